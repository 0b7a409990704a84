"""What ``mesh.og`` does: labels as point arrays, points selected by words, boxes of instances as lines.

Point arrays: og_label (int32, row of og_names, -1 unknown), og_instance (int32, the scene's id, negative for none),
og_score (float32), og_reason (uint8, a ``Reason``), og_color (uint8 RGB). Field data: og_names, the scene's file, and
og_pose, the pose to the scene's world of a dataset that was segmented with one.
Labels belong to points. For labels of cells, by majority of their points, call
``mesh.point_data_to_cell_data(categorical=True)``.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pyvista as pv
from numpy.typing import ArrayLike

import og_pointcloud as og
from og_pointcloud.ask.hosts import NAMES_FIELD, SCENE_FIELD, scene_name
from og_pointcloud.ask.instances import Instance
from og_pointcloud.ask.labelled_scene import LabelledScene, SceneLike, find_scene
from og_pointcloud.ask.segmentation import Segmentation
from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.formats.colors import label_colors
from og_pointcloud.text.words import Labels, TextFeatures

LABEL, INSTANCE, SCORE, COLOR = "og_label", "og_instance", "og_score", "og_color"
POSE_FIELD = "og_pose"
BOX_EDGES = [(a, a | 1 << axis) for a in range(8) for axis in range(3) if not a >> axis & 1]
"""Pairs of indices into `Box.corners`: the two ends of an edge differ in one bit, that is one axis."""


def to_pyvista(result: Segmentation) -> pv.PolyData:
    """A segmentation as a cloud of vertices in world coordinates, float64, with the arrays named above. All copied."""
    mesh = pv.PolyData(result.xyz.copy()) if len(result) else pv.PolyData()
    _attach(mesh, result)
    return mesh


@pv.register_dataset_accessor("og", pv.DataSet)
class OgDataSet:
    """``mesh.og``: query the points of any dataset by words.

    The scene is the one passed, else the file that the dataset records as its source. ``mesh.points`` must be in the
    scene's world coordinates.
    """

    def __init__(self, mesh: pv.DataSet) -> None:
        self._mesh = mesh

    def segment(
        self, labels: Labels = None, scene: SceneLike | None = None, *, pose: ArrayLike | None = None, **options: Any
    ) -> Any:
        """Label every point; returns a copy of the dataset with the arrays listed in this module's docstring.

        labels, scene, pose, options, warnings: as for ``og_pointcloud.segment``.
        """
        result = og.segment(self._mesh, labels, scene, pose=pose, **options)
        mesh = self._mesh.copy()
        _attach(mesh, result)
        if POSE_FIELD in mesh.field_data:  # left from an earlier answer
            mesh.field_data.remove(POSE_FIELD)
        if pose is not None and not np.array_equal(np.asarray(pose), np.eye(4)):
            mesh.field_data[POSE_FIELD] = np.asarray(pose, np.float64)
        return mesh

    def select(
        self,
        text: str | Mapping[str, ArrayLike],
        scene: SceneLike | None = None,
        *,
        against: Labels = None,
        text_features: TextFeatures = None,
    ) -> pv.UnstructuredGrid:
        """The cells that consist of points of the instances that match a text, with these points; where there is no
        such cell, the points alone.

        Point arrays: og_instance, and og_score of the instance.
        text, against, text_features: as for ``og_pointcloud.select``. Warns where nothing is selected.
        """
        found = find_scene(self._mesh, scene)
        selection = og.select(found, text, against=against, text_features=text_features)
        mesh = self._with_instances(found, scene)
        chosen = np.isin(mesh.point_data[INSTANCE], selection.instances) if mesh.n_points else np.zeros(0, bool)
        if not chosen.any():
            warnings.warn(f"no point of this dataset is selected: {selection}", stacklevel=2)
            return pv.UnstructuredGrid()
        points = mesh.extract_points(chosen, adjacent_cells=False)
        if not points.n_points:
            points = mesh.extract_points(chosen, include_cells=False)
        ids = np.asarray(points.point_data[INSTANCE])
        score = {match.instance: match.score for match in selection.fitting}
        points.point_data[SCORE] = np.array([score[instance] for instance in ids.tolist()], np.float32)
        return points

    def boxes(self, scene: SceneLike | None = None, *, up: ArrayLike | None = None) -> pv.PolyData:
        """Oriented boxes of the scene's instances that have points here, as lines: 12 cells each.

        For a dataset that this scene segmented, only labelled instances, in their label's color. Cell arrays:
        og_instance, og_color. up: (3,) vertical axis of the boxes, if known.
        """
        found = find_scene(self._mesh, scene)
        check_in_world(self._mesh)
        mesh = self._with_instances(found, scene)
        if not mesh.n_points:
            return pv.PolyData()
        segmented = mesh is self._mesh and LABEL in mesh.point_data
        included = mesh.point_data[LABEL] >= 0 if segmented else np.ones(mesh.n_points, bool)
        ids = [instance for instance in np.unique(mesh.point_data[INSTANCE][included]).tolist() if instance >= 0]
        colors = _instance_colors(mesh, ids) if segmented and COLOR in mesh.point_data else None
        table = og.instance_table(found, up=up)
        return box_lines([table[instance] for instance in ids], colors)

    def _with_instances(self, scene: LabelledScene, given: SceneLike | None) -> Any:
        """This dataset if its instance ids are this scene's, else a shallow copy with the scene's: also where the scene
        lacks some of them, or a filter has mixed them to fractions.

        given: the scene that the caller passed; None where the dataset names it.
        """
        ids = np.asarray(self._mesh.point_data.get(INSTANCE, ()))
        in_table = ids.dtype.kind in "iu" and ids.max(initial=-1) < len(scene.cloud.instances)
        named = np.asarray(self._mesh.field_data.get(SCENE_FIELD, ())).ravel()
        is_own = given is None or not len(named) or (scene.path is not None and named[0] == scene_name(scene.path))
        if in_table and is_own:
            return self._mesh
        check_in_world(self._mesh)
        mesh = self._mesh.copy(deep=False)
        if mesh.n_points:
            mesh.point_data[INSTANCE] = scene.instances_at(np.asarray(self._mesh.points))
        return mesh


def check_in_world(mesh: pv.DataSet) -> None:
    """OgPointcloudError for a dataset that was segmented with a pose, and so is not in the scene's coordinates."""
    if POSE_FIELD in mesh.field_data:
        raise OgPointcloudError(
            f"this {type(mesh).__name__} was segmented with a pose; expected points in the scene's world coordinates: "
            f"mesh.transform(mesh.field_data['{POSE_FIELD}'], inplace=False).og.segment(labels, scene)"
        )


