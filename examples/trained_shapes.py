"""Opacity and size of Gaussians trained with the mask losses, positions frozen: the paper's first limitation, tested.

A row of `benchmark_paper.py`, not part of the library: docs/paper.md has the results. A step draws a view anew, as its
blending weights change, and the gradient is propagated back through the blending. For a pixel
``M = sum_i T_i a_i f_i`` with ``T_i = prod_{j<i} (1 - a_j)``, nearest first,

    dM / da_i = T_i f_i - (sum_{j>i} T_j a_j f_j) / (1 - a_i)

and for ``a = o exp(-q / 2)``, ``q = d' C^-1 d``, ``C = s^2 C0 + LOW_PASS I`` at an offset d from the splat's center

    da / do = a / o        da / dlog s = a (q - LOW_PASS |C^-1 d|^2)
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.fitting.learned.instance_features import read_features
from og_pointcloud.fitting.learned.paper import ADAM_EPSILON, LATE_STEP, STEPS, view_losses
from og_pointcloud.fitting.learned.rendered_views import RenderedView, RenderedViews
from og_pointcloud.kernels import njit
from og_pointcloud.rendering.splatting import ALPHA_MAX, LOW_PASS, Gaussians, binned_splats
from og_pointcloud.settings import PaperSettings

OPACITY_RATE, SIZE_RATE = 2e-3, 4e-4
"""Adam's learning rates for opacity logits and logarithms of sizes: the best of five pairs on room-0 and table-0."""


def train_with_shapes(
    source: RenderedViews, settings: PaperSettings, seed: int
) -> tuple[NDArray[np.float32], NDArray[np.float32], RenderedViews]:
    """Stage 1 of mode paper with shapes: raw features (n, width), the same as read, and the new Gaussians' views."""
    base, near = source.gaussians, source.near
    opacity = torch.from_numpy(np.clip(base.opacity, 1e-3, 1 - 1e-3))
    shapes = {OPACITY_RATE: torch.logit(opacity).requires_grad_(), SIZE_RATE: torch.zeros(len(base)).requires_grad_()}
    raw = torch.from_numpy(np.random.default_rng(seed).random((len(base), settings.width), np.float32)).requires_grad_()
    groups = [{"params": [raw], "lr": settings.feature_rate}, *({"params": [p], "lr": r} for r, p in shapes.items())]
    adam = torch.optim.Adam(groups, eps=ADAM_EPSILON)
    logit, log_size = shapes.values()
    for step in range(max(1, round(STEPS[settings.schedule][0] * settings.schedule_share))):
        rng = np.random.default_rng([seed, step, *b"features"])
        view = source.views[int(rng.integers(len(source)))]
        try:
            drawn = RenderedViews(reshaped(base, logit, log_size), [view], near, settings, whole=False)
        except SceneError:  # no mask of the view is covered any more
            continue
        read = 0.5 + 0.5 * torch.nn.functional.normalize(raw, dim=1)
        image = _Drawn.apply(read, logit, log_size, drawn)
        separation, cohesion = view_losses(
            image, drawn[0].mask, settings, late=step >= LATE_STEP * settings.schedule_share
        )
        adam.zero_grad(set_to_none=True)
        (separation + settings.cohesion_weight * cohesion).backward()
        adam.step()
    trained = RenderedViews(reshaped(base, logit, log_size), source.views, near, settings, whole=False)
    features = np.zeros((len(base), settings.width), np.float32)
    features[trained.known] = read_features(raw.detach().numpy()[trained.known])
    return raw.detach().numpy(), features, trained


def reshaped(base: Gaussians, logit: torch.Tensor, log_size: torch.Tensor) -> Gaussians:
    """The Gaussians with other opacities (n,), logits, and all axes longer by a factor (n,), its logarithm."""
    size = log_size.detach().exp().numpy()[:, None]
    return replace(base, scale=base.scale * size, opacity=torch.sigmoid(logit.detach()).numpy())


