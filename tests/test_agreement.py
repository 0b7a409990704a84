"""Agreement across views: the sparse products against sets of points; views in another order; what nobody can tell."""

from __future__ import annotations

import numpy as np
import pytest

from og_pointcloud.masking.agreement import (
    ENOUGH_POINTS,
    ENOUGH_SHARE,
    ProposedPoints,
    agreement,
    points_of_proposals,
    rescored,
)
from og_pointcloud.masking.contracts import Proposals
from og_pointcloud.scene import Camera

COUNT = 120


def random_views(seed, counts=(7, 9, 0, 5)):
    rng = np.random.default_rng(seed)
    views = []
    for masks in counts:
        seen = np.flatnonzero(rng.random(COUNT) < 0.7).astype(np.int32)
        middle, width = rng.integers(0, COUNT, masks), rng.integers(1, 40, masks)
        width[:1] = 2  # too few points for any view
        views.append(ProposedPoints(seen, np.abs(seen - middle[:, None]) < width[:, None]))
    return views


def literal(views, index, mask):
    """As the module's docstring says it, with sets."""
    seen = [set(view.seen.tolist()) for view in views]
    sets = [[set(view.seen[row].tolist()) for row in view.inside] for view in views]
    mine, words = sets[index][mask], []
    for other in range(len(views)):
        both = seen[index] & seen[other]
        if other == index or len(mine & both) < max(ENOUGH_SHARE * len(mine), ENOUGH_POINTS):
            continue
        best = 0.0
        for theirs in sets[other]:
            union = (mine | theirs) & both
            best = max(best, len(mine & theirs & both) / len(union)) if union else best
        words.append(best)
    return np.mean(words) if words else np.nan


@pytest.mark.parametrize("seed", range(5))
def test_sets_of_points(seed):
    views = random_views(seed)
    found = agreement(views, COUNT)
    for index, view in enumerate(views):
        expected = [literal(views, index, mask) for mask in range(len(view.inside))]
        np.testing.assert_allclose(found[index], expected, rtol=1e-6)
    assert np.isnan(np.concatenate(found)).any()
    assert len(np.unique(np.concatenate(found))) > 10


def test_the_order_of_views_does_not_matter():
    views = random_views(3, (7, 9, 0, 5, 8, 6))
    order = [4, 2, 0, 5, 3, 1]
    found, shuffled = agreement(views, COUNT), agreement([views[k] for k in order], COUNT)
    for place, k in enumerate(order):
        np.testing.assert_array_equal(shuffled[place], found[k])


def test_the_same_view_twice_agrees_with_itself():
    view = random_views(1, (6,))[0]
    large = view.inside.sum(axis=1) >= ENOUGH_POINTS
    for found in agreement([view, view], COUNT):
        assert (found[large] == 1).all()
        assert np.isnan(found[~large]).all()


def test_one_view_and_views_without_proposals_tell_nothing():
    assert np.isnan(agreement(random_views(0, (6,)), COUNT)[0]).all()
    assert [len(found) for found in agreement(random_views(0, (0, 0)), COUNT)] == [0, 0]


def test_points_behind_the_surface_are_not_seen():
    side = np.linspace(-1, 1, 41, dtype=np.float32)
    x, y = np.meshgrid(side, side)
    near = np.stack([x, y, np.full_like(x, 4)], axis=-1).reshape(-1, 3)
    xyz = np.concatenate([near, near * [1, 1, 1.5], near * [1, 1, -1]]).astype(np.float32)
    asked = np.arange(0, len(xyz), 3)
    camera = Camera(80, 60, 120.0, 120.0, 40.0, 30.0, np.eye(4))
    left = np.zeros((60, 80), bool)
    left[:, :40] = True
    proposals = Proposals(np.stack([left, ~left]), np.ones(2, np.float32))
    found = points_of_proposals(proposals, xyz, np.full(len(xyz), 0.05, np.float32), asked, camera)
    seen = asked[found.seen]
    expected = asked[asked < len(near)]
    expected = expected[120 * xyz[expected, 1] / 4 + 30 < 60]
    assert set(seen.tolist()) == set(expected.tolist())
    assert np.array_equal(found.inside[0], xyz[seen, 0] < 0)
    assert np.array_equal(found.inside[1], xyz[seen, 0] >= 0)


def test_scores_of_what_nobody_can_tell_take_the_usual_agreement():
    scores = rescored(np.array([0.25, 0.25, 1], np.float32), np.array([0.8, np.nan, 0.5]), 0.6)
    assert scores == pytest.approx([0.4, 0.3, 0.5])
