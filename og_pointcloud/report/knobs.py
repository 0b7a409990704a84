"""The settings of a fit that trade error for time, and what forces back in what a scene's fit left out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.settings import FitSettings, PaperSettings

__all__ = ["DEFAULT", "FORCED", "KNOBS", "Knob", "Setting", "find_setting", "settings_to_try"]


@dataclass(frozen=True)
class Setting:
    """One value of one knob. every: each every-th view of the capture is used, 1 for all."""

    knob: str
    value: str
    settings: FitSettings = field(default_factory=FitSettings)
    every: int = 1

    @property
    def is_default(self) -> bool:
        """Whether a fit without any settings is this one."""
        return self.settings == FitSettings() and self.every == 1


@dataclass(frozen=True)
class Knob:
    """What is turned, the values tried, and why the default is where it is."""

    name: str
    why: str
    values: tuple[Setting, ...]


DEFAULT = Setting("default", "")


def _part(name: str, **changes: Any) -> FitSettings:
    """The defaults with some numbers of one part changed: ``_part("geometry", max_stride=1)``."""
    defaults = FitSettings()
    return replace(defaults, **{name: replace(getattr(defaults, name), **changes)})


def _knob(name: str, why: str, part: str, field: str, values: tuple[Any, ...], mode: Any = "auto") -> Knob:
    def named(value: Any) -> str:
        return "none" if value is None else " and ".join(map(str, value)) if isinstance(value, tuple) else f"{value:g}"

    tried = (Setting(name, named(value), replace(_part(part, **{field: value}), mode=mode)) for value in values)
    return Knob(name, why, tuple(tried))


def _mode(mode: Any, **paper: Any) -> FitSettings:
    return FitSettings(mode=mode, paper=PaperSettings(**paper))


KNOBS = (
    Knob(
        "mode",
        "grouping is as good as learned features on the scenes measured and takes a fraction of the time; auto learns "
        "only where grouping explains the masks badly",
        tuple(Setting("mode", mode, _mode(mode)) for mode in ("grouping", "fast", "auto")),
    ),
    Knob(
        "views",
        "all: a view costs time once, and what it alone sees is lost without it",
        (DEFAULT, *(Setting("views", f"one of {n}", every=n) for n in (2, 4, 8))),
    ),
    _knob(
        "enough views",
        "none: choosing views takes longer than most captures' superfluous views; long videos gain",
        "visibility", "enough_views", (5, 10, 20, None),
    ),
    _knob(
        "pixels per spacing",
        "2: finer pixels see nothing new of the cloud, coarser ones lose small things and thin edges",
        "geometry", "pixels_per_spacing", (0.5, 1.0, 2.0, 4.0),
    ),
    _knob(
        "alpha cut-off",
        "1/255, as 3DGS: raising it saves a few per cent of the kernel and begins to show",
        "visibility", "alpha_min", (1 / 1024, 1 / 255, 1 / 64, 1 / 16),
    ),
    _knob(
        "transmittance cut-off",
        "1e-4, as 3DGS: what lies deeper has no weight left",
        "visibility", "transmittance_min", (1e-5, 1e-4, 1e-2, 1e-1),
    ),
    _knob(
        "photographs",
        "4, and 10 to decide close calls: fewer take the wrong scale now and then, more take longer for the same one",
        "geometry", "photographs", ((2, 2), (4, 10), (10, 20)),
    ),
    _knob(
        "grouping sample",
        "60,000 points: overlaps of masks do not change with more",
        "grouping", "graph_points", (5_000, 20_000, 60_000, 1_000_000_000),
    ),
    _knob(
        "neighbours",
        "16: enough that borders are settled by a majority",
        "geometry", "neighbours", (8, 16, 32),
    ),
    _knob("feature width", "6, as published", "features", "width", (3, 6, 12), mode="fast"),
    _knob(
        "feature tolerance", "1e-3: instances do not change below it",
        "features", "tolerance", (1e-2, 1e-3, 1e-4), mode="fast",
    ),
)  # fmt: skip
"""In the order of the pipeline; of each the default is one of the values."""

PAPER = Setting("mode", "paper, 3 % of its steps", _mode("paper", schedule_share=0.03))
"""Tried only where it is asked for: minutes to hours."""

FORCED: tuple[tuple[str, Setting], ...] = (
    ("of the pixels", Setting("left out", "all pixels", _part("geometry", max_stride=1))),
    ("groups of masks", Setting("left out", "all groups of masks", _part("membership", rate_share=0.0))),
    ("learned features", Setting("left out", "learned features", _mode("fast"))),
    ("learned features", Setting("left out", "learned features in two levels",
                                 replace(_part("codebook", levels=2), mode="fast"))),
)  # fmt: skip
"""Words of a fit's list of what it left out -> the setting that forces it back in."""


def settings_to_try(*, paper: bool = False, only: Callable[[Knob], bool] = lambda knob: True) -> list[Setting]:
    """Every setting once, the default first."""
    tried = [setting for knob in KNOBS if only(knob) for setting in knob.values if not setting.is_default]
    return [DEFAULT, *tried, *([PAPER] if paper else [])]


def find_setting(knob: str, value: str) -> Setting:
    """The setting of that name; OgPointcloudError where there is none."""
    forced = [setting for _, setting in FORCED]
    for setting in (DEFAULT, PAPER, *forced, *(setting for knob in KNOBS for setting in knob.values)):
        if (setting.knob, setting.value) == (knob, value):
            return setting
    raise OgPointcloudError(f"'{knob}' has no value '{value}'; expected one that og_pointcloud.report.knobs lists")
