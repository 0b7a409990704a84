"""The Open3D plugin: the same kind out, refusals in words."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from labelled_clouds import make_cloud, quietly
from og_pointcloud_export import write_bundle

import og_pointcloud as og
from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.formats.gaussian_ply import gaussian_rows
from og_pointcloud.formats.ply import write_ply
from og_pointcloud.scene import Points

open3d = pytest.importorskip("open3d")
og3 = pytest.importorskip("og_pointcloud_open3d")

from og_pointcloud_open3d import convert  # noqa: E402

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
WORDS = ["apple", "pear", "plum"]


def legacy_cloud(scene):
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(scene.xyz.copy()))
    cloud.normals = open3d.utility.Vector3dVector(np.tile([0.0, 0, 1], (len(scene.xyz), 1)))
    return cloud


def legacy_mesh(scene):
    faces = open3d.utility.Vector3iVector(np.array([[0, 1, 2], [2, 3, 4]]))
    return open3d.geometry.TriangleMesh(open3d.utility.Vector3dVector(scene.xyz.copy()), faces)


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
    assert len(quietly(np.zeros((0, 3)), WORDS, scene).to_open3d().point["og_label"]) == 0


def test_other_arguments_reach_segment(scene):
    pose = np.eye(4)
    pose[:3, 3] = [5, 6, 7]
    moved = open3d.t.geometry.PointCloud(open3d.core.Tensor(scene.xyz - [5, 6, 7]))
    painted, result = og3.segment(moved, WORDS, scene, pose=pose, max_distance=0.01)
    assert np.array_equal(result.labels, og.segment(scene.xyz, WORDS, scene, max_distance=0.01).labels)
    assert np.allclose(painted.point["positions"].numpy(), scene.xyz - [5, 6, 7])


@pytest.mark.parametrize("kind", ["legacy", "tensor"])
def test_an_empty_cloud_is_refused(scene, kind):
    cloud = open3d.geometry.PointCloud() if kind == "legacy" else open3d.t.geometry.PointCloud()
    with pytest.raises(SceneError, match="0 points; Open3D returns such a cloud for a file that it cannot read"):
        og3.segment(cloud, WORDS, scene)


def test_positions_of_open3d_are_points(scene):
    expected = og.segment(scene.xyz, WORDS, scene).labels
    legacy = legacy_cloud(scene)
    tensor = open3d.t.geometry.PointCloud.from_legacy(legacy)
    for points in (legacy.points, tensor.point.positions):
        np.testing.assert_array_equal(og.segment(points, WORDS, scene).labels, expected)


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
    og.segment(scene, WORDS).save(tmp_path / "d.npz")  # Open3D raises a RuntimeError of several lines
    for name in ("b.xyz", "c.unheard", "d.npz"):
        with pytest.raises(SceneError, match="Open3D reads no points from it"):
            og3.read(tmp_path / name)
    open3d.io.write_point_cloud(str(tmp_path / "D.PCD"), legacy_cloud(scene))
    for damaged in (path, tmp_path / "D.PCD"):
        damaged.write_bytes(damaged.read_bytes()[:-50])
        with pytest.raises(SceneError, match=f"{damaged.name}: .*truncated"):  # Open3D returns uninitialized memory
            og3.read(damaged)
    path.write_bytes(b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nend_header\n1\n2\n")
    with pytest.raises(SceneError, match="no column y, z"):
        og3.read(path)
    with pytest.raises(SceneError, match="no such file"):
        og3.read(tmp_path / "missing.ply")


# Open3D itself


@pytest.mark.parametrize(
    ("says", "shown"), [("libusb-1.0.so.0: cannot open shared object file\nNo such file", "libusb"), ("", "OSError")]
)
def test_missing_system_libraries_are_one_sentence(says, shown, monkeypatch):
    def fail(name):
        raise OSError(says)

    monkeypatch.setattr(convert.importlib, "import_module", fail)
    with pytest.raises(
        OgPointcloudError, match=rf"does not load \({shown}.*apt-get install libusb-1.0-0 libgl1"
    ) as caught:
        convert.open3d()
    assert "\n" not in str(caught.value)


def test_open3d_that_is_not_installed_names_the_extra(scene, monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(og.MissingExtraError, match=r"og-pointcloud\[open3d\]"):
        og.segment(scene, WORDS).to_open3d()


def test_old_versions_are_refused_in_words(monkeypatch):
    monkeypatch.setattr(open3d, "__version__", "0.18.0")
    with pytest.raises(OgPointcloudError, match=r"Open3D is 0.18.0; this plugin needs 0.19 or later"):
        convert.open3d()
    monkeypatch.setattr(open3d, "__version__", "0.19.0")
    assert convert.open3d() is open3d
    monkeypatch.setattr(open3d, "__version__", "0.20.0+dev1")
    assert convert.open3d() is open3d


# Examples


def run_example(name, *arguments):
    command = [sys.executable, str(EXAMPLES / name), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, env=dict(os.environ), timeout=120)
    assert done.returncode == 0, done.stderr
    assert len((EXAMPLES / name).read_text().splitlines()) < 60
    return done.stdout


@pytest.mark.slow
def test_example_of_a_painted_cloud(scene, bundle, tmp_path):
    open3d.io.write_point_cloud(str(tmp_path / "cloud.ply"), legacy_cloud(scene))
    said = run_example(
        "04_open3d_cloud.py", bundle, tmp_path / "cloud.ply", "--labels=apple,pear", "-o", tmp_path / "p.ply"
    )
    assert "voxels of apple" in said
    labels = open3d.t.io.read_point_cloud(str(tmp_path / "p.ply")).point["og_label"].numpy()[:, 0]
    assert np.array_equal(labels, og.segment(og.read_points(tmp_path / "cloud.ply").xyz_world, WORDS[:2], scene).labels)


@pytest.mark.slow
def test_example_of_a_highlight(tmp_path):
    """The side of a blue wall that the word means is red in the picture, the other pale grey."""
    y, z = (axis.ravel() for axis in np.meshgrid(*[np.linspace(-1.5, 1.5, 40)] * 2))
    xyz, side = np.column_stack([np.zeros(len(y)), y, z]), (y < 0).astype(np.int32)
    splats = Points.from_world(
        xyz, rgb=np.full((len(y), 3), [40, 90, 160], np.uint8), scale=np.full((len(y), 3), 0.06, np.float32),
        rotation=np.tile(np.float32([1, 0, 0, 0]), (len(y), 1)), opacity=np.full(len(y), 0.95, np.float32),
    )  # fmt: skip
    write_ply(tmp_path / "splats.ply", {"vertex": gaussian_rows(splats)})
    bundle = write_bundle(make_cloud(xyz, side, 0.08, 0.2), tmp_path / "wall.ogpc")
    word = next(word for word in WORDS if og.select(bundle, word).instances == (0,))
    arguments = ("--eye=-4,0,0.1", "--target=0,0,0", "-o", tmp_path / "h.png")
    run_example("05_highlight_in_splats.py", bundle, tmp_path / "splats.ply", word, *arguments)
    image = np.asarray(open3d.io.read_image(str(tmp_path / "h.png"))).astype(int)
    assert image.shape == (480, 640, 3)
    left, right = image[200:280, 230:290], image[200:280, 350:410]  # seen from x < 0, y > 0 is on the left
    assert (left[..., 0] - left[..., 1] > 90).all()
    assert (np.ptp(right, axis=-1) <= 3).all()
    assert (right > 150).all()


@pytest.mark.slow
def test_example_of_las_and_gltf(scene, bundle, tmp_path):
    pytest.importorskip("trimesh")
    laspy = pytest.importorskip("laspy")
    og.segment(scene, WORDS).save(tmp_path / "in.laz")
    said = run_example("06_las_and_gltf.py", bundle, tmp_path / "in.laz", "--labels=apple,pear", "-o", tmp_path / "out")
    assert "apple: " in said
    assert "of labels agree" in said
    assert len(laspy.read(tmp_path / "out.laz")) == len(scene.xyz)
    assert (tmp_path / "out.glb").exists()
