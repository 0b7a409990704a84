"""A CLIP or SigLIP model's files -> the folder that og_pointcloud.text.encoder reads, held against torch first.

The graph is built from the weights (text_graph); ``torch_vectors`` is the same tower written in torch, so that two ways
must agree before anything is written.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import zlib
from collections.abc import Collection, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.bundle.read import read_bundle
from og_pointcloud.bundle.vocabulary import everyday_words
from og_pointcloud.cloud import FeatureSpace
from og_pointcloud.errors import MissingExtraError, OgPointcloudError
from og_pointcloud.formats.npy import npy_bytes
from og_pointcloud.text.encoder import (
    ENCODER_FILES,
    FORMAT,
    GRAPH,
    MANIFEST,
    SCHEMA_VERSION,
    TOKENIZER,
    WORD_BANK,
    TextEncoder,
    cache_folder,
    check_templates,
)
from og_pointcloud_export.text_graph import build_text_graph
from og_pointcloud_export.text_tokenizer import find_tokenizer, read_json
from og_pointcloud_export.text_weights import Activation, Affine, Block, TextTower, read_text_tower

try:
    import torch
    import torch.nn.functional as F
except ImportError as error:
    raise MissingExtraError("torch", "export-text") from error

if TYPE_CHECKING:
    from og_pointcloud.cloud import LabelledCloud

__all__ = [
    "PARITY_TEXTS", "activated", "export_text_encoder", "files_with_manifest", "own_name", "own_version",
    "torch_vectors", "write_folder",
]  # fmt: skip

TOLERANCE = 1e-5
"""Largest difference of a unit vector's entry from torch that is let through; float32 reaches about 1e-6."""
INT8_COSINE = 0.99
"""Smallest cosine of an int8 vector with its float32 one that is let through."""
EQUAL = 1e-6
"""Cosines that float32 vectors cannot tell apart."""
MODEL_NAME = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*")
"""OWNER/MODEL: how feature spaces are named, after where the weights were published."""
PARITY_TEXTS = (
    "", " ", "a", "chair", "a photo of a chair.", "red mug", "object", "things", "stuff", "texture",
    "fire extinguisher", "kitchen counter", "a wooden table with four legs, seen from above", "traffic light",
    "person riding a bicycle", "café", "cafe\u0301", "naïve façade", "it's the dog's", "Ünïcödé", "日本語の看板",
    "стул", "كرسي", "\U0001f469\u200d\U0001f467 \U0001f44d\U0001f3fd", "1234567890", "3.14 %", "!?.,;:-_()[]{}",
    "A   lot\tof \n space", "&amp; &lt;b&gt;", "\x00\x1f control", "x" * 300,
    "a very long sentence that goes on " * 20, "<|endoftext|> early", "TV", "tv", "sofa", "window", "door", "lamp",
)  # fmt: skip
"""Labels and awkward texts, on which graph and torch are compared."""


def export_text_encoder(
    source: str | os.PathLike[str],
    output: str | os.PathLike[str] | None = None,
    *,
    feature_space: str | None = None,
    templates: Sequence[str] = ("{}",),
    activation: Activation | None = None,
    tokenizer: str | os.PathLike[str] | None = None,
    int8: bool = False,
    scene: str | os.PathLike[str] | None = None,
) -> tuple[Path, dict[str, Any]]:
    """Write a model's text tower as a folder, whole or not at all. Returns the folder, and its manifest.

    The folder also holds the vectors of our everyday words, which scenes judge labels by (`ask.choosing`).

    source: a transformers CLIP or SigLIP folder, an OpenCLIP folder, or a file of weights with OpenAI's or OpenCLIP's
        names (.safetensors, weights-only .pt). output: None for the user's cache, where it is found without a word.
    feature_space: OWNER/MODEL, as scenes name it; None: what the model's configuration calls itself.
    templates: texts with {} where a name goes; their vectors' mean stands for the name.
    activation, tokenizer: of a source that does not say, or has none beside it.
    int8: a quarter of the size. Refused where a cosine with float32 falls below 0.99 or, with a scene (.ogpc), where an
        instance's best word, or a word's best instance, becomes another.
    Raises OgPointcloudError, and FeatureSpaceError for a scene of another space; then nothing is written.
    """
    source = Path(source)
    templates = check_templates(templates)
    tower = read_text_tower(source, activation)
    space = feature_space or own_name(source)
    description, pad_id = find_tokenizer(source, Path(tokenizer) if tokenizer else None, tower)
    about = {
        "format": FORMAT,
        "schema_version": SCHEMA_VERSION,
        "written_by": f"og-pointcloud {own_version()}",
        "feature_space": space,
        "width": tower.width,
        "context_length": len(tower.position_embedding),
        "vocabulary": len(tower.token_embedding),
        "pad_id": pad_id,
        "templates": list(templates),
        "tower": {
            "layers": len(tower.blocks), "heads": tower.heads, "activation": tower.activation,
            "causal": tower.causal, "pooling": tower.pooling,
        },
    }  # fmt: skip
    held = {GRAPH: build_text_graph(tower), TOKENIZER: json.dumps(description, ensure_ascii=False).encode()}
    about["precision"] = "fp32"
    encoder = TextEncoder(files_with_manifest(about, held), str(source))
    parity = _parity(tower, encoder)
    if int8:
        cloud = read_bundle(scene).cloud if scene is not None else None
        held[GRAPH], about["precision"] = build_text_graph(tower, int8=True), "int8"
        small = TextEncoder(files_with_manifest(about, held), str(source))
        parity["int8"] = _accept_int8(small, encoder, cloud)
        encoder = small
    held[WORD_BANK] = npy_bytes(encoder(everyday_words()).astype(np.float16))
    files = files_with_manifest({**about, "parity": parity}, held)
    folder = Path(output) if output is not None else cache_folder() / re.sub(r"[^\w.-]+", "--", space)
    write_folder(folder, files, known=ENCODER_FILES)
    return folder, json.loads(files[MANIFEST])


