"""Plain clouds from any file, told apart by content, and the labelled cloud."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.ply import join_columns, read_ply, write_ply
from og_pointcloud.formats.points import read_places, read_points, write_labelled_ply

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
XYZ = np.random.default_rng(6).normal(size=(30, 3))
RGB = np.random.default_rng(7).integers(0, 256, (30, 3)).astype("u1")


def write_cloud(path: Path, xyz: np.ndarray = XYZ, **columns: np.ndarray) -> Path:
    write_ply(path, {"vertex": join_columns(dict(zip("xyz", xyz.T, strict=True)) | columns)})
    return path


def named(names: tuple[str, str, str], values: np.ndarray) -> dict[str, np.ndarray]:
    return dict(zip(names, values.T, strict=True))


def test_a_cloud_without_colors_or_normals(tmp_path):
    points = read_points(write_cloud(tmp_path / "a.ply"))
    np.testing.assert_allclose(points.xyz_world, XYZ, atol=1e-6)
    assert (points.rgb, points.are_gaussians) == (None, False)


def test_map_coordinates_keep_their_millimeters(tmp_path):
    offset = np.array([4.5e6, -5.2e6, 300.0])
    points = read_points(write_cloud(tmp_path / "a.ply", XYZ + offset))
    np.testing.assert_allclose(points.xyz_world, XYZ + offset, rtol=0, atol=1e-6)
    np.testing.assert_allclose(points.origin, np.median(XYZ + offset, axis=0))


@pytest.mark.parametrize(
    "names", [("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue")]
)
@pytest.mark.parametrize(
    "values",
    [RGB, RGB.astype("u2") * 257, RGB.astype("u2"), RGB.astype("f4") / 255, RGB.astype("f8"), RGB.astype("i4")],
    ids=["uchar", "ushort", "ushort of 8 bits", "unit float", "float", "int"],
)
def test_colors_of_every_name_and_type(tmp_path, names, values):
    np.testing.assert_array_equal(read_points(write_cloud(tmp_path / "a.ply", **named(names, values))).rgb, RGB)


@pytest.mark.parametrize("above", [np.nextafter(np.float32(1), np.float32(2)), 1.02, 2.0])
def test_float_colors_a_little_above_one_are_full(tmp_path, above):
    values = RGB.astype("f4") / 255
    values[3, 1] = above
    expected = RGB.copy()
    expected[3, 1] = 255
    rgb = read_points(write_cloud(tmp_path / "a.ply", **named(("red", "green", "blue"), values))).rgb
    np.testing.assert_array_equal(rgb, expected)


@pytest.mark.parametrize("bad", [-1.0, 256.0, np.nan])
def test_colors_out_of_range_are_refused(tmp_path, bad):
    values = RGB.astype("f4")
    values[3, 1] = bad
    with pytest.raises(SceneError, match=r"a\.ply: colors red, green, blue span .*; expected 0\.\.1 or 0\.\.255"):
        read_points(write_cloud(tmp_path / "a.ply", **named(("red", "green", "blue"), values)))


def test_the_content_decides_not_the_name(tmp_path):
    np.testing.assert_allclose(read_points(write_cloud(tmp_path / "cloud.pcd")).xyz_world, XYZ, atol=1e-6)
    text = (
        "# .PCD v.7\nVERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 1\nHEIGHT 1\nPOINTS 1\nDATA ascii\n1 2 3\n"
    )
    (tmp_path / "cloud.ply").write_text(text)
    assert read_points(tmp_path / "cloud.ply").xyz_world.tolist() == [[1, 2, 3]]


@pytest.mark.parametrize(
    ("content", "start"),
    [
        (b"", "it is empty"),
        (b"glTF\x00\x00", "it starts with b'glTF"),
        (b"version https://git-lfs.github.com/spec/v1\n", "it starts with b'version https"),
        (b"plywood", "it starts with b'plywood'"),
    ],
)
def test_other_files_are_refused_with_a_list_of_what_is_readable(tmp_path, content, start):
    path = tmp_path / "a.ply"
    path.write_bytes(content)
    with pytest.raises(
        SceneError, match=f"not a geometry file .*{start}.* expected a PLY .* PCD .* E57, SPZ, SOG or .splat"
    ) as caught:
        read_points(path)
    assert str(caught.value).startswith(f"{path}: ")


TEXTS = {
    "plain": "1 2 3\n4 5 6\n", "one row, no line end": "1 2 3", "Windows": "\ufeff1\t2\t3\r\n4\t5\t6\r\n",
    "named": '"id";"X";"Y";"Z";"Red";"Green";"Blue";"class"\n7;1;2;3;255;0;9;chair\n8;4;5;6;1;2;3;desk, x\n',
    "named as a comment": "// 2 rooms\n//X Y Z Intensity R G B\n2\n\n1 2 3 99 255 0 9\n4 5 6 7 1 2 3\n",
    "COLMAP's": "# POINT3D_ID, X, Y, Z, R, G, B, ERROR\n7 1 2 3 255 0 9 0.1\n8 4 5 6 1 2 3 0.1\n",
    "Leica's": "2\n1 2 3 -1200 255 0 9\n4 5 6 17 1 2 3\n", "with labels": "1,2,3,255,0,9,5\n4,5,6,1,2,3,6\n",
    "with normals": "1 2 3 255 0 9 0 0 1\n4 5 6 1 2 3 0 -1 0\n", "shares": "1 2 3 1 0 0.035\n4 5 6 .0039 .0078 .0118\n",
    "normals only": "1 2 3 0 0 1 # a\n4 5 6 0 -1 0\n", "a remark": "# x y z in meters\n1 2 3\n4 5 6\n",
    "intensities": "1 2 3 0.5 7 8\n4 5 6 300 1 1\n",
}  # fmt: skip
WITHOUT_COLORS = ("plain", "one row, no line end", "Windows", "normals only", "a remark", "intensities")


@pytest.mark.parametrize("name", TEXTS)
def test_clouds_in_text_as_programs_write_them(tmp_path, name):
    (tmp_path / "a.csv").write_bytes(TEXTS[name].encode())
    points = read_points(tmp_path / "a.csv")
    assert points.xyz_world.tolist() == [[1, 2, 3], [4, 5, 6]][: len(points)]
    expected = None if name in WITHOUT_COLORS else [[255, 0, 9], [1, 2, 3]]
    assert (None if points.rgb is None else points.rgb.tolist()) == expected


def test_rows_of_text_keep_their_places_and_digits(tmp_path):
    (tmp_path / "a.xyz").write_text("431234.567 5412345.678 312\nnan nan nan\n1e400 0 0\n431235.567 5412345.678 312\n")
    with pytest.warns(UserWarning, match=r"2 of 4 points contain NaN or infinity \(the first is row 1\): unknown"):
        places = read_places(tmp_path / "a.xyz")
    assert places[[0, 3]].tolist() == [[431234.567, 5412345.678, 312], [431235.567, 5412345.678, 312]]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("1 2 3\n4 5\n", "at row 2 with 2 columns.*expected 3 or more columns"),
        ("1,2,3\n4,x,6\n", "string 'x' to float64 at row 1.*expected 3 or more columns"),
        ("x,y,z\n1.5,2.5,\n", "not a geometry file"),
        ("x;y;z\n1,5;2;3\n", "not a geometry file .*numbers x y z in each line .1.5, not 1,5."),
        ("3\n1 2 3\n4 5 6\n", "its first line says 3 points, 2 follow"),
        ("2\n3\n0 0 0\n1 0 0\n", "not a geometry file"),  # .ptx: a pose comes first
        ("# of x, y, z, 2 points\n1 2 3\n4 5 6\n", "names 6 columns, the first row has 3; expected one name a column"),
        ("x,y,z,red,green,blue\n1,2,3,300,0,0\n", "colors red, green, blue span 0..300"),
    ],
)
def test_text_that_is_no_cloud_is_refused(tmp_path, text, says):
    (tmp_path / "a.txt").write_text(text)
    with pytest.raises(SceneError, match=says) as caught:
        read_points(tmp_path / "a.txt")
    assert str(caught.value).startswith(f"{tmp_path / 'a.txt'}: ")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="named pipes are POSIX's")
def test_a_pipe_is_refused_before_it_is_read(tmp_path):
    os.mkfifo(tmp_path / "pipe.ply")
    with pytest.raises(SceneError, match=r"pipe.ply: it is a pipe or a device; expected a file"):
        read_points(tmp_path / "pipe.ply")


def test_no_points_and_missing_columns_name_the_file_once(tmp_path):
    path = write_cloud(tmp_path / "a.ply", XYZ[:0])
    with pytest.raises(SceneError, match="0 points") as caught:
        read_points(path)
    assert str(caught.value).count(str(path)) == 1
    write_cloud(path)
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(SceneError, match="it is truncated") as caught:
        read_points(path)
    assert str(caught.value).count(str(path)) == 1
    write_ply(path, {"vertex": join_columns({"x": XYZ[:, 0], "y": XYZ[:, 1]})})
    with pytest.raises(SceneError, match="no column z; expected x, y, z, the file has x, y"):
        read_points(path)
    write_ply(path, {"point": join_columns({"x": XYZ[:, 0]})})
    with pytest.raises(SceneError, match=r"no element 'vertex' before .*; the file has point"):
        read_points(path)


def test_points_with_nan_are_left_out_with_their_colors_and_one_warning(tmp_path):
    rgb = np.arange(90, dtype=np.uint8).reshape(30, 3)
    xyz = XYZ.astype("f4")
    xyz.view("u4")[5, 2] = 0x7F800001
    xyz[9, 1] = np.inf
    path = tmp_path / "a.ply"
    columns = dict(zip(("x", "y", "z", "red", "green", "blue"), (*xyz.T, *rgb.T), strict=True))
    write_ply(path, {"vertex": join_columns(columns)})
    says = r"2 of 30 points contain NaN or infinity \(the first is row 5\): left out"
    with pytest.warns(UserWarning, match=says) as caught:
        points = read_points(path)
    assert len(caught) == 1  # a signalling NaN is no other one
    np.testing.assert_array_equal(points.rgb, np.delete(rgb, [5, 9], axis=0))


def labels_of(count):
    return {
        "og_label": (np.arange(count) % 4 - 1).astype(np.int32),
        "og_instance": np.arange(-2, count - 2, dtype=np.int32),
        "og_score": np.linspace(0, 1, count, dtype=np.float32),
        "og_reason": (np.arange(count) % 6).astype(np.uint8),
    }


@pytest.mark.parametrize(("offset", "stored"), [(0.0, "f4"), (1e6, "f8")])
def test_labelled_cloud_reads_back(tmp_path, offset, stored):
    path = tmp_path / "labelled.ply"
    attributes = labels_of(30)
    write_labelled_ply(path, XYZ + offset, RGB, attributes, ["a cup", "line\nbreak"])
    rows = read_ply(path)["vertex"]
    expected = [(name, stored) for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
    labels = [("og_label", "i4"), ("og_instance", "i4"), ("og_score", "f4"), ("og_reason", "u1")]
    assert rows.dtype == np.dtype([*expected, *labels])
    for name, values in attributes.items():
        np.testing.assert_array_equal(rows[name], values)
    assert rb'comment og_names ["a cup", "line\nbreak"]' in path.read_bytes()[:1000]
    points = read_points(path)
    np.testing.assert_allclose(points.xyz_world, XYZ + offset, rtol=0, atol=1e-6 * np.ptp(XYZ, axis=0).max())
    np.testing.assert_array_equal(points.rgb, RGB)


def test_a_row_with_nan_makes_no_doubles_of_the_others(tmp_path):
    xyz = XYZ.copy()
    xyz[3] = np.nan
    write_labelled_ply(tmp_path / "a.ply", xyz, RGB, labels_of(30))
    rows = read_ply(tmp_path / "a.ply")["vertex"]
    assert rows.dtype["x"] == np.float32
    np.testing.assert_array_equal(np.isnan(rows["x"]), np.arange(30) == 3)


def test_a_stray_at_the_origin_of_the_map_costs_the_others_no_millimeters(tmp_path):
    """Scanners write 0 0 0 for what they did not measure: 5000 km from the place, by which float32 seemed precise."""
    xyz = np.vstack([XYZ + np.array([431234.567, 5412345.678, 312]), np.zeros((1, 3))])
    write_labelled_ply(tmp_path / "a.ply", xyz, RGB[[*range(30), 0]], labels_of(31))
    rows = read_ply(tmp_path / "a.ply")["vertex"]
    np.testing.assert_array_equal(np.column_stack([rows[axis] for axis in "xyz"]), xyz)


def test_positions_beyond_float32_are_stored_as_double(tmp_path):
    xyz = np.array([[0, 0, 0], [1e300, 1, 2]])
    write_labelled_ply(tmp_path / "a.ply", xyz, RGB[:2], labels_of(2))
    rows = read_ply(tmp_path / "a.ply")["vertex"]
    assert rows["x"].tolist() == [0, 1e300]


def test_a_labelled_cloud_may_be_empty_but_not_uneven(tmp_path):
    write_labelled_ply(tmp_path / "a.ply", np.zeros((0, 3)), RGB[:0], labels_of(0))
    assert len(read_ply(tmp_path / "a.ply")["vertex"]) == 0
    with pytest.raises(SceneError, match="one-dimensional arrays of one length"):
        write_labelled_ply(tmp_path / "b.ply", XYZ, RGB, labels_of(30) | {"og_label": np.zeros(29, np.int32)})
    assert not (tmp_path / "b.ply").exists()


@pytest.mark.skipif(not DATA.is_dir(), reason="shared data: capture folders")
@pytest.mark.parametrize(
    ("capture", "count"),
    [("seven_redkitchen", 174687), ("apc_shelf_B", 49093), ("ycb_0050", 103091), ("nuscenes_frame", 34688)],
)
def test_real_clouds_agree_with_open3d(capture, count):
    open3d = pytest.importorskip("open3d")
    path = DATA / capture / "points.ply"
    points = read_points(path)
    assert len(points) == count
    cloud = open3d.io.read_point_cloud(str(path))
    np.testing.assert_allclose(points.xyz_world, np.asarray(cloud.points), rtol=1e-6, atol=1e-5)
    np.testing.assert_array_equal(points.rgb, np.rint(np.asarray(cloud.colors) * 255))


def test_names_that_no_header_holds_are_left_out(tmp_path):
    names = [f"word number {index}" for index in range(20_000)]
    write_labelled_ply(tmp_path / "a.ply", XYZ, RGB, labels_of(30), names)
    assert b"og_names" not in (tmp_path / "a.ply").read_bytes()
    assert len(read_points(tmp_path / "a.ply")) == 30
