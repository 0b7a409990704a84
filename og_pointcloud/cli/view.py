"""Write a page of a scene labelled by words, which any browser opens without a network.

og-pointcloud view kitchen.ogpc --labels chair,table --html kitchen.html
"""

from __future__ import annotations

import argparse

import og_pointcloud as og
from og_pointcloud.cli import common
from og_pointcloud.cli.common import Parser
from og_pointcloud.errors import OgPointcloudError, counted
from og_pointcloud.journal import Journal


def add(parser: Parser) -> None:
    common.add_shared(parser, "bundle", "--labels", "--text-features", "--cloud", "--up")
    common.add_output(parser, "--html", endings=(".html", ".htm"), help="the page to write (default: S.html)")
    parser.add_argument("--boxes", action="store_true", help="draw boxes around labelled instances")
    cut = "hide this share of the height, from the top (default: 0)"
    common.add_option(parser, "--cut", "SHARE", cut, type=float, default=0.0)
    parser.add_argument("--instances", action="store_true", help="color by instance")


def run(arguments: argparse.Namespace) -> None:
    if not 0 <= arguments.cut < 1:
        raise OgPointcloudError(f"--cut is {arguments.cut}; expected a share of the height, from 0 to below 1")
    import numpy as np

    from og_pointcloud.cli.segment import describe_segmentation, print_segmentation
    from og_pointcloud.show.page import Look, write_page
    from og_pointcloud.show.viewpoint import are_no_strays, choose_viewpoint

    up = np.array(common.direction(arguments.up or "z"), np.float64)  # fails before the work, if invalid
    journal = Journal(progress=False)
    with journal.stage("load"):
        scene = og.load(arguments.bundle)
        other = og.read_points(arguments.cloud) if arguments.cloud else None
    with journal.stage("segment"):
        asked, labels = scene if other is None else other.xyz_world, common.names_in(arguments.labels)
        words = scene.known_words(labels, arguments.text_features) if arguments.instances else labels
        result = og.segment(asked, words, scene, text_features=arguments.text_features)
    rgb = scene.cloud.rgb if other is None else other.rgb
    shown = np.logical_and.reduce(np.isfinite(result.xyz), axis=1)
    if not shown.any():
        raise OgPointcloudError(f"{arguments.cloud or arguments.bundle} has no points to show; expected at least one")
    shown[shown] = are_no_strays(result.xyz[shown])
    height = result.xyz[shown] @ up  # the view is chosen for the points left by --cut, as when the page opens
    shown[shown] = height <= height.max() - arguments.cut * np.ptp(height)
    view = choose_viewpoint(result.xyz[shown], result.labels[shown] >= 0, up)
    mode = "instances" if arguments.instances else "labels"
    look = Look((arguments.cloud or arguments.bundle).stem, mode, arguments.boxes, arguments.cut)
    page = arguments.html or arguments.bundle.with_suffix(".html")
    if left_out := write_page(page, scene, result, view, look, rgb):
        print(f"left out of the page: {left_out}")
    if result.names:
        print_segmentation(describe_segmentation(result, journal, arguments.bundle, page))
    else:  # --instances, and a scene without words: there are no labels
        share = float((result.instances >= 0).mean())
        print(f"{share:.1%} of {counted(len(result), 'point')} in {counted(len(scene.cloud.instances), 'instance')}")
        print(f"wrote {page}")
    given = common.as_given(arguments, "--text-features", "--up")
    common.print_next("instances", arguments.bundle, *given, hint="what each instance is, and where: ")
