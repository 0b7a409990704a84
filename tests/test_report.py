"""The report: knobs, the front, baselines against literal loops, what the finished file trades, the page and files."""

import csv
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import NAMES, write_tiny_capture

from og_pointcloud.cli import main
from og_pointcloud.cloud import Vocabulary
from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.fitting.fit import fit, prepare
from og_pointcloud.formats.capture import read_capture
from og_pointcloud.report import asking, knobs, page, sweep
from og_pointcloud.report.baselines import BASELINES
from og_pointcloud.report.measure import Row, disagreement, error_of, labels_of, measure, measure_apart, read_subject


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    capture = write_tiny_capture(tmp_path_factory.mktemp("report") / "capture")
    truth = {"cls": capture.object_ids, "background": capture.object_ids < 0}
    np.savez(capture.folder / "gt.npz", names=np.array(NAMES), **truth)
    return capture.folder


@pytest.fixture(scope="module")
def subject(folder):
    return read_subject(folder)


@pytest.fixture(scope="module")
def prepared(folder):
    return prepare(read_capture(folder))


@pytest.fixture(scope="module")
def cloud(folder):
    return fit(read_capture(folder), progress=False)


def row(seconds, miou, knob="k", value="v", **more):
    return Row("c", knob, value, seconds, 1.0, miou=miou, seconds_most=seconds, **more)


def test_every_knob_of_the_default_road_tries_the_default():
    for knob in knobs.KNOBS:
        modes = {setting.settings.mode for setting in knob.values}
        assert modes == {"fast"} or any(setting.is_default for setting in knob.values), knob.name
        assert len({setting.value for setting in knob.values}) == len(knob.values)
        assert knob.why


def test_settings_are_found_by_their_names_and_differ():
    tried = [*knobs.settings_to_try(paper=True), *(setting for _, setting in knobs.FORCED)]
    assert len({(setting.knob, setting.value) for setting in tried}) == len(tried)
    for setting in tried:
        assert knobs.find_setting(setting.knob, setting.value) == setting
    assert [setting.is_default for setting in tried].count(True) == 1
    with pytest.raises(OgPointcloudError, match="'mode' has no value 'slow'"):
        knobs.find_setting("mode", "slow")


def test_only_the_knobs_asked_for_are_tried():
    tried = knobs.settings_to_try(only=lambda knob: knob.name == "views")
    assert [setting.knob for setting in tried] == ["default", "views", "views", "views"]
    assert [setting.every for setting in tried] == [1, 2, 4, 8]


def test_front_is_what_no_row_beats():
    random = np.random.default_rng(0)
    rows = [row(float(s), float(m)) for s, m in random.integers(1, 12, (60, 2)) / 12]
    literal = [
        one
        for one in rows
        if not any(
            (o.seconds <= one.seconds and o.miou >= one.miou) and (o.seconds, o.miou) != (one.seconds, one.miou)
            for o in rows
        )
    ]
    assert {(r.seconds, r.miou) for r in sweep.front(rows)} == {(r.seconds, r.miou) for r in literal}


def test_error_without_truth_is_the_disagreement():
    assert sweep.error(row(1.0, 0.75)) == 0.25
    assert sweep.error(row(1.0, None, disagreement=0.1)) == 0.1


def test_a_fit_is_measured_as_it_is_made(folder, subject, cloud):
    measured, labels = measure(subject, knobs.DEFAULT)
    np.testing.assert_array_equal(labels, labels_of(cloud, subject.vocabulary))
    assert measured.instances == len(cloud.instances)
    assert measured.miou > 0.8
    assert measured.miou == error_of(labels, subject)["miou"]
    assert list(measured.left_out) == cloud.provenance["left_out"]
    assert measured.is_default


def test_a_process_of_its_own_measures_the_same(folder, subject, tmp_path):
    setting = knobs.find_setting("views", "one of 2")
    apart = measure_apart(folder, setting, tmp_path / "labels.npy")
    here, labels = measure(subject, setting)
    np.testing.assert_array_equal(np.load(tmp_path / "labels.npy"), labels)
    assert (apart.miou, apart.instances, apart.knob, apart.value) == (here.miou, here.instances, "views", "one of 2")


