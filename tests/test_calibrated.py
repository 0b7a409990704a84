"""Scenes with a word bank, asked through the public API: probabilities, reasons, and unknown where nothing fits."""

from __future__ import annotations

import json
import shlex
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import test_choosing
from commands import output_of, run
from labelled_clouds import SPACE, TOO_FAR, queries, quietly, room
from og_pointcloud_export import write_bundle
from test_choosing import Made, unit

import og_pointcloud as og
from og_pointcloud.ask.choosing import Chooser, Reason
from og_pointcloud.cloud import BACKGROUND, UNOBSERVED, Vocabulary
from og_pointcloud.evaluate.truth import read_truth

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
OWNERS = [0, 0, 1, 2, 3, 5, 6, 7, 8]
SHOWN = tuple(f"shown {row}" for row in range(9))
ABSENT = tuple(f"absent {row}" for row in range(50))
"""Words 0 to 8 are what the descriptors show, 10 to 59 are shown nowhere."""


@pytest.fixture(scope="module")
def made():
    return Made(9, owners=OWNERS)


@pytest.fixture(scope="module")
def cloud(made):
    """The room, each descriptor of which shows a word; instance 4 has none."""
    words = Vocabulary((*SHOWN, *ABSENT), np.concatenate([made.texts[:9], made.texts[10:60]]))
    return replace(room(), instances=made.table, vocabulary=words, word_bank=made.bank)


@pytest.fixture(scope="module")
def path(cloud, tmp_path_factory):
    return write_bundle(cloud, tmp_path_factory.mktemp("bundle") / "judged.ogpc")


@pytest.fixture(scope="module")
def scene(path):
    return og.load(path)


@pytest.fixture(scope="module")
def plain(cloud):
    """The same scene without its bank."""
    return og.LabelledScene.from_cloud(replace(cloud, word_bank=None))


def answers_plainly(scene, points, texts):
    """(label, score, reason) of each point, one by one, from what the chooser says of its instance."""
    choice = Chooser(scene.cloud.instances, scene.cloud.word_bank).choose(texts)
    views = scene.cloud.instances.views
    beyond = {BACKGROUND: Reason.IN_NO_MASK, UNOBSERVED: Reason.UNOBSERVED, TOO_FAR: Reason.TOO_FAR}
    for instance in scene.instances_at(points):
        if instance < 0:
            yield -1, 0, beyond[instance]
        elif instance == 4:
            yield -1, 0, Reason.NOT_DESCRIBED
        elif choice.unknown[instance] > 0.5:
            yield -1, 0, Reason.NONE_FITS
        else:
            label = choice.table[instance].argmax()
            seen = (views[instance] + 0.5) / (views[instance] + 1)
            yield label, choice.table[instance, label] * seen, Reason.LABELLED


def test_points_get_probabilities_and_reasons(scene, made):
    asked = [0, 3, 4, 8, 12]
    names = [(*SHOWN, "-", *ABSENT)[row] for row in asked]
    points = queries(scene.cloud, 400).astype(np.float64)
    result = og.segment(points, names, scene)
    labels, scores, reasons = zip(*answers_plainly(scene, points, made.texts[asked]), strict=True)
    assert result.calibrated
    assert "fitting or not" not in repr(result)
    assert result.labels.tolist() == list(labels)
    assert result.reasons.dtype == np.int8
    assert result.reasons.tolist() == list(reasons)
    np.testing.assert_allclose(result.scores, scores, atol=1e-6)
    assert set(result.reasons) == set(Reason) - {Reason.NOT_FINITE}  # every other case was there
    assert sum(result.unknown_because().values()) == (result.labels < 0).sum()
    assert result.unknown_because()[Reason.TOO_FAR] == (result.instances == TOO_FAR).sum()


def test_absent_words_get_no_point_and_shown_ones_keep_theirs(scene, plain):
    with pytest.warns(UserWarning, match=r"none of 3000 points has a label: \d+ are like none of these labels, .*feat"):
        absent = og.segment(scene, ABSENT[:10])
    assert absent.unknown_because()[Reason.NONE_FITS] > 1500
    assert (og.segment(plain, ABSENT[:10]).labels >= 0).mean() > 0.5  # which is why there is a bank
    both, alone = og.segment(scene, SHOWN + ABSENT), og.segment(scene, SHOWN)
    assert (both.labels == alone.labels).mean() > 0.99
    assert (alone.labels == og.segment(plain, SHOWN).labels).all()


