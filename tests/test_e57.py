"""E57 files that libE57 itself wrote: clouds in one world, images that become a capture, and files that are none."""

import json

import cv2
import numpy as np
import pytest
from commands import error_of, output_of

import og_pointcloud as og
from og_pointcloud.cli import main
from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.formats.capture import find_images, read_photograph, read_poses
from og_pointcloud.formats.e57 import unpack_e57
from og_pointcloud.formats.points import read_places, read_points
from og_pointcloud.formats.poses import rotation_of_quaternion

pye57 = pytest.importorskip("pye57")

TURN = np.array([0.8, 0.1, -0.2, 0.55]) / np.linalg.norm([0.8, 0.1, -0.2, 0.55])
AT = np.array([10.0, -20.0, 3.0])
STRAIGHT = np.array([1.0, 0, 0, 0])


def scan(seed=0, count=300):
    rng = np.random.default_rng(seed)
    colors = {name: rng.integers(0, 256, count).astype(np.uint8) for name in ("colorRed", "colorGreen", "colorBlue")}
    return dict(zip(("cartesianX", "cartesianY", "cartesianZ"), rng.normal(size=(3, count)), strict=True)) | colors


def write_e57(path, scans=1, images=(), turn=TURN, at=AT):
    """scans: how many, or their data; each at a pose of its own. images: (name, kind, numbers, encoded picture, pose or
    None)."""
    from pye57 import libe57

    written = [scan(seed) for seed in range(scans)] if isinstance(scans, int) else scans
    with pye57.E57(str(path), mode="w") as file:
        for index, data in enumerate(written):
            file.write_scan_raw(data, rotation=turn, translation=at + index)
        handle = file.image_file
        vector = file.root["images2D"]

        def structure(numbers):
            node = libe57.StructureNode(handle)
            for key, value in numbers.items():
                of_type = libe57.IntegerNode if isinstance(value, int) else libe57.FloatNode
                node.set(key, structure(value) if isinstance(value, dict) else of_type(handle, value))
            return node

        for name, kind, numbers, picture, pose in images:
            node = structure({"pose": pose} if pose else {})
            node.set("name", libe57.StringNode(handle, name))
            shown = structure(numbers)
            node.set(f"{kind}Representation", shown)
            vector.append(node)
            blob = libe57.BlobNode(handle, len(picture))
            shown.set("jpegImage" if picture[:2] == b"\xff\xd8" else "pngImage", blob)
            blob.write(np.frombuffer(picture, np.uint8).copy(), 0, len(picture))
    return written


def pose_of(quaternion=TURN, translation=AT):
    axes = dict(zip("wxyz", map(float, quaternion), strict=True))
    return {"rotation": axes, "translation": dict(zip("xyz", map(float, translation), strict=True))}


def encoded(width, height, suffix=".png", values=None):
    picture = np.full((height, width, 3), 90, np.uint8) if values is None else values
    return cv2.imencode(suffix, picture)[1].tobytes()


PINHOLE = {"imageWidth": 64, "imageHeight": 48, "focalLength": 0.02, "pixelWidth": 0.0004, "pixelHeight": 0.0005}
PINHOLE |= {"principalPointX": 31.0, "principalPointY": 25.0}


def spherical(width, height, rise=np.pi):
    return {"imageWidth": width, "imageHeight": height, "pixelWidth": 2 * np.pi / width, "pixelHeight": rise / height}


def test_scans_are_one_cloud_in_the_files_world(tmp_path):
    written = write_e57(tmp_path / "a.e57", scans=2)
    points = read_points(tmp_path / "a.e57")
    local = [np.stack([data[f"cartesian{axis}"] for axis in "XYZ"], axis=1) for data in written]
    world = np.concatenate([xyz @ rotation_of_quaternion(TURN).T + AT + i for i, xyz in enumerate(local)])
    np.testing.assert_allclose(points.xyz_world, world, atol=1e-5)
    np.testing.assert_array_equal(points.rgb[:, 1], np.concatenate([data["colorGreen"] for data in written]))


def test_points_that_the_scanner_calls_invalid_are_left_out(tmp_path):
    data = scan()
    data["cartesianInvalidState"] = (np.arange(300) % 3 == 0).astype(np.uint8)
    write_e57(tmp_path / "a.e57", [data], turn=STRAIGHT, at=np.zeros(3))
    points = read_points(tmp_path / "a.e57")
    np.testing.assert_allclose(points.xyz_world[:, 0], data["cartesianX"][np.arange(300) % 3 != 0], atol=1e-6)


