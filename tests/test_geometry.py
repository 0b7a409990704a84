"""Point spacing, samples, near plane and strided cameras."""

from __future__ import annotations

import signal
import threading
import time

import numpy as np
import pytest
from numpy.random import Generator
from numpy.typing import NDArray

from og_pointcloud.rendering import geometry
from og_pointcloud.rendering.geometry import (
    FLOATER_DRAWN_SPACINGS,
    SPACING_MEDIAN_NEIGHBORS,
    drawn_spacing,
    morton_order,
    near_plane,
    nearest_in,
    neighborhood,
    position_hash,
    sample_of_points,
    strided,
)
from og_pointcloud.rendering.splatting import NEAR_SHARE
from og_pointcloud.scene import Camera
from og_pointcloud.settings import GeometrySettings

SETTINGS = GeometrySettings()


def grid(side: int, step: float = 1.0) -> NDArray[np.float32]:
    """A square lattice in the plane z = 0."""
    line = np.arange(side) * step
    return np.stack([*np.meshgrid(line, line), np.zeros((side, side))], axis=-1).reshape(-1, 3).astype(np.float32)


def test_spacing_of_a_lattice_is_its_step() -> None:
    around = neighborhood(grid(10, 0.25), SETTINGS)
    assert around.spacing.dtype == np.float32
    np.testing.assert_allclose(np.median(around.spacing), 0.25)


def test_neighbors_are_those_of_brute_force(random: Generator) -> None:
    xyz = random.normal(size=(200, 3)).astype(np.float32)
    around = neighborhood(xyz, SETTINGS)
    apart = np.linalg.norm(xyz[:, None].astype(np.float64) - xyz, axis=2)
    np.fill_diagonal(apart, np.inf)
    nearest = np.argsort(apart, axis=1)[:, : SETTINGS.neighbors]
    np.testing.assert_array_equal(around.index, nearest)
    own = np.take_along_axis(apart, nearest, axis=1)
    three = own[:, :3].mean(axis=1)
    expected = np.minimum(three, np.median(three[nearest[:, :SPACING_MEDIAN_NEIGHBORS]], axis=1))
    np.testing.assert_allclose(around.spacing, expected, rtol=1e-5)
    floor = np.maximum(around.spacing, np.median(three))
    np.testing.assert_array_equal(around.adjoining, own <= SETTINGS.reach * floor[:, None])


def test_order_of_points_does_not_matter(random: Generator) -> None:
    xyz = random.normal(size=(300, 3)).astype(np.float32)
    order = random.permutation(300)
    plain, shuffled = neighborhood(xyz, SETTINGS), neighborhood(xyz[order], SETTINGS)
    np.testing.assert_array_equal(shuffled.spacing, plain.spacing[order])
    np.testing.assert_array_equal(order[shuffled.index], plain.index[order])
    np.testing.assert_array_equal(shuffled.adjoining, plain.adjoining[order])


def test_unit_of_length_scales_the_spacing(random: Generator) -> None:
    xyz = random.normal(size=(300, 3)).astype(np.float32)
    meters, millimeters = neighborhood(xyz, SETTINGS), neighborhood(xyz * np.float32(1024), SETTINGS)
    np.testing.assert_array_equal(millimeters.spacing, meters.spacing * 1024)
    np.testing.assert_array_equal(millimeters.adjoining, meters.adjoining)


def test_a_floater_has_the_spacing_of_the_surface_it_left() -> None:
    xyz = np.concatenate([grid(10), [[4, 4, 500]]]).astype(np.float32)
    around = neighborhood(xyz, SETTINGS)
    assert around.spacing[-1] <= 1.5
    assert not around.adjoining[-1].any()
    assert not (around.adjoining & (around.index == 100)).any()


def test_only_points_that_float_far_apart_in_all_directions_are_drawn_small(random: Generator) -> None:
    """A room's floor, a far wall of a tenth of its density, and floaters above the floor as far apart as the wall's."""
    floor, wall = grid(40), grid(8, 10.0)[:, [0, 2, 1]]
    wall[:, 1] += random.normal(500, 1, 64)
    floaters = random.uniform([0, 0, 100], [40, 40, 140], (64, 3))
    xyz = np.concatenate([floor, wall, floaters]).astype(np.float32)
    around = neighborhood(xyz, SETTINGS)
    drawn = drawn_spacing(xyz, around)
    assert np.median(around.spacing[1664:]) > 3, "they are no neighbors of the floor"
    assert np.mean(np.isclose(drawn[1664:], FLOATER_DRAWN_SPACINGS)) > 0.8, (
        "but for some at their rim, whose neighbors lie to one side"
    )
    np.testing.assert_array_equal(drawn[:1664], around.spacing[:1664])


