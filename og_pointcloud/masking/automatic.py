"""Masks of everything in an image, by a model that takes point prompts: it is prompted on a grid, and the good
masks are kept, without duplicates.

As in segment-anything's automatic generator, masks with a low predicted IoU or an unstable border are dropped, only
the best of masks with nearly the same box is kept, small holes are filled and small islands removed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.formats.images import require_cv2
from og_pointcloud.masking.contracts import Proposals
from og_pointcloud.scene import FloatArray

Masks = NDArray[np.bool_]


class PointPredictor(Protocol):
    """A segment-anything model in any framework. Coordinates are pixels of the image, x before y."""

    def set_image(self, image: NDArray[np.uint8]) -> None:
        """Encode (H, W, 3) uint8 RGB, once for all prompts."""
        ...

    def at_points(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """points (k, 2) -> logits (k, m, h, w) of m candidate masks each, at the model's resolution without padding, so
        that they cover the image; and predicted IoU (k, m)."""
        ...


@dataclass(frozen=True)
class AutomaticMasks:
    """A proposer around a `PointPredictor`.

    points_per_side: of the grid. batch: prompts at once. least_iou, least_stability: a mask below either is dropped.
    stability_offset: logits by which the border is moved. same_box: masks whose boxes have a larger IoU are duplicates.
    speck_share: smaller holes and islands are removed, a share of the image. Other defaults are segment-anything's,
    which removes no specks.
    """

    predictor: PointPredictor
    points_per_side: int = 32
    batch: int = 64
    least_iou: float = 0.88
    least_stability: float = 0.95
    stability_offset: float = 1.0
    same_box: float = 0.7
    speck_share: float = 1e-4

    def propose(self, image: NDArray[np.uint8]) -> Proposals:
        """image: (H, W, 3) uint8 RGB."""
        height, width = image.shape[:2]
        points = grid(self.points_per_side, width, height)
        self.predictor.set_image(image)
        batches = (points[first : first + self.batch] for first in range(0, len(points), self.batch))
        kept = [self._accepted(*self.predictor.at_points(batch)) for batch in batches]
        logits, scores = (np.concatenate(parts) for parts in zip(*kept, strict=True))
        # Duplicates are removed at low resolution: most prompts find a thing that others found too.
        best = suppress_duplicates(logits > 0, scores, self.same_box)
        masks = np.zeros((len(best), height, width), np.bool_)
        for mask, chosen in zip(masks, best, strict=True):
            full = require_cv2().resize(logits[chosen], (width, height), interpolation=require_cv2().INTER_LINEAR)
            mask[:] = without_specks(full > 0, round(self.speck_share * width * height))
        kept_whole = suppress_duplicates(masks, scores[best], self.same_box)  # again: specks had enlarged boxes
        return Proposals(masks[kept_whole], scores[best][kept_whole])

    def _accepted(self, logits: FloatArray, iou: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The accepted masks (n, h, w) of a batch's logits (k, m, h, w) and IoU (k, m), and their scores (n,)."""
        logits, iou = logits.reshape(-1, *logits.shape[2:]), iou.reshape(-1)
        good = (iou > self.least_iou) & (logits > 0).any(axis=(1, 2))
        good[good] = stability(logits[good], self.stability_offset) >= self.least_stability
        return logits[good], np.clip(iou[good], 0, 1)


def grid(per_side: int, width: int, height: int) -> FloatArray:
    """(per_side^2, 2) points x, y at the centers of equal cells."""
    at = (np.arange(per_side) + 0.5) / per_side
    return np.stack(np.meshgrid(at * width, at * height), axis=-1).reshape(-1, 2).astype(np.float32)


def stability(logits: FloatArray, offset: float) -> FloatArray:
    """(n,): IoU of each mask (n, h, w) at a stricter and at a laxer threshold; 0 where both are empty."""
    strict = (logits > offset).sum(axis=(1, 2))
    lax = (logits > -offset).sum(axis=(1, 2))
    return (strict / np.maximum(lax, 1)).astype(np.float32)


def suppress_duplicates(masks: Masks, scores: FloatArray, max_iou: float) -> NDArray[np.intp]:
    """Non-maximum suppression of masks (n, h, w) by their boxes: indices, best score first, of masks with a score above
    0 whose box has no IoU above ``max_iou`` with a better one's."""
    cv2 = require_cv2()
    boxes = [cv2.boundingRect(mask.astype(np.uint8)) for mask in masks]
    return np.array(cv2.dnn.NMSBoxes(boxes, scores.tolist(), 0.0, max_iou), np.intp).reshape(-1)


def without_specks(mask: Masks, smallest_px: int) -> Masks:
    """The mask (h, w) with holes of fewer pixels filled, then islands of fewer removed; the largest always stays."""
    filled = mask | _specks(~mask, smallest_px, spare_largest=False)
    return filled & ~_specks(filled, smallest_px, spare_largest=True)


def _specks(mask: Masks, smallest_px: int, spare_largest: bool) -> Masks:
    _, labels, stats, _ = require_cv2().connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    area = stats[:, require_cv2().CC_STAT_AREA]
    small = area < smallest_px
    small[0] = False  # label 0 is outside the mask
    if spare_largest and len(area) > 1:
        small[1 + int(np.argmax(area[1:]))] = False
    return small[labels]
