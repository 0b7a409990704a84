"""A street and rough country under a sky, and the two sensors that measure such places.

Meters, z up. Everything has a name, the ground and the sky too, as proposers mask everything outdoors. A `Scanner` or
`Matched` gives the raw points of a cloud; `make.py` counts the views that see them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from og_pointcloud_room.furniture import Item, Random, paint, wood
from og_pointcloud_room.raycast import Frame, Intrinsics, Surfaces
from og_pointcloud_room.room import Room
from og_pointcloud_room.shapes import Material, Part, box, cushion_shape, lathe, rotated
from scipy.ndimage import zoom

SKY = "sky"
STREET = ("road", "sidewalk", "building", "car", "pole", "tree", "person", "fence", SKY)
COUNTRY = ("trail", "grass", "bush", "tree", "rock", "log", "pole", SKY)
HALF_LENGTH_M, CLEAR_M = 36.0, 30.0
"""Half the length of a street or field; half the length of the stretch with things along it."""
LEAVES = Material((0.24, 0.46, 0.16), (0.12, 0.28, 0.1), (0.3, 0.3, 0.3))
BARK = Material((0.36, 0.27, 0.2), (0.25, 0.18, 0.12), (0.2, 0.2, 0.2))
STONE = Material((0.55, 0.53, 0.5), (0.4, 0.39, 0.37), (0.3, 0.3, 0.3))
ASPHALT = Material((0.33, 0.33, 0.35), (0.27, 0.27, 0.28), (0.5, 0.5, 0.5))
PAVED = Material((0.6, 0.58, 0.55), (0.5, 0.49, 0.47), (0.4, 0.4, 0.4))
STEEL = Material((0.5, 0.52, 0.54), (0.4, 0.42, 0.44), (0.3, 0.3, 0.3))
AIR = Material((0.6, 0.75, 0.95), (0.7, 0.8, 0.95), (9.0, 9.0, 9.0))
DIRT = Material((0.5, 0.4, 0.28), (0.38, 0.3, 0.2), (0.4, 0.4, 0.4))
BLADES = Material((0.42, 0.55, 0.2), (0.3, 0.4, 0.14), (0.15, 0.15, 0.15))
Doubles = NDArray[np.float64]


class Raw(NamedTuple):
    """Measured points. xyz: (n, 3) where a ray first meets a surface. normal: (n, 3) of that surface. owner: (n,)
    object. rgb: (n, 3) uint8. offset: (n, 3) meters from xyz to where the sensor puts the point."""

    xyz: Doubles
    normal: Doubles
    owner: NDArray[np.int64]
    rgb: NDArray[np.uint8]
    offset: Doubles


# Places ---------------------------------------------------------------------------------------------------------


def _under_sky(items: Sequence[Item], half_width_m: float, height_m: float) -> Room:
    """Items in a box of sky, which is the last item."""
    x, y = 2 * HALF_LENGTH_M, 2 * half_width_m
    walls = [box((x, 0.1, height_m), (0, side * (y / 2 + 0.05), 0), AIR) for side in (-1, 1)]
    walls += [box((0.1, y, height_m), (side * (x / 2 + 0.05), 0, 0), AIR) for side in (-1, 1)]
    walls += [box((x, y, 0.1), (0, 0, z), AIR) for z in (-0.1, height_m)]
    return Room((x, y, height_m), (*items, Item(SKY, tuple(walls))), ())


def _tree(rng: Random) -> Item:
    """A trunk, and a crown of five blobs."""
    height, radius = rng.uniform(2.2, 3.5), rng.uniform(0.1, 0.18)
    trunk = lathe([(0, 0), (radius, 0), (0.7 * radius, height), (0, height)], (0, 0, 0), BARK)
    crown = [
        cushion_shape(
            rng.uniform(1.2, 2.2, 3).tolist(), (*rng.normal(0, 0.55, 2), height - rng.uniform(0.2, 0.9)), LEAVES, 0.9
        )
        for _ in range(5)
    ]
    return Item("tree", (trunk, *crown))


def _bush(rng: Random) -> Item:
    """Three to five overlapping blobs, 0.6 to 1.5 m high."""
    blobs = [
        cushion_shape((*rng.uniform(0.6, 1.3, 2), rng.uniform(0.6, 1.4)), (*rng.normal(0, 0.4, 2), -0.1), LEAVES, 0.9)
        for _ in range(rng.integers(3, 6))
    ]
    return Item("bush", tuple(blobs))


def _rock(rng: Random) -> Item:
    return Item("rock", (cushion_shape(rng.uniform(0.3, 1.1, 3).tolist(), (0, 0, -0.1), STONE, 0.7),))


def _log(rng: Random) -> Item:
    radius, length = rng.uniform(0.12, 0.22), rng.uniform(1.5, 3.5)
    upright = lathe([(0, 0), (radius, 0), (radius, length), (0, length)], (0, 0, -length / 2), BARK)
    turned = np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]])
    return Item("log", (upright.turned(turned, (0, 0, radius)),))


def _pole(rng: Random) -> Item:
    """A street lamp of 5 to 6 m, or a sign of 2.3 m with its plate."""
    if rng.uniform() < 0.5:
        tall = rng.uniform(5, 6)
        return Item("pole", (box((0.12, 0.12, tall), (0, 0, 0), STEEL), box((0.9, 0.15, 0.1), (0.4, 0, tall), STEEL)))
    return Item("pole", (box((0.07, 0.07, 2.3), (0, 0, 0), STEEL), box((0.05, 0.6, 0.6), (0, 0, 1.8), paint(rng))))


def _car(rng: Random) -> Item:
    length, coat, tyre = rng.uniform(3.8, 4.8), paint(rng), Material((0.1, 0.1, 0.1), (0.15, 0.15, 0.15), (1, 1, 1))
    body = cushion_shape((length, 1.75, 0.75), (0, 0, 0.3), coat, 0.25)
    cabin = cushion_shape((0.55 * length, 1.5, 0.75), (-0.05 * length, 0, 0.85), coat, 0.35)
    wheels = [box((0.6, 0.2, 0.6), (x * length, y, 0), tyre) for x in (-0.32, 0.32) for y in (-0.75, 0.75)]
    return Item("car", (body, cabin, *wheels))


def _person(rng: Random) -> Item:
    height, coat = rng.uniform(1.55, 1.9), paint(rng, 0.5)
    legs = [box((0.17, 0.15, 0.48 * height), (0, y, 0), paint(rng, 0.2)) for y in (-0.1, 0.1)]
    trunk = cushion_shape((0.28, 0.46, 0.42 * height), (0, 0, 0.45 * height), coat, 0.5)
    return Item("person", (*legs, trunk, cushion_shape((0.2, 0.18, 0.24), (0, 0, height - 0.25), wood(rng), 0.9)))


def _fence(rng: Random) -> Item:
    posts = [box((0.06, 0.03, 1.0), (x, 0, 0), wood(rng)) for x in np.arange(-2.5, 2.6, 0.25)]
    return Item("fence", (*posts, *(box((5.2, 0.03, 0.08), (0, 0, z), wood(rng)) for z in (0.25, 0.8))))


def street_room(rng: Random) -> Room:
    """72 m of street: houses, parked cars, poles, trees, people on the pavements, fences."""
    items = [Item("road", (box((2 * HALF_LENGTH_M, 8, 0.1), (0, 0, 0), ASPHALT),))]
    for side in (-1, 1):
        items.append(Item("sidewalk", (box((2 * HALF_LENGTH_M, 8, 0.22), (0, side * 8, 0), PAVED),)))
        for x in np.arange(-HALF_LENGTH_M + 5, HALF_LENGTH_M, 11):
            width, deep = rng.uniform(7, 10.6), rng.uniform(8.5, 10.5)
            house = box((width, 3, rng.uniform(6, 11)), (x, side * (deep + 1.5), 0), paint(rng, 0.25))
            items.append(Item("building", (house,)))
            if rng.uniform() < 0.5:
                items.append(_fence(rng).moved((x, side * (deep - 1.2), 0.22)))
        for maker, near, step, chance in (
            (_car, 2.95, 6.0, 0.75), (_pole, 4.6, 12.0, 0.9), (_tree, 5.4, 10.0, 0.7), (_person, 6.3, 9.0, 0.6),
        ):  # fmt: skip
            for x in np.arange(-CLEAR_M, CLEAR_M, step) + rng.uniform(0, step):
                if rng.uniform() < chance:
                    turn = 0.05 * rng.normal() if maker is _car else np.pi * (side < 0)
                    at = (
                        x + 0.12 * step * rng.normal(),
                        side * (near + 0.12 * rng.normal()),
                        0.1 if near < 4 else 0.22,
                    )
                    items.append(maker(rng).moved(at, turn))
    return _under_sky(items, 14.0, 16.0)


def _waves(rng: Random, low: float, high: float, cells: int, size: int) -> Doubles:
    """(size, size) smooth heights from low to high, with ``cells`` hills along a side."""
    field = zoom(rng.uniform(0, 1, (cells, cells)), size / cells, order=3, mode="nearest", grid_mode=True)
    return low + (high - low) * np.clip(field, 0, 1)


def _sheet(height: Doubles, material: Material) -> Part:
    """Heights on a square grid over the field as a surface."""
    size = len(height)
    x, y = np.meshgrid(*[np.linspace(-HALF_LENGTH_M, HALF_LENGTH_M, size)] * 2, indexing="ij")
    first = (np.arange(size - 1)[:, None] * size + np.arange(size - 1)).ravel()
    corners = np.stack([first, first + size, first + 1, first + 1, first + size, first + size + 1], axis=1)
    vertices = np.stack([x.ravel(), y.ravel(), height.ravel()], axis=1)
    return Part(vertices, corners.reshape(-1, 3).astype(np.int32), material)


def ground_at(room: Room, x: float, y: float) -> float:
    """Height of the trail's surface there, meters."""
    vertices = room.objects[0].parts[0].vertices
    return float(vertices[((vertices[:, :2] - (x, y)) ** 2).sum(axis=1).argmin(), 2])


