"""Each fault that captures have is told on a small room, with the repair that mends it; right rooms are silent."""

import json
import warnings
from collections import Counter
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from checked_room import tiled_room, with_cameras, with_views
from commands import error_of, output_of
from scenes import write_scene
from scipy.spatial.transform import Rotation

import og_pointcloud as og
from og_pointcloud.bundle.read import read_bundle
from og_pointcloud.checking.check import (
    MAX_BLENDED_SHARE,
    CaptureWarning,
    _coordinates,
    check_capture,
    check_cloud,
    check_words,
    warn_of_doubts,
)
from og_pointcloud.checking.masks import MaskMaps, _blended, entropies
from og_pointcloud.checking.photographs import Photographs
from og_pointcloud.checking.sample import SAMPLE_VIEWS, Comparison, draw_sample, seen
from og_pointcloud.cli import main
from og_pointcloud.cloud import UNOBSERVED
from og_pointcloud.errors import SceneError
from og_pointcloud.fitting.fit import fit_prepared, prepare
from og_pointcloud.formats.mask_files import MaskLayer
from og_pointcloud.formats.poses import in_local_frame, rotation_of_vector
from og_pointcloud.formats.repairs import KINDS, Repair, read_repairs, repaired_cameras, repaired_layers
from og_pointcloud.scene import Camera, Points

SMALL = {"views": 6, "points": 3000}
TABLE = Path(__file__).resolve().parents[2] / "shared" / "data" / "ycb_0050"


def parsed(text):
    return [Repair.parse(word) for word in text.split()]


def faulty(text, seed=1, **options):
    """A room whose cameras are wrong by what a repair does."""
    return with_cameras(tiled_room(seed, **options), lambda cameras: repaired_cameras(cameras, parsed(text)))


def mended(scene, text):
    return with_cameras(scene, lambda cameras: repaired_cameras(cameras, parsed(text)))


def verdicts(checks):
    return {check.name: check.verdict for check in checks}


def doubts(scene):
    return {check.name: check for check in check_capture(scene) if check.verdict == "doubt"}


def for_release(*cases):
    return [pytest.param(case, marks=[pytest.mark.slow, pytest.mark.release]) for case in cases]


@pytest.fixture(scope="module")
def fitted():
    return og.fit(tiled_room(1, **SMALL), progress=False)


def check_poses(scene):
    """What `check_capture` says where there are no masks."""
    nothing = np.full(scene.views[0].mask_map().shape, -1, np.int32)
    return check_capture(with_views(scene, masks=lambda *_: nothing, mask_features=lambda *_: np.zeros((0, 0), "f4")))


def without_colors(scene):
    return replace(scene, points=replace(scene.points, rgb=None))


def named(scene, names):
    return replace(scene, views=tuple(replace(scene.views[0], name=name) for name in names))


# Right rooms.


@pytest.mark.parametrize("count", [SAMPLE_VIEWS - 1, 2 * SAMPLE_VIEWS])
def test_of_images_cut_into_faces_the_fronts_are_asked_where_there_are_enough(count):
    room = tiled_room(1, views=1, points=100)
    names = [f"{index:02}/{face}" for index in range(count) for face in ("front", "left", "up")]
    asked = {view.name.split("/")[1] for view in draw_sample(named(room, names)).views}
    assert (asked == {"front"}) == (count >= SAMPLE_VIEWS)
    # Cameras of a rig may be called so too.
    names = [f"{side}/{index:02}" for side in ("front", "left") for index in range(count)]
    assert {view.name.split("/")[0] for view in draw_sample(named(room, names)).views} == {"front", "left"}


@pytest.mark.parametrize("seed", [0, *for_release(1, 2, 3)])
def test_a_right_room_is_silent_and_every_check_is_made(seed):
    checks = check_capture(tiled_room(seed))
    assert verdicts(checks) == dict.fromkeys(("poses", "alignment", "masks", "features"), "ok")
    with warnings.catch_warnings():
        warnings.simplefilter("error", CaptureWarning)
        warn_of_doubts(checks)


