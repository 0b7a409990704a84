"""text_encoder.onnx: a text tower as one graph of standard operators.

Input   tokens (B, T) int64    ids that begin and end as the tokenizer says; T is any length up to the context where the
                               tower is causal (what follows a text's end cannot reach it), else the whole context
Output  text   (B, D) float32  unit rows
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import MissingExtraError, OgPointcloudError
from og_pointcloud.text.encoder import ENCODER_FILES, GRAPH

try:
    import onnx
    from onnx import TensorProto, helper, numpy_helper
except ImportError as error:
    raise MissingExtraError("onnx", "export-text") from error

if TYPE_CHECKING:
    from og_pointcloud_export.text_weights import Affine, Block, TextTower

__all__ = ["IR_VERSION", "OPSET", "Graph", "add_activation", "build_text_graph"]

OPSET, IR_VERSION = 18, 8
INT8_ZERO = 128


def build_text_graph(tower: TextTower, *, int8: bool = False) -> bytes:
    """The serialised graph. OgPointcloudError where it would be larger than a graph in one file may be.

    int8: matrices of the blocks in 8 bits, a scale a column, activations quantised as they come (a scale a run);
    embeddings in 8 bits, a scale a row. Norms, attention and projection stay float32.
    """
    graph = Graph(int8)
    x = _embed(graph, tower)
    for number, block in enumerate(tower.blocks):
        x = _block(graph, f"block{number}", x, block, tower)
    _pool(graph, x, tower)
    held = sum(constant.nbytes for constant in graph.constants.values())
    most = ENCODER_FILES[GRAPH] - (1 << 20)
    if held > most:
        raise OgPointcloudError(
            f"the text tower has {held / 1e9:.2f} GB of constants; expected at most {most / 1e9:.2f}, all that one "
            f"file may hold{'' if int8 else ': try --int8'}"
        )
    return graph.serialized(tower.width)


class Graph:
    """Nodes and constants as they are added; a value is known by its name."""

    def __init__(self, int8: bool) -> None:
        self.int8 = int8
        self.nodes: list[onnx.NodeProto] = []
        self.constants: dict[str, NDArray[Any]] = {}

    def constant(self, name: str, value: Any) -> str:
        """Keep a value under a name, which is given back."""
        self.constants[name] = np.ascontiguousarray(value) if np.ndim(value) else np.asarray(value)
        return name

    def add(self, operator: str, inputs: str, output: str, **attributes: Any) -> str:
        """A node; inputs and outputs as names with spaces between. Gives the first output."""
        self.nodes.append(helper.make_node(operator, inputs.split(), output.split(), **attributes))
        return output.split()[0]

    def linear(self, name: str, x: str, affine: Affine, *, exact: bool = False) -> str:
        """x times a matrix, plus the bias if there is one; in 8 bits where the graph is, unless exact."""
        if self.int8 and not exact:
            product = self._int8_product(name, x, affine.weight)
        else:
            product = self.add("MatMul", f"{x} {self.constant(f'{name}.weight', affine.weight)}", f"{name}.product")
        if affine.bias is None:
            return product
        return self.add("Add", f"{product} {self.constant(f'{name}.bias', affine.bias)}", name)

    def _int8_product(self, name: str, x: str, weight: NDArray[np.float32]) -> str:
        """Both sides unsigned: with a signed weight, processors without VNNI saturate, and answers would differ."""
        scale = np.maximum(np.abs(weight).max(axis=0), np.finfo(np.float32).tiny) / 127
        rounded = (np.rint(weight / scale) + INT8_ZERO).astype(np.uint8)
        self.add("DynamicQuantizeLinear", x, f"{name}.in {name}.in_scale {name}.in_zero")
        constants = [self.constant(f"{name}.weight", rounded), f"{name}.in_zero"]
        constants.append(self.constant("int8_zero", np.uint8(INT8_ZERO)))
        self.add("MatMulInteger", f"{name}.in {' '.join(constants)}", f"{name}.sum")
        self.add("Cast", f"{name}.sum", f"{name}.sum_float", to=TensorProto.FLOAT)
        self.add("Mul", f"{name}.in_scale {self.constant(f'{name}.scale', scale.astype(np.float32))}", f"{name}.step")
        return self.add("Mul", f"{name}.sum_float {name}.step", f"{name}.product")

    def norm(self, name: str, x: str, affine: Affine, epsilon: float) -> str:
        """Layer norm over the last axis."""
        constants = f"{self.constant(f'{name}.gain', affine.weight)} {self.constant(f'{name}.offset', affine.bias)}"
        return self.add("LayerNormalization", f"{x} {constants}", name, axis=-1, epsilon=epsilon)

    def serialized(self, width: int) -> bytes:
        """The bytes of text_encoder.onnx. width: of a vector."""
        graph = helper.make_graph(
            self.nodes,
            "text_encoder",
            [helper.make_tensor_value_info("tokens", TensorProto.INT64, ["B", "T"])],
            [helper.make_tensor_value_info("text", TensorProto.FLOAT, ["B", width])],
            [numpy_helper.from_array(value, name) for name, value in self.constants.items()],
            doc_string=__doc__,
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="og_pointcloud")
        model.ir_version = IR_VERSION
        return model.SerializeToString()


def _embed(graph: Graph, tower: TextTower) -> str:
    table = tower.token_embedding
    if graph.int8:
        scale = np.maximum(np.abs(table).max(axis=1, keepdims=True), np.finfo(np.float32).tiny) / 127
        graph.constant("embedding", np.rint(table / scale).astype(np.int8))
        graph.add("Gather", "embedding tokens", "embedded_int8", axis=0)
        graph.add("Cast", "embedded_int8", "embedded_steps", to=TensorProto.FLOAT)
        graph.add("Gather", f"{graph.constant('embedding_scale', scale.astype(np.float32))} tokens", "embedded_scale")
        graph.add("Mul", "embedded_steps embedded_scale", "embedded")
    else:
        graph.add("Gather", f"{graph.constant('embedding', table)} tokens", "embedded", axis=0)
    graph.constant("first", np.array([0]))
    graph.constant("second", np.array([1]))
    graph.add("Shape", "tokens", "length", start=1, end=2)
    positions = graph.constant("positions", tower.position_embedding)
    graph.add("Slice", f"{positions} first length first", "positions_used")
    if tower.causal:
        context = len(tower.position_embedding)
        later = np.triu(np.full((context, context), -np.inf, np.float32), 1)
        graph.add("Slice", f"{graph.constant('later_tokens', later)} first length first", "later_rows")
        graph.add("Slice", "later_rows first length second", "later")
    return graph.add("Add", "embedded positions_used", "x")


def _block(graph: Graph, name: str, x: str, block: Block, tower: TextTower) -> str:
    normed = graph.norm(f"{name}.norm_1", x, block.norm_1, tower.epsilon)
    attended = _attend(graph, f"{name}.attention", normed, block, tower)
    x = graph.add("Add", f"{x} {attended}", f"{name}.attended")
    hidden = graph.linear(f"{name}.expand", graph.norm(f"{name}.norm_2", x, block.norm_2, tower.epsilon), block.expand)
    active = add_activation(graph, f"{name}.active", hidden, tower.activation)
    return graph.add("Add", f"{x} {graph.linear(f'{name}.contract', active, block.contract)}", f"{name}.x")


def _attend(graph: Graph, name: str, x: str, block: Block, tower: TextTower) -> str:
    width = tower.token_embedding.shape[1]
    graph.constant("by_head", np.array([0, 0, tower.heads, width // tower.heads]))
    graph.constant("together", np.array([0, 0, width]))
    graph.constant("attention_scale", np.float32(1 / math.sqrt(width // tower.heads)))
    graph.add(
        "Split", graph.linear(f"{name}.in", x, block.attend_in), f"{name}.q {name}.k {name}.v", axis=2, num_outputs=3
    )
    for part, order in (("q", [0, 2, 1, 3]), ("k", [0, 2, 3, 1]), ("v", [0, 2, 1, 3])):
        graph.add("Reshape", f"{name}.{part} by_head", f"{name}.{part}_heads")
        graph.add("Transpose", f"{name}.{part}_heads", f"{name}.{part}_first", perm=order)
    graph.add("Mul", f"{name}.q_first attention_scale", f"{name}.q_scaled")
    logits = graph.add("MatMul", f"{name}.q_scaled {name}.k_first", f"{name}.logits")
    if tower.causal:
        logits = graph.add("Add", f"{logits} later", f"{name}.logits_masked")
    graph.add("Softmax", logits, f"{name}.weights", axis=-1)
    graph.add("MatMul", f"{name}.weights {name}.v_first", f"{name}.mixed")
    graph.add("Transpose", f"{name}.mixed", f"{name}.mixed_rows", perm=[0, 2, 1, 3])
    graph.add("Reshape", f"{name}.mixed_rows together", f"{name}.mixed_flat")
    return graph.linear(f"{name}.out", f"{name}.mixed_flat", block.attend_out)


def add_activation(graph: Graph, name: str, x: str, activation: str) -> str:
    """One of the three bends that CLIP and SigLIP have between a block's two matrices."""
    if activation == "quick_gelu":  # x sigmoid(1.702 x)
        graph.add("Mul", f"{x} {graph.constant('quick', np.float32(1.702))}", f"{name}.steep")
        graph.add("Sigmoid", f"{name}.steep", f"{name}.share")
        return graph.add("Mul", f"{x} {name}.share", name)
    graph.constant("one", np.float32(1))
    graph.constant("half", np.float32(0.5))
    if activation == "gelu":  # x (1 + erf(x / sqrt 2)) / 2
        graph.add("Div", f"{x} {graph.constant('root_two', np.float32(math.sqrt(2)))}", f"{name}.scaled")
        graph.add("Erf", f"{name}.scaled", f"{name}.bent")
    else:  # x (1 + tanh(sqrt(2 / pi) (x + 0.044715 x^3))) / 2
        graph.add("Mul", f"{x} {x}", f"{name}.square")
        graph.add("Mul", f"{name}.square {graph.constant('cubic', np.float32(0.044715))}", f"{name}.cubic")
        graph.add("Add", f"{name}.cubic one", f"{name}.factor")
        graph.add("Mul", f"{x} {graph.constant('tanh_scale', np.float32(math.sqrt(2 / math.pi)))}", f"{name}.scaled")
        graph.add("Mul", f"{name}.scaled {name}.factor", f"{name}.argument")
        graph.add("Tanh", f"{name}.argument", f"{name}.bent")
    graph.add("Add", f"{name}.bent one", f"{name}.raised")
    graph.add("Mul", f"{x} {name}.raised", f"{name}.doubled")
    return graph.add("Mul", f"{name}.doubled half", name)


def _pool(graph: Graph, x: str, tower: TextTower) -> None:
    """The text's token, normed and projected alone: norms act a token at a time."""
    if tower.pooling == "last":
        pooled = graph.add("Gather", f"{x} {graph.constant('last', np.int64(-1))}", "pooled", axis=1)
    else:
        marked = "tokens"
        if tower.pooling == "eos":
            marked = graph.add("Equal", f"tokens {graph.constant('eos', np.int64(tower.eos_id))}", "is_end")
        graph.add("Cast", marked, "marks", to=TensorProto.INT32)
        graph.add("ArgMax", "marks", "end", axis=1, keepdims=1)  # the first of equals
        pooled = graph.add("GatherND", f"{x} end", "pooled", batch_dims=1)
    normed = graph.norm("final_norm", pooled, tower.final_norm, tower.epsilon)
    vector = graph.linear("projection", normed, tower.projection, exact=True)
    graph.add("ReduceL2", f"{vector} second", "length_raw", keepdims=1)
    graph.add("Max", f"length_raw {graph.constant('tiny', np.finfo(np.float32).tiny)}", "length_safe")
    graph.add("Div", f"{vector} length_safe", "text")
