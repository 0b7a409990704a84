"""Objects found frame by frame: points vote for tracks, and later frames can overturn the votes.

A track is one thing shown by masks of several frames. A mask is assigned to the track of most of its points, if it also
covers most of what the frame shows of that track; else it starts a new track. So a cup that the first frames took for
part of the table gets a track when frames show it alone, and its points switch to it once its votes outweigh the
table's. A frame with a mask of a track votes for it at the points within the mask and against it at all others, as
views do in `fitting.membership`; a frame that missed the track has no vote.

Each frame is a witness for every two tracks that it has masks of: that they are one thing, if most of both lies in one
mask, else that they are two. Tracks are joined when a majority of their witnesses says one (`fitting.grouping` does the
same for masks, over all views at once; `Mapper.snapshot` runs that rule). A frame touches only the tracks that it sees.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.fitting.association import directions
from og_pointcloud.kernels import njit
from og_pointcloud.mapping.likeness import LikenessScale, Look, spread_of, typical_cosine
from og_pointcloud.mapping.voxels import Columns

NO_TRACK = -1
TRACKS_PER_POINT = 4
"""Number of tracks that a point stores votes for."""
MAX_VOTES = 24.0
"""Maximum votes of a point for one track, so that the present can overturn a long history."""
MIN_VIEWS = 2
"""Frames that must show a track before it is an object with an id."""
MAJORITY = 0.5
"""A mask belongs to a track, or the visible part of a track to a mask, if more than this share of it does."""
MIN_TRACKED_SHARE = 0.25
"""Share of a mask's points that must have a track for the mask to be assigned to one of these."""
MIN_WITNESS_SHARE = 0.3
"""A frame that shows less than this share of what frames usually show of a track is no witness of it."""
JOIN_MAJORITY, MIN_WITNESSES = 0.5, 2
"""Two tracks are joined if more than this share of their witnesses, and at least this many, say that they are one."""
MIN_POINTS = 3.0
"""Points of a track or mask that a frame must show to say anything about it."""


@dataclass
class PointVotes(Columns):
    """The strongest votes of each point. track: (n, 4) int32, NO_TRACK where empty; weight: (n, 4) float32."""

    track: NDArray[np.int32] = field(default_factory=lambda: np.zeros((0, TRACKS_PER_POINT), np.int32))
    weight: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, TRACKS_PER_POINT), np.float32))
    FILL_VALUES: ClassVar[dict[str, float]] = {"track": NO_TRACK}

    def best(self, points: NDArray[np.integer], root: NDArray[np.int32]) -> NDArray[np.int32]:
        """(m,) the track, after joins, with the most votes of each point; NO_TRACK without votes."""
        return _best(points, self.track, self.weight, root)

    def add(
        self, points: NDArray[np.integer], track: NDArray[np.int32], weight: NDArray[np.float32],
        masked: NDArray[np.bool_],
    ) -> None:  # fmt: skip
        """Vote at points (m,) for the track of the mask that each lies in, NO_TRACK for none, and against all other
        tracks with a mask in this frame: masked, (tracks,) bool. A track that the proposer missed gets no vote."""
        _add(points, track, weight, masked, self.track, self.weight)