def label_names(mesh: pv.DataSet) -> tuple[str, ...]:
    """Names of the labels in og_label; OgPointcloudError if the dataset lacks either, or a label has no name."""
    for kind, data, name in (("point", mesh.point_data, LABEL), ("field", mesh.field_data, NAMES_FIELD)):
        if name not in data:
            raise OgPointcloudError(
                f"the {type(mesh).__name__} of {mesh.n_points:,} points has no {kind} array '{name}'; expected a "
                "segmented dataset: mesh = mesh.og.segment(['chair', 'table'])"
            )
    names, labels = np.asarray(mesh.field_data[NAMES_FIELD]).ravel(), np.asarray(mesh.point_data[LABEL])
    if labels.dtype.kind not in "iu" or labels.max(initial=-1) >= len(names):
        raise OgPointcloudError(
            f"point array '{LABEL}' is {labels.dtype} up to {labels.max(initial=-1):g}; expected whole numbers below "
            f"{len(names)}, which index '{NAMES_FIELD}': filters that interpolate mix labels, so segment their result"
        )
    return tuple(map(str, names))


def box_lines(rows: Iterable[Instance], colors: Mapping[int, Sequence[int]] | None = None) -> pv.PolyData:
    """Oriented boxes as lines, without those of empty instances. colors: instance id -> RGB; None: from the id."""
    boxes = {row.id: box for row in rows if (box := row.oriented_box) is not None}
    if not boxes:
        return pv.PolyData()
    ids, corners = np.array([*boxes], np.int32), np.concatenate([box.corners for box in boxes.values()])
    # VTK lists the cells one after the other, each preceded by its number of points: 2, first, second.
    edges = (np.array(BOX_EDGES) + 8 * np.arange(len(ids))[:, None, None]).reshape(-1, 2)
    lines = pv.PolyData(corners, lines=np.insert(edges, 0, 2, axis=1).ravel())
    rgb = label_colors(ids) if colors is None else np.array([colors[instance] for instance in ids.tolist()], np.uint8)
    lines.cell_data[INSTANCE] = np.repeat(ids, len(BOX_EDGES))
    lines.cell_data[COLOR] = np.repeat(rgb, len(BOX_EDGES), axis=0)
    return lines


def set_strings(mesh: pv.DataObject, name: str, values: Iterable[str]) -> None:
    """Add strings as field data through VTK: PyVista refuses non-ASCII ones, VTK and its files do not."""
    from vtkmodules.vtkCommonCore import vtkStringArray

    strings = vtkStringArray()
    strings.SetName(name)
    for value in values:
        strings.InsertNextValue(value)
    mesh.GetFieldData().AddArray(strings)


def _attach(mesh: Any, result: Segmentation) -> None:
    if len(result):  # PyVista refuses empty arrays
        for name, values in {**result.attributes, COLOR: result.colors}.items():
            mesh.point_data.set_array(values, name, deep_copy=True)  # else edits of the mesh would change the result
        mesh.set_active_scalars(LABEL, preference="point")
    set_strings(mesh, NAMES_FIELD, result.names)
    if result.scene is not None:
        set_strings(mesh, SCENE_FIELD, [scene_name(result.scene)])
    elif SCENE_FIELD in mesh.field_data:  # left from an earlier answer
        mesh.field_data.remove(SCENE_FIELD)


def _instance_colors(mesh: pv.DataSet, ids: Sequence[int]) -> dict[int, Sequence[int]]:
    """The color of each instance's first point here; all its points have the same label."""
    present, first = np.unique(np.asarray(mesh.point_data[INSTANCE]), return_index=True)
    rows = first[np.searchsorted(present, ids)]
    return dict(zip(ids, np.asarray(mesh.point_data[COLOR])[rows].tolist(), strict=True))
