"""OpenGaussian as published (paper, Sec. 3.1 and 3.2): features and codebook trained by rendering, one view a step.

The reference for the fast forms (instance_features.py, codebook.py), in error and in time. A step picks a random view,
renders the feature map ``M = W F`` with its frozen blending weights, computes the losses on its pixels, and updates all
features with Adam. ``formula`` chooses between the printed equations and what the authors' code computes:

    Eq. 1    paper: squares summed over the pixels of all masks, divided by the mean number of masked pixels per view.
             authors: distances not squared, mean over a mask's pixels, then over masks.
    Eq. 2    paper: mean of 1 / d^2. authors: 1 / (d^2 + 1), each row weighted 0.1 to 1 by rank of nearness; after
             LATE_STEP only the nearest tenth keeps its weight, the others the least.
    Eq. 4    paper: L1 between the map of cluster centers and that of the features of stage 1, over the image.
             authors: the target is each mask's mean painted back, L1 in the coarse stage, squares in the fine one;
             masks of mixed features are left out, here and in the association; in some steps all Gaussians are drawn
             smaller, so that hidden ones show and features become right per point, not only per blend; each step of
             the fine stage draws one coarse cluster alone.
    Eq. 3    paper: clusters of features as read. authors: of the raw vectors, so that position counts relative to
             their length.

docs/paper.md lists all numbers of both beside ours. Defects of the published code are fixed: centers follow their
clusters at every step, not only when points are reassigned; fine centers start inside their coarse cluster, and empty
ones restart elsewhere in it; pixels without a mask are not targets; points that no mask shows get no cluster.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from og_pointcloud.errors import naming_extra
from og_pointcloud.fitting.grouping import indicator
from og_pointcloud.fitting.learned.codebook import kmeans
from og_pointcloud.fitting.learned.matching import filled_masks
from og_pointcloud.fitting.learned.rendered_views import RenderedView, RenderedViews
from og_pointcloud.fitting.mask_table import view_fingerprint, weights_by_instance
from og_pointcloud.fitting.work_folder import WorkFolder, fingerprint
from og_pointcloud.settings import PaperSettings

with naming_extra("torch", "learn"):
    import torch

STEPS = {"scannet": (20_000, 20_000, 20_000), "lerf": (10_000, 10_000, 20_000)}
"""Steps of the features, the coarse and the fine codebook stage (the authors' code; the sums are the paper's)."""
LATE_STEP = 5_000
"""From this step on, times schedule_share, the authors' Eq. 2 concentrates on the nearest pairs."""
LEAST_WEIGHT = 0.1
"""Weight of a mask's farthest pair in the authors' Eq. 2; the nearest weighs 1."""
LATE_RANK = 0.9
"""Late in training, pairs that weigh less than this weigh LEAST_WEIGHT."""
SMALLEST_DISTANCE = 1e-4
"""Added in quadrature to the distances of the printed Eq. 2: two equal means would give infinity."""
ROUNDING = 1e-3
"""Distances that are not squared are smoothed at zero by this radius: sqrt(d^2 + ROUNDING^2)."""
ADAM_EPSILON = 1e-15
"""As in 3DGS: one Gaussian's share of the gradient of a mean over pixels is small compared with the usual 1e-8."""
OWN_MASK_SHARE = 0.2
"""A coarse cluster holds a mask when it has more than this share of the mask's blended weight."""
SIZES = 8
"""Shrunken Gaussians have one of this many sizes, evenly spread over 0 to 1 (the authors: any size): few enough for the
weights of each to be kept."""
CURVE_POINTS = 200
"""Points of a stage's loss curve in the provenance."""
RECENT = 100
"""The reported loss is the mean over this many last steps, since each sees another view."""
CHECKPOINT_SECONDS = 60.0
"""The training state is written to the work folder this often."""


@dataclass(frozen=True)
class TrainingRun:
    """How the stages run. seed: of the start and of the views drawn.

    progress: called after every step with the stage's name, the step's number, the number of steps, and the mean of the
    last losses. work: keeps checkpoints. Training that was killed and restarted with the same folder, scene, settings
    and seed continues from the last one, and ends bit-identical to an uninterrupted run. None: nothing is kept.
    """

    seed: int = 0
    progress: Callable[[str, int, int, float], None] | None = None
    work: WorkFolder | None = None


