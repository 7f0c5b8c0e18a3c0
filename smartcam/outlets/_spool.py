"""A spool: what waits for a far end, in a file that survives a crash of its process."""

from __future__ import annotations

import contextlib
import json
import os
import sqlite3
import time
from typing import TYPE_CHECKING, Literal, NamedTuple, TypeAlias

from smartcam._locks import try_lock
from smartcam.exceptions import ConfigurationError
from smartcam.outlets._entry import OutletAccount, OutletEntry

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

Policy: TypeAlias = Literal["drop_oldest", "drop_newest"]

ROW_BYTES = 200
"""Bytes that an entry takes in the file beside its text, about."""

MAX_PLACE = (1 << 63) - 1
"""The last place that an entry may have."""

MAX_DAMAGED_FILES = 3
"""Damaged spools that are kept beside the new one."""

_SCHEMA = """
CREATE TABLE IF NOT EXISTS entries(
    place INTEGER PRIMARY KEY AUTOINCREMENT, camera TEXT NOT NULL, epoch INTEGER NOT NULL,
    number INTEGER NOT NULL, kind TEXT NOT NULL, application INTEGER, at REAL NOT NULL,
    body TEXT NOT NULL, bytes INTEGER NOT NULL, count INTEGER NOT NULL);
CREATE INDEX IF NOT EXISTS of_camera ON entries(camera, place);
CREATE TABLE IF NOT EXISTS counts(name TEXT PRIMARY KEY, value INTEGER NOT NULL);
CREATE TABLE IF NOT EXISTS cameras(camera TEXT PRIMARY KEY, epoch INTEGER, number INTEGER);
"""
_COUNT = "SELECT COUNT(*) FROM entries WHERE kind != 'gap'"
_FIELDS = "camera, epoch, number, kind, application, at, body"
_INSERT = f"INSERT INTO entries({_FIELDS}, bytes, count) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)"  # noqa: S608


class SpoolHead(NamedTuple):
    """Entries at the head of the spool, and their places."""

    places: list[int]
    entries: list[OutletEntry]


