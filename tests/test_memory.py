"""Tables that outgrow their memory, and work that is interrupted: the same bits as when all goes well."""

from __future__ import annotations

import mmap
import os
import shutil
import signal
import subprocess
import sys
import time
import weakref
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from commands import error_of
from conftest import TinyCapture
from numpy.typing import NDArray
from scipy.sparse import csr_array, random_array
from test_fit import boxes_on_a_table
from test_grouping import hand_table
from test_membership import groups, on_a_line
from test_visibility import NEAR, camera, cloud, table_of, view_of

import og_pointcloud as og
from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.fitting import mask_table as mask_table_module
from og_pointcloud.fitting import memory as memory_module
from og_pointcloud.fitting import view_votes as votes_module
from og_pointcloud.fitting.fit import fit, prepare
from og_pointcloud.fitting.mask_table import MaskTable
from og_pointcloud.fitting.membership import assign_points
from og_pointcloud.fitting.memory import (
    free_memory,
    in_file,
    memory_in_use,
    memory_left,
    parse_memory,
    scratch_array,
    scratch_like,
)
from og_pointcloud.fitting.view_votes import view_votes
from og_pointcloud.fitting.work_folder import WorkFolder, fingerprint, kept_files
from og_pointcloud.rendering.geometry import neighborhood
from og_pointcloud.rendering.splatting import Gaussians
from og_pointcloud.scene import View
from og_pointcloud.settings import FitSettings, GeometrySettings, MembershipSettings

MATRICES = ("weights", "outside", "exposure")
TIGHT = FitSettings(memory=1)
"""Less than any process holds: the table goes to disk at once."""


@pytest.mark.parametrize(
    ("text", "expected"), [("4GB", 4e9), ("500M", 5e8), ("2.5e9", 2.5e9), ("1 TB", 1e12), ("3GiB", 3e9)]
)
def test_sizes_are_read(text: str, expected: float) -> None:
    assert parse_memory(text) == expected


@pytest.mark.parametrize("text", ["", "4", "much", "-4GB", "4PB", "1.2.3GB", "1e999GB"])
def test_what_is_no_size_is_refused(text: str) -> None:
    with pytest.raises(OgPointcloudError, match="expected a size of at least 64MB, such as 4GB"):
        parse_memory(text)


def test_free_memory_ends_at_the_limit_of_a_container(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "max").write_text("70000000\n")
    (tmp_path / "current").write_text("20000000\n")
    (tmp_path / "none").write_text("max\n")
    folder, entry = str(tmp_path), "inactive_file "
    limits = ((folder, "missing", "missing", entry), (folder, "none", "current", entry))
    monkeypatch.setattr(memory_module, "CGROUPS", limits)
    assert free_memory() > 50_000_000
    monkeypatch.setattr(memory_module, "CGROUPS", (*limits, (folder, "max", "current", entry)))
    assert free_memory() == 50_000_000
    # Files that the system keeps in memory as long as nobody needs it count as used there.
    (tmp_path / "memory.stat").write_text("anon 1000000\ninactive_file 15000000\n")
    assert free_memory() == 65_000_000


def test_memory_in_use_grows_with_an_array() -> None:
    before = memory_in_use()
    held = np.frombuffer(mmap.mmap(-1, 80_000_000), np.uint8)  # new from the system, whatever this process has freed
    held[:] = 1
    assert memory_in_use() - before > 0.9 * held.nbytes


def test_memory_left_is_what_the_limit_leaves_or_half_of_what_is_free() -> None:
    assert memory_left(1) == 0
    assert 0.9 * (4 << 40) < memory_left(4 << 40) < 4 << 40
    assert 0 < memory_left(None) <= free_memory()


def test_scratch_arrays_are_plain_writable_arrays_in_files_that_csr_takes_as_they_are() -> None:
    values = scratch_array(3, np.float32)
    values[:] = [5, 2, 3]
    assert type(values) is np.ndarray
    matrix = csr_array((values, np.array([0, 1, 1], np.int32), np.array([0, 2, 3], np.int32)), shape=(2, 2))
    assert in_file(matrix.data)
    np.testing.assert_array_equal(matrix.toarray(), [[5, 2], [0, 3]])
    assert in_file(scratch_like(values, np.float64))
    assert not in_file(scratch_like(np.zeros(3), np.float64))
    assert scratch_array(0, np.int32).shape == (0,)


