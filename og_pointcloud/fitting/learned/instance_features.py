"""Instance features of all Gaussians (paper, Sec. 3.1, Eq. 1 and 2), from the mask table instead of by rendering.

Blending is linear: with the weights ``W`` of a view and features ``F`` a pixel shows ``M = W F``, and a mask's mean is
a row of ``diag(1 / N) A F``, where ``A`` (mask_table.py) sums W over the mask's pixels. So both losses of all views
follow from two sparse products, ``A F`` for the value and ``A' G`` for the gradient; nothing is rendered.

    objective = mean over views of L_c  +  cohesion_weight * L_s

``L_c``, inter-mask contrast (Eq. 2), over the pairs i != j of a view's m masks:
    1 / (m (m - 1)) sum of 1 / (d_ij^2 + e^2).
    A view without two masks has none. The printed form has e = 0 and is infinite where two means meet; here e is
    `FeatureSettings.closest`, after rounds with e = COARSE_BOUNDS.
``L_s``, intra-mask smoothness (Eq. 1), over the Gaussians that show in a mask instead of the rendered pixels:
    the sum of ``A_ig |f_g - Mbar_i|^2``, which is ``sum_g c_g |f_g|^2 - sum_i N_i |Mbar_i|^2`` with ``c = A' 1``,
    divided by P.
    N_i is a mask's *blended weight*, the sum of row i of A, so that coverage does not act as a feature; P is the sum of
    all N_i. By Jensen's inequality the sum bounds that over pixels of ``|M_p - a_p Mbar_i|^2``, where a_p is the
    pixel's coverage: the printed loss where a_p = 1. It is stricter: each Gaussian must agree, not only each blend.

Divided by P, Eq. 1 weighs the same at any image size; otherwise it is the paper's sum over a random view.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from og_pointcloud.errors import SceneError
from og_pointcloud.fitting.mask_table import MaskTable
from og_pointcloud.kernels import njit, prange
from og_pointcloud.settings import FeatureSettings

COARSE_BOUNDS = (0.71, 0.57, 0.14)
"""The bound e of Eq. 2 in the rounds before the last: larger ones have fewer local minima. Directions at right angles
read 0.71 apart."""
COARSE_TOLERANCE = 10.0
"""Rounds before the last use this many times the tolerance: the next one moves the features anyway."""
WINDOW = 10
"""Steps over which the decrease of the objective is measured."""
LEVEL = 0.01
"""The decrease is relative to the objective, or to this share of its first value if larger: it may tend to 0."""
MEMORY = 6
"""Steps remembered by L-BFGS (Nocedal & Wright 2006, Sec. 7.2; 3 to 20 are usual)."""
DOT_PART = 8192
"""Length of the partial sums of dot products, each in float32."""
FIRST_REACH = 0.5
"""How far the first step moves the feature that it moves most, as no curvature is known yet."""
SUFFICIENT = 1e-4
"""Armijo: a step must achieve this share of the decrease that the slope predicts (Nocedal & Wright, Eq. 3.4)."""
HALVINGS = 20
"""Step lengths tried, each half of the one before."""

Evaluate = Callable[[NDArray[np.float32]], tuple[float, NDArray[np.float32]]]
"""Raw features -> the objective and its gradient with respect to them."""
Pair = tuple[NDArray[np.float32], NDArray[np.float32], float]
"""A step, the change of the gradient along it, and their product."""


@dataclass(frozen=True)
class LearnedFeatures:
    """Features of n Gaussians and how they were found.

    features: (n, width) float32 as read (see `read_features`); rows of zeros where no mask sees the Gaussian.
    seen: (n,) float64, pixels of blending weight in masks; 0: the feature is meaningless.
    objective: float64, before the last round and after each of its steps; it falls in each. steps: of all rounds.
    converged: False where `FeatureSettings.max_steps` was reached first.
    """

    features: NDArray[np.float32]
    seen: NDArray[np.float64]
    objective: NDArray[np.float64]
    steps: int
    converged: bool


def learn_features(table: MaskTable, settings: FeatureSettings | None = None, seed: int = 0) -> LearnedFeatures:
    """Features that agree within masks and differ between the masks of a view, by L-BFGS on all views at once.

    Each mask gets a random direction from the seed, and each Gaussian starts at the mean of its masks' directions, so
    that Gaussians of the same masks start together.

    The same input and seed give the same features. Raises SceneError if no mask shows a Gaussian.
    """
    settings = settings or FeatureSettings()
    problem = FeatureObjective(table, settings)
    rng = np.random.default_rng(seed)
    # Normalized Gaussian vectors are uniformly distributed directions.
    random = rng.normal(size=(problem.mask_count, settings.width))
    directions = problem.uplift((random / np.linalg.norm(random, axis=1, keepdims=True)).astype(np.float32))
    raw = directions / np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-6)  # masks may cancel
    # From a smooth objective to the final one; all rounds share one budget of steps.
    objective, steps, converged = [0.0], 0, False
    for closest in (*COARSE_BOUNDS, settings.closest):
        tolerance = settings.tolerance * (1 if closest == settings.closest else COARSE_TOLERANCE)
        raw, objective, converged = _minimise(problem, raw, closest, tolerance, settings.max_steps - steps)
        steps += len(objective) - 1
    features = np.zeros((table.weights.shape[1], settings.width), np.float32)
    features[problem.shown] = read_features(raw)
    return LearnedFeatures(features, problem.seen, np.array(objective), steps, converged)


def read_features(raw: NDArray[np.floating]) -> NDArray[np.floating]:
    """What the losses see of a raw feature (n, width): its direction mapped to [0, 1]; of a zero row, 0.5."""
    return _read(raw, _columns(raw))


def raw_gradient(raw: NDArray[np.floating], gradient: NDArray[np.floating]) -> NDArray[np.floating]:
    """The gradient with respect to raw features (n, width), given that with respect to their `read_features`."""
    return _raw_gradient(raw, gradient, _columns(raw))


class FeatureObjective:
    """Value and gradient of the losses over all views, for features as read.

    Only Gaussians that a mask shows take part: ``shown`` (k,) are their rows, and all features here are (k, width).
    ``seen`` (n,) float64 is the blending weight of all Gaussians in masks, ``weight`` (k, 1) float32 that of those
    shown. Masks that show none are left out.
    """

    def __init__(self, table: MaskTable, settings: FeatureSettings) -> None:
        self.settings = settings
        # In float64: where features agree, Eq. 1 is a small difference of large sums. (scipy's own sums stay float32.)
        weight = table.weights @ np.ones(table.weights.shape[1])
        self.seen = np.bincount(table.weights.indices, table.weights.data, table.weights.shape[1]).astype(np.float64)
        # Gaussians that no mask shows have no gradient and are left out. Masks without a Gaussian have no mean.
        self.shown = np.flatnonzero(self.seen > 0)
        self.weight = self.seen[self.shown, None].astype(np.float32)
        kept = np.flatnonzero(weight > 0)
        if len(kept) == 0:
            raise SceneError(
                f"none of the {len(weight)} masks shows a Gaussian; expected at least one: make masks, and check that "
                "poses and cloud are in the same frame"
            )
        self._weights = _int32(table.weights[kept][:, self.shown])
        self._weights.sort_indices()  # so that rows of the features are read in order
        self._transposed = _int32(csr_array(self._weights.T))
        # Masks are stacked view by view: where each view's masks begin, and last the number of masks.
        self._first = np.flatnonzero(np.diff(table.mask_view[kept], prepend=-1, append=-2))
        self._size = weight[kept]

    @property
    def mask_count(self) -> int:
        """Masks that show a Gaussian."""
        return len(self._size)

    def mask_means(self, features: NDArray[np.floating]) -> NDArray[np.float64]:
        """(masks, width) float64, ``diag(1 / N) A F``."""
        return _product(*_arrays(self._weights), features, _columns(features)) / self._size[:, None]

    def uplift(self, of_masks: NDArray[np.float32]) -> NDArray[np.float32]:
        """(k, width): for each Gaussian the mean of the masks' rows, weighted by how much of it each shows."""
        return (_product(*_arrays(self._transposed), of_masks, _columns(of_masks)) / self.weight).astype(np.float32)

    def at(self, features: NDArray[np.floating], closest: float) -> tuple[float, NDArray[np.floating]]:
        """The objective, without terms that are off, at features (k, width) as read, and its gradient, in their dtype.

        closest: the bound e of Eq. 2.
        """
        settings, views = self.settings, len(self._first) - 1
        features = np.ascontiguousarray(features)
        means = self.mask_means(features)
        # Eq. 2 depends on the means alone; pull is the gradient with respect to them.
        separation, pull = _separation(means, self._first, closest**2)
        separation, pull = float(separation) / views, pull * (settings.inter / views)
        # Eq. 1 as the difference of the two sums above: one depends on features, one on means.
        factor, total = settings.intra * settings.cohesion_weight, self._size.sum()
        blended = self.seen[self.shown, None] * features
        cohesion = float((features * blended).sum() - (self._size[:, None] * means**2).sum()) / total
        # Chain rule: means are diag(1 / N) A F, so their gradient comes back to the features by A' diag(1 / N).
        pull = (pull + factor * (-2 / total * self._size[:, None] * means)) / self._size[:, None]
        gradient = _product(*_arrays(self._transposed), pull, _columns(pull)) + factor * (2 / total * blended)
        objective = settings.inter * separation + factor * cohesion
        return objective, gradient.astype(features.dtype)


