"""The random parameters of each scene of the zoo. The same name gives the same scene on every machine.

A kind fixes the parameters it is about and leaves the rest to chance. Each has two scenes: number 0 is for choosing,
number 1 for judging only. For scenes given by path the last digit of the name decides: even for choosing, odd or none
for judging; captures on which today's numbers were chosen are for choosing.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

SETTLED = ("seven_redkitchen", "apc_shelf_B", "ycb_0050", "nuscenes_frame")
"""Captures that constants were chosen on before there was a zoo."""


@dataclass(frozen=True)
class Draw:
    """One scene. place: of `places.PLACES`, "street", or "demo", the demo's own capture with its fused cloud.

    points: of the cloud. views: number of images; width, height: of an image, pixels. noise: of points across their
    surface, standard deviation in spacings. uneven: density at the walls is exp(-uneven) times that in the middle.
    backdrop: density of floor, walls and ceiling relative to that of things. outliers: share of points placed anywhere;
    floaters: share of points between a camera and what it sees. hidden: share of the surfaces seen by no view that is
    in the cloud all the same. all_masked: floor, walls and ceiling have masks and classes too; else they are known
    background. split, merge, miss, spurious, wrong_class, edge_px: how the proposer errs (`MaskNoise`). spans: number
    of things that share their mask with a neighbor in all views. taken: number of things gone in the second half of the
    views. levels: each view comes three times, with masks of parts, of things, and of things with what stands on them.
    confused: mean share of a thing's masks that are named as something alike (`places.ALIKE`); for a single thing from
    none to twice that. blurred: share of views whose masks are ragged and often missing, as from a moving camera.
    swallow: probability that something without a mask lies in the mask of what it stands on or before.
    """

    name: str
    place: str
    seed: int
    points: int
    views: int
    width: int
    height: int
    noise: float
    uneven: float
    backdrop: float
    outliers: float
    floaters: float
    hidden: float
    all_masked: bool
    split: float
    merge: float
    miss: float
    spurious: float
    wrong_class: float
    edge_px: float
    spans: int = 0
    taken: int = 0
    levels: bool = False
    confused: float = 0.0
    blurred: float = 0.0
    swallow: float = 0.0


Fixed = Mapping[str, Any]
SFM: Fixed = {"points": (8_000, 20_000), "noise": (0.1, 0.4), "backdrop": (0.002, 0.008), "floaters": (0.005, 0.02),
              "hidden": (0, 0)}  # fmt: skip

MEASURED: Fixed = {"all_masked": True, "noise": (0, 0), "uneven": (0, 0), "hidden": (1, 1), "merge": (0.0, 0.03)}
"""For places outdoors: their sensors bring noise and uneven density themselves, and see what no camera does."""

KINDS: Mapping[str, Fixed] = {
    "room": {"place": "room", "all_masked": False},
    "room-masked": {"place": "room", "all_masked": True},
    "room-noisy": {"place": "room", "all_masked": False, "noise": (1.5, 3.0), "outliers": (0.001, 0.004)},
    "room-sparse": {"place": "room", "points": (5_000, 8_000), "uneven": (0.5, 1.5)},
    "room-oversegmented": {"place": "room", "split": (0.5, 0.8)},
    "room-undersegmented": {"place": "room", "merge": (0.25, 0.45)},
    "room-missed": {"place": "room", "all_masked": False, "miss": (0.4, 0.7), "wrong_class": (0.15, 0.3)},
    "detector": {
        "place": "room",
        "all_masked": False,
        "miss": (0.3, 0.5),
        "wrong_class": (0.3, 0.45),
        "split": (0.2, 0.4),
        "merge": (0.1, 0.2),
    },
    "swallowed": {"place": "room", "all_masked": False, "miss": (0.3, 0.5), "swallow": (0.5, 1.0)},
    "swallowed-masked": {"place": "room", "all_masked": True, "miss": (0.3, 0.5), "swallow": (0.5, 1.0)},
    "room-changing": {"place": "room", "taken": (4, 7)},
    "million": {"place": "room", "points": (1_000_000, 1_000_000), "views": (16, 20), "width": (320, 320)},
    "many-views": {"place": "desk", "views": (180, 200), "width": (160, 160)},
    "large-images": {"place": "table", "views": (10, 12), "width": (1280, 1280)},
    "flat": {"place": "flat", "views": (40, 60), "points": (60_000, 100_000)},
    "shelf": {"place": "shelf"},
    "bin": {"place": "bin", "views": (10, 15), "noise": (1.0, 2.5), "all_masked": False},
    "desk": {"place": "desk"},
    "table": {"place": "table"},
    "board": {"place": "board", **SFM},
    "board-dense": {"place": "board", "all_masked": False},
    "still": {"place": "still", "views": (12, 20), "hidden": (0, 0)},
    "boxes": {"place": "boxes"},
    "plants": {"place": "plants"},
    "wires": {"place": "wires"},
    "glass": {"place": "glass"},
    "mirror": {"place": "mirror"},
    "levels": {"place": "desk", "levels": True, "views": (16, 24)},
    "spanning": {"place": "shelf", "spans": (3, 4)},
    "street": {"place": "street", "points": (40_000, 120_000), "views": (24, 40), "width": (480, 480)},
    "walk": {
        "place": "walk",
        "all_masked": True,
        "views": (90, 130),
        "points": (60_000, 100_000),
        "width": (320, 480),
        "confused": (0.2, 0.35),
        "blurred": (0.2, 0.4),
    },
    "drive": {
        "place": "drive",
        "points": (12_000, 30_000),
        "views": (50, 80),
        "width": (480, 640),
        "floaters": (0.01, 0.03),
        "confused": (0.05, 0.15),
        **MEASURED,
        "hidden": (0, 0),
    },
    "lidar": {
        "place": "lidar",
        "points": (30_000, 60_000),
        "views": (6, 18),
        "width": (480, 640),
        "confused": (0.05, 0.15),
        **MEASURED,
    },
    "offroad": {
        "place": "country",
        "points": (40_000, 80_000),
        "views": (24, 40),
        "width": (400, 560),
        "edge_px": (1.5, 3.0),
        "confused": (0.1, 0.25),
        **MEASURED,
    },
    "demo": {"place": "demo", "views": (30, 40), "width": (320, 480)},
}
"""Name -> the parameters it fixes: one value, or the range that it is drawn from."""
ANY: Fixed = {
    "points": (10_000, 80_000), "views": (16, 44), "width": (240, 640), "noise": (0.0, 1.0), "uneven": (0.0, 1.2),
    "backdrop": (0.3, 1.0), "outliers": (0.0, 0.002), "floaters": (0.0, 0.002), "hidden": (0.0, 0.5),
    "split": (0.05, 0.25), "merge": (0.0, 0.08), "miss": (0.05, 0.2), "spurious": (0.0, 0.1),
    "wrong_class": (0.02, 0.1), "edge_px": (0.3, 1.2),
}  # fmt: skip
"""The ranges of parameters that a kind leaves to chance. Whole numbers are drawn log-uniformly."""


def scene_names() -> list[str]:
    """The names of all scenes, the two of a kind side by side."""
    return [f"{kind}-{number}" for kind in KINDS for number in (0, 1)]


def draw(name: str) -> Draw:
    """The scene with a name of `scene_names`; KeyError for any other."""
    kind, number = name[:-2], name[-2:]
    if kind not in KINDS or number not in ("-0", "-1"):
        raise KeyError(name)
    seed = zlib.crc32(name.encode()) % 10_000
    rng = np.random.default_rng([seed, 99])
    # Each number has its own draw, even where the kind fixes it: fixing another one leaves the rest unchanged.
    fixed = KINDS[kind]
    numbers: dict[str, Any] = {"all_masked": bool(rng.uniform() < 0.35)}
    for key, usual in ANY.items():
        numbers[key] = _between(fixed.get(key, usual), rng.uniform())
    for key in ("spans", "taken", "confused", "blurred", "swallow"):
        if key in fixed:
            numbers[key] = _between(fixed[key], rng.uniform())
    numbers.update({key: fixed[key] for key in ("place", "all_masked", "levels") if key in fixed})
    numbers["width"] = 16 * round(numbers["width"] / 16)
    return Draw(name=name, seed=seed, height=3 * numbers["width"] // 4, **numbers)


def _between(limits: tuple[float, float], share: float) -> float:
    """The value at this share of the range; whole numbers on a logarithmic scale."""
    low, high = limits
    if isinstance(low, int) and low > 0:
        return round(low * (high / low) ** share)
    return round(low + share * (high - low), 6)


def half_of(name: str) -> str:
    """ "choose" or "judge": which half a scene is in, by its name alone."""
    digits = re.findall(r"\d", name)
    even = bool(digits) and int(digits[-1]) % 2 == 0
    return "choose" if even or name in SETTLED else "judge"


def is_chosen(name: str, half: str | None, beginnings: Sequence[str]) -> bool:
    """Whether a scene is in a half (None: either), and its name begins with one of ``beginnings``, if there are any."""
    return half in (None, half_of(name)) and name.startswith(tuple(beginnings) or "")