@dataclass
class Track:
    """total: (D,) sum of its masks' unit features, weighted by the points that each mask shows; pixels: sum of these
    weights. views, masks: number that showed it. first, sequence: numbers of the first and last frame that did, 0 for
    an earlier map; last_seen: their latest stamp. id: of the object, NO_TRACK while provisional. home: (3,)
    where it stood before it first left, world coordinates, None for what never came back. box: (2, 3) lowest and
    highest coordinates of points that voted for it. lost: rows of its points removed as seen through; losing_since:
    stamp of the first of these. left: its look, once most were removed; left_at: the frame that last showed it:
    whatever was elsewhere by then is something else. left_anchor, home_anchor: of the frame that brought most of the
    points that left or home stand for: they move with it; -1 none."""

    total: NDArray[np.float64] | None = None
    pixels: float = 0.0
    views: int = 0
    masks: int = 0
    last_seen: float = -np.inf
    sequence: int = 0
    first: int = 0
    id: int = NO_TRACK
    home: NDArray[np.float64] | None = None
    box: NDArray[np.float64] = field(default_factory=lambda: np.array([[np.inf] * 3, [-np.inf] * 3]))
    lost: list[int] = field(default_factory=list)
    losing_since: float = -np.inf
    left: Look | None = None
    left_at: int = 0
    left_anchor: int = -1
    home_anchor: int = -1

    def extend_box(self, box: NDArray[np.float64]) -> None:
        """Enlarge the box to hold another (2, 3)."""
        self.box = np.stack([np.minimum(self.box[0], box[0]), np.maximum(self.box[1], box[1])])

    def merge(self, other: Track) -> None:
        """Merge another track of the same object into this one. Views and stamps are not added up: frames may have
        shown both."""
        if other.total is not None:
            self.total = other.total if self.total is None else self.total + other.total
        for name in ("pixels", "masks", "lost"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self.first = min(self.first, other.first)
        if self.home is None:
            self.home, self.home_anchor = other.home, other.home_anchor
        self.extend_box(other.box)
        for name in ("views", "last_seen", "sequence"):
            setattr(self, name, max(getattr(self, name), getattr(other, name)))

    @property
    def descriptor(self) -> NDArray[np.float64] | None:
        """(D,) unit vector, None without a feature."""
        length = 0.0 if self.total is None else float(np.linalg.norm(self.total))
        return None if self.total is None or length < 1e-12 else self.total / length

    @property
    def agreement(self) -> float:
        """Mean cosine of its features with their mean."""
        return 0.0 if self.total is None else float(np.linalg.norm(self.total)) / max(self.pixels, 1e-12)


@dataclass
class Tracks:
    """tracks: by number. root: (tracks,) int32, the track that each was joined into. pairs: for two roots, number of
    frames that showed them as one thing, and as two. next_id: of the next object; ids are never given twice."""

    tracks: list[Track] = field(default_factory=list)
    root: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))
    pairs: dict[tuple[int, int], list[int]] = field(default_factory=dict)
    next_id: int = 0

    def add(self, track: Track) -> int:
        """Add a track; returns its number."""
        self.tracks.append(track)
        self.root = np.append(self.root, np.int32(len(self.root)))
        return len(self.root) - 1

    def prune(self, votes: PointVotes, before: float) -> None:
        """Drop tracks that were joined into others, and those without an id that no frame has shown since that stamp,
        and renumber the others: memory grows with the objects, not with the frames."""
        kept = [k for k, t in enumerate(self.tracks) if self.root[k] == k and (t.id >= 0 or t.last_seen >= before)]
        # Old number -> new one. The extra last entry is for NO_TRACK, which indexes it as -1.
        number = np.full(len(self.tracks) + 1, NO_TRACK, np.int32)
        number[kept] = np.arange(len(kept))
        number[:-1] = number[self.root]
        votes.track[:] = number[votes.track]
        votes.weight[votes.track == NO_TRACK] = 0
        kept_set = {*kept}
        self.pairs = {(int(number[a]), int(number[b])): c for (a, b), c in self.pairs.items() if {a, b} <= kept_set}
        self.tracks, self.root = [self.tracks[k] for k in kept], np.arange(len(kept), dtype=np.int32)

    def extend_boxes(self, xyz: NDArray[np.float32], points: NDArray[np.integer], track: NDArray[np.int32]) -> None:
        """Enlarge the boxes of tracks to hold the points (m,), rows of xyz (n, 3), that voted for them: track, (m,)."""
        boxes = _boxes(xyz, points, track, len(self.tracks))
        for k in np.flatnonzero(np.isfinite(boxes[:, 0, 0])):
            self.tracks[self.root[k]].extend_box(boxes[k])

    def spread(self) -> NDArray[np.float64]:
        """(tracks,) spread s of their descriptors (`likeness`)."""
        return spread_of([track.agreement for track in self.tracks], [track.masks for track in self.tracks])

    def likeness_scale(self) -> LikenessScale:
        """Calibration of cosines between objects of this map, from its own objects."""
        known = [k for k, track in enumerate(self.tracks) if track.id >= 0 and track.descriptor is not None]
        rows = np.array([self.tracks[k].descriptor for k in known])
        return LikenessScale(other=typical_cosine(rows, self.spread()[known]) if known else 0.0)

    def by_id(self) -> dict[int, int]:
        """Object id -> number of its track, for tracks that have not been joined into another."""
        return {track.id: k for k, track in enumerate(self.tracks) if track.id >= 0 and self.root[k] == k}

    def observe(
        self, votes: PointVotes, xyz: NDArray[np.float32], points: NDArray[np.int32], mask: NDArray[np.int32],
        weight: NDArray[np.float32], features: NDArray[np.float32], when: tuple[float, int],
    ) -> tuple[list[int], list[int]]:  # fmt: skip
        """Count what a frame shows: points (m,), rows of xyz (n, 3), each with its mask (-1 none) and a weight.
        features: (M, D) of the masks. when: the frame's stamp and sequence.

        Returns the tracks that are now objects and need an id, and those with an id that were seen again.
        """
        # Tracks that the frame shows, NO_TRACK (-1) first if it is among them, and the index of each point's track in
        # them.
        best = votes.best(points, self.root)
        held = np.bincount(best + 1, minlength=len(self.root) + 1) > 0
        seen, place = np.flatnonzero(held) - 1, (np.cumsum(held) - 1)[best + 1]
        # (masks + 1, tracks seen) weight that each mask shows of each of these; the last row is for points in no mask.
        rows = np.where(mask < 0, len(features), mask)
        shown = np.bincount(rows * len(seen) + place, weight, (len(features) + 1) * len(seen))
        shown = np.asarray(shown.reshape(len(features) + 1, len(seen)), np.float64)
        of_tracks, seen = shown[:, seen >= 0], seen[seen >= 0]
        # Assign masks to tracks, vote, then join tracks: each step uses the result of the one before.
        of_mask = self._assign_masks(of_tracks, shown.sum(axis=1), seen)
        of_point = np.append(of_mask, NO_TRACK).astype(np.int32)[mask]
        masked = np.isin(self.root, self.root[of_mask[of_mask >= 0]])
        votes.add(points, of_point, weight, masked)
        self.extend_boxes(xyz, points, of_point)
        self._add_witnesses(of_tracks[:-1], of_tracks.sum(axis=0), seen)
        return self._describe(of_mask, shown.sum(axis=1), features, when)

    def _assign_masks(
        self, of_tracks: NDArray[np.float64], of_masks: NDArray[np.float64], seen: NDArray[np.intp]
    ) -> NDArray[np.int64]:
        """(M,) the track of each mask, a new one if none fits; NO_TRACK for masks that show next to nothing.

        of_tracks: (M + 1, tracks) weight that each mask shows of each track in ``seen``; of_masks: (M + 1,) in total.
        """
        of_mask = np.full(len(of_tracks) - 1, NO_TRACK)
        visible = of_tracks.sum(axis=0)
        for m in np.flatnonzero(of_masks[:-1] >= MIN_POINTS):
            best = int(of_tracks[m].argmax()) if len(seen) else -1
            # Most of the mask's points with a track have this one, most of the visible part of this one lies in the
            # mask, and the mask is not nearly all new points.
            tracked = of_tracks[m].sum()
            fits = (
                best >= 0
                and of_tracks[m, best] > MAJORITY * max(tracked, 1e-9)
                and of_tracks[m, best] > MAJORITY * visible[best]
                and tracked > MIN_TRACKED_SHARE * of_masks[m]
            )
            of_mask[m] = seen[best] if fits else self.add(Track())
        return of_mask

    def _add_witnesses(self, shown: NDArray[np.float64], visible: NDArray[np.float64], seen: NDArray[np.intp]) -> None:
        """Count for every two tracks in masks whether this frame shows them as one, and join those that most frames do.

        shown: (M, tracks) weight that each mask shows of each track in ``seen``. visible: (tracks,) including that in
        no mask.
        """
        # A frame that shows little of a track, such as its foot after the rest has left, is no witness of it.
        usual = np.array([self.tracks[k].pixels / max(self.tracks[k].masks, 1) for k in seen.tolist()])
        enough = visible >= np.maximum(MIN_WITNESS_SHARE * usual, MIN_POINTS)
        holds = enough & (shown.max(axis=0, initial=0) > MAJORITY * visible)
        container = shown.argmax(axis=0) if len(shown) else np.zeros(len(seen), int)
        held = np.flatnonzero(holds)
        for index, a in enumerate(held):
            for b in held[index + 1 :]:
                pair = int(seen[a]), int(seen[b])
                same = container[a] == container[b]
                # Pairs are counted only once a frame has shown them as one: most never are, and need no memory.
                if same or pair in self.pairs:
                    counts = self.pairs.setdefault(pair, [0, 0])
                    counts[0 if same else 1] += 1
                    one, two = counts
                    if same and one >= MIN_WITNESSES and one > JOIN_MAJORITY * (one + two):
                        self._join(*pair)

    def _join(self, a: int, b: int) -> None:
        """Merge two tracks: the one with the lower id stays or, without ids, the one with the lower number."""
        a, b = int(self.root[a]), int(self.root[b])
        if a == b:
            return
        a, b = sorted((a, b), key=lambda k: (self.tracks[k].id < 0, self.tracks[k].id, k))
        self.tracks[a].merge(self.tracks[b])
        self.tracks[b].total = None
        self.root[self.root == b] = a
        self.pairs = {pair: counts for pair, counts in self.pairs.items() if b not in pair}

    def _describe(
        self,
        of_mask: NDArray[np.int64],
        of_masks: NDArray[np.float64],
        features: NDArray[np.float32],
        when: tuple[float, int],
    ) -> tuple[list[int], list[int]]:
        """Add the masks (M,) to the features and counts of their tracks; see `observe` for the rest."""
        unit = directions(features)  # zeros where a feature has no direction
        new, again = [], []
        # No two masks have the same track: a mask holds more than half of the visible part of its own, and tracks that
        # this frame joined lie mostly in one mask.
        for m in np.flatnonzero(of_mask >= 0):
            k = int(self.root[of_mask[m]])
            track = self.tracks[k]
            if unit[m].any():
                track.total = of_masks[m] * unit[m] + (0 if track.total is None else track.total)
            track.pixels, track.masks = track.pixels + of_masks[m], track.masks + 1
            track.first = track.first if track.masks > 1 else when[1]
            track.views, track.sequence = track.views + 1, when[1]
            track.last_seen = max(track.last_seen, when[0])  # frames may come late
            if track.id < 0 and track.views >= MIN_VIEWS:
                new.append(k)
            elif track.id >= 0:
                again.append(k)
        return new, again


