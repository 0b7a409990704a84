"""Token ids: a small vocabulary by hand, slow plain merging, and the libraries that wrote the formats."""

from __future__ import annotations

import base64
import gzip
import json
import random
import re
import string
import struct
import unicodedata
from itertools import pairwise
from pathlib import Path

import pytest
from og_pointcloud_export.text_tokenizer import clip_description, siglip_description

from og_pointcloud.text.tokenizer import BYTE_CHARACTERS, WHITESPACE, BytePairs, CharacterMap, Tokenizer, Unigrams

CLIP_MERGES = Path(__file__).resolve().parents[2] / "shared" / "data" / "clip" / "bpe_simple_vocab_16e6.txt.gz"
SMALL_MERGES = [("a", "t</w>"), ("c", "at</w>"), ("l", "o"), ("lo", "w</w>"), ("lo", "w"), ("e", "r</w>")]
START, END = 512 + len(SMALL_MERGES), 513 + len(SMALL_MERGES)
NASTY = [
    "", " ", "a", "a photo of a café", "cafe\u0301", "I'M don't WE'LL o'clock '' 's 'S !'s 'x", "日本語の看板 中文",
    "한국어", "\U0001f469\u200d\U0001f469\u200d\U0001f467 \U0001f44d\U0001f3fd \U0001f1e9\U0001f1ea",
    "\x00\x01\x7f a\x1cb\x1d\x85c", "&amp; &lt;b&gt; &#39;", "word " * 200, "1234567 3.14 ½ Ⅷ ² ٣",
    "İstanbul ΣΑΣ ß ﬁ Ǆ",
    "<|startoftext|> hi <|endoftext|>!", "<|STARTOFTEXT|>! x", "!<|ENDOFTEXT|>?", "\ufeffbom\u200bzw\u00a0nb\u3000wide",
    "a" * 3000, "ठ िी عربى עברית", "_under_score_-dash", "\ufffd", "e\u0323\u0307", "a\n\n\t b\r\n", "'''''",
    "....!!!???", "x<|endoftext|>y", "</w> Ġ",
]  # fmt: skip


def tokenizer_of(description) -> Tokenizer:
    return Tokenizer(json.dumps(description).encode())


@pytest.fixture(scope="module")
def small() -> Tokenizer:
    return tokenizer_of(clip_description(SMALL_MERGES))


def byte(character: str, *, last: bool) -> int:
    """Ids of ASCII signs in CLIP's vocabulary: from '!' on, 256 more at a word's end."""
    return ord(character) - ord("!") + 256 * last


@pytest.mark.parametrize(
    ("text", "ids"),
    [
        ("", []),
        (" \t\n", []),
        ("at", [512]),
        ("cat", [513]),
        ("CAT  cat", [513, 513]),
        ("low", [515]),
        ("lower", [516, 517]),  # lo w, then e r
        ("lowat", [516, 512]),
        ("loc", [514, byte("c", last=True)]),
        ("!", [byte("!", last=True)]),
        ("cat's", [513, byte("'", last=False), byte("s", last=True)]),
        ("12", [byte("1", last=True), byte("2", last=True)]),
        # é is C3 A9: the letters of both bytes are among the printable ones of Latin-1.
        ("é", [94 + 0xC3 - 0xA1 - 1, 256 + 94 + 0xA9 - 0xA1]),
        ("e\u0301", [94 + 0xC3 - 0xA1 - 1, 256 + 94 + 0xA9 - 0xA1]),
    ],
)
def test_a_small_vocabulary_by_hand(small, text, ids):
    assert small(text, 77) == [START, *ids, END]


def test_a_long_text_loses_its_end_but_not_its_closing_token(small):
    assert small("cat " * 100, 7) == [START, 513, 513, 513, 513, 513, END]
    assert small("cat " * 5, 7) == [START, 513, 513, 513, 513, 513, END]
    assert small("cat", 7) == [START, 513, END]


def test_special_words_are_tokens_of_their_own(small):
    assert small("cat<|endoftext|>cat", 77) == [START, 513, END, 513, END]


def test_a_lone_surrogate_counts_as_the_replacement_character(small):
    assert small("a\ud800b", 77) == small("a\ufffdb", 77)
    assert small("\ud83d\udc4d", 77) == small("\U0001f44d", 77)  # a pair is the character that it spells


def test_every_byte_has_a_character_of_its_own():
    assert len(set(BYTE_CHARACTERS)) == 256
    assert not any(character.isspace() for character in BYTE_CHARACTERS)
    assert BYTE_CHARACTERS[ord("a")] == "a"
    assert BYTE_CHARACTERS[0] == "Ā"


