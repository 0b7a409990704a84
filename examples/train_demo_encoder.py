"""Trains the demo encoder: a tiny image encoder and a tiny text encoder that know the procedural room's things.

    python examples/train_demo_encoder.py              # writes og_pointcloud/masking/demo_encoder, then measures it
    python examples/train_demo_encoder.py --measure    # measures the one that is there

Crops of some thousand masks of rendered rooms and the words for what they show are brought together by the usual
contrastive loss; words for nothing in the room compete. The text side is a one-block CLIP text tower, exported like any
other; the image side a small convolutional net. Rooms of other seeds than those of training are for measuring, and the
demo's own (0, 1, 2 ...) are for neither.

It is a demo encoder: it knows these rooms, nineteen kinds of things and their synonyms, and nothing else of the world.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections import Counter, OrderedDict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import cast

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from og_pointcloud_export.image_encoder import write_image_encoder
from og_pointcloud_export.image_graph import add_unit_rows, serialized
from og_pointcloud_export.text_encoder import export_text_encoder
from og_pointcloud_export.text_graph import Graph
from og_pointcloud_export.text_tokenizer import clip_description
from og_pointcloud_room.capture import CaptureSettings, RoomCapture, make_capture
from og_pointcloud_room.furniture import CLASS_NAMES
from og_pointcloud_room.raycast import Frame
from og_pointcloud_room.words import RELATED, SYNONYMS
from safetensors.torch import save_file
from torch import nn

from og_pointcloud.masking.crops import Crop, mask_crops
from og_pointcloud.masking.encoders import DEMO_FOLDER, DEMO_SPACE, open_encoder
from og_pointcloud.masking.encoders.preprocessing import Preprocessing
from og_pointcloud.text.encoder import TextEncoder as TrainedTextEncoder
from og_pointcloud.text.encoder import read_text_encoder
from og_pointcloud.text.tokenizer import Tokenizer
from og_pointcloud.text.vocabulary import everyday_words

Random = np.random.Generator

TRAINING_SEEDS, MEASURING_SEEDS = range(1000, 1032), range(2000, 2004)
KINDS = tuple(SYNONYMS)
WALL, FLOOR = KINDS.index("wall"), KINDS.index("floor")
CROPS = (Crop(1.15, 0.15), Crop(1.8, 0.5))
"""One shows the shape, one where the thing stands."""
PREPROCESSING = Preprocessing(48, mean=(0.486, 0.455, 0.408), std=(0.25, 0.25, 0.25), resample="bilinear")
WIDTH, CONTEXT, TEXT_WIDTH, HEADS, MERGES = 64, 16, 64, 4, 600
CHANNELS = ((3, 24, 5, 2), (24, 40, 3, 2), (40, 40, 3, 1), (40, 80, 3, 2), (80, 80, 3, 1), (80, 128, 3, 2))
"""Of each convolution: channels in and out, size of its kernel, stride."""
BATCH, PHRASES, ABSENT, LEARNING_RATE = 96, 3, 140, 3e-3
SHARPNESS = 16.0
"""Factor of the cosines in the contrastive loss."""

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
"""For measuring: none of them is among those above."""


# Crops and what they show ---------------------------------------------------------------------------------------


def room_crops(seed: int, views: int, rng: Random) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """(M, crops, S, S, 3) uint8 and (M,) kinds: masks of a careless proposer, parts of them, and of walls and floor."""
    capture = make_capture(seed, CaptureSettings(views=views, samples_per_view=50))
    crops, kinds = [], []
    for frame, ids in zip(capture.frames, capture.masks, strict=True):
        kind = kinds_seen(capture, frame)
        masks = [ids == number for number in range(1, int(ids.max()) + 1)]
        masks += [_part(masks[index], rng) for index in rng.permutation(len(masks))[:4]]
        for shell in (WALL, FLOOR):
            if (kind == shell).sum() > 2000:
                masks += [kind == shell] if rng.uniform() < 0.3 else [_part(kind == shell, rng)]
        stacked = np.array([mask for mask in masks if mask.sum() > 50])
        crops.append(np.stack([_cut(frame.image, stacked, crop) for crop in CROPS], axis=1))
        kinds += [np.bincount(kind[mask]).argmax() for mask in stacked]
    return np.concatenate(crops), np.array(kinds)


def kinds_seen(capture: RoomCapture, frame: Frame) -> NDArray[np.int64]:
    """(H, W) index into KINDS of what each pixel shows; the ceiling counts as wall."""
    of_object = np.array([KINDS.index(item.name) for item in capture.room.objects] + [WALL])
    directions = capture.intrinsics.directions() @ frame.camera_to_world[2, :3]
    height_m = directions * frame.depth_m + frame.camera_to_world[2, 3]
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
    """absent: words for nothing in the room that training uses. kept: 25 more, of which it sees none."""

    absent: tuple[str, ...]
    kept: tuple[str, ...]

    @classmethod
    def drawn(cls, rng: Random) -> Words:
        """From our everyday words, without those that a thing of the room may be called."""
        present = {word for words in SYNONYMS.values() for word in words} | set(RELATED)
        absent = [word for word in everyday_words() if word not in present]
        order = rng.permutation(len(absent)).tolist()
        return cls(tuple(absent[index] for index in order[25:]), tuple(absent[index] for index in order[:25]))

    def phrase(self, word: str, rng: Random) -> str:
        """The word as someone may type it: plural, with an adjective, in a sentence. Adjectives say nothing here."""
        if rng.uniform() < 0.15:
            word = _plural(word)
        if rng.uniform() < 0.2:
            word = f"{rng.choice(ADJECTIVES)} {word}"
        return str(rng.choice(TEMPLATES)).replace("{}", word)

    def absent_phrase(self, rng: Random) -> str:
        """A word for nothing in the room, one in six made up."""
        if rng.uniform() < 1 / 6:
            syllables = (f"{rng.choice(list('bcdfghjklmnprstvwz'))}{rng.choice(list('aeiou'))}" for _ in range(3))
            return self.phrase("".join(list(syllables)[: rng.integers(1, 4)]) + str(rng.choice(list("nrstlk"))), rng)
        return self.phrase(self.absent[rng.integers(len(self.absent))], rng)


def _plural(word: str) -> str:
    if word.endswith(("s", "x", "sh", "ch")):
        return f"{word}es"
    return f"{word[:-1]}ies" if word.endswith("y") and word[-2] not in "aeiou" else f"{word}s"


def learnt_merges(texts: Iterable[str], count: int) -> list[tuple[str, str]]:
    """Byte-pair merges of ASCII texts: again and again the pair that stands most often side by side."""
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
    """A transformer's block, its parts named as OpenCLIP names them."""

    def __init__(self) -> None:
        super().__init__()
        self.ln_1, self.ln_2 = nn.LayerNorm(TEXT_WIDTH), nn.LayerNorm(TEXT_WIDTH)
        self.attn = nn.MultiheadAttention(TEXT_WIDTH, HEADS, batch_first=True)
        layers = {"c_fc": nn.Linear(TEXT_WIDTH, 4 * TEXT_WIDTH), "gelu": nn.GELU()}
        self.mlp = nn.Sequential(OrderedDict(**layers, c_proj=nn.Linear(4 * TEXT_WIDTH, TEXT_WIDTH)))

    def forward(self, x: torch.Tensor, later: torch.Tensor) -> torch.Tensor:
        """x: (B, T, W); later: (T, T), -inf where a token may not look."""
        normed = self.ln_1(x)
        x = x + self.attn(normed, normed, normed, attn_mask=later, need_weights=False)[0]
        return x + self.mlp(self.ln_2(x))


