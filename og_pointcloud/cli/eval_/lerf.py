"""``og-pointcloud eval lerf``: selection by text on the four scenes of LeRF-OVS, from the data set's own files."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from og_pointcloud.cli.common import add_command, check_outputs, names_in, print_table, write_json
from og_pointcloud.cli.eval_.common import percent, prediction_file, signed, spread
from og_pointcloud.errors import OgPointcloudError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from og_pointcloud.evaluate.lerf_selection import PairScore

    Scenes = dict[str, list[PairScore]]


def add(protocols: Any) -> None:
    parser = add_command(
        protocols, "lerf", run,
        "LeRF-OVS: select by text, render the selection, hold it against the outlined objects (mIoU, IoU over 0.25).",
        "og-pointcloud eval lerf lerf_ovs --predictions fitted --gaussians trained --text-features words.npz",
    )  # fmt: skip
    parser.add_argument(
        "folder", type=Path, metavar="DIR", help="folder with <scene>/sparse/0 and label/<scene>/*.json"
    )
    parser.add_argument("--predictions", type=Path, required=True, metavar="P", help="folder with <scene>.ogpc")
    parser.add_argument("--against", type=Path, metavar="Q", help="as P: also give the difference, P less Q, paired")
    parser.add_argument(
        "--gaussians", type=Path, metavar="G",
        help="folder with <scene>.ply, or <scene>/point_cloud/iteration_*/, of scenes that were fitted from Gaussians",
    )  # fmt: skip
    parser.add_argument("--text-features", type=Path, metavar="F.npz", help="names and vectors of the objects")
    parser.add_argument("--scenes", metavar="A,B", help="these scenes (default: all with labels)")
    parser.add_argument("--oracle", action="store_true", help="also the best instance there is for each pair (slow)")
    parser.add_argument("--json", type=Path, metavar="F.json", help="also write every pair")


def run(arguments: argparse.Namespace) -> None:
    check_outputs({"--json": (arguments.json, [".json"])}, inputs=[arguments.text_features])
    from og_pointcloud.evaluate.lerf_selection import ORACLE, WAYS, read_scene, scene_names

    known, wanted = scene_names(arguments.folder), names_in(arguments.scenes)
    missing = [name for name in wanted or () if name not in known]
    if missing:
        raise OgPointcloudError(f"{arguments.folder} has no labels of '{missing[0]}'; it has {', '.join(known)}")
    # Everything is looked for before anything is rendered: what the last scene lacks is said at once.
    labels = [read_scene(arguments.folder, name) for name in wanted or known]
    folders = [folder for folder in (arguments.predictions, arguments.against) if folder]
    files = [[prediction_file(folder, scene.name, (".ogpc",)) for scene in labels] for folder in folders]
    splats = [gaussians_file(arguments.gaussians, scene.name) for scene in labels]
    ways = (*WAYS, ORACLE) if arguments.oracle else WAYS
    own, *others = (score(labels, of_folder, splats, arguments) for of_folder in files)
    print_scores(own, ways)
    print_set(own)
    compare(own, ways)
    for other in others:
        for way in ways:
            change = paired(ious(own, way), ious(other, way))
            print(f"{way}: less {arguments.against}, all pairs: {signed(change)}")
    if arguments.json:
        write_json(arguments.json, described(own, ways))
        print(f"wrote {arguments.json}")


def score(labels: Any, files: list[Path], splats: list[Path | None], arguments: argparse.Namespace) -> Scenes:
    from og_pointcloud.ask.labelled_scene import load
    from og_pointcloud.evaluate.lerf_selection import gaussians_of, score_pairs

    scenes: Scenes = {}
    for of_scene, file, splat in zip(labels, files, splats, strict=True):
        scene = load(file)
        gaussians = gaussians_of(scene.cloud, splat)
        scenes[of_scene.name] = score_pairs(scene, of_scene, gaussians, arguments.text_features, arguments.oracle)
    return scenes


def ious(scenes: Scenes, way: str) -> NDArray[np.float64]:
    """(pairs,) of all scenes."""
    import numpy as np

    return np.array([pair.iou[way] for pairs in scenes.values() for pair in pairs])


def paired(first: NDArray[np.float64], second: NDArray[np.float64]) -> Any:
    from og_pointcloud.evaluate.spread import paired_bootstrap

    return paired_bootstrap(first, second)


def print_scores(scenes: Scenes, ways: tuple[str, ...]) -> None:
    import numpy as np

    from og_pointcloud.evaluate.lerf import IOU_FOUND, score_scenes
    from og_pointcloud.evaluate.spread import bootstrap

    by_way = {way: {name: np.array([p.iou[way] for p in pairs]) for name, pairs in scenes.items()} for way in ways}
    rows = []
    for name, pairs in scenes.items():
        cells = [
            (of[name].mean(), (of[name] > IOU_FOUND).mean()) if len(pairs) else (None,) * 2 for of in by_way.values()
        ]
        rows.append((name, str(len(pairs)), *(percent(value) for cell in cells for value in cell)))
    means = [score_scenes(of) for of in by_way.values()]
    total = str(means[0].pairs)
    rows.append(("mean of scenes", total, *(percent(v) for mean in means for v in (mean.miou, mean.accuracy))))
    rows.append(("all pairs", total, *(percent(v) for mean in means for v in (mean.flat_miou, mean.flat_accuracy))))
    intervals = []
    for way in ways:
        values = ious(scenes, way)
        intervals += [spread(bootstrap(values)), spread(bootstrap((values > IOU_FOUND).astype(float)))]
    rows.append(("95 % of all pairs", "", *intervals))
    print_table(("", "pairs", *(f"{way} {what}" for way in ways for what in ("mIoU", "over 0.25"))), rows)


def print_set(scenes: Scenes) -> None:
    """Whether the pairs are those of the published table."""
    from og_pointcloud.evaluate.lerf import PAIRS

    if {name: len(pairs) for name, pairs in scenes.items()} == dict(PAIRS):
        print("the scenes and pairs of the published table")
    else:
        published = ", ".join(f"{name} {count}" for name, count in PAIRS.items())
        print(f"not the set of the published table, whose pairs are {published}: its means are of others")


def compare(scenes: Scenes, ways: tuple[str, ...]) -> None:
    """What another way of choosing brings on the same pairs, and how often it chooses nothing."""
    for way in ways[1:]:
        print(f"{way} less {ways[0]}, mIoU of all pairs: {signed(paired(ious(scenes, way), ious(scenes, ways[0])))}")
    pairs = [pair for of_scene in scenes.values() for pair in of_scene]
    for way in pairs[0].selected:
        nothing = sum(pair.selected[way] == 0 for pair in pairs)
        print(f"{way}: nothing selected for {nothing} of {len(pairs)} pairs")


def described(scenes: Scenes, ways: tuple[str, ...]) -> dict[str, Any]:
    """Means and every pair, as JSON."""
    from dataclasses import asdict

    import numpy as np

    from og_pointcloud.evaluate.lerf import score_scenes

    means = {
        way: asdict(score_scenes({name: np.array([p.iou[way] for p in pairs]) for name, pairs in scenes.items()}))
        for way in ways
    }
    return {"means": means, "scenes": {name: [asdict(pair) for pair in pairs] for name, pairs in scenes.items()}}


def gaussians_file(folder: Path | None, scene: str) -> Path | None:
    if folder is None:
        return None
    from og_pointcloud.formats.gaussian_ply import latest_iteration

    file = folder / f"{scene}.ply"
    found = file if file.is_file() else latest_iteration(folder / scene)
    if found is None:
        raise OgPointcloudError(
            f"{folder} has neither {scene}.ply nor {scene}/point_cloud/iteration_*/point_cloud.ply; expected the "
            "Gaussians that the scene was fitted from"
        )
    return found
