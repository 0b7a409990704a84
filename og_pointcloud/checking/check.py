"""check_capture(scene) -> what fits together, what does not, and the repair that would help: before a fit is believed.

Nothing here changes a label. A check that cannot be made says so; one that fails names its suspects. Each bound lies
between right captures of every sensor at hand, far on the one side, and gross faults on the other
(examples/benchmark_checks.py). Where two bounds leave a gap, the capture has the benefit of the doubt.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from og_pointcloud.checking.conversions import Repairs, best_conversion, best_mask_conversion
from og_pointcloud.checking.masks import MaskMaps, read_mask_maps
from og_pointcloud.checking.photographs import ALIKE, Photographs, read_photographs, unreadable
from og_pointcloud.checking.registration import GROUPS, MORE_POINTS, Registration, Small
from og_pointcloud.checking.sample import Comparison, Sample, draw_sample, seen
from og_pointcloud.cloud import BACKGROUND, UNKNOWN_SPACE, UNOBSERVED, LabelledCloud
from og_pointcloud.errors import coordinate, printable
from og_pointcloud.scene import Points, Scene, float32_step

Verdict = Literal["ok", "doubt", "unchecked"]

PHOTOGRAPHS_FIT = (0.7, 0.25)
"""Least share and gap (`Comparison`) by which drawings must fit their own photographs better than others."""
NEARLY_ALWAYS = 0.95
"""From this share on no gap is asked for: a mirror, or other light, reduces the gap but not the share."""
MASKS_AGREE, MASKS_VOUCH = (0.75, 0.12), (0.85, 0.15)
"""Share and gap by which masks of different views agree better than with other masks: from the first on they are right,
and they are doubted only where both are missed; from the second on they vouch for poses that photographs doubt."""
MASKS_CHANCE, MASKS_ERRORS = 0.6, 2.0
"""Right masks that miss walls and floors in one view but not in the next agree little more than wrong ones do, and a
few pairs of views cannot tell the two apart: masks are not doubted where the share is at least this, and the gap at
most so many of its standard errors below its bound."""
LEAST_FEATURE_SHARE, FEWEST_FEATURES = 0.6, 60
"""Least share of comparisons, and fewest of them, in which masks that show the same thing must have the more similar
features. By chance it is a half; where a detector names most things alike, two thirds."""
LESS_ERROR, LEAST_GAIN, LEAST_SHIFT = 0.8, 0.085, 0.01
"""A small change is a fault of the capture when it leaves less than this share of the error, takes more than this off
it (in correlation), and moves points by more than this share of the image's width. Real calibrations leave more and
move less; smooth images, which a change fits by chance, hardly gain."""
FEWEST_ALIGNED = 4
"""Fewer views than this can be fitted by a change although nothing is wrong."""
AS_GOOD, HALF = 0.1, 0.5
"""Of two changes the one with fewer numbers is preferred if it misses no more than this share of the other's gain. A
change of everything, which no repair can undo, is named only where no other gains half as much."""
FEWEST = 10
"""Fewer points, comparisons, rows or instances than this say nothing."""
FEWEST_VOUCHING = 30
"""Fewer comparisons than this do not vouch for poses."""
MOST_BLIND = 0.7
"""Share of the views asked that may see nothing because they belong to another part of a larger map."""
MOST_UNSHOWN, MOST_ZERO, WHOLE_IMAGE = 0.3, 0.5, 0.95
"""Most feature rows that no pixel shows, most rows that are zero, and most of an image that one mask covers; shares."""
MOST_BLENDED = 0.004
"""Share of mask borders, by the median view and beyond chance, with an id between those of both sides. It is 0.0015 at
most in right captures, 0.008 or more in masks stored with losses, and 0.14 or more in interpolated ones."""
NEARLY_ALL, MOST_UNOBSERVED = 0.95, 0.5
"""Most of the points that one instance may have, and most that no view may see; shares."""
LEAST_COSINE = 2.5
"""How far an instance's best word stands out, in standard deviations of random directions' cosines: farther than this
where both are of one encoder, less far where they are not and words are few (the best of 1000 random ones: 3.2)."""
SUSPECTS = "poses (axes, direction, order), units, intrinsics or the cloud's frame are wrong"


class CaptureWarning(UserWarning):
    """A capture does not fit together: what was found, and the repair."""


@dataclass(frozen=True)
class Check:
    """name: of what was looked at. verdict: "unchecked" where there is nothing to tell by. says: what was found, in
    words. repair: `og-pointcloud repair CAPTURE` takes it, where one is known to help."""

    name: str
    verdict: Verdict
    says: str
    repair: str = ""

    def as_dict(self) -> dict[str, str]:
        """JSON-able, as reports and manifests hold it."""
        entry = {"name": self.name, "verdict": self.verdict, "says": self.says}
        return {**entry, "repair": self.repair} if self.repair else entry


def check_capture(scene: Scene) -> list[Check]:
    """Whether poses, photographs, masks, features and cloud fit together; takes half a second, more where they do not.

    Some views and points are asked; of a scene without masks poses and photographs alone. Raises SceneError where masks
    cannot be read.
    """
    sample = draw_sample(scene)
    maps = read_mask_maps(sample) if any(view.mask_count for view in scene.views) else None
    # In this order, as one fault looks like the next: wrong poses make masks disagree, wrong masks mix up features.
    checks, photographs = _poses(sample, maps)
    checks.append(_alignment(photographs))
    if maps is not None:
        checks.append(_masks(maps, is_doubted=_doubted(checks, "poses")))
        checks.append(_features(maps, is_doubted=_doubted(checks, "poses", "masks")))
    return [*_coordinates(scene.points), *checks, *_unreadable(sample, photographs)]


def check_cloud(cloud: LabelledCloud, before: Sequence[Check] = ()) -> list[Check]:
    """Whether a fit's answer is one to believe: points seen, instances. before: the checks of its capture."""
    vouched = any(check.name == "poses" and check.verdict == "ok" for check in before)
    return [_observed(cloud, vouched), _instances(cloud), _space(cloud)]


