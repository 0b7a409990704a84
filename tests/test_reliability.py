"""Split-half reliability: by hand, what lowers it and in what words, and its way into files and tables."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hostile_files import changed, drop
from labelled_clouds import make_cloud
from scenes import write_tiny_capture
from scipy.sparse import csr_array

import og_pointcloud as og
from og_pointcloud.cli import main
from og_pointcloud.fitting.fit import fit_prepared, prepare
from og_pointcloud.fitting.labellers import grouping
from og_pointcloud.fitting.mask_table import MaskTable
from og_pointcloud.fitting.reliability import SAME_LOOK_COSINE, _cut, likely_cause, split_half
from og_pointcloud.journal import Journal
from og_pointcloud.scene import NOT_SEEN, Points, Scene
from og_pointcloud.settings import FitSettings

SETTINGS = FitSettings(mode="grouping")


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return og.read_capture(write_tiny_capture(tmp_path_factory.mktemp("tiny") / "capture", 8).folder)


def judged(scene: Scene):
    """The reliability of a fit of a scene, and its likely cause if it were low."""
    prepared = prepare(scene, SETTINGS)
    labelling = grouping(prepared.table, prepared.surface, SETTINGS, Journal(progress=False))
    found = split_half(prepared.table, prepared.surface, labelling, SETTINGS)
    return found, likely_cause(found)


def with_views(scene: Scene, change) -> Scene:
    return replace(scene, views=tuple(change(index, view) for index, view in enumerate(scene.views)))


def test_a_cause_is_found_where_lenses_left_pixels_unseen(scene: Scene):
    def with_rim(index, view):
        masks = view.mask_map().copy()
        masks[:4] = masks[:, :4] = NOT_SEEN
        return replace(view, masks=masks)

    assert judged(with_views(scene, with_rim))[1]


def literally(scene: Scene):
    """The same in dense arrays and loops: (again, named) of each instance."""
    prepared = prepare(scene, SETTINGS)
    table, surface = prepared.table, prepared.surface
    labelling = grouping(table, surface, SETTINGS, Journal(progress=False))
    names = [view.name for view in surface.scene.views]
    order = [index for index in np.argsort(names) if (table.mask_view == index).any()]
    features = table.unit_features.astype(np.float64)
    common = features[features.any(axis=1)].mean(axis=0)

    def direction(feature):
        moved = feature / np.linalg.norm(feature) - common
        return moved / np.linalg.norm(moved)

    def look(instances, k):
        rows = instances.descriptors[instances.descriptor_instance == k]
        return direction(rows.sum(axis=0)) if len(rows) else None

    looks = [look(labelling.instances, k) for k in range(len(labelling.instances))]

    def alike(a, b):
        return a == b or looks[a] @ looks[b] > SAME_LOOK_COSINE

    def nearest(feature):
        return int(np.argmax([feature @ other for other in looks]))

    shares = np.zeros((2, len(looks)))
    ids = labelling.instance_ids
    for number in (0, 1):
        kept = sorted(order[number::2])
        masks = [m for m in range(len(table.mask_view)) if table.mask_view[m] in kept]
        half = MaskTable(
            table.weights[masks],
            table.outside[kept],
            table.exposure[kept],
            np.array([kept.index(view) for view in table.mask_view[masks]], np.int32),
            table.mask_pixels[masks],
            table.mask_features[masks],
        )
        found = grouping(half, surface, SETTINGS, Journal(progress=False))
        name = [nearest(look(found.instances, k)) if k >= 0 else -1 for k in found.instance_ids]
        for k in range(len(looks)):
            own = np.flatnonzero(ids == k)
            same = [point for point in own if name[point] >= 0 and alike(k, name[point])]
            beyond = [p for p in range(len(ids)) if name[p] == k and not (ids[p] >= 0 and alike(k, ids[p]))]
            shares[number, k] = 2 * len(same) / (len(own) + len(same) + len(beyond))
    named = [
        np.mean([alike(k, nearest(direction(features[m]))) for m in np.flatnonzero(labelling.mask_instance == k)])
        for k in range(len(looks))
    ]
    return shares.mean(axis=0), np.array(named)


def noisy_features(scene: Scene, seed: int = 0) -> Scene:
    """A third of the masks has the feature of the other ball, so that shares lie between 0 and 1."""
    random = np.random.default_rng(seed)
    swap = [random.random(view.mask_count) < 0.35 for view in scene.views]
    rows = [np.where(swapped[:, None], view.mask_features[::-1], view.mask_features) for swapped, view in
            zip(swap, scene.views, strict=True)]  # fmt: skip
    return with_views(scene, lambda index, view: replace(view, mask_features=rows[index]))


@pytest.mark.parametrize("seed", range(3))
def test_it_is_what_loops_say(scene: Scene, seed: int) -> None:
    noisy = noisy_features(scene, seed)
    found, _ = judged(noisy)
    again, named = literally(noisy)
    np.testing.assert_allclose(found.again, again, atol=1e-12)
    np.testing.assert_allclose(found.named, named, atol=1e-12)
    assert found.named.min() < 1


def test_views_that_contradict_an_instance_lower_it(scene: Scene) -> None:
    """In half of the views the first thing's mask spills over what is beside it, in either half of the views alike."""

    def spilled(index, view):
        ids, first = view.mask_map(), (view.mask_features @ scene.views[0].mask_features[0]).argmax()
        wide = np.kron((ids == first)[::8, ::8], np.ones((8, 8), bool))[: ids.shape[0], : ids.shape[1]]
        return replace(view, masks=np.where(wide & (ids < 0), first, ids)) if index // 2 % 2 else view

    honest, torn = (judged(with_views(scene, change))[0] for change in (lambda _, view: view, spilled))
    assert np.nanmin(torn.expected) < np.nanmin(honest.expected) < 1
    product = torn.again * torn.named * torn.expected
    np.testing.assert_array_equal(torn.of_instance, product.astype(np.float32))


