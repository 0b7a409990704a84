"""Maps that grow and places that change: error beside time, in the same row.

    python examples/benchmark_maps.py frames CAPTURE          # each tenth: ms per frame, mIoU beside a fit of the same
    python examples/benchmark_maps.py frames CAPTURE --shuffle --pose-noise 0.01 0.2 --depth-share 0.05
    python examples/benchmark_maps.py frames CAPTURE --every 4 --tenths 1     # a quarter of the frames, the end alone
    python examples/benchmark_maps.py speed CAPTURE               # ms per frame at 100,000 and 1,000,000 points
    python examples/benchmark_maps.py loops CAPTURE --depth-noise 0.002   # memory over loops of the same path
    python examples/benchmark_maps.py pairs FOLDER...             # a/ and b/ with changes.json, two visits each
    python examples/benchmark_maps.py pairs FOLDER... --sparse 5000   # the same, sparse as from structure from motion
    python examples/benchmark_maps.py days SEED...                # demo rooms: a map that goes on growing the next day

A capture has gt.npz for its scores; the map is made from its depth images, if it has any, else its own cloud is given.
The map is compared with fits of the same frames: with the capture's own points, and with those that `og-pointcloud
fuse` makes from the map's depth images. All three are scored at the capture's own points, each labelled like its
nearest one. Times are of `integrate` alone, without the models'; CPU milliseconds are given too, as other programs slow
the wall clock. A pair is scored by SuperMap's definitions: IoU above 0.1, centroid within 0.3 m.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from map_scores import NEAR_M, PairScore, score_pair
from scipy.spatial import cKDTree

import og_pointcloud as og
from og_pointcloud.evaluate.truth import read_truth
from og_pointcloud.formats.capture import depth_files, read_capture, read_poses
from og_pointcloud.formats.depth import DepthFrame, resampled
from og_pointcloud.formats.fusion import fuse
from og_pointcloud.formats.poses import in_local_frame, rotation_of_vector
from og_pointcloud.mapping.sight import depth_views
from og_pointcloud.scene import Camera, Points, Scene

TENTHS, WARM_UP, LOOPS = 10, 5, 4
SIZES = 100_000, 1_000_000
TEXTURED, FALLS_OFF_M = 60, 0.35
"""Textured places of a room, where structure from motion finds points, and the distance at which it finds a third."""
OFF_M, STRAY, STRAY_M = 0.008, 0.01, 0.3
"""Noise of its points; share of strays, and how far off these are."""
SPARSE_POSES = 0.005, 0.1
"""Noise of its poses: meters, degrees."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one of the five."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("frames", "speed", "loops", "pairs", "days"))
    parser.add_argument("folders", type=Path, nargs="+", metavar="FOLDER")
    parser.add_argument("--shuffle", action="store_true", help="frames in random order")
    parser.add_argument("--pose-noise", type=float, nargs=2, default=(0, 0), metavar=("M", "DEG"))
    parser.add_argument("--depth-share", type=float, default=1.0, metavar="X", help="of the readings that are kept")
    parser.add_argument("--depth-noise", type=float, default=0.0, metavar="X", help="of loops: times depth squared")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="take each N-th frame")
    parser.add_argument("--tenths", type=int, default=TENTHS, metavar="N", help="rows of the table")
    parser.add_argument("--no-fit", action="store_true", help="without the fits of the same frames")
    parser.add_argument("--sparse", type=int, default=0, metavar="N", help="pairs of N uneven points, without depth")
    options = parser.parse_args(arguments)
    if options.what == "pairs":
        pairs(options.folders, options.sparse)
        return
    if options.what == "days":
        days(options.folders)
        return
    for folder in options.folders:
        {"frames": growing, "speed": speed, "loops": loops}[options.what](folder, options)


def frames_of(folder: Path, options: argparse.Namespace) -> tuple[Scene, list[og.Frame]]:
    """A capture and its views as frames, thinned and disturbed by the options."""
    capture, random = read_capture(folder), np.random.default_rng(0)
    capture = replace(capture, views=capture.views[:: options.every])
    depths = depth_files(folder, read_poses(folder))
    frames = []
    for number, view in enumerate(capture.views):
        camera = in_local_frame(view.camera, -capture.points.origin)
        depth = depths[view.name].read().depth if view.name in depths else None
        camera = _moved(camera, random, *options.pose_noise)
        if depth is not None and options.depth_share < 1:
            depth = np.where(random.random(depth.shape) < options.depth_share, depth, 0)
        masks, rgb = view.mask_map(), view.image_rgb()
        frames.append(og.Frame(camera, masks, view.mask_features, depth, rgb=rgb, stamp=float(number)))
    if options.shuffle:
        frames = [frames[k] for k in random.permutation(len(frames))]
    return capture, frames


