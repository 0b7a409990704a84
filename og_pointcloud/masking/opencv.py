"""Masks without a model: superpixels merged by color and contrast into a region tree.

1. Superpixels: graph segmentation (Felzenszwalb and Huttenlocher, 2004) cut by compact SLIC cells, so that none runs
   from one surface into another of its color.
2. Merging: in every round, pairs of neighbors that are each other's nearest become one region. The distance of two
   regions follows from their mean colors and the contrast along their common border; small or textured regions are
   nearer to all their neighbors.
3. Proposals: the persistent regions. A region's score compares the distance at which it was merged away (death) with
   that at which it was made (birth). Regions overlap only by containing one another; `levels` chooses among them.

All lengths are relative to the image's size; distances are in 8-bit CIE Lab. Nothing is tuned to a scene.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import MissingExtraError
from og_pointcloud.formats.images import require_cv2
from og_pointcloud.masking.contracts import Proposals
from og_pointcloud.scene import DoubleArray, FloatArray, IntArray

Labels = IntArray

WORKING_SIDE_PX = 480
"""Longer side at which regions are found; a larger one finds texture, not things."""
MIN_SIDE_PX = 8
"""An image with a shorter side yields nothing."""
GRAPH_SIGMA, GRAPH_K = 0.6, 15.0
"""The graph segmentation's blur in pixels, and its k: small, for small superpixels, as merging follows."""
MIN_SUPERPIXEL_SHARE = 1e-4
"""Share of the image."""
CELL_SHARE = 1 / 40
"""Side of a SLIC cell, as a share of the image's longer side."""
LIGHTNESS_WEIGHT = 0.5
"""Relative to the two color channels: shading and shadows mainly change lightness."""
TEXTURE_WEIGHT = 0.03
"""Color distances are divided by 1 + this times the standard deviation inside the less textured of the two regions."""
REACH_PX = 2
"""Contrast is measured this far to either side of a border, as the border itself is blurred."""
SMALL_REGION_SHARE = 4e-3
"""Share of the image: a region of this size is nearer to its neighbors by a factor sqrt(2) than a large one."""
NOISE_DISTANCE = 5.0
"""Smaller distances are insignificant: this is added to both sides of the score's ratio."""
MIN_REGION_SHARE, MAX_REGION_SHARE = 4e-4, 0.6
"""Shares of the image: a smaller region is too small for a word to name, a larger one is the surroundings."""
TYPICAL_SHARE = 6e-3
"""Scores of regions much smaller than this share are lowered: of two equally persistent, the larger is the thing."""
MIN_SCORE = 0.1
SAME_REGION_SHARE = 0.85
"""A region with more than this share of an ancestor's area is the same thing; the higher score is kept."""
MAX_PROPOSALS = 250
"""Per image, those with the best scores."""


class OpenCVProposer:
    """The built-in proposer: OpenCV's contrib modules, no weights."""

    def propose(self, image: NDArray[np.uint8]) -> Proposals:
        """image: (H, W, 3) uint8 RGB."""
        cv2 = require_cv2()
        height, width = image.shape[:2]
        scale = min(1.0, WORKING_SIDE_PX / max(height, width))
        size = round(width * scale), round(height * scale)
        if min(size) < MIN_SIDE_PX:
            return Proposals(np.zeros((0, height, width), np.bool_), np.zeros(0, np.float32))
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        tree = region_tree(small)
        chosen, scores = tree.persistent()
        # Superpixels are numbered so that each region is a run of them: its mask is two comparisons per pixel.
        place, runs = tree.runs()
        rank = place[tree.superpixels]
        masks = np.zeros((len(chosen), height, width), np.bool_)
        for mask, (first, end) in zip(masks, runs[chosen], strict=True):
            drawn = ((rank >= first) & (rank < end)).astype(np.uint8) * 255
            mask[:] = cv2.resize(drawn, (width, height), interpolation=cv2.INTER_LINEAR) >= 128
        return Proposals(masks, scores)


