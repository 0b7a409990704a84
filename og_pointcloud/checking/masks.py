"""Do masks of different views agree where they show the same points, better than masks of other images would?

Two views give each point that both see a mask each; how much one says of the other is their mutual information. It is
compared with what the other view's mask map says when it is mirrored, or another image's. Of masks that show the same
points, the features should be more alike than those of other masks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.checking.sample import Sample, Seen, seen
from og_pointcloud.cloud import unit_rows
from og_pointcloud.scene import Camera

__all__ = ["Consistency", "MaskMaps", "read_mask_maps"]

Ids = NDArray[np.integer]

LONGEST_PX = 320
CELLS = 32
RIVALS = 3
"""Other images' masks that a pair of views is compared with, beside the mirrored one."""
ALIKE = 0.7
"""Mask maps with more mutual information than this, pixel by pixel, are no rivals: the camera hardly moved."""
GRID = np.stack(np.meshgrid(np.arange(64) + 0.5, np.arange(64) + 0.5), axis=-1).reshape(-1, 2) / 64
"""Places all over an image, as shares of its size."""
FEWEST_SHARED = 40
SHARED_SHARE = 0.15
"""Views of which the one that sees less shares less than this with the other see each other's points through walls."""
LEAST_ENTROPY = 0.05
"""A view nearly all in one mask says nothing."""
SAME_IOU = 0.5
"""Masks of two views show the same where they share more than this of their points, and are each other's best."""
FEWEST_POINTS = 15


@dataclass(frozen=True)
class Consistency:
    """share: of comparisons in which the right one wins; ties count half. own, other: mean of what is compared.
    compared: number of comparisons."""

    share: float
    own: float
    other: float
    compared: int

    @classmethod
    def of(cls, pairs: Sequence[tuple[float, float]]) -> Consistency:
        """Of pairs of what is right and a rival."""
        if not pairs:
            return cls(0.0, 0.0, 0.0, 0)
        own, other = np.array(pairs).T
        won = (own > other + 1e-6) + 0.5 * (np.abs(own - other) <= 1e-6)
        return cls(float(won.mean()), float(own.mean()), float(other.mean()), len(pairs))

    @property
    def gap(self) -> float:
        """How far the right ones stand out."""
        return self.own - self.other


