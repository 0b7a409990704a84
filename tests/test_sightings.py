"""Sight lines against their definition: every point, every splat before it, in float64."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from reference_splatting import in_camera, reference_alpha, round_splats

from og_pointcloud.rendering.sightings import (
    EDGE_PX,
    MIN_OPENNESS,
    RING_SHARE,
    VOTE_SAMPLES,
    openness,
    sightings,
    sightings_of,
)
from og_pointcloud.rendering.splatting import BATCH, Gaussians
from og_pointcloud.scene import NOT_SEEN, Camera

CAMERA = Camera(48, 40, 60, 60, 24, 20, np.eye(4))
NEAR = 0.1


def reference_openness(splats: Gaussians, camera: Camera, thickness: NDArray[np.floating]) -> NDArray[np.float64]:
    """(n,): the product of (1 - alpha) at each center's pixel over all that lies more than thickness before it."""
    depth = np.array([in_camera(splats, g, camera)[2] for g in range(len(splats))])
    alphas = {h: reference_alpha(splats, h, camera) for h in range(len(splats)) if depth[h] > NEAR}
    found = np.zeros(len(splats))
    for g in range(len(splats)):
        if depth[g] <= NEAR:
            continue
        u, v = camera.project(splats.xyz[[g]])[0][0]
        if not (0 <= u < camera.width and 0 <= v < camera.height):
            continue
        light = 1.0
        for h in range(len(splats)):
            if NEAR < depth[h] < np.float32(depth[g]) - np.float32(thickness[g]):
                alpha = alphas[h][int(v), int(u)]
                light *= 1 - alpha if alpha >= 1 / 255 else 1.0
        found[g] = light if light >= MIN_OPENNESS else 0.0
    return found


@pytest.mark.parametrize("seed", range(6))
def test_openness_is_that_of_the_definition(seed: int) -> None:
    random = np.random.default_rng(seed)
    xyz = random.uniform([-1.5, -1.2, 0.5], [1.5, 1.2, 5], (150, 3))
    splats = round_splats(xyz, random.uniform(0.01, 0.15, 150), random.uniform(0.3, 0.95))
    thickness = random.uniform(0, 0.3, 150).astype(np.float32)
    found, u, v = openness(splats, CAMERA, NEAR, thickness)
    expected = reference_openness(splats, CAMERA, thickness)
    np.testing.assert_allclose(found, expected, atol=2e-5)
    assert (expected > 0.5).any()
    assert (expected[(found > 0) | (expected > 0)] < 0.5).any(), "the scene has points that are partly hidden"
    uv = CAMERA.project(splats.xyz)[0]
    np.testing.assert_allclose(np.stack([u, v], axis=1)[found > 0], uv[found > 0], atol=1e-4)


@pytest.mark.parametrize(("scale", "opacity"), [(0.5, 0.02), (0.2, 0.9)])
def test_more_splats_than_a_tile_fetches_at_once(scale: float, opacity: float) -> None:
    """Faint ones leave light for some of those that are fetched next, opaque ones for none."""
    depth = np.random.default_rng(0).uniform(0.5, 5, 3 * BATCH)
    slopes = np.random.default_rng(1).uniform(-0.13, 0.13, (2, len(depth)))
    splats = round_splats(np.stack([*(slopes * depth), depth], axis=1), scale, opacity)
    thickness = np.full(len(depth), 0.1, np.float32)
    expected = reference_openness(splats, CAMERA, thickness)
    np.testing.assert_allclose(openness(splats, CAMERA, NEAR, thickness)[0], expected, atol=2e-5)
    before_last = np.count_nonzero(depth < depth[expected > 0].max())
    assert before_last > 1.2 * BATCH if opacity < 0.1 else before_last < BATCH


def test_points_of_one_surface_do_not_hide_each_other() -> None:
    line = np.linspace(-0.3, 0.3, 12)
    x, y, z = np.meshgrid(line, line, [2.0, 2.05, 2.1])
    layers = round_splats(np.stack([x, y, z], axis=-1).reshape(-1, 3), 0.05)
    thick = openness(layers, CAMERA, NEAR, np.full(len(layers), 0.2, np.float32))[0]
    thin = openness(layers, CAMERA, NEAR, np.full(len(layers), 0.01, np.float32))[0]
    np.testing.assert_array_equal(thick, 1)
    assert (thin == 0).sum() > len(layers) / 3