def test_without_a_bank_the_best_cosine_is_the_label(plain, made):
    points = queries(plain.cloud, 300).astype(np.float64)
    result = og.segment(points, SHOWN, plain)
    cosines = unit(made.table.descriptors) @ unit(made.texts[:9]).T
    assert not result.calibrated
    assert set(result.reasons) == set(Reason) - {Reason.NONE_FITS, Reason.NOT_FINITE}
    labelled = np.flatnonzero(result.labels >= 0)
    for point in labelled[:200]:
        rows = np.flatnonzero(np.array(OWNERS) == result.instances[point])
        assert result.scores[point] == pytest.approx(cosines[rows].max(), abs=1e-6)
        assert result.labels[point] == cosines[rows].max(axis=0).argmax()
    assert len(labelled) > 200


def test_the_chooser_is_made_once_and_shared(scene, cloud):
    assert scene.chooser is scene.chooser
    assert scene.chooser.bank is scene.cloud.word_bank
    other = replace(cloud, word_bank=None)
    assert og.segment(other, SHOWN).calibrated is False  # a changed cloud does not keep the old one's
    assert og.segment(cloud, SHOWN).calibrated is True


def test_threads_share_a_scene_from_its_first_question(path):
    scene = og.load(path)  # nothing of it has been made yet
    frames = [queries(scene.cloud, 100, seed).astype(np.float64) for seed in range(4)]
    expected = [og.segment(frame, SHOWN, og.load(path)) for frame in frames]
    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(lambda index: og.segment(frames[index % 4], SHOWN, scene), range(16)))
    for index, result in enumerate(results):
        for key in ("labels", "scores", "reasons"):
            np.testing.assert_array_equal(getattr(result, key), getattr(expected[index % 4], key))


# Awkward labels


def test_one_label_is_judged_too(scene):
    result = og.segment(scene, SHOWN[5])
    assert set(result.instances[result.labels == 0]) == {6 - 1}
    with pytest.warns(UserWarning, match="like none of these labels"):
        assert (og.segment(scene, "absent 3").labels == -1).all()


def test_ten_thousand_labels(scene, made):
    words = {name: made.texts[row] for row, name in enumerate(SHOWN)}
    many = test_choosing.encoder_like_clip(10_000, seed=77)
    result = og.segment(scene, words | {str(row): vector for row, vector in enumerate(many)})
    assert np.isfinite(result.scores).all()
    shown = result.labels[result.labels >= 0]
    assert len(shown) > 300
    assert (shown < 9).mean() > 0.9


def test_labels_of_one_vector_share_nothing_and_the_first_is_answered(scene, made):
    once = og.segment(scene, {"a": made.texts[2], "b": made.texts[7]})
    twice = og.segment(scene, {"a": made.texts[2], "b": made.texts[7], "c": 4 * made.texts[2], "d": made.texts[7]})
    np.testing.assert_array_equal(once.labels, twice.labels)
    np.testing.assert_allclose(once.scores, twice.scores, atol=1e-6)


@pytest.mark.parametrize("size", [1e-30, 1e30])
def test_vectors_of_any_length(scene, made, size):
    result = og.segment(scene, {"a": made.texts[2].astype(np.float64) * size, "b": made.texts[7]})
    np.testing.assert_array_equal(result.labels, og.segment(scene, {"a": made.texts[2], "b": made.texts[7]}).labels)


@pytest.mark.parametrize(
    "kind", ["descriptors that are zero", "descriptors that are one", "no descriptor", "one instance"]
)
def test_tables_without_much_to_compare(cloud, kind):
    table, ids = cloud.instances, cloud.instance_ids
    if kind == "descriptors that are zero":
        table = replace(table, descriptors=0 * table.descriptors)
    elif kind == "descriptors that are one":
        table = replace(table, descriptors=np.repeat(table.descriptors[:1], 9, axis=0))
    elif kind == "no descriptor":
        table = replace(table, descriptors=table.descriptors[:0], descriptor_instance=table.descriptor_instance[:0])
    else:
        table, ids = Made(1).table, np.minimum(ids, 0)
    result = quietly(replace(cloud, instances=table, instance_ids=ids), SHOWN)
    assert result.calibrated
    assert np.isfinite(result.scores).all()
    assert (result.scores[result.labels < 0] == 0).all()
    assert (result.labels >= 0).any() == (kind in ("descriptors that are one", "one instance"))


