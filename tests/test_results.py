"""The README's tables of results: they parse, and what writes them writes what the scorers say."""

from __future__ import annotations

import csv
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import NAMES, write_tiny_capture

import og_pointcloud as og
from og_pointcloud.evaluate.baselines import direct_uplift, only_where_masked
from og_pointcloud.fitting.fit import prepare

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
SPREAD = r"[+-]?\d\.\d{3} to [+-]?\d\.\d{3}"


@pytest.fixture(scope="module")
def script():
    sys.path.insert(0, str(ROOT / "scripts"))
    import write_results

    yield write_results
    sys.path.remove(str(ROOT / "scripts"))


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    made = write_tiny_capture(tmp_path_factory.mktemp("results") / "tiny")
    ids = made.object_ids
    np.savez(made.folder / "gt.npz", names=np.array(NAMES), cls=ids, background=ids < 0)
    return made


def cells(table: str) -> list[list[str]]:
    return [[cell.strip() for cell in row.strip("|").split(" | ")] for row in table.splitlines()]


def literal_miou(said, cls):
    """Names said of each point, against classes; the floor's points have none, and a name there is a false one."""
    ious = [((said == n) & (cls == k)).sum() / ((said == n) | (cls == k)).sum() for k, n in enumerate(NAMES)]
    return float(np.mean(ious))


def test_the_readmes_tables_parse(script):
    header, rule, *rows = cells(script.around(README, "results")[1])
    assert header == list(script.HEADER)
    assert len(rule) == len(header)
    assert len(rows) >= 5
    for row in rows:
        assert len(row) == len(header), row
        miou, uplift, masked, gain = row[1:5]
        assert re.fullmatch(rf"\*\*\d\.\d{{3}}\*\* \({SPREAD}\)", miou), miou
        assert re.fullmatch(rf"[+-]\d\.\d{{3}} \({SPREAD}\)", gain), gain
        over, gained = float(miou[2:7]) - max(float(uplift), float(masked)), float(gain.split()[0])
        assert gained <= over + 2e-3
        # Of rooms the mean of gains is given, each over the better of its room.
        assert row[0].startswith("mean of") or gained >= over - 2e-3
        low, high = (float(number) for number in re.search(r"\((.*) to (.*)\)", miou).groups())
        assert low - 0.0005 <= float(miou[2:7]) <= high + 0.0005
        assert re.fullmatch(r"\d+\.\d s", row[8])
        assert re.fullmatch(r"\d+\.\d MB", row[9])
    header, _, *rows = cells(script.around(README, "modes")[1])
    assert {row[0].split(",")[0] for row in rows} >= {"`grouping`", "`fast`", "`auto`", "`paper`"}
    assert all(len(row) == len(header) for row in rows)


def test_a_row_is_what_the_scorers_say(script, capture, tmp_path, capsys):
    page = tmp_path / "page.md"
    empty = "".join(f"<!-- {name} -->\n<!-- end of {name} -->\n" for name in ("results", "modes"))
    page.write_text(f"above\n{empty}below\n")
    script.main([str(capture.folder), "--runs", "1", "--readme", str(page)])
    (row,) = cells(script.around(page, "results")[1])[2:]
    assert page.read_text().startswith("above\n<!-- results -->\n| scene")
    assert page.read_text().endswith("<!-- end of modes -->\nbelow\n")
    assert row[0] == f"tiny, 6 views, {len(capture.object_ids):,} points"
    scene = og.read_capture(capture.folder)
    og.write_bundle(og.fit(scene, progress=False), tmp_path / "s.ogpc")
    result = og.segment(og.load(tmp_path / "s.ogpc"), None, text_features=capture.text_features)
    ours = literal_miou(np.array([*result.names, ""])[result.labels], capture.object_ids)
    words = np.load(capture.text_features)
    uplifted = direct_uplift(scene, prepare(scene), words["vectors"])
    masked = only_where_masked(uplifted, prepare(scene))
    names = np.array([*words["names"], ""])
    plain = [literal_miou(names[labels], capture.object_ids) for labels in (uplifted, masked)]
    assert row[1].startswith(f"**{ours:.3f}** (")
    assert row[2:4] == [f"{miou:.3f}" for miou in plain]
    assert row[2] != row[3]
    assert row[4].startswith(f"{ours - max(plain):+.3f} (")
    assert row[6] == f"{np.mean(result.labels[capture.object_ids >= 0] < 0):.3f}"
    assert row[7] == f"{np.mean(result.labels[capture.object_ids < 0] >= 0):.3f}"
    assert f"{ours:.4f}" in capsys.readouterr().out
    # What is written again takes the place of what was there.
    again = page.read_text()
    script.with_table(page, "results", script.around(page, "results")[1])
    assert page.read_text() == again


