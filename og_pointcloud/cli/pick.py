"""Select the instance at a pixel of a view, or at a position; render its mask.

og-pointcloud pick kitchen.ogpc --capture kitchen --view frame7 --pixel 320,240 -o mask.png
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import og_pointcloud as og
from og_pointcloud.cli import common
from og_pointcloud.cli.common import Parser
from og_pointcloud.errors import OgPointcloudError, coordinate, did_you_mean


def add(parser: Parser) -> None:
    common.add_shared(parser, "bundle", "--text-features", "--json")
    click = parser.add_mutually_exclusive_group(required=True)
    common.add_option(click, "--xyz", "X,Y,Z", "a position in world coordinates")
    common.add_option(click, "--pixel", "U,V", "a pixel of the view, column and row")
    common.add_option(parser, "--capture", "CAPTURE", "capture folder of the view", type=Path)
    common.add_option(parser, "--view", "NAME", "file stem of the view's image")
    common.add_output(parser, "-o", "--output", endings=(".png",), help="the instance's mask in the view")


def run(arguments: argparse.Namespace) -> None:
    from og_pointcloud.formats.images import write_png
    from og_pointcloud.scene import Points

    uses_view = arguments.pixel is not None or arguments.output is not None
    if uses_view and not (arguments.capture and arguments.view):
        raise OgPointcloudError("--pixel and -o need a camera: name it with --capture CAPTURE --view NAME")
    if not uses_view and (arguments.capture or arguments.view):
        given = "--capture" if arguments.capture else "--view"
        raise OgPointcloudError(f"{given} is given, but --xyz alone needs no camera; expected -o MASK.png as well")
    scene = og.load(arguments.bundle)
    camera = world_camera(arguments.capture, arguments.view) if uses_view else None
    # A click is only as good as the camera's pose, which is checked against the fitted cloud.
    if camera is not None:
        common.warn_of_poses(arguments.capture, Points(scene.cloud.xyz, scene.cloud.origin, scene.cloud.rgb))
    if arguments.pixel is not None and camera is not None:
        hit = og.pick(scene, camera, common.numbers(arguments.pixel, "--pixel", 2))
    else:
        hit = og.pick(scene, common.numbers(arguments.xyz, "--xyz", 3))
    known = scene.known_words(None, arguments.text_features)
    words = hit.words(known) if hit.found and known.names else []
    mask = None
    if arguments.output and camera is not None:
        mask = hit.mask(camera)
        write_png(arguments.output, mask.astype("uint8") * 255)
    pixels = None if mask is None else int(mask.sum())
    common.print_result(arguments, describe_pick(hit, words, arguments.output, pixels), print_pick)


def world_camera(capture: Path, name: str) -> og.Camera:
    scene = og.read_capture(capture)
    cameras = {view.name: view.camera for view in scene.views}
    if name not in cameras:
        raise OgPointcloudError(
            f"--view is '{name}', which is not among the {len(cameras)} views of {capture}{did_you_mean(name, cameras)}"
        )
    return og.in_world(cameras[name], scene.points.origin)


def describe_pick(
    hit: og.Pick, words: Sequence[tuple[str, float]], mask: Path | None, mask_pixels: int | None
) -> dict[str, Any]:
    """The output of ``pick --json``: the instance, or why there is none, and where the click hit."""
    return {
        "instance": hit.instance,
        "found": hit.found,
        "what": str(hit),
        "point": hit.point,
        "xyz_world": None if hit.xyz_world is None else hit.xyz_world.tolist(),
        "points": len(hit.point_indices) if hit.found else 0,
        "words": [{"name": name, "score": round(score, 4)} for name, score in words],
        "mask": str(mask) if mask else None,
        "mask_pixels": mask_pixels,
    }


def print_pick(report: Mapping[str, Any]) -> None:
    """Print what was hit and where, the words that fit it best, and the mask's file."""
    print(report["what"])
    if report["xyz_world"]:
        print(f"hit at {', '.join(map(coordinate, report['xyz_world']))} (point {report['point']})")
    if report["words"]:
        best = [f"{word['name']} {word['score']:.2f}" for word in report["words"]]
        print(f"best words: {common.some_of(best)}")
    if report["mask"]:
        print(f"wrote {report['mask']} ({report['mask_pixels']:,} pixels)")
