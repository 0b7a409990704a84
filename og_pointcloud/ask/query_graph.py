"""query.onnx of a .ogpc file, asked for instances of points. Files come from anywhere, so its answers are checked."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.cloud import TOO_FAR
from og_pointcloud.errors import BundleError
from og_pointcloud.models import open_session

__all__ = ["QueryGraph"]

OUTPUTS = {"instance": np.int32, "certain": np.bool_}
"""What is asked of the graph: one value a point each."""


class QueryGraph:
    """The look-up of a .ogpc file. Several threads may ask it at once.

    onnx: the serialised graph. path: its file, for errors. instances: how many the file has.
    BundleError, also of later calls, for a graph that does not run or answers what no graph of ours would.
    """

    def __init__(self, onnx: bytes, path: Path | None, instances: int) -> None:
        self._path, self._instances = path, instances
        try:
            self._session = open_session(onnx)
        except Exception as error:  # onnxruntime raises types of its own for a graph that it cannot run
            raise self._refused(f"does not run ({_first_line(error)})") from None
        inputs = {given.name: given for given in self._session.get_inputs()}
        outputs = {given.name for given in self._session.get_outputs()}
        if set(inputs) != {"points", "text"} or not set(OUTPUTS) <= outputs:
            raise self._refused(f"takes {sorted(inputs)} and gives {sorted(outputs)}")
        shape = inputs["text"].shape
        if len(shape) != 2 or not isinstance(shape[1], int):
            raise self._refused(f"takes text of shape {shape}, of no width")
        self._no_text = np.zeros((0, shape[1]), np.float32)

    def look_up(self, local: NDArray[np.float32]) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
        """Instance id, and whether it is certain, (N,) each. local: (N, 3), the cloud's frame."""
        try:
            found = self._session.run(list(OUTPUTS), {"points": local, "text": self._no_text})
        except Exception as error:  # onnxruntime raises types of its own
            raise self._refused(f"fails ({_first_line(error)})") from None
        instances, certain = (np.asarray(values) for values in found)
        for values, dtype in zip((instances, certain), OUTPUTS.values(), strict=True):
            if values.shape != (len(local),) or values.dtype != dtype:
                raise self._refused(f"answers {values.dtype} {values.shape} for {len(local)} points")
        # Nothing is looked up by a number that is no instance's.
        if len(local) and not (instances.min() >= TOO_FAR and instances.max() < self._instances):
            raise self._refused("answers what is no instance of this file")
        return instances, certain

    def _refused(self, what: Any) -> BundleError:
        return BundleError(f"{self._path}: query.onnx {what}: write the file again")


def _first_line(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0][:200]
