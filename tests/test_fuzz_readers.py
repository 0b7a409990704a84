"""Damaged and lying files: a few hundred for every reader, and those, by name, that once got through."""

from __future__ import annotations

import json
import struct
import zipfile
from functools import lru_cache
from itertools import count
from random import Random

import fuzz_readers
import numpy as np
import pytest
from fuzz_changes import BY_SUFFIX, changed, mended, packed, unpacked
from fuzz_files import READERS, Reader, bundle_members, encoders, language_features, las_files, transforms
from fuzz_readers import make_input, try_input
from hypothesis import given, settings
from hypothesis import strategies as some

from og_pointcloud.bundle.read import read_bundle, read_carried_encoder
from og_pointcloud.cli import main
from og_pointcloud.errors import BundleError, FeatureSpaceError, OgPointcloudError, SceneError
from og_pointcloud.formats.langsplat import read_language_features
from og_pointcloud.formats.nerfstudio import read_transforms
from og_pointcloud.formats.npy import array_from_npy, npy_bytes
from og_pointcloud.formats.pcd import read_pcd
from og_pointcloud.formats.ply import read_ply
from og_pointcloud.formats.points import read_points
from og_pointcloud.scene import Camera
from og_pointcloud.text.encoder import TextEncoder, check_templates, encoder_files
from og_pointcloud.text.text_features import read_text_features

INPUTS = {"scene file": 60, "scene file, its members": 60, "scene file, asked": 30, "graph": 60, "text encoder": 60}
INPUTS |= {"LangSplat": 80, "OpenGaussian result": 40, "masks": 60, "capture": 40}
INPUTS |= dict.fromkeys(("ScanNet", "7-Scenes", "Replica", "Record3D"), 60)
"""Of the readers that take milliseconds; 120 of each of the others."""


@lru_cache
def seeds_of(name):
    return READERS[name].seeds()


@pytest.mark.parametrize("name", READERS)
def test_every_input_is_read_or_refused(name, tmp_path):
    if name in ("LAS", "LAZ"):
        pytest.importorskip("lazrs")
    reader = READERS[name]
    seeds = seeds_of(name)
    outcomes = {"read": 0, "refused": 0}
    for number in range(INPUTS.get(name, 120)):
        outcome, says = try_input(reader, make_input(reader, seeds, 7, number), tmp_path)
        assert outcome != "unexpected", f"input {number}: {says}"
        outcomes[outcome] += 1
    assert min(outcomes.values()) > 0  # changes that all readers refuse, or none, would say nothing


@pytest.mark.parametrize("name", READERS)
def test_the_files_that_are_changed_are_valid(name, tmp_path):
    if name in ("LAS", "LAZ"):
        pytest.importorskip("lazrs")
    reader = READERS[name]
    for files in seeds_of(name):
        whole = {"scene.ogpc": packed(files)} if reader.whole else files
        assert try_input(reader, whole, tmp_path) == ("read", "")


# What tries the readers must see what they do wrong.


def test_what_is_unexpected_is_told(tmp_path):
    def outcome(read):
        return try_input(Reader("", list, read), {"a.txt": b"x"}, tmp_path)

    def fail(error):
        raise error

    assert outcome(lambda at: (at / "a.txt").read_bytes()) == ("read", "")
    assert outcome(lambda at: fail(SceneError(f"{at}: no"))) == ("refused", ": no")
    assert outcome(lambda at: (at / "b.txt").read_bytes())[0] == "refused"
    for error in (KeyError("x"), MemoryError(), RecursionError(), AssertionError(), ValueError("x"), OSError("x")):
        assert outcome(lambda at, error=error: fail(error))[0] == "unexpected"
    assert "RuntimeWarning" in outcome(lambda at: np.float32(3e38) * np.float32(3e38))[1]
    assert outcome(lambda at: fail(SceneError("x" * 401))) == (
        "unexpected",
        f"a message of 401 characters: {'x' * 120!r}",
    )
    assert outcome(lambda at: fail(FileNotFoundError("a\nb")))[0] == "unexpected"


