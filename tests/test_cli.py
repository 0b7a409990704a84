"""The commands from end to end on a tiny capture, and what they answer to bad use and bad input."""

import json
import shutil
import subprocess
import sys

import cv2
import numpy as np
import pytest
from commands import error_of, next_command, output_of, run
from scenes import COLORS, NAMES, UNUSED_NAME, sample_surfaces, write_ply, write_tiny_capture
from test_opengaussian import WIDTH as LEAF_WIDTH
from test_opengaussian import write_result

import og_pointcloud as og
from og_pointcloud.ask.labelled_scene import load
from og_pointcloud.ask.segmentation import SAVED_AS
from og_pointcloud.bundle.read import read_bundle
from og_pointcloud.cli import build_parser, common, main
from og_pointcloud.cli import segment as cli_segment
from og_pointcloud.fitting import fit as fit_module
from og_pointcloud.formats.capture import read_capture
from og_pointcloud.formats.spz import write_spz
from og_pointcloud.scene import Points


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """(capture, its .ogpc, what fit printed): fitted once, only read by the tests."""
    folder = tmp_path_factory.mktemp("fitted")
    capture = write_tiny_capture(folder / "capture")
    bundle = folder / "new folder" / "tiny.ogpc"
    assert main(["fit", str(capture.folder), "-o", str(bundle), "--json", str(folder / "run.json")]) == 0
    return capture, bundle


def test_fitted_points_get_their_names(fitted, tmp_path, capsys):
    capture, bundle = fitted
    output = tmp_path / "labels.npz"
    stdout = output_of(capsys, "segment", bundle, "--labels", ",".join(NAMES), "-o", output)
    assert all(name in stdout for name in NAMES)
    result = np.load(output)
    assert result["labels"].dtype == np.int32
    assert list(result["names"]) == list(NAMES)
    assert capture.share_correct(result["labels"], list(result["names"])) > 0.9
    floor = capture.object_ids < 0
    assert (result["labels"][floor] == -1).mean() > 0.8, "only the floor that a ball hides from every view is doubtful"
    assert len(result["scores"]) == len(result["instances"]) == len(capture.object_ids)


def test_without_labels_all_names_of_the_file_are_asked(fitted, tmp_path, capsys):
    capture, bundle = fitted
    output = tmp_path / "labels.npz"
    output_of(capsys, "segment", bundle, "--text-features", capture.text_features, "-o", output)
    assert list(np.load(output)["names"]) == [*NAMES, UNUSED_NAME]


def test_other_points_keep_their_order(fitted, tmp_path, capsys):
    capture, bundle = fitted
    order = np.random.default_rng(1).permutation(len(capture.object_ids))
    xyz, object_ids = sample_surfaces()
    write_ply(tmp_path / "shuffled.ply", xyz[order], COLORS[object_ids][order])
    whole, shuffled = tmp_path / "whole.npz", tmp_path / "shuffled.npz"
    assert run(capsys, "segment", bundle, "-o", whole)[0] == 0
    assert run(capsys, "segment", bundle, "--points", tmp_path / "shuffled.ply", "-o", shuffled)[0] == 0
    assert np.array_equal(np.load(shuffled)["labels"], np.load(whole)["labels"][order])


def test_points_in_a_frame_of_their_own_are_placed_by_a_pose(fitted, tmp_path, capsys):
    _, bundle = fitted
    xyz, object_ids = sample_surfaces()
    pose = np.array([[0.0, -1, 0, 5], [1, 0, 0, -3], [0, 0, 1, 2], [0, 0, 0, 1]])
    write_ply(tmp_path / "scan.ply", (xyz - pose[:3, 3]) @ pose[:3, :3], COLORS[object_ids])
    np.savetxt(tmp_path / "pose.txt", pose)
    asked = "segment", bundle, "--points", tmp_path / "scan.ply", "--pose", tmp_path / "pose.txt"
    stdout = output_of(capsys, *asked, "-o", tmp_path / "placed.ply")
    assert "scan.ply" not in stdout.splitlines()[-1], "view would show the scan where it is not"
    np.testing.assert_allclose(og.read_points(tmp_path / "placed.ply").xyz_world, xyz, atol=1e-5)
    for name, command in (("placed", asked), ("whole", asked[:2])):
        assert run(capsys, *command, "-o", tmp_path / f"{name}.npz")[0] == 0
    assert np.array_equal(np.load(tmp_path / "placed.npz")["labels"], np.load(tmp_path / "whole.npz")["labels"])
    np.savetxt(tmp_path / "pose.txt", pose[:3])
    assert "expected a finite 4x4 matrix" in error_of(capsys, *asked)
    assert "expected the cloud that it places" in error_of(capsys, "segment", bundle, *asked[4:])


