"""The .ogpc file: what goes in comes out, and every way to damage or forge one gives one clear error."""

from __future__ import annotations

import copy
import shutil
import zipfile
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from hostile_files import changed, drop, members_of, zip_of
from labelled_clouds import (
    instance_table,
    instances_plainly,
    make_cloud,
    queries,
    reference_scores,
    room,
    tough_clouds,
    unit_rows,
)
from og_pointcloud_export import write_bundle, writer

import og_pointcloud as og
from og_pointcloud.bundle.read import read_bundle
from og_pointcloud.cloud import InstanceTable, Vocabulary
from og_pointcloud.errors import BundleError, OgPointcloudError
from og_pointcloud.formats.npy import array_from_npy, npy_bytes
from og_pointcloud.models import open_session

CLOUDS = tough_clouds()
SCHEMA_2 = Path(__file__).parent / "data" / "schema_2.ogpc"
"""Two balls of 100 points each, "apple" and "pear", on 40 points of a floor: 35 background, 5 unobserved. Written by an
older library, with words and a bank of 60; never written anew."""


@pytest.fixture(scope="module")
def bundle_file(tmp_path_factory):
    return write_bundle(room(500), tmp_path_factory.mktemp("bundle") / "room.ogpc")


def refuse(path, says, **options):
    with pytest.raises(BundleError, match=says) as caught:
        read_bundle(path, **options)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", CLOUDS)
def test_tough_clouds_come_back_as_they_went(tmp_path, name):
    cloud = CLOUDS[name]
    back = read_bundle(write_bundle(og.LabelledScene.from_cloud(cloud), tmp_path / "s.ogpc")).cloud
    for key in ("xyz", "origin", "instance_ids", "rgb"):
        assert (getattr(back, key) == getattr(cloud, key)).all()
        assert getattr(back, key).dtype == getattr(cloud, key).dtype
    for field in fields(InstanceTable):
        ours, theirs = getattr(back.instances, field.name), getattr(cloud.instances, field.name)
        assert ours.shape == theirs.shape
        assert ours.dtype == theirs.dtype
        np.testing.assert_array_equal(ours, theirs)
    for key in ("feature_space", "spacing", "reach", "provenance"):
        assert getattr(back, key) == getattr(cloud, key)
    assert (back.vocabulary is None) == (cloud.vocabulary is None)
    assert (back.certainty is None) == (cloud.certainty is None)
    if cloud.certainty is not None:
        assert back.certainty.tolist() == cloud.certainty.tolist()


def test_a_file_of_an_older_library_opens_and_answers():
    scene = og.load(SCHEMA_2)
    ids = np.repeat([0, 1, -1, -2], [100, 100, 35, 5])
    assert read_bundle(SCHEMA_2).manifest["schema_version"] == 2
    assert scene.cloud.instance_ids.tolist() == ids.tolist()
    for words in (["apple", "pear"], None):
        result = og.segment(scene.xyz, words, scene)
        assert result.calibrated
        assert result.instances.tolist() == ids.tolist()
        assert result.labels.tolist() == np.maximum(ids, -1).tolist()
        assert result.scores[[0, 100, 200]].tolist() == pytest.approx([0.8939, 0.8612, 0], abs=1e-3)
    points = scene.cloud.origin + np.array([[0.31, 0, 0], [0.36, 0, 0], [0.28, 0, 0], [0, 0, 0.42], [0, 0, 0.5]])
    asked = og.segment(points, ["pear", "chair"], scene)
    assert asked.instances.tolist() == [1, 1, 0, 0, -3]
    assert asked.labels.tolist() == [0, 0, -1, -1, -1]


def test_graph_and_arrays_of_an_older_file_agree():
    bundle = read_bundle(SCHEMA_2)
    cloud, points = bundle.cloud, queries(bundle.cloud, 500)
    text = unit_rows(7)
    names = ["instance", "certain", "instance_scores"]
    instance, certain, scores = open_session(bundle.query_onnx).run(names, {"points": points, "text": text})
    assert certain.all()
    assert instance.tolist() == instances_plainly(cloud, points).tolist()
    assert np.abs(scores - reference_scores(cloud.instances, text)).max() < 1e-6


