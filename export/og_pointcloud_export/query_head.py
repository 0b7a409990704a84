"""query.onnx: one graph that answers text for points, and stands alone in any program with an ONNX runtime.

Inputs
  points (N, 3) float32   in the bundle's local frame: world minus ``frame.origin`` of the manifest; NaN is too far
  text   (L, D) float32   one vector a label, of any length; a zero vector is like nothing
Outputs
  label           (N,) int32      row of ``text``, -1 unknown
  score           (N,) float32    cosine of that label, 0 where unknown
  instance        (N,) int32      instance id, -1 background, -2 unobserved, -3 too far from the cloud
  certain         (N,) bool       false: close to a border, the answer is that of the cell's centre (see brick_grid)
  instance_scores (K, L) float32  best cosine of an instance's descriptors with each text, -2 without a descriptor
Any of N, L and K may be 0.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.bundle import NO_EVIDENCE
from og_pointcloud.cloud import InstanceTable, LabelledCloud
from og_pointcloud.errors import MissingExtraError
from og_pointcloud_export.brick_grid import BRICK, CODE_OFFSET, PARTS, BrickGrid

try:
    import onnx
    from onnx import TensorProto, helper, numpy_helper
except ImportError as error:
    raise MissingExtraError("onnx", "fit") from error

__all__ = ["OPSET", "build_query_head", "reference_scores"]

OPSET, IR_VERSION = 18, 8
"""The oldest that has everything needed (ScatterElements with max), so that onnxruntime 1.17 and later run it."""


def build_query_head(cloud: LabelledCloud, grid: BrickGrid) -> bytes:
    """The serialised graph of a cloud; inputs and outputs are described above."""
    nodes = [*_score_nodes(), *_lookup_nodes()]
    constants = {**_score_constants(cloud.instances), **_lookup_constants(grid)}
    inputs = [
        helper.make_tensor_value_info("points", TensorProto.FLOAT, ["N", 3]),
        helper.make_tensor_value_info("text", TensorProto.FLOAT, ["L", constants["descriptors"].shape[1]]),
    ]
    outputs = [
        helper.make_tensor_value_info("label", TensorProto.INT32, ["N"]),
        helper.make_tensor_value_info("score", TensorProto.FLOAT, ["N"]),
        helper.make_tensor_value_info("instance", TensorProto.INT32, ["N"]),
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
    return helper.make_node(operator, inputs.split(), [output], **attributes)


def _score_nodes() -> list[onnx.NodeProto]:
    """text -> instance_scores, and the label and score of each answer code (too far, unobserved, background, 0..)."""
    return [
        # Unit length, in two steps so that neither tiny nor huge vectors leave float32.
        _node("Abs", "text", "text_magnitude"),
        _node("ReduceMax", "text_magnitude last_axis", "text_largest"),
        _node("Max", "text_largest smallest_normal", "text_scale"),
        _node("Div", "text text_scale", "text_scaled"),
        _node("ReduceL2", "text_scaled last_axis", "text_length"),
        _node("Max", "text_length smallest_normal", "text_divisor"),
        _node("Div", "text_scaled text_divisor", "text_unit"),
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
    descriptors = instances.descriptors
    if descriptors.shape[1] == 0:  # nothing was ever described: any one column will do
        descriptors = np.zeros((0, 1), np.float32)
    return {
        "descriptors": np.ascontiguousarray(descriptors, np.float32),
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
    """points -> answer code through the grid -> instance, certain, label and score.

    Coordinates are laid out as three rows of N: several times as fast as N rows of three, and, unlike a product with
    the strides, exact in integers wherever it runs.
    """
    return [
        _node("Transpose", "points", "rows", perm=[1, 0]),
        _node("Sub", "rows grid_low", "offset"),
        _node("Mul", "offset parts_per_unit", "position"),
        _node("IsNaN", "position", "position_missing"),
        _node("Where", "position_missing zero position", "position_known"),
        _node("Max", "position_known zero", "position_above"),
        _node("Min", "position_above last_part", "position_inside"),
        _node("Cast", "position_inside", "part", to=TensorProto.INT32),
        _node("Div", "part parts", "cell"),
        _node("Div", "cell brick_edge", "brick"),
        # brick -> its row of cells -> the cell's value
        *_flat_index("brick", "brick_strides", "brick_index"),
        _node("Gather", "brick_rows brick_index", "brick_row"),
        *_remainder("cell", "brick", "brick_edge", "cell_in_brick"),
        *_flat_index("cell_in_brick", "cell_strides", "cell_index"),
        *_entry("cell_values", "brick_row", "cells_per_brick", "cell_index", "cell_value"),
        # a split cell -> its row of parts -> the part's value
        _node("Sub", "cell_value first_split", "split"),
        _node("Max", "split zero_int32", "split_row"),
        *_remainder("part", "cell", "parts", "part_in_cell"),
        *_flat_index("part_in_cell", "part_strides", "part_index"),
        *_entry("part_values", "split_row", "parts_per_cell", "part_index", "part_value"),
        _node("Less", "cell_value first_split", "cell_is_whole"),
        _node("Where", "cell_is_whole cell_value part_value", "value"),
        # certain, or open with the answer at the centre
        _node("Less", "value codes", "certain"),
        _node("Sub", "value codes", "value_at_center"),
        _node("Where", "certain value value_at_center", "code"),
        _node("Sub", "code code_offset", "instance"),
        _node("Gather", "code_label code", "label"),
        _node("Gather", "code_score code", "score"),
    ]


def _remainder(fine: str, coarse: str, factor: str, output: str) -> list[onnx.NodeProto]:
    """fine - coarse * factor: the index within."""
    return [_node("Mul", f"{coarse} {factor}", f"{output}_start"), _node("Sub", f"{fine} {output}_start", output)]


def _flat_index(index: str, strides: str, output: str) -> list[onnx.NodeProto]:
    """Three rows of indices -> one row."""
    return [
        _node("Mul", f"{index} {strides}", f"{output}_terms"),
        _node("ReduceSum", f"{output}_terms first_axis", output, keepdims=0),
    ]


def _entry(table: str, row: str, width: str, column: str, output: str) -> list[onnx.NodeProto]:
    """table[row, column] of a flat table of rows of that width, as int32."""
    return [
        _node("Cast", row, f"{output}_row", to=TensorProto.INT32),
        _node("Mul", f"{output}_row {width}", f"{output}_start"),
        _node("Add", f"{output}_start {column}", f"{output}_address"),
        _node("Gather", f"{table} {output}_address", f"{output}_stored"),
        _node("Cast", f"{output}_stored", output, to=TensorProto.INT32),
    ]


def _lookup_constants(grid: BrickGrid) -> dict[str, Any]:
    shape = np.array(grid.bricks.shape, np.int32)
    return {
        "grid_low": grid.low[:, None],
        "parts_per_unit": np.float32(PARTS) / grid.cell_size,
        "last_part": (shape * BRICK * PARTS - 1).astype(np.float32)[:, None],
        "parts": np.int32(PARTS),
        "brick_edge": np.int32(BRICK),
        "brick_strides": np.array([[shape[1] * shape[2]], [shape[2]], [1]], np.int32),
        "cell_strides": np.array([[BRICK**2], [BRICK], [1]], np.int32),
        "part_strides": np.array([[PARTS**2], [PARTS], [1]], np.int32),
        "cells_per_brick": np.int32(BRICK**3),
        "parts_per_cell": np.int32(PARTS**3),
        "brick_rows": grid.bricks.ravel(),
        "cell_values": grid.cells.ravel(),
        "part_values": grid.parts.ravel(),
        "codes": np.int32(grid.codes),
        "first_split": np.int32(2 * grid.codes),
        "code_offset": np.int32(CODE_OFFSET),
    }


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
