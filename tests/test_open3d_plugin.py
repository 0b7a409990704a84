"""The Open3D plugin: the same kind out, refusals in words, a window that is described, pictures that are looked at."""

from __future__ import annotations

import ctypes.util
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from labelled_clouds import make_cloud, room
from og_pointcloud_export import write_bundle

import og_pointcloud as og
from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.formats.colors import UNKNOWN_COLOR, label_colors
from og_pointcloud.formats.gaussian_ply import write_gaussian_ply
from og_pointcloud.scene import Points

open3d = pytest.importorskip("open3d")
og3 = pytest.importorskip("og_pointcloud_open3d")

from og_pointcloud_open3d import host, offscreen  # noqa: E402

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
WORDS = ["apple", "pear", "plum"]
HAS_SPLATS = tuple(map(int, open3d.__version__.split(".")[:2])) >= (0, 20)
needs_driver = pytest.mark.skipif(
    HAS_SPLATS and ctypes.util.find_library("vulkan") is None, reason="no Vulkan: libvulkan1 mesa-vulkan-drivers"
)
needs_splats = pytest.mark.skipif(not HAS_SPLATS, reason="Gaussians are drawn by Open3D 0.20 and later")


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    return write_bundle(room(1200), tmp_path_factory.mktemp("scene") / "room.ogpc")


@pytest.fixture(scope="module")
def scene(bundle):
    return og.load(bundle)


def legacy_cloud(scene):
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(scene.xyz))
    cloud.normals = open3d.utility.Vector3dVector(np.tile([0.0, 0, 1], (len(scene.xyz), 1)))
    return cloud


def legacy_mesh(scene):
    faces = open3d.utility.Vector3iVector(np.array([[0, 1, 2], [2, 3, 4]]))
    return open3d.geometry.TriangleMesh(open3d.utility.Vector3dVector(scene.xyz), faces)


# Segmenting


def test_legacy_geometry_comes_back_painted_beside_its_labels(scene):
    for cloud, colors_of in ((legacy_cloud(scene), "colors"), (legacy_mesh(scene), "vertex_colors")):
        painted, result = og3.segment(cloud, WORDS, scene)
        assert type(painted) is type(cloud)
        assert np.array_equal(np.rint(np.asarray(getattr(painted, colors_of)) * 255), result.colors)
        assert np.array_equal(result.labels, og.segment(scene.xyz, WORDS, scene).labels)
        assert len(getattr(cloud, colors_of)) == 0, "what was given stays as it was"
    assert painted.has_triangles()
    assert og3.segment(legacy_cloud(scene), WORDS, scene).cloud.has_normals()


def test_tensor_geometry_comes_back_with_attributes(scene):
    cloud = open3d.t.geometry.PointCloud.from_legacy(legacy_cloud(scene))
    mesh = open3d.t.geometry.TriangleMesh.from_legacy(legacy_mesh(scene))
    for geometry, name in ((cloud, "point"), (mesh, "vertex")):
        painted, result = og3.segment(geometry, WORDS, scene)
        assert type(painted) is type(geometry)
        tensors = getattr(painted, name)
        for attribute, values in result.attributes.items():
            assert tensors[attribute].numpy().dtype == values.dtype
            assert np.array_equal(tensors[attribute].numpy(), values[:, None])
        assert np.array_equal(np.rint(tensors["colors"].numpy() * 255), result.colors)
        assert "og_label" not in getattr(geometry, name)
    painted = og3.segment(cloud, WORDS, scene).cloud
    assert "normals" in painted.point
    apples = painted.select_by_mask(painted.point["og_label"].flatten() == 0)
    assert len(apples.point["positions"]) == og.segment(scene, WORDS).counts()["apple"]
    assert len(painted.voxel_down_sample(0.3).point["og_score"]) > 3


def test_a_result_becomes_a_tensor_cloud(scene):
    result = og.segment(scene, WORDS)
    cloud = result.to_open3d()
    assert np.array_equal(cloud.point["positions"].numpy(), result.xyz)
    assert np.array_equal(cloud.point["og_instance"].numpy()[:, 0], result.instances)
    again = og3.segment(cloud, WORDS, scene).result
    assert np.array_equal(again.labels, result.labels)


