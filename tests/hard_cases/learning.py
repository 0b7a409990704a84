"""Features whose means meet, codebooks larger than their data, instances without evidence, the published losses."""

from __future__ import annotations

from itertools import combinations

import literal
import numpy as np
from numpy.typing import NDArray

from hard_cases import naive
from hard_cases.case import Answer, agrees, powers, refuses
from hard_cases.inputs import NEAR, by_ball, int32, mask_table_of, single, solid, two_balls, unit_rows
from og_pointcloud.cloud import UNOBSERVED
from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.fitting.association import describe_instances
from og_pointcloud.fitting.fit import fit
from og_pointcloud.fitting.learned.codebook import kmeans, two_level_codebook
from og_pointcloud.fitting.learned.instance_features import FeatureObjective, learn_features
from og_pointcloud.scene import Points, Scene
from og_pointcloud.settings import CodebookSettings, FeatureSettings, PaperSettings

MASKS, EACH = 3, 200
EQ2_ALONE = FeatureSettings(intra=False)


@agrees(1e-6, "distance of two mask means", powers(0, -7, -1))
def eq2_gradient(distance: float) -> Answer:
    """Eq. 2 where masks share nearly all they show; naive: 1 / d^2 of float32 means."""
    features = (0.5 + 0.1 * np.random.default_rng(0).normal(size=(600, 6))).astype(np.float32)
    weights = np.ones((MASKS, 600), np.float32)
    weights += (distance * np.random.default_rng(1).normal(size=weights.shape) * 10).astype(np.float32)
    weights = np.abs(weights)
    _, gradient = FeatureObjective(mask_table_of(weights, [0] * MASKS), EQ2_ALONE).at(features, closest=0)
    size = weights.astype(np.longdouble).sum(axis=1, keepdims=True)
    means = weights.astype(np.longdouble) @ features / size
    pull = np.zeros_like(means)
    for i, j in combinations(range(MASKS), 2):
        apart = means[i] - means[j]
        pull[i] -= 4 * apart / (apart @ apart) ** 2 / (MASKS * (MASKS - 1))
        pull[j] += 4 * apart / (apart @ apart) ** 2 / (MASKS * (MASKS - 1))
    largest = np.abs(pull).max()
    exact = (weights.T / size.T) @ (pull / largest)

    def plain() -> NDArray[np.floating]:
        total = weights.sum(axis=1, keepdims=True)
        return (weights / total).T @ naive.eq2_gradient(weights @ features / total) / np.float32(largest)

    return Answer(gradient / float(largest), exact, plain)


@agrees(1e-5, "spread of the features in a mask", powers(0, -5, -1))
def eq1_value(spread: float) -> Answer:
    """Eq. 1 as a quadratic form where features nearly agree: a small difference of large sums."""
    random = np.random.default_rng(0)
    weights = np.where(random.random((4, 3000)) < 0.5, random.random((4, 3000)), 0).astype(np.float32)
    features = (0.5 + spread * random.normal(size=(3000, 6))).astype(np.float32)
    eq1_alone = FeatureSettings(inter=False, cohesion_weight=1.0)
    objective = FeatureObjective(mask_table_of(weights, [0, 0, 1, 1]), eq1_alone)
    cohesion, _ = objective.at(features[objective.shown], closest=1)
    wide, size = weights.astype(np.longdouble), weights.astype(np.longdouble).sum(axis=1)
    means = wide @ features / size[:, None]
    exact = sum((w * np.square(features - mean).sum(axis=1)).sum() for w, mean in zip(wide, means, strict=True))
    return Answer(cohesion, exact / size.sum(), lambda: naive.eq1(weights, features))


@agrees(1e-6)
def one_mask_only() -> Answer:
    """A single mask: Eq. 2 has no pair, Eq. 1 is met exactly."""
    learned = learn_features(mask_table_of(np.ones((1, 50)), [0]))
    return Answer(np.r_[np.ptp(learned.features, axis=0), learned.objective[-1]], np.zeros(7))


@refuses(
    SceneError, "none of the 2 masks shows a Gaussian", "expected at least one", "make masks, and check that poses"
)
def nothing_to_learn_from() -> object:
    """Masks that show no Gaussian."""
    return learn_features(mask_table_of(np.zeros((2, 50)), [0, 0]))


@agrees(0)
def more_clusters_than_points() -> Answer:
    """A codebook of 100 x 10 for five points: a leaf each, none empty."""
    features, xyz = unit_rows(5, 6), unit_rows(5, 3, seed=1)
    settings = CodebookSettings(k1=100, k2=10)
    book = two_level_codebook(features, xyz, np.ones(5), mask_table_of(np.ones((2, 5)), [0, 0]), settings)
    return Answer(np.r_[len(np.unique(book.leaf)), len(book.leaf_centers)], np.array([5, 5]))


@agrees(0)
def empty_clusters() -> Answer:
    """Five groups of points, five centers in one place: the empty clusters start again where points are far off."""
    groups = np.repeat(np.arange(5), 20)
    values = (10 * np.eye(5)[groups] + 0.1 * np.random.default_rng(0).normal(size=(100, 5))).astype(np.float32)
    own, _ = kmeans(values, np.ones(100), np.tile(values[:1], (5, 1)), 30)
    return Answer(np.r_[[len(np.unique(own[groups == g])) for g in range(5)], len(np.unique(own))], np.r_[[1] * 5, 5])


