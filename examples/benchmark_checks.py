"""Faults added one at a time to correct captures: which are detected, by which check, and what the named repair gains.

    python examples/benchmark_checks.py CAPTURE [CAPTURE ...] [--fit] [--only FAULT ...] [--good]

A capture is a folder with transforms.json, points.ply, masks/, mask_features.npz and images/. For every fault, a
temporary folder of links is made with the faulty file in it; lengths are shares of the median distance to the cameras.
``told by`` is "refused" where reading or fitting ends in an error, else the checks in doubt; ``repair`` is what they
name, repaired and checked again at most twice. With --fit each is fitted and scored against ``gt.npz``, with the fault
and with the repair. --good: only the captures as they are, where a doubt is a false alarm, and the cost of the checks
compared with a fit.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

import og_pointcloud as og
from og_pointcloud.bundle.vocabulary import scene_words
from og_pointcloud.checking.check import check_capture, check_words
from og_pointcloud.cloud import FeatureSpace, LabelledCloud
from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.evaluate.captures import ask, score_capture
from og_pointcloud.evaluate.truth import read_truth
from og_pointcloud.formats.ply import plain_rows, write_ply
from og_pointcloud.formats.points import read_points
from og_pointcloud.formats.poses import rotation_of_vector

OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])
ROUNDS = 2
CURED = 3
"""A fault counts as cured if the repaired mIoU is at most this many percent below that of the correct capture."""
TEXT, FEATURES = "text_features.npz", "mask_features.npz"
Fault = Callable[[Path], None]
Maps = list[NDArray[Any]]


def main(arguments: list[str] | None = None) -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path)
    parser.add_argument("--fit", action="store_true")
    parser.add_argument("--good", action="store_true")
    parser.add_argument("--pairs", action="store_true", help="two mistakes at once")
    parser.add_argument("--only", nargs="+", choices=tuple(FAULTS))
    options = parser.parse_args(arguments)
    names = options.only or [name for name in FAULTS if (" + " in name) == options.pairs]
    warnings.simplefilter("ignore")
    if options.good:
        false_alarms(options.captures, options.fit)
        return
    for capture in options.captures:
        table(capture, names, options.fit)


def table(capture: Path, names: Sequence[str], fitted: bool) -> None:
    """Print a line for each fault, and how many are detected, have a named repair, and are cured."""
    right = judged(capture, [], True)[0] if fitted else None
    beside = "" if right is None else f", {right:.1f} as it is"
    print(f"{capture.name}{beside}\n{'fault':<33} {'told by':<28} {'repair':<52} {'mIoU':>6} {'repaired':>9}")
    faults = [name for name in names if name not in HARMLESS]
    told, named, cured = [], [], []
    for name in names:
        with tempfile.TemporaryDirectory() as temporary:
            found = found_of(capture, Path(temporary) / capture.name, name, fitted)
        scores = [f"{value:6.1f}" if value is not None else " " * 6 for value in (found.score, found.repaired)]
        print(
            f"{name:<33} {', '.join(found.doubts):<28} {' '.join(found.repairs):<52} {'    '.join(scores)}", flush=True
        )
        if name in faults:
            told += [name] if found.doubts else []
            named += [name] if found.repairs else []
            cured += [name] if right and found.repaired and found.repaired > right - CURED else []
    last = f", {len(cured)} cured by it (within {CURED} of the right capture)" if fitted else ""
    print(f"{capture.name}: {len(told)} of {len(faults)} faults told, {len(named)} with a repair{last}\n", flush=True)


class Found(NamedTuple):
    """doubts: names of the checks in doubt. score, repaired: mIoU in percent with the fault, and with the repairs."""

    doubts: list[str]
    repairs: list[str]
    score: float | None
    repaired: float | None


def found_of(capture: Path, folder: Path, name: str, fitted: bool) -> Found:
    """What the checks find of one fault. folder: where the faulty capture is made."""
    link(capture, folder)
    repairs: list[str] = []
    FAULTS[name](folder)
    try:
        score, doubts = judged(folder, repairs, fitted)
    except OgPointcloudError:
        score, doubts = None, ["refused"]
    for _ in range(ROUNDS):
        try:
            checks = check_capture(og.read_capture(folder, repairs=repairs))
        except OgPointcloudError:
            break
        found = next((check.repair for check in checks if check.verdict == "doubt" and check.repair), "")
        if not found:
            break
        repairs += found.split()
    after = judged(folder, repairs, fitted)[0] if repairs else None
    return Found(doubts, repairs, score, after)


def judged(folder: Path, repairs: tuple[str, ...] | list[str], fitted: bool) -> tuple[float | None, list[str]]:
    """mIoU in percent of a fit of the folder, None without a fit; the names of the checks in doubt."""
    scene = og.read_capture(folder, repairs=repairs)
    if not fitted:
        return None, [check.name for check in check_capture(scene) if check.verdict == "doubt"]
    cloud = with_words(og.fit(scene, progress=False), folder)
    doubts = [check["name"] for check in cloud.provenance["checks"] if check["verdict"] == "doubt"]
    doubts += ["words"] if check_words(cloud).verdict == "doubt" else []
    truth = read_truth(folder)
    return 100 * score_capture(ask(cloud, truth, folder / TEXT), truth).labels.miou, doubts


def with_words(cloud: LabelledCloud, folder: Path) -> LabelledCloud:
    """The cloud with the words and the word bank of its folder."""
    space = FeatureSpace(cloud.feature_space, cloud.space.width)
    return scene_words(space, capture=folder).added_to(cloud)


def false_alarms(captures: list[Path], fitted: bool) -> None:
    """Print verdicts on captures as they are, with the processor seconds of the checks, and of the whole fit."""
    alarms = 0
    for capture in captures:
        scene = og.read_capture(capture)
        start = time.process_time()
        checks = check_capture(scene)
        seconds = time.process_time() - start
        beside = ""
        if fitted:
            start = time.process_time()
            cloud = with_words(og.fit(scene, progress=False), capture)
            beside = f" of {time.process_time() - start:.1f} s"
            verdicts = [(check["name"], check["verdict"]) for check in cloud.provenance["checks"]]
            verdicts.append(("words", check_words(cloud).verdict))
        else:
            verdicts = [(check.name, check.verdict) for check in checks]
        by = {verdict: [name for name, given in verdicts if given == verdict] for verdict in ("doubt", "unchecked")}
        alarms += bool(by["doubt"])
        said = "; ".join(f"{verdict}: {', '.join(names)}" for verdict, names in by.items() if names)
        print(f"{capture.name:<22} {seconds:5.2f} s{beside}  {said or 'all ok'}", flush=True)
    print(f"{alarms} false alarms in {len(captures)} captures")


def link(capture: Path, folder: Path) -> None:
    """A folder of links to a capture's files."""
    folder.mkdir(parents=True)
    for part in capture.resolve().iterdir():
        (folder / part.name).symlink_to(part)


