"""LangSplat's ``language_features``: ``<view name>_s.npy`` [4, H, W] of ids, ``<view name>_f.npy`` [M, D] of features.

The four levels are SAM's default, small, medium and large masks. Ids are cumulative: the small level continues
where the default level ended, so an id is a row of the feature file whatever its level; -1 is outside every mask.
OpenGaussian trains on one level, the large one. Tools that make masks of one level may write it as all four.

One level is read. Its rows are compacted (rows that no pixel of the level shows are left out). A view without a mask at
this level stays without masks: other levels never replace it, since the small masks of one view would contradict the
large masks of its neighbors.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.cloud import UNKNOWN_SPACE
from og_pointcloud.errors import SceneError, printable
from og_pointcloud.formats.mask_files import MAX_FEATURE_BYTES, MaskLayer, as_features, require_all, rows_shown
from og_pointcloud.formats.npy import mapped_array, read_npz
from og_pointcloud.formats.poses import read_text

LANGUAGE_FEATURES_FOLDER = "language_features"
LEVELS = ("default", "small", "medium", "large")
SPACE_FILE = "feature_space.txt"
WORDS_FILE = "text_features.npz"
LANGSPLAT_SPACE = "laion/CLIP-ViT-B-16-laion2B-s34B-b88K"
"""The encoder of LangSplat's own scripts, 512-d, unless ``feature_space.txt`` in the folder, or the capture's text
features of the same width, name another."""
LANGSPLAT_WIDTH = 512


def read_language_features(capture: Path, names: Sequence[str], level: str) -> tuple[list[MaskLayer], str]:
    """The masks of these views at one level and the name of their feature space.

    Each id map is read here once, to find the rows that the level uses, and again when its layer is read. SceneError
    where a file is missing, an id has no feature row, or no view has a mask at this level.
    """
    if level not in LEVELS:
        raise SceneError(f"mask level is '{level}'; expected one of {', '.join(LEVELS)}")
    folder = capture / LANGUAGE_FEATURES_FOLDER
    id_files = [folder / f"{name}_s.npy" for name in names]
    feature_files = [folder / f"{name}_f.npy" for name in names]
    cure = "run the mask and feature extraction on all images"
    require_all(id_files, cure)
    require_all(feature_files, cure)
    # Each map is decoded here for the rows that it shows, then freed: hundreds of them would not fit into memory.
    layers = [_layer(ids, features, level) for ids, features in zip(id_files, feature_files, strict=True)]
    empty = [name for name, layer in zip(names, layers, strict=True) if not len(layer.features)]
    if len(empty) == len(names):
        raise SceneError(
            f"{folder}: no view has a mask at level '{level}'; expected masks: choose another of {', '.join(LEVELS)}"
        )
    if empty:
        warnings.warn(
            f"{len(empty)} of {len(names)} views have no mask at level '{level}', e.g. '{printable(empty[0], 80)}'",
            stacklevel=2,
        )
    return layers, _feature_space(capture, layers)


def _layer(id_file: Path, feature_file: Path, level: str) -> MaskLayer:
    ids = _level_ids(id_file, level)
    features = as_features(mapped_array(feature_file), f"{feature_file}:")
    highest = int(ids.max(initial=-1))
    if highest >= len(features):
        raise SceneError(
            f"{id_file}: mask id {highest} of level '{level}' has no feature row ({feature_file.name} has "
            f"{len(features)}): write both files in one run"
        )
    used, row_of_id = rows_shown(ids, len(features))
    height, width = ids.shape
    return MaskLayer((width, height), features[used], partial(_rows, id_file, level, row_of_id))


def _rows(id_file: Path, level: str, row_of_id: NDArray[np.int32]) -> NDArray[np.int32]:
    """(H, W): each pixel's index among the rows that the level uses, -1 outside every mask."""
    return row_of_id[_level_ids(id_file, level)]


def _level_ids(file: Path, level: str) -> NDArray[np.int32]:
    """(H, W) int32, cumulative ids of one level, -1 for none; the other levels' bytes are not read."""
    levels = mapped_array(file)
    if levels.ndim != 3 or len(levels) != len(LEVELS) or levels.dtype.kind not in "iuf":
        raise SceneError(
            f"{file} is {levels.dtype} {levels.shape}; expected numbers (4, height, width), one map per level: "
            f"{', '.join(LEVELS)}"
        )
    index = LEVELS.index(level)
    stored = np.asarray(levels[index])
    with np.errstate(invalid="ignore"):
        ids = stored.astype(np.int32)
    if (ids != stored).any():
        raise SceneError(f"{file}: level '{level}' has values that are not ids; expected whole numbers, -1 for none")
    # Id 0 is the first mask of the first level that has any. Equal levels share their rows.
    others = [other for other in levels[:index] if (other >= 0).any()] if (ids == 0).any() else []
    if not all(np.array_equal(other, stored) for other in others):
        raise SceneError(
            f"{file}: the ids of level '{level}' start at 0 again; expected ids that continue from level to level, as "
            "LangSplat writes them, so that an id is a row of the features"
        )
    return np.maximum(ids, -1)


def _feature_space(capture: Path, layers: Sequence[MaskLayer]) -> str:
    file, words = capture / LANGUAGE_FEATURES_FOLDER / SPACE_FILE, capture / WORDS_FILE
    if file.is_file():
        return read_text(file).strip() or UNKNOWN_SPACE
    width = next(layer.features.shape[1] for layer in layers if len(layer.features))
    if words.is_file():
        stated = read_npz(words, ("vectors",), ("feature_space",), MAX_FEATURE_BYTES, "text features with 'vectors'")
        if stated["vectors"].ndim == 2 and stated["vectors"].shape[1] == width and "feature_space" in stated:
            return str(stated["feature_space"])
    return LANGSPLAT_SPACE if width == LANGSPLAT_WIDTH else UNKNOWN_SPACE
