"""ONNX models: finding fetched ones, checking untrusted ones, and opening sessions.

Nothing is fetched here, and onnxruntime is imported nowhere else.

An untrusted graph is checked by its bytes before any runtime gets them (`check_graph`). onnxruntime reads any local
file that a graph names as the location of its constants, and fills constants of any size that a header claims. So a
graph passes only if its constants are stored in its own bytes, at the length that their shape requires, and its nodes
are standard operators: no other domain, no functions, no graphs inside nodes.

Field numbers are those of onnx.proto3, named in comments; messages are traversed without copying.
"""

from __future__ import annotations

import json
import math
import os
import re
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import OgPointcloudError, first_line

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

MANIFEST = "manifest.json"
MODEL_NAME = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*", re.ASCII)
REVISION = re.compile(r"[0-9a-f]{40}")
ERRORS_ONLY = 3
"""Lowest severity that onnxruntime logs."""
MAX_GRAPH_BYTES, MAX_RUN_S = 3 << 30, 120.0
"""Largest memory for weights and all that is computed from them, and longest run in seconds; the largest text encoders
take half of that memory, and one second."""
STANDARD_DOMAINS = ("", "ai.onnx")
TYPE_BYTES = {1: 4, 2: 1, 3: 1, 4: 2, 5: 2, 6: 4, 7: 8, 9: 1, 10: 2, 11: 8, 12: 4, 13: 8, 16: 2}
"""Bytes per element, by TensorProto.DataType; without strings (8), which have no fixed length."""
VARINT, FIXED_64, BYTES, FIXED_32 = 0, 1, 2, 5


def hub_cache() -> Path:
    """The folder of fetched models, by the environment variables of Hugging Face's tools; it need not exist."""
    cache = os.environ.get("XDG_CACHE_HOME") or home_folder() / ".cache"
    home = os.environ.get("HF_HOME") or os.path.join(cache, "huggingface")
    hub = os.environ.get("HF_HUB_CACHE") or os.environ.get("HUGGINGFACE_HUB_CACHE") or os.path.join(home, "hub")
    return Path(os.path.expandvars(os.path.expanduser(hub)))


def home_folder() -> Path:
    """The user's home; a nonexistent path for users without one, as in containers run under a bare user id."""
    try:
        return Path.home()
    except RuntimeError:
        return Path("/nonexistent")


def model_folder(name: str | os.PathLike[str]) -> Path | None:
    """A model's folder, by its path or by OWNER/MODEL as last fetched; None if there is none."""
    folder = Path(name).expanduser()
    return folder if folder.is_dir() else fetched_model(str(name))


def fetched_model(name: str) -> Path | None:
    """The folder of OWNER/MODEL as last fetched; None if it was not fetched, or the name has another form."""
    if not MODEL_NAME.fullmatch(name):
        return None
    model = hub_cache() / f"models--{name.replace('/', '--')}"
    # Layout of the Hugging Face cache: refs/main holds the revision, snapshots/REVISION the files.
    main = model / "refs" / "main"
    revision = main.read_text(encoding="utf-8", errors="replace").strip()[:64] if main.is_file() else ""
    folder = model / "snapshots" / revision
    return folder if REVISION.fullmatch(revision) and folder.is_dir() else None


def open_session(model: bytes, *, bounded: bool = False) -> InferenceSession:
    """A CPU session that leaves the cores idle between runs. model: a serialized ONNX graph.

    bounded: for an untrusted graph. Nothing is computed on opening, and all such graphs share MAX_GRAPH_BYTES of
    memory: a run that needs more fails.
    """
    # Read on import, which otherwise writes a device id and a usage database into the user's cache folder.
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = ERRORS_ONLY
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.enable_mem_pattern = False  # else it keeps one for every number of points that it was ever given
    if bounded:
        _bound_memory()
        options.add_session_config_entry("session.use_env_allocators", "1")
    without = ["ConstantFolding"] if bounded else []  # it would compute on opening, before run_bounded's time counts
    return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"], disabled_optimizers=without)


