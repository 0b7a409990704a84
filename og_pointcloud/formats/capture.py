"""Read a capture folder as a Scene: poses, masks with features, geometry, and images if present.

Each part comes from the first of these that the folder has.
  poses     ``transforms.json`` (nerfstudio, instant-ngp, Blender), ``transforms_train.json``; COLMAP ``sparse/0`` (of
            ScanNet++ ``dslr/colmap``); Metashape's ``.xml`` and RealityScan's ``.csv`` of cameras; the folders of
            ScanNet, 7-Scenes, Replica, Polycam, 3D Scanner App, ARKitScenes and KITTI-360
  masks     ``mask_features.npz`` with ``masks/``; LangSplat's ``language_features/``
  geometry  the file given; ``ply_file_path`` of transforms.json; ``points.ply``, ``point_cloud.ply``, the folder's one
            ``.pcd``; the latest ``point_cloud/iteration_*/point_cloud.ply``; ScanNet's ``*_vh_clean_2.ply``;
            KITTI-360's static cloud; COLMAP's ``points3D``, with COLMAP's poses; depth images, fused
  depth     optional; ``depth_file_path`` of a frame; the data set's location; ``depth/`` beside ``images/``
  images    optional; the path in the pose file, or that file name in ``images/``

A view is named by its image's file stem, and so are its masks and features; where two images share a stem (as in rigs),
by the path below the folder that all images share: ``left/000``, ``masks/left/000.png``.

An image whose lens no pinhole can show (fisheye, equirectangular) becomes the faces of a cube, one view each:
``frame/front``, ``frame/left``. Masks belong to the image as it is, ``masks/frame.png``, and are split with it, or to
the faces, ``masks/frame/front.png``.

Masks set the resolution: a camera takes the size of its mask map (shapes must agree), and its image is resized to it.
"""

from __future__ import annotations

import os
import posixpath
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import compress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.cloud import UNKNOWN_SPACE
from og_pointcloud.errors import SceneError, printable
from og_pointcloud.formats import colmap
from og_pointcloud.formats.depth import DepthFile, DepthFrame, find_depth, resampled
from og_pointcloud.formats.faces import Face
from og_pointcloud.formats.gaussian_ply import latest_iteration
from og_pointcloud.formats.images import LEADS_OUT, find_image, image_size, read_rgb, require_scaled, without_suffix
from og_pointcloud.formats.kitti360 import find_static_cloud
from og_pointcloud.formats.langsplat import LANGUAGE_FEATURES_FOLDER, read_language_features
from og_pointcloud.formats.mask_files import (
    FEATURES_NAME,
    MASKS_FOLDER,
    MaskLayer,
    made_of_some,
    read_masks,
    rows_shown,
)
from og_pointcloud.formats.nerfstudio import TRANSFORMS_NAMES, read_transforms
from og_pointcloud.formats.photogrammetry import find_photogrammetry, read_photogrammetry
from og_pointcloud.formats.points import read_points
from og_pointcloud.formats.poses import PosedFrames, PosedImage, in_local_frame, in_pinholes, the_only
from og_pointcloud.formats.repairs import Repair, read_repairs, repaired_images, repaired_layers
from og_pointcloud.formats.rgbd import find_mesh, read_rgbd
from og_pointcloud.formats.tables import naming
from og_pointcloud.scene import Camera, CutMasks, IntArray, Points, Scene, View

if TYPE_CHECKING:
    from og_pointcloud.formats.fusion import FusedCloud

CLOUD_NAMES = ("points.ply", "point_cloud.ply", "scans/mesh_aligned_0.05.ply")
DECODED_MAPS = 4
"""Decoded mask maps kept for images with several faces, which are read one after the other."""
MAX_FUSED_FRAMES = 300
"""At most this many depth images are fused, spread evenly: neighbors in a recording show almost the same."""


