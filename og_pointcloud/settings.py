"""Every number of the fit, with its source or reason. Frozen: a mistyped option is an error.

None is an absolute length: distances are in point spacings, weights in pixels, the rest are shares.
"""

from __future__ import annotations

import sys
from dataclasses import MISSING, dataclass, field, fields, replace
from numbers import Integral, Real
from typing import Any, Literal, get_args, get_origin, get_type_hints

from og_pointcloud.errors import OgPointcloudError

ABOVE_ZERO = {
    "coarse_interval", "enough_views", "fine_interval", "graph_points", "held_out_points", "image_pixels", "k1", "k2",
    "kinds", "lloyd_rounds", "memory", "neighbors", "opacity", "reach", "rounds", "scale", "scales", "schedule_share",
    "sharpness", "synonym", "tile_points", "width",
}  # fmt: skip
"""Settings that must not be 0; none may be negative."""
AT_MOST_ONE = {"opacity", "view_quantile"}


class _Checked:
    """Settings checked against their types when created: OgPointcloudError names the wrong one."""

    def __post_init__(self) -> None:
        hints = get_type_hints(type(self))
        for setting in fields(self):  # pyright: ignore[reportArgumentType]
            value = getattr(self, setting.name)
            if expected := _unlike(hints[setting.name], setting.name, value):
                default = "" if setting.default is MISSING else f", by default {setting.default!r}"
                kind = type(self).__name__
                raise OgPointcloudError(f"{setting.name} is {value!r}; expected {expected}{default} ({kind})")


def _unlike(hint: Any, name: str, value: Any) -> str:
    """What a setting of this type and name must be, in words; "" where the value is valid."""
    kinds = get_args(hint)  # the choices of a Literal, the types in a tuple or union; a union here is "int or None"
    if get_origin(hint) is Literal:
        return "" if value in kinds else f"one of {', '.join(map(repr, kinds))}"
    if type(None) in kinds:
        return "" if value is None else _unlike(kinds[0], name, value)
    if get_origin(hint) is tuple:
        right = isinstance(value, (tuple, list)) and value and not any(_unlike(kinds[0], name, each) for each in value)
        return "" if right else "a tuple of numbers above 0"
    if hint not in (int, float):  # a bool, or nested settings
        return "" if isinstance(value, hint) else f"a {hint.__name__}"
    # numpy's number types pass too; True, which Python counts as 1, and NaN, which is not >= 0, do not.
    least, most, whole = name in ABOVE_ZERO, name in AT_MOST_ONE, hint is int
    numbers: Any = Integral if whole else Real
    if isinstance(value, numbers) and not isinstance(value, bool):
        largest = 1 if most else 2**63 - 1 if whole else sys.float_info.max
        if 0 <= value <= largest and not (value == 0 and least):
            return ""
    kind = "a whole number" if whole else "a finite number"
    return kind + (" above 0" if least else " of at least 0") + " and at most 1" * most + " and below 2^63" * whole


