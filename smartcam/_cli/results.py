"""``smartcam results``: show the results in a store: a file, or the stores of a fleet's agents."""

from __future__ import annotations

import re
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import click

from smartcam._cli.options import OUTPUT_OPTIONS, Options, async_command
from smartcam._extras import from_part
from smartcam.exceptions import ConfigurationError, ResponseTimeoutError

_UNITS = {"s": "seconds", "min": "minutes", "h": "hours", "d": "days"}
_AGE = re.compile(r"(\d{1,6}(?:\.\d{1,3})?) ?(s|min|h|d)", re.ASCII)

DEFAULT_COUNT = 1000
"""Number of results that are shown without ``--count``."""


def _parse_since(_context: Any, _parameter: Any, text: str | None) -> datetime | None:
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
    help="Show the results in a store: those of a shift, those that failed. FILE is that of an "
    "outlet of the kind sqlite; URL is a fleet's, whose agents show their stores. The oldest "
    "result comes first. --failed shows errors, gaps, and results with a false value whose name "
    "is one such as ok or passed. The last line of a store has the counts of the whole period, "
    "also of results that --count leaves out."
)
@click.argument("store", metavar="FILE|URL")
@click.option(
    "--since", metavar="AGE|TIME", callback=_parse_since, help="8h, 30min, 2d, or a time."
)
@click.option("--failed", is_flag=True, help="Errors, gaps, and results that did not pass.")
@click.option("--camera", metavar="PATTERN", help="Only these cameras: line1/cam1, line1/**.")
@async_command("--count", "--timeout", *OUTPUT_OPTIONS)
async def results(
    store: str, since: datetime | None, failed: bool, camera: str | None, options: Options
) -> None:
    """Show results."""
    max_count = DEFAULT_COUNT if options.count is None else options.count
    if "://" in store:
        await _show_fleet_stores(store, since, failed, camera or "**", max_count, options)
        return
    from smartcam.outlets._inside import StoreQuery, read_store

    stored = read_store(Path(store), StoreQuery(since, failed, camera or "**", max_count))
    _show_rows(stored.rows, stored.summary, "", options)


async def _show_fleet_stores(
    url: str, since: datetime | None, failed: bool, camera: str, max_count: int, options: Options
) -> None:
    """Show the contents of the stores of a fleet's agents."""
    with from_part("fleet", "the results of a fleet need"):
        import smartcam.fleet
    async with smartcam.fleet.open(url, connect_timeout=options.step_timeout(10.0)) as fleet:
        stores = await fleet.stored_results(
            camera,
            since=since,
            only_failed=failed,
            max_rows=min(max_count, 1000),
            timeout=options.step_timeout(30.0),
        )
    if not stores:
        raise ResponseTimeoutError(f"results {url}: no agent has a store, or none answered in time")
    for store in stores:
        name = f"{store.agent} {store.outlet}".rstrip()
        if store.error:
            raise ConfigurationError(f"results of the agent {name}: {store.error}")
        summary = {
            key: value for key, value in store._asdict().items() if key not in _NOT_IN_SUMMARY
        }
        _show_rows(store.rows, summary, name, options)


_NOT_IN_SUMMARY = ("rows", "error")


def _show_rows(
    rows: list[dict[str, Any]], summary: dict[str, Any], name: str, options: Options
) -> None:
    for row in rows:
        options.show(row, _row_text(row))
    least = "at least " if summary["at_least"] else ""
    text = (
        f"{f'{name}: ' if name else ''}{summary['total']} rows: {summary['failed']} failed, "
        f"{summary['errors']} of them errors; {least}{summary['lost']} lost in "
        f"{summary['gaps']} gaps"
    )
    options.show(summary, text)


def _row_text(row: dict[str, Any]) -> str:
    at = datetime.fromisoformat(row["at"]).astimezone()
    content = row["error"] or row["value"] or ""
    lost = f" ({row['lost']} lost)" if row["lost"] else ""
    application = "" if row["application"] is None else f" application {row['application']}"
    picture = f"  {row['picture']}" if row["picture"] else ""
    camera = row["camera"] or "all cameras"
    return f"{at:%Y-%m-%d %H:%M:%S} {camera}{application}: {content}{lost}{picture}"
