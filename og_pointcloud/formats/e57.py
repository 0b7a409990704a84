"""E57 files (ASTM E2807) of laser scanners: their scans as one cloud, their images as a capture folder.

Poses take scans and images to the file's world. A pinhole image looks along -z, y up; a spherical one along +x, z up,
and may end before the poles: it is padded with black. Images without a pose, cylindrical ones, and those that only
illustrate the site (visual references) cannot be used. Read by pye57's libE57 (MIT, BSL), the extra 'e57', which checks
the file's checksums.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import OgPointcloudError, SceneError, first_line, naming_extra
from og_pointcloud.formats.atomic import StrPath, write_file, write_json
from og_pointcloud.formats.images import MAX_PIXELS, decoded_bytes, require_cv2, stated_size
from og_pointcloud.formats.ply import plain_rows, write_ply
from og_pointcloud.formats.poses import MAX_NUMBER, pose_of_quaternion
from og_pointcloud.formats.tables import naming
from og_pointcloud.scene import DoubleArray

E57_SIGNATURE = b"ASTM-E57"
CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
COLORS = ("colorRed", "colorGreen", "colorBlue")
INVALID_STATES = ("cartesianInvalidState", "sphericalInvalidState")
POINTS_PER_CHUNK = 1 << 18
"""Points read at once."""
MAX_POINTS_PER_BYTE = 8
"""No scanner's file packs more; one that claims to is an attempt to fill memory."""
TURN_TOLERANCE = 0.02
"""A spherical image must span 360 degrees, within this relative tolerance."""
SPHERICAL_FROM_OPENGL = np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]])
"""OpenGL's axes (right, up, back) in the frame of a spherical image, as columns."""


def looks_like_e57(head: bytes) -> bool:
    """Whether a file with these first bytes is an E57."""
    return head.startswith(E57_SIGNATURE)


def read_e57(path: StrPath) -> NDArray[np.void]:
    """Rows x, y, z and, if all scans have colors, red, green, blue of all scans of an E57 file in its world; points
    that the scanner marks as invalid are left out.

    SceneError, beginning with the path, for a file that is damaged or has no points; MissingExtraError without pye57.
    """
    parts: list[tuple[DoubleArray, NDArray[np.uint8] | None]] = []
    path = Path(path)
    with _opened(path) as (libe57, file):
        most = MAX_POINTS_PER_BYTE * path.stat().st_size
        for scan in _children(file.root(), "data3D"):
            parts += _scan(libe57, file, scan, most)
            most -= scan["points"].childCount()  # several scans may name the same bytes
        if not parts:
            raise SceneError("it has no scan with points; expected one or more: export the scans with the images")
        xyz = np.concatenate([xyz for xyz, _ in parts])
        colors = [rgb for _, rgb in parts if rgb is not None]
        rgb = np.concatenate(colors) if len(colors) == len(parts) else None
        return plain_rows(xyz, rgb)


def unpack_e57(path: StrPath, folder: StrPath) -> tuple[int, list[str]]:
    """Write an E57 file as a capture folder: ``images/``, ``transforms.json``, ``points.ply``.

    Returns the number of images, and the name and reason for each that cannot be used. SceneError if none can.
    """
    path, folder = Path(path), Path(folder)
    if (folder / "images").is_symlink():
        raise SceneError(
            f"{folder / 'images'} is a link, and nothing is written through links; expected a folder: remove it"
        )
    rows = read_e57(path)
    frames, unused = [], []
    with _opened(path) as (_, file):
        for number, image in enumerate(_children(file.root(), "images2D")):
            name = _text(image, "name") or f"image {number}"
            try:  # an image that cannot be used does not cost the others
                frames.append(_unpack_image(image, folder, f"{number:04d}_{_slug(name)}", path.stat().st_size))
            except SceneError as error:
                unused.append(f"{name:.60}: {error}")
        if not frames:
            why = unused[0] if unused else "the file has no images"
            raise SceneError(f"none of its images can be used ({why}); expected pinhole or spherical ones with poses")
    write_ply(folder / "points.ply", {"vertex": rows})
    write_json(folder / "transforms.json", {"ply_file_path": "points.ply", "frames": frames})
    return len(frames), unused


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Any]]:
    """libE57 and the open file; errors of libE57 inside become SceneError."""
    with naming_extra("pye57", "e57"):
        from pye57 import libe57  # pyright: ignore[reportAttributeAccessIssue]
    with naming(path):
        path.stat()
        file = None
        try:
            file = libe57.ImageFile(str(path), "r")
            yield libe57, file
        except (OgPointcloudError, OSError, MemoryError):
            raise
        except Exception as error:  # errors of libE57 and of its bindings
            raise SceneError(f"not a whole E57 file ({first_line(error)}): copy or export it again") from None
        finally:
            if file is not None:
                file.close()


