"""The report: settings, one row a fit with error and seconds, the front, other methods, files and the command."""

from __future__ import annotations

import csv
import shutil
import warnings
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from commands import error_of, output_of
from scenes import COLORS, NAMES, write_ply, write_tiny_capture
from scipy.sparse import csr_array

from og_pointcloud.ask.labelled_scene import LabelledScene
from og_pointcloud.bundle.vocabulary import scene_words
from og_pointcloud.checking.check import CaptureWarning
from og_pointcloud.cloud import FeatureSpace
from og_pointcloud.errors import FeatureSpaceError, OgPointcloudError, SceneError
from og_pointcloud.evaluate import sweep as sweeping
from og_pointcloud.evaluate.baselines import BASELINES, only_where_masked
from og_pointcloud.evaluate.captures import ask
from og_pointcloud.evaluate.knobs import DEFAULT, KNOBS, Setting, settings_of
from og_pointcloud.evaluate.sweep import BASELINE, Row, Sweep, front, read_subject, sweep
from og_pointcloud.evaluate.sweep_report import write_chart, write_report
from og_pointcloud.fitting.fit import fit, prepare
from og_pointcloud.formats.capture import read_capture
from og_pointcloud.journal import LeftOut, left_out_entry
from og_pointcloud.settings import FitSettings

PNG = b"\x89PNG"


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


def test_warming_up_warns_of_nothing(subject, monkeypatch):
    """Two views of a few points may well look wrong: only the fit itself warns."""
    monkeypatch.setattr(sweeping, "fit", lambda *_, **__: warnings.warn("poses", CaptureWarning, stacklevel=2))
    with warnings.catch_warnings(record=True) as heard:
        sweeping.warm_up(subject.scene)
        assert not heard
        warnings.warn("kept", CaptureWarning, stacklevel=1)
    assert [str(one.message) for one in heard] == ["kept"]


def row(seconds: float, error: float, knob: str = "k", value: str = "v", capture: str = "c") -> Row:
    return Row(capture, knob, value, seconds, error)


def value_of(knob: str, value: str) -> Setting:
    return next(setting for setting in KNOBS[knob] if setting.value == value)


# Settings -------------------------------------------------------------------------------------------------------


def test_one_value_of_every_knob_is_its_default_and_no_setting_is_tried_twice():
    for name, values in KNOBS.items():
        stands = [value.settings == FitSettings() and value.every == 1 for value in values]
        assert stands.count(True) == 1, name
        assert len({value.value for value in values}) == len(values)
    tried = settings_of()
    assert tried[0] == DEFAULT
    assert all(one.settings != other.settings or one.every != other.every
               for index, one in enumerate(tried) for other in tried[:index])  # fmt: skip


def test_only_the_knobs_asked_for_are_tried():
    assert [setting.every for setting in settings_of(("views",))] == [1, 2, 4, 8]
    assert [setting.name for setting in settings_of(("mode", "neighbors", "mode"))] == [
        "default", "mode: fast", "neighbors: 12", "neighbors: 48",
    ]  # fmt: skip
    assert [setting.value for setting in settings_of(("grouping sample",))] == ["", "5,000", "20,000", "all"]
    with pytest.raises(OgPointcloudError, match="'color' is not a knob; expected one of views, mode"):
        settings_of(("color",))


# Rows -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_rows_have_error_and_seconds_and_a_setting_that_fails_costs_no_other(subject, monkeypatch):
    def fails(scene, settings, progress):
        if settings.membership.sure_share == 0.4:
            raise ZeroDivisionError("division by zero")
        return fit(scene, settings, progress=progress)

    monkeypatch.setattr(sweeping, "fit", fails)
    tried = [DEFAULT, value_of("sure share", "0.4"), value_of("views", "one of 2"), value_of("mode", "fast")]
    found = sweep([subject], tried, progress=False)
    assert found.failed == {"capture, sure share: 0.4": "ZeroDivisionError: division by zero"}
    rows = {(one.knob, one.value): one for one in found.rows}
    assert list(rows)[:3] == [("default", ""), ("views", "one of 2"), ("mode", "fast")]
    cloud = fit(subject.scene, progress=False)
    default = rows["default", ""]
    labels = LabelledScene.from_cloud(cloud).chooser.choose(subject.vocabulary.vectors).at(cloud.instance_ids)[0]
    called = subject.truth.class_of(labels, subject.vocabulary.names)
    assert default.miou == 1 - default.error == subject.truth.score(called).miou > 0.8
    assert default.gain == 0
    assert list(default.left_out) == cloud.provenance["left_out"]
    assert default.instances == len(cloud.instances)
    views = rows["views", "one of 2"]
    assert views.gain == pytest.approx(views.miou - default.miou)
    assert views.gain_low <= views.gain <= views.gain_high
    for one in found.rows:
        assert one.seconds > 0
        assert 0 <= one.error <= 1
    assert {value for knob, value in rows if knob == BASELINE} == {
        name + end for name in BASELINES for end in ("", ", where masked")
    }


