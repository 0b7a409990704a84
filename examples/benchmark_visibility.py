"""Error and time of the visibility kernel, of the settings that trade one for the other, and the memory of a long fit.

    python examples/benchmark_visibility.py [CAPTURE] [--against CHECKOUT]    # seconds a view and error, in one table
    python examples/benchmark_visibility.py CAPTURE --settings                # scores of fits with other settings
    python examples/benchmark_visibility.py --memory 300 [--budget 4GB]       # a million Gaussians in 300 views

Seconds are those of one core, the fastest of several runs: a fit works on as many views at once as there are cores.
With ``--against`` another checkout of the project is measured in turn with this one, on the same arrays. Errors are
those of a window of the image in which a literal float64 reference (tests/reference_splatting.py) can be afforded.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.fitting.mask_table import Gaussians, ViewWeights, view_weights
from og_pointcloud.scene import Camera, Points, Scene

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

NEAR = 0.01
WINDOW = (64, 48)
"""Pixels that the literal reference draws."""
ROUNDS, RUNS = 3, 5
"""Processes per checkout, in turn, and runs of each case in each of them."""
CUTOFFS = {
    "3DGS: alpha 1/255, light 1e-4": (1 / 255, 1e-4),
    "alpha 1/64": (1 / 64, 1e-4),
    "light 1e-2": (1 / 255, 1e-2),
    "alpha 1/32, light 1e-2": (1 / 32, 1e-2),
}


@dataclass(frozen=True)
class Case:
    """A view to draw: thickness (n,) or None as for `view_weights`, ids (H, W) with mask_count masks."""

    name: str
    gaussians: Gaussians
    camera: Camera
    ids: NDArray[np.int32]
    mask_count: int
    near: float
    thickness: NDArray[np.float32] | None = None

    @property
    def arguments(self) -> tuple[Gaussians, Camera, NDArray[np.int32], int, float, NDArray[np.float32] | None]:
        """Of `view_weights`."""
        return self.gaussians, self.camera, self.ids, self.mask_count, self.near, self.thickness


# Scenes ----------------------------------------------------------------------------------------------------------


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


def masks(width: int, height: int) -> NDArray[np.int32]:
    """30 rectangles with gaps between them."""
    column, row = np.meshgrid(np.arange(width) * 6 // width, np.arange(height) * 5 // height)
    ids = (row * 6 + column).astype(np.int32)
    ids[:: height // 5] = -1
    return ids


def box_case(count: int, width: int, height: int) -> Case:
    """The box of so many points, seen by one camera."""
    gaussians = box(count, np.random.default_rng(0))
    return Case(f"box, {count:,}", gaussians, camera(width, height), masks(width, height), 30, NEAR)


def capture_case(folder: Path) -> Case:
    """The middle view of a capture, as `fit` draws it."""
    from og_pointcloud.fitting.fit import prepare
    from og_pointcloud.formats.capture import read_capture
    from og_pointcloud.rendering.geometry import thinned

    scene = read_capture(folder)
    middle = scene.views[len(scene.views) // 2]
    few = replace(scene, views=scene.views[:: max(1, len(scene.views) // 10)])
    prepared = prepare(few)
    view = thinned(middle, prepared.stride)
    thickness = (6 * prepared.neighbourhood.spacing).astype(np.float32)
    name = f"{folder.name}, {len(scene.points):,}"
    return Case(name, prepared.gaussians, view.camera, view.mask_map(), view.mask_count, prepared.near, thickness)


def window_of(case: Case) -> Case:
    """The middle of a view, without the Gaussians that are far from it in the image."""
    width, height = (min(size, whole) for size, whole in zip(WINDOW, case.ids.shape[::-1], strict=True))
    left, top = (case.camera.width - width) // 2, (case.camera.height - height) // 2
    view = replace(
        case.camera, width=width, height=height, cx=case.camera.cx - left, cy=case.camera.cy - top
    )  # fmt: skip
    x, y, z = (case.gaussians.xyz @ view.world_to_camera[:3, :3].T + view.world_to_camera[:3, 3]).T
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = view.fx * x / z + view.cx, view.fy * y / z + view.cy
        room = 4 * view.fx * case.gaussians.scale.max(axis=1) / z + 4
    close = (z > case.near) & (u > -room) & (u < width + room) & (v > -room) & (v < height + room)
    few = Gaussians(*(getattr(case.gaussians, name)[close] for name in ("xyz", "scale", "rotation", "opacity")))
    ids = np.ascontiguousarray(case.ids[top : top + height, left : left + width])
    return replace(case, gaussians=few, camera=view, ids=ids, thickness=None)


# Time and error --------------------------------------------------------------------------------------------------


def errors(window: Case, reference: NDArray[np.float64]) -> tuple[float, float]:
    """Largest and mean error of a window's weights, as parts of the largest and the mean weight."""
    error = np.abs(view_weights(*window.arguments).rows.toarray() - reference)
    return float(error.max() / reference.max()), float(error.sum() / reference.sum())


