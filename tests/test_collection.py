"""Many scenes asked at once give what asking each would, and no word crosses from one encoder's space to another's."""

from __future__ import annotations

import json
import os
import re
import shutil
import sqlite3
import sys
from dataclasses import replace
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest
from commands import error_of, output_of, run
from labelled_clouds import instance_table, unit_rows
from text_models import encoder_files, write_files

import og_pointcloud as og
from og_pointcloud.cloud import LabelledCloud, Vocabulary, WordBank
from og_pointcloud.collection.index import index
from og_pointcloud.collection.lance import write_lance
from og_pointcloud.collection.scoring import largest
from og_pointcloud.collection.store import SUPER_JOURNAL_MARK, Atlas
from og_pointcloud.errors import FeatureSpaceError, OgPointcloudError
from og_pointcloud.show.findings_page import picture, png_bytes

WIDTH = 32
THINGS = ("chair", "desk", "lamp", "mug", "plant", "sofa", "bed", "rug")
ENCODER = dict(zip(THINGS, unit_rows(len(THINGS), WIDTH, seed=9), strict=True))
BANK = WordBank(unit_rows(80, WIDTH, seed=4))
SPACE = "tests/encoder"


def scene(things, seed=0, *, space=SPACE, encoder=ENCODER, words=THINGS, bank=None, noise=0.1, at=0.0, common=0.0):
    """A cloud with an instance of 4 points for each thing, one unit apart along x; the second has two descriptors."""
    random = np.random.default_rng(seed)
    owners = sorted([*range(len(things)), *([1] if len(things) > 1 else [])])
    rows = np.array([encoder[things[k]] for k in owners]) + noise * random.normal(size=(len(owners), WIDTH)) + common
    rows = (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)
    table = replace(instance_table(len(things), owners, WIDTH), descriptors=rows)
    corners = np.array([[0, 0, 0], [0.4, 0, 0], [0, 0.2, 0], [0, 0, 0.3]])
    xyz = (np.arange(len(things))[:, None, None] * [1, 0, 0] + corners).reshape(-1, 3).astype(np.float32)
    vectors = np.array([encoder[name] for name in words], np.float32).reshape(-1, WIDTH)
    return LabelledCloud(
        xyz, np.array([at, 0, 0]), np.repeat(np.arange(len(things)), 4).astype(np.int32), table, space, 0.3, 0.9,
        vocabulary=Vocabulary(tuple(words), vectors) if words else None, word_bank=bank,
    )  # fmt: skip


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "scans"


def indexed(folder: Path, clouds: dict[str, LabelledCloud]) -> og.Collection:
    for name, cloud in clouds.items():
        og.write_bundle(cloud, folder / f"{name}.ogpc")
    return og.Collection.index(folder, folder.parent / "atlas", progress=False)


def many(count: int, **options) -> dict[str, LabelledCloud]:
    random = np.random.default_rng(1)
    things = [list(random.choice(THINGS, random.integers(1, 7))) for _ in range(count)]
    return {f"site{k % 3}/room{k:02d}": scene(things[k], k, **options) for k in range(count)}


@pytest.fixture(scope="module")
def judged(tmp_path_factory) -> tuple[dict[str, LabelledCloud], og.Collection]:
    """Scenes of one bank, and their collection. Nobody changes it."""
    clouds = many(12, bank=BANK, noise=0.7, common=0.3)
    return clouds, indexed(tmp_path_factory.mktemp("judged") / "scans", clouds)


def test_scores_are_those_of_each_scene_alone(judged):
    clouds, collection = judged
    for word in THINGS:
        found = collection.find(word, top=10_000)
        assert len(found) == sum(len(cloud.instances) for cloud in clouds.values())
        by_key = {(finding.scene, finding.instance): finding for finding in found}
        for name, cloud in clouds.items():
            for match in og.select(cloud, word, against=[]):
                finding = by_key[name, match.instance]
                assert finding.score == pytest.approx(match.score, abs=2e-4)
                assert (finding.calibrated, finding.points) == (True, 4)
        scores = [finding.score for finding in found]
        assert scores == sorted(scores, reverse=True)


@pytest.mark.parametrize("top", [1, 3, 40])
def test_the_best_are_found_without_scoring_all(judged, top, monkeypatch):
    monkeypatch.setattr("og_pointcloud.collection.scoring.FIRST_SCORED", 1)
    _, collection = judged
    for word in THINGS:
        everything, some = (collection.find(word, top=count) for count in (10_000, top))
        assert [(f.scene, f.instance) for f in some] == [(f.scene, f.instance) for f in everything[:top]]
        assert [f.score for f in some] == pytest.approx([f.score for f in everything[:top]], rel=1e-4)


