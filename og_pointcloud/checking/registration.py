"""Would the photographs fit better if the cameras were moved, turned, scaled or calibrated a little otherwise?

Points' colours against photographs at the points' pixels, by Gauss-Newton over an image pyramid, all views sharing one
small change: a similarity of the cloud, focal length, principal point and two terms of a lens. Photometric alignment as
in direct visual odometry, with frozen geometry; both sides are normalised, so exposure does not matter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.checking.photographs import BLACK, Photographs, shrunk
from og_pointcloud.checking.sample import seen
from og_pointcloud.formats.repairs import Repair, rotation_of_vector
from og_pointcloud.scene import Camera

__all__ = ["FREE", "MORE_POINTS", "Registration", "Small"]

Doubles = NDArray[np.float64]

LEVELS = (24, 48, 96, 192)
"""Longer sides of the pyramid's images, pixels: a fault of a tenth of the image is within reach of the first."""
VIEWS = 8
POINTS = 600
"""Of each view: there are a dozen numbers to find."""
MORE_POINTS = 1500
"""Of each view, once a fault is known, for its size."""
ROUNDS = 4
FEWEST_POINTS = 50
LIMITS = np.array([0.1] * 3 + [0.1] * 3 + [0.1, 0.1, 0.05, 0.05, 0.2, 0.2])
"""Size of a small fault: radians, median depths, logarithms, shares of the image, lens terms. They are drawn to 0 on
this scale, so that what photographs do not fix stays; half of it is the longest step."""
PULL = 1e-4
HUBER = 1.5
"""Residuals beyond so many medians count by their root: what moved, or shines, does not decide."""
COUNT = len(LIMITS)
TURN, MOVE, SIZE, FOCAL, CENTER, LENS = slice(0, 3), slice(3, 6), 6, 7, slice(8, 10), slice(10, 12)
FREE = {
    "focal": (7,), "shifted": (8, 9), "lens": (10, 11), "aligned": tuple(range(7)), "everything": tuple(range(COUNT)),
}  # fmt: skip
"""What may change together, fewest numbers first."""


@dataclass(frozen=True)
class Small:
    """A small change. numbers: (12,) rotation vector and translation of the cloud about its middle (median depths), log
    size, log focal, principal point (shares), r^2 and r^4 of the lens. error: 1 - mean correlation with it. shift: how
    far points move in the images, median, as a share of the width."""

    numbers: Doubles
    error: float
    shift: float


