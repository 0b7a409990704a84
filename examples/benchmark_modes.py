"""Grouping, fast, auto and the paper's method on captures with ground truth: score, seconds, memory, in one table.

    python examples/benchmark_modes.py CAPTURE [CAPTURE ...] --rooms 0,1,2 -o out/modes
    python examples/benchmark_modes.py --row CAPTURE paper --schedule-share 0.03      # one row alone

Each row is a process of its own, after a discarded fit of a tiny scene in the same mode, so that compiled code is
loaded. Paper mode runs a share of its published schedule; its seconds at all of it are extrapolated from the steps
done. Its score is that of the steps done: at a few hundredths of them features have hardly left their random start.
Rooms are made once, in the output folder. What a capture must hold is said in score_captures.py. At the end the fast
forms are held against rendering on the first capture and on a made scene (benchmark_equality.py).
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmark_scaling import compile_once, in_own_process, peak_mb, timed_fit, warm_up, write_rows
from score_captures import score_of

import og_pointcloud as og
from og_pointcloud.settings import FitSettings, PaperSettings

COLOURS = {"grouping": "tab:blue", "fast": "tab:orange", "auto": "black", "paper": "tab:red"}
MODES = tuple(COLOURS)
MAKE_ROOM = """
import sys
from pathlib import Path
from og_pointcloud_room.capture import make_capture, write_capture
write_capture(make_capture(int(sys.argv[1])), Path(sys.argv[2]))
"""


@dataclass(frozen=True)
class ModeRow:
    """One mode on one capture.

    unknown: share of the labelled points without a label. chosen: the road that mode "auto" took. prepare_s, own_s,
    total_s, cpu_s: seconds of the shared stages, of the mode's own, of the whole fit, and of all cores together.
    steps: of learning, 0 where nothing is learned. published_steps, published_s: paper mode at its whole schedule,
    else as they are.
    """

    capture: str
    mode: str
    chosen: str
    miou: float
    macc: float
    unknown: float
    prepare_s: float
    own_s: float
    total_s: float
    cpu_s: float
    peak_mb: float
    steps: int
    schedule_share: float
    seconds_per_step: float
    published_steps: int
    published_s: float


def measure(folder: Path, mode: Any, share: float) -> ModeRow:
    """Fit and score a capture in this process."""
    settings = FitSettings(mode=mode, paper=PaperSettings(schedule_share=share))
    warm_up(settings)
    cloud, seconds = timed_fit(og.read_capture(folder), settings)
    peak = peak_mb()
    with tempfile.TemporaryDirectory() as temporary:
        bundle = Path(temporary) / "scene.ogpc"
        og.write_bundle(cloud, bundle)
        result = og.segment(og.load(bundle), None, text_features=folder / "text_features.npz")
    score = score_of(result.labels, result.names, folder)
    notes = cloud.provenance["notes"]
    training = notes.get("training", [])
    steps = sum(stage["steps"] for stage in training) + notes.get("feature_steps", 0)
    missing = [stage["published_steps"] - stage["steps"] for stage in training]
    extra_s = sum(count * stage["seconds_per_step"] for count, stage in zip(missing, training, strict=True))
    stepping_s = sum(stage["steps"] * stage["seconds_per_step"] for stage in training)
    return ModeRow(
        capture=folder.name,
        mode=mode,
        chosen=mode if mode != "auto" else "fast" if "feature_steps" in notes else "grouping",
        miou=score.miou,
        macc=score.macc,
        unknown=score.unknown_share,
        **seconds,
        peak_mb=peak,
        steps=steps,
        schedule_share=share if training else 1.0,
        seconds_per_step=stepping_s / steps if training else 0.0,
        published_steps=steps + sum(missing),
        published_s=seconds["total_s"] + extra_s,
    )


def rooms(seeds: Sequence[int], folder: Path) -> list[Path]:
    """Captures of the procedural rooms, made where they are not there yet, each in its own process."""
    made = [folder / f"room{seed}" for seed in seeds]
    for seed, room in zip(seeds, made, strict=True):
        if not (room / "gt.npz").exists():  # the last file that is written
            subprocess.run([sys.executable, "-c", MAKE_ROOM, str(seed), str(room)], check=True)
    return made


def compared(rows: Sequence[ModeRow]) -> list[str]:
    """Lines that say, per capture, where auto stands: against the best of the others, and against paper's seconds."""
    lines = ["capture            auto - best other (mode)   paper at its published schedule / auto, seconds"]
    for capture in dict.fromkeys(row.capture for row in rows):
        by_mode = {row.mode: row for row in rows if row.capture == capture}
        auto = by_mode.pop("auto", None)
        if auto is None or not by_mode:
            continue
        best = max(by_mode.values(), key=lambda row: row.miou)
        line = f"{capture:<18} {auto.miou - best.miou:+17.4f} ({best.mode})".ljust(46)
        if "paper" in by_mode:
            paper = by_mode["paper"]
            ratio = paper.published_s / auto.total_s
            line += f"{paper.published_s:8.0f} / {auto.total_s:.1f} = {ratio:.0f} ({paper.published_steps:,} steps)"
        lines.append(line)
    return lines


