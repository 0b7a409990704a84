"""KITTI-360 folders as its documentation lays them out: a stereo pair, keyframes, a static cloud."""

import numpy as np
import pytest
from capture_files import write_masks
from scenes import write_image

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.capture import read_capture, read_geometry, read_poses
from og_pointcloud.formats.ply import join_columns, write_ply

WIDTH, HEIGHT, FOCAL, CX, CY, BASELINE = 140, 37, 55.25, 68.2, 23.9, 0.6
DRIVE = "2013_05_28_drive_0000_sync"
OFFSET = np.array([1000.0, 3800.0, 116.0])
"""The world of the data set is large."""


def pose_of(frame):
    """(4, 4) left camera to world: driving along x, OpenCV axes (z forward, y down)."""
    pose = np.eye(4)
    pose[:3, :3] = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    pose[:3, 3] = OFFSET + np.array([0.8 * frame, 0, 1.55])
    return pose


def write_kitti360(folder, frames=(250, 252, 253), right=True, drive=DRIVE):
    calibration = ["calib_time: 09-Jan-2012 13:57:47", "corner_dist: 9.950000e-02"]
    for camera, shift in (("00", 0.0), ("01", -BASELINE * FOCAL)):
        projection = [FOCAL, 0, CX, shift, 0, FOCAL, CY, 0, 0, 0, 1, 0]
        calibration += [f"S_rect_{camera}: {WIDTH:e} {HEIGHT:e}", f"R_rect_{camera}: 1 0 0 0 1 0 0 0 1"]
        calibration.append(f"P_rect_{camera}: " + " ".join(f"{value:e}" for value in projection))
    (folder / "calibration").mkdir(exist_ok=True, parents=True)
    (folder / "calibration/perspective.txt").write_text("\n".join(calibration) + "\n")
    poses = folder / "data_poses" / drive / "cam0_to_world.txt"
    poses.parent.mkdir(parents=True)
    lines = [f"{frame} " + " ".join(map(repr, pose_of(frame).ravel().tolist())) for frame in frames]
    poses.write_text("\n".join(lines) + "\n")
    for camera in ("00", "01") if right else ("00",):
        for frame in range(250, 254):  # 251 is no keyframe
            image = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
            write_image(folder / f"data_2d_raw/{drive}/image_{camera}/data_rect/{frame:010d}.png", image)
    xyz = OFFSET + np.random.default_rng(0).uniform((210, -9, -2), (240, 9, 9), (300, 3))
    columns = dict(zip("xyz", xyz.astype(np.float32).T, strict=True))
    columns |= {name: np.full(300, 7, np.uint8) for name in ("red", "green", "blue", "isVisible")}
    columns |= {name: np.zeros(300, np.int32) for name in ("semanticID", "instanceID")}
    static = folder / f"data_3d_semantics/train/{drive}/static"
    static.mkdir(parents=True)
    write_ply(static / "000250_000253.ply", {"vertex": join_columns(columns)})
    return xyz


@pytest.mark.filterwarnings("ignore:.*no finite pose")
def test_a_stereo_pair_stands_beside_each_other(tmp_path):
    write_kitti360(tmp_path)
    poses = read_poses(tmp_path)
    assert len(poses.images) == 6
    assert poses.names[0] == "image_00/data_rect/0000000250"
    left, right = poses.images[1].camera, poses.images[4].camera
    np.testing.assert_allclose(left.world_to_camera, np.linalg.inv(pose_of(252)), atol=1e-9)
    assert (left.width, left.height, left.fx, left.cx) == (WIDTH, HEIGHT, FOCAL, CX + 0.5)
    # To the right of a car that drives along x with z up is -y. A disparity is focal length x baseline / depth.
    np.testing.assert_allclose(right.center - left.center, [0, -BASELINE, 0], atol=1e-6)
    ahead = (pose_of(252) @ [0.3, 0.1, 20.0, 1.0])[:3]
    (u_left, v_left), (u_right, v_right) = (camera.project(ahead[None])[0][0] for camera in (left, right))
    assert (u_left - u_right, v_left) == pytest.approx((FOCAL * BASELINE / 20, v_right))


@pytest.mark.filterwarnings("ignore:.*have no masks")
def test_keyframes_masks_and_the_static_cloud_are_a_capture(tmp_path):
    xyz = write_kitti360(tmp_path, right=False)
    write_masks(tmp_path, ["0000000250", "0000000253"], size=(WIDTH, HEIGHT))
    with pytest.warns(UserWarning, match=r"no finite pose for 1 of .*0000000251"):
        scene = read_capture(tmp_path)
    assert [view.name for view in scene.views] == ["0000000250", "0000000253"]
    np.testing.assert_allclose(scene.points.xyz_world, xyz, atol=1e-3)
    uv, depth = scene.views[0].camera.project(scene.points.xyz)
    assert scene.views[0].camera.shows(uv[depth > 0]).any()


@pytest.mark.parametrize(
    ("file", "content", "said"),
    [
        ("calibration/perspective.txt", "", "perspective.txt, S_rect_00, lacks finite numbers"),
        ("calibration/perspective.txt", "S_rect_00: 9 9\nP_rect_00: 1 2", "P_rect_00, lacks finite numbers"),
        ("calibration/perspective.txt", "S_rect_00: 9 9\nP_rect_00:" + " 0" * 12, "fx and fy at least"),
        (f"data_poses/{DRIVE}/cam0_to_world.txt", "1 2 3\n", "expected rows of 17"),
        (f"data_poses/{DRIVE}/cam0_to_world.txt", "", "expected rows of 17"),
    ],
)
def test_damaged_files_name_the_cure(tmp_path, file, content, said):
    write_kitti360(tmp_path, right=False)
    (tmp_path / file).write_text(content)
    with pytest.raises(SceneError, match=said):
        read_poses(tmp_path)


@pytest.mark.filterwarnings("error::RuntimeWarning", "ignore:.*no finite pose")
@pytest.mark.parametrize(("number", "says"), [("inf", "none of its"), ("1e-320", "differs from a rotation")])
def test_absurd_poses_make_no_warnings_of_numpy(tmp_path, number, says):
    write_kitti360(tmp_path, right=False)
    file = tmp_path / f"data_poses/{DRIVE}/cam0_to_world.txt"
    pose = f"0 0 1 100 {number} 0 0 200 0 -1 0 1.5 0 0 0 1"
    file.write_text("\n".join(f"{line.split()[0]} {pose}" for line in file.read_text().splitlines()))
    with pytest.raises(SceneError, match=says):
        read_poses(tmp_path)


@pytest.mark.filterwarnings("ignore:.*no finite pose")
def test_several_drives_and_several_clouds_are_refused(tmp_path):
    write_kitti360(tmp_path)
    static = tmp_path / f"data_3d_semantics/train/{DRIVE}/static"
    (static / "000254_000400.ply").write_bytes((static / "000250_000253.ply").read_bytes())
    with pytest.raises(SceneError, match=r"2 static clouds, .*name the one to use"):
        read_geometry(tmp_path, read_poses(tmp_path))
    write_kitti360(tmp_path, drive="2013_05_28_drive_0002_sync")
    with pytest.raises(SceneError, match=r"images of 2 drives with poses .*expected one"):
        read_poses(tmp_path)
