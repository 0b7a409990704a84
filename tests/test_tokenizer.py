"""Token ids: a small vocabulary by hand, slow plain merging, and the library that wrote the format."""

from __future__ import annotations

import gzip
import json
import random
import sys
import unicodedata
from itertools import pairwise
from pathlib import Path

import pytest
from text_models import END, MERGES, START, clip_tokenizer

from og_pointcloud.errors import MissingExtraError
from og_pointcloud.text.tokenizer import BYTE_CHARACTERS, BytePairs, ClipTokenizer, OtherTokenizer, open_tokenizer

CLIP_MERGES = Path(__file__).resolve().parents[2] / "shared" / "data" / "clip" / "bpe_simple_vocab_16e6.txt.gz"
NASTY = [
    "", " ", "a", "a photo of a café", "cafe\u0301", "I'M don't WE'LL o'clock '' 's 'S !'s 'x", "日本語の看板 中文",
    "한국어", "\U0001f469\u200d\U0001f469\u200d\U0001f467 \U0001f44d\U0001f3fd \U0001f1e9\U0001f1ea",
    "\x00\x01\x7f a\x1cb\x1d\x85c", "&amp; &lt;b&gt; &#39;", "word " * 200, "1234567 3.14 ½ Ⅷ ² ٣",
    "İstanbul ΣΑΣ ß ﬁ Ǆ",
    "<|startoftext|> hi <|endoftext|>!", "<|STARTOFTEXT|>! x", "!<|ENDOFTEXT|>?", "\ufeffbom\u200bzw\u00a0nb\u3000wide",
    "a" * 3000, "ठ िी عربى עברית", "_under_score_-dash", "\ufffd", "e\u0323\u0307", "a\n\n\t b\r\n", "'''''",
    "....!!!???", "x<|endoftext|>y", "</w> Ġ",
]  # fmt: skip


def tokenizer_of(description, context_length=10**6):
    return open_tokenizer(json.dumps(description).encode(), context_length, 1 << 20)


@pytest.fixture(scope="module")
def small():
    return tokenizer_of(clip_tokenizer(MERGES))


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
    assert small(text) == [START, *ids, END]


def test_a_long_text_loses_its_end_but_not_its_closing_token():
    small = tokenizer_of(clip_tokenizer(MERGES), 7)
    assert small("cat " * 100) == [START, 513, 513, 513, 513, 513, END]
    assert small("cat " * 5) == [START, 513, 513, 513, 513, 513, END]
    assert small("cat") == [START, 513, END]


def test_names_of_special_tokens_are_letters_and_signs(small):
    ids = small("cat<|endoftext|>cat")
    assert ids[0] == START
    assert ids[1] == ids[-2] == 513
    assert END not in ids[1:-1]
    assert len(ids) > 10


def test_a_lone_surrogate_counts_as_the_replacement_character(small):
    assert small("a\ud800b") == small("a\ufffdb")
    assert small("\ud83d\udc4d") == small("\U0001f44d")  # a pair is the character that it spells


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


def test_merging_by_rounds_is_merging_step_by_step():
    source = random.Random(0)
    for _ in range(200):
        tokens = [*"abc", *(f"{letter}</w>" for letter in "abc")]
        merges = []
        for _ in range(8):
            left, right = (
                source.choice([token for token in tokens if not token.endswith("</w>")]),
                source.choice(tokens),
            )
            if (left, right) not in merges and left + right not in tokens:
                merges.append((left, right))
                tokens.append(left + right)
        others = [byte for byte in BYTE_CHARACTERS if byte not in "abc"]
        tokens += [*others, *(f"{byte}</w>" for byte in others)]
        ids = {token: id for id, token in enumerate(tokens)}
        pieces = BytePairs(ids, [" ".join(pair) for pair in merges])
        text = "".join(source.choices("abc", k=source.randrange(1, 25)))
        ranks = {pair: rank for rank, pair in enumerate(merges)}
        expected = merge_plainly([*text[:-1], f"{text[-1]}</w>"], ranks)
        assert pieces(text) == [ids[token] for token in expected]


def test_a_very_long_word_is_no_burden(small):
    assert 1000 < len(small("low" * 30_000)) < 5000


# What is refused, and what goes to another library


def unigrams(**changes):
    """SigLIP's kind of tokenizer: lower case, no punctuation, single spaces, unigrams, an end."""
    patterns = ((r"[!-/:-@\[-`{-~]", ""), (r"\s+", " "))
    replaced = [{"type": "Replace", "pattern": {"Regex": found}, "content": content} for found, content in patterns]
    pieces = [("<unk>", 0.0), ("</s>", 0.0), ("▁", -3.0), ("▁cat", -1.0), ("▁c", -2.0), ("at", -2.5), ("s", -2.0)]
    return {
        "version": "1.0", "truncation": None, "padding": None, "added_tokens": [], "decoder": None,
        "normalizer": {"type": "Sequence", "normalizers": [{"type": "Lowercase"}, *replaced]},
        "pre_tokenizer": {"type": "Metaspace", "replacement": "▁", "prepend_scheme": "always", "split": True},
        "model": {"type": "Unigram", "unk_id": 0, "vocab": pieces, "byte_fallback": False},
        "post_processor": {
            "type": "TemplateProcessing", "pair": [],
            "single": [{"Sequence": {"id": "A", "type_id": 0}}, {"SpecialToken": {"id": "</s>", "type_id": 0}}],
            "special_tokens": {"</s>": {"id": "</s>", "ids": [1], "tokens": ["</s>"]}},
        },
        **changes,
    }  # fmt: skip


