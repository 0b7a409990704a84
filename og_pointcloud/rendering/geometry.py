"""Plain cloud -> Gaussians: how large and how opaque a point is, chosen so that the cloud looks like the photographs.

Too large and the cloud becomes fog that hides itself and bleeds over edges; too small and rays pass through. Every
point becomes an isotropic Gaussian of ``scale`` times its own spacing, with one ``opacity``; the two numbers are those
with which the points, drawn in their own colours, differ least from the images. It is the paper's stage 0 (scale and
opacity fitted with frozen positions) reduced to what a plain cloud needs.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from og_pointcloud.rendering.splatting import NEAR_SHARE, Gaussians, render
from og_pointcloud.scene import Camera, Points, View
from og_pointcloud.settings import GeometrySettings

__all__ = [
    "GeometryChoice",
    "Neighbourhood",
    "chance_of_place",
    "choose_gaussians",
    "distinct_places",
    "near_plane",
    "neighbourhood",
    "pixels_per_spacing",
    "sample_of_points",
    "strided",
    "thinned",
]


@dataclass(frozen=True)
class Neighbourhood:
    """spacing: (n,) float32, mean distance to the three nearest points, tamed for duplicates and floaters.
    index: (n, k) int32, nearest points, nearest first, without the point itself. adjoining: (n, k) bool, those within
    the settings' reach (in spacings)."""

    spacing: NDArray[np.float32]
    index: NDArray[np.int32]
    adjoining: NDArray[np.bool_]


@dataclass(frozen=True)
class GeometryChoice:
    """scale (in spacings) and opacity of every point, and the trials (scale, opacity, photometric error) behind them;
    no trials where there was nothing to compare with."""

    gaussians: Gaussians
    scale: float
    opacity: float
    trials: tuple[tuple[float, float, float], ...]


def neighbourhood(xyz: NDArray[np.float32], settings: GeometrySettings) -> Neighbourhood:
    """Spacing and neighbours of every point.

    A floater's own spacing says nothing of a surface: it is held to the median spacing of its neighbours.
    Duplicates have none: they take the scene's. One point alone has spacing 1.
    """
    n = len(xyz)
    k = min(settings.neighbours, n - 1)
    if k == 0:
        return Neighbourhood(np.ones(n, np.float32), np.zeros((n, 0), np.int32), np.zeros((n, 0), bool))
    distance, index = map(np.asarray, cKDTree(xyz).query(xyz, k=k + 1, workers=-1))
    # The point itself is usually first, but not always among duplicates.
    itself = index == np.arange(n)[:, None]
    itself[~itself.any(axis=1), -1] = True
    distance, index = distance[~itself].reshape(n, k), index[~itself].reshape(n, k).astype(np.int32)
    spacing = distance[:, :3].mean(axis=1)
    typical = float(np.median(spacing[spacing > 0])) if (spacing > 0).any() else 1.0
    spacing = np.where(spacing > 0, spacing, typical)
    spacing = np.minimum(spacing, np.median(spacing[index], axis=1)).astype(np.float32)
    adjoining = distance <= settings.reach * np.maximum(spacing, typical)[:, None]
    return Neighbourhood(spacing, index, adjoining)


