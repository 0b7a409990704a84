"""Objects as they are found frame by frame: points vote for tracks, and later frames can overturn the votes.

A track is what masks of several frames show as one thing. A mask belongs to the track that most of its points are of,
if the mask also covers most of what the frame shows of that track; else it founds a track of its own. So a cup that the
first frames took for a part of the table gets a track when frames show it alone, and its points go over to it once its
votes outweigh the table's. A frame with a mask of a track votes for it at the points within the mask and against it at
those beside, as views do in `fitting.membership`; a frame that missed the track has no vote.

Each frame is a witness for every two tracks that masks show in it: that they are one thing, if most of both lies in one
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
from og_pointcloud.mapping.likeness import Look, Scale, spread_of, typical_cosine
from og_pointcloud.mapping.voxels import Columns

NO_TRACK = -1
HEAVIEST = 4
"""Tracks that a point remembers votes for."""
MOST_VOTES = 24.0
"""Votes for one track that a point counts at most, so that the present can overturn a long history."""
CONFIRMED_VIEWS = 2
"""Frames that must show a track before it is an object with an id."""
MOSTLY = 0.5
"""Share above which a mask is mostly of a track, or what shows of a track lies mostly in a mask."""
LEAST_TRACKED = 0.25
"""Share of a mask's points that tracks must have, for the mask to belong to one of them."""
WITNESS_SHARE = 0.3
"""A frame that shows less than this share of what frames usually show of a track says nothing of it."""
JOIN_MAJORITY, FEWEST_WITNESSES = 0.5, 2
"""Two tracks are joined if more than this share of their witnesses, and so many, say that they are one."""
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
        """Vote at points (m,) for the track of the mask that each lies in, NO_TRACK for none, and against all other
        tracks that have a mask in this frame: masked, (tracks,) bool. A track that the proposer missed gets no vote."""
        _add(points, track, weight, masked, self.track, self.weight)


