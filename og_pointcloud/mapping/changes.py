"""Two visits of a place: what is gone, what is new, what moved, and what nobody looked at again.

Both visits are clouds with the cameras that saw them. Each point of the earlier one is asked of the views of the later
one, and each of the later one of the views of the earlier: is it still (was it already) there, or is its place seen
through (was it)? By instance, over the points that show and that can tell:

    gone     most of them are seen through later, from two places
    new      most of them lie where the earlier visit had looked through, from two places
    moved    a new instance that looks like a gone one
    unseen   so few of them are looked at later that nothing is known

Points close to the surface of something else cannot tell: when a book is gone, its lower edge still agrees with the
table. What lies where the earlier visit never looked is neither new nor old: it is added to a map, and not reported.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from og_pointcloud.ask.labelled_scene import SceneLike, as_scene
from og_pointcloud.cloud import LabelledCloud
from og_pointcloud.errors import SceneError
from og_pointcloud.formats.poses import in_local_frame
from og_pointcloud.mapping.likeness import (
    ALIKE,
    FEWEST_SAME,
    OTHER_COLOR,
    Look,
    Scale,
    cosines,
    descriptors_of,
    spread_of,
    typical_cosine,
)
from og_pointcloud.mapping.map_record import MapRecord
from og_pointcloud.mapping.presence import Presence
from og_pointcloud.mapping.sight import DiscSurface, MeasuredView
from og_pointcloud.rendering.geometry import Neighbourhood, neighbourhood
from og_pointcloud.scene import Camera
from og_pointcloud.settings import GeometrySettings

TOLERANCE = 0.5
"""Spacings at right angles to a surface up to which a point is of it."""
SCATTER = 2.0
"""Standard deviations of the points off their surface, where that is more: of dense and noisy clouds."""
MOST = 0.5
"""Share of an instance's telling points that decides."""
SAME_SURFACE = 1.5
"""Spacings within which two visits' points are of one surface."""
USUAL_COLORS = 3.0
"""Times that the colour of one thing may differ more than that of the median thing which has not moved."""
FEWEST_POINTS, LEAST_SHARE = 5, 0.05
"""Points of an instance, and share of those that show, that must be looked at before anything is said of it."""
TELLING = 1.5
"""Tolerances that a point lies off every other surface about it, to tell of its own thing."""
FLAT_SHARE = 0.25
"""Share of what is looked at that must be seen through where most of a thing lies flat on something else."""
ADJOINING = 3.0
"""Spacings up to which two instances adjoin, and may be pieces of one thing."""
LEAST_STILL = 0.05
"""Share of all points looked at, hidden ones among them, that are where they were."""
SMALL_PIECE = 0.5
"""A piece of less than this share of another's points is small."""
OTHER_FRAME = 0.5
"""Share of all points looked at that are seen through, above which the two do not lie in one frame."""


@dataclass(frozen=True)
class Moved:
    """id: in the earlier cloud. before, after: (3,) float64, where its points were and are on average, world
    coordinates. now: its id in the later cloud.

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
    """gone, unseen: ids of the earlier cloud. new: ids of the later one. moved: what is in both.

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


def compare(before: SceneLike, after: SceneLike) -> Changes:
    """What changed between two visits of one place, of which each is a labelled cloud that `fit` or a mapper made.

    Both lie in one world frame. SceneError where they do not seem to, where the later one does not know its cameras
    (a file of an older version: fit it again), and FeatureSpaceError where their descriptors cannot be compared.

    >>> print(og.compare(wall, wall))  # of `fit`'s example
    0 gone, 0 new, 0 moved, 0 not seen again
    """
    earlier = as_scene(before).cloud
    return compare_visits(Visit(earlier), Visit.in_frame_of(earlier, as_scene(after).cloud)).changes