def test_an_honest_capture_is_reliable_and_without_warning(scene: Scene) -> None:
    cloud = og.fit(scene, SETTINGS, progress=False)
    assert 0.85 < cloud.reliability <= 1
    assert cloud.provenance["notes"]["reliability"] == pytest.approx(cloud.reliability, abs=1e-4)
    assert not any("reliability" in warning for warning in cloud.provenance["warnings"])


def test_the_order_of_views_and_points_does_not_matter(scene: Scene) -> None:
    order = np.random.default_rng(0).permutation(len(scene.points))
    shuffled = replace(scene, points=scene.points.take(order), views=scene.views[::-1])
    first, second = og.fit(scene, SETTINGS, progress=False), og.fit(shuffled, SETTINGS, progress=False)
    assert first.reliability == pytest.approx(second.reliability, abs=5e-3)


def test_features_that_err_lower_it_and_are_named(scene: Scene) -> None:
    honest, _ = judged(scene)
    found, cause = judged(noisy_features(scene))
    assert np.nanmean(found.of_instance) < np.nanmean(honest.of_instance) - 0.1
    assert "named differently" in cause


@pytest.mark.slow
def test_a_low_one_is_said_with_its_cause(scene: Scene) -> None:
    """Each view has the pose of another."""
    cameras = [view.camera for view in scene.views]
    wrong = with_views(scene, lambda index, view: replace(view, camera=cameras[(index + 2) % len(cameras)], image=None))
    with pytest.warns(UserWarning, match="poses: masks of different views agree no better than unrelated masks"):
        cloud = og.fit(wrong, SETTINGS, progress=False)
    assert cloud.reliability < 0.6
    (warning,) = [text for text in cloud.provenance["warnings"] if "reliab" in text]
    assert ", below 0.65: half of the views give " in warning
    assert "are not where the poses say" in warning


def test_three_views_judge_nothing(scene: Scene) -> None:
    cloud = og.fit(replace(scene, views=scene.views[:3]), SETTINGS, progress=False)
    assert cloud.reliability is None
    assert np.isnan(cloud.instances.reliability).all()


