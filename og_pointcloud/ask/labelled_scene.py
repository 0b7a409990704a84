"""Text in, labels out: opens a .ogpc file and queries it for points. Needs numpy and onnxruntime alone.

``segment`` finds the scene, then the words, then the instance of each point, then the word that fits each instance, if
any. ``choosing`` judges words, against the scene's word bank if it has one. query.onnx looks points up; for the few
close to a border, where its table does not guarantee the answer, ``nearest`` searches the cloud. A scene in memory has
no graph: every point is searched for, with the same result.
"""

from __future__ import annotations

import os
import warnings
from functools import cached_property, lru_cache, partial
from numbers import Real
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from og_pointcloud.ask.choosing import Chooser, Reason
from og_pointcloud.ask.hosts import carried_scene, import_plugin, world_points
from og_pointcloud.ask.instances import WORDS_PER_ROW, Instances, list_instances
from og_pointcloud.ask.query_graph import QueryGraph
from og_pointcloud.ask.segmentation import Segmentation
from og_pointcloud.bundle.nearest import NearestPoint
from og_pointcloud.bundle.read import Bundle, read_bundle
from og_pointcloud.bundle.vocabulary import carried_encoder
from og_pointcloud.cloud import TOO_FAR, LabelledCloud, Vocabulary
from og_pointcloud.errors import OgPointcloudError, SceneError, counted, span
from og_pointcloud.formats.atomic import StrPath
from og_pointcloud.scene import (
    ROTATION_TOLERANCE,
    DoubleArray,
    FloatArray,
    IntArray,
    float32_step,
    numbers_of,
    pose_matrix,
    rotation_error,
    rounded_pose,
)
from og_pointcloud.text.words import Labels, TextFeatures, resolve_labels

SceneLike: TypeAlias = "LabelledScene | LabelledCloud | StrPath"

MISPLACED_SHARE = 1 / 3
"""If more than this share of the query points is too far from the scene, the two may be in different frames."""
SAMPLE_POINTS, MIN_SAMPLE_POINTS = 1000, 100
"""About so many evenly spread points of a cloud tell whether its unit and precision fit the scene; fewer than the
second number tell nothing."""
WIDE_SCENE_REACHES = 10
"""A cloud narrower than the reach, in a scene wider than this many reaches, is probably in another unit."""
POINTS_PER_RUN = 1 << 20
"""Points given to the graph at once, which limits its memory to about 150 MB."""


