"""Two visits as one HTML page: what is gone, new and moved, in colours that can be switched on and off one by one."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.ask.labelled_scene import LabelledScene
from og_pointcloud.ask.segmentation import Segmentation
from og_pointcloud.cloud import LabelledCloud
from og_pointcloud.mapping.changes import Changes
from og_pointcloud.mapping.merging import joined
from og_pointcloud.show.page import Look, write_page
from og_pointcloud.show.viewpoint import choose_viewpoint

__all__ = ["STATES", "write_changes_page"]

STATES = ("gone", "new", "moved from here", "moved to here")
"""Labels of the page; what has none of them is as it was, or was not seen again."""


def write_changes_page(
    path: str | os.PathLike[str], before: LabelledCloud, after: LabelledCloud, changes: Changes, up: NDArray[np.float64]
) -> None:
    """Write the page, whole or not at all: the later visit, and of the earlier one what left its place. up: (3,) unit.

    Instances of the later visit keep their ids; those of the earlier one follow behind.
    """
    left = [*changes.gone, *(moved.id for moved in changes.moved)]
    rows = np.flatnonzero(np.isin(before.instance_ids, left))
    count = len(after.instances)
    moved_from, moved_to = [entry.id for entry in changes.moved], [entry.now for entry in changes.moved]
    of_before = np.where(np.isin(before.instance_ids[rows], moved_from), 2, 0)
    of_after = np.full(len(after), -1)
    of_after[np.isin(after.instance_ids, changes.new)] = 1
    of_after[np.isin(after.instance_ids, moved_to)] = 3
    labels = np.concatenate([of_after, of_before]).astype(np.int32)
    shift = before.origin - after.origin
    colored = before.rgb is not None and after.rgb is not None
    ids = np.concatenate([after.instance_ids, before.instance_ids[rows] + count]).astype(np.int32)
    both = replace(
        after,
        xyz=np.concatenate([after.xyz, (before.xyz[rows] + shift).astype(np.float32)]),
        instance_ids=ids,
        instances=joined(after.instances, before.instances, count + np.arange(len(before.instances)), ids),
        rgb=np.concatenate([after.rgb, before.rgb[rows]]) if colored else None,  # pyright: ignore
        certainty=None,
    )
    scene = LabelledScene.from_cloud(both)
    reasons = np.where(labels < 0, 4, 0).astype(np.int8)
    result = Segmentation(
        scene.xyz, labels, (labels >= 0).astype(np.float32), both.instance_ids, reasons, STATES, scene.path
    )
    view = choose_viewpoint(scene.xyz, labels >= 0, up)
    write_page(path, scene, result, view, Look(f"What changed: {changes}", boxes=True, cut=0.2), both.rgb)
