"""Make masks and mask features from a capture's images.

og-pointcloud masks CAPTURE --proposer sam:facebook/sam-vit-base --encoder openai/clip-vit-base-patch16
"""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path

from og_pointcloud.cli.common import Parser, add_shared, print_next, some_of, warn_of_poses


def add(parser: Parser) -> None:
    add_shared(parser, "capture")
    parser.add_argument(
        "--proposer", default="opencv", metavar="P",
        help="opencv (default, no weights), sam:FOLDER, sam:OWNER/MODEL,"
        " python:MODULE:NAME (your own), or a folder of id PNGs or COCO .json files",
    )  # fmt: skip
    parser.add_argument(
        "--encoder", default="demo", metavar="E",
        help="demo (default; knows the demo room alone), a model's folder, OWNER/MODEL, or none: masks alone",
    )  # fmt: skip
    parser.add_argument(
        "--features", default="crops", choices=("crops", "dense"),
        help="crops: several runs of the encoder a mask (default); dense: one run an image, faster and coarser",
    )  # fmt: skip
    parser.add_argument("--words", nargs="+", default=(), metavar="WORD", help="mask these alone; needs SAM 3")
    parser.add_argument(
        "--tracks", action="store_true",
        help="follow things from image to image: SAM 3's words; or a folder's ids mean the same in all its PNGs",
    )  # fmt: skip
    parser.add_argument("--level", default="medium", choices=("small", "medium", "large"), help="how much is one mask")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="use every N-th image; needs -o")
    parser.add_argument("--longest-side", type=int, default=1024, metavar="PX", help="larger images are shrunk to this")
    parser.add_argument("--overwrite", action="store_true", help="replace masks of others, or make all again")
    parser.add_argument("-o", "--output", type=Path, metavar="DIR", help="a capture of its own (default: CAPTURE)")


def run(arguments: argparse.Namespace) -> None:
    from og_pointcloud.masking.make_masks import MaskSettings, make_masks

    settings = MaskSettings(
        proposer=arguments.proposer,
        encoder=None if arguments.encoder == "none" else arguments.encoder,
        level=arguments.level,
        features=arguments.features,
        longest_side=arguments.longest_side,
        every=arguments.every,
        words=tuple(arguments.words),
        tracks=arguments.tracks,
    )
    if arguments.encoder == "demo":
        warnings.warn(
            "the demo encoder knows the demo room's furniture alone: words mean little on other photographs; take "
            "a model's folder, --encoder FOLDER ('hf cache ls' lists them), or none",
            stacklevel=1,
        )
    warn_of_poses(arguments.capture)
    made = make_masks(arguments.capture, settings, arguments.output, overwrite=arguments.overwrite)
    if made.left_out:
        print(f"left out: {len(made.left_out)} of {made.images + len(made.left_out)} images: {some_of(made.left_out)}")
    if made.done_before == made.images:
        print(f"all {made.images} images have these masks already: nothing to do (--overwrite makes them again)")
    print(
        f"{made.masks} masks in {made.images} images ({made.seconds:.1f} s, {made.done_before} images done before), "
        f"feature space {made.feature_space}"
    )
    print_next("fit", made.output, "-o", f"{made.output.resolve().name}.ogpc")
