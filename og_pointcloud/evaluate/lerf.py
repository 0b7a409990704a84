"""LeRF-OVS object selection, from the data set's own folders: select by text, render the selection, compare outlines.

``DIR/label/<scene>/frame_00041.json`` has the outlines of the queried objects, ``DIR/<scene>/sparse/0`` the poses.

Rules. A text selects Gaussians, only these are rendered, and the predicted mask is where their alpha is above 0.7. A
(frame, object) pair scores the IoU with the outlined mask, 0 where nothing is selected or rendered; several outlines of
one category in a frame are one object. mIoU is the mean over a scene's pairs, accuracy the share of pairs with an IoU
above 0.25; the table's figure is the mean of the four scenes (macro).

A text selects in two ways, scored side by side, since selection is where most is lost:

    best         the one instance that the text fits best, whatever its score: no threshold, never nothing
    calibrated   the instances that the text fits better than the everyday words of the scene's word bank; may be none.
                 Without a bank, as best
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.ask.labelled_scene import LabelledScene
from og_pointcloud.ask.selecting import select
from og_pointcloud.cloud import LabelledCloud
from og_pointcloud.errors import SceneError
from og_pointcloud.formats.colmap import find_model, read_images
from og_pointcloud.formats.images import MAX_PIXELS, require_cv2, same_shape
from og_pointcloud.formats.points import read_points
from og_pointcloud.formats.poses import in_local_frame
from og_pointcloud.rendering.geometry import near_plane
from og_pointcloud.rendering.splatting import Gaussians, render
from og_pointcloud.scene import Camera
from og_pointcloud.text.words import TextFeatures

MIN_ALPHA, MIN_IOU = 0.7, 0.25
"""The protocol's bounds (see above): alpha of a rendered pixel, and IoU of a pair for accuracy."""
PUBLISHED_PAIRS = 208
"""(frame, object) pairs of the published table, in four scenes."""
WAYS = ("best", "calibrated")
LABEL_FOLDER = "label"
MAX_OFFSET_SPACINGS = 0.01
"""Share of the point spacing by which a fitted cloud and its Gaussians may differ."""

Alpha = NDArray[np.floating]


@dataclass(frozen=True)
class LabelledFrame:
    """name: file stem of the image. width, height: its pixels. objects: category -> (H, W) bool."""

    name: str
    width: int
    height: int
    objects: dict[str, NDArray[np.bool_]]


@dataclass(frozen=True)
class LerfScene:
    """A scene's labelled frames, and the camera of each, from world coordinates, at the size of its label image."""

    name: str
    frames: tuple[LabelledFrame, ...]
    cameras: tuple[Camera, ...]

    @property
    def objects(self) -> list[str]:
        """All labelled objects, in alphabetical order."""
        return sorted({name for frame in self.frames for name in frame.objects})


@dataclass(frozen=True)
class PairScore:
    """A (frame, object) pair. iou: by way of selecting."""

    frame: str
    object: str
    iou: dict[str, float]


# Reading --------------------------------------------------------------------------------------------------------


def scene_names(folder: Path) -> list[str]:
    """The scenes that have labels; SceneError where there is none."""
    names = sorted({file.parent.name for file in (folder / LABEL_FOLDER).glob("*/*.json")})
    if not names:
        raise SceneError(
            f"{folder} has no {LABEL_FOLDER}/<scene>/frame_*.json; expected the LeRF-OVS folder, which contains "
            f"<scene>/ and {LABEL_FOLDER}/"
        )
    return names


def read_scene(folder: Path, name: str) -> LerfScene:
    """Labels and poses of one scene. SceneError names what is missing: labels, poses, the pose of a labelled frame."""
    files = sorted((folder / LABEL_FOLDER / name).glob("*.json"))
    if not files:
        raise SceneError(f"{folder / LABEL_FOLDER / name} has no frame_*.json; expected the labels of '{name}'")
    model = find_model(folder / name)
    if model is None:
        raise SceneError(f"{folder / name} has no poses; expected COLMAP's sparse/0 with cameras and images")
    images = {Path(image.path).stem: image for image in read_images(model)}
    frames, cameras = [], []
    for file in files:
        frame = read_frame(file)
        image = images.get(frame.name)
        if image is None:
            raise SceneError(f"{file}: frame '{frame.name}' has none of the {len(images)} poses in {model}")
        if image.lens is not None:
            raise SceneError(f"{model}: frame '{frame.name}' has a distorted lens; labels are for undistorted images")
        size, labelled = (image.camera.width, image.camera.height), (frame.width, frame.height)
        if not same_shape(size, labelled):
            raise SceneError(f"{file} has {labelled} pixels, its camera {size}; expected the same aspect ratio")
        frames.append(frame)
        cameras.append(image.camera.resized(*labelled))
    return LerfScene(name, tuple(frames), tuple(cameras))


