"""Cameras: where points appear, and rotations. What a scene's records refuse."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from og_pointcloud.cloud import Vocabulary
from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.formats.poses import rigid, rotation_of_quaternion
from og_pointcloud.scene import Camera, Points, Scene, View, evenly


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


def test_the_center_of_a_pose_of_rounded_numbers_is_where_it_projects_from():
    place = np.array([500_000.0, 5_600_000.0, 100.0])  # UTM, meters
    rotation = Rotation.random(rng=np.random.default_rng(0)).as_matrix().round(6)
    camera = Camera(64, 48, 50.0, 60.0, 30.0, 25.0, rigid(rotation, -rotation @ place))
    np.testing.assert_allclose(camera.center, place, atol=1e-6)
    assert np.abs(camera.world_to_camera @ [*camera.center, 1])[:3].max() < 1e-6


def test_the_middle_of_the_first_pixel_is_at_a_half():
    camera = Camera(4, 3, 2.0, 2.0, 0.5, 0.5, np.eye(4))
    uv_px, depth = camera.project(np.array([[0.0, 0.0, 7.0], [7.0, 0.0, 7.0], [14.0, 0, 7.0], [0, 0, 0], [0, 0, -7.0]]))
    np.testing.assert_array_equal(uv_px[:3], [[0.5, 0.5], [2.5, 0.5], [4.5, 0.5]])
    np.testing.assert_array_equal(depth, [7, 7, 7, 0, -7])
    np.testing.assert_array_equal(camera.shows(uv_px), [True, True, False, False, False])


TURNED = rigid(Rotation.from_rotvec([0.1, 0.4, -0.2]).as_matrix(), np.array([1.0, 2, 3]))


def test_a_transposed_pose_is_refused():
    with pytest.raises(SceneError, match=r"the last row of camera pose is \[1.0, 2.0, 3.0, 1.0\]; expected 0 0 0 1"):
        Camera(64, 48, 50.0, 60.0, 30.0, 25.0, TURNED.T)


def test_a_camera_keeps_its_pose_when_the_buffer_that_it_came_in_is_used_again():
    buffer = TURNED.copy()
    camera = Camera(64, 48, 50.0, 60.0, 30.0, 25.0, buffer)
    buffer[:3, 3] = 9
    np.testing.assert_array_equal(camera.world_to_camera, TURNED)
    rgb = np.full((2, 3), 7, np.uint8)
    points = Points.from_world(np.eye(2, 3), rgb=rgb)
    rgb[:] = 9
    assert (points.rgb == 7).all()


def test_a_pose_may_be_a_list_or_a_tensor():
    torch = pytest.importorskip("torch")
    for pose in (TURNED.tolist(), torch.from_numpy(TURNED.copy()).requires_grad_()):
        np.testing.assert_array_equal(Camera(64, 48, 50.0, 60.0, 30.0, 25.0, pose).world_to_camera, TURNED)
    for pose in (None, [[1, 0], [1]], torch.eye(4).to_sparse()):
        with pytest.raises(SceneError, match=r"camera pose is .*; expected a finite 4x4 matrix: drop or repair this"):
            Camera(64, 48, 50.0, 60.0, 30.0, 25.0, pose)


def test_an_images_sides_are_whole_numbers():
    camera = Camera(64.0, np.float32(48), 50.0, 60.0, 30.0, 25.0, np.eye(4))
    assert (type(camera.width), type(camera.height), camera.width, camera.height) == (int, int, 64, 48)
    for side in (48.5, np.nan, np.inf):
        with pytest.raises(SceneError, match=f"camera image is 64x{side}; expected whole numbers from 1 to"):
            Camera(64, side, 50.0, 60.0, 30.0, 25.0, np.eye(4))


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


@pytest.mark.parametrize(
    ("xyz", "origin", "seen"),
    [
        (np.zeros((2, 3)), np.zeros(3), r"xyz is float64 \(2, 3\)"),
        (np.zeros((2, 4), np.float32), np.zeros(3), r"xyz is float32 \(2, 4\)"),
        (np.zeros(6, np.float32), np.zeros(3), r"xyz is float32 \(6,\)"),
        (np.zeros((2, 3), np.float32), np.zeros(2), r"origin of shape \(2,\)"),
    ],
)
def test_points_of_another_type_or_shape_are_refused(xyz: np.ndarray, origin: np.ndarray, seen: str):
    with pytest.raises(
        SceneError, match=seen + r".*; expected float32 \(\d, 3\) near zero and \(3,\): Points.from_world"
    ):
        Points(xyz, origin)


def _view(**parts: Any) -> View:
    camera, ids, features = (
        Camera(4, 3, 2.0, 2.0, 2.0, 1.5, np.eye(4)),
        np.zeros((3, 4), int),
        np.eye(2, dtype=np.float32),
    )
    return View(**{"name": "a", "camera": camera, "masks": ids, "mask_features": features, **parts})


@pytest.mark.parametrize(
    "masks", [np.zeros((3, 4)), np.ones((3, 4), bool), np.zeros((2, 3, 4), int), np.zeros(12, int), None]
)
def test_masks_that_are_no_map_of_whole_numbers_are_refused(masks: Any):
    """A boolean mask would say that mask 0 is all around it."""
    with pytest.raises(
        SceneError, match=r"view 'a': the mask map is .*; expected whole numbers \(3, 4\): rows of mask_fe"
    ):
        _view(masks=masks).mask_map()


@pytest.mark.parametrize("image", [np.zeros((3, 4, 3)), np.zeros((3, 4), np.uint8), np.zeros((4, 3, 3), np.uint8)])
def test_photographs_that_are_no_bytes_of_the_cameras_size_are_refused(image: np.ndarray):
    with pytest.raises(
        SceneError, match=r"view 'a': the image is .*; expected uint8 \(3, 4, 3\), the size of its camera: fix w"
    ):
        _view(image=image).image_rgb()


def test_views_without_a_name_and_scenes_without_a_point_are_refused():
    with pytest.raises(SceneError, match="a view's name is 3; expected text"):
        _view(name=3)
    with pytest.raises(SceneError, match="the scene has 0 points; expected at least one"):
        Scene(Points(np.zeros((0, 3), np.float32), np.zeros(3)), (_view(),), "letters")
    with pytest.raises(SceneError, match=r"view 'a': the camera is a ndarray; expected an og\.Camera"):
        _view(camera=np.eye(4))
    with pytest.raises(SceneError, match=r"view 'a': mask features are object \(\); expected float32"):
        _view(mask_features=None)


@pytest.mark.parametrize(
    ("place", "value", "kind"), [(0, np.zeros((5, 3)), "Points"), (1, ["a.png"], "View"), (2, None, "str")]
)
def test_scenes_of_other_things_are_refused(place: int, value: Any, kind: str):
    parts: list[Any] = [Points(np.zeros((1, 3), np.float32), np.zeros(3)), (_view(),), "letters"]
    parts[place] = value
    with pytest.raises(SceneError, match=f"a scene is given .*; expected {kind}: Scene"):
        Scene(*parts)


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (lambda view: Points([[0, 0, 0.0]], [0, 0, 0]), r"xyz is float64 \(1, 3\).* Points.from_world\(xyz\) makes"),
        (lambda _: Points(np.zeros((1, 3), np.float32), [0, 0, 0], [[1, 2, 3]]), "rgb is int64; expected uint8"),
        (lambda view: replace(view, mask_features=[[1.0, 0]]), r"float64 \(1, 2\); .*pass features.astype"),
        (lambda view: replace(view, mask_features=[[1.0], [1.0, 0]]), "mask_features is .*rows differ in length"),
        (lambda view: replace(view, image=[[[1, 2, 3]]]).image_rgb(), r"image is int64 \(1, 1, 3\); expected uint8"),
        (lambda view: replace(view, mask_tracks=[0.5] * view.mask_count), "mask tracks are float64"),
        (lambda view: Vocabulary(("a",), [["x", 0]]), "vocabulary vectors is <U21; expected float32"),
        (lambda view: Vocabulary(("a", "b"), [[1, 0]]), "2 names and vectors of shape"),
    ],
)
def test_lists_are_told_as_the_arrays_that_they_are(made, said):
    with pytest.raises(OgPointcloudError, match=said):
        made(_view())


def test_views_may_come_from_a_generator():
    views = [_view(name="a"), _view(name="b")]
    scene = Scene(Points(np.zeros((1, 3), np.float32), np.zeros(3)), (view for view in views), "letters")  # type: ignore[arg-type]
    assert scene.views == tuple(views)
    with pytest.raises(SceneError, match="two views are named 'a'; expected unique"):
        Scene(scene.points, views[:1] * 2, "letters")  # type: ignore[arg-type]
    with pytest.raises(SceneError, match="the scene has 0 views"):
        Scene(scene.points, iter(()), "letters")  # type: ignore[arg-type]


def test_tensors_are_taken_as_arrays_are():
    torch = pytest.importorskip("torch")
    xyz, rgb, features = np.ones((2, 3)), np.full((2, 3), 7, np.uint8), np.eye(2, 4, dtype=np.float32)
    points = Points.from_world(torch.from_numpy(xyz), rgb=torch.from_numpy(rgb))
    assert points.xyz_world.tolist() == xyz.tolist()
    view = _view(mask_features=torch.from_numpy(features), mask_tracks=torch.arange(2))
    rgb[:], features[:] = 0, 0  # copied
    assert points.rgb is not None
    assert (points.rgb == 7).all()
    assert view.mask_features.tolist() == np.eye(2, 4).tolist()
    with pytest.raises(SceneError, match="mask features are float64"):
        _view(mask_features=torch.zeros(2, 4, dtype=torch.float64))


def test_evenly_takes_first_and_last():
    assert evenly([1, 2, 3, 4, 5], 3) == [1, 3, 5]
    assert evenly([1, 2], 5) == [1, 2]
    assert evenly([], 3) == []


def test_lists_of_what_is_right_are_taken():
    points = Points(np.zeros((2, 3), np.float32), [1, 2, 3])
    assert points.origin.tolist() == [1, 2, 3]
    assert Vocabulary(("a",), [[1, 0]]).vectors.dtype == np.float32