@dataclass(frozen=True)
class CapturePoses:
    """The posed pinhole images of a capture. names: of their views. source: the pose file or folder. is_recording: the
    frames come from a video, and perhaps only some have masks."""

    names: tuple[str, ...]
    images: tuple[PosedImage, ...]
    source: Path
    ply_file_path: str | None = None
    is_recording: bool = False


def read_capture(
    folder: str | Path,
    gaussians: str | Path | None = None,
    mask_level: str | None = None,
    repairs: Sequence[str] | None = None,
) -> Scene:
    """Read a capture folder.

    gaussians: a cloud or 3DGS file to use instead of the folder's own geometry.
    mask_level: of LangSplat's masks: default, small, medium or large (the paper's level, and that of None). Masks of
        other formats have no levels: SceneError where one is given.
    repairs: of mistakes in the files, such as "axes=flipped" (formats/repairs.py lists them); None: those in the
        folder's ``repairs.json``, which `og-pointcloud repair` writes.

    Masks and images are read later, on demand; poses, features and points are read here, and file headers are checked.
    Raises SceneError with the cause and the cure; warns of images that are listed but absent, and of frames without a
    pose, which are left out.

    >>> import og_pointcloud as og
    >>> og.read_capture("no_such_folder")
    Traceback (most recent call last):
        ...
    og_pointcloud.errors.SceneError: no_such_folder is not a folder; expected a capture folder with poses, ...
    """
    capture = Path(folder)
    applied = read_repairs(capture) if repairs is None else tuple(map(Repair.parse, repairs))
    poses = read_poses(capture, applied)
    shown = _with_masks(capture, poses) if poses.is_recording or made_of_some(capture) else poses
    layers, feature_space = _layers(capture, shown, mask_level, applied)
    points = read_geometry(capture, poses, gaussians)  # all frames: depth counts without masks too
    files = find_images(capture, shown.images)
    views = tuple(
        _view(name, image, layer, file, points.origin)
        for name, image, layer, file in zip(shown.names, shown.images, layers, files, strict=True)
    )
    return Scene(points, views, feature_space, name=capture.resolve().name)


def read_photographed(folder: str | Path, points: Points | None = None) -> Scene | None:
    """The posed photographs of a capture folder without their masks, and its points; None where it has none, or only
    depth images that would have to be fused."""
    capture = Path(folder)
    poses = read_poses(capture)
    if points is None:
        if not (poses.ply_file_path or _find_cloud(capture) or colmap.find_model(capture)):
            return None
        points = read_geometry(capture, poses)
    views = []
    for name, image in zip(poses.names, poses.images, strict=True):
        size = image.camera.width, image.camera.height
        no_masks = MaskLayer(size, np.zeros((0, 0), np.float32), partial(np.full, size[::-1], -1, np.int32))
        views.append(_view(name, image, no_masks, find_image(capture, image.path), points.origin))
    return Scene(points, tuple(views), UNKNOWN_SPACE, name=capture.resolve().name)


def read_poses(capture: Path, repairs: Sequence[Repair] | None = None) -> CapturePoses:
    """Every posed image of a capture folder as pinhole views; SceneError where there are no poses.

    repairs: None for those of the folder's ``repairs.json``.
    """
    if not capture.is_dir():
        raise SceneError(f"{capture} is not a folder; expected a capture folder with poses, images, masks and points")
    repairs = read_repairs(capture) if repairs is None else repairs
    poses = _stated_poses(capture)
    names, images = [], []
    for name, image in zip(poses.names, repaired_images(poses.images, repairs), strict=True):
        for view in in_pinholes(image):
            names.append(f"{name}/{view.face.name}" if view.face is not None and view.face.name else name)
            images.append(view)
    return replace(poses, names=tuple(names), images=tuple(images))


