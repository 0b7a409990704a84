"""Boxes: held to a slow search, to known boxes, to every invariance, and to strays and degenerate points."""

import itertools
from functools import partial

import numpy as np
import pytest
from labelled_clouds import room
from scipy.spatial import ConvexHull, cKDTree
from scipy.spatial.transform import Rotation

from og_pointcloud.ask import boxes
from og_pointcloud.ask.boxes import Box, axis_aligned_box, main_part, oriented_box
from og_pointcloud.ask.labelled_scene import instance_table
from og_pointcloud.errors import SceneError
from og_pointcloud.formats.poses import quaternion_of


def without_strays(xyz):
    """main_part, at the median distance to the third nearest other point."""
    distinct = np.unique(xyz, axis=0)
    third = min(4, len(distinct))
    spacing = float(np.median(np.reshape(cKDTree(distinct).query(distinct, third)[0], (len(distinct), -1))[:, -1]))
    return main_part(xyz, max(float(f"{spacing:.6g}"), 1e-12))


RANDOM_SHAPES = [(count, seed) for count in (5, 8, 20, 60) for seed in range(2)]


def least_volume_plainly(xyz):
    """Every facet of the hull as the floor of the box, and 400 directions more; each with the least rectangle on it."""
    hull = ConvexHull(xyz)
    floors = [*hull.equations[:, :3], *Rotation.random(400, random_state=0).as_matrix()[:, 0]]
    least = np.inf
    for floor in floors:
        helper = np.eye(3)[np.abs(floor).argmin()]
        u = np.cross(floor, helper) / np.linalg.norm(np.cross(floor, helper))
        v = np.cross(floor, u)
        least = min(least, least_area_plainly(xyz @ np.stack([u, v]).T) * np.ptp(xyz @ floor))
    return least


def least_area_plainly(flat):
    """Each pair of neighboring hull corners in turn as the direction of a side."""
    corners = flat[ConvexHull(flat).vertices]
    sides = [(b - a) / np.linalg.norm(b - a) for a, b in itertools.pairwise([*corners, corners[0]])]
    return min(np.ptp(corners @ side) * np.ptp(corners @ [-side[1], side[0]]) for side in sides)


def turned_box(size=(3.0, 2.0, 0.5), count=2000, seed=0):
    """Points on the faces of a turned box, its eight corners among them, and its rotation."""
    random = np.random.default_rng(seed)
    rotation = Rotation.random(random_state=seed).as_matrix()
    xyz = random.uniform(-0.5, 0.5, (count, 3))
    axis = random.integers(0, 3, count)
    xyz[np.arange(count), axis] = random.choice([-0.5, 0.5], count)
    corners = np.array(list(itertools.product([-0.5, 0.5], repeat=3)))
    return np.concatenate([xyz, corners]) * size @ rotation.T, rotation


def l_shape(seed=0):
    random = np.random.default_rng(seed)
    return np.concatenate([random.random((400, 3)) * [3, 0.3, 1], random.random((400, 3)) * [0.3, 2, 1]])


def assert_same_box(one, other, tolerance):
    """Equal as sets of points: axes may differ in order and sign where lengths agree."""
    np.testing.assert_allclose(one.center, other.center, atol=tolerance)
    assert one.contains(other.corners, tolerance).all()
    assert other.contains(one.corners, tolerance).all()


@pytest.mark.parametrize("margin", [0.0, 0.3])
def test_a_box_holds_what_lies_before_its_faces_and_no_more(margin):
    box = oriented_box(turned_box()[0])
    for axis, length in zip(box.axes, box.size, strict=True):
        face = box.center + np.outer([-1, 1], (length / 2 + margin) * axis)
        assert box.contains(face - 1e-9 * np.outer([-1, 1], axis), margin).all()
        assert not box.contains(face + 1e-9 * np.outer([-1, 1], axis), margin).any()


@pytest.mark.parametrize("offset", [0.0, 5e6])
@pytest.mark.parametrize("thickness", [0.0, 1.0])
def test_a_box_holds_the_points_it_was_made_from(offset, thickness):
    for seed in range(20):
        random = np.random.default_rng(seed)
        turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
        xyz = offset + random.normal(size=(50, 3)) * [2, 1, thickness] @ turn
        for box in (axis_aligned_box(xyz), oriented_box(xyz), oriented_box(xyz, up=turn[0])):
            assert box.contains(xyz).all()
            assert box.contains(box.corners).all()


