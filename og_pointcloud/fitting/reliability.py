"""How good a fit is, without truth: its split-half reliability, for each instance and for the scene.

Labels are made anew from either half of the views, every other one by name, from the rows that the mask table has
already. The reliability of an instance is the product of three shares in [0, 1]:

    again   Dice coefficient of its points with those that a half gives its look, mean of both halves. Few views,
            geometry that hides the wrong things, wrong poses, and masks that are cut differently in every view lower it
    named   the share of its masks whose own feature, alone, is nearest to the instance's look. An encoder that errs,
            and masks that span several things, lower it
    expected
            expected IoU of its points with its true points, under the state probabilities from all views together
            (view_reports.py). Both halves may agree on an error, as rays slip through a surface in all views: this
            share is lower even then if views contradict it

Instances have the same look if their descriptors are alike after what all masks have in common is removed: two chairs
do, and either may be found in place of the other. No half can reveal an error that all views share. Over
`examples/zoo.py` the scene's figure ranks fits nearly as mIoU does; docs/scores.md has the figures.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, vstack

from og_pointcloud.cloud import InstanceTable, unit_rows
from og_pointcloud.fitting.labellers import Labelling, grouping
from og_pointcloud.fitting.mask_table import MaskTable
from og_pointcloud.journal import Journal
from og_pointcloud.rendering.geometry import neighborhood, sample_of_points
from og_pointcloud.rendering.surface import Surface
from og_pointcloud.settings import FitSettings

MIN_VIEWS = 4
"""With fewer views, a half may have one view, which nothing in it contradicts."""
SAME_LOOK_COSINE = 0.5
"""Two instances have the same look above this cosine of their descriptors, without what all masks share. Unrelated
things have about 0; 0.3 and 0.7 rank scenes of the zoo as well."""
MAX_COSINES = 1 << 24
"""Cosines held at once: 128 MB in float64."""
ROWS_PER_CUT = 16
"""Rows cut out of a mask table at once: it may be mapped from a file, and larger than memory."""

Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Reliability:
    """again, named, expected: (K,) in [0, 1] as above; NaN where an instance has no feature or no judged point. alone:
    the share of judged points in instances that are unseen in one of the halves."""

    again: NDArray[np.float64]
    named: NDArray[np.float64]
    expected: NDArray[np.float64]
    alone: float

    @property
    def of_instance(self) -> NDArray[np.float32]:
        """(K,) their product."""
        return (self.again * self.named * self.expected).astype(np.float32)


def split_half(table: MaskTable, surface: Surface, labelling: Labelling, settings: FitSettings) -> Reliability | None:
    """The reliability of a labelling; None where views cannot be halved. Does not depend on the order of views.

    table, surface: what it was made from. Of a larger cloud a sample of ``geometry.held_out_points`` points is judged.
    """
    masked = sorted(np.unique(table.mask_view).tolist(), key=lambda index: table.names[index])
    if len(masked) < MIN_VIEWS or not len(labelling.instances):
        return None
    sample = sample_of_points(surface.gaussians.xyz, settings.geometry.held_out_points)
    judged = _of_points(surface, sample, settings)
    ids = labelling.instance_ids[sample]
    looks, count = _Looks(table, labelling.instances), len(labelling.instances)
    points = np.bincount(ids[ids >= 0], minlength=count)
    # Halves of every other view, so that each sees the scene from all sides. Each counts half.
    again, unseen = np.zeros(count), np.zeros(len(ids), bool)
    for half in (masked[0::2], masked[1::2]):
        part = _of_views(table, np.sort(half), sample)
        unseen |= np.asarray(part.exposure.sum(axis=0)).ravel() == 0
        again += _again(ids, _named_by(part, judged, looks, settings), looks, points) / 2
    known = looks.described & (points > 0)
    alone = float(unseen[ids >= 0].mean()) if (ids >= 0).any() else 0.0
    # Points that keep their leaf have no state probabilities.
    expected = np.ones(count) if labelling.expected_iou is None else labelling.expected_iou
    again, named, expected = (
        np.where(known, share, np.nan) for share in (again, _named(table, labelling, looks), expected)
    )
    return Reliability(again, named, expected, alone)


class _Looks:
    """What instances look like. described: (K,) bool, those with a feature."""

    def __init__(self, table: MaskTable, instances: InstanceTable) -> None:
        features = table.unit_features
        given = features.any(axis=1)
        # Encoders give all images of a scene much in common; what tells things apart is the rest.
        self.common = features[given].mean(axis=0, dtype=np.float64) if given.any() else np.zeros(features.shape[1])
        self.direction, self.described = self.of(instances)
        self._rows = np.flatnonzero(self.described)

    def of(self, instances: InstanceTable) -> tuple[NDArray[np.float64], Bools]:
        """(K, D) directions of instances of the same scene, zero for those without a feature, and which have one."""
        total = np.zeros((len(instances), len(self.common)))
        if len(instances.descriptors):
            np.add.at(total, instances.descriptor_instance, instances.descriptors)
        described = np.asarray(total.any(axis=1))
        total[described] = self.without_common(total[described])
        return total, described

    def without_common(self, features: NDArray[np.floating]) -> NDArray[np.floating]:
        """Unit rows of the features minus the mean of all masks of the scene."""
        return unit_rows(unit_rows(features.astype(np.float64)) - self.common)

    def nearest(self, directions: NDArray[np.floating]) -> NDArray[np.int64]:
        """The instance whose look is nearest to each direction, -1 where none has one."""
        if not len(self._rows):
            return np.full(len(directions), -1)
        step = max(1, MAX_COSINES // len(self._rows))
        chunks = [directions[low : low + step] for low in range(0, len(directions), step)]
        found = [(chunk @ self.direction[self._rows].T).argmax(axis=1) for chunk in chunks]
        return self._rows[np.concatenate(found)] if found else np.zeros(0, np.int64)

    def alike(self, first: NDArray[np.integer], second: NDArray[np.integer]) -> Bools:
        """Whether pairs of instances are of one look; none is like -1."""
        # A cosine for each different pair: points are many, pairs of instances few.
        pairs, place = np.unique(np.stack([first, second]), axis=1, return_inverse=True)
        cosine = self.direction[np.maximum(pairs, 0)].prod(axis=0).sum(axis=1)
        same = ((pairs[0] == pairs[1]) | (cosine > SAME_LOOK_COSINE)) & (pairs >= 0).all(axis=0)
        return same[place.ravel()]


def _again(
    ids: NDArray[np.int32], name: NDArray[np.int64], looks: _Looks, points: NDArray[np.int64]
) -> NDArray[np.float64]:
    """(K,) Dice coefficient of each instance with the points that a half gives its look. points: (K,) its number of
    points. name: (n,) the instance that a half gives each point. A wrongly named point counts against the instance that
    it is given, and is missing from its own."""
    same = looks.alike(ids, name)
    false_positives = np.bincount(name[~same & (name >= 0)], minlength=len(points))
    true_positives = np.bincount(ids[same], minlength=len(points))
    return 2 * true_positives / np.maximum(points + true_positives + false_positives, 1)


def _named_by(table: MaskTable, surface: Surface, looks: _Looks, settings: FitSettings) -> NDArray[np.int64]:
    """(n,) the instance whose look is nearest to what labels made from these views alone give each point, -1 none."""
    # By grouping, whatever the mode: it needs no training.
    found = grouping(table, surface, settings, Journal(progress=False))
    directions, described = looks.of(found.instances)
    name = np.append(np.where(described, looks.nearest(directions), -1), -1)  # the last: of points without an instance
    return name[np.maximum(found.instance_ids, -1)]


def _named(table: MaskTable, labelling: Labelling, looks: _Looks) -> NDArray[np.float64]:
    """(K,) share of an instance's masks whose feature is nearest to its look; 1 where none has a feature."""
    features, owner = table.unit_features, labelling.mask_instance
    used = np.flatnonzero((owner >= 0) & features.any(axis=1))
    right = looks.alike(owner[used], looks.nearest(looks.without_common(features[used])))
    count = len(labelling.instances)
    masks = np.bincount(owner[used], minlength=count)
    return np.divide(np.bincount(owner[used], right, count), masks, out=np.ones(count), where=masks > 0)


