"""The .ogpc file: its members and limits.

A zip of uncompressed members; nothing is pickled:

  manifest.json            format, schema_version, feature_space, frame (origin, unit, spacing, reach), counts,
                           members (bytes, sha256, dtype, shape of each), parity figures of the graph, provenance
  query.onnx               the graph that answers text; the instance table's descriptors (R, D) are its constants
  arrays/*.npy             xyz, instance_ids (smallest integer type), rgb, certainty and cameras if known,
                           instances/*
  vocabulary/names.json    words that can be given as strings, if any
  vocabulary/vectors.npy   (L, D) float32 unit vectors, in older files float16
  bank/vectors.npy         (B, D) float16, everyday words that labels are judged by (``ask.choosing``), if it has them
  text_encoder/*           the files of a text encoder (see ``text.encoder``), if it carries one; read when needed

``bundle.read`` reads it, ``og_pointcloud_export`` writes it.
"""

from __future__ import annotations

import hashlib
import io
import json
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.scene import Camera

FORMAT = "ogpc"
SCHEMA_VERSION = 2
"""Incremented when older files can no longer be queried. Since version 2 the graph itself decides points at borders."""
ON_SURFACE, NEAR_SURFACE, BEYOND_REACH = 0, 1, 2
"""Distance class of a query point from the cloud: within about 1.5 spacings, within reach, or too far."""

MAX_MEMBERS = 256
MAX_MANIFEST_BYTES, MAX_NAMES_BYTES = 1 << 21, 1 << 23
"""Small, since parsed JSON takes up to twenty times its bytes in memory."""
SAFE_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*(/[A-Za-z0-9_][A-Za-z0-9_.-]*)*")
INTEGER_DTYPES, FLOAT_DTYPES = ("|i1", "<i2", "<i4"), ("<f2", "<f4")
REBUILD = "copy the file again, or make it again (og-pointcloud fit)"
BANK = "bank/vectors.npy"
INSTANCE_MEMBERS = {"part_of": "whole"}
"""Columns of the instance table whose member keeps the name that it had in the first files of schema 2."""
OPTIONAL_COLUMNS = ("reliability",)
"""Columns of the instance table that the first files of schema 2 lack."""
RGB, CERTAINTY, CAMERAS = "arrays/rgb.npy", "arrays/certainty.npy", "arrays/cameras.npy"
CARRIED_ENCODER = "text_encoder/"
"""Prefix of the names of a carried text encoder's members."""


def rows_of_cameras(cameras: Sequence[Camera]) -> NDArray[np.float64]:
    """(V, 18) float64, per camera: width, height, fx, fy, cx, cy, and the first three rows of world_to_camera."""
    rows = [(c.width, c.height, *c.intrinsics, *c.world_to_camera[:3].ravel()) for c in cameras]
    return np.array(rows, np.float64).reshape(-1, 18)


def cameras_of_rows(rows: NDArray[np.float64]) -> tuple[Camera, ...]:
    """The inverse of `rows_of_cameras`; SceneError for a row that is no valid camera."""
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows[:, 6:].reshape(-1, 3, 4)
    # NaN and infinity have no integer value: they become sizes that Camera refuses.
    sizes = np.nan_to_num(rows[:, :2]).clip(0, 1 << 30).astype(int).tolist()
    return tuple(
        Camera(width, height, fx, fy, cx, cy, pose)
        for (width, height), (fx, fy, cx, cy), pose in zip(sizes, rows[:, 2:6].tolist(), poses, strict=True)
    )


def manifest_json(manifest: Mapping[str, Any]) -> bytes:
    """The bytes of manifest.json; OgPointcloudError if the provenance is no JSON, or longer than readers accept."""
    try:
        text = json.dumps(manifest, indent=1, ensure_ascii=False).encode()
    except (TypeError, ValueError) as error:
        raise OgPointcloudError(
            f"the cloud's provenance cannot be written as JSON ({error}): use plain types"
        ) from None
    if len(text) > MAX_MANIFEST_BYTES:
        raise OgPointcloudError(
            f"the manifest has {len(text)} bytes; expected at most {MAX_MANIFEST_BYTES}, the readers' limit: remove "
            "entries from the cloud's provenance"
        )
    return text


def describe_member(name: str, data: bytes) -> dict[str, Any]:
    """The manifest's entry for a member: bytes, sha256 and, for an array, its type and shape."""
    entry: dict[str, Any] = {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    if name.endswith(".npy"):
        array = np.load(io.BytesIO(data), allow_pickle=False)
        entry |= {"dtype": array.dtype.str, "shape": list(array.shape)}
    return entry
