"""3DGS files actually trained, on photographs of made rooms: labels of Gaussians, and of held-out photographs.

    python examples/benchmark_splats.py -o out/splats                       # all rooms; a minute or two each, to train
    python examples/benchmark_splats.py -o out/splats --half judge

A room is fitted twice, from the same masks: as a 3DGS of what its photographs show, and as a cloud of its surfaces. A
Gaussian's truth is that of the nearest point of a dense exact cloud, if that is within the Gaussian's size. But
Gaussians may lie anywhere and reach over edges as long as photographs come out right. So labels are also drawn in
photographs that neither the training nor the fit has seen: a pixel gets the class that most of its light comes from.
That is compared with the best of the baselines; with giving each Gaussian the truth of its nearest point; and with
about the best that labels can reach: the class of the pixels that receive most of a Gaussian's light. Writes
OUT/splats.csv, and for each room OUT/NAME.png: photograph, 3DGS, truth, drawn labels.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from og_pointcloud_room.capture import RoomCapture, write_capture
from og_pointcloud_zoo.draws import draw, is_chosen
from og_pointcloud_zoo.make import drawn_capture
from og_pointcloud_zoo.measure import WORDS, answered, measure
from og_pointcloud_zoo.trained import NEAREST, trained
from scipy.spatial import cKDTree

from og_pointcloud.evaluate.baselines import baseline_labels
from og_pointcloud.evaluate.metrics import Score
from og_pointcloud.evaluate.sweep import warm_up
from og_pointcloud.evaluate.truth import GT_NAME, Truth
from og_pointcloud.fitting.fit import fit_prepared, prepare
from og_pointcloud.fitting.grouping import indicator
from og_pointcloud.formats.atomic import write_file
from og_pointcloud.formats.capture import read_capture
from og_pointcloud.formats.colors import label_colors
from og_pointcloud.formats.gaussian_ply import gaussian_rows
from og_pointcloud.formats.ply import write_ply
from og_pointcloud.formats.tables import csv_text
from og_pointcloud.journal import Journal
from og_pointcloud.rendering.splatting import Gaussians, render, view_weights
from og_pointcloud.scene import Camera, Points
from og_pointcloud.text.text_features import read_text_features

ROOMS = tuple(f"{place}-{number}" for place in ("room", "shelf", "table", "desk") for number in (0, 1))
WIDTH, VIEWS, HELD_OUT = 256, 42, 6
"""Width and number of the photographs; each HELD_OUT-th is neither trained on nor fitted."""
START, MOST = 5_000, 20_000
"""Initial points of a training, and maximum number of Gaussians."""
DENSE = 300_000
"""Points of the cloud that Gaussians take their truth from."""
COVERED = 0.5
"""A pixel is drawn where at least this share of its light comes from Gaussians."""


@dataclass(frozen=True)
class Row:
    """color_error: mean absolute difference between held-out photographs and the 3DGS, in [0, 1]. miou, background: of
    the Gaussians. drawn, drawn_background: of held-out photographs' pixels; there, baseline: the best one; nearest: the
    nearest points' truth; possible: labels from these photographs' own truth. cloud: mIoU of the room as a cloud.
    seconds: of the 3DGS's fit, capture in memory."""

    scene: str
    gaussians: int
    color_error: float
    miou: float
    background: float
    drawn: float
    drawn_background: float
    baseline: float
    nearest: float
    possible: float
    cloud: float
    seconds: float


