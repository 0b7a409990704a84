"""Views that see nothing new, and those that do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_fit import boxes_on_a_table, share_right

from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.fitting.fit import fit
from og_pointcloud.rendering.coverage import _spread_order, needed_views
from og_pointcloud.scene import Camera, View
from og_pointcloud.settings import FitSettings, VisibilitySettings

WALL = np.stack([*np.meshgrid(np.linspace(-4, 4, 160), np.linspace(-1, 1, 40)), np.full((40, 160), 2.0)], axis=-1)
WALL = WALL.reshape(-1, 3).astype(np.float32)


def looking_at(x: float) -> View:
    """A view of the wall from x - 1 to x + 1."""
    pose = np.eye(4)
    pose[0, 3] = -x
    return View(str(x), Camera(64, 64, 64, 64, 32, 32, pose), np.zeros((64, 64), np.int32), np.ones((1, 4), np.float32))


def test_of_views_alike_so_many_are_needed_as_are_enough() -> None:
    views = [looking_at(0.001 * index) for index in range(20)]
    for enough in (1, 3, 20, 30):
        assert len(needed_views(WALL, views, enough)) == min(enough, 20)


def test_a_view_of_something_new_is_needed_wherever_it_stands() -> None:
    for place in range(6):
        views = [looking_at(0.0)] * 5
        views.insert(place, looking_at(2.5))
        assert place in needed_views(WALL, views, 1)
        assert len(needed_views(WALL, views, 1)) == 2


def test_what_is_behind_a_wall_is_not_seen() -> None:
    """A camera between two walls sees what the wall in front hides from the others."""
    behind = WALL + np.float32([0, 0, 2])
    between = looking_at(0.0)
    pose = between.camera.world_to_camera.copy()
    pose[2, 3] = -3
    between = replace(between, camera=replace(between.camera, world_to_camera=pose))
    views = [looking_at(0.0), looking_at(0.0), between]
    assert needed_views(np.concatenate([WALL, behind]), views, 1) == [0, 2]


def test_views_that_see_nothing_are_not_needed() -> None:
    assert needed_views(WALL, [looking_at(0.0), looking_at(100.0)], 1) == [0]
    assert needed_views(WALL - np.float32([0, 0, 10]), [looking_at(0.0)], 1) == []


@pytest.mark.parametrize("count", [0, 1, 2, 5, 8, 100])
def test_the_order_spreads_and_leaves_none_out(count: int) -> None:
    order = _spread_order(count)
    assert sorted(order) == list(range(count))
    if count == 8:
        assert order == [0, 4, 2, 6, 1, 5, 3, 7]


@pytest.mark.slow
def test_a_fit_leaves_out_views_given_twice_and_says_so() -> None:
    known = boxes_on_a_table()
    again = [replace(view, name=f"{view.name} again") for view in known.scene.views]
    scene = replace(
        known.scene, views=tuple(view for pair in zip(known.scene.views, again, strict=True) for view in pair)
    )
    cloud = fit(scene, FitSettings(visibility=VisibilitySettings(enough_views=4)), progress=False)
    assert cloud.provenance["notes"]["table"]["views"] < 16
    assert any("of 16 views" in entry["what"] for entry in cloud.provenance["left_out"])
    assert share_right(cloud, known.truth) > 0.95
    assert fit(scene, progress=False).provenance["notes"]["table"]["views"] == 16


def test_no_view_is_not_enough() -> None:
    with pytest.raises(OgPointcloudError, match="enough_views is 0; expected at least 1"):
        VisibilitySettings(enough_views=0)