class LabelledScene:
    """A labelled cloud to query. Made by ``load``; cheap to keep and thread-safe.

    cloud: points in the local frame, their instance ids, and the instance table. path, manifest: the .ogpc file and its
    manifest with counts, parity figures, provenance; None and empty for a scene in memory.
    instance_ids: (n,) int32, row of ``instances``, -1 background, -2 unobserved. vocabulary: words that can be given
    as strings, None if there are none. feature_space: name of the encoder that label vectors must come from.
    Its arrays are read-only, as later answers depend on them: Open3D's Vector3dVector needs `xyz.copy()`.

    >>> scene = og.LabelledScene.from_cloud(cloud)  # of `LabelledCloud`'s example; og.load reads a file
    >>> scene.instances_at(np.array([[0.02, 0, 1], [1, 0.1, 1], [9, 9, 9]]))
    array([ 0,  1, -3], dtype=int32)
    >>> len(scene.instances), scene.vocabulary.names
    (2, ('chair', 'desk'))
    """

    def __init__(self, bundle: Bundle) -> None:
        self._bundle, cloud = bundle, bundle.cloud
        self.cloud, self.path, self.manifest = cloud, bundle.path, bundle.manifest
        self.instance_ids = _read_only(cloud.instance_ids.view())  # the cloud's own array may be a caller's
        self.vocabulary, self.feature_space = cloud.vocabulary, cloud.feature_space

    def __repr__(self) -> str:
        words = counted(len(self.vocabulary.names), "word") if self.vocabulary else "no words of its own"
        place = "in memory" if self.path is None else f"'{self.path}'"
        return (
            f"LabelledScene({place}: {counted(len(self.instance_ids), 'point')}, "
            f"{counted(len(self.cloud.instances), 'instance')}, {words}, feature space '{self.feature_space}')"
        )

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickles the file's content, not the open session: each process opens its own."""
        return LabelledScene, (self._bundle,)

    @classmethod
    def from_cloud(cls, cloud: LabelledCloud) -> LabelledScene:
        """A scene of a cloud that was never written to a file; its answers are the same. The first one comes sooner, as
        no graph is opened; many points take longer, as each is searched for."""
        return cls(Bundle(None, cloud, None, {}))

    @cached_property
    def xyz(self) -> DoubleArray:
        """(n, 3) float64, world coordinates."""
        return _read_only(self.cloud.xyz_world)

    @cached_property
    def certainty(self) -> FloatArray | None:
        """(n,) float32 in [0, 1], as ``LabelledCloud.certainty``; None where that is not known."""
        stored = self.cloud.certainty
        return None if stored is None else _read_only((stored / 255).astype(np.float32))

    @cached_property
    def instances(self) -> Instances:
        """The instances as a table: row k is instance id k, with its position, boxes, size, evidence and best words of
        the scene's vocabulary. Whole columns, and the descriptors, are in ``cloud.instances``."""
        return instance_table(self)

    def show(self, labels: Labels = None, *, text_features: TextFeatures = None) -> Any:
        """A live page of the scene, which a notebook shows in its cell; `og-pointcloud serve` on the command line.

        labels, text_features: as for ``segment``. Returns at once with the page, which has ``url``, ``wait`` and
        ``stop``. Served to this machine alone. Needs the extra 'serve'.
        """
        return import_plugin("og_pointcloud.show.serve", "serve").show(self, labels, text_features=text_features)

    @cached_property
    def chooser(self) -> Chooser:
        """Decides which label fits each instance, if any; calibrated if the scene has a word bank."""
        return Chooser(self.cloud.instances, self.cloud.word_bank, feature_space=self.feature_space)

    def words(self, labels: Labels = None, text_features: TextFeatures = None) -> Vocabulary:
        """Labels with their vectors, found as for ``segment``: given, from a file, the scene's own, or encoded."""
        encoder = carried_encoder(self.path)
        return resolve_labels(labels, text_features, self.vocabulary, self.feature_space, encoder)

    def known_words(self, labels: Labels = None, text_features: TextFeatures = None) -> Vocabulary:
        """The same, but an empty vocabulary if no words are given and the scene has none."""
        given = labels is not None or text_features is not None
        if given or (self.vocabulary and self.vocabulary.names):
            return self.words(labels, text_features)
        return Vocabulary((), np.zeros((0, self.cloud.space.width), np.float32))

    def instances_at(self, points: NDArray[np.floating], *, max_distance: float | None = None) -> IntArray:
        """(N,) int32: instance id of the scene point nearest to each point, -1, -2, or -3 if none is within reach.

        points: (N, 3), world coordinates. A row with NaN or infinity, as depth cameras send them, is out of reach.
        max_distance: a shorter reach, in the scene's unit; costs an exact search for every point.
        Exact: among equally near points the first one wins, and a point of the scene finds its own id.
        """
        self.check_distance(max_distance)
        return self._instances_at(self._local(points), max_distance)

    def _instances_at(self, local: FloatArray, max_distance: float | None) -> IntArray:
        """The same for points (N, 3) in the cloud's frame."""
        instances = np.empty(len(local), np.int32)
        for start in range(0, len(local), POINTS_PER_RUN):
            run = slice(start, start + POINTS_PER_RUN)
            instances[run] = self._look_up(local[run])
        if max_distance is not None:
            within_reach = np.flatnonzero(instances != TOO_FAR)
            nearest = self.nearest.query(local[within_reach])
            beyond = within_reach[self.nearest.distance(local[within_reach], nearest) > max_distance]
            instances[beyond] = TOO_FAR
        return instances

    def check_distance(self, max_distance: float | None) -> None:
        """OgPointcloudError unless the distance is a length above 0, and at most the scene's reach."""
        if max_distance is not None and not (isinstance(max_distance, Real) and 0 < max_distance <= self.cloud.reach):
            raise OgPointcloudError(
                f"max_distance is {max_distance!r:.40}; expected a length up to the scene's reach, "
                f"{self.cloud.reach:.4g}: points farther than that have no label"
            )

    def certainty_at(self, points: NDArray[np.floating]) -> FloatArray | None:
        """(N,) float32, certainty of the scene point nearest to each point, 0 if none is within reach; None if the
        scene has no certainty. points: (N, 3), world coordinates. An exact search for every point."""
        return self.certainty if points is self.xyz else self._certainty_at(self._local(points))

    def _certainty_at(self, local: FloatArray) -> FloatArray | None:
        """The same for points (N, 3) in the cloud's frame."""
        if self.certainty is None:
            return None
        by_point = np.append(self.certainty, np.float32(0))
        certainty = np.zeros(len(local), np.float32)
        finite = np.isfinite(local).all(axis=1)
        certainty[finite] = by_point[self.nearest.query(local[finite])]  # NONE_WITHIN_REACH, -1, reads the appended 0
        return certainty

    def _local(self, points: NDArray[np.floating]) -> FloatArray:
        """(N, 3) float32 in the cloud's frame; infinite where float32 overflows."""
        given = numbers_of(points)
        if given.ndim != 2 or given.shape[1] != 3 or given.dtype.kind not in "fiu":
            raise OgPointcloudError(
                f"points are {given.dtype} of shape {given.shape}; expected numbers (N, 3), world coordinates: one "
                "point is [[x, y, z]]"
            )
        points = np.asarray(given, np.float64)
        local = np.empty(points.shape, np.float32)
        with np.errstate(over="ignore"):
            for axis in range(3):  # three times as fast as all at once, which makes a float64 copy
                np.subtract(points[:, axis], self.cloud.origin[axis], out=local[:, axis], casting="same_kind")
        return local

    def _look_up(self, local: FloatArray) -> IntArray:
        """(N,) instance of each point: the graph's answer if it is certain, else by exact search. local: (N, 3)."""
        if self._graph is None:
            instances, pending = np.full(len(local), TOO_FAR, np.int32), np.arange(len(local))
        else:
            instances, certain = self._graph.look_up(local)
            if certain.all():
                return instances
            pending = np.flatnonzero(~certain)
        pending = pending[np.isfinite(local[pending]).all(axis=1)]  # the others are too far already
        # NONE_WITHIN_REACH, -1, reads the appended TOO_FAR.
        nearest = self.nearest.query(local[pending])
        instances[pending] = np.append(self.instance_ids, np.int32(TOO_FAR))[nearest]
        return instances

    @cached_property
    def _graph(self) -> QueryGraph | None:
        graph = self._bundle.query_onnx
        return None if graph is None else QueryGraph(graph, self.path, self.cloud)

    @cached_property
    def nearest(self) -> NearestPoint:
        """Finds the scene point nearest to points of the local frame, within reach."""
        return NearestPoint(self.cloud.xyz, self.cloud.spacing, self.cloud.reach)


