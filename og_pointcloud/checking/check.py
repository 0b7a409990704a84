"""check_capture(scene) -> what fits together, what does not, and the repair that would help: before a fit is believed.

Nothing here changes a label. A check that cannot be made says so; one that fails names its suspects. Each bound lies
between correct captures of every available sensor, by a wide margin, and gross faults (examples/benchmark_checks.py).
Where two bounds leave a gap, the capture gets the benefit of the doubt.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from og_pointcloud.checking.conversions import Repairs, best_conversion, best_mask_conversion
from og_pointcloud.checking.masks import MaskMaps, read_mask_maps
from og_pointcloud.checking.photographs import SAME_CONTENT_CORRELATION, Photographs, read_photographs
from og_pointcloud.checking.registration import GROUPS, MORE_POINTS_PER_VIEW, Registration, SmallChange
from og_pointcloud.checking.sample import Comparison, Sample, draw_sample, seen
from og_pointcloud.cloud import BACKGROUND, UNKNOWN_SPACE, UNOBSERVED, LabelledCloud
from og_pointcloud.errors import coordinate, printable
from og_pointcloud.scene import Points, Scene, float32_step, middle_extent

Verdict = Literal["ok", "doubt", "unchecked"]

PHOTOGRAPHS_FIT = (0.7, 0.25)
"""Least share and gap (`Comparison`) by which renderings must fit their own photographs better than others."""
NEARLY_ALWAYS_SHARE = 0.95
"""From this share on no gap is required: a mirror, or other light, reduces the gap but not the share."""
MASKS_AGREE, MASKS_VOUCH = (0.75, 0.12), (0.85, 0.15)
"""Least share and gap by which masks of different views agree better than with other masks. Masks that reach the first
pair are right, and are doubted only if they miss both numbers; those that reach the second vouch for poses that
photographs doubt."""
MIN_UNDECIDED_SHARE, MAX_GAP_ERRORS = 0.6, 2.0
"""Right masks that miss walls and floors in one view but not in the next agree little more than wrong ones do, and
few pairs of views cannot tell the two apart: masks are not doubted where the share is at least the first number, and
the gap at most the second number of its standard errors below its bound."""
MIN_FEATURE_SHARE, MIN_FEATURE_COMPARISONS = 0.6, 60
"""Least share of comparisons in which masks of the same thing must have the more similar features, and least number of
comparisons. The share is a half by chance, and two thirds where a detector gives most things the same name."""
MAX_ERROR_RATIO, MIN_ERROR_GAIN, MIN_SHIFT_SHARE = 0.8, 0.085, 0.01
"""A small change is a fault of the capture if it leaves at most this share of the error, reduces it by at least this
(in correlation), and moves points by at least this share of the image's width. Real calibrations leave more error and
move points less; smooth images, which a change may fit by chance, hardly gain."""
MIN_ALIGNED_VIEWS = 4
"""With fewer views a change may fit although nothing is wrong."""
MAX_MISSED_GAIN, MIN_GROUP_GAIN = 0.1, 0.5
"""Of two changes the one with fewer parameters is preferred if it misses at most the first share of the other's gain. A
change of everything, which no repair can undo, is named only where no other reaches the second share of its gain."""
MIN_COUNT = 10
"""Fewer points, comparisons, rows or instances are not enough to judge by."""
MIN_VOUCHING_COMPARISONS = 30
"""Fewer comparisons than this do not vouch for poses."""
MAX_BLIND_SHARE = 0.7
"""Share of the sampled views that may see nothing because they belong to another part of a larger map."""
MAX_UNSHOWN_SHARE, MAX_ZERO_SHARE, WHOLE_IMAGE_SHARE = 0.3, 0.5, 0.95
"""Largest shares of feature rows that no pixel shows, of rows that are zero, and of an image that one mask covers."""
MAX_BLENDED_SHARE = 0.004
"""Share of mask borders with an id between those of both sides: the median over views, less what chance gives. It is at
most 0.0015 in right captures, 0.008 or more in masks stored with losses, and 0.14 or more in interpolated ones."""
MAX_INSTANCE_SHARE, MAX_UNOBSERVED_SHARE = 0.95, 0.5
"""Largest shares of the points that one instance may have, and that no view may see."""
MIN_COSINE_DEVIATIONS = 2.5
"""Cosine of an instance with its best word, in standard deviations of random directions' cosines: larger than this if
both are from one encoder, smaller where they are not and words are few (the best of 1000 random words: 3.2)."""
SUSPECTS = "poses (axes, direction, order), units, intrinsics or the cloud's frame are wrong"


class CaptureWarning(UserWarning):
    """A capture does not fit together: what was found, and the repair."""


@dataclass(frozen=True)
class Check:
    """name: what was checked. verdict: "unchecked" where there is nothing to judge by. says: the finding, in words.
    repair: an argument of `og-pointcloud repair CAPTURE`, where one is known to help."""

    name: str
    verdict: Verdict
    says: str
    repair: str = ""

    def as_dict(self) -> dict[str, str]:
        """A dictionary for JSON, as reports and manifests hold it."""
        entry = {"name": self.name, "verdict": self.verdict, "says": self.says}
        return {**entry, "repair": self.repair} if self.repair else entry


def check_capture(scene: Scene) -> list[Check]:
    """Whether poses, photographs, masks, features and cloud fit together; takes half a second, more where they do not.

    Checks a sample of views and points; without masks, only poses and photographs. Raises SceneError where masks cannot
    be read.
    """
    sample = draw_sample(scene)
    maps = read_mask_maps(sample) if any(view.mask_count for view in scene.views) else None
    photographs, errors = read_photographs(sample)
    # In this order, as one fault looks like the next: wrong poses make masks disagree, wrong masks swap features.
    checks, photographs = _poses(sample, maps, photographs)
    checks.append(_alignment(photographs))
    if maps is not None:
        checks.append(_masks(maps, is_doubted=_doubted(checks, "poses")))
        checks.append(_features(maps, is_doubted=_doubted(checks, "poses", "masks")))
    return [*_coordinates(scene.points), *checks, *_unreadable(sample, errors)]


def check_cloud(cloud: LabelledCloud, before: Sequence[Check] = ()) -> list[Check]:
    """Whether a fit's result can be believed: points seen, instances. before: the checks of its capture."""
    vouched = any(check.name == "poses" and check.verdict == "ok" for check in before)
    return [_observed(cloud, vouched), _instances(cloud), _space(cloud)]


