"""The benchmark scripts on tiny inputs: what they print must follow from what they ran. Nothing here is about time."""

from __future__ import annotations

import csv
from dataclasses import asdict, replace
from pathlib import Path

import benchmark_scaling as scaling
import numpy as np
import pytest
from benchmark_scaling import BallRoom, ScalingRow, exponent, made_scene, series
from conftest import FEATURE_SPACE, NAMES, TinyCapture

from og_pointcloud.formats.capture import read_capture
from og_pointcloud.scene import Camera


@pytest.fixture
def scored_capture(tiny_capture: TinyCapture) -> Path:
    """The tiny capture with its truth beside it."""
    np.savez(tiny_capture.folder / "gt.npz", cls=tiny_capture.object_ids, names=np.array(NAMES))
    return tiny_capture.folder


def grown(points: int, views: int, mode: str) -> ScalingRow:
    """A row of a fit whose seconds grow as points^0.5 views, its memory as points."""
    seconds = 0.01 * points**0.5 * views
    return ScalingRow(
        points, views, mode, 10 * views, seconds, 2 * seconds, 3 * seconds, 4 * seconds, 200 + points, points, 0.9
    )


def test_balls_are_drawn_where_rays_meet_them() -> None:
    """The drawing ball by ball within boxes, against every ray with every ball."""
    room = BallRoom.make(30, np.random.default_rng(0))
    assert len(room.radii) > 15
    for view in made_scene(10, 3, (80, 60))[0].views:
        camera = view.camera
        column, row = np.meshgrid(np.arange(80) + 0.5, np.arange(60) + 0.5)
        ray = np.stack([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, np.ones_like(row)], -1)
        ray = (ray / np.linalg.norm(ray, axis=-1, keepdims=True)) @ camera.world_to_camera[:3, :3]
        to_centre = room.centres - camera.center
        along = ray @ to_centre.T
        miss = (to_centre**2).sum(axis=1) - along**2
        depth = np.where((miss < room.radii**2) & (along > 0), along - np.sqrt(abs(room.radii**2 - miss)), np.inf)
        expected = np.where(np.isfinite(depth).any(axis=-1), depth.argmin(axis=-1), -1)
        assert (expected >= 0).mean() > 0.02
        np.testing.assert_array_equal(room.look(camera), expected)


def test_points_of_the_made_scene_are_seen_where_its_images_show_them() -> None:
    scene, owner = made_scene(20_000, 3, (160, 120), balls=8)
    assert 0.02 < (owner >= 0).mean() < 0.5
    for view in scene.views:
        at, inside = _pixels(scene.points.xyz, view.camera)
        assert inside.sum() > 3_000
        # Places agree but for hidden points and those at edges: far more often than chance would have it.
        alike = (view.image_rgb()[at[inside, 1], at[inside, 0]] == scene.points.rgb[inside]).all(axis=1)
        assert alike.mean() > 0.85
        assert view.mask_count == len(np.unique(view.mask_map()[view.mask_map() >= 0]))


