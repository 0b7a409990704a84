"""Messages of one stamp -> a frame of a map: depth and color images, masks with features, the camera.

Depth is 16UC1 in millimeters or 32FC1 in meters (REP 118). Masks are 8UC1, 16UC1 or 32SC1: 0 none, else a number from
1 on that is valid in this image only. Any of them may be a CompressedImage, as image_transport's plugins `compressed`
(PNG, or JPEG for colors) and `compressedDepth` (PNG) publish them. A PointCloud2 with a field ``feature`` has one row
per mask, the encoder's features of masks 1, 2, ... CameraInfo has pixel centers at integer coordinates.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError, printable
from og_pointcloud.formats.depth import lengths
from og_pointcloud.formats.images import decoded_bytes, require_cv2
from og_pointcloud.formats.poses import Sensor
from og_pointcloud.mapping.frame import Frame
from og_pointcloud.scene import Camera
from og_pointcloud_ros.messages import NANOSECONDS, nanoseconds
from og_pointcloud_ros.pointcloud2 import read_fields

REQUIRED_ROLES = ("depth", "masks", "features")
"""Roles of messages that a frame waits for."""
ENCODINGS = {
    "8UC1": ("u1", 1), "mono8": ("u1", 1), "16UC1": ("u2", 1), "mono16": ("u2", 1), "32SC1": ("i4", 1),
    "32FC1": ("f4", 1), "rgb8": ("u1", 3), "bgr8": ("u1", 3), "rgba8": ("u1", 4), "bgra8": ("u1", 4),
}  # fmt: skip
"""Encoding of an image -> type and number of its channels."""
KINDS = {"depth": ("u2", "i4", "f4"), "masks": ("u1", "u2", "i4")}
"""Types of pixels, by role."""
WRONG_KINDS = {
    "depth": "is {}; expected 16UC1, millimeters, or 32FC1, meters: 8 bits have lost the lengths",
    "masks": "are {}; expected 8UC1, 16UC1 or 32SC1: numbers of masks",
}
"""What an error says of other types."""
JPEG = b"\xff\xd8"
"""First bytes of a JPEG file."""
MAX_METERS = 250.0
"""No camera measures a depth beyond it at most of its pixels: such numbers are millimeters."""
DEPTH_HEADER = 12
"""Bytes before the PNG of a `compressedDepth` image: an int32, and two float32 that depth in meters is coded by."""


def image_array(message: Any) -> NDArray[Any]:
    """(H, W) or (H, W, 3) pixels of a sensor_msgs/Image, colors as RGB. SceneError for an unknown encoding."""
    encoding = str(message.encoding)
    if encoding not in ENCODINGS:
        raise SceneError(f"image encoding is '{encoding}'; expected one of {', '.join(ENCODINGS)}")
    code, channels = ENCODINGS[encoding]
    kind = np.dtype(code).newbyteorder(">" if message.is_bigendian else "<")
    data = np.frombuffer(np.asarray(message.data, np.uint8).tobytes(), np.uint8)
    # A line may be longer than its pixels: step includes padding.
    line = message.width * channels * kind.itemsize
    if message.step < line or len(data) < message.step * message.height:
        raise SceneError(f"image: {len(data)} bytes, {message.step} per row; expected {message.height} rows of {line}")
    lines = data[: message.step * message.height].reshape(message.height, message.step)[:, :line]
    pixels = np.ascontiguousarray(lines).view(kind).reshape(message.height, message.width, channels)
    pixels = pixels.astype(kind.newbyteorder("="))
    return pixels[..., 0] if channels == 1 else pixels[..., 2::-1] if encoding[0] == "b" else pixels[..., :3]


def compressed_image_array(message: Any) -> NDArray[Any]:
    """Pixels of a sensor_msgs/CompressedImage, as `image_array` gives those of the image that was compressed.

    Its format is "ENCODING; compressed" or "ENCODING; compressedDepth" with details after it, or as from many
    cameras' drivers only "jpeg" or "png". SceneError where it cannot be decoded.
    """
    encoding, _, how = str(message.format).partition(";")
    name = f"an image of format '{printable(message.format, 40)}'"
    data, start = np.asarray(message.data, np.uint8), DEPTH_HEADER if "compressedDepth" in how else 0
    if start and "rvl" in how.lower():
        raise SceneError(
            f"{name} is coded by RVL; expected PNG: set the publisher's compressedDepth format to png, or take the "
            "uncompressed topic"
        )
    read = decoded_bytes(data[start:], require_cv2().IMREAD_UNCHANGED, name)
    pixels: NDArray[Any] = np.asarray(read)
    if start and encoding.strip() == "32FC1":
        if pixels.dtype != np.uint16 or pixels.ndim != 2:
            raise SceneError(f"compressedDepth of 32FC1 holds {pixels.dtype} {pixels.shape}; expected 16-bit gray")
        # Stored is a / depth + b (compressed_depth_image_transport's codec), 0 where nothing was measured.
        a, b = data[4:start].view("<f4").astype(np.float64)
        return np.divide(a, pixels - b, out=np.zeros(pixels.shape), where=pixels > 0).astype(np.float32)
    return pixels if pixels.ndim == 2 else np.ascontiguousarray(pixels[..., 2::-1])


@dataclass
class _Parts:
    """The messages of one stamp received so far. frame_id: of the camera."""

    frame_id: str = ""
    depth: NDArray[Any] | None = None
    masks: NDArray[Any] | None = None
    color: NDArray[Any] | None = None
    features: NDArray[Any] | None = None


class FrameAssembler:
    """Groups messages into frames by stamp. required: roles that a frame waits for. rectified: whether images are
    rectified, as by image_proc: their camera_info still describes the lens of the raw ones. waiting: by stamp, in
    nanoseconds, in order of arrival."""

    def __init__(self, required: Iterable[str] = REQUIRED_ROLES, *, rectified: bool = False) -> None:
        self.required, self.rectified, self.waiting = tuple(required), rectified, dict[int, _Parts]()
        self._info: Any = None
        self._warned = False  # of colors that are left out

    def add(self, role: str, message: Any) -> None:
        """Add a message of a role: "info" or a field of `_Parts`. SceneError if it does not fit the role."""
        stamp = nanoseconds(message.header.stamp)
        if role == "info":  # the lens does not change from frame to frame: the latest one serves all
            self._info = message
            return
        parts = self.waiting.setdefault(stamp, _Parts())
        if role == "features":
            rows = read_fields(message)
            if "feature" not in (rows.dtype.names or ()):
                raise SceneError(
                    f"features have fields {rows.dtype.names}; expected a field 'feature' with one row per mask"
                )
            # The width comes from the field: an image without masks has 0 rows of it.
            width = rows.dtype["feature"].shape or (1,)
            parts.features = np.asarray(rows["feature"], np.float32).reshape(rows.size, *width)
        else:
            if role == "depth" or not parts.frame_id:  # a color camera may stand beside that of depth
                parts.frame_id = message.header.frame_id
            if (compressed := hasattr(message, "format")) and role != "color" and bytes(message.data[:2]) == JPEG:
                raise SceneError(
                    f"{role} are JPEG images, which change numbers; expected PNG, compressedDepth or raw ones"
                )
            pixels = compressed_image_array(message) if compressed else image_array(message)
            if role in KINDS and pixels.dtype.str[1:] not in KINDS[role]:
                raise SceneError(f"{role} {WRONG_KINDS[role].format(pixels.dtype)}")
            if role == "color" and pixels.ndim == 2:  # of a gray camera
                pixels = np.repeat(pixels[..., None], 3, axis=2)
            setattr(parts, role, pixels)

    def is_complete(self, stamp: int) -> bool:
        """Whether everything that a frame waits for has arrived, including the camera."""
        parts = self.waiting[stamp]
        return self._info is not None and all(getattr(parts, role) is not None for role in self.required)

    def unpaired(self, stamp: int) -> str:
        """Why the masks or features of a stamp cannot be used, as the other is missing; empty if neither is."""
        parts = self.waiting[stamp]
        if (parts.masks is None) == (parts.features is None):
            return ""
        one, other = ("masks", "features") if parts.features is None else ("features", "masks")
        return f"{one} came without {other} of the same stamp: give both the stamp of their image"

    def frame(self, stamp: int, pose: Callable[[str, int], NDArray[np.float64]]) -> Frame | None:
        """The frame of a stamp, from what has arrived; None without depth or masks with features. Call `forget` after
        use.

        pose: (frame id, stamp) -> (4, 4) from that frame to the map; its errors propagate. SceneError without a camera.
        """
        parts = self.waiting[stamp]
        masks = features = None
        if parts.masks is not None and parts.features is not None:
            # Mask i + 1 is row i of the features; 0, no mask, becomes -1.
            masks, features = parts.masks.astype(np.int64) - 1, parts.features
        if parts.depth is None and masks is None:
            return None
        if self._info is None:
            raise SceneError("no camera_info came with it")
        camera = _camera(self._info, self.rectified, np.linalg.inv(pose(parts.frame_id, stamp)).astype(np.float64))
        depth = None if parts.depth is None else _meters(parts.depth)
        return Frame(camera, masks, features, depth, rgb=self._rgb(parts.color, camera), stamp=stamp / NANOSECONDS)

    def _rgb(self, color: NDArray[Any] | None, camera: Camera) -> NDArray[np.uint8] | None:
        """Colors that fit the camera's image; else None, with a single warning, as frames do not need them."""
        if color is None or (color.dtype == np.uint8 and color.shape[:2] == (camera.height, camera.width)):
            return color
        if not self._warned:
            warnings.warn(
                f"color images are {color.dtype} {color.shape}; expected uint8 ({camera.height}, {camera.width}, 3), "
                "as camera_info says of depth and masks: colors are left out",
                stacklevel=3,
            )
            self._warned = True
        return None

    def forget(self, stamp: int) -> None:
        """Drop a stamp."""
        self.waiting.pop(stamp, None)


