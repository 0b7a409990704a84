"""Solids of furniture: boxes, turned shapes and cushions as triangle meshes with a two-color grained material.

Lengths in meters, z up. A part stands on the origin of its own frame unless given another base. Corners lie on a
micrometer grid, so that the last bit of a sine, which depends on the processor, does not move them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

SEGMENTS = 28
"""Facets around a turned or cushioned shape: round to the eye at two meters."""
GRID = 2.0**-20
"""Grid spacing of corners in meters; float32 represents the whole grid within 8 m of the origin."""


@dataclass(frozen=True)
class Material:
    """Two RGB colors in [0, 1], mixed by value noise; grain: size of its blobs along x, y, z in meters."""

    color: tuple[float, float, float]
    second: tuple[float, float, float]
    grain: tuple[float, float, float]


@dataclass(frozen=True)
class Part:
    """One closed solid. vertices: (V, 3) float64 meters, rounded to the grid; triangles: (T, 3) int32, any winding."""

    vertices: NDArray[np.float64]
    triangles: NDArray[np.int32]
    material: Material

    def __post_init__(self) -> None:
        object.__setattr__(self, "vertices", np.round(self.vertices / GRID) * GRID)

    def moved(self, offset: ArrayLike, yaw: float = 0.0) -> Part:
        """Turned by ``yaw`` radians about z, then shifted by ``offset`` (3,)."""
        return self.turned(rotation_about("z", yaw), offset)

    def turned(self, rotation: NDArray[np.float64], offset: ArrayLike = (0.0, 0.0, 0.0)) -> Part:
        """Turned by ``rotation`` (3, 3) about the origin, then shifted by ``offset`` (3,)."""
        return replace(self, vertices=rotated(self.vertices, rotation) + np.asarray(offset, np.float64))


def rotated(xyz: NDArray[np.float64], rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 3) points turned by ``rotation`` (3, 3), summed in the same order everywhere, unlike a matrix product."""
    x, y, z = rotation.T
    return xyz[:, :1] * x + xyz[:, 1:2] * y + xyz[:, 2:] * z


def rotation_about(axis: str, angle: float) -> NDArray[np.float64]:
    """(3, 3) right-handed rotation by ``angle`` radians about the axis "x", "y" or "z"."""
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    rotation = np.eye(3)
    rotation[i, i] = rotation[j, j] = np.cos(angle)
    rotation[j, i] = np.sin(angle)
    rotation[i, j] = -rotation[j, i]
    return rotation


def box(size: Sequence[float], base: Sequence[float], material: Material) -> Part:
    """Axis-aligned box of ``size`` (x, y, z) whose bottom face is centered on ``base``."""
    corners = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.0)])
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [triangle for a, b, c, d in faces for triangle in ((a, b, c), (a, c, d))]
    return Part(corners * np.asarray(size) + np.asarray(base), np.array(triangles, np.int32), material)


def lathe(profile: Sequence[tuple[float, float]], base: Sequence[float], material: Material) -> Part:
    """Turned solid: ``profile`` lists (radius, height) from axis to axis (first and last radius 0)."""
    radius, height = np.array(profile, np.float64).T
    angle = np.linspace(0, 2 * np.pi, SEGMENTS, endpoint=False)
    x, y = radius[:, None] * np.cos(angle), radius[:, None] * np.sin(angle)
    rings = np.stack([x, y, np.broadcast_to(height[:, None], x.shape)], axis=2)
    return Part(rings.reshape(-1, 3) + np.asarray(base), _ring_triangles(len(profile)), material)


def cushion_shape(size: Sequence[float], base: Sequence[float], material: Material, squareness: float = 0.35) -> Part:
    """Superellipsoid that fills the box ``size`` standing on ``base``; squareness 1 is an ellipsoid, 0 a box."""
    latitude = np.linspace(-np.pi / 2, np.pi / 2, SEGMENTS // 2 + 1)[:, None]
    longitude = np.linspace(-np.pi, np.pi, SEGMENTS, endpoint=False)[None]

    def bent(value: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.sign(value) * np.abs(value) ** squareness

    x = bent(np.cos(latitude)) * bent(np.cos(longitude))
    y = bent(np.cos(latitude)) * bent(np.sin(longitude))
    z = bent(np.sin(latitude)) + 0.0 * longitude
    unit = np.stack([x, y, z], axis=2).reshape(-1, 3) / 2 + (0.0, 0.0, 0.5)
    return Part(unit * np.asarray(size) + np.asarray(base), _ring_triangles(len(latitude)), material)


def _ring_triangles(rings: int) -> NDArray[np.int32]:
    """Triangles between consecutive rings of SEGMENTS vertices each."""
    ring, step = np.meshgrid(np.arange(rings - 1), np.arange(SEGMENTS), indexing="ij")
    a = ring * SEGMENTS + step
    b = ring * SEGMENTS + (step + 1) % SEGMENTS
    lower, upper = np.stack([a, b, a + SEGMENTS], axis=2), np.stack([b, b + SEGMENTS, a + SEGMENTS], axis=2)
    return np.concatenate([lower.reshape(-1, 3), upper.reshape(-1, 3)]).astype(np.int32)
