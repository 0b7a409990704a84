"""Would the photographs fit better if the cameras were moved, turned, scaled or calibrated a little otherwise?

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

from og_pointcloud.checking.photographs import LONGEST_PX, Floats, Photographs, centered, shrunk
from og_pointcloud.checking.sample import seen
from og_pointcloud.formats.poses import rotation_of_vector
from og_pointcloud.formats.repairs import Repair
from og_pointcloud.scene import Camera

Doubles = NDArray[np.float64]

LEVELS = (24, 48, 96, LONGEST_PX)
"""Longer sides of the pyramid's images, pixels: the first has a fault of a tenth of the image within reach."""
POINTS = 400
"""Points of each view: enough for the dozen numbers to find."""
MORE_POINTS = 700
"""Points of each view once a fault is known, to measure it."""
ROUNDS = 4
"""Most Gauss-Newton steps at each level."""
GAIN = 0.01
"""A search is resumed where it ended as long as that gains more than this share of the error without a change."""
FEWEST_POINTS = 50
"""A view that sees fewer points has no say."""
LIMITS = np.array([0.1] * 3 + [0.1] * 3 + [0.1, 0.1, 0.05, 0.05, 0.2, 0.2])
"""Size of a small fault, for each number: radians, median depths, logarithms, shares of the image, lens terms. All are
pulled to 0 on this scale, so that what photographs do not fix stays as it is; half of it is the longest step."""
PULL = 1e-4
"""Weight of that pull for each view, whose colors and photograph are of length one."""
TINY = 1e-4
"""Step of finite differences, as a share of the limits."""
HUBER = 1.5
"""Residuals beyond so many medians count linearly, not squared: what moved, or shines, does not decide."""
COUNT = len(LIMITS)
TURN, MOVE, SIZE, FOCAL, CENTER = slice(0, 3), slice(3, 6), 6, 7, slice(8, 10)


class Group(NamedTuple):
    """free: which of the 12 numbers may change together. says: what such a change means."""

    free: tuple[int, ...]
    says: str


GROUPS = {
    "focal": Group((7,), "another focal length"),
    "shifted": Group((8, 9), "another principal point"),
    "lens": Group((10, 11), "a lens that bends otherwise (distortion corrected twice, or not at all)"),
    "aligned": Group(tuple(range(7)), "the cameras moved as a whole"),
    "everything": Group(tuple(range(COUNT)), "poses and calibration changed a little"),
}
"""Fewest numbers first; all but the last are repairs."""


@dataclass(frozen=True)
class Small:
    """A small change. numbers: (12,) rotation vector and translation of the cloud about its middle (median depths), log
    size, log focal, principal point (shares), r^2 and r^4 of the lens. error: 1 - mean correlation with it. shift: how
    far points move in the images, median, as a share of the width."""

    numbers: Doubles
    error: float
    shift: float