def check_words(cloud: LabelledCloud) -> Check:
    """Whether the vocabulary's vectors may come from the masks' encoder.

    Vectors of two encoders relate like random directions: their cosines spread by 1 / sqrt(width).
    """
    descriptors, vocabulary = cloud.instances.descriptors, cloud.vocabulary
    if vocabulary is None or len(descriptors) < MIN_COUNT or len(vocabulary.names) < 2:
        return Check("words", "unchecked", "no words to compare, or too few instances")
    best = cloud.instances.cosines(vocabulary.vectors).max(axis=1)
    # Cosines below -1 mean instances without a descriptor; the rest are scaled to units of 1 / sqrt(width).
    typical = float(np.median(best[best >= -1])) * float(np.sqrt(descriptors.shape[1]))
    says = f"an instance's best word scores {typical:.1f} standard deviations above random vectors"
    if typical < MIN_COSINE_DEVIATIONS:
        return Check("words", "doubt", f"{says}: the words seem to come from another encoder than the masks")
    return Check("words", "ok", says)


def warn_of_doubts(checks: Sequence[Check], capture: str = "CAPTURE") -> None:
    """A `CaptureWarning` for each doubt. capture: its folder, for the repair command."""
    for check in checks:
        if check.verdict == "doubt":
            cure = f"; try: og-pointcloud repair {capture} {check.repair}" if check.repair else ""
            warnings.warn(f"{check.name}: {check.says}{cure}", CaptureWarning, stacklevel=3)


def with_checks(cloud: LabelledCloud, checks: Sequence[Check]) -> LabelledCloud:
    """The cloud with these checks added to those in its provenance."""
    entries = [*cloud.provenance.get("checks", []), *(check.as_dict() for check in checks)]
    return replace(cloud, provenance={**cloud.provenance, "checks": entries})


def _doubted(checks: Sequence[Check], *names: str) -> bool:
    return any(check.verdict == "doubt" for check in checks if check.name in names)


def _doubt(name: str, says: str, repairs: Repairs = (), then: str = "") -> Check:
    """then: what holds with the repairs, if there are any."""
    listed = " ".join(map(str, repairs))
    return Check(name, "doubt", f"{says}; with {listed} {then}" if repairs else says, listed)


