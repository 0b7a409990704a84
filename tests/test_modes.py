"""The modes from masks to instances, on boxes whose truth is known, and the choice between them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from string import Formatter
from typing import Any, get_args, get_type_hints

import numpy as np
import pytest
from test_fit import BOXES, boxes_on_a_table

from og_pointcloud.cloud import BACKGROUND, UNOBSERVED, LabelledCloud
from og_pointcloud.fitting import fit as fit_module
from og_pointcloud.fitting import labellers
from og_pointcloud.fitting.fit import fit, prepare
from og_pointcloud.fitting.grouping import indicator
from og_pointcloud.fitting.labellers import LABELLERS, fast
from og_pointcloud.fitting.learned.codebook import Codebook
from og_pointcloud.journal import Journal, LeftOut, left_out_entry
from og_pointcloud.settings import CodebookSettings, FitSettings, MatchingSettings, PaperSettings

MODES = get_args(get_type_hints(FitSettings)["mode"])
PAPER = PaperSettings(schedule_share=0.004, k1=8, k2=2, feature_rate=0.02)
"""Some eighty steps a stage: enough for four boxes that every view sees."""


def box_purity(cloud: LabelledCloud, truth: np.ndarray) -> tuple[float, int]:
    """Of the boxes' points that are in an instance, the share whose instance is mostly of their box; boxes that lead
    in some instance."""
    ids = cloud.instance_ids
    known = (ids >= 0) & (truth < BOXES)
    votes = np.zeros((len(cloud.instances), BOXES), int)
    np.add.at(votes, (ids[known], truth[known]), 1)
    lead = votes.argmax(axis=1)
    return float((lead[ids[known]] == truth[known]).mean()), len(np.unique(lead[votes.any(axis=1)]))


@pytest.mark.parametrize("mode", ["grouping", "fast", pytest.param("paper", marks=pytest.mark.slow)])
def test_every_mode_finds_the_boxes(mode: str) -> None:
    if mode == "paper":
        pytest.importorskip("torch")
    known = boxes_on_a_table()
    cloud = fit(known.scene, FitSettings(mode=mode, paper=PAPER), progress=False)  # type: ignore[arg-type]
    purity, boxes = box_purity(cloud, known.truth)
    assert boxes == BOXES
    assert purity > (0.85 if mode == "paper" else 0.97)
    assert len(cloud.instances.descriptors) >= BOXES
    assert cloud.provenance["settings"]["mode"] == mode
    assert {stage["name"] for stage in cloud.provenance["stages"]} >= {"visibility"}


def test_ids_are_the_same_on_every_run() -> None:
    first, second = (fit(boxes_on_a_table().scene, FitSettings(mode="fast"), progress=False) for _ in range(2))
    np.testing.assert_array_equal(first.instance_ids, second.instance_ids)
    np.testing.assert_array_equal(first.instances.descriptors, second.instances.descriptors)


def test_paper_mode_draws_points_as_full_as_trained_gaussians() -> None:
    """Each rendered alone must cover its pixels; Gaussians of a file stay as they are."""
    scene = boxes_on_a_table().scene
    full = prepare(scene, FitSettings(mode="paper")).surface
    np.testing.assert_allclose(full.gaussians.scale, np.repeat(0.7 * full.neighborhood.spacing[:, None], 3, axis=1))
    np.testing.assert_allclose(full.gaussians.opacity, 0.95)
    drawn = full.gaussians.take(full.row_of_point)
    own = {"scale": drawn.scale * 2, "rotation": drawn.rotation, "opacity": drawn.opacity / 2}
    surface = prepare(replace(scene, points=replace(scene.points, **own)), FitSettings(mode="paper")).surface
    trained = surface.gaussians.take(surface.row_of_point)
    np.testing.assert_array_equal(trained.scale, own["scale"])
    np.testing.assert_array_equal(trained.opacity, own["opacity"])


def test_literal_leaves_know_no_background() -> None:
    """The paper gives every point that shows in a mask a leaf; what no mask shows is unobserved, not background."""
    known = boxes_on_a_table()
    prepared = prepare(known.scene)
    settings = FitSettings(matching=MatchingSettings(settle=False))
    literal = fast(prepared.table, prepared.surface, settings, Journal(False))
    shown = np.asarray(prepared.table.weights.sum(axis=0)).ravel() > 0
    np.testing.assert_array_equal(literal.instance_ids >= 0, shown)
    assert (literal.instance_ids[~shown] == UNOBSERVED).all()
    settled = fast(prepared.table, prepared.surface, FitSettings(), Journal(False))
    settled = settled.of_points(prepared.surface.row_of_point)
    assert (settled.instance_ids[known.truth == BOXES] == BACKGROUND).mean() > 0.5


def test_fast_mode_names_the_coarse_cluster_of_every_instance() -> None:
    known = boxes_on_a_table()
    cloud = fit(known.scene, FitSettings(mode="fast", codebook=CodebookSettings(k1=2)), progress=False)
    assert set(np.unique(cloud.instances.coarse)) <= {0, 1}
    grouped = fit(known.scene, FitSettings(mode="grouping"), progress=False)
    assert (grouped.instances.coarse == -1).all()


def test_leaves_are_decided_on_largest_first_whatever_their_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where masks of two overlap, the smaller one may have a point: which is smaller goes by number."""
    prepared = prepare(boxes_on_a_table().scene)
    given, books = [], []
    decide, build = labellers.assign_and_correct_groups, labellers.two_level_codebook

    def renumbered(*arguments: Any) -> Codebook:
        book = build(*arguments)
        order = np.random.default_rng(len(books)).permutation(len(book.leaf_coarse))
        number = np.append(np.argsort(order), -1).astype(np.int32)
        books.append(replace(
            book, leaf=number[book.leaf], leaf_centers=book.leaf_centers[order], leaf_coarse=book.leaf_coarse[order]
        ))  # fmt: skip
        return books[-1]

    monkeypatch.setattr(labellers, "two_level_codebook", renumbered)
    monkeypatch.setattr(labellers, "assign_and_correct_groups", lambda *a: given.append(a[2].group) or decide(*a))
    settings = FitSettings(codebook=CodebookSettings(k1=3))
    found = [fast(prepared.table, prepared.surface, settings, Journal(False)) for _ in range(3)]
    for groups, book in zip(given, books, strict=True):
        np.testing.assert_array_equal(groups, given[0])
        # The leaf that masks of each group show most of.
        points, in_leaf = np.bincount(book.leaf[book.leaf >= 0]), indicator(book.leaf, len(book.leaf_coarse))
        shown = [(prepared.table.weights[groups == group] @ in_leaf.T).sum(axis=0) for group in range(len(points))]
        assert len(np.unique(points)) == len(points) > 2
        assert (np.diff(points[np.argmax(shown, axis=1)]) < 0).all()
    for each in found:
        np.testing.assert_array_equal(each.instance_ids, found[0].instance_ids)


