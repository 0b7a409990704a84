"""Results of OpenGaussian runs -> LabelledCloud: ``point_cloud.ply`` with ``cluster_lang.npz``.

The .ply is a trained 3DGS file (the six ``ins_feat_*`` properties that OpenGaussian adds were clustered already and are
not read). The .npz names the outcome, one row per leaf of the two-level codebook (k1 k2 of them, many empty):

  ``leaf_feat``   (K, D) floats, mean CLIP feature of the leaf's masks, a zero row where no mask matched
  ``leaf_score``  (K,) floats, mean score of those matches
  ``occu_count``  (K,) how many views matched
  ``leaf_ind``    (N,) integers, the leaf of each Gaussian, in the order of the .ply

Every leaf with a Gaussian becomes an instance. One that no view matched has no descriptor, so it answers "unknown";
the authors' own evaluation gives it class 0.
"""

from __future__ import annotations

import os
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.cloud import UNKNOWN_SPACE, InstanceTable, LabelledCloud
from og_pointcloud.errors import MissingExtraError, SceneError
from og_pointcloud.formats.gaussian_ply import latest_iteration, read_gaussian_ply
from og_pointcloud.formats.langsplat import LANGSPLAT_SPACE, LANGSPLAT_WIDTH
from og_pointcloud.formats.npy import array_from_zip
from og_pointcloud.formats.tables import naming
from og_pointcloud.journal import LeftOut, left_out_entry
from og_pointcloud.settings import GeometrySettings

try:
    from og_pointcloud.rendering.geometry import neighbourhood
except ImportError as error:
    raise MissingExtraError("scipy and numba", "fit") from error

__all__ = ["CLUSTERS_NAME", "MIN_OPACITY", "find_result", "read_opengaussian"]

CLUSTERS_NAME = "cluster_lang.npz"
MIN_OPACITY = 0.1
"""Gaussians less opaque cannot be seen; the authors' ScanNet evaluation leaves out the same ones."""
MAX_UNPACKED_BYTES = 1 << 31
"""Bytes of the four arrays together; ten million Gaussians and a thousand leaves need 82 MB."""


@dataclass(frozen=True)
class _Leaves:
    """The four arrays, checked. unit_features: (K, D) float32, unit rows, zero where the leaf has no feature."""

    unit_features: NDArray[np.float32]
    score: NDArray[np.float32]
    views: NDArray[np.int32]
    of_gaussian: NDArray[np.int64]


def read_opengaussian(
    result: str | os.PathLike[str],
    cluster_lang: str | os.PathLike[str] | None = None,
    *,
    feature_space: str | None = None,
    min_opacity: float = MIN_OPACITY,
) -> LabelledCloud:
    """Read what an OpenGaussian run wrote.

    result: the run's folder (its highest ``point_cloud/iteration_*/point_cloud.ply`` is taken) or a .ply.
    cluster_lang: the .npz; left out, ``cluster_lang.npz`` in the folder or next to the .ply.
    feature_space: the encoder of the leaves' features; None: LangSplat's OpenCLIP ViT-B/16 where they are 512 wide, as
        OpenGaussian's are, else unknown.
    min_opacity: Gaussians less opaque are left out; 0 keeps all, and with them the file's order.

    Evidence: ``views`` and ``masks`` are occu_count, ``agreement`` is leaf_score; ``visible_area``, of which the files
    say nothing, is 0. Raises SceneError, beginning with the path, for files that are missing, damaged or not of one
    run. Nothing is unpickled.

    >>> import og_pointcloud as og
    >>> og.read_opengaussian("no_such_run")
    Traceback (most recent call last):
        ...
    og_pointcloud.errors.SceneError: no_such_run...
    """
    ply, clusters = find_result(Path(result), None if cluster_lang is None else Path(cluster_lang))
    points = read_gaussian_ply(ply)
    with naming(clusters):
        leaves = _read_leaves(clusters, len(points))
    assert points.opacity is not None
    kept = points.opacity >= min_opacity
    if not kept.any():
        raise SceneError(
            f"{ply}: none of {len(points)} Gaussians has an opacity of {min_opacity} or more (the largest is "
            f"{points.opacity.max(initial=0):.3g}); expected visible ones: lower min_opacity"
        )
    xyz = points.xyz[kept]
    used, ids = np.unique(leaves.of_gaussian[kept], return_inverse=True)
    settings = GeometrySettings()
    spacing = float(np.median(neighbourhood(xyz, settings).spacing))
    return LabelledCloud(
        xyz=xyz,
        origin=points.origin,
        instance_ids=ids.reshape(-1).astype(np.int32),
        instances=_instances(leaves, used, ids.reshape(-1)),
        feature_space=feature_space or _usual_space(leaves.unit_features.shape[1]),
        spacing=spacing,
        reach=settings.reach * spacing,
        rgb=None if points.rgb is None else points.rgb[kept],
        provenance=_provenance(ply, clusters, leaves, used, int((~kept).sum()), min_opacity),
    )