def country_room(rng: Random) -> Room:
    """Hills with a trail along x, patches of grass that hide the ground, bushes, trees, rocks, logs and posts."""
    size = 145
    ground = _waves(rng, 0.5, 3.0, 6, size) + _waves(rng, 0, 0.25, 36, size)
    off_trail = np.clip(np.abs(np.linspace(-HALF_LENGTH_M, HALF_LENGTH_M, size)) / 2.5 - 0.6, 0, 1)[None]
    grass = ground + (_waves(rng, -0.25, 0.5, 24, size) + _waves(rng, -0.1, 0.1, 72, size) + 0.3) * off_trail - 0.3
    items = [Item("trail", (_sheet(ground, DIRT),)), Item("grass", (_sheet(grass, BLADES),))]
    bare = Room((0, 0, 0), tuple(items), ())
    for maker, count, nearest in (
        (_bush, 22, 3.2),
        (_tree, 14, 4.0),
        (_rock, 10, 1.8),
        (_log, 5, 2.5),
        (_pole, 5, 2.6),
    ):
        for _ in range(count):
            x, y = rng.uniform(-CLEAR_M, CLEAR_M), rng.choice((-1, 1)) * (nearest + 14 * rng.uniform() ** 1.5)
            items.append(maker(rng).moved((x, y, ground_at(bare, x, y) - 0.03), rng.uniform(0, 2 * np.pi)))
    return _under_sky(items, HALF_LENGTH_M, 16.0)