def test_a_fit_that_fails_is_told_by_its_last_line(tmp_path):
    with pytest.raises(OgPointcloudError, match=r"nowhere, default : the fit failed: .*nowhere"):
        measure_apart(tmp_path / "nowhere", knobs.DEFAULT, tmp_path / "labels.npy")


def test_disagreement_of_words_and_of_instances(subject):
    first, second = np.array([0, 0, 1, -1]), np.array([0, 1, 1, -1])
    assert disagreement(first, second, subject) == 0.25
    wordless = replace(subject, vocabulary=None)
    assert disagreement(np.array([5, 5, 7, 7]), np.array([0, 0, 1, 1]), wordless) == 0.0
    assert disagreement(first, second, wordless) > 0


def test_truth_of_another_cloud_is_refused(subject):
    with pytest.raises(SceneError, match="3"):
        error_of(np.zeros(3, int), subject)


def literal_uplift(prepared, features, words):
    weights = prepared.table.weights.toarray().astype(np.float64)
    labels = np.full(weights.shape[1], -1)
    for point in range(weights.shape[1]):
        if weights[:, point].sum() > 0:
            mean = sum(weight * feature for weight, feature in zip(weights[:, point], features, strict=True))
            labels[point] = np.argmax([mean @ (word / np.linalg.norm(word)) for word in words])
    return labels


def test_direct_uplift_is_the_weighted_mean_word_by_word(folder, subject, prepared):
    words = subject.vocabulary.vectors.astype(np.float64)
    labels = BASELINES["direct uplift"](read_capture(folder), prepared, words)
    literal = literal_uplift(prepared, prepared.table.unit_features.astype(np.float64), words)
    np.testing.assert_array_equal(labels, literal)


def test_compressed_features_are_those_of_the_best_three_directions(folder, subject, prepared):
    words = subject.vocabulary.vectors.astype(np.float64)
    features = prepared.table.unit_features.astype(np.float64)
    middle = features.mean(axis=0)
    values, vectors = np.linalg.eigh(np.cov((features - middle).T))
    basis = vectors[:, np.argsort(values)[-3:]]
    literal = literal_uplift(prepared, (features - middle) @ basis @ basis.T + middle, words)
    labels = BASELINES["compressed"](read_capture(folder), prepared, words)
    assert (labels == literal).mean() > 0.999  # equal scores may go either way


def test_nearest_view_asks_the_closest_view_that_has_a_mask_there(folder, subject, prepared):
    scene, table, words = read_capture(folder), prepared.table, subject.vocabulary.vectors
    labels = BASELINES["nearest view"](scene, prepared, words)
    weights, word = table.weights.toarray(), (table.unit_features @ words.T).argmax(axis=1)
    checked = 0
    for point in range(0, weights.shape[1], 7):
        masks = np.flatnonzero(weights[:, point])
        if len(masks) == 0:
            assert labels[point] == -1
            continue
        away = [np.linalg.norm(scene.views[v].camera.center - scene.points.xyz[point]) for v in table.mask_view[masks]]
        closest = masks[np.isclose(away, min(away))]
        if len(np.unique(table.mask_view[closest])) > 1:
            continue  # the cameras stand in a ring: two are equally close
        checked += 1
        assert labels[point] == word[closest[np.argmax(weights[closest, point])]]
    assert checked > 50


