"""query.onnx: one graph that answers text for points, and stands alone in any program with an ONNX runtime.

Inputs
  points (N, 3) float32   in the bundle's local frame: world minus ``frame.origin`` of the manifest; NaN is too far
  text   (L, D) float32   one vector a label, of any length; a zero vector is like nothing
Outputs
  label           (N,) int32      row of ``text``, -1 unknown
  score           (N,) float32    cosine of that label, 0 where unknown
  instance        (N,) int32      instance id, -1 background, -2 unobserved, -3 too far from the cloud
  distance        (N,) int8       0 on the surface, 1 near it, 2 too far; between 0 and 1 to about a cell (brick_grid)
  certain         (N,) bool       false, rarely: the table has no room for this cell, the answer is its centre's
  instance_scores (K, L) float32  best cosine of an instance's descriptors with each text, -2 without a descriptor
Any of N, L and K may be 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.bundle.nearest import surface_distance
from og_pointcloud.bundle.read import BEYOND, NEAR, ON_SURFACE
from og_pointcloud.cloud import NO_EVIDENCE, InstanceTable, LabelledCloud
from og_pointcloud.errors import MissingExtraError
from og_pointcloud_export.brick_cells import BLOCK, BRICK, PARTS, TOO_FAR_CODE
from og_pointcloud_export.brick_grid import CELLS, CODE_OFFSET, LONGEST_LIST, PLACES, SHORT_LIST, BrickGrid

try:
    import onnx
    from onnx import TensorProto, helper, numpy_helper
except ImportError as error:
    raise MissingExtraError("onnx", "fit") from error

__all__ = ["OPSET", "ScoreHead", "build_query_head", "reference_scores"]

MIDDLE_LIST = 20
"""So many candidates are compared where the list is longer than SHORT_LIST, LONGEST_LIST where it is longer still."""
OPSET, IR_VERSION = 18, 8
"""The oldest that has everything needed (ScatterElements with max), so that onnxruntime 1.17 and later run it."""


@dataclass(frozen=True)
class ScoreHead:
    """How text meets the descriptors; the default changes nothing, the others trade error for size.

    width: dimensions that text and descriptors are reduced to, those in which the descriptors differ most; with as many
        as there are descriptors nothing is lost. None: all.
    centred: the mean descriptor is taken off both first, a different cosine, which spreads scores wider.
    precision: of the stored descriptors; int8 with a scale each.
    """

    width: int | None = None
    centred: bool = False
    precision: Literal["float32", "float16", "int8"] = "float32"


def build_query_head(cloud: LabelledCloud, grid: BrickGrid, head: ScoreHead | None = None) -> bytes:
    """The serialised graph of a cloud; inputs and outputs are described above."""
    head = head or ScoreHead()
    nodes = [*_text_nodes(head), *_descriptor_nodes(head), *_score_nodes(), *_lookup_nodes()]
    text_width = max(cloud.instances.descriptors.shape[1], 1)
    constants = {**_score_constants(cloud.instances, head), **_lookup_constants(cloud, grid)}
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


def _text_nodes(head: ScoreHead) -> list[onnx.NodeProto]:
    """text -> text_columns, what each descriptor is multiplied with."""
    nodes, last = _unit_nodes("text"), "text_unit"
    if head.centred:
        nodes += [_node("Sub", f"{last} center", "text_centred"), *_unit_nodes("text_centred")]
        last = "text_centred_unit"
    if head.width is not None:
        nodes += [_node("MatMul", f"{last} projection", "text_projected")]
        last = "text_projected"
    return [*nodes, _node("Transpose", last, "text_columns", perm=[1, 0])]


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


def _descriptor_nodes(head: ScoreHead) -> list[onnx.NodeProto]:
    """descriptors -> table, in float32."""
    if head.precision == "float32":
        return [_node("Identity", "descriptors", "table")]
    if head.precision == "float16":
        return [_node("Cast", "descriptors", "table", to=TensorProto.FLOAT)]
    return [
        _node("Cast", "descriptors", "descriptor_steps", to=TensorProto.FLOAT),
        _node("Mul", "descriptor_steps descriptor_scale", "table"),
    ]


def _score_nodes() -> list[onnx.NodeProto]:
    """table -> instance_scores, and the label and score of each answer code (too far, unobserved, background, 0..)."""
    return [
        _node("MatMul", "table text_columns", "similarity"),
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


def _score_constants(instances: InstanceTable, head: ScoreHead) -> dict[str, Any]:
    codes = len(instances) + CODE_OFFSET
    return {
        **_table_constants(instances.descriptors, head),
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


def _table_constants(descriptors: NDArray[np.float32], head: ScoreHead) -> dict[str, NDArray[Any]]:
    if descriptors.shape[1] == 0:  # nothing was ever described: any one column will do
        descriptors = np.zeros((0, 1), np.float32)
    constants: dict[str, NDArray[Any]] = {}
    table = descriptors.astype(np.float64)
    if head.centred:
        center = table.mean(axis=0) if len(table) else np.zeros(table.shape[1])
        length = np.linalg.norm(table - center, axis=1, keepdims=True)
        table = np.divide(table - center, length, out=np.zeros_like(table), where=length > 0)
        constants["center"] = center.astype(np.float32)
    if head.width is not None:
        directions = np.linalg.svd(table, full_matrices=False)[2][: head.width]
        table = table @ directions.T
        constants["projection"] = np.ascontiguousarray(directions.T, np.float32)
    if head.precision == "int8":
        scale = np.maximum(np.abs(table).max(axis=1, keepdims=True, initial=0), np.finfo(np.float32).tiny) / 127
        constants["descriptor_scale"] = scale.astype(np.float32)
        table = np.round(table / scale)
    return constants | {"descriptors": np.ascontiguousarray(table, head.precision)}


def _lookup_nodes() -> list[onnx.NodeProto]:
    """points -> answer code, by the table and, for the few points in open cells, by their lists -> the outputs.

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
        # Along each axis, cell -> what it adds to (block * 64 + place of the brick in it) * 64 + that of the cell.
        _node("GatherElements", "axis_places cell", "place_terms", axis=1),
        *_sum_of_rows("place_terms", "place"),
        _node("Div", "place cells_per_block", "block"),
        _node("Div", "place cells_per_brick", "brick"),
        _node("GatherElements", "block_shifts block", "brick_shift"),
        _node("Add", "brick brick_shift", "brick_address"),
        _node("GatherElements", "brick_values brick_address", "brick_stored"),
        _node("Cast", "brick_stored", "brick_value", to=TensorProto.INT32),
        # A brick that is a list alone has the last row, which says so for all its cells.
        _node("Min", "brick_value last_row", "cells_row"),
        _node("Sub", "cells_row brick", "row_shift"),
        _node("Mul", "row_shift cells_per_brick", "address_shift"),
        _node("Add", "place address_shift", "address"),
        _node("GatherElements", "cell_values address", "cell_stored"),
        _node("Cast", "cell_stored", "cell_value", to=TensorProto.INT32),
        *_open_cell_nodes(),
        # certain, or open with the answer at the centre
        _node("Less", "value codes", "certain"),
        _node("GatherElements", "value_instance value", "instance"),
        _node("GatherElements", "value_distance value", "distance"),
        _node("GatherElements", "value_answer value", "answer"),
        _node("GatherElements", "code_label answer", "label"),
        _node("GatherElements", "code_score answer", "score"),
    ]


