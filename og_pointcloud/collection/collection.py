"""A collection of scenes queried at once: words in, instances of all scenes out, best first."""

from __future__ import annotations

import fnmatch
import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from numbers import Integral
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from og_pointcloud.bundle.vocabulary import carried_encoder
from og_pointcloud.cloud import UNKNOWN_SPACE, FeatureSpace, Vocabulary, unit_rows
from og_pointcloud.collection.index import Changes, Family, Group, families, index
from og_pointcloud.collection.lance import MAX_EXACT_SCENES, LanceTables
from og_pointcloud.collection.scoring import Block, load_block, sigmoid
from og_pointcloud.collection.store import Atlas, SceneEntry
from og_pointcloud.errors import OgPointcloudError, counted, did_you_mean
from og_pointcloud.formats.atomic import StrPath
from og_pointcloud.scene import numbers_of
from og_pointcloud.text.encoder import TextEncoder, export_command, find_encoder
from og_pointcloud.text.words import TextFeatures, resolve_labels, words_of

DEFAULT_TOP = 20
"""Default number of findings."""
SAME_WORD_COSINE = 0.95
"""From this cosine on two names are one word, which does not compete with itself: "mug" and "a mug"."""


@dataclass(frozen=True)
class Finding:
    """An instance of some scene, found for a word. center, size: of the axis-aligned box of its main part, (x, y, z) in
    its scene's world frame and unit.

    score: if calibrated, the probability that it is what the word says; else LERF's relevancy, between 0 and 1: how
    much better the word fits than the other words of the scene's encoder that are known here, or than a cosine of 0
    without any; 0.5 means equally well. fits: whether the score is above one half.

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


class Findings(tuple[Finding, ...]):
    """Findings, best first. not_asked: sentences about scenes that could not be asked for some word, and why.

    >>> og.Findings().to_json()
    '[]'
    """

    not_asked: tuple[str, ...]

    def __new__(cls, found: Iterable[Finding] = (), not_asked: tuple[str, ...] = ()) -> Findings:
        """found: best first."""
        findings = super().__new__(cls, found)
        findings.not_asked = not_asked
        return findings

    def to_json(self) -> str:
        """A list of records, best first."""
        return json.dumps([finding.to_dict() for finding in self], indent=2, ensure_ascii=False)


class Collection:
    """The scenes of an atlas (`Collection.index` makes one). Descriptors are read on first use, and kept; a query of
    some scenes or a box reads only those.

    >>> import pathlib, tempfile
    >>> folder = pathlib.Path(tempfile.mkdtemp())
    >>> path = og.write_bundle(cloud, folder / "office.ogpc")  # of `LabelledCloud`'s example
    >>> collection = og.Collection.index(folder, folder / "atlas", progress=False)
    >>> [(finding.scene, finding.instance) for finding in collection.find("chair", top=1)]
    [('office', 0)]
    >>> collection.find("chair", within=([0.5, -1, 0], [2, 1, 2]))[0].instance
    1
    """

    def __init__(self, path: StrPath, *, lance: str | None = None) -> None:
        """path: of an atlas; OgPointcloudError for any other or damaged file. lance: folder or URI of the database that
        `lance.write_lance` made of it, which is then searched instead of memory (extra 'lance')."""
        self.path = Path(path).absolute()
        self._lance = None if lance is None else LanceTables(lance)
        self.changes: Changes | None = None
        self._stamp: tuple[int, ...] = ()
        self._open()

    def __repr__(self) -> str:
        return f"Collection('{self.path}': {counted(len(self.entries), 'scene')}, {counted(len(self.words), 'word')})"

    def _open(self) -> None:
        """Read the list of scenes, if the atlas has changed since it was last read."""
        state = self.path.stat() if self.path.is_file() else None
        stamp = (state.st_ino, state.st_size, state.st_mtime_ns) if state else ()
        if stamp and stamp == self._stamp:
            return
        with Atlas.reading(self.path) as atlas:
            if self._lance is not None:
                self._lance.require(atlas)
            self.root, self.entries = atlas.root, atlas.entries()
            self._groups = [group for family in families(atlas, self.entries) for group in family.groups()]
        self._by_name = {entry.name: entry for entry in self.entries}
        self._blocks: dict[str, Block] = {}
        self._stamp = stamp

    @classmethod
    def index(cls, folder: StrPath, path: StrPath, *, progress: bool = True) -> Collection:
        """Bring an atlas up to date with the .ogpc files in a folder, and open it; `changes` lists what changed.

        Arguments and errors as in `collection.index.index`.
        """
        changes = index(folder, path, progress=progress)
        collection = cls(path)
        collection.changes = changes
        return collection

    @property
    def scenes(self) -> tuple[str, ...]:
        """Names of all scenes: their files' paths below ``root``, without the ending."""
        return tuple(entry.name for entry in self.entries)

    @property
    def words(self) -> tuple[str, ...]:
        """All words stored by any scene, sorted; an encoder may know more."""
        return tuple(sorted({word for group in self._groups for word in group.family.words}))

    def file(self, scene: str) -> Path:
        """The .ogpc file of a scene, at its path when it was indexed."""
        path = self.root / f"{scene}.ogpc"
        upper = path.with_suffix(".OGPC")
        return upper if upper.is_file() and not path.is_file() else path

    def find(
        self,
        words: str | Iterable[str] | Mapping[str, ArrayLike],
        *,
        within: tuple[ArrayLike, ArrayLike] | None = None,
        scenes: str | Iterable[str] | None = None,
        top: int = DEFAULT_TOP,
        text_features: TextFeatures = None,
    ) -> Findings:
        """The instances of all scenes that words fit best.

        words: looked up in text_features, then among the words of a scene's family (scenes of one encoder), else
        encoded, if there is an encoder; or name -> vector (D,), for scenes of that width. A scene that cannot be asked
        for a word is left out, and ``not_asked`` says so.
        within: two corners (3,); only instances whose box center lies between them, in their scene's world.
        scenes: names, or patterns such as "site3/*". top: maximum number of findings.
        Raises OgPointcloudError if no scene can be asked, or a name or pattern matches none; FeatureSpaceError if
        vectors match none.
        """
        if not isinstance(top, Integral) or top < 1:
            raise OgPointcloudError(f"top is {top!r:.40}; expected a whole number, at least 1")
        names = _texts("words", words, "at least one word or phrase")
        patterns = None if scenes is None else _texts("scenes", scenes, "at least one name or pattern, or None for all")
        features = None if text_features is None else words_of(text_features)
        given = resolve_labels(words, None, None, UNKNOWN_SPACE) if isinstance(words, Mapping) else None
        box = None if within is None else _corners(within)
        query = _Query(names, features, given, patterns, box, top)
        self._open()
        try:
            return self._found(query)
        except OgPointcloudError:
            before = self._stamp
            self._open()
            if self._stamp == before:
                raise
            # Another process changed the atlas meanwhile: what was read of it belongs to what it was.
            return self._found(query)

    def _found(self, query: _Query) -> Findings:
        query = replace(query, ids=self._ids(query.patterns))
        asked = [group for group in self._groups if query.scenes_of(group)]
        vectors = [self._vectors(group.family, query) for group in asked]
        if not any(vectors):
            raise _unanswerable(query, [group.family for group in asked])
        # The best of each group and word, then the best of all: (sort key, finding).
        ranked = [
            pair
            for group, known in zip(asked, vectors, strict=True)
            for word, vector in known.items()
            for pair in self._best(group, query, word, vector)
        ]
        ranked.sort(key=lambda pair: -pair[0])  # stable: the first one on ties
        # Scenes that could not be asked for a word, by word and feature space.
        counts: Counter[tuple[str, str]] = Counter()
        for group, known in zip(asked, vectors, strict=True):
            for word in set(query.words) - known.keys():
                counts[word, group.family.feature_space] += len(query.scenes_of(group))
        not_asked = tuple(
            f"{counted(count, 'scene')} of feature space '{space}' could not be searched for '{word}': its vector "
            "there is unknown"
            for (word, space), count in sorted(counts.items())
        )
        return Findings((finding for _, finding in ranked[: query.top]), not_asked)

    def _ids(self, patterns: tuple[str, ...] | None) -> set[int] | None:
        """Ids of the scenes that names or patterns match; None, meaning all, stays None."""
        if patterns is None:
            return None
        ids: set[int] = set()
        for pattern in patterns:
            fitting = [pattern] if pattern in self._by_name else fnmatch.filter(self._by_name, pattern)
            if not fitting:
                raise OgPointcloudError(
                    f"no scene is called '{pattern}'; expected the name of a scene in {self.path} "
                    f"({len(self.entries):,}), or a pattern{did_you_mean(pattern, self.scenes)}"
                )
            ids.update(self._by_name[name].id for name in fitting)
        return ids

    def _vectors(self, family: Family, query: _Query) -> dict[str, NDArray[np.float32]]:
        """Unit vectors of the words that these scenes can be asked for."""
        given, features = query.given, query.features
        if given is not None:
            fits = given.vectors.shape[1] == family.width
            return dict(zip(given.names, unit_rows(given.vectors), strict=True)) if fits else {}
        known = family.words
        if features is not None and (features[1], features[0].vectors.shape[1]) == (family.feature_space, family.width):
            known = known | dict(zip(features[0].names, unit_rows(features[0].vectors), strict=True))
        vectors = {name: known[name] for name in query.words if name in known}
        missing = [name for name in query.words if name not in known]
        if missing and (encoder := self._encoder(family)) is not None:
            vectors |= dict(zip(missing, encoder(missing), strict=True))
        return vectors

    def _encoder(self, family: Family) -> TextEncoder | None:
        """The encoder that a scene of the family carries, else the one found for the feature space. The latter is used
        only if the space has one family here: with several it is unknown which one it belongs to."""
        for entry in family.entries:
            # Since it was indexed, a file may have become damaged, or the scene of another encoder.
            with suppress(OgPointcloudError):
                if entry.encoder and (encoder := carried_encoder(self.file(entry.name))()):
                    family.space.require(encoder.space, "texts that it encodes")
                    return encoder
        of_space = {id(group.family) for group in self._groups if group.family.feature_space == family.feature_space}
        encoder = find_encoder(family.feature_space) if len(of_space) == 1 else None
        return encoder if encoder and family.space.accepts(encoder.space) else None

    def _best(self, group: Group, query: _Query, word: str, vector: NDArray[np.float32]) -> list[tuple[float, Finding]]:
        """The best of a group for a word, with their sort keys."""
        block = self._blocks.get(group.name) or self._block(group, query, vector)
        # A block holds a whole group or more than was queried: its ranking leaves the rest out.
        selected = np.ones(len(block.entries), bool) if query.ids is None else np.isin(block.ids, list(query.ids))
        words = np.array([*group.family.words.values()], np.float32).reshape(-1, len(vector))  # unit vectors
        rivals = words[words @ vector < SAME_WORD_COSINE]
        ranked = zip(*block.rank(vector, rivals, selected, query.top, query.box), strict=True)
        return [(key, _finding(block, row, word, float(sigmoid(key)))) for row, key in ranked]

    def _block(self, group: Group, query: _Query, vector: NDArray[np.float32]) -> Block:
        """The queried scenes of a group that meet the box, reduced to those that LanceDB proposes, if it is used. A
        block of the whole group is kept for later queries, one of some scenes is read each time."""
        here = query.scenes_of(group)
        with Atlas.reading(self.path) as atlas:
            ids = atlas.within(*query.box) if query.box is not None else {entry.id for entry in here}
            candidates = [entry for entry in here if entry.id in ids] or here[:1]
            is_all = len(candidates) == len(group.entries)
            if self._lance is not None and (is_all or len(candidates) > MAX_EXACT_SCENES):
                direction = load_block(atlas, candidates[:1]).direction(vector)
                # When all scenes are queried, the box is the only condition: no list of ids is needed.
                scene_ids = None if len(here) == len(group.entries) else [entry.id for entry in candidates]
                part = len(candidates) / len(group.entries)
                proposed = self._lance.propose(group.name, direction, query.box, scene_ids, query.top, part)
                return load_block(atlas, [entry for entry in candidates if entry.id in proposed] or candidates[:1])
            block = load_block(atlas, atlas.side_by_side(candidates))
        if is_all:
            self._blocks[group.name] = block
        return block


