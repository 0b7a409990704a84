"""``og-pointcloud masks``: what it writes, what it takes up after a kill, what it refuses, what it survives."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from capture_files import BY_COLOR, HEIGHT, WIDTH, by_color, make_world, write_colmap_text, write_transforms
from commands import error_of, output_of
from PIL import Image, ImageOps
from scenes import write_image, write_ply

from og_pointcloud.cli import main
from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.formats.capture import read_capture
from og_pointcloud.formats.images import EXIF_ORIENTATION, exif_quarter_turns
from og_pointcloud.masking.contracts import Proposals
from og_pointcloud.masking.make_masks import PREVIEW_NAME, WORK_FOLDER, MaskSettings, make_masks
from og_pointcloud.text.encoder import DEMO_ENCODER

ALONE = MaskSettings(encoder=None)
QUICK = MaskSettings(BY_COLOR, encoder=None)
QUICKLY = ["--proposer", BY_COLOR, "--encoder", "none"]


@pytest.fixture(autouse=True)
def _poses_that_are_not_checked(monkeypatch):
    """test_checking does that; the poses here are of nowhere, which takes it longest."""
    monkeypatch.setattr("og_pointcloud.cli.masks.warn_of_poses", lambda _: None)


def scenery(shift=0, size=(HEIGHT, WIDTH)):
    """A picture (BGR) with two things on a ground."""
    height, width = size
    image = np.full((height, width, 3), 120, np.uint8)
    image[height // 4 : height // 2, width // 8 + shift : width // 2 + shift] = (40, 40, 210)
    image[height // 2 + 4 : -4, width // 2 : -8] = (60, 190, 60)
    return image


def make_capture(folder: Path, count=4, encode=None):
    """A capture without masks. encode: image number and BGR picture -> the bytes of its file, None for plain PNG."""
    world = make_world(count=count)
    folder.mkdir(parents=True, exist_ok=True)
    write_transforms(folder, world, ply_file_path="points.ply")
    write_ply(folder / "points.ply", world.xyz, world.rgb)
    (folder / "images").mkdir()
    for k, name in enumerate(world.names):
        data = (encode or plain)(k, scenery(k))
        (folder / "images" / f"{name}.png").write_bytes(data)
    return world


def plain(_, picture):
    return cv2.imencode(".png", picture)[1].tobytes()


def ids_of(folder: Path, name: str):
    return cv2.imread(str(folder / "masks" / f"{name}.png"), cv2.IMREAD_UNCHANGED)


def test_words_are_a_list_like_any_other(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr("og_pointcloud.masking.make_masks.make_masks", lambda *given, **_: asked.append(given) or 1 / 0)
    for line in (["--words", "red chair,lamp", str(tmp_path)], [str(tmp_path), "--encoder", "none"]):
        assert main(["masks", *line]) == 2, "it ends where masks are made"
    assert [folder for folder, *_ in asked] == [tmp_path, tmp_path]
    assert [settings.words for _, settings, _ in asked] == [("red chair", "lamp"), ()]


def test_masks_are_made_again_where_the_encoder_behind_a_path_has_changed(tmp_path):
    make_capture(tmp_path / "c")
    encoder, settings = tmp_path / "encoder", MaskSettings(encoder=str(tmp_path / "encoder"))
    shutil.copytree(DEMO_ENCODER / "image", encoder)

    def made_by(name):
        manifest = json.loads((encoder / "manifest.json").read_text())
        if name != manifest["feature_space"]:
            (encoder / "manifest.json").write_text(json.dumps({**manifest, "feature_space": name}))
        made = make_masks(tmp_path / "c", settings, progress=False)
        return made.feature_space, made.done_before

    assert made_by("first/one") == ("first/one", 0)
    assert made_by("second/one") == ("second/one", 0)
    assert made_by("second/one") == ("second/one", 4)


def test_a_capture_gets_masks_that_can_be_read(tmp_path):
    world = make_capture(tmp_path / "c")
    made = make_masks(tmp_path / "c", ALONE, progress=False)
    scene = read_capture(tmp_path / "c")
    assert made.images == 4
    assert made.done_before == 0
    assert made.masks == sum(view.mask_count for view in scene.views) >= 8
    for k, view in enumerate(scene.views):
        ids = view.mask_map()
        thing = (scenery(k) == (40, 40, 210)).all(axis=2)
        found = ids == np.bincount(ids[thing] + 1).argmax() - 1
        assert (found & thing).sum() / (found | thing).sum() > 0.7  # of 24x12 pixels, a rim of one is a quarter
    assert (tmp_path / "c" / PREVIEW_NAME).stat().st_size > 1000
    assert not (tmp_path / "c" / WORK_FOLDER).exists()
    assert json.loads((tmp_path / "c" / "masks" / "made.json").read_text())["proposer"] == "opencv"
    assert [view.name for view in scene.views] == world.names


def test_the_demo_encoder_gives_the_features(tmp_path):
    make_capture(tmp_path / "c", 2)
    made = make_masks(tmp_path / "c", MaskSettings(), progress=False)
    scene = read_capture(tmp_path / "c")
    assert scene.feature_space == made.feature_space == "og_pointcloud/demo-room-encoder"
    features = np.concatenate([view.mask_features for view in scene.views])
    assert np.allclose(np.linalg.norm(features, axis=1), 1, atol=1e-2)


def test_images_side_by_side_give_the_same_files(tmp_path, monkeypatch):
    world = make_capture(tmp_path / "c")
    for cores, name in ((1, "one"), (3, "three")):
        monkeypatch.setattr(os, "cpu_count", lambda cores=cores: cores)
        make_masks(tmp_path / "c", MaskSettings(), tmp_path / name, progress=False)
    for name in ("mask_features.npz", *(f"masks/{name}.png" for name in world.names)):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "three" / name).read_bytes()


def test_images_that_are_all_done_are_only_assembled(tmp_path, monkeypatch):
    """A run that ended between its last image and `assemble`."""
    world = make_capture(tmp_path / "c")
    make_masks(tmp_path / "c", QUICK, tmp_path / "whole", progress=False)
    with monkeypatch.context() as patch:
        patch.setattr("og_pointcloud.masking.make_masks._assemble", killed)
        with pytest.raises(KeyboardInterrupt):
            make_masks(tmp_path / "c", QUICK, progress=False)
    assert not (tmp_path / "c" / "masks").exists()
    (tmp_path / "c" / PREVIEW_NAME).unlink()  # killed before the preview, or while the record was first written
    (tmp_path / "c" / "masks").mkdir()
    (tmp_path / "c" / "masks" / ".made.json.0123abcd.tmp").write_text("{")
    made = make_masks(tmp_path / "c", QUICK, progress=False)
    assert made.done_before == made.images == 4
    assert (tmp_path / "c" / PREVIEW_NAME).read_bytes() == (tmp_path / "whole" / PREVIEW_NAME).read_bytes()
    for name in world.names:
        assert np.array_equal(ids_of(tmp_path / "c", name), ids_of(tmp_path / "whole", name))


def killed(*_):
    raise KeyboardInterrupt


# Long work -------------------------------------------------------------------------------------------------------

SLOWLY = """
import sys, time
from og_pointcloud.masking import worker as w
from og_pointcloud.masking import make_masks as m
masks_of_level = w.masks_of_level
def slow(*arguments):
    with open(sys.argv[2], "a") as log:
        log.write("x")
    time.sleep(float(sys.argv[3]))
    return masks_of_level(*arguments)
