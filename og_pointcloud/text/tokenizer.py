"""Words -> token ids, by what a ``tokenizer.json`` says: byte pairs (CLIP, Gemma's of SigLIP 2) or unigrams (SigLIP).

The file is the one that the ``tokenizers`` library writes. Its parts, in the order they act: added_tokens (special
words found in the text as they stand), normalizer, pre_tokenizer (text -> pieces), model (piece -> ids),
post_processor (ids that stand before and after). Each kind of part that CLIP's and SigLIP's files use is here; any
other is refused by name, since ids that are nearly right give vectors that are quietly wrong.
"""

from __future__ import annotations

import base64
import heapq
import json
import re
import struct
import unicodedata
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache
from typing import Any, TypeAlias

__all__ = ["BYTE_CHARACTERS", "WHITESPACE", "Tokenizer"]

Normalizer: TypeAlias = "Callable[[str], str]"
PreTokenizer: TypeAlias = "Callable[[str], list[str]]"

WHITESPACE = "\t\n\v\f\r \x85\xa0\u1680\u2000-\u200a\u2028\u2029\u202f\u205f\u3000"
"""Unicode's White_Space, as the inside of a character class; Python's ``\\s`` has four control characters more."""
CLIP_WORDS = r"'s|'t|'re|'ve|'m|'ll|'d|[\p{L}]+|[\p{N}]|[^\s\p{L}\p{N}]+"
CLIP_SPECIALS = r"<\|startoftext\|>|<\|endoftext\|>|"
SIGN = "[!-/:-@\\[-`{-~ ]"
"""ASCII's punctuation, and space."""
UNKNOWN_PENALTY = 10.0
"""What a character without a piece scores below the rarest piece, as sentencepiece has it."""
PIECES_REMEMBERED = 1 << 14


def _byte_characters() -> tuple[str, ...]:
    """A printable character for each byte: itself where Latin-1 prints it, else the next from U+0100 on."""
    printable = {*range(33, 127), *range(161, 173), *range(174, 256)}
    others = iter(range(256, 512))
    return tuple(chr(byte if byte in printable else next(others)) for byte in range(256))


BYTE_CHARACTERS = _byte_characters()
"""How byte-level vocabularies spell bytes: row b is the character of byte b."""


class Tokenizer:
    """Turns text into token ids. Safe to share by threads.

    Made from the bytes of a tokenizer.json; ValueError says what in it is damaged or not understood.
    """

    def __init__(self, data: bytes) -> None:
        try:
            description = json.loads(data)
            self._specials, normalized_specials = _added_tokens(description.get("added_tokens") or [])
            self._normalize = _normalizer(description.get("normalizer"))
            self._normalized_specials = {self._normalize(text): id for text, id in normalized_specials.items()}
            self._split = _pre_tokenizer(description.get("pre_tokenizer"))
            self._before, self._after = _frame(description.get("post_processor"))
            self._piece_ids = lru_cache(PIECES_REMEMBERED)(_model(description["model"]))
        except (KeyError, TypeError, AttributeError, IndexError, RecursionError, struct.error) as error:
            what = f"{type(error).__name__}: {error!s:.80}"
            raise ValueError(f"it is not in the form of a tokenizer.json ({what})") from None
        self._special_pattern = _any_of(self._specials)
        self._normalized_pattern = _any_of(self._normalized_specials)
        model = description["model"]
        self.highest_id = max(
            [_highest_id(model), *self._specials.values(), *normalized_specials.values(), *self._before, *self._after]
        )
        """The largest id that a text can give."""

    def __call__(self, text: str, limit: int) -> list[int]:
        """Ids of a text, at most ``limit``: a longer one loses its end, but keeps the ids that stand after the text.

        A lone surrogate, which is no character, counts as U+FFFD.
        """
        text = text.encode("utf-16", "surrogatepass").decode("utf-16", "replace")
        ids: list[int] = []
        for part, special in _parts(text, self._special_pattern, self._specials):
            if special is not None:
                ids.append(special)
                continue
            for word, inner in _parts(self._normalize(part), self._normalized_pattern, self._normalized_specials):
                if inner is not None:
                    ids.append(inner)
                else:
                    for piece in self._split(word):
                        ids += self._piece_ids(piece)
        room = max(0, limit - len(self._before) - len(self._after))
        return [*self._before, *ids[:room], *self._after]