def write_case(case: Case, path: Path) -> None:
    """A case for another process."""
    thickness = np.full(len(case.gaussians), np.inf, np.float32) if case.thickness is None else case.thickness
    view = case.camera
    numbers = np.array([view.width, view.height, view.fx, view.fy, view.cx, view.cy, case.mask_count, case.near])
    np.savez(
        path, **vars(case.gaussians), pose=view.world_to_camera, ids=case.ids, numbers=numbers, thickness=thickness
    )


def seconds_of(path: Path) -> float:
    """Seconds of a core for one view."""
    with np.load(path) as file:
        arrays = dict(file)
    width, height, fx, fy, cx, cy, mask_count, near = arrays["numbers"].tolist()
    view = Camera(int(width), int(height), fx, fy, cx, cy, arrays["pose"])
    gaussians = Gaussians(*(arrays[name] for name in ("xyz", "scale", "rotation", "opacity")))
    return fastest(lambda: view_weights(gaussians, view, arrays["ids"], int(mask_count), near, arrays["thickness"]))[0]


def fastest(work: Callable[[], ViewWeights]) -> tuple[float, ViewWeights]:
    """Seconds of this process' cores, the least of RUNS after a discarded one; and the result."""
    result, taken = work(), []
    for _ in range(RUNS):
        start = time.process_time()
        result = work()
        taken.append(time.process_time() - start)
    return min(taken), result


def seconds_in(checkout: Path, paths: list[Path]) -> list[float]:
    """`seconds_of` each case with the code of a checkout, in a process of its own with one thread."""
    environment = {**os.environ, "PYTHONPATH": str(checkout), "NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, __file__, "--measure", str(checkout), *map(str, paths)]
    result = subprocess.run(command, stdout=subprocess.PIPE, env=environment, text=True, check=True)
    return json.loads(result.stdout.splitlines()[-1])


def print_kernel(cases: list[Case], against: Path | None) -> None:
    """A row a case: seconds, error against float64, and the other checkout's seconds beside them."""
    from reference_splatting import reference_view_weights  # pyright: ignore[reportMissingImports]  (in tests/)

    here = Path(__file__).resolve().parents[1]
    checkouts = [here] if against is None else [against.resolve(), here]
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / f"{index}.npz" for index in range(len(cases))]
        for case, path in zip(cases, paths, strict=True):
            write_case(case, path)
        runs = [[seconds_in(checkout, paths) for checkout in checkouts] for _ in range(ROUNDS)]
    least = np.min(runs, axis=0)
    other = f"{'other':>8} {'ratio':>6} " if against else ""
    print(f"{'scene':<26} {'image':<10} {'s a view':>8} {other} largest error  mean error (of a window, relative)")
    for index, case in enumerate(cases):
        window = window_of(case)
        reference = reference_view_weights(window.gaussians, window.camera, window.ids, window.mask_count, window.near)
        largest, mean = errors(window, reference)
        ours = least[-1][index]
        compared = f"{least[0][index]:8.4f} {least[0][index] / ours:6.2f} " if against else ""
        size = f"{case.camera.width}x{case.camera.height}"
        print(f"{case.name:<26} {size:<10} {ours:8.4f} {compared} {largest:13.1e} {mean:11.1e}", flush=True)


