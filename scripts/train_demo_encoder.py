"""Trains the demo encoder: a tiny image encoder and a tiny text encoder that know the procedural room's things.

    python scripts/train_demo_encoder.py              # writes og_pointcloud/masking/demo_encoder, then measures it
    python scripts/train_demo_encoder.py --measure    # measures the existing one

Crops of some thousand masks of rendered rooms and the words for what they show are aligned by the usual contrastive
loss; words for nothing in the room, many of them made up, are negatives. Half of the masks come from a careless
proposer that knows things, half from OpenCV: pieces of things, of walls and of the floor with its shadows. The text
side is a one-block CLIP text tower, exported like any other; the image side is a small convolutional net. Measuring
uses rooms of other seeds than training, and neither uses the demo's own (0, 1, 2 ...).

It is a demo encoder: it knows these rooms, nineteen kinds of things and their synonyms, and nothing else.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections import Counter, OrderedDict
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from og_pointcloud_export.encoders import write_image_encoder, write_text_encoder
from og_pointcloud_room.capture import CaptureSettings, RoomCapture, make_capture
from og_pointcloud_room.furniture import CLASS_NAMES
from og_pointcloud_room.raycast import Frame
from og_pointcloud_room.words import RELATED, SYNONYMS
from onnx import TensorProto, helper, numpy_helper
from torch import nn
from transformers import CLIPTokenizer

from og_pointcloud.masking.contracts import LEVELS, ImageModel
from og_pointcloud.masking.crops import Crop, Preprocessing, mask_crops
from og_pointcloud.masking.encode import DEMO_SPACE, open_encoder
from og_pointcloud.masking.levels import masks_of_level
from og_pointcloud.masking.opencv import OpenCVProposer
from og_pointcloud.text.encoder import DEMO_ENCODER, read_text_encoder
from og_pointcloud.text.encoder import TextEncoder as TrainedTextEncoder
from og_pointcloud.text.text_features import everyday_words
from og_pointcloud.text.tokenizer import BYTE_CHARACTERS, Tokenizer, open_tokenizer

Random = np.random.Generator

TRAINING_SEEDS, MEASURING_SEEDS = range(1000, 1096), range(2000, 2004)
KINDS = tuple(SYNONYMS)
WALL, FLOOR = KINDS.index("wall"), KINDS.index("floor")
NAMES = tuple(word for synonyms in SYNONYMS.values() for word in synonyms)
CROPS = (Crop(1.15, 0.15), Crop(1.8, 0.5), Crop(4.0, 0.7))
"""One shows the shape, one the surroundings, one what a piece belongs to."""
PROPOSALS = 40
"""Number of OpenCV's masks taken per view."""
FEWEST_PX, PUREST = 50, 0.5
"""Masks with fewer pixels, or in which no kind fills more than this share, are not trained on."""
PREPROCESSING = Preprocessing(48, mean=(0.486, 0.455, 0.408), std=(0.25, 0.25, 0.25), resample="bilinear")
WIDTH, CONTEXT, TEXT_WIDTH, HEADS, MERGES = 64, 16, 64, 4, 600
CHANNELS = ((3, 24, 5, 2), (24, 40, 3, 2), (40, 40, 3, 1), (40, 80, 3, 2), (80, 80, 3, 1), (80, 160, 3, 2))
"""Per convolution: channels in and out, kernel size, stride."""
BATCH, PHRASES, ABSENT, LEARNING_RATE = 64, 3, 140, 3e-3
MADE_UP = 0.5
"""Share of the words for nothing in the room that are not real words."""
HUE_TURN = 0.5
"""Standard deviation in radians, for every other mask: things come in all colors, though wood and leaves do not."""
SHARPNESS, WORD_SHARPNESS = 16.0, 10.0
"""Factors on cosines in the contrastive loss, and in the term that separates words: pieces of a table and of the floor
look alike, but if the two words were close, each would count as the other's synonym when labels are judged."""

