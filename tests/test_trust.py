"""What a stranger's file cannot do, what two processes or a full disk cannot break: docs/security.md, held."""

from __future__ import annotations

import errno
import importlib
import itertools
import json
import os
import re
import shutil
import struct
import subprocess
import sys
import threading
import time
import tracemalloc
import zipfile
import zlib
from pathlib import Path

import benchmark_stream
import numpy as np
import pytest
from capture_files import edit_poses
from commands import error_of
from copc_files import attributes_of
from hostile_files import (
    UNBOUNDED_TOKENIZERS,
    UNKNOWN_GRAPHS,
    answers_other_ids,
    encoder_graph,
    encoder_with,
    forged,
    huge_image,
    members_of,
    transforms,
    with_graph,
    zeros_npz,
)
from labelled_clouds import SPACE, WORDS, make_cloud, room, tough_clouds
from og_pointcloud_export import write_bundle
from scenes import write_image, write_tiny_capture
from test_bundle import SCHEMA_2
from text_models import OUT

import og_pointcloud as og
from og_pointcloud.bundle.known_graph import KNOWN_GRAPHS, query_graph_digest
from og_pointcloud.bundle.vocabulary import add_words
from og_pointcloud.cli import main
from og_pointcloud.cloud import TOO_FAR, Vocabulary
from og_pointcloud.errors import BundleError, FeatureSpaceError, OgPointcloudError, SceneError
from og_pointcloud.fitting.memory import memory_in_use
from og_pointcloud.formats.atomic import changing, locked, replacing, replacing_folder, write_file, write_json
from og_pointcloud.formats.images import image_size, read_rgb
from og_pointcloud.formats.las import write_las
from og_pointcloud.formats.nerfstudio import read_transforms
from og_pointcloud.formats.npy import npy_bytes, read_npz
from og_pointcloud.formats.points import read_points
from og_pointcloud.formats.poses import numbered_images, read_numbers
from og_pointcloud.formats.structure_from_motion import find_poses
from og_pointcloud.mapping.map_journal import MAGIC, RECORD_HEADER, MapJournal, packed
from og_pointcloud.masking.make_masks import MaskSettings, make_masks
from og_pointcloud.models import hub_cache
from og_pointcloud.text.encoder import TextEncoder, check_templates

ROOT = Path(__file__).resolve().parents[1]
ESCAPE = "\x1b]0;owned\x07\x1b[2J"
UNBREAKABLE = "1\u00a0kg"


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    return write_bundle(room(500), tmp_path_factory.mktemp("trust") / "room.ogpc")


# A .ogpc is data ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("file", ["new", SCHEMA_2], ids=["new", "old"])
@pytest.mark.parametrize("change", UNKNOWN_GRAPHS, ids=lambda change: change.__name__)
def test_no_graph_but_ours_reaches_a_runtime(bundle, tmp_path, monkeypatch, change, file):
    if file is SCHEMA_2 and change.__name__ in ("divides_by_zero", "names_another_output"):
        pytest.skip("the older graph has other numbers there")
    hostile = with_graph(bundle if file == "new" else file, tmp_path / "s.ogpc", change)
    monkeypatch.setattr("og_pointcloud.ask.query_graph.open_session", None)
    with pytest.raises(BundleError, match=r"query\.onnx.*do not trust the file"):
        og.load(hostile)


def test_graphs_of_all_libraries_that_wrote_this_schema_are_known():
    digests = {query_graph_digest(members_of(path)["query.onnx"]) for path in (SCHEMA_2,)}
    assert digests < KNOWN_GRAPHS
    assert len(KNOWN_GRAPHS) >= 6, "older files must still open"


@pytest.mark.parametrize("part", ["values", "code", "counts"])
def test_a_graph_with_other_descriptors_than_the_file_says(bundle, tmp_path, part):
    def edit(manifest):
        if part == "values":
            manifest["descriptors"]["offset"] -= 4

    owners = room(500).instances.descriptor_instance
    changes = {"arrays/instances/descriptor_instance.npy": npy_bytes(owners[::-1].copy())} if part == "code" else {}
    if part == "counts":
        one_less = {"arrays/xyz.npy": npy_bytes(room(500).xyz)}
        forged(bundle, tmp_path / "s.ogpc", one_less, lambda manifest: manifest["counts"].update(instances=8))
    else:
        forged(bundle, tmp_path / "s.ogpc", changes, edit)
    with pytest.raises(BundleError, match=r"other instances or descriptors|expected <[if]4 \(8,\)"):
        og.load(tmp_path / "s.ogpc")