@dataclass
class StageHistory:
    """A stage's cost and losses. published_steps: steps at schedule_share 1. seconds: of all steps done. loss: one
    number per step done. resumed_at: the step that an earlier run had reached, 0 if there was none."""

    name: str
    published_steps: int
    seconds: float = 0.0
    loss: list[float] = field(default_factory=list)
    resumed_at: int = 0

    @property
    def steps(self) -> int:
        """Steps done."""
        return len(self.loss)

    @property
    def published_seconds(self) -> float:
        """Seconds that the stage would take at its published number of steps."""
        return self.published_steps * self.seconds / max(self.steps, 1)

    def to_dict(self) -> dict[str, Any]:
        """For the cloud's provenance. loss: means of at most CURVE_POINTS equal stretches of the stage."""
        stretches = np.array_split(np.array(self.loss), min(CURVE_POINTS, max(self.steps, 1)))
        return {
            "stage": self.name,
            "steps": self.steps,
            "resumed_at": self.resumed_at,
            "published_steps": self.published_steps,
            "seconds": round(self.seconds, 3),
            "published_seconds": round(self.published_seconds, 1),
            "loss": [float(f"{stretch.mean():.4g}") for stretch in stretches],
        }


@dataclass(frozen=True)
class TrainedFeatures:
    """raw: (n, width) float32 as trained, and features: as read; both zero where unseen. seen: (n,) float64, pixels of
    blending weight in masks; 0: the feature was never trained."""

    raw: NDArray[np.float32]
    features: NDArray[np.float32]
    seen: NDArray[np.float64]
    history: StageHistory


@dataclass(frozen=True)
class TrainedCodebook:
    """leaf: (n,) int32, ``coarse * k2 + fine``, coarse in 0..k1-1; -1 where no mask shows the point. centers: (k1 k2,
    width) float32; rows of leaves without Gaussians are zero. histories: coarse and fine stage."""

    leaf: NDArray[np.int32]
    centers: NDArray[np.float32]
    histories: tuple[StageHistory, StageHistory]


def train_features(source: RenderedViews, settings: PaperSettings, run: TrainingRun | None = None) -> TrainedFeatures:
    """Stage 1: features of all Gaussians, from random ones in [0, 1], by Eq. 1 and 2 of one random view per step.

    source: only the pixels in masks.
    """
    run = run or TrainingRun()
    random = np.random.default_rng(run.seed).random((len(source.gaussians), settings.width), np.float32)
    trained = torch.tensor(random[source.known], device=source.device)
    key = _training_key(source, settings, run)
    history = StageHistory("features", STEPS[settings.schedule][0])
    stage = _Stage(history, trained, settings.feature_rate)
    late = LATE_STEP * settings.schedule_share
    for step, rng in stage.steps(settings, run, key):
        view = source[int(rng.integers(len(source)))]
        image = view.render(_read(trained, settings.normalize))
        separation, cohesion = view_losses(image, view.mask, settings, late=step >= late)
        # The printed Eq. 1 is a sum over pixels: scaled so that its weight means the same at any image size.
        scale = 1 if settings.formula == "authors" else 1 / source.masked_pixels
        loss = settings.inter * separation + settings.intra * settings.cohesion_weight * scale * cohesion
        stage.adam.zero_grad(set_to_none=True)
        loss.backward()
        stage.adam.step()
        history.loss.append(loss.item())
    raw, features = np.zeros_like(random), np.zeros_like(random)
    raw[source.known] = _on_host(trained)
    features[source.known] = _on_host(_read(trained.detach(), settings.normalize))
    return TrainedFeatures(raw, features, source.seen, history)