def _moved(camera: Camera, random: np.random.Generator, meters: float, degrees: float) -> Camera:
    turn = rotation_of_vector(random.normal(size=3) * np.deg2rad(degrees) / np.sqrt(3))
    pose = camera.world_to_camera.copy()
    pose[:3] = turn @ pose[:3]
    pose[:3, 3] += random.normal(size=3) * meters / np.sqrt(3)
    return replace(camera, world_to_camera=pose)


def mapper_of(capture: Scene, frames: list[og.Frame]) -> og.Mapper:
    """A mapper with the capture's own cloud, or an empty one if frames have depth."""
    if all(frame.depth is not None for frame in frames):
        return og.Mapper(feature_space=capture.feature_space)
    return og.Mapper(cloud=capture.points, feature_space=capture.feature_space)


def miou(cloud: og.LabelledCloud, folder: Path, xyz: np.ndarray) -> float:
    """mIoU at the capture's own points, each labelled like the cloud's nearest one."""
    result = og.segment(cloud, text_features=folder / "text_features.npz")
    labels = result.labels
    if len(cloud) != len(xyz):
        labels = labels[cKDTree(cloud.xyz_world).query(xyz, workers=-1)[1]]
    truth = read_truth(folder)
    return truth.score(truth.class_of(labels, result.names)).miou


def with_fused_points(capture: Scene, folder: Path) -> Scene:
    """The same views, with the points that `og-pointcloud fuse` makes of their depth images."""
    files, origin = depth_files(folder, read_poses(folder)), capture.points.origin
    frames = []
    for view in capture.views:
        rgb = view.image_rgb()
        colors = None if rgb is None else partial(resampled, rgb, view.camera)
        frames.append(DepthFrame(view.name, files[view.name], colors))
    points = fuse(frames).points
    return replace(capture, points=Points((points.xyz_world - origin).astype(np.float32), origin, points.rgb))


def growing(folder: Path, options: argparse.Namespace) -> None:
    """Print a row for each tenth of the frames."""
    capture, frames = frames_of(folder, options)
    mapper, xyz = mapper_of(capture, frames), capture.points.xyz_world
    print(f"\n{folder.name}: {len(frames)} frames, {len(capture.points):,} points in the capture")
    print("mIoU of the map; of fits of the same frames, with the capture's own points and with those fused from depth")
    print("frames    points  objects  median ms  p95 ms  CPU ms  kept MB     map     fit   fused   map s   fit s")
    done = 0
    for tenth in range(1, options.tenths + 1):
        until, start = round(len(frames) * tenth / options.tenths), time.process_time()
        wall = [mapper.integrate(frame).seconds for frame in frames[done:until]]
        spent, done = (time.process_time() - start) / max(len(wall), 1), until
        if not wall:
            continue
        begun = time.perf_counter()
        own = miou(mapper.snapshot().cloud, folder, xyz)
        labelled = time.perf_counter() - begun
        batch, fused, seconds = float("nan"), float("nan"), float("nan")
        if not options.no_fit:
            begun = time.perf_counter()
            stamps = {frame.stamp for frame in frames[:until]}
            views = tuple(view for number, view in enumerate(capture.views) if number in stamps)
            same = replace(capture, views=views)
            batch, seconds = miou(og.fit(same, progress=False), folder, xyz), time.perf_counter() - begun
            if all(frame.depth is not None for frame in frames):
                fused = miou(og.fit(with_fused_points(same, folder), progress=False), folder, xyz)
        print(
            f"{done:6}  {mapper.points:8,}  {len(mapper.objects()):7}  {1e3 * np.median(wall):9.1f}  "
            f"{1e3 * np.percentile(wall, 95):6.1f}  {1e3 * spent:6.1f}  {mapper.nbytes / 1e6:7.1f}  {own:6.4f}  "
            f"{batch:6.4f}  {fused:6.4f}  {labelled:6.1f}  {seconds:6.1f}",
            flush=True,
        )


def speed(folder: Path, options: argparse.Namespace) -> None:
    """Milliseconds per frame in maps of SIZES points, which lie between the capture's points and their neighbors."""
    capture, frames = frames_of(folder, options)
    xyz, random = capture.points.xyz_world, np.random.default_rng(0)
    near = np.asarray(cKDTree(xyz).query(xyz, k=5, workers=-1)[1])
    print(f"\n{folder.name}: {len(frames)} frames\n   points  objects  median ms  p95 ms  CPU ms")
    for size in SIZES:
        first, other = near[random.integers(0, len(xyz), size)][:, [0, random.integers(1, 5)]].T
        cloud = xyz[first] + random.random((size, 1)) * (xyz[other] - xyz[first])
        mapper = og.Mapper(cloud=cloud, feature_space=capture.feature_space)
        for frame in frames[:WARM_UP]:
            mapper.integrate(frame)
        start = time.process_time()
        wall = [mapper.integrate(frame).seconds for frame in frames[WARM_UP:]]
        spent = (time.process_time() - start) / len(wall)
        print(
            f"{size:9,}  {len(mapper.objects()):7}  {1e3 * np.median(wall):9.1f}  "
            f"{1e3 * np.percentile(wall, 95):6.1f}  {1e3 * spent:6.1f}",
            flush=True,
        )