def test_rooms_share_a_line(script):
    from og_pointcloud.evaluate.intervals import BlockInterval
    from og_pointcloud.evaluate.metrics import Score

    def row(miou, plain):
        spread = BlockInterval(miou, miou - 0.1, miou + 0.1, 1.0, 50)
        score = Score(miou, 0.9, 0.1, 0.02, 100, (0,), (miou,), (0.9,))
        gain = replace(spread, mean=miou - plain)
        return script.CaptureRow("room", 90, 1000, 5, score, spread, plain - 0.1, plain, gain, 8.0, 0.3, 4.0)

    line = script.line_of_rooms([row(0.9, 0.5), row(0.8, 0.5)])
    assert line[0].startswith("mean of 2 demo rooms, 90 views, 1,000 points")
    # Draws of two rooms: both the one, both the other, or one each.
    assert line[1:5] == ("**0.850** (0.800 to 0.900)", "0.400", "0.500", "+0.350 (+0.300 to +0.400)")


def test_photographs_become_a_capture_that_can_be_scored(script, capture, tmp_path):
    folder, space = tmp_path / "photographs", np.array("tiny-test-space")
    bank = np.random.default_rng(0).normal(size=(60, 16))
    np.savez(capture.folder / "word_bank.npz", names=np.arange(60).astype(str), vectors=bank, feature_space=space)
    before = {file: file.read_bytes() for file in capture.folder.rglob("*") if file.is_file()}
    assert script.photograph(capture.folder, folder) > 0
    assert {file: file.read_bytes() for file in capture.folder.rglob("*") if file.is_file()} == before
    assert not (folder / "word_bank.npz").exists()  # it was of another encoder
    scene = og.read_capture(folder)
    assert scene.feature_space != og.read_capture(capture.folder).feature_space
    assert sum(view.mask_count for view in scene.views) > 0
    words = np.load(folder / "text_features.npz")
    assert words["names"].tolist() == list(NAMES)
    assert words["vectors"].shape[1] == scene.feature_width
    assert (folder / "gt.npz").read_bytes() == (capture.folder / "gt.npz").read_bytes()


def test_the_table_of_modes(script, tmp_path):
    table = tmp_path / "modes.csv"
    rows = [
        ("ycb_0050", "auto", 0.9, 1.0, 1.0, 5.0), ("room0", "auto", 0.8, 2.0, 1.0, 5.0),
        ("room1", "auto", 0.6, 4.0, 1.0, 5.0), ("ycb_0050", "paper", 0.2, 60.0, 0.03, 1800.0),
        ("room0", "paper", 0.1, 60.0, 0.03, 1200.0), ("room1", "paper", 0.3, 80.0, 0.03, 2400.0),
    ]  # fmt: skip
    with table.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("capture", "mode", "miou", "own_s", "schedule_share", "published_s"))
        writer.writerows(rows)
    assert cells(script.modes_table(list(csv.DictReader(table.open())))) == [
        ["", "table", "demo rooms"],
        ["---", "---:", "---:"],
        ["`auto`", "0.900, 1.0 s", "0.700, 3.0 s"],
        ["`paper`, 3 % of its steps", "0.200, 60.0 s", "0.200, 70.0 s"],
        ["all of them, extrapolated", "30 min", "30 min"],
    ]


@pytest.mark.parametrize("text", ["", "<!-- results -->", "<!-- end of results --> <!-- results -->"])
def test_a_page_without_its_comments_is_told_of_at_once(script, text, tmp_path, capture):
    page = tmp_path / "page.md"
    page.write_text(text)
    with pytest.raises(ValueError, match="has not '<!-- results -->' and then"):
        script.main([str(capture.folder), "--readme", str(page)])
    assert page.read_text() == text
