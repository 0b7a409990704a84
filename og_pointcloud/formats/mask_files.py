"""The project's own mask format: ``masks/<view name>.png`` and ``mask_features.npz``.

A mask image is gray, 8 or 16 bit, or has a palette, whose colors are ignored. It holds 0 outside every mask, else an id
1..M, valid in this image only. The features file holds ``<view name>`` -> (M, D), any float type, where row i belongs
to id i + 1, and ``feature_space``, the name of the encoder. A view without masks has an all-zero image and an empty
(0, D) array. For tracked masks it holds ``<view name>.tracks`` -> (M,) integers: one number per tracked thing, the same
in all views, -1 unknown.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.cloud import UNKNOWN_SPACE
from og_pointcloud.errors import SceneError, printable
from og_pointcloud.formats.images import PngHeader, decoded, palette_indices, png_header, require_cv2
from og_pointcloud.formats.npy import read_npz
from og_pointcloud.formats.poses import read_json_object
from og_pointcloud.scene import NOT_SEEN, CutMasks, FloatArray, IntArray

MASKS_FOLDER = "masks"
FEATURES_NAME = "mask_features.npz"
MADE_NAME = "made.json"
"""The record of the run of `og-pointcloud masks` that made the masks, in their folder."""
TRACKS = ".tracks"
MAX_FEATURE_BYTES = 1 << 32
GRAY, PALETTE = 0, 3
PNG_COLOR_TYPES = {0: "gray", 2: "RGB (3 channels)", 3: "palette", 4: "gray with alpha", 6: "RGBA (4 channels)"}


@dataclass(frozen=True)
class MaskLayer:
    """One view's masks, before they are paired with a camera.

    size: (width, height) of the mask map. features: (M, D) float32. tracks: as `View.mask_tracks`.
    read: returns the map, (height, width) int32, -1 outside every mask, else a row of ``features``.
    cut_from: as in `View`.
    """

    size: tuple[int, int]
    features: FloatArray
    read: Callable[[], IntArray]
    tracks: NDArray[np.integer] | None = None
    cut_from: CutMasks | None = None


def read_masks(capture: Path, names: Sequence[str]) -> tuple[list[MaskLayer], str]:
    """The masks of these views and the name of their feature space (``unknown`` where the file names none).

    Features and image headers are read; each image is decoded when its layer's ``read`` is called. Raises
    SceneError where a view has no mask image or no features, or an image is not gray.
    """
    files = [capture / MASKS_FOLDER / f"{name}.png" for name in names]
    require_all(files, "write an all-zero mask and an empty (0, D) feature array for an image without masks")
    features, tracks, feature_space = _read_features(capture / FEATURES_NAME, names)
    headers = map(_id_header, files)
    layers = [
        MaskLayer((header.width, header.height), features[name], partial(read_ids, file), tracks.get(name))
        for name, file, header in zip(names, files, headers, strict=True)
    ]
    return layers, feature_space


def made_of_some(capture: Path) -> bool:
    """Whether the record beside a capture's masks says that they were made for every n-th image only."""
    try:
        return read_json_object(capture / MASKS_FOLDER / MADE_NAME).get("every", 1) != 1
    except SceneError:  # masks made by other tools have none
        return False


def require_all(files: Sequence[Path], cure: str) -> None:
    """Raise one SceneError for all missing mask files: their number, the first three, and the cure."""
    missing = [file for file in files if not os.path.isfile(file)]  # Path.is_file fails for names that are too long
    if missing:  # one error for all: a capture may lack hundreds
        folder = missing[0].parents[0]
        names = ", ".join(printable(file.name, 80) for file in missing[:3]) + (", ..." if len(missing) > 3 else "")
        raise SceneError(
            f"{len(missing)} of {len(files)} posed images have no mask: {folder} lacks {names}; expected one per "
            f"image: {cure}, or remove the image from the pose file"
        )


def _id_header(file: Path) -> PngHeader:
    header = png_header(file)
    is_gray = header is not None and header.color_type == GRAY and header.bit_depth in (8, 16)
    if header is None or not (is_gray or header.color_type == PALETTE):
        found = f"a PNG, {header.bit_depth}-bit {PNG_COLOR_TYPES.get(header.color_type)}" if header else "not a PNG"
        raise SceneError(
            f"{file} is {found}; expected an 8-bit or 16-bit gray PNG, or one with a palette, whose values are mask "
            "ids (0 none, 1..M): write ids instead of colors"
        )
    return header


def read_ids(file: Path) -> IntArray:
    """A mask image, (H, W) int32: -1 outside every mask, else the feature row (the stored id less 1)."""
    has_palette = _id_header(file).color_type == PALETTE  # OpenCV would return colors instead of ids
    ids = palette_indices(file) if has_palette else decoded(file, require_cv2().IMREAD_UNCHANGED)
    if ids.ndim != 2:
        raise SceneError(f"{file} has shape {ids.shape}; expected one channel of mask ids")
    return ids.astype(np.int32) - 1


def _read_features(file: Path, names: Sequence[str]) -> tuple[dict[str, FloatArray], dict[str, NDArray[Any]], str]:
    """Features and tracks by view name, and the name of the feature space."""
    of_tracks = {name + TRACKS: name for name in names}
    expected = "an array (masks, D) under each image's stem"
    arrays = read_npz(file, names, [*of_tracks, "feature_space"], MAX_FEATURE_BYTES, expected)
    features = {name: as_features(arrays[name], f"{file}, '{name}':") for name in names}
    tracks = {name: arrays[key] for key, name in of_tracks.items() if key in arrays}
    return features, tracks, str(arrays.get("feature_space", UNKNOWN_SPACE))


def rows_shown(ids: IntArray, count: int) -> tuple[NDArray[np.intp], IntArray]:
    """(u,) the rows of ``count`` features that an id map shows, ascending; and (count + 2,) the position of each row
    among these, indexed by ids: -1 for unused rows; ids -1 and NOT_SEEN, the last two entries, map to themselves."""
    used = np.flatnonzero(np.bincount(ids[ids >= 0], minlength=1))
    place = np.full(count + 2, -1, np.int32)
    place[NOT_SEEN] = NOT_SEEN
    place[used] = np.arange(len(used), dtype=np.int32)
    return used, place


def as_features(values: NDArray[Any], source: str) -> FloatArray:
    """(masks, width) float32 features from a file. Values beyond float32 become infinite, which the scene reports by
    mask. SceneError, which begins with ``source``, for anything but floats of that shape."""
    if values.size == 0:
        return np.zeros((0, values.shape[-1] if values.ndim == 2 else 0), np.float32)
    if values.ndim != 2 or not np.issubdtype(values.dtype, np.floating):
        raise SceneError(
            f"{source} features are {values.dtype} {values.shape}; expected floats of shape (masks, dimension)"
        )
    with np.errstate(over="ignore"):
        return values.astype(np.float32)
