"""The state of a growing map: its points, whether they are still there, their votes, and what views showed.

Which points a frame shows, and in which of its masks, follows from its depth or, without depth, from the map's own
surface: points behind it are hidden.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike, NDArray

from og_pointcloud.cloud import FeatureSpace
from og_pointcloud.errors import SceneError
from og_pointcloud.formats.depth import DepthImage
from og_pointcloud.formats.fusion import on_surface, to_world
from og_pointcloud.formats.poses import in_local_frame
from og_pointcloud.mapping.frame import CheckedFrame
from og_pointcloud.mapping.kept_views import KeptView, KeptViews
from og_pointcloud.mapping.presence import Presence, tolerance_of
from og_pointcloud.mapping.sight import AGREES, THROUGH, MeasuredView, states_of_points
from og_pointcloud.mapping.tracks import NO_TRACK, PointVotes, Tracks
from og_pointcloud.mapping.voxels import MAX_READINGS, VoxelPoints
from og_pointcloud.rendering.geometry import depths, isotropic
from og_pointcloud.rendering.sightings import Sightings, openness, sightings_of
from og_pointcloud.rendering.splatting import NEAR_SHARE
from og_pointcloud.rendering.surface import sight_thickness
from og_pointcloud.scene import Camera, Points, numbers_of
from og_pointcloud.settings import GeometrySettings

MARGIN_SHARE = 0.1
"""Points up to this share of the image beyond its border are drawn, as they may hide others within."""
READINGS_PER_SPACING = 1.5
"""Depth readings of a frame used per spacing, along each image axis: more would only be averaged."""
MAX_BALANCE = 3.0
"""A point's history counts as at most this many frames, for it or against it."""
MIN_SAME_POSE_COSINE = 0.995
"""Two frames of one stamp have different poses if one is turned against the other by more than this cosine (5.7
degrees), or stands farther from it than the points' spacing."""
RECENT_FRAMES = 4096
"""Number of latest frames whose stamps are kept: they tell since when an object has been where it is."""


