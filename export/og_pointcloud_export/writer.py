"""LabelledCloud -> one .ogpc file; og_pointcloud.bundle.format describes it."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass, fields, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.ask.labelled_scene import SceneLike, as_scene
from og_pointcloud.bundle.format import (
    FORMAT,
    INSTANCE_MEMBERS,
    SCHEMA_VERSION,
    describe_member,
    manifest_json,
    rows_of_cameras,
)
from og_pointcloud.bundle.nearest import NONE_WITHIN_REACH, NearestPoint
from og_pointcloud.bundle.vocabulary import bank_members, bank_of_encoder, encoder_members, vocabulary_members
from og_pointcloud.cloud import TOO_FAR, InstanceTable, LabelledCloud
from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.formats.atomic import StrPath, replacing
from og_pointcloud.formats.npy import npy_bytes
from og_pointcloud.models import open_session
from og_pointcloud_export.lookup_grid import build_lookup_grid
from og_pointcloud_export.query_graph import OPSET, build_query_graph

SCORE_TOLERANCE = 1e-5
"""Largest accepted cosine error of the graph against float64; float32 sums of 512 terms reach 1e-6."""
PARITY_TEXTS, PARITY_POINTS = 64, 4096


@dataclass(frozen=True)
class QueryModel:
    """query.onnx of a cloud. parity: its largest differences from float64."""

    onnx: bytes
    parity: dict[str, Any]


def write_bundle(cloud: SceneLike, path: StrPath, *, text_encoder: StrPath | None = None) -> Path:
    """Write a cloud or a scene as .ogpc, atomically, with the same bytes for the same cloud. Returns the path.

    text_encoder: the folder of an encoder for the file to carry. A cloud without a word bank gets that of this encoder,
    or of the one found for its feature space (`og_pointcloud.text.encoder.find_encoder`), if any.
    Raises OgPointcloudError, and writes nothing, if the provenance is no JSON, if it or a word is longer than readers
    accept, if the graph disagrees with numpy, or if the encoder is of another feature space.

    >>> import pathlib, tempfile
    >>> path = og.write_bundle(cloud, pathlib.Path(tempfile.mkdtemp()) / "two.ogpc")  # of `LabelledCloud`'s example
    >>> og.segment(path, ["chair"]).counts()
    {'chair': 3}
    """
    path, cloud = Path(path), cloud if isinstance(cloud, LabelledCloud) else as_scene(cloud).cloud
    if cloud.word_bank is None:
        cloud = replace(cloud, word_bank=bank_of_encoder(cloud.space, text_encoder))
    model = query_model(cloud)
    members = {"query.onnx": model.onnx} | {
        f"arrays/{name}.npy": npy_bytes(array) for name, array in _arrays(cloud).items()
    }
    if cloud.vocabulary is not None:
        members |= vocabulary_members(cloud.vocabulary)
    if cloud.word_bank is not None:
        members |= bank_members(cloud.word_bank)
    if text_encoder is not None:
        members |= encoder_members(text_encoder, cloud.space)[0]
    manifest = _manifest(cloud, model, members)
    with replacing(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, data in {"manifest.json": manifest, **members}.items():
            archive.writestr(zipfile.ZipInfo(name), data)  # ZipInfo is dated 1980: equal contents, equal bytes
    return path


def query_model(cloud: LabelledCloud) -> QueryModel:
    """Build a cloud's query.onnx and compare it with numpy in float64; OgPointcloudError if they differ."""
    onnx = build_query_graph(cloud, build_lookup_grid(cloud))
    parity = _parity(cloud, onnx)
    if parity["instance_score_error"] > SCORE_TOLERANCE or parity["certain_points_wrong"]:
        raise OgPointcloudError(
            f"query.onnx differs from float64: scores by {parity['instance_score_error']:.3g} (expected at most "
            f"{SCORE_TOLERANCE}), {parity['certain_points_wrong']} certain points wrong (expected 0): descriptors must "
            "be unit rows; if they are, report this cloud as a bug"
        )
    return QueryModel(onnx, parity)


