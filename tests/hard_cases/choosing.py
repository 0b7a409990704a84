"""Labels that are nearly one, one, ten thousand, of any length; a bank with words given twice: probabilities."""

from __future__ import annotations

from dataclasses import replace

import literal
import numpy as np
from numpy.typing import NDArray

from hard_cases.case import Answer, agrees, powers
from hard_cases.inputs import labelled_cloud, unit_rows
from og_pointcloud.ask.choosing import Chooser
from og_pointcloud.cloud import WordBank
from og_pointcloud.settings import ChoosingSettings

WIDTH, KINDS = 64, 12


@agrees(1e-5, "angle between two labels, radians", powers(0, -3, -1))
def nearly_equal_labels(angle: float) -> Answer:
    """Two labels that mean nearly the same share what they have between them."""
    first, other = _labels(2)
    across = other - first * (first @ other)
    across /= np.linalg.norm(across)
    return _probabilities(np.stack([first, np.cos(angle) * first + np.sin(angle) * across]))


@agrees(1e-5)
def equal_labels() -> Answer:
    """Two names of one vector are one hypothesis: each has its probability."""
    return _probabilities(np.tile(_labels(1), (2, 1)))


@agrees(1e-5, "length of the vectors", (1e-30, 1e-10, 1.0, 1e10, 1e30))
def probability_at_any_length(length: float) -> Answer:
    """Probabilities do not depend on how long the labels' vectors are."""
    return _probabilities(_labels(5) * length)


@agrees(1e-5)
def probability_of_one_label() -> Answer:
    """A single label is held against all other kinds of things."""
    return _probabilities(_labels(1))


@agrees(1e-5)
def probability_of_ten_thousand_labels() -> Answer:
    """10,000 labels: probabilities add up to one with "none of these"."""
    return _probabilities(unit_rows(10_000, WIDTH, seed=7).astype(float))


@agrees(1e-5, "copies of each word", (1, 2, 8))
def bank_with_words_given_twice(copies: float) -> Answer:
    """A bank in which every word stands so many times says what it says with each once."""
    return _probabilities(_labels(5), copies=int(copies))


@agrees(1e-5)
def label_among_the_bank() -> Answer:
    """A label that is a word of the bank, and its synonyms there, do not speak against it."""
    return _probabilities(_bank()[:3])


@agrees(1e-5, "descriptors of an instance", (1, 2, 6))
def instances_of_several_looks(descriptors: float) -> Answer:
    """Of several descriptors the best one speaks for an instance, for labels and bank alike."""
    return _probabilities(_labels(5), descriptors=int(descriptors))


def _rows(seed: int, count: int) -> NDArray[np.float64]:
    """Unit rows that share one large direction, as those of real encoders do."""
    rows = unit_rows(count, WIDTH, seed).astype(float) + 1.2 * np.eye(WIDTH)[seed % 2]
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def _bank() -> NDArray[np.float64]:
    return _rows(1, 300)


def _labels(count: int) -> NDArray[np.float64]:
    """Labels of which the first fit an instance."""
    return _rows(3, count) + 0.5 * _rows(2, KINDS)[:count]


def _probabilities(texts: NDArray[np.float64], copies: int = 1, descriptors: int = 1) -> Answer:
    """Of labels and of none, by the library and by the literal form."""
    rows, texts = _rows(2, KINDS).astype(np.float32), texts.astype(np.float32)
    owner = (np.arange(KINDS) // descriptors).astype(np.int32)
    bank, count = _bank().astype(np.float32), KINDS // descriptors
    table = replace(labelled_cloud(instances=count).instances, descriptors=rows, descriptor_instance=owner)
    ours = Chooser(table, WordBank(np.repeat(bank, copies, axis=0))).choose(texts)
    exact = literal.choice(rows, owner.tolist(), texts, bank, ChoosingSettings())
    return Answer(np.c_[ours.table, ours.unknown], np.c_[exact])
