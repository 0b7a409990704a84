"""Do masks of different views agree where they show the same points, better than masks of other images would?

Each point that two views see lies in a mask of either; how well one predicts the other is their mutual information. It
is compared with that of rivals: the other view's mask map mirrored, and mask maps of other images. And masks that show
the same points should have more similar features than other masks.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.checking.sample import Comparison, Sample, seen
from og_pointcloud.cloud import unit_rows
from og_pointcloud.scene import Camera

Ids = NDArray[np.integer]
Places = NDArray[np.float64]

MAX_SIDE_PX = 320
"""Longer side of the mask maps that are kept, pixels."""
CELLS_PER_SIDE = 32
POINTS = 8000
FEW_VIEWS, FEW_POINTS = 5, 3000
RIVALS = 3
"""Other images' mask maps that a pair of views is compared with, besides the mirrored one."""
MAX_RIVAL_INFORMATION = 0.7
"""Mask maps with more mutual information than this, pixel by pixel, are no rivals: the camera hardly moved between."""
GRID = np.stack(np.meshgrid(np.arange(64) + 0.5, np.arange(64) + 0.5), axis=-1).reshape(-1, 2) / 64
"""(4096, 2) x, y evenly over an image, as shares of its size."""
MIN_SHARED_POINTS = 40
MIN_SHARED_SHARE = 0.15
"""Least share of the points, of the view with fewer, that both views must see; with less they look through walls."""
MIN_ENTROPY_NATS = 0.05
"""A view nearly covered by one mask has less, and is no evidence."""
SAME_IOU = 0.5
"""Masks of two views show the same thing if their IoU on points exceeds this and they are each other's best match."""
MIN_MATCH_POINTS = 15


