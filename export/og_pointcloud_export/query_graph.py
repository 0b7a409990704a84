"""query.onnx: one graph that answers text for points, and stands alone in any program with an ONNX runtime.

Inputs
  points (N, 3) float32   in the bundle's local frame: world minus ``frame.origin`` of the manifest; NaN is too far
  text   (L, D) float32   one vector a label, of any length; a zero vector is like nothing
Outputs
  label           (N,) int32      row of ``text``, -1 unknown
  score           (N,) float32    cosine of that label, 0 where unknown
  instance        (N,) int32      instance id, -1 background, -2 unobserved, -3 too far from the cloud
  distance        (N,) int8       0 on the surface, 1 near it, 2 too far; between 0 and 1 to about a cell (lookup_grid)
  certain         (N,) bool       false, rarely: the table has no room for this cell, the answer is its center's
  instance_scores (K, L) float32  best cosine of an instance's descriptors with each text, -2 without a descriptor
Any of N, L and K may be 0.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.bundle.format import BEYOND_REACH, NEAR_SURFACE, ON_SURFACE
from og_pointcloud.bundle.nearest import surface_distance
from og_pointcloud.cloud import NO_EVIDENCE, InstanceTable, LabelledCloud
from og_pointcloud.errors import naming_extra
from og_pointcloud_export.lookup_boxes import CHILDREN, EDGE, MAX_LIST_LENGTH, MAX_SHARED_LIST_LENGTH, TOO_FAR_CODE
from og_pointcloud_export.lookup_grid import CODE_OFFSET, LookupGrid, compact

with naming_extra("onnx", "fit"):
    import onnx
    from onnx import TensorProto, helper, numpy_helper

LIST_LENGTHS = (MAX_SHARED_LIST_LENGTH, 20, MAX_LIST_LENGTH)
"""Candidates compared at once: the first number for every list, the next one for longer lists, and so on."""
OPSET, IR_VERSION = 18, 8
"""The oldest versions with all that is needed (ScatterElements with max), so onnxruntime 1.17 and later run them."""


def build_query_graph(cloud: LabelledCloud, grid: LookupGrid) -> bytes:
    """The serialised graph of a cloud; inputs and outputs are described above."""
    graph = _Graph()
    code_label, code_score = _score_labels(graph, cloud.instances)
    _Lookup(graph, cloud, grid).answer(code_label, code_score)
    inputs = [("points", TensorProto.FLOAT, ["N", 3]), ("text", TensorProto.FLOAT, ["L", _text_width(cloud.instances)])]
    outputs = [
        ("label", TensorProto.INT32, ["N"]),
        ("score", TensorProto.FLOAT, ["N"]),
        ("instance", TensorProto.INT32, ["N"]),
        ("distance", TensorProto.INT8, ["N"]),
        ("certain", TensorProto.BOOL, ["N"]),
        ("instance_scores", TensorProto.FLOAT, [len(cloud.instances), "L"]),
    ]
    declared = [
        [helper.make_tensor_value_info(name, kind, shape) for name, kind, shape in values]
        for values in (inputs, outputs)
    ]
    query_head = helper.make_graph(
        graph.nodes, "query_head", declared[0], declared[1], graph.initializers, doc_string=__doc__
    )
    model = helper.make_model(query_head, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="og_pointcloud")
    model.ir_version = IR_VERSION
    onnx.checker.check_model(model)
    return model.SerializeToString()


class _Graph:
    """Graph builder. A call adds a node and returns the name of its output, to be used as input of other nodes. Inputs
    that are numpy arrays or scalars become constants."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.initializers: list[onnx.TensorProto] = []
        self._scalars: dict[tuple[str, bytes], str] = {}

    def __call__(self, operator: str, *inputs: Any, name: str = "", **attributes: Any) -> str:
        name = name or f"{operator}_{len(self.nodes)}"
        names = [value if isinstance(value, str) else self._scalar(value) for value in inputs]
        self.nodes.append(helper.make_node(operator, names, [name], name=name, **attributes))
        return name

    def constant(self, name: str, value: Any) -> str:
        """Add a named constant."""
        self.initializers.append(numpy_helper.from_array(np.asarray(value), name))
        return name

    def _scalar(self, value: Any) -> str:
        """A small constant, shared by all nodes that use it."""
        array = np.asarray(value)
        key = f"{array.dtype.str}{array.shape}", array.tobytes()
        if key not in self._scalars:
            self._scalars[key] = self.constant(f"constant_{len(self._scalars)}", array)
        return self._scalars[key]

    def int32(self, value: str) -> str:
        return self("Cast", value, to=TensorProto.INT32)

    def double(self, value: str) -> str:
        return self("Cast", value, to=TensorProto.DOUBLE)

    def flat(self, value: str) -> str:
        return self("Reshape", value, FLAT)

    def at(self, table: str, index: str, **attributes: Any) -> str:
        """The table's entries at these indices, by GatherElements: in onnxruntime it takes a tenth of Gather's time."""
        return self("GatherElements", table, index, **attributes)

    def where_true(self, comparison: str, first: Any, second: Any) -> str:
        """Indices (m,) int32 where the comparison holds."""
        return self.int32(self.flat(self("NonZero", self(comparison, first, second))))

    def split_rows(self, table: str) -> list[str]:
        """(3, m) -> three times (m,)."""
        rows = [f"{table}_row_{axis}" for axis in "xyz"]
        self.nodes.append(helper.make_node("Split", [table], rows, name=f"{table}_rows", axis=0, num_outputs=3))
        return [self.flat(row) for row in rows]

    def sum_of_rows(self, table: str) -> str:
        """(3, m) -> (m,); twice as fast as ReduceSum."""
        x, y, z = self.split_rows(table)
        return self("Add", self("Add", x, y), z)

    def columns_at(self, table: str, columns: str) -> str:
        """(3, m), the columns with these indices (m,) of a table of three rows."""
        shape = self("Concat", np.array([3]), self("Shape", columns), axis=0)
        return self.at(table, self("Expand", columns, shape), axis=1)


