"""How well labels are chosen, and how honest their probabilities are: one row per capture and method.

    python examples/benchmark_choosing.py CAPTURE [CAPTURE ...] --words WORDS.npz -o FOLDER [--fitted FOLDER]

A capture has ``gt.npz`` (for scoring alone) and ``text_features.npz``, see docs/scores.md. WORDS.npz holds
text vectors of the same encoder: arrays ``<set>_names`` and ``<set>_text``; --bank names the sets of the word bank,
--absent the set that absent words are drawn from. A capture with a simulated feature space gets simulated words.

Absent words: 50 drawn with a fixed seed, 40 times, from those whose centred vector has a cosine below 0.5 with every
label of the truth (armchair and sofa have 0.54, mug and cup 0.61, chair and bench 0.48); none of them is in the bank,
up to words that two sets share.

Columns: miou, unknown and background as ``eval capture`` has them, with all labels asked; miou_beside with the absent
words asked at once with the labels; called_absent: of the points of instances, the share that gets a label when
absent words alone are asked; ece: expected calibration error over labelled points, ten bins, the labels asked;
ece_all: the same with as many points again that are asked absent words alone; unobserved_called must be 0.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import og_pointcloud as og
from og_pointcloud.ask.choosing import Choice, Chooser
from og_pointcloud.cloud import UNOBSERVED, LabelledCloud, WordBank
from og_pointcloud.errors import MissingExtraError, OgPointcloudError
from og_pointcloud.evaluate.truth import read_truth
from og_pointcloud.settings import ChoosingSettings

ABSENT_WORDS, DRAWS, DRAWS_BESIDE, BINS = 50, 40, 5, 10
RELATED = 0.5
"""Centred cosine from which a word may well be said of a present thing."""
CLIP_SCALE = 100.0
"""Factor of the cosines in CLIP's own softmax."""

Answers = Callable[[NDArray[np.float32]], Choice]


@dataclass(frozen=True)
class Row:
    """One capture asked in one way; the module's docstring explains the columns."""

    capture: str
    method: str
    miou: float
    unknown: float
    background_called: float | None
    miou_beside: float
    called_absent: float
    called_absent_worst: float
    ece: float
    ece_all: float
    unobserved_called: int


@dataclass(frozen=True)
class Case:
    """A fitted capture with its truth, the labels asked, and the draws of absent words (each (50, D))."""

    folder: Path
    cloud: LabelledCloud
    names: tuple[str, ...]
    texts: NDArray[np.float32]
    bank: NDArray[np.float32]
    absent: tuple[NDArray[np.float32], ...]
    negatives: NDArray[np.float32]


def load_case(folder: Path, fitted: Path | None, words: dict[str, NDArray], bank: list[str], absent: str) -> Case:
    """Fit the capture, or read what an earlier run wrote to ``fitted``, and draw the words."""
    vocabulary, space = og.read_text_features(folder / "text_features.npz")
    texts = unit(vocabulary.vectors)
    if space.startswith("simulated"):
        made = made_words(texts, 1200, np.random.default_rng(0))
        bank_vectors, pool, negatives = made[:800], made[800:], made[:4]
    else:
        bank_vectors = unit(np.concatenate([words[f"{name}_text"] for name in bank]))
        pool = unit(words[f"{absent}_text"])
        negatives = canonical(words)
    present = texts[present_classes(folder)]
    middle = bank_vectors.mean(axis=0)
    related = unit(pool - middle) @ unit(present - middle).T
    pool = pool[related.max(axis=1) < RELATED]
    draws = tuple(
        pool[np.random.default_rng(seed).choice(len(pool), min(ABSENT_WORDS, len(pool)), replace=False)]
        for seed in range(DRAWS)
    )
    return Case(folder, fitted_cloud(folder, fitted), vocabulary.names, texts, bank_vectors, draws, negatives)