def own(folder: Path, name: str) -> Path:
    """A private copy in place of the link."""
    path = folder / name
    if not path.is_symlink():
        return path
    source = path.resolve()
    path.unlink()
    (shutil.copytree if source.is_dir() else shutil.copy)(source, path)
    return path


def transforms(change: Callable[[dict[str, Any]], None]) -> Fault:
    """A fault of transforms.json; change: edits its content in place."""

    def fault(folder: Path) -> None:
        path = own(folder, "transforms.json")
        content = json.loads(path.read_text())
        change(content)
        path.write_text(json.dumps(content))

    return fault


def poses(change: Callable[[Maps, int], NDArray[Any]]) -> Fault:
    """A fault of poses; change: (all matrices, index of one) -> that one, changed."""

    def edit(content: dict[str, Any]) -> None:
        matrices = [np.array(frame["transform_matrix"], float) for frame in content["frames"]]
        for index, frame in enumerate(content["frames"]):
            frame["transform_matrix"] = np.asarray(change(matrices, index)).tolist()

    return transforms(edit)


def numbers(keys: str, change: Callable[[float], float]) -> Fault:
    """A fault of numbers in transforms.json, at top level or in frames."""

    def edit(content: dict[str, Any]) -> None:
        for level in (content, *content["frames"]):
            level.update({key: change(level[key]) for key in keys.split() if key in level})

    return transforms(edit)


