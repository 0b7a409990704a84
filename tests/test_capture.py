"""A capture folder becomes the same Scene whatever its format, and each thing that can be wrong has one clear error."""

import pickle
import shutil
import struct
import sys
import warnings
import zlib
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from capture_files import (
    HEIGHT,
    WIDTH,
    World,
    edit_poses,
    make_world,
    same_camera,
    write_colmap_binary,
    write_colmap_text,
    write_features,
    write_images,
    write_masks,
    write_transforms,
)
from scenes import write_image, write_ply

from og_pointcloud.errors import MissingExtraError, SceneError
from og_pointcloud.formats.capture import read_capture
from og_pointcloud.formats.images import find_image

REAL_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
REAL_CAPTURES = {"seven_redkitchen": 100, "apc_shelf_B": 15, "ycb_0050": 20, "nuscenes_frame": 6}


def make_capture(folder: Path, world: World | None = None) -> World:
    """transforms.json, images, masks, points.ply."""
    folder.mkdir(exist_ok=True)
    world = world or make_world()
    write_transforms(folder, world, ply_file_path="points.ply")
    write_images(folder, world.names)
    write_masks(folder, world.names)
    write_ply(folder / "points.ply", world.xyz, world.rgb)
    return world


@pytest.fixture
def capture(tmp_path):
    folder = tmp_path / "scene"
    world = make_capture(folder)
    return folder, world


def refused(folder, says):
    with pytest.raises(SceneError, match=says):
        read_capture(folder)


def write_blender(folder, world):
    """Square pixels and a centered principal point are all that this format can say."""
    angle = 2 * np.arctan(0.5 * WIDTH / world.intrinsics[0])
    others = dict.fromkeys(("fl_x", "fl_y", "cx", "cy", "w", "h"))
    write_transforms(folder, world, suffix="", name="transforms_train.json", camera_angle_x=angle, **others)


@pytest.mark.parametrize("offset", [0.0, 1e6])
@pytest.mark.parametrize(
    "write",
    [
        write_transforms,
        partial(write_transforms, per_frame=True, ply_file_path="points.ply"),
        write_blender,
        lambda folder, world: write_colmap_binary(folder / "sparse/0", world),
        lambda folder, world: write_colmap_text(folder / "colmap/sparse/0", world),
    ],
)
def test_all_formats_give_the_same_scene(tmp_path, write, offset):
    shift = np.array([offset, -offset, offset / 3])
    world = make_world(offset=shift)
    world.intrinsics = (70.0, 70.0, WIDTH / 2, HEIGHT / 2)
    write(tmp_path, world)
    write_images(tmp_path, world.names)
    write_masks(tmp_path, world.names)
    write_ply(tmp_path / "points.ply", world.xyz, world.rgb)
    scene = read_capture(tmp_path)
    assert [view.name for view in scene.views] == world.names
    np.testing.assert_allclose(scene.points.xyz_world, world.xyz, atol=1e-6)
    for view, pose in zip(scene.views, world.poses, strict=True):
        local = pose.copy()
        local[:3, 3] += pose[:3, :3] @ scene.points.origin
        assert same_camera(view.camera, world.camera(local))
    # And without any frame in between: local points through the local camera land where the world's do.
    camera, pose = scene.views[0].camera, world.poses[0]
    theirs = world.xyz @ pose[:3, :3].T + pose[:3, 3]
    ours = scene.points.xyz @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    np.testing.assert_allclose(ours, theirs, atol=2e-6)


@pytest.mark.parametrize(
    ("ids_kind", "kind"), [(np.uint8, np.float16), (np.uint16, np.float32), (np.uint16, np.float64)]
)
def test_masks_features_and_images_are_what_was_written(tmp_path, ids_kind, kind):
    world = make_world()
    write_transforms(tmp_path, world)
    image = write_images(tmp_path, world.names)
    features = {name: np.linspace(-1, 1, 16).reshape(2, 8).astype(kind) for name in world.names}
    ids, _ = write_masks(tmp_path, world.names, dtype=ids_kind, replaced=features)
    write_ply(tmp_path / "points.ply", world.xyz, world.rgb)
    scene = read_capture(str(tmp_path))
    assert scene.feature_space == "tiny"
    assert scene.feature_width == 8
    assert scene.name == tmp_path.name
    for view in scene.views:
        np.testing.assert_array_equal(view.mask_map(), ids.astype(int) - 1)
        assert view.mask_features.dtype == np.float32
        np.testing.assert_array_equal(view.mask_features, features[view.name].astype(np.float32))
        np.testing.assert_array_equal(view.image_rgb(), image)


