"""What is logged for the Rerun viewer, read back by its own tools."""

import subprocess
import sys
from contextlib import nullcontext
from importlib.util import find_spec, module_from_spec
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest
from commands import error_of
from labelled_clouds import make_cloud

from og_pointcloud.formats.colors import NO_LABEL, label_colors
from og_pointcloud.scene import NOT_SEEN, Camera, Points, Scene, View


def two_walls():
    """Two walls, left and right; the first view shows the left one, the second both, in front of a hole."""
    yz = np.stack(np.meshgrid(np.arange(0, 1, 0.05), np.arange(0, 1, 0.05)), axis=-1).reshape(-1, 2)
    walls = [np.c_[yz[:, 0] + x, yz[:, 1], np.full(len(yz), 2.0)] for x in (-1.2, 0.2)]
    points = Points.from_world(np.concatenate(walls), rgb=np.full((2 * len(yz), 3), 90, np.uint8))
    views = []
    for index, shown in enumerate(([0], [0, 1], [0, 1])):
        pose = np.eye(4)
        pose[:3, 3] = points.origin + [[2.0, 0, 0], [0, 0, 0], [0.1, 0, 0]][index]
        ids = np.full((60, 80), -1, np.int32)
        camera = Camera(80, 60, 40, 40, 40, 30, pose)
        for wall in shown:
            uv = (np.array(walls[wall]) - points.origin) @ pose[:3, :3].T + pose[:3, 3]
            pixel = np.rint(uv[:, :2] / uv[:, 2:] * 40 + [40, 30]).astype(int)
            inside = ((pixel >= 0) & (pixel < [80, 60])).all(axis=1)
            ids[pixel[inside, 1], pixel[inside, 0]] = shown.index(wall)
        image = np.full((60, 80, 3), 40 * index, np.uint8)
        views.append(View(f"view{index}", camera, ids, np.eye(2, 4, dtype=np.float32)[shown], image=image))
    return Scene(points, tuple(views), "made-up")


def printed(path):
    """Every row of a recording in words, and that the file is whole."""
    tool = Path(sys.executable).with_name("rerun")
    if not tool.exists():
        pytest.skip("rerun's command is not beside Python")
    checked = subprocess.run([tool, "rrd", "verify", path], capture_output=True, text=True, timeout=100)
    assert checked.returncode == 0, checked.stderr
    return subprocess.run([tool, "rrd", "stats", path], capture_output=True, text=True, timeout=100).stdout


class Recording:
    """Stands in for Rerun's: keeps what is logged, by step."""

    def __init__(self):
        self.step, self.logged = None, []

    def set_time(self, timeline, sequence):
        self.step = sequence

    def log(self, path, *what):
        self.logged.append((self.step, path, what))


@pytest.fixture
def fitted():
    pytest.importorskip("rerun")
    capture = two_walls()
    half = len(capture.points.xyz) // 2
    return capture, make_cloud(capture.points.xyz, np.repeat([0, 1], half), origin=capture.points.origin)


def test_an_instance_appears_with_the_first_view_that_shows_it(fitted, monkeypatch, tmp_path):
    from og_pointcloud.show import rerun_file

    recording = Recording()
    monkeypatch.setattr(rerun_file, "rerun_sink", lambda path: nullcontext(rerun_file.RerunSink(recording)))
    rerun_file.write_rerun(tmp_path / "unused.rrd", *fitted)
    _, cloud = fitted
    own = label_colors(np.arange(2)).tolist()
    shown = [(step, what[0]) for step, path, what in recording.logged if path == "world/points"]
    packed = [points.colors.as_arrow_array().to_numpy() for _, points in shown]
    rgb = [np.stack([colors >> 24, colors >> 16 & 255, colors >> 8 & 255], axis=1).tolist() for colors in packed]
    steps = [step for step, _ in shown]
    assert steps == [0, 0, 1], "before the views, at the first, and at the second, which shows one more"
    for colors, expected in zip(rgb, ([NO_LABEL] * 2, [own[0], NO_LABEL], own), strict=True):
        for instance in (0, 1):
            assert {tuple(colors[k]) for k in np.flatnonzero(cloud.instance_ids == instance)} == {
                tuple(expected[instance])
            }
    masks = [what[0] for _, path, what in recording.logged if path == "world/camera/masks"]
    assert len(masks) == 3
    assert [path for _, path, _ in recording.logged].count("world/camera/image") == 3


def test_what_the_lens_did_not_see_is_in_no_mask(monkeypatch):
    rerun = MagicMock()
    monkeypatch.setitem(sys.modules, "rerun", rerun)
    spec = find_spec("og_pointcloud.show.rerun_file")
    module = module_from_spec(spec)  # known to no one else, as it holds the stand-in
    spec.loader.exec_module(module)
    camera = Camera(3, 1, 40, 40, 1.5, 0.5, np.eye(4))
    module.RerunSink(MagicMock()).frame(0, camera, None, np.array([[NOT_SEEN, -1, 0]]))
    assert rerun.SegmentationImage.call_args.args[0].tolist() == [[0, 0, 1]]


def test_the_file_is_whole_and_nothing_else_is_left(fitted, tmp_path):
    from og_pointcloud.show.rerun_file import write_rerun

    path = tmp_path / "new folder" / "walls.rrd"
    write_rerun(path, *fitted)
    stats = printed(path)
    for entity in ("/world/camera/image:", "/world/camera/masks:", "/world/camera:", "/world/points:", "/world/boxes:"):
        assert entity in stats
    assert [file.name for file in path.parent.iterdir()] == ["walls.rrd"]


def test_a_recording_that_fails_leaves_nothing(tmp_path):
    pytest.importorskip("rerun")
    from og_pointcloud.show.rerun_file import rerun_sink

    def begin_and_fail():
        with rerun_sink(tmp_path / "half.rrd") as sink:
            sink.text("begun")
            raise KeyError

    with pytest.raises(KeyError):
        begin_and_fail()
    assert list(tmp_path.iterdir()) == []


def test_without_rerun_the_extra_is_named_before_the_work(tmp_path, capsys, monkeypatch):
    monkeypatch.delitem(sys.modules, "og_pointcloud.show.rerun_file", raising=False)
    monkeypatch.setitem(sys.modules, "rerun", None)
    (tmp_path / "capture").mkdir()
    out = ["-o", str(tmp_path / "a.ogpc"), "--rerun", str(tmp_path / "a.rrd")]
    assert "og-pointcloud[rerun]" in error_of(capsys, "fit", tmp_path / "capture", *out)
