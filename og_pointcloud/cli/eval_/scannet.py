"""``og-pointcloud eval scannet``: the table of ScanNet scenes, from the data set's own files."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from og_pointcloud.cli.common import add_command, check_outputs, names_in, print_table, write_json
from og_pointcloud.cli.eval_.common import percent, prediction_file, signed, spread
from og_pointcloud.errors import OgPointcloudError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from og_pointcloud.evaluate.scannet import SceneScore
    from og_pointcloud.evaluate.spread import RiskCoverage

LABELS = "_vh_clean_2.labels.ply"
NOT_OF_THE_TABLE = 40
"""NYU40's "other property", which no task asks for."""


@dataclass(frozen=True)
class Predicted:
    """ids: (n,) NYU40, 0 unknown. confidence: (n,), None where a file of labels has none. forced: (n,) as ids, but
    every instance with a feature takes a class; None for stored labels. strange: names said that are no class."""

    ids: NDArray[np.int64]
    confidence: NDArray[np.floating] | None
    forced: NDArray[np.int64] | None
    strange: frozenset[str]


@dataclass(frozen=True)
class SceneResult:
    """One scene, one task. forced: mIoU of `Predicted.forced`. correct, confidence: of the protocol's points."""

    score: SceneScore
    forced: float | None
    correct: NDArray[np.bool_]
    confidence: NDArray[np.float64]
    has_confidence: bool
    strange: frozenset[str]


@dataclass(frozen=True)
class TaskResult:
    """scenes: by name. forced: its mean over scenes, None with stored labels. curve: of the points of all scenes
    together, None without confidences. answered: their share. strange: names said that are no class."""

    scenes: dict[str, SceneScore]
    forced: float | None
    curve: RiskCoverage | None
    answered: float
    strange: frozenset[str]


def add(protocols: Any) -> None:
    scannet = add_command(
        protocols, "scannet", run,
        "ScanNet point segmentation with 19, 15 and 10 classes; unknown counts as wrong, and beside it as abstention.",
        "og-pointcloud eval scannet scans --predictions fitted --json scores.json",
    )  # fmt: skip
    scannet.add_argument("folder", type=Path, metavar="DIR", help=f"folder of scene folders with <scene>{LABELS}")
    scannet.add_argument(
        "--predictions", type=Path, required=True, metavar="P",
        help="folder with <scene>.ogpc, which is asked, or <scene>.npz, from `segment -o` for the labels' points",
    )  # fmt: skip
    scannet.add_argument("--against", type=Path, metavar="Q", help="as P: also give the difference, P less Q, paired")
    scannet.add_argument("--text-features", type=Path, metavar="F.npz", help="names and vectors for .ogpc predictions")
    scannet.add_argument(
        "--gaussians",
        type=Path,
        metavar="G",
        help="folder with <scene>.ply, whose points of opacity below 0.1 are ignored",
    )
    scannet.add_argument("--scenes", metavar="A,B", help="these scenes (default: all in DIR)")
    scannet.add_argument("--plot", type=Path, metavar="F.png", help="risk against coverage of the 19 classes")
    scannet.add_argument("--json", type=Path, metavar="F.json", help="also write every score")


