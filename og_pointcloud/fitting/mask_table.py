"""Frozen geometry + views -> the mask table: how much each Gaussian shows in each mask of each view.

One pass over each view (`splatting.view_weights`), several side by side; the rows go to a `TableStore`, which knows
where there is room for them. Views that an interrupted fit left in a work folder are not rendered again.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from hashlib import blake2b
from itertools import chain, islice
from typing import TypeVar

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from og_pointcloud.fitting.table_store import TableStore
from og_pointcloud.rendering.splatting import (
    CUTOFFS,
    FRUSTUM_MARGIN,
    NEAR_SHARE,
    Cutoffs,
    Gaussians,
    ViewWeights,
    pixel_weights,
    render,
    view_weights,
    working_memory,
)
from og_pointcloud.scene import View

__all__ = [
    "FRUSTUM_MARGIN",
    "NEAR_SHARE",
    "Cutoffs",
    "Gaussians",
    "MaskTable",
    "ViewWeights",
    "mask_table",
    "pixel_weights",
    "render",
    "table_key",
    "view_weights",
    "working_memory",
]

Shown = TypeVar("Shown")

SEEN_THROUGH = 0.1
"""What a weight through a surface counts as exposure. Not 0: a point that no view sees otherwise keeps its say."""
VERSION = b"1"
"""Of the weights: rows that a killed fit of another version left are not taken up."""


@dataclass(frozen=True)
class MaskTable:
    """What every mask of every view shows of every Gaussian, and what shows outside all masks.

    weights: (masks, n) sparse float32, ``A`` above, masks stacked view by view.
    outside: (views, n) sparse float32, the same for each view's pixels without a mask.
    exposure: (views, n) sparse float32, the part of each Gaussian's own splat that reaches the camera: about 1 in
        front, small behind other splats, and smaller still where it only shows through a surface.
    mask_view: (masks,) int32, the view of each mask. mask_pixels: (masks,) int32, area in pixels.
    mask_features: (masks, D) float32, as the encoder gave them.
    """

    weights: csr_array
    outside: csr_array
    exposure: csr_array
    mask_view: NDArray[np.int32]
    mask_pixels: NDArray[np.int32]
    mask_features: NDArray[np.float32]

    @property
    def unit_features(self) -> NDArray[np.float32]:
        """(masks, D) mask features of length 1; zero rows stay zero. Lengths of 1e30 would overflow float32."""
        wide = self.mask_features.astype(np.float64)
        length = np.linalg.norm(wide, axis=1, keepdims=True)
        return (wide / np.where(length > 0, length, 1)).astype(np.float32)

    @property
    def seen(self) -> NDArray[np.float64]:
        """(n,) float64: pixels' worth of blending weight of each Gaussian over all views, masked or not."""
        return np.asarray(self.weights.sum(axis=0) + self.outside.sum(axis=0), np.float64)