def _stated_poses(capture: Path) -> CapturePoses:
    """The images as the pose file lists them."""
    # Pose files that someone made for this capture come first; the folder of a data set is tried last.
    size_of, is_recording = partial(_size_of_image, capture), False
    if (file := next((capture / name for name in TRANSFORMS_NAMES if (capture / name).is_file()), None)) is not None:
        source, frames = file, read_transforms(file, size_of)
    elif (model := colmap.find_model(capture)) is not None:
        source, frames = model, PosedFrames(colmap.read_images(model))
        if said := colmap.larger_model(model, len(frames.images)):
            warnings.warn(said, stacklevel=4)
    elif (export := find_photogrammetry(capture)) is not None:
        source, frames = export, read_photogrammetry(export, size_of)
    else:
        source, frames, is_recording = capture, _recording(capture), True
    if frames.dropped:
        warnings.warn(
            f"{source}: no finite pose for {len(frames.dropped)} of {len(frames.dropped) + len(frames.images)} frames, "
            "which are left out, e.g. "
            f"'{printable(frames.dropped[0], 80)}'",
            stacklevel=4,
        )
    with naming(source):
        names = _view_names(frames.images)
    return CapturePoses(names, frames.images, source, frames.ply_file_path, is_recording)


def _recording(capture: Path) -> PosedFrames:
    """The frames of a data set's folder; SceneError where its layout is unknown."""
    frames = read_rgbd(capture)
    if frames is not None and frames.images:
        return frames
    if frames is not None:
        raise SceneError(f"{capture}: none of its {len(frames.dropped)} frames has a finite pose")
    raise SceneError(
        f"{capture} has no pose file; expected transforms.json (nerfstudio, instant-ngp, Blender), a COLMAP model in "
        "sparse/0 (cameras and images, .bin or .txt), Metashape's .xml or RealityScan's .csv of cameras, or the layout "
        "of ScanNet (color/, pose/, intrinsic/), 7-Scenes (frame-*.pose.txt), Replica (results/, traj.txt), Polycam "
        "(keyframes/), 3D Scanner App (frame_*.json), ARKitScenes (lowres_wide.traj) or KITTI-360 (data_poses/); "
        "og-pointcloud import makes such a folder from an E57 file, og-pointcloud poses from photographs without poses"
    )


def _size_of_image(capture: Path, path: str) -> tuple[int, int]:
    file = find_image(capture, path)
    if file is None:
        raise SceneError(
            f"{capture}: image '{path}' is not found, and the pose file has no w and h: add them or the image"
        )
    return image_size(file)


def _view_names(images: Sequence[PosedImage]) -> tuple[str, ...]:
    """File stems; where two images share one (as in rigs), paths from the folder that all images share."""
    paths = [posixpath.normpath(without_suffix(image.path)) for image in images]
    stems = [posixpath.basename(path) for path in paths]
    if len(set(stems)) == len(stems):
        return tuple(stems)
    if len(set(paths)) < len(paths):
        twice = next(path for path in paths if paths.count(path) > 1)
        raise SceneError(
            f"two images have the path '{twice:.80}'; expected unique ones: rename or leave out one of them"
        )
    paths = [path.lstrip("/") for path in paths]
    shared = posixpath.commonpath([posixpath.dirname(path) for path in paths])
    names = [path[len(shared) :].lstrip("/") for path in paths]
    outside = next((name for name in names if ".." in name.split("/")), None)
    if outside is not None:
        raise SceneError(f"image path '{outside}' leads out of its folder; expected paths below one image folder")
    return tuple(names)


def _with_masks(capture: Path, poses: CapturePoses) -> CapturePoses:
    """The images that have masks, for a recording or where masks were made for only some; all images if none has one,
    as reading the masks then raises the error."""
    has_mask = [_has_mask(capture, name) or _has_mask(capture, posixpath.dirname(name)) for name in poses.names]
    if all(has_mask) or not any(has_mask):
        return poses
    warnings.warn(
        f"{capture}: {len(has_mask) - sum(has_mask)} of {len(has_mask)} images have no masks and are left out",
        stacklevel=3,
    )
    return replace(poses, names=tuple(compress(poses.names, has_mask)), images=tuple(compress(poses.images, has_mask)))


