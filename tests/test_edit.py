"""Scene editing: what is taken, what is kept as it was, colors and harmonics against their definition, refusals."""

import json
import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from commands import error_of, output_of, run
from labelled_clouds import WORDS, make_cloud, room
from scipy.spatial.transform import Rotation
from scipy.special import lpmv

import og_pointcloud as og
from og_pointcloud.ask.labelled_scene import LabelledScene
from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.formats.ply import join_columns, read_ply, write_ply
from og_pointcloud.formats.points import read_points
from og_pointcloud.show.splat_columns import rotated_harmonics

SH_CONSTANT = 0.28209479177387814
BASE = ("f_dc_0", "f_dc_1", "f_dc_2")
FAR = np.array([1000.0, -500.0, 20.0])


def gaussian_columns(xyz, degree=3, seed=0):
    """A trained 3DGS file's columns, and two more that a trainer might add."""
    random = np.random.default_rng(seed)
    rest = 3 * ((degree + 1) ** 2 - 1)
    names = ["nx", "ny", "nz", *BASE, *(f"f_rest_{k}" for k in range(rest)), "opacity"]
    names += [*(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4)), "ins_feat_r"]
    columns = dict(zip("xyz", np.asarray(xyz, np.float32).T, strict=True))
    columns |= {name: random.normal(size=len(xyz)).astype(np.float32) * 0.4 for name in names}
    return columns | {"label": random.integers(0, 99, len(xyz)).astype(np.int32)}


@pytest.fixture(scope="module")
def scene():
    cloud = replace(room(900), origin=FAR)
    # What a file of float32 holds: the .ogpc was made from it.
    xyz = cloud.xyz_world.astype(np.float32)
    return LabelledScene.from_cloud(replace(cloud, xyz=(xyz - FAR).astype(np.float32)))


@pytest.fixture
def splats(scene, tmp_path):
    path = tmp_path / "splats.ply"
    extra = join_columns({"a": np.arange(2, dtype=np.int32)})
    write_ply(path, {"vertex": join_columns(gaussian_columns(scene.xyz)), "extra": extra})
    return path


def plain_file(path, xyz, **columns):
    write_ply(path, {"vertex": join_columns(dict(zip("xyz", xyz.T, strict=True)) | columns)})
    return path


def vertices(path):
    return read_ply(path)["vertex"]


def stacked(rows, names):
    return np.stack([rows[name] for name in names], axis=1).astype(float)


# Which points -----------------------------------------------------------------------------------------------------


def test_remove_and_extract_share_the_rows_between_them(scene, splats, tmp_path):
    rows, mine = vertices(splats), scene.instance_ids == 3
    removed = og.edit.remove(scene, 3, tmp_path / "without.ply", cloud=splats)
    extracted = og.edit.extract(scene, 3, tmp_path / "alone.ply", cloud=splats)
    np.testing.assert_array_equal(vertices(removed.path), rows[~mine])
    np.testing.assert_array_equal(vertices(extracted.path), rows[mine])
    assert (removed.points, removed.changed, removed.instances, removed.notes) == ((~mine).sum(), mine.sum(), (3,), ())
    assert (extracted.points, extracted.changed) == (mine.sum(), mine.sum())
    assert read_ply(removed.path)["extra"]["a"].tolist() == [0, 1]
    assert b"comment edited by og-pointcloud" in removed.path.read_bytes()[:200]


def test_every_way_to_say_what(scene, splats, tmp_path):
    """A word, ids, a click, a match and a selection take the points that the scene says are theirs."""
    place = scene.xyz[np.flatnonzero(scene.instance_ids == 2)[5]]
    selection = og.select(scene, WORDS[1])
    assert selection.instances
    meant = [
        (WORDS[1], selection.instances), (selection, selection.instances), (selection[0], [selection[0].instance]),
        (og.pick(scene, place), [2]), ([5, 2, 5], [5, 2]), (np.int32(1), [1]), (np.array([0, 1]), [0, 1]),
    ]  # fmt: skip
    rows = vertices(splats)
    for what, ids in meant:
        done = og.edit.extract(scene, what, tmp_path / "out.ply", cloud=splats)
        assert done.instances == tuple(ids)
        np.testing.assert_array_equal(vertices(done.path), rows[np.isin(scene.instance_ids, ids)])