def test_what_a_pose_moves_leaves_its_attributes_behind(fitted, tmp_path, capsys):
    xyz, object_ids = sample_surfaces()
    og.segment(xyz, NAMES[:1], fitted[1]).save(tmp_path / "survey.las")
    ones = np.ones((len(xyz), 4), np.float32)
    shape = {"scale": 0.01 * ones[:, :3], "rotation": ones / 2, "opacity": ones[:, 0]}
    write_spz(tmp_path / "splats.spz", Points.from_world(xyz, rgb=COLORS[object_ids], **shape))
    np.savetxt(tmp_path / "pose.txt", np.eye(4))
    for cloud, output, lost in (
        ("survey.las", "o.laz", f"attributes and coordinate system of {tmp_path / 'survey.las'}"),
        ("survey.las", "o.glb", None),
        ("splats.spz", "o.glb", "splats"),
        ("splats.spz", "o.las", None),
    ):
        asked = "segment", fitted[1], "--points", tmp_path / cloud, "-o", tmp_path / output
        said = [line for line in output_of(capsys, *asked).splitlines() if line.startswith("left out")]
        assert not said, "without a pose nothing is"
        stdout = output_of(capsys, *asked, "--pose", tmp_path / "pose.txt")
        (line,) = [line for line in stdout.splitlines() if line.startswith("left out")] or [None]
        assert (line is None) if lost is None else line.startswith(f"left out: {lost}, ")
        report = json.loads(output_of(capsys, *asked, "--pose", tmp_path / "pose.txt", "--json"))
        assert report["left_out"] == (line and line.removeprefix("left out: "))
    asked = "segment", fitted[1], "--points", tmp_path / "splats.spz", "--pose", tmp_path / "pose.txt"
    assert "but --pose moves no splats; expected a .ply" in error_of(capsys, *asked, "-o", tmp_path / "o.spz")


def test_segment_json_counts_every_point(fitted, capsys):
    capture, bundle = fitted
    report = json.loads(output_of(capsys, "segment", bundle, "--json"))
    assert sum(report["counts"].values()) + report["unknown"] == report["points"] == len(capture.object_ids)


def test_fit_reports_its_stages_and_next_command(tiny_capture, tmp_path, capsys):
    bundle, record = tmp_path / "tiny.ogpc", tmp_path / "run.json"
    stdout = output_of(capsys, "fit", tiny_capture.folder, "-o", bundle, "--json", record)
    report = json.loads(record.read_text())
    assert report["points"] == len(tiny_capture.object_ids)
    assert report["points"] == sum(report[f"points_{state}"] for state in ("in_instances", "background", "unobserved"))
    assert report["stages"][0]["name"] == "read capture"
    assert report["seconds"] == pytest.approx(sum(stage["seconds"] for stage in report["stages"]), abs=0.01)
    command = next_command(stdout)
    assert ",".join(NAMES) in command
    assert command[-1].endswith("tiny_labels.ply"), "tiny.ply may be the cloud that was fitted"
    output_of(capsys, *command)


