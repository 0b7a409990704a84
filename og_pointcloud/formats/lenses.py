"""Project rays of the camera to normalized image coordinates, for every supported camera model.

Normalized coordinates times the focal lengths plus the principal point are pixels, so they do not change with the
image's size. x right, y down, z forward; theta is a ray's angle from the axis.

perspective  x/z, y/z, then OpenCV's k1..k6 and p1, p2. ``r8``: coefficient of r^8 (k3 has r^6), which photogrammetry
             calls k4. ``xi``: the ray's length times xi is first added to z (unified model of Mei and Rives, ICRA
             2007: KITTI-360's fisheyes).
fisheye      radius theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8): Kannala and Brandt, OpenCV's fisheye;
             p1, p2 and the thin prism's sx1, sy1 as in COLMAP's THIN_PRISM_FISHEYE.
fov          radius atan(2 r tan(omega / 2)) / omega, r = tan(theta): Devernay and Faugeras 2001.
division     radius d with r = d / (1 + k d^2): Fitzgibbon 2001.
extended     x / (alpha sqrt(beta (x^2 + y^2) + z^2) + (1 - alpha) z): Khomutenko et al. 2016.
spherical    longitude and latitude in radians; the whole sphere, x wraps around.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from og_pointcloud.errors import SceneError
from og_pointcloud.scene import Camera, DoubleArray

Terms = Mapping[str, float]

ANGLES = np.linspace(0.0, np.pi, 4097)[:-1]
"""Angles from the axis, radians, at which a lens's field of view is probed."""


def _perspective(x: DoubleArray, y: DoubleArray, z: DoubleArray, t: Terms) -> tuple[DoubleArray, DoubleArray]:
    z = z + t["xi"] * np.sqrt(x * x + y * y + z * z)  # the unified model; a plain pinhole for xi = 0
    x, y = x / z, y / z
    r2 = x * x + y * y
    radial = 1 + r2 * (t["k1"] + r2 * (t["k2"] + r2 * (t["k3"] + r2 * t["r8"])))
    return _tangential(x, y, r2, radial / (1 + r2 * (t["k4"] + r2 * (t["k5"] + r2 * t["k6"]))), t)


def _fisheye(x: DoubleArray, y: DoubleArray, z: DoubleArray, t: Terms) -> tuple[DoubleArray, DoubleArray]:
    # Scale (x, y) to length theta; on the axis both are 0, whatever the scale.
    radius = np.hypot(x, y)
    scale = np.arctan2(radius, z) / np.maximum(radius, np.finfo(np.float64).tiny)
    x, y = x * scale, y * scale
    r2 = x * x + y * y
    radial = 1 + r2 * (t["k1"] + r2 * (t["k2"] + r2 * (t["k3"] + r2 * t["k4"])))
    x, y = _tangential(x, y, r2, radial, t)
    return x + t["sx1"] * r2, y + t["sy1"] * r2


def _tangential(
    x: DoubleArray, y: DoubleArray, r2: DoubleArray, radial: DoubleArray, t: Terms
) -> tuple[DoubleArray, DoubleArray]:
    """Brown's decentering on top of the radial factor, in OpenCV's order of p1 and p2."""
    p1, p2 = t["p1"], t["p2"]
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y),
    )


def _fov(x: DoubleArray, y: DoubleArray, z: DoubleArray, t: Terms) -> tuple[DoubleArray, DoubleArray]:
    radius = np.hypot(x, y)
    bent = np.arctan2(2 * np.tan(t["omega"] / 2) * radius, z) / t["omega"]  # arctan2: also rays to the side and behind
    scale = bent / np.maximum(radius, np.finfo(np.float64).tiny)
    return x * scale, y * scale


def _division(x: DoubleArray, y: DoubleArray, z: DoubleArray, t: Terms) -> tuple[DoubleArray, DoubleArray]:
    x, y = x / z, y / z
    # r = d / (1 + k d^2) solved for d, the root that is r for k = 0; this form also holds at k = 0.
    scale = 2 / (1 + np.sqrt(1 - 4 * t["k"] * (x * x + y * y)))
    return x * scale, y * scale


def _extended(x: DoubleArray, y: DoubleArray, z: DoubleArray, t: Terms) -> tuple[DoubleArray, DoubleArray]:
    depth = t["alpha"] * np.sqrt(t["beta"] * (x * x + y * y) + z * z) + (1 - t["alpha"]) * z
    return x / depth, y / depth


