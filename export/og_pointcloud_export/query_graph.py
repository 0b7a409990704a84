"""query.onnx: one graph that answers text for points, and stands alone in any program with an ONNX runtime.

Inputs
  points (N, 3) float32   in the bundle's local frame: world minus ``frame.origin`` of the manifest; NaN is too far
  text   (L, D) float32   one vector a label, of any length; a zero vector is like nothing
Outputs
  label           (N,) int32      row of ``text``, -1 unknown
  score           (N,) float32    cosine of that label, 0 where unknown
  instance        (N,) int32      instance id, -1 background, -2 unobserved, -3 too far from the cloud
  distance        (N,) int8       0 on the surface, 1 near it, 2 too far; between 0 and 1 to about a cell (lookup_grid)
  certain         (N,) bool       false, rarely: the table has no room for this cell, the answer is its centre's
  instance_scores (K, L) float32  best cosine of an instance's descriptors with each text, -2 without a descriptor
Any of N, L and K may be 0.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.bundle.format import BEYOND, NEAR, ON_SURFACE
from og_pointcloud.bundle.nearest import surface_distance
from og_pointcloud.cloud import NO_EVIDENCE, InstanceTable, LabelledCloud
from og_pointcloud.errors import MissingExtraError
from og_pointcloud_export.lookup_boxes import CHILDREN, EDGE, LONGEST_LIST, SHORT_LIST, TOO_FAR_CODE
from og_pointcloud_export.lookup_grid import CODE_OFFSET, LookupGrid

try:
    import onnx
    from onnx import TensorProto, helper, numpy_helper
except ImportError as error:
    raise MissingExtraError("onnx", "fit") from error

__all__ = ["OPSET", "build_query_graph"]

LIST_LENGTHS = {"short": SHORT_LIST, "middle": 20, "long": LONGEST_LIST}
"""So many candidates are compared: of most lists the first number, of longer ones the next."""
OPSET, IR_VERSION = 18, 8
"""The oldest that has everything needed (ScatterElements with max), so that onnxruntime 1.17 and later run it."""


def build_query_graph(cloud: LabelledCloud, grid: LookupGrid) -> bytes:
    """The serialised graph of a cloud; inputs and outputs are described above."""
    nodes = [*_unit_nodes("text"), *_score_nodes(), *_lookup_nodes()]
    text_width = max(cloud.instances.descriptors.shape[1], 1)
    constants = {**_score_constants(cloud.instances), **_lookup_constants(cloud, grid)}
    inputs = [
        helper.make_tensor_value_info("points", TensorProto.FLOAT, ["N", 3]),
        helper.make_tensor_value_info("text", TensorProto.FLOAT, ["L", text_width]),
    ]
    outputs = [
        helper.make_tensor_value_info("label", TensorProto.INT32, ["N"]),
        helper.make_tensor_value_info("score", TensorProto.FLOAT, ["N"]),
        helper.make_tensor_value_info("instance", TensorProto.INT32, ["N"]),
        helper.make_tensor_value_info("distance", TensorProto.INT8, ["N"]),
        helper.make_tensor_value_info("certain", TensorProto.BOOL, ["N"]),
        helper.make_tensor_value_info("instance_scores", TensorProto.FLOAT, [len(cloud.instances), "L"]),
    ]
    initializers = [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()]
    graph = helper.make_graph(nodes, "query_head", inputs, outputs, initializers, doc_string=__doc__)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="og_pointcloud")
    model.ir_version = IR_VERSION
    onnx.checker.check_model(model)
    return model.SerializeToString()


def _node(operator: str, inputs: str, output: str, **attributes: Any) -> onnx.NodeProto:
    return helper.make_node(operator, inputs.split(), [output], name=output, **attributes)


def _unit_nodes(name: str) -> list[onnx.NodeProto]:
    """Rows of unit length, in two steps so that neither tiny nor huge vectors leave float32."""
    return [
        _node("Abs", name, f"{name}_magnitude"),
        _node("ReduceMax", f"{name}_magnitude last_axis", f"{name}_largest"),
        _node("Max", f"{name}_largest smallest_normal", f"{name}_scale"),
        _node("Div", f"{name} {name}_scale", f"{name}_scaled"),
        _node("ReduceL2", f"{name}_scaled last_axis", f"{name}_length"),
        _node("Max", f"{name}_length smallest_normal", f"{name}_divisor"),
        _node("Div", f"{name}_scaled {name}_divisor", f"{name}_unit"),
    ]


def _score_nodes() -> list[onnx.NodeProto]:
    """text_unit -> instance_scores; label and score of each answer code: too far, unobserved, background, 0.."""
    return [
        _node("Transpose", "text_unit", "text_columns", perm=[1, 0]),
        _node("MatMul", "descriptors text_columns", "similarity"),
        # The best descriptor of each instance; codes without one stay at NO_EVIDENCE.
        _node("Shape", "text", "label_count", end=1),
        _node("Concat", "code_count label_count", "table_shape", axis=0),
        _node("Expand", "no_evidence table_shape", "empty_table"),
        _node("Shape", "similarity", "similarity_shape"),
        _node("Expand", "descriptor_code similarity_shape", "similarity_code"),
        _node("ScatterElements", "empty_table similarity_code similarity", "code_scores", axis=0, reduction="max"),
        _node("Slice", "code_scores first_instance past_the_end first_axis", "instance_scores"),
        # Column 0 stands for "unknown": it wins where no label has evidence, or there is no label at all.
        _node("Concat", "unknown_column code_scores", "choices", axis=1),
        _node("ArgMax", "choices", "choice", axis=1, keepdims=0),
        _node("Sub", "choice one_int64", "choice_label"),
        _node("Cast", "choice_label", "code_label", to=TensorProto.INT32),
        _node("ReduceMax", "choices last_axis", "best_score", keepdims=0),
        _node("Less", "code_label zero_int32", "code_unknown"),
        _node("Where", "code_unknown zero best_score", "code_score"),
    ]


def _score_constants(instances: InstanceTable) -> dict[str, Any]:
    codes = len(instances) + CODE_OFFSET
    described = instances.descriptors.shape[1] > 0  # if nothing was ever described, any one column will do
    return {
        "descriptors": np.ascontiguousarray(instances.descriptors if described else np.zeros((0, 1)), np.float32),
        "descriptor_code": (instances.descriptor_instance.astype(np.int64) + CODE_OFFSET)[:, None],
        "code_count": np.array([codes], np.int64),
        "no_evidence": np.array(NO_EVIDENCE, np.float32),
        "unknown_column": np.full((codes, 1), NO_EVIDENCE, np.float32),
        "first_instance": np.array([CODE_OFFSET], np.int64),
        "past_the_end": np.array([np.iinfo(np.int64).max], np.int64),
        "first_axis": np.array([0], np.int64),
        "last_axis": np.array([1], np.int64),
        "smallest_normal": np.finfo(np.float32).tiny,
        "zero": np.float32(0),
        "zero_int32": np.int32(0),
        "one_int64": np.int64(1),
    }


def _lookup_nodes() -> list[onnx.NodeProto]:
    """points -> answer code, by the tables of ``LookupGrid`` and, for the few points in boxes that have one, by their
    list -> the outputs.

    Coordinates are laid out as three rows of N: several times as fast as N rows of three, and, unlike a product with
    the strides, exact in integers wherever it runs. Tables are read with GatherElements, which in onnxruntime takes a
    tenth of Gather's time.
    """
    return [
        _node("Transpose", "points", "rows", perm=[1, 0]),
        _node("Sub", "rows grid_low", "offset"),
        _node("Mul", "offset cells_per_unit", "position"),
        # The clamp is on integers: whatever NaN, infinity or 1e30 become there, they end in the outermost layer.
        _node("Cast", "position", "cell_unbounded", to=TensorProto.INT32),
        _node("Max", "cell_unbounded zero_int32", "cell_above"),
        _node("Min", "cell_above last_cell", "cell"),
        # Along each axis, cell -> what it adds to (block * 64 + brick in the block) * 64 + cell in the brick.
        _node("GatherElements", "axis_places cell", "place_terms", axis=1),
        *_sum_of_rows("place_terms", "place"),
        _node("Div", "place cells_per_block", "block"),
        _node("Div", "place children", "brick"),
        # block -> its row of brick_values, less its number, times 64; brick -> its reference
        _node("GatherElements", "block_shifts block", "brick_shift"),
        _node("Add", "brick brick_shift", "brick_address"),
        _node("GatherElements", "brick_values brick_address", "brick_stored"),
        _node("Cast", "brick_stored", "brick_reference", to=TensorProto.INT32),
        # cell -> its value; the last row stands for bricks that have a list
        _node("Min", "brick_reference last_row", "brick_row"),
        _node("Sub", "brick_row brick", "row_shift"),
        _node("Mul", "row_shift children", "address_shift"),
        _node("Add", "place address_shift", "cell_address"),
        _node("GatherElements", "node_values cell_address", "cell_stored"),
        _node("Cast", "cell_stored", "cell_value", to=TensorProto.INT32),
        # The few points whose cell is split or has a list; for the others that value is the answer.
        *_where_true("GreaterOrEqual", "cell_value first_child_value", "pending"),
        *_part_nodes(),
        *_list_nodes(),
        _node("ScatterElements", "cell_value pending pending_value", "value", axis=0),
        # certain, or open with the answer at the centre
        _node("Less", "value codes", "certain"),
        _node("GatherElements", "value_instance value", "instance"),
        _node("GatherElements", "value_distance value", "distance"),
        _node("GatherElements", "value_answer value", "answer"),
        _node("GatherElements", "code_label answer", "label"),
        _node("GatherElements", "code_score answer", "score"),
    ]


def _part_nodes() -> list[onnx.NodeProto]:
    """pending, indices of points -> part_value, of the part of the cell; child, number of what settles it, if any."""
    return [
        *_columns_at("rows", "pending", "pending_rows"),
        *_rows_apart("pending_rows", "point"),
        _node("GatherElements", "cell_value pending", "pending_cell_value"),
        _node("GatherElements", "brick_reference pending", "pending_brick_reference"),
        *_child_nodes("pending_brick_reference", "pending_cell_value", "cell_child"),
        # A reference, as a brick's: the cell's row if it is split, else beyond the last row for its list.
        _node("GatherElements", "child_length cell_child", "cell_child_length"),
        _node("GatherElements", "child_start cell_child", "cell_child_start"),
        _node("Cast", "cell_child_length", "cell_child_length_int32", to=TensorProto.INT32),
        _node("Less", "cell_child_length_int32 one_int32", "cell_split"),
        _node("Add", "cell_child row_count", "cell_list_reference"),
        _node("Where", "cell_split cell_child_start cell_list_reference", "cell_reference"),
        # Where in the cell the point is, in parts.
        _node("Sub", "pending_rows grid_low", "pending_offset"),
        _node("Mul", "pending_offset cells_per_unit", "pending_position"),
        _node("Mul", "pending_position edge", "part_position"),
        _node("Cast", "part_position", "part", to=TensorProto.INT32),
        _node("Cast", "pending_position", "pending_cell", to=TensorProto.INT32),
        _node("Mul", "pending_cell edge_int32", "first_part"),
        _node("Sub", "part first_part", "part_in_cell"),  # Mod takes ten times as long
        _node("Mul", "part_in_cell part_strides", "part_terms"),
        *_sum_of_rows("part_terms", "part_place"),
        _node("Min", "cell_reference last_row", "cell_row"),
        _node("Mul", "cell_row children", "cell_start"),
        _node("Add", "cell_start part_place", "part_address"),
        _node("GatherElements", "node_values part_address", "part_stored"),
        _node("Cast", "part_stored", "part_value", to=TensorProto.INT32),
        *_child_nodes("cell_reference", "part_value", "child_or_less"),
        _node("Max", "child_or_less zero_int32", "child"),  # below 0, and unused, for parts that are answered
    ]


def _child_nodes(reference: str, value: str, output: str) -> list[onnx.NodeProto]:
    """A box's reference, and the value in it -> number of the child: first of the row + value - 2 codes, or, of a
    reference to a list, for which the last row says -1 and 2 codes, how far it lies beyond that row."""
    return [
        _node("Min", f"{reference} last_row", f"{output}_row"),
        _node("GatherElements", f"first_child {output}_row", f"{output}_first"),
        _node("Sub", f"{value} first_child_value", f"{output}_in_box"),
        _node("Add", f"{output}_first {output}_in_box", f"{output}_of_row"),
        _node("Sub", f"{reference} {output}_row", f"{output}_beyond"),
        _node("Add", f"{output}_of_row {output}_beyond", output),
    ]


def _list_nodes() -> list[onnx.NodeProto]:
    """part_value, child -> pending_value: of points with a list, the code of the nearest candidate.

    As many entries are read of every list: LIST_LENGTHS' first, then, of longer lists, all again up to the next.
    """
    nodes = [
        _node("GatherElements", "child_start child", "list_start"),
        _node("GatherElements", "child_length child", "list_length_stored"),
        _node("Cast", "list_length_stored", "list_length", to=TensorProto.INT32),
        _node("Less", "part_value first_child_value", "part_answered"),
        _node("Where", "part_answered zero_int32 list_length", "length"),
    ]
    value, longer_than = "part_value", "zero_int32"
    for name in LIST_LENGTHS:
        nodes += [*_where_true("Greater", f"length {longer_than}", f"{name}_rows"), *_search_nodes(name)]
        nodes += [_node("ScatterElements", f"{value} {name}_rows {name}_code", f"value_after_{name}", axis=0)]
        value, longer_than = f"value_after_{name}", f"{name}_length"
    return [*nodes, _node("Identity", value, "pending_value")]


def _search_nodes(name: str) -> list[onnx.NodeProto]:
    """{name}_rows of the pending points -> {name}_code, that of the nearest in each one's list, decided in float64.

    {name}_steps 0..K-1 reads K entries of every list. Of a shorter one it runs on into the next: farther points, or the
    same ones again.
    """

    def own(names: str) -> str:
        return " ".join(given[1:] if given.startswith("/") else f"{name}_{given}" for given in names.split())

    def node(operator: str, inputs: str, output: str, **attributes: Any) -> onnx.NodeProto:
        return _node(operator, own(inputs), own(output), **attributes)

    distance = []
    for axis in "xyz":
        distance += [
            node("GatherElements", f"/candidate_{axis} candidate", f"{axis}"),
            node("Cast", f"{axis}", f"{axis}_double", to=TensorProto.DOUBLE),
            node("Reshape", f"{axis}_double candidate_shape", f"{axis}_table"),
            node("GatherElements", f"/point_{axis} rows", f"{axis}_asked"),
            node("Cast", f"{axis}_asked", f"{axis}_asked_double", to=TensorProto.DOUBLE),
            node("Unsqueeze", f"{axis}_asked_double /last_axis", f"{axis}_column"),
            node("Sub", f"{axis}_table {axis}_column", f"{axis}_difference"),
            node("Mul", f"{axis}_difference {axis}_difference", f"{axis}_squared"),
        ]
    return [
        node("GatherElements", "/list_start rows", "start"),
        node("Unsqueeze", "start /last_axis", "start_column"),
        node("Add", "start_column steps", "candidate_address"),
        node("Shape", "candidate_address", "candidate_shape"),
        node("Reshape", "candidate_address /flat", "candidate_address_flat"),
        node("GatherElements", "/candidates_low candidate_address_flat", "candidate_low_stored"),
        node("Cast", "candidate_low_stored", "candidate_low", to=TensorProto.INT32),
        node("GatherElements", "/candidates_high candidate_address_flat", "candidate_high_stored"),
        node("Cast", "candidate_high_stored", "candidate_high_steps", to=TensorProto.INT32),
        node("Mul", "candidate_high_steps /high_step", "candidate_high"),
        node("Add", "candidate_low candidate_high", "candidate"),
        *distance,
        node("Add", "x_squared y_squared", "xy_squared"),
        node("Add", "xy_squared z_squared", "squared"),
        # Lists ascend by point number, so the first of equals is the lowest.
        node("ArgMin", "squared", "nearest", axis=1),
        node("GatherElements", "squared nearest", "nearest_squared", axis=1),
        node("Reshape", "candidate candidate_shape", "candidate_table"),
        node("GatherElements", "candidate_table nearest", "nearest_candidate", axis=1),
        node("Reshape", "nearest_candidate /flat", "nearest_flat"),
        node("Reshape", "nearest_squared /flat", "nearest_squared_flat"),
        node("GatherElements", "/candidate_answer nearest_flat", "answer_stored"),
        node("Cast", "answer_stored", "answer", to=TensorProto.INT32),
        node("Add", "answer /near_codes", "answer_near"),
        node("LessOrEqual", "nearest_squared_flat /surface_squared", "on_surface"),
        node("Where", "on_surface answer answer_near", "answer_within"),
        node("LessOrEqual", "nearest_squared_flat /reach_squared", "within_reach"),
        node("Where", "within_reach answer_within /too_far", "code"),
    ]


def _rows_apart(table: str, name: str) -> list[onnx.NodeProto]:
    """(3, m) -> name_x, name_y, name_z, (m,) each."""
    rows = [f"{name}_row_{axis}" for axis in "xyz"]
    return [
        helper.make_node("Split", [table], rows, name=f"{name}_rows", axis=0, num_outputs=3),
        *(_node("Reshape", f"{row} flat", f"{name}_{axis}") for row, axis in zip(rows, "xyz", strict=True)),
    ]


def _sum_of_rows(table: str, output: str) -> list[onnx.NodeProto]:
    """(3, m) -> (m,); twice as fast as ReduceSum."""
    return [
        *_rows_apart(table, output),
        _node("Add", f"{output}_x {output}_y", f"{output}_xy"),
        _node("Add", f"{output}_xy {output}_z", output),
    ]


def _where_true(comparison: str, inputs: str, output: str) -> list[onnx.NodeProto]:
    """Indices (m,) int32 where the comparison holds."""
    return [
        _node(comparison, inputs, f"{output}_mask"),
        _node("NonZero", f"{output}_mask", f"{output}_indices"),
        _node("Reshape", f"{output}_indices flat", f"{output}_flat"),
        _node("Cast", f"{output}_flat", output, to=TensorProto.INT32),
    ]


def _columns_at(table: str, columns: str, output: str) -> list[onnx.NodeProto]:
    """Those columns (m,) of a table of three rows, (3, m)."""
    return [
        _node("Shape", columns, f"{output}_count"),
        _node("Concat", f"three {output}_count", f"{output}_shape", axis=0),
        _node("Expand", f"{columns} {output}_shape", f"{output}_columns"),
        _node("GatherElements", f"{table} {output}_columns", output, axis=1),
    ]


def _lookup_constants(cloud: LabelledCloud, grid: LookupGrid) -> dict[str, Any]:
    codes, near_codes = grid.codes, grid.codes // 2
    point, candidate = np.unique(grid.candidates, return_inverse=True)
    xyz = cloud.xyz[point] if len(point) else np.zeros((1, 3), np.float32)
    answer = cloud.instance_ids[point] + CODE_OFFSET if len(point) else np.zeros(1, np.int64)
    code = np.arange(2 * codes) % codes
    code_answer = np.where(code > near_codes, code - near_codes, code)
    distance = np.where(code == TOO_FAR_CODE, BEYOND, np.where(code > near_codes, NEAR, ON_SURFACE))
    block_row = grid.blocks.ravel().astype(np.int64)
    return {
        # where a point is
        "grid_low": grid.low[:, None],
        "cells_per_unit": np.float32(1) / grid.cell_size,
        "last_cell": (np.array(grid.shape) * EDGE - 1).astype(np.int32)[:, None],
        "axis_places": _axis_places(grid),
        "cells_per_block": np.int32(CHILDREN**2),
        "children": np.int32(CHILDREN),
        "edge": np.float32(EDGE),
        "edge_int32": np.int32(EDGE),
        "part_strides": np.array([[EDGE**2], [EDGE], [1]], np.int32),
        # boxes
        "block_shifts": ((block_row - np.arange(len(block_row))) * CHILDREN).astype(np.int32),
        "brick_values": grid.bricks.ravel(),
        "node_values": grid.nodes.ravel(),
        "last_row": np.int32(len(grid.nodes) - 1),
        "row_count": np.int32(len(grid.nodes)),
        "codes": np.int32(codes),
        "first_child_value": np.int32(2 * codes),
        "first_child": grid.first_child,
        "child_length": grid.child_length,
        "child_start": grid.child_start,
        # candidates; a search may read LONGEST_LIST entries from the start of the last list
        **_in_three_bytes("candidates", np.append(candidate, np.zeros(LONGEST_LIST, np.int64))),
        **{f"candidate_{axis}": np.ascontiguousarray(xyz[:, row]) for row, axis in enumerate("xyz")},
        "candidate_answer": answer.astype(np.min_scalar_type(int(answer.max()))),
        **{f"{name}_steps": np.arange(length, dtype=np.int32)[None] for name, length in LIST_LENGTHS.items()},
        **{f"{name}_length": np.int32(length) for name, length in LIST_LENGTHS.items()},
        "reach_squared": np.float64(cloud.reach) ** 2,
        "surface_squared": np.float64(surface_distance(cloud.spacing, cloud.reach)) ** 2,
        # answers
        "near_codes": np.int32(near_codes),
        "too_far": np.int32(TOO_FAR_CODE),
        "value_instance": (code_answer - CODE_OFFSET).astype(np.int32),
        "value_distance": distance.astype(np.int8),
        "value_answer": code_answer.astype(np.int32),
        "one_int32": np.int32(1),
        "three": np.array([3], np.int64),
        "flat": np.array([-1], np.int64),
    }


def _in_three_bytes(name: str, values: NDArray[np.integer]) -> dict[str, Any]:
    """Indices below 2^24, as almost all are, in three bytes instead of four; the high part takes what it needs."""
    high = values >> 16
    constants: dict[str, Any] = {
        f"{name}_low": (values & 0xFFFF).astype(np.uint16),
        f"{name}_high": high.astype(np.min_scalar_type(int(high.max()))),
        "high_step": np.int32(1 << 16),
    }
    return constants


def _axis_places(grid: LookupGrid) -> NDArray[np.int32]:
    """(3, cells along the longest axis) int32; see ``_lookup_nodes``."""
    _, blocks_y, blocks_z = grid.blocks.shape
    cell = np.arange(max(grid.shape) * EDGE)
    block, brick, inside = cell // EDGE**2, cell // EDGE % EDGE, cell % EDGE
    block_strides, strides = (np.array([[x], [y], [1]]) for x, y in ((blocks_y * blocks_z, blocks_z), (EDGE**2, EDGE)))
    place = (block * block_strides * CHILDREN + brick * strides) * CHILDREN + inside * strides
    in_grid = cell < np.array(grid.shape)[:, None] * EDGE  # the table's remainder is never read
    return np.where(in_grid, place, 0).astype(np.int32)