def _children(node: Any, name: str) -> Iterator[Any]:
    if node.isDefined(name):
        vector = node[name]
        for index in range(vector.childCount()):
            yield vector[index]


def _text(node: Any, name: str) -> str:
    return str(node[name].value()) if node.isDefined(name) else ""


def _number(node: Any, name: str) -> float:
    if not node.isDefined(name):
        raise SceneError(f"it has no {name}")
    field = node[name]  # a float, an integer, or an integer that counts steps of a scale
    value = float(field.scaledValue() if hasattr(field, "scaledValue") else field.value())
    if not abs(value) <= MAX_NUMBER:
        raise SceneError(f"its {name} is {value}; expected a finite number")
    return value


def _pose(node: Any) -> DoubleArray | None:
    """(4, 4) to the file's world, or None if there is no pose."""
    if not node.isDefined("pose"):
        return None
    pose = node["pose"]
    quaternion = [_number(pose["rotation"], axis) for axis in "wxyz"]
    return pose_of_quaternion(quaternion, [_number(pose["translation"], axis) for axis in "xyz"])


# Points -----------------------------------------------------------------------------------------------------------


def _scan(libe57: Any, file: Any, scan: Any, most: int) -> list[tuple[DoubleArray, NDArray[np.uint8] | None]]:
    """Chunks of points in the file's world, and their colors."""
    vector = scan["points"]
    prototype = libe57.StructureNode(vector.prototype())
    fields = {prototype.get(index).elementName() for index in range(prototype.childCount())}
    places = next((names for names in (CARTESIAN, SPHERICAL) if fields.issuperset(names)), None)
    if places is None:
        raise SceneError(f"a scan has the fields {', '.join(sorted(fields)):.120}; expected {', '.join(CARTESIAN)}")
    if vector.childCount() > most:
        raise SceneError(f"a scan claims {vector.childCount()} points, more than fit into the file: copy it again")
    colors = COLORS if fields.issuperset(COLORS) else ()
    wanted = [*places, *colors, *(name for name in INVALID_STATES if name in fields)]
    # libE57 fills these arrays chunk by chunk, converted to float64 and scaled (the two True arguments).
    arrays = {name: np.zeros(min(POINTS_PER_CHUNK, max(vector.childCount(), 1))) for name in wanted}
    buffers = libe57.VectorSourceDestBuffer()
    for name, array in arrays.items():
        buffers.append(libe57.SourceDestBuffer(file, name, array, len(array), True, True))
    pose, limits, parts = _pose(scan), [_color_limit(scan, name) for name in colors], []
    reader = vector.reader(buffers)
    while count := reader.read():
        valid = np.ones(count, np.bool_)
        for name in INVALID_STATES:  # 0: valid; 1, 2: only a direction, or nothing
            valid &= arrays[name][:count] == 0 if name in arrays else True
        xyz = np.column_stack([arrays[name][:count][valid] for name in places])
        xyz = xyz if places is CARTESIAN else _from_angles(*xyz.T)
        if pose is not None:
            xyz = xyz @ pose[:3, :3].T + pose[:3, 3]
        # Each scan states its largest color value: 255 or 65535, for example.
        scaled = [255 * arrays[name][:count][valid] / limit for name, limit in zip(colors, limits, strict=True)]
        rgb = np.clip(np.rint(np.column_stack(scaled)), 0, 255).astype(np.uint8) if colors else None
        parts += [(xyz, rgb)] if len(xyz) else []
    reader.close()
    return parts


def _from_angles(distance: DoubleArray, azimuth: DoubleArray, elevation: DoubleArray) -> DoubleArray:
    """(n, 3) from range and radians: azimuth from x towards y, elevation above the xy plane."""
    flat = distance * np.cos(elevation)
    return np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(elevation)])


