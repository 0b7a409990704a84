"""The benchmark of choosing on the tiny capture: its rows must follow from its answers."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import benchmark_choosing as bench
import numpy as np
import pytest
from labelled_clouds import unit_rows
from scenes import FEATURE_SPACE, NAMES, TinyCapture

from og_pointcloud.ask.choosing import Choice, Chooser
from og_pointcloud.cloud import WordBank
from og_pointcloud.errors import OgPointcloudError

WIDTH = 16


@pytest.fixture
def scored_capture(tiny_capture: TinyCapture) -> Path:
    """The tiny capture with its truth, and a floor whose points are known background."""
    np.savez(
        tiny_capture.folder / "gt.npz",
        cls=tiny_capture.object_ids,
        names=np.array(NAMES),
        background=tiny_capture.object_ids < 0,
    )
    return tiny_capture.folder


def words_file(folder: Path) -> Path:
    path = folder / "words.npz"
    bank, absent = unit_rows(200, WIDTH, 1), unit_rows(90, WIDTH, 2)
    np.savez(
        path,
        home_names=np.array(["object", *(f"home {i}" for i in range(199))]), home_text=bank,
        zoo_names=np.array([f"zoo {i}" for i in range(90)]), zoo_text=absent,
    )  # fmt: skip
    return path


def test_rows_of_a_capture(scored_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "DRAWS", 3)
    output = tmp_path / "out"
    arguments = [str(scored_capture), "--words", str(words_file(tmp_path)), "--bank", "home", "--absent", "zoo"]
    bench.main([*arguments, "--fitted", str(tmp_path / "fitted"), "-o", str(output)])
    with open(output / "choosing.csv") as file:
        rows = {row["method"]: row for row in csv.DictReader(file)}
    assert rows["argmax, CLIP's softmax"]["called_absent"] == "1.0"
    assert float(rows["bank"]["called_absent"]) < float(rows["LERF relevancy"]["called_absent"]) <= 1
    assert float(rows["bank"]["miou"]) <= float(rows["argmax, CLIP's softmax"]["miou"])
    assert float(rows["argmax, CLIP's softmax"]["miou"]) > 0.6
    assert all(row["unobserved_called"] == "0" and row["capture"] == "capture" for row in rows.values())
    assert (output / "reliability.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "fitted" / "capture.ogpc").is_file()  # and the next run reads it


def test_a_set_of_words_that_is_not_there(scored_capture: Path, tmp_path: Path) -> None:
    arguments = [str(scored_capture), "--words", str(words_file(tmp_path)), "--bank", "farm", "-o", str(tmp_path)]
    with pytest.raises(OgPointcloudError, match="no array 'farm_text'"):
        bench.main(arguments)


def test_absent_words_are_drawn_alike_and_far_from_present_ones(scored_capture: Path, tmp_path: Path) -> None:
    words = dict(np.load(words_file(tmp_path)))
    asked, truth = np.load(scored_capture / "text_features.npz")["vectors"][:2], np.load(scored_capture / "gt.npz")
    assert truth["cls"].max() == 1
    words["zoo_text"][:3] = asked[0] + 0.1 * unit_rows(3, WIDTH, 3)
    first, again = (bench.load_case(scored_capture, tmp_path, words, ["home"], "zoo") for _ in range(2))
    middle = first.bank.mean(axis=0)
    for draw, same in zip(first.absent, again.absent, strict=True):
        assert len(np.unique(draw, axis=0)) == len(draw) <= bench.ABSENT_WORDS
        np.testing.assert_array_equal(draw, same)
        assert (bench.unit(draw - middle) @ bench.unit(bench.unit(asked) - middle).T).max() < bench.RELATED
    assert len(first.negatives) == 1  # "object" alone of LERF's four


def test_simulated_captures_get_words_of_their_encoder(scored_capture: Path, tmp_path: Path) -> None:
    texts = np.load(scored_capture / "text_features.npz")
    np.savez(
        scored_capture / "text_features.npz",
        names=texts["names"], vectors=texts["vectors"], feature_space=np.array(f"simulated-{FEATURE_SPACE}"),
    )  # fmt: skip
    masks = dict(np.load(scored_capture / "mask_features.npz"))
    masks["feature_space"] = np.array(f"simulated-{FEATURE_SPACE}")
    np.savez(scored_capture / "mask_features.npz", **masks)
    case = bench.load_case(scored_capture, tmp_path, {}, [], "")
    assert case.bank.shape == (800, WIDTH)
    assert all(draw.shape == (bench.ABSENT_WORDS, WIDTH) for draw in case.absent)


def test_made_words_share_what_texts_share() -> None:
    texts = bench.unit(np.concatenate([np.full((9, 1), 2.0), unit_rows(9, 63)], axis=1))
    made = bench.made_words(texts, 400, np.random.default_rng(0))
    np.testing.assert_allclose(np.linalg.norm(made, axis=1), 1, atol=1e-5)
    off_diagonal = ~np.eye(400, dtype=bool)
    assert (made @ made.T)[off_diagonal].mean() == pytest.approx((made @ texts.T).mean(), abs=0.02)
    assert (made @ made.T)[off_diagonal].mean() == pytest.approx(0.8, abs=0.05)  # 4 / (4 + 1)


def test_calibration_error_by_hand() -> None:
    # Bin 0.6: said 0.65 on average, right 1 of 2; bin 0.9: said 0.95, right 2 of 2; 1.0 falls into the last bin.
    judgements = np.array([[0.62, 1], [0.68, 0], [0.9, 1], [1.0, 1]])
    assert bench.calibration_error(judgements) == pytest.approx(0.5 * 0.15 + 0.5 * 0.05)
    assert bench.calibration_error(np.zeros((0, 2))) == 0
    assert [len(part) for part in bench.binned(judgements)] == [2, 2]


def test_judgements_count_background_as_wrong(scored_capture: Path, tmp_path: Path) -> None:
    case = bench.load_case(scored_capture, tmp_path, dict(np.load(words_file(tmp_path))), ["home"], "zoo")
    choice = Chooser(case.cloud.instances, WordBank(case.bank)).choose(case.texts)
    truth, ids = np.load(scored_capture / "gt.npz"), case.cloud.instance_ids
    everything = replace(case, cloud=replace(case.cloud, instance_ids=np.maximum(ids, 0)))
    judged = bench.judged(everything, choice)
    assert len(judged) == len(ids)
    assert judged[truth["background"], 1].sum() == 0
    assert judged[:, 1].sum() > 400
    assert judged[:, 0].max() <= choice.membership.max()


def test_an_answer_by_a_threshold() -> None:
    table = np.array([[0.2, 0.7], [0.3, 0.4], [0.9, 0.1]], np.float32)
    none, ones = np.full(3, -1, np.int32), np.ones(3, np.float32)
    evidence = np.array([[0, 0], [0, 0], [-np.inf, -np.inf]], np.float32)
    choice = Choice(none, ones, ones, table, evidence, np.zeros(3, np.int8), ones / 2)
    answered = bench.answer(choice, table, threshold=0.5)
    np.testing.assert_array_equal(answered.labels, [1, -1, -1])
    np.testing.assert_allclose(answered.probability, [0.7, 0, 0])
