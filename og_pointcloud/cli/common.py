"""What several commands share: the parser, checks of output paths, timing, tables."""

from __future__ import annotations

import argparse
import csv
import io
import json
import math
import os
import re
import shlex
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from textwrap import indent
from typing import TYPE_CHECKING, Any, NoReturn

from og_pointcloud.errors import OgPointcloudError, counted, did_you_mean, printable
from og_pointcloud.journal import Journal

if TYPE_CHECKING:
    from og_pointcloud.cloud import LabelledCloud
    from og_pointcloud.formats.atomic import StrPath
    from og_pointcloud.scene import Points

SHOWN = 12
"""Number of words or instances that a list shows before it ends in dots."""
AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1), "-x": (-1, 0, 0), "-y": (0, -1, 0), "-z": (0, 0, -1)}
LONGEST_CELL, LONGEST_NOTE = 60, 1000
"""Characters shown of a name in a table or list, and of a note."""


class Parser(argparse.ArgumentParser):
    """An argparse parser whose errors are one line, like every other error of the program."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        # Abbreviations would make `--mask` mean one thing today and another once an option is added.
        super().__init__(*args, allow_abbrev=False, formatter_class=argparse.RawDescriptionHelpFormatter, **kwargs)
        self.register("action", None, Once)
        self._negative_number_matcher = re.compile(r"-([\d.,][\d.,eE+-]*|[xyz])$")  # -1,2e-5,3 and -z are values
        self._is_intermixing = False

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:  # pyright: ignore
        """Options may stand before an optional positional, where argparse alone would give it nothing."""
        is_plain = all(action.nargs not in ("?", "*") for action in self._get_positional_actions())
        if is_plain or self._is_intermixing:
            return super().parse_known_args(args, namespace)
        self._is_intermixing = True  # argparse calls this method, once for the options and once for the positionals
        try:
            return self.parse_known_intermixed_args(args, namespace)
        finally:
            self._is_intermixing = False

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"error: {message} (see '{self.prog} --help')\n")

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Adds a guess at what was meant."""
        if action.choices is not None and value not in action.choices:
            expected = f"expected {', '.join(map(str, action.choices))}{did_you_mean(str(value), action.choices)}"
            raise argparse.ArgumentError(action, f"{printable(str(value), LONGEST_CELL)!r} is unknown; {expected}")


