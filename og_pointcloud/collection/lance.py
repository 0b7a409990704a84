"""LanceDB beside an atlas (extra 'lance'): for more descriptors than memory holds, in a folder or an object store.

A table has a row per descriptor: its vector and shift (`scoring.Block`), whose inner product with (direction, 1) is the
evidence itself. So the largest products are the best instances, even among scenes that are judged differently. LanceDB
only proposes: what it finds is scored from the atlas. An answer may miss an instance, but the scores are those of the
exact search.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from math import ceil
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.collection.index import families
from og_pointcloud.collection.scoring import Block, load_block
from og_pointcloud.collection.store import Atlas
from og_pointcloud.errors import OgPointcloudError, naming_extra
from og_pointcloud.formats.atomic import StrPath

MIN_INDEXED_ROWS = 50_000
"""Rows from which on a table gets an index; with fewer, all are compared."""
ROWS_PER_PARTITION = 4_000
SCENES_PER_WRITE = MAX_EXACT_SCENES = 200
"""Scenes written at once; and scenes up to which the atlas is searched exactly: their rows lie in all partitions."""
PROPOSED_ROWS = 50
"""Rows proposed per requested instance: a row's rank by evidence is not yet its rank by probability."""
SEARCHED_PARTITIONS, REFINE_FACTOR = 64, 8
"""Partitions searched, and multiple of the requested rows compared in full precision: recall against time. On 200,000
synthetic descriptors the recall at 10 was 1.00; with 24 and 4 it was 0.97 (docs/scale.md)."""


def _database(uri: str) -> Any:
    with naming_extra("lancedb", "lance"):
        import lancedb  # pyright: ignore[reportMissingImports]
    return lancedb.connect(uri)


def write_lance(atlas: StrPath, uri: str) -> None:
    """Write a whole atlas to the database at a folder or URI (s3://...), replacing what is there."""
    database = _database(uri)  # says which extra is missing
    import pyarrow as pa  # pyright: ignore[reportMissingImports]

    with Atlas.reading(atlas) as opened:
        written = opened.fingerprint
        for group in (group for family in families(opened, opened.entries()) for group in family.groups()):
            numbers = {"scene": pa.int64(), "instance": pa.int32()} | dict.fromkeys("xyz", pa.float64())
            vector = pa.list_(pa.float16(), group.family.width + 1)
            schema = pa.schema([*numbers.items(), ("vector", vector)])
            table = database.create_table(group.name, schema=schema, mode="overwrite")
            # Added in parts, not as a generator: LanceDB would read that in another thread, where SQLite refuses.
            for start in range(0, len(group.entries), SCENES_PER_WRITE):
                block = load_block(opened, group.entries[start : start + SCENES_PER_WRITE])
                table.add(pa.Table.from_arrays(_columns(block), schema=schema))
            if (count := table.count_rows()) >= MIN_INDEXED_ROWS:
                partitions = max(8, count // ROWS_PER_PARTITION)
                table.create_index(metric="dot", index_type="IVF_SQ", num_partitions=partitions)
    with Atlas.writing(atlas) as opened:
        opened.note(_name(uri), written)


def _name(uri: str) -> str:
    """The name under which an atlas notes the fingerprint written to this database."""
    return f"lance {uri if '://' in uri else os.path.abspath(uri)}"


def _columns(block: Block) -> list[Any]:
    import pyarrow as pa  # pyright: ignore[reportMissingImports]

    instance = np.repeat(np.arange(len(block)), np.diff(block.bounds))
    vectors = np.column_stack([block.vectors, block.shift]).astype(np.float16)
    rows = pa.FixedSizeListArray.from_arrays(pa.array(vectors.ravel()), vectors.shape[1])
    numbers = [block.ids[block.scene[instance]], block.instance[instance].astype(np.int32), *block.center[instance].T]
    return [*map(pa.array, numbers), rows]


class LanceTables:
    """The tables that `write_lance` wrote."""

    def __init__(self, uri: str) -> None:
        if "://" not in uri and not os.path.isdir(uri):
            raise OgPointcloudError(f"'{uri}' is not a folder; expected one that og-pointcloud index --lance wrote")
        self._uri, self._database = uri, _database(uri)

    def require(self, atlas: Atlas) -> None:
        """OgPointcloudError unless these hold all scenes of an atlas as they are now: new ones would be missed."""
        if atlas.noted(_name(self._uri)) != atlas.fingerprint:
            raise OgPointcloudError(
                f"'{self._uri}' was not written from the current {atlas.path}: write it again with "
                "og-pointcloud index --lance"
            )

    def propose(
        self,
        name: str,
        direction: NDArray[np.float32],
        box: NDArray[np.float64] | None,
        scenes: Sequence[int] | None,
        top: int,
        share: float = 1.0,
    ) -> set[int]:
        """Ids of the scenes whose descriptors have the most evidence for a direction (D,).

        name: of the group. box: (2, 3) corners that the instances' centers must lie between. scenes: their ids; None
        for all. share: approximate share of the rows that pass box and scenes: the fewer, the more partitions must be
        searched for the best of them.
        """
        try:
            table = self._database.open_table(name)
        except (ValueError, FileNotFoundError) as error:
            raise OgPointcloudError(
                f"'{self._uri}' has no table for these scenes ({error!s:.80}): the atlas has changed since; write it "
                "again with og-pointcloud index --lance"
            ) from None
        query = table.search(np.append(direction, np.float32(1)), vector_column_name="vector").distance_type("dot")
        query = query.nprobes(ceil(SEARCHED_PARTITIONS / share)).refine_factor(REFINE_FACTOR).limit(PROPOSED_ROWS * top)
        conditions = [] if scenes is None else [f"scene IN ({', '.join(map(str, scenes))})"]
        if box is not None:
            corners = zip("xyz", *box.tolist(), strict=True)
            conditions += [f"{axis} BETWEEN {low!r} AND {high!r}" for axis, low, high in corners]
        if conditions:
            query = query.where(" AND ".join(conditions), prefilter=True)  # else it would filter the best of all rows
        return set(query.select(["scene", "_distance"]).to_arrow()["scene"].to_pylist())
