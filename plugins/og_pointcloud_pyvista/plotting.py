"""``plotter.og``: draws segmented datasets and boxes, and answers clicks with words."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import pyvista as pv
from numpy.typing import ArrayLike, NDArray
from vtkmodules.vtkCommonCore import VTK_FONT_FILE

import og_pointcloud as og
from og_pointcloud.ask.boxes import unit_up
from og_pointcloud.ask.labelled_scene import LabelledScene, SceneLike, find_scene
from og_pointcloud.ask.picking import Pick
from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.formats.colors import LUMINANCE, label_colors
from og_pointcloud.show.viewpoint import FOCAL, Viewpoint, choose_viewpoint
from og_pointcloud.text.words import Labels
from og_pointcloud_pyvista.datasets import COLOR, INSTANCE, LABEL, box_lines, check_in_world, label_names
from og_pointcloud_pyvista.files import RGB

UNKNOWN_COLOR = (205, 205, 205)
"""Lighter than in the data: most of a scene may be unknown, and the known part should stand out."""
MAX_LEGEND_ENTRIES = 20
"""Maximum number of names in a legend, the most frequent ones; one more entry counts the points of the others."""
LEGEND_MARGIN = 0.015
HIGHLIGHT = "magenta"
MAX_DARKENING = 0.5
"""Share by which a label's color is darkened where the dataset's own color is black, to keep shapes and shadows
visible."""
PROBE = "import pyvista as pv; pv.Plotter(off_screen=True, window_size=(32, 32)).screenshot(return_img=True)"
TEXT_SIZE = 11
LATIN_END = 0x180
"""VTK's own font has the characters before this one; it draws nothing in place of those that it lacks."""
PLACEHOLDER_FONT = "Last Resort"
"""Draws the same box for all characters of a script."""


def can_render() -> bool:
    """Whether VTK can render off-screen here. Tried in a separate process: VTK crashes without EGL or OSMesa."""
    if not os.environ.get("DISPLAY"):  # else VTK looks for an X server first, and prints errors
        os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")
    return subprocess.run([sys.executable, "-c", PROBE], capture_output=True, timeout=120, check=False).returncode == 0


