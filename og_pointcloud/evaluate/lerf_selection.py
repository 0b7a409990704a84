"""LeRF-OVS from the data set's own folders: select by text, render the selection alone, hold it against the outlines.

``DIR/label/<scene>/frame_00041.json`` are the outlines, ``DIR/<scene>/sparse/0`` the poses. What a text selects is
asked in three ways, whose scores stand side by side, since choosing is where most is lost:

    best         the one instance that the text fits best, whatever its score: no threshold, and no "nothing"
    calibrated   the instances that the text fits better than the everyday words of the scene's word bank; may be none.
                 Without a bank, the best
    among        the instances that the text fits better than the scene's other labelled objects do, and than the bank's
                 words: whoever asks knows the list
    oracle       the one instance that would have scored best in this frame: what choosing can reach at most
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.ask.labelled_scene import LabelledScene
from og_pointcloud.ask.selecting import select
from og_pointcloud.cloud import LabelledCloud
from og_pointcloud.errors import MissingExtraError, SceneError
from og_pointcloud.evaluate.lerf import LabelledFrame, pair_ious, read_frame
from og_pointcloud.formats.colmap import find_model, read_images
from og_pointcloud.formats.images import same_shape
from og_pointcloud.formats.points import read_points
from og_pointcloud.formats.poses import in_local_frame
from og_pointcloud.scene import Camera, Points, View
from og_pointcloud.settings import GeometrySettings
from og_pointcloud.text.words import TextFeatures

try:
    from og_pointcloud.fitting.mask_table import Gaussians, render
    from og_pointcloud.rendering.geometry import isotropic, near_plane, neighbourhood
except ImportError as error:
    raise MissingExtraError("scipy and numba", "fit") from error

__all__ = ["ORACLE", "WAYS", "LerfScene", "PairScore", "gaussians_of", "read_scene", "scene_names", "score_pairs"]

WAYS = ("best", "calibrated", "among")
ORACLE = "oracle"
LABEL_FOLDER = "label"
SAME_PLACE = 0.01
"""Share of the point spacing by which a fitted cloud and its Gaussians may lie apart."""


@dataclass(frozen=True)
class LerfScene:
    """A scene's labelled frames, and the camera of each, from world coordinates, at the size of its label."""

    name: str
    frames: tuple[LabelledFrame, ...]
    cameras: tuple[Camera, ...]

    @property
    def objects(self) -> list[str]:
        """All labelled objects, in alphabetical order."""
        return sorted({name for frame in self.frames for name in frame.objects})


@dataclass(frozen=True)
class PairScore:
    """A (frame, object) pair. iou: by way. selected: how many instances each way selected."""

    frame: str
    object: str
    iou: dict[str, float]
    selected: dict[str, int]


