"""Results of OpenGaussian runs -> LabelledCloud: ``point_cloud.ply`` with ``cluster_lang.npz``.

The .ply is a trained 3DGS file (the six ``ins_feat_*`` properties that OpenGaussian adds are clustered already and not
read). The .npz holds the result, one row per leaf of the two-level codebook (k1 k2 leaves, many of them empty):

  ``leaf_feat``   (K, D) floats, mean CLIP feature of the leaf's masks, a zero row where no mask matched
  ``leaf_score``  (K,) floats, mean score of those matches
  ``occu_count``  (K,) how many views matched
  ``leaf_ind``    (N,) integers, the leaf of each Gaussian, in the order of the .ply

Every leaf with a Gaussian becomes an instance. One that no view matched has no descriptor, so it answers "unknown";
the authors' own evaluation gives it class 0.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.cloud import UNKNOWN_SPACE, InstanceTable, LabelledCloud
from og_pointcloud.errors import SceneError
from og_pointcloud.fitting.association import directions
from og_pointcloud.formats.gaussian_ply import latest_iteration
from og_pointcloud.formats.langsplat import LANGSPLAT_SPACE, LANGSPLAT_WIDTH
from og_pointcloud.formats.npy import read_npz
from og_pointcloud.formats.points import read_points
from og_pointcloud.formats.tables import naming
from og_pointcloud.journal import LeftOut, left_out_entry
from og_pointcloud.rendering.geometry import neighborhood
from og_pointcloud.settings import GeometrySettings

MIN_OPACITY = 0.1
"""Gaussians less opaque than this cannot be seen; the authors' ScanNet evaluation leaves out the same ones."""
ARRAYS = ("leaf_feat", "leaf_score", "occu_count", "leaf_ind")
MAX_UNPACKED_BYTES = 1 << 31
"""Bytes of the four arrays together; ten million Gaussians and a thousand leaves need 82 MB."""


