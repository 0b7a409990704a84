"""Select instances by words: ranks all instances by one text, and tells which ones it fits.

A cosine alone says little: what counts as high differs from scene to scene and word to word. So the text competes with
other words, and with the scene's word bank if it has one: it selects the instances that `segment` would label with it.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence, Sized
from dataclasses import dataclass, field, fields
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from og_pointcloud.ask.boxes import Box
from og_pointcloud.ask.choosing import Choice, Reason
from og_pointcloud.ask.instances import MAX_ROWS_SHOWN
from og_pointcloud.ask.labelled_scene import LabelledScene, SceneLike, as_scene
from og_pointcloud.cloud import NO_EVIDENCE, FeatureSpace, Vocabulary
from og_pointcloud.errors import OgPointcloudError, counted, printable
from og_pointcloud.text.words import Labels, TextFeatures


@dataclass(frozen=True)
class Match:
    """An instance compared with a text. points: its number of points.

    score: the probability that it is what the text says if the selection is calibrated, else their cosine.
    fits: whether neither another word nor "none of these" is more probable. If not calibrated: whether no other word
    has a higher cosine or, without other words, whether it is the best instance.
    rival, rival_score: the other word that fits it best, and its score; None and -2 if no other word was given.

    >>> best = og.select(cloud, "desk").best  # of `LabelledCloud`'s example
    >>> best.instance, best.score, best.fits, best.rival
    (1, 1.0, True, 'chair')
    """

    instance: int
    score: float
    fits: bool
    rival: str | None
    rival_score: float
    points: int
    _scene: LabelledScene = field(repr=False, compare=False)

    @property
    def oriented_box(self) -> Box | None:
        """`Instance.oriented_box` of its row in the scene's table of instances."""
        return self._scene.instances[self.instance].oriented_box

    def to_dict(self) -> dict[str, Any]:
        """JSON-able."""
        shown = {each.name: getattr(self, each.name) for each in fields(self) if each.repr}
        return shown | {"rival_score": None if self.rival is None else self.rival_score}


@dataclass(frozen=True)
class Selection(Sequence[Match]):
    """Instances ranked by a text: all that have points and a feature, best first; ties go to the smaller id.

    query: the text. rivals: number of other words that competed. unknown: number of instances with points but without a
    feature, which no text can find. calibrated: whether the scene has a word bank, so that scores are probabilities.

    >>> selection = og.select(cloud, "chair")  # of `LabelledCloud`'s example
    >>> selection.instances, selection.point_indices
    ((0,), array([0, 1]))
    """

    query: str
    matches: tuple[Match, ...]
    rivals: int
    unknown: int
    calibrated: bool
    scene: LabelledScene = field(repr=False)

    def __len__(self) -> int:
        return len(self.matches)

    @overload
    def __getitem__(self, index: int) -> Match: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Match, ...]: ...
    def __getitem__(self, index: int | slice) -> Match | tuple[Match, ...]:
        """By rank: 0 is the best."""
        return self.matches[index]

    @property
    def best(self) -> Match | None:
        """The instance with the highest score, whether or not the text fits it; None if there is none."""
        return self.matches[0] if self.matches else None

    @property
    def fitting(self) -> tuple[Match, ...]:
        """The matches that the text fits; without rivals or word bank only the best, as nothing tells more."""
        return tuple(match for match in self.matches if match.fits)

    @property
    def instances(self) -> tuple[int, ...]:
        """Ids of the fitting instances, best first."""
        return tuple(match.instance for match in self.fitting)

    @property
    def point_indices(self) -> NDArray[np.int64]:
        """(m,) indices of the scene's points in fitting instances, ascending."""
        return np.flatnonzero(np.isin(self.scene.instance_ids, self.instances))

    def to_json(self) -> str:
        """The query, and every match in order."""
        names = ("query", "rivals", "unknown", "calibrated")
        record = {name: getattr(self, name) for name in names} | {"matches": [match.to_dict() for match in self]}
        return json.dumps(record, indent=2, ensure_ascii=False)

    def __repr__(self) -> str:
        lines = [f"'{printable(self.query, 60)}' fits {len(self.fitting)} of {counted(len(self), 'instance')}"]
        for match in self[:MAX_ROWS_SHOWN]:
            mark = "*" if match.fits else " "
            rival = f"{printable(match.rival, 40)} {match.rival_score:.3f}" if match.rival else "-"
            lines.append(
                f"{mark} instance {match.instance:<5} {match.score:.3f}  {match.points:>9,} points  rival {rival}"
            )
        if len(self) > MAX_ROWS_SHOWN:
            lines.append(f"and {len(self) - MAX_ROWS_SHOWN} that it fits less")
        return "\n".join(lines)


