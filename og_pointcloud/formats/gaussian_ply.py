"""3D Gaussian splatting PLY files -> Points: scales linear, rotations unit wxyz, opacities in [0, 1], base color.

Two layouts. *Trained* (Inria, gsplat, nerfstudio, OpenGaussian): one float property per value, before activation: log
scale, logit opacity, quaternion of any length, color as the constant spherical harmonic. *Compressed* (SuperSplat): an
element ``chunk`` with the bounds of every 256 splats, and four packed 32-bit words per splat. Higher harmonics,
instance features and normals are not read: nothing here renders view-dependent color.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.ply import join_columns
from og_pointcloud.formats.tables import colors, positions, stack_columns, storable_positions
from og_pointcloud.scene import DoubleArray, FloatArray, Points

SH_CONSTANT = 0.28209479177387814
"""The spherical harmonic of degree 0, 1 / (2 sqrt(pi)): color = 0.5 + SH_CONSTANT * f_dc."""
SPLATS_PER_CHUNK = 256
MAX_RATIO, ALWAYS_ALLOWED_BYTES = 20, 1 << 24
"""A file may unpack to this many times its size, or to this many bytes."""

BASE_COLOR = ("f_dc_0", "f_dc_1", "f_dc_2")
LOG_SCALE = ("scale_0", "scale_1", "scale_2")
ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")

Elements = Mapping[str, NDArray[np.void]]


class Splats(NamedTuple):
    """The Gaussians of a file. points: those whose values are all finite. finite: (n,) bool, the rows of the file that
    became points. others: says how many rows did not; "" if none."""

    points: Points
    finite: NDArray[np.bool_]
    others: str


def latest_iteration(folder: Path) -> Path | None:
    """The last .ply that a training run saved: point_cloud/iteration_N/point_cloud.ply with the largest N."""
    iterations = {
        int(match.group(1)): file
        for file in folder.glob("point_cloud/iteration_*/point_cloud.ply")
        if (match := re.fullmatch(r"iteration_(\d+)", file.parent.name))
    }
    return iterations[max(iterations)] if iterations else None


def gaussian_rows(points: Points) -> NDArray[np.void]:
    """(n,) records in the trained layout of degree 0, world coordinates, for the element "vertex" of a 3DGS file.

    Positions are float64 where float32 would lose more than 1e-6 of the extent. Scale 0 and opacities 0 and 1 become
    the nearest finite logarithm and logit, so that any reader survives them. Without rgb the splats are mid-gray.
    """
    scale, rotation, opacity = points.gaussians
    smallest = np.finfo(np.float32).smallest_normal
    # 1 - 2^-24 is the largest float32 below 1.
    opacity = np.clip(opacity.astype(np.float64), 2.0**-24, 1 - 2.0**-24)
    rgb = np.full(points.xyz.shape, 127.5) if points.rgb is None else points.rgb
    groups = {
        ("x", "y", "z"): storable_positions(points.xyz_world),
        ("nx", "ny", "nz"): np.zeros_like(points.xyz),
        BASE_COLOR: ((rgb / 255 - 0.5) / SH_CONSTANT).astype(np.float32),
        ("opacity",): np.log(opacity / (1 - opacity)).astype(np.float32)[:, None],
        LOG_SCALE: np.log(np.maximum(scale, smallest)),
        ROTATION: rotation,
    }
    return join_columns({name: values[:, i] for names, values in groups.items() for i, name in enumerate(names)})


def holds_gaussians(elements: Elements) -> bool:
    """Whether a PLY's elements are Gaussians in either layout, rather than a plain cloud."""
    return _are_compressed(elements) or not {"scale_0", "rot_0"}.isdisjoint(_names(elements))


def gaussians_from_ply(elements: Elements) -> Splats:
    """Gaussians from the elements of a trained or compressed 3DGS file; world coordinates, the median as origin.

    A zero quaternion is no rotation. Opacity logits of +-inf are 1 and 0, a log scale of -inf is 0: some converters
    write them for splats that are fully opaque, invisible or flat. Any other value that is not finite, and a log scale
    above 88.7, whose exponential overflows float32, leaves out its Gaussian. SceneError where a property is missing.
    """
    if "vertex" not in elements:
        raise SceneError(f"no element 'vertex' of plain properties; the file has {', '.join(elements) or 'none':.200}")
    return _compressed(elements) if _are_compressed(elements) else _trained(elements["vertex"])


def _are_compressed(elements: Elements) -> bool:
    return "chunk" in elements and "packed_position" in _names(elements)


def _names(elements: Elements) -> tuple[str, ...]:
    """Names of the vertex properties; empty without vertices."""
    return elements["vertex"].dtype.names or () if "vertex" in elements else ()


def _trained(vertex: NDArray[np.void]) -> Splats:
    with np.errstate(over="ignore"):
        scale = np.exp(stack_columns(vertex, LOG_SCALE)).astype(np.float32)
    # The logistic function as tanh, which cannot overflow.
    opacity = 0.5 + 0.5 * np.tanh(0.5 * stack_columns(vertex, ("opacity",))[:, 0])
    if "f_dc_0" in (vertex.dtype.names or ()):
        color = 0.5 + SH_CONSTANT * stack_columns(vertex, BASE_COLOR)
    else:  # nerfstudio's exporter can write red, green, blue instead
        rgb = colors(vertex)
        color = None if rgb is None else rgb / 255
    return activated(positions(vertex), scale, stack_columns(vertex, ROTATION), opacity, color)


