"""Words -> text vectors of a feature space, by an encoder that ``og-pointcloud export text`` wrote.

It is a folder, or the members ``text_encoder/`` of a .ogpc file; nothing in it is pickled:

  manifest.json       format, schema_version, feature_space, width, context_length, templates, precision, padding of
                      texts, bytes, crc32 and sha256 of the other files, parity figures against torch
  text_encoder.onnx   tokens (B, T) int64 -> text (B, D) float32, unit rows
  tokenizer.json      vocabulary and merges (see ``tokenizer``)
  word_bank.npy       (B, D) float16, everyday words in the manifest's templates (see ``choosing``)

It needs numpy and onnxruntime, and the tokenizers package if the tokenizer is not CLIP's. Files are untrusted, and are
checked before they are run.
"""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.cloud import FeatureSpace, WordBank
from og_pointcloud.errors import FeatureSpaceError, OgPointcloudError
from og_pointcloud.formats.atomic import StrPath
from og_pointcloud.formats.npy import array_from_npy
from og_pointcloud.models import MANIFEST, MODEL_NAME, EncoderFormat, home_folder, open_session
from og_pointcloud.text.tokenizer import MAX_CHARACTERS, open_tokenizer

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

MODELS_VARIABLE = "OG_POINTCLOUD_MODELS"
"""Environment variable: folders, separated as in PATH, that are encoders or contain some."""
GRAPH, TOKENIZER, WORD_BANK = "text_encoder.onnx", "tokenizer.json", "word_bank.npy"
OPERATORS = frozenset({
    "Add", "ArgMax", "Cast", "Clip", "Concat", "DequantizeLinear", "Div", "DynamicQuantizeLinear", "Equal", "Erf",
    "Expand", "Gather", "GatherND", "Gemm", "LayerNormalization", "LessOrEqual", "MatMul", "MatMulInteger", "Max",
    "Mul", "Pow", "Range", "ReduceL2", "Reshape", "Shape", "Sigmoid", "Slice", "Softmax", "Split", "Squeeze", "Tanh",
    "Transpose", "Unsqueeze", "Where",
})  # fmt: skip
"""The operators allowed in an encoder's graph: arithmetic without loops, random numbers, or graphs inside nodes."""
DEMO_ENCODER = Path(__file__).parents[1] / "masking" / "demo_encoder"
"""The encoder that comes with the library, its halves ``image`` and ``text``: it knows the demo room and nothing
else."""
CarriedEncoder: TypeAlias = "Callable[[], TextEncoder | None]"
TEXTS_PER_RUN = 64
MAX_TEMPLATES, MAX_TEMPLATE_CHARACTERS = 128, 400
"""Largest number of templates of an encoder, and of characters of one. CLIP has 80 templates for ImageNet."""
MAX_CACHED_VECTORS = 1 << 14
ENCODER = EncoderFormat(
    "og-text-encoder", 1, GRAPH, OPERATORS, "og-pointcloud export text", {TOKENIZER: 1 << 26, WORD_BANK: 1 << 26},
    optional=WORD_BANK,
)  # fmt: skip
"""The files of an encoder; the word bank may be absent."""


