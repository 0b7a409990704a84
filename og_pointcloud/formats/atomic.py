"""Files and folders that are written whole or not at all, and folders that one process at a time works in."""

from __future__ import annotations

import glob
import json
import os
import secrets
import shutil
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import IO, Any, BinaryIO, TypeAlias

from og_pointcloud.errors import OgPointcloudError

try:
    import fcntl
except ImportError:  # on Windows, where a second process is not kept out
    fcntl = None

StrPath: TypeAlias = "str | os.PathLike[str]"
"""A path as callers give it."""
LOCK = ".lock"
"""The file in a folder that shows other processes that one works there."""
STALE_S = 60.0
"""A younger temporary file is left alone: its maker may not have locked it yet."""


@contextmanager
def replacing(path: StrPath, *, durable: bool = True) -> Iterator[BinaryIO]:
    """A file to write that replaces ``path`` when, and only when, the block ends without an error.

    Several processes may write one path at a time: each file is whole, and the last one stays. Missing parent folders
    are created; temporary files that killed runs left for the same path are removed.
    durable: the file is on the disk before it replaces the path, so that not even a power cut leaves half of one; False
    for files whose readers check them. OSError names the path even if writing fails (a full disk). OgPointcloudError
    where the path is a folder, or a device, which would be destroyed.
    """
    path = Path(path)
    if path.exists() and not path.is_file():
        raise OgPointcloudError(f"'{path}' is a folder or a device; expected the path of a file to create or replace")
    path.parent.mkdir(parents=True, exist_ok=True)
    _remove_stale(path)
    temporary = _temporary(path)
    try:
        with temporary.open("xb") as file:  # a new file, never one planted there, nor a link
            _hold(file)
            yield file
            if not file.closed:
                file.flush()
                if durable:
                    os.fsync(file.fileno())
        if path.exists():
            shutil.copymode(path, temporary)  # a private file stays private
        os.replace(temporary, path)  # atomic: readers find the old file or the new one, whole
        if durable:
            _sync_folder(path.parent)
    except OSError as error:
        if error.filename is None and error.errno is not None:
            raise OSError(error.errno, f"{error.strerror}; the file was not written", str(path)) from error
        raise
    finally:
        temporary.unlink(missing_ok=True)  # if it has not replaced the path


def write_file(path: StrPath, data: bytes) -> Path:
    """Write a file whole or not at all, as `replacing` does; returns its path."""
    with replacing(path) as file:
        file.write(data)
    return Path(path)


def write_json(path: StrPath, value: Mapping[str, Any]) -> Path:
    """Write an indented JSON file, whole or not at all; returns its path."""
    text = json.dumps(value, indent=2, ensure_ascii=False)
    return write_file(path, text.encode(errors="backslashreplace") + b"\n")


@contextmanager
def replacing_folder(path: StrPath, *, overwrite: bool = False) -> Iterator[Path]:
    """The path of a folder to create and fill, which becomes ``path`` when, and only when, the block ends without an
    error. overwrite: it may replace an existing folder; else there must be none."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    # Remove what killed runs left: nobody holds its lock.
    for old in path.parent.glob(f".{glob.escape(path.name)}.*.tmp"):
        if old.is_dir() and not old.is_symlink():
            with suppress(OgPointcloudError), locked(old):
                if (before := old / f"{path.name}.before").exists() and not path.exists():
                    before.rename(path)  # killed after moving the old folder aside
                shutil.rmtree(old, ignore_errors=True)
    temporary = _temporary(path)
    temporary.mkdir()
    try:
        with locked(temporary):
            yield temporary / path.name
            # A folder that is not empty cannot be replaced: the old one is moved aside first.
            moved = [path.rename(temporary / f"{path.name}.before")] if overwrite and path.exists() else []
            try:
                os.replace(temporary / path.name, path)
            except BaseException:
                for old in moved:  # move it back, or it would be removed with the temporary folder
                    old.rename(path)
                raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


@contextmanager
def changing(path: StrPath) -> Iterator[None]:
    """Keep other processes from changing a file that is read and then replaced; OgPointcloudError if one is at it."""
    with ExitStack() as stack:
        with suppress(OSError):  # the reader says why a file cannot be read
            file = stack.enter_context(Path(path).open("rb"))
            # A file that was replaced since it was opened is no longer the one that others lock.
            if not _hold(file) or not os.path.samestat(os.fstat(file.fileno()), os.stat(path)):
                raise OgPointcloudError(
                    f"'{path}' is being changed by another process; expected one at a time: run this again afterwards"
                )
        yield


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Create the folder and keep other processes out of it; OgPointcloudError if another one already works there.

    The lock ends with the process, however that ends. A folder that is empty afterwards stays.
    """
    file = _lock_file(folder)
    try:
        yield
    finally:
        with suppress(OSError):
            (folder / LOCK).unlink()
        file.close()


def _lock_file(folder: Path) -> IO[bytes]:
    while True:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            file = (folder / LOCK).open("ab+", buffering=0)
        except OSError as error:
            raise OgPointcloudError(
                f"the work folder '{folder}' cannot be used ({error.strerror}); expected a writable folder: name "
                "another"
            ) from error
        if not _hold(file):
            file.seek(0)
            holder = file.read(80).decode(errors="replace").strip() or "another process"
            file.close()
            raise OgPointcloudError(
                f"the work folder '{folder}' is in use by {holder}; expected one run at a time: wait for it, or name "
                "another folder"
            )
        # A run that has just ended may have removed the file between our opening and locking it: then our lock keeps
        # nobody out, and the next iteration creates a new one.
        with suppress(OSError):
            if os.path.samestat(os.fstat(file.fileno()), (folder / LOCK).stat()):
                with suppress(OSError):  # a full disk: the lock holds without its owner's name
                    file.truncate(0)
                    file.write(f"process {os.getpid()}, since {time.strftime('%Y-%m-%d %H:%M:%S')}".encode())
                return file
        file.close()


def _hold(file: IO[bytes]) -> bool:
    """Lock an open file until it is closed; False where another process has locked it."""
    if fcntl is not None:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError:  # a network drive without locks
            return True
    return True


def _temporary(path: Path) -> Path:
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")


def _remove_stale(path: Path) -> None:
    """Remove temporary files of this path that no process is still writing."""
    for old in path.parent.glob(f".{glob.escape(path.name)}.*.tmp"):
        with suppress(OSError):
            if not old.is_symlink() and old.is_file() and time.time() - old.stat().st_mtime > STALE_S:
                with old.open("rb") as file:
                    if _hold(file):
                        old.unlink()


def _sync_folder(folder: Path) -> None:
    """Flush a folder's new entries to the disk, where the system can."""
    with suppress(OSError):
        number = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(number)
        finally:
            os.close(number)
