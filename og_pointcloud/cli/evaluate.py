"""Score labels against a data set's, or a capture's, own truth.

og-pointcloud eval capture kitchen kitchen.ogpc
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from og_pointcloud.cli.common import Parser, add_command, add_output, names_in, print_table, replaceable, write_json
from og_pointcloud.errors import OgPointcloudError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from og_pointcloud.evaluate.captures import CaptureScore
    from og_pointcloud.evaluate.intervals import BlockInterval, Interval
    from og_pointcloud.evaluate.lerf import PairScore
    from og_pointcloud.evaluate.scannet import SceneScore

    LerfScores = dict[str, list[PairScore]]

SCANNET_LABELS = "_vh_clean_2.labels.ply"
CAPTURE_HEADER = (
    "", "mIoU", "95 %", "mAcc", "unknown", "background called", "answered", "share answered", "risk area", "AP50",
    "ARI",
)  # fmt: skip
SCANNET_HEADER = (
    "", "mIoU", "mAcc", "forced", "flat mIoU", "answered", "share answered", "risk area", "95 % of mIoU",
)  # fmt: skip


def add(parser: Parser) -> None:
    protocols = parser.add_subparsers(dest="protocol", required=True, metavar="PROTOCOL", parser_class=Parser)
    capture, scannet, lerf = (
        add_command(protocols, run.__name__.removeprefix("run_"), run, run.__doc__)
        for run in (run_capture, run_scannet, run_lerf)
    )
    add_path(capture, "captures", "CAPTURE", "folders with gt.npz", nargs="+")
    add_path(capture, "predictions", "S", ".ogpc of the one CAPTURE, or folder with all")
    add_path(scannet, "folder", "DIR", f"scene folders with <scene>{SCANNET_LABELS}")
    add_path(scannet, "--predictions", "P", "folder with <scene>.ogpc, or <scene>.npz from `segment -o`", required=True)
    add_path(scannet, "--gaussians", "G", "folder with <scene>.ply, whose points of opacity below 0.1 are ignored")
    add_path(lerf, "folder", "DIR", "with <scene>/sparse/0 and label/<scene>/*.json")
    add_path(lerf, "--predictions", "P", "folder with <scene>.ogpc", required=True)
    add_path(
        lerf, "--gaussians", "G", "folder with <scene>.ply, or <scene>/point_cloud/iteration_*/: what was fitted",
        required=True,
    )  # fmt: skip
    lerf.add_argument("--oracle", action="store_true", help="also the best instance there is for each pair (slow)")
    for data_set in (scannet, lerf):
        data_set.add_argument("--scenes", metavar="A,B", help="these scenes (default: all with labels in DIR)")
    for protocol in (capture, scannet):
        add_output(protocol, "--plot", endings=(".png",), help="risk against coverage")
    for protocol in (capture, scannet, lerf):
        add_path(protocol, "--against", "OTHER", "as the predictions: also the difference, less OTHER, paired")
        add_path(
            protocol, "--text-features", "F.npz",
            "names asked and their vectors (default: the capture's text_features.npz, else the scene's own words)",
        )  # fmt: skip
        add_output(protocol, "--json", endings=(".json",), help="also write every score")


def add_path(parser: Parser, name: str, metavar: str, help: str, **settings: Any) -> None:
    parser.add_argument(name, type=replaceable, metavar=metavar, help=help, **settings)


# Captures -------------------------------------------------------------------------------------------------------


def run_capture(arguments: argparse.Namespace) -> None:
    """Score a fitted capture against its own gt.npz: labels with their interval, risk, coverage, instances.

    og-pointcloud eval capture kitchen kitchen.ogpc --against kitchen_fast.ogpc --plot risk.png
    """
    require_plots(arguments)
    from og_pointcloud.evaluate.captures import ask, difference, score_capture
    from og_pointcloud.evaluate.truth import read_truth

    captures, against = arguments.captures, arguments.against
    names = [folder.resolve().name for folder in captures]
    if len(set(names)) < len(names):
        raise OgPointcloudError(f"two captures are called '{max(names, key=names.count)}'; expected names of their own")
    truths = {folder: read_truth(folder) for folder in captures}
    files = {folder: scene_file(arguments.predictions, folder, len(captures)) for folder in captures}
    others = {folder: scene_file(against, folder, len(captures)) for folder in captures} if against else {}
    rows, report, curves = [], {}, {}
    for name, (folder, truth) in zip(names, truths.items(), strict=True):
        own_words = folder / "text_features.npz"
        words = arguments.text_features or (own_words if own_words.is_file() else None)
        answer = ask(files[folder], truth, words)
        score = score_capture(answer, truth)
        curves[name] = score.curve, score.answered_share
        change = None
        if against:
            other = ask(others[folder], truth, words)
            change = difference(answer, other, truth)
            second = score_capture(other, truth)
            curves[f"{name}, {others[folder].name}"] = second.curve, second.answered_share
        rows.append(capture_cells(name, score, change))
        report[name] = {
            **asdict(score),
            "risk_area": score.curve.area,
            "spacing": answer.spacing,
            "less_the_other": asdict(change) if change else None,
        }
        del report[name]["curve"]
    print_table(CAPTURE_HEADER + (("less the other",) if against else ()), rows)
    print("unknown counts as wrong; 'answered' leaves it out. The 95 % are over cubes of each scene, not over points:")
    for name, entry in report.items():
        interval = entry["interval"]
        print(f"{name}: {interval['blocks']} cubes of {interval['edge'] / entry['spacing']:.0f} point spacings")
    write_files(arguments, report, curves)


def capture_cells(name: str, score: CaptureScore, change: BlockInterval | None) -> tuple[str, ...]:
    labels, things = score.labels, score.instances
    return (
        name, percent(labels.miou), spread(score.interval), percent(labels.macc), percent(labels.unknown_share),
        percent(labels.background_called), percent(score.answered.miou if score.answered.classes else None),
        percent(score.answered_share), f"{score.curve.area:.4f}", percent(things and things.of_class.ap50),
        f"{things.rand:.3f}" if things else "-",
        *((signed(change),) if change else ()),
    )  # fmt: skip


def scene_file(predictions: Path, capture: Path, captures: int) -> Path:
    """The labelled scene of a capture: the file, where there is one capture, or the file of its name in the folder."""
    if predictions.is_dir():
        return prediction_file(predictions, capture.resolve().name, (".ogpc",))
    if captures > 1:
        raise OgPointcloudError(f"{predictions} is one file for {captures} captures; expected a folder with one each")
    if predictions.suffix != ".ogpc" or not predictions.is_file():
        raise OgPointcloudError(f"{predictions} is no .ogpc file; expected one: og-pointcloud fit {capture} -o S.ogpc")
    return predictions


# ScanNet --------------------------------------------------------------------------------------------------------


def run_scannet(arguments: argparse.Namespace) -> None:
    """ScanNet with 19, 15 and 10 classes; unknown counts as wrong, and beside it as abstention.

    og-pointcloud eval scannet scans --predictions fitted --json scores.json
    """
    require_plots(arguments)
    from og_pointcloud.evaluate.scannet import SCENES, TASKS, risk_over_scenes

    files = scannet_truths(arguments.folder, names_in(arguments.scenes))
    folders = [folder for folder in (arguments.predictions, arguments.against) if folder]
    predictions = [{scene: prediction_file(folder, scene) for scene in files} for folder in folders]
    results = [score_scans(files, found, arguments) for found in predictions]
    rows, report = [], {}
    for task in TASKS:
        row, report[str(task)] = scannet_row(task, *(scores[task] for scores in results))
        rows.append(row)
    print_table(SCANNET_HEADER + (("less the other",) if arguments.against else ()), rows)
    published = sum(scene in SCENES for scene in files)
    print(f"{len(files)} scenes, {published} of the {len(SCENES)} of the published table; intervals are over scenes")
    if arguments.gaussians is None:
        print("no --gaussians: transparent points are not ignored")
    found = {
        str(folder): risk_over_scenes(list(scores[max(TASKS)].values()))
        for folder, scores in zip(folders, results, strict=True)
    }
    curves = {name: (curve, answered) for name, (curve, answered) in found.items() if curve}
    if arguments.plot and not curves:
        raise OgPointcloudError("no prediction has scores, so there is no risk against coverage to plot (--plot)")
    write_files(arguments, report, curves, f"ScanNet, {max(TASKS)} classes")


def score_scans(
    truths: Mapping[str, Path], predictions: Mapping[str, Path], arguments: argparse.Namespace
) -> dict[int, dict[str, SceneScore]]:
    """Every task of every scene."""
    from og_pointcloud.evaluate.scannet import TASKS, read_prediction, read_truth, score_scene

    scores = {task: {} for task in TASKS}
    for scene, file in truths.items():
        xyz, truth = read_truth(file)
        opacity = opacities(arguments.gaussians, scene, len(truth))
        for task, of_task in scores.items():
            found = read_prediction(predictions[scene], xyz, task, arguments.text_features)
            of_task[scene] = score_scene(found.ids, truth, task, opacity, found.confidence, found.forced)
    return scores


def scannet_row(
    task: int, scenes: Mapping[str, SceneScore], other: Mapping[str, SceneScore] | None = None
) -> tuple[tuple[str, ...], dict[str, Any]]:
    """A row of the table, and the same with every scene as JSON. other: of the predictions to compare with."""
    import numpy as np

    from og_pointcloud.evaluate.intervals import bootstrap, paired_bootstrap
    from og_pointcloud.evaluate.scannet import average, risk_over_scenes

    values = list(scenes.values())
    mean, (curve, _) = average(values), risk_over_scenes(values)
    per_scene = np.array([score.protocol.miou for score in values])
    interval = bootstrap(per_scene) if mean.scenes else None
    change = None
    if other and mean.scenes:
        change = paired_bootstrap(per_scene, np.array([score.protocol.miou for score in other.values()]))
    row = (
        f"{task} classes", *map(percent, (mean.miou, mean.macc, mean.forced_miou, mean.flat_miou)),
        percent(mean.answered), percent(mean.answered_share), f"{curve.area:.4f}" if curve else "-", spread(interval),
        *([] if other is None else [signed(change) if change else "-"]),
    )  # fmt: skip
    entry = {
        **{name: getattr(mean, name) for name in ("miou", "macc", "forced_miou", "flat_miou")},
        "risk_area": curve.area if curve else None,
        "interval": [interval.low, interval.high] if interval else None,
        "less_the_other": [change.mean, change.low, change.high] if change else None,
        "scenes": {
            scene: {
                **{name: getattr(score.protocol, name) for name in ("miou", "macc", "points")},
                "class_iou": dict(zip(map(str, score.protocol.classes), score.protocol.class_iou, strict=True)),
                "answered_miou": score.answered.miou,
                "answered_share": score.answered_share,
            }
            for scene, score in scenes.items()
        },
    }
    return row, entry


def scannet_truths(folder: Path, scenes: list[str] | None) -> dict[str, Path]:
    """Scene name -> its labels, in the folder or in the scene's own folder below it."""
    files = (*folder.glob(f"*{SCANNET_LABELS}"), *folder.glob(f"*/*{SCANNET_LABELS}"))
    found = {file.name.removesuffix(SCANNET_LABELS): file for file in files}
    if not found:
        raise OgPointcloudError(f"{folder} has no <scene>/<scene>{SCANNET_LABELS}; expected ScanNet's folder of scenes")
    return {scene: found[scene] for scene in known_scenes(folder, sorted(found), scenes)}


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


