"""Does the drawing of view i fit photograph i better than other photographs?

The points' colours, drawn where the poses say, on a grid of some dozen cells, are correlated with the photographs on
that grid: what is left of a photograph there is where things are, which wrong poses get wrong. Another exposure, noise
and hidden points change little. Nothing else of the capture is asked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.checking.sample import CELLS, Sample, Seen, seen
from og_pointcloud.errors import SceneError
from og_pointcloud.formats.images import require_cv2
from og_pointcloud.scene import Camera

__all__ = ["BLACK", "Likeness", "Photographs", "read_photographs"]

FEWEST_CELLS = 30
"""A drawing of fewer cells says nothing."""
BLACK = 1.0
"""Of 255: what no light fell on is darker."""
SOME_BLACK = 0.02
"""Share of a cell that is black, above which its mean says little of what is there."""
FLAT = 3.0
"""Standard deviation of colours, of 255, below which there is nothing to compare."""
ALIKE = 0.95
"""Photographs that correlate more than this show the same: neither need fit the other's drawing less."""
FEWEST_COMPARED = 3
GREY = 3.0
"""Mean difference between the channels, of 255, up to which colours are no colours: a LiDAR's intensity, say."""
FEW_COLORS = 64
"""A cloud coloured by classes has no more."""


@dataclass(frozen=True)
class Likeness:
    """share: of comparisons in which the own photograph fits a view's drawing better than another does. own, other:
    mean correlations with them. compared: number of comparisons."""

    share: float
    own: float
    other: float
    compared: int

    @property
    def gap(self) -> float:
        """How far the own ones stand out: 0 not at all, 1 as far as they can."""
        return (self.own - self.other) / max(1 - self.other, 1e-6)


@dataclass(frozen=True)
class Photographs:
    """sample: of the scene, views with photographs. images: (H, W, 3) uint8 each; grids: the same with CELLS cells
    along the longer side, float32. rivals: of each view, the photographs that its drawing is compared with: others
    that do not show the same, and its own mirrored."""

    sample: Sample
    images: list[NDArray[np.uint8]]
    grids: list[NDArray[np.float32]]
    rivals: list[list[NDArray[np.float32]]]

    def likeness(self, cameras: Sequence[Camera]) -> Likeness:
        """How well the photographs fit what these cameras see."""
        own, other, won = [], [], 0
        for camera, grid, rivals in zip(cameras, self.grids, self.rivals, strict=True):
            drawing, cells = self._drawing(camera)
            own.append(_correlation(drawing, grid, cells))
            against = [_correlation(drawing, rival, cells) for rival in rivals]
            won += sum(own[-1] > value for value in against)
            other += against
        if not other:
            return Likeness(0.0, 0.0, 0.0, 0)
        return Likeness(won / len(other), float(np.mean(own)), float(np.mean(other)), len(other))

    def fewer(self, views: int, points: int) -> Photographs:
        """Of fewer views and points, for what is asked often."""
        sample = self.sample.fewer(views, points)
        rows = [self.sample.places.index(place) for place in sample.places]
        return Photographs(
            sample, [self.images[row] for row in rows], [self.grids[row] for row in rows],
            [self.rivals[row] for row in rows],
        )  # fmt: skip

    @property
    def points_are_painted(self) -> bool:
        """Whether the points' colours may say something else than photographs do: shades of grey where those are not
        grey, or a few colours, as of classes."""
        rgb = self.sample.rgb
        if rgb is None or len(np.unique(rgb, axis=0)) <= FEW_COLORS:
            return True
        return _tint(rgb) < GREY <= float(np.median([_tint(grid) for grid in self.grids]))

    def _drawing(self, camera: Camera) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
        assert self.sample.rgb is not None
        return drawing(seen(self.sample.xyz, camera), self.sample.rgb)


def read_photographs(sample: Sample) -> Photographs | None:
    """None where there is nothing to compare: no photographs, no colours, or a few photographs of the same."""
    if sample.rgb is None or float(sample.rgb.std(axis=0).max()) < FLAT:
        return None
    images = [_image(view) for view in sample.views]
    kept = [row for row, image in enumerate(images) if image is not None and float(image.std()) >= FLAT]
    sample = Sample(
        sample.xyz, sample.rgb, tuple(sample.views[row] for row in kept), tuple(sample.places[row] for row in kept),
        sample.listed, sample.origin,
    )  # fmt: skip
    images = [image for row in kept if (image := images[row]) is not None]
    grids = [shrunk(image, CELLS) for image in images]
    rivals = [_rivals(grid, grids) for grid in grids]
    if sum(map(len, rivals)) < FEWEST_COMPARED:
        return None
    return Photographs(sample, images, grids, rivals)


def drawing(points: Seen, rgb: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """(c, 3) mean colour of the cells that hold a point, and (c,) which cells these are, ascending."""
    size = points.shape[0] * points.shape[1]
    count = np.bincount(points.cells, minlength=size)
    held = np.flatnonzero(count)
    sums = [np.bincount(points.cells, rgb[points.rows, channel], size)[held] for channel in range(3)]
    return (np.stack(sums, axis=1) / count[held, None]).astype(np.float32), held


def shrunk(image: NDArray[np.uint8], side: int) -> NDArray[np.float32]:
    """The image with its longer side that long at most, averaged; black where a part of what is averaged is."""
    scale = min(1.0, side / max(image.shape[:2]))
    width, height = (max(1, round(scale * length)) for length in image.shape[1::-1])
    cv2 = require_cv2()
    small = np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.float32)
    black = cv2.inRange(image, (0, 0, 0), (0, 0, 0))  # 255 where it is
    small[cv2.resize(black, (width, height), interpolation=cv2.INTER_AREA) > 255 * SOME_BLACK] = 0
    return small


def _image(view) -> NDArray[np.uint8] | None:  # noqa: ANN001
    """None for a photograph that cannot be read: whoever needs it says so."""
    try:
        return view.image_rgb()
    except SceneError:
        return None


def _rivals(grid: NDArray[np.float32], grids: list[NDArray[np.float32]]) -> list[NDArray[np.float32]]:
    rows, columns = grid.shape[:2]
    fitted = [require_cv2().resize(other, (columns, rows)) for other in grids if other is not grid]
    everywhere = np.arange(rows * columns)
    flat = grid.reshape(-1, 3)
    return [rival for rival in [*fitted, grid[:, ::-1]] if _correlation(flat, rival, everywhere) < ALIKE]


def _correlation(drawing: NDArray[np.float32], photograph: NDArray[np.float32], cells: NDArray[np.intp]) -> float:
    """Of the colours in the cells, all channels together, each less its mean; 0 where there is too little. Black cells
    are left out: beyond a lens's rim a photograph shows nothing."""
    b = photograph.reshape(-1, 3)[cells]
    shown = b.max(axis=1, initial=0) >= BLACK
    if np.count_nonzero(shown) < FEWEST_CELLS:
        return 0.0
    a, b = drawing[shown], b[shown]
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    return float((a * b).sum() / np.sqrt((a * a).sum() * (b * b).sum() + 1e-6))


def _tint(colors: NDArray[np.float32]) -> float:
    return float(np.ptp(colors.reshape(-1, 3), axis=1).mean())
