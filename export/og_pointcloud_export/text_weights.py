"""A CLIP or SigLIP text tower, read from the files that people have: transformers folders, OpenCLIP's, OpenAI's.

Weights come from ``.safetensors``, or from ``.pt`` / ``.bin`` files that hold weights only: nothing is unpickled that
could run. Vision towers are left where they lie: see image_weights.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias, cast, get_args

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import MissingExtraError, OgPointcloudError
from og_pointcloud_export.text_tokenizer import read_json

try:
    import torch
except ImportError as error:
    raise MissingExtraError("torch", "export-text") from error

__all__ = [
    "Activation", "Affine", "Block", "TextTower", "Weights", "find_weights", "named_activation", "open_clip_activation",
    "open_clip_block", "own_settings", "read_text_tower", "transformers_block", "whole_number",
]  # fmt: skip

Activation = Literal["quick_gelu", "gelu", "gelu_pytorch_tanh"]
Pooling = Literal["argmax", "eos", "last"]
Array: TypeAlias = "NDArray[np.float32]"

HEAD_WIDTH = 64
"""Of every CLIP text tower; state dicts do not say how many heads there are."""
EARLY_EOS = 2
"""transformers' CLIP configurations were long written with this eos_token_id, which is wrong: its model then takes the
highest id of a text, which is CLIP's real end of text. Read as an id, it would pool a token that texts do not have."""
CLIP_EOS = 49407
TOWER_WEIGHTS = ("model.safetensors", "pytorch_model.bin")
OPEN_CLIP_WEIGHTS = ("open_clip_model.safetensors", "open_clip_pytorch_model.bin", "open_clip_pytorch_model.pt")
OPEN_CLIP_CONFIG = "open_clip_config.json"
OPENAI_MARKS = {"input_resolution", "context_length", "vocab_size"}
"""Three numbers that only OpenAI's own state dicts hold."""


@dataclass(frozen=True)
class Affine:
    """x @ weight + bias, or a layer norm's gain and offset. weight: (in, out) or (width,); bias: None for none."""

    weight: Array
    bias: Array | None


@dataclass(frozen=True)
class Block:
    """x += attend_out(attention(attend_in(norm_1(x)))), then x += contract(activation(expand(norm_2(x)))).

    attend_in: (W, 3 W), queries, keys and values side by side.
    """

    norm_1: Affine
    attend_in: Affine
    attend_out: Affine
    norm_2: Affine
    expand: Affine
    contract: Affine


@dataclass(frozen=True)
class TextTower:
    """All that turns token ids into a text vector, float32.

    token_embedding: (V, W); position_embedding: (C, W), C the context length. projection: (W, D).
    causal: each token sees those before it only. pooling: the token whose vector is the text's: "argmax" of the ids,
    the first that is eos_id, or the last of the context.
    """

    token_embedding: Array
    position_embedding: Array
    blocks: tuple[Block, ...]
    final_norm: Affine
    projection: Affine
    heads: int
    activation: Activation
    epsilon: float
    causal: bool
    pooling: Pooling
    eos_id: int

    @property
    def width(self) -> int:
        """Of the text vectors."""
        return self.projection.weight.shape[1]


def read_text_tower(source: Path, activation: Activation | None = None) -> TextTower:
    """The text tower of a transformers or OpenCLIP folder, or of a file of weights with OpenAI's names.

    activation: of a file that does not say; OpenCLIP's own models use "gelu", those after OpenAI's "quick_gelu".
    OgPointcloudError where the source is none of these, or holds what is not understood.
    """
    files, config = find_weights(source)
    weights = Weights.read(files)
    try:
        if "text_model.embeddings.token_embedding.weight" in weights.names:
            tower = _from_transformers(weights, config)
        else:
            tower = _from_open_clip(weights, config, activation)
    except (KeyError, TypeError, AttributeError) as error:
        raise OgPointcloudError(
            f"{source}: its configuration is not in the form of a CLIP or SigLIP ({type(error).__name__}: {error})"
        ) from None
    if tower.token_embedding.shape[1] % tower.heads:
        raise OgPointcloudError(
            f"{source}: width {tower.token_embedding.shape[1]} does not part in {tower.heads} heads"
        )
    return tower