def find_result(result: Path, cluster_lang: Path | None = None) -> tuple[Path, Path]:
    """The .ply and the .npz of a run, given its folder or its .ply. SceneError where one is not there."""
    if result.is_dir():
        ply, folders = latest_iteration(result) or result / "point_cloud.ply", [result]
    else:
        ply, folders = result, []
    if not ply.is_file():
        raise SceneError(f"{ply} is not a file; expected a result folder of OpenGaussian or its point_cloud.ply")
    # The .ply lies in point_cloud/iteration_N/ of the folder that holds the .npz.
    folders += [ply.parent, *ply.resolve().parents[2:3]]
    choices = [folder / CLUSTERS_NAME for folder in folders] if cluster_lang is None else [cluster_lang]
    clusters = next((file for file in choices if file.is_file()), None)
    if clusters is None:
        raise SceneError(
            f"{choices[0]} is not a file; expected the leaves' features that OpenGaussian writes after its last stage: "
            "finish the run, or name the file (--cluster-lang)"
        )
    return ply, clusters


def _read_leaves(file: Path, gaussians: int) -> _Leaves:
    arrays = _arrays(file)
    features, of_gaussian = arrays["leaf_feat"], arrays["leaf_ind"]
    if features.ndim != 2 or features.dtype.kind != "f":
        raise SceneError(f"leaf_feat is {features.dtype} {features.shape}; expected floats of shape (leaves, width)")
    score, views = (_per_leaf(name, arrays[name], len(features)) for name in ("leaf_score", "occu_count"))
    if ((views < 0) | (views >= 1 << 31)).any():
        raise SceneError(f"occu_count spans {views.min():g}..{views.max():g}; expected counts of views: match again")
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.linalg.norm(features.astype(np.float64), axis=1, keepdims=True)
    if not np.isfinite(length).all():
        row = int(np.argmin(np.isfinite(length)))
        raise SceneError(f"leaf_feat row {row} holds NaN or infinity; expected finite numbers: associate again")
    matched = (length > 0) & (views > 0)[:, None]
    return _Leaves(
        np.where(matched, features / np.where(length > 0, length, 1), 0).astype(np.float32),
        np.clip(score, -1, 1).astype(np.float32),
        views.astype(np.int32),
        _leaf_of_gaussian(of_gaussian, gaussians, len(features)),
    )


def _arrays(file: Path) -> dict[str, NDArray[Any]]:
    """The four arrays by name. None is unpacked before its size is checked, none is unpickled."""
    wanted = ("leaf_feat", "leaf_score", "occu_count", "leaf_ind")
    try:
        with zipfile.ZipFile(file) as archive:
            # Saved under names that end in .npy themselves, so that numpy's own ending may follow once more.
            entries = {info.filename.split(".npy")[0]: info for info in archive.infolist()}
            missing = [name for name in wanted if name not in entries]
            if missing:
                raise SceneError(
                    f"no '{missing[0]}' (it has {', '.join(entries) or 'nothing':.120}); expected {', '.join(wanted)}: "
                    "name the file that OpenGaussian wrote last"
                )
            size = sum(entries[name].file_size for name in wanted)
            if size > MAX_UNPACKED_BYTES:
                raise SceneError(f"its arrays unpack to {size} bytes; expected at most {MAX_UNPACKED_BYTES}")
            return {name: array_from_zip(archive, entries[name]) for name in wanted}
    except SceneError:
        raise
    except (zipfile.BadZipFile, zlib.error, ValueError, EOFError, RuntimeError) as error:
        raise SceneError(
            f"cannot be read as an .npz of plain arrays ({error!s:.120}): associate again or copy it anew"
        ) from None


