"""Reads a .ogpc file without trusting it; ``bundle.format`` describes its members."""

from __future__ import annotations

import json
import os
import zipfile
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.bundle import format as ogpc
from og_pointcloud.bundle.known_graph import query_tables
from og_pointcloud.cloud import TOO_FAR, InstanceTable, LabelledCloud, Vocabulary, WordBank
from og_pointcloud.errors import BundleError, OgPointcloudError
from og_pointcloud.formats.atomic import StrPath
from og_pointcloud.formats.npy import array_from_npy
from og_pointcloud.text.text_features import check_names

ZIP_ERRORS = (zipfile.BadZipFile, EOFError, RuntimeError, NotImplementedError, OSError, ValueError)
"""All that zipfile raises for archives that are damaged, encrypted, or compressed in an unknown way."""


@dataclass(frozen=True)
class Bundle:
    """Content of a .ogpc file.

    path, query_onnx: the file, and its serialized graph; None for a cloud that was never a file. manifest: as read; the
    fields that this library uses are checked.
    """

    path: Path | None
    cloud: LabelledCloud
    query_onnx: bytes | None
    manifest: dict[str, Any]


def read_bundle(path: StrPath) -> Bundle:
    """Read and check a .ogpc file; BundleError, whose text begins with the path, for any other or damaged file.

    Each member's CRC-32 is checked. The manifest's sha256 digests are not: anyone can write them, so they identify
    files but do not authenticate them.

    >>> import pathlib, tempfile
    >>> path = og.write_bundle(cloud, pathlib.Path(tempfile.mkdtemp()) / "two.ogpc")  # of `LabelledCloud`'s example
    >>> bundle = og.read_bundle(path)
    >>> bundle.cloud.feature_space, bundle.manifest["counts"]["points"]
    ('two-words', 3)
    """
    if not isinstance(path, (str, os.PathLike)) or not os.path.isfile(path):
        cure = "check the name, or make it (og-pointcloud fit)"
        # Not Path.with_suffix and is_file, which fail for "." and for names that are too long.
        beside = f"{os.path.splitext(Path(path))[0]}.ogpc" if isinstance(path, (str, os.PathLike)) else ""
        if os.path.isfile(beside):
            cure = f"did you mean {beside}?"  # a capture's folder has the same name
        raise BundleError(f"{path} is not a file; expected a .ogpc file: {cure}")
    path = Path(path)
    try:
        with path.open("rb") as file:
            members, carried = _members(file)
        manifest = _manifest(members)
        _check_members(manifest, members, carried)
        # Only complete, declared members are parsed, and each is checked against the others.
        # Absolute: what else the file holds is read later, perhaps from another working folder.
        cloud = _cloud(manifest, members)
        _check_counts(cloud)
        return Bundle(path.absolute(), cloud, members["query.onnx"], manifest)
    except _Refused as error:
        raise BundleError(f"{path}: {error}") from None


def read_carried_encoder(path: StrPath) -> dict[str, bytes] | None:
    """The files of the text encoder that a .ogpc carries, by name, unchecked; None if it carries none."""
    path = Path(path)
    try:
        with path.open("rb") as file:
            _, carried = _members(file)
            archive = zipfile.ZipFile(file)
            return {name.removeprefix(ogpc.CARRIED_ENCODER): archive.read(name) for name in carried} or None
    except _Refused as error:
        raise BundleError(f"{path}: {error}") from None
    except ZIP_ERRORS as error:
        raise BundleError(f"{path}: the text encoder in it is damaged ({error!s:.120}): {ogpc.REBUILD}") from None


class _Refused(Exception):
    """Why a file is refused; read_bundle puts the path before it."""


