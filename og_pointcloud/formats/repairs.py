"""Mistakes of a capture's files, put right on reading: the files stay as they are.

A repair is one word, ``name=value``. They are applied in their order to what the pose and mask files say; points are
never touched, so that answers stay in the cloud's frame. ``repairs.json`` in a capture folder lists those that every
command applies; `og-pointcloud repair` writes it, and the checks of a capture (og_pointcloud.checking) propose them.

  axes=flipped          the cameras' y and z axes point the other way: OpenCV's where OpenGL's are read, or the reverse
  direction=inverse     poses are world-to-camera where camera-to-world is read, or the reverse
  quaternions=xyzw      quaternions are stored x y z w where w x y z is read
  world=x,z,-y          the poses' world has other axes: its x, y, z are these of the cloud
  scale=2.5             the poses' lengths, times this, are the cloud's
  aligned=tx,ty,tz,rx,ry,rz,s   cameras moved as a whole: by t, in the cloud's unit, turned by the rotation vector r
                        (degrees) and scaled by s about their mean centre
  frames=1              image i has the pose that is listed for image i + 1 (-1: i - 1)
  intrinsics=2          fx, fy, cx, cy are of an image that is smaller by this factor
  focal=1.5             fx and fy times this
  center=swapped        cx and cy are in each other's place; center=middle: the image's middle is meant
  shifted=du,dv         cx and cy moved by these shares of width and height
  lens=none             images and masks are free of distortion already
  masks=mirrored        left and right exchanged; upside-down; turned: by 180 degrees
  masks=next            image i has the mask and features of image i + 1; previous
  masks=from-zero       mask ids count from 0, as rows of features do
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.mask_files import MaskLayer
from og_pointcloud.formats.poses import PosedImage, read_json, rigid, rotation_of_quaternion
from og_pointcloud.scene import Camera

__all__ = [
    "REPAIRS_NAME", "WORLDS", "Repair", "read_repairs", "repaired_cameras", "repaired_ids", "repaired_images",
    "repaired_layers", "rotation_of_vector",
]  # fmt: skip

REPAIRS_NAME = "repairs.json"
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
MOST_REPAIRS = 16
FLIPS: dict[str, Callable[[NDArray[Any]], NDArray[Any]]] = {
    "mirrored": lambda ids: ids[:, ::-1],
    "upside-down": lambda ids: ids[::-1],
    "turned": lambda ids: ids[::-1, ::-1],
    "from-zero": lambda ids: np.where(ids < 0, ids, ids + 1),
}
SHIFTS = {"next": 1, "previous": -1}
WORLDS = tuple(
    ",".join(sign + axis for sign, axis in zip(signs, axes, strict=True))
    for axes in itertools.permutations("xyz")
    for signs in itertools.product(("", "-"), repeat=3)
)
"""All ways to name axes; half of them mirror the world."""
WORDS = {
    "axes": ("flipped",),
    "direction": ("inverse",),
    "quaternions": ("xyzw",),
    "world": WORLDS,
    "center": ("swapped", "middle"),
    "lens": ("none",),
    "masks": (*FLIPS, *SHIFTS),
}
NUMBERS = {"scale": 1, "aligned": 7, "frames": 1, "intrinsics": 1, "focal": 1, "shifted": 2}
POSITIVE = ("scale", "intrinsics", "focal")


@dataclass(frozen=True)
class Repair:
    """One repair, as the list above has it. numbers: those of its value, where they are numbers.

    >>> str(Repair.parse("scale=2.5")), Repair.parse("frames=-1").numbers
    ('scale=2.5', (-1.0,))
    """

    name: str
    value: str
    numbers: tuple[float, ...] = ()

    @classmethod
    def parse(cls, text: str) -> Repair:
        """SceneError where the text is none of the repairs."""
        name, _, value = text.partition("=")
        if value in WORDS.get(name, ()):
            return cls(name, value)
        numbers = _numbers(value)
        fits = name in NUMBERS and len(numbers) == NUMBERS[name] and bool(np.isfinite(numbers).all())
        fits = fits and (name != "frames" or numbers[0] == int(numbers[0]))
        fits = fits and (name not in POSITIVE or numbers[0] > 0) and (name != "aligned" or numbers[6] > 0)
        if not fits:
            expected = ", ".join(WORDS[name][:8]) if name in WORDS else f"{NUMBERS.get(name, 'no')} finite numbers"
            known = f"; {name} takes {expected}" if name in WORDS or name in NUMBERS else ""
            raise SceneError(
                f"'{text:.80}' is no repair; expected name=value with a name of "
                f"{', '.join(sorted({*WORDS, *NUMBERS}))}{known} ('og-pointcloud repair --help' explains)"
            )
        return cls(name, value, numbers)

    def __str__(self) -> str:
        return f"{self.name}={self.value}"


def _numbers(text: str) -> tuple[float, ...]:
    """Those between commas; none where they are not numbers."""
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        return ()


def read_repairs(capture: Path) -> tuple[Repair, ...]:
    """What ``repairs.json`` of a capture folder lists, in its order; none without that file."""
    file = capture / REPAIRS_NAME
    if not file.is_file():
        return ()
    content = read_json(file)
    listed = content.get("repairs") if isinstance(content, dict) else None
    if not isinstance(listed, list) or len(listed) > MOST_REPAIRS or not all(isinstance(text, str) for text in listed):
        raise SceneError(
            f'{file} is not {{"repairs": [texts]}} with at most {MOST_REPAIRS} of them: write it again with '
            "'og-pointcloud repair', or remove it"
        )
    return tuple(map(Repair.parse, listed))


def repaired_images(images: Sequence[PosedImage], repairs: Sequence[Repair]) -> tuple[PosedImage, ...]:
    """What the pose file means. Depth images move and scale with their photographs."""
    cameras = repaired_cameras([image.camera for image in images], repairs)
    depths = repaired_cameras([image.depth.camera if image.depth else image.camera for image in images], repairs)
    without_lens = any(repair.name == "lens" for repair in repairs)
    repaired = []
    for image, camera, depth_camera in zip(images, cameras, depths, strict=True):
        depth = None if image.depth is None else replace(image.depth, camera=depth_camera)
        if without_lens:
            depth = None if depth is None else replace(depth, lens=None)
            image = replace(image, lens=None)
        repaired.append(replace(image, camera=camera, depth=depth))
    return tuple(repaired)


def repaired_cameras(cameras: Sequence[Camera], repairs: Sequence[Repair]) -> list[Camera]:
    """cameras: from world coordinates, in the order of the pose file."""
    repaired = list(cameras)
    for repair in repairs:
        if repair.name in INTRINSICS:
            repaired = [INTRINSICS[repair.name](camera, repair) for camera in repaired]
        elif repair.name in POSES:
            poses = np.stack([camera.world_to_camera for camera in repaired])
            moved = POSES[repair.name](poses, repair)
            repaired = [replace(camera, world_to_camera=pose) for camera, pose in zip(repaired, moved, strict=True)]
    return repaired


def repaired_layers(layers: Sequence[MaskLayer], repairs: Sequence[Repair]) -> list[MaskLayer]:
    """What the mask files mean; layers: in the order of the pose file."""
    repaired = list(layers)
    for repair in repairs:
        if repair.name == "masks" and repair.value in SHIFTS:
            by = SHIFTS[repair.value]
            repaired = [repaired[(index + by) % len(repaired)] for index in range(len(repaired))]
        elif repair.name == "masks":
            repaired = [replace(layer, read=partial(_read_repaired, layer.read, repair)) for layer in repaired]
    return repaired


def repaired_ids(ids: NDArray[Any], repair: Repair) -> NDArray[Any]:
    """One mask map (H, W), -1 outside of all masks, as a repair of masks that stay with their image means it."""
    return np.ascontiguousarray(FLIPS[repair.value](ids))


def _read_repaired(read: Callable[[], NDArray[np.int32]], repair: Repair) -> NDArray[np.int32]:
    return repaired_ids(read(), repair)


def _flipped(poses: NDArray[np.float64], repair: Repair) -> NDArray[np.float64]:
    return FLIP @ poses


def _inverse(poses: NDArray[np.float64], repair: Repair) -> NDArray[np.float64]:
    return np.asarray(np.linalg.inv(poses), np.float64)


def _reordered(poses: NDArray[np.float64], repair: Repair) -> NDArray[np.float64]:
    """A rotation of w x y z that was read from x y z w: q and -q are one rotation, so signs do not matter."""
    return np.stack(
        [rigid(rotation_of_quaternion(np.roll(_quaternion(pose[:3, :3]), 1)), pose[:3, 3]) for pose in poses]
    )


def _quaternion(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """(4,) unit w x y z of a rotation: the eigenvector of the largest eigenvalue of Bar-Itzhack's symmetric matrix."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    symmetric = np.array(
        [
            [a + e + i, h - f, c - g, d - b],
            [h - f, a - e - i, b + d, c + g],
            [c - g, b + d, e - a - i, f + h],
            [d - b, c + g, f + h, i - a - e],
        ]
    )
    return np.linalg.eigh(symmetric)[1][:, -1]


