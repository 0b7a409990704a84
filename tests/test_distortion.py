"""Undistorted masks against OpenCV's own projection: a point lands where the pinhole camera says."""

from functools import partial

import cv2
import numpy as np
import pytest

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.distortion import Distortion, lens_distortion, undistorted
from og_pointcloud.scene import Camera, View

WIDTH, HEIGHT = 320, 240
CAMERA = Camera(WIDTH, HEIGHT, 260.0, 255.0, 165.0, 117.0, np.eye(4))
LENSES = {
    "barrel": (False, {"k1": -0.2, "k2": 0.04}),
    "pincushion": (False, {"k1": 0.15}),
    "opencv": (False, {"k1": -0.2, "k2": 0.05, "p1": 0.004, "p2": -0.006}),
    "rational": (False, {"k1": 0.3, "k2": 0.05, "k3": 0.01, "k4": 0.5, "k5": 0.1, "p1": 0.002, "k6": 0.02}),
    "fisheye": (True, {"k1": 0.03, "k2": -0.01, "k3": 0.002}),
    "equidistant": (True, {}),
}


def lens(name):
    fisheye, values = LENSES[name]
    distortion = lens_distortion(values, fisheye=fisheye)
    assert distortion is not None
    return distortion


def distorted_pixels(points, distortion):
    """Pixel coordinates (centres at +0.5) at which the lens images 3-D points."""
    matrix = np.array([[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1]])
    project = cv2.fisheye.projectPoints if distortion.fisheye else cv2.projectPoints
    zero, terms = np.zeros(3), np.array(distortion.coefficients)
    arguments = (zero, zero, matrix, terms)
    return project(points.reshape(-1, 1, 3), *arguments)[0].reshape(-1, 2)


def points_on_a_grid():
    """3-D points whose pinhole pixels are well apart, all over the image, at different depths."""
    u, v = np.meshgrid(np.arange(20.3, WIDTH - 15, 25), np.arange(18.7, HEIGHT - 15, 25))
    depth = np.linspace(1.0, 9.0, u.size)
    x = (u.ravel() - CAMERA.cx) / CAMERA.fx * depth
    y = (v.ravel() - CAMERA.cy) / CAMERA.fy * depth
    return np.stack([x, y, depth], 1), np.stack([u.ravel(), v.ravel()], 1)


@pytest.mark.parametrize("name", LENSES)
def test_a_mask_painted_through_the_lens_is_found_at_the_pinhole_pixel(name):
    distortion = lens(name)
    points, pinhole_pixels = points_on_a_grid()
    painted = np.full((HEIGHT, WIDTH), -1, np.int32)
    pixels = distorted_pixels(points, distortion)
    seen = ((pixels > 3) & (pixels < [WIDTH - 3, HEIGHT - 3])).all(1)
    assert seen.sum() > 50
    for row in np.flatnonzero(seen):
        j, i = np.floor(pixels[row]).astype(int)
        painted[i - 2 : i + 3, j - 2 : j + 3] = row
    features = np.ones((len(points), 4), np.float32)
    view = View("v", CAMERA, partial(undistorted(CAMERA, distortion).mask_ids, painted), features)
    found = view.mask_map()
    j, i = np.floor(pinhole_pixels[seen]).astype(int).T
    np.testing.assert_array_equal(found[i, j], np.flatnonzero(seen))
    # And nothing but ids that were painted: nearest never mixes two.
    assert set(np.unique(found)) == {-1, *np.flatnonzero(seen)}


@pytest.mark.parametrize("name", LENSES)
def test_a_mark_in_the_image_moves_to_the_pinhole_pixel(name):
    distortion = lens(name)
    points, pinhole_pixels = points_on_a_grid()
    middle = len(points) // 2 + 5
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    u, v = distorted_pixels(points[middle : middle + 1], distortion)[0]
    image[:] = np.round(250 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / 18.0))[..., None]
    out = undistorted(CAMERA, distortion).image(image)[..., 0].astype(float)
    assert out.shape == (HEIGHT, WIDTH)
    weight = np.where(out > 25, out, 0)
    centroid = np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()
    assert np.abs(centroid - pinhole_pixels[middle]).max() < 0.25


@pytest.mark.parametrize("k1", [1e-9, -1e-9])
def test_hardly_any_distortion_changes_no_pixel(k1):
    ids = np.arange(WIDTH * HEIGHT, dtype=np.int32).reshape(HEIGHT, WIDTH)
    np.testing.assert_array_equal(undistorted(CAMERA, Distortion(False, (k1, *[0.0] * 7))).mask_ids(ids), ids)


def test_pixels_the_lens_never_saw_are_outside_every_mask():
    maps = undistorted(CAMERA, lens("pincushion"))
    ids = maps.mask_ids(np.zeros((HEIGHT, WIDTH), np.int32))
    assert ids[0, 0] == -1
    assert ids[HEIGHT // 2, WIDTH // 2] == 0
    assert (maps.image(np.full((HEIGHT, WIDTH, 3), 200, np.uint8))[0, 0] == 0).all()


def test_a_polynomial_that_turns_back_shows_nothing_twice():
    """1 - r^2 is largest at r = 0.577: beyond that the same content would come again, mirrored."""
    wide = Camera(WIDTH, HEIGHT, 120.0, 120.0, 160.0, 120.0, np.eye(4))
    maps = undistorted(wide, Distortion(False, (-1.0, 0, 0, 0, 0, 0, 0, 0)))
    ids = maps.mask_ids(np.zeros((HEIGHT, WIDTH), np.int32))
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    radius = np.hypot((x - 160) / 120, (y - 120) / 120)
    assert (ids[radius < 0.57] == 0).all()
    assert (ids[radius > 0.585] == -1).all()


def test_views_with_the_same_lens_share_its_maps():
    moved = Camera(WIDTH, HEIGHT, 260.0, 255.0, 165.0, 117.0, np.diag([1.0, -1.0, -1.0, 1.0]))
    assert undistorted(CAMERA, lens("barrel")) is undistorted(moved, lens("barrel"))
    assert undistorted(CAMERA, lens("barrel")) is not undistorted(CAMERA.resized(160, 120), lens("barrel"))


def test_a_halved_image_is_undistorted_alike():
    """Coefficients belong to normalised coordinates, so scaling camera and mask commutes with undistorting."""
    x = undistorted(CAMERA, lens("opencv")).x
    half = undistorted(CAMERA.resized(WIDTH // 2, HEIGHT // 2), lens("opencv")).x
    # The centre of a half-size pixel lies midway between those of two whole ones on the diagonal.
    midway = (x[::2, ::2] + x[1::2, 1::2]) / 2 + 0.5
    assert np.abs((half + 0.5) * 2 - midway).max() < 0.01


def test_named_terms():
    assert lens_distortion({"k1": 0.0, "p1": 0.0}, fisheye=False) is None
    assert lens_distortion({}, fisheye=True) == Distortion(True, (0, 0, 0, 0))
    with pytest.raises(SceneError, match=r"the term omega = 0\.9; expected only k1"):
        lens_distortion({"omega": 0.9}, fisheye=False)
    with pytest.raises(SceneError, match="expected finite numbers"):
        lens_distortion({"k1": np.nan}, fisheye=False)


def test_a_mask_of_another_size_is_refused():
    with pytest.raises(SceneError, match=r"the mask map is \(10, 10\); expected the camera's \(240, 320\)"):
        undistorted(CAMERA, lens("barrel")).mask_ids(np.zeros((10, 10), np.int32))
