"""Words of a .ogpc file, and the bank that labels are judged by: stored with their vectors, so that queries need no
encoder. ``scene_words`` finds them for a new file.

Only changed members are written anew; the graph and the arrays are copied. Needs numpy alone.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from og_pointcloud.bundle.format import BANK, CARRIED_ENCODER, MAX_NAMES_BYTES, describe_member, manifest_json
from og_pointcloud.bundle.read import read_bundle, read_carried_encoder
from og_pointcloud.cloud import FeatureSpace, LabelledCloud, Vocabulary, WordBank, unit_rows
from og_pointcloud.errors import FeatureSpaceError, OgPointcloudError
from og_pointcloud.formats.atomic import StrPath, changing, replacing
from og_pointcloud.formats.npy import npy_bytes
from og_pointcloud.journal import LeftOut, left_out_entry
from og_pointcloud.text.encoder import ENCODER, CarriedEncoder, TextEncoder, find_encoder, read_text_encoder
from og_pointcloud.text.text_features import check_names, checked_vocabulary, read_text_features

CAPTURE_WORDS = {"text_features.npz": LeftOut.VOCABULARY, "word_bank.npz": LeftOut.WORD_BANK}
"""Word files that a capture folder may contain, and what a fit reports if they are of another feature space."""


@dataclass(frozen=True)
class SceneWords:
    """vocabulary: words that can be given by name. word_bank: everyday words that labels are judged by. None if there
    are none. left_out: entries of provenance["left_out"]."""

    vocabulary: Vocabulary | None = None
    word_bank: WordBank | None = None
    left_out: tuple[dict[str, Any], ...] = ()

    def added_to(self, cloud: LabelledCloud) -> LabelledCloud:
        """The cloud with these words."""
        left_out = [*cloud.provenance.get("left_out", []), *self.left_out]
        provenance = {**cloud.provenance, "left_out": left_out}
        return replace(cloud, vocabulary=self.vocabulary, word_bank=self.word_bank, provenance=provenance)


def scene_words(
    space: FeatureSpace,
    *,
    text_features: StrPath | None = None,
    word_bank: StrPath | None = None,
    capture: StrPath | None = None,
) -> SceneWords:
    """The words for a scene whose masks are of this feature space; cheap enough to be checked before a fit.

    text_features: an .npz with the vocabulary; None: the capture folder's text_features.npz, if it is of this space.
    word_bank: an .npz of at least 50 everyday words; None: the capture folder's word_bank.npz, if it is of this
        space, else the bank of the text encoder found for the space, if any.
    FeatureSpaceError if a file cannot be read, or a given file is of another space or width.
    """
    left_out = []

    def words_of(given: StrPath | None, own: str, read: Callable[[Path], tuple[Any, str]]) -> Any:
        """The words of a given file, which must fit; else of the capture's own, which are left out if they do not."""
        if given is None and (capture is None or not (Path(capture) / own).is_file()):
            return None
        file = Path(capture or "", own) if given is None else Path(given)
        words, name = read(file)
        word_space = FeatureSpace(name, words.vectors.shape[1])
        if given is not None:
            space.require(word_space, f"words of {file}")
        elif name != space.name or not space.accepts(word_space):
            reason = f"{own} has {word_space}, the masks have {space}: encode the words with the masks' model"
            left_out.append(left_out_entry(CAPTURE_WORDS[own], reason=reason))
            return None
        return words

    vocabulary = words_of(text_features, "text_features.npz", read_text_features)
    bank = words_of(word_bank, "word_bank.npz", read_bank)
    if bank is None and (bank := bank_of_encoder(space)):
        space.require(FeatureSpace(space.name, bank.vectors.shape[1]), "word bank of the text encoder found for it")
    return SceneWords(vocabulary, bank, tuple(left_out))


def bank_of_encoder(space: FeatureSpace, folder: StrPath | None = None) -> WordBank | None:
    """The word bank of a text encoder's folder, or of the encoder found for the space; None if it has none or is of
    another space."""
    encoder = find_encoder(space.name) if folder is None else read_text_encoder(folder)
    if encoder is None or not FeatureSpace(space.name).accepts(encoder.space):
        return None
    return encoder.word_bank


def add_words(path: StrPath, words: Vocabulary, feature_space: str, output: StrPath | None = None) -> Vocabulary:
    """Append words with their vectors to those of a .ogpc file; a word that it already has gets the new vector. Returns
    all its words.

    feature_space: of the vectors. output: another file to write; None: the same one, replaced atomically.
    FeatureSpaceError for vectors of another space or width than the file's; OgPointcloudError while another process
    changes the file.
    """
    with changing(path):
        bundle = read_bundle(path)
        cloud = bundle.cloud
        added = FeatureSpace(feature_space, words.vectors.shape[1])
        cloud.space.require(added, "words")
        old = cloud.vocabulary or Vocabulary((), np.zeros((0, added.width), np.float32))
        if old.names:  # if no instance has a descriptor, they alone tell the width of the space
            FeatureSpace(cloud.feature_space, old.vectors.shape[1]).require(added, "words")
        merged = all_words(old, words)
        counts = {**bundle.manifest["counts"], "words": len(merged.names)}
        _rewrite(path, output, {**bundle.manifest, "counts": counts}, vocabulary_members(merged))
    return merged


