"""Small random image towers in the formats that people have, and a vision transformer written plainly in numpy."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from text_models import GELU

WIDTH, LAYERS, PATCH, SIZE, OUT = 64, 2, 8, 32, 16
SPACE = "tests/tiny-vit"
CLIP_TEXT = {"hidden_size": 32, "intermediate_size": 32, "num_hidden_layers": 1, "num_attention_heads": 2,
             "vocab_size": 64, "bos_token_id": 1, "eos_token_id": 2}  # fmt: skip
VISION = {"hidden_size": WIDTH, "intermediate_size": 128, "num_hidden_layers": LAYERS, "num_attention_heads": 4,
          "image_size": SIZE, "patch_size": PATCH}  # fmt: skip


def shaken(model):
    """Weights large enough that every part of the tower matters."""
    import torch

    torch.manual_seed(0)
    with torch.no_grad():
        for weight in model.parameters():
            weight.add_(torch.randn_like(weight) * 0.1)
    return model.eval()


def transformers_model(family):
    """A CLIP, SigLIP or SigLIP 2 (flexible shapes) of transformers itself."""
    import transformers

    if family == "clip":
        config = transformers.CLIPConfig(vision_config=VISION, text_config=CLIP_TEXT, projection_dim=OUT)
        return shaken(transformers.CLIPModel(config))
    text = {**CLIP_TEXT, "hidden_size": WIDTH, "projection_size": WIDTH, "pad_token_id": 1}
    if family == "siglip":
        return shaken(transformers.SiglipModel(transformers.SiglipConfig(vision_config=VISION, text_config=text)))
    vision = {name: value for name, value in VISION.items() if name != "image_size"}
    config = transformers.Siglip2Config(vision_config={**vision, "num_patches": (SIZE // PATCH) ** 2}, text_config=text)
    return shaken(transformers.Siglip2Model(config))


def transformers_vectors(model, pixels):
    """(B, D) unit rows as transformers has them."""
    import torch

    images = torch.from_numpy(pixels)
    given = {"pixel_values": images}
    if type(model).__name__ == "Siglip2Model":
        side = SIZE // PATCH
        cut = images.unfold(2, PATCH, PATCH).unfold(3, PATCH, PATCH).permute(0, 2, 3, 4, 5, 1)
        given["pixel_values"] = cut.reshape(len(pixels), side * side, PATCH * PATCH * 3)
        given["pixel_attention_mask"] = torch.ones(len(pixels), side * side, dtype=torch.long)
        given["spatial_shapes"] = torch.tensor([[side, side]] * len(pixels))
    with torch.no_grad():
        vectors = model.get_image_features(**given)
    vectors = vectors if torch.is_tensor(vectors) else vectors.pooler_output
    return torch.nn.functional.normalize(vectors, dim=-1).numpy()


def open_clip_state(seed=0):
    """Random weights of an image tower under OpenAI's and OpenCLIP's names."""
    import torch

    random = torch.Generator().manual_seed(seed)

    def normal(*shape, scale=0.1, shift=0.0):
        return torch.randn(*shape, generator=random) * scale + shift

    state = {
        "visual.class_embedding": normal(WIDTH),
        "visual.positional_embedding": normal((SIZE // PATCH) ** 2 + 1, WIDTH),
        "visual.conv1.weight": normal(WIDTH, 3, PATCH, PATCH),
        "visual.proj": normal(WIDTH, OUT),
    }
    for norm in ("ln_pre", "ln_post", *(f"transformer.resblocks.{n}.ln_{k}" for n in range(LAYERS) for k in (1, 2))):
        state |= {f"visual.{norm}.weight": normal(WIDTH, shift=1.0), f"visual.{norm}.bias": normal(WIDTH)}
    shapes = {"attn.in_proj_": (3 * WIDTH, WIDTH), "attn.out_proj.": (WIDTH, WIDTH), "mlp.c_fc.": (128, WIDTH),
              "mlp.c_proj.": (WIDTH, 128)}  # fmt: skip
    for layer in range(LAYERS):
        for name, shape in shapes.items():
            stem = f"visual.transformer.resblocks.{layer}.{name}"
            state |= {f"{stem}weight": normal(*shape, scale=0.15), f"{stem}bias": normal(shape[0])}
    return state


def write_open_clip(folder: Path, quick_gelu=False, **vision):
    from safetensors.torch import save_file

    folder.mkdir(exist_ok=True)
    save_file(open_clip_state(), folder / "open_clip_model.safetensors")
    model = {"embed_dim": OUT, "vision_cfg": {"image_size": SIZE, "patch_size": PATCH, "head_width": 16, **vision}}
    config = {
        "model_cfg": {**model, "quick_gelu": quick_gelu},
        "preprocess_cfg": {"mean": [0.5] * 3, "std": [0.25] * 3},
    }
    (folder / "open_clip_config.json").write_text(json.dumps(config))
    return folder


def forward_plainly(state, pixels, heads=WIDTH // 16, activation="gelu"):
    """(D,) float64, unit length: one image (3, S, S) through the tower, one patch and one head at a time."""
    get = {name.removeprefix("visual."): value.double().numpy() for name, value in state.items()}

    def norm(x, name):
        centred = x - x.mean(axis=-1, keepdims=True)
        scale = np.sqrt((centred**2).mean(axis=-1, keepdims=True) + 1e-5)
        return centred / scale * get[f"{name}.weight"] + get[f"{name}.bias"]

    rows = [get["class_embedding"]]
    for top in range(0, SIZE, PATCH):
        for left in range(0, SIZE, PATCH):
            patch = pixels[:, top : top + PATCH, left : left + PATCH]
            rows.append((get["conv1.weight"] * patch).sum(axis=(1, 2, 3)))
    x = norm(np.array(rows) + get["positional_embedding"], "ln_pre")
    for layer in range(LAYERS):
        name = f"transformer.resblocks.{layer}"
        qkv = norm(x, f"{name}.ln_1") @ get[f"{name}.attn.in_proj_weight"].T + get[f"{name}.attn.in_proj_bias"]
        mixed = []
        for head in range(heads):
            q, k, v = (part[:, head * 16 : head * 16 + 16] for part in np.split(qkv, 3, axis=1))
            weights = np.exp(q @ k.T / 4)
            mixed.append(weights / weights.sum(axis=1, keepdims=True) @ v)
        x = x + np.hstack(mixed) @ get[f"{name}.attn.out_proj.weight"].T + get[f"{name}.attn.out_proj.bias"]
        hidden = norm(x, f"{name}.ln_2") @ get[f"{name}.mlp.c_fc.weight"].T + get[f"{name}.mlp.c_fc.bias"]
        x = x + GELU[activation](hidden) @ get[f"{name}.mlp.c_proj.weight"].T + get[f"{name}.mlp.c_proj.bias"]
    vector = norm(x[0], "ln_post") @ get["proj"]
    return vector / np.linalg.norm(vector)
