"""Text encoders at run time: what they answer, how they are found, and that no file that is read can do harm."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
from dataclasses import replace

import numpy as np
import onnx
import pytest
from hostile_files import encoder_with
from labelled_clouds import room, unit_rows
from og_pointcloud_export import write_bundle
from onnx import TensorProto, helper, numpy_helper
from text_models import OUT, SPACE, encoder_files, write_files

import og_pointcloud as og
from og_pointcloud.cloud import Vocabulary
from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.formats.npy import npy_bytes
from og_pointcloud.models import check_graph
from og_pointcloud.text.encoder import (
    OPERATORS,
    TextEncoder,
    cache_folder,
    encoder_for,
    find_encoder,
    read_text_encoder,
)


@pytest.fixture(autouse=True)
def no_models_of_this_machine(monkeypatch, tmp_path):
    monkeypatch.delenv("OG_POINTCLOUD_MODELS", raising=False)
    monkeypatch.setattr("og_pointcloud.text.encoder.cache_folder", lambda: tmp_path / "cache")


@pytest.fixture(scope="module")
def encoder_folder(tmp_path_factory):
    return write_files(tmp_path_factory.mktemp("encoders") / "tiny", encoder_files())


@pytest.fixture
def encoder(encoder_folder):
    return TextEncoder({path.name: path.read_bytes() for path in encoder_folder.iterdir()}, str(encoder_folder))


def scene_of(encoder, path, names, descriptors):
    cloud = room(300)
    table = replace(cloud.instances, descriptors=np.asarray(descriptors, np.float32))
    words = Vocabulary(tuple(names), encoder(names)) if names else None
    return write_bundle(replace(cloud, instances=table, feature_space=SPACE, vocabulary=words), path)


def test_names_are_put_into_templates_and_averaged(encoder):
    plain = encoder.encode(["a cat", "low cat cat"]).mean(axis=0)
    assert np.abs(encoder(["{0.__class__}"]) - encoder.encode(["{0.__class__}"])).max() < 1e-6
    encoder.templates = ("a {}", "low {} cat")
    assert np.abs(encoder(["cat"])[0] - plain / np.linalg.norm(plain)).max() < 1e-6
    assert encoder([]).shape == (0, OUT)


def test_a_text_is_encoded_once(encoder, monkeypatch):
    first = encoder.encode(["cat", "low", "cat"])
    assert (first[0] == first[2]).all()
    with monkeypatch.context() as patch:
        patch.setitem(encoder.__dict__, "_session", None)
        assert (encoder.encode(["low", "cat"]) == first[[1, 0]]).all()
    monkeypatch.setattr("og_pointcloud.text.encoder.MAX_CACHED_VECTORS", 1)
    encoder.encode(["cat"])
    assert list(encoder._cache) == ["cat"]


def test_threads_share_an_encoder(encoder, encoder_folder):
    texts = [f"cat {number}" for number in range(40)]
    results = {}
    threads = [
        threading.Thread(target=lambda key=key: results.update({key: encoder.encode(texts)})) for key in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(results) == 4
    assert all((result == results[0]).all() for result in results.values())


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda m: m.update(format="zip"), "format is .'zip', 1.; expected 'og-text-encoder' 1"),
        (lambda m: m.update(schema_version=2), "expected 'og-text-encoder' 1"),
        (lambda m: m.update(width=0), "width is 0"),
        (lambda m: m.update(width=True), "width is True"),
        (lambda m: m.update(width=OUT + 1), r"word_bank.npy cannot be used \(it is <f2 .*expected <f2 \(B, 25\)"),
        (lambda m: m.update(context_length=10**12), "context_length is"),
        (lambda m: m.update(context_length="77"), "context_length is '77'"),
        (lambda m: m.update(vocabulary=10), "gives ids up to 519, but the model has 10"),
        (lambda m: m.update(pad_id=10**6), "pad_id is 1000000"),
        (lambda m: m.update(templates=[]), "no slot for the name"),
        (lambda m: m.update(templates=[3]), "no slot for the name"),
        (lambda m: m.update(templates="{}"), "expected a list"),
        (lambda m: m.update(precision="fp8"), "precision 'fp8'"),
        (lambda m: m.update(feature_space=None), "feature_space None"),
        (lambda m: m.pop("files"), "'files' is missing"),
        (lambda m: m["files"]["tokenizer.json"].update(crc32=0), "checksum"),
        (lambda m: m.update(files=[]), "not a usable encoder"),
    ],
)
def test_manifests_that_do_not_fit(tmp_path, change, says):
    folder = write_files(tmp_path / "e", encoder_with(change=change))
    with pytest.raises(OgPointcloudError, match=says) as caught:
        read_text_encoder(folder).encode(["cat"])
    assert str(caught.value).startswith(str(folder))


def test_a_graph_of_another_width_than_its_manifest_says(tmp_path):
    bank = npy_bytes(np.ones((50, OUT + 1), np.float16))
    folder = write_files(tmp_path / "e", encoder_with(width=OUT + 1, bank=bank))
    with pytest.raises(OgPointcloudError, match=r"returns float32 \(1, 24\).*make the encoder again"):
        read_text_encoder(folder).encode(["cat"])


def external(model):
    model.graph.initializer[0].ClearField("raw_data")
    model.graph.initializer[0].data_location = TensorProto.EXTERNAL
    model.graph.initializer[0].external_data.add(key="location", value="/etc/passwd")


def claim_much(model):
    model.graph.initializer[0].dims[0] = 1 << 40


def unpack(model):
    model.graph.initializer[0].ClearField("raw_data")
    model.graph.initializer[0].float_data.extend([1.0] * 8)


def branch(model):
    inner = helper.make_graph([], "inner", [], [])
    model.graph.node.append(helper.make_node("If", ["x"], ["y"], then_branch=inner, else_branch=inner))


def hidden_constant(model):
    tensor = numpy_helper.from_array(np.ones(3, np.float32), "t")
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value="secret")
    model.graph.node.append(helper.make_node("Cast", ["x"], ["y"], value=tensor))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (external, "refers to other files"),
        (hidden_constant, "refers to other files"),
        (claim_much, "constant of shape"),
        (unpack, "not stored as plain bytes"),
        (branch, "uses the operator 'If'"),
        (
            lambda m: m.graph.node.append(helper.make_node("ConstantOfShape", ["x"], ["y"])),
            "operator 'ConstantOfShape'",
        ),
        (lambda m: m.graph.node.append(helper.make_node("Add", ["x"], ["y"], domain="com.evil")), "of 'com.evil'"),
        (lambda m: m.opset_import.append(helper.make_opsetid("com.microsoft", 1)), "operators of 'com.microsoft'"),
        (lambda m: m.functions.append(onnx.FunctionProto(name="f")), "functions of its own"),
        (lambda m: m.graph.sparse_initializer.append(onnx.SparseTensorProto()), "sparse"),
    ],
)
def test_graphs_that_could_do_harm(encoder_folder, tmp_path, change, says):
    model = onnx.load(encoder_folder / "text_encoder.onnx")
    change(model)
    folder = write_files(tmp_path / "e", encoder_with(graph=model.SerializeToString()))
    with pytest.raises(OgPointcloudError, match=says):
        read_text_encoder(folder)


def test_a_graph_inside_a_node_is_refused_whatever_the_operator(encoder_folder):
    model = onnx.load(encoder_folder / "text_encoder.onnx")
    branch(model)
    with pytest.raises(ValueError, match="contains a graph of its own"):
        check_graph(model.SerializeToString())


def test_graphs_of_noise_are_refused_or_harmless(encoder_folder):
    data = (encoder_folder / "text_encoder.onnx").read_bytes()
    random = np.random.default_rng(0)
    check_graph(data, OPERATORS)
    structure = data[: data.index(b"raw") if b"raw" in data else 4000]
    passed = 0
    for _ in range(2000):
        noise = bytearray(structure)
        for place in random.integers(0, len(noise), 3):
            noise[place] = random.integers(256)
        with contextlib.suppress(ValueError):  # and nothing else
            check_graph(bytes(noise), OPERATORS)
            passed += 1
    assert passed < 2000


def test_files_that_are_damaged_or_too_large(tmp_path, monkeypatch):
    for number, (name, data) in enumerate(
        [("tokenizer.json", b"{}"), ("text_encoder.onnx", b""), ("manifest.json", b"[")]
    ):
        folder = write_files(tmp_path / str(number), encoder_files() | {name: data})
        with pytest.raises(OgPointcloudError, match="make the encoder again"):
            read_text_encoder(folder)
        (folder / name).unlink()
        with pytest.raises(OgPointcloudError, match=f"{name}"):
            read_text_encoder(folder)
    monkeypatch.setitem(read_text_encoder.__globals__["ENCODER"].more, "tokenizer.json", 10)
    with pytest.raises(OgPointcloudError, match="expected at most 10"):
        read_text_encoder(write_files(tmp_path / "large", encoder_files()))


# Found by feature space


def test_encoders_are_found_among_the_models_and_in_the_cache(encoder_folder, tmp_path, monkeypatch):
    assert find_encoder(SPACE) is None
    (encoder_folder.parent / "stray").mkdir(exist_ok=True)
    (encoder_folder.parent / "stray" / "manifest.json").write_text("{")
    for value in (str(encoder_folder), os.pathsep.join([str(tmp_path / "absent"), str(encoder_folder.parent)])):
        monkeypatch.setenv("OG_POINTCLOUD_MODELS", value)
        assert encoder_for(SPACE).feature_space == SPACE
        assert find_encoder("another/space") is None
    assert encoder_for(SPACE) is encoder_for(SPACE)
    monkeypatch.delenv("OG_POINTCLOUD_MODELS")
    (tmp_path / "cache").mkdir()
    (tmp_path / "cache" / "tiny").symlink_to(encoder_folder)
    assert encoder_for(SPACE).feature_space == SPACE


def test_a_missing_encoder_names_the_command_that_makes_it():
    with pytest.raises(OgPointcloudError, match=r"export text laion/CLIP-ViT-B-16$"):
        encoder_for("laion/CLIP-ViT-B-16")


@pytest.mark.parametrize(
    ("platform", "environment", "expected"),
    [
        ("linux", {}, "~/.cache/og_pointcloud"),
        ("linux", {"XDG_CACHE_HOME": "/x"}, "/x/og_pointcloud"),
        ("linux", {"XDG_CACHE_HOME": "relative"}, "~/.cache/og_pointcloud"),
        ("darwin", {"XDG_CACHE_HOME": "/x"}, "~/Library/Caches/og_pointcloud"),
        ("win32", {"LOCALAPPDATA": "/l"}, "/l/og_pointcloud/Cache"),
    ],
)
def test_the_cache_is_where_the_platform_has_it(monkeypatch, platform, environment, expected):
    for name in ("XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(sys, "platform", platform)
    assert str(cache_folder()) == os.path.expanduser(expected)


def test_words_that_a_scene_lacks_are_encoded(encoder, encoder_folder, tmp_path, monkeypatch):
    names = ["cat", "low"]
    path = scene_of(encoder, tmp_path / "s.ogpc", names, unit_rows(9, OUT))
    scene = og.load(path)
    with pytest.raises(OgPointcloudError, match=r"'lower' is not among the 2 known words.*export text"):
        og.segment(scene, ["cat", "lower"])
    monkeypatch.setenv("OG_POINTCLOUD_MODELS", str(encoder_folder))
    result = og.segment(scene, ["cat", "lower"])
    expected = og.segment(scene, {"cat": encoder(["cat"])[0], "lower": encoder(["lower"])[0]})
    assert (result.labels == expected.labels).all()
    assert set(result.labels[result.labels >= 0]) == {0, 1}


def test_a_damaged_encoder_is_not_passed_over(encoder, tmp_path, monkeypatch):
    path = scene_of(encoder, tmp_path / "s.ogpc", ["cat"], unit_rows(9, OUT))
    folder = write_files(tmp_path / "e", encoder_files() | {"text_encoder.onnx": b"torn"})
    monkeypatch.setenv("OG_POINTCLOUD_MODELS", str(folder))
    with pytest.raises(OgPointcloudError, match="it is damaged or was changed"):
        og.segment(og.load(path), ["lower"])


def test_encoding_brings_nothing_heavy(encoder_folder):
    code = (
        "import sys\nfrom og_pointcloud.text.encoder import read_text_encoder\n"
        "assert read_text_encoder(sys.argv[1])(['cat']).shape == (1, 24)\nprint(*sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(encoder_folder)], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert "onnxruntime" in loaded
    assert not {"torch", "onnx", "transformers", "tokenizers", "regex", "safetensors"} & loaded
