"""Gaussians of extreme shape, size, opacity and place, compared with the definition of splatting."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
from reference_splatting import reference_pixel_weights

from hard_cases import naive
from hard_cases.case import Answer, agrees, powers, refuses
from hard_cases.inputs import NEAR, camera, dense_weights, scatter, single, splatted
from og_pointcloud.errors import SceneError
from og_pointcloud.formats.ply import join_columns, write_ply
from og_pointcloud.formats.points import read_points
from og_pointcloud.rendering.splatting import Gaussians
from og_pointcloud.scene import Points

WEIGHTS = 1e-6
"""Of blending weights: they are stored as float32, which knows 1 to 6e-8."""


@agrees(WEIGHTS, "axis ratio", powers(0, 6))
def needle(ratio: float) -> Answer:
    """One axis so many times as long as the others: a line across the image at 1e6."""
    gaussians = scatter()
    return splatted(replace(gaussians, scale=single([0.1 * ratio, 0.1, 0.1]) * np.ones((10, 1), "f4")), camera())


@agrees(WEIGHTS, "axis ratio", powers(0, 6))
def pancake(ratio: float) -> Answer:
    """Two axes so many times as long as the third, seen edge-on."""
    gaussians = scatter()
    half = np.arctan2(-gaussians.xyz[:, 0], gaussians.xyz[:, 1]) / 2  # about z, until x is across the line of sight
    rotation = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=1).astype(np.float32)
    flat = single([0.02, 0.02 * ratio, 0.02 * ratio]) * np.ones((10, 1), "f4")
    return splatted(replace(gaussians, scale=flat, rotation=rotation), camera())


@agrees(WEIGHTS, "standard deviation, scene units", (1e-40, 1e-30, 1e-20, *powers(-10, 6, 2)))
def scale(deviation: float) -> Answer:
    """From denormal to a million times the image."""
    gaussians = scatter()
    return splatted(replace(gaussians, scale=np.full((10, 3), deviation, np.float32)), camera())


@agrees(WEIGHTS)
def wider_than_the_image() -> Answer:
    """Faint ones, many times as wide as the image."""
    scale, opacity = np.full((10, 3), 50, np.float32), np.full(10, 0.2, np.float32)
    return splatted(replace(scatter(), scale=scale, opacity=opacity), camera())


@agrees(WEIGHTS)
def scale_zero() -> Answer:
    """Standard deviation exactly 0, in one axis or in all: a splat is never smaller than about a pixel."""
    gaussians = scatter()
    shape = gaussians.scale.copy()
    shape[:5], shape[5:, 1] = 0, 0
    return splatted(replace(gaussians, scale=shape), camera())


@agrees(WEIGHTS)
def needles_across_tile_corners() -> Answer:
    """Diagonal needles a pixel thin, so far from the corners of their tiles that the density there underflows."""
    angle, steps = np.pi / 4, np.arange(-14, 15)
    xyz = single(np.stack([steps / 24, steps / 24, np.full(29, 2.0)], axis=1))
    rotation = np.tile(single([np.cos(angle / 2), 0, 0, -np.sin(angle / 2)]), (29, 1))
    opacity = np.full(29, 0.5, np.float32)
    gaussians = Gaussians(xyz, np.tile(single([2, 1e-6, 1e-6]), (29, 1)), rotation, opacity)
    return splatted(gaussians, camera(32, 32, 24.0))


@agrees(WEIGHTS)
def opacity_ends() -> Answer:
    """Opacity exactly 0 and 1, the latter also in the middle of a pixel, denormal, and just below 1."""
    gaussians = replace(scatter(), opacity=single([0, 1, 1e-40, 0.002, 1, 0.99999994, 0, 1, 0.5, 1]))
    gaussians.xyz[1] = [0, 0, 1.5]
    return splatted(gaussians, camera(25, 19))


@agrees(WEIGHTS, "length of the quaternion", powers(-36, 36, 9))
def quaternion_length(length: float) -> Answer:
    """Quaternions of a file that are not unit: their direction counts."""
    gaussians = scatter()
    raw = (gaussians.rotation.astype(np.float64) * length).astype(np.float32)
    unit = raw / np.linalg.norm(raw.astype(np.float64), axis=1, keepdims=True)
    answer = splatted(_read(gaussians, rotation=raw), camera())
    exact = reference_pixel_weights(replace(gaussians, rotation=unit), camera(), NEAR)
    shape = gaussians.xyz, gaussians.scale

    def plain() -> np.ndarray:
        return naive.pixel_weights(*shape, naive.unit(raw), gaussians.opacity, camera(), NEAR)

    return replace(answer, reference=exact, naive=plain)


@agrees(WEIGHTS)
def quaternion_zero() -> Answer:
    """A zero quaternion in a file is no rotation."""
    gaussians = scatter()
    identity = np.tile(single([1, 0, 0, 0]), (10, 1))
    exact = reference_pixel_weights(replace(gaussians, rotation=identity), camera(), NEAR)
    return Answer(dense_weights(_read(gaussians, rotation=0 * gaussians.rotation), camera()), exact)


@agrees(WEIGHTS)
def infinite_logits() -> Answer:
    """Logits of +-inf and logarithms of -inf in a file are opacities 1 and 0 and a flat axis."""
    gaussians = scatter()
    logit = single([np.inf, -np.inf] * 5)
    flat = gaussians.scale * single([1, 1, 0])
    with np.errstate(divide="ignore"):
        read = _read(gaussians, log_scale=np.log(flat), logit=logit)
    exact = reference_pixel_weights(replace(gaussians, scale=flat, opacity=(logit > 0).astype("f4")), camera(), NEAR)
    return Answer(dense_weights(read, camera()), exact)


@refuses(SceneError, "10 of 10 Gaussians are not finite", "expected finite values", "export it again")
def scale_beyond_float32() -> object:
    """Log scales of 89, whose exponential leaves float32."""
    log_scale = np.log(scatter().scale)
    log_scale[:, 1] = 89
    return _read(scatter(), log_scale=log_scale)


@refuses(SceneError, "opacity of Gaussian 4 is nan", "expected", "activate")
def opacity_not_a_number() -> object:
    """Gaussians made by hand with an opacity of NaN."""
    gaussians = scatter()
    opacity = gaussians.opacity.copy()
    opacity[4] = np.nan
    return Points(gaussians.xyz, np.zeros(3), scale=gaussians.scale, rotation=gaussians.rotation, opacity=opacity)


@refuses(SceneError, "rotation of Gaussian 0 is [", "expected", "divide")
def rotation_not_unit() -> object:
    """Gaussians made by hand with quaternions of length 3, which would be drawn three times as large."""
    gaussians = scatter()
    parts = gaussians.scale, 3 * gaussians.rotation, gaussians.opacity
    return Points(gaussians.xyz, np.zeros(3), None, *parts)


@agrees(WEIGHTS, "distance to the near plane, of its depth", powers(-1, -12, -1))
def near_plane(share: float) -> Answer:
    """Centers this far before and this far behind the near plane: the former are drawn, the latter not."""
    xyz = single([[-0.2, 0, 1], [0.2, 0, 1]])
    gaussians = Gaussians(xyz, np.full((2, 3), 0.03, "f4"), scatter(2).rotation, single([0.6, 0.6]))
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, 2, 3] = 0.5 * (1 + share * np.array([1, -1])) - 1  # the centers are at z = 1, the near plane at 0.5
    sides = [splatted(gaussians, camera(pose=pose), near=0.5) for pose in poses]
    return Answer(
        np.stack([side.ours for side in sides]),
        np.stack([side.reference for side in sides]),
        lambda: np.stack([side.naive() for side in sides if side.naive]),
    )


@agrees(WEIGHTS)
def on_and_behind_the_near_plane() -> Answer:
    """A center exactly on the near plane, one at the camera's center, some behind it: none is drawn."""
    gaussians = scatter(5)
    xyz = gaussians.xyz.copy()
    xyz[:4] = [[0, 0, 0.5], [0, 0, 0], [0, 0, -1], [0.1, 0, -1e-30]]
    return splatted(replace(gaussians, xyz=xyz), camera(), near=0.5)


