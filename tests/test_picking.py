"""Clicks select instances: the drawing against loops over pixels and points, invariances, and every kind of miss."""

import itertools
import math
import warnings
from dataclasses import replace

import numpy as np
import pinhole
import pytest
from labelled_clouds import WORDS, make_cloud, queries, room, unit_rows

import og_pointcloud as og
from og_pointcloud.ask import picking
from og_pointcloud.ask.labelled_scene import LabelledScene
from og_pointcloud.ask.picking import NO_POINT, front_points, in_world, pick
from og_pointcloud.cloud import BACKGROUND, TOO_FAR, UNOBSERVED
from og_pointcloud.errors import FeatureSpaceError, OgPointcloudError
from og_pointcloud.scene import Camera


def looking(position, target, width=40, height=30, focal=30.0):
    """A camera in world coordinates at ``position`` whose image center shows ``target``; world z is up."""
    pose = pinhole.looking(position, np.subtract(target, position))
    return Camera(width, height, focal, 1.1 * focal, width / 2 + 0.3, height / 2 - 0.2, pose)


FROM_ABOVE = looking([1, 3, 2], [1, 0.7, 0.3])
"""Of the room: its floor at z = 0 and its wall at y = 0, both 2 x 2."""


def front_points_plainly(cloud, camera):
    """front_points, written from its description for images no finer than the cloud."""
    in_camera = cloud.xyz_world @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    front = np.full((camera.height, camera.width), NO_POINT)
    for row, column in itertools.product(range(camera.height), range(camera.width)):
        covering = []
        for point, (x, y, depth) in enumerate(in_camera):
            if depth <= cloud.spacing:
                continue
            across = column - math.floor(camera.fx * x / depth + camera.cx)
            down = row - math.floor(camera.fy * y / depth + camera.cy)
            half = min(
                round(picking.HALF_SIDE_SPACINGS * np.sqrt(camera.fx * camera.fy) * cloud.spacing / depth),
                picking.MAX_HALF_SIDE_PX,
            )
            if max(abs(across), abs(down)) <= half:
                covering.append((across**2 + down**2, across, down, depth, point))
        if covering:
            surface = min(depth for *_, depth, _ in covering)
            front[row, column] = min(c for c in covering if c[3] <= surface + cloud.reach)[4]
    return front


def test_the_drawing_is_that_of_loops_over_pixels_and_points():
    random = np.random.default_rng(2)
    xyz = np.concatenate([room(150).xyz, random.random((50, 3)) * [2, 2, 0.01] + [0, 0, 1.2], [[1, 2.6, 1.7]]])
    cloud = make_cloud(xyz, random.integers(-2, 5, len(xyz)), 0.06, 0.18, origin=(3, 4, 5))
    camera = replace(FROM_ABOVE, world_to_camera=FROM_ABOVE.world_to_camera.copy())
    camera.world_to_camera[:3, 3] -= camera.world_to_camera[:3, :3] @ [3, 4, 5]
    plain = front_points_plainly(cloud, camera)
    assert len(np.unique(plain)) > 100
    assert 0.05 < (plain == NO_POINT).mean() < 0.9
    assert np.array_equal(front_points(cloud, camera), plain)


@pytest.mark.parametrize("zoom", [1, 20])
def test_a_click_hits_what_the_drawing_shows(zoom):
    cloud = room()
    camera = FROM_ABOVE.resized(40 * zoom, 30 * zoom)
    front = front_points(cloud, camera)
    seen = set()
    for u, v in np.random.default_rng(0).random((60, 2)) * [camera.width, camera.height]:
        hit, drawn = pick(cloud, camera, (u, v)), front[int(v), int(u)]
        assert hit.point == (None if drawn == NO_POINT else drawn)
        assert hit.instance == (TOO_FAR if drawn == NO_POINT else cloud.instance_ids[drawn])
        assert hit.found == (hit.instance >= 0)
        if hit.found:
            assert np.array_equal(hit.xyz_world, cloud.xyz_world[drawn])
            assert np.array_equal(hit.point_indices, np.flatnonzero(cloud.instance_ids == hit.instance))
            assert hit.mask(camera)[int(v), int(u)]
        seen.add(hit.instance)
    assert len(seen) >= 6
    assert TOO_FAR in seen


