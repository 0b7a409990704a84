"""Whether points are still there, from all that views measured, and what that says of the instances of a visit.

A view that measures a surface where a point lies speaks for it, one that looks through its place speaks against it. In
a map that grows the sum is bounded, so that a long history cannot outvote what is seen today. Views from one place
alone refute nothing: a point is absent only if it was seen through from two directions. A view in which no mask shows
an object is no evidence that it is absent: proposers miss things.
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

APART = 0.998
"""Cosine between two directions of sight, from the point, below which they count as two: 3.6 degrees."""
TOLERANCE = 0.5
"""Distance in spacings, at right angles to a surface, up to which a point lies on it."""
SCATTER = 2.0
"""The same in standard deviations of points off their surface; the larger of the two holds, this one in dense and noisy
clouds."""
MOST = 0.5
"""Share of an instance's points above which they decide for it."""
FEWEST_POINTS, LEAST_SHARE = 5, 0.05
"""Points of an instance, and share of those that show, that must be looked at before anything is said of it."""
TELLING = 1.5
"""Tolerances that a point must lie off every other surface near it to be evidence for its own instance alone."""
FLAT_SHARE = 0.25
"""Share of what is looked at that must be seen through where most of an object lies flat on something else."""
ABOUT = 32
"""Neighbors of each point seen through by which it is estimated how much the other cloud leaves out there."""
CHANCE = 0.05
"""Probability below which it is no accident that a cloud lacks points: the usual level of a test."""


def tolerance_of(spacing: float, scatter: float) -> float:
    """Distance from a surface, at right angles to it, up to which a point lies on it. scatter: standard deviation of
    points off their surface."""
    return max(TOLERANCE * spacing, SCATTER * scatter)


@dataclass
class Presence(Columns):
    """Evidence about n points. tolerance: of `tolerance_of`. most: bound of the odds. odds: (n,) float32, the number of
    views that confirm a point less those that see through it, within the bound. refuted: (n,) uint8, directions, up to
    two, from which it was seen through; first: (n, 3), the first of them. seen_at: (n,) float64, the latest stamp of a
    view that measured it, or its place; -inf where none did. hidden: (n,) bool, some view measured a surface in front
    of it."""

    tolerance: float
    most: float = np.inf
    odds: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    refuted: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(0, np.uint8))
    seen_at: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    hidden: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))
    first: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    SPARE: ClassVar[dict[str, float]] = {"seen_at": -np.inf}

    @staticmethod
    def by(views: Iterable[MeasuredView], tolerance: float, *clouds: NDArray[np.float32]) -> list[Presence]:
        """What views say of all points of each cloud (n, 3). Views are gone through once, as each may be read or drawn
        only then."""
        presences = [Presence(tolerance) for _ in clouds]
        for presence, xyz in zip(presences, clouds, strict=True):
            presence.grow(len(xyz))
        for view in views:
            for presence, xyz in zip(presences, clouds, strict=True):
                states = states_of_points(xyz, tolerance, view)
                presence.take(np.arange(len(xyz)), xyz, states, view.camera.center, 0.0)
        return presences

    def take(
        self, rows: NDArray[np.integer], xyz: NDArray[np.float32], states: NDArray[np.int8],
        center: NDArray[np.float64], stamp: float,
    ) -> None:  # fmt: skip
        """Take in the states (m,) of some rows of xyz (n, 3), seen from a camera center. A state older than the latest
        counted for its point is left out: a frame that comes late cannot bring back what has left since."""
        self.hidden[rows[states == HIDDEN]] = True
        evidence = self.odds, self.refuted, self.seen_at, self.first
        _count(rows, xyz, states, center, stamp, self.most, evidence)

    def left_out(self, lacks: NDArray[np.bool_]) -> NDArray[np.float64]:
        """(n,) float64: ``lacks``, 1 where the views' cloud lacks a point and 0 where it has one; NaN where the views
        measured only what lies in front of it, and so could not have it."""
        return np.where(self.hidden & (self.odds == 0), np.nan, lacks)

    @property
    def present(self) -> NDArray[np.bool_]:
        """(n,) bool: confirmed by more views than see through."""
        return self.odds > 0

    @property
    def absent(self) -> NDArray[np.bool_]:
        """(n,) bool: seen through by more views than confirm it, and from two places."""
        return (self.odds < 0) & (self.refuted > 1)


