"""Text encoders: every source gives the vectors of its own library, and no file that is read can do harm."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import subprocess
import sys
import threading
import warnings
import zlib
from dataclasses import replace

import numpy as np
import onnx
import pytest
from labelled_clouds import room, unit_rows
from og_pointcloud_export import write_bundle
from og_pointcloud_export.text_graph import build_text_graph
from onnx import TensorProto, helper, numpy_helper
from text_models import (
    CONTEXT,
    LAYERS,
    MERGES,
    OUT,
    SPACE,
    TEXTS,
    VOCABULARY,
    WIDTH,
    forward_plainly,
    openai_state,
    write_tokenizer,
)

import og_pointcloud as og
from og_pointcloud.bundle.vocabulary import everyday_words
from og_pointcloud.cli import main
from og_pointcloud.cloud import Vocabulary
from og_pointcloud.errors import FeatureSpaceError, OgPointcloudError
from og_pointcloud.formats.npy import npy_bytes
from og_pointcloud.models import check_graph, open_session
from og_pointcloud.text.encoder import (
    OPERATORS,
    TextEncoder,
    cache_folder,
    encoder_for,
    find_encoder,
    read_text_encoder,
)

torch = pytest.importorskip("torch")
safetensors_torch = pytest.importorskip("safetensors.torch")
exporter = pytest.importorskip("og_pointcloud_export.text_encoder")
export_text_encoder, torch_vectors = exporter.export_text_encoder, exporter.torch_vectors
read_text_tower = pytest.importorskip("og_pointcloud_export.text_weights").read_text_tower
torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def no_models_of_this_machine(monkeypatch, tmp_path):
    monkeypatch.delenv("OG_POINTCLOUD_MODELS", raising=False)
    monkeypatch.setattr("og_pointcloud.text.encoder.cache_folder", lambda: tmp_path / "cache")


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """OpenAI's names in a .safetensors, the tokenizer beside it."""
    folder = write_tokenizer(tmp_path_factory.mktemp("weights"))
    safetensors_torch.save_file(openai_state(), folder / "clip.safetensors")
    return folder / "clip.safetensors"


@pytest.fixture(scope="module")
def encoder_folder(source, tmp_path_factory):
    folder = tmp_path_factory.mktemp("encoders") / "tiny"
    export_text_encoder(source, folder, feature_space=SPACE, activation="quick_gelu")
    return folder


@pytest.fixture
def encoder(encoder_folder):
    return TextEncoder({path.name: path.read_bytes() for path in encoder_folder.iterdir()}, str(encoder_folder))


def plain_vectors(encoder, state, **how):
    return np.array([forward_plainly(state, encoder.tokens(text), **how) for text in TEXTS])


# Every source gives the vectors of its own library


def test_onnxruntime_torch_and_numpy_agree(encoder, source):
    plain = plain_vectors(encoder, openai_state())
    tower = read_text_tower(source, "quick_gelu")
    by_torch = np.concatenate([torch_vectors(tower, np.array([encoder.tokens(text)])) for text in TEXTS])
    assert np.abs(encoder.encode(TEXTS) - plain).max() < 1e-5
    assert np.abs(by_torch - plain).max() < 1e-5
    alike = plain @ plain.T - np.eye(len(TEXTS))
    assert alike[:-1, 2:-1].max() < 0.99  # texts differ by far more than that
    assert alike[1, -1] > 1 - 1e-9  # but nothing after an end counts


