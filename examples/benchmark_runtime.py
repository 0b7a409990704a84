"""How fast a scene labels a frame, what that costs in error and bytes, and what the runtime weighs.

    python examples/benchmark_runtime.py SCENE.ogpc -o out/runtime    # runtime.csv and runtime.png, over cell sizes
    python examples/benchmark_runtime.py SCENE.ogpc --footprint       # import, first answer, memory, installed size

A frame is points of the scene's own cloud moved by noise. Labels are cached, as in a stream. Each round times every
way once, and scipy's KD-tree with all cores beside them, so that ratios hold on a busy machine too. A second table has
the text side: precisions and widths of the descriptor table, error against time. Needs the extras fit and report;
--footprint needs the base install alone.
"""

from __future__ import annotations

import argparse
import csv
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

import og_pointcloud as og
from og_pointcloud.ask.labelled_scene import LabelledScene
from og_pointcloud.bundle.read import Bundle
from og_pointcloud.cloud import TOO_FAR, LabelledCloud, Vocabulary

if TYPE_CHECKING:
    from og_pointcloud_export.query_head import ScoreHead

CELL_SIZES = (1.0, 1.5, 2.0, 3.0, 4.0)
"""In point spacings; a third of the reach is the smallest there is."""
WAYS = {"table alone": {"lists": False}, "lists": {"split": False}, "lists and parts": {}}
"""A cell's answer at its centre; border cells settled by their candidates; and those that hold points split first."""
RANDOM_WORDS = 500
HEAVY = ("torch", "open3d", "pyvista", "cv2", "numba", "scipy")
FIRST_ANSWER = """
import sys, time
start = time.perf_counter()
import og_pointcloud as og
imported = time.perf_counter()
scene = og.load(sys.argv[1])
points, dimensions = scene.xyz[:1000], scene.cloud.instances.descriptors.shape[1] or 1
og.Segmenter(scene, {"word": [1.0] * dimensions})(points)
answered = time.perf_counter()
import resource
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print(imported - start, answered - start, peak, *(name for name in sys.argv[2:] if name in sys.modules))
"""


@dataclass(frozen=True)
class LookupRow:
    """One table of the grid. frame_ms: a Segmenter's call, exact; graph_ms: query.onnx alone. kd_tree_ms: scipy, all
    cores. differ: share of points that the graph answers otherwise than the KD-tree; frame_differ: the Segmenter. open:
    share that the graph leaves to the exact search. onnx_mb: size of query.onnx; build_seconds: to make it.
    """

    way: str
    cell_per_spacing: float
    frame_ms: float
    graph_ms: float
    kd_tree_ms: float
    ratio: float
    differ: float
    frame_differ: float
    open: float
    onnx_mb: float
    build_seconds: float


@dataclass(frozen=True)
class ScoreRow:
    """One descriptor table. error: largest difference of a cosine from float64 (of centred vectors where centred);
    best_word_differs: share of instances; text_ms: all words, no point.
    """

    precision: str
    width: int
    centred: bool
    text_ms: float
    error: float
    best_word_differs: float
    table_kb: float


def main(arguments: Sequence[str] | None = None) -> None:
    """Parse, measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("-o", "--output", type=Path, help="folder for runtime.csv, scores.csv and runtime.png")
    parser.add_argument("--points", type=int, default=300_000, help="points of a frame (300000)")
    parser.add_argument("--noise", type=float, default=0.3, help="standard deviation, in point spacings (0.3)")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--cells", type=float, nargs="+", default=CELL_SIZES, help="cell sizes, in point spacings")
    parser.add_argument("--words", type=Path, help="text-features .npz to ask for; left out: the scene's own words")
    parser.add_argument("--footprint", action="store_true")
    options = parser.parse_args(arguments)
    if options.footprint:
        print_footprint(options.scene)
        return
    cloud = og.load(options.scene).cloud
    frame = make_frame(cloud, options.points, options.noise)
    lookups = measure_lookups(cloud, frame, options.cells, options.rounds)
    print_table(lookups)
    words = og.read_text_features(options.words)[0] if options.words is not None else cloud.vocabulary
    scores = measure_scores(cloud, words, options.rounds)
    print_table(scores)
    if options.output is not None:
        options.output.mkdir(parents=True, exist_ok=True)
        write_csv(options.output / "runtime.csv", lookups)
        write_csv(options.output / "scores.csv", scores)
        plot(options.output / "runtime.png", lookups, options.points)


def make_frame(cloud: LabelledCloud, points: int, noise: float) -> NDArray[np.float64]:
    """(points, 3) world coordinates near the cloud's own."""
    random = np.random.default_rng(0)
    own = cloud.xyz_world[random.integers(0, len(cloud), points)]
    return own + noise * cloud.spacing * random.normal(size=own.shape)


