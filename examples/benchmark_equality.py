"""The fast forms against rendering: objectives and gradients, and the evidence of Eq. 5; worst relative errors.

    python examples/benchmark_equality.py CAPTURE [-o DIR]

On one capture, at reduced resolution, and one made scene. The rendered side blends every pixel in float64 from the
weights of its Gaussians, takes the losses there, and lets torch find the gradient; the fast side has the mask table
and S. float32: as a fit has them, features too. float64: both summed in float64 from the same pixels, features too,
so that what is left is the algebra. Errors are relative to the rendered value; of gradients to the largest entry.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from benchmark_scaling import made_scene, write_rows
from numpy.typing import NDArray
from scipy.sparse import csr_array, vstack

from og_pointcloud.fitting.fit import prepare
from og_pointcloud.fitting.learned.codebook import two_level_codebook
from og_pointcloud.fitting.learned.instance_features import (
    FeatureObjective,
    MaskGram,
    cohesion_factor,
    learn_features,
    masked_gram,
)
from og_pointcloud.fitting.learned.matching import Evidence, eq5_scores, visible_evidence
from og_pointcloud.fitting.learned.paper import view_losses
from og_pointcloud.fitting.mask_table import MaskTable, mask_table, pixel_weights
from og_pointcloud.formats.capture import read_capture
from og_pointcloud.rendering.geometry import thinned
from og_pointcloud.scene import Scene
from og_pointcloud.settings import CodebookSettings, FeatureSettings, MatchingSettings, PaperSettings

VIEWS = 6
"""Views compared at most, evenly spread."""
SHORT_SIDE = 60
"""Pixels of the images' shorter side, at least, after thinning."""
WIDTH = 6
PRINTED_BOUND = 1e-4
"""Eq. 2 as the paper mode renders it is bounded at this distance (paper.SMALLEST_DISTANCE)."""
BOUND = 0.1
"""And here where the literal form beside the points' bound is written out."""


@dataclass(frozen=True)
class EqualityRow:
    """Worst relative error of one quantity on one scene, with the fast form in float32 and in float64."""

    scene: str
    quantity: str
    float32: float
    float64: float


@dataclass(frozen=True)
class Form:
    """What the fast side knows of the views, and the type that its features are in."""

    table: MaskTable
    gram: MaskGram
    dtype: type[np.floating]


@dataclass(frozen=True)
class Pixels:
    """All pixels of one view. weights: (pixels, n) float64 blending weights. ids: (pixels,) int32, its mask, -1 none.
    count: masks of the view."""

    weights: csr_array
    ids: NDArray[np.int32]
    count: int

    def in_masks(self) -> tuple[csr_array, NDArray[np.int64]]:
        """Weights of the pixels in masks that show a Gaussian at all, and their masks, 0..m-1."""
        coverage = np.asarray(self.weights.sum(axis=1)).ravel()
        shown = np.bincount(self.ids + 1, coverage, minlength=self.count + 1) > 0
        inside = np.flatnonzero((self.ids >= 0) & shown[self.ids + 1])
        return self.weights[inside], np.unique(self.ids[inside], return_inverse=True)[1].astype(np.int64)