@pytest.mark.parametrize("lie", ["ids", "points", "one instance"])
def test_a_graph_that_contradicts_the_arrays_is_found_out_on_opening(bundle, tmp_path, lie):
    cloud, path = room(500), tmp_path / "s.ogpc"
    if lie == "ids":
        with_graph(bundle, path, answers_other_ids)
    elif lie == "points":
        forged(bundle, path, {"arrays/xyz.npy": npy_bytes(cloud.xyz[::-1].copy())})
    else:
        ids = np.where(cloud.instance_ids == 4, -1, cloud.instance_ids).astype(np.int8)
        points = np.where(np.arange(9) == 4, 0, cloud.counted_points).astype(np.int32)
        forged(
            bundle, path, {"arrays/instance_ids.npy": npy_bytes(ids), "arrays/instances/points.npy": npy_bytes(points)}
        )
    scene = og.load(path)  # the arrays may be looked at, as by `info`
    with pytest.raises(BundleError, match="contradicts the file's own points and ids"):
        og.segment([[0.5, 0.5, 0]], scene=scene)


@pytest.mark.filterwarnings("ignore:none of", "ignore:no point")
def test_whatever_is_drawn_no_honest_file_is_refused(tmp_path):
    clouds = tough_clouds()
    for name in ("coincident points of different ids", "all points in one place", "far outliers", "a lattice"):
        path = write_bundle(clouds[name], tmp_path / "s.ogpc")
        for _ in range(3):
            assert len(og.load(path).instances_at(np.zeros((1, 3)))) == 1, name


def test_a_manifest_is_bounded_before_it_is_read(bundle, tmp_path):
    lists = b'{"format":"ogpc","schema_version":2,"x":[' + b"[]," * 800_000 + b"[]]}"
    path = forged(bundle, tmp_path / "s.ogpc", {})
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("manifest.json", lists)
    tracemalloc.start()
    with pytest.raises(BundleError, match=r"manifest\.json has .* bytes; expected at most"):
        og.load(path)
    assert tracemalloc.get_traced_memory()[1] < 4 * len(lists)
    tracemalloc.stop()


@pytest.mark.parametrize(
    "frame", [{"spacing": 5e-324}, {"reach": 1e300}, {"origin": [1e30, 0, 0]}], ids=lambda frame: next(iter(frame))
)
def test_lengths_whose_squares_are_no_numbers(bundle, tmp_path, frame):
    with pytest.raises(BundleError, match=r"expected (a positive length, 1e-30 to|finite numbers up to 1e\+15)"):
        og.load(forged(bundle, tmp_path / "s.ogpc", {}, lambda manifest: manifest["frame"].update(frame)))


@pytest.mark.parametrize("name", ["\ud800x", "x" * 1001, "\u2028"])
def test_names_that_are_none(bundle, tmp_path, name):
    names = json.dumps([name, *WORDS[1:]]).encode()
    with pytest.raises(BundleError, match=r"expected whole ones, at most 1000|is not a list of 5 different words"):
        og.load(forged(bundle, tmp_path / "s.ogpc", {"vocabulary/names.json": names}))


# Text encoders --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", UNBOUNDED_TOKENIZERS)
def test_tokenizers_that_would_grow_without_end(case):
    tokenizer, says = UNBOUNDED_TOKENIZERS[case]
    with pytest.raises(OgPointcloudError) as caught:
        TextEncoder(encoder_with(tokenizer), "evil")
    assert says in str(caught.value)


@pytest.mark.parametrize("templates", [[f"{{}}{k}" for k in range(60_000)], ["{}" * 300_000]])
def test_templates_are_few_and_short(templates):
    with pytest.raises(OgPointcloudError, match="expected at most 128 of 400"):
        TextEncoder(encoder_with(templates=templates), "evil")
    assert len(check_templates(["a photo of a {}."] * 80)) == 80  # as CLIP was published


def test_a_long_word_is_cut_before_templates_repeat_it():
    encoder = TextEncoder(encoder_with(templates=["{}" * 150]), "long")
    tracemalloc.start()
    encoder(["low" * 1_000_000])
    assert tracemalloc.get_traced_memory()[1] < 3 << 23
    tracemalloc.stop()


def test_what_an_encoder_computes_is_bounded_in_memory():
    encoder = TextEncoder(encoder_with(graph=encoder_graph(OUT, "outer")), "evil")
    with pytest.raises(OgPointcloudError, match=r"evil: text_encoder\.onnx does not run"):
        encoder(["cat"])  # 4 GiB


def test_what_an_encoder_computes_is_bounded_in_time(monkeypatch):
    monkeypatch.setattr("og_pointcloud.models.MAX_RUN_S", 0.2)
    encoder = TextEncoder(encoder_with(graph=encoder_graph(OUT, "long")), "evil")
    with pytest.raises(OgPointcloudError, match=r"does not run \(TimeoutError\)"):
        encoder(["cat"])


def test_a_carried_encoder_of_another_space_answers_nothing(tmp_path):
    files = encoder_with(feature_space="other/space", width=OUT)
    path = write_bundle(room(100), tmp_path / "s.ogpc")
    path = forged(path, path, {f"text_encoder/{name}": data for name, data in files.items()})
    with pytest.raises(FeatureSpaceError, match=f"has feature space 'other/space', the scene has '{SPACE}'"):
        og.segment(path, ["low"])


