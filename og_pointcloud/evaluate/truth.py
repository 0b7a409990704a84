"""A capture's own ground truth: ``gt.npz`` beside its cloud. Only scores read it, never a fit."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.evaluate.metrics import Score, score_labels
from og_pointcloud.formats.npy import read_npz

GT_NAME = "gt.npz"
MAX_UNPACKED_BYTES = 1 << 31
POINT_ARRAYS = ("background", "views", "ratio", "votes", "instance")
"""Optional arrays of gt.npz, one value per point."""
MIN_VOTE_SHARE, MIN_VOTES = 0.5, 2
"""Where classes were found by votes: smallest share of votes that must agree on a class, and smallest number."""


@dataclass(frozen=True)
class Truth:
    """cls: (n,) int, class of each point, an index into ``names``, -1 none. scored: (n,) bool, whether its truth is
    reliable. background: (n,) bool, known to be of no class; None if unknown. instance: (n,) int, the thing that a
    point is part of, below 0 none; None if unknown."""

    cls: NDArray[np.integer]
    names: tuple[str, ...]
    scored: NDArray[np.bool_]
    background: NDArray[np.bool_] | None
    instance: NDArray[np.integer] | None = None

    def class_of(self, labels: NDArray[np.integer], words: Sequence[str]) -> NDArray[np.int64]:
        """(n,) classes of labels that index ``words``, -1 unknown; a word that the truth lacks is a wrong answer.

        >>> truth = Truth(np.array([0, 1]), ("cup", "pot"), np.array([True, True]), None)
        >>> truth.class_of(np.array([0, 1, -1]), ["pot", "lamp"]).tolist()
        [1, 2, -1]
        """
        numbers = {name: number for number, name in enumerate(self.names)}
        number = np.array([*(numbers.get(word, len(numbers)) for word in words), -1])
        return number[np.maximum(labels, -1)]

    def score(self, called: NDArray[np.integer]) -> Score:
        """The score of the classes (n,) given to points, as `class_of` returns them; SceneError for another length."""
        if len(called) != len(self.cls):
            raise SceneError(f"{len(called)} labels for {len(self.cls)} points of {GT_NAME}; expected one per point")
        return score_labels(called, self.cls, scored=self.scored, background=self.background)


def read_truth(folder: str | os.PathLike[str]) -> Truth:
    """A capture's ``gt.npz``: ``cls`` (n,), ``names``, and optionally ``instance``, ``background``, ``views``,
    ``ratio``, ``votes``.

    Points that no view shows (views 0), or whose class has less than half of the votes or only a single one, are not
    scored. Raises SceneError where the file is absent, damaged, or lacks what is needed.
    """
    path = Path(folder) / GT_NAME
    if not path.is_file():
        raise SceneError(
            f"{path} is not a file; a score needs it: 'cls' (n,), a class per point, -1 for none, and 'names'. "
            "Without one, use the demo room: og-pointcloud demo"
        )
    entries = read_npz(path, ("cls", "names"), POINT_ARRAYS, MAX_UNPACKED_BYTES, "'cls' (n,) and 'names' (L,)")
    cls, names = entries["cls"], entries["names"]
    is_listed = cls.ndim == 1 and cls.dtype.kind in "iu" and names.ndim == 1 and names.dtype.kind == "U"
    highest = int(cls.max()) if is_listed and cls.size else -1
    if not is_listed or highest >= len(names):
        reach = f" up to {highest}" if is_listed else ""
        raise SceneError(
            f"{path}: cls is {cls.dtype} {cls.shape}{reach}, names {names.dtype} {names.shape}; expected whole "
            "numbers (n,) that index the names, and strings (L,)"
        )
    if len(set(names.tolist())) < len(names):
        raise SceneError(f"{path}: a name occurs twice in names; expected each class once: merge the two classes")
    cls = cls.astype(np.int64)  # of unsigned numbers, -1 is not one
    for name in POINT_ARRAYS:
        if name in entries and entries[name].shape != cls.shape:
            raise SceneError(f"{path}: {name} has shape {entries[name].shape}, cls {cls.shape}; expected one per point")
    instance = entries.get("instance")
    if instance is not None and instance.dtype.kind not in "iu":
        raise SceneError(f"{path}: instance is {instance.dtype}; expected whole numbers, below 0 for none")
    instance = None if instance is None else instance.astype(np.int64)
    scored = np.ones(len(cls), bool)
    # A file may state how each point got its class: by votes of labelled images, which may be few or divided.
    if "views" in entries:
        scored &= entries["views"] > 0
    if "ratio" in entries and "votes" in entries:
        scored &= (entries["ratio"] >= MIN_VOTE_SHARE) & (entries["votes"] >= MIN_VOTES)
    background = entries["background"].astype(bool) if "background" in entries else None
    return Truth(cls, tuple(names.tolist()), scored, background, instance)