class Registration:
    """A search for small changes of these cameras, which the photographs are seen from, by ``points`` points of each
    view. start: no change."""

    def __init__(self, photographs: Photographs, cameras: Sequence[Camera], points: int = POINTS) -> None:
        assert photographs.sample.rgb is not None
        self.photographs, self.cameras, self.points = photographs, cameras, points
        self.xyz, self.rgb = photographs.sample.xyz, photographs.sample.rgb.astype(np.float64)
        self.middle = np.median(self.xyz, axis=0)
        # The median depth is the unit of translations, so that limits hold in every scene.
        depths = np.concatenate([camera.project(self.xyz[::10])[1] for camera in cameras])
        self.depth = float(np.median(depths[depths > 0])) if (depths > 0).any() else 1.0
        self.finest = [_with_slopes(image) for image in photographs.images]
        self.start = self._judged(np.zeros(COUNT))

    def refined(self, name: str, small: Small) -> Small:
        """A change that was found, searched again from there as long as that helps: after a large change other points
        are visible than those that the first search used."""
        again = self.found(name, small)
        return self.refined(name, again) if small.error - again.error > GAIN * self.start.error else again

    def found(self, name: str, begin: Small | None = None) -> Small:
        """The best change of a group's numbers about another one, else about none; that itself where nothing is
        better."""
        begin = begin or self.start
        numbers, free = begin.numbers.copy(), list(GROUPS[name].free)
        # Coarse to fine: each level's images are smooth enough for the slopes to hold over what the last one left.
        for side in LEVELS:
            images = self.finest
            if side < LONGEST_PX:
                images = [_with_slopes(shrunk(image, side)) for image in self.photographs.images]
            rows = self._seen(numbers)
            for _ in range(ROUNDS):
                step = self._step(numbers, rows, images, free)
                numbers[free] += step
                if np.abs(step / LIMITS[free]).max() < 3e-3:  # converged, far below what is called a fault
                    break
        judged = self._judged(numbers)
        return judged if judged.error < begin.error else begin

    def repair(self, name: str, small: Small) -> tuple[Repair, ...]:
        """The change of a group as a repair, if there is one."""
        numbers = small.numbers
        values: dict[str, Sequence[float]] = {
            "focal": [float(np.exp(numbers[FOCAL]))], "shifted": numbers[CENTER].tolist(),
            "aligned": self._alignment(numbers),
        }  # fmt: skip
        texts = {group: ",".join(f"{value:.4g}" for value in listed) for group, listed in values.items()}
        texts["lens"] = "none"
        return (Repair.parse(f"{name}={texts[name]}"),) if name in texts else ()

    def _alignment(self, numbers: Doubles) -> list[float]:
        """Numbers of the repair "aligned". The change turns, scales and moves the cloud about its middle; the repair
        moves the cameras the opposite way about their mean center."""
        turn, size = rotation_of_vector(numbers[TURN]), float(np.exp(numbers[SIZE]))
        mean = np.mean([camera.center for camera in self.photographs.sample.listed], axis=0)
        there = (mean - self.middle - numbers[MOVE] * self.depth) @ turn / size + self.middle
        return [*(there - mean), *np.rad2deg(-numbers[TURN]), 1 / size]

    def _judged(self, numbers: Doubles) -> Small:
        correlations, shifts = [], []
        for view, rows in enumerate(self._seen(numbers)):
            if len(rows) >= FEWEST_POINTS:
                places = self._places(view, rows, numbers)
                stated = self._places(view, rows, np.zeros(COUNT))
                shifts.append(float(np.median(np.linalg.norm(places - stated, axis=1))))
                difference, _ = self._residual(self.finest[view], rows, places)
                correlations.append(1 - 0.5 * float((difference**2).sum()))  # of unit vectors |a - b|^2 = 2 - 2 a.b
        if not correlations:
            return Small(numbers, 1.0, 0.0)
        return Small(numbers, 1 - float(np.mean(correlations)), float(np.median(shifts)))

    def _seen(self, numbers: Doubles) -> list[NDArray[np.intp]]:
        """For each view the rows of the points to compare. Which are hidden is decided on the changed cloud."""
        cloud = self._moved(self.xyz, numbers)
        visible = [seen(cloud, camera).rows for camera in self.cameras]
        return [rows[:: 1 + len(rows) // self.points] for rows in visible]

    def _moved(self, xyz: Doubles, numbers: Doubles) -> Doubles:
        turned = (xyz - self.middle) @ rotation_of_vector(numbers[TURN]).T
        return self.middle + np.exp(numbers[SIZE]) * turned + numbers[MOVE] * self.depth

    def _places(self, view: int, rows: NDArray[np.intp], numbers: Doubles) -> Doubles:
        """(points, 2) where points of the changed cloud appear, as shares of the image."""
        camera = self.cameras[view]
        pose, size = camera.world_to_camera, np.array([camera.width, camera.height])
        in_camera = self._moved(self.xyz[rows], numbers) @ pose[:3, :3].T + pose[:3, 3]
        # Points beside or behind the camera get a finite place far outside; the lens terms stop at 63 degrees (r = 2).
        xy = in_camera[:, :2] / np.maximum(in_camera[:, 2:], 1e-3 * self.depth)
        r2 = np.minimum((xy**2).sum(axis=1), 4.0)[:, None]
        bent = xy * (1 + r2 * (numbers[10] + r2 * numbers[11])) * np.exp(numbers[FOCAL])
        return (bent * (camera.fx, camera.fy) + (camera.cx, camera.cy)) / size + numbers[CENTER]

    def _residual(self, image: Floats, rows: NDArray[np.intp], places: Doubles) -> tuple[Doubles, Doubles]:
        """(points, 3) photograph minus colors, each without its mean and of length one over the view; and the
        photograph's slopes there on the same scale, (points, 2, 3). Both are 0 where the photograph shows nothing."""
        sampled = _sampled(image, places)
        shown = np.asarray(np.isfinite(sampled).all(axis=1, keepdims=True))
        sampled = np.where(shown, sampled, 0)
        photograph, colors = centered(sampled[:, :3], shown), centered(self.rgb[rows], shown)
        scale = float(np.sqrt((photograph**2).sum() + 1e-6))
        difference = photograph / scale - colors / np.sqrt((colors**2).sum() + 1e-6)
        return difference, sampled[:, 3:].reshape(-1, 2, 3) / scale

    def _step(self, numbers: Doubles, seen_: list[NDArray[np.intp]], images: list[Floats], free: list[int]) -> Doubles:
        """One damped Gauss-Newton step of the free numbers, over all views."""
        limits = LIMITS[free]
        normal, gradient, views = np.zeros((len(free), len(free))), np.zeros(len(free)), 0
        for view, rows in enumerate(seen_):
            if len(rows) < FEWEST_POINTS:
                continue
            views += 1
            places = self._places(view, rows, numbers)
            residual, slopes = self._residual(images[view], rows, places)
            jacobian = np.empty((len(rows), 3, len(free)))
            for column, number in enumerate(free):
                motion = self._motion(view, rows, numbers, number, places)
                jacobian[..., column] = (slopes * motion[..., None]).sum(axis=1)
            # The residual has no mean, so its derivative has none; how the length changes is neglected.
            jacobian = (jacobian - jacobian.mean(axis=0)).reshape(-1, len(free))
            # Huber's weights, as in iteratively reweighted least squares.
            size = np.abs(residual).reshape(-1, 1)
            weighted = jacobian / np.maximum(1, size / (HUBER * np.median(size) + 1e-12))
            normal += weighted.T @ jacobian
            gradient += weighted.T @ residual.reshape(-1)
        # The pull's own normal equations, and Levenberg's damping by a thousandth of the diagonal.
        pull = PULL * max(views, 1) / limits**2
        damped = normal + np.diag(pull + 1e-3 * np.diag(normal))
        step = -np.linalg.solve(damped, gradient + pull * numbers[free])
        return np.asarray(step / max(1.0, float(np.abs(step / limits).max() / 0.5)), np.float64)

    def _motion(self, view: int, rows: NDArray[np.intp], numbers: Doubles, number: int, places: Doubles) -> Doubles:
        """(points, 2) derivative of the places by one of the numbers, by a finite difference."""
        moved = numbers.copy()
        moved[number] += TINY * LIMITS[number]
        return (self._places(view, rows, moved) - places) / (TINY * LIMITS[number])


def _with_slopes(image: Floats) -> Floats:
    """(H, W, 9): the colors, their slopes to the right and their slopes down, per width and per height of the image."""
    height, width = image.shape[:2]
    return np.concatenate([image, np.gradient(image, axis=1) * width, np.gradient(image, axis=0) * height], axis=2)


def _sampled(image: Floats, places: Doubles) -> Doubles:
    """(points, channels) of an image (H, W, channels), interpolated bilinearly; outside, the nearest pixel's."""
    height, width = image.shape[:2]
    # Pixel centers lie at + 0.5. Just short of the last column and row, so that the next one exists.
    u = np.clip(places[:, 0] * width - 0.5, 0, width - 1.001)
    v = np.clip(places[:, 1] * height - 0.5, 0, height - 1.001)
    column, row = u.astype(np.intp), v.astype(np.intp)
    right, down = (u - column)[:, None], (v - row)[:, None]
    above = image[row, column] * (1 - right) + image[row, column + 1] * right
    below = image[row + 1, column] * (1 - right) + image[row + 1, column + 1] * right
    return above * (1 - down) + below * down
