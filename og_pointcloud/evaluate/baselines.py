"""Other ways from masks to labelled points, on the same mask table: what the whole method is worth beside them.

Each takes what the shared stages have prepared, and vectors of words (L, D); it returns a word for each point of the
surface, (n,) int, -1 where it has none. None of them knows background: every point that a mask's rays reach gets a
word. `only_where_masked` is the plain remedy, reported beside each: points that views show mostly outside of masks get
none.

    direct uplift      every point the mean feature of the masks that show it, by blending weight
    center sampling    the feature of the mask at the pixel of its center, mean over views by how visible it is there
                       (the idea of Occam's LGS)
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from og_pointcloud.cloud import unit_rows
from og_pointcloud.fitting.fit import Prepared
from og_pointcloud.fitting.photographs import Photographs

MIN_MASKED_SHARE = 0.5
"""Share of a point's visible weight that must lie in masks, or it belongs to none."""

Words = NDArray[np.floating]
Labels = NDArray[np.integer]
Baseline = Callable[[Prepared, Words], Labels]


def direct_uplift(prepared: Prepared, words: Words) -> Labels:
    """Each point takes the word nearest to the mean feature of the masks that show it."""
    return uplift(prepared.table.weights, prepared.table.unit_features, words)


def center_sampling(prepared: Prepared, words: Words) -> Labels:
    """Each point takes the word nearest to the mean of the mask features at its center's pixel, by exposure."""
    table, views = prepared.table, prepared.surface.scene.views
    xyz = prepared.surface.gaussians.xyz
    photographs = Photographs.of(views)
    first = np.concatenate([[0], np.cumsum([view.mask_count for view in views])])
    similarity = table.unit_features @ unit_rows(words.astype(np.float64)).T
    scores, reached = np.zeros((len(xyz), len(words))), np.zeros(len(xyz), bool)
    for index, view in enumerate(views):
        # Visibility is kept by photograph, of which this view may be a part.
        exposure = csr_array(table.exposure[[photographs.of_view[index]]])
        points, visible = exposure.indices, exposure.data
        uv_px, _ = view.camera.project(xyz[points])
        inside = view.camera.shows(uv_px)
        column, row = np.floor(uv_px[inside]).astype(int).T
        mask = np.full(len(points), -1)
        mask[inside] = view.mask_map()[row, column]
        shown = mask >= 0
        # A mask of a cut view is part of one of the photograph, which has the row in the table.
        scores[points[shown]] += visible[shown, None] * similarity[photographs.of_mask[first[index] + mask[shown]]]
        reached[points[shown]] = True
    return np.where(reached, scores.argmax(axis=1), -1)


BASELINES: dict[str, Baseline] = {"direct uplift": direct_uplift, "center sampling": center_sampling}


def baseline_labels(prepared: Prepared, words: Words) -> Iterator[tuple[str, Labels, float]]:
    """Every method, as it is and where masked: its name, the words of all points of the scene, and its seconds."""
    for name, method in BASELINES.items():
        start = time.perf_counter()
        labels = method(prepared, words)
        seconds = time.perf_counter() - start
        for value, found in ((name, labels), (f"{name}, where masked", only_where_masked(labels, prepared))):
            yield value, prepared.surface.of_points(found), seconds


def only_where_masked(labels: Labels, prepared: Prepared) -> Labels:
    """The labels, -1 for points that have at most MIN_MASKED_SHARE of their visible weight in masks."""
    table = prepared.table
    inside, outside = (np.asarray(part.sum(axis=0), np.float64).ravel() for part in (table.weights, table.outside))
    return np.where(inside > MIN_MASKED_SHARE * (inside + outside), labels, -1)


def uplift(weights: csr_array, features: NDArray[np.floating], words: Words) -> Labels:
    """(n,) the word nearest to the mean of the features (M, D) by the weights (M, n); -1 where no mask reaches."""
    # A mean's cosines are in the order of its products with the words: it need not be made, nor be of length 1.
    scores = np.asarray(weights.T @ (features @ unit_rows(words.astype(np.float64)).T))
    reached = np.asarray(weights.sum(axis=0)).ravel() > 0
    return np.where(reached, scores.argmax(axis=1), -1)
