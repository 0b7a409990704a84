"""Frozen geometry + views -> the mask table: how openly each mask of each view shows each point.

One pass over each view (`sightings.sightings`), several side by side. What a view shows goes to a `WorkFolder`,
which writes it where memory is short or the work long; in the end the views are put together to one table. Views that
an interrupted fit left in the folder are not rendered again.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from typing import Any, TypeVar

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array

from og_pointcloud.errors import OgPointcloudError, SceneError, span
from og_pointcloud.fitting.memory import scratch_array
from og_pointcloud.fitting.work_folder import WorkFolder, fingerprint
from og_pointcloud.kernels import njit
from og_pointcloud.rendering.sightings import sightings
from og_pointcloud.rendering.splatting import Gaussians
from og_pointcloud.scene import Scene, View

Result = TypeVar("Result")


@dataclass(frozen=True)
class MaskTable:
    """What every mask of every view shows of every point, and what shows outside all masks.

    weights: (masks, n) sparse float32, how openly each point shows in each mask; masks view by view.
    outside: (views, n) sparse float32, the same for each view's pixels without a mask.
    exposure: (views, n) sparse float32 in (0, 1], the light that reaches the camera from each point: 1 in front, little
        behind others.
    mask_view: (masks,) int32, the view of each mask. mask_pixels: (masks,) int32, area in pixels.
    mask_features: (masks, D) float32, as the encoder gave them.
    mask_track: (masks,) int64 as `View.mask_tracks`; None where no view has tracks. names: (views,), of the views.
    doubted: (views, n) sparse float32, exposure that was removed from the above because it comes through holes of an
        object, or because colors contradict it (seen_colors.py; below 0 where they raise it): it still counts for how
        masks overlap, not for what a point is. None: none.
    """

    weights: csr_array
    outside: csr_array
    exposure: csr_array
    mask_view: NDArray[np.int32]
    mask_pixels: NDArray[np.int32]
    mask_features: NDArray[np.float32]
    mask_track: NDArray[np.int64] | None = None
    names: tuple[str, ...] = ()
    doubted: csr_array | None = None

    @property
    def unit_features(self) -> NDArray[np.float32]:
        """(masks, D) mask features of length 1; zero rows stay zero. Lengths of 1e30 would overflow float32."""
        wide = self.mask_features.astype(np.float64)
        length = np.linalg.norm(wide, axis=1, keepdims=True)
        return (wide / np.where(length > 0, length, 1)).astype(np.float32)

    def of_points(self, rows: NDArray[np.int64]) -> MaskTable:
        """The table of some of its points, in ascending order."""
        if len(rows) == self.exposure.shape[1]:
            return self
        matrices = (self.weights, self.outside, self.exposure, self.doubted)
        weights, outside, exposure, doubted = (m if m is None else csr_array(m[:, rows]) for m in matrices)
        return replace(self, weights=weights, outside=outside, exposure=exposure, doubted=doubted)

    def with_doubted(self) -> MaskTable:
        """The table with all doubted exposure restored, as geometry alone has it."""
        if self.doubted is None:
            return self
        exposure = csr_array(self.exposure + self.doubted)
        np.minimum(exposure.data, 1, out=exposure.data)
        return replace(self, exposure=exposure, doubted=None)


def mask_table(
    gaussians: Gaussians,
    views: Iterable[View],
    near: float,
    thickness: NDArray[np.float32],
    *,
    work: WorkFolder | None = None,
    side_by_side: int | None = None,
    most_in_memory: float = np.inf,
    selected: NDArray[np.bool_] | None = None,
) -> MaskTable:
    """The mask table of all views, one pass over each.

    near: depth of the near plane, thickness: (n,) how far in front of a point others hide it, both in scene units.
    work: where the views are kept meanwhile; views that are there already are not rendered. None: in memory.
    side_by_side: maximum number of views worked on at once; None: the number of threads.
    most_in_memory: bytes of entries; a larger table is in mapped files.
    selected: (n,) bool, the points that rays are cast to; None: all.
    """
    if work is None:
        work = WorkFolder(None)
        work.hold(np.inf, np.inf)
    geometry = (gaussians.xyz, gaussians.scale, gaussians.rotation, gaussians.opacity, thickness, near)
    # What is not kept is not looked for by another run: it needs no fingerprint.
    of_all = fingerprint(*geometry, selected) if work.folder is not None else None

    def arrays_of(view: View, ids: NDArray[np.int32] | None = None) -> tuple[NDArray[Any], ...]:
        """Numbers of entries of each row (masks + 1,), the last for pixels without a mask; the entries' columns and
        values; and columns and values of the exposure. ids: the view's mask map; None: it is read."""
        ids = view.mask_map() if ids is None else ids
        seen = sightings(gaussians, view.camera, ids, view.mask_count, near, thickness, selected)
        rows, exposure = seen.rows, seen.openness
        return np.diff(rows.indptr), rows.indices, rows.data, exposure.indices, exposure.data

    def shown(view: View) -> _ShownView:
        ids = view.mask_map()
        key = fingerprint(of_all, view_fingerprint(view, ids)) if of_all is not None else work.number()
        # Only a view's sizes are kept here, no mask map: the work folder holds its entries, or writes them to a file.
        lengths, *_, exposed = work.arrays("view", key, lambda: arrays_of(view, ids))
        sizes = np.array([lengths[:-1].sum(dtype=np.int64), lengths[-1], len(exposed)])
        return _ShownView(view, key, sizes, np.bincount(ids[ids >= 0], minlength=view.mask_count).astype(np.int32))

    views_shown = list(_side_by_side(shown, views, side_by_side))
    views = [each.view for each in views_shown]
    return MaskTable(
        *_put_together(views_shown, len(gaussians), work, most_in_memory, arrays_of),
        np.repeat(np.arange(len(views), dtype=np.int32), [view.mask_count for view in views]),
        np.concatenate([each.pixels for each in views_shown]),
        stacked_features([view.mask_features for view in views]),
        stacked_tracks([(view.mask_tracks, view.mask_count) for view in views]),
        tuple(view.name for view in views),
    )