@pytest.mark.parametrize("options", [{"origin": (5e5, 4e6, 0), "scale": 100.0}, {"views": 3}, {"points": 1500}])
def test_offsets_units_few_views_and_few_points_raise_no_doubt(options):
    assert doubts(tiled_room(2, **options)) == {}


def test_points_at_one_place_have_no_coordinates_to_doubt():
    for count in (1, 3):
        points = Points(np.zeros((count, 3), np.float32), np.array([4e6, 5e5, 100.0]))
        assert _coordinates(points) == []


@pytest.mark.parametrize("stray", [False, True])
def test_map_coordinates_that_float32_rounded_are_a_doubt(stray):
    """A right cloud, and its cameras, of which a program has kept the cloud's coordinates as float32; also with a point
    at the origin of the map, where scanners put what they did not measure."""
    room = tiled_room(2, origin=(431234.567, 5412345.678, 312.0))
    xyz = room.points.xyz_world.astype(np.float32)
    xyz[0] *= not stray
    rounded = Points.from_world(xyz, rgb=room.points.rgb)
    found = doubts(with_cameras(replace(room, points=rounded), lambda cameras: cameras))["coordinates"]
    assert "in steps of 0.5 at 5412347.0" in found.says


@pytest.mark.parametrize("views", [slice(None), slice(0, 4), slice(2, 5), slice(2, 4)])
def test_a_pixel_of_a_small_smooth_image_is_no_fault(tiny_capture, views):
    """Where every number may change, or in few views, points move by more than the bound: no fault."""
    scene = og.read_capture(tiny_capture.folder)
    assert doubts(replace(scene, views=scene.views[views])) == {}


@pytest.mark.parametrize(("own", "verdict"), [(0.96, "ok"), (0.9, "doubt")])
def test_a_drawing_as_like_its_photograph_as_photographs_of_the_same_is_right(own, verdict, monkeypatch):
    """Whatever it loses against others: of views nearly alike a third of the comparisons go the other way."""
    found = Comparison(0.62, own, 0.75, 0.1, 16, "correlation")
    monkeypatch.setattr(Photographs, "fit", lambda self, cameras: found)
    monkeypatch.setattr("og_pointcloud.checking.check.best_conversion", lambda photographs: ())
    assert verdicts(check_poses(tiled_room(**SMALL)))["poses"] == verdict


@pytest.mark.parametrize(
    ("share", "error", "verdict"),
    [(0.7, 0.035, "unchecked"), (0.7, 0.01, "doubt"), (0.5, 0.035, "doubt"), (0.8, 0.01, "unchecked")],
)
def test_masks_too_ragged_to_tell_right_ones_from_wrong_ones_are_unchecked(share, error, verdict, monkeypatch):
    """The first is what a right walk gives, whose masks miss the floor in one view and not in the next."""
    found = Comparison(share, 0.23, 0.16, 0.07, 67, "information", error)
    monkeypatch.setattr(MaskMaps, "fit", lambda self, cameras: found)
    scene = tiled_room(**SMALL)
    assert verdicts(check_capture(scene))["masks"] == verdict
    assert verdicts(check_capture(without_colors(scene)))["poses"] == verdict


def test_the_error_of_a_gap_counts_groups_and_not_comparisons():
    random = np.random.default_rng(0)
    groups = np.repeat(np.arange(400), 5)
    own = random.normal(0.3, 0.1, 400)[groups]  # a group's comparisons are right or wrong together
    found = Comparison.of([(value, 0.1) for value in own], "", groups=groups.tolist())
    assert found.error == pytest.approx(0.1 / np.sqrt(400), rel=0.1)
    order = random.permutation(len(own))
    shuffled = Comparison.of([(value, 0.1) for value in own[order]], "", groups=(7 * groups[order]).tolist())
    assert shuffled.error == pytest.approx(found.error)
    assert Comparison.of([(0.5, 0.1), (0.6, 0.1)], "", groups=[3, 3]).error == np.inf


