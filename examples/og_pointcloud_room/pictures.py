"""Pictures of the demo: input views with their masks, and the cloud by instance or label.

A picture of the cloud looks into the room: the ceiling and the walls on the eye's side are cut away.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from og_pointcloud.ask.labelled_scene import LabelledScene
from og_pointcloud.ask.segmentation import Segmentation
from og_pointcloud.formats.colors import label_colors
from og_pointcloud.show.viewpoint import FOCAL, Viewpoint, choose_viewpoint

CUT_M = 2.3
"""Points above this are cut away to show the inside of the room; meters above the floor."""
WALL_M = 0.15
"""Points nearer than this to the end of the room are a wall, or hang on one; meters."""
STEP_BACK = 1.15
"""Factor on the eye's distance, so that walls and what hangs on them are in the picture too."""
DRAWN_SIZE, PICTURE_WIDTH = (1600, 1000), 1000
"""Pixels as drawn, and the width as shown."""
CLOSED = 4.5
"""Width of a point in point spacings, so that surfaces close; smoothing halves it."""
ASIDE = 0.12
"""How far the scene is shifted left, in half widths, as the legend is on the right."""

Colors = NDArray[np.uint8]


def draw_views(path: Path, images: Sequence[Colors], masks: Sequence[NDArray[np.integer]]) -> None:
    """Views side by side, and under each the same with its masks in random colors.

    images: (H, W, 3) uint8 RGB each. masks: (H, W) each, 0 or less outside every mask.
    """
    rng = np.random.default_rng(0)
    columns = []
    for image, ids in zip(images, masks, strict=True):
        colors = np.concatenate([[(255, 255, 255)], label_colors(rng.permutation(max(int(ids.max()), 1)))])
        inside = (ids > 0)[:, :, None]
        over = np.where(inside, 0.4 * image + 0.6 * colors[np.maximum(ids, 0)], 0.35 * image + 0.65 * 255)
        smoothed = ids.astype(np.float32)
        edge = inside[:, :, 0] & (cv2.erode(smoothed, np.ones((3, 3))) != cv2.dilate(smoothed, np.ones((3, 3))))
        over[edge] = 255
        gap = np.full((8, image.shape[1], 3), 255.0)
        columns += [np.concatenate([image, gap, over]), np.full((2 * image.shape[0] + 8, 8, 3), 255.0)]
    sheet = np.concatenate(columns[:-1], axis=1).astype(np.uint8)
    cv2.imwrite(str(path), sheet[:, :, ::-1])


def draw_clouds(
    path: Path, scene: LabelledScene, results: dict[str, Segmentation], rgb: Colors,
    known: NDArray[np.bool_] | None = None, *, by: str = "label",
) -> Path:  # fmt: skip
    """Results for one cloud side by side, each under its title. Needs PyVista with off-screen rendering.

    rgb: (N, 3) colors of the points, which shade those of the labels. known: (N,) points to draw; all if left out.
    by: "label" or "instance".
    """
    import pyvista as pv
    from og_pointcloud_pyvista import to_pyvista
    from og_pointcloud_pyvista.files import RGB

    shown, view = _look_into_room(next(iter(results.values())))
    shown = shown if known is None else shown & known
    distance = float(np.linalg.norm(view.eye - view.target))
    point_size = float(np.clip(CLOSED * scene.cloud.spacing * FOCAL * DRAWN_SIZE[1] / 2 / distance, 2, 12))
    panels = []
    for title, result in results.items():
        mesh = to_pyvista(result).extract_points(shown, adjacent_cells=False)
        mesh.point_data[RGB] = rgb[shown]
        plotter = pv.Plotter(off_screen=True, window_size=list(DRAWN_SIZE), theme=pv.themes.DocumentTheme())
        plotter.og.add_segmentation(mesh, by=by, point_size=point_size)
        plotter.og.look(view)
        plotter.camera.SetWindowCenter(ASIDE, 0)
        plotter.enable_anti_aliasing("ssaa")
        plotter.add_text(title, position="upper_left", font_size=14, color="black", font="arial")
        picture = np.asarray(plotter.screenshot(return_img=True))
        plotter.close()
        size = (PICTURE_WIDTH, round(picture.shape[0] * PICTURE_WIDTH / picture.shape[1]))
        panels.append(cv2.resize(picture[:, :, 2::-1], size, interpolation=cv2.INTER_AREA))
    cv2.imwrite(str(path), np.hstack(panels))
    return path


def _look_into_room(result: Segmentation) -> tuple[NDArray[np.bool_], Viewpoint]:
    """(N,) which points to show, and the viewpoint, chosen by the things in the room; walls before the eye are cut."""
    xyz = result.xyz
    lower, upper = np.percentile(xyz, (0.5, 99.5), axis=0)
    middle, half = (lower + upper) / 2, (upper - lower) / 2
    below = (xyz > lower - 0.1).all(axis=1) & (xyz < upper + 0.1).all(axis=1) & (xyz[:, 2] < lower[2] + CUT_M)
    beyond = (xyz - middle)[:, :2]
    inside = below & (np.abs(beyond) < half[:2] - WALL_M).all(axis=1)
    view = choose_viewpoint(xyz[inside], result.labels[inside] >= 0, np.array([0.0, 0.0, 1.0]))
    view = replace(view, eye=view.target + STEP_BACK * (view.eye - view.target))
    before_eye = beyond * np.sign(view.eye - middle)[:2] > half[:2] - WALL_M
    return below & ~before_eye.any(axis=1), view