def test_a_file_written_anew_has_the_same_arrays(tmp_path):
    old, new = (members_of(path) for path in (SCHEMA_2, write_bundle(read_bundle(SCHEMA_2).cloud, tmp_path / "s.ogpc")))
    assert list(old) == list(new)
    changed = [name for name in old if old[name] != new[name]]
    assert changed == ["manifest.json", "query.onnx", "vocabulary/vectors.npy"]  # words: in half precision before
    words = [array_from_npy(members["vocabulary/vectors.npy"]) for members in (old, new)]
    np.testing.assert_allclose(words[1], words[0], atol=1e-3)


def test_words_come_back_as_unit_vectors_close_to_their_own(tmp_path):
    cloud = room(100)
    back = read_bundle(write_bundle(cloud, tmp_path / "s.ogpc")).cloud.vocabulary
    assert back.names == cloud.vocabulary.names
    assert np.abs(back.vectors * 10 - cloud.vocabulary.vectors).max() < 0.01


def test_words_that_half_precision_would_confuse_are_told_apart(tmp_path):
    cloud = make_cloud(np.zeros((1, 3)), [0], instances=instance_table(1))
    row, other = unit_rows(1)[0].astype(np.float64), unit_rows(2, seed=1)[1]
    # As float16 both become the same row, and the first would win.
    cloud = replace(cloud, vocabulary=Vocabulary(("close", "same"), np.array([row + 2e-6 * other, row], np.float32)))
    back = read_bundle(write_bundle(cloud, tmp_path / "s.ogpc")).cloud.vocabulary
    assert (back.vectors[0] != back.vectors[1]).any()
    np.testing.assert_allclose(back.vectors @ row, [1, 1], atol=1e-5)


def test_the_same_cloud_gives_the_same_bytes(tmp_path):
    first, second = (write_bundle(room(300), tmp_path / name).read_bytes() for name in ("a.ogpc", "b.ogpc"))
    assert first == second
    with zipfile.ZipFile(tmp_path / "a.ogpc") as archive:
        assert {info.date_time for info in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}


def test_manifest_says_what_is_inside(bundle_file):
    manifest = read_bundle(bundle_file).manifest
    assert (manifest["format"], manifest["schema_version"]) == ("ogpc", 2)
    assert manifest["counts"] == {"points": 500, "instances": 9, "descriptors": 9, "words": 5}
    assert manifest["parity"]["instance_score_error"] < 1e-6
    assert manifest["parity"]["certain_points_wrong"] == 0
    assert manifest["members"]["arrays/instance_ids.npy"]["dtype"] == "|i1"


def test_descriptors_are_stored_once(bundle_file):
    row = room(500).instances.descriptors[3].tobytes()
    assert bundle_file.read_bytes().count(row) == 1


@pytest.mark.parametrize(("count", "dtype"), [(127, "|i1"), (200, "<i2"), (40_000, "<i4")])
def test_ids_take_the_smallest_type(count, dtype):
    ids = np.array([-2, count - 1], np.int32)
    assert writer._smallest_signed(ids).dtype.str == dtype
    assert (writer._smallest_signed(ids) == ids).all()


def _of_table(**columns):
    return lambda cloud: replace(cloud, instances=replace(cloud.instances, **columns))


def _with_words(names, vectors):
    return lambda cloud: replace(cloud, vocabulary=Vocabulary(names, vectors))


VECTORS = unit_rows(2).astype(np.float64)


@pytest.mark.parametrize(
    "change",
    [
        lambda cloud: replace(cloud, instance_ids=cloud.instance_ids.astype(np.int64)),
        _of_table(masks=np.arange(9), descriptors=unit_rows(9).astype(np.float16).astype(np.float64)),
        _of_table(agreement=np.ones(9), views=np.ones(9, np.uint8), descriptor_instance=np.arange(9)),
        _with_words(("mug", "cup"), VECTORS),
        _with_words(["mug", "cup"], VECTORS.astype(np.float16)),
    ],
)
def test_clouds_made_of_numpys_usual_types_are_written_as_files_that_open(tmp_path, change):
    cloud = change(room(300))
    scene = og.load(write_bundle(cloud, tmp_path / "s.ogpc"))
    assert og.segment(scene).labels.tolist() == og.segment(cloud).labels.tolist()
    assert scene.cloud.instances.masks.tolist() == cloud.instances.masks.tolist()


