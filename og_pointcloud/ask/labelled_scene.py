"""Text in, labels out: opens a .ogpc and asks it about points. numpy and onnxruntime, nothing else.

``segment`` is one statement a step: which scene, which words, which instance each point belongs to, which word fits
each instance, if any. Words are judged by ``choosing``, against the scene's word bank if it has one. Points are looked
up by query.onnx. For the few close to a border, where its table does not promise the answer, ``nearest`` searches the
cloud. A scene in memory has no graph: every point is searched for, with the same answers.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping
from functools import cached_property, lru_cache, partial
from numbers import Real
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from og_pointcloud.ask.choosing import Chooser, Reason
from og_pointcloud.ask.hosts import carried_scene, import_plugin, world_points
from og_pointcloud.ask.instances import WORDS, Instances, list_instances
from og_pointcloud.ask.query_graph import QueryGraph
from og_pointcloud.ask.segmentation import Segmentation
from og_pointcloud.bundle.nearest import NearestPoint
from og_pointcloud.bundle.read import Bundle, read_bundle
from og_pointcloud.bundle.vocabulary import carried_encoder
from og_pointcloud.cloud import TOO_FAR, LabelledCloud, Vocabulary
from og_pointcloud.errors import OgPointcloudError, SceneError, counted, span
from og_pointcloud.formats.atomic import StrPath
from og_pointcloud.scene import (
    RIGID,
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

ELSEWHERE_SHARE = 1 / 3
"""Where more than this share of the points asked lies too far from the scene, the two may be in different frames."""
LOOKED_AT, FEWEST_JUDGED = 1000, 100
"""About so many points of a cloud, evenly spread, tell whether its unit and its precision fit the scene; fewer than the
second number say nothing."""
WIDE = 10
"""A scene so many times as wide as its reach is more than what a cloud within that reach would show of it."""
POINTS_PER_RUN = 1 << 20
"""Points given to the graph at once, which keeps its memory to about 150 MB."""


class LabelledScene:
    """A labelled cloud that can be asked. Make one with ``load``; it is cheap to keep and safe to share by threads.

    cloud: points in the local frame, their instance ids, and what is known of the instances. path: the .ogpc file, and
    manifest: the file's, with counts, parity figures, provenance; None and empty for a scene in memory.
    instance_ids: (n,) int32, row of ``instances``, -1 background, -2 unobserved. vocabulary: the words that may be
    asked as strings, None without any. feature_space: name of the encoder that label vectors must come from.
    Its own arrays are read-only, as every later answer is made of them: Open3D's Vector3dVector wants `xyz.copy()`.

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
        """Other processes are sent what the file holds, not the open session: each opens its own."""
        return LabelledScene, (self._bundle,)

    @classmethod
    def from_cloud(cls, cloud: LabelledCloud) -> LabelledScene:
        """A scene of a cloud that was never written. It answers as its file would. The first answer comes sooner, as no
        graph is opened; many points take longer, as each is searched for."""
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
        """The instances as a table: row k is instance id k, with its place, boxes, size, evidence and best own words.

        Whole columns, and the descriptors, are in ``cloud.instances``.
        """
        return instance_table(self)

    def show(self, labels: Labels = None, *, text_features: TextFeatures = None) -> Any:
        """A live page of the scene, which a notebook shows in its cell; `og-pointcloud serve` for the command line.

        labels, text_features: as for ``segment``. Returns at once: the page, which has a ``url``, ``wait`` and
        ``stop``. Served to this machine alone. Needs the extra 'serve'.
        """
        return import_plugin("og_pointcloud.show.serve", "serve").show(self, labels, text_features=text_features)

    @cached_property
    def chooser(self) -> Chooser:
        """Decides which label fits each instance, if any; calibrated where the scene has a word bank."""
        return Chooser(self.cloud.instances, self.cloud.word_bank, feature_space=self.feature_space)

    def words(self, labels: Labels = None, text_features: TextFeatures = None) -> Vocabulary:
        """Labels with their vectors, as ``segment`` finds them: named, in a file, in the scene's own words, encoded."""
        encoder = carried_encoder(self.path)
        if isinstance(labels, Mapping):
            labels = {name: numbers_of(vector) for name, vector in labels.items()}
        return resolve_labels(labels, text_features, self.vocabulary, self.feature_space, encoder)

    def known_words(self, labels: Labels = None, text_features: TextFeatures = None) -> Vocabulary:
        """The same, but no words where none are given and the scene has none."""
        given = labels is not None or text_features is not None
        if given or (self.vocabulary and self.vocabulary.names):
            return self.words(labels, text_features)
        return Vocabulary((), np.zeros((0, self.cloud.space.width), np.float32))

    def instances_at(self, points: NDArray[np.floating], *, max_distance: float | None = None) -> IntArray:
        """(N,) int32: instance id of the scene's point nearest to each, -1, -2, or -3 where none is within reach.

        points: (N, 3), world coordinates. A row with NaN or infinity, as depth cameras send them, is out of reach.
        max_distance: a shorter reach, in the scene's unit; costs an exact search of every point.
        Exact: of points equally near the first one counts, and a point of the scene finds its own id.
        """
        self.check_distance(max_distance)
        return self._instances_at(self._local(points), max_distance)

    def _instances_at(self, local: FloatArray, max_distance: float | None) -> IntArray:
        """The same of points (N, 3) in the cloud's frame."""
        instances = np.empty(len(local), np.int32)
        for start in range(0, len(local), POINTS_PER_RUN):
            run = slice(start, start + POINTS_PER_RUN)
            instances[run] = self._look_up(local[run])
        if max_distance is not None:
            within_reach = np.flatnonzero(instances != TOO_FAR)
            nearest = self.nearest.query(local[within_reach])
            cut = within_reach[self.nearest.distance(local[within_reach], nearest) > max_distance]
            instances[cut] = TOO_FAR
        return instances

    def check_distance(self, max_distance: float | None) -> None:
        """OgPointcloudError unless the distance is a length above 0, and at most the scene's reach."""
        if max_distance is not None and not (isinstance(max_distance, Real) and 0 < max_distance <= self.cloud.reach):
            raise OgPointcloudError(
                f"max_distance is {max_distance}; expected a length up to the scene's reach, {self.cloud.reach:.4g}: "
                "points farther than that have no label"
            )

    def certainty_at(self, points: NDArray[np.floating]) -> FloatArray | None:
        """(N,) float32, the certainty of the scene's point nearest to each, 0 where none is within reach; None where
        the scene does not know it. points: (N, 3), world coordinates. An exact search of every point."""
        return self.certainty if points is self.xyz else self._certainty_at(self._local(points))

    def _certainty_at(self, local: FloatArray) -> FloatArray | None:
        """The same of points (N, 3) in the cloud's frame."""
        if self.certainty is None:
            return None
        of_points = np.append(self.certainty, np.float32(0))
        certainty = np.zeros(len(local), np.float32)
        finite = np.isfinite(local).all(axis=1)
        certainty[finite] = of_points[self.nearest.query(local[finite])]  # NONE_WITHIN_REACH, -1, reads the added 0
        return certainty

    def _local(self, points: NDArray[np.floating]) -> FloatArray:
        """(N, 3) in the cloud's frame; infinite where that leaves float32."""
        given = numbers_of(points)
        if given.ndim != 2 or given.shape[1] != 3 or given.dtype.kind not in "fiu":
            raise OgPointcloudError(
                f"points are {given.dtype} of shape {given.shape}; expected numbers (N, 3), world coordinates: one "
                "point is [[x, y, z]]"
            )
        points = np.asarray(given, np.float64)
        local = np.empty(points.shape, np.float32)
        with np.errstate(over="ignore"):
            for axis in range(3):  # three times as fast as all in one, which makes a float64 copy of its own
                np.subtract(points[:, axis], self.cloud.origin[axis], out=local[:, axis], casting="same_kind")
        return local

    def _look_up(self, local: FloatArray) -> IntArray:
        """(N,) instance of each point: the graph's answer where it is certain, else by exact search. local: (N, 3)."""
        if self._graph is None:
            instances, still_open = np.full(len(local), TOO_FAR, np.int32), np.arange(len(local))
        else:
            instances, certain = self._graph.look_up(local)
            if certain.all():
                return instances
            still_open = np.flatnonzero(~certain)
        still_open = still_open[np.isfinite(local[still_open]).all(axis=1)]  # the others are too far already
        # One value more than points: NONE_WITHIN_REACH is -1 and reads TOO_FAR.
        nearest = self.nearest.query(local[still_open])
        instances[still_open] = np.append(self.instance_ids, np.int32(TOO_FAR))[nearest]
        return instances

    @cached_property
    def _graph(self) -> QueryGraph | None:
        graph = self._bundle.query_onnx
        return None if graph is None else QueryGraph(graph, self.path, self.cloud)

    @cached_property
    def nearest(self) -> NearestPoint:
        """Index of the scene's point nearest to points of the local frame, within the reach."""
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
    """Label the points of a cloud by words. The cloud may be of any density, a crop, noisy, or in a frame of its own.

    A scene with a word bank (``scene.cloud.word_bank``) answers probabilities, and unknown where no label is probable;
    one without answers the label with the largest cosine. The result says which (``calibrated``), and why a point is
    unknown (``reasons``).

    pcd: an array (N, 3) of world coordinates, a cloud or mesh of Open3D, PyVista or trimesh, a geometry file; or a
        scene, a LabelledCloud or a .ogpc file, whose own points are then labelled. Rows with NaN answer unknown.
    scene: what to ask. Left out: the scene that the cloud is or carries.
    pose: (4, 4), takes the cloud's coordinates to the scene's world. Left out: they are world coordinates.
    labels, text_features, max_distance: as for ``Segmenter``, which asks the same of many clouds.

    Warns where no point gets a label, and says why. Raises OgPointcloudError and its kinds: SceneError (no cloud),
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

    Several threads may call it at once; memory does not grow from call to call.

    scene: a loaded scene, a LabelledCloud or the path of a .ogpc file.
    labels: words, found in text_features or in the scene's vocabulary (None: all of them), or encoded, if the scene's
        text encoder is found; or name -> vector (D,).
    text_features: a text-features .npz, or what ``read_text_features`` returned for it.
    max_distance: points farther than this from the scene's cloud answer unknown; at most, and left out, its reach.

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
        self._max_distance, self._warned = max_distance, False
        self._choice = scene.chooser.choose(words.vectors)

    def __call__(self, points: Any, pose: ArrayLike | None = None) -> Segmentation:
        """points: (N, 3) world coordinates, or any cloud that ``segment`` takes; N may be 0.

        pose: (4, 4), takes the points to the scene's world, as a sensor's pose in the map does; ``xyz`` of the result
        is then in the world too.
        Warns the first time that no point gets a label, not at every empty frame of a stream.
        """
        return self._answer(points, pose)

    def _answer(self, pcd: Any, pose: ArrayLike | None) -> Segmentation:
        scene = self.scene
        own = as_scene(pcd) if _is_scene(pcd) else None
        are_own = own is not None and own.cloud is scene.cloud and pose is None
        if are_own:  # they need no look-up
            points, instances = scene.xyz.copy(), scene.instance_ids.copy()
            certainty_of = partial(scene.certainty_at, scene.xyz)
        else:
            points = _posed(world_points(pcd) if own is None else own.xyz.copy(), pose)
            local = scene._local(points)  # it stays what was asked about, whatever becomes of the result's points
            instances = scene._instances_at(local, self._max_distance)
            if self._max_distance is not None:
                local[instances == TOO_FAR] = np.inf  # certainty has no shorter reach than the scene's
            certainty_of = partial(scene._certainty_at, local)
        labels, scores, reasons = self._choice.at(instances)
        far = np.flatnonzero(instances == TOO_FAR)
        reasons[far[~np.isfinite(points[far]).all(axis=1)]] = Reason.NOT_FINITE
        result = Segmentation(
            points, labels, scores, instances, reasons, self.names, scene.path, self._choice.calibrated,
            certainty_of,
        )  # fmt: skip
        if not self._warned and (reason := _why_few(result, scene, are_own, pose)):
            self._warned = True
            warnings.warn(reason, stacklevel=3)  # where segment, or the segmenter, is called
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

    >>> [(row.id, row.points, row.words) for row in og.instance_table(cloud, words=1)]  # of `LabelledCloud`'s example
    [(0, 2, (('chair', 1.0),)), (1, 1, (('desk', 1.0),))]
    """
    scene = as_scene(scene)
    return list_instances(scene.cloud, scene.chooser, scene.known_words(labels, text_features), up=up, words=words)