TEMPLATES = (
    "{}", "{}", "{}", "{}.", "a {}", "the {}", "one {}", "my {}", "a photo of a {}", "a photo of the {}",
    "a cropped photo of a {}", "a {} in a scene", "a {} in a room", "this is a {}", "find the {}", "where is the {}",
    "show me the {}", "a picture showing a {}", "an image of a {}", "all the {}", "some {}", "two {}", "several {}",
)  # fmt: skip
ADJECTIVES = (
    "red", "green", "blue", "yellow", "white", "black", "brown", "grey", "orange", "pink", "purple", "small", "large",
    "old", "big", "wooden", "dark", "bright", "little", "round", "empty", "new", "nice",
)  # fmt: skip
NEW_TEMPLATES = ("a rendering of a {}", "there is a {} here", "a shiny turquoise {}", "look at these {}")
"""For measuring: none of these is used above."""


# Crops and what they show ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Crops:
    """pixels: (M, crops, S, S, 3) uint8. kinds: (M,) index into KINDS of what most of each mask shows. proposed: (M,)
    whether OpenCV proposed it."""

    pixels: NDArray[np.uint8]
    kinds: NDArray[np.int64]
    proposed: NDArray[np.bool_]

    def drawing_shares(self) -> NDArray[np.float64]:
        """(M,) how often each is drawn: OpenCV's as often as the others, rare kinds more often than their number."""
        share = np.where(self.proposed, 1 / max(self.proposed.sum(), 1), 1 / max((~self.proposed).sum(), 1))
        share /= np.sqrt(np.bincount(self.kinds, share)[self.kinds])
        return share / share.sum()


def room_crops(seed: int, views: int) -> Crops:
    """Crops of a room: masks of a careless proposer, parts of them and of walls and floor, and some of OpenCV's."""
    cv2.setNumThreads(1)
    rng = np.random.default_rng([2, seed])
    capture = make_capture(seed, CaptureSettings(views=views, samples_per_view=50))
    pixels, kinds, proposed = [], [], []
    for frame, ids in zip(capture.frames, capture.masks, strict=True):
        kind = kinds_seen(capture, frame)
        known, found = _careless(ids, kind, rng), opencv_masks(frame.image)
        masks = [*known, *(found[index] for index in rng.permutation(len(found))[:PROPOSALS])]
        counts = np.array([np.bincount(kind[mask], minlength=len(KINDS)) for mask in masks])
        fit = (counts.sum(axis=1) > FEWEST_PX) & (counts.max(axis=1) > PUREST * counts.sum(axis=1))
        stacked = np.array([mask for mask, fits in zip(masks, fit, strict=True) if fits])
        pixels.append(np.stack([_cut(frame.image, stacked, crop) for crop in CROPS], axis=1))
        kinds.append(counts[fit].argmax(axis=1))
        proposed.append((np.arange(len(masks)) >= len(known))[fit])
    return Crops(np.concatenate(pixels), np.concatenate(kinds), np.concatenate(proposed))


def rendered(seeds: Sequence[int], views: int, processes: int) -> Crops:
    """Crops of many rooms, in the order of their seeds whichever process finishes first."""
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}  # for the child processes: sums in one order
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:
        rooms = list(pool.map(room_crops, seeds, [views] * len(seeds)))
    columns = zip(*((room.pixels, room.kinds, room.proposed) for room in rooms), strict=True)
    return Crops(*(np.concatenate(column) for column in columns))


def opencv_masks(image: NDArray[np.uint8]) -> list[NDArray[np.bool_]]:
    """The masks of all levels that OpenCV proposes."""
    proposals = OpenCVProposer().propose(image)
    maps = [masks_of_level(proposals, level)[0] for level in LEVELS]
    return [ids == number for ids in maps for number in range(ids.max() + 1)]


def _careless(ids: NDArray[np.uint16], kind: NDArray[np.int64], rng: Random) -> list[NDArray[np.bool_]]:
    """The masks of a view, parts of four of them, and walls and floor, or parts of these."""
    masks = [ids == number for number in range(1, int(ids.max()) + 1)]
    masks += [_part(masks[index], rng) for index in rng.permutation(len(masks))[:4]]
    for shell in (WALL, FLOOR):
        if (kind == shell).sum() > 2000:
            masks += [kind == shell] if rng.uniform() < 0.3 else [_part(kind == shell, rng)]
    return masks


