"""Would the photographs fit better if the cameras were moved, turned, scaled or calibrated slightly differently?

Points' colors are compared with the photographs at the points' pixels, and one small change, shared by all views, is
found by Gauss-Newton over an image pyramid: a similarity of the cloud, focal length, principal point and two lens
terms. This is photometric alignment as in direct visual odometry, with frozen geometry; both sides are normalized, so
exposure does not matter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.checking.photographs import MAX_SIDE_PX, Floats, Photographs, centered, shrunk
from og_pointcloud.checking.sample import seen
from og_pointcloud.formats.poses import rotation_of_vector
from og_pointcloud.formats.repairs import Repair

Doubles = NDArray[np.float64]

PYRAMID_PX = (24, 48, 96, MAX_SIDE_PX)
"""Longer sides of the pyramid's images: the coarsest has a fault of a tenth of the image within reach."""
POINTS_PER_VIEW = 400
"""Enough to find a dozen parameters."""
MORE_POINTS_PER_VIEW = 700
"""Used once a fault is known, to measure it."""
MAX_STEPS = 4
"""Most Gauss-Newton steps at each level."""
MIN_RESTART_GAIN = 0.01
"""A search is restarted where it ended as long as that gains more than this share of the initial error."""
MIN_POINTS = 50
"""A view that sees fewer points is ignored."""
LIMITS = np.array([0.1] * 3 + [0.1] * 3 + [0.1, 0.1, 0.05, 0.05, 0.2, 0.2])
"""Size of a small fault, for each parameter: radians, median depths, logarithms, shares of the image, lens terms. A
prior pulls all to 0 on this scale, so that what photographs do not determine stays as it is; half of it is the longest
step."""
PRIOR_WEIGHT = 1e-4
"""Weight of that prior for each view, whose colors and photograph are of length one."""
DIFFERENCE_STEP = 1e-4
"""Step of finite differences, as a share of the limits."""
HUBER_MEDIANS = 1.5
"""Residuals beyond this many medians count linearly, not squared: what moved, or shines, does not decide."""
PARAMETER_COUNT = len(LIMITS)
ROTATION, TRANSLATION, LOG_SCALE, LOG_FOCAL, PRINCIPAL_POINT = slice(0, 3), slice(3, 6), 6, 7, slice(8, 10)


class Group(NamedTuple):
    """free: which of the 12 parameters may change together. says: what such a change means."""

    free: tuple[int, ...]
    says: str


GROUPS = {
    "focal": Group((7,), "another focal length"),
    "shifted": Group((8, 9), "another principal point"),
    "lens": Group((10, 11), "another lens distortion (it is corrected twice, or not at all)"),
    "aligned": Group(tuple(range(7)), "the cameras moved as a whole"),
    "everything": Group(tuple(range(PARAMETER_COUNT)), "poses and calibration slightly changed"),
}
"""Fewest parameters first; all but the last are repairs."""


@dataclass(frozen=True)
class SmallChange:
    """A small change. numbers: (12,) rotation vector and translation of the cloud about its middle (median depths), log
    size, log focal, principal point (shares), r^2 and r^4 of the lens. error: 1 - mean correlation with it. shift: how
    far points move in the images, median, as a share of the width."""

    numbers: Doubles
    error: float
    shift: float


