"""The paper's three ablations (Sec. 4.4: losses, codebook, association) on a capture with known labels.

Every row is one method, scored as the paper scores ScanNet: mean IoU and recall over the labelled points; a point
without a label is a miss. Where background is known, the strict score, in which a class called there is wrong, and the
share of it that was called stand beside. A row changes one thing of the *literal* method: features by Eq. 1 and 2 from
random ones, two levels of k1 = 64 and k2 = 5 clusters (Eq. 3), masks accepted by Eq. 5, and points that keep their
leaf. Rows beside the paper's: what this library adds (a better start, k from the scene, points settled by all views),
how the authors' code accepts masks, and what is reached without learning (grouping).

    fast   from the mask table (features.py, codebook.py): stages that rows share run once
    paper  by rendering (paper.py), with its schedule shortened to a stated share

Seconds are those of all stages a row needs after geometry and visibility, which every row needs; a stage that several
rows share is timed once and counts in each.
"""

from __future__ import annotations

import csv
import io
import json
import os
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.cloud import InstanceTable, Vocabulary
from og_pointcloud.errors import FeatureSpaceError, MissingExtraError, OgPointcloudError, SceneError
from og_pointcloud.evaluate.metrics import score_labels
from og_pointcloud.evaluate.plots import require_matplotlib
from og_pointcloud.evaluate.truth import Truth
from og_pointcloud.formats.atomic import replacing
from og_pointcloud.rendering.geometry import thinned
from og_pointcloud.scene import Scene
from og_pointcloud.settings import CodebookSettings, FeatureSettings, FitSettings, MatchingSettings, PaperSettings
from og_pointcloud.text.text_features import read_text_features

try:
    from og_pointcloud.fitting.fit import prepare
    from og_pointcloud.fitting.labellers import Prepared, by_features, by_grouping, mask_means
    from og_pointcloud.fitting.learned.codebook import two_level_codebook
    from og_pointcloud.fitting.learned.instance_features import learn_features
    from og_pointcloud.fitting.learned.matching import alone_evidence, match_masks, visible_evidence
    from og_pointcloud.journal import Journal
except ImportError as error:
    raise MissingExtraError("scipy and numba", "fit") from error

__all__ = [
    "AblationRow",
    "Case",
    "ablate",
    "average",
    "cases",
    "check_subject",
    "plot",
    "read_vocabulary",
    "references",
    "write_csv",
]

Value = TypeVar("Value")

LITERAL = FitSettings(
    mode="fast",
    features=FeatureSettings(start="random"),
    codebook=CodebookSettings(k1=64, k2=5, position_weight=2.0),
    matching=MatchingSettings(threshold=0.02, settle=False),
)
"""What the rows of base "fast" change. A product is smaller than either factor: at the usual thresholds of 0.1 or 0.2
"both" would lose to them for that reason alone, so this one only keeps off what hardly touches. The published weight of
positions is per metre (1.0 on ScanNet): about 5 per extent of a room, and no use for a table top."""
PUBLISHED_MIOU = {
    "losses": {"inter only": 0.3524, "intra only": 0.2589, "both": 0.3829},
    "codebook": {
        "one level, k = 64": 0.2868,
        "one level, k = 320": 0.1461,
        "one level, k = 64, xyz": 0.3204,
        "one level, k = 320, xyz": 0.1520,
        "two levels": 0.3027,
        "two levels, xyz": 0.3829,
    },
    "association": {"IoU only, alone": 0.3528, "feature only, alone": 0.3401, "both, alone": 0.3829},
}
"""Of the same row in the paper: 10 classes of ScanNet. Other data: the order is to be compared, not the size."""
SHORT_BAR = 0.15
"""The number stands beside a bar that is shorter than this."""
LABEL_WIDTH = 4.0
"""A label takes the room of this factor of seconds."""
COLORS = {"losses": "#4c72b0", "codebook": "#dd8452", "association": "#55a868", "reference": "#8c8c8c"}


