"""LabelledCloud: the contract between training, which makes it, and the runtime, which labels points by it."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from og_pointcloud.errors import FeatureSpaceError, OgPointcloudError
from og_pointcloud.scene import Camera, brief, require_finite, take_arrays

BACKGROUND = -1
"""Instance id of a point that views saw, but outside every mask more often than missed masks explain."""
UNOBSERVED = -2
"""Instance id of a point about which nothing is known: no view saw it, and it lies on no observed surface."""

TOO_FAR = -3
"""Instance id of a query point without a cloud point within reach."""
UNKNOWN = -1
"""Label of a point that none of the names is known to fit."""
UNKNOWN_SPACE = "unknown"
"""Feature space of vectors of an unnamed encoder: only their width is checked."""
NO_EVIDENCE = -2.0
"""Cosine of an instance without a descriptor: below every true one."""
LENGTH_LIMITS = (1e-30, 1e30)
"""Smallest and largest spacing or reach of a scene: their squares and ratios are still finite in float64."""
MAX_ORIGIN = 1e15
"""Largest coordinate of a scene's origin, in its unit: beyond it float64 has no digits left for the points."""
MIN_BANK = 50
"""Smallest number of words in a bank: with fewer, the standard deviation is too uncertain as a unit of evidence."""


@dataclass(frozen=True)
class FeatureSpace:
    """What makes vectors comparable: their encoder and their width.

    name: of the encoder, e.g. "openai/clip-vit-base-patch16"; UNKNOWN_SPACE if it was not named, which fits any.
    width: length of the vectors; 0 if there are none yet, which fits any.
    """

    name: str
    width: int = 0

    def __post_init__(self) -> None:
        if not isinstance(self.name, str):
            raise FeatureSpaceError(
                f"the feature space is {self.name!r:.80}; expected the encoder's name, or '{UNKNOWN_SPACE}'"
            )

    def accepts(self, other: FeatureSpace) -> bool:
        """Whether vectors of the other space can be compared with vectors of this one."""
        # An unknown name or width is compatible with any.
        same_encoder = self.name == other.name or UNKNOWN_SPACE in (self.name, other.name)
        return same_encoder and (self.width == other.width or 0 in (self.width, other.width))

    def require(self, other: FeatureSpace, what: str) -> None:
        """FeatureSpaceError unless the two can be compared; it calls the other space's vectors ``what``."""
        if not self.accepts(other):
            raise FeatureSpaceError(f"the {what} are in {other}; expected {self}: encode them with that encoder")

    def __str__(self) -> str:
        return f"feature space '{self.name}'" + (f" (dimension {self.width})" if self.width else "")