class Once(argparse.Action):
    """The default action of options: refuses a second value, where argparse would silently take the last."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        given = vars(namespace).setdefault("given", set())
        if option_string and self.dest in given:
            example = f": {option_string} {self.metavar}" if self.metavar else ""
            parser.error(f"{option_string} is given twice; expected once{example}")
        given.add(self.dest)
        setattr(namespace, self.dest, values)


SHARED: dict[str, dict[str, Any]] = {
    "capture": {"type": Path, "metavar": "CAPTURE", "help": "folder with images and poses"},
    "bundle": {"type": Path, "metavar": "S.ogpc", "help": "file that `fit` wrote"},
    "--labels": {"metavar": "A,B,C", "help": 'names to choose from; "a, b" is one name (default: all known)'},
    "--text-features": {
        "type": Path, "metavar": "F.npz",
        "help": "names with vectors from the scene's encoder (default: the scene's own words)",
    },
    "--gaussians": {"type": Path, "metavar": "F.ply", "help": "geometry to use instead of the capture's own"},
    "--cloud": {"type": Path, "metavar": "CLOUD", "help": "another cloud or splat of the place (default: the scene's)"},
    "--up": {"metavar": "AXIS", "help": "up direction: x, y, z, -x, -y, -z or X,Y,Z (z by default in pictures)"},
    "--frame": {"default": "map", "metavar": "F", "help": "name of the map's frame in tf (default: %(default)s)"},
    "--json": {"action": "store_true", "help": "print the result as JSON"},
}  # fmt: skip
"""Options that mean the same in several commands."""


def add_command(commands: Any, name: str, run: Any, text: str | None) -> Parser:
    """text: one line on what the command does, an empty line, and an example."""
    summary, _, example = (text or "").strip().partition("\n\n")
    example = "example:\n" + indent(example.strip(), "  ")
    parser = commands.add_parser(name, help=summary, description=summary, epilog=example)
    parser.set_defaults(run=run, parser=parser)
    return parser


def add_commands(parser: Parser, what: str, *runs: Callable[[argparse.Namespace], None]) -> list[Parser]:
    """A subcommand for each ``run_NAME``, whose docstring is its text. what: the name of the choice among them."""
    below = parser.add_subparsers(dest=what, required=True, metavar=what.upper(), parser_class=Parser)
    return [add_command(below, run.__name__.removeprefix("run_"), run, run.__doc__) for run in runs]


def add_shared(parser: Any, *names: str) -> None:
    for name in names:
        parser.add_argument(name, **SHARED[name])


def add_option(parser: Any, name: str, metavar: str | None, help: str, **settings: Any) -> None:
    """An option or positional argument with values."""
    parser.add_argument(name, metavar=metavar, help=help, **settings)


def add_output(parser: Any, *flags: str, endings: Sequence[str], help: str, **settings: Any) -> None:
    """An option for a file to write, which `check_outputs` checks before the command runs."""
    settings = {"metavar": f"OUT{endings[0]}", **settings}
    parser.add_argument(*flags, type=Path, help=help, **settings).endings = endings


def replaceable(text: str) -> Path:
    """Type of an input path that an output may replace or lie in (`check_outputs` protects inputs of type Path)."""
    return Path(text)


def check_outputs(arguments: argparse.Namespace) -> None:
    """Refuse, before any work, an output that cannot be written or that would replace an input.

    Options of `add_output` are outputs, all other options of type Path inputs.
    """
    actions = [(action, getattr(arguments, action.dest)) for action in arguments.parser._actions if action.type is Path]
    # Outputs have their endings attached (`add_output`); an input may be several paths.
    values = [value if isinstance(value, list) else [value] for action, value in actions if not outputs_of(action)]
    inputs = [path for several in values for path in several if isinstance(path, Path)]
    taken: dict[Path, str] = {}
    for action, path in actions:
        if path is None or not (endings := outputs_of(action)):
            continue
        option = action.option_strings[0]
        if path.suffix not in endings and "" not in endings:  # "": a folder, of any name
            raise OgPointcloudError(f"{option} is '{path}'; expected a name that ends in {' or '.join(endings)}")
        is_folder = "" in endings and path.suffix not in filter(None, endings)
        check_output(option, path, inputs, is_folder=is_folder)
        if path.resolve() in taken:
            raise OgPointcloudError(f"{taken[path.resolve()]} and {option} are both '{path}'; expected different names")
        taken[path.resolve()] = option


def outputs_of(action: argparse.Action) -> Sequence[str]:
    """The endings that an option's file may have; none if it is not an output."""
    return getattr(action, "endings", ())


def check_output(option: str, path: Path, inputs: Sequence[Path], *, is_folder: bool = False) -> None:
    """Refuse a folder, unless one is to be written (is_folder), an input, an existing file in an input folder (except
    .ogpc files, which are not part of a capture), and a path that cannot be written."""
    resolved, sources = path.resolve(), [source.resolve() for source in inputs]
    if path.is_dir() and not is_folder:
        raise OgPointcloudError(f"{option} is '{path}', which is a folder; expected a file name")
    in_folder = any(source in resolved.parents for source in sources) and path.exists() and path.suffix != ".ogpc"
    if resolved in sources or in_folder:
        raise OgPointcloudError(f"{option} is '{path}', which is an input; expected another name: inputs are kept")
    existing = next(parent for parent in resolved.parents if parent.exists())
    if not existing.is_dir() or not os.access(existing, os.W_OK):
        raise OgPointcloudError(f"{option} is '{path}', but '{existing}' is not a folder that can be written to")


def print_result(arguments: argparse.Namespace, result: Mapping[str, Any], show: Callable[[Any], None]) -> None:
    """Print a result as JSON where --json was given, else by ``show``."""
    if arguments.json:
        print_json(json.dumps(result, indent=2, ensure_ascii=False))
    else:
        show(result)


def print_json(text: str) -> None:
    """Print readable JSON; only characters that a terminal would act on are escaped, in JSON's way."""
    print("".join(sign if sign.isprintable() or sign == "\n" else json.dumps(sign)[1:-1] for sign in text.rstrip()))


def print_next(*words: object, hint: str = "") -> None:
    """End the output with a command to type next."""
    print(f"next: {hint}{shlex.join(['og-pointcloud', *map(str, words)])}")


def as_given(arguments: argparse.Namespace, *options: str) -> list[str]:
    """The options among these that were given, with their values, for typing them again."""
    values = {option: getattr(arguments, option.removeprefix("--").replace("-", "_")) for option in options}
    return [str(word) for option, value in values.items() if value is not None for word in (option, value)]


def check_at_least(option: str, value: float | None, least: float) -> None:
    if value is not None and not value >= least:
        raise OgPointcloudError(f"{option} is {value}; expected at least {least}")