def kinds_seen(capture: RoomCapture, frame: Frame) -> NDArray[np.int64]:
    """(H, W) index into KINDS of what each pixel shows; the ceiling counts as wall."""
    of_object = np.array([KINDS.index(item.name) for item in capture.room.objects] + [WALL])
    directions = capture.intrinsics.directions() @ frame.camera_to_world[2, :3]
    height_m = directions.reshape(frame.depth_m.shape) * frame.depth_m + frame.camera_to_world[2, 3]
    return np.where((frame.owner < 0) & (height_m < 0.02), FLOOR, of_object[frame.owner])


def _part(mask: NDArray[np.bool_], rng: Random) -> NDArray[np.bool_]:
    """The pixels nearest to one of a few random pixels of the mask."""
    pixels = np.argwhere(mask)
    seeds = pixels[rng.choice(len(pixels), min(len(pixels), int(rng.integers(2, 6))), replace=False)]
    nearest = ((pixels[:, None] - seeds) ** 2).sum(axis=2).argmin(axis=1)
    part = np.zeros_like(mask)
    part[tuple(pixels[nearest == 0].T)] = True
    return part


def _cut(image: NDArray[np.uint8], masks: NDArray[np.bool_], crop: Crop) -> NDArray[np.uint8]:
    return mask_crops(image, masks, crop, PREPROCESSING.size, PREPROCESSING.fill, PREPROCESSING.resample)


# Words ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Words:
    """absent: words for nothing in the room, used in training. kept: 25 more, not used in training. merges: the
    tokenizer's, learnt from all words except kept."""

    absent: tuple[str, ...]
    kept: tuple[str, ...]
    merges: tuple[tuple[str, str], ...]

    @classmethod
    def drawn(cls, rng: Random) -> Words:
        """From our everyday words, without those that may name a thing of the room."""
        present = {word for words in SYNONYMS.values() for word in words} | set(RELATED)
        absent = [word for word in everyday_words() if word not in present]
        order = rng.permutation(len(absent)).tolist()
        used = tuple(absent[index] for index in order[25:])
        merges = learnt_merges([*NAMES, *NAMES, *used, *ADJECTIVES, *TEMPLATES], MERGES)
        return cls(used, tuple(absent[index] for index in order[:25]), tuple(merges))

    def phrase(self, word: str, rng: Random) -> str:
        """The word as someone may type it: plural, with an adjective, in a sentence. Adjectives have no meaning."""
        if rng.uniform() < 0.15:
            word = _plural(word)
        if rng.uniform() < 0.2:
            word = f"{rng.choice(ADJECTIVES)} {word}"
        return str(rng.choice(TEMPLATES)).replace("{}", word)

    def absent_phrase(self, rng: Random) -> str:
        """A word for nothing in the room, every other one made up: unknown words must be far from known ones, and no
        list has them all."""
        word = self._made_up(rng) if rng.uniform() < MADE_UP else str(rng.choice(self.absent))
        return self.phrase(word, rng)

    @cached_property
    def _pieces(self) -> tuple[list[str], list[str]]:
        """The tokenizer's pieces that continue a word, and those that end one."""
        pieces = [first + second for first, second in self.merges]
        ends = [piece.removesuffix("</w>") for piece in pieces if piece.endswith("</w>")]
        return [piece for piece in pieces if not piece.endswith("</w>")], ends

    def _made_up(self, rng: Random) -> str:
        """Pieces of other words, or syllables, or a name of the room's things with two letters swapped."""
        choice = rng.uniform()
        if choice < 0.5:
            pieces, ends = self._pieces
            word = "".join(pieces[index] for index in rng.integers(len(pieces), size=rng.integers(0, 3)))
            word += ends[rng.integers(len(ends))]
        elif choice < 0.75:
            syllables = zip(rng.choice(list("bcdfghjklmnprstvwz"), 4), rng.choice(list("aeiou"), 4), strict=True)
            word = "".join(f"{consonant}{vowel}" for consonant, vowel in list(syllables)[: rng.integers(1, 5)])
            word += str(rng.choice(list("nrstlkx")))
        else:
            letters = list(NAMES[rng.integers(len(NAMES))])
            for place in rng.integers(len(letters), size=2):
                letters[place] = str(rng.choice(list("abcdefghijklmnoprstuvwz")))
            word = "".join(letters)
        return str(rng.choice(self.absent)) if word in NAMES or word in RELATED else word


