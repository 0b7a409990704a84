"""What the checks look at: some views and points of a scene, and which points a camera sees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.formats.poses import in_local_frame
from og_pointcloud.formats.repairs import Repair, repaired_cameras
from og_pointcloud.scene import Camera, Scene, View

__all__ = ["CELLS", "Sample", "Seen", "draw_sample", "seen"]

VIEWS = 12
POINTS = 20_000
CELLS = 48
"""Cells along an image's longer side: of each, what is nearest is seen. A few points must fall into one."""
BEHIND = 1.1
"""Points up to so many times as deep as the nearest one of their cell are seen."""


@dataclass(frozen=True)
class Sample:
    """xyz: (n, 3) float64, local frame; rgb: (n, 3) float32 or None. views: some, evenly spread by name. places: their
    rows in `listed`, all cameras of the scene, from the local frame. origin: (3,) world = local + origin."""

    xyz: NDArray[np.float64]
    rgb: NDArray[np.float32] | None
    views: tuple[View, ...]
    places: tuple[int, ...]
    listed: tuple[Camera, ...]
    origin: NDArray[np.float64]

    @property
    def cameras(self) -> list[Camera]:
        """The cameras of the views, as the files say."""
        return [view.camera for view in self.views]

    def repaired(self, repairs: Sequence[Repair]) -> list[Camera]:
        """The cameras of the views as the repairs mean them; a matrix or lengths without sense raise SceneError."""
        # All poses are needed where each takes its neighbour's, or is moved about the mean of all.
        everyone = any(repair.name in ("frames", "aligned") for repair in repairs)
        asked = range(len(self.listed)) if everyone else self.places
        world = [in_local_frame(self.listed[place], -self.origin) for place in asked]
        repaired = [in_local_frame(camera, self.origin) for camera in repaired_cameras(world, repairs)]
        return [repaired[place] for place in self.places] if everyone else repaired

    def fewer(self, views: int, points: int) -> Sample:
        """Some of it, for what is asked often."""
        rows = _spread(len(self.views), views)
        step = 1 + (len(self.xyz) - 1) // points
        return replace(
            self,
            xyz=self.xyz[::step],
            rgb=None if self.rgb is None else self.rgb[::step],
            views=tuple(self.views[row] for row in rows),
            places=tuple(self.places[row] for row in rows),
        )


@dataclass(frozen=True)
class Seen:
    """What a camera sees. rows: of the points, ascending. places: (k, 2) float64, right and down, as shares of the
    image. cells: (k,) of a grid whose rows and columns ``shape`` has."""

    rows: NDArray[np.intp]
    places: NDArray[np.float64]
    cells: NDArray[np.intp]
    shape: tuple[int, int]


def draw_sample(scene: Scene) -> Sample:
    """Some views and points of a scene. Nothing is read."""
    order = sorted(range(len(scene.views)), key=lambda index: scene.views[index].name)
    places = tuple(order[row] for row in _spread(len(order), VIEWS))
    step = 1 + (len(scene.points) - 1) // POINTS
    rgb = scene.points.rgb
    return Sample(
        scene.points.xyz[::step].astype(np.float64),
        None if rgb is None else rgb[::step].astype(np.float32),
        tuple(scene.views[place] for place in places),
        places,
        tuple(view.camera for view in scene.views),
        scene.points.origin,
    )


def seen(xyz: NDArray[np.float64], camera: Camera, cells: int = CELLS) -> Seen:
    """The points (n, 3) that are in the image and not far behind the nearest one of their cell."""
    columns, rows = (max(1, round(cells * side / max(camera.width, camera.height))) for side in _size(camera))
    uv_px, depth = camera.project(xyz)
    inside = np.flatnonzero(camera.shows(uv_px))
    places = uv_px[inside] / _size(camera)
    column, row = (np.minimum(places, 1 - 1e-9) * (columns, rows)).astype(np.intp).T
    cell = row * columns + column
    nearest = np.full(columns * rows, np.inf)
    np.minimum.at(nearest, cell, depth[inside])
    front = depth[inside] <= BEHIND * nearest[cell]
    return Seen(inside[front], places[front], cell[front], (rows, columns))


def _size(camera: Camera) -> tuple[int, int]:
    return camera.width, camera.height


def _spread(count: int, most: int) -> list[int]:
    return np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(int)).tolist()