def _arrays(cloud: LabelledCloud) -> dict[str, NDArray[Any]]:
    """Members below arrays/, by name. Descriptors are stored only in query.onnx, at an offset in the manifest."""
    columns = [field.name for field in fields(InstanceTable) if field.name != "descriptors"]
    table = {INSTANCE_MEMBERS.get(name, name): getattr(cloud.instances, name) for name in columns}
    table["points"] = cloud.counted_points  # where points were removed or copied, the table's may be of earlier ones
    if not np.isfinite(table["reliability"]).any():
        del table["reliability"]  # like files older than this column
    arrays = {"xyz": cloud.xyz, "instance_ids": _smallest_signed(cloud.instance_ids)}
    if cloud.rgb is not None:
        arrays["rgb"] = cloud.rgb
    if cloud.certainty is not None:
        arrays["certainty"] = cloud.certainty
    if cloud.cameras:
        arrays["cameras"] = rows_of_cameras(cloud.cameras)
    return arrays | {f"instances/{name}": array for name, array in table.items()}


def _smallest_signed(ids: NDArray[np.int32]) -> NDArray[np.signedinteger]:
    return ids.astype(np.min_scalar_type(-1 - int(ids.max(initial=0))))  # which holds as many numbers from 0 on


def _parity(cloud: LabelledCloud, onnx: bytes) -> dict[str, Any]:
    """Compare the graph with numpy on the cloud's words, random vectors, and points moved by 0, 0.5 or 2 spacings."""
    session = open_session(onnx)
    random = np.random.default_rng(0)
    width = session.get_inputs()[1].shape[1]
    text = random.normal(size=(PARITY_TEXTS, width)).astype(np.float32)
    if cloud.vocabulary is not None and cloud.vocabulary.vectors.shape[1] == width:
        text = np.concatenate([cloud.vocabulary.vectors, text])
    points = cloud.xyz[random.integers(0, len(cloud), PARITY_POINTS)] if len(cloud) else cloud.xyz
    points = points + (random.normal(size=points.shape) * random.choice([0, 0.5, 2], (len(points), 1)) * cloud.spacing)
    points = points.astype(np.float32)

    names = ["instance_scores", "instance", "certain"]
    scores, instance, certain = (np.asarray(out) for out in session.run(names, {"points": points, "text": text}))
    # Certain answers of the graph must equal those of the exact search; open ones are counted.
    nearest = NearestPoint(cloud.xyz, cloud.spacing, cloud.reach).query(points)
    exact = np.full(len(points), TOO_FAR, np.int32)
    exact[nearest != NONE_WITHIN_REACH] = cloud.instance_ids[nearest[nearest != NONE_WITHIN_REACH]]
    reference = cloud.instances.cosines(text.astype(np.float64))
    return {
        "texts": len(text),
        "instance_score_error": float(np.abs(scores - reference).max(initial=0.0)),
        "points": len(points),
        "certain_points_wrong": int((certain & (instance != exact)).sum()),
        "open_points": int((~certain).sum()),
    }


def _manifest(cloud: LabelledCloud, model: QueryModel, members: dict[str, bytes]) -> bytes:
    descriptors = np.ascontiguousarray(cloud.instances.descriptors, "<f4")
    manifest = {
        "format": FORMAT,
        "schema_version": SCHEMA_VERSION,
        "written_by": written_by(),
        "feature_space": cloud.feature_space,
        "frame": {
            "origin": cloud.origin.tolist(), "unit": "of the capture", "spacing": float(cloud.spacing),
            "reach": float(cloud.reach),
        },
        "counts": {
            "points": len(cloud), "instances": len(cloud.instances), "descriptors": len(descriptors),
            "words": len(cloud.vocabulary.names) if cloud.vocabulary is not None else 0,
        },
        # Stored once, as constants of the graph.
        "descriptors": {
            "member": "query.onnx", "offset": model.onnx.index(descriptors.tobytes()) if descriptors.size else 0,
            "shape": list(descriptors.shape),
        },
        "query_head": {"opset": OPSET},
        "parity": model.parity,
        "members": {name: describe_member(name, data) for name, data in members.items()},
        "provenance": cloud.provenance,
    }  # fmt: skip
    return manifest_json(manifest)


def written_by() -> str:
    """Name and version of this library, as manifests hold them."""
    try:
        return f"og-pointcloud {version('og-pointcloud')}"
    except PackageNotFoundError:
        return "og-pointcloud unknown"
