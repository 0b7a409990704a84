"""Two visits of a place: what is gone, what is new, what moved, and what nobody looked at again.

Both visits are clouds with the cameras that saw them. For each point of the earlier visit, the later views tell whether
it is still there or is seen through; for each point of the later visit, the earlier views tell whether it was there
already. By instance, over the visible points that are evidence:

    gone     most of them are seen through later, from two places
    new      most of them lie where the earlier visit had seen through, from two places
    moved    a new instance that looks like a gone one; if it looks like one that had left before, it is new, and back
    unseen   too few of them are looked at later to know anything; or the later visit's cloud lacks so many points near
             them that theirs may be missing by chance

Points close to the surface of something else are no evidence: when a book is gone, its lower edge still agrees with the
table. What lies where the earlier visit never looked is neither new nor old: it is added to a map, not reported.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from og_pointcloud.ask.labelled_scene import SceneLike, as_scene
from og_pointcloud.cloud import BACKGROUND
from og_pointcloud.errors import SceneError
from og_pointcloud.journal import with_bar
from og_pointcloud.mapping.likeness import (
    MAX_COLOR_DIFFERENCE,
    MAX_COMPARED_DESCRIPTORS,
    MIN_LIKENESS,
    MIN_UNMOVED_THINGS,
    LikenessScale,
    Look,
    cosines,
    spread_of,
    typical_cosine,
)
from og_pointcloud.mapping.map_record import MapRecord
from og_pointcloud.mapping.presence import (
    MIN_POINTS,
    TOLERANCE_SPACINGS,
    Evidence,
    Presence,
    Visit,
    tolerance_of,
)
from og_pointcloud.rendering.geometry import nearest_in

SAME_SURFACE_SPACINGS = 1.5
"""Points of two visits within this many spacings lie on one surface."""
MAX_COLOR_DEVIATIONS = 3.0
"""The color of one thing may differ by this many times the difference of the median thing that has not moved."""
MIN_STILL_SHARE = 0.05
"""Share of all points looked at, including hidden ones, that must be where they were; else the frames differ."""
SMALL_PIECE_SHARE = 0.5
"""A piece is small if it has less than this share of the other's points."""
MANY_THINGS, MAX_CHANGED_SHARE = 4, 0.5
"""If more than this share of so many things left or moved, a warning asks whether the frames differ."""
OTHER_UNIT_RATIO, RATIO_ERROR, RATIOS_TRIED = 1.25, 0.1, 41
"""Things that are typically this many times as long ask for another unit of length; it is searched for within this
share of that ratio, in so many steps."""
LARGEST_THINGS, COMPARED_POINTS = 200, 5000
"""Number of things and points by which units and places of two visits are compared."""
OFFSET_ROUNDS, OFFSET_REACH_SPACINGS, OFFSET_DAMPING = 6, 4.0, 0.03
"""Steps of the search for one offset of all points; how far it reaches; share of all surfaces that must face a
direction to tell an offset along it."""
MAX_OFF_SHARE = 0.5
"""The unit differs if the right one leaves less than this share of the points that lie off the other visit."""
MAX_THROUGH_SHARE = 0.5
"""If more than this share of the points measured again or seen through is seen through, the frames differ."""


@dataclass(frozen=True)
class Moved:
    """An instance at another place. id: in the earlier cloud. before, after: (3,) float64, the middle of its points
    then and now, world coordinates. now: its id in the later cloud.

    >>> og.Moved(3, np.zeros(3), np.array([1, 0, 2]), 5).to_dict()
    {'id': 3, 'from': [0.0, 0.0, 0.0], 'to': [1, 0, 2]}
    """

    id: int
    before: NDArray[np.float64]
    after: NDArray[np.float64]
    now: int

    def to_dict(self) -> dict[str, Any]:
        """JSON-able: id, from, to."""
        return {"id": self.id, "from": self.before.round(6).tolist(), "to": self.after.round(6).tolist()}