def _coordinates(points: Points) -> list[Check]:
    """A doubt where float32 rounded a map's coordinates to steps larger than the distance between its points."""
    # A surface of n points is about sqrt(n) times as wide as the distance between them.
    pitch = middle_extent(points.xyz) / float(np.sqrt(len(points)))
    farthest = float(np.abs(points.origin).max())
    if pitch == 0 or np.spacing(np.float32(farthest)) <= pitch or (step := float32_step(points.xyz_world)) <= pitch:
        return []
    says = (
        f"they are float32, in steps of {step:.3g} at {coordinate(farthest)}, and points lie about {pitch:.2g} apart: "
        "export them as double, or subtract an offset from cloud and poses first"
    )
    return [Check("coordinates", "doubt", says)]


def _unreadable(sample: Sample, errors: list[str]) -> list[Check]:
    """A doubt where photographs cannot be read: the fit goes on without them, as if the capture had none."""
    if not errors:
        return []
    given = sum(view.image is not None for view in sample.views)
    says = f"{len(errors)} of {given} that were sampled cannot be read, and are not used: {errors[0]}"
    return [Check("photographs", "doubt", says)]


def _poses(
    sample: Sample, maps: MaskMaps | None, photographs: Photographs | None
) -> tuple[list[Check], Photographs | None]:
    """The check of poses, by photographs where there are any, else by masks; and the photographs, if they fit."""
    if photographs is None:
        return [_poses_by_masks(sample, maps)], None
    stated = photographs.fit(photographs.sample.cameras)
    always = stated.share >= NEARLY_ALWAYS_SHARE and stated.compared >= MIN_VOUCHING_COMPARISONS
    # Of few views, others fit nearly as well.
    if stated.reaches(PHOTOGRAPHS_FIT) or always or stated.own >= SAME_CONTENT_CORRELATION:
        return [Check("poses", "ok", f"renderings fit their own photographs best: {stated}")], photographs
    # Colors that do not come from photographs are no evidence against poses: judge by masks.
    if photographs.points_are_painted:
        return [_poses_by_masks(sample, maps)], None
    misfit = f"rendered at these poses, the cloud fits its own photographs no better than others ({stated})"
    if repairs := best_conversion(photographs):
        repaired = photographs.fit(photographs.sample.repaired(repairs))
        return [_doubt("poses", f"{misfit}: {SUSPECTS}", repairs, f"it does ({repaired})")], None
    # Where masks fit the poses well, it is the photographs that are wrong; the fit does not read them.
    agreement = _agreement(maps)
    if agreement.compared >= MIN_VOUCHING_COMPARISONS and agreement.reaches(MASKS_VOUCH):
        says = (
            f"they fit the points' colors no better than other photographs ({stated}), but masks fit: they are turned, "
            "of another place or in another order (labels do not depend on them), or poses are slightly off"
        )
        return [_agreed("poses", agreement), _doubt("photographs", says)], None
    return [_doubt("poses", f"{misfit}: {SUSPECTS}")], None


def _poses_by_masks(sample: Sample, maps: MaskMaps | None) -> Check:
    enough = min(MIN_COUNT, len(sample.xyz) / 2)  # in a cloud of a few points a view need not see ten
    blind = sum(len(seen(sample.xyz, camera).rows) < enough for camera in sample.cameras)
    agreement = _agreement(maps)
    if blind > MAX_BLIND_SHARE * len(sample.cameras):
        says = f"the cameras of {blind} of {len(sample.cameras)} views see almost none of the cloud"
    elif agreement.compared < MIN_COUNT:
        return Check("poses", "unchecked", "no photographs of colored points; masks are missing or overlap too little")
    elif _verdict(agreement) == "ok":
        return _agreed("poses", agreement)
    else:
        says = f"masks of different views agree no better than unrelated masks ({agreement})"
    repairs = (best_conversion(maps) or best_mask_conversion(maps)) if maps else ()
    # Neither right nor wrong by the bounds, and no conversion helps: not doubted.
    if blind <= MAX_BLIND_SHARE * len(sample.cameras) and _verdict(agreement) == "unchecked" and not repairs:
        return _agreed("poses", agreement)
    return _doubt("poses", f"{says}: {SUSPECTS}, or masks belong to other images", repairs, "masks agree")


