"""Worlds of every offset and size, cameras and images of every kind."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from reference_splatting import reference_pixel_weights

from hard_cases import naive
from hard_cases.case import Answer, agrees, powers, refuses
from hard_cases.inputs import (
    NEAR,
    by_ball,
    camera,
    dense_weights,
    int32,
    labelled_cloud,
    scatter,
    single,
    splatted,
    two_balls,
    write_two_balls,
)
from og_pointcloud.ask.labelled_scene import LabelledScene
from og_pointcloud.errors import SceneError
from og_pointcloud.fitting.fit import fit
from og_pointcloud.formats.capture import read_capture
from og_pointcloud.formats.poses import in_local_frame, rigid
from og_pointcloud.rendering.geometry import near_plane
from og_pointcloud.rendering.splatting import NEAR_SHARE, view_weights
from og_pointcloud.scene import Camera, Points

TURNED = np.diag([1.0, -1.0, -1.0, 1.0])
"""A camera that looks the other way."""


@agrees(1e-6, "offset of the world, scene units", powers(0, 8))
def offset(distance: float) -> Answer:
    """A scene at map coordinates: the origin is taken off points and poses in float64."""
    gaussians = scatter()
    away = distance * np.array([1.0, -0.7, 0.3])
    world = gaussians.xyz.astype(np.float64) + away
    seen = in_local_frame(camera(), -away)
    points = Points.from_world(world)
    local = replace(gaussians, xyz=points.xyz)
    shape = gaussians.scale, gaussians.rotation, gaussians.opacity
    return Answer(
        dense_weights(local, in_local_frame(seen, points.origin)),
        reference_pixel_weights(gaussians, camera(), NEAR),
        lambda: naive.pixel_weights(world, *shape, seen, NEAR),
    )


@agrees(1e-6, "size of the scene, units", powers(-6, 6))
def size(units: float) -> Answer:
    """The same scene in other units; naive: the near plane 0.2 units away, as 3DGS fixes it."""
    gaussians = scatter()
    large = replace(gaussians, xyz=(gaussians.xyz * units).astype("f4"), scale=(gaussians.scale * units).astype("f4"))
    return splatted(large, camera(), near=NEAR_SHARE * units, naive_near=0.2)


@agrees(0, "offset of the world, scene units", (0, 1e3, 1e5, 1e6, 1e7))
def offset_from_files(distance: float) -> Answer:
    """A capture folder at map coordinates is labelled as at the origin."""
    away = (distance, -0.7 * distance, 0.3 * distance)
    with tempfile.TemporaryDirectory() as folder:
        balls = write_two_balls(Path(folder), origin=away)
        ids = fit(read_capture(folder), progress=False).instance_ids
    return Answer(by_ball(ids, balls), balls)


@agrees(0, "size of the scene, units", (1e-3, 1e-1, 1e0, 1e2, 1e5))
def size_of_a_fit(units: float) -> Answer:
    """A scene of a millimeter and one of 100 km are labelled alike."""
    scene, balls = two_balls(size=units)
    return Answer(by_ball(fit(scene, progress=False).instance_ids, balls), balls)


@agrees(0, "offset of the world, scene units", powers(0, 8))
def lookup_offset(distance: float) -> Answer:
    """Points of a unit cube at map coordinates find their own instance."""
    away = (distance, -0.7 * distance, 0.3 * distance)
    cloud = labelled_cloud(origin=away)
    world = cloud.xyz_world
    ours = LabelledScene.from_cloud(cloud).instances_at(world + 1e-4)
    return Answer(ours, cloud.instance_ids, lambda: cloud.instance_ids[naive.nearest(world, world + 1e-4)])


@agrees(0, "size of the cube, units", (1e-15, 1e-3, 1.0, 1e5, 1e15))
def lookup_size(units: float) -> Answer:
    """The same in a cube of any size."""
    cloud = labelled_cloud(size=units)
    asked = cloud.xyz_world + 1e-4 * units
    return Answer(LabelledScene.from_cloud(cloud).instances_at(asked), cloud.instance_ids)


@agrees(0)
def lookup_of_anything() -> Answer:
    """NaN, infinity and 1e300 are too far; of coincident points the first answers."""
    cloud = labelled_cloud()
    cloud.xyz[1] = cloud.xyz[0]
    cloud.instance_ids[:2] = [3, 4]
    rows = [[np.nan, 0, 0], [np.inf, 0, 0], [0.5, -np.inf, 0], [1e300, 0, 0], [-1e38, 1e38, 0]]
    asked = np.concatenate([rows, cloud.xyz_world[:2]])
    return Answer(LabelledScene.from_cloud(cloud).instances_at(asked), int32([-3] * 5 + [3, 3]))


@agrees(1e-6, "depth, of the scene's median", (0.5, 0.1, 0.05, 0.03))
def close_object(share: float) -> Answer:
    """A splat much closer to the camera than the rest of the scene is drawn as if there were no near plane."""
    gaussians = scatter()
    depth = share * np.median(gaussians.xyz[1:, 2])
    gaussians.xyz[0], gaussians.scale[0] = [0.1 * depth, 0, depth], 0.05 * depth
    near = near_plane(gaussians.xyz, [camera()])
    return Answer(dense_weights(gaussians, camera(), near), reference_pixel_weights(gaussians, camera(), 1e-9))


@agrees(0)
def camera_sees_nothing() -> Answer:
    """A camera turned away has no weights, nor has one a million units off."""
    away = np.eye(4)
    away[0, 3] = 1e6
    ours = [dense_weights(scatter(), camera(pose=pose)) for pose in (TURNED, away)]
    return Answer(np.stack(ours), np.zeros((2, 18, 24, 10)))


@agrees(0)
def one_camera_sees_nothing() -> Answer:
    """One view that looks away changes no label."""
    scene, balls = two_balls()
    away = rigid(np.eye(3), np.array([0, 0, -1e6]))
    blind = replace(scene.views[0], name="blind", camera=replace(scene.views[0].camera, world_to_camera=away))
    ids = fit(replace(scene, views=(*scene.views, blind)), progress=False).instance_ids
    return Answer(by_ball(ids, balls), balls)


@agrees(1e-6)
def image_of_one_pixel() -> Answer:
    """An image of 1x1."""
    return splatted(scatter(), camera(1, 1, 1.0))


@agrees(1e-6, slow=True)
def image_of_8k() -> Answer:
    """An image of 7680x4320, compared where its splats lie."""
    gaussians = scatter(4)
    gaussians.xyz[:] = [[1.5, 0.8, 2], [-1.5, -0.8, 2], [1.499, 0.8, 2.1], [0, 0, 2]]
    gaussians.scale[:] = 0.003
    large = camera(7680, 4320, 5000.0)
    wanted = np.zeros((4320, 7680), bool)
    for top, left in _CORNERS:
        wanted[top : top + 128, left : left + 160] = True
    weights = view_weights(gaussians, large, NEAR, wanted).toarray().astype(np.float64)
    row = (np.cumsum(wanted) - 1).reshape(wanted.shape)
    ours = [weights[row[top : top + 128, left : left + 160]].sum(axis=(0, 1)) for top, left in _CORNERS]
    windows = (replace(large, width=160, height=128, cx=large.cx - left, cy=large.cy - top) for top, left in _CORNERS)
    exact = [reference_pixel_weights(gaussians, window, NEAR).sum(axis=(0, 1)) for window in windows]
    return Answer(np.array(ours), np.array(exact))


_CORNERS = ((4100, 7500), (100, 20), (2100, 3760))


@agrees(1e-6, "principal point, image widths from the middle", (0, *powers(-2, 4)))
def principal_point(widths: float) -> Answer:
    """A principal point far outside the image; naive: linearised about the axis, as in 3DGS."""
    gaussians, middle = scatter(), camera()
    shifted = replace(middle, cx=middle.cx + widths * middle.width)
    slope = (shifted.cx - middle.cx) / shifted.fx
    moved = gaussians.xyz - gaussians.xyz[:, 2:] * single([slope, 0, 0])
    return splatted(replace(gaussians, xyz=moved), shifted)


@agrees(1e-6, "focal length, image widths", powers(-3, 5, 2))
def focal_length(widths: float) -> Answer:
    """From a view of nearly a half-space to one of a hundred-thousandth of a radian."""
    gaussians = scatter()
    narrow = min(1.0, 1 / widths)
    xyz, shape = gaussians.xyz * single([narrow, narrow, 1]), gaussians.scale * np.float32(narrow)
    return splatted(replace(gaussians, xyz=xyz, scale=shape), camera(focal_px=24 * widths))


@refuses(SceneError, "nan", "expected a finite 4x4 matrix", "drop or repair this view")
def pose_not_a_number() -> object:
    """A tracker that was lost."""
    return camera(pose=np.full((4, 4), np.nan))


@refuses(SceneError, "from a rotation matrix by 3", "expected a rigid right-handed pose", "remove scale or mirroring")
def pose_scaled() -> object:
    """A pose with a scale of 2."""
    return camera(pose=np.diag([2.0, 2.0, 2.0, 1.0]))


@refuses(SceneError, "0x18", "expected whole numbers from 1", "check w and h")
def image_of_no_pixel() -> object:
    """An image of 0x18."""
    return camera(0)


@refuses(SceneError, "(0.0, 22.0", "expected finite numbers, with fx and fy", "check the camera model")
def focal_length_zero() -> object:
    """A focal length of 0."""
    return Camera(24, 18, 0.0, 22.0, 12.0, 9.0, np.eye(4))


@refuses(SceneError, "2 of 10 points contain NaN or infinity (the first is row 3)", "expected finite", "remove them")
def points_not_a_number() -> object:
    """A cloud with NaN in it."""
    xyz = scatter().xyz
    xyz[3], xyz[7, 1] = np.nan, np.inf
    return Points.from_world(xyz)


@refuses(SceneError, "1e+40", "expected less than float32's 3.4e38", "remove the outliers")
def points_beyond_float32() -> object:
    """Coordinates that float32 cannot hold, however they are shifted."""
    return Points.from_world(np.array([[0.0, 0, 0], [1e40, 0, 0], [0, 0, 0]]))