# LeRF-OVS -------------------------------------------------------------------------------------------------------


def run_lerf(arguments: argparse.Namespace) -> None:
    """LeRF-OVS: select by text, render, compare with the outlined objects (mIoU, IoU over 0.25).

    og-pointcloud eval lerf lerf_ovs --predictions fitted --gaussians trained --text-features words.npz
    """
    from og_pointcloud.evaluate.intervals import paired_bootstrap
    from og_pointcloud.evaluate.lerf import ORACLE, WAYS, read_scene, scene_names

    # Everything is looked for before anything is rendered: what the last scene lacks is named at once.
    wanted = known_scenes(arguments.folder, scene_names(arguments.folder), names_in(arguments.scenes))
    labels = [read_scene(arguments.folder, name) for name in wanted]
    folders = [folder for folder in (arguments.predictions, arguments.against) if folder]
    files = [[prediction_file(folder, name, (".ogpc",)) for name in wanted] for folder in folders]
    splats = [gaussians_file(arguments.gaussians, name) for name in wanted]
    ways = (*WAYS, ORACLE) if arguments.oracle else WAYS
    own, *others = (score_selections(labels, of_folder, splats, arguments) for of_folder in files)
    means = print_selections(own, ways)
    print_set(own)
    for way in ways[1:]:
        change = paired_bootstrap(pair_column(own, way), pair_column(own, ways[0]))
        print(f"{way} less {ways[0]}, mIoU of all pairs: {signed(change)}")
    for other in others:
        for way in ways:
            change = paired_bootstrap(pair_column(own, way), pair_column(other, way))
            print(f"{way}: less {arguments.against}, all pairs: {signed(change)}")
    scenes = {name: [asdict(pair) for pair in pairs] for name, pairs in own.items()}
    write_files(arguments, {"means": means, "scenes": scenes})


