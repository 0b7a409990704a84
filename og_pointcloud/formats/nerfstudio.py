"""``transforms.json`` of nerfstudio, instant-ngp and Blender: camera-to-world, OpenGL axes (x right, y up, z back).

Intrinsics are at the top level or in a frame, which overrides it: ``fl_x fl_y cx cy w h`` in pixels, or
``camera_angle_x`` (radians over the width) or ``x_fov`` (degrees), with the principal point in the middle unless given.
A focal length of one axis holds for both. Of the splits that Blender writes, ``transforms_train.json`` is read.
``from_mitsuba`` (instant-ngp) means Mitsuba's axes (x left, z forward). ``aabb_scale``, ``scale``, ``offset`` and the
like describe the rendering box of instant-ngp, not the poses, and are ignored.

A frame's ``depth_file_path``, or ``depth_path`` (instant-ngp; a file that is absent is skipped), names its depth image
inside the capture folder; stored integers are millimeters unless ``integer_depth_scale`` (instant-ngp, integers only)
or ``depth_unit_scale_factor`` gives another unit. The units hold for images in ``depth/`` too.

``applied_transform`` (nerfstudio: from COLMAP's world to the world of this file) is *not* applied to
``ply_file_path``: nerfstudio writes that cloud in the world of ``transform_matrix``.
"""

from __future__ import annotations

import posixpath
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.depth import DepthFile
from og_pointcloud.formats.images import LEADS_OUT
from og_pointcloud.formats.lenses import SPHERICAL, Lens, lens_of, spherical_camera
from og_pointcloud.formats.poses import MAX_NUMBER, OPENGL_SIGNS, PosedFrames, PosedImage, inverse, read_json_object
from og_pointcloud.formats.tables import naming
from og_pointcloud.scene import Camera

TRANSFORMS_NAMES = ("transforms.json", "transforms_train.json")
PERSPECTIVE_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
FISHEYE_MODELS = ("OPENCV_FISHEYE", "FISHEYE")
SPHERICAL_MODELS = ("EQUIRECTANGULAR",)
OTHER_LENSES = ("ftheta", "latlong", "equirectangular", "orthographic")
"""Keys of instant-ngp, whose presence alone means one of its lenses that are not read."""
DEPTH_KEYS = ("depth_file_path", "depth_path")
FOCAL_KEYS = (("fl_x", "fl_y"), ("camera_angle_x", "camera_angle_y"), ("x_fov", "y_fov"))
MITSUBA_SIGNS = np.array([-1.0, 1.0, -1.0, 1.0])
"""Factors of a pose's columns from Mitsuba's axes (x left, y up, z forward) to OpenGL's."""
LENS_TERMS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")


def read_transforms(file: Path, image_size: Callable[[str], tuple[int, int]]) -> PosedFrames:
    """Read a transforms file; ``image_size(path)`` returns (width, height) for files without it (Blender).

    Raises SceneError for anything that is not such a file, naming the frame and the key.
    """
    content = read_json_object(file)
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise SceneError(
            f"{file} has no list 'frames' with at least one frame; expected nerfstudio's or instant-ngp's layout"
        )
    shared = {key: value for key, value in content.items() if key != "frames"}  # a frame's own keys override these
    signs = OPENGL_SIGNS * MITSUBA_SIGNS if shared.get("from_mitsuba") else OPENGL_SIGNS
    images, dropped = [], []
    for index, frame in enumerate(frames):
        path = frame.get("file_path") if isinstance(frame, dict) else None
        if not isinstance(path, str) or not path:
            raise SceneError(f"{file}: frame {index} has file_path {path!r}; expected the path of its image")
        path = path.replace("\\", "/")
        with naming(f"{file}, frame '{path:.80}'"):
            camera_to_world = _matrix(frame, "transform_matrix")
            if np.isfinite(camera_to_world).all():  # trackers write NaN when they get lost
                keys = _overridden(shared, frame)
                camera = _camera(keys, inverse(camera_to_world * signs), partial(image_size, path))
                lens = _lens(keys)
                units = _depth_unit(keys, "depth_unit_scale_factor"), _depth_unit(keys, "integer_depth_scale")
                depth_path = _depth_path(file.parent, keys, lens)
                depth = depth_path and DepthFile(depth_path, camera, units[0], lens, units[1])
                images.append(PosedImage(path, camera, lens, depth, None, *units))
            else:
                dropped.append(path)
    if not images:
        raise SceneError(
            f"{file}: none of its {len(frames)} frames has a finite transform_matrix; expected one or more"
        )
    ply = shared.get("ply_file_path")
    ply_file_path = ply.replace("\\", "/") if isinstance(ply, str) and ply else None
    return PosedFrames(tuple(images), tuple(dropped), ply_file_path)


def _overridden(shared: dict[str, Any], frame: dict[str, Any]) -> dict[str, Any]:
    """The keys of a frame: its own, and the shared ones. A focal length of its own also replaces a shared angle."""
    own = [pair for pair in FOCAL_KEYS if any(frame.get(key) is not None for key in pair)]
    replaced = {key for pair in FOCAL_KEYS if own and pair not in own for key in pair}
    return {**{key: value for key, value in shared.items() if key not in replaced}, **frame}


