"""The runtime's benchmark on a small room: what it prints must follow from what it ran. Nothing here is about time."""

from __future__ import annotations

import csv

import benchmark_runtime as benchmark
import numpy as np
import pytest
from labelled_clouds import room
from og_pointcloud_export import write_bundle


@pytest.fixture(scope="module")
def bundle_file(tmp_path_factory):
    return write_bundle(room(1500), tmp_path_factory.mktemp("bundle") / "room.ogpc")


def test_lookups_are_exact_with_lists_and_not_without(bundle_file, tmp_path):
    pytest.importorskip("matplotlib")
    cells = ["1", "2"]
    arguments = ["-o", str(tmp_path), "--points", "2000", "--rounds", "1", "--noise", "0.5", "--cells", *cells]
    benchmark.main([str(bundle_file), *arguments])
    with (tmp_path / "runtime.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["way"], float(row["cell_per_spacing"])) for row in rows] == [
        (way, float(cell)) for way in benchmark.WAYS for cell in cells
    ]
    for row in rows:
        assert float(row["frame_differ"]) == 0
        assert (float(row["differ"]) > 0.001) == (row["way"] == "table alone")
        assert float(row["differ"]) <= float(row["open"])
        assert float(row["ratio"]) == pytest.approx(float(row["kd_tree_ms"]) / float(row["frame_ms"]))
    with (tmp_path / "scores.csv").open() as file:
        scores = list(csv.DictReader(file))
    assert [row["precision"] for row in scores[:3]] == ["float32", "float16", "int8"]
    errors = [float(row["error"]) for row in scores]
    assert errors[0] < 1e-6 < errors[1] < errors[2] < 0.05
    assert (tmp_path / "runtime.png").stat().st_size > 5000
    assert sorted(file.name for file in tmp_path.iterdir()) == ["runtime.csv", "runtime.png", "scores.csv"]


def test_a_scene_without_descriptors_has_no_scores():
    from labelled_clouds import instance_table, make_cloud

    cloud = make_cloud(np.zeros((3, 3)), [0, 0, -1], instances=instance_table(1, []))
    assert benchmark.measure_scores(cloud, None, 1) == []


def test_footprint_of_a_fresh_process(bundle_file, capsys, monkeypatch):
    monkeypatch.setattr(benchmark.print_footprint, "__defaults__", (1,))
    benchmark.main([str(bundle_file), "--footprint"])
    lines = capsys.readouterr().out.splitlines()
    assert lines[3].split()[:4] == ["heavy", "libraries", "loaded", "none"]
    packages = [line.split()[0] for line in lines[5:]]
    assert {"numpy", "onnxruntime", "og-pointcloud"} <= set(packages)
    assert not {"scipy", "torch", "numba", "onnx"} & set(packages)
    assert float(lines[4].split()[2]) == pytest.approx(sum(float(line.split()[-2]) for line in lines[5:]), abs=1)
