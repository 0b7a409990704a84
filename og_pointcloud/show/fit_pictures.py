"""Pictures of features, as in the paper's figures: rendered over several views, stage below stage.

Features become colors by one linear map, fitted once and used for every stage, so that equal colors mean equal
features before and after discretization. The colors are rendered with the blending weights of the renderer.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.ask.hosts import numbers_of
from og_pointcloud.errors import SceneError
from og_pointcloud.formats.images import require_cv2, write_png
from og_pointcloud.rendering.splatting import Gaussians, render
from og_pointcloud.scene import View

GREY = (128, 128, 128)
"""A point without a feature, because no view sees it."""
SPREAD = 1.5
"""Standard deviations to either side of the mean that a color channel shows."""
LEAST_RANGE = 0.25
"""Least range that a channel shows, as a share of the widest one's: less may be noise, and is not stretched."""
OPAQUE = 0.5
"""Pixels that are covered at least this much show their value alone, emptier ones fade to white."""
CELL_WIDTH = 360
"""Pixels; views that are narrower keep their size."""
GAP, STRIP, MARGIN = 6, 26, 10
TEXT_SCALE, LETTER = 0.5, 11
"""Size of letters, and pixels that the widest takes: of long names the end is shown, where they differ."""
PLOT_HEIGHT, CURVE = 200, (31, 119, 180)
"""Height of a plot of losses, pixels, and RGB of its curve."""

Colors = NDArray[np.uint8]


@dataclass(frozen=True)
class FeatureColors:
    """A linear map of features to RGB: ``0.5 + (f - center) @ axes``, cut to 0..1. center: (w,). axes: (w, 3)."""

    center: NDArray[np.float64]
    axes: NDArray[np.float64]

    @classmethod
    def fit(cls, features: NDArray[np.floating], weight: NDArray[np.floating]) -> FeatureColors:
        """The three principal directions of the features become red, green and blue.

        features: (n, w); rows with NaN are left out. weight: (n,), how much each counts: its visibility. Each direction
        points to where its largest component is positive, so that the same features always have the same colors.
        """
        used = _known(features) & (weight > 0)
        rows, mass = features[used].astype(np.float64), weight[used].astype(np.float64)
        axes = np.zeros((features.shape[1], 3))
        if not len(rows):
            return cls(axes[:, 0], axes)
        mass /= mass.sum()
        center = rows[0] + mass @ (rows - rows[0])  # exact where all are equal
        # Weighted principal components; eigh sorts by rising variance.
        centered = rows - center
        variances, directions = np.linalg.eigh((centered * mass[:, None]).T @ centered)
        variances, directions = variances[::-1][:3], directions[:, ::-1][:, :3]
        directions *= np.sign(directions[np.abs(directions).argmax(axis=0), np.arange(directions.shape[1])])
        # SPREAD standard deviations to either side of 0.5 fill a channel; equal features, without any, stay at 0.5.
        deviations = np.sqrt(np.maximum(variances, LEAST_RANGE**2 * variances[0]))
        axes[:, : directions.shape[1]] = directions / np.where(deviations > 0, 2 * SPREAD * deviations, np.inf)
        return cls(center, axes)

    def __call__(self, features: NDArray[np.floating]) -> Colors:
        """(n, 3) uint8 RGB of features (n, w), gray where they are NaN."""
        share = 0.5 + (features.astype(np.float64) - self.center) @ self.axes
        known = _known(features)[:, None]
        return np.where(known, np.rint(255 * np.clip(np.where(known, share, 0), 0, 1)), GREY).astype(np.uint8)