def _added_tokens(entries: list[dict[str, Any]]) -> tuple[dict[str, int], dict[str, int]]:
    """Content -> id of the tokens found in the text as given, and of those found after normalising."""
    tables: tuple[dict[str, int], dict[str, int]] = ({}, {})
    for entry in entries:
        if entry.get("single_word"):
            raise ValueError(f"its added token {entry['content']!r} counts as a single word only: not understood")
        # Spaces beside a token are nothing in the files here: their pre_tokenizers drop or trim them.
        tables[bool(entry.get("normalized"))][_text(entry["content"])] = _id(entry["id"])
    return tables


def _any_of(words: Mapping[str, int]) -> re.Pattern[str] | None:
    longest_first = sorted(filter(None, words), key=len, reverse=True)
    return re.compile("|".join(map(re.escape, longest_first))) if longest_first else None


def _parts(text: str, pattern: re.Pattern[str] | None, ids: Mapping[str, int]) -> Iterator[tuple[str, int | None]]:
    """The text in order: ("", id) for each special word, (text, None) for what lies between."""
    start = 0
    for match in pattern.finditer(text) if pattern else ():
        if match.start() > start:
            yield text[start : match.start()], None
        yield "", ids[match.group()]
        start = match.end()
    if start < len(text):
        yield text[start:], None


# Normalizers: text -> text


def _normalizer(spec: dict[str, Any] | None) -> Normalizer:
    if spec is None:
        return lambda text: text
    kind = spec["type"]
    if kind == "Sequence":
        return _chained([_normalizer(step) for step in spec["normalizers"]])
    if kind in ("NFC", "NFD", "NFKC", "NFKD"):
        return lambda text: unicodedata.normalize(kind, text)
    if kind == "Lowercase":  # one character at a time: no rule for a final sigma
        return lambda text: "".join(map(str.lower, text))
    if kind == "Strip":
        ends = {"strip_left": rf"\A[{WHITESPACE}]+", "strip_right": rf"[{WHITESPACE}]+\Z"}
        pattern = re.compile("|".join(end for name, end in ends.items() if spec[name]) or r"\A(?!)")
        return lambda text: pattern.sub("", text)
    if kind == "Prepend":
        prefix = _text(spec["prepend"])
        return lambda text: prefix + text if text else text
    if kind == "Replace":
        found, content = _replaced(spec["pattern"]), _text(spec["content"])
        return lambda text: found.sub(lambda _: content, text)
    if kind == "Precompiled":
        return CharacterMap(base64.b64decode(spec["precompiled_charsmap"]))
    raise ValueError(f"its normalizer is a {kind!r:.40}: not understood")


def _chained(steps: list[Normalizer]) -> Normalizer:
    def run(text: str) -> str:
        for step in steps:
            text = step(text)
        return text

    return run


def _replaced(pattern: dict[str, str]) -> re.Pattern[str]:
    """What a Replace looks for: a string, or one character class once or more, which no text can make slow."""
    if "String" in pattern:
        return re.compile(re.escape(_text(pattern["String"])))
    written = _text(pattern["Regex"])
    understood = re.fullmatch(rf"(?:\\s| |\[(?:\\{SIGN}|(?![\[\\\]]){SIGN})+\])(?:\+|\{{2,\}})?", written)
    try:
        if understood and "&&" not in written:
            return re.compile(written.replace(r"\s", f"[{WHITESPACE}]"))
    except re.error:
        pass
    raise ValueError(f"its normalizer replaces the pattern {written!r:.80}: not understood")


