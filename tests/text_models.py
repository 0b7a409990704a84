"""Small models: CLIP and SigLIP of transformers with random weights, and a text encoder made without torch."""

from __future__ import annotations

import json
import zlib

import numpy as np
from labelled_clouds import unit_rows
from onnx import TensorProto, helper, numpy_helper

from og_pointcloud.formats.npy import npy_bytes
from og_pointcloud.text.text_features import everyday_words
from og_pointcloud.text.tokenizer import BYTE_CHARACTERS, CLIP_NORMALIZER, CLIP_WORDS

MERGES = [("a", "t</w>"), ("c", "at</w>"), ("l", "o"), ("lo", "w</w>"), ("lo", "w"), ("e", "r</w>")]
VOCABULARY, CONTEXT, OUT = 512 + len(MERGES) + 2, 16, 24
START, END = VOCABULARY - 2, VOCABULARY - 1
SIZE, PATCH = 32, 8
TEXTS = ["", "cat", "low lower cat", "it's 12 cats!", "café \U0001f44d", "cat " * 50, "cat<|endoftext|>low"]
SPACE = "tests/tiny-clip"
KINDS = ("clip", "clip of early days", "siglip")


def clip_tokenizer(merges):
    """A tokenizer.json as CLIP's repositories have it, with other merges."""
    letters = sorted(BYTE_CHARACTERS, key=lambda character: (ord(character) >= 256, ord(character)))
    joined = ["".join(merge) for merge in merges]
    tokens = [*letters, *(f"{letter}</w>" for letter in letters), *joined, "<|startoftext|>", "<|endoftext|>"]
    ids = {token: id for id, token in enumerate(tokens)}
    start, end = ([token, ids[token]] for token in tokens[-2:])
    split = {"type": "Split", "pattern": {"Regex": CLIP_WORDS}, "behavior": "Removed", "invert": True}
    bytes_ = {"type": "ByteLevel", "add_prefix_space": False, "trim_offsets": True, "use_regex": True}
    flags = {"single_word": False, "lstrip": False, "rstrip": False, "normalized": False, "special": True}
    return {
        "version": "1.0", "truncation": None, "padding": None, "decoder": None,
        "added_tokens": [{"id": id, "content": token, **flags} for token, id in (start, end)],
        "normalizer": CLIP_NORMALIZER,
        "pre_tokenizer": {"type": "Sequence", "pretokenizers": [split, bytes_]},
        "model": {"type": "BPE", "unk_token": end[0], "end_of_word_suffix": "</w>", "vocab": ids,
                  "merges": [" ".join(merge) for merge in merges]},
        "post_processor": {"type": "RobertaProcessing", "sep": end, "cls": start, "trim_offsets": False,
                           "add_prefix_space": False},
    }  # fmt: skip


def encoder_files(feature_space=SPACE, width=OUT, tokenizer=None, seed=5):
    """The files of a text encoder that gives each text the vector of its second token: of a word, its first."""
    nodes = [
        helper.make_node("Gather", ["rows", "tokens"], ["all"], axis=0),
        helper.make_node("Gather", ["all", "second"], ["text"], axis=1),
    ]
    tokens = helper.make_tensor_value_info("tokens", TensorProto.INT64, ["batch", "length"])
    text = helper.make_tensor_value_info("text", TensorProto.FLOAT, ["batch", width])
    rows = unit_rows(VOCABULARY, width, seed)
    constants = [numpy_helper.from_array(rows, "rows"), numpy_helper.from_array(np.array(1, np.int64), "second")]
    graph = helper.make_graph(nodes, "encoder", [tokens], [text], constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    held = {
        "text_encoder.onnx": model.SerializeToString(),
        "tokenizer.json": json.dumps(tokenizer or clip_tokenizer(MERGES)).encode(),
        "word_bank.npy": npy_bytes(unit_rows(len(everyday_words()), width, seed=6).astype(np.float16)),
    }
    manifest = {
        "format": "og-text-encoder", "schema_version": 1, "feature_space": feature_space, "width": width,
        "context_length": CONTEXT, "vocabulary": VOCABULARY, "pad_id": None, "templates": ["{}"], "precision": "fp32",
        "files": {name: {"bytes": len(data), "crc32": zlib.crc32(data)} for name, data in held.items()},
    }  # fmt: skip
    return {"manifest.json": json.dumps(manifest).encode(), **held}


def write_files(folder, files):
    folder.mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        (folder / name).write_bytes(data)
    return folder


def transformers_model(kind):
    """One of KINDS, in which every part of both halves matters."""
    import torch
    import transformers

    text = {"vocab_size": VOCABULARY, "hidden_size": 32, "intermediate_size": 48, "num_hidden_layers": 2,
            "num_attention_heads": 4, "max_position_embeddings": CONTEXT, "bos_token_id": START,
            "pad_token_id": END}  # fmt: skip
    vision = {"hidden_size": 32, "intermediate_size": 48, "num_hidden_layers": 2, "num_attention_heads": 4,
              "image_size": SIZE, "patch_size": PATCH}  # fmt: skip
    if kind.startswith("clip"):
        # The first configurations had eos_token_id 2 for what is the highest id.
        early = {"eos_token_id": 2, "hidden_act": "quick_gelu"}
        text |= early if "early" in kind else {"eos_token_id": END, "hidden_act": "gelu"}
        config = transformers.CLIPConfig(text_config=text, vision_config=vision, projection_dim=OUT)
        model = transformers.CLIPModel(config)
    else:
        text |= {"projection_size": 32, "eos_token_id": END}
        model = transformers.SiglipModel(transformers.SiglipConfig(text_config=text, vision_config=vision))
    torch.manual_seed(0)
    with torch.no_grad():
        for weight in model.parameters():  # as they begin, biases are zero and vectors nearly one
            weight.copy_(torch.randn_like(weight) * 0.15)
    return model.eval()


def write_model(folder, kind="clip"):
    """A model's folder with its tokenizer."""
    transformers_model(kind).save_pretrained(folder)
    (folder / "tokenizer.json").write_text(json.dumps(clip_tokenizer(MERGES)))
    (folder / "tokenizer_config.json").write_text('{"pad_token": "<|endoftext|>"}')
    return folder


def text_vectors(model, tokens):
    """(1, D) unit rows as transformers has them."""
    import torch

    with torch.no_grad():
        vectors = model.get_text_features(input_ids=torch.tensor([tokens])).pooler_output
    return torch.nn.functional.normalize(vectors, dim=-1).numpy()


def image_vectors(model, pixels):
    """(B, D) unit rows as transformers has them."""
    import torch

    with torch.no_grad():
        vectors = model.get_image_features(pixel_values=torch.from_numpy(pixels)).pooler_output
    return torch.nn.functional.normalize(vectors, dim=-1).numpy()
