"""ScanNet point segmentation as in OpenGaussian's table: NYU40 classes of ``*_vh_clean_2.labels.ply``.

Rules. A task is 19, 15 or 10 classes, queried by their bare names. Points of other classes, and points whose Gaussian
has an opacity below 0.1, are ignored: neither they nor predictions on them count anywhere. IoU and recall are computed
per class over one scene and averaged over the classes *present in that scene*, then over scenes (macro mean).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.ask.choosing import Chooser
from og_pointcloud.ask.labelled_scene import as_scene, segment
from og_pointcloud.errors import SceneError
from og_pointcloud.evaluate.metrics import Score, score_labels
from og_pointcloud.formats.ply import read_ply
from og_pointcloud.formats.tables import positions

NAMES: Mapping[int, str] = {
    1: "wall", 2: "floor", 3: "cabinet", 4: "bed", 5: "chair", 6: "sofa", 7: "table", 8: "door", 9: "window",
    10: "bookshelf", 11: "picture", 12: "counter", 14: "desk", 16: "curtain", 24: "refrigerator",
    28: "shower curtain", 33: "toilet", 34: "sink", 36: "bathtub",
}  # fmt: skip
"""NYU40 ids and names of the 19 classes."""
TASKS: Mapping[int, tuple[int, ...]] = {
    19: tuple(NAMES),
    15: (1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 12, 14, 16, 33, 34),
    10: (1, 2, 4, 5, 6, 7, 8, 9, 10, 33),
}
"""NYU40 ids of each task, by its number of classes."""
SCENES = tuple(f"scene{number:04}_00" for number in (0, 62, 70, 97, 140, 200, 347, 400, 590, 645))
"""The ten scenes of the table."""
MIN_OPACITY = 0.1
"""Points of fainter Gaussians are ignored (see above)."""
MAX_NYU40_ID = 40
STRAY_IDS = (50, 149)
"""Of no class, in three scenes of ScanNet v2 (scene0270_00, scene0270_02, scene0384_00)."""


def read_truth(file: str | Path) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """xyz (n, 3) and NYU40 ids (n,), 0 unlabelled, of a ``*.labels.ply``. SceneError names file and cure."""
    elements = read_ply(Path(file))
    vertices = elements.get("vertex")
    if vertices is None or "label" not in (vertices.dtype.names or ()):
        raise SceneError(f"{file} has no vertices with a property 'label'; expected ScanNet's *_vh_clean_2.labels.ply")
    labels = vertices["label"].astype(np.int64)
    labels[np.isin(labels, STRAY_IDS)] = 0
    if len(labels) and not 0 <= labels.min() <= labels.max() <= MAX_NYU40_ID:
        raise SceneError(
            f"{file}: labels span {labels.min()}..{labels.max()}; expected NYU40 ids 0..{MAX_NYU40_ID}: take the "
            "labels of ScanNet v2, not those of ScanNet200"
        )
    return positions(vertices), labels.astype(np.int32)


def ask(
    file: Path, xyz: NDArray[np.float64], task: int, text_features: Path | None = None
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(n,) NYU40 ids that a .ogpc file gives a scene's vertices, 0 unknown; and the ids if every instance with a
    feature takes its best class, however badly it fits. xyz: (n, 3) world coordinates. task: 19, 15 or 10."""
    scene, ids = as_scene(file), np.array([*TASKS[task], 0])  # label -1 takes the last: unknown
    names = [NAMES[class_id] for class_id in TASKS[task]]
    words = scene.words(names, text_features)
    result = segment(xyz, words, scene=scene)
    forced = Chooser(scene.cloud.instances).choose(words.vectors).at(result.instances)[0]  # without bank: best cosine
    return ids[np.maximum(result.labels, -1)], ids[np.maximum(forced, -1)]


def score_scene(
    predicted: NDArray[np.integer], truth: NDArray[np.integer], task: int, opacity: NDArray[np.floating] | None = None
) -> Score:
    """Score one scene; class ids are NYU40's. NaN where no point belongs to the task.

    predicted: (n,) NYU40 ids, below 1 for unknown; an id outside the task is a wrong answer. truth: (n,) NYU40 ids.
    task: 19, 15 or 10. opacity: (n,) of each point's Gaussian; None counts all points.
    """
    of_task = np.where(np.isin(truth, TASKS[task]), truth, -1)
    opaque = np.ones(truth.shape, bool) if opacity is None else opacity >= MIN_OPACITY
    return score_labels(np.where(predicted > 0, predicted, -1), of_task, scored=opaque, min_points=1)
