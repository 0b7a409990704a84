"""Captures of fisheyes and panoramas: images become pinhole views, and their masks go with them."""

import json
import shutil

import cv2
import numpy as np
import pytest
from capture_files import edit_poses, make_world, write_colmap_text, write_features
from scenes import write_image

import og_pointcloud as og
from og_pointcloud.errors import SceneError
from og_pointcloud.fitting.mask_table import mask_table
from og_pointcloud.formats import capture
from og_pointcloud.formats.capture import read_capture, read_poses
from og_pointcloud.formats.ply import plain_rows, write_ply
from og_pointcloud.masking.make_masks import MaskSettings, make_masks
from og_pointcloud.rendering.geometry import isotropic
from og_pointcloud.scene import NOT_SEEN

FACES = ["front", "left", "right", "up", "down", "back"]
SIZE = (256, 128)
DIRECTIONS = np.array([[0.3, 0.1, 1], [1, 0.2, 0.9], [0.2, -0.1, -1], [-1, 0.1, 0.1], [0.1, 1, 0.2], [0.2, -1, 0.1]])


def balls(count=400):
    """(6, count, 3) points of balls of radius 0.25 at distance 3 in six directions."""
    directions = DIRECTIONS / np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
    around = np.random.default_rng(0).normal(size=(6, count, 3))
    return 3 * directions[:, None] + 0.25 * around / np.linalg.norm(around, axis=2, keepdims=True)


def positions():
    return [np.array([0.2 * i, 0.1 * i, -0.15 * i]) for i in range(3)]


def write_panoramas(folder, lens="EQUIRECTANGULAR", size=SIZE, circle=False):
    """Three panoramas (or equidistant fisheyes) of the balls; ids 1..6 in each, rows of features to match."""
    width, height = size
    focal = width / np.pi  # of the fisheye: half a turn across
    column, row = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    if lens == "EQUIRECTANGULAR":
        longitude, latitude = (column / width - 0.5) * 2 * np.pi, (row / height - 0.5) * np.pi
        rays = np.stack(
            [np.cos(latitude) * np.sin(longitude), np.sin(latitude), np.cos(latitude) * np.cos(longitude)], axis=-1
        )
    else:
        x, y = (column - width / 2) / focal, (row - height / 2) / focal
        theta = np.hypot(x, y)
        rays = np.stack([np.sinc(theta / np.pi) * x, np.sinc(theta / np.pi) * y, np.cos(theta)], axis=-1)
    frames, features = [], {}
    centers = balls().mean(axis=1)
    for index, position in enumerate(positions()):
        ids = np.zeros((height, width), np.uint16)
        for ball, center in enumerate(centers):
            to_ball = center - position
            distance = np.linalg.norm(to_ball)
            ids[rays @ (to_ball / distance) > np.cos(np.arcsin(0.25 / distance))] = ball + 1
        if circle:
            ids[theta > np.pi / 2] = 0
        name = f"pano_{index}"
        write_image(folder / "masks" / f"{name}.png", ids)
        colors = np.stack([ids * 30, 255 - ids * 20, np.full_like(ids, 90)], axis=-1).astype(np.uint8)
        write_image(folder / "images" / f"{name}.png", colors)
        features[name] = np.eye(6, 8, dtype=np.float32)
        pose = np.diag([1.0, -1.0, -1.0, 1.0])
        pose[:3, 3] = position
        frames.append({"file_path": f"images/{name}.png", "transform_matrix": pose.tolist()})
    keys = {"camera_model": lens, "w": width, "h": height, "fl_x": focal, "fl_y": focal}
    content = {**keys, "cx": width / 2, "cy": height / 2, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))
    write_features(folder, {"feature_space": np.array("tiny"), **features})
    # In the colors of the images, which are written as blue, green, red.
    ball = np.repeat(np.arange(1, 7), 400)
    rgb = np.stack([np.full_like(ball, 90), 255 - ball * 20, ball * 30], axis=1).astype(np.uint8)
    write_ply(folder / "points.ply", {"vertex": plain_rows(balls().reshape(-1, 3), rgb)})
    return folder


@pytest.fixture
def panoramas(tmp_path):
    return write_panoramas(tmp_path)


