"""``og-pointcloud segment``: points labelled by words."""

from __future__ import annotations

import argparse
import json
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from og_pointcloud.cli.common import SHOWN, add_command, calibration_hint, check_outputs, names_in, print_table, timed

if TYPE_CHECKING:
    from og_pointcloud.ask.segmentation import Segmentation


def add(commands: Any) -> None:
    parser = add_command(
        commands, "segment", run, "Label points by words: those of the fitted cloud, or of another one.",
        "og-pointcloud segment kitchen.ogpc --labels chair,table -o labels.npz",
    )  # fmt: skip
    parser.add_argument("bundle", type=Path, metavar="S.ogpc", help="what `fit` wrote")
    parser.add_argument("--labels", metavar="A,B,C", help="names to choose among (default: all that are known)")
    parser.add_argument("--text-features", type=Path, metavar="F.npz", help="names and vectors, from the same encoder")
    parser.add_argument(
        "--template", action="append", metavar="TEXT",
        help="what names are put into, such as 'a photo of a {}'; several are averaged; needs the text encoder",
    )  # fmt: skip
    parser.add_argument("--negatives", metavar="A,B,C", help="names too, but points that they fit better are unknown")
    parser.add_argument("--points", type=Path, metavar="CLOUD", help="points to label (default: those fitted)")
    parser.add_argument(
        "-o", "--output", type=Path, metavar="OUT", help="labels as .npz, or a coloured .ply, .las, .laz or .glb"
    )
    parser.add_argument("--json", action="store_true", help="print the counts as JSON")


def run(arguments: argparse.Namespace) -> None:
    from og_pointcloud.ask.segmentation import SAVED_AS

    check_outputs(
        {"-o": (arguments.output, SAVED_AS)},
        inputs=[arguments.bundle, arguments.text_features, arguments.points],
    )
    from og_pointcloud.ask.labelled_scene import load, segment

    stages: list[dict[str, Any]] = []
    with timed(stages, "load"):
        scene = load(arguments.bundle)
    with timed(stages, "segment"):
        result = segment(
            arguments.points or scene,
            names_in(arguments.labels),
            scene=scene,
            text_features=arguments.text_features,
            templates=arguments.template,
            negatives=names_in(arguments.negatives),
        )
    if arguments.output:
        with timed(stages, "save"):
            arguments.output.parent.mkdir(parents=True, exist_ok=True)
            result.save(arguments.output)
    report = describe_segmentation(result, stages, arguments.bundle, arguments.output)
    if arguments.json:
        print(json.dumps(report, indent=2, ensure_ascii=False))
    else:
        print_segmentation(report)


def describe_segmentation(
    result: Segmentation, stages: Sequence[Mapping[str, Any]], bundle: Path, output: Path | None
) -> dict[str, Any]:
    """What ``segment --json`` prints: points of each name, and why the others are unknown."""
    return {
        "bundle": str(bundle),
        "output": str(output) if output else None,
        "points": len(result),
        "counts": result.counts(),
        "unknown": int((result.labels < 0).sum()),
        "unknown_because": {str(reason): count for reason, count in result.unknown_because().items()},
        "calibrated": result.calibrated,
        "seconds": {stage["name"]: stage["seconds"] for stage in stages},
    }


def print_segmentation(report: Mapping[str, Any]) -> None:
    """The names that were found, in the order asked, and the share that stays unknown."""
    total = max(report["points"], 1)
    found = {name: count for name, count in report["counts"].items() if count}
    rows = [(name, f"{count:,}", f"{count / total:.1%}") for name, count in found.items()]
    rows.append(("unknown", f"{report['unknown']:,}", f"{report['unknown'] / total:.1%}"))
    print_table(("label", "points", "share"), rows)
    absent = [name for name in report["counts"] if name not in found]
    if absent:
        print(f"no point: {', '.join(absent[:SHOWN])}{', ...' if len(absent) > SHOWN else ''}")
    reasons = [f"{count:,} {reason}" for reason, count in report["unknown_because"].items()]
    if reasons:
        print(f"unknown: {', '.join(reasons)}")
    if not report["calibrated"]:
        print(
            "not calibrated: every instance gets its best label, however badly it fits. "
            f"{calibration_hint(report['bundle'])}"
        )
    print(", ".join(f"{name} {seconds:.2f} s" for name, seconds in report["seconds"].items()))
    if report["output"]:
        print(f"wrote {report['output']}")
    else:
        command = ["og-pointcloud", "segment", report["bundle"], "-o", str(Path(report["bundle"]).with_suffix(".ply"))]
        print(f"next: keep the labels with -o, e.g. {shlex.join(command)}")