@pytest.mark.skipif(not TABLE.exists(), reason="the capture ycb_0050 is not here")
@pytest.mark.parametrize("views", [3, 4])
def test_neighboring_views_whose_photographs_are_nearly_alike_raise_no_doubt(views):
    """A drawing fits its neighbors' photographs nearly as well as its own, which it fits as well as can be."""
    scene = og.read_capture(TABLE)
    assert not doubts(replace(scene, views=scene.views[:views]))


def test_the_order_of_views_and_points_does_not_matter_for_a_right_room():
    scene = tiled_room(0)
    order = np.random.default_rng(0).permutation(len(scene.points))
    shuffled = replace(scene, points=scene.points.take(order), views=scene.views[::-1])
    assert verdicts(check_capture(shuffled)) == verdicts(check_capture(scene))


def test_what_cannot_be_checked_is_said_to_be_unchecked():
    scene = without_colors(tiled_room(0))
    assert verdicts(check_capture(scene)) == {
        "poses": "ok", "alignment": "unchecked", "masks": "ok", "features": "ok",
    }  # fmt: skip
    one = replace(scene, views=scene.views[:1])
    assert set(verdicts(check_capture(one)).values()) == {"unchecked"}
    assert verdicts(check_poses(scene)) == {"poses": "unchecked", "alignment": "unchecked"}


def test_equal_views_cannot_be_compared():
    scene = tiled_room(0)
    first = scene.views[0]
    same = replace(scene, views=tuple(replace(first, name=view.name) for view in scene.views))
    assert "masks" not in doubts(same)
    assert "poses" not in doubts(without_colors(same))


def test_another_exposure_and_noise_raise_no_doubt():
    random = np.random.default_rng(0)

    def changed(view, index, views):
        image = view.image_rgb() * random.uniform(0.5, 1) + random.uniform(0, 60) + random.normal(0, 8, (72, 96, 3))
        return np.clip(image, 0, 255).astype(np.uint8)

    assert doubts(with_views(tiled_room(3), image=changed)) == {}


def with_black_rims(scene):
    column, row = np.meshgrid(np.arange(96) - 47.5, np.arange(72) - 35.5)
    inside = (np.hypot(column / 48, row / 36) < 0.9)[..., None]
    return with_views(scene, image=lambda view, i, views: view.image_rgb() * inside.astype(np.uint8))


def test_what_lies_beyond_the_rim_of_a_lens_is_not_held_against_the_poses():
    assert verdicts(check_poses(with_black_rims(tiled_room(2, **SMALL)))) == {"poses": "ok", "alignment": "ok"}
    turned = with_black_rims(faulty("shifted=0.05,0.03", **SMALL))
    assert verdicts(check_poses(turned)) == {"poses": "ok", "alignment": "doubt"}


@pytest.mark.parametrize(("width", "height"), [(97, 71), (71, 97), (1000, 761), (33, 21), (2000, 40)])
def test_images_of_any_size_are_compared_on_the_grid_of_what_is_seen(width, height):
    scene = with_views(
        tiled_room(2, **SMALL),
        camera=lambda view, i, views: view.camera.resized(width, height),
        image=lambda view, i, views: cv2.resize(view.image_rgb(), (width, height)),
        masks=lambda view, i, views: cv2.resize(view.mask_map(), (width, height), interpolation=cv2.INTER_NEAREST),
    )
    assert doubts(scene) == {}


@pytest.mark.parametrize("is_grey", [True, False])
def test_intensities_and_colors_of_classes_are_not_held_against_photographs(is_grey):
    scene, random = tiled_room(1), np.random.default_rng(0)
    grey = random.integers(0, 255, (len(scene.points), 1), np.uint8).repeat(3, axis=1)
    palette = random.integers(0, 255, (12, 3), np.uint8)
    rgb = grey if is_grey else palette[random.integers(0, 12, len(scene.points))]
    painted = replace(scene, points=replace(scene.points, rgb=rgb))
    assert verdicts(check_capture(painted))["poses"] == "ok"  # by masks
    assert verdicts(check_poses(painted))["poses"] == "unchecked"


