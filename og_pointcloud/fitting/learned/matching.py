"""Instances + masks -> which masks show which instance (paper, Sec. 3.3, Eq. 5), where no grouping has decided it.

    S_ij = IoU(pi(M_i), B_j) * (1 - |M_i - P_j|_1)

M_i is the map of instance i, binarised by pi; B_j is mask j of a view, and P_j that mask filled with its mean feature.
The paper renders each instance alone in every view (`alone_evidence`). What is visible of an instance among the others,
with true occlusion, is a product with the mask table and needs no rendering (`visible_evidence`). In each view the mask
with the best score is accepted, if that is good enough; the encoder's features of accepted masks describe the instance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial.distance import cdist

from og_pointcloud.cloud import InstanceTable
from og_pointcloud.fitting.association import directions
from og_pointcloud.fitting.mask_table import MaskTable, areas_by_instance
from og_pointcloud.rendering.splatting import FRUSTUM_MARGIN, Gaussians, render
from og_pointcloud.scene import Camera, View
from og_pointcloud.settings import MatchingSettings

MIXED_VARIANCE = 0.006
"""A mask whose features vary more (variance, mean over channels) is neither a target of Eq. 4 nor accepted by Eq. 5,
unless it is large (the authors' code)."""
LARGE_SHARE = 0.8
"""A mask with at least this share of the largest mask's pixels is large (the authors' code)."""


@dataclass(frozen=True)
class Evidence:
    """What Eq. 5 compares, for all masks and K instances. Areas in pixels.

    shared: (masks, K) float64, the area that mask and instance have in common. mask_area: (masks,) float64.
    instance_area: (views, K) float64. distance: (masks, K) float64, L1 distance of their features, summed over the
    channels; infinite where they have nothing in common.
    """

    shared: NDArray[np.float64]
    mask_area: NDArray[np.float64]
    instance_area: NDArray[np.float64]
    distance: NDArray[np.float64]

    def of_masks(self, kept: NDArray[np.bool_]) -> Evidence:
        """The same, except that masks not kept have nothing in common with any instance."""
        distance = np.where(kept[:, None], self.distance, np.inf)
        return replace(self, shared=self.shared * kept[:, None], distance=distance)


@dataclass(frozen=True)
class Matching:
    """instances: K rows of evidence; an instance without an accepted mask has no descriptor and is unknown.
    mask_instance: (masks,) int32, the instance that accepted the mask, with the best score where several did, -1 none.
    """

    instances: InstanceTable
    mask_instance: NDArray[np.int32]


def visible_evidence(
    table: MaskTable,
    instance_ids: NDArray[np.int32],
    instance_features: NDArray[np.floating],
    mask_features: NDArray[np.floating],
) -> Evidence:
    """What each mask shows of each instance among all others, in pixels of blending weight.

    instance_ids: (n,) int32, below 0 none. instance_features: (K, width), one per instance. mask_features:
    (masks, width), the mean instance feature that each mask shows (not the encoder's).
    A mask's area is what it shows of the cloud: pixels that show no point do not count.
    """
    shared, instance_area = areas_by_instance(table, instance_ids, len(instance_features))
    distance = np.where(shared > 0, cdist(mask_features, instance_features, "cityblock"), np.inf)
    return Evidence(shared, np.asarray(table.weights.sum(axis=1), np.float64), instance_area, distance)


def filled_masks(
    image: NDArray[np.floating], mask: NDArray[np.integer], count: int
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """The mean feature of each mask, P of Eq. 5, (count, width), and whether its features are uniform or it is large.

    image: (pixels, width) rendered features; mask: (pixels,) the mask of each, 0..count-1. The mean of a mask without
    pixels is zero.
    """
    pixels = np.bincount(mask, minlength=count)
    own = csr_array((np.ones(len(mask)), (mask, np.arange(len(mask)))), shape=(count, len(mask)))
    # The variance about the mean, in a second pass: mean square less squared mean would be mostly rounding.
    means = (own @ image) / np.maximum(pixels, 1)[:, None]
    variance = np.mean(np.asarray(own @ (image - means[mask]) ** 2), axis=1) / np.maximum(pixels, 1)
    pure = (variance <= MIXED_VARIANCE) | (pixels >= LARGE_SHARE * pixels.max(initial=0))
    return means, pure & (pixels > 0)


def rendered_masks(
    gaussians: Gaussians, views: Sequence[View], near: float, features: NDArray[np.float32], covered_share: float
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """`filled_masks` of all views, (masks, width) and (masks,), from pixels covered by at least ``covered_share``."""
    found = []
    for view in views:
        image, alpha = render(gaussians, features, view.camera, near)
        ids = view.mask_map()
        # In a pixel that is covered less, the feature is too small by that much.
        inside = (ids >= 0) & (alpha >= covered_share)
        found.append(filled_masks(image[inside], ids[inside], view.mask_count))
    means, pure = zip(*found, strict=True)
    return np.concatenate(means), np.concatenate(pure)


def alone_evidence(
    gaussians: Gaussians,
    views: Sequence[View],
    near: float,
    instance_ids: NDArray[np.int32],
    instance_features: NDArray[np.floating],
    mask_features: NDArray[np.floating],
    covered_share: float,
) -> Evidence:
    """The paper's evidence: each instance rendered alone in every view, as if nothing were in front of it.

    An instance's pixels are those it covers by more than ``covered_share`` (pi); the distance is the mean over those
    that lie in the mask. Instances without a Gaussian in the image are not rendered.
    One rendering per instance and view: slow. near: depth of the near plane; the rest as in `visible_evidence`.
    """
    count = len(instance_features)
    # Masks of all views are numbered consecutively: where each view's masks begin.
    first = np.cumsum([0, *(view.mask_count for view in views)])
    shared = np.zeros((first[-1], count))
    distance = np.full((first[-1], count), np.inf)
    mask_area = np.zeros(first[-1])
    instance_area = np.zeros((len(views), count))
    members = [gaussians.take(np.flatnonzero(instance_ids == instance)) for instance in range(count)]
    for index, view in enumerate(views):
        rows = slice(first[index], first[index + 1])
        ids = view.mask_map().ravel()
        mask_area[rows] = np.bincount(ids[ids >= 0], minlength=view.mask_count)
        for instance, own in enumerate(members):
            if not _in_image(own, view.camera, near):
                continue
            # An instance's Gaussians share one feature, so its map is that times the coverage: no channels to render.
            alpha = render(own, np.zeros((len(own), 0), np.float32), view.camera, near)[1].ravel().astype(np.float64)
            covered = alpha > covered_share
            instance_area[index, instance] = covered.sum()
            # |M_i - P_j| of Eq. 5 at each pixel that the instance shares with a mask, then its mean by mask.
            both = covered & (ids >= 0)
            common = np.bincount(ids[both], minlength=view.mask_count)
            rendered = alpha[both, None] * instance_features[instance]
            apart = np.abs(rendered - mask_features[rows][ids[both]]).sum(axis=1)
            total = np.bincount(ids[both], apart, view.mask_count)
            shared[rows, instance] = common
            distance[rows, instance] = np.where(common > 0, total / np.maximum(common, 1), np.inf)
    return Evidence(shared, mask_area, instance_area, distance)


def eq5_scores(evidence: Evidence, mask_view: NDArray[np.int32], settings: MatchingSettings) -> NDArray[np.float64]:
    """(masks, K) float64 in [0, 1]: S_ij of Eq. 5, or one of its factors alone."""
    # The distance is summed over channels, and infinite without a common pixel: as printed, scores would be negative.
    area, likeness = evidence.instance_area[mask_view], np.maximum(1 - evidence.distance, 0)
    if settings.score == "feature":
        return likeness
    whole = area if settings.score == "within" else area + evidence.mask_area[:, None] - evidence.shared
    overlap = np.divide(evidence.shared, whole, out=np.zeros_like(whole), where=whole > 0)
    return overlap if settings.score == "iou" else overlap * likeness


def match_masks(
    table: MaskTable, instance_ids: NDArray[np.int32], evidence: Evidence, settings: MatchingSettings
) -> Matching:
    """Accept masks for instances, and describe each instance by the encoder's features of its masks.

    In every view an instance takes its best-scoring mask, if that score exceeds the threshold; with fewer than
    ``min_views`` such views it takes none at all. Its descriptor is the mean direction of its masks' features, equally
    weighted. Masks without a feature (zero rows) are evidence, but in no descriptor.
    """
    scores = eq5_scores(evidence, table.mask_view, settings)
    masks, owners = _accepted(scores, table.mask_view, settings)
    count = scores.shape[1]
    accepted = np.bincount(owners, minlength=count).astype(np.int32)
    features = directions(table.mask_features)
    total = np.zeros((count, features.shape[1]))
    np.add.at(total, owners, features[masks])
    described = np.flatnonzero(np.linalg.norm(total, axis=1) > 1e-12)  # opposite features can cancel
    # Agreement: the mean cosine between an instance's descriptor and its masks, of those that have a feature.
    with_feature = np.bincount(owners[features[masks].any(axis=1)], minlength=count)
    cosines = np.bincount(owners, (features[masks] * directions(total)[owners]).sum(axis=1), count)
    instances = InstanceTable(
        descriptors=directions(total[described]).astype(np.float32),
        descriptor_instance=described.astype(np.int32),
        points=np.bincount(instance_ids[instance_ids >= 0], minlength=count).astype(np.int32),
        views=accepted,  # at most one mask of each view
        masks=accepted.copy(),
        agreement=(cosines / np.maximum(with_feature, 1)).astype(np.float32),
        visible_area=np.bincount(owners, evidence.shared[masks, owners], count).astype(np.float32),
    )
    owner = np.full(len(scores), -1, np.int32)
    by_score = np.argsort(scores[masks, owners], kind="stable")  # the last write wins: the best score
    owner[masks[by_score]] = owners[by_score]
    return Matching(instances, owner)


def _accepted(
    scores: NDArray[np.float64], mask_view: NDArray[np.int32], settings: MatchingSettings
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs (mask, instance), at most one for each view and instance, sorted by instance, then view."""
    best = []
    for view in np.unique(mask_view):
        rows = np.flatnonzero(mask_view == view)
        best.append(rows[scores[rows].argmax(axis=0)])
    if not best or scores.shape[1] == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    masks = np.stack(best, axis=1)  # (K, views that have masks)
    reached = np.take_along_axis(scores.T, masks, axis=1)
    # A relative threshold is a factor on what the scene's typical instance scores in its best view.
    best_of_instance = reached.max(axis=1)
    unit = np.median(best_of_instance[best_of_instance > 0]) if settings.relative and best_of_instance.any() else 1.0
    good = reached > settings.threshold * unit
    good[good.sum(axis=1) < settings.min_views] = False
    return masks[good], np.nonzero(good)[0]


def _in_image(gaussians: Gaussians, camera: Camera, near: float) -> bool:
    """Whether any center lies in front of the camera and in the image, or in the margin from which splats reach in."""
    uv_px, depth = camera.project(gaussians.xyz)
    size = np.array([camera.width, camera.height])
    # From the middle: half the image, and the share of that half by which the projection goes beyond.
    reach = (0.5 + 0.5 * FRUSTUM_MARGIN) * size
    return bool((np.abs(uv_px[depth > near] - 0.5 * size) < reach).all(axis=1).any())