def _of_views(table: MaskTable, views: NDArray[np.int64], points: NDArray[np.int64]) -> MaskTable:
    """The table of some of its views, ascending, and points."""
    masks = np.flatnonzero(np.isin(table.mask_view, views))
    parts = ((table.weights, masks), (table.outside, views), (table.exposure, views))
    weights, outside, exposure = (_cut(matrix, rows, points) for matrix, rows in parts)
    return MaskTable(
        weights, outside, exposure, np.searchsorted(views, table.mask_view[masks]).astype(np.int32),
        table.mask_pixels[masks], table.mask_features[masks],
        None if table.mask_track is None else table.mask_track[masks],
        doubted=None if table.doubted is None else _cut(table.doubted, views, points),
    )  # fmt: skip


def _cut(matrix: csr_array, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> csr_array:
    """Some rows and columns of a matrix, a few rows at a time: the whole may be larger than memory."""
    chosen = slice(None) if len(columns) == matrix.shape[1] else columns
    cuts = [csr_array(matrix[rows[low : low + ROWS_PER_CUT]])[:, chosen] for low in range(0, len(rows), ROWS_PER_CUT)]
    return csr_array(vstack(cuts, format="csr"))


def _of_points(surface: Surface, rows: NDArray[np.int64], settings: FitSettings) -> Surface:
    """The surface of some of its points."""
    if len(rows) == len(surface.gaussians):
        return surface
    return replace(
        surface,
        scene=replace(surface.scene, points=surface.scene.points.take(rows)),
        neighborhood=neighborhood(surface.gaussians.xyz[rows], settings.geometry),
        gaussians=surface.gaussians.take(rows),
        thickness=surface.thickness[rows],
    )


def likely_cause(found: Reliability) -> str:
    """In words, why a reliability is low. Wrong poses are found by the checks of the capture (checking/)."""
    # A half cannot label what it does not see: ``again`` is then low whatever the masks.
    if found.alone > 0.25:
        return f"too few views: {found.alone:.0%} of the labeled points are seen by only one half of the views"
    again, named = float(np.nanmean(found.again)), float(np.nanmean(found.named))
    if named < again:
        return f"masks of the same object are named differently: {named:.0%} of them, taken alone, name their instance"
    return (
        f"half of the views give {again:.0%} of the points the same label: masks disagree about what is one object, "
        "or are not where the poses say"
    )