@njit(cache=True, nogil=True)
def _boxes(xyz, points, track, count):  # noqa: ANN001, ANN202
    """(count, 2, 3): lowest and highest coordinates of the points of each track, infinite without points."""
    boxes = np.empty((count, 2, 3))
    boxes[:, 0], boxes[:, 1] = np.inf, -np.inf
    for i in range(len(points)):
        if track[i] >= 0:
            box = boxes[track[i]]
            for a in range(3):
                box[0, a], box[1, a] = min(box[0, a], xyz[points[i], a]), max(box[1, a], xyz[points[i], a])
    return boxes


@njit(cache=True, nogil=True)
def _best(points, track, weight, root):  # noqa: ANN001, ANN202
    """(m,) see `PointVotes.best`; the lower number on ties."""
    best = np.full(len(points), NO_TRACK, np.int32)
    for i in range(len(points)):
        p = points[i]
        most = np.float32(0)
        for a in range(TRACKS_PER_POINT):
            if track[p, a] < 0:
                continue
            # Votes for tracks that were joined later are added up.
            own, together = root[track[p, a]], np.float32(0)
            for b in range(TRACKS_PER_POINT):
                if track[p, b] >= 0 and root[track[p, b]] == own:
                    together += weight[p, b]
            if together > most or (together == most and best[i] >= 0 and own < best[i]):
                best[i], most = own, together
    return best


@njit(cache=True, nogil=True)
def _add(points, new, amount, masked, track, weight):  # noqa: ANN001, ANN202
    """See `PointVotes.add`. Changes track and weight, (n, TRACKS_PER_POINT), in slot."""
    for i in range(len(points)):
        p, t = points[i], new[i]
        # Vote against the other tracks that this frame has masks of; find the slot of t, and the lightest to replace.
        lightest, slot = 0, -1
        for a in range(TRACKS_PER_POINT):
            if track[p, a] == t:
                slot = a
            elif track[p, a] >= 0 and masked[track[p, a]]:
                weight[p, a] = max(weight[p, a] - amount[i], np.float32(0))
            if weight[p, a] < weight[p, lightest]:
                lightest = a
        if t < 0:
            continue
        # A new track takes the lightest slot if it outweighs it, else reduces its weight: one that keeps coming gets
        # in.
        if slot >= 0:
            weight[p, slot] = min(weight[p, slot] + amount[i], np.float32(MAX_VOTES))
        elif weight[p, lightest] <= amount[i]:
            track[p, lightest], weight[p, lightest] = t, amount[i]
        else:
            weight[p, lightest] -= amount[i]
