"""A map that grows with every frame, and knows what came, went and moved.

A frame is checked, then judged: which points of the map it measures again, sees through, cannot see. Its depth adds
points; its masks vote (`tracks`); what it shows is kept as rows of the mask table (`kept_views`), and the frame itself
is let go. Points seen through from two places leave, and an object leaves with most of its visible points. All of that
touches only what the frame sees. `snapshot` and `finish` then label every point by the batch rule from the rows kept.
"""

from __future__ import annotations

import os
import time
import zlib
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from og_pointcloud.ask.labelled_scene import LabelledScene, SceneLike, as_scene
from og_pointcloud.cloud import UNKNOWN_SPACE, FeatureSpace, LabelledCloud
from og_pointcloud.errors import SceneError
from og_pointcloud.kernels import njit, prange
from og_pointcloud.mapping import map_state
from og_pointcloud.mapping.batch import label
from og_pointcloud.mapping.changes import FEWEST_POINTS, MOST, SCATTER, TOLERANCE, Changes, Moved, Visit, compare_visits
from og_pointcloud.mapping.frame import CheckedFrame, Frame, checked, require_same_place
from og_pointcloud.mapping.kept_views import KeptViews, Moment
from og_pointcloud.mapping.likeness import ALIKE, Look, likeness, spread_of
from og_pointcloud.mapping.map_journal import MapJournal
from og_pointcloud.mapping.map_record import MapRecord
from og_pointcloud.mapping.merging import merge
from og_pointcloud.mapping.presence import Presence
from og_pointcloud.mapping.renumber import matched_ids, with_ids
from og_pointcloud.mapping.sight import AGREES, DiscSurface, MeasuredView, lens_of, states_of_points, view_of_depth
from og_pointcloud.mapping.tracks import NO_TRACK, PointVotes, Track, Tracks
from og_pointcloud.mapping.voxels import VoxelPoints
from og_pointcloud.rendering.geometry import Neighbourhood, isotropic, neighbourhood
from og_pointcloud.rendering.sightings import Sightings, openness, sightings_of
from og_pointcloud.rendering.splatting import NEAR_SHARE
from og_pointcloud.rendering.surface import sight_thickness
from og_pointcloud.scene import Camera, Points, require_finite
from og_pointcloud.settings import FitSettings

__all__ = ["FrameChange", "MapObject", "Mapper"]

PIXELS_PER_SPACING = 4.0
"""Pixels of the first depth image, at its median depth, to a spacing of a map that starts empty."""
READINGS_PER_SPACING = 1.5
"""Readings a spacing that a frame gives to the map, along each axis: more would only be averaged."""
SLANT = 0.15
"""Cosine between ray and surface below which a reading is no point: edges of depth images fly."""
POINT_COLUMNS = "_xyz", "_rgb", "_weight", "_anchor", "_keys", "_rows"
VOTE_COLUMNS = "track", "weight"
PRESENCE_COLUMNS = "odds", "refuted", "seen_at", "hidden", "_from"
MARGIN = 0.1
"""Share of an image beyond its border from which points are drawn, as they may hide others within."""
MOST_ODDS = 3.0
"""Frames that history counts for at most."""
RECENT_FRAMES = 4096
"""Stamps of frames that are remembered: those that a journal still holds are not integrated twice."""
PRUNED_EVERY = 64
"""Frames after which tracks that came to nothing are let go."""
USUAL_SHARE = 0.3
"""Part of an object's points that a usual frame shows."""
KNOWN_VOTES = 8.0
"""Votes that a point of an earlier map has for its instance."""


@dataclass(frozen=True)
class FrameChange:
    """What a frame changed, by object ids. new: objects seen for the first time often enough; updated: seen again;
    gone: most of their visible points were seen through; moved: where they were and are. seconds: it took."""

    new: tuple[int, ...] = ()
    updated: tuple[int, ...] = ()
    gone: tuple[int, ...] = ()
    moved: tuple[Moved, ...] = ()
    seconds: float = 0.0


@dataclass(frozen=True)
class MapObject:
    """An object as it is known now. place: (3,) mean of its points, world coordinates; size: (3,) along the axes.
    state: "present" or "gone" (then where it was last). last_seen: the stamp."""

    id: int
    state: str
    place: NDArray[np.float64]
    size: NDArray[np.float64]
    points: int
    views: int
    last_seen: float
    descriptor: NDArray[np.float64] | None = field(repr=False)


