"""A collection of scenes asked at once: words in, instances of all scenes out, best first."""

from __future__ import annotations

import difflib
import json
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, TypeAlias, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from og_pointcloud.bundle.vocabulary import carried_encoder
from og_pointcloud.cloud import UNKNOWN_SPACE, FeatureSpace, Vocabulary, unit_rows
from og_pointcloud.collection.index import Changes, index, own_words, pooled_words
from og_pointcloud.collection.lance import LanceTables
from og_pointcloud.collection.scoring import Block, block_key, load_block
from og_pointcloud.collection.store import Atlas, SceneEntry
from og_pointcloud.errors import FeatureSpaceError, OgPointcloudError
from og_pointcloud.text.encoder import TextEncoder, export_command, find_encoder
from og_pointcloud.text.text_features import read_text_features
from og_pointcloud.text.words import TextFeatures, resolve_labels

__all__ = ["Collection", "Finding", "Findings"]

Words: TypeAlias = "str | Iterable[str] | Mapping[str, ArrayLike]"
TOP = 20
SAME_WORD = 0.95
"""Cosine from which two names are one word, which does not compete with itself: "mug" and "a mug"."""


@dataclass(frozen=True)
class Finding:
    """An instance of some scene beside a word. center, size: of the axis-aligned box of its main part, (x, y, z) in its
    scene's world frame and unit.

    score: where calibrated, the probability that it is what the word says; else between 0 and 1 how much better the
    word fits than the other words that the scene's kin knows (LERF's relevancy, 0.5: as well); the cosine where they
    know no other. fits: whether the score is above one half.

    >>> chair = og.Finding("office", 3, "chair", 0.9, (1.0, 2.0, 0.5), (0.5, 0.5, 1.0), 800, True, True)
    >>> list(chair.to_dict())
    ['scene', 'instance', 'word', 'score', 'center', 'size']
    """

    scene: str
    instance: int
    word: str
    score: float
    center: tuple[float, float, float]
    size: tuple[float, float, float]
    points: int
    calibrated: bool
    fits: bool

    def to_dict(self) -> dict[str, Any]:
        """JSON-able: scene, instance, word, score, center, size."""
        names = ("scene", "instance", "word", "score", "center", "size")
        return {name: list(value) if isinstance(value := getattr(self, name), tuple) else value for name in names}


@dataclass(frozen=True)
class Findings(Sequence[Finding]):
    """What was found, best first. not_asked: why which scenes could not be asked for which words, in words.

    >>> og.Findings(()).to_json()
    '[]'
    """

    found: tuple[Finding, ...]
    not_asked: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.found)

    def __iter__(self) -> Iterator[Finding]:
        return iter(self.found)

    @overload
    def __getitem__(self, index: int) -> Finding: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Finding, ...]: ...
    def __getitem__(self, index: int | slice) -> Finding | tuple[Finding, ...]:
        """By rank: 0 is the best."""
        return self.found[index]

    def to_json(self) -> str:
        """A list of records, best first."""
        return json.dumps([finding.to_dict() for finding in self], indent=2, ensure_ascii=False)

    def __str__(self) -> str:
        header = ("score", "word", "scene", "instance", "center", "size")
        rows = [header, *(_cells(finding) for finding in self)]
        widths = [max(len(row[column]) for row in rows) for column in range(len(header))]
        return "\n".join(
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
        )


