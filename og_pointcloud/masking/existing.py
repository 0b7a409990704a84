"""Existing masks: id images, COCO annotations, and results of a user's function."""

from __future__ import annotations

import importlib.util
import math
import posixpath
import runpy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError, first_line
from og_pointcloud.formats.faces import Face
from og_pointcloud.formats.images import MAX_PIXELS, same_shape, without_suffix
from og_pointcloud.formats.mask_files import read_ids
from og_pointcloud.formats.poses import MAX_JSON_BYTES, read_json
from og_pointcloud.masking.contracts import MaskProposer, Proposals
from og_pointcloud.scene import DoubleArray, IntArray, numbers_of

_READING_COCO = Lock()
"""A file is read once, not once in each thread: from Python 3.12 on, cached_property does not see to it."""
MAX_MASKS_PX = 1 << 33
"""Total pixels of all masks of one image: more are refused before allocation."""


def from_ids(ids: NDArray[np.integer], none: int = 0, tracks: bool = False) -> Proposals:
    """An id map (H, W) as proposals of score 1, by ascending id. none: the id outside every mask. tracks: whether ids
    are track numbers."""
    # Ids may be any numbers, with gaps: only those that occur become masks.
    names = np.unique(ids)
    names = names[names != none]
    _check_room(len(names), ids.shape, "the id map")
    of_tracks = names.astype(np.int64) if tracks else None
    return Proposals(ids == names[:, None, None], np.ones(len(names), np.float32), of_tracks)


def as_proposals(given: Any, shape: tuple[int, int]) -> Proposals:
    """The result of a user's function as proposals for an image of ``shape`` (H, W).

    It may return Proposals; bool (M, H, W), which get the score 1; or an integer id map (H, W), negative outside every
    mask, or 0 there if no id is negative. An empty list has no mask.
    """
    if isinstance(given, (list, tuple)):
        given = [numbers_of(mask) for mask in given]
        sizes = {mask.shape for mask in given}
        if len(sizes) > 1:
            raise SceneError(f"masks are {' and '.join(map(str, sorted(sizes)))}; expected all of {shape}")
        given = np.array(given) if given else np.zeros((0, *shape), np.bool_)
    masks = given.masks if isinstance(given, Proposals) else numbers_of(given)
    if masks.ndim in (2, 3) and masks.shape[-2:] != shape:
        raise SceneError(f"masks are {masks.shape}, their image is {shape}; expected the same (H, W)")
    if isinstance(given, Proposals):
        return given
    if masks.ndim == 2 and masks.dtype.kind in "iu":
        return from_ids(np.maximum(masks.astype(np.int64), -1), none=-1 if masks.min(initial=0) < 0 else 0)
    if masks.ndim == 3 and masks.dtype == np.bool_:
        return Proposals(masks, np.ones(len(masks), np.float32))
    raise SceneError(
        f"a mask proposer returned {type(given).__name__} {masks.dtype} {masks.shape}; expected Proposals, bool "
        "(masks, H, W), or an id map of whole numbers (H, W)"
    )


@dataclass(frozen=True)
class CallableProposer:
    """A user's function, image (H, W, 3) uint8 RGB -> what `as_proposals` takes, as a proposer. name: of the
    function, for errors."""

    function: Callable[[NDArray[np.uint8]], Any]
    name: str

    def propose(self, image: NDArray[np.uint8]) -> Proposals:
        """SceneError where the function fails, or returns something else."""
        height, width = image.shape[:2]
        try:
            given = self.function(image)
        except Exception as error:
            raise SceneError(
                f"the mask proposer {self.name} failed ({_user_error(error)}): og-pointcloud --debug shows where"
            ) from error
        return as_proposals(given, (height, width))


