"""Walks a camera through the room and writes what it sees as a capture folder, with exact ground truth.

The same seed gives the same room on every machine: random draws never depend on what was seen before, so that the one
pixel in a million that a processor rounds to another object affects nothing else.

The folder: ``images/`` . ``transforms.json`` (nerfstudio: camera-to-world, OpenGL axes) . ``points.ply`` (a fused
cloud from noisy depth) . ``masks/<stem>.png`` (uint16, 0 none, ids local to the image) . ``mask_features.npz`` .
``text_features.npz`` . ``word_bank.npz`` . ``gt.npz`` (for scoring only).
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from og_pointcloud.text.text_features import everyday_words
from og_pointcloud_room.features import FEATURE_SPACE, FeatureModel
from og_pointcloud_room.furniture import CLASS_NAMES
from og_pointcloud_room.masks import MaskNoise, propose_masks
from og_pointcloud_room.raycast import BACKGROUND, Frame, Intrinsics, RayCaster, Surfaces, o3d, tensor
from og_pointcloud_room.room import Room, furnish
from og_pointcloud_room.shapes import rotated

Random = np.random.Generator
FLYING = -2
"""Source of a sample on no surface: interpolated across a depth edge, or an outlier."""
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
ABSENT_WORDS = 50
TOUCHING_M = 1e-4
"""Two surfaces whose distances from a point differ by less are equally near."""
PATH, CLOUD, MASKS, FEATURES, TEXTURE, WORDS = range(1, 7)
"""Random number streams besides that of the furniture; cloud, masks and features have one per view."""


@dataclass(frozen=True)
class CaptureSettings:
    """views: images along the path. width, height: pixels. voxel_m: one point is kept per cube of this side.

    mask_noise: 0 for perfect masks and features of the right class, 1 for the default errors of
    :class:`~og_pointcloud_room.masks.MaskNoise`, more for worse. Masks are numbered at random in every view regardless.
    depth_noise: multiple of a structured-light sensor's noise, 1.2 mm + 1.9 mm (z - 0.4 m)^2 / m^2 (Nguyen 2012).
    range_m: depth beyond it is discarded, as fusion does.
    samples_per_view: pixels of each view that enter the cloud. flying: share of the samples at depth edges that are
    interpolated between front and back. outliers: share of samples placed anywhere in the room.
    """

    views: int = 60
    width: int = 640
    height: int = 480
    voxel_m: float = 0.025
    mask_noise: float = 1.0
    depth_noise: float = 1.0
    range_m: float = 3.5
    samples_per_view: int = 40_000
    flying: float = 0.01
    outliers: float = 5e-5


@dataclass(frozen=True)
class RoomCapture:
    """The contents of a capture folder, and the truth.

    masks: per view (H, W) uint16. mask_features: per view (M, 512) float32. xyz (n, 3) float32 meters, rgb (n, 3)
    uint8. cls, instance: (n,) int32 class and object of each point, -1 where it has none; background: (n,) bool, on
    walls, floor or ceiling. Where ``cls`` is -1 and ``background`` false the truth is ambiguous: a flying pixel, an
    outlier, or a point that noise moved to another surface. bank_vectors: (B, 512) float32, our everyday words,
    including those for the room's things; absent_vectors: (50, 512) float32, words for nothing in it. names: of the
    classes. views: (n,) int32, how many views see each point; None: not counted.
    """

    room: Room
    intrinsics: Intrinsics
    frames: tuple[Frame, ...]
    masks: tuple[NDArray[np.uint16], ...]
    mask_features: tuple[NDArray[np.float32], ...]
    text_vectors: NDArray[np.float32]
    xyz: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    cls: NDArray[np.int32]
    instance: NDArray[np.int32]
    background: NDArray[np.bool_]
    bank_vectors: NDArray[np.float32]
    absent_vectors: NDArray[np.float32]
    names: tuple[str, ...] = CLASS_NAMES
    views: NDArray[np.int32] | None = None

    @property
    def mask_instance(self) -> NDArray[np.int32]:
        """(masks of all views,) the object that fills most of each mask, -1 where it shows none."""
        owners = [np.maximum(frame.owner, BACKGROUND) for frame in self.frames]  # a street also has a sky, below it
        objects = 1 + max(0, *(int(owner.max()) for owner in owners))
        areas = np.concatenate([_area_px(ids, own, objects) for ids, own in zip(self.masks, owners, strict=True)])
        return np.where(areas.any(axis=1), areas.argmax(axis=1), -1).astype(np.int32)


def make_capture(seed: int = 0, settings: CaptureSettings | None = None) -> RoomCapture:
    """Furnish, walk, sense, mask and describe; the same seed and settings give the same arrays."""
    settings = settings or CaptureSettings()
    noise = MaskNoise().scaled(settings.mask_noise)
    room = furnish(seed)
    caster = RayCaster(room, stream(seed, TEXTURE))
    intrinsics = Intrinsics(settings.width, settings.height, 0.82 * settings.width)
    path = walk(room, caster.surfaces, settings.views, stream(seed, PATH))
    frames = tuple(caster.look(intrinsics, pose) for pose in path)
    xyz, rgb, source = _fused_cloud(room, frames, intrinsics, settings, seed)
    instance, background = ground_truth(room, caster.surfaces, xyz, source)
    class_of_object = np.array([CLASS_NAMES.index(item.name) for item in room.objects], np.int32)
    masks = tuple(propose_masks(frame.owner, noise, stream(seed, MASKS, view)) for view, frame in enumerate(frames))
    feature_rng, word_rng = stream(seed, FEATURES), stream(seed, WORDS)
    model = FeatureModel(len(CLASS_NAMES), feature_rng)
    looks = np.stack([model.object_look(feature_rng) for _ in room.objects])
    features = tuple(
        mask_features(ids, frame.owner, class_of_object, looks, model, noise.wrong_class, stream(seed, FEATURES, view))
        for view, (ids, frame) in enumerate(zip(masks, frames, strict=True))
    )
    cls = np.where(instance >= 0, class_of_object[instance], -1).astype(np.int32)
    bank = everyday_vectors(model, CLASS_NAMES, word_rng)
    return RoomCapture(
        room, intrinsics, frames, masks, features, model.texts, xyz, rgb, cls, instance, background,
        bank, model.words(ABSENT_WORDS, word_rng),
    )  # fmt: skip


def everyday_vectors(model: FeatureModel, names: tuple[str, ...], rng: Random) -> NDArray[np.float32]:
    """(B, 512) float32: the encoder's vectors of our everyday words; for a class's name, that class's text."""
    everyday = everyday_words()
    bank = model.words(len(everyday), rng)
    for name, vector in zip(names, model.texts, strict=True):
        if name in everyday:
            bank[everyday.index(name)] = vector
    return bank