def test_masks_and_images_are_read_when_asked_for(capture):
    folder, world = capture
    scene = read_capture(folder)
    shutil.rmtree(folder / "images")
    new = np.full((HEIGHT, WIDTH), 2, np.uint8)
    write_image(folder / "masks" / f"{world.names[0]}.png", new)
    assert (scene.views[0].mask_map() == 1).all()
    with pytest.raises(FileNotFoundError):
        scene.views[0].image_rgb()


@pytest.mark.parametrize("empty", [np.zeros((0, 8)), np.zeros((0, 8), int), np.array([])])
def test_a_view_without_masks_is_legal(capture, empty):
    folder, world = capture
    nothing = world.names[1]
    write_masks(folder, world.names, replaced={nothing: empty})
    write_image(folder / "masks" / f"{nothing}.png", np.zeros((HEIGHT, WIDTH), np.uint16))
    view = read_capture(folder).views[1]
    assert view.mask_count == 0
    assert (view.mask_map() == -1).all()


def test_a_features_file_without_a_space(capture):
    folder, world = capture
    write_features(folder, {name: np.ones((2, 8)) for name in world.names})
    assert read_capture(folder).feature_space == "unknown"


def test_language_features_are_found(capture):
    folder, world = capture
    (folder / "mask_features.npz").unlink()
    (folder / "language_features").mkdir()
    levels = np.full((4, HEIGHT, WIDTH), -1, np.float32)
    levels[1, :, :10], levels[3, :, 20:] = 0, 1
    for name in world.names:
        np.save(folder / "language_features" / f"{name}_s.npy", levels)
        np.save(folder / "language_features" / f"{name}_f.npy", np.arange(6.0).reshape(2, 3))
    large, small = read_capture(folder).views[0], read_capture(folder, mask_level="small").views[0]
    np.testing.assert_array_equal(large.mask_features, [[3, 4, 5]])
    np.testing.assert_array_equal(small.mask_features, [[0, 1, 2]])
    np.testing.assert_array_equal(large.mask_map(), np.where(levels[3] < 0, -1, 0))


def test_a_mask_level_of_masks_without_levels_is_refused(capture):
    with pytest.raises(
        SceneError, match=r"mask level is 'small', but the masks of .* have no levels; expected no level"
    ):
        read_capture(capture[0], mask_level="small")


# Resolution and distortion.


