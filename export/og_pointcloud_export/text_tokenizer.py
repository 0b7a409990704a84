"""tokenizer.json of an encoder: the model's own, or written from the merges or the sentencepiece file beside it."""

from __future__ import annotations

import base64
import json
import struct
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.models import message_fields
from og_pointcloud.text.encoder import ENCODER_FILES, TOKENIZER
from og_pointcloud.text.tokenizer import BYTE_CHARACTERS, CLIP_WORDS

if TYPE_CHECKING:
    from og_pointcloud_export.text_weights import TextTower

__all__ = ["clip_description", "find_tokenizer", "read_json", "siglip_description"]

CLIP_START, CLIP_END = "<|startoftext|>", "<|endoftext|>"
TOKENIZER_FILES = (TOKENIZER, "bpe_simple_vocab_16e6.txt.gz", "merges.txt", "spiece.model")
"""In the order in which they are believed."""
PUNCTUATION = r"[!-/:-@\[-`{-~]"
UNIGRAM = 1


def find_tokenizer(source: Path, chosen: Path | None, tower: TextTower) -> tuple[dict[str, Any], int | None]:
    """The description, as of a tokenizer.json, and the id that fills texts up to the context (None: nothing does).

    chosen: a file of one of the four kinds, or None for the first of them beside the weights.
    """
    folder = source if source.is_dir() else source.parent
    path = chosen or next((folder / name for name in TOKENIZER_FILES if (folder / name).is_file()), None)
    if path is None or not path.is_file():
        raise OgPointcloudError(
            f"{path or folder} {'is not a file' if path else 'holds no tokenizer'}; expected one of "
            f"{', '.join(TOKENIZER_FILES)} beside the weights, or --tokenizer FILE"
        )
    if path.name.endswith(".json"):
        description = read_json(path)
        if not tower.causal:
            description = _lower_casing(description)
    elif path.name.endswith(".model"):
        description = siglip_description(_bounded(path))
    else:
        merges = _read_merges(path, len(tower.token_embedding))
        description = clip_description(merges)
    return description, None if tower.causal else _pad_id(path, description)


def clip_description(merges: Iterable[tuple[str, str]]) -> dict[str, Any]:
    """CLIP's tokenizer from its merges: ids are the 256 bytes, the bytes at a word's end, the merges, start, end."""
    merges = list(merges)
    letters = [character for _, character in sorted(zip(_byte_order(), BYTE_CHARACTERS, strict=True))]
    tokens = [*letters, *(letter + "</w>" for letter in letters), *(left + right for left, right in merges)]
    ids = {token: id for id, token in enumerate([*tokens, CLIP_START, CLIP_END])}
    ends = [[token, ids[token]] for token in (CLIP_END, CLIP_START)]
    return {
        "version": "1.0",
        "added_tokens": [{"id": id, "content": token, "special": True, "normalized": False} for token, id in ends],
        "normalizer": _sequence("normalizers", {"type": "NFC"}, _replace(r"\s+", " "), {"type": "Lowercase"}),
        "pre_tokenizer": _sequence(
            "pretokenizers",
            {"type": "Split", "pattern": {"Regex": CLIP_WORDS}, "behavior": "Removed", "invert": True},
            {"type": "ByteLevel", "add_prefix_space": False},
        ),
        "model": {
            "type": "BPE",
            "unk_token": CLIP_END,
            "end_of_word_suffix": "</w>",
            "vocab": ids,
            "merges": [f"{left} {right}" for left, right in merges],
        },
        "post_processor": {"type": "RobertaProcessing", "sep": ends[0], "cls": ends[1]},
    }


def siglip_description(spiece: bytes) -> dict[str, Any]:
    """SigLIP's tokenizer from its sentencepiece file: lower case, no punctuation, single spaces, then its pieces."""
    pieces, character_map, model_kind = _read_sentencepiece(spiece)
    ids = {text: id for id, (text, _, _) in enumerate(pieces)}
    unknown = next((id for id, (_, _, kind) in enumerate(pieces) if kind == 2), None)
    if model_kind != UNIGRAM or unknown is None or "</s>" not in ids:
        raise OgPointcloudError(
            f"the sentencepiece model is of kind {model_kind}, {len(pieces)} pieces; expected SigLIP's: unigrams, with "
            "an unknown piece and '</s>'"
        )
    steps = [{"type": "Lowercase"}, _replace(PUNCTUATION, ""), _replace(r"\s+", " ")]
    if character_map:
        steps.append({"type": "Precompiled", "precompiled_charsmap": base64.b64encode(character_map).decode()})
    steps += [_replace(" {2,}", " "), {"type": "Strip", "strip_left": True, "strip_right": True}]
    return {
        "version": "1.0",
        "added_tokens": [],
        "normalizer": _sequence("normalizers", *steps),
        "pre_tokenizer": {"type": "Metaspace", "replacement": "▁", "prepend_scheme": "always", "split": True},
        "model": {"type": "Unigram", "unk_id": unknown, "vocab": [[text, score] for text, score, _ in pieces]},
        "post_processor": {
            "type": "TemplateProcessing",
            "single": [{"Sequence": {"id": "A"}}, {"SpecialToken": {"id": "</s>"}}],
            "special_tokens": {"</s>": {"ids": [ids["</s>"]]}},
        },
        "pad_token": "</s>",
    }


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object from a file of bounded size; OgPointcloudError for anything else."""
    try:
        if path.stat().st_size > ENCODER_FILES[TOKENIZER]:
            raise ValueError(f"it has more than {ENCODER_FILES[TOKENIZER]} bytes")
        value = json.loads(path.read_bytes())
        if not isinstance(value, dict):
            raise ValueError(f"it holds a {type(value).__name__}, not an object")
    except (ValueError, OSError, RecursionError) as error:
        raise OgPointcloudError(f"{path} cannot be read as JSON ({error}): fetch it again") from None
    return value


def _byte_order() -> list[int]:
    """Place of each byte in CLIP's vocabulary: printable ones first."""
    ranks = sorted(range(256), key=lambda byte: (ord(BYTE_CHARACTERS[byte]) >= 256, byte))
    return [ranks.index(byte) for byte in range(256)]