@pytest.mark.parametrize("kind", ["half", "pt", "checkpoint", "openai"])
def test_state_dicts_as_people_have_them(tmp_path, kind):
    state, path = openai_state(), write_tokenizer(tmp_path) / "clip.pt"
    if kind == "half":
        state = {name: tensor.half() for name, tensor in state.items()}
        path = tmp_path / "clip.safetensors"
        safetensors_torch.save_file(state, path)
    elif kind == "checkpoint":
        torch.save({"epoch": 3, "state_dict": {f"module.{name}": tensor for name, tensor in state.items()}}, path)
    elif kind == "openai":
        torch.save(
            state | {name: torch.tensor(1) for name in ("input_resolution", "context_length", "vocab_size")}, path
        )
    else:
        torch.save(state, path)
    activation = None if kind == "openai" else "quick_gelu"
    folder, manifest = export_text_encoder(path, tmp_path / "out", feature_space=SPACE, activation=activation)
    encoder = read_text_encoder(folder)
    assert np.abs(encoder.encode(TEXTS) - plain_vectors(encoder, state)).max() < 1e-5
    assert manifest["tower"] == {
        "layers": LAYERS, "heads": WIDTH // 64, "activation": "quick_gelu", "causal": True, "pooling": "argmax",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("model", "how"),
    [
        ({"quick_gelu": True}, {"activation": "quick_gelu"}),
        ({}, {"activation": "gelu"}),
        ({"text_cfg": {"heads": 4, "norm_kwargs": {"eps": 1e-3}}}, {"activation": "gelu", "heads": 4, "epsilon": 1e-3}),
        (
            {"text_cfg": {"no_causal_mask": True, "pool_type": "last", "act_kwargs": {"approximate": "tanh"}}},
            {"activation": "gelu_pytorch_tanh", "causal": False, "place": CONTEXT - 1},
        ),
    ],
)
def test_open_clip_folders(tmp_path, model, how):
    state = openai_state()
    config = {"model_cfg": {"embed_dim": OUT, "vision_cfg": {}, "text_cfg": {"width": WIDTH}, **model}}
    write_tokenizer(tmp_path)
    (tmp_path / "open_clip_config.json").write_text(json.dumps(config))
    (tmp_path / "tokenizer_config.json").write_text('{"pad_token": "<|endoftext|>"}')
    named = {name if name == "logit_scale" else f"text.{name}": tensor for name, tensor in state.items()}
    safetensors_torch.save_file(named, tmp_path / "open_clip_model.safetensors")
    encoder = read_text_encoder(export_text_encoder(tmp_path, tmp_path / "out", feature_space=SPACE)[0])
    assert np.abs(encoder.encode(TEXTS) - plain_vectors(encoder, state, **how)).max() < 1e-5
    if not how.get("causal", True):
        assert {len(encoder.tokens(text)) for text in TEXTS} == {CONTEXT}