def test_the_next_command_asks_for_what_is_there(tiny_capture, tmp_path, capsys):
    """A list of words may begin with an airplane, and without a bank every instance would be one."""
    file = tiny_capture.folder / "text_features.npz"
    stored = dict(np.load(file))
    unused_first = {name: stored[name][::-1] for name in ("names", "vectors")}
    np.savez(file, **{**stored, **unused_first})
    command = next_command(output_of(capsys, "fit", tiny_capture.folder, "-o", tmp_path / "tiny.ogpc"))
    assert set(command[command.index("--labels") + 1].split(",")) == set(NAMES)


def test_nothing_is_proposed_where_no_point_has_a_label(fitted, tmp_path, capsys):
    write_ply(tmp_path / "far.ply", np.full((5, 3), 500.0), np.zeros((5, 3), np.uint8))
    assert "next: " not in output_of(capsys, "segment", fitted[1], "--points", tmp_path / "far.ply")


def test_without_words_the_next_command_needs_none(tiny_capture, tmp_path, capsys):
    (tiny_capture.folder / "text_features.npz").unlink()
    stdout = output_of(capsys, "fit", tiny_capture.folder, "-o", tmp_path / "tiny.ogpc")
    assert "no words are known yet" in stdout
    output_of(capsys, *next_command(stdout))


def test_a_cut_image_is_one_line(tiny_capture):
    """In a process of its own: OpenCV, which warns too, reads how loud it shall be when it is imported."""
    mask = next(iter((tiny_capture.folder / "masks").iterdir()))
    mask.write_bytes(mask.read_bytes()[:-40])
    command = [sys.executable, "-m", "og_pointcloud", "fit", tiny_capture.folder, "-o", tiny_capture.folder / "a.ogpc"]
    found = subprocess.run(command, capture_output=True, text=True)
    assert found.returncode == 2
    assert found.stderr.startswith("error: ")
    assert len(found.stderr.splitlines()) == 1, found.stderr


def test_what_wrote_a_file_says_what_to_type_next(fitted, tmp_path, capsys, monkeypatch):
    capture, scene = fitted
    monkeypatch.chdir(tmp_path)
    bundle = shutil.copy(scene, tmp_path / "it's.ogpc")
    words, cloud = ("--text-features", capture.text_features), capture.folder / "points.ply"
    others = {**np.load(capture.text_features), "names": ["rouge", "bleu", "lampe"]}
    np.savez(tmp_path / "others.npz", **others)
    others = ("--text-features", tmp_path / "others.npz")
    assert run(capsys, "index", tmp_path, "-o", tmp_path / "atlas")[0] == 0
    for command in (
        ("segment", bundle, *words, "--points", cloud),
        ("segment", bundle, *words, "--labels", "red ball, blue ball", "--points", cloud, "-o", tmp_path / "a.ply"),
        ("view", bundle, *words, "--html", tmp_path / "a.html"),
        ("edit", "extract", bundle, "--word", "red ball", *words, "--cloud", cloud, "-o", tmp_path / "b.ply"),
        ("select", bundle, "rouge", *others),
        ("instances", bundle, *others),
        ("instances", bundle, "-o", tmp_path / "a.csv"),
        ("find", tmp_path / "atlas", "red ball", "--html", tmp_path / "found.html"),
    ):
        proposed = next_command(output_of(capsys, *command))
        assert ("--text-features" in proposed) == ("--text-features" in command)
        output_of(capsys, *proposed)
        if command[0] != "view":
            assert "next: " not in run(capsys, *command, "--json")[1]


def test_info_tells_what_is_inside(fitted, capsys):
    capture, bundle = fitted
    assert "instances" in run(capsys, "info", bundle)[1]
    report = json.loads(run(capsys, "info", bundle, "--json")[1])
    assert report["counts"]["points"] == len(capture.object_ids)
    assert report["words"] == [*NAMES, UNUSED_NAME]


