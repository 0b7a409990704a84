"""Pictures without a window: painted clouds, and 3D Gaussians in which what a word finds stands out."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

import og_pointcloud as og
from og_pointcloud.ask.hosts import world_points
from og_pointcloud.ask.labelled_scene import SceneLike
from og_pointcloud.ask.segmentation import Segmentation
from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.formats.atomic import replacing
from og_pointcloud.formats.colors import LUMINANCE, label_colors
from og_pointcloud.formats.gaussian_ply import BASE_COLOR, LOG_SCALE, ROTATION, gaussian_rows
from og_pointcloud.formats.tables import stack_columns
from og_pointcloud.scene import Camera, Points
from og_pointcloud.show.viewpoint import Viewpoint, choose_viewpoint
from og_pointcloud.text.words import Labels, TextFeatures
from og_pointcloud_open3d.host import WITH_SPLATS, open3d, require_version

__all__ = ["draw_png", "highlight_png", "look_at", "viewpoint"]

FADED = 0.35
"""Contrast that is left to what is not highlighted."""
PAPER = 0.92
"""The light grey that it fades to."""
TINT = 0.6
"""Share of the highlight in a found splat's colour; the rest stays its own, and with it the shading."""
HIGHLIGHT = (230, 40, 60)
SECONDS_PER_PICTURE = 600
DRIVERS = "libvulkan1 mesa-vulkan-drivers libegl1 libgl1"


def look_at(
    eye: ArrayLike,
    target: ArrayLike,
    up: ArrayLike = (0, 0, 1),
    *,
    size: tuple[int, int] = (960, 720),
    view_angle_deg: float = 60.0,
) -> Camera:
    """A camera at ``eye`` that looks at ``target``, all in world coordinates.

    size: width and height, pixels. view_angle_deg: from the picture's top to its bottom.
    OgPointcloudError where eye, target and up lie on one line.
    """
    eye_m, forward = np.asarray(eye, np.float64), np.asarray(target, np.float64) - np.asarray(eye, np.float64)
    right = np.cross(forward, np.asarray(up, np.float64))
    if not np.linalg.norm(right) > 1e-9 * np.linalg.norm(forward):
        raise OgPointcloudError(f"eye {eye}, target {target} and up {up} lie on one line; expected a way up")
    forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ eye_m
    width, height = size
    focal_px = height / 2 / np.tan(np.deg2rad(view_angle_deg) / 2)
    return Camera(width, height, focal_px, focal_px, width / 2, height / 2, pose)


def draw_png(
    path: str | os.PathLike[str],
    pcd: Any,
    labels: Labels = None,
    scene: SceneLike | None = None,
    *,
    camera: Camera | None = None,
    point_size: float = 3.0,
    text_features: TextFeatures = None,
) -> Path:
    """Draw a cloud as .png: as it is painted, or with the colours of its labels.

    pcd: an Open3D cloud or mesh, whose points are drawn; or a Segmentation, drawn with its colours.
    labels, scene, text_features: as for ``segment``; given either labels or scene, the cloud is labelled first.
    camera: maps from world coordinates; left out, one from obliquely above. point_size: pixels.
    OgPointcloudError where no driver draws off-screen, SceneError where there is nothing to draw.
    """
    if not isinstance(pcd, Segmentation) and (labels is not None or scene is not None):
        pcd = og.segment(pcd, labels, scene, text_features=text_features)
    xyz, rgb = (pcd.xyz, pcd.colors) if isinstance(pcd, Segmentation) else (world_points(pcd), _colors(pcd))
    finite = np.isfinite(xyz).all(axis=1)
    labelled = (rgb != label_colors(np.array([-1]))).any(axis=1)
    job = {"colors": (rgb[finite] / 255).astype(np.float32), "point_size": np.array(point_size)}
    return _render(path, xyz[finite], camera or _camera_for(xyz[finite], labelled[finite]), job)