def measure_lookups(
    cloud: LabelledCloud, frame: NDArray[np.float64], cells: Iterable[float], rounds: int
) -> list[LookupRow]:
    """A row a table; all are timed in turn, round after round, and a row has their medians."""
    from scipy.spatial import cKDTree

    tables = [build_table(cloud, way, cell) for way in WAYS for cell in cells]
    local = (frame - cloud.origin).astype(np.float32)
    tree = cKDTree(cloud.xyz)

    def ask_tree() -> NDArray[np.int32]:
        _, nearest = tree.query(local, distance_upper_bound=cloud.reach, workers=-1)
        return np.append(cloud.instance_ids, np.int32(TOO_FAR))[nearest]

    exact = ask_tree()
    ways: list[Callable[[], Any]] = [ask_tree]
    for table in tables:
        ways += [lambda table=table: table.segmenter(frame), lambda table=table: table.run(local)]
    seconds = np.median([[timed(way) for way in ways] for _ in range(rounds)], axis=0)
    tree_seconds = seconds[0]
    rows = []
    for table, frame_seconds, graph_seconds in zip(tables, seconds[1::2], seconds[2::2], strict=True):
        instance, certain = table.run(local)
        rows.append(
            LookupRow(
                table.way, table.cell, 1e3 * frame_seconds, 1e3 * graph_seconds, 1e3 * tree_seconds,
                tree_seconds / frame_seconds, float((instance != exact).mean()),
                float((table.segmenter(frame).instances != exact).mean()), float((~certain).mean()), table.onnx_mb,
                table.build_seconds,
            )
        )  # fmt: skip
    return rows


@dataclass(frozen=True)
class Table:
    """A grid ready to be asked. run: local points (N, 3) float32 -> instance and certain, by the graph alone."""

    way: str
    cell: float
    segmenter: og.Segmenter
    run: Callable[[NDArray[np.float32]], Sequence[Any]]
    onnx_mb: float
    build_seconds: float


def build_table(cloud: LabelledCloud, way: str, cell: float) -> Table:
    """The grid of that way and cell size, in a scene of its own."""
    from og_pointcloud_export.brick_grid import GridSettings, build_brick_grid
    from og_pointcloud_export.query_head import build_query_head

    from og_pointcloud.models import open_session

    start = time.perf_counter()
    graph = build_query_head(cloud, build_brick_grid(cloud, GridSettings(cell_per_spacing=cell, **WAYS[way])))
    seconds = time.perf_counter() - start
    session, width = open_session(graph), max(cloud.instances.descriptors.shape[1], 1)
    words = {f"word {row}": vector for row, vector in enumerate(np.eye(8, width, dtype=np.float32)) if vector.any()}
    return Table(
        way,
        cell,
        og.Segmenter(LabelledScene(Bundle(None, cloud, graph, {})), words),
        lambda local: session.run(["instance", "certain"], {"points": local, "text": np.zeros((0, width), np.float32)}),
        len(graph) / 1e6,
        seconds,
    )


def measure_scores(cloud: LabelledCloud, words: Vocabulary | None, rounds: int) -> list[ScoreRow]:
    """Precisions and widths of the descriptor table, asked for these words; without any, for random vectors."""
    from og_pointcloud_export.query_head import ScoreHead

    width = cloud.instances.descriptors.shape[1]
    if len(cloud.instances.descriptors) == 0:
        return []
    random = np.random.default_rng(0).normal(size=(RANDOM_WORDS, width)).astype(np.float32)
    text = random if words is None else words.vectors
    heads = [ScoreHead(precision=precision) for precision in ("float32", "float16", "int8")]
    heads += [ScoreHead(reduced) for reduced in (64, 32, 16, 8) if reduced < width]
    heads += [ScoreHead(None, centred=True), ScoreHead(min(64, width), centred=True, precision="int8")]
    return [measure_head(cloud, text, head, rounds) for head in heads]


def measure_head(cloud: LabelledCloud, text: NDArray[np.float32], head: ScoreHead, rounds: int) -> ScoreRow:
    """One descriptor table, all words at once."""
    from og_pointcloud_export.brick_grid import GridSettings, build_brick_grid
    from og_pointcloud_export.query_head import build_query_head, reference_scores

    from og_pointcloud.models import open_session

    session = open_session(build_query_head(cloud, build_brick_grid(cloud, GridSettings(lists=False)), head))
    feed = {"points": np.zeros((0, 3), np.float32), "text": text}

    def ask() -> NDArray[np.float32]:
        return np.asarray(session.run(["instance_scores"], feed)[0])

    plain, found = reference_scores(cloud.instances, text), ask()
    reference = centred_scores(cloud, text) if head.centred else plain
    count, width = cloud.instances.descriptors.shape
    kept = width if head.width is None else min(head.width, count, width)
    table_bytes = count * kept * np.dtype(head.precision).itemsize + (0 if head.width is None else 4 * kept * width)
    return ScoreRow(
        head.precision, kept, head.centred, 1e3 * float(np.median([timed(ask) for _ in range(rounds)])),
        float(np.abs(found - reference).max()), float((found.argmax(axis=1) != plain.argmax(axis=1)).mean()),
        table_bytes / 1e3,
    )  # fmt: skip


