"""Points denser than pixels: merged by cell as loops do it, in any order, unit and place; others stay as they are."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from test_fit import BOXES, TABLE, THINGS, share_right
from visits import cameras, scene, surface

from og_pointcloud.fitting.fit import fit
from og_pointcloud.journal import Journal
from og_pointcloud.rendering import pixel_cells
from og_pointcloud.rendering.geometry import neighborhood, sample_of_points
from og_pointcloud.rendering.pixel_cells import (
    CELL_PIXELS,
    MAX_LEVEL,
    pixel_widths,
    typical_spacing,
    with_points_of_cells,
)
from og_pointcloud.scene import Camera, Points, Scene, View
from og_pointcloud.settings import FitSettings, GeometrySettings

DENSE, SPARSE = 0.01, 0.06
"""Spacings; a pixel is about 0.04 wide."""


def wall(count: int, seed: int = 0, unit: float = 1.0) -> Scene:
    """Points on a slope that two cameras see from 1 to 8 away, so that pixels differ in width."""
    random = np.random.default_rng(seed)
    xyz = random.uniform([-1, -1, 0], [1, 1, 7], (count, 3))
    xyz[:, 1] = 0.1 * xyz[:, 2] - 0.5 + 0.01 * random.normal(size=count)
    views = []
    for shift in (0.0, 0.3):
        pose = np.eye(4)
        pose[:3, 3] = unit * np.array([shift, 0, 1.0])
        views.append(View(f"{shift}", Camera(64, 48, 50.0, 50.0, 32.0, 24.0, pose), np.zeros((48, 64), np.int32), ONE))
    rgb = random.integers(0, 256, (count, 3)).astype(np.uint8)
    return Scene(Points((unit * xyz).astype(np.float32), np.zeros(3), rgb), tuple(views), "two-words")


ONE = np.ones((1, 2), np.float32)


def literal_cells(scene: Scene) -> dict[tuple[float, ...], list[int]]:
    """The points of each cell."""
    xyz = scene.points.xyz.astype(np.float64)
    sample, width = xyz[sample_of_points(scene.points.xyz, pixel_cells.SAMPLED_POINTS)], []
    for place in sample:
        seen = []
        for camera in (view.camera for view in scene.views):
            x, y, z = camera.world_to_camera[:3, :3] @ place + camera.world_to_camera[:3, 3]
            if z > 0:
                u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
                if 0 <= u < camera.width and 0 <= v < camera.height:
                    seen.append(math.sqrt(x * x + y * y + z * z) / math.sqrt(camera.fx * camera.fy))
        width.append(0.75 * min(seen) + 0.25 * max(seen) if seen else math.nan)  # of two views, or one
    known = [k for k, w in enumerate(width) if not math.isnan(w)]
    typical, middle = float(np.median([width[k] for k in known])), np.median(scene.points.xyz, axis=0)
    cells = defaultdict(list)
    for row, place in enumerate(xyz):
        nearest = min(known, key=lambda k: math.dist(sample[k], place))
        level = min(max(math.floor(math.log2(width[nearest] / typical) + 0.5), -MAX_LEVEL), MAX_LEVEL - 1)
        side = CELL_PIXELS * typical * 2.0**level
        cells[(level, *(math.floor((place[a] - middle[a]) / side) for a in range(3)))].append(row)
    return cells


@pytest.mark.parametrize("seed", range(2))
def test_cells_are_those_of_the_literal_reference(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pixel_cells, "SAMPLED_POINTS", 60)
    monkeypatch.setattr(pixel_cells, "MAX_KEPT_SHARE", 1.0)
    dense = wall(3000, seed)
    merged, cell = with_points_of_cells(dense, Journal(progress=False))
    expected = literal_cells(dense)
    assert len({key[0] for key in expected}) > 2, "cells differ in width"
    assert cell is not None
    assert len(merged.points) == len(expected) < 2900
    for rows in expected.values():
        assert len(set(cell[rows])) == 1
        xyz, rgb = merged.points.xyz[cell[rows[0]]], merged.points.rgb[cell[rows[0]]]
        np.testing.assert_allclose(xyz, dense.points.xyz[rows].mean(axis=0, dtype=np.float64), atol=2e-6)
        assert np.abs(rgb - dense.points.rgb[rows].mean(axis=0)).max() <= 0.5


def test_pixels_are_as_wide_as_their_angle_makes_them() -> None:
    views = wall(10).views
    (width, nowhere) = pixel_widths(np.array([[0.0, 0, 4], [0, 0, -3]]), views)
    assert width == pytest.approx((0.75 * 5 + 0.25 * math.hypot(5, 0.3)) / 50)
    assert math.isnan(nowhere)


def partition(cell: NDArray[np.int64]) -> set[frozenset[int]]:
    rows = defaultdict(list)
    for row, of in enumerate(cell.tolist()):
        rows[of].append(row)
    return set(map(frozenset, rows.values()))


def test_order_does_not_matter() -> None:
    dense = wall(20_000)
    order = np.random.default_rng(1).permutation(20_000)
    merged, cell = with_points_of_cells(dense, Journal(progress=False))
    shuffled, other = with_points_of_cells(replace(dense, points=dense.points.take(order)), Journal(progress=False))
    assert cell is not None
    assert other is not None
    np.testing.assert_array_equal(cell[order], other)
    np.testing.assert_array_equal(merged.points.xyz, shuffled.points.xyz)
    np.testing.assert_array_equal(merged.points.rgb, shuffled.points.rgb)


@pytest.mark.parametrize("unit", [1024.0, 2.0**-20])
def test_units_do_not_matter(unit: float) -> None:
    (_, cell), (_, other) = (with_points_of_cells(wall(20_000, unit=u), Journal(progress=False)) for u in (1.0, unit))
    assert cell is not None
    assert other is not None
    assert partition(cell) == partition(other)


def test_a_far_point_merges_with_nothing_and_changes_nothing() -> None:
    dense = wall(20_000)
    xyz = np.concatenate([dense.points.xyz, np.array([[1e9, 0, 0], [0, -1e30, 0]], np.float32)])
    far = replace(dense, points=Points(xyz, np.zeros(3)))
    (_, cell), (merged, other) = (with_points_of_cells(made, Journal(progress=False)) for made in (dense, far))
    assert cell is not None
    assert other is not None
    assert np.isfinite(merged.points.xyz).all()
    assert len(set(other[-2:]) | set(other[:-2])) == len(set(other[:-2])) + 2
    assert len(partition(other)) == pytest.approx(len(partition(cell)) + 2, rel=0.02)


def test_points_that_pixels_tell_apart_or_that_no_view_shows_stay() -> None:
    behind = wall(20_000)
    behind = replace(behind, points=replace(behind.points, xyz=behind.points.xyz - np.float32([0, 0, 9])))
    for made in (wall(800), behind, wall(1)):
        assert with_points_of_cells(made, Journal(progress=False)) == (made, None)


@pytest.mark.parametrize("tile_points", [None, 800])
def test_a_dense_cloud_is_labelled_cell_by_cell(tile_points: int | None) -> None:
    views = cameras(8, size=(96, 72))
    owner = surface(THINGS, spacing=DENSE)[1]
    dense = scene(THINGS, views, spacing=DENSE, floor=False)
    cloud = fit(dense, FitSettings(tile_points=tile_points), progress=False)
    (entry,) = [entry for entry in cloud.provenance["left_out"] if entry["key"] == "points denser than pixels"]
    assert entry["why"] == "those within 2 pixels share the label of their mean"
    cell = with_points_of_cells(dense, Journal(progress=False))[1]
    assert cell is not None
    assert cell.max() < len(cell) / 5
    spacing = np.median(neighborhood(dense.points.xyz, GeometrySettings()).spacing)
    assert cloud.spacing == pytest.approx(spacing, rel=0.25)  # a cell is twelve times as wide
    for rows in partition(cell):
        assert len(set(cloud.instance_ids[list(rows)])) == 1
    assert len(cloud.instances) == BOXES
    assert cloud.instances.points.sum() == (cloud.instance_ids >= 0).sum()
    assert share_right(cloud, np.where(owner < 0, TABLE, owner)) > 0.9


def test_the_spacing_of_a_cloud_is_that_of_its_positions() -> None:
    once = np.random.default_rng(0).uniform(size=(300, 3)).astype(np.float32)
    spacing = neighborhood(once, GeometrySettings()).spacing
    assert typical_spacing(np.repeat(once, 9, axis=0), spacing) == np.median(spacing)
    assert typical_spacing(np.repeat(once[:1], 9, axis=0), np.ones(1, np.float32)) == 1
    assert typical_spacing(once, spacing[:9]) == pytest.approx(np.median(spacing), rel=0.25)
    assert typical_spacing(np.eye(3, dtype=np.float32), np.ones(1, np.float32)) == pytest.approx(np.sqrt(2))


def test_a_sparse_cloud_is_labelled_point_by_point() -> None:
    sparse = scene(THINGS, cameras(8, size=(96, 72)), spacing=SPARSE, floor=False)
    assert "points denser than pixels" not in {e["key"] for e in fit(sparse, progress=False).provenance["left_out"]}
