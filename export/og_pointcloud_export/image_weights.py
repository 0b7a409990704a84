"""The image tower of a CLIP or SigLIP model, read from the files that text_weights reads the text tower of.

Published vision transformers differ in three places: how patches begin (a class token, a norm), what the image's vector
is taken from (the class token, or attention by one learnt question), and whether it is projected.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.masking.crops import Resample
from og_pointcloud.masking.encoders.preprocessing import CLIP_MEAN, CLIP_STD, HALF, Preprocessing
from og_pointcloud_export.text_tokenizer import read_json
from og_pointcloud_export.text_weights import (
    Activation,
    Affine,
    Block,
    Weights,
    find_weights,
    named_activation,
    open_clip_activation,
    open_clip_block,
    own_settings,
    transformers_block,
    whole_number,
)

__all__ = ["AttentionPool", "ImageTower", "read_image_tower"]

Array: TypeAlias = "NDArray[np.float32]"

HEAD_WIDTH = 64
"""Of OpenCLIP's towers and OpenAI's that do not say."""
PILLOW_RESAMPLE: dict[Any, Resample] = {2: "bilinear", 3: "bicubic"}
OPEN_CLIP_UNDERSTOOD = {"image_size", "layers", "width", "head_width", "patch_size", "mlp_ratio", "patch_dropout"}


@dataclass(frozen=True)
class AttentionPool:
    """SigLIP's head: one learnt question attends to all patches, then x += contract(activation(expand(norm(x)))).

    question: (W,). attend_in: (W, 3 W), queries, keys and values side by side.
    """

    question: Array
    attend_in: Affine
    attend_out: Affine
    norm: Affine
    expand: Affine
    contract: Affine


@dataclass(frozen=True)
class ImageTower:
    """All that turns pixels into an image vector, float32.

    patch: (3 P P, W), rows by channel, row, column. position_embedding: (N, W), N patches, and the class token first
    where there is one. pool: None where the class token is the image's vector. projection: None for none.
    """

    patch: Affine
    patch_size: int
    class_token: Array | None
    position_embedding: Array
    pre_norm: Affine | None
    blocks: tuple[Block, ...]
    final_norm: Affine
    pool: AttentionPool | None
    projection: Affine | None
    heads: int
    activation: Activation
    epsilon: float
    preprocessing: Preprocessing

    @property
    def width(self) -> int:
        """Of the image vectors."""
        return self.position_embedding.shape[1] if self.projection is None else self.projection.weight.shape[1]

    @property
    def grid(self) -> int:
        """Patches along a side of the image."""
        return self.preprocessing.size // self.patch_size


def read_image_tower(source: Path, activation: Activation | None = None) -> ImageTower:
    """The image tower of a transformers or OpenCLIP folder, or of a file of weights with OpenAI's names.

    activation: of a file that does not say; OpenCLIP's own models use "gelu", those after OpenAI's "quick_gelu".
    OgPointcloudError where the source is none of these, or holds what is not understood.
    """
    files, config = find_weights(source)
    weights = Weights.read(files)
    try:
        if "vision_model.embeddings.patch_embedding.weight" in weights.names:
            tower = _from_transformers(weights, config, source)
        else:
            tower = _from_open_clip(weights, config, activation)
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        if isinstance(error, OgPointcloudError):
            raise
        raise OgPointcloudError(
            f"{source}: its configuration is not in the form of a CLIP or SigLIP ({type(error).__name__}: {error})"
        ) from None
    if tower.position_embedding.shape[1] % tower.heads:
        raise OgPointcloudError(
            f"{source}: width {tower.position_embedding.shape[1]} does not part in {tower.heads} heads"
        )
    return tower


def _from_transformers(weights: Weights, config: dict[str, Any], source: Path) -> ImageTower:
    family = str(config.get("model_type")).removesuffix("_vision_model")
    if family not in ("clip", "siglip", "siglip2"):
        raise OgPointcloudError(
            f"{weights.where}: model_type is {config.get('model_type')!r:.40}; expected clip, siglip or siglip2"
        )
    vision = own_settings(config, family, "vision")
    is_clip = family == "clip"
    model = "vision_model."
    position = weights.array(f"{model}embeddings.position_embedding.weight", None, None)
    width = position.shape[1]
    patch_size = whole_number(weights, "patch_size", vision.get("patch_size", 32 if is_clip else 16))
    if is_clip and "visual_projection.weight" not in weights.names:
        raise OgPointcloudError(
            f"{weights.where} has no 'visual_projection.weight', so its vectors cannot be compared with texts': name "
            "the whole CLIPModel, or CLIPVisionModelWithProjection"
        )
    layers = weights.count_layers(f"{model}encoder.layers.")
    size = patch_size * _grid(weights, len(position) - is_clip)
    return ImageTower(
        patch=_patch(weights, f"{model}embeddings.patch_embedding", width, patch_size, bias=not is_clip),
        patch_size=patch_size,
        class_token=weights.array(f"{model}embeddings.class_embedding", width) if is_clip else None,
        position_embedding=position,
        pre_norm=weights.norm(f"{model}pre_layrnorm", width) if is_clip else None,
        blocks=tuple(transformers_block(weights, f"{model}encoder.layers.{layer}", width) for layer in range(layers)),
        final_norm=weights.norm(f"{model}post_layernorm", width),
        pool=None if is_clip else _attention_pool(weights, f"{model}head", width),
        projection=weights.affine("visual_projection", width, None, bias=False) if is_clip else None,
        heads=whole_number(weights, "num_attention_heads", vision.get("num_attention_heads", 12)),
        activation=named_activation(
            weights, vision.get("hidden_act", "quick_gelu" if is_clip else "gelu_pytorch_tanh")
        ),
        epsilon=float(vision.get("layer_norm_eps", 1e-5 if is_clip else 1e-6)),
        preprocessing=_processor(source, size, is_clip),
    )


def _patch(weights: Weights, name: str, width: int, patch_size: int, *, bias: bool) -> Affine:
    """Stored as a convolution (W, 3, P, P) or, by SigLIP 2 for flexible shapes, as a Linear (W, P P 3)."""
    inputs, side = 3 * patch_size**2, patch_size
    offset = weights.array(f"{name}.bias", width) if bias else None
    if weights.fetch(f"{name}.weight").ndim == 2:
        flat = weights.array(f"{name}.weight", width, inputs).reshape(width, side, side, 3).transpose(0, 3, 1, 2)
    else:
        flat = weights.array(f"{name}.weight", width, 3, side, side)
    return Affine(np.ascontiguousarray(flat.reshape(width, inputs).T), offset)


def _attention_pool(weights: Weights, name: str, width: int) -> AttentionPool:
    expand = weights.affine(f"{name}.mlp.fc1", width, None)
    together = weights.array(f"{name}.attention.in_proj_weight", 3 * width, width).T
    return AttentionPool(
        question=weights.array(f"{name}.probe", 1, 1, width).ravel(),
        attend_in=Affine(np.ascontiguousarray(together), weights.array(f"{name}.attention.in_proj_bias", 3 * width)),
        attend_out=weights.affine(f"{name}.attention.out_proj", width, width),
        norm=weights.norm(f"{name}.layernorm", width),
        expand=expand,
        contract=weights.affine(f"{name}.mlp.fc2", expand.weight.shape[1], width),
    )


def _from_open_clip(weights: Weights, config: dict[str, Any], activation: Activation | None) -> ImageTower:
    model = config.get("model_cfg", {})
    vision = model.get("vision_cfg", {})
    strange = sorted(name for name, value in vision.items() if name not in OPEN_CLIP_UNDERSTOOD and value)
    if strange or "visual.conv1.weight" not in weights.names or "visual.proj" not in weights.names:
        named = f"vision_cfg has {strange[0]} {vision[strange[0]]!r:.60}" if strange else "image tower is no plain ViT"
        raise OgPointcloudError(
            f"{weights.where}: its {named}; not understood: use its transformers form, if there is one"
        )
    width, _, patch_size, _ = weights.fetch("visual.conv1.weight").shape
    position = weights.array("visual.positional_embedding", None, width)
    head_width = whole_number(weights, "head_width", vision.get("head_width", HEAD_WIDTH))
    layers = weights.count_layers("visual.transformer.resblocks.")
    return ImageTower(
        patch=_patch(weights, "visual.conv1", width, patch_size, bias=False),
        patch_size=patch_size,
        class_token=weights.array("visual.class_embedding", width),
        position_embedding=position,
        pre_norm=weights.norm("visual.ln_pre", width),
        blocks=tuple(
            open_clip_block(weights, f"visual.transformer.resblocks.{layer}", width) for layer in range(layers)
        ),
        final_norm=weights.norm("visual.ln_post", width),
        pool=None,
        projection=Affine(weights.array("visual.proj", width, None), None),
        heads=max(1, width // head_width),
        activation=open_clip_activation(weights, model, vision, activation),
        epsilon=1e-5,
        preprocessing=_open_clip_preprocessing(config, patch_size * _grid(weights, len(position) - 1)),
    )


def _grid(weights: Weights, patches: int) -> int:
    side = math.isqrt(max(patches, 0))
    if side == 0 or side * side != patches:
        raise OgPointcloudError(f"{weights.where} has places for {patches} patches; expected those of a square image")
    return side


def _processor(source: Path, size: int, is_clip: bool) -> Preprocessing:
    """What preprocessor_config.json says, or what the family's published models do."""
    file = (source if source.is_dir() else source.parent) / "preprocessor_config.json"
    said = read_json(file) if file.is_file() else {}
    mean, std = (CLIP_MEAN, CLIP_STD) if is_clip else (HALF, HALF)
    resample = PILLOW_RESAMPLE.get(said.get("resample", 3))
    if resample is None or said.get("rescale_factor", 1 / 255) != 1 / 255:
        raise OgPointcloudError(
            f"{file}: resample {said.get('resample')!r:.20} or rescale_factor {said.get('rescale_factor')!r:.20}; "
            "expected 2 (bilinear) or 3 (bicubic), and 1/255"
        )
    return Preprocessing(
        size=size,
        mean=tuple(said.get("image_mean", mean)),
        std=tuple(said.get("image_std", std)),
        resample=resample,
        keeps_shape=is_clip,
    )


def _open_clip_preprocessing(config: dict[str, Any], size: int) -> Preprocessing:
    said = config.get("preprocess_cfg", {})
    return Preprocessing(
        size=size,
        mean=tuple(said.get("mean", CLIP_MEAN)),
        std=tuple(said.get("std", CLIP_STD)),
        resample=said.get("interpolation", "bicubic"),
        keeps_shape=said.get("resize_mode", "shortest") == "shortest",
    )
