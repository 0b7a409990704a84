"""Cameras exported by photogrammetry programs: Agisoft Metashape's XML, RealityScan's (RealityCapture's) CSV.

Metashape    File > Export > Export Cameras, Agisoft XML. Poses are camera-to-chunk with OpenCV axes; the transform of
             the chunk, or of the camera's component, takes them to the world (geocentric where the project has
             coordinates). The principal point is relative to the image's middle; p1 and p2 are OpenCV's p2 and p1, k4
             is the coefficient of r^8.
RealityScan  Registration, "Internal/External camera parameters": a line per image, ``#name,x,y,alt,heading,pitch,roll,
             f,px,py,k1,k2,k3,k4,t1,t2``. At angles of 0 a camera looks down with north at the top. Focal length
             and principal point are in millimeters of a frame whose longer side is 36.

Images are given by file name only, by Metashape as ``group/name`` here where names repeat. They are searched for in the
folder and its image folders.
"""

from __future__ import annotations

import csv
import io
import itertools
import posixpath
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.lenses import SPHERICAL, Lens, lens_of, spherical_camera
from og_pointcloud.formats.poses import MAX_NUMBER, OPENGL_SIGNS, PosedFrames, PosedImage, inverse, rigid
from og_pointcloud.formats.tables import naming
from og_pointcloud.scene import Camera, DoubleArray

ImageSize = Callable[[str], tuple[int, int]]

MAX_BYTES = 1 << 28
HEAD_BYTES = 4096
"""Bytes that are enough to recognize a file."""
MAX_SKEW_PX = 1.0
"""Largest neglected shift by the skew b2, at the upper and lower border."""
FISHEYES = ("fisheye", "equidistant_fisheye")
"""Metashape's names of one model; the second since it has others."""
FULL_FRAME_MM = 36.0
"""Longer side of the 35 mm film that RealityScan's lengths refer to."""
COLUMNS = ["x", "y", "alt", "heading", "pitch", "roll", "f", "px", "py", "k1", "k2", "k3", "k4", "t1", "t2"]


def find_photogrammetry(capture: Path) -> Path | None:
    """The export of one of these programs in the folder, recognized by its first bytes, or None."""
    files = [*sorted(capture.glob("*.xml")), *sorted(capture.glob("*.csv"))]
    return next((file for file in files if file.is_file() and _reader(file) is not None), None)


def read_photogrammetry(file: Path, image_size: ImageSize) -> PosedFrames:
    """Poses of the export that `find_photogrammetry` found. ``image_size(name)`` returns (width, height) of an image.

    Images without a pose are dropped. SceneError names the file, the camera and the cure.
    """
    reader = _reader(file)
    if reader is None:
        raise SceneError(f"{file} is neither Metashape's XML of cameras nor RealityScan's CSV: export it again")
    if (size := file.stat().st_size) > MAX_BYTES:
        raise SceneError(f"{file} has {size} bytes; expected at most {MAX_BYTES}: split it")
    with naming(file):
        frames = reader(file.read_text(encoding="utf-8-sig", errors="replace"), image_size)
        if not frames.images:
            raise SceneError(f"none of its {len(frames.dropped)} cameras has a pose: align the photographs first")
    return frames


def _reader(file: Path) -> Callable[[str, ImageSize], PosedFrames] | None:
    with file.open("rb") as stream:
        head = stream.read(HEAD_BYTES).removeprefix(b"\xef\xbb\xbf").lstrip()
    if file.suffix == ".csv":
        return _realityscan if head.startswith(b"#name,") else None
    return _metashape if b"<document" in head and b"<chunk" in head else None


# Metashape --------------------------------------------------------------------------------------------------------


def _metashape(text: str, _: ImageSize) -> PosedFrames:
    if "<!DOCTYPE" in text or "<!ENTITY" in text:  # a few nested entities unpack to gigabytes
        raise SceneError("the XML defines entities; expected none, as in Metashape's files: export it again")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise SceneError(f"not valid XML ({error}): export the cameras again") from None
    chunks = [chunk for chunk in root.iter("chunk") if chunk.get("enabled") != "false" and _cameras(chunk)]
    # A chunk without a transform has a world of its own, which is allowed only if the file has one chunk.
    placed = [
        chunk for chunk in chunks if _world_of(chunk) is not None or chunk.find(".//component/transform") is not None
    ]
    if len(chunks) > 1 and len(placed) < len(chunks):
        labels = ", ".join(repr(chunk.get("label")) for chunk in chunks)
        raise SceneError(f"the chunks {labels:.200} have no common world; expected one chunk: align or disable chunks")
    images, dropped = [], []
    for chunk in chunks:
        _require_common_world(chunk)
        posed, without = _chunk(chunk)
        images += posed
        dropped += without
    return PosedFrames(tuple(images), tuple(dropped))