def test_a_stray_far_from_the_scan_costs_the_others_no_millimeters(tmp_path):
    """As a point at the origin of the map is, where some programs put what a scanner did not measure."""
    data, at = scan(), np.array([431234.567, 5412345.678, 312.0])
    data["cartesianY"][-1] = -at[1]
    write_e57(tmp_path / "a.e57", [data], turn=STRAIGHT, at=at)
    world = np.column_stack([data[f"cartesian{axis}"] for axis in "XYZ"]) + at
    np.testing.assert_allclose(read_points(tmp_path / "a.e57").xyz_world[:-1], world[:-1], rtol=0, atol=1e-5)


class Measured(np.ndarray):
    """An array whose bounds, which the writer stores, are those of its finite values."""

    def min(self, *_, **__):
        return float(np.nanmin(np.asarray(self)))

    def max(self, *_, **__):
        return float(np.nanmax(np.asarray(self)))


def test_points_with_nan_are_left_out_with_a_warning_and_stay_unknown_where_labelled(tmp_path):
    data = scan()
    data["cartesianX"][7] = np.nan
    measured = {name: values.view(Measured) for name, values in data.items()}
    write_e57(tmp_path / "a.e57", [measured], turn=STRAIGHT, at=np.zeros(3))
    with pytest.warns(UserWarning, match=r"1 of 300 points contain NaN or infinity \(the first is row 7\): left out"):
        points = read_points(tmp_path / "a.e57")
    np.testing.assert_allclose(points.xyz_world[:, 0], np.delete(data["cartesianX"], 7), atol=1e-6)
    with pytest.warns(UserWarning, match="the first is row 7"):
        places = read_places(tmp_path / "a.e57")
    assert np.flatnonzero(np.isnan(places).any(axis=1)).tolist() == [7]


def test_a_pinhole_image_sees_its_points_where_the_standard_says(tmp_path):
    """Standard: looks along -z, x right, y up; column = principal point - x / z times focal length in pixels."""
    write_e57(tmp_path / "a.e57", images=[("Setup 1/front", "pinhole", PINHOLE, encoded(64, 48), pose_of())])
    assert unpack_e57(tmp_path / "a.e57", tmp_path / "capture") == (1, [])
    (image,) = read_poses(tmp_path / "capture").images
    assert image.path == "images/0000_Setup_1_front.png"
    point = np.array([0.3, 0.2, -2.0])
    world = rotation_of_quaternion(TURN) @ point + AT
    uv, depth = image.camera.project(world[None])
    np.testing.assert_allclose(uv, [[31.0 + 50 * 0.15, 25.0 - 40 * 0.1]], atol=1e-9)
    assert depth[0] == pytest.approx(2)


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
@pytest.mark.parametrize("rise", [np.pi, np.radians(120)])
def test_a_spherical_image_shows_its_points_in_its_faces(tmp_path, rise, suffix):
    """Standard: +x in the middle, +y left of it, z up; scanners see no floor below them, so images end before it."""
    width, height = 400, round(400 * rise / (2 * np.pi))
    picture = np.full((height, width, 3), 60, np.uint8)
    directions = {"front": (1, 0.1, 0.05), "left": (0.1, 1, 0.2), "back": (-1, 0.3, -0.4), "right": (0.2, -1, 0.3)}
    for number, (x, y, z) in enumerate(directions.values()):
        column = width / 2 - np.arctan2(y, x) * width / (2 * np.pi)
        row = height / 2 - np.arctan2(z, np.hypot(x, y)) * height / rise
        cv2.circle(picture, (int(column), int(row)), 6, (0, 0, 250 - 40 * number), -1)
    numbers = spherical(width, height, rise)
    write_e57(tmp_path / "a.e57", images=[("pano", "spherical", numbers, encoded(0, 0, suffix, picture), pose_of())])
    assert unpack_e57(tmp_path / "a.e57", tmp_path / "capture")[0] == 1
    poses = read_poses(tmp_path / "capture")
    assert len(poses.images) == 6
    files = find_images(tmp_path / "capture", poses.images)
    found = {}
    for name, image, file in zip(poses.names, poses.images, files, strict=True):
        rgb = read_photograph(file, image.camera, image.face)
        for number, (face, direction) in enumerate(directions.items()):
            world = rotation_of_quaternion(TURN) @ np.array(direction, float) + AT
            uv, _ = image.camera.project(world[None])
            if image.camera.shows(uv)[0]:
                column, row = uv[0].astype(int)
                assert abs(int(rgb[row, column, 0]) - (250 - 40 * number)) < 25
                found[face] = name.rsplit("/", 1)[1]
    assert found == {face: face for face in directions}