def plate_before_wall():
    """A plate of side 1 (instance 0) one before a wall of side 6 (instance 1), 0.1 apart."""
    grids = []
    for side, depth in ((1, 1.0), (6, 2.0)):
        line = np.arange(-side / 2, side / 2 + 0.01, 0.1)
        x, z = np.meshgrid(line, line)
        grids.append(np.stack([x.ravel(), np.full(x.size, depth), z.ravel()], axis=1))
    return make_cloud(np.concatenate(grids), np.repeat([0, 1], [len(grid) for grid in grids]), 0.1, 0.3)


AHEAD = looking([0, -1, 0], [0, 1, 0], width=64, height=48, focal=40.0)


def test_masks_are_closed_and_hidden_by_what_lies_in_front():
    cloud = plate_before_wall()
    plate, wall = pick(cloud, AHEAD, (32, 24)), pick(cloud, AHEAD, (50, 24))
    assert (plate.instance, wall.instance) == (0, 1)
    rows, columns = np.nonzero(plate.mask(AHEAD))
    assert len(rows) > 0.98 * (np.ptp(rows) + 1) * (np.ptp(columns) + 1), "a full rectangle, but for its corners"
    # The plate spans 20 px and 22 px; a footprint more at each side is allowed.
    assert 20 <= np.ptp(columns) + 1 <= 28
    assert 22 <= np.ptp(rows) + 1 <= 30
    assert (plate.mask(AHEAD) ^ wall.mask(AHEAD)).all(), "every pixel is one or the other"
    behind = looking([0, 4, 0], [0, 1, 0], width=64, height=48, focal=20.0)
    assert not plate.mask(behind).any(), "from behind, the wall hides it"
    assert pick(cloud, behind, (32, 24)).instance == 1


def moved(cloud, camera, offset):
    """The scene and the camera, the same in a world whose coordinates are larger by ``offset``."""
    pose = camera.world_to_camera.copy()
    pose[:3, 3] -= pose[:3, :3] @ offset
    return replace(cloud, origin=cloud.origin + offset), replace(camera, world_to_camera=pose)


def scaled(cloud, camera, factor):
    pose = camera.world_to_camera.copy()
    pose[:3, 3] *= factor
    lengths = {"spacing": cloud.spacing * factor, "reach": cloud.reach * factor}
    smaller = replace(cloud, xyz=(cloud.xyz * factor).astype(np.float32), **lengths)
    return smaller, replace(camera, world_to_camera=pose)


def test_map_coordinates_and_millimeters_change_nothing():
    cloud = room()
    expected = front_points(cloud, FROM_ABOVE)
    assert np.array_equal(front_points(*moved(cloud, FROM_ABOVE, np.array([1e6, -2e6, 300]))), expected)
    assert np.array_equal(front_points(*scaled(cloud, FROM_ABOVE, 2.0**-10)), expected)
    assert np.mean(front_points(*scaled(cloud, FROM_ABOVE, 1e-3)) == expected) > 0.99


def test_shuffled_points_give_the_same_masks():
    cloud = room()
    order = np.random.default_rng(4).permutation(len(cloud))
    shuffled = replace(cloud, xyz=cloud.xyz[order], instance_ids=cloud.instance_ids[order])
    assert np.array_equal(np.append(order, -1)[front_points(shuffled, FROM_ABOVE)], front_points(cloud, FROM_ABOVE))


def test_cameras_of_a_capture_are_taken_to_the_world():
    cloud = replace(room(), origin=np.array([4e5, -7e5, 12.0]))
    local = FROM_ABOVE  # as a capture holds it: from coordinates without the origin
    expected = front_points(replace(cloud, origin=np.zeros(3)), local)
    assert np.array_equal(front_points(cloud, in_world(local, cloud.origin)), expected)
    assert np.allclose(in_world(local, cloud.origin).center, local.center + cloud.origin)


def test_clicks_on_background_on_unobserved_points_and_on_nothing_say_so():
    cloud = plate_before_wall()
    for state, words in ((BACKGROUND, "background"), (UNOBSERVED, "unobserved")):
        ids = np.where(cloud.instance_ids == 0, state, cloud.instance_ids)
        hit = pick(replace(cloud, instance_ids=ids.astype(np.int32)), AHEAD, (32, 24))
        assert (hit.instance, hit.found) == (state, False)
        assert hit.point is not None
        assert words in str(hit)
        for ask in (lambda hit=hit: hit.mask(AHEAD), lambda hit=hit: hit.point_indices, hit.words):
            with pytest.raises(OgPointcloudError, match=words):
                ask()
    away = looking([0, -1, 0], [0, -2, 0], width=64, height=48)
    hit = pick(cloud, away, (32, 24))
    assert (hit.instance, hit.point, hit.xyz_world) == (TOO_FAR, None, None), "all points are behind the camera"
    assert str(hit) == "no point of the scene"
    assert not pick(cloud, AHEAD, (32, 24)).mask(away).any()


