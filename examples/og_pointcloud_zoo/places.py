"""The places of the zoo's scenes, and a camera path through each. Frame and units are those of the demo's room."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from og_pointcloud_room.capture import looking_at, walk
from og_pointcloud_room.furniture import (
    CLASS_NAMES,
    METAL,
    Group,
    Item,
    Random,
    arranged,
    bottle,
    desk_group,
    dining_group,
    floor_plant,
    lying_book,
    mug,
    paint,
    shelf_group,
    small_plant,
    sofa_group,
    table_of,
    vase,
    wood,
)
from og_pointcloud_room.raycast import Frame, Intrinsics, Surfaces
from og_pointcloud_room.room import Room, furnish, shell
from og_pointcloud_room.shapes import box

from og_pointcloud_zoo.outdoors import (
    COUNTRY,
    STREET,
    Matched,
    Raw,
    Scanner,
    country_room,
    ground_at,
    street_room,
)

GLASS, MIRROR = "window", "mirror"
"""Names of things that a depth sensor does not see: it looks through the first and into the second."""
BOXES = ("box", "crate", "suitcase")
NAMES = (*CLASS_NAMES, *BOXES, "rack", GLASS, MIRROR, "floor", "wall", "ceiling")
ALIKE = (
    ("sofa", "bed", "chair"), ("table", "desk", "cabinet", "shelf"), ("floor", "rug", "table"),
    ("wall", "cabinet", "picture"), ("mug", "vase", "bottle"), ("monitor", "picture", "mirror"),
    ("road", "sidewalk"), ("building", "fence"), ("pole", "tree", "person"), ("trail", "grass"), ("bush", "tree"),
    ("rock", "log"),
)  # fmt: skip
"""Names that an encoder confuses."""
ON_ROOF = np.array([0, 0, 0.3])
"""Meters from a vehicle's cameras to its scanner."""
Pose = NDArray[np.float64]
Sensor = Callable[[int, Random], Raw]


@dataclass(frozen=True)
class Place:
    """room: what stands where. poses(views, surfaces, rng): the camera path through it, (4, 4) camera-to-world each.

    names: of the classes. sensor(frames, intrinsics): what measures the cloud; None: points lie evenly on surfaces.
    soft: names of things that points also lie inside of.
    """

    room: Room
    poses: Callable[[int, Surfaces, Random], list[Pose]]
    names: tuple[str, ...] = NAMES
    sensor: Callable[[Sequence[Frame], Intrinsics], Sensor] | None = None
    soft: frozenset[str] = frozenset()


@dataclass(frozen=True)
class _Arc:
    """An arc around ``middle`` (3,), of ``angle`` radians centered on the side facing -y; radius, height in meters."""

    middle: tuple[float, float, float]
    angle: float
    radius: tuple[float, float]
    height: tuple[float, float]

    def __call__(self, views: int, surfaces: Surfaces, rng: Random) -> list[Pose]:
        poses = []
        for step in range(views):
            turn = -np.pi / 2 + self.angle * (step / max(views - 1, 1) - 0.5) + 0.02 * rng.normal()
            radius, height, target = rng.uniform(*self.radius), rng.uniform(*self.height), rng.normal(size=3)
            x, y, _ = self.middle
            eye = np.array([x + radius * np.cos(turn), y + radius * np.sin(turn), height])
            for _ in range(20):  # up, away from what is in the way
                if surfaces.distance_m(eye[None])[0] > 0.2:
                    break
                eye[2] += 0.1
            poses.append(looking_at(eye, np.array(self.middle) + 0.06 * target, 0.04 * rng.normal()))
        return poses


def _in_shell(rng: Random, items: list[Item], size: tuple[float, float, float]) -> Room:
    """Items in an otherwise empty room, whose four walls are separate things."""
    floor, walls, ceiling = shell(rng, size)
    return Room(size, tuple(items), (floor, *(Item("wall", (part,)) for part in walls.parts), ceiling))


def _grid(rng: Random, makers: list[Callable[[Random], Item]], pitch: float) -> list[Item]:
    """Things on the floor, ``pitch`` meters apart and a little off their places."""
    side = int(np.ceil(np.sqrt(len(makers))))
    items = []
    for index, maker in enumerate(makers):
        place = (np.array(divmod(index, side)) - (side - 1) / 2) * pitch + rng.uniform(-0.08, 0.08, 2) * pitch
        items.append(maker(rng).moved((*place, 0.0), rng.uniform(0, 2 * np.pi)))
    return items


