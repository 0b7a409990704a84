"""Two visits of one place: what is gone, new, moved and unseen; maps that later visits are folded into."""

from __future__ import annotations

import json
import tracemalloc
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from labelled_clouds import instance_table, make_cloud
from scenes import FEATURE_SPACE, HEIGHT, NAMES, WIDTH, write_depth
from text_models import encoder_files, write_files
from visits import BIN, CHEST, CRATE, PARCEL, SPACE, Thing, cameras, cast, instance_of, moved, scene, surface

import og_pointcloud as og
from og_pointcloud.bundle.read import read_carried_encoder
from og_pointcloud.bundle.vocabulary import carry_encoder
from og_pointcloud.cli import main
from og_pointcloud.errors import FeatureSpaceError, OgPointcloudError, SceneError
from og_pointcloud.formats.poses import in_local_frame
from og_pointcloud.mapping import changes as changes_module
from og_pointcloud.mapping.likeness import spread_of
from og_pointcloud.mapping.map_record import MapRecord
from og_pointcloud.mapping.merging import joined
from og_pointcloud.mapping.presence import Evidence, Visit
from og_pointcloud.mapping.sight import AGREES, HIDDEN, NOTHING, THROUGH, DiscSurface, states_of_points, view_of_depth
from og_pointcloud.rendering.geometry import neighborhood
from og_pointcloud.scene import Camera
from og_pointcloud.settings import GeometrySettings

AWAY = (-0.9, 0.5, 0.0)
BEFORE = [CHEST, BIN, CRATE]
AFTER = [CHEST, moved(CRATE, AWAY), PARCEL]
"""The bin left, the crate moved, a parcel came."""


@pytest.fixture(scope="module")
def monday():
    return og.fit(scene(BEFORE), progress=False)


@pytest.fixture(scope="module")
def friday():
    return og.fit(scene(AFTER, seed=1), progress=False)


@pytest.fixture(scope="module")
def updated(monday):
    return og.update(monday, scene(AFTER, seed=1), progress=False)


def states_by_hand(xyz, camera, things, tolerance):
    """The definition for one point at a time, in float64: the surface along its own ray, at right angles."""
    states = []
    for p in xyz.astype(np.float64):
        toward = camera.world_to_camera[:3, :3] @ p + camera.world_to_camera[:3, 3]
        narrow = replace(camera, width=1, height=1, cx=0.5 - camera.fx * toward[0] / toward[2],
                         cy=0.5 - camera.fy * toward[1] / toward[2])  # fmt: skip
        depth, _ = cast(things, narrow)
        if not depth[0, 0]:
            states.append(NOTHING)
            continue
        along = (float(depth[0, 0]) - toward[2]) * np.linalg.norm(toward / toward[2])
        states.append(AGREES if abs(along) < tolerance else HIDDEN if along < 0 else THROUGH)
    return np.array(states)


def test_states_of_points_are_those_along_each_ray():
    camera = cameras()[0]
    view = view_of_depth(cast(AFTER, camera)[0], camera)
    xyz, _ = surface(BEFORE, seed=3)
    uv_px, _ = camera.project(xyz)
    inside = (uv_px > 3).all(axis=1) & (uv_px < np.array([camera.width, camera.height]) - 3).all(axis=1)
    xyz = xyz[inside].astype(np.float32)
    literal = states_by_hand(xyz, camera, AFTER, 0.02)
    fast = states_of_points(xyz, 0.02, view)
    clear = (literal == HIDDEN) | (literal == THROUGH)
    # At edges, within a pixel and a half, all surfaces around count: nothing is called absent there.
    assert (literal[fast == THROUGH] == THROUGH).mean() > 0.99
    assert (fast[clear] == literal[clear]).mean() > 0.8
    assert (fast[literal == AGREES] == AGREES).mean() > 0.97


