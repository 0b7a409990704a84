"""How the time and memory of a fit grow with the points and the views: a table, a CSV, fitted exponents and a plot.

    python examples/benchmark_scaling.py -o out/scaling
    python examples/benchmark_scaling.py --row 100000 60 fast          # one row alone

Each row is a process of its own, after a discarded fit of a tiny scene of the same kind, so that compiled code is
loaded; the fastest of ``--repeats`` runs is kept. The scene is made on the spot: balls in a furnished-sized room whose
walls are in the cloud too, posed 640x480 images of it, and masks that are sometimes missing. Its truth is known, so
error stands beside time: the adjusted Rand index of the instances on those points of balls that some view shows.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.cloud import LabelledCloud
from og_pointcloud.evaluate.metrics import adjusted_rand_index
from og_pointcloud.scene import Camera, Points, Scene, View
from og_pointcloud.settings import FitSettings

Row = TypeVar("Row")

POINTS = (7_000, 30_000, 100_000, 300_000, 1_000_000)
"""Sizes of the cloud, seen by VIEWS_OF_POINTS images."""
VIEWS_OF_POINTS = 60
VIEWS = (20, 60, 150, 300)
"""Numbers of images, of POINTS_OF_VIEWS points."""
POINTS_OF_VIEWS = 100_000
MODES = ("grouping", "fast")
IMAGE = (640, 480)
TINY = {"points": 1_500, "views": 4, "image": (64, 48), "balls": 5}
"""The scene of the discarded fit."""

ROOM_M = np.array([6.0, 5.0, 2.8])
BALL_RADII_M = (0.12, 0.35)
NOISE_M = 0.002
"""Standard deviation of the points about their surfaces."""
MISSING = 0.1
"""Share of the masks that a proposer does not find."""
FEATURE_WIDTH = 512
COMPILE = """
import sys
from benchmark_scaling import warm_up
from og_pointcloud.settings import FitSettings
for mode in sys.argv[1:]:
    warm_up(FitSettings(mode=mode))
"""
PREPARING = ("spacing", "geometry", "visibility")
"""Stages before the mode's own (fit.py)."""


