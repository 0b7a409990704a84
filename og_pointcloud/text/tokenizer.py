"""Words -> token ids, by a ``tokenizer.json``.

CLIP's byte-pair encoding is implemented here, so that the base install can encode typed words; any other file (SigLIP's
unigrams, the Gemma byte pairs of SigLIP 2) goes through the ``tokenizers`` package. Both are untrusted: files that
could make it run very long, or give different ids on another run, are refused.
"""

from __future__ import annotations

import base64
import json
import math
import re
import unicodedata
from collections.abc import Iterator, Mapping
from functools import lru_cache
from itertools import pairwise
from typing import Any, Protocol

from og_pointcloud.errors import OgPointcloudError, naming_extra

WHITESPACE = "\t\n\v\f\r \x85\xa0\u1680\u2000-\u200a\u2028\u2029\u202f\u205f\u3000"
"""Unicode's White_Space, as the inside of a character class; Python's ``\\s`` has four more control characters."""
CLIP_WORDS = r"'s|'t|'re|'ve|'m|'ll|'d|[\p{L}]+|[\p{N}]|[^\s\p{L}\p{N}]+"
CLIP_SPECIALS = r"<\|startoftext\|>|<\|endoftext\|>|"
CLIP_NORMALIZER = {
    "type": "Sequence",
    "normalizers": [
        {"type": "NFC"},
        {"type": "Replace", "pattern": {"Regex": r"\s+"}, "content": " "},
        {"type": "Lowercase"},
    ],
}
PUNCTUATION = "[!-/:-@\\[-`{-~ ]"
"""One ASCII punctuation character, or a space."""
LINEAR_PATTERN = re.compile(rf"(?:\\s| |\[(?:\\{PUNCTUATION}|(?![\[\\\]]){PUNCTUATION})+\])(?:\+|\{{2,\}})?")
"""Regular expressions that take linear time on any text: one character class, once or repeated."""
MAX_CHARACTERS = 4096
"""Longer texts are truncated first of all; contexts have 77 tokens or fewer."""
MAX_PIECE_CHARACTERS, MAX_ADDED_PIECES = 256, 1 << 12
"""Characters of a piece, and pieces added to the vocabulary. Unigrams take time quadratic in a piece's length."""
MAX_FRAME_CHARACTERS = 1 << 13
"""Characters of the description of what is put around a text's ids: templates repeat lists of ids."""
MAX_GROWTH = 256
"""Largest factor by which normalizer and pre-tokenizer may lengthen a text."""
GROWTH = {
    "NFC": 3, "NFD": 4, "NFKC": 18, "NFKD": 18, "Lowercase": 3, "Strip": 1, "StripAccents": 1, "Nmt": 1,
    "BertNormalizer": 4, "ByteLevel": 4, "Prepend": 2,
}  # fmt: skip
"""Largest factor by which each step lengthens a text, by Unicode's own tables."""
MAX_CACHED_PIECES = 1 << 14


class Tokenizer(Protocol):
    """Text -> token ids. highest_id: the largest id that a text can give."""

    highest_id: int

    def __call__(self, text: str) -> list[int]:
        """Ids of a text, at most the context length: a longer text is truncated before its closing tokens."""
        ...


def open_tokenizer(data: bytes, context_length: int, vocabulary: int) -> Tokenizer:
    """The tokenizer of an untrusted tokenizer.json. ValueError says what is damaged or refused.

    vocabulary: number of tokens of the model that takes its ids. MissingExtraError if it is not CLIP's and the
    ``tokenizers`` package is absent.
    """
    try:
        description = json.loads(data)
        tokenizer = ClipTokenizer(description, context_length) if _is_clip(description) else None
        if tokenizer is None:
            _check_other(description)
    except (KeyError, TypeError, AttributeError, IndexError, RecursionError) as error:
        what = f"{type(error).__name__}: {error!s:.80}"
        raise ValueError(f"it is not in the form of a tokenizer.json ({what})") from None
    tokenizer = tokenizer or OtherTokenizer(data, context_length)
    if tokenizer.highest_id >= vocabulary:
        raise ValueError(
            f"it gives ids up to {tokenizer.highest_id}, but the model has {vocabulary} tokens: they do not match"
        )
    return tokenizer


def _is_clip(description: dict[str, Any]) -> bool:
    # The pattern exists in two forms, with and without the names of the special tokens.
    splits = [
        {"type": "Split", "pattern": {"Regex": pattern}, "behavior": "Removed", "invert": True}
        for pattern in (CLIP_WORDS, CLIP_SPECIALS + CLIP_WORDS)
    ]
    steps, model = (description.get("pre_tokenizer") or {}).get("pretokenizers") or [], description["model"]
    return (
        description.get("normalizer") == CLIP_NORMALIZER
        and [step["type"] for step in steps] == ["Split", "ByteLevel"]
        and steps[0] in splits
        and not steps[1].get("add_prefix_space")
        and model.get("type", "BPE") == "BPE"
        and model.get("end_of_word_suffix") == "</w>"
        and not any(model.get(name) for name in ("dropout", "continuing_subword_prefix", "ignore_merges"))
        and (description.get("post_processor") or {}).get("type") == "RobertaProcessing"
    )


