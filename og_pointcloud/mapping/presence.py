"""Whether points are still there, from everything that views measured, and what follows for the instances of a visit.

A view that measures a surface at a point votes for it, one that sees through its position votes against it. A growing
map bounds the sum, so that a long history cannot outvote what is seen today. Views from one place alone refute nothing:
a point is absent only if it was seen through from two directions. A view in which no mask shows an object is no
evidence that it is absent: proposers miss things.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.spatial import cKDTree
from scipy.special import bdtrc

from og_pointcloud.cloud import LabelledCloud
from og_pointcloud.errors import SceneError
from og_pointcloud.fitting.association import members_of
from og_pointcloud.formats.poses import in_local_frame
from og_pointcloud.kernels import njit
from og_pointcloud.mapping.likeness import Look, descriptors_of
from og_pointcloud.mapping.sight import AGREES, HIDDEN, THROUGH, DiscSurface, MeasuredView, states_of_points
from og_pointcloud.mapping.voxels import Columns
from og_pointcloud.rendering.geometry import Neighborhood, nearest_in, neighborhood
from og_pointcloud.scene import Camera
from og_pointcloud.settings import GeometrySettings

SAME_DIRECTION_COSINE = 0.998
"""Two viewing directions of a point count as one above this cosine: they differ by less than 3.6 degrees."""
TOLERANCE_SPACINGS = 0.5
"""A point lies on a surface up to this perpendicular distance, in spacings."""
TOLERANCE_DEVIATIONS = 2.0
"""The same in standard deviations of points off their surface. The larger of the two applies: this one in dense, noisy
clouds."""
MAJORITY = 0.5
"""Share of an instance's points that decides for the whole instance."""
MIN_POINTS, MIN_LOOKED_AT_SHARE = 5, 0.05
"""Points of an instance, and share of its visible ones, that must be looked at before anything is decided about it."""
CLEARANCE_TOLERANCES = 1.5
"""A point is evidence for its own instance alone if it lies this many tolerances off every other surface near it."""
MIN_LOST_SHARE = 0.25
"""Share of the points looked at that must be seen through where most of an object lies flat on something else."""
MISSING_SHARE_NEIGHBORS = 32
"""Neighbors of each point seen through from which the share of points missing from the other cloud is estimated."""
SIGNIFICANCE_LEVEL = 0.05
"""Missing points with a probability below this are not missing by chance: the usual significance level."""


def tolerance_of(spacing: float, scatter: float) -> float:
    """Perpendicular distance up to which a point lies on a surface. scatter: standard deviation of points off their
    surface."""
    return max(TOLERANCE_SPACINGS * spacing, TOLERANCE_DEVIATIONS * scatter)


@dataclass
class Presence(Columns):
    """Evidence about n points. tolerance: from `tolerance_of`. balance: (n,) float32, number of views that confirm a
    point minus those that see through it, clipped to +-max_balance. through_directions: (n,) uint8, number of
    directions, up to two, from which it was seen through; first_direction: (n, 3), the first of them. seen_at: (n,)
    float64, latest stamp of a view that measured it or saw through it, -inf without one. hidden: (n,) bool, some view
    measured a surface in front of it."""

    tolerance: float
    max_balance: float = np.inf
    balance: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    through_directions: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(0, np.uint8))
    seen_at: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    hidden: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))
    first_direction: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    FILL_VALUES: ClassVar[dict[str, float]] = {"seen_at": -np.inf}

    @staticmethod
    def from_views(views: Iterable[MeasuredView], tolerance: float, *clouds: NDArray[np.float32]) -> list[Presence]:
        """Evidence of views about all points of each cloud (n, 3). Views are iterated once, as each may be read or
        drawn lazily."""
        known = [(Presence(tolerance), xyz) for xyz in clouds]
        for presence, xyz in known:
            presence.grow(len(xyz))
        for view in views:
            for presence, xyz in known:
                states = states_of_points(xyz, tolerance, view)
                presence.add_states(np.arange(len(xyz)), xyz, states, view.camera.center, 0.0)
        return [presence for presence, _ in known]

    def add_states(
        self, rows: NDArray[np.integer], xyz: NDArray[np.float32], states: NDArray[np.int8],
        center: NDArray[np.float64], stamp: float,
    ) -> None:  # fmt: skip
        """Count the states (m,) of some rows of xyz (n, 3), seen from a camera center. A state older than the latest
        one counted for its point is ignored: a late frame cannot bring back what has left since."""
        self.hidden[rows[states == HIDDEN]] = True
        evidence = self.balance, self.through_directions, self.seen_at, self.first_direction
        _count(rows, xyz, states, center, stamp, self.max_balance, evidence)

    def missing(self, lacks: NDArray[np.bool_]) -> NDArray[np.float64]:
        """(n,) float64: 1 where the views' cloud lacks a point (``lacks``), 0 where it has one, NaN where the views
        measured only surfaces in front of it, so that the cloud could not have it."""
        return np.where(self.hidden & (self.balance == 0), np.nan, lacks)

    @property
    def present(self) -> NDArray[np.bool_]:
        """(n,) bool: more views confirm it than see through it."""
        return self.balance > 0

    @property
    def absent(self) -> NDArray[np.bool_]:
        """(n,) bool: more views see through it than confirm it, from two directions."""
        return (self.balance < 0) & (self.through_directions > 1)