def _spherical(x: DoubleArray, y: DoubleArray, z: DoubleArray, _: Terms) -> tuple[DoubleArray, DoubleArray]:
    return np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))


Projection = Callable[[DoubleArray, DoubleArray, DoubleArray, Terms], tuple[DoubleArray, DoubleArray]]
MODELS: dict[str, tuple[tuple[str, ...], Projection]] = {
    "perspective": (("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "r8", "xi"), _perspective),
    "fisheye": (("k1", "k2", "k3", "k4", "p1", "p2", "sx1", "sy1"), _fisheye),
    "fov": (("omega",), _fov),
    "division": (("k",), _division),
    "extended": (("alpha", "beta"), _extended),
    "spherical": ((), _spherical),
}
"""Names of the terms, and the projection function."""


@dataclass(frozen=True)
class Lens:
    """A camera model without focal lengths and principal point. terms: in the order of ``MODELS``."""

    model: str
    terms: tuple[float, ...]

    @property
    def wraps(self) -> bool:
        """Whether the image continues from its left border at the right one."""
        return self.model == "spherical"

    def project(self, rays: DoubleArray) -> tuple[DoubleArray, DoubleArray]:
        """Normalized coordinates (...) of rays (..., 3) of any length; NaN for rays that the lens does not see."""
        x, y, z = np.moveaxis(np.asarray(rays, np.float64), -1, 0)
        with np.errstate(all="ignore"):
            u, v = self._normalized(x, y, z)
            seen = np.arctan2(np.hypot(x, y), z) < widest(self)
        return np.where(seen, u, np.nan), np.where(seen, v, np.nan)

    def radius(self, angle: float) -> float:
        """Radius of the circle on which rays at this angle from the axis, radians, meet the image; infinite where the
        lens does not see them, or draws no circles."""
        u, _ = self.project(np.array([np.sin(angle), 0.0, np.cos(angle)]))
        return np.inf if self.wraps or np.isnan(u) else float(u)

    def _normalized(self, x: DoubleArray, y: DoubleArray, z: DoubleArray) -> tuple[DoubleArray, DoubleArray]:
        names, projection = MODELS[self.model]
        return projection(x, y, z, dict(zip(names, self.terms, strict=True)))


SPHERICAL = Lens("spherical", ())


@lru_cache(maxsize=64)
def widest(lens: Lens) -> float:
    """The angle from the axis, radians, up to which a lens sees: where radii stop growing. Beyond that, a polynomial
    turns back and would show the inside of the image again; a perspective lens has no rays to the side or behind."""
    if lens.wraps:
        return np.inf
    with np.errstate(all="ignore"):
        radius, _ = lens._normalized(np.sin(ANGLES), np.zeros_like(ANGLES), np.cos(ANGLES))
        falls = ~(np.diff(radius) > 0)
    return float(ANGLES[int(np.argmax(falls))]) if falls.any() else np.inf


def lens_of(model: str, values: Terms) -> Lens | None:
    """The lens with these named terms (absent ones are zero); None if it is a pinhole. SceneError for other terms.

    A fisheye lens with zero terms is equidistant, not a pinhole, so it is never None.
    """
    names, _ = MODELS[model]
    unknown = [name for name, value in values.items() if value and name not in names]
    if unknown:
        raise SceneError(
            f"a {model} lens has the term {unknown[0]} = {values[unknown[0]]}; expected only {', '.join(names)}: "
            "undistort images and masks first, and state pinhole cameras"
        )
    terms = tuple(float(values.get(name, 0.0)) for name in names)
    if not np.isfinite(terms).all():
        raise SceneError(f"lens distortion {', '.join(names)} is {terms}; expected finite numbers")
    if model in ("perspective", "fov", "division") and not any(terms):  # with zeros these are pinholes
        return None
    lens = Lens(model, terms)
    if not widest(lens) > 0:
        raise SceneError(f"a {model} lens with {', '.join(names)} of {terms} sees nothing: check them in the pose file")
    return lens


def spherical_camera(width: int, height: int, world_to_camera: DoubleArray) -> Camera:
    """The camera of an equirectangular image of the whole sphere: its focal lengths are pixels per radian."""
    if not 1.9 < width / max(height, 1) < 2.1:
        raise SceneError(
            f"an equirectangular image is {width}x{height}; expected twice as wide as high, the whole sphere: pad it "
            "with black to that shape"
        )
    return Camera(width, height, width / (2 * np.pi), height / np.pi, width / 2, height / 2, world_to_camera)