def test_of_equals_the_first_ones_are_found():
    assert largest(np.zeros(1000), lambda rows: np.zeros(len(rows)), 3)[0].tolist() == [0, 1, 2]


def test_the_room_with_the_thing_comes_first(folder):
    things = {name: [name, *(other for other in THINGS[:3] if other != name)] for name in THINGS[3:]}
    clouds = {f"{name} room": scene(kinds, k, noise=0.1) for k, (name, kinds) in enumerate(things.items())}
    collection = indexed(folder, clouds)
    for name in things:
        best = collection.find(name)[0]
        assert (best.scene, best.instance, best.fits) == (f"{name} room", 0, True)


def test_cosines_of_two_scenes_are_not_compared_but_judged_by_the_words_that_they_share(folder):
    """One scene's features all lie near the texts, as a detector's do; the other's far from them, as an image's."""
    words = {f"word{k}": row for k, row in enumerate(unit_rows(60, WIDTH, seed=2))}
    shared = unit_rows(1, WIDTH, seed=3)[0]
    texts = {name: (row + 2 * shared) / np.linalg.norm(row + 2 * shared) for name, row in words.items()}
    images = {name: row - 2 * shared for name, row in words.items()}
    near = scene(["word1", "word2"], 0, encoder=texts, words=list(texts), noise=0.02)
    far = replace(
        scene(["word5", "word6"], 1, encoder=images, words=list(texts), noise=0.02), vocabulary=near.vocabulary
    )
    text = texts["word5"]
    assert near.instances.cosines(text[None]).max() > far.instances.cosines(text[None]).max() + 0.3
    collection = indexed(folder, {"near": near, "far": far})
    best = collection.find("word5")[0]
    assert (best.scene, best.instance, best.calibrated) == ("far", 0, True)
    assert collection.find("word1")[0].scene == "near"


def test_a_word_is_never_asked_in_the_space_of_another_encoder(folder):
    other = dict(zip(THINGS, unit_rows(len(THINGS), WIDTH, seed=77), strict=True))
    impostor = {"chair": ENCODER["chair"], "desk": ENCODER["desk"]}
    clouds = {
        "ours": scene(["chair", "desk"]),
        "same name": scene(["mug", "chair"], encoder=other, words=["mug", "chair"]),
        "other name": scene(["chair"], encoder=impostor, words=["desk"], space="another/encoder"),
        "nobody's": scene(["chair"], encoder=impostor, words=["desk"], space="unknown"),
        "nobody's too": scene(["chair"], encoder=impostor, words=[], space="unknown"),
        "of one of two": scene(["lamp"], words=[]),
    }
    collection = indexed(folder, clouds)
    found = collection.find("lamp", top=100)
    assert {finding.scene for finding in found} == {"ours"}
    assert len(found.not_asked) == 3
    assert found.not_asked[0].startswith("1 scene of feature space 'another/encoder' could not be searched for 'lamp'")
    found = collection.find("chair", top=100)
    assert {finding.scene for finding in found} == {"ours", "same name"}
    best = {finding.scene: finding.instance for finding in reversed(found)}
    assert best == {"ours": 0, "same name": 1}


def test_scenes_without_words_are_asked_in_those_of_their_kin(folder):
    collection = indexed(folder, {"a": scene(["desk"]), "b": scene(["chair"], words=[])})
    assert collection.find("chair")[0].scene == "b"
    with pytest.raises(OgPointcloudError, match=r"'chairs' is not among the 8 words .* mean 'chair'"):
        collection.find("chairs")


def test_vectors_are_asked_of_the_scenes_of_their_encoder(folder):
    clouds = {"a": scene(["desk"]), "b": scene(["chair"], space="another/encoder")}
    collection = indexed(folder, clouds)
    features = (Vocabulary(("seat",), ENCODER["chair"][None]), "another/encoder")
    assert {f.scene for f in collection.find("seat", text_features=features)} == {"b"}
    other_width = (Vocabulary(("chair",), np.ones((1, 5), np.float32)), SPACE)
    assert [f.scene for f in collection.find("chair", scenes="a", text_features=other_width)] == ["a"]
    with pytest.raises(FeatureSpaceError, match=r"names of text_features are in .*'another/encoder' \(dimension 5\)"):
        collection.find("seat", text_features=(Vocabulary(("seat",), np.ones((1, 5), np.float32)), "another/encoder"))


