"""Which of the usual conversions makes a capture fit: axes, direction, units, scale, intrinsics, neighboring frames.

All repairs that `KINDS` lists are tried on few views and points, and the best of them again on all that were read. A
repair is named only if it fits well, and far better than the files as they are. Numbers (a scale, a focal length) are
searched on a grid, then refined. Where none fits, each is tried again after repairing one of the commonest mistakes.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from og_pointcloud.checking.masks import MaskMaps
from og_pointcloud.checking.photographs import Photographs
from og_pointcloud.checking.registration import MORE_POINTS_PER_VIEW, Registration
from og_pointcloud.checking.sample import Comparison
from og_pointcloud.errors import SceneError
from og_pointcloud.formats.repairs import KINDS, MASK_FLIPS, MASK_SHIFTS, Repair

Repairs = tuple[Repair, ...]

COMMON_MISTAKES = "axes=flipped", "direction=inverse", "scale=1000", "scale=0.001", "frames=1", "frames=-1"
"""Mistakes that often come with a second one."""
FINALISTS = 8
"""How many of the best on few views and points are tried again on all."""
PHOTOGRAPHS_FIT, MASKS_FIT = (0.8, 0.4), (0.9, 0.18)
"""Least share and gap (`Comparison`) of a conversion that fits."""
MIN_COMPARISONS = 30
"""Fewer comparisons of masks are not convincing."""
MIN_GAP_GAIN = 0.1
"""By how much a conversion's gap must exceed that of the files as they are."""
STEPS_PER_DOUBLING = 8
"""Fine enough to bring the rendering to within a cell or two."""
ROUND_NUMBERS = (1000, 100, 10, 8, 4, 3, 2, 1.5, 1 / 0.3048, 2.54, 1)
"""Factors that units (millimeters, centimeters, feet, inches) and reduced images are off by."""
ROUND_TOLERANCE = 0.015
"""A number within this share of a round one, or of its reciprocal, is replaced by it, if that fits as well."""
MAX_ERROR_RATIO = 1.1
"""An error up to this many times the least counts as fitting as well."""


def best_conversion(evidence: Photographs | MaskMaps) -> Repairs:
    """The repairs of cameras that make photographs or masks fit; () if none does."""
    single = _best_of(evidence, _tried())
    if single or isinstance(evidence, MaskMaps):
        return single
    # No single word or number fits: try a small motion of all cameras, then two mistakes at once.
    registration = Registration(evidence, MORE_POINTS_PER_VIEW)
    moved = registration.repair("aligned", registration.refined("aligned", registration.best_change("aligned")))
    return moved if _convinces(evidence, moved) else _best_of(evidence, _pairs())


def _best_of(evidence: Photographs | MaskMaps, tried: Iterable[Repairs]) -> Repairs:
    """The best of the tried repairs, if it convinces; else ()."""
    # Hundreds are tried, so first on little evidence; ranked by gap, as several may win every comparison.
    few = evidence.fewer()
    finalists = sorted(tried, key=lambda repairs: -_fit(few, repairs).gap)[:FINALISTS]
    best = max(finalists, key=lambda repairs: _fit(evidence, repairs).gap)
    best = _polished(best, evidence) if isinstance(evidence, Photographs) else best
    return best if _convinces(evidence, best) else ()


def best_mask_conversion(maps: MaskMaps) -> Repairs:
    """The repair of masks that makes them agree; () if none does."""
    cameras = maps.sample.cameras
    fits: dict[Repairs, Comparison] = {}
    for value, flip in MASK_FLIPS.items():
        fits[_parsed(f"masks={value}")] = replace(maps, ids=[flip(ids) for ids in maps.ids]).fit(cameras)
    for value, by in MASK_SHIFTS.items():  # equivalent to giving these masks the neighbor's camera
        fits[_parsed(f"masks={value}")] = _fit(maps, _parsed(f"frames={-by}"))
    best = max(fits, key=lambda repairs: fits[repairs].gap)
    better = fits[best].gap > maps.fit(cameras).gap + MIN_GAP_GAIN / 2  # the gaps of masks are half as large: MASKS_FIT
    return best if better and fits[best].compared >= MIN_COMPARISONS and fits[best].reaches(MASKS_FIT) else ()


def _tried() -> Iterable[Repairs]:
    """Every repair of cameras by one word or one number, and both mistakes of axes at once."""
    flipped, inverse = "axes=flipped", "direction=inverse"
    for name, kind in KINDS.items():
        if name not in ("masks", "lens"):
            yield from (_parsed(f"{name}={word}") for word in kind.words)
        steps = np.arange(1, kind.doublings * STEPS_PER_DOUBLING + 1) / STEPS_PER_DOUBLING
        yield from (_parsed(f"{name}={value:.6g}") for value in 2.0 ** np.concatenate([-steps, steps]))
    yield from map(_parsed, (f"{flipped} {inverse}", f"{inverse} {flipped}", f"{flipped} {inverse} {flipped}"))


def _pairs() -> Iterable[Repairs]:
    """Every repair after one of the commonest. Two of different kinds are nearly the same in either order."""
    for first in map(_parsed, COMMON_MISTAKES):
        yield from (first + repairs for repairs in _tried() if repairs[0].name != first[0].name)


def _parsed(words: str) -> Repairs:
    return tuple(map(Repair.parse, words.split()))


def _fit(evidence: Photographs | MaskMaps, repairs: Repairs) -> Comparison:
    """The fit with the cameras repaired; an empty comparison where the repairs make no sense."""
    try:
        return evidence.fit(evidence.sample.repaired(repairs))
    except SceneError:
        return Comparison.of([], "")


def _polished(repairs: Repairs, photographs: Photographs) -> Repairs:
    """The repairs with the last one's number refined, and rounded where that fits as well."""
    *before, repair = repairs
    if not KINDS[repair.name].doublings:
        return repairs

    def error(value: float) -> float:
        return 1 - _fit(photographs, (*before, *_parsed(f"{repair.name}={value:.6g}"))).own

    value = repair.numbers[0]
    # Three searches around the best so far, from the grid's step (9%) down to a twentieth of a percent.
    for width, count in ((0.06, 6), (0.01, 5), (0.002, 4)):
        value = float(min(value * (1 + width * np.linspace(-1, 1, 2 * count + 1)), key=error))
    for round_one in (number**sign for number in ROUND_NUMBERS for sign in (1, -1)):
        if abs(value / round_one - 1) < ROUND_TOLERANCE and error(round_one) <= MAX_ERROR_RATIO * error(value):
            value = round_one
            break
    return (*before, *_parsed(f"{repair.name}={value:.5g}"))


def _convinces(evidence: Photographs | MaskMaps, repairs: Repairs) -> bool:
    stated, found = _fit(evidence, ()), _fit(evidence, repairs)
    enough = PHOTOGRAPHS_FIT if isinstance(evidence, Photographs) else MASKS_FIT
    few = isinstance(evidence, MaskMaps) and found.compared < MIN_COMPARISONS
    return not few and found.reaches(enough) and found.gap > stated.gap + MIN_GAP_GAIN
