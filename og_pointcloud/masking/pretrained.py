"""A transformers folder -> its model; only numbers are taken from the folder.

Its config.json must name an accepted type, whose class comes from transformers: code in the folder (auto_map) is
ignored. Weights are read from .safetensors only, as other files are pickles; nothing is downloaded.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from og_pointcloud.errors import SceneError, first_line, naming_extra
from og_pointcloud.formats.poses import read_json_object
from og_pointcloud.masking.crops import Color

with naming_extra("torch and transformers", "masks"):
    import torch
    import transformers

Attention = Literal["eager", "sdpa"]


def load_pretrained(folder: Path, classes: Mapping[str, str], attention: Attention = "sdpa") -> tuple[Any, str]:
    """The model in float32, in evaluation mode, and its model_type.

    classes: model_type -> class of transformers. attention: how transformers computes it; "eager" is plain matrix
    products, which exports well.
    SceneError where the folder has none of these types, or its weights are incomplete.
    """
    kind = _model_type(folder, classes)
    try:
        model, report = getattr(transformers, classes[kind]).from_pretrained(
            folder, local_files_only=True, trust_remote_code=False, use_safetensors=True,
            attn_implementation=attention, dtype=torch.float32, output_loading_info=True,
        )  # fmt: skip
    except Exception as error:  # many types, some of safetensors' own
        raise SceneError(
            f"{folder} cannot be read ({type(error).__name__}: {first_line(error)}); expected a complete "
            f"{classes[kind]} with weights in .safetensors: fetch it again, or save it again with save_pretrained"
        ) from None
    if missing := sorted(report["missing_keys"]):
        raise SceneError(
            f"{folder} lacks {len(missing)} of the weights of a {classes[kind]}, such as '{missing[0]}': give a folder "
            "with the complete model"
        )
    return model.eval(), kind


def best_device() -> torch.device:
    """A GPU where torch has one."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def read_config(folder: Path, *names: str) -> dict[str, Any]:
    """The first of these JSON files that a folder has, empty if it has none. SceneError if it holds no object."""
    file = next((folder / name for name in names if (folder / name).is_file()), None)
    return {} if file is None else read_json_object(file)


def read_image_processor(folder: Path, mean: Color, std: Color) -> tuple[dict[str, Any], Color, Color]:
    """What a folder states of its image processor, and mean and standard deviation of RGB in [0, 1]. mean, std: of the
    published models, where the folder states none. SceneError where it states something else."""
    stated = read_config(folder, "preprocessor_config.json", "processor_config.json")
    stated = stated.get("image_processor", stated)
    try:
        colors = np.array([stated.get("image_mean", mean), stated.get("image_std", std)], np.float64)
    except (AttributeError, TypeError, ValueError):
        colors = np.empty(0)
    if colors.shape != (2, 3) or not (np.isfinite(colors).all() and (colors[1] > 0).all()):
        raise SceneError(
            f"{folder}: image_mean or image_std of its image processor cannot be used; expected three finite numbers "
            "each, deviations above 0: fetch the model again"
        )
    found: Any = map(tuple, colors.tolist())
    return stated, *found


def _model_type(folder: Path, classes: Mapping[str, str]) -> str:
    if not (folder / "config.json").is_file():
        raise SceneError(
            f"{folder} is not a transformers folder: it has no config.json; expected a model folder (for an OpenCLIP "
            "model, fetch the repository that has it for transformers)"
        )
    config = read_config(folder, "config.json")
    kind = str(config.get("model_type"))
    if kind not in classes or not hasattr(transformers, classes[kind]):
        raise SceneError(
            f"{folder}: model_type is {kind!r:.40}; expected one of {', '.join(classes)} that the installed "
            f"transformers {transformers.__version__} has"
        )
    if "quantization_config" in config:
        raise SceneError(f"{folder} is quantized; expected float32 or float16: only such weights are read")
    return kind