@dataclass(frozen=True)
class _Query:
    """A query. features: vectors of words in a feature space; given: vectors of the words themselves, used exclusively.
    patterns: of the queried scenes' names, and ids: of these scenes, None for all. box: (2, 3) corners that the
    instance's center must lie between, None for anywhere. top: maximum number of findings."""

    words: tuple[str, ...]
    features: tuple[Vocabulary, str] | None
    given: Vocabulary | None
    patterns: tuple[str, ...] | None
    box: NDArray[np.float64] | None
    top: int
    ids: set[int] | None = None

    def scenes_of(self, group: Group) -> Sequence[SceneEntry]:
        """The scenes of a group that are queried."""
        if self.ids is None:
            return group.entries
        return [group.by_id[id] for id in sorted(self.ids & group.by_id.keys())]


def _texts(what: str, given: Any, expected: str) -> tuple[str, ...]:
    """Distinct texts, in order: one or several. OgPointcloudError for anything else, an empty text or none."""
    several = isinstance(given, Iterable) and not isinstance(given, (str, bytes))
    texts: list[Any] = [*given] if several else [given]
    if not texts or not all(isinstance(text, str) and text.strip() for text in texts):
        raise OgPointcloudError(f"the {what} are {given!r:.80}; expected {expected}")
    return tuple(dict.fromkeys(texts))


