"""LAS and LAZ headers: what they count is compared with the file, before room is made for it."""

from __future__ import annotations

import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from copc_files import attributes_of, write_copc

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.las import write_las
from og_pointcloud.formats.points import read_points


def labelled(path: Path) -> bytes:
    """Twelve labelled points as the library writes them."""
    xyz, rgb = np.random.default_rng(0).normal(size=(12, 3)), np.full((12, 3), 99, np.uint8)
    write_las(path, xyz, rgb, attributes_of([0] * 12), ("a",))
    return path.read_bytes()


def las_header(data, **numbers):
    """The file with other numbers in its header, by name: records, points, table_chunks, layer, chunk_points."""
    edit = bytearray(data)
    first = struct.unpack_from("<I", edit, 96)[0]
    laszip = edit.find(struct.pack("<16sH", b"laszip encoded", 22204)) + 52
    table = struct.unpack_from("<q", edit, first)[0] if laszip > 52 else 0
    places = {"records": (100, "<I"), "points": (247, "<Q"), "last_records": (243, "<I")}
    places["chunk_points"] = (laszip + 12, "<I")
    places |= {"table": (first, "<q"), "table_chunks": (table + 4, "<I"), "layer": (first + 8 + 49 + 4, "<I")}
    for name, number in numbers.items():
        struct.pack_into(places[name][1], edit, places[name][0], number)
    return bytes(edit)


@pytest.mark.parametrize(
    ("suffix", "numbers", "says"),
    [
        (".las", {"records": 2**32 - 1}, "4294967295 records before the points"),
        (".las", {"last_records": 2**32 - 1}, "of 4294967295 behind the points"),  # once read one by one
        (".las", {"points": 10**12}, "1000000000000 points of 49 bytes"),
        (".las", {"points": 13}, "13 points of 49 bytes"),
        (".laz", {"points": 13}, "cannot be read as LAS|expected 13 points"),
        (".laz", {"table": 10**12}, "a chunk table at byte 1000000000000"),
        (".laz", {"table_chunks": 2**32 - 1}, "a table of 4294967295 chunks"),
        (".laz", {"layer": 2**32 - 1}, "layers of chunk 0 beyond the chunk table"),
    ],
)
def test_las_headers_that_count_too_much(tmp_path, suffix, numbers, says):
    pytest.importorskip("lazrs")
    data = labelled(tmp_path / f"cloud{suffix}")
    path = tmp_path / f"cloud{suffix}"
    assert len(read_points(path)) == 12
    path.write_bytes(las_header(data, **numbers))
    with pytest.raises(SceneError, match=says):
        read_points(path)


def test_chunks_of_two_billion_points_make_no_room_for_them(tmp_path):
    pytest.importorskip("lazrs")
    data = labelled(tmp_path / "cloud.laz")
    (tmp_path / "cloud.laz").write_bytes(las_header(data, chunk_points=2**31 - 1))  # once ended the process
    assert len(read_points(tmp_path / "cloud.laz")) == 12


@pytest.mark.parametrize("version", ["1.2", "1.4"])
@pytest.mark.parametrize("point_format", [0, 3, 6, 7, 8])
@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_las_of_any_kind_counts_right(tmp_path, version, point_format, suffix):
    laspy = pytest.importorskip("laspy")
    pytest.importorskip("lazrs")
    if version == "1.2" and point_format > 3:
        pytest.skip("1.2 ends at point format 3")
    for points in (1, 50_001):  # of which a chunk holds 50,000
        header = laspy.LasHeader(point_format=point_format, version=version)
        header.scales = [0.001] * 3
        header.add_extra_dims([laspy.ExtraBytesParams("extra", "u2")])
        las = laspy.LasData(header)
        las.xyz = np.random.default_rng(0).random((points, 3))
        las.write(tmp_path / f"cloud{suffix}")
        assert len(read_points(tmp_path / f"cloud{suffix}")) == points


@pytest.mark.parametrize("size", [1e-9, 1e-4, 0.3, 1.0, 1e6])
@pytest.mark.parametrize("offset", [0.0, -5e6])
def test_places_are_kept_to_a_hundred_millionth_of_the_extent(tmp_path, size, offset):
    pytest.importorskip("laspy")
    xyz = offset + size * np.random.default_rng(0).random((50, 3))
    write_las(tmp_path / "a.las", xyz, np.zeros((50, 3), np.uint8), attributes_of([0] * 50), ("a",))
    extent = np.ptp(xyz, axis=0).max()
    rounding = 4 * np.spacing(abs(offset) + size)  # of float64, which such coordinates have anyway
    np.testing.assert_allclose(read_points(tmp_path / "a.las").xyz_world, xyz, rtol=0, atol=5e-8 * extent + rounding)


