"""Picture of the losses of a fit in mode paper."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from og_pointcloud.formats.atomic import StrPath
from og_pointcloud.formats.images import require_cv2, write_png

WIDTH, HEIGHT, STRIP, MARGIN = 360, 200, 26, 10
"""Pixels of a plot, of the text strips above and below it, and of the margin beside its curve."""
CURVE = (31, 119, 180)


def training_picture(stages: Sequence[Mapping[str, Any]], path: StrPath) -> Path:
    """Write a PNG of each stage's losses against its steps, side by side.

    stages: ``cloud.provenance["notes"]["training"]``. Each has a scale of its own, from zero.
    """
    cv2 = require_cv2()
    panels = []
    for stage in stages:
        loss = np.repeat(stage["loss"], 2 if len(stage["loss"]) == 1 else 1)  # a single value becomes a level line
        panel = np.full((HEIGHT + 2 * STRIP, WIDTH, 3), 255, np.uint8)
        top = float(loss.max(initial=0.0)) or 1.0
        points = np.stack([np.linspace(MARGIN, WIDTH - MARGIN, len(loss)), STRIP + HEIGHT * (1 - loss / top)], axis=1)
        cv2.polylines(panel, [points.round().astype(np.int32)], False, CURVE, 2, cv2.LINE_AA)
        cv2.line(panel, (MARGIN, STRIP + HEIGHT), (WIDTH - MARGIN, STRIP + HEIGHT), (0, 0, 0), 1)
        steps = f"{stage['steps']:,} of {stage['published_steps']:,} steps"
        for text, bottom in ((f"{stage['stage']}: loss, 0 to {top:.3g}", STRIP), (steps, HEIGHT + 2 * STRIP)):
            cv2.putText(panel, text, (MARGIN, bottom - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
        panels.append(panel)
    return write_png(Path(path), np.concatenate(panels, axis=1))