def test_a_file_that_is_damaged_or_of_another_encoder_by_now_encodes_no_word(folder, tmp_path):
    spaces = {SPACE: tmp_path / "ours", "another/encoder": tmp_path / "theirs"}
    for seed, (space, path) in enumerate(spaces.items()):
        write_files(path, encoder_files(space, WIDTH, seed=seed))
    for name in "ab":
        og.write_bundle(scene(["desk"]), folder / f"{name}.ogpc", text_encoder=spaces[SPACE])
    collection = indexed(folder, {})
    before = collection.find("cat").to_json()
    theirs = scene(["desk"], space="another/encoder")
    og.write_bundle(theirs, folder / "a.ogpc", text_encoder=spaces["another/encoder"])
    assert collection.find("cat").to_json() == before
    (folder / "a.ogpc").write_bytes(b"half of a file")
    assert collection.find("cat").to_json() == before
    (folder / "b.ogpc").unlink()
    with pytest.raises(OgPointcloudError, match="'cat' is not among the 8 words"):
        collection.find("cat")


def test_endings_in_capitals_are_those_of_scenes_too(folder):
    og.write_bundle(scene(["desk"]), folder / "a.ogpc").rename(folder / "a.OGPC")
    collection = indexed(folder, {})
    assert collection.file(collection.find("desk")[0].scene) == folder / "a.OGPC"
    assert len(og.segment(folder / "a.OGPC")) == 4


def test_given_vectors_are_asked_whatever_words_they_go_by(folder):
    collection = indexed(folder, {"a": scene(["desk", "chair"], bank=BANK), "b": scene(["lamp"], bank=BANK)})
    for name in ("desk", "seat"):  # also where the scenes know the word
        best = collection.find({name: 3 * ENCODER["chair"]})[0]
        expected = collection.find("chair")[0]
        assert (best.scene, best.instance, best.word) == (expected.scene, expected.instance, name) == ("a", 1, name)
        assert best.score == pytest.approx(expected.score, abs=1e-6)
    with pytest.raises(FeatureSpaceError, match=r"label vectors are .*\(dimension 5\); expected .*\(dimension 32\)"):
        collection.find({"chair": np.ones(5)})
    with pytest.raises(FeatureSpaceError, match="the vector of 'chair' is zero"):
        collection.find({"chair": np.zeros(WIDTH)})


def test_box_and_scenes_restrict(folder):
    clouds = {f"room{k}": scene(THINGS[:5], k, at=10.0 * k) for k in range(5)}
    collection = indexed(folder, clouds)
    everything = collection.find("lamp", top=100)
    low, high = np.array([9.5, -1, -1]), np.array([22.5, 1, 1])
    inside = [f for f in everything if (np.array(f.center) >= low).all() and (np.array(f.center) <= high).all()]
    assert len(inside) == 5 + 3  # of room 2 the first three
    for fresh in (collection, og.Collection(folder.parent / "atlas")):  # with all in memory, and with nothing
        found = fresh.find("lamp", within=(low, high), top=100)
        assert {(f.scene, f.instance): pytest.approx(f.score) for f in found} == {
            (f.scene, f.instance): f.score for f in inside
        }
        assert {f.scene for f in fresh.find("lamp", scenes=["room1", "room[34]"])} == {"room1", "room3", "room4"}
    random = np.random.default_rng(0)
    for _ in range(30):
        low, high = np.sort(random.uniform([-5, -1, -1], [50, 1, 1], (2, 3)), axis=0)
        inside = [f for f in everything if (np.array(f.center) >= low).all() and (np.array(f.center) <= high).all()]
        assert [(f.scene, f.instance) for f in collection.find("lamp", within=(low, high), top=100)] == [
            (f.scene, f.instance) for f in inside
        ]
    assert not collection.find("lamp", within=([500, 0, 0], [501, 1, 1]))


@pytest.mark.parametrize(("option", "values", "says"), [
    ("words", [5, None, [], ["mug", " "], [["mug"]], {}], "expected at least one word or phrase"),
    ("scenes", [5, [], [None], "", [["site0"]]], "expected at least one name or pattern, or None for all"),
    ("scenes", ["room9"], "no scene is called 'room9'"),
    ("scenes", ["Site0/room00"], r"or a pattern; did you mean 'site0/room00'[^;]*\?$"),
    ("top", [0, 2.5, "3", None], "top is .*; expected a whole number, at least 1"),
    ("within", [5, [[0, 0, 0], [1, 1]], (["a"] * 3, ["b"] * 3), ([1j] * 3, [2j] * 3), ([0, 0, 0], [0, -1, 0]),
                ([np.nan] * 3, [1] * 3)], "expected two corners of three numbers, the low one first"),
])  # fmt: skip
def test_arguments_of_other_kinds_are_one_error(judged, option, values, says):
    for value in values:
        with pytest.raises(OgPointcloudError, match=says):
            judged[1].find(**{"words": "lamp", option: value})


