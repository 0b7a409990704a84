"""How good a proposer's masks are, what a fit makes of them, and what they cost: one row a capture and level.

    python examples/benchmark_masks.py CAPTURE [CAPTURE ...] [--proposer opencv] [--levels LEVEL ...] [--every N]

The captures have masks and features of their own. Coverage: for each of these masks the best IoU with a mask of the
level; its mean, and the share over a half. Fit: the own features are
handed to the proposer's masks by overlap (means weighted by shared pixels; masks of which less than half lies in own
masks get none and are left out), fitted, and scored against ``gt.npz``. Without ``gt.npz`` the last columns are empty.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import og_pointcloud as og
from og_pointcloud.evaluate.truth import read_truth
from og_pointcloud.masking.contracts import LEVELS, MaskSettings
from og_pointcloud.masking.make_masks import MasksMade, make_masks
from og_pointcloud.scene import Scene, View
from og_pointcloud.text.text_features import read_text_features

SMALLEST_SHARE = 8e-4
"""Own masks of less of the image are not asked for."""
HEADER = f"{'capture':<18} {'level':<7} {'IoU':>6} {'> 0.5':>6} {'masks/image':>12} {'s/image':>8}"
FIT_HEADER = f" {'mIoU':>7} {'mAcc':>6} {'instances':>10} {'fit s':>6}"


def main(arguments: list[str] | None = None) -> None:
    """The table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path)
    parser.add_argument("--proposer", default="opencv")
    parser.add_argument("--levels", nargs="+", default=LEVELS, choices=LEVELS)
    parser.add_argument("--every", type=int, default=1, help="use every N-th image")
    options = parser.parse_args(arguments)
    print(HEADER + FIT_HEADER)
    for folder in options.captures:
        scene = og.read_capture(folder)
        for level in options.levels:
            settings = MaskSettings(options.proposer, encoder=None, level=level, every=options.every)
            with tempfile.TemporaryDirectory() as temporary:
                made = make_masks(folder, settings, temporary, progress=False)
                print(row(scene, folder, made, level), flush=True)


def row(scene: Scene, folder: Path, made: MasksMade, level: str) -> str:
    """Coverage and costs of the masks made, and of a fit on them where there is a truth."""
    own = {view.name: view for view in scene.views}
    views, found = [], []
    for view in og.read_capture(made.output).views:
        if view.name in own:
            shared = shared_pixels(view, own[view.name])
            found += best_iou(shared)
            views.append(with_own_features(view, own[view.name], shared))
    cells = (
        f"{folder.name:<18} {level:<7} {np.mean(found):6.3f} {np.mean(np.array(found) > 0.5):6.2f} "
        f"{made.masks / made.images:12.0f} {made.seconds / made.images:8.2f}"
    )
    return cells + (fit_cells(replace(scene, views=tuple(views)), folder) if (folder / "gt.npz").is_file() else "")


def shared_pixels(view: View, own: View) -> NDArray[np.int64]:
    """(masks + 1, own masks + 1): pixels that two masks share; row and column 0 are outside every mask."""
    ids, theirs = view.mask_map(), own.mask_map()
    rows, columns = (
        ((np.arange(count) + 0.5) * length / count).astype(int)
        for count, length in zip(ids.shape, theirs.shape, strict=True)
    )
    pair = (ids + 1).astype(np.int64) * (own.mask_count + 1) + theirs[rows[:, None], columns] + 1
    return np.bincount(pair.ravel(), minlength=(view.mask_count + 1) * (own.mask_count + 1)).reshape(
        view.mask_count + 1, -1
    )


def best_iou(shared: NDArray[np.int64]) -> list[float]:
    """For each own mask that is large enough, the best IoU with a mask."""
    area, own_area = shared.sum(axis=1, keepdims=True), shared.sum(axis=0)
    iou = (shared / np.maximum(area + own_area - shared, 1))[1:, 1:]
    return iou.max(axis=0, initial=0)[own_area[1:] >= SMALLEST_SHARE * shared.sum()].tolist()


def with_own_features(view: View, own: View, shared: NDArray[np.int64]) -> View:
    """The view with those masks that lie in own masks, and these masks' features."""
    inside = shared[1:, 1:]
    known = np.flatnonzero(inside.sum(axis=1) > 0.5 * shared[1:].sum(axis=1))
    weights = inside[known] / np.maximum(inside[known].sum(axis=1, keepdims=True), 1)
    new_row = np.full(view.mask_count + 1, -1, np.int32)  # the last entry serves -1
    new_row[known] = np.arange(len(known), dtype=np.int32)
    features = (weights @ own.mask_features).astype(np.float32)
    return replace(view, masks=new_row[view.mask_map()], mask_features=features)


def fit_cells(scene: Scene, folder: Path) -> str:
    """Scores of a fit on these masks."""
    start = time.perf_counter()
    cloud = og.fit(scene, progress=False)
    seconds = time.perf_counter() - start
    words, _ = read_text_features(folder / "text_features.npz")
    result = og.segment(replace(cloud, vocabulary=words), list(words.names))
    score = read_truth(folder).score(result.labels, result.names)
    return f" {score.miou:7.3f} {score.macc:6.3f} {len(cloud.instances):10} {seconds:6.1f}"


if __name__ == "__main__":
    main()
