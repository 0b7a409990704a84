"""Does the rendering of view i fit photograph i better than other photographs?

The points' colors are rendered at the stated poses, on a grid of some dozen cells a side, and correlated with the
photographs on that grid. So coarse a photograph shows little but where things are, which wrong poses get wrong; another
exposure, noise and hidden points change little. Nothing else of the capture is used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.checking.sample import Comparison, Sample, Seen, grid_shape, seen
from og_pointcloud.errors import SceneError
from og_pointcloud.formats.images import require_cv2
from og_pointcloud.scene import Camera, View

Floats = NDArray[np.float32]

MAX_SIDE_PX = 192
FEW_VIEWS, FEW_POINTS = 4, 3000
MIN_CELLS = 30
"""A rendering with fewer cells is no evidence."""
MAX_BLACK_SHARE = 0.02
"""A pixel of a reduced image shows nothing when more than this share of it is black, as beyond a lens's rim."""
MIN_COLOR_DEVIATION = 3.0
"""Standard deviation of colors, of 255, below which there is nothing to compare."""
SAME_CONTENT_CORRELATION = 0.95
"""Photographs that correlate at least this much show the same: either may fit the other's rendering as well."""
MIN_COMPARISONS = 3
MAX_GRAY_TINT = 3.0
"""Mean range of the channels, of 255, below which colors are gray: a LiDAR's intensity, say."""
MAX_CLASS_COLORS = 64
"""A cloud colored by class has at most this many colors."""


