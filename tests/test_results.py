"""The table of results: what its script prints is what the scorers say."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from scenes import NAMES, write_tiny_capture

import og_pointcloud as og
from og_pointcloud.evaluate.baselines import baseline_labels
from og_pointcloud.evaluate.intervals import Interval
from og_pointcloud.fitting.fit import prepare

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def script():
    sys.path.insert(0, str(ROOT / "scripts"))
    import write_results

    yield write_results
    sys.path.remove(str(ROOT / "scripts"))


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    made = write_tiny_capture(tmp_path_factory.mktemp("results") / "tiny")
    ids = made.object_ids
    np.savez(made.folder / "gt.npz", names=np.array(NAMES), cls=ids, background=ids < 0)
    return made


def literal_miou(said, cls):
    """Names said of each point, against classes; the floor's points have none, and a name there is a false one."""
    ious = [((said == n) & (cls == k)).sum() / ((said == n) | (cls == k)).sum() for k, n in enumerate(NAMES)]
    return float(np.mean(ious))


@pytest.mark.slow
def test_a_row_is_what_the_scorers_say(script, capture, tmp_path, capsys):
    script.main([str(capture.folder), "--runs", "1"])
    _, _, line = capsys.readouterr().out.strip().splitlines()
    row = line.strip("| ").split(" | ")
    assert row[0] == f"tiny, 6 views, {len(capture.object_ids):,} points"
    scene = og.read_capture(capture.folder)
    og.write_bundle(og.fit(scene, progress=False), tmp_path / "s.ogpc")
    result = og.segment(og.load(tmp_path / "s.ogpc"), None, text_features=capture.text_features)
    ours = literal_miou(np.array([*result.names, ""])[result.labels], capture.object_ids)
    words, prepared = np.load(capture.text_features), prepare(scene)
    names = np.array([*words["names"], ""])
    plain = [
        literal_miou(names[labels], capture.object_ids) for _, labels, _ in baseline_labels(prepared, words["vectors"])
    ]
    assert row[1].startswith(f"**{ours:.3f}** (")
    assert row[2].startswith(f"{max(plain):.3f} (")
    assert row[3] == f"{np.mean(result.labels[capture.object_ids < 0] >= 0):.3f}"
    assert row[4] == f"{np.mean(result.labels[capture.object_ids >= 0] < 0):.3f}"
    assert float(row[5]) > 0


def test_rooms_share_a_line(script):
    def room(miou, plain):
        return script.Result("room", Interval(miou, miou - 0.1, miou + 0.1), ("direct uplift", plain), 0.02, 0.1, 8.0)

    line = script.table([script.mean_of_rooms([room(0.9, 0.5), room(0.8, 0.4)])]).splitlines()[-1]
    # Draws of two rooms: both the one, both the other, or one each.
    assert (
        line == "| mean of 2 demo rooms | **0.850** (0.800 to 0.900) | 0.450 (each room's best) | 0.020 | 0.100 | 8.0 |"
    )


@pytest.mark.slow
def test_photographs_become_a_capture_that_can_be_scored(script, capture, tmp_path):
    folder, space = tmp_path / "photographs", np.array("tiny-test-space")
    bank = np.random.default_rng(0).normal(size=(60, 16))
    np.savez(capture.folder / "word_bank.npz", names=np.arange(60).astype(str), vectors=bank, feature_space=space)
    before = {file: file.read_bytes() for file in capture.folder.rglob("*") if file.is_file()}
    assert script.photograph(capture.folder, folder) > 0
    assert {file: file.read_bytes() for file in capture.folder.rglob("*") if file.is_file()} == before
    assert not (folder / "word_bank.npz").exists()  # it was of another encoder
    scene = og.read_capture(folder)
    assert scene.feature_space != og.read_capture(capture.folder).feature_space
    assert sum(view.mask_count for view in scene.views) > 0
    words = np.load(folder / "text_features.npz")
    assert words["names"].tolist() == list(NAMES)
    assert words["vectors"].shape[1] == scene.feature_width
    assert (folder / "gt.npz").read_bytes() == (capture.folder / "gt.npz").read_bytes()
