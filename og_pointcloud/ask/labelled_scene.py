"""Text in, labels out: opens a .ogpc and asks it about points. numpy and onnxruntime, nothing else.

``segment`` is one statement a step: which scene, which words, which instance each point belongs to, which word fits
each instance, if any. Words are judged by ``choosing``, against the scene's word bank if it has one. The lookup of
points is query.onnx's; the few points close to a border, where its table does not promise the answer, are settled
exactly by ``nearest``.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from og_pointcloud.ask.choosing import Chooser, Reason, chooser_of
from og_pointcloud.ask.hosts import carried_scene, world_points
from og_pointcloud.ask.instances import WORDS, Instances, list_instances
from og_pointcloud.ask.segmentation import Segmentation
from og_pointcloud.bundle.nearest import NONE_WITHIN_REACH, NearestPoint, surface_distance
from og_pointcloud.bundle.read import BEYOND, NEAR, ON_SURFACE, Bundle, read_bundle
from og_pointcloud.cloud import TOO_FAR, UNKNOWN_SPACE, FeatureSpace, LabelledCloud, Vocabulary
from og_pointcloud.errors import BundleError, OgPointcloudError, SceneError
from og_pointcloud.text.words import Labels, TextFeatures, resolve_labels

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

__all__ = [
    "SCENE_VARIABLE",
    "LabelledScene",
    "SceneLike",
    "Segmenter",
    "as_scene",
    "find_scene",
    "instance_table",
    "load",
    "segment",
    "use",
]

SceneLike: TypeAlias = "LabelledScene | LabelledCloud | str | os.PathLike[str]"

SCENE_VARIABLE = "OG_POINTCLOUD_SCENE"
POINTS_PER_RUN = 1 << 20
"""What bounds the memory of the graph: about 150 MB."""


class LabelledScene:
    """A labelled cloud that can be asked. Make one with ``load``; it is cheap to keep and safe to share by threads."""

    def __init__(self, bundle: Bundle) -> None:
        self._bundle = bundle
        self._nearest_within: dict[float, NearestPoint] = {}

    @classmethod
    def from_cloud(cls, cloud: LabelledCloud) -> LabelledScene:
        """A scene of a cloud that was never written; makes its graph, which needs the 'fit' extra and takes seconds."""
        from og_pointcloud_export import query_model

        return cls(Bundle(None, cloud, query_model(cloud).onnx, {}))

    @property
    def cloud(self) -> LabelledCloud:
        """Points in the local frame, their instance ids, and what is known of the instances."""
        return self._bundle.cloud

    @property
    def path(self) -> Path | None:
        """The .ogpc file, None for a scene in memory."""
        return self._bundle.path

    @property
    def manifest(self) -> dict[str, Any]:
        """The file's manifest: counts, parity figures, provenance; empty for a scene in memory."""
        return self._bundle.manifest

    @cached_property
    def xyz(self) -> NDArray[np.float64]:
        """(n, 3) float64, world coordinates."""
        return self.cloud.xyz_world

    @property
    def instance_ids(self) -> NDArray[np.int32]:
        """(n,) int32: row of ``instances``, -1 background, -2 unobserved."""
        return self.cloud.instance_ids

    @cached_property
    def certainty(self) -> NDArray[np.float32] | None:
        """(n,) float32 in [0, 1], as ``LabelledCloud.certainty``; None where that is not known."""
        stored = self.cloud.certainty
        return None if stored is None else (stored / 255).astype(np.float32)

    @cached_property
    def instances(self) -> Instances:
        """The instances as a table: row k is instance id k, with its place, boxes, size, evidence and best own words.

        Whole columns, and the descriptors, are in ``cloud.instances``.
        """
        return instance_table(self)

    @property
    def vocabulary(self) -> Vocabulary | None:
        """The words that may be asked as strings, if it has any."""
        return self.cloud.vocabulary

    @property
    def feature_space(self) -> str:
        """Name of the encoder that label vectors must come from."""
        return self.cloud.feature_space

    @property
    def chooser(self) -> Chooser:
        """What tells which label fits each instance, if any; calibrated if the scene has a word bank. Made once."""
        return chooser_of(self.cloud)

    def instance_scores(self, vectors: NDArray[np.floating]) -> NDArray[np.float32]:
        """(K, L) float32: best cosine of an instance's descriptors with each vector, -2 for one without a descriptor.

        vectors: (L, D) of any length. FeatureSpaceError where D is not the scene's.
        """
        self.cloud.space.require(FeatureSpace(UNKNOWN_SPACE, vectors.shape[1]), "label vectors")
        if len(self.cloud.instances.descriptors) == 0:  # no width to hold them to
            vectors = np.zeros((len(vectors), self._text_width), np.float32)
        feed = {"points": np.zeros((0, 3), np.float32), "text": np.ascontiguousarray(vectors, np.float32)}
        scores = self._ask(["instance_scores"], feed)[0]
        if scores.shape != (len(self.cloud.instances), len(vectors)) or scores.dtype != np.float32:
            raise BundleError(
                f"{self.path}: query.onnx gives scores {scores.dtype} {scores.shape}: write the file again"
            )
        return scores

    def instances_at(self, points: NDArray[np.floating], *, max_distance: float | None = None) -> NDArray[np.int32]:
        """(N,) int32: instance id of the scene's point nearest to each, -1, -2, or -3 where none is within reach.

        points: (N, 3), world coordinates. A row with NaN or infinity, as depth cameras send them, is out of reach.
        max_distance: a shorter reach, in the scene's unit; costs an exact search of every point.
        Exact: of points equally near the first one counts, and a point of the scene finds its own id.
        """
        return self.look_up(points, max_distance=max_distance)[0]

    def look_up(
        self, points: NDArray[np.floating], *, max_distance: float | None = None
    ) -> tuple[NDArray[np.int32], NDArray[np.int8]]:
        """What ``instances_at`` answers, and (N,) int8: on the surface, near, or too far, as Segmentation says."""
        points = np.asarray(points, np.float64)
        local = np.empty(points.shape, np.float32)
        with np.errstate(over="ignore"):  # what leaves float32 is infinitely far
            for axis in range(3):  # three times as fast as all in one, which makes a float64 copy of its own
                np.subtract(points[:, axis], self.cloud.origin[axis], out=local[:, axis], casting="same_kind")
        instances, distance = np.empty(len(local), np.int32), np.empty(len(local), np.int8)
        for start in range(0, len(local), POINTS_PER_RUN):
            run = slice(start, start + POINTS_PER_RUN)
            instances[run], distance[run] = self._look_up(local[run])
        if max_distance is not None:
            cut = self._farther_than(max_distance, local, instances)
            instances[cut], distance[cut] = TOO_FAR, BEYOND
        return instances, distance

    def certainty_at(self, points: NDArray[np.floating]) -> NDArray[np.float32] | None:
        """(N,) float32, the certainty of the scene's point nearest to each, 0 where none is within reach; None where
        the scene does not know it. points: (N, 3), world coordinates. An exact search of every point."""
        if self.certainty is None or points is self.xyz:
            return self.certainty
        of_points = np.append(self.certainty, np.float32(0))
        certainty = np.zeros(len(points), np.float32)
        finite = np.isfinite(points).all(axis=1)
        local = (np.asarray(points, np.float64)[finite] - self.cloud.origin).astype(np.float32)
        certainty[finite] = of_points[self._nearest.query(local)]  # NONE_WITHIN_REACH is the last
        return certainty

    def _look_up(self, local: NDArray[np.float32]) -> tuple[NDArray[np.int32], NDArray[np.int8]]:
        feed = {"points": local, "text": np.zeros((0, self._text_width), np.float32)}
        instances, distance, certain = self._ask(["instance", "distance", "certain"], feed)
        self._check_answers(len(local), instances, distance, certain)
        if certain.all():
            return instances, distance
        still_open = np.flatnonzero(~certain)
        still_open = still_open[np.isfinite(local[still_open]).all(axis=1)]  # the others are too far already
        nearest = self._nearest.query(local[still_open])
        instances[still_open] = np.append(self.instance_ids, np.int32(TOO_FAR))[nearest]
        surface = surface_distance(self.cloud.spacing, self.cloud.reach)
        on_surface = self._nearest.distance(local[still_open], nearest) <= surface
        distance[still_open] = np.where(nearest == NONE_WITHIN_REACH, BEYOND, np.where(on_surface, ON_SURFACE, NEAR))
        return instances, distance

    def _ask(self, outputs: list[str], feed: dict[str, NDArray[np.float32]]) -> list[NDArray[Any]]:
        try:
            return [np.asarray(output) for output in self._session.run(outputs, feed)]
        except Exception as error:  # onnxruntime raises types of its own
            raise BundleError(f"{self.path}: query.onnx fails ({_first_line(error)}): write the file again") from None

    def _check_answers(
        self, count: int, instances: NDArray[Any], distance: NDArray[Any], certain: NDArray[Any]
    ) -> None:
        """A foreign graph may answer anything; nothing is looked up by a number that is none of ours."""
        kinds = [(values.shape, values.dtype) for values in (instances, distance, certain)]
        good = kinds == [((count,), np.dtype(kind)) for kind in (np.int32, np.int8, np.bool_)]
        if not good or (count and not (instances.min() >= TOO_FAR and instances.max() < len(self.cloud.instances))):
            raise BundleError(f"{self.path}: query.onnx answers what is no instance of this file: write the file again")

    def _farther_than(
        self, max_distance: float, local: NDArray[np.float32], instances: NDArray[np.int32]
    ) -> NDArray[np.int64]:
        """Rows of points within reach, but with no cloud point within that distance."""
        if not 0 < max_distance <= self.cloud.reach:
            raise OgPointcloudError(
                f"max_distance is {max_distance}; expected a length up to the scene's reach, {self.cloud.reach:.4g}: "
                "points farther than that have no label"
            )
        within_reach = np.flatnonzero(instances != TOO_FAR)
        search = self._nearest_within.get(max_distance)
        if search is None:  # only the last one is kept: a stream asks for the same again and again
            search = NearestPoint(self.cloud.xyz, self.cloud.spacing, max_distance)
            self._nearest_within = {max_distance: search}
        return within_reach[search.query(local[within_reach]) == NONE_WITHIN_REACH]

    @cached_property
    def _session(self) -> InferenceSession:
        from og_pointcloud.models import open_session

        try:
            session = open_session(self._bundle.query_onnx)
        except Exception as error:  # onnxruntime raises types of its own for a graph that it cannot run
            raise BundleError(
                f"{self.path}: query.onnx does not run ({_first_line(error)}): write the file again"
            ) from None
        inputs = {given.name: given for given in session.get_inputs()}
        outputs = {given.name for given in session.get_outputs()}
        if set(inputs) != {"points", "text"} or not {"instance", "distance", "certain", "instance_scores"} <= outputs:
            raise BundleError(
                f"{self.path}: query.onnx takes {sorted(inputs)} and gives {sorted(outputs)}: write the file again"
            )
        shape = inputs["text"].shape
        if len(shape) != 2 or not isinstance(shape[1], int):
            raise BundleError(f"{self.path}: query.onnx takes text of shape {shape}, of no width: write the file again")
        return session

    @property
    def _text_width(self) -> int:
        return next(given.shape[1] for given in self._session.get_inputs() if given.name == "text")

    @cached_property
    def _nearest(self) -> NearestPoint:
        return NearestPoint(self.cloud.xyz, self.cloud.spacing, self.cloud.reach)