def test_what_takes_long_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr(fuzz_readers, "MOST_SECONDS", 0.01)
    reader = Reader("", list, lambda at: next(number for number in count() if number > 1_000_000))
    assert "of processor time; then read" in try_input(reader, {}, tmp_path)[1]


def test_an_input_is_the_same_again_and_others_differ():
    reader = READERS["text features"]
    seeds = reader.seeds()
    first = [make_input(reader, seeds, 3, number) for number in range(20)]
    assert first == [make_input(reader, seeds, 3, number) for number in range(20)]
    assert len({json.dumps(files, default=bytes.hex) for files in first}) > 15
    assert make_input(reader, seeds, 4, 0) != first[0]


@pytest.mark.parametrize("suffix", sorted(BY_SUFFIX))
def test_changes_survive_any_content(suffix):
    for number in range(60):
        random = Random(number)
        data = random.randbytes(number)
        assert isinstance(changed(random, f"a{suffix}", data), bytes)


def test_a_reader_in_a_process_of_its_own(capsys):
    assert fuzz_readers.main(["--reader", "words", "--count", "30"]) == 0
    tried, refused, _, read, unexpected, _ = map(int, capsys.readouterr().out.splitlines()[1].split()[1:])
    assert (tried, unexpected) == (30, 0)
    assert refused + read == 30
    assert fuzz_readers.main(["--reader", "words", "--only", "3"]) == 0


# What once got through.


def test_messages_are_printable_whatever_the_file_says(capsys, tmp_path):
    error = SceneError("a\x1b[31m b\ud800\r\n\u202e café \U0001f44d")
    assert str(error) == "a\\x1b[31m b\\ud800\\r\\n\\u202e café \U0001f44d"
    (tmp_path / "\x1b[2J.ogpc").write_bytes(b"")
    assert main(["info", str(tmp_path / "\x1b[2J.ogpc")]) != 0
    assert "\x1b" not in capsys.readouterr().err


@pytest.mark.parametrize(
    "header",
    [
        "{'descr': '<f4', 'fortran_order': False, 'shape': (True, 3), }",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (9999999999999999999999,), }",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (" + "1, " * 5000 + "), }",
        "x" * 5000,
        "{'descr': '<f4)', 'fortran_order': False, 'shape': (3, 4)), }",
        "{'descr': '|S0', 'fortran_order': False, 'shape': (-1,), }",  # numpy.load divides by it
        "{'descr': '|S0', 'fortran_order': False, 'shape': (1000000000000,), }",
    ],
)
def test_array_headers(tmp_path, header):
    data = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode() + bytes(12)
    if "True" in header:  # counts as one
        assert array_from_npy(data).shape == (1, 3)
        return
    with pytest.raises(ValueError, match="header") as caught:
        array_from_npy(data)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 200
    for name, content in language_features()[0].items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(data if name.endswith("a_s.npy") else content)
    with pytest.raises(SceneError, match=r"a_s\.npy cannot be read as a \.npy array"):
        read_language_features(tmp_path, ("a", "b"), "large")


@pytest.mark.parametrize("value", [10**400, -(10**400), 1e400, float("nan"), "y" * 3000, True, []])
def test_numbers_of_a_pose_file(tmp_path, value):
    content = json.loads(transforms()[0]["transforms.json"])
    content["fl_x"] = value
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(SceneError, match=r"fl_x is .*; expected a finite number") as caught:
        read_transforms(tmp_path / "transforms.json", lambda _: (48, 36))
    assert len(str(caught.value)) < 400 + len(str(tmp_path))


def test_a_pose_that_overflows_is_refused():
    pose = np.eye(4)
    pose[:3, :3] = [[1e200, -1e200, 0], [1e200, 1e200, 0], [0, 0, 1]]  # its product with itself is inf - inf
    with pytest.raises(SceneError, match="rigid right-handed pose"):
        Camera(4, 4, 1.0, 1.0, 2.0, 2.0, pose)


def test_an_encoder_is_read_without_allocating_what_it_might_be(tmp_path):
    import tracemalloc

    for name, data in encoders()[0].items():
        (tmp_path / name).write_bytes(data)
    tracemalloc.start()
    try:
        encoder_files(tmp_path)
        assert tracemalloc.get_traced_memory()[1] < 1 << 22
    finally:
        tracemalloc.stop()


