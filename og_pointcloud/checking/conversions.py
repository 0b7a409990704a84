"""Which of the usual conversions makes a capture fit: axes, direction, units, scale, intrinsics, neighbouring frames.

Each is tried on a few views and points; the best one is tried again on all that were read, and named only if it fits
well and far better than what the files say. Numbers (a scale, a focal length) are searched on a grid, then more finely.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from og_pointcloud.checking.masks import Consistency, MaskMaps
from og_pointcloud.checking.photographs import Photographs
from og_pointcloud.checking.registration import FREE, MORE_POINTS, Registration
from og_pointcloud.checking.sample import Sample
from og_pointcloud.errors import SceneError
from og_pointcloud.formats.repairs import SHIFTS, WORLDS, Repair, repaired_ids
from og_pointcloud.scene import Camera

__all__ = ["VOUCHING", "best_conversion", "best_mask_conversion", "fits"]

Repairs = tuple[Repair, ...]
Score = Callable[[Sequence[Camera]], float]

TRIED_VIEWS, TRIED_POINTS = 8, 4000
PHOTOGRAPHS_FIT = (0.8, 0.4, 0.5)
"""Share of comparisons, gap and correlation from which a conversion fits."""
MASKS_FIT, VOUCHING = (0.9, 0.18), (0.85, 0.15)
"""Share and gap from which it does by masks; and from which masks vouch for poses that photographs doubt."""
FEWEST_COMPARED = 30
BETTER = 0.1
"""It fits by so much more than what the files say, of a correlation or of mutual information."""
STEPS_PER_DOUBLING = 6
"""A grid this fine brings the drawing to within a cell or two."""
ROUND_NUMBERS = (1000, 100, 10, 8, 4, 3, 2, 1.5, 1 / 0.3048, 2.54, 1)
ROUND = 0.015
"""A number within this share of a round one, or of its reciprocal, is the round one, if that fits as well."""
CLOSE = 1.1
"""Errors up to so many times the least one are as good."""
SPANS = {"scale": 11, "intrinsics": 4, "focal": 5}
"""Doublings and halvings that are tried."""


def fits(found: Consistency, needed: tuple[float, float] = MASKS_FIT) -> bool:
    """Whether masks agree so far."""
    return found.compared >= FEWEST_COMPARED and found.share >= needed[0] and found.gap >= needed[1]


def best_conversion(photographs: Photographs | None, maps: MaskMaps | None) -> Repairs:
    """The repairs of cameras that make the capture fit, by its photographs or else by its masks; () if none does."""
    score: Score
    if photographs is not None:
        few = photographs.fewer(TRIED_VIEWS, TRIED_POINTS)
        sample, score = few.sample, lambda cameras: few.likeness(cameras).own
    elif maps is not None:
        masks = maps.fewer(TRIED_VIEWS, TRIED_POINTS)
        sample, score = masks.sample, lambda cameras: masks.agreement(cameras).gap
    else:
        return ()
    for tried in (_alone(), _together()):
        best = max(tried, key=lambda repairs: _score(sample, repairs, score))
        if photographs is not None:
            best = _polished(best, photographs)
        if _convinces(best, photographs, maps):
            return best
    if photographs is not None and _convinces(moved := _moved(photographs), photographs, maps):
        return moved
    return ()


def _moved(photographs: Photographs) -> Repairs:
    """The cameras moved as a whole so that photographs fit best."""
    registration = Registration(photographs, photographs.sample.cameras, MORE_POINTS)
    centers = np.stack([camera.center for camera in photographs.sample.listed])
    return registration.repairs("aligned", registration.found(FREE["aligned"]), centers)


def best_mask_conversion(maps: MaskMaps) -> Repairs:
    """The repair of masks that makes them agree; () if none does."""
    cameras = maps.sample.cameras
    found: dict[Repairs, Consistency] = {}
    for value in ("mirrored", "upside-down", "turned", "next", "previous"):
        repair = Repair.parse(f"masks={value}")
        if value not in SHIFTS:
            ids = [repaired_ids(map_, repair) for map_ in maps.ids]  # flips alone: rows do not change
            found[repair,] = maps.with_ids(ids).agreement(cameras)
        elif len(maps.ids) == len(maps.sample.listed):
            ids = maps.ids[SHIFTS[value] :] + maps.ids[: SHIFTS[value]]
            found[repair,] = maps.with_ids(ids).agreement(cameras)
        else:  # the neighbour's masks were not read; its camera with this one's masks tells the same
            moved = maps.sample.repaired([Repair.parse(f"frames={-SHIFTS[value]}")])
            found[repair,] = maps.agreement(moved)
    best = max(found, key=lambda repairs: found[repairs].gap)
    stated = maps.agreement(cameras)
    return best if fits(found[best]) and found[best].gap > stated.gap + BETTER / 2 else ()


def _alone() -> list[Repairs]:
    words = [
        "axes=flipped", "direction=inverse", "axes=flipped direction=inverse", "direction=inverse axes=flipped",
        "axes=flipped direction=inverse axes=flipped", "quaternions=xyzw", "frames=1", "frames=-1", "center=swapped",
        "center=middle",
    ]  # fmt: skip
    words += [f"world={world}" for world in WORLDS if world != "x,y,z"]
    for name, span in SPANS.items():
        steps = np.arange(-span * STEPS_PER_DOUBLING, span * STEPS_PER_DOUBLING + 1)
        words += [f"{name}={value:.6g}" for value in 2.0 ** (steps[steps != 0] / STEPS_PER_DOUBLING)]
    return _parsed(words)


def _together() -> list[Repairs]:
    """Two mistakes at once, the commonest ones."""
    camera = ("axes=flipped", "direction=inverse", "axes=flipped direction=inverse", "direction=inverse axes=flipped")
    units = ("scale=1000", "scale=0.001", "intrinsics=2", "intrinsics=4", "intrinsics=0.5")
    words = [f"{first} {other}" for first in camera for other in (*(f"world={world}" for world in WORLDS), *units)]
    return _parsed([*words, *(f"world={world} {unit}" for world in WORLDS for unit in units[:2])])


def _parsed(words: Iterable[str]) -> list[Repairs]:
    return [tuple(map(Repair.parse, word.split())) for word in words]


def _score(sample: Sample, repairs: Repairs, score: Score) -> float:
    try:
        return score(sample.repaired(repairs))
    except SceneError:  # a matrix that is no pose
        return -1.0


def _polished(repairs: Repairs, photographs: Photographs) -> Repairs:
    """The number of a repair, searched more finely, and made a round one where that fits as well."""
    repair = repairs[0]
    if repair.name not in SPANS:
        return repairs

    sample = photographs.sample

    def error(value: float) -> float:
        return registration.error(sample.repaired([Repair.parse(f"{repair.name}={value:.6g}")]))

    registration = Registration(photographs, sample.repaired(repairs))
    value = repair.numbers[0]
    for width, count in ((0.06, 6), (0.01, 5), (0.002, 4)):
        tried = value * (1 + width * np.linspace(-1, 1, 2 * count + 1))
        value = float(min(tried, key=error))
    for round_one in (number**sign for number in ROUND_NUMBERS for sign in (1, -1)):
        if abs(value / round_one - 1) < ROUND and error(round_one) <= CLOSE * error(value):
            value = round_one
            break
    return (Repair.parse(f"{repair.name}={value:.5g}"),)


def _convinces(repairs: Repairs, photographs: Photographs | None, maps: MaskMaps | None) -> bool:
    try:
        if photographs is not None:
            stated, found = (photographs.likeness(photographs.sample.repaired(each)) for each in ((), repairs))
            enough = min(np.array([found.share, found.gap, found.own]) / PHOTOGRAPHS_FIT) >= 1
            return enough and found.own > stated.own + BETTER
        assert maps is not None
        said, meant = (maps.agreement(maps.sample.repaired(each)) for each in ((), repairs))
        return fits(meant) and meant.gap > said.gap + BETTER
    except SceneError:
        return False