# The scene ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class BallRoom:
    """centres (balls, 3), radii (balls,), metres; world z up, the origin in the middle of the floor."""

    centres: NDArray[np.float64]
    radii: NDArray[np.float64]

    @classmethod
    def make(cls, balls: int, rng: np.random.Generator) -> BallRoom:
        """Balls that do not touch, below the cameras; fewer where there is no room for them."""
        centres, radii = np.zeros((0, 3)), np.zeros(0)
        for _ in range(50 * balls):
            radius = rng.uniform(*BALL_RADII_M)
            centre = rng.uniform((-0.45, -0.45, 0), (0.45, 0.45, 0.35)) * ROOM_M + (0, 0, radius)
            if (np.linalg.norm(centres - centre, axis=1) > radii + radius + 0.05).all():
                centres, radii = np.vstack([centres, centre]), np.append(radii, radius)
            if len(radii) == balls:
                break
        return cls(centres, radii)

    def points(self, count: int, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        """Points (n, 3) spread evenly over all surfaces, and the ball of each, -1 on the room's own."""
        x, y, z = ROOM_M
        walls = np.array([y * z, y * z, x * z, x * z, x * y, x * y])
        area = np.concatenate([walls, 4 * np.pi * self.radii**2])
        surface = rng.choice(len(area), count, p=area / area.sum())
        ball = np.maximum(surface - len(walls), 0)
        outwards = rng.normal(size=(count, 3))
        outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
        xyz = self.centres[ball] + self.radii[ball, None] * outwards
        on_wall = np.flatnonzero(surface < len(walls))
        xyz[on_wall] = rng.uniform(-0.5, 0.5, (len(on_wall), 3)) * ROOM_M + (0, 0, z / 2)
        axis, far = surface[on_wall] // 2, surface[on_wall] % 2
        xyz[on_wall, axis] = (far - 0.5) * ROOM_M[axis] + np.where(axis == 2, z / 2, 0)
        return xyz + NOISE_M * rng.normal(size=xyz.shape), (surface - len(walls)).clip(min=-1).astype(np.int32)

    def look(self, camera: Camera) -> NDArray[np.int32]:
        """(H, W) int32: the ball that each pixel shows, -1 the room. Exact, ball by ball within its bounding box."""
        nearest = np.full((camera.height, camera.width), np.inf)
        shown = np.full((camera.height, camera.width), -1, np.int32)
        pose = camera.world_to_camera
        centres = self.centres @ pose[:3, :3].T + pose[:3, 3]
        for ball, ((x, y, z), radius) in enumerate(zip(centres, self.radii, strict=True)):
            if z < 1.1 * radius:
                continue
            reach = radius / (z - radius)
            left, right = _span(camera.fx, camera.cx, x / z, reach, camera.width)
            top, bottom = _span(camera.fy, camera.cy, y / z, reach, camera.height)
            u = (np.arange(left, right) + 0.5 - camera.cx) / camera.fx
            v = (np.arange(top, bottom)[:, None] + 0.5 - camera.cy) / camera.fy
            square, along = u * u + v * v + 1, u * x + v * y + z
            root = along**2 - square * (x * x + y * y + z * z - radius**2)
            depth = np.where(root > 0, (along - np.sqrt(np.maximum(root, 0))) / square, np.inf)
            window = (slice(top, bottom), slice(left, right))
            shown[window] = np.where(depth < nearest[window], ball, shown[window])
            nearest[window] = np.minimum(nearest[window], depth)
        return shown

    def masks(self, camera: Camera, balls: NDArray[np.int64]) -> NDArray[np.int32]:
        """(H, W) int32: the place in ``balls`` of the ball that a pixel shows, -1 where it is not among them."""
        number = np.full(len(self.radii) + 1, -1, np.int32)
        number[balls] = np.arange(len(balls))
        return number[self.look(camera)]

    def in_view(
        self, camera: Camera, look: NDArray[np.int32], xyz: NDArray[np.float64], ball: NDArray[np.int32]
    ) -> NDArray[np.bool_]:
        """(n,) bool: whether points on balls face the camera, in a pixel of its ``look`` that shows their ball."""
        pose = camera.world_to_camera
        in_camera = xyz @ pose[:3, :3].T + pose[:3, 3]
        facing = ((xyz - self.centres[ball]) * (camera.center - xyz)).sum(axis=1) > 0
        rows = np.flatnonzero(facing & (in_camera[:, 2] > 0))
        column = np.floor(in_camera[rows, 0] / in_camera[rows, 2] * camera.fx + camera.cx)
        row = np.floor(in_camera[rows, 1] / in_camera[rows, 2] * camera.fy + camera.cy)
        inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        rows, column, row = rows[inside], column[inside].astype(int), row[inside].astype(int)
        seen = np.zeros(len(xyz), bool)
        seen[rows] = look[row, column] == ball[rows]
        return seen

    def image(self, camera: Camera) -> NDArray[np.uint8]:
        """(H, W, 3) uint8: what the camera sees, coloured by place and ball."""
        pose = camera.world_to_camera.astype(np.float32)
        u = (np.arange(camera.width, dtype=np.float32) + 0.5 - camera.cx) / camera.fx
        v = (np.arange(camera.height, dtype=np.float32)[:, None] + 0.5 - camera.cy) / camera.fy
        direction = [pose[0, axis] * u + pose[1, axis] * v + pose[2, axis] for axis in range(3)]
        # The eye is inside the room: a ray leaves by the nearest of the three walls that it runs towards.
        middle = np.array([0, 0, ROOM_M[2] / 2])
        with np.errstate(divide="ignore"):
            walls = [
                (middle[axis] + np.copysign(ROOM_M[axis] / 2, along) - camera.center[axis]) / along
                for axis, along in enumerate(direction)
            ]
        depth = np.minimum.reduce(walls)
        place = np.stack([camera.center[axis] + depth * along for axis, along in enumerate(direction)], axis=-1)
        shown = self.look(camera)
        return colours(place.reshape(-1, 3), shown.ravel()).reshape(*shown.shape, 3)


def _span(focal: float, centre: float, at: float, reach: float, size: int) -> tuple[int, int]:
    """Pixels, ends exclusive, that a ball can cover along one axis: at +- reach (1 + |at|) on the plane at depth 1."""
    low, high = at - reach * (1 + abs(at)), at + reach * (1 + abs(at))
    return int(np.clip(focal * low + centre, 0, size)), int(np.clip(focal * high + centre + 1, 0, size))


def colours(xyz: NDArray[np.floating], owner: NDArray[np.int32]) -> NDArray[np.uint8]:
    """(n, 3) uint8: a colour a ball; walls in squares of half a metre, so that images can tell places apart."""
    ball = np.arange(owner.max(initial=-1) + 1)[:, None]
    hues = 60 + 190 * np.modf(0.618 * ball + np.array([0.0, 0.35, 0.6]))[0]
    squares = np.floor(2 * xyz + 0.25).astype(np.int32)
    light = (squares[:, 0] + squares[:, 1] + squares[:, 2]) & 1
    palette = np.concatenate([[[120.0] * 3, [200.0] * 3], hues]).astype(np.uint8)
    return palette[np.where(owner >= 0, owner + 2, light)]


def made_scene(
    points: int, views: int, image: tuple[int, int] = IMAGE, balls: int = 40, seed: int = 0
) -> tuple[Scene, NDArray[np.int32]]:
    """The scene, and the ball that some view shows each point on, -1 none. Masks and images are drawn whenever they
    are read, as those of a capture are decoded."""
    rng = np.random.default_rng(seed)
    room = BallRoom.make(balls, rng)
    xyz, owner = room.points(points, rng)
    on_ball = np.flatnonzero(owner >= 0)
    seen = np.zeros(len(on_ball), bool)
    looks = rng.normal(size=(balls, FEATURE_WIDTH)) / np.sqrt(FEATURE_WIDTH)
    taken = []
    for index in range(views):
        camera = _camera(2 * np.pi * index / views, image, rng)
        look = room.look(camera)
        seen |= room.in_view(camera, look, xyz[on_ball], owner[on_ball])
        pixels = np.bincount(look.ravel() + 1, minlength=balls + 1)[1:]
        shown = np.flatnonzero((pixels > 0) & (rng.random(balls) >= MISSING))
        noise = rng.normal(size=(len(shown), FEATURE_WIDTH)) / np.sqrt(FEATURE_WIDTH)
        features = (looks[shown] + 0.8 * noise).astype(np.float32)
        drawn, pictured = partial(room.masks, camera, shown), partial(room.image, camera)
        taken.append(View(f"view{index}", camera, drawn, features, pictured))
    cloud = Points(xyz.astype(np.float32), np.zeros(3), colours(xyz, owner))
    owner[on_ball[~seen]] = -1
    return Scene(cloud, tuple(taken), "made-balls", "balls"), owner


def _camera(angle: float, image: tuple[int, int], rng: np.random.Generator) -> Camera:
    """A camera at the rim of the room that looks across it, above the balls."""
    around = np.array([np.cos(angle), np.sin(angle), 0])
    eye = 0.42 * ROOM_M * around + (0, 0, rng.uniform(1.9, 2.3))
    forward = -0.3 * ROOM_M * around + (*rng.normal(size=2) * 0.3, 0.5) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0, 0, 1.0))
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = [right, np.cross(forward, right), forward]
    pose[:3, 3] = -pose[:3, :3] @ eye
    width, height = image
    return Camera(width, height, 0.82 * width, 0.82 * width, width / 2, height / 2, pose)


