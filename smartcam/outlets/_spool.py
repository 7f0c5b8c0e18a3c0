"""Keep entries that wait for a server in a spool: a file that survives a crash of the process."""

from __future__ import annotations

import contextlib
import json
import os
import sqlite3
import time
import zlib
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias

from smartcam._locks import try_lock
from smartcam.exceptions import ConfigurationError
from smartcam.outlets._database import open_database, open_for_reading
from smartcam.outlets._entry import OutletCounts, OutletEntry

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

Policy: TypeAlias = Literal["drop_oldest", "drop_newest"]

ROW_BYTES = 200
"""Approximate number of bytes of an entry in the file, without its text."""

MAX_ROW_ID = (1 << 63) - 1
"""Largest row id of an entry; the table's column is named ``place``."""

MIN_FREE_ROW_IDS = 1 << 32
"""Least number of free row ids after the last one. If there are fewer, the file is damaged."""

MAX_REASON_CHARACTERS = 500
"""Largest number of characters of a gap's reason; joined gaps have several reasons."""

MAX_DAMAGED_FILES = 3
"""Largest number of damaged files that are kept in the folder of the spool."""

_SCHEMA = """
CREATE TABLE IF NOT EXISTS entries(
    place INTEGER PRIMARY KEY AUTOINCREMENT, camera TEXT NOT NULL, epoch INTEGER NOT NULL,
    number INTEGER NOT NULL, kind TEXT NOT NULL, application INTEGER, at REAL NOT NULL,
    body TEXT NOT NULL, bytes INTEGER NOT NULL, checksum INTEGER NOT NULL);
CREATE INDEX IF NOT EXISTS of_camera ON entries(camera, place);
CREATE TABLE IF NOT EXISTS counts(name TEXT PRIMARY KEY, value INTEGER NOT NULL);
CREATE TABLE IF NOT EXISTS cameras(camera TEXT PRIMARY KEY, epoch INTEGER, number INTEGER);
"""
_TOTALS = "SELECT COUNT(*) FILTER (WHERE kind != 'gap'), COALESCE(SUM(bytes), 0) FROM entries"
_FIELDS = "camera, epoch, number, kind, application, at, body"
_INSERT = (
    f"INSERT INTO entries(place, {_FIELDS}, bytes, checksum) "  # noqa: S608
    "VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)"
)

_DISK_CODES = frozenset(
    {
        *(sqlite3.SQLITE_BUSY, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR),
        *(sqlite3.SQLITE_LOCKED, sqlite3.SQLITE_NOMEM, sqlite3.SQLITE_PERM),
        *(sqlite3.SQLITE_PROTOCOL, sqlite3.SQLITE_READONLY),
    }
)


def is_damage(error: sqlite3.Error) -> bool:
    """Return True if an error means a damaged file, not a full or unavailable disk."""
    code = getattr(error, "sqlite_errorcode", None)
    if code is None:
        return not isinstance(error, sqlite3.OperationalError)
    return code & 0xFF not in _DISK_CODES


class SpoolHead(NamedTuple):
    """The oldest entries of the spool, their row ids, and the spool's epoch."""

    row_ids: list[int]
    entries: list[OutletEntry]
    epoch: int