def test_duplicates_have_the_spacing_of_the_scene() -> None:
    xyz = np.concatenate([grid(10), np.repeat(grid(1) + 3, 40, axis=0)]).astype(np.float32)
    around = neighborhood(xyz, SETTINGS)
    np.testing.assert_allclose(around.spacing[100:], 1, atol=0.2)
    assert (around.spacing > 0).all()
    assert (around.index != np.arange(140)[:, None]).all()
    assert around.adjoining[100:].all()


def test_points_given_twice_have_the_spacing_they_had(random: Generator) -> None:
    xyz = random.normal(size=(300, 3)).astype(np.float32)
    again = np.concatenate([np.arange(300), np.arange(300), np.arange(0, 300, 3)])
    once, twice = neighborhood(xyz, SETTINGS), neighborhood(xyz[again], SETTINGS)
    np.testing.assert_array_equal(twice.spacing, once.spacing[again])


def test_only_duplicates() -> None:
    around = neighborhood(np.ones((50, 3), np.float32), SETTINGS)
    np.testing.assert_array_equal(around.spacing, 1)
    assert around.adjoining.all()


@pytest.mark.parametrize("outlier", [0.5, 1e6])
def test_what_follows_each_other_along_the_curve_is_near(random: Generator, outlier: float) -> None:
    xyz = np.concatenate([random.uniform(size=(4096, 3)), [[outlier] * 3]]).astype(np.float32)
    rows = morton_order(xyz)
    np.testing.assert_array_equal(np.sort(rows), np.arange(4097))
    runs = xyz[rows[rows != 4096]].reshape(64, 64, 3)  # of the cube of side 1, cubes of side 1/4 if all were even
    assert np.median(np.ptp(runs, axis=1).max(axis=1)) < 0.5
    assert np.median(np.ptp(xyz[:4096].reshape(64, 64, 3), axis=1).max(axis=1)) > 0.9


@pytest.mark.parametrize("n", [0, 1, 3])
def test_points_of_one_place_keep_their_order_along_the_curve(n: int) -> None:
    np.testing.assert_array_equal(morton_order(np.ones((n, 3), np.float32)), np.arange(n))


@pytest.mark.parametrize("n", [1, 2, 3, 16, 17, 18])
def test_few_points_have_all_others_as_neighbors(n: int) -> None:
    xyz = np.stack([np.arange(n), np.zeros(n), np.zeros(n)], axis=1).astype(np.float32)
    around = neighborhood(xyz, SETTINGS)
    assert around.index.shape == around.adjoining.shape == (n, min(n - 1, SETTINGS.neighbors))
    assert around.index.dtype == np.int32
    assert ((around.spacing >= 1) & (around.spacing <= 2)).all()
    for point, neighbors in enumerate(around.index):
        assert set(neighbors) <= set(range(n)) - {point}
        assert len(set(neighbors)) == len(neighbors)


@pytest.mark.parametrize(("width", "height", "stride"), [(50, 37, 1), (50, 37, 2), (50, 37, 3), (7, 4, 3), (2, 2, 2)])
def test_a_strided_camera_sees_the_strided_pixels(width: int, height: int, stride: int) -> None:
    camera = Camera(width, height, 40.0, 44.0, 0.4 * width, 0.6 * height, np.eye(4))
    small = strided(camera, stride)
    first = stride // 2
    kept = np.zeros((height, width))[first::stride, first::stride]
    assert (small.height, small.width) == kept.shape
    # The ray of every pixel center of the small camera is that of the pixel it stands for.
    column, row = np.meshgrid(np.arange(small.width), np.arange(small.height))
    ray_x, ray_y = (column + 0.5 - small.cx) / small.fx, (row + 0.5 - small.cy) / small.fy
    np.testing.assert_allclose(camera.fx * ray_x + camera.cx, first + stride * column + 0.5, atol=1e-9)
    np.testing.assert_allclose(camera.fy * ray_y + camera.cy, first + stride * row + 0.5, atol=1e-9)


def frontal(distance: float) -> Camera:
    pose = np.eye(4)
    pose[2, 3] = distance
    return Camera(40, 30, 100.0, 100.0, 20, 15, pose)


