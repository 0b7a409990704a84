"""SAM, SAM-HQ, SAM 2 and SAM 3 through transformers, without its image processors and without torchvision.

What the processors would do is a few lines (`prepared`), with the numbers of the model's ``preprocessor_config.json``:
SAM and SAM-HQ scale the longer side and pad, SAM 2 and 3 scale both sides to a square. SAM 3's points are answered by
its tracker half; its words are in ``sam3``.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import MissingExtraError, SceneError, first_line
from og_pointcloud.masking.automatic import AutomaticMasks

try:
    import torch
    import transformers
except ImportError as error:
    raise MissingExtraError("torch and transformers", "masks") from error

Tensor = torch.Tensor

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
"""config.json's model_type -> the class that answers points."""
PADDED = ("sam", "sam_hq")
IMAGENET = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
HALVES = (0.5, 0.5, 0.5), (0.5, 0.5, 0.5)


@dataclass(frozen=True)
class Preparation:
    """side: pixels of the square that the model takes. padded: the longer side is scaled to it and the rest is 0;
    else both sides are scaled. mean, std: of channels in [0, 1]."""

    side: int
    padded: bool
    mean: tuple[float, ...]
    std: tuple[float, ...]


def open_sam(name: str | os.PathLike[str]) -> AutomaticMasks:
    """A proposer from a model's folder or a fetched OWNER/MODEL; SceneError where there is none of SAM's kinds."""
    return AutomaticMasks(SamPredictor(name), f"sam:{name}")


@dataclass(frozen=True)
class LoadedModel:
    """kind: its model_type. where: its folder, or OWNER/MODEL. device: a GPU where torch has one."""

    model: Any
    kind: str
    where: str
    device: torch.device
    preparation: Preparation


def load_sam(name: str | os.PathLike[str], classes: Mapping[str, str]) -> LoadedModel:
    """A model's folder or a fetched OWNER/MODEL, for evaluation. classes: model_type -> transformers' class to take.

    SceneError where there is none of these types, or it cannot be read.
    """
    where = str(Path(name).expanduser()) if Path(name).expanduser().is_dir() else str(name)
    try:
        kind = _known_type(name, _read_json(where, "config.json"), classes)
        # A known type is a class of transformers: no code of the folder's (auto_map) is looked at.
        # Weights are read from .safetensors alone: other files are pickles.
        model: Any = getattr(transformers, classes[kind]).from_pretrained(
            where, local_files_only=True, trust_remote_code=False, attn_implementation="sdpa", use_safetensors=True
        )
    except SceneError:
        raise
    except Exception as error:  # of many types, some of safetensors' own
        raise SceneError(
            f"no SAM model '{name}' ({first_line(error):.120}); expected a transformers folder with "
            "config.json and weights, or a fetched model: hf download OWNER/MODEL"
        ) from None
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    return LoadedModel(model.eval().to(device), kind, where, device, _preparation(where, kind, model.config))


