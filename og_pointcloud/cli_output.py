"""What the commands print: a record for --json, and the same as lines for a reader."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from og_pointcloud.ablation import AblationRow
    from og_pointcloud.cloud import LabelledCloud
    from og_pointcloud.picking import Pick
    from og_pointcloud.runtime import LabelledScene
    from og_pointcloud.segmentation import Segmentation

__all__ = [
    "describe_bundle",
    "describe_fit",
    "describe_pick",
    "describe_segmentation",
    "next_fit_command",
    "print_ablation",
    "print_fit",
    "print_import",
    "print_info",
    "print_pick",
    "print_segmentation",
    "print_table",
]

SHOWN = 12
"""Words, and instances, that a list shows before it ends in dots."""


def describe_fit(cloud: LabelledCloud, capture: Path, bundle: Path) -> dict[str, Any]:
    """What ``fit --json`` writes: counts, the file, and the provenance (stages, settings, what was left out)."""
    from og_pointcloud.cloud import BACKGROUND, UNOBSERVED

    ids = cloud.instance_ids
    return {
        "capture": str(capture),
        "output": str(bundle),
        "bytes": bundle.stat().st_size,
        "points": len(cloud),
        "instances": len(cloud.instances),
        "points_in_instances": int((ids >= 0).sum()),
        "points_background": int((ids == BACKGROUND).sum()),
        "points_unobserved": int((ids == UNOBSERVED).sum()),
        "feature_space": cloud.feature_space,
        "vocabulary": len(cloud.vocabulary.names) if cloud.vocabulary else 0,
        "seconds": round(sum(stage["seconds"] for stage in cloud.provenance["stages"]), 3),
        **cloud.provenance,
    }


def print_fit(report: Mapping[str, Any], cloud: LabelledCloud) -> None:
    """What ``fit`` closes with; ends in the next command."""
    print_provenance(cloud.provenance)
    total = report["points"]
    shares = [report[f"points_{state}"] / total for state in ("in_instances", "background", "unobserved")]
    print(
        f"{total:,} points: {shares[0]:.1%} in {report['instances']} instances, {shares[1]:.1%} background, "
        f"{shares[2]:.1%} unobserved"
    )
    print(f"wrote {report['output']} ({report['bytes'] / 1e6:.1f} MB)")
    print(f"next: {next_segment_command(report['output'], cloud)}")


def print_import(report: Mapping[str, Any], cloud: LabelledCloud) -> None:
    """What ``import`` closes with: the files it found, and the rest as ``fit``."""
    for file in report["files"].values():
        print(f"read {file}")
    print_fit(report, cloud)


def next_segment_command(bundle: str, cloud: LabelledCloud) -> str:
    """A segment command that works as it stands, or names what it still needs."""
    command = ["og-pointcloud", "segment", bundle]
    if cloud.vocabulary and cloud.vocabulary.names:
        labels = ["--labels", ",".join(cloud.vocabulary.names[:2])]
    else:
        labels = ["--text-features", f"{cloud.feature_space.replace('/', '_')}_names.npz"]
    return shlex.join([*command, *labels, "-o", str(Path(bundle).with_suffix(".ply"))])


def describe_segmentation(
    result: Segmentation, stages: Sequence[Mapping[str, Any]], bundle: Path, output: Path | None
) -> dict[str, Any]:
    """What ``segment --json`` prints: points of each name, and why the others are unknown."""
    from og_pointcloud.bundle import TOO_FAR
    from og_pointcloud.cloud import BACKGROUND, UNOBSERVED

    unknown = result.labels < 0
    states = {"background": BACKGROUND, "unobserved": UNOBSERVED, "too far from the scene": TOO_FAR}
    reasons = {name: int((result.instances == state).sum()) for name, state in states.items()}
    reasons["instance without a feature"] = int((unknown & (result.instances >= 0)).sum())
    return {
        "bundle": str(bundle),
        "output": str(output) if output else None,
        "points": len(result),
        "counts": result.counts(),
        "unknown": int(unknown.sum()),
        "unknown_because": reasons,
        "seconds": {stage["name"]: stage["seconds"] for stage in stages},
    }


def print_segmentation(report: Mapping[str, Any]) -> None:
    """The names that were found, in the order asked, and the share that stays unknown."""
    total = max(report["points"], 1)
    found = {name: count for name, count in report["counts"].items() if count}
    rows = [(name, f"{count:,}", f"{count / total:.1%}") for name, count in found.items()]
    rows.append(("unknown", f"{report['unknown']:,}", f"{report['unknown'] / total:.1%}"))
    print_table(("label", "points", "share"), rows)
    absent = [name for name in report["counts"] if name not in found]
    if absent:
        print(f"no point: {', '.join(absent[:SHOWN])}{', ...' if len(absent) > SHOWN else ''}")
    reasons = [f"{count:,} {name}" for name, count in report["unknown_because"].items() if count]
    if reasons:
        print(f"unknown: {', '.join(reasons)}")
    print(", ".join(f"{name} {seconds:.2f} s" for name, seconds in report["seconds"].items()))
    if report["output"]:
        print(f"wrote {report['output']}")
    else:
        command = ["og-pointcloud", "segment", report["bundle"], "-o", str(Path(report["bundle"]).with_suffix(".ply"))]
        print(f"next: keep the labels with -o, e.g. {shlex.join(command)}")


def describe_pick(
    hit: Pick, words: Sequence[tuple[str, float]], mask: Path | None, mask_pixels: int | None
) -> dict[str, Any]:
    """What ``pick --json`` prints: the instance, or why there is none, and where the click hit."""
    return {
        "instance": hit.instance,
        "found": hit.found,
        "what": str(hit),
        "point": hit.point,
        "xyz_world": None if hit.xyz_world is None else hit.xyz_world.tolist(),
        "points": len(hit.point_indices) if hit.found else 0,
        "words": [{"name": name, "score": round(score, 4)} for name, score in words],
        "mask": str(mask) if mask else None,
        "mask_pixels": mask_pixels,
    }


def print_pick(report: Mapping[str, Any]) -> None:
    """What was hit and where, the words that fit it best, and the mask."""
    print(report["what"])
    if report["xyz_world"]:
        print(f"hit at {', '.join(f'{value:.6g}' for value in report['xyz_world'])} (point {report['point']})")
    if report["words"]:
        best = [f"{word['name']} {word['score']:.2f}" for word in report["words"][:SHOWN]]
        print(f"best words: {', '.join(best)}{', ...' if len(report['words']) > SHOWN else ''}")
    if report["mask"]:
        print(f"wrote {report['mask']} ({report['mask_pixels']:,} pixels)")


def describe_bundle(scene: LabelledScene, path: Path) -> dict[str, Any]:
    """What ``info --json`` prints: the manifest, with the file's size and its words."""
    words = list(scene.vocabulary.names) if scene.vocabulary else []
    return {"path": str(path), "bytes": path.stat().st_size, "words": words, **scene.manifest}


