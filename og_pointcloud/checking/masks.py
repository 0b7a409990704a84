"""Do masks of different views agree where they show the same points, better than masks of other images would?

Each point that two views see lies in a mask of either; how much one mask tells of the other is their mutual
information. It is compared with that of rivals: the other view's mask map mirrored, and mask maps of other images. And
masks that show the same points should have features more alike than other masks have.
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

LONGEST_PX = 320
"""Longer side of the mask maps that are kept, pixels."""
CELLS = 32
POINTS = 8000
FEW_VIEWS, FEW_POINTS = 5, 3000
RIVALS = 3
"""Other images' masks that a pair of views is compared with, beside the mirrored one."""
ALIKE = 0.7
"""Mask maps with more mutual information than this, pixel by pixel, are no rivals: the camera hardly moved between."""
GRID = np.stack(np.meshgrid(np.arange(64) + 0.5, np.arange(64) + 0.5), axis=-1).reshape(-1, 2) / 64
"""Places all over an image, as shares of its size."""
FEWEST_SHARED = 40
SHARED_SHARE = 0.15
"""Of two views, the share of the fewer points that both must see; with less they see each other's through walls."""
LEAST_ENTROPY = 0.05
"""In nats; a view nearly all in one mask has less, and says nothing."""
SAME_IOU = 0.5
"""Masks of two views show the same where they share more than this of their points, and are each other's best."""
FEWEST_POINTS = 15