@dataclass(frozen=True)
class Changes:
    """gone, unseen: ids of the earlier cloud. new: ids of the later one. moved: in both.

    >>> print(og.Changes(gone=(1, 4), new=(7,), moved=(), unseen=()))
    2 gone, 1 new, 0 moved, 0 not seen again
    """

    gone: tuple[int, ...]
    new: tuple[int, ...]
    moved: tuple[Moved, ...]
    unseen: tuple[int, ...]

    def to_dict(self) -> dict[str, Any]:
        """JSON-able: gone, new, moved (id, from, to), unseen."""
        moved = [one.to_dict() for one in self.moved]
        return {"gone": list(self.gone), "new": list(self.new), "moved": moved, "unseen": list(self.unseen)}

    def __str__(self) -> str:
        counts = (self.gone, "gone"), (self.new, "new"), (self.moved, "moved"), (self.unseen, "not seen again")
        return ", ".join(f"{len(items)} {name}" for items, name in counts)


def compare(before: SceneLike, after: SceneLike, *, progress: bool = True) -> Changes:
    """Changes between two visits to one place, each a labelled cloud made by `fit` or a mapper.

    Both must lie in one world frame. SceneError if they seem not to, or if the later one does not know its cameras (a
    file of an older version: fit it again); FeatureSpaceError if their descriptors cannot be compared.
    progress: show bars with the remaining time where stderr is a terminal.

    >>> print(og.compare(wall, wall))  # of `fit`'s example
    0 gone, 0 new, 0 moved, 0 not seen again
    """
    earlier = as_scene(before).cloud
    later = Visit.in_frame_of(earlier, as_scene(after).cloud)
    return compare_visits(Visit(earlier), later, progress=progress).changes


@dataclass(frozen=True)
class Comparison:
    """changes, with their evidence. evidence: about the earlier visit's points. nearest: for each later point the row
    of the nearest earlier one, -1 where none lies on its surface. pieces: for instances that came or moved, later id ->
    later id of the thing that it is a piece of (itself, if in one piece). gone_pieces: the same by earlier ids, for
    what moved. back: for those in ``changes.new`` that had left before the earlier visit, later id -> earlier id."""

    changes: Changes
    evidence: Evidence
    nearest: NDArray[np.int64]
    pieces: dict[int, int]
    gone_pieces: dict[int, int]
    back: dict[int, int]


def compare_visits(
    earlier: Visit, later: Visit, again: tuple[NDArray[np.bool_], NDArray[np.bool_]] | None = None,
    *, progress: bool = False,
) -> Comparison:  # fmt: skip
    """Changes with their evidence. Both visits lie in the local frame of the earlier one. Errors as `compare`.

    again: (n,) bool each, which earlier points the later visit measured again and which it saw through, if already
    known; then all points of the later visit count as seen.
    """
    a, b = earlier.cloud, later.cloud
    a.space.require(b.space, "descriptors of the later visit")
    if not b.cameras and later.depth is None:
        raise SceneError("the later visit has no cameras, so what it looked at is unknown: fit its capture again")
    scatter, spacing = max(earlier.surface.scatter, later.surface.scatter), max(a.spacing, b.spacing)
    tolerance = tolerance_of(spacing, scatter)
    # What the earlier views say about both visits' points.
    views = with_bar(earlier.measured(), "then", len(a.cameras), progress and earlier.depth is None)
    shown, was_there = Presence.from_views(views, tolerance, a.xyz, b.xyz)
    if not a.cameras:  # what the earlier visit saw is not known: it may have looked from the same places
        views = with_bar(earlier.measured(b.cameras), "then", len(b.cameras), progress)
        (was_there,) = Presence.from_views(views, tolerance, b.xyz)
    shows = np.ones(len(b), bool)
    missing = np.zeros(len(a))  # depth images lack no points
    # What the later views say about both; where frames were judged one by one, the map has counted it already.
    if again is None:
        _require_one_unit(earlier, later)
        views = with_bar(later.measured(), "now", len(b.cameras), progress and later.depth is None)
        still_there, own = Presence.from_views(views, tolerance, a.xyz, b.xyz)
        _require_one_frame(still_there)
        _warn_of_offset(earlier, later)
        again, shows = (still_there.present, still_there.absent), own.present
        if later.depth is None:
            missing = still_there.missing(nearest_in(cKDTree(b.xyz), a.xyz)[0] > spacing)
    distance, nearest = nearest_in(cKDTree(a.xyz), b.xyz)
    of_earlier = Evidence(shown.present | (not a.cameras), *again, earlier.distinct(tolerance), missing)
    not_there = was_there.missing(distance > spacing)
    of_later = Evidence(shows, was_there.present, was_there.absent, later.distinct(tolerance), not_there)
    nearest = np.where(distance <= SAME_SURFACE_SPACINGS * a.spacing, nearest, -1)
    found = _decide(earlier, later, of_earlier, of_later, nearest)
    _warn_of_many_changes(found.changes, int(np.count_nonzero(earlier.count(a.instance_ids >= 0))))
    return found


