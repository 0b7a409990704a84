"""Photographs of a made scene -> a 3DGS actually trained on them: sizes, shapes, opacities and colors, densified.

As published (Kerbl et al., 2023), without what a small scene does not need: the loss is L1 alone, colors do not depend
on the viewing direction, opacities are not reset. A pixel's color is ``C = sum_i T_i a_i c_i + T B``, nearest first,
with ``T_i = prod_{j<i} (1 - a_j)``, ``a_i = o_i exp(-q_i)`` and a gray B behind everything; so

    dC / dc_i = T_i a_i        dC / da_i = T_i c_i - (sum_{j>i} T_j a_j c_j + T B) / (1 - a_i)

which our own kernel sums for each splat; torch propagates it from there to position, size and shape.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from tqdm import tqdm

from og_pointcloud.kernels import njit, prange
from og_pointcloud.rendering.splatting import LOW_PASS, TILE
from og_pointcloud.scene import Camera, Points

STEPS = 1500
DENSIFIED = range(300, 1001, 100)
"""Steps at which Gaussians are split, copied and dropped."""
RATES = {"xyz": 1.6e-4, "log_size": 5e-3, "rotation": 1e-3, "logit": 5e-2, "color": 1e-2}
"""Adam's learning rates as published; xyz's is relative to the extent of the cameras, color's for a sigmoid's argument.
"""
POSITION_END = 0.01
"""Share of its learning rate that xyz ends with."""
GROWS_FROM = 2e-4
"""Mean length of the gradient at a center, in units of half the image, above which a Gaussian is densified."""
SPLIT_FROM = 0.01
"""Size, as a share of the extent, above which a Gaussian is split into two of 1 / SPLIT its size instead of copied."""
SPLIT = 1.6
LEAST_OPACITY = 0.005
"""Less opaque Gaussians are dropped."""
BEHIND = 0.5
"""The gray behind everything."""
NEAREST = 0.1
"""Depth of the near plane, meters."""
REACH = 3.0
"""Standard deviations up to which a splat is drawn."""

Parameters = dict[str, torch.Tensor]
Image = NDArray[np.float32]


def trained(start: Points, cameras: Sequence[Camera], images: Sequence[Image], most: int, seed: int = 0) -> Points:
    """A 3DGS of what images show.

    start: initial points with colors, as from structure from motion. images: (H, W, 3) in [0, 1], one per camera. most:
    maximum number of Gaussians.
    """
    rng = np.random.default_rng(seed)
    torch.manual_seed(seed)
    centers = np.stack([camera.center for camera in cameras])
    extent = 1.1 * float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())
    now = _begun(start)
    adam, growth = _optimizer(now, extent), np.zeros((len(start), 2))
    for step in tqdm(range(STEPS), "3DGS", disable=None, leave=False):
        view = int(rng.integers(len(cameras)))
        adam.param_groups[0]["lr"] = RATES["xyz"] * extent * POSITION_END ** (step / STEPS)
        adam.zero_grad(set_to_none=True)
        pull = _backward(now, cameras[view], images[view])
        adam.step()
        growth += np.stack([pull, pull > 0], axis=1)
        if step in DENSIFIED:
            now = _densified(now, growth[:, 0] / np.maximum(growth[:, 1], 1), extent, most)
            adam, growth = _optimizer(now, extent), np.zeros((len(now["xyz"]), 2))
    return _as_points(now, start.origin)


def _begun(start: Points) -> Parameters:
    assert start.rgb is not None
    to_others: NDArray[np.float64] = np.asarray(cKDTree(start.xyz).query(start.xyz, 4)[0])[:, 1:].mean(axis=1)
    color = np.clip(start.rgb / 255, 0.02, 0.98)
    return {
        "xyz": torch.from_numpy(start.xyz.astype(np.float32)),
        "log_size": torch.from_numpy(np.log(np.maximum(to_others, 1e-4)).astype(np.float32))[:, None].repeat(1, 3),
        "rotation": torch.tensor([[1.0, 0, 0, 0]]).repeat(len(start), 1),
        "logit": torch.full((len(start),), float(np.log(0.1 / 0.9))),
        "color": torch.logit(torch.from_numpy(color.astype(np.float32))),
    }


def _optimizer(now: Parameters, extent: float) -> torch.optim.Adam:
    rates = RATES | {"xyz": RATES["xyz"] * extent}
    groups: list[dict[str, Any]] = [{"params": [now[k].requires_grad_()], "lr": rate} for k, rate in rates.items()]
    return torch.optim.Adam(groups, eps=1e-15)


def _as_points(now: Parameters, origin: NDArray[np.float64]) -> Points:
    now = {name: values.detach() for name, values in now.items()}
    kept = torch.sigmoid(now["logit"]) > LEAST_OPACITY
    xyz, size, rotation, opacity, color = (
        values[kept].numpy()
        for values in (
            now["xyz"], now["log_size"].exp(), torch.nn.functional.normalize(now["rotation"], dim=1),
            torch.sigmoid(now["logit"]), torch.sigmoid(now["color"]),
        )
    )  # fmt: skip
    return Points(xyz, origin, np.rint(255 * color).astype(np.uint8), size, rotation, opacity)


def _densified(now: Parameters, pull: NDArray[np.float64], extent: float, most: int) -> Parameters:
    """Gaussians with a large gradient are copied if small, split if large; faint or huge ones are dropped."""
    now = {name: values.detach() for name, values in now.items()}
    size = now["log_size"].exp().max(dim=1).values.numpy()
    good = (torch.sigmoid(now["logit"]) > LEAST_OPACITY).numpy() & (size < 0.5 * extent)
    hot = np.argsort(-pull, kind="stable")[: max(0, most - len(pull))]
    hot = hot[(pull[hot] > GROWS_FROM) & good[hot]]
    large = hot[size[hot] > SPLIT_FROM * extent]
    good[large] = False
    halves = np.repeat(large, 2)
    rows = torch.from_numpy(np.concatenate([np.flatnonzero(good), np.setdiff1d(hot, large), halves]))
    found = {name: values[rows] for name, values in now.items()}
    if len(halves):
        last = slice(len(rows) - len(halves), None)
        offset = (
            _axes(found["rotation"][last]) @ (torch.randn(len(halves), 3) * found["log_size"][last].exp())[..., None]
        )
        found["xyz"][last] += offset[..., 0]
        found["log_size"][last] -= float(np.log(SPLIT))
    return found


# One view ------------------------------------------------------------------------------------------------------------


def _axes(rotation: torch.Tensor) -> torch.Tensor:
    """(n, 3, 3) rotation matrices of quaternions (w, x, y, z) of any length."""
    w, x, y, z = torch.nn.functional.normalize(rotation, dim=1).unbind(1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)


def _backward(now: Parameters, camera: Camera, image: Image) -> NDArray[np.float64]:
    """Adds the gradients of one view's loss. Returns (n,) the length of that at each center, in units of half the
    image; 0 for Gaussians that do not show."""
    pose = torch.from_numpy(camera.world_to_camera.astype(np.float32))
    seen = now["xyz"] @ pose[:3, :3].T + pose[:3, 3]
    depth = seen[:, 2].clamp(min=NEAREST)
    x, y = seen[:, 0] / depth, seen[:, 1] / depth
    # The Jacobian of perspective at the center, bounded beyond the image's border as published.
    wide, high = 0.65 * camera.width / camera.fx, 0.65 * camera.height / camera.fy
    zero = torch.zeros_like(depth)
    jacobian = torch.stack(
        [
            torch.stack([camera.fx / depth, zero, -camera.fx * x.clamp(-wide, wide) / depth], dim=1),
            torch.stack([zero, camera.fy / depth, -camera.fy * y.clamp(-high, high) / depth], dim=1),
        ],
        dim=1,
    )
    root = jacobian @ pose[:3, :3] @ (_axes(now["rotation"]) * now["log_size"].exp()[:, None, :])
    covariance = root @ root.transpose(1, 2)
    a, b, c = covariance[:, 0, 0] + LOW_PASS, covariance[:, 0, 1], covariance[:, 1, 1] + LOW_PASS
    area = (a * c - b * b).clamp(min=1e-9)
    given = [
        torch.stack(part, dim=1)
        for part in ((camera.fx * x + camera.cx, camera.fy * y + camera.cy), (c / area, -b / area, a / area))
    ]
    given += [torch.sigmoid(now["logit"])[:, None], torch.sigmoid(now["color"])]
    splats = torch.cat(given, dim=1).detach().numpy()
    reach = REACH * torch.stack([a, c], dim=1).sqrt().detach().numpy()
    order = np.argsort(seen[:, 2].detach().numpy(), kind="stable")
    start, members = _binned(order, seen[:, 2].detach().numpy(), splats, reach, camera.width, camera.height)
    _, gradient, shown = _gradients(splats, start, members, np.ascontiguousarray(image))
    torch.autograd.backward(
        given, [torch.from_numpy(gradient[:, part]) for part in (slice(0, 2), slice(2, 5), slice(5, 6), slice(6, 9))]
    )
    half = np.array([camera.width / 2, camera.height / 2])
    return np.where(shown, np.maximum(np.linalg.norm(gradient[:, :2] * half, axis=1), 1e-30), 0)


@njit(cache=True)
def _binned(order, depth, splats, reach, width, height):  # noqa: ANN001, ANN202
    """The splats of each tile, nearest first: where each tile's begin, and which they are."""
    columns, rows = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    start, members = np.zeros(columns * rows + 1, np.int64), np.zeros(0, np.int64)
    place = start
    for fill in (False, True):
        for g in order:
            u, v, across, down = splats[g, 0], splats[g, 1], reach[g, 0], reach[g, 1]
            if depth[g] <= NEAREST or u + across < 0 or v + down < 0 or u - across >= width or v - down >= height:
                continue
            left, right = max(0, int((u - across) // TILE)), min(columns - 1, int((u + across) // TILE))
            top, bottom = max(0, int((v - down) // TILE)), min(rows - 1, int((v + down) // TILE))
            for row in range(top, bottom + 1):
                for column in range(left, right + 1):
                    tile = row * columns + column
                    if fill:
                        members[place[tile]] = g
                        place[tile] += 1
                    else:
                        start[tile + 1] += 1
        if not fill:
            start = np.cumsum(start)
            place, members = start[:-1].copy(), np.empty(start[-1], np.int64)
    return start, members


@njit(cache=True, parallel=True, error_model="numpy")
def _gradients(splats, start, members, image):  # noqa: ANN001, ANN202
    """The mean absolute difference of colors; its gradient (n, 9) with respect to each splat's center, conic, opacity
    and color; and (n,) which splats show."""
    height, width = image.shape[:2]
    columns, scale = (width + TILE - 1) // TILE, np.float32(1 / image.size)
    errors, entries = np.zeros(len(start) - 1), np.zeros((len(members), 9), np.float32)
    for tile in prange(len(start) - 1):
        top, left = tile // columns * TILE, tile % columns * TILE
        begin, count = start[tile], start[tile + 1] - start[tile]
        of_tile = splats[members[begin : start[tile + 1]]]
        alpha, light, falloff = np.empty(count, np.float32), np.empty(count, np.float32), np.empty(count, np.float32)
        which, color, sign = np.empty(count, np.int64), np.empty(3, np.float32), np.empty(3, np.float32)
        for row in range(top, min(top + TILE, height)):
            for column in range(left, min(left + TILE, width)):
                through, drawn = np.float32(1), 0
                color[:] = 0
                for m in range(count):
                    s = of_tile[m]
                    x, y = np.float32(column + 0.5) - s[0], np.float32(row + 0.5) - s[1]
                    q = np.float32(0.5) * (s[2] * x * x + s[4] * y * y) + s[3] * x * y
                    if q < 0 or q > np.float32(REACH * REACH / 2 + 1):
                        continue
                    fall = np.exp(-q)
                    a = min(np.float32(0.99), s[5] * fall)
                    if a < np.float32(1 / 255):
                        continue
                    which[drawn], alpha[drawn], light[drawn], falloff[drawn] = m, a, through, fall
                    drawn += 1
                    for channel in range(3):
                        color[channel] += through * a * s[6 + channel]
                    through *= 1 - a
                    if through < np.float32(1e-4):
                        break
                behind = np.float32(0)  # gradient of everything drawn behind a splat
                for channel in range(3):
                    apart = color[channel] + through * np.float32(BEHIND) - image[row, column, channel]
                    errors[tile] += abs(apart)
                    sign[channel] = np.sign(apart) * scale
                    behind += through * np.float32(BEHIND) * sign[channel]
                for k in range(drawn - 1, -1, -1):
                    s, entry, a = of_tile[which[k]], entries[begin + which[k]], alpha[k]
                    own = np.float32(0)
                    for channel in range(3):
                        entry[6 + channel] += light[k] * a * sign[channel]
                        own += s[6 + channel] * sign[channel]
                    by_alpha = light[k] * own - behind / (1 - a)
                    behind += light[k] * a * own
                    if a >= np.float32(0.99):
                        continue
                    entry[5] += by_alpha * falloff[k]
                    by_q, x, y = -by_alpha * a, np.float32(column + 0.5) - s[0], np.float32(row + 0.5) - s[1]
                    entry[0] -= by_q * (s[2] * x + s[3] * y)
                    entry[1] -= by_q * (s[4] * y + s[3] * x)
                    entry[2] += by_q * x * x / 2
                    entry[3] += by_q * x * y
                    entry[4] += by_q * y * y / 2
    return errors.sum() * scale, *_gathered(members, entries, len(splats))


@njit(cache=True)
def _gathered(members, entries, n):  # noqa: ANN001, ANN202
    """(n, 9) the sum of each splat's entries, and (n,) which have one. A separate function, because inside a parallel
    kernel each of these sums would wake all threads."""
    gradient, shown = np.zeros((n, 9), np.float32), np.zeros(n, np.bool_)
    for e in range(len(members)):
        gradient[members[e]] += entries[e]
        shown[members[e]] = True
    return gradient, shown
