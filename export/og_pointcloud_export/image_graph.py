"""image_encoder.onnx: an image tower as one graph of standard operators.

Input   pixels (B, 3, S, S) float32  as the manifest's preprocessing makes them
Output  image  (B, D) float32        unit rows
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import MissingExtraError, OgPointcloudError
from og_pointcloud.masking.encoders.onnx_model import ENCODER_FILES, GRAPH
from og_pointcloud_export.text_graph import IR_VERSION, OPSET, Graph, add_activation

try:
    from onnx import TensorProto, helper, numpy_helper
except ImportError as error:
    raise MissingExtraError("onnx", "masks") from error

if TYPE_CHECKING:
    from og_pointcloud_export.image_weights import AttentionPool, ImageTower
    from og_pointcloud_export.text_weights import Block

__all__ = ["add_unit_rows", "build_image_graph", "serialized"]


def build_image_graph(tower: ImageTower) -> bytes:
    """The serialised graph. OgPointcloudError where it would be larger than a graph in one file may be."""
    graph = Graph(int8=False)
    graph.constant("by_head", np.array([0, 0, tower.heads, tower.position_embedding.shape[1] // tower.heads]))
    graph.constant("together", np.array([0, 0, tower.position_embedding.shape[1]]))
    x = _embed(graph, tower)
    for number, block in enumerate(tower.blocks):
        x = _block(graph, f"block{number}", x, block, tower)
    if tower.pool is None:
        first = graph.add("Gather", f"{x} {graph.constant('first', np.int64(0))}", "class", axis=1)
        pooled = graph.norm("final_norm", first, tower.final_norm, tower.epsilon)
    else:
        x = graph.norm("final_norm", x, tower.final_norm, tower.epsilon)
        pooled = _attention_pool(graph, x, tower.pool, tower)
    if tower.projection is not None:
        pooled = graph.linear("projection", pooled, tower.projection)
    add_unit_rows(graph, pooled)
    return serialized(graph, tower.preprocessing.size, tower.width, __doc__)


def add_unit_rows(graph: Graph, rows: str) -> None:
    """Ends the graph: (B, D) rows to the output "image", each of length 1."""
    graph.add("ReduceL2", f"{rows} {graph.constant('row', np.array([1]))}", "length_raw", keepdims=1)
    graph.add("Max", f"length_raw {graph.constant('tiny', np.finfo(np.float32).tiny)}", "length_safe")
    graph.add("Div", f"{rows} length_safe", "image")


def serialized(graph: Graph, size: int, width: int, description: str | None) -> bytes:
    """The bytes of image_encoder.onnx. size: of the square, pixels. width: of a vector."""
    held = sum(constant.nbytes for constant in graph.constants.values())
    most = ENCODER_FILES[GRAPH] - (1 << 20)
    if held > most:
        raise OgPointcloudError(
            f"the image tower has {held / 1e9:.2f} GB of constants; expected at most {most / 1e9:.2f}, all that one "
            "file may hold: use the model's folder itself"
        )
    made = helper.make_graph(
        graph.nodes,
        "image_encoder",
        [helper.make_tensor_value_info("pixels", TensorProto.FLOAT, ["B", 3, size, size])],
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, ["B", width])],
        [numpy_helper.from_array(value, name) for name, value in graph.constants.items()],
        doc_string=description,
    )
    model = helper.make_model(made, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="og_pointcloud")
    model.ir_version = IR_VERSION
    return model.SerializeToString()


def _embed(graph: Graph, tower: ImageTower) -> str:
    width, side = tower.position_embedding.shape[1], tower.patch_size
    kernels = graph.constant("patch", tower.patch.weight.T.reshape(width, 3, side, side))
    bias = "" if tower.patch.bias is None else graph.constant("patch_bias", tower.patch.bias)
    graph.add("Conv", f"pixels {kernels} {bias}", "patches_square", strides=[side, side])
    graph.add("Reshape", f"patches_square {graph.constant('by_patch', np.array([0, width, -1]))}", "patches_last")
    x = graph.add("Transpose", "patches_last", "patches", perm=[0, 2, 1])
    position: NDArray[Any] = tower.position_embedding
    if tower.class_token is not None:
        # As many class tokens as there are images: the first patch of each, times zero.
        graph.add("Gather", f"{x} {graph.constant('one_patch', np.array([0]))}", "a_patch", axis=1)
        graph.add("Mul", f"a_patch {graph.constant('zero', np.float32(0))}", "nothing")
        graph.add("Add", f"nothing {graph.constant('class_token', tower.class_token)}", "class_tokens")
        x = graph.add("Concat", f"class_tokens {x}", "tokens", axis=1)
    x = graph.add("Add", f"{x} {graph.constant('positions', position)}", "placed")
    return x if tower.pre_norm is None else graph.norm("pre_norm", x, tower.pre_norm, tower.epsilon)


def _block(graph: Graph, name: str, x: str, block: Block, tower: ImageTower) -> str:
    normed = graph.norm(f"{name}.norm_1", x, block.norm_1, tower.epsilon)
    together = graph.linear(f"{name}.in", normed, block.attend_in)
    graph.add("Split", together, f"{name}.q {name}.k {name}.v", axis=2, num_outputs=3)
    by_head = graph.add("Reshape", f"{name}.q by_head", f"{name}.q_heads")
    q = graph.add("Transpose", by_head, f"{name}.q_first", perm=[0, 2, 1, 3])
    mixed = _mixed(graph, name, q, f"{name}.k", f"{name}.v", tower)
    x = graph.add("Add", f"{x} {graph.linear(f'{name}.out', mixed, block.attend_out)}", f"{name}.attended")
    normed = graph.norm(f"{name}.norm_2", x, block.norm_2, tower.epsilon)
    active = add_activation(
        graph, f"{name}.active", graph.linear(f"{name}.expand", normed, block.expand), tower.activation
    )
    return graph.add("Add", f"{x} {graph.linear(f'{name}.contract', active, block.contract)}", f"{name}.x")


def _mixed(graph: Graph, name: str, q: str, k: str, v: str, tower: ImageTower) -> str:
    """Attention, (B, Q, W). q: (B or 1, heads, Q, W / heads); k, v: (B, N, W)."""
    head_width = tower.position_embedding.shape[1] // tower.heads
    scale = graph.constant("attention_scale", np.float32(1 / math.sqrt(head_width)))
    for part, value, order in (("keys", k, [0, 2, 3, 1]), ("values", v, [0, 2, 1, 3])):
        graph.add("Reshape", f"{value} by_head", f"{name}.{part}_heads")
        graph.add("Transpose", f"{name}.{part}_heads", f"{name}.{part}", perm=order)
    graph.add("Mul", f"{q} {scale}", f"{name}.q_scaled")
    graph.add("MatMul", f"{name}.q_scaled {name}.keys", f"{name}.logits")
    graph.add("Softmax", f"{name}.logits", f"{name}.weights", axis=-1)
    graph.add("MatMul", f"{name}.weights {name}.values", f"{name}.mixed_heads")
    graph.add("Transpose", f"{name}.mixed_heads", f"{name}.mixed_rows", perm=[0, 2, 1, 3])
    return graph.add("Reshape", f"{name}.mixed_rows together", f"{name}.mixed")


def _attention_pool(graph: Graph, x: str, pool: AttentionPool, tower: ImageTower) -> str:
    """(B, W). The question is the same for all images, and so is what it becomes before it meets their keys."""
    width = len(pool.question)
    bias = np.zeros(3 * width, np.float32) if pool.attend_in.bias is None else pool.attend_in.bias
    asked = pool.question @ pool.attend_in.weight[:, :width] + bias[:width]
    q = graph.constant("pool.question", asked.reshape(1, tower.heads, 1, -1))
    for part, start in (("k", width), ("v", 2 * width)):
        columns = slice(start, start + width)
        weight = graph.constant(f"pool.{part}.weight", pool.attend_in.weight[:, columns])
        graph.add("MatMul", f"{x} {weight}", f"pool.{part}.product")
        graph.add("Add", f"pool.{part}.product {graph.constant(f'pool.{part}.bias', bias[columns])}", f"pool.{part}")
    mixed = graph.linear("pool.out", _mixed(graph, "pool", q, "pool.k", "pool.v", tower), pool.attend_out)
    normed = graph.norm("pool.norm", mixed, pool.norm, tower.epsilon)
    active = add_activation(graph, "pool.active", graph.linear("pool.expand", normed, pool.expand), tower.activation)
    answer = graph.add("Add", f"{mixed} {graph.linear('pool.contract', active, pool.contract)}", "pool.answer")
    return graph.add("Reshape", f"{answer} {graph.constant('flat', np.array([-1, width]))}", "pool.flat")
