"""A folder of .ogpc files -> an atlas: only files that changed are read; then it is settled who judges whom.

Cosines of two scenes cannot be compared: one has 0.3 where a word fits, another, whose features come from a detector's
words, 0.8 where it does not. A word bank makes them comparable (`ask.choosing`), and where a scene brings none, its kin
lends one: the bank of another scene of its feature space, else all words that the scenes of the space know together.

The name of a feature space is what somebody typed. Scenes that give the same words other vectors are no kin, whatever
their spaces are called, and no word of one is ever asked of the other.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from hashlib import blake2b
from itertools import count
from pathlib import Path

import numpy as np

from og_pointcloud.ask.choosing import Chooser, Standard
from og_pointcloud.ask.instances import list_instances
from og_pointcloud.bundle.format import CARRIED_ENCODER
from og_pointcloud.bundle.read import read_bundle
from og_pointcloud.cloud import MIN_BANK, UNKNOWN_SPACE, InstanceTable, LabelledCloud, Vocabulary, WordBank, unit_rows
from og_pointcloud.collection.progress import counted
from og_pointcloud.collection.store import INSTANCE, Atlas, SceneArrays, SceneEntry
from og_pointcloud.errors import OgPointcloudError

__all__ = ["Changes", "index", "kinship", "pooled_words"]

SAME_ENCODER = 0.5
"""Mean cosine of the words that two scenes share, above which one encoder made both: the same word in other templates
has about 0.9, in another encoder's space about 0."""


@dataclass(frozen=True)
class Changes:
    """What an index took: names of scenes. left_out: name and cause of each file that cannot be read; what the atlas
    held of it is gone."""

    added: tuple[str, ...]
    replaced: tuple[str, ...]
    removed: tuple[str, ...]
    left_out: tuple[tuple[str, str], ...]
    unchanged: int

    def __str__(self) -> str:
        counts = [("added", self.added), ("replaced", self.replaced), ("removed", self.removed)]
        parts = [f"{len(names)} {what}" for what, names in counts if names]
        return ", ".join([*parts, f"{self.unchanged} unchanged"])


def index(
    folder: str | os.PathLike[str],
    path: str | os.PathLike[str],
    *,
    executor: Executor | None = None,
    progress: bool = True,
) -> Changes:
    """Bring an atlas up to date with all .ogpc files in a folder and the folders below.

    path: of the atlas, which is made where there is none. executor: reads files side by side; None: one by one.
    OgPointcloudError where the folder holds no such file, or the atlas cannot be written; it then stays as it was.
    """
    root = Path(folder)
    files = {file.relative_to(root).with_suffix("").as_posix(): file for file in sorted(root.rglob("*.ogpc"))}
    if not files:
        raise OgPointcloudError(f"'{root}' holds no .ogpc file; expected a folder with what og-pointcloud fit wrote")
    with Atlas.writing(path) as atlas:
        atlas.set_root(root)
        known = {entry.name: entry for entry in atlas.entries()}
        jobs = [(name, file) for name, file in files.items() if not _is_same(file, known.get(name))]
        names, paths = [name for name, _ in jobs], [file for _, file in jobs]
        digests = [known[name].digest if name in known else None for name in names]
        read = (executor.map if executor else map)(read_scene, paths, digests)
        added, replaced, left_out = [], [], []
        for name, found in zip(names, counted(read, "index", len(jobs), progress), strict=True):
            if found.error:
                left_out.append((name, found.error))
                atlas.remove(name)
            elif found.arrays is None:
                atlas.touch(known[name], found.modified)
            else:
                (replaced if name in known else added).append(name)
                _add(atlas, name, found)
        removed = sorted(set(known) - set(files))
        for name in removed:
            atlas.remove(name)
        settle(atlas)
    unchanged = len(files) - len(added) - len(replaced) - len(left_out)
    return Changes(tuple(added), tuple(replaced), tuple(removed), tuple(left_out), unchanged)


def _is_same(file: Path, entry: SceneEntry | None) -> bool:
    """Whether a file has the size and date that it had: then it is not even opened."""
    state = file.stat()
    return entry is not None and (state.st_size, state.st_mtime_ns) == (entry.bytes, entry.modified)


@dataclass(frozen=True)
class ReadScene:
    """What a file held. error: why it cannot be used, then there is nothing else. arrays: None where the file has the
    digest that it had."""

    error: str = ""
    digest: str = ""
    bytes: int = 0
    modified: int = 0
    feature_space: str = ""
    points: int = 0
    arrays: SceneArrays | None = None
    vocabulary: Vocabulary | None = None
    bank: WordBank | None = None
    encoder: bool = False


def read_scene(file: Path, digest: str | None) -> ReadScene:
    """A .ogpc file for an atlas. digest: that of its content as the atlas has it."""
    try:
        state = file.stat()
        found = blake2b(file.read_bytes(), digest_size=16).hexdigest()
        if found == digest:
            return ReadScene(modified=state.st_mtime_ns)
        bundle = read_bundle(file)
        cloud = bundle.cloud
        arrays = arrays_of(cloud)
    except (OgPointcloudError, OSError) as error:
        return ReadScene(error=str(error))
    facts = (found, state.st_size, state.st_mtime_ns, cloud.feature_space, len(cloud))
    encoder = any(name.startswith(CARRIED_ENCODER) for name in bundle.manifest["members"])
    return ReadScene("", *facts, arrays, cloud.vocabulary, cloud.word_bank, encoder)