FLAT, FIRST_AXIS, LAST_AXIS = np.array([-1]), np.array([0]), np.array([1])


def _text_width(instances: InstanceTable) -> int:
    return max(instances.descriptors.shape[1], 1)  # without any descriptor, one arbitrary column will do


def _unit_rows(graph: _Graph, rows: str) -> str:
    """Rows of unit length, in two steps so that tiny or huge vectors do not leave the range of float32."""
    smallest = np.finfo(np.float32).tiny
    scaled = graph("Div", rows, graph("Max", graph("ReduceMax", graph("Abs", rows), LAST_AXIS), smallest))
    return graph("Div", scaled, graph("Max", graph("ReduceL2", scaled, LAST_AXIS), smallest))


def _score_labels(graph: _Graph, instances: InstanceTable) -> tuple[str, str]:
    """text -> instance_scores; label and score of each answer code: too far, unobserved, background, 0.."""
    codes = len(instances) + CODE_OFFSET
    rows = np.ascontiguousarray(instances.descriptors.reshape(-1, _text_width(instances)), np.float32)
    descriptor_code = graph.constant(
        "descriptor_code", instances.descriptor_instance.astype(np.int64)[:, None] + CODE_OFFSET
    )
    text_columns = graph("Transpose", _unit_rows(graph, "text"), perm=[1, 0])
    similarity = graph("MatMul", graph.constant("descriptors", rows), text_columns)
    # The best descriptor of each instance; codes without one stay at NO_EVIDENCE.
    shape = graph("Concat", np.array([codes]), graph("Shape", "text", end=1), axis=0)
    empty = graph("Expand", np.float32(NO_EVIDENCE), shape)
    code_of_row = graph("Expand", descriptor_code, graph("Shape", similarity))
    scores = graph("ScatterElements", empty, code_of_row, similarity, axis=0, reduction="max")
    past_the_end = np.array([np.iinfo(np.int64).max])
    graph("Slice", scores, np.array([CODE_OFFSET]), past_the_end, FIRST_AXIS, name="instance_scores")
    # Column 0 means "unknown": it wins if no label has evidence, or there is no label at all.
    unknown = graph.constant("unknown_column", np.full((codes, 1), NO_EVIDENCE, np.float32))
    choices = graph("Concat", unknown, scores, axis=1)
    label = graph.int32(graph("Sub", graph("ArgMax", choices, axis=1, keepdims=0), np.int64(1)))
    best = graph("ReduceMax", choices, LAST_AXIS, keepdims=0)
    return label, graph("Where", graph("Less", label, np.int32(0)), np.float32(0), best)


