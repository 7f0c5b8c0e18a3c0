"""Store results in an SQLite file, with a table for each application."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import sqlite3
import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, cast

from pydantic import Field

from smartcam._file_values import Age, Size  # noqa: TC001 - pydantic needs them at run time
from smartcam._user_code import text_of
from smartcam.exceptions import ConfigurationError, EntryRefusedError, OutletError
from smartcam.outlets._database import open_database
from smartcam.outlets._outlet import Outlet
from smartcam.outlets._records import picture_of, records_of
from smartcam.outlets._settings import OutletSettings
from smartcam.outlets._stored import read_store

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence
    from concurrent.futures import Future
    from pathlib import Path

    from smartcam.outlets._entry import OutletEntry
    from smartcam.outlets._outlet import Column, OutletContext
    from smartcam.outlets._stored import StoredResults, StoreQuery

VERSION = 2
"""Version of the store's own tables, in the file's ``user_version``."""

MAX_COLUMNS = 500
"""Largest number of columns of an application's table; further values are only in
``results.value``."""

MAX_COLUMN_CHARACTERS = 100

EXPIRE_INTERVAL = 60.0
"""Seconds between two searches for results that are too old, and are deleted."""

_TABLES = """
CREATE TABLE IF NOT EXISTS results(
    id TEXT PRIMARY KEY, camera TEXT NOT NULL, epoch INTEGER NOT NULL, number INTEGER NOT NULL,
    kind TEXT NOT NULL, at TEXT NOT NULL, application INTEGER, sequence BLOB,
    triggered_at TEXT, latency REAL, error TEXT, error_kind TEXT, lost INTEGER, value TEXT,
    records INTEGER, picture TEXT, at_least INTEGER);
CREATE INDEX IF NOT EXISTS results_at ON results(at);
CREATE TABLE IF NOT EXISTS fields(
    application INTEGER NOT NULL, name TEXT NOT NULL, column_name TEXT NOT NULL,
    type TEXT NOT NULL, unit TEXT NOT NULL, since TEXT NOT NULL,
    PRIMARY KEY (application, column_name));