@pytest.mark.parametrize(("count", "seed"), RANDOM_SHAPES)
def test_volume_is_near_that_of_a_slow_search(count, seed):
    """Within a tenth, not exact: a few scattered points have no faces that a box could lie flush with."""
    random = np.random.default_rng(seed)
    xyz = random.normal(size=(count, 3)) * random.uniform(0.2, 2, 3)
    box = oriented_box(xyz)
    assert box.contains(xyz, 1e-12).all()
    assert box.volume <= 1.1 * least_volume_plainly(xyz)


def test_box_of_a_box_is_that_box():
    xyz, rotation = turned_box()
    box = oriented_box(xyz)
    np.testing.assert_allclose(box.size, [3, 2, 0.5], atol=1e-9)
    np.testing.assert_allclose(np.abs(box.axes @ rotation), np.eye(3), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(box.axes), 1)
    assert len({tuple(corner) for corner in box.corners.round(6)}) == 8


def test_box_of_a_cube_whose_principal_axes_mean_nothing():
    xyz, _ = turned_box((1, 1, 1), seed=3)
    assert oriented_box(xyz).volume == pytest.approx(1, rel=1e-3)  # of few turns, from axes that mean nothing
    tetrahedron = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1.0]])
    assert oriented_box(tetrahedron @ Rotation.random(random_state=1).as_matrix().T).volume < 8 * 1.5  # at worst


@pytest.mark.parametrize(("count", "seed"), RANDOM_SHAPES)
def test_no_turn_about_one_of_its_own_axes_makes_the_box_smaller(count, seed):
    xyz = np.random.default_rng(seed).normal(size=(count, 3))
    box = oriented_box(xyz)
    for axis, (u, v) in zip(box.axes, ((1, 2), (2, 0), (0, 1)), strict=True):
        assert box.volume <= 1.01 * least_area_plainly(xyz @ box.axes[[u, v]].T) * np.ptp(xyz @ axis)


@pytest.mark.parametrize("seed", range(4))
def test_box_is_exact_where_the_points_inside_pull_the_principal_axes_aside(seed):
    random, rotation = np.random.default_rng(seed), Rotation.random(random_state=seed).as_matrix()
    corners = np.array(list(itertools.product([-0.5, 0.5], repeat=3)))
    inside = np.outer(random.uniform(-0.4, 0.4, 300), random.choice([-1, 1], 3))
    xyz = np.concatenate([corners, inside]) * [3, 2.5, 2] @ rotation.T
    np.testing.assert_allclose(oriented_box(xyz).size, [3, 2.5, 2], atol=1e-9)


def test_a_full_box_of_points_whose_outermost_ones_few_directions_touch():
    xyz = np.random.default_rng(0).uniform(-1, 1, (2000, 3)) * [3, 2, 0.3]
    assert oriented_box(xyz).volume < 1.02 * least_volume_plainly(xyz)


