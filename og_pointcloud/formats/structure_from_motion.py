"""Photographs without poses -> a COLMAP model with poses and points, through pycolmap (extra 'poses').

COLMAP finds SIFT features, matches pairs and maps incrementally. The choices made here: photographs of one size share a
lens; every photograph is compared with every other or, if there are more than `MAX_EXHAUSTIVE`, with its neighbors and
a sample of all; the largest model is kept, rotated so that z is up as the cameras were held. Its scale is arbitrary.
Seeds are fixed.

Structure from motion fails on bare walls, mirrors, or photographs taken from one spot. This raises an error instead of
making a capture of the few photographs that happened to fit.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from og_pointcloud.errors import SceneError, counted, naming_extra
from og_pointcloud.formats.atomic import StrPath, replacing_folder
from og_pointcloud.formats.images import image_size
from og_pointcloud.formats.poses import numbered_images, upright_axes
from og_pointcloud.formats.tables import naming
from og_pointcloud.journal import Journal

MODEL_FOLDER = "sparse"
MIN_SIZE = 3
"""Minimum number of photographs in a model."""
MIN_POSED_SHARE = 0.5
"""Share of the photographs: with fewer poses, a model is a fragment of the scene."""
MAX_EXHAUSTIVE = 120
"""Up to this many photographs all pairs are compared; else only pairs among every k-th, at most this many of them."""
NEIGHBORS = 10
"""Each photograph is always compared with this many before and after it."""
PAIRS_PER_CALL = 64
"""Small, as Ctrl-C and the progress bar wait for each call of COLMAP to end."""
SEED = 0
CURE = (
    "take more photographs from more positions, each overlapping the next by two thirds, of textured, motionless "
    "objects in even light, or let the tool that took them export its poses"
)


@dataclass(frozen=True)
class PosesFound:
    """capture: its folder. registered, of: numbers of photographs with a pose, and of all. points: number of
    triangulated points. error_px: their mean reprojection error. left_out: names of files without a pose. seconds: of
    features, matching and mapping, wall clock."""

    capture: Path
    registered: int
    of: int
    points: int
    error_px: float
    left_out: tuple[str, ...]
    seconds: tuple[float, ...]


def find_poses(
    photographs: StrPath,
    capture: StrPath | None = None,
    *,
    longest_side: int = 1600,
    threads: int = 1,
    progress: bool = False,
) -> PosesFound:
    """Make a capture folder from photographs: ``sparse/0``, as COLMAP writes it.

    photographs: the folder with them, or one whose ``images/`` has them. capture: the folder to make, with a link to
        the photographs; None: beside them.
    longest_side: features are found in images shrunk to this, pixels. threads: for all steps; one thread is
        deterministic, several may not be.
    SceneError where there are too few photographs, a model exists already, or fewer than half get a pose.
    MissingExtraError without pycolmap.
    """
    source = Path(photographs)
    target = source if capture is None else Path(capture)
    files, journal = _photographs(source, target), Journal(progress)
    with naming(target), tempfile.TemporaryDirectory(prefix="og-pointcloud-") as work:
        model = _Run(files, Path(work), longest_side, threads, journal).model()
        _require_enough(model, files)
        placed = _put_back_names(model, files)
        _turn_upright(model)
        # Nothing is put into the capture before everything is done.
        with replacing_folder(target / MODEL_FOLDER) as folder:
            (folder / "0").mkdir(parents=True)
            model.write_binary(str(folder / "0"))
        if capture is not None and not (target / "images").exists():
            (target / "images").symlink_to(files[0].parent.resolve(), target_is_directory=True)
    left_out = tuple(file.name for file in files if file.name not in placed)
    error_px = float(model.compute_mean_reprojection_error())
    seconds = tuple(stage["seconds"] for stage in journal.stages)
    return PosesFound(target, len(placed), len(files), model.num_points3D(), error_px, left_out, seconds)


def _photographs(source: Path, target: Path) -> list[Path]:
    """The files, in the order of their numbers; SceneError where they cannot become a capture in the target."""
    if not source.is_dir():
        raise SceneError(f"{source} is not a folder; expected one of photographs")
    files = numbered_images(source)
    if len(files) < MIN_SIZE:  # a plan or a preview may lie beside images/
        files = numbered_images(source / "images") or files
    if len(files) < MIN_SIZE:
        found = counted(len(files), "photograph")
        raise SceneError(f"{source} has {found}; expected {MIN_SIZE} or more, there or in its images/")
    if os.path.lexists(target / MODEL_FOLDER):
        raise SceneError(f"{target / MODEL_FOLDER} already exists; expected none: remove it, or name another folder")
    images = target / "images"
    is_other = not images.exists() or not images.samefile(files[0].parent)
    if target != source and os.path.lexists(images) and is_other:
        raise SceneError(f"{images} has other images than {files[0].parent}; expected none: name another folder (-o)")
    return files


def _pycolmap() -> Any:
    with naming_extra("pycolmap", "poses"):
        import pycolmap  # pyright: ignore[reportMissingImports]
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)  # failures are reported here
    return pycolmap


class _Run:
    """The three steps on one database. Photographs are named by number: COLMAP's list of pairs allows no spaces."""

    def __init__(self, files: Sequence[Path], work: Path, longest_side: int, threads: int, journal: Journal) -> None:
        self._colmap, self._journal, self._threads = _pycolmap(), journal, threads
        self._folder, self._database, self._pairs_file = work / "images", work / "database.db", work / "pairs.txt"
        self._names = [f"{number:06d}{file.suffix}" for number, file in enumerate(files)]
        self._sizes = [image_size(file) for file in files]
        self._longest_side = longest_side
        self._folder.mkdir()
        for file, name in zip(files, self._names, strict=True):
            (self._folder / name).symlink_to(file.resolve())

    def model(self) -> Any:
        """The largest model, or None."""
        with self._journal.stage("features"):
            self._find_features()
        with self._journal.stage("matches"):
            self._match()
        with self._journal.stage("mapping"):
            return self._map()

    def _find_features(self) -> None:
        colmap, camera_of_size = self._colmap, dict[tuple[int, int], int]()
        options = colmap.FeatureExtractionOptions(
            use_gpu=False, num_threads=self._threads, max_image_size=self._longest_side
        )
        # Image by image, so that each can be given the camera of its size; -1 makes a new one.
        for number in self._journal.steps(range(len(self._names)), "features"):
            reader, size = colmap.ImageReaderOptions(), self._sizes[number]
            reader.existing_camera_id = camera_of_size.get(size, -1)
            camera_of_size.setdefault(size, len(camera_of_size) + 1)  # COLMAP's numbers
            colmap.extract_features(
                self._database, self._folder, [self._names[number]], colmap.CameraMode.SINGLE, reader, options,
                colmap.Device.cpu,
            )  # fmt: skip

    def _match(self) -> None:
        colmap, pairs = self._colmap, _pairs(len(self._names))
        options = colmap.FeatureMatchingOptions(use_gpu=False, num_threads=self._threads)
        pairing, verification = colmap.ImportedPairingOptions(), colmap.TwoViewGeometryOptions()
        pairing.match_list_path, verification.ransac.random_seed = self._pairs_file, SEED
        for start in self._journal.steps(range(0, len(pairs), PAIRS_PER_CALL), "matches"):
            lines = (f"{self._names[a]} {self._names[b]}\n" for a, b in pairs[start : start + PAIRS_PER_CALL])
            self._pairs_file.write_text("".join(lines))
            colmap.match_image_pairs(self._database, options, pairing, verification, colmap.Device.cpu)

    def _map(self) -> Any:
        colmap = self._colmap
        colmap.set_random_seed(SEED)
        options = colmap.IncrementalPipelineOptions(
            num_threads=self._threads, random_seed=SEED, min_model_size=MIN_SIZE
        )
        options.mapper.random_seed = options.triangulation.random_seed = SEED
        steps = iter(self._journal.steps(range(len(self._names)), "mapping"))
        models = colmap.incremental_mapping(
            self._database, self._folder, self._folder.with_name("models"), options,
            next_image_callback=lambda: next(steps, None),
        )  # fmt: skip
        return max(models.values(), key=lambda model: model.num_reg_images(), default=None)