@dataclass(frozen=True)
class Case:
    """One row to be: a method, and in words what it changes of the literal one.

    evidence: how Eq. 5 sees an instance, rendered alone or visible among the others (base "paper": settings.paper).
    """

    table: Literal["losses", "codebook", "association", "reference"]
    name: str
    differs: str
    settings: FitSettings
    evidence: Literal["visible", "alone"] = "visible"

    @property
    def method(self) -> str:
        """The road taken; of mode "paper" with the share of its schedule."""
        mode = self.settings.mode
        return f"paper, {self.settings.paper.schedule_share:.3g} of its schedule" if mode == "paper" else mode


@dataclass(frozen=True)
class AblationRow:
    """One row, averaged over ``runs`` seeds and over captures.

    miou, macc, unknown_share: over the labelled points (metrics.Score). strict_miou: with a class called on known
    background as wrong; background_called: the share of it that was. Both None where no background is known.
    miou_spread: standard deviation of one run's miou (mean over captures); None for a single run.
    seconds: of all stages after visibility. clusters: leaves, or instances. settings: what the case changes.
    """

    table: str
    name: str
    method: str
    differs: str
    captures: str
    runs: int
    miou: float
    macc: float
    unknown_share: float
    miou_spread: float | None
    strict_miou: float | None
    background_called: float | None
    seconds: float
    clusters: float
    settings: dict[str, Any] = field(repr=False)

    @property
    def published_miou(self) -> float | None:
        """Of the same row in the paper, on its data."""
        return PUBLISHED_MIOU.get(self.table, {}).get(self.name)


@dataclass(frozen=True)
class _Outcome:
    instance_ids: NDArray[np.int32]
    instances: InstanceTable
    seconds: float
    clusters: int


def cases(base: Literal["fast", "paper"] = "fast", schedule_share: float = 0.05) -> list[Case]:
    """The rows of the three tables and those beside them, in the paper's order."""
    if base == "paper":
        paper = PaperSettings(schedule_share=schedule_share)
        return [*_paper_cases(FitSettings(mode="paper", paper=paper)), *references()]
    features, book, matching = LITERAL.features, LITERAL.codebook, LITERAL.matching
    masks = replace(features, start="masks")

    def row(table: Any, name: str, differs: str, evidence: Any = "visible", **changes: Any) -> Case:
        return Case(table, name, differs, replace(LITERAL, **changes), evidence)

    rows = [
        row("losses", "inter only", "without Eq. 1", features=replace(features, intra=False)),
        row("losses", "intra only", "without Eq. 2", features=replace(features, inter=False)),
        row("losses", "both", "nothing: the literal method"),
        row("losses", "both, from masks", "features start at random directions of their masks", features=masks),
        row("losses", "none, from masks", "that start alone, no loss", features=replace(masks, max_steps=0)),
    ]
    for positions in (False, True):
        for k in (64, 320):
            changed = replace(book, levels=1, k1=k, k2=None, positions=positions)
            name = f"one level, k = {k}{', xyz' if positions else ''}"
            rows.append(row("codebook", name, f"one level of {k}, positions {positions}", codebook=changed))
    rows += [
        row("codebook", "two levels", "coarse clusters without positions", codebook=replace(book, positions=False)),
        row("codebook", "two levels, xyz", "nothing: the literal method"),
        row(
            "codebook", "two levels, xyz, adaptive k", "k1, k2 from the scene", codebook=replace(book, k1=None, k2=None)
        ),
    ]
    for evidence in ("visible", "alone"):
        for score, name in (("iou", "IoU only"), ("feature", "feature only"), ("both", "both")):
            changed = replace(matching, score=score)
            rows.append(
                row("association", f"{name}, {evidence}", f"{name}, instances {evidence}", evidence, matching=changed)
            )
    strict, settled = PaperSettings().matching, replace(matching, settle=True)
    rows += [
        row("association", "both, published acceptance", "score over 0.2 in two views, all alike", matching=strict),
        row("association", "both, visible, settled", "all views settle each point", matching=settled),
    ]
    return [*rows, Case("reference", "fast", "this library's settings", FitSettings(mode="fast")), *references()]