def test_every_mode_has_its_labeller_and_auto_is_the_default_by_another_name() -> None:
    assert tuple(LABELLERS) == MODES
    assert LABELLERS["auto"] is LABELLERS[FitSettings().mode]


@pytest.mark.parametrize("key", LeftOut)
def test_whatever_is_left_out_has_its_sentences(key: LeftOut) -> None:
    """Told whole numbers, as a journal may be."""
    names = [name for text in (key.what, key.why) for _, name, _, _ in Formatter().parse(text) if name]
    entry = left_out_entry(key, **dict.fromkeys(names, 7))
    assert entry["key"] == key.key
    assert entry["what"]
    assert entry["why"]
    assert [entry[name] for name in names] == [7] * len(names)


@pytest.mark.slow
def test_a_killed_fit_in_paper_mode_continues_its_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paper = pytest.importorskip("og_pointcloud.fitting.learned.paper")
    scene = boxes_on_a_table().scene
    monkeypatch.setattr(fit_module, "KEEP_AFTER_S", 0)  # else a short fit keeps nothing
    settings = FitSettings(mode="paper", paper=replace(PAPER, schedule_share=0.0005))
    expected = fit(scene, settings, progress=False)
    monkeypatch.setattr(paper, "CHECKPOINT_SECONDS", 0)
    with monkeypatch.context() as patch:
        patch.setattr(paper, "train_codebook", _interrupt)
        with pytest.raises(KeyboardInterrupt):
            fit(scene, settings, work=tmp_path / "work", progress=False)
    cloud = fit(scene, settings, work=tmp_path / "work", progress=False)
    np.testing.assert_array_equal(cloud.instance_ids, expected.instance_ids)
    assert [stage["resumed_at"] for stage in cloud.provenance["notes"]["training"]] == [10, 0, 0]
    assert not (tmp_path / "work").exists()


def _interrupt(*_: object) -> None:
    raise KeyboardInterrupt


@pytest.mark.slow
def test_paper_mode_says_how_long_the_published_schedule_would_take() -> None:
    pytest.importorskip("torch")
    known = boxes_on_a_table()
    settings = FitSettings(mode="paper", paper=replace(PAPER, schedule_share=0.0005))
    training = fit(known.scene, settings, progress=False).provenance["notes"]["training"]
    assert [stage["stage"] for stage in training] == ["features", "coarse codebook", "fine codebook"]
    for stage in training:
        assert stage["steps"] == 10
        assert stage["published_steps"] == 20_000
        assert stage["published_seconds"] == pytest.approx(2000 * stage["seconds"], abs=2)