def test_templates_that_are_no_texts(tmp_path):
    for templates in ([None], ["{}", None], [3], []):
        with pytest.raises(OgPointcloudError, match="has no place for the name"):
            check_templates(templates)
    files = encoders()[0]
    manifest = {**json.loads(files["manifest.json"]), "templates": [None]}
    files = mended({**files, "manifest.json": json.dumps(manifest).encode()}, files)
    with pytest.raises(OgPointcloudError, match="has no place for the name"):
        TextEncoder(files, "encoder")


def test_a_carried_encoder_that_is_encrypted(tmp_path):
    data = bytearray(packed(bundle_members()[1]))
    at = max(place for place in (data.find(b"PK\x01\x02", start) for start in range(0, len(data), 64)) if place >= 0)
    data[at + 8] |= 1
    (tmp_path / "scene.ogpc").write_bytes(data)
    with zipfile.ZipFile(tmp_path / "scene.ogpc") as archive:
        assert [info.filename for info in archive.infolist() if info.flag_bits & 1] == ["text_encoder/word_bank.npy"]
    with pytest.raises(BundleError, match=r"text encoder in it is damaged .*encrypted"):
        read_carried_encoder(tmp_path / "scene.ogpc")


def test_long_names_do_not_make_long_messages(tmp_path):
    members = bundle_members()[0]
    for name in ("z" * 3000, "\x1b" * 3000):
        (tmp_path / "scene.ogpc").write_bytes(packed({**members, name: b""}))
        with pytest.raises(BundleError) as caught:
            read_bundle(tmp_path / "scene.ogpc")
        assert len(str(caught.value)) < 600 + len(str(tmp_path))


def test_text_of_characters_that_there_are_not(tmp_path):
    """A str made of them breaks the interpreter."""
    data = npy_bytes(np.array(["chair"]))
    for last, fine in ((b"\xff\xff\x10\0", True), (b"\0\0\x11\0", False), (b"\xff\xff\xff\xff", False)):
        if fine:
            assert array_from_npy(data[:-4] + last)[0] == "chai\U0010ffff"
        else:
            with pytest.raises(ValueError, match="characters that there are not"):
                array_from_npy(data[:-4] + last)


@pytest.mark.parametrize(
    ("place", "number", "says"), [(10, 14, "packed by method 14"), (20, 2**30 - 999, "claims 1073740825 bytes")]
)
def test_members_of_an_npz_that_numpy_would_not_write(tmp_path, place, number, says):
    data = bytearray(READERS["text features"].seeds()[0]["words.npz"])
    directory = data.find(b"PK\x01\x02")
    data[directory + place : directory + place + 2 + 2 * (place == 20)] = number.to_bytes(
        2 + 2 * (place == 20), "little"
    )
    (tmp_path / "words.npz").write_bytes(data)
    with pytest.raises(FeatureSpaceError, match=says):
        read_text_features(tmp_path / "words.npz")


def test_archives_are_packed_and_unpacked_alike():
    members = {"a": b"1", "b/c.npy": npy_bytes(np.arange(3))}
    assert unpacked(packed(members)) == members
    assert unpacked(packed(members, zipfile.ZIP_DEFLATED)) == members
    assert unpacked(b"no zip") == {}


# Headers of any form

NUMBERS = some.one_of(some.integers(-1, 12), some.sampled_from((2**31, 2**32, 2**63, 10**12, 10**14, 10**20)))
TYPES = some.sampled_from(
    ("char", "uchar", "short", "int", "uint", "float", "double", "float32", "int8", "int", "half")
)
WORDS = some.one_of(some.sampled_from(("x", "y", "z", "red", "vertex", "chunk")), some.text("ab _\x1b\x85", max_size=3))
KIND = some.one_of(TYPES, TYPES, some.builds("list {} {}".format, TYPES, TYPES))
ELEMENT = some.tuples(NUMBERS, some.lists(KIND, min_size=1, max_size=4))


def read_or_refused(read, path):
    try:
        return read(path), ""
    except SceneError as error:
        return None, str(error)