@pytest.mark.parametrize("what", [-1, 9, [], [0, 44], [0.0], True, [True], 3.0, None])
def test_what_is_no_instance_is_refused(scene, splats, tmp_path, what):
    with pytest.raises(OgPointcloudError, match="ids from 0 to 8"):
        og.edit.remove(scene, what, tmp_path / "out.ply", cloud=splats)
    assert not (tmp_path / "out.ply").exists()


def test_a_click_that_missed_and_a_word_that_fits_nothing_are_refused(scene, splats, tmp_path):
    with pytest.raises(OgPointcloudError, match="the click hit no point of the scene; expected an instance to edit"):
        og.edit.remove(scene, og.pick(scene, FAR + 500), tmp_path / "out.ply", cloud=splats)
    nothing = og.select(scene, {"moon": -scene.vocabulary.vectors.sum(axis=0)})
    assert not nothing.fitting
    with pytest.raises(OgPointcloudError, match=r"'moon' fits none of 9 instances.*pass an id"):
        og.edit.remove(scene, nothing, tmp_path / "out.ply", cloud=splats)


def test_what_was_found_in_another_scene_is_refused(scene, splats, tmp_path):
    other = LabelledScene.from_cloud(room(700, seed=4))
    selection = og.select(other, WORDS[1])
    hit = og.pick(other, other.xyz[np.flatnonzero(other.instance_ids == 2)[0]])
    for what in (selection, selection[0], hit):
        with pytest.raises(OgPointcloudError, match=f"the {type(what).__name__} .* expected one from this scene"):
            og.edit.remove(scene, what, tmp_path / "out.ply", cloud=splats)
    again = LabelledScene.from_cloud(replace(scene.cloud))
    assert og.edit.remove(again, og.select(scene, WORDS[1]), tmp_path / "out.ply", cloud=splats).instances


def test_without_a_cloud_the_scenes_own_points_are_edited(scene, tmp_path):
    done = og.edit.remove(scene, [0, 1], tmp_path / "out.ply")
    points = og.read_points(done.path)
    kept = ~np.isin(scene.instance_ids, [0, 1])
    np.testing.assert_allclose(points.xyz_world, scene.xyz[kept], atol=1e-4)
    np.testing.assert_array_equal(points.rgb, scene.cloud.rgb[kept])


def test_another_cloud_takes_the_instances_of_the_nearest_points(scene, tmp_path):
    random = np.random.default_rng(0)
    order = random.permutation(len(scene.xyz))
    for xyz in (scene.xyz[order], np.concatenate([scene.xyz[::2], [FAR + 90]])):
        source = plain_file(tmp_path / "other.ply", xyz)
        done = og.edit.extract(scene, 3, tmp_path / "out.ply", cloud=source)
        expected = xyz[scene.instances_at(xyz) == 3]
        np.testing.assert_array_equal(stacked(vertices(done.path), "xyz"), expected)
        assert len(expected) > 10
        assert "took the instance of the nearest scene point" in done.notes[0]
    with pytest.raises(OgPointcloudError, match="none of its 900 points lies within"):
        og.edit.remove(scene, 3, tmp_path / "out.ply", cloud=plain_file(tmp_path / "far.ply", scene.xyz - FAR))


def test_halo_takes_unlabelled_points_near_the_object_alone(scene, splats, tmp_path):
    halo = 3.0
    done = og.edit.extract(scene, 8, tmp_path / "out.ply", cloud=splats, halo=halo)
    ids, xyz = scene.instance_ids, scene.xyz
    own = xyz[ids == 8]
    near = np.array([np.linalg.norm(own - place, axis=1).min() for place in xyz]) <= halo * scene.cloud.spacing
    expected = (ids == 8) | (near & (ids < 0))
    assert (ids == 8).sum() < expected.sum() < ((ids == 8) | near).sum()
    np.testing.assert_allclose(stacked(vertices(done.path), "xyz"), xyz[expected], atol=1e-4)
    for halo in (-1, np.nan, "1"):
        with pytest.raises(OgPointcloudError, match=f"halo is {halo}"):
            og.edit.extract(scene, 8, tmp_path / "x.ply", halo=halo)


