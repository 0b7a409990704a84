"""Baseline methods from masks to labelled points, on the same mask table, to compare the whole method with.

Each takes the result of the shared stages and the vectors of words (L, D); it returns a word for each point of the
surface, (n,) int, -1 for none. None of them models background: every point that a mask's rays reach gets a word.
`only_where_masked` is the simple remedy, reported beside each: points that views show mostly outside masks get no word.

    direct uplift      each point has the mean feature of the masks that show it, by blending weight
    center sampling    each point has the feature of the mask at its center's pixel, averaged over views by visibility
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
"""A point with at most this share of its visible weight in masks belongs to none."""

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
        # Visibility is stored per photograph; this view may be part of one.
        exposure = csr_array(table.exposure[[photographs.of_view[index]]])
        points, visible = exposure.indices, exposure.data
        uv_px, _ = view.camera.project(xyz[points])
        inside = view.camera.shows(uv_px)
        column, row = np.floor(uv_px[inside]).astype(int).T
        mask = np.full(len(points), -1)
        mask[inside] = view.mask_map()[row, column]
        shown = mask >= 0
        # A mask of a cut view is part of a mask of its photograph, which has the row in the table.
        scores[points[shown]] += visible[shown, None] * similarity[photographs.of_mask[first[index] + mask[shown]]]
        reached[points[shown]] = True
    return np.where(reached, scores.argmax(axis=1), -1)


BASELINES: dict[str, Baseline] = {"direct uplift": direct_uplift, "center sampling": center_sampling}


def baseline_labels(prepared: Prepared, words: Words) -> Iterator[tuple[str, Labels, float]]:
    """Every method, unrestricted and where masked: name, words of all points of the scene, and seconds."""
    for name, method in BASELINES.items():
        start = time.perf_counter()
        labels = method(prepared, words)
        seconds = time.perf_counter() - start
        for value, found in ((name, labels), (f"{name}, where masked", only_where_masked(labels, prepared))):
            yield value, prepared.surface.of_points(found), seconds


def only_where_masked(labels: Labels, prepared: Prepared) -> Labels:
    """The labels, with -1 for points that have at most MIN_MASKED_SHARE of their visible weight in masks."""
    table = prepared.table
    inside, outside = (np.asarray(part.sum(axis=0), np.float64).ravel() for part in (table.weights, table.outside))
    return np.where(inside > MIN_MASKED_SHARE * (inside + outside), labels, -1)


def uplift(weights: csr_array, features: NDArray[np.floating], words: Words) -> Labels:
    """(n,) the word nearest to the mean of the features (M, D), weighted by (M, n); -1 where no mask reaches."""
    # Cosines of a mean rank as its dot products with the words: no need to compute the mean or to normalize it.
    scores = np.asarray(weights.T @ (features @ unit_rows(words.astype(np.float64)).T))
    reached = np.asarray(weights.sum(axis=0)).ravel() > 0
    return np.where(reached, scores.argmax(axis=1), -1)