def _paper_cases(literal: FitSettings) -> list[Case]:
    paper = literal.paper
    changes: list[tuple[Any, str, str, dict[str, Any]]] = [
        ("losses", "inter only", "without Eq. 1", {"intra": False}),
        ("losses", "intra only", "without Eq. 2", {"inter": False}),
        ("losses", "both", "nothing: the published method", {}),
        ("codebook", "one level, k = 64", "k2 = 1, no positions", {"k2": 1, "position_weight": 0.0}),
        (
            "codebook",
            "one level, k = 320",
            "k1 = 320, k2 = 1, no positions",
            {"k1": 320, "k2": 1, "position_weight": 0.0},
        ),
        ("codebook", "one level, k = 64, xyz", "k2 = 1", {"k2": 1}),
        ("codebook", "one level, k = 320, xyz", "k1 = 320, k2 = 1", {"k1": 320, "k2": 1}),
        ("codebook", "two levels", "coarse clusters without positions", {"position_weight": 0.0}),
        ("codebook", "two levels, xyz", "nothing: the published method", {}),
    ]
    for evidence in ("alone", "visible"):
        for score, name in (("iou", "IoU only"), ("feature", "feature only"), ("both", "both")):
            changed = {"association": evidence, "matching": replace(paper.matching, score=score)}
            changes.append(("association", f"{name}, {evidence}", f"{name}, instances {evidence}", changed))
    return [
        Case(table, name, differs, replace(literal, paper=replace(paper, **changed)))
        for table, name, differs, changed in changes
    ]


def references() -> list[Case]:
    """What every base ends in: the road without learning."""
    return [Case("reference", "grouping", "masks joined by shared points, no learning", FitSettings(mode="grouping"))]


def ablate(
    scene: Scene,
    truth: Truth,
    vocabulary: Vocabulary,
    *,
    base: Literal["fast", "paper"] = "fast",
    seeds: Sequence[int] = (0,),
    schedule_share: float = 0.05,
    name: str = "capture",
    prepared: Prepared | None = None,
    only: Iterable[Case] | None = None,
    progress: bool = True,
) -> list[AblationRow]:
    """All rows of one capture, each averaged over the seeds.

    vocabulary: of the masks' encoder; its names are asked, those that the truth lacks are wrong answers.
    schedule_share: of base "paper", which at its published length takes hours on a CPU. prepared: what `fit.prepare`
    made of the scene. only: these cases (default: `cases`). progress: a bar where stderr is a terminal.

    Raises SceneError where the truth is of another cloud, FeatureSpaceError where the vocabulary is as wide as no mask.
    """
    check_subject(scene, truth, vocabulary)
    if not seeds:
        raise OgPointcloudError("0 seeds; expected at least one")
    todo = list(only) if only is not None else cases(base, schedule_share)
    journal = Journal(progress)
    prepared = prepared or prepare(scene, journal=journal)
    runs: dict[int, list[AblationRow]] = {index: [] for index in range(len(todo))}
    stages: dict[int, _Stages] = {}
    for seed, index in journal.steps([(seed, index) for seed in seeds for index in range(len(todo))], name):
        stages = {seed: stages[seed]} if seed in stages else {seed: _Stages(scene, prepared, seed)}
        outcome = stages[seed].run(todo[index])
        runs[index].append(_scored(todo[index], outcome, truth, vocabulary, name))
    return [_over_seeds(rows) for rows in runs.values()]


