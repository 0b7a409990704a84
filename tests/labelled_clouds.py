"""Labelled clouds for tests: small ones made here, and the answers they should give, found the slow plain way."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import og_pointcloud as og
from og_pointcloud.cloud import BACKGROUND, NO_EVIDENCE, UNOBSERVED, InstanceTable, LabelledCloud, Vocabulary

TOO_FAR = -3
WIDTH = 16
SPACE = "tiny-test-space"
WORDS = ("apple", "pear", "plum", "café", "red ball")


def quietly(*arguments: Any, **options: Any) -> og.Segmentation:
    """`og.segment` without its warnings."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return og.segment(*arguments, **options)


def unit_rows(count: int, width: int = WIDTH, seed: int = 0) -> NDArray[np.float32]:
    """Random rows of length 1."""
    rows = np.random.default_rng(seed).normal(size=(count, width))
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def instance_table(count: int, owners: list[int] | None = None, width: int = WIDTH) -> InstanceTable:
    """owners: the instance of each descriptor; None for one each."""
    owner = np.array(range(count) if owners is None else owners, np.int32)
    numbers = np.arange(count, dtype=np.int32)
    ratios = np.linspace(0, 1, count, dtype=np.float32)
    return InstanceTable(unit_rows(len(owner), width), owner, numbers, numbers + 1, numbers + 2, ratios, ratios * 9)


def make_cloud(xyz, ids, spacing=0.05, reach=0.15, origin=(0, 0, 0), instances=None, words=WORDS) -> LabelledCloud:
    xyz = np.asarray(xyz, np.float32).reshape(-1, 3)
    ids = np.asarray(ids, np.int32)
    cloud = LabelledCloud(
        xyz=xyz,
        origin=np.array(origin, np.float64),
        instance_ids=ids,
        instances=instance_table(int(ids.max(initial=-1)) + 1) if instances is None else instances,
        feature_space=SPACE,
        spacing=spacing,
        reach=reach,
        rgb=np.full((len(xyz), 3), 7, np.uint8),
        vocabulary=Vocabulary(tuple(words), 10 * unit_rows(len(words), seed=0)) if words else None,
        provenance={"seed": 3, "left_out": []},
    )
    return replace(cloud, instances=replace(cloud.instances, points=cloud.counted_points))


def room(count: int = 3000, seed: int = 0) -> LabelledCloud:
    """A bumpy floor and a wall, cut into 9 instances, background and unobserved, with a sprinkle of lone labels."""
    random = np.random.default_rng(seed)
    uv = random.random((count, 2)) * [2, 2]
    height = 0.02 * random.normal(size=count)
    floor = np.arange(count) % 3 > 0
    xyz = np.where(floor[:, None], np.stack([uv[:, 0], uv[:, 1], height], 1), np.stack([uv[:, 0], height, uv[:, 1]], 1))
    ids = (uv[:, 0] * 1.5).astype(int) * 3 + (uv[:, 1] * 1.5).astype(int)
    ids = np.where(uv.sum(axis=1) > 3.2, UNOBSERVED, np.where(uv[:, 1] < 0.3, BACKGROUND, ids))
    lone = random.random(count) < 0.01
    ids[lone] = random.integers(-2, 9, lone.sum())
    # Instance 0 has two descriptors, 4 has none.
    cloud = make_cloud(xyz, ids, instances=instance_table(9, [0, 0, 1, 2, 3, 5, 6, 7, 8]))
    return replace(cloud, certainty=random.integers(0, 256, count).astype(np.uint8))


