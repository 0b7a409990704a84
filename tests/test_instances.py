"""The table of instances: each column against its plain definition, files of it, and what has no points."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from commands import error_of
from labelled_clouds import WIDTH, WORDS, instance_table, make_cloud, room, tough_clouds, unit_rows

import og_pointcloud as og
from og_pointcloud.ask.boxes import axis_aligned_box, oriented_box
from og_pointcloud.ask.labelled_scene import LabelledScene
from og_pointcloud.cli import main
from og_pointcloud.cloud import Vocabulary
from og_pointcloud.errors import counted

FAR = np.array([1e6, -4e6, 350.25])


@pytest.fixture(scope="module")
def scene():
    return LabelledScene.from_cloud(replace(room(900), origin=FAR))


@pytest.mark.parametrize("cloud", tough_clouds().values(), ids=tough_clouds())
def test_every_cloud_has_a_table(cloud):
    table = og.instance_table(LabelledScene.from_cloud(cloud))
    assert str(table).startswith(counted(len(cloud.instances), "instance"))
    assert json.loads(table.to_json(), parse_constant=pytest.fail) == table.to_records(), "no NaN, no infinity"


def test_each_column_is_what_it_says(scene):
    table, evidence = og.instance_table(scene), scene.cloud.instances
    assert [row.id for row in table] == list(range(9))
    for k, row in enumerate(table):
        own = scene.xyz[scene.instance_ids == k]
        np.testing.assert_array_equal(row.xyz, own)
        main = own[row.main_part]
        np.testing.assert_allclose(row.centroid, main.mean(axis=0), atol=1e-8)
        np.testing.assert_allclose(row.axis_aligned_box.low, main.min(axis=0), atol=1e-8)
        np.testing.assert_allclose(row.axis_aligned_box.high, main.max(axis=0), atol=1e-8)
        np.testing.assert_array_equal(row.oriented_box.size, oriented_box(main).size)
        assert row.points == len(own) > 20
        assert (row.views, row.masks, row.part_of) == (evidence.views[k], evidence.masks[k], evidence.part_of[k])
        assert (row.agreement, row.visible_area) == (evidence.agreement[k], evidence.visible_area[k])
        assert row.state == ("no feature" if k == 4 else "labelled")


def test_strays_are_outside_the_boxes_but_counted():
    random = np.random.default_rng(0)
    xyz = np.concatenate([random.random((500, 3)), [[40, 0, 0], [0, 70, 0]]])
    row = og.instance_table(LabelledScene.from_cloud(make_cloud(xyz, np.zeros(502))))[0]
    assert (row.points, row.to_dict()["strays"]) == (502, 2)
    assert row.axis_aligned_box.high.max() <= 1
    assert row.oriented_box.volume < 1.01


def test_best_words_are_the_highest_cosines(scene):
    table, cloud = og.instance_table(scene, words=2), scene.cloud
    vectors = cloud.vocabulary.vectors / np.linalg.norm(cloud.vocabulary.vectors, axis=1, keepdims=True)
    for row in table:
        own = cloud.instances.descriptors[cloud.instances.descriptor_instance == row.id]
        if not len(own):
            assert row.words == ()
            continue
        cosines = (own @ vectors.T).max(axis=0)
        best = np.argsort(-cosines)[:2]
        assert [name for name, _ in row.words] == [WORDS[index] for index in best]
        np.testing.assert_allclose([score for _, score in row.words], cosines[best], atol=1e-5)


def test_words_may_be_given_or_missing(scene):
    vectors = unit_rows(2, WIDTH, seed=5)
    given = og.instance_table(scene, {"one": vectors[0], "two": vectors[1]})
    assert {name for row in given for name, _ in row.words} == {"one", "two"}
    wordless = LabelledScene.from_cloud(replace(scene.cloud, vocabulary=None))
    assert all(row.words == () for row in og.instance_table(wordless))
    empty = replace(scene.cloud, vocabulary=Vocabulary((), np.zeros((0, WIDTH), np.float32)))
    assert og.instance_table(LabelledScene.from_cloud(empty))[0].words == ()


def test_boxes_stand_upright_where_up_is_known(scene):
    for row in og.instance_table(scene, up=(0, 0, 1)):
        np.testing.assert_allclose(row.oriented_box.axes[2], [0, 0, 1], atol=1e-12)


def test_an_instance_without_points_has_no_place():
    cloud = make_cloud([[0, 0, 0], [1, 0, 0]], [2, 2], instances=instance_table(4))
    table = og.instance_table(LabelledScene.from_cloud(cloud))
    assert [row.state for row in table] == ["empty", "empty", "labelled", "empty"]
    assert table[0].centroid is table[0].oriented_box is table[0].axis_aligned_box is None
    assert len(table[0].main_part) == 0
    np.testing.assert_allclose(table[2].oriented_box.size, [1, 0, 0], atol=1e-12)
    records = list(csv.DictReader(table.to_csv().splitlines()))
    assert [record["axis_aligned_box_low_0"] for record in records] == ["", "", "0.0", ""]
    assert "empty" in repr(table)


def test_ids_do_not_count_from_the_end(scene):
    table = og.instance_table(scene)
    for wrong in (-1, -2, 9):
        with pytest.raises(IndexError, match="background"):
            table[wrong]
    assert [row.id for row in table[2:4]] == [2, 3]
    sizes = [row.points for row in table.largest(3)]
    assert sizes == sorted((row.points for row in table), reverse=True)[:3]


def test_no_instance_at_all():
    cloud = make_cloud([[0, 0, 0]], [-1], instances=instance_table(0))
    table = og.instance_table(LabelledScene.from_cloud(cloud))
    assert len(table) == 0
    assert table.to_records() == json.loads(table.to_json()) == []
    assert repr(table).startswith("0 instances")
    assert table.to_csv() == "\n"


def test_json_and_csv_hold_the_same_numbers(scene, tmp_path):
    table = og.instance_table(scene)
    table.to_json(tmp_path / "t.json"), table.to_csv(tmp_path / "t.csv")
    records = json.loads((tmp_path / "t.json").read_text())
    assert records == table.to_records()
    with (tmp_path / "t.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(records) == 9
    for record, row in zip(records, rows, strict=True):
        oriented, words = record["oriented_box"], record["words"]
        assert [float(row[f"oriented_box_size_{k}"]) for k in range(3)] == oriented["size"]
        assert [float(row[f"oriented_box_rotation_wxyz_{k}"]) for k in range(4)] == oriented["rotation_wxyz"]
        assert float(row["oriented_box_axes_2_1"]) == oriented["axes"][2][1]
        assert [float(row[f"axis_aligned_box_high_{k}"]) for k in range(3)] == record["axis_aligned_box"]["high"]
        assert [row[f"words_{k}_name"] for k in range(len(words))] == [word["name"] for word in words]
    assert not list(tmp_path.glob("*.tmp"))


def test_a_table_costs_nothing_until_it_is_asked(scene, monkeypatch):
    monkeypatch.setattr("og_pointcloud.ask.instances.oriented_box", lambda *_: pytest.fail("asked too early"))
    table = og.instance_table(scene)
    assert table[0].axis_aligned_box is table[0].axis_aligned_box
    np.testing.assert_array_equal(
        table[0].axis_aligned_box.size, axis_aligned_box(table[0].xyz[table[0].main_part]).size
    )


def test_printed_table_is_cut_and_starts_with_the_largest():
    cloud = make_cloud(np.random.default_rng(0).random((300, 3)), np.arange(300) % 30)
    lines = repr(og.instance_table(LabelledScene.from_cloud(cloud))).splitlines()
    assert lines[0] == "30 instances"
    assert lines[-1] == "and 18 smaller ones"
    assert len(lines) == 15


def test_places_on_a_map_are_told_to_a_tenth_of_a_meter():
    cloud = make_cloud(np.random.default_rng(0).random((50, 3)), np.zeros(50, np.int32))
    far = replace(cloud, origin=np.array([500_000.25, 4_000_000.5, 100.0]))
    assert " 50000" in repr(og.instance_table(far))
    assert " 400000" in repr(og.instance_table(far))


def test_any_way_to_name_a_scene(bundle):
    for source in (bundle, str(bundle), og.load(bundle), room(600)):
        assert len(og.instance_table(source)) == 9
    with pytest.raises(og.OgPointcloudError, match="scene is a int"):
        og.instance_table(3)


@pytest.mark.parametrize("words", [-1, 1.5, None, True])
def test_words_a_row_are_counted(words):
    with pytest.raises(og.OgPointcloudError, match=rf"words is {words}; expected a number of words per row, from 0"):
        og.instance_table(room(600), words=words)


def test_a_negative_count_of_largest_is_refused():
    table = og.instance_table(room(600))
    assert len(table.largest(0)) == 0
    with pytest.raises(og.OgPointcloudError, match="count is -1; expected 0 or more"):
        table.largest(-1)


def test_command(bundle, tmp_path, capsys):
    assert main(["instances", str(bundle), "--up", "0,0,1", "-o", str(tmp_path / "new" / "t.csv")]) == 0
    assert capsys.readouterr().out.startswith("9 instances\nid")
    assert len((tmp_path / "new" / "t.csv").read_text().splitlines()) == 10
    assert main(["instances", str(bundle), "--json", "--words", "1"]) == 0
    assert [len(record["words"]) for record in json.loads(capsys.readouterr().out)] == [1, 1, 1, 1, 0, 1, 1, 1, 1]
    assert "ends in .json or .csv" in error_of(capsys, "instances", bundle, "-o", tmp_path / "t.txt")
    assert "expected x, y, z, -x, -y, -z or a direction" in error_of(capsys, "instances", bundle, "--up", "0,0")