class _Stages:
    """The stages of one scene and seed. What several cases share runs once, and keeps its time."""

    def __init__(self, scene: Scene, prepared: Prepared, seed: int) -> None:
        self.scene, self.prepared, self.seed = scene, prepared, seed
        self.views = [thinned(view, prepared.stride) for view in scene.views]
        self._done: dict[Any, tuple[Any, float]] = {}

    def run(self, case: Case) -> _Outcome:
        """Labels and cost of a case."""
        settings = replace(case.settings, seed=self.seed)
        if settings.mode == "grouping" or (settings.mode == "fast" and settings.matching.settle):
            road = by_grouping if settings.mode == "grouping" else by_features
            journal = Journal(progress=False)
            labelling = road(self.scene, self.prepared, settings, journal)
            seconds = sum(stage["seconds"] for stage in journal.stages)
            return _Outcome(labelling.instance_ids, labelling.instances, seconds, len(labelling.instances))
        if settings.mode == "paper":
            return self._paper(settings.paper)
        learned, first = self._once(
            settings.features, lambda: learn_features(self.prepared.table, settings.features, self.seed)
        )
        book, second = self._once(
            (settings.features, settings.codebook),
            lambda: two_level_codebook(
                learned.features, self.scene.points.xyz, learned.seen, self.prepared.table, settings.codebook, self.seed
            ),
        )
        outcome = self._matched(
            self.prepared,
            (settings.features, settings.codebook),
            case.evidence,
            settings.matching,
            (book.leaf, book.leaf_centres, learned.features),
        )
        return replace(outcome, seconds=outcome.seconds + first + second)

    def _paper(self, paper: PaperSettings) -> _Outcome:
        from og_pointcloud.fitting.learned.paper import train_codebook, train_features

        prepared = self._full_gaussians()
        scene = (prepared.gaussians, self.views, prepared.near)
        # Stages are shared by cases whose settings differ in what comes after them only.
        later = PaperSettings()
        of_codebook = replace(
            paper, association=later.association, matching=later.matching, schedule_share=paper.schedule_share
        )
        of_features = replace(of_codebook, k1=later.k1, k2=later.k2, position_weight=later.position_weight)
        trained, first = self._once(of_features, lambda: train_features(*scene, paper, self.seed))
        book, second = self._once(
            ("codebook", of_codebook), lambda: train_codebook(*scene, trained.features, paper, self.seed)
        )
        used, leaf = np.unique(book.leaf[book.leaf >= 0], return_inverse=True)
        ids = np.full(len(book.leaf), -1, np.int32)
        ids[book.leaf >= 0] = leaf
        outcome = self._matched(
            prepared,
            of_codebook,
            paper.association,
            paper.matching,
            (ids, book.centres[used], trained.features),
        )
        return replace(outcome, seconds=outcome.seconds + first + second)

    def _full_gaussians(self) -> Prepared:
        """The scene as mode "paper" prepares it; the others' Gaussians are thin."""
        return self._once("full", lambda: prepare(self.scene, FitSettings(mode="paper"), Journal(progress=False)))[0]

    def _matched(
        self,
        prepared: Prepared,
        key: Any,
        kind: Literal["visible", "alone"],
        matching: MatchingSettings,
        clusters: tuple[NDArray[np.int32], NDArray[np.float32], NDArray[np.float32]],
    ) -> _Outcome:
        """Eq. 5 for clusters: (leaf of each point, centre of each leaf, feature of each point)."""
        leaf, centres, features = clusters

        def evidence() -> Any:
            shown = mask_means(prepared.table, features)
            if kind == "visible":
                return visible_evidence(prepared.table, leaf, centres, shown)
            return alone_evidence(prepared.gaussians, self.views, prepared.near, leaf, centres, shown)

        found, first = self._once((key, kind), evidence)
        start = time.perf_counter()
        matched = match_masks(prepared.table, leaf, found, matching)
        seconds = first + time.perf_counter() - start
        return _Outcome(leaf, matched.instances, seconds, len(centres))

    def _once(self, key: Any, compute: Callable[[], Value]) -> tuple[Value, float]:
        if key not in self._done:
            start = time.perf_counter()
            value = compute()
            self._done[key] = value, time.perf_counter() - start
        return self._done[key]


def check_subject(scene: Scene, truth: Truth, vocabulary: Vocabulary) -> None:
    """SceneError where the truth is of another cloud, FeatureSpaceError where names and masks differ in width."""
    if len(truth.cls) != len(scene.points):
        raise SceneError(
            f"the truth is of {len(truth.cls)} points, the cloud has {len(scene.points)}; expected one each"
        )
    width = vocabulary.vectors.shape[1]
    if scene.feature_width not in (0, width):
        raise FeatureSpaceError(
            f"the names' vectors have width {width}, the masks' {scene.feature_width}: take the encoder of the masks"
        )