def describe_fit(cloud: LabelledCloud, capture: Path, bundle: Path) -> dict[str, Any]:
    """What ``fit --json`` writes: counts, the file, and the provenance (stages, settings, what was left out)."""
    from og_pointcloud.cloud import BACKGROUND, UNOBSERVED

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
        "calibrated": cloud.word_bank is not None,
        "reliability": cloud.reliability,
        "seconds": round(sum(stage["seconds"] for stage in cloud.provenance["stages"]), 3),
        **cloud.provenance,
    }


def print_fit(report: Mapping[str, Any], cloud: LabelledCloud) -> None:
    """Print the summary of a fit; it ends with a next command that works as printed."""
    from og_pointcloud.bundle.vocabulary import carried_encoder
    from og_pointcloud.text.encoder import find_encoder

    print_provenance(cloud.provenance, report["capture"])
    if (seconds := cloud.provenance["notes"].get("compiling", 0)) > 1:
        print(f"compiling took {seconds:.0f} s of this, which later fits do not need")
    total = report["points"]
    shares = [report[f"points_{state}"] / total for state in ("in_instances", "background", "unobserved")]
    print(
        f"{counted(total, 'point')}: {shares[0]:.1%} in {counted(report['instances'], 'instance')}, "
        f"{shares[1]:.1%} background, {shares[2]:.1%} unobserved"
    )
    if report["reliability"] is not None:
        print(f"reliability {report['reliability']:.2f}: how well half of the views reproduce the labels, 0 to 1")
    print(f"wrote {report['output']} ({report['bytes'] / 1e6:.1f} MB)")
    if not report["calibrated"]:
        print(f"no word bank: scores will be cosines. {calibration_hint(report['output'])}")
    output = report["output"]
    if cloud.vocabulary or find_encoder(cloud.feature_space, carried_encoder(output)):
        labels = likely_words(cloud) if cloud.vocabulary else ("chair", "table")
        print_next("segment", output, "--labels", as_option(labels), "-o", labels_file(output))
    else:
        print("no words are known yet: give segment --text-features, or run export text for the masks' encoder")
        print_next("instances", output)


def likely_words(cloud: LabelledCloud) -> list[str]:
    """Two words that best fit the largest instances of a cloud with a vocabulary, or its first two. Words that fit
    nothing, as in the list of a data set, would label everything where there is no word bank."""
    from og_pointcloud.ask.labelled_scene import LabelledScene

    largest = LabelledScene.from_cloud(cloud).instances.largest()
    best = dict.fromkeys(row.words[0][0] for row in largest if row.points and row.words)
    return list(best)[:2] or list(cloud.vocabulary.names[:2] if cloud.vocabulary else ())


@contextmanager
def interruptible() -> Iterator[None]:
    """Ctrl-C raises KeyboardInterrupt even in compiled code, where numba makes a chain of SystemErrors of it."""
    try:
        yield
    except SystemError as error:
        cause: BaseException | None = error
        while isinstance(cause, SystemError):
            cause = cause.__cause__
        if isinstance(cause, KeyboardInterrupt):
            raise cause from None
        raise


def write_fit(
    cloud: LabelledCloud, journal: Journal, output: Path, text_encoder: StrPath | None = None
) -> LabelledCloud:
    """Write the .ogpc file; returns the cloud with the journal's stages and the writing stage added to its provenance.

    text_encoder: as for ``write_bundle``. OgPointcloudError if the file cannot be written; it says where the cloud was
    saved instead.
    """
    from og_pointcloud_export import write_bundle

    from og_pointcloud.fitting.memory import scratch_root

    stages = [*cloud.provenance.get("stages", []), *journal.stages]
    cloud = replace(cloud, provenance={**cloud.provenance, "stages": stages})
    with Journal(False, stages).stage("write file"):
        try:
            write_bundle(cloud, output, text_encoder=text_encoder)
        except OSError as error:
            # A fit may have taken hours: it is saved where there is room, if anywhere.
            kept = Path(tempfile.mkdtemp(prefix="og-pointcloud-", dir=scratch_root())) / output.name
            try:
                write_bundle(cloud, kept, text_encoder=text_encoder)
            except OSError:
                kept.parent.rmdir()
                raise error from None
            raise OgPointcloudError(
                f"'{output}' cannot be written ({error.strerror}): the fit was saved as '{kept}': move it to where "
                "there is room"
            ) from error
    return cloud