def test_one_thing_alone_beside_a_point_that_no_view_sees(scene: Scene) -> None:
    """Unobserved is state -2, which a table of one row has no room for."""
    first = scene.views[0].mask_features[0]

    def with_one_mask(index, view):
        of_thing = view.mask_map() == (view.mask_features @ first).argmax()
        return replace(view, masks=np.where(of_thing, view.mask_map(), -1))

    xyz = np.concatenate([scene.points.xyz, [[0, 0, -50]]]).astype(np.float32)
    one = replace(with_views(scene, with_one_mask), points=Points(xyz, scene.points.origin))
    cloud = og.fit(one, SETTINGS, progress=False)
    assert (len(cloud.instances), cloud.instance_ids[-1]) == (1, og.UNOBSERVED)
    assert cloud.reliability > 0.85


def test_masks_without_features_leave_it_unknown(scene: Scene) -> None:
    blank = with_views(scene, lambda _, view: replace(view, mask_features=np.zeros_like(view.mask_features)))
    with pytest.warns(UserWarning, match="are zero"):
        assert og.fit(blank, SETTINGS, progress=False).reliability is None


def test_it_is_not_judged_twice_for_points_at_one_place(scene: Scene) -> None:
    twice = replace(scene, points=scene.points.take(np.repeat(np.arange(len(scene.points)), 2)))
    prepared = prepare(twice, SETTINGS)
    cloud = fit_prepared(prepared, SETTINGS)
    assert len(cloud) == 2 * len(scene.points)
    single = og.fit(scene, SETTINGS, progress=False)
    assert cloud.reliability == pytest.approx(single.reliability, abs=1e-6)


def test_the_scene_s_is_the_mean_by_the_fourth_root_of_points() -> None:
    cloud = make_cloud(np.random.default_rng(0).normal(size=(13, 3)), np.array([0] * 9 + [1] * 4))
    table = replace(cloud.instances, points=np.array([81, 16], np.int32), reliability=np.array([1, 0.5], np.float32))
    assert table.overall_reliability == pytest.approx((3 * 1 + 2 * 0.5) / 5)
    half = replace(table, reliability=np.array([np.nan, 0.5], np.float32))
    assert half.overall_reliability == 0.5


def test_it_travels_in_the_file_and_stands_in_the_table(scene: Scene, tmp_path) -> None:
    cloud = og.fit(scene, SETTINGS, progress=False)
    path = og.write_bundle(cloud, tmp_path / "s.ogpc")
    opened = og.load(path)
    np.testing.assert_array_equal(opened.cloud.instances.reliability, cloud.instances.reliability)
    assert opened.cloud.reliability == cloud.reliability
    row = opened.instances[0]
    assert row.reliability == pytest.approx(float(cloud.instances.reliability[0]))
    assert json.loads(opened.instances.to_json())[0]["reliability"] == row.reliability
    assert "reliability" in repr(opened.instances).splitlines()[1]


def test_a_file_of_before_opens_without_it(scene: Scene, tmp_path) -> None:
    path = og.write_bundle(og.fit(scene, SETTINGS, progress=False), tmp_path / "s.ogpc")
    opened = og.load(changed(path, tmp_path / "old.ogpc", drop("arrays/instances/reliability.npy")))
    assert opened.cloud.reliability is None
    assert opened.instances[0].reliability is None
    assert json.loads(opened.instances.to_json())[0]["reliability"] is None


def test_the_command_prints_it(tmp_path, capsys) -> None:
    capture = write_tiny_capture(tmp_path / "capture", 8).folder
    main(["fit", str(capture), "-o", str(tmp_path / "s.ogpc"), "--json", str(tmp_path / "fit.json")])
    written = json.loads((tmp_path / "fit.json").read_text())["reliability"]
    assert written == og.load(tmp_path / "s.ogpc").cloud.reliability
    assert f"reliability {written:.2f}: how well half of the views reproduce the labels" in capsys.readouterr().out


@pytest.mark.parametrize("columns", [np.arange(50), np.array([3, 4, 40])])
@pytest.mark.parametrize("rows", [np.arange(0, 40, 3), np.array([7])])
def test_parts_of_a_table_are_its_parts(rows, columns) -> None:
    dense = np.random.default_rng(0).integers(0, 3, (40, 50)).astype(np.float32)
    part = _cut(csr_array(dense), rows, columns)
    np.testing.assert_array_equal(part.toarray(), dense[np.ix_(rows, columns)])
    assert (part.dtype, part.indices.dtype) == (np.float32, np.int32)
