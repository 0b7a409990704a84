"""query.onnx by itself: its table against every distance, its scores against float64, and its empty cases."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
from hostile_files import forged, members_of
from labelled_clouds import (
    TOO_FAR,
    WIDTH,
    instance_table,
    instances_plainly,
    make_cloud,
    queries,
    reference_scores,
    room,
    tough_clouds,
    unit_rows,
)
from og_pointcloud_export import lookup_boxes, lookup_grid, writer
from og_pointcloud_export.lookup_boxes import CHILDREN, EDGE
from og_pointcloud_export.lookup_grid import CODE_OFFSET, build_lookup_grid
from og_pointcloud_export.query_graph import build_query_graph
from test_choosing import Made

import og_pointcloud as og
from og_pointcloud.bundle.format import BEYOND_REACH, NEAR_SURFACE, ON_SURFACE
from og_pointcloud.bundle.known_graph import query_tables
from og_pointcloud.bundle.nearest import surface_distance
from og_pointcloud.cloud import WordBank
from og_pointcloud.errors import BundleError, OgPointcloudError
from og_pointcloud.models import open_session

CLOUDS = tough_clouds()
OUTPUTS = ["label", "score", "instance", "distance", "certain", "instance_scores"]


def run(cloud, points, text):
    return answers(build_query_graph(cloud, build_lookup_grid(cloud)), points, text)


def answers(graph, points, text):
    feed = {"points": np.asarray(points, np.float32).reshape(-1, 3), "text": np.asarray(text, np.float32)}
    return dict(zip(OUTPUTS, open_session(graph).run(OUTPUTS, feed), strict=True))


def texts(cloud, count=5):
    width = max(cloud.instances.descriptors.shape[1], 1)
    return np.random.default_rng(2).normal(size=(count, width))


@pytest.mark.parametrize("name", CLOUDS)
def test_tough_clouds_get_exact_answers_from_a_graph_that_readers_know(name):
    """Whoever changes the graph adds its digest to KNOWN_GRAPHS."""
    cloud = CLOUDS[name]
    points, text = queries(cloud, 300), texts(cloud)
    graph = build_query_graph(cloud, build_lookup_grid(cloud))
    assert query_tables(graph)["codes"].tolist() == [len(cloud.instances) + 3]
    found = answers(graph, points, text)
    exact = instances_plainly(cloud, points)
    assert (found["instance"][found["certain"]] == exact[found["certain"]]).all()
    assert found["instance"].min() >= TOO_FAR
    assert found["instance"].max(initial=-1) < max(len(cloud.instances), 1)
    reference = reference_scores(cloud.instances, text)
    assert found["instance_scores"].shape == (len(cloud.instances), len(text))
    assert np.abs(found["instance_scores"] - reference).max(initial=0) < 1e-6
    for label, score, instance in zip(found["label"], found["score"], found["instance"], strict=True):
        if instance < 0 or reference[instance].max() == -2:
            assert (label, score) == (-1, 0)
        else:
            assert label == reference[instance].argmax()
            assert score == pytest.approx(reference[instance].max(), abs=1e-6)


def test_most_queries_near_the_cloud_are_certain():
    random = np.random.default_rng(0)
    xyz = np.append(random.random((20_000, 2)), 0.002 * random.normal(size=(20_000, 1)), axis=1)
    cloud = make_cloud(xyz, xyz[:, 0] > 0.5, spacing=0.006, reach=0.02)
    points = xyz[random.integers(0, len(cloud), 5000)] + 0.3 * cloud.spacing * random.normal(size=(5000, 3))
    # One border, a unit long, with half a cell and about a spacing on either side: a few percent stay open.
    assert run(cloud, points, texts(cloud))["certain"].mean() > 0.95


def test_beyond_the_grid_is_certainly_too_far_unless_points_lie_there():
    beyond = [[1e6, 0, 0], [0, -1e6, 0], [0, 0, 3e38]]
    found = run(CLOUDS["room"], beyond, texts(CLOUDS["room"]))
    assert (found["instance"] == TOO_FAR).all()
    assert found["certain"].all()
    assert not run(CLOUDS["far outliers"], beyond, texts(CLOUDS["far outliers"]))["certain"].any()


def test_far_outliers_do_not_grow_the_table():
    room_grid, outlier_grid = (build_lookup_grid(CLOUDS[name]) for name in ("room", "far outliers"))
    assert outlier_grid.blocks.size <= lookup_grid.MIN_BLOCK_BUDGET
    assert len(outlier_grid.nodes) <= 2 * len(room_grid.nodes)


def test_a_long_map_gets_wider_cells_and_every_answer_is_certain(monkeypatch):
    monkeypatch.setattr(lookup_grid, "MIN_BLOCK_BUDGET", 300)
    monkeypatch.setattr(lookup_grid, "BLOCKS_PER_POINT", 0)
    along = np.linspace(0, 60, 1500)  # a street from corner to corner of its bounds, its points 0.05 apart or more
    xyz = np.stack([along, along, along / 2], axis=1) + np.random.default_rng(0).normal(scale=0.05, size=(1500, 3))
    cloud = replace(make_cloud(xyz.astype(np.float32), np.arange(1500) % 3), spacing=0.05, reach=0.15)
    points = np.concatenate([cloud.xyz, queries(cloud, 200)]).astype(np.float32)
    found = run(cloud, points, texts(cloud))
    assert found["certain"].all()
    assert (found["instance"] == instances_plainly(cloud, points)).all()
    assert (found["instance"][:1500] >= 0).all()


@pytest.mark.parametrize("nodes", [5, 100, 260])
def test_a_table_over_its_budget_of_nodes_leaves_boxes_open_and_stays_right(monkeypatch, nodes):
    cloud = CLOUDS["room"]
    points = queries(cloud, 300)
    full = run(cloud, points, texts(cloud))
    monkeypatch.setattr(lookup_grid, "MIN_NODE_BUDGET", nodes)
    monkeypatch.setattr(lookup_grid, "NODES_PER_POINT", 0)
    small = run(cloud, points, texts(cloud))
    assert len(build_lookup_grid(cloud).nodes) == nodes + 1  # and the row for lists
    assert full["certain"].all()
    assert not small["certain"].all()
    assert (small["instance"] == instances_plainly(cloud, points))[small["certain"]].all()


def test_lists_settle_what_is_open():
    cloud = CLOUDS["room"]
    points = cloud.xyz + np.float32(0.3 * cloud.spacing) * np.random.default_rng(0).normal(size=cloud.xyz.shape)
    found = run(cloud, points, texts(cloud))
    assert found["certain"].all()
    assert (found["instance"] == instances_plainly(cloud, points.astype(np.float32))).all()


@pytest.mark.parametrize("cell_per_spacing", [0.7, 3.0])
def test_the_size_of_a_cell_changes_no_answer(monkeypatch, cell_per_spacing):
    cloud = CLOUDS["room"]
    points = queries(cloud, 300)
    monkeypatch.setattr(lookup_grid, "CELL_PER_SPACING", cell_per_spacing)
    found = run(cloud, points, texts(cloud))
    assert found["certain"].mean() > 0.95
    assert (found["instance"] == instances_plainly(cloud, points))[found["certain"]].all()


def test_without_lists_the_center_of_a_box_answers_for_it(monkeypatch):
    cloud = CLOUDS["room"]
    points = cloud.xyz + np.float32(0.3 * cloud.spacing) * np.random.default_rng(0).normal(size=cloud.xyz.shape)
    exact = instances_plainly(cloud, points.astype(np.float32))
    monkeypatch.setattr(lookup_grid, "MIN_LIST_BUDGET", 0)
    monkeypatch.setattr(lookup_grid, "LISTS_PER_POINT", 0)
    table = run(cloud, points, texts(cloud))
    assert 0.2 < table["certain"].mean() < 1
    assert (table["instance"] == exact)[table["certain"]].all()
    assert 0.7 < (table["instance"] == exact).mean() < 1  # mostly, not always, the right one


def test_lists_over_their_budget_leave_boxes_open_and_every_answer_right(monkeypatch):
    cloud = CLOUDS["room"]
    points = queries(cloud, 300)
    monkeypatch.setattr(lookup_grid, "MIN_LIST_BUDGET", 100)
    monkeypatch.setattr(lookup_grid, "LISTS_PER_POINT", 0)
    monkeypatch.setattr(lookup_grid, "BOXES_PER_CHUNK", 1)  # a budget ends with the chunk that uses it up
    assert 100 <= (build_lookup_grid(cloud).child_length > 0).sum() < 100 + CHILDREN
    found = run(cloud, points, texts(cloud))
    assert 0.2 < found["certain"].mean() < 1
    assert (found["instance"] == instances_plainly(cloud, points))[found["certain"]].all()


@pytest.mark.parametrize("share", [0.1, 0.5])
def test_a_graph_has_no_more_bytes_than_a_file_can_and_stays_right(monkeypatch, share):
    cloud = CLOUDS["room"]
    points = queries(cloud, 300)
    most = int(share * len(build_query_graph(cloud, build_lookup_grid(cloud))))
    monkeypatch.setattr(lookup_grid, "MAX_TABLE_BYTES", most)
    monkeypatch.setattr(lookup_grid, "BOXES_PER_CHUNK", 1)
    without_tables = 25_000
    assert len(build_query_graph(cloud, build_lookup_grid(cloud))) < most + without_tables
    found = run(cloud, points, texts(cloud))
    assert 0 < found["certain"].mean() < 1
    assert (found["instance"] == instances_plainly(cloud, points))[found["certain"]].all()


def test_boxes_answered_in_small_chunks_give_the_same_graph(monkeypatch):
    cloud = CLOUDS["room"]
    graph = build_query_graph(cloud, build_lookup_grid(cloud))
    monkeypatch.setattr(lookup_grid, "BOXES_PER_CHUNK", 3)
    assert build_query_graph(cloud, build_lookup_grid(cloud)) == graph


def answer_at(grid, part):
    """What the grid says of a part of a cell, (3,) counted from its low corner: (certain answer, None, edge in parts of
    the box that says it), or (None, the points of its list, edge); (None, None, edge) if open."""
    block, place = part // EDGE**3, part // EDGE**2 % EDGE
    reference = int(grid.bricks[grid.blocks[tuple(block)], np.ravel_multi_index(tuple(place), (EDGE,) * 3)])
    for size in (EDGE, 1):
        if reference >= len(grid.nodes):
            return None, points_of_list(grid, reference - len(grid.nodes)), size * EDGE
        value = int(grid.nodes[reference, np.ravel_multi_index(tuple(part // size % EDGE), (EDGE,) * 3)])
        if value < 2 * grid.codes:
            return (value if value < grid.codes else None), None, size
        child = int(grid.first_child[reference]) + value - 2 * grid.codes
        if grid.child_length[child] > 0:
            return None, points_of_list(grid, child), size
        reference = int(grid.child_start[child])
    raise AssertionError("a part is split")


def points_of_list(grid, child):
    start = grid.child_start[child]
    return set(grid.candidates[start : start + grid.child_length[child]].tolist())


def box_plainly(cloud, center, half):
    """(answer of the instance, or -3; points nearest somewhere): the box against all points in reach, pair by pair."""
    seen = cloud.xyz.astype(np.float64) - center
    in_reach = np.flatnonzero((np.maximum(np.abs(seen) - half, 0) ** 2).sum(axis=1) <= float(cloud.reach) ** 2)
    if len(in_reach) == 0:
        return TOO_FAR, set()
    seen = seen[in_reach]  # what loses to a point out of reach is out of reach itself
    squared = (seen**2).sum(axis=1)
    spread = np.abs(seen[:, None] - seen).sum(axis=2)
    loses = (squared[:, None] - squared - 2 * half * spread > 1e-9 * half**2).any(axis=1)
    winners = in_reach[~loses]
    everywhere = ((np.abs(seen[squared.argmin()]) + half) ** 2).sum() <= float(cloud.reach) ** 2
    same = len(set(cloud.instance_ids[winners].tolist())) == 1
    return (int(cloud.instance_ids[winners[0]]) if everywhere and same else None), set(winners.tolist())


def test_every_box_is_that_of_the_plain_reference():
    base, random = room(120), np.random.default_rng(3)
    dense, lone = 0.25 * base.xyz + [2.5, 0, 0], 3 * random.random((25, 3))
    ids = np.concatenate([base.instance_ids, base.instance_ids, np.arange(25) % 9])
    cloud = make_cloud(np.concatenate([base.xyz, dense, lone]), ids, instances=base.instances)
    grid = build_lookup_grid(cloud)
    size, near_codes = float(grid.cell_size) / EDGE, grid.codes // 2
    rounding = float(grid.cell_size) * 4 * float(np.finfo(np.float32).eps) * max(grid.shape) * EDGE
    kinds = {(kind, edge): 0 for kind in ("certain", "list") for edge in (1, EDGE, EDGE**2)}
    occupied = np.unique(np.floor((cloud.xyz - grid.low) / size).astype(int), axis=0)
    about = np.concatenate([random.integers(-12, 13, (10, 3)), random.integers(-2, 3, (6, 3))])
    for part in np.unique((occupied[:, None] + about).reshape(-1, 3), axis=0):
        code, points, edge = answer_at(grid, part)
        center = grid.low.astype(np.float64) + (part // edge + 0.5) * edge * size
        expected, winners = box_plainly(cloud, center, edge * size / 2 + rounding)
        if code is None:
            kinds["list", edge] += 1
            assert expected is None
            assert winners <= points  # more where boxes share the list
        else:
            kinds["certain", edge] += 1
            assert expected == (
                TOO_FAR if code == 0 else (code - near_codes if code > near_codes else code) - CODE_OFFSET
            )
    del kinds["certain", EDGE**2]  # no brick is within reach of one point
    assert min(kinds.values()) > 20, kinds


def test_a_sparse_scene_is_settled_whole_however_far_it_reaches():
    random = np.random.default_rng(4)
    spread = np.append(random.random((3000, 2)) * 1500, random.random((3000, 1)) * 100, axis=1)
    cloud = make_cloud(spread, np.arange(3000) % 7, spacing=1.0, reach=3.0)
    points = (spread + random.normal(size=spread.shape) * random.choice([0.3, 1.5], (3000, 1))).astype(np.float32)
    found = run(cloud, points, texts(cloud))
    assert found["certain"].all()
    assert (found["instance"] == instances_plainly(cloud, points)).all()
    grid = build_lookup_grid(cloud)
    # Hardly a brick without a point is split: it has the list of the points about it.
    assert (grid.bricks >= len(grid.nodes)).sum() > 2 * len(cloud)
    assert sum(table.nbytes for table in vars(grid).values() if isinstance(table, np.ndarray)) < 400 * len(cloud)


def test_queries_where_very_many_points_lie_are_settled_in_parts(monkeypatch):
    random = np.random.default_rng(6)
    xyz = np.concatenate([random.random((1000, 3)) * 0.12, 3 * random.random((500, 3))])
    cloud = make_cloud(xyz, random.integers(0, 5, 1500))
    points = (xyz[:1000] + 0.01 * random.normal(size=(1000, 3))).astype(np.float32)
    found = run(cloud, points, texts(cloud))
    assert (found["instance"] == instances_plainly(cloud, points))[found["certain"]].all()
    assert found["certain"].mean() > 0.2
    monkeypatch.setattr(lookup_grid, "MIN_NODE_BUDGET", 60)  # bricks alone: lists of cells do not hold so many
    monkeypatch.setattr(lookup_grid, "NODES_PER_POINT", 0)
    assert run(cloud, points, texts(cloud))["certain"].mean() < 0.1


def test_of_coincident_points_one_is_kept():
    cloud = CLOUDS["coincident points of different ids"]
    assert build_lookup_grid(cloud).candidates.max() < 800


def test_lists_have_at_most_so_many_candidates():
    cloud = make_cloud(np.random.default_rng(6).random((4000, 3)) * 0.12, np.arange(4000) % 5)
    grid, points = build_lookup_grid(cloud), queries(cloud, 300)
    assert grid.child_length.max() <= lookup_boxes.MAX_LIST_LENGTH
    found = run(cloud, points, texts(cloud))
    assert 0 < found["certain"].mean() < 1
    assert (found["instance"] == instances_plainly(cloud, points))[found["certain"]].all()


def test_distance_is_surface_near_or_beyond():
    cloud = CLOUDS["room"]
    cell = float(build_lookup_grid(cloud).cell_size)
    points = queries(cloud, 400)[:1200]
    found = run(cloud, points, texts(cloud))
    true = np.linalg.norm(points[:, None].astype(np.float64) - cloud.xyz, axis=2).min(axis=1)
    assert ((found["distance"] == BEYOND_REACH) == (found["instance"] == TOO_FAR)).all()
    assert ((found["distance"] == BEYOND_REACH) == (true > cloud.reach)).all()
    # Between the first two, a cell's center speaks for the cell.
    half_diagonal, surface = cell * np.sqrt(3) / 2, surface_distance(cloud.spacing, cloud.reach)
    assert (found["distance"][true <= surface - half_diagonal] == ON_SURFACE).all()
    assert (found["distance"][(true > surface + half_diagonal) & (true <= cloud.reach)] == NEAR_SURFACE).all()
    assert set(found["distance"].tolist()) == {ON_SURFACE, NEAR_SURFACE, BEYOND_REACH}


def test_a_table_without_any_box_is_all_open(monkeypatch):
    cloud = CLOUDS["room"]
    monkeypatch.setattr(lookup_grid, "MAX_BRICKS_PER_AXIS", 0)
    assert not run(cloud, [[1e6, 0, 0]], texts(cloud))["certain"].any()


def test_nan_is_too_far():
    cloud = CLOUDS["room"]
    found = run(cloud, [[np.nan, 0, 0], [0, np.nan, 0], [np.nan] * 3, [np.inf, 0, 0], [-np.inf, 0, 0]], texts(cloud))
    assert (found["instance"] == TOO_FAR).all()
    assert (found["label"] == -1).all()


@pytest.mark.parametrize("points", [0, 7])
@pytest.mark.parametrize("labels", [0, 1, 3])
@pytest.mark.parametrize("instances", [0, 2])
def test_any_count_may_be_zero(points, labels, instances):
    cloud = make_cloud(
        np.zeros((3, 3)), [-1, -2, instances - 1 if instances else -1], instances=instance_table(instances)
    )
    found = run(cloud, np.zeros((points, 3)), texts(cloud, labels))
    assert found["instance_scores"].shape == (instances, labels)
    assert found["label"].shape == found["score"].shape == found["certain"].shape == (points,)


def test_odd_text_vectors():
    cloud = make_cloud(np.zeros((1, 3)), [0])
    row = cloud.instances.descriptors[0].astype(np.float64)
    found = run(cloud, [[0, 0, 0]], [0 * row, 1e-42 * row, 1e30 * row, -3 * row])
    assert found["instance_scores"][0, [0, 2, 3]] == pytest.approx([0, 1, -1], abs=1e-6)
    assert np.isfinite(found["instance_scores"]).all()
    assert found["label"].tolist() == [2]


AWKWARD_TEXT = np.concatenate(
    [
        unit_rows(20),
        unit_rows(4) * 1e30,
        unit_rows(4) * 1e-30,
        np.eye(WIDTH)[:3] * -7,
        instance_table(5).descriptors,
        -instance_table(5).descriptors,
        np.full((1, WIDTH), 3e38),
    ]
).astype(np.float32)


def test_scores_of_texts_of_any_length_are_those_of_float64():
    cloud = make_cloud(np.zeros((1, 3)), [0], instances=instance_table(5, [0, 0, 1, 2, 4]))
    found = run(cloud, [[0, 0, 0]], AWKWARD_TEXT)["instance_scores"]
    assert np.abs(found - reference_scores(cloud.instances, AWKWARD_TEXT)).max() < 1e-5


def test_an_instance_answers_with_its_best_descriptor():
    table = instance_table(2, [0, 0, 1])
    cloud = make_cloud(np.zeros((1, 3)), [0], instances=table)
    found = run(cloud, [[0, 0, 0]], table.descriptors[::-1])
    assert found["instance_scores"][0, 1:] == pytest.approx([1, 1], abs=1e-6)
    assert found["label"][0] in (1, 2)


def test_the_graph_stands_alone_and_is_plain():
    model = onnx.load_from_string(build_query_graph(CLOUDS["room"], build_lookup_grid(CLOUDS["room"])))
    onnx.checker.check_model(model, full_check=True)
    assert [value.name for value in model.graph.input] == ["points", "text"]
    assert [value.name for value in model.graph.output] == OUTPUTS
    assert model.graph.input[1].type.tensor_type.shape.dim[1].dim_value == WIDTH
    assert not any(tensor.external_data for tensor in model.graph.initializer)


def test_the_documented_program_answers_like_the_library(tmp_path, monkeypatch):
    writer.write_bundle(CLOUDS["map coordinates"], tmp_path / "scene.ogpc")
    monkeypatch.chdir(tmp_path)
    page = (Path(__file__).resolve().parents[1] / "docs" / "query_onnx.md").read_text()
    program = page.split("```python\n")[1].split("```")[0]
    origin = CLOUDS["map coordinates"].origin
    names = {}
    exec(program.replace("]])  # world", f"]]) + {origin.tolist()}  # world"), names)
    words = dict(zip("abc", names["text"], strict=True))
    assert names["labels"].tolist() == og.segment(names["points"], words, tmp_path / "scene.ogpc").labels.tolist()
    assert names["labels"].tolist()[:2] != [-1, -1]
    assert names["labels"][2] == -1
    assert names["instance"].tolist()[2] == TOO_FAR


@pytest.mark.parametrize(("bank_words", "signal"), [(300, 0.5), (50, 0.14)])
def test_the_documented_program_of_probabilities_answers_like_the_library(tmp_path, monkeypatch, bank_words, signal):
    made = Made(9, signal, owners=[0, 0, 1, 2, 3, 5, 6, 7, 8])
    bank = WordBank(made.bank.vectors[:bank_words])
    cloud = replace(CLOUDS["room"], instances=made.table, word_bank=bank, vocabulary=None)
    writer.write_bundle(cloud, tmp_path / "scene.ogpc")
    monkeypatch.chdir(tmp_path)
    page = (Path(__file__).resolve().parents[1] / "docs" / "query_onnx.md").read_text()
    program = "".join(part.split("```")[0] for part in page.split("```python\n")[1:])
    texts = made.texts[[0, 2, 3, 6, 30, 31]]
    asked = program.replace(
        "text = np.eye(3, width, dtype=np.float32)", f"text = np.array({texts.tolist()}, np.float32)"
    )
    asked = asked.replace("points = np.array(", "points = np.array(near + ")
    names = {"near": queries(cloud, 100).astype(np.float64).tolist()}
    exec(asked, names)
    result = og.segment(names["points"], dict(zip("abcdef", texts, strict=True)), tmp_path / "scene.ogpc")
    assert result.calibrated
    assert {-1, 0, 1} <= set(result.labels)
    assert names["labels"].tolist() == result.labels.tolist()
    np.testing.assert_allclose(names["scores"], result.scores, atol=1e-5)


HARMS = {
    "another domain": lambda model: setattr(model.graph.node[0], "domain", "com.stranger"),
    "another opset": lambda model: model.opset_import.add(domain="com.microsoft", version=1),
    "a function": lambda model: model.functions.add(name="f", domain=""),
    "a note": lambda model: model.metadata_props.add(key="a", value="b"),
}
"""Of the whole file; UNKNOWN_GRAPHS of hostile_files change its graph, and test_text_encoder's harms its constants."""


@pytest.mark.parametrize("harm", HARMS.values(), ids=HARMS)
def test_hostile_graphs_are_refused_before_a_runtime_sees_them(harm, tmp_path, monkeypatch):
    path = writer.write_bundle(CLOUDS["one point"], tmp_path / "s.ogpc")
    model = onnx.load_from_string(members_of(path)["query.onnx"])
    harm(model)
    with pytest.raises(ValueError):  # before a file holds it
        query_tables(model.SerializeToString())
    hostile = forged(path, tmp_path / "hostile.ogpc", {"query.onnx": model.SerializeToString()})
    monkeypatch.setattr("og_pointcloud.ask.query_graph.open_session", None)
    with pytest.raises(BundleError, match="do not trust the file"):
        og.load(hostile)


def test_a_graph_that_differs_from_float64_is_refused(monkeypatch):
    monkeypatch.setattr(writer, "SCORE_TOLERANCE", 1e-12)
    with pytest.raises(OgPointcloudError, match="differs from float64"):
        writer.query_model(CLOUDS["room"])
