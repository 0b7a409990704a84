"""OpenCV's region tree, the automatic grid of prompts, and masks that exist already."""

from __future__ import annotations

import json
import time
import tracemalloc
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest

from og_pointcloud.errors import SceneError
from og_pointcloud.masking.automatic import AutomaticMasks, grid, stability, suppress_duplicates, without_specks
from og_pointcloud.masking.contracts import Proposals
from og_pointcloud.masking.existing import CallableProposer, ExistingMasks, as_proposals, decode_rle, from_ids
from og_pointcloud.masking.opencv import OpenCVProposer, region_tree


def painted(noise=4.0, size=(120, 160)):
    """Three flat things on a grey ground, and the map of which is where (0 ground)."""
    ids = np.zeros(size, np.int32)
    ids[20:60, 15:60] = 1
    cv2.circle(ids, (110, 40), 25, 2, -1)
    ids[80:108, 40:128] = 3
    colors = np.array([(130, 130, 130), (200, 60, 60), (60, 90, 200), (70, 160, 80)], np.float32)
    image = colors[ids] + np.random.default_rng(0).normal(0, noise, (*size, 3))
    return np.clip(image, 0, 255).astype(np.uint8), ids


def iou(a, b):
    return (a & b).sum() / max(1, (a | b).sum())


# OpenCV ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(120, 160), (480, 640)])
def test_opencv_finds_flat_things(size):
    image, ids = painted()
    image = cv2.resize(image, size[::-1], interpolation=cv2.INTER_NEAREST)
    ids = cv2.resize(ids, size[::-1], interpolation=cv2.INTER_NEAREST)
    proposals = OpenCVProposer().propose(image)
    assert proposals.masks.shape[1:] == size
    for thing in (1, 2, 3):
        assert max(iou(mask, ids == thing) for mask in proposals.masks[:12]) > 0.9


def test_opencv_is_deterministic():
    image, _ = painted(noise=20)
    first, second = OpenCVProposer().propose(image), OpenCVProposer().propose(image)
    assert np.array_equal(first.masks, second.masks)
    assert np.array_equal(first.scores, second.scores)


def test_the_tree_is_a_tree_and_runs_are_its_regions():
    tree = region_tree(painted()[0])
    n, m = int(tree.superpixels.max()) + 1, len(tree.parent)
    assert m == 2 * n - 1
    assert (tree.parent < 0).sum() == 1
    assert (tree.parent[:-1] > np.arange(m - 1)).all()
    assert (tree.death >= tree.birth).all()
    place, runs = tree.runs()
    rank = place[tree.superpixels]
    inside: list[set[int]] = [{k} for k in range(n)] + [set() for _ in range(m - n)]
    for child, above in enumerate(tree.parent.tolist()):
        if above >= 0:
            inside[above] |= inside[child]
    for region in range(m):
        literal = np.isin(tree.superpixels, list(inside[region]))
        assert np.array_equal((rank >= runs[region, 0]) & (rank < runs[region, 1]), literal)
        assert tree.area[region] == literal.sum()


@pytest.mark.parametrize("shape", [(1, 1), (3, 500), (9, 9), (7, 7)])
def test_opencv_on_almost_nothing(shape):
    proposals = OpenCVProposer().propose(np.zeros((*shape, 3), np.uint8))
    assert proposals.masks.shape[1:] == shape


