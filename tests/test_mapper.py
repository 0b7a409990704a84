"""Maps that grow frame by frame: the same as a fit, kept safe, unharmed by bad frames, aware of what changes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from labelled_clouds import room
from scenes import write_ply
from visits import BIN, CHEST, CRATE, PARCEL, SPACE, Thing, cameras, cast, frames, instance_of, moved, scene, surface

import og_pointcloud as og
from og_pointcloud.errors import FeatureSpaceError, OgPointcloudError, SceneError
from og_pointcloud.mapping.frame_queue import FrameQueue
from og_pointcloud.mapping.sight import AGREES, NOTHING, THROUGH, states_of_points, view_of_depth
from og_pointcloud.mapping.tracks import NO_TRACK, PointVotes
from og_pointcloud.mapping.voxels import VoxelPoints
from og_pointcloud.rendering.geometry import neighborhood

THINGS = [CHEST, BIN, CRATE]
ELSEWHERE = moved(CRATE, (-0.9, 0.5, 0.0))


def mapped(given, start=None, **options):
    """A mapper that has taken frames in, and their changes."""
    mapper = og.Mapper(start, feature_space=SPACE, **options) if start is None else og.Mapper(start, **options)
    return mapper, [mapper.integrate(frame) for frame in given]


def without_depth(given):
    return [replace(frame, depth=None) for frame in given]


@pytest.fixture(scope="module")
def grown():
    return mapped(frames(THINGS))


@pytest.mark.slow
def test_a_known_cloud_ends_as_a_fit_does():
    capture = scene(THINGS)
    fitted = og.fit(capture, og.FitSettings(mode="grouping"), progress=False)
    mapper, _ = mapped(without_depth(frames(THINGS)), cloud=capture.points)
    cloud = mapper.snapshot().cloud
    np.testing.assert_array_equal(cloud.xyz, fitted.xyz)
    same = [(fitted.instance_ids == instance_of(fitted, t)) == (cloud.instance_ids == instance_of(cloud, t))
            for t in THINGS]  # fmt: skip
    assert np.mean(same) > 0.99


def test_what_left_a_known_cloud_and_returns_is_there_again():
    mapper, _ = mapped(frames(THINGS), cloud=scene(THINGS).points)
    known = {entry.id: entry.points for entry in mapper.objects()}
    (crate,) = (entry.id for entry in mapper.objects() if np.abs(entry.place[:2] - [0.65, 0.7]).max() < 0.2)
    gone = [change.gone for change in map(mapper.integrate, frames([CHEST, BIN], seed=1, first=100.0))]
    assert sum(gone, ()) == (crate,)
    left = mapper.snapshot().cloud
    back = [change.moved for change in map(mapper.integrate, frames(THINGS, seed=2, first=200.0))]
    assert [move.id for move in sum(back, ())] == [crate]
    objects = {entry.id: entry for entry in mapper.objects()}
    assert {entry.state for entry in objects.values()} == {"present"}, "it stands where it stood"
    assert objects.keys() == known.keys()
    assert abs(objects[crate].points - known[crate]) < 0.1 * known[crate]
    cloud = mapper.snapshot().cloud
    assert len(left) < len(cloud) <= len(scene(THINGS).points)
    assert instance_of(cloud, CRATE) == crate


def test_a_late_frame_brings_nothing_back_to_a_known_cloud():
    mapper, _ = mapped([*frames(THINGS), *frames([CHEST, BIN], seed=1, first=100.0)], cloud=scene(THINGS).points)
    before = mapper.points
    for frame in frames(THINGS, seed=2, first=50.0):
        mapper.integrate(frame)
    assert mapper.points <= before
    assert [entry.state for entry in mapper.objects()].count("gone") == 1


def test_depth_alone_makes_the_points(grown):
    mapper, _ = grown
    cloud = mapper.snapshot().cloud
    assert {instance_of(cloud, thing) for thing in THINGS}.isdisjoint({-1})
    assert len({instance_of(cloud, thing) for thing in THINGS}) == 3
    on_surface = np.abs(cloud.xyz_world[:, 2]) < 0.02
    for thing in THINGS:
        low, size = np.array(thing.low), np.array(thing.size)
        outside = np.maximum(low - cloud.xyz_world, cloud.xyz_world - low - size).max(axis=1)
        on_surface |= np.abs(outside) < 0.02
    assert on_surface.mean() > 0.97
    assert og.segment(mapper.snapshot(), {"chest": cloud.instances.descriptors[0]}).labels.max() == 0


def test_objects_have_the_ids_of_the_snapshot(grown):
    mapper, changes = grown
    cloud, objects = mapper.snapshot().cloud, {entry.id: entry for entry in mapper.objects()}
    for thing in THINGS:
        entry = objects[instance_of(cloud, thing)]
        assert np.abs(entry.place - (np.array(thing.low) + np.array(thing.size) / 2)).max() < 0.2
        assert entry.state == "present"
        points = cloud.xyz_world[cloud.instance_ids == entry.id]
        assert entry.box.contains(points, 0.05).mean() > 0.99
        assert np.abs(entry.box.size - thing.size).max() < 0.1
    assert {*objects} <= {k for change in changes for k in (*change.new, *change.updated)}


def test_the_order_of_frames_hardly_matters():
    given = frames(THINGS)
    shuffled = [given[k] for k in np.random.default_rng(0).permutation(len(given))]
    one, other = (mapped(g, spacing=0.04)[0].snapshot().cloud for g in (given, shuffled))
    for thing in THINGS:
        sizes = [cloud.instances.points[instance_of(cloud, thing)] for cloud in (one, other)]
        assert min(sizes) > 0.7 * max(sizes)


def test_what_is_carried_elsewhere_keeps_its_id():
    first, second = frames(THINGS), frames([CHEST, BIN, ELSEWHERE], seed=1, first=100.0)
    mapper, _ = mapped(first)
    crate = instance_of(mapper.snapshot().cloud, CRATE)
    changes = [mapper.integrate(frame) for frame in second]
    assert [k for change in changes for k in change.gone] == [crate]
    assert [entry.id for change in changes for entry in change.moved] == [crate]
    cloud = mapper.snapshot().cloud
    assert instance_of(cloud, ELSEWHERE) == crate
    assert instance_of(cloud, CRATE) == -1


def test_what_left_is_said_to_have_stood_where_all_of_it_did():
    """A thing twice as high as wide: its lower half is not seen through yet when most of what shows has left."""
    high = replace(BIN, size=(0.4, 0.4, 1.2))
    mapper, _ = mapped(frames([CHEST, high, CRATE]))
    known = instance_of(mapper.snapshot().cloud, high)
    (stood,) = (entry.place for entry in mapper.objects() if entry.id == known)
    views = cameras()
    for frame in frames([CHEST, CRATE], [*views[2:], *views[:2]][::3], seed=1, first=100.0):
        mapper.integrate(frame)
    (gone,) = (entry for entry in mapper.objects() if entry.state == "gone")
    assert gone.id == known
    assert np.linalg.norm(gone.place - stood) < 0.1
    assert np.abs(gone.box.center - (np.array(high.low) + np.array(high.size) / 2)).max() < 0.1


def test_frames_of_before_do_not_bring_back_what_has_left_since():
    """They come late, through another queue, say: what they add was seen through in later frames."""
    mapper, _ = mapped(frames(THINGS))
    crate = instance_of(mapper.snapshot().cloud, CRATE)
    for frame in frames([CHEST, BIN], seed=1, first=100.0):
        mapper.integrate(frame)
    points, last_seen = mapper.points, {entry.id: entry.last_seen for entry in mapper.objects()}
    changes = [mapper.integrate(frame) for frame in frames(THINGS, seed=2, first=50.0)]
    assert all(change.new == change.moved == () for change in changes)
    assert instance_of(mapper.snapshot().cloud, CRATE) == -1
    assert mapper.points < 1.01 * points
    assert {entry.id: entry.last_seen for entry in mapper.objects()} == last_seen
    changes = [mapper.integrate(frame) for frame in frames(THINGS, seed=3, first=200.0)]
    assert [entry.id for change in changes for entry in change.moved] == [crate]


def test_a_missed_detection_removes_nothing():
    mapper, _ = mapped(frames(THINGS))
    blind = [replace(frame, masks=None, features=None, stamp=50.0 + k) for k, frame in enumerate(frames(THINGS))]
    assert all(mapper.integrate(frame).gone == () for frame in blind)
    assert {instance_of(mapper.snapshot().cloud, thing) for thing in THINGS}.isdisjoint({-1})


@pytest.mark.slow
def test_a_map_is_gone_on_with():
    before = og.fit(scene(THINGS), progress=False)
    mapper, _ = mapped(frames([CHEST, ELSEWHERE, PARCEL], seed=1, first=10.0), before)
    cloud = mapper.snapshot().cloud
    changes = mapper.changes
    assert changes.gone == (instance_of(before, BIN),)
    assert [entry.id for entry in changes.moved] == [instance_of(before, CRATE)]
    assert changes.new == (instance_of(cloud, PARCEL),)
    assert instance_of(cloud, CHEST) == instance_of(before, CHEST)


def test_what_comes_into_a_map_that_goes_on_has_one_id(grown, tmp_path):
    came = [PARCEL, Thing((-1.1, 0.9, 0.0), (0.3, 0.3, 0.7), (240, 240, 240), 5),
            Thing((1.0, -0.2, 0.0), (0.35, 0.35, 0.45), (120, 60, 160), 6)]  # fmt: skip
    before, given = grown[0].snapshot(), frames([CHEST, CRATE, *came], seed=1, first=100.0)
    mapper, changes = mapped(given, before, journal=tmp_path / "map")
    cloud, objects = mapper.snapshot().cloud, {entry.id: entry for entry in mapper.objects()}
    new = [instance_of(cloud, thing) for thing in came]
    for thing, known in zip(came, new, strict=True):
        assert np.abs(objects[known].place - (np.array(thing.low) + np.array(thing.size) / 2)).max() < 0.3
    assert mapper.changes.new == tuple(sorted(new)) == changes[1].new
    assert mapper._map.tracks.next_id == len(cloud.instances)
    np.testing.assert_array_equal(
        og.Mapper(before, journal=tmp_path / "map").snapshot().instance_ids, cloud.instance_ids
    )


def test_more_loops_of_one_path_keep_no_more():
    """Each place is kept from one direction a few times at most; here that is full after the second loop."""
    mapper, _ = mapped(frames(THINGS))
    points, held = mapper.points, []
    for _ in range(3):
        for frame in frames(THINGS):
            mapper.integrate(frame)
        held.append(mapper.nbytes)
    assert held[2] == held[1]
    assert mapper.points < 1.01 * points


def lowered(given, by=0.5):
    """The frames with poses that are wrong."""
    off = np.eye(4)
    off[2, 3] = by
    return [replace(f, camera=replace(f.camera, world_to_camera=f.camera.world_to_camera @ off)) for f in given]


def poses_of(given):
    return {frame.stamp: frame.camera.world_to_camera for frame in given}


def test_a_loop_closure_moves_where_things_stood_too():
    """What is gone meanwhile was seen by frames that are corrected; so was the home of what returned."""
    given = [*frames(THINGS), *frames([CHEST, BIN], seed=1, first=100.0)]
    mapper, _ = mapped(lowered(given))
    mapper.correct(poses_of(given))
    (gone,) = (entry for entry in mapper.objects() if entry.state == "gone")
    middle = np.array(CRATE.low) + np.array(CRATE.size) / 2
    assert np.abs([gone.place - middle, gone.box.center - middle]).max() < 0.25
    given += frames(THINGS, seed=2, first=200.0)
    (back,) = (one for frame in given[28:] for one in mapper.integrate(frame).moved)
    assert np.abs([back.before - middle, back.after - middle]).max() < 0.25
    mapper.correct(poses_of(lowered(given)))
    assert {entry.state for entry in mapper.objects()} == {"present"}, "it stands where it stood"


def test_a_loop_closure_moves_what_its_frames_brought():
    given = frames(THINGS)
    mapper, _ = mapped(lowered(given))
    mapper.correct(poses_of(given))
    right, _ = mapped(given)
    np.testing.assert_allclose(
        np.sort(mapper.snapshot().xyz[:, 2])[::50], np.sort(right.snapshot().xyz[:, 2])[::50], atol=0.01
    )
    with pytest.raises(SceneError, match="rotation"):
        mapper.correct({0.0: np.diag([2.0, 2, 2, 1])})
    with pytest.raises(SceneError, match=r"the last row of camera pose is .* expected 0 0 0 1"):
        mapper.correct({0.0: given[0].camera.world_to_camera.T})
    with pytest.raises(SceneError, match="poses are a list; expected a dict"):
        mapper.correct([np.eye(4)])
    with pytest.raises(SceneError, match="a pose is given for frame 'a'; expected the frame's stamp"):
        mapper.correct({"a": np.eye(4)})
    before, pose = mapper._map.points.xyz.copy(), given[0].camera.world_to_camera
    with pytest.raises(SceneError, match=r"stamps 100, 101; expected those of integrated frames, 0 to 13"):
        mapper.correct({100.0: pose, 101.0: pose})
    with pytest.raises(SceneError, match="no frame has been integrated yet"):
        og.Mapper().correct({0.0: pose})
    np.testing.assert_array_equal(mapper._map.points.xyz, before)
    with pytest.warns(UserWarning, match="1 of 2 poses are for frames that were not integrated: 0.5"):
        mapper.correct({0.0: pose, 0.5: pose})


def bad_frames():
    frame = frames(THINGS)[5]
    lifted = frame.camera.world_to_camera.copy()
    lifted[:3, 3] += 1.0
    return {
        "has no camera": replace(frame, camera=None),
        "pose is off": replace(frame, camera=replace(frame.camera, world_to_camera=lifted)),
        "no feature row": replace(frame, features=frame.features[:1]),
        "another encoder": replace(frame, feature_space="another encoder"),
        "dimension 7": replace(frame, features=np.ones((len(frame.features), 7), np.float32)),
        "contains NaN": replace(frame, features=frame.features * np.nan),
        "its depths are about 2000 times what the map expects": replace(frame, depth=2000 * frame.depth),
        r"frame 1700000000.25: mask id \d has no feature row; .*: there are 1": replace(
            frame, features=frame.features[:1], stamp=1_700_000_000.25
        ),
        "mask image is": replace(frame, masks=frame.masks[:-1]),
        "masks are float64": replace(frame, masks=frame.masks.astype(float)),
        "depth is float32": replace(frame, depth=frame.depth[1:]),
        "both depth and a cloud": replace(frame, cloud=np.zeros((3, 3))),
        "points are a ndarray of float64": replace(frame, depth=None, cloud=np.zeros(3)),
        "is not a geometry file|No such file": replace(frame, depth=None, cloud="none.ply"),
        "the mask map contains -5": replace(frame, masks=np.minimum(frame.masks, -5)),
        r"masks are int64 \(4,\)": replace(frame, masks=[1, 2, 3, 4]),
        "its camera is a ndarray": replace(frame, camera=np.eye(4)),
        "a frame is a str; expected an og.Frame": "x",
        "rgb is <U1": replace(frame, rgb="x"),
        "rgb is": replace(frame, rgb=frame.rgb[..., :2]),
        "stamp is nan": replace(frame, stamp=np.nan),
        r"stamp is 1000\d+; expected a finite number": replace(frame, stamp=10**400),
    }


BAD_FRAMES = bad_frames()


@pytest.mark.parametrize(("said", "frame"), BAD_FRAMES.items(), ids=BAD_FRAMES)
def test_a_bad_frame_is_refused_in_words_and_the_map_unharmed(grown, said, frame):
    mapper, _ = grown
    before, points = mapper.snapshot(), mapper.points
    with pytest.raises((SceneError, FeatureSpaceError), match=said):
        mapper.integrate(frame)
    assert mapper.snapshot() is before
    assert mapper.points == points


@pytest.mark.parametrize("said", ["has no camera", "its camera is a ndarray", "a frame is a str; expected an og.Frame"])
def test_a_bad_first_frame_is_refused_in_the_same_words(said):
    with pytest.raises(SceneError, match=said):
        og.Mapper().integrate(BAD_FRAMES[said])


def test_a_map_takes_over_the_encoder_that_a_frame_names():
    given = frames(THINGS)[:4]
    for mapper in (og.Mapper(), og.Mapper(replace(mapped(given)[0].snapshot().cloud, feature_space="unknown"))):
        mapper.integrate(given[0])
        mapper.integrate(replace(given[1], feature_space="clip"))
        mapper.integrate(given[2])  # does not say
        with pytest.raises(FeatureSpaceError, match=r"'siglip'.*; expected feature space 'clip'"):
            mapper.integrate(replace(given[3], feature_space="siglip"))
        assert mapper.snapshot().cloud.feature_space == "clip"


def test_a_pose_that_float32_rounded_is_told():
    frame = frames(THINGS)[0]
    mapped_camera = og.in_world(frame.camera, (431234.567, 5412345.678, 312.345))
    og.Mapper(feature_space=SPACE).integrate(replace(frame, camera=mapped_camera))
    rounded = replace(mapped_camera, world_to_camera=mapped_camera.world_to_camera.astype(np.float32))
    with pytest.warns(UserWarning, match="frames may be placed wrongly; float32 rounded the pose to steps of"):
        og.Mapper(feature_space=SPACE).integrate(replace(frame, camera=rounded))


def test_a_frame_farther_off_than_voxels_are_counted_is_refused():
    """As by a robot that begins at 0 and then gets its place in UTM: all its readings would share one voxel."""
    given = frames(THINGS)
    mapper, _ = mapped(given[:4], spacing=0.04)
    points, far = mapper.points, og.in_world(given[4].camera, (431234.5, 5412345.6, 312.3))
    with pytest.raises(SceneError, match=r"frame 4 stands 5\.41e\+06 from where the map began; .* at most 4\.19e\+04"):
        mapper.integrate(replace(given[4], camera=far))
    assert mapper.points == points
    mapper.integrate(given[4])


def test_a_camera_close_to_a_wall_is_of_the_place():
    """Most of the map before it lies behind the wall."""
    x, y = (grid.ravel() for grid in np.meshgrid(np.linspace(-1, 1, 60), np.linspace(-1, 1, 60)))
    walls = [np.stack([x * z, y * z, np.full(3600, float(z))], axis=-1) for z in range(1, 9)]
    camera = og.Camera(64, 48, 40.0, 40.0, 32.0, 24.0, np.eye(4))
    depth = np.ones((48, 64), np.float32)
    og.Mapper(cloud=np.concatenate(walls)).integrate(og.Frame(camera, depth=depth))
    with pytest.raises(SceneError, match="confirms 0% of"):
        og.Mapper(cloud=np.concatenate(walls)).integrate(og.Frame(camera, depth=5 * depth))


def test_rows_of_a_cloud_that_lie_nowhere_are_left_out():
    cloud = np.array([[0, 0, 1], [np.nan, 0, 1], [0, 1, 1], [0, np.inf, 1], [1, 0, 1]])
    with pytest.warns(UserWarning, match="2 of 5 points contain NaN or infinity: the map leaves them out") as said:
        assert og.Mapper(cloud=cloud).points == 3
    assert said[0].filename == __file__
    with pytest.warns(UserWarning, match="1 of 1 points"), pytest.raises(SceneError, match="the cloud has 0 points"):
        og.Mapper(cloud=cloud[1:2])


def test_a_file_is_known_with_its_colors(tmp_path):
    colors = np.array([[10, 20, 30], [40, 50, 60], [70, 80, 90]], np.uint8)
    write_ply(tmp_path / "cloud.ply", np.array([[0, 0, 1], [np.nan, 0, 1], [0, 1, 1]]), colors)
    with pytest.warns(UserWarning, match="1 of 3 points contain NaN or infinity .*: left out") as said:
        known = og.Mapper(cloud=tmp_path / "cloud.ply")._map
    assert len(said) == 1
    assert sorted(known.points.rgb.tolist()) == colors[::2].tolist()


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_an_outlier_of_a_known_cloud_does_no_harm():
    xyz = surface(THINGS)[0]
    more = np.concatenate([xyz, [[1e30, 0, 0], [0, -3e38, 0]]])
    one, other = (mapped(frames(THINGS)[:4], cloud=points)[0].snapshot().cloud for points in (xyz, more))
    np.testing.assert_array_equal(other.instance_ids[: len(xyz)], one.instance_ids)
    assert (other.instance_ids[len(xyz) :] < 0).all()


def test_what_is_no_scene_no_cloud_and_no_settings_is_refused(tmp_path):
    with pytest.raises(OgPointcloudError, match="settings is a str; expected an"):
        og.Mapper(settings="grouping")
    for known in ({"start": room(500)}, {"cloud": np.eye(3)}):
        with pytest.raises(SceneError, match=r"spacing is 0\.5, but a map or a cloud is given"):
            og.Mapper(spacing=0.5, **known)
    with pytest.raises(FeatureSpaceError, match="by feature_space, are in feature space 'another/encoder'; expected"):
        og.Mapper(room(500), feature_space="another/encoder")
    with pytest.raises(SceneError, match=r"points are a list of <U1 \(1, 3\)"):
        og.Mapper(cloud=[["a", "b", "c"]])
    for spacing in ("1", True):
        with pytest.raises(SceneError, match=f"spacing is {spacing!r}; expected a positive length"):
            og.Mapper(spacing=spacing)
    np.save(tmp_path / "cloud.npy", np.zeros((3, 3)))
    with pytest.raises(SceneError, match=r"cloud\.npy: not a geometry file"):
        og.Mapper(cloud=tmp_path / "cloud.npy")


def test_masks_without_any_geometry_are_refused():
    with pytest.raises(SceneError, match="no points yet"):
        og.Mapper().integrate(without_depth(frames(THINGS))[0])
    with pytest.raises(SceneError, match="no frame with masks has shown any point"):
        og.Mapper().snapshot()


@pytest.mark.slow
def test_sparse_depth_makes_a_map():
    random = np.random.default_rng(0)
    sparse = [
        replace(f, depth=np.where(random.random(f.depth.shape) < 0.05, f.depth, 0)) for f in frames(THINGS, cameras(40))
    ]
    mapper, _ = mapped(sparse, spacing=0.05)
    cloud = mapper.snapshot().cloud
    assert len({instance_of(cloud, thing) for thing in THINGS} - {-1}) == 3


def test_readings_between_two_surfaces_are_no_points():
    camera = og.Camera(64, 48, 60.0, 60.0, 32.0, 24.0, np.eye(4))
    depth = np.where(np.arange(64) < 32, 2.0, 3.0)[None].repeat(48, axis=0)
    without, flying = depth.copy(), depth.copy()
    without[::5, 32], flying[::5, 32] = 0, 2.5
    counts = []
    for image in (without, flying, depth):
        mapper = og.Mapper(spacing=0.02)
        mapper.integrate(og.Frame(camera, depth=image))
        counts.append(mapper.points)
    assert counts[0] == counts[1] < counts[2]


def test_whole_numbers_of_depth_are_millimeters_and_the_largest_is_no_reading():
    camera, points = og.Camera(64, 48, 60.0, 60.0, 32.0, 24.0, np.eye(4)), []
    depth = np.full((48, 64), 2.0)
    depth[:, 40:] = np.nan
    for image in (depth, np.where(np.isnan(depth), 65535, 2000).astype(np.uint16)):
        mapper = og.Mapper(spacing=0.05)
        mapper.integrate(og.Frame(camera, depth=image))
        points.append(mapper._map.points.xyz)
    np.testing.assert_array_equal(*points)


def test_a_shelf_seen_at_a_slant_alone_becomes_points():
    """Its top lies 8 cm below the lens, so that each row of the image sees 8 cm more of it in depth."""
    camera = og.Camera(64, 120, 500.0, 500.0, 32.0, 60.0, np.eye(4))
    down = (np.arange(120) + 0.5 - 60) / 500
    with np.errstate(divide="ignore"):
        on_top = np.where(down > 0, 0.08 / down, np.inf)
    depth = np.where(on_top < 1.5, 1.5, np.where(on_top < 2.2, on_top, 3.0))[:, None].repeat(64, axis=1)
    mapper = og.Mapper(spacing=0.02)
    mapper.integrate(og.Frame(camera, depth=depth))
    _, y, z = (mapper._map.points.xyz + mapper._map.origin).T
    top = (np.abs(y - 0.08) < 0.005) & (z > 1.52) & (z < 2.2)
    assert len({*np.round(z[top], 2)}) >= 4  # of its eight rows every second is read
    assert (top | (np.abs(z - 1.5) < 0.02) | (np.abs(z - 3) < 0.02)).all()


def test_voxel_points_are_means_of_their_voxels():
    random = np.random.default_rng(0)
    xyz = random.uniform(-1, 1, (3000, 3)).astype(np.float32)
    points = VoxelPoints(0.25, grows=True)
    for part in np.array_split(xyz, 7):
        points.add(part, np.zeros((len(part), 3), np.uint8), 0)
    voxel = np.floor(xyz / np.float32(0.25)).astype(int)
    keys, owner = np.unique(voxel, axis=0, return_inverse=True)
    owner = owner.ravel()
    means = np.array([xyz[owner == k].astype(np.float64).mean(axis=0) for k in range(len(keys))])
    few = np.bincount(owner) <= 32  # beyond, the mean follows
    found = points.xyz[np.lexsort(np.floor(points.xyz / 0.25).astype(int).T[::-1])]
    assert points.n == len(keys)
    np.testing.assert_allclose(found[few], means[few], atol=1e-5)


def test_what_stands_where_others_left_moves_with_its_own_frame():
    points, place = VoxelPoints(0.25, grows=True), np.full((1, 3), 0.1, np.float32)
    assert points.add(place, np.zeros((1, 3), np.uint8), 0)
    assert not points.add(place, np.zeros((1, 3), np.uint8), 1)
    points.weight[0] = 0  # it left
    assert points.add(place + np.float32(0.1), np.zeros((1, 3), np.uint8), 2)
    assert (points.n, points.anchor.tolist(), points.xyz[0].tolist()) == (1, [2], pytest.approx([0.2] * 3))


KILLED = """
import sys, time
sys.path.insert(0, {tests!r})
from og_pointcloud.mapping import map_journal
from visits import CHEST, BIN, CRATE, frames, SPACE
import og_pointcloud as og
map_journal.MAX_LOG_BYTES = 1_500_000
mapper = og.Mapper(feature_space=SPACE, journal={folder!r})
for frame in frames([CHEST, BIN, CRATE]):
    mapper.integrate(frame)
    print(frame.stamp, flush=True)