@dataclass(frozen=True)
class MaskMaps:
    """The masks of a sample's views, reduced; one list entry per view.

    ids: (H, W) integers, at most about MAX_SIDE_PX long, 0 outside all masks, else row + 1. features: (masks, D) unit
    rows. shown: (masks,) bool, whether any pixel shows the row. blended: share of the borders that have an id between
    those of both sides (`_blended`).
    """

    sample: Sample
    ids: list[Ids]
    features: list[NDArray[np.floating]]
    shown: list[NDArray[np.bool_]]
    blended: list[float]

    def fit(self, cameras: Sequence[Camera]) -> Comparison:
        """How much better masks predict each other where these cameras see the same points than rivals do."""
        pairs, groups = [], []
        for i, j, mine, theirs in self._pairs(cameras):
            a = _at(self.ids[i], mine)
            own = _information(a, _at(self.ids[j], theirs))
            if own is not None:
                others = (_information(a, _at(rival, theirs)) for of, rival in self._rivals[j] if of != i)
                pairs += [(own, other) for other in others if other is not None]
                # (i, j) and (j, i) share their own value, so they are one group: their errors are not independent.
                groups += [min(i, j) * len(cameras) + max(i, j)] * (len(pairs) - len(groups))
        return Comparison.of(pairs, "information", groups=groups)

    def features_alike(self, cameras: Sequence[Camera], shift: int = 0) -> Comparison:
        """How much more similar features of masks that show the same points are. shift: added to every mask's row."""
        pairs = []
        for i, j, mine, theirs in self._pairs(cameras):
            sizes = len(self.features[i]), len(self.features[j])
            if not all(sizes):  # features of a view without masks may have any width
                continue
            counts = _shared(_at(self.ids[i], mine) - 1, _at(self.ids[j], theirs) - 1, sizes, shift)
            cosines = self.features[i] @ self.features[j].T
            for row, same in _same_things(counts):
                pairs += [(float(cosines[row, same]), float(other)) for other in np.delete(cosines[row], same)]
        return Comparison.of(pairs, "cosine")

    def fewer(self) -> MaskMaps:
        """Fewer points and only the first views, which share points as they are neighbors; for searches."""
        few = slice(FEW_VIEWS)
        sample = self.sample.thinned(FEW_POINTS).of_views(range(len(self.ids))[few])
        return MaskMaps(sample, self.ids[few], self.features[few], self.shown[few], self.blended[few])

    def _pairs(self, cameras: Sequence[Camera]) -> Iterator[tuple[int, int, Places, Places]]:
        """Every ordered pair of views that share enough points, and where each sees these."""
        sights = [seen(self.sample.xyz, camera, CELLS_PER_SIDE) for camera in cameras]
        for i, one in enumerate(sights):
            for j, other in enumerate(sights):
                if i == j:
                    continue
                shared, mine, theirs = np.intersect1d(one.rows, other.rows, assume_unique=True, return_indices=True)
                if len(shared) >= max(MIN_SHARED_POINTS, MIN_SHARED_SHARE * min(len(one.rows), len(other.rows))):
                    yield i, j, one.places[mine], other.places[theirs]

    @cached_property
    def _rivals(self) -> list[list[tuple[int, Ids]]]:
        """For each view, rivals (view, mask map): other views' maps and its own mirrored, but none that is nearly the
        same."""
        rivals, count = [], len(self.ids)
        for view, ids in enumerate(self.ids):
            # Evenly spread over the capture: neighbors show nearly the same.
            others = sorted({(view + step * count // (RIVALS + 1)) % count for step in range(1, RIVALS + 1)} - {view})
            maps = [*((other, self.ids[other]) for other in others), (view, ids[:, ::-1])]
            own = _at(ids, GRID)
            rivals.append(
                [item for item in maps if (_information(own, _at(item[1], GRID)) or 0.0) < MAX_RIVAL_INFORMATION]
            )
        return rivals


def read_mask_maps(sample: Sample) -> MaskMaps:
    """The masks of the sample's views. Raises SceneError where they cannot be read."""
    ids, shown, blended = [], [], []
    for view in sample.views:
        map_ = np.maximum(view.mask_map(), -1) + 1  # what a lens did not see is in no mask
        shown.append(np.bincount(map_.reshape(-1), minlength=view.mask_count + 1)[1:] > 0)
        blended.append(_blended(map_))
        step = max(1, max(map_.shape) // MAX_SIDE_PX)
        ids.append(map_[step // 2 :: step, step // 2 :: step].astype(np.int64))
    features = [unit_rows(view.mask_features) for view in sample.views]
    return MaskMaps(sample.thinned(POINTS), ids, features, shown, blended)


def _blended(ids: Ids) -> float:
    """Share of changes of id, along some rows, in which the new id lies between the old one and the next pixel's, less
    the share expected by chance. A map that was resized with interpolation, or stored with losses, has such ids at its
    borders; where right masks touch, or leave a gap, there are none.
    """
    rows = ids[:: max(1, len(ids) // MAX_SIDE_PX)]
    left, middle, right = rows[:, :-2], rows[:, 1:-1], rows[:, 2:]
    steps = left != middle
    between = ((left < middle) & (middle < right)) | ((left > middle) & (middle > right))
    # Masks a pixel wide, as of fine textures, are no blends: of three random ids the middle one lies between the others
    # in a third of the cases.
    three = steps & (middle != right) & (left != right)
    return float(between.sum() - three.sum() / 3) / max(int(steps.sum()), 1)


def entropies(a: Ids, b: Ids) -> tuple[float, float, float]:
    """Entropies, in nats, of labellings a and b and of both together; a, b: (n,) integers from 0. Their mutual
    information is the sum of the first two entropies less the third."""
    columns = int(b.max(initial=0)) + 1  # the pair (a, b) as one number: a histogram of pairs in one pass
    joint = np.bincount(a * columns + b, minlength=(int(a.max(initial=0)) + 1) * columns).reshape(-1, columns)
    return _entropy(joint.sum(axis=1)), _entropy(joint.sum(axis=0)), _entropy(joint.reshape(-1))


def _entropy(counts: Ids) -> float:
    shares = counts[counts > 0] / max(counts.sum(), 1)
    return float(-(shares * np.log(shares)).sum())


def _information(a: Ids, b: Ids) -> float | None:
    """Mutual information over the geometric mean of both entropies, in [0, 1]; None where one has too little."""
    first, second, both = entropies(a, b)
    if min(first, second) < MIN_ENTROPY_NATS:
        return None
    return (first + second - both) / float(np.sqrt(first * second))


def _at(ids: Ids, places: Places) -> Ids:
    height, width = ids.shape
    column, row = np.minimum((places * (width, height)).astype(np.intp), (width - 1, height - 1)).T
    return ids[row, column]


def _shared(a: Ids, b: Ids, sizes: tuple[int, int], shift: int) -> Ids:
    """(masks, masks): points that lie in both masks, by feature row; a, b: rows, -1 for none."""
    a, b = a + shift * (a >= 0), b + shift * (b >= 0)
    inside = (a >= 0) & (b >= 0) & (a < sizes[0]) & (b < sizes[1])
    return np.bincount(a[inside] * sizes[1] + b[inside], minlength=sizes[0] * sizes[1]).reshape(sizes)


def _same_things(counts: Ids) -> list[tuple[int, int]]:
    """Pairs of masks that are each other's best match, and match well."""
    union = counts.sum(axis=1)[:, None] + counts.sum(axis=0) - counts
    iou = counts / np.maximum(union, 1)
    best, back = iou.argmax(axis=1), iou.argmax(axis=0)
    rows = np.arange(len(counts))
    # Mutual best matches above SAME_IOU: a part and its whole are not the same thing.
    fits = (iou[rows, best] > SAME_IOU) & (counts[rows, best] >= MIN_MATCH_POINTS) & (back[best] == rows)
    return [(int(row), int(best[row])) for row in np.flatnonzero(fits)]
