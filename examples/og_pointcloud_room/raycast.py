"""Views of the room: ray casting with Open3D, shading, and the distance from any point to the true surfaces.

The rounding of Embree, inside Open3D, depends on the processor. So it only tells which triangle a ray meets; where on
it is computed here in float64, without matrix products, whose order of summation depends on the processor too. That
makes depth, color and everything derived the same on every machine, except for single pixels on an object's outline.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import zoom

from og_pointcloud.errors import MissingExtraError
from og_pointcloud.scene import Camera
from og_pointcloud_room.furniture import Item
from og_pointcloud_room.room import Room
from og_pointcloud_room.shapes import rotated

try:
    import open3d as o3d
except ImportError as error:
    raise MissingExtraError("open3d", "demo") from error

Points = NDArray[np.float64]
BACKGROUND = -1
NOISE_SIDE, NOISE_STEPS = 128, 8
"""Cells along a side of the noise table, and cells per grain of a material."""
FILL_LIGHTS = (((0.3, -0.5, 0.8), 0.25), ((-0.8, 0.5, 0.33), 0.14), ((0.6, 0.8, 0.0), 0.08), ((0.1, 0.2, -0.97), 0.08))
"""Direction towards, and strength of, the lights without shadows: window, bounce from the wall, from the floor."""


class Hits(NamedTuple):
    """What n rays hit. part: (n,) int64 among all parts of all items, -1 for nothing; distance: (n,) float64 in
    lengths of the ray's direction, NaN for nothing; normal: (n, 3) float64 unit, against the ray."""

    part: NDArray[np.int64]
    distance: Points
    normal: Points


class Surfaces:
    """The triangles of some items. part_item: (parts,) int64, the item that each part belongs to."""

    def __init__(self, items: Iterable[Item]) -> None:
        self._scene = o3d.t.geometry.RaycastingScene()
        owners, corners = [], []
        # Open3D numbers geometries in the order they are added, and triangles within each from 0.
        for index, item in enumerate(items):
            for part in item.parts:
                self._scene.add_triangles(tensor(part.vertices), tensor(part.triangles, np.uint32))
                owners.append(index)
                corners.append(part.vertices[part.triangles])
        self.part_item = np.array(owners)
        self._first_triangle = np.cumsum([0, *map(len, corners)])
        # Each triangle's plane, normal . x = offset, from which the point where a ray meets it is computed.
        first, second, third = np.concatenate(corners).transpose(1, 0, 2)
        across = np.cross(second - first, third - first)
        self._normal = across / np.maximum(np.sqrt(_dot(across, across)), 1e-12)[:, None]
        self._offset = _dot(self._normal, first)

    def cast(self, origin: ArrayLike, directions: Points) -> Hits:
        """The nearest surface along rays from ``origin`` (3,) in ``directions`` (n, 3)."""
        rays = np.concatenate([np.broadcast_to(origin, directions.shape), directions], axis=1)
        found = self._scene.cast_rays(tensor(rays))
        part = found["geometry_ids"].numpy().astype(np.int64)
        missed = part >= len(self.part_item)  # Open3D's largest id means "none"
        part[missed] = -1
        triangle = self._first_triangle[part] + np.where(missed, 0, found["primitive_ids"].numpy())
        triangle[missed] = 0
        normal, offset = self._normal[triangle], self._offset[triangle]
        steepness = _dot(normal, directions)
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (offset - _dot(normal, np.asarray(origin))) / steepness
        distance[missed] = np.nan
        return Hits(part, distance, normal * -np.sign(steepness)[:, None])  # triangles may be wound either way

    def is_blocked(self, starts: Points, steps: Points) -> NDArray[np.bool_]:
        """(n,) whether a surface lies between ``starts`` and ``starts + steps``, both (n, 3)."""
        rays = tensor(np.concatenate([starts, steps], axis=1))
        return self._scene.test_occlusions(rays, tnear=0.0, tfar=1.0).numpy()

    def distance_m(self, xyz: Points | NDArray[np.float32]) -> NDArray[np.float32]:
        """(n,) meters from points (n, 3) to the nearest surface."""
        return self._scene.compute_distance(tensor(xyz)).numpy()


@dataclass(frozen=True)
class Intrinsics:
    """Pinhole camera: width, height, focal length in pixels; the principal point is the image's middle."""

    width: int
    height: int
    focal_px: float

    def directions(self) -> Points:
        """(H, W, 3) ray directions in the camera's frame (OpenCV), z = 1, through pixel centers."""
        x = (np.arange(self.width) + 0.5 - self.width / 2) / self.focal_px
        y = (np.arange(self.height) + 0.5 - self.height / 2) / self.focal_px
        return np.stack([*np.meshgrid(x, y), np.ones((self.height, self.width))], axis=2).astype(np.float64)

    def camera(self, camera_to_world: Points) -> Camera:
        """This camera at a pose (4, 4), OpenCV axes."""
        pose, focal = np.linalg.inv(camera_to_world).astype(np.float64), self.focal_px
        return Camera(self.width, self.height, focal, focal, self.width / 2, self.height / 2, pose)


