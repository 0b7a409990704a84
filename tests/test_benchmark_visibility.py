"""The benchmark of the kernel on tiny inputs: what it prints must follow from what it ran."""

from __future__ import annotations

import benchmark_visibility as benchmark
import numpy as np
import pytest
from reference_splatting import reference_view_weights

from og_pointcloud.fitting.mask_table import view_weights


def tiny() -> benchmark.Case:
    return benchmark.box_case(2_000, 96, 72)


def test_a_window_shows_what_the_image_shows_there() -> None:
    case = tiny()
    window = benchmark.window_of(case)
    assert window.ids.shape == (48, 64)
    assert 100 < len(window.gaussians) <= 2_000
    ids = np.full_like(case.ids, 30)  # the rest of the image is a mask of its own
    ids[12:60, 16:80] = case.ids[12:60, 16:80]
    whole = view_weights(case.gaussians, case.camera, ids, 31, case.near).rows.sum(axis=1)
    part = view_weights(*window.arguments).rows.sum(axis=1)
    np.testing.assert_allclose(part[:30], whole[:30], rtol=1e-2)


def test_errors_are_relative_to_the_reference() -> None:
    window = benchmark.window_of(tiny())
    expected = reference_view_weights(window.gaussians, window.camera, window.ids, 30, window.near)
    assert max(benchmark.errors(window, expected)) < 1e-5
    largest, mean = benchmark.errors(window, 1.1 * expected)
    assert largest == pytest.approx(0.1 / 1.1, rel=1e-3)
    assert mean == pytest.approx(0.1 / 1.1, rel=1e-3)


def test_the_table_compares_two_checkouts(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(benchmark, "ROUNDS", 1)
    here = benchmark.Path(benchmark.__file__).resolve().parents[1]
    benchmark.print_kernel([tiny()], against=here)
    header, row = capsys.readouterr().out.splitlines()
    assert "ratio" in header
    ours, other, ratio, largest, mean = map(float, row.split()[3:])
    assert ratio == pytest.approx(other / ours, rel=0.1)
    assert 0 < mean <= largest < 1e-5


def test_cutoffs_are_compared_with_those_of_3dgs(capsys: pytest.CaptureFixture[str]) -> None:
    benchmark.print_cutoffs([tiny()])
    rows = capsys.readouterr().out.splitlines()[2:]
    lost = [float(row.split()[-2]) for row in rows]
    assert len(rows) == len(benchmark.CUTOFFS)
    assert lost[0] == 0
    assert 0 < lost[1] < lost[3] < 0.1


def test_memory_is_told_stage_by_stage(capsys: pytest.CaptureFixture[str]) -> None:
    benchmark.print_memory(2_000, 3, (64, 48), "64MB")
    out = capsys.readouterr().out
    for stage in ("spacing", "visibility", "membership"):
        row = next(line for line in out.splitlines() if line.startswith(stage)).split()
        assert float(row[2]) > 50
    assert "'on_disk': True" in out
