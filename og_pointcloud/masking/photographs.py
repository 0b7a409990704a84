"""The posed images of a capture folder, and a contact sheet of their masks, to check before a long run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.capture import find_images, read_photograph, read_poses
from og_pointcloud.formats.colors import label_colors
from og_pointcloud.formats.faces import Face
from og_pointcloud.formats.images import exif_quarter_turns, image_size, require_cv2, require_scaled, write_png
from og_pointcloud.formats.poses import PosedImage
from og_pointcloud.scene import Camera

CELL_WIDTH_PX = 480
MASK_OPACITY = 0.55


@dataclass(frozen=True)
class Photograph:
    """A posed image. name: its view's. path: as in the pose file. file: where it is. camera: from world coordinates.

    face: None where masks are made on the image as it is; they are undistorted when they are read. An image that no
    pinhole can show becomes several photographs, each a face of a cube: models are trained on pinhole images, and no
    border of a panorama cuts a thing in two.
    quarter_turns: how often it must be turned by 90 degrees, counter-clockwise, to stand upright.
    """

    name: str
    path: str
    file: Path
    camera: Camera
    face: Face | None = None
    quarter_turns: int = 0

    def read(self, longest_side: int) -> NDArray[np.uint8]:
        """(h, w, 3) uint8 RGB, shrunk so that neither side is longer. Gray, 16-bit and alpha become 8-bit RGB. Not
        turned upright: poses are for the pixels as stored, and ignore EXIF orientation."""
        width, height = image_size(self.file)
        if self.face is not None:
            camera = self.face.of_whole_size(width, height).camera
            width, height = camera.width, camera.height
        scale = min(1.0, longest_side / max(width, height))
        size = (width, height) if scale == 1 else (max(1, round(width * scale)), max(1, round(height * scale)))
        return read_photograph(self.file, self.camera.resized(*size), self.face)


def read_photographs(capture: Path) -> tuple[Photograph, ...]:
    """All posed images of a capture, checked by their headers. SceneError where one is missing or cannot be used."""
    poses = read_poses(capture)
    files = find_images(capture, poses.images)
    missing = [image.path for image, file in zip(poses.images, files, strict=True) if file is None]
    if missing:
        raise SceneError(
            f"{capture}: {len(missing)} of {len(files)} posed images are not found, e.g. '{missing[0]}'; expected all: "
            "masks are made from images, so copy them there or remove them from the pose file"
        )
    named = zip(poses.names, poses.images, files, strict=True)
    return tuple(_photograph(name, image, file) for name, image, file in named if file is not None)


def _photograph(name: str, image: PosedImage, file: Path) -> Photograph:
    whole = image.camera if image.face is None else image.face.whole
    # Checked here, not when the image is processed: a night of work must not end with a wrong size.
    cure = (
        "fix the width and height in the pose file, or rotate the image (EXIF orientation is ignored: poses are for "
        "the pixels as stored)"
    )
    require_scaled(f"{file} is", image_size(file), (whole.width, whole.height), cure)
    if image.face is None or not image.face.name:
        return Photograph(name, image.path, file, whole, None, _turns_upright(image, file))
    return Photograph(name, image.path, file, image.camera, image.face)


def _turns_upright(image: PosedImage, file: Path) -> int:
    """Quarter turns by gravity where the data set says where up is, else by the file's EXIF orientation."""
    if image.up is None:
        return exif_quarter_turns(file)
    right, down, _ = image.camera.world_to_camera[:3, :3] @ np.array(image.up)
    return int(np.argmax([-down, right, down, -right]))


def write_contact_sheet(path: Path, pictures: Sequence[tuple[NDArray[np.uint8], NDArray[np.int32]]]) -> None:
    """A PNG of images in a row, with their masks below. pictures: (H, W, 3) uint8 RGB and (H, W) ids of each."""
    cv2 = require_cv2()
    height, width = pictures[0][1].shape
    # The first image's size for all: usually there is one camera.
    size = CELL_WIDTH_PX, max(1, round(2 * CELL_WIDTH_PX * height / width))
    cells = [np.vstack([image, _drawn(image, ids)]) for image, ids in pictures]
    sheet = np.hstack([cv2.resize(cell, size, interpolation=cv2.INTER_AREA) for cell in cells])
    write_png(path, sheet)


def _drawn(image: NDArray[np.uint8], ids: NDArray[np.int32]) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 RGB: the image tinted by mask, with white borders. ids: (H, W), -1 outside every mask."""
    tinted = image.astype(np.float32)
    inside = ids >= 0
    tinted[inside] = (1 - MASK_OPACITY) * tinted[inside] + MASK_OPACITY * label_colors(ids[inside])
    # A pixel is border where its left or its upper neighbor has another id.
    tinted[:, 1:][ids[:, 1:] != ids[:, :-1]] = 255
    tinted[1:][ids[1:] != ids[:-1]] = 255
    return tinted.astype(np.uint8)
