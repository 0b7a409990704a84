"""State and answers of a live page, without the page: colors of points, words, clicks, instances.

``serve`` shows it in a browser. The state is small: the color mode, and which instances are highlighted ("lit").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.ask.instances import NO_FEATURE, Instance, Instances
from og_pointcloud.ask.labelled_scene import LabelledScene, instance_table
from og_pointcloud.ask.picking import pick
from og_pointcloud.ask.selecting import Match, select
from og_pointcloud.cloud import LabelledCloud
from og_pointcloud.errors import MissingExtraError, OgPointcloudError, coordinate, counted, printable
from og_pointcloud.formats.colors import LUMINANCE, NO_LABEL, certainty_colors, label_colors
from og_pointcloud.mapping.map_record import MapRecord
from og_pointcloud.scene import Points
from og_pointcloud.show.viewpoint import Viewpoint
from og_pointcloud.text.words import MAX_WORD_CHARACTERS, Labels, TextFeatures

COLOR_MODES = ("labels", "instances", "certainty", "changes", "photo")
CHANGES = {
    "gone": (200, 30, 60), "new": (24, 150, 70), "moved from here": (244, 178, 60), "moved to here": (226, 88, 34),
    "not seen at the last visit": (86, 110, 190), "as it was": NO_LABEL,
}  # fmt: skip
"""Changes of an instance between two visits, and their colors. A map of several visits has no points of what left."""
MAX_WORDS_SHOWN = 6
"""Words shown for an instance."""
MAX_MATCHES_SHOWN = 12
"""Instances listed for a word."""
MAX_HINT_WORDS = 8
"""Stored words given as examples."""
MIN_SHADE, MAX_SHADE = 0.55, 1.10
"""Factors of a label's color if the point's own is black, and if it is white: shapes and shadows stay visible."""
FADE_SHARE, FADE_GREY = 0.72, 237
"""Points that are not lit turn grey, mixed with this share of this light grey."""
CLICK_PX = 33
"""Side of the square around a click in which points are searched."""


@dataclass(frozen=True)
class Answer:
    """An answer for the page. bars: words or instances with their scores. note: what the scores mean."""

    title: str
    lines: tuple[str, ...] = ()
    bars: tuple[tuple[str, float], ...] = ()
    note: str = ""


class LiveScene:
    """A scene to show, by its own points or by another cloud of the same place.

    scene: the scene to query. shown: the points to show, possibly Gaussians; None for the scene's own. labels,
    text_features: the words of mode "labels", as for ``segment``; left out, the scene's own, or none. changes: (K,) the
    change of each instance, a row of `CHANGES`, in which case this mode comes first; None for those that a map of
    several visits records.

    >>> live = LiveScene(og.LabelledScene.from_cloud(cloud))  # of `LabelledCloud`'s example
    >>> live.ask("desk").lines, live.lit
    (('fits 1 of 2 instances',), {1})
    """

    def __init__(
        self,
        scene: LabelledScene,
        shown: Points | None = None,
        labels: Labels = None,
        text_features: TextFeatures = None,
        changes: NDArray[np.intp] | None = None,
    ) -> None:
        self.scene, self.shown, self._text_features = scene, shown, text_features
        self.xyz = scene.xyz if shown is None else shown.xyz_world
        self.rgb = scene.cloud.rgb if shown is None else shown.rgb
        self.ids = scene.instance_ids if shown is None else scene.instances_at(self.xyz)
        """(N,) instance of each point shown; negative ids index tables by id from their end."""
        words = scene.known_words(labels, text_features)
        self.names = words.names
        self.label_of = scene.chooser.choose(words.vectors).by_id[0]
        known = _known_changes(scene.cloud) if changes is None else changes
        # By id, as label_of; negative ids read its end: "as it was", the last of CHANGES.
        self._change_of = np.full(len(self.label_of), len(CHANGES) - 1)
        if known is not None:
            self._change_of[: len(known)] = known
        has = {
            "labels": self.names,
            "changes": known is not None,
            "certainty": scene.certainty is not None,
            "photo": self.rgb is not None,
        }
        self.modes = tuple(mode for mode in COLOR_MODES if has.get(mode, True))
        self.mode = self.modes[0] if changes is None else "changes"
        self.lit: set[int] | None = None
        """Ids of the highlighted instances, None if all are."""

    # What is shown --------------------------------------------------------------------------------------------------

    def colors(self) -> NDArray[np.uint8]:
        """(N, 3) uint8 RGB of the points shown, by mode; grey for points that are not lit."""
        if self.mode == "photo":
            base = self._photo
        elif self.mode == "certainty":
            base = self._certainty_colors
        else:
            base = self._painted()
        if self.lit is None:
            return base
        total = base[:, 0] + base[:, 1].astype(np.uint16) + base[:, 2]  # the sum of three uint8 would overflow
        faded = (np.float32(FADE_SHARE * FADE_GREY) + np.float32((1 - FADE_SHARE) / 3) * total).astype(np.uint8)
        return np.where(self._is_lit[self.ids][:, None], base, faded[:, None])

    @cached_property
    def instances(self) -> Instances:
        """The instances as a table, each with its best words."""
        return instance_table(self.scene, text_features=self._text_features, words=MAX_WORDS_SHOWN)

    def legend(self) -> list[tuple[str, Sequence[int], int]]:
        """(name, RGB, points), the most frequent first and unlabelled points last; colors are gray if the mode does not
        show labels."""
        if self.mode == "changes":
            points = np.bincount(self._change_of[self.ids], minlength=len(CHANGES)).tolist()
            return [(name, color, count) for (name, color), count in zip(CHANGES.items(), points, strict=True) if count]
        counts = np.bincount(self.label_of[self.ids] + 1, minlength=len(self.names) + 1).tolist()
        by_label = label_colors(np.arange(len(self.names))).tolist()
        colors = by_label if self.mode == "labels" else [NO_LABEL] * len(self.names)
        rows = [row for row in zip(self.names, colors, counts[1:], strict=True) if row[2]]
        return [*sorted(rows, key=lambda row: -row[2]), *([("unknown", NO_LABEL, counts[0])] if counts[0] else [])]

    def name_of(self, instance: int) -> str:
        """What an instance is called: its label, else its best word, else its number."""
        if self.label_of[instance] >= 0:
            return self.names[self.label_of[instance]]
        words = self.instances[instance].words
        return f"{words[0][0]}?" if words else f"instance {instance}"

    def _painted(self) -> NDArray[np.uint8]:
        """Colors of labels, changes or instances, shaded by the brightness of the points' own colors."""
        count = len(self.scene.cloud.instances)
        table = np.full((len(self.label_of), 3), NO_LABEL, np.uint8)
        table[:count] = label_colors(np.arange(count))
        if self.mode == "changes":
            table = np.array([*CHANGES.values()], np.uint8)[self._change_of]
        elif self.mode == "labels":
            table[~self._is_lit] = NO_LABEL  # lit instances stand out in their own color even if no label fits them
            labelled = self.label_of >= 0
            table[labelled] = label_colors(self.label_of[labelled])
        return np.minimum(table[self.ids] * self._shade, 255).astype(np.uint8)

    @property
    def _is_lit(self) -> NDArray[np.bool_]:
        lit = np.zeros(len(self.label_of), bool)
        lit[sorted(self.lit or ())] = True
        return lit

    @cached_property
    def _photo(self) -> NDArray[np.uint8]:
        return np.full(self.xyz.shape, 200, np.uint8) if self.rgb is None else self.rgb

    @cached_property
    def _certainty_colors(self) -> NDArray[np.uint8]:
        certainty = self.scene.certainty_at(self.xyz)
        return certainty_colors(np.zeros(len(self.xyz)) if certainty is None else certainty)

    @cached_property
    def _shade(self) -> NDArray[np.float32]:
        light = (self._photo / 255) @ LUMINANCE
        return (MIN_SHADE + (MAX_SHADE - MIN_SHADE) * light).astype(np.float32)[:, None]

    # What is answered -----------------------------------------------------------------------------------------------

    def ask(self, text: str) -> Answer:
        """Light the instances that a word fits; all of them for an empty text or an unknown word."""
        word, self.lit = text.strip(), None
        if not word:
            own = self.scene.vocabulary.names if self.scene.vocabulary else ()
            examples = ", ".join([*own[:MAX_HINT_WORDS], "..."] if len(own) > MAX_HINT_WORDS else own)
            stored = [f"stored words: {examples}"] if own else []
            return Answer("", (*stored, "click an object to identify it"))
        try:
            selection = select(self.scene, word, text_features=self._text_features)
        except (OgPointcloudError, MissingExtraError) as error:
            return Answer(f"“{printable(word, MAX_WORD_CHARACTERS)}”", (str(error),))
        # If nothing fits, the set is empty: all points are faded, and the closest instances are listed.
        self.lit = set(selection.instances)
        total = counted(len(selection), "instance")
        fits = f"fits {len(self.lit)} of {total}" if self.lit else "fits no instance; closest:"
        shown = selection[: min(max(len(self.lit), 5), MAX_MATCHES_SHOWN)]
        bars = tuple((self._match_text(match), match.score) for match in shown)
        return Answer(word, (fits,), bars, meaning(selection.calibrated))

    def choose(self, instance: int) -> Answer:
        """Light one instance and describe it."""
        row = self.instances[instance]
        self.lit = {instance}
        lines = [f"instance {instance} · {counted(row.points, 'point')} · {counted(row.views, 'view')}"]
        if row.oriented_box is not None and row.centroid is not None:
            size = " x ".join(f"{length:.3g}" for length in row.oriented_box.size)
            lines.append(f"size {size} · at {', '.join(map(coordinate, row.centroid))}")
        note = meaning_of(row, self.scene.chooser.bank is not None)
        title = self.names[self.label_of[instance]] if self.label_of[instance] >= 0 else "unknown"
        return Answer(title, tuple(lines), row.words, note)

    def click(self, eye: NDArray[np.float64], direction: NDArray[np.float64], focal_px: float) -> Answer:
        """Light the instance seen from ``eye`` along a direction; describe it and give the certainty of its point.

        eye, direction: (3,), world. focal_px: focal length of the window that was clicked in.
        """
        # A small camera along the click; its up direction does not affect the middle pixel.
        view = Viewpoint(eye, eye + direction, np.eye(3)[np.abs(direction).argmin()])
        hit = pick(self.scene, view.camera(CLICK_PX, CLICK_PX, focal_px), (CLICK_PX / 2, CLICK_PX / 2))
        if not hit.found:
            self.lit = None
            return Answer(str(hit), ("no instance",))
        answer = self.choose(hit.instance)
        certainty = self.scene.certainty
        if certainty is None or hit.point is None:
            return answer
        line = f"certainty that the point belongs to it: {certainty[hit.point]:.0%}"
        return Answer(answer.title, (*answer.lines, line), answer.bars, answer.note)

    def _match_text(self, match: Match) -> str:
        better = f" ({match.rival} fits better)" if not match.fits and match.rival else ""
        return f"instance {match.instance}{better}"


def _known_changes(cloud: LabelledCloud) -> NDArray[np.intp] | None:
    """(K,) row of `CHANGES` of each instance of a map; None after fewer than two visits."""
    record = MapRecord.of(cloud)
    if len(record.visits) < 2:
        return None
    names = list(CHANGES)
    last_visit = record.visits[-1].stamp
    change = np.full(len(cloud.instances), names.index("as it was"))
    change[[k for k, stamp in record.last_seen.items() if stamp < last_visit]] = names.index(
        "not seen at the last visit"
    )
    change[list(record.moved_from)] = names.index("moved to here")
    return change


def meaning_of(row: Instance, calibrated: bool) -> str:
    """What an instance's scores are, or why it has none."""
    if row.state == NO_FEATURE:
        return "no mask gave it a feature: it is unknown for every word"
    return meaning(calibrated) if row.words else "the scene stores no words to name it"


def meaning(calibrated: bool) -> str:
    """The page's explanation of its scores."""
    return "probability" if calibrated else "cosine: how similar, not how probable"
