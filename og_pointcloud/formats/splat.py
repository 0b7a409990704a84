"""Read .splat, the 32-byte records of Gaussians that web viewers load: position and linear scale as float32, color with
opacity and quaternion w x y z as bytes. The file has no header, so it is recognized by its name.

Format: antimatter15/splat, README, "Notes"; axes are those of a PLY.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.gaussian_ply import Splats, activated

SUFFIX = ".splat"
MAX_STRETCH = 0.1
"""Half of the quaternions are this near to length 1, as writers normalize them; a quarter of random ones are."""
RECORD = np.dtype([("xyz", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])


def read_splat(path: Path) -> Splats:
    """The Gaussians of a .splat file; SceneError where it is no whole number of records, or of something else."""
    size = path.stat().st_size
    if not size or size % RECORD.itemsize:
        each = RECORD.itemsize
        raise SceneError(
            f"it has {size} bytes; expected {each} for each splat, one or more: it is truncated or no .splat"
        )
    rows = np.fromfile(path, RECORD)
    with np.errstate(invalid="ignore"):  # widening a signalling NaN warns
        xyz = rows["xyz"].astype(np.float64)
    # A scale's sign does not change its Gaussian.
    scale, rotation, rgba = np.abs(rows["scale"]), rows["rotation"] / 128 - 1, rows["rgba"] / 255
    lengths = np.linalg.norm(rotation, axis=1)
    if np.median(np.abs(lengths - 1)) > MAX_STRETCH:
        raise SceneError(
            f"its quaternions have a median length of {np.median(lengths):.2f}; expected 1: it is no .splat"
        )
    return activated(xyz, scale, rotation, rgba[:, 3], rgba[:, :3])