@dataclass(frozen=True)
class _Leaves:
    """The four arrays, checked. unit_features: (K, D) float32, unit rows, zero where no view matched the leaf."""

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

    Evidence: ``views`` and ``masks`` are occu_count, ``agreement`` is leaf_score; ``visible_area`` is 0, as the files
    say nothing about it. Raises SceneError, beginning with the path, for files that are missing, damaged or not of one
    run. Nothing is unpickled.

    >>> import og_pointcloud as og
    >>> og.read_opengaussian("no_such_run")
    Traceback (most recent call last):
        ...
    og_pointcloud.errors.SceneError: no_such_run...
    """
    ply, clusters = _find_result(Path(result), None if cluster_lang is None else Path(cluster_lang))
    points = read_points(ply)
    if points.opacity is None:
        raise SceneError(f"{ply} is a plain cloud; expected the trained Gaussians of the run, its point_cloud.ply")
    with naming(clusters):
        leaves = _read_leaves(clusters, len(points))
    kept = points.opacity >= min_opacity
    if not kept.any():
        raise SceneError(
            f"{ply}: none of the {len(points)} Gaussians has an opacity of {min_opacity} or more (the largest is "
            f"{points.opacity.max(initial=0):.3g}); expected at least one: lower min_opacity"
        )
    xyz = points.xyz[kept]
    # Leaves with a Gaussian that is kept become instances 0, 1, ...; k1 k2 leaves are mostly empty.
    used, ids = np.unique(leaves.of_gaussian[kept], return_inverse=True)
    settings, width = GeometrySettings(), leaves.unit_features.shape[1]
    spacing = float(np.median(neighborhood(xyz, settings).spacing))
    return LabelledCloud(
        xyz=xyz,
        origin=points.origin,
        instance_ids=ids.astype(np.int32),
        instances=_instances(leaves, used, ids),
        feature_space=feature_space or (LANGSPLAT_SPACE if width == LANGSPLAT_WIDTH else UNKNOWN_SPACE),
        spacing=spacing,
        reach=settings.reach * spacing,
        rgb=None if points.rgb is None else points.rgb[kept],
        provenance=_provenance(ply, clusters, leaves, used, int((~kept).sum()), min_opacity),
    )


def _find_result(result: Path, cluster_lang: Path | None) -> tuple[Path, Path]:
    """The .ply and the .npz of a run, given its folder or its .ply. SceneError where one is not there."""
    if result.is_dir():
        ply, folders = latest_iteration(result) or result / "point_cloud.ply", [result]
    else:
        ply, folders = result, []
    if not ply.is_file():
        raise SceneError(f"{ply} is not a file; expected an OpenGaussian result folder or its point_cloud.ply")
    # The .ply lies in point_cloud/iteration_N/ of the folder that holds the .npz.
    folders += [ply.parent, *ply.resolve().parents[2:3]]
    choices = [folder / "cluster_lang.npz" for folder in folders] if cluster_lang is None else [cluster_lang]
    clusters = next((file for file in choices if file.is_file()), None)
    if clusters is None:
        raise SceneError(
            f"{choices[0]} is not a file; expected the leaf features that OpenGaussian writes after its last stage: "
            "finish the run, or give the file (--cluster-lang)"
        )
    return ply, clusters


def _read_leaves(file: Path, gaussians: int) -> _Leaves:
    """The four arrays, each of plain numbers in its shape; SceneError for anything else."""
    arrays = read_npz(file, ARRAYS, (), MAX_UNPACKED_BYTES, f"{', '.join(ARRAYS)}: give the file written last")
    features, score, views, of_gaussian = (arrays[name] for name in ARRAYS)
    if features.ndim != 2 or features.dtype.kind != "f":
        raise SceneError(f"leaf_feat is {features.dtype} {features.shape}; expected floats of shape (leaves, D)")
    # One value a leaf, and one leaf a Gaussian: another number of Gaussians means files of two runs.
    leaves = len(features)
    for name, kinds, length in zip(ARRAYS[1:], ("fiu", "fiu", "iu"), (leaves, leaves, gaussians), strict=True):
        if arrays[name].dtype.kind not in kinds or arrays[name].shape not in ((length,), (length, 1)):
            raise SceneError(
                f"{name} is {arrays[name].dtype} {arrays[name].shape}; expected "
                f"{'numbers' if 'f' in kinds else 'integers'} of shape ({length},): give two files of the same run"
            )
    # In float64 no bound rounds; NaN is within none.
    largest = np.finfo(np.float32).max
    bounds = (-largest, largest), (-largest, largest), (0, (1 << 31) - 1), (0, leaves - 1)
    for name, (least, most) in zip(ARRAYS, bounds, strict=True):
        within = (arrays[name].astype(np.float64) >= least) & (arrays[name].astype(np.float64) <= most)
        if not within.all():
            row = int(np.argwhere(~within)[0][0])
            raise SceneError(
                f"{name} row {row} is {arrays[name][row]!s:.60}; expected numbers from {least:g} to {most:g}: give two "
                "files of the same run, or run the association again"
            )
    unit = directions(features)
    return _Leaves(
        np.where((views > 0).reshape(-1, 1), unit, 0).astype(np.float32),
        # A score of Eq. 5 is a share; rounding may leave it just beyond.
        np.clip(score, -1, 1).astype(np.float32).reshape(-1),
        views.astype(np.int32).reshape(-1),
        of_gaussian.astype(np.int64).reshape(-1),
    )


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


def _provenance(
    ply: Path, clusters: Path, leaves: _Leaves, used: NDArray[np.int64], faint: int, min_opacity: float
) -> dict[str, Any]:
    """Where the cloud is from and what of it was left out, with the keys that a fit's provenance has."""
    total, count = len(leaves.views), len(used)
    undescribed = int((~leaves.unit_features[used].any(axis=1)).sum())
    left_out = []
    if total > count:
        left_out.append(left_out_entry(LeftOut.EMPTY_LEAVES, count=total - count, total=total))
    if faint:
        left_out.append(left_out_entry(LeftOut.FAINT_GAUSSIANS, count=faint, opacity=min_opacity))
    warnings = [f"{undescribed} of {count} instances have no feature and are always unknown"] if undescribed else []
    return {
        "source": "OpenGaussian result",
        "files": {"gaussians": f"{ply.parent.name}/{ply.name}", "clusters": clusters.name},
        "settings": {"min_opacity": min_opacity},
        "stages": [],
        "left_out": left_out,
        "warnings": warnings,
        "notes": {"leaves": total, "instances": count, "instances_without_feature": undescribed},
    }
