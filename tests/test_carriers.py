"""The same points through every library that carries them, and labels out to files: the same answers, bit for bit."""

from __future__ import annotations

import itertools
import json
import struct
from dataclasses import replace

import numpy as np
import pytest
from labelled_clouds import make_cloud, room
from og_pointcloud_export import write_bundle
from test_formats_spz import splats

import og_pointcloud as og
from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.formats.ply import read_ply

WORDS = ["apple", "pear", "plum"]
COMPONENTS = {5123: "<u2", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


@pytest.fixture(scope="module")
def asked(scene):
    """A scene, points that carriers of float32 and of whole tenths of millimeters hold exactly, and their labels."""
    random = np.random.default_rng(1)
    points = scene.xyz + random.normal(size=scene.xyz.shape) * 0.3 * scene.cloud.spacing
    points = (np.round(points * 8192) / 8192).astype(np.float32).astype(np.float64)
    expected = og.segment(points, WORDS, scene)
    assert len(set(expected.labels.tolist())) > 2
    return scene, points, expected


def through_torch(points, _):
    return pytest.importorskip("torch").from_numpy(points.copy()).requires_grad_()


def through_torch_float32(points, _):
    torch = pytest.importorskip("torch")
    return torch.nn.Parameter(torch.from_numpy(points.astype(np.float32)))


def through_cuda(points, _):
    torch = pytest.importorskip("torch")
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    return torch.from_numpy(points.copy()).cuda()


def through_open3d_legacy(points, _):
    open3d = pytest.importorskip("open3d")
    return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))


def through_open3d_tensor(points, _):
    open3d = pytest.importorskip("open3d")
    return open3d.t.geometry.PointCloud(open3d.core.Tensor(points.astype(np.float32)))


def through_pyvista(points, _):
    return pytest.importorskip("pyvista").PolyData(points)


def through_pyvista_array(points, _):
    return pytest.importorskip("pyvista").PolyData(points).points


def through_trimesh_array(points, _):
    return pytest.importorskip("trimesh").PointCloud(points).vertices


def through_trimesh(points, _):
    return pytest.importorskip("trimesh").PointCloud(points)


def through_trimesh_mesh(points, _):
    return pytest.importorskip("trimesh").Trimesh(points, [[0, 1, 2]], process=False)


def through_las_data(points, _):
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales, header.offsets = np.full(3, 2.0**-13), np.zeros(3)
    las = laspy.LasData(header)
    las.xyz = points
    return las


def through_las_file(points, folder):
    path = folder / "points.las"
    through_las_data(points, folder).write(path)
    return path


def through_laz_file(points, folder):
    path = folder / "points.laz"
    through_las_data(points, folder).write(str(path))
    return str(path)


def through_pointcloud2(points, _):
    ros = pytest.importorskip("og_pointcloud_ros", exc_type=ImportError)
    empty = og.Segmentation(
        points, *(np.full(len(points), -1, kind) for kind in (np.int32, np.float32, np.int32)), names=("nothing",),
        reasons=np.zeros(len(points), np.int8),
    )  # fmt: skip
    return ros.to_pointcloud2(empty)


CARRIERS = [value for name, value in list(globals().items()) if name.startswith("through_")]


@pytest.mark.parametrize("carrier", CARRIERS, ids=lambda carrier: carrier.__name__.removeprefix("through_"))
def test_every_carrier_gives_the_same_labels(asked, carrier, tmp_path):
    scene, points, expected = asked
    got = og.segment(carrier(points, tmp_path), WORDS, scene)
    for name, values in expected.attributes.items():
        assert np.array_equal(got.attributes[name], values), name
    assert np.array_equal(got.xyz, points)


def test_rows_with_nan_stay_rows(asked, tmp_path):
    scene, points, expected = asked
    broken = points[:50].copy()
    broken[[3, 7]] = np.nan
    for carrier in (through_torch, through_open3d_legacy, through_open3d_tensor, through_pyvista, through_pointcloud2):
        got = og.segment(carrier(broken, tmp_path), WORDS, scene)
        kept = ~np.isnan(broken[:, 0])
        assert np.array_equal(got.labels[kept], expected.labels[:50][kept])
        assert (got.labels[~kept] == -1).all()


