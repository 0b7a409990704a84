"""What every pose file gives, whatever its format: one record per image, in world coordinates."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.distortion import Distortion
from og_pointcloud.scene import Camera

__all__ = ["PosedImage", "in_local_frame", "naming", "rigid"]


@dataclass(frozen=True)
class PosedImage:
    """An image as a pose file lists it.

    path: as written there, with forward slashes; relative to the capture folder or to its image folder.
    camera: its ``world_to_camera`` still starts from world coordinates (float64), not from the scene's local frame.
    distortion: None for a pinhole lens.
    """

    path: str
    camera: Camera
    distortion: Distortion | None = None


@contextmanager
def naming(source: str) -> Iterator[None]:
    """Put the place in a pose file in front of what is wrong with a camera there."""
    try:
        yield
    except SceneError as error:
        raise SceneError(f"{source}: {error}") from None


def rigid(rotation: NDArray[np.float64], translation: NDArray[np.float64]) -> NDArray[np.float64]:
    """The (4, 4) transform x -> rotation @ x + translation."""
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = translation
    return transform


def in_local_frame(camera: Camera, origin: NDArray[np.float64]) -> Camera:
    """The camera seen from local coordinates, world = local + origin.

    R (local + origin) + t = R local + (R origin + t): in float64, so that an offset of 1e6 costs under 1e-9.
    """
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    return replace(camera, world_to_camera=rigid(rotation, rotation @ origin + translation))
