"""og_pointcloud: open-vocabulary labels for point clouds and Gaussian splats.

    import og_pointcloud as og

    scene = og.load("kitchen.ogpc")
    result = og.segment(points, ["chair", "desk"], scene)      # points: (N, 3), or an Open3D or PyVista cloud
    result.labels, result.scores, result.instances, result.mask("chair")
    result.calibrated, result.unknown_because()         # whether scores are probabilities; why points have no label

    hit = og.pick(scene, camera, (320, 240))            # or a place: og.pick(scene, (1.2, 0.4, 0.8))
    hit.instance, hit.point_indices, hit.mask(camera)

    scene.instances                                     # places, boxes, evidence, best words; to_json, to_csv
    og.select(scene, "red mug")                         # instances ranked by a word
    og.edit.remove(scene, "red mug", "without.ply", cloud="kitchen.ply")

Importing costs little: each name is fetched from its module on first use, and only ``fit``, what reads captures and
results, what writes bundles and what draws pictures need more than numpy and onnxruntime (the extra 'fit').
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from og_pointcloud_export import write_bundle

    from og_pointcloud import edit as edit
    from og_pointcloud.boxes import Box, axis_aligned_box, oriented_box
    from og_pointcloud.bundle import TOO_FAR, read_bundle
    from og_pointcloud.choosing import Reason, WordBank
    from og_pointcloud.cloud import BACKGROUND, UNOBSERVED, InstanceTable, LabelledCloud, Vocabulary
    from og_pointcloud.errors import BundleError, FeatureSpaceError, MissingExtraError, OgPointcloudError, SceneError
    from og_pointcloud.fitting.fit import fit
    from og_pointcloud.fitting.pictures import feature_colors, feature_picture, instance_picture
    from og_pointcloud.formats.capture import read_capture
    from og_pointcloud.formats.opengaussian import read_opengaussian
    from og_pointcloud.formats.points import read_points
    from og_pointcloud.instances import Instance, Instances, instance_table
    from og_pointcloud.picking import Pick, in_world, pick
    from og_pointcloud.runtime import LabelledScene, Segmenter, load, segment, use
    from og_pointcloud.scene import Camera
    from og_pointcloud.segmentation import UNKNOWN, Segmentation
    from og_pointcloud.selecting import Match, Selection, select
    from og_pointcloud.settings import FitSettings
    from og_pointcloud.text.features import read_text_features

__all__ = [
    "BACKGROUND",
    "TOO_FAR",
    "UNKNOWN",
    "UNOBSERVED",
    "Box",
    "BundleError",
    "Camera",
    "FeatureSpaceError",
    "FitSettings",
    "Instance",
    "InstanceTable",
    "Instances",
    "LabelledCloud",
    "LabelledScene",
    "Match",
    "MissingExtraError",
    "OgPointcloudError",
    "Pick",
    "Reason",
    "SceneError",
    "Segmentation",
    "Segmenter",
    "Selection",
    "Vocabulary",
    "WordBank",
    "axis_aligned_box",
    "feature_colors",
    "feature_picture",
    "fit",
    "in_world",
    "instance_picture",
    "instance_table",
    "load",
    "oriented_box",
    "pick",
    "read_bundle",
    "read_capture",
    "read_opengaussian",
    "read_points",
    "read_text_features",
    "segment",
    "select",
    "use",
    "write_bundle",
]

_HOMES = {
    "og_pointcloud.boxes": ("Box", "axis_aligned_box", "oriented_box"),
    "og_pointcloud.bundle": ("TOO_FAR", "read_bundle"),
    "og_pointcloud.choosing": ("Reason", "WordBank"),
    "og_pointcloud.cloud": ("BACKGROUND", "UNOBSERVED", "InstanceTable", "LabelledCloud", "Vocabulary"),
    "og_pointcloud.errors": (
        "BundleError", "FeatureSpaceError", "MissingExtraError", "OgPointcloudError", "SceneError",
    ),
    "og_pointcloud.fitting.fit": ("fit",),
    "og_pointcloud.formats.capture": ("read_capture",),
    "og_pointcloud.formats.opengaussian": ("read_opengaussian",),
    "og_pointcloud.formats.points": ("read_points",),
    "og_pointcloud.instances": ("Instance", "Instances", "instance_table"),
    "og_pointcloud.picking": ("Pick", "in_world", "pick"),
    "og_pointcloud.fitting.pictures": ("feature_colors", "feature_picture", "instance_picture"),
    "og_pointcloud.runtime": ("LabelledScene", "Segmenter", "load", "segment", "use"),
    "og_pointcloud.scene": ("Camera",),
    "og_pointcloud.segmentation": ("UNKNOWN", "Segmentation"),
    "og_pointcloud.selecting": ("Match", "Selection", "select"),
    "og_pointcloud.settings": ("FitSettings",),
    "og_pointcloud.text.features": ("read_text_features",),
    "og_pointcloud_export": ("write_bundle",),
}  # fmt: skip
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}
_MODULES = frozenset({"edit"})
"""Modules used as they are: og.edit.remove."""


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return importlib.import_module(f"{__name__}.{name}")
    if name not in _HOME_OF:
        raise AttributeError(f"module 'og_pointcloud' has no attribute '{name}'")
    value = getattr(importlib.import_module(_HOME_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_MODULES})
