"""The room on two days, as frames of a depth camera with masks: a chair was moved, a bottle left, a ball came."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

import og_pointcloud as og
from og_pointcloud_room.capture import looking_at, mask_features
from og_pointcloud_room.features import FEATURE_SPACE, FeatureModel
from og_pointcloud_room.furniture import CLASS_NAMES, ball
from og_pointcloud_room.masks import MaskNoise, propose_masks
from og_pointcloud_room.raycast import Intrinsics, RayCaster, Surfaces
from og_pointcloud_room.robot import centered, free_floor, ring
from og_pointcloud_room.room import Room, furnish
from og_pointcloud_room.shapes import Material

NAMES = (*CLASS_NAMES, "ball")
RED = Material((0.8, 0.15, 0.1), (0.7, 0.1, 0.1), (0.2, 0.2, 0.2))
INTRINSICS = Intrinsics(320, 240, 230.0)
FRAMES, DAYS_APART_S = 60, 86_400.0


@dataclass(frozen=True)
class _Day:
    """room: what stands there. looks: (objects,) int, each object's number among those of both days."""

    room: Room
    looks: np.ndarray


class TwoDays:
    """before, after: the frames of one walk each. model: the encoder; its texts are of NAMES. changed: what moved, left
    and came, by name. places: (3,) middle of each, by "gone", "new", "from" and "to"."""

    feature_space = FEATURE_SPACE

    def __init__(self, seed: int = 0, frames: int = FRAMES) -> None:
        room, rng = furnish(seed), np.random.default_rng([seed, 20])
        self.model = FeatureModel(len(NAMES), rng)
        self._objects = (*room.objects, ball(0.2, 24, RED))
        self._looks = [self.model.object_look(rng) for _ in self._objects]
        count, path = len(room.objects), ring(room)
        names = [item.name for item in room.objects]
        chair, bottle = names.index("chair"), next(k for k, name in enumerate(names) if name in ("bottle", "vase"))
        now, taken, surfaces = dict(enumerate(room.objects)), np.full((1, 2), np.inf), Surfaces(room.objects)
        places = {"gone": now.pop(bottle).middle, "from": room.objects[chair].middle}
        for which, item in ((chair, centered(room.objects[chair])), (count, self._objects[-1])):
            place = free_floor(room, surfaces, path, taken)
            now[which], taken = item.moved((*place, 0.0)), np.concatenate([taken, place[None]])
        self.places = {**places, "to": now[chair].middle, "new": now[count].middle}
        today = replace(room, objects=tuple(now.values()))
        self.before = self._walked(_Day(room, np.arange(count)), frames, rng, 0.0)
        self.after = self._walked(_Day(today, np.array([*now])), frames, rng, DAYS_APART_S)
        self.room, self.changed = room, {"moved": "chair", "gone": names[bottle], "new": "ball"}

    def _walked(self, day: _Day, frames: int, rng: np.random.Generator, stamp: float) -> list[og.Frame]:
        caster, half = RayCaster(day.room, rng), np.array(day.room.size[:2]) / 2
        kinds = np.array([NAMES.index(item.name) for item in day.room.objects])
        looks, noise, made = np.array(self._looks)[day.looks], MaskNoise(), []
        for number, angle in enumerate(np.linspace(0, 2 * np.pi, frames, endpoint=False)):
            around = np.array([np.cos(angle), np.sin(angle)])
            eye = np.array([*(0.45 * half * around), 1.6 + 0.15 * np.sin(5 * angle)])
            pose = looking_at(eye, np.array([*(-0.75 * half * around), 0.3]), roll=0.0)
            seen = caster.look(INTRINSICS, pose)
            ids = propose_masks(seen.owner, noise, rng)
            rows = mask_features(ids, seen.owner, kinds, looks, self.model, noise.wrong_class, rng)
            depth = seen.depth_m + 0.003 * rng.normal(size=seen.depth_m.shape).astype(np.float32)
            camera, masks = INTRINSICS.camera(pose), ids.astype(np.int32) - 1
            made.append(og.Frame(camera, masks, rows, depth, rgb=seen.image, stamp=stamp + number / 3))
        return made
