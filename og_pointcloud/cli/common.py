"""What several commands share: the parser, checks of output paths, timing, tables."""

from __future__ import annotations

import argparse
import difflib
import json
import os
import shlex
import time
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from og_pointcloud.errors import MissingExtraError, OgPointcloudError

if TYPE_CHECKING:
    from og_pointcloud.cloud import LabelledCloud

SHOWN = 12
"""Words, and instances, that a list shows before it ends in dots."""


class Parser(argparse.ArgumentParser):
    """An argparse parser whose errors are one line, like every other error of the program."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        # Abbreviations would make `--mask` mean one thing today and another once an option is added.
        super().__init__(*args, allow_abbrev=False, formatter_class=argparse.RawDescriptionHelpFormatter, **kwargs)

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"error: {message} ('{self.prog} --help' explains)\n")


def add_command(commands: Any, name: str, run: Any, summary: str, example: str) -> Parser:
    parser = commands.add_parser(name, help=summary, description=summary, epilog=f"example:\n  {example}")
    parser.set_defaults(run=run, parser=parser)
    return parser


def did_you_mean(word: str, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(word, list(known), n=3)
    return f"; did you mean {' or '.join(repr(match) for match in close)}?" if close else ""


def check_outputs(outputs: Mapping[str, tuple[Path | None, Sequence[str]]], inputs: Iterable[Path | None]) -> None:
    """Refuse, before any work, an output that cannot be written or that would replace an input.

    outputs: option -> (path or None, the endings it may have).
    """
    sources = [path.resolve() for path in inputs if path]
    taken: dict[Path, str] = {}
    for option, (path, endings) in outputs.items():
        if path is None:
            continue
        resolved = path.resolve()
        if path.suffix not in endings:
            raise OgPointcloudError(f"{option} is '{path}'; expected a name that ends in {' or '.join(endings)}")
        if path.is_dir():
            raise OgPointcloudError(f"{option} is '{path}', which is a folder; expected a file name")
        if replaces_input(resolved, sources):
            raise OgPointcloudError(
                f"{option} is '{path}', a file that is read; expected another name, so that it stays"
            )
        if resolved in taken:
            raise OgPointcloudError(f"{taken[resolved]} and {option} are both '{path}'; expected two names")
        taken[resolved] = option
        existing = next(parent for parent in resolved.parents if parent.exists())
        if not existing.is_dir() or not os.access(existing, os.W_OK):
            raise OgPointcloudError(f"{option} is '{path}', but '{existing}' is not a folder that can be written to")


def replaces_input(path: Path, sources: Sequence[Path]) -> bool:
    """Also true for what lies in a capture folder already, except a .ogpc, which is never an input of fit."""
    in_capture = any(source in path.parents for source in sources) and path.exists() and path.suffix != ".ogpc"
    return path in sources or in_capture


def write_json(path: Path, value: Mapping[str, Any]) -> None:
    from og_pointcloud.formats.atomic import replacing

    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file:
        file.write(json.dumps(value, indent=2, ensure_ascii=False).encode() + b"\n")


@contextmanager
def timed(stages: list[dict[str, Any]], name: str) -> Iterator[None]:
    """Append {"name", "seconds"} for what runs inside."""
    start = time.perf_counter()
    yield
    stages.append({"name": name, "seconds": round(time.perf_counter() - start, 4)})


def require_room() -> None:
    # The room's modules import these as they please: whoever lacks one needs the whole extra.
    for module in ("numba", "scipy", "cv2", "onnx", "open3d", "pyvista"):
        if find_spec(module) is None:
            raise MissingExtraError(module, "demo")


def describe_fit(cloud: LabelledCloud, capture: Path, bundle: Path) -> dict[str, Any]:
    """What ``fit --json`` writes: counts, the file, and the provenance (stages, settings, what was left out)."""
    from og_pointcloud.bundle.format import BANK
    from og_pointcloud.cloud import BACKGROUND, UNOBSERVED

    with zipfile.ZipFile(bundle) as archive:  # writing may have found a word bank
        calibrated = BANK in archive.namelist()
    ids = cloud.instance_ids
    return {
        "capture": str(capture),
        "output": str(bundle),
        "bytes": bundle.stat().st_size,
        "points": len(cloud),
        "instances": len(cloud.instances),
        "points_in_instances": int((ids >= 0).sum()),
        "points_background": int((ids == BACKGROUND).sum()),
        "points_unobserved": int((ids == UNOBSERVED).sum()),
        "feature_space": cloud.feature_space,
        "vocabulary": len(cloud.vocabulary.names) if cloud.vocabulary else 0,
        "calibrated": calibrated,
        "seconds": round(sum(stage["seconds"] for stage in cloud.provenance["stages"]), 3),
        **cloud.provenance,
    }


def print_fit(report: Mapping[str, Any], cloud: LabelledCloud) -> None:
    """What ``fit`` closes with; ends in the next command."""
    print_provenance(cloud.provenance)
    total = report["points"]
    shares = [report[f"points_{state}"] / total for state in ("in_instances", "background", "unobserved")]
    print(
        f"{total:,} points: {shares[0]:.1%} in {report['instances']} instances, {shares[1]:.1%} background, "
        f"{shares[2]:.1%} unobserved"
    )
    print(f"wrote {report['output']} ({report['bytes'] / 1e6:.1f} MB)")
    if not report["calibrated"]:
        print(f"no word bank: scores will be cosines. {calibration_hint(report['output'])}")
    print(f"next: {next_segment_command(report['output'], cloud)}")


def next_segment_command(bundle: str, cloud: LabelledCloud) -> str:
    """A segment command that works as it stands, or names what it still needs."""
    from og_pointcloud.bundle.vocabulary import carried_encoder
    from og_pointcloud.text.encoder import find_encoder

    command = ["og-pointcloud", "segment", bundle]
    if cloud.vocabulary and cloud.vocabulary.names:
        labels = ["--labels", ",".join(cloud.vocabulary.names[:2])]
    elif find_encoder(cloud.feature_space, carried_encoder(bundle)):
        labels = ["--labels", "chair,table"]
    else:
        labels = ["--text-features", f"{cloud.feature_space.replace('/', '_')}_names.npz"]
    return shlex.join([*command, *labels, "-o", str(Path(bundle).with_suffix(".ply"))])


def names_in(text: str | None) -> list[str] | None:
    """The names of an option like A,B,C; None where it is not given."""
    return None if text is None else [name.strip() for name in text.split(",") if name.strip()]


def calibration_hint(bundle: Path | str) -> str:
    """How a file without a word bank gets one."""
    command = shlex.join(["og-pointcloud", "vocabulary", "bank", str(bundle)])
    return f"For probabilities, and 'unknown' where no label fits: {command} [WORDS.npz]"


def print_provenance(provenance: Mapping[str, Any]) -> None:
    stages = provenance.get("stages", [])
    if stages:
        rows = [(stage["name"], f"{stage['seconds']:.2f}") for stage in stages]
        print_table(("stage", "seconds"), [*rows, ("total", f"{sum(stage['seconds'] for stage in stages):.2f}")])
    for entry in provenance.get("left_out", []):
        print(f"left out: {entry['what']}: {entry['why']}")
    for text in provenance.get("warnings", []):
        print(f"warning: {text}")


def print_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """The first column to the left, numbers to the right."""
    widths = [max(len(row[column]) for row in [header, *rows]) for column in range(len(header))]
    for row in [header, *rows]:
        first, *others = (cell.rjust(width) for cell, width in zip(row, widths, strict=True))
        print("  ".join([first.strip().ljust(widths[0]), *others]))