def _warn_of_many_changes(changes: Changes, things: int) -> None:
    """A warning where most things changed: in a room, walls agree with themselves even half a meter off."""
    changed, seen = len(changes.gone) + len(changes.moved), things - len(changes.unseen)
    if seen >= MANY_THINGS and changed > MAX_CHANGED_SHARE * seen:
        warnings.warn(
            f"{changed} of the {seen} things that the later visit looks at have left or moved: if they have not, the "
            "two are not in the same world frame: register their poses first",
            stacklevel=4,
        )


def _require_one_unit(earlier: Visit, later: Visit) -> None:
    """SceneError where things are longer in one visit, and shrinking it by as much about the world's origin brings it
    onto the other. A later visit of another part, or with other things, fits best as it is."""
    lengths = _lengths_of_alike(earlier, later)
    ratio = float(np.median(lengths[1] / lengths[0])) if lengths.shape[1] >= MIN_UNMOVED_THINGS else 1.0
    small, large = (earlier.cloud, later.cloud) if ratio > 1 else (later.cloud, earlier.cloud)
    if max(ratio, 1 / ratio) < OTHER_UNIT_RATIO:
        return
    xyz = large.xyz_world[:: 1 + len(large) // COMPARED_POINTS]
    units = [1.0, *(max(ratio, 1 / ratio) * np.linspace(1 - RATIO_ERROR, 1 + RATIO_ERROR, RATIOS_TRIED))]
    tree, reach = cKDTree(small.xyz), SAME_SURFACE_SPACINGS * small.spacing
    off = [float(np.mean(nearest_in(tree, xyz / unit - small.origin)[0] > reach)) for unit in units]
    if min(off) < MAX_OFF_SHARE * off[0]:
        raise SceneError(
            f"things of the later visit are {float(f'{ratio:.3g}'):g} times as long as those of the earlier one, and "
            "all of it is: the two seem to be in different units of length: scale one of them"
        )


def _lengths_of_alike(earlier: Visit, later: Visit) -> NDArray[np.float64]:
    """(2, m) lengths in both visits of the largest things that are most like each other."""
    visits, chosen = (earlier, later), []
    for table in (visit.cloud.instances for visit in visits):
        described = np.flatnonzero(np.bincount(table.descriptor_instance, minlength=len(table)) * table.points > 0)
        chosen.append(described[np.argsort(-table.points[described], kind="stable")[:LARGEST_THINGS]])
    if not all(map(len, chosen)):
        return np.zeros((2, 0))
    alike = cosines(earlier.cloud.instances, chosen[0], later.cloud.instances, chosen[1])
    partner = alike.argmax(axis=1)
    one = np.flatnonzero(alike.argmax(axis=0)[partner] == np.arange(len(partner)))
    pairs = zip(visits, (chosen[0][one], chosen[1][partner[one]]), strict=True)
    lengths = [[visit.look(k, visit.rows[k]).length for k in ids.tolist()] for visit, ids in pairs]
    return np.maximum(np.array(lengths, np.float64).reshape(2, -1), 1e-12)


def _require_one_frame(now: Presence) -> None:
    """SceneError where hardly any point that is looked at again is where it was; a warning where none is looked at."""
    still, through = np.count_nonzero(now.present), np.count_nonzero(now.balance < 0)
    met = np.count_nonzero(now.hidden | (now.balance != 0))
    if through > MAX_THROUGH_SHARE * (still + through) or still < MIN_STILL_SHARE * met:
        raise SceneError(
            f"of {met:,} points that the later visit looks at, {still:,} are where they were and {through:,} are seen "
            "through; expected few changes: the two are not in the same world frame, or show different places: "
            "register their poses first"
        )
    if not met:
        what = f"the later visit looks at none of the earlier visit's {len(now.balance):,} points: they do not overlap"
        warnings.warn(f"{what}, or are not in the same world frame, so changes are unknown", stacklevel=4)


def _warn_of_offset(earlier: Visit, later: Visit) -> None:
    """A warning where one motion brings the surfaces of the later visit onto the earlier one's, and it is longer than
    the points' spacing. Fitted from points to planes (Chen and Medioni, 1992), each weighted by its nearness, as what
    changed lies far off; directions along which most surfaces extend show no offset, and are damped."""
    surface, spacing = earlier.surface, max(earlier.cloud.spacing, later.cloud.spacing)
    xyz = later.surface.xyz[:: 1 + len(later.cloud) // COMPARED_POINTS].astype(np.float64)
    tree, start, middle = cKDTree(surface.xyz), xyz, np.median(xyz, axis=0)
    size = max(float(np.median(np.linalg.norm(xyz - middle, axis=1))), spacing)
    for _ in range(OFFSET_ROUNDS):
        distance, nearest = nearest_in(tree, xyz)
        near = distance < OFFSET_REACH_SPACINGS * spacing
        to, normal = surface.xyz[nearest[near]] - xyz[near], surface.normal[nearest[near]].astype(np.float64)
        off = np.einsum("na,na->n", to, normal)
        # Its change by a shift along each axis, and by a turn around each.
        change = np.c_[normal, np.cross((xyz[near] - middle) / size, normal)]
        weighted = change / np.maximum(np.abs(off), TOLERANCE_SPACINGS * spacing)[:, None]
        normal_equations = weighted.T @ change
        damping = OFFSET_DAMPING * np.trace(normal_equations[:3, :3]) + 1e-12
        shift, turn = np.split(np.linalg.solve(normal_equations + damping * np.eye(6), weighted.T @ off), 2)
        xyz = xyz + shift + np.cross(turn, (xyz - middle) / size)
    moved = float(np.median(np.linalg.norm(xyz - start, axis=1)))
    if moved > spacing:
        warnings.warn(
            f"the later visit lies about {moved:.2g} off the earlier one, {moved / spacing:.2g} times the distance of "
            "its points, so what is near a surface may seem to have come or gone: register their poses first",
            stacklevel=4,
        )


@dataclass(frozen=True)
class _Thing:
    """One thing that left or came, as one visit shows it. pieces: its instances, the largest first. look: of those of
    its points that left or came, with the place of all pieces. points: number of these. surely: significant, not
    chance."""

    pieces: tuple[int, ...]
    look: Look
    points: int
    surely: bool

    def has(self, piece: _Thing, place: NDArray[np.float64], reach: float, scale: LikenessScale) -> bool:
        """Whether another looks like a piece of this one, which then is at that place and this long (reach)."""
        near = np.linalg.norm(piece.look.place - place) < reach
        return bool(near) and self.look.has_color_of(piece.look) and scale.cosine(self.look, piece.look) > MIN_LIKENESS

    def with_pieces(self, other: _Thing) -> _Thing:
        """This one with the pieces of another."""
        points = self.points + other.points
        place = (self.points * self.look.place + other.points * other.look.place) / points
        return _Thing(
            (*self.pieces, *other.pieces), replace(self.look, place=place), points, self.surely or other.surely
        )

    def without_pieces(self) -> _Thing:
        """This one emptied, once another has its pieces; it keeps its position in the list."""
        return _Thing((), self.look, 0, False)


def _decide(
    earlier: Visit, later: Visit, of_earlier: Evidence, of_later: Evidence, nearest: NDArray[np.int64]
) -> Comparison:
    """The changes, from the evidence about both visits. nearest: as in `Comparison`."""
    left, left_surely, unseen = of_earlier.decided(earlier)
    came, came_surely, _ = of_later.decided(later)
    # The similarity of one thing in both visits is learned from what stayed.
    scale = _likeness_scale(earlier, later, _unmoved(earlier, later, nearest, left, came))
    gone = _things(earlier, left, left_surely, of_earlier.through)
    new = _things(later, came, came_surely, of_later.through)
    count = len(gone)  # after them: what an earlier visit found gone and may be back
    gone += [_Thing((k,), look, 0, True) for k, look in MapRecord.of(earlier.cloud).gone.items()]
    gone, new, pairs = _merged_pieces(gone, new, _matched(gone, new, scale), scale)
    # What may be missing by chance has left (or come) if it looks like something that surely came (or left).
    pairs = {g: n for g, n in pairs.items() if gone[g].surely or new[n].surely}
    gone_alone = [thing for g, thing in enumerate(gone[:count]) if g not in pairs and thing.surely]
    new_alone = [thing for n, thing in enumerate(new) if n not in pairs.values() and thing.surely and thing.pieces]
    gone_pieces = {piece: gone[g].pieces[0] for g in pairs for piece in gone[g].pieces}
    # The earlier map has no point of what is back: it came, and did not move.
    back = {new[n].pieces[0]: gone[g].pieces[0] for g, n in pairs.items() if g >= count}
    # What only likely left and looks like nothing that came may be missing by chance: it counts as unseen.
    unseen |= left
    unseen[[piece for thing in gone_alone for piece in thing.pieces] + list(gone_pieces)] = False
    changes = Changes(
        gone=tuple(sorted(piece for thing in gone_alone for piece in thing.pieces)),
        new=tuple(sorted([*back, *(thing.pieces[0] for thing in new_alone)])),
        moved=tuple(
            Moved(gone[g].pieces[0], gone[g].look.place, new[n].look.place, new[n].pieces[0])
            for g, n in sorted(pairs.items())
            if g < count
        ),
        unseen=tuple(np.flatnonzero(unseen & (earlier.count(earlier.cloud.instance_ids >= 0) > 0)).tolist()),
    )  # what left in earlier visits has rows without points in the table: these are not unseen
    come = [*new_alone, *(new[n] for n in pairs.values())]
    pieces = {piece: thing.pieces[0] for thing in come for piece in thing.pieces}
    return Comparison(changes, of_earlier, nearest, pieces, gone_pieces, back)


def _unmoved(
    earlier: Visit, later: Visit, nearest: NDArray[np.int64], left: NDArray[np.bool_], came: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """(m, 2) instances of both visits that share most of their surface with each other, neither left nor came, and have
    descriptors."""
    if not len(left) or not len(came):
        return np.zeros((0, 2), np.int64)
    owners = np.where(nearest >= 0, earlier.cloud.instance_ids[nearest], BACKGROUND)
    stayed = ~np.append(left, [True, True])[owners] & ~np.append(came, [True, True])[later.cloud.instance_ids]
    shared = later.overlap(np.where(stayed, owners, BACKGROUND), len(left))
    described = [
        np.isin(np.arange(len(v.cloud.instances)), v.cloud.instances.descriptor_instance) for v in (earlier, later)
    ]
    # Pairs that are each other's best partner.
    partner, of_later = (np.asarray(shared.argmax(axis=axis)).ravel() for axis in (0, 1))
    one = np.flatnonzero((shared.max(axis=0).toarray().ravel() >= MIN_POINTS) & described[0])
    other = partner[one]
    mutual = (of_later[other] == one) & described[1][other]
    return np.stack([one, other], axis=1)[mutual]


def _likeness_scale(earlier: Visit, later: Visit, unmoved: NDArray[np.int64]) -> LikenessScale:
    """Calibration of cosines and colors by what has not moved, (m, 2): the similarity of each thing in the two visits,
    and to the other thing that is most like it."""
    a, b = earlier.cloud.instances, later.cloud.instances
    # Adjoining instances may be parts of one thing: they do not count as other things.
    adjoining, itself = later.adjoining[unmoved[:, 1]][:, unmoved[:, 1]], np.arange(len(unmoved))
    own, most = np.zeros((2, len(unmoved)))
    for rows in np.array_split(itself, 1 + len(unmoved) // MAX_COMPARED_DESCRIPTORS):
        between = cosines(a, unmoved[rows, 0], b, unmoved[:, 1])
        own[rows] = between[rows - rows[:1], rows]
        between[rows - rows[:1], rows] = between[adjoining[rows].nonzero()] = -np.inf
        most[rows] = between.max(axis=1, initial=-np.inf)
    others = most[np.isfinite(most)]
    if len(others) < MIN_UNMOVED_THINGS:
        spread = spread_of(b.agreement, b.masks)[b.descriptor_instance]
        return LikenessScale(other=typical_cosine(b.descriptors, spread))
    same, other = float(np.median(own)), float(np.median(others))
    one, two = earlier.cloud.rgb, later.cloud.rgb
    if one is None or two is None:
        return LikenessScale(same, other)
    # Different light shifts all colors alike; the rest differs from thing to thing.
    pairs = ((one[earlier.rows[i]], two[later.rows[k]]) for i, k in unmoved.tolist())
    off = np.array([np.median(now, axis=0) - np.median(was, axis=0) for was, now in pairs])
    shift = np.median(off, axis=0)
    usual = float(np.median(np.abs(off - shift).max(axis=1)))
    return LikenessScale(same, other, shift, max(MAX_COLOR_DIFFERENCE, MAX_COLOR_DEVIATIONS * usual))


def _things(
    visit: Visit, chosen: NDArray[np.bool_], surely: NDArray[np.bool_], through: NDArray[np.bool_]
) -> list[_Thing]:
    """Chosen instances as things of one piece, each with the look of its points that left or came: ``through``."""
    rows = {k: visit.rows[k][through[visit.rows[k]]] for k in np.flatnonzero(chosen).tolist()}
    return [_Thing((k,), visit.look(k, of), len(of), bool(surely[k])) for k, of in rows.items()]


def _matched(gone: list[_Thing], new: list[_Thing], scale: LikenessScale) -> dict[int, int]:
    """Row of gone -> row of new where the two look like one thing: the best assignment overall."""
    if not gone or not new:
        return {}
    alike = np.array([[scale.likeness(one.look, other.look) for other in new] for one in gone])
    lengths = [np.array([thing.look.length for thing in things]) for things in (gone, new)]
    as_long = np.minimum.outer(*lengths) / np.maximum(np.maximum.outer(*lengths), 1e-12)
    # Likeness weighs more, and is capped at 1, that of one thing: among several as alike, which may be pieces of one
    # thing, the one of the same length is taken.
    rows, columns = linear_sum_assignment(-np.where(alike > MIN_LIKENESS, 2 * np.minimum(alike, 1) + as_long, 0))
    return {int(g): int(n) for g, n in zip(rows, columns, strict=True) if alike[g, n] > MIN_LIKENESS}


def _merged_pieces(
    gone: list[_Thing], new: list[_Thing], pairs: dict[int, int], scale: LikenessScale
) -> tuple[list[_Thing], list[_Thing], dict[int, int]]:
    """Gone, new and pairs after what moved was merged with its other pieces: instances that look like it, have its
    color, and lie no farther off than it is long. Of those that left, only small ones: a large one that stood beside it
    may have been another of its kind. Things whose pieces were merged stay in the lists, empty."""
    gone, new, pairs = list(gone), list(new), dict(pairs)
    within_visit = replace(scale, shift=0.0)
    for g in sorted(pairs, key=lambda g: -gone[g].points):
        if g not in pairs:  # merged into a larger one
            continue
        n = pairs[g]
        long = max(gone[g].look.length, new[n].look.length)
        for h, piece in enumerate(gone):
            # Where the piece is matched itself, its counterpart must be a piece at the new place.
            small = h != g and 0 < piece.points < SMALL_PIECE_SHARE * gone[g].points
            came_too = h not in pairs or gone[g].has(new[pairs[h]], new[n].look.place, long, scale)
            if small and came_too and gone[g].has(piece, gone[g].look.place, long, within_visit):
                gone[g], gone[h] = gone[g].with_pieces(piece), piece.without_pieces()
                pairs.pop(h, None)
        for k, piece in enumerate(new):
            if k not in pairs.values() and piece.points and gone[g].has(piece, new[n].look.place, long, scale):
                new[n], new[k] = new[n].with_pieces(piece), piece.without_pieces()
    return gone, new, pairs
