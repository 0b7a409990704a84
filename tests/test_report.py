"""The report: knobs, the front, what shares a table against whole fits, baselines against literal loops, the page."""

import csv
import re
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import NAMES, write_tiny_capture
from scipy.sparse import csr_array

from og_pointcloud.cli import main
from og_pointcloud.cloud import Vocabulary
from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.evaluate.baselines import BASELINES, only_where_masked
from og_pointcloud.evaluate.report import asking, judging, knobs, page, sweep
from og_pointcloud.evaluate.report.judging import disagreement, error, judged, mean_over_captures, verdict
from og_pointcloud.evaluate.report.knobs import find_setting
from og_pointcloud.evaluate.report.measure import (
    Row,
    digest_of,
    error_of,
    labels_of,
    measure,
    measure_apart,
    read_subject,
)
from og_pointcloud.evaluate.report.plots import fit_plot, knob_plot, mean_plot
from og_pointcloud.evaluate.report.shared import ON_SHARED, Measured, SharedFit, rows_of
from og_pointcloud.fitting.fit import fit, prepare
from og_pointcloud.formats.capture import read_capture
from og_pointcloud.settings import FitSettings


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    capture = write_tiny_capture(tmp_path_factory.mktemp("report") / "capture")
    truth = {"cls": capture.object_ids, "background": capture.object_ids < 0}
    np.savez(capture.folder / "gt.npz", names=np.array(NAMES), **truth)
    return capture.folder


@pytest.fixture(scope="module")
def subject(folder):
    return read_subject(folder)


@pytest.fixture(scope="module")
def prepared(folder):
    return prepare(read_capture(folder))


@pytest.fixture(scope="module")
def cloud(folder):
    return fit(read_capture(folder), progress=False)


@pytest.fixture(scope="module")
def shared(subject):
    return SharedFit(subject)


def row(seconds, miou, knob="k", value="v", **more):
    return Row("c", knob, value, seconds, more.pop("seconds_most", seconds), miou=miou, **more)


def test_every_knob_stands_at_its_base_by_default():
    for knob in knobs.KNOBS:
        assert [knob.is_base(value) for value in knob.values].count(True) == 1, knob.name
        assert len({setting.value for setting in knob.values}) == len(knob.values)
        assert knob.why
        assert knob.base in (knobs.DEFAULT, knobs.FAST)


def test_settings_are_found_by_their_names_and_differ():
    forced = [entry.setting for entry in (*knobs.FORCED, *knobs.ALWAYS_FORCED)]
    tried = dict.fromkeys([knobs.DEFAULT, knobs.EXACT, *knobs.SEEDS, *knobs.settings_to_try(paper=True), *forced])
    assert len({(setting.knob, setting.value) for setting in tried}) == len(tried)
    for setting in tried:
        assert find_setting(setting.knob, setting.value) == setting
    assert [setting.is_default for setting in tried].count(True) == 1
    with pytest.raises(OgPointcloudError, match="'mode' has no value 'slow'"):
        find_setting("mode", "slow")


def test_only_the_knobs_asked_for_are_tried():
    tried = knobs.settings_to_try(only=lambda knob: knob.name == "views")
    assert [(setting.knob, setting.every) for setting in tried] == [("views", 2), ("views", 4), ("views", 8)]
    of_fast = knobs.settings_to_try(only=lambda knob: knob.name == "feature width")
    assert [setting.value for setting in of_fast] == ["fast", "3", "12"]  # what the widths are held against comes first


def test_what_shares_a_stage_changes_nothing_of_it():
    """A setting may take over the table only if nothing before grouping reads what it changes."""
    before = ("geometry", "visibility", "memory")
    for setting in knobs.settings_to_try():
        changed = [name for name in before if getattr(setting.settings, name) != getattr(FitSettings(), name)]
        if setting.shares == "table":
            assert changed == [], setting
        if setting.shares == "geometry":
            photographs = replace(setting.settings.geometry, pixels_per_spacing=2.0, max_stride=3)
            assert photographs == FitSettings().geometry, setting


