"""The depth images of a capture folder, as views of a later visit are asked for what they measured."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.formats.capture import depth_files, read_poses
from og_pointcloud.formats.depth import DepthFile
from og_pointcloud.formats.poses import in_local_frame
from og_pointcloud.mapping.sight import MeasuredView, view_of_depth

__all__ = ["depth_views"]


@dataclass(frozen=True)
class _DepthViews:
    """Views that are read one by one, as often as they are asked for."""

    files: tuple[DepthFile, ...]
    origin: NDArray[np.float64]

    def __iter__(self) -> Iterator[MeasuredView]:
        for file in self.files:
            image = file.read()
            yield view_of_depth(image.depth, in_local_frame(image.camera, self.origin))


def depth_views(capture: str | Path, origin: NDArray[np.float64]) -> _DepthViews | None:
    """What the depth images of a capture measured, from cameras in the local frame of that origin (world = local +
    origin); None where it has none."""
    files = depth_files(Path(capture), read_poses(Path(capture)))
    return _DepthViews(tuple(files.values()), origin) if files else None