def test_a_full_disk_is_one_clear_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch, WorkFolder.open(tmp_path / "work") as work:
        patch.setattr("numpy.lib.format.write_array", full)
        with pytest.raises(OgPointcloudError, match=r"work/a-1.*cannot be written \(No space left.*larger disk"):
            work.arrays("a", "1", lambda: [np.zeros(3)])
    monkeypatch.setattr(memory_module, "_reserve", full)
    with pytest.raises(OgPointcloudError, match=r"no room for 0.0 GB in.*No space left.*TMPDIR"):
        scratch_array(3, np.int32)


# A work folder ---------------------------------------------------------------------------------------------------


class Killed(BaseException):
    """What Ctrl-C raises is no Exception either."""


@contextmanager
def killed_run(folder: Path | None) -> Iterator[WorkFolder]:
    """A run that is killed at the end of the block."""
    with suppress(Killed), WorkFolder.open(folder) as work:
        yield work
        raise Killed


ARRAYS = [
    np.arange(7, dtype=np.float32),
    np.zeros((0, 3), np.int32),
    np.array([[True, False, True]]),
    np.array([(1, 2.5)], [("point", "<i4"), ("value", "<f4")]),
]


def keep(folder: Path, key: str = "1") -> None:
    """A run that makes ARRAYS and is killed."""
    with killed_run(folder) as work:
        work.arrays("view", key, lambda: ARRAYS)


def taken_up(folder: Path, key: str = "1") -> bool:
    """Whether the next run finds the arrays; it gets them whether or not."""
    with WorkFolder.open(folder) as work:
        for read, array in zip(work.arrays("view", key, lambda: ARRAYS), ARRAYS, strict=True):
            assert read.dtype == array.dtype
            np.testing.assert_array_equal(read, array)
        return work.found == 1


def test_what_a_killed_run_made_is_not_made_again(tmp_path: Path) -> None:
    keep(tmp_path / "work")
    assert kept_files(tmp_path / "work", "view") == 1
    assert taken_up(tmp_path / "work")
    assert not (tmp_path / "work").exists()
    keep(tmp_path / "work")
    assert not taken_up(tmp_path / "work", "2")


@pytest.mark.parametrize("damage", ["empty", "cut", "longer", "header", "value", "checksum", "foreign"])
def test_a_damaged_file_is_made_anew(tmp_path: Path, damage: str) -> None:
    keep(tmp_path)
    (file,) = tmp_path.glob("view*")
    content = bytearray(file.read_bytes())
    place = {"header": 20, "value": 140, "checksum": -1}.get(damage)
    if place is not None:
        content[place] ^= 1
    changed = {"empty": b"", "cut": content[:-5], "longer": content + b"0", "foreign": b"no arrays at all"}
    file.write_bytes(changed.get(damage, content))
    assert not taken_up(tmp_path)


