"""What a sweep tries: the settings that trade error for time.

A knob is a list of named values; each value is a whole `FitSettings`, so that whatever a fit can be told can be a knob.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.settings import FitSettings


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
