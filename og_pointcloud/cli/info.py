"""Show what a .ogpc file contains and how it was made.

og-pointcloud info kitchen.ogpc
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import og_pointcloud as og
from og_pointcloud.cli import common
from og_pointcloud.cli.common import Parser
from og_pointcloud.errors import BundleError, counted, printable


def add(parser: Parser) -> None:
    common.add_shared(parser, "bundle", "--json")


def run(arguments: argparse.Namespace) -> None:
    scene = og.load(arguments.bundle)
    described = describe_bundle(scene, arguments.bundle)
    try:
        common.print_result(arguments, described, lambda _: print_info(scene, arguments.bundle))
    except (KeyError, TypeError, ValueError):  # provenance is the one part of a file that `load` does not check
        raise BundleError(f"{arguments.bundle}: its provenance is not as fit writes it; see --json") from None


def describe_bundle(scene: og.LabelledScene, path: Path) -> dict[str, Any]:
    """The output of ``info --json``: the manifest, with the file's size and its words."""
    words = list(scene.vocabulary.names) if scene.vocabulary else []
    bank = scene.cloud.word_bank
    return {
        "path": str(path), "bytes": path.stat().st_size, "words": words,
        "word_bank": 0 if bank is None else len(bank.vectors), **scene.manifest,
    }  # fmt: skip


def print_info(scene: og.LabelledScene, path: Path) -> None:
    """Print the file's size, frame and words, its largest instances, and how it was made."""
    cloud, manifest = scene.cloud, scene.manifest
    words = cloud.vocabulary.names if cloud.vocabulary else ()
    writer = printable(str(manifest.get("written_by", "unknown writer")), 60)
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB, {writer}")
    sizes = f"{counted(len(cloud), 'point')}, {counted(len(cloud.instances), 'instance')}"
    print(f"{sizes}, feature space '{cloud.feature_space}'")
    origin = ", ".join(f"{value:.10g}" for value in cloud.origin)
    print(f"spacing {cloud.spacing:.4g}, reach {cloud.reach:.4g}, origin ({origin}), in the capture's unit")
    print(f"{counted(len(words), 'word')}: {common.some_of(words)}" if words else "no words of its own")
    if cloud.word_bank is None:
        print(f"no word bank: scores are cosines. {common.calibration_hint(path)}\n")
    else:
        print(f"word bank of {len(cloud.word_bank.vectors)}: scores are probabilities\n")
    print(f"{scene.instances}\n")
    common.print_provenance(cloud.provenance)