class _Drawn(torch.autograd.Function):
    """(pixels, width) of values (n, width) as the only view of ``drawn`` shows them."""

    @staticmethod
    def forward(
        ctx: Any, values: torch.Tensor, _logit: torch.Tensor, _log_size: torch.Tensor, drawn: RenderedViews
    ) -> torch.Tensor:
        ctx.drawn = drawn
        ctx.save_for_backward(values)
        return torch.from_numpy(drawn[0].weights @ values.numpy()[drawn.known])

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:  # pyright: ignore
        (values,), drawn, pull = ctx.saved_tensors, ctx.drawn, gradient.contiguous().numpy()
        known, opacity = drawn.known, drawn.gaussians.opacity
        of_values = torch.zeros_like(values)
        of_values[known] = torch.from_numpy(drawn[0].weights.T @ pull)
        of_opacity, of_size = shape_gradient(drawn, drawn[0], values.numpy()[known], pull)
        of_logit = of_opacity * opacity * (1 - opacity)
        return of_values, torch.from_numpy(of_logit).float(), torch.from_numpy(of_size).float(), None


def shape_gradient(
    source: RenderedViews, view: RenderedView, values: NDArray[np.floating], pull: NDArray[np.floating]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Gradients with respect to opacities and log sizes, (n,) each, of a loss with gradient ``pull`` (pixels, c) at
    the image of values (known, c).

    view: of a source of this one view. Cut-offs of the blending have no gradient.
    """
    gaussians, camera = source.gaussians, source.views[0].camera
    splats, *_ = binned_splats(gaussians, camera, source.near, None)
    found = np.zeros((2, len(source.known)))
    sparse = view.weights.indptr, view.weights.indices, view.weights.data
    shown, place = source.known, np.zeros(len(gaussians), np.int64)
    place[splats["gaussian"]] = np.arange(len(splats))
    splats, opacity = splats[place[shown]], gaussians.opacity[shown]
    _add_gradient(sparse, view.pixels, camera.width, values, pull, splats, opacity, found)
    whole = np.zeros((2, len(gaussians)))
    whole[:, shown] = found
    return whole[0], whole[1]


@njit(cache=True, nogil=True)
def _add_gradient(sparse, pixels, width, values, pull, splats, opacity, found):  # noqa: ANN001, ANN202
    """Add to found (2, known) the gradients by opacity and log size. Entries of a pixel are nearest first."""
    indptr, indices, weights = sparse
    log2_density = 2 * np.log(2.0)  # splats hold the log2 of the density, which is -q / 2
    for row in range(len(pixels)):
        x, y = pixels[row] % width + 0.5, pixels[row] // width + 0.5
        entries = range(indptr[row], indptr[row + 1])
        behind = 0.0  # gradient of everything behind the entry
        for e in entries:
            behind += weights[e] * (pull[row] * values[indices[e]]).sum()
        light = 1.0  # T of the entry: light that those before it let through
        for e in entries:
            g, weight = indices[e], np.float64(weights[e])
            own = (pull[row] * values[g]).sum()
            behind -= weight * own
            alpha = weight / light
            by_alpha = light * own - behind / (1.0 - alpha)
            light -= weight
            if alpha > ALPHA_MAX * (1 - 1e-6):  # clipped there: no gradient
                continue
            s = splats[g]
            # -log2 of the density is (across (dx + shear dy))^2 + down dy^2.
            dy, square = y - s.v, np.float64(s.across) ** 2
            slanted = x - s.u + s.shear * dy
            q = log2_density * (square * slanted * slanted + s.down * dy * dy)
            cx, cy = log2_density * square * slanted, log2_density * (square * s.shear * slanted + s.down * dy)
            found[0, g] += by_alpha * alpha / opacity[g]
            found[1, g] += by_alpha * alpha * (q - LOW_PASS * (cx * cx + cy * cy))