def _agreement(maps: MaskMaps | None) -> Comparison:
    return Comparison.of([], "information") if maps is None else maps.fit(maps.sample.cameras)


def _agreed(name: str, found: Comparison) -> Check:
    verdict = _verdict(found)
    agree = "agree" if verdict == "ok" else "agree too little to be clearly right, and too much to be clearly wrong"
    return Check(name, verdict, f"masks of different views {agree}: {found}")


def _verdict(found: Comparison) -> Verdict:
    """For masks: "unchecked" where only one of share and gap is missed, or the gap may be missed by chance."""
    if found.reaches(MASKS_AGREE):
        return "ok"
    least_share, least_gap = MASKS_AGREE
    may_be = found.share >= MIN_UNDECIDED_SHARE and found.gap + MAX_GAP_ERRORS * found.error >= least_gap
    return "unchecked" if may_be or found.share >= least_share or found.gap >= least_gap else "doubt"


def _alignment(photographs: Photographs | None) -> Check:
    """Small faults: a shift, a turn, a scale or calibration that is a little off."""
    if photographs is None or len(photographs.images) < MIN_ALIGNED_VIEWS:
        says = f"it needs at least {MIN_ALIGNED_VIEWS} photographs that fit the points' colors"
        return Check("alignment", "unchecked", says)
    registration, name = Registration(photographs), "everything"
    change = registration.best_change(name)
    # A few points show whether anything is wrong at all; more of them then show what, and how much.
    if suspicious := _is_fault(change, registration.start.error):
        registration = Registration(photographs, MORE_POINTS_PER_VIEW)
        name, change = _simplest(registration)
        change = registration.refined(name, change)
    less = 1 - change.error / max(registration.start.error, 1e-9)
    if suspicious and _is_fault(change, registration.start.error):
        off = f"points are off by {change.shift:.1%} of the width"
        says = f"photographs fit {less:.0%} better with {GROUPS[name].says}: {off}"
        return Check("alignment", "doubt", says, " ".join(map(str, registration.repair(name, change))))
    says = f"no small change of poses or calibration fits much better ({less:.0%}, {change.shift:.1%} of the width)"
    return Check("alignment", "ok", says)


def _simplest(registration: Registration) -> tuple[str, SmallChange]:
    """The group with the fewest parameters whose best change is as good as others', and that change."""
    start = registration.start.error
    changes = {name: registration.best_change(name) for name in GROUPS}
    everything = changes.pop("everything")
    least = min(change.error for change in changes.values())
    if start - least < MIN_GROUP_GAIN * (start - everything.error):
        return "everything", everything
    return next(item for item in changes.items() if item[1].error <= least + MAX_MISSED_GAIN * (start - least))


def _is_fault(change: SmallChange, start: float) -> bool:
    """Whether a change corrects a fault of the capture. start: the error without it."""
    return change.error <= min(MAX_ERROR_RATIO * start, start - MIN_ERROR_GAIN) and change.shift >= MIN_SHIFT_SHARE


def _masks(maps: MaskMaps, *, is_doubted: bool) -> Check:
    whole = sum(np.bincount(ids.reshape(-1))[1:].max(initial=0) > WHOLE_IMAGE_SHARE * ids.size for ids in maps.ids)
    if whole > len(maps.ids) / 2:
        says = f"one mask covers the whole image in {whole} of {len(maps.ids)} views: make one mask per object"
        return Check("masks", "doubt", says)
    if (blended := float(np.median(maps.blended))) > MAX_BLENDED_SHARE:
        says = (
            f"{blended:.0%} of the borders have ids between those on either side: masks were resized with "
            "interpolation, or compressed with losses; expected unchanged ids: nearest neighbor, PNG"
        )
        return Check("masks", "doubt", says)
    if is_doubted:  # with wrong poses, right masks disagree too
        return Check("masks", "unchecked", "poses must be fixed first")
    agreement = _agreement(maps)
    if agreement.compared < MIN_COUNT:
        return Check("masks", "unchecked", "too few points are seen by two views with masks")
    repairs = () if _verdict(agreement) == "ok" else best_mask_conversion(maps)
    if _verdict(agreement) != "doubt" and not repairs:
        return _agreed("masks", agreement)
    says = (
        f"where views see the same points, masks agree no better than unrelated masks ({agreement}): they are "
        "mirrored, turned, or from other images"
    )
    return _doubt("masks", says, repairs, "they agree")


