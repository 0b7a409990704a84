"""Make a furnished room, fit it, query it by words, score it and show it.

og-pointcloud demo -o out/demo
"""

from __future__ import annotations

import argparse
from importlib.util import find_spec
from pathlib import Path

from og_pointcloud.cli.common import Parser, add_option, check_output
from og_pointcloud.errors import MissingExtraError, OgPointcloudError


def add(parser: Parser) -> None:
    folder = "folder to fill (default: %(default)s)"
    parser.add_argument("-o", "--output", type=Path, default=Path("out/demo"), metavar="DIR", help=folder)
    add_option(parser, "--seed", "N", "each seed makes a different room (default: %(default)s)", type=int, default=0)
    add_option(parser, "--mask-noise", "X", "0 clean, 1 realistic (default: %(default)s)", type=float, default=1.0)
    alone = "also label the room from its images only, without ready-made masks and features"
    parser.add_argument("--photographs", action=argparse.BooleanOptionalAction, default=True, help=alone)


def run(arguments: argparse.Namespace) -> None:
    # The room's modules import these where they need them: whoever lacks one needs the whole extra.
    for module in ("numba", "scipy", "cv2", "onnx", "open3d", "pyvista"):
        if find_spec(module) is None:
            raise MissingExtraError(module, "demo")
    room = arguments.output / "room.ogpc"
    check_output("-o", room, [])
    begun = arguments.output / ".demo"
    if not (room.exists() or begun.exists()) and arguments.output.is_dir() and any(arguments.output.iterdir()):
        raise OgPointcloudError(f"{arguments.output} holds other files; expected an empty folder: name another (-o)")
    arguments.output.mkdir(parents=True, exist_ok=True)
    begun.touch()  # what an interrupted demo leaves is the next one's to replace
    from og_pointcloud_room.demo import run_demo

    run_demo(arguments.output, seed=arguments.seed, mask_noise=arguments.mask_noise, photographs=arguments.photographs)
