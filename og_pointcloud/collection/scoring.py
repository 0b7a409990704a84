"""The instances of many scenes against one text: the best of them, exactly, without scoring each to the end.

An instance's evidence is one inner product a descriptor and a line (`choosing.Standard`), so all of it takes one pass
over the descriptors. Its probability also depends on what other words of the bank say, which is a hundred times the
work; but evidence alone bounds it from above. So instances are taken by their bounds, best first, until no other can
reach the places that are asked for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.cloud import Vocabulary, WordBank, unit_rows
from og_pointcloud.collection.store import Atlas, SceneEntry
from og_pointcloud.settings import ChoosingSettings

__all__ = ["Block", "Ranked", "block_key", "load_block"]

RELEVANCY_TEMPERATURE = 10.0
"""Factor of the cosines in LERF's relevancy (Kerr et al., Language Embedded Radiance Fields, ICCV 2023, Sec. 3.4):
of its released code, the paper gives none."""

ROWS_AT_ONCE = 512
"""Descriptors that are put together before a product: so many stay in a core's cache."""
LEAST_RUN = 16
"""Mean length of runs of descriptors from which each run has a product of its own."""
FIRST = 256
"""Instances scored to the end at first; then twice as many, as long as it takes."""
CERTAIN = 1e-12
"""Distance from 0 and 1 at which a cosine's logit is cut off."""


@dataclass(frozen=True)
class Ranked:
    """rows: (n,) instances of a block, best first. key: (n,) float64, what they are ranked by, the same for all
    blocks: the logit of the score. score: (n,) float64."""

    rows: NDArray[np.intp]
    key: NDArray[np.float64]
    score: NDArray[np.float64]

    def rows_with_scores(self) -> list[tuple[int, float, float]]:
        """(row, key, score), best first."""
        return list(zip(self.rows.tolist(), self.key.tolist(), self.score.tolist(), strict=True))


@dataclass(frozen=True)
class Block:
    """Scenes that are asked alike: of one kin, with one vocabulary and one judge. Only instances with a descriptor.

    entries: S scenes. descriptors: (R, D) float32. first: (I,) the first descriptor of each instance. scene, instance:
    (I,) row of entries, and id in the scene. points: (I,). low, high: (I, 3) float64, corners of the box.
    bank: the judge; None for none, then the following are empty. common: (S, D). scale, shift: (R,). sharpness: (S,).
    """

    entries: tuple[SceneEntry, ...]
    descriptors: NDArray[np.float32]
    first: NDArray[np.intp]
    scene: NDArray[np.int32]
    instance: NDArray[np.int32]
    points: NDArray[np.int32]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    bank: WordBank | None
    common: NDArray[np.float32]
    scale: NDArray[np.float32]
    shift: NDArray[np.float32]
    sharpness: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.instance)

    @cached_property
    def _end(self) -> NDArray[np.intp]:
        return np.append(self.first, len(self.descriptors))

    def direction(self, text: NDArray[np.float32]) -> NDArray[np.float32]:
        """(D,) of a text (D,): the unit vector whose products with the descriptors say how it fits."""
        unit = unit_rows(text) if self.bank is None else unit_rows(unit_rows(text) - self.bank.mean)
        return unit.astype(np.float32)

    def evidence_vectors(self) -> NDArray[np.float32]:
        """(R, D + 1): their inner product with (direction, 1) is the evidence of each descriptor, without judge the
        cosine."""
        if self.bank is None:
            return np.pad(self.descriptors, ((0, 0), (0, 1)))
        of_row = np.repeat(self.scene, np.diff(self._end))
        scaled = self.scale[:, None] * (self.descriptors - self.common[of_row])
        return np.column_stack([scaled, self.shift]).astype(np.float32)

    def rank(
        self,
        text: NDArray[np.float32],
        rivals: NDArray[np.float32],
        chosen: NDArray[np.bool_] | None,
        top: int,
    ) -> Ranked:
        """The best ``top`` of the chosen instances (None: of all) for a text (D,), of equals the first.

        With a judge the score is the probability that the instance is what the text says, as `og.select` has it
        against no other word. Without, against rivals (M, D), LERF's relevancy; without those the cosine.
        """
        has_points = self.points > 0
        rows = np.flatnonzero(has_points if chosen is None else has_points & chosen)
        if self.bank is not None:
            rows, key = self._most_probable(rows, text, top)
        else:
            key = self._uncalibrated(rows, text, rivals)
        order = np.argsort(-key, kind="stable")[:top]
        rows, key = rows[order], key[order]
        if self.bank is None and not len(rivals):
            return Ranked(rows, _logit(key), key)
        return Ranked(rows, key, _share(key))

    def _uncalibrated(
        self, rows: NDArray[np.intp], text: NDArray[np.float32], rivals: NDArray[np.float32]
    ) -> NDArray[np.float64]:
        cosine = self._best(rows, self._cosines(rows, self.direction(text)[None]))[:, 0].astype(np.float64)
        if not len(rivals):
            return cosine
        rival = self._best(rows, self._cosines(rows, unit_rows(rivals))).max(axis=1)
        return RELEVANCY_TEMPERATURE * (cosine - rival)

    def _most_probable(
        self, rows: NDArray[np.intp], text: NDArray[np.float32], top: int
    ) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
        """At least the best ``top`` of these instances, and the logit of their probability."""
        assert self.bank is not None
        settings = ChoosingSettings()
        direction = self.direction(text)[None]
        bank = unit_rows(self.bank.vectors - self.bank.mean)
        others = bank[(bank @ direction[0]) < settings.synonym]
        sharpness = self.sharpness[self.scene[rows]].astype(np.float64)
        label = sharpness * self._evidence(rows, direction)[:, 0]
        by_chance = sharpness**2 / 2
        bound = label - by_chance - np.log(settings.kinds)
        known = np.zeros(0, np.intp)
        key = np.full(len(rows), -np.inf)
        count = FIRST + top
        while True:
            best = _largest(bound, count)
            new = np.setdiff1d(best, known, assume_unique=True)
            none = by_chance[new]
            if len(others) and len(new):
                said = sharpness[new, None] * self._evidence(rows[new], others)
                none = np.maximum(none, np.logaddexp.reduce(said, axis=1) - np.log(len(others)))
            key[new] = label[new] - none - np.log(settings.kinds)
            known = best
            if len(best) == len(rows) or np.partition(key[best], -top)[-top] >= bound[best].min():
                best.sort()
                return rows[best], key[best]
            count *= 4

    def _evidence(self, rows: NDArray[np.intp], directions: NDArray[np.float32]) -> NDArray[np.float32]:
        """(n, L) of these instances for unit directions (L, D), in standard deviations of the judge's words."""
        where = self._descriptors_of(rows)
        of_row = np.repeat(self.scene[rows], np.diff(self._end)[rows])
        common = self.common @ directions.T
        scores = self._cosines(rows, directions)
        scores -= common[of_row]
        scores *= self.scale[where, None]
        scores += self.shift[where, None]
        return self._best(rows, scores)

    def _cosines(self, rows: NDArray[np.intp], directions: NDArray[np.float32]) -> NDArray[np.float32]:
        """(descriptors of these instances, L)."""
        where = self._descriptors_of(rows)
        if isinstance(where, slice):
            return self.descriptors @ directions.T
        scores = np.empty((len(where), len(directions)), np.float32)
        ends = np.append(np.flatnonzero(np.diff(where) != 1) + 1, len(where))
        if len(ends) * LEAST_RUN > len(where):
            for start in range(0, len(where), ROWS_AT_ONCE):
                part = slice(start, start + ROWS_AT_ONCE)
                scores[part] = self.descriptors[where[part]] @ directions.T
            return scores
        for begin, end in pairwise([0, *ends.tolist()]):  # whole scenes: multiplied where they lie, not copied
            np.matmul(self.descriptors[where[begin] : where[end - 1] + 1], directions.T, out=scores[begin:end])
        return scores

    def _descriptors_of(self, rows: NDArray[np.intp]) -> NDArray[np.intp] | slice:
        """Numbers of the descriptors of these instances, in their order; of all instances, all."""
        if len(rows) == len(self):
            return slice(None)
        count = np.diff(self._end)[rows]
        begin = np.cumsum(count) - count
        return np.arange(count.sum()) + np.repeat(self.first[rows] - begin, count)

    def _best(self, rows: NDArray[np.intp], scores: NDArray[np.float32]) -> NDArray[np.float32]:
        """(n, L) of the descriptors' scores, the largest of each instance."""
        if len(rows) == 0:
            return np.zeros((0, scores.shape[1]), np.float32)
        count = np.diff(self._end)[rows]
        return np.maximum.reduceat(scores, np.cumsum(count) - count, axis=0)


