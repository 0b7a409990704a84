"""Pictures of the demo: input views with their masks, the cloud by instance, the cloud by class beside the truth."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import MissingExtraError

if TYPE_CHECKING:
    import pyvista

__all__ = ["can_render", "draw_instances", "draw_labels", "draw_views"]

PALETTE = np.array(
    [
        (31, 119, 180), (255, 152, 62), (44, 150, 60), (214, 39, 40), (148, 103, 189), (240, 128, 190), (188, 166, 34),
        (23, 180, 200), (128, 84, 62), (122, 200, 90), (250, 205, 60), (70, 70, 150), (160, 30, 100), (110, 180, 250),
        (0, 110, 105), (200, 120, 105), (205, 160, 230), (90, 110, 40), (255, 90, 90), (60, 60, 70),
    ],
    np.uint8,
)  # fmt: skip
"""Colours that stay apart beside each other; classes beyond their number start again."""
UNKNOWN = np.array((216, 216, 216), np.uint8)
CUT_HEIGHT = 2.3
"""Points above are cut away, so that one sees into the room; metres above the floor."""
SPLAT_M = 0.055
"""Side of the square that a point is drawn as, metres: neighbours of a cloud thinned to 4 cm just close up."""
VIEW_ANGLE = 30.0
OVERSAMPLING = 2
"""Pictures are rendered this much larger and averaged down: splats have no anti-aliasing of their own."""
PROBE = "import pyvista as pv; p = pv.Plotter(off_screen=True, window_size=(32, 32)); p.screenshot(return_img=True)"

Colours = NDArray[np.uint8]


def can_render() -> bool:
    """Whether PyVista can draw off-screen here. Tried in a process of its own: without EGL or OSMesa VTK crashes.

    Raises MissingExtraError where PyVista is not installed.
    """
    if importlib.util.find_spec("pyvista") is None:
        raise MissingExtraError("pyvista", "demo")
    if not os.environ.get("DISPLAY"):
        # Else VTK looks for an X server first and complains.
        os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")
    tried = subprocess.run([sys.executable, "-c", PROBE], capture_output=True, timeout=120, check=False)
    return tried.returncode == 0


def draw_views(path: Path, images: Sequence[Colours], masks: Sequence[NDArray[np.integer]], *, seed: int = 0) -> None:
    """Views side by side, and under each the same with its masks in random colours.

    images: (H, W, 3) uint8 RGB each. masks: (H, W) each, 0 or less outside every mask.
    """
    rng = np.random.default_rng(seed)
    columns = []
    for image, ids in zip(images, masks, strict=True):
        colours = np.concatenate([[(255, 255, 255)], PALETTE[rng.permutation(max(int(ids.max()), 1)) % len(PALETTE)]])
        inside = (ids > 0)[:, :, None]
        over = np.where(inside, 0.4 * image + 0.6 * colours[np.maximum(ids, 0)], 0.35 * image + 0.65 * 255)
        smoothed = ids.astype(np.float32)
        edge = inside[:, :, 0] & (cv2.erode(smoothed, np.ones((3, 3))) != cv2.dilate(smoothed, np.ones((3, 3))))
        over[edge] = 255
        gap = np.full((8, image.shape[1], 3), 255.0)
        columns += [np.concatenate([image, gap, over]), np.full((2 * image.shape[0] + 8, 8, 3), 255.0)]
    sheet = np.concatenate(columns[:-1], axis=1).astype(np.uint8)
    cv2.imwrite(str(path), sheet[:, :, ::-1])


def draw_instances(path: Path, xyz: NDArray[np.floating], rgb: Colours, instance_ids: NDArray[np.integer]) -> None:
    """The cloud in its own colours beside the cloud by instance, unlabelled points light grey.

    xyz: (n, 3) metres, z up, floor at 0. rgb: (n, 3) uint8. instance_ids: (n,), negative for none.
    """
    rank = np.unique(np.maximum(instance_ids, -1), return_inverse=True)[1]
    # Neighbouring ids get far colours; three shades tell instances apart that share a colour.
    shade = np.array([1.0, 0.72, 1.25])[(rank // len(PALETTE)) % 3]
    bright = np.clip(PALETTE[rank * 7 % len(PALETTE)] * shade[:, None], 0, 255).astype(np.uint8)
    colours = np.where((instance_ids >= 0)[:, None], bright, UNKNOWN)
    count = len(np.unique(instance_ids[instance_ids >= 0]))
    plotter = _plotter((1600, 760), shape=(1, 2))
    _panel(plotter, 0, f"input: {len(xyz):,} points", xyz, rgb)
    _panel(plotter, 1, f"{count} instances", xyz, _lit(colours, rgb))
    _save(plotter, path)


def draw_labels(
    path: Path, xyz: NDArray[np.floating], rgb: Colours, labels: NDArray[np.integer], truth: NDArray[np.integer],
    names: Sequence[str], *, instance_ids: NDArray[np.integer] | None = None, title: str = "segmented by words",
) -> None:  # fmt: skip
    """The cloud by class beside the truth, with a legend; unknown points light grey.

    xyz: (n, 3) metres, z up, floor at 0. rgb: (n, 3) uint8. labels, truth: (n,) rows of ``names``, -1 unknown.
    instance_ids: (n,) or None; with it the largest instance of each class carries its name.
    """
    plotter = _plotter((1760, 760), shape=(1, 3), col_weights=[0.45, 0.45, 0.1])
    for column, (caption, ids) in enumerate([(title, labels), ("ground truth", truth)]):
        colours = np.where((ids >= 0)[:, None], PALETTE[np.maximum(ids, 0) % len(PALETTE)], UNKNOWN)
        shown = _panel(plotter, column, caption, xyz, _lit(colours, rgb))
        if column == 0 and instance_ids is not None:
            _name_instances(plotter, xyz[shown], labels[shown], instance_ids[shown], names)
    present = np.union1d(labels[labels >= 0], truth[truth >= 0])
    plotter.subplot(0, 2)
    words = [names[int(index)] for index in present]
    _legend(plotter, [*words, "unknown"], [*PALETTE[present % len(PALETTE)], UNKNOWN])
    _save(plotter, path)


def _legend(plotter: pyvista.Plotter, words: Sequence[str], colours: Sequence[Colours]) -> None:
    """Swatches with black words beside them; VTK's own legend writes yellow words on white."""
    places = np.stack([np.zeros(len(words)), -np.arange(len(words)), np.zeros(len(words))], axis=1)
    plotter.add_points(places, scalars=np.stack(colours), rgb=True, point_size=16 * OVERSAMPLING, lighting=False)
    beside = places + np.array([0.45, 0, 0])
    plotter.add_point_labels(
        beside, list(words), font_size=17 * OVERSAMPLING, text_color="black", shape=None, show_points=False,
        always_visible=True, font_family="arial", bold=False, justification_vertical="center",
    )  # fmt: skip
    plotter.camera.parallel_projection = True
    plotter.camera.focal_point = (1.6, -(len(words) - 1) / 2, 0)
    plotter.camera.position = (1.6, -(len(words) - 1) / 2, 10)
    plotter.camera.up = (0, 1, 0)
    plotter.camera.parallel_scale = 0.6 * max(len(words), 16)