@pytest.mark.parametrize(
    "vectors", [np.zeros((60, 64)), np.ones((60, 64)), np.eye(60, 64) * 1e-30, np.eye(60, 64) * 1e30]
)
def test_banks_that_say_little_or_nothing(cloud, made, vectors):
    result = quietly(replace(cloud, word_bank=og.WordBank(vectors)), SHOWN)
    assert result.calibrated
    assert np.isfinite(result.scores).all()
    assert ((result.scores > 0) == (result.labels >= 0)).all()


# Selecting, picking, and the table of instances


def test_a_selection_says_how_probable_each_instance_is(scene, plain):
    selection = og.select(scene, SHOWN[5])
    assert selection.calibrated
    assert selection.instances == (5,)
    assert selection[0].score > 0.9
    assert selection[0].rival_score < 0.1
    assert all(match.score < 0.5 for match in selection[1:])
    nothing = og.select(scene, ABSENT[0], against=[])
    assert (nothing.instances, nothing.rivals, len(nothing)) == ((), 0, 8)
    assert json.loads(nothing.to_json())["calibrated"] is True
    assert len(og.select(plain, ABSENT[0], against=[]).fitting) == 1  # the best alone, as nothing tells more
    # Instance 0 shows two words; a rival takes it only where it fits better.
    assert 0 in og.select(scene, SHOWN[1], against=[]).instances


def test_a_selection_is_what_segment_labels(scene):
    names = (SHOWN[2], SHOWN[6], ABSENT[4])
    result = og.segment(scene, names)
    for label, name in enumerate(names):
        chosen = og.select(scene, name, against=[other for other in names if other != name])
        np.testing.assert_array_equal(chosen.point_indices, np.flatnonzero(result.labels == label))


def test_saturated_probabilities_are_ranked_by_evidence(scene, made):
    texts = made.texts[[5, 20, 21]]
    choice = scene.chooser.choose(texts)
    ranked = og.select(scene, {"a": texts[0]}, against={"b": texts[1], "c": texts[2]})
    pairs = [(-choice.table[k, 0], -choice.evidence[k, 0]) for k in (match.instance for match in ranked)]
    assert pairs == sorted(pairs)
    assert len(pairs) == 8


def test_words_of_a_pick_and_of_the_table_are_the_same_probabilities(scene, cloud, path):
    point = int(np.flatnonzero(cloud.instance_ids == 6)[0])
    for source in (scene, cloud, path):
        words = og.pick(source, scene.xyz[point]).words()
        assert words[0][0] == SHOWN[6]
        assert words[0][1] > 0.9
        assert len(words) == len(SHOWN) + len(ABSENT)
        assert [score for _, score in words] == sorted((score for _, score in words), reverse=True)
        assert og.pick(source, scene.xyz[point]).words([SHOWN[6]])[0][1] > 0.9
    assert scene.instances[6].words == tuple(og.pick(scene, scene.xyz[point]).words()[:3])
    assert og.pick(scene, scene.xyz[int(np.flatnonzero(cloud.instance_ids == 4)[0])]).words() == []
    assert scene.instances[4].words == ()


def test_scene_instances_is_the_table_with_boxes(scene, cloud):
    table = scene.instances
    assert table is scene.instances
    assert isinstance(table, og.Instances)
    assert [row.points for row in table] == np.bincount(cloud.instance_ids[cloud.instance_ids >= 0]).tolist()
    assert table[2].oriented_box.volume > 0
    assert np.abs(table[2].centroid - scene.xyz[table[2].point_indices][table[2].main_part].mean(axis=0)).max() < 1e-9
    assert json.loads(table.to_json())[2]["words"][0]["name"] == SHOWN[3]
    assert (scene.cloud.instances.views == [row.views for row in table]).all()
    parts = replace(
        cloud.instances, coarse=np.arange(9, dtype=np.int32)[::-1], part_of=np.array([1] + [-1] * 8, np.int32)
    )
    other = og.instance_table(replace(cloud, instances=parts))
    assert [(row.part_of, row.coarse) for row in other][:3] == [(1, 8), (-1, 7), (-1, 6)]
    assert json.loads(other.to_json())[0]["coarse"] == 8


# Commands


