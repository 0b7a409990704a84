"""What may be wrong with a file: random damage, and lies that only someone who knows the format would tell.

``changed`` picks by the file's name. Every choice is drawn from the ``random.Random`` that is passed, so a seed gives
the same file again.
"""

from __future__ import annotations

import hashlib
import io
import json
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from copy import deepcopy
from functools import lru_cache
from pathlib import PurePath
from random import Random
from typing import Any

import numpy as np

from og_pointcloud.formats.npy import npy_bytes

__all__ = ["changed", "mended", "packed", "unpacked"]

Change = Callable[[Random, bytes], bytes]

NUMBERS = (
    0, 1, 2, 3, 4, 7, 127, 128, 255, 256, 32767, 65535, 2**31 - 1, 2**31, 2**32 - 1, 2**32, 10**12, 2**63 - 1, 2**63,
    2**64 - 1,
)  # fmt: skip
"""At the ends of the integer types, and a trillion."""
WORDS = (
    "", "0", "-1", "1e12", "1000000000000", "9" * 25, "1e400", "nan", "-inf", "0x10", "1_000", "\u0663", "\u00bd",
    "1.5", "..", "../../etc/passwd", "/etc/passwd", "a/b", "\x00", "\x1b[31m", "x" * 5000, "#", ",", '"', "list",
    "float", "double", "uchar", "int", "ascii", "binary", "vertex", "chunk", "CAMERA", "OPENCV",
)  # fmt: skip
VALUES: tuple[Any, ...] = (
    None, True, False, -1, 0, 1, 3, 256, 2**31, 2**63, 10**30, 0.5, 1e308, float("nan"), float("inf"), "", "x", "..",
    "../../etc/passwd", "\x1b[2J\r\n", "\ud800", "y" * 3000, [], {}, [[]], [None], {"a": {}}, [1, 2, 3], "BPE", "Split",
)  # fmt: skip
NAMES = ("../escape.npy", "/etc/passwd", "a/../b", "C:\\x", "a//b", "x\x07y", "\x1b[31m", "manifest.json", "z" * 300)
SHAPES = (
    "(1000000000000,)", "(-1,)", "(0,)", "()", "(3, 0)", "(4294967296, 4294967296)", "(2, 3", "[2, 3]", "(True, 3)",
    "(1.5,)", "('a',)", "None", "(" * 2000, "(" + "1, " * 40 + ")", "(9999999999999999999999,)", "(1,) * 9",
)  # fmt: skip
TYPES = (
    "|O", "<f8", ">f4", "<i8", "|b1", "|V8", "|V0", "<U4", "|S0", "<M8[s]", "<c16", "<f2", "|u1", "garbage", "<f4,<f4",
    "(1000000,)<f4", "<U100000000",
)  # fmt: skip
OPERATORS = (
    "Loop", "If", "Scan", "ConstantOfShape", "Expand", "Tile", "Range", "RandomNormal", "Resize", "Gather", "Concat",
    "SequenceInsert", "QLinearConv", "Pow", "Reshape", "NonZero", "MemcpyToHost", "\x1b[31m", "",
)  # fmt: skip
MOST_MEMBERS = 300
BOMB_BYTES = 1 << 22


def changed(random: Random, name: str, data: bytes) -> bytes:
    """The content of the file called ``name`` after one to three changes that suit its format."""
    suit = BY_SUFFIX.get(PurePath(name).suffix, change_bytes)
    for _ in range(random.choice((1, 1, 1, 2, 3))):
        data = (suit if random.random() < 0.8 else change_bytes)(random, data)
    return data


# Any file


def change_bytes(random: Random, data: bytes) -> bytes:
    """Bits flipped, bytes set, a number written, cut short; a span lost, repeated or copied; or noise put in."""
    if not data:
        return random.randbytes(random.randrange(64))
    edit, at = bytearray(data), random.randrange(len(data))
    span = slice(at, at + random.randint(1, random.choice((1, 4, 16, 256, 4096))))
    kind = random.randrange(8)
    if kind == 0:
        for _ in range(random.choice((1, 1, 2, 16))):
            edit[random.randrange(len(edit))] ^= 1 << random.randrange(8)
    elif kind == 1:
        edit[span] = bytes([random.choice((0, 1, 9, 10, 32, 127, 128, 255))]) * len(edit[span])
    elif kind == 2:
        edit[at : at + 8] = _number(random)[: len(edit) - at]
    elif kind == 3:
        del edit[at:]
    elif kind == 4:
        del edit[span]
    elif kind == 5:
        edit[at:at] = edit[span] * random.choice((1, 2, 50))
    elif kind == 6:
        to = random.randrange(len(edit))
        edit[to:to] = edit[span]
    else:
        edit[at:at] = random.randbytes(random.choice((1, 8, 100)))
    return bytes(edit)