w.masks_of_level = slow
m.make_masks(sys.argv[1], m.MaskSettings(encoder=None))
"""


def run_slowly(capture, log, seconds):
    return subprocess.Popen(
        [sys.executable, "-c", SLOWLY, str(capture), str(log), str(seconds)], stderr=subprocess.PIPE
    )


@pytest.mark.slow
def test_killed_in_the_middle_nothing_is_lost_and_nothing_done_twice(tmp_path):
    world = make_capture(tmp_path / "c", 5)
    make_masks(tmp_path / "c", ALONE, tmp_path / "whole", progress=False)
    process = run_slowly(tmp_path / "c", tmp_path / "log1", 0.25)
    deadline = time.monotonic() + 60
    while len(list((tmp_path / "c").glob(f"{WORK_FOLDER}/*/*.npz"))) < 2 and time.monotonic() < deadline:
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    process.stderr.close()
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "c").glob(f"{WORK_FOLDER}/*/[0-9a-f]*.npz")}
    assert 2 <= len(kept) < 5
    assert not (tmp_path / "c" / "mask_features.npz").exists()
    second = run_slowly(tmp_path / "c", tmp_path / "log2", 0)
    said = second.communicate()[1].decode()
    assert second.returncode == 0, said
    assert len((tmp_path / "log2").read_text()) == 5 - len(kept)
    for name in world.names:
        assert np.array_equal(ids_of(tmp_path / "c", name), ids_of(tmp_path / "whole", name))


def test_masks_that_are_half_replaced_are_without_features(tmp_path, monkeypatch):
    """The old rows would be read with the new masks."""
    world = make_capture(tmp_path / "c", 2)
    make_masks(tmp_path / "c", QUICK, progress=False)
    with monkeypatch.context() as patch:
        patch.setattr("og_pointcloud.masking.make_masks.write_png", killed)
        with pytest.raises(KeyboardInterrupt):
            make_masks(tmp_path / "c", replace(QUICK, level="small"), progress=False)
    with pytest.raises(SceneError, match=r"has masks/ but no mask_features\.npz"):
        read_capture(tmp_path / "c")
    made = make_masks(tmp_path / "c", replace(QUICK, level="small"), progress=False)
    assert (made.done_before, len(read_capture(tmp_path / "c").views)) == (2, len(world.names))


def test_masks_of_faces_are_made_again_for_another_lens(tmp_path):
    capture, sides = tmp_path / "c", {"fl_x": 20.0, "fl_y": 20.0, "w": WIDTH, "h": HEIGHT, "k1": 0.0}
    make_capture(capture, 1)
    poses = json.loads((capture / "transforms.json").read_text())
    for lens, done_before in (
        (sides, 0),
        (sides, None),
        ({**sides, "k1": 0.05}, 0),
        ({**sides, "k1": 0.05, "fl_x": 22.0}, 0),
    ):
        content = {**poses, **lens, "camera_model": "OPENCV_FISHEYE"}
        (capture / "transforms.json").write_text(json.dumps(content))
        made = make_masks(capture, QUICK, progress=False)
        assert made.images > 1
        assert made.done_before == (made.images if done_before is None else done_before)


@pytest.mark.parametrize("name", ["file", "allow_pickle", "args", "kwds"])
def test_images_may_have_any_name(tmp_path, name):
    world = make_capture(tmp_path / "c", 2)
    rename_image(tmp_path / "c", world.names[1], name)
    make_masks(tmp_path / "c", QUICK, progress=False)
    assert [view.name for view in read_capture(tmp_path / "c").views] == [world.names[0], name]


def test_an_image_called_as_the_encoders_name_is_refused(tmp_path):
    world = make_capture(tmp_path / "c", 2)
    rename_image(tmp_path / "c", world.names[1], "feature_space")
    with pytest.raises(OgPointcloudError, match=r"feature_space\.png has the name by which mask_features\.npz"):
        make_masks(tmp_path / "c", QUICK, progress=False)
    assert not (tmp_path / "c" / WORK_FOLDER).exists()


def rename_image(capture: Path, old: str, new: str):
    (capture / "images" / f"{old}.png").rename(capture / "images" / f"{new}.png")
    poses = capture / "transforms.json"
    poses.write_text(poses.read_text().replace(f"images/{old}.png", f"images/{new}.png"))


def test_links_to_a_capture_that_was_moved_are_made_again(tmp_path):
    make_capture(tmp_path / "before", 2)
    make_masks(tmp_path / "before", replace(QUICK, every=2), tmp_path / "half", progress=False)
    (tmp_path / "before").rename(tmp_path / "after")
    make_masks(tmp_path / "after", replace(QUICK, every=2), tmp_path / "half", progress=False)
    assert len(read_capture(tmp_path / "half").points) == 50


def test_other_settings_and_other_images_are_done_anew(tmp_path):
    world = make_capture(tmp_path / "c", 2)
    broken = tmp_path / "c" / "images" / f"{world.names[1]}.png"
    good = broken.read_bytes()
    broken.write_bytes(good[: len(good) // 2])
    with pytest.raises(SceneError, match="1 of 2 images cannot be used"):
        make_masks(tmp_path / "c", ALONE, progress=False)
    first = next((tmp_path / "c" / "images").glob(f"{world.names[0]}*"))
    first.write_bytes(plain(0, scenery(9)))
    os.utime(first, ns=(1, 1))
    broken.write_bytes(good)
    made = make_masks(tmp_path / "c", ALONE, progress=False)
    assert made.done_before == 0
    ids = ids_of(tmp_path / "c", world.names[0])
    thing = (scenery(9) == (40, 40, 210)).all(axis=2)
    assert (ids == np.bincount(ids[thing]).argmax())[thing].mean() > 0.7


def test_masks_of_others_are_not_overwritten(tmp_path, capsys):
    world = make_capture(tmp_path / "c", 2)
    (tmp_path / "c" / "masks").mkdir()
    theirs = tmp_path / "c" / "masks" / f"{world.names[0]}.png"
    theirs.write_bytes(b"mine")
    assert "was not made by this command" in error_of(capsys, "masks", tmp_path / "c", *QUICKLY)
    assert theirs.read_bytes() == b"mine"
    assert main(["masks", str(tmp_path / "c"), *QUICKLY, "--overwrite"]) == 0
    out = output_of(capsys, "masks", tmp_path / "c", *QUICKLY, "--level", "small")
    assert "next: og-pointcloud fit" in out


def test_the_demo_encoder_is_not_taken_without_a_word(tmp_path, capsys):
    make_capture(tmp_path / "c", 1)
    assert main(["masks", str(tmp_path / "c")]) == 0
    assert "knows only the demo room's furniture" in capsys.readouterr().err
    assert main(["masks", str(tmp_path / "c"), *QUICKLY]) == 0
    assert "demo room" not in capsys.readouterr().err


def test_masks_of_nothing_are_not_handed_to_fit(tmp_path, capsys):
    make_capture(tmp_path / "c", 2)
    (tmp_path / "ids").mkdir()
    for name in ("frame_00", "frame_01"):
        cv2.imwrite(str(tmp_path / "ids" / f"{name}.png"), np.zeros((HEIGHT, WIDTH), np.uint8))
    assert main(["masks", str(tmp_path / "c"), "--proposer", str(tmp_path / "ids"), "--encoder", "none"]) == 0
    out, err = capsys.readouterr()
    assert "0 masks in 2 images" in out
    assert "next" not in out
    assert "found nothing in any image" in err


def test_a_run_that_finds_all_done_does_nothing(tmp_path, capsys):
    make_capture(tmp_path / "c", 3)
    command = ["masks", str(tmp_path / "c"), *QUICKLY]
    assert main(command) == 0
    first = capsys.readouterr()
    state = {file: file.stat().st_mtime_ns for file in sorted((tmp_path / "c").rglob("*")) if file.is_file()}
    assert main(command) == 0
    second = capsys.readouterr()
    told, counts = second.out.split("\n", 1)
    assert told.startswith("all 3 images already have these masks: nothing to do")
    assert counts.split(" (")[0] == first.out.split(" (")[0]  # so many masks in so many images
    assert {file: file.stat().st_mtime_ns for file in sorted((tmp_path / "c").rglob("*")) if file.is_file()} == state


@pytest.mark.parametrize("change", ["--overwrite", "--level", "image", "mask", "features", "record", "made.json"])
def test_what_changed_is_made_again(tmp_path, capsys, change):
    world = make_capture(tmp_path / "c", 3)
    masks = tmp_path / "c" / "masks"
    command = ["masks", str(tmp_path / "c"), *QUICKLY]
    assert main(command) == 0
    before = {name: ids_of(tmp_path / "c", name) for name in world.names}
    if change.startswith("--"):
        command += [change] if change == "--overwrite" else [change, "large"]
    elif change == "image":
        os.utime(tmp_path / "c" / "images" / f"{world.names[1]}.png", ns=(1, 1))
    elif change == "mask":
        (masks / f"{world.names[1]}.png").unlink()
    elif change == "features":
        (tmp_path / "c" / "mask_features.npz").unlink()
    elif change == "record":  # killed while the files were put in place
        made = json.loads((masks / "made.json").read_text())
        del made["key"]
        (masks / "made.json").write_text(json.dumps(made))
    else:
        (masks / "made.json").write_text("{")
    capsys.readouterr()
    assert main(command) == 0
    assert "nothing to do" not in capsys.readouterr().out
    if change != "--level":
        assert all(np.array_equal(ids, ids_of(tmp_path / "c", name)) for name, ids in before.items())


def test_other_masks_in_the_folder_of_the_proposer_are_taken_up(tmp_path):
    world = make_capture(tmp_path / "c", 2)
    for fill in (9, 200):
        ids = np.zeros((HEIGHT, WIDTH), np.uint8)
        ids[10:30, 10 : 30 + fill // 20] = fill
        for name in world.names:
            write_image(tmp_path / "given" / f"{name}.png", ids)
        make_masks(tmp_path / "c", MaskSettings(str(tmp_path / "given"), encoder=None), progress=False)
        assert ((ids_of(tmp_path / "c", world.names[0]) > 0) == (ids > 0)).all()


def test_the_folder_of_the_proposer_may_be_the_capture_but_not_its_masks(tmp_path, monkeypatch):
    """Masks were made again on every run, or, their ids renumbered, of themselves."""
    capture, names = tmp_path / "c", make_capture(tmp_path / "c", 2).names
    square = {"segmentation": [[9, 9, 29, 9, 29, 29, 9, 29]]}
    images = [{"id": k, "file_name": f"{name}.png", "height": HEIGHT, "width": WIDTH} for k, name in enumerate(names)]
    coco = {"images": images, "annotations": [{"image_id": k, **square} for k in range(2)]}
    (capture / "annotations.json").write_text(json.dumps(coco))
    settings = MaskSettings(str(capture), encoder=None)
    with monkeypatch.context() as patch:
        patch.setattr("og_pointcloud.masking.make_masks._assemble", killed)
        with pytest.raises(KeyboardInterrupt):
            make_masks(capture, settings, progress=False)
    assert [make_masks(capture, settings, progress=False).done_before for _ in range(2)] == [2, 2]
    before = ids_of(capture, names[0])
    of_itself = MaskSettings(str(capture / "masks"), encoder=None)
    with pytest.raises(OgPointcloudError, match=r"would be replaced by those made of them; .* \(-o DIR\)"):
        make_masks(capture, of_itself, overwrite=True, progress=False)
    assert np.array_equal(ids_of(capture, names[0]), before)


# Which images ----------------------------------------------------------------------------------------------------


def test_left_out_images_need_a_folder_and_are_named(tmp_path, capsys):
    world = make_capture(tmp_path / "c", 5)
    poses = tmp_path / "c" / "transforms.json"
    poses.write_bytes(b"\xef\xbb\xbf" + poses.read_bytes())  # the mark that editors of Windows put before it
    assert "(-o DIR)" in error_of(capsys, "masks", tmp_path / "c", *QUICKLY, "--every", "2")
    output = tmp_path / "c" / "half"
    said = output_of(capsys, "masks", tmp_path / "c", *QUICKLY, "--every", "2", "-o", output)
    assert f"left out: 2 of 5 images: {world.names[1]}, {world.names[3]}" in said
    scene = read_capture(output)
    assert [view.name for view in scene.views] == world.names[::2]
    assert scene.views[0].image_rgb() is not None
    assert len(scene.points) == 50
    assert not (tmp_path / "c" / "masks").exists()
    assert not (output / "half").exists(), "it holds no link to itself"


def test_colmap_captures(tmp_path):
    """Its pose files stay as they are: images left out are known by the record of the masks."""
    world, capture = make_world(count=3), tmp_path / "c"
    write_colmap_text(capture / "sparse" / "0", world)
    for name in world.names:
        write_image(capture / "images" / f"{name}.png", scenery())
    make_masks(capture, replace(QUICK, every=2), tmp_path / "some", progress=False)
    with pytest.warns(UserWarning, match="1 of 3 images have no masks and are left out"):
        assert [view.name for view in read_capture(tmp_path / "some").views] == world.names[::2]
    make_masks(capture, QUICK, progress=False)
    assert all(view.mask_count for view in read_capture(capture).views)
    (capture / "masks" / f"{world.names[1]}.png").unlink()
    with pytest.raises(SceneError, match="1 of 3 posed images have no mask"):
        read_capture(capture)


@pytest.mark.parametrize(("thing", "with_palette"), [(700, False), (200, True)])
def test_ids_of_a_video_tracker_are_tracks_of_the_capture(tmp_path, thing, with_palette):
    world = make_capture(tmp_path / "c", 3)
    for k, name in enumerate(world.names):
        ids = np.zeros((HEIGHT, WIDTH), np.uint16)
        ids[10:30, 10 + k : 30 + k], ids[5:9, 40:60] = thing, 5
        if with_palette:  # as trackers of DAVIS write them
            image = Image.fromarray(ids.astype(np.uint8), "P")
            image.putpalette(np.random.default_rng(0).integers(0, 256, 768).tolist())
            image.save(tmp_path / f"{name}.png")
        else:
            write_image(tmp_path / f"{name}.png", ids)
    settings = MaskSettings(str(tmp_path), encoder=None, level="large", tracks=True)
    make_masks(tmp_path / "c", settings, progress=False)
    for k, view in enumerate(read_capture(tmp_path / "c").views):
        of_thing = view.mask_map()[20, 20 + k], view.mask_map()[6, 50]
        assert [view.mask_tracks[mask] - 1 for mask in of_thing] == [thing - 2, 3]
    make_masks(tmp_path / "c", replace(settings, tracks=False), progress=False)
    assert all(view.mask_tracks is None for view in read_capture(tmp_path / "c").views)


def test_tracks_that_do_not_fit_the_masks_are_refused(tmp_path):
    make_capture(tmp_path, 2)
    make_masks(tmp_path, QUICK, progress=False)
    with np.load(tmp_path / "mask_features.npz") as file:
        arrays = dict(file)
    name = next(name for name in arrays if name != "feature_space")
    for tracks in (np.zeros(len(arrays[name]) + 1, np.int64), np.zeros(len(arrays[name]))):
        np.savez(tmp_path / "mask_features.npz", **arrays, **{f"{name}.tracks": tracks})
        with pytest.raises(SceneError, match=rf"view '{name}': mask tracks are .*; expected a whole number for each"):
            read_capture(tmp_path)


# Images as they come ----------------------------------------------------------------------------------------------


def grey(_, picture):
    return cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY))[1].tobytes()


def sixteen_bit(_, picture):
    return cv2.imencode(".png", picture.astype(np.uint16) * 257)[1].tobytes()


def alpha(_, picture):
    return cv2.imencode(".png", np.dstack([picture, np.full(picture.shape[:2], 90, np.uint8)]))[1].tobytes()


def rotated_by_exif(_, picture):
    """A JPEG that says orientation 6: viewers turn it, poses do not."""
    data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
    tiff = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0"
    exif = b"Exif\0\0" + tiff
    return data[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + data[2:]


@pytest.mark.parametrize("encode", [grey, sixteen_bit, alpha, rotated_by_exif])
def test_images_of_every_kind(tmp_path, encode):
    world = make_capture(tmp_path / "c", 1, encode)
    make_masks(tmp_path / "c", ALONE, progress=False)
    ids = ids_of(tmp_path / "c", world.names[0])
    thing = (scenery() == (40, 40, 210)).all(axis=2)
    found = ids == np.bincount(ids[thing]).argmax()
    assert ids.shape == (HEIGHT, WIDTH)
    assert (found & thing).sum() / (found | thing).sum() > 0.7


@pytest.mark.slow
def test_a_large_image_is_shrunk_and_its_camera_with_it(tmp_path):
    make_capture(tmp_path / "c", 1, lambda *_: plain(0, scenery(size=(HEIGHT * 120, WIDTH * 120))))
    make_masks(tmp_path / "c", ALONE, progress=False)
    view = read_capture(tmp_path / "c").views[0]
    assert (view.camera.width, view.camera.height) == (1024, 768)
    assert view.camera.fx == pytest.approx(70 * 16)
    assert view.mask_count >= 2


@pytest.mark.parametrize(
    "data", [b"", b"not an image", plain(0, scenery())[:60], plain(0, np.zeros((7, 90, 3), np.uint8))]
)
def test_an_image_that_cannot_be_used_is_named(tmp_path, data):
    world = make_capture(tmp_path / "c", 3, lambda k, picture: data if k == 1 else plain(k, picture))
    with pytest.raises(SceneError, match=world.names[1]):
        make_masks(tmp_path / "c", QUICK, progress=False)
    assert not (tmp_path / "c" / "masks").exists()


def test_a_missing_image_and_a_missing_folder(tmp_path):
    world = make_capture(tmp_path / "c", 2)
    (tmp_path / "c" / "images" / f"{world.names[0]}.png").unlink()
    with (
        pytest.warns(UserWarning, match="not found"),
        pytest.raises(SceneError, match="1 of 2 posed images are not found"),
    ):
        make_masks(tmp_path / "c", ALONE, progress=False)
    with pytest.raises(SceneError, match="is not a folder"):
        make_masks(tmp_path / "none", ALONE, progress=False)


def test_a_proposer_that_is_not_there_is_one_error(tmp_path):
    make_capture(tmp_path / "c", 2)
    settings = MaskSettings(proposer="onnx:none.onnx", encoder=None)
    with pytest.raises(OgPointcloudError, match=r"proposer is 'onnx:none\.onnx'; expected opencv, sam:FOLDER"):
        make_masks(tmp_path / "c", settings, progress=False)


OWN = """
import numpy as np
def bright(image):
    return image.max(axis=2) / 255
