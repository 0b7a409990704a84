"""The furnished room: which groups stand where. Seeded; objects rest on supports and keep clear of each other.

Frame: meters, z up, the floor at z = 0, the origin in the middle of the floor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from og_pointcloud_room.furniture import (
    Group,
    Item,
    Random,
    bed_group,
    cabinet_group,
    desk_group,
    dining_group,
    floor_lamp,
    floor_plant,
    picture,
    shelf_group,
    sofa_group,
)
from og_pointcloud_room.shapes import Material, box

WALL_GAP = 0.02
CORNER = 0.5
"""Side of the square kept free in each corner, for a floor lamp or a plant."""


@dataclass(frozen=True)
class Room:
    """size: (x, y, z) meters. objects: the instances, in the order of their ids. shell: floor, walls and ceiling."""

    size: tuple[float, float, float]
    objects: tuple[Item, ...]
    shell: tuple[Item, ...]


def furnish(seed: int = 0) -> Room:
    """A room of about 5 x 4.5 m with 30 to 40 objects; layout, sizes and colors follow the seed."""
    rng = np.random.default_rng([seed, 0])
    size = (rng.uniform(4.9, 5.3), rng.uniform(4.6, 4.9), 2.6)
    makers = [sofa_group, shelf_group, cabinet_group, bed_group if rng.uniform() < 0.5 else desk_group]
    at_walls = [makers[index](rng) for index in rng.permutation(4)]
    objects = [item for wall, group in enumerate(at_walls) for item in _against_wall(rng, group, wall, at_walls, size)]
    objects += _in_the_middle(rng, dining_group(rng), at_walls, size)
    for maker, corner in zip((floor_lamp, floor_plant), rng.permutation(4), strict=False):
        signs = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)][corner])
        place = signs * (np.array(size[:2]) / 2 - CORNER / 2 - 0.05)
        objects.append(maker(rng).moved((*place, 0.0)))
    return Room(size, tuple(objects), shell(rng, size))


def _against_wall(
    rng: Random, group: Group, wall: int, at_walls: list[Group], size: tuple[float, float, float]
) -> list[Item]:
    """The group with its back to wall 0 (+y), 1 (-x), 2 (-y) or 3 (+x), clear of the neighboring walls' groups."""
    length, reach = (size[0], size[1]) if wall % 2 == 0 else (size[1], size[0])
    right, left = (max(at_walls[(wall + step) % 4].depth, CORNER) + 0.03 for step in (3, 1))
    along = rng.uniform(-length / 2 + left + group.width / 2, length / 2 - right - group.width / 2)
    yaw = wall * np.pi / 2
    items = list(group.items)
    if group.carries_picture:
        items.append(picture(rng).moved((0, group.depth / 2 + WALL_GAP, rng.uniform(1.5, 1.65))))
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    place = turn @ (along, reach / 2 - group.depth / 2 - WALL_GAP)
    return [item.moved((*place, 0.0), yaw) for item in items]


def _in_the_middle(
    rng: Random, group: Group, at_walls: list[Group], size: tuple[float, float, float]
) -> tuple[Item, ...]:
    """The group placed somewhere in the rectangle that the groups at the walls leave free."""
    up, left, down, right = (wall_group.depth + 2 * WALL_GAP for wall_group in at_walls)
    center = np.array([left - right, down - up]) / 2
    free = np.array([size[0] - left - right, size[1] - up - down])
    slack = np.maximum(free - (group.width, group.depth), 0) / 2
    return group.moved((*(center + rng.uniform(-1, 1, 2) * np.minimum(slack, 0.2)), 0.0))


def shell(rng: Random, size: tuple[float, float, float]) -> tuple[Item, ...]:
    """Plank floor, four walls and the ceiling, all outside the room's box."""
    x, y, z = size
    tone = rng.uniform(0.7, 0.9)
    plank = Material((tone * 0.9, tone * 0.68, tone * 0.45), (tone * 0.68, tone * 0.48, tone * 0.3), (1.2, 0.1, 1.0))
    plaster = Material((0.87, 0.86, 0.82), tuple(rng.uniform(0.72, 0.82, 3)), (0.35, 0.35, 0.35))
    white = Material((0.93, 0.93, 0.92), (0.88, 0.88, 0.87), (0.5, 0.5, 0.5))
    walls = [box((x + 0.2, 0.1, z), (0, side * (y / 2 + 0.05), 0), plaster) for side in (-1, 1)]
    walls += [box((0.1, y, z), (side * (x / 2 + 0.05), 0, 0), plaster) for side in (-1, 1)]
    floor, ceiling = box((x + 0.2, y + 0.2, 0.1), (0, 0, -0.1), plank), box((x + 0.2, y + 0.2, 0.1), (0, 0, z), white)
    return (Item("floor", (floor,)), Item("wall", tuple(walls)), Item("ceiling", (ceiling,)))
