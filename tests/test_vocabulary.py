"""Words and encoders stored in a .ogpc: added, listed, carried, and everything else left as it was."""

from __future__ import annotations

import json
import zlib
from dataclasses import replace
from shutil import copytree, ignore_patterns

import numpy as np
import pytest
from commands import error_of
from hostile_files import forged, members_of
from labelled_clouds import SPACE, WIDTH, WORDS, instance_table, make_cloud, reference_scores, room, unit_rows
from og_pointcloud_export import write_bundle
from scenes import write_tiny_capture
from text_models import encoder_files, write_files

import og_pointcloud as og
from og_pointcloud.bundle.read import read_bundle, read_carried_encoder
from og_pointcloud.bundle.vocabulary import add_words, carried_encoder, carry_encoder, store_bank
from og_pointcloud.cli import main
from og_pointcloud.cloud import Vocabulary, WordBank
from og_pointcloud.errors import FeatureSpaceError, OgPointcloudError
from og_pointcloud.formats.npy import npy_bytes
from og_pointcloud.text.encoder import TextEncoder, encoder_for, read_text_encoder
from og_pointcloud.text.text_features import everyday_words, read_words
from og_pointcloud.text.words import resolve_labels

NEW = Vocabulary(("grape", "Größe 40"), 3 * unit_rows(2, seed=9))


@pytest.fixture(scope="module")
def without_words(tmp_path_factory):
    return write_bundle(replace(room(300), vocabulary=None), tmp_path_factory.mktemp("bundle") / "bare.ogpc")


@pytest.fixture(scope="module")
def bundle_file(tmp_path_factory):
    return write_bundle(room(300), tmp_path_factory.mktemp("bundle") / "room.ogpc")


@pytest.fixture
def path(bundle_file, tmp_path):
    (tmp_path / "s.ogpc").write_bytes(bundle_file.read_bytes())
    return tmp_path / "s.ogpc"


def manifest_of(encoder_folder):
    return json.loads((encoder_folder / "manifest.json").read_text())


def test_added_words_can_be_asked(path):
    done = add_words(path, NEW, SPACE)
    assert len(done.names) == len(WORDS) + 2
    bundle = read_bundle(path)
    assert bundle.cloud.vocabulary.names == (*WORDS, *NEW.names)
    assert np.abs(bundle.cloud.vocabulary.vectors[-2:] - NEW.vectors / 3).max() < 1e-3
    assert bundle.manifest["counts"]["words"] == len(WORDS) + 2
    asked = og.segment(og.load(path), ["grape", "apple"])
    given = og.segment(og.load(path), {"grape": NEW.vectors[0], "apple": unit_rows(5, seed=0)[0]})
    assert (asked.labels == given.labels).all()


def test_all_else_stays_byte_for_byte(path, bundle_file):
    add_words(path, NEW, SPACE)
    before, after = members_of(bundle_file), members_of(path)
    assert list(before) == list(after)
    changed = {name for name in before if before[name] != after[name]}
    assert changed == {"manifest.json", "vocabulary/names.json", "vocabulary/vectors.npy"}
    old, new = json.loads(before["manifest.json"]), json.loads(after["manifest.json"])
    assert {key for key in old if old[key] != new[key]} <= {"counts", "members", "parity"}


def test_adding_again_gives_the_new_vector_and_no_second_word(path):
    add_words(path, NEW, SPACE)
    done = add_words(path, Vocabulary(("grape", "fig"), unit_rows(2, seed=11)), SPACE)
    assert len(done.names) == len(WORDS) + 3
    vocabulary = read_bundle(path).cloud.vocabulary
    assert vocabulary.names == (*WORDS, *NEW.names, "fig")
    assert np.abs(vocabulary.vectors[len(WORDS)] - unit_rows(2, seed=11)[0]).max() < 1e-3


def test_a_file_without_words_gets_some(without_words, tmp_path):
    assert add_words(without_words, NEW, SPACE, tmp_path / "t.ogpc").names == NEW.names
    assert read_bundle(tmp_path / "t.ogpc").cloud.vocabulary.names == NEW.names
    assert read_bundle(without_words).cloud.vocabulary is None


