"""Where the time goes, held against a stored run: `make bench`, under a minute on two cores.

    python examples/bench.py                 # the table, beside bench_baseline.json
    python examples/bench.py --save          # three rounds, stored as the new baseline

Every row has seconds, error, and *units*: seconds over those of a fixed piece of work in numpy (one core, no BLAS)
timed in the same run, so that a faster machine, or a slower one, has about the same figure. "against" is the seconds of
the plain way to the same answer, over ours, in the same run too. A row is marked slower where its units exceed the
baseline's by more than a quarter, or by more than the stored rounds differed among themselves; that is a hint, no
failure. Rows that use all cores compare only where there are as many, and nothing else to do: they are wall-clock time,
the unit is the processor's.

    kernel        one view of 100,000 Gaussians at 640x480, a core's seconds; error: largest weight against float64, in
                  a window, relative; against the literal form in numpy, that window
    fit           a made room of 60,000 points and 30 images, stage by stage; error: 1 - adjusted Rand index
    segment       300,000 points in a scene; error: share with another instance than scipy's KD-tree (all cores) finds
    first answer  a fresh process: import, load, label 1,000 points; error: share of labels that differ from ours
    write         that scene as .ogpc; error: share of points whose instance differs when it is read back
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from benchmark_runtime import make_frame
from benchmark_scaling import made_scene, warm_up
from benchmark_visibility import box_case, errors, window_of

import og_pointcloud as og
from og_pointcloud.cloud import TOO_FAR, LabelledCloud
from og_pointcloud.evaluate.metrics import adjusted_rand_index
from og_pointcloud.evaluate.report.sweep import machine

Answer = TypeVar("Answer")

BASELINE = Path(__file__).with_name("bench_baseline.json")
NOISE = 1.25
"""Units may differ by this factor from run to run on a machine that has other things to do."""
ROUNDS_SAVED = 3
RUNS = 5
UNIT_SORTED, UNIT_SQUARE = 4_000_000, 500
KERNEL_POINTS, KERNEL_IMAGE = 100_000, (640, 480)
ROOM_POINTS, ROOM_VIEWS, ROOM_IMAGE = 60_000, 30, (640, 480)
FRAME_POINTS, FRAME_NOISE = 300_000, 0.3
"""The frame's points lie so many point spacings off the scene's, standard deviation."""
FIRST_POINTS = 1_000
FIRST_ANSWER = """
import sys, time
start = time.perf_counter()
import numpy as np
import og_pointcloud as og
scene = og.load(sys.argv[1])
words = {str(row): vector for row, vector in enumerate(np.load(sys.argv[2]))}
labels = og.Segmenter(scene, words)(scene.xyz[: int(sys.argv[3])]).labels
print(time.perf_counter() - start, *labels)
"""


@dataclass(frozen=True)
class Row:
    """seconds: the least of several runs. units: of the calibration. error: see above. against: None where there is no
    plain way. cores: that the work may use."""

    name: str
    seconds: float
    units: float
    error: float
    against: float | None = None
    cores: int = 1


@dataclass(frozen=True)
class Kept:
    """A row of the baseline: the median of its rounds, and the largest over the smallest."""

    units: float
    error: float
    spread: float
    cores: int


def fastest(work: Callable[[], Answer], runs: int = RUNS, clock: Callable[[], float] = time.perf_counter) -> tuple:
    """Seconds, the least of several runs after a discarded one, and the last answer."""
    answer, taken = work(), []
    for _ in range(runs):
        start = clock()
        answer = work()
        taken.append(clock() - start)
    return min(taken), answer


def calibration_seconds() -> float:
    """Of the unit: a sort and a product, about 0.1 s of one core. einsum without BLAS stays on that core."""
    values = np.random.default_rng(0).random(UNIT_SORTED)
    square = values[: UNIT_SQUARE**2].reshape(UNIT_SQUARE, UNIT_SQUARE)
    return fastest(lambda: (np.sort(values), np.einsum("ij,jk->ik", square, square)), clock=time.process_time)[0]


# The pieces of work ---------------------------------------------------------------------------------------------


def bench_kernel(unit: float, points: int = KERNEL_POINTS, image: tuple[int, int] = KERNEL_IMAGE) -> list[Row]:
    """One row."""
    import numba
    from reference_splatting import reference_view_weights  # pyright: ignore[reportMissingImports]  (in tests/)

    from og_pointcloud.fitting.mask_table import view_weights

    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        case = box_case(points, *image)
        window = window_of(case)
        seconds, _ = fastest(lambda: view_weights(*case.arguments), clock=time.process_time)
        ours, _ = fastest(lambda: view_weights(*window.arguments), clock=time.process_time)
        start = time.process_time()
        reference = reference_view_weights(window.gaussians, window.camera, window.ids, window.mask_count, window.near)
        plain = time.process_time() - start
        return [Row("kernel", seconds, seconds / unit, errors(window, reference)[0], plain / ours)]
    finally:
        numba.set_num_threads(threads)


def bench_fit(
    unit: float, points: int = ROOM_POINTS, views: int = ROOM_VIEWS, image: tuple[int, int] = ROOM_IMAGE, runs: int = 2
) -> tuple[list[Row], LabelledCloud]:
    """A row a stage, and the cloud of the last run."""
    warm_up(og.FitSettings())
    scene, owner = made_scene(points, views, image)
    clouds = [og.fit(scene, progress=False) for _ in range(runs)]
    stages: dict[str, list[float]] = {}
    for cloud in clouds:
        of_run: dict[str, float] = {}
        for stage in cloud.provenance["stages"]:
            of_run[stage["name"]] = of_run.get(stage["name"], 0.0) + stage["seconds"]
        for name, seconds in of_run.items():
            stages.setdefault(name, []).append(seconds)
    known = owner >= 0
    error = 1 - adjusted_rand_index(clouds[-1].instance_ids[known], owner[known])
    rows = [_of_all_cores(f"fit: {name}", min(seconds), unit, error) for name, seconds in stages.items()]
    total = min(sum(stage["seconds"] for stage in cloud.provenance["stages"]) for cloud in clouds)
    return [*rows, _of_all_cores("fit, all", total, unit, error)], clouds[-1]


def bench_segment(unit: float, cloud: LabelledCloud, path: Path, points: int = FRAME_POINTS) -> list[Row]:
    """One row. path: the cloud's .ogpc."""
    from scipy.spatial import cKDTree

    frame = make_frame(cloud, points, FRAME_NOISE)
    local, tree = (frame - cloud.origin).astype(np.float32), cKDTree(cloud.xyz)
    ids = np.append(cloud.instance_ids, np.int32(TOO_FAR))
    segmenter = og.Segmenter(path, _words(cloud))
    seconds, result = fastest(lambda: segmenter(frame))
    plain, found = fastest(lambda: ids[tree.query(local, distance_upper_bound=cloud.reach, workers=-1)[1]])
    error = float((result.instances != found).mean())
    return [_of_all_cores("segment", seconds, unit, error, plain / seconds)]