def _with_axes(poses: NDArray[np.float64], repair: Repair) -> NDArray[np.float64]:
    """x of the poses' world is the named axis of the cloud's, and so on; a mirrored world mirrors its cameras too."""
    turn = np.eye(4)
    turn[:3, :3] = [
        np.where(np.array(["x", "y", "z"]) == part[-1], -1.0 if part[0] == "-" else 1.0, 0.0)
        for part in repair.value.split(",")
    ]
    mirrored = np.linalg.det(turn) < 0
    return (np.diag([-1.0, 1, 1, 1]) if mirrored else np.eye(4)) @ poses @ turn


def _scaled(poses: NDArray[np.float64], repair: Repair) -> NDArray[np.float64]:
    scaled = poses.copy()
    scaled[:, :3, 3] *= repair.numbers[0]
    return scaled


def _aligned(poses: NDArray[np.float64], repair: Repair) -> NDArray[np.float64]:
    """Cameras' centres c about their mean m become m + s R (c - m) + t, their rotations W become W R'."""
    move, turn, size = repair.numbers[:3], rotation_of_vector(np.deg2rad(repair.numbers[3:6])), repair.numbers[6]
    rotations = poses[:, :3, :3]
    centers = -np.einsum("nji,nj->ni", rotations, poses[:, :3, 3])
    mean = centers.mean(axis=0)
    centers = mean + size * (centers - mean) @ turn.T + move
    aligned = poses.copy()
    aligned[:, :3, :3] = rotations @ turn.T
    aligned[:, :3, 3] = -np.einsum("nij,nj->ni", aligned[:, :3, :3], centers)
    return aligned