SMALL = {
    "vocab_size": VOCABULARY, "hidden_size": 32, "intermediate_size": 48, "num_hidden_layers": 2,
    "num_attention_heads": 4, "max_position_embeddings": CONTEXT,
}  # fmt: skip
SMALL_VISION = {"hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2}
SMALL_VISION |= {"image_size": 16, "patch_size": 16}


def transformers_model(kind):
    transformers = pytest.importorskip("transformers")
    text = SMALL | {"projection_dim": OUT, "hidden_act": "quick_gelu"}
    torch.manual_seed(0)
    if kind == "clip text, early eos":
        model = transformers.CLIPTextModelWithProjection(transformers.CLIPTextConfig(**text, eos_token_id=2))
    elif kind == "clip":
        text = text | {"hidden_act": "gelu", "eos_token_id": VOCABULARY - 1}
        config = transformers.CLIPConfig(text_config=text, vision_config=SMALL_VISION, projection_dim=OUT)
        model = transformers.CLIPModel(config)
    else:
        config = {"text_config": SMALL | {"projection_size": OUT}, "vision_config": SMALL_VISION}
        prefix = "Siglip2" if kind == "siglip2" else "Siglip"
        model = getattr(transformers, f"{prefix}Model")(getattr(transformers, f"{prefix}Config")(**config))
    for parameter in model.parameters():  # as they begin, biases are zero and vectors nearly one
        parameter.data = torch.randn_like(parameter) * 0.15
    return model.eval()


@pytest.mark.parametrize("kind", ["clip text, early eos", "clip", "siglip", "siglip2"])
def test_transformers_folders_give_the_vectors_of_transformers(tmp_path, kind):
    model = transformers_model(kind)
    model.save_pretrained(write_tokenizer(tmp_path / "model") if (tmp_path / "model").mkdir() is None else None)
    (tmp_path / "model" / "tokenizer_config.json").write_text('{"pad_token": "<|endoftext|>"}')
    folder, manifest = export_text_encoder(tmp_path / "model", tmp_path / "out", feature_space=SPACE)
    encoder = read_text_encoder(folder)
    for text in TEXTS:
        tokens = encoder.tokens(text)
        padded = torch.tensor([tokens + [VOCABULARY - 1] * (CONTEXT - len(tokens))])
        with torch.no_grad():
            out = model(input_ids=padded) if "text" in kind else model.get_text_features(input_ids=padded)
        vector = out if torch.is_tensor(out) else out.text_embeds if "text" in kind else out.pooler_output
        expected = torch.nn.functional.normalize(vector, dim=1).numpy()
        assert np.abs(encoder.encode([text]) - expected).max() < 1e-5, text
    pooling = {"clip text, early eos": "argmax", "clip": "eos"}.get(kind, "last")
    assert manifest["tower"]["pooling"] == pooling
    assert manifest["parity"]["max_abs_error"] < 1e-5
    assert manifest["pad_id"] == (None if "clip" in kind else VOCABULARY - 1)


def test_the_second_text_configuration_of_early_clips_counts(tmp_path):
    model = transformers_model("clip")
    model.save_pretrained(tmp_path)
    config = json.loads((tmp_path / "config.json").read_text())
    config["text_config_dict"] = {"hidden_act": "quick_gelu"}
    (tmp_path / "config.json").write_text(json.dumps(config))
    assert read_text_tower(tmp_path).activation == "quick_gelu"


def test_where_a_text_ends(source):
    """The highest id is not always the end: the two ways of pooling differ on a token that was added later."""
    tower = read_text_tower(source, "quick_gelu")
    end = VOCABULARY - 3
    tokens = np.array([[5, VOCABULARY - 1, 9, end, end, 7]])
    for pooling, place in (("argmax", 1), ("eos", 3), ("last", 5)):
        ending = replace(tower, pooling=pooling, eos_id=end)
        plain = forward_plainly(openai_state(), tokens[0], place=place)
        by_graph = open_session(build_text_graph(ending)).run(["text"], {"tokens": tokens})[0]
        assert np.abs(np.asarray(by_graph)[0] - plain).max() < 1e-5
        assert np.abs(torch_vectors(ending, tokens)[0] - plain).max() < 1e-5


def test_a_text_does_not_depend_on_those_beside_it(encoder):
    together = encoder.encode(TEXTS)
    for text, vector in zip(TEXTS, together, strict=True):
        session = encoder._open_session()
        tokens = encoder.tokens(text)
        padded = np.array([tokens + [0] * (CONTEXT - len(tokens))])
        assert np.abs(np.asarray(session.run(["text"], {"tokens": padded})[0])[0] - vector).max() < 1e-6


def test_the_manifest_says_how_it_was_made(encoder_folder):
    manifest = json.loads((encoder_folder / "manifest.json").read_text())
    assert manifest["parity"]["texts"] == len(exporter.PARITY_TEXTS)
    assert manifest["parity"]["max_abs_error"] < 1e-5
    assert manifest["parity"]["min_cosine"] > 1 - 1e-6
    assert {key: manifest[key] for key in ("feature_space", "width", "context_length", "templates", "precision")} == {
        "feature_space": SPACE, "width": OUT, "context_length": CONTEXT, "templates": ["{}"], "precision": "fp32",
    }  # fmt: skip
    for name, entry in manifest["files"].items():
        assert hashlib.sha256((encoder_folder / name).read_bytes()).hexdigest() == entry["sha256"]


# What cannot be exported


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda state: state.pop("text_projection"), "lacks 'text_projection'"),
        (lambda state: state.update(text_projection=torch.zeros(3, 3)), "expected \\(128, None\\)"),
        (lambda state: state.update(positional_embedding=torch.full((16, 128), torch.nan)), "not finite"),
        (lambda state: state["ln_final.bias"].mul_(torch.inf), "not finite"),
        (lambda state: state.pop("token_embedding.weight"), "lacks 'token_embedding.weight'"),
        (lambda state: state.update({"token_embedding.weight": torch.randn(900, 128)}), None),
    ],
)
def test_weights_that_are_not_a_text_towers(tmp_path, change, says):
    state = openai_state()
    change(state)
    write_tokenizer(tmp_path)
    safetensors_torch.save_file(state, tmp_path / "clip.safetensors")
    if says is None:  # more tokens than the tokenizer has: extra ones, as models have them
        export_text_encoder(tmp_path / "clip.safetensors", tmp_path / "out", feature_space=SPACE, activation="gelu")
        return
    with pytest.raises(OgPointcloudError, match=says):
        export_text_encoder(tmp_path / "clip.safetensors", tmp_path / "out", feature_space=SPACE, activation="gelu")
    assert not (tmp_path / "out").exists()


