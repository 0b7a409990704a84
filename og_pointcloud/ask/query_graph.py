"""Looks up the instances of points in query.onnx of a .ogpc file.

Files are untrusted. ``bundle.known_graph`` limits what the graph can do; this module checks that its answers are right:
on opening, a new random sample of the file's points and of positions near them is looked up and compared with the
file's arrays.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.cloud import TOO_FAR, LabelledCloud
from og_pointcloud.errors import BundleError, first_line
from og_pointcloud.models import open_session

OUTPUTS = {"instance": np.int32, "certain": np.bool_}
"""The graph's outputs that are used, one value per point each, and their types."""
CHECKED_POINTS, CHECKED_PLACES = 4096, 8
"""Points and positions beside them compared on opening. 4,096 random points miss a wrong thousandth of the cloud once
in 60 openings, 0.999^4096. Positions are few: their nearest points are found by brute force, in time linear in the
cloud."""


class QueryGraph:
    """The look-up of a .ogpc file. Thread-safe.

    onnx: the serialized graph. path: its file, for errors. cloud: the content of the file's arrays.
    BundleError for a graph that does not run or contradicts the arrays; later calls raise it for answers that no graph
    of ours gives.
    """

    def __init__(self, onnx: bytes, path: Path | None, cloud: LabelledCloud) -> None:
        self._path, self._instances = path, len(cloud.instances)
        try:
            self._session = open_session(onnx)
        except Exception as error:  # onnxruntime raises types of its own for a graph that it cannot run
            raise self._refused(f"does not run ({first_line(error)})") from None
        inputs = {given.name: given for given in self._session.get_inputs()}
        outputs = {given.name for given in self._session.get_outputs()}
        if set(inputs) != {"points", "text"} or not set(OUTPUTS) <= outputs:
            raise self._refused(f"takes {sorted(inputs)} and gives {sorted(outputs)}")
        shape = inputs["text"].shape
        if len(shape) != 2 or not isinstance(shape[1], int):
            raise self._refused(f"takes text of shape {shape}, without a fixed dimension")
        self._no_text = np.zeros((0, shape[1]), np.float32)
        if len(cloud):
            self._compare(cloud, np.random.default_rng())

    def look_up(self, local: NDArray[np.float32]) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
        """Instance ids, and whether each is certain, (N,) each. local: (N, 3), the cloud's frame."""
        try:
            answers = self._session.run(list(OUTPUTS), {"points": local, "text": self._no_text})
        except Exception as error:  # onnxruntime raises types of its own
            raise self._refused(f"fails ({first_line(error)})") from None
        instances, certain = (np.asarray(values) for values in answers)
        for values, dtype in zip((instances, certain), OUTPUTS.values(), strict=True):
            if values.shape != (len(local),) or values.dtype != dtype:
                raise self._refused(f"answers with {values.dtype} {values.shape} for {len(local)} points")
        # Callers index arrays by these ids: an invalid one must not get that far.
        if len(local) and not (instances.min() >= TOO_FAR and instances.max() < self._instances):
            raise self._refused("answers with ids that are not instances of this file")
        return instances, certain

    def _compare(self, cloud: LabelledCloud, random: np.random.Generator) -> None:
        """BundleError if the graph contradicts the arrays. A correct graph passes for every random sample."""
        rows = random.integers(0, len(cloud), CHECKED_POINTS)
        instances, certain = self.look_up(cloud.xyz[rows])
        differ = np.flatnonzero(certain & (instances != cloud.instance_ids[rows]))
        # A point that differs need not be wrong, as the first of coincident points counts: it is checked as a position.
        # Other positions lie half a spacing off a point, where the nearest one is not obvious.
        places = cloud.xyz[rows[:CHECKED_PLACES]] + random.normal(size=(CHECKED_PLACES, 3)) * (0.5 * cloud.spacing)
        places = np.concatenate([cloud.xyz[rows[differ[:CHECKED_PLACES]]], places.astype(np.float32)])
        instances, certain = self.look_up(places)
        expected = np.array([_brute_force_instance(cloud, place) for place in places])
        if wrong := int((certain & (instances != expected)).sum()):
            raise self._refused(f"contradicts the file's own points and ids at {wrong} of {len(places)} positions")

    def _refused(self, what: Any) -> BundleError:
        return BundleError(f"{self._path}: query.onnx {what}: write the file again")


def _brute_force_instance(cloud: LabelledCloud, place: NDArray[np.float32]) -> int:
    """Instance of the nearest point within reach, the first of equally near ones, from all distances in float64."""
    # A coarse filter along x, wide enough for float32's rounding; the distances below decide.
    close = np.flatnonzero(np.abs(cloud.xyz[:, 0] - place[0]) <= 2 * cloud.reach)
    x, y, z = (cloud.xyz[close].astype(np.float64) - place.astype(np.float64)).T
    squared = (x * x + y * y) + z * z
    if len(close) == 0 or squared.min() > float(cloud.reach) ** 2:
        return TOO_FAR
    return int(cloud.instance_ids[close[squared.argmin()]])
