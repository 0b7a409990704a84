"""COLMAP models: binary, text, and rigs give the same cameras; damage gives one error."""

import struct

import numpy as np
import pytest
from capture_files import make_world, quaternion_matrix, same_camera, write_colmap_binary, write_colmap_text

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.colmap import find_model, read_images, read_points3d

WRITERS = [write_colmap_binary, write_colmap_text]


def expected_cameras(world):
    return list(map(world.camera, world.poses))


@pytest.mark.parametrize("write", WRITERS)
@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_binary_and_text_hold_the_same_world(tmp_path, write, offset):
    world = make_world(offset=(offset, -offset, 10.0))
    write(tmp_path / "sparse/0", world)
    model = find_model(tmp_path)
    assert model is not None
    assert model == tmp_path / "sparse/0"
    images = read_images(model)
    assert [image.path for image in images] == [f"{name}.png" for name in world.names]
    for image, camera in zip(images, expected_cameras(world), strict=True):
        assert image.distortion is None
        assert same_camera(image.camera, camera, 1e-9)
    xyz, rgb = read_points3d(model)
    np.testing.assert_array_equal(xyz, world.xyz)
    np.testing.assert_array_equal(rgb, world.rgb)


def test_scaled_quaternions_are_normalised(tmp_path):
    world = make_world()
    write_colmap_binary(tmp_path, world, poses=np.hstack([world.quaternions * 3.0, world.translations]))
    assert all(map(same_camera, [image.camera for image in read_images(tmp_path)], expected_cameras(world)))


def split_into_rig(world, camera_from_rig):
    """rig_from_world of one frame per image, such that camera_from_rig @ rig_from_world is the image's pose."""
    return [np.linalg.inv(sensor) @ pose for sensor, pose in zip(camera_from_rig, world.poses, strict=True)]


def pose_row(pose):
    """qw qx qy qz tx ty tz of a 4x4 pose whose rotation angle is below 180 degrees."""
    rotation = pose[:3, :3]
    w = np.sqrt(1 + np.trace(rotation)) / 2
    axis = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    return [w, *(axis / (4 * w)), *pose[:3, 3]]


@pytest.fixture
def rig_world():
    """Images 1 and 3 by camera 5, the rig's reference; image 2 by camera 9, beside it; and an IMU, no camera."""
    world = make_world(seed=4)
    turned = np.eye(4)
    turned[:3, :3] = quaternion_matrix(np.array([np.cos(0.4), 0.0, np.sin(0.4), 0.0]))
    turned[:3, 3] = [-0.2, 0.01, 0.03]
    sensors = [np.eye(4), turned, np.eye(4)]
    frames = split_into_rig(world, sensors)
    if any(1 + np.trace(pose[:3, :3]) < 1e-3 for pose in frames):
        pytest.fail("choose a seed without half turns")
    cameras = {5: ("PINHOLE", world.intrinsics), 9: ("PINHOLE", world.intrinsics)}
    return world, cameras, turned, [pose_row(pose) for pose in frames]


def write_rigs(model, turned, frames, binary):
    camera_ids = [5, 9, 5]
    if binary:
        rig = struct.pack("<QII", 1, 7, 3) + struct.pack("<iI", 0, 5)
        rig += struct.pack("<iIB7d", 0, 9, 1, *pose_row(turned)) + struct.pack("<iIB", 1, 3, 0)
        (model / "rigs.bin").write_bytes(rig)
        data = struct.pack("<Q", 3)
        for index, row in enumerate(frames):
            data += struct.pack("<II7dI", index + 40, 7, *row, 2)
            data += struct.pack("<iIQ", 0, camera_ids[index], index + 1) + struct.pack("<iIQ", 1, 3, 1)
        (model / "frames.bin").write_bytes(data)
        return
    sensor = " ".join(repr(float(value)) for value in pose_row(turned))
    (model / "rigs.txt").write_text(f"# Rig calib list\n7 3 CAMERA 5 CAMERA 9 1 {sensor} IMU 3 0\n")
    lines = [
        f"{index + 40} 7 {' '.join(repr(float(v)) for v in row)} 2 CAMERA {camera_ids[index]} {index + 1} IMU 3 1"
        for index, row in enumerate(frames)
    ]
    (model / "frames.txt").write_text("# Frame list\n" + "\n".join(lines) + "\n")


