"""A map that grows with every frame, and knows what came, went and moved.

A frame is checked, then compared with the map: which points it measures again, which it sees through, which it cannot
see. Its depth adds points; its masks vote (`tracks`); what it shows is kept as rows of the mask table (`kept_views`),
and the frame itself is dropped. Points seen through from two places are removed, and an object leaves with most of its
visible points. All of this touches only what the frame sees. `snapshot` then labels every point by the batch rule from
the kept rows.
"""

from __future__ import annotations

import os
import time
import warnings
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from og_pointcloud.ask.hosts import world_points
from og_pointcloud.ask.labelled_scene import LabelledScene, SceneLike, as_scene
from og_pointcloud.bundle.vocabulary import carrier_of_encoder
from og_pointcloud.cloud import UNKNOWN_SPACE, FeatureSpace, LabelledCloud
from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.formats.points import read_points
from og_pointcloud.mapping.changes import Changes, Moved, compare_visits
from og_pointcloud.mapping.frame import COMPARED_POINTS, CheckedFrame, Frame, checked, require_same_place
from og_pointcloud.mapping.growing_map import GrowingMap, drawn_points, measured_points, vote
from og_pointcloud.mapping.labelling import draw_again, labelled, matched_ids, with_ids
from og_pointcloud.mapping.map_journal import MapJournal
from og_pointcloud.mapping.map_objects import MapObject, assign_ids, objects_of, remove_points
from og_pointcloud.mapping.map_record import MapRecord
from og_pointcloud.mapping.merging import merge
from og_pointcloud.mapping.presence import Visit
from og_pointcloud.mapping.sight import DiscSurface
from og_pointcloud.mapping.tracks import Track
from og_pointcloud.mapping.voxels import MAX_VOXEL_INDEX
from og_pointcloud.rendering.geometry import Neighborhood, neighborhood
from og_pointcloud.scene import Camera, Points, require_finite, rounded_pose
from og_pointcloud.settings import FitSettings, fit_settings

PIXELS_PER_SPACING = 4.0
"""The spacing of a map that starts empty, in pixels of the first depth image at its median depth."""
PRUNE_EVERY_FRAMES = 64
"""Tracks that never became objects are dropped after each this many frames."""
TYPICAL_SHOWN_SHARE = 0.3
"""Share of an object's points that a frame typically shows, assumed for an earlier map, which does not record it."""
PRIOR_VOTES = 8.0
"""Votes of a point of an earlier map for its instance; frames can outvote them."""


@dataclass(frozen=True)
class FrameChange:
    """Changes by a frame, as object ids. new: objects that enough frames have now shown. updated: objects seen again.
    gone: objects whose visible points were mostly seen through. moved: where they were and are. seconds: time taken."""

    new: tuple[int, ...] = ()
    updated: tuple[int, ...] = ()
    gone: tuple[int, ...] = ()
    moved: tuple[Moved, ...] = ()
    seconds: float = 0.0