def run(arguments: argparse.Namespace) -> None:
    outputs = {"--json": (arguments.json, [".json"]), "--plot": (arguments.plot, [".png"])}
    check_outputs(outputs, inputs=[arguments.text_features])
    from og_pointcloud.evaluate.plots import plot_risk_coverage, require_matplotlib
    from og_pointcloud.evaluate.scannet import SCENES

    if arguments.plot:
        require_matplotlib()
    files = truth_files(arguments.folder, names_in(arguments.scenes))
    folders = [folder for folder in (arguments.predictions, arguments.against) if folder]
    predictions = [{scene: prediction_file(folder, scene) for scene in files} for folder in folders]
    own, *others = (score_files(files, found, arguments) for found in predictions)
    rows, report = [], {}
    for task, result in own.items():
        row, report[str(task)] = described(task, result, others[0][task] if others else None)
        rows.append(row)
    print_table(HEADER + (("less the other",) if others else ()), rows)
    published = sum(scene in SCENES for scene in files)
    print(f"{len(files)} scenes, {published} of the {len(SCENES)} of the published table; intervals are over scenes")
    if strange := sorted(frozenset().union(*(result.strange for result in own.values()))):
        print(f"said, but no class of the table, so wrong everywhere: {', '.join(strange[:5])}")
    if arguments.gaussians is None:
        print("no --gaussians: transparent points are not ignored, so mIoU is that of all points")
    if arguments.plot:
        largest = max(own)
        results = [(str(folder), of[largest]) for folder, of in zip(folders, (own, *others), strict=True)]
        curves = {name: result.curve for name, result in results if result.curve}
        if not curves:
            raise OgPointcloudError("no prediction has scores, so there is no risk against coverage to plot (--plot)")
        title = f"ScanNet, {largest} classes"
        plot_risk_coverage(curves, {name: result.answered for name, result in results}, arguments.plot, title)
        print(f"wrote {arguments.plot}")
    if arguments.json:
        write_json(arguments.json, report)
        print(f"wrote {arguments.json}")


HEADER = (
    "", "mIoU", "mAcc", "forced", "flat mIoU", "all points", "answered", "share answered", "risk area", "95 % of mIoU",
)  # fmt: skip


def score_files(
    files: dict[str, Path], predictions: dict[str, Path], arguments: argparse.Namespace
) -> dict[int, TaskResult]:
    """Every task over all scenes."""
    from og_pointcloud.evaluate.scannet import TASKS

    scenes = {scene: score_file(scene, file, predictions[scene], arguments) for scene, file in files.items()}
    return {task: over_all({scene: of_task[task] for scene, of_task in scenes.items()}) for task in TASKS}


def score_file(scene: str, file: Path, prediction: Path, arguments: argparse.Namespace) -> dict[int, SceneResult]:
    """Every task of one scene."""
    import numpy as np

    from og_pointcloud.evaluate.scannet import TASKS, read_truth, score_scene, scored_answers

    xyz, truth = read_truth(file)
    opacity = opacities(arguments.gaussians, scene, len(truth))
    results = {}
    for task in TASKS:
        found = predicted(prediction, xyz, task, arguments.text_features)
        forced = None if found.forced is None else score_scene(found.forced, truth, task, opacity).protocol.miou
        confidence = np.zeros(len(truth)) if found.confidence is None else found.confidence
        results[task] = SceneResult(
            score_scene(found.ids, truth, task, opacity),
            forced,
            *scored_answers(found.ids, confidence, truth, task, opacity),
            found.confidence is not None,
            found.strange,
        )
    return results


def over_all(scenes: dict[str, SceneResult]) -> TaskResult:
    """One task over its scenes."""
    import numpy as np

    from og_pointcloud.evaluate.spread import risk_coverage

    results = list(scenes.values())
    correct = np.concatenate([result.correct for result in results])
    confidence = np.concatenate([result.confidence for result in results])
    has_curve = len(correct) > 0 and all(result.has_confidence for result in results)
    forced = [result.forced for result in results if result.forced is not None]
    return TaskResult(
        scenes={scene: result.score for scene, result in scenes.items()},
        forced=over_scenes(forced) if len(forced) == len(results) else None,
        curve=risk_coverage(correct, confidence) if has_curve else None,
        answered=float(np.isfinite(confidence).mean()) if len(correct) else float("nan"),
        strange=frozenset().union(*(result.strange for result in results)),
    )


