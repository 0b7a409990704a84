"""The bytes of a .npy file -> array, without a copy and without trusting its header; and back."""

from __future__ import annotations

import io
import mmap
import tokenize
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import OgPointcloudError, SceneError

MAX_HEADER_BYTES = 1 << 17
"""Bytes within which a header must end; numpy refuses headers of more than 10,000 characters."""
LAST_CODE_POINT = 0x10FFFF
"""The last code point of Unicode."""
MAX_RATIO, ALWAYS_ALLOWED_BYTES = 200, 1 << 26
"""A file may unpack to this many times its size, or to this many bytes. Vectors hardly compress, masks by 100."""


def array_from_npy(data: bytes | mmap.mmap) -> NDArray[Any]:
    """A read-only array backed by ``data``; ValueError if it is not a .npy, holds objects, or differs in length."""
    stream = io.BytesIO(data[:MAX_HEADER_BYTES])
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    try:
        shape, fortran_order, dtype = read(stream)
        shape = tuple(map(int, shape))  # numpy accepts True as an int until it counts bytes
    except (ValueError, SyntaxError, tokenize.TokenError, TypeError, RecursionError) as error:  # from its parser
        raise ValueError(f"its header cannot be parsed ({str(error).partition(chr(10))[0]:.80})") from None
    if dtype.hasobject:
        raise ValueError(f"it contains Python objects ({dtype}), which are never loaded")
    count = int(np.prod(shape, dtype=object))  # Python's integers do not overflow
    claimed, held = count * dtype.itemsize, len(data) - stream.tell()
    if any(length < 0 for length in shape) or claimed != held or (count and not dtype.itemsize):
        raise ValueError(f"its header claims {dtype} {shape}, {claimed} bytes, but {held} follow")
    if claimed == 0:
        return np.zeros(shape, dtype)
    flat = np.frombuffer(data, dtype, count, offset=stream.tell())
    # Otherwise numpy would raise an error later, without the file's name, when it makes strings of the numbers.
    if dtype.kind == "U" and (flat.view(f"{dtype.byteorder}u4") > LAST_CODE_POINT).any():
        raise ValueError(f"it contains {dtype} text with characters that do not exist")
    return flat.reshape(shape[::-1]).T if fortran_order else flat.reshape(shape)


def mapped_array(file: Path) -> NDArray[Any]:
    """The array of a .npy file, memory-mapped, so that only used parts are read. SceneError where it cannot be read.

    numpy.load is not used: for a type without bytes it divides by zero, which ends the process.
    """
    try:
        with file.open("rb") as stream:
            return array_from_npy(mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ))
    except (ValueError, OSError) as error:
        raise SceneError(
            f"{file} cannot be read as a .npy array ({error!s:.120}): it is damaged or truncated, write it again"
        ) from None


def read_npz(
    file: Path,
    needed: Sequence[str],
    optional: Sequence[str],
    max_bytes: int,
    expected: str,
    kind: type[OgPointcloudError] = SceneError,
) -> dict[str, NDArray[Any]]:
    """The arrays of an .npz that are needed, and the optional ones that it has, by name; a name may end in .npy itself.

    An error of this kind, which begins with the file, if it is not an .npz, lacks what is ``expected``, unpacks to
    more than ``max_bytes``, uses a compression that numpy does not, or claims to end beyond the file. Nothing is
    unpickled, and nothing is unpacked before its size is checked.
    """
    try:
        with zipfile.ZipFile(file) as archive:
            held = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            if (total := sum(info.file_size for info in held.values())) > max_bytes:
                raise ValueError(f"it unpacks to {total} bytes; expected at most {max_bytes}")
            if total > max(ALWAYS_ALLOWED_BYTES, MAX_RATIO * file.stat().st_size):
                raise ValueError(f"it unpacks to {total} bytes, {MAX_RATIO} times its size: it is made to fill memory")
            # OpenGaussian's names end in .npy, and numpy.savez appends another one.
            found = {name: held.get(name) or held.get(f"{name}.npy") for name in (*needed, *optional)}
            arrays = {name: _array_from_zip(archive, info) for name, info in found.items() if info}
    except (zipfile.BadZipFile, zlib.error, ValueError, OSError, EOFError, RuntimeError) as error:
        raise kind(
            f"{file}: it cannot be read as an .npz of plain arrays ({error!s:.120}): write it again with numpy.savez"
        ) from None
    if missing := [name for name in needed if name not in arrays]:
        raise kind(
            f"{file}: it lacks {len(missing)} of {len(needed)} arrays, e.g. '{missing[0]}' (it has "
            f"{', '.join(held) or 'nothing':.120}); expected {expected}"
        )
    return arrays


def _array_from_zip(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> NDArray[Any]:
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"a member is compressed by method {info.compress_type}, which numpy does not use")
    if info.header_offset + info.compress_size > archive.start_dir:
        raise ValueError(f"a member claims {info.compress_size} bytes, more than the file has")
    return array_from_npy(archive.read(info))


def npy_bytes(array: NDArray[Any]) -> bytes:
    """An array as a .npy file: little-endian, rows in C order, the same bytes for the same values everywhere."""
    stream = io.BytesIO()
    little_endian = array.astype(array.dtype.newbyteorder("<"), copy=False)
    np.lib.format.write_array(stream, np.ascontiguousarray(little_endian), version=(1, 0), allow_pickle=False)
    return stream.getvalue()
