"""Tables that outgrow their memory, and fits that are interrupted: the same bits as when all goes well."""

from __future__ import annotations

import json
import mmap
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import csr_array, random_array
from test_fit import boxes_on_a_table
from test_grouping import hand_table
from test_membership import groups, on_a_line
from test_visibility import NEAR, camera, cloud, view_of

from og_pointcloud.cli import main
from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.fitting import membership
from og_pointcloud.fitting import memory as memory_module
from og_pointcloud.fitting.fit import fit, prepare
from og_pointcloud.fitting.mask_table import Gaussians, MaskTable, mask_table, table_key
from og_pointcloud.fitting.membership import assign_points
from og_pointcloud.fitting.memory import (
    Column,
    free_memory,
    in_file,
    memory_in_use,
    parse_memory,
    scratch_file,
    scratch_like,
)
from og_pointcloud.fitting.table_store import PROGRESS, TableStore, kept_views, remove_work
from og_pointcloud.fitting.view_votes import hear_views
from og_pointcloud.rendering.geometry import neighbourhood
from og_pointcloud.scene import View
from og_pointcloud.settings import FitSettings, GeometrySettings, MembershipSettings, VisibilitySettings

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
    missing = (str(tmp_path / "missing"), str(tmp_path / "missing"))
    limits = (missing, (str(tmp_path / "none"), str(tmp_path / "current")))
    monkeypatch.setattr(memory_module, "CGROUPS", limits)
    assert free_memory() > 50_000_000
    monkeypatch.setattr(memory_module, "CGROUPS", (*limits, (str(tmp_path / "max"), str(tmp_path / "current"))))
    assert free_memory() == 50_000_000


def test_memory_in_use_grows_with_an_array() -> None:
    before = memory_in_use()
    held = np.frombuffer(mmap.mmap(-1, 80_000_000), np.uint8)  # new from the system, whatever this process has freed
    held[:] = 1
    assert memory_in_use() - before > 0.9 * held.nbytes


@pytest.mark.parametrize("moved_after", [0, 3, 10])
def test_a_column_is_its_pieces_wherever_it_lives(moved_after: int) -> None:
    pieces = [np.arange(count, dtype=np.int32) for count in (0, 3, 1000, 0, 7, 1, 100_000, 2)]
    column = Column(np.int32)
    for index, piece in enumerate(pieces):
        if index == moved_after:
            column.move_to(scratch_file())
        column.append(piece)
    assert column.nbytes == 4 * sum(map(len, pieces))
    values = column.array()
    np.testing.assert_array_equal(values, np.concatenate(pieces))
    assert in_file(values) == (moved_after < len(pieces))
    assert in_file(scratch_like(values, np.float64)) == in_file(values)
    assert scratch_like(values, np.float64).shape == values.shape


def test_mapped_arrays_are_plain_writable_arrays_that_csr_takes_as_they_are() -> None:
    column = Column(np.float32)
    column.move_to(scratch_file())
    column.append(np.array([1, 2, 3], np.float32))
    values = column.array()
    assert type(values) is np.ndarray
    values[0] = 5
    matrix = csr_array((values, np.array([0, 1, 1], np.int32), np.array([0, 2, 3], np.int32)), shape=(2, 2))
    assert in_file(matrix.data)
    np.testing.assert_array_equal(matrix.toarray(), [[5, 2], [0, 3]])


# A table of views ------------------------------------------------------------------------------------------------


def views(count: int = 7) -> list[View]:
    return [view_of(camera(), masks, f"view {index}") for index, masks in enumerate([5, 3, 0, 8, 2, 6, 1][:count])]


@pytest.fixture
def gaussians() -> Gaussians:
    return cloud(np.random.default_rng(0))


@pytest.fixture
def expected(gaussians: Gaussians) -> MaskTable:
    return mask_table(gaussians, views(), NEAR)


def assert_same(table: MaskTable, expected: MaskTable) -> None:
    for name in MATRICES:
        actual, right = getattr(table, name), getattr(expected, name)
        assert actual.shape == right.shape
        for part in ("indptr", "indices", "data"):
            np.testing.assert_array_equal(getattr(actual, part), getattr(right, part))
            assert getattr(actual, part).dtype == getattr(right, part).dtype
    for name in ("mask_view", "mask_pixels", "mask_features"):
        np.testing.assert_array_equal(getattr(table, name), getattr(expected, name))


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_a_table_on_disk_is_the_table_in_memory(gaussians: Gaussians, expected: MaskTable, share: float) -> None:
    nbytes = sum(getattr(expected, name).nnz for name in MATRICES) * 8
    store = TableStore(len(gaussians), memory=share * nbytes)
    table = mask_table(gaussians, views(), NEAR, store=store)
    assert store.on_disk
    assert all(in_file(getattr(table, name).data) and in_file(getattr(table, name).indices) for name in MATRICES)
    assert_same(table, expected)


