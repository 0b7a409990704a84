"""Mask table -> instances, in one of three modes.

grouping  masks that cover the same Gaussians are one instance (grouping.py). No training.
fast      instance features from the mask table, a two-level codebook, masks matched by Eq. 5 (learned/): the paper's
          objectives without rendering. Deterministic, seconds.
paper     the same objectives as published: trained by rendering, one view a step (learned/paper.py), each instance
          matched as rendered alone. The reference for the other two.

All return a `Labelling`. In grouping and fast all views then decide every point (membership.py); in mode paper points
keep their leaf.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.cloud import UNOBSERVED, InstanceTable
from og_pointcloud.fitting.association import describe_instances, part_of
from og_pointcloud.fitting.grouping import MaskGroups, group_masks
from og_pointcloud.fitting.learned.codebook import thing_count, two_level_codebook
from og_pointcloud.fitting.learned.instance_features import learn_features
from og_pointcloud.fitting.learned.matching import (
    Matching,
    alone_evidence,
    match_masks,
    rendered_masks,
    visible_evidence,
)
from og_pointcloud.fitting.looks import by_look, looks_of_groups
from og_pointcloud.fitting.mask_table import MaskTable
from og_pointcloud.fitting.membership import assign_and_correct_groups
from og_pointcloud.fitting.view_votes import ViewVotes, view_votes
from og_pointcloud.fitting.work_folder import WorkFolder
from og_pointcloud.journal import Journal, LeftOut
from og_pointcloud.rendering.geometry import sample_of_points
from og_pointcloud.rendering.surface import Surface
from og_pointcloud.settings import FitSettings

if TYPE_CHECKING:
    from og_pointcloud.fitting.learned.paper import TrainedCodebook
    from og_pointcloud.fitting.learned.rendered_views import RenderedViews


@dataclass(frozen=True)
class Labelling:
    """instance_ids: (n,) int32, a row of ``instances``, BACKGROUND or UNOBSERVED. mask_instance: (masks,) int32, the
    instance that each mask shows, -1 none. certainty: (n,) float32, and expected_iou: (K,) float64, see `Membership`;
    None where views did not decide every point."""

    instance_ids: NDArray[np.int32]
    instances: InstanceTable
    mask_instance: NDArray[np.int32]
    certainty: NDArray[np.float32] | None = None
    expected_iou: NDArray[np.float64] | None = None

    def of_points(self, rows: NDArray[np.integer] | None) -> Labelling:
        """The labelling of other points: point i gets the label of point rows[i]; None: of the same points."""
        if rows is None:
            return self
        certainty = None if self.certainty is None else self.certainty[rows]
        ids = self.instance_ids[rows]
        points = np.bincount(ids[ids >= 0], minlength=len(self.instances)).astype(np.int32)
        return replace(self, instance_ids=ids, instances=replace(self.instances, points=points), certainty=certainty)


Labeller = Callable[[MaskTable, Surface, FitSettings, Journal], Labelling]


def grouping(table: MaskTable, surface: Surface, settings: FitSettings, journal: Journal) -> Labelling:
    """Masks joined by the Gaussians they share; no training."""
    with journal.stage("grouping"):
        # Overlaps of masks are shares: a sample of the points measures them just as well.
        sample = sample_of_points(surface.gaussians.xyz, settings.grouping.graph_points)
        groups = group_masks(table, settings.grouping, sample)
        votes = view_votes(table)
    return _decided_by_views(table, votes, groups, surface, settings, journal)


def fast(table: MaskTable, surface: Surface, settings: FitSettings, journal: Journal) -> Labelling:
    """Features by Eq. 1 and 2, codebook by Eq. 3, masks by Eq. 5, all from the mask table."""
    with journal.stage("features"):
        learned = learn_features(table, settings.features, settings.seed)
        journal.notes["feature_steps"], journal.notes["features_converged"] = learned.steps, learned.converged
    with journal.stage("codebook"):
        xyz = surface.scene.points.xyz
        book = two_level_codebook(learned.features, xyz, learned.seen, table, settings.codebook, settings.seed)
        coarse, leaves = journal.notes["clusters"] = [book.coarse_count, len(book.leaf_centers)]
        if coarse == leaves:
            journal.leave_out(LeftOut.SECOND_LEVEL)
    with journal.stage("matching"):
        # A mask's P_j of Eq. 5 is the mean of what it shows, an instance's M_i its leaf's center.
        shown = np.asarray(table.weights.sum(axis=1), np.float64)[:, None]
        means = (table.weights @ learned.features) / np.where(shown > 0, shown, 1)
        evidence = visible_evidence(table, book.leaf, book.leaf_centers, means)
        matching = match_masks(table, book.leaf, evidence, settings.matching)
    if not settings.matching.settle:
        return _leaves_as_instances(table, book.leaf, book.leaf_coarse, matching)
    return _leaves_decided_by_views(table, surface, settings, journal, book.leaf_coarse, matching)


def paper(
    table: MaskTable, surface: Surface, settings: FitSettings, journal: Journal, work: WorkFolder | None = None
) -> Labelling:
    """The paper's method: features and codebook trained by rendering, instances matched as rendered alone (Eq. 5).

    work: keeps the state of the training, so that a killed run can resume; None: nothing is kept.
    """
    features, book = trained_by_rendering(table, surface, settings, journal, work)
    return leaves_of_training(table, surface, features, book, settings, journal)


def trained_by_rendering(
    table: MaskTable, surface: Surface, settings: FitSettings, journal: Journal, work: WorkFolder | None = None,
    source: RenderedViews | None = None,
) -> tuple[NDArray[np.float32], TrainedCodebook]:  # fmt: skip
    """What mode paper trains: features (n, width) of the first stage, as read, and the codebook.

    source: the blending weights, if they are available already.
    """
    from og_pointcloud.fitting.learned.paper import TrainingRun, train_codebook, train_features
    from og_pointcloud.fitting.learned.rendered_views import RenderedViews

    options = settings.paper
    if options.k1 is None:
        options = replace(options, k1=thing_count(table))  # before training: a checkpoint's key holds the settings
    drawn = surface.gaussians, surface.scene.views, surface.near, options
    with journal.bars() as report:
        run = TrainingRun(settings.seed, report, work)
        with journal.stage("features"):
            source = source or RenderedViews(*drawn, whole=False)
            trained = train_features(source, options, run)
        with journal.stage("codebook"):
            # The printed Eq. 4 compares whole images, all others pixels in masks.
            source = RenderedViews(*drawn, whole=True) if options.formula == "paper" else source
            book = train_codebook(source, trained.raw, options, run)
    journal.notes["training"] = [history.to_dict() for history in (trained.history, *book.histories)]
    return trained.features, book


def leaves_of_training(
    table: MaskTable,
    surface: Surface,
    features: NDArray[np.float32],
    book: TrainedCodebook,
    settings: FitSettings,
    journal: Journal,
) -> Labelling:
    """The leaves of a trained codebook as instances, each with the masks that Eq. 5 accepts for it."""
    options, gaussians = settings.paper, surface.gaussians
    near, views = surface.near, surface.scene.views
    # Leaves with Gaussians become instances 0, 1, ...; some of the k1 k2 leaves have none.
    used, leaf = np.unique(book.leaf[book.leaf >= 0], return_inverse=True)
    ids = np.full(len(gaussians), -1, np.int32)
    ids[book.leaf >= 0] = leaf
    with journal.stage("matching"):
        shown, pure = rendered_masks(gaussians, views, near, features, options.covered_share)
        centers = book.centers[used]
        if options.matching.visible:
            evidence = visible_evidence(table, ids, centers, shown)
        else:
            evidence = alone_evidence(gaussians, views, near, ids, centers, shown, options.alone_share)
        if options.formula == "authors":
            evidence = evidence.of_masks(pure)
        matching = match_masks(table, ids, evidence, options.matching)
    coarse = (used // options.k2).astype(np.int32)
    if options.matching.settle:
        return _leaves_decided_by_views(table, surface, settings, journal, coarse, matching)
    return _leaves_as_instances(table, ids, coarse, matching)


LABELLERS: dict[str, Labeller] = {"grouping": grouping, "fast": fast, "paper": paper, "auto": grouping}
"""By `FitSettings.mode`. Grouping is the default on every scene, and what "auto" stands for: over the zoo's half for
choosing, fast was better by more than 0.01 on one of 32 scenes, and neither agreement with masks nor reliability told
which one."""


def _leaves_decided_by_views(
    table: MaskTable, surface: Surface, settings: FitSettings, journal: Journal, coarse: NDArray[np.int32],
    matching: Matching,
) -> Labelling:  # fmt: skip
    """Leaves as groups of the masks that they accepted, largest first; all views then decide every point."""
    # number[leaf] is its rank by points; the last, of leaf -1, stays -1.
    order = np.argsort(-matching.instances.points, kind="stable")
    number = np.append(np.argsort(order), -1).astype(np.int32)
    groups = MaskGroups(number[matching.mask_instance], len(order), np.zeros(len(table.mask_view), bool))
    with journal.stage("grouping"):
        votes = view_votes(table)
    return _decided_by_views(table, votes, groups, surface, settings, journal, coarse[order])


def _decided_by_views(
    table: MaskTable,
    votes: ViewVotes,
    groups: MaskGroups,
    surface: Surface,
    settings: FitSettings,
    journal: Journal,
    coarse: NDArray[np.int32] | None = None,
) -> Labelling:
    """Every point's state from all views together, and what the encoder saw of each instance.

    coarse: (groups,) the coarse cluster of each group, if the groups are leaves of a codebook.
    """
    with journal.stage("membership"):
        rgb = surface.scene.points.rgb
        before = groups.group
        groups, membership = assign_and_correct_groups(table, votes, groups, surface.neighborhood, settings, rgb)
    if groups.spanning.any():
        journal.leave_out(LeftOut.SPANNING_MASKS, count=int(groups.spanning.sum()))
    if membership.dismissed.any():
        journal.leave_out(LeftOut.CONTRADICTED_GROUPS, count=int(membership.dismissed.sum()), total=groups.count)
    with journal.stage("association"):
        ids = membership.instance_ids
        # A group that was shown as two things becomes two; a group that no point is left of goes.
        looks = looks_of_groups(table, groups.group, ids, groups.count)
        used, ids, mask_instance = renumbered(by_look(votes, ids, looks), looks.look)
        instances = describe_instances(table, mask_instance, ids, len(used))
        if coarse is not None:
            of_group = np.full(groups.count, len(coarse))
            np.minimum.at(of_group, groups.group[before >= 0], before[before >= 0])  # its largest leaf
            instances = replace(instances, coarse=coarse[of_group[looks.group[used]]])
    expected_iou = membership.expected_iou[looks.group[used]]
    return Labelling(ids, instances, mask_instance, membership.certainty, expected_iou)


def renumbered(
    ids: NDArray[np.int32], group: NDArray[np.int32]
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]:
    """Groups that have points become instances 0, 1, ... in order. Returns these groups, the instance of each point,
    and the instance of each mask, -1 where its group has no point.

    ids: (n,) the group of each point, or a state below 0, which stays. group: (masks,) the group of each mask, -1 none.
    """
    used = np.unique(ids[ids >= 0])
    # Long enough for negative states, which index from the end, even without any group.
    number = np.full(int(max(group.max(initial=-1), ids.max(initial=-1))) + 3, -1, np.int32)
    number[used] = np.arange(len(used), dtype=np.int32)
    return used, np.where(ids >= 0, number[ids], ids).astype(np.int32), number[group]


def _leaves_as_instances(
    table: MaskTable, leaf: NDArray[np.int32], leaf_coarse: NDArray[np.int32], matching: Matching
) -> Labelling:
    """Points keep the leaf they are in; those that no mask shows are unobserved."""
    parent = part_of(table, matching.mask_instance, leaf, len(leaf_coarse))
    ids = np.where(leaf >= 0, leaf, UNOBSERVED).astype(np.int32)
    return Labelling(ids, replace(matching.instances, part_of=parent, coarse=leaf_coarse), matching.mask_instance)
