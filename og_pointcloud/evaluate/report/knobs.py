"""The settings that trade error for time, and what forces back in what a scene's fit left out."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.settings import FitSettings, PaperSettings

__all__ = [
    "ALWAYS_FORCED",
    "DEFAULT",
    "EXACT",
    "FAST",
    "FORCED",
    "KNOBS",
    "NOT_FORCED",
    "PAPER",
    "SEEDS",
    "Forced",
    "Knob",
    "Setting",
    "base_of",
    "find_setting",
    "forced_by",
    "settings_to_try",
]

Shared = Literal["nothing", "geometry", "table"]
Special = Literal["", "float16 weights", "float16 features", "plain points", "coincident points"]


@dataclass(frozen=True)
class Setting:
    """One value of one knob.

    every: each every-th view of the capture is used, 1 for all. shares: what it cannot change and so takes over from
    the default's fit: nothing, the choice of Gaussians (geometry), or the whole mask table; their seconds are added.
    special: what is done beside settings: the mask table's weights or features go through float16, Gaussians of the
    file are taken as plain points, or points at one place are all kept.
    """

    knob: str
    value: str
    settings: FitSettings = field(default_factory=FitSettings)
    every: int = 1
    shares: Shared = "nothing"
    special: Special = ""

    @property
    def is_default(self) -> bool:
        """Whether a fit without any settings is this one."""
        return self.settings == FitSettings() and self.every == 1 and not self.special


@dataclass(frozen=True)
class Knob:
    """What is turned, the values tried, and why the default is where it is. base: what the values are held against."""

    name: str
    why: str
    values: tuple[Setting, ...]
    base: Setting

    def is_base(self, value: Setting) -> bool:
        """Whether a value is where the knob stands by default."""
        return value.settings == self.base.settings and value.every == 1 and not value.special

    @property
    def default_value(self) -> str:
        """The name of the value where the knob stands by default."""
        return next(value.value for value in self.values if self.is_base(value))


@dataclass(frozen=True)
class Forced:
    """words: a regular expression of a fit's list of what it left out. setting: forces that back in."""

    words: str
    setting: Setting


def _part(name: str, **changes: Any) -> FitSettings:
    """The defaults with some numbers of one part changed: ``_part("geometry", max_stride=1)``."""
    defaults = FitSettings()
    return replace(defaults, **{name: replace(getattr(defaults, name), **changes)})


def _knob(
    name: str, why: str, part: str, field: str, values: dict[str, Any], shares: Shared = "nothing", mode: Any = "auto"
) -> Knob:
    tried = (
        Setting(name, label, replace(_part(part, **{field: value}), mode=mode), shares=shares)
        for label, value in values.items()
    )
    return Knob(name, why, tuple(tried), FAST if mode == "fast" else DEFAULT)


def _mode(mode: Any, **paper: Any) -> FitSettings:
    return FitSettings(mode=mode, paper=PaperSettings(**paper))


def _codebook(value: str, **changes: Any) -> Setting:
    return Setting("codebook", value, replace(_part("codebook", **changes), mode="fast"), shares="table")


DEFAULT = Setting("default", "")
FAST = Setting("mode", "fast", _mode("fast"), shares="table")
"""What the knobs of learned features and codebook start from: by default neither runs on most scenes."""
GROUPING = Setting("mode", "grouping", _mode("grouping"), shares="table")

EXACT = Setting(
    "exact",
    "no cut-off, every pixel, every point",
    replace(
        _part("visibility", alpha_min=1e-6, transmittance_min=1e-9),
        geometry=replace(FitSettings().geometry, max_stride=1),
        grouping=replace(FitSettings().grouping, graph_points=1_000_000_000),
    ),
    shares="geometry",
)
"""The default without its approximations; what other fits disagree with it is what approximation costs."""

