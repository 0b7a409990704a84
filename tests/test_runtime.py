"""load, use, segment and Segmenter: exact on tough clouds, for each kind of cloud, label and scene; and refusals."""

from __future__ import annotations

import pickle
import re
import sys
import types
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from labelled_clouds import (
    SPACE,
    TOO_FAR,
    WIDTH,
    WORDS,
    instances_plainly,
    make_cloud,
    nearest_plainly,
    queries,
    quietly,
    reference_scores,
    room,
    tough_clouds,
    unit_rows,
)
from og_pointcloud_export import lookup_grid, write_bundle

import og_pointcloud as og
from og_pointcloud.ask import labelled_scene as runtime
from og_pointcloud.cloud import Vocabulary
from og_pointcloud.errors import BundleError, FeatureSpaceError, OgPointcloudError, SceneError
from og_pointcloud.formats.colors import label_colors
from og_pointcloud.scene import Points

CLOUDS = tough_clouds()


def labels_plainly(cloud, instances, words):
    """Label and score of each instance id by float64 cosines."""
    scores = reference_scores(cloud.instances, words)
    labels, best = np.full(len(instances), -1), np.zeros(len(instances))
    for row, instance in enumerate(instances):
        if instance >= 0 and scores[instance].max() > -2:
            labels[row], best[row] = scores[instance].argmax(), scores[instance].max()
    return labels, best


@pytest.mark.parametrize("name", CLOUDS)
def test_answers_are_exact_on_tough_clouds_from_a_file_and_in_memory(tmp_path, name):
    cloud = CLOUDS[name]
    local = queries(cloud, 300)
    vectors = unit_rows(4, max(cloud.instances.descriptors.shape[1], 1), seed=9)
    words, points = dict(zip("abcd", vectors, strict=True)), local.astype(np.float64) + cloud.origin
    file = quietly(points, words, og.load(write_bundle(cloud, tmp_path / "s.ogpc")))
    memory = quietly(points, words, runtime.LabelledScene.from_cloud(cloud))
    # What the origin takes away from a world coordinate is compared as the scene sees it.
    seen = (local.astype(np.float64) + cloud.origin - cloud.origin).astype(np.float32)
    assert (file.instances == instances_plainly(cloud, seen)).all()
    labels, scores = labels_plainly(cloud, file.instances, vectors)
    assert (file.labels == labels).all()
    assert np.abs(file.scores - scores).max() < 1e-6
    for part in ("labels", "scores", "instances", "reasons"):
        assert (getattr(file, part) == getattr(memory, part)).all(), part


@pytest.mark.parametrize("name", [name for name in CLOUDS if "coincident" not in name and "one place" not in name])
def test_a_point_of_the_cloud_finds_its_own_id(name):
    cloud = CLOUDS[name]
    scene = runtime.as_scene(cloud)
    assert (scene.instances_at(scene.xyz) == cloud.instance_ids).all()
    # The same through the cloud itself, which needs no lookup.
    words = {"a": np.ones(scene.cloud.instances.descriptors.shape[1] or 1)}
    assert (quietly(scene, words).labels == quietly(scene.xyz, words, scene).labels).all()


def test_meters_millimeters_and_map_coordinates_answer_alike(scene):
    cloud = scene.cloud
    points = queries(cloud, 300)[:900].astype(np.float64)
    meters = scene.instances_at(points)
    kilo = make_cloud(cloud.xyz * 1024, cloud.instance_ids, cloud.spacing * 1024, cloud.reach * 1024)
    shifted = replace(cloud, origin=np.array([2.0**20, -(2.0**22), 2.0**9]))
    assert (runtime.as_scene(kilo).instances_at(points * 1024) == meters).all()
    assert (runtime.as_scene(shifted).instances_at(points + shifted.origin) == meters).all()


@pytest.mark.parametrize(
    ("points", "shape"),
    [
        (np.zeros(3), "(3,)"),
        (np.zeros((2, 4)), "(2, 4)"),
        (np.zeros((1, 2, 3)), "(1, 2, 3)"),
        (np.zeros((2, 3), complex), "(2, 3)"),
        ([["a", "b", "c"]], "(1, 3)"),
        ([[1, 2, 3], [4]], "()"),
        (None, "()"),
    ],
)
def test_what_are_no_points_is_refused_with_its_shape(scene, points, shape):
    for ask in (scene.instances_at, scene.certainty_at):
        with pytest.raises(OgPointcloudError, match=re.escape(f"shape {shape}; expected numbers (N, 3)")):
            ask(points)


class OnGpu:
    """Refuses numpy, as cupy's arrays do."""

    def __array__(self, *_, **__):
        raise TypeError("Implicit conversion to a NumPy array is not allowed. Please use `.get()`")


def test_arrays_of_a_gpu_library_are_refused_in_its_own_words(scene):
    with pytest.raises(SceneError, match=r"a OnGpu is not an array of points \(Implicit .*`.get\(\)`\); expected"):
        og.segment(OnGpu(), ["apple"], scene)
    for ask in (
        lambda: scene.instances_at(OnGpu()),
        lambda: og.segment(scene, {"apple": OnGpu()}),
        lambda: og.segment(scene.xyz, ["apple"], scene, pose=OnGpu()),
        lambda: og.pick(scene, OnGpu()),
        lambda: og.oriented_box(OnGpu()),
    ):
        with pytest.raises(OgPointcloudError, match=" expected "):
            ask()


