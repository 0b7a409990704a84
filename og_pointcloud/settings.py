"""Every number of the fit, with its source or reason. Frozen: a mistyped option is an error.

None of them is a length: distances are in point spacings, weights in pixels, the rest are shares.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

__all__ = ["AssociationSettings", "FitSettings", "GeometrySettings", "GroupingSettings", "MembershipSettings"]


@dataclass(frozen=True)
class GeometrySettings:
    """Gaussians of a plain cloud (geometry.py)."""

    scales: tuple[float, ...] = (0.2, 0.25, 0.35, 0.5, 0.7, 1.0)
    """Standard deviations tried, in point spacings."""
    opacities: tuple[float, ...] = (0.3, 0.5, 0.7, 0.9)
    """Opacities tried."""
    start_scale: float = 0.35
    """Scale without images to compare with."""
    start_opacity: float = 0.5
    """Opacity without images."""
    error_tolerance: float = 0.02
    """Photometric errors within this share of the best look as good."""
    mask_share: float = 0.08
    """A splat's standard deviation is at most this part of a typical mask's side."""
    photographs: int = 4
    """Images compared with, evenly spread over the views."""
    photograph_resolution: float = 1.2
    """Pixels per point spacing of the images compared with."""
    pixels_per_spacing: float = 2.0
    """Image pixels used per point spacing: more pixels than that see nothing new of the cloud."""
    max_stride: int = 3
    """Never leave out more pixels than this, whatever the spacing: mask edges are drawn in pixels."""
    neighbours: int = 16
    """Nearest points looked at."""
    reach: float = 3.0
    """Points within this many spacings adjoin; farther than this from the cloud is "too far"."""


@dataclass(frozen=True)
class GroupingSettings:
    """Training-free grouping of masks (grouping.py)."""

    graph_points: int = 60_000
    """Gaussians that mask overlaps are measured on."""
    witness_share: float = 0.1
    """A view that sees less than this share of a mask is no witness of it."""
    container_share: float = 0.5
    """A mask lies in another view's mask when more than this share of it does: at most one can hold it."""
    part_share: float = 0.1
    """A piece smaller than this share of a mask does not make it span several things."""
    join_majority: float = 0.5
    """Groups are joined while more than this share of their witnesses says "one thing"."""


@dataclass(frozen=True)
class MembershipSettings:
    """States of points (membership.py)."""

    sure_share: float = 0.6
    """A point is surely of an instance when this share of the weight asked lies in its masks."""
    possible_share: float = 0.2
    """A point may be of an instance from this share on, if it adjoins sure ones."""
    growth_votes: float = 0.25
    """This share of the adjoining points must be of the instance already."""
    rate_share: float = 0.25
    """An instance detected less often than this share of the scene's typical rate is noise of the proposer."""
    island_share: float = 0.15
    """A separate piece whose points show less than this share of what the main piece's do was seen through it."""
    border_shares: tuple[float, float] = (0.2, 0.9)
    """Points with a share between these lie between states: their neighbours settle them."""
    border_rounds: int = 2
    """How often: a border can be two points thick."""
    own_vote: float = 3.0
    """Votes of a point's own state, where a sure neighbour has one."""
    few_views: int = 3
    """Points seen by fewer views than this are checked by depth: no other view could contradict a mask."""
    gap_sizes: float = 2.0
    """A gap in depth wider than this many times the mask's own size parts object and background."""
    front_share: float = 0.2
    """The nearest run of depths with this share of a mask's weight is its object."""


@dataclass(frozen=True)
class AssociationSettings:
    """Feature rows of instances (association.py)."""

    outlier_deviations: float = 3.0
    """A mask's feature is left out when its cosine lies this many robust deviations below the median."""


@dataclass(frozen=True)
class FitSettings:
    """Settings of `fit`. The defaults are meant for every scene; none needs tuning."""

    mode: Literal["auto", "grouping"] = "auto"
    seed: int = 0
    geometry: GeometrySettings = field(default_factory=GeometrySettings)
    grouping: GroupingSettings = field(default_factory=GroupingSettings)
    membership: MembershipSettings = field(default_factory=MembershipSettings)
    association: AssociationSettings = field(default_factory=AssociationSettings)
