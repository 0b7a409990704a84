"""CLIP and SigLIP models of transformers -> the encoder folders that the base install runs, through torch.onnx.export.

Before a folder is written, its graph is opened by the same code that will open it later, and its vectors are compared
with torch's. Models are loaded by `masking.clip.load_model`: three model types, .safetensors, nothing fetched.
"""

from __future__ import annotations

import hashlib
import json
import logging
import re
import warnings
import zlib
from collections.abc import Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import MissingExtraError, OgPointcloudError, naming_extra
from og_pointcloud.formats.atomic import StrPath, replacing_folder
from og_pointcloud.formats.npy import npy_bytes
from og_pointcloud.formats.poses import read_json_object
from og_pointcloud.masking import encode
from og_pointcloud.masking.contracts import ImageModel
from og_pointcloud.masking.crops import WITH_CONTEXT, Crop
from og_pointcloud.models import MANIFEST, EncoderFormat, check_graph, open_session
from og_pointcloud.text import encoder as text_encoder
from og_pointcloud.text.encoder import TextEncoder, cache_folder, check_templates
from og_pointcloud.text.text_features import everyday_words
from og_pointcloud_export.writer import written_by

with naming_extra("torch, transformers and onnx", "export"):
    import torch

    from og_pointcloud.masking.clip import TransformersModel, load_model, published_name
    from og_pointcloud.masking.pretrained import read_config
if find_spec("onnxscript") is None:  # torch.onnx.export imports it late, with a less helpful error
    raise MissingExtraError("onnxscript", "export")

OPSET = 18
TOLERANCE = 1e-5
"""Largest accepted difference from torch in any entry of a unit vector; float32 reaches about 1e-6."""
PARITY_TEXTS = (
    "", " ", "a", "chair", "a photo of a chair.", "red mug", "object", "things", "stuff", "texture",
    "fire extinguisher", "kitchen counter", "a wooden table with four legs, seen from above", "traffic light",
    "person riding a bicycle", "café", "cafe\u0301", "naïve façade", "it's the dog's", "Ünïcödé", "日本語の看板",
    "стул", "كرسي", "\U0001f469\u200d\U0001f467 \U0001f44d\U0001f3fd", "1234567890", "3.14 %", "!?.,;:-_()[]{}",
    "A   lot\tof \n space", "&amp; &lt;b&gt;", "\x00\x1f control", "x" * 300,
    "a very long sentence that goes on " * 20, "<|endoftext|> early", "TV", "tv", "sofa", "window", "door", "lamp",
)  # fmt: skip
"""Labels and awkward texts on which graph and torch are compared."""
PARITY_IMAGES = 4
PARITY_PATCHES = (4, 7)
"""Rows and columns of patches of an additional image, whose shape differs from training."""
MAX_PATCHES_PER_SIDE = 1 << 10
"""Patches along a side of an image that a graph accepts."""


def export_text_encoder(
    source: StrPath,
    output: StrPath | None = None,
    *,
    feature_space: str | None = None,
    templates: Sequence[str] = ("{}",),
) -> tuple[Path, dict[str, Any]]:
    """Write a model's text encoder as a folder, atomically. Returns the folder and its manifest.

    The folder also holds the vectors of our everyday words, by which scenes judge labels (`ask.choosing`).

    source: a transformers folder of CLIP or SigLIP with its tokenizer. output: None for the user's cache, where it is
        found by its feature space.
    feature_space: OWNER/MODEL, as scenes name it; None: the name in the model's configuration.
    templates: texts with {} for the name; the mean of their vectors represents the name.
    Raises OgPointcloudError, and then writes nothing.
    """
    source = Path(source)
    templates = check_templates(templates)
    space = feature_space or published_name(source)
    model = load_model(source, "eager")
    config, is_causal = model.config.text_config, model.config.model_type == "clip"
    tokenizer = _tokenizer_of(source, is_causal)
    about = {
        "feature_space": space,
        "context_length": config.max_position_embeddings,
        "vocabulary": config.vocab_size,
        "pad_id": None if is_causal else _pad_id(source, tokenizer),
        "templates": list(templates),
        "model_type": model.config.model_type,
    }
    folder = Path(output) if output is not None else cache_folder() / _folder_name(space)
    return folder, write_text_encoder(folder, _TextTower(model).eval(), tokenizer, about)