@agrees(0, "offset of the values, of their spread", powers(0, 6))
def kmeans_offset(offset: float) -> Answer:
    """k-means of values far from zero; naive: distances as |x|^2 - 2 x c + |c|^2."""
    random = np.random.default_rng(0)
    values = (offset + random.normal(size=(400, 3))).astype(np.float32)
    centers = values[:8].copy()
    exact = np.square(values.astype(float)[:, None] - centers.astype(float)).sum(axis=2).argmin(axis=1)
    own, _ = kmeans(values, np.ones(400), centers, 0)
    return Answer(own.astype(np.int64), exact, lambda: naive.nearest_center(values, centers))


@agrees(0)
def identical_values() -> Answer:
    """k-means of points that are all the same: one cluster, whatever k."""
    own, _ = kmeans(np.ones((50, 3), "f4"), np.ones(50), np.ones((4, 3), "f4"), 30)
    return Answer(own, np.zeros(50, np.int32))


@refuses(
    OgPointcloudError, "row 0 of the codebook's input is [nan, nan]", "expected finite values", "leave out such points"
)
def values_not_a_number() -> object:
    """k-means of NaN."""
    return kmeans(np.full((5, 2), np.nan, "f4"), np.ones(5), np.zeros((1, 2), "f4"), 3)


@agrees(0, "points", (1, 2, 3, 30))
def few_points(count: float) -> Answer:
    """A cloud of so many points, all in one place in the middle of a ball."""
    scene, _ = two_balls()
    middle = np.tile(single([[-0.8, 0, 0]]), (int(count), 1))
    cloud = Points(middle, scene.points.origin)
    ids = fit(Scene(cloud, scene.views, "s"), progress=False).instance_ids
    return Answer(ids, np.zeros(int(count), np.int32))


@agrees(0)
def coincident_cloud() -> Answer:
    """Every point of the cloud twice in one place: both are of their ball."""
    scene, balls = two_balls()
    twice = Points(np.concatenate([scene.points.xyz] * 2), scene.points.origin)
    ids = fit(Scene(twice, scene.views, "s"), progress=False).instance_ids
    return Answer(by_ball(ids, np.tile(balls, 2)), np.tile(balls, 2))


@agrees(0)
def points_no_view_saw() -> Answer:
    """Points behind every camera are unobserved, not background and no instance."""
    scene, balls = two_balls()
    hidden = single([[0, 0, 1e4], [0, 10, 1e4]])
    cloud = Points(np.concatenate([scene.points.xyz, hidden]), scene.points.origin)
    ids = fit(Scene(cloud, scene.views, "s"), progress=False).instance_ids
    return Answer(np.r_[by_ball(ids[:600], balls), ids[600:]], np.r_[balls, int32([UNOBSERVED, UNOBSERVED])])


@agrees(0)
def instance_no_mask_shows() -> Answer:
    """Of three instances the last has no mask: it has no descriptor, so no word is ever its label."""
    table = mask_table_of(np.eye(2, 30), [0, 0])
    ids = np.repeat(int32([0, 1, 2]), 10)
    instances = describe_instances(table, int32([0, 1]), ids, 3)
    return Answer(instances.descriptor_instance, int32([0]))


@agrees(1e-9, "distance of two mask means", powers(0, -8, -1), slow=True)
def paper_losses(distance: float) -> Answer:
    """Eq. 1 and 2 of the paper mode and their gradients, where the means of masks of one view meet."""
    means = 0.5 + distance * np.eye(MASKS, 6)
    return _losses(means.repeat(EACH, axis=0), np.arange(MASKS).repeat(EACH))


@agrees(1e-9, slow=True)
def paper_losses_of_one_mask() -> Answer:
    """A view with a single mask: Eq. 2 has no pair."""
    return _losses(np.full((EACH, 6), 0.5), np.zeros(EACH, np.int64))


@agrees(1e-6, slow=True)
def paper_codebook_with_empty_clusters() -> Answer:
    """Two features in all and eight clusters of eight: the center of each point's leaf is its feature."""
    from og_pointcloud.fitting.learned.paper import train_codebook
    from og_pointcloud.fitting.learned.rendered_views import RenderedViews

    scene, balls = two_balls(points=40)
    features = (np.where(balls[:, None] == 0, 0.2, 0.7) * np.ones((1, 6))).astype(np.float32)
    still = PaperSettings(normalize=False, k1=8, k2=8, coarse_rate=0.0, fine_rate=0.0, schedule_share=1e-3)
    book = train_codebook(
        RenderedViews(solid(scene.points.xyz), scene.views, NEAR, still, whole=False), features, still
    )
    known = np.flatnonzero(book.leaf >= 0)
    return Answer(np.r_[book.centers[book.leaf[known]].ravel(), len(known) > 40], np.r_[features[known].ravel(), 1])


def _losses(image: NDArray[np.float64], mask: NDArray[np.int64]) -> Answer:
    """Both losses of an image of features, with some noise, and their gradients, each as a part of the largest."""
    import torch

    from og_pointcloud.fitting.learned.paper import SMALLEST_DISTANCE, view_losses

    image = image + 1e-3 * np.random.default_rng(0).normal(size=image.shape)
    values = torch.tensor(image, requires_grad=True)
    losses = view_losses(values, torch.from_numpy(mask), PaperSettings(formula="paper"))
    gradients = [torch.autograd.grad(loss, values, retain_graph=True)[0].numpy() for loss in losses]
    ours = [losses[0].item(), losses[1].item(), *gradients]
    exact = literal.paper_losses(image, mask, SMALLEST_DISTANCE)
    size = [max(np.abs(part).max(), 1e-300) for part in exact]
    return Answer(
        np.concatenate([np.ravel(part) / by for part, by in zip(ours, size, strict=True)]),
        np.concatenate([np.ravel(part) / by for part, by in zip(exact, size, strict=True)]),
    )
