"""The exact search against every distance computed."""

from __future__ import annotations

import numpy as np
import pytest
from labelled_clouds import make_cloud, nearest_plainly, queries, room, tough_clouds

from og_pointcloud.bundle import nearest
from og_pointcloud.bundle.nearest import NearestPoint

CLOUDS = tough_clouds()


def search(cloud, points):
    return NearestPoint(cloud.xyz, cloud.spacing, cloud.reach).query(points)


@pytest.mark.parametrize("name", CLOUDS)
def test_nearest_point_is_exact_on_tough_clouds(name):
    cloud = CLOUDS[name]
    points = queries(cloud, 300)
    assert (search(cloud, points) == nearest_plainly(cloud, points)).all()


def test_of_equally_near_points_the_first_wins():
    cloud = make_cloud([[0, 0, 0], [2, 0, 0], [0, 0, 0], [2, 0, 0], [1, 1, 0]], [4, 3, 2, 1, 0], 1.0, 3.0)
    points = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [1, 0.5, 0], [0.5, 0.5, 0]], np.float32)
    assert search(cloud, points).tolist() == [0, 0, 1, 4, 0]


def test_reach_counts_to_the_last_bit():
    cloud = make_cloud([[0, 0, 0]], [0], spacing=0.5, reach=1.0)
    points = np.array([[1, 0, 0], [np.nextafter(np.float32(1), np.float32(2)), 0, 0], [0, 0, -1]], np.float32)
    assert search(cloud, points).tolist() == [0, -1, 0]


def test_small_chunks_change_nothing(monkeypatch):
    cloud = room(500)
    points = queries(cloud, 200)
    whole = search(cloud, points)
    monkeypatch.setattr(nearest, "QUERIES_PER_CHUNK", 7)
    monkeypatch.setattr(nearest, "CANDIDATES_PER_CHUNK", 11)
    assert (search(cloud, points) == whole).all()


def test_no_queries():
    assert search(room(50), np.zeros((0, 3), np.float32)).shape == (0,)