def stream(seed: int, purpose: int, *view: int) -> Random:
    """The random numbers of a scene for one purpose, and of one view."""
    return np.random.default_rng([seed, purpose, *view])


# The camera's path ----------------------------------------------------------------------------------------------


def walk(room: Room, surfaces: Surfaces, views: int, rng: Random) -> list[NDArray[np.float64]]:
    """Two hand-held rounds: the first along the furniture looking across, the second in the middle looking outwards.

    The hand moves up and down on the way, to look under and onto things, as when scanning a room.
    """
    half = np.array(room.size[:2]) / 2
    start = rng.uniform(0, 2 * np.pi)
    poses = []
    for step in range(views):
        # progress: 0 to 1 in the first round, 1 to 2 in the second.
        progress = 2 * step / views
        outwards = progress >= 1
        angle = start + 2 * np.pi * progress
        around = np.array([np.cos(angle), np.sin(angle)])
        lift = 0.35 * np.sin(7 * angle)
        if outwards:
            eye = np.array([*(-0.25 * half * around), 1.4 + lift])
            target = np.array([*(half * around), 0.75])
        else:
            eye = np.array([*(0.66 * half * around), 1.45 + lift])
            target = np.array([*(-0.3 * half * around), 0.55])
        eye = eye + rng.normal(size=3) * (0.06, 0.06, 0.08)
        while surfaces.distance_m(eye[None])[0] < 0.35:  # towards the middle and up, off the furniture
            eye[:2] *= 0.9
            eye[2] = min(eye[2] + 0.03, 1.8)
        poses.append(looking_at(eye, target + rng.normal(size=3) * 0.12, roll=rng.normal() * 0.04))
    return poses