def select(
    scene: SceneLike, text: str | Mapping[str, ArrayLike], *, against: Labels = None, text_features: TextFeatures = None
) -> Selection:
    """Rank the instances of a scene by a text, and tell which ones it fits.

    scene: a loaded scene, a LabelledCloud or the path of a .ogpc file.
    text: a word or phrase, found as for ``segment``; or one name -> vector (D,).
    against: the words that compete, as labels of ``segment``; left out, all other words of text_features or the scene;
        an empty list for the word bank alone. Rivals with the same meaning ("cup" for "mug") share the instances.

    Raises OgPointcloudError if text is not one word or phrase, else as ``segment``.

    >>> [(match.instance, match.score) for match in og.select(cloud, "desk")]  # of `LabelledCloud`'s example
    [(1, 1.0), (0, 0.0)]
    """
    scene = as_scene(scene)
    if not isinstance(text, str) and (not isinstance(text, Mapping) or len(text) != 1):
        shown = list(text) if isinstance(text, Mapping) else text
        raise OgPointcloudError(f"the text is {shown!r:.80}; expected one word or phrase, or one name -> vector")
    query = scene.words(text, text_features)
    asked = FeatureSpace(scene.feature_space, query.vectors.shape[1])
    scene.cloud.space.require(asked, f"vector of '{query.names[0]}'")
    rivals = _rivals(scene, query, against, text_features)
    choice = scene.chooser.choose(np.concatenate([query.vectors, rivals.vectors]))  # label 0 is the query
    points = np.bincount(scene.instance_ids[scene.instance_ids >= 0], minlength=len(choice.labels))
    known = (points > 0) & (choice.reasons != Reason.NOT_DESCRIBED)
    ranked = [int(k) for k in choice.ranking(0) if known[k]]
    # With neither rivals nor bank, label 0 would fit every instance: then only the best one counts as fitting.
    fitting = set(np.flatnonzero(choice.labels == 0).tolist() if rivals.names or choice.calibrated else ranked[:1])
    return Selection(
        query=query.names[0],
        matches=tuple(_match(scene, k, choice, k in fitting, rivals.names, int(points[k])) for k in ranked),
        rivals=len(rivals.names),
        unknown=int(((points > 0) & ~known).sum()),
        calibrated=choice.calibrated,
        scene=scene,
    )


def _match(
    scene: LabelledScene, instance: int, choice: Choice, fits: bool, rivals: Sequence[str], points: int
) -> Match:
    """One instance's match. choice: label 0 is the query, the labels after it are its rivals."""
    score, rival, rival_score = float(choice.scores[instance, 0]), None, NO_EVIDENCE
    if rivals:
        best = int(choice.evidence[instance, 1:].argmax())
        rival, rival_score = rivals[best], float(choice.scores[instance, 1 + best])
    return Match(instance, score, fits, rival, rival_score, points, scene)


def _rivals(scene: LabelledScene, query: Vocabulary, against: Labels, text_features: TextFeatures) -> Vocabulary:
    """The words that compete with the query, without itself."""
    if isinstance(against, np.ndarray):
        against = np.atleast_1d(against)  # an array without dimensions is one word
    elif isinstance(against, Iterable) and not isinstance(against, Sized):  # an iterator can be counted only once
        against = list(against)
    none_wanted = isinstance(against, Sized) and not len(against)  # []; None asks for all known words
    words = query if none_wanted else scene.known_words(against, text_features)
    others = [index for index, name in enumerate(words.names) if name != query.names[0]]
    if not others:
        return Vocabulary((), query.vectors[:0])
    query_space, space = (FeatureSpace(scene.feature_space, of.vectors.shape[1]) for of in (query, words))
    query_space.require(space, f"words that compete with '{query.names[0]}'")
    return Vocabulary(tuple(words.names[index] for index in others), words.vectors[others])
