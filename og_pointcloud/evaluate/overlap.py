"""Intersection over union of boxes in space, exact: along the axes, and turned."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.ask.boxes import Box
from og_pointcloud.errors import OgPointcloudError

__all__ = ["aligned_iou", "oriented_iou"]

Doubles = NDArray[np.float64]

SAME_PLANE = 1e-9
"""Share of the boxes' size below which two faces lie in one plane."""


def aligned_iou(first: NDArray[np.floating], second: NDArray[np.floating]) -> Doubles:
    """(P, T) IoU of boxes (P, 2, 3) and (T, 2, 3), lowest and highest corners. Two boxes without volume have IoU 0."""
    a, b = np.asarray(first, np.float64), np.asarray(second, np.float64)
    for boxes in (a, b):
        if boxes.ndim != 3 or boxes.shape[1:] != (2, 3) or (boxes[:, 1] < boxes[:, 0]).any():
            raise OgPointcloudError(f"boxes are {boxes.shape}; expected (n, 2, 3), lowest corners, then highest")
    low = np.maximum(a[:, None, 0], b[None, :, 0])
    high = np.minimum(a[:, None, 1], b[None, :, 1])
    shared = np.prod(np.maximum(high - low, 0.0), axis=2)
    union = np.prod(a[:, 1] - a[:, 0], axis=1)[:, None] + np.prod(b[:, 1] - b[:, 0], axis=1)[None, :] - shared
    return np.divide(shared, union, out=np.zeros_like(shared), where=union > 0)


def oriented_iou(first: Box, second: Box) -> float:
    """IoU of two turned boxes; 0 where one has no volume.

    The volume of the intersection is summed over its faces (divergence theorem): every face of it lies in a face of one
    box, clipped by the other. Faces in one plane are counted once.
    """
    volumes = first.volume, second.volume
    if min(volumes) <= 0:
        return 0.0
    slack = SAME_PLANE * float(max(first.size.max(), second.size.max()))
    shared = _flux(first, second, 0.0, first.center) + _flux(second, first, slack, first.center)
    shared = min(max(shared, 0.0), *volumes)
    return shared / (sum(volumes) - shared)


def _planes(box: Box) -> list[tuple[Doubles, float]]:
    """Outward normals n and offsets d: inside is n x <= d."""
    return [
        (sign * axis, float(sign * (axis @ box.center) + length / 2))
        for axis, length in zip(box.axes, box.size, strict=True)
        for sign in (-1.0, 1.0)
    ]


def _faces(box: Box) -> list[tuple[Doubles, Doubles]]:
    """Six polygons (4, 3), each with its outward normal."""
    faces = []
    for index in range(3):
        across, up = (box.axes[k] * box.size[k] / 2 for k in ((index + 1) % 3, (index + 2) % 3))
        for sign in (-1.0, 1.0):
            middle = box.center + sign * box.axes[index] * box.size[index] / 2
            corners = (middle - across - up, middle + across - up, middle + across + up, middle - across + up)
            faces.append((np.stack(corners), sign * box.axes[index]))
    return faces


def _flux(box: Box, clipping: Box, inward: float, about: Doubles) -> float:
    """A third of the flux of x - about through the box's faces inside the other box (drawn in by ``inward`` where a
    face of it lies in the same plane and looks the same way)."""
    total = 0.0
    for polygon, normal in _faces(box):
        for plane, offset in _planes(clipping):
            same_way = plane @ normal > 1 - SAME_PLANE
            polygon = _clipped(polygon, plane, offset - inward if same_way else offset)
        total += _area(polygon, normal) * float(normal @ (polygon[0] - about)) / 3 if len(polygon) >= 3 else 0.0
    return total


def _clipped(polygon: Doubles, normal: Doubles, offset: float) -> Doubles:
    """The part of a convex polygon (k, 3) with n x <= d (Sutherland and Hodgman)."""
    if len(polygon) == 0:
        return polygon
    height = polygon @ normal - offset
    corners = []
    for index in range(len(polygon)):
        here, there = height[index - 1], height[index]
        if (here <= 0) != (there <= 0):
            corners.append(polygon[index - 1] + (polygon[index] - polygon[index - 1]) * here / (here - there))
        if there <= 0:
            corners.append(polygon[index])
    return np.array(corners).reshape(-1, 3)


def _area(polygon: Doubles, normal: Doubles) -> float:
    edges = polygon[1:] - polygon[0]
    return abs(float(np.cross(edges[:-1], edges[1:]).sum(axis=0) @ normal)) / 2