def test_unigrams_go_through_tokenizers():
    pytest.importorskip("tokenizers")
    tokenizer = tokenizer_of(unigrams(), 4)
    assert isinstance(tokenizer, OtherTokenizer)
    assert tokenizer("Cats!") == [3, 6, 1]
    assert tokenizer("") == [1]
    assert tokenizer("cat " * 10_000) == [3, 3, 3, 1]
    assert tokenizer("cat\ud800") == [3, 0, 1]
    assert tokenizer.highest_id == 6


def test_without_tokenizers_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "tokenizers", None)
    assert isinstance(tokenizer_of(clip_tokenizer(MERGES)), ClipTokenizer)
    with pytest.raises(MissingExtraError, match=r"og-pointcloud\[words\]"):
        tokenizer_of(unigrams())


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"model": {"type": "WordPiece", "vocab": {}}}, "model is a 'WordPiece'"),
        (
            {"normalizer": {"type": "Replace", "pattern": {"Regex": "(a+)+$"}, "content": ""}},
            r"uses the pattern '\(a",
        ),
        (
            {"pre_tokenizer": {"type": "Split", "pattern": {"Regex": "(x|x)*y"}, "behavior": "Removed"}},
            "uses the pattern",
        ),
        ({"model": {**clip_tokenizer([])["model"], "merges": ["a bc"]}}, "not in the form"),
        ({"model": {**clip_tokenizer([])["model"], "vocab": {"a": 0}}}, "lacks 256 of the 256 bytes"),
        ({"model": {**clip_tokenizer([])["model"], "vocab": {"a": "0"}}}, "'0' is in the place of a token id"),
        ({"model": {**clip_tokenizer([])["model"], "dropout": 0.1}}, "dropout 0.1"),
        ({"model": None}, "not in the form"),
        ({"post_processor": {"type": "RobertaProcessing"}}, "not in the form"),
    ],
)
def test_what_is_refused_is_named(change, says):
    with pytest.raises(ValueError, match=says):
        tokenizer_of({**clip_tokenizer(MERGES), **change})


@pytest.mark.parametrize(
    "change",
    [
        {"model": {"type": "Unigram", "vocab": [["a"]]}},
        {"model": {"type": "Unigram", "vocab": [["a", 0.0]], "unk_id": 7}},
        {"normalizer": {"type": "Precompiled", "precompiled_charsmap": "////fwAAAAA="}},
        {"pre_tokenizer": {"type": "Unheard"}},
        {"post_processor": {"type": "TemplateProcessing", "single": [], "pair": [], "special_tokens": 3}},
    ],
)
def test_what_tokenizers_does_not_read_is_a_plain_error(change):
    pytest.importorskip("tokenizers")
    with pytest.raises(ValueError, match="tokenizers does not read it"):
        tokenizer_of(unigrams(**change))


@pytest.mark.parametrize("data", [b"", b"[]", b"[" * 100_000, b'{"model": 3}', b"\xff\xfe"])
def test_bytes_that_are_no_description(data):
    with pytest.raises(ValueError, match=r".+"):
        open_tokenizer(data, 77, 1 << 20)


# Against the libraries


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


@pytest.mark.slow
@pytest.mark.parametrize("full", [False, True])
def test_clip_ids_are_those_of_transformers(full, request):
    """With a few merges, and with CLIP's own where its list is at hand."""
    transformers = pytest.importorskip("transformers")
    merges = request.getfixturevalue("clip_merges") if full else MERGES
    description = clip_tokenizer(merges)
    theirs = transformers.CLIPTokenizer(vocab=description["model"]["vocab"], merges=merges)
    as_transformers_writes_it = json.loads(theirs.backend_tokenizer.to_str())
    ours, cut = tokenizer_of(as_transformers_writes_it), tokenizer_of(as_transformers_writes_it, 77)
    of_old_folders = tokenizer_of(description)
    assert isinstance(ours, ClipTokenizer)
    assert isinstance(of_old_folders, ClipTokenizer)
    source = random.Random(1)
    compared = 0
    for text in NASTY + [some_text(source) for _ in range(800)]:
        if "<|" in text:  # names of special tokens are words to ours
            continue
        expected = theirs(text)["input_ids"]
        assert ours(text) == expected, repr(text)
        assert cut(text) == theirs(text, truncation=True, max_length=77)["input_ids"], repr(text)
        assert of_old_folders(text) == expected, repr(text)
        compared += len(expected)
    assert compared > 20_000


@pytest.mark.slow
def test_clip_ids_known_from_its_publication(clip_merges):
    ours = tokenizer_of(clip_tokenizer(clip_merges), 77)
    assert ours("a photo of a cat") == [49406, 320, 1125, 539, 320, 2368, 49407]
    assert ours("a diagram") == [49406, 320, 22697, 49407]
