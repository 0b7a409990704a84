"""Find things by words in all scenes of an index, best first.

og-pointcloud find atlas "fire extinguisher" --html found.html
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from og_pointcloud.cli import common
from og_pointcloud.cli.common import Parser
from og_pointcloud.errors import OgPointcloudError, coordinate, printable

if TYPE_CHECKING:
    from og_pointcloud.collection.collection import Finding


def add(parser: Parser) -> None:
    option = partial(common.add_option, parser)
    option("atlas", "ATLAS", "file that `index` wrote", type=Path)
    option("words", "WORD", "words or phrases", nargs="+")
    option("--within", "X,Y,Z,X,Y,Z", "two corners of a box, low one first: only instances with their center in it")
    option("--scene", "NAME", "only this scene, or all that match, as 'site3/*' does; repeatable", action="append")
    option("--top", "N", "number of results (default: %(default)s)", type=int, default=20)
    option("--lance", "URI", "search the table that `index --lance` wrote, not memory")
    common.add_output(parser, "--html", endings=(".html", ".htm"), help="also write a page with a picture of each")
    common.add_shared(parser, "--text-features", "--json")


def run(arguments: argparse.Namespace) -> None:
    from og_pointcloud.collection.collection import Collection
    from og_pointcloud.show.findings_page import write_findings

    common.check_at_least("--top", arguments.top, 1)
    if arguments.atlas.suffix == ".ogpc":
        raise OgPointcloudError(
            f"ATLAS is '{arguments.atlas}'; expected what `og-pointcloud index FOLDER -o ATLAS` wrote: one scene is "
            f"asked with og-pointcloud select {arguments.atlas} WORD"
        )
    corners = None if arguments.within is None else common.numbers(arguments.within, "--within", 6)
    collection = Collection(arguments.atlas, lance=arguments.lance)
    findings = collection.find(
        arguments.words,
        within=None if corners is None else (corners[:3], corners[3:]),
        scenes=arguments.scene,
        top=arguments.top,
        text_features=arguments.text_features,
    )
    if arguments.html:
        write_findings(arguments.html, collection, findings, ", ".join(arguments.words))
    for note in findings.not_asked:
        print(f"warning: {printable(note)}", file=sys.stderr)
    if arguments.json:
        common.print_json(findings.to_json())
        return
    if findings:
        common.print_table(("scene", "instance", "word", "score", "center", "size"), list(map(cells, findings)))
        if not (fitting := sum(finding.fits for finding in findings)):
            print("nothing fits: no score is above one half")
        elif fitting < len(findings):
            print(f"{fitting} of these {len(findings)} fit: their scores are above one half")
    else:
        print("nothing was found there: no instance with a feature has its center in the box")
    if not all(finding.calibrated for finding in findings):
        print("without a word bank, a scene's scores say how much better the word fits than other known words do")
    if arguments.html:
        print(f"wrote {arguments.html}")
    if findings and findings[0].fits:  # a word that fits nothing would label all of a scene without a bank
        best, given = findings[0], common.as_given(arguments, "--text-features")
        file = collection.file(best.scene)
        if file.is_file():
            common.print_next("view", file, "--labels", common.as_option([best.word]), *given)
        else:
            print(f"{file} no longer exists: update the index")


def cells(finding: Finding) -> tuple[str, ...]:
    center = " ".join(map(coordinate, finding.center))
    size = " x ".join(f"{value:.3g}" for value in finding.size)
    return finding.scene, str(finding.instance), finding.word, f"{finding.score:.3f}", center, size
