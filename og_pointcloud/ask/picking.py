"""Select an instance by a click (Sec. 4.3): a pixel or a 3D position -> instance, its points, its mask in any camera.

numpy only. Points are drawn as squares; at each pixel the front surface wins, and on it the point nearest to the pixel.
Clicks and masks follow the same rule, so the mask of a picked instance contains the clicked pixel. For a camera much
finer than the cloud, a coarser image is drawn and enlarged: more pixels would show nothing more.

Frames. Everything here is in world coordinates, like ``scene.xyz``; a camera's ``world_to_camera`` maps from them.
Views of a capture map from its local frame: ``in_world(view.camera, capture.points.origin)`` is the camera to pass.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from og_pointcloud.ask.labelled_scene import LabelledScene, SceneLike, as_scene
from og_pointcloud.bundle.nearest import NONE_WITHIN_REACH
from og_pointcloud.cloud import BACKGROUND, TOO_FAR, UNOBSERVED, LabelledCloud
from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.formats.poses import in_local_frame
from og_pointcloud.scene import Camera, numbers_of, rounded_pose
from og_pointcloud.text.words import Labels, TextFeatures

NEAR_PLANE_SPACINGS = 1.0
"""Depth of the near plane, in point spacings: a nearer point would cover half the image."""
HALF_SIDE_SPACINGS = 0.7
"""Half the side of a point's square, in point spacings: few gaps, and outlines hardly dilated."""
MAX_PX_PER_SPACING = 2.0
"""Largest number of pixels drawn per point spacing: two resolve neighboring points."""
MAX_HALF_SIDE_PX = 8
"""Largest number of pixels of a square on each side of its middle: points much nearer than the others leave gaps."""
NO_POINT = NONE_WITHIN_REACH

_NOTHING_PICKED = {
    BACKGROUND: "background: views saw this point, but outside every mask",
    UNOBSERVED: "an unobserved point: no view says what it is",
    TOO_FAR: "no point of the scene",
}


@dataclass(frozen=True, eq=False)
class DrawnPoints:
    """Points to draw without a LabelledCloud. xyz: (n, 3), world = xyz + origin. spacing: typical distance between
    neighbors. reach: thickness of a surface, in the scene's unit."""

    xyz: NDArray[np.float32]
    origin: NDArray[np.float64]
    spacing: float
    reach: float


@dataclass(frozen=True, eq=False)
class Pick:
    """What a click hit.

    instance: id in the scene's table; or BACKGROUND (-1), UNOBSERVED (-2) or TOO_FAR (-3), a miss.
    point: index of the scene point that was hit, None for a miss. xyz_world: (3,) float64, its position, or None.

    >>> hit = og.pick(cloud, (0.09, 0, 1))  # of `LabelledCloud`'s example
    >>> hit.instance, hit.point, hit.words()[0]
    (0, 1, ('chair', 1.0))
    >>> str(og.pick(cloud, (9, 9, 9)))
    'no point of the scene'
    """

    scene: LabelledScene = field(repr=False)
    instance: int
    point: int | None = None
    xyz_world: NDArray[np.float64] | None = None

    @property
    def found(self) -> bool:
        """Whether an instance was hit."""
        return self.instance >= 0

    @property
    def point_indices(self) -> NDArray[np.int64]:
        """Indices of the instance's points in the scene, ascending. OgPointcloudError if no instance was hit."""
        self._require_instance()
        return np.flatnonzero(self.scene.instance_ids == self.instance)

    def mask(self, camera: Camera) -> NDArray[np.bool_]:
        """(H, W) bool: pixels at which the camera sees the instance; occluded parts are left out.

        camera: maps from world coordinates (`in_world`). OgPointcloudError if no instance was hit.
        """
        self._require_instance()
        front = front_points(self.scene.cloud, camera)
        return (front != NO_POINT) & (self.scene.instance_ids[front] == self.instance)

    def words(self, labels: Labels = None, *, text_features: TextFeatures = None) -> list[tuple[str, float]]:
        """Words with their scores on the instance, best first; empty for an instance without a descriptor.

        A score is the probability that the instance is what the word says if the scene has a word bank, else a cosine.
        labels, text_features: as for ``segment``; left out, the scene's own words. OgPointcloudError if no instance was
        hit, or as ``segment``.
        """
        self._require_instance()
        words = self.scene.words(labels, text_features)
        return self.scene.chooser.choose(words.vectors).words(self.instance, words.names)

    def __str__(self) -> str:
        if not self.found:
            return _NOTHING_PICKED[self.instance]
        return f"instance {self.instance} of {len(self.point_indices):,} points"

    def _require_instance(self) -> None:
        if not self.found:
            raise OgPointcloudError(f"the click hit {self}; expected an instance (`found` is true): click elsewhere")


