"""One scene of the zoo, fitted and scored like any capture: our labels, the fit's own reliability, and baselines."""

from __future__ import annotations

import ast
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

import og_pointcloud as og
from og_pointcloud.cloud import UNOBSERVED
from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.evaluate.baselines import baseline_labels
from og_pointcloud.evaluate.captures import Answer, ask
from og_pointcloud.evaluate.intervals import miou_interval
from og_pointcloud.evaluate.knobs import changed
from og_pointcloud.evaluate.metrics import matched_shares
from og_pointcloud.evaluate.truth import Truth, read_truth
from og_pointcloud.fitting.fit import Prepared, fit_prepared, prepare
from og_pointcloud.formats.capture import read_capture
from og_pointcloud.journal import Journal
from og_pointcloud.settings import FitSettings
from og_pointcloud.text.text_features import read_text_features
from og_pointcloud_zoo.draws import half_of
from og_pointcloud_zoo.worse import worse

WORDS, BANK = "text_features.npz", "word_bank.npz"
PIECE_SPACINGS = 5.0
"""Points of a thing that are no farther apart than so many point spacings belong to one piece of it."""


@dataclass(frozen=True)
class Row:
    """One scene. miou, background, unknown: as in `Score`. seconds: of the fit, capture in memory; core_seconds: summed
    over all cores, which other work on the machine affects less. worse: how the scene was made worse before the fit, as
    "views=5".

    recall, precision: of instances (`matched_shares`), None where the truth has no things. reliability: the fit's own,
    in [0, 1]. baseline: the best one, None if none was measured; gain: our mIoU less the
    baseline's, over the same blocks of space, with its 95 % interval.
    """

    scene: str
    half: str
    points: int
    views: int
    miou: float
    background: float | None
    unknown: float
    seconds: float
    core_seconds: float
    reliability: float | None
    recall: float | None = None
    precision: float | None = None
    worse: str = ""
    baseline: str | None = None
    baseline_miou: float | None = None
    gain: float | None = None
    gain_low: float | None = None
    gain_high: float | None = None


def measure(
    folder: Path,
    settings: FitSettings | None = None,
    baselines: bool = True,
    changes: Mapping[str, Any] | None = None,
    largest_pieces: bool = False,
) -> Row:
    """Fit and score a capture with gt.npz and text_features.npz, and the baselines on the same mask table.

    changes: kind -> amount by which the capture is made worse before the fit (`worse`). It is scored at all its points:
    those that were left out take the label of the nearest one that was not.
    largest_pieces: score each thing at its largest piece alone (`at_largest_pieces`).
    """
    capture, truth, changes = read_capture(folder), read_truth(folder), changes or {}
    scene = capture
    for kind, amount in changes.items():
        scene = worse(scene, kind, amount)
    start, worked = time.perf_counter(), time.process_time()
    journal = Journal(progress=False)
    prepared = prepare(scene, settings, journal)
    cloud = fit_prepared(prepared, settings, journal)
    seconds, worked = time.perf_counter() - start, time.process_time() - worked
    xyz = capture.points.xyz  # only "points" changes their rows: strays come after them
    at = np.asarray(cKDTree(scene.points.xyz).query(xyz)[1]) if "points" in changes else np.arange(len(xyz))
    at_points = replace(cloud, xyz=xyz, instance_ids=cloud.instance_ids[at], rgb=None, certainty=None)
    answer = answered(folder, at_points, truth)
    truth = at_largest_pieces(truth, answer.xyz, answer.spacing) if largest_pieces else truth
    score = truth.score(answer.called)
    recall, precision = _of_instances(at_points.instance_ids, truth)
    row = Row(
        scene=folder.name,
        half=half_of(folder.name),
        points=len(scene.points),
        views=len(scene.views),
        miou=score.miou,
        background=score.background_called,
        unknown=score.unknown_share,
        seconds=seconds,
        core_seconds=worked,
        reliability=cloud.reliability,
        recall=recall,
        precision=precision,
        worse=" ".join(f"{kind}={amount}" for kind, amount in changes.items()),
    )
    return _beside_baselines(row, folder, prepared, at, answer, truth, score.classes) if baselines else row


