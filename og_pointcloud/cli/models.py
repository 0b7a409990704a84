"""List the models that are here, and the commands that get others. Downloads nothing.

og-pointcloud models
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

from og_pointcloud.cli.common import Parser, print_table
from og_pointcloud.models import hub_cache

KINDS = {"sam": "proposer", "clip": "encoder", "siglip": "encoder"}
"""Beginning of a config.json's model_type -> what it is for."""
USUAL = (
    ("proposer", "facebook/sam-vit-base", "SAM, 94 M parameters"),
    ("proposer", "facebook/sam2.1-hiera-small", "SAM 2.1, 46 M"),
    ("encoder", "openai/clip-vit-base-patch16", "CLIP, 150 M"),
    ("encoder", "google/siglip-base-patch16-224", "SigLIP, 203 M"),
)
"""What most want first; sizes as published."""


def add(_: Parser) -> None:
    """No options."""


def run(_: argparse.Namespace) -> None:
    found = sorted({(kind, name, where) for kind, name, where in found_models()})
    if found:
        print_table(("model", "for", "where"), [(name, kind, str(where)) for kind, name, where in found])
    else:
        print("no models found (looked in OG_POINTCLOUD_MODELS, the user's cache, and Hugging Face's)")
    print("\nto fetch one (nothing was downloaded):")
    here = {name for _, name, _ in found}
    for kind, name, size in USUAL:
        if name not in here:
            print(f"  hf download {name}    # {kind}, {size}")


def found_models() -> Iterator[tuple[str, str, Path]]:
    """(purpose, name, folder) of exported encoders and of transformers models, in all places that are looked in."""
    from og_pointcloud.text.encoder import model_folders

    for parent in model_folders():
        for folder in sorted(parent.iterdir()) if parent.is_dir() else ():
            if kind := model_kind(folder):
                yield kind, folder.name, folder
    for snapshots in sorted(hub_cache().glob("models--*/snapshots")):
        name = snapshots.parent.name.removeprefix("models--").replace("--", "/", 1)
        for folder in sorted(snapshots.iterdir()):
            if kind := model_kind(folder):
                yield kind, name, folder


def model_kind(folder: Path) -> str | None:
    """What an exported encoder, or a transformers folder with weights, is for; None for one of another kind."""
    from og_pointcloud.errors import SceneError
    from og_pointcloud.formats.poses import read_json

    if (folder / "manifest.json").is_file():
        return "encoder" if (folder / "image_encoder.onnx").is_file() else "words"
    if not any((*folder.glob("*.safetensors*"), *folder.glob("*.bin"))):
        return None
    try:
        model_type = str(read_json(folder / "config.json").get("model_type"))
    except (SceneError, OSError, AttributeError):  # none, damaged, or no object
        return None
    return next((kind for name, kind in KINDS.items() if model_type.startswith(name)), None)