def _minimise(
    problem: FeatureObjective, raw: NDArray[np.float32], closest: float, tolerance: float, max_steps: int
) -> tuple[NDArray[np.float32], list[float], bool]:
    """Raw features where the objective hardly falls any more, its values on the way, and whether it converged.

    Limited-memory BFGS with backtracking, preconditioned by each Gaussian's visible weight.
    """

    # scipy's L-BFGS-B, in the same variables, reaches the same minimum (objective within 0.1 %, mIoU of mode fast
    # within 0.005) in 4 to 11 times the processor time: 11.6 s against 3.0 s in a room of 260,000 points, 2.9 s against
    # 0.26 s on a table of 103,000. It holds all in float64, and its sums depend on the number of threads.
    def evaluate(raw: NDArray[np.float32]) -> tuple[float, NDArray[np.float32]]:
        objective, gradient = problem.at(read_features(raw), closest)
        return objective, raw_gradient(raw, gradient)

    pairs: list[Pair] = []
    value, gradient = evaluate(raw)
    values = [value]
    while len(values) <= max_steps:
        # Gradient and curvature of a Gaussian both grow about in proportion to how much of it shows: divided by that,
        # steps are alike for all.
        step = -gradient / problem.weight
        if pairs:
            step = _two_loops(gradient, pairs, np.float32(1) / problem.weight)
        elif longest := float(np.linalg.norm(step, axis=1).max()):
            step *= np.float32(FIRST_REACH / longest)
        moved = _backtracked(evaluate, raw, step, values[-1], _dot(step, gradient))
        if moved is None and pairs:
            pairs.clear()  # the remembered curvature misled: try the plain gradient before giving up
            continue
        if moved is None:
            return raw, values, True  # no step lowers the objective by more than rounding
        new_raw, value, new_gradient = moved
        _remember(pairs, new_raw - raw, new_gradient - gradient)
        raw, gradient = new_raw, new_gradient
        values.append(value)
        least = tolerance * max(value, LEVEL * values[0])
        if len(values) > WINDOW and values[-1 - WINDOW] - value < least:  # it hardly falls any more
            return raw, values, True
    return raw, values, False