@dataclass(frozen=True)
class Visit:
    """A labelled cloud as it is compared. depth: what its views measured by depth images, in its local frame; None: its
    own cloud, seen from its cameras."""

    cloud: LabelledCloud
    depth: Iterable[MeasuredView] | None = None

    @classmethod
    def in_frame_of(
        cls, other: LabelledCloud, cloud: LabelledCloud, depth: Iterable[MeasuredView] | None = None
    ) -> Visit:
        """A visit in the local frame of another; depth: of its views, in that frame already."""
        shift = cloud.origin - other.origin
        cameras = tuple(in_local_frame(camera, -shift) for camera in cloud.cameras)
        return cls(
            replace(cloud, xyz=(cloud.xyz + shift).astype(np.float32), origin=other.origin, cameras=cameras), depth
        )

    @cached_property
    def surface(self) -> DiscSurface:
        """Its cloud, as it is seen."""
        return DiscSurface(self.cloud.xyz, self.around)

    @cached_property
    def around(self) -> Neighbourhood:
        """Neighbours of its points."""
        return neighbourhood(self.cloud.xyz, GeometrySettings())

    def measured(self, cameras: Sequence[Camera] | None = None) -> Iterable[MeasuredView]:
        """What its views measured, or, of its cloud, what views from other places would have."""
        if self.depth is not None and cameras is None:
            return self.depth
        return (self.surface.seen_from(camera) for camera in (self.cloud.cameras if cameras is None else cameras))

    def points_of(self, instance: int) -> NDArray[np.int64]:
        """(m,) rows of an instance's points, ascending."""
        return self._by_instance[instance]

    @cached_property
    def _by_instance(self) -> list[NDArray[np.int64]]:
        ids = self.cloud.instance_ids
        order = np.argsort(ids, kind="stable")
        return np.split(order, np.searchsorted(ids[order], np.arange(len(self.cloud.instances) + 1)))[1:-1]

    @cached_property
    def described(self) -> NDArray[np.int64]:
        """(instances,) how many descriptors each has."""
        table = self.cloud.instances
        return np.bincount(table.descriptor_instance, minlength=len(table))

    @cached_property
    def adjoining(self) -> NDArray[np.bool_]:
        """(instances, instances): those with points that are neighbours of each other's; each adjoins itself."""
        ids, found = self.cloud.instance_ids, np.eye(len(self.cloud.instances), dtype=bool)
        for neighbour in self.around.index.T:
            both = (ids >= 0) & (ids[neighbour] >= 0)
            found[ids[both], ids[neighbour[both]]] = True
        return found | found.T

    def color_of(self, instance: int) -> NDArray[np.float64]:
        """(3,) the median colour of an instance; of a cloud with colours."""
        assert self.cloud.rgb is not None
        return np.median(self.cloud.rgb[self.points_of(instance)], axis=0)

    def look(self, instance: int, rows: NDArray[np.int64]) -> Look:
        """The look of an instance, by some of its points."""
        cloud = self.cloud
        rgb = None if cloud.rgb is None else cloud.rgb[rows]
        return Look.of_points(*descriptors_of(cloud.instances, instance), cloud.xyz[rows], rgb)

    def count(self, chosen: NDArray[np.bool_], sure: NDArray[np.floating] | None = None) -> NDArray[np.float64]:
        """(instances,) how many of each instance's points are chosen, (n,) bool; sure: (n,) what each counts."""
        ids, weight = self.cloud.instance_ids, np.ones(len(chosen)) if sure is None else sure
        rows = np.flatnonzero(chosen & (ids >= 0))
        return np.asarray(np.bincount(ids[rows], weight[rows], len(self.cloud.instances)), np.float64)

    def telling(self, tolerance: float) -> NDArray[np.bool_]:
        """(n,) bool: points that lie off the surfaces of all other instances about them."""
        ids, surface = self.cloud.instance_ids, self.surface
        tells = np.ones(len(ids), bool)
        for neighbour in self.around.index.T:
            off = np.abs(np.einsum("na,na->n", self.cloud.xyz - surface.xyz[neighbour], surface.normal[neighbour]))
            tells &= (ids[neighbour] == ids) | (off > TELLING * tolerance)
        return tells