def _number(random: Random) -> bytes:
    """An extreme number as 1, 2, 4 or 8 bytes, either byte order."""
    size = random.choice((1, 2, 4, 8))
    number = random.choice(NUMBERS) % (1 << 8 * size)
    return number.to_bytes(size, random.choice(("little", "little", "big")))


# Text, and files that begin with text


def change_text(random: Random, data: bytes) -> bytes:
    """One word, or one line, is another, gone, or there twice. Bytes that are no text stay as they are."""
    lines = data.decode("latin-1").split("\n")
    at = random.randrange(len(lines))
    kind = random.randrange(8)
    if kind < 4:
        words = re.split(r"(\s+)", lines[at])
        words[random.randrange(len(words))] = random.choice((random.choice(WORDS), random.choice(words)))
        lines[at] = "".join(words)
    elif kind == 4:
        del lines[at]
    elif kind == 5:
        lines[at:at] = [lines[at]] * random.choice((1, 1, 100))
    elif kind == 6:
        other = random.randrange(len(lines))
        lines[at], lines[other] = lines[other], lines[at]
    else:
        lines.insert(at, " ".join(random.choice(WORDS) for _ in range(random.randrange(1, 9))))
    return "\n".join(lines).encode("utf-8", "replace") if random.random() < 0.2 else _latin(lines)


def _latin(lines: list[str]) -> bytes:
    return "\n".join(lines).encode("latin-1", "replace")


def change_headed(random: Random, data: bytes) -> bytes:
    """A header of text lines before binary data, as PLY and PCD have: mostly the header is changed."""
    end = re.search(rb"\n(end_header|DATA [a-z_]+)\r?\n", data)
    if end is None or random.random() < 0.35:
        return change_bytes(random, data)
    return change_text(random, data[: end.end()]) + data[end.end() :]


# JSON


def change_json(random: Random, data: bytes) -> bytes:
    """A value anywhere in it is another, gone, or deeply nested."""
    try:
        content = json.loads(data)
    except (ValueError, RecursionError):
        return change_bytes(random, data)
    if random.random() < 0.02:
        return b"[" * 100_000
    places = list(_places(content))
    if not places:
        return json.dumps(random.choice(VALUES)).encode()
    holder, key = random.choice(places)
    if random.random() < 0.15:
        del holder[key]
    elif random.random() < 0.1:
        holder[key] = [[holder[key]]]
    else:
        holder[key] = deepcopy(random.choice(VALUES))  # a later change may reach into it
    return json.dumps(content).encode()


def _places(content: Any) -> list[tuple[Any, Any]]:
    """(container, key) of every value; of long containers the first few."""
    found: list[tuple[Any, Any]] = []
    waiting = [content] if isinstance(content, (dict, list)) else []
    while waiting:
        holder = waiting.pop()
        keys = list(holder)[:40] if isinstance(holder, dict) else range(min(len(holder), 40))
        for key in keys:
            found.append((holder, key))
            if isinstance(holder[key], (dict, list)):
                waiting.append(holder[key])
    return found


# .npy


def change_npy(random: Random, data: bytes) -> bytes:
    """Another shape, type, order, version or length of the header, or damaged data behind it."""
    match = re.match(rb"\x93NUMPY(.)\x00(..)(\{[^\n]*\n)", data, re.DOTALL)
    if match is None or random.random() < 0.3:
        return change_bytes(random, data)
    version, header, body = match[1], match[3].decode("latin-1"), data[match.end() :]
    kind = random.randrange(6)
    if kind < 2:
        header = re.sub(r"'shape': \([^)]*\)", lambda _: f"'shape': {random.choice(SHAPES)}", header)
    elif kind == 2:
        header = re.sub(r"'descr': '[^']*'", lambda _: f"'descr': {random.choice(TYPES)!r}", header)
    elif kind == 3:
        header = header.replace("False", random.choice(("True", "1", "None", "'x'")))
    elif kind == 4:
        version = bytes([random.choice((0, 2, 3, 9))])
    else:
        header = change_text(random, header.encode()).decode("latin-1")
    text = header.encode("latin-1", "replace")
    length = random.choice((len(text),) * 6 + (0, 1, 65535))
    size = struct.pack("<H", length % 65536) if version == b"\x01" else struct.pack("<I", length)
    return b"\x93NUMPY" + version + b"\0" + size + text + body


# PNG