def test_places_are_those_of_the_instances(folder):
    cloud = scene(["chair", "desk"], at=1e6)
    found = indexed(folder, {"far away": cloud}).find("desk")[0]
    box = og.instance_table(cloud)[1].axis_aligned_box
    np.testing.assert_allclose(found.center, box.center, atol=1e-6)
    np.testing.assert_allclose(found.size, box.size, atol=1e-6)


def test_only_what_changed_is_read_again(folder, monkeypatch):
    collection = indexed(folder, many(4))
    names = collection.scenes
    link = folder / "link.ogpc"
    link.symlink_to(folder / f"{names[2]}.ogpc")
    index(folder, folder.parent / "atlas", progress=False)
    link.unlink()
    link.symlink_to("a drive that is not mounted")
    changes = index(folder, folder.parent / "atlas", progress=False)
    assert [name for name, _ in changes.left_out] == ["link"]
    link.unlink()
    assert collection.changes.added == names
    (folder / f"{names[0]}.ogpc").unlink()
    og.write_bundle(scene(["bed"], 99), folder / f"{names[1]}.ogpc")
    os.utime(folder / f"{names[2]}.ogpc")  # another date, the same content
    (folder / f"{names[3]}.ogpc").write_bytes(b"no zip")
    og.write_bundle(scene(["rug"], 98), folder / "new.ogpc")
    read = []
    from og_pointcloud.collection import index as module

    original = module.read_bundle
    monkeypatch.setattr(module, "read_bundle", lambda path: read.append(path.stem) or original(path))
    changes = index(folder, folder.parent / "atlas", progress=False)
    assert sorted(read) == sorted([Path(names[1]).name, Path(names[3]).name, "new"])
    assert (changes.added, changes.replaced, changes.removed) == (("new",), (names[1],), (names[0],))
    assert [name for name, _ in changes.left_out] == [names[3]]
    assert changes.unchanged == 1
    fresh = og.Collection.index(folder, folder.parent / "other", progress=False)
    again = og.Collection(folder.parent / "atlas")
    assert set(again.scenes) == {names[1], names[2], "new"}
    for word in THINGS:
        assert again.find(word, top=100).to_json() == fresh.find(word, top=100).to_json()


@pytest.mark.skipif(sys.platform != "linux", reason="other systems refuse such a name")
def test_a_file_whose_name_is_no_text_is_left_out(folder):
    indexed(folder, {"a": scene(["desk"])})
    shutil.copy(folder / "a.ogpc", os.fsencode(folder) + b"/\xff.ogpc")
    changes = index(folder, folder.parent / "atlas", progress=False)
    assert changes.left_out == (("\udcff", "its name has bytes that are not UTF-8: rename the file or folder"),)
    assert changes.unchanged == 1


def test_scenes_are_judged_as_long_as_their_kin_knows_enough_words(folder):
    words = {f"word{k}": row for k, row in enumerate(unit_rows(60, WIDTH, seed=2))}
    clouds = {
        "many": scene(["word1"], encoder=words, words=words),
        "few": scene(["word2"], encoder=words, words=["word2"]),
    }
    assert indexed(folder, clouds).find("word2")[0].calibrated
    (folder / "many.ogpc").unlink()
    (best,) = indexed(folder, {}).find("word2")
    assert (best.scene, best.calibrated) == ("few", False)


