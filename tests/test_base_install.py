"""What the base install, numpy and onnxruntime alone, answers; run under every Python by scripts/other_pythons.sh."""

from __future__ import annotations

import io
import json
import warnings
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np
import pytest

import og_pointcloud as og
from og_pointcloud.cli import main
from og_pointcloud.formats.atomic import locked, replacing

SCENE = Path(__file__).parent / "data" / "schema_2.ogpc"
"""Two balls of 100 points, "apple" and "pear", on a floor of 40."""


def test_a_file_answers_words():
    scene = og.load(SCENE)
    result = og.segment(scene.xyz, ["apple", "pear"], scene)
    assert result.counts() == {"apple": 100, "pear": 100}
    assert og.segment(SCENE).labels.tolist() == np.repeat([0, 1, -1], [100, 100, 40]).tolist()
    assert [row.points for row in scene.instances] == [100, 100]
    assert og.pick(scene, scene.xyz[0]).instance == 0


def test_commands(tmp_path):
    out = io.StringIO()
    with redirect_stdout(out):
        assert main(["info", str(SCENE), "--json"]) == 0
    assert json.loads(out.getvalue())["words"] == ["apple", "pear", "chair"]
    assert main(["segment", str(SCENE), "-o", str(tmp_path / "s.ply")]) == 0
    assert og.read_points(tmp_path / "s.ply").xyz.shape == (240, 3)
    assert main(["segment", str(SCENE), "--labels", "mug"]) == 2
    assert main(["info", str(tmp_path / "none.ogpc")]) == 2


def test_streams_take_any_frame():
    ask = og.Segmenter(SCENE, ["apple"])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for count in (0, 1, 7, 240):
            assert len(ask(np.full((count, 3), np.nan)).labels) == count


def test_files_are_whole_and_folders_locked(tmp_path):
    with replacing(tmp_path / "f") as file:
        file.write(b"whole")
    assert [path.name for path in tmp_path.iterdir()] == ["f"]
    with locked(tmp_path / "w"), pytest.raises(og.OgPointcloudError, match="in use by"), locked(tmp_path / "w"):
        pass
