"""Feature colours against their definition, and pictures against what a small scene must show in which cell."""

import re

import cv2
import numpy as np
import pytest

from og_pointcloud.errors import SceneError
from og_pointcloud.rendering.splatting import Gaussians
from og_pointcloud.scene import Camera, View
from og_pointcloud.show.fit_pictures import (
    GAP,
    GREY,
    MARGIN,
    STRIP,
    FeatureColors,
    feature_colors,
    feature_picture,
    training_picture,
)

WIDTH, HEIGHT = 80, 60


def ahead(width=WIDTH, height=HEIGHT):
    """A camera at the origin that looks along z."""
    return Camera(width, height, width / 1.6, width / 1.6, width / 2, height / 2, np.eye(4))


def wall():
    """A closed wall at z = 2 that fills the image, and which of its points are on the right."""
    x, y = np.meshgrid(np.linspace(-2, 2, 81), np.linspace(-1.5, 1.5, 61))
    xyz = np.stack([x.ravel(), y.ravel(), np.full(x.size, 2.0)], axis=1).astype(np.float32)
    n = len(xyz)
    rotation = np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1))
    return Gaussians(xyz, np.full((n, 3), 0.03, np.float32), rotation, np.full(n, 0.95, np.float32)), xyz[:, 0] > 0


def view(name, camera=None, image=None):
    camera = camera or ahead()
    none = np.full((camera.height, camera.width), -1, np.int32)
    return View(name, camera, none, np.zeros((0, 4), np.float32), image)


def cell(sheet, row, column, size=(WIDTH, HEIGHT)):
    left, top = MARGIN + column * (size[0] + GAP), STRIP + row * (STRIP + size[1] + GAP) + STRIP
    return sheet[top : top + size[1], left : left + size[0]]