def load(path: StrPath) -> LabelledScene:
    """Open a .ogpc file; BundleError says what is wrong with any other.

    >>> import pathlib, tempfile
    >>> path = og.write_bundle(cloud, pathlib.Path(tempfile.mkdtemp()) / "two.ogpc")  # of `LabelledCloud`'s example
    >>> og.load(path).instance_ids
    array([0, 0, 1], dtype=int32)
    """
    return LabelledScene(read_bundle(path))


def segment(
    pcd: Any,
    labels: Labels = None,
    scene: SceneLike | None = None,
    *,
    pose: ArrayLike | None = None,
    text_features: TextFeatures = None,
    max_distance: float | None = None,
) -> Segmentation:
    """Label the points of a cloud by words. The cloud may have any density or frame, and may be cropped or noisy.

    With a word bank (``scene.cloud.word_bank``), scores are probabilities, and a point is unknown if no label is
    probable; without one, each point gets the label with the largest cosine. The result says which (``calibrated``),
    and why a point is unknown (``reasons``).

    pcd: an array (N, 3) of world coordinates, a cloud or mesh of Open3D, PyVista or trimesh, a geometry file; or a
        scene, a LabelledCloud or a .ogpc file, whose own points are then labelled. Rows with NaN are unknown.
    scene: the scene to query. Left out: the scene that the cloud is or carries.
    pose: (4, 4), maps the cloud's coordinates to the scene's world. Left out: they are world coordinates.
    labels, text_features, max_distance: as for ``Segmenter``, which labels many clouds by the same words.

    Warns if no point gets a label, and says why. Raises OgPointcloudError and its subclasses: SceneError (no cloud),
    BundleError (no scene), FeatureSpaceError (vectors of another space or width).

    >>> result = og.segment([[0.02, 0, 1], [9, 9, 9]], ["desk", "chair"], cloud)  # of `LabelledCloud`'s example
    >>> result.labels, result.scores
    (array([ 1, -1], dtype=int32), array([1., 0.], dtype=float32))
    >>> og.segment(cloud, {"seat": np.array([5, 1]), "top": np.array([1, 5])}).labels
    array([0, 0, 1], dtype=int32)
    """
    ask = Segmenter(find_scene(pcd, scene), labels, text_features=text_features, max_distance=max_distance)
    return ask._answer(pcd, pose)