@dataclass(frozen=True)
class RegionTree:
    """Superpixels and the regions that they were merged into.

    superpixels: (H, W) int32, 0..n-1. parent: (m,) int32 of the n superpixels, then of merged regions in order of
    birth, so that a parent comes after its children; -1 a root. birth, death: (m,) distance at which a region was made
    (0 for superpixels) and merged away (infinite for roots). area: (m,) pixels.
    """

    superpixels: Labels
    parent: Labels
    birth: DoubleArray
    death: DoubleArray
    area: DoubleArray

    def runs(self) -> tuple[Labels, Labels]:
        """An order of superpixels in which every region is a run: (n,) position of each, (m, 2) first and end."""
        # Sizes from the leaves up, as parents come after their children; then positions from the roots down: each
        # region takes the next free ones of its parent.
        leaves = int(self.superpixels.max()) + 1
        size = np.concatenate([np.ones(leaves, np.int32), np.zeros(len(self.parent) - leaves, np.int32)])
        for region, above in enumerate(self.parent.tolist()):
            if above >= 0:
                size[above] += size[region]
        first = np.zeros(len(size), np.int32)
        free = np.zeros(len(size) + 1, np.int32)  # the last entry serves roots, whose parent is -1
        for region in range(len(size) - 1, -1, -1):
            above = self.parent[region]
            first[region] = free[region] = free[above]
            free[above] += size[region]
        return first[:leaves], np.stack([first, first + size], axis=1)

    def persistent(self) -> tuple[NDArray[np.intp], FloatArray]:
        """Regions worth a proposal, best first, and their scores in [0, 1)."""
        death = np.minimum(self.death, 1.5 * self.birth.max())  # as if roots were merged away a little later
        share = self.area / self.superpixels.size
        score = 1 - (self.birth + NOISE_DISTANCE) / (np.maximum(death, self.birth) + NOISE_DISTANCE)
        score *= np.sqrt(share / (share + TYPICAL_SHARE))
        kept = (share > MIN_REGION_SHARE) & (share < MAX_REGION_SHARE) & (score > MIN_SCORE)
        # Of a chain of regions that hardly grow, one is kept.
        for region in np.flatnonzero(kept):
            above = self.parent[region]
            while above >= 0 and SAME_REGION_SHARE * self.area[above] < self.area[region]:
                if kept[above] and kept[region]:
                    kept[region if score[region] < score[above] else above] = False
                above = self.parent[above]
        chosen = np.flatnonzero(kept)
        chosen = chosen[np.argsort(-score[chosen], kind="stable")][:MAX_PROPOSALS]
        return chosen, score[chosen].astype(np.float32)


def region_tree(image: NDArray[np.uint8]) -> RegionTree:
    """Superpixels of an image (H, W, 3) uint8 RGB, and all regions that they merge into, up to the whole image."""
    cv2 = require_cv2()
    lab = cv2.cvtColor(cv2.bilateralFilter(image, 5, 20, 5), cv2.COLOR_RGB2LAB).astype(np.float32)
    lab[:, :, 0] *= LIGHTNESS_WEIGHT
    superpixels = _superpixels(lab)
    pixels = lab.reshape(-1, 3).astype(np.float64)
    # Sums over the pixels of each region, so that merging is addition: count, colors, their squares.
    regions = _sums(superpixels.ravel(), np.column_stack([np.ones(len(pixels)), pixels, pixels**2]))
    borders = _Borders.of(superpixels, lab)
    # number: each current region's index in the tree, which has at most 2 n - 1 regions.
    count = len(regions)
    number, birth = np.arange(count), np.zeros(2 * count - 1)
    parent, area = np.full(2 * count - 1, -1, np.int32), np.zeros(2 * count - 1)
    area[:count] = regions[:, 0]
    while len(borders.a):
        distance = _distances(regions, borders, superpixels.size)
        pairs = _nearest_pairs(borders, distance, len(regions))
        a, b = borders.a[pairs], borders.b[pairs]
        new = np.arange(count, count + len(pairs))
        parent[number[a]] = parent[number[b]] = new
        # Distances may shrink as regions grow; a merged region is never born before its two parts.
        birth[new] = np.maximum(distance[pairs], np.maximum(birth[number[a]], birth[number[b]]))
        area[new] = regions[a, 0] + regions[b, 0]
        count += len(pairs)
        # b is merged into a; then current regions are renumbered 0, 1, ..., and their sums and borders added up.
        number[a] = new
        into = np.arange(len(number))
        into[b] = a
        left, into = np.unique(into, return_inverse=True)
        number = number[left]
        regions, borders = _sums(into, regions), borders.gathered(into)
    parent, birth, area = parent[:count], birth[:count], area[:count]
    return RegionTree(superpixels, parent, birth, np.where(parent >= 0, birth[parent], np.inf), area)