def test_segment_counts_reasons_and_names_the_cure(path, plain, tmp_path, capsys):
    stdout = output_of(capsys, "segment", path, "--labels", f"{SHOWN[0]},{SHOWN[6]}", "-o", tmp_path / "o.npz")
    assert "like none of these labels" in stdout
    assert "not calibrated" not in stdout
    saved = np.load(tmp_path / "o.npz")
    assert saved["calibrated"]
    reasons = np.bincount(saved["reasons"], minlength=len(Reason))
    assert f"unknown: {reasons[Reason.NONE_FITS]:,} like none of these labels, {reasons[2]:,} of instances" in stdout
    bare = write_bundle(plain.cloud, tmp_path / "bare scene.ogpc")
    report = json.loads(run(capsys, "segment", bare, "--labels", SHOWN[0], "--json")[1])
    assert report["calibrated"] is False
    assert sum(report["unknown_because"].values()) == report["unknown"]
    for arguments in (("segment", bare, "--labels", SHOWN[0]), ("select", bare, SHOWN[0]), ("info", bare)):
        (line,) = [line for line in run(capsys, *arguments)[1].splitlines() if "vocabulary bank" in line]
        command = line[line.index("og-pointcloud ") :].removesuffix(" [WORDS.npz]")
        assert shlex.split(command) == ["og-pointcloud", "vocabulary", "bank", str(bare)]
    assert "word bank of 300: scores are probabilities" in run(capsys, "info", path)[1]
    assert json.loads(run(capsys, "info", path, "--json")[1])["word_bank"] == 300


def test_a_bank_that_is_added_calibrates(plain, made, tmp_path, capsys):
    bare = write_bundle(plain.cloud, tmp_path / "bare.ogpc")
    names = np.array([f"word {number}" for number in range(len(made.bank.vectors))])
    np.savez(tmp_path / "words.npz", names=names, vectors=made.bank.vectors, feature_space=SPACE)
    assert run(capsys, "vocabulary", "bank", bare, tmp_path / "words.npz")[0] == 0
    code, stdout, stderr = run(capsys, "segment", bare, "--labels", ",".join(ABSENT[:5]))
    assert code == 0
    assert "none of 3000 points has a label" in stderr
    assert "no points: absent 0" in stdout


# Recorded captures

RECORDED = {"nuscenes_frame": 0.55, "apc_shelf_B": 0.93}


@pytest.mark.slow
@pytest.mark.skipif(not DATA.is_dir(), reason="the recorded captures are absent")
@pytest.mark.parametrize("name", RECORDED)
def test_recorded_captures_keep_their_labels_and_give_absent_words_hardly_a_point(name, tmp_path, capsys):
    words = np.load(DATA / "clip" / "text_vitb32.npz")
    names = np.concatenate([words["oid_names"], words["o365_names"]])
    vectors = np.concatenate([words["oid_text"], words["o365_text"]])
    first = np.unique(names, return_index=True)[1]
    asked, space = og.read_text_features(DATA / name / "text_features.npz")
    np.savez(tmp_path / "words.npz", names=names[first], vectors=vectors[first], feature_space=space)
    arguments = ("fit", DATA / name, "-o", tmp_path / "s.ogpc", "--word-bank", tmp_path / "words.npz")
    assert run(capsys, *arguments)[0] == 0
    scene = og.load(tmp_path / "s.ogpc")
    bare = og.LabelledScene(replace(scene._bundle, cloud=replace(scene.cloud, word_bank=None)))
    judged, plain = og.segment(scene), og.segment(bare)
    assert judged.calibrated
    assert not plain.calibrated
    truth = read_truth(DATA / name)
    assert truth.score(truth.class_of(judged.labels, judged.names)).miou > RECORDED[name]
    np.testing.assert_array_equal(judged.labels, plain.labels)
    of_instance = scene.instance_ids >= 0
    present = np.unique(judged.labels[judged.labels >= 0])
    middle = scene.cloud.word_bank.mean
    related = unit(unit(words["lvis_text"]) - middle) @ unit(unit(asked.vectors[present]) - middle).T
    pool = words["lvis_text"][related.max(axis=1) < 0.5]
    called = []
    for seed in range(60):  # of so few instances one word that fits is a fifth of all points: few draws say little
        rows = np.random.default_rng(seed).choice(len(pool), 50, replace=False)
        absent = {str(row): pool[row] for row in rows}
        assert (og.segment(bare, absent).labels[of_instance] >= 0).all()
        called.append((quietly(scene, absent).labels[of_instance] >= 0).mean())
    assert np.mean(called) < 0.05
