"""Choice of a viewpoint: the view from obliquely above that shows the most labelled points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.formats.poses import rigid, upright_axes
from og_pointcloud.scene import Camera, DoubleArray

FOCAL = 1.7
"""Focal length in half heights of the picture: a vertical view angle of 61 degrees."""
ELEVATIONS_DEG = (30.0, 50.0)
AZIMUTHS = 12
GRID_PX = (96, 60)
"""Width and height of the coarse picture in which each pixel shows its nearest point."""
MAX_SAMPLE_POINTS = 20_000
TRIM_PERCENTILES = (3.0, 97.0)
"""Percentiles of the points that the frame must contain: strays should not make everything small."""
STRAY_SIDES = 10.0
"""Points farther from these percentiles than this many of their longest sides are strays, such as 0 0 0 in a map: a
picture with them shows nothing else."""
EYE_DISTANCE_HALF_DIAGONALS = 1.6
"""Distance of the eye while directions are compared, in half diagonals of the points."""
FILLED_SHARE = 0.9
"""Share of the picture's height or width that the points finally fill."""


@dataclass(frozen=True)
class Viewpoint:
    """eye, target, up: (3,) float64, world coordinates; up is a unit vector."""

    eye: DoubleArray
    target: DoubleArray
    up: DoubleArray

    def axes(self) -> DoubleArray:
        """(3, 3), rows right, up and forward of the picture."""
        back = (self.eye - self.target) / np.linalg.norm(self.eye - self.target)
        right = np.cross(self.up, back)
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(back, right), -back])

    def camera(self, width: int, height: int, focal_px: float) -> Camera:
        """A camera in world coordinates; the middle of its image shows the target."""
        rotation = self.axes() * [[1], [-1], [1]]  # cameras have y down
        pose = rigid(rotation, -rotation @ self.eye)
        return Camera(width, height, focal_px, focal_px, width / 2, height / 2, pose)


def choose_viewpoint(xyz: DoubleArray, labelled: NDArray[np.bool_], up: DoubleArray) -> Viewpoint:
    """The viewpoint for points xyz (n, 3), n >= 1, finite. labelled: (n,), points that should be visible; all if none
    is set. up: (3,) unit vector."""
    sample = np.linspace(0, len(xyz) - 1, min(len(xyz), MAX_SAMPLE_POINTS)).astype(np.int64)
    points, wanted = xyz[sample], labelled[sample] if labelled.any() else np.ones(len(sample), bool)
    low, high = np.percentile(points, TRIM_PERCENTILES, axis=0)
    target = low + (high - low) / 2
    distance = EYE_DISTANCE_HALF_DIAGONALS * max(float(np.linalg.norm(high - low)) / 2, 1e-9)
    # Candidates all around at two elevations; side is any direction perpendicular to up.
    side, across, _ = upright_axes(up)
    directions = [
        np.cos(tilt) * (np.cos(turn) * side + np.sin(turn) * across) + np.sin(tilt) * up
        for tilt in np.deg2rad(ELEVATIONS_DEG)
        for turn in np.arange(AZIMUTHS) * 2 * np.pi / AZIMUTHS
    ]
    views = [Viewpoint(target + distance * direction, target, up) for direction in directions]
    best = max(views, key=lambda view: _visible_cells(points, wanted, view))
    inside = ((points >= low) & (points <= high)).all(axis=1)
    # Each of a few points may be the outermost along some axis: then all count.
    return _framed(points[inside] if inside.any() else points, best)


def are_no_strays(xyz: DoubleArray) -> NDArray[np.bool_]:
    """(n,) bool, which finite points (n, 3), n >= 1, are not far from all others; all if most are at one place."""
    low, high = np.percentile(xyz, TRIM_PERCENTILES, axis=0)
    margin = STRAY_SIDES * float((high - low).max()) or np.inf
    return ((xyz >= low - margin) & (xyz <= high + margin)).all(axis=1)


def _framed(points: DoubleArray, view: Viewpoint) -> Viewpoint:
    """The same direction and target from as near as possible with all points still in the picture."""
    axes, distance = view.axes(), float(np.linalg.norm(view.eye - view.target))
    x, y, behind = axes @ (points - view.target).T
    offset = np.maximum(np.abs(x) * GRID_PX[1] / GRID_PX[0], np.abs(y))
    nearest = float((FOCAL / FILLED_SHARE * offset - behind).max())  # FOCAL offset/(distance + behind) <= FILLED_SHARE
    return Viewpoint(view.target - max(nearest, 0.1 * distance) * axes[2], view.target, view.up)


def _visible_cells(points: DoubleArray, wanted: NDArray[np.bool_], view: Viewpoint) -> int:
    """Number of pixels of a coarse picture whose nearest point is a wanted one."""
    camera = view.camera(*GRID_PX, FOCAL * GRID_PX[1] / 2)
    uv_px, depth = camera.project(points)
    in_image = np.flatnonzero(camera.shows(uv_px))
    in_image = in_image[np.argsort(depth[in_image], kind="stable")]  # the nearest first
    column, row = uv_px[in_image].astype(np.int64).T
    return int(wanted[in_image][np.unique(row * GRID_PX[0] + column, return_index=True)[1]].sum())
