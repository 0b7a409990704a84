"""RGB-D data sets in their own layouts, written on the spot: cameras, depth, and the fused cloud of each."""

import json
import warnings
from pathlib import Path

import numpy as np
import pytest
from capture_files import edit_poses, write_masks
from commands import error_of, output_of
from scenes import ROOM_SIZE, distance_to_surface, look, room_poses, write_depth, write_rgb

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.capture import depth_files, fuse_capture, read_capture, read_poses
from og_pointcloud.formats.depth import resampled
from og_pointcloud.formats.points import read_points
from og_pointcloud.formats.repairs import Repair
from og_pointcloud.formats.rgbd import COLOR_FOCAL_PX, DEPTH_FOCAL_PX

COUNT = 6
LENS = (130.0, 131.0, 79.0, 60.5)
"""fx fy cx cy with pixel centers at whole numbers, as these data sets state them; the scene adds 0.5 to cx, cy."""
OURS = (LENS[0], LENS[1], LENS[2] + 0.5, LENS[3] + 0.5)
SIZE = WIDTH, HEIGHT = ROOM_SIZE


def matrix(lens, size=4):
    made = np.eye(size)
    made[0, 0], made[1, 1], made[0, 2], made[1, 2] = lens
    return made


def write_scannet(folder: Path):
    """Color at twice the depth's size with a lens of its own, as in the data set."""
    color_lens, color_size = (260.0, 262.0, 158.0, 121.0), (2 * WIDTH, 2 * HEIGHT)
    for name in ("pose", "intrinsic"):
        (folder / name).mkdir(parents=True)
    for index, pose in enumerate(room_poses(COUNT)):
        centered = (color_lens[0], color_lens[1], color_lens[2] + 0.5, color_lens[3] + 0.5)
        write_rgb(folder / f"color/{index * 5}.jpg", look(pose, size=color_size, intrinsics=centered)[1])
        write_depth(folder / f"depth/{index * 5}.png", look(pose, intrinsics=OURS)[0])
        np.savetxt(folder / f"pose/{index * 5}.txt", pose)
    np.savetxt(folder / "intrinsic/intrinsic_color.txt", matrix(color_lens))
    np.savetxt(folder / "intrinsic/intrinsic_depth.txt", matrix(LENS))
    np.savetxt(folder / "intrinsic/extrinsic_depth.txt", np.eye(4))
    return [str(5 * index) for index in range(COUNT)], color_size


def write_seven_scenes(folder: Path, intrinsics: bool = True):
    for index, pose in enumerate(room_poses(COUNT)):
        depth, rgb = look(pose, intrinsics=OURS)
        depth[:3] = 65.535
        write_depth(folder / f"frame-{index:06d}.depth.png", depth)
        write_rgb(folder / f"frame-{index:06d}.color.png", rgb)
        np.savetxt(folder / f"frame-{index:06d}.pose.txt", pose, fmt="%.7e", delimiter="\t")
    if intrinsics:
        np.savetxt(folder / "camera-intrinsics.txt", matrix(LENS, 3))
    return [f"frame-{index:06d}.color" for index in range(COUNT)], SIZE


def write_replica(folder: Path):
    for index, pose in enumerate(room_poses(COUNT)):
        depth, rgb = look(pose, intrinsics=OURS)
        write_depth(folder / f"results/depth{index:06d}.png", depth, 1 / 6553.5)
        write_rgb(folder / f"results/frame{index:06d}.jpg", rgb)
    np.savetxt(folder / "traj.txt", [pose.ravel() for pose in room_poses(COUNT)])
    lens = dict(zip(("fx", "fy", "cx", "cy"), LENS, strict=True))
    parameters = {"camera": {"w": WIDTH, "h": HEIGHT, **lens, "scale": 6553.5}}
    (folder.parent / "cam_params.json").write_text(json.dumps(parameters))
    return [f"frame{index:06d}" for index in range(COUNT)], SIZE


@pytest.fixture(params=[write_scannet, write_seven_scenes, write_replica])
def dataset(request, tmp_path):
    folder = tmp_path / "set" / "scene"
    folder.mkdir(parents=True)
    return folder, *request.param(folder)


def test_every_layout_becomes_a_scene_with_a_fused_cloud(dataset):
    folder, names, size = dataset
    write_masks(folder, names, size)
    scene = read_capture(folder)
    assert [view.name for view in scene.views] == names
    fused = fuse_capture(folder)
    assert distance_to_surface(scene.points.xyz_world).max() < fused.survey.voxel / 2
    assert len(scene.points) == len(fused.points) > 3000
    for view, pose in zip(scene.views, room_poses(COUNT), strict=True):
        np.testing.assert_allclose(view.camera.center + scene.points.origin, pose[:3, 3], atol=1e-5)
        np.testing.assert_allclose(view.camera.world_to_camera[:3, :3].T, pose[:3, :3], atol=1e-5)
        assert (view.camera.width, view.camera.height) == size
        image = view.image_rgb()
        assert image.shape == (size[1], size[0], 3)


