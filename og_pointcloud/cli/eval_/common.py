"""What the protocols share: cells of a table, and where the predictions are."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from og_pointcloud.errors import OgPointcloudError


class Spread(Protocol):
    """An interval of any kind."""

    @property
    def mean(self) -> float: ...
    @property
    def low(self) -> float: ...
    @property
    def high(self) -> float: ...


def percent(value: float | None) -> str:
    return "-" if value is None or value != value else f"{100 * value:.1f}"


def spread(interval: Spread | None) -> str:
    return f"{percent(interval.low)} to {percent(interval.high)}" if interval else "-"


def signed(interval: Spread) -> str:
    """A difference with its interval, in points of percent."""
    return f"{100 * interval.mean:+.1f} ({100 * interval.low:+.1f} to {100 * interval.high:+.1f})"


def prediction_file(folder: Path, scene: str, endings: Sequence[str] = (".ogpc", ".npz")) -> Path:
    """The file of one scene in a folder of them; a missing one is an error."""
    files = [folder / f"{scene}{ending}" for ending in endings]
    file = next((file for file in files if file.is_file()), None)
    if file is None:
        names = " nor ".join(file.name for file in files)
        raise OgPointcloudError(
            f"{folder} has {'neither ' if len(files) > 1 else 'no '}{names}: a mean over other scenes is another "
            "figure; fit that scene, or name the scenes to score"
        )
    return file
