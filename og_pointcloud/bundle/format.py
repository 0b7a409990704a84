"""The .ogpc file: what is in it, and the limits that it is held against.

One zip, every member stored uncompressed, nothing pickled:

  manifest.json            format, schema_version, feature_space, frame (origin, unit, spacing, reach), counts,
                           members (bytes, sha256, dtype, shape of each), parity figures of the graph, provenance
  query.onnx               the graph that answers text; the instance table's descriptors (R, D) are its constants
  arrays/*.npy             xyz, instance_ids (smallest integer type), rgb and certainty if known, instances/*
  vocabulary/names.json    words that may be asked as strings, if any
  vocabulary/vectors.npy   (L, D) float32 unit vectors, in older files float16
  bank/vectors.npy         (B, D) float16, everyday words that labels are judged by (``ask.choosing``), if it has them
  text_encoder/*           the files of a text encoder (see ``text.encoder``), if it carries one; read when needed

``bundle.read`` reads it, ``og_pointcloud_export`` writes it.
"""

from __future__ import annotations

import hashlib
import io
import re
from typing import Any

import numpy as np

FORMAT = "ogpc"
SCHEMA_VERSION = 2
"""Raised when files of before cannot be asked any more: 2 is the graph that settles points at borders itself."""
ON_SURFACE, NEAR, BEYOND = 0, 1, 2
"""How far a query point is from the cloud: within about 1.5 spacings, within reach, or too far."""

MAX_MEMBERS = 256
MAX_MANIFEST_BYTES = 1 << 26
SAFE_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*(/[A-Za-z0-9_][A-Za-z0-9_.-]*)*")
INTEGERS, FLOATS = ("|i1", "<i2", "<i4"), ("<f2", "<f4")
QUERY_OPERATORS = frozenset({
    "Abs", "Add", "ArgMax", "ArgMin", "Cast", "Concat", "Div", "Expand", "Gather", "GatherElements", "Greater",
    "GreaterOrEqual", "Identity", "IsNaN", "Less", "LessOrEqual", "MatMul", "Max", "Min", "Mod", "Mul", "NonZero",
    "ReduceL2", "ReduceMax", "ReduceSum", "Reshape", "ScatterElements", "Shape", "Slice", "Split", "Sub",
    "Transpose", "Unsqueeze", "Where",
})  # fmt: skip
"""What a query.onnx is made of: arithmetic and look-ups, nothing that repeats or branches."""
REBUILD = "write the file again with write_bundle"
BANK = "bank/vectors.npy"
INSTANCE_MEMBERS = {"part_of": "whole"}
"""Columns of the instance table whose member has another name, as it was in the first files of schema 2."""
RGB, CERTAINTY = "arrays/rgb.npy", "arrays/certainty.npy"
CARRIED_ENCODER = "text_encoder/"
"""What the names of a carried text encoder's members begin with."""


def describe_member(name: str, data: bytes) -> dict[str, Any]:
    """What the manifest says of a member: bytes, sha256 and, of an array, its type and shape."""
    entry: dict[str, Any] = {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    if name.endswith(".npy"):
        array = np.load(io.BytesIO(data), allow_pickle=False)
        entry |= {"dtype": array.dtype.str, "shape": list(array.shape)}
    return entry
