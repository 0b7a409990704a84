"""What the finished file trades: how points are looked up, and how precisely descriptors and texts are kept.

Asked are points about the cloud's own, moved by a quarter of a spacing, as a sensor would see the place again. The
exact answer is the nearest point's, and cosines in float64.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud._onnxruntime import open_session
from og_pointcloud.bundle import TOO_FAR
from og_pointcloud.choosing import Chooser
from og_pointcloud.cloud import LabelledCloud
from og_pointcloud.nearest import NONE_WITHIN_REACH, NearestPoint
from og_pointcloud.report.measure import Row, Subject, error_of
from og_pointcloud.runtime import LabelledScene

__all__ = ["ASKED", "measure_asking"]

ASKED = 300_000
"""Points of a frame: a depth camera's 640x480."""
MOVED = 0.25
"""Spacings that the points asked are off the cloud's, standard deviation."""
WIDTHS = (256, 64, 16, 4)
REPEATS = 5

Labels = NDArray[np.integer]


def measure_asking(cloud: LabelledCloud, subject: Subject, seed: int = 0) -> list[Row]:
    """Rows of the knobs "lookup", "descriptors" and "text"; seconds are of one frame, or of one choice of words."""
    if subject.vocabulary is None:
        return []
    random = np.random.default_rng(seed)
    source = random.integers(0, len(cloud), ASKED)
    points = (cloud.xyz[source] + MOVED * cloud.spacing * random.standard_normal((ASKED, 3))).astype(np.float32)
    asked = subject if subject.truth is None else replace(subject, truth=_of_rows(subject.truth, source))
    word_of_id = _words(cloud, subject.vocabulary.vectors)
    exact = word_of_id[_searched(cloud, points)]
    rows = []
    for value, look_up in _lookups(cloud).items():
        seconds, ids = _timed(lambda look_up=look_up: look_up(points))
        rows.append(_row("lookup", value, seconds, word_of_id[ids], exact, asked))
    ids = _searched(cloud, points)
    for knob, value, descriptors, texts in _precisions(cloud, subject.vocabulary.vectors):
        kept = replace(cloud, instances=replace(cloud.instances, descriptors=descriptors), word_bank=None)
        seconds, words = _timed(lambda kept=kept, texts=texts: _words(kept, texts))
        rows.append(_row(knob, value, seconds, words[ids], exact, asked))
    return rows


def _of_rows(truth: Any, rows: NDArray[np.integer]) -> Any:
    background = None if truth.background is None else truth.background[rows]
    return replace(truth, cls=truth.cls[rows], scored=truth.scored[rows], background=background)


def _words(cloud: LabelledCloud, texts: NDArray[np.floating]) -> Labels:
    """The word of each instance id, those of -3, -2 and -1 behind the last."""
    return Chooser(cloud.instances).choose(texts).by_id[0]


def _searched(cloud: LabelledCloud, points: NDArray[np.float32]) -> Labels:
    nearest = NearestPoint(cloud.xyz, cloud.spacing, cloud.reach).query(points)
    return np.append(cloud.instance_ids, np.int32(TOO_FAR))[np.where(nearest == NONE_WITHIN_REACH, -1, nearest)]


def _lookups(cloud: LabelledCloud) -> dict[str, Callable[[NDArray[np.float32]], Labels]]:
    """Ways to the instance of a point; all are made ready before they are timed."""
    from og_pointcloud_export import query_model
    from scipy.spatial import cKDTree

    graph = open_session(query_model(cloud).onnx)
    width = graph.get_inputs()[1].shape[1]
    scene = LabelledScene.from_cloud(cloud)
    tree, ids = cKDTree(cloud.xyz), np.append(cloud.instance_ids, np.int32(TOO_FAR))
    search = NearestPoint(cloud.xyz, cloud.spacing, cloud.reach)

    def graph_alone(points: NDArray[np.float32]) -> Labels:
        return np.asarray(graph.run(["instance"], {"points": points, "text": np.zeros((0, width), np.float32)})[0])

    def graph_and_search(points: NDArray[np.float32]) -> Labels:
        return scene.instances_at(points + cloud.origin)

    def search_alone(points: NDArray[np.float32]) -> Labels:
        nearest = search.query(points)
        return ids[np.where(nearest == NONE_WITHIN_REACH, -1, nearest)]

    def kd_tree(points: NDArray[np.float32]) -> Labels:
        return ids[tree.query(points, distance_upper_bound=cloud.reach, workers=-1)[1]]

    return {
        "graph alone": graph_alone,
        "graph and search": graph_and_search,
        "search alone": search_alone,
        "scipy KD-tree": kd_tree,
    }


def _precisions(
    cloud: LabelledCloud, texts: NDArray[np.floating]
) -> list[tuple[str, str, NDArray[np.float32], NDArray[np.float32]]]:
    """(knob, value, descriptors, texts) as they would be kept."""
    table, texts = cloud.instances.descriptors, np.asarray(texts, np.float32)
    texts = texts / np.linalg.norm(texts, axis=1, keepdims=True)
    kept = [("descriptors", "float32", table, texts)]
    kept += [("descriptors", name, rounded(table), texts) for name, rounded in ROUNDED.items()]
    kept += [("text", name, table, rounded(texts)) for name, rounded in ROUNDED.items()]
    # Words and instances differ along few directions; these are the instances' own.
    middle = table.mean(axis=0)
    directions = np.linalg.svd(table - middle, full_matrices=False)[2]
    for width in WIDTHS:
        if width < min(len(directions), table.shape[1]):
            basis = np.concatenate([_unit(middle[None]), directions[:width]]).T.astype(np.float32)
            kept.append(("descriptors", f"{width} directions", _unit(table @ basis), texts @ basis))
    return kept


def _eight_bits(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    """A scale a row, as int8 tables are kept."""
    scale = np.maximum(np.abs(rows).max(axis=1, keepdims=True), 1e-30) / 127
    return np.round(rows / scale).astype(np.float32) * scale


ROUNDED: dict[str, Callable[[NDArray[np.float32]], NDArray[np.float32]]] = {
    "float16": lambda rows: rows.astype(np.float16).astype(np.float32),
    "int8": _eight_bits,
}


def _unit(rows: NDArray[np.floating]) -> NDArray[np.float32]:
    return (rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-30)).astype(np.float32)


def _timed(call: Callable[[], Labels]) -> tuple[list[float], Labels]:
    answer, seconds = call(), []
    for _ in range(REPEATS):
        start = time.perf_counter()
        answer = call()
        seconds.append(time.perf_counter() - start)
    return seconds, answer


def _row(knob: str, value: str, seconds: list[float], labels: Labels, exact: Labels, asked: Subject) -> Row:
    return Row(
        capture=asked.folder.name,
        knob=knob,
        value=value,
        seconds=min(seconds),
        seconds_most=max(seconds),
        peak_mb=float("nan"),
        disagreement=float((labels != exact).mean()),
        runs=len(seconds),
        **error_of(labels, asked),
    )