def user_proposer(place: str) -> MaskProposer:
    """The proposer ``MODULE:NAME``: a function for `CallableProposer`, an object whose ``propose`` is one, or a class
    of such objects, called without arguments. SceneError where there is none.

    MODULE is the file ``MODULE.py`` in the working directory (dots are folders), else a module that Python finds. The
    import path stays as it is: a file that imports its neighbors needs their folder in PYTHONPATH.
    """
    module, _, name = place.partition(":")
    if not name or not all(part.isidentifier() for part in module.split(".")):
        raise SceneError(f"the proposer is 'python:{place}'; expected python:MODULE:NAME")
    try:
        file = _local_file(module)
        # A file is run by its path, not imported: one called numpy.py does not shadow numpy.
        found = runpy.run_path(str(file))[name] if file.is_file() else getattr(importlib.import_module(module), name)
    except Exception as error:  # the module may raise anything
        raise SceneError(
            f"no proposer 'python:{place}' ({_user_error(error)}); expected a name in {module}.py here, or in an "
            "installed module"
        ) from error
    made = found() if isinstance(found, type) else found
    if callable(function := getattr(made, "propose", made)):
        return CallableProposer(function, f"python:{place}")
    raise SceneError(f"'python:{place}' is a {type(made).__name__}; expected a function or an object with propose()")


def user_source(place: str) -> list[Path]:
    """The file that defines ``MODULE:NAME``; empty if there is none."""
    module = place.partition(":")[0]
    if (file := _local_file(module)).is_file():
        return [file]
    try:
        spec = importlib.util.find_spec(module)
    except Exception:  # a package may raise anything; `user_proposer` says what
        return []
    return [Path(spec.origin)] if spec is not None and spec.origin else []


def _local_file(module: str) -> Path:
    """The path that a module's file in the working directory would have."""
    return Path(f"{module.replace('.', '/')}.py")


def _user_error(error: Exception) -> str:
    return f"{type(error).__name__}: {first_line(error)}"


@dataclass(frozen=True)
class ExistingMasks:
    """A folder of masks by image name: ``<name>.png`` of ids (as `read_ids`, 0 none), ``<name>.json`` (a list of RLE
    annotations, as segment-anything's script writes), or one COCO ``.json`` for all images.

    tracks: whether an id of a PNG means the same thing in all of them.
    """

    folder: Path
    tracks: bool = False

    def of(self, image_name: str, shape: tuple[int, int], face: Face | None = None) -> Proposals:
        """The masks of one image, resized to ``shape`` (H, W). SceneError where it has none.

        face: of a cube, which the image is; without masks of its own, it gets those of the whole image, cut like it.
        """
        found = self._stored(image_name)
        if found is None and face is not None:
            image_name = posixpath.dirname(image_name)
            found = self._stored(image_name)
        else:
            face = None
        if found is None:
            raise SceneError(
                f"{self.folder} has no masks for image '{image_name}'; expected {image_name}.png or {image_name}.json "
                "in it, or a COCO .json that lists it"
            )
        stored, source = found
        if isinstance(stored, list):
            return _from_annotations(stored, source, shape, face)
        return from_ids(_placed(stored, shape, face, source, -1), none=-1, tracks=self.tracks)

    def files(self, image_name: str, face: Face | None = None) -> list[Path]:
        """The files that hold masks of this image alone. All others that are read are the folder's ``*.json``."""
        names = [image_name] if face is None else [image_name, posixpath.dirname(image_name)]
        files = (self.folder / f"{name}{suffix}" for name in names for suffix in (".png", ".json"))
        return [file for file in files if file.is_file()]

    def _stored(self, image_name: str) -> tuple[IntArray | list[dict[str, Any]], str] | None:
        """The id map (H, W), -1 outside every mask, or the annotations of an image, and where they are."""
        for file in self.files(image_name):  # its own files come before files for all images
            if file.suffix == ".png":
                return read_ids(file), str(file)
            return _annotations(read_json(file, MAX_JSON_BYTES)), str(file)
        # Views are named by stem, or by a path below a folder that may be part of COCO's paths.
        with _READING_COCO:
            coco = self._coco
        alike = coco.get(image_name.rsplit("/", 1)[-1], {})
        # A view's folder tells cameras apart: a path that names another one is of another image.
        named = [
            path for path in alike
            if f"/{path}".endswith(f"/{image_name}") or ("/" in path and f"/{image_name}".endswith(f"/{path}"))
        ]  # fmt: skip
        if len(named) > 1:
            raise SceneError(
                f"{self.folder} lists {len(named)} images that '{image_name}' could be ({', '.join(named):.120}); "
                "expected one: use the paths of the pose file in the COCO file"
            )
        return (alike[named[0]], f"{self.folder}, image '{named[0]}'") if named else None

    @cached_property
    def _coco(self) -> dict[str, dict[str, list[dict[str, Any]]]]:
        """Annotations by their image's stem and path without suffix, each with the image's size, from all COCO files of
        the folder."""
        found: dict[str, dict[str, list[dict[str, Any]]]] = {}
        for file in sorted(self.folder.glob("*.json")):
            content = read_json(file, MAX_JSON_BYTES)
            if not (isinstance(content, dict) and isinstance(content.get("images"), list)):
                continue
            # COCO lists images and annotations separately; polygons need their image's size.
            images: dict[Any, tuple[list[dict[str, Any]], list[Any]]] = {}
            for image in content["images"]:
                known = isinstance(image, dict) and isinstance(image.get("id"), (int, str, type(None)))
                if not known or not isinstance(image.get("file_name"), str):
                    raise SceneError(f"{file}: an image is {image!r:.60}; expected id, file_name, height and width")
                path = without_suffix(image["file_name"].replace("\\", "/"))
                of_image = found.setdefault(path.rsplit("/", 1)[-1], {}).setdefault(path, [])
                images[image.get("id")] = of_image, [image.get("height"), image.get("width")]
            for annotation in _annotations(content.get("annotations")):
                image_id = annotation.get("image_id")
                if isinstance(image_id, (int, str)) and image_id in images:
                    of_image, size = images[image_id]
                    of_image.append({**annotation, "size": size})
        return found


