"""What colors of adjoining points say: the ratio of likelihoods that a scene shows, and labels that follow it."""

from __future__ import annotations

import literal
import numpy as np
import pytest
from numpy.random import Generator
from numpy.typing import NDArray
from test_grouping import ONE, hand_table
from test_membership import groups, on_a_line

from og_pointcloud.fitting.colors import (
    COLOR_DIFFERENCE_BINS,
    MAX_COLOR_RATIO,
    color_ratios,
    neighbor_weights,
    outline_ratios,
)
from og_pointcloud.fitting.membership import assign_points
from og_pointcloud.fitting.view_votes import view_votes
from og_pointcloud.rendering.geometry import Neighborhood, neighborhood
from og_pointcloud.settings import GeometrySettings, MembershipSettings

SIDE = 24
DARK, LIGHT = (40, 30, 30), (90, 120, 60)


def grid(random: Generator, side: int = SIDE) -> tuple[Neighborhood, NDArray[np.int32], NDArray[np.float64]]:
    """The neighborhood of a square of points, half of them of state 0, half of state 1, most of them sure in part."""
    x, y = np.meshgrid(np.arange(side), np.arange(side))
    xyz = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3) + random.normal(0, 0.05, (side**2, 3))
    return (
        neighborhood(xyz.astype(np.float32), GeometrySettings()),
        (x.ravel() >= side // 2).astype(np.int32),
        np.where(random.random(side**2) < 0.8, random.uniform(0.6, 1, side**2), 0),
    )


def colored(ids: NDArray[np.int32], random: Generator, noise: float) -> NDArray[np.uint8]:
    """Dark points of state 0, light ones of state 1, with noise."""
    return np.clip(np.array([DARK, LIGHT])[ids] + random.normal(0, noise, (len(ids), 3)), 0, 255).astype(np.uint8)


def lists(around: Neighborhood) -> list[list[int]]:
    return [index[near].tolist() for index, near in zip(around.index, around.adjoining, strict=True)]


@pytest.mark.parametrize(("seed", "noise"), [(0, 3.0), (1, 3.0), (2, 3.0), (0, 40.0)])
def test_ratios_are_those_of_the_literal_reference(seed: int, noise: float) -> None:
    random = np.random.default_rng(seed)
    around, ids, sure = grid(random)
    rgb = colored(ids, random, noise)
    found = color_ratios(rgb, ids, sure, around)
    np.testing.assert_allclose(found, literal.color_ratios(rgb, ids, sure, lists(around)), rtol=1e-5)
    assert found[0] > 1.2 > 0.8 > found[-1]
    assert (np.diff(found) <= 0).all()


def test_ratios_across_outlines_are_means_over_pairs_of_a_point_inside_and_one_outside() -> None:
    random = np.random.default_rng(0)
    around, ids, sure = grid(random)
    rgb = colored(ids, random, 3.0)
    ratios = color_ratios(rgb, ids, sure, around)
    group = random.integers(-1, 3, len(ids)).astype(np.int32)
    group[around.index[group == 2]] = 2  # is nearly all; group 3 is empty
    found = outline_ratios(rgb, group, 4, around, ratios)
    for k in range(4):
        pairs = [(g, h) for g in np.flatnonzero(group == k) for h in lists(around)[g] if group[h] != k]
        apart = [round(np.linalg.norm(rgb[g].astype(float) - rgb[h])) for g, h in pairs]
        assert found[k] == pytest.approx(np.mean(ratios[apart]) if apart else 1, rel=1e-6)
    np.testing.assert_array_equal(outline_ratios(None, group, 4, around, ratios), 1)


def test_ratios_stay_within_their_bounds_where_colors_tell_all() -> None:
    random = np.random.default_rng(0)
    around, ids, sure = grid(random, 8 * SIDE)
    found = color_ratios(colored(ids, random, 0), ids, sure, around)
    assert found.max() == pytest.approx(MAX_COLOR_RATIO)
    assert found.min() == pytest.approx(1 / MAX_COLOR_RATIO)


@pytest.mark.parametrize("same", [True, False])
def test_colors_that_say_nothing_weigh_nothing(same: bool) -> None:
    """One color for all, or colors by chance: every adjoining point counts about as one."""
    random = np.random.default_rng(1)
    around, ids, sure = grid(random)
    rgb = np.full((SIDE**2, 3), 7, np.uint8) if same else random.integers(0, 255, (SIDE**2, 3)).astype(np.uint8)
    found = color_ratios(rgb, ids, sure, around)
    weights = neighbor_weights(rgb, around, found)
    assert (weights[~around.adjoining] == 0).all()
    assert np.median(weights[around.adjoining]) == pytest.approx(1, abs=0.25)


def test_a_scene_without_colors_or_without_borders_is_not_asked() -> None:
    random = np.random.default_rng(2)
    around, ids, sure = grid(random)
    for rgb, states in ((None, ids), (colored(ids, random, 5), np.zeros_like(ids))):
        found = color_ratios(rgb, states, sure, around)
        assert found.shape == (COLOR_DIFFERENCE_BINS,)
        assert (found == 1).all()
        assert np.array_equal(neighbor_weights(rgb, around, found), around.adjoining)


def test_order_of_points_does_not_matter() -> None:
    random = np.random.default_rng(3)
    around, ids, sure = grid(random)
    rgb, order = colored(ids, random, 20), random.permutation(SIDE**2)
    back = np.argsort(order)
    shuffled = Neighborhood(around.spacing[order], back[around.index[order]].astype(np.int32), around.adjoining[order])
    found = color_ratios(rgb, ids, sure, around)
    assert np.array_equal(found, color_ratios(rgb[order], ids[order], sure[order], shuffled))


@pytest.mark.parametrize("tell", [True, False])
def test_points_of_a_torn_border_go_with_their_color(tell: bool) -> None:
    """Ten pairs of things in a row; masks of the left ones are ragged and reach two points into the right ones."""
    n, size = 400, 20
    truth = (np.arange(n) // size % 2).astype(np.int32)
    thing = np.arange(n) // size
    reach = np.where((truth == 1) & (np.arange(n) % size < 2), thing - 1, thing)
    views = [[(np.flatnonzero(shown == k).tolist(), ONE) for k in range(n // size)] for shown in (thing, reach, reach)]
    table = hand_table(n, views)
    around = neighborhood(on_a_line(n), GeometrySettings())
    rgb = np.array([DARK, LIGHT], np.uint8)[truth] if tell else np.full((n, 3), 9, np.uint8)
    number = groups([k for _ in views for k in range(n // size)])
    ids = assign_points(table, view_votes(table), number, around, MembershipSettings(), rgb).instance_ids
    assert (np.mean(ids == thing) == 1) == tell
