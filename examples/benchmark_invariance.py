"""What must not change a fit, changed: points, masks and views reordered, the world moved, views and points doubled.

    python examples/benchmark_invariance.py CAPTURE [CAPTURE ...] -o out/invariance

A row per capture and change: the share of the points with the label they had (unknown counts as a label), the scores,
and the number of instances. What a capture must hold is said in score_captures.py. Writes invariance.csv.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from benchmark_scaling import write_rows
from numpy.typing import NDArray
from score_captures import score_of

import og_pointcloud as og
from og_pointcloud.cloud import LabelledCloud
from og_pointcloud.scene import Points, Scene, View
from og_pointcloud.text.text_features import read_text_features

Change = Callable[[Scene, np.random.Generator], tuple[Scene, NDArray[np.int64]]]
"""Scene -> the changed one, and the row of each of its points in the former."""


@dataclass(frozen=True)
class InvarianceRow:
    """same_label: share of the points, against the unchanged capture."""

    capture: str
    change: str
    same_label: float
    miou: float
    macc: float
    unknown: float
    instances: int


def points_shuffled(scene: Scene, rng: np.random.Generator) -> tuple[Scene, NDArray[np.int64]]:
    """The same points in another order."""
    return _with_rows(scene, rng.permutation(len(scene.points)))


def points_twice(scene: Scene, rng: np.random.Generator) -> tuple[Scene, NDArray[np.int64]]:
    """Every point and a copy of it in the same place."""
    return _with_rows(scene, np.repeat(np.arange(len(scene.points)), 2))


def _with_rows(scene: Scene, rows: NDArray[np.int64]) -> tuple[Scene, NDArray[np.int64]]:
    points = scene.points
    arrays = {name: getattr(points, name) for name in ("rgb", "normals", "scale", "rotation", "opacity")}
    chosen = {name: None if array is None else array[rows] for name, array in arrays.items()}
    return replace(scene, points=replace(points, xyz=points.xyz[rows], **chosen)), rows


def views_shuffled(scene: Scene, rng: np.random.Generator) -> tuple[Scene, NDArray[np.int64]]:
    """The same views in another order."""
    return _with_views(scene, [scene.views[index] for index in rng.permutation(len(scene.views))])


def views_twice(scene: Scene, rng: np.random.Generator) -> tuple[Scene, NDArray[np.int64]]:
    """Every view and a copy of it under another name."""
    return _with_views(scene, [*scene.views, *(replace(view, name=f"{view.name} again") for view in scene.views)])


def masks_renumbered(scene: Scene, rng: np.random.Generator) -> tuple[Scene, NDArray[np.int64]]:
    """The masks of every view with other ids."""
    return _with_views(scene, [_renumbered(view, rng.permutation(view.mask_count)) for view in scene.views])


def _renumbered(view: View, old: NDArray[np.int64]) -> View:
    new = np.append(np.argsort(old), -1).astype(np.int32)
    return replace(view, masks=lambda: new[view.mask_map()], mask_features=view.mask_features[old])


def _with_views(scene: Scene, views: list[View]) -> tuple[Scene, NDArray[np.int64]]:
    return replace(scene, views=tuple(views)), np.arange(len(scene.points))


def moved(
    scene: Scene, rng: np.random.Generator, *, scale: float = 1.0, turned: bool = False, offset: float = 0.0
) -> tuple[Scene, NDArray[np.int64]]:
    """The world turned at random, scaled, and moved by so much along each axis, with its cameras."""
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0] if turned else np.eye(3)
    turn *= np.linalg.det(turn)  # a rotation, no mirror
    points = scene.points
    if points.are_gaussians:
        raise SystemExit(f"{scene.name} holds Gaussians; expected a plain cloud: their rotations are not moved here")
    world = scale * points.xyz_world @ turn.T + offset
    placed = Points.from_world(world, rgb=points.rgb)
    views = []
    for view in scene.views:
        pose = view.camera.world_to_camera.copy()
        shift = pose[:3, 3] - pose[:3, :3] @ points.origin
        pose[:3, :3] = pose[:3, :3] @ turn.T
        pose[:3, 3] = pose[:3, :3] @ (placed.origin - offset) + scale * shift
        views.append(replace(view, camera=replace(view.camera, world_to_camera=pose)))
    return replace(scene, points=placed, views=tuple(views)), np.arange(len(points))


CHANGES: dict[str, Change] = {
    "points shuffled": points_shuffled,
    "every point twice": points_twice,
    "masks renumbered": masks_renumbered,
    "views shuffled": views_shuffled,
    "every view twice": views_twice,
    "world turned": partial(moved, turned=True),
    "world a thousand times larger": partial(moved, scale=1e3),
    "world a thousand times smaller": partial(moved, scale=1e-3),
    "world moved by 1e6": partial(moved, offset=1e6),
}


def labels_of(cloud: LabelledCloud, vectors: NDArray[np.floating]) -> NDArray[np.int64]:
    """(n,) row of the text vectors that is nearest to a descriptor of each point's instance; -1 unknown."""
    table = cloud.instances
    best = np.full(len(table) + 2, -1)  # rows -2 and -1: unobserved, background
    unit = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    best[table.descriptor_instance] = (table.descriptors @ unit.T).argmax(axis=1)
    return best[cloud.instance_ids]


def measure(folder: Path) -> list[InvarianceRow]:
    """The unchanged capture and every change of it."""
    scene = og.read_capture(folder)
    vocabulary, _ = read_text_features(folder / "text_features.npz")
    rows, before = [], np.zeros(0)
    for name, change in {"none": lambda scene, _: (scene, np.arange(len(scene.points))), **CHANGES}.items():
        changed, source = change(scene, np.random.default_rng(0))
        cloud = og.fit(changed, progress=False)
        labels = np.empty(len(scene.points), np.int64)
        labels[source] = labels_of(cloud, vocabulary.vectors)
        before = labels if name == "none" else before
        score = score_of(labels, vocabulary.names, folder)
        same = float((labels == before).mean())
        rows.append(
            InvarianceRow(folder.name, name, same, score.miou, score.macc, score.unknown_share, len(cloud.instances))
        )
        print_row(rows[-1])
    return rows


def print_row(row: InvarianceRow) -> None:
    """One line of the table."""
    print(
        f"{row.capture:<17} {row.change:<31} {row.same_label:10.5f} {row.miou:7.4f} {row.macc:7.4f} "
        f"{row.unknown:8.4f} {row.instances:10}",
        flush=True,
    )


def main() -> None:
    """Measure all captures, print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path, metavar="CAPTURE")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/invariance"), help="folder for the CSV")
    arguments = parser.parse_args()
    print("capture           change                          same label    mIoU    mAcc  unknown  instances")
    rows = [row for folder in arguments.captures for row in measure(folder)]
    arguments.output.mkdir(parents=True, exist_ok=True)
    write_rows(arguments.output / "invariance.csv", rows)


if __name__ == "__main__":
    main()
