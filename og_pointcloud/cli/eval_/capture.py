"""``og-pointcloud eval capture``: labelled scenes against the truth that their captures bring."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from og_pointcloud.cli.common import add_command, check_outputs, print_table, write_json
from og_pointcloud.cli.eval_.common import percent, prediction_file, signed, spread
from og_pointcloud.errors import OgPointcloudError

if TYPE_CHECKING:
    from og_pointcloud.evaluate.blocks import BlockInterval
    from og_pointcloud.evaluate.captures import Answer, CaptureScore


def add(protocols: Any) -> None:
    parser = add_command(
        protocols, "capture", run,
        "A fitted capture against its own gt.npz: labels with their interval, risk against coverage, instances.",
        "og-pointcloud eval capture kitchen kitchen.ogpc --against kitchen_fast.ogpc --plot risk.png",
    )  # fmt: skip
    parser.add_argument("captures", type=Path, nargs="+", metavar="CAPTURE", help="folders with gt.npz")
    parser.add_argument("predictions", type=Path, metavar="S", help=".ogpc of the one CAPTURE, or folder with all")
    parser.add_argument("--against", type=Path, metavar="OTHER", help="as S: give the difference, S less OTHER, paired")
    parser.add_argument(
        "--text-features", type=Path, metavar="F.npz",
        help="names asked (default: the capture's text_features.npz, else the scene's own words)",
    )  # fmt: skip
    parser.add_argument("--plot", type=Path, metavar="F.png", help="risk against coverage, a line a scene")
    parser.add_argument("--json", type=Path, metavar="F.json", help="also write every score")


def run(arguments: argparse.Namespace) -> None:
    outputs = {"--json": (arguments.json, [".json"]), "--plot": (arguments.plot, [".png"])}
    check_outputs(outputs, inputs=[arguments.text_features, arguments.predictions, arguments.against])
    from og_pointcloud.evaluate.captures import ask, difference, score_capture
    from og_pointcloud.evaluate.plots import plot_risk_coverage, require_matplotlib
    from og_pointcloud.evaluate.truth import read_truth

    if arguments.plot:
        require_matplotlib()
    captures, against = arguments.captures, arguments.against
    names = [folder.resolve().name for folder in captures]
    if len(set(names)) < len(names):
        raise OgPointcloudError(f"two captures are called '{max(names, key=names.count)}'; expected names of their own")
    truths = {folder: read_truth(folder) for folder in captures}
    files = {folder: scene_file(arguments.predictions, folder, len(captures)) for folder in captures}
    others = {folder: scene_file(against, folder, len(captures)) for folder in captures} if against else {}
    rows, report, curves, shares = [], {}, {}, {}
    for folder, truth in truths.items():
        name, words = folder.resolve().name, words_of(folder, arguments.text_features)
        answer = ask(files[folder], truth, words)
        score = score_capture(answer, truth)
        curves[name], shares[name] = score.curve, score.answered_share
        change = None
        if against:
            other = ask(others[folder], truth, words)
            change = difference(answer, other, truth)
            label = f"{name}, {others[folder].name}"
            second = score_capture(other, truth)
            curves[label], shares[label] = second.curve, second.answered_share
        rows.append(cells(name, score, change))
        report[name] = describe(score, answer, change)
    print_table(HEADER + (("less the other",) if against else ()), rows)
    print("unknown counts as wrong; 'answered' leaves it out. The 95 % are over cubes of each scene, not over points:")
    for name, entry in report.items():
        interval = entry["interval"]
        print(f"{name}: {interval['blocks']} cubes of {interval['edge'] / entry['spacing']:.0f} point spacings")
    if arguments.plot:
        plot_risk_coverage(curves, shares, arguments.plot)
        print(f"wrote {arguments.plot}")
    if arguments.json:
        write_json(arguments.json, report)
        print(f"wrote {arguments.json}")


HEADER = (
    "", "mIoU", "95 %", "mAcc", "unknown", "background called", "answered", "share answered", "risk area", "AP50",
    "PQ", "ARI",
)  # fmt: skip


def cells(name: str, score: CaptureScore, change: BlockInterval | None) -> tuple[str, ...]:
    labels, things = score.labels, score.instances
    return (
        name, percent(labels.miou), spread(score.interval), percent(labels.macc), percent(labels.unknown_share),
        percent(labels.background_called), percent(score.answered.miou if score.answered.classes else None),
        percent(score.answered_share), f"{score.curve.area:.4f}", percent(things and things.of_class.ap50),
        percent(things and things.panoptic.quality), f"{things.rand:.3f}" if things else "-",
        *((signed(change),) if change else ()),
    )  # fmt: skip


def describe(score: CaptureScore, answer: Answer, change: BlockInterval | None) -> dict[str, Any]:
    """All scores of a capture as JSON; shares, not percent. NaN, where nothing was to be scored, becomes null."""
    entry = {
        "labels": asdict(score.labels),
        "interval": asdict(score.interval),
        "answered": asdict(score.answered),
        "answered_share": score.answered_share,
        "risk_area": score.curve.area,
        "instances": asdict(score.instances) if score.instances else None,
        "spacing": answer.spacing,
        "less_the_other": asdict(change) if change else None,
    }
    return without_nan(entry)


def without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: without_nan(inner) for name, inner in value.items()}
    return None if isinstance(value, float) and value != value else value


def scene_file(predictions: Path, capture: Path, captures: int) -> Path:
    """The labelled scene of a capture: the file, where there is one capture, or the file of its name in the folder."""
    if predictions.is_dir():
        return prediction_file(predictions, capture.resolve().name, (".ogpc",))
    if captures > 1:
        raise OgPointcloudError(f"{predictions} is one file for {captures} captures; expected a folder with one each")
    if predictions.suffix != ".ogpc" or not predictions.is_file():
        raise OgPointcloudError(f"{predictions} is no .ogpc file; expected one: og-pointcloud fit {capture} -o S.ogpc")
    return predictions


def words_of(capture: Path, text_features: Path | None) -> Path | None:
    own = capture / "text_features.npz"
    return text_features or (own if own.is_file() else None)