def merge_plainly(symbols: list[str], ranks: dict[tuple[str, str], int]) -> list[str]:
    """Join the best pair, leftmost first, until none is left."""
    while True:
        pairs = [(ranks[pair], place) for place, pair in enumerate(pairwise(symbols)) if pair in ranks]
        if not pairs:
            return symbols
        _, place = min(pairs)
        symbols = [*symbols[:place], symbols[place] + symbols[place + 1], *symbols[place + 2 :]]


def test_merging_by_heap_is_merging_step_by_step():
    source = random.Random(0)
    for _ in range(200):
        tokens = list("abc")
        merges = []
        for _ in range(8):
            pair = (source.choice(tokens), source.choice(tokens))
            if pair not in merges and "".join(pair) not in tokens:
                merges.append(pair)
                tokens.append("".join(pair))
        ids = {token: id for id, token in enumerate(tokens)}
        pieces = BytePairs({"vocab": ids, "merges": [" ".join(pair) for pair in merges]})
        text = "".join(source.choices("abc", k=source.randrange(25)))
        ranks = {pair: rank for rank, pair in enumerate(merges)}
        assert pieces(text) == [ids[token] for token in merge_plainly(list(text), ranks)]


def test_a_very_long_word_is_no_burden(small):
    assert len(small("low" * 30_000, 10**6)) == 30_002


@pytest.mark.parametrize(
    ("spec", "text", "ids"),
    [
        ({"unk_token": "?"}, "axya", [1, 0, 0, 1]),
        ({"unk_token": "?", "fuse_unk": True}, "axya", [1, 0, 1]),
        ({}, "axya", [1, 1]),
        ({"byte_fallback": True, "unk_token": "?"}, "aéa", [1, 2, 3, 1]),
        ({"byte_fallback": True, "unk_token": "?"}, "axa", [1, 0, 1]),
    ],
)
def test_what_the_vocabulary_lacks(spec, text, ids):
    vocabulary = {"?": 0, "a": 1, "<0xC3>": 2, "<0xA9>": 3}
    assert BytePairs({"vocab": vocabulary, "merges": [], **spec})(text) == ids


@pytest.mark.parametrize(
    ("pattern", "cleaned"),
    [
        (r"\s+", "a-b._c-"),
        ("[,-.]", "a  b_c\t\u00a0"),  # a range
        (r"[\-\.]", "a  b_c\t\u00a0"),
        (" {2,}", "a-b._c-\t\u00a0"),
    ],
)
def test_what_a_replacement_finds(pattern, cleaned):
    replace = {"type": "Replace", "pattern": {"Regex": pattern}, "content": ""}
    tokenizer = tokenizer_of({**clip_description(SMALL_MERGES), "normalizer": replace})
    assert tokenizer._normalize("a-  b._c-\t\u00a0") == cleaned


def test_unigrams_are_cut_where_the_scores_sum_highest():
    vocabulary = [["<unk>", 0.0], ["a", -1.0], ["b", -1.0], ["ab", -2.5], ["aba", -2.6]]
    model = Unigrams({"vocab": vocabulary, "unk_id": 0})
    assert model("ab") == [1, 2]  # -2 against -2.5
    assert model("aba") == [4]  # -2.6 against -3
    assert model("abab") == [4, 2]
    assert model("xaxx") == [0, 1, 0]
    assert model("") == []


def character_map(entries: dict[str, str]) -> bytes:
    """A double-array trie, built the slow way: the first place where a node's children are all free."""
    replacements, offsets = b"", {}
    for key, value in entries.items():
        offsets[key.encode()] = len(replacements)
        replacements += value.encode() + b"\0"
    cells = [0] * 4096
    taken = {0}

    def place(node: int, prefix: bytes) -> None:
        labels = sorted(
            {key[len(prefix)] if len(key) > len(prefix) else 0 for key in offsets if key.startswith(prefix)}
        )
        offset = next(
            base
            for base in range(1, 1024)
            if all((node ^ base ^ label) not in taken and node ^ base ^ label for label in labels)
        )
        cells[node] |= offset << 10
        taken.update(node ^ offset ^ label for label in labels)
        for label in labels:
            child = node ^ offset ^ label
            if label == 0:
                cells[node] |= 1 << 8
                cells[child] = 1 << 31 | offsets[prefix]
            else:
                cells[child] = label
                place(child, prefix + bytes([label]))

    place(0, b"")
    return struct.pack("<I", 4 * len(cells)) + struct.pack(f"<{len(cells)}I", *cells) + replacements