def test_many_points_that_few_directions_touch_still_lie_inside_a_small_box():
    ball = np.random.default_rng(0).normal(size=(5000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    box = oriented_box(ball)
    assert box.contains(ball, 1e-12).all()
    assert box.volume < 8


@pytest.mark.parametrize("up", [None, (0, 0, 1)])
def test_order_and_repetition_do_not_matter_at_all(up):
    xyz = l_shape()
    random = np.random.default_rng(1)
    again = np.concatenate([xyz, xyz[:300], xyz[:7]])[random.permutation(len(xyz) + 307)]
    for name in ("center", "size", "axes"):
        np.testing.assert_array_equal(getattr(oriented_box(again, up), name), getattr(oriented_box(xyz, up), name))


@pytest.mark.parametrize("seed", range(4))
def test_box_turns_moves_and_grows_with_its_points(seed):
    xyz, random = l_shape(), np.random.default_rng(seed)
    rotation, move, scale = (
        Rotation.random(random_state=seed).as_matrix(),
        random.normal(size=3),
        10.0 ** (3 * seed - 4),
    )
    box, other = oriented_box(xyz), oriented_box(scale * (xyz @ rotation.T + move))
    expected = Box(scale * (rotation @ box.center + move), scale * box.size, box.axes @ rotation.T)
    assert_same_box(other, expected, 1e-6 * scale)


def test_map_coordinates_cost_their_rounding_alone():
    xyz, _ = turned_box()
    far = oriented_box(xyz + np.array([1e6, -4e6, 350.25]))
    assert_same_box(Box(far.center - [1e6, -4e6, 350.25], far.size, far.axes), oriented_box(xyz), 1e-8)
    low = axis_aligned_box(xyz + 1e6).low - 1e6
    np.testing.assert_allclose(low, xyz.min(axis=0), atol=1e-9)


@pytest.mark.parametrize("up", [None, (0.0, 0.6, 0.8)])
def test_few_directions_at_once_give_the_same_box(up, monkeypatch):
    xyz = turned_box(count=300)[0]
    whole = oriented_box(xyz, up)
    monkeypatch.setattr(boxes, "MAX_PRODUCTS", 7 * len(xyz))
    assert_same_box(oriented_box(xyz, up), whole, 1e-12)


def test_upright_box_is_the_least_that_stands():
    xyz, _ = turned_box((3, 2, 1))
    yaw = Rotation.from_euler("z", 0.7).as_matrix()
    standing = np.array(list(itertools.product([-1.5, 1.5], [-1, 1], [0, 2]))) @ yaw.T
    box = oriented_box(standing, up=(0, 0, 5))
    np.testing.assert_allclose(box.axes[2], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(np.sort(box.size[:2]), [2, 3])
    leaning = oriented_box(xyz, up=(0.3, -0.2, 1))
    assert leaning.contains(xyz, 1e-12).all()
    assert leaning.volume > oriented_box(xyz).volume
    np.testing.assert_allclose(np.linalg.det(leaning.axes), 1)
    flat = oriented_box([[0, 0, 0], [0, 0, 2]], up=(0, 0, -1))
    np.testing.assert_allclose(flat.size, [0, 0, 2], atol=1e-12)
    np.testing.assert_allclose(flat.axes[2], [0, 0, -1])


DEGENERATE = {
    "one point": ([[1, 2, 3]], [0, 0, 0]),
    "coincident": ([[1, 2, 3]] * 50, [0, 0, 0]),
    "two points": ([[0, 0, 0], [1, 2, 2]], [3, 0, 0]),
    "collinear": (np.linspace(0, 1, 40)[:, None] * [1, 2, 2], [3, 0, 0]),
    "coplanar": ([[0, 0, 0], [2, 1, 0], [1, 3, 0], [-1, 2, 0]], [np.sqrt(5), np.sqrt(5), 0]),
}


@pytest.mark.parametrize("name", DEGENERATE)
@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_degenerate_points_have_a_box_with_lengths_of_zero(name, offset):
    xyz, size = DEGENERATE[name]
    rotation = Rotation.random(random_state=2).as_matrix()
    xyz = np.asarray(xyz, float) @ rotation.T + offset
    box = oriented_box(xyz)
    np.testing.assert_allclose(box.size, size, atol=1e-8)
    np.testing.assert_allclose(box.axes @ box.axes.T, np.eye(3), atol=1e-12)
    assert box.contains(xyz, 1e-8).all()
    assert axis_aligned_box(xyz).contains(xyz, 1e-8).all()
    assert without_strays(xyz).all()


@pytest.mark.parametrize(
    "points", [np.zeros((0, 3)), np.zeros((4, 2)), [[0, np.nan, 0]], [[0, np.inf, 0]], [[1e200, 0, 0]]]
)
def test_points_without_a_box_are_refused(points):
    for make in (axis_aligned_box, oriented_box, partial(main_part, spacing=1.0)):
        with pytest.raises(SceneError, match="expected"):
            make(points)


def test_a_box_contains_points_of_three_columns_alone():
    with pytest.raises(SceneError, match=r"points are float64 of shape \(4, 2\); expected numbers \(n, 3\)$"):
        axis_aligned_box(np.eye(3)).contains(np.zeros((4, 2)))
    assert axis_aligned_box(np.eye(3)).contains([[0.5, 0.5, 0.5], [np.nan, 0, 0]]).tolist() == [True, False]
    assert axis_aligned_box(np.eye(3)).contains(np.zeros((0, 3))).shape == (0,)


@pytest.mark.parametrize("up", [(0, 0, 0), (1, 0), (np.nan, 0, 1), "z"])
def test_an_up_without_direction_is_refused(up):
    with pytest.raises(SceneError, match="up is"):
        oriented_box(np.eye(3), up)
    with pytest.raises(SceneError, match="up is"):
        instance_table(room(), up=up)


@pytest.mark.parametrize("seed", range(6))
def test_quaternion_is_the_rotation(seed):
    turns = Rotation.random(5, random_state=seed).as_matrix()
    half_turns = Rotation.from_rotvec(np.pi * np.eye(3)).as_matrix()
    for matrix in [*turns, *half_turns, np.eye(3)]:
        w, *xyz = quaternion_of(matrix)
        assert w >= 0
        np.testing.assert_allclose(Rotation.from_quat([*xyz, w]).as_matrix(), matrix, atol=1e-12)
    box = oriented_box(turned_box(seed=seed)[0])
    w, *xyz = box.rotation_wxyz
    np.testing.assert_allclose(Rotation.from_quat([*xyz, w]).apply(np.eye(3)), box.axes, atol=1e-12)


# Strays -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_two_percent_of_strays_hardly_change_the_box(seed):
    xyz, _ = turned_box(count=3000, seed=seed)
    random = np.random.default_rng(seed)
    strays = random.uniform(-5, 5, (60, 3))
    everything = np.concatenate([xyz, strays])
    main = without_strays(everything)
    assert main[: len(xyz)].all()
    clean, trimmed, raw = (oriented_box(points).volume for points in (xyz, everything[main], everything))
    assert raw > 50 * clean
    assert trimmed < 1.5 * clean


def test_a_speck_of_another_object_is_left_out_but_a_second_half_is_not():
    random = np.random.default_rng(0)
    one, speck, half = (random.random((n, 3)) + np.array([x, 0, 0]) for n, x in ((1000, 0), (30, 8), (400, 8)))
    with_speck, with_half = np.concatenate([one, speck * [1, 0.3, 0.3]]), np.concatenate([one, half])
    np.testing.assert_array_equal(without_strays(with_speck), np.arange(1030) < 1000)
    assert without_strays(with_half).all()


def test_sparse_points_are_linked_more_widely_and_few_are_all_kept():
    random = np.random.default_rng(0)
    xyz = random.random((300, 3))
    assert main_part(xyz, spacing=1e-3).mean() > 0.9
    assert without_strays(random.random((19, 3)) * [1000, 1, 1]).all()


def test_strays_are_the_same_whatever_the_order_the_offset_or_the_turn():
    xyz, _ = turned_box(count=1500)
    random = np.random.default_rng(4)
    xyz = np.concatenate([xyz, random.uniform(-6, 6, (40, 3))])
    main, order = without_strays(xyz), random.permutation(len(xyz))
    assert 0 < (~main).sum() <= 40
    np.testing.assert_array_equal(without_strays(xyz[order]), main[order])
    np.testing.assert_array_equal(without_strays(np.concatenate([xyz, xyz[:500]]))[: len(xyz)], main)
    turned = xyz @ Rotation.random(random_state=5).as_matrix().T + 1e5
    assert (without_strays(turned) == main).mean() > 0.999


@pytest.mark.parametrize("seed", range(4))
def test_a_turned_cloud_that_thins_out_loses_the_same_points(seed):
    xyz = np.random.default_rng(seed).standard_t(3, (800, 3)) * [3, 2, 1]
    main = without_strays(xyz)
    assert 0.9 < main.mean() < 1
    np.testing.assert_array_equal(without_strays(xyz @ Rotation.random(random_state=seed).as_matrix().T), main)


def test_connected_parts_against_a_search_voxel_by_voxel():
    random = np.random.default_rng(0)
    voxel = random.integers(-9, 9, (260, 3))
    part = boxes._connected(voxel)
    expected = np.full(len(voxel), -1)
    for start in range(len(voxel)):
        todo = [start] if expected[start] < 0 else []
        while todo:
            expected[todo] = start
            near = (np.abs(voxel[:, None] - voxel[todo]).max(axis=2) <= 1).any(axis=1)
            todo = np.flatnonzero(near & (expected < 0)).tolist()
    assert len(np.unique(part)) == len(np.unique(expected)) > 10
    assert len(np.unique(np.stack([part, expected]), axis=1).T) == len(np.unique(part))