def test_many_points_are_asked_in_runs(scene, monkeypatch):
    points = queries(scene.cloud, 300).astype(np.float64)
    whole = scene.instances_at(points)
    monkeypatch.setattr(runtime, "POINTS_PER_RUN", 101)
    assert (scene.instances_at(points) == whole).all()


def test_answers_are_told_apart_and_kept_in_sets(scene):
    """By identity: arrays have no one truth value."""
    bank = unit_rows(60, seed=1)
    for make in (
        lambda: og.segment(scene),
        lambda: og.pick(scene, scene.xyz[0]),
        lambda: og.Frame(None, np.eye(3)),
        lambda: og.axis_aligned_box(scene.xyz),
        lambda: replace(scene.cloud.instances),
        lambda: og.Vocabulary(("a", "b"), bank[:2]),
        lambda: og.WordBank(bank),
    ):
        one, other = make(), make()
        assert one != other
        assert {one, other} == {other, one}
        assert [other, one].index(one) == 1


def test_a_scene_keeps_its_arrays_and_a_result_has_its_own(scene):
    loaded = og.load(scene.path)
    in_memory = og.LabelledScene.from_cloud(room())
    for asked in (loaded, in_memory, pickle.loads(pickle.dumps(loaded))):
        for array in (asked.xyz, asked.instance_ids, asked.certainty):
            with pytest.raises(ValueError, match="read-only"):
                array[:] = 0
        for pcd in (asked, room(700, seed=4), asked.xyz):
            make = partial(og.segment, pcd, WORDS, asked)
            expected, edited = make(), make()
            for name in ("xyz", "labels", "scores", "instances", "reasons", "certainty"):
                getattr(edited, name)[:] = 0
            for name in ("xyz", "labels", "scores", "instances", "reasons", "certainty"):
                np.testing.assert_array_equal(getattr(make(), name), getattr(expected, name))
    with pytest.raises(ValueError, match="read-only"):
        loaded.cloud.instance_ids[:] = 0
    assert in_memory.cloud.instance_ids.flags.writeable, "an array of the caller's stays as it was"


def test_a_scene_offers_its_parts(scene, bundle):
    cloud = room()
    assert scene.xyz.dtype == np.float64
    assert (scene.xyz == cloud.xyz_world).all()
    assert scene.instance_ids.dtype == np.int32
    assert (scene.instance_ids == cloud.instance_ids).all()
    assert len(scene.instances) == 9
    assert (scene.feature_space, scene.vocabulary.names, scene.path) == (SPACE, WORDS, bundle)
    assert scene.manifest["counts"]["points"] == len(scene.xyz)


# Which scene is asked


def test_the_scene_may_be_named_in_any_way_but_must_be(scene, bundle):
    points = scene.xyz[:50]
    expected = og.segment(points, ["apple", "pear"], scene).labels
    for given in (bundle, str(bundle), room()):
        assert (og.segment(points, ["apple", "pear"], given).labels == expected).all()
    with pytest.raises(OgPointcloudError, match=r"no scene to query: pass scene=og.load"):
        og.segment(points, ["apple", "pear"])


@pytest.mark.parametrize("kind", ["scene", "cloud", "path", "text path"])
def test_a_scene_may_be_the_cloud(scene, bundle, kind):
    pcd = {"scene": scene, "cloud": room(), "path": bundle, "text path": str(bundle)}[kind]
    result = og.segment(pcd, ["apple", "pear"])
    assert (result.instances == scene.instance_ids).all()
    assert (result.xyz == scene.xyz).all()


def test_a_scene_may_be_the_cloud_that_another_is_asked_about(scene):
    other = room(700, seed=4)
    result = og.segment(other, ["apple"], scene)
    assert (result.instances == instances_plainly(scene.cloud, other.xyz)).all()


def test_a_file_that_changes_is_read_again(tmp_path):
    path = write_bundle(room(100), tmp_path / "s.ogpc")
    assert len(og.segment(path, ["apple"])) == 100
    write_bundle(room(200), path)
    assert len(og.segment(path, ["apple"])) == 200


def test_what_is_no_scene(tmp_path):
    with pytest.raises(OgPointcloudError, match="scene is a int"):
        og.segment(np.zeros((1, 3)), ["apple"], 3)
    for path in (tmp_path / "nowhere.ogpc", tmp_path, "a\0.ogpc", "a" * 5000, "\ud800.ogpc"):
        with pytest.raises(BundleError, match=r"is not a file; expected a \.ogpc file"):
            og.load(path)
        with pytest.raises(BundleError, match=r"is not a file; expected a \.ogpc file"):
            og.segment(np.zeros((1, 3)), ["apple"], path)
    for path in (None, 3, ["a.ogpc"]):
        with pytest.raises(BundleError, match=r"is not a file; expected a \.ogpc file"):
            og.load(path)