@torch.no_grad()
def torch_vectors(tower: TextTower, tokens: NDArray[np.int64]) -> NDArray[np.float32]:
    """(B, D) float32 unit rows: the tower in torch. tokens: (B, T)."""
    ids = torch.from_numpy(tokens)
    x = torch.from_numpy(tower.token_embedding)[ids] + torch.from_numpy(tower.position_embedding)[: ids.shape[1]]
    for block in tower.blocks:
        x = x + _attention(x, block, tower)
        hidden = _linear(_norm(x, block.norm_2, tower), block.expand)
        x = x + _linear(activated(hidden, tower.activation), block.contract)
    if tower.pooling == "last":
        place = torch.full((len(ids),), ids.shape[1] - 1)
    else:
        place = (ids if tower.pooling == "argmax" else (ids == tower.eos_id).int()).argmax(dim=1)
    pooled = _norm(x, tower.final_norm, tower)[torch.arange(len(ids)), place]
    return F.normalize(_linear(pooled, tower.projection), dim=1).numpy()


def _attention(x: torch.Tensor, block: Block, tower: TextTower) -> torch.Tensor:
    batch, length, width = x.shape
    together = _linear(_norm(x, block.norm_1, tower), block.attend_in)
    q, k, v = (part.view(batch, length, tower.heads, -1).transpose(1, 2) for part in together.chunk(3, dim=2))
    mixed = F.scaled_dot_product_attention(q, k, v, is_causal=tower.causal)
    return _linear(mixed.transpose(1, 2).reshape(batch, length, width), block.attend_out)


def _linear(x: torch.Tensor, affine: Affine) -> torch.Tensor:
    product = x @ torch.from_numpy(affine.weight)
    return product if affine.bias is None else product + torch.from_numpy(affine.bias)


def _norm(x: torch.Tensor, affine: Affine, tower: TextTower) -> torch.Tensor:
    gain, offset = torch.from_numpy(affine.weight), torch.from_numpy(np.asarray(affine.bias))
    return F.layer_norm(x, x.shape[-1:], gain, offset, tower.epsilon)


def activated(x: torch.Tensor, activation: Activation) -> torch.Tensor:
    """One of the three bends that CLIP and SigLIP have between a block's two matrices."""
    if activation == "quick_gelu":
        return x * torch.sigmoid(1.702 * x)
    return F.gelu(x, approximate="none" if activation == "gelu" else "tanh")


def _parity(tower: TextTower, encoder: TextEncoder) -> dict[str, Any]:
    """How far the graph is from torch; texts in torch stand alone, so that what a batch does to them shows."""
    tokens = [np.array([encoder.tokens(text)]) for text in PARITY_TEXTS]
    expected = np.concatenate([torch_vectors(tower, row) for row in tokens])
    got = encoder.encode(PARITY_TEXTS)
    error = float(np.abs(got - expected).max())
    if not error <= TOLERANCE:
        raise OgPointcloudError(
            f"the graph differs from torch by {error:.3g}; expected at most {TOLERANCE}: the weights may hold values "
            "that leave float32; if not, please report this model"
        )
    cosine = float((got.astype(np.float64) * expected).sum(axis=1).min())
    return {
        "texts": len(PARITY_TEXTS), "tokens": sum(row.size for row in tokens), "max_abs_error": error,
        "min_cosine": cosine, "torch": torch.__version__,
    }  # fmt: skip