def write_text_encoder(folder: Path, tower: Any, tokenizer: dict[str, Any], about: dict[str, Any]) -> dict[str, Any]:
    """Write a torch module as a text encoder if its graph gives the module's vectors. Returns the manifest.

    tower: tokens (B, T) int64 -> (B, D) unit rows; T is any length up to the context, or exactly the context if
        about["pad_id"] is set. tokenizer: as in a tokenizer.json. about: the manifest's entries about the model.
    """
    context, pad_id = about["context_length"], about["pad_id"]
    # No size of the example is 1, which torch.export would treat as a constant.
    example = torch.zeros((2, min(context, 7) if pad_id is None else context), dtype=torch.int64)
    batch, length = torch.export.Dim("batch"), torch.export.Dim("length", min=1, max=context)
    graph = _onnx_graph(tower, example, "tokens", ["text"], {0: batch, 1: length} if pad_id is None else {0: batch})
    with torch.no_grad():
        width = tower(example).shape[1]
    about = {**_heading(text_encoder.ENCODER), **about, "width": width, "precision": "fp32"}
    contents = {text_encoder.GRAPH: graph, text_encoder.TOKENIZER: json.dumps(tokenizer, ensure_ascii=False).encode()}
    encoder = TextEncoder(_with_manifest(about, contents), str(folder))
    parity = _text_parity(tower, encoder)
    # The bank is encoded by the graph itself, as labels will be.
    contents[text_encoder.WORD_BANK] = npy_bytes(encoder(everyday_words()).astype(np.float16))
    files = _with_manifest({**about, "parity": parity}, contents)
    _write_folder(folder, files, text_encoder.ENCODER)
    return json.loads(files[MANIFEST])


def export_image_encoder(
    source: StrPath,
    output: StrPath | None = None,
    *,
    feature_space: str | None = None,
    crops: Sequence[Crop] = WITH_CONTEXT,
) -> tuple[Path, dict[str, Any]]:
    """Write a model's image encoder as a folder, atomically. Returns the folder and its manifest.

    source, output: as for ``export_text_encoder``. feature_space: OWNER/MODEL, the text encoder's; None: the name in
    the model's configuration. crops: default way to crop masks.
    Raises OgPointcloudError, and MissingExtraError if a package of the 'export' extra is absent.
    """
    model = TransformersModel(source, feature_space, crops=tuple(crops), attention="eager")
    model.device = torch.device("cpu")  # the tower is exported and compared there
    about = {"model_type": model.tower.model.config.model_type, "patch": model.patch}
    folder = Path(output) if output is not None else cache_folder() / f"{_folder_name(model.feature_space)}--image"
    return folder, write_image_encoder(folder, model, model.tower.cpu(), about)


def write_image_encoder(folder: Path, model: ImageModel, tower: Any, about: dict[str, Any]) -> dict[str, Any]:
    """Write a torch module as an image encoder if its graph gives the model's vectors. Returns the manifest.

    model: the reference that the graph must agree with. tower: the same model as a torch module with patches
    (`clip.ImageTower`), or the bytes of a graph (B, 3, S, S) -> (B, D) without. about: further entries of the manifest;
    "patch" is needed for a module.
    """
    if isinstance(tower, bytes):
        graph = tower
    else:
        patch = about["patch"]
        sides = {
            axis: patch * torch.export.Dim(name, min=2, max=MAX_PATCHES_PER_SIDE) for axis, name in ((2, "h"), (3, "w"))
        }
        example = torch.zeros((2, 3, 3 * patch, 5 * patch))
        graph = _onnx_graph(tower, example, "pixels", ["image", "patches"], {0: torch.export.Dim("batch"), **sides})
    try:
        check_graph(graph, encode.OPERATORS)
    except ValueError as error:
        raise OgPointcloudError(
            f"the graph that torch {torch.__version__} wrote cannot be used ({error}): report this model as a bug"
        ) from None
    manifest = {
        **_heading(encode.ENCODER),
        "feature_space": model.feature_space,
        "width": model.width,
        "preprocessing": asdict(model.preprocessing),
        "crops": [asdict(crop) for crop in model.crops],
        **about,
        "parity": _image_parity(graph, model),
    }
    _write_folder(folder, _with_manifest(manifest, {encode.GRAPH: graph}), encode.ENCODER)
    return encode.OnnxModel(folder).manifest


