"""A scene as one self-contained HTML page: rotate it, query it by clicks and words, switch labels on and off.

page.html is the template; the data is inserted as JSON, arrays as deflated base64. Needs numpy alone.
"""

from __future__ import annotations

import base64
import json
import zlib
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.ask.boxes import axis_aligned_box
from og_pointcloud.ask.choosing import Reason
from og_pointcloud.ask.labelled_scene import LabelledScene, instance_table
from og_pointcloud.ask.segmentation import Segmentation
from og_pointcloud.errors import OgPointcloudError, coordinate, counted
from og_pointcloud.formats.atomic import StrPath, write_file
from og_pointcloud.formats.colors import NO_LABEL, label_colors
from og_pointcloud.show.live import MAX_WORDS_SHOWN, meaning, meaning_of
from og_pointcloud.show.viewpoint import Viewpoint, are_no_strays

TEMPLATE = Path(__file__).with_name("page.html")
MAX_POINTS = 2_000_000
"""Points of a page, about 16 MB; larger clouds are subsampled evenly."""
MAX_SCORES = 4_000_000
"""Scores of words on instances that a page holds; with more, it has no word search."""
QUANTIZATION_STEPS = 65535
"""Steps of 16-bit coordinates and scores: positions are off by at most half a step, 1/131,000 of the cloud's extent."""


@dataclass(frozen=True)
class Look:
    """Initial state of a page; a click changes all but the title.

    mode: what colors show, "labels", "instances" or "photo". boxes: whether they are shown. cut: share of the height
    hidden from the top, 0 to 1. colors: RGB of each label; left out, by its index. unlabelled: name of points without a
    label.
    """

    title: str
    mode: str = "labels"
    boxes: bool = False
    cut: float = 0.0
    colors: tuple[tuple[int, int, int], ...] = ()
    unlabelled: str = "unknown"


def write_page(
    path: StrPath,
    scene: LabelledScene,
    result: Segmentation,
    view: Viewpoint,
    look: Look,
    rgb: NDArray[np.uint8] | None = None,
) -> str:
    """Write the page atomically; returns what it leaves out, in words, empty if nothing.

    result: of ``scene``, at least one finite point. rgb: (N, 3) colors of its points.
    """
    finite = np.flatnonzero(np.isfinite(result.xyz).all(axis=1))
    if len(finite) == 0:
        raise OgPointcloudError(f"none of {len(result)} points has finite coordinates; expected at least one")
    finite = finite[are_no_strays(result.xyz[finite])]  # the steps of places span all that is shown
    shown = finite[np.linspace(0, len(finite) - 1, min(len(finite), MAX_POINTS)).astype(np.int64)]
    left_out = [f"{len(result) - len(shown):,} of {len(result):,} points"] if len(shown) < len(result) else []
    words, word_data = _words(scene)
    if not words and scene.vocabulary and scene.vocabulary.names:
        left_out.append(
            f"the search for {len(scene.vocabulary.names):,} words: too many for {len(scene.instances)} instances"
        )
    xyz = result.xyz[shown]
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    middle = low + (high - low) / 2
    instances = int((scene.cloud.instances.points > 0).sum())
    data = {
        "subtitle": f"{counted(len(shown), 'point')} · {counted(instances, 'instance')}",
        **asdict(look), "meaning": meaning(result.calibrated),
        "grey": NO_LABEL, "hues": label_colors(np.arange(len(scene.instances))).tolist(),
        "spacing": scene.cloud.spacing * (len(finite) / len(shown)) ** 0.5,  # points lie on surfaces: two dimensions
        "low": (low - middle).tolist(), "size": (high - low).tolist(),
        "corners": axis_aligned_box([low - middle, high - middle]).corners.tolist(),
        "extent": float(np.linalg.norm(high - low)) or 1.0,
        "eye": (view.eye - middle).tolist(), "target": (view.target - middle).tolist(), "up": view.up.tolist(),
        "names": list(result.names), "colors": look.colors or label_colors(np.arange(len(result.names))).tolist(),
        "counts": list(result.counts().values()), "unknown": int((result.labels < 0).sum()),
        "reasons": [str(Reason.TOO_FAR), str(Reason.UNOBSERVED), str(Reason.IN_NO_MASK)],  # of ids -3, -2, -1
        "instances": _instances(scene, result, view.up, middle, word_data.pop("choice")),
        "points": len(shown), "has_rgb": rgb is not None,
        "place": _packed(_quantized(xyz, low, high)), "instance": _packed(result.instances[shown].astype("<i4")),
        "rgb": _packed(np.full((len(shown), 3), 200, np.uint8) if rgb is None else np.asarray(rgb, np.uint8)[shown]),
        "words": words, **word_data,
    }  # fmt: skip
    # Names come from files: none may close the HTML element that contains it.
    text = json.dumps(data, ensure_ascii=False, allow_nan=False).replace("<", "\\u003c")
    page = TEMPLATE.read_text(encoding="utf-8").replace("/*SCENE*/", text)
    write_file(path, page.encode(errors="backslashreplace"))
    return " and ".join(left_out)


def _words(scene: LabelledScene) -> tuple[list[str], dict[str, Any]]:
    """The scene's own words; their scores on each instance, and the word chosen for each instance, if any."""
    own, count = scene.vocabulary, len(scene.instances)
    nothing = {"choice": np.full(count, -1), "word_scores": "", "lowest": 0.0, "highest": 1.0}
    if own is None or not own.names or count * len(own.names) > MAX_SCORES:
        return [], nothing
    choice = scene.chooser.choose(own.vectors)
    scores = np.where(np.isfinite(choice.scores), choice.scores, 0).astype(np.float64)
    low, high = float(scores.min(initial=0)), float(scores.max(initial=1))
    packed = _packed(_quantized(scores, np.float64(low), np.float64(high)))
    return list(own.names), {"choice": choice.labels, "word_scores": packed, "lowest": low, "highest": high}


def _instances(
    scene: LabelledScene,
    result: Segmentation,
    up: NDArray[np.float64],
    middle: NDArray[np.float64],
    choice: NDArray[np.integer],
) -> list[dict[str, Any]]:
    # All points of an instance have the same label: that of its first point.
    present, first, counts = np.unique(result.instances, return_index=True, return_counts=True)
    shown = dict(zip(present.tolist(), zip(result.labels[first].tolist(), counts.tolist(), strict=True), strict=True))
    rows = []
    for row in instance_table(scene, up=up, words=MAX_WORDS_SHOWN):
        label, points = shown.get(row.id, (-1, 0))
        record: dict[str, Any] = {
            "id": row.id, "label": label, "points": points, "views": row.views, "words": row.words,
            "choice": int(choice[row.id]), "note": meaning_of(row, result.calibrated),
        }  # fmt: skip
        if points and row.oriented_box is not None and row.centroid is not None:
            record |= {
                "box": (row.oriented_box.corners - middle).tolist(), "extent": row.oriented_box.size.tolist(),
                "center": (row.centroid - middle).tolist(), "world": ", ".join(map(coordinate, row.centroid)),
            }  # fmt: skip
        rows.append(record)
    return rows


def _quantized(values: NDArray[np.float64], low: Any, high: Any) -> NDArray[np.uint16]:
    return np.rint((values - low) / np.where(high > low, high - low, 1) * QUANTIZATION_STEPS).astype("<u2")


def _packed(array: NDArray[Any]) -> str:
    return base64.b64encode(zlib.compress(np.ascontiguousarray(array).tobytes(), 6)).decode()