def test_a_panorama_becomes_six_views_with_its_masks(panoramas):
    scene = read_capture(panoramas)
    assert [view.name for view in scene.views] == [f"pano_{i}/{face}" for i in range(3) for face in FACES]
    xyz, truth = scene.points.xyz, np.repeat(np.arange(6), 400)
    for view in scene.views:
        uv, _ = view.camera.project(xyz)
        inside = view.camera.shows(uv)
        column, row = np.floor(uv[inside]).astype(int).T
        ids = view.mask_map()
        assert (ids != NOT_SEEN).all()
        held = ids[row, column]
        owner = view.mask_features.argmax(axis=1)
        on = held >= 0
        assert (owner[held[on]] != truth[inside][on]).sum() <= 0.01 * on.sum()
        assert on.sum() > 0.6 * inside.sum() or inside.sum() < 50  # balls are seven pixels wide, and rims lie beside
        assert set(np.unique(ids)) == set(range(-1, view.mask_count)), "a face has the masks that it shows, no other"


def test_a_mask_across_a_border_of_faces_is_one_mask_of_each(panoramas):
    views = {view.name: view for view in read_capture(panoramas).views}
    front, right = views["pano_0/front"], views["pano_0/right"]
    both = {int(row) for row in front.mask_features.argmax(1)} & {int(row) for row in right.mask_features.argmax(1)}
    assert both == {1}, "the ball at 48 degrees lies in both"


def test_the_masks_of_an_image_are_read_once_for_all_its_faces(panoramas, monkeypatch):
    monkeypatch.setattr(capture, "DECODED_MAPS", 1)
    scene = read_capture(panoramas)
    maps = [view.mask_map() for view in scene.views]
    shutil.rmtree(panoramas / "masks")
    for view, ids in zip(scene.views, maps, strict=True):
        again = view.mask_map()
        assert again.dtype == np.int32
        np.testing.assert_array_equal(again, ids)


def test_photographs_are_split_like_their_masks(panoramas):
    for view in read_capture(panoramas).views[:6]:
        image, ids = view.image_rgb(), view.mask_map()
        inside = np.abs(cv2.blur(ids.astype(np.float32), (5, 5)) - ids) < 1e-6
        owner = np.append(view.mask_features.argmax(1), -1)
        numbers = owner[ids] + 1
        assert (np.abs(image[..., 2].astype(int) - numbers * 30)[inside] <= 1).all()


@pytest.mark.parametrize("lens", ["EQUIRECTANGULAR", "OPENCV_FISHEYE", "FISHEYE"])
def test_balls_all_around_are_labelled(tmp_path, lens):
    size = (512, 256) if lens == "EQUIRECTANGULAR" else (400, 400)
    folder = write_panoramas(tmp_path, lens, size, circle=lens != "EQUIRECTANGULAR")
    scene = read_capture(folder)
    cloud = og.fit(scene, progress=False)
    result = og.segment(cloud, {f"ball {i}": row for i, row in enumerate(np.eye(6, 8, dtype=np.float32))})
    truth = np.repeat(np.arange(6), 400)
    ahead = np.repeat(DIRECTIONS[:, 2] > 0.05, 400) if lens != "EQUIRECTANGULAR" else np.ones(2400, bool)
    assert ahead.sum() >= 1600
    assert (result.labels == truth)[ahead].mean() > 0.85  # but for rims, and backs that show through the balls alone
    assert ((result.labels == truth) | (result.labels == -1)).mean() > 0.998
    behind = np.repeat(DIRECTIONS[:, 2] < -0.5, 400)
    assert lens == "EQUIRECTANGULAR" or (result.labels[behind] == -1).all()


def test_masks_may_be_of_the_faces(panoramas):
    scene = read_capture(panoramas)
    features = {"feature_space": np.array("tiny")}
    for view in scene.views:
        ids = view.mask_map()
        write_image(panoramas / "masks" / f"{view.name}.png", (ids + 1).astype(np.uint16))
        features[view.name] = view.mask_features
    write_features(panoramas, features)
    for index in range(3):
        (panoramas / "masks" / f"pano_{index}.png").unlink()
    again = read_capture(panoramas)
    for view, same in zip(scene.views, again.views, strict=True):
        np.testing.assert_array_equal(view.mask_map(), same.mask_map())
        np.testing.assert_array_equal(view.mask_features, same.mask_features)