class TextEncoder(nn.Module):
    """A one-block CLIP text tower. tokenizer: which also says how many tokens there are."""

    def __init__(self, tokenizer: Tokenizer) -> None:
        super().__init__()
        self.tokenizer = tokenizer
        self.token_embedding = nn.Embedding(tokenizer.highest_id + 1, TEXT_WIDTH)
        nn.init.normal_(self.token_embedding.weight, std=0.3)
        self.positional_embedding = nn.Parameter(0.1 * torch.randn(CONTEXT, TEXT_WIDTH))
        self.transformer = nn.ModuleDict({"resblocks": nn.ModuleList([Block()])})
        self.ln_final = nn.LayerNorm(TEXT_WIDTH)
        self.text_projection = nn.Parameter(torch.randn(TEXT_WIDTH, WIDTH) * TEXT_WIDTH**-0.5)

    def forward(self, texts: Sequence[str]) -> torch.Tensor:
        """(B, WIDTH) unit rows."""
        rows = [self.tokenizer(text, CONTEXT) for text in texts]
        length = max(map(len, rows))
        # The end's id is the highest; behind the end nothing counts, since no token looks ahead.
        ids = torch.tensor([row + row[-1:] * (length - len(row)) for row in rows])
        later = torch.full((length, length), -torch.inf).triu(1)
        x = self.token_embedding(ids) + self.positional_embedding[:length]
        for block in self.transformer["resblocks"]:  # type: ignore[union-attr]
            x = block(x, later)
        last = self.ln_final(x)[torch.arange(len(ids)), ids.argmax(dim=1)]
        return F.normalize(last @ self.text_projection, dim=1)