def _has_mask(capture: Path, name: str) -> bool:
    files = f"{MASKS_FOLDER}/{name}.png", f"{LANGUAGE_FEATURES_FOLDER}/{name}_s.npy"
    # Not Path.is_file, which fails for names that are too long.
    return any(os.path.isfile(capture / file) for file in files)


def _layers(
    capture: Path, poses: CapturePoses, level: str | None, repairs: Sequence[Repair]
) -> tuple[list[MaskLayer], str]:
    """The masks of each view, and the name of their feature space. Masks of a whole image are repaired, then split with
    it."""
    faces = [image.face for image in poses.images]
    # The name that each view's masks are stored under: the image's for a cube's face without masks of its own.
    called = [
        posixpath.dirname(name) if face and face.name and not _has_mask(capture, name) else name
        for name, face in zip(poses.names, faces, strict=True)
    ]
    distinct = list(dict.fromkeys(called))
    read, feature_space = _read_masks(capture, distinct, level)
    stored = dict(zip(distinct, repaired_layers(read, repairs), strict=True))
    # Faces of one image share its decoded mask map.
    decoded = lru_cache(maxsize=DECODED_MAPS)(lambda name: stored[name].read())
    # Masks of a whole image are cut to the view; a cube face's own masks have its pixels already.
    return [
        _layer_of(face, stored[name], view, partial(decoded, name))
        if face and (not face.name or name != view)
        else stored[name]
        for view, name, face in zip(poses.names, called, faces, strict=True)
    ], feature_space


def _layer_of(face: Face, layer: MaskLayer, view: str, decoded: Callable[[], IntArray]) -> MaskLayer:
    """A view's part of a whole image's masks; a cube's face keeps only the masks that it shows. decoded: the image's
    map, in this process; what the view reads later may be asked for in another one."""
    _require_shape(view, layer, face.whole)
    scaled = face.of_whole_size(*layer.size)
    size = scaled.camera.width, scaled.camera.height
    if not face.name:  # the one view of an image shows all of its masks
        return MaskLayer(size, layer.features, partial(_read_part, scaled, layer.read), layer.tracks)
    # The features of a face depend on the masks that it shows: the map is read now, and kept as runs of equal ids.
    # These are smaller than the features of most masks, and the whole image is not read again for each of its faces.
    ids = scaled.mask_ids(decoded())
    flat, shape = ids.ravel(), ids.shape
    first = np.flatnonzero(np.append(True, flat[1:] != flat[:-1]))
    values, lengths = flat[first], np.diff(first, append=flat.size)
    if (last := values.max()) >= len(layer.features):
        raise SceneError(
            f"view '{view}': mask id {last + 1} has no feature row (the features file has {len(layer.features)}): "
            "write one feature row per mask id"
        )
    used, row_of_id = rows_shown(values, len(layer.features))
    rows = row_of_id[values]
    tracks = None if layer.tracks is None else layer.tracks[used]
    cut = CutMasks(posixpath.dirname(view), used)
    return MaskLayer(size, layer.features[used], partial(_from_runs, rows, lengths, shape), tracks, cut)


def _read_part(face: Face, read: Callable[[], IntArray]) -> IntArray:
    return face.mask_ids(read())


def _from_runs(rows: IntArray, lengths: NDArray[np.intp], shape: tuple[int, ...]) -> IntArray:
    return np.repeat(rows, lengths).reshape(shape)


def _read_masks(capture: Path, names: Sequence[str], level: str | None) -> tuple[list[MaskLayer], str]:
    if (capture / FEATURES_NAME).is_file():
        if level is not None:
            raise SceneError(
                f"mask level is '{level}', but the masks of {capture} ({FEATURES_NAME}) have no levels; expected no "
                f"level: leave it out, or move {FEATURES_NAME} away to read {LANGUAGE_FEATURES_FOLDER}/ instead"
            )
        return read_masks(capture, names)
    if (capture / LANGUAGE_FEATURES_FOLDER).is_dir():
        return read_language_features(capture, names, "large" if level is None else level)
    found = f"{MASKS_FOLDER}/ but no {FEATURES_NAME}" if (capture / MASKS_FOLDER).is_dir() else "no masks at all"
    raise SceneError(
        f"{capture} has {found}; expected {MASKS_FOLDER}/<image stem>.png (ids) with {FEATURES_NAME}, or LangSplat's "
        f"{LANGUAGE_FEATURES_FOLDER}/<image stem>_s.npy and _f.npy: og-pointcloud masks {capture} makes them"
    )