def _open_cell_nodes() -> list[onnx.NodeProto]:
    """cell_value -> value: the same, but for cells with a list the answer of the part, or else of the list."""
    return [
        *_where_true("GreaterOrEqual", "cell_value first_listed", "listed"),
        *_columns_at("rows", "listed", "listed_rows"),
        *_rows_apart("listed_rows", "point"),
        _node("GatherElements", "cell_value listed", "listed_value"),
        # row's first list + the cell's own -> its list; of a list alone, both come to -1
        _node("GatherElements", "cells_row listed", "listed_row"),
        _node("GatherElements", "first_list listed_row", "listed_first"),
        _node("Sub", "listed_value first_listed", "listed_number"),
        _node("Add", "listed_first listed_number", "list_of_cell"),
        _node("GatherElements", "brick_value listed", "listed_brick_value"),
        _node("Sub", "listed_brick_value last_row", "listed_beyond_rows"),
        _node("Max", "listed_beyond_rows zero_int32", "list_alone"),
        _node("Add", "list_of_cell list_alone", "list"),
        # the part of the cell, and its value
        _node("Sub", "listed_rows grid_low", "listed_offset"),
        _node("Mul", "listed_offset cells_per_unit", "listed_position"),
        _node("Mul", "listed_position parts_per_cell_edge", "part_position"),
        _node("Cast", "part_position", "part", to=TensorProto.INT32),
        _node("Cast", "listed_position", "listed_cell", to=TensorProto.INT32),
        _node("Mul", "listed_cell parts_edge", "first_part"),
        _node("Sub", "part first_part", "part_in_cell"),  # Mod takes ten times as long
        _node("Mul", "part_in_cell part_strides", "part_terms"),
        *_sum_of_rows("part_terms", "part_index"),
        _node("GatherElements", "list_parts list", "list_parts_stored"),
        _node("Cast", "list_parts_stored", "parts_row", to=TensorProto.INT32),
        _node("Mul", "parts_row parts_per_cell", "parts_start"),
        _node("Add", "parts_start part_index", "part_address"),
        _node("GatherElements", "part_values part_address", "part_stored"),
        _node("Cast", "part_stored", "part_value", to=TensorProto.INT32),
        # open parts: compare the distances of the list's points, as many as it has at most
        _node("Sub", "part_value codes", "part_beyond_codes"),
        _node("Max", "part_beyond_codes zero_int32", "list_of_part"),
        _node("Add", "list list_of_part", "part_list"),
        _node("GatherElements", "list_start part_list", "listed_start"),
        _node("Add", "part_list one_int32", "next_list"),
        _node("GatherElements", "list_start next_list", "listed_end"),
        _node("Sub", "listed_end listed_start", "listed_length"),
        _node("Less", "part_value codes", "part_certain"),
        _node("Where", "part_certain zero_int32 listed_length", "length_to_search"),
        *_where_true("Greater", "length_to_search zero_int32", "short_rows"),
        *_search_nodes("short"),
        _node("ScatterElements", "part_value short_rows short_code", "value_after_short", axis=0),
        *_where_true("Greater", "length_to_search short_length", "middle_rows"),
        *_search_nodes("middle"),
        _node("ScatterElements", "value_after_short middle_rows middle_code", "value_after_middle", axis=0),
        *_where_true("Greater", "length_to_search middle_length", "long_rows"),
        *_search_nodes("long"),
        _node("ScatterElements", "value_after_middle long_rows long_code", "listed_code", axis=0),
        _node("ScatterElements", "cell_value listed listed_code", "value", axis=0),
    ]