def check_words(cloud: LabelledCloud) -> Check:
    """Whether the vocabulary's vectors can be of the masks' encoder.

    Vectors of two encoders stand to each other as random directions do: their cosines spread by 1 / sqrt(width).
    """
    descriptors, vocabulary = cloud.instances.descriptors, cloud.vocabulary
    if vocabulary is None or len(descriptors) < FEWEST or len(vocabulary.names) < 2:
        return Check("words", "unchecked", "no words to compare, or too few instances")
    best = cloud.instances.cosines(vocabulary.vectors).max(axis=1)
    # Cosines below -1 are of instances without a descriptor; the rest in units of 1 / sqrt(width).
    typical = float(np.median(best[best >= -1])) * float(np.sqrt(descriptors.shape[1]))
    says = f"an instance's best word stands {typical:.1f} standard deviations of random vectors from chance"
    if typical < LEAST_COSINE:
        return Check("words", "doubt", f"{says}: the words' vectors seem to be of another encoder than the masks'")
    return Check("words", "ok", says)


def warn_of_doubts(checks: Sequence[Check], capture: str = "CAPTURE", stacklevel: int = 2) -> None:
    """A `CaptureWarning` for each doubt. capture: its folder, as the repair's line has it."""
    for check in checks:
        if check.verdict == "doubt":
            cure = f"; try: og-pointcloud repair {capture} {check.repair}" if check.repair else ""
            warnings.warn(f"{check.name}: {check.says}{cure}", CaptureWarning, stacklevel=stacklevel + 1)


def with_checks(cloud: LabelledCloud, checks: Sequence[Check]) -> LabelledCloud:
    """The cloud with these checks added to those in its provenance."""
    entries = [*cloud.provenance.get("checks", []), *(check.as_dict() for check in checks)]
    return replace(cloud, provenance={**cloud.provenance, "checks": entries})


def _doubted(checks: Sequence[Check], *names: str) -> bool:
    return any(check.verdict == "doubt" for check in checks if check.name in names)