class Spool:
    """A spool in one file; every method blocks, and belongs to one thread at a time.

    Args:
        path: the file; created if it does not exist. A damaged file is renamed; its readable
            entries are kept in a new file, and a gap replaces the others.
        max_bytes: largest number of bytes of the waiting entries.
        policy: entries to drop beyond ``max_bytes``: the oldest or the newest. Dropped entries are
            counted, and a gap replaces them.
        durable: whether each write is synced, so that entries survive a power failure; otherwise
            they survive only a crash of the process.

    Raises:
        ConfigurationError: another process has the spool.
        sqlite3.Error: the file cannot be created or written.

    Attributes:
        epoch: number of this start, larger than those of earlier starts even if the clock was set
            back.
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
        self._in_flight = 0  # last row id that is being delivered; it is not dropped
        self._lock: int | None = None

    def open(self) -> None:
        """Open the file, for the first time or after an error has closed it."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if self._lock is None:
            self._lock = os.open(self.path.with_suffix(".lock"), os.O_RDWR | os.O_CREAT, 0o600)
            if try_lock(self._lock) is False:
                os.close(self._lock)
                self._lock = None
                raise ConfigurationError(f"outlet's spool {self.path}: another process has it")
        try:
            self._connect()
        except sqlite3.Error as exc:
            if not is_damage(exc):
                raise
            self._replace_file(str(exc))
        self._write_epoch(self.epoch)

    def replace_damaged(self, reason: str) -> None:
        """Rename the damaged file, and copy its readable entries to a new file."""
        database, self._database = self._database, None
        if database is not None:
            database.close()
        self._replace_file(reason)

    @property
    def closed(self) -> bool:
        """True if the file is not open, as after an error of :meth:`replace_damaged`."""
        return self._database is None

    def _connect(self) -> None:
        database = _open_connection(self.path)
        try:
            database.execute("PRAGMA journal_mode = WAL")
            database.execute(f"PRAGMA synchronous = {'FULL' if self._durable else 'NORMAL'}")
            _check_versions(self.path)
            database.execute("BEGIN IMMEDIATE")
            database.execute("COMMIT")
            ((answer,),) = database.execute("PRAGMA quick_check(1)").fetchall()
            if answer != "ok":
                raise sqlite3.DatabaseError(answer)
            database.executescript(_SCHEMA)
            self._load(database)
        except BaseException:
            database.close()
            raise
        self._database = database

    def _load(self, database: sqlite3.Connection) -> None:
        counts = _read_counts(database)
        self._spooled, self._bytes = database.execute(_TOTALS).fetchone()
        if not _outlet_counts(counts, self._spooled).balanced:
            raise sqlite3.DatabaseError("its counts do not balance")
        ((last_row_id,),) = database.execute(
            "SELECT COALESCE(MAX(place), 0) FROM entries"
        ).fetchall()
        if not last_row_id < _next_row_id(database):
            raise sqlite3.DatabaseError(f"row id {last_row_id} is above the recorded last one")
        file_epoch, lock_epoch = counts.get("epoch", 0), self._read_epoch()
        self.epoch = max(file_epoch + 1, lock_epoch + 1, time.time_ns() // 1000)
        with _transaction(database):
            if counts.get("running"):  # the process crashed: results that were in memory are lost
                reason = "the process crashed; results after the last entry may be missing"
                for camera, epoch, number in _last_numbers(database):
                    _add_gap(database, _make_gap(camera, epoch, number + 1), 0, reason, 0)
            database.execute("DELETE FROM cameras")
            database.execute("INSERT INTO cameras VALUES ('', ?, 0)", (self.epoch,))
            if lock_epoch > file_epoch:
                reason = "the spool's file was deleted or is an older copy; entries are lost"
                self._add_common_gap(database, 0, reason)
            _write_counts(database, {"epoch": self.epoch, "running": 1})
        self._counts = {**counts, "epoch": self.epoch, "running": 1}

    def _read_epoch(self) -> int:
        """Return the epoch in the lock file, a file of its own that outlives a deleted spool."""
        if self._lock is None:
            return 0
        os.lseek(self._lock, 0, os.SEEK_SET)
        text = os.read(self._lock, 20).strip()
        return int(text) if text.isdigit() else 0

    def _write_epoch(self, epoch: int) -> None:
        if self._lock is not None:
            os.lseek(self._lock, 0, os.SEEK_SET)
            os.write(self._lock, b"%20d" % epoch)

    def _add_common_gap(self, database: sqlite3.Connection, lost: int, reason: str) -> None:
        """Add a gap that concerns all cameras."""
        ((_, epoch, number),) = _last_numbers(database, "WHERE camera = ''")
        gap = _make_gap("", epoch, number + 1)
        _add_gap(database, gap, lost, reason, self._in_flight, may_be_more=True)
        database.execute("UPDATE cameras SET number = number + 1 WHERE camera = ''")

    def _replace_file(self, reason: str) -> None:
        """Rename the damaged file, and write its readable entries to a new one."""
        saved, counts = _salvage(self.path)
        stamp = time.time_ns()
        for suffix in ("", "-wal", "-shm"):
            file = self.path.with_name(self.path.name + suffix)
            if file.exists():
                file.replace(self.path.with_name(f"{self.path.name}.damaged-{stamp}{suffix}"))
        self._delete_old_damaged()
        database = _open_connection(self.path)
        with contextlib.closing(database):
            database.execute("PRAGMA journal_mode = WAL")
            database.executescript(_SCHEMA)
            with _transaction(database):
                self._write(database, saved)
                lost = _balance(database, counts)
                epoch = max([counts.get("epoch", 0), *(entry.epoch for entry in saved)])
                epoch = 1 + max(epoch, self._read_epoch(), time.time_ns() // 1000)
                _write_counts(database, {**counts, "epoch": epoch, "running": 0})
                text = f"the spool was damaged ({reason}); the file is kept beside it"
                _add_gap(database, _make_gap("", epoch, 0), lost, text, 0, may_be_more=True)
        self._write_epoch(epoch)
        self._in_flight = 0
        self._connect()

    def _delete_old_damaged(self) -> None:
        pattern = f"{self.path.name}.damaged-*"
        found = self.path.parent.glob(pattern)
        paths = sorted(path for path in found if path.name[-4:] not in ("-wal", "-shm"))
        for path in paths[:-MAX_DAMAGED_FILES]:
            for suffix in ("", "-wal", "-shm"):
                path.with_name(path.name + suffix).unlink(missing_ok=True)

    @property
    def _open_database(self) -> sqlite3.Connection:
        if self._database is None:
            raise sqlite3.OperationalError("the spool is closed")
        return self._database

    # ------------------------------------------------------------------ writing

    def add(
        self, entries: Sequence[OutletEntry], lost: Sequence[tuple[OutletEntry, int, str]] = ()
    ) -> None:
        """Write entries, all or none, and gaps before them.

        Args:
            entries: results and errors, and gaps that a source reported.
            lost: entries that were dropped from memory: the last one, their number, and the reason.

        Raises:
            sqlite3.Error: the disk is full or unavailable; no entry was written or counted.
        """
        database = self._open_database
        counts = dict(self._counts)
        with _transaction(database):
            for last, count, reason in lost:
                _add_gap(database, last, count, reason, self._in_flight)
                counts["results"] = counts.get("results", 0) + count
                counts["dropped.memory"] = counts.get("dropped.memory", 0) + count
            results = sum(entry.kind != "gap" for entry in entries)
            counts["results"] = counts.get("results", 0) + results
            fitting = len(entries)
            if self._policy == "drop_newest":
                fitting = self._count_fitting(entries)
            accepted = entries[:fitting]
            refused = [entry for entry in entries[fitting:] if entry.kind != "gap"]
            size = self._write(database, accepted)
            for last, count in _last_by_camera(refused):
                _add_gap(database, last, count, "the spool was full", self._in_flight)
            if refused:
                counts["dropped.full"] = counts.get("dropped.full", 0) + len(refused)
            _write_last_numbers(database, [*(last for last, _, _ in lost), *entries])
            dropped, freed = self._drop_oldest(database, self._bytes + size, counts)
            _write_counts(database, counts)
        self._counts = counts
        self._bytes += size - freed
        self._spooled += sum(entry.kind != "gap" for entry in accepted) - dropped

    def _write(self, database: sqlite3.Connection, entries: Sequence[OutletEntry]) -> int:
        rows = [
            _make_row(entry, row_id) for row_id, entry in enumerate(entries, _next_row_id(database))
        ]
        database.executemany(_INSERT, rows)
        return sum(row[-2] for row in rows)

    def _count_fitting(self, entries: Sequence[OutletEntry]) -> int:
        """Return the number of entries for which there is room."""
        room = self._max_bytes - self._bytes
        for count, entry in enumerate(entries):
            room -= len(entry.body) + ROW_BYTES
            if room < 0:
                return count
        return len(entries)

    def _drop_oldest(
        self, database: sqlite3.Connection, size: int, counts: dict[str, int]
    ) -> tuple[int, int]:
        """Drop the oldest entries beyond the bound; return their number and their bytes."""
        if size <= self._max_bytes or self._policy != "drop_oldest":
            return 0, 0
        freed, ids, dropped = 0, list[int](), list[OutletEntry]()
        for row_id, size_of, *fields in database.execute(
            f"SELECT place, bytes, {_FIELDS} FROM entries WHERE place > ? AND kind != 'gap' "  # noqa: S608
            "ORDER BY place",
            (self._in_flight,),
        ):
            if size - freed <= self._max_bytes:
                break
            ids.append(row_id)
            dropped.append(OutletEntry(*fields))
            freed += size_of
        database.executemany("DELETE FROM entries WHERE place = ?", [(row_id,) for row_id in ids])
        last_row_ids = {entry.camera: row_id for entry, row_id in zip(dropped, ids, strict=True)}
        for last, count in _last_by_camera(dropped):
            row_id = last_row_ids[last.camera]
            _add_gap(database, last, count, "the spool was full", self._in_flight, row_id)
        counts["dropped.full"] = counts.get("dropped.full", 0) + len(dropped)
        return len(dropped), freed

    # ------------------------------------------------------------------ delivering

    def head(self, max_count: int) -> SpoolHead:
        """Return the oldest entries, up to ``max_count``; none is dropped before the next call."""
        while True:
            row_ids, entries, damaged = list[int](), list[OutletEntry](), list[int]()
            for row_id, checksum, *fields in self._open_database.execute(
                f"SELECT place, checksum, {_FIELDS} FROM entries ORDER BY place LIMIT ?",  # noqa: S608
                (max_count,),
            ):
                entry = OutletEntry(*fields)
                if _checksum(entry, row_id) != checksum:
                    damaged.append(row_id)
                else:
                    row_ids.append(row_id)
                    entries.append(entry)
            if not damaged:
                self._in_flight = row_ids[-1] if row_ids else 0
                return SpoolHead(row_ids, entries, self.epoch)
            self._drop_damaged(damaged)

    def _drop_damaged(self, row_ids: Sequence[int]) -> None:
        """Drop damaged entries, and add a gap after the other entries."""
        database, counts = self._open_database, dict(self._counts)
        with _transaction(database):
            database.executemany(
                "DELETE FROM entries WHERE place = ?", [(row_id,) for row_id in row_ids]
            )
            lost = _balance(database, counts)
            self._add_common_gap(database, lost, "entries of the spool were damaged")
            _write_counts(database, counts)
        self._counts = counts
        self._spooled, self._bytes = database.execute(_TOTALS).fetchone()

    def remove_delivered(
        self, head: SpoolHead, count: int | None = None, refused: str = ""
    ) -> None:
        """Remove the first ``count`` entries of a head, which the server accepted; None: all.

        Args:
            head: entries from :meth:`head`.
            count: number of accepted entries.
            refused: reason why the server refused the next entry; "" if it did not.
        """
        database = self._open_database
        if head.epoch != self.epoch:
            return  # the file was replaced meanwhile: the entries are delivered again
        accepted = len(head.row_ids) if count is None else count
        row_ids, entries = head.row_ids[:accepted], head.entries[:accepted]
        delivered = sum(entry.kind != "gap" for entry in entries)
        counts = {"delivered": self._counts.get("delivered", 0) + delivered}
        removed = delivered
        with _transaction(database):
            if refused:
                row_id, entry = head.row_ids[accepted], head.entries[accepted]
                row_ids, entries = [*row_ids, row_id], [*entries, entry]
                if entry.kind != "gap":
                    counts["dropped.refused"] = self._counts.get("dropped.refused", 0) + 1
                    removed += 1
            database.executemany(
                "DELETE FROM entries WHERE place = ?", [(row_id,) for row_id in row_ids]
            )
            _write_counts(database, counts)
        self._counts |= counts
        freed = sum(len(entry.body) + ROW_BYTES for entry in entries if entry.kind != "gap")
        self._bytes -= freed
        self._spooled -= removed
        self._in_flight = 0

    # ------------------------------------------------------------------ the counts

    @property
    def counts(self) -> OutletCounts:
        """The counts of the entries in the file."""
        return _outlet_counts(self._counts, self._spooled)

    @property
    def bytes(self) -> int:
        """Number of bytes of the waiting entries."""
        return self._bytes

    def close(self, *, all_written: bool = True) -> None:
        """Close the file.

        Args:
            all_written: whether all waiting entries were written; if not, the next start adds a
                gap.
        """
        database, self._database = self._database, None
        if database is not None:
            if all_written:
                with contextlib.suppress(sqlite3.Error), _transaction(database):
                    _write_counts(database, {"running": 0})
            database.close()
        lock, self._lock = self._lock, None
        if lock is not None:
            os.close(lock)


def read_outlet_counts(path: Path) -> OutletCounts | None:
    """Return the counts in a spool's file; None without a file. A process may be using the file.

    Raises:
        sqlite3.Error: the file cannot be read now.
    """
    if not path.exists():
        return None
    with contextlib.closing(open_for_reading(path, timeout=1.0)) as database:
        database.execute("BEGIN")
        counts = _read_counts(database)
        spooled, _ = database.execute(_TOTALS).fetchone()
    return _outlet_counts(counts, spooled)


def _open_connection(path: Path) -> sqlite3.Connection:
    database = open_database(path, timeout=0.5)
    database.text_factory = _decode_text  # checksums detect damaged texts
    return database


def _check_versions(path: Path) -> None:
    """Check the file's format versions: with a damaged one, SQLite would open the file read-only.

    Raises:
        sqlite3.DatabaseError: the file's header is damaged.
    """
    with path.open("rb") as file:
        versions = file.read(20)[18:]
    if any(version not in {1, 2} for version in versions):
        raise sqlite3.DatabaseError(f"expected the versions 1 or 2, got {versions.hex(' ')}")


def _decode_text(data: bytes) -> str:
    return data.decode(errors="replace")


def _read_counts(database: sqlite3.Connection) -> dict[str, int]:
    """Return the counts in the file.

    Raises:
        sqlite3.DatabaseError: the counts are damaged.
    """
    counts = dict(database.execute("SELECT name, value FROM counts"))
    if not all(isinstance(count, int) and count >= 0 for count in counts.values()):
        raise sqlite3.DatabaseError("expected counts of 0 or more")
    return counts


def _outlet_counts(counts: Mapping[str, int], spooled: int) -> OutletCounts:
    dropped = {
        name.removeprefix("dropped."): value
        for name, value in counts.items()
        if name.startswith("dropped.") and value
    }
    return OutletCounts(counts.get("results", 0), counts.get("delivered", 0), spooled, dropped)


def _balance(database: sqlite3.Connection, counts: dict[str, int]) -> int:
    """Correct the counts to fit the entries in the file; return the number of lost entries."""
    spooled, _ = database.execute(_TOTALS).fetchone()
    totals = _outlet_counts(counts, int(spooled))
    counted = totals.delivered + totals.spooled + sum(totals.dropped.values())
    lost = max(0, totals.results - counted)  # the counts may be older than the entries
    counts["results"] = max(totals.results, counted)
    counts["dropped.damaged"] = counts.get("dropped.damaged", 0) + lost
    return lost


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


def _write_counts(database: sqlite3.Connection, new: Mapping[str, int]) -> None:
    database.executemany("INSERT OR REPLACE INTO counts VALUES (?, ?)", new.items())


def _write_last_numbers(database: sqlite3.Connection, entries: Sequence[OutletEntry]) -> None:
    """Write the number of each camera's last entry; after a crash, a gap follows this number."""
    last = {entry.camera: (entry.camera, entry.epoch, entry.number) for entry in entries}
    database.executemany("INSERT OR REPLACE INTO cameras VALUES (?, ?, ?)", last.values())


def _last_numbers(database: sqlite3.Connection, which: str = "") -> list[tuple[str, int, int]]:
    return database.execute(f"SELECT camera, epoch, number FROM cameras {which}").fetchall()  # noqa: S608


def _checksum(entry: OutletEntry, row_id: int) -> int:
    """Return the checksum of an entry and of its row id, which decides its order."""
    return zlib.crc32(repr((row_id, *entry)).encode(errors="backslashreplace"))


def _next_row_id(database: sqlite3.Connection) -> int:
    """Return the row id for the next entry, after those of all earlier entries.

    Raises:
        sqlite3.DatabaseError: the file's record of the last row id is damaged.
    """
    row = database.execute("SELECT seq FROM sqlite_sequence WHERE name = 'entries'").fetchone()
    last = 0 if row is None else row[0]
    if not isinstance(last, int) or not 0 <= last < MAX_ROW_ID - MIN_FREE_ROW_IDS:
        raise sqlite3.DatabaseError(f"expected the last place of an entry, got {last!r:.40}")
    return last + 1


def _make_row(entry: OutletEntry, row_id: int) -> tuple[Any, ...]:
    """Return the row of an entry for the table."""
    entry = entry._replace(at=float(entry.at))
    size = 0 if entry.kind == "gap" else len(entry.body) + ROW_BYTES
    return row_id, *entry, size, _checksum(entry, row_id)


def _make_gap(camera: str, epoch: int, number: int) -> OutletEntry:
    return OutletEntry(camera, epoch, number, "gap", None, time.time(), "")


def _last_by_camera(entries: Iterable[OutletEntry]) -> list[tuple[OutletEntry, int]]:
    """Return the last entry of each camera, and the number of the camera's entries."""
    counted: dict[str, tuple[OutletEntry, int]] = {}
    for entry in entries:
        counted[entry.camera] = entry, counted.get(entry.camera, (entry, 0))[1] + 1
    return [*counted.values()]


def _add_gap(
    database: sqlite3.Connection,
    last: OutletEntry,
    count: int,
    reason: str,
    in_flight: int,
    row_id: int | None = None,
    *,
    may_be_more: bool = False,
) -> None:
    """Add a gap, with a free row id or at the end; join it with the gaps before it.

    Args:
        database: the spool.
        last: the last entry that the gap replaces.
        count: number of replaced entries; 0 if it is unknown.
        reason: why entries are missing.
        in_flight: row id up to which entries are being delivered, and must not change.
        row_id: row id of the gap; None: the end.
        may_be_more: whether more entries than ``count`` may be missing.
    """
    may_be_more, joined_row_ids, reasons = may_be_more or count == 0, list[tuple[int]](), [reason]
    for older_row_id, checksum, *fields in database.execute(
        f"SELECT place, checksum, {_FIELDS} FROM entries "  # noqa: S608
        "WHERE camera = ? AND place > ? AND place <= ? ORDER BY place DESC",
        (last.camera, in_flight, MAX_ROW_ID if row_id is None else row_id),
    ):
        entry = OutletEntry(*fields)
        if entry.kind != "gap" or _checksum(entry, older_row_id) != checksum:
            break
        older = json.loads(entry.body)
        count += older["lost"]
        may_be_more = may_be_more or older["at_least"]
        reasons.append(older["error"])
        joined_row_ids.append((older_row_id,))
    database.executemany("DELETE FROM entries WHERE place = ?", joined_row_ids)
    unique_reasons = dict.fromkeys(
        reason for text in reversed(reasons) for reason in text.split("; ")
    )
    error = "; ".join(unique_reasons)[:MAX_REASON_CHARACTERS]
    body = json.dumps({"error": error, "kind": "Gap", "lost": count, "at_least": may_be_more})
    gap = OutletEntry(last.camera, last.epoch, last.number, "gap", None, last.at, body)
    database.execute(_INSERT, _make_row(gap, _next_row_id(database) if row_id is None else row_id))


def _salvage(path: Path) -> tuple[list[OutletEntry], dict[str, int]]:
    """Return the readable entries and counts of a damaged file."""
    entries, counts = dict[int, OutletEntry](), dict[str, int]()
    with contextlib.suppress(sqlite3.Error), contextlib.closing(_open_connection(path)) as database:
        with contextlib.suppress(sqlite3.Error):
            counts = _read_counts(database)
        for order in ("place", "place DESC"):  # a page in between may be unreadable
            with contextlib.suppress(sqlite3.Error):
                for row_id, checksum, *fields in database.execute(
                    f"SELECT place, checksum, {_FIELDS} FROM entries ORDER BY {order}"  # noqa: S608
                ):
                    if row_id in entries:
                        break
                    entry = OutletEntry(*fields)
                    if _checksum(entry, row_id) == checksum:
                        entries[row_id] = entry
    return [entries[row_id] for row_id in sorted(entries)], counts
