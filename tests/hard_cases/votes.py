"""What views say of points and what becomes of it: exposures of any size, ties, conflicts, borders; and Eq. 5."""

from __future__ import annotations

from dataclasses import replace

import literal
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from hard_cases.case import Answer, agrees, powers
from hard_cases.inputs import int32, single, unit_rows
from og_pointcloud.cloud import BACKGROUND, UNOBSERVED
from og_pointcloud.fitting.grouping import MaskGroups
from og_pointcloud.fitting.learned.matching import eq5_scores, match_masks, visible_evidence
from og_pointcloud.fitting.mask_table import MaskTable
from og_pointcloud.fitting.membership import Membership, assign_points
from og_pointcloud.fitting.seen_colors import differences
from og_pointcloud.fitting.view_votes import view_votes
from og_pointcloud.rendering.geometry import Neighborhood
from og_pointcloud.scene import Camera, Points, View
from og_pointcloud.settings import MatchingSettings, MembershipSettings

POINTS, REACH = 80, 3


@agrees(1e-6, "exposure of the other views", (1e-30, *powers(-18, 0, 3)))
def exposure(share: float) -> Answer:
    """One view sees every point openly, the others that much of it: what shines through hardly counts."""
    table = _table(seed=0)
    shown = table.exposure.toarray()
    shown[1:] *= np.float32(share)
    return _votes(replace(table, exposure=csr_array(shown)))


@agrees(1e-6)
def exposure_zero_and_one() -> Answer:
    """Views that see a point fully or not at all; what no view sees has no vote."""
    table = _table(seed=1)
    seen = (np.random.default_rng(2).random((4, POINTS)) < 0.5) & (table.exposure.toarray() > 0)
    seen[:, :5] = False
    masked = table.weights.toarray() * seen[table.mask_view]
    parts = masked, table.outside.toarray() * seen, np.where(seen, 1, 0).astype(np.float32)
    return _votes(_made(*parts, table.mask_view.tolist()))


@agrees(1e-6)
def votes_of_one_view() -> Answer:
    """A single view: what it shows counts in full, however little of a point it sees."""
    return _votes(_table(seed=3, views=1))


@agrees(0)
def conflicting_views() -> Answer:
    """Of views that show a point in and out of a mask the majority decides; of two that differ, "possible" does."""
    inside = single([[1, 1, 1, 0], [1, 1, 0, 0], [1, 0, 0, 0]])
    table = _made(inside, 1 - inside, np.ones((3, 4), np.float32), [0, 1, 2])
    ids = _assigned(table, [0, 0, 0], _lone(4)).instance_ids
    return Answer(ids, int32([0, 0, BACKGROUND, BACKGROUND]))


@agrees(0)
def tied_groups() -> Answer:
    """Two instances with the same right to every point: the lower number has them."""
    table = _made(np.ones((2, 6)), np.zeros((2, 6)), np.ones((2, 6)), [0, 1])
    return Answer(_assigned(table, [0, 1], _lone(6)).instance_ids, np.zeros(6, np.int32))


@agrees(0, "seed", tuple(range(8)))
def membership_of_any_votes(seed: float) -> Answer:
    """Points on a line whose masks are torn at random: the state of each, against the literal form."""
    ours, (ids, *_) = _both(int(seed))
    return Answer(ours.instance_ids, ids)


@agrees(1e-6, "seed", tuple(range(4)))
def certainty_of_any_votes(seed: float) -> Answer:
    """How sure of it the same points are."""
    ours, (_, certainty, _) = _both(int(seed))
    return Answer(ours.certainty, certainty)


@agrees(1e-6, "seed", tuple(range(4)))
def expected_iou_of_any_votes(seed: float) -> Answer:
    """How much of each group is expected to be right."""
    ours, (*_, expected) = _both(int(seed))
    return Answer(ours.expected_iou, expected)


@agrees(0, "seed", tuple(range(4)))
def borders_by_color(seed: float) -> Answer:
    """Points hear each neighbor as far as its color speaks for one thing."""
    random = np.random.default_rng(int(seed))
    rgb = np.clip(3 * np.arange(POINTS)[:, None] + random.normal(0, 9, (POINTS, 3)), 0, 255).astype(np.uint8)
    ours, (ids, *_) = _both(int(seed), rgb)
    return Answer(ours.instance_ids, ids)