# Files of captures ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["jpg", "bmp", "webp", "tif", "png"])
def test_sizes_come_from_headers_and_are_bounded(tmp_path, kind):
    cv2 = pytest.importorskip("cv2")
    small, large = tmp_path / f"small.{kind}", tmp_path / f"large.{kind}"
    cv2.imwrite(str(small), np.zeros((31, 57, 3), np.uint8))
    assert image_size(small) == (57, 31)
    if kind != "webp":  # of which a header alone is no file
        large.write_bytes(huge_image(kind, 12_000, 8_000))
        assert image_size(large) == (12_000, 8_000), "no warning of Pillow's, whose bound is smaller"
    large.write_bytes(huge_image(kind))
    for read in (image_size, lambda file: read_rgb(file, (60_000, 17_000))):
        with pytest.raises(SceneError, match=r"(60000x17000|1020000000) pixels.*; expected at most .*: scale it down"):
            read(large)


def test_a_small_file_does_not_unpack_to_a_large_one(tmp_path):
    for rows, refused in ((30_000_000, True), (1_000_000, False)):
        (tmp_path / "f.npz").write_bytes(zeros_npz(rows))
        if refused:
            with pytest.raises(SceneError, match="made to fill memory"):
                read_npz(tmp_path / "f.npz", ["view0"], (), 1 << 32, "")
        else:
            assert len(read_npz(tmp_path / "f.npz", ["view0"], (), 1 << 32, "")["view0"]) == rows


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (transforms(transform_matrix=[[10**400] * 4] * 4), "expected 4 rows of 4 numbers"),
        (b" " * (1 << 26) + transforms(), "expected at most 67108864: split it"),
    ],
)
def test_pose_files_that_are_none(tmp_path, content, says):
    (tmp_path / "transforms.json").write_bytes(content)
    with pytest.raises(SceneError, match=says):
        read_transforms(tmp_path / "transforms.json", lambda _: (48, 36))


def test_a_pose_file_with_a_mark_before_it(tmp_path):
    (tmp_path / "transforms.json").write_bytes(b"\xef\xbb\xbf" + transforms())
    assert len(read_transforms(tmp_path / "transforms.json", lambda _: (48, 36)).images) == 1


def test_a_name_too_long_for_any_file_is_a_missing_image(tiny_capture):
    edit_poses(tiny_capture.folder, lambda content: content["frames"][0].update(file_path="i" * 300 + "/view0.png"))
    with pytest.warns(UserWarning, match=r"1 of 6 images are listed but not found, e\.g\. 'i{77}\.\.\.'"):
        assert len(og.read_capture(tiny_capture.folder).views) == 6


@pytest.mark.parametrize("scale", [0.0, -1e-4, float("nan")])
def test_a_las_file_whose_scales_collapse_or_mirror_it(tmp_path, scale):
    pytest.importorskip("laspy")
    write_las(tmp_path / "a.las", np.eye(9)[:, :3], np.zeros((9, 3), np.uint8), attributes_of([0] * 9), ("chair",))
    data = bytearray((tmp_path / "a.las").read_bytes())
    data[131:155] = struct.pack("<3d", scale, 1e-3, 1e-3)
    (tmp_path / "a.las").write_bytes(data)
    with pytest.raises(SceneError, match=r"its scale factors are .*; expected 3 numbers above 0"):
        read_points(tmp_path / "a.las")


@pytest.mark.filterwarnings("ignore:none of")
def test_a_focal_length_of_next_to_nothing():
    with pytest.raises(SceneError, match="fx and fy at least 1e-06 of the image's sides"):
        og.Camera(640, 480, 1e-300, 1e-300, 320.0, 240.0, np.eye(4))


def test_what_is_masked_in_an_array_of_points_has_no_label(bundle):
    points = np.ma.array(room(500).xyz[:4].astype(np.float64), mask=[[k < 2] * 3 for k in range(4)])
    masked, plain = (og.segment(given, ["apple"], bundle) for given in (points, points.data))
    assert (masked.instances[:2] == TOO_FAR).all()
    np.testing.assert_array_equal(masked.instances[2:], plain.instances[2:])


# Foreign text ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def rude(bundle, tmp_path_factory):
    """A file whose every text would write to the terminal's title and clear it."""

    def edit(manifest):
        manifest.update(written_by=ESCAPE * 1000, feature_space=f"{ESCAPE}'; touch OWNED; '")
        note = {"what": ESCAPE, "why": ESCAPE * 1000}
        stages = [{"name": ESCAPE, "seconds": 1.0}]
        manifest["provenance"].update(warnings=[ESCAPE * 1000], stages=stages, left_out=[note])

    names = ["=cmd|' /C calc'!A0", f"{ESCAPE}red", "chair\u202etxt", "A" * 1000, UNBREAKABLE]
    changes = {"vocabulary/names.json": json.dumps(names).encode()}
    return forged(bundle, tmp_path_factory.mktemp("rude") / "s.ogpc", changes, edit)