@overload
def pick(scene: SceneLike, where: Camera, uv_px: ArrayLike) -> Pick: ...
@overload
def pick(scene: SceneLike, where: ArrayLike) -> Pick: ...
def pick(scene: SceneLike, where: Camera | ArrayLike, uv_px: ArrayLike | None = None) -> Pick:
    """Select the instance at a pixel of a camera, or at a 3D position.

    scene: a loaded scene, a LabelledCloud or the path of a .ogpc file.
    where: a camera that maps from world coordinates (`in_world`), with uv_px, (2,) pixels (column, row; pixel centers
        at +0.5); or a position, (3,) world coordinates, which selects the nearest point within the scene's reach.

    A miss is also a Pick: its ``instance`` tells which kind, ``str(pick)`` in words. Raises OgPointcloudError for a
    pixel outside the image and for numbers that are not finite. Warns of a camera pose that float32 has rounded.

    >>> camera = og.Camera(64, 48, 40.0, 40.0, 32.0, 24.0, np.eye(4))  # at the world's origin, along z
    >>> hit = og.pick(cloud, camera, (32, 24))  # of `LabelledCloud`'s example
    >>> hit.instance, bool(hit.mask(camera)[24, 32])
    (0, True)
    """
    scene = as_scene(scene)
    if isinstance(where, Camera):
        if coarse := rounded_pose(where.world_to_camera, scene.cloud.spacing):
            warnings.warn(f"another point may be hit; {coarse}", stacklevel=2)
        point = _point_at_pixel(scene.cloud, where, uv_px)
    elif uv_px is not None:
        raise OgPointcloudError(f"uv_px is given with a {type(where).__name__}; expected it only with a Camera")
    else:
        point = _nearest_point(scene, where)
    if point == NO_POINT:
        return Pick(scene, TOO_FAR)
    return Pick(scene, int(scene.instance_ids[point]), point, scene.cloud.xyz[point] + scene.cloud.origin)


def in_world(camera: Camera, origin: ArrayLike) -> Camera:
    """A camera of a scene's local frame, converted to world coordinates. origin: (3,), world = local + origin.

    >>> import numpy as np
    >>> import og_pointcloud as og
    >>> local = og.Camera(64, 48, 40.0, 40.0, 32.0, 24.0, np.eye(4))
    >>> og.in_world(local, np.array([500.0, 0, 20])).center
    array([500.,   0.,  20.])
    """
    place = numbers_of(origin)
    if not isinstance(camera, Camera) or place.shape != (3,) or place.dtype.kind not in "fiu":
        raise OgPointcloudError(
            f"the camera is a {type(camera).__name__}, the origin {origin!r:.80}; expected og.Camera and three numbers"
        )
    return in_local_frame(camera, -place.astype(np.float64))


def front_points(cloud: LabelledCloud | DrawnPoints, camera: Camera) -> NDArray[np.int64]:
    """(H, W) index of the point that each pixel shows, NO_POINT (-1) where there is none.

    camera: maps from world coordinates.

    A point covers the pixels within HALF_SIDE_SPACINGS of its own, at most MAX_HALF_SIDE_PX, along rows and columns. At
    each pixel the front surface starts at the nearest point and is as thick as the scene's reach. On it the point whose
    pixel is nearest wins; ties go to the rightmost, then the lowest pixel, then to the point nearest to the camera.
    """
    squares, drawn = _squares(cloud, camera)
    # Each pixel of the camera shows the drawn pixel that its center falls into.
    front = _front_points(squares, drawn.width, drawn.height, cloud.reach)
    rows = ((np.arange(camera.height) + 0.5) * drawn.height / camera.height).astype(np.intp)
    columns = ((np.arange(camera.width) + 0.5) * drawn.width / camera.width).astype(np.intp)
    return front[rows[:, None], columns]


def _point_at_pixel(cloud: LabelledCloud, camera: Camera, uv_px: ArrayLike | None) -> int:
    """The point that `front_points` shows at the pixel that holds uv_px, or NO_POINT."""
    uv = numbers_of(uv_px)
    if uv.dtype.kind not in "fiu" or uv.shape != (2,) or not ((uv >= 0) & (uv < [camera.width, camera.height])).all():
        raise OgPointcloudError(
            f"uv_px is {uv_px}; expected a pixel of the camera's image: a column from 0 to below {camera.width}, and a "
            f"row from 0 to below {camera.height}"
        )
    return int(front_points(cloud, camera)[int(uv[1]), int(uv[0])])


