"""A mapper's state as arrays and plain values, and back."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.bundle.format import cameras_of_rows, rows_of_cameras
from og_pointcloud.mapping.kept_views import KeptView, KeptViews
from og_pointcloud.mapping.tracks import Track, Tracks

__all__ = ["columns", "kept_arrays", "kept_from", "set_columns", "tracks_from", "tracks_state"]

Arrays = dict[str, NDArray[Any]]
KEPT = ("starts", "columns", "votes", "seen", "openness", "pixels", "features")
NUMBERS = tuple(entry.name for entry in fields(Track) if entry.name != "total")


def columns(prefix: str, owner: Any, names: tuple[str, ...]) -> Arrays:
    """Attributes of an object that are arrays, under a prefix."""
    return {f"{prefix}.{name}": getattr(owner, name) for name in names}


def set_columns(prefix: str, owner: Any, names: tuple[str, ...], arrays: Arrays) -> None:
    """Take them back, writable."""
    for name in names:
        setattr(owner, name, arrays[f"{prefix}.{name}"].copy())


def kept_arrays(kept: KeptViews) -> Arrays:
    """The kept views, each kind of array one behind the other."""
    views = kept.views
    arrays: Arrays = {"kept.shown": kept.shown, "kept.cameras": rows_of_cameras([view.camera for view in views])}
    arrays["kept.when"] = np.array([(view.stamp, view.sequence) for view in views]).reshape(-1, 2)
    for name in KEPT:
        parts = [getattr(view, name) for view in views]
        arrays[f"kept.{name}"] = np.concatenate([part.reshape(-1) for part in parts]) if parts else np.zeros(0)
        arrays[f"kept.{name}.length"] = np.array([len(part) for part in parts], np.int64)
    return arrays


def kept_from(arrays: Arrays, width: int) -> KeptViews:
    """The kept views of `kept_arrays`. width: of the features."""
    cameras = cameras_of_rows(arrays["kept.cameras"])
    parts = {}
    for name in KEPT:
        data, lengths = arrays[f"kept.{name}"], arrays[f"kept.{name}.length"]
        data = data.reshape(-1, width) if name == "features" else data
        parts[name] = np.split(data, np.cumsum(lengths)[:-1]) if len(lengths) else []
    views = [
        KeptView(camera, float(stamp), int(sequence), **{name: parts[name][k].copy() for name in KEPT})
        for k, (camera, (stamp, sequence)) in enumerate(zip(cameras, arrays["kept.when"], strict=True))
    ]
    return KeptViews(views, arrays["kept.shown"].copy())


def tracks_state(tracks: Tracks) -> tuple[Arrays, dict[str, Any]]:
    """Arrays and values of the tracks."""
    known = [k for k, track in enumerate(tracks.tracks) if track.total is not None]
    totals = [tracks.tracks[k].total for k in known]
    pairs = [(*pair, *counts) for pair, counts in tracks.pairs.items()]
    arrays: Arrays = {
        "tracks.root": tracks.root,
        "tracks.known": np.array(known, np.int64),
        "tracks.total": np.array(totals, np.float64).reshape(len(known), -1) if known else np.zeros((0, 1)),
        "tracks.numbers": np.array([[getattr(t, name) for name in NUMBERS] for t in tracks.tracks]).reshape(-1, 6),
        "tracks.pairs": np.array(pairs, np.int64).reshape(-1, 4),
        "tracks.free": np.array(tracks.free, np.int64),
    }
    return arrays, {"next_id": tracks.next_id}


def tracks_from(arrays: Arrays, values: dict[str, Any]) -> Tracks:
    """The tracks of `tracks_state`."""
    made = []
    for pixels, agreement, views, masks, last_seen, id_ in arrays["tracks.numbers"].tolist():
        made.append(Track(None, pixels, agreement, int(views), int(masks), last_seen, int(id_)))
    for k, total in zip(arrays["tracks.known"].tolist(), arrays["tracks.total"], strict=True):
        made[k].total = total.copy()
    pairs = {(a, b): [one, two] for a, b, one, two in arrays["tracks.pairs"].tolist()}
    return Tracks(made, arrays["tracks.root"].copy(), pairs, values["next_id"], arrays["tracks.free"].tolist())