@dataclass(frozen=True, eq=False)
class InstanceTable:
    """What is known about K instances; row k of each array is instance id k.

    descriptors: (R, D) float32, unit rows, grouped by instance: an instance has one or more, or none if no mask gave it
        a feature (it is then "unknown").
    descriptor_instance: (R,) int32, the instance of each descriptor, ascending.
    points: (K,) int32, points with this id. views, masks: (K,) int32, views that saw it and masks joined in it.
    agreement: (K,) float32 in [-1, 1], mean cosine of its masks' features with their descriptor.
    visible_area: (K,) float32, pixels of blending weight that its masks put on it, over all views.
    coarse: (K,) int32, the coarse cluster that an instance of a codebook lies in, -1 none. part_of: (K,) int32, the
        instance that this one is a part of, -1 none; without cycles. Left empty, both become -1 throughout.
    reliability: (K,) float32 in [0, 1], how well labels from half of the views reproduce its points, and its masks its
        name (fitting/reliability.py); NaN if not known. Left empty, it is NaN throughout.

    >>> cloud.instances.points, cloud.instances.part_of  # of `LabelledCloud`'s example
    (array([2, 1], dtype=int32), array([-1, -1], dtype=int32))
    >>> cloud.instances.cosines(np.array([[3, 4]], np.float32))
    array([[0.6],
           [0.8]], dtype=float32)
    """

    descriptors: NDArray[np.float32]
    descriptor_instance: NDArray[np.int32]
    points: NDArray[np.int32]
    views: NDArray[np.int32]
    masks: NDArray[np.int32]
    agreement: NDArray[np.float32]
    visible_area: NDArray[np.float32]
    coarse: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))
    part_of: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))
    reliability: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))

    __repr__ = brief

    def __post_init__(self) -> None:
        take_arrays(self, *(each.name for each in fields(self)))
        count = len(self.points)
        # Frozen, so by object.__setattr__: a column left empty becomes "unknown" in every row.
        for name, unknown in (("coarse", np.int32(-1)), ("part_of", np.int32(-1)), ("reliability", np.float32("nan"))):
            if len(getattr(self, name)) == 0:
                object.__setattr__(self, name, np.full(count, unknown))
        for name in ("points", "views", "masks", "agreement", "visible_area", "coarse", "part_of", "reliability"):
            if getattr(self, name).shape != (count,):
                raise OgPointcloudError(f"instance {name} has shape {getattr(self, name).shape}; expected ({count},)")
        if self.descriptors.ndim != 2 or len(self.descriptors) != len(self.descriptor_instance):
            raise OgPointcloudError(
                f"descriptors {self.descriptors.shape} and their instances {self.descriptor_instance.shape} differ"
            )
        for each in fields(self):
            kind = np.float32 if each.name in _FLOAT_COLUMNS else np.int32
            object.__setattr__(self, each.name, _as_stored(getattr(self, each.name), kind, f"instance {each.name}"))
        for name, (least, most) in _RANGES.items():
            values = getattr(self, name)
            if len(wrong := values[(values < least) | (values > most)]):  # NaN is "not known"
                raise OgPointcloudError(f"instance {name} is {wrong[0]}; expected {least:g} to {most:g}")
        owner = self.descriptor_instance  # ascending, so that each instance's descriptors are one slice
        if owner.size and (owner.min() < 0 or owner.max() >= count or (np.diff(owner) < 0).any()):
            raise OgPointcloudError(f"descriptor instances must ascend within 0..{count - 1}")
        if not np.isfinite(self.descriptors).all():
            raise OgPointcloudError("descriptors contain NaN or infinity; expected unit rows")
        _check_hierarchy(self.coarse, self.part_of)

    def __len__(self) -> int:
        return len(self.points)

    @property
    def overall_reliability(self) -> float | None:
        """Mean reliability, weighted by the fourth root of the instances' points: words count equally in a mIoU, but
        the reliability of few points is uncertain. None if no instance's is known. It ranks fits almost as mIoU does,
        which needs ground truth; 1 is not to be expected."""
        known = np.isfinite(self.reliability) & (self.points > 0)
        if not known.any():
            return None
        return float(np.average(self.reliability[known].astype(np.float64), weights=self.points[known] ** 0.25))

    def cosines(self, vectors: NDArray[np.floating]) -> NDArray[np.floating]:
        """(K, L) best cosine of each instance's descriptors with each of vectors (L, D); -2 if it has no descriptor.

        In the vectors' precision, at least float32. A zero vector has cosine 0 with everything.
        """
        vectors = unit_rows(vectors)
        if len(self.descriptors) == 0:  # the vectors may have any width
            return np.full((len(self), len(vectors)), NO_EVIDENCE, vectors.dtype)
        cosines = self.descriptors.astype(vectors.dtype, copy=False) @ vectors.T
        return best_of_rows(cosines, self.descriptor_instance, len(self), NO_EVIDENCE)


_FLOAT_COLUMNS = ("descriptors", "agreement", "visible_area", "reliability")
_RANGES = {
    **dict.fromkeys(("points", "views", "masks", "visible_area"), (0, np.inf)),
    "agreement": (-1.001, 1.001), "reliability": (0, 1.001),
}  # fmt: skip
"""What columns of an instance table can hold; shares and cosines leave room for rounding."""


def _as_stored(values: NDArray[Any], kind: type[np.number], what: str) -> NDArray[Any]:
    """Numbers in the type stored in files; OgPointcloudError for values of another kind."""
    if values.dtype.kind not in ("fiu" if issubclass(kind, np.floating) else "iu"):
        raise OgPointcloudError(f"{what} is {values.dtype}; expected {np.dtype(kind)}: convert it")
    with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinity
        return values.astype(kind, copy=False)


def _check_hierarchy(coarse: NDArray[np.int32], part_of: NDArray[np.int32]) -> None:
    count = len(part_of)
    if count and (coarse.min() < -1 or part_of.min() < -1 or part_of.max() >= count):
        raise OgPointcloudError(
            f"coarse clusters start at {coarse.min()}, part_of spans {part_of.min()}..{part_of.max()}; expected -1 or "
            f"more, and part_of at most {count - 1}"
        )
    parents = np.append(part_of, -1)  # row -1 is its own parent: none
    ancestor = np.arange(count)
    # Pointer doubling: after k rounds every row has risen 2^k levels, and without a cycle none rises more than count.
    for _ in range(count.bit_length()):
        ancestor, parents = parents[ancestor], parents[parents]
    if (ancestor >= 0).any():
        raise OgPointcloudError(f"instance {int(np.argmax(ancestor >= 0))} is part of itself, through part_of")