def test_depth_of_a_view_is_given_at_the_pixels_of_its_image(dataset):
    folder, names, size = dataset
    posed = read_poses(folder)
    files = depth_files(folder, posed)
    image = files[names[2]].read()
    depth = resampled(image.depth, image.camera, posed.images[2].camera)
    assert depth.shape == (size[1], size[0])
    intrinsics = OURS if size == SIZE else (260.0, 262.0, 158.5, 121.5)
    truth, _ = look(room_poses(COUNT)[2], size=size, intrinsics=intrinsics)
    measured = depth > 0
    assert measured.mean() > 0.9
    # Nearest pixels: exact to a pixel's slope, but at the edges of things.
    assert np.quantile(np.abs(depth - truth)[measured], 0.9) < 0.05
    assert list(files) == names


def test_frames_without_a_pose_are_left_out_and_counted_once(tmp_path):
    folder = tmp_path / "scene"
    names, size = write_scannet(folder)
    (folder / "pose/5.txt").write_text("\n".join(["-inf -inf -inf -inf"] * 4))
    (folder / "pose/15.txt").write_text("\n".join(["nan 0 0 0"] * 4))
    write_masks(folder, names, size)
    with pytest.warns(
        UserWarning, match=r"no finite pose for 2 of \d+ frames, which are left out, e.g. 'color/5.jpg'"
    ) as said:
        scene = read_capture(folder)
    assert len(said) == 1
    assert [view.name for view in scene.views] == ["0", "10", "20", "25"]


def test_frames_of_a_recording_without_masks_are_left_out_but_fused(tmp_path):
    folder = tmp_path / "scene"
    folder.mkdir()
    names, size = write_seven_scenes(folder)
    write_masks(folder, names[::2], size)
    with pytest.warns(UserWarning, match="3 of 6 images have no masks and are left out"):
        scene = read_capture(folder)
    assert [view.name for view in scene.views] == names[::2]
    assert fuse_capture(folder).frames == COUNT


def test_uncalibrated_seven_scenes_have_two_lenses_and_sequences_of_their_own(tmp_path):
    for sequence in ("seq-01", "seq-02"):
        (tmp_path / sequence).mkdir()
        write_seven_scenes(tmp_path / sequence, intrinsics=False)
    files = depth_files(tmp_path, read_poses(tmp_path))
    assert list(files)[COUNT] == "seq-02/frame-000000.color"
    assert files["seq-01/frame-000003.color"].camera.fx == DEPTH_FOCAL_PX * WIDTH / 640
    names = list(files)
    write_masks(tmp_path, names, SIZE)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # color and depth are of one lens here, and said to be of two
        scene = read_capture(tmp_path)
    assert scene.views[0].camera.fx == COLOR_FOCAL_PX * WIDTH / 640
    # 65535 is "not measured", not 65 m.
    assert files[names[0]].read().depth.max() < 6


@pytest.mark.parametrize("wrong", [("color",), ("color", "depth")])
def test_intrinsics_of_a_depth_sensor_of_its_own_are_not_repaired_with_the_photographs(tmp_path, wrong):
    write_scannet(tmp_path)
    right = read_poses(tmp_path).images[0]
    for sensor in wrong:
        file = tmp_path / f"intrinsic/intrinsic_{sensor}.txt"
        stated = np.loadtxt(file)
        stated[:2, :3] = 2 * stated[:2, :3] + [[0, 0, 0.5], [0, 0, 0.5]]  # centers of pixels at whole numbers
        np.savetxt(file, stated)
    repaired = read_poses(tmp_path, [Repair.parse("intrinsics=0.5")]).images[0]
    np.testing.assert_allclose(repaired.camera.intrinsics, right.camera.intrinsics)
    np.testing.assert_allclose(repaired.depth.camera.intrinsics, right.depth.camera.intrinsics)


def test_scannets_mesh_is_the_cloud_where_it_is_there(tmp_path):
    folder = tmp_path / "scene"
    names, size = write_scannet(folder)
    write_masks(folder, names, size)
    text = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    text += "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    (folder / "scene_vh_clean_2.ply").write_text(text)
    assert len(read_capture(folder).points) == 3