def view_losses(
    image: torch.Tensor, mask: torch.Tensor, settings: PaperSettings, *, late: bool = False
) -> tuple[torch.Tensor, torch.Tensor]:
    """Eq. 2 and Eq. 1 of one view. image: (pixels, width) rendered features of the pixels in masks. mask: (pixels,)
    int64, their masks 0..m-1, each at least once. Eq. 1 of formula "paper" is the sum over pixels, as printed."""
    pixels = torch.bincount(mask)
    means = _mask_means(image, mask, pixels)
    square = (image - means.index_select(0, mask)).square().sum(dim=1)  # indexing has a much slower gradient
    if settings.formula == "authors":
        distance = (square + ROUNDING**2).sqrt()  # the distance itself has no gradient at zero
        cohesion = _mask_means(distance[:, None], mask, pixels).mean()
    else:
        cohesion = square.sum()
    return _separation(means, settings.formula, late), cohesion


def _mask_means(values: torch.Tensor, mask: torch.Tensor, pixels: torch.Tensor) -> torch.Tensor:
    """(masks, width) means of values (pixels, width). pixels: (masks,) the number in each mask."""
    return values.new_zeros((len(pixels), values.shape[1])).index_add(0, mask, values) / pixels[:, None]


def _separation(means: torch.Tensor, formula: str, late: bool) -> torch.Tensor:
    """Eq. 2 of one view from the means of its masks (m, width)."""
    m = len(means)
    if m < 2:
        return means.sum() * 0  # not a plain 0, which has no gradient
    square = (means[:, None] - means[None]).square().sum(dim=2)
    near = 1 / (square + (1.0 if formula == "authors" else SMALLEST_DISTANCE**2))
    near = near * (1 - torch.eye(m, dtype=means.dtype, device=means.device))
    if formula == "authors":
        # Rank of nearness within a row, by two argsorts: the mask itself 0, the farthest other 1, the nearest m - 1.
        rank = near.detach().argsort(dim=1, stable=True).argsort(dim=1).to(means.dtype)
        weight = LEAST_WEIGHT + (1 - LEAST_WEIGHT) * rank / (m - 1)
        if late:
            weight = torch.where(weight < LATE_RANK, LEAST_WEIGHT, weight)
        near = near * weight
    return near.sum() / (m * (m - 1))


def train_codebook(
    source: RenderedViews, raw: NDArray[np.float32], settings: PaperSettings, run: TrainingRun | None = None
) -> TrainedCodebook:
    """Stage 2: a coarse codebook of features and positions, then a fine one of features inside each coarse cluster.

    source: all pixels with formula "paper", else only those in masks. raw: (n, width), of stage 1, not yet read. A step
    renders cluster centers in place of features, computes Eq. 4, and moves each feature by the gradient at its center
    (straight-through estimator). Positions are in scene units, as published.
    """
    run = run or TrainingRun()
    rng = np.random.default_rng(run.seed)
    gaussians, known = source.gaussians, source.known
    training = _CodebookTraining(source, torch.tensor(raw[known], device=source.device), settings)
    start = _on_host(training.features)
    key = _training_key(source, settings, run, raw)

    # Coarse: all known Gaussians as one part, clustered by features and positions from k1 of them at random.
    coarse = StageHistory("coarse codebook", STEPS[settings.schedule][1])
    places = settings.position_weight * gaussians.xyz[known]
    assert settings.k1 is not None, "the number of coarse clusters is the caller's to find"
    k1 = settings.k1
    first = rng.permutation(len(known))[:k1]
    centers = np.concatenate([start[first], places[first]], axis=1)
    together = _Parts([np.arange(len(known))], [len(centers)], places)
    own, _ = training.train(coarse, centers, together, run, key)

    # Fine: each coarse cluster is a separate part, clustered by features alone from some of its own Gaussians.
    members = [np.flatnonzero(own == cluster) for cluster in range(len(centers))]
    source.forget_clusters()
    held = _masks_held(source, own, len(centers))
    seeds = [rng.permutation(rows)[:count] for rows, count in zip(members, _fine_counts(held, settings), strict=True)]
    fine = StageHistory("fine codebook", STEPS[settings.schedule][2])
    fine_centers = _on_host(training.features)[np.concatenate(seeds)]
    apart = _Parts(members, [len(rows) for rows in seeds], np.zeros((len(known), 0), np.float32), held)
    own_fine, fine_centers = training.train(fine, fine_centers, apart, run, key)
    # Leaf numbers leave room for k2 in every coarse cluster, as published.
    leaf_of_center = np.concatenate([c * settings.k2 + np.arange(len(rows)) for c, rows in enumerate(seeds)])
    leaf = np.full(len(gaussians), -1, np.int32)
    leaf[known] = leaf_of_center[own_fine]
    table = np.zeros((k1 * settings.k2, raw.shape[1]), np.float32)
    table[leaf_of_center] = training.read(torch.as_tensor(fine_centers, device="cpu")).numpy()
    return TrainedCodebook(leaf, table, (coarse, fine))


