"""Write labelled clouds and splats as binary glTF 2.0 (.glb).

Points have colors; splats also have the attributes of KHR_gaussian_splatting (viewers without it draw points). Label
and instance are feature ids (EXT_mesh_features, attributes _FEATURE_ID_0 and _FEATURE_ID_1), with their names in
property tables (EXT_structural_metadata), which Cesium shows for a picked feature and uses for styling. Score and
reason are custom attributes; names are also in the mesh's extras.

Format: Khronos, "glTF 2.0 Specification", and the extensions' texts.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.atomic import StrPath, write_file
from og_pointcloud.formats.gaussian_ply import SH_CONSTANT
from og_pointcloud.formats.tables import LABEL_FINITE, naming
from og_pointcloud.scene import Points, require_finite

POINTS_MODE, ARRAY_BUFFER = 0, 34962
FLOAT = 5126
"""Component type of all columns. Ids too, exact up to 2^24: glTF has no 32-bit integers for vertices."""
VECTOR_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
GLB_MAGIC, GLB_VERSION, JSON_CHUNK, BINARY_CHUNK = b"glTF", 2, b"JSON", b"BIN\0"
FEATURES, METADATA = "EXT_mesh_features", "EXT_structural_metadata"
SPLATS = "KHR_gaussian_splatting"
SPLATS_AS = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
"""As splats are trained: display-referred sRGB colors."""
ALIGNMENT = 8
"""Bytes, for everything in the buffer: property tables need 8, vertex columns 4."""
NAME = "name"
"""The property of both tables: the name of a label, and of an instance's label."""


def write_gltf(
    path: StrPath,
    xyz_world: NDArray[np.floating],
    rgb: NDArray[np.uint8],
    attributes: Mapping[str, NDArray],
    names: Sequence[str],
    splats: Points | None = None,
) -> None:
    """Write a labelled cloud as .glb; whole or not at all.

    xyz_world: (n, 3), n at least 1; stored as float32 around their median, which is the node's translation. Axes stay
        as they are: glTF assumes y up, so rotate a scene with z up in the viewer.
    rgb: (n, 3) uint8 sRGB; stored linear, as the format requires.
    attributes: og_label, og_instance (n,) int32, og_score (n,) float32, og_reason (n,) uint8. Ids below 0 become the
        null feature id; og_reason tells them apart.
    names: those that og_label indexes.
    splats: Gaussians in the order of xyz_world; their shape and opacity are kept, their color is ``rgb``.
    SceneError where there are no points, or a coordinate is not finite, before or after conversion to float32.
    """
    path = Path(path)
    with naming(path):
        if len(xyz_world) == 0:
            raise SceneError("0 points; expected at least one: glTF has no empty clouds")
        require_finite(xyz_world, LABEL_FINITE)
        of_splats = {} if splats is None else _splat_columns(splats, rgb)
        # float32 around the median: world coordinates far from 0 would lose millimeters.
        origin = np.median(np.asarray(xyz_world, np.float64), axis=0)
        with np.errstate(over="ignore"):
            local = (xyz_world - origin).astype(np.float32)
        require_finite(local, f"glTF's float32 ends at 3.4e38, so {LABEL_FINITE}")
        columns = {"POSITION": local, "COLOR_0": _linear_colors(rgb, splats)}
        tables = {"og_label": list(names), "og_instance": _instance_names(attributes, names)}
        for index, (name, texts) in enumerate(tables.items()):
            ids = attributes[name]  # below 0 becomes the null feature id, one beyond the last
            columns[f"_FEATURE_ID_{index}"] = np.where(ids >= 0, ids, len(texts)).astype(np.float32)
        columns["_OG_SCORE"] = attributes["og_score"].astype(np.float32)
        columns["_OG_REASON"] = attributes["og_reason"].astype(np.float32)
        extensions: dict[str, Any] = {FEATURES: {}} | ({SPLATS: SPLATS_AS} if of_splats else {})
        buffer = _Buffer()
        document = _document(columns | of_splats, origin, extensions, names, buffer)
        extensions[FEATURES]["featureIds"] = _feature_sets(attributes, tables, document, buffer)
        write_file(path, _as_glb(document, buffer))