def _box_item(rng: Random) -> Item:
    """A box of 20 to 45 cm, half of them with another one on top, as one thing."""
    width, depth, height = rng.uniform(0.2, 0.45, 3)
    parts = [box((width, depth, height), (0, 0, 0), paint(rng, 0.4))]
    if rng.uniform() < 0.5:
        parts.append(box((0.7 * width, 0.7 * depth, 0.7 * height), (0, 0, height), paint(rng, 0.4)))
    return Item(BOXES[rng.integers(len(BOXES))], tuple(parts))


def _rack(rng: Random) -> Item:
    """An upright grid of 8 mm bars, like a fence or a drying rack."""
    width, height, bars = rng.uniform(0.7, 1.0), rng.uniform(0.8, 1.1), int(rng.integers(7, 11))
    upright = [box((0.008, 0.008, height), (x, 0, 0), METAL) for x in np.linspace(-width / 2, width / 2, bars)]
    across = [box((width, 0.008, 0.008), (0, 0, z), METAL) for z in np.linspace(0.05, height, 5)]
    feet = [box((0.02, 0.4, 0.02), (x, 0, 0), METAL) for x in (-width / 2, width / 2)]
    return Item("rack", (*upright, *across, *feet))


def room(rng: Random, seed: int) -> Place:
    """The demo's furnished room, walked through twice."""
    made = furnish(seed)
    floor, walls, ceiling = made.shell
    made = replace(made, shell=(floor, *(Item("wall", (part,)) for part in walls.parts), ceiling))
    return Place(made, lambda views, surfaces, rng: walk(made, surfaces, views, rng))


def _in_the_way(item: Item) -> bool:
    """Whether it stands in the middle of the flat, where the doorway is."""
    xy = item.vertices[:, :2]
    return bool((xy.min(axis=0) < (0.7, 0.8)).all() and (xy.max(axis=0) > (-0.7, -0.8)).all())


def flat(rng: Random, seed: int) -> Place:
    """Two furnished rooms with a doorway between them, walked through at head height, looking a little down."""
    both = [furnish(seed), furnish(seed + 1000)]
    width = max(made.size[0] for made in both) + 0.2
    size = (2 * width, max(made.size[1] for made in both), 2.6)
    items = [
        item.moved((side * width / 2, 0, 0)) for side, made in zip((-1, 1), both, strict=True) for item in made.objects
    ]
    items = [item for item in items if not _in_the_way(item)]
    plain = _in_shell(rng, items, size)
    walls = [
        Item("wall", (box((0.1, size[1] / 2 - 0.5, 2.6), (0, side * (size[1] / 4 + 0.25), 0), paint(rng, 0.1)),))
        for side in (-1, 1)
    ]

    def poses(views: int, surfaces: Surfaces, rng: Random) -> list[Pose]:
        taken = []
        for step in range(views):
            turn = 4 * np.pi * step / views
            eye = np.array([0.55 * width * np.sin(turn / 2), 0.3 * np.sin(turn), 1.65 + 0.03 * rng.normal()])
            heading = turn + 1.5 * np.sin(2 * turn) + 0.2 * rng.normal()
            while surfaces.distance_m(eye[None])[0] < 0.25:
                eye[:2] *= 0.9  # moved towards the doorway
            ahead = np.array([np.cos(heading), np.sin(heading), -0.45 + 0.1 * rng.normal()])
            taken.append(looking_at(eye, eye + ahead, 0.03 * rng.normal()))
        return taken

    return Place(replace(plain, shell=(*plain.shell, *walls)), poses)


def _at_wall(rng: Random, group: Group, extra: list[Item], angle: float, distance: tuple[float, float]) -> Place:
    """A group with its back to a wall, seen from its front."""
    back = 2.0 - group.depth / 2 - 0.02
    made = _in_shell(rng, [item.moved((0, back, 0)) for item in (*group.items, *extra)], (5.0, 4.0, 2.6))
    top = max(item.vertices[:, 2].max() for item in group.items)
    return Place(made, _Arc((0.0, back, 0.5 * top), angle, distance, (0.4 * top, 0.9 * top + 0.5)))


def shelf(rng: Random, seed: int) -> Place:
    """An open shelf with small things, seen from in front."""
    return _at_wall(rng, shelf_group(rng), [], 1.6, (1.3, 2.0))


