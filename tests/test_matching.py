"""Eq. 5: masks matched with instances, against the equation written out over pixels and against the paper's way."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from reference_splatting import round_splats
from test_grouping import ONE, OTHER, HandView, hand_table
from test_visibility import NEAR, camera, cloud, patches, table_of

from og_pointcloud.fitting.learned.matching import (
    Evidence,
    Matching,
    alone_evidence,
    eq5_scores,
    filled_masks,
    match_masks,
    rendered_masks,
    visible_evidence,
)
from og_pointcloud.rendering.splatting import Gaussians, view_weights
from og_pointcloud.scene import Camera, View
from og_pointcloud.settings import MatchingSettings

SETTINGS = MatchingSettings()
RED, GREEN = np.array([1.0, 0.0]), np.array([0.0, 1.0])
NOTHING = np.zeros(8, np.float32)


def match(
    views: list[HandView],
    ids: list[int],
    settings: MatchingSettings = SETTINGS,
    instance_features: NDArray[np.float64] | None = None,
    mask_features: NDArray[np.float64] | None = None,
) -> Matching:
    """All instance features alike, where none are given."""
    table = hand_table(len(ids), views)
    count = max(ids) + 1
    of_instances = np.ones((count, 2)) if instance_features is None else instance_features
    of_masks = np.ones((len(table.mask_view), 2)) if mask_features is None else mask_features
    instance_ids = np.array(ids, np.int32)
    return match_masks(table, instance_ids, visible_evidence(table, instance_ids, of_instances, of_masks), settings)


def turned(angle: float) -> Camera:
    """A camera one unit before the middle of the test cloud, turned about the vertical."""
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    pose[2, 3] = 2.0
    return camera(world_to_camera=pose)


def test_visible_evidence_is_the_sum_over_points() -> None:
    """Areas and features of two views, from all that they show, in float64."""
    random = np.random.default_rng(0)
    gaussians = cloud(random)
    views = [View(f"v{k}", turned(0.2 * k), patches(turned(0.2 * k)), np.ones((12, 3), np.float32)) for k in range(2)]
    table = table_of(gaussians, views)
    ids = random.integers(-1, 5, len(gaussians)).astype(np.int32)
    features, mask_features = random.random((5, 6)), random.random((24, 6))
    evidence = visible_evidence(table, ids, features, mask_features)

    onehot = (ids[:, None] == np.arange(5)).astype(np.float64)
    shown, outside = table.weights.toarray().astype(np.float64), table.outside.toarray().astype(np.float64)
    np.testing.assert_allclose(evidence.shared, shown @ onehot, rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(evidence.mask_area, shown.sum(axis=1), rtol=1e-5)
    in_views = [(shown[12 * k : 12 * k + 12].sum(axis=0) + outside[k]) @ onehot for k in range(2)]
    np.testing.assert_allclose(evidence.instance_area, in_views, rtol=1e-5)
    apart = np.abs(mask_features[:, None] - features).sum(axis=2)
    np.testing.assert_allclose(evidence.distance, np.where(evidence.shared > 0, apart, np.inf))
    assert (evidence.shared > 0).any()


def test_equation_5_by_hand() -> None:
    """3 pixels in common of 6 and 5, features 0.25 apart: IoU 3/8, score 3/8 * 3/4."""
    evidence = Evidence(np.array([[3.0]]), np.array([6.0]), np.array([[5.0]]), np.array([[0.25]]))
    view = np.zeros(1, np.int32)
    for score, expected in {"both": 3 / 8 * 3 / 4, "iou": 3 / 8, "feature": 3 / 4}.items():
        np.testing.assert_allclose(eq5_scores(evidence, view, MatchingSettings(score=score)), [[expected]])
    far = replace(evidence, distance=np.array([[1.5]]))
    assert eq5_scores(far, view, SETTINGS)[0, 0] == 0


def wall(x: tuple[float, float], depth: float) -> Gaussians:
    """An opaque upright sheet of splats a pixel apart, seen by `camera`."""
    step = depth / 40
    across, down = np.meshgrid(np.arange(x[0], x[1], step), np.arange(-0.2, 0.2, step))
    xyz = np.stack([across.ravel(), down.ravel(), np.full(across.size, depth)], axis=1)
    flat = np.tile(np.array([step, step, 1e-4], np.float32), (len(xyz), 1))
    return replace(round_splats(xyz, step, 0.99), scale=flat)


def both(a: Gaussians, b: Gaussians) -> Gaussians:
    return Gaussians(*(np.concatenate([getattr(a, f), getattr(b, f)]) for f in ("xyz", "scale", "rotation", "opacity")))


def test_alone_is_visible_where_nothing_is_in_front() -> None:
    """Two opaque walls side by side score alike, to within their soft edges."""
    left, right = wall((-0.5, -0.1), 1.0), wall((0.15, 0.5), 1.0)
    gaussians, ids = both(left, right), np.repeat([0, 1], [len(left), len(right)]).astype(np.int32)
    masks = np.full((37, 50), -1, np.int32)
    masks[8:28, 3:22], masks[8:28, 28:46] = 0, 1
    view = View("v", camera(), masks, np.ones((2, 3), np.float32))
    table = table_of(gaussians, [view])
    colors = np.stack([RED, GREEN])
    visible = visible_evidence(table, ids, colors, colors)
    alone = alone_evidence(gaussians, [view], NEAR, ids, colors, colors, 0.7)
    scores = eq5_scores(visible, table.mask_view, SETTINGS), eq5_scores(alone, table.mask_view, SETTINGS)
    assert scores[0].diagonal().min() > 0.7
    np.testing.assert_allclose(*scores, atol=0.15)


def test_alone_compares_the_map_with_the_filled_mask_pixel_by_pixel() -> None:
    """The paper's distance: blended feature against the mask's, mean over the pixels of both."""
    gaussians = wall((-0.4, 0.2), 1.0)
    masks = np.full((37, 50), -1, np.int32)
    masks[12:20, 20:44] = 0
    view = View("v", camera(), masks, np.ones((1, 3), np.float32))
    ids = np.zeros(len(gaussians), np.int32)
    feature, of_mask = np.array([0.9, 0.3]), np.array([0.8, 0.4])
    evidence = alone_evidence(gaussians, [view], NEAR, ids, feature[None], of_mask[None], 0.7)
    alpha = view_weights(gaussians, camera(), NEAR).toarray().astype(np.float64).sum(axis=1)
    common = alpha[(alpha > 0.7) & (masks.ravel() == 0)]
    distance = np.abs(common[:, None] * feature - of_mask).sum(axis=1).mean()
    np.testing.assert_allclose(evidence.distance, [[distance]], rtol=1e-5)
    assert evidence.shared[0, 0] == len(common) > 0
    assert evidence.mask_area[0] == 8 * 24
    assert evidence.instance_area[0, 0] == (alpha > 0.7).sum()


def test_alone_sees_through_what_is_in_front() -> None:
    """A hidden wall fills the mask of the one before it: IoU cannot tell, the feature can, and true visibility can."""
    front, behind = wall((-0.4, 0.4), 1.0), wall((-0.8, 0.8), 2.0)
    gaussians, ids = both(front, behind), np.repeat([0, 1], [len(front), len(behind)]).astype(np.int32)
    masks = np.full((37, 50), -1, np.int32)
    masks[10:28, 9:41] = 0
    view = View("v", camera(), masks, np.ones((1, 3), np.float32))
    table = table_of(gaussians, [view])
    colors = np.stack([RED, GREEN])
    alone = alone_evidence(gaussians, [view], NEAR, ids, colors, RED[None], 0.7)
    visible = visible_evidence(table, ids, colors, RED[None])
    by_iou = MatchingSettings(score="iou")
    assert eq5_scores(alone, table.mask_view, by_iou)[0, 1] > 0.4
    assert eq5_scores(alone, table.mask_view, SETTINGS)[0, 1] == 0
    assert eq5_scores(visible, table.mask_view, by_iou)[0, 1] < 0.1


def test_alone_skips_what_is_not_in_the_image() -> None:
    gaussians = wall((-0.2, 0.2), 1.0)
    away = replace(gaussians, xyz=gaussians.xyz * np.float32([1, 1, -1]))
    aside = replace(gaussians, xyz=gaussians.xyz + np.float32([50, 0, 0]))
    view = View("v", camera(), np.zeros((37, 50), np.int32), np.ones((1, 3), np.float32))
    for hidden in (away, aside):
        ids = np.zeros(len(hidden), np.int32)
        evidence = alone_evidence(hidden, [view], NEAR, ids, RED[None], RED[None], 0.7)
        assert evidence.instance_area[0, 0] == 0
        assert np.isinf(evidence.distance[0, 0])


def test_the_best_mask_of_each_view_is_accepted() -> None:
    views: list[HandView] = [[([0, 1, 2], ONE), ([3, 4, 5], OTHER)], [([0, 1], ONE), ([2, 3, 4, 5], OTHER)]]
    result = match(views, [0, 0, 0, 1, 1, 1])
    np.testing.assert_array_equal(result.mask_instance, [0, 1, 0, 1])
    np.testing.assert_allclose(result.instances.descriptors, [ONE, OTHER], atol=1e-6)
    np.testing.assert_array_equal(result.instances.masks, [2, 2])
    np.testing.assert_allclose(result.instances.visible_area, [5, 6])
    np.testing.assert_array_equal(result.instances.points, [3, 3])
    np.testing.assert_allclose(result.instances.agreement, 1, rtol=1e-6)


def test_features_decide_where_overlaps_do_not() -> None:
    """Two instances share a mask alike; the one that looks like it takes it."""
    views: list[HandView] = [[([0, 1], ONE)]]
    result = match(views, [0, 1], instance_features=np.stack([RED, GREEN]), mask_features=np.stack([0.9 * RED]))
    np.testing.assert_array_equal(result.mask_instance, [0])
    np.testing.assert_array_equal(result.instances.descriptor_instance, [0])


def test_an_instance_without_an_accepted_mask_has_no_descriptor() -> None:
    """Unknown, not class 0: here one of 20 points of a mask is no match for the mask."""
    result = match([[(range(20), ONE)]] * 3, [0] * 19 + [1])
    np.testing.assert_array_equal(result.instances.descriptor_instance, [0])
    np.testing.assert_array_equal(result.instances.masks, [3, 0])
    assert result.instances.agreement[1] == 0


def test_a_mask_that_several_accept_is_of_the_best() -> None:
    """Of a mask of 6 points one instance has 2, the other 4; whichever comes first."""
    for ids in ([0, 0, 1, 1, 1, 1], [0, 0, 0, 0, 1, 1]):
        result = match([[(range(6), ONE)]], ids)
        np.testing.assert_array_equal(result.instances.masks, [1, 1])
        np.testing.assert_array_equal(result.mask_instance, [np.argmax(np.bincount(ids))])


def test_few_views_are_not_enough_where_more_are_asked() -> None:
    views: list[HandView] = [[([0, 1], ONE), ([2, 3], OTHER)], [([0, 1], ONE)]]
    result = match(views, [0, 0, 1, 1], MatchingSettings(min_views=2))
    np.testing.assert_array_equal(result.instances.descriptor_instance, [0])
    np.testing.assert_array_equal(result.mask_instance, [0, -1, 0])


def test_views_count_alike() -> None:
    """Of 8 points one view's mask has all, the other's 4: weights 1 : 1."""
    views: list[HandView] = [[(range(8), ONE)], [(range(4), OTHER)]]
    plain = match(views, [0] * 8).instances.descriptors
    np.testing.assert_allclose(plain, [(ONE + OTHER) / np.sqrt(2)], rtol=1e-6)


def test_masks_without_a_feature_are_evidence_but_describe_nothing() -> None:
    result = match([[([0, 1], NOTHING)], [([0, 1], ONE)]], [0, 0])
    np.testing.assert_allclose(result.instances.descriptors, [ONE])
    assert result.instances.masks[0] == 2
    assert result.instances.agreement[0] == pytest.approx(1)
    nothing = match([[([0, 1], NOTHING)]], [0, 0])
    assert nothing.instances.descriptors.shape == (0, 8)


@pytest.mark.parametrize("score", ["both", "iou", "feature"])
def test_order_of_views_does_not_matter(score: str) -> None:
    random = np.random.default_rng(1)
    views: list[HandView] = [
        [(random.choice(30, 8, replace=False), random.normal(size=8).astype(np.float32)) for _ in range(2)]
        for _ in range(6)
    ]
    ids = random.integers(0, 4, 30).tolist()
    mask_features = random.random((12, 2))
    settings = MatchingSettings(score=score)  # pyright: ignore
    one = match(views, ids, settings, mask_features=mask_features)
    order = random.permutation(6)
    rows = np.concatenate([[2 * view, 2 * view + 1] for view in order])
    other = match([views[view] for view in order], ids, settings, mask_features=mask_features[rows])
    np.testing.assert_array_equal(other.mask_instance, one.mask_instance[rows])
    np.testing.assert_allclose(other.instances.descriptors, one.instances.descriptors, atol=1e-6)


def test_no_instance_at_all() -> None:
    table = hand_table(3, [[([0, 1], ONE)]])
    ids = np.full(3, -1, np.int32)
    evidence = visible_evidence(table, ids, np.zeros((0, 2)), np.ones((1, 2)))
    result = match_masks(table, ids, evidence, SETTINGS)
    assert len(result.instances) == 0
    np.testing.assert_array_equal(result.mask_instance, [-1])


def test_within_is_the_share_of_the_instance() -> None:
    """A piece of a large mask: Eq. 5 by IoU is small, by its own share it is the likeness alone."""
    evidence = Evidence(np.array([[4.0, 0.0]]), np.array([40.0]), np.array([[5.0, 2.0]]), np.array([[0.1, np.inf]]))
    view = np.zeros(1, np.int32)
    assert eq5_scores(evidence, view, MatchingSettings())[0, 0] == pytest.approx(4 / 41 * 0.9)
    within = eq5_scores(evidence, view, MatchingSettings(score="within"))
    np.testing.assert_allclose(within, [[4 / 5 * 0.9, 0]])


def test_a_relative_threshold_counts_in_the_median_of_the_best_scores() -> None:
    views: list[HandView] = [[([0, 1], ONE), ([4, 5], OTHER)]] * 2
    found = [
        match(views, [0, 0, 0, 0, 1, 1], MatchingSettings(threshold=share, relative=True)).instances.views.tolist()
        for share in (0.6, 0.7, 1.4)
    ]
    assert found == [[2, 2], [0, 2], [0, 0]], "best scores are 0.5 and 1, their median is 0.75"


def test_filled_masks_mask_by_mask() -> None:
    random = np.random.default_rng(0)
    mask = np.repeat([0, 1, 3], [50, 6, 6])
    image = np.where(mask[:, None] == 3, random.random((62, 4)), 0.01 * random.random((62, 4)) + 0.3)
    means, pure = filled_masks(image, mask, 4)
    for index in (0, 1, 3):
        np.testing.assert_allclose(means[index], image[mask == index].mean(axis=0))
    assert pure.tolist() == [True, True, False, False], "mask 2 has no pixel, mask 3 is mixed and small"
    assert filled_masks(random.random((62, 4)), mask, 4)[1].tolist() == [True, False, False, False], "0 is large"


def test_masks_left_out_have_nothing_in_common_with_any_instance() -> None:
    evidence = Evidence(np.ones((2, 1)), np.ones(2), np.ones((1, 1)), np.zeros((2, 1)))
    kept = evidence.of_masks(np.array([True, False]))
    assert eq5_scores(kept, np.zeros(2, np.int32), MatchingSettings()).ravel().tolist() == [1, 0]
    assert kept.distance.ravel().tolist() == [0, np.inf]


def test_rendered_masks_are_filled_from_covered_pixels() -> None:
    gaussians = cloud(np.random.default_rng(0))
    views = [View("v", turned(0.0), patches(turned(0.0)), np.ones((12, 3), np.float32))]
    values = np.random.default_rng(1).random((len(gaussians), 2), np.float32)
    means, pure = rendered_masks(gaussians, views, NEAR, values, 0.3)
    weights, ids = view_weights(gaussians, views[0].camera, NEAR).toarray(), views[0].mask_map().ravel()
    for mask in range(views[0].mask_count):
        pixels = (ids == mask) & (weights.sum(axis=1) >= 0.3)
        expected = (weights[pixels] @ values).mean(axis=0) if pixels.any() else np.zeros(2)
        np.testing.assert_allclose(means[mask], expected, atol=1e-5)
        assert pure[mask] <= pixels.any()