def _plural(word: str) -> str:
    if word.endswith(("s", "x", "sh", "ch")):
        return f"{word}es"
    return f"{word[:-1]}ies" if word.endswith("y") and word[-2] not in "aeiou" else f"{word}s"


def learnt_merges(texts: Iterable[str], count: int) -> list[tuple[str, str]]:
    """Byte-pair merges of ASCII texts: repeatedly the most frequent adjacent pair."""
    counts = Counter(word for text in texts for word in text.lower().split())
    pieces = {word: [*word[:-1], f"{word[-1]}</w>"] for word in counts}
    merges: list[tuple[str, str]] = []
    for _ in range(count):
        pairs: Counter[tuple[str, str]] = Counter()
        for word, parts in pieces.items():
            for pair in pairwise(parts):
                pairs[pair] += counts[word]
        best = max(pairs, key=lambda pair: (pairs[pair], pair))
        merges.append(best)
        pieces = {word: _merged(parts, best) for word, parts in pieces.items()}
    return merges


def tokenizer_json(merges: Iterable[tuple[str, str]]) -> dict[str, Any]:
    """CLIP's tokenizer with these merges: ids are the 256 bytes, the bytes at a word's end, the merges, start, end."""
    letters = sorted(BYTE_CHARACTERS, key=lambda character: (ord(character) >= 256, ord(character)))
    merges = list(merges)
    joined = ["".join(merge) for merge in merges]
    tokens = [*letters, *(f"{letter}</w>" for letter in letters), *joined, "<|startoftext|>", "<|endoftext|>"]
    pairs: Any = merges
    made: Any = CLIPTokenizer(vocab={token: id for id, token in enumerate(tokens)}, merges=pairs)
    return json.loads(made.backend_tokenizer.to_str())


def _merged(parts: list[str], pair: tuple[str, str]) -> list[str]:
    merged: list[str] = []
    for part in parts:
        if merged and (merged[-1], part) == pair:
            merged[-1] += part
        else:
            merged.append(part)
    return merged


# The two encoders -----------------------------------------------------------------------------------------------


class Block(nn.Module):
    """A transformer block, with parts named as in OpenCLIP."""

    def __init__(self) -> None:
        super().__init__()
        self.ln_1, self.ln_2 = nn.LayerNorm(TEXT_WIDTH), nn.LayerNorm(TEXT_WIDTH)
        self.attn = nn.MultiheadAttention(TEXT_WIDTH, HEADS, batch_first=True)
        layers = {"c_fc": nn.Linear(TEXT_WIDTH, 4 * TEXT_WIDTH), "gelu": nn.GELU()}
        self.mlp = nn.Sequential(OrderedDict(**layers, c_proj=nn.Linear(4 * TEXT_WIDTH, TEXT_WIDTH)))

    def forward(self, x: torch.Tensor, later: torch.Tensor) -> torch.Tensor:
        """x: (B, T, W); later: (T, T), -inf where a token may not attend. Attention is in plain products: torch's own
        fixes the number of texts when exported."""
        inputs = F.linear(self.ln_1(x), self.attn.in_proj_weight, self.attn.in_proj_bias)
        query, key, value = inputs.unflatten(2, (3, HEADS, -1)).permute(2, 0, 3, 1, 4)
        cosines = query @ key.transpose(2, 3) * (TEXT_WIDTH / HEADS) ** -0.5 + later
        x = x + self.attn.out_proj((cosines.softmax(3) @ value).transpose(1, 2).flatten(2))
        return x + self.mlp(self.ln_2(x))