class Spool:
    """A spool in one file; every method blocks, and belongs to one thread at a time.

    Args:
        path: the file; made if it is not there. A damaged one is put aside, what can be read of it
            is kept, and a gap tells of the rest.
        max_bytes: bytes of entries that wait at most.
        policy: what happens beyond: the oldest entries make room, or the newest are refused; both
            are counted, and a gap stands where they were.
        durable: whether each write reaches the disk before it counts, so that a loss of power
            takes nothing; otherwise only a crash of the process takes nothing.

    Raises:
        ConfigurationError: another process has the spool.
        sqlite3.Error: the file cannot be made or written.

    Attributes:
        epoch: number of this start, larger than all before, whatever the clock says.
    """

    def __init__(
        self, path: Path, max_bytes: int, policy: Policy = "drop_oldest", *, durable: bool = False
    ) -> None:
        self.path = path
        self._max_bytes, self._policy, self._durable = max_bytes, policy, durable
        self._database: sqlite3.Connection | None = None
        self.epoch: int = 0
        self._counts: dict[str, int] = {}
        self._bytes = self._spooled = 0
        self._in_flight = 0  # the last place that is being delivered: it is not dropped
        self._lock: int | None = None

    def open(self) -> None:
        """Open the file."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if self._lock is None:
            self._lock = os.open(self.path.with_suffix(".lock"), os.O_RDWR | os.O_CREAT, 0o600)
            if try_lock(self._lock) is False:
                os.close(self._lock)
                self._lock = None
                raise ConfigurationError(f"outlet's spool {self.path}: another process has it")
        try:
            self._connect()
        except sqlite3.OperationalError:
            raise  # the disk is full or away
        except sqlite3.DatabaseError as exc:
            self._start_anew(str(exc))

    def reopen(self) -> None:
        """Open the file again where it turned out to be damaged."""
        database, self._database = self._database, None
        if database is not None:
            database.close()
        self.open()

    def _connect(self) -> None:
        database = sqlite3.connect(
            self.path, timeout=0.5, isolation_level=None, check_same_thread=False
        )
        try:
            database.execute("PRAGMA journal_mode = WAL")
            database.execute(f"PRAGMA synchronous = {'FULL' if self._durable else 'NORMAL'}")
            database.execute("BEGIN IMMEDIATE")
            database.execute("COMMIT")
            ((found,),) = database.execute("PRAGMA quick_check(1)").fetchall()
            if found != "ok":
                raise sqlite3.DatabaseError(found)
            database.executescript(_SCHEMA)
            self._load(database)
        except BaseException:
            database.close()
            raise
        self._database = database

    def _load(self, database: sqlite3.Connection) -> None:
        self._counts = dict(database.execute("SELECT name, value FROM counts"))
        spooled, size = database.execute(
            "SELECT COUNT(*) FILTER (WHERE kind != 'gap'), COALESCE(SUM(bytes), 0) FROM entries"
        ).fetchone()
        self._spooled, self._bytes = spooled, size
        known = self._counts.get("epoch", 0)
        self.epoch = max(known + 1, time.time_ns() // 1000)
        with _transaction(database):
            if self._counts.get("running"):  # nobody ended it: what waited in memory is gone
                for camera, epoch, number in database.execute(
                    "SELECT camera, epoch, number FROM cameras"
                ).fetchall():
                    _add_gap(
                        database,
                        OutletEntry(camera, epoch, number, "gap", None, time.time(), ""),
                        0,
                        "the process ended at once; what came behind the last entry may be missing",
                        0,
                    )
            database.execute("DELETE FROM cameras")
            _set(database, {"epoch": self.epoch, "running": 1})
        self._counts |= {"epoch": self.epoch, "running": 1}

    def _start_anew(self, why: str) -> None:
        """Put a damaged file aside, and keep what can be read of it."""
        saved, counts = _salvaged(self.path)
        stamp = time.time_ns()
        for suffix in ("", "-wal", "-shm"):
            part = self.path.with_name(self.path.name + suffix)
            if part.exists():
                part.replace(self.path.with_name(f"{self.path.name}.damaged-{stamp}{suffix}"))
        self._forget_damaged()
        lost = 0
        if counts:
            counts["running"] = 1
            waited = counts.get("results", 0) - counts.get("delivered", 0)
            waited -= sum(value for name, value in counts.items() if name.startswith("dropped."))
            kept = sum(entry.kind != "gap" for entry in saved)
            lost = max(0, waited - kept)
            # the counts may be of an older page than the entries
            counts["results"] = counts.get("results", 0) + max(0, kept - waited)
            counts["dropped.damaged"] = counts.get("dropped.damaged", 0) + lost
        else:
            counts = {"results": sum(entry.kind != "gap" for entry in saved)}
        self._connect()
        before = max([counts.get("epoch", 0), *(entry.epoch for entry in saved)])
        counts["epoch"] = self.epoch = max(self.epoch, before + 1)
        database = self._there
        with _transaction(database):
            _set(database, counts)
            _add_gap(
                database,
                OutletEntry("", self.epoch, 0, "gap", None, time.time(), ""),
                lost,
                f"the spool was damaged ({why}); the file is kept beside it",
                0,
            )
        self._counts |= counts
        self._insert(saved)

    def _forget_damaged(self) -> None:
        pattern = f"{self.path.name}.damaged-*"
        names = sorted(
            one for one in self.path.parent.glob(pattern) if one.name[-4:] not in ("-wal", "-shm")
        )
        for one in names[:-MAX_DAMAGED_FILES]:
            for suffix in ("", "-wal", "-shm"):
                one.with_name(one.name + suffix).unlink(missing_ok=True)

    @property
    def _there(self) -> sqlite3.Connection:
        if self._database is None:
            raise sqlite3.OperationalError("the spool is closed")
        return self._database

    # ------------------------------------------------------------------ writing

    def add(
        self, entries: Sequence[OutletEntry], lost: Sequence[tuple[OutletEntry, int, str]] = ()
    ) -> None:
        """Keep entries that came, all or none, and tell gaps before them.

        Args:
            entries: results and errors, and gaps that a source tells.
            lost: entries that found no room in memory: the last one, their number, the reason.

        Raises:
            sqlite3.Error: the disk is full or away; nothing was kept and nothing counted.
        """
        database = self._there
        new = dict(self._counts)
        with _transaction(database):
            for last, count, why in lost:
                _add_gap(database, last, count, why, self._in_flight)
                new["results"] = new.get("results", 0) + count
                new["dropped.memory"] = new.get("dropped.memory", 0) + count
            came = sum(entry.kind != "gap" for entry in entries)
            new["results"] = new.get("results", 0) + came
            kept = list(entries)
            if self._policy == "drop_newest":
                kept = self._refuse(database, kept, new)
            size = self._write(database, kept)
            gone, freed = self._make_room(database, self._bytes + size, new)
            _set(database, new)
        self._counts = new
        self._bytes += size - freed
        self._spooled += sum(entry.kind != "gap" for entry in kept) - gone

    def _insert(self, entries: Sequence[OutletEntry]) -> None:
        database = self._there
        with _transaction(database):
            self._bytes += self._write(database, entries)
        self._spooled += sum(entry.kind != "gap" for entry in entries)

    def _write(self, database: sqlite3.Connection, entries: Sequence[OutletEntry]) -> int:
        sizes = [len(entry.body) + ROW_BYTES for entry in entries]
        rows = [(*entry, size, 1) for entry, size in zip(entries, sizes, strict=True)]
        database.executemany(_INSERT, rows)
        last = {entry.camera: (entry.camera, entry.epoch, entry.number) for entry in entries}
        database.executemany("INSERT OR REPLACE INTO cameras VALUES (?, ?, ?)", last.values())
        return sum(sizes)

    def _refuse(
        self, database: sqlite3.Connection, entries: list[OutletEntry], counts: dict[str, int]
    ) -> list[OutletEntry]:
        """Return the entries that there is room for; those behind become gaps."""
        room, taken = self._max_bytes - self._bytes, 0
        for entry in entries:
            room -= len(entry.body) + ROW_BYTES
            if room < 0:
                break
            taken += 1
        refused = [one for one in entries[taken:] if one.kind != "gap"]
        counts["dropped.full"] = counts.get("dropped.full", 0) + len(refused)
        for last, count in _by_camera(refused):
            _add_gap(database, last, count, "the spool was full", self._in_flight)
        return entries[:taken]

    def _make_room(
        self, database: sqlite3.Connection, size: int, counts: dict[str, int]
    ) -> tuple[int, int]:
        """Drop the oldest entries beyond the bound; return how many, and their bytes."""
        if size <= self._max_bytes or self._policy != "drop_oldest":
            return 0, 0
        freed, places, dropped = 0, list[int](), list[OutletEntry]()
        for place, size_of, *fields in database.execute(
            f"SELECT place, bytes, {_FIELDS} FROM entries WHERE place > ? AND kind != 'gap' "  # noqa: S608
            "ORDER BY place",
            (self._in_flight,),
        ):
            if size - freed <= self._max_bytes:
                break
            places.append(place)
            dropped.append(OutletEntry(*fields))
            freed += size_of
        database.executemany("DELETE FROM entries WHERE place = ?", [(one,) for one in places])
        last_places = {entry.camera: place for entry, place in zip(dropped, places, strict=True)}
        for last, count in _by_camera(dropped):
            place = last_places[last.camera]
            _add_gap(database, last, count, "the spool was full", self._in_flight, place)
        counts["dropped.full"] = counts.get("dropped.full", 0) + len(dropped)
        return len(dropped), freed

    # ------------------------------------------------------------------ delivering

    def head(self, most: int) -> SpoolHead:
        """Return the oldest entries, ``most`` at most; they stay, and are in flight until told."""
        places, entries = list[int](), list[OutletEntry]()
        for place, *fields in self._there.execute(
            f"SELECT place, {_FIELDS} FROM entries ORDER BY place LIMIT ?",  # noqa: S608
            (most,),
        ):
            places.append(place)
            entries.append(OutletEntry(*fields))
        self._in_flight = places[-1] if places else 0
        return SpoolHead(places, entries)

    def done(self, waiting: SpoolHead, count: int | None = None, refused: str = "") -> None:
        """Forget the first ``count`` entries, which the far end took; None: all.

        Args:
            waiting: entries of :meth:`head`.
            count: number of those that were taken.
            refused: why the far end never takes the next one; "" where none was refused.
        """
        database = self._there
        taken = len(waiting.places) if count is None else count
        places, entries = waiting.places[:taken], waiting.entries[:taken]
        delivered = sum(entry.kind != "gap" for entry in entries)
        counts = {"delivered": self._counts.get("delivered", 0) + delivered}
        gone = delivered
        with _transaction(database):
            if refused:
                place, entry = waiting.places[taken], waiting.entries[taken]
                places, entries = [*places, place], [*entries, entry]
                if entry.kind != "gap":
                    counts["dropped.refused"] = self._counts.get("dropped.refused", 0) + 1
                    gone += 1
            database.executemany("DELETE FROM entries WHERE place = ?", [(one,) for one in places])
            _set(database, counts)
        self._counts |= counts
        freed = sum(len(one.body) + ROW_BYTES for one in entries if one.kind != "gap")
        self._bytes -= freed
        self._spooled -= gone
        self._in_flight = 0

    # ------------------------------------------------------------------ the account

    @property
    def account(self) -> OutletAccount:
        """The account of what is in the file."""
        return _account(self._counts, self._spooled)

    @property
    def bytes(self) -> int:
        """The bytes of entries that wait."""
        return self._bytes

    def close(self) -> None:
        """Close the file, and mark it as ended well."""
        database, self._database = self._database, None
        if database is not None:
            with contextlib.suppress(sqlite3.Error), _transaction(database):
                _set(database, {"running": 0})
            database.close()
        lock, self._lock = self._lock, None
        if lock is not None:
            os.close(lock)


def read_account(path: Path) -> OutletAccount | None:
    """Return the account in a spool's file, which a process may have; None where there is none.

    Raises:
        sqlite3.Error: it cannot be read now.
    """
    if not path.exists():
        return None
    place = f"{path.absolute().as_uri()}?mode=ro"
    with contextlib.closing(sqlite3.connect(place, uri=True, timeout=1.0)) as database:
        database.execute("BEGIN")
        counts = dict(database.execute("SELECT name, value FROM counts"))
        (spooled,) = database.execute(_COUNT).fetchone()
    return _account(counts, spooled)


def _account(counts: dict[str, int], spooled: int) -> OutletAccount:
    dropped = {
        name.removeprefix("dropped."): value
        for name, value in counts.items()
        if name.startswith("dropped.") and value
    }
    return OutletAccount(counts.get("results", 0), counts.get("delivered", 0), spooled, dropped)


@contextlib.contextmanager
def _transaction(database: sqlite3.Connection) -> Iterator[None]:
    database.execute("BEGIN IMMEDIATE")
    try:
        yield
        database.execute("COMMIT")
    except BaseException:
        with contextlib.suppress(sqlite3.Error):  # a full disk has rolled it back already
            database.execute("ROLLBACK")
        raise


def _set(database: sqlite3.Connection, new: dict[str, int]) -> None:
    database.executemany("INSERT OR REPLACE INTO counts VALUES (?, ?)", new.items())


def _by_camera(entries: Iterable[OutletEntry]) -> list[tuple[OutletEntry, int]]:
    """Return the last entry of each camera, and how many the camera had."""
    found: dict[str, tuple[OutletEntry, int]] = {}
    for entry in entries:
        found[entry.camera] = entry, found.get(entry.camera, (entry, 0))[1] + 1
    return [*found.values()]


def _add_gap(
    database: sqlite3.Connection,
    last: OutletEntry,
    count: int,
    why: str,
    in_flight: int,
    place: int | None = None,
) -> None:
    """Tell a gap, at a place that is free, or at the end; gaps that follow each other are one.

    Args:
        database: the spool.
        last: the last entry that the gap stands for.
        count: number of entries; 0 where nobody knows.
        why: reason.
        in_flight: place up to which entries are being delivered, and stay as they are.
        place: place of the gap; None: the end.
    """
    unknown, gone = count == 0, list[tuple[int]]()
    for there, kind, body in database.execute(
        "SELECT place, kind, body FROM entries WHERE camera = ? AND place > ? AND place <= ? "
        "ORDER BY place DESC",
        (last.camera, in_flight, MAX_PLACE if place is None else place),
    ):
        if kind != "gap":
            break
        said = json.loads(body)
        count += said["lost"]
        unknown = unknown or said["at_least"]
        gone.append((there,))
    database.executemany("DELETE FROM entries WHERE place = ?", gone)
    body = json.dumps({"error": why, "kind": "Gap", "lost": count, "at_least": unknown})
    database.execute(
        f"INSERT INTO entries(place, {_FIELDS}, bytes, count) "  # noqa: S608
        "VALUES (?, ?, ?, ?, 'gap', NULL, ?, ?, 0, ?)",
        (place, last.camera, last.epoch, last.number, last.at, body, count),
    )


def _salvaged(path: Path) -> tuple[list[OutletEntry], dict[str, int]]:
    """Return the entries and the counts that can be read of a damaged file."""
    entries, counts = list[OutletEntry](), dict[str, int]()
    with contextlib.suppress(sqlite3.Error), contextlib.closing(sqlite3.connect(path)) as database:
        with contextlib.suppress(sqlite3.Error):
            counts = dict(database.execute("SELECT name, value FROM counts"))
        with contextlib.suppress(sqlite3.Error, TypeError):
            for row in database.execute(f"SELECT {_FIELDS} FROM entries ORDER BY place"):  # noqa: S608
                entry = OutletEntry(*row)
                if isinstance(entry.body, str) and isinstance(entry.camera, str):
                    entries.append(entry)
    return entries, counts