class ImageEncoder(nn.Module):
    """Six convolutions, their mean over the image, one matrix."""

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


def train(
    crops: NDArray[np.uint8], kinds: NDArray[np.int64], words: Words, steps: int, seed: int
) -> tuple[TextEncoder, ImageEncoder, list[tuple[str, str]]]:
    """Both encoders, and the merges of the tokenizer. crops, kinds: as of ``room_crops``, of many rooms."""
    torch.manual_seed(seed)
    rng = np.random.default_rng([seed, 1])
    names = [word for synonyms in SYNONYMS.values() for word in synonyms]
    merges = learnt_merges([*names, *names, *words.absent, *ADJECTIVES, *TEMPLATES], MERGES)
    text = TextEncoder(Tokenizer(json.dumps(clip_description(merges)).encode()))
    image = ImageEncoder().to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimizer = torch.optim.AdamW([*text.parameters(), *image.parameters()], weight_decay=0.02)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, LEARNING_RATE, total_steps=steps, pct_start=0.1)
    share = 1 / np.sqrt(np.bincount(kinds)[kinds])
    start = time.perf_counter()
    for step in range(steps):
        chosen = rng.choice(len(crops), BATCH, p=share / share.sum())
        pixels = _varied(PREPROCESSING.pixels(crops[chosen, rng.integers(0, len(CROPS), BATCH)]), rng)
        texts = [words.phrase(str(rng.choice(SYNONYMS[kind])), rng) for kind in KINDS for _ in range(PHRASES)]
        texts += [words.absent_phrase(rng) for _ in range(ABSENT)]
        loss = contrastive_loss(image(pixels), torch.from_numpy(kinds[chosen]), text(texts))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        if step % 100 == 99:
            print(f"step {step + 1}: loss {loss.item():.3f}, {time.perf_counter() - start:.0f} s", flush=True)
    return text.eval(), image.eval(), merges


def contrastive_loss(images: torch.Tensor, kinds: torch.Tensor, texts: torch.Tensor) -> torch.Tensor:
    """Images choose among all texts, words among all images, and words of different meaning keep apart.

    texts: PHRASES for each of KINDS, then those for nothing in the room, each a meaning of its own.
    """
    named = len(KINDS) * PHRASES
    meaning = torch.cat([torch.arange(len(KINDS)).repeat_interleave(PHRASES), torch.arange(named, len(texts))])
    logits, fits = SHARPNESS * images @ texts.T, meaning == kinds[:, None]
    by_image = logits.logsumexp(1) - logits.masked_fill(~fits, -torch.inf).logsumexp(1)
    seen = fits.any(0)
    by_word = (logits.logsumexp(0) - logits.masked_fill(~fits, -torch.inf).logsumexp(0))[seen]
    apart = (4 * texts @ texts.T).masked_fill(meaning == meaning[:, None], -torch.inf).logsumexp(1)
    return by_image.mean() + 0.3 * by_word.mean() + 0.3 * apart.mean()