def change_png(random: Random, data: bytes) -> bytes:
    """Another size or pixel type, with the checksum that a decoder asks for."""
    if len(data) < 33 or random.random() < 0.4:
        return change_bytes(random, data)
    head = bytearray(data[12:29])
    field = random.randrange(7)
    if field < 2:
        head[4 + 4 * field : 8 + 4 * field] = struct.pack(">I", random.choice((0, 1, 47, 20_000, 2**31 - 1, 2**32 - 1)))
    else:
        head[10 + field] = random.choice((0, 1, 2, 3, 4, 6, 8, 16, 255))
    return data[:12] + bytes(head) + struct.pack(">I", zlib.crc32(head)) + data[33:]


# Archives


def unpacked(data: bytes) -> dict[str, bytes]:
    """The members of a zip by name; empty for what is none."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            return {info.filename: archive.read(info) for info in archive.infolist() if info.file_size <= BOMB_BYTES}
    except Exception:  # whatever a damaged one raises
        return {}


def packed(members: dict[str, bytes], compression: int = zipfile.ZIP_STORED, twice: str | None = None) -> bytes:
    """A zip of these members; ``twice`` names one that is written again under its name."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", compresslevel=1) as archive:
        for name, data in members.items():
            archive.writestr(zipfile.ZipInfo(name), data, compression, compresslevel=1)
        if twice is not None:
            info = zipfile.ZipInfo("same")
            archive.writestr(info, members[twice])
            info.filename = info.orig_filename = twice
    return stream.getvalue()


def mended(files: dict[str, bytes], before: dict[str, bytes]) -> dict[str, bytes]:
    """The files with lengths, checksums and offsets in their manifest.json corrected: damage that no checksum shows."""
    try:
        manifest = json.loads(files["manifest.json"])
        listed = manifest["files" if "files" in manifest else "members"]
        for name in {*listed, *files} - {"manifest.json"}:
            if name not in files:
                del listed[name]
                continue
            sums = {"crc32": zlib.crc32(files[name]), "sha256": hashlib.sha256(files[name]).hexdigest()}
            listed[name] = {**listed.get(name, {}), "bytes": len(files[name]), **sums}
        if place := manifest.get("descriptors"):
            start, length = place["offset"], 4 * place["shape"][0] * place["shape"][1]
            place["offset"] = files["query.onnx"].find(before["query.onnx"][start : start + length])
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, RecursionError):
        return files  # the manifest itself is what was changed
    return {**files, "manifest.json": json.dumps(manifest).encode()}


def change_zip(random: Random, data: bytes) -> bytes:
    """A member changed as suits it, mostly with its checksums made right again, or a lie of the archive itself."""
    members = unpacked(data)
    if not members:
        return change_bytes(random, data)
    name = random.choice(list(members))
    kind = random.randrange(12)
    if kind < 6:
        after = {**members, name: changed(random, name, members[name])}
        return packed(mended(after, members) if random.random() < 0.8 else after)
    if kind == 6:
        return packed(members, twice=name)
    if kind == 7:
        return packed(members, zipfile.ZIP_DEFLATED)
    if kind == 8:
        content = members.pop(name) if random.random() < 0.5 else members[name]
        return packed({**members, random.choice(NAMES): content})
    if kind == 9:
        return packed({**members, name: _bomb()}, zipfile.ZIP_DEFLATED)
    if kind == 10 and random.random() < 0.2:
        return packed({**members, **{f"extra{number}": b"" for number in range(MOST_MEMBERS)}})
    return _lying_directory(random, data)