def decode_rle(rle: Any, source: str = "RLE") -> NDArray[np.bool_]:
    """COCO's run-length code -> (H, W) bool. rle: {"size": [H, W], "counts": list of runs, or COCO's compressed text}.

    Runs alternate, background first, down the columns. SceneError where sizes are absurd, or runs do not fill them.
    """
    if not isinstance(rle, dict):
        raise SceneError(f"{source} is {type(rle).__name__}; expected a record with size and counts")
    height, width = _size(rle.get("size"), source)
    counts = rle.get("counts")
    if isinstance(counts, (str, bytes)):
        counts = _decompressed(counts, source)
    elif not (isinstance(counts, list) and all(type(run) is int for run in counts)):
        raise SceneError(f"{source}: counts are {type(counts).__name__}; expected whole numbers or COCO's string")
    if any(run < 0 for run in counts) or sum(counts) != height * width:
        raise SceneError(
            f"{source}: runs add up to {sum(counts)} pixels (shortest {min(counts, default=0)}), the image has "
            f"{height * width}; expected runs that fill it: the file is damaged or for another image"
        )
    values = np.arange(len(counts)) % 2 == 1
    return np.repeat(values, counts).reshape(width, height).T  # runs go down the columns


def _size(size: Any, source: str) -> tuple[int, int]:
    """[height, width] of a mask, checked before anything of that size is allocated."""
    if not (isinstance(size, list) and len(size) == 2 and all(type(length) is int and length > 0 for length in size)):
        raise SceneError(f"{source}: size is {size!r:.60}; expected [height, width] in pixels")
    if size[0] * size[1] > MAX_PIXELS:
        raise SceneError(f"{source}: size is {size[0]}x{size[1]}; expected at most {MAX_PIXELS} pixels")
    return size[0], size[1]


def _decompressed(text: str | bytes, source: str) -> list[int]:
    """Run lengths from COCO's text (cocoapi, maskApi.c, rleToString). Each character, less 48, has six bits: five of
    the number, lowest first, and a sixth that is set if more follow; the fifth bit of the last character is the sign.
    From the fourth run on, numbers are differences from the run two before."""
    data = text.encode("latin-1", "replace") if isinstance(text, str) else text
    runs: list[int] = []
    value = shift = 0
    for byte in data:
        bits = byte - 48
        if not 0 <= bits < 64 or shift > 50:
            raise SceneError(f"{source}: counts contain the byte {byte}; expected COCO's compressed run lengths")
        value |= (bits & 31) << shift
        shift += 5
        if not bits & 32:
            if bits & 16:  # two's complement of the bits read so far
                value -= 1 << shift
            runs.append(value + runs[-2] if len(runs) > 2 else value)
            value = shift = 0
    if shift:
        raise SceneError(f"{source}: counts end in the middle of a run: they are truncated")
    return runs


def _annotations(found: Any) -> list[dict[str, Any]]:
    found = found.get("annotations") if isinstance(found, dict) else found
    if not isinstance(found, list) or not all(isinstance(entry, dict) for entry in found):
        raise SceneError(f"annotations are {type(found).__name__}; expected a list of records with a segmentation")
    return found