def _varied(pixels: NDArray[np.float32], rng: Random) -> torch.Tensor:
    """Mirrored by chance, brighter or darker, of warmer or colder light."""
    mirrored = rng.uniform(size=len(pixels)) < 0.5
    pixels[mirrored] = pixels[mirrored, :, :, ::-1]
    gain = rng.normal(1, 0.15, (len(pixels), 1, 1, 1)) * rng.normal(1, 0.06, (len(pixels), 3, 1, 1))
    lift = rng.normal(0, 0.15, (len(pixels), 1, 1, 1))
    varied = torch.from_numpy((pixels * gain + lift).astype(np.float32))
    return varied.contiguous(memory_format=torch.channels_last)


# Export ---------------------------------------------------------------------------------------------------------


def export(text: TextEncoder, image: ImageEncoder, merges: list[tuple[str, str]], folder: Path) -> None:
    """Write both halves. The text side takes the road of any OpenCLIP model, through a folder in its format."""
    with tempfile.TemporaryDirectory() as temporary:
        source = Path(temporary)
        save_file({name: value.contiguous() for name, value in text.state_dict().items()},
                  source / "open_clip_model.safetensors")  # fmt: skip
        config = {"model_cfg": {"embed_dim": WIDTH, "text_cfg": {"heads": HEADS}}}
        (source / "open_clip_config.json").write_text(json.dumps(config))
        (source / "tokenizer.json").write_text(json.dumps(clip_description(merges)))
        export_text_encoder(source, folder / "text", feature_space=DEMO_SPACE)
    rounded = RoundedImageModel(image)
    about = {"knows": list(KINDS), "trained_by": "examples/train_demo_encoder.py"}
    write_image_encoder(folder / "image", rounded.graph(), rounded, CROPS, about)