def mask_table(
    gaussians: Gaussians,
    views: Iterable[View],
    near: float,
    thickness: NDArray[np.float32] | None = None,
    store: TableStore | None = None,
    at_once: int | None = None,
    cutoffs: Cutoffs = CUTOFFS,
) -> MaskTable:
    """The mask table of all views, one pass over each.

    near: depth of the near plane, scene units. thickness: (n,) how far behind the surface in front of it a Gaussian may
    lie and still belong to it, scene units; what lies farther is seen through it and counts
    SEEN_THROUGH. None: all counts alike.
    store: where the rows go; None: into memory. Its views that are the first of these are not rendered again.
    at_once: views worked on side by side at most, None: as many as there are threads.
    """
    store = store or TableStore(len(gaussians))
    of_views: list[tuple[NDArray[np.int32], NDArray[np.float32]]] = []

    def note(view: View, ids: NDArray[np.int32]) -> None:
        pixels = np.bincount(ids.ravel() + 1, minlength=view.mask_count + 1)[1:].astype(np.int32)
        of_views.append((pixels, view.mask_features))

    def show(view: View) -> tuple[View, NDArray[np.int32], str, ViewWeights, csr_array]:
        ids = view.mask_map()
        shown = view_weights(gaussians, view.camera, ids, view.mask_count, near, thickness, cutoffs)
        return view, ids, _mark(view, ids) if store.folder else "", shown, _exposure(shown)

    coming = iter(views)
    for view in coming if store.marks else ():
        ids = view.mask_map()
        if len(of_views) == len(store.marks) or _mark(view, ids) != store.marks[len(of_views)]:
            coming = chain([view], coming)
            break
        note(view, ids)
    store.keep(len(of_views))
    try:
        for view, ids, mark, shown, exposed in _side_by_side(show, coming, at_once):
            store.add(mark, shown.rows, exposed)
            note(view, ids)
    finally:
        store.checkpoint()
    width = max((rows.shape[1] for _, rows in of_views), default=0)
    return MaskTable(
        store.matrix("weights"),
        store.matrix("outside"),
        store.matrix("exposure"),
        np.repeat(np.arange(len(of_views), dtype=np.int32), [len(pixels) for pixels, _ in of_views]),
        np.concatenate([pixels for pixels, _ in of_views]),
        np.concatenate([rows if len(rows) else np.zeros((0, width), np.float32) for _, rows in of_views]),
    )


def table_key(gaussians: Gaussians, near: float, thickness: NDArray[np.float32], cutoffs: Cutoffs = CUTOFFS) -> str:
    """A fingerprint of all that the rows of a view depend on, but for the view."""
    digest = blake2b(VERSION, digest_size=16)
    numbers = np.array([near, *cutoffs])
    for array in (gaussians.xyz, gaussians.scale, gaussians.rotation, gaussians.opacity, thickness, numbers):
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def _mark(view: View, ids: NDArray[np.int32]) -> str:
    """A fingerprint of what the rows depend on in one view."""
    camera = view.camera
    numbers = camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, view.mask_count
    digest = blake2b(repr(numbers).encode(), digest_size=16)
    digest.update(np.ascontiguousarray(camera.world_to_camera).data)
    digest.update(np.ascontiguousarray(ids).data)
    return digest.hexdigest()


def _side_by_side(work: Callable[[View], Shown], views: Iterable[View], at_once: int | None = None) -> Iterator[Shown]:
    """Work on several views at once, each on one thread: sorting and merging then keep no core waiting.

    Results come in the order of the views; only a few views are held at a time.
    """
    coming = iter(views)
    for view in islice(coming, 1):
        yield work(view)  # starts numba's threads: only then is their layer known
    threads = min(numba.get_num_threads(), at_once or numba.get_num_threads())
    layer = numba.threading_layer()  # pyright: ignore[reportPrivateImportUsage]
    if threads == 1 or layer == "workqueue":  # which takes no calls from two threads at once
        yield from map(work, coming)
        return

    def alone(view: View) -> Shown:
        numba.set_num_threads(1)  # of this Python thread
        return work(view)

    with ThreadPoolExecutor(max_workers=threads) as pool:
        waiting: deque[Future[Shown]] = deque()
        try:
            for view in coming:
                waiting.append(pool.submit(alone, view))
                if len(waiting) > threads:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)  # interrupted, or a view failed: no more are begun


def _exposure(view: ViewWeights) -> csr_array:
    """(1, n) sparse: the weight of each Gaussian in a view, as a part of what it would be with nothing in front.

    What shows through a surface counts SEEN_THROUGH: the rest of a view's word would be about the surface.
    """
    n = view.rows.shape[1]
    seen = np.bincount(view.rows.indices, view.rows.data, n).astype(np.float64)  # integers where there is nothing
    visible = np.flatnonzero(seen)
    seen -= (1 - SEEN_THROUGH) * np.bincount(view.through.indices, view.through.data, n)
    # Of a huge splat so little is in the image that float32 would call it nothing.
    part = np.clip(seen[visible] / view.area[visible], np.finfo(np.float32).tiny, 1).astype(np.float32)
    return csr_array((part, visible.astype(np.int32), [0, len(visible)]), shape=(1, n))