def test_words_of_another_space_or_width_change_nothing(path, bundle_file):
    with pytest.raises(FeatureSpaceError, match="words are in feature space 'other' \\(dimension 16\\)"):
        add_words(path, NEW, "other")
    with pytest.raises(FeatureSpaceError, match="dimension 8"):
        add_words(path, Vocabulary(("a",), unit_rows(1, 8)), SPACE)
    assert path.read_bytes() == bundle_file.read_bytes()
    assert add_words(path, NEW, "unknown").names[-2:] == NEW.names


def test_words_of_another_width_change_nothing_where_no_instance_is_described(tmp_path):
    described = instance_table(1)
    bare = replace(described, descriptors=np.zeros((0, 0), np.float32), descriptor_instance=np.zeros(0, np.int32))
    path = write_bundle(make_cloud(np.zeros((1, 3)), [0], instances=bare), tmp_path / "bare.ogpc")
    with pytest.raises(FeatureSpaceError, match=r"the words are in .*\(dimension 8\); expected .*\(dimension"):
        add_words(path, Vocabulary(("a",), unit_rows(1, 8)), SPACE)
    assert og.load(path).vocabulary.names == tuple(WORDS)


def test_a_word_that_no_reader_takes_changes_nothing(path, bundle_file):
    """As of a file that is not one word a line, but one line of words."""
    with pytest.raises(OgPointcloudError, match="has 1001 characters; expected whole ones, at most 1000"):
        add_words(path, Vocabulary(("grape", "x" * 1001), unit_rows(2)), SPACE)
    assert path.read_bytes() == bundle_file.read_bytes()


def test_best_cosines_are_those_of_the_graphs_reference():
    table = instance_table(6, [0, 0, 1, 3, 3, 5])
    text = np.concatenate([4 * unit_rows(7, seed=3), np.zeros((1, WIDTH), np.float32)])
    assert np.abs(table.cosines(text.astype(np.float64)) - reference_scores(table, text)).max() < 1e-12


def test_words_of_a_file(tmp_path):
    (tmp_path / "w.txt").write_bytes("\ufeffchair\r\n\n  red mug \nchair\nGröße\n".encode())
    assert read_words(tmp_path / "w.txt") == ("chair", "red mug", "Größe")
    for content, says in ((b"\n \n", "has no words"), (b"\xff\xfe", "cannot be read as words")):
        (tmp_path / "w.txt").write_bytes(content)
        with pytest.raises(OgPointcloudError, match=says):
            read_words(tmp_path / "w.txt")
    with pytest.raises(OgPointcloudError, match="cannot be read as words"):
        read_words(tmp_path / "absent.txt")


def run(*arguments):
    return main(["vocabulary", *map(str, arguments)])


