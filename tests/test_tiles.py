"""A fit in tiles is the fit of the whole: same labels, same evidence, whatever is cut and interrupted."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import fields, replace
from functools import lru_cache
from multiprocessing import get_context

import numpy as np
import pytest
from scenes import TinyCapture
from scipy.optimize import linear_sum_assignment
from street import MadeStreet, make_street

import og_pointcloud as og
from og_pointcloud.checking.check import CaptureWarning
from og_pointcloud.cli import main
from og_pointcloud.cloud import LabelledCloud
from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.fitting import tiles
from og_pointcloud.fitting.fit import fit
from og_pointcloud.fitting.tiled_cloud import TiledCloud, _opened, split
from og_pointcloud.fitting.work_folder import WorkFolder, kept_files
from og_pointcloud.rendering.splatting import view_weights
from og_pointcloud.scene import Camera, Points, Scene, View
from og_pointcloud.settings import FitSettings, GeometrySettings

SETTINGS = FitSettings(mode="grouping", geometry=GeometrySettings(scales=(0.5,)))
POINTS = 24_000


def agreement(first: np.ndarray, second: np.ndarray) -> float:
    """Of the points that either labelling gives an instance, the share with the same, under the one-to-one matching of
    instances that makes it largest."""
    either, both = (first >= 0) | (second >= 0), (first >= 0) & (second >= 0)
    shared = np.zeros((first.max(initial=-1) + 1, second.max(initial=-1) + 1))
    np.add.at(shared, (first[both], second[both]), 1)
    return float(shared[linear_sum_assignment(-shared)].sum() / either.sum())


@lru_cache
def street() -> MadeStreet:
    return make_street(POINTS, 12, (240, 135), length_m=30.0)


@lru_cache
def whole() -> LabelledCloud:
    return fit(street().scene, SETTINGS, progress=False)


@lru_cache
def tiled(most: int) -> LabelledCloud:
    return fit(street().scene, replace(SETTINGS, tile_points=most), progress=False)


@pytest.mark.parametrize("most", [1, 7, 100, 999, 5000])
def test_tiles_hold_every_point_once_and_none_too_many(most):
    xyz = np.random.default_rng(0).normal(size=(1000, 3)).astype(np.float32) * [9, 3, 1]
    cut = split(xyz, most)
    np.testing.assert_array_equal(np.sort(cut.order), np.arange(1000))
    sizes = np.diff(cut.start)
    assert len(cut) == -(-1000 // most)
    assert 0 < sizes.min() <= sizes.max() <= most
    assert sizes.max() - sizes.min() <= len(cut).bit_length()


def test_tiles_do_not_overlap_and_do_not_depend_on_the_order_of_points():
    random = np.random.default_rng(1)
    xyz = random.random((3000, 3)).astype(np.float32)
    cut = split(xyz, 200)
    parts = [xyz[cut.order[cut.part(tile)]] for tile in range(len(cut))]
    boxes = np.array([[part.min(axis=0), part.max(axis=0)] for part in parts])
    apart = (boxes[:, None, 0] > boxes[None, :, 1]).any(axis=2)
    assert (apart | apart.T | np.eye(len(cut), dtype=bool)).all()
    order = random.permutation(3000)
    other = split(xyz[order], 200)
    assert [set(order[other.order[other.part(tile)]]) for tile in range(len(other))] == [
        set(cut.order[cut.part(tile)]) for tile in range(len(cut))
    ]


def test_coincident_points_stay_together():
    xyz = np.repeat(np.array([[0, 0, 0], [1, 0, 0]], np.float32), 50, axis=0)
    cut = split(xyz, 10)
    assert [sorted(cut.order[cut.part(tile)]) for tile in range(len(cut))] == [list(range(50)), list(range(50, 100))]


@pytest.mark.slow
def test_one_tile_is_the_fit_itself(monkeypatch):
    monkeypatch.setattr(tiles, "MIN_SPACING_PX", 1e-6)
    cloud = fit(street().scene, replace(SETTINGS, tile_points=POINTS), progress=False)
    assert len(whole().instances) > 15
    np.testing.assert_array_equal(cloud.instance_ids, whole().instance_ids)
    for name in ("points", "views", "masks", "part_of", "descriptor_instance"):
        np.testing.assert_array_equal(getattr(cloud.instances, name), getattr(whole().instances, name))
    for name in ("descriptors", "agreement", "visible_area"):
        np.testing.assert_allclose(
            getattr(cloud.instances, name), getattr(whole().instances, name), rtol=1e-3, atol=1e-5
        )
    assert (cloud.spacing, cloud.reach) == pytest.approx((whole().spacing, whole().reach))


@pytest.mark.parametrize("most", [pytest.param(POINTS // 2, marks=pytest.mark.slow), POINTS // 4])
def test_tiles_label_as_one_fit_does(most):
    cloud = tiled(most)
    assert len(cloud.provenance["notes"]["tiles"]) == POINTS // most
    assert agreement(whole().instance_ids, cloud.instance_ids) > 0.99
    states = [np.minimum(ids, 0) for ids in (whole().instance_ids, cloud.instance_ids)]
    assert (states[0] == states[1]).mean() > 0.99
    reference = whole().certainty
    assert (np.abs(cloud.certainty / 255 - reference / 255) < 0.1).mean() > 0.97
    assert len(set(reference)) > 50


def test_evidence_is_summed_over_tiles():
    cloud, reference = tiled(POINTS // 4), whole()
    shared = np.zeros((len(reference.instances), len(cloud.instances)))
    both = (cloud.instance_ids >= 0) & (reference.instance_ids >= 0)
    np.add.at(shared, (reference.instance_ids[both], cloud.instance_ids[both]), 1)
    large = np.flatnonzero(reference.instances.points > 500)
    same = shared[large].argmax(axis=1)
    for name in ("points", "views", "masks", "visible_area"):
        ratio = getattr(cloud.instances, name)[same] / getattr(reference.instances, name)[large]
        assert np.median(np.abs(ratio - 1)) < 0.02, name
    rows = np.searchsorted(reference.instances.descriptor_instance, large)
    cosine = (reference.instances.descriptors[rows] * cloud.instances.descriptors[same]).sum(axis=1)
    assert np.median(cosine) > 0.999


@pytest.mark.slow
def test_an_object_across_a_border_is_one_instance():
    made, cloud = street(), tiled(POINTS // 6)
    cut = split(made.scene.points.xyz, POINTS // 6)
    tile = np.empty(POINTS, int)
    tile[cut.order] = np.repeat(np.arange(len(cut)), np.diff(cut.start))
    usable = (whole().instance_ids >= 0) & (cloud.instance_ids >= 0)
    crossing = 0
    for instance in range(len(whole().instances)):
        ids = [
            np.bincount(cloud.instance_ids[part]).argmax()
            for part in (
                np.flatnonzero(usable & (whole().instance_ids == instance) & (tile == t)) for t in range(len(cut))
            )
            if len(part) > 100
        ]
        crossing += len(ids) > 1
        assert len(set(ids)) <= 1
    assert crossing >= 3


@pytest.mark.slow
def test_the_order_of_points_does_not_matter():
    made = street()
    order = np.random.default_rng(2).permutation(POINTS)
    points = made.scene.points
    shuffled = replace(made.scene, points=Points(points.xyz[order], points.origin, points.rgb[order]))
    cloud = fit(shuffled, replace(SETTINGS, tile_points=POINTS // 4), progress=False)
    # A state that no view saw is its nearest neighbor's: of two equally near ones, the first's.
    assert agreement(tiled(POINTS // 4).instance_ids[order], cloud.instance_ids) > 0.998


def two_walls() -> Scene:
    """A wall at depth 2 with a mask all over it, a wall at depth 6 behind it: no camera sees the second."""
    side = np.linspace(-1, 1, 40)
    front = np.stack(np.meshgrid(side, side, [2.0]), axis=-1).reshape(-1, 3)
    back = np.stack(np.meshgrid(1.5 * side, 1.5 * side, [6.0]), axis=-1).reshape(-1, 3)
    views = []
    for index, x in enumerate((-0.1, 0.0, 0.1)):
        pose = np.eye(4)
        pose[0, 3] = x
        camera = Camera(60, 60, 80.0, 80.0, 30.0, 30.0, pose)
        views.append(View(f"view{index}", camera, np.zeros((60, 60), np.int32), np.ones((1, 4), np.float32)))
    xyz = np.concatenate([front, back]).astype(np.float32)
    return Scene(Points(xyz, np.zeros(3)), tuple(views), "tiny-test-space")


def test_what_stands_in_another_tile_hides_what_is_behind_it():
    scene = two_walls()
    cut = split(scene.points.xyz, 1600)
    assert [set(scene.points.xyz[cut.order[cut.part(tile)], 2].tolist()) for tile in range(2)] == [{2.0}, {6.0}]
    full = FitSettings(geometry=GeometrySettings(scales=(1.0,), opacity=0.95))
    cloud = fit(scene, replace(full, tile_points=1600), progress=False)
    assert (cloud.instance_ids[:1600] == 0).mean() > 0.7  # the rest is outside the images
    assert (cloud.instance_ids[1600:] < 0).all()


@pytest.mark.parametrize("most", [None, 1600])
def test_photographs_that_cannot_be_read_are_counted(most):
    """All of them: the checks before a fit ask for some."""
    scene, grey = two_walls(), np.full((60, 60, 3), 99, np.uint8)
    images = (grey, grey[1:], grey.astype(float))
    views = tuple(replace(view, image=image) for view, image in zip(scene.views, images, strict=True))
    colored = replace(scene.points, rgb=np.full((3200, 3), 99, np.uint8))
    cloud = fit(replace(scene, points=colored, views=views), FitSettings(tile_points=most), progress=False)
    [told] = [text for text in cloud.provenance["warnings"] if text.startswith("photographs")]
    assert told.startswith("photographs of 2 of 3 views cannot be read: view 'view1': the image is uint8 (59, 60, 3)")


def tiled_cloud(points: Points, spacing: float, work: WorkFolder) -> TiledCloud:
    cloud = TiledCloud.cut(points, len(points), SETTINGS, work)
    spacings = np.full((2, len(points)), spacing, np.float32)
    work.arrays("spacing", cloud.key, lambda: [spacings, cloud.points.xyz])
    return cloud


def test_every_point_that_shows_is_points_to_draw(monkeypatch, tmp_path):
    monkeypatch.setattr(tiles, "MIN_SPACING_PX", 1e-6)
    random = np.random.default_rng(3)
    points = Points((4 * random.normal(size=(4000, 3))).astype(np.float32), np.zeros(3))
    camera = Camera(40, 30, 25.0, 40.0, 3.0, 28.0, np.eye(4))
    view = View("view", camera, np.full((30, 40), -1, np.int32), np.zeros((0, 4), np.float32))
    cloud = tiled_cloud(points, 0.3, WorkFolder(tmp_path))
    drawing = tiles._Drawing(1.0, 0.1, 0.3)
    # So faint that nothing hides anything.
    everything = drawing.splats(cloud, np.arange(4000), np.ones(4000, np.float32), 0.01)
    shows = np.unique(view_weights(everything, camera, drawing.near).indices)
    rows, larger, inside = tiles._points_to_draw(view, cloud, drawing)
    assert len(shows) > 250
    assert set(shows) <= set(rows)
    assert len(rows) == inside < 2000
    assert (larger == 1).all()


def test_points_finer_than_pixels_are_thinned_to_them(monkeypatch, tmp_path):
    monkeypatch.setattr(tiles, "MIN_SPACING_PX", 0.5)
    random = np.random.default_rng(4)
    xyz = np.concatenate([random.uniform(-1, 1, (40_000, 2)), np.full((40_000, 1), 4.0)], axis=1).astype(np.float32)
    camera = Camera(80, 80, 160.0, 160.0, 40.0, 40.0, np.eye(4))
    view = View("view", camera, np.full((80, 80), -1, np.int32), np.zeros((0, 4), np.float32))
    cloud = tiled_cloud(
        Points(xyz, np.zeros(3)), 0.00625, WorkFolder(tmp_path)
    )  # a quarter of a pixel, half of MIN_SPACING_PX
    drawing = tiles._Drawing(0.5, 0.1, 0.00625)
    rows, larger, inside = tiles._points_to_draw(view, cloud, drawing)
    assert inside == 40_000
    assert len(rows) == pytest.approx(10_000, rel=0.05)
    np.testing.assert_allclose(larger, 2, rtol=1e-3)
    others, _, _ = tiles._points_to_draw(replace(view, name="other"), cloud, drawing)
    assert len(np.intersect1d(rows, others)) == pytest.approx(2_500, rel=0.1)
    monkeypatch.setattr(tiles, "MAX_SPLATS", 3_000)
    rows, larger, _ = tiles._points_to_draw(view, cloud, drawing)
    assert 2_000 < len(rows) < 3_200
    assert (larger**2).sum() == pytest.approx(40_000, rel=0.05)


@pytest.mark.slow
def test_an_interrupted_fit_goes_on_behind_its_last_view(tmp_path, monkeypatch):
    real, rendered = tiles._entries, []

    def interrupted(view, *rest):
        if len(rendered) == 5:
            raise KeyboardInterrupt
        rendered.append(view.name)
        return real(view, *rest)

    work = tmp_path / "work"
    monkeypatch.setattr(tiles, "_entries", interrupted)
    with pytest.raises(KeyboardInterrupt):
        fit(street().scene, replace(SETTINGS, tile_points=POINTS // 4), work=work, progress=False)
    assert kept_files(work, "view") == 5
    monkeypatch.setattr(tiles, "_entries", lambda view, *rest: rendered.append(view.name) or real(view, *rest))
    cloud = fit(street().scene, replace(SETTINGS, tile_points=POINTS // 4), work=work, progress=False)
    assert rendered == [view.name for view in street().scene.views]
    np.testing.assert_array_equal(cloud.instance_ids, tiled(POINTS // 4).instance_ids)
    assert not work.exists()


def test_another_scene_takes_up_nothing(tmp_path, monkeypatch):
    work = tmp_path / "work"
    scene = two_walls()
    monkeypatch.setattr(tiles, "_decide", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        fit(scene, replace(SETTINGS, tile_points=1600), work=work, progress=False)
    before = set(work.iterdir())
    masks = [np.where(np.arange(60) < 30, -1, view.mask_map()).astype(np.int32) for view in scene.views]
    other = replace(scene, views=tuple(replace(v, masks=m) for v, m in zip(scene.views, masks, strict=True)))
    moved = replace(scene, points=Points(scene.points.xyz + np.float32(0.01), np.zeros(3)))
    for changed, new in ((other, 3), (moved, 4 + 3)):
        with pytest.raises(KeyboardInterrupt):
            fit(changed, replace(SETTINGS, tile_points=1600), work=work, progress=False)
        assert len(set(work.iterdir()) - before) == new
        before = set(work.iterdir())


def test_bad_use_is_told_at_the_door():
    scene = two_walls()
    with pytest.raises(OgPointcloudError, match=r'mode is "fast".*expected "grouping"'):
        fit(scene, FitSettings(mode="fast", tile_points=1600))
    bare = tuple(
        replace(view, mask_features=np.zeros((0, 4), np.float32), masks=view.mask_map() - 1) for view in scene.views
    )
    with pytest.raises(SceneError, match="has a mask"):
        fit(replace(scene, views=bare), FitSettings(tile_points=1600), progress=False)
    behind = replace(scene, points=Points(-scene.points.xyz, np.zeros(3)))
    with pytest.raises(SceneError, match="no camera sees the cloud"):
        fit(behind, FitSettings(tile_points=1600), progress=False)
    with pytest.raises(OgPointcloudError, match="tile_points is 0; expected a whole number above 0"):
        FitSettings(tile_points=0)
    with pytest.raises(OgPointcloudError, match="seed is -1"):
        FitSettings(seed=-1)


def spot(side: int) -> Scene:
    """A wall in the middle of three images, and in each one mask in their corner, so many pixels wide."""
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, 40), np.linspace(-0.3, 0.3, 40))
    xyz = np.stack([x, y, np.full_like(x, 2)], axis=-1).reshape(-1, 3).astype(np.float32)
    masks = np.full((64, 64), -1, np.int32)
    masks[:side, :side] = 0
    camera = Camera(64, 64, 64.0, 64.0, 32.0, 32.0, np.eye(4))
    views = tuple(View(name, camera, masks, np.eye(1, 2, dtype=np.float32)) for name in "abc")
    return Scene(Points(xyz, np.zeros(3)), views, "two-words")


def test_masks_that_show_no_point_are_refused_as_in_a_whole_fit():
    for tile_points in (None, 500):
        with pytest.raises(SceneError, match="none of the 3 masks shows a Gaussian"):
            fit(spot(8), replace(SETTINGS, tile_points=tile_points), progress=False)


def test_masks_that_the_sample_misses_give_no_instance(monkeypatch):
    monkeypatch.setattr(tiles, "SAMPLE_STEP", POINTS)
    few = replace(SETTINGS, tile_points=500, grouping=replace(SETTINGS.grouping, graph_points=3))
    with pytest.warns(CaptureWarning, match="instances: none"):
        cloud = fit(spot(23), few, progress=False)  # the mask shows a corner of the wall, and none of the sample
    assert len(cloud.instances) == 0


def test_a_fit_is_in_tiles_where_memory_is_short_and_they_help(monkeypatch):
    scene, tight = two_walls(), FitSettings(memory=64_000_000)
    assert not tiles.needs_tiles(scene, tight)  # no larger than the smallest tile
    monkeypatch.setattr(tiles, "MIN_TILE_POINTS", 1000)
    assert not tiles.needs_tiles(scene, FitSettings())
    assert not tiles.needs_tiles(scene, replace(tight, mode="paper"))
    assert tiles.needs_tiles(scene, tight)
    with pytest.raises(OgPointcloudError, match="give it more memory"):
        fit(scene, tight, progress=False)
    monkeypatch.setattr(tiles, "memory_left", lambda limit: 3_000_000)
    cloud = fit(scene, tight, progress=False)
    assert cloud.provenance["left_out"][0]["key"] == "whole fit"
    assert cloud.provenance["notes"]["tiles"] == [800] * 4


def test_memory_decides_the_tiles_in_few_steps():
    def most(points: int, memory: float) -> int:
        return tiles._points_per_tile(points, int(memory))

    assert most(20_000_000, 12e9) == 2_000_000
    assert most(20_000_000, 2.9e9) == most(20_000_000, 3.1e9) == 250_000
    with pytest.raises(OgPointcloudError, match="20,000,000 points take"):
        most(20_000_000, 2.45e9)


@pytest.mark.slow
def test_the_command_fits_in_tiles(tiny_capture: TinyCapture, tmp_path):
    bundle = tmp_path / "tiny.ogpc"
    main(["fit", str(tiny_capture.folder), "-o", str(bundle), "--tile-points", "600"])
    scene = og.load(bundle)
    result = og.segment(scene.xyz, ["red ball", "blue ball"], scene)
    assert tiny_capture.share_correct(result.labels, list(result.names)) > 0.95
    assert not list(tmp_path.glob("*.work"))


@pytest.mark.slow
@pytest.mark.parametrize("executor", ["threads", "processes", "dask"])
def test_tiles_are_the_same_on_any_executor(executor, tmp_path, recwarn):
    reference = tiled(POINTS // 4)
    with executor_of(executor) as workers:
        settings = replace(SETTINGS, tile_points=POINTS // 4)
        cloud = fit(street().scene, settings, work=tmp_path / "work", executor=workers, progress=False)
    for name in ("xyz", "instance_ids", "certainty"):
        np.testing.assert_array_equal(getattr(cloud, name), getattr(reference, name))
    for column in fields(reference.instances):
        ours, theirs = (getattr(table, column.name) for table in (cloud.instances, reference.instances))
        np.testing.assert_array_equal(ours, theirs, column.name)
    assert (cloud.spacing, cloud.reach) == (reference.spacing, reference.reach)
    assert cloud.provenance["left_out"] == reference.provenance["left_out"]
    assert not (tmp_path / "work").exists()


def test_two_walls_are_the_same_on_threads():
    scene, settings = two_walls(), replace(SETTINGS, tile_points=1600)
    alone = fit(scene, settings, progress=False)
    with ThreadPoolExecutor(2) as workers:
        cloud = fit(scene, settings, executor=workers, progress=False)
    assert (cloud.instance_ids >= 0).any()
    np.testing.assert_array_equal(cloud.instance_ids, alone.instance_ids)
    np.testing.assert_array_equal(cloud.certainty, alone.certainty)


@contextmanager
def executor_of(kind: str) -> Iterator[Executor]:
    if kind == "dask":
        distributed = pytest.importorskip("distributed", reason="needs the extra 'cluster': dask[distributed]")
        cluster = distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None)
        with cluster, distributed.Client(cluster) as client:
            yield client.get_executor(pure=False)
        return
    with ThreadPoolExecutor(2) if kind == "threads" else ProcessPoolExecutor(2, get_context("spawn")) as executor:
        yield executor


def test_a_worker_that_cannot_see_the_folder_says_so(tmp_path):
    with pytest.raises(OgPointcloudError, match="a folder that all workers share"):
        _opened(tmp_path, "0")
