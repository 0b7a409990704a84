"""Sees the room: ray casting with Open3D, shading, and the distance from any point to the true surfaces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import zoom

from og_pointcloud.errors import MissingExtraError
from og_pointcloud_room.room import Room

try:
    import open3d as o3d
except ImportError as error:
    raise MissingExtraError("open3d", "demo") from error

__all__ = ["Frame", "Intrinsics", "RayCaster"]

BACKGROUND = -1
NOISE_SIDE, NOISE_STEPS = 128, 8
"""Cells along a side of the noise table, and cells to a grain of a material."""
FILL_LIGHTS = (((0.3, -0.5, 0.8), 0.25), ((-0.8, 0.5, 0.33), 0.14), ((0.6, 0.8, 0.0), 0.08), ((0.1, 0.2, -0.97), 0.08))
"""Directions towards and strengths of the lights that cast no shadow: window, bounce from the wall, from the floor."""


@dataclass(frozen=True)
class Intrinsics:
    """Pinhole camera: width, height, focal length in pixels; the principal point is the image's middle."""

    width: int
    height: int
    focal_px: float

    def directions(self) -> NDArray[np.float32]:
        """(H, W, 3) ray directions in the camera's frame (OpenCV), z = 1, through pixel centres."""
        x = (np.arange(self.width) + 0.5 - self.width / 2) / self.focal_px
        y = (np.arange(self.height) + 0.5 - self.height / 2) / self.focal_px
        return np.stack([*np.meshgrid(x, y), np.ones((self.height, self.width))], axis=2).astype(np.float32)


@dataclass(frozen=True)
class Frame:
    """One view of the room. camera_to_world: (4, 4) OpenCV axes.

    depth_m: (H, W) float32 along the optical axis. owner: (H, W) int32 object id, -1 for walls, floor and ceiling.
    image: (H, W, 3) uint8 RGB.
    """

    camera_to_world: NDArray[np.float64]
    depth_m: NDArray[np.float32]
    owner: NDArray[np.int32]
    image: NDArray[np.uint8]


class RayCaster:
    """The room's surfaces, ready to be looked at."""

    def __init__(self, room: Room, rng: np.random.Generator) -> None:
        self._room = room
        self._light = np.array([0.15 * room.size[0], -0.1 * room.size[1], 0.92 * room.size[2]], np.float32)
        self._noise_table = _value_noise(rng)
        self._scene = o3d.t.geometry.RaycastingScene()
        owners, colours, seconds, grains = [], [], [], []
        items = [*room.objects, *room.shell]
        for index, item in enumerate(items):
            for part in item.parts:
                self._scene.add_triangles(_tensor(part.vertices), _tensor(part.triangles, np.uint32))
                owners.append(index if index < len(room.objects) else BACKGROUND)
                colours.append(part.material.colour)
                seconds.append(part.material.second)
                grains.append(part.material.grain)
        self._part_owner = np.array(owners, np.int32)
        self._part_colours = np.array([colours, seconds], np.float32)
        self._part_grain = np.array(grains, np.float32)

    def look(self, intrinsics: Intrinsics, camera_to_world: NDArray[np.float64]) -> Frame:
        """Depth, object ids and a shaded picture from one pose (OpenCV camera-to-world)."""
        shape = (intrinsics.height, intrinsics.width)
        pose = camera_to_world.astype(np.float32)
        rays = np.empty((shape[0] * shape[1], 6), np.float32)
        rays[:, :3] = pose[:3, 3]
        rays[:, 3:] = intrinsics.directions().reshape(-1, 3) @ pose[:3, :3].T
        hit = self._scene.cast_rays(_tensor(rays))
        depth_m, part = hit["t_hit"].numpy(), hit["geometry_ids"].numpy()
        if not np.isfinite(depth_m).all():
            raise ValueError(f"{int((~np.isfinite(depth_m)).sum())} rays leave the room; expected a camera inside it")
        xyz = rays[:, :3] + rays[:, 3:] * depth_m[:, None]
        normals = hit["primitive_normals"].numpy()
        normals *= -np.sign(np.einsum("nd,nd->n", normals, rays[:, 3:]))[:, None]
        shaded = self._albedo(xyz, part) * self._light_at(xyz, normals)[:, None]
        image = (255 * np.sqrt(np.minimum(shaded, 1))).astype(np.uint8)
        owner = self._part_owner[part]
        return Frame(camera_to_world, depth_m.reshape(shape), owner.reshape(shape), image.reshape(*shape, 3))

    def nearest_owner(self, xyz: NDArray[np.float32]) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """Object id (-1 for the shell) of the surface nearest to each point (n, 3), and its distance in metres."""
        found = self._scene.compute_closest_points(_tensor(xyz))
        distance_m = np.linalg.norm(found["points"].numpy() - xyz, axis=1)
        return self._part_owner[found["geometry_ids"].numpy()], distance_m.astype(np.float32)

    def clearance_m(self, xyz: NDArray[np.float64]) -> float:
        """Distance from one point (3,) to the nearest surface."""
        return float(self._scene.compute_distance(_tensor(xyz[None])).numpy()[0])

    def _albedo(self, xyz: NDArray[np.float32], part: NDArray[np.uint32]) -> NDArray[np.float32]:
        """Two colours of each part's material, mixed by two octaves of value noise of its grain. (n, 3)."""
        cell = np.floor(xyz * (NOISE_STEPS / self._part_grain[part])).astype(np.int32) % NOISE_SIDE
        noise = self._noise_table[cell[:, 0], cell[:, 1], cell[:, 2]]
        share = np.clip(0.5 + noise, 0, 1)[:, None]
        first, second = self._part_colours
        return first[part] + (second - first)[part] * share

    def _light_at(self, xyz: NDArray[np.float32], normals: NDArray[np.float32]) -> NDArray[np.float32]:
        """Lambert: a ceiling light that casts shadows, fill lights and a little ambient light. (n,)."""
        start = xyz + 2e-3 * normals
        towards = self._light - start
        rays = _tensor(np.concatenate([start, towards], axis=1))
        lit = ~self._scene.test_occlusions(rays, tnear=0.0, tfar=1.0).numpy()
        distance = np.sqrt(np.einsum("nd,nd->n", towards, towards))
        facing = np.maximum(np.einsum("nd,nd->n", normals, towards), 0) / distance
        light = 0.12 + lit * facing / (0.75 + 0.2 * distance**2)
        for direction, strength in FILL_LIGHTS:
            light += strength * np.maximum(normals @ np.array(direction, np.float32), 0)
        return light


def _value_noise(rng: np.random.Generator) -> NDArray[np.float32]:
    """(128, 128, 128) periodic noise of two octaves; one grain is NOISE_STEPS cells."""
    octaves = []
    for steps, strength in ((NOISE_STEPS, 0.75), (NOISE_STEPS // 2, 0.35)):
        lattice = rng.uniform(-strength, strength, (NOISE_SIDE // steps,) * 3).astype(np.float32)
        octaves.append(zoom(lattice, steps, order=1, mode="grid-wrap", grid_mode=True))
    return octaves[0] + octaves[1]


def _tensor(values: NDArray[Any], dtype: Any = np.float32) -> Any:
    """An Open3D tensor; typed loosely, as Open3D's own stubs know no arrays."""
    make_tensor: Any = o3d.core.Tensor
    return make_tensor(np.ascontiguousarray(values, dtype))