@dataclass(frozen=True)
class Frame:
    """One view of the room. camera_to_world: (4, 4) OpenCV axes.

    depth_m: (H, W) float32 along the optical axis. owner: (H, W) int32 object id, -1 for walls, floor and ceiling.
    image: (H, W, 3) uint8 RGB.
    """

    camera_to_world: Points
    depth_m: NDArray[np.float32]
    owner: NDArray[np.int32]
    image: NDArray[np.uint8]


class RayCaster:
    """The room under a ceiling light. surfaces: of its objects, then of its shell."""

    def __init__(self, room: Room, rng: np.random.Generator) -> None:
        items = [*room.objects, *room.shell]
        self.surfaces = Surfaces(items)
        self._light = np.array([0.15 * room.size[0], -0.1 * room.size[1], 0.92 * room.size[2]])
        self._noise_table = _value_noise(rng)
        item = self.surfaces.part_item
        self._part_owner = np.where(item < len(room.objects), item, BACKGROUND).astype(np.int32)
        materials = [part.material for item in items for part in item.parts]
        self._first, self._second, self._grain = (
            np.array([getattr(material, name) for material in materials]) for name in ("color", "second", "grain")
        )

    def look(self, intrinsics: Intrinsics, camera_to_world: Points) -> Frame:
        """Depth, object ids and a shaded picture from one pose (OpenCV camera-to-world).

        ValueError where a ray leaves the room.
        """
        shape, eye = (intrinsics.height, intrinsics.width), camera_to_world[:3, 3]
        directions = rotated(intrinsics.directions().reshape(-1, 3), camera_to_world[:3, :3])
        hits = self.surfaces.cast(eye, directions)
        if (hits.part < 0).any():
            raise ValueError(f"{int((hits.part < 0).sum())} rays leave the room; expected a camera inside it")
        xyz = eye + directions * hits.distance[:, None]
        shaded = self._albedo(xyz, hits.part) * self._light_at(xyz, hits.normal)[:, None]
        image = (255 * np.sqrt(np.minimum(shaded, 1))).astype(np.uint8)  # the square root approximates sRGB's curve
        depth_m = hits.distance.astype(np.float32).reshape(shape)
        return Frame(camera_to_world, depth_m, self._part_owner[hits.part].reshape(shape), image.reshape(*shape, 3))

    def _albedo(self, xyz: Points, part: NDArray[np.int64]) -> Points:
        """(n, 3) the two colors of each part's material, mixed by two octaves of value noise of its grain."""
        cell = np.floor(xyz * (NOISE_STEPS / self._grain[part])).astype(np.int64) % NOISE_SIDE
        noise = self._noise_table[cell[:, 0], cell[:, 1], cell[:, 2]].astype(np.float64)
        share = np.clip(0.5 + noise, 0, 1)[:, None]
        return self._first[part] + (self._second - self._first)[part] * share

    def _light_at(self, xyz: Points, normals: Points) -> Points:
        """(n,) Lambertian: a ceiling light that casts shadows, fill lights and a little ambient light."""
        start = xyz + 2e-3 * normals  # off the surface, which would otherwise shadow itself
        towards = self._light - start
        distance = np.sqrt(_dot(towards, towards))
        facing = np.maximum(_dot(normals, towards), 0) / distance
        light = 0.12 + ~self.surfaces.is_blocked(start, towards) * facing / (0.75 + 0.2 * distance**2)
        for direction, strength in FILL_LIGHTS:
            light += strength * np.maximum(_dot(normals, np.array(direction)), 0)
        return light


def _value_noise(rng: np.random.Generator) -> NDArray[np.float32]:
    """(128, 128, 128) periodic noise of two octaves; one grain is NOISE_STEPS cells."""
    octaves = []
    for steps, strength in ((NOISE_STEPS, 0.75), (NOISE_STEPS // 2, 0.35)):
        lattice = rng.uniform(-strength, strength, (NOISE_SIDE // steps,) * 3).astype(np.float32)
        octaves.append(zoom(lattice, steps, order=1, mode="grid-wrap", grid_mode=True))
    return octaves[0] + octaves[1]


def _dot(first: Points, second: Points) -> Points:
    """(n,) products of rows (n, 3), summed in one order everywhere."""
    return first[..., 0] * second[..., 0] + first[..., 1] * second[..., 1] + first[..., 2] * second[..., 2]


def tensor(values: NDArray[Any], dtype: Any = np.float32) -> Any:
    """An Open3D tensor; typed loosely, as Open3D's own stubs do not accept arrays."""
    make_tensor: Any = o3d.core.Tensor
    return make_tensor(np.ascontiguousarray(values, dtype))