# Faults of poses, units and intrinsics: told by name, and mended by that name.

FAULTS = ["axes=flipped", "world=x,-z,y", "scale=0.37", "frames=1"]
MORE_FAULTS = [
    "direction=inverse", "axes=flipped direction=inverse", "direction=inverse axes=flipped", "world=y,-x,z",
    "world=-x,y,z", "scale=0.001", "frames=-1", "intrinsics=0.5", "intrinsics=4", "focal=0.3",
    "quaternions=xyzw quaternions=xyzw quaternions=xyzw",
]  # fmt: skip


@pytest.mark.parametrize("fault", [*FAULTS, *for_release(*MORE_FAULTS)])
def test_a_fault_of_the_poses_is_told_and_its_repair_makes_every_check_good(fault):
    scene = faulty(fault, **SMALL)
    check = doubts(scene)["poses"]
    assert check.repair
    assert "axes, direction, order" in check.says
    assert doubts(mended(scene, check.repair)) == {}


@pytest.mark.parametrize("fault", ["axes=flipped", *for_release("intrinsics=0.5")])
def test_masks_stand_in_for_missing_colors(fault):
    scene = without_colors(faulty(fault))
    check = doubts(scene)["poses"]
    assert check.repair
    assert doubts(mended(scene, check.repair)) == {}


def test_cameras_that_see_nothing_are_told_without_photographs_too():
    away = with_views(
        faulty("scale=1"),
        camera=lambda view, i, views: replace(view.camera, cx=-900.0),
        image=lambda view, i, views: None,
    )
    check = doubts(away)["poses"]
    assert "see almost none of the cloud" in check.says
    assert check.repair == "center=middle"


@pytest.mark.slow
@pytest.mark.release
def test_poses_in_random_order_are_told_and_nothing_is_named():
    random = np.random.default_rng(0).permutation(10)
    shuffled = with_cameras(tiled_room(1), lambda cameras: [cameras[index] for index in random])
    assert doubts(shuffled)["poses"].repair == ""


@pytest.mark.parametrize(
    "fault",
    ["aligned=0,0,0,0,0,5,1", *for_release("aligned=0.2,0,0,0,0,0,1", "aligned=0,0,0,0,0,0,1.1", "shifted=0.05,0.03")],
)
def test_a_small_fault_is_told_with_a_repair_that_takes_it_back(fault):
    scene = faulty(fault)
    check = doubts(scene)["alignment"]
    assert check.repair
    assert doubts(mended(scene, check.repair)) == {}


def test_a_large_shift_is_taken_back_whole():
    found = next(check.repair for check in doubts(faulty("aligned=0.25,0,0,0,0,5,1")).values() if check.repair)
    (repair,) = parsed(found)
    np.testing.assert_allclose(repair.numbers[:3], [-0.25, 0, 0], atol=0.01)
    np.testing.assert_allclose(repair.numbers[3:], [0, 0, -5, 1], atol=0.15)


def test_swapped_principal_points_are_named():
    def swapped(cameras):
        return [replace(camera, cx=camera.cy, cy=camera.cx) for camera in cameras]

    wide = with_cameras(tiled_room(1), swapped)
    found = doubts(wide)
    repair = next(check.repair for check in found.values() if check.repair)
    assert doubts(mended(wide, repair)) == {}


# Faults of masks, features and photographs.


@pytest.mark.parametrize(("value", "flip"), [("mirrored", np.fliplr), ("turned", lambda ids: ids[::-1, ::-1])])
def test_masks_that_are_mirrored_or_turned_are_named(value, flip):
    scene = with_views(tiled_room(1), masks=lambda view, i, views: np.ascontiguousarray(flip(view.mask_map())))
    assert doubts(scene)["masks"].repair == f"masks={value}"


def test_masks_of_the_next_image_are_named():
    scene = with_views(
        tiled_room(1),
        masks=lambda view, i, views: views[(i + 1) % len(views)].masks,
        mask_features=lambda view, i, views: views[(i + 1) % len(views)].mask_features,
    )
    assert doubts(scene)["masks"].repair == "masks=previous"