"""
_TYPES = {
    "bool": "INTEGER",
    "string": "TEXT",
    "real32": "REAL",
    "real64": "REAL",
    "uint64": "BLOB",  # stores values unchanged; INTEGER would make a REAL of a large one
}
_OWN_COLUMNS = frozenset({"id", "record", "rowid"})


class StoreSettings(OutletSettings):
    """The settings of a store of results."""

    file: str = Field(min_length=1, description="the file, beside this one; made if missing")
    keep: Age | None = Field(None, description="age beyond which results are deleted: 90 d")
    keep_size: Size | None = Field(
        None, description="size of the file beyond which the oldest are deleted: 10 GB"
    )
    pictures: str | None = Field(
        None,
        min_length=1,
        description="path of a result's picture, beside the file, with {camera}, {application}, "
        "{number} and {sequence} in it; the row has it if the picture exists",
    )


class ResultStore(Outlet[StoreSettings]):
    """Writes results, errors and gaps to an SQLite file; a repeated entry is not written twice.

    The table ``results`` has a row for each entry. ``app_7`` has a row for each record of the
    results of application 7. ``fields`` has the types and units of the columns of all ``app_``
    tables.
    """

    settings_class = StoreSettings

    def __init__(
        self, name: str, settings: StoreSettings, folder: Path, context: OutletContext
    ) -> None:
        super().__init__(name, settings, folder, context)
        self.path = folder / settings.file
        self._file: _StoreFile | None = None
        self._closing: Future[None] | None = None  # future of the previous file's closing

    async def open(self) -> None:
        """Wait until the previous connection is closed, then open the file, and migrate its tables.

        Raises:
            ConfigurationError: a newer version of smartcam made the file.
            sqlite3.Error: the file cannot be opened.
        """
        if self._closing is not None:  # a slow disk may still be closing it
            await asyncio.wait({asyncio.wrap_future(self._closing)})
        self._file = _StoreFile(self.name, self.path, self.settings, self.context)
        await _wait_for_thread(self._file.submit(self._file.open))

    async def deliver(self, entries: Sequence[OutletEntry]) -> None:
        """Write all entries or none; if one is refused, write only the entries before it."""
        file = self._file
        if file is None:
            raise sqlite3.OperationalError("the store is closed")
        await _wait_for_thread(file.submit(lambda: file.write(entries)))

    def stored(self, query: StoreQuery) -> StoredResults | None:
        """Return the results in the file.

        Raises:
            ConfigurationError: the file cannot be read.
        """
        return read_store(self.path, query)

    async def close(self) -> None:
        """Close the file."""
        file, self._file = self._file, None
        if file is not None:
            self._closing = file.submit(file.close, last=True)
            await _wait_for_thread(self._closing)


async def _wait_for_thread(running: Future[None]) -> None:
    """Wait for work of a thread; the thread finishes it even if the caller is cancelled."""
    await asyncio.shield(asyncio.wrap_future(running))


class _StoreFile:
    """A connection to the store's file, and the only thread that uses the connection.

    A slow disk may block the thread after the outlet has stopped waiting. So the outlet opens a new
    connection only after the thread has closed this one.

    Args:
        name: name of the outlet.
        path: path of the file.
        settings: settings of the store.
        context: callbacks into the process that has the cameras.
    """

    def __init__(
        self, name: str, path: Path, settings: StoreSettings, context: OutletContext
    ) -> None:
        self.path, self.settings, self.context = path, settings, context
        self._thread = ThreadPoolExecutor(1, f"smartcam.outlets.{name}.store")
        self._database: sqlite3.Connection | None = None
        self._columns: dict[
            tuple[str, int], dict[str, str]
        ] = {}  # columns that were looked up for the current batch
        self._expired_at = 0.0
        self._identity: object = None  # device and number of the opened file

    def submit(self, work: Callable[[], None], *, last: bool = False) -> Future[None]:
        """Run work in the thread; ``last``: the thread ends afterwards."""
        running = self._thread.submit(work)
        if last:
            self._thread.shutdown(wait=False)
        return running

    # ------------------------------------------------------------------ in the thread

    def open(self) -> None:
        """Open the file, and bring its tables to this version."""
        try:
            self._open()
        except BaseException:
            self.close()
            raise

    def _open(self) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._database = database = open_database(self.path, timeout=10.0)
        (version,) = database.execute("PRAGMA user_version").fetchone()
        if version > VERSION:
            raise ConfigurationError(
                f"the store {self.path} is of a newer smartcam: its version is {version}, this one "
                f"knows {VERSION}"
            )
        if not version:
            database.execute("PRAGMA auto_vacuum = INCREMENTAL")
        database.execute("PRAGMA journal_mode = WAL")
        database.execute("PRAGMA synchronous = FULL")  # the spool deletes what was written here
        with _transaction(database):
            for statement in filter(str.strip, _TABLES.split(";")):
                database.execute(statement)
            if version == 1:
                database.execute("ALTER TABLE results ADD COLUMN at_least INTEGER")
            database.execute(f"PRAGMA user_version = {VERSION}")
        self._identity = self._identity_at_path()
        self._expired_at = 0.0

    def _identity_at_path(self) -> object:
        """Return the device and the number of the file at the path; None without one."""
        try:
            status = self.path.stat()
        except FileNotFoundError:
            return None
        return status.st_dev, status.st_ino

    def close(self) -> None:
        """Close the file."""
        database, self._database = self._database, None
        if database is not None:
            database.close()

    def write(self, entries: Sequence[OutletEntry]) -> None:
        """Write entries, and delete old ones beyond the bounds."""
        database = self._database
        if database is None:
            raise sqlite3.OperationalError("the store is closed")
        try:
            self._write_all(database, entries)
        except EntryRefusedError as exc:
            self._write_all(database, entries[: exc.index])
            raise
        if time.monotonic() - self._expired_at > EXPIRE_INTERVAL or not self._expired_at:
            self._expire(database)
            self._expired_at = time.monotonic()

    def _write_all(self, database: sqlite3.Connection, entries: Sequence[OutletEntry]) -> None:
        """Write entries in one transaction.

        Raises:
            EntryRefusedError: an entry cannot be written; then none is written.
            OutletError: the file was moved or deleted meanwhile, so the entries must be written
                again to a new file.
        """
        self._columns.clear()  # a layout may have changed, or a transaction been rolled back
        with _transaction(database):
            for index, entry in enumerate(entries):
                try:
                    self._write_one(database, entry)
                except _REFUSING_ERRORS as exc:
                    raise EntryRefusedError(text_of(exc), index=index) from exc
        if self._identity_at_path() != self._identity:
            raise OutletError(f"the store {self.path} was moved or deleted: a new one is begun")

    def _write_one(self, database: sqlite3.Connection, entry: OutletEntry) -> None:
        fields: dict[str, Any] = _encodable(json.loads(entry.body))
        value = fields.get("value")
        records = records_of(value)
        row = (
            entry.id,
            *entry[:4],
            fields.get("received_at") or _time_text(entry.at),
            fields.get("application"),
            _sqlite_value(fields.get("sequence")),
            fields.get("triggered_at"),
            fields.get("latency"),
            fields.get("error"),
            fields.get("kind"),
            fields.get("lost"),
            None if value is None else json.dumps(value, separators=(",", ":")),
            None if records is None else len(records),
            self._picture_path(entry, fields),
            fields.get("at_least"),
        )
        marks = ", ".join("?" * len(row))
        written = database.execute(f"INSERT OR IGNORE INTO results VALUES ({marks})", row).rowcount  # noqa: S608
        if not written or entry.application is None or records is None:
            return
        columns = self._get_columns(database, entry.camera, entry.application, records)
        names = [*columns]
        cells = ", ".join(f'"{columns[name]}"' for name in names)
        marks = ", ".join("?" * (len(names) + 2))
        database.executemany(
            f"INSERT OR IGNORE INTO app_{entry.application}"  # noqa: S608
            f"(id, record{', ' if names else ''}{cells}) VALUES ({marks})",
            [
                (entry.id, number, *(_sqlite_value(record.get(name)) for name in names))
                for number, record in enumerate(records)
            ],
        )

    def _get_columns(
        self,
        database: sqlite3.Connection,
        camera: str,
        application: int,
        records: Sequence[Mapping[str, Any]],
    ) -> dict[str, str]:
        """Return an application's columns, by the values' names; add missing columns.

        A column stays if the layout no longer has its value. A value gets a new column if its type
        or unit has changed, or differs in another camera's layout.
        """
        known = self._columns.get((camera, application))
        if known is None:
            database.execute(
                f"CREATE TABLE IF NOT EXISTS app_{application}(id TEXT NOT NULL "
                "REFERENCES results(id), record INTEGER NOT NULL, PRIMARY KEY (id, record))"
            )
            known = self._columns[camera, application] = {}
            for name, kind, unit in self.context.columns(camera, application):
                self._add_column(database, application, known, (name, kind, unit))
        for record in records:
            for name, value in record.items():
                if name not in known and value is not None:
                    self._add_column(database, application, known, (name, _type_of(value), ""))
        return known

    def _add_column(
        self,
        database: sqlite3.Connection,
        application: int,
        known: dict[str, str],
        value_column: Column,
    ) -> None:
        """Find the column of a value, or create it, and add it to the known columns."""
        name, kind, unit = value_column
        rows = database.execute(
            "SELECT name, column_name, type, unit FROM fields WHERE application = ?", (application,)
        ).fetchall()
        for row_name, column, row_kind, row_unit in rows:
            if (row_name, _affinity(row_kind), row_unit) == (name, _affinity(kind), unit):
                known[name] = column
                return
        if len(rows) >= MAX_COLUMNS:
            return
        taken = {column.lower() for _, column, _, _ in rows} | _OWN_COLUMNS
        column = base = re.sub(r"\W", "_", name)[:MAX_COLUMN_CHARACTERS] or "value"
        if column.lower() in taken:
            column = base = f"{base}_{unit or kind}"
        n = 2
        while column.lower() in taken:
            column, n = f"{base}_{n}", n + 1
        database.execute(f'ALTER TABLE app_{application} ADD COLUMN "{column}" {_affinity(kind)}')
        database.execute(
            "INSERT INTO fields VALUES (?, ?, ?, ?, ?, ?)",
            (application, name, column, kind, unit, _time_text(time.time())),
        )
        known[name] = column

    def _picture_path(self, entry: OutletEntry, fields: Mapping[str, Any]) -> str | None:
        pattern, folder = self.settings.pictures, self.path.parent
        if pattern is None or entry.kind == "gap":
            return None
        picture = picture_of(pattern, folder, fields)
        return None if picture is None else str(picture.relative_to(folder))

    def _expire(self, database: sqlite3.Connection) -> None:
        """Delete the oldest results beyond the bounds of age and size, in small parts."""
        if self.settings.keep is not None:
            limit = _time_text(time.time() - self.settings.keep)
            while self._delete(database, "WHERE at < ?", (limit,)):
                pass
        size = self.settings.keep_size
        while size is not None and _used_bytes(database) > size:
            if not self._delete(database, "", ()):
                break
        database.execute("PRAGMA incremental_vacuum").fetchall()

    def _delete(self, database: sqlite3.Connection, condition: str, values: Iterable[Any]) -> int:
        query = f"SELECT id FROM results {condition} ORDER BY at LIMIT 100"  # noqa: S608
        ids = database.execute(query, (*values,)).fetchall()
        with _transaction(database):
            for (application,) in database.execute(
                "SELECT DISTINCT application FROM fields"
            ).fetchall():
                database.executemany(f"DELETE FROM app_{application} WHERE id = ?", ids)  # noqa: S608
            database.executemany("DELETE FROM results WHERE id = ?", ids)
        return len(ids)


_REFUSING_ERRORS = (
    ArithmeticError,
    LookupError,
    RecursionError,
    TypeError,
    ValueError,
    sqlite3.DataError,
)
"""Errors that writing an entry again would not avoid; so the entry is refused."""


def _encodable(value: Any) -> Any:
    """Return a JSON value whose texts can be encoded as UTF-8, with ? for other characters."""
    if isinstance(value, str):
        return value if value.isascii() else value.encode(errors="replace").decode()
    if isinstance(value, dict):
        fields = cast("dict[str, Any]", value)
        return {_encodable(name): _encodable(field) for name, field in fields.items()}
    return [*map(_encodable, value)] if isinstance(value, list) else value


def _used_bytes(database: sqlite3.Connection) -> int:
    pages, free, size = (
        database.execute(f"PRAGMA {name}").fetchone()[0]
        for name in ("page_count", "freelist_count", "page_size")
    )
    return int((pages - free) * size)


def _type_of(value: Any) -> str:
    if isinstance(value, bool):
        return "bool"
    if isinstance(value, int):
        return "int64" if -(1 << 63) <= value < 1 << 63 else "uint64"
    return "real64" if isinstance(value, float) or value is None else "string"


def _affinity(kind: str) -> str:
    return _TYPES.get(kind, "INTEGER")


def _sqlite_value(value: Any) -> Any:
    if isinstance(value, int) and not -(1 << 63) <= value < 1 << 63:
        return str(value)  # too large for an integer of SQLite
    if value is None or isinstance(value, (int, float, str)):
        return value
    return json.dumps(value, separators=(",", ":"))


def _time_text(at: float) -> str:
    from datetime import UTC, datetime

    return datetime.fromtimestamp(at, UTC).isoformat(timespec="microseconds")


@contextlib.contextmanager
def _transaction(database: sqlite3.Connection) -> Any:
    database.execute("BEGIN IMMEDIATE")
    try:
        yield
        database.execute("COMMIT")
    except BaseException:
        with contextlib.suppress(sqlite3.Error):
            database.execute("ROLLBACK")
        raise