def read_geometry(capture: Path, poses: CapturePoses, gaussians: str | Path | None = None) -> Points:
    """The points of a capture folder, or of the file given; fused from depth images where there is no other
    geometry."""
    if gaussians is not None:
        return read_points(Path(gaussians))
    if poses.ply_file_path is not None:
        return read_points(_inside(capture, poses.ply_file_path, poses.source))
    cloud = _find_cloud(capture)
    if cloud is not None:
        return read_points(cloud)
    model = colmap.find_model(capture)
    if model is None:
        frames = _depth_frames(capture, poses)
        if not frames:
            raise SceneError(
                f"{capture} has no geometry; expected {' or '.join(CLOUD_NAMES[:2])}, one .pcd, ply_file_path in "
                "transforms.json, point_cloud/iteration_*/point_cloud.ply, COLMAP's sparse/0/points3D or depth images "
                "in depth/: add one of them, or name a file (--gaussians)"
            )
        return _fused(capture, frames).points
    if poses.source != model:  # tools rotate, shift or scale COLMAP's world, and seldom state how
        raise SceneError(
            f"{poses.source} names no cloud, and the world of {model}/points3D may differ from that of its poses; "
            f"expected a cloud in the world of {poses.source.name}: add {CLOUD_NAMES[0]}, or remove "
            f"{poses.source.name}, so that COLMAP's poses are used"
        )
    xyz, rgb = colmap.read_points3d(model)
    return Points.from_world(xyz, rgb=rgb)


def _inside(capture: Path, path: str, source: Path) -> Path:
    """``path`` inside the capture folder; a pose file may not point elsewhere."""
    relative = posixpath.normpath(path)
    file = capture / relative
    if LEADS_OUT.match(relative) or not file.is_file():
        raise SceneError(
            f"{source}: ply_file_path is '{path}', which is not a file inside the capture folder; expected one: copy "
            "the cloud there and fix the path, or name the file (--gaussians)"
        )
    return file


def _find_cloud(capture: Path) -> Path | None:
    for name in CLOUD_NAMES:
        if (capture / name).is_file():
            return capture / name
    pcd = the_only(capture, "*.pcd", ".pcd files")
    return pcd or latest_iteration(capture) or find_mesh(capture) or find_static_cloud(capture)


def fuse_capture(folder: str | Path, depth_unit: float | None = None) -> FusedCloud:
    """The cloud of a capture's depth images, whether or not the folder has another; warns of what is doubtful.

    depth_unit: world lengths per stored step, if the files do not state it. Raises SceneError without depth images.
    """
    capture = Path(folder)
    poses = read_poses(capture)
    frames = _depth_frames(capture, poses)
    if not frames:
        first = f"depth/{poses.names[0]}.png"  # of a panorama's face: its depth is of a pinhole
        raise SceneError(f"{capture} has no depth images; expected {first} and so on, or depth_file_path in poses")
    if depth_unit is not None:
        frames = [replace(frame, depth=replace(frame.depth, unit=depth_unit, integer_unit=None)) for frame in frames]
    return _fused(capture, frames)