def test_a_change_that_fails_leaves_the_atlas_as_it_was(folder, monkeypatch):
    collection = indexed(folder, many(4))
    before = collection.find("chair", top=100).to_json()
    content = (folder.parent / "atlas").read_bytes()
    og.write_bundle(scene(["chair"], 50), folder / "late.ogpc")
    monkeypatch.setattr("og_pointcloud.collection.index.judge_scenes", lambda atlas: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        index(folder, folder.parent / "atlas", progress=False)
    with pytest.raises(ZeroDivisionError):
        index(folder, folder.parent / "new atlas", progress=False)
    assert not (folder.parent / "new atlas").exists()
    assert (folder.parent / "atlas").read_bytes() == content
    assert og.Collection(folder.parent / "atlas").find("chair", top=100).to_json() == before


def test_tough_scenes(folder):
    empty = replace(scene(["chair"]), xyz=np.zeros((0, 3), np.float32), instance_ids=np.zeros(0, np.int32))
    nothing = replace(scene(["chair"]), instances=instance_table(0, width=0), instance_ids=np.full(4, -1, np.int32))
    plain = replace(scene(["chair", "desk"]), instances=instance_table(2, [], WIDTH), vocabulary=None)
    clouds = {"no points": empty, "no instance": nothing, "no descriptor": plain, "good": scene(["desk"])}
    found = indexed(folder, clouds).find("desk", top=100)
    assert [finding.scene for finding in found] == ["good"]
    (folder / "none").mkdir()
    with pytest.raises(OgPointcloudError, match=r"has no \.ogpc files"):
        og.Collection.index(folder / "none", folder.parent / "atlas")


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        ("CREATE VIEW trap AS SELECT 1", "schema"),
        ("CREATE TRIGGER trap AFTER UPDATE ON scenes BEGIN DELETE FROM scenes; END", "schema"),
        ("DROP TABLE judgements", "schema"),
        ("PRAGMA user_version = 9", "version"),
        ("PRAGMA application_id = 0", "version"),
        ("UPDATE judgements SET judge = (SELECT vocabulary FROM scenes)", "at least 50"),
        ("UPDATE scenes SET name = x'ff' WHERE id = 1", "UTF-8"),
        ("UPDATE scenes SET descriptors = zeroblob(7)", "buffer|reshape"),
        ("UPDATE scenes SET instances = zeroblob(0)", "must ascend within"),
        ("UPDATE scenes SET owner = randomblob(length(owner))", "must ascend within"),
        ("UPDATE words SET names = '[1, 2]'", "reshape"),
        ("UPDATE words SET vectors = 5", "buffer|bytes-like"),
        ("UPDATE words SET width = 1e300", "."),
        ("UPDATE judgements SET sharpness = 'x'", "the judgement of 'site"),
        ("UPDATE judgements SET standard = CAST(x'0000c07f' || substr(standard, 5) AS BLOB)", "NaN"),
    ],
)
def test_hostile_atlases_are_refused(judged, tmp_path, change, cause):
    path = tmp_path / "atlas"
    shutil.copy(judged[1].path, path)
    with sqlite3.connect(path) as connection:
        connection.execute(change)
    connection.close()
    with pytest.raises(OgPointcloudError, match=cause) as caught:
        og.Collection(path).find("chair")
    assert str(caught.value).startswith(f"{path} is not a usable atlas")
    assert "remove" not in str(caught.value)  # it may be another file of the user's


def test_damaged_bytes_are_refused_or_answered(judged, tmp_path):
    path, content, random = tmp_path / "atlas", judged[1].path.read_bytes(), np.random.default_rng(0)
    refused = 0
    for _ in range(60):
        damaged = np.frombuffer(content, np.uint8).copy()
        damaged[random.integers(0, len(damaged), 40)] = random.integers(0, 256, 40)
        path.write_bytes(damaged.tobytes()[: random.integers(1, len(damaged) + 1)])
        try:
            og.Collection(path).find("chair")
        except OgPointcloudError:
            refused += 1
    assert refused > 20


def test_a_schema_of_damaged_letters_is_refused(judged, tmp_path):
    """SQLite quotes them in its error, which Python cannot decode."""
    path = tmp_path / "atlas"
    path.write_bytes(judged[1].path.read_bytes().replace(b"NOT NULL", b"NOT NUL\xec"))
    with pytest.raises(OgPointcloudError, match=r"is not a usable atlas .*: give og-pointcloud index an atlas"):
        og.Collection(path)


def test_other_files_are_no_atlas(tmp_path):
    for content in (b"", b"text", b"SQLite format 3\0" + bytes(100)):
        (tmp_path / "atlas").write_bytes(content)
        with pytest.raises(OgPointcloudError, match="not a usable atlas"):
            og.Collection(tmp_path / "atlas")
    with pytest.raises(OgPointcloudError, match="not a file"):
        og.Collection(tmp_path / "nothing")
    with pytest.raises(OgPointcloudError, match="is a folder or a device"), Atlas.writing("."):
        pass


def test_readers_see_the_atlas_before_a_change_or_after_it(folder):
    collection = indexed(folder, many(3))
    with Atlas.writing(folder.parent / "atlas") as atlas:
        atlas.remove(collection.scenes[0])
        assert og.Collection(folder.parent / "atlas").scenes == collection.scenes
    assert og.Collection(folder.parent / "atlas").scenes == collection.scenes[1:]