def _is_scene(pcd: Any) -> bool:
    is_file = isinstance(pcd, (str, os.PathLike)) and Path(pcd).suffix == ".ogpc"
    return is_file or isinstance(pcd, (LabelledScene, LabelledCloud))


def find_scene(pcd: Any, scene: SceneLike | None = None) -> LabelledScene:
    """The scene that answers for a cloud: the one given, else that the cloud is or carries; else OgPointcloudError."""
    if scene is not None:
        return as_scene(scene)
    if _is_scene(pcd):
        return as_scene(pcd)
    if (carried := carried_scene(pcd)) is not None:
        return as_scene(carried)
    raise OgPointcloudError("no scene to ask: pass scene=og.load('S.ogpc'), or its path, or segment a labelled cloud")


def as_scene(source: SceneLike) -> LabelledScene:
    """A scene that can be asked, of whatever names one; the same again for a cloud or file that has not changed."""
    if isinstance(source, LabelledScene):
        return source
    if isinstance(source, LabelledCloud):
        return _scene_once(source)
    if isinstance(source, (str, os.PathLike)):
        if not os.path.isfile(source):
            return load(source)  # which says what is wrong
        path = Path(source).resolve()
        state = path.stat()
        return _load_once(path, state.st_mtime_ns, state.st_size)
    raise OgPointcloudError(
        f"scene is a {type(source).__name__}; expected a scene, a LabelledCloud or the path of a .ogpc"
    )


