"""Words for a .ogpc file that is being made: which vocabulary and which word bank go into it."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from og_pointcloud.bundle.vocabulary import read_bank
from og_pointcloud.cloud import FeatureSpace, LabelledCloud, Vocabulary, WordBank
from og_pointcloud.journal import LeftOut, left_out_entry
from og_pointcloud.text.encoder import find_encoder, read_text_encoder
from og_pointcloud.text.text_features import read_text_features

__all__ = ["SceneWords", "bank_of_encoder", "scene_words"]

CAPTURE_WORDS = "text_features.npz"
"""Name of the text features that a capture folder may hold."""


@dataclass(frozen=True)
class SceneWords:
    """vocabulary: words that can be asked by name. word_bank: everyday words that labels are judged by. None: there are
    none. left_out: entries of provenance["left_out"]."""

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
    text_features: str | os.PathLike[str] | None = None,
    word_bank: str | os.PathLike[str] | None = None,
    capture: str | os.PathLike[str] | None = None,
) -> SceneWords:
    """The words for a scene whose masks are of this feature space; cheap enough to be checked before a fit.

    text_features: an .npz with the vocabulary; None: the capture folder's own where it has one of this space.
    word_bank: an .npz of at least 50 everyday words; None: that of the text encoder found for the space, if any.
    FeatureSpaceError where a file cannot be read, or one that was asked for is of another space or width.
    """
    vocabulary, left_out = None, ()
    if text_features is not None:
        vocabulary, name = read_text_features(text_features)
        space.require(FeatureSpace(name, vocabulary.vectors.shape[1]), f"names of {text_features}")
    elif capture is not None and (own := Path(capture) / CAPTURE_WORDS).is_file():
        vocabulary, name = read_text_features(own)
        of_words = FeatureSpace(name, vocabulary.vectors.shape[1])
        if name != space.name or not space.accepts(of_words):
            reason = f"{own} is of {of_words}, the masks are of {space}: encode the names with the masks' model"
            vocabulary, left_out = None, (left_out_entry(LeftOut.VOCABULARY, reason=reason),)
    if word_bank is not None:
        bank, name = read_bank(word_bank)
        space.require(FeatureSpace(name, bank.vectors.shape[1]), f"words of {word_bank}")
    elif bank := bank_of_encoder(space):
        space.require(FeatureSpace(space.name, bank.vectors.shape[1]), "word bank of the text encoder found for it")
    return SceneWords(vocabulary, bank, left_out)


def bank_of_encoder(space: FeatureSpace, folder: str | os.PathLike[str] | None = None) -> WordBank | None:
    """The word bank of a text encoder's folder, or of the encoder that is found for the space; None where that has none
    or is of another space."""
    encoder = find_encoder(space.name) if folder is None else read_text_encoder(folder)
    return encoder.word_bank if encoder is not None and encoder.feature_space == space.name else None