class _Buffer:
    """The binary buffer of a document, and its buffer views."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, int]] = []

    def add(self, data: bytes, **more: int) -> int:
        """Append data, aligned, and return the index of its buffer view. more: further entries of the view."""
        self.data += bytes(-len(self.data) % ALIGNMENT)
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data), **more})
        self.data += data
        return len(self.views) - 1


def _splat_columns(splats: Points, rgb: NDArray[np.uint8]) -> dict[str, NDArray[np.float32]]:
    """Attributes of KHR_gaussian_splatting: quaternions x y z w, linear scales, opacity, the constant harmonic."""
    scale, rotation, opacity = splats.gaussians
    if len(splats) != len(rgb):
        raise SceneError(f"{len(splats)} Gaussians for {len(rgb)} labels; expected one label per Gaussian")
    columns = {
        "ROTATION": rotation[:, [1, 2, 3, 0]],  # from w x y z
        "SCALE": scale,
        "OPACITY": opacity,
        "SH_DEGREE_0_COEF_0": ((rgb / 255 - 0.5) / SH_CONSTANT).astype(np.float32),
    }
    return {f"{SPLATS}:{name}": column for name, column in columns.items()}


def _linear_colors(rgb: NDArray[np.uint8], splats: Points | None) -> NDArray[np.float32]:
    """(n, 3) float32 linear color; (n, 4) with the opacity of splats. 8 bits would lose dark colors, and of 16 bits
    trimesh reads the lower ones."""
    # The transfer function of sRGB, IEC 61966-2-1.
    share = np.arange(256) / 255
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4).astype(np.float32)[rgb]
    return linear if splats is None else np.column_stack([linear, splats.gaussians[2]])


def _document(
    columns: Mapping[str, NDArray],
    origin: NDArray[np.float64],
    extensions: dict[str, Any],
    names: Sequence[str],
    buffer: _Buffer,
) -> dict[str, Any]:
    """The JSON document of one mesh with one point primitive; its columns are appended to the buffer."""
    accessors = [_accessor(buffer, column, with_bounds=name == "POSITION") for name, column in columns.items()]
    attributes = {name: index for index, name in enumerate(columns)}
    primitive = {"attributes": attributes, "mode": POINTS_MODE, "extensions": extensions}
    return {
        "asset": {"version": "2.0", "generator": "og-pointcloud"},
        "extensionsUsed": list(extensions),
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "translation": origin.tolist()}],
        "meshes": [{"primitives": [primitive], "extras": {"og_names": list(names)}}],
        "accessors": accessors,
    }


def _instance_names(attributes: Mapping[str, NDArray], names: Sequence[str]) -> list[str]:
    """The name of each instance's label, "" where it has none. All points of an instance share a label, so that of its
    first point is used."""
    ids, labels = attributes["og_instance"], attributes["og_label"]
    named = [""] * (int(ids.max(initial=-1)) + 1)
    present, first = np.unique(ids, return_index=True)
    for instance, label in zip(present.tolist(), labels[first].tolist(), strict=True):
        if instance >= 0 and label >= 0:
            named[instance] = names[label]
    return named


def _feature_sets(
    attributes: Mapping[str, NDArray], tables: Mapping[str, Sequence[str]], document: dict[str, Any], buffer: _Buffer
) -> list[dict[str, Any]]:
    """The feature sets of a primitive, one per table of names; the tables become the document's property tables.

    Strings are stored as one UTF-8 text, with the offset of each start and of the end. A table without any text is left
    out: a buffer cannot be empty.
    """
    feature_sets, classes, made = [], {}, []
    for index, (name, texts) in enumerate(tables.items()):
        ids = attributes[name]
        count = max(len(np.unique(ids[ids >= 0])), 1)  # the schema requires at least 1
        feature_sets.append({"featureCount": count, "nullFeatureId": len(texts), "attribute": index, "label": name})
        encoded = [text.encode() for text in texts]
        if any(encoded):  # len(texts) + 1 offsets, the last one the end
            offsets = np.cumsum([0, *map(len, encoded)]).astype("<u4").tobytes()
            places = {"values": buffer.add(b"".join(encoded)), "stringOffsets": buffer.add(offsets)}
            classes[name] = {"properties": {NAME: {"type": "STRING"}}}
            feature_sets[-1]["propertyTable"] = len(made)
            made.append({"name": name, "class": name, "count": len(texts), "properties": {NAME: places}})
    if made:
        document["extensionsUsed"].append(METADATA)
        schema = {"id": "og_pointcloud", "classes": classes}
        document["extensions"] = {METADATA: {"schema": schema, "propertyTables": made}}
    return feature_sets


def _accessor(buffer: _Buffer, column: NDArray, *, with_bounds: bool) -> dict[str, Any]:
    """The document's entry for a column, whose data is appended to the buffer."""
    accessor: dict[str, Any] = {
        "bufferView": buffer.add(column.astype("<f4", copy=False).tobytes(), target=ARRAY_BUFFER),
        "componentType": FLOAT,
        "count": len(column),
        "type": VECTOR_TYPES[column.shape[1] if column.ndim == 2 else 1],
    }
    if with_bounds:  # required for positions by the specification
        accessor |= {"min": column.min(axis=0).tolist(), "max": column.max(axis=0).tolist()}
    return accessor


def _as_glb(document: Mapping[str, Any], buffer: _Buffer) -> bytes:
    """Binary glTF (section 4 of the specification): a header of 12 bytes, then a JSON and a binary chunk. Chunks are
    padded to multiples of 4 bytes, JSON with spaces, binary with zeros."""
    binary = bytes(buffer.data) + bytes(-len(buffer.data) % 4)
    whole = {**document, "bufferViews": buffer.views, "buffers": [{"byteLength": len(binary)}]}
    text = json.dumps(whole, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = [
        struct.pack("<I4s", len(data), kind) + data for kind, data in ((JSON_CHUNK, text), (BINARY_CHUNK, binary))
    ]
    length = 12 + sum(map(len, chunks))
    return b"".join([struct.pack("<4sII", GLB_MAGIC, GLB_VERSION, length), *chunks])
