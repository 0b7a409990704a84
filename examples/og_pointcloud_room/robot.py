"""A robot drives through the room after it was mapped: LiDAR frames with noise, and the truth of every ray.

Since mapping, things have changed: a chair stands elsewhere and two objects are new.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from og_pointcloud_room.furniture import CLASS_NAMES, Item, ball
from og_pointcloud_room.raycast import Surfaces
from og_pointcloud_room.room import Room, furnish
from og_pointcloud_room.shapes import Material, box, rotated, rotation_about

Points = NDArray[np.float64]
BACKGROUND, NEW, MOVED, NO_RETURN = -1, -2, -3, -4
"""What a ray hits, other than an object that stands as mapped (a row of CLASS_NAMES)."""
SENSOR_HEIGHT_M, SPEED_M_S = 0.9, 0.4
FLOOR_STEP_M, RING_STEPS = 0.06, 90
CLEAR_OF_FURNITURE_M, CLEAR_OF_PATH_M, APART_M = 0.35, 0.6, 0.8
"""Distances that the middle of a thing brought in keeps, where there is room."""


@dataclass(frozen=True)
class Lidar:
    """A spinning sensor. beams: between elevations ``lowest`` and ``highest``, degrees. columns: per turn. hertz: turns
    per second.

    noise_m: standard deviation of ranges; dropouts: share of rays without a return; both of a common indoor LiDAR.
    pose_noise_m, pose_noise_rad: standard deviation of the localisation error of each pose, per axis.
    """

    beams: int = 32
    columns: int = 720
    lowest: float = -40.0
    highest: float = 40.0
    hertz: float = 10.0
    noise_m: float = 0.01
    dropouts: float = 0.02
    pose_noise_m: float = 0.01
    pose_noise_rad: float = 0.003

    def directions(self) -> Points:
        """(beams * columns, 3) unit vectors: x forward, z up."""
        elevation = np.radians(np.linspace(self.lowest, self.highest, self.beams))[:, None]
        azimuth = np.linspace(-np.pi, np.pi, self.columns, endpoint=False)
        x, y, z = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
        return np.stack([x, y, np.broadcast_to(z, x.shape)], axis=2).reshape(-1, 3)


@dataclass(frozen=True)
class LidarFrame:
    """xyz: (N, 3) float32 in the sensor's frame, one row per ray, NaN without a return. truth: (N,) int32.

    stamp: nanoseconds. sensor_to_map: (4, 4), the estimated pose. position: (3,), the true position.
    """

    stamp: int
    xyz: NDArray[np.float32]
    sensor_to_map: Points
    position: Points
    truth: NDArray[np.int32]


@dataclass(frozen=True)
class ChangedRoom:
    """items: what stands there now. truth: (items,) int32, the correct answer for a ray that hits each."""

    items: tuple[Item, ...]
    truth: NDArray[np.int32]


class Drive:
    """One lap around the middle of the room of a seed. Iterating gives its frames, the same ones for the same seed."""

    def __init__(self, seed: int = 0, lidar: Lidar | None = None, frames: int | None = None) -> None:
        self.lidar, self._seed, self.room = lidar or Lidar(), seed, furnish(seed)
        self.path = ring(self.room)
        lap_s = np.linalg.norm(np.diff(self.path, axis=0, append=self.path[:1]), axis=1).sum() / SPEED_M_S
        self.frame_count = frames or int(lap_s * self.lidar.hertz)
        self.now = _changed(self.room, self.path)
        self._surfaces = Surfaces(self.now.items)

    def __len__(self) -> int:
        return self.frame_count

    def __iter__(self) -> Iterator[LidarFrame]:
        rng = np.random.default_rng([self._seed, 10])
        rays, lidar = self.lidar.directions(), self.lidar
        for index in range(self.frame_count):
            pose = self._pose(index)
            ranges, truth = self._cast(pose, rays)
            noisy = ranges + lidar.noise_m * rng.normal(size=len(ranges))
            noisy[rng.uniform(size=len(ranges)) < lidar.dropouts] = np.nan
            truth = np.where(np.isfinite(noisy), truth, NO_RETURN).astype(np.int32)
            # Points are in the sensor's frame, so a localisation error moves all of them together.
            believed = pose.copy()
            believed[:3, :3] = rotation_about("z", lidar.pose_noise_rad * rng.normal()) @ pose[:3, :3]
            believed[:3, 3] += lidar.pose_noise_m * rng.normal(size=3)
            xyz = (rays * noisy[:, None]).astype(np.float32)
            yield LidarFrame(round((index + 1) * 1e9 / lidar.hertz), xyz, believed, pose[:3, 3], truth)

    def _pose(self, index: int) -> Points:
        place = index / self.frame_count * len(self.path)
        here, ahead = (_on_ring(self.path, place + step) for step in (0.0, 1.0))
        pose = np.eye(4)
        pose[:3, :3] = rotation_about("z", float(np.arctan2(*(ahead - here)[::-1])))
        pose[:3, 3] = (*here, SENSOR_HEIGHT_M)
        return pose

    def _cast(self, pose: Points, rays: Points) -> tuple[Points, NDArray[np.int32]]:
        """Range of each ray in meters, NaN without a hit, and what it hits."""
        hits = self._surfaces.cast(pose[:3, 3], rotated(rays, pose[:3, :3]))
        truth = self.now.truth[self._surfaces.part_item[hits.part]]
        return hits.distance, np.where(hits.part < 0, NO_RETURN, truth)


def _changed(room: Room, path: Points) -> ChangedRoom:
    """The room today: one chair moved, a suitcase and a ball brought in, where the floor is free."""
    chair = next(index for index, item in enumerate(room.objects) if item.name == "chair")
    others = tuple(item for index, item in enumerate(room.objects) if index != chair)
    grey = Material((0.4, 0.4, 0.45), (0.3, 0.3, 0.35), (0.1, 0.1, 0.1))
    arrivals = [
        (Item("suitcase", (box((0.4, 0.25, 0.6), (0, 0, 0), grey),)), NEW),
        (ball(0.2, 12, grey), NEW),
        (centered(room.objects[chair]), MOVED),
    ]
    items, taken = [*others, *room.shell], np.full((1, 2), np.inf)
    truth = [CLASS_NAMES.index(item.name) for item in others] + [BACKGROUND] * len(room.shell)
    surfaces = Surfaces([*room.objects, *room.shell])
    for item, what in arrivals:
        place = free_floor(room, surfaces, path, taken)
        taken = np.concatenate([taken, place[None]])
        items.append(item.moved((*place, 0.0)))
        truth.append(what)
    return ChangedRoom(tuple(items), np.array(truth, np.int32))


def centered(item: Item) -> Item:
    """The item moved above the origin."""
    x, y, _ = item.middle
    return item.moved((-x, -y, 0.0))


def free_floor(room: Room, surfaces: Surfaces, path: Points, taken: Points) -> Points:
    """(2,) the place on the floor nearest to the path that is clear of the path, all furniture and places taken."""
    x, y = (np.arange(-side / 2, side / 2, FLOOR_STEP_M) for side in room.size[:2])
    floor = np.stack(np.meshgrid(x, y), axis=2).reshape(-1, 2)
    from_path, from_taken = (np.linalg.norm(floor[:, None] - places, axis=2).min(axis=1) for places in (path, taken))
    # Each clearance as a share of the wanted one; where no place has them all, the freest one is taken.
    asked = (_clearance(surfaces, floor) / CLEAR_OF_FURNITURE_M, from_path / CLEAR_OF_PATH_M, from_taken / APART_M)
    free = np.min(np.array(asked), axis=0)
    return floor[np.where(free >= min(1.0, free.max()), from_path, np.inf).argmin()]


def ring(room: Room) -> Points:
    """(RING_STEPS, 2) a closed path around the middle, each step where the furniture leaves most room; smoothed."""
    surfaces, angle = Surfaces([*room.objects, *room.shell]), 2 * np.pi * np.arange(RING_STEPS) / RING_STEPS
    around = np.stack([np.cos(angle), np.sin(angle)], axis=1) * np.array(room.size[:2]) / 2
    shares = np.linspace(0.3, 0.85, 23)
    places = around[:, None] * shares[None, :, None]
    clearance = _clearance(surfaces, places.reshape(-1, 2)).reshape(RING_STEPS, -1)
    best = shares[clearance.argmax(axis=1)]
    # Smoothed over 15 steps; as the ring is closed, it is padded with seven steps from the opposite end.
    window = np.hanning(17)[1:-1]
    smooth = np.asarray(np.convolve(np.concatenate([best[-7:], best, best[:7]]), window / window.sum(), "valid"), float)
    return around * smooth[:, None]


def _on_ring(path: Points, place: float) -> Points:
    first, share = int(place), place % 1
    return (1 - share) * path[first % len(path)] + share * path[(first + 1) % len(path)]


def _clearance(surfaces: Surfaces, places: Points) -> Points:
    """(n,) meters from each place (n, 2) to the nearest surface between knee and sensor height, or to the floor."""
    at_heights = (np.column_stack([places, np.full(len(places), z)]) for z in (0.4, 0.65, SENSOR_HEIGHT_M))
    return np.min([surfaces.distance_m(xyz) for xyz in at_heights], axis=0).astype(np.float64)