def print_info(scene: LabelledScene, path: Path) -> None:
    """The file's size, frame and words, its largest instances, and how it was made."""
    cloud, manifest = scene.cloud, scene.manifest
    words = cloud.vocabulary.names if cloud.vocabulary else ()
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB, {manifest.get('written_by', 'unknown writer')}")
    print(f"{len(cloud):,} points, {len(cloud.instances)} instances, feature space '{cloud.feature_space}'")
    origin = ", ".join(f"{value:g}" for value in cloud.origin)
    print(f"spacing {cloud.spacing:.4g}, reach {cloud.reach:.4g}, origin ({origin}), in the capture's unit")
    print(f"{len(words)} words: {', '.join(words[:SHOWN])}{', ...' if len(words) > SHOWN else ''}\n")
    print_instances(scene)
    print()
    print_provenance(cloud.provenance)


def print_instances(scene: LabelledScene) -> None:
    """The largest instances, with the evidence for each and the word that fits it best."""
    table, vocabulary = scene.instances, scene.vocabulary
    largest = table.points.argsort(kind="stable")[::-1][:SHOWN]
    described = set(table.descriptor_instance.tolist())
    best = scene.instance_scores(vocabulary.vectors).argmax(axis=1) if vocabulary and vocabulary.names else None
    rows = []
    for index in largest.tolist():
        word = vocabulary.names[best[index]] if vocabulary and best is not None and index in described else "-"
        evidence = (f"{table.points[index]:,}", str(table.views[index]), str(table.masks[index]))
        rows.append((str(index), *evidence, f"{table.agreement[index]:.2f}", word))
    print_table(("instance", "points", "views", "masks", "agreement", "best word"), rows)
    if len(table) > SHOWN:
        print(f"and {len(table) - SHOWN} smaller ones")


def print_ablation(rows: Sequence[AblationRow]) -> None:
    """A table a method and table of the paper; strict: with a class called on background as wrong."""
    print("paper: the same row's mIoU as published, on ScanNet: compare the order, not the size\n")
    header = ("", "mIoU", "+-", "paper", "mAcc", "unknown", "strict mIoU", "background called", "seconds", "clusters")
    for method, table in dict.fromkeys((row.method if row.table != "reference" else "", row.table) for row in rows):
        own = [row for row in rows if row.table == table and (table == "reference" or row.method == method)]
        cells = [
            (
                row.name, f"{row.miou:.3f}", number(row.miou_spread), number(row.published_miou), f"{row.macc:.3f}",
                f"{row.unknown_share:.3f}", number(row.strict_miou), number(row.background_called),
                f"{row.seconds:.2f}", f"{row.clusters:.0f}",
            )
            for row in own
        ]  # fmt: skip
        print_table((f"{table} ({method})" if method else table, *header[1:]), cells)
        print()


def number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def next_fit_command(capture: Path, output: Path) -> str:
    """A fit of the capture, which takes what an ablation compares."""
    return shlex.join(["og-pointcloud", "fit", str(capture), "-o", str(output / f"{capture.name}.ogpc")])


def print_provenance(provenance: Mapping[str, Any]) -> None:
    stages = provenance.get("stages", [])
    if stages:
        rows = [(stage["name"], f"{stage['seconds']:.2f}") for stage in stages]
        print_table(("stage", "seconds"), [*rows, ("total", f"{sum(stage['seconds'] for stage in stages):.2f}")])
    for entry in provenance.get("left_out", []):
        print(f"left out: {entry['what']}: {entry['why']}")
    for text in provenance.get("warnings", []):
        print(f"warning: {text}")


def print_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """The first column to the left, numbers to the right."""
    widths = [max(len(row[column]) for row in [header, *rows]) for column in range(len(header))]
    for row in [header, *rows]:
        first, *others = (cell.rjust(width) for cell, width in zip(row, widths, strict=True))
        print("  ".join([first.strip().ljust(widths[0]), *others]))