def _members(file: BinaryIO) -> tuple[dict[str, bytes], dict[str, int]]:
    """All members by name, and the sizes of a carried encoder's, which are rarely needed.

    Members must be stored uncompressed and fit into the file together, so reading them takes no more memory than the
    file's size.
    """
    size = file.seek(0, os.SEEK_END)
    try:
        archive = zipfile.ZipFile(file)
        infos = archive.infolist()
        for info in infos:
            if not ogpc.SAFE_NAME.fullmatch(info.filename):
                raise _Refused(f"member name {info.filename!r:.80} is not a plain relative path: do not trust the file")
            if info.compress_type != zipfile.ZIP_STORED or info.compress_size != info.file_size:
                raise _Refused(f"member '{info.filename:.80}' is compressed; expected stored members: {ogpc.REBUILD}")
        # Members of the same name, or overlapping ones, could be read differently by other readers.
        names = {info.filename for info in infos}
        total = sum(info.file_size for info in infos)
        if len(names) != len(infos) or len(infos) > ogpc.MAX_MEMBERS or total > size:
            raise _Refused(
                f"{len(infos)} members with {len(names)} names claim {total} bytes in a file of {size}; expected at "
                f"most {ogpc.MAX_MEMBERS} members that fit, with unique names: do not trust the file"
            )
        carried = {info.filename: info.file_size for info in infos if info.filename.startswith(ogpc.CARRIED_ENCODER)}
        return {info.filename: archive.read(info) for info in infos if info.filename not in carried}, carried
    except ZIP_ERRORS as error:
        raise _Refused(
            f"not a .ogpc file, or damaged ({error!s:.120}); expected a zip of stored members: {ogpc.REBUILD}; a "
            "cloud or splat alone is not a scene: og-pointcloud fit makes one from a capture"
        ) from None


def _manifest(members: dict[str, bytes]) -> dict[str, Any]:
    if "manifest.json" not in members:
        holds = ", ".join(list(members)[:3]) or "nothing"
        raise _Refused(f"a zip without manifest.json (it has {holds}): not a .ogpc file; pass the one that fit wrote")
    manifest = _json(members, "manifest.json", ogpc.MAX_MANIFEST_BYTES)
    if not isinstance(manifest, dict) or manifest.get("format") != ogpc.FORMAT:
        seen = manifest.get("format") if isinstance(manifest, dict) else type(manifest).__name__
        raise _Refused(f"its manifest says format {seen!r}; expected {ogpc.FORMAT!r}: pass the file that fit wrote")
    schema = manifest.get("schema_version")
    if not isinstance(schema, int) or schema < 1:
        raise _Refused(f"schema_version is {schema!r}; expected a whole number from 1: {ogpc.REBUILD}")
    if schema != ogpc.SCHEMA_VERSION:
        older = "older", "fit the capture again (og-pointcloud fit CAPTURE -o S.ogpc)"
        age, cure = older if schema < ogpc.SCHEMA_VERSION else ("newer", "pip install --upgrade og-pointcloud")
        raise _Refused(
            f"schema_version is {schema}, {age} than the {ogpc.SCHEMA_VERSION} that this library reads: {cure}"
        )
    return manifest


def _json(members: dict[str, bytes], name: str, most: int) -> Any:
    data = members[name]
    if len(data) > most:
        raise _Refused(f"{name} has {len(data)} bytes; expected at most {most}: {ogpc.REBUILD}")
    try:
        return json.loads(data)
    except (ValueError, RecursionError) as error:
        raise _Refused(f"{name} is not JSON ({error}): {ogpc.REBUILD}") from None


def _check_members(manifest: dict[str, Any], members: dict[str, bytes], carried: dict[str, int]) -> None:
    # The zip directory and the manifest list the same members: neither may have more.
    declared = _field(manifest, "members", dict)
    sizes = {name: len(data) for name, data in members.items()} | carried
    if undeclared := sorted(set(sizes) - set(declared) - {"manifest.json"}):
        raise _Refused(f"member '{undeclared[0]:.80}' is not in the manifest: the file was changed; {ogpc.REBUILD}")
    for name, entry in declared.items():
        if name not in sizes:
            raise _Refused(f"member '{name:.80}' of the manifest is missing: {ogpc.REBUILD}")
        length = _field(entry, "bytes", int, f"members/{name}/")
        if length != sizes[name]:
            raise _Refused(f"member '{name}' has {sizes[name]} bytes, the manifest says {length}: {ogpc.REBUILD}")
    if "query.onnx" not in members:
        raise _Refused(f"member 'query.onnx' is missing: {ogpc.REBUILD}")