def test_nothing_and_everything_are_refused(scene, tmp_path):
    part = plain_file(tmp_path / "part.ply", scene.xyz[scene.instance_ids == 3])
    with pytest.raises(OgPointcloudError, match="belongs to instance 0"):
        og.edit.remove(scene, 0, tmp_path / "out.ply", cloud=part)
    with pytest.raises(OgPointcloudError, match="would be removed"):
        og.edit.remove(scene, 3, tmp_path / "out.ply", cloud=part)
    assert not (tmp_path / "out.ply").exists()


# Files ------------------------------------------------------------------------------------------------------------


def test_originals_are_never_overwritten(scene, splats, tmp_path):
    before = splats.read_bytes()
    (tmp_path / "link.ply").symlink_to(splats)
    for output in (splats, tmp_path / "link.ply", tmp_path / "." / "splats.ply"):
        with pytest.raises(OgPointcloudError, match="inputs are kept"):
            og.edit.remove(scene, 3, output, cloud=splats)
        with pytest.raises(OgPointcloudError, match="inputs are kept"):
            og.edit.insert(plain_file(tmp_path / "p.ply", scene.xyz), splats, output)
    with pytest.raises(OgPointcloudError, match=r"ends in \.ply"):
        og.edit.remove(scene, 3, tmp_path / "out.npz", cloud=splats)
    assert splats.read_bytes() == before


def test_a_mesh_loses_its_faces_and_says_so(scene, tmp_path):
    source = plain_file(tmp_path / "mesh.ply", scene.xyz.astype(np.float32))
    head, _, data = source.read_bytes().partition(b"end_header\n")
    face = b"element face 1\nproperty list uchar int vertex_indices\n"
    source.write_bytes(head + face + b"end_header\n" + data + bytes([3]) + np.arange(3, dtype="<i4").tobytes())
    done = og.edit.remove(scene, 3, tmp_path / "out.ply", cloud=source)
    assert done.notes == (f"{source}: faces and other lists are left out",)
    assert b"face" not in done.path.read_bytes()[:300]


