"""``smartcam results``: what is in a store of results."""

from __future__ import annotations

import contextlib
import re
import sqlite3
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import click

from smartcam._cli.options import OUTPUT, Options, runs
from smartcam.exceptions import ConfigurationError

_UNITS = {"s": "seconds", "min": "minutes", "h": "hours", "d": "days"}
_AGE = re.compile(r"(\d{1,6}(?:\.\d{1,3})?) ?(s|min|h|d)", re.ASCII)

DEFAULT_COUNT = 1000
"""Results that are shown where ``--count`` says nothing."""

_COLUMNS = "id, camera, kind, at, application, sequence, latency, error, lost, value, picture"


def _since(_context: Any, _parameter: Any, text: str | None) -> datetime | None:
    if text is None:
        return None
    age = _AGE.fullmatch(text)
    if age is not None:
        return datetime.now(UTC) - timedelta(**{_UNITS[age[2]]: float(age[1])})
    try:
        return datetime.fromisoformat(text).astimezone(UTC)
    except ValueError:
        raise click.BadParameter(
            "expected an age such as 8h, 30min or 2d, or a time such as 2026-11-29T06:00"
        ) from None


@click.command(
    help="Show the results in a store: those of a shift, those that failed. FILE is what an "
    "outlet of the kind sqlite writes; the oldest result comes first. With --failed those that did "
    "not pass, by the names of their truth values, with errors and gaps. The last line counts all "
    "of the time."
)
@click.argument("file")
@click.option("--since", metavar="AGE|TIME", callback=_since, help="8h, 30min, 2d, or a time.")
@click.option("--failed", is_flag=True, help="Errors, gaps, and results that did not pass.")
@click.option("--camera", metavar="PATTERN", help="Of these cameras: line1/cam1, line1/*.")
@runs("--count", *OUTPUT)
async def results(
    file: str, since: datetime | None, failed: bool, camera: str | None, options: Options
) -> None:
    """Show results."""
    _read(file, since, failed, camera, options)


def _read(
    file: str, since: datetime | None, failed: bool, camera: str | None, options: Options
) -> None:
    path = Path(file)
    if not path.is_file():
        raise ConfigurationError(f"results {file}: there is no such file")
    place = f"{path.absolute().as_uri()}?mode=ro"
    try:
        with contextlib.closing(sqlite3.connect(place, uri=True, timeout=5.0)) as database:
            _show(database, since, failed, camera, options)
    except sqlite3.Error as exc:
        raise ConfigurationError(f"results {file}: expected a store of results: {exc}") from exc


def _show(
    database: sqlite3.Connection,
    since: datetime | None,
    failed: bool,
    camera: str | None,
    options: Options,
) -> None:
    bad = _bad(database)
    which, values = ["1"], list[Any]()
    if since is not None:
        which.append("at >= ?")
        values.append(since.isoformat(timespec="microseconds"))
    if camera is not None:
        which.append("camera GLOB ?")
        values.append(camera)
    of = " AND ".join(which)
    shown = f"{of} AND {bad}" if failed else of
    count = DEFAULT_COUNT if options.count is None else options.count
    rows = database.execute(
        f"SELECT * FROM (SELECT {_COLUMNS} FROM results WHERE {shown} "  # noqa: S608
        "ORDER BY at DESC LIMIT ?) ORDER BY at",
        (*values, count),
    )
    names = _COLUMNS.split(", ")
    for row in rows:
        fields: dict[str, Any] = dict(zip(names, row, strict=True))
        options.show(fields, _text(fields))
    total, errors, gaps, not_good = database.execute(
        "SELECT COUNT(*), COUNT(*) FILTER (WHERE kind = 'error'), "  # noqa: S608
        f"COALESCE(SUM(lost), 0), COUNT(*) FILTER (WHERE {bad}) FROM results WHERE {of}",
        values,
    ).fetchone()
    said = {"rows": total, "failed": not_good, "errors": errors, "lost": gaps}
    text = f"{total} rows: {not_good} failed, {errors} of them errors; {gaps} lost in gaps"
    options.show(said, text)


def _bad(database: sqlite3.Connection) -> str:
    """Return the condition of a result that did not pass."""
    from smartcam.web._inside import meaning

    found = ["kind != 'result'"]
    conditions: dict[int, list[str]] = {}
    for application, name, column in database.execute(
        "SELECT application, name, column_name FROM fields WHERE type = 'bool'"
    ):
        good = meaning(name)
        if good is not None:
            quoted = column.replace('"', '""')
            conditions.setdefault(application, []).append(f'"{quoted}" = {int(not good)}')
    for application, each in conditions.items():
        found.append(
            f"id IN (SELECT id FROM app_{int(application)} WHERE {' OR '.join(each)})"  # noqa: S608
        )
    return f"({' OR '.join(found)})"


def _text(fields: dict[str, Any]) -> str:
    at = datetime.fromisoformat(fields["at"]).astimezone()
    said = fields["error"] or fields["value"] or ""
    lost = f" ({fields['lost']} lost)" if fields["lost"] else ""
    application = "" if fields["application"] is None else f" application {fields['application']}"
    picture = f"  {fields['picture']}" if fields["picture"] else ""
    return f"{at:%Y-%m-%d %H:%M:%S} {fields['camera']}{application}: {said}{lost}{picture}"
