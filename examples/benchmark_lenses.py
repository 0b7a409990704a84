"""The demo's room photographed by other lenses: labels and seconds beside those of pinhole images, one row per lens.

    python examples/benchmark_lenses.py [--seeds N ...] [--noise LEVEL] [--every N] [--runs N]

pinhole       60 images of 640x480, as in the demo
fisheye       60 images of 640x480 from the same places, equidistant, 180 degrees across
its faces     what it is split into, but rendered as pinhole images with their own masks: the cost of splitting
spherical     20 panoramas of 1280x640 from every third place (--every)
its faces     as above

Masks and features are simulated as for the demo, on each image as it is, except that the smallest mask has as many
pixels in all of them as in the demo's: as a share of the image it would have 2.7 times as many on a panorama, a third
on its faces. Points and truth are the same in all rows. Seconds are processor seconds; the ratio is to those of pinhole
images. The first fit compiles: for ratios take two runs or more (--runs), where the least seconds count.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from og_pointcloud_room.capture import TEXTURE, CaptureSettings, RoomCapture, make_capture, mask_features, write_capture
from og_pointcloud_room.features import FeatureModel
from og_pointcloud_room.furniture import CLASS_NAMES
from og_pointcloud_room.masks import MaskNoise, propose_masks
from og_pointcloud_room.raycast import RayCaster

import og_pointcloud as og
from og_pointcloud.evaluate.metrics import score_labels
from og_pointcloud.formats.faces import faces
from og_pointcloud.formats.lenses import SPHERICAL, Lens, lens_of, spherical_camera
from og_pointcloud.scene import Camera

FISHEYE, PANORAMA = (640, 480), (1280, 640)
LENS_STREAM = 50
"""Random number stream, besides the demo's."""


@dataclass(frozen=True)
class Photographer:
    """What a `RayCaster` needs of a camera, its pose, and its entries in transforms.json.

    rays: (H, W, 3). pose: camera to world, OpenCV axes.
    """

    width: int
    height: int
    focal_px: float
    rays: NDArray[np.float64]
    pose: NDArray[np.float64]
    keys: dict[str, Any]

    def directions(self) -> NDArray[np.float64]:
        """The rays."""
        return self.rays


def pinhole(camera: Camera) -> Photographer:
    """camera: from the room's coordinates."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    rays = np.stack([*np.meshgrid(x, y), np.ones((camera.height, camera.width))], axis=2)
    return _photographer(camera, rays.astype(np.float64), "PINHOLE")


def fisheye(pose: NDArray[np.float64]) -> Photographer:
    """Equidistant: the angle from the axis is the distance from the image's middle."""
    width, height = FISHEYE
    focal = width / np.pi
    x, y = np.meshgrid((np.arange(width) + 0.5 - width / 2) / focal, (np.arange(height) + 0.5 - height / 2) / focal)
    theta = np.hypot(x, y)
    shrunk = np.sinc(theta / np.pi)
    camera = Camera(width, height, focal, focal, width / 2, height / 2, _inverse(pose))
    return _photographer(camera, np.stack([shrunk * x, shrunk * y, np.cos(theta)], axis=2), "OPENCV_FISHEYE")


def panorama(pose: NDArray[np.float64]) -> Photographer:
    """Columns are longitudes, rows latitudes."""
    width, height = PANORAMA
    longitude = ((np.arange(width) + 0.5) / width - 0.5) * 2 * np.pi
    latitude = ((np.arange(height) + 0.5) / height - 0.5) * np.pi
    east, down = np.meshgrid(longitude, latitude)
    rays = np.stack([np.cos(down) * np.sin(east), np.sin(down), np.cos(down) * np.cos(east)], axis=2)
    return _photographer(spherical_camera(width, height, _inverse(pose)), rays, "EQUIRECTANGULAR")


def _inverse(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.linalg.inv(pose), np.float64)


