"""Small random text towers in the formats that people have, and CLIP's forward pass written plainly in numpy."""

from __future__ import annotations

import json
from math import erf
from typing import TYPE_CHECKING

import numpy as np
from og_pointcloud_export.text_tokenizer import clip_description

if TYPE_CHECKING:
    import torch

WIDTH, LAYERS, CONTEXT, OUT = 128, 2, 16, 24
MERGES = [("a", "t</w>"), ("c", "at</w>"), ("l", "o"), ("lo", "w</w>"), ("lo", "w"), ("e", "r</w>")]
VOCABULARY = 512 + len(MERGES) + 2
TEXTS = ["", "cat", "low lower cat", "it's 12 cats!", "café \U0001f44d", "cat " * 50, "cat<|endoftext|>low"]
SPACE = "tests/tiny-clip"


def openai_state(seed: int = 0, width: int = WIDTH) -> dict[str, torch.Tensor]:
    """Random weights under OpenAI's names, large enough that every part of the tower matters."""
    import torch

    random = torch.Generator().manual_seed(seed)

    def normal(*shape: int, scale: float = 0.1, shift: float = 0.0) -> torch.Tensor:
        return torch.randn(*shape, generator=random) * scale + shift

    state = {
        "token_embedding.weight": normal(VOCABULARY, width, scale=0.5),
        "positional_embedding": normal(CONTEXT, width, scale=0.5),
        "ln_final.weight": normal(width, shift=1.0),
        "ln_final.bias": normal(width),
        "text_projection": normal(width, OUT),
        "logit_scale": torch.tensor(4.6),
        "visual.proj": normal(3, 5),
    }
    for layer in range(LAYERS):
        name = f"transformer.resblocks.{layer}"
        state |= {
            f"{name}.attn.in_proj_weight": normal(3 * width, width, scale=0.15),
            f"{name}.attn.in_proj_bias": normal(3 * width),
            f"{name}.attn.out_proj.weight": normal(width, width),
            f"{name}.attn.out_proj.bias": normal(width),
            f"{name}.ln_1.weight": normal(width, shift=1.0),
            f"{name}.ln_1.bias": normal(width),
            f"{name}.ln_2.weight": normal(width, shift=1.0),
            f"{name}.ln_2.bias": normal(width),
            f"{name}.mlp.c_fc.weight": normal(4 * width, width),
            f"{name}.mlp.c_fc.bias": normal(4 * width),
            f"{name}.mlp.c_proj.weight": normal(width, 4 * width),
            f"{name}.mlp.c_proj.bias": normal(width),
        }
    return state


def write_tokenizer(folder, **changes):
    (folder / "tokenizer.json").write_text(json.dumps({**clip_description(MERGES), **changes}))
    return folder


GELU = {
    "quick_gelu": lambda x: x / (1 + np.exp(-1.702 * x)),
    "gelu": lambda x: x * (1 + np.vectorize(erf)(x / np.sqrt(2))) / 2,
    "gelu_pytorch_tanh": lambda x: x * (1 + np.tanh(np.sqrt(2 / np.pi) * (x + 0.044715 * x**3))) / 2,
}


def forward_plainly(state, tokens, heads=WIDTH // 64, activation="quick_gelu", causal=True, place=None, epsilon=1e-5):
    """(D,) float64, unit length: one text through the tower, one head at a time. place: None for the highest id's."""
    get = {name: value.double().numpy() for name, value in state.items()}

    def norm(x, name):
        centred = x - x.mean(axis=1, keepdims=True)
        scale = np.sqrt((centred**2).mean(axis=1, keepdims=True) + epsilon)
        return centred / scale * get[f"{name}.weight"] + get[f"{name}.bias"]

    def linear(x, weight, bias):
        return x @ get[weight].T + get[bias]

    x = get["token_embedding.weight"][tokens] + get["positional_embedding"][: len(tokens)]
    for layer in range(LAYERS):
        name = f"transformer.resblocks.{layer}"
        qkv = linear(norm(x, f"{name}.ln_1"), f"{name}.attn.in_proj_weight", f"{name}.attn.in_proj_bias")
        q, k, v = np.split(qkv, 3, axis=1)
        width = x.shape[1] // heads
        mixed = []
        for head in range(heads):
            own = slice(head * width, (head + 1) * width)
            logits = q[:, own] @ k[:, own].T / np.sqrt(width)
            if causal:
                logits[np.triu_indices(len(tokens), 1)] = -np.inf
            weights = np.exp(logits - logits.max(axis=1, keepdims=True))
            mixed.append(weights / weights.sum(axis=1, keepdims=True) @ v[:, own])
        x = x + linear(np.hstack(mixed), f"{name}.attn.out_proj.weight", f"{name}.attn.out_proj.bias")
        hidden = GELU[activation](linear(norm(x, f"{name}.ln_2"), f"{name}.mlp.c_fc.weight", f"{name}.mlp.c_fc.bias"))
        x = x + linear(hidden, f"{name}.mlp.c_proj.weight", f"{name}.mlp.c_proj.bias")
    x = norm(x, "ln_final")[int(np.argmax(tokens)) if place is None else place]
    vector = x @ get["text_projection"]
    return vector / np.linalg.norm(vector)
