"""Every reader of the library, with small valid files of each layout that it reads, made on the spot."""

from __future__ import annotations

import io
import json
import struct
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from fuzz_changes import mended, packed, unpacked
from hard_cases.inputs import labelled_cloud, unit_rows, write_two_balls
from numpy.typing import NDArray

from og_pointcloud.ask.labelled_scene import LabelledScene
from og_pointcloud.bundle.read import QUERY_OPERATORS, read_bundle, read_carried_encoder
from og_pointcloud.bundle.vocabulary import read_words
from og_pointcloud.cloud import WordBank
from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.fitting.opengaussian import read_opengaussian
from og_pointcloud.formats import colmap, rgbd
from og_pointcloud.formats.capture import read_capture
from og_pointcloud.formats.gaussian_ply import gaussian_rows
from og_pointcloud.formats.images import read_rgb
from og_pointcloud.formats.langsplat import read_language_features
from og_pointcloud.formats.las import write_las
from og_pointcloud.formats.mask_files import MaskLayer, read_masks
from og_pointcloud.formats.nerfstudio import read_transforms
from og_pointcloud.formats.npy import array_from_npy, npy_bytes
from og_pointcloud.formats.points import read_points
from og_pointcloud.formats.poses import PosedFrames
from og_pointcloud.models import check_graph
from og_pointcloud.scene import Points
from og_pointcloud.text.encoder import TextEncoder, encoder_files
from og_pointcloud.text.text_features import read_text_features

__all__ = ["READERS", "Files", "Reader"]

Files = dict[str, bytes]
"""Content by path inside a folder."""

SIZE = (48, 36)
WIDTH = 8


@dataclass(frozen=True)
class Reader:
    """seeds: valid folders, all different. read: reads such a folder and all that is read later on demand, and asserts
    what the reader promises of its result. errors: what it may raise. whole: the folder's files belong to one archive,
    which is packed, with its manifest mended, after a file in it was changed.
    """

    name: str
    seeds: Callable[[], list[Files]]
    read: Callable[[Path], object]
    errors: tuple[type[Exception], ...] = (OgPointcloudError, FileNotFoundError)
    whole: bool = False


# Labelled scenes


def bundles() -> list[Files]:
    """A scene with colours, words and a word bank; and one that carries a text encoder."""
    from og_pointcloud_export import write_bundle

    cloud = labelled_cloud(count=60)
    rgb, bank = np.full((60, 3), 9, np.uint8), WordBank(unit_rows(64, 16, seed=3))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.ogpc"
        rich = write_bundle(replace(cloud, rgb=rgb, word_bank=bank), path).read_bytes()
        plain = unpacked(write_bundle(replace(cloud, vocabulary=None), path).read_bytes())
    carrying = {**plain, **{f"text_encoder/{name}": data for name, data in encoders()[0].items()}}
    return [{"scene.ogpc": rich}, {"scene.ogpc": packed(mended(carrying, plain))}]


def bundle_members() -> list[Files]:
    """The same files, unpacked."""
    return [unpacked(files["scene.ogpc"]) for files in bundles()]


def graphs() -> list[Files]:
    """The graphs alone."""
    return [{"query.onnx": members["query.onnx"]} for members in bundle_members()]


def _read_scene(folder: Path) -> None:
    path = folder / "scene.ogpc"
    cloud = read_bundle(path).cloud
    assert np.isfinite(cloud.xyz).all()
    assert cloud.instance_ids.max(initial=-1) < len(cloud.instances)
    if files := read_carried_encoder(path):
        TextEncoder(files, "text_encoder")


def _ask_scene(folder: Path) -> None:
    scene = LabelledScene(read_bundle(folder / "scene.ogpc", verify_sha256=True))
    points = np.concatenate([scene.xyz[:20], [[np.nan, 0, 0], [1e30, 0, 0]]])
    ids = scene.instances_at(points)
    assert ids.shape == (len(points),)
    assert ids.min() >= -3
    assert ids.max() < len(scene.cloud.instances)
    scene.instance_scores(np.zeros((2, scene.cloud.instances.descriptors.shape[1]), np.float32))
    scene.instances.to_json()


