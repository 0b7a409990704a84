"""A whole scene at one look: what ``og-pointcloud view`` writes as a picture."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pyvista as pv
from numpy.typing import NDArray

from og_pointcloud.ask.labelled_scene import LabelledScene
from og_pointcloud.ask.segmentation import Segmentation
from og_pointcloud.show.page import Look
from og_pointcloud.show.viewpoint import FOCAL, Viewpoint
from og_pointcloud_pyvista.datasets import to_pyvista
from og_pointcloud_pyvista.files import RGB

PICTURE_SIZE = (1600, 1000)
CLOSED = 3.0
"""Width of a point in point spacings, so that surfaces close; smoothing halves it."""
ASIDE = 0.12
"""How far the scene is moved to the left, in half widths: the legend is on the right."""


def draw(
    scene: LabelledScene,
    result: Segmentation,
    rgb: NDArray[np.uint8] | None,
    shown: NDArray[np.bool_],
    view: Viewpoint,
    look: Look,
) -> pv.Plotter:
    """An off-screen plotter, ready to be photographed; needs `can_render`.

    rgb: (N, 3) colors of the points, which shade those of the labels. shown: (N,) which points to draw. look: its mode
    is "labels" or "instances".
    """
    of_points = [field.name for field in fields(result) if isinstance(getattr(result, field.name), np.ndarray)]
    mesh = to_pyvista(replace(result, **{name: getattr(result, name)[shown] for name in of_points}))
    if rgb is not None:
        mesh.point_data[RGB] = rgb[shown]
    plotter = pv.Plotter(off_screen=True, window_size=list(PICTURE_SIZE), theme=pv.themes.DocumentTheme())
    distance = float(np.linalg.norm(view.eye - view.target))
    point_size = float(np.clip(CLOSED * scene.cloud.spacing * FOCAL * PICTURE_SIZE[1] / 2 / distance, 2, 12))
    plotter.og.add_segmentation(mesh, by=look.mode.removesuffix("s"), point_size=point_size)
    if look.boxes:
        plotter.og.add_boxes(mesh, up=view.up)
    plotter.og.look(view)
    plotter.camera.SetWindowCenter(ASIDE, 0)
    plotter.enable_anti_aliasing("ssaa")
    return plotter