def nerfstudio(folder: Path, **keys):
    """transforms.json with depth_file_path."""
    frames = []
    for index, pose in enumerate(room_poses(COUNT)):
        depth, rgb = look(pose, intrinsics=LENS)
        write_rgb(folder / f"images/{index}.png", rgb)
        write_depth(folder / f"depths/d{index}.png", depth, keys.get("integer_depth_scale", 1e-3))
        frame = {"file_path": f"images/{index}.png", "depth_file_path": f"depths/d{index}.png"}
        frames.append({**frame, "transform_matrix": (pose @ np.diag([1, -1, -1, 1])).tolist()})
    lens = dict(zip(("fl_x", "fl_y", "cx", "cy"), LENS, strict=True))
    content = {**lens, "w": WIDTH, "h": HEIGHT, "frames": frames, **keys}
    (folder / "transforms.json").write_text(json.dumps(content))
    return [str(index) for index in range(COUNT)]


@pytest.mark.parametrize("keys", [{}, {"integer_depth_scale": 2e-4}])
def test_nerfstudios_depth_files_are_fused(tmp_path, keys):
    write_masks(tmp_path, nerfstudio(tmp_path, **keys), SIZE)
    scene = read_capture(tmp_path)
    assert distance_to_surface(scene.points.xyz_world).max() < fuse_capture(tmp_path).survey.voxel / 2


