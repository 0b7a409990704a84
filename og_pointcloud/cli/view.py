"""``og-pointcloud view``: a scene labelled by words, in a window, as a page or a picture; or views of a capture."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from og_pointcloud.cli.common import add_command, check_outputs, names_in, print_table, timed
from og_pointcloud.errors import OgPointcloudError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from og_pointcloud.ask.labelled_scene import LabelledScene
    from og_pointcloud.ask.segmentation import Segmentation
    from og_pointcloud.scene import Scene
    from og_pointcloud.show.viewpoint import Viewpoint

AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1), "-x": (-1, 0, 0), "-y": (0, -1, 0), "-z": (0, 0, -1)}
OF_SCENE = ("labels", "text_features", "cloud", "html", "png", "boxes", "certainty", "up", "cut")
OF_CAPTURE = ("features", "output", "columns", "seed")


def add(commands: Any) -> None:
    parser = add_command(
        commands, "view", run,
        "Look at a scene labelled by words: in a window, as a stand-alone page or picture. Or at views of a capture.",
        "og-pointcloud view kitchen.ogpc --labels chair,table --html kitchen.html\n"
        "  og-pointcloud view kitchen --features -o features.png",
    )  # fmt: skip
    parser.add_argument("source", type=Path, metavar="S.ogpc|CAPTURE", help="what `fit` wrote, or a capture folder")
    scene = parser.add_argument_group("a scene (S.ogpc); without --html and --png it opens a window")
    scene.add_argument("--labels", metavar="A,B,C", help="names to choose among (default: all that are known)")
    scene.add_argument("--text-features", type=Path, metavar="F.npz", help="names and vectors, from the same encoder")
    scene.add_argument("--cloud", type=Path, metavar="CLOUD", help="points to show (default: those fitted)")
    scene.add_argument("--html", type=Path, metavar="P.html", help="a page that any browser opens, without a network")
    scene.add_argument("--png", type=Path, metavar="P.png", help="a picture")
    scene.add_argument("--boxes", action="store_true", help="boxes around what has a label")
    scene.add_argument("--certainty", action="store_true", help="colours by how sure each point's instance is")
    scene.add_argument("--up", choices=AXES, metavar="AXIS", help="which of x, y, z, -x, -y, -z points up (default: z)")
    scene.add_argument(
        "--cut", type=float, metavar="SHARE", help="hide this share of the height, from the top: ceilings"
    )
    parser.add_argument(
        "--instances", nargs="?", type=Path, const=True, metavar="S.ogpc",
        help="of a scene: colours by instance; of a capture: show the instances of this fit",
    )  # fmt: skip
    capture = parser.add_argument_group("a capture, with --features or --instances S.ogpc")
    capture.add_argument(
        "--features", action="store_true", help="learn features; show them before and after clustering"
    )
    capture.add_argument(
        "-o", "--output", type=Path, metavar="P.png", help="the picture (default: features.png or instances.png)"
    )
    capture.add_argument("--columns", type=int, metavar="N", help="views shown (default: 4)")
    capture.add_argument("--seed", type=int, metavar="N", help="of everything random (default: 0)")


def run(arguments: argparse.Namespace) -> None:
    is_scene = arguments.source.suffix == ".ogpc"
    of_other = [
        name for name in (OF_CAPTURE if is_scene else OF_SCENE) if getattr(arguments, name) not in (None, False)
    ]
    if of_other:
        kind, other = ("scene (.ogpc)", "capture") if is_scene else ("capture", "scene (.ogpc)")
        hint = ": a picture is --png, a page --html" if "output" in of_other else ""
        raise OgPointcloudError(
            f"--{of_other[0].replace('_', '-')} is for a {other}, but '{arguments.source}' is a {kind}{hint}"
        )
    (view_scene if is_scene else view_capture)(arguments)


def view_scene(arguments: argparse.Namespace) -> None:
    check_scene_options(arguments)
    from og_pointcloud.ask.hosts import import_plugin
    from og_pointcloud.cli.segment import describe_segmentation, print_segmentation

    stages: list[dict[str, Any]] = []
    scene, result, rgb = labelled(arguments, stages)
    if arguments.certainty and result.certainty is None:
        raise OgPointcloudError(f"{arguments.source} does not know how sure its points are: fit the capture again")
    with timed(stages, "choose view"):
        shown, view = chosen_view(result, arguments)
    outputs = [path for path in (arguments.html, arguments.png) if path]
    for path in outputs:
        path.parent.mkdir(parents=True, exist_ok=True)
    if arguments.html:
        with timed(stages, "page"):
            left_out = make_page(scene, result, view, rgb, arguments)
        if left_out:
            print(f"left out of the page: {left_out}")
    plotter = None
    if arguments.png or not outputs:
        with timed(stages, "draw"):
            by = "certainty" if arguments.certainty else "instance" if arguments.instances else "label"
            draw = import_plugin("og_pointcloud_pyvista.screening", "pyvista").draw
            plotter = draw(scene, result, rgb, shown, view, by=by, boxes=arguments.boxes, window=not outputs)
            if arguments.png:
                plotter.screenshot(arguments.png)
    print_segmentation(describe_segmentation(result, stages, arguments.source, outputs[0] if outputs else None))
    for path in outputs[1:]:
        print(f"wrote {path}")
    if plotter is not None and not outputs:
        plotter.show()


def check_scene_options(arguments: argparse.Namespace) -> None:
    check_outputs(
        {"--html": (arguments.html, [".html", ".htm"]), "--png": (arguments.png, [".png"])},
        inputs=[arguments.source, arguments.text_features, arguments.cloud],
    )
    if isinstance(arguments.instances, Path):
        raise OgPointcloudError(f"--instances is '{arguments.instances}'; expected no value where a scene is shown")
    if arguments.certainty and (arguments.instances or arguments.html):
        raise OgPointcloudError(
            "--certainty is drawn alone, in a window or with --png; leave out --instances and --html"
        )
    if arguments.cut is not None and not 0 <= arguments.cut < 1:
        raise OgPointcloudError(f"--cut is {arguments.cut}; expected a share of the height, from 0 to below 1")
    if arguments.html is not None and arguments.png is None:
        return
    from og_pointcloud.ask.hosts import import_plugin

    plugin = import_plugin("og_pointcloud_pyvista", "pyvista")
    if arguments.png is None and sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
        raise OgPointcloudError(
            "there is no display for a window (DISPLAY is not set): write a page (--html P.html) or a picture (--png "
            "P.png)"
        )
    if arguments.png is not None and not plugin.can_render():
        raise OgPointcloudError(
            "VTK cannot draw off-screen here, it finds neither EGL nor OSMesa: install one of them (Debian: apt-get "
            "install libegl1, or libosmesa6), or write a page (--html P.html), which needs neither"
        )


def labelled(
    arguments: argparse.Namespace, stages: list[dict[str, Any]]
) -> tuple[LabelledScene, Segmentation, NDArray[np.uint8] | None]:
    """The scene, its answer, and the colours of the points asked about."""
    from og_pointcloud.ask.labelled_scene import load, segment
    from og_pointcloud.formats.points import read_points

    with timed(stages, "load"):
        scene = load(arguments.source)
        other = read_points(arguments.cloud) if arguments.cloud else None
    with timed(stages, "segment"):
        result = segment(
            scene if other is None else other.xyz_world,
            names_in(arguments.labels),
            scene,
            text_features=arguments.text_features,
        )
    return scene, result, scene.cloud.rgb if other is None else other.rgb


def chosen_view(result: Segmentation, arguments: argparse.Namespace) -> tuple[NDArray[np.bool_], Viewpoint]:
    """(N,) which points are shown, what --cut hides left out; and where from."""
    import numpy as np

    from og_pointcloud.show.viewpoint import choose_viewpoint

    up = np.array(AXES[arguments.up or "z"], np.float64)
    shown = np.logical_and.reduce(np.isfinite(result.xyz), axis=1)
    if not shown.any():
        raise OgPointcloudError(f"{arguments.cloud or arguments.source} has no point to show; expected at least one")
    if arguments.cut:
        height = result.xyz[shown] @ up
        shown[shown] = height <= height.max() - arguments.cut * np.ptp(height)
    return shown, choose_viewpoint(result.xyz[shown], result.labels[shown] >= 0, up)


def make_page(
    scene: LabelledScene,
    result: Segmentation,
    view: Viewpoint,
    rgb: NDArray[np.uint8] | None,
    arguments: argparse.Namespace,
) -> str:
    from og_pointcloud.show.page import Look, write_page

    title, mode = (arguments.cloud or arguments.source).stem, "instances" if arguments.instances else "labels"
    look = Look(title, mode, arguments.boxes, arguments.cut or 0.0)
    return write_page(arguments.html, scene, result, view, look, rgb)


def view_capture(arguments: argparse.Namespace) -> None:
    if not arguments.features and arguments.instances is None:
        arguments.parser.error("one of the arguments --features --instances is required")
    if arguments.features and arguments.instances is not None:
        arguments.parser.error("argument --instances: not allowed with argument --features")
    if arguments.instances is True:  # nothing behind the option
        raise OgPointcloudError(
            f"--instances has no value; expected the fit of '{arguments.source}': --instances S.ogpc"
        )
    output = arguments.output or Path("features.png" if arguments.features else "instances.png")
    columns, seed = 4 if arguments.columns is None else arguments.columns, arguments.seed or 0
    check_outputs({"-o": (output, [".png"])}, inputs=[arguments.source, arguments.instances])
    if columns < 1:
        raise OgPointcloudError(f"--columns is {columns}; expected at least 1")
    from og_pointcloud.fitting.fit import prepare
    from og_pointcloud.formats.capture import read_capture
    from og_pointcloud.journal import Journal
    from og_pointcloud.show import fit_pictures as pictures

    stages: list[dict[str, Any]] = []
    with timed(stages, "read capture"):
        scene = read_capture(arguments.source)
    output.parent.mkdir(parents=True, exist_ok=True)
    with timed(stages, "prepare"):
        prepared = prepare(scene, journal=Journal(progress=True))
        surface = prepared.surface
    if arguments.features:
        with timed(stages, "learn"):
            features = pictures.learned_stages(prepared.table, surface.scene.points.xyz, seed=seed)
        with timed(stages, "draw"):
            pictures.feature_picture(surface.gaussians, scene.views, surface.near, features, output, columns)
    else:
        ids, gaussians = instances_of(arguments.instances, scene), surface.gaussians.take(surface.row_of_point)
        with timed(stages, "draw"):
            pictures.instance_picture(gaussians, scene.views, surface.near, ids, output, columns)
    print_table(("stage", "seconds"), [(stage["name"], f"{stage['seconds']:.2f}") for stage in stages])
    print(f"wrote {output}")


def instances_of(bundle: Any, scene: Scene) -> dict[str, NDArray[np.int32]]:
    from og_pointcloud.bundle.read import read_bundle

    cloud = read_bundle(bundle).cloud
    if len(cloud) != len(scene.points):
        raise OgPointcloudError(
            f"{bundle} has {len(cloud)} points, the capture {len(scene.points)}; expected a fit of this capture"
        )
    return {f"{len(cloud.instances)} instances": cloud.instance_ids}