@dataclass(frozen=True)
class Visit:
    """A labelled cloud to be compared. depth: what its depth images measured, in its local frame; None: its own cloud,
    rendered from its cameras, takes their place."""

    cloud: LabelledCloud
    depth: Iterable[MeasuredView] | None = None

    @classmethod
    def in_frame_of(
        cls, other: LabelledCloud, cloud: LabelledCloud, depth: Iterable[MeasuredView] | None = None
    ) -> Visit:
        """A visit moved to the local frame of another. depth: of its views, already in that frame."""
        shift = cloud.origin - other.origin
        cameras = tuple(in_local_frame(camera, -shift) for camera in cloud.cameras)
        return cls(
            replace(cloud, xyz=(cloud.xyz + shift).astype(np.float32), origin=other.origin, cameras=cameras), depth
        )

    @cached_property
    def surface(self) -> DiscSurface:
        """Its cloud as a surface that hides what lies behind it."""
        return DiscSurface(self.cloud.xyz, self.neighbors)

    @cached_property
    def neighbors(self) -> Neighborhood:
        """Neighbors of its points. SceneError where it has none."""
        if not len(self.cloud):
            raise SceneError("a visit has 0 points; expected at least one: it shows nothing to compare")
        return neighborhood(self.cloud.xyz, GeometrySettings())

    def measured(self, cameras: Sequence[Camera] | None = None) -> Iterable[MeasuredView]:
        """What its views measured or, given cameras, what views from there would measure of its cloud."""
        if self.depth is not None and cameras is None:
            return self.depth
        return (self.surface.seen_from(camera) for camera in (self.cloud.cameras if cameras is None else cameras))

    @cached_property
    def rows(self) -> list[NDArray[np.intp]]:
        """Rows of each instance's points, ascending."""
        return members_of(self.cloud.instance_ids, len(self.cloud.instances))

    @cached_property
    def adjoining(self) -> csr_array:
        """(instances, instances) bool: whether some points of the two are neighbors."""
        ids, count = self.cloud.instance_ids, len(self.cloud.instances)
        touching = csr_array((count, count), dtype=np.bool_)
        for neighbor in self.neighbors.index.T:
            touching += _pairs(ids, ids[neighbor], (count, count)).astype(np.bool_)
        return (touching + touching.T).tocsr()

    def look(self, instance: int, rows: NDArray[np.int64]) -> Look:
        """Appearance of an instance, from some of its points."""
        cloud = self.cloud
        place = (cloud.xyz[rows].astype(np.float64) + cloud.origin).mean(axis=0)
        rgb = None if cloud.rgb is None else cloud.rgb[rows]
        return Look.of_points(*descriptors_of(cloud.instances, instance), place, cloud.xyz[rows], cloud.origin, rgb)

    def count(self, chosen: NDArray[np.bool_], sure: NDArray[np.floating] | None = None) -> NDArray[np.float64]:
        """(instances,) number of chosen points of each instance. chosen: (n,) bool. sure: (n,) weight of each point;
        None: 1."""
        ids, weight = self.cloud.instance_ids, np.ones(len(chosen)) if sure is None else sure
        rows = np.flatnonzero(chosen & (ids >= 0))
        return np.asarray(np.bincount(ids[rows], weight[rows], len(self.cloud.instances)), np.float64)

    def overlap(self, owners: NDArray[np.integer], count: int) -> csr_array:
        """(instances, count) int64, number of points of each instance that lie on each of another visit's ``count``
        instances. owners: (n,) the other visit's instance at each point; negative ones are not counted."""
        return _pairs(self.cloud.instance_ids, owners, (len(self.cloud.instances), count))

    def distinct(self, tolerance: float) -> NDArray[np.bool_]:
        """(n,) bool: points that lie off the surfaces of all other instances near them. Something measured there
        belongs to their own instance."""
        ids, surface = self.cloud.instance_ids, self.surface
        off_others = np.ones(len(ids), bool)
        for neighbor in self.neighbors.index.T:
            off = np.abs(np.einsum("na,na->n", self.cloud.xyz - surface.xyz[neighbor], surface.normal[neighbor]))
            off_others &= (ids[neighbor] == ids) | (off > CLEARANCE_TOLERANCES * tolerance)
        return off_others