def find_weights(source: Path) -> tuple[list[Path], dict[str, Any]]:
    """The files of weights, and the configuration beside them ({} if there is none)."""
    if source.is_file():
        beside = source.with_name(OPEN_CLIP_CONFIG)
        return [source], read_json(beside) if beside.is_file() else {}
    if not source.is_dir():
        raise OgPointcloudError(f"{source} does not exist; expected a model's folder, or its .safetensors or .pt file")
    index = source / "model.safetensors.index.json"
    for config, names in (("config.json", TOWER_WEIGHTS), (OPEN_CLIP_CONFIG, OPEN_CLIP_WEIGHTS)):
        found = [source / name for name in names if (source / name).is_file()][:1]
        if config == "config.json" and index.is_file():
            shards = {Path(name).name for name in read_json(index).get("weight_map", {}).values()}
            found = [source / name for name in sorted(shards)]
        if found and (source / config).is_file():
            return found, read_json(source / config)
    raise OgPointcloudError(
        f"{source} is no model's folder; expected config.json with {' or '.join(TOWER_WEIGHTS)} (transformers), or "
        f"{OPEN_CLIP_CONFIG} with {' or '.join(OPEN_CLIP_WEIGHTS[:2])} (OpenCLIP); or name a file of weights"
    )


@dataclass(frozen=True)
class Weights:
    """Tensors by name, fetched when asked for."""

    where: str
    names: frozenset[str]
    fetch: Callable[[str], torch.Tensor]

    @classmethod
    def read(cls, files: list[Path]) -> Weights:
        """Open .safetensors, or load one .pt or .bin that holds weights only."""
        if all(path.suffix == ".safetensors" for path in files):
            return cls(str(files[0]), *_open_safetensors(files))
        if len(files) == 1 and files[0].suffix in (".pt", ".pth", ".bin"):
            tensors = _load_weights_only(files[0])
            return cls(str(files[0]), frozenset(tensors), tensors.__getitem__)
        raise OgPointcloudError(f"{files[0]} is not read: expected .safetensors, or a .pt or .bin with weights only")

    def array(self, name: str, *shape: int | None) -> Array:
        """The tensor as float32; OgPointcloudError unless it is there, finite and of this shape (None: any length)."""
        if name not in self.names:
            raise OgPointcloudError(f"{self.where} lacks '{name}'; expected the weights of a CLIP or SigLIP tower")
        tensor = self.fetch(name)
        fits = tensor.ndim == len(shape) and all(
            want in (None, have) for want, have in zip(shape, tensor.shape, strict=True)
        )
        if not fits or not tensor.is_floating_point() or not bool(torch.isfinite(tensor).all()):
            raise OgPointcloudError(
                f"{self.where}: '{name}' is {tensor.dtype} {tuple(tensor.shape)} or not finite; expected {shape}"
            )
        return tensor.to(torch.float32).contiguous().numpy()

    def affine(self, name: str, inputs: int, outputs: int | None, *, bias: bool = True) -> Affine:
        """A torch Linear, whose weight is stored as (out, in)."""
        weight = self.array(f"{name}.weight", outputs, inputs).T
        return Affine(np.ascontiguousarray(weight), self.array(f"{name}.bias", weight.shape[1]) if bias else None)

    def norm(self, name: str, width: int) -> Affine:
        """A torch LayerNorm."""
        return Affine(self.array(f"{name}.weight", width), self.array(f"{name}.bias", width))

    def count_layers(self, prefix: str) -> int:
        """How many numbers stand behind a prefix."""
        numbers = {name.removeprefix(prefix).split(".")[0] for name in self.names if name.startswith(prefix)}
        return len(numbers)


def _open_safetensors(files: list[Path]) -> tuple[frozenset[str], Callable[[str], torch.Tensor]]:
    try:
        from safetensors import SafetensorError, safe_open
    except ImportError as error:
        raise MissingExtraError("safetensors", "export-text") from error
    homes = {}
    try:
        for path in files:
            file = safe_open(path, framework="pt")
            homes |= dict.fromkeys(file.keys(), file)
    except (SafetensorError, OSError) as error:
        raise OgPointcloudError(f"{files[0].parent}: not readable as .safetensors ({error}): fetch it again") from None
    return frozenset(homes), lambda name: homes[name].get_tensor(name)