class Harmful:
    def __reduce__(self):
        return os.mkdir, ("was_run",)


def test_nothing_is_unpickled(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    torch.save({"token_embedding.weight": Harmful()}, "pickled.pt")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.jit.save(torch.jit.script(torch.nn.Linear(2, 2)), "scripted.pt")
    (tmp_path / "noise.safetensors").write_bytes(b"\xff" * 100)
    (tmp_path / "weights.h5").write_bytes(b"x")
    for name, says in (
        ("pickled.pt", "not a file of weights only"),
        ("scripted.pt", "not a file of weights only"),
        ("noise.safetensors", "not readable as .safetensors"),
        ("weights.h5", "is not read: expected .safetensors"),
        ("missing.pt", "does not exist"),
        (".", "is no model's folder"),
    ):
        with pytest.raises(OgPointcloudError, match=says):
            read_text_tower(tmp_path / name)
    assert not (tmp_path / "was_run").exists()


def test_what_a_source_must_say(source, tmp_path):
    with pytest.raises(OgPointcloudError, match="--activation quick_gelu"):
        read_text_tower(source)
    with pytest.raises(OgPointcloudError, match="pass --feature-space as your scenes name it"):
        export_text_encoder(source, tmp_path / "out", activation="gelu")
    with pytest.raises(OgPointcloudError, match=r"no place for the name; expected \{\}"):
        export_text_encoder(source, tmp_path / "out", activation="gelu", feature_space=SPACE, templates=["a photo"])
    (tmp_path / "merges.txt").write_text("#version: 0.2\na t</w>\n")
    with pytest.raises(OgPointcloudError, match=r"has 1 merges; expected at least 6, .* for the 520 tokens"):
        export_text_encoder(
            source, tmp_path / "out", activation="gelu", feature_space=SPACE, tokenizer=tmp_path / "merges.txt"
        )
    assert not (tmp_path / "out").exists()


def test_merges_alone_make_the_same_tokenizer(source, encoder, tmp_path):
    (tmp_path / "merges.txt").write_text("#version: 0.2\n" + "".join(f"{a} {b}\n" for a, b in [*MERGES, ("x", "y")]))
    folder, _ = export_text_encoder(
        source, tmp_path / "out", activation="gelu", feature_space=SPACE, tokenizer=tmp_path / "merges.txt"
    )
    assert [read_text_encoder(folder).tokens(text) for text in TEXTS] == [encoder.tokens(text) for text in TEXTS]


@pytest.mark.parametrize("setting", [{"hf_model_name": "roberta"}, {"embed_cls": True}, {"pool_type": "first"}])
def test_open_clip_settings_that_are_not_understood(tmp_path, setting):
    (tmp_path / "open_clip_config.json").write_text(json.dumps({"model_cfg": {"text_cfg": setting}}))
    safetensors_torch.save_file(openai_state(), tmp_path / "open_clip_model.safetensors")
    with pytest.raises(OgPointcloudError, match=f"its text_cfg has {next(iter(setting))}"):
        read_text_tower(tmp_path)


def test_a_model_that_transformers_calls_otherwise(tmp_path):
    model = transformers_model("clip")
    model.save_pretrained(tmp_path)
    config = json.loads((tmp_path / "config.json").read_text())
    for change, says in (({"model_type": "blip"}, "model_type is 'blip'"), ({"text_config": 3}, "not in the form")):
        (tmp_path / "config.json").write_text(json.dumps(config | change))
        with pytest.raises(OgPointcloudError, match=says):
            read_text_tower(tmp_path)


def test_a_folder_with_other_things_is_left_alone(source, tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(OgPointcloudError, match="holds other things than an encoder"):
        export_text_encoder(source, tmp_path, feature_space=SPACE, activation="quick_gelu")
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_an_encoder_is_replaced_whole(source, tmp_path):
    for template in ("a {}", "the {}"):
        export_text_encoder(source, tmp_path / "out", feature_space=SPACE, activation="gelu", templates=[template])
        assert read_text_encoder(tmp_path / "out").templates == (template,)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


# int8


def test_int8_is_small_close_and_never_depends_on_what_it_runs_with(source, encoder, tmp_path):
    folder, manifest = export_text_encoder(
        source, tmp_path / "int8", feature_space=SPACE, activation="quick_gelu", int8=True
    )
    small = read_text_encoder(folder)
    cosines = (small.encode(TEXTS) * encoder.encode(TEXTS)).sum(axis=1)
    assert 0.99 < cosines.min() < 0.999999
    assert manifest["parity"]["int8"]["min_cosine"] >= 0.99
    assert manifest["files"]["text_encoder.onnx"]["bytes"] < len(build_text_graph(read_text_tower(source, "gelu"))) / 3
    alike = ["cat low", "low cat", "12", "lowlow", "cat cat"]
    assert len({len(small.tokens(text)) for text in alike}) == 1
    alone = TextEncoder({path.name: path.read_bytes() for path in folder.iterdir()}, "alone")
    together = small.encode(alike)
    assert all((alone.encode([text])[0] == vector).all() for text, vector in zip(alike, together, strict=True))


def test_int8_that_turns_vectors_too_far(source, tmp_path, monkeypatch):
    monkeypatch.setattr(exporter, "INT8_COSINE", 0.9999999)
    with pytest.raises(OgPointcloudError, match=r"int8 turns the vector of .* leave --int8 out"):
        export_text_encoder(source, tmp_path / "out", feature_space=SPACE, activation="quick_gelu", int8=True)
    assert not (tmp_path / "out").exists()


def scene_of(encoder, path, names, descriptors):
    cloud = room(300)
    table = replace(cloud.instances, descriptors=np.asarray(descriptors, np.float32))
    words = Vocabulary(tuple(names), encoder(names)) if names else None
    return write_bundle(replace(cloud, instances=table, feature_space=SPACE, vocabulary=words), path)


def test_int8_must_not_change_what_a_scene_answers(source, encoder, tmp_path):
    names = ["cat", "low", "lower cats"]
    vectors = encoder(names)
    clear = scene_of(encoder, tmp_path / "clear.ogpc", names, vectors[np.arange(9) % 3])
    # An instance as like one word as another: whichever int8 moves more, loses.
    middle = vectors[0] + vectors[1]
    tie = middle / np.linalg.norm(middle)
    small = export_text_encoder(source, tmp_path / "s", feature_space=SPACE, activation="quick_gelu", int8=True)[0]
    moved = read_text_encoder(small)(names) - vectors
    tie = tie - 2e-5 * np.sign((moved[0] - moved[1]) @ tie) * (vectors[0] - vectors[1])
    close = scene_of(encoder, tmp_path / "close.ogpc", names, [tie / np.linalg.norm(tie)] * 9)

    def export(scene):
        return export_text_encoder(
            source, tmp_path / "out", feature_space=SPACE, activation="quick_gelu", int8=True, scene=scene
        )

    with pytest.raises(OgPointcloudError, match=r"int8 changes \d+ of the scene's choices"):
        export(close)
    with pytest.raises(FeatureSpaceError, match="the scene's descriptors are of feature space"):
        export(write_bundle(room(100), tmp_path / "other.ogpc"))
    assert not (tmp_path / "out").exists()
    report = export(clear)[1]["parity"]["int8"]
    assert (report["instances"], report["words"], report["choices_changed"]) == (9, 3, 0)


# The runtime


def test_names_are_put_into_templates_and_averaged(encoder):
    templates = ("a {}", "low {} cat")
    plain = encoder.encode(["a cat", "low cat cat"]).mean(axis=0)
    assert np.abs(encoder(["cat"], templates)[0] - plain / np.linalg.norm(plain)).max() < 1e-6
    assert np.abs(encoder(["{0.__class__}"]) - encoder.encode(["{0.__class__}"])).max() < 1e-6
    assert encoder([]).shape == (0, OUT)


def test_a_text_is_encoded_once(encoder, monkeypatch):
    first = encoder.encode(["cat", "low", "cat"])
    assert (first[0] == first[2]).all()
    monkeypatch.setattr(encoder, "_run", None)
    assert (encoder.encode(["low", "cat"]) == first[[1, 0]]).all()
    monkeypatch.setattr("og_pointcloud.text.encoder.VECTORS_REMEMBERED", 1)
    encoder.encode(["cat"])
    assert list(encoder._remembered) == ["cat"]


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


def altered(folder, out, change=None, **files):
    """A copy with some files replaced, manifest changed, and digests put right."""
    held = {path.name: path.read_bytes() for path in folder.iterdir()} | files
    manifest = json.loads(held["manifest.json"])
    for name in manifest["files"]:
        manifest["files"][name]["crc32"] = zlib.crc32(held[name])
    if change:
        change(manifest)
    held["manifest.json"] = json.dumps(manifest).encode()
    out.mkdir()
    for name, data in held.items():
        (out / name).write_bytes(data)
    return out


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda m: m.update(format="zip"), "format 'zip'; expected 'og-text-encoder'"),
        (lambda m: m.update(schema_version=2), "schema_version is 2"),
        (lambda m: m.update(width=0), "width is 0"),
        (lambda m: m.update(width=True), "width is True"),
        (lambda m: m.update(width=OUT + 1), r"word_bank.npy cannot be used \(it is <f2 .*expected <f2 \(B, 25\)"),
        (lambda m: m.update(context_length=10**12), "context_length is"),
        (lambda m: m.update(context_length="77"), "context_length is '77'"),
        (lambda m: m.update(context_length=5000), None),
        (lambda m: m.update(vocabulary=10), "gives ids up to 519, the encoder has 10"),
        (lambda m: m.update(pad_id=10**6), "pad_id is 1000000"),
        (lambda m: m.update(templates=[]), "no place for the name"),
        (lambda m: m.update(templates=[3]), "no place for the name"),
        (lambda m: m.update(templates="{}"), "expected a list"),
        (lambda m: m.update(precision="fp8"), "precision 'fp8'"),
        (lambda m: m.update(feature_space=None), "feature_space None"),
        (lambda m: m.pop("files"), "'files' is missing"),
        (lambda m: m["files"]["tokenizer.json"].update(crc32=0), "checksum"),
        (lambda m: m.update(files=[]), "not a text encoder"),
    ],
)
def test_manifests_that_do_not_fit(encoder_folder, tmp_path, change, says):
    folder = altered(encoder_folder, tmp_path / "e", change)
    if says is None:  # longer than its positions: short texts do, long ones say so
        assert read_text_encoder(folder).encode(["cat"]).shape == (1, OUT)
        with pytest.raises(OgPointcloudError, match="does not run"):
            read_text_encoder(folder).encode(["cat " * 50])
        return
    with pytest.raises(OgPointcloudError, match=says) as caught:
        read_text_encoder(folder).encode(["cat"])
    assert str(caught.value).startswith(str(folder))


