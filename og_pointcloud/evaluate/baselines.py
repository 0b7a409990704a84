"""Other ways from masks to labelled points, on the same mask table: what the whole method is worth beside them.

Each takes what the stages that all share have prepared, and vectors of words; it returns a word a point, (n,) int, -1
where it says nothing. None knows background: a point that a mask's rays reach gets a word. `only_where_masked` is the
plain remedy, and is reported beside each: points that views show mostly outside of masks get none.

    direct uplift      every point the mean feature of the masks that show it, by blending weight
    nearest view       the feature of the mask that the closest view shows it in
    compressed         direct uplift with features reduced to 3 numbers and back, as LangSplat does per scene; here by
                       principal components, the best a linear autoencoder can do
    centre sampling    the feature of the mask at the pixel of its centre, mean over views by how visible it is there
                       (the idea of Occam's LGS)
    mask graph         masks joined over views; every point goes to the group that shows most of it, none to background
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from og_pointcloud.fitting.grouping import group_masks, indicator
from og_pointcloud.fitting.labellers import Prepared
from og_pointcloud.fitting.view_votes import hear_views
from og_pointcloud.rendering.geometry import sample_of_points
from og_pointcloud.scene import Scene
from og_pointcloud.settings import FitSettings

__all__ = [
    "BASELINES",
    "centre_sampling",
    "compressed_uplift",
    "direct_uplift",
    "mask_graph",
    "nearest_view",
    "only_where_masked",
    "uplift",
]

COMPRESSED_WIDTH = 3
"""Numbers a feature in LangSplat's scenes (its Sec. 4)."""

MOSTLY = 0.5
"""Share of a point's weight in masks from which it belongs to them."""

Words = NDArray[np.floating]
Labels = NDArray[np.integer]
Baseline = Callable[[Scene, Prepared, Words], Labels]


def direct_uplift(scene: Scene, prepared: Prepared, words: Words) -> Labels:
    """Each point takes the word nearest to the mean feature of the masks that show it."""
    return uplift(prepared.table.weights, prepared.table.unit_features, words)


def compressed_uplift(scene: Scene, prepared: Prepared, words: Words) -> Labels:
    """`direct_uplift` with features that went through three numbers."""
    features = prepared.table.unit_features
    middle = features.mean(axis=0)
    _, _, directions = np.linalg.svd(features - middle, full_matrices=False)
    basis = directions[:COMPRESSED_WIDTH]
    return uplift(prepared.table.weights, (features - middle) @ basis.T @ basis + middle, words)


def nearest_view(scene: Scene, prepared: Prepared, words: Words) -> Labels:
    """Each point takes the word of the mask that shows most of it in the closest view that shows it in any."""
    table, xyz = prepared.table, prepared.gaussians.xyz
    closest, mask = np.full(len(xyz), np.inf), np.full(len(xyz), -1)
    for view in np.unique(table.mask_view):
        rows = np.flatnonzero(table.mask_view == view)
        shown = csr_array(table.weights[rows]).tocoo()
        order = np.lexsort((-shown.row, shown.data, shown.col))
        last = order[np.append(np.diff(shown.col[order]) > 0, True)] if len(order) else order
        points, most = shown.col[last], shown.row[last]
        distance = np.linalg.norm(xyz[points] - scene.views[view].camera.center, axis=1)
        nearer = distance < closest[points]
        closest[points[nearer]], mask[points[nearer]] = distance[nearer], rows[most[nearer]]
    return np.where(mask >= 0, _word_of(table.unit_features, words)[mask], -1)


def centre_sampling(scene: Scene, prepared: Prepared, words: Words) -> Labels:
    """Each point takes the word nearest to the mean of the mask features at its centre's pixel, by exposure."""
    table, xyz = prepared.table, prepared.gaussians.xyz
    first = np.searchsorted(table.mask_view, np.arange(len(scene.views)))
    similarity = table.unit_features @ _unit(words).T
    scores, reached = np.zeros((len(xyz), len(words))), np.zeros(len(xyz), bool)
    for index, view in enumerate(scene.views):
        camera = view.camera
        uv_px, _ = camera.project(xyz)
        exposure = csr_array(table.exposure[[index]])
        points = exposure.indices
        points = points[camera.shows(uv_px[points])]
        column, row = uv_px[points].astype(int).T
        mask = view.mask_map()[row, column]
        visible = np.zeros(len(xyz))
        visible[exposure.indices] = exposure.data
        points, mask = points[mask >= 0], mask[mask >= 0]
        scores[points] += visible[points, None] * similarity[first[index] + mask]
        reached[points] = True
    return np.where(reached, scores.argmax(axis=1), -1)


def mask_graph(scene: Scene, prepared: Prepared, words: Words) -> Labels:
    """Masks joined as mode grouping does; each point goes to the group whose masks show most of it."""
    table, settings = prepared.table, FitSettings().grouping
    sample = sample_of_points(prepared.gaussians.xyz, settings.graph_points)
    groups = group_masks(table, hear_views(table), settings, sample)
    if groups.count == 0:
        return np.full(len(prepared.gaussians), -1)
    masks_of = indicator(groups.group, groups.count)
    shown = csr_array(masks_of @ table.weights).tocsc()
    group = np.asarray(shown.argmax(axis=0)).ravel()
    reached = np.diff(shown.indptr) > 0
    return np.where(reached, _word_of(masks_of @ table.unit_features, words)[group], -1)


BASELINES: dict[str, Baseline] = {
    "direct uplift": direct_uplift,
    "nearest view": nearest_view,
    "compressed": compressed_uplift,
    "centre sampling": centre_sampling,
    "mask graph": mask_graph,
}


def only_where_masked(labels: Labels, prepared: Prepared) -> Labels:
    """The labels without those of points of whose visible weight less than MOSTLY lies in masks."""
    table = prepared.table
    inside, outside = (np.asarray(part.sum(axis=0), np.float64).ravel() for part in (table.weights, table.outside))
    return np.where(inside > MOSTLY * (inside + outside), labels, -1)


def uplift(weights: csr_array, features: NDArray[np.floating], words: Words) -> Labels:
    """(n,) the word nearest to the mean of the features (M, D) by the weights (M, n); -1 where no mask reaches."""
    # A mean's cosines are in the order of its products with the words: it need not be made, nor be of length 1.
    scores = np.asarray(weights.T @ (features @ _unit(words).T))
    reached = np.asarray(weights.sum(axis=0)).ravel() > 0
    return np.where(reached, scores.argmax(axis=1), -1)


def _word_of(features: NDArray[np.floating], words: Words) -> Labels:
    return (features @ _unit(words).T).argmax(axis=1)


def _unit(rows: NDArray[np.floating]) -> NDArray[np.float64]:
    wide = np.asarray(rows, np.float64)
    return wide / np.maximum(np.linalg.norm(wide, axis=1, keepdims=True), 1e-300)
