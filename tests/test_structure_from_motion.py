"""Poses of photographs: a textured room photographed along an arc, and photographs of which no model can be made."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from pinhole import looking, rays
from scenes import camera, distance_to_surface, look, write_image

from og_pointcloud.cli import main
from og_pointcloud.errors import MissingExtraError, SceneError
from og_pointcloud.formats.capture import read_geometry, read_poses
from og_pointcloud.formats.poses import upright_axes
from og_pointcloud.formats.structure_from_motion import MAX_EXHAUSTIVE, NEIGHBORS, _pairs, find_poses

SIZE = 320, 240
VIEWS = 9


def arc():
    """Camera to world, OpenCV axes: around the crate in steps of 7 degrees, looking down at it."""
    for angle in np.radians(200 + 7 * np.arange(VIEWS)):
        eye = np.array([2 + 1.6 * np.cos(angle), 1.5 + 1.2 * np.sin(angle), 1.5])
        yield np.linalg.inv(looking(eye, [2.0, 1.5, 0.6] - eye))


def photograph(pose):
    """(H, W, 3): what a place looks like depends on the place alone: noise in space, fine and coarse."""
    from scipy.ndimage import map_coordinates

    depth, _ = look(pose, size=SIZE)
    xyz = rays(camera(pose, SIZE)) * depth[..., None] + pose[:3, 3]
    shade = np.zeros(depth.shape)
    for octave, fineness in enumerate((4, 9, 19, 37)):
        volume = np.random.default_rng(octave).normal(size=(32, 32, 32))
        shade += map_coordinates(volume, np.moveaxis(xyz * fineness, -1, 0), order=1, mode="grid-wrap")
    grey = np.clip(128 + 40 * shade, 0, 255)
    return np.stack([grey, 0.9 * grey, 0.8 * grey], axis=2).astype(np.uint8)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photographs")
    for index, pose in enumerate(arc()):
        write_image(folder / f"IMG {index}.png", photograph(pose))
    return folder


@pytest.mark.slow
def test_poses_and_points_of_a_room(photographs, tmp_path, capsys):
    pytest.importorskip("pycolmap")
    random = np.random.default_rng(0)
    (tmp_path / "photographs").mkdir()
    for file in photographs.iterdir():
        (tmp_path / "photographs" / file.name).symlink_to(file)
    write_image(tmp_path / "photographs" / "elsewhere.png", random.integers(0, 256, (240, 320, 3)).astype(np.uint8))
    assert main(["poses", str(tmp_path / "photographs"), "-o", str(tmp_path / "room")]) == 0
    said = capsys.readouterr()
    assert f"{VIEWS} of {VIEWS + 1} photographs have poses" in said.out
    assert "next: og-pointcloud masks" in said.out
    assert "1 photograph could not be placed: elsewhere.png" in said.err

    poses = read_poses(tmp_path / "room")
    found = {name: image.camera for name, image in zip(poses.names, poses.images, strict=True)}
    wanted = {f"IMG {index}": camera(pose, SIZE) for index, pose in enumerate(arc())}
    assert found.keys() == wanted.keys()
    ours = np.array([found[name].center for name in wanted])
    theirs = np.array([wanted[name].center for name in wanted])
    scale, rotation, shift = similarity(ours, theirs)
    path = np.ptp(theirs, axis=0).max()
    assert np.abs(scale * ours @ rotation.T + shift - theirs).max() < 0.01 * path
    for name, right in wanted.items():
        turn = rotation @ found[name].world_to_camera[:3, :3].T @ right.world_to_camera[:3, :3]
        assert np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))) < 1
        assert abs(found[name].fx / right.fx - 1) < 0.02
    assert rotation[2, 2] > np.cos(np.radians(40)), "z is up, as far as the photographs say"
    points = read_geometry(tmp_path / "room", poses)
    assert len(points) > 300
    xyz = scale * points.xyz_world @ rotation.T + shift
    assert np.median(distance_to_surface(xyz)) < 0.02, "of a room 4 long"
    with pytest.raises(SceneError, match="sparse already exists"):
        find_poses(tmp_path / "photographs", tmp_path / "room")


@pytest.mark.slow
def test_the_same_photographs_give_the_same_model(photographs, tmp_path):
    pytest.importorskip("pycolmap")
    for name in ("a", "b"):
        find_poses(photographs, tmp_path / name)
    for file in ("cameras.bin", "images.bin", "points3D.bin"):
        a, b = ((tmp_path / name / "sparse/0" / file).read_bytes() for name in ("a", "b"))
        assert a == b, file


def similarity(source, target):
    """Scale, rotation and shift that take points nearest to others (Umeyama 1991)."""
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    u, values, vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ sign @ vt
    scale = np.trace(np.diag(values) @ sign) / (a**2).sum()
    return scale, rotation, target.mean(axis=0) - scale * rotation @ source.mean(axis=0)


def test_photographs_that_share_nothing_say_what_to_do(tmp_path, capsys):
    pytest.importorskip("pycolmap")
    random = np.random.default_rng(0)
    for index in range(4):
        write_image(tmp_path / "p" / f"{index}.png", random.integers(0, 256, (60, 80, 3)).astype(np.uint8))
    assert main(["poses", str(tmp_path / "p"), "-o", str(tmp_path / "c")]) == 2
    said = capsys.readouterr().err
    assert "0 of 4 photographs could be aligned; expected at least half of them: take more photographs" in said
    assert len(said.splitlines()) == 1, said
    assert not (tmp_path / "c" / "sparse").exists()
    assert not (tmp_path / "c" / "images").exists()


def test_too_few_photographs_and_a_missing_library(tmp_path, monkeypatch):
    with pytest.raises(SceneError, match="none is not a folder; expected one of photographs"):
        find_poses(tmp_path / "none")
    write_image(tmp_path / "plan.png", np.zeros((8, 8, 3), np.uint8))
    with pytest.raises(SceneError, match=r"has 1 photograph; expected 3 or more, there or in its images/"):
        find_poses(tmp_path)
    for index in range(3):  # the plan beside images/ is none of the photographs
        write_image(tmp_path / "images" / f"{index}.png", np.zeros((8, 8, 3), np.uint8))
    (tmp_path / "other" / "images").mkdir(parents=True)
    with pytest.raises(SceneError, match=r"images has other images than .*name another folder"):
        find_poses(tmp_path, tmp_path / "other")
    (tmp_path / "other" / "images").rmdir()
    (tmp_path / "other").rmdir()
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(MissingExtraError, match="poses"):
        find_poses(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["images", "plan.png"]


@pytest.mark.parametrize("count", [3, MAX_EXHAUSTIVE, MAX_EXHAUSTIVE + 1, 1000])
def test_pairs(count):
    pairs = _pairs(count)
    assert len(set(pairs)) == len(pairs)
    assert all(0 <= a < b < count for a, b in pairs)
    near = {(a, b) for a in range(count) for b in range(a + 1, min(a + 1 + NEIGHBORS, count))}
    assert near <= set(pairs)
    assert len(pairs) <= MAX_EXHAUSTIVE**2 / 2 + count * NEIGHBORS
    if count <= MAX_EXHAUSTIVE:
        assert len(pairs) == count * (count - 1) // 2
    assert any(b - a > count // 2 for a, b in pairs), "the ends are compared too: loops close"


@pytest.mark.parametrize("seed", range(5))
def test_up_becomes_z(seed):
    up = np.random.default_rng(seed).normal(size=3)
    up /= np.linalg.norm(up)
    rotation = upright_axes(up)
    np.testing.assert_allclose(rotation @ up, [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) > 0