def killed_in_a_change(folder: Path, target: Path) -> str:
    """Copy an atlas and its journal as a kill in the middle of a change leaves them; returns an answer from before."""
    collection = indexed(folder, many(3))
    before, content = collection.find("chair", top=100).to_json(), collection.path.read_bytes()
    with Atlas.writing(collection.path) as atlas:
        atlas._run("PRAGMA cache_size = 2")  # so that SQLite writes to the file before the change ends
        atlas.remove(collection.scenes[0])
        atlas.add_words(("",) * 2000, np.ones((2000, 16), np.float32))
        target.mkdir()
        for name in ("atlas", "atlas-journal"):
            shutil.copy(folder.parent / name, target / name)
    assert (target / "atlas").read_bytes() != content
    return before


def test_readers_see_the_atlas_before_a_change_that_was_killed(folder, tmp_path):
    before, killed = killed_in_a_change(folder, tmp_path / "killed"), tmp_path / "killed"
    assert og.Collection(killed / "atlas").find("chair", top=100).to_json() == before
    assert [file.name for file in killed.iterdir()] == ["atlas"]


def test_a_killed_change_that_cannot_be_undone_is_told(folder, tmp_path, monkeypatch):
    killed_in_a_change(folder, tmp_path / "killed")
    connect = sqlite3.connect
    monkeypatch.setattr(sqlite3, "connect", lambda path, **options: connect(path.replace("=rw", "=ro"), **options))
    with pytest.raises(OgPointcloudError, match="a killed index run may have to be undone: run og-pointcloud index"):
        og.Collection(tmp_path / "killed" / "atlas")


def test_a_journal_deletes_no_other_file(folder, tmp_path):
    """SQLite removes the "super-journal" that a journal names at its end, once the change is undone."""
    killed_in_a_change(folder, tmp_path / "killed")
    precious, journal = tmp_path / "precious", tmp_path / "killed" / "atlas-journal"
    precious.write_text("mine")
    name = os.fsencode(precious)
    page = (1 << 30) // int.from_bytes(journal.read_bytes()[24:28], "big") + 1
    numbers = [number.to_bytes(4, "big") for number in (page, len(name), sum(name))]
    with journal.open("ab") as file:
        file.write(numbers[0] + name + b"".join(numbers[1:]) + SUPER_JOURNAL_MARK)
    for use in (og.Collection, lambda path: index(folder, path, progress=False)):
        with pytest.raises(OgPointcloudError, match="atlas-journal names another file, which would be deleted"):
            use(tmp_path / "killed" / "atlas")
    assert precious.read_text() == "mine"


def test_a_full_disk_leaves_nothing_of_a_new_atlas(tmp_path):
    resource = pytest.importorskip("resource")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, limits[1]))
    try:
        with pytest.raises(OgPointcloudError, match="is unchanged"), Atlas.writing(tmp_path / "atlas") as atlas:
            atlas.add_words(("",) * 2000, np.ones((2000, 1024), np.float32))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert list(tmp_path.iterdir()) == []