def _cameras(chunk: ElementTree.Element) -> list[ElementTree.Element]:
    """The enabled cameras of a chunk, including those in groups."""
    return [camera for camera in chunk.iterfind("cameras//camera") if camera.get("enabled") not in ("false", "0")]


def _require_common_world(chunk: ElementTree.Element) -> None:
    """SceneError where cameras lie in several components, one of them without a transform: it is not aligned."""
    ids = {camera.get("component_id") for camera in _cameras(chunk) if camera.find("transform") is not None} - {None}
    placed = {each.get("id") for each in chunk.iterfind("components/component") if each.find("transform") is not None}
    if len(ids) > 1 and ids - placed:
        raise SceneError(
            f"{len(ids)} components of the chunk '{chunk.get('label') or '':.60}' have cameras but no common world; "
            "expected one component: align or merge them, or disable the cameras of the others"
        )


def _paths(chunk: ElementTree.Element) -> list[tuple[ElementTree.Element, str]]:
    """The enabled cameras and their images: labels, below those of their groups where two cameras share one."""
    cameras = _cameras(chunk)
    labels = [camera.get("label") or "" for camera in cameras]
    if len(set(labels)) < len(labels):
        groups = {camera: group.get("label") or "" for group in chunk.iterfind("cameras//group") for camera in group}
        labels = [posixpath.join(groups.get(of, ""), label) for of, label in zip(cameras, labels, strict=True)]
    return list(zip(cameras, labels, strict=True))


def _chunk(chunk: ElementTree.Element) -> tuple[list[PosedImage], list[str]]:
    sensors = {sensor.get("id"): sensor for sensor in chunk.iterfind("sensors/sensor")}
    worlds = {component.get("id"): _world_of(component) for component in chunk.iterfind("components/component")}
    world_of_chunk, images, dropped = _world_of(chunk), [], []
    for camera, path in _paths(chunk):
        transform = camera.find("transform")
        sensor = sensors.get(camera.get("sensor_id"))
        if transform is None or sensor is None:
            dropped.append(path)
            continue
        with naming(f"camera '{path:.60}'"):
            # Cameras that were aligned in several groups lie in components, each with its own transform to the world.
            world = worlds.get(camera.get("component_id")) or world_of_chunk or (1.0, np.eye(3), np.zeros(3))
            images.append(_metashape_image(path, sensor, _floats(transform, 16).reshape(4, 4), world))
    return images, dropped


World = tuple[float, DoubleArray, DoubleArray]
"""Scale, rotation, translation: world = scale * rotation @ chunk + translation."""


def _world_of(element: ElementTree.Element) -> World | None:
    transform = element.find("transform")
    if transform is None:
        return None
    rotation, translation, scale = (transform.find(name) for name in ("rotation", "translation", "scale"))
    factor = 1.0 if scale is None else float(_floats(scale, 1)[0])
    if factor <= 0:  # all cameras in one place, or mirrored places
        raise SceneError(f"its scale is {factor:g}; expected a number above 0: export the cameras again")
    return (
        factor,
        np.eye(3) if rotation is None else _floats(rotation, 9).reshape(3, 3),
        np.zeros(3) if translation is None else _floats(translation, 3),
    )


def _metashape_image(path: str, sensor: ElementTree.Element, to_chunk: DoubleArray, world: World) -> PosedImage:
    scale, rotation, translation = world
    with np.errstate(all="ignore"):  # `Camera` refuses the result
        pose = inverse(rigid(rotation @ to_chunk[:3, :3], scale * rotation @ to_chunk[:3, 3] + translation))
    # A sensor may have an initial and an adjusted calibration; poses belong to the adjusted one.
    calibrations = sensor.findall("calibration")
    adjusted = next((made for made in calibrations if made.get("class") == "adjusted"), None)
    calibration = adjusted if adjusted is not None else next(iter(calibrations), None)
    resolution = sensor.find("resolution")
    if resolution is None:
        raise SceneError("its sensor has no resolution: export the cameras again")
    width, height = (_whole(resolution.get(side)) for side in ("width", "height"))
    kind = sensor.get("type") or "frame"
    if kind == "spherical":
        return PosedImage(path, spherical_camera(width, height, pose), SPHERICAL)
    if calibration is None:
        raise SceneError("its sensor has no calibration: export the cameras again")
    terms = {child.tag: _floats(child, 1)[0].item() for child in calibration if child.tag != "resolution"}
    focal = terms.pop("f", 0.0)
    # u = width / 2 + cx + x f + x b1 + y b2, v = height / 2 + cy + y f (Metashape's manual, camera models).
    cx, cy, skew = width / 2 + terms.pop("cx", 0.0), height / 2 + terms.pop("cy", 0.0), terms.pop("b2", 0.0)
    if abs(skew) * height > 2 * MAX_SKEW_PX * max(focal, 1.0):
        raise SceneError(f"its calibration has the skew b2 = {skew}; expected 0: optimize the cameras without b2")
    camera = Camera(width, height, focal + terms.pop("b1", 0.0), focal, cx, cy, pose)
    return PosedImage(path, camera, _metashape_lens(kind, terms))


