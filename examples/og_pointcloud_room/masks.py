"""A simulated mask proposer: randomly numbered, ragged, split, merged, missing and spurious masks.

Distances and edge noise are computed exactly or elementwise, not by OpenCV, whose rounding depends on the processor.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from og_pointcloud.errors import OgPointcloudError

Random = np.random.Generator


@dataclass(frozen=True)
class MaskNoise:
    """How a proposer errs.

    split: chance that a visible object comes as two or three masks. merge: chance that it is joined with an object it
    touches in the image. miss: chance that it has no mask. spurious: chance that a view has a mask on bare wall or
    floor. wrong_class: chance that a mask's feature is that of another class. edge_px: how far edges wander, pixels.
    smallest_share: masks below this share of the image are dropped. swallow: chance that an object without a mask lies
    in the mask of the larger thing it touches most, as a cup in its table's; else that mask has a hole there.
    """

    split: float = 0.15
    merge: float = 0.04
    miss: float = 0.1
    spurious: float = 0.05
    wrong_class: float = 0.05
    edge_px: float = 0.7
    smallest_share: float = 2e-4
    swallow: float = 0.0

    def scaled(self, level: float) -> MaskNoise:
        """The same proposer with every chance and ``edge_px`` times ``level`` (0: perfect masks)."""
        if not level >= 0:
            raise OgPointcloudError(f"mask noise is {level}; expected 0 (perfect masks) or more (1: the default noise)")
        names = ("split", "merge", "miss", "spurious", "wrong_class")
        chances = {name: min(level * getattr(self, name), 1.0) for name in names}
        return replace(self, edge_px=level * self.edge_px, **chances)


def propose_masks(owner: NDArray[np.int32], noise: MaskNoise, rng: Random) -> NDArray[np.uint16]:
    """Ids of one view's masks, (H, W) uint16: 0 none, else 1..M in random order.

    owner: (H, W) int32, the object seen at each pixel, -1 for walls, floor and ceiling.
    """
    # A proposer's errors in turn: joined, missing, split and spurious masks.
    regions = [owner == instance for instance in np.unique(owner[owner >= 0])]
    regions = _merged(regions, noise.merge, rng)
    regions = _found(regions, noise, rng)
    regions = [
        part for region in regions for part in (_split(region, rng) if rng.uniform() < noise.split else [region])
    ]
    if rng.uniform() < noise.spurious:
        regions.append(_blob(owner, rng))
    # Numbered and painted in random order: where masks overlap at their edges, either may be on top.
    ids = np.zeros(owner.shape, np.uint16)
    for rank, index in enumerate(rng.permutation(len(regions))):
        _paint(ids, regions[index], rank + 1, noise.edge_px, rng)
    return _without_tiny(ids, noise.smallest_share * owner.size)


def _merged(regions: list[NDArray[np.bool_]], chance: float, rng: Random) -> list[NDArray[np.bool_]]:
    """Each region is, by chance, joined with one that it touches."""
    merged = list(regions)
    for index in range(len(regions)):
        if rng.uniform() >= chance:
            continue
        rim = cv2.dilate(regions[index].astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
        touching = [other for other in range(len(regions)) if other != index and (regions[other] & rim).sum() > 10]
        if touching:
            other = touching[rng.integers(len(touching))]
            merged[other], merged[index] = merged[other] | merged[index], np.zeros_like(merged[index])
    return [region for region in merged if region.any()]


def _found(regions: list[NDArray[np.bool_]], noise: MaskNoise, rng: Random) -> list[NDArray[np.bool_]]:
    """The regions that are not missed, some of them including missed ones that they touch."""
    found = [rng.uniform() >= noise.miss for _ in regions]
    kept = {index: regions[index] for index in np.flatnonzero(found).tolist()}
    for index in np.flatnonzero(~np.array(found, bool)).tolist() if noise.swallow else []:
        rim = cv2.dilate(regions[index].astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
        larger = [other for other, region in kept.items() if region.sum() > regions[index].sum()]
        touching = {other: int((regions[other] & rim).sum()) for other in larger}
        most = max(touching, key=lambda other: touching[other], default=None)
        if rng.uniform() < noise.swallow and most is not None and touching[most] > 10:
            kept[most] = kept[most] | regions[index]
    return list(kept.values())


def _split(region: NDArray[np.bool_], rng: Random) -> list[NDArray[np.bool_]]:
    """Two or three parts: the cells of random pixels of the region."""
    pixels = np.argwhere(region)
    places = rng.uniform(size=rng.integers(2, 4))  # shares of the list, so that one more pixel moves no seed far
    seeds = pixels[(places * len(pixels)).astype(int)]
    nearest = ((pixels[:, None] - seeds[None]) ** 2).sum(axis=2).argmin(axis=1)
    parts = []
    for cell in range(len(seeds)):
        part = np.zeros_like(region)
        part[tuple(pixels[nearest == cell].T)] = True
        parts.append(part)
    return parts


def _blob(owner: NDArray[np.int32], rng: Random) -> NDArray[np.bool_]:
    """A small ellipse on the background, one to three hundredths of the image's area."""
    height, width = owner.shape
    rows, columns = np.nonzero(owner < 0)
    blob = np.zeros(owner.shape, np.uint8)
    if len(rows):
        pick = rng.integers(len(rows))
        axes = (rng.uniform(0.05, 0.1, 2) * (width, height)).astype(int)
        cv2.ellipse(
            blob, (int(columns[pick]), int(rows[pick])), axes.tolist(), float(rng.uniform(0, 180)), 0, 360, 1, -1
        )
    return blob.astype(bool) & (owner < 0)


