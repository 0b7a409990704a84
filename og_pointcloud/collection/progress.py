"""A bar with the remaining time, on a terminal, where tqdm is installed: reading files needs no more than numpy."""

from __future__ import annotations

from collections.abc import Iterable
from importlib.util import find_spec
from typing import TypeVar

__all__ = ["counted"]

Item = TypeVar("Item")


def counted(items: Iterable[Item], name: str, total: int, progress: bool) -> Iterable[Item]:
    """The items, with a bar."""
    if not progress or find_spec("tqdm") is None:
        return items
    from tqdm import tqdm

    return tqdm(items, desc=f"{name:<12}", total=total, dynamic_ncols=True, disable=None)