def shelf_bin(rng: Random, seed: int) -> Place:
    """The same from close up and nearly one place: one or two of its compartments."""
    return replace(shelf(rng, seed), poses=_Arc((0.0, 1.8, 0.75), 0.9, (0.75, 0.95), (0.8, 1.2)))


def desk(rng: Random, seed: int) -> Place:
    """A desk with monitor, lamp and small things, and a chair."""
    return _at_wall(rng, desk_group(rng), [], 1.8, (1.4, 2.0))


def glass(rng: Random, seed: int) -> Place:
    """A shelf behind a pane, through which the depth sensor looks."""
    pane = Item(GLASS, (box((0.8, 0.01, 1.1), (0.05, -0.3, 0.3), METAL),))
    return _at_wall(rng, shelf_group(rng), [pane], 1.8, (1.3, 2.0))


def mirror(rng: Random, seed: int) -> Place:
    """A sofa below a mirror, behind which the depth sensor finds a second room."""
    group = sofa_group(rng)
    frame = Item(MIRROR, (box((1.2, 0.03, 0.7), (0, group.depth / 2 - 0.015, 1.1), METAL),))
    return _at_wall(rng, group, [frame], 1.4, (1.6, 2.4))


def table(rng: Random, seed: int) -> Place:
    """A laid table with its chairs, from all around."""
    around = _Arc((0, 0, 0.6), 6, (1.7, 2.3), (1.2, 1.9))
    return Place(_in_shell(rng, list(dining_group(rng).items), (6, 6, 2.8)), around)


def board(rng: Random, seed: int) -> Place:
    """Small things on a table top, filmed from close up; the room around is far away."""
    height = 0.74
    makers = [mug, mug, bottle, vase, lying_book, lying_book, small_plant, mug, bottle]
    top = table_of("table", 1.3, 0.9, height, wood(rng))
    things = arranged(rng, makers, (0, 0, height), (1.25, 0.85), (4, 3))
    return Place(_in_shell(rng, [top, *things], (7, 7, 3)), _Arc((0, 0, height), 6, (0.9, 1.2), (1.1, 1.5)))


def still(rng: Random, seed: int) -> Place:
    """The same table top with the camera almost still."""
    return replace(board(rng, seed), poses=_Arc((0, 0, 0.78), 0.25, (0.9, 0.95), (1.2, 1.25)))


def boxes(rng: Random, seed: int) -> Place:
    """Boxes on a floor."""
    items = _grid(rng, [_box_item] * 12, 0.75)
    return Place(_in_shell(rng, items, (6, 6, 2.8)), _Arc((0, 0, 0.2), 6, (1.7, 2.4), (0.9, 1.8)))


def plants(rng: Random, seed: int) -> Place:
    """Potted plants and vases, whose leaves hide one another."""
    items = _grid(rng, [floor_plant, small_plant, vase, floor_plant, small_plant, floor_plant, vase, small_plant], 0.55)
    return Place(_in_shell(rng, items, (5, 5, 2.8)), _Arc((0, 0, 0.4), 6, (1.3, 1.9), (0.7, 1.6)))


def wires(rng: Random, seed: int) -> Place:
    """Racks of thin bars among boxes: most of what shows within a rack is behind it."""
    items = _grid(rng, [_rack, _box_item, _rack, _box_item, _box_item, _rack], 0.8)
    return Place(_in_shell(rng, items, (5, 5, 2.8)), _Arc((0, 0, 0.4), 6, (1.5, 2.1), (0.7, 1.6)))


def head_worn(rng: Random, seed: int) -> Place:
    """The flat by a head-worn camera; the wearer goes from thing to thing and looks at each from close up."""
    plain = flat(rng, seed)

    def poses(views: int, surfaces: Surfaces, rng: Random) -> list[Pose]:
        taken, half = [], np.array(plain.room.size[:2]) / 2 - 0.25
        objects = plain.room.objects
        while len(taken) < views:
            item = objects[rng.integers(len(objects))]
            middle = item.vertices.mean(axis=0)
            turn, height = rng.uniform(0, 2 * np.pi), rng.uniform(1.5, 1.7)
            for near in np.linspace(2.0, rng.uniform(0.4, 0.9), rng.integers(3, 7)):  # a few steps towards it
                turn += 0.15 * rng.normal()
                eye = np.array([middle[0] + near * np.cos(turn), middle[1] + near * np.sin(turn), height])
                bent = max(height - 0.5 * (2.0 - near), middle[2] + 0.3)
                eye[2] = min(bent, height) + 0.02 * rng.normal()
                if (np.abs(eye[:2]) < half).all() and surfaces.distance_m(eye[None])[0] > 0.25:
                    taken.append(looking_at(eye, middle + 0.2 * rng.normal(size=3), 0.08 * rng.normal()))
        return taken[:views]

    return replace(plain, poses=poses)