class Collection:
    """The scenes of an atlas (`Collection.index` makes one). Descriptors are read when they are first asked and then
    kept, those of single scenes or of a box alone where only they are asked.

    >>> import pathlib, tempfile
    >>> folder = pathlib.Path(tempfile.mkdtemp())
    >>> path = og.write_bundle(cloud, folder / "office.ogpc")  # of `LabelledCloud`'s example
    >>> collection = og.Collection.index(folder, folder / "atlas", progress=False)
    >>> [(finding.scene, finding.instance) for finding in collection.find("chair", top=1)]
    [('office', 0)]
    >>> collection.find("chair", within=([0.5, -1, 0], [2, 1, 2]))[0].instance
    1
    """

    def __init__(self, path: str | os.PathLike[str], *, lance: str | None = None) -> None:
        """path: of an atlas; OgPointcloudError where it is none, or damaged. lance: folder or URI of what
        `lance.write_lance` made of it, which is then searched in place of memory (extra 'lance')."""
        self.path = Path(path)
        self._lance = None if lance is None else LanceTables(lance)
        self.changes: Changes | None = None
        self._blocks: dict[tuple[Any, ...], Block] = {}
        with Atlas.reading(path) as atlas:
            self.root, self.entries = atlas.root, atlas.entries()
            self._words = own_words(atlas, self.entries)
        self._families: dict[int | None, list[SceneEntry]] = {}
        for entry in self.entries:
            self._families.setdefault(entry.kin, []).append(entry)
        self._pools = {kin: pooled_words(family, self._words) for kin, family in self._families.items()}

    @classmethod
    def index(
        cls,
        folder: str | os.PathLike[str],
        path: str | os.PathLike[str],
        *,
        executor: Executor | None = None,
        progress: bool = True,
    ) -> Collection:
        """Bring an atlas up to date with the .ogpc files in a folder, and open it; `changes` says what was new.

        Arguments and errors as of `collection.index.index`.
        """
        changes = index(folder, path, executor=executor, progress=progress)
        collection = cls(path)
        collection.changes = changes
        return collection

    @property
    def scenes(self) -> tuple[str, ...]:
        """Names of all scenes: their files' paths below ``root``, without the ending."""
        return tuple(entry.name for entry in self.entries)

    @property
    def words(self) -> tuple[str, ...]:
        """All words that some scene stores, sorted; an encoder may know more."""
        return tuple(sorted({word for pool in self._pools.values() for word in pool}))

    def file(self, scene: str) -> Path:
        """The .ogpc file of a scene, where it was when it was indexed."""
        return self.root / f"{scene}.ogpc"

    def find(
        self,
        words: Words,
        *,
        within: tuple[ArrayLike, ArrayLike] | None = None,
        scenes: str | Iterable[str] | None = None,
        top: int = TOP,
        text_features: TextFeatures = None,
    ) -> Findings:
        """The instances that words fit best, of all scenes.

        words: looked up in text_features, in each scene's own words, in those of its kin (scenes of the same feature
        space whose words agree), else encoded, if there is an encoder; or name -> vector, of the feature space of all
        scenes that have its width. A scene that cannot be asked for a word is left out, and ``not_asked`` says so.
        within: two corners (3,); instances whose box has its center in between, in their scene's world.
        scenes: names, or patterns such as "site3/*". top: how many.
        Raises OgPointcloudError where no scene can be asked, or there is none of a name.
        """
        query = _Query.of(words, within, top, text_features)
        groups = self._groups(self._wanted(scenes))
        query.require_one_space(groups)
        vectors = [self._vectors(group, query) for group in groups]
        if not any(vectors):
            raise self._unanswerable(query.names, groups)
        with Atlas.reading(self.path) as atlas:
            near = None if query.box is None else atlas.within(*query.box)
            found = [
                pair
                for group, known in zip(groups, vectors, strict=True)
                for pair in self._best(atlas, group, near, known, query)
            ]
        found.sort(key=lambda pair: -pair[0])  # stable: of equals the first
        best = tuple(finding for _, finding in found[:top])
        return Findings(best, _not_asked(groups, vectors, query.names))

    def _wanted(self, scenes: str | Iterable[str] | None) -> list[SceneEntry]:
        """The scenes of these names or patterns; all for None."""
        if scenes is None:
            return self.entries
        patterns = (scenes,) if isinstance(scenes, str) else tuple(scenes)
        names = self.scenes
        for pattern in patterns:
            if not any(_fits(name, pattern) for name in names):
                raise OgPointcloudError(
                    f"no scene is called '{pattern}'{_meant(pattern, names)}; expected one of the {len(names)} scenes "
                    f"of {self.path}"
                )
        return [entry for entry in self.entries if any(_fits(entry.name, pattern) for pattern in patterns)]

    def _groups(self, wanted: Iterable[SceneEntry]) -> list[list[SceneEntry]]:
        """Scenes with descriptors, those that are asked alike together."""
        groups: dict[tuple[Any, ...], list[SceneEntry]] = {}
        for entry in wanted:
            if entry.width:
                groups.setdefault(block_key(entry, self._words), []).append(entry)
        return list(groups.values())

    def _vectors(self, group: Sequence[SceneEntry], query: _Query) -> dict[str, NDArray[np.float32]]:
        """Unit vectors of those words that these scenes can be asked for."""
        entry = group[0]
        known = query.vectors_for(entry)
        if query.given is not None:
            return known
        own = pooled_words([entry], self._words)
        for source in (own, self._pools[entry.kin]):
            known = {word: source[word] for word in query.names if word in source} | known
        missing = [word for word in query.names if word not in known]
        if missing and (encoder := self._encoder(entry)) is not None and encoder.width == entry.width:
            known |= dict(zip(missing, encoder(missing), strict=True))
        return known

    def _encoder(self, entry: SceneEntry) -> TextEncoder | None:
        """The encoder that a scene of the kin carries; or the one found for the space, where all its scenes are kin."""
        for other in self._families[entry.kin]:
            if other.encoder and (encoder := carried_encoder(self.file(other.name))()):
                return encoder
        kins = {other.kin for other in self.entries if other.feature_space == entry.feature_space and other.width}
        return find_encoder(entry.feature_space) if len(kins) == 1 else None

    def _best(
        self, atlas: Atlas, group: list[SceneEntry], near: set[int] | None, known: Mapping[str, Any], query: _Query
    ) -> list[tuple[float, Finding]]:
        """The best of a group for each word, with what they are ranked by. near: ids of scenes with anything near."""
        here = group if near is None else [entry for entry in group if entry.id in near]
        if not known or not here:
            return []
        found = []
        for word, vector in known.items():
            block, chosen = self._candidates(atlas, group, here, vector, query)
            ranked = block.rank(vector, self._rivals(group[0], vector), chosen, query.top)
            found += [(key, _finding(block, row, word, score)) for row, key, score in ranked.rows_with_scores()]
        return found

    def _candidates(
        self, atlas: Atlas, group: list[SceneEntry], here: list[SceneEntry], vector: Any, query: _Query
    ) -> tuple[Block, NDArray[np.bool_]]:
        """A block, and which of its instances are asked: all of those scenes in the box, or what LanceDB proposes."""
        if self._lance is None:
            block = self._block(atlas, here)
            chosen = np.isin([entry.id for entry in block.entries], [entry.id for entry in here])[block.scene]
        else:
            key = block_key(group[0], self._words)
            some = None if len(here) == sum(block_key(e, self._words) == key for e in self.entries) else here
            direction = load_block(atlas, here[:1]).direction(vector)
            proposed = self._lance.propose(key, direction, query.box, some, query.top)
            block = load_block(atlas, [entry for entry in here if entry.id in {id for id, _ in proposed}] or here[:1])
            ids = np.array([entry.id for entry in block.entries])[block.scene]
            pairs = zip(ids.tolist(), block.instance.tolist(), strict=True)
            chosen = np.array([pair in proposed for pair in pairs], bool)
        if query.box is not None:
            middle = (block.low + block.high) / 2
            chosen &= ((middle >= query.box[0]) & (middle <= query.box[1])).all(axis=1)
        return block, chosen

    def _block(self, atlas: Atlas, here: list[SceneEntry]) -> Block:
        """The arrays of some scenes that are asked alike, maybe with those of others."""
        key = block_key(here[0], self._words)
        if key not in self._blocks:
            if len(here) < sum(block_key(entry, self._words) == key for entry in self.entries):
                return load_block(atlas, here)
            self._blocks[key] = load_block(atlas, here)
        return self._blocks[key]

    def _rivals(self, entry: SceneEntry, vector: NDArray[np.float32]) -> NDArray[np.float32]:
        """(M, D) the words that compete where no bank judges: all that the kin knows, without the word itself."""
        pool = self._pools[entry.kin].values()
        rivals = np.array([other for other in pool if other @ vector < SAME_WORD], np.float32)
        return rivals.reshape(-1, entry.width)

    def _unanswerable(self, names: Sequence[str], groups: list[list[SceneEntry]]) -> OgPointcloudError:
        known = {word for group in groups for word in self._pools[group[0].kin]}
        spaces = sorted({group[0].feature_space for group in groups})
        if not spaces:
            return OgPointcloudError("no scene has an instance with a feature: nothing can be asked; make masks first")
        return OgPointcloudError(
            f"'{names[0]}' is not among the {len(known)} words of these scenes{_meant(names[0], known)}; give "
            "text_features with its vector (--text-features), or, for any word at all, make the encoder once: "
            f"{export_command(spaces[0])}"
        )