class Segmenter:
    """The same labels for many clouds: words are scored once, and a call only looks points up.

    Thread-safe; memory does not grow from call to call.

    scene: a loaded scene, a LabelledCloud or the path of a .ogpc file.
    labels: words, found in text_features or in the scene's vocabulary (None: all of them), or encoded, if the scene's
        text encoder is found; or name -> vector (D,).
    text_features: a text-features .npz, or the result of ``read_text_features`` for it.
    max_distance: points farther than this from the scene's cloud are unknown; at most its reach, which is the default.

    >>> ask = og.Segmenter(cloud, ["desk", "chair"])  # of `LabelledCloud`'s example
    >>> for frame in (np.array([[0, 0, 1.0]]), np.array([[1, 0, 1.1], [0, 0, 0.9]])):
    ...     ask(frame).labels.tolist()
    [1]
    [0, 1]
    """

    def __init__(
        self,
        scene: SceneLike,
        labels: Labels = None,
        *,
        text_features: TextFeatures = None,
        max_distance: float | None = None,
    ) -> None:
        self.scene = scene = as_scene(scene)
        scene.check_distance(max_distance)
        words = scene.words(labels, text_features)
        self.names = words.names
        """The labels, in the order of their numbers."""
        self._max_distance, self._warned = max_distance, set[bool]()
        self._choice = scene.chooser.choose(words.vectors)

    def __call__(self, points: Any, pose: ArrayLike | None = None) -> Segmentation:
        """points: (N, 3) world coordinates, or any cloud that ``segment`` takes; N may be 0.

        pose: (4, 4), maps the points to the scene's world, as a sensor's pose in the map does; ``xyz`` of the result
        is then in world coordinates.
        Warns the first time that no point gets a label, and the first time that there is none, not at every such frame
        of a stream.
        """
        return self._answer(points, pose)

    def _answer(self, pcd: Any, pose: ArrayLike | None) -> Segmentation:
        scene = self.scene
        own = as_scene(pcd) if _is_scene(pcd) else None
        are_own = own is not None and own.cloud is scene.cloud and pose is None
        if are_own:  # no look-up needed
            points, instances = scene.xyz.copy(), scene.instance_ids.copy()
            certainty_of = scene.certainty
        else:
            points = _posed(world_points(pcd) if own is None else own.xyz.copy(), pose)
            local = scene._local(points)  # a copy: a later change of the result's points does not change its certainty
            instances = scene._instances_at(local, self._max_distance)
            if self._max_distance is not None:
                local[instances == TOO_FAR] = np.inf  # the certainty look-up knows only the scene's reach
            certainty_of = partial(scene._certainty_at, local)
        labels, scores, reasons = self._choice.at(instances)
        far = np.flatnonzero(instances == TOO_FAR)
        reasons[far[~np.isfinite(points[far]).all(axis=1)]] = Reason.NOT_FINITE
        result = Segmentation(
            points, labels, scores, instances, reasons, self.names, scene.path, self._choice.calibrated,
            certainty_of,
        )  # fmt: skip
        is_empty = len(result) == 0
        if is_empty not in self._warned and (reason := _label_warning(result, self, are_own, pose)):
            self._warned.add(is_empty)
            warnings.warn(reason, stacklevel=3)  # at the call of segment, or of the segmenter
        return result