def fitted_cloud(folder: Path, fitted: Path | None) -> LabelledCloud:
    """The capture's labelled cloud, kept as .ogpc in ``fitted``."""
    bundle = None if fitted is None else fitted / f"{folder.name}.ogpc"
    if bundle is not None and bundle.is_file():
        return og.read_bundle(bundle).cloud
    cloud = og.fit(og.read_capture(folder), progress=False)
    if bundle is not None:
        bundle.parent.mkdir(parents=True, exist_ok=True)
        og.write_bundle(cloud, bundle)
    return cloud


def present_classes(folder: Path) -> NDArray[np.intp]:
    """Rows of the truth's names, which are those of text_features.npz, that some point has."""
    truth = np.load(folder / "gt.npz")
    names, asked = [str(name) for name in truth["names"]], og.read_text_features(folder / "text_features.npz")[0].names
    return np.array([asked.index(names[c]) for c in np.unique(truth["cls"][truth["cls"] >= 0]) if names[c] in asked])


def canonical(words: dict[str, NDArray]) -> NDArray[np.float32]:
    """LERF's negatives, as far as any set has them."""
    sets = [key.removesuffix("_names") for key in words if key.endswith("_names") and f"{key[:-6]}_text" in words]
    found = {str(n).lower(): v for s in sets for n, v in zip(words[f"{s}_names"], words[f"{s}_text"], strict=True)}
    rows = [found[name] for name in ("object", "things", "stuff", "texture") if name in found]
    return unit(np.array(rows)) if rows else np.zeros((0, 1), np.float32)


def made_words(texts: NDArray[np.float32], count: int, random: np.random.Generator) -> NDArray[np.float32]:
    """Words of a simulated encoder: what its texts share, and as much of a random direction as each has of its own."""
    middle = texts.mean(axis=0)
    own = np.linalg.norm(texts - middle, axis=1).mean()
    return unit(middle + own * unit(random.normal(size=(count, texts.shape[1]))))


def methods(case: Case) -> dict[str, Answers]:
    """Ways to choose, from texts (L, D) to a Choice."""
    table, bank = case.cloud.instances, WordBank(case.bank)
    plain = Chooser(table)

    def with_bank(bank: WordBank = bank, **settings: float) -> Answers:
        return Chooser(table, bank, replace(ChoosingSettings(), **settings)).choose  # pyright: ignore[reportArgumentType]

    def clip_softmax(texts: NDArray[np.float32]) -> Choice:
        choice = plain.choose(texts)
        shifted = CLIP_SCALE * (choice.evidence - choice.evidence.max(axis=1, keepdims=True))
        return answer(choice, np.exp(shifted) / np.exp(shifted).sum(axis=1, keepdims=True), threshold=0)

    def lerf(texts: NDArray[np.float32]) -> Choice:
        choice = plain.choose(texts, case.negatives)
        return answer(choice, choice.table, threshold=0.5)

    def closest_pair(texts: NDArray[np.float32]) -> Choice:
        """Each label with its nearest word of the bank, as an ensemble of names for want of an encoder."""
        middle = bank.mean
        cosines = unit(texts - middle) @ unit(bank.vectors - middle).T
        alias = np.where((cosines.max(axis=1) >= 0.6)[:, None], bank.vectors[cosines.argmax(axis=1)], unit(texts))
        return Chooser(table, bank).choose(unit(unit(texts) + alias))

    some = np.random.default_rng(0).permutation(len(case.bank))
    chosen: dict[str, Answers] = {"argmax, CLIP's softmax": clip_softmax}
    if len(case.negatives):
        chosen["LERF relevancy"] = lerf
    chosen |= {
        "bank": with_bank(),
        "bank, images not centred": with_bank(same_look=1e-6),
        "bank, fixed sharpness": fixed_sharpness(table, bank),
        "bank of 300": with_bank(WordBank(case.bank[some[:300]])),
        "bank of 100": with_bank(WordBank(case.bank[some[:100]])),
        "bank, two names a label": closest_pair,
        "bank, one descriptor": Chooser(one_descriptor_each(table), bank).choose,
    }
    if len(case.negatives):
        chosen["bank and negatives"] = lambda texts: Chooser(table, bank).choose(texts, case.negatives)
    return chosen