MADE_WRONG = {
    "masks=next": lambda maps: [maps[-1], *maps[:-1]],
    "masks=mirrored": lambda maps: [ids[:, ::-1] for ids in maps],
    "masks=from-zero": lambda maps: [np.maximum(ids, 1) - 1 for ids in maps],
}


@pytest.mark.parametrize("repair", MADE_WRONG)
def test_masks_of_panoramas_are_repaired_before_they_are_split(panoramas, repair):
    files = [panoramas / "masks" / f"pano_{index}.png" for index in range(3)]
    maps = [cv2.imread(str(file), cv2.IMREAD_UNCHANGED) for file in files]
    for ids in maps:  # row 0 is of no mask, as in files numbered from zero
        ids[ids > 0] += 1
    rows = np.eye(7, 8, dtype=np.float32)
    write_features(panoramas, {"feature_space": np.array("tiny"), **{f"pano_{index}": rows for index in range(3)}})

    def written_and_read(maps, repairs):
        for file, ids in zip(files, maps, strict=True):
            write_image(file, np.ascontiguousarray(ids))
        return read_capture(panoramas, repairs=repairs).views

    right = written_and_read(maps, [])
    repaired = written_and_read(MADE_WRONG[repair](maps), [repair])
    for view, same in zip(right, repaired, strict=True):
        np.testing.assert_array_equal(view.mask_map(), same.mask_map())
        np.testing.assert_array_equal(view.mask_features, same.mask_features)


def test_masks_of_half_the_size_halve_the_views(panoramas):
    for file in (panoramas / "masks").glob("*.png"):
        write_image(file, np.ascontiguousarray(cv2.imread(str(file), cv2.IMREAD_UNCHANGED)[::2, ::2]))
    scene = read_capture(panoramas)
    assert {view.camera.width for view in scene.views} == {40}
    assert all(view.mask_map().shape == (40, 40) for view in scene.views)
    image = scene.views[0].image_rgb()
    assert image.shape == (40, 40, 3)


def test_masks_that_do_not_fit_the_panorama_are_refused(panoramas):
    write_image(panoramas / "masks" / "pano_1.png", np.zeros((100, 100), np.uint16))
    with pytest.raises(SceneError, match=r"view 'pano_1/front': the masks are 100x100 pixels, its camera 256x128"):
        read_capture(panoramas)


def test_a_mask_without_features_is_refused(panoramas):
    features = {"feature_space": np.array("tiny")} | {f"pano_{i}": np.eye(5, 8, dtype=np.float32) for i in range(3)}
    write_features(panoramas, features)
    with pytest.raises(
        SceneError, match=r"view 'pano_0/\w+': mask id 6 has no feature row \(the features file has 5\)"
    ):
        read_capture(panoramas)


def test_masks_are_made_of_the_faces(panoramas, tmp_path):
    output = tmp_path / "made"
    made = make_masks(panoramas, MaskSettings(every=2), output, progress=False)
    assert made.images == 12
    scene = read_capture(output)
    assert [view.name for view in scene.views] == [f"pano_{i}/{face}" for i in (0, 2) for face in FACES]
    assert (output / "masks" / "pano_2" / "down.png").is_file()
    assert sum(view.mask_count for view in scene.views) > 6


