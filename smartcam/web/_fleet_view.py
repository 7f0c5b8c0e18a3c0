"""Keep the data of a fleet's page: follow the fleet once for all viewers.

One task updates the changed rows five times per second; without changes there is no work. The task
does not wait for viewers. Each viewer asks for rows in an order, and compares the rows' version
numbers with those that it has, to find changes.
"""

from __future__ import annotations

import asyncio
import collections
import logging
import time
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, TypeAlias

from smartcam.fleet import AgentJoined, AgentLeft, CameraJoined, CameraLeft
from smartcam.web._fleet_rows import MODES, OUTCOMES, RATE_SECONDS, FleetRow

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.fleet import Fleet, FleetEvent
    from smartcam.layout._inside import ShownUnits
    from smartcam.streams import Subscription

_log = logging.getLogger("smartcam.web")

PERIOD: Final = 0.2
"""Seconds between two updates of the rows, and between two updates of a page."""

MAX_EVENTS: Final = 50_000
"""Largest number of events of the fleet between two updates; if there are more, the whole fleet is
read again."""

MAX_UNSHARED: Final = 10_000
"""Largest number of shown cameras that no agent shares any more. If there are more, the cameras
that disappeared first are forgotten."""

ITEMS_PER_TURN: Final = 50
"""Largest number of rows or results that are handled in one turn of the event loop."""

MAX_SEARCHED_ROWS: Final = 1000
"""Largest number of rows that are searched in one turn of the event loop."""

BAR_DURATION: Final = 5
"""Seconds of results in one bar of the chart of outcomes."""

SERIES_DURATION: Final = 600
"""Seconds over which outcomes are kept."""

ORDER_DURATION: Final = 1.0
"""Seconds for which the rows keep their order although their values change, since people cannot
read rows that jump."""

MAX_SORTED_LISTS: Final = 64
"""Largest number of sorted lists of rows that are kept for viewers."""

Filter: TypeAlias = Literal["all", "connected", "errors", "busy", "stopped"]
Sort: TypeAlias = Literal["name", "state", "rate", "last", "errors"]

SORTS: Final[dict[str, Callable[[FleetRow], Any]]] = {
    "state": lambda row: MODES.index(row.mode),
    "rate": lambda row: row.rate,
    "last": lambda row: row.last_at,
    "errors": lambda row: row.errors,
}
"""Functions that return the key by which rows are sorted, except for the name."""


class RowQuery(NamedTuple):
    """A page's query: which rows, and in which order."""

    search: str = ""  # words that a row must all contain
    filter: Filter = "all"
    sort: Sort = "name"
    descending: bool = False


class RowOrder(NamedTuple):
    """The names of a query's rows, in their order."""

    names: list[str]
    version: int  # the view's version number when the order was made
    made_at: float  # time of the loop's clock


