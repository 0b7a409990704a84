"""An image tower in torch, and its export: the folder that og_pointcloud.masking runs without torch.

The graph is built from the weights (image_graph); the tower here is the same in torch, so that two ways must agree
before anything is written.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import MissingExtraError, OgPointcloudError
from og_pointcloud.masking.crops import WITH_CONTEXT, Crop
from og_pointcloud.masking.encoders.onnx_model import (
    ENCODER_FILES,
    FORMAT,
    GRAPH,
    SCHEMA_VERSION,
    OnnxModel,
)
from og_pointcloud.masking.encoders.preprocessing import Preprocessing
from og_pointcloud.text.encoder import cache_folder
from og_pointcloud_export.image_graph import build_image_graph
from og_pointcloud_export.image_weights import AttentionPool, ImageTower, read_image_tower
from og_pointcloud_export.text_encoder import activated, files_with_manifest, own_name, own_version, write_folder
from og_pointcloud_export.text_weights import Activation, Affine, Block

try:
    import torch
    import torch.nn.functional as F
except ImportError as error:
    raise MissingExtraError("torch", "masks") from error

__all__ = ["TorchModel", "export_image_encoder", "open_tower", "write_image_encoder"]

TOLERANCE = 1e-5
"""Largest difference of a unit vector's entry from torch that is let through; float32 reaches about 1e-6."""
PARITY_IMAGES = 4