def test_a_graph_that_is_not_ours_is_refused(scene):
    for graph in (b"junk", b""):
        broken = runtime.LabelledScene(replace(scene._bundle, query_onnx=graph))
        with pytest.raises(BundleError, match=r"query\.onnx does not run"):
            broken.instances_at(np.zeros((1, 3)))
    import onnx

    value = onnx.helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, ["N"])
    out = onnx.helper.make_tensor_value_info("y", onnx.TensorProto.FLOAT, ["N"])
    graph = onnx.helper.make_graph([onnx.helper.make_node("Neg", ["x"], ["y"])], "g", [value], [out])
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 18)], ir_version=8)
    other = runtime.LabelledScene(replace(scene._bundle, query_onnx=model.SerializeToString()))
    with pytest.raises(BundleError, match=r"takes \['x'\]"):
        other.instances_at(np.zeros((1, 3)))
    model = onnx.load_from_string(scene._bundle.query_onnx)
    text = next(given for given in model.graph.input if given.name == "text")
    text.type.tensor_type.shape.dim[1].dim_param = "any"
    other = runtime.LabelledScene(replace(scene._bundle, query_onnx=model.SerializeToString()))
    with pytest.raises(BundleError, match=r"takes text of shape \[.*, 'any'\], without a fixed dimension"):
        other.instances_at(np.zeros((1, 3)))


@pytest.mark.parametrize(
    "table",
    [
        "value_instance", "block_shifts", "brick_values", "node_values", "child_start", "child_length",
        "candidates_high", "descriptors",
    ],
)  # fmt: skip
def test_a_graph_whose_tables_lie_gives_an_error_or_an_instance_of_the_scene(scene, table):
    import onnx

    graph = onnx.load_from_string(scene._bundle.query_onnx)
    constant = next(constant for constant in graph.graph.initializer if constant.name == table)
    for byte in (0x7F, 0x33, 0xFF):
        constant.raw_data = bytes([byte]) * len(constant.raw_data)
        lies = runtime.LabelledScene(replace(scene._bundle, query_onnx=graph.SerializeToString()))
        try:
            result = quietly(scene.xyz[:500], ["apple"], lies)
        except BundleError as error:
            assert "query.onnx" in str(error)  # noqa: PT017
        else:
            assert result.instances.min() >= TOO_FAR
            assert result.instances.max() < len(scene.instances)


# Which cloud is asked about


def test_clouds_of_other_libraries_are_read_without_importing_them(scene, monkeypatch):
    points = scene.xyz[:40]
    expected = og.segment(points, ["apple", "pear"], scene)

    def host(module, **attributes):
        kind = type("Cloud", (), {"__module__": module})
        return type("Derived", (kind,), {"__module__": "mine", **attributes})()

    class Tensor(np.ndarray):
        def cpu(self):
            return self

        def numpy(self):
            return np.asarray(self)

    clouds = [
        host("open3d.cpu.pybind.geometry", points=points.tolist()),
        host("open3d.cpu.pybind.t.geometry", point={"positions": points.view(Tensor)}),
        host("pyvista.core.pointset", points=points, field_data={}),
        host("trimesh.points", vertices=points),
        host("open3d.cpu.pybind.geometry", vertices=points.tolist()),
        host("open3d.cpu.pybind.t.geometry", vertex={"positions": points.view(Tensor)}),
        points.tolist(),
        points[::-1][::-1],
    ]
    for cloud in clouds:
        assert (og.segment(cloud, ["apple", "pear"], scene).labels == expected.labels).all()
    with pytest.warns(UserWarning, match="0 points"):
        assert len(og.segment(host("open3d.x", point={}), ["apple"], scene)) == 0
    with pytest.raises(SceneError, match="a Derived of open3d has no points"):
        og.segment(host("open3d.x"), ["apple"], scene)
    imported = sys.modules.get("trimesh")
    assert imported is None or isinstance(imported, types.ModuleType)


def test_a_cloud_that_was_read_is_asked_in_world_coordinates(tmp_path):
    mapped = runtime.as_scene(CLOUDS["map coordinates"])
    points = og.read_points(og.segment(mapped, WORDS).save(tmp_path / "own.ply"))
    assert np.abs(points.xyz).max() < 100
    result = og.segment(points, WORDS, mapped)
    np.testing.assert_array_equal(result.xyz, points.xyz_world)
    np.testing.assert_array_equal(result.instances, mapped.instance_ids)


@pytest.mark.parametrize("ending", [".ply", ".pcd"])
def test_a_file_without_points_is_answered_as_an_array_without_is(scene, tmp_path, ending):
    path = tmp_path / f"none{ending}"
    if ending == ".ply":
        quietly(np.zeros((0, 3)), ["apple"], scene).save(path)
    else:
        path.write_text("VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 0\nHEIGHT 1\nPOINTS 0\n"
                        "DATA ascii\n")  # fmt: skip
    with pytest.warns(UserWarning, match="no point has a label: the cloud has 0 points"):
        result = og.segment(path, ["apple"], scene)
    assert result.counts() == {"apple": 0}
    assert len(np.load(result.save(tmp_path / "out.npz"))["labels"]) == 0