def score_selections(
    labels: Sequence[Any], files: list[Path], splats: list[Path], arguments: argparse.Namespace
) -> LerfScores:
    from og_pointcloud.ask.labelled_scene import load
    from og_pointcloud.evaluate.lerf import gaussians_of, score_pairs

    scenes: LerfScores = {}
    for of_scene, file, splat in zip(labels, files, splats, strict=True):
        scene = load(file)
        gaussians = gaussians_of(scene.cloud, splat)
        scenes[of_scene.name] = score_pairs(scene, of_scene, gaussians, arguments.text_features, arguments.oracle)
    return scenes


def pair_column(scenes: LerfScores, way: str) -> NDArray[np.float64]:
    """(pairs,) IoU in one way, of all scenes."""
    import numpy as np

    return np.array([pair.iou[way] for pairs in scenes.values() for pair in pairs])


def print_selections(scenes: LerfScores, ways: Sequence[str]) -> dict[str, dict[str, float]]:
    """A table with a row a scene and the means; these as JSON, by way."""
    from og_pointcloud.evaluate.intervals import bootstrap
    from og_pointcloud.evaluate.lerf import IOU_FOUND, score_scenes

    by_way = {way: {name: pair_column({name: pairs}, way) for name, pairs in scenes.items()} for way in ways}
    rows = []
    for name, pairs in scenes.items():
        cells = [(of[name].mean(), (of[name] > IOU_FOUND).mean()) if len(pairs) else (None,) * 2
                 for of in by_way.values()]  # fmt: skip
        rows.append((name, str(len(pairs)), *(percent(value) for cell in cells for value in cell)))
    means = [score_scenes(of) for of in by_way.values()]
    total = str(means[0].pairs)
    rows.append(("mean of scenes", total, *(percent(v) for mean in means for v in (mean.miou, mean.accuracy))))
    rows.append(("all pairs", total, *(percent(v) for mean in means for v in (mean.flat_miou, mean.flat_accuracy))))
    pooled = [pair_column(scenes, way) for way in ways]
    intervals = [bootstrap(column) for ious in pooled for column in (ious, (ious > IOU_FOUND).astype(float))]
    rows.append(("95 % of all pairs", "", *map(spread, intervals)))
    print_table(("", "pairs", *(f"{way} {what}" for way in ways for what in ("mIoU", "over 0.25"))), rows)
    return {way: asdict(mean) for way, mean in zip(ways, means, strict=True)}