def _doubt(name: str, says: str, repairs: Repairs = (), then: str = "") -> Check:
    """then: what is so with the repairs, if there are any."""
    listed = " ".join(map(str, repairs))
    return Check(name, "doubt", f"{says}; with {listed} {then}" if repairs else says, listed)


def _coordinates(points: Points) -> list[Check]:
    """A doubt where float32 rounded the coordinates of a map to more than the distance of its points."""
    # A surface of n points is about as wide as the root of n times their distance.
    apart = float(np.ptp(points.xyz, axis=0).max()) / float(np.sqrt(len(points)))
    farthest = float(np.abs(points.origin).max())
    if apart == 0 or np.spacing(np.float32(farthest)) <= apart or (step := float32_step(points.xyz_world)) <= apart:
        return []
    says = (
        f"they are float32, in steps of {step:.3g} at {coordinate(farthest)}, and points lie about {apart:.2g} apart: "
        "export them as double, or take an offset off cloud and poses before"
    )
    return [Check("coordinates", "doubt", says)]


def _unreadable(sample: Sample, photographs: Photographs | None) -> list[Check]:
    """A doubt where photographs cannot be read: the fit goes on without them, as if the capture had none."""
    used = {view.name for view in photographs.sample.views} if photographs else set()
    asked = [view for view in sample.views if view.image is not None and sample.rgb is not None]
    found = unreadable(view for view in asked if view.name not in used)
    says = (
        f"{len(found)} of {len(asked)} that were asked for cannot be read, and say nothing: {found[0]}" if found else ""
    )
    return [Check("photographs", "doubt", says)] if found else []


def _poses(sample: Sample, maps: MaskMaps | None) -> tuple[list[Check], Photographs | None]:
    """By photographs where there are any, else by masks; and the photographs, if they fit."""
    photographs = read_photographs(sample)
    if photographs is None:
        return [_poses_by_masks(sample, maps)], None
    stated = photographs.fit(photographs.sample.cameras)
    always = stated.share >= NEARLY_ALWAYS and stated.compared >= FEWEST_VOUCHING
    if stated.reaches(PHOTOGRAPHS_FIT) or always or stated.own >= ALIKE:  # of a few views, others fit nearly as well
        return [Check("poses", "ok", f"drawings fit their own photographs best: {stated}")], photographs
    # Colors that were not taken from photographs say nothing against poses: masks have to.
    if photographs.points_are_painted:
        return [_poses_by_masks(sample, maps)], None
    misfit = f"drawn where the poses say, the cloud fits its own photographs no better than others ({stated})"
    if repairs := best_conversion(photographs):
        repaired = photographs.fit(photographs.sample.repaired(repairs))
        return [_doubt("poses", f"{misfit}: {SUSPECTS}", repairs, f"it does ({repaired})")], None
    # Where masks fit the poses well, it is the photographs that are wrong; the fit does not read them.
    agreement = _agreement(maps)
    if agreement.compared >= FEWEST_VOUCHING and agreement.reaches(MASKS_VOUCH):
        says = (
            f"they fit the points' colors no better than other photographs ({stated}), though masks do: they are "
            "turned, of another place or in another order (labels do not depend on them), or poses are off a little"
        )
        return [_agreed("poses", agreement), _doubt("photographs", says)], None
    return [_doubt("poses", f"{misfit}: {SUSPECTS}")], None


def _poses_by_masks(sample: Sample, maps: MaskMaps | None) -> Check:
    enough = min(FEWEST, len(sample.xyz) / 2)  # of a cloud of a few points a view need not see ten
    blind = sum(len(seen(sample.xyz, camera).rows) < enough for camera in sample.cameras)
    agreement = _agreement(maps)
    if blind > MOST_BLIND * len(sample.cameras):
        says = f"the cameras of {blind} of {len(sample.cameras)} views see next to nothing of the cloud"
    elif agreement.compared < FEWEST:
        return Check("poses", "unchecked", "no photographs with colored points; masks are missing or share too little")
    elif _verdict(agreement) == "ok":
        return _agreed("poses", agreement)
    else:
        says = f"masks of different views agree no better than others' masks ({agreement})"
    repairs = (best_conversion(maps) or best_mask_conversion(maps)) if maps else ()
    # Neither right nor wrong by their bounds, and no conversion helps: not doubted.
    if blind <= MOST_BLIND * len(sample.cameras) and _verdict(agreement) == "unchecked" and not repairs:
        return _agreed("poses", agreement)
    return _doubt("poses", f"{says}: {SUSPECTS}, or masks are of other images", repairs, "masks agree")


