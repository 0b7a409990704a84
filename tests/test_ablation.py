"""Ablations: rows against fits of their own, the score, the truth that is read, and the files."""

import csv
import json
import sys
import warnings
from dataclasses import replace

import numpy as np
import pytest
from conftest import FEATURE_SPACE, NAMES, write_tiny_capture

import og_pointcloud as og
from og_pointcloud.errors import FeatureSpaceError, MissingExtraError, OgPointcloudError, SceneError
from og_pointcloud.evaluate import ablation
from og_pointcloud.evaluate.ablation import (
    PUBLISHED_MIOU,
    ablate,
    average,
    cases,
    read_vocabulary,
    write_csv,
)
from og_pointcloud.evaluate.metrics import score_labels
from og_pointcloud.evaluate.truth import read_truth
from og_pointcloud.fitting.fit import fit, prepare
from og_pointcloud.fitting.learned.instance_features import learn_features
from og_pointcloud.formats.capture import read_capture
from og_pointcloud.settings import FeatureSettings


@pytest.fixture(scope="module")
def subject(tmp_path_factory):
    """(folder, scene, prepared, truth, vocabulary) of the tiny capture, with its truth beside it."""
    capture = write_tiny_capture(tmp_path_factory.mktemp("ablation") / "capture")
    truth = {"cls": capture.object_ids, "background": capture.object_ids < 0}
    np.savez(capture.folder / "gt.npz", names=np.array(NAMES), **truth)
    scene = read_capture(capture.folder)
    return (
        capture.folder,
        scene,
        prepare(scene),
        read_truth(capture.folder),
        read_vocabulary(capture.folder, scene.feature_space),
    )


@pytest.fixture(scope="module")
def rows(subject):
    return run(subject)


def run(subject, **options):
    _, scene, prepared, truth, vocabulary = subject
    return ablate(scene, truth, vocabulary, prepared=prepared, progress=False, **options)


def row_of(rows, table, name):
    return next(row for row in rows if (row.table, row.name) == (table, name))


def test_rows_score_as_fits_of_their_own(subject, rows):
    """Stages that rows share give what a whole fit with the row's settings gives, asked like any other file."""
    folder, scene, prepared, truth, _ = subject
    words = folder / "text_features.npz"
    compared = 0
    for case, row in zip(cases(), rows, strict=True):
        assert (case.table, case.name) == (row.table, row.name)
        if case.evidence == "alone":
            continue
        cloud = fit(scene, case.settings, progress=False, prepared=prepared)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # clusters as many as the published ones are all unknown here
            result = og.segment(cloud, text_features=words)
        names = [NAMES.index(name) if name in NAMES else len(NAMES) for name in result.names] + [-1]
        score = score_labels(np.array(names)[result.labels], truth.cls)
        strict = score_labels(np.array(names)[result.labels], truth.cls, background=truth.background)
        assert (row.miou, row.macc, row.unknown_share) == (score.miou, score.macc, score.unknown_share), row.name
        assert (row.strict_miou, row.background_called) == (strict.miou, strict.background_called)
        compared += 1
    assert compared > 15


def test_what_is_literal_is_so_in_all_three_tables(rows):
    literal = [
        row_of(rows, table, name)
        for table, name in (("losses", "both"), ("codebook", "two levels, xyz"), ("association", "both, visible"))
    ]
    assert len({(row.miou, row.macc, row.clusters) for row in literal}) == 1
    assert all(row.seconds > 0 for row in rows)
    assert row_of(rows, "reference", "grouping").miou > 0.9


@pytest.mark.parametrize("base", ["fast", "paper"])
def test_every_row_of_the_paper_is_there(base):
    names = {(case.table, case.name) for case in cases(base)}
    assert {(table, name) for table, published in PUBLISHED_MIOU.items() for name in published} <= names
    assert len(names) == len(cases(base)), "a table has no two rows of one name"


def test_the_share_of_the_schedule_is_said():
    (literal,) = [case for case in cases("paper", 0.05) if (case.table, case.name) == ("losses", "both")]
    assert literal.method == "paper, 0.05 of its schedule"
    assert literal.settings.paper.schedule_share == 0.05


def test_rows_trained_by_rendering_score_as_their_fit(subject):
    pytest.importorskip("torch")
    folder, scene, _, truth, _ = subject
    wanted = []
    for case in cases("paper", 0.0005):
        if case.name in ("both", "IoU only, visible", "two levels"):  # so little training makes no whole things
            matching = replace(case.settings.paper.matching, threshold=0.01, min_views=1)
            paper = replace(case.settings.paper, k1=4, k2=2, matching=matching)
            wanted.append(replace(case, settings=replace(case.settings, paper=paper)))
    found = run(subject, only=wanted)
    assert len(found) == 3
    for case, row in zip(wanted, found, strict=True):
        cloud = fit(scene, case.settings, progress=False)
        result = og.segment(cloud, text_features=folder / "text_features.npz")
        score = score_labels(result.labels, truth.cls)
        assert (row.miou, row.clusters) == (score.miou, len(cloud.instances))
        assert row.miou > 0.1