@pytest.mark.parametrize(
    ("pcd", "says"),
    [
        (np.zeros(3), r"float64 \(3,\)"),
        (np.zeros((3, 4)), r"\(3, 4\)"),
        (np.array([["a", "b", "c"]]), "<U1"),
        ([[1, 2], [3]], "not an array of points"),
        (None, "object"),
        (np.zeros((1, 3), complex), "complex"),
    ],
)
def test_what_is_no_cloud(scene, pcd, says):
    with pytest.raises(SceneError, match=says):
        og.segment(pcd, ["apple"], scene)


# Which words


def test_words_come_from_the_vocabulary_a_mapping_a_file_or_what_was_read(scene, tmp_path):
    vectors = unit_rows(5, seed=0)
    np.savez(tmp_path / "t.npz", names=np.array(WORDS), vectors=vectors, feature_space=np.array(SPACE))
    asked = ["pear", "apple"]
    expected = og.segment(scene, asked)
    assert expected.names == ("pear", "apple")
    mapping = {"pear": vectors[1], "apple": list(vectors[0] * 7)}
    bare = replace(room(), vocabulary=None)
    for result in (
        og.segment(scene, mapping),
        og.segment(scene, Vocabulary(("pear", "apple"), vectors[[1, 0]])),
        og.segment(bare, iter(asked), text_features=tmp_path / "t.npz"),
        og.segment(bare, tuple(asked), text_features=og.read_text_features(tmp_path / "t.npz")),
    ):
        assert (result.labels == expected.labels).all()
        assert result.names == ("pear", "apple")
    assert og.segment(scene).names == WORDS
    assert og.segment(bare, text_features=tmp_path / "t.npz").names == WORDS
    assert og.segment(scene, "café").names == ("café",)


def test_a_word_may_be_an_array_without_dimensions(scene):
    assert og.segment(scene, np.array("apple")).names == ("apple",)
    with pytest.raises(OgPointcloudError, match=r"is a .*; expected words, or name -> vector"):
        og.segment(scene, np.array(5))


@pytest.mark.parametrize("given", [{"apple": np.ones(WIDTH)}, Vocabulary(("a",), np.ones((1, WIDTH))), ("a", "b"), 3])
def test_what_are_no_text_features_is_refused(scene, given, tmp_path):
    said = r"text_features are a \w+; expected an .npz file, or what og.read_text_features returned"
    with pytest.raises(OgPointcloudError, match=said):
        og.segment(scene, ["apple"], text_features=given)
    og.write_bundle(scene.cloud, tmp_path / "scans" / "a.ogpc")
    collection = og.Collection.index(tmp_path / "scans", tmp_path / "atlas", progress=False)
    with pytest.raises(OgPointcloudError, match=said):
        collection.find("apple", text_features=given)


def test_a_files_words_come_before_the_scenes(scene):
    own = Vocabulary(("apple",), -unit_rows(1, seed=0))
    result = og.segment(scene, ["apple", "pear"], text_features=(own, "unknown"))
    assert (result.labels != og.segment(scene, ["apple", "pear"]).labels).any()


@pytest.mark.parametrize(
    ("labels", "error", "says"),
    [
        (["aple"], OgPointcloudError, "'aple' is not among the 5 known words; did you mean 'apple'"),
        (["Red Ball"], OgPointcloudError, "did you mean 'red ball'"),
        (["zzz", "apple", "yyy"], OgPointcloudError, r"5 known words \(apple, .*\), nor are 1 more of"),
        ([], OgPointcloudError, "0 labels"),
        (["apple", " "], OgPointcloudError, "a label is empty"),
        ({}, OgPointcloudError, "0 labels"),
        (["apple", "pear", "apple"], OgPointcloudError, "'apple' is given twice"),
        ([1], OgPointcloudError, "label 1 is a int"),
        (5, OgPointcloudError, "label 5 is a int"),
        (b"apple", OgPointcloudError, "label b'apple' is a bytes"),
        ({"a": np.ones(WIDTH - 1)}, FeatureSpaceError, rf"\(dimension {WIDTH - 1}\); expected .*\(dimension {WIDTH}\)"),
        ({"a": np.ones(WIDTH), "b": np.ones(3)}, FeatureSpaceError, r"'b' is float64 \(3,\)"),
        ({"a": np.ones((1, WIDTH))}, FeatureSpaceError, r"'a' is float64 \(1, 16\)"),
        ({"a": [[1, 2], [3]]}, FeatureSpaceError, "the vector of 'a' is object"),
        ({"a": "text"}, FeatureSpaceError, "the vector of 'a'"),
        ({"a": np.zeros(WIDTH)}, FeatureSpaceError, "'a' is zero"),
        ({"a": np.ones(WIDTH), "b": np.full(WIDTH, np.nan)}, FeatureSpaceError, "'b' is NaN"),
    ],
)
def test_labels_that_cannot_be_asked(scene, labels, error, says):
    with pytest.raises(error, match=says):
        og.segment(scene, labels)