def bench_first_answer(unit: float, cloud: LabelledCloud, path: Path, runs: int = RUNS) -> list[Row]:
    """One row."""
    words, count = _words(cloud), min(FIRST_POINTS, len(cloud))
    vectors = path.with_suffix(".words.npy")
    np.save(vectors, np.stack(list(words.values())))
    command = [sys.executable, "-c", FIRST_ANSWER, str(path), str(vectors), str(count)]
    printed = [subprocess.run(command, capture_output=True, text=True, check=True).stdout.split() for _ in range(runs)]
    ours = og.Segmenter(cloud, words)(cloud.xyz_world[:count]).labels
    error = float((np.array(printed[-1][1:], int) != ours).mean())
    seconds = min(float(line[0]) for line in printed)
    return [_of_all_cores("first answer", seconds, unit, error)]


def bench_write(unit: float, cloud: LabelledCloud, path: Path, runs: int = 3) -> list[Row]:
    """One row; leaves the file."""
    seconds, _ = fastest(lambda: og.write_bundle(cloud, path), runs)
    read = og.load(path).cloud
    return [_of_all_cores("write", seconds, unit, float((read.instance_ids != cloud.instance_ids).mean()))]


def measure() -> list[Row]:
    """All rows once. The unit is timed before and after; the lesser counts, as with all others."""
    unit = calibration_seconds()
    rows = bench_kernel(unit)
    of_fit, cloud = bench_fit(unit)
    rows += of_fit
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "room.ogpc"
        rows += bench_write(unit, cloud, path)
        rows += bench_segment(unit, cloud, path)
        rows += bench_first_answer(unit, cloud, path)
    least = min(unit, calibration_seconds())
    return [Row(**{**asdict(row), "units": row.seconds / least}) for row in rows]