def rule_by_hand(xyz, tolerance, view):
    """What `sight` says it does, for one point and one pixel at a time."""
    camera, states = view.camera, []
    within = np.hypot(tolerance, 3 * view.noise)
    for p in xyz.astype(np.float64):
        x = camera.world_to_camera[:3, :3] @ p + camera.world_to_camera[:3, 3]
        u, v = camera.fx * x[0] / x[2] + camera.cx, camera.fy * x[1] / x[2] + camera.cy
        said = []
        for row in range(int(np.floor(v)) - 1, int(np.floor(v)) + 2):
            for column in range(int(np.floor(u)) - 1, int(np.floor(u)) + 2):
                inside = 0 <= row < camera.height and 0 <= column < camera.width
                depth = float(view.depth[row, column]) if inside else 0.0
                if depth == 0:
                    continue
                normal = view.normal[row, column].astype(np.float64)
                ray = np.array([(column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy, 1.0])
                across, on_ray = normal @ (x - depth * ray), abs(depth - x[2]) * np.linalg.norm(x) / x[2]
                slanted = abs(normal @ x) < 0.15 * np.linalg.norm(x)
                if abs(across) <= within and (on_ray <= within or not slanted):
                    said.append(AGREES)
                elif slanted and on_ray > within:
                    said.append(HIDDEN if depth < x[2] else NOTHING)
                else:
                    said.append(HIDDEN if across < 0 else THROUGH)
        in_image = x[2] > 0 and 0 <= u < camera.width and 0 <= v < camera.height
        states.append(
            NOTHING if not in_image else AGREES if AGREES in said else HIDDEN if HIDDEN in said
            else THROUGH if said.count(THROUGH) >= 3 and NOTHING not in said else NOTHING
        )  # fmt: skip
    return np.array(states)


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_states_of_points_follow_the_rule_word_by_word(noise):
    random = np.random.default_rng(5)
    xyz = (surface(BEFORE, seed=3)[0] + random.normal(0, 0.02, (1, 3)))[::8].astype(np.float32)
    for camera in (*cameras(2), replace(cameras(7)[3], width=50, cx=60.0)):
        depth = cast(AFTER, camera)[0]
        view = view_of_depth(depth + (noise * random.normal(size=depth.shape) * (depth > 0)).astype(np.float32), camera)
        fast, literal = states_of_points(xyz, 0.02, view), rule_by_hand(xyz, 0.02, view)
        assert {*fast.tolist()} == {NOTHING, AGREES, HIDDEN, THROUGH}
        assert np.count_nonzero(fast != literal) <= 2  # of which a distance lies on the tolerance, in float32


def discs(xyz):
    xyz = xyz.astype(np.float32)
    return DiscSurface(xyz, neighborhood(xyz, GeometrySettings()))


def test_a_cloud_is_seen_like_its_depth_image():
    camera = cameras()[2]
    xyz, _ = surface(AFTER, seed=4)
    drawn = discs(xyz).seen_from(camera)
    depth, _ = cast(AFTER, drawn.camera)
    both = (drawn.depth > 0) & (depth > 0)
    assert both.sum() > 0.95 * (depth > 0).sum()
    assert np.median(np.abs(drawn.depth - depth)[both]) < 0.01


def test_sparse_depth_says_the_same_of_fewer_points():
    camera = cameras()[0]
    depth, _ = cast(AFTER, camera)
    sparse = np.where(np.random.default_rng(0).random(depth.shape) < 0.05, depth, 0).astype(np.float32)
    xyz = surface(BEFORE, seed=3)[0].astype(np.float32)
    full, few = (states_of_points(xyz, 0.02, view_of_depth(d, camera)) for d in (depth, sparse))
    told = few == THROUGH
    assert told.sum() > 50
    assert (full[told] == THROUGH).mean() > 0.95


def test_what_changed_is_told_by_id(monday, friday):
    changes = og.compare(monday, friday)
    assert changes.gone == (instance_of(monday, BIN),)
    assert changes.new == (instance_of(friday, PARCEL),)
    (followed,) = changes.moved
    assert followed.id == instance_of(monday, CRATE)
    assert followed.now == instance_of(friday, AFTER[1])
    np.testing.assert_allclose(followed.after - followed.before, AWAY, atol=0.05)
    assert json.loads(json.dumps(changes.to_dict())) == changes.to_dict()
    assert set(changes.to_dict()["moved"][0]) == {"id", "from", "to"}


FOUR = [
    Thing((-1.3, -1.3, 0.0), (0.4, 0.4, 0.4), (200, 60, 50), 1),
    Thing((-1.3, 0.9, 0.0), (0.4, 0.4, 0.4), (200, 60, 50), 2),
    Thing((0.9, -1.3, 0.0), (0.4, 0.4, 0.4), (200, 60, 50), 3),
    Thing((0.9, 0.9, 0.0), (0.4, 0.4, 0.4), (200, 60, 50), 4),
]
"""Two of one kind, and two of another, that stay where they are."""


def of_kinds(things, seed, own):
    """A visit whose descriptors are a kind's, and a thing's own direction beside it: (kind, own direction) of each."""
    cloud = og.fit(scene(things, seed=seed), progress=False)
    rows = cloud.instances.descriptors.copy()
    for thing, (kind, direction) in zip(things, own, strict=True):
        row = np.zeros(rows.shape[1], np.float32)
        row[kind], row[direction] = np.sqrt(0.9), np.sqrt(0.1)  # two of a kind have the cosine 0.9
        rows[cloud.instances.descriptor_instance == instance_of(cloud, thing)] = row
    return replace(cloud, instances=replace(cloud.instances, descriptors=rows))


@pytest.mark.parametrize(("direction", "moves"), [(9, 1), (10, 0)], ids=["itself", "another of its kind"])
def test_another_of_its_kind_is_not_the_same_thing(direction, moves):
    stay, crate = [(1, 5), (1, 6), (2, 7), (2, 8)], Thing((-0.2, -0.2, 0.0), (0.4, 0.4, 0.4), (200, 60, 50), 5)
    before = of_kinds([*FOUR, crate], 0, [*stay, (3, 9)])
    after = of_kinds([*FOUR, moved(crate, (-0.6, 0.5, 0.0))], 1, [*stay, (3, direction)])
    found = og.compare(before, after)
    assert (len(found.moved), len(found.gone), len(found.new)) == (moves, 1 - moves, 1 - moves)


def test_how_far_means_of_few_features_are_off_is_told_from_the_scene():
    random, width = np.random.default_rng(0), 256
    masks = np.repeat([1, 2, 3, 5, 12, 40], 60)
    agreement, off = np.zeros(len(masks)), np.zeros(len(masks))
    for k, count in enumerate(masks.tolist()):
        rows = np.eye(width)[0] + 0.8 * random.normal(size=(count, width)) / np.sqrt(width)
        rows /= np.linalg.norm(rows, axis=1, keepdims=True)
        mean = rows.mean(axis=0) / np.linalg.norm(rows.mean(axis=0))
        agreement[k], off[k] = (rows @ mean).mean(), mean[0] ** -2 - 1
    told = spread_of(agreement, masks)
    for count in np.unique(masks):
        np.testing.assert_allclose(told[masks == count].mean(), off[masks == count].mean(), rtol=0.15)


@pytest.mark.parametrize("apart", [1.5, 1.8, 2.5])
def test_two_sheets_are_no_thick_one(apart):
    """Both faces of a wall, a few spacings apart: planes lie in one of them, and points stay where they are."""
    random, count = np.random.default_rng(0), 2000
    height = np.repeat([0.0, apart / np.sqrt(count)], count)
    sheets = np.c_[random.random((2 * count, 2)), height]
    found = discs(sheets)
    assert found.scatter < 0.1 * found.spacing
    assert np.mean(np.abs(found.xyz[:, 2] - sheets[:, 2]) < 0.1 * found.spacing) > 0.85


@pytest.mark.slow
def test_the_same_place_again_has_not_changed(monday):
    again = og.fit(scene(BEFORE, seed=2), progress=False)
    changes = og.compare(monday, again)
    assert (changes.gone, changes.new, changes.moved) == ((), (), ())


@pytest.mark.parametrize("progress", [True, False])
def test_a_comparison_tells_how_many_views_it_goes_through(monday, friday, monkeypatch, progress):
    bars = []
    monkeypatch.setattr(changes_module, "with_bar", lambda views, *bar: bars.append(bar) or views)
    og.compare(monday, friday, progress=progress)
    assert bars == [("then", len(monday.cameras), progress), ("now", len(friday.cameras), progress)]
    assert bars[0][1] > 1


def test_time_reversed_swaps_gone_and_new(monday, friday):
    changes = og.compare(friday, monday)
    assert changes.gone == (instance_of(friday, PARCEL),)
    assert changes.new == (instance_of(monday, BIN),)
    assert [moved.id for moved in changes.moved] == [instance_of(friday, AFTER[1])]


def scaled(cloud, unit):
    poses = [camera.world_to_camera.copy() for camera in cloud.cameras]
    for pose in poses:
        pose[:3, 3] *= unit
    views = (replace(camera, world_to_camera=pose) for camera, pose in zip(cloud.cameras, poses, strict=True))
    lengths = {"spacing": unit * cloud.spacing, "reach": unit * cloud.reach}
    return replace(cloud, xyz=(unit * cloud.xyz).astype(np.float32), cameras=tuple(views), **lengths)


@pytest.mark.slow
@pytest.mark.parametrize("unit", [0.001, 1000.0])
def test_the_unit_of_length_does_not_matter(monday, friday, unit):
    one, other = og.compare(monday, friday), og.compare(scaled(monday, unit), scaled(friday, unit))
    assert (one.gone, one.new) == (other.gone, other.new)
    assert [(m.id, m.now) for m in one.moved] == [(m.id, m.now) for m in other.moved]


@pytest.mark.slow
def test_far_from_the_origin_nothing_changes(monday, friday):
    far = np.array([5e5, 4e6, 300.0])
    one = og.compare(monday, friday)
    other = og.compare(replace(monday, origin=far), replace(friday, origin=far))
    assert (one.gone, one.new, one.unseen) == (other.gone, other.new, other.unseen)


def test_what_is_hidden_stays(monday):
    """A screen before the bin hides it: nobody looked, so nothing is said of it."""
    screen = Thing((0.1, -1.5, 0.0), (1.1, 0.05, 1.4), (240, 240, 240), 5)
    views = [camera for camera in cameras(40) if camera.center[1] < -3.0 and abs(camera.center[0]) < 1]
    hidden = og.fit(scene([CHEST, CRATE, screen], views, seed=5), progress=False)
    changes = og.compare(monday, hidden)
    assert instance_of(monday, BIN) not in changes.gone


def test_one_place_alone_refutes_nothing(monday):
    one = cameras(14)[:1]
    seen = og.fit(scene([CHEST, CRATE], one, seed=6), progress=False)
    assert og.compare(monday, seen).gone == ()


@pytest.mark.slow
@pytest.mark.parametrize("kept", [1.0, 0.2])
def test_what_a_patchy_cloud_leaves_out_is_not_gone(monday, kept):
    """Points of structure from motion lack in patches: a bin of which the visit has the foot alone is gone only if the
    floor around it is not missing too."""
    visit, random = scene(BEFORE, seed=2), np.random.default_rng(0)
    xyz = visit.points.xyz
    off = np.maximum(np.array(BIN.low) - xyz, xyz - np.add(BIN.low, BIN.size)).max(axis=1)
    upper = (off < 0.01) & (xyz[:, 2] > 0.15)
    patch = (off < 0.5) & (xyz[:, 2] < 0.01) & (random.random(len(xyz)) > kept)
    visit = replace(visit, points=visit.points.take(np.flatnonzero(~(upper | patch))))
    updated = og.update(monday, visit, progress=False)
    told = [instance_of(monday, BIN)]
    assert [*updated.changes.gone] == (told if kept == 1 else [])
    assert [*updated.changes.unseen] == ([] if kept == 1 else told)
    low, high = np.add(BIN.low, (0, 0, 0.3)), np.add(BIN.low, BIN.size)
    upper = ((updated.cloud.xyz_world > low - 0.01) & (updated.cloud.xyz_world < high + 0.01)).all(axis=1)
    stays = np.count_nonzero(upper & (updated.cloud.instance_ids == told[0]))
    assert stays == pytest.approx(0 if kept == 1 else 400, abs=50)  # of four sides and the top


@pytest.mark.parametrize(
    ("through", "lacking", "surely"),
    [(18, 1.0, True), (12, 1.0, False), (12, np.nan, True)],
    ids=["more than chance", "no more than chance", "what is hidden is not left out"],
)
def test_points_that_may_be_missing_by_chance_prove_nothing(monday, through, lacking, surely):
    """Of 20 points of the bin that are looked at so many are seen through; of all others half lack, or are hidden."""
    visit, random = Visit(monday), np.random.default_rng(0)
    asked = visit.rows[instance_of(monday, BIN)][:20]
    still, seen_through = np.ones(len(monday), bool), np.zeros(len(monday), bool)
    still[visit.rows[instance_of(monday, BIN)]] = False
    still[asked[through:]], seen_through[asked[:through]] = True, True
    left_out = np.where(random.random(len(monday)) < 0.5, lacking, 0.0)
    shown = still | seen_through
    left, sure, _ = Evidence(shown, still, seen_through, np.ones(len(monday), bool), left_out).decided(visit)
    assert np.flatnonzero(left).tolist() == [instance_of(monday, BIN)]
    assert np.flatnonzero(sure).tolist() == np.flatnonzero(left & surely).tolist()


def test_what_a_visit_knows_of_its_instances_goes_into_the_map():
    """A table (0) and its leg (1); in the visit they are 3 and 0, and a drawer (1) with its knob (2) is new."""
    nan = np.float32("nan")
    of_map = replace(instance_table(2), coarse=np.int32([0, 1]), part_of=np.int32([-1, 0]),
                     reliability=np.float32([0.5, nan]))  # fmt: skip
    of_visit = replace(instance_table(4), coarse=np.int32([0, 1, 1, -1]), part_of=np.int32([3, 3, 1, -1]),
                       reliability=np.float32([0.25, 0.75, nan, 0.9]))  # fmt: skip
    both = joined(of_map, of_visit, np.array([1, 2, 3, 0]), np.array([0, 1, 2, 3]))
    assert both.part_of.tolist() == [-1, 0, 0, 2]
    assert both.coarse.tolist() == [0, 1, 3, 3]  # behind those of the map
    # Of both visits by their masks: 2 of the map's, 5 of the visit's.
    np.testing.assert_allclose(both.reliability, [(2 * 0.5 + 5 * 0.9) / 7, 0.25, 0.75, nan], rtol=1e-6)
    # Two pieces of one new thing, one of which the visit took for a part of the drawer: nothing is a part of itself.
    both = joined(of_map, replace(of_visit, part_of=np.int32([-1, 2, 3, -1])), np.array([1, 2, 3, 2]), np.arange(4))
    assert both.part_of.tolist() == [-1, 0, 3, -1]


def test_a_visit_compared_with_itself_has_nothing_to_say(monday):
    """Nor of an instance with fewer points than decide anything, nor of one that its own views do not see."""
    ids, xyz = monday.instance_ids.copy(), monday.xyz.copy()
    ids[np.flatnonzero(ids == instance_of(monday, BIN))[2:]] = -1
    xyz[ids == instance_of(monday, CRATE), 2] -= 2  # below the floor
    odd = replace(monday, instance_ids=ids, xyz=xyz)
    assert str(og.compare(odd, odd)) == "0 gone, 0 new, 0 moved, 0 not seen again"


@pytest.mark.slow
def test_what_the_first_visit_never_looked_at_is_not_new(monday):
    """Monday only looked from one side; behind the chest stands something that it could not see."""
    side = [camera for camera in cameras(40) if camera.center[0] < -2.5]
    behind = Thing((-0.35, -0.1, 0.0), (0.15, 0.2, 0.3), (30, 200, 200), 6)
    before = og.fit(scene([CHEST, behind], side, seed=7), progress=False)
    # The first visit's cloud holds what its cameras saw alone.
    seen = surface([CHEST, behind], seed=7)[1] != 1
    known = replace(before, xyz=before.xyz[seen], instance_ids=before.instance_ids[seen],
                    rgb=before.rgb[seen], certainty=before.certainty[seen])  # fmt: skip
    after = og.fit(scene([CHEST, behind], seed=8), progress=False)
    assert instance_of(after, behind) not in og.compare(known, after).new


def test_a_map_keeps_its_ids(monday, updated):
    cloud = updated.cloud
    assert updated.changes.gone == (instance_of(monday, BIN),)
    assert instance_of(cloud, CHEST) == instance_of(monday, CHEST)
    assert instance_of(cloud, AFTER[1]) == instance_of(monday, CRATE)
    assert updated.changes.new == (instance_of(cloud, PARCEL),)
    assert updated.changes.new[0] >= len(monday.instances)
    bin_ = instance_of(monday, BIN)
    assert cloud.instances.points[bin_] == 0
    record = MapRecord.of(cloud)
    assert bin_ in record.gone
    assert [record.last_seen[k] for k in (bin_, instance_of(monday, CHEST))] == [0.0, 1.0]
    assert instance_of(cloud, BIN) == -1


@pytest.mark.slow
@pytest.mark.parametrize("by", [(0.0, 0.0, 0.0), (0.5, 1.1, 0.0)], ids=["where it was", "elsewhere"])
def test_what_comes_back_is_known_again(monday, updated, by):
    """The map in between has no point of it: it is new, and has not moved."""
    bin_ = instance_of(monday, BIN)
    back = [*AFTER, moved(BIN, by)]
    visit = og.fit(scene(back, seed=9), progress=False)
    assert og.compare(updated.cloud, visit).to_dict() == {
        "gone": [], "new": [instance_of(visit, back[-1])], "moved": [], "unseen": []
    }  # fmt: skip
    again = og.update(updated.cloud, scene(back, seed=9), progress=False)
    assert again.changes.to_dict() == {"gone": [], "new": [bin_], "moved": [], "unseen": []}
    assert instance_of(again.cloud, back[-1]) == bin_
    record = MapRecord.of(again.cloud)
    assert bin_ not in {**record.gone, **record.moved_from}


def test_a_part_of_the_place_leaves_the_rest_as_it_was(monday):
    """Half of the cameras, near things hide far ones: what is not looked at keeps id, points and time."""
    low = [replace(camera, height=60, cy=-10.0) for camera in cameras(14)]  # the lower rows: the near floor
    seen = og.update(monday, scene([CHEST, BIN, CRATE], low, seed=10), progress=False)
    assert seen.changes.gone == ()
    assert seen.changes.new == ()
    for thing in BEFORE:
        assert instance_of(seen.cloud, thing) == instance_of(monday, thing)


def test_a_visit_without_colors_leaves_the_map_its_own(monday):
    visit = scene(AFTER, seed=1)
    plain = replace(visit, points=replace(visit.points, rgb=None))
    cloud, bare = og.update(monday, plain, progress=False).cloud, og.fit(plain, progress=False)
    kept = np.isin(cloud.xyz, monday.xyz).all(axis=1)
    assert 0 < np.count_nonzero(~kept) < np.count_nonzero(kept)
    assert (cloud.rgb[~kept] == 128).all()
    np.testing.assert_array_equal(cloud.rgb[kept], monday.rgb[np.isin(monday.xyz, cloud.xyz[kept]).all(axis=1)])
    assert og.update(bare, plain, progress=False).cloud.rgb is None


def test_a_map_survives_its_file(updated, tmp_path):
    path = og.write_bundle(updated.cloud, tmp_path / "map.ogpc")
    read = og.load(path).cloud
    assert MapRecord.of(read).added_to({}) == MapRecord.of(updated.cloud).added_to({})
    assert len(read.cameras) == len(updated.cloud.cameras) == 28
    for one, other in zip(read.cameras, updated.cloud.cameras, strict=True):
        np.testing.assert_array_equal(one.world_to_camera, other.world_to_camera)


def test_a_file_of_before_has_no_cameras_and_says_so(monday):
    bare = replace(monday, cameras=())
    with pytest.raises(SceneError, match="has no cameras"):
        og.compare(monday, bare)
    assert len(og.compare(bare, monday).new) == 0


def test_another_place_is_refused(monday, friday):
    turned = replace(friday, origin=friday.origin + np.array([0.0, 0.0, 1.0]))
    with pytest.raises(SceneError, match="not in the same world frame"):
        og.compare(monday, turned)
    below = replace(friday, origin=friday.origin - np.array([0.0, 0.0, 50.0]))  # its cameras look down, away from it
    with pytest.warns(UserWarning, match="looks at none of the earlier visit's .* points: they do not overlap") as said:
        og.compare(monday, below)
    assert (len(said), said[0].filename) == (1, __file__)


@pytest.mark.parametrize("unit", [0.001, 1 / 40, 0.3048, 1.5, 10, 40, 1000])
def test_a_visit_in_another_unit_is_refused(monday, friday, unit):
    """With one origin, so that the floor lies on the floor; one thing left, one moved, one came."""
    with pytest.raises(SceneError, match=r"times as long as .* different units of length"):
        og.compare(monday, scaled(friday, unit))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("spacings", "told"), [(0.5, False), (1.5, True), (3, True)])