class Registration:
    """A search about the cameras as they are stated, by so many points of each view."""

    def __init__(self, photographs: Photographs, cameras: Sequence[Camera], points: int = POINTS) -> None:
        fewer = photographs.fewer(VIEWS, len(photographs.sample.xyz))
        self.rows = [photographs.sample.places.index(place) for place in fewer.sample.places]
        self.cameras = [cameras[row] for row in self.rows]
        assert fewer.sample.rgb is not None
        self.xyz, self.rgb = fewer.sample.xyz, fewer.sample.rgb.astype(np.float64)
        self.pyramids = {side: [_with_slopes(shrunk(image, side)) for image in fewer.images] for side in LEVELS}
        self.points = points
        self.middle = np.median(self.xyz, axis=0)
        depths = np.concatenate([camera.project(self.xyz[::10])[1] for camera in self.cameras])
        self.depth = float(np.median(depths[depths > 0])) if (depths > 0).any() else 1.0
        self.start = self._judged(np.zeros(COUNT))

    def found(self, free: Sequence[int]) -> Small:
        """The best change of these numbers; the stated one where nothing is better."""
        numbers = np.zeros(COUNT)
        for side in LEVELS:
            rows = self._seen(numbers)
            for _ in range(ROUNDS):
                step = self._step(numbers, rows, side, list(free))
                numbers[list(free)] += step
                if np.abs(step / LIMITS[list(free)]).max() < 3e-3:
                    break
        judged = self._judged(numbers)
        return judged if judged.error < self.start.error else self.start

    def error(self, cameras: Sequence[Camera]) -> float:
        """1 - mean correlation for other cameras of the same views."""
        stated, self.cameras = self.cameras, [cameras[row] for row in self.rows]
        try:
            return self._judged(np.zeros(COUNT)).error
        finally:
            self.cameras = stated

    def repairs(self, name: str, small: Small, centers: Doubles) -> tuple[Repair, ...]:
        """The change of `FREE`'s group as repairs. centers: (views, 3) of all cameras of the scene, local frame."""
        if name == "lens":
            return (Repair.parse("lens=none"),)
        texts = {
            "focal": f"focal={np.exp(small.numbers[FOCAL]):.4g}",
            "shifted": "shifted=" + ",".join(f"{share:.4g}" for share in small.numbers[CENTER]),
            "aligned": self._alignment(small.numbers, centers),
        }
        return tuple(Repair.parse(text) for part, text in texts.items() if name == part)

    def _alignment(self, numbers: Doubles, centers: Doubles) -> str:
        """The cloud is turned by R, sized and moved about its middle; so cameras go the other way about their mean."""
        turn, size = rotation_of_vector(numbers[TURN]), float(np.exp(numbers[SIZE]))
        mean = centers.mean(axis=0)
        there = (mean - self.middle - numbers[MOVE] * self.depth) @ turn / size + self.middle
        values = [*(there - mean), *np.rad2deg(-numbers[TURN]), 1 / size]
        return "aligned=" + ",".join(f"{value:.5g}" for value in values)

    def _judged(self, numbers: Doubles) -> Small:
        correlations, shifts = [], []
        rows = self._seen(numbers)
        for view, camera in enumerate(self.cameras):
            if len(rows[view]) < FEWEST_POINTS:
                continue
            places = self._placed(camera, rows[view], numbers)[1]
            stated = self._placed(camera, rows[view], np.zeros(COUNT))[1]
            shifts.append(float(np.median(np.linalg.norm(places - stated, axis=1))))
            difference = self._residual(view, rows[view], places, LEVELS[-1])[0]
            correlations.append(1 - 0.5 * float((difference**2).sum()))
        if not correlations:
            return Small(numbers, 1.0, 0.0)
        return Small(numbers, 1 - float(np.mean(correlations)), float(np.median(shifts)))

    def _seen(self, numbers: Doubles) -> list[NDArray[np.intp]]:
        """Of each view the rows of the points that are looked at; hidden ones are told with the changed cloud."""
        cloud = self._cloud(self.xyz, numbers)
        found = [seen(cloud, camera).rows for camera in self.cameras]
        return [rows[:: 1 + len(rows) // self.points] for rows in found]

    def _cloud(self, xyz: Doubles, numbers: Doubles) -> Doubles:
        turned = (xyz - self.middle) @ rotation_of_vector(numbers[TURN]).T
        return self.middle + np.exp(numbers[SIZE]) * turned + numbers[MOVE] * self.depth

    def _placed(self, camera: Camera, rows: NDArray[np.intp], numbers: Doubles) -> tuple[Doubles, Doubles, Doubles]:
        """Points of the changed cloud, where they appear as shares of the image, and in the camera's frame."""
        cloud = self._cloud(self.xyz[rows], numbers)
        in_camera = cloud @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        xy = in_camera[:, :2] / np.maximum(in_camera[:, 2:], 1e-3 * self.depth)
        r2 = np.minimum((xy**2).sum(axis=1), 4.0)[:, None]
        bent = xy * (1 + r2 * (numbers[10] + r2 * numbers[11])) * np.exp(numbers[FOCAL])
        size = np.array([camera.width, camera.height])
        places = (bent * (camera.fx, camera.fy) + (camera.cx, camera.cy)) / size + numbers[CENTER]
        return cloud, places, in_camera

    def _residual(self, view: int, rows: NDArray[np.intp], places: Doubles, side: int) -> tuple[Doubles, Doubles]:
        """(points, 3) photograph less colours, each less its mean and of length one; the photograph's slopes there, of
        the same scale, (points, 2, 3)."""
        sampled = _sampled(self.pyramids[side][view], places)
        photograph, slopes = sampled[:, :3], sampled[:, 3:9].reshape(-1, 2, 3)
        shown = sampled[:, 9:] > 0.999  # beyond a lens's rim there is nothing to compare
        photograph = _centered(photograph, shown)
        colors = _centered(self.rgb[rows], shown)
        scale = float(np.sqrt((photograph**2).sum() + 1e-6))
        return photograph / scale - colors / np.sqrt((colors**2).sum() + 1e-6), slopes * shown[..., None] / scale

    def _step(self, numbers: Doubles, rows: Sequence[NDArray[np.intp]], side: int, free: list[int]) -> Doubles:
        """One damped Gauss-Newton step of the free numbers, over all views."""
        normal, gradient = np.zeros((len(free), len(free))), np.zeros(len(free))
        views = 0
        for view, camera in enumerate(self.cameras):
            if len(rows[view]) < FEWEST_POINTS:
                continue
            views += 1
            cloud, places, in_camera = self._placed(camera, rows[view], numbers)
            residual, slopes = self._residual(view, rows[view], places, side)
            motion = self._motion(camera, cloud, in_camera, numbers)[:, :, free]
            jacobian = np.einsum("nac,nap->ncp", slopes, motion)
            jacobian -= jacobian.mean(axis=0)
            size = np.abs(residual)
            weight = 1 / np.maximum(1, size / (HUBER * np.median(size) + 1e-12))
            jacobian = jacobian.reshape(-1, len(free))
            weighted = jacobian * weight.reshape(-1, 1)
            normal += weighted.T @ jacobian
            gradient += weighted.T @ residual.reshape(-1)
        limits = LIMITS[free]
        pull = PULL * max(views, 1) / limits**2
        damped = normal + np.diag(pull + 1e-3 * np.diag(normal))
        step = -np.linalg.solve(damped, gradient + pull * numbers[free])
        return np.asarray(step / max(1.0, float(np.abs(step / limits).max() / 0.5)), np.float64)

    def _motion(self, camera: Camera, cloud: Doubles, in_camera: Doubles, numbers: Doubles) -> Doubles:
        """(points, 2, 12) how places change with each number, the lens left out of all but its own."""
        z = np.maximum(in_camera[:, 2], 1e-3 * self.depth)
        x, y = in_camera[:, 0] / z, in_camera[:, 1] / z
        r2 = np.minimum(x**2 + y**2, 4.0)
        about = cloud - self.middle - numbers[MOVE] * self.depth
        changes = np.zeros((len(cloud), 3, 7))  # of points, in the world
        for axis in range(3):
            changes[:, :, axis] = np.cross(np.eye(3)[axis], about)
            changes[:, axis, 3 + axis] = self.depth
        changes[:, :, SIZE] = about
        changes = np.einsum("ab,nbp->nap", camera.world_to_camera[:3, :3], changes)
        across = np.exp(numbers[FOCAL]) * np.array([camera.fx / camera.width, camera.fy / camera.height])
        motion = np.zeros((len(cloud), 2, COUNT))
        for axis, place in enumerate((x, y)):
            motion[:, axis, :7] = across[axis] * (changes[:, axis] - place[:, None] * changes[:, 2]) / z[:, None]
            motion[:, axis, FOCAL] = across[axis] * place
            motion[:, axis, 8 + axis] = 1
            motion[:, axis, 10] = across[axis] * place * r2
            motion[:, axis, 11] = across[axis] * place * r2**2
        return motion


def _centered(colors: Doubles, shown: NDArray[np.bool_]) -> Doubles:
    """Colours (points, 3) less the mean of those that are shown (points, 1); 0 where they are not."""
    mean = (colors * shown).sum(axis=0) / max(np.count_nonzero(shown), 1)
    return (colors - mean) * shown


def _with_slopes(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """(H, W, 10): the colours, how they change to the right and down, per width and height of the image, and 1 where
    neither the pixel nor one beside it is black."""
    height, width = image.shape[:2]
    lit = np.pad((image.max(axis=2) >= BLACK).astype(np.float32), 1, mode="edge")
    lit = np.min([lit[1:-1, 1:-1], lit[:-2, 1:-1], lit[2:, 1:-1], lit[1:-1, :-2], lit[1:-1, 2:]], axis=0)[..., None]
    right, down = np.gradient(image, axis=1) * width, np.gradient(image, axis=0) * height
    return np.concatenate([image, right * lit, down * lit, lit], axis=2)


def _sampled(image: NDArray[np.float32], places: Doubles) -> Doubles:
    """(points, channels) of an image (H, W, channels) between pixel centres; outside, the nearest pixel's."""
    height, width = image.shape[:2]
    u = np.clip(places[:, 0] * width - 0.5, 0, width - 1.001)
    v = np.clip(places[:, 1] * height - 0.5, 0, height - 1.001)
    column, row = u.astype(np.intp), v.astype(np.intp)
    right, down = (u - column)[:, None], (v - row)[:, None]
    above = image[row, column] * (1 - right) + image[row, column + 1] * right
    below = image[row + 1, column] * (1 - right) + image[row + 1, column + 1] * right
    return above * (1 - down) + below * down
