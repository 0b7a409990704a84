"""Phones' exports, as the apps write them: ARKit's axes, small depth images, frames without an image or a pose."""

import json

import numpy as np
import pytest
from capture_files import make_world, write_colmap_text, write_images, write_masks
from scenes import ROOM_SIZE, camera, look, room_poses, write_depth, write_image, write_ply

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.capture import depth_files, fuse_capture, read_capture, read_poses
from og_pointcloud.masking.photographs import read_photographs

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
WIDTH, HEIGHT = ROOM_SIZE
SCALE = 4
"""Images are so many times as large as depth images."""


def photographs():
    """(name, camera to world with OpenCV axes, depth) of a room."""
    return [(index, pose, look(pose)[0]) for index, pose in enumerate(room_poses()[:4])]


def lens_of_images():
    at = camera(np.eye(4))
    return at.fx * SCALE, at.fy * SCALE, at.cx * SCALE, at.cy * SCALE


def picture(path):
    write_image(path, np.full((HEIGHT * SCALE, WIDTH * SCALE, 3), 120, np.uint8))


def write_polycam(folder, images="corrected_images", cameras="corrected_cameras"):
    fx, fy, cx, cy = lens_of_images()
    for index, pose, depth in photographs():
        name = f"17000{index}"
        picture(folder / "keyframes" / images / f"{name}.jpg")
        keys = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": WIDTH * SCALE, "height": HEIGHT * SCALE}
        matrix = pose @ OPENGL
        keys |= {f"t_{row}{column}": matrix[row, column] for row in range(3) for column in range(4)}
        file = folder / "keyframes" / cameras / f"{name}.json"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps({**keys, "blur_score": 100, "neighbors": [1, 2]}))
        write_depth(folder / "keyframes/depth" / f"{name}.png", depth)
    return "keyframes/corrected_cameras/170001.json"


def write_scanner_app(folder):
    fx, fy, cx, cy = lens_of_images()
    for index, pose, depth in photographs():
        picture(folder / f"frame_{index:05d}.jpg")
        content = {"cameraPoseARFrame": (pose @ OPENGL).ravel().tolist(), "time": 1.5, "frame_index": index}
        content["intrinsics"] = [fx, 0, cx - 0.5, 0, fy, cy - 0.5, 0, 0, 1]
        (folder / f"frame_{index:05d}.json").write_text(json.dumps(content))
        write_depth(folder / f"depth_{index:05d}.png", depth)
    (folder / "frame_00007.json").write_text("{}")  # frames whose image was not kept
    return "frame_00001.json"


def write_arkit_scenes(folder):
    from scipy.spatial.transform import Rotation

    at, lines = camera(np.eye(4)), []
    for index, pose, depth in photographs():
        name = f"4200_{10 + index / 10:.3f}"
        image = np.full((HEIGHT, WIDTH, 3), 120, np.uint8)
        write_image(folder / "lowres_wide" / f"{name}.png", image)
        write_depth(folder / "lowres_depth" / f"{name}.png", depth)
        inverse = np.linalg.inv(pose)
        vector = Rotation.from_matrix(inverse[:3, :3]).as_rotvec()
        lines.append(" ".join(map(repr, [10 + index / 10 + 0.004, *vector.tolist(), *inverse[:3, 3].tolist()])))
        pincam = folder / "lowres_wide_intrinsics" / f"{name}.pincam"
        pincam.parent.mkdir(exist_ok=True)
        pincam.write_text(f"{WIDTH} {HEIGHT} {at.fx} {at.fy} {at.cx - 0.5} {at.cy - 0.5}\n")
    (folder / "lowres_wide.traj").write_text("\n".join(lines[::-1]) + "\n")
    write_image(folder / "lowres_wide" / "4200_99.000.png", image)  # after tracking ended
    return "lowres_wide_intrinsics/4200_10.100.pincam"


WRITERS = {"Polycam": write_polycam, "3D Scanner App": write_scanner_app, "ARKitScenes": write_arkit_scenes}


@pytest.fixture(params=WRITERS)
def app(request, tmp_path):
    return request.param, tmp_path, WRITERS[request.param](tmp_path)


@pytest.mark.filterwarnings("ignore:.*no finite pose")
def test_cameras_and_depths_fit_the_room(app):
    name, folder, _ = app
    poses = read_poses(folder)
    scale = 1 if name == "ARKitScenes" else SCALE
    assert len(poses.images) == 4
    assert poses.is_recording
    for image, (_, pose, _) in zip(poses.images, photographs(), strict=True):
        np.testing.assert_allclose(image.camera.world_to_camera, np.linalg.inv(pose), atol=1e-9)
        ours, theirs = image.camera, camera(pose)
        np.testing.assert_allclose([ours.fx, ours.cx, ours.cy], scale * np.array([theirs.fx, theirs.cx, theirs.cy]))
        assert (ours.width, ours.height) == (WIDTH * scale, HEIGHT * scale)
    files = depth_files(folder, poses)
    depth = files[poses.names[2]].read()
    np.testing.assert_allclose(depth.depth, photographs()[2][2], atol=6e-4)
    assert depth.camera.fx == pytest.approx(camera(np.eye(4)).fx)
    cloud = fuse_capture(folder).points
    assert len(cloud) > 1000
    assert cloud.rgb is not None


