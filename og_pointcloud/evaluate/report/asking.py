"""What the finished file trades: how points are looked up, and how precisely descriptors and texts are kept.

Asked are points about the cloud's own, moved by a quarter of a spacing, as a sensor would see the place again. The
exact answer is the nearest point's, and cosines in float64.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.ask.choosing import Chooser
from og_pointcloud.ask.labelled_scene import LabelledScene
from og_pointcloud.bundle.nearest import NONE_WITHIN_REACH, NearestPoint
from og_pointcloud.cloud import TOO_FAR, LabelledCloud
from og_pointcloud.evaluate.report.measure import Row, Subject, error_of
from og_pointcloud.evaluate.truth import Truth
from og_pointcloud.models import open_session

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

__all__ = ["ASKED", "DEFAULTS", "REASONS", "measure_asking", "truth_of_rows"]

ASKED = 300_000
"""Points of a frame: a depth camera's 640x480."""
MOVED = 0.25
"""Spacings that the points asked are off the cloud's, standard deviation."""
CELLS = (1.0, 1.5, 2.0, 3.0)
"""Edges of the bricks' cells, in point spacings."""
WIDTHS = (256, 64, 16, 4)
REPEATS, LONG = 5, 1.0
"""Calls timed of each way; two once they took so many seconds."""
DEFAULTS = {"lookup": "graph and search", "descriptors": "float32", "text": "float32"}
"""The value of each knob of the finished file where nothing is set."""
REASONS = {
    "lookup": "the graph alone is right where its table has room; seeing that it was, and else searching, takes more",
    "descriptors": "a scene's table is small: rounding saves little; projecting costs words where things are many",
    "text": "as the encoder gives them; a file keeps words in float16 where that changes no answer",
}

Labels = NDArray[np.integer]
Frame = NDArray[np.float64]
"""(n, 3) world coordinates, as a sensor's pose gives them: bringing them to the map is part of each way."""


def measure_asking(cloud: LabelledCloud, subject: Subject, seed: int = 0) -> list[Row]:
    """Rows of the knobs "lookup", "descriptors" and "text"; seconds are of one frame, or of one choice of words.

    subject: its truth is of the cloud's rows.
    """
    if subject.vocabulary is None:
        return []
    random = np.random.default_rng(seed)
    source = random.integers(0, len(cloud), ASKED)
    points = cloud.xyz_world[source] + MOVED * cloud.spacing * random.standard_normal((ASKED, 3))
    asked = subject if subject.truth is None else replace(subject, truth=truth_of_rows(subject.truth, source))
    word_of_id = _words(cloud, subject.vocabulary.vectors)
    ids = _searched(cloud, points)
    exact = word_of_id[ids]
    rows = []
    for value, (look_up, megabytes) in _lookups(cloud).items():
        seconds, found = _timed(lambda look_up=look_up: look_up(points))
        rows.append(_row("lookup", value, seconds, word_of_id[found], exact, asked, megabytes))
    for knob, value, descriptors, texts, megabytes in _precisions(cloud, subject.vocabulary.vectors):
        kept = replace(cloud, instances=replace(cloud.instances, descriptors=descriptors), word_bank=None)
        seconds, words = _timed(lambda kept=kept, texts=texts: _words(kept, texts))
        rows.append(_row(knob, value, seconds, words[ids], exact, asked, megabytes))
    return rows


def truth_of_rows(truth: Truth, rows: NDArray[np.integer]) -> Truth:
    """The truth of some of its points, in that order."""
    background = None if truth.background is None else truth.background[rows]
    return replace(truth, cls=truth.cls[rows], scored=truth.scored[rows], background=background, instance=None)


def _words(cloud: LabelledCloud, texts: NDArray[np.floating]) -> Labels:
    """The word of each instance id, those of -3, -2 and -1 behind the last."""
    return Chooser(cloud.instances).choose(texts).by_id[0]


def _searched(cloud: LabelledCloud, points: Frame) -> Labels:
    nearest = NearestPoint(cloud.xyz, cloud.spacing, cloud.reach).query(_local(cloud, points))
    return np.append(cloud.instance_ids, np.int32(TOO_FAR))[np.where(nearest == NONE_WITHIN_REACH, -1, nearest)]


