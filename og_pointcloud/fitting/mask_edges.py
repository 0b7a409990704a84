"""Masks that end before the things that they show -> masks that end where the photograph changes.

Some proposers' masks keep off edges, by training or because somebody has eroded them. All views then say that the rims
of things are background, and no vote of theirs can tell otherwise. The photographs can: across the edge of a thing
brightness changes more than along it, and this contrast is largest at the edge itself. With

    c(d)   the mean of |change across| - |change along|, over pixels d pixels outside of the nearest mask

taken over evenly spread views, masks end early by the d at which c is largest, if c is clearly larger there than at the
masks' own edges: MIN_CONTRAST_RATIO times as large, and by MIN_STANDARD_ERRORS of its mean over the views. Texture
inside of masks changes in all directions alike, and masks that are ragged but end at the right place on average peak
at 0. Then every mask is widened by d, but not into others. Without photographs masks stay as they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.fitting.seen_colors import with_photograph
from og_pointcloud.formats.images import require_cv2
from og_pointcloud.journal import Journal
from og_pointcloud.scene import Scene, View, evenly

MIN_CONTRAST_RATIO = 1.5
"""Masks end early only where the contrast farther out is more than this many times that at their edges."""
MIN_STANDARD_ERRORS = 3.0
"""And where it is larger by this many standard errors of the mean over the views compared."""
COMPARED_VIEWS = 8
"""Views that are compared, evenly spread: those beyond change no mean."""
MIN_COMPARED_VIEWS = 3
"""Fewer views have no standard error to speak of."""
MAX_PIXELS_OUT = 6
"""Masks are compared with the photographs so far beyond their edges, and as far inside."""
COMPARED_SIZE = 1_024
"""Of longer images one row and column in so many are compared that they are no longer than this."""
NORMAL_BLUR_PX = 1.5
"""The direction across an edge is that of the distance from it, smoothed by so much."""


def with_masks_to_edges(scene: Scene, journal: Journal) -> Scene:
    """The scene with masks that end where photographs change, or as it is if they do already. journal: gets a warning
    that says by how much they were widened."""
    pixels = pixels_short(scene.views)
    if pixels == 0:
        return scene
    journal.notes["masks_widened_px"] = pixels
    of_size = f" of images {COMPARED_SIZE:,} px long" if max(map(_stride, scene.views)) > 1 else ""
    journal.warnings.append(
        f"masks end {pixels} px{of_size} before the photographs change, so they were widened by as much: if you erode "
        "masks, do it less"
    )
    widened = (replace(view, masks=_Widened(view, pixels * _stride(view))) for view in scene.views)
    return replace(scene, views=tuple(widened))


def pixels_short(views: Sequence[View]) -> int:
    """By how many pixels masks end before what they show, 0 if they do not, or too few views tell. In images longer
    than COMPARED_SIZE, by how many of the pixels compared."""
    usable = sorted((view for view in views if view.mask_count and view.image is not None), key=lambda view: view.name)
    compared = evenly(usable, COMPARED_VIEWS)
    found = [contrast for view in compared if (contrast := edge_contrast(view)) is not None]
    if len(found) < MIN_COMPARED_VIEWS:
        return 0
    of_views = np.array(found)
    short = int(of_views.mean(axis=0).argmax()) - MAX_PIXELS_OUT + 1
    if short <= 0:
        return 0
    there, here = of_views[:, short + MAX_PIXELS_OUT - 1], of_views[:, MAX_PIXELS_OUT - 1]
    error = (there - here).std(ddof=1) / np.sqrt(len(found))
    clearly = there.mean() > MIN_CONTRAST_RATIO * here.mean() and (there - here).mean() > MIN_STANDARD_ERRORS * error
    return short if clearly else 0


def edge_contrast(view: View) -> NDArray[np.float64] | None:
    """(2 MAX_PIXELS_OUT,) mean contrast of a view's photograph across edges 1 - MAX_PIXELS_OUT to MAX_PIXELS_OUT pixels
    outside of its masks' edges with pixels of no mask, in levels a pixel. None without such edges, without a photograph
    that can be read, or where some of these distances do not occur."""
    view, _ = with_photograph(view)
    image = view.image_rgb()
    if image is None:
        return None
    cv2, stride = require_cv2(), _stride(view)
    ids = view.mask_map()[::stride, ::stride]
    if min(ids.shape) < 2:
        return None
    inside, outside = ids >= 0, ids == -1
    if not inside.any() or not outside.any():
        return None
    # From pixel to pixel across an edge is 1, so the edge lies half way.
    to_inside, to_outside = (
        cv2.distanceTransform((~pixels).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        for pixels in (inside, outside)
    )
    distance = np.where(inside, 0.5 - to_outside, to_inside - 0.5)
    grey = cv2.cvtColor(np.ascontiguousarray(image[::stride, ::stride]), cv2.COLOR_RGB2GRAY).astype(np.float32)
    down, right = np.gradient(grey)
    across_down, across_right = np.gradient(cv2.GaussianBlur(distance, (0, 0), NORMAL_BLUR_PX))
    across = np.abs(down * across_down + right * across_right)
    along = np.abs(down * across_right - right * across_down)
    contrast = (across - along) / np.maximum(np.hypot(across_down, across_right), 1e-6)
    place = np.floor(distance).astype(np.int64) + MAX_PIXELS_OUT
    near = (inside | outside) & (place >= 0) & (place <= 2 * MAX_PIXELS_OUT)
    count = np.bincount(place[near], minlength=2 * MAX_PIXELS_OUT + 1)
    if not count.all():
        return None
    mean = np.bincount(place[near], contrast[near], len(count)) / count
    return (mean[:-1] + mean[1:]) / 2  # an edge shows in the pixels on both sides of it


def _stride(view: View) -> int:
    """One row and column in so many of a view is compared."""
    return -(-max(view.camera.width, view.camera.height) // COMPARED_SIZE)


@dataclass(frozen=True, eq=False)
class _Widened:
    """Reads a view's masks, each widened into pixels of no mask that are no farther than ``pixels`` from it."""

    view: View
    pixels: int

    def __call__(self) -> NDArray[np.int32]:
        ids, cv2 = self.view.mask_map().astype(np.int32), require_cv2()
        inside = ids >= 0
        if not inside.any():
            return ids
        away, nearest = cv2.distanceTransformWithLabels(
            (~inside).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
        )
        mask_of = np.full(int(nearest.max()) + 1, -1, np.int32)
        mask_of[nearest[inside]] = ids[inside]
        return np.where((ids == -1) & (away <= self.pixels), mask_of[nearest], ids)