def _name_instances(
    plotter: pyvista.Plotter, xyz: NDArray[np.floating], labels: NDArray[np.integer],
    instance_ids: NDArray[np.integer], names: Sequence[str],
) -> None:  # fmt: skip
    """The name of each class at the top of its largest instance."""
    places, words = [], []
    for class_id in np.unique(labels[labels >= 0]):
        ids, counts = np.unique(instance_ids[(labels == class_id) & (instance_ids >= 0)], return_counts=True)
        if len(ids):
            points = xyz[instance_ids == ids[counts.argmax()]]
            places.append([*np.median(points[:, :2], axis=0), np.percentile(points[:, 2], 95) + 0.05])
            words.append(names[class_id])
    if words:
        plotter.add_point_labels(
            np.array(places), words, font_size=14 * OVERSAMPLING, text_color="black", shape_color="white",
            shape_opacity=0.75, margin=2 * OVERSAMPLING, show_points=False, always_visible=True, font_family="arial",
            bold=False,
        )  # fmt: skip


def _plotter(window_size: tuple[int, int], **layout: Any) -> pyvista.Plotter:
    import pyvista

    large = [OVERSAMPLING * side for side in window_size]
    theme = pyvista.themes.DocumentTheme()
    return pyvista.Plotter(off_screen=True, window_size=large, border=False, theme=theme, **layout)


