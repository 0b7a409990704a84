"""What the live page shows and answers, without the page: colors by slow loops, words by `select`, clicks by `pick`."""

from dataclasses import replace

import numpy as np
import pytest
from labelled_clouds import make_cloud, room

import og_pointcloud as og
from og_pointcloud.ask.picking import front_points
from og_pointcloud.formats.colors import LUMINANCE, NO_LABEL, certainty_colors, label_colors
from og_pointcloud.mapping.map_record import MapRecord, VisitEntry
from og_pointcloud.scene import Points
from og_pointcloud.show.live import CHANGES, LiveScene
from og_pointcloud.show.viewpoint import Viewpoint


def rainbow(count=3000):
    cloud = room(count)
    random = np.random.default_rng(1)
    certainty = random.integers(0, 256, count).astype(np.uint8)
    return replace(cloud, rgb=random.integers(0, 256, (count, 3)).astype(np.uint8), certainty=certainty)


def quarters(origin=(0, 0, 0)):
    """A square in four instances, one of them background."""
    xy = np.stack(np.meshgrid(np.arange(0, 2, 0.05), np.arange(0, 2, 0.05)), axis=-1).reshape(-1, 2)
    ids = 2 * (xy[:, 0] > 1) + (xy[:, 1] > 1) - 1
    cloud = make_cloud(np.c_[xy, 0.1 * np.sin(3 * xy[:, 0])], ids, origin=origin)
    return replace(cloud, certainty=np.arange(len(xy)).astype(np.uint8))


@pytest.fixture
def scene():
    return og.LabelledScene.from_cloud(rainbow())


def slow_color(own, rgb, is_lit):
    """One point, float64: a color, by the point's own light, in grey where it is not lit."""
    light = sum(weight * value / 255 for weight, value in zip(LUMINANCE, rgb, strict=True))
    color = np.array([min(channel * (0.55 + 0.55 * light), 255) for channel in own]).astype(int)
    return color if is_lit else np.full(3, int(0.72 * 237 + 0.28 * color.sum() / 3))


def test_a_map_of_two_visits_is_colored_by_change(scene):
    assert "changes" not in LiveScene(scene).modes
    cloud = scene.cloud
    count = len(cloud.instances)
    record = MapRecord([VisitEntry("monday", 0.0, 3), VisitEntry("friday", 5.0, 3)], dict.fromkeys(range(count), 5.0))
    record.last_seen[2], record.moved_from[4] = 0.0, (1.0, 2.0, 3.0)
    map_ = replace(cloud, provenance=record.added_to(cloud.provenance))
    live = LiveScene(og.LabelledScene.from_cloud(map_), labels=["plum"])
    live.mode = "changes"
    shown, ids = live.colors(), cloud.instance_ids
    for point in range(0, len(shown), 7):
        name = {4: "moved to here", 2: "not seen at the last visit"}.get(ids[point], "as it was")
        expected = slow_color(CHANGES[name], cloud.rgb[point], True)
        assert np.abs(shown[point].astype(int) - expected).max() <= 1
    counts = {name: points for name, _, points in live.legend()}
    assert counts == {
        "moved to here": (ids == 4).sum(), "not seen at the last visit": (ids == 2).sum(),
        "as it was": (~np.isin(ids, [2, 4])).sum(),
    }  # fmt: skip
    live.mode = "labels"
    assert "moved to here" not in {name for name, *_ in live.legend()}


@pytest.mark.parametrize("mode", ["labels", "instances"])
@pytest.mark.parametrize("lit", [None, {0, 4, 7}, set()])
def test_colors_are_those_of_labels_and_instances(scene, mode, lit):
    live = LiveScene(scene, labels=["plum", "apple"])
    live.mode, live.lit = mode, lit
    result = og.segment(scene, ["plum", "apple"])
    shown = live.colors()
    assert shown.dtype == np.uint8
    for point in range(0, len(shown), 7):
        instance, label = result.instances[point], result.labels[point]
        is_lit = lit is None or instance in lit
        by_instance = instance >= 0 and (mode == "instances" or (label < 0 and lit is not None and is_lit))
        own = label_colors(np.array([instance if by_instance else label]))[0]
        own = own if by_instance or (label >= 0 and mode == "labels") else NO_LABEL
        expected = slow_color(own, scene.cloud.rgb[point], is_lit)
        assert np.abs(shown[point].astype(int) - expected).max() <= 1


@pytest.mark.parametrize("mode", ["labels", "instances", "certainty", "photo"])
def test_the_legend_shows_colors_only_where_points_have_them(scene, mode):
    live = LiveScene(scene, labels=["plum", "apple"])
    live.mode = mode
    shown = {name: tuple(color) for name, color, _ in live.legend()}
    by_label = dict(zip(["plum", "apple"], map(tuple, label_colors(np.arange(2)).tolist()), strict=True))
    grey = dict.fromkeys(["plum", "apple"], tuple(NO_LABEL))
    assert {name: shown[name] for name in by_label} == (by_label if mode == "labels" else grey)