def _meters(stored: NDArray[Any]) -> NDArray[np.float32]:
    """Depth in meters, 0 where none was measured. SceneError where it is stored as floats, but of millimeters."""
    depth = lengths(stored)
    if depth.any() and (median := float(np.median(depth[depth > 0]))) > MAX_METERS:
        raise SceneError(
            f"depth of {median:,.0f} m, the median of an image; expected meters in 32FC1 (REP 118), less than "
            f"{MAX_METERS:.0f}: publish millimeters as 16UC1"
        )
    return depth


def _camera(info: Any, rectified: bool, world_to_camera: NDArray[np.float64]) -> Camera:
    if not rectified and np.any(np.abs(np.asarray(info.d, np.float64)) > 1e-9):
        raise SceneError(
            "camera_info has distortion; expected rectified images: use image_rect topics (in a bag, with 'rect' in "
            "their names; for the node, with rectified:=true)"
        )
    # K, 3 x 3, is the lens of the raw images, P, 3 x 4, that of the rectified ones (sensor_msgs/CameraInfo).
    k, p = np.reshape(info.k, (3, 3)), np.reshape(info.p, (3, 4))
    sensor = Sensor.from_matrix((int(info.width), int(info.height)), p if rectified and p[0, 0] > 0 else k)
    return Camera(*sensor.size, sensor.fx, sensor.fy, sensor.cx, sensor.cy, world_to_camera)