def scene_names(folder: Path) -> list[str]:
    """The scenes that have labels; SceneError where there is none."""
    names = sorted({file.parent.name for file in (folder / LABEL_FOLDER).glob("*/*.json")})
    if not names:
        raise SceneError(
            f"{folder} has no {LABEL_FOLDER}/<scene>/frame_*.json; expected the folder of LeRF-OVS, with <scene>/ and "
            f"{LABEL_FOLDER}/ in it"
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
            raise SceneError(f"{file} is of frame '{frame.name}', of which {model} has no pose; it has {len(images)}")
        if image.distortion is not None:
            raise SceneError(f"{model}: frame '{frame.name}' has a distorted lens; labels are of undistorted images")
        size, labelled = (image.camera.width, image.camera.height), (frame.width, frame.height)
        if not same_shape(size, labelled):
            raise SceneError(f"{file} is of {labelled} pixels, its camera of {size}; expected one shape, scaled")
        frames.append(frame)
        cameras.append(image.camera.resized(*labelled))
    return LerfScene(name, tuple(frames), tuple(cameras))


def gaussians_of(cloud: LabelledCloud, file: Path | None) -> Gaussians:
    """The cloud's points as splats, in its local frame: those of the file that it was fitted from, or round ones as the
    fit drew a plain cloud. SceneError where neither is known, or the file is another cloud's."""
    if file is None:
        notes = cloud.provenance.get("notes", {})
        scale, opacity = (notes.get(f"gaussian_{name}") for name in ("scale", "opacity"))
        if (
            not isinstance(scale, int | float)
            or not isinstance(opacity, int | float)
            or not (scale > 0 and 0 < opacity <= 1)
        ):
            raise SceneError(
                "the scene does not say how its points were drawn: it was fitted from Gaussians, which its file "
                "does not hold; expected them: name their folder (--gaussians)"
            )
        spacing = neighbourhood(cloud.xyz, GeometrySettings()).spacing
        return isotropic(Points(cloud.xyz, cloud.origin), spacing, scale, opacity)
    points = read_points(file)
    found = Gaussians.from_points(points)
    if len(points) != len(cloud):
        raise SceneError(f"{file} has {len(points)} Gaussians, the scene {len(cloud)} points; expected one each")
    apart = float(np.abs(points.xyz_world - cloud.xyz_world).max(initial=0))
    if apart > SAME_PLACE * cloud.spacing:
        raise SceneError(
            f"{file}: Gaussians lie up to {apart:.3g} from the scene's points; expected those that it was fitted from"
        )
    return Gaussians(cloud.xyz, found.scale, found.rotation, found.opacity)


def score_pairs(
    scene: LabelledScene, labels: LerfScene, gaussians: Gaussians, text_features: TextFeatures = None,
    oracle: bool = False,
) -> list[PairScore]:  # fmt: skip
    """The IoU of every (frame, object) pair, in every way.

    gaussians: of the scene's points (`gaussians_of`). text_features: where the objects' names are found; left out, the
    scene's own words and text encoder. oracle: also that way, which renders every instance into every frame.
    """
    cameras = [in_local_frame(camera, scene.cloud.origin) for camera in labels.cameras]
    near = near_plane(scene.cloud.xyz, [_posed(camera) for camera in cameras])
    chosen = {name: _selected(scene, name, labels.objects, text_features) for name in labels.objects}
    scores = []
    for frame, camera in zip(labels.frames, cameras, strict=True):
        shown = partial(_alpha, gaussians, scene.instance_ids, camera, near)
        ious: dict[str, dict[str, float]] = {}
        for way in WAYS:
            ious[way] = pair_ious(frame, {name: shown(chosen[name][way]) for name in frame.objects})
        if oracle:
            ious[ORACLE] = dict.fromkeys(frame.objects, 0.0)
            for alpha in _each_alone(scene.cloud, shown):
                found = pair_ious(frame, dict.fromkeys(frame.objects, alpha))
                ious[ORACLE] = {name: max(found[name], best) for name, best in ious[ORACLE].items()}
        for name in frame.objects:
            counts = {way: len(chosen[name][way]) for way in WAYS}
            scores.append(PairScore(frame.name, name, {way: of[name] for way, of in ious.items()}, counts))
    return scores


def _selected(
    scene: LabelledScene, text: str, objects: Sequence[str], text_features: TextFeatures
) -> dict[str, tuple[int, ...]]:
    """Instances that a text selects, by way."""
    alone = select(scene, text, against=[], text_features=text_features)
    others = [name for name in objects if name != text]
    among = select(scene, text, against=others, text_features=text_features)
    best = () if alone.best is None else (alone.best.instance,)
    return dict(zip(WAYS, (best, alone.instances, among.instances), strict=True))


def _alpha(
    gaussians: Gaussians, ids: NDArray[np.int32], camera: Camera, near: float, instances: Sequence[int]
) -> NDArray[np.float32]:
    """(H, W) what the points of some instances cover of a view, nothing else being there."""
    rows = np.flatnonzero(np.isin(ids, instances))
    if not len(rows):
        return np.zeros((camera.height, camera.width), np.float32)
    columns = (gaussians.xyz, gaussians.scale, gaussians.rotation, gaussians.opacity)
    alone = Gaussians(*(np.ascontiguousarray(column[rows]) for column in columns))
    return render(alone, np.zeros((len(rows), 0), np.float32), camera, near)[1]


def _each_alone(cloud: LabelledCloud, shown: partial[NDArray[np.float32]]) -> Iterator[NDArray[np.float32]]:
    for instance in np.unique(cloud.instance_ids[cloud.instance_ids >= 0]).tolist():
        yield shown((instance,))


def _posed(camera: Camera) -> View:
    """A view without masks."""
    nothing = np.full((camera.height, camera.width), -1, np.int32)
    return View("", camera, nothing, np.zeros((0, 0), np.float32))
