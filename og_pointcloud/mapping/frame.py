"""A frame: the input of one posed image to a map, checked before the map is changed."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.ask.hosts import world_points
from og_pointcloud.cloud import UNKNOWN_SPACE, FeatureSpace
from og_pointcloud.errors import FeatureSpaceError, SceneError
from og_pointcloud.formats.depth import lengths
from og_pointcloud.formats.poses import in_local_frame
from og_pointcloud.formats.tables import naming
from og_pointcloud.mapping.sight import AGREES, MeasuredView, states_of_points, view_of_depth
from og_pointcloud.scene import Camera, View, numbers_of

COMPARED_POINTS = 4000
"""Approximate number of map points that a frame's depth is compared with."""
MIN_COMPARED_POINTS = 200
"""With fewer there is no check: the frame looks at a part of the place that the map does not know."""
GRID_CELLS, MAX_DEPTH_RATIO = 16, 1.2
"""Cells of an image along each side; a point more than MAX_DEPTH_RATIO times as far as the nearest one of its cell may
be hidden by it."""
MIN_AGREEING_SHARE = 0.25
"""Share of the map points in front of a camera whose depth it must confirm: only a small part of a place moves."""
OTHER_UNIT_RATIO = 2.5
"""Ratio of measured to expected depths above which the unit of length differs: a meter is 3.3 feet."""
MAX_RATIO_SPREAD = 1.2
"""In another unit all depths are off by one factor: three quarters of the ratios span less than this times their
median."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One posed image of a stream. Everything but the camera may be missing.

    camera: world_to_camera from world coordinates (not a scene's local ones). None is refused: nothing can be placed
    without a pose.
    masks: (H, W) int, -1 outside of masks (or NOT_SEEN, as in `View`), else a row of features; H, W the camera's.
    features: (M, D) float, one row per mask, as the encoder gave it.
    depth: (H, W) along the optical axis, possibly sparse: float in world units, 0 or NaN where nothing was measured; or
    integers, millimeters of a world in meters, as in depth images (`formats.depth.lengths`).
    cloud: (n, 3) float, world coordinates, or any cloud that `og.segment` takes, measured from this camera's position,
    instead of depth.
    rgb: (H, W, 3) uint8. stamp: seconds, or any count that grows with time; None: one more than the last frame's.
    feature_space: name of the features' encoder, which must be the map's; a map without one takes it over. None: not
    stated.

    >>> camera = og.Camera(64, 48, 60.0, 60.0, 32.0, 24.0, np.eye(4))
    >>> frame = og.Frame(camera, masks=np.full((48, 64), -1), stamp=12.5)
    """

    camera: Camera | None
    masks: NDArray[np.integer] | None = None
    features: NDArray[np.floating] | None = None
    depth: NDArray[np.floating | np.integer] | None = None
    cloud: Any = None
    rgb: NDArray[np.uint8] | None = None
    stamp: float | None = None
    feature_space: str | None = None


@dataclass(frozen=True)
class CheckedFrame:
    """A frame that passed all checks. camera: pose from the map's local frame. ids: (H, W) int32 mask image, -1 none.
    features: (M, D) float32. view: surfaces measured by its depth, None without. rgb: (H, W, 3) uint8 or None. space:
    of the map's descriptors once the frame is in it."""

    camera: Camera
    ids: NDArray[np.int32]
    features: NDArray[np.float32]
    view: MeasuredView | None
    rgb: NDArray[np.uint8] | None
    stamp: float
    space: FeatureSpace


def checked(frame: Frame, origin: NDArray[np.float64], space: FeatureSpace, stamp: float) -> CheckedFrame:
    """The frame in a map's local frame (world = local + origin). SceneError, or FeatureSpaceError, says what is wrong.

    space: of the map's descriptors, of width 0 while it has none. stamp: for a frame without one.
    """
    if not isinstance(frame, Frame):
        raise SceneError(f"a frame is a {type(frame).__name__}; expected an og.Frame")
    stamp = stamp if frame.stamp is None else frame.stamp
    # Compared, which fractions and whole numbers of any size can be; NaN is not at most anything.
    if not (isinstance(stamp, Real) and abs(stamp) <= sys.float_info.max):
        raise SceneError(f"frame stamp is {stamp!r:.80}; expected a finite number: seconds, or a count")
    stamp = float(stamp)
    name = f"frame {stamp:.15g}"
    if frame.camera is None:
        raise SceneError(f"{name} has no camera; expected an og.Camera with its pose: drop frames that lost track")
    if not isinstance(frame.camera, Camera):
        raise SceneError(f"{name}: its camera is a {type(frame.camera).__name__}; expected an og.Camera")
    camera = in_local_frame(frame.camera, origin)
    if frame.depth is not None and frame.cloud is not None:
        raise SceneError(f"{name} has both depth and a cloud; expected only one: leave out the sparser one")
    ids, features = _masks(frame, camera, name)
    if len(features):
        own = FeatureSpace(UNKNOWN_SPACE if frame.feature_space is None else frame.feature_space, features.shape[1])
        space.require(own, f"mask features of {name}")
        space = FeatureSpace(own.name if space.name == UNKNOWN_SPACE else space.name, own.width)
    depth = _depth(frame, origin, camera, name)
    rgb = None if frame.rgb is None else numbers_of(frame.rgb)
    if rgb is not None and (rgb.shape != (camera.height, camera.width, 3) or rgb.dtype != np.uint8):
        raise SceneError(f"{name}: rgb is {rgb.dtype} {rgb.shape}; expected uint8 ({camera.height}, {camera.width}, 3)")
    view = view_of_depth(depth, camera) if depth.any() else None
    return CheckedFrame(camera, ids, features, view, rgb, stamp, space)