def _nearest_point(scene: LabelledScene, place: ArrayLike) -> int:
    """Index of the nearest point within the scene's reach, the one that a query point finds, else NO_POINT."""
    world = numbers_of(place)
    if world.dtype.kind not in "fiu" or world.shape != (3,) or not np.isfinite(world).all():
        raise OgPointcloudError(f"the position is {place}; expected three finite world coordinates x, y, z")
    return int(scene.nearest.query(scene._local(world[None]))[0])


@dataclass(frozen=True)
class _Squares:
    """Points as squares of pixels, from far to near; among equally far ones, the lowest index last.

    index: (m,) in the cloud. pixel: (m, 2) column and row of the middle pixel. depth: (m,), in the scene's unit.
    half_px: (m,) pixels covered on each side of the middle one.
    """

    index: NDArray[np.int64]
    pixel: NDArray[np.int64]
    depth: NDArray[np.float64]
    half_px: NDArray[np.int64]


def _squares(cloud: LabelledCloud | DrawnPoints, camera: Camera) -> tuple[_Squares, Camera]:
    """The squares that may touch the image, and the camera that they are drawn in, coarser for a coarse cloud."""
    uv_px, depth = in_world(camera, -cloud.origin).project(cloud.xyz.astype(np.float64))
    in_front = depth > NEAR_PLANE_SPACINGS * cloud.spacing
    spacing_px = np.sqrt(camera.fx * camera.fy) * cloud.spacing / np.where(in_front, depth, np.inf)
    inside = in_front & camera.shows(uv_px)
    # The image is shrunk until the median spacing of the points in it is at most MAX_PX_PER_SPACING pixels.
    shrink = max(1.0, float(np.median(spacing_px[inside])) / MAX_PX_PER_SPACING) if inside.any() else 1.0
    drawn = camera.resized(max(1, round(camera.width / shrink)), max(1, round(camera.height / shrink)))
    size = np.array([drawn.width, drawn.height])
    scale = size / [camera.width, camera.height]
    half = np.minimum(np.rint(HALF_SIDE_SPACINGS * spacing_px * np.sqrt(scale.prod())), MAX_HALF_SIDE_PX)
    uv_px = uv_px * scale
    # A point outside the image counts if its square may reach into it, with a pixel to spare.
    index = np.flatnonzero(in_front & ((uv_px >= -half[:, None] - 1) & (uv_px <= size + half[:, None] + 1)).all(axis=1))
    index = index[np.lexsort((-index, -depth[index]))]
    return _Squares(index, np.floor(uv_px[index]).astype(np.int64), depth[index], half[index].astype(np.int64)), drawn


def _front_points(squares: _Squares, width: int, height: int, reach: float) -> NDArray[np.int64]:
    """(height, width) index of the point that each pixel shows."""
    nearest, shown = np.full(width * height, -1), np.full(width * height, NO_POINT)
    # First pass, start of the front surface: squares are sorted from far to near, so the largest index is the nearest.
    for square, pixel in _covered(squares, width, height):
        ranks = np.full(width * height, -1)
        ranks[pixel] = square  # of several writes the last one stays: the nearest
        np.maximum(nearest, ranks, out=nearest)
    surface_end = np.append(squares.depth, np.inf)[nearest] + reach  # -1, no square, reads infinity
    # Second pass, the point shown: squares come by distance of their middle from the pixel, and the first one stays.
    for square, pixel in _covered(squares, width, height):
        wins = (shown[pixel] == NO_POINT) & (squares.depth[square] <= surface_end[pixel])
        shown[pixel[wins]] = squares.index[square[wins]]
    return shown.reshape(height, width)


def _covered(squares: _Squares, width: int, height: int) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Squares and one pixel (row-major) that each covers: first their middle pixels, then pixels ever farther away."""
    widest = int(squares.half_px.max(initial=-1))
    steps = np.arange(-widest, widest + 1)
    for right, down in sorted(itertools.product(steps, steps), key=lambda step: step[0] ** 2 + step[1] ** 2):
        column, row = (squares.pixel + np.array([right, down])).T
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        square = np.flatnonzero(inside & (squares.half_px >= max(abs(right), abs(down))))
        yield square, row[square] * width + column[square]