class TextEncoder:
    """Encodes words; made by ``read_text_encoder`` or ``encoder_for``. Thread-safe.

    The vectors of 16,384 texts are cached: a repeated label costs a look-up.
    """

    def __init__(self, files: Mapping[str, bytes], where: str) -> None:
        """files: the bytes of ENCODER's files. where: prefix of error texts, a path. OgPointcloudError if damaged.

        ``word_bank``: everyday words encoded by this encoder, None if it was made without.
        """
        self.where = where
        self.manifest = ENCODER.checked(files, where, _check_fields)
        self.feature_space: str = self.manifest["feature_space"]
        self.width: int = self.manifest["width"]
        self.space = FeatureSpace(self.feature_space, self.width)
        self.context_length: int = self.manifest["context_length"]
        self.templates: tuple[str, ...] = tuple(self.manifest["templates"])
        self.precision: str = self.manifest["precision"]
        self.word_bank = _word_bank(files[WORD_BANK], self.width, where) if WORD_BANK in files else None
        self._graph = files[GRAPH]
        try:
            self._tokenizer = open_tokenizer(files[TOKENIZER], self.context_length, self.manifest["vocabulary"])
        except ValueError as error:
            raise OgPointcloudError(f"{where}: {TOKENIZER} cannot be used ({error}): {ENCODER.remake}") from None
        self._cache: dict[str, NDArray[np.float32]] = {}

    def __call__(self, names: Sequence[str]) -> NDArray[np.float32]:
        """(len(names), D) float32, unit rows: for each name the mean over the manifest's templates."""
        # CLIP's prompt ensemble (Radford et al. 2021): unit vectors are averaged, and the mean is normalized again.
        texts = [template.replace("{}", name[:MAX_CHARACTERS]) for name in names for template in self.templates]
        vectors = self.encode(texts).reshape(len(names), len(self.templates), self.width).mean(axis=1)
        return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), np.finfo(np.float32).tiny)

    def encode(self, texts: Sequence[str]) -> NDArray[np.float32]:
        """(len(texts), D) float32, unit rows: the texts as they are, without templates."""
        cache = self._cache if len(self._cache) < MAX_CACHED_VECTORS else {}  # full: a new one
        missing = [text for text in dict.fromkeys(texts) if text not in cache]
        for batch, tokens in self._batches(missing):
            vectors = ENCODER.vectors(self._session, tokens, (len(tokens), self.width), self.where)
            cache.update(zip(batch, vectors, strict=True))
        self._cache = cache  # replaced, never emptied: another thread may be reading the old one
        return np.array([cache[text] for text in texts], np.float32).reshape(len(texts), self.width)

    def tokens(self, text: str) -> list[int]:
        """Token ids of a text, the encoder's input: cut to the context, padded only if the encoder needs it."""
        ids = self._tokenizer(text)
        pad = self.manifest["pad_id"]
        return ids if pad is None else ids + [pad] * (self.context_length - len(ids))

    def _batches(self, texts: Iterable[str]) -> Iterator[tuple[list[str], NDArray[np.int64]]]:
        """Batches of texts with equally many tokens, so that none needs padding to the length of another.

        An int8 graph scales the activations of a whole batch together: with one, each text runs alone, so that its
        vector does not depend on the others.
        """
        by_length: dict[int, list[tuple[str, list[int]]]] = {}
        for text in texts:
            tokens = self.tokens(text)
            by_length.setdefault(len(tokens), []).append((text, tokens))
        size = 1 if self.precision == "int8" else TEXTS_PER_RUN
        for group in by_length.values():
            for start in range(0, len(group), size):
                batch = group[start : start + size]
                yield [text for text, _ in batch], np.array([tokens for _, tokens in batch], np.int64)

    @cached_property
    def _session(self) -> InferenceSession:
        return open_session(self._graph, bounded=True)


def read_text_encoder(folder: StrPath) -> TextEncoder:
    """Open and check a folder that ``og-pointcloud export text`` wrote; OgPointcloudError for any other.

    Cached: the same unchanged folder gives the same encoder.
    """
    path = Path(folder).resolve()
    if not (path / MANIFEST).is_file():
        raise OgPointcloudError(f"{folder} has no {MANIFEST}; expected a folder that og-pointcloud export text wrote")
    states = [(path / name).stat() for name in ENCODER.files if (path / name).is_file()]
    return _read_once(path, tuple((state.st_mtime_ns, state.st_size) for state in states))


@lru_cache(maxsize=2)
def _read_once(folder: Path, _state: tuple[tuple[int, int], ...]) -> TextEncoder:
    return TextEncoder(ENCODER.read(folder), str(folder))


def encoder_for(feature_space: str, carried: CarriedEncoder | None = None) -> TextEncoder:
    """``find_encoder``, but if there is none, an OgPointcloudError that names the command that makes one."""
    if encoder := find_encoder(feature_space, carried):
        return encoder
    named = os.environ.get(MODELS_VARIABLE)
    raise OgPointcloudError(
        f"no text encoder for feature space '{feature_space}' is in {MODELS_VARIABLE} ({named or 'not set'}) or "
        f"{cache_folder()}; make one from the model's weights: {export_command(feature_space)}"
    )


