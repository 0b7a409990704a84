"""Which views a scene needs: those that see what few others have seen.

Neighbouring frames of a video see the same. Counted on a sample of the points: views are asked in an order that
spreads over the sequence, and one whose points have nearly all been seen often enough already is left out. What a view
sees is told by a coarse depth test; nothing is rendered, no mask is read.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.scene import Camera, View

__all__ = ["needed_views"]

SAMPLE = 20_000
"""Points that are looked at."""
CELLS = 48
"""Cells along an image's longer side; of each, the nearest points are seen."""
BEHIND = 1.1
"""Points up to so many times as deep as the nearest one of their cell are seen."""
NEW_SHARE = 0.05
"""A view is needed when more than this share of what it sees has not been seen often enough."""


def needed_views(xyz: NDArray[np.float32], views: Sequence[View], enough: int) -> list[int]:
    """Indices of the views to use, ascending, so that what any view sees is seen by about ``enough`` of them."""
    sample = xyz[:: 1 + len(xyz) // SAMPLE]
    seen_by = np.zeros(len(sample), np.int32)
    needed = []
    for index in _spread_order(len(views)):
        seen = _seen(sample, views[index].camera)
        if len(seen) and (seen_by[seen] < enough).mean() > NEW_SHARE:
            seen_by[seen] += 1
            needed.append(index)
    return sorted(needed)


def _spread_order(count: int) -> list[int]:
    """0 to count - 1, each as far from those before it as halving allows: the first, the middle, the quarters ..."""
    bits = max(count - 1, 0).bit_length()
    reversed_bits = (int(format(k, f"0{bits}b")[::-1], 2) for k in range(1 << bits)) if bits else iter([0])
    return [index for index in reversed_bits if index < count]


def _seen(xyz: NDArray[np.float32], camera: Camera) -> NDArray[np.intp]:
    """Indices of the points that are in the image and not far behind the nearest one of their cell."""
    uv_px, depth = camera.project(xyz)
    inside = np.flatnonzero(camera.shows(uv_px))
    cell_px = max(camera.width, camera.height) / CELLS
    column, row = (uv_px[inside] // cell_px).astype(np.int64).T
    cell = row * CELLS + column
    nearest = np.full(CELLS * CELLS, np.inf)
    np.minimum.at(nearest, cell, depth[inside])
    return inside[depth[inside] <= BEHIND * nearest[cell]]