class CharacterMap:
    """sentencepiece's table of replacements: at each place the longest entry that begins there, else the character.

    data: 4 bytes, the size of a double-array trie over UTF-8 bytes; the trie, 4 bytes a cell; replacements, each ended
    by a zero byte, which the trie's values are offsets into.
    """

    def __init__(self, data: bytes) -> None:
        (size,) = struct.unpack_from("<I", data)
        if size % 4 or not 4 <= size <= len(data) - 4:
            raise ValueError(f"its character map claims a trie of {size} bytes in {len(data)}")
        self._cells = struct.unpack_from(f"<{size // 4}I", data, 4)
        self._replacements = data[4 + size :]

    def __call__(self, text: str) -> str:
        data = text.encode()
        pieces, position = [], 0
        while position < len(data):
            length, value = self._longest(data, position)
            if length:
                end = self._replacements.find(b"\0", value)
                pieces.append(self._replacements[value : end if end >= 0 else None])
            else:
                length = _utf8_length(data[position])
                pieces.append(data[position : position + length])
            position += length
        return b"".join(pieces).decode("utf-8", "replace")

    def _longest(self, data: bytes, start: int) -> tuple[int, int]:
        """Length and value of the longest entry that ``data`` holds at ``start``; length 0 where there is none."""
        cells, found = self._cells, (0, 0)
        node = _offset(cells[0])
        for position in range(start, len(data)):
            node ^= data[position]
            if node >= len(cells) or cells[node] & 0x800000FF != data[position]:
                break
            has_value = cells[node] >> 8 & 1
            node ^= _offset(cells[node])
            if has_value and node < len(cells):
                found = (position + 1 - start, cells[node] & 0x7FFFFFFF)
        return found


def _offset(cell: int) -> int:
    return cell >> 10 << ((cell & 512) >> 6)


def _utf8_length(first: int) -> int:
    return 1 if first < 0x80 else 2 if first < 0xE0 else 3 if first < 0xF0 else 4


# Pre-tokenizers: text -> pieces that no token crosses


def _pre_tokenizer(spec: dict[str, Any] | None) -> PreTokenizer:
    if spec is None:
        return lambda text: [text]
    kind = spec["type"]
    if kind == "Sequence":
        return _each([_pre_tokenizer(step) for step in spec["pretokenizers"]])
    if kind == "Split":
        return _split_by(spec)
    if kind == "ByteLevel":
        # use_regex would cut pieces as GPT-2 does: CLIP's are cut finer already.
        if spec.get("add_prefix_space"):
            raise ValueError("its ByteLevel puts a space before the text: not understood")
        return lambda text: ["".join(BYTE_CHARACTERS[byte] for byte in text.encode())]
    if kind == "WhitespaceSplit":
        return re.compile(f"[^{WHITESPACE}]+").findall
    if kind == "Metaspace":
        return _metaspace(spec)
    raise ValueError(f"its pre_tokenizer is a {kind!r:.40}: not understood")


def _each(steps: list[PreTokenizer]) -> PreTokenizer:
    def run(text: str) -> list[str]:
        pieces = [text]
        for step in steps:
            pieces = [smaller for piece in pieces for smaller in step(piece)]
        return pieces

    return run


def _split_by(spec: dict[str, Any]) -> PreTokenizer:
    pattern, behavior, invert = spec["pattern"], spec["behavior"], spec.get("invert", False)
    if pattern in ({"Regex": CLIP_WORDS}, {"Regex": CLIP_SPECIALS + CLIP_WORDS}) and behavior == "Removed" and invert:
        return _clip_splitter(has_specials=pattern["Regex"].startswith(CLIP_SPECIALS))
    if set(pattern) == {"String"} and behavior == "MergedWithPrevious" and not invert:
        mark = re.escape(_text(pattern["String"]))
        return re.compile(f"(?s:.*?{mark}|.+)").findall
    raise ValueError(f"its pre_tokenizer splits at {pattern!r:.120} ({behavior!r:.20}): not understood")


def _clip_splitter(has_specials: bool) -> PreTokenizer:
    """CLIP_WORDS without a library that knows \\p{L}: the text is spelled by kind, and runs are looked for in that."""
    endings = re.compile((CLIP_SPECIALS if has_specials else "") + "'s|'t|'re|'ve|'m|'ll|'d")
    runs = re.compile("L+|N|O+")

    def split(text: str) -> list[str]:
        kinds = "".join(map(_kind, text))
        pieces, position = [], 0
        while position < len(text):
            match = endings.match(text, position) or runs.match(kinds, position)
            end = match.end() if match else position + 1
            if match:
                piece = text[position:end]
                # A special word that came to be by lower-casing is none: its letters and signs go apart.
                pieces += re.findall("[a-z]+|[^a-z]+", piece) if piece[0] == "<" and piece[-1] == ">" else [piece]
            position = end
        return pieces

    return split


