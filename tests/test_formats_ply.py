"""PLY: every encoding against bytes written by hand, and headers that lie."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.ply import HEADER_LIMIT, NUMPY_TYPES, join_columns, read_ply, write_ply
from og_pointcloud.formats.points import read_points

ROWS = [(1.5, -2, 250), (0.25, 70000, 0), (-1e-3, 3, 7)]
FIELDS = [("x", "f4"), ("n", "i4"), ("red", "u1")]
HEADER = (
    "ply\nformat {encoding} 1.0\ncomment by hand, Å\x0bone line\nobj_info x\nelement vertex 3\n"
    "property float x\nproperty int n\nproperty uchar red\n"
)
FACES = "element face 2\nproperty list uchar int vertex_indices\nproperty short mark\n"
FACE_ROWS = [([0, 1, 2], 5), ([2, 1, 0, 1], 6)]
STRUCT_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


def vertex_bytes(encoding: str) -> bytes:
    if encoding == "ascii":
        return "".join(f"{x} {n} {red}\n" for x, n, red in ROWS).encode()
    return b"".join(struct.pack(STRUCT_ORDERS[encoding] + "fiB", *row) for row in ROWS)


def face_bytes(encoding: str) -> bytes:
    if encoding == "ascii":
        return "".join(f"{len(ids)} {' '.join(map(str, ids))} {mark}\n" for ids, mark in FACE_ROWS).encode()
    order = STRUCT_ORDERS[encoding]
    return b"".join(struct.pack(f"{order}B{len(ids)}ih", len(ids), *ids, mark) for ids, mark in FACE_ROWS)


def write(path: Path, header: str, body: bytes = b"") -> Path:
    path.write_bytes(header.encode() + b"end_header\n" + body)
    return path


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("faces", ["none", "after"])
def test_every_encoding_gives_the_same_vertices_with_and_without_faces(tmp_path, encoding, faces):
    header, body = HEADER.format(encoding=encoding), vertex_bytes(encoding)
    if faces == "after":
        header, body = header + FACES, body + face_bytes(encoding)
    elements = read_ply(write(tmp_path / "a.ply", header, body))
    assert list(elements) == ["vertex"]
    assert elements["vertex"].dtype == np.dtype(FIELDS)
    np.testing.assert_array_equal(elements["vertex"], np.array(ROWS, FIELDS))


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_vertices_with_lists_are_read_without_them(tmp_path, encoding):
    header = (
        f"ply\nformat {encoding} 1.0\nelement vertex 3\nproperty list uchar uint views\nproperty double x\n"
        "property uchar red\nproperty list int float weights\nproperty list uchar short none\nproperty float y\n"
        "element extra 1\nproperty int n\n"
    )
    lists = [((7, 8, 9), (0.5,), ()), ((), (0.1, 0.2), (-1,)), ((1,), (), ())]
    expected = np.array([(1.5, 3, -2), (-0.25, 255, 0), (4e6, 0, 3)], [("x", "f8"), ("red", "u1"), ("y", "f4")])
    rows = [
        (len(a), *a, x, red, len(b), *b, len(c), *c, y) for (a, b, c), (x, red, y) in zip(lists, expected, strict=True)
    ]
    if encoding == "ascii":
        body = "".join(" ".join(map(str, row)) + "\n" for row in [*rows, [5]]).encode()
    else:
        kinds = [f"{STRUCT_ORDERS[encoding]}B{len(a)}IdBi{len(b)}fB{len(c)}hf" for a, b, c in lists]
        body = b"".join(struct.pack(kind, *row) for kind, row in zip(kinds, rows, strict=True))
        body += struct.pack(STRUCT_ORDERS[encoding] + "i", 5)
    path = write(tmp_path / "a.ply", header, body)
    elements = read_ply(path)
    assert elements["vertex"].dtype == expected.dtype
    np.testing.assert_array_equal(elements["vertex"], expected)
    assert elements["extra"]["n"].tolist() == [5]
    for cut in range(8, len(body)):  # at any place: in a length, a list, or a row's end
        write(path, header, body[:-cut])
        with pytest.raises(SceneError, match=r"a\.ply: element 'vertex': "):
            read_ply(path)


def test_faces_behind_the_vertices_are_not_even_looked_at(tmp_path):
    encoding = "binary_little_endian"
    body = vertex_bytes(encoding) + face_bytes(encoding)[:5]
    rows = read_ply(write(tmp_path / "a.ply", HEADER.format(encoding=encoding) + FACES, body))["vertex"]
    np.testing.assert_array_equal(rows, np.array(ROWS, FIELDS))


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_windows_line_ends_in_the_header(tmp_path, encoding):
    text = (HEADER.format(encoding=encoding) + "end_header\n").replace("\n", "\r\n")
    path = tmp_path / "a.ply"
    path.write_bytes(text.encode() + vertex_bytes(encoding))
    np.testing.assert_array_equal(read_ply(path)["vertex"], np.array(ROWS, FIELDS))


def test_ascii_skips_blank_lines_and_keeps_nan_for_the_caller(tmp_path):
    header = "ply\nformat ascii 1.0\nelement vertex 2\nproperty double x\nproperty float y\n"
    rows = read_ply(write(tmp_path / "a.ply", header, b"\n1e300 nan\n\n  -2\t3  \n"))["vertex"]
    np.testing.assert_array_equal(rows["x"], [1e300, -2])
    np.testing.assert_array_equal(rows["y"], np.float32([np.nan, 3]))


def test_elements_follow_each_other_and_may_be_empty(tmp_path):
    header = (
        "ply\nformat binary_little_endian 1.0\nelement chunk 1\nproperty float low\n"
        "element none 0\nproperty int a\nelement vertex 2\nproperty uint packed\n"
    )
    elements = read_ply(write(tmp_path / "a.ply", header, struct.pack("<fII", 2.5, 1, 0xFFFFFFFF) + b"trailing"))
    assert elements["chunk"]["low"].tolist() == [2.5]
    assert len(elements["none"]) == 0
    assert elements["vertex"]["packed"].tolist() == [1, 0xFFFFFFFF]


def test_header_without_final_line_end(tmp_path):
    path = tmp_path / "a.ply"
    path.write_bytes(b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header")
    assert read_ply(path)["vertex"].shape == (0,)


def test_written_files_read_back_and_are_readable_by_the_letter_of_the_format(tmp_path):
    random = np.random.default_rng(0)
    codes = sorted(set(NUMPY_TYPES.values()))
    columns = {f"p_{code}": random.integers(0, 100, 50).astype(code) for code in codes}
    columns["big"] = random.normal(size=50).astype(">f8")
    write_ply(tmp_path / "a.ply", {"vertex": join_columns(columns), "extra": np.zeros(0, [("e", "u2")])}, ["hello"])
    elements = read_ply(tmp_path / "a.ply")
    assert list(elements) == ["vertex", "extra"]
    for name, column in columns.items():
        np.testing.assert_array_equal(elements["vertex"][name], column)
    first = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    assert first[0].startswith(b"ply\nformat binary_little_endian 1.0\ncomment hello\nelement vertex 50\nproperty ")
    row_size = sum(np.dtype(code).itemsize for code in codes) + 8
    assert len(first[1]) == 50 * row_size
    assert struct.unpack("<d", first[1][row_size - 8 : row_size])[0] == columns["big"][0]


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "a.ply"
    write_ply(path, {"vertex": np.zeros(2, [("x", "f4")])})
    before = path.read_bytes()

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("og_pointcloud.formats.atomic.os.replace", fail)
    with pytest.raises(SceneError, match=r"a\.ply: No space left on device"):
        write_ply(path, {"vertex": np.ones(5, [("x", "f4")])})
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("elements", "comments", "message"),
    [
        ({"vertex": np.zeros(2, [("x", "i8")])}, (), "property 'x' of element 'vertex' is int64"),
        ({"vertex": np.zeros(2, [("x", "f4", (3,))])}, (), "property 'x'"),
        ({"vertex": np.zeros((2, 3))}, (), "expected a 1-D structured array"),
        ({"vertex": np.zeros(2, [("a b", "f4")])}, (), "PLY names are one word"),
        ({"vertex": np.zeros(2, [("x", "f4")])}, ("one\nelement vertex 9",), "line break"),
    ],
)
def test_what_ply_cannot_hold_is_refused(tmp_path, elements, comments, message):
    with pytest.raises(SceneError, match=message):
        write_ply(tmp_path / "a.ply", elements, comments)
    assert not list(tmp_path.iterdir())


VERTEX = "element vertex 3\nproperty float x\n"
LITTLE, ASCII = "ply\nformat binary_little_endian 1.0\n", "ply\nformat ascii 1.0\n"


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ("PK\x03\x04", "not a PLY file: it starts with b'PK"),
        ("plyx\n", "not a PLY file"),
        ("ply\n" + VERTEX, "no 'format' line"),
        ("ply\nformat ascii 2.0\n" + VERTEX, "header line 2 is 'format ascii 2.0'"),
        ("ply\nformat morse 1.0\n" + VERTEX, "header line 2"),
        (LITTLE + LITTLE[4:] + VERTEX, "header line 3"),
        (LITTLE + "element vertex -3\nproperty float x\n", "header line 3"),
        (LITTLE + "element vertex 3.5\nproperty float x\n", "header line 3"),
        (LITTLE + f"element vertex {'9' * 5000}\nproperty float x\n", "header line 3"),
        (LITTLE + "property float x\n", "header line 3"),
        (LITTLE + "element vertex 3\n", "has no properties"),
        (LITTLE + VERTEX + VERTEX, "element 'vertex' is declared twice"),
        (LITTLE + VERTEX + "property float x\n", "has property 'x' twice"),
        (LITTLE + VERTEX + "".join(f"property uchar p{k}\n" for k in range(12_000)), "more than 1024 properties"),
        (LITTLE + VERTEX + "property quad y\n", "unknown type 'quad'; expected one of char, uchar"),
        (LITTLE + VERTEX + "property list uchar y\n", "expected a type and a name"),
        (LITTLE + VERTEX + "property float\n", "expected a type and a name"),
        (LITTLE + "comment " + "x" * HEADER_LIMIT + "\n" + VERTEX, "no line 'end_header' within"),
    ],
)
def test_damaged_headers(tmp_path, header, message):
    path = write(tmp_path / "a.ply", header, bytes(12))
    with pytest.raises(SceneError, match=message) as caught:
        read_ply(path)
    assert str(caught.value).startswith(f"{path}: ")


@pytest.mark.parametrize(
    ("header", "body", "message"),
    [
        (LITTLE + "element vertex 999999999999999\nproperty double x\n", bytes(20),
         r"expected 999999999999999 rows of 8 bytes .* the file has 2 rows \(20 bytes\)"),
        (LITTLE + VERTEX, bytes(11), r"expected 3 rows of 4 bytes .12 bytes., the file has 2 rows .11 bytes"),
        (ASCII + VERTEX, b"1\n2\n", "expected 3 rows, the file has 2: it is truncated"),
        (ASCII + VERTEX, b" \n", "expected 3 rows, the file has 0"),
        (ASCII + VERTEX, b"1\nabc\n3\n", "'abc'"),
        (ASCII + VERTEX, b"1\n2 2\n3\n", "expected 1 values per row"),
        (ASCII + VERTEX, b"1 2\n2 3\n3 4\n", "expected 1 values"),
        (ASCII + "element vertex 1\nproperty float x\nproperty uchar red\n", b"1 300\n",
         r"'300' to uint8|not a whole number of the type"),
    ],
)  # fmt: skip
def test_rows_that_do_not_fit_the_header_are_refused_before_memory_is_taken(tmp_path, header, body, message):
    with pytest.raises(SceneError, match=message):
        read_ply(write(tmp_path / "a.ply", header, body))


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_vertices_behind_lists_are_refused(tmp_path, encoding):
    header = f"ply\nformat {encoding} 1.0\n{FACES}{VERTEX}"
    with pytest.raises(SceneError, match=r"no element 'vertex' before the first one with lists .faces.*vertices first"):
        read_points(write(tmp_path / "a.ply", header, face_bytes(encoding)))


def test_missing_file_and_folder(tmp_path):
    with pytest.raises(SceneError, match=r"none\.ply: No such file or directory"):
        read_ply(tmp_path / "none.ply")
    with pytest.raises(SceneError, match="Is a directory"):
        read_ply(tmp_path)
