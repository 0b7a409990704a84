"""Writers of portable files, which need onnx or numba; the readers are in ``og_pointcloud``.

``writer``: a LabelledCloud -> one .ogpc file, checked against float64. ``query_graph``: the graph in it that labels
points by text; ``lookup_grid`` and ``lookup_boxes``: the table by which that graph finds the nearest point's instance.
``encoders``: text and image models -> the ONNX folders that encode words and masks.
"""

from __future__ import annotations

from og_pointcloud_export.writer import query_model, write_bundle

__all__ = ["query_model", "write_bundle"]