@dataclass(frozen=True)
class Visit:
    """A labelled cloud as it is compared. depth: what its views measured by depth images, in its local frame; None:
    what its own cloud shows from its cameras."""

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
        """Its cloud as a surface that hides what lies behind it."""
        return DiscSurface(self.cloud.xyz, self.around)

    @cached_property
    def around(self) -> Neighborhood:
        """Neighbors of its points. SceneError where it has none."""
        if not len(self.cloud):
            raise SceneError("a visit has 0 points; expected at least one: it shows nothing to compare")
        return neighborhood(self.cloud.xyz, GeometrySettings())

    def measured(self, cameras: Sequence[Camera] | None = None) -> Iterable[MeasuredView]:
        """What its views measured; or, with cameras, what views from there would measure of its cloud."""
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
        for neighbor in self.around.index.T:
            touching += _pairs(ids, ids[neighbor], (count, count)).astype(np.bool_)
        return (touching + touching.T).tocsr()

    def look(self, instance: int, rows: NDArray[np.int64]) -> Look:
        """How an instance looks, by some of its points."""
        cloud = self.cloud
        place = (cloud.xyz[rows].astype(np.float64) + cloud.origin).mean(axis=0)
        rgb = None if cloud.rgb is None else cloud.rgb[rows]
        return Look.of_points(*descriptors_of(cloud.instances, instance), place, cloud.xyz[rows], cloud.origin, rgb)

    def count(self, chosen: NDArray[np.bool_], sure: NDArray[np.floating] | None = None) -> NDArray[np.float64]:
        """(instances,) how many points of each instance are chosen. chosen: (n,) bool. sure: (n,) what a point counts;
        None: 1."""
        ids, weight = self.cloud.instance_ids, np.ones(len(chosen)) if sure is None else sure
        rows = np.flatnonzero(chosen & (ids >= 0))
        return np.asarray(np.bincount(ids[rows], weight[rows], len(self.cloud.instances)), np.float64)

    def shared(self, owners: NDArray[np.integer], count: int) -> csr_array:
        """(instances, count) int64, how many points of each instance lie on each of another visit's ``count``
        instances. owners: (n,) the other's instance at each point; negative ones are not counted."""
        return _pairs(self.cloud.instance_ids, owners, (len(self.cloud.instances), count))

    def telling(self, tolerance: float) -> NDArray[np.bool_]:
        """(n,) bool: points that lie off the surfaces of all other instances near them: something measured there is of
        their own instance."""
        ids, surface = self.cloud.instance_ids, self.surface
        tells = np.ones(len(ids), bool)
        for neighbor in self.around.index.T:
            off = np.abs(np.einsum("na,na->n", self.cloud.xyz - surface.xyz[neighbor], surface.normal[neighbor]))
            tells &= (ids[neighbor] == ids) | (off > TELLING * tolerance)
        return tells