class _Lookup:
    """points -> outputs: by the tables of ``LookupGrid`` and, for the few points in boxes with a list, by distances to
    its candidates.

    Coordinates are three rows of N, several times as fast as N rows of three. Integer sums of rows are exact on every
    runtime, which a matrix product with the strides is not.
    """

    def __init__(self, graph: _Graph, cloud: LabelledCloud, grid: LookupGrid) -> None:
        self.graph, self.cloud, self.grid = graph, cloud, grid
        self.first_child_value, self.last_row = np.int32(2 * grid.codes), np.int32(len(grid.nodes) - 1)
        for name in ("first_child", "child_length", "child_start"):
            graph.constant(name, getattr(grid, name))
        graph.constant("node_values", grid.nodes.ravel())
        graph.constant("grid_low", grid.low[:, None])
        # Candidates, renumbered: only the cloud's points that are in a list.
        point, candidate = np.unique(grid.candidates, return_inverse=True)
        xyz = cloud.xyz[point] if len(point) else np.zeros((1, 3), np.float32)
        answer = cloud.instance_ids[point] + CODE_OFFSET if len(point) else np.zeros(1, np.int64)
        for row, axis in enumerate("xyz"):
            graph.constant(f"candidate_{axis}", np.ascontiguousarray(xyz[:, row]))
        graph.constant("candidate_answer", compact(answer))
        # Indices below 2^24, which are almost all, take three bytes instead of four: the high part has the smallest
        # type that fits. A search may read MAX_LIST_LENGTH entries from the start of the last list, hence the padding.
        candidate = np.append(candidate, np.zeros(MAX_LIST_LENGTH, np.int64))
        graph.constant("candidates_low", (candidate & 0xFFFF).astype(np.uint16))
        graph.constant("candidates_high", compact(candidate >> 16))

    def answer(self, code_label: str, code_score: str) -> None:
        """Add all outputs but instance_scores."""
        graph, grid = self.graph, self.grid
        rows = graph("Transpose", "points", perm=[1, 0])
        # Integers are clamped: whatever NaN, infinity or 1e30 are cast to, they end up in the outermost layer.
        last_cell = graph.constant("last_cell", (np.array(grid.shape) * EDGE - 1).astype(np.int32)[:, None])
        cell = graph("Min", graph("Max", graph.int32(self._position(rows)), np.int32(0)), last_cell)
        # Along each axis, cell -> what it adds to (block * 64 + brick in the block) * 64 + cell in the brick.
        place = graph.sum_of_rows(graph.at(graph.constant("axis_places", _axis_places(grid)), cell, axis=1))
        block, brick = graph("Div", place, np.int32(CHILDREN**2)), graph("Div", place, np.int32(CHILDREN))
        # block -> its row of brick_values, less its number, times 64; brick -> its reference
        block_row = grid.blocks.ravel().astype(np.int64)
        shifts = graph.constant("block_shifts", ((block_row - np.arange(len(block_row))) * CHILDREN).astype(np.int32))
        brick_address = graph("Add", brick, graph.at(shifts, block))
        brick_values = graph.constant("brick_values", grid.bricks.ravel())
        brick_reference = graph.int32(graph.at(brick_values, brick_address))
        # cell -> its value; bricks with a list read the last row
        row_shift = graph("Sub", graph("Min", brick_reference, self.last_row), brick)
        cell_address = graph("Add", place, graph("Mul", row_shift, np.int32(CHILDREN)))
        cell_value = graph.int32(graph.at("node_values", cell_address))
        # The few points whose cell is split or has a list; for all others the value is the answer.
        pending = graph.where_true("GreaterOrEqual", cell_value, self.first_child_value)
        points = graph.columns_at(rows, pending)
        part_value, child = self._part(points, graph.at(brick_reference, pending), graph.at(cell_value, pending))
        value = self._nearest_in_list(graph.split_rows(points), part_value, child)
        self._outputs(graph("ScatterElements", cell_value, pending, value, axis=0), code_label, code_score)

    def _position(self, rows: str) -> str:
        """(3, m) points -> coordinates in cells, from the grid's low corner."""
        return self.graph("Mul", self.graph("Sub", rows, "grid_low"), np.float32(1) / self.grid.cell_size)

    def _outputs(self, value: str, code_label: str, code_score: str) -> None:
        """Value -> outputs: certain, or open with the answer at the center."""
        graph, codes, near_codes = self.graph, self.grid.codes, self.grid.codes // 2
        # Small tables over all values below 2 codes: a value >= codes is open, and its code is value - codes.
        code = np.arange(2 * codes) % codes
        code_answer = np.where(code > near_codes, code - near_codes, code)
        distance = np.where(code == TOO_FAR_CODE, BEYOND_REACH, np.where(code > near_codes, NEAR_SURFACE, ON_SURFACE))
        answer = graph.at(graph.constant("value_answer", code_answer.astype(np.int32)), value)
        instance = graph.constant("value_instance", (code_answer - CODE_OFFSET).astype(np.int32))
        graph("Less", value, np.int32(codes), name="certain")
        graph.at(instance, value, name="instance")
        graph.at(graph.constant("value_distance", distance.astype(np.int8)), value, name="distance")
        graph.at(code_label, answer, name="label")
        graph.at(code_score, answer, name="score")

    def _part(self, points: str, brick_reference: str, cell_value: str) -> tuple[str, str]:
        """Value of the part of the cell in which each of these points (3, m) lies; and the index of the child that
        answers that part, if it has one."""
        graph, zero = self.graph, np.int32(0)
        cell_child = self._child(brick_reference, cell_value)
        # A reference like a brick's: the cell's row if it is split, else beyond the last row for its list.
        is_split = graph("Less", graph.int32(graph.at("child_length", cell_child)), np.int32(1))
        list_reference = graph("Add", cell_child, self.last_row + np.int32(1))
        reference = graph("Where", is_split, graph.at("child_start", cell_child), list_reference)
        # Position of the point within the cell, in parts.
        position = self._position(points)
        first_part = graph("Mul", graph.int32(position), np.int32(EDGE))
        part = graph(
            "Sub", graph.int32(graph("Mul", position, np.float32(EDGE))), first_part
        )  # Mod takes 10 times as long
        part_place = graph.sum_of_rows(graph("Mul", part, np.array([[EDGE**2], [EDGE], [1]], np.int32)))
        row_start = graph("Mul", graph("Min", reference, self.last_row), np.int32(CHILDREN))
        value = graph.int32(graph.at("node_values", graph("Add", row_start, part_place)))
        # Parts that are already answered get a negative child, which is not used.
        return value, graph("Max", self._child(reference, value), zero)

    def _child(self, reference: str, value: str) -> str:
        """A box's reference, and the value in it -> index of the child that answers it.

        For a row of nodes it is first_child + value - 2 codes. A reference to a list exceeds the last row by the
        child's index + 1; that row has first_child -1 and the value 2 codes, so the same sum serves both.
        """
        graph = self.graph
        row = graph("Min", reference, self.last_row)
        row_child = graph("Add", graph.at("first_child", row), graph("Sub", value, self.first_child_value))
        return graph("Add", row_child, graph("Sub", reference, row))

    def _nearest_in_list(self, points: list[str], part_value: str, child: str) -> str:
        """The code of the nearest candidate for points (x, y, z) with a list; for others their part's value.

        Arrays need one length for all lists: the first of LIST_LENGTHS; longer lists are read again up to the next.
        """
        graph = self.graph
        start, length = graph.at("child_start", child), graph.int32(graph.at("child_length", child))
        is_answered = graph("Less", part_value, self.first_child_value)
        length = graph("Where", is_answered, np.int32(0), length)
        value, longer_than = part_value, 0
        for entries in LIST_LENGTHS:
            rows = graph.where_true("Greater", length, np.int32(longer_than))
            queries = [graph.at(coordinate, rows) for coordinate in points]
            code = self._search(queries, graph.at(start, rows), entries)
            value, longer_than = graph("ScatterElements", value, rows, code, axis=0), entries
        return value

    def _search(self, points: list[str], start: str, entries: int) -> str:
        """The code of the nearest of the first ``entries`` of each point's list, decided in float64.

        For a shorter list they continue into the next list: those points are farther, or the same ones again.
        """
        graph, cloud = self.graph, self.cloud
        steps = np.arange(entries, dtype=np.int32)[None]
        address = graph("Add", graph("Unsqueeze", start, LAST_AXIS), steps)
        shape, address = graph("Shape", address), graph.flat(address)
        low, high = (graph.int32(graph.at(f"candidates_{part}", address)) for part in ("low", "high"))
        candidate = graph("Add", low, graph("Mul", high, np.int32(1 << 16)))
        squares = []
        for axis, query in zip("xyz", points, strict=True):
            coordinate = graph("Reshape", graph.double(graph.at(f"candidate_{axis}", candidate)), shape)
            difference = graph("Sub", coordinate, graph("Unsqueeze", graph.double(query), LAST_AXIS))
            squares.append(graph("Mul", difference, difference))
        squared = graph("Add", graph("Add", squares[0], squares[1]), squares[2])
        # Lists ascend by point index, so the first of equals has the lowest.
        nearest = graph("ArgMin", squared, axis=1)
        distance = graph.flat(graph.at(squared, nearest, axis=1))
        nearest = graph.flat(graph.at(graph("Reshape", candidate, shape), nearest, axis=1))
        answer = graph.int32(graph.at("candidate_answer", nearest))
        near = graph("Add", answer, np.int32(self.grid.codes // 2))
        surface = np.float64(surface_distance(cloud.spacing, cloud.reach))
        within = graph("Where", graph("LessOrEqual", distance, surface**2), answer, near)
        is_in_reach = graph("LessOrEqual", distance, np.float64(cloud.reach) ** 2)
        return graph("Where", is_in_reach, within, np.int32(TOO_FAR_CODE))


def _axis_places(grid: LookupGrid) -> NDArray[np.int32]:
    """(3, cells along the longest axis) int32; see ``_Lookup.answer``."""
    _, blocks_y, blocks_z = grid.blocks.shape
    cell = np.arange(max(grid.shape) * EDGE)
    block, brick, inside = cell // EDGE**2, cell // EDGE % EDGE, cell % EDGE
    block_strides, strides = (np.array([[x], [y], [1]]) for x, y in ((blocks_y * blocks_z, blocks_z), (EDGE**2, EDGE)))
    place = (block * block_strides * CHILDREN + brick * strides) * CHILDREN + inside * strides
    in_grid = cell < np.array(grid.shape)[:, None] * EDGE  # the table's remainder is never read
    return np.where(in_grid, place, 0).astype(np.int32)