@dataclass(frozen=True)
class _Parts:
    """Parts of the known Gaussians that are clustered separately.

    rows, counts: for each part, its rows of the known Gaussians and its number of clusters. places: (known, 3 or 0),
    clustered with the features but not rendered. held: for each view (masks, parts) bool, the masks that a part holds;
    None in the coarse stage, whose only part is never drawn alone.
    """

    rows: list[NDArray[np.int64]]
    counts: list[int]
    places: NDArray[np.float32]
    held: list[NDArray[np.bool_]] | None = None

    def reassigned(
        self, features: NDArray[np.float32], centers: NDArray[np.float32], rounds: int
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Every point's nearest center in its part after some rounds of Lloyd's algorithm, and the centers."""
        # Centers of all parts are in one array, part by part; ``first`` is where a part's centers begin.
        values = np.concatenate([features, self.places], axis=1)
        own, centers, first = np.zeros(len(values), np.int64), centers.copy(), 0
        for rows, count in zip(self.rows, self.counts, strict=True):
            if count:
                mine = slice(first, first + count)
                found, centers[mine] = kmeans(values[rows], np.ones(len(rows)), centers[mine], rounds)
                own[rows] = first + found
            first += count
        return own, centers


class _CodebookTraining:
    """Trains features through their cluster centers; both codebook stages use it."""

    def __init__(self, source: RenderedViews, raw: torch.Tensor, settings: PaperSettings) -> None:
        self.source, self.settings = source, settings
        # The target of Eq. 4 is rendered from the features of stage 1 (the paper's pseudo features): it never changes.
        self.pseudo = _read(raw, settings.normalize)
        # Clusters of raw vectors have raw centers, which are read at each rendering; else all are read once, here.
        self.reads_centers = settings.normalize and settings.cluster_raw
        self.features = raw if self.reads_centers else self.pseudo.clone()
        self.targets: dict[int, tuple[torch.Tensor, torch.Tensor]] = {}  # by view, made when needed

    def read(self, values: torch.Tensor) -> torch.Tensor:
        """Features or centers as they are rendered."""
        return _read(values, self.reads_centers)

    def train(
        self, history: StageHistory, centers: NDArray[np.float32], parts: _Parts, run: TrainingRun, key: str
    ) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """Train until the stage's steps are done; the center of each known Gaussian, and the centers (k, width)."""
        settings, features, width = self.settings, self.features, self.features.shape[1]
        is_fine = parts.held is not None
        interval = settings.fine_interval if is_fine else settings.coarse_interval
        rate = settings.fine_rate if is_fine else settings.coarse_rate
        squared = is_fine and settings.formula == "authors"
        stage = _Stage(history, features, rate, centers)
        for step, rng in stage.steps(settings, run, key):
            if step % interval == 0:
                stage.reassign(parts, settings.lloyd_rounds)
            view, target, rows = self._draw(rng, parts)
            quantized = stage.centers[:, :width][stage.own].requires_grad_()
            # Eq. 4; its gradient with respect to the centers is passed straight through to the features.
            error = view.render(self.read(quantized))[rows] - target
            loss = error.square().mean() if squared else error.abs().mean()
            (features.grad,) = torch.autograd.grad(loss, quantized)
            stage.adam.step()
            # The published code moves centers at reassignments only; here they follow their features at every step.
            stage.centers[:, :width] = _cluster_means(features.detach(), stage.own, stage.centers[:, :width])
            history.loss.append(loss.item())
        features.requires_grad_(False)
        stage.reassign(parts, settings.lloyd_rounds)
        return _on_host(stage.own).astype(np.int32), _on_host(stage.centers[:, :width])

    def _draw(self, rng: np.random.Generator, parts: _Parts) -> tuple[RenderedView, torch.Tensor, torch.Tensor | slice]:
        """A random view, perhaps with smaller Gaussians or one part alone; what its pixels should show, and which of
        its pixels count."""
        index = int(rng.integers(len(self.source)))
        view = self.source[index]
        if self.settings.formula == "paper":
            return view, view.render(self.pseudo), slice(None)
        # The authors' target: each mask painted with its mean. Targets do not change, so they are kept.
        if index not in self.targets:
            image = view.render(self.pseudo)
            means, kept = filled_masks(_on_host(image), _on_host(view.mask), len(view.mask_names))
            self.targets[index] = image.new_tensor(means), torch.tensor(kept, device=image.device)
        means, kept = self.targets[index]
        # The middle of one of SIZES equal stretches of 0 to 1.
        factor = (int(SIZES * rng.random()) + 0.5) / SIZES if rng.random() < self.settings.point_pressure else 1.0
        part, members = -1, None
        if self.settings.fine_alone and parts.held is not None and parts.held[index].any():
            choices = np.flatnonzero(parts.held[index].any(axis=0))
            part = int(choices[rng.integers(len(choices))])
            members, kept = parts.rows[part], kept & torch.tensor(parts.held[index][:, part], device=kept.device)
        drawn = self.source.drawn(index, factor, part, members)
        # The mask of the full view that each drawn pixel is in: the drawn view may have fewer masks.
        place = torch.searchsorted(view.mask_names, drawn.mask_names)[drawn.mask]
        if not kept[place].any():  # no pixel of a target is covered any more
            drawn, place, kept = view, view.mask, self.targets[index][1]
        rows = kept[place]
        return drawn, means[place][rows], rows


def _cluster_means(features: torch.Tensor, own: torch.Tensor, centers: torch.Tensor) -> torch.Tensor:
    """Means of the clusters' features; an empty cluster stays where it is."""
    points = torch.bincount(own, minlength=len(centers))[:, None]
    sums = torch.zeros_like(centers).index_add_(0, own, features)
    return torch.where(points > 0, sums / points.clamp(min=1), centers)


def _masks_held(source: RenderedViews, own: NDArray[np.int32], k1: int) -> list[NDArray[np.bool_]]:
    """For each view (masks, k1) bool: the masks that each coarse cluster holds."""
    held = []
    for view in source:
        of_masks = csr_array(indicator(_on_host(view.mask), len(view.mask_names)) @ view.weights)
        held.append(weights_by_instance(of_masks, own, k1) > OWN_MASK_SHARE * of_masks.sum(axis=1)[:, None])
    return held


def _fine_counts(held: list[NDArray[np.bool_]], settings: PaperSettings) -> list[int]:
    """Fine clusters of each coarse one: k2; by formula "authors" at most one more than the masks it holds in a view."""
    most = np.max([of_view.sum(axis=0) for of_view in held], axis=0)
    return [settings.k2 if settings.formula == "paper" else int(min(count + 1, settings.k2)) for count in most]


class _Read(torch.autograd.Function):
    """Directions mapped to [0, 1] (`instance_features.read_features`). torch's own gradient would take most of the time
    of a step."""

    @staticmethod
    def forward(ctx: Any, raw: torch.Tensor) -> torch.Tensor:
        length = raw.norm(dim=1, keepdim=True)
        length.masked_fill_(length == 0, torch.inf)  # a zero row reads 0.5, with zero gradient
        direction = raw / length
        ctx.save_for_backward(direction, length)
        return torch.add(0.5, direction, alpha=0.5)

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> torch.Tensor:  # pyright: ignore
        direction, length = ctx.saved_tensors
        # The derivative of x / |x| keeps the part of the gradient perpendicular to x, divided by |x|.
        along = (direction * gradient).sum(dim=1, keepdim=True)
        return torch.addcmul(gradient, direction, along, value=-1).mul_(0.5 / length)


def _read(raw: torch.Tensor, normalize: bool) -> torch.Tensor:
    """Features as rendered; raw ones are read as they are."""
    return _Read.apply(raw) if normalize else raw


def _on_host(values: torch.Tensor) -> NDArray[Any]:
    """The values in numpy; on a CPU they share memory."""
    return values.detach().cpu().numpy()


def _training_key(source: RenderedViews, settings: PaperSettings, run: TrainingRun, *more: Any) -> str:
    """A fingerprint of everything that the result of a stage depends on; empty where nothing is kept."""
    if run.work is None:
        return ""
    drawn = source.gaussians
    shapes = drawn.xyz, drawn.scale, drawn.rotation, drawn.opacity, source.near
    views = (view_fingerprint(view, view.mask_map()) for view in source.views)
    return fingerprint(*shapes, *views, settings, run.seed, *more)


class _Stage:
    """Everything that a training stage changes, and therefore everything in a checkpoint.

    features: (known, width) float32, updated in place by ``adam``. centers, own: in a codebook stage, (k, d) float32
    and (known,) int64, each Gaussian's row of centers, on the features' device.
    """

    def __init__(
        self, history: StageHistory, features: torch.Tensor, rate: float, centers: NDArray[np.float32] | None = None
    ) -> None:
        self.history, self.features = history, features
        self.adam = torch.optim.Adam([features.requires_grad_()], lr=rate, eps=ADAM_EPSILON, fused=True)
        centers = np.zeros((0, 0), np.float32) if centers is None else centers
        self.centers = torch.tensor(centers, device=features.device)
        self.own = torch.zeros(len(features), dtype=torch.int64, device=features.device)

    def reassign(self, parts: _Parts, rounds: int) -> None:
        """Reassign Gaussians to centers by `_Parts.reassigned`, on the host."""
        own, centers = parts.reassigned(_on_host(self.features), _on_host(self.centers), rounds)
        device = self.features.device
        self.own, self.centers = torch.as_tensor(own, device=device), torch.as_tensor(centers, device=device)

    def steps(self, settings: PaperSettings, run: TrainingRun, key: str) -> Iterator[tuple[int, np.random.Generator]]:
        """The numbers of the remaining steps, each with its own random generator: seeded by step and stage, so that it
        does not matter whether this run did the steps before. Times and reports each step, and saves the state under
        the key now and then."""
        history = self.history
        count = max(1, round(history.published_steps * settings.schedule_share))
        name, kept_at = history.name.replace(" ", "-"), time.monotonic()
        if run.work is not None:
            self._restore(run.work.arrays(name, key, self._arrays))
        for step in range(history.steps, count):
            start = time.perf_counter()
            yield step, np.random.default_rng([run.seed, step, *name.encode()])
            history.seconds += time.perf_counter() - start
            is_due = step + 1 == count or time.monotonic() - kept_at >= CHECKPOINT_SECONDS
            if run.work is not None and is_due:
                run.work.replace(name, key, self._arrays())
                kept_at = time.monotonic()
            if run.progress:
                run.progress(history.name, step + 1, count, float(np.mean(history.loss[-RECENT:])))

    def _arrays(self) -> tuple[NDArray[Any], ...]:
        """A checkpoint: features, Adam's two moments, centers, own; then the seconds followed by the losses."""
        state, features = self.adam.state.get(self.features), self.features.detach()
        moments = (state["exp_avg"], state["exp_avg_sq"]) if state else (torch.zeros_like(features),) * 2
        losses = np.array([self.history.seconds, *self.history.loss])
        return *(_on_host(tensor).copy() for tensor in (features, *moments, self.centers, self.own)), losses

    def _restore(self, arrays: tuple[NDArray[Any], ...]) -> None:
        """Continue from a checkpoint (`_arrays`). Adam's step count is the number of losses."""
        *tensors, losses = arrays
        device = self.features.device
        features, average, square, self.centers, self.own = (torch.tensor(array, device=device) for array in tensors)
        self.features.data.copy_(features)
        self.history.seconds, *self.history.loss = losses.tolist()
        done = self.history.resumed_at = len(self.history.loss)
        steps = torch.tensor(float(done), device=device)
        self.adam.state[self.features] = {"step": steps, "exp_avg": average, "exp_avg_sq": square}
