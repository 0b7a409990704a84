"""Recognizes, node for node, the query.onnx of this schema version: no other graph is ever run.

A digest fixes what the nodes do. Files differ only in the contents of tables, whose names, types and ranks are fixed
too, and in single numbers that nodes add, compare or multiply with. None of these can enlarge an array: memory is
bounded by the size of the file and of the query. ``ask.query_graph`` checks that the graph's answers are right.
"""

from __future__ import annotations

from hashlib import blake2b

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.models import Constant, check_graph, constant_of, message_fields, text_of

KNOWN_GRAPHS = frozenset({
    "0931f16d57ab1db72ec826a2b787e5f5", "278a9debe4359bb24c880b918dd953e8", "cd2b6be498a00464ad55884c286e2033",
    "5125ba60d69c8c34932f1c6f484a6e08", "d6b9de5009bf92436051be07f7985c7a", "b9731a6b2aa1345740ee322b1720fe8f",
})  # fmt: skip
"""`query_graph_digest` of the graph that `og_pointcloud_export.query_graph` builds, then of those that it has built
since schema version 2. A change of that graph adds its digest here, and removes none."""
MODEL_FIELDS, GRAPH_FIELDS = {1, 2, 7, 8}, {1, 2, 5, 10, 11, 12}
"""Fields of onnx.proto3 that our graphs have. ModelProto: ir_version, producer_name, graph, opset_import. GraphProto:
node, name, initializer, doc_string, input, output."""
CODE_COUNT_INPUT = "(answer codes)"
"""Placeholder in the digest for the name of the constant that holds the number of answer codes."""
TABLES = frozenset({
    "axis_places", "block_shifts", "brick_values", "candidate_answer", "candidate_x", "candidate_y", "candidate_z",
    "candidates", "candidates_high", "candidates_low", "cell_values", "child_length", "child_start", "descriptor_code",
    "descriptors", "first_child", "first_list", "grid_low", "last_cell", "list_parts", "list_start", "node_values",
    "part_values", "place_to_address", "unknown_column", "value_answer", "value_distance", "value_instance",
})  # fmt: skip
"""Constants that differ from file to file; all others are numbers."""
DTYPES = {1: "<f4", 2: "|u1", 3: "|i1", 4: "<u2", 6: "<i4", 7: "<i8", 11: "<f8", 12: "<u4"}
"""numpy's types by TensorProto.DataType."""
UNSIGNED = (2, 4, 12)
FREE_OPERATORS = {6: ("Add", "Sub", "Less", "GreaterOrEqual", "Min", "Max"), 1: ("Mul",), 11: ("LessOrEqual",)}
"""By TensorProto.DataType of a single number: operators in which it may have any value. Other contents of a table could
have the same effect, so fixing it would gain nothing."""


def query_tables(onnx: bytes) -> dict[str, NDArray[np.generic]]:
    """The tables of a query graph by name, read-only views, and ``codes``, its number of answer codes. ValueError says
    why, for any other graph."""
    check_graph(onnx)
    digest, constants, codes = _parsed(onnx)
    if digest not in KNOWN_GRAPHS:
        raise ValueError("it is not a graph that this format allows")
    tables = {name: constant for name, constant in constants.items() if name in TABLES} | {"codes": codes}
    return {name: np.frombuffer(table.data, DTYPES[table.kind]).reshape(table.shape) for name, table in tables.items()}


def query_graph_digest(onnx: bytes) -> str:
    """32 hexadecimal digits: digest of everything that must be equal in the graphs of all files."""
    return _parsed(onnx)[0]


def _parsed(onnx: bytes) -> tuple[str, dict[str, Constant], Constant]:
    """The digest, all constants by name, and the number of answer codes."""
    # Field numbers, of ModelProto: 1 ir_version, 7 graph, 8 opset_import; of GraphProto: 1 node, 5 initializer, 11
    # input, 12 output; of TensorProto: 8 name; of ValueInfoProto: 1 name.
    model = list(message_fields(memoryview(onnx)))
    graph = [field for number, value in model if number == 7 for field in message_fields(value)]
    if {number for number, _ in model} - MODEL_FIELDS or {number for number, _ in graph} - GRAPH_FIELDS:
        raise ValueError("it contains fields that our graphs do not have")
    named = [(text_of(value, 8), constant_of(value)) for number, value in graph if number == 5]
    constants = dict(named)
    nodes = [_Node(value) for number, value in graph if number == 1]
    # The first Concat makes the shape (answer codes, texts) of the table of scores.
    counting = next((node for node in nodes if node.operator == "Concat" and node.inputs), None)
    # Two constants of one name, or one called CODE_COUNT_INPUT, could stand in for one another in the digest.
    if (
        len(constants) != len(named)
        or CODE_COUNT_INPUT in constants
        or counting is None
        or counting.inputs[0] not in constants
    ):
        raise ValueError("it does not count answer codes as our graphs do")
    # The digest covers versions, tables by kind, inputs and outputs by name, and every node in order.
    lines = [f"{number} {_hex(value)}" for number, value in model if number in (1, 8)]
    lines += sorted(f"{name} {_kind(constant)}" for name, constant in constants.items() if name in TABLES)
    lines += [f"{number} {text_of(value, 1)!r}" for number, value in graph if number in (11, 12)]
    codes, counting.inputs[0] = constants[counting.inputs[0]], CODE_COUNT_INPUT
    lines += [node.line(constants) for node in nodes]
    return blake2b("\n".join(lines).encode(), digest_size=16).hexdigest(), constants, codes


class _Node:
    def __init__(self, message: memoryview | int) -> None:
        fields = list(message_fields(message))  # of NodeProto: 1 input, 2 output, 4 op_type, 5 attribute
        self.operator = text_of(message, 4)
        self.inputs = [_text(value) for number, value in fields if number == 1]
        self.outputs = [_text(value) for number, value in fields if number == 2]
        self.attributes = [_hex(value) for number, value in fields if number == 5]

    def line(self, constants: dict[str, Constant]) -> str:
        """The node's effect as text. Inputs appear by name, but constants that are no tables by their value, or as
        "any" if it may differ."""
        inputs = [self._input(name, constants[name]) if name in constants else repr(name) for name in self.inputs]
        return f"{self.operator} {inputs} {self.outputs} {self.attributes}"

    def _input(self, name: str, constant: Constant) -> str:
        if name in TABLES:
            return repr(name)
        is_free = not constant.shape and self.operator in FREE_OPERATORS.get(constant.kind, ())
        return f"{constant.kind} {constant.shape} {'any' if is_free else constant.data.hex()}"


def _kind(table: Constant) -> str:
    """Type and rank. All unsigned types count as one: whole numbers are stored in the smallest type that fits."""
    return f"{'unsigned' if table.kind in UNSIGNED else table.kind} {len(table.shape)}"


def _text(value: memoryview | int) -> str:
    return str(value) if isinstance(value, int) else bytes(value).decode("utf-8", "replace")


def _hex(value: memoryview | int) -> str:
    return str(value) if isinstance(value, int) else value.hex()
