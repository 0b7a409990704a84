"""Every number of the default method on one page: its source, and the zoo's error at half and at twice its value.

A number between 0 and 1 is not doubled beyond 1 but moved halfway to 1. Each value is tried on a few scenes of the
choosing half; the mask table is rebuilt only where the number changes it. Results are kept beside the scenes by a
checksum of the code, so that an interrupted run can continue.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import json
import textwrap
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

import og_pointcloud
from og_pointcloud import settings as records
from og_pointcloud.evaluate.knobs import changed
from og_pointcloud.evaluate.truth import read_truth
from og_pointcloud.fitting.fit import fit_prepared, prepare
from og_pointcloud.formats.atomic import write_file
from og_pointcloud.formats.capture import read_capture
from og_pointcloud.settings import FitSettings
from og_pointcloud_zoo.draws import draw
from og_pointcloud_zoo.make import made_scene
from og_pointcloud_zoo.measure import answered

SCENES = (
    "room-0", "room-noisy-0", "room-sparse-0", "detector-0", "shelf-0", "bin-0", "board-0", "plants-0", "glass-0",
)  # fmt: skip
"""From the choosing half: clean and noisy, dense and sparse, all masked and things only, few views and many."""
SWEPT = ("geometry", "grouping", "membership")
"""Settings records whose numbers all affect labels."""
MODULES: dict[str, tuple[str, tuple[str, ...]]] = {
    "fitting.view_votes.OPENNESS_POWER": ("", ("_relative_exposure",)),
    "fitting.view_reports.HIDDEN_REPORT_PROBABILITY": ("", ("_add_log_likelihood",)),
    "fitting.view_reports.MIN_REPORT_PROBABILITY": ("", ("_with_floor", "_normalize", "_add_log_likelihood")),
    "fitting.view_reports.MAX_INDEPENDENT_VIEWS": ("", ("_add_log_likelihood",)),
    "fitting.view_reports.PRIOR_COUNT": ("", ("_normalize",)),
    "fitting.view_reports.BACKGROUND_LOG_PRIOR": ("", ()),
    "fitting.view_reports.SMOOTHNESS": ("", ("_influences",)),
    "fitting.view_reports.MIN_COLOR_RATIO": ("", ("_influences",)),
    "fitting.view_reports.MAX_INFLUENCE": ("", ("_influences",)),
    "fitting.colors.MAX_COLOR_RATIO": ("table", ()),
    "fitting.colors.SURENESS_POWER": ("", ()),
    "fitting.seen_colors.SEEN_PRIOR": ("table", ("_apply_color_evidence",)),
    "fitting.held_out.MIN_AGREEMENT_GAIN": ("table", ()),
    "rendering.geometry.SPACING_MEDIAN_NEIGHBORS": ("table", ()),
    "rendering.geometry.FLOATER_SPACINGS": ("table", ()),
    "rendering.geometry.FLOATER_SCATTER_SHARE": ("table", ()),
    "fitting.fragments.HIDDEN_BORDER_VIEWS": ("", ()),
    "fitting.fragments.MIN_LOG_RATIO": ("", ()),
    "fitting.fragments.ALIKE_SHARE": ("", ()),
    "fitting.fragments.ALIKE_SHARE_LESS": ("", ()),
    "fitting.looks.MIN_LOOK_MASKS": ("", ()),
    "fitting.mask_edges.MIN_CONTRAST_RATIO": ("table", ()),
    "fitting.mask_edges.MIN_STANDARD_ERRORS": ("table", ()),
    "fitting.association.SAME_KIND_BOUND": ("", ()),
    "fitting.association.DOMINANT_WEIGHT_RATIO": ("", ()),
    "rendering.sightings.MIN_OPENNESS": ("table", ("_trace_openness",)),
    "rendering.sightings.EDGE_PX": ("table", ("_within_masks", "_votes")),
    "rendering.smoothing.NOISE_NEIGHBORS": ("table", ("_smoothed",)),
    "rendering.smoothing.NOISE_BIAS": ("table", ("_smoothed",)),
    "rendering.sightings.RING_SHARE": ("table", ()),
    "rendering.pixel_cells.CELL_PIXELS": ("table", ()),
    "rendering.pixel_cells.MAX_KEPT_SHARE": ("table", ()),
    "rendering.pixel_cells.NEAREST_SHARE": ("table", ()),
}
"""Constants of modules: whether they change the mask table, and the compiled functions that use them."""
TABLE = ("geometry", "membership.gap_sizes", "membership.front_share", "membership.hole_sizes")
"""Settings that the mask table depends on."""
SOURCES: dict[str, tuple[str, ...]] = {
    "the scene chooses": ("geometry.scales",),
    "derived": ("grouping.container_share", "grouping.join_majority"),
    "enough": ("geometry.enough_views", "geometry.held_out_views", "geometry.held_out_points", "grouping.graph_points"),
    "guessed": (
        "geometry.opacity", "geometry.sight_thickness", "geometry.neighbors", "geometry.reach",
        "grouping.witness_share", "grouping.left_out_voice", "grouping.spanning_share",
        "membership.sure_share", "membership.sure_votes", "membership.swallowed_votes", "membership.open_share",
        "membership.possible_share", "membership.possible_openly", "membership.growth_votes", "membership.rate_share",
        "membership.missed_chance", "membership.island_share",
        "membership.gap_sizes", "membership.front_share", "membership.hole_sizes",
        *MODULES,
    ),
}  # fmt: skip
"""Where numbers come from. Enough: more gives the same and takes longer. Guessed: found by trying a few captures."""
SHARP, BETTER, FLAT = 0.02, 0.005, 0.002
"""Changes of the mean error: a number that adds the first is sharp; one that lowers it by more than the second is
better elsewhere; one that moves it by less than the last does not matter here. Choosing the point size on another
sample of points, no better or worse, lowers it by nearly the second."""


@dataclass(frozen=True)
class Constant:
    """path: of the setting, or of the module's constant within og_pointcloud. value: the current one. meaning: its
    documentation. source: one of SOURCES."""

    path: str
    value: Any
    meaning: str
    source: str

    @property
    def of_module(self) -> bool:
        """Whether it is a constant of a module rather than a setting."""
        return self.path.split(".")[-1].isupper()

    @property
    def in_table(self) -> bool:
        """Whether the mask table depends on it."""
        return bool(MODULES[self.path][0]) if self.of_module else self.path.startswith(TABLE)

    @property
    def values(self) -> tuple[Any, Any]:
        """Half of it and twice it."""
        return _half(self.value), _twice(self.value)


@dataclass(frozen=True)
class Tried:
    """Error, 1 - mIoU, of each of SCENES: at the current value, at half and at twice of it."""

    constant: Constant
    default: tuple[float, ...]
    half: tuple[float, ...]
    twice: tuple[float, ...]

    def change(self, errors: tuple[float, ...]) -> float:
        """Change of the mean error."""
        return float(np.mean(errors) - np.mean(self.default))

    @property
    def verdict(self) -> str:
        """Whether it is sharp, does not matter, or would be better at another value."""
        changes = self.change(self.half), self.change(self.twice)
        if max(map(abs, changes)) < FLAT:
            return "does not matter here"
        better = [name for name, change in zip(("half", "twice"), changes, strict=True) if change < -BETTER]
        parts = ["sharp"] * (max(changes) >= SHARP) + [f"better at {name}" for name in better]
        return ", ".join(parts)


def constants() -> list[Constant]:
    """All of the default method, with their documentation; the source is "not said" where SOURCES has none."""
    default, meanings = FitSettings(), _meanings(inspect.getsource(records))
    found = []
    for owner in SWEPT:
        record = getattr(default, owner)
        for name in (field.name for field in fields(record)):
            found.append(_constant(f"{owner}.{name}", getattr(record, name), meanings[type(record).__name__, name]))
    for path in MODULES:
        module, name = _module(path)
        found.append(_constant(path, getattr(module, name), _meanings(inspect.getsource(module))["", name]))
    return found


def _constant(path: str, value: Any, meaning: str) -> Constant:
    source = next((source for source, paths in SOURCES.items() if path in paths), "not said")
    return Constant(path, value, " ".join(meaning.split()), source)


def _meanings(source: str) -> dict[tuple[str, str], str]:
    """(class or "", name) -> the string below it; for a name without one, a string that mentions it."""
    found: dict[tuple[str, str], str] = {}
    tree = ast.parse(source)
    classes = [(node.name, node.body) for node in tree.body if isinstance(node, ast.ClassDef)]
    for owner, body in [("", tree.body), *classes]:
        texts = [_text(node) for node in body]
        for node, below in zip(body, [*texts[1:], None], strict=True):
            targets = [node.target] if isinstance(node, ast.AnnAssign) else getattr(node, "targets", [])
            for name in (target.id for target in targets if isinstance(target, ast.Name)):
                found[owner, name] = below or next((text for text in texts if text and name in text), "")
    return found


def _text(node: ast.stmt) -> str | None:
    """The string of a bare string statement; None for any other."""
    value = node.value if isinstance(node, ast.Expr) else None
    return str(value.value) if isinstance(value, ast.Constant) else None


def _half(value: Any) -> Any:
    if isinstance(value, tuple):
        return tuple(_half(part) for part in value)
    return max(1, value // 2) if isinstance(value, int) else value / 2


def _twice(value: Any) -> Any:
    if isinstance(value, tuple):
        return tuple(_twice(part) for part in value)
    return (1 + value) / 2 if isinstance(value, float) and 0.5 <= value < 1 else 2 * value


def tried(chosen: Sequence[Constant], output: Path) -> Iterator[Tried]:
    """The errors of each constant, scenes and results under ``output``; known results are not measured again."""
    folders = [made_scene(draw(name), output / "scenes") for name in SCENES]
    kept = output / f"constants-{_checksum():08x}"
    bench = _Bench(folders)
    for constant in chosen:
        errors = {}
        for name, value in (("default", constant.value), *zip(("half", "twice"), constant.values, strict=True)):
            key = "default.json" if name == "default" else f"{constant.path}-{name}.json"
            file = kept / key
            if not file.is_file():
                write_file(file, json.dumps(bench.errors(constant, value)).encode())
            errors[name] = tuple(json.loads(file.read_text()))
        yield Tried(constant, **errors)


def _checksum() -> int:
    """Checksum of the code that labels."""
    root, total = Path(og_pointcloud.__file__).parent, 0
    files = [path for folder in ("fitting", "rendering", "ask") for path in (root / folder).rglob("*.py")]
    for path in sorted([*files, root / "settings.py", root / "kernels.py"]):
        total = zlib.crc32(path.read_bytes(), total)
    return total


class _Bench:
    """Scenes with their mask tables at the current values."""

    def __init__(self, folders: Sequence[Path]) -> None:
        self.folders, self._prepared = folders, {}

    def errors(self, constant: Constant, value: Any) -> list[float]:
        """1 - mIoU of each scene with one number changed."""
        settings = FitSettings() if constant.of_module else changed(FitSettings(), constant.path, value)
        anew = constant.in_table and value != constant.value
        with _in_module(constant.path, value) if constant.of_module else nullcontext():
            return [self._error(folder, settings, anew) for folder in self.folders]

    def _error(self, folder: Path, settings: FitSettings, anew: bool) -> float:
        if folder not in self._prepared:
            self._prepared[folder] = prepare(read_capture(folder))
        prepared = prepare(self._prepared[folder].scene, settings) if anew else self._prepared[folder]
        truth = read_truth(folder)
        answer = answered(folder, fit_prepared(prepared, settings), truth)
        return 1 - truth.score(answer.called).miou


def _module(path: str) -> tuple[Any, str]:
    module, _, name = path.rpartition(".")
    return importlib.import_module(f"og_pointcloud.{module}"), name


@contextmanager
def _in_module(path: str, value: Any) -> Iterator[None]:
    """Changes a module's number temporarily; compiled functions that use it are recompiled, without a disk cache."""
    module, name = _module(path)
    before = getattr(module, name)
    try:
        _put(module, name, value, path)
        yield
    finally:
        _put(module, name, before, path)