@pytest.mark.slow
def test_without_truth_the_error_is_what_the_fit_says_of_itself(folder, tmp_path):
    bare = tmp_path / "bare"
    shutil.copytree(folder, bare)
    (bare / "gt.npz").unlink()
    found = sweep([read_subject(bare)], [DEFAULT, value_of("views", "one of 4")], progress=False)
    default, fewer = found.rows  # no other method can be judged
    assert (default.miou, default.gain) == (None, None)
    assert default.error == 1 - default.reliability < 0.5
    assert fewer.reliability != default.reliability
    text = write_report(found, tmp_path / "r.md", tmp_path / "r.png").read_text()
    assert "no truth" in text
    assert "| reliability |" in text
    assert "| mIoU |" not in text


def test_points_at_one_place_are_fitted_as_a_fit_does(folder, subject, tmp_path):
    twice = tmp_path / "twice"
    shutil.copytree(folder, twice)
    points = subject.scene.points
    place = np.concatenate([np.arange(len(points)), np.arange(0, len(points), 3)])
    world = points.xyz_world[place]
    write_ply(twice / "points.ply", world.astype(np.float32), np.broadcast_to(COLORS[0], (len(place), 3)))
    truth = subject.truth
    np.savez(twice / "gt.npz", names=truth.names, cls=truth.cls[place], background=truth.background[place])
    again = read_subject(twice)
    (default, *_) = sweep([again], [DEFAULT], progress=False).rows
    cloud = fit(again.scene, progress=False)
    assert list(default.left_out) == cloud.provenance["left_out"]
    assert default.instances == len(cloud.instances)


def test_labels_are_judged_by_the_word_bank_that_a_fit_has(folder, tmp_path):
    for file in folder.iterdir():
        (tmp_path / file.name).symlink_to(file)
    with np.load(folder / "mask_features.npz") as masks:  # words that fit what masks show better than its name does
        rows = np.concatenate([rows for name, rows in masks.items() if name != "feature_space"])
        everyday = rows[np.arange(60) % len(rows)] + np.random.default_rng(0).normal(0, 0.01, (60, rows.shape[1]))
        bank = {"names": np.array([f"word {k}" for k in range(len(everyday))]), "vectors": everyday}
        np.savez(tmp_path / "word_bank.npz", feature_space=masks["feature_space"], **bank)
    subject = read_subject(tmp_path)
    (found,) = sweep([subject], [DEFAULT], progress=False).rows[:1]
    space = FeatureSpace(subject.scene.feature_space, subject.scene.feature_width)
    cloud = scene_words(space, capture=tmp_path).added_to(fit(subject.scene, progress=False))
    as_eval = subject.truth.score(ask(cloud, subject.truth, tmp_path / "text_features.npz").called)
    assert found.miou == as_eval.miou
    plain = read_subject(folder)
    assert found.unknown > sweep([plain], [DEFAULT], progress=False).rows[0].unknown


def test_a_capture_that_cannot_be_fitted_is_named_and_costs_no_other(subject, monkeypatch):
    monkeypatch.setattr(sweeping, "needs_tiles", lambda scene, _: scene.views[0].name == "large")
    views = (replace(subject.scene.views[0], name="large"), *subject.scene.views[1:])
    large = replace(subject, name="large", scene=replace(subject.scene, views=views))
    found = sweep([large, subject], [DEFAULT], progress=False)
    assert found.captures == ["capture"]
    assert "large: 1,576 points need more memory" in found.failed["large"]
    with pytest.raises(OgPointcloudError, match=r"no capture could be fitted: large: .* report on a part"):
        sweep([large], [DEFAULT], progress=False)


def test_front_is_what_no_row_beats():
    random = np.random.default_rng(0)
    rows = [row(float(s), float(e)) for s, e in random.integers(1, 12, (60, 2)) / 12]
    literal = [
        one
        for one in rows
        if not any(
            (o.seconds <= one.seconds and o.error <= one.error) and (o.seconds, o.error) != (one.seconds, one.error)
            for o in rows
        )
    ]
    assert {(r.seconds, r.error) for r in front(rows)} == {(r.seconds, r.error) for r in literal}


def test_a_capture_that_cannot_be_judged_is_refused_at_once(folder, tmp_path):
    other = tmp_path / "other"
    shutil.copytree(folder, other)
    np.savez(other / "gt.npz", names=np.array(NAMES), cls=np.zeros(3, int))
    with pytest.raises(SceneError, match="the truth has 3 points"):
        read_subject(other)
    shutil.copy(folder / "gt.npz", other / "gt.npz")
    words = dict(np.load(other / "text_features.npz"))
    np.savez(other / "text_features.npz", **(words | {"feature_space": np.array("another/model")}))
    with pytest.raises(FeatureSpaceError, match="are in feature space 'another/model'"):
        read_subject(other)


