"""The demo: the procedural room captured, fitted, written to one file, queried by words, scored and drawn.

Twice: with the masks and features of a simulated proposer and encoder, and from the photographs alone.
"""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from og_pointcloud_export import write_bundle

import og_pointcloud as og
from og_pointcloud.cli.common import print_next
from og_pointcloud.cloud import Vocabulary, WordBank
from og_pointcloud.evaluate.baselines import direct_uplift
from og_pointcloud.evaluate.metrics import Score, adjusted_rand_index, score_labels
from og_pointcloud.fitting.fit import Prepared, fit_prepared, prepare
from og_pointcloud.formats.capture import read_capture
from og_pointcloud.settings import FitSettings
from og_pointcloud_room.capture import ABSENT_WORDS, CaptureSettings, RoomCapture, make_capture, write_capture
from og_pointcloud_room.furniture import CLASS_NAMES
from og_pointcloud_room.photographs import ABSENT, FromPhotographs, label_from_photographs
from og_pointcloud_room.pictures import draw_clouds, draw_views
from og_pointcloud_room.stages import stage

SHOWN_VIEWS = (0.0, 0.2, 0.62, 0.82)
"""Positions along the path of the views on the contact sheet."""


@dataclass(frozen=True)
class MethodScore:
    """One row of the demo's table.

    absent_called: share of all points that get a label when the words name nothing in the room.
    seconds: wall clock from the scene in memory to a label per point; None if given.
    """

    name: str
    score: Score
    absent_called: float
    seconds: float | None


@dataclass(frozen=True)
class DemoResult:
    """What the demo wrote and measured.

    methods: direct uplift, og_pointcloud, ceiling, and, on request, og_pointcloud from photographs.
    share_of_the_way: share of the mIoU difference between uplift and ceiling that og_pointcloud gains (NaN where uplift
    is already at the ceiling). instance_agreement: adjusted Rand index of its instances with the true ones, on labelled
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
    """Makes a room in ``output``/capture, fits it, writes ``output``/room.ogpc, labels it by all classes and scores it.

    seed: of the room. mask_noise: 0 for a perfect proposer, 1 the default, more for worse. pictures: also draw
    views.png, instances.png and labels.png, where PyVista can render off-screen. photographs: also label the room from
    its images alone, masks by OpenCV, features and typed words by the demo encoder, into ``output``/photographs.
    Prints one line per stage and a table.
    """
    seconds: dict[str, float] = {}
    settings = FitSettings(seed=seed)
    with stage("make the room", seconds):
        capture = make_capture(seed, CaptureSettings(mask_noise=mask_noise))
        folder = write_capture(capture, output / "capture")
    with stage("read the capture", seconds):
        scene = read_capture(folder)
    with stage("render the masks", seconds):
        prepared = prepare(scene, settings)
    with stage("fit", seconds):
        cloud = fit_prepared(prepared, settings)
    bundle = output / "room.ogpc"
    with stage("write one file", seconds):
        words, bank = Vocabulary(CLASS_NAMES, capture.text_vectors), WordBank(capture.bank_vectors)
        write_bundle(replace(cloud, vocabulary=words, word_bank=bank), bundle)
    with stage("segment by words", seconds):
        loaded = og.load(bundle)
        result = og.segment(capture.xyz, CLASS_NAMES, scene=loaded)
    with stage("ask absent words", seconds):
        called = _absent_called(loaded, capture)
    with stage("baselines", seconds):
        plain, best = _baselines(prepared, seconds["render the masks"], capture)
    ours_seconds = sum(seconds[name] for name in ("render the masks", "fit", "write one file", "segment by words"))
    ours = MethodScore("og_pointcloud", _score(result.labels, capture), called, ours_seconds)
    methods, seen = (plain, ours, best), None
    if photographs:
        print("\nfrom photographs alone: masks by OpenCV, features and typed words by the demo encoder", flush=True)
        seen = label_from_photographs(folder, output / "photographs", seed=seed)
        seconds |= {f"photographs: {name}": value for name, value in seen.seconds.items()}
        total = sum(seen.seconds.values())
        methods += (MethodScore("from photographs alone", seen.score, seen.absent_called, total),)
    written: tuple[Path, ...] = ()
    if pictures:
        with stage("draw pictures", seconds):
            written = _draw(output, capture, loaded, result, seen)
    gain, possible = ours.score.miou - plain.score.miou, best.score.miou - plain.score.miou
    labelled = capture.instance >= 0
    agreement = adjusted_rand_index(result.instances[labelled], capture.instance[labelled])
    share = gain / possible if possible > 0 else float("nan")
    demo = DemoResult(output, bundle, written, methods, share, agreement, seconds)
    _report(demo)
    return demo


def ceiling(
    features: NDArray[np.floating], mask_instance: NDArray[np.integer], texts: NDArray[np.floating],
    instances: NDArray[np.integer],
) -> NDArray[np.int32]:  # fmt: skip
    """The best that masks allow: true instances, each with the mean feature of the masks that mostly show it.

    features: (M, D) unit rows; mask_instance: (M,) the true instance that each mask mostly shows, -1 for background;
    texts: (C, D) unit rows; instances: (n,) true instance of each point, -1 none. Returns (n,) int32 class ids, -1 off
    the instances and for an instance without a mask.
    """
    count = int(max(instances.max(initial=-1), mask_instance.max(initial=-1))) + 1
    label_of = np.full(count + 1, -1, np.int32)
    similarity = features @ texts.T
    for instance in np.unique(mask_instance[mask_instance >= 0]):
        label_of[instance] = similarity[mask_instance == instance].mean(axis=0).argmax()
    return label_of[np.where(instances >= 0, instances, count)]


def _absent_called(scene: og.LabelledScene, capture: RoomCapture) -> float:
    absent = {f"absent {number}": vector for number, vector in enumerate(capture.absent_vectors)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # warns that no point has a label, as hoped
        return float((og.segment(capture.xyz, absent, scene=scene).labels >= 0).mean())


def _baselines(prepared: Prepared, render_s: float, capture: RoomCapture) -> tuple[MethodScore, MethodScore]:
    """Direct uplift from the fit's own mask table, and the ceiling from the truth."""
    features = np.concatenate(capture.mask_features)

    def plain(texts: NDArray[np.floating]) -> NDArray[np.integer]:
        return prepared.surface.of_points(direct_uplift(prepared, texts))

    def best(texts: NDArray[np.floating]) -> NDArray[np.integer]:
        return ceiling(features, capture.mask_instance, texts, capture.instance)

    start = time.perf_counter()
    labels = plain(capture.text_vectors)
    seconds = render_s + time.perf_counter() - start
    plain_called, best_called = (float((ask(capture.absent_vectors) >= 0).mean()) for ask in (plain, best))
    return (
        MethodScore("direct uplift", _score(labels, capture), plain_called, seconds),
        MethodScore("ceiling: true instances", _score(best(capture.text_vectors), capture), best_called, None),
    )


