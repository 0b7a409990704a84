"""One fit, measured in a process of its own: its error, its seconds, its peak memory.

    python -m og_pointcloud.report.measure CAPTURE KNOB VALUE LABELS.npy     # prints a Row as JSON

A fit of two views and few points comes first and is discarded, so that compiled code is loaded.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.choosing import chooser_of
from og_pointcloud.cloud import LabelledCloud, Vocabulary
from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.fitting.fit import fit
from og_pointcloud.formats.capture import read_capture
from og_pointcloud.metrics import adjusted_rand_index
from og_pointcloud.report.knobs import Setting, find_setting
from og_pointcloud.scene import Points, Scene
from og_pointcloud.scoring.truth import GT_NAME, Truth, read_truth
from og_pointcloud.text.features import read_text_features

__all__ = ["Row", "Subject", "disagreement", "error_of", "labels_of", "measure", "measure_apart", "read_subject"]

WARM_UP_POINTS = 2_000
KILOBYTES = 1 if sys.platform == "darwin" else 1024
"""Bytes of one unit of ru_maxrss."""


@dataclass(frozen=True)
class Subject:
    """A capture, the words that are asked of it, and what its points are. Both None where the folder lacks them."""

    folder: Path
    vocabulary: Vocabulary | None
    truth: Truth | None


@dataclass(frozen=True)
class Row:
    """One setting on one capture.

    miou, macc, unknown: over the points with a known class, a point without a label being a miss; background: the share
    of known background that was given a class. None where the capture does not know them.
    disagreement: share of all points whose label differs from the default's; where there are no words, 1 minus the
    adjusted Rand index of the instances.
    seconds, seconds_most: least and most of the runs. peak_mb: of the process, NaN where it was not one of its own.
    runs_alike: whether every run gave every point the same label. left_out: as the fit noted it.
    """

    capture: str
    knob: str
    value: str
    seconds: float
    peak_mb: float
    miou: float | None = None
    macc: float | None = None
    unknown: float | None = None
    background: float | None = None
    disagreement: float = 0.0
    instances: int = 0
    runs: int = 1
    seconds_most: float = 0.0
    runs_alike: bool = True
    left_out: tuple[dict[str, str], ...] = ()

    @property
    def is_default(self) -> bool:
        """Whether this is what a fit without settings does."""
        return self.knob == "default"


def read_subject(folder: Path) -> Subject:
    """The words and the truth of a capture, as far as it has them."""
    words = folder / "text_features.npz"
    vocabulary = read_text_features(words)[0] if words.is_file() else None
    truth = read_truth(folder) if vocabulary and (folder / GT_NAME).is_file() else None
    return Subject(folder, vocabulary, truth)


def measure(subject: Subject, setting: Setting) -> tuple[Row, NDArray[np.integer]]:
    """Fit a capture in this process; the row, and what `labels_of` says of its points."""
    scene = read_capture(subject.folder)
    scene = replace(scene, views=scene.views[:: setting.every])
    fit(_small(scene), setting.settings, progress=False)
    start = time.perf_counter()
    cloud = fit(scene, setting.settings, progress=False)
    seconds = time.perf_counter() - start
    labels = labels_of(cloud, subject.vocabulary)
    row = Row(
        capture=subject.folder.name,
        knob=setting.knob,
        value=setting.value,
        seconds=seconds,
        seconds_most=seconds,
        peak_mb=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * KILOBYTES / 1e6,
        instances=len(cloud.instances),
        left_out=tuple(cloud.provenance["left_out"]),
        **error_of(labels, subject),
    )
    return row, labels


def measure_apart(folder: Path, setting: Setting, labels: Path) -> Row:
    """`measure` in a process of its own, which leaves the labels in a file."""
    command = [sys.executable, "-m", __spec__.name, str(folder), setting.knob, setting.value, str(labels)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        last = done.stderr.strip().splitlines()[-1:] or [f"exit code {done.returncode}"]
        raise OgPointcloudError(f"{folder.name}, {setting.knob} {setting.value}: the fit failed: {last[0]}")
    return Row(**json.loads(done.stdout))


def labels_of(cloud: LabelledCloud, vocabulary: Vocabulary | None) -> NDArray[np.integer]:
    """(n,) the word of each point, -1 unknown; its instance where there are no words."""
    if vocabulary is None:
        return cloud.instance_ids
    return chooser_of(cloud).choose(vocabulary.vectors).at(cloud.instance_ids)[0]


def error_of(labels: NDArray[np.integer], subject: Subject) -> dict[str, Any]:
    """mIoU, recall, and shares of points, as Row has them; nothing where the capture does not know its classes."""
    truth, vocabulary = subject.truth, subject.vocabulary
    if truth is None or vocabulary is None:
        return {}
    score = truth.score(labels, vocabulary.names)
    return {
        "miou": score.miou,
        "macc": score.macc,
        "unknown": score.unknown_share,
        "background": score.background_called,
    }


def disagreement(labels: NDArray[np.integer], default: NDArray[np.integer], subject: Subject) -> float:
    """How far labels are from the default's, in [0, 1]."""
    if subject.vocabulary is None:
        return 1 - adjusted_rand_index(labels, default)
    return float((labels != default).mean())


def _small(scene: Scene) -> Scene:
    """Two views of a few points: what they are labelled does not matter."""
    points, rows = scene.points, slice(None, None, 1 + len(scene.points) // WARM_UP_POINTS)
    columns = {name: getattr(points, name) for name in ("rgb", "normals", "scale", "rotation", "opacity")}
    thin = Points(points.xyz[rows], points.origin, **{name: v if v is None else v[rows] for name, v in columns.items()})
    with_masks = [view for view in scene.views if view.mask_count]
    return replace(scene, points=thin, views=tuple(with_masks[:2]))


def main() -> None:
    """One row on standard output; the labels in the file named."""
    folder, knob, value, labels_file = sys.argv[1:]
    row, labels = measure(read_subject(Path(folder)), find_setting(knob, value))
    np.save(labels_file, labels)
    print(json.dumps(asdict(row)))


if __name__ == "__main__":
    main()