@pv.register_plotter_component("og")
class OgPlotter:
    """``plotter.og``: draws what ``mesh.og`` answers."""

    def __init__(self, plotter: pv.Plotter) -> None:
        self._plotter: Any = plotter
        self._scene: LabelledScene | None = None
        self._drawn: pv.DataSet | None = None
        self._point_size = 5.0
        self._labels: Labels = None
        self._count = 5
        self._on_click: Callable[[Pick], None] | None = None

    def __plotter_close__(self) -> None:
        self._scene, self._drawn, self._on_click = None, None, None

    def add_segmentation(
        self,
        mesh: Any,
        *,
        by: str = "label",
        legend: bool = True,
        names: bool = True,
        point_size: float = 5.0,
        name: str = "og_segmentation",
        **options: Any,
    ) -> pv.Actor:
        """Draw a segmented dataset with one color per label, or ``by="instance"``, light gray without one.

        legend: show the labels with their numbers of points. names: show a label's name on each of its instances, the
        largest first, leaving out names that would cover others. point_size: pixels, for datasets of points.
        options: of ``add_mesh``. If the dataset has its own colors (RGB), they shade those of the labels.

        Returns the actor. Warns if no point has a label; OgPointcloudError for a dataset without points or labels.
        """
        if by not in ("label", "instance"):
            raise OgPointcloudError(f"by is {by!r:.40}; expected 'label' or 'instance'")
        self._drawn, mesh = mesh, _drawable(mesh)
        words = label_names(mesh)
        labels = np.asarray(mesh.point_data[LABEL])
        if (labels < 0).all():
            warnings.warn(f"none of {mesh.n_points:,} points has a label: all are drawn gray", stacklevel=2)
        colors = _colors(np.asarray(mesh.point_data[INSTANCE]) if by == "instance" else labels)
        kind = {"style": "points", "point_size": point_size} if _is_cloud(mesh) else {}
        self._point_size = point_size
        actor = self._plotter.add_mesh(
            mesh.copy(deep=False), scalars=_shaded(colors, mesh), rgb=True, name=name,
            **{"lighting": not kind, **kind, **options},
        )  # fmt: skip
        if legend:
            self._add_legend(labels, words, colored=by == "label")
        if names and INSTANCE in mesh.point_data:
            self._add_names(mesh, labels, words, name)
        try:
            self._scene = find_scene(mesh)
        except OgPointcloudError:  # drawing needs none
            self._scene = None
        return actor

    def add_boxes(self, of: Any, *, up: ArrayLike | None = None, **options: Any) -> pv.Actor | None:
        """Draw oriented boxes around the labelled instances of a segmented dataset, or around all instances of a scene.

        of: a dataset with og_instance, or a scene, a LabelledCloud or the path of a .ogpc file. up: (3,) vertical axis
        of the boxes. options: of ``add_mesh``.
        Returns the actor; without an instance to put a box around, warns and returns None.
        """
        lines = of.og.boxes(up=up) if isinstance(of, pv.DataSet) else box_lines(og.instance_table(of, up=up))
        if lines.n_cells == 0:
            warnings.warn("there is no instance with points to draw a box around", stacklevel=2)
            return None
        return self._plotter.add_mesh(
            lines, scalars=COLOR, rgb=True, preference="cell", pickable=False,
            **{"name": "og_boxes", "line_width": 2.5, "lighting": False, **options},
        )  # fmt: skip

    def show_labelled(self, mesh: Any, *, up: ArrayLike = (0, 0, 1)) -> None:
        """Look obliquely from above, from where the most labelled points of a segmented dataset are visible.

        up: (3,) direction that is up in the image.
        """
        mesh, direction = _drawable(mesh), unit_up(up)
        label_names(mesh)  # raises if it has no labels
        points = np.asarray(mesh.points, np.float64)
        self.look(choose_viewpoint(points, np.asarray(mesh.point_data[LABEL]) >= 0, direction))

    def look(self, view: Viewpoint) -> None:
        """Move the camera to a `Viewpoint`."""
        self._plotter.camera_position = [view.eye.tolist(), view.target.tolist(), view.up.tolist()]
        self._plotter.camera.view_angle = float(np.rad2deg(2 * np.arctan(1 / FOCAL)))
        self._plotter.reset_camera_clipping_range()

    def enable_click_query(
        self,
        scene: SceneLike | None = None,
        labels: Labels = None,
        *,
        words: int = 5,
        callback: Callable[[Pick], None] | None = None,
        **options: Any,
    ) -> None:
        """A click shows which instance it hit: its points and box highlighted, its best words and scores in a corner.

        scene: to query; None: that of the dataset drawn last, else as for ``og_pointcloud.segment``. labels: words to
        rank; None: the scene's own. words: number of words shown.
        callback: called with each ``Pick``, even if it hit no instance. options: of ``enable_point_picking``.
        """
        if self._drawn is not None:
            check_in_world(self._drawn)
        self._scene = find_scene(None, scene if scene is not None else self._scene)
        self._labels, self._count = labels, words
        self._on_click = callback
        self._plotter.enable_point_picking(
            self.query,
            **{"left_clicking": True, "show_point": False, "tolerance": 0.01, "font_size": TEXT_SIZE,
               "show_message": "click a point, or press P over it, to identify it", **options},
        )  # fmt: skip

    def query(self, point: ArrayLike) -> Pick:
        """Answer a click at a point, (3,) world coordinates, as ``enable_click_query`` does for the mouse."""
        if self._scene is None:
            raise OgPointcloudError("no scene to query yet: call plotter.og.enable_click_query(scene) first")
        hit = og.pick(self._scene, np.asarray(point, np.float64))
        if hit.found:
            self._highlight(hit)
        else:
            self._plotter.remove_actor(["og_highlight", "og_highlight_box"])
        answer = self._answer(hit)
        self._plotter.add_text(
            answer, position="lower_left", font_size=TEXT_SIZE, name="og_answer", font_file=font_file(answer)
        )
        if self._on_click is not None:
            self._on_click(hit)
        return hit

    def _answer(self, hit: Pick) -> str:
        if not hit.found:
            return str(hit)
        words = hit.scene.known_words(self._labels)
        if not words.names:
            return f"{hit}\n(the scene has no words of its own: pass labels)"
        ranked = hit.words(words)[: self._count]
        lines = [f"{score:5.2f}  {word}" for word, score in ranked] or ["no mask gave it a feature: unknown"]
        return "\n".join([str(hit), *lines])

    def _highlight(self, hit: Pick) -> None:
        assert self._scene is not None
        row = self._scene.instances[hit.instance]
        self._plotter.add_points(
            row.xyz, color=HIGHLIGHT, point_size=self._point_size + 3, lighting=False, name="og_highlight",
            pickable=False, reset_camera=False,
        )  # fmt: skip
        self._plotter.add_mesh(
            box_lines([row]), color=HIGHLIGHT, line_width=3, lighting=False, name="og_highlight_box", pickable=False,
            reset_camera=False,
        )  # fmt: skip

    def _add_legend(self, labels: NDArray[np.integer], words: Sequence[str], colored: bool) -> None:
        counts = np.bincount(labels + 1, minlength=len(words) + 1)  # first: unknown, -1
        order = [int(label) for label in np.argsort(-counts[1:], kind="stable") if counts[1 + label]]
        entries = [(f"{words[label]}  {counts[1 + label]:,}", _colors(np.array([label]))[0]) for label in order]
        if len(entries) > MAX_LEGEND_ENTRIES:
            others = sum(counts[1 + label] for label in order[MAX_LEGEND_ENTRIES:])
            entries = entries[:MAX_LEGEND_ENTRIES]
            entries.append((f"{len(order) - MAX_LEGEND_ENTRIES} more  {others:,}", np.array((255, 255, 255))))
        if counts[0]:
            entries.append((f"unknown  {counts[0]:,}", np.array(UNKNOWN_COLOR)))
        text = self._plotter.theme.font.color
        longest = max(len(entry) for entry, _ in entries)
        size = (min(0.02 + 0.007 * longest, 0.4), min(0.026 * len(entries), 0.9))
        legend: Any = self._plotter.add_legend(
            [[entry, text] for entry, _ in entries], face="none", loc=None, font_family="arial",
            bcolor=self._plotter.background_color, background_opacity=0.8,
        )  # fmt: skip
        # Placed in the upper right corner manually: PyVista's `loc` puts wide legends too far inside.
        legend.SetPosition(1 - size[0] - LEGEND_MARGIN, 1 - size[1] - LEGEND_MARGIN)
        legend.SetPosition2(*size)
        if file := font_file("".join(words)):
            legend.GetEntryTextProperty().SetFontFile(file)
            legend.GetEntryTextProperty().SetFontFamily(VTK_FONT_FILE)
        # Words in the text's color beside a swatch: by default VTK gives both the color of the swatch.
        for index, (_, color) in enumerate(entries if colored else []):
            legend.SetEntryIcon(index, _swatch(color))

    def _add_names(self, mesh: Any, labels: NDArray[np.integer], words: Sequence[str], name: str) -> None:
        """Draw each labelled instance's word, the largest instances first."""
        ids = np.where(labels >= 0, np.asarray(mesh.point_data[INSTANCE]), -1)
        # The rows of each instance: those sorted by instance, cut where the next one begins.
        order = np.argsort(ids, kind="stable")
        parts = np.split(order, np.unique(ids[order], return_index=True)[1][1:])
        parts = sorted((rows for rows in parts if ids[rows[0]] >= 0), key=len, reverse=True)
        if parts:
            points = np.asarray(mesh.points)
            self._plotter.add_point_labels(
                np.array([_middle_point(points[rows]) for rows in parts]),
                [words[int(labels[rows[0]])] for rows in parts],
                font_size=13, bold=False, font_family="arial", text_color="black", shape_color="white",
                shape_opacity=0.8, margin=3, show_points=False, always_visible=True, name=f"{name}_names",
                reset_camera=False, font_file=font_file("".join(words)),
            )  # fmt: skip