def at_largest_pieces(truth: Truth, xyz: NDArray[np.float32], spacing: float) -> Truth:
    """The truth, with the points of a thing that lie apart from its largest piece not scored.

    A vote of masks, read at the pixels of points, also names points seen past a thing's edges, on the wall behind it.
    OgPointcloudError where the truth has no things.
    """
    if truth.instance is None:
        raise OgPointcloudError("gt.npz has no 'instance'; expected one, the thing that each point is part of")
    scored, named = truth.scored.copy(), truth.cls >= 0
    for thing in np.unique(truth.instance[named]):
        points = np.flatnonzero(named & (truth.instance == thing))
        near = cKDTree(xyz[points]).query_pairs(PIECE_SPACINGS * spacing, output_type="ndarray").T
        graph = csr_array((np.ones(near.shape[1]), near), shape=(len(points), len(points)))
        piece = connected_components(graph, directed=False)[1]
        scored[points] &= piece == np.bincount(piece).argmax()
    return replace(truth, scored=scored)


def _of_instances(ids: NDArray[np.int32], truth: Truth) -> tuple[float | None, float | None]:
    """Recall and precision over the points whose truth is known and that a view sees."""
    if truth.instance is None:
        return None, None
    known = (ids > UNOBSERVED) & truth.scored
    things = np.where(truth.cls >= 0, truth.instance, -1)
    asked = known & (things >= 0)
    if truth.background is not None:
        asked |= known & truth.background
    return matched_shares(ids[asked], things[asked])


def answered(folder: Path, cloud: og.LabelledCloud, truth: Truth) -> Answer:
    """A fitted cloud's label of each of its points, with the capture's own word bank if it has one."""
    if (folder / BANK).is_file():
        with np.load(folder / BANK) as bank:
            cloud = replace(cloud, word_bank=og.WordBank(bank["vectors"]))
    return ask(cloud, truth, folder / WORDS)


def _beside_baselines(
    row: Row, folder: Path, prepared: Prepared, at: NDArray[np.integer], answer: Answer, truth: Truth,
    classes: tuple[int, ...],
) -> Row:  # fmt: skip
    vocabulary = read_text_features(folder / WORDS)[0]
    baselines = baseline_labels(prepared, vocabulary.vectors)
    called = {name: truth.class_of(labels[at], vocabulary.names) for name, labels, _ in baselines}
    mious = {name: truth.score(of_baseline).miou for name, of_baseline in called.items()}
    best = max(mious, key=lambda name: mious[name])
    gain = miou_interval(answer.called, truth, answer.xyz, answer.spacing, classes, less=called[best])
    gains = {"gain": gain.mean, "gain_low": gain.low, "gain_high": gain.high}
    return replace(row, baseline=best, baseline_miou=mious[best], **gains)


def parsed_settings(changes: Iterable[str]) -> FitSettings:
    """Settings with numbers changed by ``path=value``, as "membership.sure_share=0.5" or "mode=grouping"."""
    found = FitSettings()
    for path, value in parsed(changes).items():
        try:
            found = changed(found, path, value)
        except (AttributeError, TypeError):
            raise OgPointcloudError(
                f"'{path}' is not a setting; expected a path like membership.sure_share=0.5"
            ) from None
    return found


def parsed(changes: Iterable[str]) -> dict[str, Any]:
    """Values by name from ``name=value``: numbers where possible, else text."""
    found: dict[str, Any] = {}
    for change in changes:
        name, _, value = change.partition("=")
        found[name] = value
        with suppress(ValueError, SyntaxError):
            found[name] = ast.literal_eval(value)
    return found