@pytest.mark.parametrize(
    "content", [b"", b"hello", b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n"]
)
def test_a_cloud_that_cannot_be_read_is_named(scene, tmp_path, content):
    (tmp_path / "bad.ply").write_bytes(content)
    with pytest.raises(SceneError, match=r"bad\.ply"):
        og.edit.remove(scene, 3, tmp_path / "out.ply", cloud=tmp_path / "bad.ply")
    with pytest.raises(SceneError, match=r"missing\.ply"):
        og.edit.remove(scene, 3, tmp_path / "out.ply", cloud=tmp_path / "missing.ply")


# Colors ----------------------------------------------------------------------------------------------------------


def real_harmonics(directions, count):
    """(n, count + 1) by associated Legendre functions with the Condon-Shortley sign."""
    x, y, z = directions.T
    azimuth, columns = np.arctan2(y, x), []
    for degree in range(math.isqrt(count + 1)):
        for m in range(-degree, degree + 1):
            share = math.factorial(degree - abs(m)) / math.factorial(degree + abs(m))
            legendre = np.sqrt((2 * degree + 1) / (4 * np.pi) * share) * lpmv(abs(m), degree, z)
            wave = np.cos(m * azimuth) if m >= 0 else np.sin(-m * azimuth)
            columns.append(legendre * wave * (np.sqrt(2) if m else 1))
    return np.stack(columns, axis=1)


def colors_seen(rows, directions, most=None):
    """(directions, n, 3) colors of a 3DGS file's splats, straight from the definition. most: harmonics that count."""
    count = sum(name.startswith("f_rest_") for name in rows.dtype.names) // 3
    base = stacked(rows, BASE)[:, :, None]
    rest = stacked(rows, [f"f_rest_{k}" for k in range(3 * count)]).reshape(-1, 3, count) if count else base[:, :, :0]
    known = np.concatenate([base, rest[:, :, :most]], axis=2)
    return 0.5 + np.einsum("nck,dk->dnc", known, real_harmonics(directions, known.shape[2] - 1))


def some_directions(count=20):
    directions = np.random.default_rng(1).normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def test_recolored_splats_shine_in_the_new_color_from_everywhere(scene, splats, tmp_path):
    rows, mine = vertices(splats), scene.instance_ids == 3
    done = og.edit.recolor(scene, 3, tmp_path / "out.ply", (200, 100, 20), cloud=splats)
    after = vertices(done.path)
    np.testing.assert_array_equal(after[~mine], rows[~mine])
    for name in set(rows.dtype.names) - {*BASE, *(f"f_rest_{k}" for k in range(45))}:
        np.testing.assert_array_equal(after[name], rows[name])
    color, luminance = np.array([200, 100, 20]) / 255, np.array([0.2126, 0.7152, 0.0722])
    mean = (np.clip(0.5 + SH_CONSTANT * stacked(rows, BASE)[mine], 0, 1) @ luminance).mean()
    before, now = colors_seen(rows[mine], some_directions()), colors_seen(after[mine], some_directions())
    np.testing.assert_allclose(now, (before @ luminance)[..., None] / mean * color, atol=1e-5)


def test_a_splat_without_a_color_takes_that_of_no_other(scene, splats, tmp_path):
    rows, (lost, *others) = vertices(splats), np.flatnonzero(scene.instance_ids == 3)
    rows["f_dc_0"][lost] = np.nan  # as training leaves some
    write_ply(tmp_path / "nan.ply", {"vertex": rows})
    done = og.edit.recolor(scene, 3, tmp_path / "out.ply", (200, 100, 20), cloud=tmp_path / "nan.ply")
    color, luminance = np.array([200, 100, 20]) / 255, np.array([0.2126, 0.7152, 0.0722])
    before, now = (0.5 + SH_CONSTANT * stacked(of, BASE)[others] for of in (rows, vertices(done.path)))
    mean = (np.clip(before, 0, 1) @ luminance).mean()
    np.testing.assert_allclose(now, (before @ luminance)[:, None] / mean * color, atol=1e-5)


def test_recolored_plain_cloud(scene, tmp_path):
    random, mine = np.random.default_rng(0), scene.instance_ids == 3
    grey = random.integers(60, 180, len(scene.xyz))
    rgb = dict.fromkeys(("red", "green", "blue"), grey.astype(np.uint8))
    normals = {name: random.normal(size=len(grey)).astype(np.float32) for name in ("nx", "ny", "nz")}
    source = plain_file(tmp_path / "plain.ply", scene.xyz.astype(np.float32), **normals, **rgb)
    done = og.edit.recolor(scene, 3, tmp_path / "out.ply", (250, 0, 120), cloud=source)
    after, rows = vertices(done.path), vertices(source)
    np.testing.assert_array_equal(after[~mine], rows[~mine])
    assert after.dtype == rows.dtype
    new = stacked(after, rgb)[mine]
    shading = grey[mine] / grey[mine].mean()
    np.testing.assert_allclose(new, np.minimum(shading[:, None] * [250, 0, 120], 255), atol=0.51)


@pytest.mark.parametrize("shade", [0, 5])
def test_a_dark_object_takes_the_new_color_too(scene, splats, tmp_path, shade):
    mine, color = scene.instance_ids == 3, [200, 100, 20]
    dark = dict.fromkeys(("red", "green", "blue"), np.full(len(scene.xyz), shade, np.uint8))
    plain = plain_file(tmp_path / "dark.ply", scene.xyz, **dark)
    done = og.edit.recolor(scene, 3, tmp_path / "out.ply", color, cloud=plain)
    np.testing.assert_array_equal(stacked(vertices(done.path), dark)[mine], np.tile(color, (mine.sum(), 1)))
    rows = vertices(splats)
    for name in BASE:
        rows[name] = (shade / 255 - 0.5) / SH_CONSTANT
    write_ply(tmp_path / "splats_dark.ply", {"vertex": rows})
    done = og.edit.recolor(scene, 3, tmp_path / "out.ply", color, cloud=tmp_path / "splats_dark.ply")
    now = 0.5 + SH_CONSTANT * stacked(vertices(done.path), BASE)
    np.testing.assert_allclose(255 * now[mine], np.tile(color, (mine.sum(), 1)), atol=1e-3)


def test_colors_of_other_types_become_bytes_and_missing_ones_grey(scene, tmp_path):
    mine, n = scene.instance_ids == 3, len(scene.xyz)
    half = dict.fromkeys(("r", "g", "b"), np.linspace(0, 1, n).astype(np.float32))
    for columns, others in ((half, np.rint(np.linspace(0, 255, n))), ({}, np.full(n, 128))):
        source = plain_file(tmp_path / "plain.ply", scene.xyz, **columns)
        done = og.edit.recolor(scene, 3, tmp_path / "out.ply", (90, 80, 70), cloud=source)
        rgb = og.read_points(done.path).rgb
        np.testing.assert_allclose(rgb[~mine], np.repeat(others[~mine, None], 3, axis=1), atol=1)
        np.testing.assert_allclose(rgb[mine].mean(axis=0), [90, 80, 70], atol=1)
        assert set(vertices(done.path).dtype.names) == {*"xyz", "red", "green", "blue"}


@pytest.mark.parametrize("color", [(1, 2), (1, 2, 256), (-1, 0, 0), (np.nan, 0, 0)])
def test_a_color_that_is_none_is_refused(scene, tmp_path, color):
    with pytest.raises(OgPointcloudError, match="0 to 255"):
        og.edit.recolor(scene, 3, tmp_path / "out.ply", color)


@pytest.mark.parametrize("color", [(1.0, 0, 0), (1.0, 1.0, 1.0), (0.5, 0.2, 0), (127.5, 0, 0)])
def test_a_color_of_another_scale_is_refused(scene, tmp_path, color):
    with pytest.raises(OgPointcloudError, match=r"color is .*; expected whole numbers: scale to 0..255"):
        og.edit.recolor(scene, 3, tmp_path / "out.ply", color)
    for right in ((1, 0, 0), (40.0, 70.0, 220.0), (0.0, 0.0, 0.0)):
        assert og.edit.recolor(scene, 3, tmp_path / "out.ply", right).changed


# Insertion --------------------------------------------------------------------------------------------------------


def similarity(scale=1.0, seed=0):
    pose = np.eye(4)
    pose[:3, :3] = scale * Rotation.random(random_state=seed).as_matrix()
    pose[:3, 3] = [1, -2, 0.5]
    return pose


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_turned_harmonics_are_seen_from_turned_directions(degree):
    count = (degree + 1) ** 2 - 1
    rest = np.random.default_rng(0).normal(size=(7, 3, count))
    rotation = Rotation.random(random_state=degree).as_matrix()
    turned, directions = rotated_harmonics(rest, rotation), some_directions()
    before = real_harmonics(directions, count)[:, 1:] @ rest.transpose(1, 2, 0)
    after = real_harmonics(directions @ rotation.T, count)[:, 1:] @ turned.transpose(1, 2, 0)
    np.testing.assert_allclose(after, before, atol=1e-12)
    np.testing.assert_allclose(rotated_harmonics(rest, np.eye(3)), rest, atol=1e-12)


def test_inserted_splats_stand_in_the_other_frame(tmp_path):
    random = np.random.default_rng(0)
    files = {}
    for name, count, seed in (("base", 30, 1), ("other", 20, 2)):
        files[name] = tmp_path / f"{name}.ply"
        write_ply(files[name], {"vertex": join_columns(gaussian_columns(random.normal(size=(count, 3)), 3, seed))})
    pose = similarity(2.5)
    done = og.edit.insert(files["base"], files["other"], tmp_path / "out.ply", pose)
    base, other, rows = (vertices(path) for path in (files["base"], files["other"], done.path))
    np.testing.assert_array_equal(rows[:30], base)
    new, rotation = rows[30:], pose[:3, :3] / 2.5
    np.testing.assert_allclose(stacked(new, "xyz"), stacked(other, "xyz") @ pose[:3, :3].T + pose[:3, 3], atol=1e-5)
    normals = ("nx", "ny", "nz")
    np.testing.assert_allclose(stacked(new, normals), stacked(other, normals) @ rotation.T, atol=1e-5)
    np.testing.assert_allclose(
        covariances(new), pose[:3, :3] @ covariances(other) @ pose[:3, :3].T, rtol=1e-3, atol=1e-4
    )
    directions = some_directions()
    np.testing.assert_allclose(colors_seen(new, directions @ rotation.T), colors_seen(other, directions), atol=1e-5)
    for name in ("opacity", "ins_feat_r", "label"):
        np.testing.assert_array_equal(new[name], other[name])
    assert (done.points, done.changed, done.notes) == (50, 20, ())


@pytest.mark.parametrize(("base_degree", "other_degree"), [(3, 1), (2, 0), (1, 3), (0, 2)])
def test_inserted_splats_of_another_degree_keep_their_colors(tmp_path, base_degree, other_degree):
    """In a file of degree 1 green begins at f_rest_3, in one of degree 3 at f_rest_15."""
    files = tmp_path / "base.ply", tmp_path / "other.ply"
    for path, degree, seed in zip(files, (base_degree, other_degree), (1, 2), strict=True):
        write_ply(path, {"vertex": join_columns(gaussian_columns(np.eye(3), degree, seed))})
    done = og.edit.insert(*files, tmp_path / "out.ply")
    directions, room_for = some_directions(), (base_degree + 1) ** 2 - 1
    expected = colors_seen(vertices(files[1]), directions, room_for)
    np.testing.assert_allclose(colors_seen(vertices(done.path)[3:], directions), expected, atol=1e-6)
    assert len(done.notes) == (other_degree > base_degree)


def test_inserted_flat_splats_of_two_scales_grow_with_the_pose(tmp_path):
    columns = gaussian_columns(np.eye(3))
    del columns["scale_2"]  # 2DGS has none
    write_ply(tmp_path / "flat.ply", {"vertex": join_columns(columns)})
    rows = vertices(
        og.edit.insert(tmp_path / "flat.ply", tmp_path / "flat.ply", tmp_path / "o.ply", similarity(2.5)).path
    )
    for name in ("scale_0", "scale_1"):
        np.testing.assert_allclose(np.exp(rows[name][3:]), 2.5 * np.exp(rows[name][:3]), rtol=1e-5)


@pytest.mark.parametrize("of_base", ["harmonics", "bytes"])
def test_inserted_splats_keep_their_colors_as_the_base_has_its_own(tmp_path, of_base):
    """nerfstudio's exporter writes harmonics, or red green blue in their place."""
    rgb = np.array([[255, 40, 0], [0, 0, 0], [12, 200, 255]], np.uint8)
    harmonics = gaussian_columns(np.eye(3), 0)
    as_bytes = {name: column for name, column in harmonics.items() if not name.startswith("f_dc_")}
    as_bytes |= dict(zip(("red", "green", "blue"), rgb.T, strict=True))
    for channel in range(3):
        harmonics[f"f_dc_{channel}"] = ((rgb[:, channel] / 255 - 0.5) * math.sqrt(4 * math.pi)).astype(np.float32)
    kinds = [harmonics, as_bytes] if of_base == "harmonics" else [as_bytes, harmonics]
    files = tmp_path / "base.ply", tmp_path / "other.ply"
    for path, columns in zip(files, kinds, strict=True):
        write_ply(path, {"vertex": join_columns(columns)})
    done = og.edit.insert(*files, tmp_path / "out.ply")
    np.testing.assert_array_equal(read_points(done.path).rgb, np.tile(rgb, (2, 1)))
    assert vertices(done.path).dtype == vertices(files[0]).dtype
    assert done.notes == ()


def covariances(rows):
    quaternions = stacked(rows, [f"rot_{k}" for k in (1, 2, 3, 0)])
    axes = (
        Rotation.from_quat(quaternions).as_matrix() * np.exp(stacked(rows, [f"scale_{k}" for k in range(3)]))[:, None]
    )
    return axes @ axes.transpose(0, 2, 1)


@pytest.mark.parametrize("kind", [np.float32, np.int32])
def test_inserted_points_keep_their_places_in_map_coordinates(tmp_path, kind):
    """float32 has steps of half a meter at 4e6, whole numbers of one."""
    random, away = np.random.default_rng(0), np.array([5e5, 4e6, 20])
    base = plain_file(tmp_path / "base.ply", (50 * random.normal(size=(30, 3)) + away).astype(kind))
    other = plain_file(tmp_path / "other.ply", random.random((20, 3)).astype(np.float32))
    pose = np.eye(4)
    pose[:3, 3] = away
    rows = vertices(og.edit.insert(base, other, tmp_path / "out.ply", pose).path)
    np.testing.assert_array_equal(stacked(rows[:30], "xyz"), stacked(vertices(base), "xyz"))
    np.testing.assert_allclose(stacked(rows[30:], "xyz"), stacked(vertices(other), "xyz") + away, rtol=0, atol=1e-4)


def test_properties_that_only_one_has_are_told(tmp_path):
    random = np.random.default_rng(0)
    base = plain_file(tmp_path / "base.ply", random.random((4, 3)), curvature=np.ones(4, np.float32))
    other = plain_file(tmp_path / "other.ply", random.random((3, 3)), label=np.ones(3, np.int32))
    done = og.edit.insert(base, other, tmp_path / "out.ply")
    assert vertices(done.path)["curvature"].tolist() == [1] * 4 + [0] * 3
    assert done.notes == (
        "curvature are 0 for the inserted points, which lack them",
        "label of the inserted points are left out: the cloud does not have them",
    )


@pytest.mark.parametrize("kept", [np.uint8, np.uint32, np.float32])
@pytest.mark.parametrize("added", [np.int32([300, -1]), np.float32([0.5, 7])])
def test_inserted_values_that_the_clouds_type_cannot_hold_widen_it(tmp_path, kept, added):
    base = plain_file(tmp_path / "base.ply", np.eye(3), label=np.array([1, 2, 255], kept))
    other = plain_file(tmp_path / "other.ply", np.eye(2, 3), label=added)
    done = og.edit.insert(base, other, tmp_path / "out.ply")
    assert vertices(done.path)["label"].tolist() == [1, 2, 255, *added]
    assert any("label have a wider type" in note for note in done.notes) == (kept != np.float32)


@pytest.mark.parametrize("other", [
    {"red": np.float32([1.0]), "green": np.float32([0.2]), "blue": np.float32([0])},
    {"r": np.uint8([255]), "g": np.uint8([51]), "b": np.uint8([0])},
    {"rgb": np.uint32([0xFF3300])},
], ids=["floats", "other names", "packed"])  # fmt: skip
@pytest.mark.parametrize("turned_about", [False, True])
def test_colors_of_other_types_stay_what_they_are(tmp_path, other, turned_about):
    ours = {name: np.uint8([value, value]) for name, value in zip(("red", "green", "blue"), (10, 20, 30), strict=True)}
    two, one = (
        plain_file(tmp_path / "a.ply", np.eye(2, 3), **ours),
        plain_file(tmp_path / "b.ply", np.ones((1, 3)), **other),
    )
    base, added = (one, two) if turned_about else (two, one)
    og.edit.insert(base, added, tmp_path / "c.ply")
    expected = [[10, 20, 30], [10, 20, 30], [255, 51, 0]]
    expected = expected[2:] + expected[:2] if turned_about else expected
    np.testing.assert_array_equal(og.read_points(tmp_path / "c.ply").rgb, expected)


def test_plain_points_and_splats_do_not_mix(tmp_path):
    plain, splats = plain_file(tmp_path / "plain.ply", np.eye(3)), tmp_path / "splats.ply"
    write_ply(splats, {"vertex": join_columns(gaussian_columns(np.eye(3)))})
    for pair in ((plain, splats), (splats, plain)):
        with pytest.raises(SceneError, match="expected the same kind"):
            og.edit.insert(*pair, tmp_path / "out.ply")


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        (np.diag([1, 1, 2, 1]), "shears or mirrors"),
        (np.diag([-1, 1, 1, 1]), "shears or mirrors"),
        (np.diag([0, 0, 0, 1]), "shears or mirrors"),
        (np.eye(3), "expected a finite 4x4"),
        (np.diag([1, 1, 1, 2]), "expected 0 0 0 1"),
        (np.full((4, 4), np.nan), "finite"),
    ],
)
def test_poses_that_splats_cannot_follow_are_refused(tmp_path, pose, message):
    path = plain_file(tmp_path / "p.ply", np.eye(3))
    with pytest.raises(SceneError, match=message):
        og.edit.insert(path, path, tmp_path / "out.ply", pose)