@cache
def _bound_memory() -> None:
    """Create the process's bounded allocator, shared by all sessions with ``session.use_env_allocators``."""
    import onnxruntime as ort

    kind, usual = (ort.OrtAllocatorType.ORT_ARENA_ALLOCATOR, ort.OrtMemType.DEFAULT)  # pyright: ignore
    place = ort.OrtMemoryInfo("Cpu", kind, 0, usual)  # pyright: ignore
    ort.create_and_register_allocator(place, ort.OrtArenaCfg(MAX_GRAPH_BYTES, -1, -1, -1))  # pyright: ignore


def run_bounded(
    session: InferenceSession, given: Mapping[str, NDArray[Any]], outputs: Sequence[str] | None = None
) -> list[Any]:
    """The named outputs, computing only what they need; None: all. TimeoutError after MAX_RUN_S. A timeout or Ctrl-C
    stops the run between two nodes."""
    import onnxruntime

    options: Any = onnxruntime.RunOptions()
    options.log_severity_level = ERRORS_ONLY + 1
    options.only_execute_path_to_fetches = outputs is not None
    # In a separate thread: this one can then stop waiting, and set `terminate`, which onnxruntime checks.
    with ThreadPoolExecutor(1) as pool:
        answer = pool.submit(session.run, outputs, dict(given), options)
        try:
            return list(answer.result(MAX_RUN_S))
        except BaseException:
            options.terminate = True
            raise


