"""The best instances of many scenes for one text, exactly, without fully scoring each.

An instance's evidence is one inner product per descriptor, scaled and shifted (`choosing.Standard`), so one pass over
the descriptors gives all of it. Its probability also depends on the other words of the bank, which is a hundred times
the work; but evidence alone bounds it from above. So instances are scored in the order of their bounds, until no other
can be among the best.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.ask.choosing import log_mean_likelihood
from og_pointcloud.cloud import WordBank, unit_rows
from og_pointcloud.collection.store import Atlas, SceneEntry
from og_pointcloud.scene import DoubleArray, FloatArray, IntArray
from og_pointcloud.settings import ChoosingSettings

RELEVANCY_TEMPERATURE = 10.0
"""Factor of the cosines in LERF's relevancy (Kerr et al., Language Embedded Radiance Fields, ICCV 2023, Sec. 3.4), as
in its released code; the paper gives none."""
ROWS_PER_BATCH = 512
"""Instances whose descriptors are gathered for one matrix product: few enough to stay in a core's cache."""
FIRST_SCORED = 64
"""Instances fully scored at first; then four times as many each time, until it is enough."""


@dataclass(frozen=True)
class Block:
    """S scenes of one encoder, judged by one word bank or by none, with their I instances that have a point and a
    descriptor, scene after scene.

    vectors: (R, D) float32, shift: (R,) float32; the product of a vector with a `direction`, plus its shift, is the
    evidence of a descriptor in standard deviations of the judge's words; without a judge, the cosine. bounds: (I + 1,)
    where each instance's descriptors begin, and the end of the last. scene, instance: (I,) row of ``entries``, and id
    in the scene. points: (I,). center, size: (I, 3) of the boxes. bank: the judge, or None. sharpness: (S,) float64 of
    the scenes (`choosing.Standard`), empty without a judge.
    """

    entries: tuple[SceneEntry, ...]
    vectors: FloatArray
    shift: FloatArray
    bounds: NDArray[np.intp]
    scene: IntArray
    instance: IntArray
    points: IntArray
    center: DoubleArray
    size: DoubleArray
    bank: WordBank | None
    sharpness: DoubleArray

    def __len__(self) -> int:
        return len(self.instance)

    @cached_property
    def ids(self) -> NDArray[np.int64]:
        """(S,) ids of the scenes in their atlas."""
        return np.array([entry.id for entry in self.entries], np.int64)

    @cached_property
    def _starts(self) -> NDArray[np.intp]:
        """(S + 1,) where each scene's instances begin, and the end of the last."""
        return np.searchsorted(self.scene, np.arange(len(self.entries) + 1))

    @cached_property
    def _center_bounds(self) -> DoubleArray:
        """(S, 2, 3) low and high corner around the centers of a scene's instances; infinite, which meets no box, for a
        scene without any."""
        bounds = np.full((len(self.entries), 2, 3), np.inf)
        held = np.flatnonzero(np.diff(self._starts))  # reduceat takes no empty runs
        for corner, least in enumerate((np.minimum, np.maximum) if len(held) else ()):
            bounds[held, corner] = least.reduceat(self.center, self._starts[held])
        return bounds

    @cached_property
    def _logit_bound(self) -> DoubleArray:
        """(2, I) factor and summand: the logit of an instance's score is at most factor * evidence + summand."""
        # `_relevancy` and `_log_odds` with the lowest possible scores of rivals: a cosine of -1, and that of chance.
        if self.bank is None:
            return np.full((2, len(self)), RELEVANCY_TEMPERATURE)
        sharpness = self.sharpness[self.scene]
        return np.stack([sharpness, -(sharpness**2) / 2 - np.log(ChoosingSettings().kinds)])

    @cached_property
    def _bank_words(self) -> tuple[FloatArray, FloatArray]:
        """(D,) mean of the bank's words, and (B, D) unit rows of their deviations from it."""
        assert self.bank is not None
        return self.bank.mean, unit_rows(self.bank.vectors - self.bank.mean)

    def meets(self, box: DoubleArray) -> NDArray[np.bool_]:
        """(S,) whether a scene may have an instance with its center in a box (2, 3)."""
        return ((self._center_bounds[:, 0] <= box[1]) & (self._center_bounds[:, 1] >= box[0])).all(axis=1)

    def direction(self, text: FloatArray) -> FloatArray:
        """(D,) unit vector of a text (D,) whose products with the vectors measure its fit."""
        return unit_rows(text if self.bank is None else unit_rows(text) - self._bank_words[0]).astype(np.float32)

    def evidence(self, rows: NDArray[np.intp], directions: FloatArray) -> FloatArray:
        """(n, L) evidence of instances for directions (L, D): the maximum over an instance's descriptors."""
        best = np.empty((len(rows), len(directions)), np.float32)
        for start in range(0, len(rows), ROWS_PER_BATCH):
            part = rows[start : start + ROWS_PER_BATCH]
            begins, ends = self.bounds[part], self.bounds[part + 1]
            first = np.cumsum(ends - begins) - (ends - begins)
            best[start : start + ROWS_PER_BATCH] = self._best_of(_ranges(begins, ends), first, directions)
        return best

    def _best_of(self, rows: slice | NDArray[np.intp], first: NDArray[np.intp], directions: FloatArray) -> FloatArray:
        """(n, L) maximum evidence of each instance. rows: of descriptors, instance after instance; first: (n,) where
        each instance begins among them."""
        scores = self.vectors[rows] @ directions.T
        scores += self.shift[rows, None]
        return scores if len(first) == len(scores) else np.maximum.reduceat(scores, first, axis=0)

    def rank(
        self,
        text: FloatArray,
        rivals: FloatArray,
        selected: NDArray[np.bool_],
        top: int,
        box: DoubleArray | None = None,
    ) -> tuple[NDArray[np.intp], DoubleArray]:
        """The best ``top`` instances of scenes for a text (D,), the first ones on ties, and the logits of their scores.

        selected: (S,) bool, scenes. box: (2, 3) corners that the instances' centers must lie between.
        With a judge, the score is the probability that the instance is what the text says, as in `og.select` with no
        other word. Without, it is LERF's relevancy against rivals (M, D), unit rows.
        """
        if box is not None:
            selected = selected & self.meets(box)
        # Runs of neighboring scenes, as (begin, end) of instances: their descriptors are multiplied in place, uncopied.
        edges = np.flatnonzero(np.diff(selected, prepend=False, append=False))
        runs = self._starts[edges].reshape(-1, 2)
        direction = self.direction(text)[None]
        bound = np.concatenate([np.zeros(0), *(self._bounds_of(begin, end, direction) for begin, end in runs.tolist())])
        rows = _ranges(*runs.T)
        if box is not None:
            bound[np.searchsorted(rows, self._outside(selected, box))] = -np.inf
        key_of = self._relevancy
        if self.bank is not None:
            key_of = self._log_odds
            _, rivals = self._bank_words
            rivals = rivals[(rivals @ direction[0]) < ChoosingSettings().synonym]  # words of another meaning
        best, key = largest(bound, lambda places: key_of(rows[places], direction, rivals), top)
        return rows[best], key

    def _bounds_of(self, begin: int, end: int, direction: FloatArray) -> DoubleArray:
        """(end - begin,) upper bounds of the logits of consecutive instances for a direction (1, D)."""
        rows = slice(*self.bounds[[begin, end]].tolist())
        evidence = self._best_of(rows, self.bounds[begin:end] - rows.start, direction)[:, 0]
        factor, summand = self._logit_bound[:, begin:end]
        return factor * evidence + summand

    def _outside(self, selected: NDArray[np.bool_], box: DoubleArray) -> NDArray[np.intp]:
        """The instances of scenes with their centers outside a box; only scenes that it cuts have any."""
        is_cut = selected & ((self._center_bounds[:, 0] < box[0]) | (self._center_bounds[:, 1] > box[1])).any(axis=1)
        rows = _ranges(self._starts[:-1][is_cut], self._starts[1:][is_cut])
        center = self.center[rows]
        return rows[((center < box[0]) | (center > box[1])).any(axis=1)]

    def _relevancy(self, rows: NDArray[np.intp], direction: FloatArray, rivals: FloatArray) -> DoubleArray:
        """Logit of the relevancy of a direction (1, D) against the best rival; without rivals, against a cosine of
        0."""
        cosine = self.evidence(rows, np.concatenate([direction, rivals])).astype(np.float64)
        return RELEVANCY_TEMPERATURE * (cosine[:, 0] - (cosine[:, 1:].max(axis=1) if len(rivals) else 0))

    def _log_odds(self, rows: NDArray[np.intp], direction: FloatArray, others: FloatArray) -> DoubleArray:
        """Logit of the probability (`choosing.Chooser`) of a direction (1, D) against the bank's other words."""
        sharpness = self.sharpness[self.scene[rows]]
        exponents = sharpness[:, None] * self.evidence(rows, np.concatenate([direction, others]))
        return exponents[:, 0] - log_mean_likelihood(exponents[:, 1:], sharpness) - np.log(ChoosingSettings().kinds)