# Words


def encoders() -> list[Files]:
    """An encoder that looks a text's first token up, with CLIP's byte pairs, and with unigrams."""
    from og_pointcloud_export.text_tokenizer import clip_description
    from onnx import TensorProto, helper, numpy_helper

    pairs = clip_description([("a", "t</w>"), ("c", "at</w>"), ("l", "o"), ("lo", "w</w>")])
    unigrams = {
        "normalizer": {"type": "Sequence", "normalizers": [{"type": "NFKC"}, {"type": "Prepend", "prepend": "_"}]},
        "pre_tokenizer": {"type": "Metaspace", "replacement": "_", "prepend_scheme": "always", "split": True},
        "model": {"type": "Unigram", "unk_id": 0, "vocab": [["<unk>", 0.0], ["_cat", -1.0], ["_", -2.0], ["a", -2.5]]},
        "added_tokens": [{"id": 4, "content": "</s>", "normalized": False}],
        "post_processor": {
            "type": "TemplateProcessing",
            "single": [{"Sequence": {"id": "A"}}, {"SpecialToken": {"id": "</s>"}}],
            "special_tokens": {"</s>": {"ids": [4]}},
        },
    }
    nodes = [
        helper.make_node("Gather", ["rows", "tokens"], ["all"], axis=0),
        helper.make_node("Gather", ["all", "first"], ["text"], axis=1),
    ]
    tokens = helper.make_tensor_value_info("tokens", TensorProto.INT64, ["B", "T"])
    text = helper.make_tensor_value_info("text", TensorProto.FLOAT, ["B", WIDTH])
    constants = [
        numpy_helper.from_array(unit_rows(520, WIDTH), "rows"),
        numpy_helper.from_array(np.array(0, np.int64), "first"),
    ]
    model = helper.make_model(
        helper.make_graph(nodes, "encoder", [tokens], [text], constants),
        opset_imports=[helper.make_opsetid("", 18)],
        ir_version=9,
    )
    manifest = {
        "format": "og-text-encoder", "schema_version": 1, "feature_space": "fuzz", "width": WIDTH, "context_length": 8,
        "vocabulary": 520, "pad_id": None, "templates": ["{}"], "precision": "fp32", "files": {},
    }  # fmt: skip
    bank = npy_bytes(unit_rows(64, WIDTH).astype(np.float16))
    common = {"manifest.json": json.dumps(manifest).encode(), "text_encoder.onnx": model.SerializeToString()}
    return [
        mended({**common, "tokenizer.json": json.dumps(tokenizer).encode(), "word_bank.npy": bank}, {})
        for tokenizer in (pairs, unigrams)
    ]


def text_features() -> list[Files]:
    """Plain, and compressed in single characters."""
    names = np.array(["chair", "red mug", "café"])
    made = []
    for save, vectors in ((np.savez, unit_rows(3, WIDTH)), (np.savez_compressed, unit_rows(3, 2).astype(np.float16))):
        stream = io.BytesIO()
        save(stream, names=names, vectors=vectors, feature_space=np.array("fuzz"))
        made.append({"words.npz": stream.getvalue()})
    return made


def _encode(folder: Path) -> None:
    encoder = TextEncoder(encoder_files(folder), "encoder")
    vectors = encoder(["low cat", "", "x" * 40])
    assert vectors.shape == (3, encoder.width)
    assert np.isfinite(vectors).all()


def _read_words(folder: Path) -> None:
    assert all(word.strip() for word in read_words(folder / "words.txt"))


def _read_text_features(folder: Path) -> None:
    words, _ = read_text_features(folder / "words.npz")
    assert np.isfinite(words.vectors).all()


# Points