def described(task: int, result: TaskResult, other: TaskResult | None) -> tuple[tuple[str, ...], dict[str, Any]]:
    """A row of the table, and the same with every scene as JSON. other: of the predictions to compare with."""
    import numpy as np

    from og_pointcloud.evaluate.scannet import average
    from og_pointcloud.evaluate.spread import bootstrap, paired_bootstrap

    values = list(result.scenes.values())
    mean = average(values)
    per_scene = np.array([score.protocol.miou for score in values])
    known = bool(np.isfinite(per_scene).any())
    interval = bootstrap(per_scene) if known else None
    change = None
    if other and known:
        change = paired_bootstrap(per_scene, np.array([score.protocol.miou for score in other.scenes.values()]))
    area = result.curve.area if result.curve else None
    row = (
        f"{task} classes", percent(mean.miou), percent(mean.macc), percent(result.forced), percent(mean.flat_miou),
        *map(percent, variants(values)), "-" if area is None else f"{area:.4f}",
        spread(interval), *([] if other is None else [signed(change) if change else "-"]),
    )  # fmt: skip
    entry = {
        "miou": mean.miou if known else None,
        "macc": mean.macc if known else None,
        "forced_miou": result.forced if known else None,
        "flat_miou": mean.flat_miou if known else None,
        "risk_area": area,
        "interval": [interval.low, interval.high] if interval else None,
        "less_the_other": [change.mean, change.low, change.high] if change else None,
        "scenes": {scene: describe(score) for scene, score in result.scenes.items()},
    }
    return row, entry


def variants(scores: Sequence[SceneScore]) -> list[float]:
    """Means over scenes: mIoU of all points, of the answered ones, and the share of these."""
    return [
        over_scenes([score.all_points.miou for score in scores]),
        over_scenes([score.answered.miou for score in scores]),
        over_scenes([score.answered_share for score in scores]),
    ]


def over_scenes(values: Sequence[float]) -> float:
    """The mean of those scenes that have the figure."""
    import numpy as np

    finite = [value for value in values if np.isfinite(value)]
    return float(np.mean(finite)) if finite else float("nan")


def describe(score: SceneScore) -> dict[str, Any]:
    """One scene's scores as JSON: by class, and the means."""
    classes = dict(zip(map(str, score.protocol.classes), score.protocol.class_iou, strict=True))
    return {
        "miou": score.protocol.miou if classes else None,
        "macc": score.protocol.macc if classes else None,
        "class_iou": classes,
        "points": score.protocol.points,
        "all_points_miou": score.all_points.miou if score.all_points.classes else None,
        "answered_miou": score.answered.miou if score.answered.classes else None,
        "answered_share": score.answered_share if classes else None,
    }


def truth_files(folder: Path, scenes: list[str] | None) -> dict[str, Path]:
    """Scene name -> its labels, in the folder or in the scene's own folder below it."""
    found = {
        file.name.removesuffix(LABELS): file for file in (*folder.glob(f"*{LABELS}"), *folder.glob(f"*/*{LABELS}"))
    }
    if not found:
        raise OgPointcloudError(f"{folder} has no <scene>/<scene>{LABELS}; expected ScanNet's folder of scenes")
    missing = [scene for scene in scenes or () if scene not in found]
    if missing:
        raise OgPointcloudError(f"{folder} has no labels of '{missing[0]}'; it has {', '.join(sorted(found)[:3])}, ...")
    return {scene: found[scene] for scene in scenes or sorted(found)}