def test_points_are_counted_when_a_cloud_of_fewer_points_is_written(tmp_path):
    cloud = room(300)
    half = replace(cloud, xyz=cloud.xyz[::2], instance_ids=cloud.instance_ids[::2], rgb=None, certainty=None)
    assert half.instances.points.sum() > half.counted_points.sum()
    instances = og.load(write_bundle(half, tmp_path / "s.ogpc")).cloud.instances
    assert instances.points.tolist() == [int((half.instance_ids == k).sum()) for k in range(len(instances))]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda cloud: replace(cloud, xyz=cloud.xyz.astype(float)), "xyz is float64; expected float32 near zero"),
        (lambda cloud: replace(cloud, xyz=cloud.xyz * np.float32("nan")), "300 of 300 points contain NaN"),
        (lambda cloud: replace(cloud, instance_ids=cloud.instance_ids * np.nan), "instance ids is float64; expected i"),
        (lambda cloud: replace(cloud, rgb=cloud.rgb / 255), r"rgb is float64 \(300, 3\); expected uint8 \(300, 3\)"),
        (lambda cloud: replace(cloud, feature_space=None), "the feature space is None; expected the encoder's name"),
        (_of_table(views=np.ones(9)), "instance views is float64; expected int32"),
        (_of_table(points=np.ones((9, 1), int)), r"instance points has shape \(9, 1\); expected \(9,\)"),
        (_with_words(("mug", "mug"), VECTORS), "the name 'mug' is given twice"),
        (_with_words(("mug", " "), VECTORS), "row 1 has an empty name"),
        (_with_words(("mug", "cup"), 0 * VECTORS), "the vector of 'mug' is zero"),
        (_with_words((1, 2), VECTORS), "the words are .1, 2.; expected strings"),
        (_with_words(("mug", "cup"), VECTORS * 1e300), "vectors contain NaN or infinity"),
        (_with_words(("mug", "x" * 1001), VECTORS), "has 1001 characters; expected whole ones, at most 1000"),
        (
            lambda cloud: replace(cloud, provenance={"notes": "x" * 2_100_000}),
            "expected at most 2097152, the readers' limit",
        ),
        (lambda cloud: replace(cloud, provenance={"notes": "\ud800"}), "cannot be written as JSON"),
    ],
)
def test_a_cloud_whose_file_would_not_open_is_not_written(tmp_path, change, says):
    with pytest.raises(OgPointcloudError, match=says):
        write_bundle(change(room(300)), tmp_path / "s.ogpc")
    assert not any(tmp_path.iterdir())


def test_nothing_is_left_behind_when_writing_fails(tmp_path):
    (tmp_path / "s.ogpc").write_bytes(b"old")
    cloud = replace(room(50), provenance={"what": object()})
    with pytest.raises(OgPointcloudError, match="cannot be written as JSON"):
        write_bundle(cloud, tmp_path / "s.ogpc")
    assert (tmp_path / "s.ogpc").read_bytes() == b"old"
    assert [file.name for file in tmp_path.iterdir()] == ["s.ogpc"]


def test_a_capture_in_place_of_its_file_is_told(tmp_path, bundle_file):
    (tmp_path / "kitchen").mkdir()
    refuse(tmp_path / "kitchen", r"is not a file; expected a \.ogpc file: check the name")
    shutil.copy(bundle_file, tmp_path / "kitchen.ogpc")
    refuse(tmp_path / "kitchen", r"did you mean .*kitchen\.ogpc\?")


@pytest.mark.parametrize("path", ["", ".", "/", "long" * 1000, None])
def test_what_has_no_name_or_too_long_a_one_is_no_file(path):
    with pytest.raises(BundleError, match=r"is not a file; expected a \.ogpc file: check the name"):
        read_bundle(path)


@pytest.mark.parametrize("content", [b"", b"ply\nformat ascii 1.0\n", b"PK\x03\x04" + bytes(100), bytes(70_000)])
def test_no_zip(tmp_path, content):
    (tmp_path / "s.ogpc").write_bytes(content)
    refuse(tmp_path / "s.ogpc", "not a .ogpc file, or damaged")
    refuse(tmp_path / "s.ogpc", "stored members: copy the file again, or make it again .og-pointcloud fit.; a cloud or")


def test_a_zip_of_something_else(tmp_path):
    refuse(zip_of(tmp_path / "s.ogpc", {"word/document.xml": b"<xml/>"}), "without manifest.json")
    refuse(zip_of(tmp_path / "s.ogpc", {"manifest.json": b'{"format": "zarr"}'}), "format 'zarr'")
    refuse(zip_of(tmp_path / "s.ogpc", {"manifest.json": b"[1]"}), "format 'list'")
    refuse(zip_of(tmp_path / "s.ogpc", {"manifest.json": b"{"}), "is not JSON")
    refuse(zip_of(tmp_path / "s.ogpc", {"manifest.json": b"[" * 100_000}), "is not JSON")