@dataclass(frozen=True)
class MaskMaps:
    """sample: of the scene. ids: (H, W) integers a view, at most LONGEST_PX long, 0 outside of all masks, else row + 1.
    features: (masks, D) unit rows a view. shown: (masks,) bool a view, whether any pixel shows the row."""

    sample: Sample
    ids: list[Ids]
    features: list[NDArray[np.floating]]
    shown: list[NDArray[np.bool_]]

    def agreement(self, cameras: Sequence[Camera]) -> Consistency:
        """How much more masks say of each other where these cameras see the same points than elsewhere."""
        sights = [seen(self.sample.xyz, camera, CELLS) for camera in cameras]
        rivals = [self._rivals(view) for view in range(len(self.ids))]
        found = []
        for i, j, mine, theirs in _pairs(sights):
            a, places = _at(self.ids[i], sights[i].places[mine]), sights[j].places[theirs]
            own = _mutual_information(a, _at(self.ids[j], places))
            if own is not None:
                others = (_mutual_information(a, _at(rival, places)) for of, rival in rivals[j] if of != i)
                found += [(own, other) for other in others if other is not None]
        return Consistency.of(found)

    def features_alike(self, cameras: Sequence[Camera], shift: int = 0) -> Consistency:
        """How much more alike features are of masks that show the same points. shift: added to every mask's row."""
        sights = [seen(self.sample.xyz, camera, CELLS) for camera in cameras]
        found = []
        for i, j, mine, theirs in _pairs(sights):
            if not (len(self.features[i]) and len(self.features[j])):  # a view without masks may be of any width
                continue
            counts = _shared(
                _at(self.ids[i], sights[i].places[mine]), _at(self.ids[j], sights[j].places[theirs]),
                (len(self.features[i]), len(self.features[j])), shift,
            )  # fmt: skip
            cosines = self.features[i] @ self.features[j].T
            for row, same in _same_things(counts):
                others = np.delete(cosines[row], same)
                found += [(float(cosines[row, same]), float(other)) for other in others]
        return Consistency.of(found)

    def _rivals(self, view: int) -> list[tuple[int, Ids]]:
        """Mask maps in place of this view's, and whose they are: other views', and its own mirrored; none that says
        nearly the same of the image."""
        count = len(self.ids)
        others = sorted({(view + step * count // (RIVALS + 1)) % count for step in range(1, RIVALS + 1)} - {view})
        maps = [*((other, self.ids[other]) for other in others), (view, self.ids[view][:, ::-1])]
        own = _at(self.ids[view], GRID)
        return [(of, map_) for of, map_ in maps if (_mutual_information(own, _at(map_, GRID)) or 0.0) < ALIKE]

    def fewer(self, views: int, points: int) -> MaskMaps:
        """Of fewer views and points, for what is asked often."""
        sample = self.sample.fewer(views, points)
        rows = [self.sample.places.index(place) for place in sample.places]
        return MaskMaps(
            sample, [self.ids[row] for row in rows], [self.features[row] for row in rows],
            [self.shown[row] for row in rows],
        )  # fmt: skip

    def with_ids(self, ids: list[Ids]) -> MaskMaps:
        """The same with other maps."""
        return MaskMaps(self.sample, ids, self.features, self.shown)


def read_mask_maps(sample: Sample, points: int = 8000) -> MaskMaps:
    """The masks of the sample's views. Raises SceneError where they cannot be read."""
    ids, shown = [], []
    for view in sample.views:
        map_ = np.maximum(view.mask_map(), -1)  # what a lens did not see is in no mask
        shown.append(np.bincount(map_.reshape(-1) + 1, minlength=view.mask_count + 1)[1:] > 0)
        step = max(1, max(map_.shape) // LONGEST_PX)
        ids.append(map_[step // 2 :: step, step // 2 :: step].astype(np.int64) + 1)
    features = [unit_rows(view.mask_features) for view in sample.views]
    return MaskMaps(sample.fewer(len(sample.views), points), ids, features, shown)


def _pairs(sights: Sequence[Seen]):  # noqa: ANN202
    """(i, j, rows of i's, rows of j's) of every ordered pair of views that share enough points: where these are."""
    for i, one in enumerate(sights):
        for j, other in enumerate(sights):
            if i == j:
                continue
            shared, mine, theirs = np.intersect1d(one.rows, other.rows, assume_unique=True, return_indices=True)
            if len(shared) >= max(FEWEST_SHARED, SHARED_SHARE * min(len(one.rows), len(other.rows))):
                yield i, j, mine, theirs


def _at(ids: Ids, places: NDArray[np.float64]) -> Ids:
    height, width = ids.shape
    column, row = np.minimum((places * (width, height)).astype(np.intp), (width - 1, height - 1)).T
    return ids[row, column]


def _mutual_information(a: Ids, b: Ids) -> float | None:
    """Of two labels a point, over the root of their entropies' product, in [0, 1]; None where one says nothing."""
    columns = int(b.max()) + 1
    joint = np.bincount(a * columns + b, minlength=(int(a.max()) + 1) * columns).reshape(-1, columns) / len(a)
    alone = _entropy(joint.sum(axis=1)), _entropy(joint.sum(axis=0))
    if min(alone) < LEAST_ENTROPY:
        return None
    return (sum(alone) - _entropy(joint.reshape(-1))) / float(np.sqrt(alone[0] * alone[1]))


def _entropy(shares: NDArray[np.float64]) -> float:
    positive = shares[shares > 0]
    return float(-(positive * np.log(positive)).sum())


def _shared(a: Ids, b: Ids, sizes: tuple[int, int], shift: int) -> Ids:
    """(masks, masks): points that lie in both masks, by feature row."""
    a, b = a - 1 + shift * (a > 0), b - 1 + shift * (b > 0)
    inside = (a >= 0) & (b >= 0) & (a < sizes[0]) & (b < sizes[1])
    return np.bincount(a[inside] * sizes[1] + b[inside], minlength=sizes[0] * sizes[1]).reshape(sizes)


def _same_things(counts: Ids) -> list[tuple[int, int]]:
    """Pairs of masks that are each other's best match, and match well."""
    if counts.size == 0:
        return []
    union = counts.sum(axis=1)[:, None] + counts.sum(axis=0) - counts
    iou = counts / np.maximum(union, 1)
    best, back = iou.argmax(axis=1), iou.argmax(axis=0)
    rows = np.arange(len(counts))
    fits = (iou[rows, best] > SAME_IOU) & (counts[rows, best] >= FEWEST_POINTS) & (back[best] == rows)
    return [(int(row), int(best[row])) for row in np.flatnonzero(fits)]
