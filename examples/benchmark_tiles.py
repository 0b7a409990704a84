"""A street fitted in tiles: seconds, peak memory, scores and a picture; and how little the tiles show in the labels.

    python examples/benchmark_tiles.py --points 20000000 --views 60 -o out/tiles
    python examples/benchmark_tiles.py --points 300000 --views 24 --length 60 --tile-points 75000 --checks

With ``--checks`` the same street is fitted whole, with other cuts, and with its points in another order, and each
labelling is compared with that of the tiles, point by point. The street has to fit in memory for that.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from benchmark_scaling import peak_mb
from make_street import CLASSES, GROUND, MadeStreet, make_street
from numpy.typing import NDArray

from og_pointcloud.cloud import LabelledCloud
from og_pointcloud.evaluate.metrics import adjusted_rand_index, score_labels
from og_pointcloud.fitting.fit import fit
from og_pointcloud.fitting.tiles import fit_tiles, split
from og_pointcloud.formats.colors import label_colors
from og_pointcloud.scene import Points, Scene
from og_pointcloud.settings import FitSettings

Ids = NDArray[np.integer]
PICTURE_PX = (300, 2000)
"""Least and largest width of a panel; between them it is as fine as the points fill."""
STREET_SIDE_M = 4.0
"""The second panel shows what lies farther from the middle of the road than this, on its left."""


def agreement(first: Ids, second: Ids) -> float:
    """Of the points that either labelling gives an instance, the share with the same, under the one-to-one matching of
    instances that makes it largest; 1 where neither has any."""
    from scipy.optimize import linear_sum_assignment

    either, both = (first >= 0) | (second >= 0), (first >= 0) & (second >= 0)
    shared = np.zeros((first.max(initial=-1) + 1, second.max(initial=-1) + 1))
    np.add.at(shared, (first[both], second[both]), 1)
    return float(shared[linear_sum_assignment(-shared)].sum() / either.sum()) if either.any() else 1.0


def scores(made: MadeStreet, cloud: LabelledCloud, seen: NDArray[np.bool_]) -> dict[str, float]:
    """miou of the classes, each instance being of the class whose text is nearest, and background_called, the share of
    road and pavement that is given one; ari, adjusted Rand index of the objects. All on points that some view shows."""
    texts = made.texts / np.linalg.norm(made.texts, axis=1, keepdims=True)
    of_instance = np.full(len(cloud.instances) + 2, -1)
    of_instance[cloud.instances.descriptor_instance] = (cloud.instances.descriptors @ texts.T).argmax(axis=1)
    truth = np.where(made.owner >= 0, made.street.cls[made.owner], -1)
    ground = seen & (made.owner == GROUND)
    score = score_labels(of_instance[cloud.instance_ids], truth, background=ground, scored=seen)
    on_object = seen & (made.owner >= 0)
    ari = adjusted_rand_index(cloud.instance_ids[on_object], made.owner[on_object])
    return {"miou": score.miou, "background_called": score.background_called or 0.0, "ari": ari}


def checks(made: MadeStreet, cloud: LabelledCloud, most: int, seen: NDArray[np.bool_]) -> list[dict[str, Any]]:
    """Each other way to fit the street, with its agreement with the cloud and its scores."""
    settings = FitSettings(mode="grouping")
    order = np.random.default_rng(1).permutation(len(cloud))
    points = made.scene.points
    assert points.rgb is not None
    shuffled = replace(made.scene, points=Points(points.xyz[order], points.origin, points.rgb[order]))
    back = np.argsort(order)

    def row(name: str, other: LabelledCloud) -> dict[str, Any]:
        if name.endswith("shuffled"):
            other = replace(other, xyz=points.xyz, rgb=points.rgb, instance_ids=other.instance_ids[back])
        same = agreement(cloud.instance_ids, other.instance_ids)
        return {"fit": name, "agreement": same, "instances": len(other.instances), **scores(made, other, seen)}

    return [
        row("whole", fit(made.scene, settings, progress=False)),
        row("whole, shuffled", fit(shuffled, settings, progress=False)),
        row("tiles, shuffled", fit_tiles(shuffled, settings, points_per_tile=most, progress=False)),
        row("tiles of 2/3 the points", fit_tiles(made.scene, settings, points_per_tile=2 * most // 3, progress=False)),
    ]


def warm_up() -> None:
    """Have all code compiled and stored, which takes seconds and memory."""
    settings = FitSettings(mode="grouping")
    scene = make_street(3_000, 4, (64, 36), 20.0).scene
    fit(scene, settings, progress=False)
    fit_tiles(scene, settings, points_per_tile=1_000, progress=False)


def picture(scene: Scene, cloud: LabelledCloud, most: int, path: Path) -> None:
    """Instances from above, and those of the left side from the road, with the borders of the tiles."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    xyz = scene.points.xyz
    tiles = split(xyz, most)
    colour = label_colors(np.maximum(cloud.instance_ids, -1))
    figure, panels = plt.subplots(2, 1, figsize=(20, 8), layout="constrained")
    left = np.flatnonzero(xyz[:, 1] > STREET_SIDE_M)
    above = _drawn(xyz[:, 0], xyz[:, 1], xyz[:, 2], colour)
    from_road = _drawn(xyz[left, 0], xyz[left, 2], -xyz[left, 1], colour[left])
    for panel, (image, extent), axis in zip(panels, (above, from_road), (1, 2), strict=True):
        panel.imshow(image, extent=extent, interpolation="nearest")
        for tile in range(len(tiles)):
            part = xyz[tiles.order[tiles.part(tile)]][:, [0, axis]]
            (x0, low), (x1, high) = part.min(axis=0), part.max(axis=0)
            panel.plot([x0, x1, x1, x0, x0], [low, low, high, high, low], color="black", linewidth=0.8)
        panel.set_ylabel("yz"[axis - 1] + ", metres")
    panels[0].set_title(f"{len(cloud):,} points, {len(tiles)} tiles, {len(cloud.instances)} instances; grey: none")
    panels[1].set_xlabel("x, metres")
    figure.savefig(path, dpi=100)