@dataclass(frozen=True)
class _ShownView:
    """A view whose arrays a work folder keeps under ``key``. sizes: (3,) numbers of entries in masks, outside of them,
    and of the exposure. pixels: (masks,) int32, area of each."""

    view: View
    key: str
    sizes: NDArray[np.int64]
    pixels: NDArray[np.int32]


def view_fingerprint(view: View, ids: NDArray[np.int32]) -> str:
    """A fingerprint of all that a view's rows depend on except the geometry. ids: its mask map."""
    camera = view.camera
    numbers = camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, view.mask_count
    return fingerprint(numbers, camera.world_to_camera, ids)


def _put_together(
    views: list[_ShownView],
    n: int,
    work: WorkFolder,
    most_in_memory: float,
    arrays_of: Callable[[View], tuple[NDArray[Any], ...]],
) -> tuple[csr_array, csr_array, csr_array]:
    """(weights, outside, exposure) of all views. Each view is freed once it is copied: none is in memory twice."""
    sizes = sum((each.sizes for each in views), np.zeros(3, np.int64)).tolist()
    # 8 bytes an entry: an int32 column and a float32 value. Sizes are known, so no array grows and moves.
    weights, outside, exposure = (SparseRows(entries, n, 8 * sum(sizes) > most_in_memory) for entries in sizes)
    for each in views:
        anew = partial(arrays_of, each.view)  # should its file be damaged by now
        lengths, columns, values, exposed_columns, exposed_values = work.arrays("view", each.key, anew)
        work.forget("view", each.key)
        border = len(columns) - lengths[-1]  # the last row is of pixels outside of masks
        weights.append(lengths[:-1], columns[:border], values[:border])
        outside.append(lengths[-1:], columns[border:], values[border:])
        exposure.append(len(exposed_columns), exposed_columns, exposed_values)
    return weights.matrix(), outside.matrix(), exposure.matrix()