def test_a_table_within_its_memory_touches_no_disk(gaussians: Gaussians, tmp_path: Path) -> None:
    store = TableStore(len(gaussians), folder=tmp_path / "work")
    table = mask_table(gaussians, views(), NEAR, store=store)
    assert not store.on_disk
    assert not any(in_file(getattr(table, name).data) for name in MATRICES)
    assert not (tmp_path / "work").exists()


def test_indices_are_of_four_bytes(expected: MaskTable) -> None:
    """Eight would be half as much again of memory."""
    assert {getattr(expected, name).indices.dtype for name in MATRICES} == {np.dtype(np.int32)}


class Killed(BaseException):
    """What Ctrl-C raises is no Exception either."""


def killed_after(count: int, of: list[View]) -> Iterator[View]:
    yield from of[:count]
    raise Killed


def store_in(folder: Path, gaussians: Gaussians, key: str = "key") -> TableStore:
    return TableStore(len(gaussians), folder=folder, key=key, keep_after_s=-1)


def interrupted(folder: Path, gaussians: Gaussians, after: int = 4) -> int:
    """A table that is killed; how many views it keeps."""
    with pytest.raises(Killed):
        mask_table(gaussians, killed_after(after, views()), NEAR, store=store_in(folder, gaussians), at_once=1)
    return kept_views(folder)


