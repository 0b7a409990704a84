"""Exported encoders: the vectors of transformers' own models, and what cannot be exported."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shutil

import numpy as np
import onnx
import pytest
from capture_files import BY_COLOR
from commands import error_of, output_of
from onnx import numpy_helper
from onnxruntime.quantization import QuantType, quantize_dynamic
from test_masks_command import make_capture
from text_models import (
    CONTEXT,
    END,
    KINDS,
    MERGES,
    OUT,
    SIZE,
    SPACE,
    TEXTS,
    clip_tokenizer,
    image_vectors,
    text_vectors,
    transformers_model,
    write_files,
    write_model,
)

from og_pointcloud.cli import main
from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.formats.capture import read_capture
from og_pointcloud.masking.crops import LANGSPLAT, WITH_CONTEXT
from og_pointcloud.masking.encode import CropEncoder, OnnxModel, open_encoder
from og_pointcloud.text.encoder import ENCODER, GRAPH, TextEncoder, encoder_for, read_text_encoder
from og_pointcloud.text.text_features import everyday_words

torch = pytest.importorskip("torch")
pytest.importorskip("transformers")
pytest.importorskip("onnxscript")
exporter = pytest.importorskip("og_pointcloud_export.encoders")
clip = pytest.importorskip("og_pointcloud.masking.clip")
dense = pytest.importorskip("og_pointcloud.masking.dense")
torch.set_num_threads(1)
pytestmark = pytest.mark.slow

PIXELS = np.random.default_rng(0).normal(size=(3, 3, SIZE, SIZE)).astype(np.float32)


@pytest.fixture(autouse=True)
def no_models_of_this_machine(monkeypatch, tmp_path):
    monkeypatch.delenv("OG_POINTCLOUD_MODELS", raising=False)
    monkeypatch.setattr("og_pointcloud.text.encoder.cache_folder", lambda: tmp_path / "cache")
    monkeypatch.setattr(exporter, "cache_folder", lambda: tmp_path / "cache")
    logging.getLogger("transformers").setLevel(logging.ERROR)


@pytest.fixture(autouse=True, scope="module")
def each_graph_is_made_once():
    """torch.onnx.export takes ten seconds, whichever test of the same module and weights asks for it."""
    make, graphs = exporter._onnx_graph, {}

    def kept(tower, *arguments):
        digest = hashlib.sha256(f"{type(tower)} {tower.model.config} {arguments[1:]}".encode())
        for weight in tower.parameters():
            digest.update(weight.detach().numpy().tobytes())
        if digest.digest() not in graphs:
            graphs[digest.digest()] = make(tower, *arguments)
        return graphs[digest.digest()]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(exporter, "_onnx_graph", kept)
        yield


@pytest.fixture(scope="module")
def model_folder(tmp_path_factory):
    return write_model(tmp_path_factory.mktemp("models") / "clip")


@pytest.fixture(scope="module")
def encoder_folder(model_folder):
    return exporter.export_text_encoder(model_folder, model_folder.parent / "text", feature_space=SPACE)[0]


@pytest.mark.parametrize("kind", KINDS)
def test_texts_have_the_vectors_of_transformers(kind, tmp_path):
    folder, manifest = exporter.export_text_encoder(
        write_model(tmp_path / "model", kind), tmp_path / "out", feature_space=SPACE
    )
    encoder, model = read_text_encoder(folder), transformers_model(kind)
    together = encoder.encode(TEXTS)
    expected = np.concatenate([text_vectors(model, encoder.tokens(text)) for text in TEXTS])
    assert np.abs(together - expected).max() < 1e-5
    assert (np.abs(expected[1] - expected[2]) > 1e-3).any(), "the model reads its tokens"
    is_clip = kind.startswith("clip")
    assert manifest["pad_id"] == (None if is_clip else END)
    assert ({len(encoder.tokens(text)) for text in TEXTS} == {CONTEXT}) == (not is_clip)
    assert manifest["parity"]["texts"] == len(exporter.PARITY_TEXTS)
    assert manifest["parity"]["max_abs_error"] < 1e-5
    assert manifest["parity"]["min_cosine"] > 1 - 1e-6
    for name, entry in manifest["files"].items():
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == entry["sha256"]


@pytest.mark.parametrize("kind", ["clip", "siglip"])
def test_images_have_the_vectors_of_transformers(kind, tmp_path):
    expected = image_vectors(transformers_model(kind), PIXELS)
    folder = write_model(tmp_path / "model", kind)
    assert np.abs(clip.TransformersModel(folder, SPACE)(PIXELS) - expected).max() < 1e-5
    out, manifest = exporter.export_image_encoder(folder, tmp_path / "out", feature_space=SPACE)
    assert np.abs(OnnxModel(out)(PIXELS) - expected).max() < 1e-5
    assert np.abs(OnnxModel(out)(PIXELS[:1]) - expected[:1]).max() < 1e-5
    assert (np.abs(expected[0] - expected[1]) > 1e-3).any(), "the model looks at its pixels"
    assert manifest["parity"]["max_abs_error"] < 1e-5
    assert manifest["width"] == expected.shape[1]
    assert manifest["preprocessing"]["size"] == SIZE


def test_merges_alone_make_the_same_tokenizer(model_folder, encoder_folder, tmp_path):
    shutil.copytree(model_folder, tmp_path / "model")
    description = clip_tokenizer(MERGES)
    (tmp_path / "model" / "tokenizer.json").unlink()
    (tmp_path / "model" / "vocab.json").write_text(json.dumps(description["model"]["vocab"]))
    merges = "".join(f"{left} {right}\n" for left, right in MERGES)
    (tmp_path / "model" / "merges.txt").write_text(f"#version: 0.2\n{merges}")
    folder, _ = exporter.export_text_encoder(tmp_path / "model", tmp_path / "out", feature_space=SPACE)
    before, after = read_text_encoder(encoder_folder), read_text_encoder(folder)
    assert [after.tokens(text) for text in TEXTS[:-1]] == [before.tokens(text) for text in TEXTS[:-1]]


# Dense features of exported encoders


@pytest.fixture(scope="module", params=("clip", "siglip"))
def folder(request, tmp_path_factory):
    return write_model(tmp_path_factory.mktemp(request.param), request.param)


@pytest.fixture(scope="module")
def exported(folder):
    return exporter.export_image_encoder(folder, folder.parent / f"{folder.name}-onnx", feature_space=SPACE)[0]


@pytest.mark.parametrize("shape", [(48, 48), (33, 40), (97, 31)])
def test_an_exported_encoder_gives_masks_the_same_vectors(folder, exported, shape):
    encoder = dense.DenseEncoder(clip.TransformersModel(folder, SPACE))
    random = np.random.default_rng(0)
    image = random.integers(0, 256, (*shape, 3)).astype(np.uint8)
    masks = random.uniform(size=(3, *shape)) < np.array([0.3, 0.05, 1.1])[:, None, None]
    light = open_encoder(exported, "dense")
    assert isinstance(light, dense.DenseEncoder)
    np.testing.assert_allclose(light.embed(image, masks), encoder.embed(image, masks), atol=1e-5)
    crops = open_encoder(exported)
    np.testing.assert_allclose(crops.embed(image, masks), CropEncoder(encoder.model).embed(image, masks), atol=1e-5)


def test_an_export_without_patches_and_one_that_lies_about_them(exported, tmp_path):
    def changed(patch):
        manifest = json.loads((exported / "manifest.json").read_text())
        files = {"image_encoder.onnx": (exported / "image_encoder.onnx").read_bytes()}
        return write_files(tmp_path / f"p{patch}", {"manifest.json": json.dumps(manifest | patch).encode(), **files})

    with pytest.raises(OgPointcloudError, match=r"whole crops; .*newly exported .og-pointcloud export image"):
        open_encoder(changed({"patch": None}), "dense")
    with pytest.raises(OgPointcloudError, match="patch is 0; expected a whole number up to 32"):
        open_encoder(changed({"patch": 0}), "dense")
    with pytest.raises(OgPointcloudError, match=r"expected finite float32 \(1, 16, 16, "):
        open_encoder(changed({"patch": 4}), "dense").embed(np.zeros((64, 64, 3), np.uint8), np.ones((1, 64, 64), bool))


def test_masks_on_the_command_line(folder, exported, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("og_pointcloud.cli.masks.warn_of_poses", lambda _: None)
    monkeypatch.setattr("og_pointcloud.masking.clip.published_name", lambda _: SPACE)
    make_capture(tmp_path / "c", 2)
    command = ["masks", str(tmp_path / "c"), "--proposer", BY_COLOR, "--encoder", str(folder)]
    found = []
    for features in ("dense", "crops"):
        assert main([*command, "--features", features]) == 0, capsys.readouterr().err
        found.append(np.concatenate([view.mask_features for view in read_capture(tmp_path / "c").views]))
    assert found[0].shape == found[1].shape
    assert np.abs(found[0] - found[1]).max() > 1e-3, "the second run made other features"
    command[-1] = str(exported)
    assert main([*command, "--features", "dense"]) == 0, capsys.readouterr().err
    light = np.concatenate([view.mask_features for view in read_capture(tmp_path / "c").views])
    np.testing.assert_allclose(light, found[0], atol=1e-5)


# What cannot be exported


class Harmful:
    def __reduce__(self):
        import os

        return os.mkdir, ("was_run",)


def test_folders_that_are_refused(model_folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def changed(**fields):
        shutil.rmtree(tmp_path / "model", ignore_errors=True)
        shutil.copytree(model_folder, tmp_path / "model")
        config = json.loads((model_folder / "config.json").read_text())
        (tmp_path / "model" / "config.json").write_text(json.dumps({**config, **fields}))
        return tmp_path / "model"

    def refused(folder, says, **options):
        for export in (exporter.export_text_encoder, exporter.export_image_encoder):
            with pytest.raises(OgPointcloudError, match=says):
                export(folder, tmp_path / "out", **{"feature_space": SPACE, **options})

    refused(tmp_path, "has no config.json")
    refused(changed(model_type="blip"), "model_type is 'blip'; expected one of clip, siglip")
    refused(changed(quantization_config={"quant_method": "gptq"}), "quantized")
    refused(changed(text_config=3), "cannot be read")
    nameless = "expected the name in your scenes .*: pass it to export text or export image with --feature-space"
    refused(changed(), nameless, feature_space=None)
    with pytest.raises(OgPointcloudError, match=f"{nameless}; masks takes the folder that export image makes"):
        open_encoder(changed())
    with pytest.raises(OgPointcloudError, match=r"has no config\.json"):  # of a text encoder, for one
        open_encoder(tmp_path)
    folder = changed(auto_map={"AutoModel": "evil.Model"})
    (folder / "evil.py").write_text("open('was_run', 'w')")
    clip.load_model(folder)
    (folder / "model.safetensors").write_bytes(b"\xff" * 100)
    refused(folder, "cannot be read")
    (folder / "model.safetensors").unlink()
    torch.save({"logit_scale": Harmful()}, folder / "pytorch_model.bin")
    refused(folder, "weights in .safetensors")
    assert not (tmp_path / "was_run").exists()
    assert not (tmp_path / "out").exists()


def test_weights_that_do_not_fit(model_folder, tmp_path):
    from safetensors.torch import load_file, save_file

    shutil.copytree(model_folder, tmp_path / "model")
    weights = load_file(model_folder / "model.safetensors")
    for change, says in (
        (lambda state: state.pop("text_projection.weight"), "lacks 1 of the weights of a CLIPModel, such as 'text_pro"),
        (lambda state: state["text_projection.weight"].fill_(torch.nan), "NaN|differs from torch by nan"),
        (lambda state: state.update({"text_projection.weight": torch.zeros(3, 3)}), "cannot be read"),
    ):
        state = {name: tensor.clone() for name, tensor in weights.items()}
        change(state)
        save_file(state, tmp_path / "model" / "model.safetensors", {"format": "pt"})
        with pytest.raises(OgPointcloudError, match=says):
            exporter.export_text_encoder(tmp_path / "model", tmp_path / "out", feature_space=SPACE)
    assert not (tmp_path / "out").exists()


def test_what_a_text_encoder_needs(model_folder, tmp_path):
    shutil.copytree(model_folder, tmp_path / "model")
    with pytest.raises(OgPointcloudError, match=r"no slot for the name; expected \{\}"):
        exporter.export_text_encoder(model_folder, tmp_path / "out", feature_space=SPACE, templates=["a photo"])
    (tmp_path / "model" / "tokenizer.json").unlink()
    with pytest.raises(OgPointcloudError, match=r"has no tokenizer; expected tokenizer\.json, or vocab\.json"):
        exporter.export_text_encoder(tmp_path / "model", tmp_path / "out", feature_space=SPACE)
    folder = write_model(tmp_path / "siglip", "siglip")
    (folder / "tokenizer_config.json").unlink()
    with pytest.raises(OgPointcloudError, match="has pad_token None"):
        exporter.export_text_encoder(folder, tmp_path / "out", feature_space=SPACE)
    for text in ('{"model": {}}', '{"model": []}', '{"model": {"vocab": [1]}}', '{"added_tokens": [{"id": 1}]}'):
        (folder / "tokenizer.json").write_text(text)
        with pytest.raises(OgPointcloudError, match=r"tokenizer\.json and tokenizer_config\.json cannot be read"):
            exporter.export_text_encoder(folder, tmp_path / "out", feature_space=SPACE)
    assert not (tmp_path / "out").exists()


def test_an_export_that_fails_writes_nothing(model_folder, tmp_path, monkeypatch):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "thesis.tex").write_text("years of work")
    with pytest.raises(OgPointcloudError, match="has other files than an encoder"):
        exporter.export_image_encoder(model_folder, tmp_path / "thesis", feature_space=SPACE)
    assert [path.name for path in (tmp_path / "thesis").iterdir()] == ["thesis.tex"]
    monkeypatch.setattr(exporter, "TOLERANCE", 0.0)
    for export in (exporter.export_text_encoder, exporter.export_image_encoder):
        with pytest.raises(OgPointcloudError, match="differs from torch"):
            export(model_folder, tmp_path / "out", feature_space=SPACE)
    monkeypatch.undo()
    monkeypatch.setattr("og_pointcloud.masking.encode.OPERATORS", frozenset({"Add"}))
    with pytest.raises(OgPointcloudError, match="uses the operator"):
        exporter.export_image_encoder(model_folder, tmp_path / "out", feature_space=SPACE)
    assert not (tmp_path / "out").exists()


def test_an_int8_encoder_of_before_gives_a_text_the_same_vector_whatever_it_runs_with(encoder_folder, tmp_path):
    exact = read_text_encoder(encoder_folder)
    model = onnx.load(encoder_folder / "text_encoder.onnx")
    del model.graph.value_info[:]
    quantize_dynamic(model, tmp_path / "q.onnx", ["MatMul", "Gather"], per_channel=True, weight_type=QuantType.QUInt8)
    model = onnx.load(tmp_path / "q.onnx")
    for constant in model.graph.initializer:
        constant.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(constant), constant.name))
    files = {path.name: path.read_bytes() for path in encoder_folder.iterdir()}
    manifest = json.loads(files.pop("manifest.json")) | {"precision": "int8"}
    files["text_encoder.onnx"] = model.SerializeToString()
    small = TextEncoder(exporter._with_manifest(manifest, files), "int8")
    assert 0.99 < (small.encode(TEXTS) * exact.encode(TEXTS)).sum(axis=1).min() < 0.999999
    alike = ["cat low", "low cat", "12", "lowlow", "cat cat"]
    assert len({len(small.tokens(text)) for text in alike}) == 1
    together = small.encode(alike)
    alone = TextEncoder(exporter._with_manifest(manifest, files), "alone")
    assert all((alone.encode([text])[0] == vector).all() for text, vector in zip(alike, together, strict=True))


# The command


def test_the_text_command(model_folder, tmp_path, capsys):
    arguments = ["export", "text", str(model_folder), "--feature-space", SPACE]
    printed = output_of(capsys, *arguments, "-o", tmp_path / "out", "--template", "a {}")
    assert "onnxruntime and torch differ by" in printed
    assert f"export OG_POINTCLOUD_MODELS='{tmp_path / 'out'}'" in printed
    made = read_text_encoder(tmp_path / "out")
    assert made.templates == ("a {}",)
    words = everyday_words()[:30]
    assert np.abs(made.word_bank.vectors[:30] - made.encode([f"a {word}" for word in words])).max() < 1e-3


def test_the_image_command(model_folder, tmp_path, capsys):
    arguments = ["export", "image", str(model_folder), "-o", str(tmp_path / "out"), "--feature-space", SPACE]
    assert "differ by" in output_of(capsys, *arguments, "--crops", "langsplat")
    assert open_encoder(tmp_path / "out").crops == LANGSPLAT
    assert main(arguments) == 0
    assert open_encoder(tmp_path / "out").crops == WITH_CONTEXT
    capsys.readouterr()
    assert "is neither a folder nor a downloaded model" in error_of(capsys, "export", "image", tmp_path / "none")


def test_a_fetched_model_is_found_by_its_name(model_folder, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "hub"))
    model = tmp_path / "hub" / f"models--{SPACE.replace('/', '--')}"
    (model / "snapshots" / ("a" * 40)).mkdir(parents=True)
    (model / "refs").mkdir()
    for main_is in ("", "../../..", "c" * 40):
        (model / "refs" / "main").write_text(main_is)
        assert f"'{SPACE}' is neither a folder nor a downloaded model" in error_of(capsys, "export", "text", SPACE)
    (model / "refs" / "main").write_text("b" * 40 + "\n")
    shutil.copytree(model_folder, model / "snapshots" / ("b" * 40))
    assert main(["export", "text", SPACE]) == 0
    assert encoder_for(SPACE).where == str(tmp_path / "cache" / "tests--tiny-clip")
    assert open_encoder(SPACE).width == OUT, "masks are encoded by the fetched model itself"


def test_a_folder_that_cannot_be_replaced_stays(tmp_path, monkeypatch):
    from og_pointcloud_export.encoders import _write_folder

    folder = tmp_path / "encoder"
    _write_folder(folder, {GRAPH: b"old"}, ENCODER)

    def fail(path, target):
        raise OSError("the disk is gone")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="the disk is gone"):
        _write_folder(folder, {GRAPH: b"new"}, ENCODER)
    assert (folder / GRAPH).read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [folder]