@dataclass(frozen=True, eq=False)
class Vocabulary:
    """Words with their text vectors. names: unique strings; vectors: (len(names), D) float32, any length.

    >>> import numpy as np
    >>> import og_pointcloud as og
    >>> og.Vocabulary(("chair", "desk"), np.eye(2, dtype=np.float32)).names
    ('chair', 'desk')
    """

    names: tuple[str, ...]
    vectors: NDArray[np.float32]

    __repr__ = brief

    def __post_init__(self) -> None:
        take_arrays(self, "vectors")
        if self.vectors.ndim != 2 or len(self.vectors) != len(self.names):
            raise OgPointcloudError(
                f"vocabulary has {len(self.names)} names and vectors of shape {self.vectors.shape}; expected one row "
                "per name"
            )
        object.__setattr__(self, "vectors", _as_stored(self.vectors, np.float32, "vocabulary vectors"))
        if not np.isfinite(self.vectors).all():
            raise OgPointcloudError("vocabulary vectors contain NaN or infinity; expected finite numbers")
        if not all(isinstance(name, str) for name in self.names):
            raise OgPointcloudError(f"the words are {[*self.names]!r:.80}; expected strings")


@dataclass(frozen=True, eq=False)
class WordBank:
    """Everyday words of the scene's encoder: they show how texts that do not fit score, and what else a thing may be.

    vectors: (B, D) float32 unit rows, B at least 50; they may be stored as float16.

    >>> import numpy as np
    >>> import og_pointcloud as og
    >>> float(og.WordBank(2 * np.eye(64, dtype=np.float32)).mean[0])
    0.015625
    """

    vectors: NDArray[np.float32]

    __repr__ = brief

    def __post_init__(self) -> None:
        vectors = finite_rows(self.vectors, "word bank")
        if len(vectors) < MIN_BANK:
            raise FeatureSpaceError(
                f"a word bank of {len(vectors)} words; expected at least {MIN_BANK} everyday words, encoded like labels"
            )
        object.__setattr__(self, "vectors", unit_rows(vectors))

    @property
    def mean(self) -> NDArray[np.float32]:
        """(D,) mean vector, the component that all words share."""
        return self.vectors.mean(axis=0)


