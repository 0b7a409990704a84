"""The .npz files that scores come from, read without believing them."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.npy import array_from_zip

__all__ = ["read_arrays"]

MAX_UNPACKED_BYTES = 1 << 31


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """All arrays of an .npz, read-only; SceneError where it is damaged, holds objects, or is larger than 2 GiB."""
    try:
        with zipfile.ZipFile(path) as archive:
            infos = archive.infolist()
            size = sum(info.file_size for info in infos)
            if size > MAX_UNPACKED_BYTES:
                raise ValueError(f"it unpacks to {size} bytes, more than {MAX_UNPACKED_BYTES}")
            return {info.filename.removesuffix(".npy"): array_from_zip(archive, info) for info in infos}
    except (OSError, ValueError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
        raise SceneError(f"{path} cannot be read as an .npz of plain arrays ({error!s:.120}): write it again") from None
