"""LanceDB beside an atlas (extra 'lance'): for more descriptors than memory holds, in a folder or an object store.

A table has a row for each descriptor, put so that its inner product with (direction, 1) is the evidence itself
(`choosing.Standard`): then the largest products are the best instances, also of scenes that are judged differently.
LanceDB only proposes: what it finds is scored from the atlas, so that an answer may lack an instance, but never says
anything of one that the exact search would not say.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.collection.index import own_words
from og_pointcloud.collection.scoring import block_key, load_block
from og_pointcloud.collection.store import Atlas, SceneEntry
from og_pointcloud.errors import MissingExtraError, OgPointcloudError

__all__ = ["LanceTables", "write_lance"]

INDEXED_FROM = 50_000
"""Rows from which a table has an index; fewer are all looked at."""
ROWS_A_PARTITION = 4_000
SCENES_AT_ONCE = 200
PROPOSED = 50
"""Rows that are asked for, for each that is wanted: a row's rank by evidence is not yet its rank by probability."""
PROBES, REFINE = 64, 8
"""Partitions that are searched, and times as many rows read in full as are asked for: recall against time. With 24 and
4 the recall at 10 was 0.97 on 200,000 made descriptors (docs/scale.md)."""


def _database(uri: str) -> Any:
    try:
        import lancedb  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise MissingExtraError("lancedb", "lance") from None
    return lancedb.connect(uri)


def _table(key: tuple[Any, ...]) -> str:
    kin, _, judge = key
    return f"kin{kin}-{judge or 'cosine'}"


def write_lance(atlas: str | os.PathLike[str], uri: str) -> None:
    """Write all that an atlas has to the database at a folder or URI (s3://...), in place of what is there."""
    import pyarrow as pa  # pyright: ignore[reportMissingImports]

    database = _database(uri)
    with Atlas.reading(atlas) as opened:
        entries = [entry for entry in opened.entries() if entry.width]
        words = own_words(opened, entries)
        tables: dict[str, list[SceneEntry]] = {}
        for entry in entries:
            tables.setdefault(_table(block_key(entry, words)), []).append(entry)
        for name, scenes in tables.items():
            vector = pa.list_(pa.float16(), scenes[0].width + 1)
            fields = [("scene", pa.int32()), ("instance", pa.int32()), ("x", pa.float64()), ("y", pa.float64())]
            schema = pa.schema([*fields, ("z", pa.float64()), ("vector", vector)])
            table = database.create_table(name, schema=schema, mode="overwrite")
            for batch in _batches(opened, scenes, schema):  # a generator it would read in another thread
                table.add(pa.Table.from_batches([batch]))
            if (count := table.count_rows()) >= INDEXED_FROM:
                partitions = max(8, count // ROWS_A_PARTITION)
                table.create_index(metric="dot", index_type="IVF_SQ", num_partitions=partitions)


def _batches(atlas: Atlas, scenes: Sequence[SceneEntry], schema: Any) -> Iterator[Any]:
    import pyarrow as pa  # pyright: ignore[reportMissingImports]

    for start in range(0, len(scenes), SCENES_AT_ONCE):
        some = scenes[start : start + SCENES_AT_ONCE]
        block = load_block(atlas, some)
        instance = np.repeat(np.arange(len(block)), np.diff(np.append(block.first, len(block.descriptors))))
        ids = np.array([entry.id for entry in some], np.int32)
        x, y, z = ((block.low + block.high) / 2)[instance].T
        vectors = block.evidence_vectors().astype(np.float16)
        rows = pa.FixedSizeListArray.from_arrays(pa.array(vectors.ravel()), vectors.shape[1])
        columns = [ids[block.scene[instance]], block.instance[instance], x, y, z]
        yield pa.record_batch([*map(pa.array, columns), rows], schema=schema)


class LanceTables:
    """The tables that `write_lance` wrote."""

    def __init__(self, uri: str) -> None:
        self._uri, self._database = uri, _database(uri)

    def propose(
        self,
        key: tuple[Any, ...],
        direction: NDArray[np.float32],
        box: NDArray[np.float64] | None,
        scenes: Sequence[SceneEntry] | None,
        top: int,
    ) -> set[tuple[int, int]]:
        """(scene id, instance) of descriptors with the most evidence for a direction (D,). key: as of `block_key`. box:
        corners that hold the instances' middles. scenes: those that are asked; None for all."""
        try:
            table = self._database.open_table(_table(key))
        except (ValueError, FileNotFoundError) as error:
            raise OgPointcloudError(
                f"'{self._uri}' has no table for these scenes ({error!s:.80}): the atlas has changed since; write it "
                "again with og-pointcloud index --lance"
            ) from None
        query = table.search(np.append(direction, np.float32(1)), vector_column_name="vector").distance_type("dot")
        query = (
            query.nprobes(PROBES).refine_factor(REFINE).select(["scene", "instance", "_distance"]).limit(PROPOSED * top)
        )
        conditions = []
        if box is not None:
            conditions += [f"{axis} >= {low!r} AND {axis} <= {high!r}" for axis, low, high in zip("xyz", *box.tolist())]  # noqa: B905
        if scenes is not None:
            conditions.append(f"scene IN ({', '.join(str(entry.id) for entry in scenes)})")
        if conditions:
            query = query.where(" AND ".join(conditions), prefilter=True)
        rows = query.to_arrow()
        return set(zip(rows["scene"].to_pylist(), rows["instance"].to_pylist(), strict=True))