@dataclass(frozen=True)
class Evidence:
    """Of one visit's points, by another's views, (n,) bool each. shown: seen by their own visit. still, through: the
    other visit measures them where they are, or sees through their places. telling: off all surfaces of other things.
    """

    shown: NDArray[np.bool_]
    still: NDArray[np.bool_]
    through: NDArray[np.bool_]
    telling: NDArray[np.bool_]

    def decided(self, visit: Visit) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """(instances,) bool each: those that are seen through; those hardly looked at.

        Each point counts by how sure it is of its instance: a part of the table that a mask took for the book's stays
        when the book leaves.
        """
        least = np.maximum(FEWEST_POINTS, LEAST_SHARE * visit.count(self.shown))
        seen_through, looked_at = (visit.count(self.shown & of) for of in (self.through, self.through | self.still))
        sure = None if visit.cloud.certainty is None else visit.cloud.certainty / 255
        still, telling, through = (
            visit.count(self.shown & of, sure) for of in (self.still, self.still & self.telling, self.through)
        )
        most = through > MOST * (through + still)
        lies_flat = (through > MOST * (through + telling)) & (through > FLAT_SHARE * (through + still)) & ~most
        for k in np.flatnonzero(lies_flat):
            lies_flat[k] = self._of_one_color(visit, int(k))
        return (seen_through >= least) & (most | lies_flat), looked_at < least

    def _of_one_color(self, visit: Visit, instance: int) -> bool:
        """Whether what is seen through is of the colour of the rest: else it is a part of something else."""
        rows = visit.points_of(instance)
        rows = rows[self.shown[rows]]
        return visit.look(instance, rows[self.through[rows]]).has_color_of(visit.look(instance, rows[self.still[rows]]))


@dataclass(frozen=True)
class Comparison:
    """changes, and what they rest on. of_earlier, of_later: the evidence about each visit's points. nearest: of each
    later point the row of the nearest earlier one, -1 where none is of its surface. pieces: later id -> the later id
    whose thing it is a piece of. gone_pieces: earlier id -> the moved thing that it was a piece of."""

    changes: Changes
    of_earlier: Evidence
    of_later: Evidence
    nearest: NDArray[np.int64]
    pieces: dict[int, int]
    gone_pieces: dict[int, int]


def compare_visits(
    earlier: Visit, later: Visit, again: tuple[NDArray[np.bool_], NDArray[np.bool_]] | None = None
) -> Comparison:
    """What changed, with the evidence. Both in the frame of the earlier one. Errors as `compare`.

    again: (n,) bool each, which of the earlier points the later visit measured again, or saw through, where that is
    known already; the later visit's points are then all taken to be seen.
    """
    a, b = earlier.cloud, later.cloud
    a.space.require(b.space, "later descriptors")
    if not b.cameras and later.depth is None:
        raise SceneError("the later visit does not know its cameras, so not what it looked at: fit its capture again")
    scatter = max(earlier.surface.scatter, later.surface.scatter)
    tolerance = max(TOLERANCE * max(a.spacing, b.spacing), SCATTER * scatter)
    shown, known = Presence.by(earlier.measured(), tolerance, a.xyz, b.xyz)
    if not a.cameras:  # what the earlier visit saw is not known: it may have looked from the same places
        (known,) = Presence.by(earlier.measured(b.cameras), tolerance, b.xyz)
    shows = np.ones(len(b), bool)
    if again is None:
        asked, own = Presence.by(later.measured(), tolerance, a.xyz, b.xyz)
        _require_one_frame(asked)
        again, shows = (asked.present, asked.absent), own.present
    of_earlier = Evidence(shown.present | (not a.cameras), *again, earlier.telling(tolerance))
    of_later = Evidence(shows, known.present, known.absent, later.telling(tolerance))
    distance, nearest = map(np.asarray, cKDTree(a.xyz).query(b.xyz, workers=-1))
    return _decide(earlier, later, of_earlier, of_later, np.where(distance <= SAME_SURFACE * a.spacing, nearest, -1))


def _require_one_frame(asked: Presence) -> None:
    """SceneError where hardly a point that is looked at again is where it was."""
    still, through = np.count_nonzero(asked.present), np.count_nonzero(asked.odds < 0)
    met = np.count_nonzero(asked.hidden | (asked.odds != 0))
    if through > OTHER_FRAME * (still + through) or still < LEAST_STILL * met:
        raise SceneError(
            f"of {met:,} points that the later visit looks at, {still:,} are where they were and {through:,} are seen "
            "through; expected few changes: the two do not lie in one world frame, or are of two places: register "
            "their poses first"
        )


