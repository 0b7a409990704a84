"""Stiff and extreme cases that any change is held against: ``og-pointcloud check``.

A family a file: geometry, frames, masks, features, learning, text, files. Each case is a function that makes its input;
case.py says how it is judged, reference.py and naive.py hold what it is compared with, report.py makes table and
picture of the rows. The test suite runs the quick part.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Sequence

from hard_cases import features, files, frames, geometry, learning, masks, text
from hard_cases.case import CASES, Case, Row, run_case
from og_pointcloud.errors import OgPointcloudError

__all__ = ["FAMILIES", "Case", "Row", "find_cases", "run_catalogue"]

FAMILIES = tuple(
    module.__name__.rpartition(".")[2] for module in (geometry, frames, masks, features, learning, text, files)
)


def find_cases(only: Sequence[str] = (), *, quick: bool = False) -> list[Case]:
    """The cases of these names and families, all without any; quick: those of the test suite's part.

    OgPointcloudError for a word that is neither a case nor a family.
    """
    known = {case.name for case in CASES}.union(FAMILIES)
    for word in only:
        if word not in known:
            close = difflib.get_close_matches(word, known, n=3)
            hint = f"; did you mean {' or '.join(repr(match) for match in close)}?" if close else ""
            raise OgPointcloudError(f"'{word}' is no case; expected one or a family ({', '.join(FAMILIES)}){hint}")
    wanted = [case for family in FAMILIES for case in CASES if case.family == family]
    return [
        case for case in wanted if (not only or case.name in only or case.family in only) and not (quick and case.slow)
    ]


def run_catalogue(
    cases: Sequence[Case] | None = None, *, quick: bool = False, progress: Callable[[Case], None] | None = None
) -> list[Row]:
    """The rows of these cases, or of all, in their order. quick: three values of each condition, and no slow case where
    none is named. progress: called before each case."""
    rows = []
    for case in find_cases(quick=quick) if cases is None else cases:
        if progress:
            progress(case)
        rows += run_case(case, quick=quick)
    return rows
