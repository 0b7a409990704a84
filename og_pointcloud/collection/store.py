"""The atlas: what is known of the instances of many scenes, in one SQLite file. It is read without being believed.

    scenes      a row each: name, hash of its file, feature space; arrays of its instances and descriptors
    words       vocabularies and word banks, each once, however many scenes share them, by a hash of their content
    judgements  by which words a scene's instances are judged, and what that makes of its descriptors (`judging`)
    boxes       an R*Tree of the instances' boxes

A change is one transaction: whoever reads sees the atlas before it or after it, and a process that is killed leaves
the one before.
"""

from __future__ import annotations

import json
import os
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from og_pointcloud.ask.choosing import Standard
from og_pointcloud.cloud import MIN_BANK, Vocabulary, WordBank
from og_pointcloud.errors import OgPointcloudError

__all__ = ["INSTANCE", "Atlas", "SceneArrays", "SceneEntry"]

APPLICATION, VERSION = 0x4F474154, 1
"""SQLite's application_id and user_version of an atlas; the second is raised when older ones cannot be read."""
SCHEMA = (
    "CREATE TABLE about(name TEXT PRIMARY KEY, value TEXT NOT NULL)",
    "CREATE TABLE scenes(id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE, digest TEXT NOT NULL, "
    "bytes INTEGER NOT NULL, modified INTEGER NOT NULL, space TEXT NOT NULL, width INTEGER NOT NULL, "
    "points INTEGER NOT NULL, vocabulary TEXT, bank TEXT, encoder INTEGER NOT NULL, kin INTEGER, "
    "instances BLOB NOT NULL, "
    "owner BLOB NOT NULL, descriptors BLOB NOT NULL)",
    "CREATE TABLE words(digest TEXT PRIMARY KEY, names TEXT NOT NULL, width INTEGER NOT NULL, vectors BLOB NOT NULL)",
    "CREATE TABLE judgements(scene INTEGER PRIMARY KEY, judge TEXT NOT NULL, sharpness REAL NOT NULL, "
    "standard BLOB NOT NULL)",
    "CREATE VIRTUAL TABLE boxes USING rtree(id, x0, x1, y0, y1, z0, z1)",
)
INSTANCE = np.dtype([
    ("points", "<i4"), ("views", "<i4"), ("masks", "<i4"), ("part_of", "<i4"), ("agreement", "<f4"),
    ("visible_area", "<f4"), ("centroid", "<f8", 3), ("low", "<f8", 3), ("high", "<f8", 3),
])  # fmt: skip
"""What an atlas knows of an instance: row k of a scene is instance k. Lengths in the scene's unit; NaN without points.
low, high: corners of the axis-aligned box of its main part."""
MOST_INSTANCES = 1 << 24
"""Instances of a scene, and the factor of the scene's number in an R*Tree's."""
PATIENCE_S = 30.0
"""How long a change waits for another one."""
REMAKE = "make it again with og-pointcloud index"


@dataclass(frozen=True)
class SceneEntry:
    """A scene without its arrays. name: its file's path below the folder that was indexed, without the ending.

    digest, bytes, modified: of the file. feature_space, width: of its descriptors. vocabulary, bank: digests in
    `words`, None without. encoder: 1 where the file carries a text encoder. kin: number of the scenes whose words have
    the same vectors (`index.kinship`). judge: digest of the bank by which its instances are judged, None without.
    """

    id: int
    name: str
    digest: str
    bytes: int
    modified: int
    feature_space: str
    width: int
    points: int
    instances: int
    vocabulary: str | None
    bank: str | None
    encoder: int = 0
    kin: int | None = None
    judge: str | None = None


@dataclass(frozen=True)
class SceneArrays:
    """instances: (K,) INSTANCE. owner: (R,) int32, the instance of each descriptor, ascending. descriptors: (R, D)
    float32, unit rows."""

    instances: NDArray[np.void]
    owner: NDArray[np.int32]
    descriptors: NDArray[np.float32]