@dataclass(frozen=True)
class GeometrySettings(_Checked):
    """Gaussians of a plain cloud (geometry.py)."""

    scales: tuple[float, ...] = (0.35, 0.5, 0.7)
    """Standard deviations tried, in point spacings; the one that labels held-out views best is taken (held_out.py).
    Where the smallest or the largest is clearly the best, the search goes on beyond it. A single one is used as is."""
    opacity: float = 0.9
    """Opacity of every point: two layers of points hide what is behind them."""
    held_out_views: int = 24
    """Views, evenly spread, that scales are compared on: labels from one half are judged on the other half."""
    held_out_points: int = 30_000
    """Points that scales are compared on."""
    sight_thickness: float = 3.0
    """Points closer than this many spacings along a ray belong to one surface and do not hide each other."""
    enough_views: int = 24
    """A view is left out where at least this many others show what it and its masks show (coverage.py)."""
    neighbors: int = 24
    """Nearest points of each point that its neighbors are chosen from."""
    reach: float = 3.0
    """Points within this many spacings adjoin; farther than this from the cloud is "too far"."""

    @property
    def middle_scale(self) -> float:
        """The scale where views cannot be held out: there are fewer than eight, or they share nothing."""
        return sorted(self.scales)[len(self.scales) // 2]


@dataclass(frozen=True)
class GroupingSettings(_Checked):
    """Training-free grouping of masks (grouping.py)."""

    graph_points: int = 60_000
    """Gaussians that mask overlaps are measured on."""
    witness_share: float = 0.1
    """A view that sees less than this share of a mask is no witness for it."""
    container_share: float = 0.5
    """A mask lies in another view's mask when more than this share of it does: at most one can hold it."""
    join_majority: float = 0.5
    """Groups are joined while more than this share of their witnesses says "one thing"."""
    spanning_share: float = 0.15
    """A mask that holds most of two groups spans them where each is more than this share of it."""
    left_out_voice: float = 0.5
    """Weight of a view that sees two masks but has a mask of only one; a view with masks of both weighs 1."""


@dataclass(frozen=True)
class MembershipSettings(_Checked):
    """States of points (membership.py)."""

    sure_share: float = 0.6
    """A point is clearly in an instance if more than this share of the votes of views with a mask of it is for it."""
    sure_votes: float = 0.1
    """And when it has more than this share of all votes on the point, including those of views without a mask of it."""
    swallowed_votes: float = 1.5
    """Where a larger instance has more votes, a smaller one that is clear is taken if it has more votes than this, half
    way between one view's and two: what one view alone has a mask of, no other can contradict."""
    open_share: float = 0.7
    """No point is clear that is seen less openly than this share of the scene's typical openness; the less openly it is
    seen, the less the votes on it count."""
    possible_share: float = 0.2
    """Below this share of the votes a point is clearly background; above it, it may join an adjoining instance."""
    possible_openly: float = 0.2
    """But only if its share exceeds this too when votes are weighted by themselves: views that see it openly decide."""
    growth_votes: float = 0.25
    """Such a point joins the instance when this share of the adjoining points, weighted by color, is in it already."""
    rate_share: float = 0.15
    """An instance detected less often than this share of the scene's typical rate is noise of the proposer."""
    missed_chance: float = 0.02
    """An instance masked in one view only is noise if the probability that all others missed it is below this, times
    how much likelier the colors across its outline are within one thing than between two."""
    island_share: float = 0.15
    """A separate piece whose points show less than this share of what the main piece's do was seen through the main
    piece, and is not part of it."""
    gap_sizes: float = 0.5
    """A gap in depth wider than this many times the mask's own size separates object and background."""
    front_share: float = 0.2
    """The nearest run of depths with this share of a mask's weight is its object."""
    hole_sizes: float = 0.25
    """Points farther behind those around them than this many times the mask's own size are seen through a hole."""


@dataclass(frozen=True)
class _LossSettings(_Checked):
    """Features and the losses that train them (paper, Sec. 3.1, Eq. 1 and 2)."""

    width: int = 6
    """Columns of a feature (paper, Sec. 3.1)."""
    intra: bool = True
    """Use the intra-mask smoothing loss (Eq. 1)."""
    inter: bool = True
    """Use the inter-mask contrastive loss (Eq. 2)."""
    cohesion_weight: float = 10.0
    """Weight of Eq. 1, as a mean over pixels, relative to Eq. 2. The paper gives none. The authors weigh distances 0.1;
    ours are squared, and smaller by about that much."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.intra or self.inter):
            raise OgPointcloudError("both losses are off; features need intra (Eq. 1), inter (Eq. 2), or both")


@dataclass(frozen=True)
class FeatureSettings(_LossSettings):
    """Instance features from the mask table (learned/instance_features.py)."""

    closest: float = 0.035
    """Eq. 2 stops growing where two mask means are nearer than this; directions at right angles read 0.71 apart."""
    tolerance: float = 1e-3
    """Converged when the objective fell by less than this share in the last ten steps."""
    max_steps: int = 1000
    """Steps after which training ends unconverged."""


@dataclass(frozen=True)
class CodebookSettings(_Checked):
    """Two-level codebook without rendering (learned/codebook.py; paper, Sec. 3.2, Eq. 3)."""

    k1: int | None = None
    """Coarse clusters; None: as many as there are things. The paper's 64 or 32 are its limitation 2."""
    k2: int | None = None
    """Fine clusters in each coarse one, 1 for coarse ones alone; None: as many as masks of one view fall into it."""
    position_weight: float = 2.0
    """In coarse clusters the scene's extent counts as much as this feature distance (Eq. 3; published: per scene unit).
    0: features alone."""
    fair_share: float = 0.2
    """A mask falls into a cluster that holds more than this share of the mask, or if it holds more than this share of
    what its view shows of the cluster (the authors' code: overlap 0.2)."""
    view_quantile: float = 0.8
    """Quantile, over views, of the number of masks in a cluster: the largest counts are of views that split things."""
    rounds: int = 30
    """Maximum number of k-means rounds."""


@dataclass(frozen=True)
class MatchingSettings(_Checked):
    """Which masks show which instance of a codebook (learned/matching.py; paper, Sec. 3.3, Eq. 5)."""

    score: Literal["both", "iou", "feature", "within"] = "both"
    """Eq. 5, or one of its factors alone (the paper's ablation); "within": Eq. 5 with the share of the instance that
    lies in the mask in place of IoU, which is never high for a piece of a large thing."""
    threshold: float = 0.1
    """A view's best mask is accepted above this score (the authors' code: 0.2)."""
    relative: bool = False
    """The threshold is relative to the median of the instances' best scores."""
    min_views: int = 1
    """An instance accepted by fewer views is unknown (the authors' code: 2 on ScanNet, 5 on LeRF)."""
    visible: bool = True
    """Compare masks with what is visible of an instance among the others; else with all of it, rendered alone, as
    published (mode paper)."""
    settle: bool = True
    """All views decide which instance a point is in (membership.py); else it keeps its leaf, as published."""


LITERAL_MATCHING = MatchingSettings(threshold=0.2, min_views=2, visible=False, settle=False)
"""Eq. 5 as the authors' code applies it on ScanNet."""


@dataclass(frozen=True)
class PaperSettings(_LossSettings):
    """The method as published, by rendering (learned/paper.py). At schedule_share 1 its steps are the authors'."""

    normalize: bool = True
    """Read a feature as its direction, mapped to [0, 1] (the authors' code), or as it is (the paper)."""
    schedule: Literal["scannet", "lerf"] = "scannet"
    """Steps of the three stages: 20k, 20k, 20k (ScanNet) or 10k, 10k, 20k (LeRF)."""
    schedule_share: float = 1.0
    """Factor on the steps of all stages."""
    formula: Literal["paper", "authors"] = "authors"
    """Eq. 1, 2 and 4 as printed, or as the authors' code computes them; learned/paper.py says what differs."""
    cohesion_weight: float = 0.1
    """Weight of Eq. 1 relative to Eq. 2 (the authors' code; 0.01 for LeRF's ramen)."""
    image_pixels: int = 320 * 240
    """Maximum pixels rendered per view: every stride-th row and column of larger ones. Cost grows with pixels, and
    masks of whole things lose nothing; the authors halve ScanNet's 1296 x 968."""
    scale: float = 0.7
    """Standard deviation of a plain cloud's Gaussians, in point spacings: as wide as trained Gaussians. If they were as
    thin as in the mask table, an instance rendered alone would cover no pixel by covered_share."""
    opacity: float = 0.95
    """Their opacity."""
    covered_share: float = 0.7
    """Pixels that Gaussians cover less than this are not part of their mask (the authors' code)."""
    alone_share: float = 0.7
    """The pixels of an instance rendered alone are those it covers by more than this (the authors' code: 0.8)."""
    feature_rate: float = 1e-3
    """Adam's learning rate for the features."""
    coarse_rate: float = 1e-4
    """Adam's learning rate for the features in the coarse codebook stage (the authors' code)."""
    fine_rate: float = 1e-4
    """The same in the fine stage (the authors' code: 1e-3, which moves features away from those that masks show)."""
    k1: int | None = 64
    """Coarse clusters (paper, Eq. 3); None: as many as there are things (learned/codebook.py)."""
    k2: int = 5
    """Fine clusters in each coarse one (paper, Eq. 3: 10 or 5). Formula "authors": fewer where the views show fewer
    masks in it."""
    position_weight: float = 1.0
    """Scene units of position that count as much as one of feature: absolute, as published (1.0 ScanNet, 0.5 LeRF)."""
    cluster_raw: bool = False
    """Cluster features as trained (the authors' code), not as read: they are longer, so positions count less."""
    fine_alone: bool = False
    """Each step of the fine stage renders one coarse cluster alone (the authors' code; formula "authors" only)."""
    coarse_interval: int = 200
    """Steps between reassignments to coarse clusters (the authors' code)."""
    fine_interval: int = 50
    """Steps between reassignments to fine clusters (the authors' code)."""
    lloyd_rounds: int = 5
    """Rounds of k-means per reassignment (the authors' code)."""
    point_pressure: float = 0.5
    """Probability per codebook step that all Gaussians shrink by one random factor, so that hidden ones show (formula
    "authors" only)."""
    matching: MatchingSettings = field(default_factory=lambda: LITERAL_MATCHING)
    """Eq. 5 as the authors' code applies it on ScanNet."""
    cache_bytes: int = 4 << 30
    """Bytes of blending weights kept between steps; further views are rendered anew."""
    device: str = "auto"
    """Where torch trains: cpu, cuda, or auto, cuda where torch has it. (No GPU was available: cuda is untried.)"""

    @classmethod
    def of_authors(cls, dataset: Literal["scannet", "lerf"] = "scannet", **changes: Any) -> PaperSettings:
        """The authors' settings for a data set, except for the changes; docs/paper.md says where ours differ."""
        own: dict[str, Any] = {"fine_rate": 1e-3, "alone_share": 0.8, "cluster_raw": True, "fine_alone": True}
        if dataset == "lerf":
            matching = replace(LITERAL_MATCHING, min_views=5)
            own |= {"schedule": "lerf", "k2": 10, "position_weight": 0.5, "matching": matching}
        return cls(**(own | changes))


@dataclass(frozen=True)
class FitSettings(_Checked):
    """Settings of `fit`. The defaults are meant for every scene; none needs tuning.

    >>> import og_pointcloud as og
    >>> settings = og.FitSettings(mode="grouping", seed=1)
    >>> settings.mode, settings.memory
    ('grouping', None)
    """

    mode: Literal["grouping", "fast", "paper", "auto"] = "grouping"
    """How masks become instances (labellers.py). "auto" is another name for the default."""
    reliable: float = 0.65
    """A fit with a lower reliability (reliability.py) gives a warning with the likely cause. In the choosing half of
    `examples/zoo.py`, scenes below this have a mean mIoU of 0.75, the others 0.94."""
    seed: int = 0
    """Seed of everything random."""
    memory: int | None = None
    """Bytes that the process may hold; None: what it holds already plus half of what is free."""
    tile_points: int | None = None
    """Fit in tiles of at most this many points; None: only where the whole cloud would not fit into memory."""
    geometry: GeometrySettings = field(default_factory=GeometrySettings)
    grouping: GroupingSettings = field(default_factory=GroupingSettings)
    membership: MembershipSettings = field(default_factory=MembershipSettings)
    features: FeatureSettings = field(default_factory=FeatureSettings)
    codebook: CodebookSettings = field(default_factory=CodebookSettings)
    matching: MatchingSettings = field(default_factory=MatchingSettings)
    paper: PaperSettings = field(default_factory=PaperSettings)


def fit_settings(settings: FitSettings | None) -> FitSettings:
    """The settings given, or the defaults for None; OgPointcloudError for anything else."""
    if not isinstance(settings, FitSettings | None):
        raise OgPointcloudError(f"settings is a {type(settings).__name__}; expected an og.FitSettings")
    return settings or FitSettings()


@dataclass(frozen=True)
class ChoosingSettings(_Checked):
    """From text vectors and descriptors to a label or "unknown" (choosing.py). Evidence is measured in standard
    deviations of the scores of unrelated words on an instance."""

    sharpness: float = 3.25
    """Minimum evidence assumed of a fitting word: what the best of a thousand unrelated words has by chance. Where the
    bank's words that fit a scene's instances have more, theirs is used."""
    kinds: int = 20
    """Kinds of things that an instance may be, if there are fewer labels: the prior of each label is then one in this
    many."""
    synonym: float = 0.6
    """A bank word this close to a label (centered cosine) means the same and is no evidence against it: cup and mug."""