def print_cutoffs(cases: list[Case]) -> None:
    """Weight that is lost and time that is won by leaving more out than 3DGS does; errors of whole images."""
    from og_pointcloud.fitting.mask_table import Cutoffs  # which another checkout may lack

    print(f"\n{'cut-offs':<30} {'scene':<26} {'s a view':>8} {'weight lost':>12} {'largest error, pixels':>22}")
    for case in cases:
        exact = None
        for name, (alpha, light) in CUTOFFS.items():
            cutoffs = Cutoffs(alpha, light)
            seconds, shown = fastest(lambda: view_weights(*case.arguments, cutoffs=cutoffs))  # noqa: B023
            exact = shown.rows if exact is None else exact
            lost = 1 - shown.rows.sum(dtype=np.float64) / exact.sum(dtype=np.float64)
            largest = abs(shown.rows - exact).max()
            print(f"{name:<30} {case.name:<26} {seconds:8.4f} {lost:12.2e} {largest:22.2e}", flush=True)


# Settings of the fit -----------------------------------------------------------------------------------------------


def print_settings(folder: Path) -> None:
    """Scores of a capture's fits with other settings, beside the seconds of its visibility and of all of it."""
    from score_captures import score_of  # pyright: ignore[reportMissingImports]

    import og_pointcloud as og
    from og_pointcloud.settings import VisibilitySettings

    choices = {
        "default": VisibilitySettings(),
        "alpha 1/64": VisibilitySettings(alpha_min=1 / 64),
        "alpha 1/32, light 1e-2": VisibilitySettings(alpha_min=1 / 32, transmittance_min=1e-2),
        **{f"{enough} views are enough": VisibilitySettings(enough_views=enough) for enough in (20, 10, 5)},
    }
    scene = og.read_capture(folder)
    og.fit(replace(scene, views=scene.views[:2]), progress=False)  # compiled code is loaded
    print(f"{folder.name:<26} {'mIoU':>7} {'background':>10} {'views':>6} {'visibility s':>12} {'fit s':>7}")
    for name, visibility in choices.items():
        start = time.perf_counter()
        cloud = og.fit(scene, og.FitSettings(visibility=visibility), progress=False)
        taken = time.perf_counter() - start
        with tempfile.TemporaryDirectory() as temporary:
            og.write_bundle(cloud, Path(temporary) / "scene.ogpc")
            labels = og.segment(
                og.load(Path(temporary) / "scene.ogpc"), None, text_features=folder / "text_features.npz"
            )
        score = score_of(labels.labels, labels.names, folder)
        called = "-" if score.background_called is None else f"{score.background_called:.4f}"
        stages = cloud.provenance["stages"]
        seconds = sum(stage["seconds"] for stage in stages if stage["name"] == "visibility")
        views = cloud.provenance["notes"]["table"]["views"]
        print(f"{name:<26} {score.miou:7.4f} {called:>10} {views:6} {seconds:12.2f} {taken:7.2f}", flush=True)


# Memory ------------------------------------------------------------------------------------------------------------