@lru_cache
def font_file(text: str) -> str | None:
    """Path of a font of this machine that has all characters of a text; None if VTK's own has them. Warns if none has
    them: the font that comes with matplotlib, which PyVista requires, is taken then."""
    needed = {ord(character) for character in text if character.isprintable()}
    if max(needed, default=0) < LATIN_END:
        return None
    from matplotlib.font_manager import findfont, fontManager

    shipped = findfont("DejaVu Sans")
    others = (entry.fname for entry in fontManager.ttflist if not entry.name.startswith(PLACEHOLDER_FONT))
    for path in (shipped, *others):
        if needed <= _characters(path):
            return path
    lacking = "".join(map(chr, sorted(needed - _characters(shipped))))
    warnings.warn(f"no font of this machine has all of {lacking:.40}: they are left out; install one", stacklevel=4)
    return shipped


def _characters(path: str) -> set[int]:
    """Codes of the characters that a font file has; none if it cannot be read."""
    from matplotlib.font_manager import get_font

    try:
        return set(get_font(path).get_charmap())
    except (OSError, RuntimeError):
        return set()


def _colors(ids: NDArray[np.integer]) -> NDArray[np.uint8]:
    return np.where((ids >= 0)[:, None], label_colors(ids), np.array(UNKNOWN_COLOR)).astype(np.uint8)


