"""All rows of a report, capture by capture: settings, what was left out forced back in, baselines, the file's own."""

from __future__ import annotations

import csv
import io
import os
import platform
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np

from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.evaluate.intervals import RiskCoverage
from og_pointcloud.evaluate.report.judging import judged
from og_pointcloud.evaluate.report.knobs import (
    ALWAYS_FORCED,
    DEFAULT,
    EXACT,
    FAST,
    SEEDS,
    Setting,
    forced_by,
    settings_to_try,
)
from og_pointcloud.evaluate.report.measure import Row, Subject, measure_apart, read_subject
from og_pointcloud.evaluate.report.shared import Measured, measure_shared
from og_pointcloud.formats.atomic import replacing

__all__ = ["QUICK", "Report", "Risk", "Sweep", "machine", "own_version", "report_on", "rows_as_csv", "write_rows"]

QUICK = ("mode", "views", "pixels per spacing", "grouping sample")
"""Knobs of a report in a hurry."""
DEFAULT_RUNS = 2
"""Of the default at least: what its seconds differ by is the noise that others are read with."""

Tick = Callable[[str, str, int], None]
"""Told of each row: the capture, what was measured, and how many rows of that capture are still to come."""


@dataclass(frozen=True)
class Sweep:
    """What is tried. knobs: names, None for all, and with them the exact setting and other seeds. runs: of every
    setting, least and most seconds are kept."""

    knobs: tuple[str, ...] | None = None
    runs: int = 1
    paper: bool = False


@dataclass(frozen=True)
class Risk:
    """The default's answers, surest first. answered: share of the points that it answers."""

    curve: RiskCoverage
    answered: float


@dataclass(frozen=True)
class Report:
    """rows: of every capture and setting. pictures: PNG of each capture's default fit, by name. risks: where the truth
    is known. failed: what could not be run, with the reason."""

    rows: tuple[Row, ...]
    pictures: dict[str, bytes]
    risks: dict[str, Risk]
    failed: dict[str, str]
    machine: str
    seconds: float


def report_on(folders: Sequence[Path], sweep: Sweep, tick: Tick) -> Report:
    """Measure all captures.

    Deterministic but for seconds and memory. OgPointcloudError where the default fails, SceneError for a folder that is
    no capture.
    """
    start = time.perf_counter()
    report = Report((), {}, {}, {}, machine(), 0.0)
    for subject in [read_subject(folder) for folder in folders]:  # all are read before the first is measured
        name = subject.folder.name
        with tempfile.TemporaryDirectory() as work:
            measured, failed = measure_capture(subject, Path(work), sweep, tick)
            picture, risk = Path(work) / "picture.png", Path(work) / "risk.npz"
            report = replace(
                report,
                rows=(*report.rows, *judged(subject, measured)),
                pictures=report.pictures | {name: picture.read_bytes()},
                risks=report.risks | ({name: _read_risk(risk)} if risk.is_file() else {}),
                failed=report.failed | {f"{name}: {what}": why for what, why in failed.items()},
            )
    return replace(report, seconds=time.perf_counter() - start)


def measure_capture(subject: Subject, work: Path, sweep: Sweep, tick: Tick) -> tuple[list[Measured], dict[str, str]]:
    """The default first, then settings with a process of their own, then those that share one; and what failed."""
    only, name = sweep.knobs, subject.folder.name
    default = _repeated(subject, DEFAULT, work, max(DEFAULT_RUNS, sweep.runs))
    tried = settings_to_try(paper=sweep.paper, only=lambda knob: only is None or knob.name in only)
    forced = (forced_by(entry["what"]) for entry in default.row.left_out)
    tried += [setting for setting in forced if isinstance(setting, Setting)]
    tried += [entry.setting for entry in ALWAYS_FORCED]
    if only is None:
        tried += [EXACT, *(seed for seed in SEEDS if seed.settings.mode == "auto" or FAST in tried)]
    tried = list(dict.fromkeys(tried))
    apart = [setting for setting in tried if setting.shares == "nothing"]
    together = [setting for setting in tried if setting.shares != "nothing"]
    measured, failed, left = [default], {}, len(tried)
    for setting in apart:
        left -= 1
        tick(name, f"{setting.knob} {setting.value}", left)
        try:
            measured.append(_repeated(subject, setting, work, 1 if setting.settings.mode == "paper" else sweep.runs))
        except OgPointcloudError as error:
            failed[f"{setting.knob} {setting.value}"] = str(error)

    def done(what: str) -> None:
        nonlocal left
        left = max(0, left - 1)
        tick(name, what, left)

    shared, failed_there = measure_shared(subject.folder, together, work, sweep.runs, done)
    return [*measured, *shared], failed | failed_there


def _repeated(subject: Subject, setting: Setting, work: Path, runs: int) -> Measured:
    """The row of several runs, and the labels. Runs that differ in their answer are a defect, and said."""
    rows, file = [], work / "labels.npy"
    for _ in range(runs):
        rows.append(measure_apart(subject.folder, setting, file))
    seconds = [row.seconds for row in rows]
    alike = len({row.digest for row in rows}) == 1
    row = replace(min(rows, key=lambda row: row.seconds), runs=runs, seconds_most=max(seconds), runs_alike=alike)
    return Measured(row, np.load(file, allow_pickle=False))


def _read_risk(path: Path) -> Risk:
    with np.load(path, allow_pickle=False) as stored:
        curve = RiskCoverage(stored["coverage"], stored["risk"], float(stored["area"]))
        return Risk(curve, float(stored["answered"]))


def machine() -> str:
    """What the seconds are of: processor, cores, system, and the versions of what computes."""
    return f"{_processor()}, {os.cpu_count()} cores, {platform.system()}, {versions()}"


def versions() -> str:
    """Python's, and of what computes."""
    names = ("numpy", "numba", "scipy", "onnxruntime")
    return ", ".join([f"Python {platform.python_version()}", *(f"{name} {version(name)}" for name in names)])


def own_version() -> str:
    """Of this library as installed."""
    try:
        return version("og-pointcloud")
    except PackageNotFoundError:
        return "unknown"


def _processor() -> str:
    information = Path("/proc/cpuinfo")
    if information.is_file():
        for line in information.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def rows_as_csv(rows: Iterable[Row]) -> str:
    """A line a row, with the machine and the versions in each."""
    text = io.StringIO()
    where = {"version": own_version(), "machine": machine()}
    lines = csv.DictWriter(text, [*Row.__dataclass_fields__, *where], lineterminator="\n")
    lines.writeheader()
    for row in rows:
        values = asdict(row) | {"left_out": "; ".join(entry["what"] for entry in row.left_out)} | where
        lines.writerow({name: f"{v:.6g}" if isinstance(v, float) else v for name, v in values.items()})
    return text.getvalue()


def write_rows(rows: Iterable[Row], path: Path) -> Path:
    """`rows_as_csv` in a file, written whole or not at all."""
    with replacing(path) as file:
        file.write(rows_as_csv(rows).encode())
    return path