def test_a_visit_that_is_a_little_off_is_doubted(monday, friday, spacings, told):
    """Sideways, where the floor tells nothing."""
    aside = replace(friday, origin=friday.origin + spacings * monday.spacing * np.array([0.8, 0.6, 0.0]))
    doubt = pytest.raises(UserWarning, match=r"lies about 0\.0\d+ off the earlier one, .* register their poses")
    with doubt if told else nullcontext():
        og.compare(monday, aside)


def test_a_visit_that_seems_to_move_most_things_is_doubted(monday):
    aside = replace(monday, origin=monday.origin + np.array([0.4, 0.0, 0.0]))
    with pytest.warns(UserWarning, match="3 of the 4 things .* not in the same world frame: register") as said:
        assert len(og.compare(monday, aside).moved) == 3
    assert (len(said), said[0].filename) == (1, __file__)


def test_another_encoder_is_refused(monday):
    other = replace(scene(AFTER), feature_space="another-space")
    with pytest.raises(FeatureSpaceError, match=f"expected feature space '{SPACE}'"):
        og.update(monday, other, progress=False)
    with pytest.raises(SceneError, match="capture is a list; expected a folder, or a Scene"):
        og.update(monday, [], progress=False)


def test_a_folder_is_read_with_its_depth_images(tiny_capture):
    before = og.fit(og.read_capture(tiny_capture.folder), progress=False)
    same = og.update(before, str(tiny_capture.folder), progress=False)
    assert str(same.changes) == "0 gone, 0 new, 0 moved, 0 not seen again"
    for k in range(6):  # a wall before each camera
        write_depth(tiny_capture.folder / "depth" / f"view{k}.png", np.full((HEIGHT, WIDTH), 0.5))
    with pytest.raises(SceneError, match="0 are where they were"):
        og.update(before, tiny_capture.folder, progress=False)