def _features(maps: MaskMaps, *, is_doubted: bool) -> Check:
    if doubt := _odd_rows(maps) or _unshown(maps):
        return doubt
    if not any(map(len, maps.features)):
        return Check("features", "unchecked", "masks have no features")
    if is_doubted:
        return Check("features", "unchecked", "poses and masks must be fixed first")
    alike = maps.features_alike(maps.sample.cameras)
    if alike.compared < MIN_FEATURE_COMPARISONS:
        return Check("features", "unchecked", "too few masks of different views show the same object")
    says = f"masks of the same object have the more similar features in {alike}"
    if alike.share >= MIN_FEATURE_SHARE:
        return Check("features", "ok", says)
    # The same with ids shifted by one: files that count masks from 0 give each mask its neighbor's row.
    shifted = maps.features_alike(maps.sample.cameras, shift=1).share
    if shifted > max(MIN_FEATURE_SHARE, alike.share + 0.1):
        return Check("features", "doubt", f"{says}: ids seem to count from 0", "masks=from-zero")
    return Check("features", "doubt", f"{says}: rows belong to other masks")


def _odd_rows(maps: MaskMaps) -> Check | None:
    """A doubt where rows carry no information."""
    with_rows = [features for features in maps.features if features.size]
    rows = np.concatenate(with_rows) if with_rows else np.zeros((0, 1))
    if len(rows) < MIN_COUNT:
        return None
    if (zero := float((rows == 0).all(axis=1).mean())) > MAX_ZERO_SHARE:
        return Check("features", "doubt", f"{zero:.0%} of the rows are zero: encode the masks")
    if np.ptp(rows, axis=0).max() < 1e-6:
        return Check("features", "doubt", f"all {len(rows)} rows are equal: words cannot tell masks apart")
    return None


def _unshown(maps: MaskMaps) -> Check | None:
    """A doubt where many rows belong to no pixel, or the last one never does."""
    shown = [rows for rows in maps.shown if len(rows)]
    # Ids that count from 0 leave the last row unused: it is missing in every view while most other rows are shown.
    many = [rows for rows in shown if len(rows) > 1]
    others = float(np.mean([rows[:-1].mean() for rows in many])) if many else 0.0
    if len(many) >= 4 and not any(rows[-1] for rows in many) and others > 1 - MAX_UNSHOWN_SHARE:
        says = f"the last row belongs to no pixel in any of {len(many)} views: ids seem to count from 0"
        return Check("features", "doubt", says, "masks=from-zero")
    missing = 1 - float(np.concatenate(shown).mean()) if shown else 0.0
    if sum(map(len, shown)) >= MIN_COUNT and missing > MAX_UNSHOWN_SHARE:
        says = f"{missing:.0%} of the rows belong to no pixel: more rows than masks, or rows from another run"
        return Check("features", "doubt", says)
    return None


def _observed(cloud: LabelledCloud, vouched: bool) -> Check:
    share = float((cloud.instance_ids == UNOBSERVED).mean()) if len(cloud) else 0.0
    says = f"{share:.0%} of the points are seen by no view"
    if share > MAX_UNOBSERVED_SHARE and not vouched:
        return Check("points seen", "doubt", f"{says}: {SUSPECTS}, or the views show only a small part")
    return Check("points seen", "ok", says)


def _instances(cloud: LabelledCloud) -> Check:
    ids, count = cloud.instance_ids, len(cloud.instances)
    if count == 0:
        return Check("instances", "doubt", "none: masks contradict each other, or show no points")
    largest = float(np.bincount(ids[ids >= 0], minlength=1).max() / max(len(ids), 1))
    says = f"the largest of {count} has {largest:.0%} of the points, {(ids == BACKGROUND).mean():.0%} are background"
    if largest > MAX_INSTANCE_SHARE and count > 1:
        return Check("instances", "doubt", f"{says}: masks join separate objects")
    return Check("instances", "ok", says)


def _space(cloud: LabelledCloud) -> Check:
    if cloud.feature_space == UNKNOWN_SPACE:
        says = "the masks' encoder is unknown: words from any encoder of that dimension are compared with them"
        return Check("feature space", "unchecked", says)
    return Check("feature space", "ok", f"'{printable(cloud.feature_space, 80)}'")
