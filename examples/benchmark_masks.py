"""How good mask proposals are, and what a fit makes of them: one row a capture and way of making masks.

    python examples/benchmark_masks.py CAPTURE [CAPTURE ...] [--proposer opencv] [--options depth split ...]

The captures have masks and features of their own. Coverage: for each of these masks the best IoU with any proposal,
and with any mask of a level (agreed: the scale that other views confirm); its mean, and the share over a half. Fit: the
own features are handed to the proposals by overlap (means weighted by shared pixels; proposals of which less than half
lies in masks get none and are left out), fitted, and scored against ``gt.npz``. Only every N-th image is used where
--every says so.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from score_captures import score_of

import og_pointcloud as og
from og_pointcloud.masking.agreement import agreement, points_of_proposals, rescored
from og_pointcloud.masking.contracts import DepthMaskProposer, Proposals
from og_pointcloud.masking.image_worker import AGREEMENT_POINTS
from og_pointcloud.masking.levels import AGREED, LEVELS, Level, settle
from og_pointcloud.masking.opening import open_proposer
from og_pointcloud.masking.refine import rendered_depth, smallest_mask_px, split_at_depth_edges
from og_pointcloud.rendering.geometry import neighbourhood, sample_of_points
from og_pointcloud.scene import Scene, View
from og_pointcloud.settings import GeometrySettings
from og_pointcloud.text.text_features import read_text_features

WAYS = ("plain", "depth", "split", "tiny")
SMALLEST_SHARE = 8e-4
"""Own masks of less of the image are not asked for."""


def main(arguments: list[str] | None = None) -> None:
    """A row per capture and way; then, with --fit, a row per level."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path)
    parser.add_argument("--proposer", default="opencv")
    parser.add_argument("--ways", nargs="+", default=list(WAYS), choices=WAYS)
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--fit", action="store_true")
    options = parser.parse_args(arguments)
    print("capture          way     all masks      " + "".join(f"{level:<15}" for level in LEVELS) + " s/image  masks")
    for folder in options.captures:
        scene = og.read_capture(folder)
        scene = replace(scene, views=scene.views[:: options.every])
        for way in options.ways:
            settled = print_coverage(scene, folder.name, way, options.proposer)
            for level in (*LEVELS, *AGREED) if options.fit else ():
                print_fit(scene, folder, [levels[level] for levels in settled], level)


def print_coverage(scene: Scene, name: str, way: str, proposer: str) -> list[dict[str, Level]]:
    """The levels of every view, and a row: mean best IoU / share over a half."""
    model, spacing = open_proposer(proposer), neighbourhood(scene.points.xyz, GeometrySettings()).spacing
    best: dict[str, list[float]] = {key: [] for key in ("all", *LEVELS)}
    settled, kept, seconds = [], [], 0.0
    for view in scene.views:
        image = view.image_rgb()
        assert image is not None
        depth = rendered_depth(scene.points.xyz, spacing, view.camera) if way in ("depth", "split") else None
        start = time.perf_counter()
        if way == "depth" and isinstance(model, DepthMaskProposer):
            proposals = model.propose_with_depth(image, depth)
        else:
            proposals = model.propose(image)
        if way == "split" and depth is not None:
            proposals = split_at_depth_edges(proposals, depth)
        smallest = smallest_mask_px(scene.points.xyz, spacing, view.camera) if way == "tiny" else 1
        settled.append(settle(proposals, smallest))
        seconds += time.perf_counter() - start
        kept.append((np.packbits(proposals.masks, axis=2), proposals.scores, smallest))
        best["all"] += best_iou(proposals, view)
        for level in LEVELS:
            best[level] += level_iou(settled[-1][level], view)
    cells = "".join(f"{np.mean(iou):6.3f} /{np.mean(np.array(iou) > 0.5):5.2f}  " for iou in best.values())
    masks = np.mean([len(levels["middle"].proposals) for levels in settled])
    print(f"{name:<16} {way:<6} {cells} {seconds / len(settled):6.2f} {masks:6.0f}", flush=True)
    add_agreed(scene, spacing, kept, settled)
    return settled