def test_seeds_and_captures_are_averaged(subject):
    wanted = [case for case in cases() if case.name in ("inter only", "one level, k = 64")]
    single = [run(subject, only=wanted, seeds=[seed]) for seed in (0, 1)]
    both = run(subject, only=wanted, seeds=[0, 1], name="two")
    for first, second, row in zip(*single, both, strict=True):
        assert row.runs == 2
        assert row.miou == pytest.approx((first.miou + second.miou) / 2)
        assert row.miou_spread == pytest.approx(abs(first.miou - second.miou) / np.sqrt(2))
    changed = [replace(row, miou=row.miou + 0.2, strict_miou=None, miou_spread=0.3) for row in both]
    for mean, row in zip(average([both, changed]), both, strict=True):
        assert mean.captures == "mean of 2"
        assert mean.miou == pytest.approx(row.miou + 0.1)
        assert mean.strict_miou == row.strict_miou, "where no background is known there is nothing to average"
        assert mean.miou_spread == pytest.approx(np.hypot(row.miou_spread, 0.3) / 2)
    with pytest.raises(OgPointcloudError, match="0 seeds"):
        run(subject, seeds=[])


def test_random_starts_are_of_points_not_of_masks(subject):
    """Unlearned, points of one mask are alike from masks and not from random ones."""
    table = subject[2].table
    spread = {
        start: learn_features(table, FeatureSettings(start=start, max_steps=0)).cohesion[0]
        for start in ("masks", "random")
    }
    assert spread["masks"] < 0.5 * spread["random"]
    with pytest.raises(OgPointcloudError, match='"masks" or "random"'):
        FeatureSettings(start="zero")  # type: ignore[arg-type]


def test_csv_holds_every_number(rows, tmp_path):
    with write_csv(rows, tmp_path / "a.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == len(rows)
    for line, row in zip(lines, rows, strict=True):
        assert float(line["miou"]) == pytest.approx(row.miou, rel=1e-5)
        assert json.loads(line["settings"])["codebook"]["k1"] == row.settings["codebook"]["k1"]
        assert line["miou_spread"] == ""
    assert [line["published_miou"] for line in lines][:3] == ["0.3524", "0.2589", "0.3829"]


def test_plot_is_a_picture(rows, tmp_path):
    pytest.importorskip("matplotlib")
    data = ablation.plot(rows, tmp_path / "a.png", "tiny").read_bytes()
    assert data.startswith(b"\x89PNG")
    assert data.endswith(b"IEND\xaeB`\x82")
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]


def test_matplotlib_is_named_where_it_lacks(rows, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(MissingExtraError, match=r"og-pointcloud\[report\]"):
        ablation.plot(rows, tmp_path / "a.png")


CLS = np.array([0, 1, -1, 0])


@pytest.mark.parametrize(
    ("entries", "text"),
    [
        ({"cls": CLS}, "lacks 'names'"),
        ({"cls": CLS.astype(float), "names": np.array(["a", "b"])}, "cls is float64"),
        ({"cls": CLS, "names": np.array(["a"])}, "up to 1, names"),
        ({"cls": CLS, "names": np.array(["a", "b"]), "views": np.ones(3)}, "views has shape"),
        ({"cls": CLS, "names": np.array(["a", None], object)}, "cannot be read"),
    ],
)  # fmt: skip
def test_a_bad_truth_is_refused(entries, text, tmp_path):
    np.savez(tmp_path / "gt.npz", **entries)
    with pytest.raises(SceneError, match=text):
        read_truth(tmp_path)


def test_an_absent_or_damaged_truth_is_refused(tmp_path):
    with pytest.raises(SceneError, match="is not a file"):
        read_truth(tmp_path)
    (tmp_path / "gt.npz").write_bytes(b"PK\x03\x04 nothing of the kind")
    with pytest.raises(SceneError, match="cannot be read"):
        read_truth(tmp_path)


def test_doubtful_truth_is_not_scored(tmp_path):
    votes = {"views": np.array([1, 0, 3, 4]), "ratio": np.array([0.5, 1, 0.4, 1]), "votes": np.array([2, 9, 9, 1])}
    np.savez(tmp_path / "gt.npz", cls=CLS, names=np.array(["a", "b"]), **votes)
    assert read_truth(tmp_path).scored.tolist() == [True, False, False, False]


def test_words_of_another_encoder_are_refused(subject):
    folder, scene, _, truth, vocabulary = subject
    assert scene.feature_space == FEATURE_SPACE
    with pytest.raises(FeatureSpaceError, match="'another space'"):
        read_vocabulary(folder, "another space")
    narrow = replace(vocabulary, vectors=np.ascontiguousarray(vocabulary.vectors[:, :5]))
    with pytest.raises(FeatureSpaceError, match="width 5"):
        ablate(scene, truth, narrow)
    with pytest.raises(SceneError, match="the truth is of 4 points"):
        ablate(scene, replace(truth, cls=CLS), vocabulary)
