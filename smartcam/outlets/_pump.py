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
from smartcam.outlets._entry import OutletAccount, OutletEntry
from smartcam.outlets._spool import is_damage

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.outlets._outlet import Outlet
    from smartcam.outlets._spool import Spool, SpoolHead

T = TypeVar("T")

logger: logging.Logger = logging.getLogger("smartcam.outlets")

MAX_WAITING = 20_000
"""Largest number of entries that wait in memory for the spool's disk."""

MAX_WAITING_BYTES = 1 << 26
"""Largest number of bytes of the entries that wait in memory."""

MAX_WRITTEN_TOGETHER = 500
"""Largest number of entries of one write to the spool."""

GATHER_SECONDS = 0.002
"""Seconds for which entries are collected in memory before they are written together: so a write
does not delay the trigger, and many results need a single write."""

DISK_RETRY_SECONDS = 1.0
"""Seconds until a disk that was full or unavailable is tried again."""

STOP_TIMEOUT = 10.0
"""Seconds for writing the waiting entries at the end."""

LINGER = 1.0
"""Seconds for delivering spooled entries at the end, if the server accepts them."""

CLOSE_TIMEOUT = 5.0
"""Seconds for an outlet's ``close``."""


class Arrival(NamedTuple):
    """A result or an error before an entry is made of it.

    Attributes:
        camera: name of the camera.
        number: number of the entry.
        at: time of arrival, seconds since 1970, UTC.
        size: size in memory, bytes.
        make: function that returns kind, application and body of the entry; called in the spool's
            thread.
    """

    camera: str
    number: int
    at: float
    size: int
    make: Callable[[], tuple[Any, int | None, str]]