def _sequence(name: str, *steps: dict[str, Any]) -> dict[str, Any]:
    return {"type": "Sequence", name: list(steps)}


def _replace(pattern: str, content: str) -> dict[str, Any]:
    return {"type": "Replace", "pattern": {"Regex": pattern}, "content": content}


def _lower_casing(description: dict[str, Any]) -> dict[str, Any]:
    """SigLIP 2 was trained on lower case, which the Gemma tokenizer.json that its models carry does not say."""
    model = description.get("model")
    said = json.dumps(description.get("normalizer"))
    if not isinstance(model, dict) or model.get("type") == "Unigram" or '"Lowercase"' in said:
        return description
    steps = [{"type": "Lowercase"}, *filter(None, [description.get("normalizer")])]
    return {**description, "normalizer": _sequence("normalizers", *steps)}


def _read_merges(path: Path, vocabulary: int) -> list[tuple[str, str]]:
    """The merges of a merges.txt, or of CLIP's bpe_simple_vocab_16e6.txt.gz, which holds more than CLIP uses."""
    data = _bounded(path)
    if path.suffix == ".gz":
        try:
            data = zlib.decompressobj(zlib.MAX_WBITS | 16).decompress(data, ENCODER_FILES[TOKENIZER])
        except zlib.error as error:
            raise OgPointcloudError(f"{path} cannot be unpacked ({error}): fetch it again") from None
    count = vocabulary - 2 * len(BYTE_CHARACTERS) - 2
    lines = data.decode("utf-8", "replace").rstrip("\n").split("\n")
    header = int("#version" in lines[0])
    merges = [tuple(line.split(" ")) for line in lines[header : header + max(0, count)]]
    if len(merges) != count or any(len(merge) != 2 for merge in merges):
        raise OgPointcloudError(
            f"{path} has {len(lines) - header} merges; expected at least {count}, two parts a line, for the "
            f"{vocabulary} tokens of the weights: name the tokenizer that belongs to them (--tokenizer)"
        )
    return [(left, right) for left, right in merges]


def _read_sentencepiece(data: bytes) -> tuple[list[tuple[str, float, int]], bytes, int]:
    """Pieces (text, score, kind), the map of characters, and the kind of model: protobuf, by its field numbers."""
    pieces, character_map, model_kind = [], b"", UNIGRAM
    try:
        for number, value in message_fields(memoryview(data)):
            if number == 1:
                piece = dict(message_fields(value))
                (score,) = struct.unpack("<f", bytes(piece.get(2, bytes(4))))
                pieces.append((bytes(piece[1]).decode(), score, int(piece.get(3, 1))))
            elif number == 2:
                model_kind = dict(message_fields(value)).get(3, UNIGRAM)
            elif number == 3:
                character_map = bytes(dict(message_fields(value)).get(2, b""))
    except (ValueError, KeyError, TypeError, struct.error) as error:
        raise OgPointcloudError(f"the sentencepiece model cannot be read ({error}): fetch it again") from None
    return pieces, character_map, int(model_kind)


def _pad_id(path: Path, description: dict[str, Any]) -> int:
    """What fills a text up to the context, where every token sees it and it must be the one of training."""
    beside = path.with_name("tokenizer_config.json")
    config = read_json(beside) if beside.is_file() else {}
    named = config.get("pad_token", description.pop("pad_token", None))
    token = named.get("content") if isinstance(named, dict) else named
    added = {entry["content"]: entry["id"] for entry in description.get("added_tokens") or []}
    vocabulary = description["model"]["vocab"]
    ids = vocabulary if isinstance(vocabulary, dict) else {entry[0]: id for id, entry in enumerate(vocabulary)}
    id = {**ids, **added}.get(token)
    if id is None or config.get("padding_side", "right") != "right":
        raise OgPointcloudError(
            f"{beside} has pad_token {token!r:.40}, padding_side {config.get('padding_side')!r:.20}; expected a token "
            "of the vocabulary, on the right, since this model reads texts filled up to its context: write both there"
        )
    return id


def _bounded(path: Path) -> bytes:
    if path.stat().st_size > ENCODER_FILES[TOKENIZER]:
        raise OgPointcloudError(f"{path} has {path.stat().st_size} bytes; expected at most {ENCODER_FILES[TOKENIZER]}")
    return path.read_bytes()