@pytest.mark.parametrize("words", [None, Vocabulary((), np.zeros((0, WIDTH), np.float32))])
def test_words_without_any_vocabulary(words):
    bare = replace(CLOUDS["room"], vocabulary=words)
    with pytest.raises(OgPointcloudError, match="'chair' is not among the 0 known words: pass"):
        og.segment(bare, ["chair"])
    with pytest.raises(OgPointcloudError, match=r"no labels are given, .*--labels chair,table; pass"):
        og.segment(bare)


def test_text_features_of_another_space_are_refused(scene, tmp_path):
    np.savez(tmp_path / "t.npz", names=np.array(["a"]), vectors=np.ones((1, WIDTH)), feature_space=np.array("other"))
    with pytest.raises(FeatureSpaceError, match=r"t.npz are in feature space 'other' .*expected .*'tiny-test-space':"):
        og.segment(scene, ["a"], text_features=tmp_path / "t.npz")
    np.savez(tmp_path / "t.npz", names=np.array(["a"]), vectors=np.ones((1, WIDTH)))
    assert len(og.segment(scene, ["a"], text_features=tmp_path / "t.npz"))


# What comes back


def test_result_masks_counts_and_refusals(scene, tmp_path):
    result = og.segment(scene, ["apple", "pear"])
    assert (result.labels.dtype, result.scores.dtype, result.instances.dtype) == (np.int32, np.float32, np.int32)
    assert result.counts() == {"apple": (result.labels == 0).sum(), "pear": (result.labels == 1).sum()}
    assert (result.mask("pear") == (result.labels == 1)).all()
    assert {type(name) for name in og.segment(scene, np.array(["apple", "pear"])).names} == {str}
    assert (result.scores[result.labels < 0] == 0).all()
    assert (result.labels[result.instances == 4] == -1).all()  # it has no descriptor
    with pytest.raises(OgPointcloudError, match="'plum' was not asked for; the labels are apple, pear"):
        result.mask("plum")
    with pytest.raises(OgPointcloudError, match=r"expected one of .npz, .ply, .las, .laz, .glb"):
        result.save(tmp_path / "out.txt")
    with pytest.raises(
        OgPointcloudError, match=r"the file to save is 3; expected a name that ends in one of .npz, .ply"
    ):
        result.save(3)
    with pytest.raises(OgPointcloudError, match=r"splats are a str; expected those that og.read_points"):
        result.save(tmp_path / "out.glb", splats="kitchen.ply")
    with pytest.raises(OgPointcloudError, match=r"'.*out\.ply' would not keep the splats; expected .* .glb or .spz"):
        result.save(tmp_path / "out.ply", splats=Points.from_world(scene.xyz))


def test_an_empty_frame_does_not_hide_that_the_next_ones_are_misplaced(scene):
    ask = og.Segmenter(scene, ["apple"])
    for points, told in ((np.zeros((0, 3)), "the cloud has 0 points"), (scene.xyz + 100, "too far from the scene")):
        with pytest.warns(UserWarning, match=told):
            ask(points)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            ask(points)


def test_a_scene_is_used_from_another_folder(bundle, tmp_path, monkeypatch):
    monkeypatch.chdir(bundle.parent)
    assert og.load(bundle.name).path == bundle
    with pytest.raises(BundleError, match=r"^nothing\.ogpc is not a file"):
        og.load("nothing.ogpc")


def test_what_a_strangers_words_do_to_a_terminal_is_shown(scene):
    words = {"\x1b[2Jevil\n* instance 9": np.eye(WIDTH)[0], "pear": np.eye(WIDTH)[1]}
    for shown in (repr(og.segment(scene, words)), repr(og.select(scene, "apple", against=words))):
        assert "\x1b" not in shown
        assert not any(line.startswith("* instance 9") for line in shown.splitlines())


def test_a_vector_of_another_width_is_blamed_on_the_vector(scene):
    with pytest.raises(FeatureSpaceError, match=r"vector of 'mug' .*\(dimension 4\)"):
        og.select(scene, {"mug": np.ones(4)})


def test_a_pose_that_torch_rounded_is_told_as_one_that_numpy_did(scene):
    torch = pytest.importorskip("torch")
    pose = np.eye(4)
    pose[:3, 3] = 5e6 + 0.3
    for rounded in (pose.astype(np.float32), torch.tensor(pose, dtype=torch.float32)):
        with pytest.warns(UserWarning, match="float32 rounded the pose to steps of 0.5"):
            og.segment(scene.xyz - pose[:3, 3], ["apple"], scene, pose=rounded)


