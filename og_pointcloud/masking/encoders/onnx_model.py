"""An image encoder that ``og-pointcloud export-image-encoder`` wrote, run by onnxruntime: no torch.

A folder, nothing in it pickled:

  manifest.json       format, schema_version, feature_space, width, preprocessing, crops, bytes and checksums of the
                      graph, parity figures against torch
  image_encoder.onnx  pixels (B, 3, S, S) float32 -> image (B, D) float32, unit rows

What is read is checked before it is run: it may come from a stranger.
"""

from __future__ import annotations

import json
import os
import zlib
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.masking.crops import Crop
from og_pointcloud.masking.encoders.preprocessing import Preprocessing
from og_pointcloud.models import check_graph

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

__all__ = ["ENCODER_FILES", "FORMAT", "GRAPH", "MANIFEST", "OPERATORS", "SCHEMA_VERSION", "OnnxModel", "said_space"]

FORMAT, SCHEMA_VERSION = "og-image-encoder", 1
MANIFEST, GRAPH = "manifest.json", "image_encoder.onnx"
ENCODER_FILES = {MANIFEST: 1 << 20, GRAPH: (1 << 31) - 1}
"""The files of an encoder, and the bytes that each may have; a serialised graph cannot have more."""
OPERATORS = frozenset({
    "Add", "Concat", "Conv", "DequantizeLinear", "Div", "Erf", "Gather", "GlobalAveragePool", "LayerNormalization",
    "MatMul", "Max", "Mul", "ReduceL2", "Relu", "Reshape", "Sigmoid", "Softmax", "Split", "Tanh", "Transpose",
})  # fmt: skip
"""All that an encoder's graph is made of: none repeats, calls other graphs, or makes an array larger by its values."""
REMAKE = "make the encoder again with og-pointcloud export-image-encoder"


class OnnxModel:
    """Pixels -> image vectors. width: of a vector. crops: how its maker found masks best cut out."""

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        """folder: what export-image-encoder wrote; OgPointcloudError where it is damaged or something else."""
        self.where = str(folder)
        files = {name: _read_bounded(Path(folder) / name, most) for name, most in ENCODER_FILES.items()}
        try:
            manifest = _checked_manifest(files)
            self.feature_space: str = manifest["feature_space"]
            self.width: int = manifest["width"]
            self.preprocessing = Preprocessing.from_manifest(manifest["preprocessing"])
            self.crops = tuple(Crop(**entry) for entry in manifest["crops"])
        except KeyError as error:
            raise OgPointcloudError(f"{folder}: {error} is missing in {MANIFEST}: {REMAKE}") from None
        except (ValueError, TypeError, AttributeError, RecursionError) as error:
            raise OgPointcloudError(f"{folder}: not an image encoder that can be used ({error}): {REMAKE}") from None
        self.manifest = manifest
        self._graph = files[GRAPH]

    def __call__(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """(B, width) float32 unit rows of pixels (B, 3, S, S)."""
        try:
            vectors = np.asarray(self._session.run(["image"], {"pixels": pixels})[0])
        except Exception as error:  # onnxruntime raises types of its own
            reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
            raise OgPointcloudError(f"{self.where}: {GRAPH} does not run ({reason:.200}): {REMAKE}") from None
        if vectors.dtype != np.float32 or vectors.shape != (len(pixels), self.width) or not np.isfinite(vectors).all():
            raise OgPointcloudError(
                f"{self.where}: {GRAPH} gives {vectors.dtype} {vectors.shape} or NaN; expected finite float32 "
                f"({len(pixels)}, {self.width}): {REMAKE}"
            )
        return vectors

    @cached_property
    def _session(self) -> InferenceSession:
        from og_pointcloud.models import open_session

        return open_session(self._graph)


def said_space(folder: Path) -> str | None:
    """The feature space of a folder with an image encoder; None for any other folder."""
    try:
        manifest = json.loads(_read_bounded(folder / MANIFEST, ENCODER_FILES[MANIFEST]))
    except (OgPointcloudError, OSError, ValueError, RecursionError):
        return None
    return manifest.get("feature_space") if isinstance(manifest, dict) and manifest.get("format") == FORMAT else None


def _read_bounded(path: Path, most: int) -> bytes:
    try:
        with path.open("rb") as file:
            data = file.read(most + 1)
    except FileNotFoundError:
        raise OgPointcloudError(f"{path} is missing: {REMAKE}") from None
    if len(data) > most:
        raise OgPointcloudError(f"{path} has more than {most} bytes: it is not what export-image-encoder writes")
    return data


def _checked_manifest(files: Mapping[str, bytes]) -> dict[str, Any]:
    manifest = json.loads(files[MANIFEST])
    if manifest["format"] != FORMAT or manifest["schema_version"] != SCHEMA_VERSION:
        raise ValueError(
            f"its manifest says {manifest['format']!r:.40} {manifest['schema_version']!r:.20}; expected {FORMAT!r} "
            f"{SCHEMA_VERSION}"
        )
    width, space = manifest["width"], manifest["feature_space"]
    if not isinstance(width, int) or isinstance(width, bool) or not 1 <= width < 1 << 24 or not isinstance(space, str):
        raise ValueError(f"width {width!r:.40} or feature_space {space!r:.60}; expected a whole number and a name")
    if not isinstance(manifest["crops"], list) or not manifest["crops"]:
        raise ValueError(f"crops are {manifest['crops']!r:.60}; expected a list of at least one")
    if manifest["files"][GRAPH]["crc32"] != zlib.crc32(files[GRAPH]):
        raise ValueError(f"{GRAPH} has not the manifest's checksum: it is damaged or was changed")
    check_graph(files[GRAPH], OPERATORS)
    return manifest