class TextEncoder(nn.Module):
    """A one-block CLIP text tower. tokenizer: also gives the number of tokens."""

    def __init__(self, tokenizer: Tokenizer) -> None:
        super().__init__()
        self.tokenizer = tokenizer
        self.token_embedding = nn.Embedding(tokenizer.highest_id + 1, TEXT_WIDTH)
        nn.init.normal_(self.token_embedding.weight, std=0.3)
        self.positional_embedding = nn.Parameter(0.1 * torch.randn(CONTEXT, TEXT_WIDTH))
        self.transformer = nn.ModuleDict({"resblocks": nn.ModuleList([Block()])})
        self.ln_final = nn.LayerNorm(TEXT_WIDTH)
        self.text_projection = nn.Parameter(torch.randn(TEXT_WIDTH, WIDTH) * TEXT_WIDTH**-0.5)
        self.later = torch.full((CONTEXT, CONTEXT), -torch.inf).triu(1)

    def tokens(self, texts: Sequence[str]) -> torch.Tensor:
        """(B, T) token ids; a text is padded with the end token, which has the highest id."""
        rows = [self.tokenizer(text) for text in texts]
        length = max(map(len, rows))
        return torch.tensor([row + row[-1:] * (length - len(row)) for row in rows])

    def forward(self, tokens: torch.Tensor) -> torch.Tensor:
        """(B, WIDTH) unit rows of tokens (B, T). Padding does not count, as no token attends to later ones."""
        length = tokens.shape[1]
        x = self.token_embedding(tokens) + self.positional_embedding[:length]
        for block in self.transformer["resblocks"]:  # type: ignore[union-attr]
            x = block(x, self.later[:length, :length])
        last = self.ln_final(x)[torch.arange(tokens.shape[0]), tokens.argmax(dim=1)]
        return F.normalize(last @ self.text_projection, dim=1)


class ImageEncoder(nn.Module):
    """Six convolutions, a mean over the image, one matrix."""

    def __init__(self) -> None:
        super().__init__()
        self.convolutions = nn.ModuleList(
            nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False)
            for inputs, outputs, kernel, stride in CHANNELS
        )
        self.norms = nn.ModuleList(nn.BatchNorm2d(outputs) for _, outputs, _, _ in CHANNELS)
        self.head = nn.Linear(CHANNELS[-1][1], WIDTH)

    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        """(B, WIDTH) unit rows of pixels (B, 3, S, S)."""
        x = pixels
        for convolution, norm in zip(self.convolutions, self.norms, strict=True):
            x = F.relu(norm(convolution(x)))
        return F.normalize(self.head(x.mean(dim=(2, 3))), dim=1)


def train(crops: Crops, words: Words, steps: int, seed: int) -> tuple[TextEncoder, ImageEncoder]:
    """Both encoders. As in use, a mask's vector in training is the mean of its crops' vectors."""
    torch.manual_seed(seed)
    rng = np.random.default_rng([seed, 1])
    text = TextEncoder(open_tokenizer(json.dumps(tokenizer_json(words.merges)).encode(), CONTEXT, 1 << 16))
    image = ImageEncoder().to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimizer = torch.optim.AdamW([*text.parameters(), *image.parameters()], weight_decay=0.02)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, LEARNING_RATE, total_steps=steps, pct_start=0.1)
    share = crops.drawing_shares()
    start = time.perf_counter()
    for step in range(steps):
        chosen = rng.choice(len(share), BATCH, p=share)
        images = F.normalize(image(_varied(crops.pixels[chosen], rng)).unflatten(0, (BATCH, -1)).mean(dim=1), dim=1)
        texts = [words.phrase(str(rng.choice(SYNONYMS[kind])), rng) for kind in KINDS for _ in range(PHRASES)]
        texts += [words.absent_phrase(rng) for _ in range(ABSENT)]
        loss = contrastive_loss(images, torch.from_numpy(crops.kinds[chosen]), text(text.tokens(texts)))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        if step % 100 == 99:
            print(f"step {step + 1}: loss {loss.item():.3f}, {time.perf_counter() - start:.0f} s", flush=True)
    return text.eval(), image.eval()


