"""The tables of results in README.md, measured and written between their HTML comments.

    python scripts/write_results.py CAPTURE [CAPTURE ...] --rooms 0,1,2,3,4,5 --photographs 0,1
    python scripts/write_results.py --modes out/modes/modes.csv          # from examples/benchmark_modes.py
    python scripts/write_results.py CAPTURE --print                      # to the terminal alone

Every row is measured by ``examples/score_captures.py``, which prints it too. Rooms are those of ``og-pointcloud demo``,
made once in the output folder; they share a line, whose interval is over rooms. With --photographs a room is labelled
from its images alone: masks by OpenCV, features and typed words by the demo encoder; its seconds include the masks.
"""

from __future__ import annotations

import argparse
import csv
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "examples"))

from benchmark_modes import rooms  # noqa: E402  # pyright: ignore[reportMissingImports]
from score_captures import (  # noqa: E402  # pyright: ignore[reportMissingImports]
    BANK,
    COMMAND,
    WORDS,
    CaptureRow,
    measure,
    print_row,
)

from og_pointcloud.evaluate.intervals import Interval, bootstrap  # noqa: E402
from og_pointcloud.evaluate.intervals import Interval as Spread  # noqa: E402
from og_pointcloud.evaluate.truth import read_truth  # noqa: E402
from og_pointcloud.formats.atomic import replacing  # noqa: E402
from og_pointcloud.text.encoder import DEMO_ENCODER, read_text_encoder  # noqa: E402

README = ROOT / "README.md"
ABOUT = {
    "seven_redkitchen": "7-Scenes red kitchen",
    "apc_shelf_B": "Princeton APC shelf bin",
    "ycb_0050": "YCB-Video table",
    "nuscenes_frame": "nuScenes, LiDAR",
}
"""What is said of a capture, by the name of its folder."""
SHORT = {"seven_redkitchen": "kitchen", "apc_shelf_B": "shelf", "ycb_0050": "table", "nuscenes_frame": "nuScenes"}
HEADER = (
    "scene", "mIoU (95 %)", "direct uplift", "where masked", "gain (95 %)", "mAcc", "unknown", "background called",
    "folder to file", "file", "first answer",
)  # fmt: skip


def main(arguments: list[str] | None = None) -> None:
    """Measure, print and write."""
    options = parse(arguments)
    for name in () if options.print else ("results", "modes"):
        around(options.readme, name)  # a page without its comments is told of before minutes are spent
    if options.modes:
        with options.modes.open(newline="") as file:
            table = modes_table(list(csv.DictReader(file)))
        publish("modes", table, options)
    if not (options.captures or options.rooms or options.photographs):
        return
    options.output.mkdir(parents=True, exist_ok=True)
    lines = [line(about(row), row) for row in measured(options.captures, options.runs)]
    made = measured(rooms(options.rooms, options.output), options.runs)
    lines += [line_of_rooms(made)] if made else []
    for seed, room in zip(options.photographs, rooms(options.photographs, options.output), strict=True):
        seconds = photograph(room, options.output / f"photographs{seed}")
        (row,) = measured([options.output / f"photographs{seed}"], options.runs)
        said = f"demo room {seed}, from photographs alone"
        lines.append(line(said, replace(row, fit_s=row.fit_s + seconds)))
    publish("results", markdown(HEADER, lines), options)


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="*", type=Path, metavar="CAPTURE")
    parser.add_argument("--rooms", type=_numbers, default=[], help="seeds of demo rooms, e.g. 0,1,2")
    parser.add_argument("--photographs", type=_numbers, default=[], help="seeds of rooms labelled from images alone")
    parser.add_argument("--runs", type=int, default=3, help="of what is timed; the least seconds are kept")
    parser.add_argument("--modes", type=Path, metavar="F.csv", help="write the table of modes from this file")
    parser.add_argument("--print", action="store_true", help="leave README.md as it is")
    parser.add_argument("--readme", type=Path, default=README, help="the page (default: this project's README.md)")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/results"), help="folder of the rooms")
    options = parser.parse_args(arguments)
    if not (options.captures or options.rooms or options.photographs or options.modes):
        parser.error("nothing to measure; expected captures, --rooms, --photographs or --modes")
    return options


def _numbers(text: str) -> list[int]:
    return [int(number) for number in text.split(",")]


def measured(folders: Iterable[Path], runs: int) -> list[CaptureRow]:
    """A row a capture, printed as soon as it is known."""
    rows = []
    for folder in folders:
        rows.append(measure(folder, runs))
        print_row(rows[-1])
    return rows


def photograph(room: Path, folder: Path) -> float:
    """Make a capture of a room's images alone, with the words to score it by; seconds of its masks."""
    truth = read_truth(room)
    start = time.perf_counter()
    command = [sys.executable, "-c", COMMAND, "masks", str(room), "--encoder", "demo", "--overwrite", "-o", str(folder)]
    subprocess.run(command, stdout=subprocess.DEVNULL, check=True)
    seconds = time.perf_counter() - start
    for name in (WORDS, BANK):  # links to the room's, which are of another encoder
        (folder / name).unlink(missing_ok=True)
    encoder = read_text_encoder(DEMO_ENCODER / "text")
    space = np.array(encoder.feature_space)
    np.savez(folder / WORDS, names=np.array(truth.names), vectors=encoder(truth.names), feature_space=space)
    return seconds