def looking_at(eye: NDArray[np.float64], target: NDArray[np.float64], roll: float) -> NDArray[np.float64]:
    """(4, 4) camera-to-world, OpenCV axes, z up in the world; rounded to digits that all processors' sines agree on."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, (0, 0, 1.0))
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    pose = np.eye(4)
    pose[:3, 0] = np.cos(roll) * right + np.sin(roll) * down
    pose[:3, 1] = np.cos(roll) * down - np.sin(roll) * right
    pose[:3, 2], pose[:3, 3] = forward, eye
    return np.round(pose * 2**32) / 2**32


# The cloud ------------------------------------------------------------------------------------------------------


def _fused_cloud(
    room: Room, frames: tuple[Frame, ...], intrinsics: Intrinsics, settings: CaptureSettings, seed: int
) -> tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.int32]]:
    """xyz (n, 3) float32, rgb (n, 3) uint8 and the object each point was sensed on: one noisy sample per voxel."""
    sensed = [_sense(frame, intrinsics, settings, stream(seed, CLOUD, view)) for view, frame in enumerate(frames)]
    xyz, rgb, source, in_range = (np.concatenate(column) for column in zip(*sensed, strict=True))
    # Outliers, anywhere in the room, belong to no object.
    rng, count = stream(seed, CLOUD), int(settings.outliers * len(xyz))
    anywhere = rng.uniform((-0.5, -0.5, 0), (0.5, 0.5, 1), (count, 3)) * room.size
    xyz = np.concatenate([xyz, anywhere])
    rgb = np.concatenate([rgb, rng.integers(0, 256, (count, 3), np.uint8)])
    source = np.concatenate([source, np.full(count, FLYING, np.int32)])
    in_range = np.concatenate([in_range, np.ones(count, bool)])
    # The first sample in random order is kept per voxel; a voxel's key has 20 bits for each coordinate. The order is
    # drawn for all samples, so that one at the limit of the range does not change the order of the others.
    order = rng.permutation(len(xyz))
    order = order[in_range[order]]
    cell = np.floor(xyz[order] / settings.voxel_m).astype(np.int64) + 2**19
    key = (cell[:, 0] << 40) | (cell[:, 1] << 20) | cell[:, 2]
    kept = order[np.unique(key, return_index=True)[1]]
    return xyz[kept].astype(np.float32), rgb[kept], source[kept]


def _sense(
    frame: Frame, intrinsics: Intrinsics, settings: CaptureSettings, rng: Random
) -> tuple[NDArray[np.float64], NDArray[np.uint8], NDArray[np.int32], NDArray[np.bool_]]:
    """Random pixels of one depth image in the world, with sensor noise and flying pixels at depth edges.

    xyz (k, 3), rgb (k, 3), the object that each was sensed on, and whether it lies within the sensor's range.
    """
    pixel = rng.choice(frame.depth_m.size, min(settings.samples_per_view, frame.depth_m.size), replace=False)
    # A depth edge: the nearest and the farthest of the surrounding pixels differ by more than a twentieth.
    window = np.ones((3, 3), np.uint8)
    near, far = cv2.erode(frame.depth_m, window).ravel()[pixel], cv2.dilate(frame.depth_m, window).ravel()[pixel]
    depth_m = frame.depth_m.ravel()[pixel].astype(np.float64)
    flying = (far > 1.05 * near) & (rng.uniform(size=len(pixel)) < settings.flying)
    depth_m = np.where(flying, near + rng.uniform(size=len(pixel)) * (far - near), depth_m)
    depth_m += settings.depth_noise * (0.0012 + 0.0019 * (depth_m - 0.4) ** 2) * rng.normal(size=len(pixel))
    in_camera = intrinsics.directions().reshape(-1, 3)[pixel] * depth_m[:, None]
    xyz = rotated(in_camera, frame.camera_to_world[:3, :3]) + frame.camera_to_world[:3, 3]
    source = np.where(flying, FLYING, frame.owner.ravel()[pixel]).astype(np.int32)
    return xyz, frame.image.reshape(-1, 3)[pixel], source, depth_m < settings.range_m


def ground_truth(
    room: Room, surfaces: Surfaces, xyz: NDArray[np.float32], source: NDArray[np.int32]
) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
    """instance (n,) int32 and background (n,) bool: known where no surface is nearer than that of the ray's target."""
    # Noise may move a point to another surface: then its own object is not the nearest, and it has no truth.
    nearest_m, own_m = surfaces.distance_m(xyz), np.full(len(xyz), np.inf, np.float32)
    for owner in np.unique(source[source != FLYING]):
        items = room.shell if owner == BACKGROUND else (room.objects[owner],)
        own_m[source == owner] = Surfaces(items).distance_m(xyz[source == owner])
    known = own_m <= nearest_m + TOUCHING_M
    return np.where(known, source, -1).astype(np.int32), known & (source == BACKGROUND)


