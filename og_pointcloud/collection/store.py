"""The atlas: what is known about the instances of many scenes, in one SQLite file. Its content is read as untrusted.

    scenes      a row each: name, hash of its file, feature space; arrays of its instances and descriptors
    words       vocabularies and word banks by a hash of their content, each once, however many scenes share them
    judgements  the words that a scene's instances are judged by, and the resulting `Standard` of its descriptors
    boxes       an R*Tree of the boxes of scenes

A change is one transaction: a reader sees the atlas before it or after it, and a killed process leaves the one before.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import astuple, dataclass
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from og_pointcloud.ask.choosing import Standard
from og_pointcloud.cloud import InstanceTable, Vocabulary, WordBank
from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.formats.atomic import StrPath, replacing

APPLICATION_ID, VERSION = 0x4F474154, 2
"""SQLite's application_id ("OGAT") and user_version; the latter is raised when older atlases become unreadable."""
SCHEMA = (
    "CREATE TABLE about(name TEXT PRIMARY KEY, value TEXT NOT NULL)",
    "CREATE TABLE scenes(id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE, digest TEXT NOT NULL, "
    "feature_space TEXT NOT NULL, bytes INTEGER NOT NULL, modified INTEGER NOT NULL, width INTEGER NOT NULL, "
    "encoder INTEGER NOT NULL, vocabulary TEXT, bank TEXT, instances BLOB NOT NULL, owner BLOB NOT NULL, "
    "descriptors BLOB NOT NULL)",
    "CREATE TABLE words(digest TEXT PRIMARY KEY, names TEXT NOT NULL, width INTEGER NOT NULL, vectors BLOB NOT NULL)",
    "CREATE TABLE judgements(scene INTEGER PRIMARY KEY, judge TEXT NOT NULL, sharpness REAL NOT NULL, "
    "standard BLOB NOT NULL)",
    "CREATE VIRTUAL TABLE boxes USING rtree(id, x0, x1, y0, y1, z0, z1)",
)
ENTRY_COLUMNS = (
    "id, CAST(name AS TEXT), CAST(digest AS TEXT), CAST(feature_space AS TEXT), bytes, modified, "
    "max(0, CAST(width AS INTEGER)), encoder, vocabulary, bank, judge, length(instances), length(descriptors)"
)
"""Columns of a `SceneEntry`; cast, since SQLite does not hold columns to their types."""
INSTANCE_RECORD = np.dtype([
    ("points", "<i4"), ("views", "<i4"), ("masks", "<i4"), ("part_of", "<i4"), ("agreement", "<f4"),
    ("visible_area", "<f4"), ("box", "<f8", (2, 3)),
])  # fmt: skip
"""Record of an instance: columns of its `InstanceTable`, and the low and high corner of the axis-aligned box of its
main part, in the scene's unit, 0 where it has no points."""
SUPER_JOURNAL_MARK = bytes.fromhex("d9d505f920a163d7")
"""The last bytes of a journal that names another file, which SQLite would delete (readSuperJournal in its pager.c)."""
LOCK_TIMEOUT_S = 30.0
"""Seconds that a change waits for another one to finish."""


@dataclass(frozen=True)
class SceneEntry:
    """A scene without its arrays. name: its file's path below the folder that was indexed, without the ending.

    digest, bytes, modified: of the file. feature_space, width: of its descriptors. encoder: 1 if the file carries a
    text encoder. vocabulary, bank: digests in `words`, or None. judge: digest of the bank that its instances are judged
    by, or None. instances: their number; numbers: number of float32 values of their descriptors.
    """

    id: int
    name: str
    digest: str = ""
    feature_space: str = ""
    bytes: int = 0
    modified: int = 0
    width: int = 0
    encoder: int = 0
    vocabulary: str | None = None
    bank: str | None = None
    judge: str | None = None
    instances: int = 0
    numbers: int = 0