def broken(image):
    return 1 / 0
def halves(image):
    left = np.arange(image.shape[1]) < image.shape[1] // 2
    return np.broadcast_to([[left], [~left]], (2, *image.shape[:2])).copy()
class Broken:
    def propose(self, image):
        return 1 / 0
class Nothing:
    def propose(self, image):
        from og_pointcloud.masking.contracts import Proposals
        return Proposals(np.zeros((0, *image.shape[:2]), bool), np.zeros(0, np.float32))
number = 3
"""


def test_masks_of_an_installed_module_that_has_changed_are_made_again(tmp_path, monkeypatch):
    installed = tmp_path / "site" / "installed_masks"
    installed.mkdir(parents=True)
    (installed / "__init__.py").write_text("")
    (installed / "halves.py").write_text(OWN)
    monkeypatch.syspath_prepend(str(installed.parent))
    make_capture(tmp_path / "c", 2)
    settings = MaskSettings(proposer="python:installed_masks.halves:Nothing", encoder=None)
    assert make_masks(tmp_path / "c", settings, progress=False).masks == 0
    assert make_masks(tmp_path / "c", settings, progress=False).done_before == 2
    (installed / "halves.py").write_text(OWN.replace("class Nothing:", "Nothing = halves\nclass Something:"))
    assert make_masks(tmp_path / "c", settings, progress=False).done_before == 0


def test_a_proposer_of_ones_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own_masks.py").write_text(OWN)
    (tmp_path / "typo.py").write_text("def x(:")
    make_capture(tmp_path / "c", 2)
    settings = MaskSettings(proposer="python:own_masks:halves", encoder=None)
    assert make_masks("c", settings, "halves", progress=False).masks == 4
    settings = MaskSettings(proposer="python:own_masks:Nothing", encoder=None)
    assert make_masks("c", settings, "nothing", progress=False).masks == 0
    (tmp_path / "own_masks.py").write_text(OWN.replace("class Nothing:", "Nothing = halves\nclass Something:"))
    assert make_masks("c", settings, "nothing", progress=False).masks == 4, "of code that has changed since"
    (tmp_path / "own_masks.py").write_text(OWN)
    for place, says in {
        "own_masks:number": "'python:own_masks:number' is a int; expected a function",
        "own_masks:none": "no proposer 'python:own_masks:none'",
        "no_module:bright": "no proposer 'python:no_module:bright'",
        "own_masks": "expected python:MODULE:NAME",
        "own_masks:bright": "a mask proposer returned",
        "own_masks:broken": r"python:own_masks:broken failed \(ZeroDivisionError: division by zero\)",
        "own_masks:Broken": r"python:own_masks:Broken failed \(ZeroDivisionError: division by zero\)",
        "typo:x": r"no proposer 'python:typo:x' \(SyntaxError",
    }.items():
        settings = MaskSettings(proposer=f"python:{place}", encoder=None)
        with pytest.raises(OgPointcloudError, match=says):
            make_masks("c", settings, "out", progress=False)
    assert str(tmp_path) not in sys.path


def test_settings_are_checked():
    with pytest.raises(OgPointcloudError, match="mask level is 'huge'"):
        MaskSettings(level="huge")
    with pytest.raises(OgPointcloudError, match="every is 0"):
        MaskSettings(every=0)
    with pytest.raises(OgPointcloudError, match=r"words are 'chair'; expected a tuple such as \('chair',\)"):
        MaskSettings(words="chair")  # pyright: ignore[reportArgumentType]


def test_light_work_takes_a_thread_a_core_and_models_take_one(monkeypatch, tmp_path):
    monkeypatch.setattr(os, "cpu_count", lambda: 4)
    assert ALONE.threads == 4
    assert MaskSettings(proposer=str(tmp_path)).threads == 4  # a folder of masks
    (tmp_path / "opencv").mkdir()
    monkeypatch.chdir(tmp_path)
    assert ALONE.folder is None  # a clone of OpenCV is no folder of masks
    assert MaskSettings(proposer="sam:facebook/sam-vit-base").threads == 1
    assert MaskSettings(encoder="openai/clip-vit-base-patch16").threads == 1


def test_a_pose_file_that_is_not_read_need_not_make_sense(tmp_path):
    make_capture(tmp_path / "c")
    (tmp_path / "c" / "transforms_train.json").write_text("{}")
    made = make_masks(tmp_path / "c", replace(QUICK, every=2), tmp_path / "half", progress=False)
    assert made.images == 2
    assert len(read_capture(tmp_path / "half").views) == 2


def test_a_record_that_is_nested_without_end_is_none(tmp_path):
    make_capture(tmp_path)
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks" / "made.json").write_text("[" * 200_000)
    assert make_masks(tmp_path, QUICK, progress=False).masks > 0


@pytest.mark.parametrize("orientation", [1, 2, 3, 6, 8])
def test_turns_by_exif_are_those_of_pillow(tmp_path, orientation):
    file, exif = tmp_path / "a.jpg", Image.Exif()
    exif[EXIF_ORIENTATION] = orientation
    Image.fromarray(scenery()).save(file, exif=exif)
    with Image.open(file) as image:
        stored, upright = np.asarray(image), np.asarray(ImageOps.exif_transpose(image))
    turned = np.rot90(stored, exif_quarter_turns(file))
    np.testing.assert_array_equal(turned, stored if orientation == 2 else upright)  # no camera mirrors


def test_a_damaged_orientation_is_none(tmp_path):
    (tmp_path / "a.jpg").write_bytes(rotated_by_exif(0, scenery()).replace(b"II*\0\x08", b"II*\0\xff"))
    assert exif_quarter_turns(tmp_path / "a.jpg") == 0


class Watched:
    """Proposer and encoder that keep what they are shown."""

    feature_space = "none"

    def __init__(self):
        self.shown = []

    def propose(self, image):
        self.shown.append(image)
        ids = by_color(image)
        masks = ids == np.arange(ids.max() + 1)[:, None, None]
        return Proposals(masks, np.ones(len(masks), np.float32))

    def embed(self, image, masks):
        self.shown.append(image)
        return np.array([np.append(image[mask].mean(axis=0), mask.sum()) for mask in masks])


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
@pytest.mark.parametrize("existing", [False, True])
def test_models_see_images_upright_and_masks_are_for_the_stored_ones(tmp_path, monkeypatch, turns, existing):
    make_capture(tmp_path / "c", 2)
    make_masks(tmp_path / "c", QUICK, progress=False)
    shutil.copytree(tmp_path / "c" / "masks", tmp_path / "given")
    watched = Watched()
    monkeypatch.setattr("og_pointcloud.masking.photographs.exif_quarter_turns", lambda _: turns)
    monkeypatch.setattr("og_pointcloud.masking.worker.open_encoder", lambda *_: watched)
    monkeypatch.setattr("og_pointcloud.masking.worker.open_proposer", lambda *_: watched)
    proposer = str(tmp_path / "given") if existing else "opencv"
    make_masks(tmp_path / "c", MaskSettings(proposer, encoder="any"), overwrite=True, progress=False)
    for shown in watched.shown:
        assert shown.shape[:2] == ((WIDTH, HEIGHT) if turns % 2 else (HEIGHT, WIDTH))
    for k, view in enumerate(read_capture(tmp_path / "c").views):
        ids, image = view.mask_map(), scenery(k)[..., ::-1]
        np.testing.assert_array_equal(np.rot90(watched.shown[0 if k == 0 else len(watched.shown) // 2], -turns), image)
        for mask, feature in enumerate(view.mask_features):
            assert len(np.unique(image[ids == mask], axis=0)) == 1, "a mask is of one color, where it is stored"
            expected = np.append(image[ids == mask].mean(axis=0), (ids == mask).sum())
            np.testing.assert_allclose(feature, expected, rtol=1e-2)
        assert len(view.mask_features) == (2 if existing else 3), "id 0 of a file is none"
