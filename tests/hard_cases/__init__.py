"""Stiff and extreme cases that any change is compared with: ``make check``.

A family a file: geometry, frames, masks, votes, features, learning, choosing, text, files. Each case is a function that
makes its input; case.py says how it is judged. tests/literal.py (votes, membership, matching, choosing, losses) and
tests/reference_splatting.py are the float64 references, naive.py the plain float32 forms. The test suite runs the
quick part.
"""

from __future__ import annotations

from collections.abc import Sequence

from hard_cases import choosing, features, files, frames, geometry, learning, masks, text, votes
from hard_cases.case import CASES, Case

__all__ = ["FAMILIES", "find_cases"]

FAMILIES = tuple(
    module.__name__.rpartition(".")[2]
    for module in (geometry, frames, masks, votes, features, learning, choosing, text, files)
)


def find_cases(only: Sequence[str] = (), *, quick: bool = False) -> list[Case]:
    """The cases of these names and families, all without any; quick: without the slow ones. KeyError: no such case."""
    known = {*FAMILIES, *(case.name for case in CASES)}
    if unknown := [word for word in only if word not in known]:
        raise KeyError(f"{unknown[0]!r} is no case; expected one of {', '.join(sorted(known))}")
    wanted = [case for family in FAMILIES for case in CASES if case.family == family]
    return [case for case in wanted if (not only or {case.name, case.family} & set(only)) and not (quick and case.slow)]