def plain_plys(encoding: str) -> list[Files]:
    """Positions, colours, normals and a mesh's faces; faces first, whose lists are in the way; doubles alone."""
    random = np.random.default_rng(0)
    columns = {name: random.normal(size=12).astype(np.float32) for name in ("x", "y", "z", "nx", "ny", "nz")}
    columns |= {name: random.integers(0, 256, 12).astype(np.uint8) for name in ("red", "green", "blue")}
    faces = [(3, 0, 1, 2), (4, 3, 4, 5, 6)]
    made = []
    for first in ("vertex", "face"):
        parts = {
            "vertex": _rows(columns, encoding),
            "face": _faces(faces, encoding, "uchar" if first == "vertex" else "int"),
        }
        order = [first, "face" if first == "vertex" else "vertex"]
        made.append(_ply(encoding, {name: parts[name] for name in order}))
    doubles = {name: 1e6 + random.normal(size=12) for name in ("x", "y", "z")}
    return [*made, _ply(encoding, {"vertex": _rows(doubles, encoding)})]


PLY_TYPE = {"f4": "float", "f8": "double", "u1": "uchar", "u4": "uint"}
Part = tuple[int, list[str], bytes]
"""An element's count, its properties' header lines, and its data."""


def _rows(columns: dict[str, NDArray], encoding: str) -> Part:
    lines = [f"property {PLY_TYPE[values.dtype.str[1:]]} {name}" for name, values in columns.items()]
    rows = list(zip(*columns.values(), strict=True))
    if encoding == "ascii":
        return len(rows), lines, "".join(" ".join(map(str, row)) + "\n" for row in rows).encode()
    order = ">" if encoding.endswith("big_endian") else "<"
    types = [(name, values.dtype.newbyteorder(order)) for name, values in columns.items()]
    return len(rows), lines, np.array(rows, types).tobytes()


def _faces(faces: list[tuple[int, ...]], encoding: str, length: str) -> Part:
    """faces: each the number of its corners, and these."""
    lines = [f"property list {length} int vertex_indices"]
    if encoding == "ascii":
        return len(faces), lines, "".join(" ".join(map(str, face)) + "\n" for face in faces).encode()
    order = ">" if encoding.endswith("big_endian") else "<"
    code = {"uchar": "B", "int": "i"}[length]
    data = b"".join(struct.pack(f"{order}{code}{len(face) - 1}i", *face) for face in faces)
    return len(faces), lines, data


def _ply(encoding: str, parts: dict[str, Part]) -> Files:
    header = ["ply", f"format {encoding} 1.0", "comment a cloud"]
    for name, (count, lines, _) in parts.items():
        header += [f"element {name} {count}", *lines]
    text = "\n".join([*header, "end_header", ""])
    return {"cloud.ply": text.encode() + b"".join(data for _, _, data in parts.values())}


def gaussian_plys(count: int = 12) -> list[Files]:
    """The trained layout."""
    xyz = np.random.default_rng(0).normal(size=(count, 3))
    scale, rotation = np.full((count, 3), 0.1, np.float32), np.tile(np.eye(4, dtype=np.float32)[0], (count, 1))
    opacity = np.linspace(0.2, 0.9, count).astype(np.float32)
    rows = gaussian_rows(Points.from_world(xyz, scale=scale, rotation=rotation, opacity=opacity))
    columns = {name: rows[name].astype(np.float32) for name in rows.dtype.names or ()}
    return [_ply("binary_little_endian", {"vertex": _rows(columns, "binary_little_endian")})]


def compressed_plys() -> list[Files]:
    """SuperSplat's layout, 300 splats in two chunks, with and without bounds of colours."""
    random = np.random.default_rng(0)
    packed_names = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
    vertex = {name: random.integers(0, 1 << 32, 300, dtype=np.uint32) for name in packed_names}
    made = []
    bounded = ("x", "y", "z", "scale_x", "scale_y", "scale_z")
    for names in (bounded, (*bounded, "r", "g", "b")):
        ends = (("min", -1), ("max", 1))
        chunk = {f"{end}_{name}": np.full(2, value, np.float32) for end, value in ends for name in names}
        encoding = "binary_little_endian"
        made.append(_ply(encoding, {"chunk": _rows(chunk, encoding), "vertex": _rows(vertex, encoding)}))
    return made