def instance_table(
    scene: SceneLike,
    labels: Labels = None,
    *,
    text_features: TextFeatures = None,
    up: ArrayLike | None = None,
    words: int = WORDS_PER_ROW,
) -> Instances:
    """The instances of a scene as a table.

    scene: a loaded scene, a LabelledCloud or the path of a .ogpc file.
    labels, text_features: the words to choose among, as for ``segment``; left out, the scene's own, or none.
    up: (3,) upward direction of the oriented boxes, if known. words: number of words per row.

    >>> [(row.id, row.points, row.words) for row in og.instance_table(cloud, words=1)]  # of `LabelledCloud`'s example
    [(0, 2, (('chair', 1.0),)), (1, 1, (('desk', 1.0),))]
    """
    scene = as_scene(scene)
    return list_instances(scene.cloud, scene.chooser, scene.known_words(labels, text_features), up=up, words=words)


def _is_scene(pcd: Any) -> bool:
    is_file = isinstance(pcd, (str, os.PathLike)) and Path(pcd).suffix.lower() == ".ogpc"
    return is_file or isinstance(pcd, (LabelledScene, LabelledCloud))


def find_scene(pcd: Any, scene: SceneLike | None = None) -> LabelledScene:
    """The scene to query for a cloud: the one given, else the one it is or carries; OgPointcloudError without any."""
    if scene is not None:
        return as_scene(scene)
    if _is_scene(pcd):
        return as_scene(pcd)
    if (carried := carried_scene(pcd)) is not None:
        return as_scene(carried)
    raise OgPointcloudError("no scene to query: pass scene=og.load('S.ogpc'), or its path, or segment a labelled cloud")


def as_scene(source: SceneLike) -> LabelledScene:
    """The scene of a LabelledCloud or path, or the scene given; cached for a cloud or file that has not changed."""
    if isinstance(source, LabelledScene):
        return source
    if isinstance(source, LabelledCloud):
        return _scene_once(source)
    if isinstance(source, (str, os.PathLike)):
        if not os.path.isfile(source):
            return load(source)  # raises an error that says what is wrong
        path = Path(source).resolve()
        state = path.stat()
        return _load_once(path, state.st_mtime_ns, state.st_size)
    raise OgPointcloudError(
        f"scene is a {type(source).__name__}; expected a scene, a LabelledCloud or the path of a .ogpc file"
    )


@lru_cache(maxsize=2)
def _load_once(path: Path, modified: int, size: int) -> LabelledScene:
    """The scene of a file, read once while the file is unchanged."""
    return load(path)