def cloud(change: Callable[[NDArray[np.float64], float], NDArray[np.float64]]) -> Fault:
    """A fault of the cloud; change: (points (n, 3), their median distance to the first camera) -> points."""

    def fault(folder: Path) -> None:
        points = read_points(folder / "points.ply")
        first = np.array(json.loads((folder / "transforms.json").read_text())["frames"][0]["transform_matrix"])
        xyz = points.xyz_world
        distance = float(np.median(np.linalg.norm(xyz - first[:3, 3], axis=1)))
        (folder / "points.ply").unlink()
        write_ply(folder / "points.ply", {"vertex": plain_rows(change(xyz, distance), points.rgb)})

    return fault


def pictures(part: str, change: Callable[[Maps, int], NDArray[Any]]) -> Fault:
    """A fault of masks or photographs; change: (all images, index of one) -> that one, changed."""

    def fault(folder: Path) -> None:
        files = sorted(own(folder, part).iterdir())
        maps = [np.asarray(cv2.imread(str(file), cv2.IMREAD_UNCHANGED)) for file in files]
        for index, file in enumerate(files):
            cv2.imwrite(str(file), np.ascontiguousarray(change(maps, index)))

    return fault


def arrays(name: str, change: Callable[[dict[str, Any]], dict[str, Any]]) -> Fault:
    """A fault of text_features.npz or mask_features.npz; change: of all its arrays."""

    def fault(folder: Path) -> None:
        path = own(folder, name)
        np.savez(path, **change(dict(np.load(path))))

    return fault


def features(change: Callable[[NDArray[Any], np.random.Generator], NDArray[Any]]) -> Fault:
    """A fault of the mask features; change: of one image's rows."""

    def of_all(rows: dict[str, Any]) -> dict[str, Any]:
        random = np.random.default_rng(0)
        return {key: change(each, random) if each.ndim == 2 else each for key, each in rows.items()}

    return arrays(FEATURES, of_all)


def together(*faults: Fault) -> Fault:
    """Several faults combined into one."""

    def fault(folder: Path) -> None:
        for each in faults:
            each(folder)

    return fault


def of_next_image(rows: dict[str, Any]) -> dict[str, Any]:
    """Each image's features from the next."""
    stems = sorted(key for key, each in rows.items() if each.ndim == 2)
    return rows | {stem: rows[after] for stem, after in zip(stems, [*stems[1:], *stems[:1]], strict=True)}


def colmap(inverse: bool = False, size: float = 1, scale: float = 1, wxyz: bool = True) -> Fault:
    """The poses as a COLMAP model instead, right or with a fault."""

    def fault(folder: Path) -> None:
        from scipy.spatial.transform import Rotation

        content = json.loads((folder / "transforms.json").read_text())
        (folder / "transforms.json").unlink()
        model = folder / "sparse" / "0"
        model.mkdir(parents=True)
        cameras, images = [], []
        for index, frame in enumerate(content["frames"], 1):
            keys = {**content, **frame}
            focal = keys["fl_x"], keys.get("fl_y", keys["fl_x"])
            sizes = round(keys["w"] * size), round(keys["h"] * size)
            cameras.append(f"{index} PINHOLE {sizes[0]} {sizes[1]} {focal[0]} {focal[1]} {keys['cx']} {keys['cy']}\n")
            pose = np.array(frame["transform_matrix"]) @ OPENCV
            pose[:3, 3] *= scale
            pose = pose if inverse else np.linalg.inv(pose)
            xyzw = Rotation.from_matrix(pose[:3, :3]).as_quat()
            quaternion = np.roll(xyzw, 1) if wxyz else xyzw
            line = [index, *quaternion, *pose[:3, 3], index, Path(frame["file_path"]).name]
            images.append(" ".join(map(str, line)) + "\n\n")
        (model / "cameras.txt").write_text("".join(cameras))
        (model / "images.txt").write_text("".join(images))
        (model / "points3D.txt").write_text("")

    return fault


