"""Mistakes in a capture's files, corrected on reading: the files stay as they are.

A repair is one word, ``name=value``. Repairs are applied in order to the contents of the pose and mask files; points
are never touched, so that answers stay in the cloud's frame. ``repairs.json`` in a capture folder lists those that
every command applies; `og-pointcloud repair` writes it, and the checks of a capture (og_pointcloud.checking) try the
same table, `KINDS`, to find out which conventions a capture uses.

  axes=flipped          the cameras' y and z axes point the other way: OpenCV's where OpenGL's are read, or the reverse
  direction=inverse     poses are world-to-camera where camera-to-world is read, or the reverse
  quaternions=xyzw      quaternions are stored x y z w where w x y z is read
  world=x,z,-y          the poses' world has other axes: its x, y, z are these axes of the cloud
  scale=2.5             the poses' lengths must be multiplied by this to match the cloud's
  aligned=tx,ty,tz,rx,ry,rz,s   all cameras are moved together by t, in the cloud's unit, turned by the rotation vector
                        r (degrees) and scaled by s about their mean center
  frames=1              image i has the pose that is listed for image i + 1 (-1: i - 1)
  intrinsics=2          fx, fy, cx, cy belong to an image that is smaller by this factor
  focal=1.5             fx and fy must be multiplied by this
  center=swapped        cx and cy are swapped; center=middle: they are the middle of the image
  shifted=du,dv         cx and cy are moved by these shares of width and height
  lens=none             images and masks are already undistorted
  masks=mirrored        masks are mirrored left to right; upside-down; turned: by 180 degrees
  masks=next            image i has the mask and features of image i + 1; previous: i - 1
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
from og_pointcloud.formats.poses import (
    OPENGL_SIGNS,
    PosedImage,
    quaternion_of,
    read_json_object,
    rigid,
    rotation_of_quaternion,
    rotation_of_vector,
)
from og_pointcloud.scene import Camera, DoubleArray, IntArray

REPAIRS_NAME = "repairs.json"
MAX_REPAIRS = 16
SAME_LENS_TOLERANCE = 0.01
"""Depth images whose intrinsics, scaled, are the photographs' within this relative tolerance share their mistakes."""
MASK_FLIPS: dict[str, Callable[[NDArray[Any]], NDArray[Any]]] = {
    "mirrored": lambda ids: ids[:, ::-1],
    "upside-down": lambda ids: ids[::-1],
    "turned": lambda ids: ids[::-1, ::-1],
}
MASK_SHIFTS = {"next": 1, "previous": -1}
AXIS_NAMES = tuple(
    ",".join(sign + axis for sign, axis in zip(signs, axes, strict=True))
    for axes in itertools.permutations("xyz")
    for signs in itertools.product(("", "-"), repeat=3)
)[1:]
"""All signed axis permutations except the identity; half of them mirror the world."""


@dataclass(frozen=True)
class Repair:
    """One repair of the list above. numbers: those in its value, if any.

    >>> str(Repair.parse("scale=2.5")), Repair.parse("scale=2.5").numbers
    ('scale=2.5', (2.5,))
    """

    name: str
    value: str
    numbers: tuple[float, ...] = ()

    @classmethod
    def parse(cls, text: str) -> Repair:
        """Parse the text; SceneError if it is none of the repairs."""
        name, _, value = text.partition("=")
        kind = KINDS.get(name)
        if kind is not None and value in kind.words:
            return cls(name, value)
        numbers = _numbers(value)
        if kind is not None and numbers and len(numbers) == kind.numbers and (kind.may_be_negative or numbers[-1] > 0):
            return cls(name, value, numbers)
        above = "" if kind is None or kind.may_be_negative else ", the last above 0"
        expected = kind and (", ".join(kind.words[:8]) or f"{kind.numbers} finite number(s){above}")
        raise SceneError(
            f"'{text:.80}' is not a repair; expected name=value, name one of {', '.join(sorted(KINDS))}"
            f"{f'; {name} takes {expected}' if kind else ''} ('og-pointcloud repair --help' explains)"
        )

    def __str__(self) -> str:
        return f"{self.name}={self.value}"


Change = Callable[[list[Camera], Repair], list[Camera]]


