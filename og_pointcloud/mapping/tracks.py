"""Things as they are found frame by frame: votes by point that later frames can overturn, and witnesses that join.

A track is what masks of several frames show as one thing. A mask belongs to the track that it has most of, if it also
is most of what the frame shows of that track; else it founds a track of its own. So a cup that the first frames took
for a part of the table gets a track when frames show it alone, and its points go over to it as votes outweigh the
table's: a frame that has a mask of a track votes for the points within and against those beside, as views do in
`fitting.membership`; one that missed the track has no vote.

Each frame is a witness for every two tracks that it shows within masks: one thing, if most of both lies in one mask,
else two. Tracks are joined while a majority of their witnesses says one (`fitting.grouping` does the same for masks,
over all views at once; `Mapper.finish` runs that rule). Only tracks that a frame sees are touched.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.fitting.association import directions
from og_pointcloud.kernels import njit
from og_pointcloud.mapping.likeness import Look, Scale, spread_of, typical_cosine
from og_pointcloud.mapping.voxels import Columns

NO_TRACK = -1
HEAVIEST = 4
"""Tracks that a point remembers votes for."""
MOST_VOTES = 24.0
"""Votes for one track that a point counts at most, so that the present can overturn a long history."""
CONFIRMED_VIEWS = 2
"""Frames that show a track before it is an object with an id."""
MOSTLY = 0.5
WITNESS_SHARE = 0.3
"""Share of what a usual frame shows of a track, below which a frame says nothing of it."""
JOIN_MAJORITY, FEWEST_WITNESSES = 0.5, 2
LEAST_POINTS = 3.0
"""Points of a track, or of a mask, that a frame must show to say anything of it."""


@dataclass
class PointVotes(Columns):
    """The heaviest votes of each point. track: (n, 4) int32, NO_TRACK where empty; weight: (n, 4) float32."""

    track: NDArray[np.int32] = field(default_factory=lambda: np.zeros((0, HEAVIEST), np.int32))
    weight: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, HEAVIEST), np.float32))
    SPARE: ClassVar[dict[str, float]] = {"track": NO_TRACK}

    def best(self, points: NDArray[np.integer], root: NDArray[np.int32]) -> NDArray[np.int32]:
        """(m,) the track, after joins, with the most votes of each point; NO_TRACK without any."""
        return _best(points, self.track, self.weight, root)

    def add(
        self, points: NDArray[np.integer], track: NDArray[np.int32], weight: NDArray[np.float32],
        masked: NDArray[np.bool_],
    ) -> None:  # fmt: skip
        """Votes of (m,) points for the track whose mask each lies in, NO_TRACK for none; and against those others that
        have a mask in this frame too, (tracks,) bool. A track that the proposer missed gets no vote."""
        _add(points, track, weight, masked, self.track, self.weight)


@dataclass
class Track:
    """total: (D,) sum of unit features by pixels; pixels: their sum. views, masks: how many
    showed it; first, sequence: the numbers of the first and of the last frame that did, 0 for an earlier map;
    last_seen: the stamp of the last. id: of the object, NO_TRACK while it is provisional. moved: it has been elsewhere.
    box: (2, 3) lowest and highest place of points that voted for it. lost: rows of its points that were seen through,
    losing_since: from that stamp on. left: when most were, how it looked; left_at: sequence then: what stood elsewhere
    by then is something else."""

    total: NDArray[np.float64] | None = None
    pixels: float = 0.0
    views: int = 0
    masks: int = 0
    last_seen: float = 0.0
    sequence: int = 0
    first: int = 0
    id: int = NO_TRACK
    moved: bool = False
    box: NDArray[np.float64] = field(default_factory=lambda: np.array([[np.inf] * 3, [-np.inf] * 3]))
    lost: list[int] = field(default_factory=list)
    losing_since: float = -np.inf
    left: Look | None = None
    left_at: int = 0

    def reach(self, box: NDArray[np.float64]) -> None:
        """Become as large as a box (2, 3)."""
        self.box = np.stack([np.minimum(self.box[0], box[0]), np.maximum(self.box[1], box[1])])

    def take_in(self, other: Track) -> None:
        """Become both."""
        if other.total is not None:
            self.total = other.total if self.total is None else self.total + other.total
        for name in ("pixels", "masks", "lost"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self.moved, self.first = self.moved or other.moved, min(self.first, other.first)
        self.reach(other.box)
        for name in ("views", "last_seen", "sequence"):
            setattr(self, name, max(getattr(self, name), getattr(other, name)))

    @property
    def descriptor(self) -> NDArray[np.float64] | None:
        """(D,) of length 1, None without a feature."""
        length = 0.0 if self.total is None else float(np.linalg.norm(self.total))
        return None if self.total is None or length < 1e-12 else self.total / length

    @property
    def agreement(self) -> float:
        """Mean cosine of its features with their mean."""
        return 0.0 if self.total is None else float(np.linalg.norm(self.total)) / max(self.pixels, 1e-12)


@dataclass
class Tracks:
    """tracks: by number; root: (tracks,) int32, the track that each was joined into. pairs: for two roots, how many
    frames showed them as one thing, and as two. next_id: of the next object; ids are never given twice."""

    tracks: list[Track] = field(default_factory=list)
    root: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))
    pairs: dict[tuple[int, int], list[int]] = field(default_factory=dict)
    next_id: int = 0

    def add(self, track: Track) -> int:
        """A new track's number."""
        self.tracks.append(track)
        self.root = np.append(self.root, np.int32(len(self.root)))
        return len(self.root) - 1

    def prune(self, votes: PointVotes, before: float) -> None:
        """Let go of tracks that were joined into others, and of those that one frame showed before that stamp, and
        number the others anew: memory follows the objects, and not the frames."""
        kept = [k for k, t in enumerate(self.tracks) if self.root[k] == k and (t.id >= 0 or t.last_seen >= before)]
        number = np.full(len(self.tracks) + 1, NO_TRACK, np.int32)  # the last: of NO_TRACK
        number[kept] = np.arange(len(kept))
        number[:-1] = number[self.root]
        votes.track[:] = number[votes.track]
        votes.weight[votes.track == NO_TRACK] = 0
        among = {*kept}
        self.pairs = {(int(number[a]), int(number[b])): c for (a, b), c in self.pairs.items() if {a, b} <= among}
        self.tracks, self.root = [self.tracks[k] for k in kept], np.arange(len(kept), dtype=np.int32)

    def place(self, xyz: NDArray[np.float32], points: NDArray[np.integer], track: NDArray[np.int32]) -> None:
        """Let the boxes of tracks reach the points (m,), rows of xyz (n, 3), that voted for them (m,)."""
        boxes = _boxes(xyz, points, track, len(self.tracks))
        for k in np.flatnonzero(np.isfinite(boxes[:, 0, 0])):
            self.tracks[self.root[k]].reach(boxes[k])

    def spread(self) -> NDArray[np.float64]:
        """(tracks,) the squared tangent that descriptors are off by (`likeness`)."""
        return spread_of([track.agreement for track in self.tracks], [track.masks for track in self.tracks])

    def scale(self) -> Scale:
        """What a cosine of two objects means."""
        known = [k for k, track in enumerate(self.tracks) if track.id >= 0 and track.descriptor is not None]
        rows = np.array([self.tracks[k].descriptor for k in known])
        return Scale(other=typical_cosine(rows, self.spread()[known]) if known else 0.0)

    def by_id(self) -> dict[int, int]:
        """Object id -> its track, of those that have not been joined into another."""
        return {track.id: k for k, track in enumerate(self.tracks) if track.id >= 0 and self.root[k] == k}

    def observe(
        self, votes: PointVotes, xyz: NDArray[np.float32], points: NDArray[np.int32], mask: NDArray[np.int32],
        weight: NDArray[np.float32], features: NDArray[np.float32], when: tuple[float, int],
    ) -> tuple[list[int], list[int]]:  # fmt: skip
        """Take in what a frame shows: points (m,), rows of xyz (n, 3), each in a mask or in -1, with a weight.
        features: (M, D). when: its stamp and sequence.

        Returns the tracks that are objects now and want an id, and those with one that were seen again.
        """
        own = votes.best(points, self.root)
        held = np.bincount(own + 1, minlength=len(self.root) + 1) > 0  # first: NO_TRACK
        seen, place = np.flatnonzero(held) - 1, (np.cumsum(held) - 1)[own + 1]
        rows = np.where(mask < 0, len(features), mask)  # the last row: in no mask
        shown = np.bincount(rows * len(seen) + place, weight, (len(features) + 1) * len(seen))
        shown = np.asarray(shown.reshape(len(features) + 1, len(seen)), np.float64)
        of_tracks, seen = shown[:, seen >= 0], seen[seen >= 0]
        of_mask = self._belonging(of_tracks, shown.sum(axis=1), seen)
        of_point = np.append(of_mask, NO_TRACK).astype(np.int32)[mask]
        masked = np.isin(self.root, self.root[of_mask[of_mask >= 0]])
        votes.add(points, of_point, weight, masked)
        self.place(xyz, points, of_point)
        self._witness(of_tracks[:-1], of_tracks.sum(axis=0), seen)
        return self._describe(of_mask, shown.sum(axis=1), features, when)

    def _belonging(
        self, of_tracks: NDArray[np.float64], of_masks: NDArray[np.float64], seen: NDArray[np.intp]
    ) -> NDArray[np.int64]:
        """(M,) the track of each mask, a fresh one where none fits; NO_TRACK for masks that show next to nothing."""
        of_mask = np.full(len(of_tracks) - 1, NO_TRACK)
        visible = of_tracks.sum(axis=0)
        for m in np.flatnonzero(of_masks[:-1] >= LEAST_POINTS):
            best = int(of_tracks[m].argmax()) if len(seen) else -1
            fits = best >= 0 and of_tracks[m, best] > MOSTLY * max(of_tracks[m].sum(), 1e-9)
            if fits and of_tracks[m, best] > MOSTLY * visible[best] and of_tracks[m].sum() > 0.25 * of_masks[m]:
                of_mask[m] = seen[best]
            else:
                of_mask[m] = self.add(Track())
        return of_mask

    def _witness(self, shown: NDArray[np.float64], visible: NDArray[np.float64], seen: NDArray[np.intp]) -> None:
        """Count this frame's word on every two tracks that masks hold, and join those that most frames call one."""
        # A frame that shows little of a track, its foot when the rest has gone, is no witness of it.
        usual = np.array([self.tracks[k].pixels / max(self.tracks[k].masks, 1) for k in seen.tolist()])
        enough = visible >= np.maximum(WITNESS_SHARE * usual, LEAST_POINTS)
        holds = enough & (shown.max(axis=0, initial=0) > MOSTLY * visible)
        container = shown.argmax(axis=0) if len(shown) else np.zeros(len(seen), int)
        held = np.flatnonzero(holds)
        for index, a in enumerate(held):
            for b in held[index + 1 :]:
                pair = int(seen[a]), int(seen[b])
                same = container[a] == container[b]
                if same or pair in self.pairs:
                    counts = self.pairs.setdefault(pair, [0, 0])
                    counts[0 if same else 1] += 1
                    one, two = counts
                    if same and one >= FEWEST_WITNESSES and one > JOIN_MAJORITY * (one + two):
                        self._join(*pair)

    def _join(self, a: int, b: int) -> None:
        """Make one of two tracks: the one with the lower id, or else the lower number, stays."""
        a, b = int(self.root[a]), int(self.root[b])
        if a == b:
            return
        key = [(self.tracks[k].id < 0, self.tracks[k].id, k) for k in (a, b)]
        a, b = (a, b) if key[0] < key[1] else (b, a)
        self.tracks[a].take_in(self.tracks[b])
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
        unit = directions(features)
        new, again = [], []
        for m in np.flatnonzero(of_mask >= 0):
            k = int(self.root[of_mask[m]])
            track = self.tracks[k]
            if unit[m].any():
                track.total = of_masks[m] * unit[m] + (0 if track.total is None else track.total)
            track.pixels, track.masks = track.pixels + of_masks[m], track.masks + 1
            if k in again or k in new:
                continue
            track.first = track.first if track.masks > 1 else when[1]
            track.views, (track.last_seen, track.sequence) = track.views + 1, when
            if track.id < 0 and track.views >= CONFIRMED_VIEWS:
                new.append(k)
            elif track.id >= 0:
                again.append(k)
        return new, again


