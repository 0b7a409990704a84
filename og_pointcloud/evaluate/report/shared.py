"""Many settings of one capture in one process: what they share is done once, timed, and its seconds added.

    python -m og_pointcloud.evaluate.report.shared CAPTURE WORK RUNS < settings.json     # a Row as JSON a line

Settings that share the geometry take over the choice of Gaussians and make the mask table anew; those that share the
table begin with grouping, as do the baselines. Line k leaves its labels in WORK/k.npy. Then come the rows of the
finished file (`asking`), without labels; WORK/picture.png and WORK/risk.npz are of the default.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.ask.labelled_scene import as_scene
from og_pointcloud.cloud import LabelledCloud
from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.evaluate.baselines import BASELINES, only_where_masked
from og_pointcloud.evaluate.captures import sure
from og_pointcloud.evaluate.intervals import risk_coverage
from og_pointcloud.evaluate.report.asking import measure_asking, truth_of_rows
from og_pointcloud.evaluate.report.knobs import DEFAULT, Setting, find_setting
from og_pointcloud.evaluate.report.measure import (
    Row,
    Subject,
    digest_of,
    error_of,
    labels_of,
    peak_mb,
    read_subject,
    reset_peak,
    warm_up,
)
from og_pointcloud.fitting.fit import check_scene, fit, prepare, with_distinct_points
from og_pointcloud.formats.capture import read_capture
from og_pointcloud.journal import Journal
from og_pointcloud.settings import FitSettings
from og_pointcloud.show.fit_pictures import instance_picture

__all__ = ["ON_SHARED", "SharedFit", "measure_shared"]

ON_SHARED: dict[str, Setting] = {
    "table": replace(DEFAULT, value="on the shared table", shares="table"),
    "geometry": replace(DEFAULT, value="on the shared geometry", shares="geometry"),
}
"""The default as rows that share its stages have it: what these are held against."""

Labels = NDArray[np.integer]


class Measured(NamedTuple):
    """labels: (n,) of the whole capture's points, None for rows of the finished file."""

    row: Row
    labels: Labels | None