@dataclass
class Track:
    """total: (D,) sum of its masks' unit features, each by the points that the mask shows; pixels: sum of these
    weights. views, masks: how many showed it; first, sequence: the numbers of the first and of the last frame that did,
    0 for an earlier map; last_seen: the stamp of the last. id: of the object, NO_TRACK while it is provisional. moved:
    it has been elsewhere. box: (2, 3) lowest and highest place of points that voted for it. lost: rows of its points
    that were removed as seen through, losing_since: the stamp of the first of these. left: how it looked, once most
    were; left_at: the frame that last showed it: what stood elsewhere by then is something else."""

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
        """Enlarge the box to hold another (2, 3)."""
        self.box = np.stack([np.minimum(self.box[0], box[0]), np.maximum(self.box[1], box[1])])

    def take_in(self, other: Track) -> None:
        """Add all that is known of another track, which is of the same object. Views and stamps are not added: frames
        may have shown both."""
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
        """Let go of tracks that were joined into others, and of those without an id that no frame has shown since that
        stamp, and number the others anew: memory grows with the objects, not with the frames."""
        kept = [k for k, t in enumerate(self.tracks) if self.root[k] == k and (t.id >= 0 or t.last_seen >= before)]
        # Old number -> new one. The extra last entry is NO_TRACK's own, which indexes it as -1.
        number = np.full(len(self.tracks) + 1, NO_TRACK, np.int32)
        number[kept] = np.arange(len(kept))
        number[:-1] = number[self.root]
        votes.track[:] = number[votes.track]
        votes.weight[votes.track == NO_TRACK] = 0
        kept_set = {*kept}
        self.pairs = {(int(number[a]), int(number[b])): c for (a, b), c in self.pairs.items() if {a, b} <= kept_set}
        self.tracks, self.root = [self.tracks[k] for k in kept], np.arange(len(kept), dtype=np.int32)

    def place(self, xyz: NDArray[np.float32], points: NDArray[np.integer], track: NDArray[np.int32]) -> None:
        """Enlarge the boxes of tracks to hold the points (m,), rows of xyz (n, 3), that voted for them: track, (m,)."""
        boxes = _boxes(xyz, points, track, len(self.tracks))
        for k in np.flatnonzero(np.isfinite(boxes[:, 0, 0])):
            self.tracks[self.root[k]].reach(boxes[k])

    def spread(self) -> NDArray[np.float64]:
        """(tracks,) spread s of their descriptors (`likeness`)."""
        return spread_of([track.agreement for track in self.tracks], [track.masks for track in self.tracks])

    def scale(self) -> Scale:
        """What a cosine of two objects means in this map, by its own objects."""
        known = [k for k, track in enumerate(self.tracks) if track.id >= 0 and track.descriptor is not None]
        rows = np.array([self.tracks[k].descriptor for k in known])
        return Scale(other=typical_cosine(rows, self.spread()[known]) if known else 0.0)

    def by_id(self) -> dict[int, int]:
        """Object id -> number of its track, for tracks that have not been joined into another."""
        return {track.id: k for k, track in enumerate(self.tracks) if track.id >= 0 and self.root[k] == k}

    def observe(
        self, votes: PointVotes, xyz: NDArray[np.float32], points: NDArray[np.int32], mask: NDArray[np.int32],
        weight: NDArray[np.float32], features: NDArray[np.float32], when: tuple[float, int],
    ) -> tuple[list[int], list[int]]:  # fmt: skip
        """Take in what a frame shows: points (m,), rows of xyz (n, 3), each with its mask (-1 none) and a weight.
        features: (M, D) of the masks. when: the frame's stamp and sequence.

        Returns the tracks that are objects now and want an id, and those with one that were seen again.
        """
        # Tracks that the frame shows, NO_TRACK (-1) first if it is among them, and where each point's one stands there.
        own = votes.best(points, self.root)
        held = np.bincount(own + 1, minlength=len(self.root) + 1) > 0
        seen, place = np.flatnonzero(held) - 1, (np.cumsum(held) - 1)[own + 1]
        # (masks + 1, tracks seen) weight that each mask, and the last row: no mask, shows of each of these.
        rows = np.where(mask < 0, len(features), mask)
        shown = np.bincount(rows * len(seen) + place, weight, (len(features) + 1) * len(seen))
        shown = np.asarray(shown.reshape(len(features) + 1, len(seen)), np.float64)
        of_tracks, seen = shown[:, seen >= 0], seen[seen >= 0]
        # Each mask's track, then votes by it, then which tracks are one: each step uses what the last one decided.
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
        """(M,) the track of each mask, a fresh one where none fits; NO_TRACK for masks that show next to nothing.

        of_tracks: (M + 1, tracks) weight that each mask shows of each track in ``seen``; of_masks: (M + 1,) of all.
        """
        of_mask = np.full(len(of_tracks) - 1, NO_TRACK)
        visible = of_tracks.sum(axis=0)
        for m in np.flatnonzero(of_masks[:-1] >= LEAST_POINTS):
            best = int(of_tracks[m].argmax()) if len(seen) else -1
            # Most of the mask's points with a track are of this one, most of what shows of this one lies in the mask,
            # and the mask is not nearly all new points.
            tracked = of_tracks[m].sum()
            fits = (
                best >= 0
                and of_tracks[m, best] > MOSTLY * max(tracked, 1e-9)
                and of_tracks[m, best] > MOSTLY * visible[best]
                and tracked > LEAST_TRACKED * of_masks[m]
            )
            of_mask[m] = seen[best] if fits else self.add(Track())
        return of_mask

    def _witness(self, shown: NDArray[np.float64], visible: NDArray[np.float64], seen: NDArray[np.intp]) -> None:
        """Count for every two tracks in masks whether this frame shows them as one, and join those that most frames do.

        shown: (M, tracks) weight that each mask shows of each track in ``seen``; visible: (tracks,) with that in none.
        """
        # A frame that shows little of a track, only its foot after the rest has left, say, is no witness of it.
        usual = np.array([self.tracks[k].pixels / max(self.tracks[k].masks, 1) for k in seen.tolist()])
        enough = visible >= np.maximum(WITNESS_SHARE * usual, LEAST_POINTS)
        holds = enough & (shown.max(axis=0, initial=0) > MOSTLY * visible)
        container = shown.argmax(axis=0) if len(shown) else np.zeros(len(seen), int)
        held = np.flatnonzero(holds)
        for index, a in enumerate(held):
            for b in held[index + 1 :]:
                pair = int(seen[a]), int(seen[b])
                same = container[a] == container[b]
                # Pairs are counted once a frame has shown them as one: most never are, and need no memory.
                if same or pair in self.pairs:
                    counts = self.pairs.setdefault(pair, [0, 0])
                    counts[0 if same else 1] += 1
                    one, two = counts
                    if same and one >= FEWEST_WITNESSES and one > JOIN_MAJORITY * (one + two):
                        self._join(*pair)

    def _join(self, a: int, b: int) -> None:
        """Make one of two tracks: the one with the lower id, or without ids the one with the lower number, stays."""
        a, b = int(self.root[a]), int(self.root[b])
        if a == b:
            return
        a, b = sorted((a, b), key=lambda k: (self.tracks[k].id < 0, self.tracks[k].id, k))
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
        """Add the masks (M,) to what is known of their tracks; see `observe` for the rest."""
        unit = directions(features)  # zeros where a feature has no direction
        new, again = [], []
        # No two masks are of one track: a mask has more than half of what shows of its own, and tracks that this frame
        # joined lie mostly in one mask.
        for m in np.flatnonzero(of_mask >= 0):
            k = int(self.root[of_mask[m]])
            track = self.tracks[k]
            if unit[m].any():
                track.total = of_masks[m] * unit[m] + (0 if track.total is None else track.total)
            track.pixels, track.masks = track.pixels + of_masks[m], track.masks + 1
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
    """(m,) see `PointVotes.best`; of two equal sums, the lower number."""
    best = np.full(len(points), NO_TRACK, np.int32)
    for i in range(len(points)):
        p = points[i]
        most = np.float32(0)
        for a in range(HEAVIEST):
            if track[p, a] < 0:
                continue
            # Tracks that were joined after the votes were given count together.
            own, together = root[track[p, a]], np.float32(0)
            for b in range(HEAVIEST):
                if track[p, b] >= 0 and root[track[p, b]] == own:
                    together += weight[p, b]
            if together > most or (together == most and best[i] >= 0 and own < best[i]):
                best[i], most = own, together
    return best


@njit(cache=True, nogil=True)
def _add(points, new, amount, masked, track, weight):  # noqa: ANN001, ANN202
    """See `PointVotes.add`. Changes track and weight, (n, HEAVIEST), in place."""
    for i in range(len(points)):
        p, t = points[i], new[i]
        # Votes against the other tracks that this frame has masks of; its own place, and the one to give up for it.
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
        # A newcomer takes the lightest place if it outweighs it, else it wears it down: one that keeps coming gets in.
        if place >= 0:
            weight[p, place] = min(weight[p, place] + amount[i], np.float32(MOST_VOTES))
        elif weight[p, lightest] <= amount[i]:
            track[p, lightest], weight[p, lightest] = t, amount[i]
        else:
            weight[p, lightest] -= amount[i]
