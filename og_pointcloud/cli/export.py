"""Export a model's text or image encoder, to use it without torch.

og-pointcloud export text openai/clip-vit-base-patch32
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from og_pointcloud.cli.common import Parser, add_commands, add_option
from og_pointcloud.errors import OgPointcloudError


def add(parser: Parser) -> None:
    text, image = add_commands(parser, "half", run_text, run_image)
    for half in (text, image):
        add_option(half, "model", "MODEL", "downloaded OWNER/MODEL, or a folder with a CLIP or SigLIP model", type=Path)
        where = "folder to create (default: where scenes find it automatically)"
        half.add_argument("-o", "--output", type=Path, metavar="DIR", help=where)
        add_option(half, "--feature-space", "OWNER/MODEL", "name that scenes give it (default: the model's own)")
    template = "text that a name is put into, such as 'a photo of a {}.'; several are averaged (default: {})"
    add_option(text, "--template", "TEXT", template, action="append")
    crops = "how masks are cropped if the caller does not say (default: %(default)s)"
    add_option(image, "--crops", None, crops, choices=("context", "langsplat"), default="context")


def run_text(arguments: argparse.Namespace) -> None:
    """Export the text encoder: it turns any word into a vector.

    og-pointcloud export text openai/clip-vit-base-patch32
    """
    source, feature_space = found_model(arguments.model, arguments.feature_space)
    from og_pointcloud_export.encoders import export_text_encoder

    folder, manifest = export_text_encoder(
        source, arguments.output, feature_space=feature_space, templates=arguments.template or ("{}",)
    )
    print_export(folder, manifest, "texts")
    if arguments.output is not None:
        print(f"next: export OG_POINTCLOUD_MODELS='{folder.resolve()}'  # so that scenes of this feature space find it")


def run_image(arguments: argparse.Namespace) -> None:
    """Export the image encoder: it turns crops of masks into vectors, for og-pointcloud masks.

    og-pointcloud export image openai/clip-vit-base-patch32
    """
    source, feature_space = found_model(arguments.model, arguments.feature_space)
    from og_pointcloud_export.encoders import export_image_encoder

    from og_pointcloud.masking.crops import CROP_STYLES

    crops = CROP_STYLES[arguments.crops]
    folder, manifest = export_image_encoder(source, arguments.output, feature_space=feature_space, crops=crops)
    print_export(folder, manifest, "images")


def found_model(model: Path, feature_space: str | None) -> tuple[Path, str | None]:
    """The folder of the given MODEL, and its feature space if it is known by now."""
    from og_pointcloud.models import fetched_model

    if model.is_dir():
        return model, feature_space
    name = model.as_posix()
    if folder := fetched_model(name):
        return folder, feature_space or name
    raise OgPointcloudError(
        f"'{name}' is neither a folder nor a downloaded model; expected one of them: check the path, or download "
        "the model (hf download OWNER/MODEL)"
    )


def print_export(folder: Path, manifest: Mapping[str, Any], compared: str) -> None:
    """Print what was made, and how far it is from torch. compared: what the manifest counts, 'texts' or 'images'."""
    parity = manifest["parity"]
    print(f"feature space '{manifest['feature_space']}': dimension {manifest['width']}")
    print(f"onnxruntime and torch differ by at most {parity['max_abs_error']:.1e} over {parity[compared]} {compared}")
    size = sum(file["bytes"] for file in manifest["files"].values())
    print(f"wrote {folder} ({size / 1e6:.1f} MB)")