def contrastive_loss(images: torch.Tensor, kinds: torch.Tensor, texts: torch.Tensor) -> torch.Tensor:
    """Images choose among all texts, words among all images, and words of different meaning are kept apart.

    texts: PHRASES for each of KINDS, then those for nothing in the room, each with its own meaning.
    """
    named = len(KINDS) * PHRASES
    meaning = torch.cat([torch.arange(len(KINDS)).repeat_interleave(PHRASES), torch.arange(named, len(texts))])
    logits, fits = SHARPNESS * images @ texts.T, meaning == kinds[:, None]
    by_image = logits.logsumexp(1) - logits.masked_fill(~fits, -torch.inf).logsumexp(1)
    seen = fits.any(0)
    by_word = (logits.logsumexp(0) - logits.masked_fill(~fits, -torch.inf).logsumexp(0))[seen]
    apart = (WORD_SHARPNESS * texts @ texts.T).masked_fill(meaning == meaning[:, None], -torch.inf).logsumexp(1)
    return by_image.mean() + 0.3 * by_word.mean() + 0.3 * apart.mean()


def _varied(crops: NDArray[np.uint8], rng: Random) -> torch.Tensor:
    """(B * crops, 3, S, S) of (B, crops, S, S, 3): each mask randomly mirrored, with another hue, brighter or darker,
    in warmer or colder light."""
    masks, size = len(crops), PREPROCESSING.size
    mirrored = rng.uniform(size=masks) < 0.5
    crops = np.where(mirrored[:, None, None, None, None], crops[:, :, :, ::-1], crops)
    pixels = PREPROCESSING.pixels(crops.reshape(-1, size, size, 3)).reshape(masks, -1, 3, size * size)
    gain = rng.normal(1, 0.15, (masks, 1, 1)) * rng.normal(1, 0.06, (masks, 3, 1))
    turns = _hue_turns(rng.normal(0, HUE_TURN, masks) * (rng.uniform(size=masks) < 0.5))
    mixing = (gain * turns).astype(np.float32)
    lift = rng.normal(0, 0.15, (masks, 1, 1, 1)).astype(np.float32)
    varied = torch.from_numpy((mixing[:, None] @ pixels + lift).reshape(-1, 3, size, size))
    return varied.contiguous(memory_format=torch.channels_last)