def test_masks_of_half_size_rule(capture):
    """The camera shrinks with the masks and the image follows: a pixel's ray stays the same."""
    folder, world = capture
    write_masks(folder, world.names, size=(WIDTH // 2, HEIGHT // 2))
    full = world.camera(world.poses[0])
    view = read_capture(folder).views[0]
    assert (view.camera.width, view.camera.height, view.camera.fx) == (WIDTH // 2, HEIGHT // 2, full.fx / 2)
    image = view.image_rgb()
    assert image.shape == (HEIGHT // 2, WIDTH // 2, 3)
    assert abs(int(image[0, 10, 0]) - 250 * 20.5 / (WIDTH - 1)) < 3
    assert view.mask_map().shape == image.shape[:2]


def test_a_shrunken_image_is_averaged(capture):
    """Stripes a pixel wide become their mean, not one of the two colors."""
    folder, world = capture
    write_masks(folder, world.names, size=(WIDTH // 2, HEIGHT // 2))
    stripes = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    stripes[:, ::2] = 200
    write_image(folder / "images/frame_00.png", stripes)
    image = read_capture(folder).views[0].image_rgb()
    assert (image == 100).all()


def test_a_small_image_beside_full_masks_is_enlarged(capture):
    folder, world = capture
    write_images(folder, world.names, size=(WIDTH // 4, HEIGHT // 4))
    image = read_capture(folder).views[0].image_rgb()
    assert image.shape == (HEIGHT, WIDTH, 3)


def test_an_image_of_another_shape_is_refused_when_read(capture):
    folder, world = capture
    write_images(folder, world.names, size=(HEIGHT, WIDTH))
    with pytest.raises(SceneError, match=r"frame_00.png is 48x64 pixels, its camera 64x48"):
        read_capture(folder).views[0].image_rgb()


def test_distorted_captures_are_undistorted(capture):
    """The border of the right mask moves out along the row of the principal point, in mask and image alike."""
    folder, world = capture
    write_transforms(folder, world, ply_file_path="points.ply", k1=-3.0)
    straight, view = make_world(), read_capture(folder).views[0]
    fx, _, cx, _ = straight.intrinsics
    row = int(view.camera.cy)
    border = WIDTH - WIDTH // 3
    r = next(r for r in np.arange(0, 1 / 3, 1e-4) if r * (1 - 3 * r**2) >= (border - cx) / fx)
    first = int(np.argmax(view.mask_map()[row] == 1))
    assert abs(first - (view.camera.cx + fx * r)) <= 1
    assert r > (border - cx) / fx
    image = view.image_rgb()
    assert abs(float(image[row, first, 0]) - 250 * border / WIDTH) < 6


@pytest.mark.parametrize("keys", [{}, {"k1": -0.3}, {"is_fisheye": True, "fl_x": 20, "fl_y": 20}])
def test_views_go_to_other_processes_whatever_their_lens(capture, keys):
    """As `fit` sends them to the workers of an executor."""
    folder, world = capture
    write_transforms(folder, world, ply_file_path="points.ply", **keys)
    views = read_capture(folder).views
    assert ("/" in views[0].name) == ("is_fisheye" in keys)
    for view in views:
        sent = pickle.loads(pickle.dumps(view))
        np.testing.assert_array_equal(sent.mask_map(), view.mask_map())
        np.testing.assert_array_equal(sent.image_rgb(), view.image_rgb())


# Names and files of images.


def test_equal_stems_in_two_folders_are_told_apart_by_folder(tmp_path):
    world = make_capture(tmp_path)
    names = ["left/000", "right/000", "right/001"]
    paths = iter(f"images/{name}.png" for name in names)
    edit_poses(tmp_path, lambda content: [frame.update(file_path=next(paths)) for frame in content["frames"]])
    shutil.rmtree(tmp_path / "images")
    write_images(tmp_path, names)
    write_masks(tmp_path, names)
    scene = read_capture(tmp_path)
    assert [view.name for view in scene.views] == names
    assert all(view.image_rgb() is not None for view in scene.views)
    assert len(world.names) == 3


@pytest.mark.parametrize("name", ["scan.0001", "frame_01.npy"])
def test_dots_in_names_are_no_suffix(capture, name):
    """Not even numpy's own, beside a view of the name without it."""
    folder, _ = capture
    edit_poses(folder, lambda content: content["frames"][0].update(file_path=f"./images/{name}"))
    for kind in ("images", "masks"):
        (folder / kind / "frame_00.png").rename(folder / kind / f"{name}.png")
    _, features = write_masks(folder, [name, "frame_01", "frame_02"])
    views = read_capture(folder).views
    assert views[0].name == name
    assert views[0].image_rgb() is not None
    for view in views[:2]:
        np.testing.assert_array_equal(view.mask_features, features[view.name].astype(np.float32))


def test_images_are_optional_but_missed(capture):
    folder, world = capture
    (folder / "images" / f"{world.names[1]}.png").unlink()
    with pytest.warns(UserWarning, match=r"1 of 3 images are listed but not found, e.g. 'images/frame_01.png'"):
        scene = read_capture(folder)
    assert [view.image_rgb() is None for view in scene.views] == [False, True, False]


@pytest.mark.parametrize(
    "path",
    ["/somewhere/else/frame_00.png", "../other/frame_00.png", "../../frame_00", "C:\\scans\\room 1\\frame_00.png"],
)
def test_paths_out_of_the_folder_are_looked_for_inside(capture, path):
    folder, _ = capture
    outside = folder.parent / "other"
    write_image(outside / "frame_00.png", np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    edit_poses(folder, lambda content: content["frames"][0].update(file_path=path))
    image = read_capture(folder).views[0].image_rgb()
    assert image.max() > 0, "the black image outside the capture was opened"


@pytest.mark.parametrize("root", ["/old/capture/images", "../capture/images", "/images", "../../left/../images"])
def test_images_of_a_rig_are_told_apart_whatever_leads_to_them(tmp_path, root):
    for place in ("images/left", "images/right", "images"):  # the last has the same name by chance
        write_image(tmp_path / place / "000.png", np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    for side in ("left", "right"):
        assert find_image(tmp_path, f"{root}/{side}/000") == tmp_path / "images" / side / "000.png"
    assert find_image(tmp_path / "images/left", f"{root}/right/000.png") == tmp_path / "images/left/000.png"
    assert find_image(tmp_path, "images/up/000.png") is None


@pytest.mark.parametrize("path", ["", ".", "./", "images/..", "/"])
def test_a_path_that_names_no_file_is_no_image_of_the_working_folder(tmp_path, monkeypatch, path):
    monkeypatch.chdir(tmp_path)
    assert find_image(Path(), path) is None


def test_frames_without_a_pose_are_left_out_aloud(capture):
    folder, _ = capture
    lost = np.full((4, 4), np.nan).tolist()
    edit_poses(folder, lambda content: content["frames"][1].update(transform_matrix=lost))
    with pytest.warns(
        UserWarning, match=r"no finite pose for 1 of \d+ frames, which are left out, e.g. 'images/frame_01.png'"
    ):
        scene = read_capture(folder)
    assert [view.name for view in scene.views] == ["frame_00", "frame_02"]


# Geometry.


def cloud_at(folder, name, x):
    """A cloud of two points whose x tells which file was read."""
    file = folder / name
    file.parent.mkdir(parents=True, exist_ok=True)
    write_ply(file, np.array([[x, 0, 0], [x, 1, 1.0]]), np.zeros((2, 3), np.uint8))


def test_geometry_is_chosen_in_order(tmp_path):
    world = make_capture(tmp_path)
    (tmp_path / "points.ply").unlink()
    write_transforms(tmp_path, world)
    write_colmap_text(tmp_path / "sparse/0", world)

    def x_of_cloud(**options):
        return float(read_capture(tmp_path, **options).points.xyz_world[0, 0])

    for x, name in [
        (1, "point_cloud/iteration_900/point_cloud.ply"),
        (2, "point_cloud/iteration_30000/point_cloud.ply"),
    ]:
        cloud_at(tmp_path, name, x)
        assert x_of_cloud() == x
    header = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 1\nHEIGHT 1\nPOINTS 1\nDATA ascii\n"
    (tmp_path / "map.pcd").write_text(header + "3 0 0\n")
    assert x_of_cloud() == 3
    for x, name in [(4, "point_cloud.ply"), (5, "points.ply")]:
        cloud_at(tmp_path, name, x)
        assert x_of_cloud() == x
    cloud_at(tmp_path, "fused/dense.ply", 6)
    edit_poses(tmp_path, lambda content: content.update(ply_file_path="./fused/dense.ply"))
    assert x_of_cloud() == 6
    cloud_at(tmp_path.parent, "given.ply", 7)
    assert x_of_cloud(gaussians=str(tmp_path.parent / "given.ply")) == 7


def test_points_of_colmap_go_with_its_own_poses_alone(tmp_path):
    world = make_world()
    make_capture(tmp_path, world)
    (tmp_path / "points.ply").unlink()
    write_colmap_binary(tmp_path / "sparse/0", world)
    write_transforms(tmp_path, world)
    refused(tmp_path, r"points3D may differ .* remove transforms.json, so that COLMAP's poses")
    (tmp_path / "transforms.json").unlink()
    np.testing.assert_allclose(read_capture(tmp_path).points.xyz_world, world.xyz, atol=1e-5)


@pytest.mark.parametrize("path", ["../points.ply", "/tmp/points.ply", "sub/../../points.ply", "absent.ply"])
def test_ply_file_path_stays_inside(capture, path):
    folder, _ = capture
    shutil.copy(folder / "points.ply", folder.parent / "points.ply")
    edit_poses(folder, lambda content: content.update(ply_file_path=path))
    refused(folder, r"ply_file_path is '.*', which is not a file inside the capture folder; .*--gaussians")


# Errors at the door.


def test_mask_id_without_feature_row(capture):
    folder, world = capture
    write_masks(folder, world.names, replaced={world.names[2]: np.ones((1, 8))})
    view = read_capture(folder).views[2]
    with pytest.raises(SceneError, match=r"view 'frame_02': mask id 2 has no feature row \(the features file has 1\)"):
        view.mask_map()


def png_with_header(width, height, bit_depth, color_type):
    header = b"IHDR" + struct.pack(">IIBBBBB", width, height, bit_depth, color_type, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header))


def without(*paths):
    return lambda folder, _: [(folder / path).rename(folder.parent / Path(path).name) for path in paths]


def posed(change):
    return lambda folder, _: edit_poses(folder, change)


def last_features(values):
    return lambda folder, names: write_masks(folder, names, replaced={names[2]: values})


def a_mask_of(pixels):
    return lambda folder, _: write_image(folder / "masks/frame_01.png", pixels)


def mask_bytes(data):
    return lambda folder, _: (folder / "masks/frame_01.png").write_bytes(data)


def two_pcds(folder, names):
    no_cloud(folder, names)
    (folder / "a.pcd").touch()
    (folder / "b.pcd").touch()


def no_cloud(folder, _):
    (folder / "points.ply").unlink()
    edit_poses(folder, lambda content: content.pop("ply_file_path"))


def no_images(folder, names):
    without("images")(folder, names)
    edit_poses(folder, lambda content: [content.pop(key) for key in ("w", "h")])


NO_FLOATS = r"'frame_02': features are .*; expected floats of shape \(masks, dimension\)"
NO_GRAY = "; expected an 8-bit or 16-bit gray PNG"


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (without("transforms.json"), r"has no pose file; expected transforms.json .* sparse/0"),
        (
            posed(lambda content: content["frames"].append(content["frames"][0])),
            "two images have the path 'images/frame_00'; exp",
        ),
        (no_images, r"image 'images/frame_00.png' is not found, and the pose file has no w and h"),
        (no_cloud, r"no geometry; expected points.ply .*points3D.*--gaussians"),
        (two_pcds, r"has 2 .pcd files \(a.pcd, b.pcd, ...\); expected one: name the one"),
        (without("mask_features.npz"), r"has masks/ but no mask_features.npz; expected"),
        (
            without("mask_features.npz", "masks"),
            r"has no masks at all; expected masks/<image stem>.png .*language_features",
        ),
        (
            posed(lambda content: content["frames"][1].update(file_path="images/" + "long" * 100)),
            r"1 of 3 posed images have no mask: .*lacks longlong.{60,80}; expected .*all-zero mask",
        ),
        (
            without("masks/frame_01.png"),
            r"1 of 3 posed images have no mask: .*lacks frame_01.png; .*all-zero mask",
        ),
        (
            lambda folder, names: write_features(folder, {name: np.ones((2, 8)) for name in names[:2]}),
            r"lacks 1 of 3 arrays, e.g. 'frame_02' \(it has frame_00, frame_01",
        ),
        (last_features(np.ones((2, 9))), r"2 dimensions \[8, 9\] \(e.g. frame_02: 9\)"),
        (last_features(np.full((2, 8), np.nan)), "view 'frame_02': the feature of mask 1 contains NaN"),
        (last_features(np.ones(8)), NO_FLOATS),
        (last_features(np.ones((2, 2, 2))), NO_FLOATS),
        (last_features(np.ones((2, 8), int)), NO_FLOATS),
        (
            lambda folder, names: write_masks(folder, names, size=(HEIGHT, WIDTH)),
            r"view 'frame_00': the masks are 48x64 pixels, its camera 64x48; expected",
        ),
        (a_mask_of(np.zeros((HEIGHT, WIDTH, 3), np.uint8)), r"a PNG, 8-bit RGB \(3 channels\)" + NO_GRAY),
        (a_mask_of(np.zeros((HEIGHT, WIDTH, 4), np.uint16)), r"a PNG, 16-bit RGBA \(4 channels\)" + NO_GRAY),
        (mask_bytes(png_with_header(WIDTH, HEIGHT, 4, 0)), r"frame_01.png is a PNG, 4-bit gray"),
        (mask_bytes(png_with_header(2**31 - 1, 2**31 - 1, 8, 0)), "frame_01.png .*at most 134217728 pixels"),
        (mask_bytes(b"\xff\xd8\xff\xe0JFIF" * 10), "frame_01.png is not a PNG"),
        (mask_bytes(b""), "frame_01.png is not a PNG"),
    ],
)
def test_what_is_wrong_is_named(capture, change, says):
    folder, world = capture
    change(folder, world.names)
    refused(folder, says)


def test_truncated_mask_and_image(capture):
    folder, _ = capture
    scene = read_capture(folder)
    for kind in ("masks", "images"):
        file = folder / kind / "frame_01.png"
        file.write_bytes(file.read_bytes()[:60])
    with pytest.raises(SceneError, match=r"masks/frame_01.png \(60 bytes\) cannot be decoded"):
        scene.views[1].mask_map()
    with pytest.raises(SceneError, match=r"images/frame_01.png \(60 bytes\) cannot be decoded"):
        scene.views[1].image_rgb()


def test_damaged_compressed_features_are_refused(capture):
    folder, world = capture
    file = folder / "mask_features.npz"
    np.savez_compressed(
        file, allow_pickle=False, **{name: np.random.default_rng(0).normal(size=(9, 64)) for name in world.names}
    )
    assert read_capture(folder).views[0].mask_count == 9
    broken = bytearray(file.read_bytes())
    broken[60:300] = b"\xff" * 240
    file.write_bytes(bytes(broken))
    refused(folder, r"cannot be read as an .npz of plain arrays .*decompressing")


def test_a_features_bomb_is_refused(capture, monkeypatch):
    folder, _ = capture
    monkeypatch.setattr("og_pointcloud.formats.mask_files.MAX_FEATURE_BYTES", 500)
    refused(folder, r"unpacks to \d+ bytes; expected at most 500")


def test_without_opencv_the_extra_is_named(capture, monkeypatch):
    folder, _ = capture
    monkeypatch.setitem(sys.modules, "cv2", None)
    scene = read_capture(folder)
    with pytest.raises(MissingExtraError, match=r"og-pointcloud\[fit\]"):
        scene.views[0].mask_map()


# Real captures.


@pytest.mark.parametrize(("name", "views"), REAL_CAPTURES.items())
def test_real_captures(name, views):
    folder = REAL_DATA / name
    if not folder.is_dir():
        pytest.skip(f"{folder} is absent")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = read_capture(folder)
    assert len(scene.views) == views
    assert scene.feature_space == "openai/clip-vit-base-patch32"
    assert scene.feature_width == 512
    for view in scene.views[:: max(1, views // 6)]:
        ids = view.mask_map()
        assert ids.min() >= -1
        assert ids.max() < view.mask_count
        assert color_correlation(scene.points, view) > 0.5


def color_correlation(points, view):
    """Correlation of the brightness of visible points with that of their pixels."""
    camera, image = view.camera, view.image_rgb()
    uv_px, depth = camera.project(points.xyz)
    inside = camera.shows(uv_px)
    (j, i), depth, gray = uv_px[inside].astype(int).T, depth[inside], points.rgb[inside].mean(1)
    cell = i // 8 * camera.width + j // 8
    nearest = np.full(cell.max() + 1, np.inf)
    np.minimum.at(nearest, cell, depth)
    visible = depth < nearest[cell] * 1.03
    return np.corrcoef(image[i[visible], j[visible]].mean(1), gray[visible])[0, 1]