def print_set(scenes: Mapping[str, Sequence[Any]]) -> None:
    """Whether the pairs are those of the published table."""
    from og_pointcloud.evaluate.lerf import PAIRS

    if {name: len(pairs) for name, pairs in scenes.items()} == dict(PAIRS):
        print("the scenes and pairs of the published table")
    else:
        published = ", ".join(f"{name} {count}" for name, count in PAIRS.items())
        print(f"not the set of the published table, whose pairs are {published}: its means are of others")


def gaussians_file(folder: Path, scene: str) -> Path:
    from og_pointcloud.formats.gaussian_ply import latest_iteration

    file = folder / f"{scene}.ply"
    found = file if file.is_file() else latest_iteration(folder / scene)
    if found is None:
        raise OgPointcloudError(
            f"{folder} has neither {scene}.ply nor {scene}/point_cloud/iteration_*/point_cloud.ply; expected the "
            "Gaussians that the scene was fitted from"
        )
    return found


# What the protocols share ---------------------------------------------------------------------------------------


def require_plots(arguments: argparse.Namespace) -> None:
    if arguments.plot:
        from og_pointcloud.evaluate.plots import require_matplotlib

        require_matplotlib()


def write_files(
    arguments: argparse.Namespace, report: Mapping[str, Any], curves: Mapping[str, Any] | None = None, title: str = ""
) -> None:
    """--plot and --json, where they were asked for. curves: name -> (risk against coverage, share answered)."""
    if curves and arguments.plot:
        from og_pointcloud.evaluate.plots import plot_risk_coverage

        answered = {name: share for name, (_, share) in curves.items()}
        plot_risk_coverage({name: curve for name, (curve, _) in curves.items()}, answered, arguments.plot, title)
        print(f"wrote {arguments.plot}")
    if arguments.json:
        write_json(arguments.json, without_nan(report))
        print(f"wrote {arguments.json}")