@lru_cache
def _bomb() -> bytes:
    """An honest array of zeros, a hundredth of its size once compressed."""
    return npy_bytes(np.zeros(BOMB_BYTES // 4 - 64, np.float32))


def _lying_directory(random: Random, data: bytes) -> bytes:
    """A number in an entry of the directory, in a member's own header, or in the archive's end, is another."""
    mark, fields = random.choice(
        (
            (b"PK\x01\x02", ((8, 2), (10, 2), (16, 4), (20, 4), (24, 4), (28, 2), (30, 2), (38, 4), (42, 4))),
            (b"PK\x03\x04", ((6, 2), (8, 2), (14, 4), (18, 4), (22, 4), (26, 2), (28, 2))),
            (b"PK\x05\x06", ((4, 2), (8, 2), (10, 2), (12, 4), (16, 4), (20, 2))),
        )
    )
    starts = [match.start() for match in re.finditer(re.escape(mark), data)]
    if not starts:
        return change_bytes(random, data)
    at, size = random.choice(fields)
    at += random.choice(starts)
    held = int.from_bytes(data[at : at + size], "little")
    number = random.choice((*NUMBERS, held + 1, held - 1, 8, 12, 14)) % (1 << 8 * size)
    return data[:at] + number.to_bytes(size, "little") + data[at + size :]


# Graphs


def change_onnx(random: Random, data: bytes) -> bytes:
    """A graph that does something else: foreign operators, loops, other files' contents, huge or lying constants."""
    import onnx

    if random.random() < 0.2:
        return change_bytes(random, data)
    try:
        model = onnx.load_from_string(data)
        random.choice(GRAPH_CHANGES)(random, model)
        return model.SerializeToString()
    except Exception:  # damaged by an earlier change, or no longer to be written
        return change_bytes(random, data)


def _change_node(random: Random, model: Any) -> None:
    node = random.choice(model.graph.node)
    kind = random.randrange(6)
    if kind == 0:
        node.domain = random.choice(("com.microsoft", "evil", "ai.onnx.ml", "\x1b[31m"))
    elif kind == 1:
        node.op_type = random.choice(OPERATORS)
    elif kind == 2 and node.input:
        node.input[random.randrange(len(node.input))] = random.choice(model.graph.node).output[0]
    elif kind == 3:
        model.graph.node.remove(node)
    elif kind == 4:
        model.graph.node.add().MergeFromString(node.SerializeToString())
    else:
        attribute = node.attribute.add(name=random.choice(("axis", "to", "body", "then_branch", "value", "keepdims")))
        attribute.i, attribute.type = random.choice(NUMBERS) % 2**63, attribute.INT


def _nest_graph(random: Random, model: Any) -> None:
    attribute = random.choice(model.graph.node).attribute.add(name="body")
    attribute.type = attribute.GRAPH
    if random.random() < 0.5:
        attribute.g.MergeFromString(model.graph.SerializeToString())  # a message must not be copied into itself
    else:
        attribute.g.node.add(op_type="Loop")


def _change_constant(random: Random, model: Any) -> None:
    constant = random.choice(model.graph.initializer)
    kind = random.randrange(6)
    if kind == 0:
        constant.data_location = constant.EXTERNAL
        constant.external_data.add(key="location", value=random.choice(("/etc/passwd", "../x", "x" * 500)))
    elif kind == 1:
        constant.dims.append(random.choice(NUMBERS) % 2**63)
    elif kind == 2:
        constant.data_type = random.choice((0, 1, 6, 7, 8, 10, 11, 14, 99))
    elif kind == 3:
        constant.float_data.extend([1.0] * random.randrange(4))
    elif kind == 4 and constant.data_type == constant.INT64 and constant.raw_data:
        held = np.frombuffer(constant.raw_data, "<i8").copy()
        held[random.randrange(len(held))] = random.choice((-1, 0, 1, 5, 10**6, 10**12, 2**62))
        constant.raw_data = held.tobytes()
    else:
        constant.raw_data = change_bytes(random, constant.raw_data)


def _change_interface(random: Random, model: Any) -> None:
    value = random.choice((*model.graph.input, *model.graph.output))
    kind, tensor = random.randrange(5), value.type.tensor_type
    if kind == 0:
        value.name = random.choice(("points", "text", "label", "other", ""))
    elif kind == 1:
        tensor.elem_type = random.choice((0, 1, 6, 7, 8, 9, 11))
    elif kind == 2 and tensor.shape.dim:
        tensor.shape.dim[-1].dim_param = "D"
    elif kind == 3 and tensor.shape.dim:
        tensor.shape.dim[-1].dim_value = random.choice((0, 1, 5, 10**12, -1))
    elif tensor.shape.dim:
        del tensor.shape.dim[-1]


def _change_model(random: Random, model: Any) -> None:
    kind = random.randrange(5)
    if kind == 0:
        model.functions.add(name="f", domain="")
    elif kind == 1:
        model.opset_import.add(domain=random.choice(("evil", "com.microsoft", "")), version=random.choice((0, 1, 99)))
    elif kind == 2:
        model.graph.sparse_initializer.add().dims.append(10**12)
    elif kind == 3:
        model.metadata_props.add(key="k", value="v" * 10_000)
    else:
        model.ir_version = random.choice((0, 1, 3, 99, 2**40))


GRAPH_CHANGES = (
    _change_node, _change_node, _change_node, _nest_graph, _change_constant, _change_constant, _change_constant,
    _change_interface, _change_model,
)  # fmt: skip
BY_SUFFIX: dict[str, Change] = {
    ".txt": change_text, ".ply": change_headed, ".pcd": change_headed, ".json": change_json, ".npy": change_npy,
    ".png": change_png, ".npz": change_zip, ".ogpc": change_zip, ".onnx": change_onnx,
}  # fmt: skip
