"""The paper's own tables, and repairs of its method one at a time: mode paper on captures whose truth is known.

    python examples/benchmark_paper.py kitchen shelf                        # all tables: losses, codebook, association
    python examples/benchmark_paper.py kitchen --table repairs --seeds 3 --share 0.06 --pixels 19200 -o out/paper

A capture needs gt.npz and text_features.npz. Rows that differ only in the association share a training, and their
processor seconds include all of it. Results are kept in OUT/rows.csv: the same command continues where it was
interrupted. Each cell is the mean mIoU over the seeds, with the lowest and the highest; the last columns are the
difference to the method as published, over all captures and seeds, with its 95 % bootstrap interval, and the row's mIoU
in the paper, on ScanNet. Writes OUT/TABLE.md.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from trained_shapes import train_with_shapes

from og_pointcloud.ask.labelled_scene import LabelledScene
from og_pointcloud.cloud import LabelledCloud
from og_pointcloud.evaluate.intervals import bootstrap
from og_pointcloud.evaluate.knobs import changed
from og_pointcloud.evaluate.sweep import Subject, read_subject
from og_pointcloud.fitting.fit import Prepared, labelled_cloud, prepare
from og_pointcloud.fitting.labellers import fast, leaves_of_training, trained_by_rendering
from og_pointcloud.fitting.learned.paper import TrainingRun, train_codebook
from og_pointcloud.fitting.learned.rendered_views import RenderedViews
from og_pointcloud.formats.atomic import write_file
from og_pointcloud.journal import Journal
from og_pointcloud.rendering.surface import Surface
from og_pointcloud.settings import FitSettings, MatchingSettings, PaperSettings

BOTH = "as published"
SHAPES = "trained_shapes"
"""Not a setting: selects the first stage of trained_shapes.py."""


def one_level(k: int, positions: bool) -> Mapping[str, Any]:
    """A codebook of k leaves."""
    return {"paper.k1": k, "paper.k2": 1} | ({} if positions else {"paper.position_weight": 0.0})


ABLATIONS: Mapping[str, Mapping[str, tuple[float, Mapping[str, Any]]]] = {
    "losses": {
        "inter only": (0.3524, {"paper.intra": False}),
        "intra only": (0.2589, {"paper.inter": False}),
        "both": (0.3829, {}),
    },
    "codebook": {
        "one level, k = 64": (0.2868, one_level(64, False)),
        "one level, k = 320": (0.1461, one_level(320, False)),
        "one level, k = 64, xyz": (0.3204, one_level(64, True)),
        "one level, k = 320, xyz": (0.1520, one_level(320, True)),
        "two levels": (0.3027, {"paper.position_weight": 0.0}),
        "two levels, xyz": (0.3829, {}),
    },
    "association": {
        "IoU only": (0.3528, {"paper.matching.score": "iou"}),
        "feature only": (0.3401, {"paper.matching.score": "feature"}),
        "both": (0.3829, {}),
    },
}
"""Rows of the paper's tables (Sec. 4.4): their mIoU there, on 10 classes of ScanNet (other data: compare the order, not
the size), and what the row changes in mode paper."""
PIECES = {"paper.matching.score": "within"}
BY_SCENE = {"paper.matching.relative": True, "paper.matching.threshold": 0.5}
REPAIRS: Mapping[str, Mapping[str, Any]] = {
    BOTH: {},
    "no threshold": {"paper.matching.threshold": 0.0},
    "threshold by the scene's scores": BY_SCENE,
    "pieces: share within, not IoU": PIECES,
    "hidden ones not drawn alone": {"paper.matching.visible": True},
    "k1 by the scene": {"paper.k1": None},
    "all points decided by all views": {"paper.matching.settle": True},
    "opacity and size trained too": {SHAPES: True},
    "opacity and size trained too, decided by all views": {SHAPES: True, "paper.matching.settle": True},
    "pieces, and decided by all views": {**PIECES, "paper.matching.settle": True},
    "all but the threshold": {
        **PIECES,
        "paper.k1": None,
        "paper.matching.visible": True,
        "paper.matching.settle": True,
    },
    "mode fast": {"mode": "fast"},
}
"""Row -> what it changes in mode paper."""
TABLES: Mapping[str, Mapping[str, tuple[float | None, Mapping[str, Any]]]] = {
    **ABLATIONS, "repairs": {row: (None, changes) for row, changes in REPAIRS.items()},
}  # fmt: skip
"""Table -> row -> its mIoU in the paper, and the settings that it changes."""


@dataclass(frozen=True)
class Measured:
    """A row of OUT/rows.csv. settings: what was changed. seconds: processor seconds of a whole fit."""

    capture: str
    settings: str
    seed: int
    miou: float
    unknown: float
    instances: int
    seconds: float


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure what is missing, print and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", type=Path, nargs="+", metavar="CAPTURE")
    parser.add_argument("--table", choices=[*TABLES], action="append", help="default: the three of the paper")
    parser.add_argument("--share", type=float, default=0.06, help="of the published schedule (default: %(default)s)")
    parser.add_argument("--pixels", type=int, default=160 * 120, help="of a view at most (default: %(default)s)")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/paper"))
    options = parser.parse_args(arguments)
    chosen = {name: TABLES[name] for name in options.table or list(ABLATIONS)}
    paper = PaperSettings(schedule_share=options.share, image_pixels=options.pixels)
    base = FitSettings(mode="paper", paper=paper)
    rows = [changes for table in chosen.values() for _, changes in table.values()]
    options.output.mkdir(parents=True, exist_ok=True)
    file = options.output / "rows.csv"
    for capture in options.captures:
        measure(capture, base, rows, options.seeds, file)
    names = [capture.absolute().name for capture in options.captures]
    done = {(row.capture, row.settings, row.seed): row for row in read_rows(file)}
    for name, table in chosen.items():
        text = "\n".join(lines(table, names, range(options.seeds), done))
        print(f"\n{name}\n\n{text}")
        write_file(options.output / f"{name}.md", f"{text}\n".encode())


def measure(capture: Path, base: FitSettings, rows: Sequence[Mapping[str, Any]], seeds: int, file: Path) -> None:
    """All rows of one capture that the file lacks, seed by seed."""
    from tqdm import tqdm

    name = capture.absolute().name
    done = {(row.capture, row.settings, row.seed) for row in read_rows(file)}
    left = [(seed, dict(row)) for seed in range(seeds) for row in rows if (name, key_of(row), seed) not in done]
    if not left:
        return
    subject = read_subject(capture)
    if subject.truth is None:
        sys.exit(f"{name} lacks gt.npz or text_features.npz; expected both: rows are scored by the truth")
    trial = Trial(subject, base)
    for seed, row in tqdm(left, name, disable=None):
        if (name, key_of(row), seed) in done:  # tables share rows
            continue
        done.add((name, key_of(row), seed))
        append(trial.measured(row, seed), file)


class Trial:
    """One capture; trained features are kept for rows that differ only in the association."""

    def __init__(self, subject: Subject, base: FitSettings) -> None:
        self.subject, self.base = subject, base
        self.prepared: dict[str, tuple[Prepared, float]] = {}
        self.trained: dict[tuple[FitSettings, bool], tuple[Surface, NDArray[np.float32], Any, float]] = {}
        self.source: RenderedViews | None = None

    def measured(self, changes: Mapping[str, Any], seed: int) -> Measured:
        """One fit with the changes, scored."""
        settings = replace(self.base, seed=seed)
        for path, value in changes.items():
            settings = settings if path == SHAPES else changed(settings, path, value)
        if settings.mode not in self.prepared:
            start = time.process_time()
            prepared = prepare(self.subject.scene, settings)
            self.prepared[settings.mode] = prepared, time.process_time() - start
        prepared, seconds = self.prepared[settings.mode]
        start = time.process_time()
        if settings.mode == "paper":
            surface, features, book, spent = self.training(prepared, settings, SHAPES in changes)
            seconds, start = seconds + spent, time.process_time()
            found = leaves_of_training(prepared.table, surface, features, book, settings, Journal(False))
        else:
            found = fast(prepared.table, prepared.surface, settings, Journal(False))
        seconds += time.process_time() - start
        miou, unknown = self.score(labelled_cloud(prepared, found, settings, Journal(False)))
        return Measured(
            self.subject.name, key_of(changes), seed, miou, unknown, len(found.instances), round(seconds, 2)
        )

    def training(
        self, prepared: Prepared, settings: FitSettings, shapes: bool
    ) -> tuple[Surface, NDArray[np.float32], Any, float]:
        """The surface, features, codebook, and the seconds they took. shapes: train the Gaussians' shapes too."""
        key = changed(settings, "paper.matching", MatchingSettings()), shapes
        surface, table = prepared.surface, prepared.table
        if self.source is None:
            drawn = surface.gaussians, surface.scene.views, surface.near, settings.paper
            self.source = RenderedViews(*drawn, whole=False)
        if key not in self.trained:
            start = time.process_time()
            if shapes:
                raw, features, source = train_with_shapes(self.source, settings.paper, settings.seed)
                book = train_codebook(source, raw, settings.paper, TrainingRun(settings.seed))
                surface = replace(surface, gaussians=source.gaussians)
            else:
                features, book = trained_by_rendering(table, surface, settings, Journal(False), source=self.source)
            self.trained[key] = surface, features, book, time.process_time() - start
        return self.trained[key]

    def score(self, cloud: LabelledCloud) -> tuple[float, float]:
        """mIoU and the share of unknown points."""
        words, truth = self.subject.vocabulary, self.subject.truth
        assert words is not None
        assert truth is not None
        labels = LabelledScene.from_cloud(cloud).chooser.choose(words.vectors).at(cloud.instance_ids)[0]
        score = truth.score(truth.class_of(labels, words.names))
        return round(score.miou, 4), round(score.unknown_share, 4)