class SamPredictor:
    """A `PointPredictor` on any of the four."""

    def __init__(self, name: str | os.PathLike[str]) -> None:
        loaded = load_sam(name, CLASSES)
        self.model, self.kind, self.device = loaded.model, loaded.kind, loaded.device
        self.preparation = loaded.preparation
        self.size = (0, 0)
        self.encoded: dict[str, Any] = {}

    @torch.inference_mode()
    def set_image(self, image: NDArray[np.uint8]) -> None:
        """image: (H, W, 3) uint8 RGB."""
        self.size = image.shape[0], image.shape[1]
        pixels = prepared(image, self.preparation).to(self.device)
        if self.kind == "sam_hq":
            embeddings, intermediate = self.model.get_image_embeddings(pixels)
            self.encoded = {"image_embeddings": embeddings, "intermediate_embeddings": intermediate}
        else:
            self.encoded = {"image_embeddings": self.model.get_image_embeddings(pixels)}

    @torch.inference_mode()
    def at_points(self, points: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """points: (k, 2) pixels of the image. Logits (k, 3, h, w) that cover the image, and predicted IoU (k, 3)."""
        height, width = scaled_size(self.size, self.preparation)
        scale = np.array([width / self.size[1], height / self.size[0]], np.float32)
        asked = torch.from_numpy(points * scale)[None, :, None].to(self.device)
        labels = torch.ones(asked.shape[:3], dtype=torch.int32, device=self.device)
        answer = self.model(input_points=asked, input_labels=labels, multimask_output=True, **self.encoded)
        logits = answer.pred_masks[0].float()
        rows = max(1, round(logits.shape[-2] * height / self.preparation.side))
        columns = max(1, round(logits.shape[-1] * width / self.preparation.side))
        return logits[..., :rows, :columns].cpu().numpy(), answer.iou_scores[0].float().cpu().numpy()


def scaled_size(size: tuple[int, int], preparation: Preparation) -> tuple[int, int]:
    """(height, width) of the image inside the model's square."""
    if not preparation.padded:
        return preparation.side, preparation.side
    scale = preparation.side / max(size)
    return int(size[0] * scale + 0.5), int(size[1] * scale + 0.5)


def prepared(image: NDArray[np.uint8], preparation: Preparation) -> Tensor:
    """(H, W, 3) uint8 RGB -> (1, 3, side, side) float32 as transformers' own processors make it: bilinear with
    antialiasing, rounded to 8 bit, scaled to [0, 1], normalised, then padded with 0 to the right and below."""
    pixels = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1)[None].float()
    size = scaled_size((image.shape[0], image.shape[1]), preparation)
    pixels = torch.nn.functional.interpolate(pixels, size, mode="bilinear", align_corners=False, antialias=True)
    pixels = pixels.round().clamp(0, 255) / 255
    mean, std = (torch.tensor(values)[None, :, None, None] for values in (preparation.mean, preparation.std))
    pixels = (pixels - mean) / std
    return torch.nn.functional.pad(pixels, (0, preparation.side - size[1], 0, preparation.side - size[0]))


def _known_type(name: str | os.PathLike[str], config: dict[str, Any] | None, classes: Mapping[str, str]) -> str:
    """The model_type of a config.json, if it is one of ``classes``."""
    if config is None:
        raise OSError("there is no config.json")
    kind = str(config.get("model_type"))
    if "quantization_config" in config:
        raise SceneError(f"{name} is quantised; expected a model in float32 or float16, whose weights alone are read")
    if kind not in classes or not hasattr(transformers, classes[kind]):
        raise SceneError(
            f"{name} is a model of type '{kind:.40}'; expected one of {', '.join(classes)} that the installed "
            f"transformers {transformers.__version__} has"
        )
    return kind


def _preparation(where: str, kind: str, config: Any) -> Preparation:
    """Side from the vision configuration, colours from the preprocessor's file where the model has one."""
    side = config.vision_config.image_size if kind in PADDED else _square_side(config)
    mean, std = HALVES if kind.startswith("sam3") else IMAGENET
    stated = _read_json(where, "preprocessor_config.json")
    stated = stated or _read_json(where, "processor_config.json") or {}
    stated = stated.get("image_processor", stated)
    mean, std = stated.get("image_mean", mean), stated.get("image_std", std)
    return Preparation(int(side), kind in PADDED, tuple(map(float, mean)), tuple(map(float, std)))


def _square_side(config: Any) -> int:
    side = getattr(config, "prompt_encoder_config", config).image_size
    return int(side[0] if isinstance(side, (list, tuple)) else side)


def file_of(where: str, name: str) -> Path | None:
    """A file of a model's folder, or of a fetched model; None where it has none."""
    from transformers.utils.hub import cached_file

    file = cached_file(
        where, name, local_files_only=True, _raise_exceptions_for_missing_entries=False,
        _raise_exceptions_for_connection_errors=False,
    )  # fmt: skip
    return None if file is None else Path(file)


def _read_json(where: str, name: str) -> dict[str, Any] | None:
    """A JSON file of the model, None where it has none. ValueError where it is not a JSON object."""
    file = file_of(where, name)
    content = json.loads(file.read_text(encoding="utf-8")) if file is not None else None
    if content is not None and not isinstance(content, dict):
        raise ValueError(f"{name} holds no JSON object")
    return content