def test_integer_and_half_precision_tensors(asked):
    torch = pytest.importorskip("torch")
    scene = asked[0]
    whole = np.round(asked[1][:30]).astype(int)
    expected = og.segment(whole, WORDS, scene).labels
    for tensor in (torch.from_numpy(whole), torch.from_numpy(whole).half(), torch.from_numpy(whole).bfloat16()):
        assert np.array_equal(og.segment(tensor, WORDS, scene).labels, expected)
    with pytest.raises(SceneError, match=r"Tensor of float32 \(3,\)"):
        og.segment(torch.zeros(3), WORDS, scene)
    for what in (torch.device("cpu"), torch.eye(3).to_sparse()):
        with pytest.raises(SceneError, match="no points"):
            og.segment(what, WORDS, scene)
    with pytest.raises(OgPointcloudError, match=r"the position is .*; expected three finite world coordinates"):
        og.pick(scene, torch.ones(3).to_sparse())


# LAS out


def test_words_may_come_as_tensors_as_a_model_gives_them(asked):
    """With a gradient, which numpy takes from none, and of half precision."""
    torch = pytest.importorskip("torch")
    scene = asked[0]
    vectors = torch.eye(2, scene.cloud.space.width).requires_grad_()
    words = dict(zip(("a", "b"), vectors, strict=True))
    plain = {name: vector.detach().numpy() for name, vector in words.items()}
    expected = og.segment(scene, plain).labels.tolist()
    assert og.segment(scene, words).labels.tolist() == expected
    assert og.segment(scene, {name: vector.bfloat16() for name, vector in words.items()}).labels.tolist() == expected