def test_one_mask_over_every_image_is_told():
    scene = with_views(
        tiled_room(1),
        masks=lambda view, i, views: np.zeros((72, 96), np.int32),
        mask_features=lambda view, i, views: view.mask_features[:1],
    )
    assert "covers the whole image" in doubts(scene)["masks"].says


@pytest.mark.parametrize("is_jpeg", [False, True])
def test_pictures_of_ids_that_were_blended_are_told(is_jpeg):
    def blended(view, index, views):
        ids = (view.mask_map() + 1).astype(np.uint8)
        if is_jpeg:  # told apart by tens, as whoever stores ids so may do
            kept = cv2.imdecode(cv2.imencode(".jpg", np.repeat(np.repeat(10 * ids, 4, 0), 4, 1))[1], -1)[::4, ::4] // 10
        else:
            kept = cv2.resize(cv2.resize(ids, (144, 108)), ids.shape[::-1])
        return np.minimum(kept, view.mask_count).astype(np.int32) - 1

    scene = with_views(tiled_room(1), masks=blended)
    check = doubts(scene)["masks"]
    assert "ids between those on either side" in check.says
    assert check.repair == ""


def test_masks_a_pixel_wide_are_no_blended_ids():
    """As a proposer makes them of fine textures: their ids lie between those of both sides by chance alone."""
    random = np.random.default_rng(0)
    tiles = np.repeat(random.integers(0, 200, (300, 1000)), 8, axis=1)
    tiles[:, ::8] = random.integers(0, 200, (300, 1000))
    assert abs(_blended(tiles)) < MAX_BLENDED_SHARE
    halves = tiles[:, 1:-1].copy()
    halves[:, 7::8] = (tiles[:, 7:-8:8] + tiles[:, 9::8]) // 2  # of a smoothed picture
    assert _blended(halves) > 10 * MAX_BLENDED_SHARE


def test_ids_that_count_from_zero_are_named():
    scene = with_views(tiled_room(1), masks=lambda view, i, views: np.maximum(view.mask_map() - 1, -1))
    assert doubts(scene)["features"].repair == "masks=from-zero"


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda rows: rows[np.random.default_rng(len(rows)).permutation(len(rows))], "belong to other masks"),
        (lambda rows: np.concatenate([rows, rows]), "belong to no pixel"),
        (np.zeros_like, "are zero"),
        (np.ones_like, "are equal"),
    ],
)
def test_rows_of_features_that_cannot_be_right_are_told(change, says):
    scene = with_views(tiled_room(1), mask_features=lambda view, i, views: change(view.mask_features))
    assert says in doubts(scene)["features"].says


@pytest.mark.parametrize(
    "change", [lambda image: image / 255, lambda image: image[:, :-1], lambda image: image[..., 0]]
)
def test_photographs_that_cannot_be_read_are_told(change):
    room = tiled_room()
    scene = with_views(room, image=lambda view, index, _: change(view.image) if index in (1, 4, 5) else view.image)
    checks = check_capture(scene)
    [told] = [check for check in checks if check.verdict == "doubt"]
    assert told.name == "photographs"
    assert told.says.startswith("3 of 10 that were sampled cannot be read, and are not used: view '")
    assert check_capture(replace(scene, points=without_colors(scene).points))[-1].name != "photographs"


def test_photographs_of_another_place_are_told_apart_from_wrong_poses():
    random = np.random.default_rng(0)
    other = random.integers(0, 255, (72, 96, 3), np.uint8)
    scene = with_views(tiled_room(1), image=lambda view, i, views: np.roll(other, 9 * i, axis=1))
    assert set(doubts(scene)) == {"photographs"}


# What a fit says.


