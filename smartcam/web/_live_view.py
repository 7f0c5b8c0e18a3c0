"""What the live page knows of a camera: its last results, how fast they come, its last picture."""

from __future__ import annotations

import asyncio
import collections
import contextlib
import json
import time
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam.exceptions import ConnectionClosedError, SmartCamError
from smartcam.models import Connected, Disconnected, Reconnected, Result, jsonable

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.client import SmartCamera

MAX_RESULTS = 100
"""Results that the page can show: those before are on it no more."""

MAX_VALUE = 20_000
"""Characters of JSON that a value may have on the page; a larger one is cut."""

MAX_SHOWN_RAW = 64
"""Bytes of a container that the page shows."""

SERIES = 300
"""Seconds of rate and latency that the page draws."""

IMAGE_PERIOD = 1.0
"""Seconds between two pictures that are fetched for the page, at least."""


class Entry(NamedTuple):
    """A result, or why there is none."""

    serial: int  # counted from 0
    result: Result[Any] | None
    error: str  # why a container could not be read, "" where it could

    def as_json(self) -> dict[str, Any]:
        """Return it as the page takes it."""
        if self.result is None:
            return {"serial": self.serial, "error": self.error}
        result = self.result
        value = jsonable(result.value)
        text = json.dumps(value)
        shown = {"value": value} if len(text) <= MAX_VALUE else {"cut": text[: MAX_VALUE // 10]}
        return {
            "serial": self.serial,
            "number": result.number,
            "application": result.application,
            "sequence": result.sequence,
            "received_at": result.received_at.timestamp(),
            "latency": result.latency,
            "size": len(result.raw),
            "raw": result.raw[:MAX_SHOWN_RAW].hex(" "),
            "verdicts": verdicts(value),
            **shown,
        }


class Picture(NamedTuple):
    """A camera's picture, as a file's bytes."""

    serial: int  # counted from 1
    data: bytes


class LiveView:
    """Follows a camera; the page's readers look at what it has.

    Args:
        camera: it; opened and closed by whoever made it.
        is_watched: whether anybody looks, so that a picture is worth being fetched.
    """

    def __init__(self, camera: SmartCamera[Any], is_watched: Callable[[], bool]) -> None:
        self.camera = camera
        self.entries: collections.deque[Entry] = collections.deque(maxlen=MAX_RESULTS)
        self.series: collections.deque[dict[str, Any]] = collections.deque(maxlen=SERIES)
        self.picture: Picture | None = None
        self.picture_error: str = ""
        self.changed_at: float = time.time()  # when it was connected or lost at last
        self.loss: str = ""  # why it is not connected, "" where it is
        self._is_watched = is_watched
        self._serial = 0
        self._fresh = asyncio.Event()  # a result came since the last picture
        self._latencies: list[float] = []  # of this second
        self._tasks: list[asyncio.Task[None]] = []
        self._results = camera.results(batch=True, max_queue=10 * MAX_RESULTS)
        self._events = camera.events()

    @property
    def serial(self) -> int:
        """Serial of the next entry."""
        return self._serial

    def start(self) -> None:
        """Begin."""
        jobs = (self._follow_results(), self._follow_events(), self._tick(), self._fetch_pictures())
        self._tasks = [asyncio.create_task(job, name="smartcam.live") for job in jobs]

    async def stop(self) -> None:
        """End; harmless when done twice."""
        tasks, self._tasks = self._tasks, []
        self._results.close()
        self._events.close()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def state(self) -> dict[str, Any]:
        """Return how the camera is, as JSON."""
        camera = self.camera
        known = camera.active_application is not None
        return {
            "name": camera.name,
            "url": camera.url,
            "connected": camera.connected,
            "loss": self.loss,
            "changed_at": self.changed_at,
            "status": camera.status.names if known else [],
            "application": camera.active_application,
            "can": camera.capabilities if known else None,
            "picture_error": self.picture_error,
        }

    def account(self) -> dict[str, Any]:
        """Return what was counted, as JSON."""
        counted = self.camera.statistics()
        names = (
            *("received", "triggered", "streamed", "late", "wrong_application"),
            *("uninterpretable", "unclaimed", "inspections_by_others", "overtriggers", "reconnects"),
        )
        return {name: getattr(counted, name) for name in names} | {"not_shown": self._not_shown()}

    def _not_shown(self) -> int:
        """Return how many results came faster than the page takes them."""
        return self._results.statistics().dropped

    # ------------------------------------------------------------------ tasks

    async def _follow_results(self) -> None:
        while not self._results.ended:
            try:
                batch = await anext(self._results)
            except StopAsyncIteration:
                return
            except ConnectionClosedError:
                return
            except SmartCamError as exc:
                self._add(None, str(exc))
                continue
            self._serial += max(0, len(batch) - MAX_RESULTS)
            for result in batch[-MAX_RESULTS:]:
                self._add(result)
            self._latencies += [one.latency for one in batch if one.latency is not None]
            self._fresh.set()

    def _add(self, result: Result[Any] | None, error: str = "") -> None:
        self.entries.append(Entry(self._serial, result, error))
        self._serial += 1

    async def _follow_events(self) -> None:
        with contextlib.suppress(SmartCamError):  # which says how the camera ended: see below
            async for event in self._events:
                if isinstance(event, (Connected, Reconnected, Disconnected)):
                    self.changed_at = event.at.timestamp()
                    self.loss = event.reason if isinstance(event, Disconnected) else ""
        self.changed_at = time.time()
        self.loss = str(self.camera.statistics().last_error or "closed")

    async def _tick(self) -> None:
        before = self.camera.statistics().received
        while True:
            await asyncio.sleep(1.0)
            received = self.camera.statistics().received
            latencies, self._latencies = sorted(self._latencies), []
            median = latencies[len(latencies) // 2] if latencies else None
            self.series.append({"at": time.time(), "rate": received - before, "latency": median})
            before = received

    async def _fetch_pictures(self) -> None:
        while True:
            await self._fresh.wait()
            self._fresh.clear()
            if not (self.camera.connected and self.camera.capabilities.read_image):
                continue
            if self._is_watched():
                await self.fetch_picture()
                await asyncio.sleep(IMAGE_PERIOD)

    async def fetch_picture(self) -> None:
        """Fetch the camera's last picture; what went wrong is told in the state."""
        try:
            data = await self.camera.read_image()
        except SmartCamError as exc:
            self.picture_error = str(exc)
        else:
            self.picture_error = ""
            self.picture = Picture(1 + (self.picture.serial if self.picture else 0), data)


def verdicts(value: Any) -> dict[str, Any]:
    """Return what a value says of good and bad: its truth values by name.

    Of a list of records: how many of them are true, and of how many.
    """
    if isinstance(value, dict):
        return {str(name): one for name, one in value.items() if isinstance(one, bool)}
    if isinstance(value, list) and value and all(isinstance(one, dict) for one in value):
        names = [name for name, one in value[0].items() if isinstance(one, bool)]
        return {name: [sum(one.get(name) is True for one in value), len(value)] for name in names}
    return {}