def test_near_plane_is_a_share_of_the_depth_of_what_is_in_front() -> None:
    xyz = np.array([[0, 0, 1], [0, 0, 2], [0, 0, 3], [0, 0, -50]], np.float32)
    assert near_plane(xyz, [frontal(0.0)]) == pytest.approx(2 * NEAR_SHARE)
    assert near_plane(xyz * 1000, [frontal(0.0)]) == pytest.approx(2000 * NEAR_SHARE)
    assert near_plane(xyz, [frontal(-100.0)]) > 0


def test_a_sample_of_points_does_not_depend_on_their_order() -> None:
    rng = np.random.default_rng(0)
    xyz = rng.normal(size=(5000, 3)).astype(np.float32)
    xyz[100] = -0.0
    order = rng.permutation(len(xyz))
    sample = sample_of_points(xyz, 1000)
    assert len(sample) == 1000
    assert (np.diff(sample) > 0).all()
    np.testing.assert_array_equal(np.sort(order[sample_of_points(xyz[order], 1000)]), sample)
    np.testing.assert_array_equal(sample_of_points(xyz, 5000), np.arange(5000))


@pytest.mark.parametrize(("unit", "same"), [(2.0**-10, 1000), (2.0**10, 1000), (0.001, 950), (1000.0, 950)])
def test_a_sample_of_points_does_not_depend_on_their_unit_of_length(unit: float, same: int) -> None:
    xyz = np.random.default_rng(1).normal(2, 3, size=(5000, 3)).astype(np.float32)
    sample = sample_of_points(xyz, 1000)
    # Powers of two are exact; others round a few points into the next cell.
    assert len(np.intersect1d(sample_of_points(xyz * np.float32(unit), 1000), sample)) >= same


def test_a_small_dense_core_leaves_a_sample_of_all() -> None:
    xyz = np.random.default_rng(3).normal(size=(20_000, 3)).astype(np.float32)
    xyz[11_000:] *= 50_000  # most points are in the core, whose width is what cells are made by
    sample = sample_of_points(xyz, 1000)
    assert 1000 <= len(sample) < 1100
    assert 300 < (sample >= 11_000).sum() < 600


def test_one_far_outlier_or_one_place_leaves_a_sample_of_points() -> None:
    xyz = np.random.default_rng(2).normal(size=(5000, 3)).astype(np.float32)
    xyz[0] = 3e38
    assert len(sample_of_points(xyz, 1000)) == 1000
    assert len(sample_of_points(np.zeros((50, 3), np.float32), 10)) == 50  # all of one place are drawn, or none


def test_chance_of_place_is_even_and_another_for_each_name() -> None:
    xyz = (np.indices((20, 20, 20)).reshape(3, -1).T * 0.01).astype(np.float32)  # a grid: few bits differ
    first, second = position_hash(xyz, "a"), position_hash(xyz, "b")
    for chance in (first, second):
        np.testing.assert_allclose(np.histogram(chance, 10, (0, 1))[0], 800, atol=120)
    assert abs(np.corrcoef(first, second)[0, 1]) < 0.05


def test_ctrl_c_waits_for_threads_that_are_looking_up_neighbors() -> None:
    class Tree:
        ended = False

        def query(self, xyz: NDArray[np.floating], k: int, workers: int) -> tuple[NDArray, NDArray]:
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
            time.sleep(0.1)
            self.ended = True
            return np.zeros(len(xyz)), np.zeros(len(xyz), int)

    tree = Tree()
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore Ctrl-C
    try:
        with pytest.raises(KeyboardInterrupt):
            nearest_in(tree, grid(2))  # pyright: ignore[reportArgumentType]
    finally:
        signal.signal(signal.SIGINT, before)
    assert tree.ended  # else scipy's threads would go on in memory that is gone, and end the process


def test_neighbors_looked_up_a_few_at_a_time_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    xyz = np.random.default_rng(5).random((300, 3)).astype(np.float32)
    xyz[7] = xyz[200]  # a duplicate: the point itself is not always the first found
    at_once = neighborhood(xyz, GeometrySettings())
    monkeypatch.setattr(geometry, "POINTS_PER_QUERY", 37)
    few = neighborhood(xyz, GeometrySettings())
    for name in ("spacing", "index", "adjoining"):
        np.testing.assert_array_equal(getattr(few, name), getattr(at_once, name))
