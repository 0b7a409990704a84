"""Models of furniture and of the things that stand on it, drawn from a random generator.

Single things (``mug``, ``book`` ...) return one :class:`Item` standing on the origin. Groups (``sofa_group`` ...)
return furniture with the things on it, in a frame with the floor at z = 0, the footprint centered on the origin, and
the back, which goes to the wall, at +y.
"""

from __future__ import annotations

import colorsys
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from og_pointcloud_room.shapes import Material, Part, box, cushion_shape, lathe, rotation_about

CLASS_NAMES = (
    "bed", "book", "bottle", "cabinet", "chair", "cushion", "desk", "lamp", "monitor", "mug", "picture",
    "potted plant", "rug", "shelf", "sofa", "table", "vase",
)  # fmt: skip

Random = np.random.Generator


@dataclass(frozen=True)
class Item:
    """One object instance: the name of its class and its solids."""

    name: str
    parts: tuple[Part, ...]

    @property
    def vertices(self) -> NDArray[np.float64]:
        """(V, 3) of all its solids, meters."""
        return np.concatenate([part.vertices for part in self.parts])

    @property
    def middle(self) -> NDArray[np.float64]:
        """(3,) center of its bounding box."""
        return (self.vertices.min(axis=0) + self.vertices.max(axis=0)) / 2

    def moved(self, offset: ArrayLike, yaw: float = 0.0) -> Item:
        """Turned by ``yaw`` radians about z, then shifted by ``offset`` (3,)."""
        return Item(self.name, tuple(part.moved(offset, yaw) for part in self.parts))


@dataclass(frozen=True)
class Group:
    """Items that are placed as one; width (x) and depth (y) of the footprint in meters."""

    items: tuple[Item, ...]
    width: float
    depth: float
    carries_picture: bool = True
    """Whether the wall above it is free from 1.45 m upwards."""

    def moved(self, offset: ArrayLike, yaw: float = 0.0) -> tuple[Item, ...]:
        """Its items, turned by ``yaw`` radians about z and shifted by ``offset`` (3,)."""
        return tuple(item.moved(offset, yaw) for item in self.items)


# Materials ------------------------------------------------------------------------------------------------------


def _tint(hue: float, saturation: float, value: float) -> tuple[float, float, float]:
    return colorsys.hsv_to_rgb(hue % 1.0, min(max(saturation, 0.0), 1.0), min(max(value, 0.0), 1.0))


def wood(rng: Random) -> Material:
    """Brown streaks along x."""
    hue, value = rng.uniform(0.06, 0.1), rng.uniform(0.45, 0.8)
    return Material(_tint(hue, 0.5, value), _tint(hue, 0.6, value * 0.72), (0.3, 0.03, 0.06))


HUES = (0.0, 0.04, 0.11, 0.14, 0.22, 0.33, 0.46, 0.55, 0.6, 0.66, 0.93)
"""Common hues of household things: reds, ochres, greens, teal, blues, rose."""


def fabric(rng: Random) -> Material:
    """Mottled, with a muted hue."""
    hue, saturation, value = rng.choice(HUES), rng.uniform(0.25, 0.65), rng.uniform(0.45, 0.85)
    return Material(_tint(hue, saturation, value), _tint(hue + 0.03, saturation, value * 0.75), (0.04, 0.04, 0.04))


def paint(rng: Random, saturation: float = 0.7) -> Material:
    """Almost even."""
    hue, value = rng.choice(HUES), rng.uniform(0.6, 0.95)
    return Material(_tint(hue, saturation, value), _tint(hue, saturation, value * 0.88), (0.1, 0.1, 0.1))


def _print(rng: Random, grain: float) -> Material:
    """Two contrasting hues, as on a picture or a patterned rug."""
    first, second = rng.choice(HUES, 2, replace=False)
    return Material(_tint(first, 0.55, 0.9), _tint(second, 0.7, 0.4), (grain, grain, grain))