def load(path: str | os.PathLike[str]) -> LabelledScene:
    """Open a .ogpc file; BundleError says what is wrong with any other."""
    return LabelledScene(read_bundle(path))


def use(scene: SceneLike | None) -> LabelledScene | None:
    """Make a scene, or a .ogpc file, the one that ``segment`` asks when it is given none. None forgets it."""
    global _scene_in_use
    _scene_in_use = None if scene is None else as_scene(scene)
    return _scene_in_use


def segment(
    pcd: Any,
    labels: Labels = None,
    scene: SceneLike | None = None,
    *,
    text_features: TextFeatures = None,
    templates: Sequence[str] | None = None,
    negatives: Labels = None,
    pose: ArrayLike | None = None,
    max_distance: float | None = None,
) -> Segmentation:
    """Label the points of a cloud by words. The cloud may be of any density, a crop, noisy, or in a frame of its own.

    A scene with a word bank (``scene.cloud.word_bank``) answers probabilities, and unknown where no label is probable;
    one without answers the label with the largest cosine. The result says which (``calibrated``), and why a point is
    unknown (``reasons``).

    pcd: an array (N, 3) of world coordinates, a cloud or mesh of Open3D, PyVista or trimesh, a geometry file; or a
        scene, a LabelledCloud or a .ogpc file, whose own points are then labelled. Rows with NaN answer unknown.
    labels: words, found in text_features or in the scene's vocabulary (None: all of them), or encoded, if the scene's
        text encoder is found; or name -> vector (D,).
    scene: what to ask. Left out: the scene that the cloud is or carries, else that of ``use``, else the file that the
        environment variable OG_POINTCLOUD_SCENE names.
    text_features: a text-features .npz, or what ``read_text_features`` returned for it.
    templates: texts with ``{}`` ("a photo of a {}"), into which words are put before they are encoded; their vectors'
        mean counts. Left out: stored vectors, and the encoder's own templates for other words.
    negatives: labels too, but points that they fit better are unknown.
    pose: (4, 4), takes the cloud's coordinates to the scene's world. Left out: they are world coordinates.
    max_distance: points farther than this from the scene's cloud answer unknown; at most, and left out, its reach.

    Warns where no point gets a label, and says why. Raises OgPointcloudError and its kinds: SceneError (no cloud),
    BundleError (no scene), FeatureSpaceError (vectors of another space or width).
    """
    pcd = as_scene(pcd) if _is_scene(pcd) else pcd
    scene = find_scene(pcd, scene)
    words, answers = _answers(scene, labels, text_features, templates, negatives)
    if pcd is scene and pose is None:
        points, instances = scene.xyz, scene.instance_ids
        distance = np.full(len(points), ON_SURFACE, np.int8)
    else:
        points = _posed(pcd.xyz if isinstance(pcd, LabelledScene) else world_points(pcd), pose)
        instances, distance = scene.look_up(points, max_distance=max_distance)
    result = _label(scene, words, answers, points, instances, distance)
    if reason := _why_nothing(result, scene):
        warnings.warn(reason, stacklevel=2)
    return result


