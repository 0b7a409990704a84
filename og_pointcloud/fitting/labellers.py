"""Masks -> instances, by three roads, and the choice between them.

grouping  masks that cover the same Gaussians are one instance (grouping.py). No training.
fast      instance features from the mask table, a two-level codebook, masks matched by Eq. 5 (features.py,
          codebook.py, matching.py): the paper's objectives without rendering. Deterministic, seconds.
paper     the same objectives as published: trained by rendering, a view a step (paper.py), each instance matched as
          rendered alone. The reference of the other two.
auto      grouping, and fast as well where the scene's masks say that grouping has not understood them.

All give a `Labelling`. Grouping and fast then let all views settle every point (membership.py); the paper's points
keep their leaf.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.cloud import UNOBSERVED, InstanceTable
from og_pointcloud.fitting.association import describe_instances
from og_pointcloud.fitting.grouping import MaskGroups, group_masks
from og_pointcloud.fitting.learned.codebook import cluster_weights, two_level_codebook
from og_pointcloud.fitting.learned.instance_features import learn_features
from og_pointcloud.fitting.learned.matching import Matching, alone_evidence, match_masks, visible_evidence
from og_pointcloud.fitting.mask_table import Gaussians, MaskTable
from og_pointcloud.fitting.membership import assign_points
from og_pointcloud.fitting.parts import part_of
from og_pointcloud.fitting.view_votes import Testimony, hear_views
from og_pointcloud.journal import Journal
from og_pointcloud.rendering.geometry import Neighbourhood, sample_of_points, thinned
from og_pointcloud.scene import Scene
from og_pointcloud.settings import FitSettings

__all__ = [
    "Labelling",
    "Prepared",
    "as_published",
    "by_choice",
    "by_features",
    "by_grouping",
    "mask_agreement",
    "mask_means",
]


@dataclass(frozen=True)
class Prepared:
    """Frozen geometry and what every mask shows of it: all that the stages after rendering need.

    near: depth of the near plane, scene units. stride: every stride-th row and column of the images was used.
    table: what shows behind an object through its mask is in ``outside`` (membership.without_see_through).
    """

    neighbourhood: Neighbourhood
    gaussians: Gaussians
    near: float
    stride: int
    table: MaskTable


@dataclass(frozen=True)
class Labelling:
    """instance_ids: (n,) int32, a row of ``instances``, BACKGROUND or UNOBSERVED. mask_instance: (masks,) int32, the
    instance that each mask shows, -1 none. certainty: (n,) float32 as of `Membership`; None where views did not settle
    every point."""

    instance_ids: NDArray[np.int32]
    instances: InstanceTable
    mask_instance: NDArray[np.int32]
    certainty: NDArray[np.float32] | None = None


def by_choice(scene: Scene, prepared: Prepared, settings: FitSettings, journal: Journal) -> Labelling:
    """Mode "auto": grouping, unless learned features explain the masks clearly better.

    The judge is `mask_agreement`, which needs no truth. Learning is tried only where grouping leaves room for it.
    """
    before = list(journal.left_out)
    grouped = by_grouping(scene, prepared, settings, journal)
    agreement = mask_agreement(prepared.table, grouped)
    journal.notes["mask_agreement"] = {"grouping": round(agreement, 4)}
    if len(grouped.instances) == 0:
        journal.leave_out("learned features and codebook", "no mask shows an instance: there is nothing to learn from")
        return grouped
    if agreement >= settings.agreement_enough:
        journal.leave_out(
            "learned features and codebook",
            f"instances from grouping agree with {agreement:.0%} of the masks' area; learning is tried below "
            f"{settings.agreement_enough:.0%}",
        )
        return grouped
    trial = Journal(journal.progress)
    learned = by_features(scene, prepared, settings, trial)
    journal.stages += trial.stages
    other = mask_agreement(prepared.table, learned)
    journal.notes["mask_agreement"]["fast"] = round(other, 4)
    shares = f"they agree with {other:.0%} of the masks' area, those from grouping with {agreement:.0%}"
    if other > agreement + settings.agreement_lead:
        journal.notes.update(trial.notes)
        journal.left_out = before + trial.left_out
        journal.leave_out("instances from grouping", f"learned ones explain the masks better: {shares}")
        return learned
    journal.leave_out("instances from learned features", f"they explain the masks no better: {shares}")
    return grouped


def by_grouping(scene: Scene, prepared: Prepared, settings: FitSettings, journal: Journal) -> Labelling:
    """Masks joined by the Gaussians they share; no training."""
    with journal.stage("grouping"):
        testimony = hear_views(prepared.table)
        sample = sample_of_points(prepared.gaussians.xyz, settings.grouping.graph_points)
        groups = group_masks(prepared.table, testimony, settings.grouping, sample)
    if groups.spanning.any():
        journal.leave_out(f"{groups.spanning.sum()} masks", "most views show each of them as several things")
    return _settled(prepared, testimony, groups, settings, journal)


def by_features(scene: Scene, prepared: Prepared, settings: FitSettings, journal: Journal) -> Labelling:
    """Features by Eq. 1 and 2, codebook by Eq. 3, masks by Eq. 5, all from the mask table."""
    table = prepared.table
    with journal.stage("features"):
        learned = learn_features(table, settings.features, settings.seed)
    with journal.stage("codebook"):
        book = two_level_codebook(
            learned.features, scene.points.xyz, learned.seen, table, settings.codebook, settings.seed
        )
        if book.levels == 1:
            journal.leave_out("the codebook's second level", "no view shows two masks in one coarse cluster")
    journal.notes["feature_steps"], journal.notes["features_converged"] = learned.steps, learned.converged
    journal.notes["clusters"] = [len(book.coarse_centres), len(book.leaf_centres)]
    with journal.stage("matching"):
        shown = mask_means(table, learned.features)
        evidence = visible_evidence(table, book.leaf, book.leaf_centres, shown)
        matching = match_masks(table, book.leaf, evidence, settings.matching, settings.association)
    if not settings.matching.settle:
        return _literal(table, book.leaf, book.leaf_coarse, matching)
    groups = MaskGroups(matching.mask_instance, len(book.leaf_centres), np.zeros(len(table.mask_view), bool))
    with journal.stage("grouping"):
        testimony = hear_views(table)
    return _settled(prepared, testimony, groups, settings, journal, book.leaf_coarse)


def as_published(scene: Scene, prepared: Prepared, settings: FitSettings, journal: Journal) -> Labelling:
    """The paper's method: features and codebook trained by rendering, instances matched as rendered alone (Eq. 5)."""
    from og_pointcloud.fitting.learned.paper import train_codebook, train_features

    paper, gaussians, near = settings.paper, prepared.gaussians, prepared.near
    views = [thinned(view, prepared.stride) for view in scene.views]
    with journal.stage("features"), journal.bars() as report:
        trained = train_features(gaussians, views, near, paper, settings.seed, report)
    with journal.stage("codebook"), journal.bars() as report:
        book = train_codebook(gaussians, views, near, trained.features, paper, settings.seed, report)
    histories = (trained.history, *book.histories)
    journal.notes["training"] = [
        {
            "stage": history.name,
            "steps": history.steps,
            "published_steps": history.published_steps,
            "seconds_per_step": round(history.seconds_per_step, 5),
            "published_seconds": round(history.published_seconds, 1),
        }
        for history in histories
    ]
    used, leaf = np.unique(book.leaf[book.leaf >= 0], return_inverse=True)
    ids = np.full(len(gaussians), -1, np.int32)
    ids[book.leaf >= 0] = leaf
    centres = book.centres[used]
    with journal.stage("matching"):
        shown = mask_means(prepared.table, trained.features)
        if paper.association == "alone":
            evidence = alone_evidence(gaussians, views, near, ids, centres, shown, paper.covered_share)
        else:
            evidence = visible_evidence(prepared.table, ids, centres, shown)
        matching = match_masks(prepared.table, ids, evidence, paper.matching, settings.association)
    return _literal(prepared.table, ids, (used // paper.k2).astype(np.int32), matching)


def mask_agreement(table: MaskTable, labelling: Labelling) -> float:
    """How well the instances reproduce the masks they came from: mean over masks, by area, of the best IoU with what an
    instance shows in that view. In [0, 1]; torn, merged and missed masks lower it whatever the instances."""
    count = len(labelling.instances)
    shared = cluster_weights(table.weights, labelling.instance_ids, count)
    in_view = cluster_weights(table.outside, labelling.instance_ids, count)
    np.add.at(in_view, table.mask_view, shared)
    area = np.asarray(table.weights.sum(axis=1), np.float64).ravel()
    if count == 0 or area.sum() == 0:
        return 0.0
    union = area[:, None] + in_view[table.mask_view] - shared
    best = np.divide(shared, union, out=np.zeros_like(shared), where=union > 0).max(axis=1)
    return float(np.average(best, weights=area))


def _settled(
    prepared: Prepared,
    testimony: Testimony,
    groups: MaskGroups,
    settings: FitSettings,
    journal: Journal,
    coarse: NDArray[np.int32] | None = None,
) -> Labelling:
    """Every point's state from all views together, and what the encoder saw of each instance."""
    table = prepared.table
    with journal.stage("membership"):
        membership = assign_points(table, testimony, groups, prepared.neighbourhood, settings.membership)
    if membership.dismissed.any():
        journal.leave_out(
            f"{membership.dismissed.sum()} of {groups.count} groups of masks",
            "views that see their points mostly show no such mask, far more often than the proposer's misses explain",
        )
    with journal.stage("association"):
        ids, group, used = _without_empty(membership.instance_ids, groups.group)
        instances = describe_instances(table, group, ids, len(used), settings.association)
        instances = replace(instances, part_of=part_of(table, group, ids, len(used)))
        if coarse is not None:
            instances = replace(instances, coarse=coarse[used])
    return Labelling(ids, instances, group, membership.certainty)


def _literal(
    table: MaskTable, leaf: NDArray[np.int32], leaf_coarse: NDArray[np.int32], matching: Matching
) -> Labelling:
    """Points keep the leaf they are in; those that no mask shows are unobserved."""
    whole = part_of(table, matching.mask_instance, leaf, len(leaf_coarse))
    ids = np.where(leaf >= 0, leaf, UNOBSERVED).astype(np.int32)
    return Labelling(ids, replace(matching.instances, part_of=whole, coarse=leaf_coarse), matching.mask_instance)


def _without_empty(
    ids: NDArray[np.int32], group: NDArray[np.int32]
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]:
    """Number the groups that have points 0, 1, ... in their order; masks of the others belong to none. Also returns
    the groups that are left."""
    used = np.unique(ids[ids >= 0])
    number = np.full(int(max(group.max(initial=-1), ids.max(initial=-1))) + 2, -1, np.int32)
    number[used] = np.arange(len(used), dtype=np.int32)
    return np.where(ids >= 0, number[ids], ids).astype(np.int32), number[group], used


def mask_means(table: MaskTable, features: NDArray[np.float32]) -> NDArray[np.float64]:
    """(masks, width): the mean instance feature that each mask shows; zero where it shows nothing."""
    shown = np.asarray(table.weights.sum(axis=1), np.float64).reshape(-1, 1)
    return (table.weights @ features) / np.where(shown > 0, shown, 1)