@dataclass(frozen=True)
class Evidence:
    """Evidence of another visit's views about one visit's points, (n,) bool each. shown: seen by their own visit.
    still: the other visit measures them where they are; through: it sees through them. distinct: off the surfaces of
    all other instances. missing: float64, where the other visit has no depth images: 1 where its cloud lacks the point,
    NaN where it could not have it, as it is hidden.
    """

    shown: NDArray[np.bool_]
    still: NDArray[np.bool_]
    through: NDArray[np.bool_]
    distinct: NDArray[np.bool_]
    missing: NDArray[np.float64]

    def decided(self, visit: Visit) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_]]:
        """(instances,) bool each: likely left, surely left, unknown.

        Instances likely left if they are seen through by more than the share of points that the other cloud lacks near
        them, and surely if that is significant. Unknown are those hardly looked at, unless everything seen of them is
        measured again, and those that lack no more points than their surroundings.
        Each point counts by the certainty of its instance: a part of the table that masks took for the book must not
        keep the book there when it leaves.
        """
        least = np.maximum(MIN_POINTS, MIN_LOOKED_AT_SHARE * visit.count(self.shown))
        seen_through, looked_at = (visit.count(self.shown & of) for of in (self.through, self.through | self.still))
        sure = None if visit.cloud.certainty is None else visit.cloud.certainty / 255  # uint8
        still, distinct, through = (
            visit.count(self.shown & of, sure) for of in (self.still, self.still & self.distinct, self.through)
        )
        most = through > MAJORITY * (through + still)
        # When a flat object is gone, its underside still agrees with the table below: only points off the table count
        # against those seen through. Without the majority, these must be a fair share and have the color of the rest.
        lies_flat = (through > MAJORITY * (through + distinct)) & (through > MIN_LOST_SHARE * (through + still)) & ~most
        for k in np.flatnonzero(lies_flat):
            lies_flat[k] = self._of_one_color(visit, int(k))
        left = (seen_through >= least) & (most | lies_flat)
        # A sparse cloud lacks this share of the points nearby. If the instance were still there, each of its points
        # would be missing with that probability; at least seen_through of looked_at with that of a binomial tail.
        share = self._missing_nearby(visit, left)
        likely = left & (seen_through > share * looked_at)
        surely = likely & (bdtrc(seen_through - 1, looked_at.astype(int), share) < SIGNIFICANCE_LEVEL)
        # Where all points that were seen are measured again, even few of them, or none, leave no doubt.
        again = visit.count(self.shown & self.still) == visit.count(self.shown)
        return likely, surely, ((looked_at < least) & ~again) | (left & ~likely)

    def _missing_nearby(self, visit: Visit, left: NDArray[np.bool_]) -> NDArray[np.float64]:
        """(instances,) for those that may have left, the share of points still standing near those seen through that
        the other visit's cloud lacks; 0 for the others."""
        share, xyz = np.zeros(len(left)), visit.cloud.xyz
        may_have_left = np.append(left, [False, False])[visit.cloud.instance_ids]  # unobserved and background do not
        stands = np.flatnonzero(self.shown & ~self.through & ~may_have_left & ~np.isnan(self.missing))
        tree = cKDTree(xyz[stands])
        for k in np.flatnonzero(left) if self.missing.any() and len(stands) else ():
            rows = visit.rows[k]
            lost = xyz[rows[self.shown[rows] & self.through[rows]]]
            nearby = np.unique(nearest_in(tree, lost, min(MISSING_SHARE_NEIGHBORS, len(stands)))[1])
            share[k] = self.missing[stands[nearby]].mean()
        return share

    def _of_one_color(self, visit: Visit, instance: int) -> bool:
        """Whether the points seen through have the color of the rest; otherwise they are part of something else."""
        rows = visit.rows[instance]
        rows = rows[self.shown[rows]]
        return visit.look(instance, rows[self.through[rows]]).has_color_of(visit.look(instance, rows[self.still[rows]]))


def _pairs(rows: NDArray[np.integer], columns: NDArray[np.integer], shape: tuple[int, int]) -> csr_array:
    """int64 count of each (row, column) pair in the arrays (n,); negative entries are skipped."""
    both = (rows >= 0) & (columns >= 0)
    ones = np.ones(np.count_nonzero(both), np.int64)
    return coo_array((ones, (rows[both], columns[both])), shape=shape).tocsr()


@njit(cache=True, nogil=True)
def _count(rows, xyz, states, center, stamp, max_balance, evidence):  # noqa: ANN001, ANN202
    """Add the states (m,) of points ``rows`` to the evidence: balance, through_directions, seen_at and first_direction
    of `Presence`."""
    balance, directions, seen_at, first = evidence
    for k in range(len(states)):
        i = rows[k]
        # Hidden, or nothing measured: no evidence either way.
        if (states[k] != AGREES and states[k] != THROUGH) or stamp < seen_at[i]:
            continue
        seen_at[i] = stamp
        if states[k] == AGREES:
            balance[i] = min(balance[i] + 1, max_balance)
            continue
        balance[i] = max(balance[i] - 1, -max_balance)
        # Directions to the camera: the first is remembered, the second is any that differs enough from it.
        if directions[i] < 2:
            x, y, z = center[0] - xyz[i, 0], center[1] - xyz[i, 1], center[2] - xyz[i, 2]
            length = max(np.sqrt(x * x + y * y + z * z), 1e-12)
            x, y, z = x / length, y / length, z / length
            if directions[i] == 0:
                first[i] = x, y, z
            if directions[i] == 0 or x * first[i, 0] + y * first[i, 1] + z * first[i, 2] < SAME_DIRECTION_COSINE:
                directions[i] += 1
