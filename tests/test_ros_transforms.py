"""The tree of frames: chains, moments between two stamps, and what it says of frames that are missing."""

import numpy as np
import pytest
from og_pointcloud_ros import TransformError, TransformTree
from og_pointcloud_ros.transforms import pose_of, slerp
from scipy.spatial.transform import Rotation, Slerp

SECOND = 1_000_000_000
NO_TURN = (0, 0, 0, 1)


def random_turns(count, seed=0):
    return np.random.default_rng(seed).normal(size=(count, 4))


def matrix(translation, xyzw):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat(xyzw).as_matrix(), translation
    return pose


@pytest.mark.parametrize("angle", [0, 1e-9, 1e-4, 0.1, 2.0, np.pi - 1e-3])
def test_slerp_is_scipys(angle):
    first = Rotation.from_quat(random_turns(1)[0])
    second = Rotation.from_rotvec(angle * np.array([0.6, 0, 0.8])) * first
    for share in (0, 0.25, 0.5, 0.99, 1):
        expected = Slerp([0, 1], Rotation.concatenate([first, second]))(share).as_matrix()
        for sign in (1, -1):  # one rotation, two quaternions
            mixed = slerp(first.as_quat(), sign * second.as_quat(), share)
            assert np.linalg.norm(mixed) == pytest.approx(1, abs=1e-12)
            np.testing.assert_allclose(pose_of(np.zeros(3), mixed)[:3, :3], expected, atol=1e-9)


def test_a_chain_with_a_fork_both_ways():
    places, turns = np.random.default_rng(1).normal(size=(4, 3)), random_turns(4, 2)
    tree = TransformTree()
    edges = [("map", "odom"), ("odom", "base"), ("base", "lidar"), ("base", "camera")]
    for (parent, child), place, turn in zip(edges, places, turns, strict=True):
        tree.add(parent, child, place, turn, static=True)
    map_from_odom, odom_from_base, base_from_lidar, base_from_camera = map(matrix, places, turns)
    np.testing.assert_allclose(
        tree.lookup("map", "lidar", 5), map_from_odom @ odom_from_base @ base_from_lidar, atol=1e-12
    )
    np.testing.assert_allclose(
        tree.lookup("camera", "lidar", 5), np.linalg.inv(base_from_camera) @ base_from_lidar, atol=1e-12
    )
    np.testing.assert_allclose(tree.lookup("lidar", "map", 5) @ tree.lookup("map", "lidar", 5), np.eye(4), atol=1e-12)
    assert tree.frames == ["base", "camera", "lidar", "map", "odom"]


def test_a_frame_is_where_it_is_even_if_unknown():
    np.testing.assert_array_equal(TransformTree().lookup("map", "map", 0), np.eye(4))
    np.testing.assert_array_equal(TransformTree().lookup("/map", "map", 0), np.eye(4))


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1)])
def test_moments_between_stamps(order):
    tree, turns = TransformTree(), random_turns(3, 4)
    places = np.array([[0, 0, 0], [2, 0, 0], [2, 4, 0.0]])
    for k in order:  # as they may come from several publishers
        tree.add("map", "base", places[k], turns[k], k * SECOND)
    np.testing.assert_allclose(tree.lookup("map", "base", SECOND), matrix(places[1], turns[1]), atol=1e-12)
    between = tree.lookup("map", "base", SECOND + SECOND // 4)
    expected = Slerp([0, 1], Rotation.from_quat(turns[1:]))(0.25)
    np.testing.assert_allclose(between, matrix([2, 1, 0], expected.as_quat()), atol=1e-12)


def test_stamps_of_today_keep_their_nanoseconds():
    now = 1_790_000_000 * SECOND
    tree = TransformTree()
    tree.add("map", "base", (0, 0, 0), NO_TURN, now)
    tree.add("map", "base", (100, 0, 0), NO_TURN, now + 100)
    assert tree.lookup("map", "base", now + 1)[0, 3] == pytest.approx(1)


def test_the_last_word_counts():
    tree = TransformTree()
    tree.add("map", "base", (1, 0, 0), NO_TURN, 7)
    tree.add("map", "base", (2, 0, 0), NO_TURN, 7)
    assert tree.lookup("map", "base", 7)[0, 3] == 2
    tree.add("odom", "base", (3, 0, 0), NO_TURN, static=True)
    assert tree.lookup("odom", "base", 9)[0, 3] == 3
    with pytest.raises(TransformError):
        tree.lookup("map", "base", 7)


ERRORS = {
    "an unknown frame": ("map", "nose", 0, "to 'map': 'nose' unknown; the frames are base, lost, map, nowhere"),
    "two unknown frames": ("world", "nose", 0, "'world' and 'nose' unknown"),
    "two trees": ("map", "lost", 0, "from 'lost' to 'map': they have no common ancestor"),
    "before the first": ("map", "base", 0, r"'base' in 'map' is known from 1.000 to 2.000 s, not at 0.000 s"),
    "after the last": ("map", "base", 3 * SECOND, "not at 3.000 s"),
}


@pytest.mark.parametrize(("target", "source", "stamp", "text"), ERRORS.values(), ids=ERRORS)
def test_what_is_missing_is_named(target, source, stamp, text):
    tree = TransformTree()
    tree.add("map", "base", (0, 0, 0), NO_TURN, SECOND)
    tree.add("map", "base", (1, 0, 0), NO_TURN, 2 * SECOND)
    tree.add("nowhere", "lost", (1, 0, 0), NO_TURN, static=True)
    with pytest.raises(TransformError, match=text):
        tree.lookup(target, source, stamp)


def test_a_circle_and_no_rotation():
    tree = TransformTree()
    tree.add("a", "b", (0, 0, 0), NO_TURN, static=True)
    tree.add("b", "a", (0, 0, 0), NO_TURN, static=True)
    with pytest.raises(TransformError, match="form a loop: a in b in a"):
        tree.lookup("c", "a", 0)
    for place, turn in (((0, 0, 0), (0, 0, 0, 0)), ((np.nan, 0, 0), NO_TURN), ((0, 0, 0), (np.inf, 0, 0, 0))):
        with pytest.raises(TransformError, match="expected finite numbers"):
            tree.add("map", "base", place, turn)