def test_a_visit_adds_its_words_and_a_carried_text_encoder_stays(tiny_capture, tmp_path):
    folder, before, after = tiny_capture.folder, tmp_path / "before.ogpc", tmp_path / "after.ogpc"
    assert main(["fit", str(folder), "-o", str(before)]) == 0
    width = og.load(before).cloud.instances.descriptors.shape[1]
    carry_encoder(before, write_files(tmp_path / "encoder", encoder_files(FEATURE_SPACE, width)))
    vectors = np.eye(2, width, dtype=np.float32)
    np.savez(folder / "text_features.npz", names=["vase", NAMES[0]], vectors=vectors, feature_space=FEATURE_SPACE)
    assert main(["update", str(before), str(folder), "-o", str(after)]) == 0
    known, words = og.load(before).vocabulary.names, og.load(after).vocabulary
    assert words.names == (*known, "vase")
    np.testing.assert_array_equal(words.vectors[[-1, known.index(NAMES[0])]], vectors)
    assert read_carried_encoder(after) == read_carried_encoder(before) is not None
    mapper, capture = og.Mapper(after), og.read_capture(folder)
    for view in capture.views:
        camera = in_local_frame(view.camera, -capture.points.origin)
        mapper.integrate(og.Frame(camera, view.mask_map(), view.mask_features))
    assert read_carried_encoder(mapper.save(tmp_path / "later.ogpc")) == read_carried_encoder(before)


