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

Importing costs little: each name is fetched from its module on first use. Only what fits, maps, compares, reads images
and other programs' results, writes bundles or draws pictures needs more than numpy and onnxruntime (the extra 'fit').
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from og_pointcloud_export import write_bundle

    from og_pointcloud.ask.boxes import Box, axis_aligned_box, oriented_box
    from og_pointcloud.ask.choosing import Reason
    from og_pointcloud.ask.instances import Instance, Instances
    from og_pointcloud.ask.labelled_scene import LabelledScene, Segmenter, instance_table, load, segment
    from og_pointcloud.ask.picking import Pick, in_world, pick
    from og_pointcloud.ask.segmentation import Segmentation
    from og_pointcloud.ask.selecting import Match, Selection, select
    from og_pointcloud.bundle.read import read_bundle
    from og_pointcloud.cloud import (
        BACKGROUND,
        TOO_FAR,
        UNKNOWN,
        UNOBSERVED,
        InstanceTable,
        LabelledCloud,
        Vocabulary,
        WordBank,
    )
    from og_pointcloud.collection.collection import Collection, Finding, Findings
    from og_pointcloud.collection.fit_many import CaptureFit, FitOptions, fit_many
    from og_pointcloud.errors import BundleError, FeatureSpaceError, MissingExtraError, OgPointcloudError, SceneError
    from og_pointcloud.fitting.fit import fit
    from og_pointcloud.fitting.opengaussian import read_opengaussian
    from og_pointcloud.formats.capture import read_capture
    from og_pointcloud.formats.points import read_points
    from og_pointcloud.mapping.changes import Changes, Moved, compare
    from og_pointcloud.mapping.frame import Frame
    from og_pointcloud.mapping.mapper import Mapper
    from og_pointcloud.mapping.merging import update
    from og_pointcloud.scene import Camera
    from og_pointcloud.settings import FitSettings
    from og_pointcloud.show import edit as edit
    from og_pointcloud.text.text_features import read_text_features

__version__ = "0.1.0"

__all__ = [
    "BACKGROUND", "TOO_FAR", "UNKNOWN", "UNOBSERVED", "Box", "BundleError", "Camera", "CaptureFit", "Changes",
    "Collection", "FeatureSpaceError", "Finding", "Findings", "FitOptions", "FitSettings", "Frame", "Instance",
    "InstanceTable", "Instances", "LabelledCloud", "LabelledScene", "Mapper", "Match", "MissingExtraError", "Moved",
    "OgPointcloudError", "Pick", "Reason", "SceneError", "Segmentation", "Segmenter", "Selection", "Vocabulary",
    "WordBank", "axis_aligned_box", "compare", "fit", "fit_many", "in_world",
    "instance_table", "load", "oriented_box", "pick", "read_bundle", "read_capture", "read_opengaussian", "read_points",
    "read_text_features", "segment", "select", "update", "write_bundle",
]  # fmt: skip

_HOMES = {
    "og_pointcloud.ask.boxes": ("Box", "axis_aligned_box", "oriented_box"),
    "og_pointcloud.ask.choosing": ("Reason",),
    "og_pointcloud.ask.instances": ("Instance", "Instances"),
    "og_pointcloud.ask.labelled_scene": ("LabelledScene", "Segmenter", "instance_table", "load", "segment"),
    "og_pointcloud.ask.picking": ("Pick", "in_world", "pick"),
    "og_pointcloud.ask.segmentation": ("Segmentation",),
    "og_pointcloud.ask.selecting": ("Match", "Selection", "select"),
    "og_pointcloud.bundle.read": ("read_bundle",),
    "og_pointcloud.cloud": (
        "BACKGROUND", "TOO_FAR", "UNKNOWN", "UNOBSERVED", "InstanceTable", "LabelledCloud", "Vocabulary", "WordBank",
    ),
    "og_pointcloud.collection.collection": ("Collection", "Finding", "Findings"),
    "og_pointcloud.collection.fit_many": ("CaptureFit", "FitOptions", "fit_many"),
    "og_pointcloud.errors": (
        "BundleError", "FeatureSpaceError", "MissingExtraError", "OgPointcloudError", "SceneError",
    ),
    "og_pointcloud.fitting.fit": ("fit",),
    "og_pointcloud.fitting.opengaussian": ("read_opengaussian",),
    "og_pointcloud.formats.capture": ("read_capture",),
    "og_pointcloud.formats.points": ("read_points",),
    "og_pointcloud.mapping.changes": ("Changes", "Moved", "compare"),
    "og_pointcloud.mapping.frame": ("Frame",),
    "og_pointcloud.mapping.mapper": ("Mapper",),
    "og_pointcloud.mapping.merging": ("update",),
    "og_pointcloud.scene": ("Camera",),
    "og_pointcloud.settings": ("FitSettings",),
    "og_pointcloud.text.text_features": ("read_text_features",),
    "og_pointcloud_export": ("write_bundle",),
}  # fmt: skip
"""Module -> the public names that it defines; the imports above say the same to type checkers and editors."""
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name == "edit":  # a module used as it is: og.edit.remove
        return importlib.import_module("og_pointcloud.show.edit")
    if name not in _HOME_OF:
        raise AttributeError(f"module 'og_pointcloud' has no attribute '{name}'")
    try:
        value = getattr(importlib.import_module(_HOME_OF[name]), name)
    except ModuleNotFoundError as error:
        from og_pointcloud.errors import missing_extra

        raise missing_extra(error) or error from None
    globals()[name] = value  # found at once from now on: Python asks __getattr__ only for what is not there
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, "edit"})