def test_every_truncation_is_refused(tmp_path, bundle_file):
    data = bundle_file.read_bytes()
    for length in np.linspace(0, len(data) - 1, 40).astype(int):
        (tmp_path / "s.ogpc").write_bytes(data[:length])
        refuse(tmp_path / "s.ogpc", "not a .ogpc file, or damaged")


def test_a_flipped_bit_is_refused_or_changes_nothing(tmp_path, bundle_file):
    data = bundle_file.read_bytes()
    whole = members_of(bundle_file)
    for place in np.random.default_rng(0).integers(0, len(data), 150):
        damaged = bytearray(data)
        damaged[place] ^= 1 << int(place % 8)
        (tmp_path / "s.ogpc").write_bytes(damaged)
        try:
            read_bundle(tmp_path / "s.ogpc")
        except BundleError:
            continue
        assert members_of(tmp_path / "s.ogpc") == whole  # a date, or another field that means nothing


@pytest.mark.parametrize(
    ("version", "says"),
    [
        (3, "schema_version is 3, newer than the 2.*pip install --upgrade"),
        (1, r"schema_version is 1, older than the 2.*fit the capture again \(og-pointcloud fit CAPTURE"),
    ],
)
def test_another_schema_names_the_cure(tmp_path, bundle_file, version, says):
    path = changed(bundle_file, tmp_path / "s.ogpc", lambda manifest, _: manifest.update(schema_version=version))
    refuse(path, says)


@pytest.mark.parametrize(
    "name", ["../escape.npy", "/etc/passwd", "arrays/../x", "C:\\x", "a\\b", "arrays//x", "x\x07y"]
)
def test_names_that_are_no_plain_paths(tmp_path, bundle_file, name):
    path = zip_of(tmp_path / "s.ogpc", {**members_of(bundle_file), name: b"x"})
    refuse(path, "is not a plain relative path")


def test_compressed_members_are_refused_unopened(tmp_path, bundle_file):
    members = {**members_of(bundle_file), "arrays/xyz.npy": bytes(50_000_000)}
    refuse(zip_of(tmp_path / "s.ogpc", members, zipfile.ZIP_DEFLATED), "is compressed")


def test_members_that_claim_the_same_bytes(tmp_path):
    """Directory entries that all point to one member with its right CRC: a small file that would unpack big."""
    with zipfile.ZipFile(tmp_path / "s.ogpc", "w") as archive:
        archive.writestr("big", bytes(1_000_000))
        for number in range(199):
            archive.filelist.append(copy.copy(archive.filelist[0]))
            archive.filelist[-1].filename = f"big{number}"
    refuse(tmp_path / "s.ogpc", "200 members with 200 names claim 200000000 bytes in a file of 1")


def test_two_members_of_one_name(tmp_path):
    with zipfile.ZipFile(tmp_path / "s.ogpc", "w") as archive:
        archive.writestr("manifest.json", b"first")
        with pytest.warns(UserWarning, match="Duplicate"):
            archive.writestr("manifest.json", b"second")
    refuse(tmp_path / "s.ogpc", "2 members with 1 names")


def put(name, data):
    return lambda manifest, members: members.update({name: data})