def test_a_run_leaves_what_others_put_into_its_folder(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    np.save(tmp_path / "mine.npy", np.zeros(3))
    keep(tmp_path)
    assert taken_up(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine.npy", "notes.txt"]


def test_only_one_run_at_a_time(tmp_path: Path) -> None:
    code = (
        "import sys; from og_pointcloud.fitting.work_folder import WorkFolder\nwith WorkFolder.open(sys.argv[1]): pass"
    )
    other = [sys.executable, "-c", code, str(tmp_path / "work")]
    with WorkFolder.open(tmp_path / "work"):
        refused = subprocess.run(other, capture_output=True, text=True, check=False)
        assert refused.returncode != 0
        assert f"in use by process {os.getpid()}, since" in refused.stderr
        assert "wait for it, or name another folder" in refused.stderr
        with pytest.raises(OgPointcloudError, match="in use by process"), WorkFolder.open(tmp_path / "work"):
            pass
    assert subprocess.run(other, check=False).returncode == 0


def test_a_folder_that_cannot_be_made_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OgPointcloudError, match="cannot be used"), WorkFolder.open(tmp_path / "file" / "work"):
        pass


def test_held_arrays_are_written_when_they_are_many_or_old(tmp_path: Path) -> None:
    folder = tmp_path / "work"
    with killed_run(folder) as work:
        work.hold(2 * ARRAYS[0].nbytes, 1000)
        for number in range(2):
            work.arrays("view", str(number), lambda: [ARRAYS[0]])
        assert kept_files(folder) == 0
        work.arrays("view", "2", lambda: [ARRAYS[0]])
        assert kept_files(folder) == 3
        work.arrays("view", "3", lambda: [ARRAYS[0]])
        assert kept_files(folder) == 4
        work.hold(np.inf, -1)
        work.arrays("view", "4", lambda: [ARRAYS[0]])
        assert kept_files(folder) == 5


def test_a_temporary_folder_goes_in_any_case(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    with killed_run(None) as work:
        assert not list(tmp_path.iterdir())
        work.arrays("view", "1", lambda: [ARRAYS[0]])
        assert len(list(tmp_path.glob("*/view*"))) == 1
    assert not list(tmp_path.iterdir())


def test_fingerprints_tell_arrays_and_numbers_apart() -> None:
    one = np.ones(4, np.float32)
    different = [one, 2 * one, one[:2], one.reshape(2, 2), one.astype(np.int32), 1.0, 1, None, "1", FitSettings()]
    assert len({fingerprint(value) for value in different}) == len(different)
    assert fingerprint(one, 2) == fingerprint(one.copy(), 2) != fingerprint(2, one)


def test_what_other_code_kept_is_not_taken_up(tmp_path: Path) -> None:
    """An upgrade may lay arrays out in another way."""
    package = Path(og.__file__).parent
    shutil.copytree(package, tmp_path / "og_pointcloud", ignore=shutil.ignore_patterns("__pycache__", "demo_encoder"))
    code = "from og_pointcloud.fitting.work_folder import fingerprint; print(fingerprint(1))"

    def answer() -> str:
        environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
        return subprocess.run(
            [sys.executable, "-c", code], env=environment, cwd=tmp_path, capture_output=True, text=True, check=True
        ).stdout

    assert answer().strip() == fingerprint(1)
    with (tmp_path / "og_pointcloud" / "rendering" / "sightings.py").open("a") as file:
        file.write("# newer\n")
    assert answer().strip() != fingerprint(1)


# A table of views ------------------------------------------------------------------------------------------------


def views(count: int = 7) -> list[View]:
    return [view_of(camera(), masks, f"view {index}") for index, masks in enumerate([5, 3, 0, 8, 2, 6, 1][:count])]


@pytest.fixture
def gaussians() -> Gaussians:
    return cloud(np.random.default_rng(0))


@pytest.fixture
def expected(gaussians: Gaussians) -> MaskTable:
    return table_of(gaussians, views())


def assert_same(table: MaskTable, expected: MaskTable) -> None:
    for name in MATRICES:
        actual, right = getattr(table, name), getattr(expected, name)
        assert actual.shape == right.shape
        for part in ("indptr", "indices", "data"):
            np.testing.assert_array_equal(getattr(actual, part), getattr(right, part))
            assert getattr(actual, part).dtype == getattr(right, part).dtype
    for name in ("mask_view", "mask_pixels", "mask_features"):
        np.testing.assert_array_equal(getattr(table, name), getattr(expected, name))


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 1.1])
def test_a_table_on_disk_is_the_table_in_memory(gaussians: Gaussians, expected: MaskTable, share: float) -> None:
    nbytes = sum(getattr(expected, name).nnz for name in MATRICES) * 8
    with WorkFolder.open(None) as work:
        work.hold(share * nbytes, np.inf)
        table = table_of(gaussians, views(), work=work, most_in_memory=share * nbytes)
    for name in MATRICES:
        matrix = getattr(table, name)
        assert in_file(matrix.data) == in_file(matrix.indices) == (share < 1)
    assert_same(table, expected)


def test_two_tables_in_a_temporary_folder_do_not_mix(gaussians: Gaussians, expected: MaskTable) -> None:
    other = gaussians.take(np.arange(len(gaussians))[::-1])
    with WorkFolder.open(None) as work:
        work.hold(0, np.inf)  # all is written
        assert_same(table_of(gaussians, views(), work=work), expected)
        assert_same(table_of(other, views(), work=work), table_of(other, views()))