def _put(module: Any, name: str, value: Any, path: str) -> None:
    from numba.core.caching import NullCache

    # numba freezes a module's numbers into compiled code, which it would load from the disk cache.
    changes = getattr(module, name) != value
    setattr(module, name, value)
    if path.startswith("rendering.sightings."):  # where votes are sampled, and how far away, depends on two numbers
        share, edge = module.RING_SHARE, module.EDGE_PX
        ring = [(edge * np.cos(angle), edge * np.sin(angle)) for angle in np.arange(8) * np.pi / 4]
        module.VOTE_SAMPLES = np.array([(0.0, 0.0, 1 - share), *((x, y, share / len(ring)) for x, y in ring)])
        module.REACH_PX = int(np.ceil(edge))
    for function in MODULES[path][1] if changes else ():
        compiled = getattr(module, function)
        compiled._cache = NullCache()
        compiled.recompile()


def page(results: Sequence[Tried]) -> str:
    """Markdown: the table and its summary; numbers that were not tried come last."""
    default = np.mean(results[0].default) if results else float("nan")
    sharp = [result.constant.path for result in results if result.verdict.startswith("sharp")]
    flat = [result.constant.path for result in results if result.verdict == "does not matter here"]
    names = {result.constant.path for result in results}
    rest = [one for one in constants() if one.path not in names]
    lines = [
        "# Numbers of the default way",
        "",
        f"Printed by `python examples/zoo.py --constants docs/constants.md`. {len(names) + len(rest)} numbers steer "
        f"labels. {len(names)} of them were halved and doubled (shares above a half: moved half of the way to 1) on "
        f"{len(SCENES)} scenes of the zoo's half for choosing, {', '.join(SCENES)}, whose mean error, 1 - mIoU, is "
        f"{default:.4f} as they stand. The columns give what is added to it.",
        "",
        f"Sharp (a change costs {SHARP:g} or more): {_listed(sharp)}.",
        "",
        f"Of no matter to these scenes (less than {FLAT:g} either way): {_listed(flat)}. That is said of these scenes "
        f"alone; and less than {BETTER:g} is no gain, since another sample of points moves as much.",
        "",
        "| number | value | from | half | twice | | what it is |",
        "| --- | ---: | --- | ---: | ---: | --- | --- |",
    ]
    for result in results:
        half, twice = (f"{result.change(errors):+.4f}" for errors in (result.half, result.twice))
        lines.append(_line(result.constant, half, twice, result.verdict))
    lines += [_line(one, "-", "-", "not tried") for one in rest]
    return "\n".join(line if line.startswith("|") else _wrapped(line) for line in lines) + "\n"


def _wrapped(text: str) -> str:
    return textwrap.fill(text, 120, break_long_words=False, break_on_hyphens=False)


def _line(one: Constant, half: str, twice: str, verdict: str) -> str:
    cells = (f"`{one.path}`", _short(one.value), one.source, half, twice, verdict, one.meaning)
    return f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |"


def _listed(paths: Sequence[str]) -> str:
    return ", ".join(f"`{path}`" for path in paths) or "none"


def _short(value: Any) -> str:
    parts = value if isinstance(value, tuple) else (value,)
    return ", ".join(f"{part:,}" if isinstance(part, int) else f"{part:.3g}" for part in parts)
