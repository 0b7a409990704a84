"""Crops: LangSplat's recipe written plainly, the window at the image's edge, the blend, and Pillow's resampling."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from og_pointcloud.errors import SceneError
from og_pointcloud.masking.crops import LANGSPLAT, Crop, mask_box, mask_crops

RNG = np.random.default_rng(0)
IMAGE = RNG.integers(1, 256, (50, 70, 3), np.uint8)


def _ellipse(top, left, height, width):
    rows, columns = np.mgrid[:50, :70]
    return (((rows - top - height / 2 + 0.5) / height) ** 2 + ((columns - left - width / 2 + 0.5) / width) ** 2) <= 0.25


@pytest.mark.parametrize(("height", "width"), [(20, 32), (32, 20), (32, 32), (31, 32), (32, 31)])
def test_langsplats_crop_is_black_outside_tight_and_padded_to_a_square(height, width):
    mask = _ellipse(5, 9, height, width)
    alone = np.where(mask[..., None], IMAGE, 0)
    top, left, tall, wide = mask_box(mask)
    box = alone[top : top + tall, left : left + wide]
    side = max(tall, wide)
    square = np.zeros((side, side, 3), np.uint8)
    down, right = (side - tall) // 2, (side - wide) // 2
    square[down : down + tall, right : right + wide] = box
    assert (mask_crops(IMAGE, mask[None], LANGSPLAT[0], side)[0] == square).all()


def test_a_window_beyond_the_images_edge_is_filled():
    mask = np.zeros((50, 70), bool)
    mask[:10, :10] = True
    crop = mask_crops(IMAGE, mask[None], Crop(2.0, 1.0), 20, (7, 8, 9))[0]
    assert (crop[:5] == (7, 8, 9)).all()
    assert (crop[:, :5] == (7, 8, 9)).all()
    assert (crop[5:, 5:] == IMAGE[:15, :15]).all(), "outside 1: the image as it is"


@pytest.mark.parametrize("name", ["bilinear", "bicubic"])
@pytest.mark.parametrize("place", [(0, 0), (20, 50), (35, 3)])
def test_a_shrunk_window_beyond_the_edge_is_the_filled_image_shrunk(place, name):
    top, left = place
    mask = np.zeros((50, 70), bool)
    mask[top : top + 15, left : left + 15] = True
    crop, fill = Crop(6.0, 1.0), (7, 80, 200)
    canvas = np.full((250, 270, 3), fill, np.uint8)
    canvas[100:150, 100:170] = IMAGE
    corner = [100 + at - (90 - 15) // 2 for at in place]
    window = canvas[corner[0] : corner[0] + 90, corner[1] : corner[1] + 90]
    expected = pillow_resized(window, 12, {"bilinear": 2, "bicubic": 3}[name])
    assert (mask_crops(IMAGE, mask[None], crop, 12, fill, name)[0] == expected).all()


def test_outside_the_mask_the_image_is_blended():
    mask = _ellipse(10, 10, 20, 20)
    top, left, tall, wide = mask_box(mask)
    crop = mask_crops(IMAGE, mask[None], Crop(1.0, 0.25), max(tall, wide), (100, 100, 100))[0]
    own, seen = mask[top : top + tall, left : left + wide], IMAGE[top : top + tall, left : left + wide]
    assert (crop[own] == seen[own]).all()
    assert np.abs(crop[~own] - (0.25 * seen[~own] + 75)).max() <= 0.51


def test_a_translated_scene_gives_the_same_crops():
    canvas = np.full((120, 140, 3), 50, np.uint8)
    mask = np.zeros((120, 140), bool)
    canvas[30:80, 40:110], mask[30:80, 40:110] = IMAGE, _ellipse(8, 12, 20, 30)
    moved = [np.roll(array, (9, -13), axis=(0, 1)) for array in (canvas, mask)]
    first, second = (mask_crops(a, b[None], Crop(1.4, 0.4), 24) for a, b in ((canvas, mask), moved))
    assert (first == second).all()


def test_one_pixel_and_the_whole_image_are_masks_too():
    masks = np.zeros((2, 50, 70), bool)
    masks[0, 49, 69] = masks[1] = True
    crops = mask_crops(IMAGE, masks, Crop(), 16)
    assert (crops[0] == IMAGE[49, 69]).all()
    assert crops[1][0].max() == 0, "70 wide, 50 tall: black above"
    assert crops[1][8].min() > 0
    assert mask_crops(IMAGE, masks[:0], Crop(), 16).shape == (0, 16, 16, 3)


def test_what_does_not_fit_is_refused():
    whole = np.ones((1, 50, 70), bool)
    with pytest.raises(SceneError, match="float64"):
        mask_crops(IMAGE / 255, whole, Crop(), 8)
    with pytest.raises(SceneError, match="the size of the image"):
        mask_crops(IMAGE, whole[:, :20], Crop(), 8)
    with pytest.raises(SceneError, match="no pixel"):
        mask_crops(IMAGE, ~whole, Crop(), 8)
    for wrong in ({"scale": 0.5}, {"outside": 1.5}, {"weight": 0.0}, {"weight": float("nan")}):
        with pytest.raises(SceneError, match="cannot be cut"):
            Crop(**wrong)


@pytest.mark.parametrize("side", [37, 91, 224, 12, 50])
@pytest.mark.parametrize(("name", "number"), [("bilinear", 2), ("bicubic", 3)])
def test_resizing_is_pillows(side, name, number):
    expected = pillow_resized(IMAGE[:, :50], side, number)
    crop = mask_crops(IMAGE[:, :50], np.ones((1, 50, 50), bool), Crop(), side, resample=name)[0]
    assert (crop == expected).all()


def pillow_resized(image, side, number):
    image = Image.fromarray(np.ascontiguousarray(image))
    return np.asarray(image.resize((side, side), Image.Resampling(number))).astype(int)


def test_shrinking_counts_every_pixel():
    image = np.zeros((64, 64, 3), np.uint8)
    image[::2, ::2] = 255
    shrunk = mask_crops(image, np.ones((1, 64, 64), bool), Crop(), 8)[0].astype(int)
    assert np.abs(shrunk - 64)[1:-1, 1:-1].max() <= 3, "without smoothing it would be 0 or 255"