def _backtracked(
    evaluate: Evaluate, raw: NDArray[np.float32], step: NDArray[np.float32], value: float, slope: float
) -> tuple[NDArray[np.float32], float, NDArray[np.float32]] | None:
    """Features, value and gradient after the step, halved until the value falls enough; None if it never does."""
    for halving in range(HALVINGS):
        length = 0.5**halving
        moved = raw + np.float32(length) * step
        new_value, gradient = evaluate(moved)
        if new_value < value + SUFFICIENT * length * slope:
            return moved, new_value, gradient
    return None


def _two_loops(
    gradient: NDArray[np.float32], pairs: list[Pair], preconditioner: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Minus the remembered inverse Hessian times the gradient (Nocedal & Wright, Algorithm 7.4).

    In its symbols, moved is s, turned is y, curvature is 1 / rho, and shares are alpha.
    """
    direction = -gradient
    shares = []
    for moved, turned, curvature in reversed(pairs):
        shares.append(_dot(moved, direction) / curvature)
        direction -= np.float32(shares[-1]) * turned
    # For everything not remembered: the preconditioner, scaled to the curvature along the last step (Eq. 7.20).
    _, turned, curvature = pairs[-1]
    direction *= preconditioner * np.float32(curvature / _dot(turned, turned * preconditioner))
    for (moved, turned, curvature), share in zip(pairs, reversed(shares), strict=True):
        direction += np.float32(share - _dot(turned, direction) / curvature) * moved
    return direction


def _remember(pairs: list[Pair], moved: NDArray[np.float32], turned: NDArray[np.float32]) -> None:
    """Keep a step and its change of gradient, unless the objective curved downward or hardly at all along it."""
    curvature = _dot(moved, turned)
    # Judged by their cosine, which has no unit; below 1e-6 it is only float32 rounding.
    if curvature > 1e-6 * np.sqrt(_dot(moved, moved) * _dot(turned, turned)):
        pairs.append((moved, turned, curvature))
        del pairs[:-MEMORY]


def _dot(a: NDArray[np.float32], b: NDArray[np.float32]) -> float:
    """Sum of products, in parts too short for a library to spread over threads: the order is always the same."""
    a, b = a.ravel(), b.ravel()
    return sum(float(a[i : i + DOT_PART] @ b[i : i + DOT_PART]) for i in range(0, len(a), DOT_PART))


def _int32(matrix: csr_array) -> csr_array:
    """The same matrix with fixed index types, whichever scipy chose: kernels are then compiled once."""
    index = (matrix.indices.astype(np.int32), matrix.indptr.astype(np.int64))
    return csr_array((matrix.data, *index), shape=matrix.shape)


def _arrays(matrix: csr_array) -> tuple[NDArray[np.integer], NDArray[np.integer], NDArray[np.floating]]:
    return matrix.indptr, matrix.indices, matrix.data


def _columns(values: NDArray[np.floating]) -> tuple[int, ...]:
    """A tuple as long as a row: its length is part of its type, so that the kernels' inner loops are unrolled."""
    return (0,) * values.shape[1]


@njit(cache=True, parallel=True)
def _product(indptr, indices, data, dense, columns):  # noqa: ANN001, ANN202
    """CSR matrix times (n, width), summed in float64: (rows, width) float64."""
    out = np.zeros((len(indptr) - 1, len(columns)))
    for row in prange(len(indptr) - 1):
        for e in range(indptr[row], indptr[row + 1]):
            other, weight = indices[e], np.float64(data[e])
            for c in range(len(columns)):
                out[row, c] += weight * dense[other, c]
    return out


@njit(cache=True, parallel=True)
def _read(raw, columns):  # noqa: ANN001, ANN202
    """As `read_features`: x -> 1/2 + x / (2 |x|)."""
    read = np.empty_like(raw)
    for g in prange(len(raw)):
        square = 0.0
        for c in range(len(columns)):
            square += np.float64(raw[g, c]) ** 2
        length = np.sqrt(square)
        for c in range(len(columns)):
            read[g, c] = 0.5 + 0.5 * raw[g, c] / length if length > 0 else 0.5
    return read


@njit(cache=True, parallel=True)
def _raw_gradient(raw, gradient, columns):  # noqa: ANN001, ANN202
    """As `raw_gradient`: the derivative of x / |x| keeps the part of the gradient perpendicular to x, over |x|."""
    pulled = np.empty_like(raw)
    for g in prange(len(raw)):
        square, along = 0.0, 0.0
        for c in range(len(columns)):
            square += np.float64(raw[g, c]) ** 2
            along += np.float64(raw[g, c]) * gradient[g, c]
        length = np.sqrt(square)
        for c in range(len(columns)):
            across = gradient[g, c] - raw[g, c] * along / square if square > 0 else 0.0
            pulled[g, c] = 0.5 * across / length if length > 0 else 0.0
    return pulled


@njit(cache=True)
def _separation(means, first, bound):  # noqa: ANN001, ANN202
    """Eq. 2 summed over views, 1 / (d^2 + bound), and its gradient with respect to the means (masks, width)."""
    total = 0.0
    gradient = np.zeros_like(means)
    for view in range(len(first) - 1):
        begin, count = first[view], first[view + 1] - first[view]
        if count < 2:
            continue
        near = np.zeros(count)
        for i in range(begin, begin + count):
            # 1 / (d_ij^2 + bound) for all other masks j.
            for j in range(begin, begin + count):
                square = 0.0
                for c in range(means.shape[1]):
                    square += (means[i, c] - means[j, c]) ** 2
                near[j - begin] = 1.0 / (square + bound) if j != i else 0.0
            # Both orders of a pair are summed, as printed, and each moves both means. Derivative with respect to d^2:
            # -1 / (d^2 + bound)^2; of d^2 with respect to a mean: twice the difference.
            for j in range(begin, begin + count):
                part = near[j - begin] * (1.0 / (count * (count - 1)))
                total += part
                slope = -2.0 * part * near[j - begin]
                for c in range(means.shape[1]):
                    turn = slope * (means[i, c] - means[j, c])
                    gradient[i, c] += turn
                    gradient[j, c] -= turn
    return total, gradient
