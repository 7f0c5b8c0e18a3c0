"""Query a store of results: failures since a time, and missing results."""

from __future__ import annotations

import contextlib
import sqlite3
import time
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam._file_values import matches_any
from smartcam._meanings import good_value_of
from smartcam.exceptions import ConfigurationError
from smartcam.outlets._database import open_for_reading

if TYPE_CHECKING:
    from pathlib import Path

READ_TIMEOUT = 20.0
"""Largest number of seconds for one query."""

STEPS_BETWEEN_CHECKS = 10_000
"""Number of steps of SQLite's virtual machine between two checks of the time."""

COLUMNS = (
    *("id", "camera", "kind", "at", "application", "sequence", "latency"),
    *("error", "lost", "at_least", "value", "picture"),
)
"""Columns of a returned row."""


class StoreQuery(NamedTuple):
    """A query to a store of results.

    Attributes:
        since: earliest time; None for all rows.
        failed: whether only errors, gaps and results that did not pass are returned.
        camera: name or pattern of the cameras; ``**`` for all.
        most: largest number of rows; the newest rows are returned.
    """

    since: datetime | None = None
    failed: bool = False
    camera: str = "**"
    max_rows: int = 1000


class StoredResults(NamedTuple):
    """The answer of a store of results.

    Attributes:
        rows: rows, the oldest first: ``id``, ``camera``, ``kind``, ``at``,
            ``application``, ``sequence``, ``latency``, ``error``, ``lost``, ``at_least``,
            ``value``, ``picture``.
        total: number of results, errors and gaps that match the query's time and cameras,
            including those that are not in ``rows``.
        failed: number of errors, gaps, and results that did not pass.
        errors: number of errors.
        gaps: number of gaps.
        lost: number of results that the gaps replace.
        at_least: whether more results may be lost than ``lost``.
    """

    rows: list[dict[str, Any]]
    total: int
    failed: int
    errors: int
    gaps: int
    lost: int
    at_least: bool

    @property
    def summary(self) -> dict[str, Any]:
        """Return all fields except ``rows``."""
        fields = self._asdict()
        del fields["rows"]
        return fields


def read_store(path: Path, query: StoreQuery) -> StoredResults:
    """Return the results in a store, which an outlet may be writing; blocks.

    Raises:
        ConfigurationError: there is no such file, it is no store, or it does not answer in time.
    """
    if not path.is_file():
        raise ConfigurationError(f"results {path}: there is no such file")
    deadline = time.monotonic() + READ_TIMEOUT
    try:
        with contextlib.closing(open_for_reading(path, timeout=5.0)) as database:
            database.set_progress_handler(lambda: time.monotonic() > deadline, STEPS_BETWEEN_CHECKS)
            return _query(database, query)
    except sqlite3.Error as exc:
        raise ConfigurationError(f"results {path}: expected a store of results: {exc}") from exc


def _query(database: sqlite3.Connection, query: StoreQuery) -> StoredResults:
    database.create_function(
        "chosen", 1, lambda name: name == "" or matches_any((query.camera,), name)
    )
    failed_condition = _failure_condition(database)
    conditions, values = ["1"], list[Any]()
    if query.since is not None:
        conditions.append("at >= ?")
        values.append(query.since.astimezone(UTC).isoformat(timespec="microseconds"))
    if query.camera != "**":
        conditions.append("chosen(camera)")  # a gap of all cameras belongs to each one
    condition = " AND ".join(conditions)
    row_condition = f"{condition} AND {failed_condition}" if query.failed else condition
    columns = ", ".join(COLUMNS)
    rows = database.execute(
        f"SELECT * FROM (SELECT rowid, {columns} FROM results WHERE {row_condition} "  # noqa: S608
        "ORDER BY at DESC, rowid DESC LIMIT ?) ORDER BY at, rowid",
        (*values, query.max_rows),
    ).fetchall()
    total, failed, errors, gaps, lost, at_least = database.execute(
        f"SELECT COUNT(*), COUNT(*) FILTER (WHERE {failed_condition}), "  # noqa: S608
        "COUNT(*) FILTER (WHERE kind = 'error'), COUNT(*) FILTER (WHERE kind = 'gap'), "
        f"COALESCE(SUM(lost), 0), COALESCE(MAX(at_least), 0) FROM results WHERE {condition}",
        values,
    ).fetchone()
    records = [dict(zip(COLUMNS, row[1:], strict=True)) for row in rows]
    return StoredResults(records, total, failed, errors, gaps, lost, bool(at_least))


def _failure_condition(database: sqlite3.Connection) -> str:
    """Return the condition of rows that are errors, gaps, or results that did not pass."""
    conditions: dict[int, list[str]] = {}
    for application, name, column in database.execute(
        "SELECT application, name, column_name FROM fields WHERE type = 'bool'"
    ):
        good_value = good_value_of(name)
        if good_value is not None:
            quoted = column.replace('"', '""')
            conditions.setdefault(application, []).append(f'"{quoted}" = {int(not good_value)}')
    clauses = [
        f"id IN (SELECT id FROM app_{int(application)} WHERE {' OR '.join(tests)})"  # noqa: S608
        for application, tests in conditions.items()
    ]
    condition = " OR ".join(["kind != 'result'", *clauses])
    return f"({condition})"
