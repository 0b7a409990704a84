"""Words select instances: all of them ranked by one text, and which the text fits better than any other word does.

A cosine alone says little: what counts as high differs from scene to scene and word to word. So the text competes: an
instance is selected where no rival word fits it better, as `segment` would label it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from og_pointcloud.bundle import NO_EVIDENCE
from og_pointcloud.cloud import Vocabulary
from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.instances import SHOWN, as_scene
from og_pointcloud.runtime import LabelledScene, SceneLike
from og_pointcloud.words import Labels, TextFeatures, resolve_labels

__all__ = ["Match", "Selection", "select"]


@dataclass(frozen=True)
class Match:
    """An instance beside a text. score: their cosine. points: how many it has.

    fits: whether no other word fits it better; where no other word was given, whether it is the best of all.
    rival: the other word that fits it best, with its cosine; None and -2 where no other word was given.
    """

    instance: int
    score: float
    fits: bool
    rival: str | None
    rival_score: float
    points: int

    def to_dict(self) -> dict[str, Any]:
        """JSON-able."""
        rival_score = None if self.rival is None else self.rival_score
        return {
            "instance": self.instance, "score": self.score, "fits": self.fits, "rival": self.rival,
            "rival_score": rival_score, "points": self.points,
        }  # fmt: skip


@dataclass(frozen=True)
class Selection(Sequence[Match]):
    """What a text selects: every instance that has points and a feature, best first, of equals the smaller id.

    query: the text. rivals: how many other words competed. unknown: instances with points that have no feature, which
    no text can find.
    """

    query: str
    matches: tuple[Match, ...]
    rivals: int
    unknown: int
    scene: LabelledScene = field(repr=False)

    def __len__(self) -> int:
        return len(self.matches)

    def __iter__(self) -> Iterator[Match]:
        return iter(self.matches)

    @overload
    def __getitem__(self, index: int) -> Match: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Match, ...]: ...
    def __getitem__(self, index: int | slice) -> Match | tuple[Match, ...]:
        """By rank: 0 is the best."""
        return self.matches[index]

    @property
    def best(self) -> Match | None:
        """The instance with the highest cosine, whether or not another word fits it better; None without any."""
        return self.matches[0] if self.matches else None

    @property
    def fitting(self) -> tuple[Match, ...]:
        """Those that the text fits better than every rival; without rivals the best alone, as nothing tells more."""
        return tuple(match for match in self.matches if match.fits)

    @property
    def instances(self) -> tuple[int, ...]:
        """Ids of the fitting instances, best first."""
        return tuple(match.instance for match in self.fitting)

    @property
    def point_indices(self) -> NDArray[np.int64]:
        """(m,) the scene's points that belong to fitting instances, ascending."""
        return np.flatnonzero(np.isin(self.scene.instance_ids, self.instances))

    def points_of(self, match: Match) -> NDArray[np.int64]:
        """(m,) the scene's points that belong to one match, ascending."""
        return np.flatnonzero(self.scene.instance_ids == match.instance)

    def to_json(self) -> str:
        """The query, and every match in order."""
        record = {"query": self.query, "rivals": self.rivals, "unknown": self.unknown}
        return json.dumps({**record, "matches": [match.to_dict() for match in self]}, indent=2, ensure_ascii=False)

    def __str__(self) -> str:
        lines = [f"'{self.query}' fits {len(self.fitting)} of {len(self)} instances"]
        for match in self[:SHOWN]:
            mark = "*" if match.fits else " "
            rival = f"{match.rival} {match.rival_score:.3f}" if match.rival else "-"
            lines.append(
                f"{mark} instance {match.instance:<5} {match.score:.3f}  {match.points:>9,} points  rival {rival}"
            )
        if len(self) > SHOWN:
            lines.append(f"and {len(self) - SHOWN} that it fits less")
        return "\n".join(lines)


def select(
    scene: SceneLike,
    text: str | Mapping[str, ArrayLike],
    *,
    against: Labels = None,
    text_features: TextFeatures = None,
) -> Selection:
    """Rank the instances of a scene by a text, and say which it fits.

    scene: a loaded scene, a LabelledCloud or the path of a .ogpc file.
    text: a word or phrase, found as for ``segment``; or one name -> vector (D,).
    against: the words that compete, as labels of ``segment``; left out, all others that text_features or the scene
        know; an empty list for none. Rivals that mean the same ("cup" for "mug") share the instances between them.

    Raises OgPointcloudError where text is not one word, else as ``segment``.
    """
    scene = as_scene(scene)
    if not isinstance(text, str) and (not isinstance(text, Mapping) or len(text) != 1):
        shown = list(text) if isinstance(text, Mapping) else text
        raise OgPointcloudError(f"the text is {shown!r:.80}; expected one word or phrase, or one name -> vector")
    query = resolve_labels(text, text_features, scene.vocabulary, scene.feature_space, scene.path)
    rivals = _rivals(scene, query.names[0], against, text_features)
    scores = scene.instance_scores(query.vectors)[:, 0]
    names: list[str | None] = [None] * len(scores)
    rival_scores = np.full(len(scores), NO_EVIDENCE, np.float32)
    if rivals is not None:
        of_each = scene.instance_scores(rivals.vectors)
        names = [rivals.names[index] for index in of_each.argmax(axis=1)]
        rival_scores = of_each.max(axis=1)
    points = np.bincount(scene.instance_ids[scene.instance_ids >= 0], minlength=len(scores))
    known = (scores > NO_EVIDENCE) & (points > 0)
    ranked = [int(k) for k in np.argsort(-scores, kind="stable") if known[k]]
    fits = scores >= rival_scores if rivals else np.isin(np.arange(len(scores)), ranked[:1])
    return Selection(
        query=query.names[0],
        matches=tuple(
            Match(k, float(scores[k]), bool(fits[k]), names[k], float(rival_scores[k]), int(points[k])) for k in ranked
        ),
        rivals=len(rivals.names) if rivals else 0,
        unknown=int(((points > 0) & ~known).sum()),
        scene=scene,
    )


def _rivals(scene: LabelledScene, query: str, against: Labels, text_features: TextFeatures) -> Vocabulary | None:
    """The words that compete with the query, without itself; None without any."""
    own = scene.vocabulary
    if against is None and text_features is None and not (own and own.names):
        return None
    if isinstance(against, Sequence) and not len(against):
        return None
    words = resolve_labels(against, text_features, own, scene.feature_space, scene.path)
    others = [index for index, name in enumerate(words.names) if name != query]
    return Vocabulary(tuple(words.names[index] for index in others), words.vectors[others]) if others else None