def test_images_that_cannot_be_used_are_named(tmp_path, capsys):
    images = [
        ("lost", "pinhole", PINHOLE, encoded(64, 48), None),
        ("round", "cylindrical", spherical(64, 32), encoded(64, 32), pose_of()),
        ("half", "spherical", spherical(64, 32) | {"pixelWidth": 0.01}, encoded(64, 32), pose_of()),
        ("torn", "spherical", spherical(64, 30, 2.9), b"\x89PNG torn", pose_of()),
        ("flat", "pinhole", PINHOLE | {"pixelWidth": 0.0}, encoded(64, 48), pose_of()),
        ("good", "pinhole", PINHOLE, encoded(64, 48, ".jpg"), pose_of()),
    ]
    write_e57(tmp_path / "a.e57", images=images)
    said = output_of(capsys, "import", tmp_path / "a.e57", "-o", tmp_path / "capture.v2")
    (tmp_path / "capture.v2").rename(tmp_path / "capture")
    for line in (
        "lost: it has no pose", "round: it is neither pinhole nor spherical", "half: it spans 37 x 180 degrees",
        "torn: its JPEG or PNG is damaged", "flat: it is 64x48 pixels of 0.0 x", "1 images with poses",
    ):  # fmt: skip
        assert line in said
    content = json.loads((tmp_path / "capture/transforms.json").read_text())
    assert [frame["file_path"] for frame in content["frames"]] == ["images/0005_good.jpg"]
    assert len(og.read_points(tmp_path / "capture/points.ply")) == 300
    assert "expected a new folder" in error_of(capsys, "import", tmp_path / "a.e57", "-o", tmp_path / "capture")
    (tmp_path / "a.ogpc").mkdir()
    assert "expected a file name" in error_of(capsys, "import", tmp_path / "a.e57", "-o", tmp_path / "a.ogpc")


def test_a_file_without_usable_images_leaves_nothing_behind(tmp_path):
    write_e57(tmp_path / "a.e57")
    assert main(["import", str(tmp_path / "a.e57"), "-o", str(tmp_path / "capture")]) != 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.e57"]
    with pytest.raises(SceneError, match="none of its images can be used"):
        unpack_e57(tmp_path / "a.e57", tmp_path / "capture")


def test_truncated_empty_and_foreign_files_are_one_error_and_stay(tmp_path):
    write_e57(tmp_path / "whole.e57")
    whole = (tmp_path / "whole.e57").read_bytes()
    for data in (whole[:48], whole[: len(whole) // 2], whole[:-100], whole[:3000] + b"x" * 8 + whole[3008:]):
        (tmp_path / "a.e57").write_bytes(data)
        with pytest.raises(SceneError, match=r"a\.e57: not a whole E57 file \([^\\]{9,120}\): copy or export"):
            read_points(tmp_path / "a.e57")
        assert (tmp_path / "a.e57").read_bytes() == data
    for data in (b"", b"PK\x03\x04 not this"):
        (tmp_path / "a.e57").write_bytes(data)
        with pytest.raises(SceneError, match=r"not a geometry file that can be read|not a whole zip, as a SOG"):
            read_points(tmp_path / "a.e57")
        with pytest.raises(OgPointcloudError, match=r"not a whole E57 file"):
            unpack_e57(tmp_path / "a.e57", tmp_path / "capture")


def test_scans_that_together_claim_too_much(tmp_path, monkeypatch):
    """They may all name the same bytes."""
    write_e57(tmp_path / "a.e57", scans=3)
    monkeypatch.setattr("og_pointcloud.formats.e57.POINTS_PER_CHUNK", 10)
    monkeypatch.setattr("og_pointcloud.formats.e57.MAX_POINTS_PER_BYTE", 700 / (tmp_path / "a.e57").stat().st_size)
    with pytest.raises(SceneError, match="claims 300 points, more than fit"):
        read_points(tmp_path / "a.e57")


def test_a_sphere_of_another_size_is_not_unpacked(tmp_path, monkeypatch):
    """A small file may unpack to gigabytes."""
    images = [("large", "spherical", spherical(64, 32), encoded(640, 320), pose_of())]
    write_e57(tmp_path / "a.e57", images=[*images, ("b", "pinhole", PINHOLE, encoded(64, 48), pose_of())])
    monkeypatch.setattr(cv2, "imdecode", None)
    count, unused = unpack_e57(tmp_path / "a.e57", tmp_path / "made")
    assert count == 1
    assert "its size is not the one" in unused[0]


def test_nothing_is_unpacked_through_a_link(tmp_path):
    write_e57(tmp_path / "a.e57", images=[("b", "pinhole", PINHOLE, encoded(64, 48), pose_of())])
    (tmp_path / "made").mkdir()
    (tmp_path / "made" / "images").symlink_to(tmp_path)
    with pytest.raises(SceneError, match="nothing is written through links"):
        unpack_e57(tmp_path / "a.e57", tmp_path / "made")