@lru_cache(PIECES_REMEMBERED)
def _kind(character: str) -> str:
    """L letter, N number, S white space, O any other."""
    category = unicodedata.category(character)[0]
    if category in "LN":
        return category
    return "S" if re.match(f"[{WHITESPACE}]", character) else "O"


def _metaspace(spec: dict[str, Any]) -> PreTokenizer:
    mark = _text(spec["replacement"])
    scheme = spec.get("prepend_scheme", "always" if spec.get("add_prefix_space", True) else "never")
    if scheme not in ("always", "never"):
        raise ValueError(f"its Metaspace prepends {scheme!r:.20}: not understood")
    starts = re.compile(f"{re.escape(mark)}?[^{re.escape(mark)}]+|{re.escape(mark)}")

    def split(text: str) -> list[str]:
        text = text.replace(" ", mark)
        if scheme == "always" and not text.startswith(mark):
            text = mark + text
        return starts.findall(text) if spec.get("split", True) else [text]

    return split


# Models: piece -> ids


def _model(spec: dict[str, Any]) -> Callable[[str], list[int]]:
    kind = spec.get("type", "BPE" if "merges" in spec else None)
    if kind == "BPE":
        return BytePairs(spec)
    if kind == "Unigram":
        return Unigrams(spec)
    raise ValueError(f"its model is a {kind!r:.40}; expected BPE or Unigram")


def _highest_id(spec: dict[str, Any]) -> int:
    return len(spec["vocab"]) - 1 if spec.get("type") == "Unigram" else max(spec["vocab"].values(), default=0)


class BytePairs:
    """Byte-pair encoding: begins with single characters and joins, again and again, the pair that was learnt first."""

    def __init__(self, spec: dict[str, Any]) -> None:
        for name in ("dropout", "continuing_subword_prefix", "ignore_merges"):
            if spec.get(name):
                raise ValueError(f"its byte pairs have {name} {spec[name]!r:.40}: not understood")
        self._vocabulary = {_text(token): _id(id) for token, id in spec["vocab"].items()}
        self._end = spec.get("end_of_word_suffix") or ""
        self._merges: dict[tuple[int, int], tuple[int, int]] = {}  # (left, right) -> (rank, joined)
        for rank, merge in enumerate(spec["merges"]):
            left, right = merge.split(" ") if isinstance(merge, str) else merge
            pair = (self._vocabulary[left], self._vocabulary[right])
            self._merges[pair] = (rank, self._vocabulary[left + right])
        self._unknown = _Unknown(spec, self._vocabulary, spec.get("unk_token"))

    def __call__(self, piece: str) -> list[int]:
        """Ids of a piece. A heap of pairs, so that a long piece costs n log n."""
        ids = self._characters(piece)
        before, after = list(range(-1, len(ids) - 1)), list(range(1, len(ids) + 1))
        heap: list[tuple[int, int, int, int]] = []  # rank, left position, left id, right id

        def offer(left: int) -> None:
            if left >= 0 and after[left] < len(ids):
                pair = (ids[left], ids[after[left]])
                if pair in self._merges:
                    heapq.heappush(heap, (self._merges[pair][0], left, *pair))

        for position in range(len(ids) - 1):
            offer(position)
        while heap:
            _, left, *pair = heapq.heappop(heap)
            right = after[left]
            if right >= len(ids) or [ids[left], ids[right]] != pair:
                continue  # one of the two has been joined to another since
            ids[left], ids[right] = self._merges[pair[0], pair[1]][1], -1
            after[left] = after[right]
            if after[right] < len(ids):
                before[after[right]] = left
            offer(before[left])
            offer(left)
        return [id for id in ids if id >= 0]

    def _characters(self, piece: str) -> list[int]:
        last = len(piece) - 1
        tokens = (character + self._end if index == last else character for index, character in enumerate(piece))
        return self._unknown.filled([(token, self._vocabulary.get(token)) for token in tokens])