@lru_cache(maxsize=2)
def _scene_once(cloud: LabelledCloud) -> LabelledScene:
    """The scene of a cloud in memory, made once: what one query prepares serves the next."""
    return LabelledScene.from_cloud(cloud)


def _posed(points: DoubleArray, pose: ArrayLike | None) -> DoubleArray:
    if pose is None:
        return points
    matrix = pose_matrix(pose)
    error, determinant = rotation_error(matrix[:3, :3])
    if not error <= ROTATION_TOLERANCE or determinant < 0:  # also if the error is NaN
        raise SceneError(
            f"the rotation of pose differs from a rotation matrix by {error:.3g} (det {determinant:.3g}); expected a "
            "rigid pose: bring the points into the scene's unit first, and remove mirroring"
        )
    with np.errstate(invalid="ignore", over="ignore"):  # rows with NaN or infinity stay so
        return points @ matrix[:3, :3].T + matrix[:3, 3]


def _label_warning(result: Segmentation, ask: Segmenter, are_own: bool, pose: ArrayLike | None) -> str | None:
    """Why no point has a label, or why labels may be wrong because points are misplaced; None if all is well. are_own:
    whether they are the scene's own points."""
    if len(result) == 0:
        return "no point has a label: the cloud has 0 points (a file that could not be read may give such a cloud)"
    far = int((result.reasons == Reason.TOO_FAR).sum())
    cause = "" if are_own else _misplacement(result.xyz[result.reasons != Reason.NOT_FINITE], far, ask, pose)
    if result.names and result.reasons.all():  # Reason.LABELLED is 0
        parts = [f"{count} are {reason}" for reason, count in result.unknown_because().items()]
        return f"none of {len(result)} points has a label: {', '.join(parts)}{f'; {cause}' if cause else ''}"
    others = f"{far} of {len(result)} points are {Reason.TOO_FAR}, so other labels may be wrong too"
    return cause and f"{others if far else 'labels may be wrong'}; {cause}"


def _misplacement(points: DoubleArray, far: int, ask: Segmenter, pose: ArrayLike | None) -> str:
    """Why finite points may be misplaced relative to the scene: precision, frame or unit; "" if nothing suggests it.
    far: how many are too far from it. pose: the pose that was applied to them."""
    scene, max_distance = ask.scene, ask._max_distance
    if len(scene.cloud) == 0:
        return ""
    sample = points[:: 1 + len(points) // SAMPLE_POINTS]
    enough, spacing, reach = len(sample) >= MIN_SAMPLE_POINTS, scene.cloud.spacing, scene.cloud.reach
    if enough and (step := float32_step(sample)) > spacing:
        return (
            f"float32 rounded them to steps of {step:.3g}, but the scene's points lie {spacing:.3g} apart: pass them "
            "as float64, or subtract an offset before they become float32, and pass it in pose="
        )
    if pose is not None and (coarse := rounded_pose(pose, spacing)):
        return coarse
    if far > MISPLACED_SHARE * len(points):
        limit = f"its reach is {reach:.4g}" if max_distance is None else f"max_distance is {max_distance:.4g}"
        return (
            f"the points span {span(points)}, the scene {span(scene.xyz)}, and {limit}: bring them into the scene's "
            "frame and unit"
        )
    if enough and (width := _width(sample)) < reach < _width(scene.cloud.xyz) / WIDE_SCENE_REACHES:
        return (
            f"all of them lie within {width:.3g}, a range where the scene, {_width(scene.cloud.xyz):.4g} wide, has "
            "hardly two points: bring them into the scene's unit"
        )
    return ""


def _read_only(array: NDArray[Any]) -> NDArray[Any]:
    array.flags.writeable = False
    return array


def _width(points: NDArray[np.floating]) -> float:
    return float(np.ptp(points, axis=0).max())
