"""What a sweep tries: the settings that trade error for time, and the paper's ablations (Sec. 4.4).

A knob is a list of named values; each value is a whole `FitSettings`, so that whatever a fit can be told can be a knob.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.settings import CodebookSettings, FeatureSettings, FitSettings, MatchingSettings, PaperSettings


@dataclass(frozen=True)
class Setting:
    """One value of one knob. every: each every-th view of the capture is used, 1 for all. published: mIoU of this row
    in the paper, if it is one of its tables' rows."""

    knob: str
    value: str
    settings: FitSettings = field(default_factory=FitSettings)
    every: int = 1
    published: float | None = None

    @property
    def name(self) -> str:
        """The knob and its value, as tables and charts show them."""
        return f"{self.knob}: {self.value}" if self.value else self.knob


DEFAULT = Setting("default", "")
"""A fit without settings."""
FAST = Setting("mode", "fast", FitSettings(mode="fast"))
"""What the knobs of learned features and codebook start from: by default neither runs on most scenes."""
ALL = 1_000_000_000
"""More points than any cloud has."""

Changes = Mapping[str, Any]
"""Settings by path: ``{"geometry.neighbours": 8, "seed": 2}``."""

ONE_NUMBER: Mapping[str, tuple[str, tuple[Any, ...]]] = {
    "mode": ("mode", ("grouping", "fast")),
    "neighbours": ("geometry.neighbours", (8, 16, 32)),
    "grouping sample": ("grouping.graph_points", (5_000, 20_000, 60_000, ALL)),
    "join majority": ("grouping.join_majority", (0.4, 0.5, 0.6)),
    "sure share": ("membership.sure_share", (0.4, 0.6, 0.8)),
    "feature width": ("features.width", (3, 6, 12)),
    "feature tolerance": ("features.tolerance", (1e-2, 1e-3, 1e-4)),
    "feature steps": ("features.max_steps", (10, 30, 1000)),
}
"""Knob -> the number that it sets, and the values tried."""
CODEBOOKS: Mapping[str, Changes] = {
    "two levels, k from masks": {},
    "one level, k from masks": {"codebook.levels": 1},
    "k1 32, k2 5": {"codebook.k1": 32, "codebook.k2": 5},
    "k1 64, k2 5": {"codebook.k1": 64, "codebook.k2": 5},
}


def changed(record: Any, path: str, value: Any) -> Any:
    """A settings record in which one number, at any depth, is another."""
    name, _, rest = path.partition(".")
    return replace(record, **{name: changed(getattr(record, name), rest, value) if rest else value})


def _with(base: FitSettings, changes: Changes) -> FitSettings:
    for path, value in changes.items():
        base = changed(base, path, value)
    return base


def _label(value: Any) -> str:
    if value == ALL:
        return "all"
    return f"{value:.2g}" if isinstance(value, float) else f"{value:,}" if isinstance(value, int) else value


def _knobs() -> dict[str, tuple[Setting, ...]]:
    tables = {name: {_label(value): {path: value} for value in values} for name, (path, values) in ONE_NUMBER.items()}
    every = {f"one of {count}" if count > 1 else "all": count for count in (1, 2, 4, 8)}
    knobs = {"views": tuple(Setting("views", label, every=count) for label, count in every.items())}
    for name, values in {**tables, "codebook": CODEBOOKS}.items():
        base = FAST.settings if name.startswith(("feature", "codebook")) else DEFAULT.settings
        knobs[name] = tuple(Setting(name, label, _with(base, changes)) for label, changes in values.items())
    return knobs


KNOBS = _knobs()
"""Name -> values, of which one is what stands by default (for those of features and codebook: in mode fast)."""
QUICK = ("mode", "views", "grouping sample")
"""Knobs of a report in a hurry."""


def settings_of(knobs: tuple[str, ...] | None = None) -> list[Setting]:
    """The default, then every other value of these knobs (None: of all) once. OgPointcloudError for an unknown name."""
    names = tuple(KNOBS) if knobs is None else knobs
    unknown = [name for name in names if name not in KNOBS]
    if unknown:
        raise OgPointcloudError(f"'{unknown[0]}' is no knob; expected one of {', '.join(KNOBS)}")
    values = [value for name in names for value in KNOBS[name]]
    of_fast = any(value.settings.mode == "fast" for value in values)
    tried: dict[tuple[FitSettings, int], Setting] = {}
    for value in [DEFAULT, *([FAST] if of_fast else []), *values]:
        tried.setdefault((value.settings, value.every), value)
    return list(tried.values())


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


def _one_level(k: int, positions: bool) -> tuple[Changes, Changes]:
    paper = {"paper.k1": k, "paper.k2": 1} | ({} if positions else {"paper.position_weight": 0.0})
    return {"codebook.levels": 1, "codebook.k2": None, "codebook.k1": k, "codebook.positions": positions}, paper


ABLATIONS: Mapping[str, Mapping[str, tuple[float, Changes, Changes]]] = {
    "losses": {
        "inter only": (0.3524, {"features.intra": False}, {"paper.intra": False}),
        "intra only": (0.2589, {"features.inter": False}, {"paper.inter": False}),
        "both": (0.3829, {}, {}),
    },
    "codebook": {
        "one level, k = 64": (0.2868, *_one_level(64, False)),
        "one level, k = 320": (0.1461, *_one_level(320, False)),
        "one level, k = 64, xyz": (0.3204, *_one_level(64, True)),
        "one level, k = 320, xyz": (0.1520, *_one_level(320, True)),
        "two levels": (0.3027, {"codebook.positions": False}, {"paper.position_weight": 0.0}),
        "two levels, xyz": (0.3829, {}, {}),
    },
    "association": {
        "IoU only": (0.3528, {"matching.score": "iou"}, {"paper.matching.score": "iou"}),
        "feature only": (0.3401, {"matching.score": "feature"}, {"paper.matching.score": "feature"}),
        "both": (0.3829, {}, {}),
    },
}
"""Rows of the paper's tables: their mIoU there, on 10 classes of ScanNet (other data: compare the order, not the size);
what the row changes of `LITERAL`; and of mode paper."""


def ablations(schedule_share: float | None = None) -> list[Setting]:
    """The default and mode fast, then the rows of the paper's three tables.

    schedule_share: None takes the literal method from the mask table (mode fast); else as trained by rendering, with
    this share of the published schedule.
    """
    paper = schedule_share is not None
    base = FitSettings(mode="paper", paper=PaperSettings(schedule_share=schedule_share)) if paper else LITERAL
    rows = [
        Setting(table, row, _with(base, of_paper if paper else literal), published=published)
        for table, values in ABLATIONS.items()
        for row, (published, literal, of_paper) in values.items()
    ]
    return [DEFAULT, FAST, *rows]