def _pixels(xyz: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    in_camera = xyz @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    depth = np.maximum(in_camera[:, 2:], 1e-3)
    at = np.floor(in_camera[:, :2] / depth * camera.fx + (camera.cx, camera.cy)).astype(int)
    size = (camera.width, camera.height)
    return at, (in_camera[:, 2] > 0.1) & (at >= 0).all(axis=1) & (at < size).all(axis=1)


def test_a_row_adds_up_and_finds_the_balls() -> None:
    row = scaling.measure(4_000, 8, "fast", (160, 120))
    assert (row.points, row.views, row.mode) == (4_000, 8, "fast")
    assert row.masks == sum(view.mask_count for view in made_scene(4_000, 8, (160, 120))[0].views) > 20
    assert min(row.prepare_s, row.own_s) > 0
    assert row.prepare_s + row.own_s <= row.total_s + 1e-3
    assert row.cpu_s > 0
    assert 0 <= row.grown_mb < row.peak_mb
    assert row.agreement > 0.7


def test_a_row_in_its_own_process_is_the_row() -> None:
    row = ScalingRow(**scaling.in_own_process(scaling.__file__, ["1500", "3", "grouping"], threads=1))
    assert (row.points, row.views, row.mode) == (1_500, 3, "grouping")
    assert row.masks == sum(view.mask_count for view in made_scene(1_500, 3)[0].views)


def test_exponents_of_known_growth() -> None:
    assert exponent([1, 10, 100], [3, 30, 300]) == pytest.approx(1)
    assert exponent([1, 2, 4], [5, 20, 80]) == pytest.approx(2)
    rows = [grown(n, scaling.VIEWS_OF_POINTS, mode) for n in (30_000, 7_000) for mode in scaling.MODES]
    rows += [grown(scaling.POINTS_OF_VIEWS, n, mode) for n in (20, 60) for mode in scaling.MODES]
    assert series(rows, "points", "prepare")[0] == [7_000, 30_000, scaling.POINTS_OF_VIEWS]
    assert series(rows, "views", "memory, fast") == ([20, 60], [scaling.POINTS_OF_VIEWS] * 2)
    for name in scaling.QUANTITIES:
        memory = name.startswith("memory")
        assert exponent(*series(rows, "points", name)) == pytest.approx(1 if memory else 0.5)
        assert exponent(*series(rows, "views", name)) == pytest.approx(0 if memory else 1, abs=1e-9)


def test_scaling_writes_what_it_measured(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib")
    asked: list[tuple[str, ...]] = []

    def pretend(script: str, arguments: tuple[str, str, str], threads: int) -> dict[str, object]:
        asked.append(arguments)
        row = asdict(grown(int(arguments[0]), int(arguments[1]), arguments[2]))
        return row | {"total_s": row["total_s"] / len(asked)}  # later runs are faster

    monkeypatch.setattr(scaling, "in_own_process", pretend)
    monkeypatch.setattr(scaling, "compile_once", lambda *_: None)
    monkeypatch.setattr("sys.argv", ["benchmark_scaling.py", "-o", str(tmp_path), "--repeats", "2"])
    scaling.main()
    with (tmp_path / "scaling.csv").open() as file:
        rows = list(csv.DictReader(file))
    # 5 sizes and 4 numbers of views share one scene.
    assert len(rows) == len({(row["points"], row["views"], row["mode"]) for row in rows}) == 16
    assert len(asked) == 32
    first = grown(7_000, 60, "grouping").total_s
    assert float(rows[0]["total_s"]) == pytest.approx(first / 2)
    assert (tmp_path / "scaling.png").stat().st_size > 10_000
    (slopes,) = (line.split()[1:] for line in capsys.readouterr().out.splitlines() if line.startswith("prepare "))
    assert slopes == ["0.50", "0.50", "1.00", "1.00"]


def test_paper_is_extrapolated_to_its_published_schedule(scored_capture: Path) -> None:
    pytest.importorskip("torch")
    from benchmark_modes import measure

    row = measure(scored_capture, "paper", 0.001)
    assert 0 < row.miou < 1  # 60 steps teach little
    assert (row.steps, row.published_steps) == (60, 60_000)
    assert row.published_s == pytest.approx(row.total_s + 59_940 * row.seconds_per_step, rel=1e-2)
    assert row.steps * row.seconds_per_step < row.own_s < row.total_s


def test_rows_of_modes_score_the_capture(scored_capture: Path) -> None:
    from benchmark_modes import measure

    rows = {mode: measure(scored_capture, mode, 1.0) for mode in ("grouping", "fast", "auto")}
    for row in rows.values():
        assert row.published_s == row.total_s >= row.prepare_s + row.own_s - 1e-3
        assert 0.8 < row.miou <= row.macc <= 1
        assert row.unknown < 0.2
    assert rows["grouping"].steps == 0 < rows["fast"].steps
    auto = rows["auto"]
    assert auto.chosen in ("grouping", "fast")
    assert auto.miou == rows[auto.chosen].miou


def test_modes_compares_what_it_measured(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib")
    import benchmark_modes as modes

    score = {"grouping": 0.8, "fast": 0.9, "auto": 0.88, "paper": 0.5}
    started: list[list[str]] = []

    def pretend(script: str, arguments: list[str], threads: int) -> dict[str, object]:
        folder, mode = arguments[:2]
        row = modes.ModeRow(
            Path(folder).name, mode, mode, score[mode], 1, 0, 1, 1, 2, 3, 100, 0, 1.0, 0, 0, 2
        )  # fmt: skip
        if mode == "paper":
            row = replace(row, steps=60, seconds_per_step=0.005, published_steps=60_000, published_s=300)
        return asdict(row)

    monkeypatch.setattr(modes, "in_own_process", pretend)
    monkeypatch.setattr(modes, "compile_once", lambda *_: None)
    monkeypatch.setattr(modes.subprocess, "run", lambda command, **_: started.append(command))
    monkeypatch.setattr("sys.argv", ["benchmark_modes.py", "shelf", "--rooms", "4", "-o", str(tmp_path)])
    modes.main()
    printed = capsys.readouterr().out
    for capture in ("shelf", "room4"):
        (line,) = (line for line in printed.splitlines() if line.startswith(capture) and "/" in line)
        assert line.split()[1:] == ["-0.0200", "(fast)", "300", "/", "2.0", "=", "150", "(60,000", "steps)"]
    with (tmp_path / "modes.csv").open() as file:
        written = [(row["capture"], row["mode"], float(row["miou"])) for row in csv.DictReader(file)]
    assert written == [(capture, mode, score[mode]) for capture in ("shelf", "room4") for mode in modes.MODES]
    assert (tmp_path / "modes.png").stat().st_size > 10_000
    assert started[0][-2:] == ["4", str(tmp_path / "room4")]
    assert started[1][2] == "shelf"


def test_an_unknown_mode_is_refused_by_name(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    from benchmark_modes import parse

    monkeypatch.setattr("sys.argv", ["benchmark_modes.py", "shelf", "--modes", "fast,faster"])
    with pytest.raises(SystemExit):
        parse()
    assert "--modes names faster; expected some of grouping, fast, auto, paper" in capsys.readouterr().err


def test_fast_forms_equal_rendering_and_a_wrong_table_shows(scored_capture: Path) -> None:
    pytest.importorskip("torch")
    import benchmark_equality as equality

    scene = read_capture(scored_capture)
    rows = equality.compare(FEATURE_SPACE, scene)
    assert len(rows) == 6
    for row in rows:
        assert row.float64 < 1e-11, row
        assert 1e-10 < row.float32 < 5e-6, row

    exact = equality.exact_form

    def wrong(*arguments: object) -> equality.Form:
        form = exact(*arguments)
        weights = form.table.weights.copy()
        weights.data[::2] *= 1.001
        return replace(form, table=replace(form.table, weights=weights))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(equality, "exact_form", wrong)
        damaged = {row.quantity: row.float64 for row in equality.compare(FEATURE_SPACE, scene)}
    assert all(error > 1e-7 for error in damaged.values()), damaged  # undamaged: below 1e-11


def test_labels_follow_every_change_of_a_capture(scored_capture: Path) -> None:
    from benchmark_invariance import CHANGES, measure

    first, *rows = measure(scored_capture)
    assert [row.change for row in rows] == list(CHANGES)
    assert first.miou > 0.8
    for row in rows:
        assert row.same_label > 0.98, row.change
        assert row.instances == first.instances, row.change


def test_a_moved_world_shows_the_same_images(scored_capture: Path) -> None:
    """Points turn, grow and go with their cameras: each falls on the pixel it fell on."""
    from benchmark_invariance import moved

    scene = read_capture(scored_capture)
    changed, rows = moved(scene, np.random.default_rng(1), scale=3.0, turned=True, offset=100.0)
    assert abs(np.linalg.norm(changed.points.xyz_world - scene.points.xyz_world, axis=1)).min() > 50
    for before, after in zip(scene.views, changed.views, strict=True):
        at, inside = _pixels(scene.points.xyz, before.camera)
        moved_at, moved_inside = _pixels(changed.points.xyz[np.argsort(rows)], after.camera)
        both = inside & moved_inside
        assert both.sum() > 0.99 * inside.sum() > 0
        assert (moved_at[both] == at[both]).mean() > 0.99  # but for a few on the border of two pixels