def _superpixels(lab: FloatArray) -> Labels:
    """(H, W) int32, 0..n-1: graph segments cut by compact cells."""
    cv2 = require_cv2()
    if not hasattr(cv2, "ximgproc"):
        raise MissingExtraError("opencv-contrib-python-headless (this OpenCV has no ximgproc)", "fit")
    height, width = lab.shape[:2]
    smallest = max(4, round(MIN_SUPERPIXEL_SHARE * height * width))
    segments = cv2.ximgproc.segmentation.createGraphSegmentation(GRAPH_SIGMA, GRAPH_K, smallest).processImage(lab)
    side = max(4, round(CELL_SHARE * max(height, width)))
    cells = cv2.ximgproc.createSuperpixelSLIC(lab.astype(np.uint8), cv2.ximgproc.SLICO, side, 10.0)
    cells.iterate(4)
    # A superpixel is a pair of a segment and a cell that occurs.
    both = segments.astype(np.int64) * cells.getNumberOfSuperpixels() + cells.getLabels()
    return np.unique(both, return_inverse=True)[1].reshape(height, width).astype(np.int32)


@dataclass(frozen=True)
class _Borders:
    """Neighbors a < b, (e,), and sums over the pixel pairs of their border: count, contrast."""

    a: NDArray[np.integer]
    b: NDArray[np.integer]
    length: DoubleArray
    contrast: DoubleArray

    @classmethod
    def of(cls, labels: Labels, lab: FloatArray) -> _Borders:
        across, down = _pixel_pairs(labels, lab), _pixel_pairs(labels.T, lab.transpose(1, 0, 2))
        a, b = np.concatenate([across[0], down[0]]), np.concatenate([across[1], down[1]])
        contrast = np.concatenate([across[2], down[2]])
        return cls(a, b, np.ones(len(a)), contrast).gathered(np.arange(int(labels.max()) + 1))

    def gathered(self, into: NDArray[np.intp]) -> _Borders:
        """The borders after regions were renumbered by ``into``: borders inside a region are removed, others add up."""
        count = int(into.max()) + 1
        a, b = into[self.a], into[self.b]
        between = a != b
        key = np.minimum(a, b)[between] * count + np.maximum(a, b)[between]
        pair, place = np.unique(key, return_inverse=True)
        length, contrast = _sums(place, np.stack([self.length, self.contrast], axis=1)[between]).T
        return _Borders(pair // count, pair % count, length, contrast)


def _sums(labels: NDArray[np.integer], values: DoubleArray) -> DoubleArray:
    """(groups, c): sums of the rows of ``values`` (k, c) with the same label."""
    count = int(labels.max(initial=-1)) + 1
    return np.stack([np.bincount(labels, column, count) for column in values.T], axis=1).astype(np.float64)


def _pixel_pairs(labels: Labels, lab: FloatArray) -> tuple[Labels, Labels, DoubleArray]:
    """For the p pixels whose right neighbor is in another region: both regions, and the contrast there, each (p,)."""
    row, column = np.nonzero(labels[:, :-1] != labels[:, 1:])
    left, right = np.maximum(column + 1 - REACH_PX, 0), np.minimum(column + REACH_PX, labels.shape[1] - 1)
    contrast = np.linalg.norm(lab[row, left] - lab[row, right], axis=1).astype(np.float64)
    return labels[row, column], labels[row, column + 1], contrast


def _distances(regions: DoubleArray, borders: _Borders, pixels: int) -> DoubleArray:
    """(e,) distance of the two regions of each border. regions: (n, 7) pixels, sums of colors, of their squares."""
    a, b, area = borders.a, borders.b, regions[:, 0]
    mean, mean_squared = regions[:, 1:4] / area[:, None], regions[:, 4:] / area[:, None]
    texture = np.sqrt(np.maximum(mean_squared - mean**2, 0).sum(axis=1))
    # The mean of two differences, of mean colors and of colors along the border; texture and small size shrink it.
    color = np.linalg.norm(mean[a] - mean[b], axis=1)
    color = (color + borders.contrast / borders.length) / 2 / (1 + TEXTURE_WEIGHT * np.minimum(texture[a], texture[b]))
    share = np.minimum(area[a], area[b]) / pixels
    return color * np.sqrt(share / (share + SMALL_REGION_SHARE))


def _nearest_pairs(borders: _Borders, distance: DoubleArray, count: int) -> NDArray[np.intp]:
    """Borders whose two regions are each other's nearest; of these only the nearest third, at least one, so that the
    order stays close to that of merging the nearest pair each time."""
    # Ranks have no ties.
    order = np.argsort(distance, kind="stable")
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    nearest = np.full(count, len(order))
    np.minimum.at(nearest, borders.a, rank)
    np.minimum.at(nearest, borders.b, rank)
    mutual = np.sort(rank[(nearest[borders.a] == rank) & (nearest[borders.b] == rank)])
    return order[mutual[: -(-len(mutual) // 3)]]