METAL = Material((0.32, 0.32, 0.34), (0.25, 0.25, 0.27), (0.05, 0.05, 0.05))
SCREEN = Material((0.07, 0.08, 0.1), (0.12, 0.14, 0.2), (0.2, 0.2, 0.2))
LEAF = Material((0.2, 0.52, 0.18), (0.1, 0.32, 0.12), (0.04, 0.04, 0.04))
SOIL = Material((0.22, 0.15, 0.1), (0.15, 0.1, 0.07), (0.02, 0.02, 0.02))


# Small things ---------------------------------------------------------------------------------------------------


def mug(rng: Random) -> Item:
    """Hollow cup with a handle, 9-12 cm tall."""
    material, radius, height = paint(rng), rng.uniform(0.042, 0.052), rng.uniform(0.09, 0.12)
    inner = radius - 0.006
    cup = lathe([(0, 0), (radius, 0), (radius, height), (inner, height), (inner, 0.01), (0, 0.01)], (0, 0, 0), material)
    grip = box((0.035, 0.014, height * 0.6), (radius + 0.014, 0, height * 0.2), material)
    return Item("mug", (cup, grip)).moved((0, 0, 0), rng.uniform(0, 2 * np.pi))


def bottle(rng: Random) -> Item:
    """Wine-bottle profile, 27-33 cm tall."""
    radius, height = rng.uniform(0.038, 0.048), rng.uniform(0.27, 0.33)
    profile = [(0, 0), (1, 0), (1, 0.58), (0.8, 0.68), (0.36, 0.78), (0.34, 1), (0, 1)]
    return Item("bottle", (lathe([(r * radius, z * height) for r, z in profile], (0, 0, 0), paint(rng)),))


def vase(rng: Random) -> Item:
    """Bulged, open vase, 20-30 cm tall."""
    radius, height = rng.uniform(0.07, 0.095), rng.uniform(0.2, 0.3)
    below = [(0, 0), (0.6, 0), (0.9, 0.2), (1, 0.4), (0.8, 0.65), (0.45, 0.82), (0.6, 1)]
    profile = [*below, (0.48, 0.98), (0.3, 0.8), (0, 0.7)]
    return Item("vase", (lathe([(r * radius, z * height) for r, z in profile], (0, 0, 0), paint(rng, 0.45)),))