def one_descriptor_each(table: og.InstanceTable) -> og.InstanceTable:
    """The table with the mean of each instance's descriptors, where its views disagreed and left it several."""
    owners, row = np.unique(table.descriptor_instance, return_inverse=True)
    total = np.zeros((len(owners), table.descriptors.shape[1]), np.float32)
    np.add.at(total, row, table.descriptors)
    return replace(table, descriptors=unit(total), descriptor_instance=owners.astype(np.int32))


def fixed_sharpness(table: og.InstanceTable, bank: WordBank) -> Answers:
    """The rule without what the scene's own best words say."""
    chooser = Chooser(table, bank)
    chooser.sharpness = chooser.settings.sharpness
    return chooser.choose


def answer(choice: Choice, table: NDArray[np.floating], threshold: float) -> Choice:
    """A choice by another table of scores: the largest, where it exceeds the threshold."""
    table = np.where(np.isfinite(table), table, 0).astype(np.float32)
    best = table.argmax(axis=1)
    described = np.isfinite(choice.evidence).any(axis=1)
    top = table[np.arange(len(best)), best]
    fits = described & (top > threshold)
    labels = np.where(fits, best, -1).astype(np.int32)
    return replace(
        choice,
        labels=labels,
        probability=np.where(fits, top, 0),
        unknown=1 - top,
        table=table,
        membership=np.ones_like(choice.membership),
    )  # they know no such thing


def measure(case: Case, method: str, answers: Answers) -> tuple[Row, NDArray[np.float64]]:
    """The row, and (confidence, correct) of the points that ``ece_all`` is over, for a reliability curve."""
    ids = case.cloud.instance_ids
    asked = answers(case.texts)
    labels = asked.at(ids)[0]
    score = read_truth(case.folder).score(labels, case.names)
    beside, called, absent_confidence = [], [], []
    for words in case.absent[:DRAWS_BESIDE]:
        both = answers(np.concatenate([case.texts, words])).at(ids)[0]
        more = (*case.names, *(f"absent {index}" for index in range(len(words))))
        beside.append(read_truth(case.folder).score(both, more).miou)
    points = np.bincount(ids[ids >= 0], minlength=len(case.cloud.instances))
    for words in case.absent:
        alone = answers(words)
        called.append(float(points[alone.labels >= 0].sum() / max(points.sum(), 1)))
        absent_confidence.append(confidence(alone, ids[ids >= 0][:: len(case.absent)])[0])
    present = judged(case, asked)
    # Absent words are wrong wherever they are called; as many points as were judged, from all draws in turn.
    confident = np.concatenate(absent_confidence)
    sample = confident[np.linspace(0, len(confident) - 1, len(present)).astype(int)] if len(confident) else confident
    judgements = np.concatenate([present, np.stack([sample, np.zeros(len(sample))], axis=1)])
    row = Row(
        case.folder.name, method, score.miou, score.unknown_share, score.background_called, float(np.mean(beside)),
        float(np.mean(called)), float(np.max(called)), calibration_error(present), calibration_error(judgements),
        int((labels[ids == UNOBSERVED] >= 0).sum()),
    )  # fmt: skip
    return row, judgements


