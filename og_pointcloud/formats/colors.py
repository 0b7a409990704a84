"""One color per label, the same in every file, window and page."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.cloud import UNKNOWN

UNKNOWN_COLOR = (128, 128, 128)
NO_LABEL = (222, 224, 228)
"""Color of points without a label on pages: lighter than in files, as most points of a scene may be unlabelled."""
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Weights of red, green and blue in a color's luminance, ITU-R BT.709."""
GOLDEN_RATIO = 0.618033988749895
VIRIDIS = np.array([
    (68, 1, 84), (71, 44, 122), (59, 82, 139), (44, 113, 142), (33, 145, 140), (39, 173, 129), (94, 201, 98),
    (170, 220, 50), (253, 231, 37),
])  # fmt: skip
"""Evenly spaced colors of the colormap viridis (Smith and van der Walt, 2015, CC0), from dark to bright."""


def label_colors(labels: NDArray[np.integer]) -> NDArray[np.uint8]:
    """(N, 3) uint8 RGB. The color of a label depends on its number alone; consecutive numbers differ in hue."""
    count = int(labels.max(initial=UNKNOWN)) + 1
    palette = np.array([UNKNOWN_COLOR, *(_color(label) for label in range(count))], np.uint8)
    return palette[np.maximum(labels, UNKNOWN) + 1]


def certainty_colors(certainty: NDArray[np.floating]) -> NDArray[np.uint8]:
    """(N, 3) uint8 RGB of certainties (N,) in [0, 1]: dark for 0, bright for 1."""
    stops = np.linspace(0, 1, len(VIRIDIS))
    channels = [np.interp(certainty, stops, channel) for channel in VIRIDIS.T]
    return np.rint(np.stack(channels, axis=1)).astype(np.uint8)


def _color(label: int) -> tuple[int, int, int]:
    import colorsys

    # Steps of the golden ratio spread any number of hues evenly; every 8 labels, saturation and value change too.
    hue = (0.02 + label * GOLDEN_RATIO) % 1.0
    saturation, value = ((0.75, 0.95), (0.45, 0.95), (0.85, 0.65))[label // 8 % 3]
    red, green, blue = colorsys.hsv_to_rgb(hue, saturation, value)
    return round(255 * red), round(255 * green), round(255 * blue)