def _drawn(
    right: NDArray[np.float32], up: NDArray[np.float32], nearness: NDArray[np.float32], colour: NDArray[np.uint8]
) -> tuple[NDArray[np.uint8], tuple[float, float, float, float]]:
    """An image (H, W, 3) of points, the nearest in front, and its extent (left, right, bottom, top)."""
    extent = float(right.min()), float(right.max()), float(up.min()), float(up.max())
    width, height = extent[1] - extent[0], extent[3] - extent[2]
    px_per_m = np.clip(np.sqrt(0.5 * len(right) * width / height), *PICTURE_PX) / width
    image = np.full((int(height * px_per_m) + 1, int(width * px_per_m) + 1, 3), 255, np.uint8)
    order = np.argsort(nearness, kind="stable")
    row, column = (extent[3] - up[order]) * px_per_m, (right[order] - extent[0]) * px_per_m
    image[row.astype(int), column.astype(int)] = colour[order]
    return image, extent


def main() -> None:
    """Make the street, fit it, print and write what came of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=2_000_000)
    parser.add_argument("--views", type=int, default=60)
    parser.add_argument("--image", type=int, nargs=2, default=(960, 540), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--length", type=float, default=200.0, help="of the street, metres")
    parser.add_argument("--tile-points", type=int, default=2_000_000, help="points of a tile at most")
    parser.add_argument("--work", type=Path, help="folder that keeps what is done if this is interrupted")
    parser.add_argument("--checks", action="store_true", help="also compare with other ways to fit the street")
    parser.add_argument("-o", "--output", type=Path, help="folder for a JSON file and a picture")
    arguments = parser.parse_args()
    warm_up()
    made = make_street(arguments.points, arguments.views, tuple(arguments.image), arguments.length)
    before, start = peak_mb(), time.perf_counter()
    cloud = fit_tiles(
        made.scene, FitSettings(mode="grouping"), points_per_tile=arguments.tile_points, work=arguments.work
    )
    seconds, peak = time.perf_counter() - start, peak_mb()
    seen = made.seen()
    report = {
        "points": len(cloud), "views": arguments.views, "seconds": round(seconds, 1), "peak_mb": round(peak),
        "peak_mb_before": round(before), "objects": len(made.street.cls), "instances": len(cloud.instances),
        "classes": CLASSES, **scores(made, cloud, seen), **cloud.provenance,
    }  # fmt: skip
    for stage in cloud.provenance["stages"]:
        print(f"{stage['name']:<12} {stage['seconds']:9.1f} s")
    for entry in cloud.provenance["left_out"]:
        print(f"left out: {entry['what']}: {entry['why']}")
    print(
        f"{len(cloud):,} points, {arguments.views} views, {len(cloud.provenance['notes']['tiles'])} tiles: "
        f"{seconds:.1f} s, peak {peak:,.0f} MB ({before:,.0f} MB before the fit)"
    )
    print(f"{report['objects']} objects, {report['instances']} instances; mIoU {report['miou']:.4f}, "
          f"ARI {report['ari']:.4f}, of the ground {report['background_called']:.1%} called something")  # fmt: skip
    if arguments.checks:
        report["checks"] = checks(made, cloud, arguments.tile_points, seen)
        print(f"\n{'compared with':<26} agreement  instances    mIoU     ARI")
        for row in report["checks"]:
            print(
                f"{row['fit']:<26} {row['agreement']:9.4%} {row['instances']:10} {row['miou']:7.4f} {row['ari']:7.4f}"
            )
    if arguments.output:
        arguments.output.mkdir(parents=True, exist_ok=True)
        (arguments.output / "tiles.json").write_text(json.dumps(report, indent=1))
        picture(made.scene, cloud, arguments.tile_points, arguments.output / "tiles.png")


if __name__ == "__main__":
    main()