def key_of(changes: Mapping[str, Any]) -> str:
    """The changes as one cell of a table."""
    return "; ".join(f"{path}={value}" for path, value in sorted(changes.items()))


def read_rows(file: Path) -> Iterator[Measured]:
    """The rows of the file; none if there is no file."""
    if file.is_file():
        with file.open(newline="") as lines:
            for row in csv.DictReader(lines):
                numbers = {name: float(row[name]) for name in ("miou", "unknown", "seconds")}
                whole = {name: int(row[name]) for name in ("seed", "instances")}
                yield Measured(capture=row["capture"], settings=row["settings"], **numbers, **whole)


def append(row: Measured, file: Path) -> None:
    """Add a row to the file."""
    is_new = not file.is_file()
    with file.open("a", newline="") as lines:
        writer = csv.DictWriter(lines, list(asdict(row)))
        if is_new:
            writer.writeheader()
        writer.writerow(asdict(row))


def lines(
    table: Mapping[str, tuple[float | None, Mapping[str, Any]]],
    captures: Sequence[str],
    seeds: Sequence[int],
    done: Mapping[tuple[str, str, int], Measured],
) -> Iterator[str]:
    """The table as Markdown."""
    yield f"| | {' | '.join(f'{name} | s' for name in captures)} | difference | paper |"
    yield "| --- |" + " ---: | ---: |" * len(captures) + " ---: | ---: |"
    for row, (published, changes) in table.items():
        cells, differences = [], []
        for capture in captures:
            of_seeds = [done[capture, key_of(changes), seed] for seed in seeds]
            scores = np.array([one.miou for one in of_seeds])
            seconds = np.mean([one.seconds for one in of_seeds])
            cells += [f"{scores.mean():.3f} ({scores.min():.3f}-{scores.max():.3f})", f"{seconds:.0f}"]
            differences += list(scores - [done[capture, "", seed].miou for seed in seeds])
        by = bootstrap(np.array(differences))
        against = "" if not changes else f"{by.mean:+.3f} ({by.low:+.3f} to {by.high:+.3f})"
        yield f"| {row} | {' | '.join(cells)} | {against} | {'' if published is None else f'{published:.3f}'} |"


if __name__ == "__main__":
    main()