def test_what_is_not_kept_takes_no_fingerprint(
    gaussians: Gaussians, expected: MaskTable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr("og_pointcloud.fitting.mask_table.fingerprint")
    assert_same(table_of(gaussians, views()), expected)
    with WorkFolder.open(tmp_path / "kept") as work, pytest.raises(NameError):
        table_of(gaussians, views(), work=work)


@pytest.mark.parametrize("held", [False, True])
def test_a_replaced_checkpoint_is_the_one_that_the_next_run_finds(tmp_path: Path, held: bool) -> None:
    with killed_run(tmp_path) as work:
        if held:
            work.hold(1e6, 1e3)
        for step in range(4):
            work.arrays("stage", "1", lambda: [np.zeros(3)])
            work.replace("stage", "1", [np.full(3, step), np.ones(2)])
        assert work.arrays("stage", "1", lambda: [])[0].tolist() == [3, 3, 3]
    assert kept_files(tmp_path) == (0 if held else 1)
    with WorkFolder.open(tmp_path) as work:
        found = [array.tolist() for array in work.arrays("stage", "1", lambda: [np.zeros(3)])]
    assert found == ([[0, 0, 0]] if held else [[3, 3, 3], [1, 1]])


def test_mask_maps_are_let_go_of_view_by_view(gaussians: Gaussians, expected: MaskTable) -> None:
    """Those of hundreds of large photographs would be gigabytes."""
    maps: list[weakref.ref[NDArray[np.int32]]] = []
    held: list[int] = []

    def watched(view: View) -> View:
        def read() -> NDArray[np.int32]:
            held.append(sum(known() is not None for known in maps))
            ids = view.mask_map().copy()
            maps.append(weakref.ref(ids))
            return ids

        return replace(view, masks=read)

    assert_same(table_of(gaussians, map(watched, views()), side_by_side=1), expected)
    assert len(held) == 7
    assert max(held) <= 1


def test_a_short_fit_writes_no_file(tmp_path: Path) -> None:
    with WorkFolder.open(tmp_path / "work") as work:
        prepare(boxes_on_a_table().scene, work=work)
        assert kept_files(tmp_path / "work") == 0
    assert not (tmp_path / "work").exists()


def test_indices_are_of_four_bytes(expected: MaskTable) -> None:
    """Eight would be half as much again of memory."""
    assert {getattr(expected, name).indices.dtype for name in MATRICES} == {np.dtype(np.int32)}


def killed_after(count: int, of: list[View]) -> Iterator[View]:
    yield from of[:count]
    raise Killed


def interrupted(folder: Path, gaussians: Gaussians, after: int = 4) -> int:
    """A table that is killed; how many views it keeps."""
    with pytest.raises(Killed), WorkFolder.open(folder) as work:
        table_of(gaussians, killed_after(after, views()), work=work, side_by_side=1)
    return kept_files(folder)


def resumed(folder: Path, gaussians: Gaussians, of: list[View]) -> MaskTable:
    with WorkFolder.open(folder) as work:
        return table_of(gaussians, of, work=work, side_by_side=1)


def rendered(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Numbers of masks of every view that is rendered from now on."""
    counts: list[int] = []
    plain = mask_table_module.sightings

    def counting(*arguments: object, **options: object) -> object:
        counts.append(arguments[3])  # type: ignore[arg-type]
        return plain(*arguments, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(mask_table_module, "sightings", counting)
    return counts


def test_a_killed_table_goes_on_where_it_was(
    gaussians: Gaussians, expected: MaskTable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert interrupted(tmp_path / "work", gaussians, 2) == 2
    assert interrupted(tmp_path / "work", gaussians, 4) == 4
    counts = rendered(monkeypatch)
    assert_same(resumed(tmp_path / "work", gaussians, views()), expected)
    assert counts == [2, 6, 1]
    assert not (tmp_path / "work").exists()


@pytest.mark.parametrize(("change", "again"), [("pose", 1), ("masks", 1), ("count", 1), ("order", 0), ("fewer", 0)])
def test_only_views_that_changed_are_rendered_again(
    gaussians: Gaussians, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: str, again: int
) -> None:
    interrupted(tmp_path, gaussians, 5)
    changed = views(5)
    if change == "pose":
        pose = np.eye(4)
        pose[2, 3] = 0.1
        changed[1] = replace(changed[1], camera=camera(world_to_camera=pose))
    elif change == "masks":
        ids = changed[1].mask_map().copy()
        ids[3, 3] = (ids[3, 3] + 1) % 3
        changed[1] = replace(changed[1], masks=ids)
    elif change == "count":  # one mask more, without a pixel
        changed[1] = replace(changed[1], mask_features=np.ones((4, 8), np.float32))
    else:
        changed = changed[::-1] if change == "order" else changed[:3]
    counts = rendered(monkeypatch)
    table = resumed(tmp_path, gaussians, changed)
    assert len(counts) == again
    assert_same(table, table_of(gaussians, changed))


@pytest.mark.parametrize("change", ["xyz", "opacity", "near", "thickness"])
def test_views_of_another_geometry_are_not_taken(
    gaussians: Gaussians, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: str
) -> None:
    interrupted(tmp_path, gaussians)
    counts = rendered(monkeypatch)
    if change in ("xyz", "opacity"):
        gaussians = replace(gaussians, **{change: getattr(gaussians, change) * np.float32(0.9)})
    with WorkFolder.open(tmp_path) as work:
        other = {"near": {"near": 2 * NEAR}, "thickness": {"thickness": 0.2}}.get(change, {})
        table_of(gaussians, views(), **other, work=work, side_by_side=1)
    assert len(counts) == 7


# Fits ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_fit_in_little_memory_gives_the_same_bits() -> None:
    scene = boxes_on_a_table().scene
    cloud, tight = fit(scene, progress=False), fit(scene, TIGHT, progress=False)
    assert not cloud.provenance["notes"]["table"]["on_disk"]
    assert tight.provenance["notes"]["table"]["on_disk"]
    assert tight.provenance["notes"]["table"]["views_side_by_side"] == 1
    np.testing.assert_array_equal(tight.instance_ids, cloud.instance_ids)
    np.testing.assert_array_equal(tight.instances.descriptors, cloud.instances.descriptors)


def test_what_follows_from_a_table_on_disk_is_on_disk() -> None:
    table = prepare(boxes_on_a_table().scene, TIGHT).table
    votes = view_votes(table)
    matrices = (table.weights, table.outside, table.exposure, votes.in_mask, votes.vote)
    assert all(in_file(matrix.data) and in_file(matrix.indices) for matrix in matrices)
    assert all(in_file(by_point) for _, by_point in votes.by_point)


def test_points_decided_a_few_at_a_time_are_decided_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    one = np.ones(8, np.float32)
    masks = [[(range(30), one), (range(30, 70), one)], [(range(10, 45), one)], [(range(20), one)], []]
    table = hand_table(100, masks)
    around = neighborhood(on_a_line(100), GeometrySettings())
    exposure = random_array((4, 100), density=0.9, rng=np.random.default_rng(0), format="csr", dtype=np.float32)
    exposure.data += np.float32(0.01)
    table = replace(table, exposure=csr_array(table.exposure.maximum(exposure)))
    arguments = (table, view_votes(table), groups([0, 1, 0, 1]), around, MembershipSettings())
    at_once = assign_points(*arguments)
    monkeypatch.setattr(votes_module, "ENTRIES_AT_ONCE", 40)
    few = assign_points(*arguments)
    np.testing.assert_equal(asdict(few), asdict(at_once))


SLOW_FIT = """
import sys, time
import og_pointcloud as og
from og_pointcloud.fitting import fit, mask_table
plain = mask_table.sightings
def slow(*arguments):
    if arguments[6] is None:  # all points are asked: no trial of a size
        time.sleep(0.5)
    return plain(*arguments)
mask_table.sightings = slow
fit.KEEP_AFTER_S = fit.VIEWS_MEMORY_SHARE = 0
og.fit(og.read_capture(sys.argv[1]), work=sys.argv[2], progress=False)
"""


@pytest.mark.slow
def test_a_fit_killed_in_the_middle_goes_on_and_gives_the_same_bits(tiny_capture: TinyCapture, tmp_path: Path) -> None:
    work = tmp_path / "work"
    process = subprocess.Popen([sys.executable, "-c", SLOW_FIT, str(tiny_capture.folder), str(work)])
    while kept_files(work, "view") < 2 and process.poll() is None:
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    kept = kept_files(work, "view")
    assert 2 <= kept < 6
    scene = og.read_capture(tiny_capture.folder)
    cloud = og.fit(scene, work=work, progress=False)
    assert [entry["count"] for entry in cloud.provenance["left_out"] if entry["key"] == "rendering"] == [kept]
    whole = og.fit(scene, progress=False)
    np.testing.assert_array_equal(cloud.instance_ids, whole.instance_ids)
    np.testing.assert_array_equal(cloud.instances.descriptors, whole.instances.descriptors)
    np.testing.assert_array_equal(cloud.certainty, whole.certainty)
    assert not work.exists()


def test_memory_of_a_fit_is_refused_before_any_work(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = error_of(capsys, "fit", tmp_path, "-o", tmp_path / "a.ogpc", "--memory", "4")
    assert "expected a size of at least 64MB" in said
    with pytest.raises(OgPointcloudError, match="memory is 0; expected a whole number above 0"):
        FitSettings(memory=0)
