"""How far a view's word is believed: by whether a point has its pixel's color, and what that says in this scene."""

from __future__ import annotations

from dataclasses import replace

import literal
import numpy as np
import pytest
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.sparse import csr_array
from test_grouping import ONE, hand_table
from test_membership import decide

from og_pointcloud.cloud import BACKGROUND
from og_pointcloud.errors import SceneError
from og_pointcloud.fitting.colors import COLOR_DIFFERENCE_BINS, MAX_COLOR_RATIO, likelihood_ratios
from og_pointcloud.fitting.mask_table import MaskTable
from og_pointcloud.fitting.seen_colors import (
    NO_DIFFERENCE,
    differences,
    doubted_by_color,
    sight_ratios,
    with_color_evidence,
)
from og_pointcloud.journal import Journal
from og_pointcloud.scene import Camera, Points, View

SIDE, NEAR = 20, 0.1
AREA = SIDE * SIDE
CAMERA = Camera(SIDE, SIDE, float(SIDE), float(SIDE), SIDE / 2, SIDE / 2, np.eye(4))
CAR = np.arange(100)
"""Points that are dark, as the car is."""
BELOW = np.arange(100, 160)
"""Points of the ground that two of three views see where the photographs have the car."""


def made_view(name: str, image: NDArray[np.uint8] | None) -> View:
    return View(name, CAMERA, np.full((SIDE, SIDE), -1, np.int32), np.zeros((0, len(ONE)), np.float32), image)


def street(random: Generator) -> tuple[Points, list[View], MaskTable]:
    """A dark car and light ground, a point in each pixel, and as many points of any color that no view sees, behind.
    To geometry all that is in front is open, the ground below the car too."""
    x, y = np.meshgrid(np.arange(SIDE) + 0.5 - SIDE / 2, np.arange(SIDE) + 0.5 - SIDE / 2)
    front = np.stack([x, y, np.full_like(x, SIDE)], axis=-1).reshape(-1, 3) * (2 / SIDE)
    rgb = np.full((2 * AREA, 3), 190)
    rgb[CAR] = 50
    rgb[AREA:] = random.integers(0, 256, (AREA, 3))
    rgb = np.clip(rgb + random.normal(0, 6, rgb.shape), 0, 255).astype(np.uint8)
    points = Points(np.concatenate([front, 2 * front]).astype(np.float32), np.zeros(3), rgb)
    hidden, views, masks = range(AREA, 2 * AREA), [], []
    for name in "abc":
        image = np.clip(rgb[:AREA] + random.normal(0, 6, (AREA, 3)), 1, 255).astype(np.uint8)
        if name != "c":
            image[BELOW] = image[CAR[: len(BELOW)]]
        views.append(made_view(name, image.reshape(SIDE, SIDE, 3)))
        masks.append([(CAR if name == "c" else np.concatenate([CAR, BELOW]), ONE)])
    table = hand_table(2 * AREA, masks, [hidden] * 3)
    return points, views, table


def any_scene(random: Generator, n: int = 3000) -> tuple[Points, View, NDArray[np.float64]]:
    """Points before, beside and behind a camera, of which it exposes about half, in a photograph with black pixels."""
    xyz = random.uniform((-2, -2, -1), (2, 2, 3), (n, 3)).astype(np.float32)
    points = Points(xyz, np.zeros(3), random.integers(0, 256, (n, 3)).astype(np.uint8))
    image = random.integers(0, 256, (SIDE, SIDE, 3)).astype(np.uint8)
    image[random.random((SIDE, SIDE)) < 0.2] = 0
    exposure = np.where(random.random(n) < 0.5, random.uniform(0.02, 1, n), 0).astype(np.float32)
    return points, made_view("any", image), exposure.astype(np.float64)


@pytest.mark.parametrize("seed", range(5))
def test_differences_are_those_of_the_literal_reference(seed: int) -> None:
    points, view, exposure = any_scene(np.random.default_rng(seed))
    shown = np.flatnonzero(exposure).astype(np.int32)
    found, counts = differences(points, view, NEAR, shown, exposure[shown].astype(np.float32))
    assert points.rgb is not None
    assert isinstance(view.image, np.ndarray)
    expected = literal.compared_colors(CAMERA, view.image, points.xyz, points.rgb, NEAR, exposure)
    np.testing.assert_array_equal(found, expected[0])
    np.testing.assert_array_equal(counts, expected[1][[0, 1]])
    assert 0 < (found == NO_DIFFERENCE).sum() < len(found)
    assert counts.sum(axis=1).min() > 50


