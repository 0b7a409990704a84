"""sensor_msgs/PointCloud2 <-> arrays, in numpy alone.

A message is any object with a PointCloud2's attributes: of rclpy, of rosbags (ROS 1 or 2), or a plain one. Its sizes
are used only after checking that they agree with each other and with the data.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.ask.segmentation import Segmentation
from og_pointcloud.cloud import UNKNOWN
from og_pointcloud.errors import SceneError
from og_pointcloud.formats.colors import label_colors
from og_pointcloud_ros.messages import MessageFactory, header, plain_messages

MAX_FLOAT32_M = 2.0**14
"""Meters from 0 (16 km) within which float32 resolves millimeters."""
UNLABELLED = 65535
"""Label of an unlabelled point: the 16-bit id that vision_msgs/LabelInfo reserves for that."""
ATTRIBUTES = ("height", "width", "fields", "is_bigendian", "point_step", "row_step", "data")
TYPE_CODES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""sensor_msgs/PointField's datatypes."""
DATATYPES = {np.dtype(code): number for number, code in TYPE_CODES.items()}


def from_pointcloud2(message: Any) -> NDArray[np.float64]:
    """(N, 3) float64, x y z of every point, row by row for an organized cloud, in the message's own frame.

    N is height * width: invalid points stay as NaN or infinity, so that row i is point i of the message. x, y and z may
    have any of the eight types, in any order, at any offset. SceneError if they are missing, or sizes disagree.
    """
    rows = read_fields(message)
    xyz = np.empty((*rows.shape, 3))
    for axis, name in enumerate("xyz" if rows.size else ""):
        values = rows[name] if name in (rows.dtype.names or ()) else None
        if values is None or values.shape != rows.shape:
            fields = ", ".join(rows.dtype.names or ()) or "none"
            what = "is absent" if values is None else f"has {values.shape[-1]} values per point"
            raise SceneError(f"field '{name}' of a PointCloud2 {what} (its fields: {fields}); expected x, y, z")
        xyz[..., axis] = values
    return xyz.reshape(-1, 3)


def read_fields(message: Any) -> NDArray[Any]:
    """(height, width) structured array over the message's own bytes: ``read_fields(message)["intensity"]``.

    Nothing is copied, unless data is a plain list; read-only if the message's bytes are. A field of count c has shape
    (height, width, c). Numbers are in the message's byte order. SceneError if sizes disagree.
    """
    if absent := [name for name in ATTRIBUTES if not hasattr(message, name)]:
        raise SceneError(f"a {type(message).__name__} has no '{absent[0]}'; expected a sensor_msgs/PointCloud2")
    height, width, point_step, row_step = (
        _size(message, name) for name in ("height", "width", "point_step", "row_step")
    )
    try:
        kind = _dtype(message.fields, point_step, ">" if message.is_bigendian else "<")
    except SceneError:
        raise
    except (AttributeError, TypeError, ValueError, OverflowError) as error:
        raise SceneError(
            f"the fields of a PointCloud2 are damaged ({error}); expected each with name, offset, datatype and count"
        ) from None
    data = _bytes_of(message.data)
    # A single row needs no step, and the last row no padding: some drivers omit them.
    needed = max(height - 1, 0) * row_step + width * point_step if height else 0
    fits = row_step >= width * point_step or height <= 1
    if not fits or data.size not in (needed, height * row_step) or data.size < needed:
        raise SceneError(
            f"a PointCloud2 of {height} x {width} points of {point_step} bytes, rows of {row_step}, has {data.size} "
            f"bytes; expected {max(needed, height * max(row_step, width * point_step))}: it was cut off, or is damaged"
        )
    if height * width == 0:
        return np.zeros((height, width), kind)
    if point_step == 0:
        raise SceneError(f"a PointCloud2 has {height * width} points of 0 bytes; expected x, y and z in each")
    # Strides skip the padding behind points and rows.
    return np.ndarray((height, width), kind, data, strides=(row_step if height > 1 else data.size, point_step))


def to_pointcloud2(
    result: Segmentation,
    frame_id: str = "map",
    stamp: Any = None,
    *,
    xyz: NDArray[np.floating] | None = None,
    double: bool | None = None,
    messages: MessageFactory = plain_messages,
) -> Any:
    """A labelled cloud as sensor_msgs/PointCloud2: fields x y z rgb label instance score, 28 bytes a point.

    label: uint32, row of ``result.names``, 65535 unlabelled (``to_label_info`` gives the names). instance: int32, -1
    background, -2 unobserved, -3 too far. score: float32. rgb: one color per label, packed as in PCL.
    stamp: a Time message, or nanoseconds since the epoch. messages: factory of the message's library.
    xyz: (N, 3) coordinates in frame_id, if that is not the scene's world: the sensor's cloud; (height, width, 3) for a
    message of that height and width.
    double: write x y z as float64, which few viewers read; None: if float32 would round most of them by millimeters,
    as for a map in UTM. ROS units are meters (REP 103).
    """
    xyz = result.xyz if xyz is None else xyz
    organized = xyz.shape[:-1]
    if len(organized) not in (1, 2) or xyz.shape[-1] != 3 or xyz.size != 3 * len(result):
        raise SceneError(
            f"xyz has shape {xyz.shape}; expected ({len(result)}, 3), one row per label, or (height, width, 3)"
        )
    xyz = xyz.reshape(-1, 3)
    if double is None and xyz.dtype != np.float32:
        finite = np.abs(xyz[np.logical_and.reduce(np.isfinite(xyz), axis=1)])
        double = bool(len(finite)) and float(np.median(finite.max(axis=1))) > MAX_FLOAT32_M
    # x, y, z are filled together as one sub-array; a view of the same bytes names the three.
    place = "<f8" if double else "<f4"
    colors = [("rgb", "<f4"), ("label", "<u4"), ("instance", "<i4"), ("score", "<f4")]
    rows = np.empty(len(result), [("xyz", place, 3), *colors])
    with np.errstate(over="ignore"):  # values beyond float32 become infinite
        rows["xyz"] = xyz
    rows["rgb"] = _packed_colors(len(result.names))[result.labels]
    rows["label"] = np.where(result.labels < 0, UNLABELLED, result.labels)
    rows["instance"] = result.instances
    rows["score"] = result.scores
    rows = rows.view([*((axis, place) for axis in "xyz"), *colors]).reshape(organized)
    return write_fields(rows, frame_id, stamp, messages=messages)