@pytest.mark.parametrize(
    "command", [["info"], ["info", "--json"], ["instances"], ["segment"], ["segment", "--labels", "foo"]], ids=" ".join
)
def test_nothing_in_a_file_reaches_the_terminal_as_it_is(rude, capsys, command):
    main([*command, str(rude)] if "--labels" not in command else ["segment", str(rude), *command[1:]])
    said = capsys.readouterr()
    for text in (said.out, said.err):
        assert all(line.isprintable() for line in text.split("\n"))
    assert len(said.out) < 20_000 or command[-1] == "--json"
    assert "\\x1b" in said.out + said.err or command == ["instances"] or "u001b" in said.out
    if command[-1] == "--json":
        assert json.loads(said.out)["words"][1] == f"{ESCAPE}red"
    if "--labels" in command:
        assert "touch OWNED; '\"'\"''" in said.err, "the command that is advised quotes what it names"


@pytest.mark.parametrize("command", [["instances", "--words", "5"], ["select", UNBREAKABLE]], ids=" ".join)
def test_json_of_any_name_can_be_read(rude, capsys, command):
    assert main([command[0], str(rude), *command[1:], "--json"]) == 0
    assert json.dumps(UNBREAKABLE) in json.dumps(json.loads(capsys.readouterr().out))


def test_cells_of_tables_are_no_formulas(rude, tmp_path):
    main(["instances", str(rude), "-o", str(tmp_path / "t.csv")])
    text = (tmp_path / "t.csv").read_text()
    assert "'=cmd" in text
    assert ",=cmd" not in text
    assert '"=cmd' not in text


# Files that are written, folders that are worked in -------------------------------------------------------------------