def print_checks(checks: Sequence[Mapping[str, str]], capture: Path | str) -> None:
    """Print the passed checks in one line, the unchecked in another, and each doubt with the command to try."""
    for verdict, word in (("ok", "checked"), ("unchecked", "unchecked")):
        names = [check["name"] for check in checks if check["verdict"] == verdict]
        if names:
            print(printable(f"{word}: {', '.join(names)}", LONGEST_NOTE))
    for check in checks:
        if check["verdict"] == "doubt":
            print(printable(f"doubt: {check['name']}: {check['says']}", LONGEST_NOTE))
            if repair := check.get("repair"):
                line = shlex.join(["og-pointcloud", "repair", str(capture), *repair.split()])
                print(printable(f"try: {line}", LONGEST_NOTE))


def warn_of_poses(capture: Path, points: Points | None = None) -> None:
    """Warn of inconsistencies in a capture, ignoring its masks. points: those that the poses must fit; None: the
    capture's, if it has any."""
    from og_pointcloud.checking.check import check_capture, warn_of_doubts
    from og_pointcloud.formats.capture import read_photographed

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the command itself reports what is missing
        scene = read_photographed(capture, points)
    if scene is not None:
        warn_of_doubts(check_capture(scene), shlex.quote(str(capture)))


def direction(text: str | None) -> tuple[float, float, float] | None:
    """The unit vector given by --up; None if it is not given."""
    if text is None or text in AXES:
        return AXES[text] if text else None
    try:
        x, y, z = map(float, text.split(","))
    except ValueError:
        x = y = z = math.nan
    length = math.hypot(x, y, z)
    if not 0 < length < math.inf:
        raise OgPointcloudError(f"--up is '{text}'; expected {', '.join(AXES)} or a direction such as 0,0.1,1")
    return x / length, y / length, z / length


def names_in(text: str | None) -> list[str] | None:
    """The names in an option like A,B,C; None if it is not given. A name with a comma is in double quotes."""
    if text is None:
        return None
    rows = csv.reader(text.splitlines(), skipinitialspace=True)
    return [name.strip() for row in rows for name in row if name.strip()]


def as_option(names: Sequence[str]) -> str:
    """The text that `names_in` parses into these names."""
    line = io.StringIO()
    csv.writer(line, lineterminator="").writerow(names)
    return line.getvalue()


def numbers(text: str, option: str, count: int) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count:
        raise OgPointcloudError(f"{option} is '{text}'; expected {count} numbers separated by commas")
    return values


def some_of(words: Sequence[str]) -> str:
    return ", ".join(printable(word, LONGEST_CELL) for word in words[:SHOWN]) + (", ..." if len(words) > SHOWN else "")


def labels_file(bundle: Path | str) -> Path:
    """Suggested file for labels: never S.ply, which may be the cloud that was fitted."""
    return Path(bundle).with_name(f"{Path(bundle).stem}_labels.ply")


def calibration_hint(bundle: Path | str) -> str:
    """How a file without a word bank gets one."""
    command = shlex.join(["og-pointcloud", "vocabulary", "bank", str(bundle)])
    return f"For probabilities, and 'unknown' where no label fits: {command} [WORDS.npz]"


def print_provenance(provenance: Mapping[str, Any], capture: Path | str = "CAPTURE") -> None:
    stages = provenance.get("stages", [])
    if stages:
        rows = [(stage["name"], f"{stage['seconds']:.2f}") for stage in stages]
        print_table(("stage", "seconds"), [*rows, ("total", f"{sum(stage['seconds'] for stage in stages):.2f}")])
    for entry in provenance.get("left_out", []):
        print(printable(f"left out: {entry['what']}: {entry['why']}", LONGEST_NOTE))
    for text in provenance.get("warnings", []):
        print(printable(f"warning: {text}", LONGEST_NOTE))
    print_checks(provenance.get("checks", []), capture)


def print_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table: the first column left-aligned, the others right-aligned."""
    rows = [[printable(cell, LONGEST_CELL) for cell in row] for row in rows]
    widths = [max(len(row[column]) for row in [header, *rows]) for column in range(len(header))]
    for row in [header, *rows]:
        first, *others = (cell.rjust(width) for cell, width in zip(row, widths, strict=True))
        print("  ".join([first.strip().ljust(widths[0]), *others]))


def print_shares(counts: Mapping[str, int], unknown: int, unknown_because: Mapping[Any, int]) -> None:
    """Print points and share of each label found and of "unknown", and why points are unknown."""
    total = max(sum(counts.values()) + unknown, 1)
    present = [(name, count) for name, count in counts.items() if count]
    rows = [(name, f"{count:,}", f"{count / total:.1%}") for name, count in [*present, ("unknown", unknown)]]
    print_table(("label", "points", "share"), rows)
    if unknown_because:
        print(f"unknown: {', '.join(f'{count:,} {reason}' for reason, count in unknown_because.items())}")