"""


@pytest.mark.slow
def test_killed_at_any_moment_it_goes_on(tmp_path, monkeypatch):
    from og_pointcloud.mapping import map_journal

    monkeypatch.setattr(map_journal, "MAX_LOG_BYTES", 1_500_000)
    folder = tmp_path / "journal"
    code = textwrap.dedent(KILLED).format(tests=str(Path(__file__).parent), folder=str(folder))
    given = frames(THINGS)
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as process:
        done = -1.0
        for line in process.stdout:
            done = float(line)
            if done >= 8:
                os.kill(process.pid, signal.SIGKILL)
                break
    torn = folder / "frames.log"
    torn.write_bytes(torn.read_bytes() + map_journal.MAGIC + b"half a frame")
    with pytest.warns(UserWarning, match=r"frames\.log ends in the middle of a change"):
        mapper = og.Mapper(feature_space=SPACE, journal=folder)
    assert mapper.holds(done)
    for frame in given:
        if not mapper.holds(frame.stamp):
            mapper.integrate(frame)
    whole, _ = mapped(given)
    one, other = mapper.snapshot().cloud, whole.snapshot().cloud
    np.testing.assert_array_equal(one.xyz, other.xyz)
    np.testing.assert_array_equal(one.instance_ids, other.instance_ids)
    np.testing.assert_array_equal(one.instances.descriptors, other.instances.descriptors)
    assert torn.stat().st_size < 4_000_000
    with pytest.raises(OgPointcloudError, match="began with"):
        og.Mapper(cloud=np.eye(3), journal=folder)


def test_a_journal_goes_on_only_with_what_it_began_with(tmp_path, monkeypatch):
    from og_pointcloud.mapping import map_journal

    mapper, _ = mapped(frames(THINGS)[:2], spacing=0.1, journal=tmp_path)
    same = {"feature_space": SPACE, "spacing": 0.1}
    for others in ({"spacing": None}, {"feature_space": "another/encoder"}, {"settings": og.FitSettings(seed=1)}):
        with pytest.raises(OgPointcloudError, match=r"has a map that began with 0 points .*, not with 0 points"):
            og.Mapper(journal=tmp_path, **{**same, **others})
    with pytest.raises(OgPointcloudError, match=r"began with 0 points .*, not with 3 points"):
        og.Mapper(cloud=np.eye(3), feature_space=SPACE, journal=tmp_path)
    # A smaller memory limit, as after a kill for want of memory, is no other map. The log is as it was.
    again = og.Mapper(settings=og.FitSettings(memory=1 << 30), journal=tmp_path, **same)
    assert again.points == mapper.points
    # The log says it again once it starts anew.
    monkeypatch.setattr(map_journal, "MAX_LOG_BYTES", 1000)
    again.integrate(frames(THINGS)[2])
    assert (tmp_path / "frames.log").stat().st_size == 0
    monkeypatch.undo()
    again.integrate(frames(THINGS)[3])
    (tmp_path / "map.state").unlink()
    with pytest.raises(OgPointcloudError, match="began with 0 points"):
        og.Mapper(feature_space=SPACE, journal=tmp_path)


def test_a_damaged_journal_is_refused_and_only_a_torn_end_is_cut(tmp_path):
    mapper, _ = mapped(frames(THINGS)[:2], journal=tmp_path)
    points, log = mapper.points, tmp_path / "frames.log"
    whole = log.read_bytes()
    mapper.integrate(frames(THINGS)[2])
    longer = log.read_bytes()
    for byte in (len(whole) // 2, len(whole)):  # in the middle of a record, and in the header of the last one
        damaged = bytearray(longer + b"\0" * 1000)
        damaged[byte] ^= 1
        log.write_bytes(damaged)
        with pytest.raises(OgPointcloudError, match=rf"is damaged at byte \d+ of {len(damaged)}: remove the folder"):
            og.Mapper(feature_space=SPACE, journal=tmp_path)
        assert log.read_bytes() == damaged
    for end in (longer[:-1], longer[: len(whole) + 20], longer[: len(whole) + 5]):
        log.write_bytes(end)
        with pytest.warns(UserWarning, match=f"its last {len(end) - len(whole)} bytes were cut off") as said:
            again = og.Mapper(feature_space=SPACE, journal=tmp_path)
        assert (said[0].filename, again.points, log.read_bytes()) == (__file__, points, whole)


@pytest.mark.slow
def test_the_point_size_that_a_snapshot_chose_is_in_the_journal(tmp_path):
    """Frames without depth that come later see the points in this size."""
    capture, given = scene(THINGS), without_depth(frames(THINGS))
    mapper, _ = mapped(given[:8], cloud=capture.points, journal=tmp_path)
    mapper.snapshot()
    for frame in given[8:]:
        mapper.integrate(frame)
    known = mapper._map
    again = og.Mapper(cloud=capture.points, feature_space=SPACE, journal=tmp_path)._map
    assert (again.scale, again.drawn) == (known.scale, known.drawn)
    assert known.scale != og.FitSettings().geometry.middle_scale, "the test would not notice another size"
    np.testing.assert_array_equal(again.votes.weight, known.votes.weight)
    for one, other in zip(again.kept.views, known.kept.views, strict=True):
        np.testing.assert_array_equal(one.openness, other.openness)


def test_a_journal_that_cannot_be_written_is_one_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OgPointcloudError, match=r"file' cannot be used \(File exists\)"):
        og.Mapper(journal=tmp_path / "file")
    (tmp_path / "j" / "frames.log").mkdir(parents=True)
    mapper = og.Mapper(feature_space=SPACE, journal=tmp_path / "j")
    with pytest.raises(OgPointcloudError, match="j: Is a directory: check the path"):
        mapper.integrate(frames(THINGS)[0])


def test_a_journal_takes_whatever_frames_are_given_as(tmp_path):
    torch = pytest.importorskip("torch")
    first, second = frames(THINGS)[:2]
    cloud = torch.from_numpy(surface(THINGS)[0])
    given = [
        replace(first, masks=torch.from_numpy(first.masks), depth=torch.from_numpy(first.depth)),
        replace(second, depth=None, cloud=cloud, masks=second.masks.tolist(), features=torch.tensor(second.features)),
    ]
    whole, _ = mapped(given, journal=tmp_path)
    again = og.Mapper(feature_space=SPACE, journal=tmp_path)
    assert again.points == whole.points
    assert [thing.points for thing in again.objects()] == [thing.points for thing in whole.objects()]


def test_ids_that_a_snapshot_gave_are_not_given_again_after_a_kill(tmp_path):
    first, *others = frames(THINGS)[:4]
    mapper, _ = mapped([first], journal=tmp_path)  # which makes no object yet
    given = len(mapper.snapshot().cloud.instances)
    for _ in range(2):
        again = og.Mapper(feature_space=SPACE, journal=tmp_path)
    ids = [k for frame in others for k in again.integrate(frame).new]
    assert given > 0
    assert ids
    assert min(ids) >= given


def test_frames_of_one_stamp_and_corrections_are_in_the_journal(tmp_path):
    stamps = Fraction(0), Fraction(0), 1, 1, Fraction(5, 2)  # two cameras at a time, then one
    given = [replace(frame, stamp=stamp) for stamp, frame in zip(stamps, frames(THINGS), strict=False)]
    mapper, _ = mapped(given, journal=tmp_path)
    with pytest.raises(SceneError, match="frames of stamp 0 have different poses, as of two cameras"):
        mapper.correct(poses_of(given))
    mapper.correct(poses_of(lowered(given[4:])))
    again = og.Mapper(feature_space=SPACE, journal=tmp_path)
    np.testing.assert_array_equal(again._map.points.xyz, mapper._map.points.xyz)
    assert [thing.views for thing in again.objects()] == [thing.views for thing in mapper.objects()]
    assert again._map.sequence == mapper._map.sequence


def test_a_journal_is_one_mappers(tmp_path):
    """Another process is kept out; in one process, as in a notebook, the mapper made last has it until it is closed."""
    given = frames(THINGS)[:2]
    first, _ = mapped(given[:1], journal=tmp_path)
    code = f"import og_pointcloud as og; og.Mapper(feature_space={SPACE!r}, journal={str(tmp_path)!r})"
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert f"is in use by process {os.getpid()}" in other.stderr
    with mapped(given[1:], journal=tmp_path)[0] as second:
        pass
    for mapper in (first, second):
        with pytest.raises(OgPointcloudError, match="was closed, or another mapper now writes to it"):
            mapper.integrate(replace(given[1], stamp=9.0))
        assert not mapper.holds(9.0)
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
    third, _ = mapped(given[1:], journal=tmp_path)
    assert (tmp_path / ".lock").exists()
    del third
    assert not (tmp_path / ".lock").exists(), "a mapper that is forgotten still keeps others out"


def test_a_disk_that_was_full_for_a_while_costs_only_the_frames_of_then(tmp_path):
    resource = pytest.importorskip("resource")
    first, second, third = frames(THINGS)[:3]
    mapper, _ = mapped([first], journal=tmp_path)
    turned = {first.stamp: first.camera.world_to_camera @ np.diag([-1.0, -1, 1, 1])}
    limits, points, xyz = resource.getrlimit(resource.RLIMIT_FSIZE), mapper.points, mapper._map.points.xyz.copy()
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, ((tmp_path / "frames.log").stat().st_size + 1000, limits[1]))
        with pytest.raises(OgPointcloudError, match="check the path, its permissions, and the free space"):
            mapper.integrate(second)
        resource.setrlimit(resource.RLIMIT_FSIZE, ((tmp_path / "frames.log").stat().st_size + 10, limits[1]))
        with pytest.raises(OgPointcloudError, match="check the path, its permissions, and the free space"):
            mapper.correct(turned)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert mapper.points == points, "a frame that was not written changed the map"
    np.testing.assert_array_equal(mapper._map.points.xyz, xyz, "a correction that was not written moved the map")
    mapper.integrate(third)
    again = og.Mapper(feature_space=SPACE, journal=tmp_path)
    assert (again.holds(third.stamp), again.points) == (True, mapper.points)


def test_a_whole_map_that_cannot_be_written_costs_no_frame(tmp_path, monkeypatch):
    from og_pointcloud.mapping import map_journal

    def full(path):
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(map_journal, "MAX_LOG_BYTES", 1000)
    monkeypatch.setattr(map_journal, "replacing", full)
    mapper = og.Mapper(feature_space=SPACE, journal=tmp_path)
    with pytest.warns(UserWarning, match=r"map.state cannot be written \(No space left"):
        mapper.integrate(frames(THINGS)[0])
    assert og.Mapper(feature_space=SPACE, journal=tmp_path).points == mapper.points > 0


def test_a_frame_that_failed_fails_again_and_the_map_goes_on(tmp_path, monkeypatch):
    """It leaves its number to the next one. One that was only interrupted is in the map after that."""
    module, given = sys.modules["og_pointcloud.mapping.mapper"], frames(THINGS)[:3]
    vote = module.vote

    def failing(frame, *rest):
        return vote(frame, *rest) if frame.stamp != given[1].stamp else 1 // 0

    monkeypatch.setattr(module, "vote", failing)
    mapper = og.Mapper(feature_space=SPACE, journal=tmp_path)
    mapper.integrate(given[0])
    with pytest.raises(ZeroDivisionError):
        mapper.integrate(given[1])
    mapper.integrate(given[2])
    with pytest.warns(UserWarning, match=r"change 2 in the journal failed \(ZeroDivisionError"):
        again = og.Mapper(feature_space=SPACE, journal=tmp_path)
    np.testing.assert_array_equal(again._map.points.xyz, mapper._map.points.xyz)
    np.testing.assert_array_equal(again._map.votes.weight, mapper._map.votes.weight)
    monkeypatch.undo()
    assert [og.Mapper(feature_space=SPACE, journal=tmp_path).holds(frame.stamp) for frame in given] == [True] * 3


def test_points_that_came_are_labelled_by_their_own_neighbors(monkeypatch):
    """As many came as were not seen: the neighborhood of the map that was gone on with is not that of these."""
    base, _ = mapped(frames(THINGS)[:6])
    mapper, _ = mapped(frames(THINGS)[:1], base.snapshot())
    known = mapper._map
    lacking = len(mapper._rows) - int(np.isfinite(known.presence.seen_at[: known.points.n]).sum())
    came = 50.5 + np.stack([np.arange(lacking), *np.zeros((2, lacking))], axis=1)
    known.points.add((known.points.edge * came).astype(np.float32), np.zeros((lacking, 3), np.uint8), 0)
    known.grow()
    known.presence.seen_at[known.points.n - lacking : known.points.n] = 0.0
    given = []

    def asked(*arguments):
        given.append(arguments)
        raise InterruptedError  # what would follow is not looked at

    monkeypatch.setattr(sys.modules["og_pointcloud.mapping.mapper"], "labelled", asked)
    with pytest.raises(InterruptedError):
        mapper._label(known)
    ((_, rows, around, settings),) = given
    assert len(rows) == len(mapper._rows) > lacking > 0
    np.testing.assert_array_equal(around.index, neighborhood(known.points.xyz[rows], settings.geometry).index)


def test_a_queue_never_blocks_and_says_what_it_drops():
    said, seen = [], []
    mapper = og.Mapper(feature_space=SPACE)
    queue = FrameQueue(mapper, max_age=60.0, on_change=seen.append, on_drop=said.append)
    given = frames(THINGS)[:4]
    for frame in [*given, replace(given[0], camera=None)]:
        queue.put(frame)
    queue.close()
    assert len(seen) == 4
    assert len(said) == 1
    assert "has no camera" in said[0]
    for failing in (lambda change: 1 / 0, lambda change: mapper.correct([])):
        broken = FrameQueue(mapper, on_change=failing, on_drop=said.append)
        for frame in given[:2]:
            broken.put(frame)
        broken.close()
    assert [text.split(":")[:2] for text in said[1:]] == [
        ["a frame was added, but on_change failed", f" {k}"] for k in 2 * ["ZeroDivisionError"] + 2 * ["SceneError"]
    ]
    deaf = FrameQueue(mapper, on_change=seen.append, on_drop=lambda text: 1 / 0)
    for frame in (replace(given[0], camera=None), given[1]):
        deaf.put(frame)
    deaf.close()
    assert len(seen) == 5
    said.clear()
    slow = FrameQueue(mapper, max_age=0.0, on_drop=said.append)
    slow.put(given[0])
    time.sleep(0.01)
    slow.close()
    assert slow.dropped == 1
    assert "1 dropped so far" in said[-1]
    slow.put(given[0])
    assert (slow.dropped, "after the queue was closed: 2 dropped so far" in said[-1]) == (2, True)


def test_a_driver_may_fill_its_buffers_again_behind_a_queue():
    given = frames(THINGS)[:4]
    buffer = {name: getattr(given[0], name).copy() for name in ("masks", "features", "depth", "rgb")}
    pose = given[0].camera.world_to_camera.copy()
    queue = FrameQueue(og.Mapper(feature_space=SPACE), max_age=60.0)
    with queue.lock:  # nothing is taken in before all buffers were filled again
        for frame in given:
            for name, array in buffer.items():
                array[...] = getattr(frame, name)
            pose[...] = frame.camera.world_to_camera
            queue.put(replace(frame, **buffer, camera=replace(frame.camera, world_to_camera=pose)))
    queue.close()
    whole, _ = mapped(given)
    np.testing.assert_array_equal(queue.mapper._map.points.xyz, whole._map.points.xyz)
    assert [thing.views for thing in queue.mapper.objects()] == [thing.views for thing in whole.objects()]


def test_a_saved_map_is_a_file_like_any_other(grown, tmp_path):
    mapper, _ = grown
    path = mapper.save(tmp_path / "room.ogpc")
    read = og.load(path)
    np.testing.assert_array_equal(read.instance_ids, mapper.snapshot().instance_ids)
    assert len(read.cloud.cameras) == 14


def test_a_noisy_cloud_is_still_where_it_was():
    """Noise of half a spacing: what a point is off its surface is no absence."""
    xyz, _ = surface(THINGS, seed=12)
    noisy = xyz + np.random.default_rng(0).normal(0, 0.015, xyz.shape)
    mapper = og.Mapper(cloud=noisy, feature_space=SPACE)
    changes = [mapper.integrate(frame) for frame in frames(THINGS)]
    assert all(change.gone == () for change in changes)
    assert mapper.points > 0.95 * len(noisy)


PANE = Thing((-0.2, -1.2, 0.0), (0.8, 0.04, 0.9), (180, 220, 230), 5)


def through_the_pane(given, others):
    """The same frames, whose depth looks through the pane at what stands behind it."""
    return [replace(frame, depth=cast(others, frame.camera)[0]) for frame in given]


def test_glass_that_gives_no_reading_stays():
    mapper, _ = mapped(frames([*THINGS, PANE]))
    pane = instance_of(mapper.snapshot().cloud, PANE)
    later = frames([*THINGS, PANE], seed=1, first=50.0)
    holes = [replace(f, depth=np.where(cast([*THINGS, PANE], f.camera)[1] == 3, 0, f.depth)) for f in later]
    assert all(mapper.integrate(frame).gone == () for frame in holes)
    assert instance_of(mapper.snapshot().cloud, PANE) == pane


def test_glass_that_is_looked_through_now_and_then_stays():
    given = frames([*THINGS, PANE], cameras(28))
    for k, through in [*enumerate(through_the_pane(given, THINGS))][3::4]:
        given[k] = through
    mapper, changes = mapped(given)
    assert all(change.gone == () for change in changes)
    assert instance_of(mapper.snapshot().cloud, PANE) not in {
        -1,
        *(instance_of(mapper.snapshot().cloud, t) for t in THINGS),
    }


def test_what_a_screen_hides_is_not_gone():
    """Behind it the bin is taken away, and then the screen too."""
    mapper, _ = mapped(frames(THINGS))
    bin_ = instance_of(mapper.snapshot().cloud, BIN)
    screen = Thing((-0.4, -1.2, 0.0), (1.8, 0.05, 1.2), (240, 240, 240), 5)
    before_it = [camera for camera in cameras(40) if camera.center[1] < -2.5]
    gone = [mapper.integrate(f).gone for f in frames([CHEST, CRATE, screen], before_it, seed=5, first=50.0)]
    assert not any(gone)
    gone = [mapper.integrate(f).gone for f in frames([CHEST, CRATE], before_it, seed=6, first=90.0)]
    assert bin_ in {k for ids in gone for k in ids}


def test_at_the_edge_of_images_nothing_is_gone():
    """Views that cut through things, and look past the edge of the map."""
    mapper, _ = mapped(frames(THINGS, cameras(14, part=(0, 0.5))))
    narrow = [replace(camera, width=60, cx=20.0) for camera in cameras(28)]
    changes = [mapper.integrate(frame) for frame in frames(THINGS, narrow, seed=1, first=50.0)]
    assert all(change.gone == () for change in changes)


def test_votes_go_against_tracks_that_are_shown_beside_a_point_and_not_against_missed_ones():
    votes = PointVotes()
    votes.grow(3)
    everyone, root = np.arange(3), np.arange(2, dtype=np.int32)
    one = np.ones(3, np.float32)
    votes.add(everyone, np.zeros(3, np.int32), 2 * one, np.array([True, False]))
    # Track 0 is missed; then it has a mask, which holds the first point alone, while track 1 holds the second.
    votes.add(everyone, np.full(3, NO_TRACK, np.int32), one, np.array([False, True]))
    np.testing.assert_array_equal(votes.weight[:, 0], [2, 2, 2])
    votes.add(everyone, np.array([0, 1, NO_TRACK], np.int32), one, np.array([True, True]))
    np.testing.assert_array_equal(votes.weight[:, 0], [3, 1, 1])
    votes.add(everyone, np.array([0, 1, NO_TRACK], np.int32), one, np.array([True, True]))
    np.testing.assert_array_equal(votes.best(everyone, root), [0, 1, NO_TRACK])


def test_what_was_named_elsewhere_before_its_place_was_seen_empty_gets_its_id_back():
    mapper, _ = mapped(frames(THINGS))
    crate, after = instance_of(mapper.snapshot().cloud, CRATE), [CHEST, BIN, ELSEWHERE]
    given = frames(after, seed=1, first=100.0)
    shown = [cast(after, frame.camera)[1] == 2 for frame in given]
    alone = [replace(frame, depth=np.where(only, frame.depth, 0), masks=np.where(only, frame.masks, -1))
             for frame, only in zip(given, shown, strict=True)]  # fmt: skip
    changes = [mapper.integrate(frame) for frame in alone]
    assert [k for change in changes for k in change.new] != []
    later = [mapper.integrate(frame) for frame in frames(after, seed=2, first=200.0)]
    assert [entry.id for change in later for entry in change.moved] == [crate]
    (entry,) = [entry for entry in mapper.objects() if entry.state == "moved"]
    assert entry.id == crate
    assert entry.since >= 100


def test_objects_know_since_when_they_stand_where_they_are():
    mapper, _ = mapped(frames(THINGS))
    for frame in frames([*THINGS, PARCEL], seed=1, first=100.0):
        mapper.integrate(frame)
    cloud, objects = mapper.snapshot().cloud, {entry.id: entry for entry in mapper.objects()}
    assert all(objects[instance_of(cloud, thing)].since < 100 for thing in THINGS)
    assert objects[instance_of(cloud, PARCEL)].since >= 100


def test_what_comes_back_to_its_place_has_stood_there_since_then_and_has_not_moved():
    mapper, _ = mapped(frames(THINGS))
    crate = instance_of(mapper.snapshot().cloud, CRATE)
    changes = [mapper.integrate(frame) for frame in frames([CHEST, BIN], seed=1, first=100.0)]
    assert [k for change in changes for k in change.gone] == [crate]
    for frame in frames(THINGS, seed=2, first=200.0):
        mapper.integrate(frame)
    back = {entry.id: entry for entry in mapper.objects()}[crate]
    assert back.state == "present"
    assert back.since >= 200


def test_snapshots_draw_points_as_large_as_a_fit_does():
    capture, given = scene(THINGS), without_depth(frames(THINGS))
    cloud = og.fit(capture, progress=False)
    mapper, _ = mapped(given, cloud=capture.points)
    mapper.snapshot()
    known, scale = mapper._map, cloud.provenance["notes"]["gaussian_scale"]
    geometry = og.FitSettings().geometry
    assert known.scale == scale != geometry.middle_scale
    fixed = og.FitSettings(geometry=replace(geometry, scales=(scale,)))
    for one, other in zip(known.kept.views, mapped(given, cloud=capture.points, settings=fixed)[0]._map.kept.views,
                          strict=True):  # fmt: skip
        np.testing.assert_array_equal(one.columns, other.columns)
        np.testing.assert_array_equal(one.votes, other.votes)


@pytest.mark.parametrize("spacing", [0.02, 0.004])
def test_points_are_judged_as_if_all_were_asked(spacing):
    """Whatever packets leave out says nothing."""
    xyz = surface(THINGS, seed=3)[0].astype(np.float32)
    points = VoxelPoints(spacing, grows=True)
    rows = points.add_known(xyz[:6000], None)
    np.testing.assert_array_equal(points.xyz[rows], xyz[:6000])
    for part in np.array_split(xyz[6000:], 5):
        points.add(part, np.zeros((len(part), 3), np.uint8), 0)
    points.weight[::7] = 0
    packets = points.packets
    np.testing.assert_array_equal(np.sort(packets.order), np.arange(points.n))
    assert 64 * len(packets.low) < points.n
    inside = og.Camera(90, 60, 40.0, 40.0, 45.0, 30.0, np.eye(4)[[0, 2, 1, 3]] * [[1], [-1], [1], [1]])
    for camera in (*cameras(3), replace(cameras(1)[0], width=40, cx=70.0), inside):
        depth = cast([CHEST, ELSEWHERE, PARCEL], camera)[0]
        view = view_of_depth(depth + np.random.default_rng(0).normal(0, 0.003, depth.shape) * (depth > 0), camera)
        states = np.where(points.alive, states_of_points(points.xyz, 0.01, view), NOTHING)
        told = np.flatnonzero((states == AGREES) | (states == THROUGH))
        assert np.isin(told, packets.in_view(camera, points.edge)).all()