def find_encoder(feature_space: str, carried: CarriedEncoder | None = None) -> TextEncoder | None:
    """The encoder of a feature space: the one that the scene carries, else the first one found in the model folders.

    carried: returns the encoder in the scene's file, if it has one (`bundle.vocabulary.carried_encoder`). The search
    order is the folders of OG_POINTCLOUD_MODELS, the user's cache folder, the library's own; each may be an encoder,
    or contain encoders. None if there is none; OgPointcloudError if there is one that cannot be used.
    """
    if carried is not None and (encoder := carried()):
        if not FeatureSpace(feature_space).accepts(encoder.space):
            raise FeatureSpaceError(
                f"{encoder.where} has feature space '{encoder.feature_space}', the scene has '{feature_space}', and "
                "vectors of two spaces cannot be compared: store the scene's own (og-pointcloud export --help)"
            )
        return encoder
    folder = ENCODER.find(feature_space, model_folders())
    return read_text_encoder(folder) if folder else None


def export_command(feature_space: str) -> str:
    """The command that makes the encoder of a feature space in a folder where it will be found."""
    if MODEL_NAME.fullmatch(feature_space):  # OWNER/MODEL, found in the cache of fetched models
        return f"og-pointcloud export text {feature_space}"
    return shlex.join(["og-pointcloud", "export", "text", "MODEL_FOLDER", "--feature-space", feature_space])


def cache_folder() -> Path:
    """The user's folder for encoders; it need not exist."""
    if sys.platform == "darwin":
        return home_folder() / "Library" / "Caches" / "og_pointcloud"
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or home_folder() / "AppData" / "Local") / "og_pointcloud" / "Cache"
    named = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return (named if named.is_absolute() else home_folder() / ".cache") / "og_pointcloud"


def check_templates(templates: Iterable[str]) -> tuple[str, ...]:
    """The templates: at least one text with ``{}`` in it, of limited number and length; else OgPointcloudError."""
    templates = (templates,) if isinstance(templates, str) else tuple(templates)
    if len(templates) > MAX_TEMPLATES or any(len(str(template)) > MAX_TEMPLATE_CHARACTERS for template in templates):
        raise OgPointcloudError(
            f"{len(templates)} templates of up to {max(len(str(template)) for template in templates)} characters; "
            f"expected at most {MAX_TEMPLATES} of {MAX_TEMPLATE_CHARACTERS}: each is encoded for every word"
        )
    wrong = [template for template in templates if not isinstance(template, str) or "{}" not in template]
    if wrong or not templates:
        raise OgPointcloudError(
            f"the template {(wrong or [None])[0]!r:.80} has no slot for the name; expected {{}} in it, as in 'a photo "
            "of a {}.'"
        )
    return templates


def model_folders() -> list[Path]:
    """Folders searched for encoders, in this order: OG_POINTCLOUD_MODELS, the cache, the library's demo encoder."""
    named = os.environ.get(MODELS_VARIABLE, "").split(os.pathsep)
    return [*(Path(folder).expanduser() for folder in named if folder), cache_folder(), DEMO_ENCODER]


def _check_fields(manifest: dict[str, Any]) -> None:
    for name, least in (("width", 1), ("context_length", 3), ("vocabulary", 1)):
        value = manifest[name]
        if not isinstance(value, int) or isinstance(value, bool) or not least <= value < 1 << 24:
            raise ValueError(f"{name} is {value!r:.40}; expected a whole number from {least}")
    if not isinstance(manifest["feature_space"], str) or manifest["precision"] not in ("fp32", "int8"):
        raise ValueError(f"feature_space {manifest['feature_space']!r:.60} or precision {manifest['precision']!r:.20}")
    pad = manifest["pad_id"]
    if pad is not None and not (isinstance(pad, int) and 0 <= pad < manifest["vocabulary"]):
        raise ValueError(f"pad_id is {pad!r:.40}; expected a token id, or none")
    if not isinstance(manifest["templates"], list):
        raise ValueError(f"templates are {manifest['templates']!r:.40}; expected a list of texts")
    check_templates(manifest["templates"])


def _word_bank(data: bytes, width: int, where: str) -> WordBank:
    try:
        vectors = array_from_npy(data)
        if vectors.dtype.str != "<f2" or vectors.ndim != 2 or vectors.shape[1] != width:
            raise ValueError(f"it is {vectors.dtype.str} {vectors.shape}; expected <f2 (B, {width})")
        return WordBank(vectors)
    except (ValueError, FeatureSpaceError) as error:
        raise OgPointcloudError(f"{where}: {WORD_BANK} cannot be used ({error}): {ENCODER.remake}") from None
