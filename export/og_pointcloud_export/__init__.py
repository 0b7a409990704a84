"""LabelledCloud -> .ogpc: the query head graph, its check against float64, and the file."""

from __future__ import annotations

from og_pointcloud_export.writer import query_model, write_bundle

__all__ = ["query_model", "write_bundle"]
