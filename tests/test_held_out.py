"""The size of points by held-out views: it finds the size that labels best, and depends on nothing else."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import write_tiny_capture
from scipy.sparse import csr_array

import og_pointcloud as og
from og_pointcloud.fitting import held_out
from og_pointcloud.fitting.held_out import MIN_AGREEMENT_GAIN, SCALE_STEP, ScaleChoice, agreement, choose_scale, search
from og_pointcloud.fitting.mask_table import MaskTable
from og_pointcloud.journal import Journal
from og_pointcloud.rendering.geometry import near_plane, neighborhood
from og_pointcloud.rendering.surface import sight_thickness
from og_pointcloud.scene import Scene, View
from og_pointcloud.settings import FitSettings, GeometrySettings


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return og.read_capture(write_tiny_capture(tmp_path_factory.mktemp("tiny") / "capture", 8).folder)


def chosen(scene: Scene, settings: FitSettings | None = None):
    settings = settings or FitSettings()
    spacing = neighborhood(scene.points.xyz, settings.geometry).spacing
    near = near_plane(scene.points.xyz, (view.camera for view in scene.views))
    thickness = sight_thickness(spacing, float(np.median(spacing)), settings.geometry)
    return choose_scale(scene.points, spacing, thickness, scene.views, near, settings, Journal(progress=False))


def test_the_best_on_held_out_views_is_taken(scene: Scene) -> None:
    choice = chosen(scene)
    assert set(choice.agreements) == set(FitSettings().geometry.scales)
    assert choice.agreements[choice.scale] == max(choice.agreements.values())
    assert 0.5 < choice.agreements[choice.scale] <= 1


def test_points_that_let_everything_through_are_not_taken(scene: Scene) -> None:
    """With points as fine as dust the floor behind a ball takes the ball's masks: the other views say so."""
    settings = FitSettings(geometry=GeometrySettings(scales=(0.01, 0.5)))
    assert chosen(scene, settings).scale == 0.5
    assert chosen(scene, FitSettings(geometry=GeometrySettings(scales=(0.5, 6.0)))).scale == 0.5


def test_the_search_goes_on_beyond_the_largest_while_that_is_clearly_better(scene: Scene) -> None:
    """Points as fine as a tenth of their spacing: rays slip between them."""
    choice = chosen(scene, FitSettings(geometry=GeometrySettings(scales=(0.1, 0.15))))
    assert choice.scale > 0.15
    assert choice.agreements[choice.scale] >= choice.agreements[0.15] + MIN_AGREEMENT_GAIN


@pytest.mark.parametrize(
    ("optimum", "found", "tried"),
    [
        (0.35, 0.35, {0.25}),  # the smallest, but one beyond is not better
        (0.2, 0.25 / SCALE_STEP, {0.25, 0.25 / SCALE_STEP, 0.25 / SCALE_STEP**2}),
        (1.5, 0.7 * SCALE_STEP**2, {0.7 * SCALE_STEP, 0.7 * SCALE_STEP**2, 0.7 * SCALE_STEP**3}),
        (0.5, 0.5, set()),
    ],
)
def test_how_far_the_search_goes(optimum: float, found: float, tried: set[float]) -> None:
    scales = (0.35, 0.5, 0.7)
    best, agreements = search(scales, lambda scale: 0.9 - 0.1 * abs(np.log(scale / optimum)))
    assert best == pytest.approx(found)
    assert sorted(agreements) == pytest.approx(sorted({*scales, *tried}))


def test_sizes_that_label_alike_are_not_searched_beyond() -> None:
    best, agreements = search((0.35, 0.5, 0.7), {0.35: 0.8, 0.5: 0.799, 0.7: 0.79}.__getitem__)
    assert (best, set(agreements)) == (0.35, {0.35, 0.5, 0.7})


def test_order_of_views_and_points_does_not_matter(scene: Scene) -> None:
    order = np.random.default_rng(0).permutation(len(scene.points))
    shuffled = replace(scene, points=scene.points.take(order), views=scene.views[::-1])
    first, second = chosen(scene), chosen(shuffled)
    assert first.scale == second.scale
    for scale, value in first.agreements.items():
        assert second.agreements[scale] == pytest.approx(value, abs=2e-3)


def test_masks_are_read_once_for_all_sizes_where_memory_allows(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    reads: Counter[str] = Counter()

    def counted(view: View) -> View:
        def read() -> NDArray[np.int32]:
            reads[view.name] += 1
            return view.mask_map()

        return replace(view, masks=read)

    watched = replace(scene, views=tuple(map(counted, scene.views)))
    choice = chosen(watched)
    assert set(reads.values()) == {1}
    monkeypatch.setattr(held_out, "memory_left", lambda _: 0)
    assert chosen(watched) == choice
    assert set(reads.values()) == {1 + len(choice.agreements)}


def test_too_few_views_to_hold_some_out(scene: Scene) -> None:
    few, shuffled = replace(scene, views=scene.views[:7]), GeometrySettings(scales=(0.7, 0.35, 0.5))
    assert chosen(few, FitSettings(geometry=shuffled)).scale == 0.5  # the middle one
    assert chosen(few) == ScaleChoice(FitSettings().geometry.middle_scale, {})
    cloud = og.fit(few, progress=False)
    assert any(entry["key"] == "choice of scale" for entry in cloud.provenance["left_out"])


@pytest.mark.parametrize("scales", [(0.3,), (0.3, 0.3)])
def test_a_size_that_is_given_is_taken(scene: Scene, scales: tuple[float, ...]) -> None:
    assert chosen(scene, FitSettings(geometry=GeometrySettings(scales=scales))).scale == 0.3


def test_agreement_by_hand() -> None:
    """Two masks of one view over four points: the first is instance 0 exactly, the second half of instance 1."""
    weights = csr_array(np.array([[1, 1, 0, 0], [0, 0, 1, 0]], np.float32))
    outside = csr_array(np.array([[0, 0, 0, 1]], np.float32))
    table = MaskTable(weights, outside, csr_array((1, 4)), np.zeros(2, np.int32), np.ones(2, np.int32), np.ones((2, 1)))
    assert agreement(table, np.array([0, 0, 1, 1], np.int32), 2) == pytest.approx((2 * 1 + 1 * 0.5) / 3)
    assert agreement(table, np.array([-1, -1, -1, -1], np.int32), 0) == 0


def test_labels_are_judged_by_views_that_they_were_not_made_from(scene: Scene) -> None:
    """Every other view's masks lie somewhere else: each half agrees with itself, and not with the other."""
    views = sorted(scene.views, key=lambda view: view.name)
    moved = [
        replace(view, masks=np.roll(view.mask_map(), view.camera.width // 2, axis=1)) if index % 2 else view
        for index, view in enumerate(views)
    ]
    honest, contradicted = chosen(scene), chosen(replace(scene, views=tuple(moved)))
    assert max(contradicted.agreements.values()) < 0.5 * max(honest.agreements.values())