def test_a_map_that_is_written_over_keeps_its_text_encoder(tiny_capture, tmp_path):
    folder, file = tiny_capture.folder, tmp_path / "room.ogpc"
    assert main(["fit", str(folder), "-o", str(file)]) == 0
    width = og.load(file).cloud.instances.descriptors.shape[1]
    carry_encoder(file, write_files(tmp_path / "encoder", encoder_files(FEATURE_SPACE, width)))
    carried = read_carried_encoder(file)
    mapper, capture = og.Mapper(file), og.read_capture(folder)
    for view in capture.views:
        camera = in_local_frame(view.camera, -capture.points.origin)
        mapper.integrate(og.Frame(camera, view.mask_map(), view.mask_features))
    assert read_carried_encoder(mapper.save(file)) == carried is not None
    file.unlink()  # the map in memory is still saved
    assert len(og.load(mapper.save(file)).xyz) == len(mapper.snapshot().xyz)


def test_a_map_without_points_is_refused(monday):
    none = replace(monday, xyz=monday.xyz[:0], instance_ids=monday.instance_ids[:0], rgb=None, certainty=None)
    for pair in ((none, monday), (monday, none)):
        with pytest.raises(SceneError, match="0 points; expected at least one"):
            og.compare(*pair)
    with pytest.raises(SceneError, match="0 points; expected at least one"):
        og.Mapper(none)


