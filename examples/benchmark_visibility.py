"""The blending kernel: seconds per view on one core, and error against float64, in the same row.

    python examples/benchmark_visibility.py              # made rooms of 10,000 to a million Gaussians
    python examples/benchmark_visibility.py CAPTURE      # also the middle view of a capture, as `fit` draws it

Errors are measured in a window small enough for a literal float64 reference (tests/reference_splatting.py), relative to
the largest and to the mean weight. `make bench` compares two revisions.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

if __name__ == "__main__":  # otherwise tests that import it would run on one core too
    os.environ["NUMBA_NUM_THREADS"] = "1"  # a fit works on one view per core

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from og_pointcloud.rendering.splatting import Gaussians, view_weights
from og_pointcloud.scene import Camera

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

NEAR = 0.01
IMAGE = (640, 480)
SIZES = (10_000, 100_000, 300_000, 1_000_000)
WINDOW = (64, 48)
"""Pixels that the literal reference draws."""
RUNS = 5


@dataclass(frozen=True)
class Case:
    """A view to draw."""

    name: str
    gaussians: Gaussians
    camera: Camera
    near: float

    def draw(self) -> csr_array:
        """The kernel's result."""
        return view_weights(self.gaussians, self.camera, self.near)


def room_case(count: int, width: int = IMAGE[0], height: int = IMAGE[1]) -> Case:
    """Points on the walls of a room that fill the view, half a spacing large and 0.7 opaque."""
    rng = np.random.default_rng(0)
    xyz = rng.uniform(-1, 1, (count, 3)) * [1.33, 1.0, 1.0]
    wall = rng.integers(0, 5, count)
    xyz[np.arange(count), np.array([0, 0, 1, 1, 2])[wall]] = np.array([-1.33, 1.33, -1.0, 1.0, 1.0])[wall]
    xyz[:, 2] += 1.6
    scale = np.full((count, 3), 0.5 * np.sqrt(14.0 / count), np.float32)
    rotation = np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1))
    gaussians = Gaussians(xyz.astype(np.float32), scale, rotation, np.full(count, 0.7, np.float32))
    camera = Camera(width, height, 0.55 * width, 0.55 * width, width / 2, height / 2, np.eye(4))
    return Case(f"room, {count:,}", gaussians, camera, NEAR)


def capture_case(folder: Path) -> Case:
    """The middle view of a capture, as `fit` draws it."""
    from og_pointcloud.fitting.fit import prepare
    from og_pointcloud.formats.capture import read_capture

    scene = read_capture(folder)
    middle = scene.views[len(scene.views) // 2]
    surface = prepare(replace(scene, views=scene.views[:: max(1, len(scene.views) // 10)])).surface
    return Case(f"{folder.name}, {len(scene.points):,}", surface.gaussians, middle.camera, surface.near)


def window_of(case: Case) -> Case:
    """The middle of a view, without Gaussians far from it in the image."""
    camera = case.camera
    width, height = min(WINDOW[0], camera.width), min(WINDOW[1], camera.height)
    left, top = (camera.width - width) // 2, (camera.height - height) // 2
    view = replace(camera, width=width, height=height, cx=camera.cx - left, cy=camera.cy - top)
    x, y, z = (case.gaussians.xyz @ view.world_to_camera[:3, :3].T + view.world_to_camera[:3, 3]).T
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = view.fx * x / z + view.cx, view.fy * y / z + view.cy
        room = 4 * view.fx * case.gaussians.scale.max(axis=1) / z + 4
    close = (z > case.near) & (u > -room) & (u < width + room) & (v > -room) & (v < height + room)
    few = Gaussians(*(getattr(case.gaussians, name)[close] for name in ("xyz", "scale", "rotation", "opacity")))
    return replace(case, gaussians=few, camera=view)


def reference_of(window: Case) -> NDArray[np.float64]:
    """(pixels, n) float64, by the literal reference."""
    from reference_splatting import reference_pixel_weights  # pyright: ignore[reportMissingImports]  (in tests/)

    weights = reference_pixel_weights(window.gaussians, window.camera, window.near)
    return weights.reshape(-1, len(window.gaussians))


def errors(window: Case) -> tuple[float, float]:
    """Largest and mean error of a window's weights, relative to the largest and the mean weight."""
    reference = reference_of(window)
    error = np.abs(window.draw().toarray() - reference)
    return float(error.max() / reference.max()), float(error.sum() / reference.sum())


def fastest(work: Callable[[], csr_array]) -> float:
    """Processor seconds, the least of several runs after a discarded one."""
    taken = []
    for _ in range(RUNS + 1):
        start = time.process_time()
        work()
        taken.append(time.process_time() - start)
    return min(taken[1:])


def print_kernel(cases: Sequence[Case]) -> None:
    """Print a row per case."""
    print(f"{'scene':<26} {'image':<10} {'s a view':>8} {'Gaussians/s':>12}  largest error  mean error")
    for case in cases:
        seconds = fastest(case.draw)
        largest, mean = errors(window_of(case))
        size = f"{case.camera.width}x{case.camera.height}"
        rate = len(case.gaussians) / seconds
        print(f"{case.name:<26} {size:<10} {seconds:8.4f} {rate:12.3g} {largest:14.1e} {mean:11.1e}", flush=True)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path, nargs="?")
    parser.add_argument("--points", type=int, nargs="+", default=SIZES, help="Gaussians of the made rooms")
    options = parser.parse_args(arguments)
    cases = [room_case(count) for count in options.points]
    cases += [capture_case(options.capture)] if options.capture else []
    print_kernel(cases)


if __name__ == "__main__":
    main()