@dataclass
class _Left:
    """An object that left: its look and last place, (3,) world coordinates, for when it is found again."""

    look: Look
    place: NDArray[np.float64]
    size: NDArray[np.float64]


class Mapper:
    """See the module.

    start: a map (.ogpc, scene or cloud) to go on with; None: an empty one, which grows by depth. cloud: (N, 3) world
    coordinates, or `Points`, whose geometry is known, so that frames need bring masks alone. spacing: of a map that
    starts empty, world lengths; None: by the first depth image. feature_space: the name of the masks' encoder. journal:
    a folder that holds the map while it grows (`map_journal`); one that holds it already is gone on with.

    >>> import numpy as np
    >>> import og_pointcloud as og
    >>> x, y = np.meshgrid(np.linspace(-1, 1, 40), np.linspace(-1, 1, 40))
    >>> mapper = og.Mapper(cloud=np.stack([x, y, np.full_like(x, 2)], axis=-1).reshape(-1, 3))
    >>> camera = og.Camera(64, 64, 64.0, 64.0, 32.0, 32.0, np.eye(4))
    >>> masks = np.repeat(np.arange(64)[None] >= 32, 64, axis=0).astype(int)
    >>> for _ in range(3):
    ...     change = mapper.integrate(og.Frame(camera, masks, np.eye(2)))
    >>> change.updated, mapper.snapshot().cloud.instances.points
    ((0, 1), array([800, 800], dtype=int32))
    """

    def __init__(
        self,
        start: SceneLike | None = None,
        *,
        cloud: ArrayLike | Points | None = None,
        spacing: float | None = None,
        feature_space: str = UNKNOWN_SPACE,
        settings: FitSettings | None = None,
        journal: str | os.PathLike[str] | None = None,
    ) -> None:
        if start is not None and cloud is not None:
            raise SceneError("both a map and a cloud are given; expected one of them: the map has points of its own")
        if spacing is not None and not (np.isfinite(spacing) and spacing > 0):
            raise SceneError(f"spacing is {spacing}; expected a positive length, or None")
        self.settings = settings or FitSettings()
        self._base = None if start is None else as_scene(start).cloud
        self._origin: NDArray[np.float64] | None = None
        self._space = FeatureSpace(feature_space, 0)
        self._spacing = spacing
        self._points: VoxelPoints | None = None
        self._presence = Presence(0, 0.0, MOST_ODDS)
        self._lost: dict[int, list[int]] = {}
        self._named_at: dict[int, float] = {}
        self._tracks, self._votes, self._kept = Tracks(), PointVotes(), KeptViews()
        self._left: dict[int, _Left] = {}
        self._anchors: list[tuple[float, NDArray[np.float64]]] = []  # stamp and pose of each frame that brought points
        self._born = np.zeros(0, np.int32)
        self._sequence, self._stamp = 0, -1.0
        self._recent: deque[float] = deque(maxlen=RECENT_FRAMES)
        self._labelled: tuple[int, LabelledScene] | None = None
        self._changes: Changes | None = None
        self._around: tuple[int, Neighbourhood] | None = None
        if self._base is not None:
            self._go_on(self._base)
        elif cloud is not None:
            points = cloud if isinstance(cloud, Points) else Points.from_world(np.asarray(cloud, np.float64))
            self._know(points.xyz, points.rgb, points.origin, grows=False)
        self._journal = None if journal is None else MapJournal(journal, self._began_with)
        self._resume()

    @property
    def _began_with(self) -> str:
        if self._points is None:
            return "no point"
        return f"{self._points.n} points (checksum {zlib.crc32(np.ascontiguousarray(self._points.xyz).tobytes())})"

    def _resume(self) -> None:
        """Take up what the journal holds."""
        if self._journal is None:
            return
        if (stored := self._journal.state()) is not None:
            self._restore(*stored)
        journal, self._journal = self._journal, None
        for frame in journal.frames():
            if frame.stamp not in self._recent:
                self.integrate(frame)
        self._journal = journal

    def _go_on(self, base: LabelledCloud) -> None:
        """Take a map's points and instances as they are."""
        self._know(base.xyz, base.rgb, base.origin, grows=True, spacing=base.spacing)
        self._space = base.space
        record, table = MapRecord.of(base), base.instances
        self._stamp = record.visits[-1].stamp
        for k in range(len(table)):
            rows = table.descriptors[table.descriptor_instance == k].astype(np.float64)
            pixels = float(max(USUAL_SHARE * table.points[k] * table.masks[k], 1e-6))
            total = rows.sum(axis=0) * pixels if len(rows) else None
            seen = record.last_seen.get(k, 0.0)
            counts = int(table.views[k]), int(table.masks[k])
            self._tracks.tracks.append(Track(total, pixels, float(table.agreement[k]) * pixels, *counts, seen, k))
        self._tracks.root = np.arange(len(table), dtype=np.int32)
        self._tracks.next_id = len(table)
        for k, entry in record.gone.items():
            color = None if entry.color is None else np.array(entry.color)
            rows = table.descriptors[table.descriptor_instance == k]
            look = Look(rows, float(spread_of(table.agreement[k], table.masks[k])), color, entry.length)
            self._left[k] = _Left(look, np.array(entry.place), np.full(3, entry.length))
        labelled = np.flatnonzero(base.instance_ids >= 0).astype(np.int32)
        votes = np.full(len(labelled), KNOWN_VOTES, np.float32)
        self._votes.add(labelled, base.instance_ids[labelled], votes)

    def _know(
        self, xyz: NDArray[np.float32], rgb: NDArray[np.uint8] | None, origin: NDArray[np.float64], *, grows: bool,
        spacing: float | None = None,
    ) -> None:  # fmt: skip
        require_finite(xyz)
        self._origin = origin
        around = neighbourhood(xyz, self.settings.geometry)
        self._spacing = float(np.median(around.spacing)) if spacing is None else spacing
        self._points = VoxelPoints(self._spacing, grows)
        self._points.add_known(xyz, rgb)
        self._around = len(xyz), around
        scatter = DiscSurface(xyz, around).scatter if len(xyz) > 1 else 0.0
        self._presence.tolerance = max(TOLERANCE * self._spacing, SCATTER * scatter)
        self._grow()

    @property
    def last_stamp(self) -> float:
        """The latest stamp of all frames so far."""
        return self._stamp

    @property
    def points(self) -> int:
        """How many points the map has."""
        return 0 if self._points is None else int(np.count_nonzero(self._points.alive))

    @property
    def nbytes(self) -> int:
        """Bytes of what is kept of the frames; points and votes take about 150 bytes a point beside."""
        return self._kept.nbytes

    def integrate(self, frame: Frame) -> FrameChange:
        """Take a frame in. SceneError or FeatureSpaceError, with the cause and the cure, leave the map as it was.

        Frames may come in any order; masks of a frame that has no depth, or comes late, are placed by the map's points.
        """
        start = time.perf_counter()
        origin = self._origin
        if origin is None:
            origin = np.zeros(3) if frame.camera is None else frame.camera.center
        given = checked(frame, origin, self._space, self._stamp + 1)
        view = None if given.depth is None or not given.depth.any() else view_of_depth(given.depth, given.camera)
        if self._points is None and view is None:
            raise SceneError(
                f"frame {given.stamp:g} has no depth, and the map has no points yet; expected depth or a cloud: start "
                "with Mapper(cloud=points), or with a map, where frames have masks alone"
            )
        points = self._points
        rows = np.zeros(0, np.int32)
        if points is not None and points.n:
            rows = _in_view(points.xyz, points.alive, given.camera.world_to_camera, lens_of(given.camera), 0.0,
                            given.camera.width, given.camera.height)  # fmt: skip
            if view is not None:
                require_same_place(given, points.xyz[rows], self._tolerance, view)
        # From here on the map changes, and nothing is refused any more.
        self._begin(given, view, origin)
        died = self._judge(rows, given, view) if view is not None else np.zeros(0, np.int32)
        self._add_points(given, view)
        new, again = self._vote(given, view)
        gone = self._leave(died)
        new_ids, moved = self._name(new, gone)
        self._sequence += 1
        updated = tuple(sorted(self._tracks.tracks[k].id for k in again))
        self._recent.append(given.stamp)
        if self._journal is not None and self._journal.append(replace(frame, stamp=given.stamp)):
            self._journal.write(*self._state())
        return FrameChange(new_ids, updated, tuple(sorted(gone)), moved, time.perf_counter() - start)

    def objects(self) -> list[MapObject]:
        """What is known now, by id: objects that two frames or more have shown, and those that left."""
        if self._points is None:
            return []
        best = self._best_of_all()
        found = []
        for id_, k in sorted(self._tracks.by_id().items()):
            track, rows = self._tracks.tracks[k], np.flatnonzero(best == k)
            if id_ in self._left:
                place, size, state = self._left[id_].place, self._left[id_].size, "gone"
            elif len(rows):
                xyz = self._points.xyz[rows].astype(np.float64)
                place, size, state = xyz.mean(axis=0) + self._origin, np.ptp(xyz, axis=0), "present"
            else:
                continue
            found.append(MapObject(id_, state, place, size, len(rows), track.views, track.last_seen, track.descriptor))
        return found

    def snapshot(self) -> LabelledScene:
        """The map as a scene like any other, by the batch rule over what was kept; made once while nothing changes.

        Of a map that was gone on with: with this visit folded in, as `og.update` does. SceneError while it has no mask.
        """
        if self._labelled is None or self._labelled[0] != self._sequence:
            self._labelled = self._sequence, LabelledScene.from_cloud(self._label())
        return self._labelled[1]

    finish = snapshot

    @property
    def changes(self) -> Changes | None:
        """What the latest snapshot found changed since the map that was gone on with; None where there was none."""
        return self._changes

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the snapshot as .ogpc, whole or not at all."""
        from importlib import import_module

        return import_module("og_pointcloud_export").write_bundle(self.snapshot().cloud, path)

    def correct(self, poses: Mapping[float, ArrayLike]) -> None:
        """After a loop closure: stamp -> corrected world_to_camera (4, 4) of that frame, from world coordinates.

        Points move with the frame that brought them, kept views with theirs; the points of a known cloud stay.
        SceneError for what is no pose; then nothing moves.
        """
        corrected = {}
        for stamp, pose in poses.items():
            given = Frame(Camera(1, 1, 1.0, 1.0, 0.5, 0.5, np.asarray(pose, np.float64)), stamp=stamp)
            corrected[float(stamp)] = checked(given, self._origin_or_zero, self._space, 0.0).camera.world_to_camera
        if self._points is None:
            return
        for index, (stamp, old) in enumerate(self._anchors):
            if stamp in corrected:
                rows = np.flatnonzero(self._points.anchor == index)
                motion = np.linalg.inv(corrected[stamp]) @ old
                self._points.xyz[rows] = self._points.xyz[rows] @ motion[:3, :3].T + motion[:3, 3]
                self._anchors[index] = stamp, corrected[stamp]
        for index, view in enumerate(self._kept.views):
            if view.stamp in corrected:
                camera = replace(view.camera, world_to_camera=corrected[view.stamp])
                self._kept.views[index] = replace(view, camera=camera)
        self._points.rehash()
        self._sequence += 1
        self._around = None

    def _state(self) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Everything, as arrays and plain values (`map_state`)."""
        points = self._points
        assert points is not None
        arrays, values = map_state.tracks_state(self._tracks)
        arrays |= map_state.kept_arrays(self._kept)
        arrays |= map_state.columns("points", points, POINT_COLUMNS)
        arrays |= map_state.columns("votes", self._votes, VOTE_COLUMNS)
        arrays |= map_state.columns("presence", self._presence, PRESENCE_COLUMNS)
        arrays |= {"born": self._born, "recent": np.array(self._recent), "origin": self._origin_or_zero}
        arrays["anchors"] = np.array([(stamp, *pose.ravel()) for stamp, pose in self._anchors]).reshape(-1, 17)
        for k, left in self._left.items():
            arrays[f"left.{k}"] = left.look.descriptors
        plain = {
            k: (left.look.spread, None if left.look.color is None else left.look.color.tolist(), left.look.length,
                left.place.tolist(), left.size.tolist()) for k, left in self._left.items()
        }  # fmt: skip
        values |= {
            "named_at": self._named_at,
            "left": plain,
            "lost": self._lost,
            "n": points.n,
            "spacing": self._spacing,
            "grows": points.grows,
        }
        values |= {
            "tolerance": self._tolerance,
            "sequence": self._sequence,
            "stamp": self._stamp,
            "space": (self._space.name, self._space.width),
        }
        return arrays, values

    def _restore(self, arrays: dict[str, NDArray[Any]], values: dict[str, Any]) -> None:
        """Become what `_state` was."""
        self._spacing, self._sequence, self._stamp = values["spacing"], values["sequence"], values["stamp"]
        self._space = FeatureSpace(*values["space"])
        self._points = VoxelPoints(values["spacing"], values["grows"])
        self._points.n = values["n"]
        map_state.set_columns("points", self._points, POINT_COLUMNS, arrays)
        map_state.set_columns("votes", self._votes, VOTE_COLUMNS, arrays)
        map_state.set_columns("presence", self._presence, PRESENCE_COLUMNS, arrays)
        self._presence.tolerance = values["tolerance"]
        self._tracks = map_state.tracks_from(arrays, values)
        self._kept = map_state.kept_from(arrays, self._space.width)
        self._born, self._origin = arrays["born"].copy(), arrays["origin"].copy()
        self._recent.extend(arrays["recent"].tolist())
        self._anchors = [(float(row[0]), row[1:].reshape(4, 4).copy()) for row in arrays["anchors"]]
        self._lost = {int(k): rows for k, rows in values["lost"].items()}
        self._named_at = {int(k): stamp for k, stamp in values["named_at"].items()}
        for k, (spread, color, length, place, size) in values["left"].items():
            look = Look(arrays[f"left.{k}"], spread, None if color is None else np.array(color), length)
            self._left[int(k)] = _Left(look, np.array(place), np.array(size))

    @property
    def _origin_or_zero(self) -> NDArray[np.float64]:
        return np.zeros(3) if self._origin is None else self._origin

    @property
    def _tolerance(self) -> float:
        return self._presence.tolerance

    def _grow(self) -> None:
        """Room for what is known of each point."""
        n = 0 if self._points is None else self._points.n
        self._votes.grow(n)
        self._presence.grow(n)
        if n > len(self._born):
            self._born = np.concatenate([self._born, np.zeros(n - len(self._born) + n // 2, np.int32)])

    def _begin(self, frame: CheckedFrame, view: MeasuredView | None, origin: NDArray[np.float64]) -> None:
        """What the first frame settles: the origin, the spacing, the width of features."""
        self._origin = origin
        self._stamp = max(self._stamp, frame.stamp)
        if self._points is None and view is not None:
            if self._spacing is None:
                depth = view.depth[view.depth > 0]
                focal = np.sqrt(view.camera.fx * view.camera.fy)
                self._spacing = float(PIXELS_PER_SPACING * np.median(depth) / focal)
            self._points = VoxelPoints(self._spacing, grows=True)
            self._presence.tolerance = TOLERANCE * self._spacing
        if len(frame.features) and self._space.width == 0:
            self._space = FeatureSpace(self._space.name, frame.features.shape[1])

    def _judge(self, rows: NDArray[np.int32], frame: CheckedFrame, view: MeasuredView) -> NDArray[np.int32]:
        """Presence of the points in view; returns those that left by it. Notes which are measured."""
        points, presence = self._points, self._presence
        assert points is not None
        xyz = points.xyz[rows]
        states = states_of_points(xyz, self._tolerance, view)
        presence.take(rows, xyz, states, frame.camera.center, frame.stamp)
        self._measured = rows[states == AGREES]
        died = rows[(presence.odds[rows] < -1) & (presence.refuted[rows] > 1)]
        return died

    def _add_points(self, frame: CheckedFrame, view: MeasuredView | None) -> None:
        """The readings of a frame, as dense as the map, but for those at a slant: edges of depth images fly."""
        points = self._points
        assert points is not None
        before = points.n
        self._added = np.zeros(0, np.int32)
        if view is None or not points.grows:
            return
        camera = view.camera
        typical = float(np.median(view.depth[view.depth > 0]))
        step = max(1, int(self._spacing * np.sqrt(camera.fx * camera.fy) / typical / READINGS_PER_SPACING))
        pose, lens = camera.world_to_camera, lens_of(camera)
        xyz, pixel = _readings(view.depth, view.normal, pose, lens, step, step // 2, SLANT)
        rgb = np.full((len(xyz), 3), 128, np.uint8)
        if frame.rgb is not None:
            scale = frame.rgb.shape[0] / camera.height, frame.rgb.shape[1] / camera.width
            row, column = pixel // camera.width, pixel % camera.width
            rgb = frame.rgb[(row * scale[0]).astype(np.intp), (column * scale[1]).astype(np.intp)]
        points.add(xyz, rgb, len(self._anchors))
        if points.n > before:
            self._anchors.append((frame.stamp, frame.camera.world_to_camera))
            self._grow()
            self._added = np.arange(before, points.n, dtype=np.int32)
            self._presence.odds[self._added], self._presence.seen_at[self._added] = 1, frame.stamp
            self._born[self._added] = self._sequence

    def _vote(self, frame: CheckedFrame, view: MeasuredView | None) -> tuple[list[int], list[int]]:
        """The frame's masks: votes of points and witnesses of tracks now, rows of the mask table for later."""
        points = self._points
        assert points is not None
        if len(frame.features) == 0:
            return [], []
        if view is None:
            rows, found, uv_px = self._open_points(frame)
        else:
            rows = np.concatenate([self._measured, self._added])
            uv_px, _ = frame.camera.project(points.xyz[rows])
            inside = frame.camera.shows(uv_px)
            rows, uv_px = rows[inside], uv_px[inside]
            u, v = np.ascontiguousarray(uv_px.T, np.float32)
            found = sightings_of(np.ones(len(rows), np.float32), u, v, frame.ids, len(frame.features))
        seen = found.openness.indices
        away = np.linalg.norm(points.xyz[rows[seen]] - frame.camera.center, axis=1)
        typical = float(np.median(away)) if len(away) else 0.0
        moment = Moment(frame.camera, frame.stamp, self._sequence, typical)
        self._kept.offer(moment, found, rows, points.n, frame.ids, frame.features)
        column, row = np.minimum(uv_px[seen].astype(np.intp), (frame.camera.width - 1, frame.camera.height - 1)).T
        mask = frame.ids[row, column]
        new, again = self._tracks.observe(
            self._votes, rows[seen], mask, found.openness.data.astype(np.float32), frame.features, frame.stamp
        )
        self._presence.seen_at[rows[seen]] = np.maximum(self._presence.seen_at[rows[seen]], frame.stamp)
        if self._sequence % PRUNED_EVERY == PRUNED_EVERY - 1:
            self._tracks.prune(self._votes, frame.stamp)
        return new, again

    def _open_points(self, frame: CheckedFrame) -> tuple[NDArray[np.int32], Sightings, NDArray[np.float64]]:
        """(rows, what is seen of them, where): points that a frame without depth sees, by the map's own surface."""
        points = self._points
        assert points is not None
        rows = _in_view(points.xyz, points.alive, frame.camera.world_to_camera, lens_of(frame.camera), MARGIN,
                        frame.camera.width, frame.camera.height)  # fmt: skip
        xyz, geometry = points.xyz[rows], self.settings.geometry
        if self._around is not None and self._around[0] == points.n:
            spacing = self._around[1].spacing[rows]
        else:
            spacing = np.full(len(rows), self._spacing, np.float32)
        drawn = isotropic(Points(xyz, np.zeros(3)), spacing, geometry.start_scale, geometry.opacity)
        depth = xyz @ frame.camera.world_to_camera[2, :3] + frame.camera.world_to_camera[2, 3]
        near = NEAR_SHARE * float(np.median(depth)) if len(depth) else 1e-6
        thickness = sight_thickness(spacing, float(self._spacing or 1.0), geometry)
        open_, u, v = openness(drawn, frame.camera, near, thickness)
        return (
            rows,
            sightings_of(open_, u, v, frame.ids, len(frame.features)),
            np.stack([u, v], axis=1).astype(np.float64),
        )

    def _best_of_all(self) -> NDArray[np.int32]:
        """(n,) the track of each point, NO_TRACK for those that left."""
        assert self._points is not None
        everyone = np.arange(self._points.n, dtype=np.int32)
        return np.where(self._points.alive, self._votes.best(everyone, self._tracks.root), NO_TRACK)

    def _leave(self, died: NDArray[np.int32]) -> list[int]:
        """Remove points that were seen through; returns the ids of objects that left with most of theirs."""
        points = self._points
        assert points is not None
        if len(died) == 0:
            return []
        owner = self._votes.best(died, self._tracks.root)
        points.remove(died)
        gone = []
        for k in np.unique(owner[owner >= 0]).tolist():
            lost = self._lost.setdefault(k, [])
            lost.extend(died[owner == k].tolist())
            if self._tracks.tracks[k].id >= 0 and len(lost) >= FEWEST_POINTS and self._has_left(k, lost):
                gone.append(self._tracks.tracks[k].id)
        self._forget(died)
        return gone

    def _has_left(self, k: int, lost: list[int]) -> bool:
        """Whether most of a track's visible points left; then the others, which nobody sees, leave too."""
        points = self._points
        assert points is not None
        rows = np.flatnonzero(self._best_of_all() == k).astype(np.int32)
        still = rows[self._presence.odds[rows] > 0]
        if len(lost) <= MOST * (len(lost) + len(still)):
            return False
        every = np.concatenate([np.array(lost, np.int32), rows])
        track = self._tracks.tracks[k]
        xyz = points.xyz[every].astype(np.float64)
        place = xyz.mean(axis=0) + self._origin_or_zero
        self._left[track.id] = _Left(self._look(k, every), place, np.ptp(xyz, axis=0))
        points.remove(np.setdiff1d(rows, still))
        self._forget(rows)
        del self._lost[k]
        return True

    def _forget(self, rows: NDArray[np.int32]) -> None:
        self._votes.clear(rows)
        self._presence.reset(rows)
        self._born[rows] = self._sequence

    def _look(self, k: int, rows: NDArray[np.integer]) -> Look:
        """How a track looks, by some of its points."""
        assert self._points is not None
        track = self._tracks.tracks[k]
        descriptor = track.descriptor
        return Look.of_points(
            np.zeros((0, 1), np.float32) if descriptor is None else descriptor[None].astype(np.float32),
            float(spread_of(track.agreement / max(track.pixels, 1e-12), track.masks)),
            self._points.xyz[rows],
            self._points.rgb[rows],
        )

    def _name(self, new: list[int], gone: list[int]) -> tuple[tuple[int, ...], tuple[Moved, ...]]:
        """Ids for tracks that are objects now: of something that left, if it looks so, else the next one. And what left
        just now may be an object already that was named since it was last seen where it stood."""
        if not new and not gone:
            return (), ()
        best = self._best_of_all() if self._left else None
        ids, moved = [], []
        owners = self._tracks.by_id()
        since = min((self._tracks.tracks[owners[k]].last_seen for k in gone if k in owners), default=np.inf)
        named = [k for k in owners.values() if self._named_at.get(self._tracks.tracks[k].id, -np.inf) >= since]
        for k in (*new, *named):
            track = self._tracks.tracks[k]
            if self._tracks.root[k] != k or track.id in self._left or (k in new and track.id >= 0):
                continue
            rows = np.zeros(0, np.int64) if best is None else np.flatnonzero(best == k)
            old = self._recognised(self._look(k, rows)) if len(rows) >= FEWEST_POINTS else None
            if old is not None:
                moved.append(self._returned(old, k, rows))
            elif k in new:
                ids.append(self._tracks.named(k))
                self._named_at[ids[-1]] = self._stamp
        return tuple(ids), tuple(moved)

    def _returned(self, old: int, k: int, rows: NDArray[np.int64]) -> Moved:
        """Give a track the id of what left."""
        assert self._points is not None
        left = self._left.pop(old)
        if (before := self._tracks.by_id().get(old)) is not None:
            self._tracks.tracks[before].id = NO_TRACK
        self._tracks.tracks[k].id = old
        place = self._points.xyz[rows].astype(np.float64).mean(axis=0) + self._origin_or_zero
        return Moved(old, left.place, place, old)

    def _recognised(self, look: Look) -> int | None:
        """The id of what left and looks so, if anything does."""
        rows = [t.descriptor for t in self._tracks.tracks if t.id >= 0 and t.descriptor is not None]
        cosines = np.array(rows) @ np.array(rows).T if len(rows) > 1 else np.zeros((1, 1))
        typical = float(np.median(cosines[np.triu_indices(len(cosines), 1)])) if len(rows) > 1 else 0.0
        alike = {old: likeness(left.look, look, typical) for old, left in self._left.items()}
        best = max(alike, key=lambda old: (alike[old], -old), default=None)
        return best if best is not None and alike[best] > ALIKE else None

    def _label(self) -> LabelledCloud:
        """The points that are there, labelled by the batch rule, with the ids that objects have."""
        points = self._points
        if points is None or not self._kept.views:
            raise SceneError("no frame with masks has shown any point of the map yet: integrate some first")
        chosen = points.alive.copy()
        if self._base is not None:
            chosen &= self._presence.seen_at[: points.n] > -np.inf
        rows = np.flatnonzero(chosen)
        place = np.full(points.n, -1, np.int32)
        place[rows] = np.arange(len(rows), dtype=np.int32)
        xyz = points.xyz[rows]
        around = self._neighbourhood(rows, xyz)
        cameras = [view.camera for view in self._kept.views]
        table = self._kept.table(place, self._born, len(rows))
        found = label(xyz, around, table, cameras, self.settings)
        ids, certainty = found.instance_ids, found.certainty
        visit = LabelledCloud(
            xyz=xyz,
            origin=self._origin_or_zero,
            instance_ids=ids,
            instances=found.instances,
            feature_space=self._space.name,
            spacing=float(np.median(around.spacing)),
            reach=self.settings.geometry.reach * float(np.median(around.spacing)),
            rgb=points.rgb[rows].astype(np.uint8),
            certainty=None if certainty is None else np.rint(255 * certainty).astype(np.uint8),
            cameras=tuple(cameras),
        )
        online = self._best_of_all()[rows]
        known = np.append(np.array([t.id for t in self._tracks.tracks], np.int32), np.int32(-1))[online]
        if self._base is not None:
            return self._folded(visit, rows, known)
        wanted, count = matched_ids(ids, len(found.instances), known, self._tracks.next_id)
        self._tracks.next_id = count
        return with_ids(visit, wanted, count)

    def _neighbourhood(self, rows: NDArray[np.int64], xyz: NDArray[np.float32]) -> Neighbourhood:
        if self._around is not None and len(rows) == self._around[0]:
            return self._around[1]
        return neighbourhood(xyz, self.settings.geometry)

    def _folded(self, visit: LabelledCloud, rows: NDArray[np.int64], known: NDArray[np.int32]) -> LabelledCloud:
        """The map that was gone on with, and this visit."""
        assert self._base is not None
        assert self._points is not None
        n = len(self._base)
        alive, odds = self._points.alive[:n], self._presence.odds[:n]
        earlier = Visit(self._base)
        later = Visit(visit)
        found = compare_visits(earlier, later, (alive & (odds > 0), ~alive | self._presence.absent[:n]))
        updated = merge(earlier, later, found, "frames", self._stamp)
        self._changes = updated.changes
        return updated.cloud


@njit(cache=True, parallel=True, nogil=True)
def _inside(xyz, alive, pose, lens, margin, width, height):  # noqa: ANN001, ANN202
    fx, fy, cx, cy = lens
    inside = np.zeros(len(xyz), np.bool_)
    for i in prange(len(xyz)):
        if alive[i]:
            x, y, z = xyz[i, 0], xyz[i, 1], xyz[i, 2]
            depth = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
            if depth > 0:
                u = fx * (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]) / depth + cx
                v = fy * (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]) / depth + cy
                across, down = margin * width, margin * height
                inside[i] = -across <= u < width + across and -down <= v < height + down
    return inside


def _in_view(
    xyz: NDArray[np.float32], alive: NDArray[np.bool_], pose: NDArray[np.float64], lens: NDArray[np.float64],
    margin: float, width: int, height: int,
) -> NDArray[np.int32]:  # fmt: skip
    """Rows of the points that are there and fall into an image, or within a share ``margin`` of it."""
    return np.flatnonzero(_inside(xyz, alive, pose, lens, margin, width, height)).astype(np.int32)


@njit(cache=True, nogil=True)
def _readings(depth, normal, pose, lens, step, first, slant):  # noqa: ANN001, ANN202
    """(xyz (m, 3), flat pixel (m,)) of every step-th reading that is not at a slant."""
    fx, fy, cx, cy = lens
    height, width = depth.shape
    xyz = np.empty((depth.size // (step * step) + height + width + 1, 3), np.float32)
    pixel = np.empty(len(xyz), np.int64)
    count = 0
    for row in range(first, height, step):
        for column in range(first, width, step):
            z = depth[row, column]
            if z <= 0:
                continue
            dx, dy = (column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy
            n = normal[row, column]
            if -(n[0] * dx + n[1] * dy + n[2]) < slant * np.sqrt(dx * dx + dy * dy + 1):
                continue
            x, y, w = z * dx - pose[0, 3], z * dy - pose[1, 3], z - pose[2, 3]
            for a in range(3):
                xyz[count, a] = pose[0, a] * x + pose[1, a] * y + pose[2, a] * w
            pixel[count] = row * width + column
            count += 1
    return xyz[:count], pixel[:count]