@dataclass(frozen=True)
class EncoderFormat:
    """A kind of folder that ``og-pointcloud export`` writes; such folders are untrusted.

    name, version: ``format`` and ``schema_version`` of its manifest.json. graph: the ONNX graph's file. operators:
    those that the graph may use. command: makes such a folder. more: further files, with the maximum bytes of each.
    optional: one of them that may be absent.
    """

    name: str
    version: int
    graph: str
    operators: frozenset[str]
    command: str
    more: Mapping[str, int] = field(default_factory=dict)
    optional: str = ""

    @property
    def files(self) -> dict[str, int]:
        """All files, with the maximum bytes of each; a serialized graph cannot have more."""
        return {MANIFEST: 1 << 20, self.graph: (1 << 31) - 1, **self.more}

    @property
    def remake(self) -> str:
        """The cure at the end of error texts."""
        return f"make the encoder again with {self.command}"

    def read(self, folder: Path) -> dict[str, bytes]:
        """The bytes of a folder's files, with only their size checked; OgPointcloudError if one is missing."""
        present = [name for name in self.files if name != self.optional or (folder / name).is_file()]
        return {name: self._bounded(folder / name) for name in present}

    def _bounded(self, path: Path) -> bytes:
        most = self.files[path.name]
        try:
            with path.open("rb") as file:
                size = os.fstat(file.fileno()).st_size
                if size <= most:
                    return file.read(size)  # not the limit, which it would allocate
        except FileNotFoundError:
            raise OgPointcloudError(f"{path} is missing: {self.remake}") from None
        raise OgPointcloudError(f"{path} has {size} bytes; expected at most {most}: {self.remake}")

    def checked(self, files: Mapping[str, bytes], where: str, take: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
        """The manifest, if all files are consistent. take: checks its other fields, and raises KeyError, TypeError or
        ValueError. OgPointcloudError, whose text begins with ``where``, says what is wrong."""
        try:
            for name, data in files.items():
                if len(data) > self.files[name]:
                    raise ValueError(f"{name} has {len(data)} bytes; expected at most {self.files[name]}")
            manifest = json.loads(files[MANIFEST])
            stated = manifest["format"], manifest["schema_version"]
            if stated != (self.name, self.version):
                raise ValueError(f"its format is {stated!r:.60}; expected {self.name!r} {self.version}")
            needed = {*self.files} - {self.optional}
            for name in sorted((needed | {*files, *manifest["files"]}) - {MANIFEST}):
                # Not its sha256: eight times as slow, and whoever can change a file can change its manifest.
                if manifest["files"][name]["crc32"] != zlib.crc32(files[name]):
                    raise ValueError(f"{name} does not match the manifest's checksum: it is damaged or was changed")
            check_graph(files[self.graph], self.operators)
            take(manifest)
        except KeyError as error:
            raise OgPointcloudError(f"{where}: {error} is missing: {self.remake}") from None
        except (ValueError, TypeError, AttributeError, RecursionError) as error:
            raise OgPointcloudError(f"{where}: not a usable encoder ({error}): {self.remake}") from None
        return manifest

    def feature_space(self, folder: Path) -> str | None:
        """The feature space in a folder's manifest; None without a readable one: unrelated folders may lie here too."""
        try:
            manifest = json.loads(self._bounded(folder / MANIFEST))
        except (OgPointcloudError, OSError, ValueError, RecursionError):
            return None
        ours = isinstance(manifest, dict) and manifest.get("format") == self.name
        return manifest.get("feature_space") if ours else None

    def find(self, feature_space: str, folders: Sequence[Path]) -> Path | None:
        """The first encoder of a feature space among folders that may be encoders, or contain some."""
        for folder in folders:
            inside = sorted(path for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []
            for candidate in (folder, *inside):
                if self.feature_space(candidate) == feature_space:
                    return candidate
        return None

    def vectors(
        self, session: InferenceSession, given: NDArray[Any], shape: tuple[int, ...], where: str, output: str = ""
    ) -> NDArray[np.float32]:
        """The graph's output for its only input: finite float32 of this shape. output: its name, "" for the first.

        OgPointcloudError, whose text begins with ``where``, for a graph that fails or returns anything else.
        """
        try:
            outputs = [output or session.get_outputs()[0].name]
            vectors = np.asarray(run_bounded(session, {session.get_inputs()[0].name: given}, outputs)[0])
        except Exception as error:  # onnxruntime raises types of its own
            raise OgPointcloudError(
                f"{where}: {self.graph} does not run ({first_line(error)}): {self.remake}"
            ) from None
        if vectors.dtype != np.float32 or vectors.shape != shape or not np.isfinite(vectors).all():
            raise OgPointcloudError(
                f"{where}: {self.graph} returns {vectors.dtype} {vectors.shape} or NaN; expected finite float32 "
                f"{shape}: {self.remake}"
            )
        return vectors


def check_graph(model: bytes, operators: frozenset[str] | None = None) -> None:
    """ValueError, which says why, for a graph that is damaged or may do more than compute with its own constants.

    operators: the allowed operators; None for all standard ones.
    """
    for number, value in message_fields(memoryview(model)):
        if number == 25:  # ModelProto.functions
            raise ValueError("it defines functions of its own")
        if number == 8 and (domain := text_of(value, 1)) not in STANDARD_DOMAINS:  # ModelProto.opset_import.domain
            raise ValueError(f"it uses operators of {domain!r:.40}, which are not standard")
        if number == 7:  # ModelProto.graph
            _check_parts(value, operators)


def _check_parts(graph: memoryview | int, operators: frozenset[str] | None) -> None:
    for number, part in message_fields(graph):
        if number == 1:  # GraphProto.node
            _check_node(part, operators)
        elif number == 5:  # GraphProto.initializer
            constant_of(part)
        elif number == 15:  # GraphProto.sparse_initializer
            raise ValueError("it contains sparse constants")


def _check_node(node: memoryview | int, operators: frozenset[str] | None) -> None:
    operator, domain = text_of(node, 4), text_of(node, 7)  # NodeProto.op_type and .domain
    if domain not in STANDARD_DOMAINS:
        raise ValueError(f"it uses the operator {operator!r:.40} of {domain!r:.40}, which is not standard")
    if operators is not None and operator not in operators:
        raise ValueError(f"it uses the operator {operator!r:.40}, which it does not need")
    for number, attribute in message_fields(node):
        if number != 5:  # NodeProto.attribute
            continue
        for kind, value in message_fields(attribute):
            if kind in (6, 11):  # AttributeProto.g, .graphs
                raise ValueError(f"its node {operator!r:.40} contains a graph of its own")
            if kind in (10, 22, 23):  # AttributeProto.tensors, .sparse_tensor, .sparse_tensors
                raise ValueError(f"its node {operator!r:.40} contains lists of constants")
            if kind == 5:  # AttributeProto.t
                constant_of(value)


class Constant(NamedTuple):
    """A tensor in a graph's own bytes. kind: its TensorProto.DataType. data: not copied."""

    kind: int
    shape: tuple[int, ...]
    data: memoryview


def constant_of(tensor: memoryview | int) -> Constant:
    """A TensorProto; ValueError unless it is stored as plain bytes, at the length that its shape requires."""
    shape: list[int] = []
    kind, data, typed = 0, memoryview(b""), False
    for number, value in message_fields(tensor):
        if number == 13 or (number == 14 and value):  # TensorProto.external_data; .data_location, 1 is EXTERNAL
            raise ValueError("it refers to other files on this machine")
        if number == 1:  # TensorProto.dims
            shape += integers_of(value)
        elif number == 2:  # TensorProto.data_type
            kind = value
        elif number == 9:  # TensorProto.raw_data
            data = _message(value)
        elif number in (4, 5, 6, 7, 10, 11):  # float_data, int32_data and so on: numbers one by one
            typed = True
    if typed or not isinstance(kind, int) or kind not in TYPE_BYTES:
        raise ValueError(f"it contains a constant of type {kind} that is not stored as plain bytes")
    if any(length < 0 for length in shape) or math.prod(shape) * TYPE_BYTES[kind] != len(data):
        raise ValueError(f"a constant of shape {shape} and type {kind} has {len(data)} bytes")
    return Constant(kind, tuple(shape), data)


def message_fields(message: memoryview | int) -> Iterator[tuple[int, memoryview | int]]:
    """(field number, value) of a protobuf message, in order: an int for a varint, else the bytes, not copied."""
    message = _message(message)
    position, end = 0, len(message)
    while position < end:
        key, position = _varint(message, position)
        number, wire = key >> 3, key & 7  # protobuf's tag: field number, wire type in the last three bits
        if not 0 < number < 1 << 29:
            raise ValueError(f"it is damaged: field number {number}")
        if wire == VARINT:
            value, position = _varint(message, position)
            yield number, value
            continue
        if wire == BYTES:
            length, position = _varint(message, position)
        elif wire in (FIXED_64, FIXED_32):
            length = 8 if wire == FIXED_64 else 4
        else:
            raise ValueError(f"it is damaged: wire type {wire}")
        if length > end - position:
            raise ValueError(f"it is damaged: a field of {length} bytes where {end - position} are left")
        yield number, message[position : position + length]
        position += length


def _varint(data: memoryview, position: int) -> tuple[int, int]:
    """Base-128 varint at a position, least significant group first, and the position after it."""
    if position < len(data) and data[position] < 0x80:  # nearly all are one byte
        return data[position], position + 1
    value = 0
    for shift in range(0, 70, 7):  # ten groups of seven bits hold 64
        if position >= len(data):
            break
        byte = data[position]
        position += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value & (1 << 64) - 1, position
    raise ValueError("it is damaged: a number never ends")


def _message(value: memoryview | int) -> memoryview:
    if isinstance(value, int):
        raise ValueError("it is damaged: a number stands where a message should")
    return value


def text_of(message: memoryview | int, number: int) -> str:
    """A message's field of this number as text, "" if absent; if repeated, the last one, as in protobuf."""
    fields = [value for found, value in message_fields(message) if found == number]
    return bytes(_message(fields[-1])).decode("utf-8", "replace") if fields else ""


def integers_of(value: memoryview | int) -> list[int]:
    """A repeated int64, which may be stored one by one or packed."""
    if isinstance(value, int):
        return [_signed(value)]
    numbers, position = [], 0
    while position < len(value):
        number, position = _varint(value, position)
        numbers.append(_signed(number))
    return numbers


def _signed(value: int) -> int:
    """protobuf writes a negative int64 as its two's complement of 64 bits."""
    return value - (1 << 64) if value >> 63 else value