def feature_colors(features: NDArray[np.floating], weight: NDArray[np.floating]) -> Colors:
    """(n, 3) uint8 RGB of features (n, w), gray for points without weight (n,), which no view sees, and for NaN.
    SceneError where the two do not fit.

    >>> import numpy as np
    >>> import og_pointcloud as og
    >>> og.feature_colors(np.array([[0.0], [1.0], [np.nan]]), np.ones(3))[:, 0]  # red; without a feature, gray
    array([ 43, 212, 128], dtype=uint8)
    """
    features, weight = numbers_of(features), numbers_of(weight)
    fits = features.ndim == 2 and features.shape[1] and weight.shape == features.shape[:1]
    if not fits or features.dtype.kind not in "fiu" or weight.dtype.kind not in "fiu":
        raise SceneError(
            f"features are {features.dtype} {features.shape}, their weights {weight.shape}; expected numbers (n, w) "
            "and (n,)"
        )
    colors = FeatureColors.fit(features, weight)(features)
    colors[weight <= 0] = GREY
    return colors


def feature_picture(
    gaussians: Gaussians,
    views: Sequence[View],
    near: float,
    stages: Mapping[str, NDArray[np.floating]],
    path: str | os.PathLike[str],
    columns: int = 4,
) -> Path:
    """Write a PNG of features over several views: a row of photographs, where there are any, then a row a stage.

    near: depth of the near plane (`geometry.near_plane`). stages: title -> (n, w) features, NaN rows for points without
    one; colors are fitted to the first stage. columns: views shown, evenly spread.
    SceneError where the stages do not fit the Gaussians.

    >>> import pathlib, tempfile
    >>> import numpy as np
    >>> import og_pointcloud as og
    >>> from og_pointcloud.rendering.splatting import Gaussians
    >>> from og_pointcloud.scene import View
    >>> xyz, scale = np.array([[0, 0, 2], [0.2, 0, 2]], np.float32), np.full((2, 3), 0.1, np.float32)
    >>> gaussians = Gaussians(xyz, scale, np.eye(4, dtype=np.float32)[[0, 0]], np.ones(2, np.float32))
    >>> camera = og.Camera(64, 48, 60.0, 60.0, 32.0, 24.0, np.eye(4))
    >>> view = View("front", camera, np.full((48, 64), -1, np.int32), np.zeros((0, 1), np.float32))
    >>> stages = {"features": np.array([[0.0], [1.0]], np.float32)}
    >>> og.feature_picture(gaussians, [view], 0.1, stages, pathlib.Path(tempfile.mkdtemp()) / "two.png").name
    'two.png'
    """
    _check(stages, len(gaussians))
    shown = _shown(views, columns)
    colors = FeatureColors.fit(next(iter(stages.values())), np.ones(len(gaussians)))
    of_points = {title: colors(features).astype(np.float32) for title, features in stages.items()}
    rows = {title: [_rendered(gaussians, rgb, view, near) for view in shown] for title, rgb in of_points.items()}
    return _write_grid(Path(path), shown, rows)


def training_picture(stages: Sequence[Mapping[str, Any]], path: str | os.PathLike[str]) -> Path:
    """Write a PNG of each stage's losses against its steps, side by side.

    stages: of a fit in mode paper, ``cloud.provenance["notes"]["training"]``. Each has a scale of its own, from zero.
    """
    cv2 = require_cv2()
    panels = []
    for stage in stages:
        loss = np.repeat(stage["loss"], 2 if len(stage["loss"]) == 1 else 1)  # one alone is a level line
        panel = np.full((PLOT_HEIGHT + 2 * STRIP, CELL_WIDTH, 3), 255, np.uint8)
        top = float(loss.max(initial=0.0)) or 1.0
        across = np.linspace(MARGIN, CELL_WIDTH - MARGIN, len(loss))
        points = np.stack([across, STRIP + PLOT_HEIGHT * (1 - loss / top)], axis=1).round().astype(np.int32)
        cv2.polylines(panel, [points], False, CURVE, 2, cv2.LINE_AA)
        cv2.line(panel, (MARGIN, STRIP + PLOT_HEIGHT), (CELL_WIDTH - MARGIN, STRIP + PLOT_HEIGHT), (0, 0, 0), 1)
        _write_text(panel, f"{stage['stage']}: loss, 0 to {top:.3g}", MARGIN, STRIP)
        _write_text(panel, f"{stage['steps']:,} of {stage['published_steps']:,} steps", MARGIN, PLOT_HEIGHT + 2 * STRIP)
        panels.append(panel)
    return write_png(Path(path), np.concatenate(panels, axis=1))


