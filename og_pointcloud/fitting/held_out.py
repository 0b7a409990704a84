"""How large points are drawn, decided on held-out views: no ground truth, photograph or threshold is needed.

Points that are too large hide what lies behind their edges; if they are too small, rays slip through a surface and
label what is behind it. Which is worse depends on noise, density and floaters: the scene must decide. So labels are
made from every other view, with points of each size, and judged by how well they reproduce the masks of the views
between. What those views show depends on the size too, so the labels of each size are judged with points of all sizes
in the settings, and the best on average is taken. (Judged with their own size alone, large opaque points would always
agree with themselves best.) A cloud of many noisy layers may need far smaller points than most: where the smallest or
the largest size is clearly the best, the search goes on beyond it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.fitting.grouping import group_masks
from og_pointcloud.fitting.mask_table import MaskTable, areas_by_instance, mask_table
from og_pointcloud.fitting.membership import assign_by_votes_alone
from og_pointcloud.fitting.memory import memory_left
from og_pointcloud.fitting.view_votes import view_votes
from og_pointcloud.journal import Journal, LeftOut
from og_pointcloud.rendering.geometry import Neighborhood, isotropic, neighborhood, sample_of_points
from og_pointcloud.scene import Points, View, evenly
from og_pointcloud.settings import FitSettings

MASK_MAPS_MEMORY_SHARE = 0.05
"""Mask maps that take less than this share of a fit's remaining memory are read once, not again for each size."""
MIN_VIEWS = 8
"""With fewer views, the labels of a half are so poor that choosing by them is no better than the middle size."""
SCALE_STEP = 1.4
"""Factor from a size to the next one beyond the settings' own, which are about as far apart."""
MIN_AGREEMENT_GAIN = 0.005
"""By how much a size must agree better than the others before one beyond it is tried, and that one before it is taken:
sizes that label alike differ by less, by chance."""


@dataclass(frozen=True)
class ScaleChoice:
    """scale: standard deviation of the points' Gaussians, in spacings. agreements: for each scale tried, how well its
    labels reproduce the masks of held-out views, in [0, 1]; empty where views could not be held out."""

    scale: float
    agreements: dict[float, float]


def choose_scale(
    points: Points,
    spacing: NDArray[np.float32],
    thickness: NDArray[np.float32],
    views: Sequence[View],
    near: float,
    settings: FitSettings,
    journal: Journal,
) -> ScaleChoice:
    """The scale whose labels, made from half of the views, best reproduce the masks of the other half: of the settings'
    own scales, and of smaller or larger ones while these are clearly better.

    spacing: (n,) that points are drawn by. thickness: (n,) of their surfaces. near: depth of the near plane. Only some
    views and points are used (see settings), but all points occlude. The order of views and points does not matter.
    """
    geometry = settings.geometry
    if len({*geometry.scales}) == 1:
        return ScaleChoice(geometry.scales[0], {})
    # By name, so that a capture's views give the same halves in any order; frames of a video then alternate.
    masked = sorted((view for view in views if view.mask_count), key=lambda view: view.name)
    chosen = evenly(masked, geometry.held_out_views)
    if len(chosen) < MIN_VIEWS:
        return ScaleChoice(geometry.middle_scale, {})
    size = sum(4 * view.camera.width * view.camera.height for view in chosen)
    if size < MASK_MAPS_MEMORY_SHARE * memory_left(settings.memory):
        chosen = [replace(view, masks=view.mask_map()) for view in chosen]
    # Neighbors are looked up within the sample, as the labels below are of the sample alone.
    sample = sample_of_points(points.xyz, geometry.held_out_points)
    around = neighborhood(points.xyz[sample], geometry)
    selected = np.zeros(len(points), np.bool_)
    selected[sample] = True
    halves = chosen[0::2], chosen[1::2]

    def tables_of(scale: float) -> list[MaskTable]:
        """The tables of the two halves of the views, with points of a scale."""
        drawn = isotropic(points, spacing, scale, geometry.opacity)
        tables = (mask_table(drawn, half, near, thickness, selected=selected) for half in halves)
        return [table.of_points(sample) for table in tables]

    judges = {scale: tables_of(scale) for scale in journal.steps(geometry.scales, "point size")}

    def agreement_of(scale: float) -> float:
        """How well labels made from each half reproduce the masks of the other."""
        made = [_labels(table, around, settings) for table in judges.get(scale) or tables_of(scale)]
        return float(np.mean([agreement(judge[1 - half], *made[half]) for half in (0, 1) for judge in judges.values()]))

    best, found = search(geometry.scales, agreement_of)
    rounded = {scale: round(value, 4) for scale, value in sorted(found.items())}
    return ScaleChoice(best if any(found.values()) else geometry.middle_scale, rounded)


def search(scales: Sequence[float], agreement_of: Callable[[float], float]) -> tuple[float, dict[float, float]]:
    """The best of scales, and the agreements of all that were tried. Where the smallest or the largest is clearly the
    best, the search goes on by SCALE_STEP as long as the next one is clearly better."""
    found = {scale: agreement_of(scale) for scale in scales}
    best = max(found, key=found.__getitem__)
    while best in (min(found), max(found)) and _is_clear(best, found):
        beyond = best / SCALE_STEP if best == min(found) else best * SCALE_STEP
        found[beyond] = agreement_of(beyond)
        if not _is_clear(beyond, found):
            break
        best = beyond
    return best, found


def _is_clear(best: float, found: dict[float, float]) -> bool:
    return found[best] >= MIN_AGREEMENT_GAIN + max(value for scale, value in found.items() if scale != best)


def note_scale(choice: ScaleChoice, journal: Journal) -> None:
    """Note how large the points of a plain cloud are drawn, and why."""
    journal.notes["gaussian_scale"], journal.notes["held_out_agreement"] = choice.scale, choice.agreements
    if not any(choice.agreements.values()):
        journal.leave_out(LeftOut.CHOICE_OF_SCALE, scale=choice.scale)


def agreement(table: MaskTable, ids: NDArray[np.int32], count: int) -> float:
    """How well instances reproduce a table's masks: mean over masks, by area, of the best IoU with what an instance
    shows in that view. In [0, 1]; where masks are torn, merged or missed, no instances reach 1.

    ids: (n,) int32, the instance of each point, below 0 none; count: how many instances there are.
    """
    shared, in_view = areas_by_instance(table, ids, count)
    area = np.asarray(table.weights.sum(axis=1), np.float64).ravel()
    if count == 0 or area.sum() == 0:
        return 0.0
    union = area[:, None] + in_view[table.mask_view] - shared
    best = np.divide(shared, union, out=np.zeros_like(shared), where=union > 0).max(axis=1)
    return float(np.average(best, weights=area))


def _labels(table: MaskTable, around: Neighborhood, settings: FitSettings) -> tuple[NDArray[np.int32], int]:
    """The group of masks that each point is in, as mode grouping finds it, and the number of groups.

    By votes alone, without neighbors: what neighbors correct is the same for all sizes, and labels that neighbors gave
    to hidden points would count against labels without them. Nor is what few views show doubted: half of the views
    judge.
    """
    groups = group_masks(table, settings.grouping)
    return assign_by_votes_alone(table, view_votes(table), groups, around, settings.membership), groups.count