# The command line -------------------------------------------------------------------------------------------------


def test_commands(scene, splats, tmp_path, capsys):
    bundle = og.write_bundle(scene.cloud, tmp_path / "room.ogpc")
    edit = partial(output_of, capsys, "edit")
    place = ",".join(map(str, scene.xyz[np.flatnonzero(scene.instance_ids == 2)[0]]))
    out = tmp_path / "new" / "out.ply"
    record = json.loads(edit("remove", bundle, "--id", "3,5", "--cloud", splats, "-o", out, "--json"))
    assert record["instances"] == [3, 5]
    assert record["changed"] == np.isin(scene.instance_ids, [3, 5]).sum() == len(scene.xyz) - record["points"]
    removed = edit("remove", bundle, "--id", "3,5", "--cloud", splats, "-o", out)
    assert "points removed (instances 3, 5)" in removed
    extracted = edit("extract", bundle, f"--xyz={place}", "--cloud", splats, "-o", tmp_path / "two.ply")
    assert "points extracted (instance 2)" in extracted
    recolor = ("recolor", bundle, "--word", WORDS[1], "-o", tmp_path / "c.ply", "--color")
    for color in ("1,1,1", "0,0,1.0", "90,80,70"):
        edit(*recolor, color)
    thing = np.isin(scene.instance_ids, og.select(scene, WORDS[1]).instances)
    recolored = og.read_points(tmp_path / "c.ply").rgb[thing]
    assert "expected whole numbers: scale to 0..255" in error_of(capsys, "edit", *recolor, "0.5,1,0")
    brightness = recolored.mean(axis=0) / [90, 80, 70]  # of a nearly black object: the hue is the new one, in the dark
    np.testing.assert_allclose(brightness, brightness.mean(), rtol=0.03)