def _paint(ids: NDArray[np.uint16], region: NDArray[np.bool_], number: int, edge_px: float, rng: Random) -> None:
    """Writes ``number`` over the region, its edge eroded and dilated by a smooth random field of ``edge_px`` pixels."""
    rows, columns = np.nonzero(region)
    if len(rows) == 0:
        return
    margin = int(np.ceil(3 * edge_px)) + 1
    top, bottom = max(int(rows.min()) - margin, 0), int(rows.max()) + margin + 1
    left, right = max(int(columns.min()) - margin, 0), int(columns.max()) + margin + 1
    # The region is where its signed distance exceeds 0; where it exceeds a smooth field instead, edges wander.
    inside = region[top:bottom, left:right]
    signed_px = np.where(inside, _distance_px(inside), -_distance_px(~inside))
    coarse = np.clip(
        rng.normal(size=(region.shape[0] // 8 + 2, region.shape[1] // 8 + 2)) + 0.5 * rng.normal(), -2.5, 2.5
    )
    wander_px = edge_px * _enlarged(coarse, np.arange(top, top + len(inside)), np.arange(left, left + inside.shape[1]))
    ids[top:bottom, left:right][signed_px > wander_px] = number


def _distance_px(inside: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Distance of each pixel to the nearest one outside; the picture's size where there is none."""
    return distance_transform_edt(inside) if not inside.all() else np.full(inside.shape, float(sum(inside.shape)))


def _enlarged(coarse: NDArray[np.float64], rows: NDArray[np.int64], columns: NDArray[np.int64]) -> NDArray[np.float64]:
    """(rows, columns) linearly interpolated from the values of ``coarse``, which are 8 pixels apart."""
    (row, down), (column, right) = (np.divmod(at, 8) for at in (rows, columns))
    down, right = down[:, None] / 8, right[None] / 8
    upper = coarse[np.ix_(row, column)] * (1 - right) + coarse[np.ix_(row, column + 1)] * right
    lower = coarse[np.ix_(row + 1, column)] * (1 - right) + coarse[np.ix_(row + 1, column + 1)] * right
    return upper * (1 - down) + lower * down


def _without_tiny(ids: NDArray[np.uint16], smallest_px: float) -> NDArray[np.uint16]:
    """Masks below ``smallest_px`` pixels dropped, the others renumbered 1..M in the same order."""
    counts = np.bincount(ids.ravel())
    kept = np.flatnonzero(counts[1:] >= max(smallest_px, 1)) + 1
    table = np.zeros(len(counts), np.uint16)
    table[kept] = np.arange(len(kept)) + 1
    return table[ids]
