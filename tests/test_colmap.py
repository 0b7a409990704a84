"""COLMAP models: binary and text give the same cameras; damage gives one error."""

import struct

import numpy as np
import pytest
from capture_files import make_world, same_camera, write_colmap_binary, write_colmap_text

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.capture import read_poses
from og_pointcloud.formats.colmap import find_model, read_images, read_points3d
from og_pointcloud.formats.lenses import lens_of

WRITERS = [write_colmap_binary, write_colmap_text]


def expected_cameras(world):
    return list(map(world.camera, world.poses))


@pytest.mark.parametrize("write", WRITERS)
@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_binary_and_text_hold_the_same_world(tmp_path, write, offset):
    world = make_world(offset=(offset, -offset, 10.0))
    write(tmp_path / "sparse/0", world)
    model = find_model(tmp_path)
    assert model == tmp_path / "sparse/0"
    images = read_images(model)
    assert [image.path for image in images] == [f"{name}.png" for name in world.names]
    for image, camera in zip(images, expected_cameras(world), strict=True):
        assert image.lens is None
        assert same_camera(image.camera, camera, 1e-9)
    xyz, rgb = read_points3d(model)
    np.testing.assert_array_equal(xyz, world.xyz)
    np.testing.assert_array_equal(rgb, world.rgb)


def test_scaled_quaternions_are_normalized(tmp_path):
    world = make_world()
    write_colmap_binary(tmp_path, world, poses=np.hstack([world.quaternions * 3.0, world.translations]))
    assert all(map(same_camera, [image.camera for image in read_images(tmp_path)], expected_cameras(world)))


@pytest.mark.parametrize("write", WRITERS)
def test_camera_models(tmp_path, write):
    world = make_world(count=4)
    cameras = {
        1: ("SIMPLE_PINHOLE", (70.0, 31.0, 25.0)),
        2: ("OPENCV", (70.0, 72.0, 31.0, 25.0, 0.1, -0.05, 0.001, 0.002)),
        3: ("OPENCV_FISHEYE", (70.0, 72.0, 31.0, 25.0, 0.0, 0.0, 0.0, 0.0)),
        4: ("OPENCV", (70.0, 72.0, 31.0, 25.0, 0.0, 0.0, 0.0, 0.0)),
    }
    write(tmp_path, world, cameras)
    pinhole, opencv, fisheye, straight = read_images(tmp_path)
    assert (pinhole.camera.fx, pinhole.camera.fy, pinhole.camera.cx, pinhole.camera.cy) == (70.0, 70.0, 31.0, 25.0)
    assert pinhole.lens is None
    assert straight.lens is None
    assert opencv.camera.fy == 72.0
    assert opencv.lens == lens_of("perspective", {"k1": 0.1, "k2": -0.05, "p1": 0.001, "p2": 0.002})
    assert fisheye.lens is not None, "an equidistant fisheye is no pinhole, although its terms are zero"
    assert fisheye.lens.model == "fisheye"


@pytest.mark.parametrize("write", WRITERS)
def test_a_lens_that_is_not_known_is_refused(tmp_path, write):
    write(tmp_path, make_world(), {1: ("RAD_TAN_THIN_PRISM_FISHEYE", (70.0, 72.0, 31.0, 25.0, *[0.0] * 12))})
    expected = r"camera 1 has the model (RAD\w+|of id 11); expected one of .*image_undistorter"
    with pytest.raises(SceneError, match=expected):
        read_images(tmp_path)


def read_all(model):
    return read_images(model), read_points3d(model)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_every_truncation_of_a_binary_file_is_one_error(tmp_path, name):
    write_colmap_binary(tmp_path, make_world())
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
        ("cameras.txt", "PINHOLE", "BROWN", "camera 1 has the model BROWN; expected one of"),
        ("cameras.txt", "70.0", "seventy", "line 2: found 'seventy 72.0 31.0 25.5'; expected 4 numbers"),
        ("cameras.txt", " 25.5", "", "line 2: found .* expected 4 numbers"),
        (
            "cameras.txt",
            "PINHOLE",
            "SIMPLE_PINHOLE",
            "line 2: a SIMPLE_PINHOLE with more than 3 parameters; expected f, c",
        ),
        (
            "cameras.txt",
            "1 PINHOLE",
            "1 PINHOLE 9 9 1 1 1 1\n1 PINHOLE",
            "two cameras have the id 1; expected files from o",
        ),
        ("cameras.txt", "1 PINHOLE", "4 PINHOLE", r"image 'frame_00.png' has camera 1, but the cameras .* only \[4\]"),
        ("images.txt", "1 ", "one ", "line 3: found 'one 1'; expected 2 whole numbers"),
        ("images.txt", " frame_00.png", "", "line 3: found '1 .*expected ten fields, name last"),
        ("images.txt", "frame_00.png\n\n", "frame_00.png\n", "line 4: found '2 .*expected the line of 2-D points"),
        ("points3D.txt", "\n0 ", "\n0 x", r"points3D.txt: .*row 0, column 2.*expected lines of id x y z r g b"),
    ],
)
def test_damaged_text_names_the_line(tmp_path, name, find, put, message):
    write_colmap_text(tmp_path, make_world())
    text = (tmp_path / name).read_text()
    assert find in text
    (tmp_path / name).write_text(text.replace(find, put, 1))
    with pytest.raises(SceneError, match=message):
        read_all(tmp_path)


@pytest.mark.parametrize("name", ["a.png", "IMG (1).png", "a b c.png", "1 2 3 4.png", "a b 1"])
def test_text_without_lines_of_points_is_refused_whatever_the_names(tmp_path, name):
    write_colmap_text(tmp_path, make_world())
    lines = [f"{index} 1 0 0 0 {index} 0 0 1 {name}" for index in range(1, 5)]
    (tmp_path / "images.txt").write_text("\n".join(lines) + "\n")
    with pytest.raises(SceneError, match=r"line 2: found '2 .*expected the line of 2-D points"):
        read_images(tmp_path)
    (tmp_path / "images.txt").write_text("\n1.5 2 -1 3.25 4 7\n".join(lines) + "\n")
    assert [image.path for image in read_images(tmp_path)] == [name] * 4


@pytest.mark.parametrize("write", WRITERS)
def test_a_larger_model_beside_the_first_is_mentioned(tmp_path, write, recwarn):
    write(tmp_path / "sparse/0", make_world(count=4))
    write(tmp_path / "sparse/1", make_world(count=3))
    assert len(read_poses(tmp_path).names) == 4
    assert not recwarn
    write(tmp_path / "sparse/2", make_world(count=9))
    with pytest.warns(UserWarning, match="sparse/0 has 4 images, but .*sparse/2 has 9.* swap the two folders' names"):
        assert len(read_poses(tmp_path).names) == 4


def test_text_with_a_mark_before_it_and_other_line_ends_is_read(tmp_path):
    write_colmap_text(tmp_path, make_world())
    images, (xyz, rgb) = read_all(tmp_path)
    for file in tmp_path.iterdir():
        file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes().replace(b"\n", b"\r\n"))
    marked, (xyz_marked, rgb_marked) = read_all(tmp_path)
    assert [image.path for image in marked] == [image.path for image in images]
    assert np.array_equal(xyz, xyz_marked)
    assert np.array_equal(rgb, rgb_marked)


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
