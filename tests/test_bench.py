"""The benchmark on tiny inputs: errors must be those of the work, verdicts those of the figures. Nothing about time."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import bench
import numpy as np
import pytest
from bench import Kept, Row, baseline_of, read_baseline, verdict, write_baseline
from labelled_clouds import room

import og_pointcloud as og


def row(units, error=0.0, name="kernel", cores=1):
    return Row(name, 1.0, units, error, None, cores)


def test_the_verdict_is_that_of_the_figures():
    kept = Kept(units=10.0, error=0.01, spread=1.1, cores=1)
    assert verdict(row(10.0, 0.01), kept) == "1.00"
    assert verdict(row(12.4, 0.01), kept) == "1.24"
    assert verdict(row(12.6, 0.01), kept) == "1.26 slower"
    assert verdict(row(7.9, 0.01), kept) == "0.79 faster"
    assert verdict(row(10.0, 0.02), kept) == "1.00 larger error"
    # Rounds that differed by half were no better known than that.
    assert verdict(row(14.0, 0.0), replace(kept, spread=1.5)) == "1.40"
    assert verdict(row(16.0, 0.0), replace(kept, spread=1.5)) == "1.60 slower"
    assert verdict(row(16.0, cores=8), kept) == "(of 1 cores)"
    assert verdict(row(16.0), None) == "new"


def test_a_baseline_is_the_median_of_its_rounds(tmp_path):
    rounds = [[row(units, error), row(2 * units, name="write", cores=2)] for units, error in ((3, 0.1), (2, 0), (8, 0))]
    kept = baseline_of(rounds)
    assert kept == {"kernel": Kept(3.0, 0.1, 4.0, 1), "write": Kept(6.0, 0.0, 4.0, 2)}
    write_baseline(tmp_path / "b.json", kept)
    assert read_baseline(tmp_path / "b.json") == kept
    assert "cores" in json.loads((tmp_path / "b.json").read_text())["machine"]
    assert read_baseline(tmp_path / "none.json") == {}


def test_the_least_of_several_runs_after_a_discarded_one():
    clock = iter([0.0, 5.0, 10.0, 12.0, 20.0, 23.0])
    answers = iter("abcd")
    assert bench.fastest(lambda: next(answers), 3, lambda: next(clock)) == (2.0, "d")


def test_the_kernel_is_held_against_float64(monkeypatch):
    (plain,) = bench.bench_kernel(0.5, 2_000, (96, 72))
    assert 0 < plain.error < 1e-5
    assert plain.units == pytest.approx(plain.seconds / 0.5)
    assert plain.against > 1
    # A kernel that drops every alpha below 0.3 is told from one that does not.
    from og_pointcloud.fitting import mask_table as visibility
    from og_pointcloud.fitting.mask_table import Cutoffs

    coarse = visibility.view_weights
    monkeypatch.setattr("benchmark_visibility.view_weights", lambda *a: coarse(*a, cutoffs=Cutoffs(alpha_min=0.3)))
    assert bench.bench_kernel(0.5, 2_000, (96, 72))[0].error > 0.01


def test_a_fit_has_a_row_a_stage():
    rows, cloud = bench.bench_fit(0.5, 4_000, 8, (160, 120), runs=1)
    stages = {stage["name"] for stage in cloud.provenance["stages"]}
    assert {f"fit: {name}" for name in stages} | {"fit, all"} == {one.name for one in rows}
    assert {"spacing", "geometry", "visibility", "membership"} <= stages
    assert {one.error for one in rows} == {rows[0].error}
    assert rows[0].error < 0.3
    parts = sum(one.seconds for one in rows if one.name != "fit, all")
    assert parts == pytest.approx(rows[-1].seconds, rel=1e-6)


@pytest.fixture
def stored(tmp_path):
    cloud = room(1500)
    og.write_bundle(cloud, tmp_path / "room.ogpc")
    return cloud, tmp_path / "room.ogpc"


def test_answers_are_compared(stored):
    cloud, path = stored
    assert bench.bench_segment(0.5, cloud, path, 3_000)[0].error == 0
    assert bench.bench_first_answer(0.5, cloud, path, runs=1)[0].error == 0
    assert bench.bench_write(0.5, cloud, path, runs=1)[0].error == 0


def test_wrong_answers_show_as_errors(stored, monkeypatch):
    """The file is of another cloud, in which a fifth of the points has another instance."""
    cloud, path = stored
    ids = cloud.instance_ids.copy()
    ids[::5] = (ids[::5] + 3) % 9
    other = replace(cloud, instance_ids=ids.astype(np.int32))
    assert bench.bench_segment(0.5, other, path, 3_000)[0].error == pytest.approx(0.2, abs=0.08)
    assert bench.bench_first_answer(0.5, other, path, runs=1)[0].error > 0.05
    monkeypatch.setattr(og, "write_bundle", lambda *_: None)  # the old file stays
    assert bench.bench_write(0.5, other, path, runs=1)[0].error == pytest.approx(0.2, abs=0.01)


def test_the_command_compares_and_stores(tmp_path, monkeypatch, capsys):
    measured = iter([[row(units)] for units in (4.0, 5.0, 4.5, 9.0)])
    monkeypatch.setattr(bench, "measure", lambda: next(measured))
    path = tmp_path / "b.json"
    bench.main(["--save", "--baseline", str(path)])
    assert read_baseline(path)["kernel"] == Kept(4.5, 0.0, 1.25, 1)
    bench.main(["--baseline", str(path)])
    out = capsys.readouterr().out
    assert re.search(r"9\.00 +4\.50  2\.00 slower", out)  # units, those stored, their ratio
    assert "slower than the baseline, beyond its noise: kernel" in out