def test_what_is_printed_fits_on_a_screen(scene):
    points = np.concatenate([scene.xyz, [[99, 99, 99]]])
    result = quietly(points, ["apple", "pear"], scene)
    lines = repr(result).splitlines()
    assert lines[0] == f"{len(points):,} points, each with its best label, fitting or not (no word bank)"
    assert lines[-1].split("  ")[0] == "unknown, too far from the scene"
    counted = [int(line.rsplit(maxsplit=1)[1].replace(",", "")) for line in lines[1:]]
    assert sum(counted) == len(points)
    for shown in (scene, scene.cloud, scene.cloud.instances, scene.cloud.vocabulary, og.select(scene, "apple")):
        assert len(repr(shown)) < 2000
    assert f"{len(scene.xyz):,} points" in repr(scene)
    many = [f"word {k}" for k in range(40)]
    directions = np.eye(scene.vocabulary.vectors.shape[1])[np.arange(40) % scene.vocabulary.vectors.shape[1]]
    assert len(repr(quietly(points, dict(zip(many, directions, strict=True)), scene)).splitlines()) < 22


def test_result_is_saved_as_npz_and_ply(scene, tmp_path):
    result = og.segment(scene, ["café", "pear"])
    saved = np.load(result.save(tmp_path / "out.npz"), allow_pickle=False)
    assert sorted(saved) == ["calibrated", "certainty", "instances", "labels", "names", "reasons", "scores"]
    assert (saved["certainty"] == result.certainty).all()
    assert (saved["labels"] == result.labels).all()
    assert (saved["reasons"] == result.reasons).all()
    assert not saved["calibrated"]
    assert saved["names"].tolist() == ["café", "pear"]
    points = og.read_points(result.save(tmp_path / "out.ply"))
    assert np.abs(points.xyz_world - result.xyz).max() < 1e-5
    assert (points.rgb == result.colors).all()
    assert sorted(file.name for file in tmp_path.iterdir()) == ["out.npz", "out.ply"]


def test_colors_tell_labels_apart_and_do_not_depend_on_the_others():
    colors = label_colors(np.arange(-1, 40))
    assert len(np.unique(colors, axis=0)) == 41
    assert colors[0].tolist() == [128, 128, 128]
    assert (label_colors(np.array([5, -1, 2])) == colors[[6, 0, 3]]).all()
    assert label_colors(np.zeros(0, np.int32)).shape == (0, 3)


@pytest.mark.parametrize(
    ("points", "says"),
    [
        (np.zeros((0, 3)), "the cloud has 0 points"),
        (
            np.full((4, 3), 50.0),
            r"none of 4 points has a label: 4 are too far .* span 50..50 x .*reach is 0.15: .*frame and unit",
        ),
        (np.full((4, 3), np.nan), "4 are without finite coordinates$"),
    ],
)
def test_no_label_at_all_is_explained(scene, points, says):
    with pytest.warns(UserWarning, match=says):
        og.segment(points, ["apple"], scene)


def test_points_without_finite_coordinates_are_not_called_far(scene):
    points = np.vstack([scene.xyz[:5], np.full((2, 3), 90.0), [[np.nan, 0, 0], [0, 0, np.inf], [0, -np.inf, 0]]])
    result = og.segment(points, ["apple"], scene)
    assert (result.instances[5:] == og.TOO_FAR).all()
    assert result.reasons[5:].tolist() == [og.Reason.TOO_FAR] * 2 + [og.Reason.NOT_FINITE] * 3


def test_no_label_of_a_clouds_own_points_is_explained():
    with pytest.warns(UserWarning, match="800 are unobserved"):
        og.segment(CLOUDS["all unobserved"], ["apple"])
    with pytest.warns(UserWarning, match=r"are of instances without a feature, \d+ are background"):
        og.segment(CLOUDS["instances without any descriptor"], ["apple"])


@pytest.mark.parametrize(
    ("bring", "says"),
    [
        (
            lambda xyz: xyz / 1000,
            r"3000 are background; all of them lie within 0.00\d+, .* scene's unit",
        ),
        (
            lambda xyz: xyz.astype(np.float32),
            "so other labels may be wrong too; float32 rounded them to steps of 0.5",
        ),
    ],
)
def test_a_cloud_of_another_unit_or_precision_that_lies_near_the_scene_is_told(scene, bring, says):
    """Nearly all of its points are within reach of something, and get that label."""
    origin = np.array([431234.567, 5412345.678, 312.345]) * ("float32" in says)
    mapped = runtime.as_scene(replace(scene.cloud, origin=origin))
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # a detail, a few rounded places, and the scene's own points are as they may be
        corner = mapped.xyz[np.abs(mapped.xyz - mapped.xyz[0]).max(axis=1) < 0.3]
        og.segment(corner, ["apple", "pear"], mapped)
        og.segment(mapped.xyz[:40].astype(np.float32), ["apple", "pear"], mapped)
        og.segment(mapped, ["apple", "pear"])
    with pytest.warns(UserWarning, match=says):
        og.segment(bring(mapped.xyz), ["apple", "pear"], mapped)


