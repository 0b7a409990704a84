"""Edits of the columns of a cloud or 3DGS file: recolor, transform to another frame, append.

A splat's color seen along a direction d is 0.5 + sum_k c_k Y_k(d), Y_k real spherical harmonics with the
Condon-Shortley sign, in the order l = 0, 1, .., m = -l .. l. Rotating a splat mixes coefficients within each degree:
the color that was seen along d is then seen along R d.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.colors import LUMINANCE
from og_pointcloud.formats.gaussian_ply import BASE_COLOR, LOG_SCALE, ROTATION, SH_CONSTANT
from og_pointcloud.formats.ply import join_columns
from og_pointcloud.formats.poses import quaternion_of
from og_pointcloud.formats.tables import colors, positions, stack_columns, storable_positions
from og_pointcloud.scene import DoubleArray

Rows: TypeAlias = NDArray[np.void]
Columns: TypeAlias = dict[str, NDArray[Any]]

NORMAL_COLUMNS = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"))
RGB = ("red", "green", "blue")
COLORS = (*RGB, "r", "g", "b", "diffuse_red", "diffuse_green", "diffuse_blue", "rgb", "rgba")
"""All names of color columns, which are replaced by RGB of type uchar."""
MIN_MEAN_LUMINANCE = 0.05
"""Mean luminance below which an object's shading is too faint to be kept at full strength in a new color."""
MAX_DEGREE = 3
"""Highest degree of spherical harmonics in files."""


def recolored(rows: Rows, chosen: NDArray[np.bool_], color: DoubleArray) -> Rows:
    """The rows with the chosen ones in another color, as harmonics, red green blue, or both; a plain cloud without
    colors becomes gray. color: (3,), 0 to 1; it becomes the object's mean color, and the object keeps its shading."""
    columns, rgb = _columns(rows), colors(rows)
    is_splat = set(BASE_COLOR) <= set(columns)
    if is_splat:
        # Color is linear in the coefficients, so a linear map of colors acts on the coefficients too.
        base = 0.5 + SH_CONSTANT * stack_columns(rows, BASE_COLOR)[chosen]
        mapping, added = _color_map(np.clip(base, 0, 1), color)
        _set(columns, BASE_COLOR, (base @ mapping.T + added - 0.5) / SH_CONSTANT, chosen)
        _set(columns, _rest_names(rows), np.einsum("dc,nck->ndk", mapping, _rest(rows)[chosen]), chosen)
    elif rgb is None:
        rgb = np.full((len(rows), 3), 128, np.uint8)
    if rgb is not None:
        base = rgb[chosen] / 255
        mapping, added = _color_map(base, color)
        rgb[chosen] = np.rint(255 * np.clip(base @ mapping.T + added, 0, 1)).astype(np.uint8)
        columns = _in_bytes(columns, rgb)
    return join_columns(columns)


def placed(rows: Rows, rotation: DoubleArray, scale: float, translation: DoubleArray) -> tuple[Rows, tuple[str, ...]]:
    """The rows in another frame, x -> scale * rotation @ x + translation; and notes of what could not be transformed.

    Positions become float64. Normals, rotations and scales of Gaussians and their harmonics are transformed too.
    """
    columns = _columns(rows)
    columns |= dict(zip("xyz", (positions(rows) @ (scale * rotation).T + translation).T, strict=True))
    for normal in NORMAL_COLUMNS:
        if set(normal) <= set(columns):
            _set(columns, normal, stack_columns(rows, normal) @ rotation.T)
    scales = [name for name in LOG_SCALE if name in columns]  # logarithms of standard deviations; 2DGS has two
    _set(columns, scales, stack_columns(rows, scales) + np.log(scale))
    if set(ROTATION) <= set(columns):
        _set(columns, ROTATION, _rotated(quaternion_of(rotation), stack_columns(rows, ROTATION)))
    rest = _rest(rows)
    _set(columns, _rest_names(rows), rotated_harmonics(rest, rotation))
    too_high = rest.shape[2] >= (MAX_DEGREE + 1) ** 2
    return join_columns(columns), (f"harmonics above degree {MAX_DEGREE} are not rotated",) if too_high else ()