def stacked_features(of_views: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
    """`MaskTable.mask_features` from those of each view, whose rows may have any width where it has no masks."""
    return np.concatenate([features for features in of_views if len(features)] or of_views[:1])


def stacked_tracks(of_views: Sequence[tuple[NDArray[np.integer] | None, int]]) -> NDArray[np.int64] | None:
    """`MaskTable.mask_track`, given for each view its `View.mask_tracks` and its number of masks."""
    if all(tracks is None for tracks, _ in of_views):
        return None
    return np.concatenate([np.full(count, -1) if tracks is None else np.int64(tracks) for tracks, count in of_views])


def require_sight(exposed: int, masked: int, scene: Scene) -> None:
    """SceneError where no view shows a point, or no mask does. exposed, masked: numbers of such entries."""
    if exposed and masked:
        return
    cameras = np.stack([view.camera.center for view in scene.views]) + scene.points.origin
    places = f"the cloud spans {span(scene.points.xyz_world)}, the cameras stand at {span(cameras)}"
    if exposed == 0:
        raise SceneError(
            f"no camera sees the cloud: {len(scene.points)} points, {len(scene.views)} views, no point in any image; "
            "check that poses and cloud are in the same frame and that poses are camera-to-world (transforms.json) as "
            f"documented; {places}"
        )
    raise SceneError(
        f"none of the {sum(view.mask_count for view in scene.views)} masks shows a Gaussian; expected at least "
        f"one: make masks, and check that poses and cloud are in the same frame; {places}"
    )


def weights_by_instance(matrix: csr_array, instance_ids: NDArray[np.int32], count: int) -> NDArray[np.float64]:
    """(rows, count) float64: what each row of a table's matrix shows of the points of every instance, in pixels.

    instance_ids: (n,) int32, the instance of each column, less than ``count``; below 0 none.
    """
    return _weights_by_instance(matrix.indptr, matrix.indices, matrix.data, instance_ids, count)


def areas_by_instance(
    table: MaskTable, instance_ids: NDArray[np.int32], count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What every mask, (masks, count), and every view, (views, count), shows of each instance, as above."""
    in_masks = weights_by_instance(table.weights, instance_ids, count)
    # What a view shows of an instance lies in its masks or outside all of them.
    in_views = weights_by_instance(table.outside, instance_ids, count)
    np.add.at(in_views, table.mask_view, in_masks)
    return in_masks, in_views


@njit(cache=True)
def _weights_by_instance(indptr, indices, data, instance_ids, count):  # noqa: ANN001, ANN202
    """As above, entry by entry: a product with a sparse indicator of float64 would copy all values to float64."""
    rows = len(indptr) - 1
    sums = np.zeros((rows, count))
    for row in range(rows):
        for e in range(indptr[row], indptr[row + 1]):
            instance = instance_ids[indices[e]]
            if instance >= 0:
                sums[row, instance] += data[e]
    return sums


class SparseRows:
    """A CSR matrix (rows, width) of int32 columns and float32 values that is filled row by row.

    entries: their maximum number, less than 2^31 so that int32 counts them: SciPy would turn all indices into int64,
    twice the memory. on_disk: whether they go to mapped files or into memory.
    """

    def __init__(self, entries: int, width: int, on_disk: bool) -> None:
        if entries > np.iinfo(np.int32).max:
            raise OgPointcloudError(
                f"the mask table has {entries:,} entries; expected fewer than 2^31: use fewer views, larger pixels, or "
                "part of the cloud"
            )
        self.width, self.filled = width, 0
        make = scratch_array if on_disk else np.empty
        self._indices, self._data = make(entries, np.int32), make(entries, np.float32)
        self._lengths: list[NDArray[np.integer]] = []

    def append(self, lengths: ArrayLike, indices: NDArray[np.int32], data: NDArray[np.float32]) -> None:
        """Add rows of these lengths, their entries one row after the other."""
        end = self.filled + len(indices)
        self._indices[self.filled : end], self._data[self.filled : end] = indices, data
        self.filled = end
        self._lengths.append(np.atleast_1d(np.asarray(lengths)))

    def matrix(self) -> csr_array:
        """The rows so far."""
        lengths = np.concatenate([np.zeros(1, np.int64), *self._lengths])
        start = np.cumsum(lengths).astype(np.int32)
        entries = self._data[: self.filled], self._indices[: self.filled]
        return csr_array((*entries, start), shape=(len(start) - 1, self.width))


def _side_by_side(
    work: Callable[[View], Result], views: Iterable[View], workers: int | None = None
) -> Iterator[Result]:
    """Work on several views at once, each on one thread: sorting and merging then leave no core idle.

    Results come in the order of the views; only a few views are held at a time.
    """
    pending = iter(views)
    for view in islice(pending, 1):
        yield work(view)  # starts numba's threads: only then is their layer known
    threads = min(numba.get_num_threads(), workers or numba.get_num_threads())
    layer = numba.threading_layer()  # pyright: ignore[reportPrivateImportUsage]
    if threads == 1 or layer == "workqueue":  # which takes no calls from two threads at once
        yield from map(work, pending)
        return

    def single_threaded(view: View) -> Result:
        numba.set_num_threads(1)  # for this Python thread
        return work(view)

    with ThreadPoolExecutor(max_workers=threads) as pool:
        futures: deque[Future[Result]] = deque()
        try:
            for view in pending:
                futures.append(pool.submit(single_threaded, view))
                if len(futures) > threads:  # one more than threads, so that no thread waits for the next view
                    yield futures.popleft().result()
            while futures:
                yield futures.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)  # interrupted, or a view failed: no more are begun