@pytest.mark.parametrize("as_given", [lambda pose: pose, lambda pose: pose.astype(np.float64), np.ndarray.tolist])
def test_a_pose_that_float32_rounded_is_told_where_it_matters(scene, as_given):
    origin = np.array([431234.567, 5412345.678, 312.345])
    mapped = runtime.as_scene(replace(scene.cloud, origin=origin))
    turn, about = np.eye(4), 0.3
    turn[:2, :2] = [[np.cos(about), -np.sin(about)], [np.sin(about), np.cos(about)]]
    pose = turn.copy()
    pose[:3, 3] = origin
    sensor = scene.xyz @ turn[:3, :3]
    shift = np.eye(4)
    shift[:3, 3] = [431234, 5412345, 312]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        og.segment(sensor, WORDS, mapped, pose=pose)
        og.segment(sensor, WORDS, scene, pose=as_given(turn.astype(np.float32)))
        og.segment(mapped.xyz - shift[:3, 3], WORDS, mapped, pose=as_given(shift.astype(np.float32)))  # which is exact
    with pytest.warns(
        UserWarning, match=r"float32 rounded the pose to steps of 0.5, but the scene's points lie 0.05 apart"
    ):
        og.segment(sensor, WORDS, mapped, pose=as_given(pose.astype(np.float32)))


# Poses, crops, densities, noise, streams

POSE = np.array([[0, -1, 0, 250.5], [1, 0, 0, -3.25], [0, 0, 1, 1e6], [0, 0, 0, 1]])


def same(ours, theirs):
    return all((getattr(ours, key) == getattr(theirs, key)).all() for key in ("labels", "scores", "instances"))


def test_a_pose_takes_the_cloud_to_the_scenes_world(scene):
    world = queries(scene.cloud, 200)[:600].astype(np.float64)
    sensor = (world - POSE[:3, 3]) @ POSE[:3, :3]
    result = og.segment(sensor, ["apple", "pear"], scene, pose=POSE)
    assert np.abs(result.xyz - world).max() < 1e-9
    assert same(result, og.segment(result.xyz, ["apple", "pear"], scene))
    assert same(result, og.Segmenter(scene, ["apple", "pear"])(sensor, POSE.tolist()))
    assert same(og.segment(scene, ["apple"], pose=np.eye(4)), og.segment(scene.xyz, ["apple"], scene))
    shifted = runtime.as_scene(replace(scene.cloud, origin=np.array([1e6, -2e6, 5e5])))
    moved = np.eye(4)
    moved[:3, 3] = shifted.cloud.origin
    assert same(og.segment(world, ["apple"], shifted, pose=moved), og.segment(world, ["apple"], scene))


@pytest.mark.parametrize(
    ("pose", "says"),
    [
        (np.eye(3), r"pose is float64 \(3, 3\)"),
        (np.full((4, 4), np.nan), r"nan.* expected a finite 4x4"),
        (POSE.T, "expected 0 0 0 1"),
        (np.eye(4, dtype=complex), "complex128"),
        ([[1, 0], [1]], "expected a finite 4x4"),
    ],
)
def test_poses_that_are_none(scene, pose, says):
    with pytest.raises(SceneError, match=says):
        og.segment(np.zeros((1, 3)), ["apple"], scene, pose=pose)


@pytest.mark.parametrize("name", ["room", "far outliers"])  # the latter leaves all beyond its grid open
def test_rows_that_are_not_finite_are_beyond_and_harm_no_other(name):
    scene = runtime.as_scene(CLOUDS[name])
    points = scene.xyz[:60].copy()
    clean = og.segment(points, ["apple", "pear"], scene)
    bad = np.repeat(points, 2, axis=0)
    bad[1::2] = [[np.nan, 0, 0], [0, np.inf, 0], [0, 0, -np.inf], [1e300, 0, 0], [np.nan, np.inf, -np.inf]] * 12
    for pose in (None, np.eye(4)):
        result = og.segment(bad, ["apple", "pear"], scene, pose=pose)
        assert (result.labels[::2] == clean.labels).all()
        assert (result.labels[1::2] == -1).all()
        assert (result.instances[1::2] == TOO_FAR).all()


def test_a_crop_a_shuffle_and_another_density_answer_point_by_point(scene):
    points = queries(scene.cloud, 300).astype(np.float64)
    whole = scene.instances_at(points)
    order = np.random.default_rng(0).permutation(len(points))
    assert (scene.instances_at(points[order]) == whole[order]).all()
    assert (scene.instances_at(points[::7]) == whole[::7]).all()
    assert [int(scene.instances_at(point[None])[0]) for point in points[:20]] == whole[:20].tolist()
    assert (scene.instances_at(np.repeat(points, 3, axis=0)) == np.repeat(whole, 3)).all()


def test_certainty_is_that_of_the_nearest_point(scene):
    own = scene.cloud.certainty / 255
    points = queries(scene.cloud, 300).astype(np.float64)
    points[:3] = np.nan
    nearest = nearest_plainly(scene.cloud, points.astype(np.float32))
    nearest[:3] = -1
    expected = np.append(own, 0)[nearest]
    segmenter = og.Segmenter(scene, ["apple", "pear"], max_distance=0.05)
    far = segmenter(points).instances == TOO_FAR
    assert 0 < far.sum() < len(points)
    for result, wanted in (
        (og.segment(scene, ["apple"]), own),
        (og.segment(points, ["apple"], scene), expected),
        (segmenter(points), np.where(far, 0, expected)),
    ):
        assert result.certainty.dtype == np.float32
        np.testing.assert_allclose(result.certainty, wanted, rtol=1e-6)
    columns = {name: getattr(result, name)[::3] for name in ("xyz", "labels", "scores", "instances", "reasons")}
    of_rows = replace(result, **columns, certainty_of=result.certainty[::3])
    np.testing.assert_array_equal(of_rows.certainty, result.certainty[::3])
    with pytest.raises(
        OgPointcloudError, match="certainty has 902 values, the result 301 points; expected one value per point"
    ):
        _ = replace(result, **columns).certainty