class Unigrams:
    """sentencepiece's unigram model: of all ways to cut a piece, the one whose log probabilities sum highest."""

    def __init__(self, spec: dict[str, Any]) -> None:
        self._vocabulary: dict[str, tuple[int, float]] = {}
        for id, (token, score) in enumerate(spec["vocab"]):
            self._vocabulary.setdefault(_text(token), (id, float(score)))
        self._longest = max(map(len, self._vocabulary), default=1)
        self._unknown_score = min((score for _, score in self._vocabulary.values()), default=0.0) - UNKNOWN_PENALTY
        ids = {token: id for token, (id, _) in self._vocabulary.items()}
        unknown = next((token for token, id in ids.items() if id == spec.get("unk_id")), None)
        self._unknown = _Unknown({**spec, "fuse_unk": True}, ids, unknown)

    def __call__(self, piece: str) -> list[int]:
        best: list[tuple[float, int, int | None]] = [(0.0, 0, None)]  # per end: score, start and id of the last token
        best += [(float("-inf"), 0, None)] * len(piece)
        for start in range(len(piece)):
            reached = best[start][0]
            for end in range(start + 1, min(len(piece), start + self._longest) + 1):
                entry = self._vocabulary.get(piece[start:end])
                if entry and reached + entry[1] > best[end][0]:
                    best[end] = (reached + entry[1], start, entry[0])
            if piece[start] not in self._vocabulary and reached + self._unknown_score > best[start + 1][0]:
                best[start + 1] = (reached + self._unknown_score, start, None)
        tokens: list[tuple[str, int | None]] = []
        end = len(piece)
        while end:
            _, start, id = best[end]
            tokens.append((piece[start:end], id))
            end = start
        return self._unknown.filled(tokens[::-1])


class _Unknown:
    """What stands for a character that the vocabulary lacks: its bytes, if all have tokens, else one id, else none."""

    def __init__(self, spec: dict[str, Any], ids: Mapping[str, int], token: str | None) -> None:
        self._bytes = [ids.get(f"<0x{byte:02X}>") for byte in range(256)] if spec.get("byte_fallback") else []
        self._id = None if token is None else ids[token]
        self._fused = bool(spec.get("fuse_unk"))

    def filled(self, tokens: list[tuple[str, int | None]]) -> list[int]:
        """tokens: text and id, None where unknown. fuse_unk: one id for unknown ones in a row."""
        ids: list[int] = []
        after_unknown = False
        for text, id in tokens:
            found = [id] if id is not None else [self._bytes[byte] for byte in text.encode()] if self._bytes else [None]
            known = [one for one in found if one is not None]
            if len(known) == len(found):
                ids += known
                after_unknown = False
            elif self._id is not None:
                if not (after_unknown and self._fused):
                    ids.append(self._id)
                after_unknown = True
        return ids


# Post-processors: ids before and after the text's


def _frame(spec: dict[str, Any] | None) -> tuple[list[int], list[int]]:
    if spec is None or spec["type"] == "ByteLevel":  # ByteLevel only moves offsets
        return [], []
    if spec["type"] == "RobertaProcessing":
        return [_id(spec["cls"][1])], [_id(spec["sep"][1])]
    if spec["type"] == "Sequence":
        frames = [_frame(step) for step in spec["processors"]]
        return [id for before, _ in frames[::-1] for id in before], [id for _, after in frames for id in after]
    if spec["type"] != "TemplateProcessing":
        raise ValueError(f"its post_processor is a {spec['type']!r:.40}: not understood")
    ids: tuple[list[int], list[int]] = ([], [])
    is_after = False
    for item in spec["single"]:
        if "Sequence" in item:
            is_after = True
        else:
            ids[is_after].extend(_id(id) for id in spec["special_tokens"][item["SpecialToken"]["id"]]["ids"])
    return ids


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError(f"{value!r:.40} stands where a text should")
    return value


def _id(value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 1 << 31:
        raise ValueError(f"{value!r:.40} stands where a token id should")
    return value