def test_all_that_a_fit_can_leave_out_is_forced_back_or_says_why_not():
    fitting = Path(knobs.__file__).parents[1] / "fitting"
    sources = "".join((fitting / name).read_text() for name in ("fit.py", "modes.py"))
    said = re.findall(r'leave_out\(\s*f?"([^"]+)"', sources)
    assert len(said) > 10
    for what in said:
        what = re.sub(r"\{[^}]*%\}", "75%", what)
        what = re.sub(r"\{[^}]*\}", "12", what)
        assert knobs.forced_by(what) != knobs.NOT_FORCED[""], what
    assert knobs.forced_by("75% of the pixels").value == "all pixels"
    assert knobs.forced_by("16 of 34 groups of masks").value == "dismissed groups"
    assert knobs.forced_by("3 masks").value == "spanning masks"
    assert knobs.forced_by("3 points").value == "coincident points"
    assert knobs.forced_by("a new kind of thing") == knobs.NOT_FORCED[""]


def test_front_is_what_no_row_beats():
    random = np.random.default_rng(0)
    rows = [row(float(s), float(m)) for s, m in random.integers(1, 12, (60, 2)) / 12]
    literal = [
        one
        for one in rows
        if not any(
            (o.seconds <= one.seconds and o.miou >= one.miou) and (o.seconds, o.miou) != (one.seconds, one.miou)
            for o in rows
        )
    ]
    assert {(r.seconds, r.miou) for r in judging.front(rows)} == {(r.seconds, r.miou) for r in literal}


def test_error_without_truth_is_the_disagreement():
    assert error(row(1.0, 0.75, off_exact=0.3)) == 0.25
    assert error(row(1.0, None, disagreement=0.1)) == 0.1
    assert error(row(1.0, None, disagreement=0.1, off_exact=0.3)) == 0.3
    assert error(row(1.0, 0.75, knob="lookup", off_exact=0.3)) == 0.3


def stands(*others, runs_differ=1.0):
    default = row(10.0, 0.9, "default", "", seconds_most=10.0 * runs_differ, gain_low=0.0, gain_high=0.0)
    return verdict([default, *others], "c", "views")


def test_a_default_is_off_the_front_only_beyond_the_noise():
    def other(seconds, miou, low, high):
        return row(seconds, miou, "views", "one of 2", gain=miou - 0.9, gain_low=low, gain_high=high)

    assert stands(other(5.0, 0.89, -0.02, 0.01)).state == "front"  # faster, and worse
    assert stands(other(9.7, 0.9, 0.0, 0.0)).state == "noise"
    off = stands(other(9.0, 0.9, 0.0, 0.0))
    assert (off.state, round(off.saved, 3), off.error) == ("off", 0.1, 0.0)
    assert stands(other(9.0, 0.9, 0.0, 0.0), runs_differ=1.2).state == "noise"  # its own runs differ by more
    assert stands(other(10.2, 0.93, 0.01, 0.05)).state == "off"  # surely better, and hardly slower
    assert stands(other(9.9, 0.93, -0.01, 0.07)).state == "noise"  # better, not surely
    assert stands(other(12.0, 0.93, 0.01, 0.05)).state == "front"
    worst = stands(other(9.7, 0.9, 0.0, 0.0), replace(other(6.0, 0.9, 0.0, 0.0), value="one of 4"))
    assert (worst.state, worst.by.value) == ("off", "one of 4")
    assert stands() is None


