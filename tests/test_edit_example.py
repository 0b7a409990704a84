"""Example 08: what is removed is gone, what is recolored is red, what is inserted is there, in the files and seen."""

import runpy
import sys
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from labelled_clouds import instance_table, make_cloud
from og_pointcloud_export import write_bundle

import og_pointcloud as og

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "08_edit_a_scene.py"
NAMES = ("sofa", "cushion", "table", "chair")
MIDDLES = np.array([[0, 0, 0.5], [0, 0.9, 0.5], [2, 0, 0.5], [1, 1.6, 0.5]])
COUNT = 500


def things(path):
    """A ball for each name, and a floor."""
    random = np.random.default_rng(0)
    outward = random.normal(size=(len(NAMES) * COUNT, 3))
    balls = np.repeat(MIDDLES, COUNT, axis=0) + 0.3 * outward / np.linalg.norm(outward, axis=1, keepdims=True)
    floor = np.c_[random.random((800, 2)) * [4, 3.6] - 1, np.zeros(800)]
    ids = np.append(np.repeat(np.arange(len(NAMES)), COUNT), np.full(800, -1))
    cloud = make_cloud(np.concatenate([balls, floor]), ids, instances=instance_table(len(NAMES)), words=NAMES)
    return write_bundle(cloud, path)


def near(points, middle):
    return np.linalg.norm(points.xyz_world - middle, axis=1) < 0.32


def test_scene_is_edited_by_words(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["example", str(things(tmp_path / "room.ogpc")), "-o", str(tmp_path)])
    runpy.run_path(str(EXAMPLE), run_name="__main__")
    assert "removed 2 instances, recolored 1" in capsys.readouterr().out
    before, removed, red, inserted = (
        og.read_points(tmp_path / f"{n}.ply") for n in ("before", "removed", "red", "inserted")
    )
    sofa, cushion, table, chair = MIDDLES
    assert near(before, sofa).sum() == COUNT
    assert near(removed, sofa).sum() == near(removed, cushion).sum() == 0
    color = red.rgb[near(red, table)].mean(axis=0)
    assert color[0] > 3 * color[1:].max()
    assert len(red) == len(removed)
    assert len(inserted) - len(red) == COUNT
    assert near(inserted, chair).sum() == COUNT
    assert near(inserted, [0, 0, 0.5]).sum() > 0.9 * COUNT
    sheet = cv2.imread(str(tmp_path / "edited.png")).astype(int)
    panels = [sheet[:480, :640], sheet[:480, 640:], sheet[480:, :640], sheet[480:, 640:]]
    for first, second in pairwise(panels):
        assert (np.abs(first - second).max(axis=2) > 30).sum() > 200