def appended(base: Rows, added: Rows) -> tuple[Rows, tuple[str, ...]]:
    """The rows of both, with the columns of the first; and notes of what was lost. If the two have colors in different
    columns or types, both become bytes. Positions become float64 if the first's type would move points
    (`storable_positions`), and whole numbers get a wider type if the first's cannot hold the second's."""
    added = _colored_like(base, added)
    first, second = _columns(base), _with_harmonics(added, _rest_names(base))
    places = storable_positions(np.concatenate([positions(base), positions(added)])).dtype
    first |= {axis: first[axis].astype(np.promote_types(first[axis].dtype, places)) for axis in "xyz"}
    zeros, notes = np.zeros(len(added)), []
    types = [[(name, columns[name].dtype) for name in COLORS if name in columns] for columns in (first, second)]
    if types[0] != types[1] and (ours := colors(base)) is not None and (theirs := colors(added)) is not None:
        first, second = _in_bytes(first, ours), _in_bytes(second, theirs)
    merged = {name: _joined(column, second.get(name, zeros)) for name, column in first.items()}
    if widened := [name for name, column in first.items() if merged[name].dtype != column.dtype]:
        notes.append(f"{_listed(widened)} have a wider type: the cloud's cannot hold the inserted values")
    if lacking := [name for name in first if name not in second]:
        notes.append(f"{_listed(lacking)} are 0 for the inserted points, which lack them")
    if dropped := [name for name in _columns(added) if name not in first]:
        notes.append(f"{_listed(dropped)} of the inserted points are left out: the cloud does not have them")
    return join_columns(merged), tuple(notes)


def _joined(column: NDArray[Any], values: NDArray[Any]) -> NDArray[Any]:
    """Both in the column's type; if that is of whole numbers and cannot hold the values, in a wider one that PLY has:
    id 300 would be 44 in a byte."""
    with np.errstate(invalid="ignore"):  # NaN is no whole number
        fitted = values.astype(column.dtype)
    if column.dtype.kind == "f" or np.array_equal(fitted, values):
        return np.concatenate([column, fitted])
    joined = np.concatenate([column, values])
    return joined.astype(np.float64) if joined.dtype == np.int64 else joined


def _colored_like(base: Rows, added: Rows) -> Rows:
    """The added rows with their color as the base has it, as harmonics or as red green blue: nerfstudio's exporter
    writes either."""
    columns, rgb, kept = _columns(added), colors(added), set(base.dtype.names or ())
    is_harmonic = set(BASE_COLOR) <= set(columns)
    if not is_harmonic and rgb is not None and set(BASE_COLOR) <= kept:
        columns = {name: column for name, column in columns.items() if name in kept or name not in COLORS}
        columns |= dict(zip(BASE_COLOR, ((rgb / 255 - 0.5) / SH_CONSTANT).T, strict=True))
    elif is_harmonic and rgb is None and colors(base) is not None:
        color = np.clip(0.5 + SH_CONSTANT * stack_columns(added, BASE_COLOR), 0, 1)
        columns = {name: column for name, column in columns.items() if name in kept or name not in BASE_COLOR}
        columns |= dict(zip(RGB, np.rint(255 * color).astype(np.uint8).T, strict=True))
    return join_columns(columns)


def _in_bytes(columns: Columns, rgb: NDArray[np.uint8]) -> Columns:
    """The columns with colors (n, 3) as red, green, blue of one byte, replacing all color columns of other types."""
    if not all(name in columns and columns[name].dtype == np.uint8 for name in RGB):
        columns = {name: column for name, column in columns.items() if name not in COLORS}
    return columns | dict(zip(RGB, rgb.T, strict=True))


def _color_map(base: DoubleArray, color: DoubleArray) -> tuple[DoubleArray, DoubleArray]:
    """(3, 3) matrix for colors (n, 3), which gives their luminance times the new color; and (3,) offset for colors that
    are too dark for that, so that their mean becomes the new color."""
    mean = float(np.nanmean(base @ LUMINANCE))  # one splat that training left as NaN must not take the others along
    return np.outer(color, LUMINANCE) / max(mean, MIN_MEAN_LUMINANCE), color * max(0.0, 1 - mean / MIN_MEAN_LUMINANCE)