def test_values_are_held_against_what_was_measured_the_same_way():
    whole = row(10.0, 0.9, "default", "")
    table = row(9.0, 0.9, "default", ON_SHARED["table"].value, shares="table")
    geometry = row(9.0, 0.9, "default", ON_SHARED["geometry"].value, shares="geometry")
    fast = row(20.0, 0.8, "mode", "fast", shares="table")
    wide = row(21.0, 0.8, "feature width", "12", shares="table")
    pixels = row(7.0, 0.8, "pixels per spacing", "1", shares="geometry")
    file = row(1.0, 0.9, "lookup", "graph and search", off_exact=0.0)
    tree = row(5.0, 0.9, "lookup", "KD-tree, all cores", off_exact=0.0)
    rows = [whole, table, geometry, fast, wide, pixels, file, tree]
    views = row(5.0, 0.9, "views", "one of 2")
    assert judging.base_row(rows, views) is whole
    assert judging.base_row(rows, fast) is table
    assert judging.base_row(rows, pixels) is geometry
    assert judging.base_row(rows, wide) is fast
    assert judging.base_row(rows, tree) is file


def test_means_are_over_captures():
    rows = []
    for name, factor, more in (("a", 0.5, 0.1), ("b", 2.0, 0.3)):
        rows.append(replace(row(10.0, 0.9, "default", ""), capture=name))
        rows.append(replace(row(10.0 * factor, 0.9 - more, "views", "one of 2"), capture=name))
    (mean,) = mean_over_captures(rows, "views")
    assert mean.ratio == pytest.approx(1.0)
    assert mean.error.mean == pytest.approx(0.2)
    assert mean.error.low == pytest.approx(0.1)


