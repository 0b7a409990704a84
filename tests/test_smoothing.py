"""Positions at which noisy points are drawn: nearer to their surface, by what noise explains and no more."""

from __future__ import annotations

import literal
import numpy as np
import pytest
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from og_pointcloud.rendering.geometry import Neighborhood, neighborhood
from og_pointcloud.rendering.smoothing import NOISE_BIAS, NOISE_NEIGHBORS, smoothed
from og_pointcloud.settings import GeometrySettings

Cloud = NDArray[np.float32]


def around(xyz: Cloud, neighbors: int = 24) -> Neighborhood:
    return neighborhood(xyz, GeometrySettings(neighbors=neighbors))


def wall(random: Generator, noise: float, n: int = 3000) -> Cloud:
    """A wall of points about one apart, in the plane z = 0 but for noise."""
    side = np.sqrt(n)
    plane = random.uniform(0, side, (n, 2))
    return np.column_stack([plane, random.normal(0, noise, n)]).astype(np.float32)


def inside(xyz: Cloud) -> NDArray[np.bool_]:
    """Points of a wall that are not at its rim, where neighbors lie to one side."""
    low, high = xyz[:, :2].min() + 4, xyz[:, :2].max() - 4
    return ((xyz[:, :2] > low) & (xyz[:, :2] < high)).all(axis=1)


@pytest.mark.parametrize("neighbors", [NOISE_NEIGHBORS + 1, 24])
@pytest.mark.parametrize("flat", [1.0, 0.1, 1e-3])
def test_points_move_as_the_literal_reference_has_it(flat: float, neighbors: int) -> None:
    random = np.random.default_rng(0)
    xyz = (random.normal(size=(400, 3)) * [1, 1, flat]).astype(np.float32)
    near = around(xyz, neighbors)
    found = smoothed(xyz, near)
    np.testing.assert_allclose(found, literal.smoothed(xyz, near.index, NOISE_NEIGHBORS, NOISE_BIAS), atol=1e-5)
    assert np.linalg.norm(found - xyz, axis=1).max() > 0.1 * flat


@pytest.mark.parametrize(("noise", "left"), [(0.3, 0.75), (0.5, 0.75), (1.0, 0.9)])
def test_noise_across_a_wall_falls(noise: float, left: float) -> None:
    xyz = wall(np.random.default_rng(1), noise)
    moved = smoothed(xyz, around(xyz))[inside(xyz)]
    assert moved[:, 2].std() < left * noise
    assert abs(moved[:, 2].mean()) < 0.1 * noise


def test_a_sheet_without_noise_stays() -> None:
    xyz = wall(np.random.default_rng(2), 0.0)
    np.testing.assert_allclose(smoothed(xyz, around(xyz)), xyz, atol=1e-5)


def test_a_bend_is_no_noise() -> None:
    """Points of a pipe of two spacings' radius would be drawn inwards by a third of one if all of it were noise."""
    random = np.random.default_rng(3)
    turn, along = random.uniform(0, 2 * np.pi, 2500), random.uniform(0, 200, 2500)
    radius = 2.0
    xyz = np.column_stack([radius * np.cos(turn), radius * np.sin(turn), along]).astype(np.float32)
    inwards = radius - np.linalg.norm(smoothed(xyz, around(xyz))[:, :2], axis=1)
    full = radius - np.linalg.norm(literal.smoothed(xyz, around(xyz).index, NOISE_NEIGHBORS, np.inf)[:, :2], axis=1)
    assert np.median(inwards) < 0.5 * np.median(full)


def test_moves_follow_turns_offsets_units_and_order() -> None:
    random = np.random.default_rng(4)
    xyz = wall(random, 0.4, 800)
    moved = smoothed(xyz, around(xyz))
    turn = Rotation.random(random_state=5).as_matrix()
    turned = (xyz @ turn.T + [3, -2, 1]).astype(np.float32)
    np.testing.assert_allclose(smoothed(turned, around(turned)), moved @ turn.T + [3, -2, 1], atol=1e-3)
    for unit in (1e-12, 1e12):
        scaled = (unit * xyz).astype(np.float32)
        np.testing.assert_allclose(smoothed(scaled, around(scaled)) / unit, moved, atol=1e-4)
    order = random.permutation(len(xyz))
    np.testing.assert_allclose(smoothed(xyz[order], around(xyz[order])), moved[order], atol=1e-5)


@pytest.mark.parametrize("kind", ["few", "one place", "on a line", "in two places"])
def test_points_without_a_plane_stay(kind: str) -> None:
    xyz = np.zeros((60, 3), np.float32)
    if kind == "few":
        xyz = np.random.default_rng(6).normal(size=(NOISE_NEIGHBORS + 1, 3)).astype(np.float32)
    elif kind == "on a line":
        xyz[:, 1] = np.arange(60)
    elif kind == "in two places":
        xyz[30:] = 1
    np.testing.assert_array_equal(smoothed(xyz, around(xyz)), xyz)