@dataclass(frozen=True)
class Kind:
    """change: a function of all cameras, from world coordinates, in the order of the pose file. words: the allowed
    values; or numbers: how many it takes, the last of which must be positive unless may_be_negative. doublings: the
    checks double and halve a number up to this many times; they try every word. of_all: the change of one camera
    depends on the others."""

    change: Change
    words: tuple[str, ...] = ()
    numbers: int = 0
    may_be_negative: bool = False
    doublings: int = 0
    of_all: bool = False


def read_repairs(capture: Path) -> tuple[Repair, ...]:
    """The repairs in a capture folder's ``repairs.json``, in order; none without that file."""
    file = capture / REPAIRS_NAME
    if not file.is_file():
        return ()
    listed = read_json_object(file).get("repairs")
    if not isinstance(listed, list) or len(listed) > MAX_REPAIRS or not all(isinstance(text, str) for text in listed):
        raise SceneError(
            f'{file} is not {{"repairs": [texts]}} with at most {MAX_REPAIRS} of them: write it again with '
            "'og-pointcloud repair', or remove it"
        )
    return tuple(map(Repair.parse, listed))


def repaired_cameras(cameras: Sequence[Camera], repairs: Sequence[Repair]) -> list[Camera]:
    """The cameras after these repairs, one after the other. cameras: from world coordinates, in the order of the pose
    file."""
    repaired = list(cameras)
    for repair in repairs:
        repaired = KINDS[repair.name].change(repaired, repair)
    return repaired


def repaired_images(images: Sequence[PosedImage], repairs: Sequence[Repair]) -> tuple[PosedImage, ...]:
    """The images after these repairs. Depth images move with their photographs, and scale with them unless they are of
    a sensor with intrinsics of its own."""
    cameras = repaired_cameras([image.camera for image in images], repairs)
    # All images have an entry, so that repairs of all cameras together shift depth images as they shift photographs.
    depths = repaired_cameras([image.depth.camera if image.depth else image.camera for image in images], repairs)
    without_lens = {"lens": None} if any(repair.name == "lens" for repair in repairs) else {}
    repaired = []
    for image, camera, depth_camera in zip(images, cameras, depths, strict=True):
        depth = image.depth
        if depth is not None:
            as_photograph = depth.camera.resized(image.camera.width, image.camera.height).intrinsics
            if not np.allclose(as_photograph, image.camera.intrinsics, rtol=SAME_LENS_TOLERANCE):
                depth_camera = replace(depth.camera, world_to_camera=depth_camera.world_to_camera)
            depth = replace(depth, camera=depth_camera, **without_lens)
        repaired.append(replace(image, camera=camera, depth=depth, **without_lens))
    return tuple(repaired)


def repaired_layers(layers: Sequence[MaskLayer], repairs: Sequence[Repair]) -> list[MaskLayer]:
    """The masks after these repairs; layers: of whole images, in the order of the pose file."""
    repaired = list(layers)
    # In the order of the list: shifting images and flipping each do not depend on each other.
    for value in (repair.value for repair in repairs if repair.name == "masks"):
        if value in MASK_SHIFTS:
            by = MASK_SHIFTS[value] % len(repaired)
            repaired = repaired[by:] + repaired[:by]
        else:
            repaired = [replace(layer, read=partial(_read_repaired, layer.read, value)) for layer in repaired]
    return repaired


def _read_repaired(read: Callable[[], IntArray], value: str) -> IntArray:
    ids = read()
    return np.where(ids < 0, ids, ids + 1) if value == "from-zero" else np.ascontiguousarray(MASK_FLIPS[value](ids))


def _numbers(text: str) -> tuple[float, ...]:
    """The numbers between commas; none if they are not finite numbers."""
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        return ()
    return numbers if np.isfinite(numbers).all() else ()


# Effects on cameras ---------------------------------------------------------------------------------------------------


def _each(change: Callable[[Camera, Repair], Camera]) -> Change:
    return lambda cameras, repair: [change(camera, repair) for camera in cameras]


def _each_pose(change: Callable[[DoubleArray, Repair], DoubleArray]) -> Change:
    """A change of world_to_camera, (4, 4)."""
    return _each(lambda camera, repair: replace(camera, world_to_camera=change(camera.world_to_camera, repair)))


