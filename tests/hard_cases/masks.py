"""Masks that are missing, tiny, huge, many, alike in all views or at odds between views."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hard_cases.case import Answer, agrees, powers, refuses
from hard_cases.inputs import NEAR, by_ball, camera, scatter, two_balls, unit_rows
from og_pointcloud.cloud import UNOBSERVED
from og_pointcloud.errors import SceneError
from og_pointcloud.fitting.fit import fit
from og_pointcloud.fitting.mask_table import mask_table
from og_pointcloud.scene import Scene, View
from og_pointcloud.settings import FitSettings


@agrees(1e-6, "masks in the view", (0, *powers(0, 4)))
def mask_count(count: float) -> Answer:
    """None, one, ... a mask for each of 10,000 pixels: votes on a point add up to what the view sees of it."""
    masks, large, gaussians = int(count), camera(100, 100, 90.0), scatter(200)
    ids = np.full(10_000, -1, np.int32) if masks == 0 else (np.arange(10_000) * masks // 10_000).astype(np.int32)
    view = View("one", large, ids.reshape(100, 100), np.zeros((masks, 4), np.float32))
    table = mask_table(gaussians, [view], NEAR, np.full(200, 0.1, np.float32))
    return Answer(table.weights.sum(axis=0) + table.outside.sum(axis=0), table.exposure.sum(axis=0))


@refuses(SceneError, "none of the 5 views has a mask", "expected at least one", "make masks first")
def no_mask_at_all() -> object:
    """Views without any mask."""
    return fit(_with_masks(lambda _, ids: 0 * ids - 1, np.zeros((0, 8), np.float32)), progress=False)


@refuses(SceneError, "none of the 10 masks shows a Gaussian", "expected at least one", "check that poses and cloud")
def masks_without_pixels() -> object:
    """Feature rows for two masks a view, of which no pixel is drawn."""
    return fit(_with_masks(lambda _, ids: 0 * ids - 1), progress=False)


@refuses(SceneError, "the mask map contains -3", "expected rows of mask_features, -1 or -2", "set pixels")
def mask_id_below_none() -> object:
    """A mask id of -3, below those for "no mask" and "not seen"."""
    return fit(_with_masks(lambda _, ids: ids - 2), progress=False)


@refuses(SceneError, "the mask image is 20x36 pixels", "its camera 48x36", "make the masks at the image's size")
def mask_of_another_size() -> object:
    """A mask map that does not fit its camera."""
    return fit(_with_masks(lambda _, ids: ids[:, :20]), progress=False)


@agrees(0)
def one_view_without_masks() -> Answer:
    """One view of six without a mask: the others decide."""
    scene, balls = two_balls(6)
    bare = replace(scene.views[2], masks=np.full((36, 48), -1, np.int32), mask_features=np.zeros((0, 0), np.float32))
    views = (*scene.views[:2], bare, *scene.views[3:])
    return Answer(by_ball(fit(replace(scene, views=views), progress=False).instance_ids, balls), balls)


@agrees(0)
def one_mask_in_one_view() -> Answer:
    """A single mask in a single view is one instance, with its feature."""
    scene, _ = two_balls(1)
    left = np.where(scene.views[0].mask_map() == 0, 0, -1).astype(np.int32)
    view = replace(scene.views[0], masks=left, mask_features=unit_rows(1, 8))
    cloud = fit(replace(scene, views=(view,)), progress=False)
    return Answer(np.r_[len(cloud.instances), cloud.instances.descriptor_instance], np.array([1, 0]))


@agrees(0)
def mask_of_one_pixel() -> Answer:
    """A third mask of a single pixel in every view changes no label of the others."""
    features = unit_rows(3, 8)

    def dotted(_: int, ids: NDArray[np.int32]) -> NDArray[np.int32]:
        ids = ids.copy()
        ids[0, 0] = 2
        return ids

    scene = _with_masks(dotted, features)
    return Answer(by_ball(fit(scene, progress=False).instance_ids, two_balls()[1]), two_balls()[1])


@agrees(0)
def the_whole_image() -> Answer:
    """One mask that is the whole image, in every view: everything is one instance."""
    ids = fit(_with_masks(lambda _, ids: 0 * ids, unit_rows(1, 8)), progress=False).instance_ids
    return Answer(ids, np.zeros(600, np.int32))


@agrees(0)
def shuffled_mask_ids() -> Answer:
    """Ids that mean another thing in every view, and views in another order: the same labels."""
    scene, balls = two_balls()
    turned = []
    for index, view in enumerate(scene.views):
        swap = index % 2 == 1
        ids = np.where(view.mask_map() >= 0, 1 - view.mask_map(), -1).astype(np.int32) if swap else view.mask_map()
        turned.append(replace(view, masks=ids, mask_features=view.mask_features[:: -1 if swap else 1].copy()))
    ids = fit(replace(scene, views=tuple(turned[::-1])), progress=False).instance_ids
    return Answer(by_ball(ids, balls), balls)


@agrees(0, "mode: grouping 0, fast 1", (0, 1), slow=True)
def contradictory_masks(mode: float) -> Answer:
    """Masks of unrelated halves of the image in every view: ids, descriptors and certainties are all in their range."""
    halves: tuple[Callable[[int, NDArray[np.int32]], NDArray[np.int32]], ...] = (
        lambda _, ids: np.broadcast_to(np.arange(48) // 24, ids.shape).astype(np.int32),
        lambda _, ids: np.broadcast_to(np.arange(36)[:, None] // 18, ids.shape).astype(np.int32),
    )
    scene = _with_masks(lambda index, ids: halves[index % 2](index, ids))
    cloud = fit(scene, FitSettings(mode="fast" if mode else "grouping"), progress=False)
    length = np.linalg.norm(cloud.instances.descriptors, axis=1)
    known = (cloud.instance_ids >= UNOBSERVED) & (cloud.instance_ids < len(cloud.instances))
    return Answer(np.r_[known, np.abs(length - 1) < 1e-5], np.ones(len(known) + len(length), bool))


def _with_masks(
    change: Callable[[int, NDArray[np.int32]], NDArray[np.int32]], features: NDArray[np.float32] | None = None
) -> Scene:
    """Two balls, with every mask map changed."""
    scene, _ = two_balls()
    views = [
        replace(
            view,
            masks=change(index, view.mask_map()),
            mask_features=view.mask_features if features is None else features,
        )
        for index, view in enumerate(scene.views)
    ]
    return replace(scene, views=tuple(views))