def test_interrupt_leaves_nothing(tiny_capture, tmp_path, capsys, monkeypatch):
    import og_pointcloud_export

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(og_pointcloud_export, "write_bundle", interrupt)
    out = tmp_path / "out"
    out.mkdir()
    code, _, stderr = run(capsys, "fit", tiny_capture.folder, "-o", out / "s.ogpc", "--json", out / "run.json")
    assert code == 130
    assert stderr.splitlines()[-1].startswith("interrupted: unfinished results are not written")
    assert list(out.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ((), "COMMAND"),
        (("fitt",), "did you mean 'fit'"),
        (("fit",), "CAPTURE"),
        (("fit", "capture", "-o", "s.ogpc", "--mask-levle", "large"), "did you mean '--mask-level'"),
        (("fit", "capture", "-o", "s.ogpc", "--mask", "large"), "'og-pointcloud fit' does not accept '--mask'"),
        (("segment", "s.ogpc", "--labels", "chair", "table"), "accept 'table'; several words take commas: --labels ch"),
        (("segment", "s.ogpc", "labels"), "accept 'labels'; did you mean '--labels'?"),
        (("fit", "capture", "-o", "s.ogpc", "--mode", "quick"), "quick"),
        (("fit", "capture", "-o", "s.zip"), "expected a name that ends in .ogpc"),
        (("fit", "capture", "-o", "s.ogpc", "--json", "s.ogpc"), "expected a name that ends in .json"),
        (("segment", "s.ogpc", "-o", "labels.csv"), "ends in .npz or .ply"),
        (("segment", "absent.ogpc"), "is not a file"),
        (("pick", "s.ogpc"), "one of the arguments --xyz --pixel is required"),
        (("pick", "s.ogpc", "--pixel", "3,4"), "--capture CAPTURE --view NAME"),
        (("pick", "s.ogpc", "--xyz", "1,2,3", "-o", "mask.png"), "--capture CAPTURE --view NAME"),
        (("pick", "s.ogpc", "--xyz", "1,2,3", "-o", "mask.jpg"), "ends in .png"),
        (("fit", "capture", "-o", "s.ogpc", "--schedule-share", "0.1"), "--mode grouping, which has no schedule"),
        (("fit", "capture", "-o", "s.ogpc", "--mode", "paper", "--schedule-share", "-1"), "schedule_share is -1"),
        (("import", "absent", "-o", "s.ogpc"), "is not a file; expected an OpenGaussian result folder"),
        (("edit", "remove", "s.ogpc", "--id", "3", "--id", "4", "-o", "o.ply"), "twice; expected once: --id K,L"),
        (("segment", "s.ogpc", "-o", "a.ply", "--output", "b.ply"), "--output is given twice"),
        (("fit", "capture", "-o", "s.ogpc", "--seed", "0", "--seed", "1"), "--seed is given twice"),
        (("fit", "capture", "-o", "s.ogpc", "--mode", "fast", "--mode", "fast"), "twice; expected once ("),
        (("pick", "s.ogpc", "--xyz", "1,2,3", "--view", "a"), "--view is given, but --xyz alone needs no camera"),
        (("compare", "a.ogpc", "b.ogpc", "--up", "z"), "--up is 'z' without --html"),
        (("compare", "a.ogpc", "b.ogpc", "--html", "c.html", "--up", "w"), "--up is 'w'; expected x, y, z, "),
        (("view", "a.ogpc", "--html", "c.html", "--up", "w"), "--up is 'w'; expected x, y, z, "),
        (("serve", "a.ogpc", "--up", "w"), "--up is 'w'; expected x, y, z, "),
        (("import", "house.e57", "-o", "house.ogpc"), "-o is house.ogpc; expected a folder name"),
        (("report", "capture", "--quick", "--knob", "mode"), "not allowed with"),
        (("index", ".", "-o", "."), "-o is '.', which is a folder"),
        (("index", ".", "-o", "atlas.ogpc"), "-o is 'atlas.ogpc'; expected another ending"),
        (("repair", "absent", "--undo"), "absent is not a folder"),
        (("find", "room.ogpc", "chair"), "expected what `og-pointcloud index FOLDER -o ATLAS` wrote: one scene"),
    ],
)  # fmt: skip
def test_bad_use_is_one_line(arguments, text, capsys):
    assert text in error_of(capsys, *arguments)


