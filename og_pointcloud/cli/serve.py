"""Serve a live page of scenes: type any word, or click an object to identify it. Local unless --host is given.

og-pointcloud serve kitchen.ogpc office.ogpc
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from og_pointcloud.cli.common import Parser, add_option, add_shared, direction, names_in
from og_pointcloud.errors import OgPointcloudError

if TYPE_CHECKING:
    from og_pointcloud.show.live import LiveScene
    from og_pointcloud.text.words import Labels, TextFeatures


def add(parser: Parser) -> None:
    option = partial(add_option, parser)
    option("bundles", "S.ogpc", "file that `fit` wrote; several to choose from", type=Path, nargs="+")
    add_shared(parser, "--labels", "--text-features", "--cloud", "--up")
    option("--before", "A.ogpc", "an earlier visit: show what is gone, new and moved since", type=Path)
    option("--host", "H", "address to listen on; 0.0.0.0 lets others in (default: %(default)s)", default="127.0.0.1")
    option("--port", "N", "port, or the next free one (default: %(default)s)", type=int, default=8080)


def run(arguments: argparse.Namespace) -> None:
    alone = "--cloud" if arguments.cloud else "--before" if arguments.before else None
    if alone and len(arguments.bundles) > 1:
        raise OgPointcloudError(f"{alone} is for one scene, but {len(arguments.bundles)} are given; expected only one")
    if arguments.cloud and arguments.before:
        raise OgPointcloudError("--cloud and --before are both given; expected one: --before shows visits as fitted")
    from og_pointcloud.ask.hosts import import_plugin
    from og_pointcloud.ask.labelled_scene import load
    from og_pointcloud.formats.points import read_points
    from og_pointcloud.show.live import LiveScene

    up = direction(arguments.up or "z")  # fails before the work, if invalid
    served = import_plugin("og_pointcloud.show.serve", "serve")
    shown = read_points(arguments.cloud) if arguments.cloud else None
    labels = names_in(arguments.labels)
    words = labels, arguments.text_features
    if arguments.before:
        scenes = _two_visits(arguments.before, arguments.bundles[0], *words)
    else:
        bundles = titles(arguments.bundles).items()
        scenes = {title: LiveScene(load(path), shown, *words) for title, path in bundles}
    page = served.serve(scenes, served.ServeSettings(arguments.host, arguments.port, up))
    try:
        print(f"{page.url}  (Ctrl-C stops it)", flush=True)
        if page.is_open:
            print(f"anyone who reaches {arguments.host} can see and query these scenes: it has no password", flush=True)
        else:
            print("for this machine only; --host 0.0.0.0 lets others in, without a password", flush=True)
        page.wait()
    except KeyboardInterrupt:  # interrupted before the page waited
        page.stop()


def _two_visits(earlier: Path, later: Path, labels: Labels, text_features: TextFeatures) -> dict[str, LiveScene]:
    from og_pointcloud.ask.labelled_scene import LabelledScene, load
    from og_pointcloud.mapping.changes import compare
    from og_pointcloud.show.changes_page import both_visits
    from og_pointcloud.show.live import LiveScene

    before, after = load(earlier), load(later)
    changes = compare(before, after)
    print(f"since {earlier.stem}: {changes}")
    both, change = both_visits(before.cloud, after.cloud, changes)
    return {later.stem: LiveScene(LabelledScene.from_cloud(both), None, labels, text_features, change)}


def titles(paths: list[Path]) -> dict[str, Path]:
    """The paths by their names, or by full path where two have the same name."""
    stems = [path.stem for path in paths]
    return {path.stem if stems.count(path.stem) == 1 else str(path): path for path in paths}
