"""A folder of .ogpc files -> an atlas: only files that changed are read; then each scene gets the word bank that judges
it, which makes its scores comparable with those of others.

Cosines of two scenes cannot be compared: one has 0.3 where a word fits, another, whose features come from a detector's
words, 0.8 where it does not. A word bank makes them comparable (`ask.choosing`). A scene without one borrows that of
another scene of its encoder, else all words that the scenes of its encoder have together.

The name of a feature space does not tell which scenes share an encoder: somebody typed it. Scenes with different
vectors for the same words have two encoders (two families), and words of one are never used for the other.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from hashlib import blake2b
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.ask.choosing import Chooser
from og_pointcloud.ask.instances import list_instances
from og_pointcloud.bundle.format import CARRIED_ENCODER
from og_pointcloud.bundle.read import read_bundle
from og_pointcloud.cloud import MIN_BANK, UNKNOWN_SPACE, FeatureSpace, WordBank, unit_rows
from og_pointcloud.collection.store import Atlas, SceneEntry
from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.formats.atomic import StrPath
from og_pointcloud.journal import with_bar

SAME_ENCODER_COSINE = 0.5
"""Mean cosine of the words that two scenes share, above which one encoder made both: the same word in other templates
has about 0.9, in another encoder's space about 0."""


@dataclass(frozen=True)
class Changes:
    """Changes by indexing, as names of scenes. left_out: name and cause of each file that cannot be read; its previous
    entry in the atlas is removed."""

    added: tuple[str, ...]
    replaced: tuple[str, ...]
    removed: tuple[str, ...]
    left_out: tuple[tuple[str, str], ...]
    unchanged: int

    def __str__(self) -> str:
        counts = {"added": self.added, "replaced": self.replaced, "removed": self.removed, "left out": self.left_out}
        parts = [f"{len(names)} {what}" for what, names in counts.items() if names]
        return ", ".join([*parts, f"{self.unchanged} unchanged"])


def index(folder: StrPath, path: StrPath, *, progress: bool = True) -> Changes:
    """Bring an atlas up to date with all .ogpc files in a folder and the folders below.

    path: of the atlas, created if missing. OgPointcloudError if ``folder`` is no folder or holds no such file, or if
    the atlas cannot be written; it then stays as it was.
    """
    root = Path(folder)
    if not root.is_dir():
        raise OgPointcloudError(f"'{root}' is not a folder; expected a folder of .ogpc files")
    found = sorted([*root.rglob("*.OGPC"), *root.rglob("*.ogpc")])  # of two that differ in this, the last one counts
    files = {file.relative_to(root).with_suffix("").as_posix(): file for file in found}
    if not files:
        raise OgPointcloudError(f"'{root}' has no .ogpc files; expected those that og-pointcloud fit wrote")
    added, replaced, left_out = [], [], []
    with Atlas.writing(path) as atlas:
        atlas.note("root", str(root.resolve()))
        known = {entry.name: entry for entry in atlas.entries()}
        outdated = [name for name, file in files.items() if name not in known or not _is_same(file, known[name])]
        for name in with_bar(outdated, "index", len(outdated), progress):
            try:
                if _add_file(atlas, name, files[name], known.get(name)):
                    (replaced if name in known else added).append(name)
            except (OgPointcloudError, OSError) as error:  # one bad file does not affect the others
                left_out.append((name, str(error)))
                if name in known:
                    atlas.remove(name)
        removed = sorted(set(known) - set(files))
        for name in removed:
            atlas.remove(name)
        judge_scenes(atlas)  # new words may be a better judge for scenes that did not change
    unchanged = len(files) - len(added) - len(replaced) - len(left_out)
    return Changes(tuple(added), tuple(replaced), tuple(removed), tuple(left_out), unchanged)


def _is_same(file: Path, entry: SceneEntry) -> bool:
    """Whether a file has the same size and date as when it was indexed: then it is not even opened."""
    state = file.stat() if file.is_file() else None  # a link may lead nowhere
    return state is not None and (state.st_size, state.st_mtime_ns) == (entry.bytes, entry.modified)


def _add_file(atlas: Atlas, name: str, file: Path, known: SceneEntry | None) -> bool:
    """Add a .ogpc file to the atlas; False if only its date is new, not its content."""
    if not file.is_file():
        raise OgPointcloudError(f"{file} is not a file; expected a .ogpc file")  # a device or a pipe never ends
    if os.fsencode(name).decode(errors="ignore") != name:
        raise OgPointcloudError("its name has bytes that are not UTF-8: rename the file or folder")
    state = file.stat()
    digest = blake2b(file.read_bytes(), digest_size=16).hexdigest()
    if known is not None and known.digest == digest:
        atlas.touch(known, state.st_mtime_ns)
        return False
    bundle = read_bundle(file)
    cloud, words, bank = bundle.cloud, bundle.cloud.vocabulary, bundle.cloud.word_bank
    instances = list_instances(cloud, Chooser(cloud.instances))
    boxes = [instance.axis_aligned_box for instance in instances]
    corners = np.array([(box.low, box.high) if box else np.zeros((2, 3)) for box in boxes]).reshape(-1, 2, 3)
    points = np.array([instance.points for instance in instances], np.int32)  # counted by id, whatever its table says
    table = replace(cloud.instances, descriptors=unit_rows(cloud.instances.descriptors), points=points)
    entry = SceneEntry(
        0, name, digest, cloud.feature_space, state.st_size, state.st_mtime_ns,
        width=table.descriptors.shape[1] if len(table.descriptors) else 0,
        encoder=int(any(member.startswith(CARRIED_ENCODER) for member in bundle.manifest["members"])),
        vocabulary=atlas.add_words(words.names, unit_rows(words.vectors)) if words else None,
        bank=atlas.add_words(("",) * len(bank.vectors), bank.vectors) if bank else None,
    )  # fmt: skip
    atlas.add(entry, table, corners)
    return True