def test_a_damaged_record_is_refused(monday):
    with pytest.raises(OgPointcloudError, match="record of its visits is damaged"):
        MapRecord.of(replace(monday, provenance={"map": {"visits": 3}}))
    empty = {"visits": [], "last_seen": {}, "moved_from": {}, "gone": {}}
    with pytest.raises(OgPointcloudError, match="has no visits; expected at least one"):
        MapRecord.of(replace(monday, provenance={"map": empty}))


@pytest.mark.slow
def test_the_commands_write_what_changed(monday, friday, tmp_path, capsys):
    one, other = (og.write_bundle(cloud, tmp_path / f"{name}.ogpc") for name, cloud in (("m", monday), ("f", friday)))
    assert main(["compare", str(one), str(other), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report == og.compare(monday, friday).to_dict()
    assert main(["compare", str(one), str(other)]) == 0
    assert capsys.readouterr().out.splitlines()[-1].endswith("--html changes.html")


def test_memory_does_not_grow_with_the_square_of_the_instances():
    """Two visits of 3,000 tiles of 4 points; a table of 3,000 x 3,000 float64 would be 72 MB."""
    corner = np.stack(np.meshgrid(np.arange(120), np.arange(100)), axis=-1).reshape(-1, 2)
    ids = corner[:, 0] // 2 + 60 * (corner[:, 1] // 2)
    tiles = make_cloud(0.02 * np.c_[corner - [60, 50], np.zeros(len(ids))], ids, words=None)
    tiles = replace(tiles, cameras=tuple(cameras(2)))
    tracemalloc.start()
    assert str(og.compare(tiles, tiles)) == "0 gone, 0 new, 0 moved, 0 not seen again"
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 72e6


def test_a_camera_without_a_view_of_anything_says_nothing(monday):
    away = Camera(64, 48, 60.0, 60.0, 32.0, 24.0, np.diag([1.0, -1.0, -1.0, 1.0]))
    view = view_of_depth(np.zeros((48, 64), np.float32), away)
    assert (states_of_points(monday.xyz, 0.02, view) == NOTHING).all()