class Segmenter:
    """The same labels for many clouds: words are scored once, and a call only looks points up.

    Several threads may call it at once; memory does not grow from call to call.
    scene, labels, text_features, templates, negatives, max_distance: as for ``segment``.
    """

    def __init__(
        self,
        scene: SceneLike,
        labels: Labels = None,
        *,
        text_features: TextFeatures = None,
        templates: Sequence[str] | None = None,
        negatives: Labels = None,
        max_distance: float | None = None,
    ) -> None:
        self.scene, self._max_distance = as_scene(scene), max_distance
        self._words, self._answers = _answers(self.scene, labels, text_features, templates, negatives)
        self._warned = False

    @property
    def names(self) -> tuple[str, ...]:
        """The labels, in the order of their numbers."""
        return self._words.names

    def __call__(self, points: Any, pose: ArrayLike | None = None) -> Segmentation:
        """points: (N, 3) world coordinates, or any cloud that ``segment`` takes; N may be 0.

        pose: (4, 4), takes the points to the scene's world, as a sensor's pose in the map does; ``xyz`` of the result
        is then in the world too.
        Warns the first time that no point gets a label, not at every empty frame of a stream.
        """
        points = _posed(world_points(points), pose)
        found = self.scene.look_up(points, max_distance=self._max_distance)
        result = _label(self.scene, self._words, self._answers, points, *found)
        if not self._warned and (reason := _why_nothing(result, self.scene)):
            self._warned = True
            warnings.warn(reason, stacklevel=2)
        return result