def _matrix(keys: dict[str, Any], key: str) -> NDArray[np.float64]:
    """(4, 4) float64 from nested lists of 3 or 4 rows."""
    value = keys.get(key)
    try:
        matrix = np.array(value, np.float64)
    except (ValueError, TypeError, OverflowError):
        matrix = np.empty(0)
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])
    if matrix.shape != (4, 4):
        raise SceneError(f"{key} is {value!r:.80}; expected 4 rows of 4 numbers")
    if np.isfinite(matrix).all() and np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise SceneError(f"the last row of {key} is {matrix[3].tolist()}; expected [0, 0, 0, 1]")
    return matrix


def _camera(
    keys: dict[str, Any], world_to_camera: NDArray[np.float64], image_size: Callable[[], tuple[int, int]]
) -> Camera:
    w, h, cx, cy = (_number(keys, key) for key in ("w", "h", "cx", "cy"))
    width, height = image_size() if w is None or h is None else (round(w), round(h))
    if _camera_model(keys) in SPHERICAL_MODELS:  # fl_x is ignored: writers disagree on its meaning for a sphere
        return spherical_camera(width, height, world_to_camera)
    fx, fy = _focal(keys, "x", width), _focal(keys, "y", height)
    fx, fy = fy if fx is None else fx, fx if fy is None else fy  # Blender states only one: pixels are then square
    if fx is None or fy is None:
        raise SceneError("neither fl_x (pixels) nor camera_angle_x (radians) is given; expected one of them")
    return Camera(
        width,
        height,
        fx=fx,
        fy=fy,
        cx=width / 2 if cx is None else cx,
        cy=height / 2 if cy is None else cy,
        world_to_camera=world_to_camera,
    )


def _focal(keys: dict[str, Any], axis: str, extent: int) -> float | None:
    """Focal length in pixels: as given, else from the field of view (over ``extent`` pixels), else None."""
    pixels, angle = _number(keys, f"fl_{axis}"), _number(keys, f"camera_angle_{axis}")
    if angle is None and (degrees := _number(keys, f"{axis}_fov")) is not None:
        angle = float(np.radians(degrees))
    if pixels is not None or angle is None:
        return pixels
    if not 0 < angle < np.pi:
        raise SceneError(
            f"camera_angle_{axis} is {angle}; expected radians between 0 and pi (or {axis}_fov, 0 to 180 degrees)"
        )
    return 0.5 * extent / float(np.tan(0.5 * angle))


def _number(keys: dict[str, Any], key: str) -> float | None:
    value = keys.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= MAX_NUMBER:
        raise SceneError(f"{key} is {value!r:.80}; expected a finite number")
    return float(value)


def _depth_unit(keys: dict[str, Any], key: str) -> float | None:
    unit = _number(keys, key)
    if unit is None or unit > 0:
        return unit
    if any(keys.get(name) for name in DEPTH_KEYS):
        raise SceneError(f"the depth unit is {unit}; expected world lengths per stored step, above 0, e.g. 0.001")
    return None  # no depth image needs it


def _depth_path(capture: Path, keys: dict[str, Any], lens: Lens | None) -> Path | None:
    key = next((key for key in DEPTH_KEYS if keys.get(key)), None)
    if key is None:
        return None
    if lens is not None and lens.wraps:
        raise SceneError(f"{key} of an equirectangular image is not read; expected pinhole depths: remove it")
    path = keys[key]
    inside = posixpath.normpath(str(path).replace("\\", "/"))
    if LEADS_OUT.match(inside) or "\0" in inside:
        raise SceneError(f"{key} is {path!r:.80}, which leads out of the capture folder: copy it there")
    if key == "depth_path" and not (capture / inside).is_file():  # instant-ngp skips these
        return None
    return capture / inside


def _camera_model(keys: dict[str, Any]) -> str:
    return str(keys.get("camera_model") or "OPENCV").upper()


def _lens(keys: dict[str, Any]) -> Lens | None:
    """The lens. As in nerfstudio, perspective models differ only in the terms they name, so all given terms count."""
    model = _camera_model(keys)
    other = next((key for key in keys if key.startswith(OTHER_LENSES)), None)
    known = PERSPECTIVE_MODELS + FISHEYE_MODELS + SPHERICAL_MODELS
    if model not in known or other:
        raise SceneError(
            f"the camera model is {other or model:.40}; expected one of {', '.join(known)}: "
            "undistort images and masks to a pinhole camera first"
        )
    if model in SPHERICAL_MODELS:
        return SPHERICAL
    fisheye = model in FISHEYE_MODELS or bool(keys.get("is_fisheye"))
    terms = {key: _number(keys, key) or 0.0 for key in LENS_TERMS}
    if fisheye and (terms["p1"] or terms["p2"]):
        raise SceneError(
            f"p1, p2 are {terms['p1']}, {terms['p2']}; expected 0 for a fisheye, where nerfstudio leaves them out and "
            "others do not: undistort images and masks to a pinhole camera first"
        )
    if not fisheye and (terms["k4"] or terms["k5"] or terms["k6"]):
        # nerfstudio takes k4 as the r^8 term of the numerator, OpenCV as the r^2 term of the denominator.
        raise SceneError(
            f"k4, k5, k6 are {terms['k4']}, {terms['k5']}, {terms['k6']}; expected 0 for {model}, where programs "
            "disagree on their meaning: undistort images and masks to a pinhole camera first"
        )
    return lens_of("fisheye" if fisheye else "perspective", terms)
