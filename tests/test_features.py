"""Losses of the mask table against literal rendering with automatic gradients, and what the optimization must do."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numba
import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import TinyCapture
from scipy.sparse import csr_array, random_array, vstack

from og_pointcloud.fitting.fit import prepare
from og_pointcloud.fitting.learned.instance_features import (
    FeatureObjective,
    learn_features,
    raw_gradient,
    read_features,
)
from og_pointcloud.fitting.mask_table import MaskTable
from og_pointcloud.formats.capture import read_capture
from og_pointcloud.rendering.splatting import view_weights
from og_pointcloud.settings import FeatureSettings

torch = pytest.importorskip("torch")

WIDTH = 6
CLOSEST = 0.1
VARIANTS = {
    "paper": FeatureSettings(),
    "separation alone": FeatureSettings(intra=False),
    "cohesion alone": FeatureSettings(inter=False),
}


@dataclass(frozen=True)
class Rendered:
    """Blending weights (pixels, n) and mask ids (pixels,) of every view: all that a literal rendering needs."""

    weights: list[csr_array]
    ids: list[NDArray[np.int32]]
    mask_counts: list[int]
    table: MaskTable


def random_views(seed: int = 0, n: int = 40, pixels: int = 90, mask_counts: tuple[int, ...] = (5, 3, 1, 2)) -> Rendered:
    """Sparse weights whose rows sum to between 0 and 1; the last Gaussians are in no view."""
    rng = np.random.default_rng(seed)
    weights, ids = [], []
    for count in mask_counts:
        rows = random_array((pixels, n - 4), density=0.15, rng=rng, format="csr", dtype=np.float64)
        rows = rows.multiply(rng.uniform(0.2, 1, (pixels, 1)) / np.maximum(rows.sum(axis=1)[:, None], 1e-9))
        weights.append(csr_array((csr_array(rows).astype(np.float32)).reshape(pixels, n - 4)))
        weights[-1].resize(pixels, n)
        ids.append(rng.integers(-1, count, pixels).astype(np.int32))
    return rendered(weights, ids, list(mask_counts))


def rendered(weights: list[csr_array], ids: list[NDArray[np.int32]], mask_counts: list[int]) -> Rendered:
    rows, pixels = [], []
    for weights_of, view_ids, count in zip(weights, ids, mask_counts, strict=True):
        inside = np.flatnonzero(view_ids >= 0)
        member = csr_array((np.ones(len(inside), np.float32), (view_ids[inside], inside)), (count, len(view_ids)))
        rows.append(member @ weights_of)
        pixels.append(np.bincount(view_ids[inside], minlength=count))
    nothing = csr_array((len(weights), weights[0].shape[1]), dtype=np.float32)
    view = np.repeat(np.arange(len(weights), dtype=np.int32), mask_counts)
    area = np.concatenate(pixels).astype(np.int32)
    table = MaskTable(
        csr_array(vstack(rows, format="csr")), nothing, nothing, view, area, np.zeros((len(view), 2), np.float32)
    )
    return Rendered(weights, ids, mask_counts, table)


@pytest.fixture
def tiny(tiny_capture: TinyCapture) -> Rendered:
    scene = read_capture(tiny_capture.folder)
    surface = prepare(scene).surface
    gaussians = surface.gaussians.take(surface.row_of_point)  # in the order of the capture's truth
    weights = [view_weights(gaussians, view.camera, 0.05) for view in scene.views]
    ids = [view.mask_map().ravel() for view in scene.views]
    return rendered(weights, ids, [view.mask_count for view in scene.views])


def literal(scene: Rendered, settings: FeatureSettings, values: NDArray[np.floating]) -> tuple[float, NDArray]:
    """The objective and its gradient, from rendered pixels, in the dtype of values (n, width)."""
    dtype = torch.float64 if values.dtype == np.float64 else torch.float32
    f = torch.tensor(values, requires_grad=True)
    separation, cohesion, size, views = torch.zeros((), dtype=dtype), torch.zeros((), dtype=dtype), 0.0, 0
    for sparse, ids, count in zip(scene.weights, scene.ids, scene.mask_counts, strict=True):
        inside = np.flatnonzero(ids >= 0)
        weights, ids = torch.tensor(sparse[inside].toarray(), dtype=dtype), ids[inside]
        members = [torch.tensor(np.flatnonzero(ids == i)) for i in range(count)]
        members = [pixels for pixels in members if len(pixels) and float(weights[pixels].sum()) > 0]
        views += bool(members)
        blended = [weights[pixels].sum(dim=0) for pixels in members]
        means = [weight @ f / weight.sum() for weight in blended]
        for mean, weight in zip(means, blended, strict=True):
            cohesion = cohesion + (weight * (f - mean).square().sum(dim=1)).sum()
            size += float(weight.sum())
        separation = separation + literal_separation(means)
    objective = settings.inter * separation / views + settings.intra * settings.cohesion_weight * cohesion / size
    objective.backward()
    return objective.item(), f.grad.numpy()


def literal_separation(means: list[torch.Tensor]) -> torch.Tensor | float:
    """Eq. 2 of one view, pair by pair."""
    m, total = len(means), 0.0
    for i, j in itertools.permutations(range(m), 2):
        total = total + 1 / ((means[i] - means[j]).square().sum() + CLOSEST**2)
    return total / (m * (m - 1)) if m > 1 else 0.0


def worst_errors(scene: Rendered, settings: FeatureSettings, dtype: type) -> tuple[float, float]:
    """Relative error of the objective and of its gradient (to the largest entry), fast in dtype, literal in float64."""
    values = np.random.default_rng(1).uniform(size=(scene.table.weights.shape[1], WIDTH)).astype(dtype)
    problem = FeatureObjective(scene.table, settings)
    found, pulled = problem.at(values[problem.shown], CLOSEST)
    objective, gradient = literal(scene, settings, values.astype(np.float64))
    full = np.zeros_like(gradient)
    full[problem.shown] = pulled
    return abs(found / objective - 1), float(np.abs(full - gradient).max() / np.abs(gradient).max())


@pytest.mark.parametrize("name", VARIANTS)
def test_value_and_gradient_equal_those_of_rendered_pixels_on_a_capture(tiny: Rendered, name: str) -> None:
    assert max(worst_errors(tiny, VARIANTS[name], np.float64)) < 2e-6
    assert max(worst_errors(tiny, VARIANTS[name], np.float32)) < 2e-6


def test_in_exact_weights_the_quadratic_form_is_exact() -> None:
    scene = random_views()
    weights = [rows.astype(np.float64) for rows in scene.weights]
    exact = rendered(weights, scene.ids, scene.mask_counts)
    assert max(worst_errors(exact, VARIANTS["paper"], np.float64)) < 1e-12


def test_points_bound_what_covered_pixels_show() -> None:
    scene = random_views()
    values = np.random.default_rng(1).uniform(size=(40, WIDTH))
    problem = FeatureObjective(scene.table, FeatureSettings(inter=False, cohesion_weight=1))
    bound = problem.at(values[problem.shown], CLOSEST)[0] * np.asarray(scene.table.weights.sum())
    shown = 0.0
    means = iter(problem.mask_means(values[problem.shown]))
    for weights, ids, count in zip(scene.weights, scene.ids, scene.mask_counts, strict=True):
        for i in range(count):
            rows, mean = weights[np.flatnonzero(ids == i)].toarray(), next(means)
            shown += ((rows @ values - rows.sum(axis=1, keepdims=True) * mean) ** 2).sum()
    assert 0.1 * bound < shown < bound


def test_gradient_by_raw_features_equals_the_automatic_one() -> None:
    rng = np.random.default_rng(0)
    raw = rng.normal(size=(30, WIDTH)) * rng.uniform(0.1, 1.5, (30, 1))
    by_read = rng.normal(size=raw.shape)
    f = torch.tensor(raw, requires_grad=True)
    length = f.norm(dim=1, keepdim=True)
    read = 0.5 + 0.5 * f / length
    (read * torch.tensor(by_read)).sum().backward()
    np.testing.assert_allclose(read_features(raw), read.detach().numpy(), rtol=1e-14)
    pulled = raw_gradient(raw, by_read)
    np.testing.assert_allclose(pulled, f.grad.numpy(), rtol=1e-12, atol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("settings", [FeatureSettings(), FeatureSettings(width=2)])
def test_objects_come_apart_and_keep_together(
    tiny: Rendered, tiny_capture: TinyCapture, settings: FeatureSettings
) -> None:
    learned = learn_features(tiny.table, settings)
    assert learned.converged
    assert learned.features.dtype == np.float32
    assert np.isfinite(learned.features).all()
    surely = learned.seen > 5
    red, blue = (learned.features[surely & (tiny_capture.object_ids == ball)] for ball in (0, 1))
    between = np.linalg.norm(np.median(red, axis=0) - np.median(blue, axis=0))
    within = max(np.median(np.linalg.norm(ball - np.median(ball, axis=0), axis=1)) for ball in (red, blue))
    assert between > 5 * within


def test_gaussians_that_no_mask_shows_get_no_feature() -> None:
    learned = learn_features(random_views().table)
    np.testing.assert_array_equal(np.flatnonzero(learned.seen == 0), [36, 37, 38, 39])
    np.testing.assert_array_equal(learned.features[36:], 0)
    assert (np.abs(learned.features[:36]).sum(axis=1) > 0).all()


def test_the_objective_falls_in_every_step(tiny: Rendered) -> None:
    learned = learn_features(tiny.table)
    assert learned.steps > 10
    assert (np.diff(learned.objective) < 0).all()


def test_same_answer_on_every_run_and_any_number_of_threads(tiny: Rendered) -> None:
    first = learn_features(tiny.table, seed=3)
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        np.testing.assert_array_equal(learn_features(tiny.table, seed=3).features, first.features)
    finally:
        numba.set_num_threads(threads)
    assert not np.array_equal(learn_features(tiny.table, seed=4).features, first.features)


def test_resolution_of_the_images_does_not_matter(tiny: Rendered) -> None:
    larger = replace(tiny.table, weights=csr_array(tiny.table.weights * np.float32(4)))
    np.testing.assert_allclose(learn_features(larger).features, learn_features(tiny.table).features, atol=1e-5)


def test_a_view_without_two_masks_has_no_separation() -> None:
    learned = learn_features(random_views(mask_counts=(1, 1)).table)
    assert learned.converged
    assert learned.objective[-1] == pytest.approx(0, abs=1e-6)
    assert np.isfinite(learned.features).all()


def test_one_mask_of_one_gaussian() -> None:
    one = csr_array(np.ones((1, 1), np.float32))
    table = MaskTable(one, one, one, np.zeros(1, np.int32), np.ones(1, np.int32), np.zeros((1, 1), np.float32))
    learned = learn_features(table)
    assert np.linalg.norm(2 * learned.features - 1) == pytest.approx(1, abs=1e-6)
    assert learned.converged


def test_too_few_steps_are_admitted(tiny: Rendered) -> None:
    learned = learn_features(tiny.table, FeatureSettings(max_steps=3))
    assert learned.steps == 3
    assert not learned.converged