def test_rows_are_judged_by_their_labels(folder, subject, cloud):
    default = labels_of(cloud, subject.vocabulary)
    worse, exact = default.copy(), default.copy()
    worse[:: len(worse) // 40] = -1
    exact[:3] = -1
    given = {("default", ""): default, ("views", "one of 2"): worse, (knobs.EXACT.knob, knobs.EXACT.value): exact}
    measured = [Measured(row(1.0, None, *name), labels) for name, labels in given.items()]
    rows = {one.knob: one for one in judged(subject, measured)}
    assert rows["default"].gain == rows["default"].disagreement == 0
    assert rows["default"].off_exact == pytest.approx((default[:3] != -1).mean() * 3 / len(default))
    assert rows["views"].disagreement == pytest.approx((worse != default).mean())
    assert rows["views"].off_exact == pytest.approx((worse != exact).mean())
    literal = error_of(worse, subject)["miou"] - error_of(default, subject)["miou"]
    assert rows["views"].gain == pytest.approx(literal)
    assert rows["views"].gain_low <= literal <= rows["views"].gain_high < 0


def test_a_fit_is_measured_as_it_is_made(folder, subject, cloud):
    measured, labels = measure(subject, knobs.DEFAULT)
    np.testing.assert_array_equal(labels, labels_of(cloud, subject.vocabulary))
    assert measured.instances == len(cloud.instances)
    assert measured.digest == digest_of(cloud)
    assert measured.miou > 0.8
    assert measured.miou == error_of(labels, subject)["miou"]
    assert list(measured.left_out) == cloud.provenance["left_out"]
    assert measured.is_default


def test_a_process_of_its_own_measures_the_same(folder, subject, cloud, tmp_path):
    setting = find_setting("views", "one of 2")
    apart = measure_apart(folder, setting, tmp_path / "labels.npy")
    here, labels = measure(subject, setting)
    np.testing.assert_array_equal(np.load(tmp_path / "labels.npy"), labels)
    assert (apart.digest, apart.knob, apart.value) == (here.digest, "views", "one of 2")
    assert here.digest != digest_of(cloud)
    assert apart.peak_mb > 10


def test_a_fit_that_fails_is_told_by_its_last_line(tmp_path):
    with pytest.raises(OgPointcloudError, match=r"nowhere, default : the fit failed: .*nowhere"):
        measure_apart(tmp_path / "nowhere", knobs.DEFAULT, tmp_path / "labels.npy")


@pytest.mark.parametrize(
    ("knob", "value"),
    [
        ("mode", "auto"),
        ("mode", "fast"),
        ("grouping sample", "5,000"),
        ("pixels per spacing", "0.5"),
        ("pixels per spacing", "4"),
        ("alpha cut-off", "1/16"),
        ("transmittance cut-off", "1e-1"),
        (knobs.EXACT.knob, knobs.EXACT.value),
    ],
)
def test_what_shares_stages_is_what_a_whole_fit_makes(subject, shared, knob, value):
    setting = find_setting(knob, value)
    setting = replace(setting, shares="table") if setting.is_default else setting
    found = shared.measure(setting)[0]
    whole, labels = measure(subject, setting)
    assert found.row.digest == whole.digest
    np.testing.assert_array_equal(found.labels, labels)
    assert found.row.seconds > found.row.shared_seconds > 0
    if setting.shares == "geometry":
        assert list(found.row.left_out) == list(whole.left_out)
        assert value != "0.5" or "of the pixels" in whole.left_out[0]["what"]


def test_a_table_through_float16_is_told_from_the_table(shared):
    weights = shared.prepared.table.weights.copy()
    for value in ("weights float16", "features float16"):
        rounded = shared.measure(find_setting("mask table", value))[0].row
        assert rounded.digest != shared.measure(ON_SHARED["table"])[0].row.digest
        assert rounded.miou > 0.8
    assert (shared.prepared.table.weights != weights).nnz == 0


def test_a_setting_that_fails_does_not_cost_the_others(shared, tmp_path, monkeypatch):
    real = SharedFit._from_table

    def fails(self, setting):
        if setting.value == "grouping":
            raise ZeroDivisionError("division by zero")
        return real(self, setting)

    monkeypatch.setattr(SharedFit, "_from_table", fails)
    tried = [find_setting("mode", "grouping"), find_setting("grouping sample", "5,000")]
    rows = rows_of(shared, tried, tmp_path)
    assert next(rows) == {"knob": "mode", "value": "grouping", "failed": "ZeroDivisionError: division by zero"}
    assert next(rows).row.value == "5,000"


def test_points_at_one_place_are_counted_each(folder, subject, tmp_path):
    from conftest import COLOURS, write_ply

    twice = tmp_path / "twice"
    shutil.copytree(folder, twice)
    xyz = read_capture(folder).points
    place = np.concatenate([np.arange(len(xyz)), np.arange(0, len(xyz), 3)])
    world = xyz.xyz.astype(np.float64) + xyz.origin
    write_ply(twice / "points.ply", world[place].astype(np.float32), np.broadcast_to(COLOURS[0], (len(place), 3)))
    with np.load(folder / "gt.npz") as truth:
        np.savez(twice / "gt.npz", names=truth["names"], cls=truth["cls"][place], background=truth["background"][place])
    again = read_subject(twice)
    fitted = SharedFit(again)
    found = fitted.measure(ON_SHARED["table"])[0]
    whole, labels = measure(again, knobs.DEFAULT)
    np.testing.assert_array_equal(found.labels, labels)
    assert found.row.miou == whole.miou
    forced = next(knobs.forced_by(entry["what"]) for entry in whole.left_out if "points" in entry["what"])
    kept, labels = measure(again, forced)
    assert len(labels) == len(place)
    assert not any("points" in entry["what"] for entry in kept.left_out)


def test_disagreement_of_words_and_of_instances(subject):
    first, second = np.array([0, 0, 1, -1]), np.array([0, 1, 1, -1])
    assert disagreement(first, second, subject) == 0.25
    wordless = replace(subject, vocabulary=None)
    assert disagreement(np.array([5, 5, 7, 7]), np.array([0, 0, 1, 1]), wordless) == 0.0
    assert disagreement(first, second, wordless) > 0


def test_truth_of_another_cloud_is_refused(subject):
    with pytest.raises(SceneError, match="3"):
        error_of(np.zeros(3, int), subject)


def literal_uplift(prepared, features, words):
    weights = prepared.table.weights.toarray().astype(np.float64)
    labels = np.full(weights.shape[1], -1)
    for point in range(weights.shape[1]):
        if weights[:, point].sum() > 0:
            mean = sum(weight * feature for weight, feature in zip(weights[:, point], features, strict=True))
            labels[point] = np.argmax([mean @ (word / np.linalg.norm(word)) for word in words])
    return labels


def test_direct_uplift_is_the_weighted_mean_word_by_word(folder, subject, prepared):
    words = subject.vocabulary.vectors.astype(np.float64)
    labels = BASELINES["direct uplift"](read_capture(folder), prepared, words)
    literal = literal_uplift(prepared, prepared.table.unit_features.astype(np.float64), words)
    np.testing.assert_array_equal(labels, literal)


def test_compressed_features_are_those_of_the_best_three_directions(folder, subject, prepared):
    words = subject.vocabulary.vectors.astype(np.float64)
    features = prepared.table.unit_features.astype(np.float64)
    middle = features.mean(axis=0)
    values, vectors = np.linalg.eigh(np.cov((features - middle).T))
    basis = vectors[:, np.argsort(values)[-3:]]
    literal = literal_uplift(prepared, (features - middle) @ basis @ basis.T + middle, words)
    labels = BASELINES["compressed"](read_capture(folder), prepared, words)
    assert (labels == literal).mean() > 0.999  # equal scores may go either way


def test_nearest_view_asks_the_closest_view_that_has_a_mask_there(folder, subject, prepared):
    scene, table, words = read_capture(folder), prepared.table, subject.vocabulary.vectors
    labels = BASELINES["nearest view"](scene, prepared, words)
    weights, word = table.weights.toarray(), (table.unit_features @ words.T).argmax(axis=1)
    checked = 0
    for point in range(0, weights.shape[1], 7):
        masks = np.flatnonzero(weights[:, point])
        if len(masks) == 0:
            assert labels[point] == -1
            continue
        away = [np.linalg.norm(scene.views[v].camera.center - scene.points.xyz[point]) for v in table.mask_view[masks]]
        closest = masks[np.isclose(away, min(away))]
        if len(np.unique(table.mask_view[closest])) > 1:
            continue  # the cameras stand in a ring: two are equally close
        checked += 1
        assert labels[point] == word[closest[np.argmax(weights[closest, point])]]
    assert checked > 50


def test_centre_sampling_reads_the_pixel_of_each_centre(folder, subject, prepared):
    scene, table, words = read_capture(folder), prepared.table, subject.vocabulary.vectors
    labels = BASELINES["centre sampling"](scene, prepared, words)
    exposure, similarity = table.exposure.toarray(), table.unit_features @ words.T
    first = np.searchsorted(table.mask_view, np.arange(len(scene.views)))
    maps = [view.mask_map() for view in scene.views]
    for point in range(0, len(scene.points), 11):
        total, reached = np.zeros(len(words)), False
        for index, view in enumerate(scene.views):
            camera = view.camera
            x, y, z = camera.world_to_camera[:3, :3] @ scene.points.xyz[point] + camera.world_to_camera[:3, 3]
            if exposure[index, point] == 0 or z <= 0:
                continue
            u, v = int(np.floor(camera.fx * x / z + camera.cx)), int(np.floor(camera.fy * y / z + camera.cy))
            if 0 <= u < camera.width and 0 <= v < camera.height and maps[index][v, u] >= 0:
                total += exposure[index, point] * similarity[first[index] + maps[index][v, u]]
                reached = True
        assert labels[point] == (total.argmax() if reached else -1)


def test_mask_graph_labels_what_masks_show(folder, subject, prepared):
    labels = BASELINES["mask graph"](read_capture(folder), prepared, subject.vocabulary.vectors)
    shown = np.asarray(prepared.table.weights.sum(axis=0)).ravel() > 0
    assert (labels[~shown] == -1).all()
    assert error_of(labels, subject)["macc"] > 0.8


def test_points_shown_mostly_outside_of_masks_lose_their_label():
    weights, outside = csr_array([[3.0, 1.0, 0.0, 2.0], [0.0, 2.0, 0.0, 0.0]]), csr_array([[2.0, 4.0, 1.0, 2.0]])
    shown = SimpleNamespace(table=SimpleNamespace(weights=weights, outside=outside))
    labels = only_where_masked(np.array([5, 6, 7, 8]), shown)
    np.testing.assert_array_equal(labels, [5, -1, -1, -1])  # 3 of 5, 3 of 7, 0 of 1, half


def test_lookups_are_exact_and_coarser_numbers_are_not_hidden(cloud, subject, monkeypatch):
    monkeypatch.setattr(asking, "ASKED", 5_000)
    monkeypatch.setattr(asking, "REPEATS", 1)
    rows = {(row.knob, row.value): row for row in asking.measure_asking(cloud, subject)}
    for value in ("graph and search", "graph, cells of 1", "graph, cells of 3", "search alone", "KD-tree, all cores"):
        assert rows["lookup", value].off_exact == 0
    assert rows["lookup", "graph, no lists"].off_exact > 0
    assert rows["lookup", "graph, cells of 1"].megabytes > rows["lookup", "graph, cells of 3"].megabytes
    for knob, value in asking.DEFAULTS.items():
        assert rows[knob, value].off_exact == 0
    assert rows["descriptors", "int8"].megabytes * 4 == pytest.approx(rows["descriptors", "float32"].megabytes)
    texts = subject.vocabulary.vectors
    assert rows["text", "float16"].miou == rows["descriptors", "float32"].miou
    swapped = replace(subject, vocabulary=Vocabulary(subject.vocabulary.names, texts[::-1].copy()))
    wrong = {(row.knob, row.value): row for row in asking.measure_asking(cloud, swapped)}
    assert wrong["descriptors", "float32"].miou < 0.5 < rows["descriptors", "float32"].miou


def test_command_writes_page_table_and_plots(folder, tmp_path, monkeypatch, capsys):
    few = tuple(replace(knob, values=knob.values[:2]) for knob in knobs.KNOBS if knob.name in ("views", "mode"))
    monkeypatch.setattr(knobs, "KNOBS", few)
    assert main(["report", str(folder), "--quick", "-o", str(tmp_path / "r")]) == 0
    assert "next: open" in capsys.readouterr().out
    html = (tmp_path / "r" / "report.html").read_text()
    assert re.findall(r'(?:src|href)="(?!data:)', html) == []
    for words in (
        "views: one of 2",
        "direct uplift, where masked",
        "lookup: graph and search",
        "left out",
        "same bits",
    ):
        assert words in html
    assert "DIFFERENT" not in html
    rows = {(r["knob"], r["value"]): r for r in csv.DictReader((tmp_path / "r" / "report.csv").open())}
    default = rows["default", ""]
    assert float(default["miou"]) > 0.8
    assert (default["runs"], default["seed"]) == ("2", "0")
    assert "cores" in default["machine"]
    assert default["version"]
    for setting in ON_SHARED.values():
        assert rows["default", setting.value]["digest"] == default["digest"]
        assert rows["default", setting.value]["runs"] == "2"  # first and last
    assert float(rows["mode", "fast"]["shared_seconds"]) > 0
    for name in ("settings", "capture-fits", "capture-settings"):
        assert (tmp_path / "r" / f"{name}.png").read_bytes().startswith(b"\x89PNG")


def test_a_whole_sweep_tries_everything_once(subject, monkeypatch, tmp_path):
    """Nothing is fitted: only who measures what."""
    apart, together = [], []
    left_out = ({"what": "75% of the pixels", "why": ""}, {"what": "learned features and codebook", "why": ""})

    def alone(_, setting, work, runs):
        apart.append((setting, runs))
        return Measured(row(1.0, 0.9, setting.knob, setting.value, left_out=left_out), np.zeros(1))

    monkeypatch.setattr(sweep, "_repeated", alone)
    monkeypatch.setattr(sweep, "measure_shared", lambda _, tried, *rest: (together.extend(tried), ({}, {}))[1])
    sweep.measure_capture(subject, tmp_path, sweep.Sweep(runs=3, paper=True), lambda *told: None)
    assert apart[0] == (knobs.DEFAULT, 3)
    assert (knobs.PAPER, 1) in apart  # it takes minutes
    tried = [setting for setting, _ in apart[1:]] + together
    assert len(tried) == len(set(tried))
    wanted = {*knobs.settings_to_try(paper=True), knobs.EXACT, *knobs.SEEDS, find_setting("left out", "all pixels")}
    assert {*tried} == wanted | {entry.setting for entry in knobs.ALWAYS_FORCED}
    assert all(setting.shares == "nothing" for setting, _ in apart)
    apart.clear()
    together.clear()
    sweep.measure_capture(subject, tmp_path, sweep.Sweep(knobs=("views",)), lambda *told: None)
    assert apart[0] == (knobs.DEFAULT, 2)
    assert {setting.knob for setting, _ in apart[1:]} == {"views"}
    assert knobs.EXACT not in together


def test_page_says_what_is_off_the_front_and_where_runs_differ(tmp_path):
    rows = (
        row(2.0, 0.9, "default", "", runs=2, left_out=({"what": "75% of the pixels", "why": "they are fine"},)),
        row(1.0, 0.95, "views", "one of 2", gain=0.05, gain_low=0.01, gain_high=0.09, runs_alike=False),
        row(2.5, 0.92, "left out", "all pixels", gain=0.02, gain_low=0.01, gain_high=0.03),
        row(2.2, 0.6, "baseline", "direct uplift", gain=-0.3, gain_low=-0.4, gain_high=-0.2),
    )
    dot = mean_plot(rows)
    report = sweep.Report(rows, {"c": dot}, {}, {"c: mode fast": "no mask shows an instance"}, "here", 1.0)
    html = page.write_page(report, tmp_path / "r.html").read_text()
    assert "Runs differ in their answer: c, views one of 2" in html
    assert "off</span> c: one of 2 -50.0%, -0.0500" in html
    assert "+0.300<br><small>+0.200 to +0.400" in html  # ours less direct uplift
    assert "<td>+0.50</td><td>+0.0200 (+0.0100 to +0.0300)</td>" in html  # the pixels: half a second, two points
    assert "Nothing was left out of: views, points" in html
    assert "no mask shows an instance" in html


def test_plots_stand_without_truth_and_with_one_row():
    rows = (row(2.0, None, "default", ""), row(1.0, None, "views", "one of 2", disagreement=0.1))
    for png in (mean_plot(rows), knob_plot(rows, "c"), fit_plot(rows, "c"), fit_plot(rows[:1], "c")):
        assert png.startswith(b"\x89PNG")


def test_bad_use_is_one_error(tmp_path, capsys):
    assert main(["report", "-o", str(tmp_path)]) == 2
    assert "no CAPTURE and no --room" in capsys.readouterr().err
    assert main(["report", str(tmp_path), "--runs", "0"]) == 2
    assert "--runs is 0; expected at least 1" in capsys.readouterr().err
    (tmp_path / "a" / "x").mkdir(parents=True)
    (tmp_path / "b" / "x").mkdir(parents=True)
    assert main(["report", str(tmp_path / "a" / "x"), str(tmp_path / "b" / "x"), "-o", str(tmp_path / "r")]) == 2
    assert "two captures are in folders named 'x'" in capsys.readouterr().err