def _cloud(manifest: dict[str, Any], members: dict[str, bytes]) -> LabelledCloud:
    counts, frame = _field(manifest, "counts", dict), _field(manifest, "frame", dict)
    points, instances = _field(counts, "points", int, "counts/"), _field(counts, "instances", int, "counts/")
    xyz = _array(members, "arrays/xyz.npy", ("<f4",), (points, 3))
    if not np.isfinite(xyz).all():
        raise _Refused(f"arrays/xyz.npy contains NaN or infinity; expected finite coordinates: {ogpc.REBUILD}")
    ids = _array(members, "arrays/instance_ids.npy", ogpc.INTEGER_DTYPES, (points,)).astype(np.int32)
    ids.flags.writeable = False  # as all other arrays of a file are
    rgb = _array(members, ogpc.RGB, ("|u1",), (points, 3)) if ogpc.RGB in members else None
    certainty = _array(members, ogpc.CERTAINTY, ("|u1",), (points,)) if ogpc.CERTAINTY in members else None
    cameras = _array(members, ogpc.CAMERAS, ("<f8",), (None, 18)) if ogpc.CAMERAS in members else np.zeros((0, 18))
    try:
        origin = np.array(_field(frame, "origin", list, "frame/"), np.float64)
        if origin.shape != (3,):
            raise ValueError(f"origin is {frame['origin']}; expected three numbers")
        return LabelledCloud(
            xyz=xyz,
            origin=origin,
            instance_ids=ids,
            instances=_instances(manifest, members, instances),
            feature_space=_field(manifest, "feature_space", str),
            spacing=float(_field(frame, "spacing", (int, float), "frame/")),
            reach=float(_field(frame, "reach", (int, float), "frame/")),
            rgb=rgb,
            certainty=certainty,
            vocabulary=_vocabulary(manifest, members),
            word_bank=WordBank(_array(members, ogpc.BANK, ("<f2",), (None, None))) if ogpc.BANK in members else None,
            provenance=_field(manifest, "provenance", dict),
            cameras=ogpc.cameras_of_rows(cameras),
        )
    except (OgPointcloudError, ValueError, TypeError, OverflowError) as error:
        raise _Refused(f"its parts do not fit together ({error}): {ogpc.REBUILD}") from None


def _check_counts(cloud: LabelledCloud) -> None:
    """What lists and indices say of instances must be what their points say."""
    wrong = np.flatnonzero(cloud.instances.points != cloud.counted_points)
    if len(wrong):
        first = int(wrong[0])
        raise _Refused(
            f"arrays/instances/points.npy says that instance {first} has {cloud.instances.points[first]} points, its "
            f"ids that it has {cloud.counted_points[first]}: {ogpc.REBUILD}"
        )


def _instances(manifest: dict[str, Any], members: dict[str, bytes], count: int) -> InstanceTable:
    descriptors = _descriptors(_field(manifest, "descriptors", dict), members)
    columns: dict[str, NDArray[Any]] = {}
    for field in fields(InstanceTable):
        member = f"arrays/instances/{ogpc.INSTANCE_MEMBERS.get(field.name, field.name)}.npy"
        if field.name == "descriptors" or (field.name in ogpc.OPTIONAL_COLUMNS and member not in members):
            continue
        dtype = "<f4" if field.name in ("agreement", "visible_area", "reliability") else "<i4"
        length = len(descriptors) if field.name == "descriptor_instance" else count
        columns[field.name] = _array(members, member, (dtype,), (length,))
    # The columns that `segment` reads and the tables of the graph must hold the same numbers.
    _check_graph(members["query.onnx"], descriptors, columns["descriptor_instance"], count)
    return InstanceTable(descriptors, **columns)


