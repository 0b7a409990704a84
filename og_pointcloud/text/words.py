"""The user's labels, in any form -> names and text vectors of the scene's feature space."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from og_pointcloud.cloud import FeatureSpace, Vocabulary
from og_pointcloud.errors import FeatureSpaceError, OgPointcloudError, did_you_mean, printable
from og_pointcloud.formats.atomic import StrPath
from og_pointcloud.scene import numbers_of
from og_pointcloud.text.encoder import CarriedEncoder, export_command, find_encoder
from og_pointcloud.text.text_features import checked_vocabulary, read_text_features

Labels: TypeAlias = "str | Iterable[str] | Mapping[str, ArrayLike] | Vocabulary | None"
TextFeatures: TypeAlias = "StrPath | tuple[Vocabulary, str] | None"
MAX_WORD_CHARACTERS = 60
"""Characters of an unknown word that its error quotes."""
MAX_LISTED_WORDS = 24
"""An error about an unknown word that is like none of the known ones lists them all, if they are no more than this."""


def resolve_labels(
    labels: Labels,
    text_features: TextFeatures,
    own_words: Vocabulary | None,
    feature_space: str,
    carried: CarriedEncoder | None = None,
) -> Vocabulary:
    """Distinct names, each with a finite nonzero vector.

    labels: words, looked up in text_features and then in own_words, and encoded if neither has them and there is an
    encoder; None for all words of text_features or, without it, of own_words; or name -> vector (D,); or a Vocabulary,
    taken as it is, even if empty. Words of a set are sorted alphabetically.
    text_features: a text-features file, or the result of ``read_text_features``. own_words, feature_space: the scene's.
    carried: returns the encoder in the scene's file, if it has one.
    Raises OgPointcloudError for a word that has no vector or is given twice, FeatureSpaceError for text_features of
    another space and for vectors that cannot be compared.
    """
    # In order of look-up: the caller's words come before the scene's.
    sources = [source for source in (_of_space(text_features, feature_space), own_words) if source and source.names]
    if labels is None:
        if not sources:
            how = "" if find_encoder(feature_space, carried) else f"; {_ways(feature_space)}"
            raise OgPointcloudError(
                f"no labels are given, and the scene has no words: name some, such as --labels chair,table{how}"
            )
        labels = sources[0]
    if isinstance(labels, Vocabulary):
        return _checked(labels.names, labels.vectors) if labels.names else labels
    if isinstance(labels, Mapping):
        return _checked([str(name) for name in labels], _stacked(labels, labels.values()))
    if isinstance(labels, np.ndarray):
        labels = [*np.atleast_1d(labels)]  # a 0-dimensional array is one word
    if isinstance(labels, (set, frozenset)):  # the order of a set varies from run to run
        labels = sorted(labels, key=str)
    words = tuple(labels) if isinstance(labels, Iterable) and not isinstance(labels, (str, bytes)) else (labels,)
    for word in words:
        if not isinstance(word, str):
            raise OgPointcloudError(f"label {word!r:.60} is a {type(word).__name__}; expected words, or name -> vector")
        if not word.strip():
            raise OgPointcloudError("a label is empty; expected words: name what you want to find")
    return _checked(words, _looked_up(words, sources, feature_space, carried))


def _checked(names: Sequence[str], vectors: NDArray[Any]) -> Vocabulary:
    if not names:
        raise OgPointcloudError("0 labels are given; expected at least one word: name what you want to find")
    return checked_vocabulary(tuple(map(str, names)), vectors)  # names may be numpy strings


def _ways(feature_space: str) -> str:
    return (
        "pass {name: vector}, or text_features=FILE.npz (--text-features) with 'names', 'vectors' and 'feature_space' "
        "from the scene's encoder; or store them (og-pointcloud vocabulary add); or, for any word, export the "
        f"encoder once: {export_command(feature_space)}"
    )


def _of_space(text_features: TextFeatures, feature_space: str) -> Vocabulary | None:
    if text_features is None:
        return None
    vocabulary, space = words_of(text_features)
    source = "text_features" if isinstance(text_features, tuple) else str(Path(text_features))
    FeatureSpace(feature_space).require(FeatureSpace(space, vocabulary.vectors.shape[1]), f"names of {source}")
    return vocabulary


def words_of(text_features: StrPath | tuple[Vocabulary, str]) -> tuple[Vocabulary, str]:
    """The result of `read_text_features`, given it or a file's path. OgPointcloudError for anything else."""
    if isinstance(text_features, (str, os.PathLike)):
        return read_text_features(text_features)
    if isinstance(text_features, tuple) and [*map(type, text_features)] == [Vocabulary, str]:
        return text_features
    raise OgPointcloudError(
        f"text_features are a {type(text_features).__name__}; expected an .npz file, or what og.read_text_features "
        "returned for one, (Vocabulary, name of the feature space): pass {name: vector} as labels"
    )


def _stacked(names: Iterable[str], vectors: Iterable[Any]) -> NDArray[Any]:
    rows = []
    for name, vector in zip(names, vectors, strict=True):
        row = numbers_of(vector)
        if row.ndim != 1 or row.dtype.kind not in "fiu" or row.shape != (rows[0] if rows else row).shape:
            raise FeatureSpaceError(
                f"the vector of '{name}' is {row.dtype} {row.shape}; expected numbers of shape "
                f"{rows[0].shape if rows else '(D,)'}, the same for all labels"
            )
        rows.append(row)
    return np.array(rows).reshape(len(rows), -1) if rows else np.zeros((0, 0))


def _looked_up(
    words: tuple[str, ...], sources: list[Vocabulary], feature_space: str, carried: CarriedEncoder | None
) -> NDArray[np.float32]:
    vectors: dict[str, np.ndarray] = {}  # the first source is entered last, so it wins
    for source in reversed(sources):
        vectors |= dict(zip(source.names, source.vectors, strict=True))
    missing = [word for word in words if word not in vectors]
    if missing and (encoder := find_encoder(feature_space, carried)):
        vectors |= dict(zip(missing, encoder(missing), strict=True))
    elif missing:
        others = f", nor are {len(missing) - 1} more of the labels" if len(missing) > 1 else ""
        hint = did_you_mean(missing[0], vectors, " If not")
        first = printable(missing[0], MAX_WORD_CHARACTERS)
        few = not hint and 0 < len(vectors) <= MAX_LISTED_WORDS
        known = f" ({printable(', '.join(sorted(vectors)), 300)})" if few else ""
        raise OgPointcloudError(
            f"'{first}' is not among the {len(vectors)} known words{known}{others}{hint}: {_ways(feature_space)}"
        )
    return _stacked(words, (vectors[word] for word in words)).astype(np.float32)