@pytest.mark.filterwarnings("ignore:.*no finite pose")
@pytest.mark.parametrize("turns", [0, 1, 2, 3])
@pytest.mark.parametrize("name", WRITERS)
def test_masks_are_made_of_upright_images_however_the_phone_was_held(tmp_path, monkeypatch, name, turns):
    rolled, held = np.eye(4), photographs()
    sine, cosine = np.rint([np.sin(turns * np.pi / 2), np.cos(turns * np.pi / 2)])
    # The camera, clockwise as seen from behind: what it shows, the other way.
    rolled[:2, :2] = [[cosine, -sine], [sine, cosine]]
    to_app = np.eye(4)
    if name != "ARKitScenes":  # the room is z up, the app's world y up
        to_app[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    monkeypatch.setattr(f"{__name__}.photographs", lambda: [(k, to_app @ at @ rolled, depth) for k, at, depth in held])
    WRITERS[name](tmp_path)
    assert [photograph.quarter_turns for photograph in read_photographs(tmp_path)] == [-turns % 4] * 4


def test_frames_without_a_partner_are_left_out(app):
    name, folder, partner = app
    if name == "ARKitScenes":
        with pytest.warns(UserWarning, match="no finite pose for 1 of"):
            assert len(read_poses(folder).images) == 4
    (folder / partner).unlink()
    with pytest.warns(UserWarning, match=r"no finite pose for [12] of \d+ frames, which are left out"):
        assert len(read_poses(folder).images) == 3


def test_matrices_of_3d_scanner_app_may_be_listed_column_by_column(tmp_path):
    write_scanner_app(tmp_path)
    before = [image.camera for image in read_poses(tmp_path).images]
    for file in tmp_path.glob("frame_0000[0-3].json"):
        content = json.loads(file.read_text())
        for key, side in (("cameraPoseARFrame", 4), ("intrinsics", 3)):
            content[key] = np.reshape(content[key], (side, side)).T.ravel().tolist()
        file.write_text(json.dumps(content))
    for one, other in zip(read_poses(tmp_path).images, before, strict=True):
        np.testing.assert_allclose(one.camera.world_to_camera, other.world_to_camera, atol=1e-12)
        assert one.camera.intrinsics == other.intrinsics


@pytest.mark.filterwarnings("ignore:.*no finite pose")
@pytest.mark.parametrize(("stamp", "images"), [("10.099", 4), ("10.101", 4), ("10.102", 3)])
def test_intrinsics_of_arkit_scenes_may_be_named_a_millisecond_off(tmp_path, stamp, images):
    file = tmp_path / write_arkit_scenes(tmp_path)
    file.rename(file.with_name(f"4200_{stamp}.pincam"))
    assert len(read_poses(tmp_path).images) == images


@pytest.mark.filterwarnings("ignore:.*no finite pose")
def test_a_time_of_arkit_scenes_that_is_no_number_is_no_frames_time(tmp_path):
    """NaN was the nearest of all times: every image got its pose."""
    write_arkit_scenes(tmp_path)
    before = [image.camera for image in read_poses(tmp_path).images]
    with (tmp_path / "lowres_wide.traj").open("a") as stream:
        stream.write("nan 0 0 0 7 8 9\n")
    after = [image.camera for image in read_poses(tmp_path).images]
    np.testing.assert_array_equal([a.world_to_camera for a in after], [b.world_to_camera for b in before])


@pytest.mark.filterwarnings("ignore:.*no finite pose")
@pytest.mark.parametrize(
    "content", [b"", b"{", b"[]", b"1 2 3", b'{"fx": "x", "intrinsics": [1], "t_00": null}', b"\xff\xfe"]
)
def test_damaged_files_name_the_cure(app, content):
    _, folder, partner = app
    (folder / partner).write_bytes(content)
    with pytest.raises(SceneError) as caught:
        read_poses(folder)
    assert partner.split("/")[-1] in str(caught.value)


def test_polycams_first_poses_serve_where_it_did_not_correct_them(tmp_path):
    write_polycam(tmp_path, "images", "cameras")
    assert read_poses(tmp_path).images[0].path == "keyframes/images/170000.jpg"


def test_scannet_plus_plus(tmp_path):
    """Its DSLR half is a COLMAP model in the mesh's world, with a fisheye lens."""
    world = make_world()
    write_colmap_text(tmp_path / "dslr/colmap", world, {1: ("OPENCV_FISHEYE", (60.0, 60.0, 32.0, 24.0, 0.1, 0, 0, 0))})
    write_images(tmp_path, world.names)
    (tmp_path / "dslr/resized_images").parent.mkdir(exist_ok=True)
    (tmp_path / "images").rename(tmp_path / "dslr/resized_images")
    write_masks(tmp_path, world.names)
    (tmp_path / "scans").mkdir()
    write_ply(tmp_path / "scans/mesh_aligned_0.05.ply", world.xyz, world.rgb)
    scene = read_capture(tmp_path)
    assert [view.name for view in scene.views] == world.names
    assert scene.views[0].image_rgb() is not None
    assert len(scene.points) == len(world.xyz)
