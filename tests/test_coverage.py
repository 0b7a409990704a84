"""Which views a fit needs, against slow literal forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import camera, room_poses, sample_surfaces

import og_pointcloud as og
from og_pointcloud.journal import Journal, LeftOut
from og_pointcloud.rendering.coverage import BEHIND, CELL_POINTS, FEW, needed_views, seen_points, with_needed_views
from og_pointcloud.scene import Camera, Points, Scene, View
from og_pointcloud.settings import FitSettings, GeometrySettings


def reference_seen(xyz: NDArray[np.floating], view: Camera) -> NDArray[np.bool_]:
    """(n,) bool, by the definition: inside the image, and not far behind the nearest point of its cell."""
    uv, depth = view.project(xyz)
    inside = (depth > 0) & view.shows(uv)
    side = np.sqrt(view.width * view.height * CELL_POINTS / max(inside.sum(), 1))
    cell = np.floor(uv / side)
    seen = np.zeros(len(xyz), np.bool_)
    for g in np.flatnonzero(inside):
        beside = inside & (cell == cell[g]).all(axis=1)
        seen[g] = depth[g] <= BEHIND * depth[beside].min()
    return seen


@pytest.mark.parametrize("seed", range(4))
def test_seen_points_are_those_of_the_definition(seed: int) -> None:
    random = np.random.default_rng(seed)
    xyz = random.uniform([-1, -1, -1], [5, 4, 3.5], (600, 3)).astype(np.float32)  # of a room, and around it
    views = [camera(pose) for pose in room_poses()]
    seen = seen_points(xyz, views)
    assert 0 < seen.mean() < 0.5
    np.testing.assert_array_equal(seen, [reference_seen(xyz, view) for view in views])


def test_no_view_sees_what_lies_behind_a_wall() -> None:
    x, y = (side.ravel() for side in np.meshgrid(np.linspace(-2, 2, 40), np.linspace(-2, 2, 40)))
    wall, beyond = (np.stack([x, y, np.full_like(x, z)], axis=1) for z in (2.0, 5.0))
    ahead = Camera(64, 64, 40.0, 40.0, 32.0, 32.0, np.eye(4))
    seen = seen_points(np.concatenate([wall, beyond]).astype(np.float32), [ahead])[0]
    assert seen[: len(wall)].sum() == ahead.shows(ahead.project(wall)[0]).sum()
    assert not seen[len(wall) :].any()


@pytest.mark.parametrize("seed", range(4))
def test_needed_views_are_found_one_after_the_other(seed: int) -> None:
    random, enough = np.random.default_rng(seed), 3
    seen = random.random((12, 80)) < random.uniform(0.2, 0.9, (12, 1))
    order, stay = random.permutation(12), set(range(12))
    for view in order:
        others = seen[sorted(stay - {view})].sum(axis=0)
        if sum(others[g] < enough for g in np.flatnonzero(seen[view])) < FEW * seen[view].sum():
            stay.remove(view)
    assert 3 <= len(stay) < 12
    np.testing.assert_array_equal(np.flatnonzero(needed_views(seen, order, enough)), sorted(stay))


def test_views_that_alone_see_a_thing_stay_and_so_do_those_that_see_nothing_of_the_sample() -> None:
    seen = np.zeros((12, 100), np.bool_)
    seen[:10, :90], seen[10, 50:] = True, True
    needed = needed_views(seen, np.arange(12), 4)
    assert needed[10:].all()
    assert needed[:10].sum() == 4


def balls(count: int) -> Scene:
    """Two balls on a floor from so many places around them, each time with one mask of all."""
    xyz, _ = sample_surfaces()
    points = Points(xyz + np.float32([2, 1.5, 0]), np.zeros(3))
    views = [camera(pose) for pose in room_poses(count)]
    masks = np.zeros((views[0].height, views[0].width), np.int32)
    one = np.ones((1, 4), np.float32)
    return Scene(points, tuple(View(f"view{k}", view, masks, one) for k, view in enumerate(views)), "one-word")


def test_the_same_views_stay_in_any_order_of_views_and_points() -> None:
    scene, journal = balls(40), Journal(progress=False)
    few = with_needed_views(scene, 8, journal)
    assert 8 <= len(few.views) < 40
    assert journal.left_out == [(LeftOut.VIEWS, {"count": 40 - len(few.views), "total": 40, "enough": 8})]
    shuffled = replace(
        scene, points=scene.points.take(np.arange(len(scene.points))[::-1]), views=tuple(reversed(scene.views))
    )
    again = with_needed_views(shuffled, 8, Journal(progress=False))
    assert {view.name for view in again.views} == {view.name for view in few.views}
    assert with_needed_views(scene, 40, journal) is scene


@pytest.mark.parametrize("tile_points", [None, 1000])
def test_a_fit_takes_the_views_that_it_needs_and_keeps_all_cameras(tile_points: int | None) -> None:
    scene = balls(40)
    settings = FitSettings(geometry=GeometrySettings(enough_views=4, scales=(0.5,)), tile_points=tile_points)
    cloud = og.fit(scene, settings, progress=False)
    (entry,) = (entry for entry in cloud.provenance["left_out"] if entry["key"] == LeftOut.VIEWS.key)
    assert entry["count"] >= 5
    assert len(cloud.cameras) == 40
    assert cloud.instances.views.max() <= 40 - entry["count"]
