"""transforms.json of nerfstudio, instant-ngp and Blender."""

import json

import numpy as np
import pytest
from capture_files import edit_poses, make_world, same_camera, write_transforms

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.nerfstudio import read_transforms


def no_size(path):
    raise AssertionError(f"the size of {path} was asked for, although the file states it")


def read(folder, image_size=no_size):
    return read_transforms(folder / "transforms.json", image_size)


@pytest.mark.parametrize(("side", "keys"), [(1, {"from_mitsuba": False}), (-1, {"from_mitsuba": True})])
def test_a_point_in_front_of_the_camera_has_positive_depth(tmp_path, side, keys):
    """Independent of any inverse: an OpenGL camera at (1, 2, 3) that looks along world -z, its own; Mitsuba's looks
    along its z, and its x points to the left."""
    matrix = [[side, 0, 0, 1], [0, 1, 0, 2], [0, 0, side, 3], [0, 0, 0, 1]]
    frame = {"file_path": "a.png", "transform_matrix": matrix}
    content = {"fl_x": 50, "w": 64, "h": 48, "frames": [frame], **keys}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    camera = read(tmp_path).images[0].camera
    right_up_ahead = np.array([1 + 0.5, 2 + 0.25, 3 - 4.0, 1.0])
    np.testing.assert_allclose(camera.world_to_camera @ right_up_ahead, [0.5, -0.25, 4.0, 1.0])
    assert (camera.fy, camera.cx, camera.cy) == (50, 32, 24)


def test_frames_override_the_top(tmp_path):
    write_transforms(tmp_path, make_world())
    edit_poses(tmp_path, lambda content: content["frames"][1].update(fl_x=99.0, w=128, h=96, k1=0.1))
    first, second, _ = read(tmp_path).images
    assert (first.camera.fx, second.camera.fx) == (70.0, 99.0)
    assert (second.camera.width, second.camera.height) == (128, 96)
    assert first.lens is None
    assert second.lens is not None


@pytest.mark.parametrize(
    ("shared", "own", "focal"),
    [
        ({"fl_x": 500}, {"camera_angle_x": 1.0}, (32 / np.tan(0.5),) * 2),
        ({"fl_x": 500, "fl_y": 500}, {"camera_angle_x": 1.0}, (32 / np.tan(0.5),) * 2),
        ({"camera_angle_x": 0.7, "camera_angle_y": 0.7}, {"fl_x": 90}, (90, 90)),
        ({"fl_x": 500, "fl_y": 510}, {"fl_x": 90}, (90, 510)),
        ({"fl_y": 80}, {}, (80, 80)),
        ({"camera_angle_y": 1.0}, {}, (24 / np.tan(0.5),) * 2),
        ({"x_fov": 90, "y_fov": 60}, {}, (32, 24 / np.tan(np.pi / 6))),
    ],
)
def test_a_frames_own_focal_length_counts_and_one_serves_for_both_axes(tmp_path, shared, own, focal):
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist(), **own}
    (tmp_path / "transforms.json").write_text(json.dumps({"w": 64, "h": 48, **shared, "frames": [frame]}))
    camera = read(tmp_path).images[0].camera
    assert (camera.fx, camera.fy) == pytest.approx(focal)


def test_a_unit_without_depth_images_is_not_judged(tmp_path):
    write_transforms(tmp_path, make_world(), integer_depth_scale=0)
    assert read(tmp_path).images[0].integer_depth_unit is None
    edit_poses(tmp_path, lambda content: content["frames"][0].update(depth_file_path="d.png"))
    with pytest.raises(SceneError, match=r"the depth unit is 0\.0; expected world lengths"):
        read(tmp_path)


def test_instant_ngp(tmp_path):
    write_transforms(
        tmp_path, make_world(), aabb_scale=16, scale=0.33, offset=[0.5, 0.5, 0.5], k1=0.0, is_fisheye=False
    )
    edit_poses(tmp_path, lambda content: content["frames"][0].update(file_path=".\\images\\0001", sharpness=3.0))
    images = read(tmp_path).images
    assert images[0].path == "./images/0001"
    assert images[0].lens is None
    edit_poses(tmp_path, lambda content: content.update(is_fisheye=True))
    lens = read(tmp_path).images[0].lens
    assert lens.model == "fisheye"


