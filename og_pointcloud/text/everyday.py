"""Lists of words: a user's, one a line, and the library's own words of everyday things."""

from __future__ import annotations

import os
from pathlib import Path

from og_pointcloud.errors import OgPointcloudError

__all__ = ["everyday_words", "read_words"]

MAX_WORDS_BYTES = 1 << 24


def read_words(path: str | os.PathLike[str]) -> tuple[str, ...]:
    """The words of a text file, one a line, UTF-8; empty lines and repeated words are left out.

    OgPointcloudError where it cannot be read, or has no words.
    """
    path = Path(path)
    try:
        if path.stat().st_size > MAX_WORDS_BYTES:
            raise ValueError(f"it has {path.stat().st_size} bytes, more than {MAX_WORDS_BYTES}")
        lines = path.read_bytes().decode("utf-8-sig").splitlines()
    except (OSError, ValueError) as error:
        raise OgPointcloudError(f"{path} cannot be read as words, one a line, in UTF-8 ({error})") from None
    words = tuple(dict.fromkeys(filter(None, (line.strip() for line in lines))))
    if not words:
        raise OgPointcloudError(f"{path} has no words; expected one a line")
    return words


def everyday_words() -> tuple[str, ...]:
    """The library's own words of everyday things, which an encoder makes a word bank of."""
    return read_words(Path(__file__).with_name("everyday_words.txt"))