def status_mb(field: str) -> float:
    """A line of /proc/self/status in 1e6 bytes."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(1024 * int(line.split()[1]) / 1e6 for line in lines if line.startswith(f"{field}:"))


def gaussian_room(points: int, views: int, size: tuple[int, int]) -> Scene:
    """The made scene of benchmark_scaling.py as Gaussians, 0.6 spacings large and 0.8 opaque."""
    from benchmark_scaling import ROOM_M, made_scene  # pyright: ignore[reportMissingImports]

    scene, _ = made_scene(points, views, size)
    x, y, z = ROOM_M
    spacing = np.sqrt(2.2 * (x * y + y * z + x * z) / points)  # a tenth for the balls
    rotation = np.tile(np.array([1, 0, 0, 0], np.float32), (points, 1))
    scale = np.full((points, 3), 0.6 * spacing, np.float32)
    cloud = Points(
        scene.points.xyz, scene.points.origin, scene.points.rgb, None, scale, rotation, np.full(points, 0.8, np.float32)
    )
    return replace(scene, points=cloud)


@contextmanager
def stages_with_peaks() -> Iterator[None]:
    """Print each stage of a fit with the most memory held during it."""
    from og_pointcloud.journal import Journal

    plain = Journal.stage

    @contextmanager
    def stage(journal: Journal, name: str) -> Iterator[None]:
        Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
        start = time.perf_counter()
        with plain(journal, name):
            yield
        peak, anonymous, mapped = status_mb("VmHWM"), status_mb("RssAnon"), status_mb("RssFile")
        peaks.append(peak)
        print(f"{name:<12} {time.perf_counter() - start:8.1f} {peak:9.0f} {anonymous:9.0f} {mapped:9.0f}", flush=True)

    peaks: list[float] = []
    Journal.stage = stage  # type: ignore[method-assign]
    try:
        yield
    finally:
        Journal.stage = plain  # type: ignore[method-assign]
        print(f"peak of all stages: {max(peaks, default=0):.0f} MB")


def print_memory(points: int, views: int, size: tuple[int, int], budget: str | None) -> None:
    """Fit a made scene; seconds and peak memory stage by stage."""
    from benchmark_scaling import warm_up  # pyright: ignore[reportMissingImports]

    from og_pointcloud.fitting.fit import fit
    from og_pointcloud.fitting.memory import parse_memory
    from og_pointcloud.settings import FitSettings

    settings = FitSettings(mode="grouping", memory=parse_memory(budget) if budget else None)
    warm_up(settings)
    scene = gaussian_room(points, views, size)
    print(f"{points:,} Gaussians, {views} views of {size[0]}x{size[1]}, memory {budget or 'half of what is free'}")
    print("stage               s   peak MB  held: MB  mapped MB")
    start = time.perf_counter()
    with stages_with_peaks():
        cloud = fit(scene, settings, progress=False)
    print(f"{time.perf_counter() - start:.1f} s, table {cloud.provenance['notes']['table']}")


def main() -> None:
    """Print the table that was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", nargs="?", type=Path, help="a capture folder, as a case of its own")
    parser.add_argument("--against", type=Path, metavar="CHECKOUT", help="another checkout, measured in the same run")
    parser.add_argument("--settings", action="store_true", help="fit the capture with other settings")
    parser.add_argument("--memory", type=int, metavar="VIEWS", help="fit a made scene of so many views")
    parser.add_argument("--points", type=int, default=1_000_000, help="Gaussians of that scene (default: %(default)s)")
    parser.add_argument("--size", type=int, nargs=2, default=(1000, 730), help="its images (default: 1000 730)")
    parser.add_argument("--budget", help="memory of that fit, as of `fit --memory`")
    parser.add_argument("--measure", nargs="+", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        import og_pointcloud

        checkout, *paths = map(Path, arguments.measure)
        assert checkout in Path(og_pointcloud.__file__).parents, f"{og_pointcloud.__file__} is not of {checkout}"
        print(json.dumps([seconds_of(path) for path in paths]))
    elif arguments.memory:
        print_memory(arguments.points, arguments.memory, tuple(arguments.size), arguments.budget)
    elif arguments.settings:
        print_settings(arguments.capture)
    else:
        cases = [box_case(100_000, 640, 480), box_case(1_000_000, 1000, 730)]
        cases += [capture_case(arguments.capture)] if arguments.capture else []
        print_kernel(cases, arguments.against)
        print_cutoffs(cases)


if __name__ == "__main__":
    main()