def test_centre_sampling_reads_the_pixel_of_each_centre(folder, subject, prepared):
    scene, table, words = read_capture(folder), prepared.table, subject.vocabulary.vectors
    labels = BASELINES["centre sampling"](scene, prepared, words)
    exposure, similarity = table.exposure.toarray(), table.unit_features @ words.T
    first = np.searchsorted(table.mask_view, np.arange(len(scene.views)))
    maps = [view.mask_map() for view in scene.views]
    for point in range(0, len(scene.points), 11):
        total, reached = np.zeros(len(words)), False
        for index, view in enumerate(scene.views):
            camera = view.camera
            x, y, z = camera.world_to_camera[:3, :3] @ scene.points.xyz[point] + camera.world_to_camera[:3, 3]
            if exposure[index, point] == 0 or z <= 0:
                continue
            u, v = int(np.floor(camera.fx * x / z + camera.cx)), int(np.floor(camera.fy * y / z + camera.cy))
            if 0 <= u < camera.width and 0 <= v < camera.height and maps[index][v, u] >= 0:
                total += exposure[index, point] * similarity[first[index] + maps[index][v, u]]
                reached = True
        assert labels[point] == (total.argmax() if reached else -1)


def test_mask_graph_labels_what_masks_show(folder, subject, prepared):
    labels = BASELINES["mask graph"](read_capture(folder), prepared, subject.vocabulary.vectors)
    shown = np.asarray(prepared.table.weights.sum(axis=0)).ravel() > 0
    assert (labels[~shown] == -1).all()
    assert error_of(labels, subject)["macc"] > 0.8


def test_lookups_are_exact_and_coarser_numbers_are_not_hidden(cloud, subject, monkeypatch):
    monkeypatch.setattr(asking, "ASKED", 5_000)
    monkeypatch.setattr(asking, "REPEATS", 1)
    rows = {(row.knob, row.value): row for row in asking.measure_asking(cloud, subject)}
    for value in ("graph and search", "search alone", "scipy KD-tree"):
        assert rows["lookup", value].disagreement == 0
    assert rows["descriptors", "float32"].disagreement == 0
    texts = subject.vocabulary.vectors
    assert rows["text", "float16"].miou == rows["descriptors", "float32"].miou
    swapped = replace(subject, vocabulary=Vocabulary(subject.vocabulary.names, texts[::-1].copy()))
    wrong = {(row.knob, row.value): row for row in asking.measure_asking(cloud, swapped)}
    assert wrong["descriptors", "float32"].miou < 0.5 < rows["descriptors", "float32"].miou


def test_command_writes_page_table_and_plot(folder, tmp_path, monkeypatch, capsys):
    few = tuple(knob for knob in knobs.KNOBS if knob.name == "views")
    monkeypatch.setattr(knobs, "KNOBS", (replace(few[0], values=few[0].values[:2]),))
    monkeypatch.setattr(page, "KNOBS", knobs.KNOBS)
    monkeypatch.setattr(asking, "ASKED", 2_000)
    assert main(["report", str(folder), "--quick", "-o", str(tmp_path / "r")]) == 0
    assert "next: open" in capsys.readouterr().out
    html = (tmp_path / "r" / "report.html").read_text()
    assert re.findall(r'(?:src|href)="(?!data:)', html) == []
    for words in ("the default", "views: one of 2", "baseline: direct uplift", "lookup: graph and search", "left out"):
        assert words in html
    rows = list(csv.DictReader((tmp_path / "r" / "report.csv").open()))
    assert rows[0]["knob"] == "default"
    assert float(rows[0]["miou"]) > 0.8
    assert (tmp_path / "r" / "capture.png").read_bytes().startswith(b"\x89PNG")


def test_page_says_where_runs_differ(folder, cloud, subject, tmp_path):
    rows = (row(2.0, 0.9, "default", "", runs=2), row(1.0, 0.95, "mode", "fast", runs_alike=False))
    rows = tuple(replace(one, capture=folder.name) for one in rows)
    report = sweep.Report(rows, {folder.name: cloud}, {folder.name: folder}, "here", 1.0)
    html = page.write_page(report, tmp_path / "r.html").read_text()
    assert "Runs differ in their labels: mode fast" in html
    assert "fast is as good or better on capture" in html


def test_bad_use_is_one_error(tmp_path, capsys):
    assert main(["report", "-o", str(tmp_path)]) == 2
    assert "no CAPTURE and no --room" in capsys.readouterr().err
    assert main(["report", str(tmp_path), "--runs", "0"]) == 2
    assert "--runs is 0; expected at least 1" in capsys.readouterr().err