def _agreement(maps: MaskMaps | None) -> Comparison:
    return Comparison.of([], "information") if maps is None else maps.fit(maps.sample.cameras)


def _agreed(name: str, found: Comparison) -> Check:
    verdict = _verdict(found)
    agree = "agree" if verdict == "ok" else "agree too little to tell that they are right, and too much for wrong ones"
    return Check(name, verdict, f"masks of different views {agree}: {found}")


def _verdict(found: Comparison) -> Verdict:
    """By masks: "unchecked" where only one of share and gap is missed, or the gap may be missed by chance."""
    if found.reaches(MASKS_AGREE):
        return "ok"
    least_share, least_gap = MASKS_AGREE
    may_be = found.share >= MASKS_CHANCE and found.gap + MASKS_ERRORS * found.error >= least_gap
    return "unchecked" if may_be or found.share >= least_share or found.gap >= least_gap else "doubt"


def _alignment(photographs: Photographs | None) -> Check:
    """Small faults: a shift, a turn, a scale or calibration that is a little off."""
    if photographs is None or len(photographs.images) < FEWEST_ALIGNED:
        says = f"it takes {FEWEST_ALIGNED} photographs or more that fit the points' colors"
        return Check("alignment", "unchecked", says)
    registration, name = Registration(photographs, photographs.sample.cameras), "everything"
    change = registration.found(name)
    # Few points tell whether anything is wrong at all; more of them then tell what, and how much.
    if suspicious := _is_fault(change, registration.start.error):
        registration = Registration(photographs, photographs.sample.cameras, MORE_POINTS)
        name, change = _simplest(registration)
        change = registration.refined(name, change)
    less = 1 - change.error / max(registration.start.error, 1e-9)
    if suspicious and _is_fault(change, registration.start.error):
        off = f"points lie {change.shift:.1%} of the width off"
        says = f"photographs fit {less:.0%} better with {GROUPS[name].says}: {off}"
        return Check("alignment", "doubt", says, " ".join(map(str, registration.repair(name, change))))
    says = f"no small change of poses or calibration fits much better ({less:.0%}, {change.shift:.1%} of the width)"
    return Check("alignment", "ok", says)


def _simplest(registration: Registration) -> tuple[str, Small]:
    """The group of fewest numbers whose best change is as good as others', and that change."""
    start = registration.start.error
    changes = {name: registration.found(name) for name in GROUPS}
    everything = changes.pop("everything")
    least = min(change.error for change in changes.values())
    if start - least < HALF * (start - everything.error):
        return "everything", everything
    return next(item for item in changes.items() if item[1].error <= least + AS_GOOD * (start - least))


def _is_fault(change: Small, start: float) -> bool:
    """Whether a change corrects a fault of the capture. start: the error without it."""
    return change.error <= min(LESS_ERROR * start, start - LEAST_GAIN) and change.shift >= LEAST_SHIFT


def _masks(maps: MaskMaps, *, is_doubted: bool) -> Check:
    whole = sum(np.bincount(ids.reshape(-1))[1:].max(initial=0) > WHOLE_IMAGE * ids.size for ids in maps.ids)
    if whole > len(maps.ids) / 2:
        says = f"one mask covers the whole image in {whole} of {len(maps.ids)} views: make masks of things"
        return Check("masks", "doubt", says)
    if (blended := float(np.median(maps.blended))) > MOST_BLENDED:
        says = (
            f"{blended:.0%} of the borders hold an id between those of both sides: masks were resized with "
            "interpolation, or stored with losses; expected ids as they were given: nearest neighbor, PNG"
        )
        return Check("masks", "doubt", says)
    if is_doubted:  # with wrong poses, right masks disagree too
        return Check("masks", "unchecked", "poses come first")
    agreement = _agreement(maps)
    if agreement.compared < FEWEST:
        return Check("masks", "unchecked", "too few points are seen by two views with masks")
    repairs = () if _verdict(agreement) == "ok" else best_mask_conversion(maps)
    if _verdict(agreement) != "doubt" and not repairs:
        return _agreed("masks", agreement)
    says = (
        f"where views see the same points, masks agree no better than others' ({agreement}): they are mirrored, "
        "turned, or of other images"
    )
    return _doubt("masks", says, repairs, "they agree")


