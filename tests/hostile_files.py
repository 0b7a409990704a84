"""Files as a stranger with bad intent writes them, by hand and small: tests of trust and fuzzing start from them."""

from __future__ import annotations

import base64
import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper
from text_models import encoder_files

from og_pointcloud.formats.npy import npy_bytes


def members_of(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {info.filename: archive.read(info) for info in archive.infolist()}


def zip_of(path: Path, members: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, data in members.items():
            archive.writestr(zipfile.ZipInfo(name), data, compression)
    return path


Change = Callable[[dict, dict[str, bytes]], Any]


def changed(source: Path, path: Path, change: Change) -> Path:
    """A .ogpc in which change(manifest, members) was made; its manifest says how long all members are now."""
    members = members_of(source)
    manifest = json.loads(members.pop("manifest.json"))
    change(manifest, members)
    for name, data in members.items() if isinstance(manifest["members"], dict) else ():
        manifest["members"].setdefault(name, {})["bytes"] = len(data)
    return zip_of(path, {"manifest.json": json.dumps(manifest).encode(), **members})


def drop(name: str) -> Change:
    return lambda manifest, members: (members.pop(name), manifest["members"].pop(name))


def forged(source: Path, path: Path, changes: dict[str, bytes], edit: Callable[[dict], Any] = lambda _: None) -> Path:
    """A .ogpc with some members replaced or added, and an edited manifest that declares them."""
    return changed(source, path, lambda manifest, members: (members.update(changes), edit(manifest)))


# Graphs of a .ogpc: each takes the graph of an onnx model and changes it ----------------------------------------------


def constant(graph: Any, name: str, value: Any) -> str:
    graph.initializer.append(numpy_helper.from_array(np.asarray(value), name))
    return name


def node(graph: Any, operator: str, *inputs: str, **attributes: Any) -> str:
    name = f"evil_{len(graph.node)}"
    graph.node.append(helper.make_node(operator, list(inputs), [name], **attributes))
    return name


def added_to_answer(graph: Any, value: str) -> None:
    """Make the answer depend on 0 x value, so that no runtime leaves it out."""
    for one in graph.node:
        for names in (one.input, one.output):
            for place, name in enumerate(names):
                if name == "instance":
                    names[place] = "instance_true"
    top = node(graph, "ReduceMax", value, keepdims=0)
    zero = node(graph, "Cast", node(graph, "Mul", top, constant(graph, "nothing", np.float32(0))), to=TensorProto.INT32)
    graph.node.append(helper.make_node("Add", ["instance_true", zero], ["instance"]))


def fills_memory_on_opening(graph: Any) -> None:
    size = constant(graph, "size", np.array([3 << 28], np.int64))
    added_to_answer(graph, node(graph, "Expand", constant(graph, "one", np.float32(1)), size))


def fills_memory_when_asked(graph: Any) -> None:
    size = constant(graph, "size", np.array([3 << 28], np.int64))
    asked = node(graph, "Cast", node(graph, "Shape", "points"), to=TensorProto.FLOAT)
    added_to_answer(graph, node(graph, "Expand", node(graph, "ReduceMax", asked), size))


def computes_for_long(graph: Any) -> None:
    square = node(
        graph, "Expand", constant(graph, "v", np.float32(1e-4)), constant(graph, "n", np.array([1536, 1536], np.int64))
    )
    product = square
    for _ in range(200):
        product = node(graph, "MatMul", product, square)
    added_to_answer(graph, product)


def _set_number(graph: Any, operator: str, place: int, value: Any, which: int = 0) -> None:
    """Another value for the number that the which-th such node takes there."""
    name = [one for one in graph.node if one.op_type == operator][which].input[place]
    (old,) = [number for number in graph.initializer if number.name == name]
    old.CopyFrom(numpy_helper.from_array(np.asarray(value), name))


def divides_by_zero(graph: Any) -> None:
    """A whole number divided by 0 ends the process."""
    divides = [one for one in graph.node if one.op_type == "Div"]
    types = {number.name: number.data_type for number in graph.initializer}
    which = next(k for k, one in enumerate(divides) if types.get(one.input[1]) == TensorProto.INT32)
    _set_number(graph, "Div", 1, np.int32(0), which)


def counts_more_codes(graph: Any) -> None:
    _set_number(graph, "Concat", 0, np.array([1 << 31], np.int64))


def widens_columns(graph: Any) -> None:
    concats = [one for one in graph.node if one.op_type == "Concat"]
    names = {number.name for number in graph.initializer}
    which = [k for k, one in enumerate(concats) if one.input[0] in names and one.input[0] != "unknown_column"][1]
    _set_number(graph, "Concat", 0, np.array([1 << 20], np.int64), which)


def names_another_output(graph: Any) -> None:
    graph.output[2].name = "instance_true"


def carries_a_stranger(graph: Any) -> None:
    graph.value_info.add(name="stranger")


UNKNOWN_GRAPHS = (
    fills_memory_on_opening, fills_memory_when_asked, computes_for_long, divides_by_zero, counts_more_codes,
    widens_columns, names_another_output, carries_a_stranger,
)  # fmt: skip


def with_graph(source: Path, path: Path, change: Callable[[Any], None]) -> Path:
    """A .ogpc whose graph was changed, and whose manifest says where its descriptors are."""
    members = members_of(source)
    manifest = json.loads(members["manifest.json"])
    shape, offset = manifest["descriptors"]["shape"], manifest["descriptors"]["offset"]
    descriptors = members["query.onnx"][offset : offset + 4 * shape[0] * shape[1]]
    model = onnx.load_model_from_string(members["query.onnx"])
    change(model.graph)
    graph = model.SerializeToString()
    return forged(
        source, path, {"query.onnx": graph}, lambda m: m["descriptors"].update(offset=graph.index(descriptors))
    )


def answers_other_ids(graph: Any) -> None:
    """The same nodes; of the tables one, in which every id of an instance is that of the next."""
    (table,) = [table for table in graph.initializer if table.name == "value_instance"]
    ids = numpy_helper.to_array(table)
    table.CopyFrom(numpy_helper.from_array(np.where(ids >= 0, (ids + 1) % (ids.max() + 1), ids), "value_instance"))


# Text encoders --------------------------------------------------------------------------------------------------------


def encoder_with(
    tokenizer: dict | None = None,
    change: Callable[[dict], Any] = lambda _: None,
    graph: bytes = b"",
    bank: bytes = b"",
    **manifest: Any,
) -> dict[str, bytes]:
    """The files of an encoder with another tokenizer.json, graph or word bank, other entries of its manifest, and a
    change of the manifest after its checksums were put right."""
    files = encoder_files(tokenizer=tokenizer)
    files |= {name: data for name, data in (("text_encoder.onnx", graph), ("word_bank.npy", bank)) if data}
    about = json.loads(files.pop("manifest.json")) | manifest
    about["files"] = {name: {"bytes": len(data), "crc32": zlib.crc32(data)} for name, data in files.items()}
    change(about)
    return {"manifest.json": json.dumps(about).encode(), **files}


def tokenizer_with(**parts: Any) -> dict:
    pieces = [["<unk>", 0.0], *([letter, -1.0] for letter in "abc")]
    return {"version": "1.0", "added_tokens": [], "normalizer": None, "pre_tokenizer": None, "post_processor": None,
            "decoder": None, "model": {"type": "Unigram", "unk_id": 0, "vocab": pieces}} | parts  # fmt: skip


def replacing_text(found: str, content: str, times: int) -> dict:
    step = {"type": "Replace", "pattern": {"String": found}, "content": content}
    return tokenizer_with(normalizer={"type": "Sequence", "normalizers": [step] * times})


def charsmap(longest: int) -> dict:
    table = struct.pack("<I", 4) + bytes(4) + b"x" * longest + b"\0"
    return tokenizer_with(normalizer={"type": "Precompiled", "precompiled_charsmap": base64.b64encode(table).decode()})


UNBOUNDED_TOKENIZERS = {
    "doubles the text 40 times": (replacing_text("a", "aa", 40), "1.1e+12 times as long"),
    "puts a letter between any two 40 times": (replacing_text("", "a", 40), "1.1e+12 times as long"),
    "spells bytes of bytes of bytes": (
        tokenizer_with(
            pre_tokenizer={
                "type": "Sequence",
                "pretokenizers": [{"type": "ByteLevel", "add_prefix_space": False, "trim_offsets": True}] * 40,
            }
        ),
        "1.21e+24 times as long",
    ),
    "ends each text with a million tokens": (
        tokenizer_with(
            post_processor={
                "type": "TemplateProcessing",
                "pair": [],
                "single": [{"SpecialToken": {"id": "a", "type_id": 0}}] * 1000,
                "special_tokens": {"a": {"id": "a", "ids": [1] * 1000, "tokens": ["a"] * 1000}},
            }
        ),
        "characters of post-processing",
    ),
    "has a long replacement": (charsmap(5000), "5e+03 times as long"),
    "has a long piece": (
        tokenizer_with(model={"type": "Unigram", "unk_id": 0, "vocab": [["<unk>", 0.0], ["a" * 30_000, -1.0]]}),
        "a piece of 30000 characters",
    ),
}


def encoder_graph(width: int, *steps: str) -> bytes:
    """text = of an outer product of 32,768 rows with as many columns, or of products without end."""
    size = 32_768 if "outer" in steps else 1024
    column = np.ones((size, 1), np.float32)
    graph = helper.make_graph(
        [], "text", [helper.make_tensor_value_info("tokens", TensorProto.INT64, ["B", "T"])],
        [helper.make_tensor_value_info("text", TensorProto.FLOAT, ["B", width])],
    )  # fmt: skip
    tokens = node(graph, "Cast", "tokens", to=TensorProto.FLOAT)
    scaled = node(graph, "Mul", constant(graph, "column", column), node(graph, "ReduceL2", tokens, keepdims=0))
    product = first = node(graph, "MatMul", scaled, constant(graph, "row", column.T))
    for _ in range(3000 if "long" in steps else 0):
        product = node(graph, "MatMul", product, first)
    top = node(graph, "ReduceL2", product, keepdims=1)
    graph.node.append(helper.make_node("Mul", [top, constant(graph, "w", np.ones((1, width), np.float32))], ["text"]))
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    return model.SerializeToString()


# Captures and clouds --------------------------------------------------------------------------------------------------


def zeros_npz(count: int) -> bytes:
    stream = io.BytesIO()
    np.savez_compressed(stream, view0=np.zeros((count, 1), np.float32), feature_space=np.array("x"))
    return stream.getvalue()


def huge_image(kind: str, width: int = 60_000, height: int = 17_000) -> bytes:
    """The beginning of an image that says it is so large."""
    if kind == "jpg":
        application = b"\xff\xe1" + struct.pack(">H", 5000) + bytes(4998)
        return b"\xff\xd8" + application + b"\xff\xff\xc2" + struct.pack(">HBHHB", 17, 8, height, width, 3) + bytes(9)
    if kind == "bmp":
        return b"BM" + bytes(12) + struct.pack("<IiiHH", 40, width, -height, 1, 24) + bytes(24)
    if kind == "webp":
        sizes = (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little")
        return b"RIFF" + bytes(4) + b"WEBPVP8X" + struct.pack("<II", 10, 0) + sizes
    if kind == "tif":
        # Width, height, bits, no compression, black is 0, where the one strip is, rows in it, its bytes.
        tags = {256: width, 257: height, 258: 8, 259: 1, 262: 1, 273: 8, 278: height, 279: width}
        entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags.items())
        return b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + bytes(4)
    header = b"IHDR" + struct.pack(">II5B", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + header + struct.pack(">II", zlib.crc32(header), 9) + b"IDAT"


def transforms(**changes: Any) -> bytes:
    """One frame, one camera, and what is changed of it."""
    camera = {"fl_x": 70, "fl_y": 70, "cx": 24, "cy": 18, "w": 48, "h": 36}
    frame = {"file_path": "images/a.png", "transform_matrix": np.eye(4).tolist()}
    return json.dumps({**camera, "frames": [{**frame, **changes}]}).encode()


HUGE_NUMBER = int("9" * 400)
SEEDS: dict[str, list[bytes]] = {
    "array.npy": [npy_bytes(np.zeros((0, 1 << 40), np.float32))],
    "cloud.ply": [
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1\n"
        + b"".join(b"property uchar p%d\n" % k for k in range(2000)) + b"end_header\n" + bytes(2000),
        b"ply\nformat binary_little_endian 1.0\nelement face 9\nproperty list uchar int v\nelement vertex 1\n"
        b"property float x\nproperty float y\nproperty float z\nend_header\n" + bytes(48),
    ],
    "transforms.json": [
        transforms(transform_matrix=[[HUGE_NUMBER] * 4] * 4), transforms(file_path="i" * 300 + ".png"),
        transforms(file_path="../../../../etc/passwd"), b"\xef\xbb\xbf" + transforms(), transforms(fl_x=1e-300),
        transforms(file_path="images/\x1b]0;owned\x07.png", transform_matrix=[[float("nan")] * 4] * 4),
    ],
    "image.jpg": [huge_image(kind) for kind in ("jpg", "bmp", "webp", "tif", "png")],
    "words.npz": [zeros_npz(30_000_000)],
}  # fmt: skip
"""By the names of `test_fuzz.READERS`: hand-made files that fuzzing starts from, beside valid ones."""