def _corners(within: Any) -> NDArray[np.float64]:
    """(2, 3) low and high corner."""
    corners = numbers_of(within)
    if corners.shape != (2, 3) or corners.dtype.kind not in "fiu":
        corners = np.full((2, 3), np.nan)
    if not np.isfinite(corners).all() or (corners[0] > corners[1]).any():
        raise OgPointcloudError(f"within is {within!r:.120}; expected two corners of three numbers, the low one first")
    return corners


def _finding(block: Block, row: int, word: str, score: float) -> Finding:
    scene, instance, points = block.entries[block.scene[row]].name, int(block.instance[row]), int(block.points[row])
    (x, y, z), (dx, dy, dz) = block.center[row].tolist(), block.size[row].tolist()
    calibrated = block.bank is not None
    return Finding(scene, instance, word, score, (x, y, z), (dx, dy, dz), points, calibrated, score > 0.5)


def _unanswerable(query: _Query, asked: Sequence[Family]) -> OgPointcloudError:
    word = query.words[0]
    if not asked:
        return OgPointcloudError("no scene has an instance with a feature: nothing can be searched; make masks first")
    if query.given is not None:
        asked[0].space.require(FeatureSpace(UNKNOWN_SPACE, query.given.vectors.shape[1]), "label vectors")
    if query.features is not None and word in query.features[0].names:
        vocabulary, space = query.features
        asked[0].space.require(FeatureSpace(space, vocabulary.vectors.shape[1]), "names of text_features")
    known = {name for family in asked for name in family.words}
    return OgPointcloudError(
        f"'{word}' is not among the {len(known)} words of these scenes{did_you_mean(word, known, ' If not')}: give "
        "text_features with its vector (--text-features), or, for any word, export the encoder once: "
        f"{export_command(asked[0].feature_space)}"
    )