def test_photographs_and_certainty_are_shown_as_they_are(scene):
    live = LiveScene(scene)
    assert live.modes == ("labels", "instances", "certainty", "photo")
    live.mode = "photo"
    assert np.array_equal(live.colors(), scene.cloud.rgb)
    live.mode = "certainty"
    shown = live.colors().astype(int)
    for certainty, color in ((0, (68, 1, 84)), (255, (253, 231, 37))):
        assert np.array_equal(shown[scene.cloud.certainty == certainty][0], color)
    light = certainty_colors(np.linspace(0, 1, 33)) @ LUMINANCE
    assert (np.diff(light) > 0).all(), "more certain is brighter"
    live.lit = {3}
    lit = live.colors()
    assert np.array_equal(lit[live.ids == 3], shown[live.ids == 3])
    assert (np.ptp(lit[live.ids != 3], axis=1) == 0).all()


def test_a_mode_that_the_scene_cannot_show_is_not_offered():
    bare = replace(rainbow(300), rgb=None, certainty=None, vocabulary=None)
    live = LiveScene(og.LabelledScene.from_cloud(bare))
    assert live.modes == ("instances",)
    assert live.legend() == [("unknown", NO_LABEL, 300)]
    assert live.choose(0).bars == ()
    assert "stores no words" in live.choose(0).note
    assert live.name_of(0) == "instance 0"


def test_words_light_what_select_finds(scene):
    live = LiveScene(scene)
    for word in scene.vocabulary.names:
        answer, found = live.ask(word), og.select(scene, word)
        assert live.lit == set(found.instances)
        assert answer.lines == (f"fits {len(found.instances)} of {len(found)} instances",)
        assert [score for _, score in answer.bars] == [match.score for match in found[: len(answer.bars)]]
        assert answer.note.startswith("cosine")
    assert live.ask("  ").lines[0] == "stored words: apple, pear, plum, café, red ball"
    assert live.lit is None


def test_a_word_that_nobody_knows_leaves_everything_lit(scene):
    live = LiveScene(scene)
    live.ask("plum")
    answer = live.ask("appel")
    assert live.lit is None
    assert "did you mean 'apple'" in answer.lines[0]


def test_a_word_whose_encoder_lacks_a_package_names_the_extra(scene, monkeypatch):
    def lacking(*_):
        raise og.MissingExtraError("tokenizers", "words")

    live = LiveScene(scene)
    monkeypatch.setattr(og.LabelledScene, "words", lacking)
    assert "og-pointcloud[words]" in live.ask("unheard of").lines[0]
    assert live.lit is None


@pytest.mark.parametrize("origin", [(0, 0, 0), (4e5, -2e6, 100)])
def test_clicks_find_what_pick_finds(origin):
    cloud = quarters(origin)
    scene = og.LabelledScene.from_cloud(cloud)
    live, center = LiveScene(scene), scene.xyz.mean(axis=0)
    eye = center + np.array([0.3, -0.6, 1.9])
    camera = Viewpoint(eye, center, np.eye(3)[0]).camera(160, 120, 60.0)
    front = front_points(cloud, camera)
    seen = np.append(cloud.instance_ids, np.int32(og.TOO_FAR))[front]  # -1, no point, is the last
    clear = 0
    for column, row in np.random.default_rng(0).integers([5, 5], [155, 115], (60, 2)):
        around = np.unique(seen[row - 2 : row + 3, column - 2 : column + 3])
        if len(around) > 1:  # at a border the page, which looks straight at the pixel, may draw points otherwise
            continue
        clear += 1
        direction = camera.world_to_camera[:3, :3].T @ [(column - 79.5) / 60, (row - 59.5) / 60, 1]
        answer = live.click(eye, direction, 60.0)
        assert live.lit == ({around[0]} if around[0] >= 0 else None)
        if around[0] >= 0:
            assert answer.lines[0].startswith(f"instance {around[0]} · ")
            assert answer.lines[-1].startswith("certainty that the point belongs to it: ")
            assert answer.bars == live.instances[around[0]].words
        else:
            assert answer.lines == ("no instance",)
    assert clear > 20
    assert (seen >= 0).any()


def test_how_sure_is_that_of_the_point_that_was_clicked():
    scene = og.LabelledScene.from_cloud(quarters())
    live, down = LiveScene(scene), np.array([0, 0, -1.0])
    for point in np.flatnonzero(scene.instance_ids >= 0)[::100]:
        answer = live.click(scene.xyz[point] - down, down, 100.0)
        assert answer.lines[-1] == f"certainty that the point belongs to it: {scene.certainty[point]:.0%}"


def test_another_cloud_is_shown_with_the_instances_of_the_scene(scene):
    random = np.random.default_rng(2)
    other = Points.from_world(scene.xyz[random.integers(0, 3000, 500)] + 0.01 * random.normal(size=(500, 3)))
    live = LiveScene(scene, other)
    assert np.array_equal(live.ids, scene.instances_at(other.xyz_world))
    assert live.modes == ("labels", "instances", "certainty")
    assert live.colors().shape == (500, 3)
    counts = {name: count for name, count in og.segment(other.xyz_world, None, scene).counts().items() if count}
    assert {name: count for name, _, count in live.legend()[:-1]} == counts
    assert sum(count for *_, count in live.legend()) == 500