def test_clouds_with_next_to_no_points():
    assert pick(make_cloud(np.zeros((0, 3)), []), AHEAD, (5, 5)).instance == TOO_FAR
    assert pick(make_cloud(np.zeros((0, 3)), []), (0, 0, 0)).instance == TOO_FAR
    one = make_cloud([[0, 1, 0]], [0], 0.1, 0.3)
    hit = pick(one, AHEAD, (AHEAD.cx, AHEAD.cy))
    assert (hit.instance, hit.point) == (0, 0)
    assert 1 <= hit.mask(AHEAD).sum() <= 100
    assert pick(make_cloud([[0, 1, 0]] * 50, np.zeros(50), 0.1, 0.3), AHEAD, (AHEAD.cx, AHEAD.cy)).point == 0


@pytest.mark.parametrize("uv", [(64, 5), (5, 48), (-0.1, 5), (np.nan, 5), (5,), None])
def test_pixels_outside_the_image_are_refused(uv):
    with pytest.raises(OgPointcloudError, match="expected a pixel"):
        pick(plate_before_wall(), AHEAD, uv)


def test_places_find_what_query_points_find(tmp_path):
    scene = LabelledScene.from_cloud(replace(room(800), origin=np.array([1e6, -4e6, 350.25])))
    places = queries(scene.cloud, 60)[:-2].astype(np.float64) + scene.cloud.origin
    picked = [pick(scene, place).instance for place in places]
    assert picked == scene.instances_at(places).tolist()
    assert {TOO_FAR, BACKGROUND} < set(picked)
    og.write_bundle(scene.cloud, tmp_path / "room.ogpc")
    assert [pick(tmp_path / "room.ogpc", place).instance for place in places[:5]] == picked[:5]


@pytest.mark.parametrize(
    ("where", "uv", "text"),
    [
        ((0, 0), None, "three finite world coordinates"),
        ("abc", None, "three finite world coordinates"),
        ([[0], [0, 0]], None, "three finite world coordinates"),
        ((0, 0, np.inf), None, "three finite world coordinates"),
        ((0, 0, 0), (3, 4), "expected it only with a Camera"),
    ],
)
def test_bad_places_are_refused(where, uv, text):
    with pytest.raises(OgPointcloudError, match=text):
        pick(room(), where, uv)


def test_a_camera_that_float32_rounded_is_told_where_it_matters():
    origin = np.array([431234.567, 5412345.678, 312.345])
    mapped = replace(room(), origin=origin)
    exact = in_world(FROM_ABOVE, origin)
    rounded = replace(exact, world_to_camera=exact.world_to_camera.astype(np.float32))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pick(mapped, exact, (20, 15))
        pick(room(), replace(FROM_ABOVE, world_to_camera=FROM_ABOVE.world_to_camera.astype(np.float32)), (20, 15))
    with pytest.warns(UserWarning, match=r"another point may be hit; float32 rounded the pose to steps of 0.5"):
        pick(mapped, rounded, (20, 15))


@pytest.mark.parametrize(("camera", "origin"), [(None, (0, 0, 0)), (AHEAD, 5), (AHEAD, np.eye(3)), (AHEAD, ("a",) * 3)])
def test_what_is_no_camera_or_no_origin_is_refused(camera, origin):
    with pytest.raises(OgPointcloudError, match=r"the camera is a .*; expected og.Camera and three numbers"):
        og.in_world(camera, origin)


def test_words_are_ranked_as_segment_scores_them():
    scene = LabelledScene.from_cloud(room())
    for instance in (0, 1, 4):
        place = scene.xyz[np.argmax(scene.instance_ids == instance)]
        words = pick(scene, place).words()
        scores = scene.cloud.instances.cosines(scene.vocabulary.vectors)[instance]
        if instance == 4:
            assert words == [], "it has no descriptor"
            continue
        assert dict(words) == pytest.approx(dict(zip(WORDS, scores.tolist(), strict=True)), abs=1e-6)
        assert [score for _, score in words] == sorted((score for _, score in words), reverse=True)
    hit = pick(scene, scene.xyz[np.argmax(scene.instance_ids == 1)])
    assert hit.words({"it": 3 * unit_rows(9)[2]})[0][0] == "it"
    with pytest.raises(FeatureSpaceError, match=r"dimension 3"):
        hit.words({"narrow": np.ones(3)})