def in_arrays(frame: Frame) -> Frame:
    """The frame with plain arrays instead of tensors, lists and clouds."""
    given = {name: getattr(frame, name) for name in ("masks", "features", "depth", "rgb")}
    arrays = {name: numbers_of(value) for name, value in given.items() if value is not None}
    return replace(frame, **arrays, cloud=None if frame.cloud is None else world_points(frame.cloud))


def _masks(frame: Frame, camera: Camera, name: str) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    features = np.zeros((0, 0), np.float32) if frame.features is None else numbers_of(frame.features)
    if features.dtype.kind not in "fiu" or features.ndim != 2:
        raise FeatureSpaceError(
            f"{name}: mask features are {features.dtype} {features.shape}; expected numbers of shape (masks, D)"
        )
    with np.errstate(over="ignore"):  # what float32 cannot hold becomes inf, which View refuses
        features = features.astype(np.float32)
    if frame.masks is None:
        ids = np.full((camera.height, camera.width), -1, np.int32)
    else:
        ids = numbers_of(frame.masks)
        if ids.dtype.kind not in "iu" or ids.ndim != 2:
            raise SceneError(
                f"{name}: masks are {ids.dtype} {ids.shape}; expected whole numbers of shape ({camera.height}, "
                f"{camera.width}): rows of features, -1 outside of masks"
            )
    if ids.max(initial=-1) >= len(features):
        raise SceneError(
            f"{name}: mask id {ids.max()} has no feature row; expected one for each id: there are {len(features)}, "
            "counted from 0"
        )
    view = View(name, camera, ids, features)  # checks sizes, ids and finite rows
    return np.maximum(view.mask_map(), -1), features


def _depth(frame: Frame, origin: NDArray[np.float64], camera: Camera, name: str) -> NDArray[np.float32]:
    """(H, W), 0 where nothing was measured; for a cloud, the nearest point in each pixel."""
    depth = np.zeros((camera.height, camera.width), np.float32) if frame.depth is None else numbers_of(frame.depth)
    if depth.shape != (camera.height, camera.width) or depth.dtype.kind not in "fiu":
        raise SceneError(
            f"{name}: depth is {depth.dtype} {depth.shape}; expected numbers of shape ({camera.height}, {camera.width})"
        )
    if frame.cloud is not None:
        with naming(name):
            cloud = world_points(frame.cloud)
        uv_px, z = camera.project(cloud[np.isfinite(cloud).all(axis=1)] - origin)
        inside = camera.shows(uv_px)
        column, row = uv_px[inside].astype(np.intp).T
        depth = np.full(depth.shape, np.inf, np.float32)
        np.minimum.at(depth, (row, column), z[inside].astype(np.float32))
    return lengths(depth)


def require_same_place(stamp: float, view: MeasuredView, xyz: NDArray[np.float32], tolerance: float) -> None:
    """SceneError if a frame's depth contradicts nearly all map points in front of it: its pose or unit is wrong.

    xyz: (n, 3) points of the map near the frame, some of them hidden by others. tolerance: as in `states_of_points`.
    Only a small part of a place moves, but a wrong pose moves all of it. A frame that hardly meets the map passes.
    """
    uv_px, z = view.camera.project(xyz)
    inside = view.camera.shows(uv_px)
    column, row = uv_px[inside].astype(np.intp).T
    measured, z = view.depth[row, column], z[inside]
    # Points that the map itself hides are no evidence: for a camera close to a wall, most of the place is behind it.
    cell = row * GRID_CELLS // view.camera.height * GRID_CELLS + column * GRID_CELLS // view.camera.width
    nearest = np.full(GRID_CELLS**2, np.inf)
    np.minimum.at(nearest, cell, z)
    met = (measured > 0) & (z < MAX_DEPTH_RATIO * nearest[cell])
    if np.count_nonzero(met) < MIN_COMPARED_POINTS:
        return
    agreeing = float((states_of_points(xyz[inside][met], tolerance, view) == AGREES).mean())
    if agreeing >= MIN_AGREEING_SHARE:
        return
    # The same factor nearly everywhere means another unit of length; other causes cannot be told apart.
    low, middle, high = np.percentile(measured[met] / z[met], [12.5, 50, 87.5])
    if high - low < MAX_RATIO_SPREAD * middle and max(middle, 1 / middle) > OTHER_UNIT_RATIO:
        what = (
            f"its depths are about {float(f'{middle:.3g}'):g} times what the map expects: give them in the map's unit"
        )
    else:
        what = (
            "its pose is off, it shows another place, or something blocks the camera: check these, or correct "
            "the map after a loop closure"
        )
    raise SceneError(
        f"frame {stamp:.15g} confirms {agreeing:.0%} of the {np.count_nonzero(met)} map points in front of it; "
        f"expected at least {MIN_AGREEING_SHARE:.0%}: {what}"
    )
