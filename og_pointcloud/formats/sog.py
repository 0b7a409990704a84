"""Read SOG, PlayCanvas's packed splats (version 2, in one file): a zip of meta.json and lossless WebP images.

Pixel i of each image, row by row, is splat i. Positions have 16 bits a coordinate, the low bytes in one image and the
high bytes in another, between bounds of the logarithm of their distance from 0; of rotations the three smallest
components are stored, in eight bits each; log scales and base colors are indices into tables of 256 numbers. Axes are
those of a PLY.

Harmonics above the constant one are not read, as in PLY files.

Format: PlayCanvas, "The SOG Format"; compared with the files of sogpy 1.0.2.
"""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import OgPointcloudError, SceneError, printable
from og_pointcloud.formats.gaussian_ply import SH_CONSTANT, Splats, activated, from_smallest_three, unpacked_limit
from og_pointcloud.formats.images import decoded_bytes, require_cv2, stated_size
from og_pointcloud.scene import DoubleArray

Bytes = NDArray[np.uint8]

ZIP, META, VERSION = b"PK\x03\x04", "meta.json", 2
LARGEST_CODES = 252
"""The alpha of a rotation is this plus the index of its largest component, in the order w x y z."""
TABLE_SIZE = 256
MAX_META_BYTES = 1 << 20


def looks_like_sog(head: bytes) -> bool:
    """Whether a file with these first bytes is a zip, which no other geometry here is."""
    return head.startswith(ZIP)


def read_sog(path: Path) -> Splats:
    """Gaussians of a SOG file; world coordinates, the median as origin.

    SceneError for a file that is damaged, of another format, or claims more than it holds.
    """
    with _whole_zip(), zipfile.ZipFile(path) as archive:
        sog = _Sog(archive, path.stat().st_size)
        low, high = sog.pixels("means", 0)[:, :3], sog.pixels("means", 1)[:, :3]
        scales, rotation, color = sog.pixels("scales")[:, :3], sog.pixels("quats"), sog.pixels("sh0")
    least, most = sog.numbers("means", "mins", 3), sog.numbers("means", "maxs", 3)
    share = (low + high.astype(np.float64) * 256) / 65535
    logarithm = least + (most - least) * share
    if (rotation[:, 3] < LARGEST_CODES).any():
        raise SceneError("the alphas of its rotations are not 252 to 255: export it again, without lossy compression")
    others = (rotation[:, :3] / 255 - 0.5) * np.sqrt(2)
    with np.errstate(over="ignore"):  # told as not finite
        xyz = np.sign(logarithm) * np.expm1(np.abs(logarithm))
        scale = np.exp(sog.numbers("scales", "codebook", TABLE_SIZE)[scales]).astype(np.float32)
    base = 0.5 + SH_CONSTANT * sog.numbers("sh0", "codebook", TABLE_SIZE)[color[:, :3]]
    wxyz = from_smallest_three(rotation[:, 3] - LARGEST_CODES, others)
    return activated(xyz, scale, wxyz, color[:, 3] / 255, base)


@contextmanager
def _whole_zip() -> Iterator[None]:
    """SceneError for all that zipfile raises of damaged files; our own errors pass."""
    try:
        yield
    except OgPointcloudError:
        raise
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, ValueError, OSError) as error:
        raise SceneError(f"not a whole zip, as a SOG file is ({error!s:.80}): copy or export it again") from None


class _Sog:
    """A zip whose meta.json was checked. Its images are checked, and then unpacked, one by one."""

    def __init__(self, archive: zipfile.ZipFile, packed: int) -> None:
        self._archive, self._most = archive, unpacked_limit(packed)
        self._members = {info.filename: info for info in archive.infolist()}
        if META not in self._members:
            raise SceneError("a zip without meta.json; expected a SOG file of splats, as SuperSplat exports it")
        content = self._bytes(META, MAX_META_BYTES)
        try:
            self._meta = json.loads(content)
        except (ValueError, RecursionError) as error:
            raise SceneError(f"its meta.json is no JSON ({error!s:.80}): copy or export it again") from None
        version = self._meta.get("version") if isinstance(self._meta, dict) else None
        if version != VERSION:
            raise SceneError(f"its meta.json says version {version!r:.20}; expected {VERSION}: export it again")
        count = self._meta.get("count")
        if type(count) is not int or not 1 <= count <= self._most:
            raise SceneError(f"its meta.json says {count!r:.20} splats; expected one or more, as many as it holds")
        self._count: int = count

    def numbers(self, part: str, name: str, count: int) -> DoubleArray:
        """(count,) numbers that meta.json lists."""
        listed = self._of(part, name)
        are_numbers = isinstance(listed, list) and all(type(each) in (int, float) for each in listed)
        if not are_numbers or len(listed) != count:
            raise SceneError(f"its {part} {name} are {listed!r:.40}; expected {count} numbers: export it again")
        try:
            return np.array(listed, np.float64)
        except OverflowError:
            raise SceneError(f"its {part} {name} have a number beyond float64: export it again") from None

    def pixels(self, part: str, number: int = 0) -> Bytes:
        """(count, 4) bytes of the splats, red to alpha; alpha is 255 where the image has none."""
        names = self._of(part, "files")
        name = names[number] if isinstance(names, list) and len(names) > number else None
        if not isinstance(name, str) or name not in self._members:
            raise SceneError(f"it has no image {number} of {part} ({name!r:.40}): copy or export it again")
        data, what = self._bytes(name, self._most), printable(name, 40)
        width, height = stated_size(io.BytesIO(data), what) or (0, 0)
        if not self._count <= width * height <= self._most // 4:
            raise SceneError(f"{what} has {width}x{height} pixels; expected one for each of {self._count} splats")
        cv2 = require_cv2()
        image = decoded_bytes(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED, what)
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] not in (3, 4):
            raise SceneError(f"{what} is {image.dtype} {image.shape}; expected 8-bit colors")
        to_rgba = cv2.COLOR_BGR2RGBA if image.shape[2] == 3 else cv2.COLOR_BGRA2RGBA
        return np.asarray(cv2.cvtColor(image, to_rgba), np.uint8).reshape(-1, 4)[: self._count]

    def _of(self, part: str, name: str) -> Any:
        record = self._meta.get(part)
        return record.get(name) if isinstance(record, dict) else None

    def _bytes(self, name: str, most: int) -> bytes:
        if (size := self._members[name].file_size) > most:
            raise SceneError(f"{printable(name, 40)} claims {size} bytes; expected at most {most}")
        # zipfile unpacks bz2 and lzma whole, whatever size is claimed.
        if (method := self._members[name].compress_type) not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise SceneError(
                f"{printable(name, 40)} is compressed by method {method}; expected {zipfile.ZIP_STORED} (stored) or "
                f"{zipfile.ZIP_DEFLATED} (deflated): export it again"
            )
        return self._archive.read(name)
