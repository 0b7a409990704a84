"""Example 10: a map that grows in the demo room, and what it says of the next day."""

import runpy
import sys
from pathlib import Path

import cv2
import pytest

pytest.importorskip("open3d")

import og_pointcloud as og

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "10_second_visit.py"


@pytest.mark.slow
@pytest.mark.release
def test_the_next_day_a_chair_moved_a_vase_left_and_a_ball_came(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", [str(EXAMPLE), "-o", str(tmp_path)])
    runpy.run_path(str(EXAMPLE), run_name="__main__")
    assert "gone: ['vase'], new: ['ball'], moved: ['chair'];" in capsys.readouterr().out
    assert cv2.imread(str(tmp_path / "changes.png")).shape == (640, 1600, 3)
    assert cv2.imread(str(tmp_path / "growing.png")).shape == (320, 1600, 3)
    assert len(og.load(tmp_path / "room.ogpc").cloud.instances) > 30
