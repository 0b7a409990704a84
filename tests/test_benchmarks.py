"""The benchmark scripts on tiny inputs: what they print must follow from what they ran. Nothing here is about time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import bench
import benchmark_runtime
import benchmark_visibility
import numpy as np
import pytest
from scipy.sparse import csr_array

from og_pointcloud.rendering.splatting import Gaussians

pytestmark = pytest.mark.slow


def test_a_window_shows_what_the_image_shows_there() -> None:
    case = benchmark_visibility.room_case(2_000, 96, 72)
    window = benchmark_visibility.window_of(case)
    whole = case.draw().sum(axis=1).reshape(72, 96)[12:60, 16:80]
    np.testing.assert_allclose(window.draw().sum(axis=1), whole.ravel(), rtol=1e-3)
    assert 0 < max(benchmark_visibility.errors(window)) < 1e-5


def test_a_kernel_that_leaves_out_too_much_shows(monkeypatch: pytest.MonkeyPatch) -> None:
    right = benchmark_visibility.view_weights

    def fainter(gaussians: Gaussians, *given: Any) -> csr_array:
        return right(replace(gaussians, opacity=np.float32(0.9) * gaussians.opacity), *given)

    monkeypatch.setattr(benchmark_visibility, "view_weights", fainter)
    window = benchmark_visibility.window_of(benchmark_visibility.room_case(2_000, 96, 72))
    assert benchmark_visibility.errors(window)[0] > 0.01


def test_the_kernel_is_a_row_a_case(capsys: pytest.CaptureFixture[str]) -> None:
    benchmark_visibility.main(["--points", "500", "2000"])
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[1] for line in lines[1:]] == ["500", "2,000"]
    assert max(float(line.split()[-1]) for line in lines[1:]) < 1e-5


def test_lookups_are_exact(bundle: Path, capsys: pytest.CaptureFixture[str]) -> None:
    benchmark_runtime.main([str(bundle), "--points", "2000", "--rounds", "1", "--noise", "0.5"])
    points, ours, tree, ratio, differ = capsys.readouterr().out.splitlines()[-1].replace(",", "").split()
    assert (points, float(differ)) == ("2000", 0)
    assert float(ratio) == pytest.approx(float(tree) / float(ours), rel=0.05)


def test_footprint_of_a_fresh_process(bundle: Path, capsys: pytest.CaptureFixture[str], monkeypatch) -> None:
    monkeypatch.setattr(benchmark_runtime.print_footprint, "__defaults__", (1,))
    benchmark_runtime.main([str(bundle), "--footprint"])
    lines = capsys.readouterr().out.splitlines()
    assert lines[3].split()[:4] == ["heavy", "libraries", "loaded", "none"]
    packages = [line.split()[0] for line in lines[5:]]
    assert {"numpy", "onnxruntime", "og-pointcloud"} <= set(packages)
    assert not {"scipy", "torch", "numba", "onnx"} & set(packages)


@pytest.mark.release
def test_bench_measures_every_piece_and_pairs_the_rounds(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("open3d")
    truth = bench.write_files(tmp_path / "files")
    bench.measure(bench.ROOT, tmp_path, truth)
    seconds, error = bench.measure(bench.ROOT, tmp_path, truth)
    assert set(seconds) == set(error) == set(bench.PIECES)
    assert min(seconds.values()) > 0
    assert error["write"] == error["first answer"] == error["segment"] == 0
    assert 0 < error["kernel"] < 1e-5
    assert 0 < error["fit"] < 0.1
    before = {"seconds": seconds, "error": error}
    after = {"seconds": {name: 2 * value for name, value in seconds.items()}, "error": error}
    bench.print_table([[before, after]] * 3)
    rows = capsys.readouterr().out.splitlines()[-len(bench.PIECES) :]
    assert all("2.00    2.00-2.00" in row for row in rows)


def test_tables_of_the_paper_are_written_and_go_on_where_they_were(tiny_capture, tmp_path, monkeypatch, capsys):
    """Every row of the association from one training; a second start measures nothing."""
    pytest.importorskip("torch")
    import benchmark_paper

    with pytest.raises(SystemExit, match="lacks gt"):
        benchmark_paper.main([str(tiny_capture.folder), "-o", str(tmp_path / "out")])
    truth = {"cls": tiny_capture.object_ids, "background": tiny_capture.object_ids < 0}
    np.savez(tiny_capture.folder / "gt.npz", names=np.array(["red ball", "blue ball"]), **truth)
    command = [str(tiny_capture.folder), "--table", "association", "--share", "0.0005", "--seeds", "2", "-o"]
    benchmark_paper.main([*command, str(tmp_path / "out")])
    page = (tmp_path / "out" / "association.md").read_text().splitlines()
    assert [line.split(" | ")[0] for line in page[2:]] == ["| IoU only", "| feature only", "| both"]
    assert page[-1].endswith("| 0.383 |")
    rows = list(benchmark_paper.read_rows(tmp_path / "out" / "rows.csv"))
    assert [row.seed for row in rows] == [0, 0, 0, 1, 1, 1]
    assert len({(row.seed, row.instances) for row in rows}) <= 2, "one training a seed"
    monkeypatch.setattr(benchmark_paper, "append", None)
    benchmark_paper.main([*command, str(tmp_path / "out")])
    assert capsys.readouterr().out.count("| IoU only |") == 2


def test_a_panorama_has_masks_of_things_as_few_pixels_large_as_a_photograph():
    """Else the lens would be blamed for what the proposer leaves out: a share of a panorama is many more pixels."""
    pytest.importorskip("open3d")
    import benchmark_lenses as lenses
    from og_pointcloud_room.capture import CaptureSettings, make_capture
    from og_pointcloud_room.masks import MaskNoise

    capture = make_capture(0, CaptureSettings(views=2))
    perfect = MaskNoise().scaled(0)
    least = perfect.smallest_share * capture.intrinsics.width * capture.intrinsics.height
    photographed, _ = lenses.photographed(capture, lenses.lenses(capture, every=2)["spherical"], perfect, 0)
    (frame,), (masks,) = photographed.frames, photographed.masks
    shown = np.bincount(frame.owner[frame.owner >= 0])
    masked = np.bincount(frame.owner[(masks > 0) & (frame.owner >= 0)], minlength=len(shown))
    between = (shown >= least) & (shown < perfect.smallest_share * masks.size)
    assert between.sum() >= 3
    assert (masked[between] > 0).all()
    assert not masked[shown < least].any()
