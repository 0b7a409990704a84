"""Blending weights of the views that mode paper trains on: geometry is frozen, so each view is composited once.

A pixel shows ``M = W F``, and a training step is two products, ``W F`` and, for the gradient, ``W' G``, on the device
given in the settings. Weights are kept as far as memory allows; those of other views are composited anew at every use,
bit-identical. Gaussians that no mask shows have no column: they get neither feature nor cluster, and show nothing.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from og_pointcloud.errors import OgPointcloudError, SceneError, naming_extra
from og_pointcloud.rendering.splatting import Gaussians, view_weights
from og_pointcloud.scene import View
from og_pointcloud.settings import PaperSettings

with naming_extra("torch", "learn"):
    import torch


@dataclass(frozen=True)
class RenderedView:
    """One view's blending weights.

    weights: (pixels, known) CSR float32 with int32 indices, a pixel's nearest Gaussian first. mask: (pixels,) int64, a
    row of mask_names, -1 outside masks. mask_names: (m,) int64 ascending, the view's own mask ids. Both tensors are on
    the device that values are rendered on. pixels: (pixels,) indices into the image, row by row.
    """

    weights: csr_array
    mask: torch.Tensor
    mask_names: torch.Tensor
    pixels: NDArray[np.int64]

    def render(self, values: torch.Tensor) -> torch.Tensor:
        """(pixels, width) blended values of the known Gaussians (known, width)."""
        return _Blend.apply(values, *self._factors)

    @cached_property
    def _factors(self) -> tuple[torch.Tensor, torch.Tensor]:
        """W and W' in torch. Both are kept: torch's own gradient of a CSR product is a hundred times slower."""
        both = (self.weights, csr_array(self.weights.T.tocsr()))
        return tuple(_in_torch(weights, self.mask.device) for weights in both)  # pyright: ignore

    @property
    def nbytes(self) -> int:
        """Bytes in memory, including W'."""
        # Per entry: index and value of 4 bytes each, in W and in W'. Per pixel: row start 4, mask 8, place 8.
        return 16 * self.weights.nnz + 20 * len(self.mask)


class RenderedViews:
    """Blending weights of all views that have a mask, kept as far as ``cache_bytes`` allow, else composited anew.

    views: thinned to the resolution to render at. near: depth of the near plane, scene units. whole: with all pixels,
    else those in masks that are covered enough. Raises SceneError if no mask has a pixel covered enough.

    seen: (n,) blending weight in masks. known: rows of the Gaussians that have any. masked_pixels: mean number of
    masked pixels per view. device: of the views' tensors.
    """

    def __init__(
        self, gaussians: Gaussians, views: Sequence[View], near: float, settings: PaperSettings, *, whole: bool
    ) -> None:
        self.gaussians, self.near, self.settings, self.whole = gaussians, near, settings, whole
        self.device = device_of(settings.device)
        self.seen = np.zeros(len(gaussians))
        self.views: list[View] = []
        self._kept: dict[tuple[int, float, int], RenderedView] = {}
        self._room = settings.cache_bytes
        # Which Gaussians masks show is known only after all views: until then each has a column.
        self._column = np.arange(len(gaussians), dtype=np.int32)
        pixels = 0
        for view in views:
            rendered = self._composited(gaussians, view, self._column)
            inside = rendered.mask.cpu().numpy() >= 0
            if not inside.any():
                continue
            self.seen += rendered.weights[inside].sum(axis=0, dtype=np.float64)
            pixels += int(inside.sum())
            self._keep((len(self.views), 1.0, -1), rendered)
            self.views.append(view)
        if not self.views:
            raise SceneError(
                f"none of the {len(views)} views has a mask of which Gaussians cover {settings.covered_share} or more; "
                "expected at least one: make masks, check poses, or lower covered_share"
            )
        self.masked_pixels = pixels / len(self.views)
        self.known = np.flatnonzero(self.seen > 0)
        self._column = np.full(len(gaussians), -1, np.int32)
        self._column[self.known] = np.arange(len(self.known))
        for key, rendered in self._kept.items():
            self._kept[key] = replace(rendered, weights=_with_columns(rendered.weights, self._column, len(self.known)))

    def __len__(self) -> int:
        return len(self.views)

    def __getitem__(self, index: int) -> RenderedView:
        return self.drawn(index)

    def drawn(
        self, index: int, factor: float = 1.0, cluster: int = -1, members: NDArray[np.integer] | None = None
    ) -> RenderedView:
        """A view with all Gaussians' standard deviations times ``factor``, and only these ``members`` (rows of the
        known Gaussians; None: all); its masks are among those at full size.

        cluster: at least 0, a number for the members: the view is cached under it until `forget_clusters`, so the same
        number must mean the same members.
        """
        key = index, factor, cluster
        if key in self._kept:
            return self._kept[key]
        rows = None if members is None else self.known[members]
        gaussians = self.gaussians.take(rows)
        if factor != 1.0:
            gaussians = replace(gaussians, scale=(gaussians.scale * np.float32(factor)).astype(np.float32))
        full = key == (index, 1.0, -1)
        # Targets are made at full size: a mask that shows only when Gaussians are smaller has no target.
        masks = None if full else self[index].mask_names.cpu().numpy()
        column = self._column if rows is None else self._column[rows]
        rendered = self._composited(gaussians, self.views[index], column, masks)
        self._keep(key, rendered)
        return rendered

    def _keep(self, key: tuple[int, float, int], rendered: RenderedView) -> None:
        if rendered.nbytes <= self._room:
            self._kept[key] = rendered
            self._room -= rendered.nbytes

    def forget_clusters(self) -> None:
        """Drop the cached views of some members alone: another codebook has other clusters."""
        for key in [key for key in self._kept if key[2] >= 0]:
            self._room += self._kept.pop(key).nbytes

    def _composited(
        self, gaussians: Gaussians, view: View, column: NDArray[np.int32], masks: NDArray[np.int64] | None = None
    ) -> RenderedView:
        """The view's weights. column: (Gaussians,) in the result, -1 none; masks: only these count, all by default."""
        ids = np.maximum(view.mask_map().ravel(), -1)
        if masks is not None:
            ids = np.where(np.isin(ids, masks), ids, -1)
        wanted = (ids >= 0) | self.whole
        image = wanted.reshape(view.camera.height, view.camera.width)
        weights, ids = view_weights(gaussians, view.camera, self.near, image), ids[wanted]
        coverage = weights.sum(axis=1)
        shown = np.bincount(ids + 1, coverage, minlength=view.mask_count + 1) > 0  # place 0: pixels without a mask
        inside = (ids >= 0) & shown[ids + 1] & (coverage >= self.settings.covered_share)
        rows = np.flatnonzero(inside | (coverage > 0)) if self.whole else np.flatnonzero(inside)
        ids = np.where(inside, ids, -1)[rows]
        # Remaining masks, numbered without gaps, so that each has a pixel to average over.
        names = np.unique(ids[ids >= 0]).astype(np.int64)
        mask = np.where(ids >= 0, np.searchsorted(names, ids), -1)
        small = _with_columns(weights[rows], column, int(self._column.max(initial=-1)) + 1)
        mask, names = (torch.as_tensor(ids, device=self.device) for ids in (mask, names))
        return RenderedView(small, mask, names, np.flatnonzero(wanted)[rows])


