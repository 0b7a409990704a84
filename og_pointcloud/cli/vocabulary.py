"""``og-pointcloud vocabulary add | list | bank | carry``: a .ogpc file's words, its word bank, and its text encoder."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from og_pointcloud.cli.common import add_command, check_outputs
from og_pointcloud.errors import OgPointcloudError


def add(commands: Any) -> None:
    parser = add_command(
        commands, "vocabulary", run_list, "Store words in a .ogpc file, so that asking for them needs no encoder.",
        "og-pointcloud vocabulary add kitchen.ogpc words.txt",
    )  # fmt: skip
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    adding = add_command(
        actions, "add", run_add, "Store the words of a file, one a line, with their text vectors.",
        "og-pointcloud vocabulary add kitchen.ogpc words.txt --text-encoder clip-vit-b32",
    )  # fmt: skip
    add_bundle(adding, writes=True)
    adding.add_argument(
        "words", type=Path, nargs="?", metavar="words.txt", help="one word a line (default: all of --text-features)"
    )
    vectors = adding.add_mutually_exclusive_group()
    vectors.add_argument("--text-features", type=Path, metavar="F.npz", help="names with their vectors")
    vectors.add_argument(
        "--text-encoder", type=Path, metavar="DIR", help="what encodes them (default: the feature space's, if found)"
    )
    listing = add_command(
        actions, "list", run_list, "Print the words, one a line.", "og-pointcloud vocabulary list kitchen.ogpc"
    )
    add_bundle(listing, writes=False)
    banking = add_command(
        actions, "bank", run_bank, "Store everyday words that labels are judged by: answers become probabilities.",
        "og-pointcloud vocabulary bank kitchen.ogpc --text-encoder clip-vit-b32",
    )  # fmt: skip
    add_bundle(banking, writes=True)
    source = banking.add_mutually_exclusive_group()
    source.add_argument(
        "features", type=Path, nargs="?", metavar="F.npz", help="text features of at least 50 everyday words"
    )
    source.add_argument(
        "--text-encoder", type=Path, metavar="DIR", help="whose bank it is (default: the feature space's, if found)"
    )
    carrying = add_command(
        actions, "carry", run_carry, "Store a text encoder in the file, which then answers any word anywhere.",
        "og-pointcloud vocabulary carry kitchen.ogpc clip-vit-b32 -o kitchen_any_word.ogpc",
    )  # fmt: skip
    add_bundle(carrying, writes=True)
    carrying.add_argument("encoder", type=Path, metavar="DIR", help="what `og-pointcloud export text` wrote")


def add_bundle(parser: argparse.ArgumentParser, writes: bool) -> None:
    parser.add_argument("bundle", type=Path, metavar="S.ogpc", help="what `fit` wrote")
    if writes:
        parser.add_argument("-o", "--output", type=Path, metavar="T.ogpc", help="another file (default: S.ogpc itself)")


def run_add(arguments: argparse.Namespace) -> None:
    from og_pointcloud.bundle.read import read_bundle
    from og_pointcloud.bundle.vocabulary import add_words
    from og_pointcloud.text.everyday import read_words

    if arguments.words is None and arguments.text_features is None:
        arguments.parser.error("no words: name a file with one a line, or --text-features F.npz")
    check_outputs({"-o": (arguments.output, [".ogpc"])}, inputs=[arguments.words, arguments.text_features])
    words = read_words(arguments.words) if arguments.words else None
    if arguments.text_features:
        vocabulary, space = from_features(arguments.text_features, words)
    else:
        own_space = read_bundle(arguments.bundle).cloud.feature_space
        vocabulary, space = encoded(words, arguments.text_encoder, own_space, arguments.bundle)
    done = add_words(arguments.bundle, vocabulary, space, arguments.output)
    replaced = f", {done.replaced} with a new vector" if done.replaced else ""
    print(f"wrote {arguments.output or arguments.bundle}: {done.total} words, {done.added} new{replaced}")


def from_features(path: Path, words: tuple[str, ...] | None) -> Any:
    """The vocabulary (of some words only, if any are named) and the feature space of a text-features file."""
    from og_pointcloud.cloud import Vocabulary
    from og_pointcloud.text.text_features import read_text_features

    vocabulary, space = read_text_features(path)
    if words is None:
        return vocabulary, space
    rows = {name: row for row, name in enumerate(vocabulary.names)}
    missing = [word for word in words if word not in rows]
    if missing:
        others = f" (nor are {len(missing) - 1} more)" if len(missing) > 1 else ""
        raise OgPointcloudError(f"'{missing[0]}' is not among the {len(rows)} names of {path}{others}: encode it there")
    return Vocabulary(words, vocabulary.vectors[[rows[word] for word in words]]), space


def encoded(words: tuple[str, ...] | None, folder: Path | None, own_space: str, bundle: Path) -> Any:
    """The words as the scene's encoder, or the one in a folder, has them; and its feature space."""
    from og_pointcloud.bundle.vocabulary import carried_encoder
    from og_pointcloud.cloud import FeatureSpace, Vocabulary
    from og_pointcloud.text.encoder import encoder_for, read_text_encoder

    encoder = read_text_encoder(folder) if folder else encoder_for(own_space, carried_encoder(bundle))
    FeatureSpace(own_space, 0).require(
        FeatureSpace(encoder.feature_space, encoder.width), f"texts that {encoder.where} encodes"
    )
    return Vocabulary(words or (), encoder(words or ())), encoder.feature_space


def run_list(arguments: argparse.Namespace) -> None:
    from og_pointcloud.bundle.read import read_bundle

    vocabulary = read_bundle(arguments.bundle).cloud.vocabulary
    for name in vocabulary.names if vocabulary else ():
        print(name)


def run_bank(arguments: argparse.Namespace) -> None:
    from og_pointcloud.bundle.read import read_bundle
    from og_pointcloud.bundle.vocabulary import carried_encoder, read_bank, store_bank
    from og_pointcloud.text.encoder import encoder_for, read_text_encoder

    check_outputs({"-o": (arguments.output, [".ogpc"])}, inputs=[arguments.features])
    if arguments.features:
        bank, space = read_bank(arguments.features)
    else:
        own_space = read_bundle(arguments.bundle).cloud.feature_space
        folder = arguments.text_encoder
        encoder = read_text_encoder(folder) if folder else encoder_for(own_space, carried_encoder(arguments.bundle))
        if encoder.word_bank is None:
            raise OgPointcloudError(f"{encoder.where} has no word bank: make it again with og-pointcloud export text")
        bank, space = encoder.word_bank, encoder.feature_space
    store_bank(arguments.bundle, bank, space, arguments.output)
    path = arguments.output or arguments.bundle
    print(f"wrote {path}: {len(bank.vectors)} everyday words to judge labels by; its answers are probabilities now")


def run_carry(arguments: argparse.Namespace) -> None:
    from og_pointcloud.bundle.vocabulary import carry_encoder

    check_outputs({"-o": (arguments.output, [".ogpc"])}, inputs=[])
    encoder = carry_encoder(arguments.bundle, arguments.encoder, arguments.output)
    path = arguments.output or arguments.bundle
    print(
        f"wrote {path} ({path.stat().st_size / 1e6:.1f} MB): it carries its text encoder ({encoder.precision}, feature "
        f"space '{encoder.feature_space}')"
    )
