"""Print the table of results for docs/results.md, measured with the commands and the library's own scorers.

    python scripts/write_results.py CAPTURE [CAPTURE ...] --rooms 0,1,2,3,4,5 --photographs 0,1

A capture has gt.npz, text_features.npz and optionally word_bank.npz. Rooms are those of ``og-pointcloud demo``, made
once in the output folder; they share a row, whose interval is over rooms. With --photographs a room is labelled from
its images alone: masks by OpenCV, features and typed words by the demo encoder; its seconds include the masks. Seconds
are of the whole command, folder to file, in its own process, the least of the runs. The best baseline is the one of
`og_pointcloud.evaluate.baselines` with the highest mIoU, with or without its remedy.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import og_pointcloud as og
from og_pointcloud.evaluate.baselines import baseline_labels
from og_pointcloud.evaluate.captures import ask
from og_pointcloud.evaluate.intervals import Interval, bootstrap, miou_interval
from og_pointcloud.evaluate.truth import read_truth
from og_pointcloud.fitting.fit import prepare
from og_pointcloud.formats.capture import read_capture
from og_pointcloud.text.encoder import DEMO_ENCODER, read_text_encoder
from og_pointcloud.text.text_features import read_text_features

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))

WORDS, BANK = "text_features.npz", "word_bank.npz"
COMMAND = [sys.executable, "-m", "og_pointcloud"]
HEADER = ("scene", "mIoU (95 %)", "best baseline", "background called", "unknown", "seconds")


@dataclass(frozen=True)
class Result:
    """One capture. miou: with its interval over blocks of space. baseline: the best one's name and mIoU. background:
    share of the known background that got a label, None where none is known. seconds: folder to file."""

    scene: str
    miou: Interval
    baseline: tuple[str, float]
    background: float | None
    unknown: float
    seconds: float


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="*", type=Path, metavar="CAPTURE")
    parser.add_argument("--rooms", type=_numbers, default=[], help="seeds of demo rooms, e.g. 0,1,2")
    parser.add_argument("--photographs", type=_numbers, default=[], help="seeds of rooms labelled from images alone")
    parser.add_argument("--runs", type=int, default=3, help="of the timed command; the least seconds are kept")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/results"), help="folder of the rooms")
    options = parser.parse_args(arguments)
    if not (options.captures or options.rooms or options.photographs):
        parser.error("nothing to measure; expected captures, --rooms or --photographs")
    results = [measure(folder, options.runs) for folder in options.captures]
    if options.rooms:
        results.append(mean_of_rooms([measure(room, options.runs) for room in rooms(options.rooms, options.output)]))
    for seed, room in zip(options.photographs, rooms(options.photographs, options.output), strict=True):
        folder = options.output / f"photographs{seed}"
        seconds = photograph(room, folder)
        found = measure(folder, options.runs)
        results.append(replace(found, scene=f"demo room {seed}, from images alone", seconds=found.seconds + seconds))
    print(table(results))


def _numbers(text: str) -> list[int]:
    return [int(number) for number in text.split(",")]


def measure(folder: Path, runs: int = 1) -> Result:
    """Fit a capture with the command, label it from the file, score it; and score the baselines on the same masks."""
    truth, words, scene = read_truth(folder), folder / WORDS, read_capture(folder)
    with tempfile.TemporaryDirectory() as temporary:
        bundle = Path(temporary) / "scene.ogpc"
        seconds = min(timed(["fit", str(folder), "-o", str(bundle)]) for _ in range(runs))
        answer = ask(og.load(bundle), truth, words)
    vocabulary, prepared = read_text_features(words)[0], prepare(scene)
    baselines = {
        name: truth.score(truth.class_of(labels, vocabulary.names)).miou
        for name, labels, _ in baseline_labels(prepared, vocabulary.vectors)
    }
    score = truth.score(answer.called)
    return Result(
        scene=f"{folder.absolute().name}, {len(scene.views)} views, {len(scene.points):,} points",
        miou=miou_interval(answer.called, truth, answer.xyz, answer.spacing, score.classes),
        baseline=max(baselines.items(), key=lambda item: item[1]),
        background=score.background_called,
        unknown=score.unknown_share,
        seconds=seconds,
    )


def timed(command: Sequence[str]) -> float:
    """Seconds of one of the commands, in its own process."""
    start = time.perf_counter()
    subprocess.run([*COMMAND, *command], stdout=subprocess.DEVNULL, check=True)
    return time.perf_counter() - start


def rooms(seeds: Iterable[int], folder: Path) -> list[Path]:
    """Captures of the demo's rooms, made if missing."""
    from og_pointcloud_room.capture import make_capture, write_capture  # pyright: ignore[reportMissingImports]

    made = [(seed, folder / f"room{seed}") for seed in seeds]
    for seed, room in made:
        if not (room / "gt.npz").is_file():  # the last file to be written
            write_capture(make_capture(seed), room)
    return [room for _, room in made]


def photograph(room: Path, folder: Path) -> float:
    """Make a capture from a room's images alone, with the words to score it by; returns the seconds for its masks."""
    truth = read_truth(room)
    seconds = timed(["masks", str(room), "--encoder", "demo", "--overwrite", "-o", str(folder)])
    for name in (WORDS, BANK):  # links to the room's files, which are another encoder's
        (folder / name).unlink(missing_ok=True)
    encoder = read_text_encoder(DEMO_ENCODER / "text")
    space = np.array(encoder.feature_space)
    np.savez(folder / WORDS, names=np.array(truth.names), vectors=encoder(truth.names), feature_space=space)
    return seconds


def mean_of_rooms(results: Sequence[Result]) -> Result:
    """Rooms as one row: means, the interval over rooms; the mean of each room's best baseline."""
    known = [result.background for result in results if result.background is not None]
    return Result(
        scene=f"mean of {len(results)} demo rooms",
        miou=bootstrap(np.array([result.miou.mean for result in results])),
        baseline=("each room's best", float(np.mean([result.baseline[1] for result in results]))),
        background=float(np.mean(known)) if known else None,
        unknown=float(np.mean([result.unknown for result in results])),
        seconds=float(np.mean([result.seconds for result in results])),
    )


def table(results: Iterable[Result]) -> str:
    """Markdown: the first column left-aligned, the others right-aligned."""
    lines = [HEADER, ("---", *["---:"] * (len(HEADER) - 1))]
    for one in results:
        background = "-" if one.background is None else f"{one.background:.3f}"
        miou = f"**{one.miou.mean:.3f}** ({one.miou.low:.3f} to {one.miou.high:.3f})"
        baseline = f"{one.baseline[1]:.3f} ({one.baseline[0]})"
        lines.append((one.scene, miou, baseline, background, f"{one.unknown:.3f}", f"{one.seconds:.1f}"))
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


if __name__ == "__main__":
    main()