def test_las_keeps_labels_and_a_millimeter_at_a_million(tmp_path):
    laspy = pytest.importorskip("laspy")
    cloud = make_cloud(room(800).xyz * 300, room(800).instance_ids, 15.0, 45.0, origin=(1e6, -4e6, 350.25))
    result = og.segment(og.load(write_bundle(cloud, tmp_path / "map.ogpc")), WORDS)
    for ending in (".las", ".laz"):
        las = laspy.read(result.save(tmp_path / f"out{ending}"))
        assert np.abs(las.xyz - result.xyz).max() < 1e-3
        for name, values in result.attributes.items():
            assert las[name].dtype == values.dtype
            assert np.array_equal(las[name], values)
        assert np.array_equal(las.classification, np.where(result.labels < 0, 1, 64 + result.labels))
        assert np.array_equal(las.user_data, result.reasons)
        assert np.array_equal(np.column_stack([las.red, las.green, las.blue]) // 257, result.colors)
        assert json.loads(las.header.vlrs.get_by_id("og_pointcloud")[0].record_data_bytes()) == WORDS
    assert (tmp_path / "out.laz").stat().st_size < 0.7 * (tmp_path / "out.las").stat().st_size
    points = og.read_points(tmp_path / "out.laz")
    assert np.abs(points.xyz_world - result.xyz).max() < 1e-3
    assert np.array_equal(points.rgb, result.colors)


def segmentation(labels, names, xyz=None):
    labels = np.asarray(labels, np.int32)
    count = len(labels)
    xyz = np.arange(3.0 * count).reshape(count, 3) if xyz is None else xyz
    scores = np.linspace(0, 1, count, dtype=np.float32)
    zeros = np.zeros(count, np.int8)
    return og.Segmentation(xyz, labels, scores, labels * 2 - 1, zeros, tuple(names))


def test_las_with_more_labels_than_classes(tmp_path):
    laspy = pytest.importorskip("laspy")
    names = [f"a word that is number {index}" for index in range(200)]
    las = laspy.read(segmentation([0, 191, 192, 199, -1], names).save(tmp_path / "many.las"))
    assert las.classification.tolist() == [64, 255, 1, 1, 1]
    assert las.og_label.tolist() == [0, 191, 192, 199, -1]
    with pytest.raises(SceneError, match=r"5000 names take \d+ bytes; LAS stores 65535"):
        segmentation([0], names * 25).save(tmp_path / "more.las")


def test_las_of_no_point_and_of_one(tmp_path):
    laspy = pytest.importorskip("laspy")
    assert len(laspy.read(segmentation([], ["a"]).save(tmp_path / "none.las"))) == 0
    assert laspy.read(segmentation([0], ["a"]).save(tmp_path / "one.laz")).xyz.tolist() == [[0, 1, 2]]
    with pytest.raises(SceneError, match=r"none.las: expected 0 points, the file has 0: it is empty"):
        og.read_points(tmp_path / "none.las")


@pytest.mark.parametrize("ending", [".las", ".glb"])
def test_formats_of_finite_points_refuse_others_and_leave_nothing(tmp_path, ending):
    pytest.importorskip("laspy")
    xyz = np.array([[0, 0, 0], [np.nan, 0, 0], [1, np.inf, 0]])
    with pytest.raises(SceneError, match=r"2 of 3 points contain NaN .* \(the first is row 1\).* save as .ply"):
        segmentation([0, 0, 0], ["a"], xyz).save(tmp_path / f"out{ending}")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_glb_refuses_places_beyond_float32_and_leaves_nothing(tmp_path):
    """As JSON their bounds would be Infinity, which no reader takes."""
    xyz = np.array([[0, 0, 0], [1e300, 0, 0], [1, 0, 0]])
    with pytest.raises(SceneError, match=r"1 of 3 points contain NaN .* \(the first is row 1\).* ends at 3.4e38"):
        segmentation([0, 0, 0], ["a"], xyz).save(tmp_path / "out.glb")
    assert list(tmp_path.iterdir()) == []


# glTF out


def property_tables(document, binary):
    """Strings of each property table (EXT_structural_metadata), the slow plain way."""
    views = [binary[view["byteOffset"] :][: view["byteLength"]] for view in document["bufferViews"]]
    tables = {}
    metadata = document.get("extensions", {}).get("EXT_structural_metadata", {"propertyTables": []})
    for table in metadata["propertyTables"]:
        assert metadata["schema"]["classes"][table["class"]]["properties"] == {"name": {"type": "STRING"}}
        place = table["properties"]["name"]
        assert all(document["bufferViews"][view]["byteOffset"] % 8 == 0 for view in place.values())
        ends = struct.unpack(f"<{table['count'] + 1}I", views[place["stringOffsets"]])
        text = views[place["values"]]
        tables[table["name"]] = [text[a:b].decode() for a, b in itertools.pairwise(ends)]
        assert ends[-1] == len(text)
    return tables


def parsed(path):
    """A .glb the slow plain way: its document, and its attributes as arrays."""
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert (kind, size % 4) == (b"JSON", 0)
    document = json.loads(data[20 : 20 + size])
    binary_size, kind = struct.unpack_from("<I4s", data, 20 + size)
    assert kind == b"BIN\0"
    assert binary_size == document["buffers"][0]["byteLength"] == length - 28 - size
    binary = data[28 + size :]
    arrays = {}
    for name, index in document["meshes"][0]["primitives"][0]["attributes"].items():
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        assert view["byteOffset"] % 4 == 0
        part = np.frombuffer(binary[view["byteOffset"] :][: view["byteLength"]], COMPONENTS[accessor["componentType"]])
        arrays[name] = part.reshape(accessor["count"], WIDTHS[accessor["type"]])
        if "min" in accessor:
            assert arrays[name].min(axis=0).tolist() == accessor["min"]
            assert arrays[name].max(axis=0).tolist() == accessor["max"]
    ends = [view["byteOffset"] + view["byteLength"] for view in document["bufferViews"]]
    starts = [view["byteOffset"] for view in document["bufferViews"]]
    assert all(0 <= start - end < 8 for start, end in zip(starts, [0, *ends], strict=False)), (
        "no gaps but for alignment"
    )
    assert 0 <= binary_size - ends[-1] < 4
    document["names"] = property_tables(document, binary)
    return document, arrays


def test_glb_holds_points_colors_and_feature_ids(tmp_path):
    xyz = np.random.default_rng(0).normal((1e6, -4e6, 300), 1, (40, 3))
    result = segmentation(np.arange(40) % 4 - 1, ["a", "b", "c"], xyz)
    document, arrays = parsed(result.save(tmp_path / "out.glb"))
    origin = np.array(document["nodes"][0]["translation"])
    assert np.abs(arrays["POSITION"] + origin - xyz).max() < 1e-6
    first, second = document["meshes"][0]["primitives"][0]["extensions"]["EXT_mesh_features"]["featureIds"]
    assert first == {"attribute": 0, "featureCount": 3, "nullFeatureId": 3, "label": "og_label", "propertyTable": 0}
    assert second == {"attribute": 1, "featureCount": 2, "nullFeatureId": 4, "label": "og_instance", "propertyTable": 1}
    labels = arrays["_FEATURE_ID_0"][:, 0]
    assert np.array_equal(np.where(labels == 3, -1, labels), result.labels)
    instances = arrays["_FEATURE_ID_1"][:, 0]
    assert np.array_equal(np.where(instances == 4, -1, instances), np.maximum(result.instances, -1))
    assert np.array_equal(arrays["_OG_SCORE"][:, 0], result.scores)
    linear = arrays["COLOR_0"]
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    assert np.array_equal(np.rint(255 * srgb), result.colors)
    assert document["meshes"][0]["extras"]["og_names"] == ["a", "b", "c"]
    assert document["extensionsUsed"] == ["EXT_mesh_features", "EXT_structural_metadata"]


def test_glb_names_labels_and_instances(tmp_path):
    names = ["a chair", "", "Küche", "unused"]
    result = replace(segmentation(np.arange(40) % 4 - 1, names), instances=np.arange(40, dtype=np.int32) % 8 - 1)
    document, arrays = parsed(result.save(tmp_path / "out.glb"))
    assert document["names"]["og_label"] == names
    for row, label in zip(arrays["_FEATURE_ID_1"][:, 0], result.labels, strict=True):
        if row < 7:
            assert document["names"]["og_instance"][int(row)] == (names[label] if label >= 0 else "")
    nothing, _ = parsed(segmentation([-1, -1], []).save(tmp_path / "none.glb"))
    assert nothing["names"] == {}
    assert nothing["extensionsUsed"] == ["EXT_mesh_features"]


FLOAT = 5126
SPLAT_ATTRIBUTES = {"ROTATION": "VEC4", "SCALE": "VEC3", "OPACITY": "SCALAR", "SH_DEGREE_0_COEF_0": "VEC3"}
"""What KHR_gaussian_splatting demands: no degree of harmonics but the first, which would have to be whole."""


@pytest.mark.parametrize("count", [1, 40])
def test_glb_of_splats_is_what_the_extensions_text_demands(tmp_path, count):
    points = splats(count, center=(3, -4, 5))
    result = segmentation(np.arange(count) % 4 - 1, ["a", "b", "c"], points.xyz_world)
    document, arrays = parsed(result.save(tmp_path / "out.glb", points))
    assert document["extensionsUsed"] == ["EXT_mesh_features", "KHR_gaussian_splatting", "EXT_structural_metadata"]
    assert "extensionsRequired" not in document, "COLOR_0 shows points where splats are not known"
    primitive = document["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 0
    stated = primitive["extensions"]["KHR_gaussian_splatting"]
    assert stated == {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    prefix = "KHR_gaussian_splatting:"
    stored = {
        name.removeprefix(prefix): tuple(
            document["accessors"][place][key] for key in ("type", "componentType", "count")
        )
        for name, place in primitive["attributes"].items()
        if name.startswith(prefix)
    }
    assert stored == {name: (kind, FLOAT, count) for name, kind in SPLAT_ATTRIBUTES.items()}
    assert np.array_equal(np.roll(arrays[prefix + "ROTATION"], 1, axis=1), points.rotation)
    assert np.array_equal(arrays[prefix + "SCALE"], points.scale)
    assert np.array_equal(arrays[prefix + "OPACITY"][:, 0], points.opacity)
    color = 0.5 + arrays[prefix + "SH_DEGREE_0_COEF_0"] / (2 * np.sqrt(np.pi))
    assert np.array_equal(np.rint(255 * color), result.colors)
    assert np.array_equal(arrays["COLOR_0"][:, 3], points.opacity), "what is behind shows through fallbacks too"
    assert document["names"]["og_label"] == ["a", "b", "c"]
    labels = arrays["_FEATURE_ID_0"][:, 0]
    assert np.array_equal(np.where(labels == 3, -1, labels), result.labels)
    with pytest.raises(SceneError, match=f"{count} Gaussians for {count + 1} labels"):
        segmentation([0] * (count + 1), ["a"]).save(tmp_path / "out.glb", points)


def test_spz_holds_splats_in_the_colors_of_their_labels(tmp_path):
    points = splats(40)
    result = segmentation(np.arange(40) % 3, ["a", "b", "c"], points.xyz_world)
    found = og.read_points(result.save(tmp_path / "out.spz", points))
    assert np.abs(found.rgb.astype(int) - result.colors).max() <= 2
    for other in (None, splats(39)):
        with pytest.raises(og.OgPointcloudError, match=r"out.spz stores only splats; expected .*--points"):
            result.save(tmp_path / "out.spz", other)


def test_trimesh_opens_it(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    xyz = np.random.default_rng(0).normal((1e6, -4e6, 300), 1, (40, 3))
    result = segmentation(np.arange(40) % 4 - 1, "abc", xyz)
    cloud = trimesh.load(result.save(tmp_path / "out.glb")).to_geometry()
    assert np.abs(cloud.vertices - xyz).max() < 1e-6
    linear = ((result.colors / 255 + 0.055) / 1.055) ** 2.4  # for colors that are not nearly black
    assert np.abs(cloud.colors[:, :3] - 255 * linear).max() <= 1


def test_gltf_has_no_empty_clouds(tmp_path):
    with pytest.raises(SceneError, match=r"out.glb: 0 points; expected at least one"):
        segmentation([], ["a"]).save(tmp_path / "out.glb")


def test_ply_keeps_labels(tmp_path):
    result = segmentation(np.arange(9) % 3 - 1, ["a", "b"])
    rows = read_ply(result.save(tmp_path / "out.ply"))["vertex"]
    for name, values in result.attributes.items():
        assert np.array_equal(rows[name], values)
