"""What a hard case is, and how it is judged.

A case is a function that builds a hard input and asks the library about it. Its kind says what the answer is compared
with: "float64", numbers of a reference in float64 or wider, to a bound; "exact", labels, ids or counts that are known,
of which none may differ; "refused", one clear error. Whatever else happens, a NaN, a warning of numpy, an exception of
another type, fails the case.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from og_pointcloud.errors import MissingExtraError, OgPointcloudError

__all__ = ["CASES", "Answer", "Case", "Row", "agrees", "largest_error", "powers", "refuses", "run_case"]


@dataclass(frozen=True)
class Answer:
    """ours: what the library says. reference: what is right. naive: computes what a plain float32 implementation says
    (naive.py), where there is one. All of one shape."""

    ours: ArrayLike
    reference: ArrayLike
    naive: Callable[[], ArrayLike] | None = None


@dataclass(frozen=True)
class Case:
    """A named hard case.

    compute: takes one of ``values``, or nothing where there is no condition; its docstring says what the case is.
    condition: what ``values`` are; empty where the case is a single one. bound: largest error that passes.
    refusal: the exact error of a case that must be refused, and what its text must hold: the value seen, the value
    expected, the cure. slow: takes more than a second or so, and is no part of the quick run.
    """

    name: str
    family: str
    compute: Callable[..., Any]
    bound: float = 0.0
    condition: str = ""
    values: tuple[float, ...] = ()
    refusal: tuple[type[OgPointcloudError], tuple[str, str, str]] | None = None
    slow: bool = False

    @property
    def kind(self) -> Literal["float64", "exact", "refused"]:
        """What the answer is compared with."""
        return "refused" if self.refusal else "float64" if self.bound > 0 else "exact"

    @property
    def title(self) -> str:
        """What the case is, in a line."""
        return (self.compute.__doc__ or "").strip().partition("\n")[0]


@dataclass(frozen=True)
class Row:
    """How a case went at one value of its condition.

    error, naive: see `largest_error`; NaN: the answer was not finite, or there was none. Both are None where a case is
    about an error, naive also where there is no naive form. note: why it fails, or the text of the error.
    """

    case: Case = field(repr=False)
    value: float | None
    error: float | None
    naive: float | None
    holds: bool
    note: str = ""


CASES: list[Case] = []
"""All cases, in the order of their families' files."""


def agrees(
    bound: float, condition: str = "", values: Sequence[float] = (), *, slow: bool = False
) -> Callable[[Callable[..., Answer]], Callable[..., Answer]]:
    """A case whose answer differs from the reference by ``bound`` at most, at every value of its condition.
    bound 0: not at all, kind "exact"."""

    def add(compute: Callable[..., Answer]) -> Callable[..., Answer]:
        CASES.append(Case(compute.__name__, _family(compute), compute, bound, condition, tuple(values), slow=slow))
        return compute

    return add


def refuses(
    error: type[OgPointcloudError], seen: str, expected: str, cure: str
) -> Callable[[Callable[[], object]], Callable[[], object]]:
    """A case that raises exactly this error, in one line that holds these three texts."""

    def add(compute: Callable[[], object]) -> Callable[[], object]:
        CASES.append(Case(compute.__name__, _family(compute), compute, refusal=(error, (seen, expected, cure))))
        return compute

    return add


def _family(compute: Callable[..., object]) -> str:
    return compute.__module__.rpartition(".")[2]


def powers(first: int, last: int, step: int = 1) -> tuple[float, ...]:
    """Powers of ten, from 10^first to 10^last."""
    return tuple(float(f"1e{exponent}") for exponent in range(first, last + np.sign(step), step))


def largest_error(value: ArrayLike, reference: ArrayLike) -> float:
    """Largest difference, as a part of the reference's largest magnitude (of 1 where that is 0); of integers and
    truths, the share that differs. NaN where a value is not finite, or the shapes differ."""
    value, reference = np.asarray(value), np.asarray(reference)
    if value.shape != reference.shape:
        return float("nan")
    if reference.dtype.kind != "f":
        return float((value != reference).mean()) if value.size else 0.0
    if not np.isfinite(value).all():
        return float("nan")
    size = np.abs(reference).max(initial=0)
    return float(np.abs(value.astype(np.longdouble) - reference).max(initial=0) / (size if size > 0 else 1))


def run_case(case: Case, *, quick: bool = False) -> list[Row]:
    """A row for every value of the condition, or one. quick: only of the first, the middle and the last value."""
    values = case.values or (None,)
    if quick:
        values = [values[index] for index in sorted({0, len(values) // 2, len(values) - 1})]
    return [(_refusal if case.refusal else _agreement)(case, value) for value in values]


@contextmanager
def _strict_numpy() -> Iterator[None]:
    """Warnings of numpy are errors; what a user is warned of is not."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        warnings.simplefilter("error", RuntimeWarning)
        yield


def _agreement(case: Case, value: float | None) -> Row:
    try:
        with _strict_numpy():
            answer = case.compute() if value is None else case.compute(value)
    except MissingExtraError:
        raise
    except Exception as error:  # whatever a hard case brings about is to be seen in the table
        return Row(case, value, float("nan"), None, False, f"{type(error).__name__}: {error}")
    error, naive = largest_error(answer.ours, answer.reference), None
    if answer.naive is not None:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            naive = largest_error(answer.naive(), answer.reference)
    holds = error <= case.bound
    shapes = f"the answer has shape {np.shape(answer.ours)}, the reference {np.shape(answer.reference)}"
    return Row(case, value, error, naive, holds, "" if holds else f"error {error:.2g} > {case.bound:.2g}; {shapes}")


def _refusal(case: Case, _: float | None) -> Row:
    assert case.refusal is not None
    kind, texts = case.refusal
    try:
        with _strict_numpy():
            case.compute()
    except MissingExtraError:
        raise
    except Exception as error:
        text = str(error)
        missing = [part for part in texts if part not in text]
        note = text
        if type(error) is not kind:
            note = f"{type(error).__name__} instead of {kind.__name__}: {text}"
        elif missing or "\n" in text:
            note = f"the error does not say '{(*missing, 'one line')[0]}': {text}"
        return Row(case, None, None, None, note == text, note)
    return Row(case, None, None, None, False, f"no error; expected {kind.__name__}")