@pytest.mark.parametrize("binary", [True, False])
def test_rigs_and_frames_place_the_images(tmp_path, rig_world, binary):
    world, cameras, turned, frames = rig_world
    nowhere = np.tile([1.0, 0, 0, 0, 0, 0, 0], (3, 1))  # the images' own poses are useless: only rigs know
    (write_colmap_binary if binary else write_colmap_text)(tmp_path, world, cameras, nowhere)
    write_rigs(tmp_path, turned, frames, binary)
    cameras_read = [image.camera for image in read_images(tmp_path)]
    assert all(map(same_camera, cameras_read, expected_cameras(world)))


def test_an_image_outside_every_frame_keeps_its_own_pose(tmp_path, rig_world):
    world, cameras, turned, frames = rig_world
    write_colmap_text(tmp_path, world, cameras)
    write_rigs(tmp_path, turned, frames, binary=False)
    lines = (tmp_path / "frames.txt").read_text().splitlines()
    (tmp_path / "frames.txt").write_text("\n".join(lines[:-1]) + "\n")
    assert same_camera(read_images(tmp_path)[2].camera, expected_cameras(world)[2])


def test_a_frame_of_an_unknown_rig_is_refused(tmp_path, rig_world):
    world, cameras, turned, frames = rig_world
    write_colmap_text(tmp_path, world, cameras)
    write_rigs(tmp_path, turned, frames, binary=False)
    (tmp_path / "rigs.txt").write_text("8 1 CAMERA 5\n")
    with pytest.raises(SceneError, match=r"frame has rig 7, which the rigs file lacks"):
        read_images(tmp_path)


@pytest.mark.parametrize("write", WRITERS)
def test_camera_models(tmp_path, write):
    world = make_world()
    cameras = {
        1: ("SIMPLE_PINHOLE", (70.0, 31.0, 25.0)),
        2: ("OPENCV", (70.0, 72.0, 31.0, 25.0, 0.1, -0.05, 0.001, 0.002)),
        3: ("OPENCV_FISHEYE", (70.0, 72.0, 31.0, 25.0, 0.0, 0.0, 0.0, 0.0)),
    }
    write(tmp_path, world, cameras)
    pinhole, opencv, fisheye = read_images(tmp_path)
    assert (pinhole.camera.fx, pinhole.camera.fy, pinhole.camera.cx, pinhole.camera.cy) == (70.0, 70.0, 31.0, 25.0)
    assert pinhole.distortion is None
    assert opencv.camera.fy == 72.0
    assert opencv.distortion is not None
    assert opencv.distortion.coefficients == (0.1, -0.05, 0.001, 0.002, 0, 0, 0, 0)
    assert fisheye.distortion is not None, "an equidistant fisheye is no pinhole, although its terms are zero"
    assert fisheye.distortion.fisheye


def test_zero_distortion_is_a_pinhole(tmp_path):
    world = make_world(count=1)
    write_colmap_binary(tmp_path, world, {1: ("OPENCV", (70.0, 72.0, 31.0, 25.0, 0.0, 0.0, 0.0, 0.0))})
    assert read_images(tmp_path)[0].distortion is None


@pytest.mark.parametrize("write", WRITERS)
def test_a_lens_that_cannot_be_undistorted_exactly_is_refused(tmp_path, write):
    write(tmp_path, make_world(), {1: ("FOV", (70.0, 72.0, 31.0, 25.0, 0.9))})
    with pytest.raises(SceneError, match=r"camera 1 has the model FOV; expected one of .*image_undistorter"):
        read_images(tmp_path)


def read_all(model):
    return read_images(model), read_points3d(model)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin"])
