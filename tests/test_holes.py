"""What shows through holes of an object: a slanted table top of few points over a floor, and what is no hole."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from test_grouping import ONE, hand_table

from og_pointcloud.fitting.holes import HALF_PLANE_MEAN_DIRECTION, WINDOW_POINTS, seen_through_holes
from og_pointcloud.fitting.see_through import SEEN_THROUGH_SHARE, without_see_through
from og_pointcloud.rendering.splatting import Gaussians
from og_pointcloud.scene import Camera
from og_pointcloud.settings import MembershipSettings

Doubles = NDArray[np.float64]
GAP, FRONT_SHARE = 0.2, 0.2


def over_a_floor(rng: np.random.Generator, top: int = 400, floor: int = 80) -> tuple[Doubles, Doubles]:
    """Places in the image (n, 2) in the unit square, and depths: first of a top from 1 to 2.2 deep, slanted, then of
    a floor 0.9 behind it. Over the whole mask their depths leave no gap."""
    xy = rng.random((top + floor, 2))
    return xy, 1 + 1.2 * xy[:, 1] + np.where(np.arange(top + floor) < top, 0, 0.9)


def found_hidden(xy: Doubles, depth: Doubles, weight: Doubles, area: float) -> NDArray[np.bool_]:
    """What the kernel finds of points in any order."""
    order, hidden = np.argsort(depth), np.empty(len(depth), bool)
    hidden[order] = seen_through_holes(xy[order], depth[order], weight[order], area, GAP, FRONT_SHARE)
    return hidden


def literal(xy: Doubles, depth: Doubles, weight: Doubles, area: float, gap: float, share: float) -> list[bool]:
    """The same, point by point."""
    n, low = len(depth), xy.min(axis=0)
    wide, high = np.ptp(xy, axis=0)
    cell = max(np.sqrt(max(area * WINDOW_POINTS / 9, wide * high / 4) / n), (wide + high) / (4 * n), 1e-12)
    cells = ((xy - low) / cell).astype(int)
    hidden = []
    for point in range(n):
        about = np.flatnonzero((abs(cells - cells[point]) <= 1).all(axis=1))
        about = about[np.argsort(depth[about])]
        step = max(gap, 3 * cell * depth[about[0]])
        runs = np.split(about, np.flatnonzero(np.diff(depth[about]) > step) + 1)
        front = [k for k, run in enumerate(runs) if weight[run].sum() >= share * weight[about].sum()]
        if not front or not any(point in run for run in runs[front[0] + 1 :]):
            hidden.append(False)
            continue
        away = xy[runs[front[0]]] - xy[point]
        mean = (away / np.linalg.norm(away, axis=1, keepdims=True)).mean(axis=0)
        hidden.append(bool(np.linalg.norm(mean) < HALF_PLANE_MEAN_DIRECTION))
    return hidden


@pytest.mark.parametrize("seed", range(5))
def test_a_floor_shows_through_a_slanted_top_which_stays(seed: int) -> None:
    xy, depth = over_a_floor(np.random.default_rng(seed))
    hidden = found_hidden(xy, depth, np.ones(len(xy)), 1.0)
    inside = ((xy > 0.1) & (xy < 0.9)).all(axis=1)
    assert not hidden[:400].any()
    assert hidden[400:][inside[400:]].mean() > 0.95


@pytest.mark.parametrize("seed", range(5))
def test_the_kernel_is_the_rule_point_by_point(seed: int) -> None:
    rng = np.random.default_rng(seed)
    xy, depth = over_a_floor(rng, 150, 90)
    depth += 0.05 * rng.normal(size=len(depth))
    weight = rng.random(len(depth))
    found = found_hidden(xy, depth, weight, 0.8)
    assert 0 < found.sum() < len(found)
    assert found.tolist() == literal(xy, depth, weight, 0.8, GAP, FRONT_SHARE)
    order = rng.permutation(len(depth))
    np.testing.assert_array_equal(found_hidden(xy[order], depth[order], weight[order], 0.8), found[order])


def test_many_points_in_one_window_are_sorted_too() -> None:
    """A mask that is small for its points: all but two lie in one cell, more than are sorted by insertion."""
    rng = np.random.default_rng(3)
    xy = np.concatenate([1e-3 * rng.random((400, 2)), [[1.0, 0.0], [0.0, 1.0]]])
    depth, weight = np.where(np.arange(402) % 4 == 0, 2, 1) + 0.01 * rng.random(402), rng.random(402)
    found = found_hidden(xy, depth, weight, 1.0)
    assert 0 < found.sum() < len(found)
    assert found.tolist() == literal(xy, depth, weight, 1.0, GAP, FRONT_SHARE)


def test_what_is_behind_the_rim_of_an_object_is_not_behind_a_hole() -> None:
    rng = np.random.default_rng(0)
    xy = rng.random((600, 2))
    beyond = xy[:, 0] > 0.5
    hidden = found_hidden(xy, np.where(beyond, 2.0, 1.0), np.ones(600), 1.0)
    assert hidden.sum() < 0.02 * beyond.sum()


def test_a_speck_before_a_surface_is_not_its_front() -> None:
    xy = np.random.default_rng(1).random((300, 2))
    depth = np.where(np.arange(300) < 10, 1.0, 2.0)
    assert not found_hidden(xy, depth, np.ones(300), 1.0).any()


@pytest.mark.parametrize("n", [0, 1, 2])
def test_a_mask_of_few_points_has_no_hole(n: int) -> None:
    xy, depth = np.zeros((n, 2)), np.arange(1.0, n + 1)
    assert not found_hidden(xy, depth, np.ones(n), 1.0).any()


def test_what_shows_through_a_hole_keeps_a_little_of_its_weight() -> None:
    """By a camera of 100 px a mask of 10^4 pixels is as large as it is far: half of that parts nothing over the whole
    mask; a quarter, about 0.4, does about each point."""
    xy, depth = over_a_floor(np.random.default_rng(2))
    xyz = np.column_stack([(xy - 0.5) * depth[:, None], depth]).astype(np.float32)
    n, camera = len(xyz), Camera(100, 100, 100.0, 100.0, 50.0, 50.0, np.eye(4))
    gaussians = Gaussians(xyz, np.ones_like(xyz), np.ones((n, 4), np.float32), np.ones(n, np.float32))
    table = hand_table(n, [[(range(n), ONE)]])
    table.mask_pixels[:] = 10_000
    before, exposed = table.weights.toarray()[0], table.exposure.toarray()[0]
    after, share = without_see_through(table, gaussians, [camera], MembershipSettings())
    kept = after.weights.toarray()[0] / before
    assert (kept[:400] == 1).all()
    through = kept[400:] < 1
    assert through.mean() > 0.6
    np.testing.assert_allclose(kept[400:][through], SEEN_THROUGH_SHARE, rtol=1e-6)
    np.testing.assert_allclose(after.exposure.toarray()[0], exposed * kept, rtol=1e-6)
    # What masks have in common is compared as if there were no hole.
    assert after.doubted.nnz == through.sum()
    np.testing.assert_allclose(after.with_doubted().exposure.toarray()[0], exposed, rtol=1e-6)
    few = np.arange(0, n, 7)
    np.testing.assert_array_equal(after.of_points(few).with_doubted().exposure.toarray()[0], exposed[few])
    assert share == pytest.approx(0.9 * through.sum() / n, rel=1e-3)