def rotation_of_vector(radians: NDArray[np.floating]) -> NDArray[np.float64]:
    """(3, 3) rotation about a vector (3,) by its length (Rodrigues)."""
    angle = float(np.linalg.norm(radians))
    x, y, z = np.asarray(radians, np.float64) / (angle or 1.0)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def _neighbours(poses: NDArray[np.float64], repair: Repair) -> NDArray[np.float64]:
    return np.roll(poses, -int(repair.numbers[0]), axis=0)


def _larger(camera: Camera, repair: Repair) -> Camera:
    by = repair.numbers[0]
    return replace(camera, fx=camera.fx * by, fy=camera.fy * by, cx=camera.cx * by, cy=camera.cy * by)


def _focal(camera: Camera, repair: Repair) -> Camera:
    return replace(camera, fx=camera.fx * repair.numbers[0], fy=camera.fy * repair.numbers[0])


def _centered(camera: Camera, repair: Repair) -> Camera:
    if repair.value == "swapped":
        return replace(camera, cx=camera.cy, cy=camera.cx)
    return replace(camera, cx=camera.width / 2, cy=camera.height / 2)


def _shifted(camera: Camera, repair: Repair) -> Camera:
    du, dv = repair.numbers
    return replace(camera, cx=camera.cx + du * camera.width, cy=camera.cy + dv * camera.height)


POSES = {
    "axes": _flipped, "direction": _inverse, "quaternions": _reordered, "world": _with_axes, "scale": _scaled,
    "aligned": _aligned, "frames": _neighbours,
}  # fmt: skip
INTRINSICS = {"intrinsics": _larger, "focal": _focal, "center": _centered, "shifted": _shifted}