@agrees(WEIGHTS, "depth, scene units", powers(0, -9, -1))
def close_to_the_camera(depth: float) -> Answer:
    """Centers this close to the camera, whose splats grow as one over it."""
    gaussians = scatter()
    xyz = gaussians.xyz / gaussians.xyz[:, 2:] * np.float32(depth)
    return splatted(replace(gaussians, xyz=xyz.astype(np.float32)), camera(), near=1e-12)


@agrees(WEIGHTS, "Gaussians", (10, 100, 1000, 2500))
def many_on_one_pixel(count: float) -> Answer:
    """So many faint Gaussians along one ray."""
    n, random = int(count), np.random.default_rng(0)
    xyz = np.c_[np.zeros((n, 2)), random.uniform(2, 4, n)].astype(np.float32)
    opacity = random.uniform(0.005, 0.008, n).astype(np.float32)
    return splatted(Gaussians(xyz, np.full((n, 3), 0.02, "f4"), scatter(n).rotation, opacity), camera(5, 5))


@agrees(WEIGHTS)
def coincident_points() -> Answer:
    """200 Gaussians in one place: blended in the order of their indices."""
    gaussians = scatter(200)
    return splatted(replace(gaussians, xyz=np.tile(single([0.1, 0, 3]), (200, 1))), camera(8, 8))


@agrees(WEIGHTS, "threads", (1, 2))
def equal_depths(threads: float) -> Answer:
    """300 Gaussians at equal depths, on one thread and on several: blended in the order of their indices."""
    gaussians = scatter(300)
    gaussians.xyz[:, 2] = 3
    every = numba.get_num_threads()
    try:
        numba.set_num_threads(min(int(threads), numba.config.NUMBA_NUM_THREADS))
        return splatted(gaussians, camera())
    finally:
        numba.set_num_threads(every)


def _read(
    gaussians: Gaussians, rotation: np.ndarray | None = None, log_scale: np.ndarray | None = None,
    logit: np.ndarray | None = None,
) -> Gaussians:  # fmt: skip
    """The Gaussians through a trained file, some of its columns replaced."""
    opacity = gaussians.opacity.astype(np.float64)
    groups = {
        ("x", "y", "z"): gaussians.xyz.astype(np.float64),
        ("opacity",): (np.log(opacity / (1 - opacity)) if logit is None else logit)[:, None],
        ("scale_0", "scale_1", "scale_2"): np.log(gaussians.scale, dtype=float) if log_scale is None else log_scale,
        ("rot_0", "rot_1", "rot_2", "rot_3"): gaussians.rotation if rotation is None else rotation,
    }
    columns = {name: values[:, i] for names, values in groups.items() for i, name in enumerate(names)}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "gaussians.ply"
        write_ply(path, {"vertex": join_columns(columns)})
        points = read_points(path)
    return replace(Gaussians.from_points(points), xyz=points.xyz_world.astype(np.float32))