def shuffled(maps: Maps, index: int) -> NDArray[Any]:
    """Another one of the list, at random."""
    return maps[int(np.random.default_rng(0).permutation(len(maps))[index])]


def rotated(z_degrees: float) -> NDArray[np.float64]:
    """(3, 3) rotation about z."""
    return rotation_of_vector(np.deg2rad(np.array([0, 0, z_degrees])))


def resized(map_: NDArray[Any], size: tuple[int, int]) -> NDArray[Any]:
    """Resized like a photograph, which is wrong for ids."""
    return cv2.resize(map_, size, interpolation=cv2.INTER_LINEAR)


def through_jpeg(map_: NDArray[Any]) -> NDArray[Any]:
    """Ids stored with lossy compression."""
    return np.asarray(cv2.imdecode(cv2.imencode(".jpg", (map_ * 10).astype(np.uint8))[1], -1)) // 10


def in_capitals(content: dict[str, Any]) -> None:
    """File names as another system writes them."""
    for frame in content["frames"]:
        frame["file_path"] = frame["file_path"].upper()


def exchanged(content: dict[str, Any]) -> None:
    """cx and cy swapped."""
    for level in (content, *content["frames"]):
        if "cx" in level:
            level["cx"], level["cy"] = level["cy"], level["cx"]


def mixed(vectors: NDArray[Any]) -> NDArray[np.float32]:
    """The vectors in a rotated space."""
    width = vectors.shape[1]
    return (vectors @ np.linalg.qr(np.random.default_rng(0).normal(size=(width, width)))[0]).astype(np.float32)


