"""Do depth images fit the poses and the photographs? Two questions whose answer is otherwise seen hours later.

Unit: where views overlap, a depth image of one predicts what the other measures; in the wrong unit it predicts another
depth, unless the camera only turned. Registration: objects end where depth jumps, and most of these edges are edges of
colour too. The two edge images are correlated over all shifts and some magnifications; a peak elsewhere than at "no
shift, same size" means that depth and colour are seen through other lenses than the files say, or at another time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.formats.depth import DepthFrame, DepthImage
from og_pointcloud.formats.fusion import agreement, evenly
from og_pointcloud.formats.images import require_cv2

__all__ = ["Registration", "doubts", "find_registration"]

Floats = NDArray[np.float32]

COMPARED = 12
"""Views, spread evenly, that a check reads."""
UNITS = (1e-3, 1e-2, 0.1, 0.2, 0.25, 4.0, 5.0, 10.0, 100.0, 1e3)
"""Factors between units in use: metres, centimetres, millimetres, 1/4000 and 1/5000 m against 1/1000 m."""
CONVINCING = 0.3
"""How much larger a share of agreeing depths must become for another unit to be named."""

EDGE_WIDTH = 160
"""Width of the edge images, pixels."""
JUMP = 0.05
"""A neighbour farther by this share of the depth lies on another thing."""
MAGNIFICATIONS = np.linspace(0.84, 1.16, 17)
FARTHEST_SHIFT = 0.15
"""Shifts that are tried, as a share of the width; so are the two below."""
TOLERATED = 0.02
"""Displacement at the image's corner that no warning is given for: objects' masks are no finer."""
GAIN = 1.2
"""How much better than "as stated" another placement must correlate."""
CREDIBLE = 0.05
"""A correlation below this says nothing: few edges of depth, or colours that do not show them."""


@dataclass(frozen=True)
class Registration:
    """Where the colours' edges lie, seen from the depth's: at ``magnification`` times the distance from the image's
    middle, plus ``shift`` (x, y) as a share of the width. correlation: there; stated: at magnification 1, shift 0."""

    magnification: float
    shift: tuple[float, float]
    correlation: float
    stated: float

    @property
    def displacement(self) -> float:
        """Of a corner of the image, as a share of the width."""
        return float(np.hypot(*self.shift)) + abs(self.magnification - 1) / 2

    @property
    def is_off(self) -> bool:
        """Whether depth and colour disagree by more than masks forgive, beyond doubt."""
        better = self.correlation > max(GAIN * self.stated, CREDIBLE)
        return better and self.displacement > TOLERATED


def doubts(frames: Sequence[DepthFrame]) -> list[str]:
    """What is wrong with the depth images of a capture, a sentence each with the cure; empty if nothing is."""
    chosen = [(frame, image) for frame in evenly(frames, COMPARED) if (image := frame.depth.read()).depth.any()]
    images = [image for _, image in chosen]
    found = []
    factor = better_unit(images)
    if factor != 1:
        found.append(
            f"the views' depths agree in {agreement(images, 1):.0%} of places, and in {agreement(images, factor):.0%} "
            f"if all depths are taken times {factor:g}: give the depth unit (og-pointcloud fuse --depth-unit, or "
            "integer_depth_scale in transforms.json)"
        )
    registration = find_registration([(frame, image) for frame, image in chosen if frame.colors])
    if registration is not None and registration.is_off:
        x, y = (f"{value:+.1%}" for value in registration.shift)
        found.append(
            f"edges of depth and of colour do not fall together: the colours' lie {x} of the width to the right, {y} "
            f"of it lower, magnified {registration.magnification:.2f} times (correlation {registration.correlation:.2f}"
            f", as stated {registration.stated:.2f}): register the depth images to the colour camera, or give its "
            "intrinsics"
        )
    return found


def better_unit(images: Sequence[DepthImage]) -> float:
    """The factor on all depths at which views agree clearly better than as they are; 1 if none."""
    stated = agreement(images, 1.0)
    if not np.isfinite(stated):
        stated = 0.0
    shares = {factor: share for factor in UNITS if np.isfinite(share := agreement(images, factor))}
    best = max(shares, key=shares.__getitem__, default=1.0)
    return best if shares and shares[best] > stated + CONVINCING else 1.0


def find_registration(pairs: Sequence[tuple[DepthFrame, DepthImage]]) -> Registration | None:
    """How colours lie to depths, from all views together (what is wrong is the same in all); None without edges."""
    surfaces = [
        _correlations(_depth_edges(image), _color_edges(frame.colors(image.camera)))
        for frame, image in pairs
        if frame.colors is not None
    ]
    if not any(surface.any() for surface in surfaces):
        return None
    total = np.mean(surfaces, axis=0)
    reach = round(FARTHEST_SHIFT * EDGE_WIDTH)
    magnification, row, column = np.unravel_index(int(np.argmax(total)), total.shape)
    stated = total[len(MAGNIFICATIONS) // 2, reach - 1 : reach + 2, reach - 1 : reach + 2].max()
    shift = ((int(column) - reach) / EDGE_WIDTH, (int(row) - reach) / EDGE_WIDTH)
    return Registration(float(MAGNIFICATIONS[magnification]), shift, float(total.max()), float(stated))


def _correlations(depth_edges: Floats, color_edges: Floats) -> Floats:
    """(magnifications, rows, columns): correlation coefficients at every magnification and shift, by Fourier."""
    cv2 = require_cv2()
    height, width = depth_edges.shape
    reach = round(FARTHEST_SHIFT * EDGE_WIDTH)
    padded = (height + 2 * reach, width + 2 * reach)
    color_spectrum = np.fft.rfft2(_standardised(color_edges), padded)
    surfaces = []
    for scale in MAGNIFICATIONS:
        about_middle = np.array([[scale, 0, (1 - scale) * width / 2], [0, scale, (1 - scale) * height / 2]])
        moved = np.asarray(cv2.warpAffine(depth_edges, about_middle, (width, height)), np.float32)
        product = np.fft.irfft2(color_spectrum * np.fft.rfft2(_standardised(moved), padded).conj(), padded)
        surfaces.append(np.roll(product, (reach, reach), (0, 1))[: 2 * reach + 1, : 2 * reach + 1])
    return (np.stack(surfaces) / (height * width)).astype(np.float32)


def _depth_edges(image: DepthImage) -> Floats:
    """1 where depth jumps between two measured pixels, smoothed, at EDGE_WIDTH."""
    depth = image.depth
    edges = np.zeros(depth.shape, np.float32)
    for axis in (0, 1):
        along, marked = np.moveaxis(depth, axis, 0), np.moveaxis(edges, axis, 0)
        nearer = np.minimum(along[1:], along[:-1])
        jump = (nearer > 0) & (np.abs(np.diff(along, axis=0)) > JUMP * nearer)
        marked[1:][jump] = 1
        marked[:-1][jump] = 1
    return _at_edge_width(edges)


def _color_edges(rgb: NDArray[np.uint8]) -> Floats:
    """Strength of colour edges, its root, so that a few strong ones do not decide, at EDGE_WIDTH."""
    cv2 = require_cv2()
    grey = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.float32)
    x, y = cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)
    return _at_edge_width(np.sqrt(np.hypot(x, y)))


def _at_edge_width(edges: Floats) -> Floats:
    cv2 = require_cv2()
    height, width = edges.shape
    size = EDGE_WIDTH, max(1, round(height * EDGE_WIDTH / width))
    small = cv2.resize(edges, size, interpolation=cv2.INTER_AREA if width > EDGE_WIDTH else cv2.INTER_LINEAR)
    return np.asarray(cv2.GaussianBlur(small, (0, 0), 1.0), np.float32)


def _standardised(values: Floats) -> Floats:
    deviation = float(values.std())
    return (values - values.mean()) / deviation if deviation > 0 else np.zeros_like(values)
