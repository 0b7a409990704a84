"""Make masks and mask features from a capture's images.

og-pointcloud masks CAPTURE --proposer sam:facebook/sam-vit-base --encoder openai/clip-vit-base-patch16
"""

from __future__ import annotations

import argparse
import warnings
from functools import partial
from pathlib import Path

from og_pointcloud.cli.common import Parser, add_option, add_shared, names_in, print_next, some_of, warn_of_poses
from og_pointcloud.errors import counted


def add(parser: Parser) -> None:
    add_shared(parser, "capture")
    option = partial(add_option, parser)
    proposers = "opencv (default, no weights), sam:FOLDER, sam:OWNER/MODEL, python:MODULE:NAME (your own), or a folder"
    option("--proposer", "P", f"{proposers} of id PNGs or COCO .json files", default="opencv")
    encoders = "demo (default; knows only the demo room), a model's folder, OWNER/MODEL, or none: only masks"
    option("--encoder", "E", encoders, default="demo")
    ways = "crops: several encoder runs per mask (default); dense: one run per image, faster and coarser"
    option("--features", None, ways, default="crops", choices=("crops", "dense"))
    option("--words", "A,B,C", "mask only these; needs SAM 3")
    follow = "follow objects from image to image: by SAM 3's words, or by ids that are the same in all PNGs of a folder"
    parser.add_argument("--tracks", action="store_true", help=follow)
    level = "how much one mask covers (default: %(default)s)"
    option("--level", None, level, default="medium", choices=("small", "medium", "large"))
    option("--every", "N", "use every N-th image; needs -o (default: all)", type=int, default=1)
    option("--longest-side", "PX", "larger images are shrunk to this (default: %(default)s)", type=int, default=1024)
    parser.add_argument("--overwrite", action="store_true", help="replace masks from elsewhere, or make all again")
    parser.add_argument("-o", "--output", type=Path, metavar="DIR", help="a separate capture folder (default: CAPTURE)")


def run(arguments: argparse.Namespace) -> None:
    from og_pointcloud.masking.make_masks import MaskSettings, make_masks

    settings = MaskSettings(
        proposer=arguments.proposer,
        encoder=None if arguments.encoder == "none" else arguments.encoder,
        level=arguments.level,
        features=arguments.features,
        longest_side=arguments.longest_side,
        every=arguments.every,
        words=tuple(names_in(arguments.words) or ()),
        tracks=arguments.tracks,
    )
    # Checked before masks are made, which may take hours.
    warn_of_poses(arguments.capture)
    if arguments.encoder == "demo":
        warnings.warn(
            "the demo encoder knows only the demo room's furniture: words mean little for other photographs; use "
            "a model's folder, --encoder FOLDER ('hf cache ls' lists them), or none",
            stacklevel=1,
        )
    made = make_masks(arguments.capture, settings, arguments.output, overwrite=arguments.overwrite)
    if made.left_out:
        print(f"left out: {len(made.left_out)} of {made.images + len(made.left_out)} images: {some_of(made.left_out)}")
    if made.done_before == made.images:
        print(f"all {made.images} images already have these masks: nothing to do (--overwrite makes them again)")
    print(
        f"{counted(made.masks, 'mask')} in {counted(made.images, 'image')} ({made.seconds:.1f} s, {made.done_before} "
        "done before), "
        f"feature space {made.feature_space}"
    )
    if not made.masks:
        warnings.warn(
            "the proposer found nothing in any image, and fit needs masks: try another --proposer", stacklevel=1
        )
        return
    print_next("fit", made.output, "-o", f"{made.output.resolve().name}.ogpc")