FAULTS: dict[str, Fault] = {
    "none": lambda folder: None,
    "world to camera": poses(lambda all_, i: np.linalg.inv(all_[i])),
    "OpenCV axes": poses(lambda all_, i: all_[i] @ OPENCV),
    "det -1": poses(lambda all_, i: MIRROR @ all_[i]),
    "mirrored world": poses(lambda all_, i: MIRROR @ all_[i] @ MIRROR),
    "a NaN pose": poses(lambda all_, i: all_[i] * (np.nan if i == 3 else 1)),
    "two identity poses": poses(lambda all_, i: np.eye(4) if i in (3, 9) else all_[i]),
    "all poses one": poses(lambda all_, i: all_[0]),
    "poses of next frame": poses(lambda all_, i: all_[(i + 1) % len(all_)]),
    "poses shuffled": poses(shuffled),
    "moved by 12 %": cloud(lambda xyz, distance: xyz + np.array([0.12 * distance, 0, 0])),
    "moved by 4 %": cloud(lambda xyz, distance: xyz + np.array([0.04 * distance, 0, 0])),
    "turned 5 degrees": cloud(lambda xyz, distance: xyz @ rotated(5).T),
    "turned 90 degrees": cloud(lambda xyz, distance: xyz @ rotated(90).T),
    "cloud y-up": cloud(lambda xyz, distance: xyz[:, [0, 2, 1]] * [1, 1, -1]),
    "cloud in mm": cloud(lambda xyz, distance: xyz * 1000),
    "scaled 1.1": cloud(lambda xyz, distance: xyz * 1.1),
    "w, h doubled": numbers("w h", lambda value: 2 * value),
    "K halved": numbers("fl_x fl_y cx cy", lambda value: value / 2),
    "focal length in mm": numbers("fl_x fl_y", lambda value: value / 10.8),
    "center outside": together(numbers("cx", lambda value: -400.0), numbers("cy", lambda value: 900.0)),
    "cx, cy swapped": transforms(exchanged),
    "k1 though undistorted": transforms(lambda content: content.update(camera_model="OPENCV", k1=-0.25)),
    "masks turned": pictures("masks", lambda maps, i: maps[i][::-1, ::-1]),
    "masks mirrored": pictures("masks", lambda maps, i: maps[i][:, ::-1]),
    "masks turned by 90": pictures("masks", lambda maps, i: np.rot90(maps[i])),
    "masks square": pictures("masks", lambda maps, i: cv2.resize(maps[i], (256, 256), interpolation=cv2.INTER_NEAREST)),
    "masks of next image": together(
        pictures("masks", lambda maps, i: maps[(i + 1) % len(maps)]), arrays(FEATURES, of_next_image)
    ),
    "ids from 0": pictures("masks", lambda maps, i: np.maximum(maps[i], 1) - 1),
    "features shuffled": features(lambda rows, random: rows[random.permutation(len(rows))]),
    "too many features": features(lambda rows, random: np.concatenate([rows, rows])),
    "features equal": features(lambda rows, random: np.ones_like(rows)),
    "features zero": features(lambda rows, random: np.zeros_like(rows)),
    "masks as JPEG": pictures("masks", lambda maps, i: through_jpeg(maps[i])),
    "masks interpolated": pictures(
        "masks", lambda maps, i: resized(resized(maps[i], (480, 360)), (maps[i].shape[1], maps[i].shape[0]))
    ),
    "masks all background": pictures("masks", lambda maps, i: maps[i] * 0),
    "one mask an image": together(
        pictures("masks", lambda maps, i: np.ones_like(maps[i])), features(lambda rows, random: rows[:1])
    ),
    "masks RGBA": pictures("masks", lambda maps, i: cv2.merge([maps[i].astype(np.uint8)] * 4)),
    "masks inverted": pictures("masks", lambda maps, i: (maps[i] == 0).astype(np.uint16)),
    "text of other encoder": arrays(TEXT, lambda words: {**words, "vectors": mixed(words["vectors"])}),
    "the same, unnamed": together(
        arrays(TEXT, lambda words: {"names": words["names"], "vectors": mixed(words["vectors"])}),
        arrays(FEATURES, lambda rows: {key: each for key, each in rows.items() if key != "feature_space"}),
    ),
    "text rows shifted": arrays(TEXT, lambda words: {**words, "vectors": np.roll(words["vectors"], 1, 0)}),
    "photographs of noise": pictures(
        "images", lambda maps, i: np.random.default_rng(1).integers(0, 255, maps[i].shape).astype(np.uint8)
    ),
    "photographs turned": pictures("images", lambda maps, i: maps[i][::-1, ::-1]),
    "a view twice": transforms(lambda content: content["frames"].append(content["frames"][0])),
    "names in capitals": transforms(in_capitals),
    "COLMAP": colmap(),
    "COLMAP, to world": colmap(inverse=True),
    "COLMAP, xyzw": colmap(wxyz=False),
    "COLMAP, free scale": colmap(scale=2.7),
    "COLMAP, large images": colmap(size=4),
}
PAIRS = (
    ("OpenCV axes", "ids from 0"), ("OpenCV axes", "masks mirrored"), ("OpenCV axes", "K halved"),
    ("OpenCV axes", "cloud in mm"), ("cloud y-up", "OpenCV axes"), ("cloud in mm", "K halved"),
    ("poses of next frame", "K halved"), ("cloud in mm", "features shuffled"), ("masks of next image", "ids from 0"),
    ("moved by 4 %", "ids from 0"), ("turned 5 degrees", "cx, cy swapped"), ("poses shuffled", "masks turned"),
)  # fmt: skip
"""Mistakes that occur together."""
FAULTS |= {f"{one} + {other}": together(FAULTS[one], FAULTS[other]) for one, other in PAIRS}
HARMLESS = ("none", "a NaN pose", "two identity poses", "COLMAP")
"""Not faults, or faults that a fit leaves out."""


if __name__ == "__main__":
    main()