def _ahead(views: int, place: Callable[[float], np.ndarray], headings: Sequence[float], rng: Random) -> list[Pose]:
    """A vehicle's cameras at stops along a path; headings: where those of one stop look, degrees left of ahead.
    place(share): (3,) camera position at that share of the path."""
    poses, stops = [], -(-views // len(headings))
    for step in range(views):
        stop, heading = divmod(step, len(headings))
        share = (stop + 0.5) / stops
        eye, further = place(share), place(share + 0.02)
        course = np.arctan2(*(further - eye)[1::-1]) + np.radians(headings[heading] + 1.5 * rng.normal())
        ahead = np.array([np.cos(course), np.sin(course), -0.06 + 0.02 * rng.normal()])
        poses.append(looking_at(eye, eye + ahead, 0.01 * rng.normal()))
    return poses


def _scanner(
    room: Room, stops: Sequence[Frame], rng: Random, beams: int, soft: Mapping[str, float], *, colored: bool
) -> Scanner:
    """A scanner above the camera of each stop, each sweep a little off its place."""
    places = np.stack([frame.camera_to_world[:3, 3] + ON_ROOF for frame in stops])
    return Scanner(room, places, rng.normal(0, 0.03, places.shape), beams, soft, colored)


def _in_lane(share: float) -> Pose:
    return np.array([-28 + 46 * share, -1.6 + 0.2 * np.sin(9 * share), 1.65])


def drive(rng: Random, seed: int) -> Place:
    """A street by one camera looking ahead from a car; points are matched between photographs."""
    room = street_room(rng)
    return Place(
        room, lambda views, surfaces, rng: _ahead(views, _in_lane, (0,), rng), STREET,
        lambda frames, intrinsics: Matched(room, frames, intrinsics),
    )  # fmt: skip


def lidar(rng: Random, seed: int) -> Place:
    """A street by a 32-beam scanner on a car's roof and six cameras around it, at a few stops."""
    room, around, soft = street_room(rng), (0, 60, 120, 180, 240, 300), {"tree": 0.3}

    def sensor(frames: Sequence[Frame], intrinsics: Intrinsics) -> Sensor:
        return _scanner(room, frames[:: len(around)], rng, 32, soft, colored=True)

    def poses(views: int, surfaces: Surfaces, rng: Random) -> list[Pose]:
        return _ahead(views, lambda share: _in_lane(0.4 + 0.25 * share), around, rng)

    return Place(room, poses, STREET, sensor, frozenset(soft))


def country(rng: Random, seed: int) -> Place:
    """Rough country by a robot's scanner and a camera looking ahead, swaying."""
    room = country_room(rng)
    soft = {"grass": 0.15, "bush": 0.25, "tree": 0.3}

    def place(share: float) -> Pose:
        x, y = -25 + 40 * share, 0.8 * np.sin(7 * share)
        return np.array([x, y, ground_at(room, x, y) + 1.1])

    def poses(views: int, surfaces: Surfaces, rng: Random) -> list[Pose]:
        ahead = _ahead(views, place, (0,), rng)
        sway = [0.5 * rng.normal(size=3) for _ in ahead]
        return [
            looking_at(a[:3, 3], a[:3, 3] + 8 * a[:3, 2] + s, 0.05 * s[0]) for a, s in zip(ahead, sway, strict=True)
        ]

    def sensor(frames: Sequence[Frame], intrinsics: Intrinsics) -> Sensor:
        return _scanner(room, frames[::3], rng, 64, soft, colored=False)

    return Place(room, poses, COUNTRY, sensor, frozenset(soft))


PLACES: dict[str, Callable[[Random, int], Place]] = {
    "room": room, "flat": flat, "shelf": shelf, "bin": shelf_bin, "desk": desk, "glass": glass, "mirror": mirror,
    "table": table, "board": board, "still": still, "boxes": boxes, "plants": plants, "wires": wires,
    "walk": head_worn, "drive": drive, "lidar": lidar, "country": country,
}  # fmt: skip
"""By name; each is made from a random generator and that generator's seed."""