class Mapper:
    """A map that grows: `integrate` takes a frame, `objects` lists what is known, `snapshot` is a scene that can be
    asked, `save` writes it.

    start: a map (.ogpc, scene or cloud) to continue; None: an empty one, which grows by depth. cloud: known geometry,
    so that frames need only bring masks: (N, 3) world coordinates, `Points`, or whatever `og.segment` takes; rows with
    NaN or infinity are left out with a warning.
    spacing: of a map that starts empty, in world units; None: from the first depth image. feature_space: name of the
    masks' encoder; by default the map's, or the first that a frame names. journal: a folder that holds the map while it
    grows (`map_journal`), until `close` or the end of a with block; a map that it holds already is continued.

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
        cloud: Any = None,
        spacing: float | None = None,
        feature_space: str = UNKNOWN_SPACE,
        settings: FitSettings | None = None,
        journal: str | os.PathLike[str] | None = None,
    ) -> None:
        if start is not None and cloud is not None:
            raise SceneError("both a map and a cloud are given; expected only one: the map has its own points")
        if spacing is not None and not (isinstance(spacing, Real) and spacing is not True and 0 < spacing < np.inf):
            raise SceneError(f"spacing is {spacing!r}; expected a positive length, or None")
        if spacing is not None and not (start is None and cloud is None):
            raise SceneError(f"spacing is {spacing:g}, but a map or a cloud is given, which has its own: leave it out")
        self.settings = fit_settings(settings)
        self._space, self._spacing = FeatureSpace(feature_space), None if spacing is None else float(spacing)
        scene = None if start is None else as_scene(start)
        self._base, self._base_file = (scene.cloud, scene.path) if scene else (None, None)
        self._map: GrowingMap | None = None
        self._neighborhood: Neighborhood | None = None  # of a known cloud
        self._rows = np.zeros(0, np.int64)  # of its points, in their order
        self._labelled: tuple[int, LabelledScene] | None = None
        self._changes: Changes | None = None
        if self._base is not None:
            self._base.space.require(self._space, "features of the frames, by feature_space,")
            named = self._base.space.name if feature_space == UNKNOWN_SPACE else feature_space
            self._space = replace(self._base.space, name=named)
            self._continue(self._base)
        elif cloud is not None:
            self._start_from(_known_points(cloud), grows=False)
        self._journal = None if journal is None else self._resumed(MapJournal(journal, self._began_with))

    def _start_from(self, points: Points, spacing: float | None = None, *, grows: bool) -> GrowingMap:
        """Start with known points. spacing None: their own."""
        if not len(points):
            raise SceneError("the map has 0 points; expected at least one: leave out start and cloud to begin empty")
        require_finite(points.xyz)
        self._neighborhood = neighborhood(points.xyz, self.settings.geometry)
        spacing = float(np.median(self._neighborhood.spacing)) if spacing is None else spacing
        scatter = DiscSurface(points.xyz, self._neighborhood).scatter if len(points) > 1 else 0.0
        self._map = GrowingMap.empty(points.origin, self._space, spacing, grows=grows, scatter=scatter)
        self._rows = self._map.points.add_known(points.xyz, points.rgb)
        self._map.spacing = self._neighborhood.spacing[np.argsort(self._rows)]
        self._map.grow()
        return self._map

    def _continue(self, base: LabelledCloud) -> None:
        """Adopt a map's points and instances as they are."""
        map_ = self._start_from(Points(base.xyz, base.origin, base.rgb), base.spacing, grows=True)
        record, table = MapRecord.of(base), base.instances
        map_.stamp = record.visits[-1].stamp
        for k in range(len(table)):
            rows = table.descriptors[table.descriptor_instance == k].astype(np.float64)
            pixels = float(max(TYPICAL_SHOWN_SHARE * table.points[k] * table.masks[k], 1e-6))
            # The sum of features that gives the track the descriptor's direction and the table's agreement.
            mean = rows.sum(axis=0)
            length = float(np.linalg.norm(mean))
            total = mean * (float(table.agreement[k]) * pixels / length) if length else None
            seen = record.last_seen.get(k, 0.0)
            counts = int(table.views[k]), int(table.masks[k])
            map_.tracks.add(Track(total, pixels, *counts, seen, id=k))
        map_.tracks.next_id = len(table)
        for k, entry in record.gone.items():
            map_.tracks.tracks[k].left = entry
        of = base.instance_ids >= 0
        rows, ids = self._rows[of], base.instance_ids[of]
        map_.votes.add(rows, ids, np.full(len(rows), PRIOR_VOTES, np.float32), np.zeros(len(table), np.bool_))
        map_.tracks.extend_boxes(map_.points.xyz, rows, ids)

    @property
    def _began_with(self) -> str:
        """What decides how changes are replayed, in words."""
        xyz = np.zeros((0, 3), np.float32) if self._map is None else self._map.points.xyz
        points, settings = xyz.tobytes(), repr(replace(self.settings, memory=None)).encode()
        return (
            f"{len(xyz)} points (checksum {zlib.crc32(points)}), spacing {self._spacing}, {self._space}, and settings "
            f"of checksum {zlib.crc32(settings)}"
        )

    def _resumed(self, journal: MapJournal) -> MapJournal:
        """Restore and continue what a journal holds."""
        self._map = journal.state() or self._map
        self._journal = None  # changes of the journal are not written to it again
        # Not those below the growing map's number: an interrupted frame leaves its number to the next one.
        first = 0 if self._map is None else self._map.sequence
        for number, change in journal.changes():
            if number < first:
                continue
            try:
                if isinstance(change, tuple):
                    assert self._map is not None
                    self._map.tracks.next_id, scale, drawn = change
                    draw_again(self._map, scale, drawn, self.settings.geometry)
                else:
                    self.correct(change) if isinstance(change, dict) else self.integrate(change)
            except OgPointcloudError:
                raise
            except Exception as error:  # it failed the first time, too, and a map in a queue went on then
                warnings.warn(f"change {number} in the journal failed ({type(error).__name__}: {error})", stacklevel=4)
        return journal

    def holds(self, stamp: float) -> bool:
        """Whether a frame of this stamp is in the map; assumed for stamps before the last few thousand frames."""
        map_ = self._map
        return map_ is not None and (stamp in map_.recent or stamp < map_.remembered_since)

    @property
    def points(self) -> int:
        """Number of points of the map."""
        return 0 if self._map is None else int(np.count_nonzero(self._map.points.alive))

    @property
    def nbytes(self) -> int:
        """Bytes kept of the frames; points and votes take about 150 bytes per point on top of that."""
        return 0 if self._map is None else self._map.kept.nbytes

    def integrate(self, frame: Frame) -> FrameChange:
        """Integrate a frame. SceneError or FeatureSpaceError, with cause and remedy, leave the map unchanged.

        Frames may come in any order; masks of a frame without depth, or a late one, are placed by the map's points.
        """
        start = time.perf_counter()
        valid, map_ = self._checked(frame)
        if valid.view is not None:
            nearby = map_.points.xyz[map_.rows_in_view(valid.camera, most=COMPARED_POINTS)]
            require_same_place(valid.stamp, valid.view, nearby, map_.presence.tolerance)
        if self._journal is not None:
            self._journal.append(map_.sequence, replace(frame, stamp=valid.stamp))
        # From here on the map changes, and nothing is refused anymore.
        self._map, map_.stamp = map_, max(map_.stamp, valid.stamp)
        rows, died, new, again = np.zeros(0, np.int32), np.zeros(0, np.int32), [], []
        if valid.view is not None:
            measured, died = map_.judge(valid.view, valid.stamp)
            rows = np.concatenate([measured, map_.add(valid)])
        if len(valid.features):
            drawn = None if valid.view else drawn_points(valid, map_, self.settings.geometry)
            new, again = vote(valid, map_, drawn or measured_points(valid, map_, rows))
        gone = remove_points(map_, died, valid.stamp)
        new_ids, moved = assign_ids(map_, new, again, gone)
        updated = tuple(sorted(map_.tracks.tracks[k].id for k in again))
        if map_.sequence % PRUNE_EVERY_FRAMES == PRUNE_EVERY_FRAMES - 1:
            map_.tracks.prune(map_.votes, valid.stamp)
        map_.count(valid.stamp)
        if self._journal is not None:
            self._journal.compact(map_)
        return FrameChange(new_ids, updated, tuple(gone), moved, time.perf_counter() - start)

    def close(self) -> None:
        """Leave the journal to another mapper or process; this one takes no more frames then."""
        if self._journal is not None:
            self._journal.close()

    def __enter__(self) -> Mapper:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def objects(self) -> list[MapObject]:
        """All objects, by id: those that at least two frames have shown, and those that left."""
        return [] if self._map is None else objects_of(self._map)

    def snapshot(self) -> LabelledScene:
        """The map as a regular scene, labelled by the batch rule from the kept views; cached until the map changes.

        If the mapper continues a map, this is that map with the visit merged in, as by `og.update`. SceneError while it
        has no mask.
        """
        map_ = self._map
        if map_ is None or not map_.kept.views:
            raise SceneError("no frame with masks has shown any point of the map yet; expected at least one")
        if self._labelled is None or self._labelled[0] != map_.sequence:
            self._labelled = map_.sequence, LabelledScene.from_cloud(self._label(map_))
        return self._labelled[1]

    @property
    def changes(self) -> Changes | None:
        """Changes that the latest snapshot found since the map that the mapper continues; None without one."""
        return self._changes

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the snapshot as .ogpc, whole or not at all, with the text encoder that the continued map has."""
        from importlib import import_module

        cloud, carrier = self.snapshot().cloud, carrier_of_encoder(self._base_file)
        return import_module("og_pointcloud_export").write_bundle(cloud, path, text_encoder=carrier)

    def correct(self, poses: Mapping[float, ArrayLike]) -> None:
        """Move the map after a loop closure. poses: stamp -> corrected world_to_camera (4, 4) of that frame, from world
        coordinates.

        Points move with the frame that added them, kept views with theirs, and so do the places of things that left;
        the points of a known cloud stay. SceneError for an invalid pose, if no stamp is a frame's, or if frames of one
        stamp have different poses; then nothing moves. If only some stamps are, a warning names the others, such as
        those of refused frames.
        """
        if not isinstance(poses, Mapping):
            raise SceneError(f"poses are a {type(poses).__name__}; expected a dict, stamp -> world_to_camera (4, 4)")
        if self._map is None:
            raise SceneError("no frame has been integrated yet, so there is nothing to correct: integrate some first")
        cameras = self._map.checked_poses(poses)
        if self._journal is not None:
            self._journal.append(self._map.sequence, {stamp: of.world_to_camera for stamp, of in cameras.items()})
        self._map.correct(cameras)
        self._neighborhood = None
        if self._journal is not None:
            self._journal.compact(self._map)

    def _checked(self, frame: Frame) -> tuple[CheckedFrame, GrowingMap]:
        """The checked frame, and the map that it goes into: an empty one if there is none yet. Warns of a rounded
        pose."""
        map_ = self._map
        if map_ is not None:
            valid = checked(frame, map_.origin, map_.space, map_.stamp + 1)
        else:
            camera = getattr(frame, "camera", None)
            origin = camera.center if isinstance(camera, Camera) else np.zeros(3)  # others are refused
            valid = checked(frame, origin, self._space, 0.0)
            if valid.view is None:
                raise SceneError(
                    f"frame {valid.stamp:.15g} has no depth, and the map has no points yet; expected depth or a cloud: "
                    "if frames only have masks, start with Mapper(cloud=points) or with a map"
                )
            # From the original pixels: a sparse image is read with larger ones, but many frames fill the gaps.
            pixel = valid.view.pixel * valid.view.camera.fx / valid.camera.fx
            spacing = self._spacing or max(PIXELS_PER_SPACING * pixel, valid.view.pixel)
            map_ = GrowingMap.empty(origin, self._space, spacing)
        away, reach = float(np.abs(valid.camera.center).max()), MAX_VOXEL_INDEX * map_.points.edge
        if map_.points.grows and away > reach:  # all that it measures would be in one voxel
            raise SceneError(
                f"frame {valid.stamp:.15g} stands {away:.3g} from where the map began; expected at most {reach:.3g}: "
                "its pose is in another world frame, or begin another map there"
            )
        if frame.camera is not None and (coarse := rounded_pose(frame.camera.world_to_camera, map_.points.edge)):
            warnings.warn(f"frames may be placed wrongly; {coarse}", stacklevel=3)
        return valid, map_

    def _label(self, map_: GrowingMap) -> LabelledCloud:
        """The points that are there, labelled by the batch rule, with the ids of the objects."""
        there, around = map_.points.alive, self._neighborhood
        if self._base is not None:  # this visit consists of what its frames have looked at
            there &= map_.presence.seen_at[: map_.points.n] > -np.inf
        # Points given at the start, in their given order, then those that frames added.
        rows = np.concatenate([self._rows, np.arange(len(self._rows), map_.points.n)])
        rows = rows[there[rows]]
        if around is None or not np.array_equal(rows, self._rows):  # the same number may be other points
            around = neighborhood(map_.points.xyz[rows], self.settings.geometry)
        before = map_.tracks.next_id, map_.scale, map_.drawn
        visit = labelled(map_, rows, around, self.settings)
        id_of_track = np.array([*(track.id for track in map_.tracks.tracks), -1], np.int32)
        known = id_of_track[map_.owners()[rows]]
        wanted, count = matched_ids(visit.instance_ids, len(visit.instances), known, map_.tracks.next_id)
        cloud = with_ids(visit, wanted, count) if self._base is None else self._folded(self._base, visit, map_, wanted)
        chosen = max(map_.tracks.next_id, len(cloud.instances)), map_.scale, map_.drawn
        if self._journal is not None and chosen != before:
            self._journal.append(map_.sequence, chosen)
        map_.tracks.next_id = chosen[0]
        return cloud

    def _folded(
        self, base: LabelledCloud, visit: LabelledCloud, map_: GrowingMap, wanted: NDArray[np.int64]
    ) -> LabelledCloud:
        """The map that the mapper continues, with this visit merged in. wanted: from `matched_ids`."""
        alive, presence = map_.points.alive[self._rows], map_.presence
        again = alive & presence.present[self._rows], ~alive | presence.absent[self._rows]  # measured; seen through
        earlier, later = Visit(base), Visit(visit)
        found = compare_visits(earlier, later, again)
        given = np.where(wanted < map_.tracks.next_id, wanted, -1)  # those of objects; others may not need one
        updated = merge(earlier, later, found, "frames", map_.stamp, (given, map_.tracks.next_id))
        self._changes = updated.changes
        return updated.cloud


def _known_points(cloud: Any) -> Points:
    """A cloud as `Mapper` takes it, without the rows that contain NaN or infinity."""
    if isinstance(cloud, Points):
        return cloud
    if isinstance(cloud, (str, os.PathLike)):
        return read_points(cloud)
    xyz = world_points(cloud)
    placed = np.isfinite(xyz).all(axis=1)
    if not placed.all():
        what = f"{np.count_nonzero(~placed)} of {len(xyz)} points contain NaN or infinity: the map leaves them out"
        warnings.warn(what, stacklevel=3)
    return Points.from_world(xyz[placed])