def highlight_png(
    path: str | os.PathLike[str],
    splats: Points | str | os.PathLike[str],
    text: str | Mapping[str, ArrayLike],
    scene: SceneLike,
    *,
    camera: Camera | None = None,
    color: ArrayLike = HIGHLIGHT,
    against: Labels = None,
    text_features: TextFeatures = None,
) -> Path:
    """Draw 3D Gaussians as .png, what a text finds in a colour of its own and all else faded. Needs Open3D 0.20.

    splats: a 3DGS file, or Gaussians read from one.
    text: a word or phrase, or one name -> vector. against, text_features: as for ``select``.
    scene: where the text is looked for; each splat belongs to the instance of the scene's nearest point.
    camera: as for `draw_png`. color: (3,) RGB, 0 to 255.
    OgPointcloudError where the text fits no instance, Open3D is older, or no driver draws off-screen.
    """
    require_version(open3d(), WITH_SPLATS, "drawing Gaussians")
    points = splats if isinstance(splats, Points) else og.read_points(splats)
    if not points.are_gaussians:
        raise SceneError(f"{splats}: plain points; expected 3D Gaussians (scale, rotation, opacity): use draw_png")
    selection = og.select(scene, text, against=against, text_features=text_features)
    if not selection.fitting:
        raise OgPointcloudError(
            f"'{selection.query}' fits none of {len(selection)} instances; expected one to show: try others"
        )
    found = np.isin(selection.scene.instances_at(points.xyz_world), selection.instances)
    rgb = _faded_but(points, found, np.asarray(color, np.float64))
    rows = gaussian_rows(replace(points, rgb=rgb))
    job = {
        "f_dc": stack_columns(rows, BASE_COLOR, np.float32),
        "scale": np.exp(stack_columns(rows, LOG_SCALE, np.float32)),
        "rot": stack_columns(rows, ROTATION, np.float32),
        "opacity": stack_columns(rows, ("opacity",), np.float32),
    }
    return _render(path, points.xyz_world, camera or _camera_for(points.xyz_world, found), job)


def _colors(pcd: Any) -> NDArray[np.uint8]:
    """(n, 3) of a geometry's own colours; black without any."""
    for name in ("colors", "vertex_colors"):
        if len(colors := getattr(pcd, name, ())):
            return np.rint(np.asarray(colors) * 255).astype(np.uint8)
    for name in ("point", "vertex"):
        if "colors" in (tensors := getattr(pcd, name, {})):
            colors = tensors["colors"].cpu().numpy()
            return (np.rint(colors * 255) if colors.dtype.kind == "f" else colors).astype(np.uint8)
    return np.zeros((len(world_points(pcd)), 3), np.uint8)


def _faded_but(points: Points, found: NDArray[np.bool_], color: NDArray[np.float64]) -> NDArray[np.uint8]:
    rgb = np.full(points.xyz.shape, 127.5) if points.rgb is None else points.rgb.astype(np.float64)
    grey = 255 * PAPER + FADED * ((rgb @ LUMINANCE)[:, None] - 255 * PAPER)
    return np.rint(np.where(found[:, None], (1 - TINT) * rgb + TINT * color, grey)).astype(np.uint8)


def viewpoint(xyz: NDArray[np.float64], wanted: NDArray[np.bool_]) -> Viewpoint:
    """Where most of the wanted points are seen from. xyz: (n, 3), finite; SceneError without any."""
    if len(xyz) == 0:
        raise SceneError("the cloud has 0 points with finite coordinates; expected some to draw")
    return choose_viewpoint(xyz, wanted, np.array([0.0, 0.0, 1.0]))


def _camera_for(xyz: NDArray[np.float64], wanted: NDArray[np.bool_]) -> Camera:
    view = viewpoint(xyz, wanted)
    return look_at(view.eye, view.target, view.up)


def _render(
    path: str | os.PathLike[str], xyz_world: NDArray[np.float64], camera: Camera, job: dict[str, NDArray]
) -> Path:
    """Hand the job to a process of its own, and its picture to ``path``."""
    path = Path(path)
    if path.suffix != ".png":
        raise OgPointcloudError(f"the picture is '{path}'; expected a name that ends in .png")
    version = open3d().__version__
    origin = np.median(xyz_world, axis=0)  # drawn in float32, which map coordinates would leave
    pose = camera.world_to_camera.copy()
    pose[:3, 3] += pose[:3, :3] @ origin
    job = {
        **job,
        "positions": (xyz_world - origin).astype(np.float32),
        "camera": np.array([camera.fx, camera.fy, camera.cx, camera.cy]),
        "size": np.array([camera.width, camera.height]),
        "world_to_camera": pose,
    }
    with tempfile.TemporaryDirectory() as folder:
        job_file, picture = Path(folder) / "job.npz", Path(folder) / "picture.png"
        np.savez(job_file, **job)  # pyright: ignore[reportArgumentType]
        command = [sys.executable, "-m", "og_pointcloud_open3d.render", str(job_file), str(picture)]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(entry for entry in sys.path if entry)}
        done = subprocess.run(
            command, capture_output=True, text=True, errors="replace", env=environment, timeout=SECONDS_PER_PICTURE
        )
        if done.returncode or not picture.is_file():
            raise OgPointcloudError(_why(version, done))
        with replacing(path) as file:
            file.write(picture.read_bytes())
    return path


def _why(version: str, done: subprocess.CompletedProcess[str]) -> str:
    lines = [line.strip() for line in (done.stderr or done.stdout).splitlines() if line.strip()]
    last = lines[-1][:200] if lines else f"it ended with {done.returncode}"
    return (
        f"Open3D {version} could not draw off-screen ({last}): it needs a driver, Vulkan from 0.20 and EGL before; "
        f"without a graphics card, on Debian and Ubuntu: apt-get install {DRIVERS}"
    )