def main(arguments: Sequence[str] | None = None) -> None:
    """Train what is missing, fit, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/splats"), help="folder of scenes and results")
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="rooms whose name begins so")
    parser.add_argument("--half", choices=("choose", "judge"), help="only this half")
    options = parser.parse_args(arguments)
    rows, rooms = [], [name for name in ROOMS if is_chosen(name, options.half, options.only)]
    if not rooms:
        parser.error(f"no room begins with {', '.join(options.only)}; expected one of {', '.join(ROOMS)}")
    print(" | ".join(each.name for each in fields(Row)))
    for name in rooms:
        rows.append(measured(name, options.output))
        print(" | ".join(f"{v:.4f}" if isinstance(v, float) else str(v) for v in asdict(rows[-1]).values()), flush=True)
    print(write_file(options.output / "splats.csv", csv_text([asdict(row) for row in rows]).encode()))


def measured(name: str, output: Path) -> Row:
    """One room, both ways."""
    drawn = replace(draw(name), points=MOST, views=VIEWS, width=WIDTH, height=WIDTH * 3 // 4, hidden=0.0)
    room = drawn_capture(drawn)
    exact = drawn_capture(replace(drawn, points=DENSE, noise=0.0, uneven=0.0, backdrop=1.0, outliers=0.0, floaters=0.0))
    splat, cloud = (output / "scenes" / f"{name}-{kind}" for kind in ("3dgs", "cloud"))
    if not splat.is_dir():
        fitted = _without_held_out(room)
        write_capture(fitted, cloud)
        write_capture(fitted, unfinished := splat.with_suffix(".part"))
        write_ply(unfinished / "points.ply", {"vertex": gaussian_rows(_trained_on(fitted))})
        (unfinished / GT_NAME).unlink()  # it is the cloud's
        unfinished.rename(splat)
    scene, quiet = read_capture(splat), Journal(progress=False)
    warm_up(scene)
    start = time.perf_counter()
    prepared = prepare(scene, None, quiet)
    labelled = fit_prepared(prepared, None, quiet)
    seconds = time.perf_counter() - start
    truth, nearest = _truth(scene.points, exact)
    called = answered(splat, labelled, truth).called
    words = read_text_features(splat / WORDS)[0]
    baselines = [truth.class_of(labels, words.names) for _, labels, _ in baseline_labels(prepared, words.vectors)]
    points, score = scene.points, truth.score(called)
    shown, error = _drawn(room, points, called, output / f"{name}.png")
    others = [nearest, _possible(room, points), *baselines]
    of_nearest, possible, *of_baselines = (_drawn(room, points, labels)[0].miou for labels in others)
    return Row(
        name, len(points), error, score.miou, score.background_called or 0.0, shown.miou,
        shown.background_called or 0.0, max(of_baselines), of_nearest, possible, measure(cloud, baselines=False).miou,
        seconds,
    )  # fmt: skip


def _held_out(views: int) -> NDArray[np.int64]:
    return np.arange(views)[HELD_OUT // 2 :: HELD_OUT]


def _without_held_out(capture: RoomCapture) -> RoomCapture:
    kept = np.setdiff1d(np.arange(len(capture.frames)), _held_out(len(capture.frames)))
    frames, masks, rows = (
        tuple(values[k] for k in kept) for values in (capture.frames, capture.masks, capture.mask_features)
    )
    return replace(capture, frames=frames, masks=masks, mask_features=rows)


def _cameras(capture: RoomCapture, views: Sequence[int] | NDArray[np.int64]) -> list[Camera]:
    return [capture.intrinsics.camera(capture.frames[k].camera_to_world) for k in views]


def _trained_on(capture: RoomCapture) -> Points:
    images = [(frame.image / 255).astype(np.float32) for frame in capture.frames]
    start = np.random.default_rng(0).permutation(len(capture.xyz))[:START]
    points = Points(capture.xyz[start], np.zeros(3), capture.rgb[start])
    return trained(points, _cameras(capture, range(len(images))), images, MOST)


def _truth(points: Points, exact: RoomCapture) -> tuple[Truth, NDArray[np.int32]]:
    """The truth of Gaussians, and (n,) the class of the nearest point of all, however far."""
    away, nearest = cKDTree(exact.xyz).query(points.xyz_world)
    to_others: NDArray[np.float64] = np.asarray(cKDTree(exact.xyz).query(exact.xyz[:10_000], 4)[0])[:, 1:]
    near = away < np.maximum(np.max(points.gaussians[0], axis=1), 3 * np.median(to_others))
    return Truth(exact.cls[nearest], exact.names, near, near & exact.background[nearest]), exact.cls[nearest]


def _class_of(capture: RoomCapture) -> NDArray[np.int32]:
    """(objects + 1,) the class of each owner of a pixel; the last is for background."""
    return np.array([*(capture.names.index(item.name) for item in capture.room.objects), -1], np.int32)


def _in_world(points: Points) -> Gaussians:
    return replace(Gaussians.from_points(points), xyz=points.xyz_world.astype(np.float32))


def _possible(capture: RoomCapture, points: Points) -> NDArray[np.int64]:
    """(n,) the class of the pixels in held-out photographs that receive most of a Gaussian's light, -1 background."""
    gaussians, class_of, held_out = _in_world(points), _class_of(capture), _held_out(len(capture.frames))
    light = np.zeros((len(capture.names) + 1, len(points)))
    for view, camera in zip(held_out, _cameras(capture, held_out), strict=True):
        cls = class_of[capture.frames[view].owner].ravel()
        row = np.where(cls < 0, len(capture.names), cls).astype(np.int32)
        light += (indicator(row, len(light)) @ view_weights(gaussians, camera, NEAREST)).toarray()
    best = light.argmax(axis=0)
    return np.where((best < len(capture.names)) & light.any(axis=0), best, -1)


def _drawn(
    capture: RoomCapture, points: Points, labels: NDArray[np.integer], picture: Path | None = None
) -> tuple[Score, float]:
    """The score of labels drawn in the held-out photographs, and the color error there."""
    gaussians, class_of = _in_world(points), _class_of(capture)
    classes, held_out = len(capture.names) + 1, _held_out(len(capture.frames))
    assert points.rgb is not None
    color = points.rgb.astype(np.float32) / 255
    values = np.concatenate([np.eye(classes + 1, dtype=np.float32)[labels], color], axis=1, dtype=np.float32)
    truths, found, errors = [], [], []
    for view, camera in zip(held_out, _cameras(capture, held_out), strict=True):
        frame = capture.frames[view]
        image, covered = render(gaussians, values, camera, NEAREST)
        called = image[..., :-3].argmax(axis=2)
        called = np.where((called == classes) | (covered < COVERED), -1, called)
        truths.append(class_of[frame.owner])
        found.append(called)
        rgb = image[..., -3:] + 0.5 * (1 - covered[..., None])
        errors.append(float(np.abs(rgb - frame.image / 255).mean()))
        if picture is not None and view == held_out[len(held_out) // 2]:
            parts = [
                frame.image,
                np.clip(255 * rgb, 0, 255),
                label_colors(truths[-1].ravel()).reshape(rgb.shape),
                label_colors(called.ravel()).reshape(rgb.shape),
            ]
            cv2.imwrite(str(picture), np.concatenate(parts, axis=1).astype(np.uint8)[..., ::-1])
    cls, everywhere = np.stack(truths).ravel(), np.ones(sum(map(np.size, truths)), bool)
    truth = Truth(cls, capture.names, everywhere, cls < 0)
    return truth.score(np.stack(found).ravel()), float(np.mean(errors))


if __name__ == "__main__":
    main()