# Who judges whom -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Family:
    """Scenes of one encoder: they share feature space and width, and their words agree. words: of all scenes together,
    (D,) unit vectors; for a word of several, the vector of the first scene by name."""

    feature_space: str
    width: int
    entries: list[SceneEntry] = field(default_factory=list)
    words: dict[str, NDArray[np.float32]] = field(default_factory=dict)

    @property
    def space(self) -> FeatureSpace:
        """What vectors must be of to be compared with these scenes' descriptors."""
        return FeatureSpace(self.feature_space, self.width)

    def groups(self) -> list[Group]:
        """The scenes that can be queried, grouped by the bank that judges them."""
        by_judge: dict[str | None, list[SceneEntry]] = {}
        for entry in self.entries if self.width else ():
            by_judge.setdefault(entry.judge, []).append(entry)
        return [Group(self, entries) for entries in by_judge.values()]


@dataclass(frozen=True)
class Group:
    """Scenes of one family with the same bank, or all without one: they are queried the same way."""

    family: Family
    entries: list[SceneEntry]

    @cached_property
    def by_id(self) -> dict[int, SceneEntry]:
        """The scenes by their ids."""
        return {entry.id: entry for entry in self.entries}

    @property
    def name(self) -> str:
        """Unique among the groups of the atlas."""
        return f"{self.family.entries[0].id}-{self.entries[0].judge or 'cosine'}"


def families(atlas: Atlas, entries: Iterable[SceneEntry]) -> list[Family]:
    """The scenes of an atlas by encoder.

    A scene without words belongs to the family of its feature space if there is only one. Each scene of an unnamed
    space is its own family.
    """
    by_words: dict[tuple[str, int, str, int], list[SceneEntry]] = {}
    for entry in entries:
        alone = entry.id if entry.feature_space == UNKNOWN_SPACE else 0
        by_words.setdefault((entry.feature_space, entry.width, entry.vocabulary or "", alone), []).append(entry)
    known: list[Family] = []
    # Those with words first: they define the families.
    for (space, width, digest, alone), members in sorted(
        by_words.items(), key=lambda item: (not item[0][2], item[1][0].name)
    ):
        words = _words(atlas, digest, width)
        of_space = [] if alone else [each for each in known if (each.feature_space, each.width) == (space, width)]
        fitting = [family for family in of_space if _agree(words, family.words)]
        # Scenes without words agree with any family: if there are several, it is unknown which one is theirs.
        if not fitting or (not words and len(of_space) > 1):
            fitting = [Family(space, width)]
            known += fitting
        family = fitting[0]
        family.entries.extend(members)
        family.words.update({**words, **family.words})
    return known


def _words(atlas: Atlas, digest: str, width: int) -> dict[str, NDArray[np.float32]]:
    """A vocabulary, name -> unit vector; empty if its width differs from the descriptors'."""
    words = atlas.words(digest) if digest else None
    return dict(zip(words.names, words.vectors, strict=True)) if words and words.vectors.shape[1] == width else {}


def _agree(first: Mapping[str, NDArray[np.float32]], second: Mapping[str, NDArray[np.float32]]) -> bool:
    """Whether the words that both have share about the same unit vectors; true if they have none in common."""
    shared = first.keys() & second.keys()
    return not shared or float(np.mean([first[name] @ second[name] for name in shared])) > SAME_ENCODER_COSINE


def judge_scenes(atlas: Atlas) -> None:
    """Choose the word bank that judges each scene, and judge the scenes whose bank has changed."""
    for family in families(atlas, atlas.entries()):
        lent = _lent_bank(atlas, family)
        banks: dict[str, WordBank] = {}
        # Scenes of one bank in sequence: each bank is read once, and only one is held at a time.
        for entry in sorted(family.entries, key=lambda entry: entry.bank or ""):
            judge = (entry.bank or lent) if family.width else None
            if judge == entry.judge:
                continue
            standard = None
            if judge is not None:
                if judge not in banks:
                    banks = {judge: atlas.bank(judge, family.width)}
                standard = Chooser(atlas.instances(entry)[0], banks[judge]).standard()
            atlas.judge(entry, judge, standard)
    atlas.forget_unused_words()


def _lent_bank(atlas: Atlas, family: Family) -> str | None:
    """Digest of the bank for scenes without one: that of most scenes of their family, else the family's words."""
    if banks := [entry.bank for entry in family.entries if entry.bank]:
        return max(sorted(set(banks)), key=banks.count)
    if len(family.words) < MIN_BANK or family.width == 0:
        return None
    # In order of the words, so that the same words have the same digest whichever scene came first.
    return atlas.add_words(("",) * len(family.words), np.array([family.words[name] for name in sorted(family.words)]))
