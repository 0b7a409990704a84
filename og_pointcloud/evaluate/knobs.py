"""The settings that a sweep tries, which trade error for time.

A knob is a list of named values; each value is a whole `FitSettings`, so that any setting of a fit can be a knob.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.settings import FitSettings


@dataclass(frozen=True)
class Setting:
    """One value of one knob. every: one in this many views of the capture is used, 1 for all."""

    knob: str
    value: str
    settings: FitSettings = field(default_factory=FitSettings)
    every: int = 1

    @property
    def name(self) -> str:
        """The knob and its value, as tables and charts show them."""
        return f"{self.knob}: {self.value}" if self.value else self.knob


def changed(record: Any, path: str, value: Any) -> Any:
    """A settings record with one number, at any depth, replaced: ``changed(settings, "geometry.neighbors", 8)``.

    TypeError or AttributeError for a path that does not exist.
    """
    name, _, rest = path.partition(".")
    return replace(record, **{name: changed(getattr(record, name), rest, value) if rest else value})


DEFAULT = Setting("default", "")
"""A fit without settings."""
ALL_POINTS = 1_000_000_000
"""More points than any cloud has."""
NUMBERS: Mapping[str, tuple[str, tuple[Any, ...]]] = {
    "mode": ("mode", ("grouping", "fast")),
    "neighbors": ("geometry.neighbors", (12, 24, 48)),
    "grouping sample": ("grouping.graph_points", (5_000, 20_000, 60_000, ALL_POINTS)),
    "join majority": ("grouping.join_majority", (0.4, 0.5, 0.6)),
    "sure share": ("membership.sure_share", (0.4, 0.6, 0.8)),
}
"""Knob -> the setting that it changes, and the values tried."""


def _label(value: Any) -> str:
    return "all" if value == ALL_POINTS else f"{value:,}" if isinstance(value, int) else str(value)


KNOBS = {"views": tuple(Setting("views", f"one of {n}" if n > 1 else "all", every=n) for n in (1, 2, 4, 8))} | {
    name: tuple(Setting(name, _label(value), changed(FitSettings(), path, value)) for value in values)
    for name, (path, values) in NUMBERS.items()
}
"""Name -> values, one of which is the default."""
QUICK_KNOBS = ("mode", "views", "grouping sample")
"""Knobs of a quick report."""


def settings_of(knobs: tuple[str, ...] | None = None) -> list[Setting]:
    """The default, then every other value of these knobs (None: of all). OgPointcloudError for an unknown name."""
    names = tuple(KNOBS) if knobs is None else knobs
    unknown = [name for name in names if name not in KNOBS]
    if unknown:
        raise OgPointcloudError(f"'{unknown[0]}' is not a knob; expected one of {', '.join(KNOBS)}")
    values = (value for name in dict.fromkeys(names) for value in KNOBS[name])
    return [DEFAULT, *(one for one in values if (one.settings, one.every) != (DEFAULT.settings, DEFAULT.every))]