@pytest.mark.parametrize("lens", ["EQUIRECTANGULAR", "OPENCV_FISHEYE"])
def test_given_masks_of_whole_images_are_cut_like_the_images(tmp_path, lens):
    capture_folder, given = write_panoramas(tmp_path / "c", lens, (256, 200 if lens == "OPENCV_FISHEYE" else 128)), {}
    expected = read_capture(capture_folder)
    maps = [view.mask_map() for view in expected.views]
    (capture_folder / "masks").rename(tmp_path / "given")
    # One image's masks as annotations of its own, and one by a COCO file for all images; the others are PNGs.
    for name in ("pano_1", "pano_2"):
        file = tmp_path / "given" / f"{name}.png"
        ids = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        file.unlink()
        masks = [(ids == id).T.ravel() for id in range(1, 7)]
        runs = [np.diff([0, *(np.flatnonzero(np.diff(mask)) + 1), mask.size]).tolist() for mask in masks]
        starts = [[0] if mask[0] else [] for mask in masks]
        given[name] = [
            {"image_id": 1, "segmentation": {"size": [*ids.shape], "counts": start + counts}}
            for start, counts in zip(starts, runs, strict=True)
        ]
    (tmp_path / "given" / "pano_1.json").write_text(json.dumps(given["pano_1"]))
    coco = {"images": [{"id": 1, "file_name": "images/pano_2.jpg"}], "annotations": given["pano_2"]}
    (tmp_path / "given" / "all.json").write_text(json.dumps(coco))
    (capture_folder / "mask_features.npz").unlink()
    settings = MaskSettings(str(tmp_path / "given"), encoder=None, tracks=True)
    make_masks(capture_folder, settings, progress=False)
    for view, before, ids in zip(read_capture(capture_folder).views, expected.views, maps, strict=True):
        things = np.append(before.mask_features.argmax(1), [-1, -1])[ids]  # NOT_SEEN, too, is outside every mask
        made = view.mask_map()
        assert len(np.unique(made * 8 + things)) == len(np.unique(made)) == len(np.unique(things)), view.name
        np.testing.assert_array_equal(made < 0, things < 0)
        if view.name.startswith("pano_0") and view.mask_count:
            assert view.mask_tracks is not None, "a thing has one track on all faces"
            np.testing.assert_array_equal(np.append(view.mask_tracks, -1)[made], things)
    settings = MaskSettings(str(tmp_path / "given"), encoder=None)
    assert make_masks(capture_folder, settings, progress=False).done_before == 0
    ids = cv2.imread(str(capture_folder / "masks" / "pano_0" / "front.png"), cv2.IMREAD_UNCHANGED)
    write_image(tmp_path / "given" / "pano_0" / "front.png", (ids > 0).astype(np.uint8))
    made = make_masks(capture_folder, settings, progress=False)
    assert cv2.imread(str(capture_folder / "masks" / "pano_0" / "front.png"), cv2.IMREAD_UNCHANGED).max() == 1, (
        "a face's own masks come first"
    )


def test_what_the_lens_did_not_see_says_nothing(tmp_path):
    """A fisheye's side faces are cut to its rim; what lies beyond is neither in a mask nor outside of all."""
    write_panoramas(tmp_path, "OPENCV_FISHEYE", (256, 200))
    scene = read_capture(tmp_path)
    maps = {view.name: view.mask_map() for view in scene.views}
    assert any((ids == NOT_SEEN).any() for ids in maps.values())
    points = scene.points
    spacing = np.full(len(points), 0.02, np.float32)
    cloud = isotropic(points, spacing, 0.5, 0.9)
    table = mask_table(cloud, scene.views, 0.01, spacing)
    for index, view in enumerate(scene.views):
        said = np.unique(np.r_[table.outside[[index]].indices, table.weights[table.mask_view == index].indices])
        uv, _ = view.camera.project(points.xyz[said])
        inside = view.camera.shows(uv)
        column, row = np.floor(uv[inside]).astype(int).T
        assert len(said) == 0 or (maps[view.name][row, column] != NOT_SEEN).mean() > 0.995


def test_colmaps_wide_cameras_are_views_too(tmp_path):
    world = make_world()
    write_colmap_text(
        tmp_path / "sparse/0", world, {1: ("OPENCV_FISHEYE", (20.0, 20.0, 32.0, 24.0, 0.0, 0.0, 0.0, 0.0))}
    )
    poses = read_poses(tmp_path)
    assert poses.names[:2] == ("frame_00/front", "frame_00/left")
    assert len(poses.names) > 2 * len(world.names)
    assert all(image.lens is None for image in poses.images)


