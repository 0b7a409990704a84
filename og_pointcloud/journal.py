"""What a fit did and how long it took: progress while it runs, the cloud's provenance afterwards."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from enum import Enum
from importlib.util import find_spec
from typing import Any, TypeVar

from og_pointcloud.settings import FitSettings

Item = TypeVar("Item")


class LeftOut(Enum):
    """What a fit can leave out: its key in provenance, then what it is and why, with placeholders for numbers."""

    # fmt: off
    COINCIDENT_POINTS = "coincident points", "{count} points", "they lie exactly where another does, and get its label"
    DENSE_POINTS = (
        "points denser than pixels", "{share:.0%} of the points",
        "those within {pixels:g} pixels share the label of their mean",
    )
    SHAPES = (
        "shapes of Gaussians", "scale, rotation and opacity of the Gaussians",
        "visibility is tested along the ray through each center",
    )
    CHOICE_OF_SPLATS = "choice of splats", "choice of scale", "the file has Gaussians"
    CHOICE_OF_SCALE = (
        "choice of scale", "choice of the points' size",
        "too few views can be compared here: points are drawn {scale:g} spacings large",
    )
    CHOICE_IN_PAPER_MODE = (
        "choice of splats, mode paper", "choice of scale",
        "mode paper draws points as large and opaque as trained Gaussians",
    )
    CHOICE_POINTS = (
        "points of the choice of splats", "{share:.0%} of the points in the choice of scale",
        "the rest are enough",
    )
    PIXELS_IN_PAPER_MODE = (
        "pixels, mode paper", "{share:.0%} of the pixels",
        "images of at most {most:,} pixels are rendered: one row and column in {stride} is enough",
    )
    RENDERING = "rendering", "rendering of {count} views", "an interrupted fit kept them in '{folder}'"
    VIEWS = (
        "views", "{count} of {total} views",
        "nearly everything that each of them and its masks show is shown by {enough} other views",
    )
    FINE_POINTS = (
        "points finer than pixels", "{share:.0%} of the points in the images",
        "closer together than {finest_px:g} px, or more than {most:,} in one image: larger points stand in",
    )
    SPANNING_MASKS = (
        "spanning masks", "{count} masks",
        "each covers several things: its points are only known to belong to one of these",
    )
    CONTRADICTED_GROUPS = (
        "contradicted groups", "{count} of {total} groups of masks",
        "views that see their points usually have no such mask, far more often than the proposer's misses explain",
    )
    SECOND_LEVEL = "second level", "the codebook's second level", "no view shows two masks in one coarse cluster"
    WHOLE_FIT = (
        "whole fit", "a fit of all points at once", "{count:,} points need more memory than there is: fitted in tiles",
    )
    VOCABULARY = "vocabulary", "vocabulary", "{reason}"
    WORD_BANK = "word bank", "word bank", "{reason}"
    EMPTY_LEAVES = "empty leaves", "{count} of {total} leaves", "they contain no visible Gaussian"
    FAINT_GAUSSIANS = "faint gaussians", "{count} Gaussians", "opacity below {opacity}: they cannot be seen"
    # fmt: on

    def __init__(self, key: str, what: str, why: str) -> None:
        self.key, self.what, self.why = key, what, why


def left_out_entry(key: LeftOut, **numbers: Any) -> dict[str, Any]:
    """An entry of provenance["left_out"]: ``key``, the sentences ``what`` and ``why``, and the numbers in them.

    >>> left_out_entry(LeftOut.SPANNING_MASKS, count=3)["what"]
    '3 masks'
    """
    return {"key": key.key, "what": key.what.format(**numbers), "why": key.why.format(**numbers), **numbers}


def with_bar(items: Iterable[Item], name: str, total: int, shown: bool) -> Iterable[Item]:
    """The items, with a progress bar if stderr is a terminal and tqdm is installed. The base install, with numpy and
    onnxruntime alone, shows no bar."""
    if not shown or find_spec("tqdm") is None:
        return items
    from tqdm import tqdm

    # disable=None: tqdm checks whether stderr is a terminal.
    return tqdm(items, desc=f"{name:<12}", total=total, leave=False, dynamic_ncols=True, disable=None)


@dataclass
class Journal:
    """Record of a fit: seconds per stage, what it left out and why, warnings, notes. Becomes the cloud's provenance.

    progress: show bars with the remaining time if stderr is a terminal.
    """

    progress: bool
    stages: list[dict[str, Any]] = field(default_factory=list)
    left_out: list[tuple[LeftOut, dict[str, Any]]] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    notes: dict[str, Any] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a stage; several stages of one name add up."""
        start = time.perf_counter()
        yield
        seconds = time.perf_counter() - start
        self.stages.append({"name": name, "seconds": round(seconds, 4)})

    def leave_out(self, key: LeftOut, **numbers: Any) -> None:
        """Record something that this scene did not need or that was not used, with the numbers for its sentences."""
        self.left_out.append((key, numbers))

    def steps(self, items: Sequence[Item], name: str) -> Iterable[Item]:
        """The items, with a progress bar."""
        return with_bar(items, name, len(items), self.progress)

    @contextmanager
    def bars(self) -> Iterator[Callable[[str, int, int, float], None] | None]:
        """A function that advances a bar, called with a stage's name, the step just done, the number of steps and the
        loss. None if no bar is shown. Needs tqdm, of the extra 'fit'."""
        if not self.progress:
            yield None
            return
        from tqdm import tqdm

        begun: set[str] = set()
        with tqdm(leave=False, dynamic_ncols=True, disable=None) as bar:

            def report(name: str, step: int, steps: int, loss: float) -> None:
                if name not in begun:  # one bar, which each stage resets
                    begun.add(name)
                    bar.reset(steps)
                    bar.set_description_str(f"{name:<16}: ", refresh=False)
                bar.set_postfix(loss=f"{loss:.3g}", refresh=False)
                bar.update(step - bar.n)  # a resumed training starts at a later step

            yield report

    def provenance(self, settings: FitSettings) -> dict[str, Any]:
        """The whole record, JSON-able, with the fit's settings."""
        return {
            "settings": asdict(settings),
            "stages": self.stages,
            "left_out": [left_out_entry(key, **numbers) for key, numbers in self.left_out],
            "warnings": self.warnings,
            "notes": self.notes,
        }
