"""A street as a mapping car sees it: as many LiDAR points and images as asked for, for tests of large scenes.

Two rows of houses, cars along two kerbs that run the whole length, lamps and trees. Every surface is a box or an
ellipsoid, so images and masks are cast exactly, and points are spread evenly over what a LiDAR on the road can reach.
Some masks are missing, as from a real proposer. The road and the pavement have none.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray
from og_pointcloud_room.features import FEATURE_SPACE, FeatureModel
from pinhole import looking, rays

from og_pointcloud.scene import Camera, Points, Scene, View

Floats = NDArray[np.float64]

CLASSES = ("house", "kerb", "car", "lamp", "tree")
ROAD_HALF_M, KERB_M, PAVEMENT_M = 4.0, 0.3, 3.5
"""Half the width of the road, the width of a kerb, that of a pavement."""
NOISE_M = 0.01
"""Standard deviation of points about their surfaces."""
MISSING = 0.1
"""Share of the masks that a proposer does not find."""
SMALLEST_PX = 40
"""Smaller masks are not proposed."""
HEADINGS_DEG = (0.0, 100.0, 180.0, 260.0)
"""Where the cameras of one stop look, from ahead to the left."""
FARTHEST_M = 1e4
GROUND, SKY = -1, -2
"""Owners of pixels that show no object."""


@dataclass(frozen=True)
class Street:
    """Solids in meters, x along the street, z up, the road at z = 0. low, high: (s, 3) corners. round: (s,) bool,
    ellipsoids within their corners, else boxes. owner: (s,) the object of each. cls: (objects,) row of CLASSES."""

    low: Floats
    high: Floats
    round: NDArray[np.bool_]
    owner: NDArray[np.int32]
    cls: NDArray[np.int32]
    length_m: float

    @classmethod
    def build(cls, length_m: float, rng: np.random.Generator) -> Street:
        """As many houses, cars, lamps and trees as there is room for along so many meters."""
        solids: list[tuple[list[float], list[float], bool, int]] = []
        classes: list[int] = []

        def add(name: str, *parts: tuple[list[float], list[float], bool]) -> None:
            solids.extend((low, high, round_, len(classes)) for low, high, round_ in parts)
            classes.append(CLASSES.index(name))

        for side in (-1.0, 1.0):

            def block(x: float, y: float, z: float, size: tuple[float, float, float], side: float = side) -> tuple:
                """Corners of a box at x, its near face y from the middle of the road."""
                across = sorted((side * y, side * (y + size[1])))
                return [x, across[0], z], [x + size[0], across[1], z + size[2]]

            add("kerb", (*block(0, ROAD_HALF_M, 0, (length_m, KERB_M, 0.14)), False))
            for x, width in _along(length_m, (7, 14), (0.0, 2.5), rng):
                size = (width, 9.0, rng.uniform(6, 11))
                add("house", (*block(x, ROAD_HALF_M + PAVEMENT_M + rng.uniform(0, 1.5), 0, size), False))
            for x, length in _along(length_m, (3.8, 4.8), (1.2, 9), rng):
                body = block(x, ROAD_HALF_M - 2.1, 0.25, (length, 1.75, 0.6))
                cabin = block(x + 0.25 * length, ROAD_HALF_M - 2.0, 0.85, (0.5 * length, 1.55, 0.6))
                add("car", (*body, False), (*cabin, False))
            for x, _ in _along(length_m, (0.2, 0.2), (14, 22), rng):
                add("lamp", (*block(x, ROAD_HALF_M + 0.6, 0, (0.18, 0.18, 6.5)), False))
            for x, wide in _along(length_m, (2.2, 3.2), (7, 16), rng):
                trunk = block(x + wide / 2 - 0.15, ROAD_HALF_M + 1.5, 0, (0.3, 0.3, 2.6))
                crown = block(x, ROAD_HALF_M + 1.65 - wide / 2, 2.4, (wide, wide, 2.8))
                add("tree", (*trunk, False), (*crown, True))
        low, high, round_, owner = map(np.array, zip(*solids, strict=True))
        return cls(low, high, round_, owner.astype(np.int32), np.array(classes, np.int32), length_m)

    def points(self, count: int, rng: np.random.Generator) -> tuple[NDArray[np.float32], NDArray[np.int16]]:
        """Points (n, 3) spread evenly over the surfaces, and the object of each, GROUND on road and pavement."""
        wide = ROAD_HALF_M + PAVEMENT_M
        ground = (np.array([0, -wide, 0]), np.array([self.length_m, wide, 0]))
        size = self.high - self.low
        tall = size[:, 2] > 5.5  # roofs are out of reach
        faces = np.stack([size[:, 1] * size[:, 2]] * 2 + [size[:, 0] * size[:, 2]] * 2, axis=1)
        top = np.where(tall, 0, size[:, 0] * size[:, 1])
        # Knud Thomsen's formula for the surface of an ellipsoid, exact to a percent.
        a, b, c = (size.T / 2) ** 1.6075
        shell = 4 * np.pi * ((a * b + a * c + b * c) / 3) ** (1 / 1.6075)
        area = np.where(self.round, shell, faces.sum(axis=1) + top)
        area = np.append(area, 2 * wide * self.length_m)
        per_solid = rng.multinomial(count, area / area.sum())
        xyz, owner = np.empty((count, 3), np.float32), np.repeat(np.append(self.owner, GROUND), per_solid)
        end = 0
        for solid, n in enumerate(per_solid.tolist()):
            begin, end = end, end + n
            low, high = ground if solid == len(self.low) else (self.low[solid], self.high[solid])
            at = rng.random((n, 3))
            if solid < len(self.low) and self.round[solid]:
                at = rng.normal(size=(n, 3))
                at = 0.5 + 0.5 * at / np.linalg.norm(at, axis=1, keepdims=True)
            elif solid < len(self.low):
                share = np.append(faces[solid], top[solid])
                face = rng.choice(5, n, p=share / share.sum())
                at[np.arange(n), face // 2] = np.where(face == 4, 1, face % 2)
            xyz[begin:end] = low + at * (high - low) + NOISE_M * rng.normal(size=(n, 3))
        order = rng.permutation(count)
        return xyz[order], owner[order].astype(np.int16)

    def look(self, camera: Camera) -> tuple[NDArray[np.int16], NDArray[np.float32]]:
        """(H, W) int16, the object, GROUND or SKY that each pixel shows, and (H, W) float32, its depth in meters."""
        intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
        pose, near = camera.world_to_camera, self.in_sight(camera)
        solids = self.low[near], self.high[near], self.round[near], self.owner[near]
        return _cast(*solids, pose, camera.center, intrinsics, camera.width, camera.height)

    def in_sight(self, camera: Camera) -> NDArray[np.bool_]:
        """(s,) false for solids all of whose corners are behind the camera, or beyond one side of its image."""
        corners = np.stack(np.meshgrid(*[[0, 1]] * 3), axis=-1).reshape(8, 1, 3)
        places = (
            np.where(corners, self.high, self.low) @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        )
        x, y, depth = np.moveaxis(places, -1, 0)
        u, v = camera.fx * x + camera.cx * depth, camera.fy * y + camera.cy * depth  # times the depth: signs stay
        sides = (depth, u, v, camera.width * depth - u, camera.height * depth - v)
        return np.logical_and.reduce([(side > 0).any(axis=0) for side in sides])

    def image(self, camera: Camera) -> NDArray[np.uint8]:
        """(H, W, 3) uint8: what the camera sees."""
        owner, depth = self.look(camera)
        place = rays(camera) * depth[..., None] + camera.center
        return colors(place.reshape(-1, 3), owner.ravel()).reshape(*owner.shape, 3)


def _along(
    length_m: float, sizes: tuple[float, float], gaps: tuple[float, float], rng: np.random.Generator
) -> Iterator[tuple[float, float]]:
    """(start, size) of things in a row with gaps between them."""
    x = rng.uniform(*gaps)
    while (size := rng.uniform(*sizes)) + x < length_m:
        yield x, size
        x += size + rng.uniform(*gaps)


def _chunks(count: int, size: int = 1 << 20) -> Iterator[slice]:
    return (slice(begin, begin + size) for begin in range(0, count, size))


@njit(cache=True, parallel=True, error_model="numpy")
def _cast(low, high, round_, owner, pose, eye, intrinsics, width, height):
    """Nearest solid along the ray of every pixel, the plane z = 0 behind all of them, and its depth."""
    shown = np.full((height, width), SKY, np.int16)
    nearest = np.full((height, width), FARTHEST_M, np.float32)
    fx, fy, cx, cy = intrinsics
    for row in prange(height):
        for column in range(width):
            u, v = (column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy
            down = pose[0, 2] * u + pose[1, 2] * v + pose[2, 2]
            if down < 0 and -eye[2] / down < FARTHEST_M:
                shown[row, column], nearest[row, column] = GROUND, -eye[2] / down
        for s in range(len(low)):
            for column in range(width):
                u, v = (column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy
                enter, leave = 0.05, np.float64(nearest[row, column])
                a, b, c = 0.0, 0.0, -1.0
                for axis in range(3):
                    along = pose[0, axis] * u + pose[1, axis] * v + pose[2, axis]
                    if round_[s]:
                        half = (high[s, axis] - low[s, axis]) / 2
                        offset = (eye[axis] - low[s, axis]) / half - 1
                        a += (along / half) ** 2
                        b += along / half * offset
                        c += offset * offset
                    else:
                        first, second = (low[s, axis] - eye[axis]) / along, (high[s, axis] - eye[axis]) / along
                        enter, leave = max(enter, min(first, second)), min(leave, max(first, second))
                if round_[s]:
                    enter = (-b - np.sqrt(b * b - a * c)) / a if b * b > a * c else np.inf
                if 0.05 < enter < leave:
                    shown[row, column], nearest[row, column] = owner[s], enter
    return shown, nearest


def colors(xyz: NDArray[np.floating], owner: NDArray[np.integer]) -> NDArray[np.uint8]:
    """(n, 3) uint8: a color an object, in squares of half a meter, so that images can tell places apart."""
    hues = 70 + 150 * np.modf(0.618 * np.arange(owner.max(initial=0) + 1)[:, None] + np.array([0.0, 0.35, 0.6]))[0]
    palette = np.concatenate([hues, [[150, 190, 230], [95, 95, 100]]])  # SKY and GROUND are rows -2 and -1
    squares = np.floor(2 * np.clip(xyz, -FARTHEST_M, FARTHEST_M) + 0.25).astype(np.int32)
    light = np.where((squares.sum(axis=1) & 1) | (owner == SKY), 1.0, 0.8)
    return (palette[owner] * light[:, None]).astype(np.uint8)


def drive(length_m: float, views: int, image: tuple[int, int]) -> list[Camera]:
    """Cameras in stops along the street, those of a stop looking all around."""
    stops = -(-views // len(HEADINGS_DEG))
    width, height = image
    cameras = []
    for index in range(views):
        stop, heading = index // len(HEADINGS_DEG), np.radians(HEADINGS_DEG[index % len(HEADINGS_DEG)])
        eye = np.array([length_m * (stop + 0.5) / stops, 0.8 * (-1) ** stop, 1.9])
        pose = looking(eye, [np.cos(heading), np.sin(heading), 0.06])
        cameras.append(Camera(width, height, 0.6 * width, 0.6 * width, width / 2, height / 2, pose))
    return cameras


@dataclass(frozen=True)
class MadeStreet:
    """A scene and its truth. owner: (n,) int16, the object of each point, GROUND on road and pavement."""

    scene: Scene
    owner: NDArray[np.int16]


def make_street(
    points: int, views: int, image: tuple[int, int] = (960, 540), length_m: float = 200.0, seed: int = 0
) -> MadeStreet:
    """The scene. Images are drawn whenever they are read, as those of a capture are decoded."""
    rng = np.random.default_rng(seed)
    street = Street.build(length_m, rng)
    xyz, owner = street.points(points, rng)
    model = FeatureModel(len(CLASSES), rng)
    looks = [model.object_look(rng) for _ in street.cls]
    taken = []
    for index, camera in enumerate(drive(length_m, views, image)):
        shown, _ = street.look(camera)
        pixels = np.bincount(shown[shown >= 0], minlength=len(street.cls))
        found = np.flatnonzero((pixels >= SMALLEST_PX) & (rng.random(len(pixels)) >= MISSING))
        number = np.full(len(pixels) + 2, -1, np.int32)
        number[found] = rng.permutation(len(found))
        rows = [model.image(int(street.cls[k]), looks[k], rng) for k in found[np.argsort(number[found])]]
        features = np.array(rows, np.float32).reshape(-1, model.texts.shape[1])
        pictured = partial(street.image, camera)
        taken.append(View(f"view{index:04d}", camera, number[shown], features, pictured))
    tint = np.concatenate([colors(xyz[part], owner[part]) for part in _chunks(len(xyz))])
    cloud = Points(xyz, np.zeros(3), tint)
    return MadeStreet(Scene(cloud, tuple(taken), FEATURE_SPACE, "street"), owner)