KNOBS = (
    Knob(
        "mode",
        "grouping decides as well as learned features on most scenes in a fraction of the time; auto learns only where "
        "grouping explains the masks badly",
        (GROUPING, FAST, Setting("mode", "auto")),
        DEFAULT,
    ),
    Knob(
        "views",
        "a view costs its time once; what it alone sees is lost without it",
        (Setting("views", "all"), *(Setting("views", f"one of {n}", every=n) for n in (2, 4, 8))),
        DEFAULT,
    ),
    _knob(
        "enough views",
        "choosing views costs time, and short captures have few to spare; long videos gain",
        "visibility", "enough_views", {"none": None, "5": 5, "20": 20},
    ),
    _knob(
        "pixels per spacing",
        "finer pixels see nothing new of the cloud, coarser ones lose thin edges",
        "geometry", "pixels_per_spacing", {"0.5": 0.5, "1": 1.0, "2": 2.0, "4": 4.0}, "geometry",
    ),
    _knob(
        "alpha cut-off",
        "that of 3DGS; raising it saves little of the kernel's time and begins to show",
        "visibility", "alpha_min", {"1/1024": 1 / 1024, "1/255": 1 / 255, "1/64": 1 / 64, "1/16": 1 / 16}, "geometry",
    ),
    _knob(
        "transmittance cut-off",
        "that of 3DGS; what lies deeper has no weight left",
        "visibility", "transmittance_min", {"1e-5": 1e-5, "1e-4": 1e-4, "1e-2": 1e-2, "1e-1": 1e-1}, "geometry",
    ),
    _knob(
        "photographs",
        "few take the wrong scale now and then, many take longer for the same one",
        "geometry", "photographs", {"2": (2, 2), "4 to 10": (4, 10), "10 to 20": (10, 20)},
    ),
    _knob(
        "neighbours",
        "enough that borders are settled by a majority",
        "geometry", "neighbours", {"8": 8, "16": 16, "32": 32},
    ),
    Knob(
        "mask table",
        "weights of 24 bits are what the kernel makes; half of that would do, and would halve the table",
        (
            Setting("mask table", "float32", shares="table"),
            Setting("mask table", "weights float16", shares="table", special="float16 weights"),
            Setting("mask table", "features float16", shares="table", special="float16 features"),
        ),
        DEFAULT,
    ),
    _knob(
        "grouping sample",
        "overlaps of masks hardly change with more points",
        "grouping", "graph_points", {"5,000": 5_000, "20,000": 20_000, "60,000": 60_000, "all": 1_000_000_000}, "table",
    ),
    _knob("feature width", "as published", "features", "width", {"3": 3, "6": 6, "12": 12}, "table", "fast"),
    _knob(
        "feature tolerance", "instances hardly change below it",
        "features", "tolerance", {"1e-2": 1e-2, "1e-3": 1e-3, "1e-4": 1e-4}, "table", "fast",
    ),
    _knob(
        "feature steps", "as many as the tolerance asks for",
        "features", "max_steps", {"10": 10, "30": 30, "until converged": 1000}, "table", "fast",
    ),
    Knob(
        "codebook",
        "k follows the masks of a view; the published k1 and k2 are larger than most scenes and tear things",
        (
            _codebook("two levels, k from masks"),
            _codebook("one level, k from masks", levels=1),
            _codebook("k1 32, k2 5", k1=32, k2=5),
            _codebook("k1 64, k2 5", k1=64, k2=5),
        ),
        FAST,
    ),
)  # fmt: skip
"""In the order of the pipeline."""

PAPER = Setting("mode", "paper, 3 % of its steps", _mode("paper", schedule_share=0.03))
"""Tried only where it is asked for: minutes to hours."""

SEEDS = (
    Setting("seed", "1", FitSettings(seed=1)),
    *(Setting("seed of mode fast", str(seed), FitSettings(mode="fast", seed=seed), shares="table") for seed in (1, 2)),
)
"""Not knobs: what chance has to say."""

FORCED = (
    Forced("of the pixels$", Setting("left out", "all pixels", _part("geometry", max_stride=1), shares="geometry")),
    Forced(r"^\d+ masks$", Setting("left out", "spanning masks", _part("grouping", part_share=2.0), shares="table")),
    Forced("groups of masks$", Setting("left out", "dismissed groups", _part("membership", rate_share=0.0),
                                       shares="table")),
    Forced("^learned features|^instances from learned", FAST),
    Forced("^instances from grouping$", GROUPING),
    Forced(r"^\d+ points$", Setting("left out", "coincident points", special="coincident points")),
    Forced("^choice of scale", Setting("left out", "choice of scale and opacity", special="plain points")),
)  # fmt: skip
"""What a fit's list can name."""

ALWAYS_FORCED = (
    Forced("islands of points seen through", Setting("left out", "islands", _part("membership", island_share=0.0),
                                                     shares="table")),
    Forced("outlying masks of a descriptor", Setting("left out", "outlying masks",
                                                     _part("association", outlier_deviations=1e9), shares="table")),
)  # fmt: skip
"""What a fit leaves out without a line in its list."""

NOT_FORCED = {
    r"^\d+ of \d+ views$": "only where enough views is set: see that knob",
    "^rendering of": "an interrupted fit had rendered them: the result is the same",
    "second level$": "no view asks for it: each coarse cluster would be its own fine one",
    "": "no setting brings it back",
}
"""Words of a fit's list -> why a report does not force it back in."""


def forced_by(what: str) -> Setting | str:
    """What forces an entry of a fit's list back in, or why nothing does.

    >>> forced_by("16 of 34 groups of masks").value
    'dismissed groups'
    >>> forced_by("3 of 40 views")
    'only where enough views is set: see that knob'
    """
    for entry in FORCED:
        if re.search(entry.words, what):
            return entry.setting
    return next(reason for words, reason in NOT_FORCED.items() if re.search(words, what))


def settings_to_try(*, paper: bool = False, only: Callable[[Knob], bool] = lambda knob: True) -> list[Setting]:
    """Every setting once, without the default."""
    knobs = [knob for knob in KNOBS if only(knob)]
    tried = [value for knob in knobs for value in knob.values if not knob.is_base(value)]
    if any(knob.base == FAST for knob in knobs):
        tried = [FAST, *tried]
    return [*dict.fromkeys(tried), *([PAPER] if paper else [])]


def base_of(knob: str) -> Setting:
    """What values of a knob are held against: mode fast for what only that mode has, else the default."""
    found = next((entry.base for entry in KNOBS if entry.name == knob), DEFAULT)
    return FAST if knob == SEEDS[-1].knob else found


def find_setting(knob: str, value: str) -> Setting:
    """The setting of that name; OgPointcloudError where there is none."""
    forced = [entry.setting for entry in (*FORCED, *ALWAYS_FORCED)]
    every = (DEFAULT, EXACT, PAPER, *SEEDS, *forced, *(value for knob in KNOBS for value in knob.values))
    for setting in every:
        if (setting.knob, setting.value) == (knob, value):
            return setting
    raise OgPointcloudError(f"'{knob}' has no value '{value}'; expected one that knobs.py lists")
