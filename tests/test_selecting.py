"""Selection by a word: the ranking against plain cosines, the competition of words, and what no word finds."""

import json
import shlex
from dataclasses import replace

import numpy as np
import pytest
from commands import error_of, output_of
from labelled_clouds import WIDTH, WORDS, make_cloud, unit_rows

import og_pointcloud as og
from og_pointcloud.ask.labelled_scene import LabelledScene
from og_pointcloud.cloud import InstanceTable, Vocabulary
from og_pointcloud.errors import FeatureSpaceError, OgPointcloudError

AXES = np.eye(WIDTH, dtype=np.float32)


def mugs_and_a_cup():
    """Instances 0, 1, 2: a mug, a worse mug, a cup; 3 has no feature, 4 no points; the words are axes 0 and 1."""
    rows = np.array([AXES[0], 0.8 * AXES[0] + 0.6 * AXES[2], 0.6 * AXES[0] + 0.8 * AXES[1], AXES[0]])
    numbers = np.ones(5, np.int32)
    ratios = np.ones(5, np.float32)
    table = InstanceTable(rows, np.array([0, 1, 2, 4], np.int32), numbers, numbers, numbers, ratios, ratios)
    cloud = make_cloud(np.arange(24).reshape(8, 3), [0, 0, 1, 2, 2, 2, 3, -1], instances=table)
    return LabelledScene.from_cloud(replace(cloud, vocabulary=Vocabulary(("mug", "cup"), AXES[:2])))


def test_every_instance_with_a_feature_is_ranked_by_its_cosine(scene):
    cloud = scene.cloud
    vectors = cloud.vocabulary.vectors / np.linalg.norm(cloud.vocabulary.vectors, axis=1, keepdims=True)
    owner = cloud.instances.descriptor_instance
    for text, vector in zip(WORDS, vectors, strict=True):
        selection = og.select(scene, text)
        cosines = {k: max(cloud.instances.descriptors[owner == k] @ vector) for k in range(9) if (owner == k).any()}
        assert [match.instance for match in selection] == sorted(cosines, key=lambda k: -cosines[k])
        np.testing.assert_allclose([match.score for match in selection], sorted(cosines.values())[::-1], atol=1e-5)
        assert (selection.unknown, selection.rivals) == (1, len(WORDS) - 1)


def test_what_fits_is_what_segment_labels(scene):
    result = og.segment(scene)
    for name in WORDS:
        np.testing.assert_array_equal(og.select(scene, name).point_indices, np.flatnonzero(result.mask(name)))


def test_words_compete_for_instances():
    scene = mugs_and_a_cup()
    mug = og.select(scene, "mug")
    assert [(match.instance, match.fits, match.rival, match.points) for match in mug] == [
        (0, True, "cup", 2),
        (1, True, "cup", 1),
        (2, False, "cup", 3),
    ]
    np.testing.assert_allclose([match.score for match in mug], [1, 0.8, 0.6], atol=1e-6)
    np.testing.assert_allclose([match.rival_score for match in mug], [0, 0, 0.8], atol=1e-6)
    assert mug.instances == (0, 1)
    assert mug.point_indices.tolist() == [0, 1, 2]
    assert np.flatnonzero(mug.scene.instance_ids == mug[2].instance).tolist() == [3, 4, 5]
    assert og.select(scene, "cup").instances == (2,)
    assert mug.unknown == 1


def test_without_rivals_only_the_best_fits():
    scene = mugs_and_a_cup()
    for selection in (og.select(scene, "mug", against=[]), og.select(scene, {"mug": AXES[0]}, against=["mug"])):
        assert selection.rivals == 0
        assert [match.fits for match in selection] == [True, False, False]
        assert selection.instances == (0,)
        assert selection.to_json().count('"rival": null') == 3
    for nothing in (set(), {}, np.array([], str), iter([]), (word for word in ())):
        assert og.select(scene, "mug", against=nothing).rivals == 0
    for one in (iter(["cup"]), np.array("cup")):
        assert og.select(scene, "mug", against=one).rivals == 1
    wordless = LabelledScene.from_cloud(replace(scene.cloud, vocabulary=None))
    assert og.select(wordless, {"mug": AXES[0]}).instances == (0,)


def test_a_tie_with_a_rival_still_fits_and_equal_instances_keep_their_order():
    scene = mugs_and_a_cup()
    same = og.select(scene, "mug", against={"beaker": 3 * AXES[0]})
    assert same.instances == (0, 1, 2)
    none_like_it = og.select(scene, {"moon": AXES[9]}, against=[])
    assert [match.instance for match in none_like_it] == [0, 1, 2]


def test_rivals_may_be_given_and_nothing_may_fit():
    scene = mugs_and_a_cup()
    far = og.select(scene, {"moon": AXES[9]})
    assert (far.instances, len(far), far.rivals) == ((), 3, 2)
    assert len(far.point_indices) == 0
    assert far.best.rival == "mug"
    assert og.select(scene, "mug", against={"blend": AXES[0] + AXES[1]}).instances == (0, 1)


def test_text_features_bring_words_and_rivals(scene):
    words = Vocabulary(("moon", "sun"), unit_rows(2, WIDTH, seed=8))
    selection = og.select(scene, "moon", text_features=(words, scene.feature_space))
    assert selection.rivals == 1
    assert {match.rival for match in selection} == {"sun"}


@pytest.mark.parametrize("text", [["mug", "cup"], {"a": AXES[0], "b": AXES[1]}, {}, 3, None])
def test_more_or_less_than_one_text_is_refused(text):
    with pytest.raises(OgPointcloudError, match="expected one word or phrase"):
        og.select(mugs_and_a_cup(), text)


def test_wrong_words_are_refused(scene):
    with pytest.raises(OgPointcloudError, match="not among the"):
        og.select(scene, "zebra")
    with pytest.raises(FeatureSpaceError, match="dimension 4"):
        og.select(scene, {"mug": np.ones(4)})


def test_no_instance_at_all():
    scene = LabelledScene.from_cloud(make_cloud([[0, 0, 0]], [-1]))
    selection = og.select(scene, WORDS[0])
    assert (len(selection), selection.best, selection.fitting) == (0, None, ())
    assert str(selection) == f"'{WORDS[0]}' fits 0 of 0 instances"


def test_command(tmp_path, capsys):
    bundle = og.write_bundle(mugs_and_a_cup().cloud, tmp_path / "mugs.ogpc")
    out = output_of(capsys, "select", bundle, "mug")
    assert out.startswith("'mug' fits 2 of 3 instances\n* instance 0")
    assert "no feature to compare with words: 1 instance\n" in out
    record = json.loads(output_of(capsys, "select", bundle, "mug", "--against", "", "--json"))
    assert [match["instance"] for match in record["matches"] if match["fits"]] == [0]
    error = error_of(capsys, "select", bundle, "zebra")
    assert "'zebra' is not among the 2 known words" in error
    assert "(--text-features)" in error


@pytest.mark.parametrize("against", [[], ["--against", ""]])
def test_what_is_typed_next_takes_what_was_selected(tmp_path, capsys, monkeypatch, against):
    monkeypatch.chdir(tmp_path)
    og.write_bundle(mugs_and_a_cup().cloud, tmp_path / "mugs.ogpc")
    lines = output_of(capsys, "select", "mugs.ogpc", "mug", *against).splitlines()
    selected = [int(line.split()[2]) for line in lines if line.startswith("* instance")]
    assert selected == ([0] if against else [0, 1])
    typed = shlex.split(lines[-1].removeprefix("next: og-pointcloud "))
    assert json.loads(output_of(capsys, *typed, "--json"))["instances"] == selected