@lru_cache(maxsize=2)
def _load_once(path: Path, modified: int, size: int) -> LabelledScene:
    """The scene of a file, read once as long as the file is unchanged."""
    return load(path)


@lru_cache(maxsize=2)
def _scene_once(cloud: LabelledCloud) -> LabelledScene:
    """The scene of a cloud in memory, made once: what it prepared for one question serves the next."""
    return LabelledScene.from_cloud(cloud)


def _posed(points: DoubleArray, pose: ArrayLike | None) -> DoubleArray:
    if pose is None:
        return points
    matrix = pose_matrix(pose)
    error, determinant = rotation_error(matrix[:3, :3])
    if not error <= RIGID or determinant < 0:  # also where the error is NaN
        raise SceneError(
            f"the rotation of pose is off a rotation matrix by {error:.3g} (det {determinant:.3g}); expected a rigid "
            "pose: bring the points into the scene's unit first, and remove mirroring"
        )
    with np.errstate(invalid="ignore", over="ignore"):  # rows with NaN or infinity stay such
        return points @ matrix[:3, :3].T + matrix[:3, 3]


def _why_few(result: Segmentation, scene: LabelledScene, are_own: bool, pose: ArrayLike | None) -> str | None:
    """Why no point has a label, or that many lie elsewhere than the scene; None where neither is so. are_own: whether
    they are the scene's own points."""
    if len(result) == 0:
        return "no point has a label: the cloud has 0 points (a file that could not be read may give such a cloud)"
    far = int((result.reasons == Reason.TOO_FAR).sum())
    cause = "" if are_own else _misplaced(result.xyz[result.reasons != Reason.NOT_FINITE], far, scene, pose)
    if result.names and result.reasons.all():  # Reason.LABELLED is 0
        parts = [f"{count} are {reason}" for reason, count in result.unknown_because().items()]
        return f"none of {len(result)} points has a label: {', '.join(parts)}{f'; {cause}' if cause else ''}"
    others = f"{far} of {len(result)} points are {Reason.TOO_FAR}, so that other labels may be wrong too"
    return cause and f"{others if far else 'labels may be wrong'}; {cause}"


