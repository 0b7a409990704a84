"""Score labels against the ground truth of a data set or capture.

og-pointcloud eval capture kitchen kitchen.ogpc
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from og_pointcloud.cli import common
from og_pointcloud.cli.common import Parser
from og_pointcloud.errors import OgPointcloudError, counted
from og_pointcloud.formats.atomic import write_json

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from og_pointcloud.evaluate.captures import CaptureScore
    from og_pointcloud.evaluate.intervals import Interval
    from og_pointcloud.evaluate.lerf import PairScore
    from og_pointcloud.evaluate.metrics import Score

SCANNET_LABELS = "_vh_clean_2.labels.ply"
TASK_MEANS = ("miou", "macc", "forced_miou", "unknown")


def add(parser: Parser) -> None:
    add_path = partial(common.add_option, type=common.replaceable)
    capture, scannet, lerf = common.add_commands(parser, "protocol", run_capture, run_scannet, run_lerf)
    common.add_option(capture, "capture", "CAPTURE", "folder with gt.npz", type=Path)
    add_path(capture, "bundle", "S.ogpc", "file that `fit` wrote for it")
    add_path(capture, "--against", "OTHER.ogpc", "another file: also score the paired difference, minus OTHER")
    add_path(scannet, "folder", "DIR", f"scene folders with <scene>{SCANNET_LABELS}")
    add_path(scannet, "--gaussians", "G", "folder with <scene>.ply; points of opacity below 0.1 are ignored")
    add_path(lerf, "folder", "DIR", "folder with <scene>/sparse/0 and label/<scene>/*.json")
    splats = "folder with <scene>.ply or <scene>/point_cloud/iteration_*/: the fitted Gaussians"
    add_path(lerf, "--gaussians", "G", splats, required=True)
    for data_set in (scannet, lerf):
        add_path(data_set, "--predictions", "P", "folder with <scene>.ogpc", required=True)
        common.add_option(data_set, "--scenes", "A,B", "only these scenes (default: all with labels in DIR)")
    for protocol in (capture, scannet, lerf):
        add_path(protocol, "--text-features", "F.npz", "words with vectors (default: the capture's, else the scene's)")
        common.add_output(protocol, "--json", endings=(".json",), help="also write every score")


# Captures -------------------------------------------------------------------------------------------------------


def run_capture(arguments: argparse.Namespace) -> None:
    """Score a fitted capture against its own gt.npz: labels with their interval, abstentions, instances.

    og-pointcloud eval capture kitchen kitchen.ogpc --against kitchen_fast.ogpc
    """
    from og_pointcloud.evaluate.captures import ask, difference, score_capture
    from og_pointcloud.evaluate.truth import read_truth

    truth, own_words = read_truth(arguments.capture), arguments.capture / "text_features.npz"
    words = arguments.text_features or (own_words if own_words.is_file() else None)
    answer = ask(arguments.bundle, truth, words)
    score = score_capture(answer, truth)
    change = difference(answer, ask(arguments.against, truth, words), truth) if arguments.against else None
    name, interval = arguments.capture.resolve().name, score.interval
    row = {"": name} | capture_cells(score) | ({"minus the other": signed(change)} if change else {})
    common.print_table(tuple(row), [tuple(row.values())])
    print(
        "unknown counts as wrong; 'answered' leaves it out. The 95 % interval is over cubes of the scene, not points: "
        f"{interval.blocks} cubes of {interval.edge / answer.spacing:.0f} point spacings"
    )
    less = asdict(change) if change else None
    write_scores(arguments, {name: {**asdict(score), "spacing": answer.spacing, "less_the_other": less}})


def capture_cells(score: CaptureScore) -> dict[str, str]:
    """Column -> its text."""
    labels = score.labels
    return {
        "mIoU": percent(labels.miou),
        "95 %": spread((score.interval.low, score.interval.high)),
        "mAcc": percent(labels.macc),
        "unknown": percent(labels.unknown_share),
        "background called": percent(labels.background_called),
        "answered": percent(score.answered.miou),
        "share answered": percent(score.answered_share),
        "ARI": "-" if score.rand is None else f"{score.rand:.3f}",
    }


# ScanNet --------------------------------------------------------------------------------------------------------


def run_scannet(arguments: argparse.Namespace) -> None:
    """Score ScanNet with 19, 15 and 10 classes; unknown counts as wrong, and its share is printed.

    og-pointcloud eval scannet scans --predictions fitted --json scores.json
    """
    from og_pointcloud.evaluate.scannet import SCENES, TASKS, ask, read_truth, score_scene

    truths = scannet_truths(arguments.folder, common.names_in(arguments.scenes))
    files = {scene: prediction_file(arguments.predictions, scene) for scene in truths}
    scores: dict[int, dict[str, dict[str, Any]]] = {task: {} for task in TASKS}
    for scene, file in truths.items():
        xyz, truth = read_truth(file)
        opacity = opacities(arguments.gaussians, scene, len(truth))
        for task, of_task in scores.items():
            asked = ask(files[scene], xyz, task, arguments.text_features)
            of_task[scene] = scene_scores(*(score_scene(found, truth, task, opacity) for found in asked))
    means = {task: task_means(list(of_task.values())) for task, of_task in scores.items()}
    rows = [
        (f"{task} classes", *(percent(mean[name]) for name in TASK_MEANS), spread(mean["interval"]))
        for task, mean in means.items()
    ]
    common.print_table(("", "mIoU", "mAcc", "forced", "unknown", "95 % of mIoU"), rows)
    published = sum(scene in SCENES for scene in truths)
    scenes = f"{counted(len(truths), 'scene')}, {published} of the {len(SCENES)} in the published table"
    print(f"{scenes}; intervals are over scenes")
    if arguments.gaussians is None:
        print("no --gaussians: transparent points are not ignored")
    write_scores(arguments, {str(task): {**mean, "scenes": scores[task]} for task, mean in means.items()})


def scene_scores(said: Score, forced: Score) -> dict[str, Any]:
    """Scores of one scene and task, JSON-able. said: of the scene's answers. forced: with each instance given its best
    class, however badly it fits."""
    return {
        "miou": said.miou, "macc": said.macc, "forced_miou": forced.miou, "unknown": said.unknown_share,
        "points": said.points, "class_iou": dict(zip(map(str, said.classes), said.class_iou, strict=True)),
    }  # fmt: skip


def task_means(scenes: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Means over the scenes that have points of the task's classes, and the interval of the mIoU, low and high."""
    import numpy as np

    from og_pointcloud.evaluate.intervals import bootstrap

    present = [scene for scene in scenes if scene["class_iou"]]
    if not present:
        return dict.fromkeys((*TASK_MEANS, "interval"))
    table = np.array([[scene[name] for name in TASK_MEANS] for scene in present])
    miou = bootstrap(table[:, 0])
    return dict(zip(TASK_MEANS, table.mean(axis=0).tolist(), strict=True)) | {"interval": (miou.low, miou.high)}