def _panel(
    plotter: pyvista.Plotter, column: int, caption: str, xyz: NDArray[np.floating], colours: Colours
) -> NDArray[np.bool_]:
    """One view into the room from above a corner, ceiling and near walls cut away; returns which points it shows."""
    lower, upper = np.percentile(xyz, (0.5, 99.5), axis=0)
    middle, size = (lower + upper) / 2, upper - lower
    inside = ((xyz > lower - 0.1) & (xyz < upper + 0.1)).all(axis=1)
    corner = _open_corner(xyz[inside], middle, size)
    near_wall = ((xyz[:, :2] - middle[:2]) * corner > size[:2] / 2 - 0.15).any(axis=1)
    shown = inside & ~near_wall & (xyz[:, 2] < lower[2] + CUT_HEIGHT)
    plotter.subplot(0, column)
    reach = 1.28 * float(np.linalg.norm(size[:2]))
    focus = np.array([middle[0], middle[1], lower[2] + 0.3 * size[2]])
    toward_eye = np.array([0.6 * corner[0], 0.74 * corner[1], 1.0])
    focal_px = plotter.window_size[1] / 2 / np.tan(np.deg2rad(VIEW_ANGLE / 2))
    splat_px = SPLAT_M * focal_px / (reach * float(np.linalg.norm(toward_eye)))
    cloud = xyz[shown].astype(np.float32)
    plotter.add_points(cloud, scalars=colours[shown], rgb=True, point_size=splat_px, lighting=False)
    plotter.add_text(caption, position="upper_edge", font_size=13 * OVERSAMPLING, color="black", font="arial")
    plotter.camera.position = tuple(focus + toward_eye * reach)
    plotter.camera.focal_point = tuple(focus)
    plotter.camera.up = (0, 0, 1)
    plotter.camera.view_angle = VIEW_ANGLE
    plotter.reset_camera_clipping_range()
    return shown


def _open_corner(
    xyz: NDArray[np.floating], middle: NDArray[np.floating], size: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Signs (2,) of the corner to look from: the one whose two walls have the least tall furniture before them."""
    from_middle = (xyz - middle)[:, :2]
    tall = (xyz[:, 2] > middle[2] - 0.1 * size[2]) & (np.abs(from_middle) < size[:2] / 2 - 0.12).all(axis=1)
    corners = np.array([(1.0, -1.0), (-1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
    hidden = [(tall & (from_middle * corner > size[:2] / 2 - 0.7).any(axis=1)).sum() for corner in corners]
    return corners[int(np.argmin(hidden))]


def _lit(colours: Colours, rgb: Colours) -> Colours:
    """Label colours darkened where the cloud itself is dark, so that shape and shadows stay visible."""
    luminance = rgb @ np.array([0.3, 0.59, 0.11])
    light = 0.62 + 0.38 * np.clip(luminance / max(float(np.percentile(luminance, 90)), 1.0), 0, 1)
    return (colours * light[:, None]).astype(np.uint8)


def _save(plotter: pyvista.Plotter, path: Path) -> None:
    large = plotter.screenshot(return_img=True)
    plotter.close()
    assert large is not None
    size = (large.shape[1] // OVERSAMPLING, large.shape[0] // OVERSAMPLING)
    cv2.imwrite(str(path), cv2.resize(np.asarray(large)[:, :, 2::-1], size, interpolation=cv2.INTER_AREA))
