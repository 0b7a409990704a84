"""Spherical harmonics of 3D Gaussian splatting, turned with the splats they belong to.

A splat's colour seen along a direction d is 0.5 + sum_k c_k Y_k(d), Y_k real spherical harmonics with the
Condon-Shortley sign, in the order l = 0, 1, .., m = -l .. l. Turning a splat mixes the coefficients of each degree
among themselves: the colour that was seen along d is then seen along R d.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["MAX_DEGREE", "rotated_harmonics"]

MAX_DEGREE = 3
"""Highest degree that files have."""
DIRECTIONS = 32


def rotated_harmonics(rest: NDArray[np.floating], rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Coefficients of splats that are turned. rotation: (3, 3), of column vectors.

    rest: (n, channels, k), k = 0, 3, 8 or 15: degrees 1 up to 3, without the constant. The same shape comes back.
    """
    turned = np.array(rest, np.float64)
    directions = np.random.default_rng(0).normal(size=(DIRECTIONS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    start = 0
    for degree in range(1, MAX_DEGREE + 1):
        end = start + 2 * degree + 1
        if end > rest.shape[2]:
            break
        # Turned harmonics of one degree are mixtures of that degree, Y(R' d) = Y(d) M: any few directions give M.
        seen_before, seen_after = _harmonics(directions @ rotation, degree), _harmonics(directions, degree)
        mixing = np.linalg.lstsq(seen_after, seen_before, rcond=None)[0]
        turned[..., start:end] = rest[..., start:end] @ mixing.T
        start = end
    return turned


def _harmonics(directions: NDArray[np.float64], degree: int) -> NDArray[np.float64]:
    """(n, 2 degree + 1) real spherical harmonics of unit vectors (n, 3), m = -degree .. degree."""
    x, y, z = directions.T
    pi = np.pi
    if degree == 1:
        a = np.sqrt(3 / (4 * pi))
        columns = [-a * y, a * z, -a * x]
    elif degree == 2:
        a, b = np.sqrt(15 / (4 * pi)), np.sqrt(5 / (16 * pi))
        columns = [a * x * y, -a * y * z, b * (3 * z**2 - 1), -a * x * z, a / 2 * (x**2 - y**2)]
    else:
        a, b = np.sqrt(35 / (32 * pi)), np.sqrt(105 / (4 * pi))
        c, d = np.sqrt(21 / (32 * pi)), np.sqrt(7 / (16 * pi))
        columns = [
            -a * y * (3 * x**2 - y**2), b * x * y * z, -c * y * (5 * z**2 - 1), d * z * (5 * z**2 - 3),
            -c * x * (5 * z**2 - 1), b / 2 * z * (x**2 - y**2), -a * x * (x**2 - 3 * y**2),
        ]  # fmt: skip
    return np.stack(columns, axis=1)