def _photographer(camera: Camera, rays: NDArray[np.float64], model: str) -> Photographer:
    keys = {"w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx}
    keys |= {"cy": camera.cy, "camera_model": model}
    return Photographer(camera.width, camera.height, camera.fx, rays, _inverse(camera.world_to_camera), keys)


def photographed(
    capture: RoomCapture, cameras: Sequence[Photographer], noise: MaskNoise, seed: int
) -> tuple[RoomCapture, Sequence[Photographer]]:
    """The same room and cloud with other photographs, and masks and features on them."""
    caster = RayCaster(capture.room, np.random.default_rng([seed, TEXTURE]))
    frames = tuple(caster.look(cast("Any", camera), camera.pose) for camera in cameras)
    rng = np.random.default_rng([seed, LENS_STREAM])
    model = FeatureModel(len(CLASS_NAMES), np.random.default_rng([seed, LENS_STREAM, 1]))
    looks = np.stack([model.object_look(rng) for _ in capture.room.objects])
    class_of = np.array([CLASS_NAMES.index(item.name) for item in capture.room.objects], np.int32)
    smallest_px = noise.smallest_share * capture.intrinsics.width * capture.intrinsics.height
    masks = tuple(
        propose_masks(frame.owner, replace(noise, smallest_share=smallest_px / frame.owner.size), rng)
        for frame in frames
    )
    features = tuple(
        mask_features(ids, frame.owner, class_of, looks, model, noise.wrong_class, rng)
        for ids, frame in zip(masks, frames, strict=True)
    )
    return replace(capture, frames=frames, masks=masks, mask_features=features, text_vectors=model.texts), cameras


def faces_of(cameras: Sequence[Photographer], lens: Lens) -> list[Photographer]:
    """Pinhole cameras of the views that these photographs are split into."""
    views = []
    for camera in cameras:
        k = camera.keys
        pose = _inverse(camera.pose)
        whole = Camera(camera.width, camera.height, k["fl_x"], k["fl_y"], k["cx"], k["cy"], pose)
        views += [pinhole(face.camera) for face in faces(whole, lens)]
    return views


def lenses(capture: RoomCapture, every: int) -> dict[str, list[Photographer]]:
    """The cameras of each row. every: number of places per panorama."""
    places = [frame.camera_to_world for frame in capture.frames]
    equidistant = lens_of("fisheye", {})
    assert equidistant is not None
    fisheyes, panoramas = [fisheye(pose) for pose in places], [panorama(pose) for pose in places[::every]]
    return {
        "pinhole": [pinhole(capture.intrinsics.camera(at)) for at in places],
        "fisheye": fisheyes,
        "its faces": faces_of(fisheyes, equidistant),
        "spherical": panoramas,
        "its faces ": faces_of(panoramas, SPHERICAL),
    }


def written(capture: RoomCapture, cameras: Sequence[Photographer], folder: Path) -> Path:
    """The folder, with the capture written to it."""
    write_capture(capture, folder)
    content = json.loads((folder / "transforms.json").read_text())
    for frame, camera in zip(content["frames"], cameras, strict=True):
        frame.update(camera.keys)
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


@dataclass(frozen=True)
class Row:
    """Cost and result of one fit. read, fit: processor seconds of reading and of the fit."""

    views: int
    miou: float
    read: float
    fit: float


def row(capture: RoomCapture, folder: Path) -> Row:
    """One fit of a capture in a folder."""
    start = time.process_time()
    scene = og.read_capture(folder)
    read = time.process_time()
    cloud = og.fit(scene, progress=False)
    done = time.process_time()
    words = dict(zip(CLASS_NAMES, capture.text_vectors, strict=True))
    result = og.segment(cloud, words)
    score = score_labels(result.labels, capture.cls, background=capture.background)
    return Row(len(scene.views), score.miou, read - start, done - read)


def main(arguments: list[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--noise", type=float, default=1.0)
    parser.add_argument("--views", type=int, default=60)
    parser.add_argument("--every", type=int, default=3, help="of so many places one has a panorama (1: all)")
    parser.add_argument("--runs", type=int, default=1, help="fits of each lens, taken in turn: the least seconds count")
    options = parser.parse_args(arguments)
    noise = MaskNoise().scaled(options.noise)
    print(f"{'seed':>4} {'lens':<10} {'views':>5} {'mIoU':>6} {'read s':>7} {'fit s':>6} {'ratio':>5}")
    for seed in options.seeds:
        room = make_capture(seed, CaptureSettings(views=options.views))
        with tempfile.TemporaryDirectory() as folder:
            captures = {
                name: photographed(room, cameras, noise, seed) for name, cameras in lenses(room, options.every).items()
            }
            folders = [written(*captures[name], Path(folder) / str(number)) for number, name in enumerate(captures)]
            runs = [
                [row(capture, at) for (capture, _), at in zip(captures.values(), folders, strict=True)]
                for _ in range(options.runs)
            ]
        rows = [min(of_lens, key=lambda row: row.read + row.fit) for of_lens in zip(*runs, strict=True)]
        for name, best in zip(captures, rows, strict=True):
            ratio = (best.read + best.fit) / (rows[0].read + rows[0].fit)
            seconds = f"{best.read:>7.2f} {best.fit:>6.1f} {ratio:>5.2f}"
            print(f"{seed:>4} {name:<10} {best.views:>5} {best.miou:>6.3f} {seconds}", flush=True)


if __name__ == "__main__":
    main()