def all_words(old: Vocabulary, new: Vocabulary) -> Vocabulary:
    """The words of both, with unit vectors of one width; a word that both have gets the new one's."""
    vectors = {}
    for words in (old, new):
        vectors |= dict(zip(words.names, unit_rows(words.vectors), strict=True))
    return Vocabulary(tuple(vectors), np.array(list(vectors.values()), np.float32))


def read_bank(path: StrPath) -> tuple[WordBank, str]:
    """A text-features file as a bank, and its feature space; FeatureSpaceError if it has too few words."""
    vocabulary, feature_space = read_text_features(path)
    try:
        return WordBank(vocabulary.vectors), feature_space
    except FeatureSpaceError as error:
        raise FeatureSpaceError(f"{path}: {error}") from None


def store_bank(path: StrPath, bank: WordBank, feature_space: str, output: StrPath | None = None) -> None:
    """Store a word bank in a .ogpc file, in place of any that it has; its answers are then calibrated.

    feature_space, output, errors: as for ``add_words``.
    """
    with changing(path):
        bundle = read_bundle(path)
        bundle.cloud.space.require(FeatureSpace(feature_space, bank.vectors.shape[1]), "words of the bank")
        _rewrite(path, output, bundle.manifest, bank_members(bank))


def carry_encoder(path: StrPath, folder: StrPath, output: StrPath | None = None) -> TextEncoder:
    """Store a text encoder in a .ogpc file, which can then answer any word on any machine. Returns the encoder.

    folder: written by ``og-pointcloud export text``, or a .ogpc that carries an encoder; a file without a word bank
    gets the encoder's. output: as for ``add_words``.
    """
    with changing(path):
        bundle = read_bundle(path)
        members, encoder = encoder_members(folder, bundle.cloud.space)
        if bundle.cloud.word_bank is None and encoder.word_bank is not None:
            members |= bank_members(encoder.word_bank)
        _rewrite(path, output, bundle.manifest, members)
    return encoder


def carrier_of_encoder(path: StrPath | None) -> StrPath | None:
    """The path of a .ogpc that carries a text encoder, for ``write_bundle``; None if it carries none or is gone."""
    # Asked before what is made from it is written: that may be the same file.
    carries = path is not None and Path(path).is_file() and read_carried_encoder(path)
    return path if carries else None


def carried_encoder(path: StrPath | None) -> CarriedEncoder:
    """A function that opens the text encoder in a .ogpc file when it is first needed, which it rarely is.

    It returns None if the file carries no encoder or no longer exists, and the same encoder again for an unchanged
    file. OgPointcloudError if the encoder cannot be used.
    """

    def opened() -> TextEncoder | None:
        if path is None or not Path(path).is_file():
            return None
        return _carried_once(Path(path).resolve(), Path(path).stat().st_mtime_ns)

    return opened


@lru_cache(maxsize=2)
def _carried_once(path: Path, _modified: int) -> TextEncoder | None:
    files = read_carried_encoder(path)
    return TextEncoder(files, f"{path}: text_encoder") if files else None


def encoder_members(source: StrPath, space: FeatureSpace) -> tuple[dict[str, bytes], TextEncoder]:
    """An encoder's files, of a folder or of a .ogpc that carries one, as members of a .ogpc of this feature space;
    FeatureSpaceError if it is of another."""
    files = (Path(source).is_file() and read_carried_encoder(source)) or ENCODER.read(Path(source))
    encoder = TextEncoder(files, str(source))
    space.require(encoder.space, f"texts that {source} encodes")
    return {CARRIED_ENCODER + name: data for name, data in files.items()}, encoder


def vocabulary_members(vocabulary: Vocabulary) -> dict[str, bytes]:
    """The members that hold words: names, and float32 unit vectors. OgPointcloudError for words that readers refuse."""
    check_names(vocabulary.names)
    checked_vocabulary(vocabulary.names, vocabulary.vectors)
    names = json.dumps(list(vocabulary.names), ensure_ascii=False).encode()
    if len(names) > MAX_NAMES_BYTES:
        raise OgPointcloudError(f"the words have {len(names)} bytes; expected at most {MAX_NAMES_BYTES}: store fewer")
    vectors = unit_rows(vocabulary.vectors.astype(np.float64)).astype(np.float32)
    return {"vocabulary/names.json": names, "vocabulary/vectors.npy": npy_bytes(vectors)}


def bank_members(bank: WordBank) -> dict[str, bytes]:
    """The member that holds a word bank. float16 suffices: a statistic of many words ignores a word's last digits."""
    return {BANK: npy_bytes(bank.vectors.astype(np.float16))}


def _rewrite(path: StrPath, output: StrPath | None, manifest: Mapping[str, Any], changes: Mapping[str, bytes]) -> None:
    """Write a bundle with some members replaced or added, and this manifest; the others are copied."""
    # The manifest's entries of changed members are made anew; the others stay valid.
    members = manifest["members"] | {name: describe_member(name, data) for name, data in changes.items()}
    text = manifest_json({**manifest, "members": members})
    with zipfile.ZipFile(path) as source, replacing(output or path) as file, zipfile.ZipFile(file, "w") as target:
        target.writestr(zipfile.ZipInfo("manifest.json"), text)  # ZipInfo is dated 1980: equal contents, equal bytes
        for name in members:
            target.writestr(zipfile.ZipInfo(name), changes[name] if name in changes else source.read(name))
