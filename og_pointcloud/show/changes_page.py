"""Two visits in one cloud: what is gone, new and moved, for a page with a switch for each, and for the live page."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.ask.choosing import Reason
from og_pointcloud.ask.labelled_scene import LabelledScene
from og_pointcloud.ask.segmentation import Segmentation
from og_pointcloud.cloud import LabelledCloud
from og_pointcloud.formats.atomic import StrPath
from og_pointcloud.mapping.changes import Changes
from og_pointcloud.mapping.merging import joined
from og_pointcloud.show.live import CHANGES
from og_pointcloud.show.page import Look, write_page
from og_pointcloud.show.viewpoint import choose_viewpoint

CHANGE_LABELS = tuple(CHANGES)[:4]
"""Labels of the page: gone, new, moved from and moved to; instances without one are unchanged or not seen again."""


def both_visits(
    before: LabelledCloud, after: LabelledCloud, changes: Changes
) -> tuple[LabelledCloud, NDArray[np.intp]]:
    """The later visit, plus what left its place since the earlier one; and (K,) the change of each instance, a row of
    `live.CHANGES`.

    Instances of the later visit keep their ids; those of the earlier one follow.
    """
    gone, moved = [*changes.gone], [entry.id for entry in changes.moved]
    rows = np.flatnonzero(np.isin(before.instance_ids, gone + moved))
    count, names = len(after.instances), list(CHANGES)
    change = np.full(count + len(before.instances), names.index("as it was"))
    change[[*changes.new]] = names.index("new")
    change[[entry.now for entry in changes.moved]] = names.index("moved to here")
    change[count + np.array(gone, np.intp)] = names.index("gone")
    change[count + np.array(moved, np.intp)] = names.index("moved from here")
    shift = before.origin - after.origin  # each visit has its own local frame
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
    return both, change


def write_changes_page(
    path: StrPath, before: LabelledCloud, after: LabelledCloud, changes: Changes, up: NDArray[np.float64]
) -> None:
    """Write the page atomically. up: (3,) unit vector."""
    both, change = both_visits(before, after, changes)
    scene = LabelledScene.from_cloud(both)
    # The page shows changes as labels; unchanged instances have none.
    labels = np.append(change, [-1, -1])[both.instance_ids].astype(np.int32)  # ids -2 and -1 index the last two
    labels[labels >= len(CHANGE_LABELS)] = -1
    reasons = np.where(labels < 0, Reason.NONE_FITS, Reason.LABELLED).astype(np.int8)
    result = Segmentation(
        scene.xyz, labels, (labels >= 0).astype(np.float32), both.instance_ids, reasons, CHANGE_LABELS, scene.path
    )
    view = choose_viewpoint(scene.xyz, labels >= 0, up)
    colors = tuple(CHANGES[name] for name in CHANGE_LABELS)
    look = Look(
        f"What changed: {changes}", boxes=True, cut=0.2, colors=colors, unlabelled="as it was, or not seen again"
    )
    write_page(path, scene, result, view, look, both.rgb)
