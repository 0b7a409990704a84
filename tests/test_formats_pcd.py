"""PCD: the three encodings against each other and against Open3D's writer, and files that lie."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from labelled_clouds import make_cloud

import og_pointcloud as og
from og_pointcloud.errors import SceneError
from og_pointcloud.formats.pcd import read_pcd
from og_pointcloud.formats.points import read_points

DTYPE = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("_3", "<u1", (4,)), ("rgb", "<f4"), ("normal_x", "<f4"),
     ("normal_y", "<f4"), ("normal_z", "<f4"), ("ring", "<u2"), ("stamp", "<f8")]
)  # fmt: skip
HEADER = """# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS x y z _ rgb normal_x normal_y normal_z ring stamp
SIZE 4 4 4 1 4 4 4 4 2 8
TYPE F F F U F F F F U F
COUNT 1 1 1 4 1 1 1 1 1 1
WIDTH {points}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {points}
DATA {encoding}
"""


def sample(n: int) -> np.ndarray:
    """n points; colors with alpha 0, so that they survive as decimal floats too; every fifth without a normal."""
    random = np.random.default_rng(1)
    rows = np.zeros(n, DTYPE)
    for name in ("x", "y", "z", "normal_x", "normal_y", "normal_z", "stamp"):
        rows[name] = random.normal(size=n)
    rows["rgb"] = random.integers(0, 1 << 24, n, dtype=np.uint32).view(np.float32)
    rows["ring"] = np.arange(n) // 7
    for name in ("normal_x", "normal_y", "normal_z"):
        rows[name][::5] = np.nan
    return rows


def compress_lzf(data: bytes) -> bytes:
    """A plain greedy LZF encoder: literals, and the nearest earlier match of three bytes or more."""
    out, literals, at = bytearray(), bytearray(), 0
    last_seen: dict[bytes, int] = {}

    def flush() -> None:
        for start in range(0, len(literals), 32):
            run = literals[start : start + 32]
            out.extend([len(run) - 1, *run])
        literals.clear()

    while at < len(data):
        key = data[at : at + 3]
        start = last_seen.get(key, -1) if len(key) == 3 else -1
        last_seen[key] = at
        if start < 0 or at - start > 8192:
            literals.append(data[at])
            at += 1
            continue
        length = 3
        while length < 264 and at + length < len(data) and data[start + length] == data[at + length]:
            length += 1
        flush()
        distance, code = at - start - 1, length - 2
        out.append(min(code, 7) << 5 | distance >> 8)
        if code >= 7:
            out.append(code - 7)
        out.append(distance & 255)
        at += length
    flush()
    return bytes(out)


def columns(rows: np.ndarray) -> bytes:
    return b"".join(np.ascontiguousarray(rows[name]).tobytes() for name in rows.dtype.names)


def write(path: Path, encoding: str, body: bytes, points: int, header: str = HEADER) -> Path:
    path.write_bytes(header.format(points=points, encoding=encoding).encode() + body)
    return path


def compressed(packed: bytes, size: int) -> bytes:
    return struct.pack("<II", len(packed), size) + packed


def body_of(rows: np.ndarray, encoding: str) -> bytes:
    if encoding == "binary":
        return rows.tobytes()
    if encoding == "binary_compressed":
        return compressed(compress_lzf(columns(rows)), rows.nbytes)
    lines = [" ".join(str(value) for field in row.tolist() for value in np.ravel(field)) for row in rows]
    return ("\n".join(lines) + "\n").encode()


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_every_encoding_gives_the_same_rows(tmp_path, encoding):
    rows = sample(300)
    read = read_pcd(write(tmp_path / "a.pcd", encoding, body_of(rows, encoding), len(rows)))
    assert read.dtype == DTYPE
    for name in DTYPE.names:
        np.testing.assert_array_equal(read[name], rows[name])


@pytest.mark.parametrize("pattern", [b"", b"a", b"ab" * 4000, b"abc" * 3, bytes(1000), bytes(range(256)) * 40])
def test_decompression_undoes_a_literal_compressor(tmp_path, pattern):
    header = "VERSION .7\nFIELDS v\nSIZE 1\nTYPE U\nWIDTH {points}\nHEIGHT 1\nDATA {encoding}\n"
    body = compressed(compress_lzf(pattern), len(pattern))
    path = write(tmp_path / "a.pcd", "binary_compressed", body, len(pattern), header)
    assert read_pcd(path)["v"].tobytes() == pattern


@pytest.mark.parametrize(("name", "kind"), [("rgb", "F"), ("rgba", "F"), ("rgba", "U"), ("rgb", "I")])
def test_packed_colors_keep_their_bits_whatever_type_the_file_gives_them(tmp_path, name, kind):
    # 0xFFC08040 read as a float is NaN: only its bits count.
    header = f"FIELDS x y z {name}\nSIZE 8 8 8 4\nTYPE F F F {kind}\nWIDTH 1\nHEIGHT 1\nPOINTS 1\nDATA binary\n"
    path = tmp_path / "a.pcd"
    path.write_bytes(header.encode() + struct.pack("<dddI", 1e6, 2, 3, 0xFFC08040))
    points = read_points(path)
    assert points.rgb.tolist() == [[0xC0, 0x80, 0x40]]
    assert points.xyz_world.tolist() == [[1e6, 2, 3]]


def test_invalid_points_of_an_organized_cloud_are_left_out_of_fits_and_answered_unknown_in_their_rows(tmp_path):
    header = "VERSION 0.7\r\nFIELDS x y z\r\nSIZE 4 4 4\r\nTYPE F F F\r\nWIDTH 3\r\nHEIGHT 2\r\nDATA binary\r\n"
    xyz = np.arange(18, dtype="<f4").reshape(6, 3)
    path = tmp_path / "a.pcd"
    path.write_bytes(header.encode() + xyz.tobytes())
    np.testing.assert_array_equal(read_points(path).xyz_world, xyz)
    xyz[[2, 4]] = np.nan
    path.write_bytes(header.encode() + xyz.tobytes())
    says = r"a\.pcd: 2 of 6 points contain NaN or infinity \(the first is row 2\): "
    with pytest.warns(UserWarning, match=f"{says}left out"):
        np.testing.assert_array_equal(read_points(path).xyz_world, xyz[[0, 1, 3, 5]])
    scene = make_cloud(xyz[[0, 1, 3, 5]], [0, 0, 1, 1])
    with pytest.warns(UserWarning, match=f"{says}unknown"):
        answer = og.segment(path, ["apple"], scene)
    np.testing.assert_array_equal(answer.instances, og.segment(xyz, ["apple"], scene).instances)
    assert answer.instances.tolist() == [0, 0, -3, 1, -3, 1]
    path.write_bytes(header.encode() + np.full_like(xyz, np.nan).tobytes())
    with pytest.raises(SceneError, match="0 points, and 6 that contain NaN or infinity; expected at least one"):
        read_points(path)


@pytest.mark.parametrize("ascii_file", [True, False])
@pytest.mark.parametrize("pack", [True, False])
def test_files_written_by_open3d(tmp_path, ascii_file, pack):
    open3d = pytest.importorskip("open3d")
    random = np.random.default_rng(2)
    xyz, rgb = random.normal(size=(2000, 3)), random.integers(0, 256, (2000, 3))
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(xyz))
    cloud.colors = open3d.utility.Vector3dVector(rgb / 255)
    cloud.normals = open3d.utility.Vector3dVector(xyz / np.linalg.norm(xyz, axis=1, keepdims=True))
    path = tmp_path / "a.pcd"
    assert open3d.io.write_point_cloud(str(path), cloud, write_ascii=ascii_file, compressed=pack)
    points = read_points(path)
    np.testing.assert_allclose(points.xyz_world, xyz, atol=1e-5)
    np.testing.assert_array_equal(points.rgb, rgb)


SMALL = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 2\nHEIGHT 1\nPOINTS 2\nDATA binary\n"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("FIELDS x y z", "VALUES x y z", "not a PCD file"),
        ("DATA binary\n", "", "no line 'DATA'"),
        ("DATA binary", "DATA packed", "expected one of ascii, binary, binary_compressed"),
        ("FIELDS x y z", "FIELDS x y x", "none twice"),
        ("SIZE 4 4 4", "SIZE 4 4", "PCD SIZE is '4 4'; expected 3 whole numbers"),
        ("SIZE 4 4 4", "SIZE 4 4 3", "field 'z' has TYPE F SIZE 3 COUNT 1"),
        ("TYPE F F F", "TYPE F F", "PCD TYPE has 2 entries"),
        ("TYPE F F F", "TYPE F F X", "field 'z' has TYPE X"),
        ("COUNT 1 1 1", "COUNT 1 1 0", "COUNT 0"),
        ("COUNT 1 1 1", "COUNT 1 1 999999999", "a PCD point has more than"),
        ("COUNT 1 1 1", "COUNT 1 1 2", r"expected 2 rows of 16 bytes .32 bytes., .* \(24 bytes\): it is truncated"),
        ("WIDTH 2", "WIDTH -2", "PCD WIDTH is '-2'"),
        ("WIDTH 2\n", "", "PCD WIDTH is ''"),
        ("HEIGHT 1", "HEIGHT 2", "POINTS 2, but WIDTH 2 x HEIGHT 2"),
        ("HEIGHT 1", "HEIGHT 1\nHEIGHT 1", "two lines 'HEIGHT'"),
        ("WIDTH 2\nHEIGHT 1\nPOINTS 2", "WIDTH 99999999\nHEIGHT 99999999", r"\(1199999976000000\d+ bytes\)"),
    ],
)
def test_damaged_headers(tmp_path, old, new, message):
    assert old in SMALL
    path = tmp_path / "a.pcd"
    path.write_bytes(SMALL.replace(old, new).encode() + bytes(24))
    with pytest.raises(SceneError, match=message) as caught:
        read_pcd(path)
    assert str(caught.value).startswith(f"{path}: ")


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (b"\0\0\0", r"sizes of the compressed PCD data: expected 2 rows of 4 bytes .* 0 rows \(3 bytes\)"),
        (compressed(bytes(9), 24)[:-1], r"compressed PCD data: .* \(9 bytes\), the file has 8 rows"),
        (compressed(bytes(9), 25), "claims to unpack to 25 bytes; the header's 2 points need 24"),
        (compressed(b"", 24), "unpacks to 0 bytes"),
        (compressed(b"\x00A\x20\x05", 24), "points before its beginning"),
        (compressed(b"\x00A\xe0", 24), "ends within a copy"),
        (compressed(b"\x1fABC", 24), "unpacks to 3 bytes or more; expected 24"),
        (compressed(b"\x00A\xe0\xff\x00", 24), "unpacks to 265 bytes or more"),
    ],
)
def test_damaged_compressed_data(tmp_path, body, message):
    path = tmp_path / "a.pcd"
    path.write_bytes(SMALL.replace("binary", "binary_compressed").encode() + body)
    with pytest.raises(SceneError, match=message):
        read_pcd(path)
