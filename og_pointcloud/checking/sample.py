"""What the checks use: a sample of views and points, the points that a camera sees, and how comparisons are scored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.formats.faces import CUBE
from og_pointcloud.formats.poses import in_local_frame
from og_pointcloud.formats.repairs import KINDS, Repair, repaired_cameras
from og_pointcloud.scene import Camera, Scene, View, evenly

SAMPLE_VIEWS = 12
SAMPLE_POINTS = 20_000
CELLS_PER_SIDE = 48
"""Cells along an image's longer side, each holding a few points; its nearest point hides those behind it."""
MAX_DEPTH_RATIO = 1.1
"""Points at most this many times as deep as the nearest one of their cell are seen."""


@dataclass(frozen=True)
class Comparison:
    """How what should fit compares with rivals that should not.

    share: of the comparisons that it wins; ties count half. own, other: mean of its values and of the rivals'. gap: own
    - other, or that as a share of 1 - other. compared: number of comparisons. unit: the quantity compared, in a word.
    error: standard error of the gap, 0 where no groups were given.
    """

    share: float
    own: float
    other: float
    gap: float
    compared: int
    unit: str
    error: float = 0.0

    @classmethod
    def of(
        cls, pairs: Sequence[tuple[float, float]], unit: str, *, of_rest: bool = False, groups: Sequence[int] = ()
    ) -> Comparison:
        """pairs: (own value, rival's value). of_rest: the gap is a share of 1 - other, what the rivals leave. groups: a
        number per pair, equal for pairs that are not independent; the gap's error is computed from them."""
        if not pairs:
            return cls(0.0, 0.0, 0.0, 0.0, 0, unit)
        own, other = np.array(pairs).T
        won = (own > other + 1e-6) + 0.5 * (np.abs(own - other) <= 1e-6)
        gap = float(own.mean() - other.mean()) / (max(1 - float(other.mean()), 1e-6) if of_rest else 1)
        error = _clustered_error(own - other, groups) if len(groups) else 0.0
        return cls(float(won.mean()), float(own.mean()), float(other.mean()), gap, len(pairs), unit, error)

    def reaches(self, bounds: tuple[float, float]) -> bool:
        """Whether both share and gap are at least these bounds."""
        return self.share >= bounds[0] and self.gap >= bounds[1]

    def __str__(self) -> str:
        return f"{self.share:.0%} of {self.compared} comparisons, {self.unit} {self.own:.2f} against {self.other:.2f}"


def _clustered_error(values: NDArray[np.float64], groups: Sequence[int]) -> float:
    """Standard error of the mean of values (n,) that are dependent within a group (Liang and Zeger 1986:
    residuals are summed in each group, then squared); infinite for a single group."""
    _, group = np.unique(groups, return_inverse=True)
    sums = np.bincount(group, weights=values - values.mean())
    count = len(sums)
    return float(np.sqrt((sums**2).sum() * count / (count - 1))) / len(values) if count > 1 else float("inf")


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
        """The cameras of the views, as the files state them."""
        return [view.camera for view in self.views]

    def repaired(self, repairs: Sequence[Repair]) -> list[Camera]:
        """The cameras of the views with the repairs applied; a senseless matrix or length raises SceneError."""
        # Some repairs depend on all cameras of the scene, as a change of neighboring frames or about their mean does.
        of_all = any(KINDS[repair.name].of_all for repair in repairs)
        needed = range(len(self.listed)) if of_all else self.places
        world = [in_local_frame(self.listed[place], -self.origin) for place in needed]
        repaired = [in_local_frame(camera, self.origin) for camera in repaired_cameras(world, repairs)]
        return [repaired[place] for place in self.places] if of_all else repaired

    def thinned(self, points: int) -> Sample:
        """The sample evenly thinned, to at most about this many points."""
        step = 1 + (len(self.xyz) - 1) // points
        return replace(self, xyz=self.xyz[::step], rgb=None if self.rgb is None else self.rgb[::step])

    def of_views(self, rows: Sequence[int]) -> Sample:
        """The sample with only these of its views."""
        return replace(
            self, views=tuple(self.views[row] for row in rows), places=tuple(self.places[row] for row in rows)
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
    # Faces of one image share few points, and most show few things: with enough images only the fronts are used.
    names = [view.name for view in scene.views]
    images = [name.removesuffix("front") for name in names if name.endswith("/front")]
    beside = {image + face for image in images for face in CUBE if face != "front"}
    ahead = [row for row, name in enumerate(names) if name not in beside]
    order = sorted(ahead if len(ahead) >= SAMPLE_VIEWS else range(len(names)), key=names.__getitem__)
    places = tuple(evenly(order, SAMPLE_VIEWS))
    cameras = tuple(view.camera for view in scene.views)
    views, points = tuple(scene.views[place] for place in places), scene.points
    step = 1 + (len(points) - 1) // SAMPLE_POINTS
    rgb = None if points.rgb is None else points.rgb[::step].astype(np.float32)
    return Sample(points.xyz[::step].astype(np.float64), rgb, views, places, cameras, points.origin)


def grid_shape(camera: Camera, cells: int = CELLS_PER_SIDE) -> tuple[int, int]:
    """Rows and columns of a grid over the image with ``cells`` cells along the longer side."""
    longest = max(camera.width, camera.height)
    return max(1, round(cells * camera.height / longest)), max(1, round(cells * camera.width / longest))


def seen(xyz: NDArray[np.float64], camera: Camera, cells: int = CELLS_PER_SIDE) -> Seen:
    """The points (n, 3) that are in the image and not far behind the nearest point of their cell."""
    rows, columns = grid_shape(camera, cells)
    uv_px, depth = camera.project(xyz)
    inside = np.flatnonzero(camera.shows(uv_px))
    places = uv_px[inside] / (camera.width, camera.height)
    column, row = (np.minimum(places, 1 - 1e-9) * (columns, rows)).astype(np.intp).T
    cell = row * columns + column
    # A coarse z-buffer: a hidden point would be compared with what hides it.
    nearest = np.full(columns * rows, np.inf)
    np.minimum.at(nearest, cell, depth[inside])
    front = depth[inside] <= MAX_DEPTH_RATIO * nearest[cell]
    return Seen(inside[front], places[front], cell[front], (rows, columns))