def rendered(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Ids of the masks of every view that is rendered from now on."""
    import og_pointcloud.fitting.mask_table as module

    counts: list[int] = []
    plain = module.view_weights

    def counting(*arguments: object, **options: object) -> object:
        counts.append(arguments[3])  # type: ignore[arg-type]
        return plain(*arguments, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(module, "view_weights", counting)
    return counts


def test_a_killed_table_goes_on_where_it_was(
    gaussians: Gaussians, expected: MaskTable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert interrupted(tmp_path, gaussians) == 4
    counts = rendered(monkeypatch)
    store = store_in(tmp_path, gaussians)
    table = mask_table(gaussians, views(), NEAR, store=store, at_once=1)
    assert_same(table, expected)
    assert counts == [2, 6, 1]
    assert store.resumed == 4
    remove_work(tmp_path)
    assert not tmp_path.exists()
    assert_same(table, expected)  # mapped files outlive their names


def test_a_killed_table_that_was_killed_again(gaussians: Gaussians, expected: MaskTable, tmp_path: Path) -> None:
    assert interrupted(tmp_path, gaussians, 2) == 2
    assert interrupted(tmp_path, gaussians, 5) == 5
    assert_same(mask_table(gaussians, views(), NEAR, store=store_in(tmp_path, gaussians)), expected)


@pytest.mark.parametrize("change", ["pose", "masks", "count", "order"])
def test_views_that_changed_are_rendered_again(
    gaussians: Gaussians, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: str
) -> None:
    interrupted(tmp_path, gaussians)
    changed = views()
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
        changed = [changed[0], *changed[:0:-1]]
    counts = rendered(monkeypatch)
    table = mask_table(gaussians, changed, NEAR, store=store_in(tmp_path, gaussians), at_once=1)
    assert counts == [view.mask_count for view in changed[1:]]
    monkeypatch.undo()
    assert_same(table, mask_table(gaussians, changed, NEAR))


def test_fewer_views_than_were_kept(gaussians: Gaussians, tmp_path: Path) -> None:
    interrupted(tmp_path, gaussians, 5)
    table = mask_table(gaussians, views(3), NEAR, store=store_in(tmp_path, gaussians))
    assert_same(table, mask_table(gaussians, views(3), NEAR))


def test_rows_of_another_geometry_are_not_taken(gaussians: Gaussians, tmp_path: Path) -> None:
    thickness = np.full(len(gaussians), 0.1, np.float32)
    key = table_key(gaussians, NEAR, thickness)
    assert key == table_key(gaussians, NEAR, thickness.copy())
    moved = replace(gaussians, xyz=gaussians.xyz + np.float32(0.01))
    keys = [
        table_key(moved, NEAR, thickness),
        table_key(gaussians, 2 * NEAR, thickness),
        table_key(gaussians, NEAR, 2 * thickness),
        table_key(replace(gaussians, opacity=gaussians.opacity / 2), NEAR, thickness),
    ]
    assert len({key, *keys}) == 5
    interrupted(tmp_path, gaussians)
    store = store_in(tmp_path, moved, key)
    assert store.marks == []
    assert_same(mask_table(moved, views(), NEAR, store=store), mask_table(moved, views(), NEAR))


@pytest.mark.parametrize(
    "damage", ["short", "column out of range", "negative column", "infinite", "lengths", "no json", "no file", "counts"]
)
def test_a_damaged_work_folder_is_started_over(
    gaussians: Gaussians, expected: MaskTable, tmp_path: Path, damage: str
) -> None:
    interrupted(tmp_path, gaussians)
    indices, data, lengths = (tmp_path / f"weights.{part}" for part in ("indices", "data", "lengths"))
    if damage == "short":
        data.write_bytes(data.read_bytes()[:-4])
    elif damage in ("column out of range", "negative column"):
        values = np.fromfile(indices, np.int32)
        values[10] = len(gaussians) if damage == "column out of range" else -1
        values.tofile(indices)
    elif damage == "infinite":
        values = np.fromfile(data, np.float32)
        values[10] = np.inf
        values.tofile(data)
    elif damage == "lengths":
        values = np.fromfile(lengths, np.int32)
        values[2] = -values[2]
        values.tofile(lengths)
    elif damage == "no json":
        (tmp_path / PROGRESS).write_text("{")
    elif damage == "no file":
        indices.unlink()
    else:
        progress = json.loads((tmp_path / PROGRESS).read_text())
        (tmp_path / PROGRESS).write_text(json.dumps({**progress, "masks": ["5"] * 4}))
    store = store_in(tmp_path, gaussians)
    assert store.marks == []
    assert_same(mask_table(gaussians, views(), NEAR, store=store), expected)


def test_a_full_disk_is_one_clear_error(gaussians: Gaussians, monkeypatch: pytest.MonkeyPatch) -> None:
    def full() -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("og_pointcloud.fitting.table_store.scratch_file", full)
    with pytest.raises(OgPointcloudError, match=r"no room for the mask table.*No space left.*larger disk"):
        mask_table(gaussians, views(), NEAR, store=TableStore(len(gaussians), memory=0))


# Stages after the table --------------------------------------------------------------------------------------------


def test_a_fit_in_little_memory_gives_the_same_bits() -> None:
    scene = boxes_on_a_table().scene
    cloud, tight = fit(scene, progress=False), fit(scene, TIGHT, progress=False)
    assert not cloud.provenance["notes"]["table"]["on_disk"]
    assert tight.provenance["notes"]["table"]["on_disk"]
    assert tight.provenance["notes"]["table"]["views_side_by_side"] == 1
    np.testing.assert_array_equal(tight.instance_ids, cloud.instance_ids)
    np.testing.assert_array_equal(tight.instances.descriptors, cloud.instances.descriptors)


def test_what_follows_from_a_table_on_disk_is_on_disk() -> None:
    prepared = prepare(boxes_on_a_table().scene, TIGHT)
    testimony = hear_views(prepared.table)
    matrices = (prepared.table.weights, prepared.table.outside, prepared.table.exposure, *vars(testimony).values())
    assert all(in_file(matrix.data) and in_file(matrix.indices) for matrix in matrices)


def test_points_decided_a_few_at_a_time_are_decided_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    one = np.ones(8, np.float32)
    masks = [[(range(30), one), (range(30, 70), one)], [(range(10, 45), one)], [(range(20), one)], []]
    table = hand_table(100, masks)
    around = neighbourhood(on_a_line(100), GeometrySettings())
    exposure = random_array((4, 100), density=0.9, rng=np.random.default_rng(0), format="csr", dtype=np.float32)
    exposure.data += np.float32(0.01)
    table = replace(table, exposure=csr_array(table.exposure.maximum(exposure)))
    arguments = (table, hear_views(table), groups([0, 1, 0, 1]), around, MembershipSettings())
    at_once = assign_points(*arguments)
    monkeypatch.setattr(membership, "ENTRIES_AT_ONCE", 40)
    few = assign_points(*arguments)
    for name, value in vars(at_once).items():
        np.testing.assert_array_equal(getattr(few, name), value)


def test_a_fit_goes_on_from_its_work_folder_and_removes_it(tmp_path: Path) -> None:
    scene = boxes_on_a_table().scene
    settings = FitSettings(visibility=VisibilitySettings(keep_after_s=-1))
    prepare(scene, settings, work=tmp_path / "work")
    assert kept_views(tmp_path / "work") == len(scene.views)
    cloud = fit(scene, settings, progress=False, work=tmp_path / "work")
    assert any("rendering of 8 views" in entry["what"] for entry in cloud.provenance["left_out"])
    np.testing.assert_array_equal(cloud.instance_ids, fit(scene, progress=False).instance_ids)
    assert not (tmp_path / "work").exists()


def test_removing_a_work_folder_leaves_what_others_put_there(tmp_path: Path, gaussians: Gaussians) -> None:
    interrupted(tmp_path, gaussians)
    (tmp_path / "notes.txt").write_text("mine")
    remove_work(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
    remove_work(tmp_path / "missing")


def test_memory_of_a_fit_is_refused_before_any_work(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(["fit", str(tmp_path), "-o", str(tmp_path / "a.ogpc"), "--memory", "4"])
    assert stopped.value.code == 2
    assert "expected a size of at least 64MB" in capsys.readouterr().err
    with pytest.raises(OgPointcloudError, match="memory is 0 bytes"):
        FitSettings(memory=0)