def test_other_arguments_reach_segment(scene):
    pose = np.eye(4)
    pose[:3, 3] = [5, 6, 7]
    moved = open3d.t.geometry.PointCloud(open3d.core.Tensor(scene.xyz - [5, 6, 7]))
    painted, result = og3.segment(moved, WORDS, scene, pose=pose, negatives=["café"])
    assert np.array_equal(result.labels, og.segment(scene, WORDS, negatives=["café"]).labels)
    assert np.allclose(painted.point["positions"].numpy(), scene.xyz - [5, 6, 7])


@pytest.mark.parametrize("kind", ["legacy", "tensor"])
def test_an_empty_cloud_is_refused(scene, kind):
    cloud = open3d.geometry.PointCloud() if kind == "legacy" else open3d.t.geometry.PointCloud()
    with pytest.raises(SceneError, match="0 points; Open3D returns such a cloud for a file that it cannot read"):
        og3.segment(cloud, WORDS, scene)


def test_other_geometry_is_refused(scene):
    lines = open3d.geometry.LineSet(legacy_cloud(scene).points, open3d.utility.Vector2iVector(np.array([[0, 1]])))
    with pytest.raises(OgPointcloudError, match=r"a LineSet of open3d.* cannot be painted"):
        og3.segment(lines, WORDS, scene)