@dataclass(frozen=True)
class MaskMaps:
    """What is kept of the masks of a sample's views, a list entry a view.

    ids: (H, W) integers, at most about LONGEST_PX long, 0 outside of all masks, else row + 1. features: (masks, D) unit
    rows. shown: (masks,) bool, whether any pixel shows the row. blended: share of the borders that have an id between
    those of both sides (`_blended`).
    """

    sample: Sample
    ids: list[Ids]
    features: list[NDArray[np.floating]]
    shown: list[NDArray[np.bool_]]
    blended: list[float]

    def fit(self, cameras: Sequence[Camera]) -> Comparison:
        """How much more masks say of each other where these cameras see the same points than elsewhere."""
        pairs, groups = [], []
        for i, j, mine, theirs in self._pairs(cameras):
            a = _at(self.ids[i], mine)
            own = _information(a, _at(self.ids[j], theirs))
            if own is not None:
                others = (_information(a, _at(rival, theirs)) for of, rival in self._rivals[j] if of != i)
                pairs += [(own, other) for other in others if other is not None]
                # (i, j) and (j, i) share their `own`, so they are one group: their errors are not independent.
                groups += [min(i, j) * len(cameras) + max(i, j)] * (len(pairs) - len(groups))
        return Comparison.of(pairs, "information", groups=groups)

    def features_alike(self, cameras: Sequence[Camera], shift: int = 0) -> Comparison:
        """How much more alike the features of masks are that show the same points. shift: added to every mask's row."""
        pairs = []
        for i, j, mine, theirs in self._pairs(cameras):
            sizes = len(self.features[i]), len(self.features[j])
            if not all(sizes):  # a view without masks may be of any width
                continue
            counts = _shared(_at(self.ids[i], mine) - 1, _at(self.ids[j], theirs) - 1, sizes, shift)
            cosines = self.features[i] @ self.features[j].T
            for row, same in _same_things(counts):
                pairs += [(float(cosines[row, same]), float(other)) for other in np.delete(cosines[row], same)]
        return Comparison.of(pairs, "cosine")

    def fewer(self) -> MaskMaps:
        """The same with fewer points and only the first views, which as neighbors share points; for searches."""
        few = slice(FEW_VIEWS)
        sample = self.sample.thinned(FEW_POINTS).of_views(range(len(self.ids))[few])
        return MaskMaps(sample, self.ids[few], self.features[few], self.shown[few], self.blended[few])

    def _pairs(self, cameras: Sequence[Camera]) -> Iterator[tuple[int, int, Places, Places]]:
        """Every ordered pair of views that share enough points, and where each sees these."""
        sights = [seen(self.sample.xyz, camera, CELLS) for camera in cameras]
        for i, one in enumerate(sights):
            for j, other in enumerate(sights):
                if i == j:
                    continue
                shared, mine, theirs = np.intersect1d(one.rows, other.rows, assume_unique=True, return_indices=True)
                if len(shared) >= max(FEWEST_SHARED, SHARED_SHARE * min(len(one.rows), len(other.rows))):
                    yield i, j, one.places[mine], other.places[theirs]

    @cached_property
    def _rivals(self) -> list[list[tuple[int, Ids]]]:
        """For each view, (whose, mask map) to compare its own with: other views' maps and its own mirrored, but none
        that says nearly the same of the image."""
        rivals, count = [], len(self.ids)
        for view, ids in enumerate(self.ids):
            # Evenly spread over the capture: neighbors show nearly the same.
            others = sorted({(view + step * count // (RIVALS + 1)) % count for step in range(1, RIVALS + 1)} - {view})
            maps = [*((other, self.ids[other]) for other in others), (view, ids[:, ::-1])]
            own = _at(ids, GRID)
            rivals.append([item for item in maps if (_information(own, _at(item[1], GRID)) or 0.0) < ALIKE])
        return rivals


def read_mask_maps(sample: Sample) -> MaskMaps:
    """The masks of the sample's views. Raises SceneError where they cannot be read."""
    ids, shown, blended = [], [], []
    for view in sample.views:
        map_ = np.maximum(view.mask_map(), -1) + 1  # what a lens did not see is in no mask
        shown.append(np.bincount(map_.reshape(-1), minlength=view.mask_count + 1)[1:] > 0)
        blended.append(_blended(map_))
        step = max(1, max(map_.shape) // LONGEST_PX)
        ids.append(map_[step // 2 :: step, step // 2 :: step].astype(np.int64))
    features = [unit_rows(view.mask_features) for view in sample.views]
    return MaskMaps(sample.thinned(POINTS), ids, features, shown, blended)


def _blended(ids: Ids) -> float:
    """Share of the steps from one id to the next, along some rows, that lead to an id between it and the following
    pixel's, less what chance gives. A map of ids that was resized with interpolation, or stored with losses, has such
    ids at its borders; where right masks touch, or leave a gap, there are none.
    """
    rows = ids[:: max(1, len(ids) // LONGEST_PX)]
    left, middle, right = rows[:, :-2], rows[:, 1:-1], rows[:, 2:]
    steps = left != middle
    between = ((left < middle) & (middle < right)) | ((left > middle) & (middle > right))
    # Masks a pixel wide, as of fine textures, are no blends: of three ids the middle one is between in a third of the
    # cases by chance.
    three = steps & (middle != right) & (left != right)
    return float(between.sum() - three.sum() / 3) / max(int(steps.sum()), 1)


def entropies(a: Ids, b: Ids) -> tuple[float, float, float]:
    """Entropies, in nats, of a first labelling, a second, and both together; a, b: (n,) integers from 0. The mutual
    information of the two is the sum of the first two entropies less the third."""
    columns = int(b.max(initial=0)) + 1  # the pair (a, b) as one number: a histogram of pairs in one pass
    joint = np.bincount(a * columns + b, minlength=(int(a.max(initial=0)) + 1) * columns).reshape(-1, columns)
    return _entropy(joint.sum(axis=1)), _entropy(joint.sum(axis=0)), _entropy(joint.reshape(-1))


def _entropy(counts: Ids) -> float:
    shares = counts[counts > 0] / max(counts.sum(), 1)
    return float(-(shares * np.log(shares)).sum())


def _information(a: Ids, b: Ids) -> float | None:
    """Mutual information over the root of both entropies' product, in [0, 1]; None where one says nothing."""
    first, second, both = entropies(a, b)
    if min(first, second) < LEAST_ENTROPY:
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
    fits = (iou[rows, best] > SAME_IOU) & (counts[rows, best] >= FEWEST_POINTS) & (back[best] == rows)
    return [(int(row), int(best[row])) for row in np.flatnonzero(fits)]
