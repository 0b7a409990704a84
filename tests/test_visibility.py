"""Blending weights against a literal reference, on easy and hard scenes, and under changes that must not matter; and
the mask table of several views."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import Any

import numba
import numpy as np
import pytest
from numpy.random import Generator
from numpy.typing import NDArray
from reference_splatting import reference_pixel_weights, rotation_matrix, round_splats
from scipy.sparse import csr_array

from og_pointcloud.errors import SceneError
from og_pointcloud.fitting.mask_table import MaskTable, mask_table
from og_pointcloud.rendering import splatting
from og_pointcloud.rendering.sightings import sightings
from og_pointcloud.rendering.splatting import Gaussians, render, view_weights
from og_pointcloud.scene import Camera, Points, View

NEAR = 0.25
MASKS = 12
DOT = round_splats([[0, 0, 1]], 0, 0.5)
TWENTY_IN_A_ROW = round_splats(np.linspace([0, 0, 1], [0, 0, 2], 20), 50)


def camera(width: int = 50, height: int = 37, focal: float = 40.0, **changes: float | NDArray[np.float64]) -> Camera:
    """At the origin, looking along z; 50 x 37 pixels are not a whole number of tiles."""
    plain = Camera(width, height, focal, 1.1 * focal, width / 2, height / 2, np.eye(4))
    return replace(plain, **changes)


def cloud(random: Generator, n: int = 150) -> Gaussians:
    """Blobs from a fifth of a pixel to half the image, in front of the camera and around its view."""
    quaternions = random.normal(size=(n, 4))
    return Gaussians(
        random.uniform([-2, -2, 0.5], [2, 2, 6], (n, 3)).astype(np.float32),
        (10 ** random.uniform(-2.5, -0.5, (n, 3))).astype(np.float32),
        (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).astype(np.float32),
        random.uniform(0, 1, n).astype(np.float32),
    )


def stretched(axes: slice, factor: float) -> Callable[[Generator], tuple[Gaussians, Camera]]:
    def build(random: Generator) -> tuple[Gaussians, Camera]:
        gaussians = cloud(random)
        scale = gaussians.scale.copy()
        scale[:, axes] *= np.float32(factor)
        return replace(gaussians, scale=scale), camera()

    return build


def sized(scale: float) -> Callable[[Generator], tuple[Gaussians, Camera]]:
    return lambda random: (replace(cloud(random), scale=np.full((150, 3), scale, np.float32)), camera())


def moved(move: Callable[[Generator, NDArray[np.float32]], None]) -> Callable[[Generator], tuple[Gaussians, Camera]]:
    def build(random: Generator) -> tuple[Gaussians, Camera]:
        gaussians = cloud(random)
        xyz = gaussians.xyz.copy()
        move(random, xyz)
        return replace(gaussians, xyz=xyz), camera()

    return build


def about_the_near_plane(random: Generator, xyz: NDArray[np.float32]) -> None:
    near = np.float32(NEAR)
    depths = [-1, -1e-3, 0, 1e-30, 0.24, near, np.nextafter(near, np.float32(1)), 0.26, 1]
    xyz[:, 2] = random.choice(np.array(depths, np.float32), 150)
    xyz[:, :2] *= 0.1


def far_outside(random: Generator, xyz: NDArray[np.float32]) -> None:
    xyz[:, :2] *= np.float32(10) ** random.uniform(0, 6, (150, 1)).astype(np.float32)


def on_five_spots(random: Generator, xyz: NDArray[np.float32]) -> None:
    xyz[:] = xyz[random.integers(0, 5, 150)]


def on_one_plane(_: Generator, xyz: NDArray[np.float32]) -> None:
    xyz[:, 2] = 3


def long_needles_from_outside(random: Generator) -> tuple[Gaussians, Camera]:
    gaussians = cloud(random)
    scale = np.full((150, 3), 1e-3, np.float32)
    scale[:, 0] = 100
    return replace(gaussians, xyz=gaussians.xyz * np.array([10, 10, 1], np.float32), scale=scale), camera()


HARD_SCENES: dict[str, Callable[[Generator], tuple[Gaussians, Camera]]] = {
    "plain": lambda random: (cloud(random), camera()),
    "needles 1e6 long": stretched(slice(0, 1), 1e6),
    "needles 1e3 long": stretched(slice(0, 1), 1e3),
    "needles 1e-6 thin": stretched(slice(1, 3), 1e-6),
    "needles from outside": long_needles_from_outside,
    "pancakes 1e-6 thick": stretched(slice(0, 1), 1e-6),
    "pancakes 1e3 wide": stretched(slice(0, 2), 1e3),
    "opacity 0 and 1": lambda random: (
        replace(cloud(random), opacity=random.integers(0, 2, 150).astype(np.float32)),
        camera(),
    ),
    "scale 0": sized(0),
    "scale 1e-30": sized(1e-30),
    "scale 100": sized(100),
    "scale 1e6": sized(1e6),
    "scale 1e18": sized(1e18),
    "near plane": moved(about_the_near_plane),
    "far outside": moved(far_outside),
    "coincident": moved(on_five_spots),
    "one depth": moved(on_one_plane),
    "principal point outside": lambda random: (cloud(random), camera(cx=-30.0, cy=70.0)),
    "one pixel": lambda random: (cloud(random), camera(1, 1, 1.0)),
    "one row": lambda random: (cloud(random), camera(100, 1)),
    "exact tiles": lambda random: (cloud(random), camera(64, 32)),
    "telephoto": lambda random: (cloud(random), camera(focal=4000.0)),
    "one point": lambda random: (replace(cloud(random, 1), xyz=np.array([[0.1, 0.1, 1]], np.float32)), camera()),
}


@pytest.fixture(params=HARD_SCENES)
def hard_scene(request: pytest.FixtureRequest) -> tuple[Gaussians, Camera]:
    return HARD_SCENES[request.param](np.random.default_rng(list(HARD_SCENES).index(request.param)))


def patches(view: Camera, count: int = MASKS, size: int = 5) -> NDArray[np.int32]:
    """Ids -1..count-1 in square patches."""
    random = np.random.default_rng(1)
    coarse = random.integers(-1, count, (view.height // size + 1, view.width // size + 1))
    return coarse.repeat(size, 0).repeat(size, 1)[: view.height, : view.width].astype(np.int32)


def assert_weights(actual: csr_array, expected: NDArray[np.float64]) -> None:
    """The same entries; float32 weights within 1e-4 of themselves (the rotation of a needle 1e6 pixels long is given
    in float32) and far better in the mean."""
    dense = actual.toarray().astype(np.float64)
    np.testing.assert_array_equal(dense > 0, expected > 0)
    np.testing.assert_allclose(dense, expected, rtol=1e-4, atol=1e-6)
    assert np.abs(dense - expected).sum() <= 1e-5 * expected.sum()


def image_weights(gaussians: Gaussians, view: Camera) -> NDArray[np.float32]:
    return view_weights(gaussians, view, NEAR).toarray()


def expected_weights(gaussians: Gaussians, view: Camera) -> NDArray[np.float64]:
    return reference_pixel_weights(gaussians, view, NEAR).reshape(-1, len(gaussians))


@pytest.mark.parametrize("off_axis", [0.0, 2.5, -40.0])
def test_splats_that_are_passed_over_would_show_in_no_pixel(off_axis: float):
    """Opaque splats of every size about the borders of an image, one after the other from left to right, so that whole
    runs are passed over: what is projected, and what that keeps."""
    random = np.random.default_rng(0)
    view, n = camera(cx=25 + 10 * off_axis), 20_000
    scale = 10 ** random.uniform(-3, 0.3, (n, 3))
    depth = random.uniform(0.1, 6, n)
    pixel = random.uniform(-4, 5, (n, 2)) * [view.width, view.height]
    pixel[:, 0].sort()
    xyz = np.column_stack([(pixel - [view.cx, view.cy]) / [view.fx, view.fy] * depth[:, None], depth])
    quaternions = random.normal(size=(n, 4))
    quaternions *= 1.001 / np.linalg.norm(quaternions, axis=1, keepdims=True)
    shapes = (*(part.astype(np.float32) for part in (xyz, scale, quaternions)), *np.ones((2, n), np.float32))
    intrinsics = np.array([view.fx, view.fy, view.cx, view.cy])
    seen_by = view.world_to_camera, intrinsics, (view.width, view.height), NEAR
    splats = splatting._records(n)
    shows = splatting._project(np.arange(n), shapes, seen_by, splats) != splatting.CULLED
    borders = splatting._frustum_planes(seen_by)
    looked_at = splatting._in_frustum(*shapes[:2], splatting._boxes(*shapes[:2]), borders)
    assert shows.sum() > 500
    assert looked_at[shows].all()
    assert looked_at.sum() < shows.sum() + 0.5 * (~shows).sum()


def test_weights_equal_the_reference(hard_scene: tuple[Gaussians, Camera]) -> None:
    actual = view_weights(*hard_scene, NEAR)
    assert_weights(actual, expected_weights(*hard_scene))
    assert (actual.sum(axis=1) <= 1 + 1e-6).all()
    assert (actual.data > 0).all()
    entries = actual.tocoo()
    assert len(np.unique(entries.row.astype(np.int64) * actual.shape[1] + entries.col)) == actual.nnz


def test_exposure_is_a_share(hard_scene: tuple[Gaussians, Camera]) -> None:
    gaussians, camera = hard_scene
    table = table_of(gaussians, [view_of(camera)])
    assert ((table.exposure.data > 0) & (table.exposure.data <= 1)).all()
    assert set(table.exposure.indices) == set(table.weights.indices) | set(table.outside.indices)


def test_hard_scenes_are_not_empty() -> None:
    drawn = {}
    for index, (name, build) in enumerate(HARD_SCENES.items()):
        gaussians, view = build(np.random.default_rng(index))
        drawn[name] = np.count_nonzero(image_weights(gaussians, view))
    assert min(drawn.values()) > 0, drawn


def test_pixels_that_are_left_out_have_no_row(random: Generator) -> None:
    gaussians, view = cloud(random), camera()
    wanted = patches(view) % 3 == 0
    wanted[16:32, :32] = False  # two whole tiles
    some = view_weights(gaussians, view, NEAR, wanted)
    np.testing.assert_array_equal(some.toarray(), image_weights(gaussians, view)[wanted.ravel()])


def test_nothing_in_view_gives_empty_rows(random: Generator) -> None:
    rows = view_weights(replace(cloud(random), xyz=-cloud(random).xyz), camera(), NEAR)
    assert (rows.shape, rows.nnz) == ((50 * 37, 150), 0)


def test_one_splat_by_hand() -> None:
    """A point-like splat on a pixel center: covariance 0.3, so alpha falls with exp(-d^2 / 0.6)."""
    image = image_weights(DOT, camera(5, 5, 10.0, fy=10.0)).reshape(5, 5)
    np.testing.assert_allclose(image[2, 2], 0.5, rtol=1e-6)
    np.testing.assert_allclose(image[2, 3], 0.5 * np.exp(-1 / 0.6), rtol=1e-6)
    np.testing.assert_allclose(image[1, 1], 0.5 * np.exp(-2 / 0.6), rtol=1e-6)
    assert image[2, 4] == 0  # 0.5 exp(-4 / 0.6) is below 1/255


def test_of_coincident_splats_the_lower_index_is_in_front() -> None:
    weights = image_weights(round_splats([[0, 0, 2]] * 3, 10, 0.5), camera(3, 3))[4]
    np.testing.assert_allclose(weights, [0.5, 0.25, 0.125], rtol=1e-3)


def test_a_pixel_stops_before_its_transmittance_falls_below_the_limit() -> None:
    weights = image_weights(TWENTY_IN_A_ROW, camera(1, 1))[0]
    np.testing.assert_allclose(weights[:4], 0.9 * 0.1 ** np.arange(4), rtol=1e-3)
    assert (weights[4:] == 0).all()  # the fifth would leave 1e-5


@pytest.mark.parametrize(("opacity", "size"), [(0.02, 1), (0.9, 20)])
def test_hundreds_of_splats_in_a_tile_equal_the_reference(random: Generator, opacity: float, size: float) -> None:
    """Faint ones, all of which show, and dense ones, which finish the tile early."""
    gaussians, view = cloud(random, 400), camera(20, 12, 8.0)
    scale = np.minimum(gaussians.scale * np.float32(size), np.float32(3))
    gaussians = replace(gaussians, scale=scale, opacity=np.full(400, opacity, np.float32))
    expected = expected_weights(gaussians, view)
    assert ((expected > 0).any(axis=0).sum() > 300) == (size == 1)
    assert_weights(view_weights(gaussians, view, NEAR), expected)


def test_needles_across_many_tiles_equal_the_reference(random: Generator) -> None:
    gaussians = cloud(random, 60)
    scale = np.full((60, 3), 1e-3, np.float32)
    scale[:, 0] = random.uniform(0.1, 3, 60)
    gaussians, view = replace(gaussians, scale=scale), camera(160, 96, 100.0)
    expected = expected_weights(gaussians, view)
    assert (np.count_nonzero(expected, axis=0) > 100).sum() > 20
    assert_weights(view_weights(gaussians, view, NEAR), expected)


def test_order_of_points_does_not_matter(random: Generator) -> None:
    gaussians, view = cloud(random), camera()
    order = random.permutation(len(gaussians))
    shuffled = Gaussians(*(getattr(gaussians, name)[order] for name in ("xyz", "scale", "rotation", "opacity")))
    np.testing.assert_array_equal(image_weights(shuffled, view), image_weights(gaussians, view)[:, order])


def quaternion_product(left: NDArray[np.float64], right: NDArray[np.float32]) -> NDArray[np.float32]:
    w, x, y, z = left
    a, b, c, d = right.T
    return np.stack(
        [
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ],
        axis=1,
    ).astype(np.float32)


def test_rotation_of_the_world_does_not_matter(random: Generator) -> None:
    gaussians, view = cloud(random), camera()
    turn = np.array([0.1, 0.5, -0.7, 0.5])
    turn /= np.linalg.norm(turn)
    matrix = rotation_matrix(turn).astype(np.float64)
    pose = np.eye(4)
    pose[:3, :3] = matrix.T
    turned = replace(
        gaussians,
        xyz=(gaussians.xyz @ matrix.T).astype(np.float32),
        rotation=quaternion_product(turn, gaussians.rotation),
    )
    actual = image_weights(turned, replace(view, world_to_camera=pose))
    np.testing.assert_allclose(actual, image_weights(gaussians, view), atol=1e-3)


@pytest.fixture
def threads() -> Iterator[Callable[[int], None]]:
    before = numba.get_num_threads()
    yield numba.set_num_threads
    numba.set_num_threads(before)


def test_number_of_threads_does_not_matter(random: Generator, threads: Callable[[int], None]) -> None:
    gaussians, view = cloud(random, 1000), camera(100, 80, 80.0)
    results = []
    for count in (1, min(2, numba.config.NUMBA_NUM_THREADS), numba.config.NUMBA_NUM_THREADS):
        threads(count)
        results.append(image_weights(gaussians, view))
    for result in results[1:]:
        np.testing.assert_array_equal(result, results[0])


def view_of(camera: Camera, count: int = MASKS, name: str = "view") -> View:
    random = np.random.default_rng(count)
    return View(name, camera, patches(camera, count), random.normal(size=(count, 8)).astype(np.float32))


def table_of(
    gaussians: Gaussians, views: Iterable[View], near: float = NEAR, thickness: float = 0.1, **options: Any
) -> MaskTable:
    return mask_table(gaussians, views, near, np.full(len(gaussians), thickness, np.float32), **options)


def test_render_equals_the_weights_times_the_values(hard_scene: tuple[Gaussians, Camera]) -> None:
    gaussians, view = hard_scene
    values = np.random.default_rng(3).normal(size=(len(gaussians), 4)).astype(np.float32)
    image, covered = render(gaussians, values, view, NEAR)
    weights = reference_pixel_weights(gaussians, view, NEAR)
    np.testing.assert_allclose(image, weights @ values.astype(np.float64), rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(covered, weights.sum(axis=2), rtol=1e-4, atol=1e-5)


def test_table_is_the_views_stacked(random: Generator) -> None:
    gaussians = cloud(random)
    pose = np.eye(4)
    pose[:3, 3] = [0.3, -0.2, 0.5]
    views = [
        view_of(camera(), 5, "five"),
        view_of(camera(), 0, "none"),
        view_of(camera(40, 30, world_to_camera=pose), 3, "three"),
    ]
    table = table_of(gaussians, iter(views))
    assert table.weights.shape == (8, 150)
    assert table.outside.shape == table.exposure.shape == (3, 150)
    np.testing.assert_array_equal(table.mask_view, [0] * 5 + [2] * 3)
    np.testing.assert_array_equal(table.mask_features, np.concatenate([views[0].mask_features, views[2].mask_features]))
    for index, (view, masks) in enumerate(zip(views, (slice(0, 5), slice(5, 5), slice(5, 8)), strict=True)):
        ids = view.mask_map()
        shown = sightings(gaussians, view.camera, ids, view.mask_count, NEAR, np.full(150, 0.1, np.float32))
        np.testing.assert_array_equal(table.weights[masks].toarray(), shown.rows[:-1].toarray())
        np.testing.assert_array_equal(table.outside[[index]].toarray(), shown.rows[-1:].toarray())
        np.testing.assert_array_equal(table.exposure[[index]].toarray(), shown.openness.toarray())
        np.testing.assert_array_equal(
            table.mask_pixels[masks], [(ids == number).sum() for number in range(view.mask_count)]
        )


@pytest.mark.parametrize("layer", ["omp", "workqueue"])
def test_views_side_by_side_are_the_views_one_by_one(
    random: Generator, threads: Callable[[int], None], layer: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    gaussians = cloud(random)
    views = [view_of(camera(), count, f"view {count}") for count in (5, 3, 0, 8, 2, 6, 1)]
    threads(1)
    one_by_one = table_of(gaussians, iter(views))
    threads(min(2, numba.config.NUMBA_NUM_THREADS))
    monkeypatch.setattr(numba, "threading_layer", lambda: layer)
    table = table_of(gaussians, iter(views))
    for name in ("weights", "outside", "exposure"):
        np.testing.assert_array_equal(getattr(table, name).toarray(), getattr(one_by_one, name).toarray())
    np.testing.assert_array_equal(table.mask_view, one_by_one.mask_view)
    np.testing.assert_array_equal(table.mask_features, one_by_one.mask_features)
    assert numba.get_num_threads() == min(2, numba.config.NUMBA_NUM_THREADS)


def test_a_view_that_fails_ends_the_table_with_its_error(random: Generator) -> None:
    def views() -> Iterator[View]:
        for count in (5, 3, 2, 4):
            yield view_of(camera(), count)
        raise SceneError("mask of view 4 is damaged")

    with pytest.raises(SceneError, match="view 4 is damaged"):
        table_of(cloud(random), views())


def test_table_without_any_mask(random: Generator) -> None:
    table = table_of(cloud(random), [view_of(camera(), 0), view_of(camera(), 0)])
    assert table.weights.shape == (0, 150)
    assert len(table.mask_features) == len(table.mask_pixels) == len(table.mask_view) == 0
    assert table.outside.nnz > 0


def test_unit_features_have_length_one_or_stay_zero(random: Generator) -> None:
    features = np.array([[3, 4], [0, 0], [1e-15, 0]], np.float32)
    view = View("view", camera(), patches(camera(), 3), features)
    unit = table_of(cloud(random), [view]).unit_features
    assert unit.dtype == np.float32
    np.testing.assert_allclose(unit, [[0.6, 0.8], [0, 0], [1, 0]], rtol=1e-6)


def test_a_plain_cloud_is_refused() -> None:
    with pytest.raises(SceneError, match="no scale, rotation and opacity"):
        Gaussians.from_points(Points.from_world(np.zeros((2, 3))))