@pytest.mark.parametrize(("most", "fused"), [(COUNT + 1, COUNT), (COUNT, COUNT), (COUNT - 1, -(-COUNT // 2))])
def test_as_many_depth_images_are_fused_as_may_be(tmp_path, monkeypatch, most, fused):
    nerfstudio(tmp_path)
    monkeypatch.setattr("og_pointcloud.formats.capture.MAX_FUSED_FRAMES", most)
    assert fuse_capture(tmp_path).frames == fused


@pytest.mark.parametrize("path", ["../d0.png", "/d0.png", "C:\\scan\\d0.png"])
def test_a_depth_file_outside_the_capture_is_not_opened(tmp_path, path):
    nerfstudio(tmp_path)
    edit_poses(tmp_path, lambda content: content["frames"][0].update(depth_file_path=path))
    with pytest.raises(SceneError, match="leads out of the capture folder"):
        read_poses(tmp_path)


def test_a_depth_folder_beside_the_images_is_found(tmp_path):
    names = nerfstudio(tmp_path)
    edit_poses(tmp_path, lambda content: [frame.pop("depth_file_path") for frame in content["frames"]])
    for index in range(COUNT):
        np.save(tmp_path / f"{index}.npy", look(room_poses(COUNT)[index], intrinsics=LENS)[0])
    write_masks(tmp_path, names, SIZE)
    with pytest.raises(SceneError, match=r"no geometry; .*depth images in depth/"):
        read_capture(tmp_path)
    (tmp_path / "depth").mkdir()
    for index in range(COUNT):
        (tmp_path / f"{index}.npy").rename(tmp_path / f"depth/{index}.npy")
    assert distance_to_surface(read_capture(tmp_path).points.xyz_world).max() < 0.03


def as_named(content):
    """As instant-ngp names depth images."""
    for frame in content["frames"]:
        frame["depth_path"] = frame.pop("depth_file_path")


def unnamed(content):
    for frame in content["frames"]:
        frame.pop("depth_file_path")


def absent(content):
    for frame in content["frames"]:
        frame["depth_path"] = frame.pop("depth_file_path").replace("depths/d", "gone/")


@pytest.mark.parametrize("key", ["integer_depth_scale", "depth_unit_scale_factor"])
@pytest.mark.parametrize("change", [as_named, unnamed, absent])
def test_the_stated_unit_holds_however_depth_images_are_found(tmp_path, change, key):
    nerfstudio(tmp_path, **{key: 2e-4, "integer_depth_scale": 2e-4})
    edit_poses(tmp_path, lambda content: key == "integer_depth_scale" or content.pop("integer_depth_scale"))
    if change is not as_named:
        (tmp_path / "depths").rename(tmp_path / "depth")
        for file in list((tmp_path / "depth").iterdir()):
            file.rename(file.with_name(file.name[1:]))
    edit_poses(tmp_path, change)
    files = depth_files(tmp_path, read_poses(tmp_path))
    assert list(files) == [str(index) for index in range(COUNT)]
    np.testing.assert_allclose(files["2"].read().depth, look(room_poses(COUNT)[2], intrinsics=LENS)[0], atol=2e-4)
    stated, given = fuse_capture(tmp_path), fuse_capture(tmp_path, depth_unit=2.02e-4)
    assert given.survey.depth == pytest.approx(1.01 * stated.survey.depth, rel=1e-4)


def test_the_unit_of_a_distorted_photographs_depth_is_the_stated_one(tmp_path):
    nerfstudio(tmp_path, integer_depth_scale=2e-4, k1=1e-3)
    edit_poses(tmp_path, unnamed)
    (tmp_path / "depths").rename(tmp_path / "depth")
    (tmp_path / "depth/d0.png").rename(tmp_path / "depth/0.png")
    depth = depth_files(tmp_path, read_poses(tmp_path))["0"].read().depth
    assert np.median(depth) == pytest.approx(np.median(look(room_poses(COUNT)[0], intrinsics=LENS)[0]), rel=0.02)


def thin(folder, kept):
    for file in list((folder / "results").iterdir()):
        if int(file.stem[-6:]) not in kept:
            file.unlink()


def test_images_of_a_thinned_replica_have_the_poses_of_their_numbers(tmp_path):
    folder = tmp_path / "scene"
    folder.mkdir()
    write_replica(folder)
    lines = (folder / "traj.txt").read_text().splitlines(keepends=True)
    thin(folder, (0, 2, 5))
    thinned = read_poses(folder)
    (folder / "traj.txt").write_text("".join(lines[index] for index in (0, 2, 5)))  # thinned with the images
    for poses in (thinned, read_poses(folder)):
        assert poses.names == ("frame000000", "frame000002", "frame000005")
        for image, index in zip(poses.images, (0, 2, 5), strict=True):
            np.testing.assert_allclose(image.camera.center, room_poses(COUNT)[index][:3, 3], atol=1e-5)
    (folder / "traj.txt").write_text("".join(lines[:5]))
    with pytest.raises(SceneError, match=r"3 images in results/ and 5 poses .*line i \(from 0\) for frame i"):
        read_poses(folder)


def test_poses_in_millimeters_with_depth_in_meters_are_doubted(tmp_path):
    def in_millimeters(content):
        for frame in content["frames"]:
            for row in frame["transform_matrix"][:3]:
                row[3] *= 1000

    nerfstudio(tmp_path)
    edit_poses(tmp_path, in_millimeters)
    with pytest.warns(UserWarning, match="if all depths are multiplied by 1000: state the depth unit"):
        fuse_capture(tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fused = fuse_capture(tmp_path, depth_unit=1.0)
    assert distance_to_surface(fused.points.xyz_world / 1000).max() < fused.survey.voxel / 2000


@pytest.mark.parametrize(
    ("write", "file", "content", "said"),
    [
        (write_scannet, "pose/0.txt", "1 2 3", r"shape \(1, 3\); expected rows of 4"),
        (write_scannet, "pose/0.txt", "1 0 0 0\n0 2 0 0\n0 0 1 0\n0 0 0 1", "differs from a rotation"),
        (write_scannet, "pose/0.txt", "1 0 0 0\n0 1 0 0\n0 0 1 0\n2 3 4 1", r"last row is .*2.0, 3.0, 4.0, 1.0"),
        (write_replica, "traj.txt", "1 0 0 0 0 1 0 0 0 0 1 0 2 3 4 1\n" * 6, "traj.txt, line 1: the pose's last row"),
        (write_scannet, "pose/0.txt", "1 0 0 0\n", r"shape \(1, 4\); expected a 4x4 matrix"),
        (write_scannet, "intrinsic/intrinsic_color.txt", "a b", "cannot be read as rows of numbers"),
        (write_scannet, "intrinsic/intrinsic_depth.txt", "1 0 0 0", "expected a 4x4 matrix"),
        (write_seven_scenes, "camera-intrinsics.txt", "1 0 0", "expected a 3x3 matrix"),
        (write_replica, "traj.txt", "1 " * 16, "6 images in results/ and 1 poses"),
        (write_replica, "../cam_params.json", '{"camera": {"w": 1}}', "lacks finite numbers w, h, fx"),
        (write_replica, "../cam_params.json", "[" * 100000, "is not valid JSON"),
    ],
)
def test_damaged_data_sets_name_the_file_and_the_cure(tmp_path, write, file, content, said):
    folder = tmp_path / "scene"
    folder.mkdir()
    write(folder)
    (folder / file).write_text(content)
    with pytest.raises(SceneError, match=said):
        read_poses(folder)


def test_the_command_writes_the_cloud_that_fit_then_takes(tmp_path, capsys):
    names = nerfstudio(tmp_path)
    assert f"next: og-pointcloud masks {tmp_path}\n" in output_of(capsys, "fuse", tmp_path)
    (tmp_path / "points.ply").unlink()
    write_masks(tmp_path, names, SIZE)
    said = output_of(capsys, "fuse", tmp_path)
    assert "6 depth images" in said
    assert f"next: og-pointcloud fit {tmp_path} -o scene.ogpc\n" in said
    cloud = read_points(tmp_path / "points.ply")
    assert distance_to_surface(cloud.xyz_world).max() < 0.03
    assert cloud.rgb is not None
    assert len(read_capture(tmp_path).points) == len(cloud)
    assert "already exists and is kept" in error_of(capsys, "fuse", tmp_path)
    assert "unit" in error_of(capsys, "fuse", tmp_path, "--depth-unit", "0", "-o", tmp_path / "b.ply")
