"""A tree of frames over time, made from /tf and /tf_static: the pose of one frame in another at a time.

Between two transforms, translations are interpolated linearly and rotations on the shortest arc. Offline that is always
possible, as all transforms are known in advance. There is no extrapolation before the first and after the last.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.formats.poses import pose_of_quaternion
from og_pointcloud_ros.messages import NANOSECONDS, nanoseconds

MIN_QUATERNION_LENGTH = 1e-6
"""Length below which a quaternion does not define a rotation."""
MAX_CHAIN_FRAMES = 1000
"""Maximum length of a chain of frames, each the child of the next; robots have tens."""
NEARLY_EQUAL_COSINE = 1 - 1e-8
"""Cosine of half the angle between two rotations above which the arc is straight up to rounding."""


class TransformError(OgPointcloudError):
    """Two frames are not connected, or not at the requested time."""


@dataclass
class _Edge:
    """Pose of a frame in its parent: translation (3,) and unit quaternion x y z w at each stamp, ascending."""

    parent: str
    stamps: list[int] = field(default_factory=list)
    poses: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = field(default_factory=list)
    static: bool = False


class TransformTree:
    """Frames by name, with or without a leading slash. Every frame has one parent, the latest one added."""

    def __init__(self) -> None:
        self._edges: dict[str, _Edge] = {}

    @property
    def frames(self) -> list[str]:
        """All names, in alphabetical order."""
        return sorted({*self._edges, *(edge.parent for edge in self._edges.values())})

    def add(
        self, parent: str, child: str, translation: ArrayLike, rotation_xyzw: ArrayLike, stamp: int = 0, *,
        static: bool = False,
    ) -> None:  # fmt: skip
        """Add the pose of child in parent: p_parent = R p_child + translation. stamp: nanoseconds.

        A static transform holds at all times. TransformError for NaN, infinity, or a quaternion of length 0.
        """
        place, turn = np.asarray(translation, np.float64), np.asarray(rotation_xyzw, np.float64)
        length = float(np.linalg.norm(turn))
        if not (np.isfinite(place).all() and np.isfinite(length) and length > MIN_QUATERNION_LENGTH):
            raise TransformError(
                f"the transform from '{child}' to '{parent}' is {place.tolist()}, {turn.tolist()}; expected finite "
                "numbers and a rotation of length 1"
            )
        parent, child = parent.lstrip("/"), child.lstrip("/")
        # A static transform replaces what was known, and so does another parent.
        edge = self._edges.get(child)
        if edge is None or edge.parent != parent or edge.static != static or static:
            edge = self._edges[child] = _Edge(parent, static=static)
        # Sorted by time, whatever the order of messages; the later message of one stamp counts.
        at = bisect_left(edge.stamps, stamp)
        repeated = at < len(edge.stamps) and edge.stamps[at] == stamp
        edge.stamps[at : at + repeated] = [stamp]
        edge.poses[at : at + repeated] = [(place, turn / length)]

    def add_message(self, message: Any, *, static: bool = False) -> None:
        """All transforms of a tf2_msgs/TFMessage."""
        for stamped in message.transforms:
            place, turn = stamped.transform.translation, stamped.transform.rotation
            self.add(
                stamped.header.frame_id, stamped.child_frame_id, (place.x, place.y, place.z),
                (turn.x, turn.y, turn.z, turn.w), nanoseconds(stamped.header.stamp), static=static,
            )  # fmt: skip

    def lookup(self, target: str, source: str, stamp: int) -> NDArray[np.float64]:
        """(4, 4) float64 from source to target coordinates. stamp: nanoseconds."""
        target, source = target.lstrip("/"), source.lstrip("/")
        # Both chains of parents, up to the first common frame: out of the source, and into the target.
        down, up = self._to_root(source), self._to_root(target)
        if source != target and not set(down) & set(up):
            missing = [repr(frame) for frame in (target, source) if frame not in self.frames]
            reason = f"{' and '.join(missing)} unknown" if missing else "they have no common ancestor"
            raise TransformError(
                f"no transform from '{source}' to '{target}': {reason}; "
                f"the frames are {', '.join(self.frames) or 'none'}"
            )
        common = next(frame for frame in down if frame in up)
        return np.linalg.inv(self._chain(up[: up.index(common)], stamp)) @ self._chain(
            down[: down.index(common)], stamp
        )

    def _to_root(self, frame: str) -> list[str]:
        """The frame, its parent, and so on."""
        path = [frame]
        while path[-1] in self._edges:
            parent = self._edges[path[-1]].parent
            if len(path) == MAX_CHAIN_FRAMES:
                raise TransformError(f"'{frame}' has more than {MAX_CHAIN_FRAMES} ancestors; expected a robot's tree")
            if parent in path:
                raise TransformError(f"frames form a loop: {' in '.join([*path, parent])}; expected a tree")
            path.append(parent)
        return path

    def _chain(self, frames: list[str], stamp: int) -> NDArray[np.float64]:
        """(4, 4) from the first frame to the last one's parent; the identity without frames."""
        matrix = np.eye(4)
        for frame in frames:
            matrix = self._pose(frame, stamp) @ matrix
        return matrix

    def _pose(self, frame: str, stamp: int) -> NDArray[np.float64]:
        """(4, 4) from a frame to its parent at that time; TransformError outside the known interval."""
        edge = self._edges[frame]
        if edge.static:
            return pose_of(*edge.poses[-1])
        after = bisect_left(edge.stamps, stamp)
        if after < len(edge.stamps) and edge.stamps[after] == stamp:
            return pose_of(*edge.poses[after])
        if not 0 < after < len(edge.stamps):
            first, last, asked = (moment / NANOSECONDS for moment in (edge.stamps[0], edge.stamps[-1], stamp))
            raise TransformError(
                f"'{frame}' in '{edge.parent}' is known from {first:.3f} to {last:.3f} s, not at {asked:.3f} s"
            )
        before = after - 1  # the fraction of the way between two stamps
        share = (stamp - edge.stamps[before]) / (edge.stamps[after] - edge.stamps[before])
        (place, turn), (next_place, next_turn) = edge.poses[before], edge.poses[after]
        return pose_of(place + share * (next_place - place), slerp(turn, next_turn, share))


def slerp(first: NDArray[np.float64], second: NDArray[np.float64], share: float) -> NDArray[np.float64]:
    """(4,) unit quaternion on the shortest arc between two, the first at share 0, the second at 1 (Shoemake 1985)."""
    cosine = float(first @ second)
    if cosine < 0:  # q and -q are one rotation
        second, cosine = -second, -cosine
    if cosine > NEARLY_EQUAL_COSINE:  # the sines below would be 0 / 0
        mixed = first + share * (second - first)
        return mixed / np.linalg.norm(mixed)
    angle = np.arccos(cosine)
    return (np.sin((1 - share) * angle) * first + np.sin(share * angle) * second) / np.sin(angle)


def pose_of(translation: ArrayLike, xyzw: ArrayLike) -> NDArray[np.float64]:
    """(4, 4) from a translation (3,) and a quaternion x y z w (ROS order) of any nonzero length, else SceneError."""
    return pose_of_quaternion(np.roll(np.asarray(xyzw, np.float64), 1), translation)