def _of_all_cores(name: str, seconds: float, unit: float, error: float, against: float | None = None) -> Row:
    return Row(name, seconds, seconds / unit, error, against, os.cpu_count() or 1)


def _words(cloud: LabelledCloud) -> dict[str, np.ndarray]:
    """Some instances' own looks, as labels."""
    return {f"thing {row}": vector for row, vector in enumerate(cloud.instances.descriptors[:8])}


# The baseline ---------------------------------------------------------------------------------------------------


def baseline_of(rounds: Sequence[Sequence[Row]]) -> dict[str, Kept]:
    """What is kept of several rounds."""
    kept = {}
    for same in zip(*rounds, strict=True):
        units = [row.units for row in same]
        error = max(row.error for row in same)
        kept[same[0].name] = Kept(float(np.median(units)), error, max(units) / min(units), same[0].cores)
    return kept


def verdict(row: Row, kept: Kept | None) -> str:
    """What a row is beside the baseline: a factor, and a mark where it is out of the noise."""
    if kept is None:
        return "new"
    if kept.cores != row.cores:
        return f"(of {kept.cores} cores)"
    factor, band = row.units / kept.units, max(NOISE, kept.spread)
    mark = "slower" if factor > band else "faster" if factor < 1 / band else ""
    worse = "larger error" if row.error > kept.error * (1 + 1e-3) + 1e-9 else ""
    return " ".join(filter(None, (f"{factor:.2f}", mark, worse)))


def read_baseline(path: Path) -> dict[str, Kept]:
    """Rows by name; none where nothing is stored."""
    if not path.is_file():
        return {}
    stored = json.loads(path.read_text(encoding="utf-8"))
    return {name: Kept(**row) for name, row in stored["rows"].items()}


def write_baseline(path: Path, kept: dict[str, Kept]) -> None:
    """JSON, with the machine it was measured on."""
    content = {"machine": machine(), "rows": {name: asdict(row) for name, row in kept.items()}}
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def print_rows(rows: Iterable[Row], baseline: dict[str, Kept]) -> None:
    """The table."""
    print(f"{'':<18} {'seconds':>9} {'error':>9} {'against':>8} {'units':>8} {'stored':>8}  of stored")
    for row in rows:
        against = "-" if row.against is None else f"{row.against:.1f}x"
        kept = baseline.get(row.name)
        stored, said = "-" if kept is None else f"{kept.units:.2f}", verdict(row, kept) if baseline else "-"
        figures = f"{row.seconds:9.4f} {row.error:9.2g} {against:>8} {row.units:8.2f} {stored:>8}"
        print(f"{row.name:<18} {figures}  {said}", flush=True)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print, compare; with --save store."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--baseline", type=Path, default=BASELINE, help="what to compare with (default: beside this)")
    parser.add_argument("--save", action="store_true", help=f"measure {ROUNDS_SAVED} rounds and store them there")
    options = parser.parse_args(arguments)
    baseline = read_baseline(options.baseline)
    print(machine())
    rounds = []
    for _ in range(ROUNDS_SAVED if options.save else 1):
        rounds.append(measure())
        print_rows(rounds[-1], baseline)
    slower = [row.name for row in rounds[-1] if row.name in baseline and "slower" in verdict(row, baseline[row.name])]
    if slower:
        print(f"slower than the baseline, beyond its noise: {', '.join(slower)}")
    if options.save:
        write_baseline(options.baseline, baseline_of(rounds))
        print(f"wrote {options.baseline}")
    elif not baseline:
        print(f"nothing to compare with: {options.baseline} is made with --save")


if __name__ == "__main__":
    main()