def confidence(choice: Choice, ids: NDArray[np.int32]) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Of each point of a described instance, the probability of the most probable label, and that label."""
    of_instance = ids[(ids >= 0) & np.isfinite(choice.evidence.max(axis=1, initial=-np.inf))[np.maximum(ids, 0)]]
    sure = choice.table.max(axis=1) * choice.membership
    return sure[of_instance].astype(np.float64), choice.table.argmax(axis=1)[of_instance]


def judged(case: Case, choice: Choice) -> NDArray[np.float64]:
    """(m, 2): confidence and whether right, of points of described instances whose truth is known or is background."""
    truth, ids = np.load(case.folder / "gt.npz"), case.cloud.instance_ids
    known = truth["cls"] >= 0
    if "ratio" in truth.files:
        known &= (truth["ratio"] >= 0.5) & (truth["votes"] >= 2)
    if "background" in truth.files:
        known |= truth["background"]
    keep = known & (ids >= 0) & np.isfinite(choice.evidence.max(axis=1, initial=-np.inf))[np.maximum(ids, 0)]
    probability, label = confidence(choice, ids[keep])
    names = np.array([*map(str, truth["names"]), ""])
    return np.stack([probability, np.array(case.names)[label] == names[truth["cls"][keep]]], axis=1)


def calibration_error(judgements: NDArray[np.float64]) -> float:
    """Expected calibration error: |confidence - share right| per bin of confidence, weighted by its points."""
    return float(sum(abs(b.mean(axis=0) @ (1, -1)) * len(b) for b in binned(judgements)) / max(len(judgements), 1))


def binned(judgements: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """The judgements of each bin of confidence that has any."""
    bins = np.minimum((judgements[:, 0] * BINS).astype(int), BINS - 1)
    return [judgements[bins == b] for b in np.unique(bins)]


def draw_reliability(judgements: dict[str, list[NDArray[np.float64]]], path: Path) -> None:
    """Share right over confidence, captures together and equally, labels and absent words asked."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtraError("matplotlib", "report") from error
    figure = Figure(figsize=(6, 5), layout="constrained")
    axes = figure.add_subplot()
    axes.plot([0, 1], [0, 1], color="0.7", linewidth=1, label="perfect")
    for method, parts in judgements.items():
        even = np.concatenate([part[np.linspace(0, len(part) - 1, 4000).astype(int)] for part in parts if len(part)])
        curve = np.array([(*b.mean(axis=0), len(b)) for b in binned(even)])
        (line,) = axes.plot(curve[:, 0], curve[:, 1], linewidth=1.2, label=method)
        axes.scatter(curve[:, 0], curve[:, 1], s=4 + 200 * curve[:, 2] / len(even), color=line.get_color(), alpha=0.6)
    axes.set(xlabel="probability given", ylabel="share right", xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=130)


def main(arguments: list[str] | None = None) -> None:
    """Measure, print, and write choosing.csv and reliability.png."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path)
    parser.add_argument("--words", type=Path, help="NPZ with <set>_names and <set>_text")
    parser.add_argument("--bank", nargs="+", default=["oid", "o365"], help="sets of the word bank")
    parser.add_argument("--absent", default="lvis", help="set that absent words come from")
    parser.add_argument("--fitted", type=Path, help="folder of .ogpc files of earlier runs")
    parser.add_argument("-o", "--output", type=Path, required=True)
    options = parser.parse_args(arguments)
    words = dict(np.load(options.words)) if options.words else {}
    missing = [name for name in (*options.bank, options.absent) if words and f"{name}_text" not in words]
    if missing:
        raise OgPointcloudError(f"{options.words} has no array '{missing[0]}_text'; it has {', '.join(words)}")
    options.output.mkdir(parents=True, exist_ok=True)
    columns = [field.name for field in fields(Row)]
    print(f"{'capture':<17} {'method':<26}" + "".join(f"{name[:9]:>10}" for name in columns[2:]))
    judgements: dict[str, list[NDArray[np.float64]]] = {}
    with open(options.output / "choosing.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        for folder in options.captures:
            case = load_case(folder, options.fitted, words, options.bank, options.absent)
            for method, answers in methods(case).items():
                row, judgement = measure(case, method, answers)
                judgements.setdefault(method, []).append(judgement)
                values = [getattr(row, name) for name in columns[2:]]
                cells = ("-" if v is None else f"{v:.4f}" if isinstance(v, float) else str(v) for v in values)
                print(f"{row.capture:<17} {method:<26}" + "".join(f"{cell:>10}" for cell in cells), flush=True)
                writer.writerow(asdict(row))
    draw_reliability(judgements, options.output / "reliability.png")


def unit(vectors: NDArray[np.floating]) -> NDArray[np.float32]:
    """Rows of length one."""
    return (vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)).astype(np.float32)


if __name__ == "__main__":
    main()