def _features(maps: MaskMaps, *, is_doubted: bool) -> Check:
    if doubt := _odd_rows(maps) or _unshown(maps):
        return doubt
    if not any(map(len, maps.features)):
        return Check("features", "unchecked", "masks have none")
    if is_doubted:
        return Check("features", "unchecked", "poses and masks come first")
    alike = maps.features_alike(maps.sample.cameras)
    if alike.compared < FEWEST_FEATURES:
        return Check("features", "unchecked", "too few masks of different views show the same")
    says = f"masks that show the same have the more similar ones in {alike}"
    if alike.share >= LEAST_FEATURE_SHARE:
        return Check("features", "ok", says)
    # The same with ids moved by one: files that count masks from 0 name each mask's neighbor's row.
    shifted = maps.features_alike(maps.sample.cameras, shift=1).share
    if shifted > max(LEAST_FEATURE_SHARE, alike.share + 0.1):
        return Check("features", "doubt", f"{says}: ids seem to count from 0", "masks=from-zero")
    return Check("features", "doubt", f"{says}: rows belong to other masks")


def _odd_rows(maps: MaskMaps) -> Check | None:
    """A doubt where rows say nothing."""
    with_rows = [features for features in maps.features if features.size]
    rows = np.concatenate(with_rows) if with_rows else np.zeros((0, 1))
    if len(rows) < FEWEST:
        return None
    if (zero := float((rows == 0).all(axis=1).mean())) > MOST_ZERO:
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
    if len(many) >= 4 and not any(rows[-1] for rows in many) and others > 1 - MOST_UNSHOWN:
        says = f"the last row belongs to no pixel in any of {len(many)} views: ids seem to count from 0"
        return Check("features", "doubt", says, "masks=from-zero")
    missing = 1 - float(np.concatenate(shown).mean()) if shown else 0.0
    if sum(map(len, shown)) >= FEWEST and missing > MOST_UNSHOWN:
        says = f"{missing:.0%} of the rows belong to no pixel: more rows than masks, or rows of another run"
        return Check("features", "doubt", says)
    return None


def _observed(cloud: LabelledCloud, vouched: bool) -> Check:
    share = float((cloud.instance_ids == UNOBSERVED).mean()) if len(cloud) else 0.0
    says = f"{share:.0%} of the points are seen by no view"
    if share > MOST_UNOBSERVED and not vouched:
        return Check("points seen", "doubt", f"{says}: {SUSPECTS}, or the views show a small part")
    return Check("points seen", "ok", says)


def _instances(cloud: LabelledCloud) -> Check:
    ids, count = cloud.instance_ids, len(cloud.instances)
    if count == 0:
        return Check("instances", "doubt", "none: masks contradict each other, or show no point")
    largest = float(np.bincount(ids[ids >= 0], minlength=1).max() / max(len(ids), 1))
    says = f"the largest of {count} has {largest:.0%} of the points, {(ids == BACKGROUND).mean():.0%} are background"
    if largest > NEARLY_ALL and count > 1:
        return Check("instances", "doubt", f"{says}: masks join what lies apart")
    return Check("instances", "ok", says)


def _space(cloud: LabelledCloud) -> Check:
    if cloud.feature_space == UNKNOWN_SPACE:
        says = "nobody named the encoder of the masks: words of any encoder of that width are compared with them"
        return Check("feature space", "unchecked", says)
    return Check("feature space", "ok", f"'{printable(cloud.feature_space, 80)}'")