# Other methods --------------------------------------------------------------------------------------------------


def test_direct_uplift_is_the_weighted_mean_word_by_word(subject, prepared):
    words = subject.vocabulary.vectors.astype(np.float64)
    features = prepared.table.unit_features.astype(np.float64)
    weights = prepared.table.weights.toarray().astype(np.float64)
    literal = np.full(weights.shape[1], -1)
    for point in range(weights.shape[1]):
        if weights[:, point].sum() > 0:
            mean = sum(weight * feature for weight, feature in zip(weights[:, point], features, strict=True))
            literal[point] = np.argmax([mean @ (word / np.linalg.norm(word)) for word in words])
    np.testing.assert_array_equal(BASELINES["direct uplift"](prepared, words), literal)


def test_center_sampling_reads_the_pixel_of_each_center(subject, prepared):
    scene, table, words = subject.scene, prepared.table, subject.vocabulary.vectors
    labels = prepared.surface.of_points(BASELINES["center sampling"](prepared, words))
    exposure, similarity = prepared.surface.of_points(table.exposure.toarray().T).T, table.unit_features @ words.T
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


def test_points_shown_mostly_outside_of_masks_lose_their_label():
    weights, outside = csr_array([[3.0, 1.0, 0.0, 2.0], [0.0, 2.0, 0.0, 0.0]]), csr_array([[2.0, 4.0, 1.0, 2.0]])
    shown = SimpleNamespace(table=SimpleNamespace(weights=weights, outside=outside))
    labels = only_where_masked(np.array([5, 6, 7, 8]), shown)
    np.testing.assert_array_equal(labels, [5, -1, -1, -1])  # 3 of 5, 3 of 7, 0 of 1, half


# Files and the command ------------------------------------------------------------------------------------------


def test_the_report_names_what_is_left_out_and_what_failed(tmp_path):
    entry = left_out_entry(LeftOut.PIXELS_IN_PAPER_MODE, share=0.75, most=76_800, stride=2)
    default = replace(row(2.0, 0.1, "default", ""), left_out=(entry,))
    others = (row(1.0, 0.2, "views", "one of |2|"), row(3.0, 0.4, BASELINE, "direct uplift"))
    found = Sweep((default, *others), {"c, mode: fast": "no mask"})
    text = write_report(found, tmp_path / "r.md", tmp_path / "r.png").read_text()
    for words in (
        f"- {entry['what']}: {entry['why']}", "- c, mode: fast: no mask", "![error against seconds](r.png)",
        "| default * | 2.00 | 0.1000 |", "| views: one of &#124;2&#124; * | 1.00 |",
        "| baseline: direct uplift | 3.00 |",
    ):  # fmt: skip
        assert words in text
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert len({line.count("|") for line in lines}) == 1
    alone = write_chart(Sweep((row(2.0, 0.0, "default", ""),), {}), tmp_path / "r.png")  # one row, no error
    assert alone.read_bytes().startswith(PNG)


def test_seconds_of_the_chart_are_plain_numbers(tmp_path, monkeypatch):
    ticks = []

    def keep(figure, *_, **__):
        figure.canvas.draw()
        ticks.extend(label.get_text() for label in figure.axes[0].get_xticklabels(which="both"))

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", keep)
    write_chart(Sweep((row(2.0, 0.1, "default", ""), row(20.0, 0.1, "views", "all")), {}), tmp_path / "r.png")
    assert {"2", "10", "20"} <= set(ticks)


@pytest.mark.slow
def test_the_command_writes_table_chart_and_report(folder, tmp_path, capsys):
    out = tmp_path / "r"
    printed = output_of(capsys, "report", folder, "--knob", "views", "--knob", "sure share", "-o", out)
    assert f"wrote {out / 'report.md'}" in printed
    assert "views: one of 2" in printed
    rows = {(r["knob"], r["value"]): r for r in csv.DictReader((out / "report.csv").open())}
    assert float(rows["default", ""]["miou"]) > 0.8
    assert all(float(one["seconds"]) > 0 and 0 <= float(one["error"]) <= 1 for one in rows.values())
    assert "cores" in rows["default", ""]["machine"]
    assert cv2.imread(str(out / "report.png")).shape[2] == 3
    assert "sure share: 0.4" in (out / "report.md").read_text()


def test_bad_use_is_one_error(tmp_path, capsys):
    assert "'color' is not a knob" in error_of(capsys, "report", tmp_path, "--knob", "color")
    for name in "ab":
        (tmp_path / name / "x").mkdir(parents=True)
    error = error_of(capsys, "report", tmp_path / "a" / "x", tmp_path / "b" / "x", "-o", tmp_path / "r")
    assert "two captures are in folders named 'x'" in error