@dataclass(frozen=True)
class _Query:
    """What is asked, checked. names: the words. given: their vectors, where those were given. box: two corners."""

    names: tuple[str, ...]
    given: Vocabulary | None
    features: tuple[Vocabulary, str] | None
    box: NDArray[np.float64] | None
    top: int

    @classmethod
    def of(cls, words: Words, within: Any, top: int, text_features: TextFeatures) -> _Query:
        if top < 1:
            raise OgPointcloudError(f"top is {top}; expected at least 1")
        given: Vocabulary | None = None
        names: tuple[str, ...] = ()
        if isinstance(words, Mapping):
            given = resolve_labels(words, None, None, UNKNOWN_SPACE)
            names = given.names
        else:
            names = tuple(dict.fromkeys((words,) if isinstance(words, str) else words))
        if not names or not all(isinstance(name, str) and name.strip() for name in names):
            raise OgPointcloudError(f"the words are {names!r:.80}; expected at least one word or phrase")
        features = read_text_features(text_features) if isinstance(text_features, (str, os.PathLike)) else text_features
        return cls(names, given, features, None if within is None else _corners(within), top)

    def require_one_space(self, groups: Sequence[Sequence[SceneEntry]]) -> None:
        """FeatureSpaceError where vectors without the name of a space could be of several, or of none."""
        if self.given is None:
            return
        width = self.given.vectors.shape[1]
        kins = {(group[0].feature_space, group[0].kin) for group in groups if group[0].width == width}
        if len(kins) != 1:
            spaces = ", ".join(sorted({str(FeatureSpace(g[0].feature_space, g[0].width)) for g in groups}))
            raise FeatureSpaceError(
                f"the vectors have width {width}, which {len(kins)} kinds of scenes have ({spaces}); expected one: "
                "name scenes of one kind, or give words"
            )

    def vectors_for(self, entry: SceneEntry) -> dict[str, NDArray[np.float32]]:
        """Of the words, those that came with vectors of a scene's space."""
        sources = [self.given] if self.given is not None else []
        if self.features is not None and self.features[1] == entry.feature_space:
            sources = [self.features[0]]
        vectors: dict[str, NDArray[np.float32]] = {}
        for source in sources:
            if source.vectors.shape[1] == entry.width:
                rows = dict(zip(source.names, unit_rows(source.vectors), strict=True))
                vectors = {name: rows[name] for name in self.names if name in rows}
        return vectors


