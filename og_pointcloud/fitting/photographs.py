"""A mask table of views -> one of photographs: views that were cut from one photograph are joined again.

An image too wide for a pinhole is split into several views (formats/faces.py), each rendered by itself. For grouping
and votes they are one: a mask cut at a border of faces is one mask, a view that shows a thing in one face tells points
in the others that they are not part of it, and a panorama is one witness instead of six.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from og_pointcloud.fitting.mask_table import MaskTable
from og_pointcloud.fitting.memory import scratch_like
from og_pointcloud.kernels import njit
from og_pointcloud.scene import View


@dataclass(frozen=True)
class Photographs:
    """The photographs of V views with M masks. names: (photographs,). of_view: (V,) int32, the photograph of each view.
    of_mask: (M,) int64, the mask of its photograph that each mask is a part of, numbered photograph by photograph.
    first: (masks of photographs,) int64, the first part of each."""

    names: tuple[str, ...]
    of_view: NDArray[np.int32]
    of_mask: NDArray[np.int64]
    first: NDArray[np.int64]

    @classmethod
    def of(cls, views: Sequence[View]) -> Photographs:
        """The photographs of views, in their order; a view that was not cut is a photograph."""
        # Keys tell a view from a photograph of the same name. Masks get a number that sorts by photograph, then by the
        # row that the mask has there: parts of one mask have the same.
        number: dict[tuple[str, bool], int] = {}
        of_view, masks = [], []
        for view in views:
            cut = view.cut_from
            key = (view.name, False) if cut is None else (cut.photograph, True)
            of_view.append(number.setdefault(key, len(number)))
            rows = np.arange(view.mask_count) if cut is None else cut.rows
            masks.append(rows + (np.int64(of_view[-1]) << 32))
        _, first, of_mask = np.unique(np.concatenate(masks), return_index=True, return_inverse=True)
        return cls(tuple(name for name, _ in number), np.array(of_view, np.int32), of_mask, first)

    def joined(self, table: MaskTable) -> MaskTable:
        """The table of photographs from one of views."""
        if len(self.names) == len(self.of_view):
            return table
        views = self.of_view, len(self.names)
        exposure = _summed(table.exposure, *views)
        np.minimum(exposure.data, 1, out=exposure.data)  # a splat across a border is open in both faces
        return replace(
            table,
            weights=_summed(table.weights, self.of_mask, len(self.first)),
            outside=_summed(table.outside, *views),
            exposure=exposure,
            doubted=None if table.doubted is None else _summed(table.doubted, *views),
            names=self.names,
            mask_view=self.of_view[table.mask_view[self.first]],
            mask_pixels=np.bincount(self.of_mask, table.mask_pixels, len(self.first)).astype(np.int32),
            mask_features=table.mask_features[self.first],
            mask_track=None if table.mask_track is None else table.mask_track[self.first],
        )


def _summed(matrix: csr_array, target: NDArray[np.integer], count: int) -> csr_array:
    """(count, n) sparse: the sums of the rows with each target. target: (rows,) the row of the result for each row."""
    parts = np.argsort(target, kind="stable")
    first = np.searchsorted(target[parts], np.arange(count + 1))
    # Never in place: another matrix may have the same columns.
    columns, values = scratch_like(matrix.indices, np.int32), scratch_like(matrix.data, np.float32)
    starts = _add_rows((matrix.indptr, matrix.indices, matrix.data), parts, first, matrix.shape[1], columns, values)
    return csr_array((values[: starts[-1]], columns[: starts[-1]], starts), shape=(count, matrix.shape[1]))


@njit(cache=True)
def _add_rows(matrix, parts, first, n, columns, values):  # noqa: ANN001, ANN202
    """Writes the entries of the sums, row by row, columns in the order they first occur. Returns the row starts."""
    indptr, indices, data = matrix
    place = np.full(n, -1, np.int64)  # of a column's entry; one before this row's begin is of an earlier row
    starts = np.zeros(len(first), np.int32)
    end = 0
    for row in range(len(first) - 1):
        begin = end
        for part in parts[first[row] : first[row + 1]]:
            for e in range(indptr[part], indptr[part + 1]):
                g = indices[e]
                if place[g] >= begin:
                    values[place[g]] += data[e]
                else:
                    place[g], columns[end], values[end] = end, g, data[e]
                    end += 1
        starts[row + 1] = end
    return starts