def test_objects_go_in_and_out_as_spz(scene, splats, tmp_path, capsys):
    bundle = og.write_bundle(scene.cloud, tmp_path / "room.ogpc")
    done = partial(output_of, capsys)
    thing, rest = tmp_path / "two.spz", tmp_path / "rest.spz"
    said = done("edit", "extract", bundle, "--id", "2", "--cloud", splats, "-o", thing)
    assert "note: SPZ: harmonics above the constant one" in said
    own, packed = og.read_points(splats), og.read_points(thing)
    chosen = scene.instance_ids == 2
    np.testing.assert_allclose(
        packed.xyz_world, own.xyz_world[chosen], atol=7e-5
    )  # half a step of 2^-13, as far as 1000 from 0
    np.testing.assert_allclose(packed.opacity, own.opacity[chosen], atol=0.5 / 255 + 1e-6)
    done("segment", bundle, "--points", splats, "-o", tmp_path / "all.spz")
    labels = og.segment(bundle).colors
    assert np.abs(og.read_points(tmp_path / "all.spz").rgb.astype(int) - labels).max() <= 2
    done("edit", "remove", bundle, "--id", "2", "--cloud", tmp_path / "all.spz", "-o", rest)
    assert len(og.read_points(rest)) == (~chosen).sum()
    for command, says in (
        (["segment", bundle], "stores only splats; expected those that were labelled (--points"),
        (["edit", "extract", bundle, "--id", "2"], "plain.spz stores only splats, the cloud has plain points"),
    ):
        assert says in error_of(capsys, *command, "-o", tmp_path / "plain.spz")