def compare(name: str, scene: Scene) -> list[EqualityRow]:
    """All rows of one scene."""
    spread = np.unique(np.linspace(0, len(scene.views) - 1, VIEWS).round().astype(int))
    smallest = min(min(view.camera.width, view.camera.height) for view in scene.views)
    views = [thinned(scene.views[index], max(1, smallest // SHORT_SIDE)) for index in spread]
    prepared = prepare(scene)
    gaussians, near = prepared.gaussians, prepared.near
    pixels = [
        Pixels(pixel_weights(gaussians, view.camera, near).astype(np.float64), view.mask_map().ravel(), view.mask_count)
        for view in views
    ]
    fitted = Form(mask_table(gaussians, views, near), masked_gram(gaussians, views, near), np.float32)
    forms = (fitted, exact_form(fitted, pixels))
    return [*objective_rows(name, forms, pixels), *evidence_rows(name, scene.points.xyz, forms, pixels)]


def exact_form(fitted: Form, pixels: Sequence[Pixels]) -> Form:
    """Table and S summed from all pixels in float64."""
    weights, outside, gram = [], [], csr_array(fitted.gram.matrix.shape, dtype=np.float64)
    for view in pixels:
        place = (view.ids + 1, np.arange(len(view.ids)))
        member = csr_array((np.ones(len(view.ids)), place), shape=(view.count + 1, len(view.ids)))
        sums = csr_array(member @ view.weights)
        outside.append(sums[:1])
        weights.append(sums[1:])
        inside = view.weights[np.flatnonzero(view.ids >= 0)]
        gram = gram + inside.T @ inside
    table = replace(
        fitted.table,
        weights=csr_array(vstack(weights, format="csr")),
        outside=csr_array(vstack(outside, format="csr")),
    )
    return Form(table, replace(fitted.gram, matrix=csr_array(gram)), np.float64)


def objective_rows(name: str, forms: Sequence[Form], pixels: Sequence[Pixels]) -> list[EqualityRow]:
    """Value and gradient of the printed losses (paper.py renders them), and of the points' bound (written out here)."""
    exact = np.random.default_rng(1).random((pixels[0].weights.shape[1], WIDTH))
    rows = []
    for title, settings, bound in (
        ("as printed", FeatureSettings(cohesion="rendered"), PRINTED_BOUND),
        ("points' bound", FeatureSettings(cohesion="points"), BOUND),
    ):
        errors = []
        for form in forms:
            problem = FeatureObjective(form.table, settings, form.gram)
            values = exact.astype(form.dtype)
            terms = problem.terms(values[problem.shown], bound)
            rendered, gradient = rendered_objective(pixels, values.astype(np.float64), settings, bound)
            found = np.zeros_like(gradient)
            found[problem.shown] = terms.gradient
            worst = np.abs(found - gradient).max() / np.abs(gradient).max()
            errors.append((abs(terms.objective / rendered - 1), float(worst)))
        values_apart, gradients_apart = zip(*errors, strict=True)
        rows.append(EqualityRow(name, f"objective {title}: value", *values_apart))
        rows.append(EqualityRow(name, f"objective {title}: gradient", *gradients_apart))
    return rows


def rendered_objective(
    pixels: Sequence[Pixels], values: NDArray[np.float64], settings: FeatureSettings, bound: float
) -> tuple[float, NDArray[np.float64]]:
    """The objective and its gradient (n, width), from pixels. cohesion "rendered": with the losses of paper mode."""
    features = torch.tensor(values, requires_grad=True)
    separation, cohesion, size, views = torch.zeros(()), torch.zeros(()), 0.0, 0
    for view in pixels:
        weights, mask = view.in_masks()
        if len(mask) == 0:
            continue
        if settings.cohesion == "rendered":
            of_view = view_losses(_blended(weights, features), torch.from_numpy(mask), PaperSettings(formula="paper"))
            size += len(mask)
        else:
            of_view, size = _point_losses(weights, mask, features, bound), size + float(weights.sum())
        separation, cohesion, views = separation + of_view[0], cohesion + of_view[1], views + 1
    objective = separation / views + cohesion_factor(settings) * cohesion / size
    (gradient,) = torch.autograd.grad(objective, features)
    return objective.item(), gradient.numpy()


def _point_losses(
    weights: csr_array, mask_of_pixel: NDArray[np.int64], features: torch.Tensor, bound: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Eq. 2 of the masks' blended means, and Eq. 1 over every (pixel, Gaussian) pair by its blending weight."""
    pairs = weights.tocoo()
    mask = torch.from_numpy(mask_of_pixel[pairs.row])
    weight = torch.from_numpy(pairs.data)
    of_pair = features.index_select(0, torch.from_numpy(pairs.col.astype(np.int64)))
    sums = torch.zeros((int(mask_of_pixel.max()) + 1, features.shape[1]), dtype=torch.float64)
    blended = torch.zeros(len(sums), dtype=torch.float64).index_add(0, mask, weight)
    means = sums.index_add(0, mask, weight[:, None] * of_pair) / blended[:, None]
    square = (of_pair - means.index_select(0, mask)).square().sum(dim=1)
    apart = (means[:, None] - means[None]).square().sum(dim=2)[~torch.eye(len(means), dtype=torch.bool)]
    separation = (1 / (apart + bound**2)).mean() if len(apart) else means.sum() * 0
    return separation, (weight * square).sum()


def _blended(weights: csr_array, features: torch.Tensor) -> torch.Tensor:
    """(pixels, width): every pixel's Gaussians added up one by one."""
    pairs = weights.tocoo()
    pixel, gaussian = (torch.from_numpy(index.astype(np.int64)) for index in (pairs.row, pairs.col))
    of_pair = torch.from_numpy(pairs.data)[:, None] * features.index_select(0, gaussian)
    return torch.zeros((weights.shape[0], features.shape[1]), dtype=torch.float64).index_add(0, pixel, of_pair)


def evidence_rows(
    name: str, xyz: NDArray[np.float32], forms: Sequence[Form], pixels: Sequence[Pixels]
) -> list[EqualityRow]:
    """What each mask shows of each instance, and Eq. 5 of it, from the table and from rendered pixels."""
    fitted = forms[0].table
    learned = learn_features(fitted)
    book = two_level_codebook(learned.features, xyz, learned.seen, fitted, CodebookSettings())
    shown = np.maximum(np.asarray(fitted.weights.sum(axis=1)).reshape(-1, 1), 1e-9)
    of_masks = (fitted.weights @ learned.features) / shown
    errors = []
    for form in forms:
        evidence = visible_evidence(form.table, book.leaf, book.leaf_centres, of_masks)
        rendered = rendered_evidence(pixels, book.leaf, evidence)
        both = (evidence, rendered)
        areas = [np.concatenate([e.shared.ravel(), e.instance_area.ravel(), e.mask_area]) for e in both]
        scores = [eq5_scores(either, fitted.mask_view, MatchingSettings()) for either in both]
        errors.append((_worst(*areas), _worst(*scores)))
    areas_apart, scores_apart = zip(*errors, strict=True)
    return [
        EqualityRow(name, "association: pixels shown", *areas_apart),
        EqualityRow(name, "association: score of Eq. 5", *scores_apart),
    ]


def rendered_evidence(pixels: Sequence[Pixels], ids: NDArray[np.int32], like: Evidence) -> Evidence:
    """Evidence from every view's map of instances, a channel each: blended in float64, then summed over masks. The
    distance of features is not a matter of rendering here: it is taken from ``like``."""
    channels = csr_array((ids[:, None] == np.arange(like.shared.shape[1])).astype(np.float64))
    shared, area, in_view = [], [], []
    for view in pixels:
        image = (view.weights @ channels).toarray()
        for mask in range(view.count):
            inside = np.flatnonzero(view.ids == mask)
            shared.append(image[inside].sum(axis=0))
            area.append(view.weights[inside].sum())
        in_view.append(image.sum(axis=0))
    return replace(like, shared=np.array(shared), mask_area=np.array(area), instance_area=np.array(in_view))


def _worst(values: NDArray[np.floating], expected: NDArray[np.floating]) -> float:
    """The largest error relative to each expected value; values below a thousandth of the largest count as that."""
    return float((np.abs(values - expected) / np.maximum(expected, 1e-3 * expected.max())).max())


def print_rows(rows: Sequence[EqualityRow]) -> None:
    """The table."""
    print("scene             quantity, fast against rendered in float64        float32   float64")
    for row in rows:
        print(f"{row.scene:<17} {row.quantity:<45} {row.float32:9.1e} {row.float64:9.1e}")


def main() -> None:
    """Compare on a capture and on a made scene."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("-o", "--output", type=Path, help="folder for a CSV")
    arguments = parser.parse_args()
    made, _ = made_scene(7_000, 12)
    rows = [*compare(arguments.capture.name, read_capture(arguments.capture)), *compare("made balls", made)]
    print_rows(rows)
    if arguments.output:
        arguments.output.mkdir(parents=True, exist_ok=True)
        write_rows(arguments.output / "equality.csv", rows)


if __name__ == "__main__":
    main()