def _byte_characters() -> tuple[str, ...]:
    """GPT-2's printable character for each byte: itself if Latin-1 prints it, else the next unused from U+0100 on."""
    # Without space (32), the no-break space (160) and the soft hyphen (173), which are invisible.
    printable = {*range(33, 127), *range(161, 173), *range(174, 256)}
    others = iter(range(256, 512))
    return tuple(chr(byte if byte in printable else next(others)) for byte in range(256))


BYTE_CHARACTERS = _byte_characters()
"""Spelling of bytes in byte-level vocabularies: entry b is the character of byte b."""


class ClipTokenizer:
    """CLIP's tokenizer (a `Tokenizer`): NFC, single spaces, lower case; words; byte pairs. Thread-safe."""

    def __init__(self, description: Mapping[str, Any], context_length: int) -> None:
        """description: a parsed tokenizer.json that is CLIP's except for vocabulary, merges and special tokens."""
        model, frame = description["model"], description["post_processor"]
        self._context_length = context_length
        self._start, self._end = _id(frame["cls"][1]), _id(frame["sep"][1])
        pairs = BytePairs(model["vocab"], model["merges"])
        self._piece_ids = lru_cache(MAX_CACHED_PIECES)(pairs)
        self.highest_id = max(*pairs.vocabulary.values(), self._start, self._end)

    def __call__(self, text: str) -> list[int]:
        """See `Tokenizer`. A lone surrogate, which is no character, becomes U+FFFD. The names of special tokens are
        read as plain text."""
        ids: list[int] = []
        for word in _words(_normalized(_truncated(text))):
            ids += self._piece_ids("".join(BYTE_CHARACTERS[byte] for byte in word.encode()))
        return [self._start, *ids[: max(0, self._context_length - 2)], self._end]


def _truncated(text: str) -> str:
    """At most MAX_CHARACTERS of a text, with lone surrogates replaced."""
    return text[:MAX_CHARACTERS].encode("utf-16", "surrogatepass").decode("utf-16", "replace")


def _normalized(text: str) -> str:
    """CLIP_NORMALIZER. Lower case one character at a time, so without the rule for a final sigma."""
    return "".join(map(str.lower, re.sub(f"[{WHITESPACE}]+", " ", unicodedata.normalize("NFC", text))))


def _words(text: str) -> Iterator[str]:
    """CLIP_WORDS without a library that knows \\p{L}: a second text holds the kind of each character, and runs of one
    kind are matched in it."""
    kinds = "".join(map(_kind, text))
    endings, runs = re.compile("'s|'t|'re|'ve|'m|'ll|'d"), re.compile("L+|N|O+")
    position = 0
    while position < len(text):
        # Endings before runs: in the pattern 's comes before letters and before other characters.
        if match := endings.match(text, position) or runs.match(kinds, position):
            yield text[position : match.end()]
            position = match.end()
        else:  # white space
            position += 1


@lru_cache(MAX_CACHED_PIECES)
def _kind(character: str) -> str:
    """L letter, N number, S white space, O any other."""
    category = unicodedata.category(character)[0]
    if category in "LN":
        return category
    return "S" if re.match(f"[{WHITESPACE}]", character) else "O"


class BytePairs:
    """Byte-pair encoding of words (Sennrich et al. 2016): starting from single bytes, the pair learned first is merged,
    repeatedly."""

    def __init__(self, vocabulary: Mapping[str, int], merges: list[str | list[str]]) -> None:
        self.vocabulary = {token: _id(id) for token, id in vocabulary.items()}
        missing = [byte for byte in BYTE_CHARACTERS if not {byte, f"{byte}</w>"} <= self.vocabulary.keys()]
        if missing:
            raise ValueError(f"its vocabulary lacks {len(missing)} of the 256 bytes, {missing[0]!r} first")
        self._merges: dict[tuple[int, int], tuple[int, int]] = {}  # (left, right) -> (rank, joined)
        for rank, merge in enumerate(merges):
            left, right = merge.split(" ") if isinstance(merge, str) else merge
            pair = (self.vocabulary[left], self.vocabulary[right])
            self._merges[pair] = (rank, self.vocabulary[left + right])

    def __call__(self, word: str) -> list[int]:
        """Ids of a word spelled in BYTE_CHARACTERS."""
        # The last byte carries the end-of-word mark: "at" in "cat" is another token than "at" in "cats".
        ids = [self.vocabulary[character] for character in word[:-1]] + [self.vocabulary[f"{word[-1]}</w>"]]
        while known := [(*self._merges[pair], pair) for pair in pairwise(ids) if pair in self._merges]:
            _, joined, best_pair = min(known)
            # All occurrences at once, from the left: of three equal ids the first two are merged.
            merged: list[int] = []
            position = 0
            while position < len(ids):
                is_pair = tuple(ids[position : position + 2]) == best_pair
                merged.append(joined if is_pair else ids[position])
                position += 2 if is_pair else 1
            ids = merged
        return ids


