"""The gradients by which made scenes get a trained 3DGS, against the literal blending in float64."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from og_pointcloud_zoo import trained  # noqa: E402 - needs torch

WIDTH, HEIGHT = 20, 18  # more than one tile


def _splats(rng: np.random.Generator, count: int) -> np.ndarray:
    """(count, 9): center, conic, opacity, color."""
    center = rng.uniform((0, 0), (WIDTH, HEIGHT), (count, 2))
    spread = rng.uniform(1.5, 5, (count, 2))
    conic = np.stack([1 / spread[:, 0] ** 2, rng.uniform(-0.02, 0.02, count), 1 / spread[:, 1] ** 2], axis=1)
    return np.concatenate([center, conic, rng.uniform(0.2, 0.9, (count, 1)), rng.random((count, 3))], axis=1)


def _literal_loss(splats: torch.Tensor, image: np.ndarray) -> torch.Tensor:
    rows, columns = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    light, color = torch.ones(HEIGHT, WIDTH, dtype=torch.float64), torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.float64)
    for x, y, a, b, c, opacity, *rgb in splats:  # in the order of their depth
        u, v = columns - x, rows - y
        q = (a * u * u + c * v * v) / 2 + b * u * v
        alpha = opacity * torch.exp(-q)
        alpha = torch.where((q > trained.REACH**2 / 2 + 1) | (alpha < 1 / 255), 0, alpha)
        color = color + (light * alpha)[..., None] * torch.stack(rgb)
        light = light * (1 - alpha)
    return (color + trained.BEHIND * light[..., None] - torch.from_numpy(image)).abs().mean()


def test_gradients_are_those_of_the_literal_blending() -> None:
    rng = np.random.default_rng(3)
    splats, image = _splats(rng, 12), rng.random((HEIGHT, WIDTH, 3))
    literal = torch.from_numpy(splats).requires_grad_()
    loss = _literal_loss(literal, image)
    loss.backward()

    single = splats.astype(np.float32)
    everywhere = np.full((12, 2), 100, np.float32)  # in all tiles: what is drawn decides where a splat shows
    start, members = trained._binned(np.arange(12), np.ones(12, np.float32), single, everywhere, WIDTH, HEIGHT)
    found, gradient, shown = trained._gradients(single, start, members, image.astype(np.float32))

    assert shown.all()
    assert found == pytest.approx(float(loss.detach()), rel=1e-5)
    scale = np.abs(literal.grad.numpy()).max(axis=0)
    np.testing.assert_allclose(gradient / scale, literal.grad.numpy() / scale, atol=2e-3)