def test_a_fit_warns_and_keeps_its_checks_and_they_change_no_label():
    scene = faulty("axes=flipped", **SMALL)
    with pytest.warns(CaptureWarning, match=r"poses: .*try: og-pointcloud repair CAPTURE axes=flipped"):
        cloud = og.fit(scene, progress=False)
    names = [check["name"] for check in cloud.provenance["checks"]]
    assert names == [
        "poses", "alignment", "masks", "features", "points seen", "instances", "feature space",
    ]  # fmt: skip
    assert np.array_equal(cloud.instance_ids, fit_prepared(prepare(scene)).instance_ids)


def test_most_points_unseen_is_a_doubt_only_where_nothing_vouches_for_the_poses(fitted):
    mostly = np.where(np.arange(len(fitted)) % 4, UNOBSERVED, fitted.instance_ids)
    unseen = replace(fitted, instance_ids=mostly)
    assert verdicts(check_cloud(unseen))["points seen"] == "doubt"
    assert verdicts(check_cloud(unseen, check_capture(tiled_room(1, **SMALL))))["points seen"] == "ok"


def test_words_of_another_encoder_are_told(fitted):
    rows = fitted.instances.descriptors
    assert len(rows) >= 10
    names = tuple(map(str, range(len(rows))))
    right = replace(fitted, vocabulary=og.Vocabulary(names, rows))
    assert check_words(right).verdict == "ok"
    mixed = np.linalg.qr(np.random.default_rng(0).normal(size=(rows.shape[1],) * 2))[0]
    other = replace(fitted, vocabulary=og.Vocabulary(names[:2], (rows[:2] @ mixed).astype(np.float32)))
    assert check_words(other).verdict == "doubt"


# Repairs.


@pytest.mark.parametrize(
    "text",
    [
        "", "axes", "axes=", "axes=up", "scale=0", "scale=-1", "scale=nan", "frames=0.5", "aligned=1,2,3",
        "aligned=0,0,0,0,0,0,0", "world=x,x,z", "masks=next,next", "lens=1", "shifted=1",
    ],
)  # fmt: skip
def test_what_is_no_repair_is_refused_with_the_names_of_those_that_are(text):
    with pytest.raises(SceneError, match="is not a repair; expected name=value, name one of aligned, axes"):
        Repair.parse(text)


@pytest.mark.parametrize("content", ["[]", '{"repairs": "axes=flipped"}', '{"repairs": [1]}', '{"repairs": ["x=1"]}'])
def test_a_file_of_repairs_that_is_none_is_refused(tmp_path, content):
    (tmp_path / "repairs.json").write_text(content)
    with pytest.raises(SceneError, match="repair"):
        read_repairs(tmp_path)


def posed(seed):
    random = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    pose[:3, 3] = random.normal(size=3)
    return Camera(40, 30, 35.0, 36.0, 19.0, 14.0, pose)


@pytest.mark.parametrize("seed", range(5))
def test_repairs_of_poses_are_their_formulas(seed):
    camera, other = posed(seed), posed(seed + 50)
    pose = camera.world_to_camera

    def repaired(text):
        return repaired_cameras([camera, other], parsed(text))[0].world_to_camera

    assert np.allclose(repaired("axes=flipped"), np.diag([1, -1, -1, 1]) @ pose)
    assert np.allclose(repaired("direction=inverse") @ pose, np.eye(4))
    assert np.allclose(repaired("frames=1"), other.world_to_camera)
    assert np.allclose(repaired("scale=3")[:3, 3], 3 * pose[:3, 3])
    xyzw = Rotation.from_matrix(pose[:3, :3]).as_quat()
    stored_as = Rotation.from_quat(np.roll(xyzw, -1)).as_matrix()  # w x y z written, x y z w meant
    misread = replace(camera, world_to_camera=np.block([[stored_as, pose[:3, 3:]], [np.eye(4)[3:]]]))
    assert np.allclose(repaired_cameras([misread], parsed("quaternions=xyzw"))[0].world_to_camera, pose)
    point = np.array([[0.3, -0.2, 0.7]])
    turned = point[:, [1, 0, 2]] * [1, -1, 1]  # the poses' x is the cloud's y, their y its -x
    moved = repaired_cameras([camera], parsed("world=y,-x,z"))[0]
    assert np.allclose(moved.project(point)[0], camera.project(turned)[0])


