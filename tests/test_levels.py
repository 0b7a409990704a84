"""Levels against a slow literal reference on pixels; invariances."""

from __future__ import annotations

import numpy as np
import pytest

from og_pointcloud.errors import SceneError
from og_pointcloud.masking.contracts import Proposals
from og_pointcloud.masking.levels import INSIDE_SHARE, PARTS_WEIGHT, SAME_IOU, VISIBLE_SHARE, masks_of_level


def rectangle(top, left, bottom, right, size=(24, 32)):
    mask = np.zeros(size, bool)
    mask[top:bottom, left:right] = True
    return mask


def proposals(*pairs):
    return Proposals(np.array([mask for mask, _ in pairs]), np.array([score for _, score in pairs], np.float32))


def settle(said: Proposals, level: str):
    return masks_of_level(said, level)[0]


def random_proposals(seed, count=25, size=(24, 32)):
    rng = np.random.default_rng(seed)
    masks = []
    for _ in range(count):
        top, left = rng.integers(0, size[0] - 2), rng.integers(0, size[1] - 2)
        bottom, right = rng.integers(top + 1, size[0] + 1), rng.integers(left + 1, size[1] + 1)
        masks.append(rectangle(top, left, bottom, right, size))
    return Proposals(np.array(masks), rng.uniform(0.1, 1, count).astype(np.float32))


def literal(said: Proposals, preference: float):
    """The rules as written, pixel by pixel and mask by mask: -1 for none, and the masks by how good they are."""
    order = sorted(range(len(said)), key=lambda k: (-float(said.scores[k]), said.masks[k].sum(), k))
    kept: list[int] = []
    for k in order:
        mask = said.masks[k]
        same = [(mask & said.masks[o]).sum() > SAME_IOU * (mask | said.masks[o]).sum() for o in kept]
        if mask.any() and not any(same):
            kept.append(k)

    def parent(k):
        mask = said.masks[k]
        around = [
            o for o in kept
            if said.masks[o].sum() > mask.sum() and (mask & said.masks[o]).sum() > INSIDE_SHARE * mask.sum()
        ]  # fmt: skip
        return min(around, key=lambda o: (said.masks[o].sum(), kept.index(o))) if around else None

    parents = {k: parent(k) for k in kept}

    def value(k):
        return max(own(k), preference * parts(k))

    def own(k):
        return float(said.masks[k].sum()) * float(said.scores[k])

    def parts(k):
        return sum(value(child) for child in kept if parents[child] == k)

    def chosen(k):
        return [k] if own(k) >= preference * parts(k) else [x for c in kept if parents[c] == k for x in chosen(c)]

    used = [x for k in kept if parents[k] is None for x in chosen(k)]
    used.sort(key=kept.index)
    result = np.full(said.masks.shape[1:], -1)
    for k in used:
        free = said.masks[k] & (result == -1)
        if free.sum() >= VISIBLE_SHARE * said.masks[k].sum():
            result[free] = k
    shown = [k for k in kept if (result == k).any()]
    return sum(((result == k) * (rank + 1) for rank, k in enumerate(shown)), np.full(result.shape, -1))


@pytest.mark.parametrize("seed", range(12))
def test_the_literal_reference(seed):
    said = random_proposals(seed)
    for name in PARTS_WEIGHT:
        assert np.array_equal(settle(said, name), literal(said, PARTS_WEIGHT[name])), name


def test_a_box_of_two_halves_on_three_levels():
    whole, left, right = rectangle(4, 4, 20, 28), rectangle(4, 4, 20, 16), rectangle(4, 16, 20, 28)
    said = proposals((whole, 0.8), (left, 0.76), (right, 0.75))
    assert np.array_equal(settle(said, "large") == 0, whole)
    assert np.array_equal(settle(said, "medium") == 0, whole)
    assert np.array_equal(settle(said, "small") == 0, left)
    assert np.array_equal(settle(said, "small") == 1, right)


def test_scores_decide_where_masks_overlap():
    a, b = rectangle(0, 0, 10, 20), rectangle(0, 12, 10, 32)
    both = a & b
    first, second = (settle(proposals((a, x), (b, y)), "large") for x, y in ((0.9, 0.5), (0.5, 0.9)))
    assert np.array_equal(first == 0, a)
    assert np.array_equal(first == 1, b & ~both)
    assert np.array_equal(second == 0, b)
    assert np.array_equal(second == 1, a & ~both)


def test_a_mask_that_is_mostly_hidden_hides_nothing():
    best, hidden, behind = rectangle(0, 0, 10, 16), rectangle(0, 4, 10, 20), rectangle(0, 17, 10, 40)
    settled = settle(proposals((best, 0.99), (hidden, 0.95), (behind, 0.9)), "large")
    assert np.array_equal(settled == 0, best)
    assert np.array_equal(settled == 1, behind)


@pytest.mark.parametrize("seed", range(6))
def test_levels_are_contained_in_one_another_in_a_tree(seed):
    rng = np.random.default_rng(seed)
    masks, todo = [], [(0, 0, 24, 32)]
    while todo:
        top, left, bottom, right = todo.pop()
        masks.append(rectangle(top, left, bottom, right))
        if bottom - top > 4 and right - left > 4:
            middle = int(rng.integers(left + 2, right - 1))
            todo += [(top, left, bottom, middle), (top, middle, bottom, right)]
    said = Proposals(np.array(masks), rng.uniform(0.2, 1, len(masks)).astype(np.float32))
    for finer, coarser in (("small", "medium"), ("medium", "large")):
        fine = settle(said, finer)
        for number in range(fine.max() + 1):
            owners = np.unique(settle(said, coarser)[fine == number])
            assert len(owners) == 1
            assert owners[0] >= 0


def test_the_order_of_proposals_does_not_matter():
    said = random_proposals(3)
    order = np.random.default_rng(0).permutation(len(said))
    shuffled = Proposals(said.masks[order], said.scores[order])
    for name in PARTS_WEIGHT:
        assert np.array_equal(settle(said, name), settle(shuffled, name))


def test_a_near_copy_is_one_mask_the_better_scored():
    a, b = rectangle(2, 2, 20, 20), rectangle(2, 2, 20, 21)
    assert np.array_equal(settle(proposals((a, 0.5), (b, 0.6)), "large") == 0, b)


def test_nothing_and_empty_masks():
    none = Proposals(np.zeros((0, 5, 7), bool), np.zeros(0, np.float32))
    empty = Proposals(np.zeros((2, 5, 7), bool), np.ones(2, np.float32))
    for name in PARTS_WEIGHT:
        for said in (none, empty):
            assert np.array_equal(settle(said, name), np.full((5, 7), -1))


def test_proposals_are_checked():
    with pytest.raises(SceneError, match="expected bool"):
        Proposals(np.zeros((2, 3, 4), np.uint8), np.ones(2, np.float32))
    with pytest.raises(SceneError, match="a finite one per proposal"):
        Proposals(np.zeros((2, 3, 4), bool), np.full(2, np.nan, np.float32))
