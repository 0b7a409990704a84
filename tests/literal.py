"""Votes, membership, matching, choosing and losses written straight from their definitions, in float64, in loops.

Slow and short: dense arrays, one point, mask, view or word at a time, nothing shared with the library but settings and
numbers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.cloud import BACKGROUND, UNOBSERVED
from og_pointcloud.scene import Camera
from og_pointcloud.settings import ChoosingSettings, MembershipSettings

__all__ = ["Votes", "choice", "eq5", "membership", "paper_losses", "view_votes"]

Array = NDArray[np.float64]
Ids = NDArray[np.int32]


# View votes ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Votes:
    """inside: (masks, n), what a view says for "in this mask". weight: (views, n), all that it says of a point.
    openness: (n,), the exposure of each point in the view that sees it best."""

    inside: Array
    weight: Array
    openness: Array


def view_votes(weights: Array, outside: Array, exposure: Array, mask_view: Sequence[int]) -> Votes:
    """A view counts by the square of its exposure of a point over the best view's; what shows is shared by weight."""
    inside, weight = np.zeros_like(weights), np.zeros_like(outside)
    for view, point in np.ndindex(*outside.shape):
        if exposure[view, point] == 0:
            continue
        weight[view, point] = (exposure[view, point] / exposure[:, point].max()) ** 2
        masks = [mask for mask, of in enumerate(mask_view) if of == view]
        shown = outside[view, point] + sum(weights[mask, point] for mask in masks)
        for mask in masks:
            inside[mask, point] = weights[mask, point] / shown * weight[view, point]
    return Votes(inside, weight, exposure.max(axis=0))


# Membership ------------------------------------------------------------------------------------------------------