class Pump:
    """One outlet with its spool.

    Args:
        outlet: the outlet.
        spool: spool of the outlet.
        report: function that is called with the reason why the server or the disk fails, and with
            "" when it works again.

    Attributes:
        trouble: reason why entries are not delivered now; "" without one.
        disk_trouble: reason why entries are not spooled now; "" without one.
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
        # dropped entries that no gap stands for yet
        self._lost: dict[str, tuple[Arrival, int]] = {}
        self._numbers: dict[str, int] = {}
        self._arrived, self._spooled = asyncio.Event(), asyncio.Event()
        self._account = OutletAccount()
        self._tasks: list[asyncio.Task[None]] = []
        self._thread = ThreadPoolExecutor(1, f"smartcam.outlets.{outlet.name}")
        self._open = False
        self._together = outlet.max_batch  # largest number of entries of the next batch
        self._gathering: asyncio.TimerHandle | None = None  # timer of the next write

    async def start(self) -> None:
        """Open the spool, and start writing and delivering.

        Raises:
            ConfigurationError: another process has the spool.
            sqlite3.Error: its file cannot be created.
        """
        try:
            await self._run(lambda: None)  # opens the spool
        except BaseException:
            await self._end_thread()
            raise
        self._account = self.spool.account
        self._open = True
        loop = asyncio.get_running_loop()
        for work in (self._write(), self._deliver()):
            self._tasks.append(loop.create_task(work, name=f"smartcam.outlets.{self.outlet.name}"))

    async def stop(self) -> None:
        """Write the waiting entries to the spool, and stop; the next start delivers them.

        Cancellation: the spool's thread still finishes its work.
        """
        if self._gathering is not None:
            self._gathering.cancel()
            self._gathering = None
        try:
            await self._end(self._tasks[:1])
            if self._open:
                with contextlib.suppress(Exception):  # the next start adds a gap for the rest
                    async with asyncio.timeout(STOP_TIMEOUT):
                        while self._waiting or self._lost:
                            await self._store_waiting()
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(LINGER):
                        while (  # noqa: ASYNC110 - for a second at most
                            self._account.spooled and not (self.trouble or self.disk_trouble)
                        ):
                            await asyncio.sleep(0.01)
        finally:
            self._open = False
            await self._end(self._tasks)
            self._tasks = []
            await self._end_thread()

    async def _end(self, tasks: list[asyncio.Task[None]]) -> None:
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks)

    async def _end_thread(self) -> None:
        ended = not (self._waiting or self._lost)
        with contextlib.suppress(RuntimeError, TimeoutError):
            closing = asyncio.wrap_future(
                self._thread.submit(lambda: self.spool.close(ended=ended))
            )
            async with asyncio.timeout(STOP_TIMEOUT):
                await asyncio.shield(closing)
        self._thread.shutdown(wait=False)

    def offer(
        self, camera: str, at: float, size: int, make: Callable[[], tuple[Any, int | None, str]]
    ) -> None:
        """Accept a result or an error; never wait."""
        number = self._numbers[camera] = self._numbers.get(camera, 0) + 1
        arrival = Arrival(camera, number, at, size, make)
        if (
            len(self._waiting) >= MAX_WAITING
            or self._waiting_bytes + size > MAX_WAITING_BYTES
            or self._lost  # later entries must not overtake the gap
        ):
            self._lost[camera] = arrival, self._lost.get(camera, (arrival, 0))[1] + 1
        else:
            self._waiting.append(arrival)
            self._waiting_bytes += size
        if self._gathering is None:
            loop = asyncio.get_running_loop()
            self._gathering = loop.call_later(GATHER_SECONDS, self._gathered)

    def _gathered(self) -> None:
        self._gathering = None
        self._arrived.set()

    @property
    def account(self) -> OutletAccount:
        """The account of all entries, including the ones in memory."""
        counts, waiting = self._account, len(self._waiting)
        lost = sum(count for _, count in self._lost.values())
        dropped = dict(counts.dropped)
        if lost:
            dropped["memory"] = dropped.get("memory", 0) + lost
        return OutletAccount(
            counts.results + waiting + lost, counts.delivered, counts.spooled + waiting, dropped
        )

    # ------------------------------------------------------------------ into the spool

    async def _write(self) -> None:
        while True:
            await self._arrived.wait()
            self._arrived.clear()
            while self._waiting or self._lost:
                try:
                    await self._store_waiting()
                except Exception as exc:  # noqa: BLE001 - after any error entries are kept
                    self._report_disk(f"the spool {self.spool.path}: {text_of(exc)}")
                    self._account = self.spool.account
                    await asyncio.sleep(DISK_RETRY_SECONDS)
                else:
                    self._report_disk("")

    async def _store_waiting(self) -> None:
        """Write the first waiting entries; if none wait, the gaps of dropped ones."""
        batch = [*itertools.islice(self._waiting, MAX_WRITTEN_TOGETHER)]
        lost = {} if batch else dict(self._lost)
        await self._store_arrivals(batch, lost)

    async def _store_arrivals(
        self, batch: list[Arrival], lost: dict[str, tuple[Arrival, int]]
    ) -> None:
        epoch = self.spool.epoch

        def work() -> OutletAccount:
            entries = list[OutletEntry]()
            for arrival in batch:
                kind, application, body = arrival.make()
                entry = OutletEntry(
                    arrival.camera, epoch, arrival.number, kind, application, arrival.at, body
                )
                entries.append(entry)
            gaps = [
                (
                    OutletEntry(arrival.camera, epoch, arrival.number, "gap", None, arrival.at, ""),
                    count,
                    _MEMORY,
                )
                for arrival, count in lost.values()
            ]
            self.spool.add(entries, gaps)
            return self.spool.account

        await self._run(work, lambda account: self._remove_stored(batch, lost, account))
        self._spooled.set()

    def _remove_stored(
        self, batch: list[Arrival], lost: dict[str, tuple[Arrival, int]], account: OutletAccount
    ) -> None:
        for arrival in batch:
            self._waiting.popleft()
            self._waiting_bytes -= arrival.size
        for camera, (_, count) in lost.items():
            last, now = self._lost.pop(camera)
            if now > count:
                self._lost[camera] = last, now - count
        self._account = account

    async def _run(self, work: Callable[[], T], then: Callable[[T], None] = lambda _: None) -> T:
        """Run work in the spool's thread, then ``then``, also if the caller is cancelled."""

        def guarded() -> T:
            if self.spool.closed:
                self.spool.open()
            try:
                return work()
            except sqlite3.Error as exc:
                if is_damage(exc):
                    self.spool.renew(text_of(exc))
                raise

        running = asyncio.wrap_future(self._thread.submit(guarded))
        try:
            outcome = await asyncio.shield(running)
        except asyncio.CancelledError:
            await asyncio.wait({running}, timeout=STOP_TIMEOUT)  # a disk may hang forever
            if running.done() and running.exception() is None:
                then(running.result())
            raise
        then(outcome)
        return outcome

    def _report_disk(self, why: str) -> None:
        if why != self.disk_trouble:
            self.disk_trouble = why
            log = logger.error if why else logger.info
            log("outlet %s: %s", self.outlet.name, why or "the spool is written again")
            self._report(self.outlet.name, why)

    # ------------------------------------------------------------------ to the far end

    async def _deliver(self) -> None:
        delays = Backoff().delays()
        while True:
            try:
                try:
                    async with asyncio.timeout(self.outlet.settings.timeout):
                        await self.outlet.open()
                    while True:
                        if await self._deliver_some():
                            delays = Backoff().delays()
                finally:
                    await self._close_outlet()
            except asyncio.CancelledError:
                if _cancelled():
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

    async def _deliver_some(self) -> bool:
        """Deliver a batch, or wait for one; return True if one was delivered.

        After a failed batch, entries are delivered singly at first: if the server fails at one,
        earlier entries are not delivered again.
        """
        self._spooled.clear()
        together, self._together = self._together, 1
        waiting = await self._run(lambda: self.spool.head(together))
        if not waiting.places:
            self._together = together
            if self.trouble:
                self._report_delivery("")
            await self._idle()
            return False
        try:
            async with asyncio.timeout(self.outlet.settings.timeout):
                await self.outlet.deliver(waiting.entries)
        except EntryRefusedError as exc:
            place = min(max(exc.place, 0), len(waiting.places) - 1)
            logger.error(  # noqa: TRY400 - the text says it
                "outlet %s: %s is refused for good: %s",
                self.outlet.name,
                waiting.entries[place].id,
                exc,
            )
            await self._forget(waiting, place, str(exc) or "refused")
        else:
            await self._forget(waiting, None, "")
        self._together = min(2 * together, self.outlet.max_batch)
        self._report_delivery("")
        return True

    async def _forget(self, waiting: SpoolHead, count: int | None, refused: str) -> None:
        """Remove delivered entries; wait while the disk is full, so that none is sent twice."""

        def work() -> OutletAccount:
            self.spool.done(waiting, count, refused)
            return self.spool.account

        while True:
            try:
                await self._run(work, self._set_account)
            except sqlite3.Error as exc:
                self._report_disk(f"the spool {self.spool.path}: {text_of(exc)}")
                await asyncio.sleep(DISK_RETRY_SECONDS)
            else:
                return

    def _set_account(self, account: OutletAccount) -> None:
        self._account = account

    async def _idle(self) -> None:
        """Wait until something is spooled.

        Raises:
            Exception: the server is lost.
        """
        loop = asyncio.get_running_loop()
        spooled = loop.create_task(self._spooled.wait())
        watching = loop.create_task(self.outlet.watch())
        try:
            await asyncio.wait({spooled, watching}, return_when=asyncio.FIRST_COMPLETED)
            if watching.done():
                watching.result()
        finally:
            for task in (spooled, watching):
                task.cancel()
            await asyncio.wait({spooled, watching})

    def _report_delivery(self, why: str) -> None:
        if why != self.trouble:
            self.trouble = why
            log = logger.warning if why else logger.info
            log("outlet %s: %s", self.outlet.name, why or "delivers again")
            self._report(self.outlet.name, why)


_MEMORY = "the spool's disk was full, away or too slow"


def _cancelled() -> bool:
    """Return True if this task has been cancelled."""
    task = asyncio.current_task()
    return task is None or task.cancelling() > 0