class _TextTower(torch.nn.Module):
    """Tokens (B, T) int64 -> (B, D) unit rows."""

    def __init__(self, model: Any) -> None:
        super().__init__()
        self.model = model

    def forward(self, tokens: torch.Tensor) -> torch.Tensor:
        vectors = self.model.get_text_features(input_ids=tokens).pooler_output
        return vectors / vectors.norm(dim=-1, keepdim=True)


def _onnx_graph(
    tower: Any, example: torch.Tensor, input_name: str, output_names: list[str], dimensions: dict[int, Any]
) -> bytes:
    """The module as one serialized graph. OgPointcloudError if it exceeds the size limit of one file."""
    weights = sum(tensor.numel() * tensor.element_size() for tensor in {id(p): p for p in tower.parameters()}.values())
    with _quietly(), torch.no_grad():
        program = torch.onnx.export(
            tower, (example,), dynamo=True, opset_version=OPSET, verbose=False,
            input_names=[input_name], output_names=output_names, dynamic_shapes=(dimensions,),
        )  # fmt: skip
    assert program is not None
    try:
        return program.model_proto.SerializeToString()
    except Exception:  # protobuf's own type
        raise OgPointcloudError(
            f"the model has {weights / 1e9:.2f} GB of weights; expected less than 2 GB, the limit of one file"
        ) from None


@contextmanager
def _quietly() -> Any:
    """Suppress the warnings and log lines of torch.onnx.export about its internals."""
    before = logging.root.manager.disable
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        logging.disable(logging.WARNING)
        try:
            yield
        finally:
            logging.disable(before)


# Tokenizers


def _tokenizer_of(source: Path, is_causal: bool) -> dict[str, Any]:
    """tokenizer.json beside the weights or, for CLIP, made by transformers from vocab.json and merges.txt."""
    if (source / text_encoder.TOKENIZER).is_file():
        description = read_json_object(source / text_encoder.TOKENIZER)
        return description if is_causal else _lower_casing(description)
    if is_causal and (source / "vocab.json").is_file() and (source / "merges.txt").is_file():
        from transformers import CLIPTokenizer

        tokenizer: Any = CLIPTokenizer.from_pretrained(source, local_files_only=True)
        return json.loads(tokenizer.backend_tokenizer.to_str())
    raise OgPointcloudError(
        f"{source} has no tokenizer; expected tokenizer.json{', or vocab.json and merges.txt,' if is_causal else ''} "
        "beside the weights"
    )


def _lower_casing(description: dict[str, Any]) -> dict[str, Any]:
    """Add lower-casing for SigLIP 2, which was trained on lower case: its models' Gemma tokenizer.json lacks it."""
    model = description.get("model")
    if not isinstance(model, dict) or model.get("type") == "Unigram" or '"Lowercase"' in json.dumps(
        description.get("normalizer")
    ):  # fmt: skip
        return description
    steps = [{"type": "Lowercase"}, *filter(None, [description.get("normalizer")])]
    return {**description, "normalizer": {"type": "Sequence", "normalizers": steps}}


def _pad_id(source: Path, description: dict[str, Any]) -> int:
    """Id of the token that pads texts to the context; models that attend to it need the one used in training."""
    file, config = source / "tokenizer_config.json", read_config(source, "tokenizer_config.json")
    named = config.get("pad_token")
    token = named.get("content") if isinstance(named, dict) else named
    try:
        added = {entry["content"]: entry["id"] for entry in description.get("added_tokens") or []}
        vocabulary = description["model"]["vocab"]
        ids = vocabulary if isinstance(vocabulary, dict) else {entry[0]: id for id, entry in enumerate(vocabulary)}
        id = {**ids, **added}.get(token)
    except (LookupError, TypeError) as error:
        raise OgPointcloudError(
            f"{source / text_encoder.TOKENIZER} and {file.name} cannot be read together ({error!r:.80}); expected what "
            "transformers writes: a model with a vocab, and tokens with content and id"
        ) from None
    if id is None or config.get("padding_side", "right") != "right":
        raise OgPointcloudError(
            f"{file} has pad_token {token!r:.40}, padding_side {config.get('padding_side')!r:.20}; expected a token of "
            "the vocabulary, and padding on the right, as this model reads texts padded to its context: set both there"
        )
    return id