def _compressed(elements: Elements) -> Splats:
    vertex, chunk = elements["vertex"], elements["chunk"]
    expected = -(-len(vertex) // SPLATS_PER_CHUNK)
    if len(chunk) != expected:
        raise SceneError(
            f"{len(vertex)} packed splats in {len(chunk)} chunks of {SPLATS_PER_CHUNK}; expected {expected} chunks: "
            "the file is damaged"
        )
    # Each word holds its fields from the highest bit down, as fractions of the range between the chunk's bounds.
    words = {}
    for name in ("packed_position", "packed_rotation", "packed_scale", "packed_color"):
        if name not in (vertex.dtype.names or ()) or vertex.dtype[name] != np.uint32:
            raise SceneError(f"element 'vertex' has no property '{name}' of type uint; expected a SuperSplat file")
        words[name] = np.ascontiguousarray(vertex[name])

    xyz = _between(chunk, ("x", "y", "z"), _unpack(words["packed_position"]))
    log_scale = _between(chunk, ("scale_x", "scale_y", "scale_z"), _unpack(words["packed_scale"]))
    rgba = _unpack(words["packed_color"], bits=(8, 8, 8, 8))
    color = rgba[:, :3]
    if "min_r" in (chunk.dtype.names or ()):  # since SuperSplat 2; earlier versions have no color bounds
        color = _between(chunk, ("r", "g", "b"), color)
    with np.errstate(over="ignore"):
        scale = np.exp(log_scale).astype(np.float32)
    # Two bits name the largest of w, x, y, z; the others have ten each, for +-1/sqrt(2).
    # The largest component of a unit quaternion follows from the others, none of which exceeds 1/sqrt(2).
    others = (_unpack(words["packed_rotation"], bits=(2, 10, 10, 10))[:, 1:] - 0.5) * np.sqrt(2)
    rotation = from_smallest_three(words["packed_rotation"] >> 30, others)
    return activated(xyz, scale, rotation, rgba[:, 3], color)


def _unpack(words: NDArray[np.uint32], bits: tuple[int, ...] = (11, 10, 11)) -> DoubleArray:
    """Fields of ``bits`` bits, highest first, as (n, len(bits)) fractions in [0, 1] of a field's largest value."""
    shares = np.empty((len(words), len(bits)))
    shift = sum(bits)
    for column, width in enumerate(bits):
        shift -= width
        largest = (1 << width) - 1
        shares[:, column] = (words >> shift & largest) / largest
    return shares


def _between(chunk: NDArray[np.void], names: tuple[str, ...], share: DoubleArray) -> DoubleArray:
    """(n, len(names)) values interpolated by ``share`` from the minimum to the maximum of each splat's chunk."""
    minimum, maximum = (stack_columns(chunk, [f"{end}_{name}" for name in names]) for end in ("min", "max"))
    of_splat = np.arange(len(share)) // SPLATS_PER_CHUNK
    with np.errstate(invalid="ignore"):  # infinite bounds give NaN, which is reported as such
        return minimum[of_splat] + (maximum - minimum)[of_splat] * share


def unpacked_limit(packed: int) -> int:
    """Bytes that a packed file of so many may unpack to: quantized noise, as splats are, compresses to half."""
    return max(ALWAYS_ALLOWED_BYTES, MAX_RATIO * packed)


def from_smallest_three(largest: NDArray[np.integer], others: DoubleArray) -> DoubleArray:
    """(n, 4) unit quaternions. largest: (n,) index of the largest component, which is positive; others: (n, 3), the
    other components in order."""
    quaternions, is_largest = np.empty((len(others), 4)), np.arange(4) == largest[:, None]
    quaternions[is_largest] = np.sqrt(np.maximum(0.0, 1 - np.square(others).sum(axis=1)))
    quaternions[~is_largest] = others.ravel()
    return quaternions


def activated(
    xyz: DoubleArray,
    scale: FloatArray,
    rotation: DoubleArray,
    opacity: DoubleArray,
    color: DoubleArray | None,
) -> Splats:
    """Splats from activated values, quaternions wxyz (n, 4) of any length, and colors around [0, 1], which are clipped.
    SceneError where no row is finite."""
    parts = {"position": xyz, "scale": scale, "rotation": rotation, "opacity": opacity[:, None]}
    if color is not None:
        parts["color"] = color
    placed, finite, others = xyz, np.ones(len(xyz), bool), ""
    if not all(np.isfinite(values).all() for values in parts.values()):
        # Checked by row only now: find the first such Gaussian, and which of its values.
        by_part = {name: np.isfinite(values).all(axis=1) for name, values in parts.items()}
        finite = np.logical_and.reduce(list(by_part.values()))
        first = int(np.argmin(finite))
        blamed = next(name for name in by_part if not by_part[name][first])
        others = f"{int((~finite).sum())} of {len(finite)} Gaussians are not finite (the first is row {first}, in its "
        others += f"{blamed})"
        if not finite.any():
            raise SceneError(f"{others}; expected finite values, and log scales below 88.7: export it again")
        placed, scale, rotation, opacity = xyz[finite], scale[finite], rotation[finite], opacity[finite]
        color = None if color is None else color[finite]
    length = np.linalg.norm(rotation, axis=1, keepdims=True)
    # The rotation matrix formula gives the identity for a zero quaternion, so renderers show such splats unrotated.
    unit = np.divide(rotation, length, out=np.tile([1.0, 0.0, 0.0, 0.0], (len(rotation), 1)), where=length > 0)
    rgb = None if color is None else np.rint(np.clip(color, 0, 1) * 255).astype(np.uint8)
    points = Points.from_world(
        placed, rgb=rgb, scale=scale, rotation=unit.astype(np.float32), opacity=opacity.astype(np.float32)
    )
    return Splats(points, finite, others)
