"""Mask features that are zero, alike, opposite, not numbers, of any length, width and precision."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hard_cases import naive
from hard_cases.case import Answer, agrees, powers, refuses
from hard_cases.inputs import (
    SPACE,
    by_ball,
    camera,
    int32,
    labelled_cloud,
    mask_table_of,
    single,
    two_balls,
    unit_rows,
)
from og_pointcloud.ask.labelled_scene import LabelledScene, segment
from og_pointcloud.cloud import UNKNOWN, InstanceTable
from og_pointcloud.errors import FeatureSpaceError, SceneError
from og_pointcloud.fitting.association import describe_instances
from og_pointcloud.fitting.fit import fit
from og_pointcloud.scene import Scene, View


@agrees(1e-6, "length of the features", (1e-40, 1e-30, *powers(-20, 20, 10), 1e30, 3e37))
def feature_length(length: float) -> Answer:
    """Mask features of any length give the same descriptors."""
    rows = (unit_rows(4, 16).astype(np.float64) * length).astype(np.float32)
    exact = rows / np.linalg.norm(rows.astype(np.float64), axis=1, keepdims=True)
    return Answer(_described(rows, range(4)).descriptors, exact, lambda: naive.unit(rows))


@agrees(0, "length of the features", (1e-30, 1.0, 1e30))
def feature_length_of_a_fit(length: float) -> Answer:
    """The same through a whole fit, and the words find their balls."""
    scene, balls = two_balls(features=np.float32(length) * unit_rows(2, 8))
    words = dict(zip(("left", "right"), unit_rows(2, 8), strict=True))
    return Answer(segment(fit(scene, progress=False), words).labels, balls)


@agrees(1e-6, "angle from opposite, radians", powers(0, -6, -1))
def nearly_opposite_rows(angle: float) -> Answer:
    """Two masks of one instance whose features all but cancel: what is left of them points right."""
    first = np.zeros(16)
    first[0] = 1
    second = -np.cos(angle) * first + np.sin(angle) * np.eye(16)[1]
    rows = (np.stack([first, second]) * [[3.0], [7.0]]).astype(np.float32)
    wide = rows.astype(np.longdouble)
    total = (wide / np.sqrt(np.square(wide).sum(axis=1, keepdims=True))).sum(axis=0)
    exact = (total / np.sqrt(total @ total)).astype(np.float64)
    return Answer(_described(rows, [0, 0]).descriptors[0], exact, lambda: naive.mean_direction(rows))


@agrees(0)
def opposite_rows() -> Answer:
    """Two masks of one instance with opposite features: it has no descriptor, and answers unknown."""
    rows = unit_rows(1, 16)
    return Answer(_described(np.concatenate([rows, -rows]), [0, 0]).descriptor_instance, np.zeros(0, np.int32))


@agrees(1e-6)
def zero_rows_beside_others() -> Answer:
    """A mask without a feature is no part of the descriptor."""
    rows = np.concatenate([unit_rows(2, 16), np.zeros((1, 16), np.float32)])
    exact = rows.astype(np.float64).sum(axis=0)
    return Answer(_described(rows, [0, 0, 0]).descriptors[0], exact / np.linalg.norm(exact))


@agrees(0)
def zero_rows() -> Answer:
    """No mask has a feature: points have instances, but no word is ever their label."""
    scene, _ = two_balls(features=np.zeros((2, 8), np.float32))
    result = segment(fit(scene, progress=False), {"chair": unit_rows(1, 8)[0], "desk": unit_rows(1, 8, 1)[0]})
    ours = np.r_[result.labels, (result.instances >= 0).all(), (result.scores != 0).any()]
    return Answer(ours, np.r_[np.full(600, UNKNOWN), True, False])


@agrees(0)
def identical_rows() -> Answer:
    """All masks with one feature: still two instances, told apart by place."""
    scene, balls = two_balls(features=np.tile(unit_rows(1, 8), (2, 1)))
    return Answer(by_ball(fit(scene, progress=False).instance_ids, balls), balls)


@agrees(0)
def features_of_width_1() -> Answer:
    """Features of one column, 1 and -2: two words tell them apart."""
    scene, balls = two_balls(features=single([[1], [-2]]))
    return Answer(segment(fit(scene, progress=False), {"plus": [3.0], "minus": [-0.1]}).labels, balls)


@agrees(1e-5, "columns of the features", (1, 2, 16, 128, 512, 4096))
def width(columns: float) -> Answer:
    """Cosines of words with descriptors, of vectors stored as float16; naive: computed in float16 too."""
    descriptors = unit_rows(5, int(columns))
    text = (40 * unit_rows(20, int(columns), seed=1)).astype(np.float16)
    ours = LabelledScene.from_cloud(labelled_cloud(descriptors=descriptors)).cloud.instances.cosines(text)
    return Answer(ours, _cosines(descriptors, text), lambda: naive.cosines(descriptors, text, np.float16))


@refuses(SceneError, "the feature of mask 2 contains NaN", "expected finite", "encode this mask again or remove it")
def feature_not_a_number() -> object:
    """A feature with NaN in it."""
    rows = unit_rows(3, 8)
    rows[1, 4] = np.nan
    return _one_view(rows)


@refuses(SceneError, "of mask 1 contains NaN or infinity", "expected finite", "encode this mask again or remove it")
def feature_beyond_float32() -> object:
    """A feature of 1e40, as float64 files may hold it."""
    from og_pointcloud.formats.mask_files import as_features

    return _one_view(as_features(np.full((1, 8), 1e40), "1e40:"))


@refuses(SceneError, "features of its 2 masks have dimension 0", "expected 1 or more", "encode the masks")
def features_of_width_0() -> object:
    """Features without a column."""
    return _one_view(np.zeros((2, 0), np.float32))


@refuses(SceneError, "have 2 dimensions [8, 16]", "expected one dimension", "encode all masks with the same model")
def features_of_two_widths() -> object:
    """Views whose features were made by different encoders."""
    scene, _ = two_balls()
    return Scene(scene.points, (*scene.views, replace(_one_view(unit_rows(2, 16)), name="other")), SPACE)


@refuses(FeatureSpaceError, "(dimension 8); expected", "(dimension 16)", "encode them with")
def text_of_another_width() -> object:
    """Words of another encoder than the scene's."""
    return segment(labelled_cloud(), {"chair": unit_rows(1, 8)[0]})


def _described(rows: NDArray[np.float32], owners: Sequence[int]) -> InstanceTable:
    """The instances that these masks' features describe; every mask shows a point of its own, equally much."""
    group = int32(owners)
    table = replace(mask_table_of(np.eye(len(rows)), [0] * len(rows)), mask_features=rows)
    return describe_instances(table, group, group, int(group.max()) + 1)


def _cosines(a: NDArray[np.floating], b: NDArray[np.floating]) -> NDArray[np.float64]:
    a, b = a.astype(np.float64), b.astype(np.float64)
    return (a / np.linalg.norm(a, axis=1, keepdims=True)) @ (b / np.linalg.norm(b, axis=1, keepdims=True)).T


def _one_view(features: NDArray[np.float32]) -> View:
    return View("one", camera(), np.full((18, 24), -1, np.int32), features)