def test_a_character_map_takes_the_longest_entry():
    table = CharacterMap(character_map({"ﬁ": "fi", "e\u0301": "é", "e": "E", "\t": " ", "\x01": ""}))
    assert table("ﬁx\te\u0301e\x01日") == "fix éE日"
    assert table("") == ""


@pytest.mark.parametrize("data", [b"", b"\x00", struct.pack("<I", 400) + bytes(8), struct.pack("<I", 2) + bytes(8)])
def test_a_character_map_that_claims_more_than_it_has(data):
    with pytest.raises(ValueError, match=r"claims a trie|not in the form"):
        tokenizer_of(
            {
                "model": {"type": "BPE", "vocab": {}, "merges": []},
                "normalizer": {"type": "Precompiled", "precompiled_charsmap": base64.b64encode(data).decode()},
            }
        )


def test_a_character_map_of_noise_ends():
    source = random.Random(0)
    for _ in range(200):
        noise = source.randbytes(4 * source.randrange(1, 200))
        CharacterMap(struct.pack("<I", len(noise)) + noise + source.randbytes(9))("any text, ünd more\x00")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"model": {"type": "WordPiece", "vocab": {}}}, "model is a 'WordPiece'"),
        ({"normalizer": {"type": "BertNormalizer"}}, "normalizer is a 'BertNormalizer'"),
        (
            {"normalizer": {"type": "Replace", "pattern": {"Regex": "(a+)+$"}, "content": ""}},
            r"replaces the pattern '\(a",
        ),
        ({"normalizer": {"type": "Replace", "pattern": {"Regex": "[!&&~]"}, "content": ""}}, "replaces the pattern"),
        ({"normalizer": {"type": "Replace", "pattern": {"Regex": "[~-!]"}, "content": ""}}, "replaces the pattern"),
        ({"pre_tokenizer": {"type": "BertPreTokenizer"}}, "pre_tokenizer is a 'BertPreTokenizer'"),
        ({"pre_tokenizer": {"type": "ByteLevel", "add_prefix_space": True}}, "a space before"),
        ({"pre_tokenizer": {"type": "Split", "pattern": {"Regex": "x"}, "behavior": "Removed"}}, "splits at"),
        ({"pre_tokenizer": {"type": "Metaspace", "replacement": "_", "prepend_scheme": "first"}}, "prepends 'first'"),
        ({"post_processor": {"type": "BertProcessing"}}, "post_processor is a 'BertProcessing'"),
        ({"added_tokens": [{"content": "x", "id": 1, "single_word": True}]}, "single word"),
        ({"added_tokens": [{"content": "x", "id": -1}]}, "-1 stands where a token id"),
        ({"added_tokens": [{"id": 1}]}, "not in the form"),
        ({"model": {"type": "BPE", "vocab": {"a": 0}, "merges": ["a b"]}}, "not in the form"),
        ({"model": {"type": "BPE", "vocab": {"a": "0"}, "merges": []}}, "'0' stands where a token id"),
        ({"model": {"type": "BPE", "vocab": {}, "merges": [], "dropout": 0.1}}, "dropout 0.1"),
        ({"model": {"type": "Unigram", "vocab": [["a"]]}}, "values to unpack"),
        ({"model": None}, "not in the form"),
    ],
)
def test_what_is_not_understood_is_named(change, says):
    with pytest.raises(ValueError, match=says):
        tokenizer_of({**clip_description(SMALL_MERGES), **change})


@pytest.mark.parametrize("data", [b"", b"[]", b"[" * 100_000, b'{"model": 3}', b"\xff\xfe"])
def test_bytes_that_are_no_description(data):
    with pytest.raises(ValueError, match=r".+"):
        Tokenizer(data)


def some_text(source: random.Random) -> str:
    """Characters of all planes that this Python's Unicode knows: libraries differ in the newest ones."""
    pools = [
        "abc XYZ'.,!?&;<|>_-0123 \n",
        "ÀÉßñçøłžαβγЖдй",
        "̧́̈",
        "日本語中文한국ひカ",
        "\U0001f600\U0001f44d\U0001f3fd\u200d\ufe0f",
    ]
    text = "".join(source.choice(source.choice(pools)) for _ in range(source.randrange(1, 30)))
    for _ in range(source.randrange(4)):
        character = chr(source.choice([source.randrange(0x20, 0x3000), source.randrange(0xE000, 0x1F000)]))
        # Of the newest marks, libraries disagree on the order in which they combine.
        if unicodedata.category(character) != "Cn" and not unicodedata.combining(character):
            text += character
    return text