def test_a_graph_of_another_width_than_its_manifest_says(encoder_folder, tmp_path):
    bank = npy_bytes(np.ones((50, OUT + 1), np.float16))
    folder = altered(encoder_folder, tmp_path / "e", lambda m: m.update(width=OUT + 1), **{"word_bank.npy": bank})
    with pytest.raises(OgPointcloudError, match=r"gives float32 \(1, 24\).*make the encoder again"):
        read_text_encoder(folder).encode(["cat"])


def graph_with(data, *nodes, **changes):
    model = onnx.load_from_string(data)
    model.graph.node.extend(nodes)
    for name, value in changes.items():
        getattr(model, name).extend(value)
    return model


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
        (external, "asks for other files"),
        (hidden_constant, "asks for other files"),
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
    folder = altered(encoder_folder, tmp_path / "e", **{"text_encoder.onnx": model.SerializeToString()})
    with pytest.raises(OgPointcloudError, match=says):
        read_text_encoder(folder)


def test_a_graph_inside_a_node_is_refused_whatever_the_operator(encoder_folder):
    model = onnx.load(encoder_folder / "text_encoder.onnx")
    branch(model)
    with pytest.raises(ValueError, match="holds a graph of its own"):
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


def test_files_that_are_damaged_or_too_large(encoder_folder, tmp_path, monkeypatch):
    for number, (name, data) in enumerate(
        [("tokenizer.json", b"{}"), ("text_encoder.onnx", b""), ("manifest.json", b"[")]
    ):
        folder = tmp_path / str(number)
        folder.mkdir()
        for path in encoder_folder.iterdir():
            (folder / path.name).write_bytes(data if path.name == name else path.read_bytes())
        with pytest.raises(OgPointcloudError, match="make the encoder again"):
            read_text_encoder(folder)
        (folder / name).unlink()
        with pytest.raises(OgPointcloudError, match=f"{name}"):
            read_text_encoder(folder)
    monkeypatch.setitem(read_text_encoder.__globals__["ENCODER_FILES"], "tokenizer.json", 10)
    with pytest.raises(OgPointcloudError, match="more than 10 bytes"):
        read_text_encoder(altered(encoder_folder, tmp_path / "large"))


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
    with pytest.raises(OgPointcloudError, match=r"export-text-encoder laion/CLIP-ViT-B-16$"):
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
    with pytest.raises(OgPointcloudError, match=r"'lower' is not among the 2 known words.*export-text-encoder"):
        og.segment(scene, ["cat", "lower"])
    monkeypatch.setenv("OG_POINTCLOUD_MODELS", str(encoder_folder))
    result = og.segment(scene, ["cat", "lower"])
    expected = og.segment(scene, {"cat": encoder(["cat"])[0], "lower": encoder(["lower"])[0]})
    assert (result.labels == expected.labels).all()
    assert set(result.labels[result.labels >= 0]) == {0, 1}


