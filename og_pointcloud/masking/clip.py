"""CLIP and SigLIP through transformers, without its image processors and without torchvision."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.formats.atomic import StrPath
from og_pointcloud.masking.crops import WITH_CONTEXT, Crop, Preprocessing, Resample
from og_pointcloud.masking.pretrained import (
    Attention,
    best_device,
    load_pretrained,
    read_config,
    read_image_processor,
    torch,
)
from og_pointcloud.models import MODEL_NAME

CLASSES = {"clip": "CLIPModel", "siglip": "SiglipModel"}
"""config.json's model_type -> transformers' class."""
CLIP_MEAN_STD = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)
SIGLIP_MEAN_STD = (0.5, 0.5, 0.5), (0.5, 0.5, 0.5)
"""Means and standard deviations of RGB that the published models were trained with."""
PILLOW_RESAMPLE: dict[Any, Resample] = {2: "bilinear", 3: "bicubic"}


def load_model(folder: StrPath, attention: Attention = "sdpa") -> Any:
    """A CLIP or SigLIP (also SigLIP 2 of fixed size) by `pretrained.load_pretrained`."""
    return load_pretrained(Path(folder), CLASSES, attention)[0]


class ImageTower(torch.nn.Module):
    """Pixels (B, 3, h * patch, w * patch) float32 -> unit vectors of images (B, D) and of their patches (B, h, w, D).

    A model pools an image into one vector in its last attention: CLIP in its last layer, by the class token; SigLIP in
    its head, by a probe. For patch vectors, each patch attends to itself alone in that layer, which yields its own
    value, in the same space; nothing is trained. MaskCLIP (Zhou, Loy and Dai, ECCV 2022), section 3.2.
    """

    def __init__(self, model: Any) -> None:
        """model: from ``load_model``."""
        super().__init__()
        self.model, self.patch = model, int(model.config.vision_config.patch_size)

    def forward(self, pixels: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """See the class."""
        vision = self.model.vision_model
        seen = vision(pixel_values=pixels, interpolate_pos_encoding=True, output_hidden_states=True)
        if self.model.config.model_type == "clip":
            image = self.model.visual_projection(seen.pooler_output)
            # Run the last layer again on its input, without the class token: a softmax over one token is 1, so that
            # attention returns the token's own value.
            last, tokens = vision.encoder.layers[-1], seen.hidden_states[-2][:, 1:]
            attention = last.self_attn
            tokens = tokens + attention.out_proj(attention.v_proj(last.layer_norm1(tokens)))
            tokens = tokens + last.mlp(last.layer_norm2(tokens))
            patches = self.model.visual_projection(vision.post_layernorm(tokens))
        else:
            image, tokens = seen.pooler_output, seen.last_hidden_state
            patches = vision.head(tokens.flatten(0, 1)[:, None])  # each patch as an image of one
        rows, columns = (side // self.patch for side in pixels.shape[2:])
        return _unit(image), _unit(patches).reshape(-1, rows, columns, image.shape[1])


def _unit(vectors: torch.Tensor) -> torch.Tensor:
    return vectors / vectors.norm(dim=-1, keepdim=True)


class TransformersModel:
    """A CLIP or SigLIP as a `contracts.ImageModel`; on a GPU where torch has one."""

    def __init__(
        self,
        folder: StrPath,
        feature_space: str | None = None,
        *,
        crops: tuple[Crop, ...] = WITH_CONTEXT,
        attention: Attention = "sdpa",
    ) -> None:
        """feature_space: None: from the folder's configuration. Errors: as ``load_model``."""
        model = load_model(folder, attention)
        self.feature_space = feature_space or published_name(folder)
        self.preprocessing, self.crops = preprocessing_of(folder, model.config), crops
        self.device = best_device()
        self.tower = ImageTower(model).eval().to(self.device)
        self.patch: int | None = self.tower.patch
        size = self.preprocessing.size
        self.width: int = self(np.zeros((1, 3, size, size), np.float32)).shape[1]

    @torch.inference_mode()
    def __call__(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """(B, width) float32 unit rows of pixels (B, 3, S, S)."""
        found = self.tower.model.get_image_features(pixel_values=torch.from_numpy(pixels).to(self.device))
        return _unit(found.pooler_output).cpu().numpy()

    @torch.inference_mode()
    def patches(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """(h, w, width) float32 unit vectors of pixels (1, 3, h * patch, w * patch)."""
        return self.tower(torch.from_numpy(pixels).to(self.device))[1][0].cpu().numpy()


def preprocessing_of(folder: StrPath, config: Any) -> Preprocessing:
    """From the folder's preprocessor_config.json or processor_config.json, else that of the family's published models.
    config: the model's."""
    usual = CLIP_MEAN_STD if config.model_type == "clip" else SIGLIP_MEAN_STD
    stated, mean, std = read_image_processor(Path(folder), *usual)
    number, factor = stated.get("resample", 3), stated.get("rescale_factor", 1 / 255)
    if number not in tuple(PILLOW_RESAMPLE) or factor != 1 / 255:
        raise OgPointcloudError(
            f"{folder}: of its image processor, resample is {number!r:.20}, rescale_factor {factor!r:.20}; expected "
            "2 (bilinear) or 3 (bicubic), and 1/255"
        )
    return Preprocessing(config.vision_config.image_size, mean, std, PILLOW_RESAMPLE[number])


def published_name(folder: StrPath) -> str:
    """OWNER/MODEL from a model's configuration; OgPointcloudError where it has none."""
    name = read_config(Path(folder), "config.json").get("_name_or_path")
    if not isinstance(name, str) or not MODEL_NAME.fullmatch(name):
        raise OgPointcloudError(
            f"{folder} does not say which model it is; expected the name in your scenes (og-pointcloud info S.ogpc), "
            "such as openai/clip-vit-base-patch32 or laion/CLIP-ViT-B-16-laion2B-s34B-b88K: pass it to export text or "
            "export image with --feature-space; masks takes the folder that export image makes"
        )
    return name
