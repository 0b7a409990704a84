"""Store words in a .ogpc file, so that queries for them need no encoder.

og-pointcloud vocabulary add kitchen.ogpc words.txt
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import og_pointcloud as og
from og_pointcloud.cli.common import Parser, add_commands, add_option, add_output, replaceable
from og_pointcloud.errors import OgPointcloudError, counted

if TYPE_CHECKING:
    from og_pointcloud.text.encoder import TextEncoder


def add(parser: Parser) -> None:
    add, bank, carry = add_commands(parser, "action", run_add, run_bank, run_carry)
    for action in (add, bank, carry):
        add_option(action, "bundle", "S.ogpc", "file that `fit` wrote", type=replaceable)
        add_output(action, "-o", "--output", endings=(".ogpc",), help="file to write (default: S.ogpc itself)")
    sources = add.add_mutually_exclusive_group()
    add_option(add, "words", "words.txt", "text file, one word per line", type=Path, nargs="?")
    add_option(sources, "--text-features", "F.npz", "or names with their vectors", type=Path)
    add_option(bank, "features", "F.npz", "vectors of at least 50 everyday words", type=Path, nargs="?")
    for source in (sources, bank):
        add_option(source, "--text-encoder", "DIR", "text encoder (default: the feature space's, if found)", type=Path)
    add_option(carry, "encoder", "DIR", "folder that `og-pointcloud export text` wrote", type=Path)


def run_add(arguments: argparse.Namespace) -> None:
    """Store the words of a file, one per line, with their text vectors.

    og-pointcloud vocabulary add kitchen.ogpc words.txt --text-encoder clip-vit-b32
    """
    from og_pointcloud.bundle.vocabulary import add_words
    from og_pointcloud.text.text_features import read_words

    if (arguments.words is None) == (arguments.text_features is None):
        arguments.parser.error("expected words from one source: a file with one per line, or --text-features F.npz")
    if arguments.text_features:
        vocabulary, space = og.read_text_features(arguments.text_features)
    else:
        words, encoder = read_words(arguments.words), scene_encoder(arguments)
        vocabulary, space = og.Vocabulary(words, encoder(words)), encoder.feature_space
    together = add_words(arguments.bundle, vocabulary, space, arguments.output)
    print(f"wrote {arguments.output or arguments.bundle}: {counted(len(together.names), 'word')}")


def scene_encoder(arguments: argparse.Namespace) -> TextEncoder:
    """The text encoder in --text-encoder, else that of the scene's feature space; FeatureSpaceError if they differ."""
    from og_pointcloud.bundle.vocabulary import carried_encoder
    from og_pointcloud.text.encoder import encoder_for, read_text_encoder

    own, folder = og.read_bundle(arguments.bundle).cloud.space, arguments.text_encoder
    encoder = read_text_encoder(folder) if folder else encoder_for(own.name, carried_encoder(arguments.bundle))
    own.require(encoder.space, f"texts that {encoder.where} encodes")
    return encoder


def run_bank(arguments: argparse.Namespace) -> None:
    """Store everyday words to judge labels by: scores become probabilities.

    og-pointcloud vocabulary bank kitchen.ogpc --text-encoder clip-vit-b32
    """
    from og_pointcloud.bundle.vocabulary import read_bank, store_bank

    if arguments.features and arguments.text_encoder:
        arguments.parser.error("expected everyday words from one source: F.npz, or --text-encoder DIR")
    if arguments.features:
        bank, space = read_bank(arguments.features)
    else:
        encoder = scene_encoder(arguments)
        if encoder.word_bank is None:
            raise OgPointcloudError(f"{encoder.where} has no word bank: make it again with og-pointcloud export text")
        bank, space = encoder.word_bank, encoder.feature_space
    store_bank(arguments.bundle, bank, space, arguments.output)
    path = arguments.output or arguments.bundle
    print(f"wrote {path}: {len(bank.vectors)} everyday words to judge labels by; scores are now probabilities")


def run_carry(arguments: argparse.Namespace) -> None:
    """Store a text encoder in the file, so that it can be queried for any word.

    og-pointcloud vocabulary carry kitchen.ogpc clip-vit-b32 -o kitchen_any_word.ogpc
    """
    from og_pointcloud.bundle.vocabulary import carry_encoder

    encoder = carry_encoder(arguments.bundle, arguments.encoder, arguments.output)
    path = arguments.output or arguments.bundle
    kind, size = f"{encoder.precision}, feature space '{encoder.feature_space}'", path.stat().st_size / 1e6
    print(f"wrote {path} ({size:.1f} MB): it carries its text encoder ({kind})")
