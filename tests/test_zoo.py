"""The zoo: scenes are as drawn, the same every time, and their rows are what the scorers say."""

from __future__ import annotations

import csv
from dataclasses import fields, replace

import numpy as np
import pytest
import zoo
from og_pointcloud_room.raycast import Intrinsics
from og_pointcloud_zoo import constants as numbers
from og_pointcloud_zoo import make
from og_pointcloud_zoo.draws import ANY, KINDS, draw, half_of, scene_names
from og_pointcloud_zoo.measure import Row, at_largest_pieces, measure, parsed_settings
from og_pointcloud_zoo.outdoors import Matched, Scanner, street_room
from og_pointcloud_zoo.report import summary
from og_pointcloud_zoo.worse import BLED_PX, COLOR_NOISE, COLORS, worse
from scipy.spatial import cKDTree

import og_pointcloud as og
from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.evaluate.truth import Truth, read_truth
from og_pointcloud.fitting import view_votes
from og_pointcloud.formats.capture import read_capture
from og_pointcloud.rendering import sightings
from og_pointcloud.scene import Points, Scene, View

TINY = replace(draw("boxes-0"), points=1500, views=6, width=96, height=72, outliers=0.01, floaters=0.01, hidden=0.2,
               all_masked=False)  # fmt: skip


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    cache = tmp_path_factory.mktemp("zoo")
    return [make.made_scene(replace(TINY, name=f"tiny-{half}", seed=half), cache) for half in (0, 1)]


def test_every_kind_has_a_scene_in_each_half_and_its_numbers_are_as_fixed():
    names = scene_names()
    assert len(names) >= 40
    assert len(set(names)) == len(names)
    assert [half_of(name) for name in names[:2]] == ["choose", "judge"]
    for kind, fixed in KINDS.items():
        for number in (0, 1):
            one = draw(f"{kind}-{number}")
            for key, usual in ANY.items():
                low, high = fixed.get(key, usual)
                slack = 8 if key == "width" else 0  # widths are multiples of 16
                assert low - slack <= getattr(one, key) <= high + slack, (one.name, key)


def test_which_half_follows_from_the_name_alone():
    assert half_of("ycb_0049") == half_of("hololens_office") == "judge"
    assert half_of("room2") == half_of("seven_redkitchen") == "choose"


def test_a_scene_is_as_drawn(scenes):
    scene, truth = read_capture(scenes[0]), read_truth(scenes[0])
    assert len(scene.points) == TINY.points
    assert len(scene.views) == TINY.views
    views = np.load(scenes[0] / "gt.npz")["views"]
    astray = int(0.01 * TINY.points) * 2  # outliers and floaters: of no class, and no background
    assert np.count_nonzero((views == 0) & (truth.cls < 0) & ~truth.background) >= astray
    assert not truth.background[views == 0].any()
    # Each point that has a class stands where cameras see it: in as many images as the truth says, or more.
    xyz = scene.points.xyz + scene.points.origin
    inside = np.zeros(len(xyz), int)
    for view in scene.views:
        uv, depth = view.camera.project(scene.points.xyz)
        inside += view.camera.shows(uv) & (depth > 0)
    assert (inside >= views).mean() > 0.99  # noise may carry a point over an image's edge
    things = xyz[truth.scored & (truth.cls >= 0)]
    assert things[:, 2].max() < 1.2  # boxes: 0.45 m and another of 0.7 times that
    assert things[:, 2].min() > -0.1


def test_the_same_draw_is_the_same_scene(scenes, tmp_path):
    again = make.made_scene(replace(TINY, name="tiny-0", seed=0), tmp_path)
    for path in sorted(scenes[0].rglob("*")):
        if path.is_file() and path.suffix != ".npz":
            assert (again / path.relative_to(scenes[0])).read_bytes() == path.read_bytes(), path.name
    first, second = (np.load(folder / "gt.npz") for folder in (scenes[0], again))
    assert all((first[name] == second[name]).all() for name in first.files)