def scannet_truths(folder: Path, scenes: list[str] | None) -> dict[str, Path]:
    """Scene name -> its labels file, in the folder or in the scene's own subfolder."""
    files = (*folder.glob(f"*{SCANNET_LABELS}"), *folder.glob(f"*/*{SCANNET_LABELS}"))
    labels_of = {file.name.removesuffix(SCANNET_LABELS): file for file in files}
    if not labels_of:
        raise OgPointcloudError(f"{folder} has no <scene>/<scene>{SCANNET_LABELS}; expected ScanNet's folder of scenes")
    return {scene: labels_of[scene] for scene in known_scenes(folder, sorted(labels_of), scenes)}


def opacities(folder: Path | None, scene: str, count: int) -> NDArray[np.floating] | None:
    if folder is None:
        return None
    from og_pointcloud.formats.points import read_points

    points = read_points(folder / f"{scene}.ply")
    if points.opacity is None or len(points) != count:
        kind = "Gaussians" if points.are_gaussians else "points without opacity"
        raise OgPointcloudError(
            f"{folder / scene}.ply has {len(points)} {kind}; expected a Gaussian for each of the scene's {count} "
            "points, in the same order"
        )
    return points.opacity


# LeRF-OVS -------------------------------------------------------------------------------------------------------


def run_lerf(arguments: argparse.Namespace) -> None:
    """Score LeRF-OVS: select by text, render, compare with the outlined objects (mIoU, IoU over 0.25).

    og-pointcloud eval lerf lerf_ovs --predictions fitted --gaussians trained --text-features words.npz
    """
    from og_pointcloud.ask.labelled_scene import load
    from og_pointcloud.evaluate.lerf import gaussians_of, read_scene, scene_names, score_pairs

    # Everything is looked up before anything is rendered, so that a missing file of the last scene is reported at once.
    wanted = known_scenes(arguments.folder, scene_names(arguments.folder), common.names_in(arguments.scenes))
    labels = [read_scene(arguments.folder, name) for name in wanted]
    files = [prediction_file(arguments.predictions, name) for name in wanted]
    splats = [gaussians_file(arguments.gaussians, name) for name in wanted]
    scenes = {}
    for of_scene, file, splat in zip(labels, files, splats, strict=True):
        scene = load(file)
        gaussians = gaussians_of(scene.cloud, splat)
        scenes[of_scene.name] = score_pairs(scene, of_scene, gaussians, arguments.text_features)
    means = print_selections(scenes)
    pairs = {name: [asdict(pair) for pair in of_scene] for name, of_scene in scenes.items()}
    write_scores(arguments, {"means": means, "scenes": pairs})