def tough_clouds() -> dict[str, LabelledCloud]:
    base = room(800)
    random = np.random.default_rng(5)
    twice = np.concatenate([base.xyz, base.xyz])
    far = np.concatenate([base.xyz, [[4e4, 0, 0], [0, -7e4, 2e4], [1e30, 0, 0]]])
    return {
        "room": base,
        "no point": make_cloud(np.zeros((0, 3)), []),
        "one point": make_cloud([[1, 2, 3]], [0]),
        "all unobserved": make_cloud(base.xyz, np.full(800, UNOBSERVED)),
        "no instance, no words, no width": make_cloud(
            base.xyz, np.full(800, BACKGROUND), instances=instance_table(0, width=0), words=()
        ),
        "instances without any descriptor": replace(
            base, instances=replace(instance_table(9, []), points=base.counted_points)
        ),
        "map coordinates": replace(base, origin=np.array([1e6, -4e6, 350.25])),
        "millimeters": make_cloud(base.xyz * 1000, base.instance_ids, 50.0, 150.0),
        "coincident points of different ids": make_cloud(twice, np.append(base.instance_ids, base.instance_ids[::-1])),
        "all points in one place": make_cloud(np.ones((50, 3)), np.arange(50) % 3),
        "far outliers": make_cloud(far, np.append(base.instance_ids, [2, 3, 1])),
        "a line": make_cloud(np.linspace(0, 1, 400)[:, None] * [5000, 1, 0], np.arange(400) // 100, 12.0, 30.0),
        "a lattice": make_cloud(np.stack(np.meshgrid(*[np.arange(6)] * 3), -1), random.integers(-2, 5, 216), 1.0, 2.0),
        "reach below the spacing": replace(base, reach=0.02),
        "reach of 20 spacings": replace(base, spacing=0.02, reach=0.4),
        "scattered points": make_cloud(random.random((60, 3)) * 20, np.arange(60) % 4),
        "300 instances": make_cloud(base.xyz, np.arange(800) % 300),
    }


def queries(cloud: LabelledCloud, count: int = 2000, seed: int = 1) -> NDArray[np.float32]:
    """Points in the local frame: the cloud's own, near it, about its reach, between lattice points, and far away."""
    random = np.random.default_rng(seed)
    own = cloud.xyz[random.integers(0, len(cloud), count)] if len(cloud) else np.zeros((count, 3), np.float32)
    size = random.choice([0, 0.3, 1.0, 3.0, 100.0], (count, 1)) * cloud.spacing
    moved = own + random.normal(size=(count, 3)) * size
    halves = own + np.round(random.normal(size=(count, 3)) * 2) * 0.5 * cloud.spacing
    on_reach = own + np.eye(3)[random.integers(0, 3, count)] * cloud.reach
    return np.concatenate([moved, halves, on_reach, [[1e30] * 3, [-1e9] * 3]]).astype(np.float32)


def nearest_plainly(cloud: LabelledCloud, points: NDArray[np.float32]) -> NDArray[np.int64]:
    """Index of the nearest cloud point within reach, lowest of equals, else -1: every distance, in float64."""
    nearest = np.full(len(points), -1)
    if len(cloud) == 0:
        return nearest
    for row, point in enumerate(points.astype(np.float64)):
        x, y, z = (cloud.xyz.astype(np.float64) - point).T
        squared = (x * x + y * y) + z * z
        best = int(squared.argmin())
        if squared[best] <= cloud.reach * cloud.reach:
            nearest[row] = best
    return nearest


def instances_plainly(cloud: LabelledCloud, points: NDArray[np.float32]) -> NDArray[np.int32]:
    return np.append(cloud.instance_ids, np.int32(TOO_FAR))[nearest_plainly(cloud, points)]


def reference_scores(instances: InstanceTable, text: NDArray[np.floating]) -> NDArray[np.float64]:
    """(K, L) float64: best cosine of each instance's descriptors with each text, -2 without a descriptor."""
    scores = np.full((len(instances), len(text)), NO_EVIDENCE, np.float64)
    text = text.astype(np.float64)
    length = np.linalg.norm(text, axis=1, keepdims=True)
    unit = np.divide(text, length, out=np.zeros_like(text), where=length > 0)
    for descriptor, instance in zip(
        instances.descriptors.astype(np.float64), instances.descriptor_instance, strict=True
    ):
        scores[instance] = np.maximum(scores[instance], unit @ descriptor)
    return scores
