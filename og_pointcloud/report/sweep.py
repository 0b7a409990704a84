"""All rows of a report, capture by capture: settings, what was left out forced back in, baselines, the file's own."""

from __future__ import annotations

import csv
import io
import os
import platform
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud._atomic import replacing
from og_pointcloud.cloud import LabelledCloud
from og_pointcloud.fitting.fit import fit, prepare
from og_pointcloud.formats.capture import read_capture
from og_pointcloud.report.asking import measure_asking
from og_pointcloud.report.baselines import BASELINES
from og_pointcloud.report.knobs import DEFAULT, FORCED, Setting, settings_to_try
from og_pointcloud.report.measure import Row, Subject, disagreement, error_of, labels_of, measure_apart, read_subject

__all__ = ["QUICK", "Report", "Sweep", "error", "front", "machine", "report_on", "write_rows"]

QUICK = ("mode", "views", "pixels per spacing", "grouping sample")
"""Knobs of a report in a hurry."""
NAN = float("nan")


@dataclass(frozen=True)
class Sweep:
    """What is tried. knobs: names, None for all. runs: of every setting, least and most seconds are kept."""

    knobs: tuple[str, ...] | None = None
    runs: int = 2
    paper: bool = False


@dataclass(frozen=True)
class Report:
    """rows: of every capture and setting. clouds: what the default makes of each capture, by its name."""

    rows: tuple[Row, ...]
    clouds: dict[str, LabelledCloud]
    folders: dict[str, Path]
    machine: str
    seconds: float


def report_on(
    folders: Sequence[Path], work: Path, sweep: Sweep, steps: Callable[[list[Setting], str], Iterable[Setting]]
) -> Report:
    """Measure all captures. work: a folder for labels in passing. steps: wraps a list, for progress.

    Deterministic but for seconds. OgPointcloudError where a fit fails, SceneError for a folder that is no capture.
    """
    start, rows, clouds = time.perf_counter(), [], {}
    for subject in [read_subject(folder) for folder in folders]:  # all are read before the first is measured
        rows += measure_settings(subject, work, sweep, steps)
        scene = read_capture(subject.folder)
        cloud = fit(scene, progress=False)
        clouds[subject.folder.name] = cloud
        rows += measure_baselines(subject, labels_of(cloud, subject.vocabulary))
        rows += measure_asking(cloud, subject)
    return Report(
        tuple(rows), clouds, {folder.name: folder for folder in folders}, machine(), time.perf_counter() - start
    )


def measure_settings(
    subject: Subject, work: Path, sweep: Sweep, steps: Callable[[list[Setting], str], Iterable[Setting]]
) -> list[Row]:
    """A row for the default, for every other setting, and for each thing that the default left out, forced back in."""
    default = _repeated(subject, DEFAULT, work, sweep.runs)
    rows = [default[0]]
    only = sweep.knobs
    tried = settings_to_try(paper=sweep.paper, only=lambda knob: only is None or knob.name in only)[1:]
    left_out = " ".join(entry["what"] for entry in rows[0].left_out)
    tried += [setting for words, setting in FORCED if words in left_out]
    for setting in steps(tried, subject.folder.name):
        runs = 1 if setting.settings.mode == "paper" else sweep.runs
        row, labels = _repeated(subject, setting, work, runs)
        rows.append(replace(row, disagreement=disagreement(labels, default[1], subject)))
    return rows


def _repeated(subject: Subject, setting: Setting, work: Path, runs: int) -> tuple[Row, NDArray[Any]]:
    """The row of several runs, and the labels. Runs that differ in their labels are a defect, and said."""
    rows, labels = [], []
    for _ in range(runs):
        file = work / "labels.npy"
        rows.append(measure_apart(subject.folder, setting, file))
        labels.append(np.load(file, allow_pickle=False))
    same = all((other == labels[0]).all() for other in labels[1:])
    seconds = [row.seconds for row in rows]
    row = replace(min(rows, key=lambda row: row.seconds), runs=runs, seconds_most=max(seconds), runs_alike=same)
    return row, labels[0]


def measure_baselines(subject: Subject, default: NDArray[Any]) -> list[Row]:
    """Other methods on the mask table of the default; seconds with those of the stages that all share."""
    if subject.vocabulary is None:
        return []
    scene = read_capture(subject.folder)
    start = time.perf_counter()
    prepared = prepare(scene)
    shared = time.perf_counter() - start
    rows = []
    for name, baseline in BASELINES.items():
        start = time.perf_counter()
        labels = baseline(scene, prepared, subject.vocabulary.vectors)
        seconds = shared + time.perf_counter() - start
        errors = error_of(labels, subject)
        off = disagreement(labels, default, subject)
        rows.append(Row(subject.folder.name, "baseline", name, seconds, NAN, **errors, disagreement=off))
    return [replace(row, seconds_most=row.seconds) for row in rows]


def error(row: Row) -> float:
    """1 - mIoU; the disagreement with the default where the truth is not known."""
    return row.disagreement if row.miou is None else 1 - row.miou


def front(rows: Sequence[Row]) -> list[Row]:
    """Rows that no other beats in both seconds and error, by seconds (Pareto)."""
    best: list[Row] = []
    for row in sorted(rows, key=lambda row: (row.seconds, error(row))):
        if not best or error(row) < error(best[-1]):
            best.append(row)
    return best


def machine() -> str:
    """What the seconds are of."""
    versions = ", ".join(f"{name} {version(name)}" for name in ("numpy", "numba", "scipy", "onnxruntime"))
    return (
        f"{_processor()}, {os.cpu_count()} cores, {platform.system()}, Python {platform.python_version()}, {versions}"
    )


def _processor() -> str:
    information = Path("/proc/cpuinfo")
    if information.is_file():
        for line in information.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def write_rows(rows: Iterable[Row], path: Path) -> Path:
    """A CSV, a line a row; written whole or not at all."""
    text = io.StringIO()
    lines = csv.DictWriter(text, list(Row.__dataclass_fields__), lineterminator="\n")
    lines.writeheader()
    for row in rows:
        values = asdict(row) | {"left_out": "; ".join(entry["what"] for entry in row.left_out)}
        lines.writerow({name: f"{v:.6g}" if isinstance(v, float) else v for name, v in values.items()})
    with replacing(path) as file:
        file.write(text.getvalue().encode())
    return path