def print_selections(scenes: Mapping[str, Sequence[PairScore]]) -> dict[str, dict[str, float]]:
    """Print a row per scene, the means over scenes, and the intervals over all pairs; returns the means of each way."""
    import numpy as np

    from og_pointcloud.evaluate.intervals import bootstrap
    from og_pointcloud.evaluate.lerf import MIN_IOU, PUBLISHED_PAIRS, WAYS, score_scenes

    ious = {way: {name: np.array([pair.iou[way] for pair in pairs]) for name, pairs in scenes.items()} for way in WAYS}
    means = {way: score_scenes(of_way) for way, of_way in ious.items()}
    rows = []
    for name, pairs in scenes.items():
        # A scene whose labels name no object has neither pairs nor a mean.
        cells = [(of[name].mean(), (of[name] > MIN_IOU).mean()) if pairs else (None, None) for of in ious.values()]
        rows.append((name, str(len(pairs)), *(percent(value) for cell in cells for value in cell)))
    total = sum(map(len, scenes.values()))
    rows.append(("mean", str(total), *(percent(value) for mean in means.values() for value in mean)))
    pooled = [np.concatenate(list(of_way.values())) for of_way in ious.values()]
    intervals = [bootstrap(column) for every in pooled for column in (every, (every > MIN_IOU).astype(float))]
    rows.append(("95 % over pairs", "", *(spread((found.low, found.high)) for found in intervals)))
    common.print_table(("", "pairs", *(f"{way} {what}" for way in WAYS for what in ("mIoU", "over 0.25"))), rows)
    print(f"{counted(total, 'pair')} in {counted(len(scenes), 'scene')}; the published table: {PUBLISHED_PAIRS} in 4")
    return {way: {"miou": miou, "accuracy": found} for way, (miou, found) in means.items()}


def gaussians_file(folder: Path, scene: str) -> Path:
    from og_pointcloud.formats.gaussian_ply import latest_iteration

    named = folder / f"{scene}.ply"
    file = named if named.is_file() else latest_iteration(folder / scene)
    if file is None:
        raise OgPointcloudError(
            f"{folder} has neither {scene}.ply nor {scene}/point_cloud/iteration_*/point_cloud.ply; expected the "
            "Gaussians that the scene was fitted from"
        )
    return file


# What the protocols share ---------------------------------------------------------------------------------------


def write_scores(arguments: argparse.Namespace, report: Mapping[str, Any]) -> None:
    if arguments.json:
        write_json(arguments.json, without_nan(report))
        print(f"wrote {arguments.json}")


def without_nan(value: Any) -> Any:
    """NaN, where there was nothing to score, becomes null: JSON has no NaN."""
    if isinstance(value, Mapping):
        return {name: without_nan(inner) for name, inner in value.items()}
    return None if isinstance(value, float) and value != value else value


def known_scenes(folder: Path, known: list[str], wanted: list[str] | None) -> list[str]:
    missing = [name for name in wanted or () if name not in known]
    if missing:
        raise OgPointcloudError(f"{folder} has no labels for '{missing[0]}'; it has {', '.join(known[:4])}")
    return wanted or known


def prediction_file(folder: Path, scene: str) -> Path:
    """The file of one scene in a folder of predictions; a missing file is an error."""
    file = folder / f"{scene}.ogpc"
    if not file.is_file():
        raise OgPointcloudError(
            f"{folder} has no {file.name}: a mean over other scenes is not comparable; fit that scene, or name the "
            "scenes to score"
        )
    return file


def percent(value: float | None) -> str:
    return "-" if value is None or value != value else f"{100 * value:.1f}"


def spread(interval: tuple[float, float] | None) -> str:
    return " to ".join(map(percent, interval)) if interval else "-"


def signed(interval: Interval) -> str:
    """A difference with its interval, in percentage points."""
    return f"{100 * interval.mean:+.1f} ({100 * interval.low:+.1f} to {100 * interval.high:+.1f})"