def without_nan(value: Any) -> Any:
    """NaN, where nothing was there to be scored, becomes null: JSON has no word for it."""
    if isinstance(value, Mapping):
        return {name: without_nan(inner) for name, inner in value.items()}
    return None if isinstance(value, float) and value != value else value


def known_scenes(folder: Path, known: list[str], wanted: list[str] | None) -> list[str]:
    missing = [name for name in wanted or () if name not in known]
    if missing:
        raise OgPointcloudError(f"{folder} has no labels of '{missing[0]}'; it has {', '.join(known[:4])}")
    return wanted or known


def prediction_file(folder: Path, scene: str, endings: Sequence[str] = (".ogpc", ".npz")) -> Path:
    """The file of one scene in a folder of them; a missing one is an error."""
    files = [folder / f"{scene}{ending}" for ending in endings]
    file = next((file for file in files if file.is_file()), None)
    if file is None:
        names = " nor ".join(file.name for file in files)
        raise OgPointcloudError(
            f"{folder} has {'neither ' if len(files) > 1 else 'no '}{names}: a mean over other scenes is another "
            "figure; fit that scene, or name the scenes to score"
        )
    return file


def percent(value: float | None) -> str:
    return "-" if value is None or value != value else f"{100 * value:.1f}"


def spread(interval: Interval | None) -> str:
    return f"{percent(interval.low)} to {percent(interval.high)}" if interval else "-"


def signed(interval: Interval) -> str:
    """A difference with its interval, in points of percent."""
    return f"{100 * interval.mean:+.1f} ({100 * interval.low:+.1f} to {100 * interval.high:+.1f})"