def _shaded(colors: NDArray[np.uint8], mesh: pv.DataSet) -> NDArray[np.uint8]:
    """Colors (n, 3) darkened where the dataset's own colors are dark, relative to its brightest ones; unchanged if it
    has none."""
    rgb = mesh.point_data.get(RGB)
    if rgb is None:
        return colors
    luminance = np.asarray(rgb)[:, :3] @ LUMINANCE
    bright = max(float(np.percentile(luminance, 95)), 1.0)
    light = 1 - MAX_DARKENING + MAX_DARKENING * np.clip(luminance / bright, 0, 1)
    return (colors * light[:, None]).astype(np.uint8)


def _drawable(mesh: Any) -> Any:
    """The dataset without non-finite points, which would make VTK draw nothing at all. OgPointcloudError if none are
    left, and for anything but a dataset."""
    if not isinstance(mesh, pv.DataSet):
        raise OgPointcloudError(
            f"a {type(mesh).__name__} cannot be drawn; expected a segmented dataset: result.to_pyvista(), or "
            "mesh.og.segment(words) of each block of a MultiBlock, or of blocks.combine()"
        )
    finite = np.logical_and.reduce(np.isfinite(np.asarray(mesh.points)), axis=1)
    if not finite.any():
        raise OgPointcloudError(
            f"a {type(mesh).__name__} of {mesh.n_points} points, 0 of them finite, cannot be drawn; expected points: "
            "check that its file was read, and that the selection is not empty"
        )
    if finite.all():
        return mesh
    warnings.warn(
        f"{(~finite).sum():,} of {len(finite):,} points contain NaN or infinity: they are not drawn", stacklevel=3
    )
    return mesh.extract_points(finite, adjacent_cells=False)


def _is_cloud(mesh: Any) -> bool:
    """Whether all cells of a dataset are vertices, or it has none."""
    if isinstance(mesh, pv.PolyData):
        return mesh.n_verts == mesh.n_cells
    kinds = getattr(mesh, "celltypes", None)
    clouds = (pv.CellType.VERTEX, pv.CellType.POLY_VERTEX)
    return mesh.n_cells == 0 or (kinds is not None and bool(np.isin(kinds, clouds).all()))


def _middle_point(points: NDArray[np.floating]) -> NDArray[np.floating]:
    """The point nearest to the median of all. It lies on the object, unlike the mean of a ring's points."""
    return points[((points - np.median(points, axis=0)) ** 2).sum(axis=1).argmin()]


def _swatch(color: NDArray[np.integer]) -> pv.ImageData:
    image = pv.ImageData(dimensions=(8, 8, 1))
    image.point_data["color"] = np.tile(color.astype(np.uint8), (64, 1))
    return image
