"""Fit captures that come with ground truth, ask each file for every name, and print one row each: score and time.

    python examples/score_captures.py CAPTURE [CAPTURE ...] [--word-bank WORDS.npz]

A capture's ``gt.npz`` holds ``cls`` (a class per point, -1 none) and ``names``, and where known ``background``,
``views``, ``ratio`` and ``votes``; it is read for the score alone. ``text_features.npz`` holds the names asked.
With --word-bank (text features of everyday words) a second row is of the same file with that bank.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import og_pointcloud as og
from og_pointcloud.metrics import Score
from og_pointcloud.scoring.truth import read_truth
from og_pointcloud.text.vocabulary import read_bank, store_bank

FIRST_ANSWER = """
import sys, time
start = time.perf_counter()
import og_pointcloud as og
scene = og.load(sys.argv[1])
og.segment(scene, None, text_features=sys.argv[2])
print(time.perf_counter() - start)
"""


def main(arguments: list[str] | None = None) -> None:
    """One row per capture, or two; no setting differs between them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path)
    parser.add_argument("--word-bank", type=Path, help="text features of everyday words")
    options = parser.parse_args(arguments)
    print("capture          bank   mIoU   mAcc unknown background    fit s  load+segment s     MB  instances")
    for folder in options.captures:
        with tempfile.TemporaryDirectory() as temporary:
            bundle = Path(temporary) / "scene.ogpc"
            start = time.perf_counter()
            og.write_bundle(og.fit(og.read_capture(folder), progress=False), bundle)
            seconds = time.perf_counter() - start
            print_row(folder, bundle, seconds)
            if options.word_bank:
                store_bank(bundle, *read_bank(options.word_bank))
                print_row(folder, bundle, seconds)


def print_row(folder: Path, bundle: Path, seconds: float) -> None:
    """The scores of one file. seconds: that making it took."""
    words = folder / "text_features.npz"
    scene = og.load(bundle)
    result = og.segment(scene, None, text_features=words)
    score = score_of(result.labels, result.names, folder)
    first = subprocess.run([sys.executable, "-c", FIRST_ANSWER, bundle, words], capture_output=True, check=True)
    called = "-" if score.background_called is None else f"{score.background_called:.4f}"
    print(
        f"{folder.name:<16} {'yes' if result.calibrated else 'no':>4} {score.miou:6.4f} {score.macc:6.4f}  "
        f"{score.unknown_share:6.4f} {called:>10} {seconds:8.1f} {float(first.stdout):15.2f} "
        f"{bundle.stat().st_size / 1e6:6.1f} {len(scene.cloud.instances):10}",
        flush=True,
    )


def score_of(labels: np.ndarray, names: tuple[str, ...], folder: Path) -> Score:
    """Labels that index ``names``, scored against the folder's truth; a name the truth lacks is a wrong answer."""
    return read_truth(folder).score(labels, names)


if __name__ == "__main__":
    main()