def test_a_scene_is_made_whole_or_not_at_all(tmp_path, monkeypatch):
    def fails(capture, folder):
        (folder / "points.ply").write_bytes(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(make, "write_capture", fails)
    with pytest.raises(OSError, match="disk full"):
        make.made_scene(TINY, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_things_that_share_a_mask_are_the_ones_that_are_drawn():
    place = make.PLACES["shelf"](np.random.default_rng(0), 0)
    owner = make._together(place.room, 3)
    moved = np.flatnonzero(owner[:-1] != np.arange(len(owner) - 1))
    names = [item.name for item in place.room.objects]
    assert len(moved) == 3
    assert all(names[k] in make.SMALL and names[owner[k]] == "shelf" for k in moved)
    assert owner[-1] == -1


@pytest.mark.slow
def test_a_row_is_what_the_scorers_say(scenes, tmp_path, capsys):
    zoo.main(["-o", str(tmp_path), "--captures", *map(str, scenes), "--only", "tiny", "--set", "mode=grouping"])
    with open(tmp_path / "zoo.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["scene"] for row in rows] == ["tiny-0", "tiny-1"]
    assert (tmp_path / "zoo.png").read_bytes()[:4] == b"\x89PNG"
    printed = capsys.readouterr().out
    assert "1 scenes for choosing" in printed
    assert "1 scenes for judging alone" in printed
    truth = read_truth(scenes[0])
    cloud = og.fit(read_capture(scenes[0]), og.FitSettings(mode="grouping"), progress=False)
    with np.load(scenes[0] / "word_bank.npz") as bank:
        cloud = replace(cloud, word_bank=og.WordBank(bank["vectors"]))
    result = og.segment(cloud, None, text_features=scenes[0] / "text_features.npz")
    called, counted = np.array([*result.names, ""])[result.labels], (truth.cls >= 0) & truth.scored
    ious = []
    for k in np.unique(truth.cls[counted]):
        true, said = (truth.cls == k) & counted, (called == truth.names[k]) & (counted | truth.background)
        if true.sum() >= 30:
            ious.append((true & said & counted).sum() / (true | said).sum())
    assert float(rows[0]["miou"]) == pytest.approx(np.mean(ious), abs=0.02)  # classes below 30 points are left out
    assert float(rows[0]["background"]) == pytest.approx(np.mean(called[truth.background] != ""))
    gain = [float(rows[0][key]) for key in ("gain_low", "gain", "gain_high")]
    assert gain == sorted(gain)
    assert gain[1] == pytest.approx(float(rows[0]["miou"]) - float(rows[0]["baseline_miou"]), abs=1e-9)


def test_a_thing_is_scored_at_its_largest_piece_alone():
    line = np.arange(10.0)
    xyz = np.zeros((10, 3), np.float32)
    xyz[:, 0] = np.where(line < 5, line, line + 20)  # two rows of five
    cls = np.array([0, 0, 0, 1, 1, 1, 1, 0, -1, -1])
    truth = Truth(cls, ("cup", "pot"), line != 1, cls < 0, np.where(cls < 0, -1, cls))
    found = at_largest_pieces(truth, xyz, 0.5)
    # The cup's point beyond the gap goes; of the pot's two pairs the first stays; what was not scored stays so.
    assert found.scored.tolist() == [True, False, True, True, True, False, False, False, True, True]
    assert found.cls is truth.cls
    assert at_largest_pieces(truth, xyz, 10).scored.tolist() == truth.scored.tolist()
    with pytest.raises(OgPointcloudError, match="no 'instance'"):
        at_largest_pieces(replace(truth, instance=None), xyz, 0.5)


def test_settings_are_changed_by_path():
    settings = parsed_settings(["membership.sure_share=0.5", "mode=grouping", "geometry.scales=(0.5,)"])
    assert (settings.membership.sure_share, settings.mode, settings.geometry.scales) == (0.5, "grouping", (0.5,))
    with pytest.raises(OgPointcloudError, match=r"'membership\.sure' is not a setting"):
        parsed_settings(["membership.sure=0.5"])


def test_the_summary_names_scenes_where_a_baseline_is_better():
    values = {one.name: 0 for one in fields(Row)}
    lost = Row(**{**values, "scene": "a-0", "half": "choose", "baseline": "b", "background": 0.02, "gain_high": -0.1})
    drawn = replace(lost, scene="b-0", gain_high=0.1, background=None)
    text = summary([lost, drawn])
    assert "better than ours beyond the interval on 1: a-0" in text
    assert "1 of 1 scenes 1 % or more" in text


def test_a_mask_shows_the_thing_that_fills_most_of_it_below_a_sky_too():
    made = small("street-0")
    expected = []
    for ids, frame in zip(made.masks, made.frames, strict=True):
        for mask in range(1, int(ids.max()) + 1):
            things = frame.owner[(ids == mask) & (frame.owner >= 0)]
            expected.append(np.bincount(things).argmax() if len(things) else -1)
    assert min(frame.owner.min() for frame in made.frames) < -1
    np.testing.assert_array_equal(made.mask_instance, expected)


# Places outdoors, and what measures them -------------------------------------------------------------------------


def small(name, **changes):
    return make.drawn_capture(replace(draw(name), points=1500, views=6, width=96, height=72, **changes))


def test_a_scanner_gives_rings_and_sees_what_no_camera_does():
    room = street_room(np.random.default_rng(0))
    eye = np.array([[0.0, -1.6, 2.0]])
    scanner = Scanner(room, eye, np.zeros((1, 3)), 16, {"tree": 0.5}, colored=True, error_m=0.0)
    raw = scanner(4000, np.random.default_rng(1))
    ray = raw.xyz - eye
    reached = np.linalg.norm(ray, axis=1)
    beam = (np.degrees(np.arcsin(ray[:, 2] / reached)) - scanner.down) / (scanner.up - scanner.down) * 15
    np.testing.assert_allclose(beam, np.rint(beam), atol=1e-6)
    assert len(np.unique(np.rint(beam))) > 8
    assert reached.max() < scanner.range_m
    names = np.array([item.name for item in room.objects])[raw.owner]
    assert "sky" not in names
    # Into a crown, along the ray and not beyond it; on everything hard, nowhere.
    deeper = np.linalg.norm(raw.offset, axis=1)
    assert (deeper[names != "tree"] == 0).all()
    assert deeper[names == "tree"].mean() > 0.1
    np.testing.assert_allclose(np.cross(raw.offset, ray), 0, atol=1e-9)
    crown = names == "tree"
    back = make.Surfaces(room.objects).cast(raw.xyz[crown] + raw.offset[crown], -ray[crown] / reached[crown, None])
    np.testing.assert_allclose(back.distance, deeper[crown], atol=1e-3)
    made = small("lidar-0")
    assert 0.01 < (made.views[made.cls >= 0] == 0).mean() < 0.7


def test_points_of_photographs_are_less_exact_far_away_and_lie_on_edges():
    room = street_room(np.random.default_rng(0))
    intrinsics = Intrinsics(96, 72, 80.0)
    pose = make.PLACES["drive"](np.random.default_rng(0), 0).poses(1, None, np.random.default_rng(0))[0]
    frame = make.RayCaster(room, np.random.default_rng(0)).look(intrinsics, pose)
    raw = Matched(room, [frame], intrinsics)(5000, np.random.default_rng(2))
    depth = (raw.xyz - pose[:3, 3]) @ pose[:3, 2]
    error = np.linalg.norm(raw.offset, axis=1)
    near, far = (depth < 8), (depth > 20)
    assert np.median(error[far]) > 4 * np.median(error[near])
    u, v = ((raw.xyz - pose[:3, 3]) @ pose[:3, :2] / depth[:, None] * 80 + (48, 36)).astype(int).T
    edge = np.abs(np.gradient(frame.image.astype(float).mean(axis=2))).sum(axis=0)
    assert edge[v, u].mean() > 2 * edge[frame.owner != len(room.objects) - 1].mean()


def test_points_lie_within_soft_things_and_have_their_names():
    made = small("offroad-0")
    names = np.array(made.names)[made.cls]
    soft = (made.cls >= 0) & np.isin(names, ["grass", "bush", "tree"])
    items = [item for item in made.room.objects if item.name in ("grass", "bush", "tree")]
    inside = make.Surfaces(items).distance_m(made.xyz[soft])
    assert np.quantile(inside, 0.9) > 0.1
    assert inside.max() < 1.5
    hard = (made.cls >= 0) & np.isin(names, ["rock", "log", "pole"])
    assert make.Surfaces(made.room.objects).distance_m(made.xyz[hard]).max() < 0.2  # range errors and drift


def test_views_of_a_walk_are_close_and_inside_and_name_a_thing_differently():
    made = small("walk-0", confused=0.3)
    half = np.array(made.room.size) / 2
    for frame in made.frames:
        assert (np.abs(frame.camera_to_world[:2, 3]) < half[:2]).all()
    one = draw("walk-0")
    class_of = np.arange(len(made.names), dtype=np.int32)
    named = make._named(one, class_of, made.names, 400)
    wrong = (named != class_of).mean(axis=0)
    confusable = [k for k, name in enumerate(made.names) if any(name in group for group in make.ALIKE)]
    assert wrong[confusable].mean() == pytest.approx(one.confused, abs=0.12)
    assert wrong.max() < 2 * one.confused + 0.08
    for k in np.flatnonzero(wrong):
        others = {made.names[other] for other in np.unique(named[:, k])} - {made.names[k]}
        assert others <= {name for group in make.ALIKE if made.names[k] in group for name in group}
    assert (make._named(replace(one, confused=0.0), class_of, made.names, 3) == class_of).all()


# The page of constants ------------------------------------------------------------------------------------------


def test_every_number_of_the_default_way_has_a_source_and_no_source_is_of_none():
    known = {one.path for one in numbers.constants()}
    said = [path for paths in numbers.SOURCES.values() for path in paths]
    assert {one.path for one in numbers.constants() if one.source == "not said"} == set()
    assert sorted(said) == sorted(known)
    assert all(one.meaning for one in numbers.constants())
    for path, (_, functions) in numbers.MODULES.items():
        assert all(hasattr(numbers._module(path)[0], function) for function in functions), path
    assert {half_of(name) for name in numbers.SCENES} == {"choose"}


def test_half_and_twice_stay_possible_values():
    values = {one.path: one.values for one in numbers.constants()}
    assert values["membership.sure_share"] == (0.3, 0.8)  # 0.6: half of the way from there to 1
    assert values["geometry.neighbors"] == (12, 48)
    assert values["geometry.reach"] == (1.5, 6.0)


def test_a_number_of_a_module_is_changed_for_a_while_in_compiled_code_too():
    exposure, index = np.array([1.0, 0.5], np.float32), np.zeros(2, np.int32)

    def votes():
        found = np.zeros(2, np.float32)
        view_votes._relative_exposure(index, exposure, 1, found)
        return found.tolist()

    assert votes() == [1, 0.25]
    with numbers._in_module("fitting.view_votes.OPENNESS_POWER", 1):
        assert votes() == [1, 0.5]
    assert votes() == [1, 0.25]


def test_the_ring_of_votes_follows_its_numbers():
    before = sightings.VOTE_SAMPLES.copy()
    with numbers._in_module("rendering.sightings.RING_SHARE", 0.25):
        assert sightings.VOTE_SAMPLES[:, 2].sum() == pytest.approx(1)
        assert sightings.VOTE_SAMPLES[0, 2] == 0.75
    np.testing.assert_array_equal(sightings.VOTE_SAMPLES, before)
    with numbers._in_module("rendering.sightings.EDGE_PX", sightings.EDGE_PX):  # as it stands: the same ring
        np.testing.assert_allclose(sightings.VOTE_SAMPLES, before)
    ids = np.where(np.arange(24) < 10, -1, 0) * np.ones((8, 1), np.int32)  # a mask, two pixels beyond the first block
    assert sightings._within_masks(ids)[0, 0]
    with numbers._in_module("rendering.sightings.EDGE_PX", 3.0):
        assert not sightings._within_masks(ids)[0, 0]
    assert sightings._within_masks(ids)[0, 0]


def test_verdicts_of_numbers(tmp_path):
    one = numbers.Constant("membership.sure_share", 0.6, "what it is", "guessed")
    sharp = numbers.Tried(one, (0.1, 0.3), (0.2, 0.3), (0.09, 0.29))
    assert sharp.verdict == "sharp, better at twice"
    flat = numbers.Tried(one, (0.1, 0.3), (0.1, 0.3), (0.101, 0.299))
    assert flat.verdict == "does not matter here"
    text = numbers.page([sharp, flat])
    assert (
        "| `membership.sure_share` | 0.6 | guessed | +0.0500 | -0.0100 | sharp, better at twice | what it is |" in text
    )


@pytest.mark.slow
def test_results_of_constants_are_kept(scenes, tmp_path, monkeypatch):
    monkeypatch.setattr(numbers, "SCENES", ("tiny-0",))
    monkeypatch.setattr(numbers, "made_scene", lambda drawn, cache: scenes[0])
    monkeypatch.setattr(numbers, "draw", lambda name: name)
    zoo.main(["-o", str(tmp_path), "--constants", str(tmp_path / "page.md"), "--only", "membership.sure_share"])
    first = (tmp_path / "page.md").read_text()
    assert f"{len(numbers.constants())} numbers steer labels. 1 of them" in first
    assert first.count("| not tried |") == len(numbers.constants()) - 1
    monkeypatch.setattr(numbers, "fit_prepared", None)  # nothing is measured a second time
    zoo.main(["-o", str(tmp_path), "--constants", str(tmp_path / "again.md"), "--only", "membership.sure_share"])
    assert (tmp_path / "again.md").read_text() == first
    error = 1 - measure(scenes[0], og.FitSettings(mode="grouping"), baselines=False).miou
    assert f"is {error:.4f} as they stand" in first


def test_colors_that_say_less_leave_all_else_as_it_is():
    rgb = np.random.default_rng(0).integers(0, 255, (4000, 3)).astype(np.uint8)
    camera = og.Camera(8, 8, 8.0, 8.0, 4.0, 4.0, np.eye(4))
    view = View("a", camera, np.ones((8, 8), np.int32), np.eye(1, dtype=np.float32))
    # A grid that fills the image: at depth 8 a pixel is one unit wide.
    x, y = np.meshgrid(np.linspace(-4, 3.9, 80), np.linspace(-4, 3.9, 50))
    xyz = np.stack([x, y, np.full_like(x, 8)], axis=-1).reshape(-1, 3).astype(np.float32)
    scene = Scene(Points(xyz, np.zeros(3), rgb), (view,), "none")
    noisy, grey, none, bled = (worse(scene, "colors", colors).points.rgb for colors in COLORS)
    assert none is None
    inside = (rgb > 90) & (rgb < 165)
    assert (noisy.astype(float) - rgb)[inside].std() == pytest.approx(COLOR_NOISE, rel=0.1)
    assert np.abs(np.corrcoef(grey.astype(float) - rgb.mean(axis=1, keepdims=True), rowvar=False)[0, 1]) < 0.1
    assert np.array_equal(noisy, worse(scene, "colors", "noisy").points.rgb)
    # Bled colors are those of points BLED_PX off along each axis; hardly any point keeps its own.
    row_of_color = {tuple(color): row for row, color in enumerate(rgb.tolist())}
    moved = xyz[[row_of_color[tuple(color)] for color in bled.tolist()]] - xyz
    middle = (np.abs(xyz[:, :2]) < 1).all(axis=1)
    assert moved[middle, :2].std(axis=0) == pytest.approx(BLED_PX, rel=0.25)
    assert (bled == rgb).all(axis=1).mean() < 0.1


def test_a_scene_is_made_worse_by_as_much_as_asked(scenes):
    scene = read_capture(scenes[0])
    n, xyz = TINY.points, scene.points.xyz

    fewer = worse(scene, "views", 3)
    assert [view.name for view in fewer.views] == [scene.views[k].name for k in (0, 2, 5)]

    thin = worse(scene, "points", 0.2).points.xyz
    rows = [int(np.flatnonzero((xyz == one).all(axis=1))[0]) for one in thin]
    assert len(set(rows)) == n // 5

    noisy = worse(scene, "noise", 2).points.xyz - xyz
    spacing = np.median(cKDTree(xyz).query(xyz, 2)[0][:, 1])
    assert noisy.std(axis=0) == pytest.approx([2 * spacing] * 3, rel=0.1)

    strays = worse(scene, "strays", 0.1).points.xyz
    assert np.array_equal(strays[:n], xyz)
    assert len(strays) == n * 11 // 10
    assert np.median(cKDTree(xyz).query(strays[n:])[0]) > 2 * spacing  # anywhere, not on surfaces

    off = worse(scene, "poses", 3)
    for view, before in zip(off.views, scene.views, strict=True):
        camera = before.camera
        middle = camera.center + camera.world_to_camera[2, :3]  # on the optical axis: the middle of the image
        moved = view.camera.project(middle[None])[0] - camera.project(middle[None])[0]
        assert np.linalg.norm(moved) == pytest.approx(3, rel=0.01)

    missing = worse(scene, "masks", 0.5)
    for view, before in zip(missing.views, scene.views, strict=True):
        ids, old = view.mask_map(), before.mask_map()
        assert view.mask_count < before.mask_count or before.mask_count < 4
        for k in np.unique(ids[ids >= 0]):
            whole = np.unique(old[ids == k])
            assert len(whole) == 1
            assert ((old == whole[0]) == (ids == k)).all()
            assert np.array_equal(view.mask_features[k], before.mask_features[whole[0]])

    for view, before in zip(worse(scene, "eroded", 2).views, scene.views, strict=True):
        old, around = before.mask_map(), np.pad(before.mask_map(), 1, mode="edge")
        beside = [around[y : y + old.shape[0], x : x + old.shape[1]] for y, x in ((0, 1), (2, 1), (1, 0), (1, 2))]
        edges = np.argwhere(np.logical_or.reduce([old != other for other in beside]))
        away = cKDTree(edges).query(np.argwhere(old >= -9))[0].reshape(old.shape)
        left, kept = np.where((old >= 0) & (away < 2), -1, old), view.mask_map()
        assert np.array_equal(kept >= 0, left >= 0)
        features = np.array([before.mask_features[k] for k in left[left >= 0]])
        assert np.array_equal(view.mask_features[kept[kept >= 0]], features)


def test_each_photograph_is_exposed_anew(scenes):
    scene = read_capture(scenes[0])
    blind = replace(scene, views=tuple(replace(view, image=None) for view in scene.views))
    assert all(view.image_rgb() is None for view in worse(blind, "exposure", 0.2).views)
    camera = og.Camera(8, 8, 8.0, 8.0, 4.0, 4.0, np.eye(4))
    gray = np.full((8, 8, 3), 100, np.uint8)
    view = View("a", camera, np.zeros((8, 8), np.int32), np.eye(1, dtype=np.float32), gray)
    many = tuple(replace(view, name=str(number)) for number in range(400))
    exposed = worse(replace(scene, views=many), "exposure", 0.2).views
    levels = np.log(np.array([one.image_rgb()[0, 0] for one in exposed]) / 100)
    assert levels.mean(axis=0) == pytest.approx([0] * 3, abs=0.04)
    assert levels.std(axis=0) == pytest.approx([0.2 * np.sqrt(1 + 1 / 16)] * 3, rel=0.15)
    assert (levels - levels.mean(axis=1, keepdims=True)).std() == pytest.approx(0.05 * np.sqrt(2 / 3), rel=0.15)


def test_a_worse_scene_is_scored_at_the_points_it_had(scenes):
    truth, capture = read_truth(scenes[0]), read_capture(scenes[0])
    row = measure(scenes[0], baselines=False, changes={"points": 0.2})
    thin = worse(capture, "points", 0.2)
    with np.load(scenes[0] / "word_bank.npz") as bank:
        cloud = replace(og.fit(thin, progress=False), word_bank=og.WordBank(bank["vectors"]))
    labels = og.segment(cloud, text_features=scenes[0] / "text_features.npz")
    nearest = np.linalg.norm(capture.points.xyz[:, None] - thin.points.xyz, axis=2).argmin(axis=1)
    assert row.miou == pytest.approx(truth.score(truth.class_of(labels.labels[nearest], labels.names)).miou)
    assert row.points == len(thin.points) < len(capture.points)
    with_strays = measure(scenes[0], baselines=False, changes={"strays": 0.3})
    assert with_strays.miou > 0.5
    assert with_strays.worse == "strays=0.3"
    thin_with_many_strays = measure(scenes[0], baselines=False, changes={"points": 0.8, "strays": 0.3})
    assert thin_with_many_strays.points > len(capture.points)
    assert thin_with_many_strays.miou > 0.5


@pytest.mark.parametrize("change", ["views=0", "points=1.5", "masks=no", "colors=blue", "light=1"])
def test_what_makes_nothing_worse_is_told(scenes, tmp_path, change, monkeypatch):
    monkeypatch.chdir(scenes[0])
    with pytest.raises(SystemExit, match=f"'{change}' makes nothing worse; expected one of views, points"):
        zoo.main(["-o", str(tmp_path), "--captures", ".", "--only", "tiny", "--worse", change])


def test_what_a_capture_needs_is_asked_alone(tmp_path, capsys):
    with pytest.raises(SystemExit):
        zoo.main(["-o", str(tmp_path), "--needs", "--worse", "views=3"])
    assert "give it without --worse" in capsys.readouterr().err


def test_what_a_capture_needs_is_a_table_and_a_plot(scenes, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(zoo, "LADDER", {"views": (3,), "poses": (40,)})
    zoo.main(["-o", str(tmp_path), "--captures", str(scenes[0]), "--only", "tiny", "--needs"])
    with (tmp_path / "needs.csv").open() as file:
        rows = {row["worse"]: row for row in csv.DictReader(file)}
    assert list(rows) == ["", "views=3", "poses=40"]
    assert not (tmp_path / "zoo.csv").exists()  # it is of scenes as they are
    as_it_is = measure(scenes[0], baselines=False)
    assert as_it_is.baseline is None
    assert float(rows[""]["miou"]) == pytest.approx(as_it_is.miou)
    assert float(rows["poses=40"]["miou"]) < as_it_is.miou - 0.2  # of 96 pixels
    said = capsys.readouterr().out
    assert f"| as it is | {as_it_is.miou:.3f} | {float(rows['']['baseline_miou']):.3f} |" in said
    assert (tmp_path / "needs.png").stat().st_size > 5000
