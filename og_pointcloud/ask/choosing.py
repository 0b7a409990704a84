"""Which label fits an instance, with what probability, and whether any does: text vectors and descriptors -> Choice.

The cosine of an image with a text says little by itself. With real CLIP a fitting text has about 0.33 and any other
0.18, while texts have 0.74 among themselves and images 0.53: all images share one large component, all texts another,
and some words are close to every image. So a score is compared with what it would be by chance, in three steps:

1. Center. Subtract what all kinds of things in the scene share from descriptors, what all words share from words.
2. Standardise. A bank of a few hundred everyday words (``WordBank``) shows how words that do not fit score on this
   instance; a label's evidence is its distance from their mean, in their standard deviations.
3. Weigh. An instance is one of the labels, or what another word of the bank names, or something that no word stands
   out for. Their posterior probabilities add up to one; the last two are "unknown".

No threshold is a cosine, and none is tuned to a scene: each instance has its own null distribution.

Without a word bank the largest cosine wins.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from og_pointcloud.cloud import (
    BACKGROUND,
    TOO_FAR,
    UNKNOWN,
    UNKNOWN_SPACE,
    UNOBSERVED,
    FeatureSpace,
    InstanceTable,
    WordBank,
    best_of_rows,
    finite_rows,
    unit_rows,
)  # fmt: skip
from og_pointcloud.scene import DoubleArray, FloatArray, IntArray
from og_pointcloud.settings import ChoosingSettings

SAME_TEXT_DISTANCE = 1e-5
"""Unit vectors at most this far apart are the same text; float32 rounding is a hundredth of it."""


class Reason(IntEnum):
    """Why a point or instance has no label.

    >>> import og_pointcloud as og
    >>> int(og.Reason.TOO_FAR), str(og.Reason.TOO_FAR)
    (5, 'too far from the scene')
    """

    LABELLED = 0
    NONE_FITS = 1
    """Observed, but none of these labels is more probable than something else."""
    NOT_DESCRIBED = 2
    """An instance that no mask gave a feature."""
    IN_NO_MASK = 3
    """Seen outside every mask."""
    UNOBSERVED = 4
    """No view saw it."""
    TOO_FAR = 5
    """No point of the scene is within reach."""
    NOT_FINITE = 6
    """Its coordinates hold NaN or infinity."""

    def __str__(self) -> str:
        """The reason as the end of a sentence about points: "12 are ..."."""
        return _IN_WORDS[self]


_IN_WORDS = {
    Reason.LABELLED: "labelled",
    Reason.NONE_FITS: "like none of these labels",
    Reason.NOT_DESCRIBED: "of instances without a feature",
    Reason.IN_NO_MASK: "background",
    Reason.UNOBSERVED: "unobserved",
    Reason.TOO_FAR: "too far from the scene",
    Reason.NOT_FINITE: "without finite coordinates",
}


@dataclass(frozen=True)
class Choice:
    """The answer for K instances and L labels.

    labels: (K,) int32, the most probable label, -1 where "none of these" is more probable than all labels together.
    probability: (K,) float32, probability of that label; 0 where unknown.
    unknown: (K,) float32, probability that none of the labels fits; 1 for an instance without descriptor.
    table: (K, L) float32, probability of each label: rows of different labels add up to 1 - unknown. Labels with the
        same vector are one hypothesis, and each has its probability.
    evidence: (K, L) float32, standard deviations above the bank's words; -inf without descriptor or text.
    reasons: (K,) int8, a ``Reason``.
    membership: (K,) float32, probability that a point with the instance's id belongs to it: all v views of the instance
        agreed, which gives (v + 1/2) / (v + 1) (Jeffreys' prior).
    calibrated: false without a bank: probability and unknown are then NaN, and evidence is the cosine.
    """

    labels: IntArray
    probability: FloatArray
    unknown: FloatArray
    table: FloatArray
    evidence: FloatArray
    reasons: NDArray[np.int8]
    membership: FloatArray
    calibrated: bool = True

    @property
    def scores(self) -> FloatArray:
        """(K, L) scores that rank words: the probability if calibrated, else the cosine (-inf: no descriptor)."""
        return self.table if self.calibrated else self.evidence

    def ranking(self, label: int) -> NDArray[np.intp]:
        """(K,) instances by how well one label fits them, best first; ties go to the smaller id.

        Evidence ranks instances whose probabilities are saturated at 0 or 1.
        """
        return np.lexsort((-self.evidence[:, label], -self.scores[:, label]))

    def words(self, instance: int, names: Sequence[str], count: int | None = None) -> list[tuple[str, float]]:
        """The labels of one instance with their scores, best first; only the first ``count`` if given.

        names: (L,) names of the labels. Empty for an instance without a descriptor.
        """
        if self.reasons[instance] == Reason.NOT_DESCRIBED:
            return []
        # Within one instance, more evidence means a higher score, also where probabilities are saturated at 0.
        order: list[int] = np.argsort(-self.evidence[instance], kind="stable")[:count].tolist()
        return [(names[index], float(self.scores[instance, index])) for index in order]

    @cached_property
    def by_id(self) -> tuple[IntArray, FloatArray, NDArray[np.int8]]:
        """Label, score and reason by instance id, (K + 3,) each: those of ids -3, -2 and -1 follow the last instance.

        The score is that of a point with the id: if calibrated, its instance's probability times the membership, as
        both must be right; else the cosine. 0 where unknown.
        """
        beyond = {TOO_FAR: Reason.TOO_FAR, UNOBSERVED: Reason.UNOBSERVED, BACKGROUND: Reason.IN_NO_MASK}
        score = self.probability * self.membership
        if not self.calibrated and self.evidence.shape[1]:
            cosine = self.evidence[np.arange(len(self.labels)), np.maximum(self.labels, 0)]
            score = np.where(self.labels == UNKNOWN, 0, cosine)
        return (
            np.append(self.labels, [UNKNOWN] * len(beyond)).astype(np.int32),
            np.append(score, [0] * len(beyond)).astype(np.float32),
            np.append(self.reasons, list(beyond.values())).astype(np.int8),
        )

    def at(self, instances: NDArray[np.integer]) -> tuple[IntArray, FloatArray, NDArray[np.int8]]:
        """Label, score and reason of points, (N,) each, looked up in `by_id` by their instance ids."""
        labels, scores, reasons = self.by_id
        return labels[instances], scores[instances], reasons[instances]  # negative ids index from the end


@dataclass(frozen=True)
class Standard:
    """Numbers that turn the cosines of a scene's R descriptors into evidence, for querying many scenes at once.

    An instance's evidence is the maximum over its descriptors of ``scale * ((descriptor - common) @ direction) +
    shift``, where ``direction`` is the text's unit vector minus the bank's mean, normalized again.
    common: (D,) float32. scale, shift: (R,) float32. sharpness: as `Chooser.sharpness`.
    """

    common: FloatArray
    scale: FloatArray
    shift: FloatArray
    sharpness: float


class Chooser:
    """The instances of one scene, prepared for any number of labels. Cheap to keep, thread-safe."""

    def __init__(
        self,
        instances: InstanceTable,
        bank: WordBank | None = None,
        settings: ChoosingSettings | None = None,
        feature_space: str = UNKNOWN_SPACE,
    ) -> None:
        """feature_space: of the descriptors. FeatureSpaceError if bank and descriptors differ in width."""
        self.settings = settings or ChoosingSettings()
        self.bank = bank
        self._count = len(instances)
        self._membership = ((instances.views + 0.5) / (instances.views + 1)).astype(np.float32)
        self._descriptors = unit_rows(finite_rows(instances.descriptors, "descriptors"))
        self._space = FeatureSpace(feature_space, self._descriptors.shape[1] if len(self._descriptors) else 0)
        self._owner = instances.descriptor_instance
        self._described = np.unique(self._owner)
        if bank is None or len(self._descriptors) == 0:
            return
        self._require_width(bank.vectors, "word bank's vectors")
        # Step 1, center: subtract the words' mean from words, and what all kinds of things share from descriptors.
        self._bank_directions = unit_rows(bank.vectors - bank.mean)
        self._common = common_part(self._descriptors, self._bank_directions, self.settings.sharpness)
        self._centered = self._descriptors - self._common
        # Step 2, standardise: the scores of the bank's words on a descriptor are its null distribution.
        scores = self._centered @ self._bank_directions.T
        self._middle, self._spread = _moments(scores)
        # The best of several descriptors scores higher by chance alone, so instances are standardised once more.
        best = self._best_descriptor((scores - self._middle) / self._spread)
        self._best_middle, self._best_spread = _moments(best)
        self._bank_evidence = (best - self._best_middle) / self._best_spread
        # How far a fitting word stands out in this scene: the upper quartile, over instances, of the bank's best word.
        self.sharpness = float(max(self.settings.sharpness, np.quantile(self._bank_evidence.max(axis=1), 0.75)))

    def standard(self) -> Standard:
        """Steps 1 and 2 as arrays. Only for a scene with a word bank and at least one descriptor."""
        of_instance = np.searchsorted(self._described, self._owner)
        middle, spread = self._best_middle[of_instance], self._best_spread[of_instance]
        # Both standardisations, ((score - middle) / spread - best middle) / best spread, as one scale and one shift.
        scale, shift = 1 / (self._spread * spread), -(self._middle / self._spread + middle) / spread
        columns = scale[:, 0].astype(np.float32), shift[:, 0].astype(np.float32)
        return Standard(self._common, *columns, self.sharpness)

    def choose(self, texts: ArrayLike) -> Choice:
        """The label of each instance.

        texts: (L, D) one text vector per label, of any length, float16 to float64; a zero row fits nothing.
        FeatureSpaceError for NaN or infinity, or another width than the descriptors'.
        """
        texts = finite_rows(texts, "label vectors")
        self._require_width(texts, "label vectors")
        if len(self._descriptors) == 0 or len(texts) == 0:
            return self._nothing(len(texts))
        is_zero = ~texts.any(axis=1)
        if self.bank is None:
            cosines = self._best_descriptor(self._descriptors @ unit_rows(texts).T)
            cosines[:, is_zero] = -np.inf  # 0 would be the largest where all others are negative
            nothing = np.full(cosines.shape, np.nan)
            return self._answer(cosines, nothing, nothing[:, 0])
        directions = unit_rows(unit_rows(texts) - self.bank.mean)
        scores = (self._centered @ directions.T - self._middle) / self._spread
        evidence = (self._best_descriptor(scores) - self._best_middle) / self._best_spread  # like the bank's words
        evidence[:, is_zero] = -np.inf  # a zero row, minus the bank's mean, would point somewhere
        return self._answer(evidence, *self._posterior(evidence, texts, directions))

    def _require_width(self, vectors: NDArray[np.floating], what: str) -> None:
        self._space.require(FeatureSpace(UNKNOWN_SPACE, vectors.shape[1]), what)

    def _best_descriptor(self, scores: NDArray[np.floating]) -> NDArray[np.floating]:
        """(described, ...) best score of each described instance, from the scores of all descriptors (R, ...)."""
        return best_of_rows(scores, np.searchsorted(self._described, self._owner), len(self._described))

    def _posterior(
        self, evidence: NDArray[np.floating], texts: FloatArray, directions: NDArray[np.floating]
    ) -> tuple[DoubleArray, DoubleArray]:
        """Probability of each label and of none, (described, L) and (described,), float64.

        Likelihoods are those of a linear discriminant: a fitting word's evidence is normal about ``sharpness`` with
        deviation 1, any other's about 0, so their ratio is exp(sharpness * evidence - sharpness^2 / 2). ``sharpness``,
        how far fitting words stand out, is measured in the scene (`__init__`).
        """
        sharpness = self.sharpness
        # Logarithms of likelihood times prior; the common factors exp(-sharpness^2 / 2) and prior of one kind cancel.
        # Labels with the same vector are one hypothesis: two spellings of a word do not double its prior.
        hypothesis, first = _distinct(texts)
        log_words = np.log(max(len(first), self.settings.kinds))
        log_label = sharpness * evidence[:, first].astype(np.float64)
        # "None" has the prior of all kinds together, and the mean likelihood of the bank's words other than the labels.
        other = (self._bank_directions @ directions.T).max(axis=1) < self.settings.synonym
        log_none = log_words + log_mean_likelihood(sharpness * self._bank_evidence[:, other].astype(float), sharpness)
        # The largest exponent is subtracted before exp, which would overflow beyond 709.
        top = np.maximum(log_none, log_label.max(axis=1))
        weight, none = np.exp(log_label - top[:, None]), np.exp(log_none - top)
        total = weight.sum(axis=1) + none
        return (weight / total[:, None])[:, hypothesis], none / total

    def _answer(
        self, evidence: NDArray[np.floating], table: NDArray[np.floating], unknown: NDArray[np.floating]
    ) -> Choice:
        """The choice for all K instances, from arrays (described, ...) of the instances with a descriptor."""
        answer = self._nothing(evidence.shape[1])
        best = (evidence if self.bank is None else table).argmax(axis=1)
        # Not "unknown <= 0.5": without a bank it is NaN, and the best label is the answer.
        fits = ~(unknown > 0.5) & (evidence[np.arange(len(best)), best] > -np.inf)
        rows = self._described
        answer.labels[rows] = np.where(fits, best, UNKNOWN)
        answer.probability[rows] = np.where(fits, table[np.arange(len(best)), best], 0)
        answer.unknown[rows] = unknown
        answer.table[rows] = table
        answer.evidence[rows] = evidence
        answer.reasons[rows] = np.where(fits, Reason.LABELLED, Reason.NONE_FITS)
        return answer

    def _nothing(self, labels: int) -> Choice:
        reasons = np.full(self._count, Reason.NOT_DESCRIBED, np.int8)
        reasons[self._described] = Reason.NONE_FITS
        return Choice(
            labels=np.full(self._count, UNKNOWN, np.int32),
            probability=np.zeros(self._count, np.float32),
            unknown=np.ones(self._count, np.float32),
            table=np.zeros((self._count, labels), np.float32),
            evidence=np.full((self._count, labels), -np.inf, np.float32),
            reasons=reasons,
            membership=self._membership,
            calibrated=self.bank is not None,
        )


def log_mean_likelihood(exponents: DoubleArray, sharpness: ArrayLike) -> DoubleArray:
    """(n,) log of the words' mean likelihood, at least that of a word that fits by chance. exponents: (n, W) sharpness
    times evidence. sharpness: (n,), or one for all."""
    # The mean of exp(sharpness * e) over standard normal evidence e is exp(sharpness^2 / 2).
    by_chance = np.broadcast_to(np.square(sharpness) / 2, len(exponents))
    if exponents.shape[1] == 0:
        return by_chance
    return np.maximum(by_chance, np.logaddexp.reduce(exponents, axis=1) - np.log(exponents.shape[1]))


def common_part(descriptors: FloatArray, bank_directions: FloatArray, sharpness: float) -> FloatArray:
    """(D,) the vector to subtract from each descriptor: the mean over kinds of things, times 1 - 1 / (number of kinds).

    Each kind counts once, so that an object in pieces, or a hall full of chairs, does not make the features of a chair
    look common to all things. Descriptors are of one kind if the same word of the bank fits them best. A descriptor is
    ignored if no word stands out by at least half of what fitting words do: its kind is not known. One kind alone does
    not tell what is shared: nothing is subtracted; for two kinds, half of their mean.
    """
    common, word_number = np.zeros(descriptors.shape[1], np.float32), _distinct(bank_directions)[0]
    # Kinds are found on the raw descriptors, then once more without what those kinds share; further rounds change
    # almost nothing.
    for _ in range(2):
        scores = (descriptors - common) @ bank_directions.T
        middle, spread = _moments(scores)
        kind = word_number[scores.argmax(axis=1)]
        evidence = ((scores - middle) / spread).max(axis=1)
        fits = evidence >= max(sharpness, np.quantile(evidence, 0.75)) / 2
        weight = fits / np.maximum(np.bincount(kind, fits), 1)[kind]  # adds up to one within each kind
        kinds = max(weight.sum(), 1)
        common = ((1 - 1 / kinds) * (weight / kinds) @ descriptors).astype(np.float32)
    return common


def _distinct(texts: FloatArray) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """(T,) index of each text among the distinct ones, and (distinct,) row of the first occurrence of each."""
    # Five digits: the same text gives the same unit vector, whatever the length of the vector given.
    rows = unit_rows(texts)
    rounded = np.round(rows, 5) + 0.0  # -0 becomes 0
    _, first, number = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
    same = _joined(rows[first])
    kept, group = np.unique(same, return_inverse=True)
    earliest = np.full(len(kept), len(rows))
    np.minimum.at(earliest, group.reshape(-1), first)
    return group.reshape(-1)[number.reshape(-1)], earliest


def _joined(rows: NDArray[np.floating]) -> NDArray[np.intp]:
    """(n,) for each unit row (n, D), the index of a row within SAME_TEXT_DISTANCE of it; its own if there is none.

    Rounding alone separates equal vectors where a component lies halfway between two rounded values.
    """
    along = rows @ unit_rows(np.random.default_rng(0).normal(size=rows.shape[1])).astype(rows.dtype)
    order, same = np.argsort(along), np.arange(len(rows))
    # Equal rows are also close along any one direction, where most rows have no close neighbor.
    for step in range(1, len(rows)):
        one, other = order[:-step], order[step:]
        pairs = np.flatnonzero(along[other] - along[one] <= SAME_TEXT_DISTANCE)
        if not len(pairs):
            break
        distance = np.linalg.norm(rows[one[pairs]] - rows[other[pairs]], axis=1)
        for pair in pairs[distance <= SAME_TEXT_DISTANCE]:
            same[same == same[other[pair]]] = same[one[pair]]
    return same


def _moments(scores: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean and standard deviation of each row, as columns; infinity for a row without spread, so its evidence is 0."""
    spread = scores.std(axis=1, keepdims=True)  # 1e-7 is the rounding of a float32 cosine: no spread
    return scores.mean(axis=1, keepdims=True), np.where(spread > 1e-7, spread, np.float32(np.inf))