def depth_files(capture: Path, poses: CapturePoses) -> dict[str, DepthFile]:
    """The depth images of a capture by view name; views without one are absent. Cameras are in world coordinates."""
    files = {}
    for name, image in zip(poses.names, poses.images, strict=True):
        if image.depth is not None:
            files[name] = image.depth
            continue
        # Depth beside a distorted photograph has the same distortion. Cube faces have depth images of their own; else
        # the front face has that of the photograph, unless that is a sphere's.
        face, path = image.face, find_depth(capture, name)
        whole = face if face is not None and not face.name else None
        if path is None and face is not None and face.name == "front" and not face.lens.wraps:
            whole, path = face, find_depth(capture, posixpath.dirname(name))
        if path is not None:
            camera, lens = (whole.whole, whole.lens) if whole else (image.camera, None)
            files[name] = DepthFile(path, camera, image.depth_unit, lens, image.integer_depth_unit)
    return files


def _depth_frames(capture: Path, poses: CapturePoses) -> list[DepthFrame]:
    """The frames that are fused: every k-th of a long recording, so that there are at most MAX_FUSED_FRAMES."""
    files = depth_files(capture, poses)
    images = dict(zip(poses.names, poses.images, strict=True))
    frames = []
    for name in list(files)[:: max(1, -(-len(files) // MAX_FUSED_FRAMES))]:
        file = find_image(capture, images[name].path)
        colors = None if file is None else partial(_colors_at, file, images[name])
        frames.append(DepthFrame(name, files[name], colors))
    return frames


def _fused(capture: Path, frames: Sequence[DepthFrame]) -> FusedCloud:
    from og_pointcloud.formats.fusion import doubtful_depth, fuse  # loads numba, not needed with a cloud

    fused = fuse(frames)
    empty = f"nothing is measured in {len(fused.empty)} of them, e.g. '{fused.empty[0]}'" if fused.empty else None
    end = fused.survey.range_end
    ends = f"many pixels say exactly {end:g}, the end of the camera's range: left out" if end < np.inf else None
    for text in filter(None, (doubtful_depth(frames), empty, ends)):
        warnings.warn(f"{capture}: depth images: {text}", stacklevel=4)
    return fused


def _colors_at(file: Path, image: PosedImage, camera: Camera) -> NDArray[np.uint8]:
    """(H, W, 3): the photograph's colors at the pixels of the depth camera, averaged down to its resolution first."""
    scale = min(1.0, camera.fx / image.camera.fx)  # of the photograph, so that a pixel spans the same angle as depth's
    size = max(1, round(image.camera.width * scale)), max(1, round(image.camera.height * scale))
    photographed = image.camera.resized(*size)
    return resampled(read_photograph(file, photographed, image.face), photographed, camera)


def find_images(capture: Path, images: Sequence[PosedImage]) -> list[Path | None]:
    """The files of the posed images, None where one is not found; warns of those."""
    file_of = {path: find_image(capture, path) for path in {image.path for image in images}}  # faces share an image
    files = [file_of[image.path] for image in images]
    missing = [image.path for image, file in zip(images, files, strict=True) if file is None]
    if missing:
        warnings.warn(
            f"{capture}: {len(missing)} of {len(images)} images are listed but not found, e.g. "
            f"'{printable(missing[0], 80)}'; "
            "their views have masks but no colors",
            stacklevel=3,
        )
    return files


def _require_shape(name: str, layer: MaskLayer, camera: Camera) -> None:
    cure = "make the masks on the posed images or fix w and h in the pose file"
    require_scaled(f"view '{name}': the masks are", layer.size, (camera.width, camera.height), cure)


def _view(name: str, image: PosedImage, layer: MaskLayer, file: Path | None, origin: NDArray[np.float64]) -> View:
    _require_shape(name, layer, image.camera)
    camera = in_local_frame(image.camera.resized(*layer.size), origin)
    read_image = None if file is None else partial(read_photograph, file, camera, image.face)
    return View(name, camera, layer.read, layer.features, read_image, layer.tracks, layer.cut_from)


def read_photograph(file: Path, camera: Camera, face: Face | None) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 RGB of the camera's size: the image, or the part that the face shows."""
    if face is None:
        return read_rgb(file, (camera.width, camera.height))
    scaled = face.of_size(camera.width, camera.height)
    return scaled.image(read_rgb(file, (scaled.whole.width, scaled.whole.height)))
