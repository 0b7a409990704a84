"""Look at a scene labelled by words: a page that any browser opens, or a picture.

og-pointcloud view kitchen.ogpc --labels chair,table --html kitchen.html
"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

import og_pointcloud as og
from og_pointcloud.cli.common import Parser, add_option, add_output, add_shared, direction, names_in
from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.journal import Journal

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from og_pointcloud.show.viewpoint import Viewpoint


def add(parser: Parser) -> None:
    add_shared(parser, "bundle", "--labels", "--text-features", "--cloud", "--up")
    page = "a page that any browser opens, without a network (default, without --png: S.html)"
    add_output(parser, "--html", endings=(".html", ".htm"), help=page)
    add_output(parser, "--png", endings=(".png",), help="a picture")
    parser.add_argument("--boxes", action="store_true", help="boxes around what has a label")
    cut = "hide this share of the height, from the top (default: 0)"
    add_option(parser, "--cut", "SHARE", cut, type=float, default=0.0)
    parser.add_argument("--instances", action="store_true", help="colors by instance")


def run(arguments: argparse.Namespace) -> None:
    check_scene_options(arguments)
    from og_pointcloud.ask.hosts import import_plugin
    from og_pointcloud.cli.segment import describe_segmentation, print_segmentation
    from og_pointcloud.formats.atomic import replacing
    from og_pointcloud.show.findings_page import png_bytes
    from og_pointcloud.show.page import Look, write_page

    journal = Journal(progress=False)
    with journal.stage("load"):
        scene = og.load(arguments.bundle)
        other = og.read_points(arguments.cloud) if arguments.cloud else None
    with journal.stage("segment"):
        points = scene if other is None else other.xyz_world
        result = og.segment(points, names_in(arguments.labels), scene, text_features=arguments.text_features)
    rgb = scene.cloud.rgb if other is None else other.rgb
    shown, view = chosen_view(result, arguments)
    mode = "instances" if arguments.instances else "labels"
    look = Look((arguments.cloud or arguments.bundle).stem, mode, arguments.boxes, arguments.cut)
    page = arguments.html or (None if arguments.png else arguments.bundle.with_suffix(".html"))
    if page and (left_out := write_page(page, scene, result, view, look, rgb)):
        print(f"left out of the page: {left_out}")
    if arguments.png:
        draw = import_plugin("og_pointcloud_pyvista.screening", "pyvista").draw
        picture = draw(scene, result, rgb, shown, view, look).screenshot(return_img=True)
        with replacing(arguments.png) as file:
            file.write(png_bytes(picture))
    outputs = [path for path in (page, arguments.png) if path]
    print_segmentation(describe_segmentation(result, journal, arguments.bundle, outputs[0]))
    for path in outputs[1:]:
        print(f"wrote {path}")


def check_scene_options(arguments: argparse.Namespace) -> None:
    if not 0 <= arguments.cut < 1:
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
        raise OgPointcloudError(f"{arguments.cloud or arguments.bundle} has no point to show; expected at least one")
    if arguments.cut:
        height = result.xyz[shown] @ up
        shown[shown] = height <= height.max() - arguments.cut * np.ptp(height)
    return shown, choose_viewpoint(result.xyz[shown], result.labels[shown] >= 0, up)
