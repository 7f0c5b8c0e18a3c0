"""Write entries to a spool on disk, and deliver them from there to an outlet's server."""

from __future__ import annotations

import asyncio
import collections
import contextlib
import itertools
import logging
import sqlite3
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from smartcam._user_code import ENDS_PROGRAM, text_of
from smartcam.backoff import Backoff
from smartcam.exceptions import EntryRefusedError
from smartcam.outlets._entry import OutletCounts, OutletEntry
from smartcam.outlets._spool import is_damage

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.outlets._outlet import Outlet
    from smartcam.outlets._spool import Spool, SpoolHead

T = TypeVar("T")

logger: logging.Logger = logging.getLogger("smartcam.outlets")

MAX_WAITING = 20_000
"""Largest number of entries that wait in memory to be written to the spool."""

MAX_WAITING_BYTES = 1 << 26
"""Largest number of bytes of the entries that wait in memory."""

MAX_WRITE_BATCH = 500
"""Largest number of entries that are written to the spool in one transaction."""

GATHER_TIME = 0.002
"""Seconds for which entries are collected in memory before they are written together. A write is
thus not part of a trigger's latency, and many results need a single write."""

DISK_RETRY_SECONDS = 1.0
"""Seconds until the next try to write to a disk that was full or unavailable."""

STOP_TIMEOUT = 10.0
"""Largest number of seconds that :meth:`Pump.stop` spends on writing the waiting entries."""

FINAL_DELIVERY_TIMEOUT = 1.0
"""Largest number of seconds that :meth:`Pump.stop` spends on delivering spooled entries."""

CLOSE_TIMEOUT = 5.0
"""Largest number of seconds for an outlet's ``close``."""


class Arrival(NamedTuple):
    """A result or an error that was received, and is not an entry yet.

    Attributes:
        camera: name of the camera.
        number: number of the entry.
        at: time of arrival, seconds since 1970, UTC.
        size: size in memory, bytes.
        make_content: function that returns kind, application and body of the entry; called in the
            spool's thread.
    """

    camera: str
    number: int
    at: float
    size: int
    make_content: Callable[[], tuple[Any, int | None, str]]


