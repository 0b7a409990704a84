"""Mask encoders: what a mask shows, as a vector in the feature space of the text encoder of the same name.

``open_encoder`` opens three kinds:

- CLIP and SigLIP folders of transformers (`masking.clip`), which need torch;
- folders that ``og-pointcloud export image`` wrote, run by onnxruntime:
    manifest.json       format, schema_version, feature_space, width, preprocessing, crops, bytes and checksums of the
                        graph, parity figures against torch
    image_encoder.onnx  pixels (B, 3, S, S) float32 -> image (B, D) float32, unit rows; if the manifest has a patch,
                        pixels (B, 3, h * patch, w * patch), and also -> patches (B, h, w, D) float32, unit vectors
- "demo", such a folder shipped with the library; it knows only the things of the procedural room.

A folder may be untrusted, so it is checked before its graph is run: nothing is unpickled, and none of its code runs.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.formats.atomic import StrPath
from og_pointcloud.masking.contracts import ImageModel, MaskEncoder
from og_pointcloud.masking.crops import WITH_CONTEXT, Crop, Preprocessing, mask_crops
from og_pointcloud.masking.dense import DenseEncoder
from og_pointcloud.models import EncoderFormat, fetched_model, open_session
from og_pointcloud.text.encoder import DEMO_ENCODER, MODELS_VARIABLE, model_folders

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

DEMO_SPACE = "og_pointcloud/demo-room-encoder"
"""Feature space of the demo encoder, which knows only the things of the procedural room."""
GRAPH = "image_encoder.onnx"
OPERATORS = frozenset({
    "Add", "Clip", "Concat", "Conv", "DequantizeLinear", "Div", "Erf", "Expand", "Gather", "Gemm", "GlobalAveragePool",
    "LayerNormalization", "MatMul", "Max", "Mul", "Pow", "ReduceL2", "Relu", "Reshape", "Resize", "Shape", "Sigmoid",
    "Slice", "Softmax", "Split", "Squeeze", "Tanh", "Tile", "Transpose", "Unsqueeze", "Where",
})  # fmt: skip
"""The operators that an encoder's graph may have: arithmetic, without loops, random numbers or graphs inside nodes."""
ENCODER = EncoderFormat("og-image-encoder", 1, GRAPH, OPERATORS, "og-pointcloud export image")
CROPS_PER_RUN = 16
"""Bounds memory: a large model takes about 100 MB per crop."""


def open_encoder(name: StrPath, features: str = "crops") -> MaskEncoder:
    """Open an encoder; nothing is downloaded.

    name: "demo"; a folder that ``og-pointcloud export image`` wrote; a transformers folder of CLIP or SigLIP, which
        needs torch; or OWNER/MODEL, searched for in the folders of OG_POINTCLOUD_MODELS, in the user's cache, and among
        the downloads of Hugging Face's own tools.
    features: "crops", a few model runs per mask (`CropEncoder`), or "dense", one per image (`dense.DenseEncoder`).
    Raises OgPointcloudError where there is no such encoder, and where a model has no patches, which "dense" needs.
    """
    model = _open_model(name)
    if features == "crops":
        return CropEncoder(model, model.crops)
    if model.patch is None:
        raise OgPointcloudError(
            f"the encoder '{name}' only has vectors of whole crops; expected, for --features dense, CLIP or SigLIP "
            "from transformers or newly exported (og-pointcloud export image): give one, or use --features crops"
        )
    return DenseEncoder(model)


def encoder_folder(name: StrPath) -> Path | None:
    """The folder that `open_encoder` opens, None if there is none: a folder by its path, then by its stated feature
    space, then downloads of other tools."""
    if name == "demo":
        return DEMO_ENCODER / "image"
    if (path := Path(name).expanduser()).exists():
        return path
    return ENCODER.find(str(name), model_folders()) or fetched_model(str(name))


