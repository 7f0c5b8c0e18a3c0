"""Open SQLite databases whose files may be damaged."""

from __future__ import annotations

import sqlite3
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path


class _Database(sqlite3.Connection):
    """A connection that raises no UnicodeDecodeError, but ``sqlite3.DatabaseError``.

    An error of SQLite names the damaged table. Python's module decodes this name, which fails with
    UnicodeDecodeError if the name is damaged, too.
    """

    def execute(self, sql: str, parameters: Any = (), /) -> sqlite3.Cursor:
        try:
            return super().execute(sql, parameters)
        except UnicodeDecodeError as exc:
            raise _damage_error(exc) from exc

    def executemany(self, sql: str, parameters: Iterable[Any], /) -> sqlite3.Cursor:
        try:
            return super().executemany(sql, parameters)
        except UnicodeDecodeError as exc:
            raise _damage_error(exc) from exc

    def executescript(self, sql_script: str, /) -> sqlite3.Cursor:
        try:
            return super().executescript(sql_script)
        except UnicodeDecodeError as exc:
            raise _damage_error(exc) from exc


def _damage_error(error: UnicodeDecodeError) -> sqlite3.DatabaseError:
    return sqlite3.DatabaseError(f"malformed: {error.object.decode(errors='replace')}")


def open_database(path: Path, *, timeout: float) -> sqlite3.Connection:
    """Return a connection for reading and writing, which any one thread at a time may use.

    A statement outside of a transaction is a transaction of its own.

    Args:
        path: file of the database; created if it does not exist.
        timeout: seconds that a statement waits for another process.

    Raises:
        sqlite3.Error: the file cannot be opened.
    """
    return sqlite3.connect(
        path, timeout=timeout, isolation_level=None, check_same_thread=False, factory=_Database
    )


def open_for_reading(path: Path, *, timeout: float) -> sqlite3.Connection:
    """Return a connection for reading a database that another process may be writing.

    Args:
        path: file of the database, which has to exist.
        timeout: seconds that a statement waits for another process.

    Raises:
        sqlite3.Error: the file does not exist, or cannot be opened.
    """
    uri = f"{path.absolute().as_uri()}?mode=ro"
    return sqlite3.connect(uri, uri=True, timeout=timeout, factory=_Database)
