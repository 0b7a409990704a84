"""Views that were cut from one photograph are one view to a fit: cutting changes nothing but rims."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import write_tiny_capture
from scipy.sparse import csr_array

import og_pointcloud as og
from og_pointcloud.evaluate.baselines import center_sampling
from og_pointcloud.fitting import tiles
from og_pointcloud.fitting.fit import fit, prepare
from og_pointcloud.fitting.mask_table import MaskTable
from og_pointcloud.fitting.photographs import Photographs
from og_pointcloud.fitting.view_votes import ViewVotes, view_votes
from og_pointcloud.rendering.geometry import isotropic, neighborhood
from og_pointcloud.scene import CutMasks, Points, Scene, View
from og_pointcloud.settings import FitSettings, GeometrySettings

SETTINGS = FitSettings(geometry=GeometrySettings(scales=(0.5,)))
TILED = replace(SETTINGS, tile_points=400)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return og.read_capture(write_tiny_capture(tmp_path_factory.mktemp("tiny") / "capture", 8).folder)


@pytest.fixture(scope="module")
def cut(scene: Scene) -> Scene:
    """Every view in two, through the middle, but for the first, which stays whole."""
    views = [part for view in scene.views[1:] for part in halves(view)]
    return replace(scene, views=(scene.views[0], *views))


def halves(view: View) -> list[View]:
    ids, image, camera = view.mask_map(), view.image_rgb(), view.camera
    assert image is not None
    middle = camera.width // 2
    parts = []
    for name, columns in (("left", slice(0, middle)), ("right", slice(middle, camera.width))):
        shown = ids[:, columns]
        rows = np.unique(shown[shown >= 0])
        number = np.full(view.mask_count + 1, -1, np.int32)
        number[rows] = np.arange(len(rows))
        half = replace(camera, width=shown.shape[1], cx=camera.cx - columns.start)
        masks, features = np.ascontiguousarray(number[shown]), view.mask_features[rows]
        cut_from = CutMasks(view.name, rows.astype(np.int64))
        pixels = np.ascontiguousarray(image[:, columns])
        parts.append(View(f"{view.name}/{name}", half, masks, features, pixels, cut_from=cut_from))
    return parts


def as_gaussians(scene: Scene) -> Scene:
    xyz = scene.points.xyz
    splats = isotropic(scene.points, neighborhood(xyz, GeometrySettings()).spacing, 0.7, 0.9)
    points = Points(xyz, scene.points.origin, None, splats.scale, splats.rotation, splats.opacity)
    return replace(scene, points=points)


@pytest.mark.parametrize("kind", ["points", "gaussians"])
def test_the_table_of_cut_views_is_that_of_the_photographs(scene: Scene, cut: Scene, kind: str):
    if kind == "gaussians":
        scene, cut = as_gaussians(scene), as_gaussians(cut)
    whole, joined = prepare(scene, SETTINGS).table, prepare(cut, SETTINGS).table
    assert joined.names == tuple(view.name for view in scene.views)
    np.testing.assert_array_equal(joined.mask_view, whole.mask_view)
    np.testing.assert_array_equal(joined.mask_features, whole.mask_features)
    np.testing.assert_array_equal(joined.mask_pixels, whole.mask_pixels)
    for name in ("weights", "outside", "exposure"):
        found, expected = getattr(joined, name).toarray(), getattr(whole, name).toarray()
        assert joined.exposure.data.max() <= 1
        # A pixel beside the cut is asked about the masks of its own half alone, and holes are looked for in each half's
        # own windows.
        differs = np.abs(found - expected) > 1e-3 * np.maximum(1, expected)
        assert differs.sum() <= 0.04 * (expected > 0).sum(), name


@pytest.mark.parametrize("settings", [SETTINGS, TILED], ids=["whole", "tiles"])
def test_cutting_changes_no_label(scene: Scene, cut: Scene, settings: FitSettings):
    whole, of_cut = fit(scene, settings, progress=False), fit(cut, settings, progress=False)
    assert len(whole.instances) == len(of_cut.instances) >= 2
    assert (whole.instance_ids == of_cut.instance_ids).mean() > 0.995
    np.testing.assert_array_equal(whole.instances.views, of_cut.instances.views)
    np.testing.assert_array_equal(whole.instances.masks, of_cut.instances.masks)


@pytest.mark.parametrize("photographs", [8, 4])
def test_colors_say_as_much_in_tiles(scene: Scene, photographs: int, monkeypatch: pytest.MonkeyPatch):
    views = [replace(view, image=None if row >= photographs else view.image) for row, view in enumerate(scene.views)]
    some, none = (replace(scene, views=tuple(of)) for of in (views, [replace(view, image=None) for view in views]))
    tables: list[MaskTable] = []

    def kept(table: MaskTable) -> ViewVotes:
        tables.append(table)
        return view_votes(table)

    monkeypatch.setattr(tiles, "view_votes", kept)
    monkeypatch.setattr(tiles, "MIN_SPACING_PX", 1e-6)  # no point is left out
    fit(some, replace(SETTINGS, tile_points=len(scene.points)), progress=False)
    whole, in_tiles, by_geometry = prepare(some, SETTINGS).table, tables[-1], prepare(none, SETTINGS).table
    found, expected, without = (table.exposure.toarray() for table in (in_tiles, whole, by_geometry))
    # The points of a tile are in an order of their own.
    np.testing.assert_allclose(np.sort(found, axis=1), np.sort(expected, axis=1), atol=0.01)
    assert (np.abs(expected - without)[expected > 0] > 0.01).mean() > 0.05


def test_baselines_find_the_masks_of_cut_views(scene: Scene, cut: Scene):
    words = np.unique(np.concatenate([view.mask_features for view in scene.views]).round(3), axis=0)
    whole, of_cut = (center_sampling(prepare(views, SETTINGS), words) for views in (scene, cut))
    assert (whole == of_cut).mean() > 0.98


@pytest.mark.parametrize("seed", range(3))
def test_joined_rows_are_the_sums_of_their_parts(seed: int):
    random = np.random.default_rng(seed)
    rows, counts, n = [[2, 0], [], [2], [0, 1, 3], [0, 1]], [2, 0, 1, 3, 2], 40
    cut_from = ["a", "b", "a", "b", None]
    views = [made_view(f"v{i}", *of) for i, of in enumerate(zip(counts, cut_from, rows, strict=True))]
    dense = [random.random((height, n)) * (random.random((height, n)) < 0.4) for height in (8, 5, 5, 5)]
    weights, outside, exposure, through = (csr_array(matrix.astype(np.float32)) for matrix in dense)
    features = np.concatenate([view.mask_features for view in views])
    mask_view = np.repeat(np.arange(5, dtype=np.int32), counts)
    table = MaskTable(weights, outside, exposure, mask_view, np.arange(8, dtype=np.int32), features, np.arange(8))
    joined = Photographs.of(views).joined(replace(table, doubted=through))
    # Masks a0, a2, b0, b1, b3 and the two of the last view, by the rows that are their parts.
    parts = [[1], [0, 2], [3], [4], [5], [6], [7]]
    photographs = [[0, 2], [1, 3], [4]]
    assert joined.names == ("a", "b", "v4")
    np.testing.assert_allclose(joined.weights.toarray(), [dense[0][part].sum(axis=0) for part in parts], rtol=1e-6)
    np.testing.assert_allclose(
        joined.outside.toarray(), [dense[1][part].sum(axis=0) for part in photographs], rtol=1e-6
    )
    np.testing.assert_allclose(
        joined.doubted.toarray(), [dense[3][part].sum(axis=0) for part in photographs], rtol=1e-6
    )
    least = [np.minimum(1, dense[2][part].sum(axis=0)) for part in photographs]
    np.testing.assert_allclose(joined.exposure.toarray(), least, rtol=1e-6)
    np.testing.assert_array_equal(joined.mask_view, [0, 0, 1, 1, 1, 2, 2])
    np.testing.assert_array_equal(joined.mask_pixels, [sum(part) for part in parts])
    np.testing.assert_array_equal(joined.mask_track, [part[0] for part in parts])
    np.testing.assert_array_equal(joined.mask_features, features[[part[0] for part in parts]])


def test_what_several_faces_show_is_summed_where_matrices_share_their_columns():
    """As those of exposure and doubts do: faces come one after the other, and a point on their border is in both."""
    views = [made_view(f"p/{face}", 0, "p", []) for face in range(2)]
    columns, starts = np.array([0, 1, 2, 2, 3, 4], np.int32), np.array([0, 3, 6], np.int32)
    doubts = np.array([0.1, 0.2, 0.3, 0.3, 0.4, 0.5], np.float32)
    exposure, doubted = (csr_array((of, columns, starts), shape=(2, 5)) for of in (np.full(6, 0.4, np.float32), doubts))
    empty, no_masks = csr_array((0, 5), dtype=np.float32), np.zeros(0, np.int32)
    table = MaskTable(empty, exposure.copy(), exposure, no_masks, no_masks, np.zeros((0, 3), np.float32))
    joined = Photographs.of(views).joined(replace(table, doubted=doubted))
    np.testing.assert_allclose(joined.exposure.toarray(), [[0.4, 0.4, 0.8, 0.4, 0.4]])
    np.testing.assert_allclose(joined.doubted.toarray(), [[0.1, 0.2, 0.6, 0.4, 0.5]])


def made_view(name: str, count: int, photograph: str | None, rows: list[int]) -> View:
    camera = og.Camera(4, 4, 4.0, 4.0, 2.0, 2.0, np.eye(4))
    cut_from = None if photograph is None else CutMasks(photograph, np.array(rows, np.int64))
    features = np.array(rows, np.float32).reshape(-1, 1) + np.arange(3, dtype=np.float32)
    return View(name, camera, np.full((4, 4), -1, np.int32), features[:count], cut_from=cut_from)