# One row --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ScalingRow:
    """Seconds of the shared stages, of the mode's own, and of the whole fit, and of all cores together: with fewer of
    these than of the whole something else had the machine. grown_mb: peak memory above what the process held before
    the scene was made. agreement: adjusted Rand index on the balls' points that some view shows."""

    points: int
    views: int
    mode: str
    masks: int
    prepare_s: float
    own_s: float
    total_s: float
    cpu_s: float
    peak_mb: float
    grown_mb: float
    agreement: float


def warm_up(settings: FitSettings) -> None:
    """A discarded fit of a tiny scene: compiled code is then loaded, libraries imported."""
    from og_pointcloud.fitting.fit import fit

    short = replace(settings, paper=replace(settings.paper, schedule_share=1e-3))
    fit(made_scene(**TINY)[0], short, progress=False)


def timed_fit(scene: Scene, settings: FitSettings) -> tuple[LabelledCloud, dict[str, float]]:
    """The cloud, and what it took: prepare_s, own_s, total_s and cpu_s of a row."""
    from og_pointcloud.fitting.fit import fit

    start, cpu = time.perf_counter(), time.process_time()
    cloud = fit(scene, settings, progress=False)
    total, cpu = time.perf_counter() - start, time.process_time() - cpu
    stages = cloud.provenance["stages"]
    shared = sum(stage["seconds"] for stage in stages if stage["name"] in PREPARING)
    own = sum(stage["seconds"] for stage in stages) - shared
    return cloud, {"prepare_s": shared, "own_s": own, "total_s": total, "cpu_s": cpu}