def _accept_int8(small: TextEncoder, exact: TextEncoder, cloud: LabelledCloud | None) -> dict[str, Any]:
    """What int8 costs; OgPointcloudError where that is too much."""
    own = cloud.vocabulary.names if cloud is not None and cloud.vocabulary is not None else ()
    names = list(dict.fromkeys([*own, *filter(str.strip, PARITY_TEXTS)]))
    vectors, expected = small(names), exact(names)
    cosines = (vectors.astype(np.float64) * expected).sum(axis=1)
    worst = int(cosines.argmin())
    if cosines[worst] < INT8_COSINE:
        raise OgPointcloudError(
            f"int8 turns the vector of '{names[worst]:.40}' to cosine {cosines[worst]:.4f}; expected at least "
            f"{INT8_COSINE}: leave --int8 out"
        )
    report: dict[str, Any] = {
        "texts": len(names),
        "min_cosine": float(cosines[worst]),
        "mean_cosine": float(cosines.mean()),
    }
    if cloud is None:
        return report
    FeatureSpace(exact.feature_space, exact.width).require(cloud.space, "scene's descriptors")
    words = [names.index(name) for name in own] or list(range(len(names)))
    before, after = (cloud.instances.cosines(rows[words].astype(np.float64)) for rows in (expected, vectors))
    changed = _choices_changed(before, after) + _choices_changed(before.T, after.T)
    if changed:
        raise OgPointcloudError(
            f"int8 changes {changed} of the scene's choices (best word of {len(before)} instances, best instance of "
            f"{len(words)} words); expected 0: leave --int8 out"
        )
    return {**report, "instances": len(before), "words": len(words), "choices_changed": changed}


def _choices_changed(before: NDArray[np.floating], after: NDArray[np.floating]) -> int:
    """Rows whose best column became one that was worse; among equals there was no choice."""
    if before.size == 0:
        return 0
    chosen = np.take_along_axis(before, after.argmax(axis=1)[:, None], axis=1)[:, 0]
    return int((chosen < before.max(axis=1) - EQUAL).sum())


def files_with_manifest(manifest: dict[str, Any], held: dict[str, bytes]) -> dict[str, bytes]:
    """The files of an encoder, the manifest among them, which says their sizes and checksums."""
    described = {
        name: {"bytes": len(data), "crc32": zlib.crc32(data), "sha256": hashlib.sha256(data).hexdigest()}
        for name, data in held.items()
    }
    text = json.dumps({**manifest, "files": described}, indent=1, ensure_ascii=False)
    return {MANIFEST: text.encode(), **held}


def own_name(source: Path) -> str:
    """OWNER/MODEL as a model's configuration has it; OgPointcloudError where it says none."""
    config = source / "config.json"
    name = read_json(config).get("_name_or_path") if config.is_file() else None
    if not isinstance(name, str) or not MODEL_NAME.fullmatch(name):
        raise OgPointcloudError(
            f"{source} does not say which model it is; pass --feature-space as your scenes name it (og-pointcloud info "
            "S.ogpc), such as openai/clip-vit-base-patch32 or laion/CLIP-ViT-B-16-laion2B-s34B-b88K"
        )
    return name


def write_folder(folder: Path, files: Mapping[str, bytes], known: Collection[str]) -> None:
    """Put a folder in place whole; one that is there already must hold known names only, which it replaces."""
    if folder.exists() and (not folder.is_dir() or {path.name for path in folder.iterdir()} - set(known)):
        raise OgPointcloudError(f"{folder} holds other things than an encoder; expected a new or an encoder's folder")
    folder.parent.mkdir(parents=True, exist_ok=True)
    new, old = (folder.with_name(f".{folder.name}.{os.getpid()}.{kind}") for kind in ("new", "old"))
    try:
        new.mkdir()
        for name, data in files.items():
            (new / name).write_bytes(data)
        if folder.exists():
            folder.rename(old)
        new.rename(folder)
    except BaseException:
        shutil.rmtree(new, ignore_errors=True)
        if old.exists() and not folder.exists():
            old.rename(folder)
        raise
    shutil.rmtree(old, ignore_errors=True)


def own_version() -> str:
    """Of this library, for manifests."""
    try:
        return version("og-pointcloud")
    except PackageNotFoundError:
        return "unknown"