def loops(folder: Path, options: argparse.Namespace) -> None:
    """Memory after each of LOOPS loops of the same path, each with its own depth noise."""
    capture, frames = frames_of(folder, options)
    mapper, random = mapper_of(capture, frames), np.random.default_rng(0)
    for loop in range(LOOPS):
        for frame in frames:
            depth = frame.depth
            if depth is not None and options.depth_noise:
                depth = (depth + random.normal(size=depth.shape) * options.depth_noise * depth**2).astype(np.float32)
            mapper.integrate(replace(frame, depth=depth, stamp=frame.stamp + loop * len(frames)))  # pyright: ignore
        print(f"{folder.name} loop {loop + 1}: {mapper.points:,} points, {mapper.nbytes / 1e6:.1f} MB kept of frames")


def as_sparse(capture: Scene, folder: Path, count: int) -> Scene:
    """A capture as from structure from motion: few uneven points that three views see, with noise and strays."""
    random, xyz = np.random.default_rng(ord(folder.name[0])), capture.points.xyz
    textured = xyz[random.integers(0, len(xyz), TEXTURED)]
    likely = np.exp(-cKDTree(textured).query(xyz)[0] / FALLS_OFF_M) * (np.load(folder / "gt.npz")["views"] > 2)
    points = capture.points.take(random.choice(len(xyz), count, replace=False, p=likely / likely.sum()))
    off = random.normal(0, OFF_M, (count, 3))
    stray = random.random(count) < STRAY
    off[stray] += random.normal(0, STRAY_M, (np.count_nonzero(stray), 3))
    views = tuple(replace(view, camera=_moved(view.camera, random, *SPARSE_POSES)) for view in capture.views)
    return replace(capture, points=replace(points, xyz=(points.xyz + off).astype(np.float32)), views=views)


def pairs(folders: list[Path], sparse: int = 0) -> None:
    """Print each pair's changes and errors, and the figures over all. sparse: points of each visit, 0 for all."""
    total = PairScore()
    print("pair      changes found  moved followed  reported right      s")
    for folder in folders:
        first, second = (read_capture(folder / name) for name in "ab")
        if sparse:
            first, second = as_sparse(first, folder / "a", sparse), as_sparse(second, folder / "b", sparse)
        before = og.fit(first, progress=False)
        start = time.perf_counter()
        depth = None if sparse else depth_views(folder / "b", before.origin)
        updated = og.update(before, second, depth=depth, progress=False)
        seconds = time.perf_counter() - start
        visit = og.fit(second, progress=False)
        score = score_pair(folder, updated.changes.to_dict(), before, visit, updated.cloud)
        total += score
        print(
            f"{folder.name:10} {score.changes:6} {score.found:5} {score.moved:6} {score.followed:8} "
            f"{score.reported:9} {score.right:5} {seconds:6.1f}",
            flush=True,
        )
        for error in score.errors:
            print(f"    {error}")
    print("  ".join(f"{name} {value:.3f}" for name, value in total.figures.items()), f"({total.changes} changes)")


def days(seeds: list[Path]) -> None:
    """The demo room on two days, by one mapper: whether it finds what moved, left and came, and false reports."""
    from og_pointcloud_room.second_visit import TwoDays

    total, wrong = np.zeros(3, int), 0
    print("seed  moved  gone  new  wrong  CPU ms")
    for seed in seeds:
        room = TwoDays(int(str(seed)))
        mapper, start = og.Mapper(feature_space=room.feature_space), time.process_time()
        for frame in room.before:
            mapper.integrate(frame)
        known = {entry.id for entry in mapper.objects()}
        moves = [entry for frame in room.after for entry in mapper.integrate(frame).moved if entry.id in known]
        spent = (time.process_time() - start) / (len(room.before) + len(room.after))
        objects, place, days_apart = mapper.objects(), room.places, room.after[0].stamp or 0.0
        moved = [_near(entry.before, place["from"]) and _near(entry.after, place["to"]) for entry in moves]
        gone = [_near(entry.place, place["gone"]) for entry in objects if entry.state == "gone" and entry.id in known]
        new = [_near(entry.place, place["new"]) for entry in objects
               if entry.id not in known and days_apart <= entry.since < np.inf]  # fmt: skip
        right = np.array([any(told) for told in (moved, gone, new)])
        errors = sum(told.count(False) for told in (moved, gone, new))
        total, wrong = total + right, wrong + errors
        print(f"{seed!s:>4}  {right[0]:5}  {right[1]:4}  {right[2]:3}  {errors:5}  {1e3 * spent:6.1f}", flush=True)
    print(f"of {len(seeds)} each: {total[0]} moved, {total[1]} gone, {total[2]} new; {wrong} wrong entries")


def _near(one: np.ndarray, other: np.ndarray) -> bool:
    return bool(np.linalg.norm(one - other) < NEAR_M)


if __name__ == "__main__":
    main()