# Sensors --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Scanner:
    """A spinning scanner: rays from each of ``origins`` (s, 3) at ``beams`` elevations, all around.

    drift: (s, 3) meters, how far each sweep is off its place. soft: name -> mean depth in meters that rays penetrate
    things of this name, at most their thickness. colored: points have the colors of photographs, else the grey of their
    intensity. down, up: elevations of the lowest and the highest beam, degrees. range_m: no returns beyond it. error_m:
    standard deviation of a range.
    """

    room: Room
    origins: Doubles
    drift: Doubles
    beams: int
    soft: Mapping[str, float]
    colored: bool
    down: float = -25.0
    up: float = 12.0
    range_m: float = 50.0
    error_m: float = 0.02

    def __call__(self, count: int, rng: Random) -> Raw:
        """The returns of ``count`` rays; rays into the sky have none."""
        surfaces = Surfaces(self.room.objects)
        names = [item.name for item in self.room.objects]
        tones = [part.material for item in self.room.objects for part in item.parts]
        albedo = np.array([(tone.color, tone.second) for tone in tones])
        softness = np.array([self.soft.get(name, 0.0) for name in names])
        found = []
        for origin, moved in zip(self.origins, self.drift, strict=True):
            ray = self._rays(count // len(self.origins), rng)
            hits = surfaces.cast(origin, ray)
            owner = surfaces.part_item[hits.part]
            back = (hits.part >= 0) & (hits.distance < self.range_m) & (owner != names.index(SKY))
            ray, owner, part = ray[back], owner[back], hits.part[back]
            xyz = origin + ray * hits.distance[back, None]
            # Rays penetrate soft things to an exponential depth, as through leaves, but never out at the back.
            through = np.nan_to_num(surfaces.cast(xyz + 1e-3 * ray, ray).distance)
            deeper = np.minimum(softness[owner] * rng.exponential(size=len(xyz)), 0.9 * through)
            deeper += self.error_m * rng.normal(size=len(xyz))
            share = rng.random((len(xyz), 1))
            tone = np.sqrt(0.6 * (share * albedo[part, 0] + (1 - share) * albedo[part, 1]))
            tone = tone if self.colored else np.repeat(tone.mean(axis=1, keepdims=True), 3, axis=1)
            rgb = (255 * np.clip(tone + 0.04 * rng.normal(size=(len(xyz), 1)), 0, 1)).astype(np.uint8)
            found.append((xyz, hits.normal[back], owner, rgb, ray * deeper[:, None] + moved))
        return _shuffled(found, rng)

    def _rays(self, count: int, rng: Random) -> Doubles:
        """(count, 3) unit directions, each along one of the beams."""
        around = rng.uniform(0, 2 * np.pi, count)
        beam = rng.integers(0, self.beams, count) / (self.beams - 1)
        tilt = np.radians(self.down + (self.up - self.down) * beam)
        return np.stack([np.cos(around) * np.cos(tilt), np.sin(around) * np.cos(tilt), np.sin(tilt)], axis=1)


@dataclass(frozen=True)
class Matched:
    """Points matched between photographs: at edges in the images, less exact the farther away."""

    room: Room
    frames: Sequence[Frame]
    intrinsics: Intrinsics
    baseline_m: float = 4.0
    error_px: float = 0.4

    def __call__(self, count: int, rng: Random) -> Raw:
        """About ``count`` points, equally many from each image."""
        sky = next(k for k, item in enumerate(self.room.objects) if item.name == SKY)
        directions, found = self.intrinsics.directions().reshape(-1, 3), []
        for frame in self.frames:
            # Pixels are drawn by edge strength; a plain wall has few matches, the sky none.
            grey = frame.image.astype(np.float64).mean(axis=2)
            edge = np.abs(np.gradient(grey)).sum(axis=0) + 0.3
            reach = np.cumsum(np.where(frame.owner == sky, 0, edge).ravel())
            pixel = np.searchsorted(reach, rng.random(count // len(self.frames) + 1) * reach[-1], side="right")
            depth = frame.depth_m.ravel()[pixel].astype(np.float64)
            ray = rotated(directions[pixel], frame.camera_to_world[:3, :3])
            # Two views a baseline b apart: depth = f b / disparity, so a disparity error has an effect ~ depth^2.
            error = (
                depth**2 * self.error_px / (self.intrinsics.focal_px * self.baseline_m) * rng.normal(size=len(pixel))
            )
            xyz = frame.camera_to_world[:3, 3] + ray * depth[:, None]
            rgb = frame.image.reshape(-1, 3)[pixel]
            offset = ray * np.clip(error, -0.3 * depth, 0.3 * depth)[:, None]
            found.append((xyz, ray, frame.owner.ravel()[pixel].astype(np.int64), rgb, offset))
        return _shuffled(found, rng)


def _shuffled(parts: Sequence[tuple[NDArray[Any], ...]], rng: Random) -> Raw:
    """All parts as one, in random order, so that the caller can take as many as it wants from the front."""
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    order = rng.permutation(len(columns[0]))
    return Raw(*(column[order] for column in columns))