def halves(image):
    """Median colours of the left and of the right half, away from the border between them."""
    width = image.shape[1]
    left, right = image[5:-5, 5 : width // 2 - 5], image[5:-5, width // 2 + 5 : -5]
    return np.median(left, axis=(0, 1)), np.median(right, axis=(0, 1))


def read(path):
    return cv2.imread(str(path))[:, :, ::-1]


def test_colours_are_the_weighted_main_directions():
    random = np.random.default_rng(0)
    features = random.normal(size=(500, 6)) @ np.diag([1, 5, 0.1, 3, 0.1, 2]) + 7
    weight = random.random(500)
    colors = feature_colors(features, weight).astype(float) / 255
    center = np.average(features, axis=0, weights=weight)
    for channel, axis in enumerate((1, 3, 5)):
        along = features[:, axis] - center[axis]
        inside = (colors[:, channel] > 0) & (colors[:, channel] < 1)
        assert 0.8 < inside.mean() < 0.95, "the ends are cut off"
        assert np.corrcoef(along[inside], colors[inside, channel])[0, 1] > 0.99, "its sign is fixed too"


def test_the_map_is_linear_and_the_same_for_every_stage():
    random = np.random.default_rng(1)
    features = random.normal(size=(300, 6))
    colors = FeatureColors.fit(features, np.ones(300))
    middle = colors.center + 0.2 * (features[:2] - colors.center)
    halfway = colors(middle.mean(axis=0)[None]).astype(float)
    assert np.abs(halfway - colors(middle).mean(axis=0)).max() <= 1
    assert np.array_equal(colors(features[7:9]), colors(features)[7:9])


def test_colours_do_not_depend_on_order_or_on_doubled_points():
    random = np.random.default_rng(2)
    features, weight = random.normal(size=(400, 6)), random.random(400)
    order = random.permutation(400)
    expected = feature_colors(features, weight)
    shuffled = feature_colors(features[order], weight[order])
    assert np.abs(shuffled.astype(int) - expected[order]).max() <= 1
    doubled = feature_colors(np.concatenate([features, features]), np.concatenate([weight, weight]))
    assert np.abs(doubled[:400].astype(int) - expected).max() <= 1


def test_points_without_weight_or_feature_are_grey_and_move_nothing():
    random = np.random.default_rng(3)
    features, weight = random.normal(size=(100, 6)), np.ones(100)
    expected = feature_colors(features, weight)
    strange = np.concatenate([features, 1e6 * random.normal(size=(20, 6)), np.full((5, 6), np.nan)])
    colors = feature_colors(strange, np.concatenate([weight, np.zeros(20), np.ones(5)]))
    assert np.array_equal(colors[:100], expected)
    assert (colors[100:] == GREY).all()


def test_weights_count_as_repetitions():
    random = np.random.default_rng(5)
    features, times = random.exponential(size=(300, 6)) ** 2, random.integers(0, 5, 300)
    repeated = np.repeat(features, times, axis=0)
    assert np.array_equal(
        np.repeat(feature_colors(features, times), times, axis=0), feature_colors(repeated, np.ones(len(repeated)))
    )


def test_a_cloud_that_no_view_sees_is_grey():
    assert (feature_colors(np.random.default_rng(6).normal(size=(9, 6)), np.zeros(9)) == GREY).all()


@pytest.mark.parametrize("features", [np.ones((5, 6)), np.ones((1, 6)), np.zeros((0, 6)), np.full((3, 6), np.nan)])
def test_features_that_are_all_one_are_mid_grey(features):
    colors = feature_colors(features, np.ones(len(features)))
    assert colors.shape == (len(features), 3)
    assert (np.abs(colors.astype(int) - 128) <= 1).all()


def test_narrow_features_have_colours_too():
    colors = feature_colors(np.array([[0.0], [1.0]]), np.ones(2))
    assert colors[0].tolist() == [43, 128, 128], "one standard deviation of 1.5 to either side"
    assert colors[1].tolist() == [212, 128, 128]


def test_faint_directions_are_not_blown_up():
    random = np.random.default_rng(4)
    features = np.stack([random.random(1000), 1e-3 * random.random(1000)], axis=1)
    assert np.ptp(feature_colors(features, np.ones(1000))[:, 1].astype(int)) <= 2


def test_a_picture_shows_each_stage_under_each_view(tmp_path):
    gaussians, right = wall()
    features = np.where(right[:, None], [1.0, 0, 0, 0, 0, 0], [0, 1.0, 0, 0, 0, 0])
    unknown = np.where(right[:, None], np.nan, features)
    photo = np.full((HEIGHT, WIDTH, 3), (10, 200, 30), np.uint8)
    views = [view("first", image=photo), view("second", image=lambda: photo), view("third"), view("fourth")]
    stages = {"features": features, "left half": unknown}
    path = feature_picture(gaussians, views, 0.1, stages, tmp_path / "f.png", columns=2)
    sheet = read(path)
    assert sheet.shape == (STRIP + 3 * (STRIP + HEIGHT + GAP), 2 * (MARGIN + WIDTH) + GAP, 3)
    assert (cell(sheet, 0, 0) == (10, 200, 30)).all()
    assert (cell(sheet, 0, 1) == 255).all(), "the last view has no image"
    for column in (0, 1):
        left, right_color = halves(cell(sheet, 1, column))
        assert np.abs(left - right_color).max() > 150
        left_again, grey = halves(cell(sheet, 2, column))
        assert np.array_equal(left_again, left), "one map for all stages"
        assert np.array_equal(grey, GREY)
    assert list(tmp_path.iterdir()) == [path]


def test_what_no_gaussian_covers_is_white(tmp_path):
    gaussians, right = wall()
    half = Gaussians(*(getattr(gaussians, name)[right] for name in ("xyz", "scale", "rotation", "opacity")))
    feature_picture(half, [view("a")], 0.1, {"features": np.ones((len(half), 6))}, tmp_path / "f.png")
    left, right_color = halves(cell(read(tmp_path / "f.png"), 0, 0))
    assert (left == 255).all()
    assert (np.abs(right_color - 128) <= 1).all()


def test_large_views_are_shrunk_and_long_names_cut(tmp_path):
    gaussians, right = wall()
    stages = {"features": right[:, None].astype(float)}
    name = "a/very/long/name/" * 10 + "7"
    camera = ahead(1600, 1200)
    feature_picture(gaussians, [view(name, camera)], 0.1, stages, tmp_path / "i.png")
    sheet = read(tmp_path / "i.png")
    assert sheet.shape == (STRIP + STRIP + 270 + GAP, 360 + 2 * MARGIN, 3)
    strip = sheet[:STRIP]
    assert (strip[:, : MARGIN - 2] == 255).all()
    assert (strip[:, -MARGIN + 2 :] == 255).all(), "the name ends within its column"
    assert (strip < 100).any()


@pytest.mark.parametrize(
    ("stages", "views", "text"),
    [
        ({}, 1, "0 stages"),
        ({"short": np.ones((5, 6))}, 1, r"'short' has shape \(5, 6\); expected 4941 rows"),
        ({"flat": np.ones(4941)}, 1, "'flat' has shape"),
        ({"narrow": np.ones((4941, 0))}, 1, r"'narrow' has shape \(4941, 0\)"),
        ({"a": np.ones((4941, 6)), "b": np.ones((4941, 5))}, 1, "differ in shape"),
        ({"a": np.ones((4941, 6))}, 0, "4 columns of 0 views"),
    ],
)
def test_stages_that_do_not_fit_are_refused(stages, views, text, tmp_path):
    gaussians, _ = wall()
    with pytest.raises(SceneError, match=text):
        feature_picture(gaussians, [view("a")] * views, 0.1, stages, tmp_path / "f.png")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("shape", [(5, 0), (5,), (4, 3)])
def test_features_without_a_color_are_refused(shape):
    with pytest.raises(SceneError, match=rf"float64 {re.escape(str(shape))}, their weights \(5,\); expected numbers"):
        feature_colors(np.ones(shape), np.ones(5))


def test_a_training_is_drawn_stage_by_stage(tmp_path):
    stages = [
        {"stage": name, "steps": 10, "published_steps": 20_000, "loss": loss}
        for name, loss in (("features", [1.0, 0.5, 0.25]), ("coarse codebook", [2.0, 0.0]), ("fine codebook", [0.1]))
    ]
    picture = cv2.imread(str(training_picture(stages, tmp_path / "t.png")))[:, :, ::-1].astype(int)
    assert picture.shape[1] == 3 * 360
    blue = picture[:, :, 2] - picture[:, :, 0] > 80
    first, second, third = (blue[:, 360 * panel : 360 * (panel + 1)] for panel in range(3))
    heights = [np.argwhere(first[:, column])[:, 0].mean() for column in (12, 178, 346)]
    assert np.diff(heights) == pytest.approx([100, 50], abs=4), "from one to a half to a quarter of 200 pixels"
    assert second.any()
    assert third.any()