def pcds(encoding: str) -> list[Files]:
    """With packed colours, normals, padding and a field of three."""
    header = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z _ rgb normal_x normal_y normal_z ring\nSIZE 4 4 4 1 4 4 4 4 2\n"
        "TYPE F F F U F F F F U\nCOUNT 1 1 1 4 1 1 1 1 3\nWIDTH 12\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 12\n"
        f"DATA {encoding}\n"
    )
    columns = [_positions()[:, [axis]].astype("<f4") for axis in range(3)]
    columns += [np.zeros((12, 4), np.uint8), np.full((12, 1), 1000, np.uint32).view("<f4")]
    columns += [np.full((12, 1), 0.5, "<f4")] * 3 + [np.full((12, 3), 2, "<u2")]
    if encoding == "ascii":
        lines = (" ".join(str(value) for column in columns for value in column[row]) for row in range(12))
        return [{"cloud.pcd": header.encode() + "\n".join([*lines, ""]).encode()}]
    if encoding == "binary":
        rows = b"".join(column[row].tobytes() for row in range(12) for column in columns)
        return [{"cloud.pcd": header.encode() + rows}]
    data = b"".join(column.tobytes() for column in columns)
    squeezed = _lzf(data)
    return [{"cloud.pcd": header.encode() + struct.pack("<II", len(squeezed), len(data)) + squeezed}]


def _lzf(data: bytes) -> bytes:
    """Literals, and a run of four equal bytes or more as a copy that overlaps itself."""
    out, literals, at = bytearray(), bytearray(), 0
    while at < len(data):
        run = 1
        while run < 8 and data[at : at + run + 1] == data[at : at + 1] * (run + 1):
            run += 1
        literals.append(data[at])
        at += 1
        if run >= 4 or len(literals) == 32 or at == len(data):
            out += bytes([len(literals) - 1]) + literals
            literals.clear()
        if run >= 4:
            out += bytes([run - 1 - 2 << 5, 0])
            at += run - 1
    return bytes(out)


def las_files(suffix: str) -> list[Files]:
    """Labelled as the library writes it."""
    ids, score = np.arange(12, dtype=np.int32) % 3 - 1, np.linspace(0, 1, 12, dtype=np.float32)
    attributes = {"og_label": ids, "og_instance": ids, "og_score": score, "og_reason": np.zeros(12, np.uint8)}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"cloud{suffix}"
        write_las(path, _positions(), np.full((12, 3), 99, np.uint8), attributes, ("chair", "desk"))
        return [{path.name: path.read_bytes()}]


def _positions() -> NDArray[np.float64]:
    return np.random.default_rng(0).normal(size=(12, 3))


def _only(folder: Path) -> Path:
    return next(folder.iterdir(), folder / "missing")


def _read_points(folder: Path) -> None:
    points = read_points(_only(folder))
    assert np.isfinite(points.xyz).all()
    assert len(points) > 0
    for part in (points.scale, points.rotation, points.opacity, points.normals):
        assert part is None or (len(part) == len(points) and np.isfinite(part).all())


# Captures


def captures() -> list[Files]:
    """Two views of two balls: transforms.json, a cloud, masks and their features."""
    with tempfile.TemporaryDirectory() as folder:
        capture = Path(folder) / "capture"
        write_two_balls(capture, views=2, points=20)
        return [_files_of(capture)]


def _files_of(folder: Path) -> Files:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def masks() -> list[Files]:
    """Of the capture, what ``read_masks`` reads."""
    return [{name: data for name, data in captures()[0].items() if name.startswith("mask")}]