def test_a_damaged_encoder_is_not_passed_over(encoder, encoder_folder, tmp_path, monkeypatch):
    path = scene_of(encoder, tmp_path / "s.ogpc", ["cat"], unit_rows(9, OUT))
    folder = altered(encoder_folder, tmp_path / "e")
    (folder / "text_encoder.onnx").write_bytes(b"torn")
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


# The command


def test_the_command_writes_an_encoder_and_says_how_it_is_found(source, tmp_path, capsys):
    arguments = ["export-text-encoder", str(source), "--feature-space", SPACE, "--activation", "quick_gelu"]
    assert main([*arguments, "-o", str(tmp_path / "out"), "--template", "a {}", "--int8"]) == 0
    printed = capsys.readouterr().out
    assert "onnxruntime and torch differ by" in printed
    assert "int8 and float32: cosine 0.99" in printed
    assert f"export OG_POINTCLOUD_MODELS='{tmp_path / 'out'}'" in printed
    made = read_text_encoder(tmp_path / "out")
    assert made.templates == ("a {}",)
    words = everyday_words()[:30]
    assert np.abs(made.word_bank.vectors[:30] - made.encode([f"a {word}" for word in words])).max() < 1e-3
    assert main([*arguments, "-o", str(tmp_path / "out"), "--tokenizer", "nowhere.json"]) == 2
    assert "error: nowhere.json is not a file" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main([*arguments, "--scene", "s.ogpc"])