@pytest.mark.parametrize("model", ["OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "OPENCV_FISHEYE"])
def test_distortion_is_never_ignored(tmp_path, model):
    write_transforms(tmp_path, make_world(), camera_model=model, k1=0.05, p1=0.0)
    lens = read(tmp_path).images[0].lens
    assert lens.terms[0] == 0.05
    assert (lens.model == "fisheye") == (model == "OPENCV_FISHEYE")


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"camera_model": "EQUIRECTANGULAR"}, "an equirectangular image is 64x48; expected twice as wide as high"),
        ({"camera_model": "VR180_L"}, "the camera model is VR180_L; expected one of OPENCV"),
        ({"camera_model": "FISHEYE624"}, "the camera model is FISHEYE624"),
        ({"ftheta_p0": 1.0}, "the camera model is ftheta_p0"),
        ({"equirectangular": True}, "the camera model is equirectangular"),
        ({"orthographic": True}, "the camera model is orthographic"),
        ({"k4": 0.01}, "k4, k5, k6 are 0.01, 0.0, 0.0; expected 0"),
        ({"camera_model": "OPENCV_FISHEYE", "p1": 0.01}, "p1, p2 are 0.01, 0.0; expected 0 for a fisheye"),
        ({"fl_x": None, "fl_y": None}, "neither fl_x .* nor camera_angle_x"),
        ({"fl_x": "wide"}, "fl_x is 'wide'; expected a finite number"),
        ({"fl_x": float("nan")}, "fl_x is nan; expected a finite number"),
        ({"fl_x": -3.0}, "intrinsics .* expected finite numbers, with fx and fy at least"),
        ({"fl_x": None, "camera_angle_x": 0.0}, "camera_angle_x is 0.0; expected radians"),
        ({"w": 0}, "camera image is 0x48"),
    ],
)
def test_bad_lenses_name_the_frame(tmp_path, keys, message):
    write_transforms(tmp_path, make_world(), **keys)
    with pytest.raises(SceneError, match=r"transforms.json, frame 'images/frame_00.png': .*" + message):
        read(tmp_path)


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (None, "transform_matrix is None; expected 4 rows of 4 numbers"),
        ([[1, 2], [3, 4]], "expected 4 rows of 4 numbers"),
        ("identity", "transform_matrix is 'identity'"),
        ((2 * np.eye(4)).tolist(), r"last row of transform_matrix is \[0.0, 0.0, 0.0, 2.0\]"),
        (np.diag([2.0, 2, 2, 1]).tolist(), "differs from a rotation matrix"),
        (np.diag([1.0, 1, -1, 1]).tolist(), "right-handed"),
    ],
)
def test_bad_poses_name_the_frame(tmp_path, matrix, message):
    write_transforms(tmp_path, make_world())
    edit_poses(tmp_path, lambda content: content["frames"][1].update(transform_matrix=matrix))
    with pytest.raises(SceneError, match=r"frame 'images/frame_01.png': .*" + message):
        read(tmp_path)


def test_three_rows_are_enough(tmp_path):
    world = make_world()
    write_transforms(tmp_path, world)
    edit_poses(tmp_path, lambda content: content["frames"][0]["transform_matrix"].pop())
    assert same_camera(read(tmp_path).images[0].camera, world.camera(world.poses[0]))


def test_frames_without_a_finite_pose_are_dropped_by_name(tmp_path):
    write_transforms(tmp_path, make_world())
    lost = np.full((4, 4), -np.inf).tolist()
    edit_poses(tmp_path, lambda content: content["frames"][1].update(transform_matrix=lost))
    transforms = read(tmp_path)
    assert transforms.dropped == ("images/frame_01.png",)
    assert len(transforms.images) == 2
    edit_poses(tmp_path, lambda content: [frame.update(transform_matrix=lost) for frame in content["frames"]])
    with pytest.raises(SceneError, match="none of its 3 frames has a finite transform_matrix"):
        read(tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "is not valid JSON"),
        ("[" * 100_000, "is not valid JSON"),
        ("[]", r"contains \[\]; expected a JSON object"),
        ('{"frames": []}', "no list 'frames'"),
        ('{"frames": {}}', "no list 'frames'"),
        ('{"frames": [3]}', "frame 0 has file_path None"),
        ('{"frames": [{"file_path": 3}]}', "frame 0 has file_path 3"),
        ("\udcff\udcfe{", "cannot be read as text"),
    ],
)
def test_other_files_are_refused(tmp_path, text, message):
    (tmp_path / "transforms.json").write_text(text, errors="surrogateescape")
    with pytest.raises(SceneError, match=message):
        read(tmp_path)