class Pump:
    """Writes one outlet's entries to its spool, and delivers them from there.

    Args:
        outlet: the outlet.
        spool: spool of the outlet.
        report: callback for the outlet's name and the reason why the server or the disk fails; ""
            when it works again.

    Attributes:
        trouble: reason why entries are not delivered now; "" if they are.
        disk_trouble: reason why entries are not written to the spool now; "" if they are.
    """

    def __init__(
        self,
        outlet: Outlet[Any],
        spool: Spool,
        report: Callable[[str, str], None] = lambda _name, _why: None,
    ) -> None:
        self.outlet, self.spool, self._report = outlet, spool, report
        self.trouble = self.disk_trouble = ""
        self._waiting: collections.deque[Arrival] = collections.deque()
        self._waiting_bytes = 0
        # the last dropped entry of each camera, and their number, until a gap entry reports them
        self._dropped: dict[str, tuple[Arrival, int]] = {}
        self._last_numbers: dict[str, int] = {}
        self._arrived, self._spooled = asyncio.Event(), asyncio.Event()
        self._counts = OutletCounts()
        self._tasks: list[asyncio.Task[None]] = []
        self._thread = ThreadPoolExecutor(1, f"smartcam.outlets.{outlet.name}")
        self._open = False
        self._batch_size = outlet.max_batch  # largest number of entries in the next batch
        self._gather_timer: asyncio.TimerHandle | None = (
            None  # started by the first entry after a write
        )

    async def start(self) -> None:
        """Open the spool, and start writing and delivering.

        Raises:
            ConfigurationError: another process has the spool.
            sqlite3.Error: its file cannot be created.
        """
        try:
            await self._run_in_thread(lambda: None)  # opens the spool
        except BaseException:
            await self._stop_thread()
            raise
        self._counts = self.spool.counts
        self._open = True
        loop = asyncio.get_running_loop()
        for work in (self._write(), self._deliver()):
            self._tasks.append(loop.create_task(work, name=f"smartcam.outlets.{self.outlet.name}"))

    async def stop(self) -> None:
        """Write the waiting entries to the spool, and stop; the next start delivers them.

        Cancellation: the spool's thread still finishes its work.
        """
        if self._gather_timer is not None:
            self._gather_timer.cancel()
            self._gather_timer = None
        try:
            await self._cancel_tasks(self._tasks[:1])
            if self._open:
                with contextlib.suppress(Exception):  # then the next start adds a gap entry
                    async with asyncio.timeout(STOP_TIMEOUT):
                        while self._waiting or self._dropped:
                            await self._store_waiting()
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(FINAL_DELIVERY_TIMEOUT):
                        while (  # noqa: ASYNC110 - for a second at most
                            self._counts.spooled and not (self.trouble or self.disk_trouble)
                        ):
                            await asyncio.sleep(0.01)
        finally:
            self._open = False
            await self._cancel_tasks(self._tasks)
            self._tasks = []
            await self._stop_thread()

    async def _cancel_tasks(self, tasks: list[asyncio.Task[None]]) -> None:
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks)

    async def _stop_thread(self) -> None:
        all_written = not (self._waiting or self._dropped)
        with contextlib.suppress(RuntimeError, TimeoutError):
            closing = asyncio.wrap_future(
                self._thread.submit(lambda: self.spool.close(all_written=all_written))
            )
            async with asyncio.timeout(STOP_TIMEOUT):
                await asyncio.shield(closing)
        self._thread.shutdown(wait=False)

    def offer(
        self,
        camera: str,
        at: float,
        size: int,
        make_content: Callable[[], tuple[Any, int | None, str]],
    ) -> None:
        """Accept a result or an error; never wait."""
        number = self._last_numbers[camera] = self._last_numbers.get(camera, 0) + 1
        arrival = Arrival(camera, number, at, size, make_content)
        if (
            len(self._waiting) >= MAX_WAITING
            or self._waiting_bytes + size > MAX_WAITING_BYTES
            or self._dropped  # the gap for dropped entries must be written before later entries
        ):
            self._dropped[camera] = arrival, self._dropped.get(camera, (arrival, 0))[1] + 1
        else:
            self._waiting.append(arrival)
            self._waiting_bytes += size
        if self._gather_timer is None:
            loop = asyncio.get_running_loop()
            self._gather_timer = loop.call_later(GATHER_TIME, self._on_gathered)

    def _on_gathered(self) -> None:
        self._gather_timer = None
        self._arrived.set()

    @property
    def counts(self) -> OutletCounts:
        """The counts of all entries, also of those in memory."""
        counts, waiting = self._counts, len(self._waiting)
        memory_count = sum(count for _, count in self._dropped.values())
        dropped = dict(counts.dropped)
        if memory_count:
            dropped["memory"] = dropped.get("memory", 0) + memory_count
        return OutletCounts(
            counts.results + waiting + memory_count,
            counts.delivered,
            counts.spooled + waiting,
            dropped,
        )

    # ------------------------------------------------------------------ into the spool

    async def _write(self) -> None:
        while True:
            await self._arrived.wait()
            self._arrived.clear()
            while self._waiting or self._dropped:
                try:
                    await self._store_waiting()
                except Exception as exc:  # noqa: BLE001 - after any error entries are kept
                    self._report_disk(f"the spool {self.spool.path}: {text_of(exc)}")
                    self._counts = self.spool.counts
                    await asyncio.sleep(DISK_RETRY_SECONDS)
                else:
                    self._report_disk("")

    async def _store_waiting(self) -> None:
        """Write the first waiting entries; if none wait, gaps for the dropped entries."""
        batch = [*itertools.islice(self._waiting, MAX_WRITE_BATCH)]
        dropped = {} if batch else dict(self._dropped)
        await self._store_arrivals(batch, dropped)

    async def _store_arrivals(
        self, batch: list[Arrival], dropped: dict[str, tuple[Arrival, int]]
    ) -> None:
        epoch = self.spool.epoch

        def work() -> OutletCounts:
            entries = list[OutletEntry]()
            for arrival in batch:
                kind, application, body = arrival.make_content()
                entry = OutletEntry(
                    arrival.camera, epoch, arrival.number, kind, application, arrival.at, body
                )
                entries.append(entry)
            gaps = [
                (
                    OutletEntry(arrival.camera, epoch, arrival.number, "gap", None, arrival.at, ""),
                    count,
                    _MEMORY_REASON,
                )
                for arrival, count in dropped.values()
            ]
            self.spool.add(entries, gaps)
            return self.spool.counts

        await self._run_in_thread(work, lambda counts: self._remove_stored(batch, dropped, counts))
        self._spooled.set()

    def _remove_stored(
        self, batch: list[Arrival], dropped: dict[str, tuple[Arrival, int]], counts: OutletCounts
    ) -> None:
        for arrival in batch:
            self._waiting.popleft()
            self._waiting_bytes -= arrival.size
        for camera, (_, count) in dropped.items():
            last, new_count = self._dropped.pop(camera)
            if new_count > count:
                self._dropped[camera] = last, new_count - count
        self._counts = counts

    async def _run_in_thread(
        self, work: Callable[[], T], on_done: Callable[[T], None] = lambda _: None
    ) -> T:
        """Run work in the spool's thread, then ``on_done``, even if the caller is cancelled."""

        def run_with_spool() -> T:
            if self.spool.closed:
                self.spool.open()
            try:
                return work()
            except sqlite3.Error as exc:
                if is_damage(exc):
                    self.spool.replace_damaged(text_of(exc))
                raise

        running = asyncio.wrap_future(self._thread.submit(run_with_spool))
        try:
            outcome = await asyncio.shield(running)
        except asyncio.CancelledError:
            await asyncio.wait({running}, timeout=STOP_TIMEOUT)  # bounded: a disk may hang forever
            if running.done() and running.exception() is None:
                on_done(running.result())
            raise
        on_done(outcome)
        return outcome

    def _report_disk(self, reason: str) -> None:
        if reason != self.disk_trouble:
            self.disk_trouble = reason
            log = logger.error if reason else logger.info
            log("outlet %s: %s", self.outlet.name, reason or "the spool can be written to again")
            self._report(self.outlet.name, reason)

    # ------------------------------------------------------------------ to the server

    async def _deliver(self) -> None:
        delays = Backoff().delays()
        while True:
            try:
                try:
                    async with asyncio.timeout(self.outlet.settings.timeout):
                        await self.outlet.open()
                    while True:
                        if await self._deliver_batch():
                            delays = Backoff().delays()
                finally:
                    await self._close_outlet()
            except asyncio.CancelledError:
                if _is_task_cancelled():
                    raise
                self._report_delivery("the outlet cancelled its own work")
            except ENDS_PROGRAM:
                raise
            except BaseException as exc:  # noqa: BLE001 - a plug-in may raise anything
                self._report_delivery(text_of(exc))
            await asyncio.sleep(next(delays))

    async def _close_outlet(self) -> None:
        try:
            async with asyncio.timeout(CLOSE_TIMEOUT):
                await self.outlet.close()
        except asyncio.CancelledError:
            raise
        except ENDS_PROGRAM:
            raise
        except BaseException as exc:  # noqa: BLE001 - a plug-in may raise anything
            logger.debug("outlet %s: closing: %s", self.outlet.name, text_of(exc))

    async def _deliver_batch(self) -> bool:
        """Deliver a batch, or wait for entries; return True if a batch was delivered.

        After a failed batch, the next batch has one entry. So if the server fails at one entry,
        earlier entries are not delivered again and again.
        """
        self._spooled.clear()
        batch_size, self._batch_size = self._batch_size, 1
        head = await self._run_in_thread(lambda: self.spool.head(batch_size))
        if not head.row_ids:
            self._batch_size = batch_size
            if self.trouble:
                self._report_delivery("")
            await self._wait_for_entries()
            return False
        try:
            async with asyncio.timeout(self.outlet.settings.timeout):
                await self.outlet.deliver(head.entries)
        except EntryRefusedError as exc:
            index = min(max(exc.index, 0), len(head.row_ids) - 1)
            logger.error(  # noqa: TRY400 - the text says it
                "outlet %s: %s is refused for good: %s",
                self.outlet.name,
                head.entries[index].id,
                exc,
            )
            await self._remove_delivered(head, index, str(exc) or "refused")
        else:
            await self._remove_delivered(head, None, "")
        self._batch_size = min(2 * batch_size, self.outlet.max_batch)
        self._report_delivery("")
        return True

    async def _remove_delivered(self, head: SpoolHead, refused: int | None, reason: str) -> None:
        """Remove delivered entries and the one at ``refused``; retry while the disk is full."""

        def work() -> OutletCounts:
            self.spool.remove_delivered(head, refused, reason)
            return self.spool.counts

        while True:
            try:
                await self._run_in_thread(work, self._set_counts)
            except sqlite3.Error as exc:
                self._report_disk(f"the spool {self.spool.path}: {text_of(exc)}")
                await asyncio.sleep(DISK_RETRY_SECONDS)
            else:
                return

    def _set_counts(self, counts: OutletCounts) -> None:
        self._counts = counts

    async def _wait_for_entries(self) -> None:
        """Wait until an entry is written to the spool.

        Raises:
            Exception: the server is lost.
        """
        loop = asyncio.get_running_loop()
        spooled_task = loop.create_task(self._spooled.wait())
        lost_task = loop.create_task(self.outlet.watch())
        try:
            await asyncio.wait({spooled_task, lost_task}, return_when=asyncio.FIRST_COMPLETED)
            if lost_task.done():
                lost_task.result()
        finally:
            for task in (spooled_task, lost_task):
                task.cancel()
            await asyncio.wait({spooled_task, lost_task})

    def _report_delivery(self, reason: str) -> None:
        if reason != self.trouble:
            self.trouble = reason
            log = logger.warning if reason else logger.info
            log("outlet %s: %s", self.outlet.name, reason or "delivers again")
            self._report(self.outlet.name, reason)


_MEMORY_REASON = "the spool's disk was full, away or too slow"


def _is_task_cancelled() -> bool:
    """Return True if this task has been cancelled."""
    task = asyncio.current_task()
    return task is None or task.cancelling() > 0
