"""The result of ``segment``: a label, score and instance per point, and ways to view, convert and save them."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.ask.choosing import Reason
from og_pointcloud.ask.hosts import import_plugin
from og_pointcloud.errors import OgPointcloudError, printable
from og_pointcloud.formats.atomic import StrPath, replacing
from og_pointcloud.formats.colors import label_colors
from og_pointcloud.scene import Points

MAX_LABELS_SHOWN = 12
"""Labels listed in a printed result."""
SAVED_AS = (".npz", ".ply", ".las", ".laz", ".glb", ".spz")
"""Suffixes of the files that a result can be saved as."""
SPLATS_SAVED_AS = (".glb", ".spz")


@dataclass(frozen=True, eq=False)
class Segmentation:
    """One row per point, in the order of the query points.

    xyz: (N, 3) float64, world coordinates. labels: (N,) int32, row of ``names``, -1 unknown.
    scores: (N,) float32, 0 where unknown; else, if ``calibrated``, the probability that the point is what its label
        says; if not, the cosine of the label's text with the instance's descriptor, which is no probability.
    instances: (N,) int32, the scene's instance id, -1 background, -2 unobserved, -3 too far from the scene.
    reasons: (N,) int8, why a point is unknown: a ``Reason``, 0 where it has a label.
    names: the given labels. scene: the .ogpc file queried, None for a scene in memory.
    calibrated: whether the scene has a word bank to judge labels by. Without one each point gets the best label,
        however badly it fits: then Reason.NONE_FITS does not occur.
    certainty_of: source of ``certainty``: (N,) float32, or a function that looks it up; None if it is not known.

    All arrays are the result's own: changing them changes no scene.

    >>> result = og.segment([[0, 0, 1], [9, 9, 9]], ["chair"], cloud)  # of `LabelledCloud`'s example
    >>> result.mask("chair"), result.instances
    (array([ True, False]), array([ 0, -3], dtype=int32))
    >>> {str(reason): count for reason, count in result.unknown_because().items()}
    {'too far from the scene': 1}
    """

    xyz: NDArray[np.float64]
    labels: NDArray[np.int32]
    scores: NDArray[np.float32]
    instances: NDArray[np.int32]
    reasons: NDArray[np.int8]
    names: tuple[str, ...]
    scene: Path | None = None
    calibrated: bool = False
    certainty_of: Callable[[], NDArray[np.float32] | None] | NDArray[np.float32] | None = field(
        default=None, repr=False
    )

    def __len__(self) -> int:
        return len(self.labels)

    def __getstate__(self) -> dict[str, Any]:
        """Pickled with its certainty, in place of the function that looks it up in the scene."""
        return {**vars(self), "certainty_of": self.certainty}

    def __repr__(self) -> str:
        """Points per label, the most frequent first, and per reason for having none; and whether labels had to fit."""
        frequent = sorted(((name, count) for name, count in self.counts().items() if count), key=lambda row: -row[1])
        rows = [(printable(name, 40), f"{count:,}") for name, count in frequent[:MAX_LABELS_SHOWN]]
        if rest := frequent[MAX_LABELS_SHOWN:]:
            rows.append((f"{len(rest)} more labels", f"{sum(count for _, count in rest):,}"))
        rows += [(f"unknown, {reason}", f"{count:,}") for reason, count in self.unknown_because().items()]
        name_width = max((len(name) for name, _ in rows), default=0)
        count_width = max((len(count) for _, count in rows), default=0)
        lines = (f"{name:<{name_width}}  {count:>{count_width}}" for name, count in rows)
        best = "" if self.calibrated or not frequent else ", each with its best label, fitting or not (no word bank)"
        return "\n".join([f"{len(self):,} points{best}", *lines])

    @cached_property
    def certainty(self) -> NDArray[np.float32] | None:
        """(N,) float32 in [0, 1]: how well views and neighbors support that the nearest scene point is in its instance,
        or in none; 0 if no view saw it or the scene is too far. Looked up on first access, for the query points.

        ``scores`` tell whether the instance is what the word means, this whether the point is part of it: low at
        borders, and where masks disagree. None if the scene has no certainty.
        """
        certainty = self.certainty_of() if callable(self.certainty_of) else self.certainty_of
        if certainty is None:
            return None
        if len(certainty) != len(self):  # rows were selected by dataclasses.replace
            raise OgPointcloudError(
                f"certainty has {len(certainty):,} values, the result {len(self):,} points; expected one value per "
                "point: pass those of the rows as certainty_of"
            )
        return certainty.copy()  # it may be the scene's

    def mask(self, name: str) -> NDArray[np.bool_]:
        """(N,) bool, the points with this label."""
        if name not in self.names:
            raise OgPointcloudError(f"'{name}' was not asked for; the labels are {', '.join(self.names)}")
        return self.labels == self.names.index(name)

    def counts(self) -> dict[str, int]:
        """Number of points of each name, in the order of ``names``; the remaining points are unknown."""
        counts = np.bincount(self.labels + 1, minlength=len(self.names) + 1)[1:]
        return dict(zip(self.names, counts.tolist(), strict=True))

    def unknown_because(self) -> dict[Reason, int]:
        """Number of points without a label for each reason; reasons without points are left out."""
        counts = np.bincount(self.reasons, minlength=len(Reason))
        return {reason: int(counts[reason]) for reason in Reason if reason != Reason.LABELLED and counts[reason]}

    @property
    def colors(self) -> NDArray[np.uint8]:
        """(N, 3) uint8 RGB: one color per label, gray where unknown."""
        return label_colors(self.labels)

    @property
    def attributes(self) -> dict[str, NDArray[Any]]:
        """Per-point attributes of hosts and files: (N,) arrays, with the same names in all of them.

        og_label, og_instance int32, og_score float32, og_reason uint8, as some formats have no int8.
        """
        return {
            "og_label": self.labels,
            "og_instance": self.instances,
            "og_score": self.scores,
            "og_reason": self.reasons.astype(np.uint8),
        }

    def to_open3d(self) -> Any:
        """An Open3D tensor cloud: positions, colors, and the `attributes` as (N, 1). Needs the extra 'open3d'."""
        return import_plugin("og_pointcloud_open3d", "open3d").to_open3d(self)

    def to_pyvista(self) -> Any:
        """A PyVista PolyData with the `attributes`, colors, names and scene. Needs the extra 'pyvista'."""
        return import_plugin("og_pointcloud_pyvista", "pyvista").to_pyvista(self)

    def to_pointcloud2(self, frame_id: str = "map", stamp: Any = None) -> Any:
        """A sensor_msgs/PointCloud2 message with the labels in its fields. Needs the extra 'ros'."""
        return import_plugin("og_pointcloud_ros", "ros").to_pointcloud2(self, frame_id=frame_id, stamp=stamp)

    def save(self, path: StrPath, splats: Points | None = None, source: StrPath | None = None) -> Path:
        """Write the result atomically, in the format of the path's suffix.

        .npz: labels, scores, instances, reasons, names and calibrated, and certainty if it is known.
        .ply: a colored cloud with the `attributes`.
        .las, .laz: with colors, classification and the attributes as extra bytes (needs the extra 'las').
        .glb: colored points, or splats, with feature ids and names.
        .spz: splats in the labels' colors; the format cannot hold labels.
        splats: the Gaussians, row by row, if the query points were Gaussians: `read_points` of their file. Only .glb
            and .spz keep them.
        source: the file that was labelled, without a pose. From .las or .laz to .las or .laz, its point attributes and
            coordinate system are kept, and only labels are added.
        OgPointcloudError for another suffix; SceneError if the format cannot hold the points: .las and .glb cannot hold
        NaN, .glb no empty cloud.
        """
        if not isinstance(path, (str, os.PathLike)):
            raise OgPointcloudError(
                f"the file to save is {path!r:.80}; expected a name that ends in one of {', '.join(SAVED_AS)}"
            )
        path, columns = Path(path), (self.xyz, self.colors, self.attributes, self.names)
        if path.suffix not in SAVED_AS:
            raise OgPointcloudError(f"'{path}' ends in '{path.suffix}'; expected one of {', '.join(SAVED_AS)}")
        if splats is not None and not isinstance(splats, Points):
            raise OgPointcloudError(f"splats are a {type(splats).__name__}; expected those that og.read_points gives")
        if splats is not None and path.suffix not in SPLATS_SAVED_AS:
            raise OgPointcloudError(
                f"'{path}' would not keep the splats; expected a name that ends in {' or '.join(SPLATS_SAVED_AS)}: or "
                "leave splats out for points with labels"
            )
        if path.suffix == ".npz":
            self._save_arrays(path)
        elif path.suffix == ".spz":
            self._save_spz(path, splats)
        elif path.suffix == ".glb":
            from og_pointcloud.formats.gltf import write_gltf

            write_gltf(path, *columns, splats)
        elif path.suffix == ".ply":
            from og_pointcloud.formats.points import write_labelled_ply

            write_labelled_ply(path, *columns)
        else:
            from og_pointcloud.formats.las import write_las

            write_las(path, *columns, source)
        return path

    def _save_spz(self, path: Path, splats: Points | None) -> None:
        from og_pointcloud.formats.spz import write_spz

        if splats is None or len(splats.xyz) != len(self):
            raise OgPointcloudError(f"{path} stores only splats; expected those that were labelled (--points S.ply)")
        write_spz(path, splats, self.colors)

    def _save_arrays(self, path: Path) -> None:
        arrays: dict[str, Any] = {
            "labels": self.labels,
            "scores": self.scores,
            "instances": self.instances,
            "reasons": self.reasons,
            "names": np.array(self.names, str),
            "calibrated": np.array(self.calibrated),
        }
        if self.certainty is not None:
            arrays["certainty"] = self.certainty
        with replacing(path) as file:
            np.savez(file, **arrays)