class TorchModel:
    """An image tower as an `ImageModel` and `DenseModel`; its weights lie on ``device`` from the first image on."""

    def __init__(self, tower: ImageTower, feature_space: str, device: str | None = None) -> None:
        """device: as torch names it; None: a GPU if torch sees one."""
        self.tower, self.feature_space = tower, feature_space
        self.width, self.preprocessing, self.grid = tower.width, tower.preprocessing, tower.grid
        self.device = torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))
        self._tensors: dict[int, torch.Tensor] = {}

    @torch.no_grad()
    def __call__(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """(B, width) float32 unit rows of pixels (B, 3, S, S)."""
        x = self._embedded(pixels)
        for block in self.tower.blocks:
            x = self._block(x, block)
        if self.tower.pool is None:
            pooled = self._norm(x[:, 0], self.tower.final_norm)
        else:
            pooled = self._pooled(self._norm(x, self.tower.final_norm), self.tower.pool)
        return self._projected(pooled).cpu().numpy()

    @torch.no_grad()
    def patches(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """(B, grid, grid, width) float32 unit vectors: what the model would say if each patch were all that its last
        attention sees.

        Up to the last block patches look at each other as always; there each attends to itself alone, so that its
        value stays in its place (after MaskCLIP, Zhou et al. 2022), and is pooled alone.
        """
        x = self._embedded(pixels)
        for block in self.tower.blocks[:-1]:
            x = self._block(x, block)
        x = self._block(x, self.tower.blocks[-1], alone=True)[:, int(self.tower.class_token is not None) :]
        x = self._norm(x, self.tower.final_norm)
        if self.tower.pool is not None:
            batch, count, width = x.shape
            x = self._pooled(x.reshape(batch * count, 1, width), self.tower.pool).view(batch, count, width)
        return self._projected(x).unflatten(1, (self.grid, self.grid)).cpu().numpy()

    def _embedded(self, pixels: NDArray[np.float32]) -> torch.Tensor:
        side = self.tower.patch_size
        images = torch.from_numpy(pixels).to(self.device)
        cut = images.unfold(2, side, side).unfold(3, side, side)  # (B, 3, rows, columns, P, P)
        x = self._linear(cut.permute(0, 2, 3, 1, 4, 5).flatten(3).flatten(1, 2), self.tower.patch)
        if self.tower.class_token is not None:
            x = torch.cat([self._tensor(self.tower.class_token).expand(len(x), 1, -1), x], dim=1)
        x = x + self._tensor(self.tower.position_embedding)
        return x if self.tower.pre_norm is None else self._norm(x, self.tower.pre_norm)

    def _block(self, x: torch.Tensor, block: Block, alone: bool = False) -> torch.Tensor:
        q, k, v = self._linear(self._norm(x, block.norm_1), block.attend_in).chunk(3, dim=2)
        x = x + self._linear(v if alone else self._mixed(q, k, v), block.attend_out)
        hidden = activated(self._linear(self._norm(x, block.norm_2), block.expand), self.tower.activation)
        return x + self._linear(hidden, block.contract)

    def _mixed(self, q: torch.Tensor, k: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
        q, k, v = (part.unflatten(2, (self.tower.heads, -1)).transpose(1, 2) for part in (q, k, v))
        return F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2)

    def _pooled(self, x: torch.Tensor, pool: AttentionPool) -> torch.Tensor:
        width = x.shape[2]
        question = self._tensor(pool.question).expand(len(x), 1, -1)
        q = self._linear(question, pool.attend_in)[..., :width]
        _, k, v = self._linear(x, pool.attend_in).chunk(3, dim=2)
        answer = self._linear(self._mixed(q, k, v), pool.attend_out)[:, 0]
        hidden = activated(self._linear(self._norm(answer, pool.norm), pool.expand), self.tower.activation)
        return answer + self._linear(hidden, pool.contract)

    def _projected(self, x: torch.Tensor) -> torch.Tensor:
        if self.tower.projection is not None:
            x = self._linear(x, self.tower.projection)
        return F.normalize(x, dim=-1)

    def _linear(self, x: torch.Tensor, affine: Affine) -> torch.Tensor:
        product = x @ self._tensor(affine.weight)
        return product if affine.bias is None else product + self._tensor(affine.bias)

    def _norm(self, x: torch.Tensor, affine: Affine) -> torch.Tensor:
        offset = self._tensor(cast("NDArray[np.float32]", affine.bias))
        return F.layer_norm(x, x.shape[-1:], self._tensor(affine.weight), offset, self.tower.epsilon)

    def _tensor(self, array: NDArray[np.float32]) -> torch.Tensor:
        if id(array) not in self._tensors:  # the tower keeps its arrays, so an id stays theirs
            self._tensors[id(array)] = torch.from_numpy(array).to(self.device)
        return self._tensors[id(array)]


def open_tower(
    source: str | os.PathLike[str], feature_space: str | None = None, activation: Activation | None = None
) -> TorchModel:
    """A model's weights as an image model. source, feature_space, activation, errors: see ``export_image_encoder``."""
    return TorchModel(read_image_tower(Path(source), activation), feature_space or own_name(Path(source)))


def export_image_encoder(
    source: str | os.PathLike[str],
    output: str | os.PathLike[str] | None = None,
    *,
    feature_space: str | None = None,
    activation: Activation | None = None,
    crops: Sequence[Crop] = WITH_CONTEXT,
) -> tuple[Path, dict[str, Any]]:
    """Write a model's image tower as a folder, whole or not at all. Returns the folder, and its manifest.

    source: a transformers CLIP or SigLIP folder, an OpenCLIP folder, or a file of weights with OpenAI's or OpenCLIP's
        names (.safetensors, weights-only .pt). output: None for the user's cache, where it is found without a word.
    feature_space: OWNER/MODEL, the text encoder's; None: what the model's configuration calls itself.
    activation: of a source that does not say. crops: how masks are cut out unless the caller says otherwise.
    Raises OgPointcloudError, and MissingExtraError where torch or onnx is absent; then nothing is written.
    """
    tower = read_image_tower(Path(source), activation)
    space = feature_space or own_name(Path(source))
    model = TorchModel(tower, space, device="cpu")
    about = {
        "tower": {
            "layers": len(tower.blocks), "heads": tower.heads, "activation": tower.activation,
            "patch_size": tower.patch_size, "pooling": "class" if tower.pool is None else "attention",
        },
    }  # fmt: skip
    folder = Path(output) if output is not None else cache_folder() / (re.sub(r"[^\w.-]+", "--", space) + "--image")
    return folder, write_image_encoder(folder, build_image_graph(tower), model, crops, about)


def write_image_encoder(
    folder: Path, graph: bytes, model: Any, crops: Sequence[Crop], about: dict[str, Any]
) -> dict[str, Any]:
    """Write a graph as an image encoder if it says what ``model``, the same in torch, says. Returns the manifest.

    model: an `ImageModel`. about: more for the manifest to say.
    """
    preprocessing: Preprocessing = model.preprocessing
    manifest = {
        "format": FORMAT,
        "schema_version": SCHEMA_VERSION,
        "written_by": f"og-pointcloud {own_version()}",
        "feature_space": model.feature_space,
        "width": model.width,
        "preprocessing": preprocessing.as_manifest(),
        "crops": [asdict(crop) for crop in crops],
        **about,
    }
    manifest["parity"] = _parity(graph, model)
    files = files_with_manifest(manifest, {GRAPH: graph})
    write_folder(folder, files, known=ENCODER_FILES)
    return OnnxModel(folder).manifest


def _parity(graph: bytes, model: Any) -> dict[str, Any]:
    """How far the graph is from torch, on images of noise and of even colours; OgPointcloudError where too far."""
    from og_pointcloud.models import open_session

    size = model.preprocessing.size
    random = np.random.default_rng(0)
    squares = random.integers(0, 256, (PARITY_IMAGES, size, size, 3), np.uint8)
    squares[PARITY_IMAGES // 2 :] = squares[PARITY_IMAGES // 2 :, :1, :1]
    pixels = model.preprocessing.pixels(squares)
    got, expected = np.asarray(open_session(graph).run(["image"], {"pixels": pixels})[0]), model(pixels)
    error = float(np.abs(got - expected).max())
    if not error <= TOLERANCE:
        raise OgPointcloudError(
            f"the graph differs from torch by {error:.3g}; expected at most {TOLERANCE}: the weights may hold values "
            "that leave float32; if not, please report this model"
        )
    cosine = float((got.astype(np.float64) * expected).sum(axis=1).min())
    return {"images": PARITY_IMAGES, "max_abs_error": error, "min_cosine": cosine, "torch": torch.__version__}