@agrees(1e-6, "seed", tuple(range(4)))
def certainty_by_color(seed: float) -> Answer:
    """How sure the same points are where colors tell the groups, and many neighbors say more together than they may."""
    noise = np.random.default_rng(int(seed)).normal(0, 3, (POINTS, 3))
    rgb = (60 + 60 * (3 * np.arange(POINTS)[:, None] // POINTS) + noise).astype(np.uint8)
    ours, (_, certainty, _) = _both(int(seed), rgb, reach=15)
    return Answer(ours.certainty, certainty)


@agrees(0, "color difference", (0.0, 12.0, 40.0, 120.0))
def outline_by_color(difference: float) -> Answer:
    """What one view alone has a mask of is noise where the colors across its outline hardly differ."""
    thing, blob = np.arange(POINTS) < POINTS // 3, np.abs(np.arange(POINTS) - 0.75 * POINTS) < POINTS / 8
    masks = np.array([thing, blob, *[thing] * 4], float)
    shown = np.ones((5, POINTS))
    noise = np.random.default_rng(0).normal(0, 4, (POINTS, 3))
    rgb = (90 + noise + 100 * thing[:, None] + difference / np.sqrt(3) * blob[:, None]).astype(np.uint8)
    table = _made(masks, shown - np.array([masks[0] + masks[1], *masks[2:]]) * shown, shown, [0, 0, 1, 2, 3, 4])
    ours, (ids, *_) = _by_both(table, [0, 1, 0, 0, 0, 0], rgb)
    return Answer(ours.instance_ids, ids)


@agrees(0, "gain", (0.01, 0.3, 1.0, 3.0, 100.0))
def colors_of_any_exposure(gain: float) -> Answer:
    """How far colors of points and pixels differ where the photograph is hardly exposed, or much too long."""
    random, side = np.random.default_rng(0), 12
    xyz = np.append(random.uniform(-1, 1, (200, 2)), np.full((200, 1), 2.0), axis=1).astype(np.float32)
    rgb = random.integers(0, 256, (200, 3)).astype(np.uint8)
    camera = Camera(side, side, float(side), float(side), side / 2, side / 2, np.eye(4))
    image = np.zeros((side, side, 3), np.uint8)
    u, v = np.floor(camera.project(xyz)[0]).astype(int).T
    image[v, u] = np.clip(np.rint(gain * rgb * [1, 0.8, 1.2]), 0, 255)
    view = View("any", camera, np.full((side, side), -1, np.int32), np.zeros((0, 2), np.float32), image)
    shown = np.flatnonzero(random.random(200) < 0.8).astype(np.int32)
    open_ = np.zeros(200)
    open_[shown] = 0.7
    found, counts = differences(Points(xyz, np.zeros(3), rgb), view, 0.1, shown, open_[shown].astype(np.float32))
    expected, expected_counts = literal.compared_colors(camera, image, xyz, rgb, 0.1, open_)
    return Answer(np.append(found, counts), np.append(expected, expected_counts))


@agrees(1e-6, "seed", tuple(range(4)))
def spanning_masks_of_any_votes(seed: float) -> Answer:
    """How sure the same points are where two masks span several groups."""
    ours, (_, certainty, _) = _both(int(seed), spanning=(10, 11))
    return Answer(ours.certainty, certainty)


@agrees(0)
def seen_by_no_view() -> Answer:
    """Points that no view sees take the state of the nearest that one does; without one, they stay unobserved."""
    inside = single([[1, 0, 0, 0, 0]])
    table = _made(inside, single([[0, 1, 0, 0, 0]]), single([[1, 1, 0, 0, 0]]), [0])
    neighbors = [[1], [0], [0, 1], [1, 0], []]
    return Answer(_assigned(table, [0], neighbors).instance_ids, int32([0, BACKGROUND, 0, BACKGROUND, UNOBSERVED]))


@agrees(1e-6, "seed", (0, 1, 2))
def eq5(seed: float) -> Answer:
    """Eq. 5 of masks with instances, of which one has no point."""
    table, random = _table(int(seed), views=3), np.random.default_rng(int(seed))
    ids = random.integers(-1, 4, POINTS).astype(np.int32)  # instance 4 is empty
    return _eq5(table, ids, random.random((5, 6)) / 9, random.random((len(table.mask_view), 6)) / 9)


@agrees(1e-6)
def eq5_of_zero_features() -> Answer:
    """Features that are all zero are alike: the score is the IoU."""
    table = _table(seed=4, views=2)
    return _eq5(table, (np.arange(POINTS) % 3).astype(np.int32), np.zeros((3, 6)), np.zeros((len(table.mask_view), 6)))


@agrees(0)
def eq5_of_equal_iou() -> Answer:
    """Two masks of a view that show an instance equally well: the first is accepted, and the same in every view."""
    weights = np.array([[1, 0], [0, 1], [1, 0], [0, 1]]).repeat(5, axis=1).astype(np.float32)
    table = _made(weights, np.zeros((2, 10)), np.ones((2, 10)), [0, 0, 1, 1])
    ids = np.zeros(10, np.int32)
    evidence = visible_evidence(table, ids, np.zeros((1, 6)), np.zeros((4, 6)))
    matched = match_masks(table, ids, evidence, MatchingSettings(threshold=0.2))
    return Answer(matched.mask_instance, int32([0, -1, 0, -1]))


def _eq5(table: MaskTable, ids: NDArray[np.int32], of_instances: NDArray, of_masks: NDArray) -> Answer:
    ours = eq5_scores(visible_evidence(table, ids, of_instances, of_masks), table.mask_view, MatchingSettings())
    dense = table.weights.toarray().astype(float), table.outside.toarray().astype(float)
    return Answer(ours, literal.eq5(*dense, table.mask_view.tolist(), ids, of_instances, of_masks))


def _made(weights: NDArray, outside: NDArray, exposure: NDArray, mask_view: list[int]) -> MaskTable:
    dense = (csr_array(np.asarray(part, np.float32)) for part in (weights, outside, exposure))
    return MaskTable(*dense, int32(mask_view), np.ones(len(mask_view), np.int32), unit_rows(len(mask_view), 4))


def _table(seed: int, views: int = 4) -> MaskTable:
    """Points on a line in three stretches; each view masks them, with edges of its own, torn, sometimes wrong."""
    random = np.random.default_rng(seed)
    shown, shares, mask_view = random.uniform(0.1, 9, (views, POINTS)), [], []
    for view in range(views):
        place = np.arange(POINTS) + random.normal(0, 3, POINTS) + random.normal(0, 3)
        stretch = np.clip(3 * place // POINTS, 0, 2)
        torn = np.where(random.random(POINTS) < 0.3, random.random(POINTS), 0.97)
        for instance in range(3):
            spilt = 0.3 * random.random(POINTS) * (1 - torn)
            shares.append(np.where(stretch == instance, torn, spilt))
            mask_view.append(view)
    of_view = np.array(shares).reshape(views, 3, POINTS).sum(axis=1)
    masked = np.array(shares) * shown[mask_view]
    seen = random.random((views, POINTS)) < 0.85
    visible = seen[mask_view]
    outside = np.maximum(1 - of_view, 0.01) * shown * seen
    return _made(masked * visible, outside, random.uniform(0.02, 1, (views, POINTS)) * seen, mask_view)


def _votes(table: MaskTable) -> Answer:
    ours, exact = view_votes(table), _literal(table)
    return Answer(
        np.concatenate([ours.in_mask.toarray(), ours.vote.toarray()]), np.concatenate([exact.inside, exact.weight])
    )


def _literal(table: MaskTable) -> literal.Votes:
    parts = (part.toarray().astype(float) for part in (table.weights, table.outside, table.exposure))
    return literal.view_votes(*parts, table.mask_view.tolist())


def _lone(count: int) -> list[list[int]]:
    return [[] for _ in range(count)]


def _assigned(
    table: MaskTable, group: list[int], neighbors: list[list[int]], rgb: NDArray[np.uint8] | None = None,
    spanning: tuple[int, ...] = (),
) -> Membership:  # fmt: skip
    """The library's answer; neighbors of each point, nearest first."""
    width = max(1, *map(len, neighbors))
    index, adjoining = np.zeros((len(neighbors), width), np.int32), np.zeros((len(neighbors), width), bool)
    for point, near in enumerate(neighbors):
        index[point, : len(near)], adjoining[point, : len(near)] = near, True
    around = Neighborhood(np.ones(len(neighbors), np.float32), index, adjoining)
    groups = MaskGroups(int32(group), max(group) + 1, np.isin(np.arange(len(group)), spanning))
    return assign_points(table, view_votes(table), groups, around, MembershipSettings(), rgb)


def _both(
    seed: int, rgb: NDArray[np.uint8] | None = None, spanning: tuple[int, ...] = (), reach: int = REACH
) -> tuple[Membership, tuple[NDArray, NDArray, NDArray]]:
    """Membership of a torn table by the library and by the literal form. A fourth group is noise of a single mask; the
    last mask is of none, or spans several, as all of ``spanning`` do."""
    table = _table(seed)
    group = [mask % 3 for mask in range(12)]
    group[3 + seed % 3] = 3
    for mask in {*spanning, len(group) - 1}:
        group[mask] = -1
    return _by_both(table, group, rgb, spanning, reach)


def _by_both(
    table: MaskTable, group: list[int], rgb: NDArray[np.uint8] | None, spanning: tuple[int, ...] = (),
    reach: int = REACH,
) -> tuple[Membership, tuple[NDArray, NDArray, NDArray]]:  # fmt: skip
    """Membership of points on a line by the library and by the literal form."""
    near = [
        sorted((o for o in range(max(0, g - reach), min(POINTS, g + reach + 1)) if o != g), key=lambda o: abs(o - g))
        for g in range(POINTS)
    ]
    weights, settings = table.weights.toarray().astype(float), MembershipSettings()
    exact = literal.membership(_literal(table), weights, table.mask_view.tolist(), group, near, settings, rgb, spanning)
    return _assigned(table, group, near, rgb, spanning), exact
