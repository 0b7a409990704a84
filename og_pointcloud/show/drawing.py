"""Render splats with a camera, and turn a plain cloud into splats for that."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.ask.picking import in_world
from og_pointcloud.rendering.geometry import isotropic
from og_pointcloud.rendering.splatting import Gaussians, render
from og_pointcloud.scene import Camera, Points

SPLAT_SCALE_SPACINGS, SPLAT_OPACITY = 0.7, 0.95
"""Standard deviation in point spacings, and opacity, of a plain point's splat: surfaces look closed."""


def as_splats(points: Points, spacing: float) -> Points:
    """The points as round splats. spacing: typical distance between neighboring points."""
    splats = isotropic(points, np.full(len(points), spacing, np.float32), SPLAT_SCALE_SPACINGS, SPLAT_OPACITY)
    return replace(points, scale=splats.scale, rotation=splats.rotation, opacity=splats.opacity)


def draw(
    splats: Points, camera: Camera, rgb: NDArray[np.number] | None = None, *, near: float = 0.1
) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 RGB: splats rendered by a camera, on white.

    camera: maps from world coordinates (`in_world`). rgb: (n, 3) colors, 0 to 255; left out, the splats' own. near:
    depth of the near plane, in the scene's unit. SceneError for points without Gaussians (`as_splats` adds them).
    """
    colors = np.asarray(splats.rgb if rgb is None else rgb, np.float32)
    image, covered = render(Gaussians.from_points(splats), colors, in_world(camera, -splats.origin), near)
    return np.clip(image + 255 * (1 - covered[..., None]), 0, 255).astype(np.uint8)
