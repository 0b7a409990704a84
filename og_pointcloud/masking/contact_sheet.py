"""Masks drawn on their images, side by side: what a person looks at before a night of computing."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.formats.atomic import replacing
from og_pointcloud.formats.colors import label_colors
from og_pointcloud.formats.images import require_cv2

__all__ = ["drawn", "write_contact_sheet"]

CELL_WIDTH, COLUMNS = 480, 3
TINT = 0.55


def drawn(image: NDArray[np.uint8], ids: NDArray[np.int32]) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 RGB: the image tinted by mask, with white borders. ids: (H, W), -1 outside every mask."""
    tinted = image.astype(np.float32)
    inside = ids >= 0
    tinted[inside] = (1 - TINT) * tinted[inside] + TINT * label_colors(ids[inside])
    tinted[:, 1:][ids[:, 1:] != ids[:, :-1]] = 255
    tinted[1:][ids[1:] != ids[:-1]] = 255
    return tinted.astype(np.uint8)


def write_contact_sheet(path: Path, pictures: Sequence[tuple[NDArray[np.uint8], NDArray[np.int32]]]) -> None:
    """A PNG of images above the same with their masks. pictures: (H, W, 3) uint8 RGB and (H, W) ids of each."""
    cv2 = require_cv2()
    rows = []
    for first in range(0, len(pictures), COLUMNS):
        row = pictures[first : first + COLUMNS]
        cells = [np.vstack([image, drawn(image, ids)]) for image, ids in row]
        height = max(1, max(round(cell.shape[0] * CELL_WIDTH / cell.shape[1]) for cell in cells))
        sheet = np.zeros((height, CELL_WIDTH * min(COLUMNS, len(pictures)), 3), np.uint8)
        for column, cell in enumerate(cells):
            fitted = max(1, round(cell.shape[0] * CELL_WIDTH / cell.shape[1]))
            left = column * CELL_WIDTH
            sheet[:fitted, left : left + CELL_WIDTH] = cv2.resize(
                cell, (CELL_WIDTH, fitted), interpolation=cv2.INTER_AREA
            )
        rows.append(sheet)
    png = cv2.imencode(".png", cv2.cvtColor(np.vstack(rows), cv2.COLOR_RGB2BGR))[1]
    with replacing(path) as file:
        file.write(png.tobytes())
