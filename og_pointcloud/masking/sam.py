"""SAM, SAM-HQ, SAM 2 and SAM 3 through transformers, without its image processors and without torchvision.

`prepared` replaces the processors, with the numbers of the model's ``preprocessor_config.json``: SAM and SAM-HQ scale
the longer side and pad, SAM 2 and 3 scale both sides to a square. Points go to SAM 3's tracker half; words are in
``sam3``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.atomic import StrPath
from og_pointcloud.masking.crops import Color
from og_pointcloud.masking.pretrained import best_device, load_pretrained, read_image_processor, torch
from og_pointcloud.models import model_folder

CLASSES = {
    "sam": "SamModel",
    "sam_hq": "SamHQModel",
    "sam2": "Sam2Model",
    "sam2_video": "Sam2Model",
    "sam3": "Sam3TrackerModel",
    "sam3_video": "Sam3TrackerModel",
    "sam3_tracker": "Sam3TrackerModel",
    "sam3_tracker_video": "Sam3TrackerModel",
}
"""config.json's model_type -> the class that takes point prompts."""
PADDED_MODELS = ("sam", "sam_hq")
IMAGENET_MEAN_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
HALF_MEAN_STD = (0.5, 0.5, 0.5), (0.5, 0.5, 0.5)


@dataclass(frozen=True)
class Preparation:
    """side: pixels of the square that the model takes. padded: the longer side is scaled to it and the rest is padded
    with 0; else both sides are scaled. mean, std: of channels in [0, 1]."""

    side: int
    padded: bool
    mean: Color
    std: Color


@dataclass(frozen=True)
class LoadedModel:
    """kind: its model_type. device: a GPU where torch has one."""

    model: Any
    kind: str
    folder: Path
    device: torch.device
    preparation: Preparation

    def pixels(self, image: NDArray[np.uint8]) -> torch.Tensor:
        """(H, W, 3) uint8 RGB -> the model's input, `prepared`, on its device."""
        return prepared(image, self.preparation).to(self.device)


def load_sam(name: StrPath, classes: Mapping[str, str]) -> LoadedModel:
    """A model's folder or a downloaded OWNER/MODEL, in evaluation mode. classes: model_type -> class of transformers.

    SceneError where there is no model of these types, or it cannot be read.
    """
    found = model_folder(name)
    if found is None:
        raise SceneError(
            f"no SAM model '{name}'; expected a transformers folder with config.json and weights, or a fetched model: "
            "hf download OWNER/MODEL"
        )
    model, kind = load_pretrained(found, classes)
    device = best_device()
    return LoadedModel(model.to(device), kind, found, device, _preparation(found, kind, model.config))


class SamPredictor:
    """A `PointPredictor` on SAM, SAM-HQ, SAM 2 or SAM 3."""

    def __init__(self, name: StrPath) -> None:
        """name: a model's folder or a downloaded OWNER/MODEL; SceneError where there is no SAM."""
        self.loaded = load_sam(name, CLASSES)
        self.size = (0, 0)
        self.encoded: dict[str, Any] = {}

    @torch.inference_mode()
    def set_image(self, image: NDArray[np.uint8]) -> None:
        """image: (H, W, 3) uint8 RGB."""
        self.size = image.shape[0], image.shape[1]
        embeddings = self.loaded.model.get_image_embeddings(self.loaded.pixels(image))
        if self.loaded.kind == "sam_hq":
            embeddings, intermediate = embeddings
            self.encoded = {"image_embeddings": embeddings, "intermediate_embeddings": intermediate}
        else:
            self.encoded = {"image_embeddings": embeddings}

    @torch.inference_mode()
    def at_points(self, points: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """points: (k, 2) pixels of the image. Logits (k, 3, h, w) that cover the image, and predicted IoU (k, 3)."""
        preparation, device = self.loaded.preparation, self.loaded.device
        height, width = scaled_size(self.size, preparation)
        scale = np.array([width / self.size[1], height / self.size[0]], np.float32)
        # Prompts are in pixels of the model's square input.
        prompts = torch.from_numpy(points * scale)[None, :, None].to(device)  # (images, prompts, points each, xy)
        labels = torch.ones(prompts.shape[:3], dtype=torch.int32, device=device)  # 1: on the thing
        answer = self.loaded.model(input_points=prompts, input_labels=labels, multimask_output=True, **self.encoded)
        logits = answer.pred_masks[0].float()
        # Without the padding.
        rows = max(1, round(logits.shape[-2] * height / preparation.side))
        columns = max(1, round(logits.shape[-1] * width / preparation.side))
        return logits[..., :rows, :columns].cpu().numpy(), answer.iou_scores[0].float().cpu().numpy()


def scaled_size(size: tuple[int, int], preparation: Preparation) -> tuple[int, int]:
    """(height, width) of the image inside the model's square."""
    if not preparation.padded:
        return preparation.side, preparation.side
    scale = preparation.side / max(size)
    # At least one: the shorter side of a strip rounds to 0, and torch resizes nothing to that.
    return max(1, int(size[0] * scale + 0.5)), max(1, int(size[1] * scale + 0.5))


def prepared(image: NDArray[np.uint8], preparation: Preparation) -> torch.Tensor:
    """(H, W, 3) uint8 RGB -> (1, 3, side, side) float32 as in transformers' own processors: bilinear with
    antialiasing, rounded to 8 bit, scaled to [0, 1], normalized, then padded with 0 to the right and below."""
    pixels = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1)[None].float()
    size = scaled_size((image.shape[0], image.shape[1]), preparation)
    pixels = torch.nn.functional.interpolate(pixels, size, mode="bilinear", align_corners=False, antialias=True)
    pixels = pixels.round().clamp(0, 255) / 255
    mean, std = (torch.tensor(values)[None, :, None, None] for values in (preparation.mean, preparation.std))
    pixels = (pixels - mean) / std
    return torch.nn.functional.pad(pixels, (0, preparation.side - size[1], 0, preparation.side - size[0]))


def _preparation(folder: Path, kind: str, config: Any) -> Preparation:
    """Side from the model's configuration; mean and std from the preprocessor's file if there is one, else those that
    the published models were trained with."""
    sized = config.vision_config if kind in PADDED_MODELS else getattr(config, "prompt_encoder_config", config)
    side = sized.image_size[0] if isinstance(sized.image_size, (list, tuple)) else sized.image_size
    usual = HALF_MEAN_STD if kind.startswith("sam3") else IMAGENET_MEAN_STD
    _, mean, std = read_image_processor(folder, *usual)
    return Preparation(int(side), kind in PADDED_MODELS, mean, std)
