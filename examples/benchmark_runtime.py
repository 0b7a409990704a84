"""How fast a scene labels a frame, and at what error, compared with scipy's KD-tree; and the footprint of the runtime.

    python examples/benchmark_runtime.py SCENE.ogpc                # seconds per frame of 10,000 to a million points
    python examples/benchmark_runtime.py SCENE.ogpc --footprint    # import, first answer, memory, installed size

A frame is points of the scene's own cloud moved by noise; labels are given, as in a stream. Each round times every
method once, so that ratios hold on a busy machine too. differ: share of points whose instance is not the one that the
KD-tree (exact, all cores) finds. --footprint needs only the base install.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import og_pointcloud as og

SIZES = (10_000, 100_000, 300_000, 1_000_000)
PROCESSES = 5
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


def main(arguments: Sequence[str] | None = None) -> None:
    """Parse, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--points", type=int, nargs="+", default=SIZES, help="points of the frames")
    parser.add_argument("--noise", type=float, default=0.3, help="standard deviation, in point spacings (0.3)")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--footprint", action="store_true")
    options = parser.parse_args(arguments)
    if options.footprint:
        print_footprint(options.scene)
    else:
        print_lookups(og.load(options.scene), options.points, options.noise, options.rounds)


def make_frame(cloud: og.LabelledCloud, points: int, noise: float) -> NDArray[np.float64]:
    """(points, 3) world coordinates near the cloud's own."""
    random = np.random.default_rng(0)
    own = cloud.xyz_world[random.integers(0, len(cloud), points)]
    return own + noise * cloud.spacing * random.normal(size=own.shape)


def exact_lookup(cloud: og.LabelledCloud) -> Callable[[NDArray[np.float64]], NDArray[np.int32]]:
    """World points -> instance of the nearest point of the cloud, TOO_FAR beyond its reach, by scipy's KD-tree."""
    from scipy.spatial import cKDTree

    tree, ids = cKDTree(cloud.xyz), np.append(cloud.instance_ids, np.int32(og.TOO_FAR))

    def look_up(world: NDArray[np.float64]) -> NDArray[np.int32]:
        local = (world - cloud.origin).astype(np.float32)
        return ids[tree.query(local, distance_upper_bound=cloud.reach, workers=-1)[1]]

    return look_up


def print_lookups(scene: og.LabelledScene, sizes: Sequence[int], noise: float, rounds: int) -> None:
    """Print a row per frame size: medians over the rounds."""
    cloud = scene.cloud
    words = {f"thing {row}": vector for row, vector in enumerate(cloud.instances.descriptors[:8])} or {"a": [1.0]}
    segmenter, exact = og.Segmenter(scene, words), exact_lookup(cloud)
    print(f"{len(cloud):,} points, {len(cloud.instances)} instances, noise of {noise:g} point spacings")
    print(f"{'points':>9} {'ms':>9} {'KD-tree ms':>11} {'ratio':>7} {'differ':>9}")
    for points in sizes:
        frame = make_frame(cloud, points, noise)
        differ = float((segmenter(frame).instances != exact(frame)).mean())
        both = [(timed(lambda: segmenter(frame)), timed(lambda: exact(frame))) for _ in range(rounds)]  # noqa: B023
        ours, tree = np.median(both, axis=0)
        print(f"{points:9,} {1e3 * ours:9.2f} {1e3 * tree:11.2f} {tree / ours:7.2f} {differ:9.2g}", flush=True)


def timed(ask: Callable[[], Any]) -> float:
    """Seconds of one call."""
    start = time.perf_counter()
    ask()
    return time.perf_counter() - start


def print_footprint(scene: Path) -> None:
    """Fresh processes, the fastest of each; the heavy libraries they loaded; the installed size of what is needed."""
    runs = []
    for _ in range(PROCESSES):
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
    """Bytes on disk of a distribution and of everything it requires without extras."""
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