def _hue_turns(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """(B, 3, 3) rotations of RGB about grey by angles (B,), by Rodrigues' formula."""
    grey = np.cross(np.eye(3), np.full(3, 3**-0.5))
    sine, versine = np.sin(angles)[:, None, None], (1 - np.cos(angles))[:, None, None]
    return np.eye(3) + sine * grey + versine * grey @ grey


# Export ---------------------------------------------------------------------------------------------------------


def export(text: TextEncoder, image: ImageEncoder, words: Words, folder: Path) -> None:
    """Write both encoders."""
    about = {
        "feature_space": DEMO_SPACE, "context_length": CONTEXT, "vocabulary": text.tokenizer.highest_id + 1,
        "pad_id": None, "templates": ["{}"], "tower": {"layers": 1, "heads": HEADS, "activation": "gelu"},
    }  # fmt: skip
    write_text_encoder(folder / "text", text, tokenizer_json(words.merges), about)
    rounded = RoundedImageModel(image)
    about = {"knows": list(KINDS), "trained_by": "scripts/train_demo_encoder.py"}
    write_image_encoder(folder / "image", rounded, rounded.graph(), about)


class RoundedImageModel(ImageModel):
    """The image encoder as stored: norms folded into the convolutions, which have 8 bits and one scale per channel."""

    feature_space, width, preprocessing, crops, patch = DEMO_SPACE, WIDTH, PREPROCESSING, CROPS, None

    def __init__(self, image: ImageEncoder) -> None:
        self.layers: list[tuple[NDArray[np.int8], NDArray[np.float32], NDArray[np.float32]]] = []
        for module, normed in zip(image.convolutions, image.norms, strict=True):
            convolution, norm = cast("nn.Conv2d", module), cast("nn.BatchNorm2d", normed)
            gain = (norm.weight / torch.sqrt(cast("torch.Tensor", norm.running_var) + norm.eps)).detach().numpy()
            offset = norm.bias.detach().numpy() - cast("torch.Tensor", norm.running_mean).numpy() * gain
            weight = convolution.weight.detach().numpy() * gain[:, None, None, None]
            scale = (np.abs(weight).max(axis=(1, 2, 3)) / 127).astype(np.float32)
            self.layers.append((np.rint(weight / scale[:, None, None, None]).astype(np.int8), scale, offset))
        self.head = image.head.weight.detach().numpy().T, image.head.bias.detach().numpy()

    def patches(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """Not available: it has no patches."""
        raise NotImplementedError

    @torch.no_grad()
    def __call__(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """(B, WIDTH) float32 unit rows of pixels (B, 3, S, S)."""
        x = torch.from_numpy(pixels)
        for (weight, scale, offset), (_, _, kernel, stride) in zip(self.layers, CHANNELS, strict=True):
            values = torch.from_numpy(weight * scale[:, None, None, None])
            x = F.relu(F.conv2d(x, values, torch.from_numpy(offset), stride, kernel // 2))
        weight, bias = map(torch.from_numpy, self.head)
        return F.normalize(x.mean(dim=(2, 3)) @ weight + bias, dim=1).numpy()

    def graph(self) -> bytes:
        """The same as image_encoder.onnx."""
        constants: dict[str, NDArray[Any]] = {"flat": np.array([0, -1])}
        constants |= {"head": self.head[0], "head.bias": self.head[1], "tiny": np.array(np.finfo(np.float32).tiny)}
        nodes, x = [], "pixels"
        for number, (layer, (_, _, kernel, stride)) in enumerate(zip(self.layers, CHANNELS, strict=True)):
            weight, scale, offset = (f"layer{number}.{part}" for part in ("weight", "scale", "offset"))
            constants |= zip((weight, scale, offset), layer, strict=True)
            values, total = f"layer{number}.values", f"layer{number}.sum"
            shape: dict[str, Any] = {"strides": [stride, stride], "pads": [kernel // 2] * 4}
            nodes += [
                helper.make_node("DequantizeLinear", [weight, scale], [values], axis=0),
                helper.make_node("Conv", [x, values, offset], [total], **shape),
                helper.make_node("Relu", [total], [x := f"layer{number}.x"]),
            ]
        for operator, inputs, output in (
            ("GlobalAveragePool", [x], "mean_square"),
            ("Reshape", ["mean_square", "flat"], "mean"),
            ("MatMul", ["mean", "head"], "product"),
            ("Add", ["product", "head.bias"], "vector"),
            ("ReduceL2", ["vector", "last"], "length_raw"),
            ("Max", ["length_raw", "tiny"], "length"),
            ("Div", ["vector", "length"], "image"),
        ):
            nodes.append(helper.make_node(operator, inputs, [output]))
        constants["last"] = np.array([-1])
        kept = [numpy_helper.from_array(np.ascontiguousarray(value), name) for name, value in constants.items()]
        side = PREPROCESSING.size
        pixels = helper.make_tensor_value_info("pixels", TensorProto.FLOAT, ["batch", 3, side, side])
        rows = helper.make_tensor_value_info("image", TensorProto.FLOAT, ["batch", WIDTH])
        graph = helper.make_graph(nodes, "image_encoder", [pixels], [rows], kept)
        return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=8).SerializeToString()


# Measuring ------------------------------------------------------------------------------------------------------


def measure(folder: Path, views: int = 8) -> None:
    """Prints the encoder's accuracy in rooms it has not seen, with perfect, careless and OpenCV's masks."""
    words, text = Words.drawn(np.random.default_rng(0)), read_text_encoder(folder / "text")
    image = open_encoder(folder / "image")
    absent = (words.absent[:25], words.kept)
    print(f"rooms of seeds {list(MEASURING_SEEDS)}, {views} views each; top-1 among {len(CLASS_NAMES)} class words")
    for masks_of in ("perfect masks", "careless masks", "OpenCV's masks"):
        vectors, kinds, hidden = [], [], []
        for seed in MEASURING_SEEDS:
            noise = float(masks_of == "careless masks")
            capture = make_capture(seed, CaptureSettings(views=views, samples_per_view=50, mask_noise=noise))
            for frame, ids in zip(capture.frames, capture.masks, strict=True):
                shown = kinds_seen(capture, frame)
                masks = np.arange(1, ids.max() + 1)[:, None, None] == ids
                if masks_of == "OpenCV's masks":
                    masks = np.array(opencv_masks(frame.image))
                vectors.append(image.embed(frame.image, masks))
                kinds += [np.bincount(shown[mask]).argmax() for mask in masks]
                hidden += [_is_hidden(mask, frame.depth_m) for mask in masks]
        kind = np.array(kinds)
        things = kind < len(CLASS_NAMES)
        _report(np.concatenate(vectors)[things], kind[things], np.array(hidden)[things], text, masks_of, absent)


def _is_hidden(mask: NDArray[np.bool_], depth_m: NDArray[np.float32]) -> bool:
    """Whether a tenth of the mask's outline is at the image's edge or next to something nearer."""
    framed = np.pad(mask, 1)
    depth = np.pad(depth_m, 1)  # beyond the edge counts as nearer
    own = cv2.dilate(np.where(framed, depth, 0), np.ones((3, 3), np.uint8))
    outline = (own > 0) & ~framed
    return bool((depth[outline] < own[outline] - 0.03).mean() > 0.1)


def _report(
    vectors: NDArray[np.float32], kinds: NDArray[np.int64], hidden: NDArray[np.bool_],
    encode: TrainedTextEncoder, title: str, absent: tuple[Sequence[str], Sequence[str]],
) -> None:  # fmt: skip
    def right(names: Sequence[str], template: str = "{}") -> NDArray[np.bool_]:
        texts = [template.replace("{}", name) for name in names]
        return (vectors @ encode(texts).T).argmax(axis=1) == kinds

    own = right(CLASS_NAMES)
    longest = max(map(len, SYNONYMS.values()))
    others = [right([SYNONYMS[name][index % len(SYNONYMS[name])] for name in CLASS_NAMES]) for index in range(longest)]
    best = (vectors @ encode(CLASS_NAMES).T).max(axis=1, keepdims=True)
    print(f"\n{title}: {len(kinds)} masks, {hidden.mean():.0%} of them partly hidden or cut off")
    print(f"  class words {own.mean():.3f}; in full view {own[~hidden].mean():.3f}, hidden {own[hidden].mean():.3f}")
    print(f"  synonyms {np.mean(others):.3f} ({np.min(np.mean(others, axis=1)):.3f} at worst)")
    for template in NEW_TEMPLATES:
        print(f"  '{template}' {right(CLASS_NAMES, template).mean():.3f}")
    for kind, names in zip(("trained as absent", "never seen"), absent, strict=True):
        beats = vectors @ encode(names).T > best
        print(f"  absent words, {kind}: one beats the best class word on {beats.mean():.4f} of masks, any of "
              f"{len(names)} on {beats.any(axis=1).mean():.4f}")  # fmt: skip
    by_class = [
        f"{name} {own[kinds == index].mean():.2f}" for index, name in enumerate(CLASS_NAMES) if (kinds == index).any()
    ]
    print(f"  by class: {', '.join(by_class)}")


def main() -> None:
    """Train, export and measure, or measure alone."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=DEMO_ENCODER, help="folder of the two halves")
    parser.add_argument("--measure", action="store_true", help="do not train")
    parser.add_argument("--steps", type=int, default=1600)
    parser.add_argument("--views", type=int, default=2, help="of each room: other rooms teach more than other views")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1, help="that render")
    parser.add_argument("--seed", type=int, default=0, help="of weights and choices, not of rooms")
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # sums in a fixed order: the same weights on every run on one machine
    if not arguments.measure:
        start = time.perf_counter()
        crops = rendered(TRAINING_SEEDS, arguments.views, arguments.processes)
        made = time.perf_counter()
        print(f"{len(crops.kinds)} masks of {len(TRAINING_SEEDS)} rooms in {made - start:.0f} s", flush=True)
        words = Words.drawn(np.random.default_rng(0))
        export(*train(crops, words, arguments.steps, arguments.seed), words, arguments.output)
        print(
            f"rendering, masks and crops {made - start:.0f} s in {arguments.processes} processes, training and export "
            f"{time.perf_counter() - made:.0f} s in one thread",
            flush=True,
        )
    measure(arguments.output)


if __name__ == "__main__":
    main()
