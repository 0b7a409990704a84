"""What a map knows about its instances beyond one visit: when each was last seen, and what became of it.

It is kept in the cloud's provenance under "map", as plain JSON. A file without it, as written by `fit`, is also a map:
of one visit in which everything was present. Ids are rows of the instance table and are never given twice: an instance
that left keeps its row, without points.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from og_pointcloud.cloud import InstanceTable, LabelledCloud
from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.mapping.likeness import Look, descriptors_of

KEY = "map"


@dataclass(frozen=True)
class VisitEntry:
    """A visit. name: of its capture. stamp: its time, in seconds or a count, like its frames'. views: their number."""

    name: str
    stamp: float
    views: int


@dataclass
class MapRecord:
    """visits: in order. last_seen: by id, the stamp of the visit that last saw the instance. moved_from: by id,
    its place before its last move. gone: by id, the look of instances that left and have not come back; their
    descriptors are not stored twice, as the table still has them."""

    visits: list[VisitEntry] = field(default_factory=list)
    last_seen: dict[int, float] = field(default_factory=dict)
    moved_from: dict[int, tuple[float, ...]] = field(default_factory=dict)
    gone: dict[int, Look] = field(default_factory=dict)

    @classmethod
    def of(cls, cloud: LabelledCloud) -> MapRecord:
        """The record of a map; for a cloud made by `fit`, one visit that saw every instance.

        OgPointcloudError where a file holds something else under that name.
        """
        count = len(cloud.instances)
        stored = cloud.provenance.get(KEY)
        if stored is None:
            return cls([VisitEntry("first visit", 0.0, len(cloud.cameras))], dict.fromkeys(range(count), 0.0))
        try:
            record = cls(
                [VisitEntry(str(v["name"]), float(v["stamp"]), int(v["views"])) for v in stored["visits"]],
                {int(k): float(stamp) for k, stamp in stored["last_seen"].items()},
                {int(k): _three(place) for k, place in stored["moved_from"].items()},
                {int(k): _look(entry, cloud.instances, int(k)) for k, entry in stored["gone"].items()},
            )
        except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
            raise OgPointcloudError(
                f"the map's record of its visits is damaged ({error!r:.80}): fit it again"
            ) from None
        if not record.visits:
            raise OgPointcloudError("the map's record has no visits; expected at least one: fit it again")
        # Ids are rows of the table: one beyond it would be noticed only when it is used.
        ids = {*record.last_seen, *record.moved_from, *record.gone}
        if ids and not 0 <= min(ids) <= max(ids) < count:
            raise OgPointcloudError(f"the map's record names instance {max(ids)}, the map has {count}: fit it again")
        return record

    def added_to(self, provenance: dict[str, Any]) -> dict[str, Any]:
        """The provenance with this record, JSON-able."""
        # The look without its descriptors, which the table has.
        gone = {
            k: {"place": look.place.tolist(), "length": look.length,
                "color": None if look.color is None else look.color.tolist()}
            for k, look in self.gone.items()
        }  # fmt: skip
        return {**provenance, KEY: {**asdict(replace(self, gone={})), "gone": gone}}


def _look(entry: dict[str, Any], table: InstanceTable, instance: int) -> Look:
    color, length, place = entry["color"], float(entry["length"]), np.array(_three(entry["place"]))
    bounds = place + length * np.array([[-0.5], [0.5]])
    color = None if color is None else np.array(_three(color))
    return Look(*descriptors_of(table, instance), place, color, bounds, length)


def _three(values: Any) -> tuple[float, ...]:
    x, y, z = (float(value) for value in values)
    return x, y, z
