"""Frames of any size through one Segmenter, for any length of time: does memory stay constant?

    python examples/benchmark_stream.py --frames 1000000 --points 300      # a million small frames
    python examples/benchmark_stream.py --seconds 600                      # a soak of ten minutes

A room of 500 points labels frames of 0 to --points points, now and then far away, or with NaN and infinity among them,
and with another list of labels every hundredth frame, as `~/set_labels` of the ROS node does. It prints the resident
bytes of the process after increasing numbers of frames; the last line is how far they rose after the first 10,000.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import og_pointcloud as og

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

SETTLED = 10_000
"""Frames after which buffers have their final size."""


def main(arguments: list[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=50_000, help="at most")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="at most")
    parser.add_argument("--points", type=int, default=20_000, help="of the largest frame")
    options = parser.parse_args(arguments)
    frames = options.frames if options.seconds == float("inf") else 10**9
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder:
        scene = og.load(og.write_bundle(made_room(), Path(folder) / "room.ogpc"))
        start, settled, most, told, number = time.perf_counter(), 0.0, 0.0, 1000, 0
        for number, resident in enumerate(stream(scene, frames, options.points), 1):
            settled, most = (resident, resident) if number <= SETTLED else (settled, max(most, resident))
            seconds = time.perf_counter() - start
            if number == told or seconds > options.seconds:
                print(f"{number:>12,} frames {seconds:>8.0f} s {resident:>8.1f} MB resident", flush=True)
                told *= 10
            if seconds > options.seconds:
                break
    print(f"after {SETTLED:,} frames memory rose by {most - settled:.1f} MB at most, over {number:,} in all")


def stream(scene: og.LabelledScene, frames: int, points: int) -> Iterator[float]:
    """Label ``frames`` frames of up to ``points`` points; yields the resident megabytes of the process after each."""
    random, xyz = np.random.default_rng(0), np.resize(scene.xyz, (points, 3))
    words = scene.vocabulary
    assert words is not None
    vectors, ask = words.vectors, og.Segmenter(scene, list(words.names))
    for number in range(frames):
        if number % 100 == 99:
            ask = og.Segmenter(scene, {f"label {number}": vectors[number % len(vectors)]})
        frame = xyz[: random.integers(0, points + 1)] + random.normal(size=3) * random.choice([0, 0.1, 100])
        if len(frame) and number % 7 == 0:
            frame[random.integers(0, len(frame), 5)] = random.choice([np.nan, np.inf, -1e300])
        if len(ask(frame).labels) != len(frame):
            raise AssertionError("a frame is answered point by point")
        yield resident_mb()


def made_room() -> og.LabelledCloud:
    """500 points in 8 things, with a word for each."""
    from labelled_clouds import make_cloud  # pyright: ignore[reportMissingImports]  (in tests/)

    random, ids = np.random.default_rng(0), np.arange(500) % 8
    xyz = (random.random((8, 3)) * 4)[ids] + 0.2 * random.random((500, 3))
    return make_cloud(xyz, ids, spacing=0.1, reach=0.3, words=tuple(f"thing {k}" for k in range(8)))


def resident_mb() -> float:
    """Resident megabytes of this process; Linux only."""
    with open("/proc/self/statm") as file:  # a Path would fill Python's table of interned strings, 5 MB per million
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


if __name__ == "__main__":
    main()