def _ranges(begins: NDArray[np.intp], ends: NDArray[np.intp]) -> NDArray[np.intp]:
    """The integers begins[0]..ends[0] - 1, begins[1]..ends[1] - 1, and so on, in one array."""
    count = ends - begins
    return np.arange(count.sum()) + np.repeat(begins - (np.cumsum(count) - count), count)


def largest(
    bound: DoubleArray, key_of: Callable[[NDArray[np.intp]], DoubleArray], top: int
) -> tuple[NDArray[np.intp], DoubleArray]:
    """The ``top`` indices with the largest keys, the first ones on ties, and their keys; computes few of the keys.

    bound: (n,) upper bounds of the keys; -inf excludes an index. key_of: the keys of some indices.
    """
    known, key, count = np.zeros(0, np.intp), np.zeros(0), FIRST_SCORED + top
    while True:
        tried = np.argpartition(-bound, count)[:count] if count < len(bound) else np.arange(len(bound))
        tried = tried[bound[tried] > -np.inf]
        new = np.setdiff1d(tried, known, assume_unique=True)
        known, key = np.append(known, new), np.append(key, key_of(new))
        # Done when all were tried, or no remaining bound reaches the last key needed.
        if len(tried) < count or np.partition(key, -top)[-top] > bound[tried].min():
            order = np.lexsort((known, -key))[:top]
            return known[order], key[order]
        count *= 4