def peak_mb() -> float:
    """The most memory that this process ever held, 1e6 bytes. On Linux it begins with the parent's: keep that small."""
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


def measure(points: int, views: int, mode: Any, image: tuple[int, int] = IMAGE) -> ScalingRow:
    """Fit a made scene in this process."""
    settings = FitSettings(mode=mode)
    warm_up(settings)
    before = peak_mb()
    scene, owner = made_scene(points, views, image)
    cloud, seconds = timed_fit(scene, settings)
    peak = peak_mb()
    on_ball = owner >= 0
    agreement = adjusted_rand_index(cloud.instance_ids[on_ball], owner[on_ball])
    masks = sum(view.mask_count for view in scene.views)
    return ScalingRow(points, views, mode, masks, **seconds, peak_mb=peak, grown_mb=peak - before, agreement=agreement)


def in_own_process(script: str, arguments: Sequence[str], threads: int) -> dict[str, Any]:
    """What ``script --row arguments`` prints last, a JSON object. Its messages go to stderr."""
    command = [sys.executable, script, "--row", *arguments]
    result = subprocess.run(command, stdout=subprocess.PIPE, env=_environment(threads), text=True, check=True)
    return json.loads(result.stdout.splitlines()[-1])


def compile_once(modes: Sequence[str], threads: int) -> None:
    """Have all code compiled and stored: a row that had to would hold the compiler's memory."""
    command = [sys.executable, "-c", COMPILE, *modes]
    subprocess.run(command, cwd=Path(__file__).parent, env=_environment(threads), check=True)


def _environment(threads: int) -> dict[str, str]:
    return {**os.environ, "OMP_NUM_THREADS": str(threads), "NUMBA_NUM_THREADS": str(threads)}


# All rows -------------------------------------------------------------------------------------------------------


def exponent(sizes: Iterable[float], values: Iterable[float]) -> float:
    """The slope of values over sizes, both logarithmic, by least squares: 1 is linear."""
    return float(np.polyfit(np.log(list(sizes)), np.log(list(values)), 1)[0])


QUANTITIES: dict[str, tuple[str, Callable[[ScalingRow], float]]] = {
    "prepare": ("grouping", lambda row: row.prepare_s),
    "grouping": ("grouping", lambda row: row.own_s),
    "fast": ("fast", lambda row: row.own_s),
    "prepare+grouping": ("grouping", lambda row: row.total_s),
    "prepare+fast": ("fast", lambda row: row.total_s),
    "memory, grouping": ("grouping", lambda row: row.grown_mb),
    "memory, fast": ("fast", lambda row: row.grown_mb),
}
"""What is fitted and drawn: the mode whose rows count, and their value."""


def series(rows: Sequence[ScalingRow], along: str, name: str) -> tuple[list[int], list[float]]:
    """Sizes, ascending, and values of one quantity ``along`` "points" or "views"."""
    mode, value = QUANTITIES[name]
    fixed = (lambda row: row.views == VIEWS_OF_POINTS) if along == "points" else _of_views
    chosen = sorted((row for row in rows if row.mode == mode and fixed(row)), key=lambda row: getattr(row, along))
    return [getattr(row, along) for row in chosen], [value(row) for row in chosen]


def _of_views(row: ScalingRow) -> bool:
    return row.points == POINTS_OF_VIEWS