def add_agreed(scene: Scene, spacing: np.ndarray, kept: list[tuple], settled: list[dict[str, Level]]) -> None:
    """The level on which views agree, and a row for it. kept: packed masks, scores and the fewest pixels of a view."""
    start = time.perf_counter()
    asked = sample_of_points(scene.points.xyz, AGREEMENT_POINTS)

    def proposals(index: int) -> Proposals:
        packed, scores, _ = kept[index]
        return Proposals(np.unpackbits(packed, axis=2, count=scene.views[index].camera.width).astype(bool), scores)

    points = [
        points_of_proposals(proposals(index), scene.points.xyz, spacing, asked, view.camera)
        for index, view in enumerate(scene.views)
    ]
    found = agreement(points, len(asked))
    usual = float(np.nanmedian(np.concatenate(found)))
    for index, (_, scores, smallest) in enumerate(kept):
        again = replace(proposals(index), scores=rescored(scores, found[index], usual))
        settled[index] |= settle(again, smallest, AGREED)
    seconds = (time.perf_counter() - start) / len(kept)
    best = [iou for view, levels in zip(scene.views, settled, strict=True) for iou in level_iou(levels["agreed"], view)]
    masks = np.mean([len(levels["agreed"].proposals) for levels in settled])
    print(
        f"  agreed {np.mean(best):6.3f} /{np.mean(np.array(best) > 0.5):5.2f}, {masks:.0f} masks, median agreement "
        f"{usual:.2f}, {seconds:.2f} s/image more",
        flush=True,
    )


def level_iou(level: Level, view: View) -> list[float]:
    """As `best_iou`, of the masks that a level shows."""
    masks = level.masks()
    return best_iou(Proposals(masks, np.ones(len(masks), np.float32)), view)


def best_iou(proposals: Proposals, view: View) -> list[float]:
    """For each own mask of a view that is large enough, the best IoU with a proposal."""
    ids = view.mask_map()
    flat = proposals.masks.reshape(len(proposals), ids.size)
    area, found = flat.sum(axis=1), []
    for mask in range(view.mask_count):
        own = (ids == mask).ravel()
        if own.sum() >= SMALLEST_SHARE * own.size:
            shared = flat[:, own].sum(axis=1)
            found.append(float(np.max(shared / (area + own.sum() - shared), initial=0)))
    return found


def with_own_features(view: View, level: Level) -> View:
    """The view with a level's masks; features by overlap with its own masks."""
    own = view.mask_map()
    masks = len(level.proposals)
    pair = (level.ids + 1).astype(np.int64) * (view.mask_count + 1) + own + 1
    shared = np.bincount(pair.ravel(), minlength=(masks + 1) * (view.mask_count + 1)).reshape(masks + 1, -1)[1:]
    known = np.flatnonzero(shared[:, 1:].sum(axis=1) > 0.5 * shared.sum(axis=1))
    weights = shared[known, 1:] / np.maximum(shared[known, 1:].sum(axis=1, keepdims=True), 1)
    row = np.full(masks + 1, -1, np.int32)
    row[known] = np.arange(len(known), dtype=np.int32)
    return replace(view, masks=row[level.ids], mask_features=(weights @ view.mask_features).astype(np.float32))


def print_fit(scene: Scene, folder: Path, levels: list[Level], name: str) -> None:
    """Scores of a fit on one level's masks."""
    views = tuple(with_own_features(view, level) for view, level in zip(scene.views, levels, strict=True))
    start = time.perf_counter()
    cloud = og.fit(replace(scene, views=views), progress=False)
    seconds = time.perf_counter() - start
    words, _ = read_text_features(folder / "text_features.npz")
    result = og.segment(replace(cloud, vocabulary=words), list(words.names))
    score = score_of(result.labels, result.names, folder)
    print(
        f"  fit on {name:<7} mIoU {score.miou:.3f}  mAcc {score.macc:.3f}  "
        f"{np.mean([len(level.proposals) for level in levels]):.0f} masks, {len(cloud.instances)} instances, "
        f"{seconds:.1f} s",
        flush=True,
    )


if __name__ == "__main__":
    main()
