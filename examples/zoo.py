"""The zoo: many small scenes of many kinds, half for choosing numbers, half only for judging.

    python examples/zoo.py -o out/zoo                                    # all made scenes
    python examples/zoo.py -o out/zoo --captures CAPTURE [CAPTURE ...]   # and captures with gt.npz, text_features.npz
    python examples/zoo.py -o out/zoo --half choose --set membership.sure_share=0.5 --quick
    python examples/zoo.py -o out/zoo --half judge --worse views=5 poses=2  # from less (og_pointcloud_zoo/worse.py)
    python examples/zoo.py -o out/zoo --only desk room --needs           # from less and less of each, as a table
    python examples/zoo.py -o out/zoo --captures CAPTURE [CAPTURE ...] --only NAME --largest-pieces
    python examples/zoo.py -o out/zoo --constants docs/constants.md      # each number at half and at twice its value

Scenes are made once, in OUT/scenes. Each fit is listed with the best baseline of `og_pointcloud.evaluate.baselines`,
the difference with its 95 % interval over blocks of space, and the fit's own reliability. Writes OUT/zoo.csv and
OUT/zoo.png; --needs writes OUT/needs.csv and OUT/needs.png. A scene's name alone decides which half it is in.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from og_pointcloud_zoo.constants import constants, page, tried
from og_pointcloud_zoo.draws import draw, is_chosen, scene_names
from og_pointcloud_zoo.make import made_scene
from og_pointcloud_zoo.measure import Row, measure, parsed, parsed_settings
from og_pointcloud_zoo.report import HALVES, HEADER, line, needs_table, summary, write_csv, write_needs, write_picture
from og_pointcloud_zoo.worse import LADDER, WAYS

from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.evaluate.sweep import warm_up
from og_pointcloud.formats.atomic import write_file
from og_pointcloud.formats.capture import read_capture


def main(arguments: Sequence[str] | None = None) -> None:
    """Make missing scenes, measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/zoo"), help="folder of scenes and results")
    parser.add_argument("--captures", nargs="+", type=Path, default=[], metavar="CAPTURE", help="more scenes, by path")
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="scenes whose name begins so")
    parser.add_argument("--half", choices=tuple(HALVES), help="only this half")
    parser.add_argument("--set", nargs="+", default=[], metavar="PATH=VALUE", help="settings of the fit")
    parser.add_argument("--worse", nargs="+", default=[], metavar="KIND=AMOUNT", help=f"kinds: {', '.join(WAYS)}")
    pieces = "score each thing at its largest piece: a truth voted by masks also names what is seen past its edges"
    parser.add_argument("--largest-pieces", action="store_true", help=pieces)
    parser.add_argument("--needs", action="store_true", help="each kind by several amounts")
    parser.add_argument("--quick", action="store_true", help="without baselines")
    parser.add_argument("--constants", type=Path, metavar="PAGE", help="write the page of constants (--only: of some)")
    parser.add_argument("--list", action="store_true", help="print the scenes as drawn, and make none")
    options = parser.parse_args(arguments)
    if options.constants:
        _write_constants(options)
        return
    options.captures = [path.absolute() for path in options.captures]  # "." has no name
    paths = [*options.captures, *map(Path, scene_names())]
    chosen = [path for path in paths if is_chosen(path.name, options.half, options.only)]
    if not chosen:
        parser.error(f"no scene begins with {', '.join(options.only)}; expected one of {', '.join(scene_names())}")
    if options.needs and options.worse:
        parser.error("--needs makes scenes worse in its own ways: give it without --worse")
    if options.list:
        print("\n".join(str(draw(path.name)) for path in chosen if path.name in scene_names()))
        return
    try:
        if options.needs:
            _needs(chosen, options)
        else:
            file = options.output / "zoo.csv"
            rows = _rows(chosen, options, parsed(options.worse), file)
            print(f"{summary(rows)}\n\n{file}\n{write_picture(rows, options.output / 'zoo.png')}")
    except OgPointcloudError as error:
        sys.exit(f"zoo: {error}")


def _write_constants(options: argparse.Namespace) -> None:
    from tqdm import tqdm

    chosen = [one for one in constants() if not options.only or one.path.startswith(tuple(options.only))]
    results = list(tqdm(tried(chosen, options.output), "constants", len(chosen), disable=None))
    print(write_file(options.constants, page(results).encode()))


def _needs(paths: Sequence[Path], options: argparse.Namespace) -> None:
    rows, file = [], options.output / "needs.csv"
    for change in ({}, *({kind: amount} for kind, amounts in LADDER.items() for amount in amounts)):
        rows = _rows(paths, options, change, file, rows)
    print(f"\n{needs_table(rows)}\n\n{file}\n{write_needs(rows, options.output / 'needs.png')}")


def _rows(
    paths: Sequence[Path], options: argparse.Namespace, changes: Mapping[str, Any], file: Path, rows: Sequence[Row] = ()
) -> list[Row]:
    """The rows so far and one more for each scene; after each all are written, in case of an interruption."""
    settings, rows = parsed_settings(options.set), list(rows)
    print(HEADER)
    for path in paths:
        folder = path if path in options.captures else made_scene(draw(path.name), options.output / "scenes")
        if not rows:
            warm_up(read_capture(folder))
        rows.append(measure(folder, settings, not options.quick, changes, largest_pieces=options.largest_pieces))
        print(line(rows[-1]), flush=True)
        write_csv(rows, file)
    return rows


if __name__ == "__main__":
    main()