def _scored(case: Case, outcome: _Outcome, truth: Truth, vocabulary: Vocabulary, name: str) -> AblationRow:
    """A case's labels against the truth. A name that the truth lacks is a wrong answer, not an unknown."""
    labels = _labels(outcome, vocabulary)
    called = truth.class_of(labels, vocabulary.names)
    score = score_labels(called, truth.cls, scored=truth.scored)
    strict = truth.score(labels, vocabulary.names) if truth.background is not None else None
    return AblationRow(
        case.table, case.name, case.method, case.differs, name, 1, score.miou, score.macc, score.unknown_share, None,
        strict.miou if strict else None, strict.background_called if strict else None, outcome.seconds,
        outcome.clusters, asdict(case.settings) | {"evidence": case.evidence},
    )  # fmt: skip


def _labels(outcome: _Outcome, vocabulary: Vocabulary) -> NDArray[np.int64]:
    """(n,) the best word of each point's instance, -1 where it has none, as `segment` answers."""
    table = outcome.instances
    vectors = vocabulary.vectors / np.linalg.norm(vocabulary.vectors, axis=1, keepdims=True)
    scores = np.full((len(table) + 1, len(vectors)), -np.inf)  # the last row is for ids below 0
    np.maximum.at(scores, table.descriptor_instance, table.descriptors @ vectors.T)
    best = np.where(np.isfinite(scores).any(axis=1), scores.argmax(axis=1), -1)
    return best[np.maximum(outcome.instance_ids, -1)]


def _over_seeds(rows: list[AblationRow]) -> AblationRow:
    spread = float(np.std([row.miou for row in rows], ddof=1)) if len(rows) > 1 else None
    return replace(_mean(rows), runs=len(rows), miou_spread=spread)


def average(of_captures: Sequence[Sequence[AblationRow]]) -> list[AblationRow]:
    """The mean over captures of each row, in the order of the first capture's."""
    averages = []
    for rows in map(list, zip(*of_captures, strict=True)):
        spreads = [row.miou_spread for row in rows]
        known = [spread for spread in spreads if spread is not None]
        spread = float(np.sqrt(np.square(known).sum()) / len(rows)) if len(known) == len(rows) else None
        captures = f"mean of {len(rows)}" if len(rows) > 1 else rows[0].captures
        averages.append(replace(_mean(rows), captures=captures, miou_spread=spread))
    return averages


def _mean(rows: Sequence[AblationRow]) -> AblationRow:
    """The first row with the means of all numbers; of those that only some have, over these."""
    means: dict[str, float | None] = {}
    for name in ("miou", "macc", "unknown_share", "strict_miou", "background_called", "seconds", "clusters"):
        known = [getattr(row, name) for row in rows if getattr(row, name) is not None]
        means[name] = float(np.mean(known)) if known else None
    return replace(rows[0], **means)  # pyright: ignore[reportArgumentType]


def read_vocabulary(folder: str | os.PathLike[str], feature_space: str) -> Vocabulary:
    """The names of a capture's ``text_features.npz``; FeatureSpaceError unless they are of the masks' feature space."""
    path = Path(folder) / "text_features.npz"
    if not path.is_file():
        raise FeatureSpaceError(
            f"{path} is not a file; an ablation asks for its names: 'names', 'vectors' and 'feature_space' of the "
            "masks' encoder. Without one, take a made room: --room 1"
        )
    vocabulary, own = read_text_features(path)
    if own != feature_space:
        raise FeatureSpaceError(
            f"{path} is of feature space '{own}', the masks are of '{feature_space}': encode the names with their model"
        )
    return vocabulary


def write_csv(rows: Iterable[AblationRow], path: str | os.PathLike[str]) -> Path:
    """One line a row, settings as JSON in the last column; written whole or not at all."""
    path = Path(path)
    text = io.StringIO()
    names = [*AblationRow.__dataclass_fields__]
    names.insert(names.index("settings"), "published_miou")
    lines = csv.DictWriter(text, names, lineterminator="\n")
    lines.writeheader()
    for row in rows:
        values = {name: getattr(row, name) for name in names}
        numbers = {name: f"{value:.6g}" for name, value in values.items() if isinstance(value, float)}
        lines.writerow(values | numbers | {"settings": json.dumps(row.settings)})
    with replacing(path) as file:
        file.write(text.getvalue().encode())
    return path


