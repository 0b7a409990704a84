"""A name or a folder -> a mask encoder."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, cast

from og_pointcloud.errors import FeatureSpaceError, OgPointcloudError
from og_pointcloud.masking.contracts import MaskEncoder
from og_pointcloud.masking.crops import CROP_STYLES, WITH_CONTEXT, Crop
from og_pointcloud.masking.encoders.mask_encoder import CropEncoder, DenseModel, ImageModel, PatchEncoder
from og_pointcloud.masking.encoders.onnx_model import OnnxModel, said_space
from og_pointcloud.text.encoder import MODELS_VARIABLE, model_folders

if TYPE_CHECKING:
    from og_pointcloud_export.text_weights import Activation

__all__ = ["DEMO_FOLDER", "DEMO_SPACE", "open_encoder"]

DEMO_SPACE = "og_pointcloud/demo-room-encoder"
"""Feature space of the demo encoder, which knows the procedural room's things and nothing else of the world."""
DEMO_FOLDER = Path(__file__).parents[1] / "demo_encoder"
"""Its two halves: ``image`` and ``text``."""


def open_encoder(
    name: str | os.PathLike[str],
    feature_space: str | None = None,
    *,
    crops: str | Sequence[Crop] | None = None,
    dense: bool = False,
    seconds_per_image: float | None = None,
    activation: Activation | None = None,
) -> MaskEncoder:
    """Open an encoder; nothing is downloaded.

    name: "demo"; a folder that export-image-encoder wrote; a transformers CLIP or SigLIP folder, an OpenCLIP folder, or
        a file of weights with OpenAI's or OpenCLIP's names (.safetensors, weights-only .pt), which need torch; or
        OWNER/MODEL, looked for in the folders of OG_POINTCLOUD_MODELS, in the user's cache, and among what Hugging
        Face's own tools have fetched.
    feature_space: the one that is expected, as the text encoder and the capture name it; of weights that do not say
        their name, the one that they have.
    crops: "langsplat", "context", or ways to cut masks out; None: what the encoder was made with, else "context".
    dense: pool the image's patches in the masks, one run an image; only for weights, not for exports.
    seconds_per_image: see `CropEncoder`. activation: of weights that do not say; see export-image-encoder.
    Raises OgPointcloudError where there is no such encoder, FeatureSpaceError for one of another space.
    """
    model = _open_model(name, feature_space, activation)
    if feature_space is not None and model.feature_space != feature_space:
        raise FeatureSpaceError(
            f"{name} encodes to feature space '{model.feature_space}'; expected '{feature_space}': words and masks are "
            "compared in one space only, so name the encoder of that one"
        )
    if dense:
        return PatchEncoder(_as_dense(model, name))
    return CropEncoder(model, _crops(crops, model), seconds_per_image=seconds_per_image)


def _open_model(name: str | os.PathLike[str], feature_space: str | None, activation: Activation | None) -> ImageModel:
    if name == "demo":
        return OnnxModel(DEMO_FOLDER / "image")
    path = Path(name).expanduser()
    if path.exists():
        if said_space(path) is not None:
            return OnnxModel(path)
        return _torch_model(path, feature_space, activation)
    exported = next((folder for folder in _image_encoders() if said_space(folder) == str(name)), None)
    if exported is not None:
        return OnnxModel(exported)
    fetched = _fetched(str(name))
    if fetched is not None:
        return _torch_model(fetched, feature_space or str(name), activation)
    named = os.environ.get(MODELS_VARIABLE)
    raise OgPointcloudError(
        f"no encoder '{name}': it is no folder, none of that feature space is in {MODELS_VARIABLE} "
        f"({named or 'not set'}) or the cache, and it has not been fetched; expected 'demo', a model's folder or "
        f"OWNER/MODEL: fetch it first (hf download {name}), or name its folder"
    )


def _torch_model(path: Path, feature_space: str | None, activation: Activation | None) -> ImageModel:
    from og_pointcloud_export.image_encoder import open_tower

    return open_tower(path, feature_space, activation)


def _image_encoders() -> Iterator[Path]:
    for folder in model_folders():
        if folder.is_dir():
            yield folder
            yield from sorted(path for path in folder.iterdir() if path.is_dir())


def _fetched(name: str) -> Path | None:
    """Where Hugging Face's tools keep a model that they have fetched; they are asked only for what is on the disk."""
    if name.count("/") != 1:
        return None
    try:
        from huggingface_hub import try_to_load_from_cache
    except ImportError:
        return None
    for config in ("config.json", "open_clip_config.json"):
        found = try_to_load_from_cache(name, config)
        if isinstance(found, str):
            return Path(found).parent
    return None


def _crops(crops: str | Sequence[Crop] | None, model: ImageModel) -> Sequence[Crop]:
    if crops is None:
        return model.crops if isinstance(model, OnnxModel) else WITH_CONTEXT
    if not isinstance(crops, str):
        return crops
    if crops not in CROP_STYLES:
        raise OgPointcloudError(f"crops '{crops}' are unknown; expected {' or '.join(CROP_STYLES)}")
    return CROP_STYLES[crops]


def _as_dense(model: ImageModel, name: str | os.PathLike[str]) -> DenseModel:
    if not hasattr(model, "patches"):
        raise OgPointcloudError(
            f"{name} is an export, which gives no patches; expected the model's own folder for dense"
        )
    return cast("DenseModel", model)