class FleetView:
    """Follows the cameras of a fleet, for the pages that show them.

    Args:
        fleet: an open fleet, which the caller closes.
        units: units that the pages can show instead of SI.

    Attributes:
        rows: cameras by name.
        version: version of all rows, which grows with each change.
        series: counts of the outcomes: start of a bar, seconds since 1970, and the number of
            results that passed, failed, had no verdict, or were errors. Empty bars are left out.
        failing: rows whose newest result is a failure without a picture.
        ended: True if the view does not follow the fleet.
    """

    def __init__(self, fleet: Fleet, units: ShownUnits) -> None:
        self.fleet: Fleet = fleet
        self._units = units
        self.rows: dict[str, FleetRow] = {}
        self.version: int = 0
        self.series: collections.deque[tuple[int, ...]] = collections.deque(
            maxlen=SERIES_DURATION // BAR_DURATION
        )
        self.failing: dict[FleetRow, None] = {}
        self.ended: bool = True
        self.agents: set[str] = set()
        self._names: list[str] = []  # sorted; empty if it must be made again
        self._changed_rows: dict[FleetRow, None] = {}
        self._timed_rows: set[FleetRow] = (
            set()
        )  # rows that change with time: their rate, or their mark of an error
        self._unshared: dict[str, None] = {}  # cameras that no agent shares, oldest first
        self._flags: collections.Counter[str] = collections.Counter()
        self._bar: collections.Counter[str] = collections.Counter()
        self._bar_at = 0
        self._totals: collections.deque[int] = collections.deque([0], RATE_SECONDS + 1)
        self._count = self._errors = 0
        self._orders: collections.OrderedDict[RowQuery, RowOrder] = collections.OrderedDict()
        self._events: Subscription[FleetEvent] | None = None
        self._task: asyncio.Task[None] | None = None

    # ------------------------------------------------------------------ start and stop

    async def start(self) -> None:
        """Start to follow the fleet; return when all cameras that agents share now are known."""
        if self._task is None:
            self.ended = False
            await self._read_fleet()
            self._task = asyncio.create_task(self._run(), name="smartcam.web.fleet")
            self._task.add_done_callback(self._on_task_done)

    def _on_task_done(self, task: asyncio.Task[None]) -> None:
        if task is self._task:
            self.ended = True

    async def stop(self) -> None:
        """Stop following the fleet. Idempotent."""
        task, self._task = self._task, None
        self.ended = True
        if task is not None:
            task.cancel()
            await asyncio.wait([task])
        if self._events is not None:
            self._events.close()
        for row in self.rows.values():
            row.stop_following()

    async def _run(self) -> None:
        try:
            ticks = 0
            while True:
                await asyncio.sleep(PERIOD)
                ticks += 1
                await self._receive_events()
                await self._update_changed_rows()
                if ticks * PERIOD >= 1.0:
                    ticks = 0
                    await self._update_timed_rows()
        except Exception:
            _log.exception("! the fleet's page stopped following the fleet: a fault of smartcam")
            raise

    # ------------------------------------------------------------------ agents and cameras

    async def _read_fleet(self) -> None:
        """Find out which agents and cameras exist."""
        if self._events is not None:
            self._events.close()
        self._events = stream = self.fleet.events(max_queue=MAX_EVENTS)
        previous = {row.name: set(row.agents) for row in self.rows.values()}
        self.agents.clear()
        for row in self.rows.values():
            row.agents.clear()
        await self._read_events(stream, stream.statistics().queued)
        for name, agents in previous.items():
            if agents != self.rows[name].agents:
                self.rows[name].note_change()
        await self._update_changed_rows()

    async def _receive_events(self) -> None:
        """Read new events about agents and cameras; read the whole fleet if some were dropped."""
        stream = self._events
        if stream is None:
            return
        counts = stream.statistics()
        if counts.dropped:
            await self._read_fleet()
        else:
            await self._read_events(stream, counts.queued)

    async def _read_events(self, stream: Subscription[FleetEvent], count: int) -> None:
        for number in range(count):
            self._on_event(await anext(stream))
            if number % ITEMS_PER_TURN == ITEMS_PER_TURN - 1:
                await asyncio.sleep(0)

    def _on_event(self, event: FleetEvent) -> None:
        match event:
            case AgentJoined():
                self.agents.add(event.agent)
                self.version += 1
            case AgentLeft():
                self.agents.discard(event.agent)
                self.version += 1
            case CameraJoined():
                self._add_agent(event.camera, event.agent)
            case CameraLeft():
                row = self.rows.get(event.camera)
                if row is not None:
                    row.agents.discard(event.agent)
                    row.note_change()
            case _:
                pass

    def _add_agent(self, name: str, agent: str) -> None:
        row = self.rows.get(name)
        if row is None:
            row = self.rows[name] = FleetRow(name, self._note_change, self._units)
            self._names = []
        self.agents.add(agent)
        row.agents.add(agent)
        row.follow(self.fleet[name])
        row.note_change()

    def _note_change(self, row: FleetRow) -> None:
        self._changed_rows[row] = None

    # ------------------------------------------------------------------ changes of rows

    async def _update_changed_rows(self) -> None:
        """Update the rows that may have changed."""
        loop, done_count = asyncio.get_running_loop(), 0
        rows, self._changed_rows = self._changed_rows, {}
        for row in rows:
            if self.rows.get(row.name) is not row:
                continue  # the row was forgotten
            old_count, now = row.count, loop.time()
            outcomes = await row.count_results(now)
            if row.may_have_changed:
                row.count_lost_results(outcomes, now)
            arrived = self._count_outcomes(row, outcomes, row.count - old_count)
            if row.may_have_changed or outcomes["errors"]:
                self._refresh_row(row, now)
            if row.history.wants_picture:
                self.failing[row] = None
            done_count += 1 + arrived
            if done_count >= ITEMS_PER_TURN:
                done_count = 0
                await asyncio.sleep(0)

    def _count_outcomes(
        self, row: FleetRow, outcomes: collections.Counter[str], arrived: int
    ) -> int:
        """Count the outcomes of ``arrived`` new results of a camera; return ``arrived``."""
        if arrived:
            self._bar.update(outcomes)
            self._count += arrived
            self._errors += outcomes["errors"]
            self._timed_rows.add(row)
            self._mark_changed(row)
        return arrived

    def _mark_changed(self, row: FleetRow) -> None:
        self.version += 1
        row.version = self.version

    def _refresh_row(self, row: FleetRow, now: float) -> None:
        """Update a camera's state."""
        flags = row.flags
        changed, connection_lost = row.refresh(now)
        if connection_lost:
            self._errors += 1
        if changed:
            self._mark_changed(row)
        if flags is not row.flags:
            self._flags.subtract(flags)
            self._flags.update(row.flags)
        if row.error_at is not None or not row.agents or "connected" not in row.flags:
            self._timed_rows.add(row)  # the reason of a loss may change without an event
        if row.agents:
            self._unshared.pop(row.name, None)
        elif row.name not in self._unshared:
            self._unshared[row.name] = None
            if len(self._unshared) > MAX_UNSHARED:
                self._forget_row(next(iter(self._unshared)))

    def _forget_row(self, name: str) -> None:
        row = self.rows.pop(name)
        row.stop_following()
        self.failing.pop(row, None)
        self._flags.subtract(row.flags)
        self._timed_rows.discard(row)
        self._unshared.pop(name, None)
        self._names = []
        self.version += 1

    async def _update_timed_rows(self) -> None:
        """Update rates and other values that change with time, once a second."""
        now, wall = asyncio.get_running_loop().time(), time.time()
        rows, self._timed_rows = self._timed_rows, set()
        for number, row in enumerate(rows):
            if self.rows.get(row.name) is not row:
                continue  # the row was forgotten
            old_count, rate = row.count, row.rate
            outcomes: collections.Counter[str] = collections.Counter()
            row.count_lost_results(outcomes, now)
            self._count_outcomes(row, outcomes, row.count - old_count)
            if row.update_rate() or row.error_at is not None:
                self._timed_rows.add(row)
            if row.rate != rate:
                self._mark_changed(row)
            self._refresh_row(row, now)
            if number % ITEMS_PER_TURN == ITEMS_PER_TURN - 1:
                await asyncio.sleep(0)
        self._totals.append(self._count)
        bar = int(wall) // BAR_DURATION * BAR_DURATION
        if bar != self._bar_at:
            if self._bar.total() and self._bar_at:
                self.series.append((self._bar_at, *(self._bar[name] for name in OUTCOMES)))
                self.version += 1
                self._bar.clear()
            self._bar_at = bar

    # ------------------------------------------------------------------ for viewers

    def totals(self) -> dict[str, Any]:
        """Return the totals of all cameras, as values for JSON."""
        rate = (self._totals[-1] - self._totals[0]) / max(1, len(self._totals) - 1)
        counts = {name: self._flags[name] for name in ("connected", "errors", "busy", "stopped")}
        return {
            "cameras": len(self.rows),
            "agents": len(self.agents),
            **counts,
            "rate": round(rate, 1),
            "results": self._count,
            "failures": self._errors,
        }

    async def get_order(self, query: RowQuery) -> RowOrder:
        """Return the names of a query's rows; equal queries share one order.

        Cancellation: safe.
        """
        now = asyncio.get_running_loop().time()
        known = self._orders.get(query)
        if known is not None and (
            known.version == self.version or now - known.made_at < ORDER_DURATION
        ):
            self._orders.move_to_end(query)
            return known
        if not self._names:
            self._names = sorted(self.rows)
        version = self.version
        order = RowOrder(await self._find_rows(query), version, now)
        self._orders[query] = order
        self._orders.move_to_end(query)
        while len(self._orders) > MAX_SORTED_LISTS:
            self._orders.popitem(last=False)
        return order

    def is_order_outdated(self, query: RowQuery) -> bool:
        """Return True if there is no order for a query, or it is older than the last change."""
        known = self._orders.get(query)
        return known is None or known.version != self.version

    async def _find_rows(self, query: RowQuery) -> list[str]:
        words, found = query.search.lower().split(), list[FleetRow]()
        names = self._names
        for start in range(0, len(names), MAX_SEARCHED_ROWS):
            rows = map(self.rows.get, names[start : start + MAX_SEARCHED_ROWS])
            found += [row for row in rows if row is not None and _matches(row, query.filter, words)]
            await asyncio.sleep(0)
        if query.sort in SORTS:
            found.sort(key=SORTS[query.sort], reverse=query.descending)
        elif query.descending:
            found.reverse()
        return [row.name for row in found]


def _matches(row: FleetRow, row_filter: str, words: list[str]) -> bool:
    return row_filter in row.flags and all(word in row.text for word in words)