def _lookups(cloud: LabelledCloud) -> dict[str, tuple[Callable[[Frame], Labels], float | None]]:
    """Ways to the instance of a point, with the MB of their tables; all are made ready before they are timed."""
    from scipy.spatial import cKDTree

    scene = LabelledScene.from_cloud(cloud)
    tree, ids = cKDTree(cloud.xyz), np.append(cloud.instance_ids, np.int32(TOO_FAR))
    search = NearestPoint(cloud.xyz, cloud.spacing, cloud.reach)

    def graph_and_search(points: Frame) -> Labels:
        return scene.instances_at(points)

    def search_alone(points: Frame) -> Labels:
        nearest = search.query(_local(cloud, points))
        return ids[np.where(nearest == NONE_WITHIN_REACH, -1, nearest)]

    def kd_tree(points: Frame) -> Labels:
        return ids[tree.query(_local(cloud, points), distance_upper_bound=cloud.reach, workers=-1)[1]]

    return {
        DEFAULTS["lookup"]: (graph_and_search, None),
        **_graphs(cloud),
        "search alone": (search_alone, None),
        "KD-tree, all cores": (kd_tree, None),
    }


def _local(cloud: LabelledCloud, points: Frame) -> NDArray[np.float32]:
    return (points - cloud.origin).astype(np.float32)


def _graphs(cloud: LabelledCloud) -> dict[str, tuple[Callable[[Frame], Labels], float | None]]:
    """query.onnx alone, with bricks of several cell sizes, and without the lists that settle cells at borders."""
    from og_pointcloud_export.brick_grid import GridSettings, build_brick_grid
    from og_pointcloud_export.query_head import build_query_head

    width = max(cloud.instances.descriptors.shape[1], 1)

    def ask(graph: InferenceSession, points: Frame) -> Labels:
        inputs = {"points": _local(cloud, points), "text": np.zeros((0, width), np.float32)}
        return np.asarray(graph.run(["instance"], inputs)[0])

    ways = {f"graph, cells of {cell:g}": GridSettings(cell_per_spacing=cell) for cell in CELLS}
    ways["graph, no lists"] = GridSettings(lists=False)
    graphs = {}
    for value, settings in ways.items():
        onnx = build_query_head(cloud, build_brick_grid(cloud, settings))
        graphs[value] = partial(ask, open_session(onnx)), len(onnx) / 1e6
    return graphs


def _precisions(
    cloud: LabelledCloud, texts: NDArray[np.floating]
) -> list[tuple[str, str, NDArray[np.float32], NDArray[np.float32], float]]:
    """(knob, value, descriptors, texts, MB) as they would be kept."""
    table, texts = cloud.instances.descriptors, np.asarray(texts, np.float32)
    texts = texts / np.linalg.norm(texts, axis=1, keepdims=True)
    kept = [("descriptors", "float32", table, texts, table.size * 4e-6)]
    kept += [("descriptors", name, rounded(table), texts, table.size * size) for name, rounded, size in ROUNDED]
    kept.append(("text", "float32", table, texts, texts.size * 4e-6))
    kept += [("text", name, table, rounded(texts), texts.size * size) for name, rounded, size in ROUNDED]
    # Words and instances differ along few directions; these are the instances' own.
    middle = table.mean(axis=0) if len(table) else np.zeros(table.shape[1], np.float32)
    directions = np.linalg.svd(table - middle, full_matrices=False)[2]
    for width in WIDTHS:
        if width < min(len(directions), table.shape[1]):
            basis = np.concatenate([_unit(middle[None]), directions[:width]]).T.astype(np.float32)
            value = f"projected to {width}"
            kept.append(("descriptors", value, _unit(table @ basis), texts @ basis, len(table) * (width + 1) * 4e-6))
    return kept


def _eight_bits(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    """A scale a row, as int8 tables are kept."""
    scale = np.maximum(np.abs(rows).max(axis=1, keepdims=True), 1e-30) / 127
    return np.round(rows / scale).astype(np.float32) * scale


ROUNDED: tuple[tuple[str, Callable[[NDArray[np.float32]], NDArray[np.float32]], float], ...] = (
    ("float16", lambda rows: rows.astype(np.float16).astype(np.float32), 2e-6),
    ("int8", _eight_bits, 1e-6),
)
"""A name, what it does to rows, and MB a number."""


def _unit(rows: NDArray[np.floating]) -> NDArray[np.float32]:
    return (rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-30)).astype(np.float32)


def _timed(call: Callable[[], Labels]) -> tuple[list[float], Labels]:
    """Seconds of several calls after a discarded one, of fewer where they take long, and the answer."""
    answer, seconds = call(), []
    while len(seconds) < REPEATS and (len(seconds) < 2 or sum(seconds) < LONG):
        start = time.perf_counter()
        answer = call()
        seconds.append(time.perf_counter() - start)
    return seconds, answer


def _row(
    knob: str, value: str, seconds: list[float], labels: Labels, exact: Labels, asked: Subject, megabytes: float | None
) -> Row:
    off = float((labels != exact).mean())
    return Row(
        capture=asked.folder.name,
        knob=knob,
        value=value,
        seconds=min(seconds),
        seconds_most=max(seconds),
        disagreement=off,
        off_exact=off,
        megabytes=megabytes,
        runs=len(seconds),
        **error_of(labels, asked),
    )
