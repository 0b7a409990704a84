"""The demo from photographs alone: images -> masks -> features -> fit -> one file -> typed words -> labels.

Masks come from a proposer that needs no weights, features and words from the demo encoder that comes with the library:
only the room is simulated, and nothing is downloaded. The truth is used for scoring only.
"""

from __future__ import annotations

import sys
import warnings
from dataclasses import dataclass
from pathlib import Path

from og_pointcloud_export import write_bundle

import og_pointcloud as og
from og_pointcloud.evaluate.metrics import Score, score_labels
from og_pointcloud.evaluate.truth import read_truth
from og_pointcloud.fitting.fit import fit
from og_pointcloud.formats.capture import read_capture
from og_pointcloud.masking.make_masks import PREVIEW_NAME, MaskSettings, make_masks
from og_pointcloud.settings import FitSettings
from og_pointcloud.text.encoder import DEMO_ENCODER
from og_pointcloud_room.furniture import CLASS_NAMES
from og_pointcloud_room.stages import stage

ABSENT = (
    "anvil", "armadillo", "bagpipes", "bobsled", "boomerang", "catapult", "chainsaw", "geyser", "gondola", "harpoon",
    "hovercraft", "iceberg", "igloo", "jellyfish", "parachute", "periscope", "pyramid", "rocket", "snorkel",
    "stethoscope", "tarantula", "unicycle", "volcano", "walrus", "zeppelin",
)  # fmt: skip
"""Words for nothing in the room, queried as well. The demo encoder was not trained on any of them."""


@dataclass(frozen=True)
class FromPhotographs:
    """The outcome. masks: of all images. result: the room's points labelled by CLASS_NAMES. absent_called: share of all
    points that get a label when labelled by ABSENT. preview: some images with their masks drawn in. seconds: wall clock
    per stage."""

    bundle: Path
    masks: int
    result: og.Segmentation
    score: Score
    absent_called: float
    preview: Path
    seconds: dict[str, float]


def label_from_photographs(capture: Path, output: Path, proposer: str = "opencv", seed: int = 0) -> FromPhotographs:
    """Label a capture of a room, from ``write_capture``, by the names of its classes as typed words.

    Only images, poses, points and the truth of the capture are used; ``output`` becomes a separate capture with the
    masks made here, and gets ``room.ogpc``, which carries the words' encoder. proposer: as for `og-pointcloud masks`;
    or the capture's own ``masks`` folder for the masks of the demo's simulated proposer.
    """
    seconds: dict[str, float] = {}
    output.mkdir(parents=True, exist_ok=True)
    with stage("masks and features", seconds):
        made = make_masks(capture, MaskSettings(proposer=proposer, encoder="demo"), output, overwrite=True)
    with stage("read the capture", seconds):
        scene = read_capture(output)
    with stage("fit", seconds):
        cloud = fit(scene, FitSettings(seed=seed), progress=sys.stderr.isatty())
    bundle = output / "room.ogpc"
    with stage("write one file", seconds):
        write_bundle(cloud, bundle, text_encoder=DEMO_ENCODER / "text")
    truth = read_truth(capture)
    with stage("typed words to labels", seconds):
        loaded = og.load(bundle)
        result = og.segment(loaded.xyz, CLASS_NAMES, scene=loaded)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # warns that no point has a label, as hoped
        called = float((og.segment(loaded, ABSENT).labels >= 0).mean())
    score = score_labels(result.labels, truth.cls, background=truth.background)
    return FromPhotographs(bundle, made.masks, result, score, called, output / PREVIEW_NAME, seconds)