def test_reading_refuses_what_open3d_reads_as_nothing(scene, tmp_path):
    path = tmp_path / "a.ply"
    open3d.io.write_point_cloud(str(path), legacy_cloud(scene))
    assert len(og3.read(path).point["positions"]) == len(scene.xyz)
    for name in ("b.xyz", "c.unheard"):
        (tmp_path / name).write_text("no numbers here\n")
        with pytest.raises(SceneError, match="Open3D reads no point of it"):
            og3.read(tmp_path / name)
    open3d.io.write_point_cloud(str(tmp_path / "d.pcd"), legacy_cloud(scene))
    for damaged in (path, tmp_path / "d.pcd"):
        damaged.write_bytes(damaged.read_bytes()[:-50])
        with pytest.raises(SceneError, match=f"{damaged.name}: .*truncated"):  # Open3D returns uninitialised memory
            og3.read(damaged)
    path.write_bytes(b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nend_header\n1\n2\n")
    with pytest.raises(SceneError, match="no column y, z"):
        og3.read(path)
    with pytest.raises(SceneError, match="no such file"):
        og3.read(tmp_path / "missing.ply")


# Open3D itself


def test_missing_system_libraries_are_one_sentence(monkeypatch):
    def fail(name):
        raise OSError("libusb-1.0.so.0: cannot open shared object file: No such file or directory")

    monkeypatch.setattr(host.importlib, "import_module", fail)
    with pytest.raises(
        OgPointcloudError, match=r"does not load \(libusb.*apt-get install libusb-1.0-0 libgl1"
    ) as caught:
        host.open3d()
    assert "\n" not in str(caught.value)


def test_open3d_that_is_not_installed_names_the_extra(scene, monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(og.MissingExtraError, match=r"og-pointcloud\[open3d\]"):
        og.segment(scene, WORDS).to_open3d()


def test_old_versions_are_refused_in_words(monkeypatch, tmp_path):
    monkeypatch.setattr(open3d, "__version__", "0.18.0")
    with pytest.raises(OgPointcloudError, match=r"Open3D is 0.18.0; this plugin needs 0.19 or later"):
        host.open3d()
    monkeypatch.setattr(open3d, "__version__", "0.19.0")
    assert host.open3d() is open3d
    with pytest.raises(OgPointcloudError, match=r"Open3D is 0.19.0; drawing Gaussians needs 0.20 or later"):
        og3.highlight_png(tmp_path / "a.png", "splats.ply", "apple", "room.ogpc")
    monkeypatch.setattr(open3d, "__version__", "0.20.0+dev1")
    host.require_version(open3d, host.WITH_SPLATS, "this")


# The window


class Window:
    """Open3D's O3DVisualizer as far as the buttons use it; remembers what was asked of it."""

    scaling = 1.0

    def __init__(self):
        self.said, self.geometries, self.labels = [], {}, []
        self.scene = self.view = self

    def set_post_processing(self, on):
        self.post_processing = on

    def add_3d_label(self, place, text):
        self.labels.append((np.asarray(place), text))

    def show_message_box(self, title, message):
        self.said.append(message)

    def remove_geometry(self, name):
        del self.geometries[name]

    def add_geometry(self, geometry):
        self.geometries[geometry["name"]] = geometry

    def close_dialog(self):
        pass

    post_redraw = close_dialog


@pytest.fixture
def shown(scene, monkeypatch, tmp_path):
    """(window, arguments of Open3D's draw, result) of a drawn cloud far from the origin, one row of it NaN."""
    seen = {}
    monkeypatch.setenv("DISPLAY", ":99")
    monkeypatch.setattr(open3d.visualization, "draw", lambda geometry, **options: seen.update(options, g=geometry))
    far = make_cloud(scene.cloud.xyz, scene.instance_ids, 0.05, 0.15, (1e6, 0, 0), scene.cloud.instances)
    points = np.concatenate([far.xyz_world, [[np.nan, 0, 0]]])
    bundle = write_bundle(far, tmp_path / "far.ogpc")
    result = og3.draw(points, WORDS, bundle, export=tmp_path / "out.glb")
    window = Window()
    for geometry in seen["g"]:
        window.add_geometry(geometry)
    seen["on_init"](window)
    return window, seen, result


def test_the_window_has_a_group_a_class_and_a_geometry_an_instance(shown):
    window, seen, result = shown
    groups = {geometry["group"] for geometry in window.geometries.values()}
    assert groups == {name for name, count in result.counts().items() if count} | {"unknown"}
    finite = np.isfinite(result.xyz[:, 0])
    assert sum(len(g["geometry"].point["positions"]) for g in window.geometries.values()) == finite.sum()
    for name, geometry in window.geometries.items():
        colors = np.rint(geometry["geometry"].point["colors"].numpy() * 255)
        expected = label_colors(np.array([-1 if name == "unknown" else WORDS.index(geometry["group"])]))
        assert (colors == expected).all()
        if name != "unknown":
            rows = finite & (result.instances == int(name.rpartition(" ")[2]))
            assert len(colors) == rows.sum()
    assert sorted(text for _, text in window.labels) == sorted(
        geometry["group"] for geometry in window.geometries.values() if geometry["group"] != "unknown"
    )
    assert max(np.abs(place).max() for place, _ in window.labels) < 3, "float32 needs places near the origin"
    assert window.post_processing is False
    assert np.abs(seen["lookat"]).max() < 3


def test_a_typed_query_turns_what_fits_yellow(shown, scene):
    window, seen, result = shown
    view = dict(seen["actions"])["Query"].__self__

    def yellow():
        return {
            name: int((np.rint(geometry["geometry"].point["colors"].numpy() * 255) == [255, 217, 0]).all(axis=1).sum())
            for name, geometry in window.geometries.items()
        }

    before = set(window.geometries)
    for word in ("pear", "plum"):
        view.answer(window, word)
        instances = og.select(scene, word).instances
        assert instances
        assert sum(yellow().values()) == np.isin(result.instances, instances).sum()
        assert set(window.geometries) == before
    view.answer(window, "no such word")
    assert "no such word" in window.said[-1]
    assert sum(yellow().values()), "a failed query leaves the last one"


def test_export_writes_and_says_so_or_why_not(shown, tmp_path):
    window, seen, _ = shown
    actions = dict(seen["actions"])
    actions["Export"](window)
    assert "hold NaN" in window.said[-1]
    actions["Export"].__self__._path = tmp_path / "out.ply"
    actions["Export"](window)
    assert window.said[-1] == f"wrote {tmp_path / 'out.ply'}"
    assert (tmp_path / "out.ply").exists()


def test_no_window_without_a_display_nor_without_points(scene, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(OgPointcloudError, match="no display"):
        og3.draw(scene, WORDS)
    monkeypatch.setenv("DISPLAY", ":99")
    with (
        pytest.warns(UserWarning, match="too far"),
        pytest.raises(SceneError, match="none of 2 points has finite coordinates"),
    ):
        og3.draw(np.full((2, 3), np.nan), WORDS, scene)


# Pictures


def picture(path):
    return np.asarray(open3d.io.read_image(str(path)))


def wall(count=60):
    """A square of 3 at x = 0, seen from x < 0; its left half is instance 0, its right one 1."""
    side = np.linspace(-1.5, 1.5, count)
    yz = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    return np.column_stack([np.zeros(len(yz)), yz]), (yz[:, 0] < 0).astype(np.int32)


CAMERA_SIZE = (96, 64)


def camera(origin=(0, 0, 0)):
    return og3.look_at(np.add(origin, [-2.0, 0, 0]), origin, size=CAMERA_SIZE, view_angle_deg=40)


def test_look_at_puts_the_target_in_the_middle_and_up_up():
    seen = og3.look_at((1, 2, 3), (4, 4, 4), size=(100, 80))
    x, y, depth, _ = seen.world_to_camera @ [4, 4, 4, 1]
    assert (round(x, 9), round(y, 9)) == (0, 0)
    assert depth == pytest.approx(np.sqrt(14))
    above = seen.world_to_camera @ [4, 4, 4.1, 1]
    assert above[1] < 0
    assert np.allclose(seen.center, [1, 2, 3])
    with pytest.raises(OgPointcloudError, match="on one line"):
        og3.look_at((0, 0, 1), (0, 0, 0))


@pytest.mark.slow
@needs_driver
def test_painted_points_are_drawn_in_their_exact_colours(tmp_path):
    origin = np.array([1e6, -4e6, 300.0])
    xyz, side = wall()
    scene = og.load(write_bundle(make_cloud(xyz, side, 0.05, 0.15, origin), tmp_path / "wall.ogpc"))
    result = og.segment(scene, WORDS)
    assert set(result.labels.tolist()) == {0, 1}
    from_result = picture(og3.draw_png(tmp_path / "a.png", result, camera=camera(origin), point_size=8))
    assert from_result.shape == (CAMERA_SIZE[1], CAMERA_SIZE[0], 3)
    left, right = label_colors(result.labels[[side.argmin(), side.argmax()]])
    assert (from_result[32, 20] == left).all()
    assert (from_result[32, 76] == right).all()
    legacy = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(scene.xyz))
    arguments = {"camera": camera(origin), "point_size": 8}
    painted = og3.draw_png(tmp_path / "b.png", og3.segment(legacy, WORDS, scene).cloud, **arguments)
    assert np.array_equal(picture(painted), from_result)
    labelled = og3.draw_png(tmp_path / "c.png", legacy, WORDS, scene, **arguments)
    assert np.array_equal(picture(labelled), from_result)


def splat_wall():
    xyz, side = wall(40)
    count = len(xyz)
    return side, Points.from_world(
        xyz, rgb=np.full((count, 3), [40, 90, 160], np.uint8), scale=np.full((count, 3), 0.06, np.float32),
        rotation=np.tile(np.float32([1, 0, 0, 0]), (count, 1)), opacity=np.full(count, 0.95, np.float32),
    )  # fmt: skip


@needs_driver
@needs_splats
def test_a_query_stands_out_in_a_splat_rendering(tmp_path):
    side, splats = splat_wall()
    write_gaussian_ply(tmp_path / "splats.ply", splats)
    bundle = write_bundle(make_cloud(splats.xyz_world, side, 0.08, 0.2), tmp_path / "wall.ogpc")
    word = next(word for word in WORDS if og.select(bundle, word).instances == (0,))
    image = picture(
        og3.highlight_png(tmp_path / "a.png", tmp_path / "splats.ply", word, bundle, camera=camera(), color=(255, 0, 0))
    ).astype(int)
    found, other = image[10:54, 10:40], image[10:54, 56:86]
    assert (found[..., 0] - found[..., 1] > 90).all()
    assert (np.ptp(other, axis=-1) <= 3).all(), "grey"
    assert (other > 150).all(), "faded"


@needs_splats
def test_what_cannot_be_highlighted_is_said(scene, bundle, tmp_path):
    _, splats = splat_wall()
    with pytest.raises(OgPointcloudError, match="'apple' fits none"):
        og3.highlight_png(tmp_path / "a.png", splats, {"apple": -scene.vocabulary.vectors.sum(axis=0)}, scene)
    open3d.io.write_point_cloud(str(tmp_path / "plain.ply"), legacy_cloud(scene))
    with pytest.raises(SceneError, match="plain points; expected 3D Gaussians"):
        og3.highlight_png(tmp_path / "a.png", tmp_path / "plain.ply", "apple", scene)
    assert not (tmp_path / "a.png").exists()


@needs_splats
def test_a_missing_driver_is_one_sentence_and_not_the_end(scene, tmp_path, monkeypatch):
    monkeypatch.setenv("VK_ICD_FILENAMES", str(tmp_path / "none.json"))
    with pytest.raises(OgPointcloudError, match=r"could not draw off-screen \(.*apt-get install libvulkan1") as caught:
        og3.draw_png(tmp_path / "a.png", og.segment(scene, WORDS))
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "a.png").exists()


def test_pictures_are_png_and_of_points(scene, tmp_path):
    with pytest.raises(OgPointcloudError, match=r"a.jpg'; expected a name that ends in .png"):
        og3.draw_png(tmp_path / "a.jpg", og.segment(scene, WORDS))
    with pytest.raises(SceneError, match="0 points with finite coordinates"):
        og3.draw_png(tmp_path / "a.png", np.full((3, 3), np.nan))


def test_colours_of_every_kind_are_found(scene):
    painted, result = og3.segment(legacy_cloud(scene), WORDS, scene)
    kinds = [painted, og3.segment(legacy_mesh(scene), WORDS, scene).cloud, result.to_open3d()]
    bytes_cloud = result.to_open3d()
    bytes_cloud.point["colors"] = open3d.core.Tensor(result.colors)
    for cloud in (*kinds, bytes_cloud):
        assert np.array_equal(offscreen._colors(cloud), result.colors)
    assert (offscreen._colors(legacy_cloud(scene)) == 0).all()
    assert UNKNOWN_COLOR in {tuple(color) for color in result.colors.tolist()}


# Examples


def run_example(name, *arguments):
    command = [sys.executable, str(EXAMPLES / name), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, env=dict(os.environ), timeout=120)
    assert done.returncode == 0, done.stderr
    assert len((EXAMPLES / name).read_text().splitlines()) < 60
    return done.stdout


@pytest.mark.slow
@needs_driver
def test_example_of_a_painted_cloud(scene, bundle, tmp_path):
    open3d.io.write_point_cloud(str(tmp_path / "cloud.ply"), legacy_cloud(scene))
    said = run_example(
        "04_open3d_cloud.py", bundle, tmp_path / "cloud.ply", "--labels=apple,pear", "-o", tmp_path / "p.png"
    )
    assert "voxels of apple" in said
    assert len(np.unique(picture(tmp_path / "p.png").reshape(-1, 3), axis=0)) >= 4
    labels = open3d.t.io.read_point_cloud(str(tmp_path / "p.ply")).point["og_label"].numpy()[:, 0]
    assert np.array_equal(labels, og.segment(og.read_points(tmp_path / "cloud.ply").xyz_world, WORDS[:2], scene).labels)


@pytest.mark.slow
@needs_driver
@needs_splats
def test_example_of_a_highlight(tmp_path):
    side, splats = splat_wall()
    write_gaussian_ply(tmp_path / "splats.ply", splats)
    bundle = write_bundle(make_cloud(splats.xyz_world, side, 0.08, 0.2), tmp_path / "wall.ogpc")
    options = ("--eye=-3,0,0.1", "--target=0,0,0", "-o", tmp_path / "h.png")
    run_example("05_highlight_in_splats.py", bundle, tmp_path / "splats.ply", "apple", *options)
    assert picture(tmp_path / "h.png").shape == (480, 640, 3)


@pytest.mark.slow
@needs_driver
def test_example_of_las_and_gltf(scene, bundle, tmp_path):
    pytest.importorskip("trimesh")
    laspy = pytest.importorskip("laspy")
    og.segment(scene, WORDS).to_las().write(str(tmp_path / "in.laz"))
    said = run_example("06_las_and_gltf.py", bundle, tmp_path / "in.laz", "--labels=apple,pear", "-o", tmp_path / "out")
    assert "apple: " in said
    assert "of labels agree" in said
    assert len(laspy.read(tmp_path / "out.laz")) == len(scene.xyz)
    assert (tmp_path / "out.glb").exists()
    assert (tmp_path / "out.png").exists()
