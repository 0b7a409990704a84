"""Which views a fit needs, against slow literal forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import camera, room_poses, sample_surfaces

import og_pointcloud as og
from og_pointcloud.journal import Journal, LeftOut
from og_pointcloud.rendering.coverage import (
    DEPTH_RATIO,
    MAX_RARE_SHARE,
    POINTS_PER_CELL,
    masks_at,
    needed_views,
    seen_points,
    with_needed_views,
)
from og_pointcloud.scene import Camera, Points, Scene, View
from og_pointcloud.settings import FitSettings, GeometrySettings


def reference_seen(xyz: NDArray[np.floating], view: Camera) -> NDArray[np.bool_]:
    """(n,) bool, by the definition: inside the image, and not far behind the nearest point of its cell."""
    uv, depth = view.project(xyz)
    inside = (depth > 0) & view.shows(uv)
    side = np.sqrt(view.width * view.height * POINTS_PER_CELL / max(inside.sum(), 1))
    cell = np.floor(uv / side)
    seen = np.zeros(len(xyz), np.bool_)
    for g in np.flatnonzero(inside):
        beside = inside & (cell == cell[g]).all(axis=1)
        seen[g] = depth[g] <= DEPTH_RATIO * depth[beside].min()
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


@pytest.mark.parametrize("seed", range(6))
def test_needed_views_are_found_one_after_the_other(seed: int) -> None:
    random, enough = np.random.default_rng(seed), 3
    seen = random.random((12, 80)) < random.uniform(0.2, 0.9, (12, 1))
    mask = np.where(seen & (random.random(seen.shape) < 0.7), random.integers(0, 4, seen.shape), -1).astype(np.int32)
    order, stay = random.permutation(12), set(range(12))
    for view in order:
        others = sorted(stay - {view})
        few = [g for g in np.flatnonzero(seen[view]) if seen[others, g].sum() < enough]
        rare = [g for g in range(80) if (mask[others, g] >= 0).sum() < enough]
        shows = [np.flatnonzero(mask[view] == one) for one in range(4)]
        most = any(np.isin(points, rare).sum() > len(points) / 2 for points in shows)
        if len(few) < MAX_RARE_SHARE * seen[view].sum() and not most:
            stay.remove(view)
    assert 3 <= len(stay) < 12
    np.testing.assert_array_equal(np.flatnonzero(needed_views(seen, mask, order, enough)), sorted(stay))


def test_views_that_alone_see_a_thing_stay_and_so_do_those_that_see_nothing_of_the_sample() -> None:
    seen = np.zeros((12, 100), np.bool_)
    seen[:10, :90], seen[10, 50:] = True, True
    needed = needed_views(seen, np.where(seen, 0, -1).astype(np.int32), np.arange(12), 4)
    assert needed[10:].all()
    assert needed[:10].sum() == 4


def test_the_few_views_that_have_a_mask_of_a_thing_stay() -> None:
    """Those that would be left out if they had none."""
    scene = balls(40)
    none = np.full((scene.views[0].camera.height, scene.views[0].camera.width), -1, np.int32)
    bare = [replace(view, masks=none, mask_features=np.ones((0, 4), np.float32)) for view in scene.views]
    stay = {view.name for view in with_needed_views(replace(scene, views=tuple(bare)), 4, Journal(False)).views}
    rare = [k for k, view in enumerate(bare) if view.name not in stay][:3]
    assert rare
    views = tuple(scene.views[k] if k in rare else view for k, view in enumerate(bare))
    few = with_needed_views(replace(scene, views=views), 4, Journal(False))
    assert len(few.views) < 40
    assert {f"view{k}" for k in rare} <= {view.name for view in few.views}


def test_masks_are_looked_up_where_points_are_seen() -> None:
    scene = balls(5)
    masks = np.arange(scene.views[0].mask_map().size, dtype=np.int32).reshape(scene.views[0].mask_map().shape)
    views = [replace(view, masks=masks, mask_features=np.ones((masks.size, 4), np.float32)) for view in scene.views]
    seen = seen_points(scene.points.xyz, [view.camera for view in views])
    found = masks_at(scene.points.xyz, seen, views)
    assert (found[~seen] == -1).all()
    for view, row, shown in zip(views, found, seen, strict=True):
        column, line = np.floor(view.camera.project(scene.points.xyz[shown])[0]).astype(int).T
        np.testing.assert_array_equal(row[shown], masks[line, column])


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