def plot(rows: Sequence[ModeRow], path: Path) -> None:
    """mIoU against seconds: a colour a mode, a marker a capture; below, the seconds of paper at its whole schedule."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.lines import Line2D
    from matplotlib.ticker import FuncFormatter

    captures = list(dict.fromkeys(row.capture for row in rows))
    marker = {capture: "os^DvPXp*h"[index % 10] for index, capture in enumerate(captures)}
    figure, panel = plt.subplots(figsize=(9.5, 5.5), layout="constrained")
    for row in rows:
        look = {"marker": marker[row.capture], "color": COLOURS[row.mode], "markersize": 8, "linestyle": "none"}
        if row.mode == "auto":  # it lies on top of what it chose
            look |= {"markerfacecolor": "none", "markersize": 13}
        panel.semilogx(row.total_s, row.miou, **look)
        if row.published_s > row.total_s:  # its score there is not known: on the axis
            panel.plot(row.published_s, 0, **look, alpha=0.4, transform=panel.get_xaxis_transform(), clip_on=False)
    shares = {row.schedule_share for row in rows if row.mode == "paper"}
    paper = (
        f"paper, {min(shares):.3g} of its steps\n(pale, on the axis: seconds\nof all, score not known)"
        if shares
        else "paper"
    )
    modes = [mode for mode in MODES if any(row.mode == mode for row in rows)]
    names = [paper if mode == "paper" else "auto (ring)" if mode == "auto" else mode for mode in modes]
    handles = [
        Line2D([], [], color=COLOURS[mode], linewidth=4, label=name) for mode, name in zip(modes, names, strict=True)
    ]
    handles += [
        Line2D([], [], color="0.4", marker=marker[capture], linestyle="none", label=capture) for capture in captures
    ]
    panel.legend(handles=handles, loc="center left", bbox_to_anchor=(1, 0.5), fontsize=8, frameon=False)
    panel.set(xlabel="seconds of the whole fit", ylabel="mIoU", ylim=(-0.03, 1.03))
    panel.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    panel.grid(color="0.9")
    figure.savefig(path, dpi=120)


def print_row(row: ModeRow) -> None:
    """One line of the table."""
    mode = f"{row.mode} ({row.chosen})" if row.mode == "auto" else row.mode
    line = (
        f"{row.capture:<17} {mode:<15} {row.miou:6.4f} {row.macc:6.4f} {row.unknown:8.4f} {row.prepare_s:9.1f} "
        f"{row.own_s:6.1f} {row.total_s:7.1f} {row.cpu_s:6.1f} {row.peak_mb:7.0f} {row.steps or '-':>6}"
    )
    if row.published_steps > row.steps:
        line += f" {row.schedule_share:6.3f} {1e3 * row.seconds_per_step:8.1f} {row.published_s:11.0f}"
    print(line, flush=True)


def parse() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="*", type=Path, metavar="CAPTURE")
    parser.add_argument("--rooms", default="", help="seeds of procedural rooms, e.g. 0,1,2")
    parser.add_argument("--modes", default=",".join(MODES), help="default: %(default)s")
    parser.add_argument("--schedule-share", type=float, default=0.03, help="share of paper mode's steps that is run")
    parser.add_argument("--repeats", type=int, default=1, help="runs of each row but paper's; the fastest is kept")
    parser.add_argument("--threads", type=int, default=2, help="threads of each fit")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/modes"), help="folder for CSV, PNG and rooms")
    parser.add_argument("--row", nargs=2, metavar=("CAPTURE", "MODE"), help="measure this alone, print JSON")
    arguments = parser.parse_args()
    arguments.modes = [mode for mode in arguments.modes.split(",") if mode]
    unknown = sorted({*arguments.modes} - {*MODES})
    if unknown:
        parser.error(f"--modes names {', '.join(unknown)}; expected some of {', '.join(MODES)}")
    if not (arguments.captures or arguments.rooms or arguments.row):
        parser.error("no capture and no room; expected at least one folder, or --rooms 0,1,2")
    return arguments


def main() -> None:
    """Measure all rows, or one; write table and plot; compare the fast forms with rendering."""
    arguments = parse()
    share = str(arguments.schedule_share)
    if arguments.row:
        folder, mode = arguments.row
        print(json.dumps(asdict(measure(Path(folder), mode, arguments.schedule_share))))
        return
    arguments.output.mkdir(parents=True, exist_ok=True)
    seeds = [int(seed) for seed in arguments.rooms.split(",") if seed]
    folders = [*arguments.captures, *rooms(seeds, arguments.output)]
    print(
        "capture           mode              mIoU   mAcc  unknown prepare s  own s total s  cpu s peak MB  steps"
        "  share  ms/step published s"
    )
    compile_once(arguments.modes, arguments.threads)
    rows = []
    for folder in folders:
        for mode in arguments.modes:
            repeats = 1 if mode == "paper" else arguments.repeats
            row_arguments = [str(folder), mode, "--schedule-share", share]
            runs = [in_own_process(__file__, row_arguments, arguments.threads) for _ in range(repeats)]
            rows.append(ModeRow(**min(runs, key=lambda run: run["total_s"])))
            print_row(rows[-1])
    write_rows(arguments.output / "modes.csv", rows)
    plot(rows, arguments.output / "modes.png")
    print("\n" + "\n".join(compared(rows)) + "\n", flush=True)
    equality = Path(__file__).with_name("benchmark_equality.py")
    subprocess.run([sys.executable, str(equality), str(folders[0]), "-o", str(arguments.output)], check=True)


if __name__ == "__main__":
    main()