def block_key(entry: SceneEntry, words: Mapping[str, Vocabulary]) -> tuple[Any, ...]:
    """Scenes of one key are asked alike: kin, own words and judge. words: the vocabularies by digest."""
    return entry.kin, entry.vocabulary if entry.vocabulary in words else None, entry.judge


def load_block(atlas: Atlas, entries: Sequence[SceneEntry]) -> Block:
    """Scenes of an atlas with one kin, vocabulary and judge, by name; their arrays lie behind each other."""
    loaded = [atlas.arrays(entry) for entry in entries]
    judge, width = entries[0].judge, entries[0].width
    sizes = [len(arrays.owner) for arrays in loaded]
    parts: dict[str, list[NDArray]] = {name: [] for name in ("first", "scene", "instance", "points", "low", "high")}
    standards = [atlas.judgement(entry, size) for entry, size in zip(entries, sizes, strict=True)] if judge else []
    start = 0
    for number, arrays in enumerate(loaded):
        instance, first = np.unique(arrays.owner, return_index=True)
        parts["first"].append(first + start)
        parts["scene"].append(np.full(len(instance), number, np.int32))
        parts["instance"].append(instance)
        for name in ("points", "low", "high"):
            parts[name].append(arrays.instances[name][instance])
        start += len(arrays.owner)
    together = {name: np.concatenate(arrays) for name, arrays in parts.items()}
    bank = atlas.bank(judge, width) if judge else None
    common = np.array([standard.common for standard in standards], np.float32).reshape(len(standards), width)
    return Block(
        entries=tuple(entries),
        descriptors=np.concatenate([arrays.descriptors for arrays in loaded]),
        bank=bank,
        common=common,
        scale=np.concatenate([np.zeros(0, np.float32), *(standard.scale for standard in standards)]),
        shift=np.concatenate([np.zeros(0, np.float32), *(standard.shift for standard in standards)]),
        sharpness=np.array([standard.sharpness for standard in standards], np.float32),
        **together,
    )


def _largest(values: NDArray[np.float64], count: int) -> NDArray[np.intp]:
    if count >= len(values):
        return np.arange(len(values))
    return np.argpartition(values, len(values) - count)[len(values) - count :]


def _share(logit: NDArray[np.float64]) -> NDArray[np.float64]:
    """The probability of a logit."""
    return 1 / (1 + np.exp(-np.clip(logit, -700, 700)))


def _logit(share: NDArray[np.float64]) -> NDArray[np.float64]:
    share = np.clip(share, CERTAIN, 1 - CERTAIN)
    return np.log(share) - np.log1p(-share)
