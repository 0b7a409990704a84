"""Cameras: where points appear, and rotations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.poses import rigid, rotation_of_quaternion
from og_pointcloud.scene import Camera, Points


@pytest.mark.parametrize("seed", range(5))
def test_projected_points_lie_on_the_ray_of_their_pixel(seed: int):
    rng = np.random.default_rng(seed)
    pose = rigid(Rotation.random(rng=rng).as_matrix(), rng.normal(0, 3, 3))
    camera = Camera(64, 48, 50.0, 60.0, 30.0, 25.0, pose)
    xyz = rng.normal(0, 5, (200, 3)).astype(np.float32)
    uv_px, depth = camera.project(xyz)
    rays = np.column_stack([(uv_px - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones(len(xyz))])
    back = (rays * depth[:, None]) @ pose[:3, :3] + camera.center
    before = depth > 0
    assert uv_px.dtype == depth.dtype == np.float64
    assert 0 < before.sum() < len(xyz)
    np.testing.assert_allclose(back[before], xyz[before], atol=1e-9)
    assert np.isnan(uv_px[~before]).all()
    assert not camera.shows(uv_px)[~before].any()


def test_the_middle_of_the_first_pixel_is_at_a_half():
    camera = Camera(4, 3, 2.0, 2.0, 0.5, 0.5, np.eye(4))
    uv_px, depth = camera.project(np.array([[0.0, 0.0, 7.0], [7.0, 0.0, 7.0], [14.0, 0, 7.0], [0, 0, 0], [0, 0, -7.0]]))
    np.testing.assert_array_equal(uv_px[:3], [[0.5, 0.5], [2.5, 0.5], [4.5, 0.5]])
    np.testing.assert_array_equal(depth, [7, 7, 7, 0, -7])
    np.testing.assert_array_equal(camera.shows(uv_px), [True, True, False, False, False])


def test_no_points_are_projected_to_no_pixels():
    uv_px, depth = Camera(4, 3, 2.0, 2.0, 2.0, 1.5, np.eye(4)).project(np.empty((0, 3), np.float32))
    assert (uv_px.shape, depth.shape) == ((0, 2), (0,))


@pytest.mark.parametrize("seed", range(5))
def test_rotation_of_a_quaternion(seed: int):
    turn = Rotation.random(rng=np.random.default_rng(seed))
    np.testing.assert_allclose(rotation_of_quaternion(np.roll(turn.as_quat(), 1)), turn.as_matrix(), atol=1e-15)


@pytest.mark.parametrize("kind", [np.float32, np.uint16, np.int64])
def test_colors_that_are_no_bytes_are_refused(kind: type):
    with pytest.raises(SceneError, match=f"rgb is {np.dtype(kind)}; expected uint8"):
        Points(np.zeros((2, 3), np.float32), np.zeros(3), np.ones((2, 3), kind))