def membership(
    votes: Votes, weights: Array, mask_view: Sequence[int], group: Sequence[int], neighbors: list[list[int]],
    settings: MembershipSettings, rgb: NDArray[np.uint8] | None = None, spanning: Sequence[int] = (),
) -> tuple[Ids, Array, Array]:  # fmt: skip
    """Ids and certainty of every point, and the expected IoU of every group. weights: (masks, n) pixels; neighbors: of
    each point, nearest first; rgb: (n, 3); spanning: masks without a group that show several."""
    points, count = range(weights.shape[1]), 1 + max(group)
    own, asked = np.zeros((count, len(points))), np.zeros((count, len(points)))
    views_of: dict[int, list[int]] = {}
    for k in range(count):
        masks = [mask for mask in range(len(group)) if group[mask] == k]
        own[k] = votes.inside[masks].sum(axis=0)
        views_of[k] = sorted({mask_view[mask] for mask in masks})
        asked[k] = votes.weight[views_of[k]].sum(axis=0)
    total, masked = votes.weight.sum(axis=0), votes.inside.sum(axis=0)

    def best_of(allowed: Sequence[int]) -> tuple[Ids, Array]:
        best, share = np.full(len(points), -1, np.int32), np.zeros(len(points))
        for g in points:
            voted = sorted((k for k in allowed if own[k, g] > 0), key=lambda k: -own[k, g])  # ties: the lower group
            if not voted:
                continue
            best[g] = voted[0]
            least = [max(settings.sure_share * asked[k, g], settings.swallowed_votes) for k in range(count)]
            sure = [k for k in voted if own[k, g] > least[k]]
            if sure and best[g] not in sure and sure[0] > best[g]:  # smaller, and uncontradicted
                best[g] = sure[0]
            share[g] = own[best[g], g] / asked[best[g], g]
        return best, share

    best, share = best_of(range(count))
    sure = [[g for g in points if best[g] == k and share[g] > 0.5] for k in range(count)]
    rates = [asked[k, sure[k]].sum() / max(total[sure[k]].sum(), 1e-12) for k in range(count)]
    masses = [own[k, sure[k]].sum() for k in range(count)]
    ascending = sorted(range(count), key=lambda k: rates[k])
    half = [k for i, k in enumerate(ascending) if sum(masses[a] for a in ascending[: i + 1]) >= sum(masses) / 2]
    kept = [k for k in range(count) if masses[k] > 0 and rates[k] >= settings.rate_share * rates[half[0]]]
    found = sum(masses[k] * rates[k] for k in range(count)) / sum(masses) * count / (count + 1)
    seen = sorted(votes.openness[votes.openness > 0])
    typical = (seen[(len(seen) - 1) // 2] + seen[len(seen) // 2]) / 2
    open_ = np.minimum(1, votes.openness / (settings.open_share * typical))

    def clear_of(best: Ids, share: Array) -> Ids:
        for_best = np.where(best >= 0, own[best, np.arange(len(points))], 0.0)
        agreed = (best >= 0) & (share > settings.sure_share) & (for_best > settings.sure_votes * total)
        clear = np.where(share < settings.possible_share, BACKGROUND, UNOBSERVED)
        return np.where(open_ == 1, np.where(agreed, best, clear), UNOBSERVED).astype(np.int32)

    # The word of one view alone, where others would hardly all have missed a thing, by the colors across its outline.
    missed = np.ones(count)
    for k in range(count):
        by_others = np.mean(masked[sure[k]] - own[k, sure[k]]) if sure[k] else 1.0
        if len(views_of[k]) == 1 and by_others < 0.5:
            missed[k] = (1 - found) ** np.mean(total[sure[k]] - masked[sure[k]])
    doubted = [k for k in range(count) if missed[k] < 9 * settings.missed_chance]
    clear = clear_of(best, share)
    counted = np.array([float(k != UNOBSERVED and k not in doubted) for k in clear])
    alike = color_ratios(rgb, clear, counted, neighbors) if rgb is not None and doubted else np.ones(443)
    for k in doubted:
        across = [(g, other) for g in sure[k] for other in neighbors[g] if other not in sure[k]]
        apart = [round(np.linalg.norm(rgb[g].astype(float) - rgb[other])) for g, other in across if rgb is not None]
        if missed[k] < settings.missed_chance * (np.mean(alike[apart]) if apart else 1) and k in kept:
            kept.remove(k)
    best, share = best_of(kept)
    openly = np.zeros(len(points))  # the share where each vote counts by itself once more
    for g in np.flatnonzero(best >= 0):
        of_best = np.array([votes.inside[mask, g] if group[mask] == best[g] else 0.0 for mask in range(len(group))])
        by_view = np.bincount(mask_view, of_best, len(votes.weight))
        openly[g] = by_view @ votes.weight[:, g] / (votes.weight[views_of[int(best[g])], g] ** 2).sum()

    clear = clear_of(best, share)
    reporting = [k if k in kept else -1 for k in group]
    background = count + len(spanning)
    for number, mask in enumerate(spanning, count):
        reporting[mask] = number
    sizes = count, background
    likely, alike = _likely_states(votes, mask_view, reporting, sizes, clear, best, open_, neighbors, rgb)
    ids = _likeliest(likely)
    ids[ids == background] = BACKGROUND
    possible = (best >= 0) & (share > settings.possible_share) & (openly > settings.possible_openly)
    while True:  # a middling share counts where it adjoins points that are in already
        beside = [sum(alike[g, other] for other in neighbors[g] if ids[other] == best[g]) for g in points]
        needed = [settings.growth_votes * sum(alike[g, other] for other in neighbors[g]) for g in points]
        joins = [g for g in points if possible[g] and ids[g] < 0 and beside[g] and beside[g] >= needed[g]]
        if not joins:
            break
        ids[joins] = best[joins]
    ids = _filled(_without_islands(ids, share, weights, group, neighbors, settings.island_share), neighbors)
    agreeing = [np.mean([ids[other] == ids[g] for other in neighbors[g]]) if neighbors[g] else 1.0 for g in points]
    of_state = [likely[g].get(background if ids[g] == BACKGROUND else int(ids[g]), 0.0) for g in points]
    expected = np.zeros(count)
    for k in range(count):
        right = sum(of_state[g] for g in points if ids[g] == k)
        of_group = sum(likely[g].get(k, 0.0) for g in points)
        expected[k] = right / (np.count_nonzero(ids == k) + of_group - right) if of_group else 0.0
    return ids, np.multiply(of_state, agreeing), expected


def _likely_states(
    votes: Votes, mask_view: Sequence[int], group: Sequence[int], sizes: tuple[int, int], clear: Ids, best: Ids,
    open_: Array, neighbors: list[list[int]], rgb: NDArray[np.uint8] | None,
) -> tuple[list[dict[int, float]], Array]:  # fmt: skip
    """Of each point, how likely it is in each state that it may be in; and (n, n) how many times likelier their colors
    are of one state than of two. sizes: groups, and background's number; between them are those of masks that span
    several groups."""
    from og_pointcloud.fitting import view_reports as by  # needs more than a reference of choosing may

    background, views, points = sizes[1], len(votes.weight), range(len(clear))
    said = np.zeros((views, background + 1, len(clear)))  # what each view reports of each point; the last: no mask
    no_group = np.zeros_like(votes.weight)
    for mask, view in enumerate(mask_view):
        (said[view, group[mask]] if group[mask] >= 0 else no_group[view])[:] += votes.inside[mask]
    said[:, background] = np.maximum(votes.weight - no_group - said.sum(axis=1), 0)
    shown = {(view, k) for view, k in zip(mask_view, group, strict=True) if k >= 0}
    within = {s: {int(clear[g]) for g in points if clear[g] >= 0 and said[:, s, g].any()} for s in range(*sizes)}
    may: list[set[int]] = []
    for g in points:
        near = {int(best[other]) for other in neighbors[g] if best[other] >= 0}
        reported = [k for k in range(background) if said[:, k, g].any()]
        in_masks = {k for r in reported for k in within.get(r, [r])}
        may.append({*in_masks, *near, background} if votes.weight[:, g].any() else set())
    likely = [{k: float(k == (background if clear[g] == BACKGROUND else clear[g])) for k in may[g]} for g in points]
    alike = np.ones((len(points),) * 2)
    for _ in range(by.EM_ROUNDS):
        if rgb is not None:
            sure = np.array([max(of.values(), default=0) for of in likely])
            apart = np.linalg.norm(rgb[:, None].astype(float) - rgb, axis=2)
            alike = color_ratios(rgb, _likeliest(likely), sure, neighbors)[np.rint(apart).astype(int)]
        adds = by.SMOOTHNESS * np.maximum(alike - by.MIN_COLOR_RATIO, 0) * open_
        heard_in_all = [adds[g, neighbors[g]].sum() for g in points]
        adds *= [[min(1, by.MAX_INFLUENCE / max(total, 1e-12))] for total in heard_in_all]
        chance = np.zeros((views, background + 1, background + 1))
        for view, k in np.ndindex(views, background + 1):
            chance[view, k, k if (view, k) in shown else background] = by.PRIOR_COUNT
            for g in points:
                sees = said[view, :, g].sum() * open_[g]
                chance[view, k] += likely[g].get(k, 0) * sees * open_[g] * said[view, :, g]
            least = by.MIN_REPORT_PROBABILITY
            chance[view, k] = (1 - least) * chance[view, k] / chance[view, k].sum() + least
        evidence: list[dict[int, float]] = []
        for g in points:
            sees, of_point = said[:, :, g].sum(axis=1) * open_[g], {}
            for k in may[g]:
                total = 0.0
                for view in np.flatnonzero(sees):
                    part = said[view, :, g] / said[view, :, g].sum()
                    hidden = (1 - sees[view]) * by.HIDDEN_REPORT_PROBABILITY
                    total += part @ np.log(sees[view] * chance[view, k] + hidden)
                prior = by.BACKGROUND_LOG_PRIOR if k == background else 0
                of_point[k] = total / max(1, sees.sum() / by.MAX_INDEPENDENT_VIEWS) + prior
            evidence.append(of_point)
        likely = [dict.fromkeys(of, 0.0) for of in may]
        for _ in range(1 + by.MEAN_FIELD_ROUNDS):
            before, likely = likely, []
            for g in points:
                heard = {
                    k: evidence[g][k] + sum(adds[g, other] * before[other].get(k, 0) for other in neighbors[g])
                    for k in may[g]
                }
                total = sum(np.exp(value - max(heard.values())) for value in heard.values())
                likely.append({k: float(np.exp(heard[k] - max(heard.values())) / total) for k in heard})
    return likely, alike


def _likeliest(states: list[dict[int, float]]) -> Ids:
    """The likeliest state of each point, of equals the lowest; UNOBSERVED where none is possible."""
    return np.array([min(of, key=lambda k: (-of[k], k)) if of else UNOBSERVED for of in states], np.int32)


def _filled(ids: NDArray[np.int32], neighbors: list[list[int]]) -> NDArray[np.int32]:
    """Unobserved points as the nearest neighbor that is not."""
    filled = ids.astype(np.int32)
    for g in np.flatnonzero(ids == UNOBSERVED):
        filled[g] = next((ids[other] for other in neighbors[g] if ids[other] != UNOBSERVED), UNOBSERVED)
    return filled


def _without_islands(
    ids: Ids, share: Array, weights: Array, group: Sequence[int], neighbors: list[list[int]], least: float
) -> NDArray[np.int32]:
    """Pieces of an instance whose mean share is no majority, or whose points show less than ``least`` of what those of
    its main piece do, unobserved."""
    area = [sum(weights[mask, g] for mask in range(len(group)) if group[mask] == ids[g]) for g in range(len(ids))]
    kept = ids.copy()
    for k in set(ids[ids >= 0].tolist()):
        left, pieces = set(np.flatnonzero(ids == k).tolist()), []
        while left:
            piece = {min(left)}
            while grown := {o for g in left for o in (g, *neighbors[g]) if _linked(g, o, piece, left, neighbors)}:
                piece |= grown
            pieces.append(sorted(piece))
            left -= piece
        main = max(pieces, key=lambda piece: sum(area[g] for g in piece))
        for piece in pieces:
            faint = np.mean([area[g] for g in piece]) < least * np.mean([area[g] for g in main])
            if piece is not main and (faint or np.mean([share[g] for g in piece]) <= 0.5):
                kept[piece] = UNOBSERVED
    return kept


def _linked(g: int, other: int, piece: set[int], left: set[int], neighbors: list[list[int]]) -> bool:
    """Whether ``other`` is of the instance, not yet in the piece, and adjoins it in either direction."""
    if other not in left or other in piece:
        return False
    return any(p in neighbors[other] or other in neighbors[p] for p in piece)


def color_ratios(rgb: NDArray[np.uint8], ids: Ids, sureness: Array, neighbors: list[list[int]]) -> Array:
    """(443,) how many times likelier a difference of colors is within one state than between two, by Eq. of isotonic
    regression: of all intervals about a difference, the least of the greatest means."""
    count = np.zeros((2, 443))
    sure = np.rint(256 * sureness**4) / 256
    for g in np.flatnonzero(sure):
        for other in neighbors[g]:
            apart = np.linalg.norm(rgb[g].astype(float) - rgb[other].astype(float))
            count[int(ids[g] != ids[other]), round(apart)] += sure[g] * sure[other]
    return likelihood_ratios(count)


def likelihood_ratios(count: Array) -> Array:
    """(443,) of (2, 443) counts."""
    if not count.any():
        return np.ones(443)
    count = count + 30 * count.sum(axis=0) / count.sum()
    one, two = count / count.sum(axis=1, keepdims=True)
    seen = np.flatnonzero(one + two)
    one, either = one[seen], (one + two)[seen]
    chance = []
    for place in range(len(seen)):
        means = [
            max(one[low : high + 1].sum() / either[low : high + 1].sum() for high in range(place, len(seen)))
            for low in range(place + 1)
        ]
        chance.append(min(means))
    even = np.clip(np.interp(np.arange(443), seen, chance), 0.1, 0.9)
    return even / (1 - even)


def compared_colors(
    camera: Camera, image: NDArray[np.uint8], xyz: Array, rgb: NDArray[np.uint8], near: float, exposure: Array
) -> tuple[list[int], Array]:
    """Of each point that a view exposes the difference of its color from its pixel's, 443 where there is none; and how
    often points differ so far, (2, 443): exposed ones, by 256ths of their exposure, and others in the image. Pixels
    are those of the photograph divided by its gains."""
    pixels: list[Array | None] = []
    for point in xyz:
        (u, v), depth = (values[0] for values in camera.project(point[None]))
        inside = depth > near and 0 <= u < camera.width and 0 <= v < camera.height and image[int(v), int(u)].any()
        pixels.append(image[int(v), int(u)].astype(float) if inside else None)
    gains = exposure_gains(rgb, pixels, exposure)
    found, count = [], np.zeros((2, 443))
    for pixel, color, open_ in zip(pixels, rgb, exposure, strict=True):
        apart = 443
        if pixel is not None:
            apart = round(np.linalg.norm(color.astype(float) - np.minimum(pixel / gains, 255)))
            count[int(open_ == 0), apart] += round(256 * open_) / 256 if open_ else 1
        found += [apart] if open_ else []
    return found, count


def exposure_gains(rgb: NDArray[np.uint8], pixels: Sequence[Array | None], exposure: Array) -> Array:
    """(3,) of each channel the median of pixel / point over exposed points, in steps of half a percent up to 300, by
    brightness and 256ths of the exposure; 30 points of level 128 without any gain count as well."""
    gains = np.ones(3)
    for channel in range(3):
        steps, weights = [0], [30 * 128.0]
        for pixel, color, open_ in zip(pixels, rgb, exposure, strict=True):
            if pixel is not None and open_ and color[channel]:
                step = round(math.log(max(pixel[channel], 0.5) / color[channel]) / 0.005)
                steps.append(min(max(step, -300), 300))
                weights.append(round(256 * open_) / 256 * color[channel])
        order = np.argsort(steps, kind="stable")
        below = np.cumsum(np.array(weights)[order])
        gains[channel] = math.exp(0.005 * steps[order[np.flatnonzero(below >= below[-1] / 2)[0]]])
    return gains


def believed(exposure: float, ratio: float) -> float:
    """The chance that a view sees a point, by Bayes' rule: half of what seems open is hidden."""
    seen, hidden = ratio * exposure / 2, 1 - exposure / 2
    return seen / (seen + hidden)


# Matching, paper, Eq. 5 --------------------------------------------------------------------------------------------


def eq5(
    weights: Array, outside: Array, mask_view: Sequence[int], ids: Ids, of_instances: Array, of_masks: Array
) -> Array:
    """(masks, instances): IoU of a mask with what its view shows of an instance, times 1 - L1 of their features."""
    scores = np.zeros((len(weights), len(of_instances)))
    for mask, k in np.ndindex(*scores.shape):
        points = np.flatnonzero(ids == k)
        of_view = [other for other in range(len(weights)) if mask_view[other] == mask_view[mask]]
        both = weights[mask, points].sum()
        area = sum(weights[other, points].sum() for other in of_view) + outside[mask_view[mask], points].sum()
        union = area + weights[mask].sum() - both
        apart = np.abs(of_masks[mask] - of_instances[k]).sum()
        scores[mask, k] = both / union * max(1 - apart, 0) if both > 0 else 0
    return scores


# Choosing ----------------------------------------------------------------------------------------------------------


def choice(
    descriptors: Array, owner: Sequence[int], texts: Array, bank: Array, settings: ChoosingSettings
) -> tuple[Array, Array]:
    """(K, L) probability of each label and (K,) of none. owner: the instance of each descriptor, 0 to K - 1."""
    descriptors, texts, bank = _unit(descriptors), _unit(texts), _unit(bank)
    words, labels = _unit(bank - bank.mean(axis=0)), _unit(texts - bank.mean(axis=0))
    shared = _shared(_shared(0 * descriptors[0], descriptors, words, settings), descriptors, words, settings)
    evidence, against = [], []
    for k in range(1 + max(owner)):
        of_words, of_labels = [], []
        for row in (descriptors - shared)[np.array(owner) == k]:
            scores = words @ row
            of_words.append((scores - scores.mean()) / scores.std())
            of_labels.append((labels @ row - scores.mean()) / scores.std())
        best = np.max(of_words, axis=0)  # the best of several descriptors, by how bank words do in that too
        evidence.append((np.max(of_labels, axis=0) - best.mean()) / best.std())
        against.append((best - best.mean()) / best.std())
    sharpness = max(settings.sharpness, np.quantile(np.max(against, axis=1), 0.75))
    different, first = np.unique(np.round(texts, 5), axis=0, return_index=True)
    others = np.flatnonzero((words @ labels.T).max(axis=1) < settings.synonym)
    table, none = np.zeros((len(evidence), len(texts))), np.zeros(len(evidence))
    for k in range(len(evidence)):
        # The mean over the words of the bank that do not mean a label; no less than chance.
        mean = _log_sum(sharpness * against[k][others]) - np.log(len(others)) if len(others) else -np.inf
        no_label = max(mean, sharpness**2 / 2) + np.log(max(len(different), settings.kinds))
        total = _log_sum(np.append(sharpness * evidence[k][first], no_label))
        table[k], none[k] = np.exp(sharpness * evidence[k] - total), np.exp(no_label - total)
    return table, none


def _shared(shared: Array, descriptors: Array, words: Array, settings: ChoosingSettings) -> Array:
    """(D,) what kinds of things share: the mean of their means, of those that a word of the bank fits."""
    _, number = np.unique(np.round(words, 5), axis=0, return_inverse=True)  # words given twice are one
    of_word: dict[int, list[Array]] = {}
    standing = [words @ (row - shared) for row in descriptors]
    evidence = [(scores.max() - scores.mean()) / scores.std() for scores in standing]
    fitting = max(settings.sharpness, np.quantile(evidence, 0.75)) / 2
    for row, scores, stands_out in zip(descriptors, standing, evidence, strict=True):
        if stands_out >= fitting:
            of_word.setdefault(int(number.reshape(-1)[scores.argmax()]), []).append(row)
    means = [np.mean(rows, axis=0) for rows in of_word.values()]
    return (1 - 1 / len(means)) * np.mean(means, axis=0) if means else 0 * shared


def _unit(rows: Array) -> Array:
    """Rows of length 1; a zero row stays zero."""
    rows = rows.astype(np.float64)
    largest = np.abs(rows).max(axis=1, keepdims=True)
    rows = rows / np.where(largest > 0, largest, 1)
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    return rows / np.where(length > 0, length, 1)


def _log_sum(exponents: Array) -> float:
    return float(exponents.max() + np.log(np.exp(exponents - exponents.max()).sum()))


# Smoothed positions -------------------------------------------------------------------------------------------------


def smoothed(xyz: Array, index: NDArray[np.integer], few: int, bias: float) -> Array:
    """`smoothing.smoothed`, point by point in float64."""
    xyz = np.array(xyz, np.float64)
    moved = xyz.copy()
    for g in range(len(xyz)):
        noise = _plane(xyz[np.append(g, index[g, :few])])[0]
        variance, height, normal = _plane(xyz[np.append(g, index[g])])
        moved[g] -= min(1, bias * noise / variance) * height * normal
    return moved


def _plane(points: Array) -> tuple[float, float, Array]:
    """Variance of points off the plane that fits them best, height of the first of them, and the plane's normal; the
    farther a point is from the first, the less weight it has, the last one none."""
    distance = np.linalg.norm(points - points[0], axis=1)
    weight = 1 - (distance / distance[-1]) ** 2
    mean = np.average(points, axis=0, weights=weight)
    values, vectors = np.linalg.eigh(np.cov(points.T, aweights=weight, ddof=0))
    return max(values[0], 0), (points[0] - mean) @ vectors[:, 0], vectors[:, 0]


# Losses of one view, paper, Eq. 1 and 2 ----------------------------------------------------------------------------


def paper_losses(image: Array, mask: NDArray[np.int64], bound: float) -> tuple[float, float, Array, Array]:
    """Eq. 2 (mean over pairs of 1 / (d^2 + bound^2)) and Eq. 1 (sum of squares), and their gradients by the image."""
    image = image.astype(np.longdouble)
    count = int(mask.max()) + 1
    means = np.stack([image[mask == k].mean(axis=0) for k in range(count)])
    cohesion, of_cohesion = np.longdouble(0), np.zeros_like(image)
    for pixel, k in enumerate(mask):
        cohesion += ((image[pixel] - means[k]) ** 2).sum()
        of_cohesion[pixel] = 2 * (image[pixel] - means[k])  # the means' own part adds up to zero
    separation, by_mean = np.longdouble(0), np.zeros_like(means)
    for i, j in product(range(count), repeat=2):
        if i != j:
            apart = means[i] - means[j]
            near = 1 / (apart @ apart + np.longdouble(bound) ** 2)
            separation += near / (count * (count - 1))
            by_mean[i] -= 4 * near**2 * apart / (count * (count - 1))
    of_separation = np.stack([by_mean[k] / (mask == k).sum() for k in mask])
    return float(separation), float(cohesion), of_separation.astype(float), of_cohesion.astype(float)