@dataclass(frozen=True)
class _Thing:
    """Instances of one visit that are pieces of one thing that left or came, the largest first. look: by the points
    that show so. place: (3,) their mean, world coordinates; points: how many."""

    pieces: tuple[int, ...]
    look: Look
    place: NDArray[np.float64]
    points: int

    def has(self, piece: _Thing, place: NDArray[np.float64], reach: float, scale: Scale) -> bool:
        """Whether a thing looks like a piece of this one, which is at that place then and so long."""
        near = np.linalg.norm(piece.place - place) < reach
        return bool(near) and self.look.has_color_of(piece.look) and scale.cosine(self.look, piece.look) > ALIKE

    def with_pieces(self, other: _Thing) -> _Thing:
        """This one with the pieces of another."""
        points = self.points + other.points
        place = (self.points * self.place + other.points * other.place) / points
        return replace(self, pieces=(*self.pieces, *other.pieces), place=place, points=points)

    def without_pieces(self) -> _Thing:
        """What is left of this one once another has its pieces."""
        return replace(self, pieces=(), points=0)


def _decide(
    earlier: Visit, later: Visit, of_earlier: Evidence, of_later: Evidence, nearest: NDArray[np.int64]
) -> Comparison:
    left, hardly = of_earlier.decided(earlier)
    came, _ = of_later.decided(later)
    scale = _scale(earlier, later, _unmoved(earlier, later, nearest, left, came))
    gone = _things(earlier, np.flatnonzero(left).tolist(), of_earlier.through, scale)
    new = _things(later, np.flatnonzero(came).tolist(), of_later.through, scale)
    retired = [  # what an earlier visit found gone, and may be back
        _Thing((k,), entry.look(earlier.cloud.instances, k), np.array(entry.place), 0)
        for k, entry in MapRecord.of(earlier.cloud).gone.items()
    ]
    unmatched, gone = set(range(len(gone))), [*gone, *retired]
    pairs = _matched(gone, new, scale)
    gone, new, pairs = _gathered(gone, new, pairs, scale)
    taken = set(pairs.values())
    changes = Changes(
        gone=tuple(sorted(k for g in unmatched - {*pairs} for k in gone[g].pieces)),
        new=tuple(thing.pieces[0] for n, thing in enumerate(new) if n not in taken and thing.pieces),
        moved=tuple(
            Moved(gone[g].pieces[0], gone[g].place, new[n].place, new[n].pieces[0]) for g, n in sorted(pairs.items())
        ),
        unseen=tuple(np.flatnonzero(hardly & (earlier.count(earlier.cloud.instance_ids >= 0) > 0) & ~left).tolist()),
    )
    pieces = {piece: thing.pieces[0] for thing in new for piece in thing.pieces}
    gone_pieces = {piece: gone[g].pieces[0] for g in pairs for piece in gone[g].pieces}
    return Comparison(changes, of_earlier, of_later, nearest, pieces, gone_pieces)