def _color_limit(scan: Any, name: str) -> float:
    limit = _number(scan["colorLimits"], f"{name}Maximum") if scan.isDefined("colorLimits") else 255.0
    return limit if limit > 0 else 255.0


# Images -----------------------------------------------------------------------------------------------------------


def _unpack_image(image: Any, folder: Path, name: str, most: int) -> dict[str, Any]:
    """Write an image; returns its frame for transforms.json. SceneError states why it cannot be used."""
    pose = _pose(image)
    if pose is None:
        raise SceneError("it has no pose")
    kind = next((k for k in ("pinhole", "spherical") if image.isDefined(f"{k}Representation")), None)
    if kind is None:
        raise SceneError("it is neither pinhole nor spherical")
    shown = image[f"{kind}Representation"]
    width, height = (round(_number(shown, f"image{side}")) for side in ("Width", "Height"))
    across, along = _number(shown, "pixelWidth"), _number(shown, "pixelHeight")
    if not (0 < width * height <= MAX_PIXELS and across > 0 and along > 0):
        raise SceneError(f"it is {width}x{height} pixels of {across} x {along}; expected sizes above 0")
    suffix, data = _blob(shown, most)
    keys: dict[str, Any] = {"w": width, "h": height}
    if kind == "pinhole":
        focal = _number(shown, "focalLength")  # a length, like pixelWidth
        keys |= {"camera_model": "PINHOLE", "fl_x": focal / across, "fl_y": focal / along}
        keys |= {"cx": _number(shown, "principalPointX"), "cy": _number(shown, "principalPointY")}
    else:
        data = _whole_sphere(data, suffix, (width, height), (across, along))  # pixels span radians here
        pose[:3, :3] = pose[:3, :3] @ SPHERICAL_FROM_OPENGL
        keys |= {"camera_model": "EQUIRECTANGULAR", "h": width // 2, "w": width // 2 * 2}
    write_file(folder / "images" / f"{name}{suffix}", data)
    return {"file_path": f"images/{name}{suffix}", "transform_matrix": pose.tolist(), **keys}


def _blob(shown: Any, most: int) -> tuple[str, bytes]:
    kind = next((kind for kind in ("jpeg", "png") if shown.isDefined(f"{kind}Image")), None)
    if kind is None:
        raise SceneError("it contains no JPEG or PNG")
    blob = shown[f"{kind}Image"]
    size = blob.byteCount()
    if not 0 < size <= most:
        raise SceneError(f"its {kind} claims {size} bytes, more than the file has")
    data = np.zeros(size, np.uint8)
    blob.read(data, 0, size)
    return ".jpg" if kind == "jpeg" else ".png", data.tobytes()


def _whole_sphere(data: bytes, suffix: str, size: tuple[int, int], pixel: tuple[float, float]) -> bytes:
    """The image with black above and below, twice as wide as high. pixel: radians, across and along."""
    (width, height), (across, along) = size, pixel
    if abs(width * across / (2 * np.pi) - 1) > TURN_TOLERANCE or height * along > np.pi * (1 + TURN_TOLERANCE):
        turn, rise = np.degrees([width * across, height * along])
        raise SceneError(f"it spans {turn:.0f} x {rise:.0f} degrees; expected 360 across, and 180 at most")
    cv2 = require_cv2()
    if stated_size(io.BytesIO(data), "its image") != size:  # a small file may unpack to gigabytes
        raise SceneError("its JPEG or PNG is damaged, or its size is not the one the file states")
    pixels = np.asarray(decoded_bytes(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR, "its image"))
    # The sphere is twice as wide as high; the image takes its part of the height, in the middle.
    whole = width // 2 * 2, width // 2
    shown = min(whole[1], max(1, round(whole[1] * height * along / np.pi)))
    above = (whole[1] - shown) // 2
    if pixels.shape[:2] == whole[::-1] and shown == whole[1]:
        return data
    pixels = cv2.resize(pixels, (whole[0], shown), interpolation=cv2.INTER_AREA)
    padded = cv2.copyMakeBorder(pixels, above, whole[1] - shown - above, 0, 0, cv2.BORDER_CONSTANT)
    return cv2.imencode(suffix, padded, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()


def _slug(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]+", "_", name)[:60].strip("_") or "image"