def transforms() -> list[Files]:
    """With the intrinsics at the top; in each frame, with a lens; as Blender writes it."""
    content = json.loads(captures()[0]["transforms.json"])
    frames = content.pop("frames")
    lens = {"camera_model": "OPENCV", "k1": 0.1, "p1": 0.01}
    layouts = (
        {**content, "applied_transform": np.eye(4)[:3].tolist(), "ply_file_path": "points.ply", "frames": frames},
        {"frames": [{**frame, **content, **lens} for frame in frames]},
        {"camera_angle_x": 0.9, "frames": [{**frame, "rotation": 0.1} for frame in frames]},
    )
    return [{"transforms.json": json.dumps(layout).encode()} for layout in layouts]


def language_features() -> list[Files]:
    """LangSplat's, of two views, ids as float32 and as int32."""
    ids = np.full((4, *SIZE[::-1]), -1)
    for level in range(4):
        ids[level, :18], ids[level, 18:30] = 2 * level, 2 * level + 1
    features = npy_bytes(unit_rows(8, WIDTH).astype(np.float16))
    made = []
    for kind in (np.float32, np.int32):
        files = {f"language_features/{name}_s.npy": npy_bytes(ids.astype(kind)) for name in ("a", "b")}
        made.append({**files, **{f"language_features/{name}_f.npy": features for name in ("a", "b")}})
    return made


def images() -> list[Files]:
    """A PNG and a JPEG."""
    import cv2

    pixels = np.random.default_rng(0).integers(0, 256, (*SIZE[::-1], 3)).astype(np.uint8)
    return [{f"image{suffix}": cv2.imencode(suffix, pixels)[1].tobytes()} for suffix in (".png", ".jpg")]


def colmap_models(suffix: str) -> list[Files]:
    """Two images, two lenses, points with tracks, a rig with two sensors and a frame."""
    lenses = {1: (1, (70.0, 72.0, 24.0, 18.0)), 2: (4, (70.0, 72.0, 24.0, 18.0, 0.1, 0.0, 0.0, 0.01))}
    pose = (1.0, 0.0, 0.0, 0.0, 0.1, 0.2, 0.3)
    write = _colmap_binary if suffix == "bin" else _colmap_text
    with_rig = {f"{stem}.{suffix}": data for stem, data in write(lenses, pose).items()}
    without = {name: data for name, data in with_rig.items() if not name.startswith(("rigs", "frames"))}
    return [without, with_rig]


Lenses = dict[int, tuple[int, tuple[float, ...]]]
"""Number of the camera model and its parameters, by camera id."""


def _colmap_binary(lenses: Lenses, pose: tuple[float, ...]) -> Files:
    cameras = struct.pack("<Q", len(lenses))
    for number, (model, values) in lenses.items():
        cameras += struct.pack(f"<IiQQ{len(values)}d", number, model, *SIZE, *values)
    seen = struct.pack("<Q", 2)
    for number in lenses:
        seen += struct.pack("<I7dI", number, *pose, number) + f"image_{number}.png\0".encode()
        seen += struct.pack("<Q", number) + struct.pack("<ddq", 1.5, 2.5, -1) * number
    points = struct.pack("<Q", 6)
    for number, xyz in enumerate(_positions()[:6]):
        points += struct.pack("<Q3d3BdQ", number, *xyz, 9, 8, 7, 0.5, number % 3) + bytes(8) * (number % 3)
    rigs = struct.pack("<QIIiIiIB7d", 1, 1, 2, 0, 1, 0, 2, 1, *pose)
    frames = struct.pack("<QII7dI", 1, 1, 1, *pose, 2) + struct.pack("<iIQiIQ", 0, 1, 1, 0, 2, 2)
    return {"cameras": cameras, "images": seen, "points3D": points, "rigs": rigs, "frames": frames}