@pytest.fixture(scope="module")
def clip_merges():
    if not CLIP_MERGES.is_file():
        pytest.skip("CLIP's merges are absent")
    lines = gzip.decompress(CLIP_MERGES.read_bytes()).decode().split("\n")[1:48895]
    return [tuple(line.split()) for line in lines]


def test_clip_ids_are_those_of_transformers(clip_merges):
    transformers = pytest.importorskip("transformers")
    description = clip_description(clip_merges)
    theirs = transformers.CLIPTokenizer(vocab=description["model"]["vocab"], merges=clip_merges)
    of_theirs = Tokenizer(theirs.backend_tokenizer.to_str().encode())
    ours = tokenizer_of(description)
    source = random.Random(1)
    compared = 0
    for text in NASTY + [some_text(source) for _ in range(800)]:
        expected = theirs(text)["input_ids"]
        assert of_theirs(text, 10**6) == expected, repr(text)
        assert of_theirs(text, 77) == theirs(text, truncation=True, max_length=77)["input_ids"], repr(text)
        if "|" not in text:  # our own description has no second name for special words
            assert ours(text, 10**6) == expected, repr(text)
        compared += len(expected)
    assert compared > 20_000


def test_clip_ids_known_from_its_publication(clip_merges):
    ours = tokenizer_of(clip_description(clip_merges))
    assert ours("a photo of a cat", 77) == [49406, 320, 1125, 539, 320, 2368, 49407]
    assert ours("a diagram", 77) == [49406, 320, 22697, 49407]


def test_siglip_ids_are_those_of_sentencepiece(tmp_path):
    sentencepiece = pytest.importorskip("sentencepiece")
    (tmp_path / "corpus.txt").write_text(
        "a photo of a red mug on the table\nthe quick brown fox jumps over the lazy dog\ncafé déjà vu naïve façade\n"
        "open vocabulary labels for point clouds\n日本語 の テキスト\nkitchen chair desk lamp window door sofa\n" * 40
    )
    sentencepiece.SentencePieceTrainer.train(
        input=str(tmp_path / "corpus.txt"), model_prefix=str(tmp_path / "spiece"), vocab_size=180, pad_id=0, eos_id=1,
        unk_id=2, bos_id=-1, normalization_rule_name="nmt_nfkc", hard_vocab_limit=False, minloglevel=2,
    )  # fmt: skip
    theirs = sentencepiece.SentencePieceProcessor(model_file=str(tmp_path / "spiece.model"))
    ours = tokenizer_of(siglip_description((tmp_path / "spiece.model").read_bytes()))
    source = random.Random(2)
    for text in NASTY + [some_text(source) for _ in range(1000)]:
        if "|" in text or "▁" in text:
            continue
        # SigLIP's own cleaning, which comes before its pieces.
        cleaned = "".join(map(str.lower, text)).translate(dict.fromkeys(map(ord, string.punctuation)))
        cleaned = re.sub(f"[{WHITESPACE}]+", " ", cleaned)
        assert ours(text, 10**6) == [*theirs.encode(cleaned), 1], repr(text)
    assert ours("red mug " * 100, 64)[-1] == 1
    assert len(ours("red mug " * 100, 64)) == 64


def test_gemma_ids_are_those_of_tokenizers():
    tokenizers = pytest.importorskip("tokenizers")
    bytes_ = [f"<0x{byte:02X}>" for byte in range(256)]
    tokens = [
        "<pad>",
        "<eos>",
        "<unk>",
        *bytes_,
        *"abcdefghijklmnopqrstuvwxyz▁",
        "re",
        "red",
        "▁r",
        "▁red",
        "mu",
        "mug",
    ]
    merges = [("r", "e"), ("re", "d"), ("▁", "red"), ("m", "u"), ("mu", "g")]
    theirs = tokenizers.Tokenizer(
        tokenizers.models.BPE(
            vocab={token: id for id, token in enumerate(tokens)}, merges=merges, fuse_unk=True, byte_fallback=True,
            unk_token="<unk>",
        )
    )  # fmt: skip
    theirs.normalizer = tokenizers.normalizers.Sequence(
        [tokenizers.normalizers.Lowercase(), tokenizers.normalizers.Replace(" ", "▁")]
    )
    theirs.pre_tokenizer = tokenizers.pre_tokenizers.Split(" ", "merged_with_previous")
    theirs.post_processor = tokenizers.processors.TemplateProcessing("$A <eos>", special_tokens=[("<eos>", 1)])
    ours = Tokenizer(theirs.to_str().encode())
    source = random.Random(3)
    for text in [*NASTY, "Red mug", " red  red", *(some_text(source) for _ in range(500))]:
        assert ours(text, 10**6) == theirs.encode(text).ids, repr(text)
