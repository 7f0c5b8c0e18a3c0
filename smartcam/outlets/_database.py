"""Open SQLite databases whose files may be damaged."""

from __future__ import annotations

import sqlite3
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path


class _Database(sqlite3.Connection):
    """A connection whose errors are all of the class ``sqlite3.Error``.

    SQLite's errors name the damaged table. Python's module decodes the name, and raises
    UnicodeDecodeError if the name itself is damaged.
    """

    def execute(self, sql: str, parameters: Any = (), /) -> sqlite3.Cursor:
        try:
            return super().execute(sql, parameters)
        except UnicodeDecodeError as exc:
            raise _damage(exc) from exc

    def executemany(self, sql: str, parameters: Iterable[Any], /) -> sqlite3.Cursor:
        try:
            return super().executemany(sql, parameters)
        except UnicodeDecodeError as exc:
            raise _damage(exc) from exc

    def executescript(self, sql_script: str, /) -> sqlite3.Cursor:
        try:
            return super().executescript(sql_script)
        except UnicodeDecodeError as exc:
            raise _damage(exc) from exc


def _damage(error: UnicodeDecodeError) -> sqlite3.DatabaseError:
    return sqlite3.DatabaseError(f"malformed: {error.object.decode(errors='replace')}")


def open_database(path: Path, *, timeout: float) -> sqlite3.Connection:
    """Return a connection for reading and writing, which any thread may use, one at a time.

    Each statement outside of a transaction takes effect at once.

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
    place = f"{path.absolute().as_uri()}?mode=ro"
    return sqlite3.connect(place, uri=True, timeout=timeout, factory=_Database)