@pytest.mark.parametrize("seed", range(3))
def test_beliefs_are_those_of_bayes_rule(seed: int) -> None:
    random = np.random.default_rng(seed)
    exposure = csr_array((random.random((4, 30)) * (random.random((4, 30)) < 0.6)).astype(np.float32))
    before = exposure.data.copy()
    difference = random.integers(0, NO_DIFFERENCE + 1, exposure.nnz).astype(np.uint16)
    ratios = np.append(np.linspace(MAX_COLOR_RATIO, 1 / MAX_COLOR_RATIO, COLOR_DIFFERENCE_BINS), 1).astype(np.float32)
    table = replace(hand_table(30, [[(range(5), ONE)]] * 4), exposure=exposure)
    found = with_color_evidence(table, difference, ratios)
    expected = [literal.believed(open_, ratios[apart]) for open_, apart in zip(before, difference, strict=True)]
    np.testing.assert_allclose(found.exposure.data, expected, rtol=1e-5)
    # What masks have in common is told by geometry alone.
    np.testing.assert_allclose(found.with_doubted().exposure.data, before, rtol=1e-5, atol=1e-7)


def test_what_came_through_holes_stays_beside_what_colors_doubt() -> None:
    table = hand_table(30, [[(range(5), ONE)]] * 2)
    holes = csr_array(np.where(np.arange(60) % 7 == 0, 0.5, 0).reshape(2, 30).astype(np.float32))
    table = replace(table, exposure=csr_array(np.full((2, 30), 0.4, np.float32)), doubted=holes)
    plain = table.with_doubted().exposure.toarray()
    ratios = np.append(np.linspace(MAX_COLOR_RATIO, 1 / MAX_COLOR_RATIO, COLOR_DIFFERENCE_BINS), 1).astype(np.float32)
    found = with_color_evidence(table, np.full(60, COLOR_DIFFERENCE_BINS - 1, np.uint16), ratios)
    assert found.exposure.data.max() < 0.1
    np.testing.assert_allclose(found.with_doubted().exposure.toarray(), plain, rtol=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_ground_that_shows_the_color_of_a_car_is_no_part_of_it(seed: int) -> None:
    points, views, table = street(np.random.default_rng(seed))
    by_geometry = decide(table, [0, 0, 0], points.xyz).instance_ids
    assert (by_geometry[BELOW] == 0).mean() > 0.9
    found = decide(doubted_by_color(table, points, views, NEAR), [0, 0, 0], points.xyz).instance_ids
    assert (found[BELOW] == BACKGROUND).mean() > 0.9
    np.testing.assert_array_equal(found[CAR], by_geometry[CAR])


@pytest.mark.parametrize("seed", range(3))
def test_photographs_of_noise_change_no_label(seed: int) -> None:
    random = np.random.default_rng(seed)
    points, views, table = street(random)
    by_geometry = decide(table, [0, 0, 0], points.xyz).instance_ids
    noise = [replace(view, image=random.integers(0, 256, (SIDE, SIDE, 3)).astype(np.uint8)) for view in views]
    found = decide(doubted_by_color(table, points, noise, NEAR), [0, 0, 0], points.xyz).instance_ids
    assert (found == by_geometry).mean() > 0.97


def adjusted(view: View, gains: NDArray[np.float64]) -> View:
    """The view as its camera would have taken it with other exposure and white balance."""
    assert isinstance(view.image, np.ndarray)
    return replace(view, image=np.clip(np.rint(view.image * gains), 1, 255).astype(np.uint8))


@pytest.mark.parametrize("gain", [0.5, 0.8, 1.3])
def test_exposure_and_white_balance_of_photographs_hardly_matter(gain: float) -> None:
    points, views, table = street(np.random.default_rng(0))
    expected = doubted_by_color(table, points, views, NEAR).exposure
    points, views, table = street(np.random.default_rng(0))
    views[0] = adjusted(views[0], gain * np.array([1, 0.9, 1.05]))
    found = doubted_by_color(table, points, views, NEAR).exposure
    assert np.abs((found - expected).data).mean() < 0.02
    # Without the gain, the ground of that view is taken for hidden, as it is elsewhere below the car.
    ground = np.setdiff1d(np.arange(AREA), np.concatenate([CAR, BELOW]))
    assert found.toarray()[0, ground].mean() > 0.6 > 0.3 > found.toarray()[0, BELOW].mean()


@pytest.mark.parametrize("seed", range(3))
def test_no_other_gain_leaves_less_difference(seed: int) -> None:
    """The gain of a gray photograph from its differences: least at the one that is found, but for its prior."""
    random = np.random.default_rng(seed)
    rgb = np.repeat(random.integers(1, 180, (AREA, 1)), 3, axis=1).astype(np.uint8)
    image = np.clip(np.rint(1.3 * rgb + random.normal(0, 10, (AREA, 1))), 1, 255).astype(np.uint8)
    image[:60] = 20  # hidden after all
    points = replace(street(random)[0].take(np.arange(AREA)), rgb=rgb)
    view = made_view("a", image.reshape(SIDE, SIDE, 3))
    found, _ = differences(points, view, NEAR, np.arange(AREA, dtype=np.int32), np.ones(AREA, np.float32))
    gains = np.exp(np.arange(-300, 301) * 0.005)[:, None]
    left = np.abs(image[:, 0].astype(float) - gains * rgb[:, 0])
    prior = np.abs(1 - gains[:, 0]) * 30 * 128
    best = gains[(left.sum(axis=1) + prior).argmin(), 0]
    apart = np.abs(np.minimum(image / best, 255) - rgb)
    assert np.abs(found - np.linalg.norm(apart, axis=1)).max() < 3


@pytest.mark.parametrize("levels", [(0, 255), (255, 1), (255, 255), (1, 1)])
def test_extreme_levels_have_finite_differences(levels: tuple[int, int]) -> None:
    """Black points, and photographs that are over- or underexposed throughout."""
    of_points, of_image = levels
    points = street(np.random.default_rng(0))[0].take(np.arange(AREA))
    points = replace(points, rgb=np.full((AREA, 3), of_points, np.uint8))
    view = made_view("a", np.full((SIDE, SIDE, 3), of_image, np.uint8))
    rows = np.arange(AREA, dtype=np.int32)
    found, counts = differences(points, view, NEAR, rows, np.ones(AREA, np.float32))
    assert (found < NO_DIFFERENCE).all()
    assert counts.sum() == AREA


def test_a_few_points_tell_no_gain() -> None:
    """Of three points in front of another thing, the color stays as different as it is."""
    points = replace(street(np.random.default_rng(0))[0].take(np.arange(3)), rgb=np.full((3, 3), 200, np.uint8))
    view = made_view("a", np.full((SIDE, SIDE, 3), 80, np.uint8))
    found, _ = differences(points, view, NEAR, np.arange(3, dtype=np.int32), np.ones(3, np.float32))
    assert (found == round(120 * np.sqrt(3))).all()


def test_beliefs_do_not_depend_on_the_order_of_points() -> None:
    points, views, table = street(np.random.default_rng(0))
    order = np.random.default_rng(1).permutation(2 * AREA)
    shuffled = replace(table, exposure=csr_array(table.exposure.toarray()[:, order]))
    found = doubted_by_color(shuffled, points.take(order), views, NEAR).exposure.toarray()
    np.testing.assert_array_equal(found, doubted_by_color(table, points, views, NEAR).exposure.toarray()[:, order])


def unreadable() -> NDArray[np.uint8]:
    raise SceneError("c.jpg cannot be decoded")


def test_a_view_without_a_photograph_counts_as_if_colors_said_nothing() -> None:
    found, journals = [], [Journal(False), Journal(False)]
    for image, journal in zip((None, unreadable), journals, strict=True):
        points, views, table = street(np.random.default_rng(0))
        found.append(doubted_by_color(table, points, [*views[:2], replace(views[2], image=image)], NEAR, journal))
    without, broken = found
    told = "photographs of 1 of 3 views cannot be read: c.jpg cannot be decoded"
    assert [journal.warnings for journal in journals] == [[], [told]]
    np.testing.assert_array_equal(without.exposure.toarray(), broken.exposure.toarray())
    np.testing.assert_allclose(without.exposure[[2]].data, 0.5)
    assert without.exposure[[0]].data.max() > 0.8 > 0.2 > without.exposure[[0]].data.min()


@pytest.mark.parametrize("kind", ["no colors", "no photographs", "one color", "nothing hidden"])
def test_colors_that_say_nothing_change_nothing(kind: str) -> None:
    points, views, table = street(np.random.default_rng(0))
    if kind == "no colors":
        points = replace(points, rgb=None)
    elif kind == "no photographs":
        views = [replace(view, image=None) for view in views]
    elif kind == "one color":
        points = replace(points, rgb=np.full((2 * AREA, 3), 90, np.uint8))
        views = [replace(view, image=np.full((SIDE, SIDE, 3), 90, np.uint8)) for view in views]
    else:
        points, table = points.take(np.arange(AREA)), table.of_points(np.arange(AREA))
    before = table.exposure.toarray()
    found = doubted_by_color(table, points, views, NEAR)
    np.testing.assert_array_equal(found.exposure.toarray(), before)
    assert found.doubted is None


def test_ratios_have_one_for_no_color() -> None:
    counts = np.zeros((2, COLOR_DIFFERENCE_BINS))
    counts[0, :20], counts[1, 60:] = 5000, 500
    ratios = sight_ratios(counts)
    assert ratios[NO_DIFFERENCE] == 1
    assert ratios[0] == pytest.approx(MAX_COLOR_RATIO)
    assert ratios[200] == pytest.approx(1 / MAX_COLOR_RATIO)


def test_few_cases_say_little() -> None:
    """Of colors that many points share, three more that are hidden: by themselves they would say all that is said."""
    counts = np.zeros((2, COLOR_DIFFERENCE_BINS))
    counts[0, 0], counts[1, 1] = 3, 3
    few, many = likelihood_ratios(*counts), likelihood_ratios(*(1000 * counts))
    assert 1 < few[0] < 1.3
    assert many[0] == pytest.approx(MAX_COLOR_RATIO)