def _pairs(count: int) -> list[tuple[int, int]]:
    """Numbers of the photographs that are compared with each other."""
    step = max(1, -(-count // MAX_EXHAUSTIVE))
    return [
        (first, second)
        for first in range(count)
        for second in range(first + 1, count)
        if second - first <= NEIGHBORS or not (first % step or second % step)
    ]


def _require_enough(model: Any, files: Sequence[Path]) -> None:
    registered = 0 if model is None else model.num_reg_images()
    if registered < max(MIN_SIZE, MIN_POSED_SHARE * len(files)):
        raise SceneError(
            f"{registered} of {len(files)} photographs could be aligned; expected at least half of them: {CURE}"
        )


def _put_back_names(model: Any, files: Sequence[Path]) -> set[str]:
    """Rename the model's images to their file names; returns the names of those with a pose."""
    placed = set()
    for number in model.reg_image_ids():
        image = model.images[number]
        image.name = files[int(image.name.partition(".")[0])].name
        placed.add(image.name)
    return placed


def _turn_upright(model: Any) -> None:
    """Rotate the world so that z is the mean upward direction of the photographs."""
    # The second row of a rotation, world to camera, is the camera's y axis (down) in the world.
    poses = [model.images[number].cam_from_world().matrix() for number in model.reg_image_ids()]
    up = -np.mean([pose[1, :3] for pose in poses], axis=0)
    if np.linalg.norm(up) > np.finfo(np.float64).eps:
        colmap = _pycolmap()
        model.transform(colmap.Sim3d(1.0, colmap.Rotation3d(upright_axes(up / np.linalg.norm(up))), np.zeros(3)))
