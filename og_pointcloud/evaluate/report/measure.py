"""One fit, measured in a process of its own: its error, its seconds, its peak memory.

    python -m og_pointcloud.evaluate.report.measure CAPTURE KNOB VALUE LABELS.npy     # prints a Row as JSON

A fit of two views and few points comes first and is discarded, so that compiled code is loaded.
"""

from __future__ import annotations

import json
import re
import resource
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.ask.labelled_scene import as_scene
from og_pointcloud.cloud import LabelledCloud, Vocabulary
from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.evaluate.report.knobs import Setting, find_setting
from og_pointcloud.evaluate.truth import GT_NAME, Truth, read_truth
from og_pointcloud.fitting.fit import fit, prepare
from og_pointcloud.formats.capture import read_capture
from og_pointcloud.scene import Points, Scene
from og_pointcloud.settings import FitSettings
from og_pointcloud.text.text_features import read_text_features

__all__ = [
    "Row",
    "Subject",
    "digest_of",
    "error_of",
    "labels_of",
    "measure",
    "measure_apart",
    "peak_mb",
    "read_subject",
    "reset_peak",
    "warm_up",
]

WARM_UP_POINTS = 2_000
KILOBYTES = 1 if sys.platform == "darwin" else 1024
"""Bytes of one unit of ru_maxrss."""
STATUS, CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


@dataclass(frozen=True)
class Subject:
    """A capture, the words that are asked of it, and what its points are. Both None where the folder lacks them."""

    folder: Path
    vocabulary: Vocabulary | None
    truth: Truth | None


@dataclass(frozen=True)
class Row:
    """One setting on one capture.

    seconds, seconds_most: least and most of the runs. shares: what was taken over from the default's fit in the same
    process, nothing, geometry or table; shared_seconds: how many of the seconds are of that. peak_mb: of the process
    while it ran, NaN where that is not known.
    miou, macc, unknown: over the points with a known class, a point without a label being a miss; background: the share
    of known background that was given a class. None where the capture does not know them.
    gain, gain_low, gain_high: the mIoU less that of the default (of mode fast for what only that has), and the 95 %
    interval of the difference over blocks of space. None without truth.
    disagreement, off_exact: share of all points whose label differs from the default's, and from that of the exact
    setting; of rows of the finished file, from the exact nearest point's. Where there are no words, 1 minus the
    adjusted Rand index of the instances. off_exact is None where the exact setting was not run.
    megabytes: of what is kept, for rows of the finished file: query.onnx, or the table of vectors.
    seed: of the fit. digest: of instance ids, descriptors and certainty. runs_alike: whether those of all runs were the
    same, bit for bit. left_out: as the fit noted it.
    """

    capture: str
    knob: str
    value: str
    seconds: float
    seconds_most: float
    shares: str = "nothing"
    shared_seconds: float = 0.0
    runs: int = 1
    peak_mb: float = float("nan")
    miou: float | None = None
    macc: float | None = None
    unknown: float | None = None
    background: float | None = None
    gain: float | None = None
    gain_low: float | None = None
    gain_high: float | None = None
    disagreement: float = 0.0
    off_exact: float | None = None
    megabytes: float | None = None
    instances: int = 0
    seed: int = 0
    digest: str = ""
    runs_alike: bool = True
    left_out: tuple[dict[str, str], ...] = ()

    @property
    def is_default(self) -> bool:
        """Whether this is what a fit without settings does, in a process of its own."""
        return self.knob == "default" and not self.value


def read_subject(folder: Path) -> Subject:
    """The words and the truth of a capture, as far as it has them."""
    folder = folder.absolute()  # "." has no name
    words = folder / "text_features.npz"
    vocabulary = read_text_features(words)[0] if words.is_file() else None
    truth = read_truth(folder) if vocabulary and (folder / GT_NAME).is_file() else None
    return Subject(folder, vocabulary, truth)


def measure(subject: Subject, setting: Setting) -> tuple[Row, NDArray[np.integer]]:
    """Fit a capture in this process, sharing nothing; the row, and what `labels_of` says of its points."""
    scene = read_capture(subject.folder)
    scene = replace(scene, views=scene.views[:: setting.every])
    if setting.special == "plain points":
        scene = replace(scene, points=replace(scene.points, scale=None, rotation=None, opacity=None))
    warm_up(scene, setting.settings)
    reset_peak()
    start = time.perf_counter()
    # A fit with a table at hand takes the scene as it is, with points that lie at one place.
    prepared = prepare(scene, setting.settings) if setting.special == "coincident points" else None
    cloud = fit(scene, setting.settings, prepared=prepared, progress=False)
    seconds = time.perf_counter() - start
    peak = peak_mb()
    labels = labels_of(cloud, subject.vocabulary)
    row = Row(
        capture=subject.folder.name,
        knob=setting.knob,
        value=setting.value,
        seconds=seconds,
        seconds_most=seconds,
        peak_mb=peak,
        instances=len(cloud.instances),
        seed=setting.settings.seed,
        digest=digest_of(cloud),
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


def warm_up(scene: Scene, settings: FitSettings) -> None:
    """Fit two views of a few points: what they are labelled does not matter."""
    points, rows = scene.points, slice(None, None, 1 + len(scene.points) // WARM_UP_POINTS)
    columns = {name: getattr(points, name) for name in ("rgb", "normals", "scale", "rotation", "opacity")}
    thin = Points(points.xyz[rows], points.origin, **{name: v if v is None else v[rows] for name, v in columns.items()})
    with_masks = [view for view in scene.views if view.mask_count]
    fit(replace(scene, points=thin, views=tuple(with_masks[:2])), settings, progress=False)


def reset_peak() -> None:
    """Let the peak of this process's memory start anew, where the system can (Linux)."""
    if CLEAR.is_file():
        CLEAR.write_text("5")


def peak_mb() -> float:
    """Most memory of this process since `reset_peak`, or since its start, in MB."""
    if STATUS.is_file() and (found := re.search(r"VmHWM:\s+(\d+) kB", STATUS.read_text())):
        return int(found[1]) * 1024 / 1e6
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * KILOBYTES / 1e6


def labels_of(cloud: LabelledCloud, vocabulary: Vocabulary | None) -> NDArray[np.integer]:
    """(n,) the word of each point, -1 unknown; its instance where there are no words."""
    if vocabulary is None:
        return cloud.instance_ids
    return as_scene(cloud).chooser.choose(vocabulary.vectors).at(cloud.instance_ids)[0]


def digest_of(cloud: LabelledCloud) -> str:
    """A fingerprint of the answer: equal where instances, descriptors and certainty are the same bit for bit."""
    digest = blake2b(digest_size=8)
    instances, certainty = cloud.instances, cloud.certainty
    for array in (cloud.instance_ids, instances.descriptors, instances.descriptor_instance, certainty):
        digest.update(b"" if array is None else np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


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


def main(arguments: Sequence[str] | None = None) -> None:
    """One row on standard output; the labels in the file named."""
    folder, knob, value, labels_file = sys.argv[1:] if arguments is None else arguments
    row, labels = measure(read_subject(Path(folder)), find_setting(knob, value))
    np.save(labels_file, labels)
    print(json.dumps(asdict(row)))


if __name__ == "__main__":
    main()