def device_of(name: str) -> torch.device:
    """Where to train: a torch device, or "auto": the first CUDA GPU, else the CPU. OgPointcloudError for others."""
    gpus = [f"cuda:{index}" for index in range(torch.cuda.device_count())]
    known = {"cpu": "cpu", "auto": gpus[0] if gpus else "cpu"} | {gpu: gpu for gpu in gpus}
    known |= {"cuda": gpus[0]} if gpus else {}
    if name not in known:
        raise OgPointcloudError(
            f"device is '{name:.40}', which torch does not find here; expected one of {', '.join(known)}"
        )
    return torch.device(known[name])


def _with_columns(weights: csr_array, column: NDArray[np.int32], count: int) -> csr_array:
    """The weights moved to other columns, ``count`` in all; entries whose new column is -1 are dropped."""
    indices, indptr, data = column[weights.indices], weights.indptr, weights.data
    if (indices < 0).any():
        kept = indices >= 0
        # A row begins after the entries kept in the rows before it.
        indptr = np.concatenate([[0], np.cumsum(kept)])[indptr]
        indices, data = indices[kept], data[kept]
    return csr_array((data, indices, indptr.astype(np.int32)), shape=(weights.shape[0], count))


def _in_torch(weights: csr_array, device: torch.device) -> torch.Tensor:
    """The same matrix; on a CPU it shares memory."""
    parts = (torch.as_tensor(part, device=device) for part in (weights.indptr, weights.indices, weights.data))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch warns that its CSR tensors are beta
        return torch.sparse_csr_tensor(*parts, size=weights.shape, device=device, check_invariants=False)


class _Blend(torch.autograd.Function):
    """W F with the gradient W' G. float64 values, as in the tests, are blended in float64."""

    @staticmethod
    def forward(ctx: Any, values: torch.Tensor, weights: torch.Tensor, transposed: torch.Tensor) -> torch.Tensor:
        ctx.transposed = transposed
        return weights.to(values.dtype) @ values

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor, None, None]:  # pyright: ignore
        return ctx.transposed.to(gradient.dtype) @ gradient.contiguous(), None, None
