"""Error against run time: settings x captures -> one table, with error and seconds in the same row.

Each mode first fits a few points and discards the result, so that no seconds include loading compiled code. Other
methods on the default's mask table (`baselines`) are listed beside the settings.

    with gt.npz and text_features.npz      error = 1 - mIoU; a point without a label is a miss, a class called on known
                                           background a false alarm
    without                                error = 1 - reliability (fitting/reliability.py), 1 where it is not known
"""

from __future__ import annotations

import os
import platform
import re
import time
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.ask.labelled_scene import LabelledScene
from og_pointcloud.bundle.vocabulary import scene_words
from og_pointcloud.checking.check import CaptureWarning
from og_pointcloud.cloud import FeatureSpace, Vocabulary, WordBank
from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.evaluate.baselines import baseline_labels
from og_pointcloud.evaluate.captures import Answer, difference
from og_pointcloud.evaluate.knobs import DEFAULT, Setting
from og_pointcloud.evaluate.truth import GT_NAME, Truth, read_truth
from og_pointcloud.fitting.fit import fit, prepare
from og_pointcloud.fitting.tiles import needs_tiles
from og_pointcloud.formats.atomic import write_file
from og_pointcloud.formats.capture import read_capture
from og_pointcloud.formats.tables import csv_text
from og_pointcloud.journal import Journal
from og_pointcloud.scene import Scene
from og_pointcloud.settings import FitSettings
from og_pointcloud.text.text_features import read_text_features

BASELINE = "baseline"
"""The knob named in rows of other methods."""
WARM_UP_POINTS = 2_000

Labels = NDArray[np.integer]


@dataclass(frozen=True)
class Subject:
    """A capture, the words to query, and the truth of its points. Both are None where the folder lacks either.
    word_bank: by which a fit of it judges labels, as `bundle.vocabulary.scene_words` finds it; None without one."""

    name: str
    scene: Scene
    vocabulary: Vocabulary | None
    truth: Truth | None
    word_bank: WordBank | None = None


@dataclass(frozen=True)
class Row:
    """One setting on one capture.

    seconds: of a whole fit. error: 1 - mIoU, or 1 - reliability without truth.
    miou, macc, unknown: over the points with a known class; background: share of known background that was given a
    class. All None without truth.
    gain, gain_low, gain_high: mIoU minus the default's, with its paired 95 % interval over blocks of space.
    reliability: of the fit (`LabelledCloud.reliability`), None for other methods.
    left_out: what the fit left out and why, from its provenance.
    """

    capture: str
    knob: str
    value: str
    seconds: float
    error: float
    miou: float | None = None
    macc: float | None = None
    unknown: float | None = None
    background: float | None = None
    gain: float | None = None
    gain_low: float | None = None
    gain_high: float | None = None
    reliability: float | None = None
    instances: int | None = None
    left_out: tuple[dict[str, Any], ...] = field(default=(), repr=False)

    @property
    def name(self) -> str:
        """The setting, as tables and charts show it."""
        return Setting(self.knob, self.value).name

    @property
    def is_default(self) -> bool:
        """Whether this is a fit without settings."""
        return self.knob == DEFAULT.knob


@dataclass(frozen=True)
class Sweep:
    """rows: capture by capture, the default first. failed: what could not be run -> why."""

    rows: tuple[Row, ...]
    failed: dict[str, str]

    @property
    def captures(self) -> list[str]:
        """Names of the captures, in order."""
        return list(dict.fromkeys(row.capture for row in self.rows))


def read_subject(folder: Path) -> Subject:
    """A capture with its words and its truth, where it has them.

    Raises SceneError where the truth belongs to another cloud, FeatureSpaceError where words and masks come from
    different encoders.
    """
    folder = folder.absolute()  # "." has no name
    scene, words = read_capture(folder), folder / "text_features.npz"
    if not (words.is_file() and (folder / GT_NAME).is_file()):
        return Subject(folder.name, scene, None, None)
    (vocabulary, space), truth = read_text_features(words), read_truth(folder)
    if len(truth.cls) != len(scene.points):
        raise SceneError(
            f"{folder.name}: the truth has {len(truth.cls)} points, the cloud {len(scene.points)}; expected the same "
            "number"
        )
    masks, names = (scene.feature_space, scene.feature_width), (space, vocabulary.vectors.shape[1])
    FeatureSpace(*masks).require(FeatureSpace(*names), f"names of {words}")
    return Subject(folder.name, scene, vocabulary, truth, scene_words(FeatureSpace(*masks), capture=folder).word_bank)


def sweep(subjects: Sequence[Subject], settings: Sequence[Setting], *, progress: bool = True) -> Sweep:
    """Try all settings on all captures. settings: the default (knobs.DEFAULT) first.

    A setting that fails is named in the result; the others still run. Deterministic except for seconds.
    OgPointcloudError where not even the default could be run on any capture.
    """
    from tqdm import tqdm

    rows, failed = [], {}
    total = len(subjects) * len(settings)
    with tqdm(total=total, desc="report", dynamic_ncols=True, disable=None if progress else True) as bar:
        for number, subject in enumerate(subjects):
            try:
                trial = _Trial(subject)
                for setting in settings:
                    bar.set_postfix_str(f"{subject.name}, {setting.name}")
                    try:
                        rows.append(trial.row(setting))
                    except Exception as error:  # one failing setting must not cost the report, which names it
                        if setting == DEFAULT:  # all others are compared with it
                            raise
                        failed[f"{subject.name}, {setting.name}"] = f"{type(error).__name__}: {error}"
                    bar.update()
                rows += trial.baselines()
            except OgPointcloudError as error:
                failed[subject.name] = str(error)
            bar.update((number + 1) * len(settings) - bar.n)  # skip what a failed capture did not try
    if not rows:
        raise OgPointcloudError(f"no capture could be fitted: {next(iter(failed.values()), 'none was given')}")
    return Sweep(tuple(rows), failed)


