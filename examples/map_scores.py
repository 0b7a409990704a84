"""Scores of changes between two visits against what really changed: change recall, precision, F1, identity."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import og_pointcloud as og
from og_pointcloud.formats.poses import in_local_frame
from og_pointcloud.mapping.presence import Visit
from og_pointcloud.mapping.sight import AGREES, THROUGH, states_of_points

FEWEST_POINTS = 20
"""A thing is not scored if a visit's views see fewer of its points than this: that visit does not show it."""
LOOKED_AT = 0.3
"""A thing that left counts if the later visit looks at this share of its place."""
OVERLAP = 0.1
"""IoU of points above which an instance matches a thing."""
NEAR_M = 0.3
"""Distance of centroids up to which a thing was found at its new place."""


@dataclass
class PairScore:
    """changes, found: things that changed, and those reported. moved, followed: moved things, and those with the right
    id and place. reported, right: entries of the report, and those that name a thing that changed. errors: in words."""

    changes: int = 0
    found: int = 0
    moved: int = 0
    followed: int = 0
    reported: int = 0
    right: int = 0
    errors: list[str] = field(default_factory=list)

    def __add__(self, other: PairScore) -> PairScore:
        names = ("changes", "found", "moved", "followed", "reported", "right", "errors")
        return PairScore(*(getattr(self, name) + getattr(other, name) for name in names))

    @property
    def figures(self) -> dict[str, float]:
        """Change recall, precision, F1, and the share of moved things that kept their id."""
        recall, precision = self.found / max(self.changes, 1), self.right / max(self.reported, 1)
        return {
            "recall": recall, "precision": precision, "f1": 2 * recall * precision / max(recall + precision, 1e-9),
            "identity": self.followed / max(self.moved, 1),
        }  # fmt: skip


def things_of(cloud: og.LabelledCloud, truth_xyz: NDArray[np.float64], thing: NDArray[np.integer]) -> list[set[int]]:
    """For each instance id of a cloud, the true things whose shown points overlap its own by an IoU above 0.1, and the
    one that it is mostly a piece of."""
    from scipy.spatial import cKDTree

    nearest = cKDTree(truth_xyz).query(cloud.xyz_world, workers=-1)[1]
    of_point = thing[nearest]
    both = (cloud.instance_ids >= 0) & (of_point >= 0)
    count = max(int(thing.max()) + 1, 1)
    shared = np.bincount(cloud.instance_ids[both] * count + of_point[both], minlength=len(cloud.instances) * count)
    shared = shared.reshape(-1, count)
    union = shared.sum(axis=1, keepdims=True) + np.bincount(of_point[of_point >= 0], minlength=count) - shared
    own = shared.sum(axis=1, keepdims=True)
    return [set(np.flatnonzero(of).tolist()) for of in (shared > OVERLAP * union) | (shared > own / 2)]


def score_pair(
    folder: Path, report: dict[str, Any], before: og.LabelledCloud, visit: og.LabelledCloud, after: og.LabelledCloud
) -> PairScore:
    """A pair of rooms, ``a`` and ``b`` with changes.json, against a report's JSON.

    before: the cloud that ids of gone, moved and unseen refer to. after: that of new ids. visit: ``b`` alone.
    """
    events = json.loads((folder / "b" / "changes.json").read_text())["changes"]
    truth = [np.load(folder / name / "gt.npz") for name in "ab"]
    xyz = [og.read_points(folder / name / "points.ply").xyz_world for name in "ab"]
    shown = [np.where(gt["views"] > 0, gt["instance"], -1) for gt in truth]
    counts = [np.bincount(of[of >= 0], minlength=1000) for of in shown]
    looked_at = _looked_at(visit, xyz[0], shown[0])
    thing_before = things_of(before, xyz[0], shown[0])
    thing_after = things_of(after, xyz[1], shown[1])
    score = PairScore()
    left = {event["was"]: event for event in events if "was" in event}
    came = {event["now"]: event for event in events if "now" in event}
    moved = {entry["id"]: entry for entry in report["moved"]}
    gone_things = set().union(*(thing_before[k] for k in (*report["gone"], *moved)))
    new_things = set().union(*(thing_after[k] for k in report["new"]))
    for event in events:
        was, now = event.get("was"), event.get("now")
        before_shown = was is not None and counts[0][was] >= FEWEST_POINTS and looked_at.get(was, 0) >= LOOKED_AT
        after_shown = now is not None and counts[1][now] >= FEWEST_POINTS
        if event["kind"] == "moved" and before_shown and after_shown:
            place = xyz[1][truth[1]["instance"] == now].mean(axis=0)
            right = [e for k, e in moved.items() if was in thing_before[k] and np.linalg.norm(place - e["to"]) < NEAR_M]
            score.moved, score.followed = score.moved + 1, score.followed + bool(right)
            if not right:
                score.errors.append(f"{folder.name}: moved {event['name']} {was} -> {now} not followed")
        if before_shown or (after_shown and was is None):
            found = was in gone_things if was is not None else now in new_things
            score.changes, score.found = score.changes + 1, score.found + found
            if not found:
                score.errors.append(f"{folder.name}: missed {event}")
    moved_things = {was for was, event in left.items() if event["kind"] == "moved"}
    entries = [("gone", thing_before[k] & set(left), k, thing_before[k]) for k in report["gone"]]
    entries += [("new", thing_after[k] & set(came), k, thing_after[k]) for k in report["new"]]
    entries += [("moved", thing_before[k] & moved_things, k, thing_before[k]) for k in moved]
    for kind, right, k, thing in entries:
        score.reported, score.right = score.reported + 1, score.right + bool(right)
        if not right:
            score.errors.append(f"{folder.name}: {kind} {k} is wrong (thing {thing})")
    return score


def _looked_at(visit: og.LabelledCloud, xyz: NDArray[np.float64], shown: NDArray[np.integer]) -> dict[int, float]:
    """For each thing of the earlier visit, the share of its shown points that the later visit looks at or through."""
    seen = np.zeros(len(xyz), bool)
    later = Visit(visit)
    local = (xyz - visit.origin).astype(np.float32)
    for camera in visit.cameras:
        view = later.surface.seen_from(in_local_frame(camera, np.zeros(3)))
        states = states_of_points(local, visit.spacing / 2, view)
        seen |= (states == AGREES) | (states == THROUGH)
    return {int(k): float(seen[shown == k].mean()) for k in np.unique(shown[shown >= 0])}