class Atlas:
    """An open atlas. Made by `reading` or `writing`.

    Its methods raise OgPointcloudError, beginning with the path, where the file is damaged, or no atlas of ours.
    """

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self.path, self._connection = path, connection

    @classmethod
    @contextmanager
    def reading(cls, path: str | os.PathLike[str]) -> Iterator[Atlas]:
        """For reading alone; several processes may."""
        path = Path(path)
        if not path.is_file():
            raise OgPointcloudError(f"{path} is not a file; expected an atlas: make it with og-pointcloud index")
        with cls._connected(path, "ro") as atlas:
            atlas._check()
            yield atlas

    @classmethod
    @contextmanager
    def writing(cls, path: str | os.PathLike[str]) -> Iterator[Atlas]:
        """For one change, which is made when the block ends without an error; a missing file is made too."""
        path = Path(path)
        is_new = not path.exists() or (path.is_file() and path.stat().st_size == 0)  # 0: a first index was killed
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with cls._connected(path, "rwc") as atlas:
                atlas._run("BEGIN IMMEDIATE")
                if is_new:
                    for statement in SCHEMA:
                        atlas._run(statement)
                    atlas._run(f"PRAGMA application_id = {APPLICATION}")
                    atlas._run(f"PRAGMA user_version = {VERSION}")
                else:
                    atlas._check()
                yield atlas
                atlas._run("COMMIT")
        except BaseException:
            if is_new:
                path.unlink(missing_ok=True)
            raise

    @classmethod
    @contextmanager
    def _connected(cls, path: Path, mode: str) -> Iterator[Atlas]:
        uri = f"{path.resolve().as_uri()}?mode={mode}"
        try:
            connection = sqlite3.connect(uri, uri=True, timeout=PATIENCE_S, isolation_level=None)
        except sqlite3.Error as error:
            raise OgPointcloudError(
                f"{path} cannot be opened ({error}); expected a file in a folder of yours"
            ) from None
        try:
            connection.execute("PRAGMA trusted_schema = OFF")
            connection.execute("PRAGMA cell_size_check = ON")
            yield cls(path, connection)
        finally:
            connection.close()  # what was not committed is undone

    def _run(self, statement: str, values: tuple[Any, ...] = ()) -> sqlite3.Cursor:
        try:
            return self._connection.execute(statement, values)
        except sqlite3.Error as error:
            raise self._failed(error) from None

    def _rows(self, statement: str, values: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
        cursor = self._run(statement, values)
        while True:
            try:
                row = cursor.fetchone()
            except (sqlite3.Error, ValueError, OverflowError) as error:  # also text that is no UTF-8
                raise self._failed(error) from None
            if row is None:
                return
            yield row

    def _failed(self, error: Exception) -> OgPointcloudError:
        reason = str(error)
        if "locked" in reason:
            return OgPointcloudError(f"{self.path} is being changed by another process; wait for it, then try again")
        if "full" in reason or "readonly" in reason or "I/O" in reason:
            return OgPointcloudError(f"{self.path} cannot be written ({reason}): it stays as it was; make room for it")
        return self._refused(reason)

    def _refused(self, reason: str) -> OgPointcloudError:
        return OgPointcloudError(f"{self.path} is no atlas that can be used ({reason:.120}): {REMAKE}")

    def _check(self) -> None:
        """Refuse other databases, and those with views, triggers or columns that none of ours has."""
        found = tuple(next(self._rows(f"PRAGMA {name}"))[0] for name in ("application_id", "user_version"))
        if found != (APPLICATION, VERSION):
            raise self._refused(f"its application and version are {found}; expected {(APPLICATION, VERSION)}")
        empty = sqlite3.connect(":memory:")
        for statement in SCHEMA:
            empty.execute(statement)
        query = "SELECT type, name, CASE WHEN name LIKE 'boxes\\_%' ESCAPE '\\' THEN '' ELSE sql END FROM sqlite_master"
        expected = set(empty.execute(query))
        if others := set(self._rows(query)) ^ expected:
            raise self._refused(f"its schema has, or lacks, {sorted(others, key=str)[0]!r:.80}")

    # What it holds ------------------------------------------------------------------------------------------------

    @property
    def root(self) -> Path:
        """The folder that was indexed."""
        return Path(next(self._rows("SELECT value FROM about WHERE name = 'root'"), (".",))[0])

    def entries(self) -> list[SceneEntry]:
        """All scenes, by name."""
        columns = "id, name, digest, bytes, modified, space, width, points, length(instances) / ?, vocabulary, bank, "
        columns += "encoder, kin, judge"
        statement = f"SELECT {columns} FROM scenes LEFT JOIN judgements ON scene = id ORDER BY name"
        texts, numbers = (
            ("name", "digest", "feature_space"),
            ("id", "bytes", "modified", "width", "points", "instances"),
        )
        entries = []
        for row in self._rows(statement, (INSTANCE.itemsize,)):
            entry = SceneEntry(*row)
            sound = all(isinstance(getattr(entry, name), str) for name in texts) and all(
                isinstance(getattr(entry, name), int) and getattr(entry, name) >= 0 for name in numbers
            )
            if not sound or not 0 <= entry.width < 1 << 20:
                raise self._refused(f"the scene {entry.name!r:.60} has columns of a wrong kind")
            entries.append(entry)
        return entries

    def arrays(self, entry: SceneEntry) -> SceneArrays:
        """The instances and descriptors of a scene."""
        statement = "SELECT instances, owner, descriptors FROM scenes WHERE id = ? AND digest = ?"
        row = next(self._rows(statement, (entry.id, entry.digest)), None)
        if row is None or not all(isinstance(blob, bytes) for blob in row):
            raise self._refused(f"the scene '{entry.name}' has no arrays, or was indexed again meanwhile")
        instances, owner = self._array(row[0], INSTANCE, (-1,)), self._array(row[1], np.dtype("<i4"), (-1,))
        descriptors = self._array(row[2], np.dtype("<f4"), (len(owner), entry.width))
        ascending = len(owner) == 0 or (
            owner[0] >= 0 and owner[-1] < len(instances) and (owner[1:] >= owner[:-1]).all()
        )
        shown = instances[instances["points"] > 0]
        finite = all(np.isfinite(shown[name]).all() for name in ("low", "high", "centroid", "agreement"))
        if not finite or not ascending or len(instances) > MOST_INSTANCES:
            raise self._refused(f"descriptors of '{entry.name}' belong to no instances, or these to no place")
        return SceneArrays(instances, owner, descriptors)

    def judgement(self, entry: SceneEntry, rows: int) -> Standard:
        """What its judge makes of a scene's descriptors, of which it has so many."""
        statement = "SELECT sharpness, standard FROM judgements WHERE scene = ?"
        sharpness, blob = next(self._rows(statement, (entry.id,)), (None, b""))
        numbers = self._array(blob, np.dtype("<f4"), (entry.width + 2 * rows,))
        if not isinstance(sharpness, float) or not 0 < sharpness < 1e6:
            raise self._refused(f"the sharpness of '{entry.name}' is {sharpness!r:.40}")
        common, scale, shift = np.split(numbers, [entry.width, entry.width + rows])
        return Standard(common, scale, shift, sharpness)

    def bank(self, digest: str, width: int) -> WordBank:
        """The words that judge descriptors of a width."""
        vectors = self.words(digest).vectors
        if vectors.shape[1] != width or len(vectors) < MIN_BANK:
            raise self._refused(f"a bank has {vectors.shape}; expected at least {MIN_BANK} words of width {width}")
        return WordBank(vectors)

    def words(self, digest: str) -> Vocabulary:
        """A vocabulary, or a bank, whose words have names of no meaning."""
        statement = "SELECT names, width, vectors FROM words WHERE digest = ?"
        names, width, blob = next(self._rows(statement, (digest,)), (None, 0, b""))
        try:
            listed = json.loads(str(names))
            assert isinstance(listed, list)
            assert all(isinstance(name, str) for name in listed)
        except (ValueError, TypeError, AssertionError, RecursionError):
            raise self._refused(f"the words {digest!r:.40} have no names") from None
        return Vocabulary(tuple(listed), self._array(blob, np.dtype("<f4"), (len(listed), int(width))))

    def within(self, low: ArrayLike, high: ArrayLike) -> set[int]:
        """Ids of the scenes with an instance whose box meets this one. low, high: (3,)."""
        (x0, y0, z0), (x1, y1, z1) = np.asarray(low, float).tolist(), np.asarray(high, float).tolist()
        meets = "x1 >= ? AND x0 <= ? AND y1 >= ? AND y0 <= ? AND z1 >= ? AND z0 <= ?"
        statement = f"SELECT DISTINCT id / ? FROM boxes WHERE {meets}"
        return {row[0] for row in self._rows(statement, (MOST_INSTANCES, x0, x1, y0, y1, z0, z1))}

    def _array(self, blob: Any, dtype: np.dtype[Any], shape: tuple[int, ...]) -> NDArray[Any]:
        """A read-only array over a blob; refused where it is of another size, or holds NaN or infinity."""
        try:
            array = np.frombuffer(blob, dtype).reshape(shape)
        except (ValueError, TypeError) as error:
            raise self._refused(str(error)) from None
        if dtype.kind == "f" and not np.isfinite(array).all():
            raise self._refused("an array holds NaN or infinity")
        return array

    # What changes -------------------------------------------------------------------------------------------------

    def set_root(self, root: Path) -> None:
        """Note the folder that is indexed."""
        self._run("INSERT OR REPLACE INTO about VALUES ('root', ?)", (str(root.resolve()),))

    def add(self, entry: SceneEntry, arrays: SceneArrays) -> None:
        """A scene, in place of one of the same name. Its id is given here, its kin and judgement later."""
        self.remove(entry.name)
        values = (
            entry.name, entry.digest, entry.bytes, entry.modified, entry.feature_space, entry.width, entry.points,
            entry.vocabulary, entry.bank, entry.encoder, arrays.instances.tobytes(), arrays.owner.tobytes(),
            arrays.descriptors.tobytes(),
        )  # fmt: skip
        columns = (
            "name, digest, bytes, modified, space, width, points, vocabulary, bank, encoder, instances, owner, "
            "descriptors"
        )
        id = self._run(f"INSERT INTO scenes({columns}) VALUES ({', '.join('?' * len(values))})", values).lastrowid
        assert id is not None
        known = np.flatnonzero(arrays.instances["points"])
        low, high = arrays.instances["low"][known].tolist(), arrays.instances["high"][known].tolist()
        rows = (
            (id * MOST_INSTANCES + k, x0, x1, y0, y1, z0, z1)
            for k, (x0, y0, z0), (x1, y1, z1) in zip(known.tolist(), low, high, strict=True)
        )
        self._many("INSERT INTO boxes VALUES (?, ?, ?, ?, ?, ?, ?)", rows)

    def remove(self, name: str) -> None:
        """Forget a scene, if there is one of this name."""
        for (id,) in list(self._rows("SELECT id FROM scenes WHERE name = ?", (name,))):
            self._run("DELETE FROM boxes WHERE id >= ? AND id < ?", (id * MOST_INSTANCES, (id + 1) * MOST_INSTANCES))
            self._run("DELETE FROM judgements WHERE scene = ?", (id,))
            self._run("DELETE FROM scenes WHERE id = ?", (id,))

    def touch(self, entry: SceneEntry, modified: int) -> None:
        """Note that a file has another date and the same content."""
        self._run("UPDATE scenes SET modified = ? WHERE id = ?", (modified, entry.id))

    def add_words(self, names: tuple[str, ...], vectors: NDArray[np.float32]) -> str:
        """Words with vectors (n, D); returns their digest. The same are stored once."""
        text, blob = json.dumps(names, ensure_ascii=False), np.ascontiguousarray(vectors, "<f4").tobytes()
        digest = blake2b(text.encode() + b"\0" + blob, digest_size=16).hexdigest()
        self._run("INSERT OR IGNORE INTO words VALUES (?, ?, ?, ?)", (digest, text, vectors.shape[1], blob))
        return digest

    def judge(self, entry: SceneEntry, judge: str | None, made: Standard | None) -> None:
        """Give a scene another judge, and what that makes of its descriptors; None for none."""
        self._run("DELETE FROM judgements WHERE scene = ?", (entry.id,))
        if made is not None:
            blob = np.concatenate([made.common, made.scale, made.shift]).astype("<f4").tobytes()
            self._run("INSERT INTO judgements VALUES (?, ?, ?, ?)", (entry.id, judge, made.sharpness, blob))

    def set_kin(self, kin: dict[int, int]) -> None:
        """kin: number by scene id, for all scenes; words that no scene needs any more are forgotten."""
        self._many("UPDATE scenes SET kin = ? WHERE id = ?", ((number, id) for id, number in kin.items()))
        used = " UNION ".join(
            f"SELECT {column} FROM {table} WHERE {column} IS NOT NULL"
            for column, table in (("vocabulary", "scenes"), ("bank", "scenes"), ("judge", "judgements"))
        )
        self._run(f"DELETE FROM words WHERE digest NOT IN ({used})")

    def _many(self, statement: str, rows: Iterator[tuple[Any, ...]]) -> None:
        try:
            self._connection.executemany(statement, rows)
        except sqlite3.Error as error:
            raise self._failed(error) from None