def _misplaced(points: DoubleArray, far: int, scene: LabelledScene, pose: ArrayLike | None) -> str:
    """Why points, all finite, may not lie where the scene has them, "" if nothing says so. far: how many are too far
    from it. pose: what brought them there."""
    if len(scene.cloud) == 0:
        return ""
    some = points[:: 1 + len(points) // LOOKED_AT]
    many, spacing, reach = len(some) >= FEWEST_JUDGED, scene.cloud.spacing, scene.cloud.reach
    if many and (step := float32_step(some)) > spacing:
        return (
            f"float32 rounded them to steps of {step:.3g}, the scene's points lie {spacing:.3g} apart: give them as "
            "float64, or take an offset off before they become float32, and give it in pose="
        )
    if pose is not None and (coarse := rounded_pose(pose, spacing)):
        return coarse
    if far > ELSEWHERE_SHARE * len(points):
        return (
            f"the points span {span(points)}, the scene {span(scene.xyz)}, its reach is {reach:.4g}: bring them into "
            "the scene's frame and unit"
        )
    if many and (width := _width(some)) < reach < _width(scene.cloud.xyz) / WIDE:
        return (
            f"all of them lie within {width:.3g}, where the scene, {_width(scene.cloud.xyz):.4g} wide, has hardly two "
            "points: bring them into the scene's unit"
        )
    return ""


def _read_only(array: NDArray[Any]) -> NDArray[Any]:
    array.flags.writeable = False
    return array


def _width(points: NDArray[np.floating]) -> float:
    return float(np.ptp(points, axis=0).max())