def _load_weights_only(path: Path) -> dict[str, torch.Tensor]:
    try:
        with warnings.catch_warnings():  # of TorchScript, which then raises
            warnings.simplefilter("ignore")
            loaded = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises a dozen kinds
        raise OgPointcloudError(
            f"{path} is not a file of weights only ({(str(error).splitlines() or ['?'])[0]:.120}); what is more could "
            "run code and is not opened: save the state dict of a model that you trust as .safetensors"
        ) from None
    if isinstance(loaded, Mapping) and isinstance(loaded.get("state_dict"), Mapping):
        loaded = loaded["state_dict"]
    if not isinstance(loaded, Mapping):
        raise OgPointcloudError(f"{path} holds a {type(loaded).__name__}; expected a state dict: names with tensors")
    tensors = {str(name): value for name, value in loaded.items() if isinstance(value, torch.Tensor)}
    return {name.removeprefix("module."): value for name, value in tensors.items()}


def _from_transformers(weights: Weights, config: dict[str, Any]) -> TextTower:
    family = str(config.get("model_type")).removesuffix("_text_model")
    if family not in ("clip", "siglip", "siglip2"):
        raise OgPointcloudError(
            f"{weights.where}: model_type is {config.get('model_type')!r:.40}; expected clip, siglip or siglip2"
        )
    text = own_settings(config, family, "text")
    is_clip = family == "clip"
    tokens = weights.array("text_model.embeddings.token_embedding.weight", None, None)
    width = tokens.shape[1]
    eos = text.get("eos_token_id", CLIP_EOS)
    if is_clip and "text_projection.weight" not in weights.names:
        raise OgPointcloudError(
            f"{weights.where} has no 'text_projection.weight', so its vectors cannot be compared with images': export "
            "the whole CLIPModel, or CLIPTextModelWithProjection"
        )
    layers = weights.count_layers("text_model.encoder.layers.")
    return TextTower(
        token_embedding=tokens,
        position_embedding=weights.array("text_model.embeddings.position_embedding.weight", None, width),
        blocks=tuple(
            transformers_block(weights, f"text_model.encoder.layers.{layer}", width) for layer in range(layers)
        ),
        final_norm=weights.norm("text_model.final_layer_norm", width),
        projection=weights.affine("text_projection", width, None, bias=False)
        if is_clip
        else weights.affine("text_model.head", width, None),
        heads=whole_number(weights, "num_attention_heads", text.get("num_attention_heads", 8 if is_clip else 12)),
        activation=named_activation(weights, text.get("hidden_act", "quick_gelu" if is_clip else "gelu_pytorch_tanh")),
        epsilon=float(text.get("layer_norm_eps", 1e-5 if is_clip else 1e-6)),
        causal=is_clip,
        pooling=("argmax" if eos == EARLY_EOS else "eos") if is_clip else "last",
        eos_id=whole_number(weights, "eos_token_id", eos) if is_clip else 0,
    )


def own_settings(config: dict[str, Any], family: str, tower: str) -> dict[str, Any]:
    """One tower's part of a transformers configuration, "text" or "vision": all of it where it is the tower's alone."""
    if family != config["model_type"]:
        return config
    # CLIP's early configurations hold a tower's twice; their own class believes the second.
    return {**config[f"{tower}_config"], **(config.get(f"{tower}_config_dict") or {})}


def transformers_block(weights: Weights, name: str, width: int) -> Block:
    """A block of a transformers CLIP or SigLIP tower, text or vision."""
    parts = [weights.affine(f"{name}.self_attn.{part}_proj", width, width) for part in "qkv"]
    expand = weights.affine(f"{name}.mlp.fc1", width, None)
    return Block(
        norm_1=weights.norm(f"{name}.layer_norm1", width),
        attend_in=Affine(
            np.concatenate([part.weight for part in parts], axis=1),
            np.concatenate([cast("Array", part.bias) for part in parts]),
        ),
        attend_out=weights.affine(f"{name}.self_attn.out_proj", width, width),
        norm_2=weights.norm(f"{name}.layer_norm2", width),
        expand=expand,
        contract=weights.affine(f"{name}.mlp.fc2", expand.weight.shape[1], width),
    )