def _colmap_text(lenses: Lenses, pose: tuple[float, ...]) -> Files:
    place = " ".join(map(str, pose))
    models = list(colmap.CAMERA_MODELS)
    cameras = [f"{n} {models[model]} {SIZE[0]} {SIZE[1]} {' '.join(map(str, v))}" for n, (model, v) in lenses.items()]
    seen = [f"{number} {place} {number} image_{number}.png\n1.5 2.5 -1 3.5 4.5 7" for number in lenses]
    points = [f"{number} {x} {y} {z} 9 8 7 0.5 1 0" for number, (x, y, z) in enumerate(_positions()[:6])]
    rigs, frames = [f"1 2 CAMERA 1 CAMERA 2 1 {place}"], [f"1 1 {place} 2 CAMERA 1 1 CAMERA 2 2"]
    parts = {"cameras": cameras, "images": seen, "points3D": points, "rigs": rigs, "frames": frames}
    return {stem: "\n".join(["# written by hand", *lines, ""]).encode() for stem, lines in parts.items()}


def rgbd_folders() -> dict[str, Files]:
    """Two frames as each RGB-D data set has them, by the data set's name."""
    import cv2

    def encoded(suffix: str, pixels: NDArray) -> bytes:
        return cv2.imencode(suffix, pixels)[1].tobytes()

    depth = np.linspace(500, 3000, SIZE[0] * SIZE[1]).reshape(SIZE[::-1])
    image, millimetres = np.full((*SIZE[::-1], 3), 99, np.uint8), encoded(".png", depth.astype(np.uint16))
    jpg, png = encoded(".jpg", image), encoded(".png", image)
    pose = b"1 0 0 0.1\n0 1 0 0.2\n0 0 1 0.3\n0 0 0 1\n"
    lens = b"40 0 24 0\n0 40 18 0\n0 0 1 0\n0 0 0 1\n"
    camera = {"w": SIZE[0], "h": SIZE[1], "fx": 40.0, "fy": 40.0, "cx": 23.5, "cy": 17.5, "scale": 1000.0}
    quaternions = [[0, 0, 0, 1, 0.1 * number, 0, 0] for number in range(2)]
    record = {"w": SIZE[0], "h": SIZE[1], "K": [40, 0, 0, 0, 40, 0, 24, 18, 1], "poses": quaternions}
    made: dict[str, Files] = {
        "ScanNet": {f"intrinsic/intrinsic_{sensor}.txt": lens for sensor in ("color", "depth")},
        "7-Scenes": {},
        "Replica": {
            "traj.txt": (pose.replace(b"\n", b" ") + b"\n") * 2,
            "cam_params.json": json.dumps({"camera": camera}).encode(),
        },
        "Record3D": {"metadata.json": json.dumps(record).encode()},
    }
    for n in range(2):
        made["ScanNet"] |= {f"color/{n}.jpg": jpg, f"depth/{n}.png": millimetres, f"pose/{n}.txt": pose}
        frame = f"frame-{n:06}"
        made["7-Scenes"] |= {f"{frame}.color.png": png, f"{frame}.depth.png": millimetres, f"{frame}.pose.txt": pose}
        made["Replica"] |= {f"results/frame{n:06}.jpg": jpg, f"results/depth{n:06}.png": millimetres}
        made["Record3D"] |= {f"rgb/{n}.jpg": jpg, f"depth/{n}.npy": npy_bytes(depth.astype(np.float32) / 1000)}
    return made


def opengaussian_results() -> list[Files]:
    """A .ply of 40 Gaussians and the four arrays of six leaves."""
    ply = gaussian_plys(40)[0]["cloud.ply"]
    stream = io.BytesIO()
    views, score = np.arange(1, 7), np.linspace(0, 1, 6)
    np.savez(stream, leaf_feat=unit_rows(6, WIDTH), leaf_score=score, occu_count=views, leaf_ind=np.arange(40) % 6)
    return [{"point_cloud.ply": ply, "cluster_lang.npz": stream.getvalue()}]