def _score(labels: NDArray[np.integer], capture: RoomCapture) -> Score:
    return score_labels(labels, capture.cls, background=capture.background)


def _draw(
    output: Path, capture: RoomCapture, scene: og.LabelledScene, result: og.Segmentation, seen: FromPhotographs | None
) -> tuple[Path, ...]:
    """Draw the pictures; only the input views where nothing can be rendered."""
    from og_pointcloud_pyvista import can_render

    views = output / "views.png"
    chosen = [int(place * len(capture.frames)) for place in SHOWN_VIEWS]
    draw_views(views, [capture.frames[index].image for index in chosen], [capture.masks[index] for index in chosen])
    written = (views, seen.preview) if seen else (views,)
    if not can_render():
        print("no pictures of the cloud: off-screen rendering needs EGL or OSMesa (Debian: apt install libegl1 libgl1)")
        return written
    # Flying pixels and outliers have no truth to compare with; they are shown among the instances.
    known, rgb = (capture.cls >= 0) | capture.background, capture.rgb
    truth = {"ground truth": replace(result, labels=capture.cls, instances=capture.instance)}
    by_instance = draw_clouds(output / "instances.png", scene, {"instances": result}, rgb, by="instance")
    by_label = draw_clouds(output / "labels.png", scene, {"segmented by words": result, **truth}, rgb, known)
    written += (by_instance, by_label)
    if seen:
        panels = {"from photographs alone": seen.result, **truth}
        written += (draw_clouds(output / "from_photographs.png", scene, panels, rgb, known),)
    return written


def _report(demo: DemoResult) -> None:
    columns = ("mIoU", "mAcc", "unknown", "background called", "absent called", "seconds")
    print("\n" + f"{'method':<24}" + "".join(f"{name:>{len(name) + 3}}" for name in columns))
    for method in demo.methods:
        score = method.score
        shares = (score.miou, score.macc, score.unknown_share, score.background_called, method.absent_called)
        cells = ["-" if share is None else f"{share:.4f}" for share in shares]
        cells.append("-" if method.seconds is None else f"{method.seconds:.1f}")
        row = "".join(f"{cell:>{len(name) + 3}}" for cell, name in zip(cells, columns, strict=True))
        print(f"{method.name:<24}{row}")
    print(
        f"absent called: of all points, the share that gets one of {ABSENT_WORDS} words that nothing in the room is "
        f"(from photographs: one of {len(ABSENT)} typed ones); og_pointcloud judges them by its word bank"
    )
    print(f"og_pointcloud goes {demo.share_of_the_way:.1%} of the way from direct uplift to the ceiling")
    print(f"agreement of its instances with the true ones (adjusted Rand index): {demo.instance_agreement:.3f}\n")
    print(f"wrote {demo.bundle} ({demo.bundle.stat().st_size / 1e6:.1f} MB)")
    for picture in demo.pictures:
        print(f"wrote {picture}")
    print(f"total {sum(demo.seconds.values()):.1f} s")
    print_next("segment", demo.bundle, "--labels", "chair,mug,potted plant")
    if (typed := demo.output / "photographs" / "room.ogpc").is_file():
        print_next("select", typed, "coffee mug", hint="or, in words of your own: ")