def test_threads_that_write_one_path_leave_one_whole_file(tmp_path):
    path, failed = tmp_path / "f", []

    def write(byte):
        try:
            for _ in range(30):
                with replacing(path) as file:
                    for _ in range(8):
                        file.write(bytes([byte]) * 4096)
                        file.flush()
        except OSError as error:
            failed.append(error)

    threads = [threading.Thread(target=write, args=(byte,)) for byte in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failed == []
    assert len(set(path.read_bytes())) == 1
    assert path.stat().st_size == 8 * 4096
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("kind", ["folder", "pipe", "link to a pipe"])
def test_what_is_no_file_is_not_replaced(tmp_path, kind):
    """Root could replace /dev/null, and nobody would have one any more."""
    path, pipe = tmp_path / "path", tmp_path / "pipe"
    os.mkfifo(pipe)
    {"folder": path.mkdir, "pipe": lambda: pipe.rename(path), "link to a pipe": lambda: path.symlink_to(pipe)}[kind]()
    before = path.lstat()
    with pytest.raises(OgPointcloudError, match=r"'.*path' is a folder or a device; expected the path of a file"):
        write_json(path, {})
    assert path.lstat() == before
    assert not any(tmp_path.glob(".*"))


def test_temporary_names_cannot_be_guessed_and_links_are_not_followed(tmp_path, monkeypatch):
    (tmp_path / "victim").write_text("kept")
    monkeypatch.setattr("secrets.token_hex", lambda _: "00000000")
    (tmp_path / ".f.00000000.tmp").symlink_to(tmp_path / "victim")
    with pytest.raises(FileExistsError), replacing(tmp_path / "f") as file:
        file.write(b"gone")
    assert (tmp_path / "victim").read_text() == "kept"


def test_what_killed_runs_left_is_removed_and_what_others_write_is_not(tmp_path):
    old, young, foreign = tmp_path / ".f[1].1.tmp", tmp_path / ".f[1].2.tmp", tmp_path / ".g.1.tmp"
    for file in (old, young, foreign):
        file.write_bytes(b"half")
    for file in (old, foreign):
        os.utime(file, (0, 0))
    with replacing(tmp_path / "f[1]") as file:
        os.utime(next(path for path in tmp_path.glob(".f*") if path not in (old, young)), (0, 0))
        with replacing(tmp_path / "f[1]") as other:
            other.write(b"other")
        file.write(b"whole")
    assert sorted(path.name for path in tmp_path.iterdir()) == [".f[1].2.tmp", ".g.1.tmp", "f[1]"]
    assert (tmp_path / "f[1]").read_bytes() == b"whole"


@pytest.mark.parametrize("command", ["segment -o s.ply", "view --html s.html"])
def test_a_disk_that_is_full_while_a_command_writes(bundle, tmp_path, capsys, monkeypatch, command):
    resource = pytest.importorskip("resource")
    monkeypatch.chdir(tmp_path)
    name, *rest = command.split()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        assert main([name, str(bundle), *rest]) == 2
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert re.fullmatch(rf"error: '?{rest[1]}'?: File too large; the file was not written.*\n", capsys.readouterr().err)
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_does_not_end_a_lock(tmp_path):
    resource = pytest.importorskip("resource")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, limits[1]))
    try:
        with (
            locked(tmp_path / "work"),
            pytest.raises(OgPointcloudError, match="in use by another process"),
            locked(tmp_path / "work"),
        ):
            pass
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_a_folder_is_whole_or_not_there(tmp_path):
    (tmp_path / ".bag.1.tmp").mkdir()
    (tmp_path / ".bag.1.tmp" / "half").write_text("x")
    with pytest.raises(ZeroDivisionError), replacing_folder(tmp_path / "bag") as folder:
        folder.mkdir(1 // 0)
    assert list(tmp_path.iterdir()) == []
    with replacing_folder(tmp_path / "bag") as folder:
        folder.mkdir()
        (folder / "bag.mcap").write_text("x")
    assert [path.name for path in tmp_path.rglob("*")] == ["bag", "bag.mcap"]


def test_a_folder_moved_aside_by_a_killed_run_comes_back(tmp_path):
    (tmp_path / ".bag.1.tmp" / "bag.before").mkdir(parents=True)
    (tmp_path / ".bag.1.tmp" / "bag.before" / "old").write_text("x")
    with pytest.raises(ZeroDivisionError), replacing_folder(tmp_path / "bag", overwrite=True) as folder:
        folder.mkdir(1 // 0)
    assert [path.name for path in tmp_path.rglob("*")] == ["bag", "old"]


def test_a_private_file_stays_private(tmp_path):
    path = write_json(tmp_path / "a.json", {})
    path.chmod(0o600)
    write_json(path, {"new": 1})
    assert (path.stat().st_mode & 0o777, json.loads(path.read_text())) == (0o600, {"new": 1})


def test_words_added_by_two_at_once(tmp_path, monkeypatch):
    cloud = room(500)
    bundle, before, space = write_bundle(cloud, tmp_path / "room.ogpc"), cloud.vocabulary.names, cloud.feature_space
    word = Vocabulary(("quince",), np.ones_like(cloud.vocabulary.vectors[:1]))
    with changing(bundle), pytest.raises(OgPointcloudError, match="is being changed by another process"):
        add_words(bundle, word, space)
    assert og.load(bundle).cloud.vocabulary.names == before
    # Replaced between opening and locking: the lock would be on a file that nobody else opens.
    real = os.fstat
    with monkeypatch.context() as patch:
        patch.setattr(os, "fstat", lambda number: (write_file(bundle, bundle.read_bytes()), real(number))[1])
        with pytest.raises(OgPointcloudError, match="is being changed by another process"):
            add_words(bundle, word, space)
    add_words(bundle, word, space)
    assert og.load(bundle).cloud.vocabulary.names == (*before, "quince")


def test_masks_twice_at_once(tiny_capture):
    (tiny_capture.folder / "mask_features.npz").unlink()
    shutil.rmtree(tiny_capture.folder / "masks")
    with locked(tiny_capture.folder / "masks.work"), pytest.raises(OgPointcloudError, match="one run at a time"):
        make_masks(tiny_capture.folder, MaskSettings(encoder=None), progress=False)


@pytest.mark.parametrize("name", ["masks", "masks.work"])
def test_nothing_is_written_through_links_of_a_capture(tiny_capture, tmp_path, name):
    (tiny_capture.folder / "mask_features.npz").unlink()
    shutil.rmtree(tiny_capture.folder / "masks")
    (tmp_path / "elsewhere").mkdir()
    (tiny_capture.folder / name).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OgPointcloudError, match="nothing is written through links"):
        make_masks(tiny_capture.folder, MaskSettings(encoder=None), progress=False, overwrite=True)
    assert list((tmp_path / "elsewhere").iterdir()) == []


def test_a_fit_that_cannot_be_written_is_kept(tiny_capture, tmp_path, capsys, monkeypatch):
    from og_pointcloud_export import writer

    def full(path):
        if Path(path).parent == tmp_path / "full":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        return replacing(path)

    monkeypatch.setattr(writer, "replacing", full)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    (tmp_path / "full").mkdir()
    assert main(["fit", str(tiny_capture.folder), "-o", str(tmp_path / "full" / "s.ogpc")]) == 2
    said = capsys.readouterr().err
    assert "cannot be written (No space left on device): the fit was saved as" in said
    assert len(og.load(said.partition("saved as '")[2].partition("'")[0]).instances) > 0


# No path of this machine in a file that travels -----------------------------------------------------------------------


def test_files_that_travel_hold_no_path(tmp_path):
    capture = write_tiny_capture(tmp_path / "SECRET" / "capture")
    words = dict(np.load(capture.folder / "text_features.npz"))
    np.savez(capture.folder / "text_features.npz", **{**words, "feature_space": np.array("another")})
    path = tmp_path / "s.ogpc"
    work = tmp_path / "SECRET" / "work"
    assert main(["fit", str(capture.folder), "-o", str(path), "--work", str(work)]) == 0
    members = members_of(path)
    assert b"text_features.npz has feature space 'another'" in members["manifest.json"]
    assert not any(b"SECRET" in data for data in members.values())


def test_records_of_masks_name_models_without_their_folders(tiny_capture, tmp_path):
    source = tmp_path / "SECRET" / "given"
    source.parent.mkdir()
    (tiny_capture.folder / "masks").rename(source)
    (tiny_capture.folder / "mask_features.npz").unlink()
    make_masks(tiny_capture.folder, MaskSettings(proposer=str(source), encoder=None), progress=False)
    record = (tiny_capture.folder / "masks" / "made.json").read_text()
    assert json.loads(record)["proposer"] == "given"
    assert "SECRET" not in record


def test_a_dataset_names_its_scene_without_its_folder_and_opens_no_other(bundle, tmp_path, monkeypatch):
    pv = pytest.importorskip("pyvista")
    from og_pointcloud_pyvista.files import read_ogpc

    from og_pointcloud.ask.hosts import SCENE_FIELD, carried_scene

    mesh = read_ogpc(bundle)
    field = str(mesh.field_data[SCENE_FIELD][0])
    assert "/" not in field
    assert carried_scene(mesh) == bundle.resolve()
    stranger = pv.PolyData(np.zeros((1, 3)))
    opened = []
    monkeypatch.setattr("og_pointcloud.ask.labelled_scene.load", opened.append)
    for name in (str(bundle), "\\\\server\\share\\s.ogpc", "s.ogpc", "../room.ogpc"):
        stranger.field_data[SCENE_FIELD] = [name]
        with pytest.raises(OgPointcloudError, match="was not opened here and is not in this folder"):
            og.segment(stranger, ["apple"])
    assert opened == []
    nothing = pv.PolyData(np.zeros((1, 3)))
    nothing.field_data[SCENE_FIELD] = np.zeros(0)
    assert carried_scene(nothing) is None
    monkeypatch.chdir(bundle.parent)
    assert carried_scene(stranger) == Path(bundle.name)


# Environments ---------------------------------------------------------------------------------------------------------


def test_no_home(monkeypatch, bundle, capsys):
    def fail():
        raise RuntimeError("Could not determine home directory")

    monkeypatch.setattr(Path, "home", fail)
    for name in ("HF_HOME", "HF_HUB_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    assert "not among the 5 known words" in error_of(capsys, "segment", bundle, "--labels", "foo")


@pytest.mark.parametrize(
    ("variables", "folder"),
    [
        ({}, "~/.cache/huggingface/hub"),
        ({"XDG_CACHE_HOME": "/x"}, "/x/huggingface/hub"),
        ({"XDG_CACHE_HOME": "/x", "HF_HOME": "~/hf"}, "~/hf/hub"),
        ({"HF_HOME": "/h", "HUGGINGFACE_HUB_CACHE": "$HOME/old"}, "~/old"),
        ({"HUGGINGFACE_HUB_CACHE": "/old", "HF_HUB_CACHE": "/new"}, "/new"),
    ],
)
def test_fetched_models_lie_where_hugging_faces_tools_put_them(monkeypatch, tmp_path, variables, folder):
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in ("HF_HOME", "HF_HUB_CACHE", "HUGGINGFACE_HUB_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert hub_cache() == Path(folder.replace("~", str(tmp_path)))


def test_no_folder_for_compiled_code(monkeypatch):
    numba = pytest.importorskip("numba")
    from og_pointcloud import kernels

    real = numba.njit

    def without_locator(**options):
        def decorate(function):
            if options.get("cache"):
                raise RuntimeError("cannot cache function: no locator available")
            return real(**options)(function)

        return decorate

    monkeypatch.setattr(kernels.numba, "njit", without_locator)
    assert kernels.njit(cache=True)(lambda value: value + 1)(2) == 3


def program(*arguments, **environment):
    code = "import sys; from og_pointcloud.cli import main; sys.exit(main(sys.argv[1:]))"
    return [sys.executable, "-c", code, *map(str, arguments)], {**os.environ, **environment}


@pytest.mark.parametrize("encoding", ["cp1252", pytest.param("ascii", marks=pytest.mark.slow)])
def test_output_of_few_characters(tmp_path, encoding):
    cloud = make_cloud(np.zeros((1, 3)), [0], words=("café", "日本", "😀"))
    path = write_bundle(cloud, tmp_path / "s.ogpc")
    command, environment = program("info", path, PYTHONIOENCODING=encoding)
    done = subprocess.run(command, env=environment, capture_output=True)
    assert done.returncode == 0, done.stderr
    assert b"\\u65e5\\u672c" in done.stdout


def test_a_reader_that_goes_away(bundle):
    command, environment = program("info", bundle)
    process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    assert process.wait() == 141
    assert process.stderr.read() == b""


def test_nobody_listens(bundle):
    """Standard output is closed, as by a daemon."""
    command, environment = program("info", bundle)
    closed = ["sh", "-c", 'exec "$@" >&-', "sh", *command]
    done = subprocess.run(closed, env=environment, stderr=subprocess.PIPE)
    assert (done.returncode, done.stderr) == (0, b"")


def test_ctrl_c_before_the_work_is_one_line(capsys, monkeypatch):
    def interrupted():
        raise KeyboardInterrupt

    monkeypatch.setattr("og_pointcloud.cli.build_parser", interrupted)
    assert main(["info", "s.ogpc"]) == 130
    assert capsys.readouterr().err.startswith("interrupted: ")


@pytest.mark.skipif(sys.platform == "darwin", reason="names of files are UTF-8 there")
def test_names_of_files_that_are_no_utf8(bundle, tmp_path, capsys):
    scene = tmp_path / os.fsdecode(b"k\xfcche.ogpc")
    shutil.copy(bundle, scene)
    for command in (f"view {scene} --html {tmp_path}/s.html", f"segment {scene} -o {tmp_path}/s.ply", f"info {scene}"):
        assert main(command.split()) == 0, capsys.readouterr().err
    assert "k\\udcfcche" in (tmp_path / "s.html").read_text()
    write_json(tmp_path / "s.json", {"file": str(scene)})
    assert json.loads((tmp_path / "s.json").read_text()) == {"file": str(scene)}
    capsys.readouterr()
    assert main(["index", str(tmp_path), "-o", str(tmp_path / "atlas")]) == 2
    said = capsys.readouterr().err
    assert "k\\udcfcche is left out: its name has bytes that are not UTF-8: rename the file or folder" in said


def test_an_error_nobody_foresaw_is_one_line(bundle, capsys, monkeypatch):
    def fail(*_, **__):
        raise ZeroDivisionError("\x1bdivision\n" + "x" * 10_000)

    monkeypatch.setattr("og_pointcloud.segment", fail)
    assert main(["segment", str(bundle)]) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ZeroDivisionError: \\x1bdivision")
    assert said.count("\n") == 1
    assert len(said) < 500
    with pytest.raises(ZeroDivisionError):
        main(["--debug", "segment", str(bundle)])


WATCHED = """
import sys
def watch(event, arguments):
    if event.split(".")[0] in ("socket", "subprocess") or event in ("os.system", "os.exec", "os.posix_spawn"):
        if event not in ("socket.__new__", "socket.gethostname"):
            raise SystemExit(f"{event} {arguments}")
sys.addaudithook(watch)
from og_pointcloud.cli import main
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.slow
def test_commands_open_no_connection_and_run_no_program(tiny_capture, tmp_path):
    scene = tmp_path / "s.ogpc"
    for command in (
        f"fit {tiny_capture.folder} -o {scene}", f"info {scene}", f"instances {scene}",
        f"segment {scene} -o {tmp_path}/s.ply", f"view {scene} --html {tmp_path}/s.html",
        f"index {tmp_path} -o {tmp_path}/atlas",
    ):  # fmt: skip
        ran = subprocess.run([sys.executable, "-c", WATCHED, *command.split()], capture_output=True, text=True)
        assert ran.returncode == 0, (command, ran.stderr)


# Files that are none, and folders of others -------------------------------------------------------------------------


def test_pipes_and_devices_are_no_files(tmp_path):
    """They never end."""
    os.mkfifo(tmp_path / "1.png")
    os.mkfifo(tmp_path / "poses.txt")
    (tmp_path / "2.TIF").write_bytes(b"")
    assert [file.name for file in numbered_images(tmp_path)] == ["2.TIF"]
    for path in (tmp_path / "poses.txt", Path("/dev/null")):
        with pytest.raises(SceneError, match="is not a file; expected a text file"):
            read_numbers(path, 17)
    og.write_bundle(room(), tmp_path / "scans" / "a.ogpc")
    os.mkfifo(tmp_path / "scans" / "b.ogpc")
    changes = og.Collection.index(tmp_path / "scans", tmp_path / "atlas", progress=False).changes
    assert changes.added == ("a",)
    assert [name for name, _ in changes.left_out] == ["b"]


def test_a_log_of_others_is_left_as_it_is(tmp_path):
    """A torn record at the end of a map's log is cut off; so would be all of a file that is another's."""
    (tmp_path / "frames.log").write_bytes(b"somebody's frames")
    with pytest.raises(OgPointcloudError, match="was not written by this version"):
        list(MapJournal(tmp_path, "nothing").changes())
    assert (tmp_path / "frames.log").read_bytes() == b"somebody's frames"
    (tmp_path / "link").mkdir()
    (tmp_path / "own.log").write_bytes(MAGIC)
    (tmp_path / "link" / "frames.log").symlink_to(tmp_path / "own.log")
    with pytest.raises(OgPointcloudError, match="was not written by this version"):
        list(MapJournal(tmp_path / "link", "nothing").changes())


def test_a_state_that_holds_something_else(tmp_path):
    for value in (3, ("a", "b"), ["a"]):
        data = packed(value)
        (tmp_path / "map.state").write_bytes(RECORD_HEADER.pack(MAGIC, len(data), zlib.crc32(data)) + data)
        with pytest.raises(OgPointcloudError, match="is damaged or of another version: remove the folder"):
            MapJournal(tmp_path, "nothing").state()


def test_links_to_nowhere_are_told_before_the_work(tmp_path):
    for k in range(3):
        write_image(tmp_path / f"photographs/{k}.png", np.zeros((20, 20, 3), np.uint8))
    for name, cause in (("sparse", "sparse already exists"), ("images", "has other images")):
        target = tmp_path / f"with {name}"
        target.mkdir()
        (target / name).symlink_to(tmp_path / "nowhere")
        with pytest.raises(SceneError, match=cause):
            find_poses(tmp_path / "photographs", target)


def test_names_of_files_are_printed_as_text(tmp_path, capsys):
    """Nobody chooses the names of files in a folder that was downloaded."""
    og.write_bundle(room(), tmp_path / "scans" / "a.ogpc")
    (tmp_path / "scans" / f"{ESCAPE}.ogpc").write_text("no scene")
    assert main(["index", str(tmp_path / "scans"), "-o", str(tmp_path / "atlas")]) == 0
    captures = [tmp_path / f"{ESCAPE}{k}" for k in range(2)]
    for capture in captures:
        capture.mkdir()
    assert main(["fit", *map(str, captures), "--out", str(tmp_path / "fitted")]) == 2
    printed = "".join(capsys.readouterr())
    assert printed.count("owned") >= 4
    assert "\x1b" not in printed


# Streams --------------------------------------------------------------------------------------------------------------


def stream(bundle, sizes):
    ask = og.Segmenter(bundle, ["apple", "pear"])
    points = np.tile(room(500).xyz, (200, 1)).astype(np.float64)
    for size in sizes:
        ask(points[:size])


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="only Linux tells")
@pytest.mark.filterwarnings("ignore:none of")
def test_memory_is_flat_over_frames_of_many_sizes(bundle):
    stream(bundle, [1500] * 200)
    before = memory_in_use()
    stream(bundle, range(1, 1501))
    assert memory_in_use() - before < 5 << 20  # 7 kB a size is 10 MB
    tracemalloc.start()
    stream(bundle, range(100, 700))
    assert tracemalloc.get_traced_memory()[0] < 50_000
    tracemalloc.stop()


@pytest.mark.release
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="only Linux tells")
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_soak(bundle):
    """Frames of any size, some with NaN, infinity or none, labels that change: memory ends where it began. For 3,000
    frames; `make soak` takes ten minutes, `examples/benchmark_stream.py` a million frames."""
    end = time.monotonic() + float(os.environ.get("OG_POINTCLOUD_SOAK_S", "0"))
    frames = enumerate(benchmark_stream.stream(og.load(bundle), 10**9, 20_000))
    held = [megabytes for n, megabytes in itertools.takewhile(lambda f: f[0] < 3000 or time.monotonic() < end, frames)]
    print(f"{len(held):,} frames: {held[0]:.1f}, {held[1500]:.1f}, {held[-1]:.1f} MB, {max(held):.1f} at most")
    assert max(held[1500:]) - held[1500] < 6


def test_turns_of_any_length():
    pytest.importorskip("rosbags")
    transforms_ = importlib.import_module("og_pointcloud_ros.transforms")
    turned = transforms_.pose_of((0, 0, 0), (0, 0, 2, 2))
    np.testing.assert_allclose(turned[:3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    for wrong in ((0, 0, 0, 0), (np.nan, 0, 0, 1)):
        with pytest.raises(SceneError, match="expected a finite quaternion that is not zero"):
            transforms_.pose_of((0, 0, 0), wrong)


def test_frames_that_hang_on_thousands_of_others():
    pytest.importorskip("rosbags")
    tree = importlib.import_module("og_pointcloud_ros.transforms").TransformTree()
    for k in range(3000):
        tree.add(f"f{k}", f"f{k + 1}", (0, 0, 1), (0, 0, 0, 1), static=True)
    with pytest.raises(OgPointcloudError, match="has more than 1000 ancestors"):
        tree.lookup("f0", "f3000", 0)
    assert tree.lookup("f0", "f500", 0)[2, 3] == 500
