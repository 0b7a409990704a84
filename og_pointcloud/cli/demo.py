"""``og-pointcloud demo``: a furnished room made, fitted, asked, scored and shown."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from og_pointcloud.cli.common import add_command, require_room


def add(commands: Any) -> None:
    parser = add_command(
        commands, "demo", run, "Make a furnished room, fit it, ask it for things, score it and show it.",
        "og-pointcloud demo -o out/demo",
    )  # fmt: skip
    parser.add_argument("-o", "--output", type=Path, default=Path("out/demo"), metavar="DIR", help="folder to fill")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="another room (default: %(default)s)")
    parser.add_argument(
        "--mask-noise", type=float, default=1.0, metavar="X", help="0 clean masks, 1 realistic (default: %(default)s)"
    )
    parser.add_argument(
        "--photographs", action=argparse.BooleanOptionalAction, default=True,
        help="also label the room from its images alone, without ready masks and features",
    )  # fmt: skip


def run(arguments: argparse.Namespace) -> None:
    require_room()
    from og_pointcloud_room.demo import run_demo

    run_demo(arguments.output, seed=arguments.seed, mask_noise=arguments.mask_noise, photographs=arguments.photographs)