def _from_open_clip(weights: Weights, config: dict[str, Any], activation: Activation | None) -> TextTower:
    prefix = "text." if "text.token_embedding.weight" in weights.names else ""
    tokens = weights.array(f"{prefix}token_embedding.weight", None, None)
    width = tokens.shape[1]
    model = config.get("model_cfg", {})
    text = _known_settings(weights, model.get("text_cfg", {}))
    is_linear = f"{prefix}text_projection.weight" in weights.names
    layers = weights.count_layers(f"{prefix}transformer.resblocks.")
    return TextTower(
        token_embedding=tokens,
        position_embedding=weights.array(f"{prefix}positional_embedding", None, width),
        blocks=tuple(
            open_clip_block(weights, f"{prefix}transformer.resblocks.{layer}", width) for layer in range(layers)
        ),
        final_norm=weights.norm(f"{prefix}ln_final", width),
        projection=weights.affine(
            f"{prefix}text_projection", width, None, bias=f"{prefix}text_projection.bias" in weights.names
        )
        if is_linear
        else Affine(weights.array(f"{prefix}text_projection", width, None), None),
        heads=whole_number(weights, "heads", text.get("heads", max(1, width // HEAD_WIDTH))),
        activation=open_clip_activation(weights, model, text, activation),
        epsilon=float((text.get("norm_kwargs") or {}).get("eps", 1e-5)),
        causal=not text.get("no_causal_mask", False),
        pooling=text.get("pool_type", "argmax"),
        eos_id=0,
    )


def open_clip_block(weights: Weights, name: str, width: int) -> Block:
    """A block of a tower with OpenAI's or OpenCLIP's names, text or vision."""
    expand = weights.affine(f"{name}.mlp.c_fc", width, None)
    together = weights.array(f"{name}.attn.in_proj_weight", 3 * width, width).T
    return Block(
        norm_1=weights.norm(f"{name}.ln_1", width),
        attend_in=Affine(np.ascontiguousarray(together), weights.array(f"{name}.attn.in_proj_bias", 3 * width)),
        attend_out=weights.affine(f"{name}.attn.out_proj", width, width),
        norm_2=weights.norm(f"{name}.ln_2", width),
        expand=expand,
        contract=weights.affine(f"{name}.mlp.c_proj", expand.weight.shape[1], width),
    )


def _known_settings(weights: Weights, text: dict[str, Any]) -> dict[str, Any]:
    """OpenCLIP's text_cfg, refused where it asks for what the tower here does not do."""
    free = {"context_length", "vocab_size", "width", "layers", "mlp_ratio", "hf_tokenizer_name", "tokenizer_kwargs"}
    used = {"heads", "no_causal_mask", "pool_type", "proj_bias", "norm_kwargs", "act_kwargs", "final_ln_after_pool"}
    strange = sorted(name for name, value in text.items() if name not in free | used and value)
    if strange or text.get("pool_type", "argmax") not in ("argmax", "last"):
        named = strange[0] if strange else "pool_type"
        raise OgPointcloudError(
            f"{weights.where}: its text_cfg has {named} {text[named]!r:.60}; not understood: export it from its "
            "transformers form, if there is one"
        )
    return text


def open_clip_activation(
    weights: Weights, model: dict[str, Any], text: dict[str, Any], chosen: Activation | None
) -> Activation:
    """What an OpenCLIP configuration, OpenAI's marks or the caller say; OgPointcloudError where none or two do."""
    if model:
        tanh = (text.get("act_kwargs") or {}).get("approximate") == "tanh"
        said = "quick_gelu" if model.get("quick_gelu") else "gelu_pytorch_tanh" if tanh else "gelu"
    else:
        said = "quick_gelu" if weights.names >= OPENAI_MARKS else None
    if said is None and chosen is None:
        raise OgPointcloudError(
            f"{weights.where} does not say its activation, and there is no {OPEN_CLIP_CONFIG} beside it: pass "
            "--activation quick_gelu (OpenAI's weights, OpenCLIP's models named -quickgelu, DFN) or gelu (others of "
            "OpenCLIP); a wrong one gives vectors that are quietly wrong"
        )
    if said and chosen and said != chosen:
        raise OgPointcloudError(f"{weights.where} says its activation is {said}; expected no --activation, or this one")
    return named_activation(weights, said or chosen)


def named_activation(weights: Weights, name: Any) -> Activation:
    """One of the three that are understood, else OgPointcloudError."""
    if name not in get_args(Activation):
        raise OgPointcloudError(
            f"{weights.where}: its activation is {name!r:.40}; expected {' or '.join(get_args(Activation))}"
        )
    return name


def whole_number(weights: Weights, name: str, value: Any) -> int:
    """A setting that counts something, else OgPointcloudError."""
    if not isinstance(value, int) or isinstance(value, bool) or value < 1:
        raise OgPointcloudError(f"{weights.where}: its {name} is {value!r:.40}; expected a whole number")
    return value