def instance_table(
    scene: SceneLike,
    labels: Labels = None,
    *,
    text_features: TextFeatures = None,
    up: ArrayLike | None = None,
    words: int = WORDS,
) -> Instances:
    """The instances of a scene as a table.

    scene: a loaded scene, a LabelledCloud or the path of a .ogpc file.
    labels, text_features: the words to choose among, as for ``segment``; left out, the scene's own, or none.
    up: (3,) direction that the oriented boxes stand upright on, where it is known. words: how many a row names.
    """
    scene = as_scene(scene)
    own, asked = scene.vocabulary, None
    if labels is not None or text_features is not None or (own and own.names):
        asked = resolve_labels(labels, text_features, own, scene.feature_space, scene.path)
    return list_instances(scene.cloud, scene.chooser, asked, up=up, words=words)


_scene_in_use: LabelledScene | None = None


def _is_scene(pcd: Any) -> bool:
    is_file = isinstance(pcd, (str, os.PathLike)) and Path(pcd).suffix == ".ogpc"
    return is_file or isinstance(pcd, (LabelledScene, LabelledCloud))


def find_scene(pcd: Any, scene: SceneLike | None) -> LabelledScene:
    """The scene that answers for a cloud: the one given, else that the cloud is or carries, else that of ``use``, else
    that of the environment; OgPointcloudError names these ways."""
    if scene is not None:
        return as_scene(scene)
    if isinstance(pcd, LabelledScene):
        return pcd
    if (carried := carried_scene(pcd)) is not None:
        return as_scene(carried)
    if _scene_in_use is not None:
        return _scene_in_use
    if path := os.environ.get(SCENE_VARIABLE):
        return as_scene(path)
    raise OgPointcloudError(
        "no scene to ask: pass scene=og.load('S.ogpc') (or its path), or call og.use('S.ogpc') once, or set "
        f"{SCENE_VARIABLE}, or segment a labelled cloud itself"
    )