class RoundedImageModel:
    """The image encoder as it is stored: norms folded into the convolutions, these in 8 bits, a scale a channel."""

    feature_space, width, preprocessing = DEMO_SPACE, WIDTH, PREPROCESSING

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
        graph, x = Graph(int8=False), "pixels"
        for number, ((weight, scale, offset), (_, _, kernel, stride)) in enumerate(
            zip(self.layers, CHANNELS, strict=True)
        ):
            name = f"layer{number}"
            stored = f"{graph.constant(f'{name}.weight', weight)} {graph.constant(f'{name}.scale', scale)}"
            values = graph.add("DequantizeLinear", stored, f"{name}.values", axis=0)
            inputs = f"{x} {values} {graph.constant(f'{name}.offset', offset)}"
            graph.add("Conv", inputs, f"{name}.sum", strides=[stride, stride], pads=[kernel // 2] * 4)
            x = graph.add("Relu", f"{name}.sum", f"{name}.x")
        graph.add("GlobalAveragePool", x, "mean_square")
        graph.add("Reshape", f"mean_square {graph.constant('flat', np.array([0, -1]))}", "mean")
        graph.add("MatMul", f"mean {graph.constant('head', self.head[0])}", "product")
        graph.add("Add", f"product {graph.constant('head.bias', self.head[1])}", "vector")
        add_unit_rows(graph, "vector")
        return serialized(
            graph, PREPROCESSING.size, WIDTH, "The demo encoder's image half: knows the demo's room alone."
        )


# Measuring ------------------------------------------------------------------------------------------------------


def measure(folder: Path, views: int) -> None:
    """Prints what the encoder gets right in rooms it has not seen, with perfect masks and with careless ones."""
    words, text, image = (
        Words.drawn(np.random.default_rng(0)),
        read_text_encoder(folder / "text"),
        open_encoder(folder / "image"),
    )
    absent = (words.absent[:25], words.kept)
    print(f"rooms of seeds {list(MEASURING_SEEDS)}, {views} views each; top-1 among {len(CLASS_NAMES)} class words")
    for noise in (0.0, 1.0):
        vectors, kinds, hidden = [], [], []
        for seed in MEASURING_SEEDS:
            capture = make_capture(seed, CaptureSettings(views=views, samples_per_view=50, mask_noise=noise))
            for frame, ids in zip(capture.frames, capture.masks, strict=True):
                masks = np.arange(1, ids.max() + 1)[:, None, None] == ids
                vectors.append(image.embed(frame.image, masks))
                shown = kinds_seen(capture, frame)
                kinds += [np.bincount(shown[mask]).argmax() for mask in masks]
                hidden += [_is_hidden(mask, frame.depth_m) for mask in masks]
        kind = np.array(kinds)
        things = kind < len(CLASS_NAMES)
        _report(np.concatenate(vectors)[things], kind[things], np.array(hidden)[things], text, noise, absent)


def _is_hidden(mask: NDArray[np.bool_], depth_m: NDArray[np.float32]) -> bool:
    """Whether a tenth of the mask's outline lies at the image's edge or against something nearer than it."""
    framed = np.pad(mask, 1)
    depth = np.pad(depth_m, 1)  # beyond the edge everything is near
    own = cv2.dilate(np.where(framed, depth, 0), np.ones((3, 3), np.uint8))
    outline = (own > 0) & ~framed
    return bool((depth[outline] < own[outline] - 0.03).mean() > 0.1)


def _report(
    vectors: NDArray[np.float32], kinds: NDArray[np.int64], hidden: NDArray[np.bool_],
    encode: TrainedTextEncoder, noise: float, absent: tuple[Sequence[str], Sequence[str]],
) -> None:  # fmt: skip
    def right(names: Sequence[str], templates: Sequence[str] = ("{}",)) -> NDArray[np.bool_]:
        return (vectors @ encode(names, templates).T).argmax(axis=1) == kinds

    own = right(CLASS_NAMES)
    longest = max(map(len, SYNONYMS.values()))
    others = [right([SYNONYMS[name][index % len(SYNONYMS[name])] for name in CLASS_NAMES]) for index in range(longest)]
    best = (vectors @ encode(CLASS_NAMES).T).max(axis=1, keepdims=True)
    print(f"\nmask noise {noise:.0f}: {len(kinds)} masks, {hidden.mean():.0%} of them partly hidden or cut off")
    print(f"  class words {own.mean():.3f}; in full view {own[~hidden].mean():.3f}, hidden {own[hidden].mean():.3f}")
    print(f"  synonyms {np.mean(others):.3f} ({np.min(np.mean(others, axis=1)):.3f} at worst)")
    for template in NEW_TEMPLATES:
        print(f"  '{template}' {right(CLASS_NAMES, (template,)).mean():.3f}")
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
    parser.add_argument("-o", "--output", type=Path, default=DEMO_FOLDER, help="folder of the two halves")
    parser.add_argument("--measure", action="store_true", help="do not train")
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--views", type=int, default=8, help="of each room")
    parser.add_argument("--seed", type=int, default=0, help="of weights and choices, not of rooms")
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # sums in one order: the same weights on every run of one machine
    if not arguments.measure:
        start, rng = time.perf_counter(), np.random.default_rng([arguments.seed, 2])
        rooms = [room_crops(seed, arguments.views, rng) for seed in TRAINING_SEEDS]
        crops, kinds = (np.concatenate(column) for column in zip(*rooms, strict=True))
        print(f"{len(crops)} crops of {len(TRAINING_SEEDS)} rooms in {time.perf_counter() - start:.0f} s", flush=True)
        trained = train(crops, kinds, Words.drawn(np.random.default_rng(0)), arguments.steps, arguments.seed)
        export(*trained, arguments.output)
    measure(arguments.output, arguments.views)


if __name__ == "__main__":
    main()