def _fits(name: str, pattern: str) -> bool:
    return name == pattern or fnmatchcase(name, pattern)  # a name may hold brackets


def _corners(within: Any) -> NDArray[np.float64]:
    """(2, 3) low and high corner."""
    corners = np.asarray(within, np.float64) if np.shape(within) == (2, 3) else np.full((2, 3), np.nan)
    if not np.isfinite(corners).all() or (corners[0] > corners[1]).any():
        raise OgPointcloudError(f"within is {within!r:.120}; expected two corners of three numbers, the low one first")
    return corners


def _finding(block: Block, row: int, word: str, score: float) -> Finding:
    low, high = block.low[row], block.high[row]
    calibrated = block.bank is not None
    return Finding(
        block.entries[block.scene[row]].name, int(block.instance[row]), word, score, _triple((low + high) / 2),
        _triple(high - low), int(block.points[row]), calibrated, score > 0.5,
    )  # fmt: skip


def _triple(values: NDArray[np.float64]) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z


def _not_asked(
    groups: Sequence[Sequence[SceneEntry]], vectors: Sequence[Mapping[str, Any]], names: Sequence[str]
) -> tuple[str, ...]:
    counts: Counter[tuple[str, str]] = Counter()
    for group, known in zip(groups, vectors, strict=True):
        for word in names:
            counts[word, group[0].feature_space] += len(group) * (word not in known)
    return tuple(
        f"{count} scenes of feature space '{space}' could not be asked for '{word}': no vector of theirs is known"
        for (word, space), count in sorted(counts.items()) if count
    )  # fmt: skip


def _meant(word: str, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(word, sorted(known), n=3)
    return f" (did you mean {' or '.join(repr(name) for name in close)}?)" if close else ""


def _cells(finding: Finding) -> tuple[str, ...]:
    center = " ".join(f"{value:.4g}" for value in finding.center)
    size = " x ".join(f"{value:.3g}" for value in finding.size)
    return f"{finding.score:.3f}", finding.word, finding.scene, str(finding.instance), center, size