@njit(cache=True, nogil=True)
def _boxes(xyz, points, track, count):  # noqa: ANN001, ANN202
    """(count, 2, 3): lowest and highest place of the points of each track, infinite without one."""
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
    best = np.full(len(points), NO_TRACK, np.int32)
    for i in range(len(points)):
        p = points[i]
        most = np.float32(0)
        for a in range(HEAVIEST):
            if track[p, a] < 0:
                continue
            # Tracks that were joined since then count together.
            own, together = root[track[p, a]], np.float32(0)
            for b in range(HEAVIEST):
                if track[p, b] >= 0 and root[track[p, b]] == own:
                    together += weight[p, b]
            if together > most or (together == most and best[i] >= 0 and own < best[i]):
                best[i], most = own, together
    return best


@njit(cache=True, nogil=True)
def _add(points, new, amount, masked, track, weight):  # noqa: ANN001, ANN202
    for i in range(len(points)):
        p, t = points[i], new[i]
        lightest, place = 0, -1
        for a in range(HEAVIEST):
            if track[p, a] == t:
                place = a
            elif track[p, a] >= 0 and masked[track[p, a]]:
                weight[p, a] = max(weight[p, a] - amount[i], np.float32(0))
            if weight[p, a] < weight[p, lightest]:
                lightest = a
        if t < 0:
            continue
        if place >= 0:
            weight[p, place] = min(weight[p, place] + amount[i], np.float32(MOST_VOTES))
        elif weight[p, lightest] <= amount[i]:
            track[p, lightest], weight[p, lightest] = t, amount[i]
        else:
            weight[p, lightest] -= amount[i]