def arrays_of(cloud: LabelledCloud) -> SceneArrays:
    """What an atlas keeps of a cloud."""
    table = cloud.instances
    rows = np.zeros(len(table), INSTANCE)
    for name in ("centroid", "low", "high"):
        rows[name] = np.nan
    for name in ("views", "masks", "part_of", "agreement", "visible_area"):
        rows[name] = getattr(table, name)
    for k, instance in enumerate(list_instances(cloud, Chooser(table))):
        rows[k]["points"] = instance.points
        if (box := instance.axis_aligned_box) is not None:
            rows[k]["centroid"], rows[k]["low"], rows[k]["high"] = instance.centroid, box.low, box.high
    return SceneArrays(rows, table.descriptor_instance, unit_rows(table.descriptors))


def _add(atlas: Atlas, name: str, found: ReadScene) -> None:
    arrays, vocabulary, bank = found.arrays, found.vocabulary, found.bank
    assert arrays is not None
    words = atlas.add_words(vocabulary.names, unit_rows(vocabulary.vectors)) if vocabulary else None
    judge = atlas.add_words(("",) * len(bank.vectors), bank.vectors) if bank else None
    width = arrays.descriptors.shape[1] if len(arrays.descriptors) else 0
    facts = (found.digest, found.bytes, found.modified, found.feature_space, width, found.points, len(arrays.instances))
    atlas.add(SceneEntry(0, name, *facts, words, judge, int(found.encoder)), arrays)


# Who judges whom -------------------------------------------------------------------------------------------------


def settle(atlas: Atlas) -> None:
    """Settle the kin of all scenes and whose words judge their instances, and judge those for whom that is new."""
    entries = atlas.entries()
    words = own_words(atlas, entries)
    kin = kinship(entries, words)
    for number in sorted(set(kin.values())):
        family = [entry for entry in entries if kin[entry.id] == number]
        lent = _lent_bank(atlas, family, words)
        banks: dict[str, WordBank] = {}
        for entry in family:
            judge = (entry.bank or lent) if entry.width else None
            if judge == entry.judge:
                continue
            if judge is not None and judge not in banks:
                banks = {judge: atlas.bank(judge, entry.width)}  # one: of many families each scene may have its own
            atlas.judge(entry, judge, None if judge is None else _judged(atlas, entry, banks[judge]))
    atlas.set_kin(kin)


def own_words(atlas: Atlas, entries: Iterable[SceneEntry]) -> dict[str, Vocabulary]:
    """The vocabularies of the scenes by digest, those of another width than their descriptors left out."""
    widths = {entry.vocabulary: entry.width for entry in entries if entry.vocabulary}
    words = {digest: atlas.words(digest) for digest in widths}
    return {digest: found for digest, found in words.items() if found.vectors.shape[1] == widths[digest]}


def kinship(entries: Sequence[SceneEntry], words: Mapping[str, Vocabulary]) -> dict[int, int]:
    """Number of the kin of each scene, by its id: scenes of one feature space and width whose words agree.

    A scene without words belongs to the kin of its space where there is only one. Scenes of a space that nobody named
    have no kin.
    """
    kin: dict[int, int] = {}
    families: dict[tuple[str, int], list[tuple[int, dict[str, np.ndarray]]]] = {}
    numbers = count()
    for entry in sorted(entries, key=lambda entry: (entry.vocabulary not in words, entry.name)):
        vectors = pooled_words([entry], words)
        known = families.setdefault((entry.feature_space, entry.width), [])
        fitting = [family for family in known if _agree(vectors, family[1])]
        if entry.feature_space == UNKNOWN_SPACE or not fitting or (not vectors and len(known) > 1):
            fitting = [(next(numbers), {})]
            known.extend(fitting)
        kin[entry.id] = fitting[0][0]
        for name, vector in vectors.items():
            fitting[0][1].setdefault(name, vector)
    return kin


def _agree(first: Mapping[str, np.ndarray], second: Mapping[str, np.ndarray]) -> bool:
    """Whether the words that both know have about the same unit vectors; true where they share none."""
    shared = first.keys() & second.keys()
    return not shared or float(np.mean([first[name] @ second[name] for name in shared])) > SAME_ENCODER


def pooled_words(family: Iterable[SceneEntry], words: Mapping[str, Vocabulary]) -> dict[str, np.ndarray]:
    """Word -> vector of all words that the scenes of a kin know; of several vectors the first by scene names."""
    pool: dict[str, np.ndarray] = {}
    for digest in dict.fromkeys(entry.vocabulary for entry in family):
        if digest is None or digest not in words:
            continue
        for name, vector in zip(words[digest].names, words[digest].vectors, strict=True):
            pool.setdefault(name, vector)
    return pool


def _lent_bank(atlas: Atlas, family: Sequence[SceneEntry], words: Mapping[str, Vocabulary]) -> str | None:
    """Digest of the bank for scenes that have none: what most of their kin have, else their pooled words."""
    if banks := [entry.bank for entry in family if entry.bank]:
        return max(sorted(set(banks)), key=banks.count)
    pool = pooled_words(family, words)
    if len(pool) < MIN_BANK or all(entry.width == 0 for entry in family):
        return None
    return atlas.add_words(("",) * len(pool), np.array([pool[name] for name in sorted(pool)], np.float32))


def _judged(atlas: Atlas, entry: SceneEntry, bank: WordBank) -> Standard:
    arrays = atlas.arrays(entry)
    table = instance_table_of(arrays)
    return Chooser(table, bank, feature_space=entry.feature_space).standard()


def instance_table_of(arrays: SceneArrays) -> InstanceTable:
    """The instances of a scene as it is asked."""
    rows = arrays.instances
    columns = {name: rows[name].copy() for name in ("points", "views", "masks", "agreement", "visible_area")}
    return InstanceTable(arrays.descriptors, arrays.owner, **columns, part_of=rows["part_of"].copy())