def plot(rows: Sequence[ScalingRow], path: Path) -> None:
    """Time above and memory below, over points and over views; the exponents are in the legends."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.ticker import FuncFormatter, NullFormatter

    figure, panels = plt.subplots(2, 2, figsize=(11, 8), sharex="col", sharey="row", layout="constrained")
    colour = {"prepare": "0.45", "grouping": "tab:blue", "fast": "tab:orange"}
    titles = {
        "points": f"{VIEWS_OF_POINTS} views of {IMAGE[0]}x{IMAGE[1]}",
        "views": f"{POINTS_OF_VIEWS:,} points",
    }
    for column, along in enumerate(("points", "views")):
        for name in QUANTITIES:
            sizes, values = series(rows, along, name)
            memory = name.startswith("memory")
            line = "--" if name.startswith("prepare+") else "-"
            label = f"{name.removeprefix('memory, ')}: {along}$^{{{exponent(sizes, values):.2f}}}$"
            shade = next(colour[key] for key in ("grouping", "fast", "prepare") if key in name)
            panels[int(memory), column].loglog(sizes, values, line, marker="o", color=shade, label=label)
        panels[0, column].set_title(titles[along])
        panels[1, column].set_xlabel(along)
        panels[1, column].set_xticks(series(rows, along, "prepare")[0])
        panels[1, column].xaxis.set_major_formatter(FuncFormatter(lambda size, _: f"{size:,.0f}"))
        panels[1, column].xaxis.set_minor_formatter(NullFormatter())
    panels[0, 0].set_ylabel("seconds")
    panels[1, 0].set_ylabel("peak memory of scene and fit, MB")
    for panel in panels.flat:
        panel.grid(which="major", color="0.9")
        panel.legend(fontsize=8)
    for panel in panels[:, 0]:
        panel.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    figure.savefig(path, dpi=120)


def write_rows(path: Path, rows: Sequence[Any]) -> None:
    """Rows of one dataclass as CSV."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(rows[0])])
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)


def print_row(row: ScalingRow) -> None:
    """One line of the table."""
    print(
        f"{row.points:>9,} {row.views:>5} {row.masks:>6}  {row.mode:<8} {row.prepare_s:9.2f} {row.own_s:7.2f} "
        f"{row.total_s:7.2f} {row.cpu_s:7.2f} {row.peak_mb:8.0f} {row.grown_mb:8.0f} {row.agreement:10.4f}",
        flush=True,
    )


def main() -> None:
    """Measure all rows, or one; write table, exponents and plot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/scaling"), help="folder for CSV and PNG")
    parser.add_argument("--repeats", type=int, default=1, help="runs of each row; the fastest is kept")
    parser.add_argument("--threads", type=int, default=2, help="threads of each fit")
    parser.add_argument("--row", nargs=3, metavar=("POINTS", "VIEWS", "MODE"), help="measure this alone, print JSON")
    arguments = parser.parse_args()
    if arguments.row:
        points, views, mode = arguments.row
        print(json.dumps(asdict(measure(int(points), int(views), mode))))
        return
    sizes = dict.fromkeys([*((n, VIEWS_OF_POINTS) for n in POINTS), *((POINTS_OF_VIEWS, n) for n in VIEWS)])
    print("   points views  masks  mode     prepare s   own s total s   cpu s  peak MB grown MB  agreement")
    compile_once(MODES, arguments.threads)
    rows = []
    for points, views in sizes:
        for mode in MODES:
            row_arguments = (str(points), str(views), mode)
            runs = [in_own_process(__file__, row_arguments, arguments.threads) for _ in range(arguments.repeats)]
            rows.append(ScalingRow(**min(runs, key=lambda run: run["total_s"])))
            print_row(rows[-1])
    arguments.output.mkdir(parents=True, exist_ok=True)
    write_rows(arguments.output / "scaling.csv", rows)
    plot(rows, arguments.output / "scaling.png")
    print("\nexponents             points  last two    views  last two")
    for name in QUANTITIES:
        both = [series(rows, along, name) for along in ("points", "views")]
        slopes = [exponent(sizes[first:], values[first:]) for sizes, values in both for first in (0, -2)]
        print(f"{name:<20} {slopes[0]:7.2f} {slopes[1]:9.2f} {slopes[2]:8.2f} {slopes[3]:9.2f}")


if __name__ == "__main__":
    main()
