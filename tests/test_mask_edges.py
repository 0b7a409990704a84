"""Masks that end before the things that they show: told by photographs, and widened by as much."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest
from og_pointcloud_zoo.draws import draw
from og_pointcloud_zoo.make import made_scene
from og_pointcloud_zoo.measure import measure
from scipy import ndimage
from scipy.spatial.distance import cdist

import og_pointcloud as og
from og_pointcloud.fitting import fit as stages
from og_pointcloud.fitting.mask_edges import (
    COMPARED_SIZE,
    MAX_PIXELS_OUT,
    MIN_COMPARED_VIEWS,
    NORMAL_BLUR_PX,
    edge_contrast,
    pixels_short,
    with_masks_to_edges,
)
from og_pointcloud.journal import Journal
from og_pointcloud.scene import NOT_SEEN, Points, Scene, View

NOISE = 6.0
"""Standard deviation of the texture of things and of what lies behind them, in levels."""


def drawn(seed: int, short: int, noise: float = NOISE, size: tuple[int, int] = (90, 120), contrast: int = 60) -> View:
    """A photograph of three textured discs on a textured ground. Their masks, ragged by half a pixel, end ``short``
    pixels before they do."""
    rng = np.random.default_rng(seed)
    height, width = size
    rows, columns = np.mgrid[:height, :width]
    ids, image = np.full(size, -1, np.int32), np.full(size, 100.0)
    for k in range(3):
        middle = width * (k + 0.5) / 3 + rng.uniform(-2, 2), height / 2 + rng.uniform(-5, 5)
        away = np.hypot(columns - middle[0], rows - middle[1]) - height / 6
        image[away <= 0] = 100 + contrast * (1, -1, 0.7)[k]
        ids[away + short <= rng.normal(0, 0.5, size)] = k
    image = image[..., None] + rng.normal(0, noise, (*size, 3))
    camera = og.Camera(width, height, 100.0, 100.0, width / 2, height / 2, np.eye(4))
    return View(f"{seed:03}", camera, ids, np.eye(3, dtype=np.float32), np.clip(image, 0, 255).astype(np.uint8))


@pytest.mark.parametrize("short", [0, 2, 3, 4])  # a single pixel may be raggedness
def test_by_how_much_masks_end_early_is_found(short):
    assert pixels_short([drawn(seed, short) for seed in range(6)]) == short


@pytest.mark.parametrize("change", [lambda of: of[::-1], lambda of: of[:, ::-1], lambda of: 255 - of])
def test_mirrored_or_inverted_photographs_say_the_same(change):
    def changed(view: View) -> View:
        ids = np.ascontiguousarray(change(view.mask_map())) if change(np.zeros((1, 1)))[0, 0] == 0 else view.masks
        return replace(view, masks=ids, image=np.ascontiguousarray(change(view.image)))

    assert pixels_short([changed(drawn(seed, 2)) for seed in range(6)]) == 2


def test_the_order_of_views_does_not_matter():
    views = [drawn(seed, 2) for seed in range(30)]
    assert pixels_short(views[::-1]) == pixels_short(views) == 2


@pytest.mark.parametrize("seed", range(20))
def test_texture_alone_says_nothing(seed):
    assert pixels_short([drawn(10 * seed + k, 3, noise=20, contrast=0) for k in range(8)]) == 0


def test_masks_larger_than_what_they_show_stay():
    assert pixels_short([drawn(seed, -3) for seed in range(6)]) == 0


def test_too_few_views_say_nothing():
    views = [drawn(seed, 2) for seed in range(MIN_COMPARED_VIEWS)]
    assert pixels_short(views) == 2
    assert pixels_short(views[1:]) == 0


@pytest.mark.parametrize("image", [None, np.zeros((5, 5, 3), np.uint8)])
def test_views_without_a_photograph_that_fits_are_not_compared(image):
    views = [drawn(seed, 2) for seed in range(5)]
    assert pixels_short([replace(view, image=image) for view in views[:3]] + views[3:]) == 0


def test_contrast_is_that_of_the_literal_reference():
    """Distances pair by pair, sums place by place, in float64."""
    view = drawn(0, 2, size=(48, 64))
    ids = view.mask_map().copy()
    ids[:3] = NOT_SEEN
    view = replace(view, masks=ids)
    pixels = np.argwhere(ids >= NOT_SEEN)
    inside, outside = (ids >= 0).ravel(), (ids == -1).ravel()
    distance = cdist(pixels, pixels[inside]).min(axis=1) - 0.5
    distance[inside] = 0.5 - cdist(pixels[inside], pixels[outside]).min(axis=1)
    distance = distance.reshape(ids.shape)
    grey = cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY).astype(np.float64)
    normal = np.gradient(ndimage.gaussian_filter(distance, NORMAL_BLUR_PX, mode="mirror", radius=6))
    change = np.gradient(grey)
    places: dict[int, list[float]] = {}
    for row, column in pixels[inside | outside]:
        n = np.array([normal[0][row, column], normal[1][row, column]])
        g = np.array([change[0][row, column], change[1][row, column]])
        n /= max(np.linalg.norm(n), 1e-6)
        value = abs(g @ n) - abs(g @ [n[1], -n[0]])
        places.setdefault(int(np.floor(distance[row, column])), []).append(value)
    means = [np.mean(places[place]) for place in range(-MAX_PIXELS_OUT, MAX_PIXELS_OUT + 1)]
    expected = [(one + other) / 2 for one, other in pairwise(means)]
    np.testing.assert_allclose(edge_contrast(view), expected, atol=0.02)


def scene_of(views: list[View]) -> Scene:
    return Scene(Points(np.zeros((1, 3), np.float32), np.zeros(3)), tuple(views), "none")


def test_masks_are_widened_by_as_much_and_not_into_others():
    views = [drawn(seed, 2) for seed in range(6)]
    ids = views[0].mask_map().copy()
    ids[44:47, :60], ids[40:60, 58:60] = NOT_SEEN, 2  # beside masks, and a mask that touches another
    views[0] = replace(views[0], masks=ids)
    journal = Journal(progress=False)
    found = with_masks_to_edges(scene_of(views), journal).views[0].mask_map()
    assert journal.notes["masks_widened_px"] == 2
    assert len(journal.warnings) == 1
    assert "masks end 2 px before the photographs change" in journal.warnings[0]

    pixels = np.argwhere(ids >= NOT_SEEN)
    inside = ids.ravel() >= 0
    away = cdist(pixels, pixels[inside])
    expected_inside = inside | ((ids.ravel() == -1) & (away.min(axis=1) <= 2))
    assert np.array_equal(found.ravel() >= 0, expected_inside)
    assert np.array_equal(found[ids != -1], ids[ids != -1])
    for pixel in np.flatnonzero(expected_inside & ~inside):
        of_mask = away[pixel, ids.ravel()[inside] == found.ravel()[pixel]].min()
        assert of_mask <= away[pixel].min() * 1.05  # OpenCV's distances are off by as much


def test_a_scene_that_needs_nothing_is_the_same():
    scene, journal = scene_of([drawn(seed, 0) for seed in range(6)]), Journal(progress=False)
    assert with_masks_to_edges(scene, journal) is scene
    assert journal.notes == {}
    assert journal.warnings == []


def test_large_images_are_compared_at_fewer_pixels():
    width = 2 * COMPARED_SIZE - 48
    large = []
    for seed in range(4):
        small = drawn(seed, 2, size=(100, width // 2))
        camera = og.Camera(width, 200, 100.0, 100.0, width / 2, 100.0, np.eye(4))
        ids, image = (np.repeat(np.repeat(of, 2, axis=0), 2, axis=1) for of in (small.mask_map(), small.image))
        large.append(View(small.name, camera, ids, small.mask_features, image))
    journal = Journal(progress=False)
    found = with_masks_to_edges(scene_of(large), journal)
    assert journal.notes["masks_widened_px"] == 2
    assert f"masks end 2 px of images {COMPARED_SIZE:,} px long before" in journal.warnings[0]
    before, after = large[0].mask_map() >= 0, found.views[0].mask_map() >= 0
    assert ndimage.distance_transform_edt(~before)[after].max() == 4


def test_a_fit_of_masks_that_end_early_finds_what_they_left_out(tmp_path, monkeypatch):
    tiny = replace(draw("boxes-0"), name="tiny", points=1500, views=6, width=96, height=72, all_masked=False)
    scene = made_scene(tiny, tmp_path)
    widened = measure(scene, baselines=False, changes={"eroded": 2})
    monkeypatch.setattr(stages, "with_masks_to_edges", lambda scene, journal: scene)
    assert widened.miou > measure(scene, baselines=False, changes={"eroded": 2}).miou + 0.05