def _read_capture(folder: Path) -> None:
    scene = read_capture(folder)
    for view in scene.views:
        view.mask_map()
        view.image_rgb()


def _read_layers(layers: list[MaskLayer]) -> None:
    for layer in layers:
        ids = layer.read()
        assert ids.ndim == 2
        assert ids.min(initial=-1) >= -1


def _read_frames(frames: PosedFrames) -> None:
    for image in frames.images:
        if image.depth is not None:
            depth = image.depth.read().depth
            assert np.isfinite(depth).all()
            assert depth.min() >= 0


def _read_colmap(folder: Path) -> None:
    assert colmap.read_images(folder)
    xyz, rgb = colmap.read_points3d(folder)
    assert xyz.shape == rgb.shape == (len(xyz), 3)


def _arrays() -> list[Files]:
    made = (np.arange(12.0).reshape(3, 4), np.asfortranarray(np.ones((2, 3), np.int16)), np.array(["a", "bc"]))
    stream = io.BytesIO()
    np.save(stream, made[1])
    return [{"array.npy": npy_bytes(array)} for array in made] + [{"array.npy": stream.getvalue()}]


def _readers() -> Iterator[Reader]:
    yield Reader("scene file", bundles, _read_scene)
    yield Reader("scene file, its members", bundle_members, _read_scene, whole=True)
    yield Reader("scene file, asked", bundle_members, _ask_scene, whole=True)
    inside = (ValueError, FileNotFoundError)  # of what only other readers call
    yield Reader("graph", graphs, lambda at: check_graph((at / "query.onnx").read_bytes(), QUERY_OPERATORS), inside)
    yield Reader("array", _arrays, lambda at: array_from_npy((at / "array.npy").read_bytes()), inside)
    yield Reader("text encoder", encoders, _encode)
    yield Reader("text features", text_features, _read_text_features)
    yield Reader("words", lambda: [{"words.txt": "chair\nred mug\ncaf\u00e9\n".encode()}], _read_words)
    for encoding in ("ascii", "binary_little_endian", "binary_big_endian"):
        yield Reader(f"PLY, {encoding}", lambda encoding=encoding: plain_plys(encoding), _read_points)
    yield Reader("3DGS PLY", gaussian_plys, _read_points)
    yield Reader("compressed 3DGS PLY", compressed_plys, _read_points)
    for encoding in ("ascii", "binary", "binary_compressed"):
        yield Reader(f"PCD, {encoding}", lambda encoding=encoding: pcds(encoding), _read_points)
    for suffix in (".las", ".laz"):
        yield Reader(suffix[1:].upper(), lambda suffix=suffix: las_files(suffix), _read_points)
    for suffix in ("bin", "txt"):
        yield Reader(f"COLMAP, .{suffix}", lambda suffix=suffix: colmap_models(suffix), _read_colmap)
    yield Reader("transforms.json", transforms, lambda at: read_transforms(at / "transforms.json", lambda _: SIZE))
    yield Reader("masks", masks, lambda at: _read_layers(read_masks(at, ("view0", "view1"))[0]))
    yield Reader(
        "LangSplat", language_features, lambda at: _read_layers(read_language_features(at, ("a", "b"), "large")[0])
    )
    yield Reader("image", images, lambda at: read_rgb(_only(at), SIZE))
    for name, read in (
        ("ScanNet", rgbd.read_scannet),
        ("7-Scenes", rgbd.read_seven_scenes),
        ("Replica", rgbd.read_replica),
        ("Record3D", rgbd.read_record3d),
    ):
        yield Reader(name, lambda name=name: [rgbd_folders()[name]], lambda at, read=read: _read_frames(read(at)))
    yield Reader("OpenGaussian result", opengaussian_results, read_opengaussian)
    yield Reader("capture", captures, _read_capture)


READERS = {reader.name: reader for reader in _readers()}