def plot(rows: Sequence[AblationRow], path: str | os.PathLike[str], title: str = "") -> Path:
    """A PNG: bars of mIoU for each table, and the error (1 - mIoU) of every row against its seconds."""
    path = Path(path)
    tables = [name for name in ("losses", "codebook", "association") if any(row.table == name for row in rows)]
    references = [row for row in rows if row.table == "reference"]
    figure = require_matplotlib()(figsize=(13, 8.5), layout="constrained")
    top, bottom = figure.subfigures(2, 1, height_ratios=[1.1, 1])
    for axes, table in zip(np.atleast_1d(top.subplots(1, max(len(tables), 1))), tables, strict=False):
        _bars(axes, [row for row in rows if row.table == table], references, table)
    _error_against_seconds(bottom.subplots(), rows)
    figure.suptitle(title or rows[0].captures, fontsize=13)
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=120)
    with replacing(path) as file:
        file.write(data.getvalue())
    return path


def _bars(axes: Any, rows: Sequence[AblationRow], references: Sequence[AblationRow], table: str) -> None:
    places = np.arange(len(rows))
    spread = [row.miou_spread or 0 for row in rows]
    axes.barh(places, [row.miou for row in rows], 0.68, xerr=spread, color=COLORS[table], ecolor="#333333")
    for place, row in zip(places, rows, strict=True):
        short = row.miou < SHORT_BAR
        look: Any = {"ha": "left", "color": "#333333"} if short else {"ha": "right", "color": "white"}
        beside = 0.01 + (row.miou_spread or 0)
        axes.text(row.miou + (beside if short else -beside), place, f"{row.miou:.3f}", va="center", fontsize=8, **look)
    for reference, style in zip(references, ("--", ":") if len(references) == 2 else ("--",), strict=False):
        axes.axvline(
            reference.miou, color=COLORS["reference"], linestyle=style, label=f"{reference.name} {reference.miou:.3f}"
        )
    axes.set_yticks(places, [_named(row, rows) for row in rows], fontsize=8)
    axes.invert_yaxis()
    axes.set(xlim=(0, 1), xlabel="mIoU", title=table)
    axes.spines[["top", "right"]].set_visible(False)
    if references:
        axes.legend(fontsize=7, loc="lower center", bbox_to_anchor=(0.5, -0.27), ncols=2, frameon=False)


def _named(row: AblationRow, rows: Sequence[AblationRow]) -> str:
    """Its name, with the method where both fast and paper rows are shown."""
    methods = {other.method for other in rows if other.table != "reference"}
    return f"{row.name} ({row.method.split(',')[0]})" if len(methods) > 1 else row.name


def _error_against_seconds(axes: Any, rows: Sequence[AblationRow]) -> None:
    """Every row as a dot; those that no other row beats in both are joined, they and the best of a table named."""
    for table, color in COLORS.items():
        own = [row for row in rows if row.table == table]
        if own:
            axes.scatter([r.seconds for r in own], [1 - r.miou for r in own], s=36, color=color, label=table, zorder=3)
    best = [row for row in rows if not any(o.seconds < row.seconds and o.miou > row.miou for o in rows)]
    best.sort(key=lambda row: row.seconds)
    axes.step([r.seconds for r in best], [1 - r.miou for r in best], where="post", color="#bbbbbb", zorder=1)
    tables = dict.fromkeys(row.table for row in rows)
    leaders = [max((row for row in rows if row.table == table), key=lambda row: row.miou) for table in tables]
    named = sorted(best + [row for row in leaders if row not in best], key=lambda row: (row.seconds, row.miou))
    place, height = 0.0, 5
    for row in named:
        # Labels that would run into each other are stacked.
        height = height + 10 if place and row.seconds < LABEL_WIDTH * place else 5
        place = max(row.seconds, 1e-3)
        label = row.name if row.table == "reference" else f"{row.table}: {_named(row, rows)}"
        axes.annotate(label, (row.seconds, 1 - row.miou), (6, height), textcoords="offset points", fontsize=8)
    axes.set(
        xscale="log",
        ylim=(0, 1.08 - min(row.miou for row in rows)),
        xlabel="seconds after visibility (log)",
        ylabel="error, 1 - mIoU",
    )
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.xaxis.set_minor_formatter(lambda value, _: f"{value:g}" if f"{value:e}"[0] in "25" else "")
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1, 1), frameon=False)
