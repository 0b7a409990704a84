"""Look at a scene labelled by words, as a stand-alone page or a picture. Or at a capture's features.

og-pointcloud view kitchen.ogpc --labels chair,table --html kitchen.html
  og-pointcloud view kitchen -o features.png
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import og_pointcloud as og
from og_pointcloud.cli.common import (
    Parser,
    add_option,
    add_output,
    add_shared,
    check_at_least,
    direction,
    names_in,
    warn_of_capture,
)
from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.journal import Journal

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from og_pointcloud.show.viewpoint import Viewpoint

OF_SCENE = ("labels", "text_features", "cloud", "html", "png", "boxes", "up", "cut", "instances")
OF_CAPTURE = ("output", "columns")


def add(parser: Parser) -> None:
    add_option(parser, "source", "S.ogpc|CAPTURE", "what `fit` wrote, or a capture folder", type=Path)
    scene = parser.add_argument_group("a scene (S.ogpc)")
    add_shared(scene, "--labels", "--text-features", "--cloud", "--up")
    page = "a page that any browser opens, without a network (default, without --png: S.html)"
    add_output(scene, "--html", endings=(".html", ".htm"), help=page)
    add_output(scene, "--png", endings=(".png",), help="a picture")
    scene.add_argument("--boxes", action="store_true", help="boxes around what has a label")
    add_option(scene, "--cut", "SHARE", "hide this share of the height, from the top", type=float)
    scene.add_argument("--instances", action="store_true", help="colours by instance")
    capture = parser.add_argument_group("a CAPTURE: features are learned and shown before and after clustering")
    add_output(capture, "-o", "--output", endings=(".png",), help="default: features.png")
    add_option(capture, "--columns", "N", "views shown (default: 4)", type=int)


def run(arguments: argparse.Namespace) -> None:
    is_scene = arguments.source.suffix == ".ogpc"
    for name in OF_CAPTURE if is_scene else OF_SCENE:
        if getattr(arguments, name) not in (None, False):
            kind, other = ("scene (.ogpc)", "capture") if is_scene else ("capture", "scene (.ogpc)")
            option = name.replace("_", "-")
            raise OgPointcloudError(
                f"--{option} is for a {other}, but '{arguments.source}' is a {kind}; of a scene a picture is --png, a "
                "page --html"
            )
    (view_scene if is_scene else view_capture)(arguments)


def view_scene(arguments: argparse.Namespace) -> None:
    check_scene_options(arguments)
    from og_pointcloud.ask.hosts import import_plugin
    from og_pointcloud.cli.segment import describe_segmentation, print_segmentation
    from og_pointcloud.show.page import Look, write_page

    journal = Journal(progress=False)
    with journal.stage("load"):
        scene = og.load(arguments.source)
        other = og.read_points(arguments.cloud) if arguments.cloud else None
    with journal.stage("segment"):
        points = scene if other is None else other.xyz_world
        result = og.segment(points, names_in(arguments.labels), scene, text_features=arguments.text_features)
    rgb = scene.cloud.rgb if other is None else other.rgb
    shown, view = chosen_view(result, arguments)
    mode = "instances" if arguments.instances else "labels"
    look = Look((arguments.cloud or arguments.source).stem, mode, arguments.boxes, arguments.cut or 0.0)
    page = arguments.html or (None if arguments.png else arguments.source.with_suffix(".html"))
    if page and (left_out := write_page(page, scene, result, view, look, rgb)):
        print(f"left out of the page: {left_out}")
    if arguments.png:
        draw = import_plugin("og_pointcloud_pyvista.screening", "pyvista").draw
        arguments.png.parent.mkdir(parents=True, exist_ok=True)
        draw(scene, result, rgb, shown, view, look).screenshot(arguments.png)
    outputs = [path for path in (page, arguments.png) if path]
    print_segmentation(describe_segmentation(result, journal, arguments.source, outputs[0]))
    for path in outputs[1:]:
        print(f"wrote {path}")


def check_scene_options(arguments: argparse.Namespace) -> None:
    if arguments.cut is not None and not 0 <= arguments.cut < 1:
        raise OgPointcloudError(f"--cut is {arguments.cut}; expected a share of the height, from 0 to below 1")
    if arguments.png is None:
        return
    from og_pointcloud.ask.hosts import import_plugin

    if not import_plugin("og_pointcloud_pyvista", "pyvista").can_render():
        raise OgPointcloudError(
            "VTK cannot draw off-screen here, it finds neither EGL nor OSMesa: install one of them (Debian: apt-get "
            "install libegl1, or libosmesa6), or write a page (--html P.html), which needs neither"
        )


def chosen_view(result: og.Segmentation, arguments: argparse.Namespace) -> tuple[NDArray[np.bool_], Viewpoint]:
    """(N,) which points are shown, what --cut hides left out; and where from."""
    import numpy as np

    from og_pointcloud.show.viewpoint import choose_viewpoint

    up = np.array(direction(arguments.up or "z"), np.float64)
    shown = np.logical_and.reduce(np.isfinite(result.xyz), axis=1)
    if not shown.any():
        raise OgPointcloudError(f"{arguments.cloud or arguments.source} has no point to show; expected at least one")
    if arguments.cut:
        height = result.xyz[shown] @ up
        shown[shown] = height <= height.max() - arguments.cut * np.ptp(height)
    return shown, choose_viewpoint(result.xyz[shown], result.labels[shown] >= 0, up)


def view_capture(arguments: argparse.Namespace) -> None:
    check_at_least("--columns", arguments.columns, 1)
    from og_pointcloud.fitting.fit import prepare
    from og_pointcloud.show.fit_pictures import learned_stages

    output = arguments.output or Path("features.png")
    scene = og.read_capture(arguments.source)
    warn_of_capture(scene, arguments.source)
    prepared = prepare(scene, journal=Journal(progress=True))
    surface = prepared.surface
    features = learned_stages(prepared.table, surface.scene.points.xyz)
    og.feature_picture(surface.gaussians, scene.views, surface.near, features, output, arguments.columns or 4)
    print(f"wrote {output}")