def write_fields(
    rows: NDArray[Any], frame_id: str, stamp: Any = None, *, messages: MessageFactory = plain_messages
) -> Any:
    """A PointCloud2 with the unchanged bytes of a structured array (N,) or (height, width); inverse of ``read_fields``.

    SceneError for fields that have none of the eight number types, and for two byte orders in one array.
    """
    rows = np.ascontiguousarray(np.atleast_2d(rows))
    columns = {name: column[:2] for name, column in (rows.dtype.fields or {}).items()}
    orders = {kind.base.byteorder for kind, _ in columns.values()} - {"|"}
    known = all(kind.base.newbyteorder("=") in DATATYPES for kind, _ in columns.values())
    if not columns or len(orders) > 1 or not known:
        raise SceneError(f"a PointCloud2 cannot hold {rows.dtype}; expected fields of 8 to 32-bit integers and floats")
    # A structured dtype holds the same as PointFields: names, offsets, types, counts.
    height, width = rows.shape
    fields = [
        messages("sensor_msgs/msg/PointField", name=name, offset=offset, datatype=datatype, count=count)
        for name, (kind, offset) in columns.items()
        for datatype, count in [(DATATYPES[kind.base.newbyteorder("=")], int(np.prod(kind.shape)))]
    ]
    coordinates = [rows[axis] for axis in "xyz" if axis in columns]
    return messages(
        "sensor_msgs/msg/PointCloud2", header=header(messages, frame_id, stamp), height=height, width=width,
        fields=fields, is_bigendian=orders == {">" if sys.byteorder == "little" else "="}, point_step=rows.itemsize,
        row_step=width * rows.itemsize,
        data=rows.reshape(-1).view(np.uint8) if rows.size else np.zeros(0, np.uint8),
        is_dense=all(bool(np.isfinite(values).all()) for values in coordinates),
    )  # fmt: skip


def _size(message: Any, name: str) -> int:
    value = getattr(message, name)
    if not isinstance(value, (int, np.integer)) or value < 0:
        raise SceneError(f"{name} of a PointCloud2 is {value!r}; expected a whole number from 0")
    return int(value)


def _dtype(fields: Any, point_step: int, byte_order: str) -> np.dtype[Any]:
    """The fields as a structured dtype of point_step bytes; unnamed fields are padding."""
    kinds: dict[str, tuple[Any, int]] = {}
    for field in fields:
        name, offset, count = field.name, int(field.offset), max(int(field.count), 1)  # PCL writes a count of 0 as 1
        code = TYPE_CODES.get(int(field.datatype))
        if code is None:
            raise SceneError(f"field '{name}' of a PointCloud2 has datatype {field.datatype}; expected 1 to 8")
        end = offset + count * np.dtype(code).itemsize
        if offset < 0 or end > point_step:
            raise SceneError(f"field '{name}' of a PointCloud2 spans bytes {offset} to {end} of a point's {point_step}")
        if name in kinds:
            raise SceneError(f"field '{name}' of a PointCloud2 appears twice; expected each name once")
        if name:
            kinds[name] = ((byte_order + code, (count,)) if count > 1 else byte_order + code, offset)
    formats, offsets = [kind for kind, _ in kinds.values()], [offset for _, offset in kinds.values()]
    return np.dtype({"names": list(kinds), "formats": formats, "offsets": offsets, "itemsize": point_step})


def _bytes_of(data: Any) -> NDArray[np.uint8]:
    if isinstance(data, (list, tuple)):
        return np.array(data, np.uint8)
    try:
        return np.frombuffer(data, np.uint8)
    except (TypeError, ValueError, BufferError) as error:
        raise SceneError(
            f"data of a PointCloud2 is a {type(data).__name__} ({error}); expected a contiguous run of bytes"
        ) from None


def _packed_colors(names: int) -> NDArray[np.float32]:
    """(names + 1,) float32 with bits 0x00RRGGBB: one color per label, then that of unknown, indexed by label -1."""
    red, green, blue = label_colors(np.append(np.arange(names), UNKNOWN)).astype(np.uint32).T
    return (red << 16 | green << 8 | blue).view(np.float32)