@dataclass(frozen=True)
class Photographs:
    """sample: the views of the scene that have photographs. images: (H, W, 3) each, MAX_SIDE_PX along the longer side,
    NaN where nothing is shown. grids: for each view (1 + rivals, cells, 3), its photograph on the grid of `seen`, then
    the rivals on the same grid: its own mirrored, and others that do not show the same."""

    sample: Sample
    images: list[Floats]
    grids: list[Floats]

    def fit(self, cameras: Sequence[Camera]) -> Comparison:
        """How much better each rendering by these cameras fits its own photograph than the rivals."""
        assert self.sample.rgb is not None
        pairs = []
        for camera, grid in zip(cameras, self.grids, strict=True):
            drawing, cells = _drawing(seen(self.sample.xyz, camera), self.sample.rgb)
            own, *others = _correlations(drawing, grid[:, cells])  # all over the same cells, those of the rendering
            pairs += [(own, other) for other in others]
        return Comparison.of(pairs, "correlation", of_rest=True)

    def fewer(self) -> Photographs:
        """The same with fewer views and points, for searches that compare many cameras."""
        rows = list(range(0, len(self.images), 1 + (len(self.images) - 1) // FEW_VIEWS))
        sample = self.sample.thinned(FEW_POINTS).of_views(rows)
        return Photographs(sample, [self.images[row] for row in rows], [self.grids[row] for row in rows])

    @property
    def points_are_painted(self) -> bool:
        """Whether the points' colors may not come from photographs: gray where the photographs are not, or only a few
        distinct ones, as for classes."""
        rgb = self.sample.rgb
        if rgb is None or len(np.unique(rgb, axis=0)) <= MAX_CLASS_COLORS:
            return True
        return _tint(rgb) < MAX_GRAY_TINT <= float(np.median([_tint(grid[0]) for grid in self.grids]))


def read_photographs(sample: Sample) -> tuple[Photographs | None, list[str]]:
    """None where there is nothing to compare: no photographs, no colors, or a few photographs of the same; and the
    error of each photograph that cannot be read."""
    if sample.rgb is None:
        return None, []
    shown, images, errors = [], [], []
    for row, view in enumerate(sample.views):
        try:
            image = _small_image(view)
        except SceneError as error:
            errors.append(str(error))
            continue
        if image is not None:
            shown.append(row)
            images.append(image)
    has_colors = float(sample.rgb.std(axis=0).max()) >= MIN_COLOR_DEVIATION
    sample = sample.of_views(shown)
    shapes = [grid_shape(camera) for camera in sample.cameras]
    small = [_resized(image, columns, rows) for image, (rows, columns) in zip(images, shapes, strict=True)]
    grids = [_with_rivals(grid, small) for grid in small]
    is_enough = has_colors and sum(len(grid) - 1 for grid in grids) >= MIN_COMPARISONS
    return (Photographs(sample, images, grids) if is_enough else None), errors


def shrunk(image: NDArray[np.generic], side: int) -> Floats:
    """The image (H, W, ...) reduced by averaging until its longer side has at most ``side`` pixels, and the shorter
    one at least two: fewer have no gradient."""
    scale = min(1.0, side / max(image.shape[:2]))
    return _resized(image, *(max(2, round(scale * length)) for length in image.shape[1::-1]))


def _resized(image: NDArray[np.generic], width: int, height: int) -> Floats:
    cv2 = require_cv2()
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.float32)


def _small_image(view: View) -> Floats | None:
    """None for a photograph that shows nothing. SceneError where it cannot be read."""
    image = view.image_rgb()
    if image is None:
        return None
    small = shrunk(image, MAX_SIDE_PX)
    if float(small.std()) < MIN_COLOR_DEVIATION:
        return None
    black = require_cv2().inRange(image, (0, 0, 0), (0, 0, 0))  # 255 where it is
    small[shrunk(black, MAX_SIDE_PX) > 255 * MAX_BLACK_SHARE] = np.nan
    return small


def _drawing(points: Seen, rgb: Floats) -> tuple[Floats, NDArray[np.intp]]:
    """(c, 3) mean color of the cells that hold a point, and (c,) which cells these are, ascending."""
    size = points.shape[0] * points.shape[1]
    count = np.bincount(points.cells, minlength=size)
    held = np.flatnonzero(count)
    sums = [np.bincount(points.cells, rgb[points.rows, channel], size)[held] for channel in range(3)]
    return (np.stack(sums, axis=1) / count[held, None]).astype(np.float32), held


def _with_rivals(grid: Floats, grids: list[Floats]) -> Floats:
    """(1 + rivals, cells, 3): the grid itself, its mirror image, and other views' grids, none that shows the same."""
    rows, columns = grid.shape[:2]
    others = [require_cv2().resize(other, (columns, rows)) for other in grids if other is not grid]
    candidates = np.stack([grid, grid[:, ::-1], *others]).reshape(-1, rows * columns, 3)
    alike = _correlations(candidates[0], candidates) >= SAME_CONTENT_CORRELATION
    return candidates[np.r_[True, ~alike[1:]]]


def _correlations(drawing: Floats, photographs: Floats) -> Floats:
    """(k,) of colors (c, 3) with photographs (k, c, 3), all channels together, each less its mean; 0 where too little
    is shown."""
    shown = np.asarray(np.isfinite(photographs).all(axis=2, keepdims=True))
    a, b = centered(drawing[None], shown), centered(np.where(shown, photographs, 0), shown)
    # 1e-6 keeps a uniform rendering or photograph, of length 0, from dividing by 0.
    size = np.sqrt((a * a).sum(axis=(1, 2)) * (b * b).sum(axis=(1, 2)) + 1e-6)
    return np.where(shown.sum(axis=(1, 2)) < MIN_CELLS, 0, (a * b).sum(axis=(1, 2)) / size)


def centered(colors: NDArray[Any], shown: NDArray[np.bool_]) -> NDArray[Any]:
    """Colors (..., n, 3) less the mean of those that are shown (..., n, 1); 0 where they are not."""
    mean = (colors * shown).sum(axis=-2, keepdims=True) / np.maximum(shown.sum(axis=-2, keepdims=True), 1)
    return (colors - mean) * shown


def _tint(colors: Floats) -> float:
    return float(np.nanmean(np.ptp(colors.reshape(-1, 3), axis=1)))
