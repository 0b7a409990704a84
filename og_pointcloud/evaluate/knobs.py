"""What a sweep tries: the settings that trade error for time, and the paper's ablations (Sec. 4.4).

A knob is a list of named values; each value is a whole `FitSettings`, so that whatever a fit can be told can be a knob.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.journal import LeftOut
from og_pointcloud.settings import CodebookSettings, FeatureSettings, FitSettings, MatchingSettings, PaperSettings

__all__ = ["ABLATIONS", "DEFAULT", "FORCED", "KNOBS", "PUBLISHED_MIOU", "QUICK", "Setting", "ablations", "settings_of"]


@dataclass(frozen=True)
class Setting:
    """One value of one knob. every: each every-th view of the capture is used, 1 for all."""

    knob: str
    value: str
    settings: FitSettings = field(default_factory=FitSettings)
    every: int = 1

    @property
    def name(self) -> str:
        """The knob and its value, as tables and charts show them."""
        return f"{self.knob}: {self.value}" if self.value else self.knob


DEFAULT = Setting("default", "")
"""A fit without settings."""
FAST = Setting("mode", "fast", FitSettings(mode="fast"))
"""What the knobs of learned features and codebook start from: by default neither runs on most scenes."""


def _changed(base: FitSettings, changes: Mapping[str, Any]) -> FitSettings:
    """Settings with some numbers changed: ``{"geometry.max_stride": 1, "seed": 2}``."""
    for path, value in changes.items():
        part, _, name = path.rpartition(".")
        inner = replace(getattr(base, part), **{name: value}) if part else value
        base = replace(base, **{part or name: inner})
    return base


def _knob(name: str, path: str, values: Mapping[str, Any], base: FitSettings = DEFAULT.settings) -> list[Setting]:
    """One number of the settings, several values."""
    return [Setting(name, label, _changed(base, {path: value})) for label, value in values.items()]


def _numbers(name: str, path: str, *values: float, base: FitSettings = DEFAULT.settings) -> list[Setting]:
    return _knob(name, path, {f"{value:,}": value for value in values}, base)


def _several(name: str, values: Mapping[str, Mapping[str, Any]], base: FitSettings = DEFAULT.settings) -> list[Setting]:
    """Values that change several numbers at once."""
    return [Setting(name, label, _changed(base, changes)) for label, changes in values.items()]


FORCED = "forced back in"
"""The knob that puts in again what a fit leaves out: values that a fit names are by their key in its provenance."""
ALL = 1_000_000_000
"""More points than any cloud has."""
_TRIED = (
    _knob("mode", "mode", {"grouping": "grouping", "fast": "fast", "auto": "auto"}),
    [Setting("views", "all" if every == 1 else f"one of {every}", every=every) for every in (1, 2, 4, 8)],
    _knob("enough views", "visibility.enough_views", {"none left out": None, "5": 5, "20": 20}),
    _numbers("pixels per spacing", "geometry.pixels_per_spacing", 0.5, 1.0, 2.0, 4.0),
    _knob("alpha cut-off", "visibility.alpha_min", {f"1/{part}": 1 / part for part in (1024, 255, 64, 16)}),
    _numbers("transmittance cut-off", "visibility.transmittance_min", 1e-5, 1e-4, 1e-2, 1e-1),
    _knob("photographs", "geometry.photographs", {"2": (2, 2), "4 to 10": (4, 10), "10 to 20": (10, 20)}),
    _numbers("neighbours", "geometry.neighbours", 8, 16, 32),
    _knob("grouping sample", "grouping.graph_points", {"5,000": 5_000, "20,000": 20_000, "60,000": 60_000, "all": ALL}),
    _numbers("join majority", "grouping.join_majority", 0.4, 0.5, 0.6),
    _numbers("sure share", "membership.sure_share", 0.4, 0.6, 0.8),
    _numbers("covered share", "membership.covered_share", 0.5, 0.7, 0.9),
    _numbers("border rounds", "membership.border_rounds", 0, 2, 4),
    _numbers("feature width", "features.width", 3, 6, 12, base=FAST.settings),
    _numbers("feature tolerance", "features.tolerance", 1e-2, 1e-3, 1e-4, base=FAST.settings),
    _numbers("feature steps", "features.max_steps", 10, 30, 1000, base=FAST.settings),
    _several(
        "codebook",
        {
            "two levels, k from masks": {},
            "one level, k from masks": {"codebook.levels": 1},
            "k1 32, k2 5": {"codebook.k1": 32, "codebook.k2": 5},
            "k1 64, k2 5": {"codebook.k1": 64, "codebook.k2": 5},
        },
        FAST.settings,
    ),
    _several(
        FORCED,
        {
            LeftOut.PIXELS.value: {"geometry.max_stride": 1},
            LeftOut.SPANNING_MASKS.value: {"grouping.part_share": 2.0},
            LeftOut.CONTRADICTED_GROUPS.value: {"membership.rate_share": 0.0},
            "islands": {"membership.island_share": 0.0},
            "outlying masks": {"association.outlier_deviations": 1e9},
            "all that is approximated": {
                "visibility.alpha_min": 1e-6, "visibility.transmittance_min": 1e-9, "geometry.max_stride": 1,
                "grouping.graph_points": ALL,
            },
        },
    ),
)  # fmt: skip
KNOBS: dict[str, tuple[Setting, ...]] = {tried[0].knob: tuple(tried) for tried in _TRIED}
"""Name -> values, in the order of the pipeline. One value of each but the last is what stands by default (for those of
features and codebook: in mode fast); the last forces back in what a fit leaves out."""
QUICK = ("mode", "views", "pixels per spacing", "grouping sample")
"""Knobs of a report in a hurry."""


def settings_of(knobs: tuple[str, ...] | None = None) -> list[Setting]:
    """The default, then every other value of these knobs (None: of all) once. OgPointcloudError for an unknown name."""
    names = tuple(KNOBS) if knobs is None else knobs
    unknown = [name for name in names if name not in KNOBS]
    if unknown:
        raise OgPointcloudError(f"'{unknown[0]}' is no knob; expected one of {', '.join(KNOBS)}")
    seen, tried = [(DEFAULT.settings, 1)], [DEFAULT]
    values = [value for name in names for value in KNOBS[name]]
    of_fast = any(value.settings.mode == "fast" for value in values)
    for value in [FAST, *values] if of_fast else values:
        if (value.settings, value.every) not in seen:
            seen.append((value.settings, value.every))
            tried.append(value)
    return tried


# The paper's ablations ------------------------------------------------------------------------------------------

LITERAL = FitSettings(
    mode="fast",
    features=FeatureSettings(start="random"),
    codebook=CodebookSettings(k1=64, k2=5, position_weight=2.0),
    matching=MatchingSettings(threshold=0.02, settle=False),
)
"""The method as printed, from the mask table: each row changes one thing of it. A product is smaller than either
factor: at the usual thresholds of 0.1 or 0.2 "both" would lose to them for that reason alone, so this one only keeps
off what hardly touches. The published weight of positions is per metre (1.0 on ScanNet): about 5 per extent of a room,
and no use for a table top."""
ABLATIONS = ("losses", "codebook", "association")
PUBLISHED_MIOU = {
    "losses": {"inter only": 0.3524, "intra only": 0.2589, "both": 0.3829},
    "codebook": {
        "one level, k = 64": 0.2868,
        "one level, k = 320": 0.1461,
        "one level, k = 64, xyz": 0.3204,
        "one level, k = 320, xyz": 0.1520,
        "two levels": 0.3027,
        "two levels, xyz": 0.3829,
    },
    "association": {"IoU only": 0.3528, "feature only": 0.3401, "both": 0.3829},
}
"""Of the same row in the paper: 10 classes of ScanNet. Other data: compare the order, not the size."""


def ablations(schedule_share: float | None = None) -> list[Setting]:
    """The default, grouping and mode fast, then the rows of the paper's three tables and those beside them.

    schedule_share: None takes the literal method from the mask table (mode fast); else as trained by rendering, with
    this share of the published schedule.
    """
    tables = _literal_tables() if schedule_share is None else _paper_tables(schedule_share)
    return [DEFAULT, *KNOBS["mode"][:2], *(setting for table in tables for setting in table)]


def _literal_tables() -> tuple[list[Setting], ...]:
    one_level = {"codebook.levels": 1, "codebook.k2": None}
    return (
        _several(
            "losses",
            {
                "inter only": {"features.intra": False},
                "intra only": {"features.inter": False},
                "both": {},
                "both, from masks": {"features.start": "masks"},
                "none, from masks": {"features.start": "masks", "features.max_steps": 0},
            },
            LITERAL,
        ),
        _several(
            "codebook",
            {
                **{
                    f"one level, k = {k}{', xyz' if xyz else ''}": {
                        **one_level, "codebook.k1": k, "codebook.positions": xyz,
                    }
                    for xyz in (False, True) for k in (64, 320)
                },
                "two levels": {"codebook.positions": False},
                "two levels, xyz": {},
                "two levels, xyz, adaptive k": {"codebook.k1": None, "codebook.k2": None},
            },
            LITERAL,
        ),
        _several(
            "association",
            {
                "IoU only": {"matching.score": "iou"},
                "feature only": {"matching.score": "feature"},
                "both": {},
                "both, published acceptance": {"matching": PaperSettings().matching},
                "both, settled": {"matching.settle": True},
            },
            LITERAL,
        ),
    )  # fmt: skip


def _paper_tables(schedule_share: float) -> tuple[list[Setting], ...]:
    published = FitSettings(mode="paper", paper=PaperSettings(schedule_share=schedule_share))
    matching = published.paper.matching
    without_xyz = {"paper.position_weight": 0.0}
    return (
        _several(
            "losses",
            {"inter only": {"paper.intra": False}, "intra only": {"paper.inter": False}, "both": {}},
            published,
        ),
        _several(
            "codebook",
            {
                "one level, k = 64": {"paper.k2": 1, **without_xyz},
                "one level, k = 320": {"paper.k1": 320, "paper.k2": 1, **without_xyz},
                "one level, k = 64, xyz": {"paper.k2": 1},
                "one level, k = 320, xyz": {"paper.k1": 320, "paper.k2": 1},
                "two levels": without_xyz,
                "two levels, xyz": {},
            },
            published,
        ),
        _several(
            "association",
            {
                f"{name}{', among the others' if seen == 'visible' else ''}": {
                    "paper.association": seen, "paper.matching": replace(matching, score=score),
                }
                for seen in ("alone", "visible")
                for score, name in (("iou", "IoU only"), ("feature", "feature only"), ("both", "both"))
            },
            published,
        ),
    )  # fmt: skip