@dataclass(frozen=True)
class Evidence:
    """What another visit's views say of one visit's points, (n,) bool each. shown: seen by their own visit. still: the
    other visit measures them where they are; through: it sees through their places. telling: off all surfaces of other
    instances. left_out: float64, of a visit without depth images: 1 where its cloud has no point there, NaN where it
    could have none, being hidden.
    """

    shown: NDArray[np.bool_]
    still: NDArray[np.bool_]
    through: NDArray[np.bool_]
    telling: NDArray[np.bool_]
    left_out: NDArray[np.float64]

    def decided(self, visit: Visit) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_]]:
        """(instances,) bool each: those that likely left, being seen through, and by more than the other cloud leaves
        out of all that stands near them; those of them that surely did, as this is no accident; and those of which
        nothing is known: hardly looked at, unless all that was seen is measured again, or left out no more than all
        near them.

        Each point counts by how sure it is of its instance: a part of the table that masks took for the book's must not
        keep the book there when it leaves.
        """
        least = np.maximum(FEWEST_POINTS, LEAST_SHARE * visit.count(self.shown))
        seen_through, looked_at = (visit.count(self.shown & of) for of in (self.through, self.through | self.still))
        sure = None if visit.cloud.certainty is None else visit.cloud.certainty / 255  # uint8
        still, telling, through = (
            visit.count(self.shown & of, sure) for of in (self.still, self.still & self.telling, self.through)
        )
        most = through > MOST * (through + still)
        # The underside of what lies flat agrees with the table below when it is gone: there, only points off the table
        # count against those seen through. Without that majority, these must be a fair share, and of the rest's color.
        lies_flat = (through > MOST * (through + telling)) & (through > FLAT_SHARE * (through + still)) & ~most
        for k in np.flatnonzero(lies_flat):
            lies_flat[k] = self._of_one_color(visit, int(k))
        left = (seen_through >= least) & (most | lies_flat)
        # A sparse cloud lacks this share of what stands near by. Were the instance still there, each of its points
        # would be missing with that probability: at least seen_through of looked_at by the tail of a binomial
        # distribution.
        share = self._left_out_about(visit, left)
        likely = left & (seen_through > share * looked_at)
        surely = likely & (bdtrc(seen_through - 1, looked_at.astype(int), share) < CHANCE)
        # Where all points that were seen are measured again, even few of them, or none, leave no doubt.
        again = visit.count(self.shown & self.still) == visit.count(self.shown)
        return likely, surely, ((looked_at < least) & ~again) | (left & ~likely)

    def _left_out_about(self, visit: Visit, left: NDArray[np.bool_]) -> NDArray[np.float64]:
        """(instances,) for those that may have left, the share that the other visit's cloud leaves out of what still
        stands near their points that are seen through; 0 for the others."""
        share, xyz = np.zeros(len(left)), visit.cloud.xyz
        may_have_left = np.append(left, [False, False])[visit.cloud.instance_ids]  # unobserved and background do not
        stands = np.flatnonzero(self.shown & ~self.through & ~may_have_left & ~np.isnan(self.left_out))
        tree = cKDTree(xyz[stands])
        for k in np.flatnonzero(left) if self.left_out.any() and len(stands) else ():
            rows = visit.rows[k]
            asked = xyz[rows[self.shown[rows] & self.through[rows]]]
            about = np.unique(nearest_in(tree, asked, min(ABOUT, len(stands)))[1])
            share[k] = self.left_out[stands[about]].mean()
        return share

    def _of_one_color(self, visit: Visit, instance: int) -> bool:
        """Whether the points seen through have the color of the rest: else they are a part of something else."""
        rows = visit.rows[instance]
        rows = rows[self.shown[rows]]
        return visit.look(instance, rows[self.through[rows]]).has_color_of(visit.look(instance, rows[self.still[rows]]))


def _pairs(rows: NDArray[np.integer], columns: NDArray[np.integer], shape: tuple[int, int]) -> csr_array:
    """How often each pair of a row and a column stands in the arrays (n,), int64; negative ones are left out."""
    both = (rows >= 0) & (columns >= 0)
    ones = np.ones(np.count_nonzero(both), np.int64)
    return coo_array((ones, (rows[both], columns[both])), shape=shape).tocsr()


@njit(cache=True, nogil=True)
def _count(rows, xyz, states, center, stamp, most, evidence):  # noqa: ANN001, ANN202
    """Add the states (m,) of points ``rows`` to the evidence: odds, refuted, seen_at and first of `Presence`."""
    odds, refuted, seen_at, first = evidence
    for k in range(len(states)):
        i = rows[k]
        # Hidden, or nothing measured: no evidence either way.
        if (states[k] != AGREES and states[k] != THROUGH) or stamp < seen_at[i]:
            continue
        seen_at[i] = stamp
        if states[k] == AGREES:
            odds[i] = min(odds[i] + 1, most)
            continue
        odds[i] = max(odds[i] - 1, -most)
        # Directions to the camera: the first is remembered, the second is any that differs enough from it.
        if refuted[i] < 2:
            x, y, z = center[0] - xyz[i, 0], center[1] - xyz[i, 1], center[2] - xyz[i, 2]
            length = max(np.sqrt(x * x + y * y + z * z), 1e-12)
            x, y, z = x / length, y / length, z / length
            if refuted[i] == 0:
                first[i] = x, y, z
            if refuted[i] == 0 or x * first[i, 0] + y * first[i, 1] + z * first[i, 2] < APART:
                refuted[i] += 1