@dataclass(frozen=True, eq=False)
class LabelledCloud:
    """Points with an instance id each, and one or more descriptors per instance.

    xyz: (n, 3) float32, local frame; origin: (3,) float64, world = xyz + origin.
    instance_ids: (n,) int32, >= 0 a row of ``instances``, else BACKGROUND or UNOBSERVED.
    feature_space: name of the encoder that mask features and text vectors share.
    spacing: typical distance between neighboring points, in the scene's unit.
    reach: distance from the cloud beyond which a query point is "too far from the map", same unit.
    rgb: (n, 3) uint8 or None.
    certainty: (n,) uint8, in 255ths, how well views and neighbors support that a point is in its instance, or in none;
    0 if no view saw it. None if not known, as in results of other programs.
    vocabulary: words that can be given as strings. word_bank: everyday words of the same encoder, by which labels are
    judged; without one, scores are not calibrated.
    provenance: JSON-able record of settings, seed, seconds per stage, and what was left out and why.
    cameras: cameras of the views that it was made from, in the local frame. They tell which space was observed to be
    empty, so that a later visit does not report as new what nobody had looked at before. Empty if not known.

    A chair of two points and a desk of one, as if an encoder had two words only:

    >>> import numpy as np
    >>> import og_pointcloud as og
    >>> vectors = np.eye(2, dtype=np.float32)
    >>> counts = np.array([[2, 1], [4, 4], [9, 6]], np.int32)  # points, views, masks
    >>> evidence = np.array([[0.9, 0.8], [500, 300]], np.float32)  # agreement, visible area
    >>> cloud = og.LabelledCloud(
    ...     xyz=np.array([[0, 0, 1], [0.1, 0, 1], [1, 0, 1]], np.float32),
    ...     origin=np.zeros(3),
    ...     instance_ids=np.array([0, 0, 1], np.int32),
    ...     instances=og.InstanceTable(vectors, np.array([0, 1], np.int32), *counts, *evidence),
    ...     feature_space="two-words", spacing=0.1, reach=0.3,
    ...     vocabulary=og.Vocabulary(("chair", "desk"), vectors),
    ... )
    >>> og.segment(cloud).counts()
    {'chair': 2, 'desk': 1}
    """

    xyz: NDArray[np.float32]
    origin: NDArray[np.float64]
    instance_ids: NDArray[np.int32]
    instances: InstanceTable
    feature_space: str
    spacing: float
    reach: float
    rgb: NDArray[np.uint8] | None = None
    certainty: NDArray[np.uint8] | None = None
    vocabulary: Vocabulary | None = None
    provenance: dict[str, Any] = field(default_factory=dict)
    word_bank: WordBank | None = None
    cameras: tuple[Camera, ...] = ()

    __repr__ = brief

    def __post_init__(self) -> None:
        take_arrays(self, "xyz", "origin", "instance_ids", "rgb", "certainty")
        n = len(self.xyz)
        if self.xyz.shape != (n, 3) or self.origin.shape != (3,) or self.instance_ids.shape != (n,):
            raise OgPointcloudError(
                f"xyz {self.xyz.shape}, origin {self.origin.shape} and instance ids {self.instance_ids.shape} do not "
                "fit together; expected (n, 3), (3,) and (n,)"
            )
        if self.xyz.dtype != np.float32:
            raise OgPointcloudError(
                f"xyz is {self.xyz.dtype}; expected float32 near zero: pass (xyz - origin).astype(np.float32)"
            )
        require_finite(self.xyz)
        if n and (self.instance_ids.min() < UNOBSERVED or self.instance_ids.max() >= len(self.instances)):
            raise OgPointcloudError(
                f"instance ids span {self.instance_ids.min()}..{self.instance_ids.max()}; expected "
                f"{UNOBSERVED}..{len(self.instances) - 1}"
            )
        object.__setattr__(self, "instance_ids", _as_stored(self.instance_ids, np.int32, "instance ids"))
        for name, values, shape in (("rgb", self.rgb, (n, 3)), ("certainty", self.certainty, (n,))):
            if values is not None and (values.shape != shape or values.dtype != np.uint8):
                raise OgPointcloudError(f"{name} is {values.dtype} {values.shape}; expected uint8 {shape}, 0 to 255")
        for name in ("spacing", "reach"):
            value = getattr(self, name)
            if not LENGTH_LIMITS[0] <= value <= LENGTH_LIMITS[1]:
                raise OgPointcloudError(
                    f"{name} is {value}; expected a positive length, {LENGTH_LIMITS[0]} to {LENGTH_LIMITS[1]}"
                )
        if not (np.abs(self.origin) <= MAX_ORIGIN).all():
            raise OgPointcloudError(f"origin is {self.origin}; expected finite numbers up to {MAX_ORIGIN:g}")
        space = self.space  # raises if the name is no string
        if self.word_bank is not None:
            space.require(FeatureSpace(self.feature_space, self.word_bank.vectors.shape[1]), "word bank's vectors")

    def __len__(self) -> int:
        return len(self.xyz)

    @property
    def space(self) -> FeatureSpace:
        """The feature space with the descriptors' width, 0 if no instance has a descriptor."""
        descriptors = self.instances.descriptors
        return FeatureSpace(self.feature_space, descriptors.shape[1] if len(descriptors) else 0)

    @property
    def reliability(self) -> float | None:
        """The fit's estimate of its own quality, in [0, 1]: `InstanceTable.overall_reliability`; None if unknown."""
        return self.instances.overall_reliability

    @property
    def counted_points(self) -> NDArray[np.int32]:
        """(K,) int32, the points of each instance, counted by their ids."""
        return np.bincount(self.instance_ids[self.instance_ids >= 0], minlength=len(self.instances)).astype(np.int32)

    @property
    def xyz_world(self) -> NDArray[np.float64]:
        """World coordinates, (n, 3) float64."""
        return self.xyz.astype(np.float64) + self.origin


def unit_rows(vectors: NDArray[np.floating]) -> NDArray[np.floating]:
    """Rows of length one, in the vectors' precision, at least float32; a zero row stays zero."""
    vectors = vectors.astype(np.result_type(vectors, np.float32), copy=False)
    # Divided by the largest component first: squares of tiny or huge ones would underflow or overflow.
    largest = np.abs(vectors).max(axis=-1, keepdims=True, initial=0)
    scaled = vectors / np.where(largest > 0, largest, 1)
    length = np.linalg.norm(scaled, axis=-1, keepdims=True)
    return scaled / np.where(length > 0, length, 1)


def best_of_rows(
    values: NDArray[np.floating], group: NDArray[np.integer], count: int, empty: float = -np.inf
) -> NDArray[np.floating]:
    """(count, ...) maximum over the rows of each group, ``empty`` for a group without rows. group: (rows,)."""
    best = np.full((count, *values.shape[1:]), empty, values.dtype)
    np.maximum.at(best, group, values)
    return best


def finite_rows(vectors: ArrayLike, what: str) -> NDArray[np.float32]:
    """The vectors as (count, width) float32; FeatureSpaceError, which calls them ``what``, where they are not that."""
    with np.errstate(over="ignore"):
        rows = np.asarray(vectors).astype(np.float32)
    if rows.ndim != 2:
        raise FeatureSpaceError(f"the {what} have shape {rows.shape}; expected (count, dimension)")
    if not np.isfinite(rows).all():
        row = int(np.argmin(np.isfinite(rows).all(axis=1)))
        raise FeatureSpaceError(f"row {row} of the {what} contains NaN or infinity; expected numbers: encode it again")
    return rows