def _open_model(name: StrPath) -> ImageModel:
    if folder := encoder_folder(name):
        if ENCODER.feature_space(folder) is not None:
            return OnnxModel(folder)
        from og_pointcloud.masking.clip import TransformersModel  # torch

        return TransformersModel(folder, None if Path(name).expanduser().exists() else str(name))
    named = os.environ.get(MODELS_VARIABLE)
    raise OgPointcloudError(
        f"no encoder '{name}': it is not a folder, no encoder of that feature space is in {MODELS_VARIABLE} "
        f"({named or 'not set'}) or the cache, and it has not been fetched; expected 'demo', a model folder, or "
        f"OWNER/MODEL: fetch it first (hf download {name}), or give its folder"
    )


class CropEncoder(MaskEncoder):
    """A mask's vector is the weighted mean of its crops' vectors (a `contracts.MaskEncoder`)."""

    def __init__(self, model: ImageModel, crops: Sequence[Crop] = WITH_CONTEXT) -> None:
        """crops: ways to cut a mask out, at least one."""
        if not crops:
            raise SceneError("0 ways to crop are given; expected at least one")
        self.model, self.crops = model, tuple(crops)
        self.feature_space, self.width = model.feature_space, model.width

    def embed(self, image: NDArray[np.uint8], masks: NDArray[np.bool_]) -> NDArray[np.float32]:
        """image (H, W, 3) uint8 RGB, masks (M, H, W) bool -> (M, width) float32, L2-normalized rows.

        SceneError for arrays that do not fit together, and for a mask without a pixel.
        """
        total = np.zeros((len(masks), self.width), np.float32)
        for crop in self.crops:
            for start in range(0, len(masks), CROPS_PER_RUN):
                rows = slice(start, start + CROPS_PER_RUN)
                total[rows] += np.float32(crop.weight) * self._vectors(image, masks[rows], crop)
        return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), np.finfo(np.float32).tiny)

    def _vectors(self, image: NDArray[np.uint8], masks: NDArray[np.bool_], crop: Crop) -> NDArray[np.float32]:
        before = self.model.preprocessing
        # LangSplat's crops are black outside, which the model sees as a color. A blend should fade to no information.
        fill = before.fill if crop.outside else (0, 0, 0)
        return self.model(before.pixels(mask_crops(image, masks, crop, before.size, fill, before.resample)))


class OnnxModel:
    """An exported image encoder (an `ImageModel`), run by onnxruntime."""

    def __init__(self, folder: StrPath) -> None:
        """folder: written by ``og-pointcloud export image``; OgPointcloudError if it is damaged or something else."""
        self.where = str(folder)
        files = ENCODER.read(Path(folder))
        self.manifest = ENCODER.checked(files, self.where, self._take)
        self._graph = files[GRAPH]

    def _take(self, manifest: dict[str, Any]) -> None:
        width, space, crops = manifest["width"], manifest["feature_space"], manifest["crops"]
        if type(width) is not int or not 1 <= width < 1 << 24 or not isinstance(space, str):
            raise ValueError(f"width is {width!r:.40}, feature_space {space!r:.60}; expected a whole number and a name")
        if not isinstance(crops, list) or not crops:
            raise ValueError(f"crops are {crops!r:.60}; expected a list of at least one crop")
        self.feature_space: str = space
        self.width: int = width
        self.preprocessing = Preprocessing.from_manifest(manifest["preprocessing"])
        self.crops = tuple(Crop(**entry) for entry in crops)
        self.patch: int | None = manifest.get("patch")  # absent in exports that have no patches
        if self.patch is not None and (type(self.patch) is not int or not 1 <= self.patch <= self.preprocessing.size):
            raise ValueError(f"patch is {self.patch!r:.40}; expected a whole number up to {self.preprocessing.size}")

    def __call__(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """(B, width) float32 unit rows of pixels (B, 3, S, S)."""
        return ENCODER.vectors(self._session, pixels, (len(pixels), self.width), self.where)

    def patches(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """(h, w, width) unit vectors of pixels (1, 3, h * patch, w * patch), of an encoder that has a patch."""
        assert self.patch is not None
        rows, columns = (side // self.patch for side in pixels.shape[2:])
        return ENCODER.vectors(self._session, pixels, (1, rows, columns, self.width), self.where, "patches")[0]

    @cached_property
    def _session(self) -> InferenceSession:
        return open_session(self._graph)
