"""How large a point is drawn, decided by views that were held out: no truth, no photograph, no threshold is needed.

Too large, and points hide what lies behind their edge; too small, and rays slip through a surface and label what is
behind it. Which is worse depends on noise, density and floaters: the scene must decide. So labels are made from every
other view, with points of each size, and judged on the views between, by how well they reproduce the masks there. What
those views show depends on the size too, so the labels of each size are judged with points of every size, and the best
on average is taken. (Judged with their own size alone, large opaque points would always agree with themselves best.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.fitting.grouping import group_masks
from og_pointcloud.fitting.mask_table import MaskTable, mask_table, weights_by_instance
from og_pointcloud.fitting.membership import SceneVotes, assign_points, views_with_masks
from og_pointcloud.fitting.view_votes import view_votes
from og_pointcloud.journal import Journal, LeftOut
from og_pointcloud.rendering.geometry import Neighbourhood, isotropic, neighbourhood, sample_of_points
from og_pointcloud.rendering.surface import sight_thickness
from og_pointcloud.scene import Points, View
from og_pointcloud.settings import FitSettings

FEWEST_VIEWS = 4
"""Views needed: of fewer, a half has one view, which nothing in it contradicts."""


@dataclass(frozen=True)
class ScaleChoice:
    """scale: standard deviation of the points' Gaussians, in spacings. agreements: of each scale tried, how well labels
    made with it reproduce masks of held-out views, in [0, 1]; empty where views could not be held out."""

    scale: float
    agreements: dict[float, float]


def choose_scale(
    points: Points,
    spacing: NDArray[np.float32],
    views: Sequence[View],
    near: float,
    settings: FitSettings,
    journal: Journal,
) -> ScaleChoice:
    """The scale whose labels of half of the views reproduce the masks of the other half best.

    spacing: (n,) of the points. near: depth of the near plane. Only some views and points are asked (see settings), but
    all points hide others. Does not depend on the order of views or points.
    """
    geometry = settings.geometry
    if len(geometry.scales) == 1:
        return ScaleChoice(geometry.scales[0], {})
    # By name, so that a capture's views give the same halves in any order; frames of a video then alternate.
    masked = sorted((view for view in views if view.mask_count), key=lambda view: view.name)
    spread = np.linspace(0, len(masked) - 1, min(geometry.held_out_views, len(masked))).round().astype(int)
    chosen = [masked[index] for index in np.unique(spread)]
    if len(chosen) < FEWEST_VIEWS:
        return ScaleChoice(geometry.middle_scale, {})
    # Neighbours are looked up within the sample, as the labels below are of the sample alone.
    sample = sample_of_points(points.xyz, geometry.held_out_points)
    around = neighbourhood(points.xyz[sample], geometry)
    asked = np.zeros(len(points), np.bool_)
    asked[sample] = True
    thickness = sight_thickness(spacing, float(np.median(spacing)), geometry)
    tables = []  # by scale, one for each half of the views
    for scale in journal.steps(geometry.scales, "point size"):
        gaussians = isotropic(points, spacing, scale, geometry.opacity)
        halves = (
            mask_table(gaussians, chosen[half::2], near, thickness, by_sight=True, asked=asked) for half in (0, 1)
        )
        tables.append([table.of_points(sample) for table in halves])
    # Labels of either half, at each scale, judged by the other half as every scale shows it.
    agreements = np.zeros(len(geometry.scales))
    for half in (0, 1):
        for index in range(len(geometry.scales)):
            ids, count = _labels(tables[index][half], around, settings)
            agreements[index] += np.mean([agreement(judge[1 - half], ids, count) for judge in tables]) / 2
    best = geometry.scales[int(np.argmax(agreements))] if agreements.any() else geometry.middle_scale
    rounded = np.round(agreements, 4).tolist()
    return ScaleChoice(best, dict(zip(geometry.scales, rounded, strict=True)))


def note_scale(choice: ScaleChoice, journal: Journal) -> None:
    """Note how large a plain cloud's points are drawn, and why."""
    journal.notes["gaussian_scale"], journal.notes["held_out_agreement"] = choice.scale, choice.agreements
    if not any(choice.agreements.values()):
        journal.leave_out(LeftOut.CHOICE_OF_SCALE, scale=choice.scale)


def agreement(table: MaskTable, ids: NDArray[np.int32], count: int) -> float:
    """How well instances reproduce a table's masks: mean over masks, by area, of the best IoU with what an instance
    shows in that view. In [0, 1]; where masks are torn, merged or missed, no instances reach 1.

    ids: (n,) int32, the instance of each point, below 0 none; count: how many instances there are.
    """
    shared = weights_by_instance(table.weights, ids, count)
    # What a view shows of an instance lies in its masks or outside all of them.
    in_view = weights_by_instance(table.outside, ids, count)
    np.add.at(in_view, table.mask_view, shared)
    area = np.asarray(table.weights.sum(axis=1), np.float64).ravel()
    if count == 0 or area.sum() == 0:
        return 0.0
    union = area[:, None] + in_view[table.mask_view] - shared
    best = np.divide(shared, union, out=np.zeros_like(shared), where=union > 0).max(axis=1)
    return float(np.average(best, weights=area))


def _labels(table: MaskTable, around: Neighbourhood, settings: FitSettings) -> tuple[NDArray[np.int32], int]:
    """The group of masks that each point is in, as mode grouping finds it, and how many groups there are.

    By votes alone, not by neighbours: what these mend is the same for all sizes, and a judge that saw hidden points by
    hearsay would hold it against labels that do not. Nor does it doubt what few views show, or judge how complete masks
    are: half of the views judge.
    """
    groups = group_masks(table, settings.grouping)
    by_votes = replace(
        settings.membership, sure_votes=0.0, open_share=0.0, own_vote=np.inf, possible_openly=0.0, missed_chance=0.0
    )
    votes = view_votes(table)
    scene = SceneVotes(votes.typical_openness, views_with_masks(table, groups).astype(np.float32))
    return assign_points(table, votes, groups, around, by_votes, scene=scene).instance_ids, groups.count
