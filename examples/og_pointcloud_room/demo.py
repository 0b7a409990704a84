"""The whole road on the procedural room: capture, fit, one file, words, a score beside its bounds, and pictures.

Twice: with the masks and features of a simulated proposer and encoder, and from the photographs alone.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from og_pointcloud_export import write_bundle

import og_pointcloud as og
from og_pointcloud.cloud import Vocabulary, WordBank
from og_pointcloud.evaluate.metrics import Score, adjusted_rand_index, score_labels
from og_pointcloud.fitting.fit import fit_prepared, prepare
from og_pointcloud.fitting.mask_table import MaskTable
from og_pointcloud.formats.capture import read_capture
from og_pointcloud.settings import FitSettings
from og_pointcloud_room.baselines import ceiling, direct_uplift
from og_pointcloud_room.capture import ABSENT_WORDS, CaptureSettings, RoomCapture, make_capture, write_capture
from og_pointcloud_room.furniture import CLASS_NAMES
from og_pointcloud_room.photographs import ABSENT, FromPhotographs, label_from_photographs
from og_pointcloud_room.pictures import can_render, draw_instances, draw_labels, draw_views

__all__ = ["DemoResult", "MethodScore", "run_demo"]

SHOWN_VIEWS = (0.0, 0.2, 0.62, 0.82)
"""Where along the path the views of the contact sheet lie."""


@dataclass(frozen=True)
class MethodScore:
    """One row of the demo's table.

    absent_called: of all points, the share that gets a label when it is asked for words that nothing in the room is.
    seconds: wall clock from the scene in memory to a label per point; None if given.
    """

    name: str
    score: Score
    absent_called: float
    seconds: float | None


@dataclass(frozen=True)
class DemoResult:
    """What the demo wrote and measured.

    methods: direct uplift, og_pointcloud, ceiling, and, if asked for, og_pointcloud from photographs.
    share_of_the_way: of the distance in mIoU from uplift to ceiling, how much og_pointcloud covers (NaN where uplift is
    already at the ceiling). instance_agreement: adjusted Rand index of its instances with the true ones, on labelled
    points. seconds: wall clock per stage of the demo.
    """

    output: Path
    bundle: Path
    pictures: tuple[Path, ...]
    methods: tuple[MethodScore, ...]
    share_of_the_way: float
    instance_agreement: float
    seconds: dict[str, float]


def run_demo(
    output: Path, seed: int = 0, mask_noise: float = 1.0, pictures: bool = True, photographs: bool = False
) -> DemoResult:
    """Makes a room in ``output``/capture, fits it, writes ``output``/room.ogpc, asks it for every class and scores it.

    seed: another room. mask_noise: 0 for a perfect proposer, 1 the default, more for worse. pictures: also draw
    views.png, instances.png and labels.png, where PyVista can render off-screen. photographs: also label the room from
    its images alone, masks by OpenCV, features and typed words by the demo encoder, into ``output``/photographs.
    Prints one line per stage and a table.
    """
    seconds: dict[str, float] = {}
    with _stage("make the room", seconds):
        capture = make_capture(seed, CaptureSettings(mask_noise=mask_noise))
        folder = write_capture(capture, output / "capture")
    settings = FitSettings(seed=seed)
    with _stage("read the capture", seconds):
        scene = read_capture(folder)
    with _stage("render the masks", seconds):
        prepared = prepare(scene, settings)
    with _stage("fit", seconds):
        cloud = fit_prepared(prepared, settings)
    bundle = output / "room.ogpc"
    with _stage("write one file", seconds):
        words, bank = Vocabulary(CLASS_NAMES, capture.text_vectors), WordBank(capture.bank_vectors)
        write_bundle(replace(cloud, vocabulary=words, word_bank=bank), bundle)
    with _stage("segment by words", seconds):
        loaded = og.load(bundle)
        result = og.segment(capture.xyz, CLASS_NAMES, scene=loaded)
    with _stage("ask absent words", seconds):
        called = _absent_called(loaded, capture)
    with _stage("baselines", seconds):
        baselines = _baselines(prepared.table, seconds["render the masks"], capture)
    ours_seconds = sum(seconds[name] for name in ("render the masks", "fit", "write one file", "segment by words"))
    ours_row = MethodScore("og_pointcloud", _score(result.labels, capture), called, ours_seconds)
    methods = (baselines[0], ours_row, baselines[1])
    uplift, ours, best = (method.score.miou for method in methods)
    seen = None
    if photographs:
        print("\nfrom photographs alone: masks by OpenCV, features and typed words by the demo encoder", flush=True)
        seen = label_from_photographs(folder, output / "photographs", seed=seed)
        seconds |= {f"photographs: {name}": value for name, value in seen.seconds.items()}
        own_seconds = sum(seen.seconds.values())
        methods += (MethodScore("from photographs alone", seen.score, seen.absent_called, own_seconds),)
    written: tuple[Path, ...] = ()
    if pictures:
        with _stage("draw pictures", seconds):
            written = _draw(output, capture, result.labels, result.instances)
            written += _draw_photographs(output, capture, seen) if seen else ()
    share = (ours - uplift) / (best - uplift) if best > uplift else float("nan")
    labelled = capture.instance >= 0
    agreement = adjusted_rand_index(result.instances[labelled], capture.instance[labelled])
    demo = DemoResult(output, bundle, written, methods, share, agreement, seconds)
    _report(demo)
    return demo


def _absent_called(scene: og.LabelledScene, capture: RoomCapture) -> float:
    absent = {f"absent {number}": vector for number, vector in enumerate(capture.absent_vectors)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that no point has a label is what is hoped for
        return float((og.segment(capture.xyz, absent, scene=scene).labels >= 0).mean())


def _baselines(table: MaskTable, render_s: float, capture: RoomCapture) -> tuple[MethodScore, MethodScore]:
    """Direct uplift on the mask table that the fit works on, and the ceiling on the truth."""
    features = np.concatenate(capture.mask_features)

    def uplift(texts: np.ndarray) -> np.ndarray:
        return direct_uplift(table.weights, table.mask_features, texts)

    def best(texts: np.ndarray) -> np.ndarray:
        return ceiling(features, capture.mask_instance, texts, capture.instance)

    start = time.perf_counter()
    labels = uplift(capture.text_vectors)
    seconds = render_s + time.perf_counter() - start
    uplift_called, best_called = (float((ask(capture.absent_vectors) >= 0).mean()) for ask in (uplift, best))
    return (
        MethodScore("direct uplift", _score(labels, capture), uplift_called, seconds),
        MethodScore("ceiling: true instances", _score(best(capture.text_vectors), capture), best_called, None),
    )


def _score(labels: np.ndarray, capture: RoomCapture) -> Score:
    return score_labels(labels, capture.cls, background=capture.background)


def _draw(output: Path, capture: RoomCapture, labels: np.ndarray, instances: np.ndarray) -> tuple[Path, ...]:
    """The three pictures, or the first alone where nothing can be rendered."""
    views, by_instance, by_label = (output / f"{name}.png" for name in ("views", "instances", "labels"))
    chosen = [int(place * len(capture.frames)) for place in SHOWN_VIEWS]
    draw_views(views, [capture.frames[index].image for index in chosen], [capture.masks[index] for index in chosen])
    if not can_render():
        print("no pictures of the cloud: off-screen rendering needs EGL or OSMesa (Debian: apt install libegl1 libgl1)")
        return (views,)
    draw_instances(by_instance, capture.xyz, capture.rgb, instances)
    # Flying pixels and outliers have no truth to be held against; they are shown among the instances.
    known = (capture.cls >= 0) | capture.background
    draw_labels(
        by_label, capture.xyz[known], capture.rgb[known], labels[known], capture.cls[known], CLASS_NAMES,
        instance_ids=instances[known],
    )  # fmt: skip
    return (views, by_instance, by_label)


def _draw_photographs(output: Path, capture: RoomCapture, seen: FromPhotographs) -> tuple[Path, ...]:
    if not can_render():
        return (seen.preview,)
    path, known = output / "from_photographs.png", (capture.cls >= 0) | capture.background
    draw_labels(
        path, capture.xyz[known], capture.rgb[known], seen.labels[known], capture.cls[known], CLASS_NAMES,
        instance_ids=seen.instance_ids[known],
    )  # fmt: skip
    return seen.preview, path


@contextmanager
def _stage(name: str, seconds: dict[str, float]) -> Iterator[None]:
    start = time.perf_counter()
    yield
    seconds[name] = time.perf_counter() - start
    print(f"{name:<18} {seconds[name]:6.1f} s", flush=True)


def _report(demo: DemoResult) -> None:
    print(
        f"\n{'method':<24} {'mIoU':>7} {'mAcc':>7} {'unknown':>8} {'background called':>18} {'absent called':>14} "
        f"{'seconds':>8}"
    )
    for method in demo.methods:
        score = method.score
        called = "-" if score.background_called is None else f"{score.background_called:.4f}"
        seconds = "-" if method.seconds is None else f"{method.seconds:.1f}"
        print(
            f"{method.name:<24} {score.miou:7.4f} {score.macc:7.4f} {score.unknown_share:8.4f} {called:>18} "
            f"{method.absent_called:14.4f} {seconds:>8}"
        )
    print(
        f"absent called: of all points, the share that gets one of {ABSENT_WORDS} words that nothing in the room is "
        f"(from photographs: one of {len(ABSENT)} typed ones); og_pointcloud judges them by its word bank"
    )
    print(f"og_pointcloud goes {demo.share_of_the_way:.1%} of the way from direct uplift to the ceiling")
    print(f"agreement of its instances with the true ones (adjusted Rand index): {demo.instance_agreement:.3f}\n")
    print(f"wrote {demo.bundle} ({demo.bundle.stat().st_size / 1e6:.1f} MB)")
    for picture in demo.pictures:
        print(f"wrote {picture}")
    words = "chair,mug,potted plant"
    print(f'total {sum(demo.seconds.values()):.1f} s; next: og-pointcloud segment {demo.bundle} --labels "{words}"')