def read_frame(file: str | Path) -> LabelledFrame:
    """One label file. SceneError names the file, the object and what was expected."""
    try:
        content: Any = json.loads(Path(file).read_text(encoding="utf-8"))
        info, objects = content["info"], content["objects"]
        name, width, height = str(info["name"]), int(info["width"]), int(info["height"])
        outlines = [(str(entry["category"]), entry["segmentation"]) for entry in objects]
    except (ValueError, TypeError, KeyError, RecursionError, OverflowError) as error:
        raise SceneError(
            f"{file} is not a LeRF-OVS label file with info and objects ({error}): copy it again"
        ) from None
    if min(width, height) < 1 or width * height > MAX_PIXELS:
        raise SceneError(f"{file} is for an image of {width}x{height} pixels; expected 1 to {MAX_PIXELS}")
    masks: dict[str, NDArray[np.bool_]] = {}
    for category, outline in outlines:
        # Outlines of one category are one object: their union.
        mask = _filled(outline, (height, width), f"{file}, object '{category}'")
        masks[category] = masks[category] | mask if category in masks else mask
    return LabelledFrame(Path(name).stem, width, height, masks)


def _filled(outline: Any, shape: tuple[int, int], source: str) -> NDArray[np.bool_]:
    try:
        corners = np.array(outline, np.float64)
    except (ValueError, TypeError):
        corners = np.empty((0, 0))
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3 or not np.isfinite(corners).all():
        raise SceneError(f"{source}: the outline is {outline!r:.60}; expected at least three [x, y]")
    mask = np.zeros(shape, np.uint8)
    limit = 1 << 20  # OpenCV takes 32-bit integers; points this far outside the image are clipped either way
    require_cv2().fillPoly(mask, [np.clip(np.rint(corners), -limit, limit).astype(np.int32)], 1)
    return mask.astype(bool)


def gaussians_of(cloud: LabelledCloud, file: Path) -> Gaussians:
    """The cloud's Gaussians, in its local frame, from the file that it was fitted from. SceneError where the file
    belongs to another cloud."""
    points = read_points(file)
    gaussians = Gaussians.from_points(points)
    if len(points) != len(cloud):
        raise SceneError(f"{file} has {len(points)} Gaussians, the scene {len(cloud)} points; expected one per point")
    apart = float(np.abs(points.xyz_world - cloud.xyz_world).max(initial=0))
    if apart > MAX_OFFSET_SPACINGS * cloud.spacing:
        raise SceneError(f"{file}: Gaussians lie up to {apart:.3g} from the scene's points; expected its own")
    return Gaussians(cloud.xyz, gaussians.scale, gaussians.rotation, gaussians.opacity)


# Scoring --------------------------------------------------------------------------------------------------------


def score_pairs(
    scene: LabelledScene, labels: LerfScene, gaussians: Gaussians, text_features: TextFeatures = None
) -> list[PairScore]:
    """The IoU of every (frame, object) pair, for every way of selecting.

    gaussians: of the scene's points (`gaussians_of`). text_features: vectors of the objects' names; by default, the
    scene's own words and text encoder.
    """
    cameras = [in_local_frame(camera, scene.cloud.origin) for camera in labels.cameras]
    near = near_plane(scene.cloud.xyz, cameras)  # one for all frames, as in the fit
    # Each object is queried by itself, as in the protocol: other objects' names do not compete.
    selected = {name: select(scene, name, against=[], text_features=text_features) for name in labels.objects}
    best = {name: () if one.best is None else (one.best.instance,) for name, one in selected.items()}
    chosen = {"best": best, "calibrated": {name: one.instances for name, one in selected.items()}}
    scores = []
    for frame, camera in zip(labels.frames, cameras, strict=True):
        shown = partial(_alpha, gaussians, scene.instance_ids, camera, near)
        ious = {way: pair_ious(frame, {name: shown(chosen[way][name]) for name in frame.objects}) for way in WAYS}
        scores += [PairScore(frame.name, name, {way: of[name] for way, of in ious.items()}) for name in frame.objects]
    return scores


def pair_ious(frame: LabelledFrame, alphas: Mapping[str, Alpha]) -> dict[str, float]:
    """IoU of each object of a frame. alphas: category -> (H, W) alpha of its selection's render."""
    ious = {}
    for category, truth in frame.objects.items():
        shown = alphas[category] > MIN_ALPHA
        union = int((shown | truth).sum())
        ious[category] = int((shown & truth).sum()) / union if union else 0.0
    return ious


def score_scenes(ious: Mapping[str, NDArray[np.floating]]) -> tuple[float, float]:
    """Mean over scenes of their mIoU, and of their share of pairs above MIN_IOU.

    ious: scene -> (pairs,) IoU of all its (frame, object) pairs. Scenes without a pair are left out.
    """
    scenes = [np.asarray(values, np.float64) for values in ious.values() if len(values)]
    if not scenes:
        raise SceneError("no labeled object in any frame; expected at least one")
    return float(np.mean([scene.mean() for scene in scenes])), float(np.mean([(s > MIN_IOU).mean() for s in scenes]))


def _alpha(
    gaussians: Gaussians, ids: NDArray[np.int32], camera: Camera, near: float, instances: Sequence[int]
) -> NDArray[np.float32]:
    """(H, W) alpha of a view of some instances' points alone, with nothing in front."""
    alone = gaussians.take(np.flatnonzero(np.isin(ids, instances)))
    return render(alone, np.zeros((len(alone), 0), np.float32), camera, near)[1]