def test_every_truncation_of_a_binary_file_is_one_error(tmp_path, rig_world, name):
    world, cameras, turned, frames = rig_world
    write_colmap_binary(tmp_path, world, cameras)
    write_rigs(tmp_path, turned, frames, binary=True)
    read_all(tmp_path)
    whole = (tmp_path / name).read_bytes()
    for size in {*range(0, min(len(whole), 120)), *range(0, len(whole), 37), len(whole) - 1}:
        (tmp_path / name).write_bytes(whole[:size])
        with pytest.raises(SceneError, match=rf"{name} is truncated or damaged: at byte \d+ it needs \d+ more bytes"):
            read_all(tmp_path)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_a_count_beyond_the_file_is_refused_before_anything_is_allocated(tmp_path, name):
    write_colmap_binary(tmp_path, make_world())
    data = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(struct.pack("<Q", 2**61) + data[8:])
    with pytest.raises(SceneError, match=r"truncated or damaged: at byte 8 it needs"):
        read_all(tmp_path)


@pytest.mark.parametrize(
    ("name", "find", "put", "message"),
    [
        ("cameras.txt", "PINHOLE", "BROWN", "line 2: found 'BROWN'; expected a camera model"),
        ("cameras.txt", "70.0", "seventy", "line 2: found 'seventy 72.0 31.0 25.5'; expected 4 numbers"),
        ("cameras.txt", " 25.5", "", "line 2: found .* expected 4 numbers"),
        ("images.txt", "1 ", "one ", "line 3: found 'one'; expected a whole number"),
        ("images.txt", "frame_00.png\n\n", "frame_00.png\n", "line 4: found '2 .*expected the line of 2-D points"),
        ("points3D.txt", "\n0 ", "\n0 x", "points3D.txt, line 2: .*expected id x y z r g b"),
    ],
)
def test_damaged_text_names_the_line(tmp_path, name, find, put, message):
    write_colmap_text(tmp_path, make_world())
    text = (tmp_path / name).read_text()
    assert find in text
    (tmp_path / name).write_text(text.replace(find, put, 1))
    with pytest.raises(SceneError, match=message):
        read_all(tmp_path)


def test_an_image_of_an_unknown_camera_is_refused(tmp_path):
    write_colmap_text(tmp_path, make_world())
    (tmp_path / "cameras.txt").write_text("4 PINHOLE 64 48 70 70 32 24\n")
    with pytest.raises(SceneError, match=r"image 'frame_00.png' has camera 1, but the cameras file has only \[4\]"):
        read_images(tmp_path)


@pytest.mark.parametrize("write", WRITERS)
def test_a_zero_or_infinite_pose_is_refused(tmp_path, write):
    world = make_world()
    world.quaternions[1] = 0
    write(tmp_path, world)
    with pytest.raises(SceneError, match="has no rotation; expected a finite quaternion"):
        read_images(tmp_path)
    world = make_world()
    world.translations[1, 2] = np.inf
    write(tmp_path, world)
    with pytest.raises(SceneError, match="expected a finite quaternion"):
        read_images(tmp_path)


@pytest.mark.parametrize("write", WRITERS)
def test_no_points_is_an_empty_cloud_here(tmp_path, write):
    world = make_world()
    world.xyz, world.rgb = np.empty((0, 3)), np.empty((0, 3), np.uint8)
    write(tmp_path, world)
    xyz, rgb = read_points3d(tmp_path)
    assert xyz.shape == rgb.shape == (0, 3)


def test_no_images_is_an_error(tmp_path):
    write_colmap_text(tmp_path, make_world())
    (tmp_path / "images.txt").write_text("# Image list\n")
    with pytest.raises(SceneError, match="lists 0 images"):
        read_images(tmp_path)


def test_binary_is_preferred_to_text(tmp_path):
    write_colmap_text(tmp_path, make_world(seed=1))
    world = make_world(seed=2)
    write_colmap_binary(tmp_path, world)
    assert same_camera(read_images(tmp_path)[0].camera, expected_cameras(world)[0])
