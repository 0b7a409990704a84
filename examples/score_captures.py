"""Fit captures that come with ground truth, as the command does, and score the file and direct uplift: a row each.

    python examples/score_captures.py CAPTURE [CAPTURE ...] [--runs 3]

A capture's ``gt.npz`` holds ``cls`` (a class per point, -1 none) and ``names``, and where known ``background``,
``views``, ``ratio`` and ``votes``; it is read for the score alone. ``text_features.npz`` holds the names asked, and
``word_bank.npz``, where there is one, everyday words that they are judged by. No setting differs between captures.

Beside ours stands direct uplift on the same mask table: every point takes the mean feature of the masks that show it;
"masked" the same, but points that views show mostly outside of masks take none. Intervals are of 95 %, over blocks of
space; "gain" is ours less the better of the two, paired. "fit s" is the whole command, folder to file, in a process of
its own; "first s" a new process that imports, opens the file and labels every point. Both are the least of the runs.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import og_pointcloud as og
from og_pointcloud.evaluate.baselines import direct_uplift, only_where_masked
from og_pointcloud.evaluate.captures import ask
from og_pointcloud.evaluate.intervals import BlockInterval, miou_difference, miou_interval
from og_pointcloud.evaluate.metrics import Score, score_labels
from og_pointcloud.evaluate.truth import Truth, read_truth
from og_pointcloud.fitting.fit import prepare
from og_pointcloud.formats.capture import read_capture
from og_pointcloud.text.text_features import read_text_features

WORDS, BANK = "text_features.npz", "word_bank.npz"
COMMAND = "from og_pointcloud.cli import main; raise SystemExit(main())"
FIRST_ANSWER = """
import sys, time
start = time.perf_counter()
import og_pointcloud as og
scene = og.load(sys.argv[1])
og.segment(scene, None, text_features=sys.argv[2])
print(time.perf_counter() - start)
"""


@dataclass(frozen=True)
class CaptureRow:
    """One capture. miou: of our labels, with its interval. uplift, masked: mIoU of direct uplift, and of it only where
    points lie mostly in masks. gain: ours less the better of these, paired. fit_s, first_s: least of the runs.
    file_mb: 1e6 bytes."""

    capture: str
    views: int
    points: int
    instances: int
    score: Score
    miou: BlockInterval
    uplift: float
    masked: float
    gain: BlockInterval
    fit_s: float
    first_s: float
    file_mb: float


def main(arguments: list[str] | None = None) -> None:
    """One row a capture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path)
    parser.add_argument("--runs", type=int, default=1, help="of the timed commands; the least seconds are kept")
    options = parser.parse_args(arguments)
    print(
        "capture            mIoU            95 %  uplift  masked            gain, paired   mAcc unknown background "
        " instances    fit s first s     MB"
    )
    for folder in options.captures:
        print_row(measure(folder, options.runs))


def measure(folder: Path, runs: int = 1) -> CaptureRow:
    """Fit, ask and score a capture. folder: with truth and text features. runs: of what is timed."""
    truth, words = read_truth(folder), folder / WORDS
    with tempfile.TemporaryDirectory() as temporary:
        bundle = Path(temporary) / "scene.ogpc"
        fit_s = min(_fit_seconds(folder, bundle) for _ in range(runs))
        first_s = min(_first_answer_seconds(bundle, words) for _ in range(runs))
        file_mb = bundle.stat().st_size / 1e6
        scene = og.load(bundle)
        answer, instances = ask(scene, truth, words), len(scene.cloud.instances)
    score = _scored(answer.called, truth)
    where = (truth, answer.xyz, answer.spacing, score.classes)
    views, *plain = _uplift(folder, truth)
    uplift, masked = (_scored(called, truth).miou for called in plain)
    better = plain[0] if uplift >= masked else plain[1]
    return CaptureRow(
        capture=folder.name,
        views=views,
        points=len(truth.cls),
        instances=instances,
        score=score,
        miou=miou_interval(answer.called, *where),
        uplift=uplift,
        masked=masked,
        gain=miou_difference(answer.called, better, *where),
        fit_s=fit_s,
        first_s=first_s,
        file_mb=file_mb,
    )


def print_row(row: CaptureRow) -> None:
    """One line of the table."""
    score, called = row.score, row.score.background_called
    print(
        f"{row.capture:<16} {row.miou.mean:6.4f} {_spread(row.miou):>15} {row.uplift:7.4f} {row.masked:7.4f} "
        f"{row.gain.mean:+7.4f} {_spread(row.gain):>16} {score.macc:6.4f}  {score.unknown_share:6.4f} "
        f"{'-' if called is None else f'{called:.4f}':>10} {row.instances:10} {row.fit_s:8.1f} {row.first_s:7.2f} "
        f"{row.file_mb:6.1f}",
        flush=True,
    )


def score_of(labels: NDArray[np.integer], names: tuple[str, ...], folder: Path) -> Score:
    """Labels that index ``names``, scored against the folder's truth; a name the truth lacks is a wrong answer."""
    return read_truth(folder).score(labels, names)


def _spread(interval: BlockInterval) -> str:
    return f"{interval.low:.3f} to {interval.high:.3f}"


def _scored(called: NDArray[np.integer], truth: Truth) -> Score:
    return score_labels(called, truth.cls, scored=truth.scored, background=truth.background)


def _uplift(folder: Path, truth: Truth) -> tuple[int, NDArray[np.int64], NDArray[np.int64]]:
    """How many views the capture has, and the class of each point by direct uplift, and by it where masked."""
    scene, (words, _) = read_capture(folder), read_text_features(folder / WORDS)
    prepared = prepare(scene)
    labels = direct_uplift(scene, prepared, words.vectors)
    masked = only_where_masked(labels, prepared)
    return len(scene.views), truth.class_of(labels, words.names), truth.class_of(masked, words.names)


def _fit_seconds(folder: Path, bundle: Path) -> float:
    """Of ``og-pointcloud fit``, with the capture's own word bank where it has one."""
    bank = ["--word-bank", str(folder / BANK)] if (folder / BANK).is_file() else []
    start = time.perf_counter()
    command = [sys.executable, "-c", COMMAND, "fit", str(folder), "-o", str(bundle), *bank]
    subprocess.run(command, stdout=subprocess.DEVNULL, check=True)
    return time.perf_counter() - start


def _first_answer_seconds(bundle: Path, words: Path) -> float:
    command = [sys.executable, "-c", FIRST_ANSWER, str(bundle), str(words)]
    return float(subprocess.run(command, stdout=subprocess.PIPE, check=True).stdout)


if __name__ == "__main__":
    main()
