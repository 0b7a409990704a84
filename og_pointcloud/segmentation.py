"""What a segment call returns: a label, score and instance per point, and ways to look at it."""

from __future__ import annotations

import importlib
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud._atomic import replacing
from og_pointcloud.choosing import Reason
from og_pointcloud.clouds import SCENE_FIELD
from og_pointcloud.errors import MissingExtraError, OgPointcloudError

__all__ = ["UNKNOWN", "UNKNOWN_COLOR", "Reason", "Segmentation", "label_colors"]

UNKNOWN = -1
"""Label of a point that none of the names is known to fit."""
UNKNOWN_COLOR = (128, 128, 128)
GOLDEN_RATIO = 0.618033988749895


@dataclass(frozen=True)
class Segmentation:
    """One row a point, in the order of the points asked about.

    xyz: (N, 3) float64, world coordinates. labels: (N,) int32, row of ``names``, -1 unknown.
    scores: (N,) float32, 0 where unknown; else, if ``calibrated``, the probability that the point is what its label
        says; if not, the cosine of the label's text with the instance's descriptor, which has no such meaning.
    instances: (N,) int32, the scene's instance id, -1 background, -2 unobserved, -3 too far from the scene.
    names: the labels asked for. scene: the .ogpc file that answered, None for one in memory.
    distance: (N,) int8, 0 on the scene's surface, 1 near it, 2 too far from it; between 0 and 1 to about a point
        spacing, as one table cell speaks for all points in it.
    reasons: (N,) int8, why a point is unknown: a ``Reason``, 0 where it has a label.
    calibrated: whether the scene has a word bank to judge labels by. Without one the best label is answered, however
        badly it fits: then nothing is unknown for Reason.NONE_FITS, unless negatives were asked against.
    """

    xyz: NDArray[np.float64]
    labels: NDArray[np.int32]
    scores: NDArray[np.float32]
    instances: NDArray[np.int32]
    names: tuple[str, ...]
    scene: Path | None = None
    distance: NDArray[np.int8] = field(default_factory=lambda: np.zeros(0, np.int8))
    reasons: NDArray[np.int8] = field(default_factory=lambda: np.zeros(0, np.int8))
    calibrated: bool = False

    def __post_init__(self) -> None:
        for name in ("distance", "reasons"):
            count = len(getattr(self, name))
            if count != len(self.labels):
                raise OgPointcloudError(
                    f"{len(self.labels)} labels and {count} {name} differ in number; expected one of each a point"
                )

    def __len__(self) -> int:
        return len(self.labels)

    def mask(self, name: str) -> NDArray[np.bool_]:
        """(N,) bool, the points with this label."""
        if name not in self.names:
            raise OgPointcloudError(f"'{name}' was not asked for; the labels are {', '.join(self.names)}")
        return self.labels == self.names.index(name)

    def counts(self) -> dict[str, int]:
        """Points of each name, in the order of ``names``; the remaining ones are unknown."""
        counts = np.bincount(self.labels + 1, minlength=len(self.names) + 1)[1:]
        return dict(zip(self.names, counts.tolist(), strict=True))

    def unknown_because(self) -> dict[Reason, int]:
        """Points without a label by the reason for it, reasons that no point has left out."""
        counts = np.bincount(self.reasons, minlength=len(Reason))
        return {reason: int(counts[reason]) for reason in Reason if reason != Reason.LABELLED and counts[reason]}

    @property
    def colors(self) -> NDArray[np.uint8]:
        """(N, 3) uint8 RGB: a colour a label, grey where unknown."""
        return label_colors(self.labels)

    def to_open3d(self) -> Any:
        """An Open3D tensor cloud: positions, colors, and label, score, instance, reason as (N, 1) attributes."""
        open3d = _import_host("open3d")
        cloud = open3d.t.geometry.PointCloud()
        cloud.point["positions"] = open3d.core.Tensor(self.xyz)
        cloud.point["colors"] = open3d.core.Tensor(self.colors.astype(np.float32) / 255)
        for name, values in self._columns().items():
            # A one-dimensional attribute makes Open3D's own filters fail.
            cloud.point[name] = open3d.core.Tensor(np.ascontiguousarray(values[:, None]))
        return cloud

    def to_pyvista(self) -> Any:
        """A PyVista PolyData: point arrays label, score, instance, reason and colors, field array names."""
        pyvista = _import_host("pyvista")
        mesh = pyvista.PolyData(self.xyz) if len(self) else pyvista.PolyData()
        if len(self):  # empty arrays are refused
            for name, values in self._columns().items():
                mesh.point_data[name] = values
            mesh.point_data["colors"] = self.colors
        mesh.field_data["names"] = list(self.names)
        if self.scene is not None:
            mesh.field_data[SCENE_FIELD] = [str(self.scene.resolve())]
        return mesh

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write an .npz of labels, scores, instances, reasons, names and calibrated, or a coloured .ply.

        Whole or not at all.
        """
        path = Path(path)
        if path.suffix == ".npz":
            with replacing(path) as file:
                np.savez(
                    file,
                    labels=self.labels,
                    scores=self.scores,
                    instances=self.instances,
                    reasons=self.reasons,
                    names=np.array(self.names, str),
                    calibrated=np.array(self.calibrated),
                )
        elif path.suffix == ".ply":
            from og_pointcloud.formats.points import write_labelled_ply

            write_labelled_ply(path, self.xyz, self.colors, self.instances, self.labels, self.scores)
        else:
            raise OgPointcloudError(f"'{path}' ends in '{path.suffix}'; expected a name that ends in .npz or .ply")
        return path

    def _columns(self) -> dict[str, NDArray[Any]]:
        return {"label": self.labels, "score": self.scores, "instance": self.instances, "reason": self.reasons}


def label_colors(labels: NDArray[np.integer]) -> NDArray[np.uint8]:
    """(N, 3) uint8 RGB. The colour of a label depends on its number alone; neighbours in number differ in hue."""
    count = int(labels.max(initial=UNKNOWN)) + 1
    palette = np.array([UNKNOWN_COLOR, *(_color(label) for label in range(count))], np.uint8)
    return palette[np.maximum(labels, UNKNOWN) + 1]


def _color(label: int) -> tuple[int, int, int]:
    import colorsys

    hue = (0.02 + label * GOLDEN_RATIO) % 1.0
    saturation, value = ((0.75, 0.95), (0.45, 0.95), (0.85, 0.65))[label // 8 % 3]
    red, green, blue = colorsys.hsv_to_rgb(hue, saturation, value)
    return round(255 * red), round(255 * green), round(255 * blue)


def _import_host(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        raise MissingExtraError(name, extra=name) from None