def ball(radius: float, rings: int, material: Material) -> Item:
    """A ball, of so many rings from pole to pole."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, rings)
    profile = [(radius * np.cos(a), radius * (1 + np.sin(a))) for a in angle]
    return Item("ball", (lathe(profile, (0, 0, 0), material),))


def standing_book(rng: Random) -> Item:
    """Thick upright volume, spine to the front."""
    size = (rng.uniform(0.05, 0.08), rng.uniform(0.17, 0.2), rng.uniform(0.24, 0.29))
    return Item("book", (box(size, (0, 0, 0), paint(rng)),))


def lying_book(rng: Random) -> Item:
    """Volume on its back, turned by up to 20 degrees."""
    size = (rng.uniform(0.18, 0.22), rng.uniform(0.24, 0.28), rng.uniform(0.035, 0.055))
    return Item("book", (box(size, (0, 0, 0), paint(rng)),)).moved((0, 0, 0), rng.uniform(-0.35, 0.35))


def _plant(rng: Random, pot_radius: float, height: float) -> Item:
    """Tapered pot with nine leaves that lean outwards, all within about 1.6 pot radii of the axis."""
    pot_height = 0.35 * height
    pot = [(0, 0), (0.75, 0), (1, 1), (0.85, 1), (0.8, 0.9), (0, 0.9)]
    parts = [lathe([(r * pot_radius, z * pot_height) for r, z in pot], (0, 0, 0), paint(rng, 0.4))]
    soil = [(0, 0), (0.8 * pot_radius, 0), (0.8 * pot_radius, 0.01), (0, 0.01)]
    parts.append(lathe(soil, (0, 0, 0.88 * pot_height), SOIL))
    for step in range(9):
        length = (height - 0.85 * pot_height) * rng.uniform(0.75, 1.0)
        leaf = cushion_shape((1.1 * pot_radius, 0.35 * pot_radius, length), (0, 0, 0), LEAF, squareness=1.0)
        lean = rng.uniform(0.2, 1.0) * np.arcsin(min(1.3 * pot_radius / length, 0.9))
        azimuth = 2 * np.pi * (step + rng.uniform(0, 0.6)) / 9
        turn = rotation_about("z", azimuth) @ rotation_about("x", -lean)
        parts.append(leaf.turned(turn, (0, 0, 0.85 * pot_height)))
    return Item("potted plant", tuple(parts))


def small_plant(rng: Random) -> Item:
    """Pot of 8-10 cm radius for a cabinet."""
    return _plant(rng, rng.uniform(0.08, 0.1), rng.uniform(0.34, 0.42))


def floor_plant(rng: Random) -> Item:
    """Pot of 15-18 cm radius, a meter tall with its leaves."""
    return _plant(rng, rng.uniform(0.15, 0.18), rng.uniform(0.9, 1.15))


def _lamp(rng: Random, height: float, shade_radius: float) -> Item:
    foot_radius, shade_height = 0.7 * shade_radius, 1.3 * shade_radius
    foot = lathe([(0, 0), (foot_radius, 0), (foot_radius, 0.03), (0, 0.03)], (0, 0, 0), METAL)
    pole = box((0.03, 0.03, height - shade_height - 0.03), (0, 0, 0.03), METAL)
    profile = [(0, 0), (shade_radius, 0), (0.6 * shade_radius, shade_height), (0, shade_height)]
    return Item("lamp", (foot, pole, lathe(profile, (0, 0, height - shade_height), fabric(rng))))


def floor_lamp(rng: Random) -> Item:
    """Pole with a wide shade, 1.5-1.7 m tall."""
    return _lamp(rng, rng.uniform(1.5, 1.7), rng.uniform(0.19, 0.22))


def table_lamp(rng: Random) -> Item:
    """Lamp for a desk or cabinet, 40-48 cm tall."""
    return _lamp(rng, rng.uniform(0.4, 0.48), rng.uniform(0.11, 0.13))


def monitor(rng: Random) -> Item:
    """Screen on a stand, facing -y."""
    width = rng.uniform(0.5, 0.6)
    foot = box((0.24, 0.16, 0.015), (0, 0, 0), METAL)
    neck = box((0.05, 0.03, 0.15), (0, 0.03, 0.015), METAL)
    return Item("monitor", (foot, neck, box((width, 0.03, 0.6 * width), (0, 0, 0.1), SCREEN)))


def cushion(rng: Random) -> Item:
    """Square cushion that leans back against +y by about 20 degrees."""
    side = rng.uniform(0.38, 0.44)
    upright = cushion_shape((side, 0.14, side), (0, 0, 0), fabric(rng), squareness=0.55)
    leaning = upright.turned(rotation_about("x", -rng.uniform(0.2, 0.3)))
    return Item("cushion", (leaning.moved((0, 0, -leaning.vertices[:, 2].min())),))


def picture(rng: Random) -> Item:
    """Framed print, back at y = 0 and facing -y; its lower edge is at z = 0."""
    width, height = rng.uniform(0.6, 0.9), rng.uniform(0.45, 0.6)
    frame = box((width, 0.03, height), (0, -0.015, 0), wood(rng))
    canvas = box((width - 0.08, 0.01, height - 0.08), (0, -0.035, 0.04), _print(rng, 0.16))
    return Item("picture", (frame, canvas))


# Furniture ------------------------------------------------------------------------------------------------------


def _legs(width: float, depth: float, height: float, thickness: float, material: Material) -> list[Part]:
    x, y = (width - thickness) / 2, (depth - thickness) / 2
    return [box((thickness, thickness, height), (sx * x, sy * y, 0), material) for sx in (-1, 1) for sy in (-1, 1)]


def table_of(name: str, width: float, depth: float, height: float, material: Material) -> Item:
    """A top on four legs, as a thing of this class."""
    top = box((width, depth, 0.04), (0, 0, height - 0.04), material)
    return Item(name, (top, *_legs(width, depth, height - 0.04, 0.06, material)))


def chair(rng: Random, material: Material) -> Item:
    """Kitchen chair, 42 cm square, back at +y."""
    seat_height, back_height = 0.45, rng.uniform(0.85, 0.95)
    seat = box((0.42, 0.42, 0.04), (0, 0, seat_height - 0.04), material)
    back = box((0.42, 0.03, back_height - seat_height - 0.12), (0, 0.195, seat_height + 0.12), material)
    posts = [box((0.04, 0.03, 0.14), (x, 0.195, seat_height), material) for x in (-0.17, 0.17)]
    return Item("chair", (seat, back, *posts, *_legs(0.42, 0.42, seat_height - 0.04, 0.04, material)))


def arranged(
    rng: Random, makers: Sequence[Callable[[Random], Item]], center: Sequence[float], size: Sequence[float],
    cells: tuple[int, int],
) -> list[Item]:  # fmt: skip
    """Things on a surface, each in its own grid cell so that none touch. center (x, y, z), size (x, y) meters."""
    columns, rows = cells
    chosen = rng.permutation(columns * rows)[: len(makers)]
    items = []
    for maker, cell in zip(makers, chosen, strict=True):
        item = maker(rng)
        reach = np.abs(item.vertices[:, :2]).max(axis=0)
        slack = np.maximum(np.divide(size, cells) / 2 - reach - 0.01, 0.0)
        place = (np.array([cell % columns, cell // columns]) + 0.5) / cells * size - np.divide(size, 2)
        place = place + rng.uniform(-1, 1, 2) * slack
        items.append(item.moved((center[0] + place[0], center[1] + place[1], center[2])))
    return items


def dining_group(rng: Random) -> Group:
    """Rug, table, four chairs pushed in a little, and things on the table."""
    rug = Item("rug", (box((2.2, 1.75, 0.015), (0, 0, 0), _print(rng, 0.22)),))
    width, depth, floor = rng.uniform(1.25, 1.4), rng.uniform(0.75, 0.85), 0.015
    table = table_of("table", width, depth, 0.74, wood(rng)).moved((0, 0, floor))
    material = wood(rng) if rng.uniform() < 0.5 else paint(rng)
    chairs = []
    for side in (-1, 1):
        for x in (-width / 4, width / 4):
            y = side * (depth / 2 + rng.uniform(0.0, 0.16))
            yaw = (np.pi if side < 0 else 0.0) + rng.uniform(-0.15, 0.15)
            chairs.append(chair(rng, material).moved((x + rng.uniform(-0.03, 0.03), y, floor), yaw))
    makers = [mug, mug, bottle, vase, lying_book, *[lying_book, mug][: rng.integers(0, 3)]]
    things = arranged(rng, makers, (0, 0, floor + 0.74), (width, depth), (4, 2))
    return Group((rug, table, *chairs, *things), 2.2, 1.75)


def sofa_group(rng: Random) -> Group:
    """Sofa with two seats and two cushions."""
    width, depth, material = rng.uniform(1.8, 2.0), 0.9, fabric(rng)
    parts = [
        box((width, depth, 0.28), (0, 0, 0), material),
        cushion_shape((width, 0.24, 0.56), (0, depth / 2 - 0.12, 0.28), material, squareness=0.3),
    ]
    for side in (-1, 1):
        parts.append(cushion_shape((0.2, depth - 0.24, 0.34), (side * (width - 0.2) / 2, -0.12, 0.28), material, 0.3))
        seat = ((width - 0.42) / 2, depth - 0.26, 0.17)
        parts.append(cushion_shape(seat, (side * (width - 0.4) / 4, -0.12, 0.28), material, squareness=0.2))
    places = (0.06 - width / 4, width / 4 - 0.06)
    cushions = [cushion(rng).moved((x, 0.0, 0.45), rng.uniform(-0.12, 0.12)) for x in places]
    return Group((Item("sofa", tuple(parts)), *cushions), width, depth)


def bed_group(rng: Random) -> Group:
    """Single bed along the wall with a blanket and two pillows of class "cushion"."""
    width, depth, frame = 2.0, rng.uniform(0.95, 1.1), wood(rng)
    parts = (
        box((width, depth, 0.28), (0, 0, 0), frame),
        box((0.05, depth, 0.62), (-width / 2 + 0.025, 0, 0.28), frame),
        cushion_shape((width - 0.07, depth - 0.02, 0.2), (0.03, 0, 0.28), fabric(rng), squareness=0.15),
    )
    pillows = []
    for y in (-depth / 4, depth / 4):
        pillow = cushion_shape(
            (0.32, depth / 2 - 0.06, 0.13), (-width / 2 + 0.25, y, 0.48), fabric(rng), squareness=0.5
        )
        pillows.append(Item("cushion", (pillow,)))
    return Group((Item("bed", parts), *pillows), width, depth)


def desk_group(rng: Random) -> Group:
    """Desk with monitor, lamp, mug and book, and a chair before it."""
    width, material = rng.uniform(1.3, 1.5), wood(rng)
    desk = table_of("desk", width, 0.65, 0.74, material).moved((0, 0.25, 0))
    back_row = [monitor(rng).moved((0, 0.38, 0.74)), table_lamp(rng).moved((-width / 2 + 0.16, 0.38, 0.74))]
    front_row = arranged(rng, [mug, lying_book], (0, 0.07, 0.74), (width, 0.29), (4, 1))
    seat = chair(rng, paint(rng)).moved((rng.uniform(-0.15, 0.15), -0.28, 0), np.pi + rng.uniform(-0.2, 0.2))
    return Group((desk, *back_row, *front_row, seat), width, 1.15)


def shelf_group(rng: Random) -> Group:
    """Open shelf with four compartments of books, mugs, bottles and vases."""
    width, depth, height, material = rng.uniform(1.1, 1.3), 0.34, 1.7, wood(rng)
    parts = [box((width, 0.02, height), (0, depth / 2 - 0.01, 0), material)]
    parts += [box((0.03, depth - 0.02, height), (side * (width - 0.03) / 2, -0.01, 0), material) for side in (-1, 1)]
    levels = [0.06, 0.47, 0.88, 1.29, height - 0.03]
    parts += [box((width - 0.06, depth - 0.02, 0.03), (0, -0.01, level), material) for level in levels]
    makers = [standing_book] * 5 + [mug, mug, bottle, vase, small_vase_or_bottle]
    makers = [makers[index] for index in rng.permutation(len(makers))]
    things: list[Item] = []
    for level, share in zip(levels, np.array_split(np.arange(len(makers)), 4), strict=False):
        chosen = [makers[index] for index in share]
        things += arranged(rng, chosen, (0, -0.02, level + 0.03), (width - 0.08, depth - 0.05), (4, 1))
    return Group((Item("shelf", tuple(parts)), *things), width, depth, carries_picture=False)


def small_vase_or_bottle(rng: Random) -> Item:
    """One or the other, at random."""
    return vase(rng) if rng.uniform() < 0.5 else bottle(rng)


def cabinet_group(rng: Random) -> Group:
    """Sideboard with two doors and a plant, a lamp and a vase or bottle on it."""
    width, depth, height, material = rng.uniform(1.1, 1.4), 0.45, rng.uniform(0.75, 0.85), wood(rng)
    door, front = (width / 2 - 0.03, 0.02, height - 0.1), paint(rng, 0.3)
    body = box((width, depth - 0.02, height), (0, 0.01, 0), material)
    doors = [box(door, (x, -depth / 2 + 0.01, 0.06), front) for x in (-width / 4, width / 4)]
    makers = [small_plant, table_lamp, small_vase_or_bottle]
    things = arranged(rng, makers, (0, 0, height), (width, depth - 0.06), (3, 1))
    return Group((Item("cabinet", (body, *doors)), *things), width, depth)
