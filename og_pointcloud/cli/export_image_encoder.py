"""``og-pointcloud export-image-encoder``: a CLIP or SigLIP model's image half, run without torch."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from og_pointcloud.cli.common import add_command


def add(commands: Any) -> None:
    parser = add_command(
        commands, "export-image-encoder", run, "Make a model's image encoder usable without torch.",
        "og-pointcloud export-image-encoder clip-vit-base-patch32 --feature-space openai/clip-vit-base-patch32",
    )  # fmt: skip
    parser.add_argument(
        "source", type=Path, metavar="SOURCE",
        help="transformers or OpenCLIP folder, or a file of weights (.safetensors, weights-only .pt)",
    )  # fmt: skip
    parser.add_argument(
        "-o", "--output", type=Path, metavar="DIR",
        help="the folder to write (default: in the user's cache, where it is found by its feature space)",
    )  # fmt: skip
    parser.add_argument(
        "--feature-space", metavar="OWNER/MODEL",
        help="the text encoder's; default: what the model's configuration calls itself",
    )  # fmt: skip
    parser.add_argument(
        "--activation", choices=("quick_gelu", "gelu", "gelu_pytorch_tanh"), help="of weights that do not say"
    )
    parser.add_argument(
        "--crops", choices=("context", "langsplat"), default="context",
        help="how masks are cut out unless a caller says otherwise (default: %(default)s)",
    )  # fmt: skip


def run(arguments: argparse.Namespace) -> None:
    from og_pointcloud_export.image_encoder import export_image_encoder

    from og_pointcloud.masking.crops import CROP_STYLES

    folder, manifest = export_image_encoder(
        arguments.source,
        arguments.output,
        feature_space=arguments.feature_space,
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