def predicted(file: Path, xyz: NDArray[np.float64], task: int, text_features: Path | None) -> Predicted:
    """A bundle is asked for the task's names, stored labels are taken by their names."""
    import numpy as np

    from og_pointcloud.evaluate.scannet import NAMES, TASKS

    forced = None
    if file.suffix == ".ogpc":
        asked = [NAMES[class_id] for class_id in TASKS[task]]
        labels, confidence, forced = asked_labels(file, xyz, asked, text_features)
    else:
        labels, confidence, asked = stored_labels(file)
    if len(labels) != len(xyz):
        raise OgPointcloudError(f"{file} has {len(labels)} labels, the scene {len(xyz)} points; expected one each")
    if len(labels) and labels.max() >= len(asked):
        raise OgPointcloudError(f"{file}: label {labels.max()} has no name (there are {len(asked)})")
    ids = {name: class_id for class_id, name in NAMES.items()}
    # A name that is no class of the table stays an answer, and a wrong one.
    table = np.array([*(ids.get(name, NOT_OF_THE_TABLE) for name in asked), 0])
    strange = frozenset(asked[label] for label in np.unique(labels[labels >= 0]) if asked[label] not in ids)
    return Predicted(
        table[np.maximum(labels, -1)], confidence, None if forced is None else table[np.maximum(forced, -1)], strange
    )


def asked_labels(
    file: Path, xyz: NDArray[np.float64], names: list[str], text_features: Path | None
) -> tuple[NDArray[np.integer], NDArray[np.floating], NDArray[np.integer]]:
    """(n,) labels, how sure they are, and the labels of a scene that may not say that none fits: the largest cosine."""
    from og_pointcloud.ask.choosing import Chooser
    from og_pointcloud.ask.labelled_scene import as_scene, segment
    from og_pointcloud.evaluate.captures import sure
    from og_pointcloud.text.words import resolve_labels

    scene = as_scene(file)
    words = resolve_labels(names, text_features, scene.vocabulary, scene.feature_space, scene.path)
    result = segment(xyz, words, scene=scene)
    forced = Chooser(scene.cloud.instances).choose(words.vectors).at(result.instances)[0]
    return result.labels, sure(result.scores, result.calibrated, result.certainty), forced


def stored_labels(file: Path) -> tuple[NDArray[np.integer], NDArray[np.floating] | None, list[str]]:
    """(n,) indices of names, below 0 unknown; (n,) how sure they are, if that is said; the names. As ``segment -o``
    writes: scores, and where it is known the certainty of each point."""
    import numpy as np

    from og_pointcloud.evaluate.arrays import read_arrays
    from og_pointcloud.evaluate.captures import sure

    arrays = read_arrays(file)
    missing = [name for name in ("labels", "names") if name not in arrays]
    if missing:
        raise OgPointcloudError(f"{file} lacks '{missing[0]}'; expected labels and names: segment the scene again")
    labels, names, scores = arrays["labels"], arrays["names"], arrays.get("scores")
    if labels.ndim != 1 or labels.dtype.kind not in "iu" or names.ndim != 1 or names.dtype.kind != "U":
        raise OgPointcloudError(
            f"{file}: labels are {labels.dtype} {labels.shape}, names {names.dtype} {names.shape}; expected whole "
            "numbers (points,) and strings (names,)"
        )
    certainty = arrays.get("certainty")
    for name, numbers in (("scores", scores), ("certainty", certainty)):
        if numbers is None:
            continue
        if numbers.shape != labels.shape or numbers.dtype.kind != "f" or np.isnan(numbers).any():
            raise OgPointcloudError(
                f"{file}: {name} are {numbers.dtype} {numbers.shape}; expected numbers {labels.shape}"
            )
    if scores is not None and certainty is not None:
        scores = sure(scores, bool(arrays.get("calibrated", False)), certainty)
    return labels.astype(np.int64), scores, names.tolist()


def opacities(folder: Path | None, scene: str, count: int) -> NDArray[np.floating] | None:
    if folder is None:
        return None
    from og_pointcloud.formats.points import read_points

    points = read_points(folder / f"{scene}.ply")
    if points.opacity is None or len(points) != count:
        kind = "Gaussians" if points.are_gaussians else "points without opacity"
        raise OgPointcloudError(
            f"{folder / scene}.ply has {len(points)} {kind}; expected a Gaussian for each of the scene's {count} "
            "points, in their order"
        )
    return points.opacity