# Mask features --------------------------------------------------------------------------------------------------


def mask_features(
    ids: NDArray[np.uint16], owner: NDArray[np.int32], class_of_object: NDArray[np.int32],
    looks: NDArray[np.float64], model: FeatureModel, wrong_class: float, rng: Random,
) -> NDArray[np.float32]:  # fmt: skip
    """(M, 512) float32 unit rows: an image encoder's feature of each mask.

    A mask over several objects gets the area-weighted mean of their features (shares below a tenth are ignored); a mask
    on bare background, or one that the encoder gets wrong, gets the feature of a random class.
    """
    area_px = _area_px(ids, owner, len(class_of_object))
    features = np.empty((len(area_px), model.texts.shape[1]), np.float32)
    for row, area in enumerate(area_px.astype(np.float64)):
        shown = np.flatnonzero(area > 0.1 * area.sum())
        if len(shown) == 0 or rng.uniform() < wrong_class:
            vector = model.image(int(rng.integers(len(model.texts))), model.object_look(rng), rng)
        else:
            vector = sum(area[k] * model.image(int(class_of_object[k]), looks[k], rng) for k in shown)
        features[row] = vector / np.linalg.norm(vector)
    return features


def _area_px(ids: NDArray[np.uint16], owner: NDArray[np.int32], objects: int) -> NDArray[np.int64]:
    """(M, objects): number of pixels of each mask of a view on each object."""
    pair = ids.astype(np.int64) * (objects + 1) + owner + 1  # column 0: no object, row 0: no mask
    masks = int(ids.max()) + 1
    return np.bincount(pair.ravel(), minlength=masks * (objects + 1)).reshape(masks, objects + 1)[1:, 1:]


# The folder -----------------------------------------------------------------------------------------------------


def write_capture(capture: RoomCapture, folder: Path) -> Path:
    """Writes the capture folder (made if absent, its files replaced) and returns it."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    (folder / "masks").mkdir(exist_ok=True)
    stems = [f"frame-{index:04d}" for index in range(len(capture.frames))]
    for stem, frame, ids in zip(stems, capture.frames, capture.masks, strict=True):
        cv2.imwrite(str(folder / "images" / f"{stem}.jpg"), frame.image[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 93])
        cv2.imwrite(str(folder / "masks" / f"{stem}.png"), ids)
    (folder / "transforms.json").write_text(json.dumps(_transforms(capture, stems), indent=1))
    _write_ply(folder / "points.ply", capture.xyz, capture.rgb)
    rows: dict[str, Any] = {
        stem: rows.astype(np.float16) for stem, rows in zip(stems, capture.mask_features, strict=True)
    }
    space: dict[str, Any] = {"feature_space": np.array(FEATURE_SPACE)}
    names = np.array(capture.names)
    np.savez(folder / "mask_features.npz", **rows, **space)
    np.savez(folder / "text_features.npz", names=names, vectors=capture.text_vectors, **space)
    everyday = np.array(everyday_words())
    np.savez(folder / "word_bank.npz", names=everyday, vectors=capture.bank_vectors.astype(np.float16), **space)
    truth: dict[str, Any] = {"cls": capture.cls, "instance": capture.instance, "background": capture.background}
    if capture.views is not None:
        truth["views"] = capture.views
    np.savez(folder / "gt.npz", names=names, **truth)
    return folder


def _transforms(capture: RoomCapture, stems: list[str]) -> dict[str, object]:
    camera = capture.intrinsics
    frames = [
        {"file_path": f"images/{stem}.jpg", "transform_matrix": (frame.camera_to_world @ OPENGL).tolist()}
        for stem, frame in zip(stems, capture.frames, strict=True)
    ]
    return {
        "camera_model": "PINHOLE", "w": camera.width, "h": camera.height, "fl_x": camera.focal_px,
        "fl_y": camera.focal_px, "cx": camera.width / 2, "cy": camera.height / 2, "ply_file_path": "points.ply",
        "frames": frames,
    }  # fmt: skip


def _write_ply(path: Path, xyz: NDArray[np.float32], rgb: NDArray[np.uint8]) -> None:
    """Written by Open3D, so that the generator shares no code with the reader that it tests."""
    cloud: Any = o3d.t.geometry.PointCloud(tensor(xyz))
    cloud.point.colors = tensor(rgb, np.uint8)
    if not o3d.t.io.write_point_cloud(path, cloud):
        raise OSError(f"Open3D could not write {path}")