@settings(max_examples=200, derandomize=True, deadline=None)
@given(
    some.sampled_from(("binary_little_endian", "binary_big_endian", "ascii")),
    some.lists(ELEMENT, min_size=1, max_size=3),
    some.one_of(some.just("e"), some.just("e"), WORDS),
    some.binary(max_size=200),
)
def test_ply_headers(tmp_path_factory, encoding, elements, word, data):
    lines = ["ply", f"format {encoding} 1.0"]
    for number, (rows, kinds) in enumerate(elements):
        lines.append(f"element {word}{number} {rows}")
        lines += [f"property {kind} {word}{place}" for place, kind in enumerate(kinds)]
    path = tmp_path_factory.getbasetemp() / "any.ply"
    path.write_bytes("\n".join([*lines, "end_header", ""]).encode() + data)
    arrays, refused = read_or_refused(read_ply, path)
    assert len(refused) < 400 + len(str(path))
    for name, array in (arrays or {}).items():
        assert len(array) == elements[int(name[-1])][0]
        assert encoding == "ascii" or array.nbytes <= len(data)


COUNTS = some.sampled_from((1, 1, 1, 0, 3, 2**31, 10**14))
PCD_FIELD = some.tuples(WORDS, some.sampled_from("FFFIUX"), some.sampled_from((1, 2, 4, 4, 8, 3)), COUNTS)


@settings(max_examples=200, derandomize=True, deadline=None)
@given(
    some.lists(PCD_FIELD, min_size=1, max_size=6),
    NUMBERS,
    NUMBERS,
    some.sampled_from(("ascii", "binary", "binary_compressed")),
    some.binary(max_size=200),
)
def test_pcd_headers(tmp_path_factory, fields, width, height, encoding, data):
    names, types, sizes, counts = (" ".join(map(str, column)) for column in zip(*fields, strict=True))
    lines = ("VERSION 0.7", f"FIELDS {names}", f"SIZE {sizes}", f"TYPE {types}", f"COUNT {counts}", f"WIDTH {width}")
    lines = (*lines, f"HEIGHT {height}", f"POINTS {width * height}", f"DATA {encoding}", "")
    path = tmp_path_factory.getbasetemp() / "any.pcd"
    path.write_bytes("\n".join(lines).encode("utf-8", "replace") + data)
    rows, refused = read_or_refused(read_pcd, path)
    assert len(refused) < 400 + len(str(path))
    assert rows is None or len(rows) == width * height
    assert rows is None or rows.nbytes <= (88 * len(data) if encoding == "binary_compressed" else 8 * len(data))


# LAS


def las_header(data, **numbers):
    """The file with other numbers in its header, by name: records, points, table_chunks, layer, chunk_points."""
    edit = bytearray(data)
    first = struct.unpack_from("<I", edit, 96)[0]
    laszip = edit.find(struct.pack("<16sH", b"laszip encoded", 22204)) + 52
    table = struct.unpack_from("<q", edit, first)[0] if laszip > 52 else 0
    places = {"records": (100, "<I"), "points": (247, "<Q"), "late_records": (243, "<I")}
    places["chunk_points"] = (laszip + 12, "<I")
    places |= {"table": (first, "<q"), "table_chunks": (table + 4, "<I"), "layer": (first + 8 + 49 + 4, "<I")}
    for name, number in numbers.items():
        struct.pack_into(places[name][1], edit, places[name][0], number)
    return bytes(edit)


@pytest.mark.parametrize(
    ("suffix", "numbers", "says"),
    [
        (".las", {"records": 2**32 - 1}, "4294967295 records before the points"),
        (".las", {"late_records": 2**32 - 1}, "4294967295 late records"),
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
    (data,) = las_files(suffix)[0].values()
    path = tmp_path / f"cloud{suffix}"
    path.write_bytes(las_header(data))
    assert len(read_points(path)) == 12
    path.write_bytes(las_header(data, **numbers))
    with pytest.raises(SceneError, match=says):
        read_points(path)


def test_chunks_of_two_billion_points_make_no_room_for_them(tmp_path):
    pytest.importorskip("lazrs")
    (data,) = las_files(".laz")[0].values()
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