@pytest.mark.parametrize("world", KINDS["world"].words[:16])
def test_every_naming_of_axes_gives_a_rigid_pose(world):
    rotation = repaired_cameras([posed(1)], parsed(f"world={world}"))[0].world_to_camera[:3, :3]
    assert np.linalg.det(rotation) == pytest.approx(1)
    assert np.allclose(rotation @ rotation.T, np.eye(3))


@pytest.mark.parametrize("seed", range(3))
def test_cameras_that_are_aligned_see_a_moved_cloud_as_they_saw_the_cloud(seed):
    cameras = [posed(seed), posed(seed + 9), posed(seed + 20)]
    repair = parsed("aligned=0.3,-0.2,0.1,10,-20,30,1.3")[0]
    turn = rotation_of_vector(np.deg2rad([10, -20, 30]))
    assert np.allclose(turn, Rotation.from_rotvec([10, -20, 30], degrees=True).as_matrix())
    mean = np.mean([camera.center for camera in cameras], axis=0)
    points = np.random.default_rng(seed).normal(size=(50, 3)) * 3
    moved = mean + 1.3 * (points - mean) @ turn.T + [0.3, -0.2, 0.1]
    for before, after in zip(cameras, repaired_cameras(cameras, [repair]), strict=True):
        uv, depth = before.project(points)
        uv_moved, depth_moved = after.project(moved)
        assert np.allclose(uv_moved, uv, equal_nan=True)
        assert np.allclose(depth_moved, 1.3 * depth)


def test_repairs_of_masks_are_their_formulas():
    ids = np.array([[0, 1, -1], [2, 1, 0]], np.int32)

    def repaired(text):
        return repaired_layers([MaskLayer((3, 2), np.zeros((3, 2), np.float32), lambda: ids)], parsed(text))[0].read()

    assert np.array_equal(repaired("masks=mirrored"), [[-1, 1, 0], [0, 1, 2]])
    assert np.array_equal(repaired("masks=upside-down"), [[2, 1, 0], [0, 1, -1]])
    assert np.array_equal(repaired("masks=turned"), [[0, 1, 2], [-1, 1, 0]])
    assert np.array_equal(repaired("masks=from-zero"), [[1, 2, -1], [3, 2, 1]])
    layers = [MaskLayer((3, 2), np.zeros((k, 2), np.float32), lambda: ids) for k in range(3)]
    assert [len(layer.features) for layer in repaired_layers(layers, parsed("masks=next"))] == [1, 2, 0]
    assert [len(layer.features) for layer in repaired_layers(layers, parsed("masks=previous"))] == [2, 0, 1]


@pytest.mark.parametrize("seed", range(3))
def test_entropies_are_their_formula(seed):
    random = np.random.default_rng(seed)
    a, b = random.integers(0, 4, 50), random.integers(0, 3, 50)

    def entropy(*labels):
        shares = np.array([count / 50 for count in Counter(zip(*labels, strict=True)).values()])
        return -(shares * np.log(shares)).sum()

    assert np.allclose(entropies(a, b), (entropy(a), entropy(b), entropy(a, b)))


def test_points_behind_others_are_not_seen():
    camera = Camera(48, 48, 48.0, 48.0, 24.0, 24.0, np.eye(4))
    side = np.linspace(-0.4, 0.4, 60)
    front = np.stack([*np.meshgrid(side, side), np.ones((60, 60))], axis=-1).reshape(-1, 3)
    behind = front * [2, 2, 2]
    found = seen(np.concatenate([front, behind, -front]), camera).rows
    assert np.array_equal(found, np.arange(len(front)))


# The commands.