def say(*keys_and_value):
    *keys, last, value = keys_and_value

    def change(manifest, members):
        for key in keys:
            manifest = manifest[key]
        manifest[last] = value

    return change


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (drop("query.onnx"), "'query.onnx' is missing"),
        (drop("arrays/xyz.npy"), "'arrays/xyz.npy' is missing"),
        (drop("arrays/instances/views.npy"), "'arrays/instances/views.npy' is missing"),
        (drop("vocabulary/vectors.npy"), "'vocabulary/vectors.npy' is missing"),
        (lambda manifest, members: members.pop("arrays/rgb.npy"), "'arrays/rgb.npy' of the manifest is missing"),
        (put("arrays/xyz.npy", npy_bytes(np.zeros((500, 3)))), "is <f8"),
        (put("arrays/xyz.npy", npy_bytes(np.zeros((499, 3), np.float32))), r"expected <f4 \(500, 3\)"),
        (put("arrays/xyz.npy", npy_bytes(np.full((500, 3), np.nan, np.float32))), "NaN or infinity"),
        (put("arrays/xyz.npy", npy_bytes(np.zeros((500, 3), np.float32))[:-4]), "but 5996 follow"),
        (put("arrays/xyz.npy", b"junk"), "is not a readable .npy"),
        (put("arrays/xyz.npy", b"\x93NUMPY\x01\x00\x10\x00(((((((((((((((("), "is not a readable .npy"),
        (put("arrays/instance_ids.npy", npy_bytes(np.zeros(500, "<i8")).replace(b"'<i8'", b"'|O' ")), "Python objects"),
        (put("arrays/instance_ids.npy", npy_bytes(np.full(500, 9, np.int8))), "instance ids span 9..9"),
        (put("arrays/instance_ids.npy", npy_bytes(np.full(500, -3, np.int8))), "instance ids span -3..-3"),
        (put("arrays/instances/points.npy", npy_bytes(np.full(9, 7, "<i4"))), "instance 0 has 7 points, its ids that"),
        *(
            (put(f"arrays/instances/{name}.npy", npy_bytes(np.array([5] * 8 + [value], kind))), f"{name} is {value}")
            for name, kind, value in (("views", "<i4", -1), ("masks", "<i4", -2), ("visible_area", "<f4", -1.0))
        ),
        (put("arrays/instances/agreement.npy", npy_bytes(np.full(9, 5, np.float32))), "agreement is 5.0; expected -1"),
        (put("arrays/instances/reliability.npy", npy_bytes(np.full(9, -0.5, np.float32))), "is -0.5; expected 0 to 1"),
        (put("arrays/certainty.npy", npy_bytes(np.zeros(500, np.float32))), r"is <f4 \(500,\); expected \|u1"),
        (put("arrays/certainty.npy", npy_bytes(np.zeros(499, np.uint8))), r"expected \|u1 \(500,\)"),
        (put("vocabulary/names.json", b'["a", "a", "b", "c", "d"]'), "not a list of 5 different words"),
        (put("vocabulary/names.json", b"{}"), "not a list of 5 different words"),
        (put("bank/vectors.npy", npy_bytes(unit_rows(60))), "is <f4"),
        (put("bank/vectors.npy", npy_bytes(unit_rows(49).astype(np.float16))), "a word bank of 49 words"),
        (
            put("bank/vectors.npy", npy_bytes(unit_rows(60, 8).astype(np.float16))),
            r"word bank's vectors are in .*\(dimension 8\)",
        ),
        (put("bank/vectors.npy", npy_bytes(np.full((60, 16), np.nan, np.float16))), "the word bank contains NaN"),
        (put("bank/vectors.npy", npy_bytes(np.zeros(60, np.float16))), r"expected <f2 \(None, None\)"),
        (say("counts", "points", 501), r"\(501, 3\)"),
        (say("counts", "points", -1), r"\(-1, 3\)"),
        (say("counts", "instances", 10), "expected <i4"),
        (say("counts", "words", 4), "not a list of 4 different words"),
        (say("counts", "points", True), "'counts/points' is True"),
        (say("counts", {}), "'counts/points' is None"),
        (say("descriptors", "offset", -5), "outside query.onnx"),
        (say("descriptors", "offset", 10**12), "outside query.onnx"),
        (say("descriptors", "shape", [10**9, 16]), "outside query.onnx"),
        (say("descriptors", "shape", [8, 16]), r"expected <i4 \(8,\)"),
        (say("frame", "spacing", 0), "spacing is 0"),
        (say("frame", "reach", float("nan")), "reach is nan"),
        (say("frame", "reach", 10**400), "do not fit"),
        (say("frame", "origin", [0, 1]), "expected three numbers"),
        (say("frame", "origin", [0, 1, "x"]), "do not fit"),
        (say("feature_space", None), "'feature_space' is None"),
        (say("schema_version", "1"), "schema_version is '1'"),
        (say("schema_version", 0), "schema_version is 0"),
        (say("members", []), "'members' is"),
    ],
)
def test_each_damage_has_its_own_words(tmp_path, bundle_file, change, says):
    refuse(changed(bundle_file, tmp_path / "s.ogpc", change), says)


def test_a_length_that_the_manifest_does_not_know(tmp_path, bundle_file):
    members = members_of(bundle_file)
    members["query.onnx"] += b"x"
    refuse(zip_of(tmp_path / "s.ogpc", members), "the manifest says")
    members["extra.bin"] = b"x"
    refuse(zip_of(tmp_path / "s.ogpc", members), "'extra.bin' is not in the manifest")