def test_the_command_adds(path, tmp_path, capsys):
    np.savez(
        tmp_path / "f.npz", names=np.array([*NEW.names, "apple"]), vectors=unit_rows(3, seed=9), feature_space=SPACE
    )
    assert run("add", path, "--text-features", tmp_path / "f.npz", "-o", tmp_path / "t.ogpc") == 0
    assert capsys.readouterr().out == f"wrote {tmp_path / 't.ogpc'}: 7 words\n"
    assert og.load(tmp_path / "t.ogpc").vocabulary.names == (*WORDS, *NEW.names)
    assert run("add", path, "--text-features", tmp_path / "f.npz") == 0
    assert main(["info", str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out.partition("\n")[2])["words"] == [*WORDS, *NEW.names]


def test_what_the_command_cannot_add(path, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("OG_POINTCLOUD_MODELS", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "w.txt").write_text("grape\nsofa\nlamp\n")
    for arguments, says in (
        ((tmp_path / "w.txt",), f"export text MODEL_FOLDER --feature-space {SPACE}"),
        ((tmp_path / "w.txt", "--text-encoder", tmp_path), "has no manifest.json"),
        ((tmp_path / "w.txt", "-o", tmp_path / "t.zip"), "expected a name that ends in .ogpc"),
    ):
        assert says in error_of(capsys, "vocabulary", "add", path, *arguments)
    for arguments in ((), ("w.txt", "--text-features", "a.npz"), ("--text-features", "a.npz", "--text-encoder", "b")):
        with pytest.raises(SystemExit):
            run("add", path, *arguments)


# Word banks


def test_the_everyday_words_are_many_plain_and_different():
    words = everyday_words()
    assert len(words) >= 800
    assert all(word == word.strip().lower() and word.isascii() and len(word.split()) <= 4 for word in words)
    assert not set(words) & {"object", "things", "stuff", "texture"}


def test_a_stored_bank_is_the_scenes_and_all_else_stays(path, bundle_file, tmp_path):
    bank = WordBank(5 * unit_rows(80, seed=20))
    assert read_bundle(path).cloud.word_bank is None
    store_bank(path, bank, SPACE, tmp_path / "t.ogpc")
    assert path.read_bytes() == bundle_file.read_bytes()
    bundle = read_bundle(tmp_path / "t.ogpc")
    assert bundle.manifest["members"]["bank/vectors.npy"] | {"sha256": ""} == {
        "bytes": 128 + 80 * WIDTH * 2, "sha256": "", "dtype": "<f2", "shape": [80, WIDTH],
    }  # fmt: skip
    assert np.abs(bundle.cloud.word_bank.vectors - bank.vectors).max() < 1e-3
    before, after = members_of(bundle_file), members_of(tmp_path / "t.ogpc")
    assert {name for name in after if before.get(name) != after[name]} == {"manifest.json", "bank/vectors.npy"}
    again = WordBank(unit_rows(60, seed=21))
    store_bank(tmp_path / "t.ogpc", again, SPACE)
    assert len(read_bundle(tmp_path / "t.ogpc").cloud.word_bank.vectors) == 60


def test_the_writer_stores_a_clouds_bank(tmp_path):
    bank = WordBank(unit_rows(80, seed=20))
    path = write_bundle(replace(room(100), word_bank=bank), tmp_path / "s.ogpc")
    assert np.abs(read_bundle(path).cloud.word_bank.vectors - bank.vectors).max() < 1e-3
    with pytest.raises(
        FeatureSpaceError, match=rf"bank's vectors .*\(dimension 8\); expected .*{SPACE}' \(dimension {WIDTH}\)"
    ):
        replace(room(100), word_bank=WordBank(unit_rows(80, 8)))


def test_the_command_stores_a_bank_of_text_features(path, tmp_path, capsys):
    names = np.array([f"word {number}" for number in range(60)])
    np.savez(tmp_path / "f.npz", names=names, vectors=unit_rows(60, seed=3), feature_space=SPACE)
    assert run("bank", path, tmp_path / "f.npz", "-o", tmp_path / "t.ogpc") == 0
    assert "60 everyday words" in capsys.readouterr().out
    assert len(read_bundle(tmp_path / "t.ogpc").cloud.word_bank.vectors) == 60
    before = path.read_bytes()
    np.savez(tmp_path / "few.npz", names=names[:49], vectors=unit_rows(49), feature_space=SPACE)
    np.savez(tmp_path / "other.npz", names=names, vectors=unit_rows(60), feature_space="other")
    for arguments, says in (
        ((tmp_path / "few.npz",), "few.npz: a word bank of 49 words; expected at least 50"),
        ((tmp_path / "other.npz",), "words of the bank are in feature space 'other'"),
        ((), f"export text MODEL_FOLDER --feature-space {SPACE}"),
        ((tmp_path / "f.npz", "--text-encoder", tmp_path), "from one source: F.npz, or --text-encoder DIR"),
    ):
        assert says in error_of(capsys, "vocabulary", "bank", path, *arguments)
    assert path.read_bytes() == before


# Carried encoders


@pytest.fixture(scope="module")
def encoder_folder(tmp_path_factory):
    """An encoder of the room's feature space and width."""
    return write_files(tmp_path_factory.mktemp("encoders") / "room", encoder_files(SPACE, WIDTH))


def test_the_command_encodes_words(path, tmp_path, encoder_folder, monkeypatch, capsys):
    (tmp_path / "w.txt").write_text("cat\nlow\n")
    assert run("add", path, tmp_path / "w.txt", "--text-encoder", encoder_folder) == 0
    monkeypatch.setenv("OG_POINTCLOUD_MODELS", str(encoder_folder))
    vectors = encoder_for(SPACE)(["cat", "low"])
    assert np.abs(read_bundle(path).cloud.vocabulary.vectors[-2:] - vectors).max() < 1e-3
    (tmp_path / "w.txt").write_text("lower\n")
    assert run("add", path, tmp_path / "w.txt") == 0
    assert "8 words" in capsys.readouterr().out


def test_an_encoder_brings_its_bank(path, encoder_folder, tmp_path, monkeypatch, capsys):
    encoder = read_text_encoder(encoder_folder)
    assert manifest_of(encoder_folder)["files"]["word_bank.npy"]["bytes"] == 128 + 2 * WIDTH * len(everyday_words())
    assert run("bank", path, "--text-encoder", encoder_folder, "-o", tmp_path / "t.ogpc") == 0
    assert f"{len(everyday_words())} everyday words" in capsys.readouterr().out
    monkeypatch.setenv("OG_POINTCLOUD_MODELS", str(encoder_folder))
    assert run("bank", path) == 0
    assert path.read_bytes() == (tmp_path / "t.ogpc").read_bytes()
    found = write_bundle(room(100), tmp_path / "found.ogpc")
    monkeypatch.delenv("OG_POINTCLOUD_MODELS")
    for written in (path, found, write_bundle(room(100), tmp_path / "s.ogpc", text_encoder=encoder_folder)):
        assert np.abs(read_bundle(written).cloud.word_bank.vectors - encoder.word_bank.vectors).max() < 1e-3
    own = replace(room(100), word_bank=WordBank(unit_rows(80)))
    assert (
        len(read_bundle(write_bundle(own, tmp_path / "s.ogpc", text_encoder=encoder_folder)).cloud.word_bank.vectors)
        == 80
    )


@pytest.mark.slow
def test_fit_stores_the_bank_asked_for_else_its_own_else_the_encoders(encoder_folder, tmp_path, monkeypatch, capsys):
    folder, path = write_tiny_capture(tmp_path / "capture").folder, tmp_path / "s.ogpc"
    names = np.array([f"word {number}" for number in range(60)])
    for name, count, width, space in (("f", 60, WIDTH, SPACE), ("few", 49, WIDTH, SPACE), ("wide", 60, 20, SPACE),
                                      ("other", 60, WIDTH, "other")):  # fmt: skip
        np.savez(tmp_path / f"{name}.npz", names=names[:count], vectors=unit_rows(count, width), feature_space=space)

    def fit(*arguments):
        return main(["fit", str(folder), "-o", str(path), *map(str, arguments)])

    for bank, says in (("few", "a word bank of 49"), ("wide", "(dimension 20);"), ("other", "space 'other'")):
        assert fit("--word-bank", tmp_path / f"{bank}.npz") == 2
        assert says in capsys.readouterr().err
        assert not path.exists()
    assert fit() == 0
    assert f"og-pointcloud vocabulary bank {path} [WORDS.npz]" in capsys.readouterr().out
    assert read_bundle(path).cloud.word_bank is None
    monkeypatch.setenv("OG_POINTCLOUD_MODELS", str(encoder_folder))
    for arguments, count in (((), len(everyday_words())), (("--word-bank", tmp_path / "f.npz"), 60)):
        assert fit(*arguments) == 0
        assert "vocabulary bank" not in capsys.readouterr().out
        assert len(read_bundle(path).cloud.word_bank.vectors) == count
    # The capture's own comes before the encoder's, if it is of the masks' space.
    for bank, left_out, count in (("f", [], 60), ("other", ["word bank"], len(everyday_words()))):
        (folder / "word_bank.npz").write_bytes((tmp_path / f"{bank}.npz").read_bytes())
        assert fit() == 0
        cloud = read_bundle(path).cloud
        assert len(cloud.word_bank.vectors) == count
        assert [entry["key"] for entry in cloud.provenance["left_out"] if entry["key"] == "word bank"] == left_out
    (folder / "word_bank.npz").unlink()
    torn = copytree(encoder_folder, tmp_path / "torn")
    (torn / "tokenizer.json").write_bytes(b"torn")
    monkeypatch.setenv("OG_POINTCLOUD_MODELS", str(torn))
    before = path.read_bytes()
    assert fit() == 2
    assert "tokenizer.json does not match the manifest's checksum" in capsys.readouterr().err
    assert path.read_bytes() == before


def test_an_encoder_made_without_a_bank_has_none(path, encoder_folder, tmp_path, capsys):
    folder = copytree(encoder_folder, tmp_path / "bare", ignore=ignore_patterns("word_bank.npy"))
    with pytest.raises(OgPointcloudError, match=r"'word_bank\.npy' is missing"):
        read_text_encoder(folder)
    manifest = manifest_of(folder)
    del manifest["files"]["word_bank.npy"]
    (folder / "manifest.json").write_text(json.dumps(manifest))
    assert read_text_encoder(folder).word_bank is None
    bank = (encoder_folder / "word_bank.npy").read_bytes()
    with pytest.raises(OgPointcloudError, match=r"'word_bank\.npy' is missing"):  # of the manifest's files
        TextEncoder({path.name: path.read_bytes() for path in folder.iterdir()} | {"word_bank.npy": bank}, "here")
    line = error_of(capsys, "vocabulary", "bank", path, "--text-encoder", folder)
    assert "has no word bank: make it again" in line
    carry_encoder(path, folder)
    assert read_bundle(path).cloud.word_bank is None


@pytest.mark.parametrize("bank", [b"junk", unit_rows(80), unit_rows(80, 8).astype("<f2"), unit_rows(9).astype("<f2")])
def test_banks_of_encoders_are_checked(encoder_folder, tmp_path, bank):
    data = bank if isinstance(bank, bytes) else npy_bytes(bank)
    manifest = manifest_of(encoder_folder)
    manifest["files"]["word_bank.npy"] = {"crc32": zlib.crc32(data)}
    folder = copytree(encoder_folder, tmp_path / "other")
    (folder / "word_bank.npy").write_bytes(data)
    with pytest.raises(OgPointcloudError, match=r"word_bank\.npy does not match the manifest's checksum"):
        read_text_encoder(folder)
    (folder / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(OgPointcloudError, match=r"word_bank\.npy cannot be used"):
        read_text_encoder(folder)


def test_a_carried_encoder_answers_and_is_read_only_when_asked(
    path, encoder_folder, bundle_file, monkeypatch, tmp_path
):
    monkeypatch.setattr("og_pointcloud.text.encoder.cache_folder", lambda: tmp_path / "none")
    assert read_carried_encoder(path) is None
    assert carry_encoder(path, encoder_folder).feature_space == SPACE
    bundle = read_bundle(path)
    assert bundle.cloud.vocabulary.names == WORDS
    assert encoder_for(SPACE, carried_encoder(path)).where == f"{path}: text_encoder"
    assert encoder_for(SPACE, carried_encoder(path))(["cat"]).shape == (1, WIDTH)
    asked = resolve_labels(["apple", "cat"], None, bundle.cloud.vocabulary, SPACE, carried_encoder(path))
    assert np.abs(asked.vectors[1] - encoder_for(SPACE, carried_encoder(path))(["cat"])[0]).max() == 0
    assert add_words(path, NEW, SPACE).names[-2:] == NEW.names  # which keeps what is carried
    assert encoder_for(SPACE, carried_encoder(path))(["cat"]).shape == (1, WIDTH)
    assert set(members_of(path)) - set(members_of(bundle_file)) == {
        "bank/vectors.npy",
        *(f"text_encoder/{name}" for name in ("manifest.json", "text_encoder.onnx", "tokenizer.json", "word_bank.npy")),
    }


@pytest.mark.filterwarnings("ignore:none of")
def test_a_carried_encoder_answers_whoever_asks_the_scene(path, encoder_folder):
    scene = og.load(path)
    place = scene.xyz[np.flatnonzero(scene.instance_ids >= 0)[0]]
    asks = (
        lambda: og.segment(scene, ["apple", "cat"]),
        lambda: og.Segmenter(scene, ["apple", "cat"]),
        lambda: og.select(scene, "cat"),
        lambda: og.pick(scene, place).words(["cat"]),
        lambda: og.pick(path, place).words(["cat"]),
        lambda: og.instance_table(scene, ["cat"]),
    )
    for ask in asks:
        with pytest.raises(OgPointcloudError, match=rf"export text MODEL_FOLDER --feature-space {SPACE}"):
            ask()
    carry_encoder(path, encoder_folder)
    scene = og.load(path)
    results = [ask() for ask in asks]
    cat = encoder_for(SPACE, carried_encoder(path))(["cat"])[0]
    assert (results[0].labels == og.segment(scene, {"apple": 10 * unit_rows(5)[0], "cat": cat}).labels).all()
    assert results[3] == results[4] == og.pick(scene, place).words({"cat": cat})
    assert len(results[5]) == len(scene.instances)


@pytest.mark.filterwarnings("ignore:none of")
def test_an_encoder_carried_by_a_scene_of_an_unnamed_space_answers(encoder_folder, tmp_path):
    cloud = replace(room(100), feature_space="unknown")
    stored = write_bundle(cloud, tmp_path / "stored.ogpc")
    carry_encoder(stored, encoder_folder)
    for path in (stored, write_bundle(cloud, tmp_path / "written.ogpc", text_encoder=encoder_folder)):
        assert og.segment(path, ["cat"]).names == ("cat",)
        assert og.load(path).cloud.word_bank is not None


def test_a_scene_outlives_its_file(path, encoder_folder):
    scene = og.load(path)
    expected = og.segment(scene, ["apple"]).labels
    path.unlink()
    assert (og.segment(scene, ["apple"]).labels == expected).all()
    with pytest.raises(OgPointcloudError, match="'cat' is not among the 5 known words"):
        og.segment(scene, ["apple", "cat"])


def test_the_writer_carries_an_encoder_too(encoder_folder, tmp_path, capsys):
    path = write_bundle(room(100), tmp_path / "s.ogpc", text_encoder=encoder_folder)
    assert encoder_for(SPACE, carried_encoder(path))(["cat"]).shape == (1, WIDTH)
    assert run("carry", path, encoder_folder, "-o", tmp_path / "t.ogpc") == 0
    assert "carries its text encoder (fp32" in capsys.readouterr().out
    assert (tmp_path / "t.ogpc").read_bytes() == path.read_bytes()
    with pytest.raises(FeatureSpaceError, match=r"in feature space .*expected feature space 'other'"):
        write_bundle(replace(room(100), feature_space="other"), tmp_path / "o.ogpc", text_encoder=encoder_folder)
    assert not (tmp_path / "o.ogpc").exists()


def test_a_carried_encoder_is_checked_like_any_other(path, encoder_folder, tmp_path):
    carry_encoder(path, encoder_folder)
    name = "text_encoder/text_encoder.onnx"
    torn = forged(path, tmp_path / "t.ogpc", {name: members_of(path)[name][:-1] + b"\0"})
    assert len(read_bundle(torn).cloud) == 300  # the scene itself is whole
    with pytest.raises(OgPointcloudError, match=r"t\.ogpc: text_encoder: .* was changed"):
        encoder_for(SPACE, carried_encoder(torn))


def test_words_of_a_set_come_in_the_same_order_in_every_run() -> None:
    """Sets of words have another order with another seed of hashes, and labels are rows of the words."""
    names = tuple("fedcbahgij")
    words = Vocabulary(names, np.eye(len(names), dtype=np.float32))
    found = resolve_labels(set(names), None, words, "space")
    assert found.names == tuple("abcdefghij")
    np.testing.assert_array_equal(found.vectors, words.vectors[[names.index(name) for name in found.names]])
