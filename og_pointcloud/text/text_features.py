"""Files of words: lists with one word per line; and text features, names with the vectors that an encoder gave them.

Text features are an .npz with ``names`` (L,) strings, ``vectors`` (L, D) floats, and ``feature_space``, the encoder's
name.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.cloud import UNKNOWN_SPACE, Vocabulary
from og_pointcloud.errors import FeatureSpaceError, OgPointcloudError
from og_pointcloud.formats.atomic import StrPath
from og_pointcloud.formats.npy import read_npz

MAX_UNPACKED_BYTES = 1 << 30
MAX_WORDS_BYTES = 1 << 24
MAX_NAME_CHARACTERS = 1000


def read_text_features(path: StrPath) -> tuple[Vocabulary, str]:
    """The names and vectors of a text-features .npz, and the name of its feature space.

    Raises FeatureSpaceError, whose text begins with the path, if the file cannot be read, an entry is missing, or a
    name is repeated, is empty, or has a vector that is zero, NaN or infinite. Nothing is unpickled.

    >>> import pathlib, tempfile
    >>> import numpy as np
    >>> import og_pointcloud as og
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "words.npz"
    >>> np.savez(path, names=["chair", "desk"], vectors=np.eye(2), feature_space="two-words")
    >>> vocabulary, space = og.read_text_features(path)
    >>> vocabulary.names, space
    (('chair', 'desk'), 'two-words')
    """
    path = Path(path)
    if not path.is_file():
        raise FeatureSpaceError(f"{path} is not a file; expected an .npz with 'names', 'vectors' and 'feature_space'")
    layout = "'names' (L,), 'vectors' (L, D) and 'feature_space': write it with numpy.savez"
    entries = read_npz(path, ("names", "vectors"), ("feature_space",), MAX_UNPACKED_BYTES, layout, FeatureSpaceError)
    names, vectors = entries["names"], entries["vectors"]
    if names.dtype.kind != "U" or names.ndim != 1:
        raise FeatureSpaceError(f"{path}: names are {names.dtype} {names.shape}; expected strings of shape (L,)")
    if vectors.dtype.kind != "f" or vectors.ndim != 2 or len(vectors) != len(names) or 0 in vectors.shape:
        raise FeatureSpaceError(
            f"{path}: vectors are {vectors.dtype} {vectors.shape}; expected floats of shape ({len(names)}, D), one row "
            "per name, and at least one"
        )
    try:
        check_names(names.tolist())
        vocabulary = checked_vocabulary(names.tolist(), vectors)
    except OgPointcloudError as error:
        raise FeatureSpaceError(f"{path}: {error}") from None
    return vocabulary, str(entries.get("feature_space", UNKNOWN_SPACE))


def check_names(names: Sequence[str]) -> None:
    """OgPointcloudError for a name in a file that is longer than any word, or contains half a character."""
    for name in names:
        # Lone surrogates, halves of a character, cannot be written as UTF-8.
        if len(name) > MAX_NAME_CHARACTERS or any("\ud800" <= sign <= "\udfff" for sign in name):
            raise OgPointcloudError(
                f"the name {name!r:.60} has {len(name)} characters; expected whole ones, at most {MAX_NAME_CHARACTERS}"
            )


def checked_vocabulary(names: Sequence[str], vectors: NDArray[Any]) -> Vocabulary:
    """Words with vectors (L, D) of any numeric type, as float32. OgPointcloudError for an empty or repeated name,
    FeatureSpaceError for a vector that is zero, NaN or infinite."""
    with np.errstate(over="ignore"):
        vectors = vectors.astype(np.float32, copy=False)
    seen: set[str] = set()
    for name, vector in zip(names, vectors, strict=True):
        if name in seen:
            raise OgPointcloudError(f"the name '{name}' is given twice; expected different names: remove one")
        if not name.strip():
            raise OgPointcloudError(f"row {len(seen)} has an empty name; expected a word: name it or remove it")
        if not np.isfinite(vector).all():
            raise FeatureSpaceError(f"the vector of '{name}' is NaN or infinite; expected finite ones: encode it again")
        if not vector.any():
            raise FeatureSpaceError(f"the vector of '{name}' is zero, which is similar to nothing: encode it again")
        seen.add(name)
    return Vocabulary(tuple(names), vectors)


def read_words(path: StrPath) -> tuple[str, ...]:
    """The words of a text file, one per line, UTF-8; empty lines and repeated words are skipped.

    OgPointcloudError if it cannot be read, or has no words.
    """
    path = Path(path)
    try:
        if path.stat().st_size > MAX_WORDS_BYTES:
            raise ValueError(f"it has {path.stat().st_size} bytes, more than {MAX_WORDS_BYTES}")
        lines = path.read_bytes().decode("utf-8-sig").splitlines()
    except (OSError, ValueError) as error:
        raise OgPointcloudError(f"{path} cannot be read as words, one per line, in UTF-8 ({error})") from None
    words = tuple(dict.fromkeys(filter(None, (line.strip() for line in lines))))
    if not words:
        raise OgPointcloudError(f"{path} has no words; expected one per line")
    return words


def everyday_words() -> tuple[str, ...]:
    """The library's list of everyday things, which an encoder turns into a word bank."""
    return read_words(Path(__file__).with_name("everyday_words.txt"))