@pytest.mark.parametrize(
    ("option", "positionals"),
    [
        ("--only", ("repair", "cap", "axes=flipped")), ("--only", ("repair", "cap", "axes=flipped", "world=x,z,-y")),
        ("-o=t.ogpc", ("vocabulary add", "s.ogpc", "words.txt")),
        ("-o=t.ogpc", ("vocabulary bank", "s.ogpc", "bank.npz")),
    ],
)  # fmt: skip
def test_options_stand_anywhere_among_positionals(option, positionals):
    lines = [[*positionals[:at], option, *positionals[at:]] for at in range(1, len(positionals) + 1)]
    for line in lines:
        arguments, unknown = build_parser().parse_known_args(" ".join(line).replace("=t", " t").split())
        assert not unknown
        given = {str(value) for value in vars(arguments).values()} | {*vars(arguments).get("repairs", ())}
        assert {*positionals[1:]} <= given
        assert "True" in given or "t.ogpc" in given


def test_inputs_are_not_overwritten(tiny_capture, capsys):
    folder = tiny_capture.folder
    before = (folder / "transforms.json").read_bytes()
    error = error_of(capsys, "fit", folder, "-o", folder / "s.ogpc", "--json", folder / "transforms.json")
    assert "expected another name" in error
    assert (folder / "transforms.json").read_bytes() == before
    assert not (folder / "s.ogpc").exists()


def test_output_below_a_file_is_refused(tiny_capture, capsys):
    below_file = tiny_capture.folder / "points.ply" / "s.ogpc"
    assert "is not a folder that can be written to" in error_of(capsys, "fit", tiny_capture.folder, "-o", below_file)


def test_a_demo_below_a_file_is_refused_before_its_room_is_made(tmp_path, monkeypatch, capsys):
    demo = pytest.importorskip("og_pointcloud_room.demo")
    monkeypatch.setattr(demo, "make_capture", None)
    (tmp_path / "file").touch()
    assert "is not a folder that can be written to" in error_of(capsys, "demo", "-o", tmp_path / "file" / "demo")


def test_a_demo_leaves_the_captures_of_others(tmp_path, monkeypatch, capsys):
    demo, made = pytest.importorskip("og_pointcloud_room.demo"), []
    monkeypatch.setattr(demo, "run_demo", lambda *given, **options: made.append(given))
    (tmp_path / "transforms.json").touch()  # a capture itself, or one below
    assert "holds other files; expected an empty folder" in error_of(capsys, "demo", "-o", tmp_path)
    assert not made
    (tmp_path / "transforms.json").unlink()
    output_of(capsys, "demo", "-o", tmp_path)
    made.clear()
    (tmp_path / "room.ogpc").touch()
    output_of(capsys, "demo", "-o", tmp_path)
    assert made == [(tmp_path,)], "an earlier demo is made again"
    (tmp_path / "room.ogpc").unlink()
    output_of(capsys, "demo", "-o", tmp_path)
    assert len(made) == 2, "and one that was interrupted"


def turn_cameras_away(folder):
    transforms = json.loads((folder / "transforms.json").read_text())
    for frame in transforms["frames"]:
        pose = np.array(frame["transform_matrix"])
        pose[:3, [0, 2]] *= -1
        frame["transform_matrix"] = pose.tolist()
    (folder / "transforms.json").write_text(json.dumps(transforms))