# The table of results ------------------------------------------------------------------------------------------


def about(row: CaptureRow) -> str:
    """What the first column says."""
    return f"{ABOUT.get(row.capture, row.capture)}, {row.views} views, {row.points:,} points"


def line(said: str, row: CaptureRow) -> tuple[str, ...]:
    """The cells of one capture."""
    score = row.score
    called = "-" if score.background_called is None else f"{score.background_called:.3f}"
    return (
        said, f"**{row.miou.mean:.3f}** ({_spread(row.miou)})", f"{row.uplift:.3f}", f"{row.masked:.3f}",
        f"{row.gain.mean:+.3f} ({_spread(row.gain, '+')})", f"{score.macc:.3f}", f"{score.unknown_share:.3f}", called,
        f"{row.fit_s:.1f} s", f"{row.file_mb:.1f} MB", f"{row.first_s:.2f} s",
    )  # fmt: skip


def line_of_rooms(rows: Sequence[CaptureRow]) -> tuple[str, ...]:
    """Rooms as one: means, and intervals over rooms."""

    def over(value: Callable[[CaptureRow], float]) -> Interval:
        return bootstrap(np.array([value(row) for row in rows]))

    miou, gain = over(lambda row: row.miou.mean), over(lambda row: row.gain.mean)
    points = np.mean([row.points for row in rows])
    return (
        f"mean of {len(rows)} demo rooms, {rows[0].views} views, {points:,.0f} points",
        f"**{miou.mean:.3f}** ({_spread(miou)})", f"{over(lambda row: row.uplift).mean:.3f}",
        f"{over(lambda row: row.masked).mean:.3f}",
        f"{gain.mean:+.3f} ({_spread(gain, '+')})", f"{over(lambda row: row.score.macc).mean:.3f}",
        f"{over(lambda row: row.score.unknown_share).mean:.3f}",
        f"{over(lambda row: row.score.background_called or 0.0).mean:.3f}", f"{over(lambda row: row.fit_s).mean:.1f} s",
        f"{over(lambda row: row.file_mb).mean:.1f} MB", f"{over(lambda row: row.first_s).mean:.2f} s",
    )  # fmt: skip


def _spread(interval: Spread, sign: str = "") -> str:
    return f"{interval.low:{sign}.3f} to {interval.high:{sign}.3f}"


# The table of modes --------------------------------------------------------------------------------------------


def modes_table(rows: Sequence[dict[str, str]]) -> str:
    """mIoU, and seconds after the mask table, of the lines that examples/benchmark_modes.py wrote; rooms as one."""

    def column(row: dict[str, str]) -> str:
        name = row["capture"]
        return "demo rooms" if name.startswith("room") else SHORT.get(name, name)

    columns = list(dict.fromkeys(map(column, rows)))
    lines = []
    for mode in dict.fromkeys(row["mode"] for row in rows):
        own = [[row for row in rows if row["mode"] == mode and column(row) == name] for name in columns]
        shares = {float(row["schedule_share"]) for cell in own for row in cell}
        cut = f", {100 * min(shares):.3g} % of its steps" if mode == "paper" and min(shares) < 1 else ""
        lines.append((f"`{mode}`{cut}", *(f"{_mean(c, 'miou'):.3f}, {_mean(c, 'own_s'):.1f} s" for c in own)))
        if cut:
            lines.append(("all of them, extrapolated", *(f"{_mean(c, 'published_s') / 60:.0f} min" for c in own)))
    return markdown(("", *columns), lines)


def _mean(rows: Sequence[dict[str, str]], field: str) -> float:
    return float(np.mean([float(row[field]) for row in rows]))


# Markdown ------------------------------------------------------------------------------------------------------


def markdown(header: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A table, its first column left, the others right."""
    rows = [header, ["---", *["---:"] * (len(header) - 1)], *lines]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def publish(name: str, table: str, options: argparse.Namespace) -> None:
    """Print a table, and write it into the page unless that is not wanted."""
    print(table)
    if not options.print:
        with_table(options.readme, name, table)
        print(f"wrote {options.readme}")


def with_table(page: Path, name: str, table: str) -> None:
    """Put a table between the comments of its name."""
    before, _, after = around(page, name)
    with replacing(page) as file:
        file.write(f"{before}\n{table}\n{after}".encode())


def around(page: Path, name: str) -> tuple[str, str, str]:
    """What stands before, between and after ``<!-- name -->`` and ``<!-- end of name -->``, these with the outer parts.

    ValueError where the page does not have them, each once and in this order.
    """
    first, last = f"<!-- {name} -->", f"<!-- end of {name} -->"
    text = page.read_text(encoding="utf-8")
    if text.count(first) != 1 or text.count(last) != 1 or text.index(last) < text.index(first):
        raise ValueError(f"{page} has not '{first}' and then '{last}', once each; expected the table between them")
    start, end = text.index(first) + len(first), text.index(last)
    return text[:start], text[start:end].strip(), text[end:]


if __name__ == "__main__":
    main()