def test_the_commands_tell_a_fault_repair_it_and_take_the_repair_back(tmp_path, capsys):
    folder = write_scene(tmp_path / "room", faulty("axes=flipped", **SMALL))
    fit = ["fit", str(folder), "-o", str(tmp_path / "room.ogpc"), "--json", str(tmp_path / "room.json")]
    assert main(fit) == 0
    said = capsys.readouterr()
    assert "warning: poses: " in said.err
    assert "doubt: poses: " in said.out
    assert f"try: og-pointcloud repair {folder} axes=flipped" in said.out
    for checks in (
        json.loads((tmp_path / "room.json").read_text())["checks"],
        read_bundle(tmp_path / "room.ogpc").cloud.provenance["checks"],
    ):
        assert [check["verdict"] for check in checks if check["name"] == "poses"] == ["doubt"]
    before = (folder / "transforms.json").read_bytes()
    assert "doubt" not in output_of(capsys, "repair", folder, "axes=flipped")
    assert doubts(og.read_capture(folder)) == {}
    assert (folder / "transforms.json").read_bytes() == before
    assert main(["repair", str(folder), "--undo"]) == 0
    assert not (folder / "repairs.json").exists()
    assert main(["repair", str(folder)]) == 0
    assert json.loads((folder / "repairs.json").read_text()) == {"repairs": ["axes=flipped"]}
    assert "axes=sideways" in error_of(capsys, "repair", folder, "axes=sideways")
    assert "nothing was found that needs a repair" in output_of(capsys, "repair", folder)


def test_a_repaired_capture_is_the_right_one(tmp_path):
    scene = tiled_room(1, views=4, points=500)
    right = og.read_capture(write_scene(tmp_path / "right", scene))
    wrong = write_scene(tmp_path / "wrong", faulty("axes=flipped scale=0.5", views=4, points=500))
    repaired = og.read_capture(wrong, repairs=["scale=2", "axes=flipped"])
    for one, other in zip(right.views, repaired.views, strict=True):
        assert np.allclose(one.camera.world_to_camera, other.camera.world_to_camera, atol=1e-5)
    stated = og.read_capture(wrong)
    assert not np.allclose(stated.views[0].camera.world_to_camera, right.views[0].camera.world_to_camera, atol=0.1)


def test_pick_and_masks_warn_of_poses_that_do_not_fit(tmp_path, capsys):
    scene = tiled_room(1, **SMALL)
    right = write_scene(tmp_path / "right", scene)
    assert main(["fit", str(right), "-o", str(tmp_path / "room.ogpc")]) == 0
    wrong = write_scene(tmp_path / "wrong", faulty("axes=flipped", **SMALL))
    capsys.readouterr()
    pick = ["pick", str(tmp_path / "room.ogpc"), "--view", "view00", "--pixel", "40,30", "--capture"]
    assert main([*pick, str(right)]) == 0
    assert "warning: poses" not in capsys.readouterr().err
    assert main([*pick, str(wrong)]) == 0
    assert "axes=flipped" in capsys.readouterr().err


# A cloud that is asked about lies elsewhere.


def test_a_cloud_that_lies_elsewhere_is_told_with_both_boxes(fitted):
    words = {"wall": fitted.instances.descriptors[0]}
    moved = fitted.xyz_world + np.array([1.5, 0, 0])
    with pytest.warns(
        UserWarning, match=r"too far from the scene, so other labels may be wrong.* points span .*, the scene "
    ):
        og.segment(moved, words, fitted)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        og.segment(fitted.xyz_world, words, fitted)


@pytest.mark.parametrize("pose", [np.diag([-1.0, 1, 1, 1]), np.diag([2.0, 2, 2, 1])])
def test_a_pose_that_mirrors_or_scales_is_refused(fitted, pose):
    with pytest.raises(SceneError, match="rigid"):
        og.segment(fitted.xyz_world, {"wall": fitted.instances.descriptors[0]}, fitted, pose=pose)


def test_cameras_come_back_from_the_world_as_they_were():
    scene = tiled_room(0, origin=(5e5, 4e6, 0.0))
    camera = scene.views[0].camera
    back = in_local_frame(in_local_frame(camera, -scene.points.origin), scene.points.origin)
    assert np.allclose(back.world_to_camera, camera.world_to_camera, atol=1e-8)