@pytest.mark.parametrize(
    ("damage", "text"),
    [
        (lambda folder: (folder / "transforms.json").unlink(), "transforms.json"),
        (turn_cameras_away, "no camera sees the cloud"),
    ],
)
def test_damaged_captures_are_named_in_one_line(damage, text, tiny_capture, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(fit_module, "KEEP_AFTER_S", np.inf)  # a slow machine keeps views
    damage(tiny_capture.folder)
    assert text in error_of(capsys, "fit", tiny_capture.folder, "-o", tmp_path / "new" / "s.ogpc")
    assert not (tmp_path / "new").exists()


def test_one_view_is_enough(tmp_path, capsys):
    capture = write_tiny_capture(tmp_path / "capture", view_count=1)
    output = tmp_path / "labels.npz"
    assert run(capsys, "fit", capture.folder, "-o", tmp_path / "s.ogpc")[0] == 0
    assert run(capsys, "segment", tmp_path / "s.ogpc", "-o", output)[0] == 0
    labels = np.load(output)["labels"][capture.object_ids >= 0]
    truth = capture.object_ids[capture.object_ids >= 0]
    assert (labels >= 0).mean() > 0.2, "what the view sees is labelled"
    assert (labels[labels >= 0] == truth[labels >= 0]).mean() > 0.9


def test_vocabulary_of_another_encoder(tiny_capture, tmp_path, capsys):
    """The capture's own is left out and said so; one that was asked for is an error."""
    words = {**np.load(tiny_capture.text_features), "feature_space": np.array("another space")}
    np.savez(tiny_capture.text_features, **words)
    bundle = tmp_path / "s.ogpc"
    stdout = output_of(capsys, "fit", tiny_capture.folder, "-o", bundle)
    assert {0, 1} <= set(load(bundle).instance_ids), "without words there are instances"
    assert "left out: vocabulary" in stdout
    assert "another space" in stdout
    assert json.loads(run(capsys, "info", bundle, "--json")[1])["words"] == []
    for command in (("fit", tiny_capture.folder, "-o", bundle, "--vocabulary"), ("segment", bundle, "--text-features")):
        assert "another space" in error_of(capsys, *command, tiny_capture.text_features)


def test_segment_knows_the_endings_that_results_are_saved_with():
    assert cli_segment.SAVED_AS == SAVED_AS


def test_a_command_out_of_memory_is_one_line(fitted, capsys, monkeypatch):
    def fail(*_, **__):
        raise MemoryError

    monkeypatch.setattr("og_pointcloud.segment", fail)
    assert error_of(capsys, "segment", fitted[1]) == "error: out of memory"


def views_of(capture):
    """(name, the middle of each mask in pixels, the mask map) of every view."""
    scene = read_capture(capture.folder)
    for view in scene.views:
        ids = view.mask_map()
        yield view.name, [np.argwhere(ids == mask).mean(axis=0)[::-1] for mask in range(view.mask_count)], ids


def test_a_pixel_selects_the_ball_it_shows(fitted, tmp_path, capsys):
    capture, bundle = fitted
    cloud = read_bundle(bundle).cloud
    name, middles, ids = next(views_of(capture))
    picked = set()
    for mask, (u, v) in enumerate(middles):
        output = tmp_path / f"{mask}.png"
        click = ("--capture", capture.folder, "--view", name, "--pixel", f"{u},{v}", "-o", output)
        report = json.loads(output_of(capsys, "pick", bundle, *click, "--json"))
        assert report["found"]
        truth = capture.object_ids[cloud.instance_ids == report["instance"]]
        ball = int(capture.object_ids[report["point"]])
        assert (truth == ball).mean() > 0.95
        assert report["words"][0]["name"] == NAMES[ball]
        drawn = cv2.imread(str(output), cv2.IMREAD_GRAYSCALE) == 255
        assert drawn.shape == ids.shape
        assert drawn.sum() == report["mask_pixels"]
        # Points lie 4 px apart: a mask is up to that much fatter than what it shows, and hides as much behind it.
        hidden_by_other = cv2.dilate((ids == 1 - mask).astype(np.uint8), np.ones((11, 11))) > 0
        assert drawn[(ids == mask) & ~hidden_by_other].mean() > 0.99
        assert not drawn[cv2.dilate((ids == mask).astype(np.uint8), np.ones((15, 15))) == 0].any()
        picked.add(ball)
    assert picked == {0, 1}


def test_a_place_selects_the_ball_it_is_on(fitted, capsys):
    _, bundle = fitted
    stdout = output_of(capsys, "pick", bundle, "--xyz", "-0.6,0,1.0")
    assert stdout.startswith("instance ")
    assert "best words: red ball 1.00" in stdout
    assert run(capsys, "pick", bundle, "--xyz", "9,9,9")[1] == "no point of the scene\n"


@pytest.mark.slow
def test_clicks_that_give_no_mask(fitted, tmp_path, capsys):
    capture, bundle = fitted
    click = ("--capture", capture.folder, "--view", "view0", "-o", tmp_path / "mask.png")
    assert "the click hit" in error_of(capsys, "pick", bundle, *click, "--pixel", "1,1")
    assert "expected a pixel" in error_of(capsys, "pick", bundle, *click, "--pixel", "120,1")
    assert "2 numbers" in error_of(capsys, "pick", bundle, *click, "--pixel", "a,b")
    click = ("--capture", capture.folder, "--view", "vew0", "-o", tmp_path / "mask.png")
    assert "did you mean 'view0'" in error_of(capsys, "pick", bundle, *click, "--pixel", "1,1")
    assert list(tmp_path.iterdir()) == []


def test_results_of_opengaussian_can_be_asked(tmp_path, capsys):
    write_result(tmp_path / "run")
    words = tmp_path / "words.npz"
    vectors = np.eye(2, LEAF_WIDTH, dtype=np.float32)
    np.savez(words, names=np.array(["cup", "lid"]), vectors=vectors, feature_space=np.array("their space"))
    bundle = tmp_path / "new" / "run.ogpc"
    arguments = ("import", tmp_path / "run", "-o", bundle, "--feature-space", "their space", "--text-features", words)
    stdout = output_of(capsys, *arguments)
    assert "iteration_90000" in stdout
    assert "in 4 instances" in stdout
    assert "2 of 4 instances have no feature" in stdout
    output_of(capsys, *next_command(stdout))
    output_of(capsys, "info", bundle)
    error = error_of(capsys, *arguments[:5], "another space", *arguments[6:])
    assert "encode them with that encoder" in error
    np.savez(words, names=np.array(["cup"]), vectors=np.ones((1, 3)))
    assert "(dimension 3); expected feature space 'their space' (dimension 8)" in error_of(capsys, *arguments)


def test_import_leaves_nothing_of_a_damaged_result(tmp_path, capsys):
    write_result(tmp_path / "run")
    path = tmp_path / "run" / "cluster_lang.npz"
    path.write_bytes(path.read_bytes()[:500])
    assert "cannot be read" in error_of(capsys, "import", tmp_path / "run", "-o", tmp_path / "new" / "s.ogpc")
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
def test_the_published_schedule_can_be_shortened(tiny_capture, tmp_path, capsys):
    pytest.importorskip("torch")
    record = tmp_path / "run.json"
    shortened = ("--mode", "paper", "--schedule-share", "0.0005", "--json", record)
    assert run(capsys, "fit", tiny_capture.folder, "-o", tmp_path / "s.ogpc", *shortened)[0] == 0
    assert [stage["steps"] for stage in json.loads(record.read_text())["notes"]["training"]] == [10, 10, 10]


@pytest.mark.parametrize("words", [
    "edit remove S.ogpc -o O.ply --xyz -1,0,5", "view S.ogpc --up -z",
    "find ATLAS mug --within -1,-1,0,1,1,2", "instances S.ogpc --up -0.1,0,1", "pick S.ogpc --xyz -1,2,3",
    "pick S.ogpc --xyz -1.5e-05,0,1E+2",
])  # fmt: skip
def test_negative_coordinates_are_values_and_no_options(words):
    arguments = build_parser().parse_args(words.split())
    assert words.split()[-1] in vars(arguments).values()


@pytest.mark.parametrize("names", [["chair"], ["a, b", "c"], ['17" screen', "x"], ["1,5 l", '"', "red mug"]])
def test_names_with_commas_are_read_as_they_are_printed(names):
    assert common.names_in(common.as_option(names)) == names


def test_names_are_parted_by_commas_and_kept_whole_in_quotes():
    assert common.names_in(' chair , "salt, pepper",, 17" screen\n table') == [
        "chair", "salt, pepper", '17" screen', "table",
    ]  # fmt: skip
    assert common.names_in(None) is None