def _rotated(turn: DoubleArray, quaternions: DoubleArray) -> DoubleArray:
    """(n, 4) quaternions wxyz times a rotation from the left (Hamilton); their lengths, which mean nothing, stay."""
    quaternions[~quaternions.any(axis=1), 0] = 1.0  # a zero quaternion is no rotation
    (a, b, c, d), (w, x, y, z) = turn, quaternions.T
    product = [
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    ]
    return np.stack(product, axis=1)


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")


# Columns ----------------------------------------------------------------------------------------------------------


def _columns(rows: Rows) -> Columns:
    return {name: rows[name] for name in rows.dtype.names or ()}


def _set(
    columns: Columns,
    names: Sequence[str],
    values: NDArray[np.floating],
    chosen: NDArray[np.bool_] | slice = slice(None),
) -> None:
    """Set new values (rows, ..) in the chosen rows, one column per name, in the columns' types; arrays are copied, not
    changed in place."""
    for name, column in zip(names, values.reshape(len(values), len(names)).T, strict=True):
        columns[name] = columns[name].copy()
        columns[name][chosen] = column


def _rest_names(rows: Rows) -> list[str]:
    """f_rest_0, f_rest_1, ..: all harmonics of red, then of green, then of blue."""
    present = set(rows.dtype.names or ())
    names = list(itertools.takewhile(present.__contains__, map("f_rest_{}".format, itertools.count())))
    if len(names) % 3:
        raise SceneError(f"{len(names)} f_rest properties; expected a multiple of 3, for three channels")
    return names


def _rest(rows: Rows) -> DoubleArray:
    """(n, 3, k) harmonics above the constant one; k is 0 where there are none."""
    values = stack_columns(rows, _rest_names(rows))
    return values.reshape(len(values), 3, values.shape[1] // 3)


def _with_harmonics(rows: Rows, names: Sequence[str]) -> Columns:
    """The columns with these names for the harmonics: those that the rows lack are 0, higher ones are left out. Which
    one a column holds depends on the file's degree: f_rest_3 is green's first of degree 1, and red's fourth of 3."""
    rest, count, own = _rest(rows), len(names) // 3, _rest_names(rows)
    fitted = np.pad(rest, ((0, 0), (0, 0), (0, max(0, count - rest.shape[2]))))[..., :count]
    others = {name: column for name, column in _columns(rows).items() if name not in own}
    return others | dict(zip(names, fitted.reshape(len(rows), len(names)).T, strict=True))


# Harmonics --------------------------------------------------------------------------------------------------------


def rotated_harmonics(rest: DoubleArray, rotation: DoubleArray) -> DoubleArray:
    """Coefficients of splats rotated by a matrix (3, 3) that acts on column vectors; same shape as rest.

    rest: (n, channels, k), k = 0, 3, 8 or 15: degrees 1 up to 3, without the constant.
    """
    turned, directions = rest.copy(), np.random.default_rng(0).normal(size=(32, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for degree in range(1, MAX_DEGREE + 1):
        block = slice(degree**2 - 1, (degree + 1) ** 2 - 1)
        if block.stop > rest.shape[2]:
            break
        # Rotated harmonics of a degree are linear combinations of it, Y(R' d) = Y(d) M: a few directions give M.
        before, after = _harmonics(directions @ rotation, degree), _harmonics(directions, degree)
        turned[..., block] = rest[..., block] @ np.linalg.lstsq(after, before, rcond=None)[0].T
    return turned


def _harmonics(directions: DoubleArray, degree: int) -> DoubleArray:
    """(n, 2 degree + 1) real spherical harmonics of unit vectors (n, 3), m = -degree .. degree, up to one factor."""
    x, y, z = directions.T
    if degree == 1:
        columns = [-y, z, -x]
    elif degree == 2:
        columns = [x * y, -y * z, (3 * z**2 - 1) / np.sqrt(12), -x * z, (x**2 - y**2) / 2]
    else:
        columns = [
            -y * (3 * x**2 - y**2) / np.sqrt(24), x * y * z, -y * (5 * z**2 - 1) / np.sqrt(40),
            z * (5 * z**2 - 3) / np.sqrt(60),
            -x * (5 * z**2 - 1) / np.sqrt(40), z * (x**2 - y**2) / 2, -x * (x**2 - 3 * y**2) / np.sqrt(24),
        ]  # fmt: skip
    return np.stack(columns, axis=1)