def _metashape_lens(kind: str, terms: dict[str, float]) -> Lens | None:
    if kind not in ("frame", *FISHEYES):
        raise SceneError(
            f"its sensor is of type '{kind:.40}'; expected frame, fisheye or spherical: undistort the images"
        )
    terms["p1"], terms["p2"] = terms.get("p2", 0.0), terms.get("p1", 0.0)
    if kind in FISHEYES:
        return lens_of("fisheye", terms)
    terms["r8"] = terms.pop("k4", 0.0)
    return lens_of("perspective", terms)


def _floats(element: ElementTree.Element, count: int) -> DoubleArray:
    words = (element.text or "").split()
    try:
        values = np.array([float(word) for word in words[: count + 1]])
    except ValueError:
        values = np.empty(0)
    if len(values) != count or not np.isfinite(values).all():
        raise SceneError(f"<{element.tag:.40}> contains '{' '.join(words[:4]):.60}'; expected {count} numbers")
    return values


def _whole(text: str | None) -> int:
    if text is None or not text.isascii() or not text.isdigit() or len(text) > 9:
        raise SceneError(f"its sensor's resolution is '{text or '':.20}'; expected whole numbers of pixels")
    return int(text)


# RealityScan ------------------------------------------------------------------------------------------------------


def _realityscan(text: str, image_size: ImageSize) -> PosedFrames:
    try:
        lines = csv.DictReader(io.StringIO(text))
        missing = [name for name in ("x", "y", "alt", "heading", "f") if name not in (lines.fieldnames or ())]
        if missing:
            raise SceneError(f"it has no column '{missing[0]}'; expected Internal/External camera parameters as CSV")
        return PosedFrames(tuple(_realityscan_images(lines, image_size)), ())
    except csv.Error as error:
        raise SceneError(f"not a CSV of cameras ({error!s:.80}): export it again") from None


def _realityscan_images(lines: csv.DictReader[str], image_size: ImageSize) -> Iterator[PosedImage]:
    for number, line in zip(itertools.count(2), lines, strict=False):  # line 1 has the names
        name = (line["#name"] or "").strip().replace("\\", "/").rsplit("/", 1)[-1]
        with naming(f"line {number}"):
            if not name:
                raise SceneError("it names no image; expected #name first: export it again")
            values = _numbers(line)
            width, height = image_size(name)
            scale = max(width, height) / FULL_FRAME_MM  # pixels per millimeter
            center = np.array([values["x"], values["y"], values["alt"]])
            pose = rigid(_looking_down(values["heading"], values["pitch"], values["roll"]), center) * OPENGL_SIGNS
            camera = Camera(
                width, height, scale * values["f"], scale * values["f"], width / 2 + scale * values["px"],
                height / 2 + scale * values["py"], inverse(pose),
            )  # fmt: skip
            terms = {"k1": "k1", "k2": "k2", "k3": "k3", "r8": "k4", "p1": "t1", "p2": "t2"}
            lens = lens_of("perspective", {term: values[column] for term, column in terms.items()})
        yield PosedImage(name, camera, lens)


def _numbers(line: Mapping[str, str | None]) -> dict[str, float]:
    """The numbers of a line by column; 0 for columns that an export may leave out."""
    values = {}
    for column in COLUMNS:
        text = line.get(column)
        if text is None and column in line:
            raise SceneError(f"it ends before {column}: it is truncated; copy or export it again")
        try:
            values[column] = float(text or 0)
        except (TypeError, ValueError):
            values[column] = np.nan
        if not abs(values[column]) <= MAX_NUMBER:
            raise SceneError(f"{column} is '{text!s:.40}'; expected a number")
    return values


def _looking_down(heading: float, pitch: float, roll: float) -> DoubleArray:
    """(3, 3) camera to world, OpenGL axes, world x east, y north, z up. Degrees; heading is clockwise from north. At 0
    OpenGL's axes are the world's: the camera looks along -z, down, with its y to the north."""
    (sy, sp, sr), (cy, cp, cr) = (wave(np.radians([-heading, pitch, roll])) for wave in (np.sin, np.cos))
    about_up = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    about_right = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    about_forward = np.array([[cr, 0, sr], [0, 1, 0], [-sr, 0, cr]])
    return about_up @ about_right @ about_forward
