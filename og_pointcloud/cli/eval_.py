"""``og-pointcloud eval``: scores by the protocols of published tables, from the data sets' own files."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from og_pointcloud.cli.common import Parser, add_command, check_outputs, names_in, print_table, write_json
from og_pointcloud.errors import OgPointcloudError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from og_pointcloud.scoring.scannet import SceneScore

LABELS = "_vh_clean_2.labels.ply"
NOT_OF_THE_TABLE = 40
"""NYU40's "other property", which no task asks for."""
MAX_LABEL_BYTES = 1 << 31


def add(commands: Any) -> None:
    parser = add_command(
        commands, "eval", None, "Score labels by the protocol of a published table, from the data set's own files.",
        "og-pointcloud eval scannet scans --predictions fitted",
    )  # fmt: skip
    protocols = parser.add_subparsers(dest="protocol", required=True, metavar="PROTOCOL", parser_class=Parser)
    scannet = add_command(
        protocols, "scannet", run_scannet,
        "ScanNet point segmentation with 19, 15 and 10 classes; unknown counts as wrong, and beside it as abstention.",
        "og-pointcloud eval scannet scans --predictions fitted --json scores.json",
    )  # fmt: skip
    scannet.add_argument("folder", type=Path, metavar="DIR", help=f"folder of scene folders with <scene>{LABELS}")
    scannet.add_argument(
        "--predictions", type=Path, required=True, metavar="P",
        help="folder with <scene>.ogpc, which is asked, or <scene>.npz, from `segment -o` for the labels' points",
    )  # fmt: skip
    scannet.add_argument("--text-features", type=Path, metavar="F.npz", help="names and vectors for .ogpc predictions")
    scannet.add_argument(
        "--gaussians",
        type=Path,
        metavar="G",
        help="folder with <scene>.ply, whose points of opacity below 0.1 are ignored",
    )
    scannet.add_argument("--scenes", metavar="A,B", help="these scenes (default: all in DIR)")
    scannet.add_argument("--json", type=Path, metavar="F.json", help="also write every score")


def run_scannet(arguments: argparse.Namespace) -> None:
    check_outputs({"--json": (arguments.json, [".json"])}, inputs=[arguments.text_features])
    import numpy as np

    from og_pointcloud.scoring.scannet import SCENES, TASKS, average, read_truth, score_scene
    from og_pointcloud.scoring.spread import bootstrap

    files = truth_files(arguments.folder, names_in(arguments.scenes))
    predictions = {scene: prediction_file(arguments.predictions, scene) for scene in files}
    scores: dict[int, dict[str, SceneScore]] = {task: {} for task in TASKS}
    for scene, file in files.items():
        xyz, truth = read_truth(file)
        opacity = opacities(arguments.gaussians, scene, len(truth))
        for task in TASKS:
            predicted = predicted_ids(predictions[scene], xyz, task, arguments.text_features)
            scores[task][scene] = score_scene(predicted, truth, task, opacity)
    rows, report = [], {}
    for task, of_scenes in scores.items():
        values = list(of_scenes.values())
        mean = average(values)
        per_scene = [score.protocol.miou for score in values if score.protocol.classes]
        interval = bootstrap(np.array(per_scene)) if per_scene else None
        rows.append((f"{task} classes", *map(percent, columns(values, mean)), spread(interval)))
        report[str(task)] = {
            "miou": mean.miou, "macc": mean.macc, "flat_miou": mean.flat_miou,
            "interval": [interval.low, interval.high] if interval else None,
            "scenes": {scene: describe(score) for scene, score in of_scenes.items()},
        }  # fmt: skip
    print_table(("", "mIoU", "mAcc", "flat mIoU", "all points", "answered", "share answered", "95 % of mIoU"), rows)
    published = sum(scene in SCENES for scene in files)
    print(f"{len(files)} scenes, {published} of the {len(SCENES)} of the published table; intervals are over scenes")
    if arguments.gaussians is None:
        print("no --gaussians: transparent points are not ignored, so mIoU is that of all points")
    if arguments.json:
        write_json(arguments.json, report)
        print(f"wrote {arguments.json}")


def columns(scores: Sequence[SceneScore], mean: Any) -> list[float]:
    import numpy as np

    def over_scenes(values: list[float]) -> float:
        finite = [value for value in values if np.isfinite(value)]
        return float(np.mean(finite)) if finite else float("nan")

    others = (
        [s.all_points.miou for s in scores],
        [s.answered.miou for s in scores],
        [s.answered_share for s in scores],
    )
    return [mean.miou, mean.macc, mean.flat_miou, *map(over_scenes, others)]


def percent(value: float) -> str:
    return f"{100 * value:.1f}"


def spread(interval: Any) -> str:
    return f"{percent(interval.low)} to {percent(interval.high)}" if interval else "-"


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


def prediction_file(folder: Path, scene: str) -> Path:
    files = [folder / f"{scene}{ending}" for ending in (".ogpc", ".npz")]
    file = next((file for file in files if file.is_file()), None)
    if file is None:
        raise OgPointcloudError(
            f"{folder} has neither {files[0].name} nor {files[1].name}: a mean over other scenes is another figure; "
            "fit that scene, or name the scenes to score (--scenes)"
        )
    return file


def predicted_ids(file: Path, xyz: NDArray[np.float64], task: int, text_features: Path | None) -> NDArray[np.int64]:
    """(n,) NYU40 ids, 0 unknown: a bundle is asked for the task's names, stored labels are taken by their names."""
    import numpy as np

    from og_pointcloud.scoring.scannet import NAMES, TASKS

    if file.suffix == ".ogpc":
        from og_pointcloud.runtime import segment

        names = [NAMES[class_id] for class_id in TASKS[task]]
        result = segment(xyz, names, scene=file, text_features=text_features)
        labels, asked = result.labels, names
    else:
        labels, asked = stored_labels(file)
    if len(labels) != len(xyz):
        raise OgPointcloudError(f"{file} has {len(labels)} labels, the scene {len(xyz)} points; expected one each")
    if len(labels) and labels.max() >= len(asked):
        raise OgPointcloudError(f"{file}: label {labels.max()} has no name (there are {len(asked)})")
    ids = {name: class_id for class_id, name in NAMES.items()}
    # A name that is no class of the table stays an answer, and a wrong one.
    table = np.array([*(ids.get(name, NOT_OF_THE_TABLE) for name in asked), 0])
    return table[np.maximum(labels, -1)]


def stored_labels(file: Path) -> tuple[NDArray[np.int32], list[str]]:
    """(n,) indices of names, below 0 unknown, and the names, as ``segment -o`` stores them."""
    import zipfile

    import numpy as np

    try:
        with zipfile.ZipFile(file) as archive:
            if (total := sum(entry.file_size for entry in archive.infolist())) > MAX_LABEL_BYTES:
                raise OgPointcloudError(f"{file} unpacks to {total} bytes; expected at most {MAX_LABEL_BYTES}")
        with np.load(file, allow_pickle=False) as arrays:
            labels, names = arrays["labels"], [str(name) for name in arrays["names"]]
    except (zipfile.BadZipFile, KeyError, ValueError, OSError) as error:
        if isinstance(error, OgPointcloudError):
            raise
        raise OgPointcloudError(
            f"{file} cannot be read as labels and names ({error}): segment the scene again"
        ) from None
    if labels.ndim != 1 or labels.dtype.kind not in "iu":
        raise OgPointcloudError(f"{file}: labels are {labels.dtype} {labels.shape}; expected whole numbers (points,)")
    return labels.astype(np.int32), names


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
