"""A window: the cloud by classes and instances, with names, queries typed into it, and export."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import og_pointcloud as og
from og_pointcloud.ask.labelled_scene import SceneLike, as_scene
from og_pointcloud.ask.segmentation import Segmentation
from og_pointcloud.cloud import UNKNOWN
from og_pointcloud.errors import MissingExtraError, OgPointcloudError, SceneError
from og_pointcloud.text.words import Labels, TextFeatures
from og_pointcloud_open3d.host import open3d
from og_pointcloud_open3d.offscreen import viewpoint

__all__ = ["draw"]

UNKNOWN_GROUP = "unknown"
QUERY = "Query"
QUERY_COLOR = (1.0, 0.85, 0.0)


def draw(
    pcd: Any,
    labels: Labels = None,
    scene: SceneLike | None = None,
    *,
    text_features: TextFeatures = None,
    export: str | os.PathLike[str] = "labelled.ply",
    title: str = "og_pointcloud",
    size: tuple[int, int] = (1280, 960),
    point_size: int = 3,
) -> Segmentation:
    """Open Open3D's viewer on a labelled cloud; returns the labels once the window is closed.

    Each class is a group of the panel, each of its instances a geometry in it, named in the picture too. Two buttons:
    "Query" asks for a word and shows what it finds in yellow, "Export" writes the labels.
    pcd: a cloud that ``og_pointcloud.segment`` takes. labels, scene, text_features: as there.
    export: where the button writes to, an ending that ``Segmentation.save`` knows. size: pixels.
    OgPointcloudError without a display; SceneError for a cloud without a finite point.
    """
    host = open3d()
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise OgPointcloudError("no display (DISPLAY is not set); expected one for a window: draw_png needs none")
    result = og.segment(pcd, labels, scene, text_features=text_features)
    view = _View(result, scene if scene is not None else result.scene, text_features, Path(export), point_size)
    host.visualization.draw(
        view.geometries(),
        title=title,
        width=size[0],
        height=size[1],
        actions=[("Query", view.ask), ("Export", view.export)],
        show_ui=True,
        show_skybox=False,
        point_size=point_size,
        on_init=view.prepare,
        **view.first_look(),
    )
    return result


class _View:
    """What the window shows, and what its buttons do. ``window``: Open3D's O3DVisualizer."""

    def __init__(
        self,
        result: Segmentation,
        scene: SceneLike | None,
        text_features: TextFeatures,
        export_path: Path,
        point_size: int,
    ) -> None:
        self._finite = np.isfinite(result.xyz).all(axis=1)
        if not self._finite.any():
            raise SceneError(f"none of {len(result)} points has finite coordinates; expected some to draw")
        self._result, self._scene, self._text_features, self._path = result, scene, text_features, export_path
        self._point_size = point_size
        self._origin = np.median(result.xyz[self._finite], axis=0)  # the viewer draws in float32

    def geometries(self, highlighted: NDArray[np.int64] | None = None) -> list[dict[str, Any]]:
        """One a labelled instance, in the group of its class, and one of the points without a label.

        highlighted: rows that are yellow."""
        colors = self._result.colors / 255
        if highlighted is not None:
            colors[highlighted] = QUERY_COLOR
        return [self._geometry(name, group, rows, colors[rows]) for name, group, rows in self._parts()]

    def first_look(self) -> dict[str, Any]:
        """Where the window looks from at first: arguments of Open3D's draw."""
        look = viewpoint(self._result.xyz[self._finite], self._result.labels[self._finite] != UNKNOWN)
        return {"lookat": look.target - self._origin, "eye": look.eye - self._origin, "up": look.up}

    def prepare(self, window: Any) -> None:
        """Each instance's class, written where its middle is; and colours that stay what they are."""
        window.scene.view.set_post_processing(False)
        for _, group, rows in self._parts():
            if group != UNKNOWN_GROUP:
                window.add_3d_label(self._local(rows).mean(axis=0), group)

    def ask(self, window: Any) -> None:
        """A dialog with a line to type into."""
        gui = open3d().visualization.gui
        em = window.scaling * 16
        dialog, line = gui.Dialog(QUERY), gui.TextEdit()
        line.placeholder_text = "a word or phrase, then Enter"
        line.set_on_value_changed(lambda text: self.answer(window, text))
        column = gui.Vert(em / 2, gui.Margins(em, em, em, em))
        for widget in (gui.Label("Show what is called"), line):
            column.add_child(widget)
        dialog.add_child(column)
        window.show_dialog(dialog)

    def answer(self, window: Any, text: str) -> None:
        """Make the instances that a text fits yellow, in place of those of the query before."""
        window.close_dialog()
        try:
            rows = self.found(text)
        except (OgPointcloudError, MissingExtraError) as error:
            window.show_message_box(QUERY, str(error))
            return
        if not len(rows):
            window.show_message_box(QUERY, f"nothing here is called '{text}'")
            return
        for geometry in self.geometries(highlighted=rows):
            window.remove_geometry(geometry["name"])
            window.add_geometry(geometry)
        window.post_redraw()

    def found(self, text: str) -> NDArray[np.int64]:
        """Rows of points whose instance a text fits."""
        if self._scene is None:
            raise OgPointcloudError("the labels name no scene; expected one to ask: pass it to draw")
        selection = og.select(as_scene(self._scene), text, text_features=self._text_features)
        return np.flatnonzero(np.isin(self._result.instances, selection.instances) & self._finite)

    def export(self, window: Any) -> None:
        """Write the labels, and say where."""
        try:
            message = f"wrote {self._result.save(self._path)}"
        except (OgPointcloudError, MissingExtraError, OSError) as error:
            message = str(error)
        window.show_message_box("Export", message)

    def _parts(self) -> list[tuple[str, str, NDArray[np.int64]]]:
        """(name, group, rows) of every labelled instance, and of the points without a label."""
        labels, instances = self._result.labels, self._result.instances
        parts = []
        for instance in np.unique(instances[(labels != UNKNOWN) & self._finite]).tolist():
            rows = np.flatnonzero((instances == instance) & self._finite)
            group = self._result.names[labels[rows[0]]]
            parts.append((f"{group} {instance}", group, rows))
        unknown = np.flatnonzero((labels == UNKNOWN) & self._finite)
        return [*parts, (UNKNOWN_GROUP, UNKNOWN_GROUP, unknown)] if len(unknown) else parts

    def _local(self, rows: NDArray[np.int64]) -> NDArray[np.float32]:
        return (self._result.xyz[rows] - self._origin).astype(np.float32)

    def _geometry(self, name: str, group: str, rows: NDArray[np.int64], colors: NDArray[np.floating]) -> dict[str, Any]:
        host = open3d()
        cloud = host.t.geometry.PointCloud(host.core.Tensor(self._local(rows)))
        cloud.point["colors"] = host.core.Tensor(colors.astype(np.float32))
        material = host.visualization.rendering.MaterialRecord()
        material.shader, material.point_size = "defaultUnlit", float(self._point_size)
        return {"name": name, "group": group, "geometry": cloud, "material": material}
