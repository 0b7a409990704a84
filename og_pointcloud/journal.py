"""What a fit did and how long it took: progress while it runs, the cloud's provenance afterwards."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from typing import Any, TypeVar

from og_pointcloud.settings import FitSettings

__all__ = ["Journal"]

Item = TypeVar("Item")


@dataclass
class Journal:
    """What a fit did: seconds per stage, what it left out and why, warnings, notes. Becomes the cloud's provenance.

    progress: show bars with the remaining time where stderr is a terminal.
    """

    progress: bool
    stages: list[dict[str, Any]] = field(default_factory=list)
    left_out: list[dict[str, str]] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    notes: dict[str, Any] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a stage; several stages of one name add up."""
        start = time.perf_counter()
        yield
        seconds = time.perf_counter() - start
        self.stages.append({"name": name, "seconds": round(seconds, 4)})

    def leave_out(self, what: str, why: str) -> None:
        """Note what this scene did not need, or what was not used, and the reason."""
        self.left_out.append({"what": what, "why": why})

    def steps(self, items: Sequence[Item], name: str) -> Iterable[Item]:
        """The items, with a progress bar."""
        if not self.progress:
            return items
        from tqdm import tqdm

        return tqdm(items, desc=f"{name:<12}", leave=False, dynamic_ncols=True, disable=None)

    @contextmanager
    def bars(self) -> Iterator[Callable[[str, int, int], None] | None]:
        """A function to call with a stage's name, the step just done and the number of steps: one bar per stage."""
        if not self.progress:
            yield None
            return
        from tqdm import tqdm

        bars: dict[str, Any] = {}

        def report(name: str, step: int, steps: int) -> None:
            if name not in bars:
                bars[name] = tqdm(total=steps, desc=f"{name:<16}", leave=False, dynamic_ncols=True, disable=None)
            bars[name].update(step - bars[name].n)

        try:
            yield report
        finally:
            for bar in bars.values():
                bar.close()

    def provenance(self, settings: FitSettings) -> dict[str, Any]:
        """All of it, JSON-able, with the settings it was done with."""
        return {
            "settings": asdict(settings),
            "stages": self.stages,
            "left_out": self.left_out,
            "warnings": self.warnings,
            "notes": self.notes,
        }
