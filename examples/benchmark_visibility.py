"""Seconds per view of the visibility kernel, beside its largest error against float64, in one table.

    python examples/benchmark_visibility.py

The scene is a box of points around the camera's target, all of it in view; every image is covered by 30 masks.
"""

import sys
import time
from pathlib import Path

import numpy as np

from og_pointcloud.scene import Camera
from og_pointcloud.visibility import Gaussians, view_weights

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))


def box(count: int, rng: np.random.Generator) -> Gaussians:
    """Points on the walls of a room that fill the view, drawn half a spacing large and 0.7 opaque."""
    xyz = rng.uniform(-1, 1, (count, 3)) * [1.33, 1.0, 1.0]
    wall = rng.integers(0, 5, count)
    axis = np.array([0, 0, 1, 1, 2])[wall]
    xyz[np.arange(count), axis] = np.array([-1.33, 1.33, -1.0, 1.0, 1.0])[wall]
    xyz[:, 2] += 1.6
    spacing = np.sqrt(14.0 / count)
    rotation = np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1))
    scale = np.full((count, 3), 0.5 * spacing, np.float32)
    return Gaussians(xyz.astype(np.float32), scale, rotation, np.full(count, 0.7, np.float32))


def camera(width: int, height: int) -> Camera:
    """A camera at the open side of the box, looking in."""
    return Camera(width, height, 0.55 * width, 0.55 * width, width / 2, height / 2, np.eye(4))


def masks(width: int, height: int) -> np.ndarray:
    """30 rectangles with gaps between them."""
    column, row = np.meshgrid(np.arange(width) * 6 // width, np.arange(height) * 5 // height)
    ids = (row * 6 + column).astype(np.int32)
    ids[:: height // 5] = -1
    return ids


def main() -> None:
    """Print the table: error on a small scene against the literal reference, then time on large ones."""
    from reference_splatting import reference_view_weights  # pyright: ignore[reportMissingImports]  (in tests/)

    rng = np.random.default_rng(0)
    small, view = box(2_000, rng), camera(96, 72)
    fast = view_weights(small, view, masks(96, 72), 30, 0.01).rows.toarray()
    slow = reference_view_weights(small, view, masks(96, 72), 30, 0.01)
    error = np.abs(fast - slow).max() / slow.max()
    print("points      image       seconds a view   largest weight error against float64 (2,000 points, relative)")
    for count, width, height in ((100_000, 640, 480), (1_000_000, 1000, 730)):
        gaussians, view, ids = box(count, rng), camera(width, height), masks(width, height)
        view_weights(gaussians, view, ids, 30, 0.01)
        seconds = []
        for _ in range(7):
            start = time.perf_counter()
            view_weights(gaussians, view, ids, 30, 0.01)
            seconds.append(time.perf_counter() - start)
        print(f"{count:<11,} {width}x{height:<9} {np.median(seconds):.3f} (best {min(seconds):.3f})   {error:.1e}")


if __name__ == "__main__":
    main()
