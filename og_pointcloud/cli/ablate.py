"""``og-pointcloud ablate``: the paper's ablations on captures with known labels."""

from __future__ import annotations

import argparse
import re
import shlex
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from og_pointcloud.cli.common import add_command, check_outputs, print_table, require_room
from og_pointcloud.errors import MissingExtraError, OgPointcloudError

if TYPE_CHECKING:
    from og_pointcloud.evaluate.ablation import AblationRow


def add(commands: Any) -> None:
    parser = add_command(
        commands, "ablate", run,
        "The paper's ablations (losses, codebook, association) on captures with known labels: table, CSV and plot.",
        "og-pointcloud ablate --room 1,2 -o out/ablation",
    )  # fmt: skip
    parser.add_argument(
        "captures", type=Path, nargs="*", metavar="CAPTURE", help="folders that also hold gt.npz and text_features.npz"
    )
    parser.add_argument("--room", metavar="SEED[,SEED]", help="made rooms, in place of captures or beside them")
    parser.add_argument("--seeds", type=int, default=1, metavar="N", help="runs of all that is random (default: 1)")
    parser.add_argument("--paper", action="store_true", help="also the rows trained by rendering, as published (slow)")
    parser.add_argument(
        "--schedule-share", type=float, metavar="X", help="of --paper: part of the published schedule (default: 0.05)"
    )
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("out/ablation"), metavar="DIR",
        help="folder for ablation.csv, ablation.png and the rooms (default: %(default)s)",
    )  # fmt: skip


def run(arguments: argparse.Namespace) -> None:
    seeds, share = room_seeds(arguments.room), arguments.schedule_share
    if not arguments.captures and not seeds:
        raise OgPointcloudError("no CAPTURE and no --room; expected at least one, e.g. --room 1,2")
    if share is not None and not arguments.paper:
        raise OgPointcloudError("--schedule-share is of --paper; expected both, or neither")
    if arguments.seeds < 1:
        raise OgPointcloudError(f"--seeds is {arguments.seeds}; expected at least 1")
    table, picture = arguments.output / "ablation.csv", arguments.output / "ablation.png"
    check_outputs({"-o": (table, [".csv"]), "the plot": (picture, [".png"])}, inputs=arguments.captures)
    if arguments.paper and find_spec("torch") is None:
        raise MissingExtraError("torch", "learn")
    from og_pointcloud.evaluate import ablation
    from og_pointcloud.evaluate.plots import require_matplotlib
    from og_pointcloud.evaluate.truth import read_truth
    from og_pointcloud.formats.capture import read_capture

    require_matplotlib()
    rows_wanted = ablation.cases()
    if arguments.paper:
        published = ablation.cases("paper", 0.05 if share is None else share)
        rows_wanted = [*published[: -len(ablation.references())], *rows_wanted]
    captures = [*arguments.captures, *(made_room(seed, arguments.output) for seed in seeds)]
    # All are read before the first is worked on: what is missing in the last is said at once.
    subjects = []
    for folder in captures:
        scene = read_capture(folder)
        truth, vocabulary = read_truth(folder), ablation.read_vocabulary(folder, scene.feature_space)
        ablation.check_subject(scene, truth, vocabulary)
        subjects.append((folder.name, scene, truth, vocabulary))
    rows = [
        ablation.ablate(
            scene, truth, vocabulary, only=rows_wanted, seeds=range(arguments.seeds), name=name,
            progress=sys.stderr.isatty(),
        )
        for name, scene, truth, vocabulary in subjects
    ]  # fmt: skip
    arguments.output.mkdir(parents=True, exist_ok=True)
    means = ablation.average(rows)
    every = [row for of_capture in rows for row in of_capture]
    ablation.write_csv([*every, *means] if len(rows) > 1 else means, table)
    ablation.plot(means, picture, title=", ".join(name for name, *_ in subjects))
    print_ablation(means)
    print(f"wrote {table}\nwrote {picture}")
    print(f"next: {next_fit_command(captures[0], arguments.output)}")


def room_seeds(text: str | None) -> list[int]:
    if text is None:
        return []
    if not re.fullmatch(r"\d{1,9}(,\d{1,9})*", text):
        raise OgPointcloudError(f"--room is '{text}'; expected whole numbers with commas between them, e.g. 1,2")
    return list(dict.fromkeys(int(seed) for seed in text.split(",")))


def made_room(seed: int, output: Path) -> Path:
    """A furnished room as a capture folder, small enough for many fits."""
    require_room()
    from og_pointcloud_room.capture import CaptureSettings, make_capture, write_capture

    settings = CaptureSettings(views=40, width=320, height=240, samples_per_view=20_000)
    return write_capture(make_capture(seed, settings), output / f"room-{seed}")


def print_ablation(rows: Sequence[AblationRow]) -> None:
    """A table a method and table of the paper; strict: with a class called on background as wrong."""
    print("paper: the same row's mIoU as published, on ScanNet: compare the order, not the size\n")
    header = ("", "mIoU", "+-", "paper", "mAcc", "unknown", "strict mIoU", "background called", "seconds", "clusters")
    for method, table in dict.fromkeys((row.method if row.table != "reference" else "", row.table) for row in rows):
        own = [row for row in rows if row.table == table and (table == "reference" or row.method == method)]
        cells = [
            (
                row.name, f"{row.miou:.3f}", number(row.miou_spread), number(row.published_miou), f"{row.macc:.3f}",
                f"{row.unknown_share:.3f}", number(row.strict_miou), number(row.background_called),
                f"{row.seconds:.2f}", f"{row.clusters:.0f}",
            )
            for row in own
        ]  # fmt: skip
        print_table((f"{table} ({method})" if method else table, *header[1:]), cells)
        print()


def number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def next_fit_command(capture: Path, output: Path) -> str:
    """A fit of the capture, which takes what an ablation compares."""
    return shlex.join(["og-pointcloud", "fit", str(capture), "-o", str(output / f"{capture.name}.ogpc")])