def _check_graph(
    onnx: bytes, descriptors: NDArray[np.float32], descriptor_instance: NDArray[np.int32], instances: int
) -> None:
    """Refuse any graph but ours, and one whose descriptors are not the manifest's."""
    try:
        tables = query_tables(onnx)
    except ValueError as error:
        raise _Refused(f"query.onnx: {error}: do not trust the file") from None
    # An answer code is an id, counted from TOO_FAR on.
    codes, rows = instances - TOO_FAR, (len(descriptors), max(descriptors.shape[1], 1))
    same = (
        tables["codes"].tolist() == [codes]
        and tables["unknown_column"].shape == (codes, 1)
        and tables["descriptors"].shape == rows
        and tables["descriptors"].tobytes() == descriptors.tobytes()
        and tables["descriptor_code"].tolist() == (descriptor_instance[:, None] - TOO_FAR).tolist()
    )
    if not same:
        raise _Refused("query.onnx has other instances or descriptors than the file says: do not trust the file")


def _descriptors(place: dict[str, Any], members: dict[str, bytes]) -> NDArray[np.float32]:
    """(R, D) float32, a view of the graph's constants: descriptors are stored only once."""
    graph = members["query.onnx"]
    offset, shape = _field(place, "offset", int, "descriptors/"), _field(place, "shape", list, "descriptors/")
    # Both come from the file: no negative length and no offset may lead outside the graph's bytes.
    sizes_fit = len(shape) == 2 and all(isinstance(length, int) and length >= 0 for length in shape)
    if not sizes_fit or not 0 <= offset <= len(graph) - 4 * shape[0] * shape[1]:
        raise _Refused(f"descriptors of shape {shape} at byte {offset} lie outside query.onnx: {ogpc.REBUILD}")
    return np.frombuffer(graph, "<f4", shape[0] * shape[1], offset).reshape(shape)


def _vocabulary(manifest: dict[str, Any], members: dict[str, bytes]) -> Vocabulary | None:
    if "vocabulary/names.json" not in members:
        return None
    names = _json(members, "vocabulary/names.json", ogpc.MAX_NAMES_BYTES)
    words = _field(_field(manifest, "counts", dict), "words", int, "counts/")
    are_words = isinstance(names, list) and all(isinstance(name, str) and name.strip() for name in names)
    if not are_words or len(set(names)) != len(names) or len(names) != words:
        raise _Refused(f"vocabulary/names.json is not a list of {words} different words: {ogpc.REBUILD}")
    try:
        check_names(names)
    except OgPointcloudError as error:
        raise _Refused(f"vocabulary/names.json: {error}") from None
    vectors = _array(members, "vocabulary/vectors.npy", ogpc.FLOAT_DTYPES, (words, None))
    return Vocabulary(tuple(names), vectors.astype(np.float32))


def _array(
    members: dict[str, bytes], name: str, dtypes: tuple[str, ...], shape: tuple[int | None, ...]
) -> NDArray[Any]:
    """A read-only view of a member's bytes as an array of one of these types and this shape (None: any length)."""
    if name not in members:
        raise _Refused(f"member '{name}' is missing: {ogpc.REBUILD}")
    try:
        array = array_from_npy(members[name])
    except ValueError as error:
        raise _Refused(f"member '{name}' is not a readable .npy ({error}): {ogpc.REBUILD}") from None
    fits = array.ndim == len(shape) and all(want in (None, have) for want, have in zip(shape, array.shape, strict=True))
    if array.dtype.str not in dtypes or not fits:
        expected = f"{' or '.join(dtypes)} {shape}"
        raise _Refused(f"member '{name}' is {array.dtype.str} {array.shape}; expected {expected}: {ogpc.REBUILD}")
    return array


def _field(record: Any, name: str, kind: type | tuple[type, ...], where: str = "") -> Any:
    value = record.get(name) if isinstance(record, dict) else None
    if not isinstance(value, kind) or isinstance(value, bool):
        raise _Refused(f"manifest field '{where}{name}' is {value!r:.60}; {ogpc.REBUILD}")
    return value