def _per_leaf(name: str, values: NDArray[Any], leaves: int) -> NDArray[np.float64]:
    """(K,) float64; a trailing axis of length 1 is dropped."""
    if values.dtype.kind not in "fiu" or values.shape not in ((leaves,), (leaves, 1)):
        raise SceneError(
            f"{name} is {values.dtype} {values.shape}; expected numbers of shape ({leaves},), one a row of leaf_feat"
        )
    if not np.isfinite(values).all():
        raise SceneError(f"{name} holds NaN or infinity; expected finite numbers: associate again")
    return values.reshape(leaves).astype(np.float64)


def _leaf_of_gaussian(of_gaussian: NDArray[Any], gaussians: int, leaves: int) -> NDArray[np.int64]:
    if of_gaussian.shape not in ((gaussians,), (gaussians, 1)) or of_gaussian.dtype.kind not in "iu":
        raise SceneError(
            f"leaf_ind is {of_gaussian.dtype} {of_gaussian.shape}; expected integers of shape ({gaussians},), one a "
            "Gaussian of the .ply: give the two files of one run"
        )
    outside = (of_gaussian < 0) | (of_gaussian >= leaves)
    if outside.any():
        row = int(np.argmax(outside))
        raise SceneError(
            f"leaf_ind sends Gaussian {row} to leaf {of_gaussian.reshape(-1)[row]}; expected 0..{leaves - 1}, a row of "
            "leaf_feat: give the two files of one run"
        )
    return of_gaussian.reshape(gaussians).astype(np.int64)


def _instances(leaves: _Leaves, used: NDArray[np.int64], ids: NDArray[np.intp]) -> InstanceTable:
    """The table of the leaves in ``used``, which become instances 0, 1, ..."""
    descriptors = leaves.unit_features[used]
    described = np.flatnonzero(descriptors.any(axis=1))
    return InstanceTable(
        descriptors=descriptors[described],
        descriptor_instance=described.astype(np.int32),
        points=np.bincount(ids, minlength=len(used)).astype(np.int32),
        views=leaves.views[used],
        masks=leaves.views[used],
        agreement=leaves.score[used],
        visible_area=np.zeros(len(used), np.float32),
    )


def _usual_space(width: int) -> str:
    return LANGSPLAT_SPACE if width == LANGSPLAT_WIDTH else UNKNOWN_SPACE


def _provenance(
    ply: Path, clusters: Path, leaves: _Leaves, used: NDArray[np.int64], faint: int, min_opacity: float
) -> dict[str, Any]:
    total, count = len(leaves.views), len(used)
    undescribed = int((~leaves.unit_features[used].any(axis=1)).sum())
    left_out = []
    if total > count:
        left_out.append(left_out_entry(LeftOut.EMPTY_LEAVES, count=total - count, total=total))
    if faint:
        left_out.append(left_out_entry(LeftOut.FAINT_GAUSSIANS, count=faint, opacity=min_opacity))
    warnings = [f"{undescribed} of {count} instances have no feature and answer unknown"] if undescribed else []
    return {
        "source": "OpenGaussian result",
        "files": {"gaussians": str(ply), "clusters": str(clusters)},
        "settings": {"min_opacity": min_opacity},
        "stages": [],
        "left_out": left_out,
        "warnings": warnings,
        "notes": {"leaves": total, "instances": count, "instances_without_feature": undescribed},
    }
