"""A Replica room as NICE-SLAM renders it: ``results/frame000000.jpg``, ``results/depth000000.png``, ``traj.txt``.

Line i of ``traj.txt`` is the camera-to-world matrix of frame i, 16 numbers, OpenCV axes. ``cam_params.json`` lies in
the folder or beside it: ``{"camera": {"w", "h", "fx", "fy", "cx", "cy", "scale"}}``; a stored depth of ``scale`` is a
metre.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.depth import DepthFile
from og_pointcloud.formats.poses import PosedFrames, PosedImage, camera_from_pose, naming, numbered, read_numbers

__all__ = ["holds_replica", "read_replica"]

PARAMETERS = "cam_params.json"
KEYS = ("w", "h", "fx", "fy", "cx", "cy", "scale")


def holds_replica(folder: Path) -> bool:
    """Whether the folder has this layout."""
    return (folder / "traj.txt").is_file() and (folder / "results").is_dir()


def read_replica(folder: Path) -> PosedFrames:
    """Poses, cameras and depth files of all frames. SceneError names file and cure."""
    results = folder / "results"
    images = numbered([*results.glob("frame*.jpg"), *results.glob("frame*.png")])
    poses = read_numbers(folder / "traj.txt", 16).reshape(-1, 4, 4)
    if not images or len(images) > len(poses):
        raise SceneError(
            f"{folder} has {len(images)} images in results/ and {len(poses)} poses in traj.txt; expected at least one "
            "image and a pose for each: copy both from one run"
        )
    w, h, fx, fy, cx, cy, scale = _parameters(folder)
    posed, dropped = [], []
    for index, (file, pose) in enumerate(zip(images, poses, strict=False)):
        path = f"results/{file.name}"
        if not np.isfinite(pose).all():
            dropped.append(path)
            continue
        with naming(f"{folder / 'traj.txt'}, line {index + 1}"):
            camera = camera_from_pose(pose, (round(w), round(h)), (fx, fy, cx, cy))
        depth_file = results / f"{file.stem.replace('frame', 'depth', 1)}.png"
        depth = DepthFile(depth_file, camera, 1 / scale) if depth_file.is_file() else None
        posed.append(PosedImage(path, camera, depth=depth))
    return PosedFrames(tuple(posed), tuple(dropped))


def _parameters(folder: Path) -> list[float]:
    file = next((place / PARAMETERS for place in (folder, folder.parent) if (place / PARAMETERS).is_file()), None)
    if file is None:
        raise SceneError(
            f"{folder} has no {PARAMETERS}, nor has the folder above; expected it with w h fx fy cx cy scale"
        )
    try:
        content: Any = json.loads(file.read_text(encoding="utf-8"))
        values = [float(content["camera"][key]) for key in KEYS]
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise SceneError(f'{file} is not {{"camera": {{{", ".join(KEYS)}}}}} ({error!s:.80}): copy it again') from None
    if not np.isfinite(values).all() or min(values[0], values[1], values[-1]) <= 0 or max(values[:2]) > 1 << 16:
        raise SceneError(f"{file}: {', '.join(KEYS)} are {values}; expected positive sizes and scale")
    return values