class SharedFit:
    """A capture's default fit, kept up to its mask table, from which other settings go on."""

    def __init__(self, subject: Subject, runs: int = 1) -> None:
        """runs: of what a setting does itself; least and most seconds are kept."""
        self.subject, self.runs = subject, runs
        whole = read_capture(subject.folder)
        journal = Journal(progress=False)
        warm_up(whole, FitSettings())
        self.warm = {"auto", "grouping"}
        reset_peak()
        start = time.perf_counter()
        check_scene(whole, journal)
        self.scene, self.place = with_distinct_points(whole, journal)
        self.prepared = prepare(self.scene, journal=journal)
        self.table_seconds = time.perf_counter() - start
        self.geometry_seconds = sum(stage["seconds"] for stage in journal.stages if stage["name"] == "geometry")
        self.peak = peak_mb()
        self.chosen = journal.notes.get("gaussian_scale"), journal.notes.get("gaussian_opacity")

    def measure(self, setting: Setting) -> tuple[Measured, LabelledCloud]:
        """The row of a setting that shares the geometry or the table, and its cloud."""
        if setting.settings.mode not in self.warm:
            warm_up(self.scene, setting.settings)
            self.warm.add(setting.settings.mode)
        again = self._from_table if setting.shares == "table" else self._from_geometry
        seconds, clouds, peak = self._repeated(lambda: again(setting))
        shared = self.table_seconds if setting.shares == "table" else self.geometry_seconds
        digests = {digest_of(cloud) for cloud in clouds}
        cloud = clouds[0]
        labels = self._of_whole(labels_of(cloud, self.subject.vocabulary))
        row = self._row(setting.knob, setting.value, seconds, shared, peak, labels)
        row = replace(
            row,
            shares=setting.shares,
            instances=len(cloud.instances),
            seed=setting.settings.seed,
            digest=digest_of(cloud),
            runs_alike=len(digests) == 1,
            left_out=tuple(cloud.provenance["left_out"]),
        )
        return Measured(row, labels), cloud

    def measure_baselines(self) -> Iterator[Measured]:
        """Other methods on the same table, as they are, and with points that masks mostly pass by left out."""
        if self.subject.vocabulary is None:
            return
        words = self.subject.vocabulary.vectors
        for name, baseline in BASELINES.items():
            seconds, found, peak = self._repeated(lambda method=baseline: method(self.scene, self.prepared, words))
            for value, labels in (
                (name, found[0]),
                (f"{name}, where masked", only_where_masked(found[0], self.prepared)),
            ):
                labels = self._of_whole(labels)
                row = self._row("baseline", value, seconds, self.table_seconds, peak, labels)
                yield Measured(replace(row, shares="table"), labels)

    def picture(self, cloud: LabelledCloud, path: Path) -> None:
        """Photographs, instances, and where the truth is known labels beside it."""
        stages: dict[str, NDArray[np.integer]] = {"instances": cloud.instance_ids}
        truth, vocabulary = self.subject.truth, self.subject.vocabulary
        if truth is not None and vocabulary is not None:
            rows = slice(None) if self.place is None else np.unique(self.place, return_index=True)[1]
            stages["labels"] = truth.class_of(labels_of(cloud, vocabulary), vocabulary.names)
            stages["truth"] = truth.cls[rows]
        instance_picture(self.prepared.gaussians, self.scene.views, self.prepared.near, stages, path, columns=4)

    def risk(self, cloud: LabelledCloud, path: Path) -> None:
        """Coverage and risk of the default over the points with a known class, and the share that it answers."""
        truth, vocabulary = self.subject.truth, self.subject.vocabulary
        if truth is None or vocabulary is None:
            return
        labels, score, _ = as_scene(cloud).chooser.choose(vocabulary.vectors).at(cloud.instance_ids)
        certainty = None if cloud.certainty is None else cloud.certainty / 255
        labels, sureness = self._of_whole(labels), self._of_whole(sure(score, False, certainty))
        called, classes = truth.class_of(labels, vocabulary.names), truth.score(labels, vocabulary.names).classes
        counted = truth.scored & np.isin(truth.cls, classes)
        if counted.any():
            curve = risk_coverage((called == truth.cls)[counted], np.where(called >= 0, sureness, -np.inf)[counted])
            answered = (called >= 0)[counted].mean()
            np.savez(path, coverage=curve.coverage, risk=curve.risk, area=curve.area, answered=answered)

    def _from_table(self, setting: Setting) -> LabelledCloud:
        prepared = self.prepared
        if setting.special == "float16 weights":
            table = prepared.table
            rounded = {name: _through_half(getattr(table, name)) for name in ("weights", "outside", "exposure")}
            prepared = replace(prepared, table=replace(table, **rounded))
        elif setting.special == "float16 features":
            halved = prepared.table.unit_features.astype(np.float16).astype(np.float32)
            prepared = replace(prepared, table=replace(prepared.table, mask_features=halved))
        return fit(self.scene, setting.settings, prepared=prepared, progress=False)

    def _from_geometry(self, setting: Setting) -> LabelledCloud:
        """Without photographs a fit draws points as its start values say: here as the default's fit chose."""
        scale, opacity = self.chosen
        blind, settings = self.scene, setting.settings
        if scale is not None:
            blind = replace(blind, views=tuple(replace(view, image=None) for view in blind.views))
            known = replace(settings.geometry, start_scale=scale, start_opacity=opacity)
            settings = replace(settings, geometry=known)
        journal = Journal(progress=False)
        prepared = prepare(blind, settings, journal)
        cloud = fit(blind, setting.settings, prepared=prepared, progress=False)
        left_out = [*journal.left_out, *cloud.provenance["left_out"]]
        return replace(cloud, provenance={**cloud.provenance, "left_out": left_out})

    def _repeated(self, work: Callable[[], Any]) -> tuple[list[float], list[Any], float]:
        seconds, answers = [], []
        reset_peak()
        for _ in range(self.runs):
            start = time.perf_counter()
            answers.append(work())
            seconds.append(time.perf_counter() - start)
        return seconds, answers, max(self.peak, peak_mb())

    def _row(self, knob: str, value: str, seconds: list[float], shared: float, peak: float, labels: Labels) -> Row:
        return Row(
            capture=self.subject.folder.name,
            knob=knob,
            value=value,
            seconds=shared + min(seconds),
            seconds_most=shared + max(seconds),
            shared_seconds=shared,
            runs=len(seconds),
            peak_mb=peak,
            **error_of(labels, self.subject),
        )

    def _of_whole(self, values: NDArray[Any]) -> NDArray[Any]:
        return values if self.place is None else values[self.place]