def _search_nodes(name: str) -> list[onnx.NodeProto]:
    """{name}_rows of the listed points -> {name}_code, that of the nearest in each one's list, decided in float64.

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
        node("GatherElements", "/listed_start rows", "start"),
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


def _lookup_constants(cloud: LabelledCloud, grid: BrickGrid) -> dict[str, Any]:
    shape = np.array(grid.shape, np.int64)
    codes, near_codes = grid.codes, grid.codes // 2
    # A search may read LONGEST_LIST entries from the start of the last list.
    point, candidate = np.unique(grid.candidates, return_inverse=True)
    xyz = cloud.xyz[point] if len(point) else np.zeros((1, 3), np.float32)
    answer = cloud.instance_ids[point] + CODE_OFFSET if len(point) else np.zeros(1, np.int64)
    code = np.arange(2 * codes) % codes
    code_answer = np.where(code > near_codes, code - near_codes, code)
    return {
        "grid_low": grid.low[:, None],
        "cells_per_unit": np.float32(1) / grid.cell_size,
        "last_cell": (shape * BRICK - 1).astype(np.int32)[:, None],
        "axis_places": _axis_places(grid),
        "block_shifts": ((grid.blocks.ravel().astype(np.int64) - np.arange(grid.blocks.size)) * PLACES).astype(
            np.int32
        ),
        "brick_values": grid.bricks.ravel(),
        "last_row": np.int32(len(grid.cells) - 1),
        "cells_per_block": np.int32(CELLS * PLACES),
        "cells_per_brick": np.int32(CELLS),
        "cell_values": grid.cells.ravel(),
        "codes": np.int32(codes),
        "first_listed": np.int32(2 * codes),
        "first_list": grid.first_list,
        "list_start": grid.list_start,
        "list_parts": grid.list_parts,
        "parts_per_cell_edge": np.float32(PARTS),
        "parts_edge": np.int32(PARTS),
        "part_strides": np.array([[PARTS**2], [PARTS], [1]], np.int32),
        "parts_per_cell": np.int32(PARTS**3),
        "part_values": grid.parts.ravel(),
        **_in_three_bytes("candidates", np.append(candidate, np.zeros(LONGEST_LIST, np.int64))),
        **{f"candidate_{axis}": np.ascontiguousarray(xyz[:, row]) for row, axis in enumerate("xyz")},
        "candidate_answer": answer.astype(np.min_scalar_type(int(answer.max()))),
        "short_steps": np.arange(SHORT_LIST, dtype=np.int32)[None],
        "short_length": np.int32(SHORT_LIST),
        "middle_steps": np.arange(MIDDLE_LIST, dtype=np.int32)[None],
        "middle_length": np.int32(MIDDLE_LIST),
        "long_steps": np.arange(LONGEST_LIST, dtype=np.int32)[None],
        "reach_squared": np.float64(cloud.reach) ** 2,
        "surface_squared": np.float64(surface_distance(cloud.spacing, cloud.reach)) ** 2,
        "near_codes": np.int32(near_codes),
        "too_far": np.int32(TOO_FAR_CODE),
        "value_instance": (code_answer - CODE_OFFSET).astype(np.int32),
        "value_distance": np.where(code == TOO_FAR_CODE, BEYOND, np.where(code > near_codes, NEAR, ON_SURFACE)).astype(
            np.int8
        ),
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


def _axis_places(grid: BrickGrid) -> NDArray[np.int32]:
    """(3, cells along the longest axis) int32; see ``_lookup_nodes``."""
    _, blocks_y, blocks_z = grid.blocks.shape
    cell = np.arange(max(grid.shape) * BRICK)
    block, brick, inside = cell // (BRICK * BLOCK), cell // BRICK % BLOCK, cell % BRICK
    block_strides = np.array([[blocks_y * blocks_z], [blocks_z], [1]])
    brick_strides, cell_strides = (np.array([[edge**2], [edge], [1]]) for edge in (BLOCK, BRICK))
    place = (block * block_strides * PLACES + brick * brick_strides) * CELLS + inside * cell_strides
    in_grid = cell < np.array(grid.shape)[:, None] * BRICK  # the table's remainder is never read
    return np.where(in_grid, place, 0).astype(np.int32)


def reference_scores(instances: InstanceTable, text: NDArray[np.floating]) -> NDArray[np.float64]:
    """(K, L) float64: what ``instance_scores`` should be, written down plainly in numpy."""
    scores = np.full((len(instances), len(text)), NO_EVIDENCE, np.float64)
    text = text.astype(np.float64)
    length = np.linalg.norm(text, axis=1, keepdims=True)
    unit = np.divide(text, length, out=np.zeros_like(text), where=length > 0)
    for descriptor, instance in zip(
        instances.descriptors.astype(np.float64), instances.descriptor_instance, strict=True
    ):
        scores[instance] = np.maximum(scores[instance], unit @ descriptor)
    return scores