def _check(stages: Mapping[str, NDArray[Any]], points: int) -> None:
    if not stages:
        raise SceneError("a picture has 0 stages; expected at least one title with its values")
    for title, values in stages.items():
        if values.ndim != 2 or len(values) != points or values.shape[1] == 0:
            raise SceneError(f"stage '{title}' has shape {values.shape}; expected {points} rows of features")
    if len({values.shape for values in stages.values()}) > 1:
        shapes = ", ".join(f"{title} {values.shape}" for title, values in stages.items())
        raise SceneError(f"the stages differ in shape ({shapes}); expected one, since they share their colors")


def _known(features: NDArray[np.floating]) -> NDArray[np.bool_]:
    return np.logical_and.reduce(np.isfinite(features), axis=1)


def _shown(views: Sequence[View], columns: int) -> list[View]:
    """The views to show, evenly spread, at the size they are shown in."""
    if not views or columns < 1:
        raise SceneError(f"{columns} columns of {len(views)} views; expected at least one of each")
    return [_shrunk(views[index]) for index in np.unique(np.linspace(0, len(views) - 1, columns).round().astype(int))]


def _shrunk(view: View) -> View:
    """The view at most CELL_WIDTH wide; of its masks nothing is kept."""
    cv2, camera = require_cv2(), view.camera
    width = min(camera.width, CELL_WIDTH)
    size = width, max(1, round(camera.height * width / camera.width))
    image = view.image_rgb()
    small = None if image is None else np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    none = np.full(size[::-1], -1, np.int32)
    return View(view.name, camera.resized(*size), none, np.zeros((0, 1), np.float32), small)


def _rendered(gaussians: Gaussians, rgb: NDArray[np.float32], view: View, near: float) -> NDArray:
    """(H, W, 3) mean colors of the points that show, fading to white where little covers a pixel."""
    image, covered = render(gaussians, rgb, view.camera, near)
    opacity = np.minimum(covered / OPAQUE, 1)[:, :, None]
    return opacity * image / np.maximum(covered, 1e-12)[:, :, None] + (1 - opacity) * 255


def _write_grid(path: Path, views: Sequence[View], rows: Mapping[str, Sequence[NDArray]]) -> Path:
    """One column a view under its name, one row a stage under its title, photographs first."""
    photographs = [view.image_rgb() for view in views]
    if any(image is not None for image in photographs):
        white = [np.full((view.camera.height, view.camera.width, 3), 255, np.uint8) for view in views]
        photos = [blank if image is None else image for image, blank in zip(photographs, white, strict=True)]
        rows = {"photograph": photos, **rows}
    # Left edge of each column, and, last, of what is behind them; rows are as high as the highest view.
    lefts = np.cumsum([MARGIN, *(view.camera.width + GAP for view in views)])
    height = max(view.camera.height for view in views)
    sheet = np.full((STRIP + len(rows) * (STRIP + height + GAP), int(lefts[-1]) + MARGIN - GAP, 3), 255, np.uint8)
    for left, view in zip(lefts, views, strict=False):
        _write_text(sheet, view.name[-view.camera.width // LETTER :], int(left), STRIP)
    for index, (title, row) in enumerate(rows.items()):
        top = STRIP + index * (STRIP + height + GAP)
        _write_text(sheet, title, MARGIN, top + STRIP)
        for left, image in zip(lefts, row, strict=False):
            sheet[top + STRIP : top + STRIP + image.shape[0], left : left + image.shape[1]] = np.rint(image)
    return write_png(path, sheet)


def _write_text(sheet: Colors, text: str, left: int, bottom: int) -> None:
    """Black text in a strip that ends at row ``bottom``; OpenCV's font is ASCII only."""
    cv2, ascii_text = require_cv2(), text.encode("ascii", "replace").decode()
    cv2.putText(sheet, ascii_text, (left, bottom - 8), cv2.FONT_HERSHEY_SIMPLEX, TEXT_SCALE, (0, 0, 0), 1, cv2.LINE_AA)