def as_scene(source: SceneLike) -> LabelledScene:
    """A scene that can be asked, of whatever names one; the same again for a cloud or file that has not changed."""
    if isinstance(source, LabelledScene):
        return source
    if isinstance(source, LabelledCloud):
        return _scene_of_cloud(source)
    if isinstance(source, (str, os.PathLike)):
        path = Path(source).resolve()
        if not path.is_file():
            return load(source)  # which says what is wrong
        state = path.stat()
        return _load_once(path, state.st_mtime_ns, state.st_size)
    raise OgPointcloudError(
        f"scene is a {type(source).__name__}; expected a loaded scene, a LabelledCloud or the path of a .ogpc file"
    )


@lru_cache(maxsize=2)
def _load_once(path: Path, modified: int, size: int) -> LabelledScene:
    """The scene of a file that has not changed since: naming it again and again costs nothing."""
    return load(path)


def _scene_of_cloud(cloud: LabelledCloud) -> LabelledScene:
    """The cloud keeps its scene, so that asking it again is quick."""
    scene = cloud.__dict__.get("_scene")
    if scene is None:
        scene = LabelledScene.from_cloud(cloud)
        cloud.__dict__["_scene"] = scene
    return scene


def _first_line(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0][:200]


def _posed(points: NDArray[np.float64], pose: ArrayLike | None) -> NDArray[np.float64]:
    if pose is None:
        return points
    matrix = np.asarray(pose)
    if matrix.shape != (4, 4) or matrix.dtype.kind not in "fiu" or not np.isfinite(matrix).all():
        raise SceneError(f"pose is {matrix.dtype} {matrix.shape}; expected a finite 4x4 matrix, cloud to world")
    matrix = matrix.astype(np.float64)
    if np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise SceneError(
            f"the last row of pose is {matrix[3].tolist()}; expected 0 0 0 1: give the matrix whose last column is the "
            "translation (transposed, perhaps?)"
        )
    with np.errstate(invalid="ignore", over="ignore"):  # rows with NaN or infinity stay such
        return points @ matrix[:3, :3].T + matrix[:3, 3]


def _answers(
    scene: LabelledScene,
    labels: Labels,
    text_features: TextFeatures,
    templates: Sequence[str] | None,
    negatives: Labels,
) -> tuple[Vocabulary, Answers]:
    """The words asked, and what they make of each instance id."""
    known = (text_features, scene.vocabulary, scene.feature_space, scene.path)
    words, against = resolve_labels(labels, *known, templates), None
    if negatives is not None:
        has_vectors = isinstance(negatives, (Mapping, Vocabulary))
        against = resolve_labels(negatives, *known, None if has_vectors else templates).vectors
    choice = scene.chooser.choose(words.vectors, against)
    return words, Answers(*choice.by_id, choice.calibrated)


class Answers(NamedTuple):
    """Label, score and reason of each instance id (`Choice.by_id`)."""

    labels: NDArray[np.int32]
    scores: NDArray[np.float32]
    reasons: NDArray[np.int8]
    calibrated: bool


def _label(
    scene: LabelledScene,
    words: Vocabulary,
    answers: Answers,
    points: NDArray[np.float64],
    instances: NDArray[np.int32],
    distance: NDArray[np.int8],
) -> Segmentation:
    # A negative instance counts from the end, where those of no instance lie.
    return Segmentation(
        points, answers.labels[instances], answers.scores[instances], instances, words.names, scene.path, distance,
        answers.reasons[instances], answers.calibrated, scene.certainty_at,
    )  # fmt: skip


def _why_nothing(result: Segmentation, scene: LabelledScene) -> str | None:
    """Why no point has a label; None if one has."""
    if len(result) == 0:
        return "no point has a label: the cloud has 0 points (a file that could not be read may give such a cloud)"
    if not result.reasons.all():  # Reason.LABELLED is 0
        return None
    counts = result.unknown_because()
    parts = [f"{count} are {reason}" for reason, count in counts.items()]
    advice = ""
    if set(counts) == {Reason.TOO_FAR} and len(scene.cloud) and (finite := np.isfinite(result.xyz).all(axis=1)).any():
        advice = (
            f"; the points span {_box(result.xyz[finite])}, the scene {_box(scene.xyz)}, its reach is "
            f"{scene.cloud.reach:.4g}: bring them into the scene's frame and unit"
        )
    return f"none of {len(result)} points has a label: {', '.join(parts)}{advice}"


def _box(points: NDArray[np.float64]) -> str:
    low, high = points.min(axis=0), points.max(axis=0)
    return " x ".join(f"{a:.6g}..{b:.6g}" for a, b in zip(low, high, strict=True))