def sigmoid(logit: DoubleArray) -> DoubleArray:
    """The probability of a logit."""
    return 1 / (1 + np.exp(-np.clip(logit, -700, 700)))


def load_block(atlas: Atlas, entries: Sequence[SceneEntry]) -> Block:
    """A block of some scenes of an atlas, all of one encoder and word bank."""
    parts: list[dict[str, NDArray[Any]]] = []
    width = entries[0].width
    vectors = np.empty((sum(entry.numbers for entry in entries) // width, width), np.float32)
    end, sharpness = 0, []
    for number, entry in enumerate(entries):
        table, boxes = atlas.instances(entry)
        owner = table.descriptor_instance
        shown = np.flatnonzero(table.points[owner] > 0)  # an instance without points cannot be found
        rows, shift = table.descriptors[shown], np.zeros(len(shown), np.float32)
        if entry.judge is not None:
            # Evidence is scale * ((descriptor - common) @ direction) + shift: all but the direction is applied here.
            standard = atlas.judgement(entry, len(owner))
            rows, shift = standard.scale[shown, None] * (rows - standard.common), standard.shift[shown]
            sharpness.append(standard.sharpness)
        vectors[end : end + len(shown)] = rows
        instance, first = np.unique(owner[shown], return_index=True)
        low, high = boxes[instance, 0], boxes[instance, 1]
        parts.append({
            "shift": shift, "bounds": end + first, "instance": instance,
            "scene": np.full(len(instance), number, np.int32), "points": table.points[instance],
            "center": (low + high) / 2, "size": high - low,
        })  # fmt: skip
        end += len(shown)
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    columns["bounds"] = np.append(columns["bounds"], end)
    bank = atlas.bank(judge, entries[0].width) if (judge := entries[0].judge) else None
    return Block(tuple(entries), vectors[:end], bank=bank, sharpness=np.array(sharpness), **columns)