# Checks


def _text_parity(tower: Any, encoder: TextEncoder) -> dict[str, Any]:
    """Difference of the graph from torch; torch encodes texts one by one, so that effects of batching show."""
    tokens = [torch.tensor([encoder.tokens(text)]) for text in PARITY_TEXTS]
    with torch.no_grad():
        expected = torch.cat([tower(row) for row in tokens]).numpy()
    return {
        "texts": len(PARITY_TEXTS), "tokens": sum(row.numel() for row in tokens),
        **_difference(encoder.encode(PARITY_TEXTS), expected),
    }  # fmt: skip


def _image_parity(graph: bytes, model: ImageModel) -> dict[str, Any]:
    """Difference of the graph from the model, on images of noise and of uniform colors, and on patches if any."""
    size = model.preprocessing.size
    squares = np.random.default_rng(0).integers(0, 256, (PARITY_IMAGES, size, size, 3), np.uint8)
    squares[PARITY_IMAGES // 2 :] = squares[PARITY_IMAGES // 2 :, :1, :1]  # the second half: uniform colors
    pixels = model.preprocessing.pixels(squares)
    session = open_session(graph)
    got, expected = np.asarray(session.run(["image"], {"pixels": pixels})[0]), model(pixels)
    if model.patch is not None:
        sides = (side * model.patch for side in PARITY_PATCHES)
        wide = np.random.default_rng(1).normal(size=(1, 3, *sides)).astype(np.float32)
        patches = np.asarray(session.run(["patches"], {"pixels": wide})[0])
        got = np.concatenate([got, patches.reshape(-1, model.width)])
        expected = np.concatenate([expected, model.patches(wide).reshape(-1, model.width)])
    return {"images": PARITY_IMAGES, **_difference(got, expected)}


def _difference(got: NDArray[np.float32], expected: NDArray[np.float32]) -> dict[str, Any]:
    """The manifest's parity figures; OgPointcloudError if the graph's unit rows differ too much from torch's."""
    error = float(np.abs(got - expected).max())
    if not error <= TOLERANCE:
        raise OgPointcloudError(
            f"the graph differs from torch by {error:.3g}; expected at most {TOLERANCE}: the weights may contain "
            "values beyond float32; if not, report this model as a bug"
        )
    cosine = float((got.astype(np.float64) * expected).sum(axis=1).min())
    return {"max_abs_error": error, "min_cosine": cosine, "torch": torch.__version__}


# Files


def _heading(encoder: EncoderFormat) -> dict[str, Any]:
    return {"format": encoder.name, "schema_version": encoder.version, "written_by": written_by()}


def _with_manifest(manifest: dict[str, Any], contents: dict[str, bytes]) -> dict[str, bytes]:
    """The files of an encoder, including the manifest, which lists their sizes and checksums."""
    described = {
        name: {"bytes": len(data), "crc32": zlib.crc32(data), "sha256": hashlib.sha256(data).hexdigest()}
        for name, data in contents.items()
    }
    text = json.dumps({**manifest, "files": described}, indent=1, ensure_ascii=False)
    return {MANIFEST: text.encode(), **contents}


def _folder_name(feature_space: str) -> str:
    return re.sub(r"[^\w.-]+", "--", feature_space)


def _write_folder(folder: Path, files: Mapping[str, bytes], encoder: EncoderFormat) -> None:
    """Write a complete folder, replacing an encoder's if there is one; a folder with anything else in it is refused."""
    if folder.exists() and (not folder.is_dir() or {path.name for path in folder.iterdir()} - encoder.files.keys()):
        raise OgPointcloudError(f"{folder} has other files than an encoder's; expected a new or an encoder's folder")
    with replacing_folder(folder, overwrite=True) as new:
        new.mkdir()
        for name, data in files.items():
            (new / name).write_bytes(data)
