"""``og-pointcloud export-image-encoder``: a CLIP or SigLIP model's image half, run without torch."""

from __future__ import annotations

import argparse
from typing import Any

from og_pointcloud.cli.common import add_command, add_model_options, given_model


def add(commands: Any) -> None:
    parser = add_command(
        commands, "export-image-encoder", run, "Make a model's image encoder usable without torch.",
        "og-pointcloud export-image-encoder openai/clip-vit-base-patch32",
    )  # fmt: skip
    add_model_options(parser)
    parser.add_argument(
        "--crops", choices=("context", "langsplat"), default="context",
        help="how masks are cut out unless a caller says otherwise (default: %(default)s)",
    )  # fmt: skip


def run(arguments: argparse.Namespace) -> None:
    source, feature_space = given_model(arguments.source, arguments.feature_space)
    from og_pointcloud_export.image_encoder import export_image_encoder

    from og_pointcloud.masking.crops import CROP_STYLES

    folder, manifest = export_image_encoder(
        source,
        arguments.output,
        feature_space=feature_space,
        activation=arguments.activation,
        crops=CROP_STYLES[arguments.crops],
    )
    parity, tower = manifest["parity"], manifest["tower"]
    print(
        f"feature space '{manifest['feature_space']}': width {manifest['width']}, {tower['layers']} layers, "
        f"{tower['heads']} heads, {tower['activation']}, {manifest['preprocessing']['size']} pixels"
    )
    print(f"onnxruntime and torch differ by {parity['max_abs_error']:.1e} at most, over {parity['images']} images")
    print(f"wrote {folder} ({sum(file['bytes'] for file in manifest['files'].values()) / 1e6:.1f} MB)")
