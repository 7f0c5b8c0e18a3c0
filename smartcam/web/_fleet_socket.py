"""Serve the WebSocket of a fleet's page: send the changes of the rows that the page shows."""

from __future__ import annotations

import asyncio
import json
import time
from typing import TYPE_CHECKING, Any, ClassVar, Final

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from smartcam.web._fleet_view import PERIOD, Filter, RowQuery, Sort
from smartcam.web._sockets import PageSocket
from smartcam.web._streams import READER_TIMEOUT

if TYPE_CHECKING:
    from collections.abc import Iterator

    from aiohttp import web

    from smartcam.web._fleet_view import FleetView

PROTOCOL: Final = "smartcam.fleet"
"""Subprotocol of the WebSockets that send the fleet's table."""

MAX_ROWS: Final = 120
"""Largest number of rows that a page may show at a time: three times those of a tall screen."""

MAX_SEARCH_CHARACTERS: Final = 100
"""Largest number of characters of a search text."""

MAX_MESSAGE_BYTES: Final = 1024
"""Largest number of bytes of a message from a page."""

ALIVE_INTERVAL: Final = 5.0
"""Seconds after which a page gets a message even without changes, so that it knows that the link is
alive."""

QUICK_INTERVAL: Final = 0.05
"""Least number of seconds between two messages to a page that scrolls or searches."""

ROWS_PER_TURN: Final = 10
"""Largest number of rows that are converted to JSON in one turn of the event loop."""

TOTALS_INTERVAL: Final = 1.0
"""Seconds between two messages with the totals of all cameras."""


class RowsInSight(BaseModel):
    """The rows that a page has in sight."""

    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid")

    first: int = Field(default=0, ge=0, le=1_000_000)
    count: int = Field(default=40, ge=0, le=MAX_ROWS)
    search: str = Field(default="", max_length=MAX_SEARCH_CHARACTERS)
    filter: Filter = "all"
    sort: Sort = "name"
    descending: bool = False

    @property
    def query(self) -> RowQuery:
        """Query of the rows in sight, with their order."""
        return RowQuery(self.search, self.filter, self.sort, self.descending)


class FleetSocket(PageSocket):
    """The WebSocket of a page that shows the table.

    Args:
        view: view of the fleet.
        about: facts about the fleet, which the first message carries.
        request: request that asks for the WebSocket.
    """

    def __init__(self, view: FleetView, about: dict[str, Any], request: web.Request) -> None:
        super().__init__(
            request, PROTOCOL, "row", heartbeat=READER_TIMEOUT, max_message_bytes=MAX_MESSAGE_BYTES
        )
        self._view = view
        self._about = about
        self._rows_in_sight = RowsInSight()
        self._sight_changed = asyncio.Event()  # set when other rows are in sight
        self._sent_version = -1  # version of the view at the last check for changes
        self._versions_sent: dict[str, int] = {}  # versions of the rows that the page has
        self._window: tuple[
            Any, ...
        ] = ()  # last sent to the page: number of found rows, first shown row, names of the rows
        self._totals: dict[str, Any] = {}
        self._totals_at = -TOTALS_INTERVAL
        self._last_bar_start = 0  # of the bars of outcomes that the page has

    def _handle_message(self, message: str) -> bool:
        try:
            self._rows_in_sight = RowsInSight.model_validate_json(message)
        except ValidationError:
            return False
        self._sight_changed.set()
        return True

    async def _send_messages(self) -> None:
        """Send changes until the view ends; TimeoutError: the page does not show them in time."""
        loop = asyncio.get_running_loop()
        await self._send(json.dumps({**self._about, "now": time.time()}))
        sent_at = loop.time()
        while not self._view.ended:
            text = await self._next_message()
            if text or loop.time() - sent_at >= ALIVE_INTERVAL:
                await self._send(text or "{}")
                sent_at = loop.time()
                await asyncio.sleep(QUICK_INTERVAL)
            try:
                async with asyncio.timeout(PERIOD):
                    await self._sight_changed.wait()
            except TimeoutError:
                pass

    async def _send(self, text: str) -> None:
        self._was_shown.clear()
        async with asyncio.timeout(READER_TIMEOUT):
            await self._socket.send_str(text)
            await self._was_shown.wait()

    # ------------------------------------------------------------------ changes

    async def _next_message(self) -> str:
        """Return a message with the changes since the last one; "" if there are none."""
        sight_changed = self._sight_changed.is_set()
        self._sight_changed.clear()
        parts = [*self._changed_totals()]
        if (
            sight_changed
            or self._sent_version != self._view.version
            or self._view.is_order_outdated(self._rows_in_sight.query)
        ):
            self._sent_version = self._view.version
            parts += [*await self._changed_rows(), *self._new_bars()]
        return f'{{{",".join(parts)},"now":{time.time():.2f}}}' if parts else ""

    def _changed_totals(self) -> Iterator[str]:
        now = asyncio.get_running_loop().time()
        if now - self._totals_at < TOTALS_INTERVAL:
            return
        totals = self._view.totals()
        if totals != self._totals:
            self._totals, self._totals_at = totals, now
            yield f'"totals":{json.dumps(totals)}'

    async def _changed_rows(self) -> list[str]:
        view, sight, parts = self._view, self._rows_in_sight, list[str]()
        order = await view.get_order(sight.query)
        count = len(order.names)
        first = max(0, min(sight.first, count - sight.count))
        names = [name for name in order.names[first : first + sight.count] if name in view.rows]
        window = (count, first, names)
        if window != self._window:
            self._window = window
            parts.append(f'"found":{count},"first":{first},"names":{json.dumps(names)}')
        old_versions, self._versions_sent = self._versions_sent, {}
        changed: list[str] = []
        for name in names:
            row = view.rows.get(name)
            if row is None:
                continue  # the row was forgotten
            self._versions_sent[name] = row.version
            if old_versions.get(name) != row.version:
                changed.append(row.as_json())
                if len(changed) % ROWS_PER_TURN == 0:
                    await asyncio.sleep(0)
        if changed:
            parts.append(f'"rows":[{",".join(changed)}]')
        return parts

    def _new_bars(self) -> Iterator[str]:
        bars = [bar for bar in self._view.series if bar[0] > self._last_bar_start]
        if bars:
            self._last_bar_start = bars[-1][0]
            yield f'"bars":{json.dumps(bars)}'