def test_certainty_is_of_the_points_asked_about_whatever_becomes_of_them(scene, tmp_path):
    points = queries(scene.cloud, 200).astype(np.float64)
    for make in (lambda: og.segment(scene, WORDS), lambda: quietly(points, WORDS, scene, max_distance=0.05)):
        expected = make().certainty
        assert expected.any()
        result = make()
        result.xyz[:] += 100
        result.instances[:] = TOO_FAR
        assert np.array_equal(np.load(result.save(tmp_path / "out.npz"))["certainty"], expected)


def test_a_scene_that_knows_no_certainty_says_none(scene, tmp_path):
    unknown = og.load(write_bundle(replace(scene.cloud, certainty=None), tmp_path / "s.ogpc"))
    for pcd in (unknown, scene.xyz[:5]):
        result = og.segment(pcd, ["apple"], unknown)
        assert result.certainty is None
        assert "certainty" not in np.load(result.save(tmp_path / "out.npz"), allow_pickle=False)
    with pytest.raises(OgPointcloudError, match=r"certainty is float32 \(3000,\); expected uint8 \(3000,\)"):
        replace(scene.cloud, certainty=np.zeros(3000, np.float32))


def test_noise_below_the_gap_between_objects_changes_no_label():
    random = np.random.default_rng(0)
    xyz = random.random((4000, 3)) * [1, 1, 0.01]
    xyz[:, 0] += np.where(xyz[:, 0] > 0.5, 0.2, 0)  # a gap of ten spacings
    scene = runtime.as_scene(make_cloud(xyz, xyz[:, 0] > 0.6, 0.02, 0.08))
    noisy = xyz + random.uniform(-0.04, 0.04, xyz.shape)
    assert (scene.instances_at(noisy) == (noisy[:, 0] > 0.6)).all()


def test_a_shorter_reach_is_exact(scene):
    points = queries(scene.cloud, 200).astype(np.float64)
    words = ["apple", "pear"]
    true = np.sqrt(((points.astype(np.float32)[:, None].astype(np.float64) - scene.cloud.xyz) ** 2).sum(2)).min(1)
    for limit in (0.01, 0.05, 0.12):
        result = og.segment(points, words, scene, max_distance=limit)
        assert ((result.instances == TOO_FAR) == (true > limit)).all()
        assert (result.instances == scene.instances_at(points))[true <= limit].all()
    for limit in (0, -1, 0.16, float("nan"), "0.1", [0.1]):
        with pytest.raises(OgPointcloudError, match=rf"max_distance is {re.escape(repr(limit))}; .*reach, 0.15"):
            og.segment(points, words, scene, max_distance=limit)
    with pytest.warns(UserWarning, match="too far from the scene; .* and max_distance is 0.001: bring"):
        og.segment(scene.xyz + 0.002, words, scene, max_distance=0.001)


@pytest.mark.parametrize("name", ["room", "far outliers", "coincident points of different ids", "scattered points"])
def test_points_that_the_table_leaves_open_are_settled_exactly(monkeypatch, tmp_path, name):
    monkeypatch.setattr(lookup_grid, "MIN_LIST_BUDGET", 0)
    monkeypatch.setattr(lookup_grid, "LISTS_PER_POINT", 0)
    cloud = CLOUDS[name]
    scene = og.load(write_bundle(cloud, tmp_path / "s.ogpc"))
    points = queries(cloud, 150)
    instances = scene.instances_at(points.astype(np.float64) + cloud.origin)
    assert (instances == instances_plainly(cloud, points)).all()
    still_open = ~scene._graph.look_up(points)[1] & (instances != TOO_FAR)
    assert still_open.sum() > 20


def test_scenes_and_answers_go_to_other_processes(scene, bundle):
    points = queries(scene.cloud, 200).astype(np.float64)
    ask = og.Segmenter(og.load(bundle), ["apple", "pear"])
    answer = ask(points)
    sent = pickle.loads(pickle.dumps((ask, answer, og.select(ask.scene, "apple"))))
    assert same(sent[1], answer)
    assert len(pickle.dumps(ask(points[:1]))) < 3000, "an answer takes no scene along"
    assert same(sent[0](points), answer)
    np.testing.assert_array_equal(sent[1].certainty, answer.certainty)
    assert sent[2].to_json() == og.select(scene, "apple").to_json()


def test_threads_share_a_segmenter(scene):
    ask = og.Segmenter(scene, ["apple", "pear"])
    frames = [queries(scene.cloud, 200, seed).astype(np.float64) for seed in range(8)]
    alone = [ask(frame) for frame in frames]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(ask, frames * 5))
    assert all(same(result, alone[index % 8]) for index, result in enumerate(together))