def test_copc_is_read_like_any_laz(tmp_path):
    """Its chunks are of any size, and its octree lies in records that others skip."""
    laspy = pytest.importorskip("laspy")
    rng = np.random.default_rng(0)
    xyz = rng.normal((4e5, 5e6, 100), 1.0, (900, 3))
    rgb = rng.integers(0, 256, (900, 3)).astype(np.uint8)
    write_copc(tmp_path / "a.copc.laz", xyz, rgb)
    with laspy.CopcReader.open(str(tmp_path / "a.copc.laz")) as reader:
        assert len(reader.query()) == 900
    points = read_points(tmp_path / "a.copc.laz")
    np.testing.assert_allclose(points.xyz_world, xyz, atol=1e-4)
    np.testing.assert_array_equal(points.rgb, rgb)
    labels = attributes_of([0] * 900)
    write_las(tmp_path / "labelled.laz", points.xyz_world, rgb, labels, ("bush",), tmp_path / "a.copc.laz")
    found = laspy.read(tmp_path / "labelled.laz")  # an octree of chunks that are elsewhere now would be read
    assert "copc" not in {record.user_id for record in (*found.vlrs, *(found.evlrs or ()))}
    whole = (tmp_path / "a.copc.laz").read_bytes()
    (tmp_path / "cut.copc.laz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(SceneError, match=r"cut\.copc\.laz: .* damaged or truncated"):
        read_points(tmp_path / "cut.copc.laz")


@pytest.mark.parametrize("point_format", [0, 1, 2, 3, 6, 8])
def test_a_survey_keeps_all_that_it_says(tmp_path, point_format):
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(point_format=point_format, version="1.4")
    header.scales, header.offsets = np.full(3, 0.001), np.array([5e5, 4e6, 100])
    header.add_extra_dims([laspy.ExtraBytesParams("height", np.float32)])
    header.vlrs.append(laspy.VLR("LASF_Projection", 2112, "", b'PROJCS["site"]\0'))
    header.evlrs = laspy.vlrs.vlrlist.VLRList([laspy.VLR("surveyor", 7, "", b"a" * 70_000)])
    survey, count = laspy.LasData(header), 12
    survey.xyz = np.random.default_rng(0).uniform(0, 9, (count, 3)) + header.offsets
    survey.intensity, survey["height"] = np.arange(count), np.arange(count) / 2
    survey.classification, survey.user_data = np.where(np.arange(count) < 9, 2, 30), np.arange(count)
    for field in {"gps_time", "red", "nir"} & set(survey.point_format.dimension_names):
        survey[field] = np.arange(count) * 300
    angle, step = ("scan_angle_rank", 1) if point_format < 6 else ("scan_angle", 0.006)  # degrees, as LAS 1.2 and 1.4
    survey[angle] = np.arange(count) * 15 - 90
    survey.write(tmp_path / "survey.laz")
    attributes = attributes_of(np.where(np.arange(count) < 5, 0, -1))
    points, gray, path = read_points(tmp_path / "survey.laz"), np.zeros((count, 3), np.uint8), tmp_path / "labelled.laz"
    write_las(path, points.xyz_world, gray, attributes, ("bush",), tmp_path / "survey.laz")
    found = laspy.read(path)
    for field in survey.point_format.dimension_names:
        if field in ("X", "Y", "Z", "intensity", "gps_time", "red", "green", "nir", "height", "user_data"):
            assert np.array_equal(found[field], survey[field]), field
    assert np.array_equal(found.scan_angle * 0.006, np.asarray(survey[angle]) * step)
    assert found.classification.tolist() == [64] * 5 + [2] * 4 + [30] * 3
    assert found.og_label.tolist() == attributes["og_label"].tolist()
    assert [record.user_id for record in found.vlrs].count("og_pointcloud") == 1
    assert found.vlrs.get_by_id("LASF_Projection")[0].record_data_bytes() == b'PROJCS["site"]\0'
    assert found.evlrs.get_by_id("surveyor")[0].record_data_bytes() == b"a" * 70_000
    rounded = points.xyz_world.astype(np.float32)  # by another library, to a quarter of a meter
    write_las(path, rounded, gray, attributes_of([-1] * count), ("tree",), path)  # no bush is a tree now
    again = laspy.read(path)
    assert again.classification.tolist() == [1] * 5 + [2] * 4 + [30] * 3
    assert [record.user_id for record in again.vlrs].count("og_pointcloud") == 1
    fewer = {name: values[1:] for name, values in attributes.items()}
    with pytest.raises(SceneError, match=r"survey\.laz: it has 12 points, 11 were labelled"):
        write_las(path, points.xyz_world[1:], gray[1:], fewer, ("bush",), tmp_path / "survey.laz")
    with pytest.raises(SceneError, match=r"survey\.laz: its points lie up to .* from those that were labelled"):
        write_las(path, points.xyz_world[::-1], gray, attributes, ("bush",), tmp_path / "survey.laz")
    with pytest.raises(SceneError, match=r"none\.laz: No such file"):  # not only the file to write
        write_las(path, points.xyz_world, gray, attributes, ("tree",), path.with_name("none.laz"))


def test_points_that_a_laz_only_claims_take_no_memory(tmp_path):
    """A million at once, of 1,460 bytes each, took 1.5 GB of a file of 19 kB."""
    laspy = pytest.importorskip("laspy")
    path, header = tmp_path / "wide.laz", laspy.LasHeader(point_format=0, version="1.2")
    header.add_extra_dims([laspy.ExtraBytesParams(f"wide{index}", "3f8") for index in range(60)])
    wide = laspy.LasData(header)
    wide.xyz = np.zeros((5, 3))
    wide.write(path, do_compress=True)
    data = bytearray(path.read_bytes())
    data[107:111] = struct.pack("<I", 50_000_000)  # LAS 1.2: the number of points
    path.write_bytes(data)
    tracemalloc.start()
    try:
        with pytest.raises(SceneError, match=r"wide.laz: cannot be read as LAS"):
            read_points(path)
        with pytest.raises(SceneError, match="50000000 points, 5 were labelled"):
            write_las(
                tmp_path / "out.laz", np.zeros((5, 3)), np.zeros((5, 3), np.uint8), attributes_of([0] * 5), (), path
            )
        assert tracemalloc.get_traced_memory()[1] < 1 << 28
    finally:
        tracemalloc.stop()
