"""What a frame shows of the points of a map, and in which of its masks: by its depth, or by the map's own surface."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.mapping.frame import CheckedFrame
from og_pointcloud.mapping.growing_map import GrowingMap
from og_pointcloud.mapping.kept_views import KeptView
from og_pointcloud.rendering.geometry import isotropic
from og_pointcloud.rendering.sightings import Sightings, openness, sightings_of
from og_pointcloud.rendering.splatting import NEAR_SHARE
from og_pointcloud.rendering.surface import sight_thickness
from og_pointcloud.scene import Points
from og_pointcloud.settings import GeometrySettings

MARGIN = 0.1
"""Share of an image beyond its border from which points are drawn, as they may hide others within."""


@dataclass(frozen=True)
class Seen:
    """rows: (m,) int32 of the points that were looked for. found: what is seen of these. mask: that of the pixel of
    each seen one, -1 none."""

    rows: NDArray[np.int32]
    found: Sightings
    mask: NDArray[np.int32]

    @property
    def points(self) -> NDArray[np.int32]:
        """(s,) rows of those that are seen."""
        return self.rows[self.found.openness.indices]


def measured_points(frame: CheckedFrame, known: GrowingMap, rows: NDArray[np.int32]) -> Seen:
    """Of points that the depth of a frame measures, those in its image."""
    uv_px, _ = frame.camera.project(known.points.xyz[rows])
    inside = frame.camera.shows(uv_px)
    return _seen(frame, rows[inside], np.ones(np.count_nonzero(inside), np.float32), uv_px[inside])


def drawn_points(frame: CheckedFrame, known: GrowingMap, geometry: GeometrySettings) -> Seen:
    """The points that a frame without depth sees, by the map's own surface."""
    camera, rows = frame.camera, np.sort(known.about(frame.camera, MARGIN))
    xyz, spacing = known.points.xyz[rows], known.spacing_of(rows)
    drawn = isotropic(Points(xyz, np.zeros(3)), spacing, known.scale or geometry.middle_scale, geometry.opacity)
    depth = xyz @ camera.world_to_camera[2, :3] + camera.world_to_camera[2, 3]
    near = NEAR_SHARE * float(np.median(depth)) if len(depth) else 1e-6
    open_, u, v = openness(drawn, camera, near, sight_thickness(spacing, known.points.edge, geometry))
    return _seen(frame, rows, open_, np.stack([u, v], axis=1))


def seen_again(view: KeptView, known: GrowingMap, geometry: GeometrySettings) -> KeptView:
    """A kept view without depth, as points of the map's scale show it."""
    frame = CheckedFrame(view.camera, view.masks, view.features, None, None, view.stamp)
    seen = drawn_points(frame, known, geometry)
    return KeptView.of(frame, view.sequence, seen.found, seen.rows)


def _seen(
    frame: CheckedFrame, rows: NDArray[np.int32], open_: NDArray[np.float32], uv_px: NDArray[np.floating]
) -> Seen:
    u, v = np.ascontiguousarray(uv_px.T, np.float32)
    found = sightings_of(open_, u, v, frame.ids, len(frame.features))
    last = frame.camera.width - 1, frame.camera.height - 1
    column, row = np.minimum(uv_px[found.openness.indices].astype(np.intp), last).T
    return Seen(rows, found, frame.ids[row, column])


def vote(frame: CheckedFrame, known: GrowingMap, seen: Seen) -> tuple[list[int], list[int]]:
    """The frame's masks: votes of points and witnesses of tracks now, rows of the mask table for later.

    Returns the tracks that are objects now and want an id, and those with one that were seen again.
    """
    known.space = replace(known.space, width=frame.features.shape[1])
    points, seen_at = seen.points, known.presence.seen_at
    away = np.linalg.norm(known.points.xyz[points] - frame.camera.center, axis=1)
    view = KeptView.of(frame, known.sequence, seen.found, seen.rows)
    known.kept.offer(view, float(np.median(away)) if len(away) else 0.0)
    seen_at[points] = np.maximum(seen_at[points], frame.stamp)
    weight = seen.found.openness.data.astype(np.float32)
    when = frame.stamp, known.sequence
    return known.tracks.observe(known.votes, known.points.xyz, points, seen.mask, weight, frame.features, when)