def test_votes_go_to_the_masks_at_and_around_the_pixel() -> None:
    splats = round_splats([[0, 0, 2], [0.52, 0, 2], [-2.5, 0, 2]], 0.01)  # middle, on the edge, outside
    ids = np.full((40, 48), -1, np.int32)
    ids[:, 24:39] = 0
    ids[:, 39:] = 1
    seen = sightings(splats, CAMERA, ids, 2, NEAR, np.ones(3, np.float32))
    votes = seen.rows.toarray()
    np.testing.assert_allclose(votes.sum(axis=0), [1, 1, 0], atol=1e-6)
    np.testing.assert_array_equal(seen.openness.toarray()[0], [1, 1, 0])
    u = CAMERA.project(splats.xyz)[0][1, 0]
    around = np.floor(u + EDGE_PX * np.cos(np.arange(8) * np.pi / 4)) >= 39
    np.testing.assert_allclose(votes[1, 1], (1 - RING_SHARE) * (u >= 39) + RING_SHARE * around.mean(), atol=1e-6)
    assert 0 < votes[1, 1] < 1
    assert votes[2, 0] > 0, "left of the middle point lies no mask"


def test_order_of_points_and_who_is_asked_change_nothing() -> None:
    random = np.random.default_rng(1)
    xyz = random.uniform([-1.5, -1.2, 0.5], [1.5, 1.2, 5], (400, 3)).astype(np.float32)
    splats, thickness = round_splats(xyz, 0.06), np.full(400, 0.1, np.float32)
    ids = random.integers(-1, 3, (40, 48)).astype(np.int32)
    rows = sightings(splats, CAMERA, ids, 3, NEAR, thickness).rows.toarray()
    order = random.permutation(400)
    shuffled = sightings(round_splats(xyz[order], 0.06), CAMERA, ids, 3, NEAR, thickness).rows.toarray()
    np.testing.assert_array_equal(shuffled, rows[:, order])
    asked = random.random(400) < 0.3
    some = sightings(splats, CAMERA, ids, 3, NEAR, thickness, asked).rows.toarray()
    np.testing.assert_array_equal(some[:, asked], rows[:, asked])
    assert not some[:, ~asked].any()


def test_unit_of_length_changes_nothing() -> None:
    random = np.random.default_rng(2)
    xyz = random.uniform([-1.5, -1.2, 0.5], [1.5, 1.2, 5], (300, 3)).astype(np.float32)
    thickness = np.full(300, 0.1, np.float32)
    found = openness(round_splats(xyz, 0.06), CAMERA, NEAR, thickness)[0]
    for unit in (2.0**10, 2.0**-10):
        same = openness(round_splats(xyz * unit, 0.06 * unit), CAMERA, NEAR * unit, thickness * np.float32(unit))[0]
        np.testing.assert_allclose(same, found, atol=1e-6)


def test_nothing_in_the_image_is_no_error() -> None:
    ids = np.zeros((40, 48), np.int32)
    behind = round_splats([[0, 0, -2]], 0.1)
    for splats in (behind, round_splats(np.zeros((0, 3)), 0.1)):
        seen = sightings(splats, CAMERA, ids, 1, NEAR, np.ones(len(splats), np.float32))
        assert (seen.rows.shape, seen.rows.nnz, seen.openness.nnz) == ((2, len(splats)), 0, 0)
    other = replace(CAMERA, width=17, height=1)  # a tile and a bit, one row
    one = sightings(round_splats([[0, -0.65, 2]], 0.1), other, ids[:1, :17], 1, NEAR, np.ones(1, np.float32))
    assert one.rows.shape == (2, 1)


def test_a_point_on_the_border_of_the_image_is_in_its_last_pixel():
    """A place of 7.9999999 pixels is 8 in float32."""
    border = np.array([8.0], np.float32)
    found = sightings_of(np.ones(1, np.float32), border, border, np.zeros((8, 8), np.int32), 1)
    assert found.openness.nnz == 1
    assert found.rows[[0]].sum() == pytest.approx(1)


@pytest.mark.parametrize("size", [(40, 48), (17, 5), (1, 1)])
def test_votes_are_those_of_every_sample_one_by_one(size: tuple[int, int]) -> None:
    """Masks of random rectangles, some pixels not photographed: blocks within one mask, and blocks at their edges."""
    random = np.random.default_rng(size[0])
    ids = np.full(size, -1, np.int32)
    for mask in (0, 1, 2, NOT_SEEN):
        top, left = random.integers(0, size[0]), random.integers(0, size[1])
        ids[top : top + 22, left : left + 22] = mask
    n = 500
    open_ = (random.random(n) * (random.random(n) < 0.7)).astype(np.float32)
    u, v = (random.uniform(0, side, n).astype(np.float32) for side in (size[1], size[0]))
    expected = np.zeros((4, n), np.float32)
    for g in np.flatnonzero(open_):
        if ids[min(int(v[g]), size[0] - 1), min(int(u[g]), size[1] - 1)] == NOT_SEEN:
            continue
        for right, down, share in VOTE_SAMPLES:
            x = int(np.clip(np.floor(u[g] + right), 0, size[1] - 1))
            y = int(np.clip(np.floor(v[g] + down), 0, size[0] - 1))
            expected[max(ids[y, x], -1), g] += np.float64(open_[g]) * share
    np.testing.assert_array_equal(sightings_of(open_, u, v, ids, 3).rows.toarray(), expected)