class Registration:
    """A search for small changes of the photographs' cameras, by ``points`` points of each view. start: no change."""

    def __init__(self, photographs: Photographs, points: int = POINTS_PER_VIEW) -> None:
        assert photographs.sample.rgb is not None
        self.photographs, self.cameras, self.points = photographs, photographs.sample.cameras, points
        self.xyz, self.rgb = photographs.sample.xyz, photographs.sample.rgb.astype(np.float64)
        self.middle = np.median(self.xyz, axis=0)
        # The median depth is the unit of translations, so that limits hold in every scene.
        depths = np.concatenate([camera.project(self.xyz[::10])[1] for camera in self.cameras])
        self.depth = float(np.median(depths[depths > 0])) if (depths > 0).any() else 1.0
        self.finest = [_with_slopes(image) for image in photographs.images]
        self.start = self._evaluated(np.zeros(PARAMETER_COUNT))

    def refined(self, name: str, small: SmallChange) -> SmallChange:
        """A change, searched again from where it was found as long as that helps: after a large change other points are
        visible than those that the first search used."""
        again = self.best_change(name, small)
        return self.refined(name, again) if small.error - again.error > MIN_RESTART_GAIN * self.start.error else again

    def best_change(self, name: str, begin: SmallChange | None = None) -> SmallChange:
        """The best change of a group's parameters, searched from ``begin`` (None: no change); ``begin`` itself where
        nothing is better."""
        begin = begin or self.start
        numbers, free = begin.numbers.copy(), list(GROUPS[name].free)
        # Coarse to fine: each level's images are smooth enough for the gradients to hold over the remaining offset.
        for side in PYRAMID_PX:
            images = self.finest
            if side < MAX_SIDE_PX:
                images = [_with_slopes(shrunk(image, side)) for image in self.photographs.images]
            rows = self._seen(numbers)
            for _ in range(MAX_STEPS):
                step = self._step(numbers, rows, images, free)
                numbers[free] += step
                if np.abs(step / LIMITS[free]).max() < 3e-3:  # converged, far below the size of a fault
                    break
        judged = self._evaluated(numbers)
        return judged if judged.error < begin.error else begin

    def repair(self, name: str, small: SmallChange) -> tuple[Repair, ...]:
        """The change of a group as a repair, if there is one."""
        numbers = small.numbers
        values: dict[str, Sequence[float]] = {
            "focal": [float(np.exp(numbers[LOG_FOCAL]))], "shifted": numbers[PRINCIPAL_POINT].tolist(),
            "aligned": self._alignment(numbers),
        }  # fmt: skip
        texts = {group: ",".join(f"{value:.4g}" for value in listed) for group, listed in values.items()}
        texts["lens"] = "none"
        return (Repair.parse(f"{name}={texts[name]}"),) if name in texts else ()

    def _alignment(self, numbers: Doubles) -> list[float]:
        """Numbers of the repair "aligned". The change turns, scales and moves the cloud about its middle; the repair
        moves the cameras the opposite way about their mean center."""
        turn, size = rotation_of_vector(numbers[ROTATION]), float(np.exp(numbers[LOG_SCALE]))
        mean = np.mean([camera.center for camera in self.photographs.sample.listed], axis=0)
        there = (mean - self.middle - numbers[TRANSLATION] * self.depth) @ turn / size + self.middle
        return [*(there - mean), *np.rad2deg(-numbers[ROTATION]), 1 / size]

    def _evaluated(self, numbers: Doubles) -> SmallChange:
        correlations, shifts = [], []
        for view, rows in enumerate(self._seen(numbers)):
            if len(rows) >= MIN_POINTS:
                places = self._places(view, rows, numbers)
                stated = self._places(view, rows, np.zeros(PARAMETER_COUNT))
                shifts.append(float(np.median(np.linalg.norm(places - stated, axis=1))))
                difference, _ = self._residual(self.finest[view], rows, places)
                correlations.append(1 - 0.5 * float((difference**2).sum()))  # of unit vectors |a - b|^2 = 2 - 2 a.b
        if not correlations:
            return SmallChange(numbers, 1.0, 0.0)
        return SmallChange(numbers, 1 - float(np.mean(correlations)), float(np.median(shifts)))

    def _seen(self, numbers: Doubles) -> list[NDArray[np.intp]]:
        """For each view the rows of the points to compare; visibility is that of the changed cloud."""
        cloud = self._moved(self.xyz, numbers)
        visible = [seen(cloud, camera).rows for camera in self.cameras]
        return [rows[:: 1 + len(rows) // self.points] for rows in visible]

    def _moved(self, xyz: Doubles, numbers: Doubles) -> Doubles:
        turned = (xyz - self.middle) @ rotation_of_vector(numbers[ROTATION]).T
        return self.middle + np.exp(numbers[LOG_SCALE]) * turned + numbers[TRANSLATION] * self.depth

    def _places(self, view: int, rows: NDArray[np.intp], numbers: Doubles) -> Doubles:
        """(points, 2) where points of the changed cloud appear, as shares of the image."""
        camera = self.cameras[view]
        pose, size = camera.world_to_camera, np.array([camera.width, camera.height])
        in_camera = self._moved(self.xyz[rows], numbers) @ pose[:3, :3].T + pose[:3, 3]
        # Points beside or behind the camera get finite places far outside; r is clamped at 2 (63 degrees).
        xy = in_camera[:, :2] / np.maximum(in_camera[:, 2:], 1e-3 * self.depth)
        r2 = np.minimum((xy**2).sum(axis=1), 4.0)[:, None]
        bent = xy * (1 + r2 * (numbers[10] + r2 * numbers[11])) * np.exp(numbers[LOG_FOCAL])
        return (bent * (camera.fx, camera.fy) + (camera.cx, camera.cy)) / size + numbers[PRINCIPAL_POINT]

    def _residual(self, image: Floats, rows: NDArray[np.intp], places: Doubles) -> tuple[Doubles, Doubles]:
        """(points, 3) photograph minus colors, each without its mean and normalized to length one over the view; and
        the photograph's gradients there on the same scale, (points, 2, 3). Both are 0 where it shows nothing."""
        sampled = _sampled(image, places)
        shown = np.asarray(np.isfinite(sampled).all(axis=1, keepdims=True))
        sampled = np.where(shown, sampled, 0)
        photograph, colors = centered(sampled[:, :3], shown), centered(self.rgb[rows], shown)
        scale = float(np.sqrt((photograph**2).sum() + 1e-6))
        difference = photograph / scale - colors / np.sqrt((colors**2).sum() + 1e-6)
        return difference, sampled[:, 3:].reshape(-1, 2, 3) / scale

    def _step(self, numbers: Doubles, seen_: list[NDArray[np.intp]], images: list[Floats], free: list[int]) -> Doubles:
        """One damped Gauss-Newton step of the free parameters, over all views."""
        limits = LIMITS[free]
        normal, gradient, views = np.zeros((len(free), len(free))), np.zeros(len(free)), 0
        for view, rows in enumerate(seen_):
            if len(rows) < MIN_POINTS:
                continue
            views += 1
            places = self._places(view, rows, numbers)
            residual, slopes = self._residual(images[view], rows, places)
            jacobian = np.empty((len(rows), 3, len(free)))
            for column, number in enumerate(free):
                motion = self._motion(view, rows, numbers, number, places)
                jacobian[..., column] = (slopes * motion[..., None]).sum(axis=1)
            # The residual has zero mean, so its derivative has too; the change of its length is neglected.
            jacobian = (jacobian - jacobian.mean(axis=0)).reshape(-1, len(free))
            # Huber's weights, as in iteratively reweighted least squares.
            size = np.abs(residual).reshape(-1, 1)
            weighted = jacobian / np.maximum(1, size / (HUBER_MEDIANS * np.median(size) + 1e-12))
            normal += weighted.T @ jacobian
            gradient += weighted.T @ residual.reshape(-1)
        # The prior's own normal equations, and Levenberg's damping by a thousandth of the diagonal.
        prior = PRIOR_WEIGHT * max(views, 1) / limits**2
        damped = normal + np.diag(prior + 1e-3 * np.diag(normal))
        step = -np.linalg.solve(damped, gradient + prior * numbers[free])
        return np.asarray(step / max(1.0, float(np.abs(step / limits).max() / 0.5)), np.float64)

    def _motion(self, view: int, rows: NDArray[np.intp], numbers: Doubles, number: int, places: Doubles) -> Doubles:
        """(points, 2) derivative of the places by one parameter, by a finite difference."""
        moved = numbers.copy()
        moved[number] += DIFFERENCE_STEP * LIMITS[number]
        return (self._places(view, rows, moved) - places) / (DIFFERENCE_STEP * LIMITS[number])


def _with_slopes(image: Floats) -> Floats:
    """(H, W, 9): the colors, their gradients to the right and down, per width and per height of the image."""
    height, width = image.shape[:2]
    return np.concatenate([image, np.gradient(image, axis=1) * width, np.gradient(image, axis=0) * height], axis=2)


def _sampled(image: Floats, places: Doubles) -> Doubles:
    """(points, channels) of an image (H, W, channels), bilinear; outside the image, the nearest pixel's value."""
    height, width = image.shape[:2]
    # Pixel centers lie at + 0.5. Clipped just short of the last column and row, so that the next one exists.
    u = np.clip(places[:, 0] * width - 0.5, 0, width - 1.001)
    v = np.clip(places[:, 1] * height - 0.5, 0, height - 1.001)
    column, row = u.astype(np.intp), v.astype(np.intp)
    right, down = (u - column)[:, None], (v - row)[:, None]
    above = image[row, column] * (1 - right) + image[row, column + 1] * right
    below = image[row + 1, column] * (1 - right) + image[row + 1, column + 1] * right
    return above * (1 - down) + below * down
