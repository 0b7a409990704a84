"""A tiny capture that tests fit, segment and damage: two balls on a floor, ray-cast exactly, so the truth is known."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

NAMES = ("red ball", "blue ball")
UNUSED_NAME = "lamp"
FEATURE_SPACE = "tiny-test-space"
FEATURE_WIDTH = 16
CENTERS = np.array([[-0.6, 0.0, 0.5], [0.6, 0.1, 0.5]])
RADIUS = 0.5
COLOURS = np.array([[200, 40, 40], [40, 40, 200], [120, 120, 120]], np.uint8)  # the last one is the floor's
WIDTH, HEIGHT, FOCAL_PX = 120, 90, 110.0
FLOOR = -1


@dataclass(frozen=True)
class TinyCapture:
    """folder: the capture. object_ids: (n,) int32, row of NAMES per point of points.ply, -1 on the floor."""

    folder: Path
    object_ids: NDArray[np.int32]

    @property
    def text_features(self) -> Path:
        return self.folder / "text_features.npz"

    def share_correct(self, labels: NDArray[np.int32], names: list[str]) -> float:
        """Share of the balls' points whose label is their ball; unknown counts as wrong."""
        truth = np.array([names.index(name) for name in NAMES])[self.object_ids]
        on_ball = self.object_ids != FLOOR
        return float((labels[on_ball] == truth[on_ball]).mean())


@pytest.fixture
def tiny_capture(tmp_path: Path) -> TinyCapture:
    """A plain-format capture of about 1,500 points and 6 views in ``tmp_path / "capture"``."""
    return write_tiny_capture(tmp_path / "capture")


def write_tiny_capture(folder: Path, view_count: int = 6) -> TinyCapture:
    random = np.random.default_rng(0)
    for name in ("images", "masks"):
        (folder / name).mkdir(parents=True)
    xyz, object_ids = sample_surfaces()
    write_ply(folder / "points.ply", xyz, COLOURS[object_ids])

    vectors = np.linalg.qr(random.normal(size=(FEATURE_WIDTH, FEATURE_WIDTH)))[0].astype(np.float32)[:3]
    frames, features = [], {}
    for index in range(view_count):
        stem = f"view{index}"
        camera_to_world = look_at(
            2.6 * angle_vector(2 * np.pi * (index + 0.25) / view_count), target=np.array([0, 0, 0.4])
        )
        object_map = ray_cast(camera_to_world)
        order = random.permutation(len(NAMES))  # mask ids mean nothing across views
        mask = np.append(order + 1, 0)[object_map].astype(np.uint16)
        cv2.imwrite(str(folder / "masks" / f"{stem}.png"), mask)
        cv2.imwrite(str(folder / "images" / f"{stem}.png"), COLOURS[object_map][..., ::-1])
        rows = np.argsort(order)
        features[stem] = vectors[rows] + 0.05 * random.normal(size=(len(rows), FEATURE_WIDTH)).astype(np.float32)
        frames.append({"file_path": f"images/{stem}.png", "transform_matrix": camera_to_world.tolist()})

    intrinsics = {"fl_x": FOCAL_PX, "fl_y": FOCAL_PX, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT}
    transforms = {**intrinsics, "ply_file_path": "points.ply", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(transforms))
    np.savez(folder / "mask_features.npz", feature_space=np.array(FEATURE_SPACE), **features)
    names = np.array([*NAMES, UNUSED_NAME])
    np.savez(folder / "text_features.npz", names=names, vectors=vectors, feature_space=np.array(FEATURE_SPACE))
    return TinyCapture(folder, object_ids)


def sample_surfaces(per_ball: int = 500, floor_side: int = 24) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Points (n, 3) on two balls (Fibonacci lattice) and a square floor at z = 0, with their object ids."""
    step = np.arange(per_ball) + 0.5
    height, turn = 1 - 2 * step / per_ball, step * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - height**2)
    sphere = np.stack([ring * np.cos(turn), ring * np.sin(turn), height], axis=1) * RADIUS
    side = np.linspace(-1.2, 1.2, floor_side)
    floor = np.stack([*np.meshgrid(side, side), np.zeros((floor_side, floor_side))], axis=-1).reshape(-1, 3)
    xyz = np.concatenate([sphere + CENTERS[0], sphere + CENTERS[1], floor]).astype(np.float32)
    return xyz, np.repeat(np.array([0, 1, FLOOR], np.int32), [per_ball, per_ball, len(floor)])


def angle_vector(angle: float) -> NDArray[np.float64]:
    return np.array([np.cos(angle), np.sin(angle), 0.6])


def look_at(position: NDArray[np.float64], target: NDArray[np.float64]) -> NDArray[np.float64]:
    """Camera-to-world (4, 4), OpenGL axes (x right, y up, z backward), world z up."""
    backward = (position - target) / np.linalg.norm(position - target)
    right = np.cross([0.0, 0.0, 1.0], backward)
    right /= np.linalg.norm(right)
    camera_to_world = np.eye(4)
    camera_to_world[:3] = np.stack([right, np.cross(backward, right), backward, position], axis=1)
    return camera_to_world


def ray_cast(camera_to_world: NDArray[np.float64]) -> NDArray[np.int32]:
    """Object seen by each pixel, (HEIGHT, WIDTH) int32: a row of NAMES, or -1 (floor or sky)."""
    column, row = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    in_camera = np.stack([(column - WIDTH / 2) / FOCAL_PX, -(row - HEIGHT / 2) / FOCAL_PX, -np.ones_like(row)], axis=-1)
    direction = in_camera @ camera_to_world[:3, :3].T
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    nearest = np.full((HEIGHT, WIDTH), np.inf)
    seen = np.full((HEIGHT, WIDTH), FLOOR, np.int32)
    for index, center in enumerate(CENTERS):
        along = direction @ (center - camera_to_world[:3, 3])
        miss_squared = ((center - camera_to_world[:3, 3]) ** 2).sum() - along**2
        distance = np.where(miss_squared < RADIUS**2, along - np.sqrt(np.maximum(RADIUS**2 - miss_squared, 0)), np.inf)
        seen[distance < nearest] = index
        nearest = np.minimum(nearest, distance)
    return seen


def write_ply(path: Path, xyz: NDArray[np.float32], rgb: NDArray[np.uint8]) -> None:
    """A binary little-endian cloud, written here so that the project's own writer is not what its reader is held to."""
    fields = [(name, "<f4") for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
    rows = np.empty(len(xyz), fields)
    for index, (name, _) in enumerate(fields):
        rows[name] = xyz[:, index] if index < 3 else rgb[:, index - 3]
    kind = {"<f4": "float", "u1": "uchar"}
    properties = "".join(f"property {kind[code]} {name}\n" for name, code in fields)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(xyz)}\n{properties}end_header\n"
    path.write_bytes(header.encode() + rows.tobytes())