def test_splats_that_are_not_finite_are_left_out_of_spz(scene, splats, tmp_path, capsys):
    bundle = og.write_bundle(scene.cloud, tmp_path / "room.ogpc")
    rows = read_ply(splats)["vertex"]
    row = int(np.flatnonzero(scene.instance_ids == 2)[0])
    rows["scale_1"][row] = np.nan
    write_ply(splats, {"vertex": rows})
    asked = "edit", "extract", bundle, "--id", "2", "--cloud", splats, "-o", tmp_path / "two.spz"
    assert f"1 of {(scene.instance_ids == 2).sum()} Gaussians are not finite" in output_of(capsys, *asked)
    assert len(og.read_points(tmp_path / "two.spz")) == (scene.instance_ids == 2).sum() - 1
    code, _, told = run(capsys, "segment", bundle, "--points", splats, "-o", tmp_path / "all.spz")
    assert (code, f"(the first is row {row}, in its scale): left out" in told) == (0, True)
    labels = np.delete(og.segment(bundle).colors, row, axis=0)
    assert np.abs(og.read_points(tmp_path / "all.spz").rgb.astype(int) - labels).max() <= 2


def test_wrong_commands_name_what_is_wrong(scene, splats, tmp_path, capsys):
    bundle = og.write_bundle(make_cloud([[0, 0, 0], [1, 0, 0]], [0, 1]), tmp_path / "two.ogpc")
    out = str(tmp_path / "out.ply")
    for words, message in (
        (["remove", str(bundle), "--id", "one", "-o", out], "--id is 'one'"),
        (["remove", str(bundle), "--id", "0", "--cloud", str(splats), "-o", str(splats)], "which is an input"),
        (["recolor", str(bundle), "--id", "0", "--color", "1,2", "-o", out], "--color"),
    ):
        assert message in error_of(capsys, "edit", *words)
