"""``og-pointcloud export-text-encoder``: a CLIP or SigLIP model's weights to an encoder that the base install runs."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from og_pointcloud.cli.common import add_command, add_model_options, given_model


def add(commands: Any) -> None:
    parser = add_command(
        commands, "export-text-encoder", run, "Make a model's text encoder usable without torch.",
        "og-pointcloud export-text-encoder openai/clip-vit-base-patch32",
    )  # fmt: skip
    add_model_options(parser)
    parser.add_argument(
        "--template", action="append", metavar="TEXT",
        help="what a name is put into, such as 'a photo of a {}.'; several are averaged (default: {})",
    )  # fmt: skip
    parser.add_argument(
        "--tokenizer", type=Path, metavar="FILE",
        help="tokenizer.json, merges.txt, bpe_simple_vocab_16e6.txt.gz or spiece.model (default: beside the weights)",
    )  # fmt: skip
    parser.add_argument(
        "--int8", action="store_true", help="a quarter of the size; refused where it would change what is found"
    )
    parser.add_argument("--scene", type=Path, metavar="S.ogpc", help="with --int8: a scene whose answers must stay")


def run(arguments: argparse.Namespace) -> None:
    if arguments.scene and not arguments.int8:
        arguments.parser.error("--scene is asked only what --int8 would change: give both, or neither")
    source, feature_space = given_model(arguments.source, arguments.feature_space)
    from og_pointcloud_export.text_encoder import export_text_encoder

    folder, manifest = export_text_encoder(
        source,
        arguments.output,
        feature_space=feature_space,
        templates=arguments.template or ("{}",),
        activation=arguments.activation,
        tokenizer=arguments.tokenizer,
        int8=arguments.int8,
        scene=arguments.scene,
    )
    print_export(folder, manifest, in_cache=arguments.output is None)


def print_export(folder: Path, manifest: Mapping[str, Any], in_cache: bool) -> None:
    """What was made, how far it is from torch, and how scenes find it."""
    parity, tower = manifest["parity"], manifest["tower"]
    size = sum(file["bytes"] for file in manifest["files"].values())
    print(
        f"feature space '{manifest['feature_space']}': width {manifest['width']}, {tower['layers']} layers, "
        f"{tower['heads']} heads, {tower['activation']}, context {manifest['context_length']}"
    )
    print(f"onnxruntime and torch differ by {parity['max_abs_error']:.1e} at most, over {parity['texts']} texts")
    if "int8" in parity:
        print(
            f"int8 and float32: cosine {parity['int8']['min_cosine']:.4f} at least, {describe_choices(parity['int8'])}"
        )
    print(f"wrote {folder} ({size / 1e6:.1f} MB)")
    if not in_cache:
        print(f"next: export OG_POINTCLOUD_MODELS='{folder.resolve()}'  # scenes of this feature space then find it")


def describe_choices(int8: Mapping[str, Any]) -> str:
    if "instances" not in int8:
        return "no scene asked (--scene)"
    return f"no choice changed among {int8['instances']} instances and {int8['words']} words"