def _id(value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 1 << 31:
        raise ValueError(f"{value!r:.40} is in the place of a token id")
    return value


# Other tokenizers


class OtherTokenizer:
    """Any byte pairs or unigrams (a `Tokenizer`), by the ``tokenizers`` package. Thread-safe."""

    def __init__(self, data: bytes, context_length: int) -> None:
        """data: a tokenizer.json that ``_check_other`` accepted."""
        with naming_extra("tokenizers", "words"):
            import tokenizers
        try:
            self._tokenizer = tokenizers.Tokenizer.from_str(data.decode())
            self._tokenizer.no_padding()
            self._tokenizer.enable_truncation(context_length)
            self.highest_id = max([*self._tokenizer.get_vocab().values(), *self._tokenizer.encode("").ids], default=0)
        except BaseException as error:  # a Rust panic is not an Exception
            raise ValueError(f"tokenizers does not read it ({_reason(error)})") from None

    def __call__(self, text: str) -> list[int]:
        """See `Tokenizer`."""
        text = _truncated(text)
        try:
            return self._tokenizer.encode(text).ids
        except BaseException as error:
            raise OgPointcloudError(f"tokenizers fails on {text!r:.40} ({_reason(error)})") from None


def _check_other(description: dict[str, Any]) -> None:
    model = description["model"]
    if model.get("type", "BPE" if "merges" in model else None) not in ("BPE", "Unigram"):
        raise ValueError(f"its model is a {model.get('type')!r:.40}; expected BPE or Unigram")
    if model.get("dropout"):
        raise ValueError(f"its byte pairs have dropout {model['dropout']!r:.40}: the same text could give other ids")
    for pattern in _patterns([description.get("normalizer"), description.get("pre_tokenizer")]):
        if pattern not in (CLIP_WORDS, CLIP_SPECIALS + CLIP_WORDS) and not LINEAR_PATTERN.fullmatch(pattern):
            raise ValueError(f"it uses the pattern {pattern!r:.80}, which may be slow on some texts")

    # Of pre-tokenizers only this one lengthens texts; named as often as it is used.
    byte_levels = json.dumps(description.get("pre_tokenizer")).count('"ByteLevel"')
    normalizer = description.get("normalizer") or {"type": "Strip"}
    growth = math.prod([float(GROWTH["ByteLevel"])] * byte_levels, start=_growth(normalizer))
    if growth > MAX_GROWTH:
        raise ValueError(f"it makes texts {growth:.3g} times as long; expected at most {MAX_GROWTH}")
    framing = len(json.dumps(description.get("post_processor")))
    if framing > MAX_FRAME_CHARACTERS:
        raise ValueError(f"it has {framing} characters of post-processing; expected at most {MAX_FRAME_CHARACTERS}")
    vocabulary, added = model["vocab"], description.get("added_tokens") or []
    pieces = vocabulary if isinstance(vocabulary, dict) else (entry[0] for entry in vocabulary)
    longest = max((len(piece) for piece in (*pieces, *(token["content"] for token in added))), default=0)
    if longest > MAX_PIECE_CHARACTERS or len(added) > MAX_ADDED_PIECES:
        raise ValueError(
            f"it has a piece of {longest} characters and {len(added)} added pieces; expected at most "
            f"{MAX_PIECE_CHARACTERS} and {MAX_ADDED_PIECES}"
        )


def _growth(step: dict[str, Any]) -> float:
    """Largest factor by which a normalizer lengthens a text."""
    kind = step["type"]
    if kind == "Sequence":
        return math.prod(max(1.0, _growth(inner)) for inner in step["normalizers"])
    if kind == "Replace":
        found = step["pattern"].get("String", " ")  # LINEAR_PATTERN takes at least one character
        # The empty text is found between any two characters, and stays there.
        return len(step["content"]) / len(found) if found else 1.0 + len(step["content"])
    if kind == "Precompiled":
        # SentencePiece's map: the trie's length in 4 bytes, the trie, then all replacements, each ended by a zero byte.
        table = base64.b64decode(step["precompiled_charsmap"] or "")
        trie = 4 + int.from_bytes(table[:4], "little")
        return max(map(len, table[trie:].split(b"\0")))
    if kind not in GROWTH or len(step.get("prepend", "")) > MAX_PIECE_CHARACTERS:
        raise ValueError(f"its normalizer is a {kind!r:.40}; expected {', '.join(GROWTH)}")
    return GROWTH[kind]


def _patterns(value: Any) -> Iterator[str]:
    """All regular expressions in a part of a tokenizer.json."""
    if isinstance(value, dict):
        if "Regex" in value:
            yield str(value["Regex"])
        value = list(value.values())
    for inner in value if isinstance(value, list) else ():
        yield from _patterns(inner)


def _reason(error: BaseException) -> str:
    if isinstance(error, (KeyboardInterrupt, SystemExit)):
        raise error
    return f"{type(error).__name__}: {error!s:.80}"