def near_plane(xyz: NDArray[np.float32], views: Sequence[View]) -> float:
    """Depth of the near plane: a share of the median depth at which cameras see the cloud. Never 0."""
    depths = [_depths(xyz[:: 1 + len(xyz) // 20_000], view.camera) for view in views]
    front = np.concatenate([depth[depth > 0] for depth in depths])
    return NEAR_SHARE * float(np.median(front)) if len(front) else 1e-6


def pixels_per_spacing(points: Points, spacing: NDArray[np.float32], views: Sequence[View]) -> float:
    """How many pixels apart neighbouring points lie in the images, median over the points in front of the cameras."""
    step = 1 + len(points) // 20_000
    apart = []
    for view in views:
        depth = _depths(points.xyz[::step], view.camera)
        front = depth > 0
        apart.append(np.sqrt(view.camera.fx * view.camera.fy) * spacing[::step][front] / depth[front])
    seen = np.concatenate(apart)
    return float(np.median(seen)) if len(seen) else 1.0


def chance_of_place(xyz: NDArray[np.float32], name: str = "") -> NDArray[np.float32]:
    """(n,) float32 in [0, 1), by place and name alone: a sample drawn by it does not depend on the points' order."""
    bits = np.ascontiguousarray(xyz + np.float32(0)).view(np.uint32)  # -0 becomes 0
    value = bits[:, 0] * np.uint32(0x9E3779B1) ^ bits[:, 1] * np.uint32(0x85EBCA77) ^ bits[:, 2] * np.uint32(0xC2B2AE3D)
    value ^= np.uint32(zlib.crc32(name.encode()))
    # Each bit of the input changes half of those that are used (finaliser of MurmurHash3, public domain).
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
        value = (value ^ (value >> np.uint32(shift))) * np.uint32(factor)
    return (((value ^ (value >> np.uint32(16))) >> np.uint32(8)) * 2.0**-24).astype(np.float32)


def sample_of_points(xyz: NDArray[np.float32], count: int) -> NDArray[np.int64]:
    """Ascending rows of about ``count`` points, all if there are no more; the same places whatever the order."""
    if len(xyz) <= count:
        return np.arange(len(xyz))
    chance = chance_of_place(xyz)
    return np.flatnonzero(chance <= np.partition(chance, count - 1)[count - 1])


def distinct_places(xyz: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows of the first point at each place, ascending, and for every point which of these rows is its place."""
    everyone = np.arange(len(xyz))
    bits = np.ascontiguousarray(xyz + np.float32(0)).view(np.uint32).astype(np.uint64)  # -0 becomes 0
    key = bits @ np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
    ordered = np.sort(key)
    if (ordered[1:] != ordered[:-1]).all():  # nearly every cloud; a fifth of the time that looking closer takes
        return everyone, everyone
    _, first, place = np.unique(xyz + np.float32(0), axis=0, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return np.sort(first), rank[place.ravel()]


def strided(camera: Camera, stride: int) -> Camera:
    """The camera of every stride-th pixel, ``image[stride // 2 :: stride, stride // 2 :: stride]``."""
    first = stride // 2

    def center(c: float) -> float:
        return (c - first - 0.5) / stride + 0.5

    return replace(
        camera,
        width=-(-(camera.width - first) // stride),
        height=-(-(camera.height - first) // stride),
        fx=camera.fx / stride,
        fy=camera.fy / stride,
        cx=center(camera.cx),
        cy=center(camera.cy),
    )


def thinned(view: View, stride: int) -> View:
    """The view of every stride-th row and column of its masks, without its image."""
    if stride == 1:
        return view
    first = stride // 2
    masks = np.ascontiguousarray(view.mask_map()[first::stride, first::stride])
    return replace(view, camera=strided(view.camera, stride), masks=masks, image=None)


def choose_gaussians(
    points: Points,
    spacing: NDArray[np.float32],
    views: Sequence[View],
    near: float,
    settings: GeometrySettings,
    progress: Callable[[Sequence[float]], Iterable[float]] = lambda values: values,
) -> GeometryChoice:
    """Gaussians of a plain cloud by photometric agreement with some of its images.

    Scale is swept first, then opacity, with a few images; more of them decide between the scales that come close, for
    which view is compared would decide else. Of scales that then look about as good the middle one is taken (of
    two the smaller, which bleeds less over edges): the ends of the range are where gaps or fog begin. Splats that are
    coarse beside the masks are not tried: they cannot tell inside from outside, however well they fill the image (a
    LiDAR cloud with a person of five points).
    Without colours or images the settings' start values are used.
    """
    views = sorted(views, key=lambda view: view.name)  # the same images whatever order the views came in
    photographs = _Photographs(points, spacing, views, near, settings)
    largest = settings.mask_share / max(_spacing_per_mask(points, spacing, views), 1e-12)
    scales = tuple(scale for scale in settings.scales if scale <= largest) or settings.scales[:1]
    scale, opacity = min(settings.start_scale, scales[-1]), settings.start_opacity
    if len(photographs):
        few, many = settings.photographs
        opacity = settings.opacities[-1]
        at_first: dict[float, float] = {}
        for s in progress(scales):
            at_first[s] = photographs.error(s, opacity, few)
            if s > settings.start_scale and at_first[s] > (1 + settings.close_call) * min(at_first.values()):
                break  # fog from here on
        scale = min(at_first, key=lambda s: at_first[s])
        for softer in progress(settings.opacities[-2::-1]):
            if photographs.error(scale, softer, few) >= photographs.error(scale, opacity, few):
                break
            opacity = softer
        best = min(photographs.error(s, opacity, few) for s in at_first)
        close = [s for s in at_first if photographs.error(s, opacity, few) <= best * (1 + settings.close_call)]
        errors = [photographs.error(s, opacity, many) for s in progress(close)] if len(close) > 1 else [best]
        alike = [s for s, e in zip(close, errors, strict=True) if e <= min(errors) * (1 + settings.error_tolerance)]
        scale = alike[(len(alike) - 1) // 2]
    return GeometryChoice(isotropic(points, spacing, scale, opacity), scale, opacity, photographs.trials)


def isotropic(points: Points, spacing: NDArray[np.float32], scale: float, opacity: float) -> Gaussians:
    """Round Gaussians of ``scale`` spacings."""
    n = len(points)
    rotation = np.zeros((n, 4), np.float32)
    rotation[:, 0] = 1
    size = np.repeat((scale * spacing).astype(np.float32)[:, None], 3, axis=1)
    return Gaussians(points.xyz, size, rotation, np.full(n, opacity, np.float32))


class _Photographs:
    """Images at about the cloud's own resolution (finer pixels would show only its gaps), and how little the cloud
    drawn with some scale and opacity looks like them. Empty without images or colours."""

    def __init__(
        self,
        points: Points,
        spacing: NDArray[np.float32],
        views: Sequence[View],
        near: float,
        settings: GeometrySettings,
    ) -> None:
        self.points, self.spacing, self.near = points, spacing, near
        self.images: list[tuple[Camera, NDArray[np.float32]]] = []
        self._errors: dict[tuple[float, float], list[float]] = {}
        with_image = [view for view in views if view.image is not None]
        if points.rgb is None or not with_image:
            return
        import cv2

        # Evenly spread whether only the first few are looked at, or all.
        few, many = (np.linspace(0, len(with_image) - 1, n).round().astype(int) for n in settings.photographs)
        shrink = max(1.0, pixels_per_spacing(points, spacing, views) / settings.photograph_resolution)
        for index in dict.fromkeys([*few.tolist(), *many.tolist()]):
            image, camera = with_image[index].image_rgb(), with_image[index].camera
            size = max(1, round(camera.width / shrink)), max(1, round(camera.height / shrink))
            small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
            self.images.append((camera.resized(*size), small.astype(np.float32) / 255))
        self.colors = (points.rgb / 255).astype(np.float32)
        self.guess = np.median(np.concatenate([image.reshape(-1, 3) for _, image in self.images]), axis=0)

    def __len__(self) -> int:
        return len(self.images)

    @property
    def trials(self) -> tuple[tuple[float, float, float], ...]:
        """(scale, opacity, mean error) of all that was tried."""
        return tuple((*pair, float(np.mean(errors))) for pair, errors in self._errors.items())

    def error(self, scale: float, opacity: float, count: int) -> float:
        """Mean absolute difference of the drawn cloud and the first ``count`` images; what the cloud leaves open shows
        the median colour.

        So an uncovered pixel costs what a guess costs: a cloud that cannot cover the image is not blown up to do so.
        """
        errors = self._errors.setdefault((scale, opacity), [])
        gaussians = isotropic(self.points, self.spacing, scale, opacity)
        for camera, image in self.images[len(errors) : count]:
            drawn, covered = render(gaussians, self.colors, camera, self.near)
            errors.append(float(np.abs(drawn + (1 - covered[..., None]) * self.guess - image).mean()))
        return float(np.mean(errors[:count]))


def _spacing_per_mask(points: Points, spacing: NDArray[np.float32], views: Sequence[View]) -> float:
    """Point spacing in an image as a part of a mask's side, median over the masks of a few views; 0 without masks."""
    step = 1 + len(points) // 50_000
    xyz, spacing = points.xyz[::step], spacing[::step]
    parts = []
    for view in (views[index] for index in np.unique(np.linspace(0, len(views) - 1, 12).round().astype(int))):
        ids, camera = view.mask_map(), view.camera
        uv_px, depth = camera.project(xyz)
        inside = camera.shows(uv_px)
        column, row = uv_px[inside].astype(int).T
        mask = ids[row, column]
        apart = np.sqrt(camera.fx * camera.fy) * spacing[inside] / depth[inside]
        side = np.sqrt(np.bincount(ids.ravel() + 1, minlength=view.mask_count + 1)[1:])
        parts += [np.median(apart[mask == index]) / side[index] for index in np.unique(mask[mask >= 0])]
    return float(np.median(parts)) if parts else 0.0


def _depths(xyz: NDArray[np.float32], camera: Camera) -> NDArray[np.float64]:
    return xyz @ camera.world_to_camera[2, :3] + camera.world_to_camera[2, 3]
