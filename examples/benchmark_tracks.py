"""What mask tracks gain: zoo scenes fitted without tracks, with the true ids of things, and with imperfect trackers'.

    python examples/benchmark_tracks.py -o out/zoo [--half judge] [--only NAME ...]

"lost": a track ends where its thing is out of sight for an image, and starts again with another number, as trackers do
at every turn of the camera. "wrong": in addition, some masks have the track of another thing in their image. One row
per scene: mIoU by points, without tracks, and with each kind.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from og_pointcloud_zoo.draws import draw, is_chosen, scene_names
from og_pointcloud_zoo.make import drawn_capture, made_scene
from og_pointcloud_zoo.measure import answered
from og_pointcloud_zoo.report import HALVES

import og_pointcloud as og
from og_pointcloud.evaluate.truth import read_truth
from og_pointcloud.scene import Scene

Tracks = list[NDArray[np.int64]]
"""For each view, one track per mask, -1 none."""
WRONG = 0.1


def true_tracks(name: str) -> Tracks:
    """The thing that fills most of each mask."""
    capture = drawn_capture(draw(name))
    counts = [len(rows) for rows in capture.mask_features]
    return np.split(capture.mask_instance.astype(np.int64), np.cumsum(counts)[:-1])


def lost(tracks: Tracks) -> Tracks:
    """The same, with another number whenever a thing comes back into sight."""
    number: dict[int, int] = {}
    made, given = [], 0
    for view in tracks:
        seen = {}
        for thing in np.unique(view[view >= 0]).tolist():
            seen[thing] = number.get(thing, given)
            given += thing not in number
        number = seen
        made.append(np.array([seen.get(thing, -1) for thing in view.tolist()], np.int64))
    return made


def wrong(tracks: Tracks) -> Tracks:
    """As `lost`, but some masks have the track of another mask in their image."""
    rng = np.random.default_rng(0)
    return [np.where(rng.uniform(size=len(view)) < WRONG, rng.permutation(view), view) for view in lost(tracks)]


KINDS: dict[str, Callable[[Tracks], Tracks | None]] = {
    "without": lambda _: None, "true": lambda tracks: tracks, "lost": lost, f"lost, {WRONG:.0%} wrong": wrong,
}  # fmt: skip


def with_tracks(scene: Scene, tracks: Tracks | None) -> Scene:
    """The scene with tracks of its masks."""
    if tracks is None:
        return scene
    views = zip(scene.views, tracks, strict=True)
    return replace(scene, views=tuple(replace(view, mask_tracks=numbers) for view, numbers in views))


def main(arguments: list[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/zoo"))
    parser.add_argument("--half", choices=tuple(HALVES))
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="scenes whose name begins so")
    options = parser.parse_args(arguments)
    print(f"{'scene':<26}" + "".join(f"{kind:>18}" for kind in KINDS))
    rows = []
    for name in (name for name in scene_names() if is_chosen(name, options.half, options.only)):
        folder = made_scene(draw(name), options.output / "scenes")
        scene, truth, tracks = og.read_capture(folder), read_truth(folder), true_tracks(name)
        row = []
        for change in KINDS.values():
            cloud = og.fit(with_tracks(scene, change(tracks)), progress=False)
            row.append(truth.score(answered(folder, cloud, truth).called).miou)
        rows.append(row)
        print(f"{name:<26}" + "".join(f"{miou:18.4f}" for miou in row), flush=True)
    print(f"{'mean':<26}" + "".join(f"{miou:18.4f}" for miou in np.mean(rows, axis=0)))


if __name__ == "__main__":
    main()