class Oracle:
    """Answers a point with the things there at a quarter of the size: itself, a blur of it, and noise."""

    def __init__(self):
        self.image, self.prompts = np.zeros(0), 0

    def set_image(self, image):
        self.image = image[:, :, 0]

    def at_points(self, points):
        self.prompts += len(points)
        height, width = self.image.shape
        logits, iou = [], []
        for x, y in points:
            here = self.image == self.image[int(y), int(x)]
            small = cv2.resize(
                here.astype(np.float32), (max(1, width // 4), max(1, height // 4)), interpolation=cv2.INTER_AREA
            )
            soft = cv2.blur(small, (9, 9))
            logits.append([20 * small - 10, 3 * soft - 1.5, np.full_like(small, -5)])
            iou.append([0.97, 0.95, 0.99])
        return np.array(logits, np.float32), np.array(iou, np.float32)


def test_the_grid_finds_each_thing_once():
    _, ids = painted()
    image = np.repeat((ids * 60).astype(np.uint8)[:, :, None], 3, axis=2)
    oracle = Oracle()
    proposals = AutomaticMasks(oracle, points_per_side=8, batch=7).propose(image)
    assert oracle.prompts == 64
    assert len(proposals) == 4
    for thing in range(4):
        assert max(iou(mask, ids == thing) for mask in proposals.masks) > 0.9


def test_the_grid_lies_in_the_middles_of_cells():
    points = grid(4, 80, 40)
    assert sorted({tuple(p) for p in points.tolist()})[:2] == [(10.0, 5.0), (10.0, 15.0)]
    assert len({tuple(p) for p in points.tolist()}) == 16


@pytest.mark.parametrize("seed", range(5))
def test_suppression_against_loops(seed):
    rng = np.random.default_rng(seed)
    masks = np.zeros((60, 50, 70), bool)
    for mask in masks:
        top, left = rng.integers(0, 40), rng.integers(0, 60)
        mask[top : top + rng.integers(2, 30), left : left + rng.integers(2, 30)] = True
    scores = rng.uniform(0, 1, 60).astype(np.float32)
    kept: list[int] = []
    for k in sorted(range(60), key=lambda k: -scores[k]):  # rectangles: a mask is its box
        if all(iou(masks[o], masks[k]) <= 0.3 for o in kept):
            kept.append(k)
    assert suppress_duplicates(masks, scores, 0.3).tolist() == kept
    assert len(suppress_duplicates(masks[:0], scores[:0], 0.3)) == 0


def test_stability_by_hand():
    logits = np.array([[[2.0, 0.5, -0.5, -2.0]], [[-3.0, -3.0, -3.0, -3.0]]], np.float32)
    assert stability(logits, 1.0).tolist() == [pytest.approx(1 / 3), 0.0]


def test_specks_go_and_the_largest_island_stays():
    mask = np.zeros((30, 30), bool)
    mask[5:20, 5:20] = True
    mask[10, 10] = False
    mask[25:27, 25:27] = True
    mask[12:17, 12:17] = False
    clean = without_specks(mask, 10)
    assert clean[10, 10]
    assert not clean[25, 25]
    assert not clean[14, 14]
    lone = np.zeros((30, 30), bool)
    lone[3, 3] = True
    assert np.array_equal(without_specks(lone, 10), lone)


# Masks that exist -----------------------------------------------------------------------------------------------


def compressed(counts):
    """COCO's text, written from its description."""
    text = ""
    for k, count in enumerate(counts):
        value = count - counts[k - 2] if k > 2 else count
        more = True
        while more:
            bits = value & 31
            value >>= 5
            more = value != (-1 if bits & 16 else 0)
            text += chr((bits | (32 if more else 0)) + 48)
    return text


def runs_of(mask):
    flat = mask.T.ravel()
    edges = np.flatnonzero(np.diff(flat.astype(int))) + 1
    bounds = [0, *edges.tolist(), len(flat)]
    runs = np.diff(bounds).tolist()
    return [0, *runs] if flat[0] else runs


@pytest.mark.parametrize("seed", range(8))
def test_rle_both_ways(seed):
    mask = cv2.blur(np.random.default_rng(seed).random((37, 53)), (5, 5)) > 0.5
    runs = runs_of(mask)
    size = [37, 53]
    assert np.array_equal(decode_rle({"size": size, "counts": runs}), mask)
    assert np.array_equal(decode_rle({"size": size, "counts": compressed(runs)}), mask)
    assert np.array_equal(decode_rle({"size": size, "counts": compressed(runs).encode()}), mask)


def test_rle_of_a_known_text():
    """3x3 with the middle column set: runs 3 3 3."""
    assert decode_rle({"size": [3, 3], "counts": "333"}).tolist() == [[False, True, False]] * 3


@pytest.mark.parametrize(
    ("rle", "message"),
    [
        ({"size": [3, 3], "counts": [3, 3]}, "add up to 6"),
        ({"size": [3, 3], "counts": [12, -3]}, "shortest -3"),
        ({"size": [3, 3], "counts": "33"}, "add up to 6"),
        ({"size": [3, 3], "counts": "3 3"}, "byte 32"),
        ({"size": [3, 3], "counts": "o" * 40}, "byte"),
        ({"size": [3, 3], "counts": "33S"}, "truncated"),
        ({"size": [1 << 20, 1 << 20], "counts": [1 << 40]}, "at most"),
        ({"size": [0, 3], "counts": []}, "size is"),
        ({"size": [3.5, 3], "counts": []}, "size is"),
        ({"size": [3, 3], "counts": None}, "expected whole numbers"),
        ({"size": [3, 3], "counts": [1.5, 7.5]}, "expected whole numbers"),
        ([1, 2], "is list; expected a record"),
    ],
)
def test_hostile_rle(rle, message):
    with pytest.raises(SceneError, match=message):
        decode_rle(rle, "here")


def test_a_folder_by_image_name(tmp_path):
    _, ids = painted()
    cv2.imwrite(str(tmp_path / "a.png"), ids.astype(np.uint16))
    annotations = [
        {"segmentation": {"size": [120, 160], "counts": runs_of(ids == k)}, "predicted_iou": 0.5} for k in (1, 2)
    ]
    (tmp_path / "b.json").write_text(json.dumps(annotations))
    coco = {
        "images": [{"id": 7, "file_name": "rgb/c.jpg", "height": 120, "width": 160}, {"id": 8, "file_name": "d.jpg"}],
        "annotations": [{"image_id": 7, "score": 0.25, "segmentation": [[10, 10, 50, 10, 50, 40, 10, 40]]}],
    }
    (tmp_path / "all.json").write_text(json.dumps(coco))
    folder = ExistingMasks(tmp_path)
    png, single = folder.of("a", (120, 160)), folder.of("b", (120, 160))
    assert [iou(mask, ids == k + 1) for k, mask in enumerate(png.masks)] == [1, 1, 1]
    assert [iou(mask, ids == k + 1) for k, mask in enumerate(single.masks)] == [1, 1]
    assert single.scores.tolist() == [0.5, 0.5]
    polygon = folder.of("c", (60, 80))
    assert polygon.scores.tolist() == [0.25]
    assert polygon.masks[0][5:20, 5:25].all()
    assert polygon.masks[0].sum() == 15 * 20
    assert len(folder.of("d", (4, 5))) == 0
    assert len(folder.of("rgb/c", (60, 80))) == 1
    assert len(folder.of("left/rgb/c", (60, 80))) == 1
    for another in ("e", "left/c", "left/d"):  # the path in the file names another camera, or none
        with pytest.raises(SceneError, match=f"no masks for image '{another}'; expected {another}.png"):
            folder.of(another, (4, 5))


def test_polygons_cover_the_pixels_whose_centers_they_contain(tmp_path):
    rings = {
        "edges between pixels": [2, 3, 7, 3, 7, 5, 2, 5],
        "beyond the image": [-5, -5, 3.4, -5, 3.4, 40, -5, 40],
        "slanted": [1.2, 0.3, 9.9, 4.1, 5.3, 9.7, 0.1, 6.2],
        "thinner than a pixel": [0, 4.6, 10, 4.6, 10, 5.4, 0, 5.4],
        "a star, hollow inside": [5, 0, 8, 9.5, 0.3, 3.6, 9.7, 3.6, 2, 9.5],
    }
    coco = {
        "images": [{"id": 1, "file_name": "a.png", "height": 10, "width": 11}],
        "annotations": [{"image_id": 1, "segmentation": [ring]} for ring in rings.values()],
    }
    (tmp_path / "all.json").write_text(json.dumps(coco))
    masks = ExistingMasks(tmp_path).of("a", (10, 11)).masks
    for mask, (kind, ring) in zip(masks, rings.items(), strict=True):
        corners = np.reshape(ring, (-1, 2))
        for row, column in np.ndindex(10, 11):
            ends = zip(corners, np.roll(corners, -1, axis=0), strict=True)
            crossed = [
                x + (row + 0.5 - y) * (next_x - x) / (next_y - y) <= column + 0.5
                for (x, y), (next_x, next_y) in ends
                if (y <= row + 0.5) != (next_y <= row + 0.5)
            ]
            assert mask[row, column] == sum(crossed) % 2, (kind, row, column)


def test_a_function_may_return_tensors():
    torch = pytest.importorskip("torch")
    masks = np.arange(2 * 4 * 5).reshape(2, 4, 5) % 3 == 0
    for answer in (torch.from_numpy(masks), [torch.from_numpy(mask) for mask in masks]):
        assert np.array_equal(as_proposals(answer, (4, 5)).masks, masks)
    # As of a GPU: nothing that numpy reads by itself.
    with pytest.raises(SceneError, match="expected"):
        as_proposals(torch.zeros(2, 4, 5, dtype=torch.bool, device="meta"), (4, 5))


def test_threads_read_a_coco_file_once(tmp_path, monkeypatch):
    image = {"id": 1, "file_name": "a.jpg", "height": 5, "width": 5}
    (tmp_path / "all.json").write_text(json.dumps({"images": [image], "annotations": []}))
    read, given = [], ExistingMasks(tmp_path)

    class Cached:
        """As cached_property from Python 3.12 on, without a lock."""

        def __get__(self, instance, _, make=ExistingMasks._coco.func):
            if "found" not in vars(self):
                read.append(instance)
                time.sleep(0.05)
                self.found = make(instance)
            return self.found

    monkeypatch.setattr(ExistingMasks, "_coco", Cached())
    with ThreadPoolExecutor(4) as pool:
        assert [len(found) for found in pool.map(lambda _: given.of("a", (5, 5)), range(4))] == [0] * 4
    assert read == [given]


def test_images_of_a_rig_that_share_a_stem_keep_their_own_masks(tmp_path):
    """Two cameras have a 000.png each: their views are called left/000 and right/000."""
    cameras, square = ("left", "right"), [0, 0, 9, 0, 9, 9, 0, 9]
    images = [
        {"id": k, "file_name": f"images/{name}/000.png", "height": 10, "width": 10} for k, name in enumerate(cameras)
    ]
    annotations = [{"image_id": k, "score": 0.25 * (k + 1), "segmentation": [square]} for k in range(2)]
    (tmp_path / "all.json").write_text(json.dumps({"images": images, "annotations": annotations}))
    for k, name in enumerate(cameras):
        assert ExistingMasks(tmp_path).of(f"{name}/000", (10, 10)).scores.tolist() == [0.25 * (k + 1)]
    with pytest.raises(SceneError, match="2 images that '000' could be"):
        ExistingMasks(tmp_path).of("000", (10, 10))


@pytest.mark.parametrize(
    "text", ["{", "[1]", '[{"segmentation": 3}]', '[{"segmentation": [[1, 2]], "size": [9, 9]}]', '{"a": 1}',
             '{"images": [{"id": [1], "file_name": "b.png"}]}'],
)  # fmt: skip
def test_broken_annotation_files(tmp_path, text):
    (tmp_path / ("all.json" if "images" in text else "a.json")).write_text(text)
    with pytest.raises(SceneError, match=r"expected|valid"):
        ExistingMasks(tmp_path).of("a", (9, 9))


def test_numbers_beyond_floats(tmp_path):
    """A score of 10^400 counts as 1, as any other above; a corner there is outside of everything."""
    square, huge = [1, 1, 5, 1, 5, 5], 10**400
    scored = [{"segmentation": [square], "size": [9, 9], "score": score} for score in (huge, -huge)]
    (tmp_path / "a.json").write_text(json.dumps(scored))
    assert ExistingMasks(tmp_path).of("a", (9, 9)).scores.tolist() == [1, 0]
    (tmp_path / "b.json").write_text(json.dumps([{"segmentation": [[huge, *square[1:]]], "size": [9, 9]}]))
    with pytest.raises(SceneError, match="annotation 0: a polygon is "):
        ExistingMasks(tmp_path).of("b", (9, 9))


def test_masks_of_a_larger_image_are_not_held_at_its_size(tmp_path):
    """A line of a COCO file may state any size: 30 lines took 2 GB."""
    height, width = 600, 500
    rle = {"size": [height, width], "counts": [0, height * 250, height * 250]}
    (tmp_path / "a.json").write_text(json.dumps([{"segmentation": rle}] * 200))
    ExistingMasks(tmp_path).of("a", (6, 5))  # loads what it needs
    tracemalloc.start()
    masks = ExistingMasks(tmp_path).of("a", (6, 5)).masks
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 10 * height * width
    np.testing.assert_array_equal(masks, np.tile([True, True, False, False, False], (200, 6, 1)))


@pytest.mark.parametrize("kind", ["png", "json"])
def test_masks_of_images_turned_upright_are_refused(tmp_path, kind):
    """They were stretched, as others of another shape: masks are for images as stored, whatever EXIF says."""
    cv2.imwrite(str(tmp_path / "a.png"), np.ones((160, 120), np.uint8))
    if kind == "json":
        (tmp_path / "a.png").unlink()
        (tmp_path / "a.json").write_text(json.dumps([{"segmentation": {"size": [160, 120], "counts": [0, 19200]}}]))
    assert len(ExistingMasks(tmp_path).of("a", (40, 30))) == 1
    for shape in ((30, 40), (40, 40)):
        says = rf"masks are 120x160 pixels, the image 40x{shape[0]}; expected the same aspect ratio.* EXIF orientation"
        with pytest.raises(SceneError, match=says):
            ExistingMasks(tmp_path).of("a", shape)


def test_a_color_png_is_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((5, 5, 3), np.uint8))
    with pytest.raises(SceneError, match=r"8-bit RGB .*expected an 8-bit or 16-bit gray PNG"):
        ExistingMasks(tmp_path).of("a", (5, 5))


def test_any_callable():
    image, ids = painted()
    masks = ids == np.arange(1, 4)[:, None, None]
    for answer in (masks, ids, ids - 1, from_ids(ids), ids.astype(np.uint8), ids.astype(np.uint64)):
        proposals = CallableProposer(lambda _, answer=answer: answer, "mine").propose(image)
        assert np.array_equal(proposals.masks, masks)
    scored = Proposals(masks, np.array([0.2, 0.3, 0.4], np.float32))
    assert as_proposals(scored, (120, 160)) is scored
    listed = CallableProposer(lambda _: [*masks], "mine").propose(image)
    assert np.array_equal(listed.masks, masks)
    for none in ([], ()):
        assert as_proposals(none, (120, 160)).masks.shape == (0, 120, 160)
    with pytest.raises(SceneError, match=r"3 proposals have tracks float64 \(3,\); expected a whole number each"):
        Proposals(masks, scored.scores, np.arange(3.0))  # pyright: ignore[reportArgumentType]
    with pytest.raises(SceneError, match=r"masks are \(5, 4\) and \(120, 160\); expected all of \(120, 160\)"):
        as_proposals([*masks, masks[0, :5, :4]], (120, 160))
    with pytest.raises(SceneError, match="expected the same"):
        as_proposals(masks, (5, 5))
    with pytest.raises(SceneError, match=r"a mask proposer returned NoneType .*; expected Proposals, bool"):
        as_proposals(None, (120, 160))  # of a function that forgot its return
    with pytest.raises(SceneError, match="expected Proposals, bool"):
        as_proposals(masks.astype(float), (120, 160))
