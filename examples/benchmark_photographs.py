"""The demo from photographs alone, beside the same with better masks: one row a room and source of masks.

    python examples/benchmark_photographs.py [SEED ...] [--level LEVEL] [--work FOLDER]

Masks are perfect, those of the demo's simulated proposer, or OpenCV's; all else is the same: the demo encoder describes
them, a fit makes instances of them, words are typed. What is lost from the first row to the second is the masks' fault,
what the first row lacks is the encoder's. Absent called: of all points, the share that gets one of 25 words for nothing
in the room, none of which the encoder was trained on. Seconds are wall clock on one process.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from og_pointcloud_room.capture import CaptureSettings, make_capture, write_capture
from og_pointcloud_room.photographs import FromPhotographs, label_from_photographs

STAGES = ("masks and features", "fit", "typed words to labels")


def main(arguments: list[str] | None = None) -> None:
    """The rows of each room, then the means."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("seeds", nargs="*", type=int, default=[0, 1], help="of rooms")
    parser.add_argument("--views", type=int, default=60)
    parser.add_argument("--level", help="of OpenCV's masks; as `og-pointcloud masks` has it where left out")
    parser.add_argument(
        "--work", type=Path, help="folder that keeps rooms and pictures; one that goes again if not given"
    )
    options = parser.parse_args(arguments)
    rows: dict[str, list[FromPhotographs]] = {}
    with tempfile.TemporaryDirectory() as temporary:
        for seed in options.seeds:
            folder = (options.work or Path(temporary)) / f"room{seed}"
            for name, result in label_with_each(seed, options.views, options.level, folder):
                rows.setdefault(name, []).append(result)
    print("\nroom  masks of            mIoU   mAcc  absent called  masks/image  instances  " + "  ".join(STAGES))
    for name, results in rows.items():
        for seed, result in zip(options.seeds, results, strict=True):
            print(_row(str(seed), name, [result], options.views))
    for name, results in rows.items():
        print(_row("mean", name, results, options.views))


def label_with_each(seed: int, views: int, level: str | None, folder: Path) -> list[tuple[str, FromPhotographs]]:
    """Perfect masks, simulated ones and OpenCV's."""
    perfect, careless = (
        write_capture(make_capture(seed, CaptureSettings(views=views, mask_noise=noise)), folder / name)
        for name, noise in (("perfect", 0.0), ("careless", 1.0))
    )
    sources = {"truth": str(perfect / "masks"), "simulated proposer": str(careless / "masks"), "OpenCV": "opencv"}
    found = []
    for name, proposer in sources.items():
        print(f"\nroom {seed}, masks of {name}", flush=True)
        output = folder / name.replace(" ", "_")
        chosen = level if proposer == "opencv" else None
        found.append((name, label_from_photographs(careless, output, proposer, seed=seed, processes=1, level=chosen)))
    return found


def _row(room: str, name: str, results: list[FromPhotographs], views: int) -> str:
    score, accuracy, called, masks, instances = np.mean(
        [[r.score.miou, r.score.macc, r.absent_called, r.masks / views, r.instances] for r in results], axis=0
    )
    seconds = [np.mean([result.seconds[stage] for result in results]) for stage in STAGES]
    cells = "  ".join(f"{value:{len(stage)}.1f}" for stage, value in zip(STAGES, seconds, strict=True))
    return (
        f"{room:<5} {name:<18} {score:5.3f}  {accuracy:5.3f}  {called:13.4f}  {masks:11.0f}  {instances:9.0f}  {cells}"
    )


if __name__ == "__main__":
    main()