def test_of_two_who_make_an_atlas_at_a_time_neither_removes_it(tmp_path, monkeypatch):
    monkeypatch.setattr("og_pointcloud.collection.store.LOCK_TIMEOUT_S", 0.1)
    path, journal = tmp_path / "atlas", tmp_path / "atlas-journal"
    journal.write_bytes(bytes(600))  # of an atlas that was removed
    with Atlas.writing(path) as first:
        first.note("root", str(tmp_path / "a"))
        with Atlas.writing(path) as second:
            second.note("root", str(tmp_path / "b"))
        with pytest.raises(ZeroDivisionError), Atlas.writing(path) as third:
            third.note("root", str(tmp_path / str(1 // 0)))
        with Atlas.reading(path) as atlas:
            assert atlas.root == tmp_path / "b"
    with Atlas.reading(path) as atlas:
        assert atlas.root == tmp_path / "a"
    assert [file.name for file in tmp_path.iterdir()] == ["atlas"]


def test_an_open_collection_notices_a_changed_atlas(folder):
    collection = indexed(folder, {"a": scene(["desk"]), "b": scene(["chair"], 1)})
    assert collection.find("chair")[0].scene == "b"
    (folder / "b.ogpc").unlink()
    indexed(folder, {"c": scene(["lamp", "chair"], 2)})
    assert collection.scenes == ("a", "b")
    assert collection.find("chair")[0].scene == "c"
    assert collection.scenes == ("a", "c")
    collection.path.unlink()
    with pytest.raises(OgPointcloudError, match="is not a file; expected an atlas"):
        collection.find("chair")


def test_an_atlas_that_changes_while_it_is_asked_is_asked_again(folder, monkeypatch):
    collection = indexed(folder, {"a": scene(["desk"]), "b": scene(["chair"], 1)})
    vectors = og.Collection._vectors

    def slow(*arguments):
        monkeypatch.undo()
        indexed(folder, {"b": scene(["lamp"], 3), "c": scene(["lamp", "chair"], 2)})
        return vectors(*arguments)

    monkeypatch.setattr(og.Collection, "_vectors", slow)
    assert collection.find("chair", scenes=iter(["?"]))[0].scene == "c"
    monkeypatch.setattr(og.Collection, "_vectors", lambda *_: og.Collection(folder))  # an error of its own
    with pytest.raises(OgPointcloudError, match="is not a file"):
        collection.find("chair")


def test_commands(folder, capsys, tmp_path, monkeypatch):
    for k, things in enumerate((["chair", "mug"], ["desk"])):
        og.write_bundle(scene(things, k), folder / f"room{k}.ogpc")
    (folder / "broken.ogpc").write_bytes(b"x")
    atlas, page = str(tmp_path / "atlas"), tmp_path / "found.html"
    with monkeypatch.context() as context:  # a minute for each thousand words of a data set's list
        context.setattr(og.Collection, "find", None)
        code, out, err = run(capsys, "index", folder, "-o", atlas)
    assert code == 0
    assert f"2 added, 1 left out, 0 unchanged: 2 scenes with 3 instances in {atlas}" in out
    assert re.fullmatch(rf"Collection\('{re.escape(atlas)}': 2 scenes, \d+ words\)", repr(og.Collection(atlas)))
    assert out.splitlines()[-1].split()[-1] in ("chair", "mug"), "not 'bed', the first of all words"
    assert "broken is left out" in err
    (folder / "one").mkdir()
    og.write_bundle(scene(["desk"], 1), folder / "one" / "room.ogpc")
    assert "1 added, 0 unchanged: 1 scene with 1 instance in" in output_of(
        capsys, "index", folder / "one", "-o", tmp_path / "one"
    )
    (folder / "one" / "room.ogpc").unlink()
    records = json.loads(output_of(capsys, "find", atlas, "mug", "--json", "--html", page))
    assert list(records[0]) == ["scene", "instance", "word", "score", "center", "size"]
    assert (records[0]["scene"], records[0]["instance"], records[0]["word"]) == ("room0", 1, "mug")
    assert len(records) == 3
    text = page.read_text()
    assert text.count("data:image/png;base64,") == 3
    assert ("1 of these 3 fit" in text, text.count("class=misfit")) == (True, 2)
    assert "1 of these 3 fit" in output_of(capsys, "find", atlas, "mug")
    assert "room1" in output_of(capsys, "find", atlas, "mug", "--scene", "room1", "--top", "1")
    assert "nothing was found" in output_of(capsys, "find", atlas, "mug", "--within", "5,5,5,6,6,6")
    for scenes, says in (("room0", False), ("room1", True)):  # the latter has a desk alone
        said = output_of(capsys, "find", atlas, "mug", "--scene", scenes)
        assert (("nothing fits: no score" in said), ("next: " in said)) == (says, not says)
    (folder / "room0.ogpc").unlink()
    said = output_of(capsys, "find", atlas, "mug")
    assert (f"{folder / 'room0.ogpc'} no longer exists" in said, "next: " in said) == (True, False)
    (folder / "bad").mkdir()
    (folder / "bad" / "x.ogpc").write_bytes(b"x")
    assert "none of 1 file could be read" in error_of(capsys, "index", folder / "bad", "-o", tmp_path / "bad")
    for path in (folder / "bad" / "x.ogpc", folder / "nowhere"):
        assert f"'{path}' is not a folder" in error_of(capsys, "index", path, "-o", tmp_path / "bad")
    assert "<b>mug" in error_of(capsys, "find", atlas, "<b>mug", "--html", page)
    output_of(capsys, "find", atlas, "mug", "--html", page)
    assert "file not found" in page.read_text()


def test_pictures_show_the_thing(tmp_path):
    import cv2

    from og_pointcloud.collection.collection import Finding

    random = np.random.default_rng(0)
    xyz = np.concatenate([0.2 * random.random((4000, 3)), random.random((4000, 3)) * [1, 1, 0.01]]).astype(np.float32)
    ids = np.repeat(np.array([0, -1], np.int32), 4000)
    table = instance_table(1)
    cloud = LabelledCloud(xyz, np.array([1e6, 0, 0]), ids, table, "s", 0.01, 0.1)
    thing = Finding("s", 0, "x", 1.0, (1e6 + 0.1, 0.1, 0.1), (0.2, 0.2, 0.2), 4000, True, True)
    shown = cv2.imdecode(np.frombuffer(picture(cloud, thing), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    orange = (np.abs(shown.astype(int) - (214, 90, 40)) < 3).all(axis=2)
    assert 0.05 < orange.mean() < 0.6
    assert orange[80:120, 80:120].mean() > 0.9
    image = random.integers(0, 256, (7, 5, 3)).astype(np.uint8)
    np.testing.assert_array_equal(cv2.imdecode(np.frombuffer(png_bytes(image), np.uint8), 1)[..., ::-1], image)


def test_without_lancedb_the_extra_is_named(folder, capsys, tmp_path, monkeypatch):
    og.write_bundle(scene(["desk"]), folder / "a.ogpc")
    for module in ("lancedb", "pyarrow"):
        monkeypatch.setitem(sys.modules, module, None)
    error = error_of(capsys, "index", folder, "-o", tmp_path / "atlas", "--lance", tmp_path / "lance")
    assert "og-pointcloud[lance]" in error


def test_what_lance_has_of_an_atlas_that_changed_since_is_refused(folder, tmp_path, monkeypatch):
    indexed(folder, many(3))
    atlas, uri = folder.parent / "atlas", tmp_path / "lance"
    uri.mkdir()
    database = MagicMock()
    database.create_table.return_value.count_rows.return_value = 0
    monkeypatch.setattr("og_pointcloud.collection.lance._database", lambda uri: database)
    monkeypatch.setitem(sys.modules, "pyarrow", MagicMock())
    with pytest.raises(OgPointcloudError, match=r"the current .*: write it again with og-pointcloud index --lance"):
        og.Collection(atlas, lance=str(uri))
    write_lance(atlas, str(uri))
    monkeypatch.chdir(tmp_path)
    collection = og.Collection(atlas, lance="lance")
    og.write_bundle(scene(["bed"], 99), folder / "new.ogpc")
    index(folder, atlas, progress=False)
    with pytest.raises(OgPointcloudError, match=r"the current .*: write it again with og-pointcloud index --lance"):
        collection.find("bed")


@pytest.mark.slow
def test_lance_proposes_what_the_exact_search_finds(folder, tmp_path, capsys, monkeypatch):
    pytest.importorskip("lancedb", reason="needs the extra 'lance': lancedb")
    clouds = many(9, bank=BANK, noise=0.5) | {"cosines": scene(["bed", "rug"], 8, space="another/encoder")}
    exact = indexed(folder, clouds)
    uri, atlas = str(tmp_path / "lance"), str(folder.parent / "atlas")
    output_of(capsys, "index", folder, "-o", atlas, "--lance", uri)
    proposed = og.Collection(atlas, lance=uri)
    monkeypatch.setattr("og_pointcloud.collection.collection.MAX_EXACT_SCENES", 0)
    box = ([1.5, -1, -1], [9, 1, 1])
    for options in ({}, {"within": box}, {"scenes": "site1/*"}, {"within": ([50, 50, 50], [51, 51, 51])}):
        for word in THINGS:
            expected, found = (c.find(word, top=5, **options) for c in (exact, proposed))
            assert [(f.scene, f.instance) for f in found] == [(f.scene, f.instance) for f in expected]
            assert [f.score for f in found] == pytest.approx([f.score for f in expected], abs=1e-6)
    monkeypatch.undo()
    monkeypatch.setattr("og_pointcloud.collection.lance.LanceTables.propose", None)  # a few scenes are asked exactly
    some = [found.find("bed", top=5, scenes="site1/*") for found in (exact, proposed)]
    assert [(f.scene, f.instance) for f in some[0]] == [(f.scene, f.instance) for f in some[1]]
    monkeypatch.undo()
    assert len(json.loads(output_of(capsys, "find", atlas, "bed", "--lance", uri, "--json", "--top", "1"))) == 1
    with pytest.raises(OgPointcloudError, match="is not a folder; expected one that og-pointcloud index --lance wrote"):
        og.Collection(atlas, lance=str(tmp_path / "other")).find("bed")
    assert not (tmp_path / "other").exists()
    (tmp_path / "other").mkdir()
    with pytest.raises(OgPointcloudError, match=r"the current .*: write it again with og-pointcloud index --lance"):
        og.Collection(atlas, lance=str(tmp_path / "other"))