class Atlas:
    """An open atlas. Made by `reading` or `writing`.

    OgPointcloudError, beginning with the path, where the file is damaged, or no atlas of ours.
    """

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self.path, self._run = path, connection.execute

    @classmethod
    @contextmanager
    def reading(cls, path: StrPath) -> Iterator[Atlas]:
        """For reading alone; several processes may."""
        path = Path(path)
        if not path.is_file():
            raise OgPointcloudError(f"{path} is not a file; expected an atlas: make it with og-pointcloud index")
        with cls._connected(path, "ro") as atlas:
            try:
                atlas._check()
            except sqlite3.OperationalError as error:
                if "readonly" not in str(error):
                    raise
                # The journal of a killed change, which SQLite undoes only for those who may write.
                with cls._connected(path, "rw") as writable:
                    writable._check()
                atlas._check()
            yield atlas

    @classmethod
    @contextmanager
    def writing(cls, path: StrPath) -> Iterator[Atlas]:
        """For one change, which takes effect if the block ends without an error. A missing file is created beside its
        path and moved there at the end: if two processes create it at once, the last one to end wins."""
        path = Path(path)
        if path.is_file() and path.stat().st_size:
            with cls._connected(path, "rw") as atlas:
                atlas._run("BEGIN IMMEDIATE")
                atlas._check()
                yield atlas
                atlas._run("COMMIT")
            return
        marks = (f"PRAGMA application_id = {APPLICATION_ID}", f"PRAGMA user_version = {VERSION}")
        with replacing(path) as file, cls._connected(path, "rw", Path(file.name)) as atlas:
            path.with_name(f"{path.name}-journal").unlink(
                missing_ok=True
            )  # of a deleted atlas: it would be rolled back
            for statement in ("PRAGMA journal_mode = MEMORY", "BEGIN IMMEDIATE", *SCHEMA, *marks):
                atlas._run(statement)
            yield atlas
            atlas._run("COMMIT")

    @classmethod
    @contextmanager
    def _connected(cls, path: Path, mode: str, file: Path | None = None) -> Iterator[Atlas]:
        """file: its path until it is moved to ``path``."""
        uri, journal = f"{(file or path).resolve().as_uri()}?mode={mode}", path.with_name(f"{path.name}-journal")
        if mode == "rw" and file is None and journal.is_file():
            with journal.open("rb") as stream:
                stream.seek(max(0, journal.stat().st_size - len(SUPER_JOURNAL_MARK)))
                if stream.read() == SUPER_JOURNAL_MARK:
                    raise _refused(path, f"{journal.name} names another file, which would be deleted")
        try:
            with closing(sqlite3.connect(uri, uri=True, timeout=LOCK_TIMEOUT_S, isolation_level=None)) as connection:
                # Recommended by SQLite for untrusted files (sqlite.org/security.html).
                connection.execute("PRAGMA trusted_schema = OFF")
                connection.execute("PRAGMA cell_size_check = ON")
                yield cls(path, connection)  # uncommitted changes are rolled back when it is closed
        except (sqlite3.Error, UnicodeDecodeError) as error:  # an error may quote bytes of the file
            raise _explained(path, str(error)) from None

    def _check(self) -> None:
        """Refuse other databases, and those with views, triggers or columns that ours do not have."""
        marks = tuple(self._run(f"PRAGMA {name}").fetchone()[0] for name in ("application_id", "user_version"))
        if marks != (APPLICATION_ID, VERSION):
            raise _refused(self.path, f"its application and version are {marks}; expected {(APPLICATION_ID, VERSION)}")
        # SQLite keeps the text of each CREATE. Its automatic indices have none; the R*Tree's internal tables, boxes_*,
        # have their own.
        query = "SELECT sql FROM sqlite_master WHERE sql <> '' AND NOT (type = 'table' AND name GLOB 'boxes_*')"
        if others := {row[0] for row in self._run(query)} ^ set(SCHEMA):
            raise _refused(self.path, f"its schema differs in {min(map(str, others)):.80}")

    # Reading: records are checked when they are constructed; what they refuse should not have been in the file -----

    @property
    def root(self) -> Path:
        """The folder that was indexed."""
        return Path(self.noted("root"))

    def noted(self, name: str) -> str:
        """The text that `note` stored under a name, "" if none."""
        row = self._run("SELECT value FROM about WHERE name = ?", (name,)).fetchone()
        return str(row[0]) if row else ""

    @property
    def fingerprint(self) -> str:
        """Changes whenever scenes, their contents or their judges change."""
        query = "SELECT id, digest, judge FROM scenes LEFT JOIN judgements ON scene = id ORDER BY id"
        return blake2b(repr(self._run(query).fetchall()).encode(), digest_size=16).hexdigest()

    def entries(self) -> list[SceneEntry]:
        """All scenes, by name."""
        rows = self._run(f"SELECT {ENTRY_COLUMNS} FROM scenes LEFT JOIN judgements ON scene = id ORDER BY name")
        # The last two columns are lengths of blobs in bytes: of records of instances, and of float32 numbers.
        counted = ((row[:-2], row[-2] // INSTANCE_RECORD.itemsize, row[-1] // 4) for row in rows)
        return [SceneEntry(*row, instances=size, numbers=numbers) for row, size, numbers in counted]

    def instances(self, entry: SceneEntry) -> tuple[InstanceTable, NDArray[np.float64]]:
        """The instances of a scene, with unit descriptors, and (K, 2, 3) low and high corners of their boxes."""
        statement = "SELECT instances, owner, descriptors FROM scenes WHERE id = ? AND digest = ?"
        with self._refusing_damage(f"the instances of '{entry.name}'"):
            row = self._run(statement, (entry.id, entry.digest)).fetchone()
            if row is None:
                raise ValueError("it was indexed again meanwhile")
            rows, owner = np.frombuffer(row[0], INSTANCE_RECORD), np.frombuffer(row[1], "<i4")
            columns = {name: rows[name].copy() for name in INSTANCE_RECORD.names or () if name != "box"}
            table = InstanceTable(_floats(row[2], len(owner), entry.width), owner, **columns)
            return table, _finite(rows["box"])

    def judgement(self, entry: SceneEntry, rows: int) -> Standard:
        """The `Standard` of a scene's descriptors under its judge. rows: their number."""
        statement = "SELECT sharpness, standard FROM judgements WHERE scene = ?"
        with self._refusing_damage(f"the judgement of '{entry.name}'"):
            sharpness, blob = self._run(statement, (entry.id,)).fetchone()
            parts = np.split(_floats(blob, entry.width + 2 * rows), [entry.width, entry.width + rows])
            return Standard(*parts, sharpness=float(_finite(np.float64(sharpness))))

    def words(self, digest: str) -> Vocabulary:
        """A vocabulary, or a bank, whose names are empty."""
        with self._refusing_damage(f"the words {digest!r:.40}"):
            row = self._run("SELECT names, width, vectors FROM words WHERE digest = ?", (digest,)).fetchone()
            names = tuple(str(name) for name in json.loads(row[0]))
            return Vocabulary(names, _floats(row[2], len(names), int(row[1])))

    def bank(self, digest: str, width: int) -> WordBank:
        """The words that judge descriptors of a width."""
        vectors = self.words(digest).vectors
        with self._refusing_damage(f"the bank {digest!r:.40}"):
            if vectors.shape[1] != width:
                raise ValueError(f"its words have dimension {vectors.shape[1]}, the descriptors {width}")
            return WordBank(vectors)

    def within(self, low: ArrayLike, high: ArrayLike) -> set[int]:
        """Ids of the scenes whose box around all their instances meets this one. low, high: (3,)."""
        (x0, y0, z0), (x1, y1, z1) = np.asarray(low, float).tolist(), np.asarray(high, float).tolist()
        meets = "x1 >= ? AND x0 <= ? AND y1 >= ? AND y0 <= ? AND z1 >= ? AND z0 <= ?"
        return {row[0] for row in self._run(f"SELECT id FROM boxes WHERE {meets}", (x0, x1, y0, y1, z0, z1))}

    def side_by_side(self, entries: Sequence[SceneEntry]) -> list[SceneEntry]:
        """The scenes ordered along a Z-curve (Morton 1966), so that those in a box form few runs of neighbors."""
        rows = self._run("SELECT id, x0 + x1, y0 + y1, z0 + z1 FROM boxes").fetchall()
        places = {id: place for id, *place in rows}
        twice = np.array([places.get(entry.id, [0, 0, 0]) for entry in entries], float).reshape(-1, 3)
        extent = np.ptp(twice, axis=0).max(initial=0) or 1.0
        # Centers (times two: only the order matters) in 2^10 cells per side; the bits of x, y and z are interleaved.
        cells = ((twice - twice.min(axis=0)) / extent * (2**10 - 1)).astype(np.int64)
        code = sum((cells[:, axis] >> bit & 1) << 3 * bit + axis for bit in range(10) for axis in range(3))
        return [entries[row] for row in np.argsort(code, kind="stable")]

    @contextmanager
    def _refusing_damage(self, what: str) -> Iterator[None]:
        try:
            yield
        except (OgPointcloudError, ValueError, TypeError, OverflowError, RecursionError) as error:
            raise _refused(self.path, f"{what}: {error}") from None

    # Writing ----------------------------------------------------------------------------------------------------

    def note(self, name: str, value: str) -> None:
        """Store a text under a name; "root" is the indexed folder."""
        self._run("INSERT OR REPLACE INTO about VALUES (?, ?)", (name, value))

    def add(self, entry: SceneEntry, table: InstanceTable, boxes: NDArray[np.float64]) -> None:
        """Add a scene, replacing one of the same name. Its id is assigned here, its judgement later. boxes: (K, 2,
        3)."""
        self.remove(entry.name)
        rows = np.zeros(len(table), INSTANCE_RECORD)
        for name in INSTANCE_RECORD.names or ():
            rows[name] = boxes if name == "box" else getattr(table, name)
        blobs = (rows.tobytes(), table.descriptor_instance.tobytes(), table.descriptors.tobytes())
        values = (None, *astuple(entry)[1:-3], *blobs)
        id = self._run(f"INSERT INTO scenes VALUES ({', '.join('?' * len(values))})", values).lastrowid
        if (shown := table.points > 0).any():
            corners = np.stack([boxes[shown, 0].min(axis=0), boxes[shown, 1].max(axis=0)], axis=1)
            self._run("INSERT INTO boxes VALUES (?, ?, ?, ?, ?, ?, ?)", (id, *corners.ravel().tolist()))

    def remove(self, name: str) -> None:
        """Forget a scene, if there is one of this name."""
        for (id,) in self._run("SELECT id FROM scenes WHERE name = ?", (name,)).fetchall():
            for table, key in (("boxes", "id"), ("judgements", "scene"), ("scenes", "id")):
                self._run(f"DELETE FROM {table} WHERE {key} = ?", (id,))

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
        """Replace a scene's judge and the resulting `Standard` of its descriptors; None for none."""
        self._run("DELETE FROM judgements WHERE scene = ?", (entry.id,))
        if made is not None:
            blob = np.concatenate([made.common, made.scale, made.shift]).astype("<f4").tobytes()
            self._run("INSERT INTO judgements VALUES (?, ?, ?, ?)", (entry.id, judge, made.sharpness, blob))

    def forget_unused_words(self) -> None:
        """Remove words that no scene needs anymore."""
        used = "SELECT vocabulary FROM scenes UNION SELECT bank FROM scenes UNION SELECT judge FROM judgements"
        self._run(f"DELETE FROM words WHERE digest IN (SELECT digest FROM words EXCEPT SELECT * FROM ({used}))")


def _floats(blob: bytes, *shape: int) -> NDArray[np.float32]:
    return _finite(np.frombuffer(blob, "<f4").reshape(shape))


def _finite(values: Any) -> Any:
    if not np.isfinite(values).all():
        raise ValueError("it contains NaN or infinity")
    return values


def _explained(path: Path, reason: str) -> OgPointcloudError:
    """An SQLite error, reworded to say what to do."""
    if "locked" in reason:
        return OgPointcloudError(f"{path} is being changed by another process; wait for it, then try again")
    if "unable to open" in reason:
        return OgPointcloudError(f"{path} cannot be opened ({reason}); expected a file in a folder that you may use")
    if "readonly" in reason:
        what = f"{path} cannot be written ({reason}), and a killed index run may have to be undone"
        return OgPointcloudError(f"{what}: run og-pointcloud index again where you may write")
    if "full" in reason or "I/O" in reason:
        return OgPointcloudError(f"{path} cannot be written ({reason}): it is unchanged; free some space")
    return _refused(path, reason)


def _refused(path: Path, reason: str) -> OgPointcloudError:
    again = "give og-pointcloud index an atlas, or a new name"
    return OgPointcloudError(f"{path} is not a usable atlas ({reason:.120}): {again}")