def _unmoved(
    earlier: Visit, later: Visit, nearest: NDArray[np.int64], left: NDArray[np.bool_], came: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """(m, 2) instances of both visits that share most of their surface with each other, and neither left nor came."""
    ids, count = later.cloud.instance_ids, (len(left), len(came))
    owners = np.where(nearest >= 0, earlier.cloud.instance_ids[nearest], -1)
    both = (ids >= 0) & (owners >= 0)
    shared = np.bincount(owners[both] * np.int64(count[1]) + ids[both], minlength=count[0] * count[1]).reshape(count)
    shared[left], shared[:, came] = 0, 0
    if not shared.size:
        return np.zeros((0, 2), np.int64)
    one = np.flatnonzero((shared.max(axis=1) >= FEWEST_POINTS) & (earlier.described > 0))
    other = shared[one].argmax(axis=1)
    mutual = (shared[:, other].argmax(axis=0) == one) & (later.described[other] > 0)
    return np.stack([one, other], axis=1)[mutual]


def _scale(earlier: Visit, later: Visit, unmoved: NDArray[np.int64]) -> Scale:
    """What cosines and colours mean, by what has not moved, (m, 2): how alike the two visits show it, and how alike it
    is to what is most like it of the rest."""
    a, b = earlier.cloud.instances, later.cloud.instances
    between = cosines(a, b)[np.ix_(*unmoved.T)]
    others = np.where(later.adjoining[np.ix_(unmoved[:, 1], unmoved[:, 1])], -np.inf, between).max(
        axis=1, initial=-np.inf
    )
    others = others[np.isfinite(others)]
    if len(others) < FEWEST_SAME:
        return Scale(other=typical_cosine(b.descriptors, spread_of(b.agreement, b.masks)[b.descriptor_instance]))
    same, other = float(np.median(between.diagonal())), float(np.median(others))
    if earlier.cloud.rgb is None or later.cloud.rgb is None:
        return Scale(same, other)
    off = np.array([later.color_of(k) - earlier.color_of(i) for i, k in unmoved.tolist()])
    shift = np.median(off, axis=0)
    usual = float(np.median(np.abs(off - shift).max(axis=1)))
    return Scale(same, other, shift, max(OTHER_COLOR, USUAL_COLORS * usual))


def _things(visit: Visit, candidates: list[int], through: NDArray[np.bool_], scale: Scale) -> list[_Thing]:
    """Candidates, those that adjoin and look alike together: pieces of one thing. Of a small piece, which few masks
    show, the colour is enough."""
    rows = {k: visit.points_of(k)[through[visit.points_of(k)]] for k in candidates}
    looks = {k: visit.look(k, of) for k, of in rows.items()}
    trees = {k: cKDTree(visit.cloud.xyz[of]) for k, of in rows.items()}
    group = {k: k for k in candidates}
    reach, within = ADJOINING * visit.cloud.spacing, replace(scale, shift=0.0)
    for index, one in enumerate(candidates):
        for other in candidates[index + 1 :]:
            small = SMALL_PIECE * max(len(rows[one]), len(rows[other])) > min(len(rows[one]), len(rows[other]))
            alike = within.likeness(looks[one], looks[other]) > ALIKE
            alike |= small and looks[one].has_color_of(looks[other])
            if alike and trees[one].count_neighbors(trees[other], reach):
                group = {k: group[one] if of == group[other] else of for k, of in group.items()}
    things = []
    for first in dict.fromkeys(group.values()):
        pieces = sorted((k for k in candidates if group[k] == first), key=lambda k: (-len(rows[k]), k))
        xyz = visit.cloud.xyz_world[np.concatenate([rows[k] for k in pieces])]
        things.append(_Thing(tuple(pieces), looks[pieces[0]], xyz.mean(axis=0), len(xyz)))
    return things


def _matched(gone: list[_Thing], new: list[_Thing], scale: Scale) -> dict[int, int]:
    """Row of gone -> row of new, where the two look like one thing, best pairs first over all."""
    if not gone or not new:
        return {}
    alike = np.array([[scale.likeness(one.look, other.look) for other in new] for one in gone])
    lengths = [np.array([thing.look.length for thing in things]) for things in (gone, new)]
    as_long = np.minimum.outer(*lengths) / np.maximum(np.maximum.outer(*lengths), 1e-12)
    # Of several that are alike, pieces of one thing perhaps, the one that is as long.
    rows, columns = linear_sum_assignment(-np.where(alike > ALIKE, 2 * np.minimum(alike, 1) + as_long, 0))
    return {int(g): int(n) for g, n in zip(rows, columns, strict=True) if alike[g, n] > ALIKE}


def _gathered(
    gone: list[_Thing], new: list[_Thing], pairs: dict[int, int], scale: Scale
) -> tuple[list[_Thing], list[_Thing], dict[int, int]]:
    """Gone, new and pairs with more pieces of what moved taken into it: they look like it, have its colour, and lie no
    farther off than it is long. Of what left, small pieces alone: what stood beside it may have been another of its
    kind. What holds such pieces then has none of its own."""
    gone, new, pairs = list(gone), list(new), dict(pairs)
    here = replace(scale, shift=0.0)
    for g in sorted(pairs, key=lambda g: -gone[g].points):
        if g not in pairs:
            continue
        n = pairs[g]
        long = max(gone[g].look.length, new[n].look.length)
        for h, piece in enumerate(gone):
            small = h != g and 0 < piece.points < SMALL_PIECE * gone[g].points
            came_too = h not in pairs or gone[g].has(new[pairs[h]], new[n].place, long, scale)
            if small and came_too and gone[g].has(piece, gone[g].place, long, here):
                gone[g], gone[h] = gone[g].with_pieces(piece), piece.without_pieces()
                pairs.pop(h, None)
        for k, piece in enumerate(new):
            if k not in pairs.values() and piece.points and gone[g].has(piece, new[n].place, long, scale):
                new[n], new[k] = new[n].with_pieces(piece), piece.without_pieces()
    return gone, new, pairs