def _with_xyzw(pose: DoubleArray, repair: Repair) -> DoubleArray:
    """The pose whose quaternion, stored as x y z w, was read as w x y z. The rotation determines it up to its sign,
    which does not matter: q and -q are the same rotation."""
    return rigid(rotation_of_quaternion(np.roll(quaternion_of(pose[:3, :3]), 1)), pose[:3, 3])


def _with_axes(pose: DoubleArray, repair: Repair) -> DoubleArray:
    """x of the poses' world is the named axis of the cloud's, and so on."""
    turn = np.eye(4)
    for row, axis in enumerate(repair.value.split(",")):
        turn[row, :3] = np.where(np.array(list("xyz")) == axis[-1], -1.0 if axis[0] == "-" else 1.0, 0.0)
    # In a mirrored world (determinant -1) a pose would mirror its image: the camera's x is mirrored back.
    return np.diag([np.linalg.det(turn), 1, 1, 1]).round() @ pose @ turn


def _aligned(cameras: list[Camera], repair: Repair) -> list[Camera]:
    """Cameras' centers c about their mean m become m + s R (c - m) + t, their rotations W become W R'."""
    move, turn, size = repair.numbers[:3], rotation_of_vector(np.deg2rad(repair.numbers[3:6])), repair.numbers[6]
    mean = np.mean([camera.center for camera in cameras], axis=0)
    aligned = []
    for camera in cameras:
        rotation = camera.world_to_camera[:3, :3] @ turn.T
        center = mean + size * turn @ (camera.center - mean) + move
        aligned.append(replace(camera, world_to_camera=rigid(rotation, -rotation @ center)))  # t = -W c
    return aligned


def _neighbors(cameras: list[Camera], repair: Repair) -> list[Camera]:
    by = int(repair.value) % len(cameras)
    poses = [camera.world_to_camera for camera in cameras[by:] + cameras[:by]]
    return [replace(camera, world_to_camera=pose) for camera, pose in zip(cameras, poses, strict=True)]


def _of_another_size(camera: Camera, repair: Repair) -> Camera:
    by = repair.numbers[0]
    return replace(camera, fx=camera.fx * by, fy=camera.fy * by, cx=camera.cx * by, cy=camera.cy * by)


def _focal(camera: Camera, repair: Repair) -> Camera:
    return replace(camera, fx=camera.fx * repair.numbers[0], fy=camera.fy * repair.numbers[0])


def _centered(camera: Camera, repair: Repair) -> Camera:
    if repair.value == "swapped":
        return replace(camera, cx=camera.cy, cy=camera.cx)
    return replace(camera, cx=camera.width / 2, cy=camera.height / 2)


def _shifted(camera: Camera, repair: Repair) -> Camera:
    right, down = repair.numbers
    return replace(camera, cx=camera.cx + right * camera.width, cy=camera.cy + down * camera.height)


def _none(cameras: list[Camera], repair: Repair) -> list[Camera]:
    return cameras


KINDS = {
    "axes": Kind(_each_pose(lambda pose, repair: np.diag(OPENGL_SIGNS) @ pose), ("flipped",)),
    "direction": Kind(_each_pose(lambda pose, repair: np.asarray(np.linalg.inv(pose), np.float64)), ("inverse",)),
    "quaternions": Kind(_each_pose(_with_xyzw), ("xyzw",)),
    "world": Kind(_each_pose(_with_axes), AXIS_NAMES),
    "frames": Kind(_neighbors, ("1", "-1"), of_all=True),
    "center": Kind(_each(_centered), ("swapped", "middle")),
    "scale": Kind(
        _each_pose(lambda pose, repair: rigid(pose[:3, :3], pose[:3, 3] * repair.numbers[0])), numbers=1, doublings=11
    ),
    "intrinsics": Kind(_each(_of_another_size), numbers=1, doublings=4),
    "focal": Kind(_each(_focal), numbers=1, doublings=5),
    "aligned": Kind(_aligned, numbers=7, of_all=True),
    "shifted": Kind(_each(_shifted), numbers=2, may_be_negative=True),
    "lens": Kind(_none, ("none",)),
    "masks": Kind(_none, (*MASK_FLIPS, *MASK_SHIFTS, "from-zero")),
}