def centred_scores(cloud: LabelledCloud, text: NDArray[np.float32]) -> NDArray[np.float64]:
    """Float64 cosines after the mean descriptor is taken off both sides."""
    from dataclasses import replace

    from og_pointcloud_export.query_head import reference_scores

    table = cloud.instances.descriptors.astype(np.float64)
    center = table.mean(axis=0)
    length = np.linalg.norm(table - center, axis=1, keepdims=True)
    moved = np.divide(table - center, length, out=np.zeros_like(table), where=length > 0)
    unit = text / np.linalg.norm(text.astype(np.float64), axis=1, keepdims=True)
    return reference_scores(replace(cloud.instances, descriptors=moved.astype(np.float32)), unit - center)


def timed(ask: Callable[[], Any]) -> float:
    """Seconds of one call."""
    start = time.perf_counter()
    ask()
    return time.perf_counter() - start


def print_table(rows: Sequence[Any]) -> None:
    """Rows of one dataclass as aligned columns."""
    if not rows:
        return
    cells = [list(asdict(rows[0]))]
    cells += [[f"{v:.4g}" if isinstance(v, float) else str(v) for v in asdict(row).values()] for row in rows]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    print("\n".join("  ".join(map(str.rjust, line, widths)) for line in cells), end="\n\n")


def write_csv(path: Path, rows: Sequence[Any]) -> None:
    """One line a row, under the names of its fields."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(asdict(rows[0])) if rows else [])
        writer.writeheader()
        writer.writerows(map(asdict, rows))


def plot(path: Path, rows: Sequence[LookupRow], points: int) -> None:
    """Time and share of differing points over the cell size, one line a way."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, (time_axes, error_axes, size_axes) = pyplot.subplots(1, 3, figsize=(13, 4), layout="constrained")
    for way in WAYS:
        mine = [row for row in rows if row.way == way]
        cells = [row.cell_per_spacing for row in mine]
        time_axes.plot(cells, [row.graph_ms for row in mine], "o-", label=way)
        error_axes.plot(cells, [100 * row.differ for row in mine], "o-", label=way)
        size_axes.plot(cells, [row.onnx_mb for row in mine], "o-", label=way)
    time_axes.axhline(rows[0].kd_tree_ms, color="grey", linestyle="--", label="scipy KD-tree, all cores")
    time_axes.set(title=f"query.onnx, {points:,} points", ylabel="ms", yscale="log")
    error_axes.set(title="points whose instance differs from the exact one", ylabel="%")
    error_axes.set_yscale("symlog", linthresh=0.01)
    error_axes.set_ylim(bottom=0)
    size_axes.set(title="query.onnx", ylabel="MB", ylim=(0, None))
    for axes in (time_axes, error_axes, size_axes):
        axes.set_xlabel("cell size [point spacings]")
        axes.grid(alpha=0.3)
    time_axes.legend()
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def print_footprint(scene: Path, processes: int = 5) -> None:
    """Fresh processes, the fastest of each; the heavy libraries they loaded; the installed size of what is needed."""
    runs = []
    for _ in range(processes):
        command = [sys.executable, "-c", FIRST_ANSWER, str(scene), *HEAVY]
        runs.append(subprocess.run(command, capture_output=True, text=True, check=True).stdout.split())
    imported, answered, peak = (min(float(run[column]) for run in runs) for column in range(3))
    loaded = sorted({name for run in runs for name in run[3:]})
    print(f"import og_pointcloud            {imported:8.3f} s")
    print(f"import, load and first segment  {answered:8.3f} s   ({scene.stat().st_size / 1e6:.1f} MB file)")
    print(f"peak resident memory            {peak / 1e3:8.0f} MB")
    print(f"heavy libraries loaded          {', '.join(loaded) or 'none':>8}   (of {', '.join(HEAVY)})")
    sizes = installed_sizes("og-pointcloud")
    print(f"base install                    {sum(sizes.values()) / 1e6:8.1f} MB")
    for name, size in sorted(sizes.items(), key=lambda item: -item[1]):
        print(f"  {name:<29} {size / 1e6:8.1f} MB")


def installed_sizes(root: str) -> dict[str, int]:
    """Bytes on disk of a distribution and of all that it needs without an extra."""
    sizes: dict[str, int] = {}
    waiting = [root]
    while waiting:
        name = re.sub(r"[-_.]+", "-", waiting.pop()).lower()
        if name in sizes:
            continue
        try:
            found = distribution(name)
        except PackageNotFoundError:
            continue
        paths = [Path(str(found.locate_file(file))) for file in found.files or []]
        sizes[name] = sum(path.stat().st_size for path in paths if path.is_file())
        needed = [line for line in found.requires or [] if "extra ==" not in line]
        waiting += [match.group() for line in needed if (match := re.match(r"[\w.-]+", line))]
    return sizes


if __name__ == "__main__":
    main()