class _Trial:
    """One capture while settings are tried on it."""

    def __init__(self, subject: Subject) -> None:
        self.subject = subject
        if needs_tiles(subject.scene, DEFAULT.settings):
            raise OgPointcloudError(
                f"{subject.name}: {len(subject.scene.points):,} points need more memory than there is for all settings;"
                " expected fewer: report on a part of the cloud"
            )
        self.warm: set[str] = set()
        self.default: Answer | None = None

    def row(self, setting: Setting) -> Row:
        """The row of one setting."""
        scene = replace(self.subject.scene, views=self.subject.scene.views[:: setting.every])
        if setting.settings.mode not in self.warm:
            self.warm.add(setting.settings.mode)
            warm_up(self.subject.scene, setting.settings)
        start = time.perf_counter()
        cloud = fit(scene, setting.settings, progress=False)
        seconds = time.perf_counter() - start
        scores: dict[str, Any] = {}
        if (words := self.subject.vocabulary) is not None:
            judged = LabelledScene.from_cloud(replace(cloud, word_bank=self.subject.word_bank))
            labels = judged.chooser.choose(words.vectors).at(cloud.instance_ids)[0]
            scores = self._scores(labels, cloud.spacing)
        error = 1 - scores.get("miou", cloud.reliability or 0.0)
        return Row(
            self.subject.name, setting.knob, setting.value, seconds, error, reliability=cloud.reliability,
            instances=len(cloud.instances), left_out=tuple(cloud.provenance["left_out"]), **scores,
        )  # fmt: skip

    def baselines(self) -> Iterator[Row]:
        """Other methods, unrestricted and without points that lie mostly outside masks; none without truth."""
        if self.subject.vocabulary is None or self.default is None:
            return
        start = time.perf_counter()
        prepared = prepare(self.subject.scene, journal=Journal(progress=False))
        preparing = time.perf_counter() - start
        for name, labels, seconds in baseline_labels(prepared, self.subject.vocabulary.vectors):
            scores = self._scores(labels, self.default.spacing)
            yield Row(self.subject.name, BASELINE, name, preparing + seconds, 1 - scores["miou"], **scores)

    def _scores(self, labels: Labels, spacing: float) -> dict[str, Any]:
        """Fields of `Row` for labels that index the subject's words, -1 unknown. The first call is for the default,
        with which later ones are compared."""
        truth, words = self.subject.truth, self.subject.vocabulary
        assert truth is not None
        assert words is not None
        answer = Answer(truth.class_of(labels, words.names), labels, self.subject.scene.points.xyz, spacing)
        score = truth.score(answer.called)
        self.default = self.default or answer
        figures: dict[str, Any] = {"miou": score.miou, "macc": score.macc}
        figures |= {"unknown": score.unknown_share, "background": score.background_called}
        if score.classes:
            gain = difference(answer, self.default, truth)
            figures |= {"gain": gain.mean, "gain_low": gain.low, "gain_high": gain.high}
        return figures


def warm_up(scene: Scene, settings: FitSettings | None = None) -> None:
    """Fit two views of a few points, so that no measured seconds include loading compiled code."""
    points = scene.points.take(np.arange(0, len(scene.points), 1 + len(scene.points) // WARM_UP_POINTS))
    views = tuple(view for view in scene.views if view.mask_count)[:2]
    # Two views of a few points may show nothing, or look wrong: only the whole scene's fit is to say so.
    with suppress(OgPointcloudError), warnings.catch_warnings():
        warnings.simplefilter("ignore", CaptureWarning)
        fit(replace(scene, points=points, views=views), settings, progress=False)


def front(rows: Sequence[Row]) -> list[Row]:
    """Rows that no other beats in both seconds and error, by seconds (Pareto)."""
    best: list[Row] = []
    for row in sorted(rows, key=lambda row: (row.seconds, row.error)):
        if not best or row.error < best[-1].error:
            best.append(row)
    return best


def write_rows(rows: Iterable[Row], path: Path) -> Path:
    """A CSV with a line per row, each with the machine and the versions; written whole or not at all."""
    where, records = machine(), []
    for row in rows:
        left_out = "; ".join(str(entry["what"]) for entry in row.left_out)
        records.append(asdict(row) | {"left_out": left_out, "machine": where})
    return write_file(path, csv_text(records).encode())


def machine() -> str:
    """The machine that measured seconds: processor, cores, system, and the versions of Python and the libraries."""
    information = Path("/proc/cpuinfo")
    models = re.findall(r"^model name\s*: (.*)", information.read_text(), re.M) if information.is_file() else []
    processor = models[0] if models else platform.processor() or platform.machine()
    versions = ", ".join(f"{name} {version(name)}" for name in ("numpy", "numba", "scipy", "onnxruntime"))
    return f"{processor}, {os.cpu_count()} cores, {platform.system()}, Python {platform.python_version()}, {versions}"