def test_a_fetched_model_is_found_by_its_name(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "hub"))
    model = tmp_path / "hub" / f"models--{SPACE.replace('/', '--')}"
    for revision in ("a" * 40, "b" * 40):
        (model / "snapshots" / revision).mkdir(parents=True)
    (model / "refs").mkdir()
    arguments = ["-o", str(tmp_path / "out")]
    for main_is in ("", "../../..", "c" * 40):
        (model / "refs" / "main").write_text(main_is)
        assert main(["export-text-encoder", SPACE, *arguments]) == 2
        assert f"'{SPACE}' is no folder, no file and no model that was fetched" in capsys.readouterr().err
    (model / "refs" / "main").write_text("b" * 40 + "\n")
    transformers_model("clip").save_pretrained(write_tokenizer(model / "snapshots" / ("b" * 40)))
    assert main(["export-text-encoder", SPACE, *arguments]) == 0
    assert read_text_encoder(tmp_path / "out").feature_space == SPACE


def test_without_an_output_it_lands_where_it_is_found(source, tmp_path, monkeypatch):
    monkeypatch.setattr(exporter, "cache_folder", lambda: tmp_path / "cache")
    folder, _ = export_text_encoder(source, feature_space=SPACE, activation="quick_gelu")
    assert folder == tmp_path / "cache" / "tests--tiny-clip"
    assert encoder_for(SPACE).where == str(folder)