def _through_half(matrix: Any) -> Any:
    """A sparse matrix whose values went through float16, without those that became 0."""
    rounded = matrix.copy()
    rounded.data = rounded.data.astype(np.float16).astype(np.float32)
    rounded.eliminate_zeros()
    return rounded


def measure_shared(
    folder: Path, tried: Sequence[Setting], work: Path, runs: int, done: Callable[[str], None]
) -> tuple[list[Measured], dict[str, str]]:
    """The rows of a process of its own, and what failed there with the reason. done: told of each row's name."""
    command = [sys.executable, "-m", __spec__.name, str(folder), str(work), str(runs)]
    measured, failed = [], {}
    with tempfile.TemporaryFile("w+") as errors, tempfile.TemporaryFile("w+") as names:
        json.dump([(setting.knob, setting.value) for setting in tried], names)
        names.seek(0)
        with subprocess.Popen(command, stdin=names, stdout=subprocess.PIPE, stderr=errors, text=True) as process:
            assert process.stdout is not None
            for number, line in enumerate(process.stdout):
                content = json.loads(line)
                done(f"{content['knob']} {content['value']}")
                if "failed" in content:
                    failed[f"{content['knob']} {content['value']}"] = content["failed"]
                    continue
                labels = work / f"{number}.npy"
                known = np.load(labels, allow_pickle=False) if labels.is_file() else None
                measured.append(Measured(Row(**content), known))
        if process.returncode:
            errors.seek(0)
            last = errors.read().strip().splitlines()[-1:] or [f"exit code {process.returncode}"]
            raise OgPointcloudError(f"{folder.name}: the report's process failed: {last[0]}")
    return measured, failed


def rows_of(shared: SharedFit, tried: Sequence[Setting], work: Path) -> Iterator[Measured | dict[str, str]]:
    """All rows of the process; for a setting that fails why. The default is measured first and last: what its seconds
    differ by meanwhile is the noise of the others."""
    first = {name: shared.measure(setting) for name, setting in ON_SHARED.items()}
    for setting in tried:
        try:
            yield shared.measure(setting)[0]
        except Exception as error:  # one setting must not cost the report; the page names it
            yield {"knob": setting.knob, "value": setting.value, "failed": f"{type(error).__name__}: {error}"}
    for name, (before, _) in first.items():
        yield _both(before, shared.measure(ON_SHARED[name])[0])
    yield from shared.measure_baselines()
    cloud = first["table"][1]
    shared.picture(cloud, work / "picture.png")
    shared.risk(cloud, work / "risk.npz")
    distinct = shared.subject
    if shared.place is not None and distinct.truth is not None:
        rows = np.unique(shared.place, return_index=True)[1]
        distinct = replace(distinct, truth=truth_of_rows(distinct.truth, rows))
    for row in measure_asking(cloud, distinct):
        yield Measured(row, None)


def _both(first: Measured, again: Measured) -> Measured:
    """One row of what was measured twice."""
    a, b = first.row, again.row
    row = replace(
        a,
        seconds=min(a.seconds, b.seconds),
        seconds_most=max(a.seconds_most, b.seconds_most),
        runs=a.runs + b.runs,
        runs_alike=a.runs_alike and b.runs_alike and a.digest == b.digest,
    )
    return Measured(row, first.labels)


def main() -> None:
    """A row a line on standard output, as it is measured."""
    folder, work, runs = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
    tried = [find_setting(knob, value) for knob, value in json.load(sys.stdin)]
    for number, entry in enumerate(rows_of(SharedFit(read_subject(folder), runs), tried, work)):
        if isinstance(entry, Measured) and entry.labels is not None:
            np.save(work / f"{number}.npy", entry.labels)
        print(json.dumps(entry if isinstance(entry, dict) else asdict(entry.row)), flush=True)


if __name__ == "__main__":
    main()