@dataclass
class GrowingMap:
    """origin: (3,), world = local + origin. anchors: stamp and pose of each frame that added points. sequence: number
    of the next frame; 0 stands for what was known before the first. stamp: the latest of all frames. recent: stamps of
    the last RECENT_FRAMES frames, in order of arrival. spacing: of each of the first rows, the points known at the
    start. scale: size of points drawn for frames without depth, in spacings; None: not chosen yet. drawn: number of
    such frames kept when it was chosen."""

    origin: NDArray[np.float64]
    space: FeatureSpace
    points: VoxelPoints
    presence: Presence
    votes: PointVotes = field(default_factory=PointVotes)
    tracks: Tracks = field(default_factory=Tracks)
    kept: KeptViews = field(default_factory=KeptViews)
    anchors: list[tuple[float, NDArray[np.float64]]] = field(default_factory=list)
    sequence: int = 1
    stamp: float = -1.0
    recent: list[float] = field(default_factory=list)
    spacing: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    scale: float | None = None
    drawn: int = 0

    @classmethod
    def empty(
        cls, origin: NDArray[np.float64], space: FeatureSpace, spacing: float, *, grows: bool = True,
        scatter: float = 0.0,
    ) -> GrowingMap:  # fmt: skip
        """A map without points. grows: whether frames add some. scatter: standard deviation of points off their
        surface."""
        presence = Presence(tolerance_of(spacing, scatter), MAX_BALANCE)
        return cls(origin, space, VoxelPoints(spacing, grows), presence)

    def grow(self) -> None:
        """Allocate all per-point arrays up to the number of points."""
        for columns in (self.presence, self.votes, self.kept):
            columns.grow(self.points.n)

    def rows_in_view(self, camera: Camera, margin: float = 0.0, most: int = 1 << 31) -> NDArray[np.int32]:
        """Rows of the points that are there and may project into an image, or within a share ``margin`` beyond its
        border; at most ``most`` of them, evenly chosen."""
        rows = self.points.packets.in_view(camera, self.points.edge, margin=margin)
        rows = rows[:: 1 + len(rows) // most]
        return rows[self.points.weight[rows] > 0]

    def spacing_of(self, rows: NDArray[np.int32]) -> NDArray[np.float32]:
        """(m,) spacing of points; the voxel edge for those that frames added."""
        return np.append(self.spacing, np.float32(self.points.edge))[np.minimum(rows, len(self.spacing))]

    def judge(self, view: MeasuredView, stamp: float) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Count a view's measurements for and against points. Returns the rows of those that it confirms, and of those
        to be removed after it."""
        presence, points = self.presence, self.points
        rows = self.rows_in_view(view.camera)
        states = states_of_points(points.xyz[rows], presence.tolerance, view)
        presence.add_states(rows, points.xyz, states, view.camera.center, stamp)
        # At least two more frames see through a point than confirm it, from two places: one alone removes nothing.
        through = rows[states == THROUGH]
        refuted = (presence.balance[through] < -1) & (presence.through_directions[through] > 1)
        return rows[states == AGREES], through[refuted]

    def add(self, frame: CheckedFrame) -> NDArray[np.int32]:
        """Add the readings of a frame, thinned to the map's density and without flying pixels, which lie between two
        surfaces. Returns the rows of the new points; of known geometry, those of points that had left and are measured
        again."""
        points, view, before = self.points, frame.view, self.points.n
        if view is None:
            return np.zeros(0, np.int32)
        if not points.grows:
            return self._returned(view, frame.stamp)
        left = np.flatnonzero(~points.alive)
        image, camera = DepthImage(view.depth, view.camera), view.camera
        step = max(1, int(points.edge / view.pixel / READINGS_PER_SPACING))
        chosen = on_surface(image, view.noise, step, slanted=True)
        xyz, pixel = to_world(image, chosen), np.flatnonzero(chosen)
        rgb = np.full((len(xyz), 3), 128, np.uint8)
        if frame.rgb is not None:
            # The image has more pixels than the view where its depth was sparse (`view_of_depth`).
            scale = frame.rgb.shape[0] / camera.height, frame.rgb.shape[1] / camera.width
            row, column = pixel // camera.width, pixel % camera.width
            rgb = frame.rgb[(row * scale[0]).astype(np.intp), (column * scale[1]).astype(np.intp)]
        # A late frame cannot bring back what has left since.
        closed = ~points.alive & (self.presence.seen_at[:before] > frame.stamp)
        if points.add(xyz.astype(np.float32), rgb, len(self.anchors), closed):
            self.anchors.append((frame.stamp, frame.camera.world_to_camera))
        added = np.arange(before, points.n, dtype=np.int32)
        self.grow()
        self.presence.balance[added], self.presence.seen_at[added] = 1, frame.stamp
        # What comes where others had left takes their rows.
        self.kept.born[added] = self.kept.born[left[points.weight[left] > 0]] = self.sequence
        return added

    def _returned(self, view: MeasuredView, stamp: float) -> NDArray[np.int32]:
        """Rows of the points that had left and that a view measures where they were; they are there again."""
        points, presence = self.points, self.presence
        rows = points.packets.in_view(view.camera, points.edge)
        left = rows[(points.weight[rows] == 0) & (presence.seen_at[rows] <= stamp)]  # not by a late frame
        back = left[states_of_points(points.xyz[left], presence.tolerance, view) == AGREES]
        points.weight[back], presence.balance[back], presence.seen_at[back] = MAX_READINGS, 1, stamp
        self.kept.born[back] = self.sequence
        return back

    def owners(self) -> NDArray[np.int32]:
        """(n,) the track of each point, NO_TRACK for those that left."""
        everyone = np.arange(self.points.n, dtype=np.int32)
        return np.where(self.points.alive, self.votes.best(everyone, self.tracks.root), NO_TRACK)

    def rows_of(self, track: int) -> NDArray[np.int32]:
        """Rows of the points of a track; only packets that meet the track's box are searched."""
        (low, high), edge = self.tracks.tracks[track].box, self.points.edge
        rows = self.points.packets.in_box(low - edge, high + edge)
        return rows[(self.points.weight[rows] > 0) & (self.votes.best(rows, self.tracks.root) == track)]

    def forget(self, rows: NDArray[np.int32]) -> None:
        """Reset the votes and evidence of points that left, or whose object left; from this frame on they may belong to
        something else."""
        self.votes.track[rows], self.votes.weight[rows] = NO_TRACK, 0
        self.presence.balance[rows], self.presence.through_directions[rows] = 0, 0
        self.kept.born[rows] = self.sequence

    def place_of(self, rows: NDArray[np.integer]) -> NDArray[np.float64]:
        """(3,) middle of points, world coordinates: the median, as votes assign some far-off points to an object."""
        return np.median(self.points.xyz[rows].astype(np.float64), axis=0) + self.origin

    def checked_poses(self, poses: Mapping[float, ArrayLike]) -> dict[float, Camera]:
        """Stamp -> a camera with the corrected world_to_camera of that frame. SceneError or a warning as in
        `Mapper.correct`."""
        if strange := [stamp for stamp in poses if not isinstance(stamp, Real)]:
            raise SceneError(f"a pose is given for frame {strange[0]!r}; expected the frame's stamp, a number")
        cameras = {float(t): Camera(1, 1, 1.0, 1.0, 0.5, 0.5, numbers_of(pose)) for t, pose in poses.items()}
        placed = [*self.anchors, *((view.stamp, view.camera.world_to_camera) for view in self.kept.views)]
        first = dict(reversed(placed))
        for stamp, pose in ((stamp, pose) for stamp, pose in placed if stamp in cameras):
            apart = first[stamp] @ np.linalg.inv(pose)
            turned = apart[:3, :3].trace() < 1 + 2 * MIN_SAME_POSE_COSINE
            if turned or np.linalg.norm(apart[:3, 3]) > self.points.edge:
                raise SceneError(
                    f"frames of stamp {stamp:.15g} have different poses, as of two cameras; expected one that the "
                    "corrected pose replaces: give the frames of each camera stamps of their own"
                )
        known = {*self.recent, *first}
        strange = [stamp for stamp in cameras if stamp not in known and stamp >= self.remembered_since]
        some = ", ".join(f"{stamp:.15g}" for stamp in strange[:3]) + ", ..." * (len(strange) > 3)
        if strange and len(strange) == len(cameras):  # seconds instead of nanoseconds, say
            there = f", {min(known):.15g} to {max(known):.15g}" if known else ""
            raise SceneError(f"the poses have stamps {some}; expected those of integrated frames{there}")
        if strange:
            what = f"{len(strange)} of {len(cameras)} poses are for frames that were not integrated: {some}"
            warnings.warn(what, stacklevel=3)
        return cameras

    def correct(self, cameras: Mapping[float, Camera]) -> None:
        """Move the points that the frames of these stamps added, and where these points say that things stood.
        cameras: from `checked_poses`."""
        corrected = {stamp: in_local_frame(camera, self.origin).world_to_camera for stamp, camera in cameras.items()}
        for index, (stamp, old) in enumerate(self.anchors):
            if stamp not in corrected:
                continue
            # A point keeps its place in the frame of its camera: out of the old pose, into the corrected one.
            motion = np.linalg.inv(corrected[stamp]) @ old
            rows = np.flatnonzero(self.points.anchor == index)
            self.points.xyz[rows] = self.points.xyz[rows] @ motion[:3, :3].T + motion[:3, 3]
            self.anchors[index] = stamp, corrected[stamp]
            turn, shift = motion[:3, :3], motion[:3, 3] + self.origin
            for track in self.tracks.tracks:
                if track.left and track.left_anchor == index:
                    track.left = track.left.moved_to(turn @ (track.left.place - self.origin) + shift)
                if track.home is not None and track.home_anchor == index:
                    track.home = turn @ (track.home - self.origin) + shift
        for index, view in enumerate(self.kept.views):
            if view.stamp in corrected:
                camera = replace(view.camera, world_to_camera=corrected[view.stamp])
                self.kept.views[index] = replace(view, camera=camera)
        self.points.reindex()
        for heaviest in self.votes.track[: self.points.n].T:
            self.tracks.extend_boxes(self.points.xyz, np.arange(self.points.n), heaviest)
        # Snapshots are cached by sequence: they are made again after a correction.
        self.count(self.stamp)

    @property
    def remembered_since(self) -> float:
        """Not all frames before this stamp are remembered."""
        return min(self.recent) if len(self.recent) == RECENT_FRAMES else -np.inf

    def count(self, stamp: float) -> None:
        """One more frame is in."""
        self.sequence += 1
        self.recent = [*self.recent[1 - RECENT_FRAMES :], stamp]

    def stamp_of(self, sequence: int) -> float:
        """The stamp of the frame of that number, or of the earliest remembered one; -inf for what was known before all
        frames."""
        place = sequence - (self.sequence - len(self.recent))  # the last of recent is number sequence - 1
        return self.recent[max(place, 0)] if sequence > 0 else -np.inf


@dataclass(frozen=True)
class Seen:
    """Points in one frame. rows: (m,) int32 candidate points. found: which of these are seen, by index into ``rows``.
    mask: (s,) id at the pixel of each seen point, -1 none."""

    rows: NDArray[np.int32]
    found: Sightings
    mask: NDArray[np.int32]

    @property
    def points(self) -> NDArray[np.int32]:
        """(s,) rows of the points that are seen."""
        return self.rows[self.found.openness.indices]


def measured_points(frame: CheckedFrame, known: GrowingMap, rows: NDArray[np.int32]) -> Seen:
    """The points in a frame's image among those that its depth measured; as they were measured, all are fully open."""
    uv_px, _ = frame.camera.project(known.points.xyz[rows])
    inside = frame.camera.shows(uv_px)
    return _seen(frame, rows[inside], np.ones(np.count_nonzero(inside), np.float32), uv_px[inside])


def drawn_points(frame: CheckedFrame, known: GrowingMap, geometry: GeometrySettings) -> Seen:
    """The points that a frame without depth sees: those not hidden by the map's own points, drawn as in `fit`."""
    camera, rows = frame.camera, np.sort(known.rows_in_view(frame.camera, MARGIN_SHARE))
    xyz, spacing = known.points.xyz[rows], known.spacing_of(rows)
    drawn = isotropic(Points(xyz, np.zeros(3)), spacing, known.scale or geometry.middle_scale, geometry.opacity)
    depth = depths(xyz, camera)
    near = NEAR_SHARE * float(np.median(depth)) if len(depth) else 1e-6
    open_, u, v = openness(drawn, camera, near, sight_thickness(spacing, known.points.edge, geometry))
    return _seen(frame, rows, open_, np.stack([u, v], axis=1))


def _seen(
    frame: CheckedFrame, rows: NDArray[np.int32], open_: NDArray[np.float32], uv_px: NDArray[np.floating]
) -> Seen:
    u, v = np.ascontiguousarray(uv_px.T, np.float32)
    found = sightings_of(open_, u, v, frame.ids, len(frame.features))
    last = frame.camera.width - 1, frame.camera.height - 1
    column, row = np.minimum(uv_px[found.openness.indices].astype(np.intp), last).T
    return Seen(rows, found, frame.ids[row, column])


def vote(frame: CheckedFrame, known: GrowingMap, seen: Seen) -> tuple[list[int], list[int]]:
    """Count the frame's masks: for now as votes of points and witnesses of tracks, for later as rows of the mask table.

    Returns the tracks that are now objects and need an id, and those with an id that were seen again.
    """
    known.space = frame.space  # its width is not known before the first mask, its name perhaps later
    points, seen_at = seen.points, known.presence.seen_at
    away = np.linalg.norm(known.points.xyz[points] - frame.camera.center, axis=1)
    view = KeptView.of(frame, known.sequence, seen.found, seen.rows)
    known.kept.offer(view, float(np.median(away)) if len(away) else 0.0)
    seen_at[points] = np.maximum(seen_at[points], frame.stamp)
    weight = seen.found.openness.data.astype(np.float32)
    when = frame.stamp, known.sequence
    return known.tracks.observe(known.votes, known.points.xyz, points, seen.mask, weight, frame.features, when)