@pytest.mark.parametrize("name", ["0", "pano_0"])  # the second is found by the image's name
def test_depth_of_a_wide_lens_is_read_in_front(tmp_path, name):
    folder = write_panoramas(tmp_path, "OPENCV_FISHEYE", (256, 256))
    if name == "0":
        edit_poses(folder, lambda content: content["frames"][0].update(depth_file_path="depth/0.npy"))
    (folder / "depth").mkdir()
    np.save(folder / f"depth/{name}.npy", np.full((256, 256), 2.0, np.float32))
    poses = read_poses(folder)
    ((view, depth),) = capture.depth_files(folder, poses).items()
    assert view == "pano_0/front"
    assert depth.read().camera.width == poses.images[0].camera.width
    assert (depth.read().depth == 2).all()


def test_depth_of_a_panorama_is_refused(panoramas):
    edit_poses(panoramas, lambda content: content["frames"][0].update(depth_file_path="depth/0.npy"))
    with pytest.raises(SceneError, match="equirectangular image is not read"):
        read_poses(panoramas)


def unit(*xyzw):
    return np.array(xyzw) / np.linalg.norm(xyzw)


def test_rigs_as_colmap_writes_them(tmp_path):
    """Since 3.12 poses are of frames, and of sensors in rigs; the images file has each image's own all the same."""
    pycolmap = pytest.importorskip("pycolmap")
    model = pycolmap.Reconstruction()
    for camera_id in (1, 2):
        params = [70.0, 72.0, 31.0, 25.0] if camera_id == 1 else [60.0, 60.0, 32.0, 24.0]
        model.add_camera(pycolmap.Camera(camera_id=camera_id, model="PINHOLE", width=64, height=48, params=params))
    rig = pycolmap.Rig(rig_id=1)
    left, right = (pycolmap.sensor_t(type=pycolmap.SensorType.CAMERA, id=number) for number in (1, 2))
    beside = pycolmap.Rigid3d(pycolmap.Rotation3d(unit(0.0, 0.0, 0.1, 1.0)), np.array([0.2, 0.0, 0.05]))
    rig.add_ref_sensor(left)
    rig.add_sensor(right, beside)
    model.add_rig(rig)
    expected = {}
    for number in range(2):
        frame = pycolmap.Frame(frame_id=number + 1, rig_id=1)
        turn = pycolmap.Rotation3d(unit(0.1, 0.2 * number, 0.0, 1.0))
        at = pycolmap.Rigid3d(turn, np.array([number, 0.5, 1.0]))
        for camera_id, side in ((1, "left"), (2, "right")):
            frame.add_data_id(pycolmap.data_t(left if camera_id == 1 else right, 2 * number + camera_id))
            pose = at if camera_id == 1 else beside * at
            expected[f"{side}/{number}.png"] = np.vstack([pose.matrix(), [0, 0, 0, 1]])
        frame.rig_from_world = at
        model.add_frame(frame)
        for camera_id, side in ((1, "left"), (2, "right")):
            image = pycolmap.Image(name=f"{side}/{number}.png", camera_id=camera_id, image_id=2 * number + camera_id)
            image.frame_id = number + 1
            model.add_image(image)
        model.register_frame(number + 1)
    for suffix, write in ((".bin", model.write_binary), (".txt", model.write_text)):
        folder = tmp_path / suffix / "sparse" / "0"
        folder.mkdir(parents=True)
        write(folder)
        assert (folder / f"rigs{suffix}").is_file()
        assert (folder / f"frames{suffix}").is_file()
        poses = read_poses(tmp_path / suffix)
        assert set(poses.names) == {"left/0", "right/0", "left/1", "right/1"}
        for image in poses.images:
            np.testing.assert_allclose(image.camera.world_to_camera, expected[image.path], atol=1e-9)
            assert image.camera.fx == (70.0 if image.path.startswith("left") else 60.0)


def test_depth_is_asked_for_by_the_name_of_a_face(tmp_path):
    """A panorama's own depth image, which holds lengths of rays, is not read: that of a face has to be named."""
    write_panoramas(tmp_path)
    first = read_poses(tmp_path).names[0]
    image, face = first.split("/")
    assert face == "front"
    write_image(tmp_path / "depth" / f"{image}.png", np.ones(SIZE[::-1], np.uint16))
    with pytest.raises(SceneError, match=f"has no depth images; expected depth/{first}.png and so on"):
        capture.fuse_capture(tmp_path)