def _from_annotations(
    annotations: Sequence[dict[str, Any]], source: str, shape: tuple[int, int], face: Face | None
) -> Proposals:
    """The masks of one image's annotations, each brought to ``shape`` at once: of a larger image, all would not fit
    into memory."""
    _check_room(len(annotations), shape, source)
    masks, scores, stored = np.zeros((len(annotations), *shape), np.bool_), [], None
    for index, annotation in enumerate(annotations):
        where = f"{source}, annotation {index}"
        segmentation = annotation.get("segmentation")
        if isinstance(segmentation, list):
            mask = _polygons(segmentation, annotation.get("size"), where)
        else:
            mask = decode_rle(segmentation, where)
        stored = stored or mask.shape
        if mask.shape != stored:
            raise SceneError(f"{where} is {mask.shape}, the first {stored}; expected masks of one image")
        masks[index] = _placed(mask, shape, face, where, False)
        score = annotation.get("score", annotation.get("predicted_iou", 1.0))
        # Not numpy's functions, which refuse whole numbers beyond 64 bits.
        finite = isinstance(score, (int, float)) and abs(score) < math.inf
        scores.append(float(min(max(score, 0), 1)) if finite else 1.0)
    return Proposals(masks, np.array(scores, np.float32))


def _polygons(polygons: list[Any], size: Any, source: str) -> NDArray[np.bool_]:
    """The mask inside rings of x, y in pixels. size: [height, width]."""
    drawn = np.zeros(_size(size, source), np.bool_)
    for ring in polygons:
        try:
            corners = np.array(ring, np.float64).reshape(-1, 2)
        except (ValueError, TypeError, OverflowError):
            corners = np.empty((0, 2))
        if len(corners) < 3 or not (np.abs(corners) < 1e6).all():
            raise SceneError(f"{source}: a polygon is {ring!r:.60}; expected x, y, x, y, ... of at least three corners")
        drawn |= _inside(corners, drawn.shape)
    return drawn


def _inside(corners: DoubleArray, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """(H, W) the pixels whose center is inside a ring of (n, 2) x, y. OpenCV's fillPoly also fills those that it only
    touches: half a pixel more all around."""
    height, width = shape
    flips = np.zeros((height, width + 1), np.bool_)
    for (x, y), (next_x, next_y) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        # Along a row, each edge that it crosses leads in or out.
        first, end = np.clip(np.ceil(np.sort([y, next_y]) - 0.5), 0, height).astype(np.int64)
        rows = np.arange(first, end)
        crossings = x + (rows + 0.5 - y) / (next_y - y or 1) * (next_x - x)
        flips[rows, np.clip(np.ceil(crossings - 0.5), 0, width).astype(np.int64)] ^= True
    return np.logical_xor.accumulate(flips[:, :width], axis=1)


def _placed(image: NDArray[Any], shape: tuple[int, int], face: Face | None, source: str, outside: int) -> NDArray[Any]:
    """A mask or id map at the size of its image, (H, W); if a face is given, cut like the face, which has this size.
    outside: the value where the lens saw nothing."""
    if face is None:
        return _resized(image, shape, source)
    face = face.of_size(shape[1], shape[0])
    return face.picked(_resized(image, (face.whole.height, face.whole.width), source), outside)


def _resized(image: NDArray[Any], shape: tuple[int, int], source: str) -> NDArray[Any]:
    """A mask or id map (h, w) at another size (H, W), by nearest pixel. SceneError where it would be stretched."""
    height, width = image.shape
    if not same_shape((height, width), shape):
        raise SceneError(
            f"{source}: the masks are {width}x{height} pixels, the image {shape[1]}x{shape[0]}; expected the same "
            "aspect ratio: make masks of the whole image as stored, not turned by its EXIF orientation"
        )
    # The old pixel that contains the center of each new pixel.
    rows = (np.arange(shape[0]) + 0.5) * height / shape[0]
    columns = (np.arange(shape[1]) + 0.5) * width / shape[1]
    return image[rows.astype(np.int64)[:, None], columns.astype(np.int64)]


def _check_room(masks: int, shape: tuple[int, ...], source: str) -> None:
    if masks * int(np.prod(shape)) > MAX_MASKS_PX:
        raise SceneError(f"{source} has {masks} masks of {shape}; expected at most {MAX_MASKS_PX} pixels in total")
