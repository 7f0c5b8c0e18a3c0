"""What the live page knows of a camera: its last results, how fast they come, its last picture."""

from __future__ import annotations

import asyncio
import collections
import json
import math
import re
import time
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam.exceptions import ConnectionTakenError, InterpretationError, SmartCamError
from smartcam.models import Connected, Disconnected, Localization, Reconnected, Result, jsonable

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.camera import Camera

MAX_RESULTS = 100
"""Results that the page can show: those before are on it no more."""

MAX_VALUE = 20_000
"""Characters of JSON that a value may have on the page; a larger one is cut."""

MAX_PARTS = 500
"""Localizations of a result that the page draws."""

MAX_SHOWN_RAW = 64
"""Bytes of a container that the page shows."""

SERIES = 300
"""Seconds of rate and latency that the page draws."""

IMAGE_PERIOD = 1.0
"""Seconds between two pictures that are fetched for the page, at least."""


class ShownResult(NamedTuple):
    """A result, or why there is none."""

    serial: int  # counted from 0
    result: Result[Any] | None
    error: str  # why a container could not be read, "" where it could

    def as_json(self) -> dict[str, Any]:
        """Return it as the page takes it."""
        if self.result is None:
            return {"serial": self.serial, "error": self.error}
        result = self.result
        return {
            "serial": self.serial,
            "number": result.number,
            "application": result.application,
            "sequence": result.sequence,
            "received_at": result.received_at.timestamp(),
            "latency": result.latency,
            "size": len(result.raw),
            "raw": result.raw[:MAX_SHOWN_RAW].hex(" "),
            **shown_value(result.value),
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

    def __init__(self, camera: Camera[Any], is_watched: Callable[[], bool]) -> None:
        self.camera: Camera[Any] = camera
        self.entries: collections.deque[ShownResult] = collections.deque(maxlen=MAX_RESULTS)
        self.series: collections.deque[dict[str, Any]] = collections.deque(maxlen=SERIES)
        self.picture: Picture | None = None
        self.picture_error: str = ""
        self.changed_at: float = time.time()  # when it was connected or lost at last
        self.loss: str = ""  # why it is not connected, "" where it is
        self._end: SmartCamError | None = None  # why it will never be again
        self._is_watched = is_watched
        self._serial = 0
        self._picture_wanted = True
        self._latencies: list[float] = []  # of this second
        self._tasks: list[asyncio.Task[None]] = []
        self._subscribe(camera)

    def _subscribe(self, camera: Camera[Any]) -> None:
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

    async def follow(self, camera: Camera[Any], loss: str) -> None:
        """Show this camera instead, which is not opened yet; ``loss``: why the one before is not.

        Cancellation: leaves it stopped.
        """
        await self.stop()
        self._end, self.loss = None, loss
        self.camera = camera
        self._subscribe(camera)
        self.start()

    def show(self, result: Result[Any]) -> None:
        """Show a result of before it was followed."""
        self._add(result)

    def want_picture(self) -> None:
        """Have the camera's picture fetched when its time has come, while anybody looks."""
        self._picture_wanted = True

    def state(self) -> dict[str, Any]:
        """Return how the camera is, as JSON."""
        camera = self.camera
        known = camera.active_application is not None
        return {
            "name": camera.name,
            "url": camera.url,
            "connection": self._connection(),
            "loss": self.loss,
            "last_error": "" if camera.connected else camera.statistics().last_error or "",
            "changed_at": self.changed_at,
            "status": camera.status.names if known else [],
            "application": camera.active_application,
            "can": camera.capabilities if known else None,
            "picture_error": self.picture_error,
        }

    def _connection(self) -> str:
        if self.camera.connected:
            return "connected"
        if self.camera.active_application is None:
            return "awaited"
        if isinstance(self._end, ConnectionTakenError):
            return "taken"
        return "lost" if self._end is None else "ended"

    def account(self) -> dict[str, Any]:
        """Return what was counted, as JSON."""
        counted = self.camera.statistics()
        names = (
            *("received", "triggered", "streamed", "late", "wrong_application"),
            *(
                "uninterpretable",
                "unclaimed",
                "inspections_by_others",
                "overtriggers",
                "reconnects",
            ),
        )
        return {name: getattr(counted, name) for name in names} | {"not_shown": self._not_shown()}

    def _not_shown(self) -> int:
        """Return how many results came faster than the page takes them."""
        return self._results.statistics().dropped

    # ------------------------------------------------------------------ tasks

    async def _follow_results(self) -> None:
        while True:
            try:
                batch = await anext(self._results)
            except InterpretationError as exc:
                self._add(None, str(exc))
                continue
            except (StopAsyncIteration, SmartCamError):
                return
            self._serial += max(0, len(batch) - MAX_RESULTS)
            for result in batch[-MAX_RESULTS:]:
                self._add(result)
            self._latencies += [one.latency for one in batch if one.latency is not None]
            self._picture_wanted = True

    def _add(self, result: Result[Any] | None, error: str = "") -> None:
        self.entries.append(ShownResult(self._serial, result, error))
        self._serial += 1

    async def _follow_events(self) -> None:
        try:
            async for event in self._events:
                if isinstance(event, (Connected, Reconnected, Disconnected)):
                    self.changed_at = event.at.timestamp()
                    self.loss = event.reason if isinstance(event, Disconnected) else ""
                    self._picture_wanted |= not self.loss
        except SmartCamError as exc:
            self._end, self.changed_at, self.loss = exc, time.time(), str(exc)

    async def _tick(self) -> None:
        before = self.camera.statistics().received
        while True:
            await asyncio.sleep(1.0)
            received = self.camera.statistics().received
            latencies, self._latencies = sorted(self._latencies), []
            median = latencies[len(latencies) // 2] if latencies else None
            self.series.append(
                {"at": time.time(), "rate": max(0, received - before), "latency": median}
            )
            before = received

    async def _fetch_pictures(self) -> None:
        while True:
            if self._picture_wanted and self._is_watched() and self.camera.connected:
                self._picture_wanted = False
                if self.camera.capabilities.read_image:
                    await self._fetch_picture()
                    await asyncio.sleep(IMAGE_PERIOD)
            await asyncio.sleep(IMAGE_PERIOD / 10)

    async def _fetch_picture(self) -> None:
        """Fetch the camera's last picture; what went wrong is told in the state."""
        try:
            data = await self.camera.read_image()
        except SmartCamError as exc:
            self.picture_error = str(exc)
        else:
            self.picture_error = ""
            self.picture = Picture(1 + (self.picture.serial if self.picture else 0), data)


def shown_value(value: Any) -> dict[str, Any]:
    """Return a value as the page shows it: parts that it draws, or JSON, cut where it is long."""
    if isinstance(value, list) and all(isinstance(one, Localization) for one in value):
        found: list[Localization] = value
        frame = found[0].pose.header.frame_id if found else ""
        return {
            "parts": [_part(one) for one in found[:MAX_PARTS]],
            "count": len(found),
            "frame": frame,
        }
    value = jsonable(value)
    text = json.dumps(value)
    shown = {"value": value} if len(text) <= MAX_VALUE else {"cut": text[: MAX_VALUE // 10]}
    return {"verdicts": verdicts(value), **shown}


def _part(one: Localization) -> dict[str, Any]:
    """Return a part as it lies on the plane: metres, and radians about z."""
    (x, y, z), (i, j, k, w) = one.pose.position, one.pose.orientation
    theta = math.atan2(2.0 * (w * k + i * j), 1.0 - 2.0 * (j * j + k * k))
    part = {"name": one.feature_id, "quality": one.quality, "x": x, "y": y, "z": z, "theta": theta}
    return {name: jsonable(item) for name, item in part.items()}


def verdicts(value: Any) -> list[dict[str, Any]]:
    """Return a value's truth values: ``name``, ``true``, ``of`` and ``verdict``.

    Of a list of records: how many of them are true, and of how many.
    """
    rows: list[Any] = value if isinstance(value, list) else [value]
    if not (rows and all(isinstance(one, dict) for one in rows)):
        return []
    names = [str(name) for name, one in rows[0].items() if isinstance(one, bool)]
    return [_verdict(name, [one.get(name) is True for one in rows]) for name in names]


def _verdict(name: str, values: list[bool]) -> dict[str, Any]:
    good = meaning(name)
    verdict = None if good is None else "pass" if all(one is good for one in values) else "fail"
    return {"name": name, "true": sum(values), "of": len(values), "verdict": verdict}


PASS_WORDS = frozenset({"ok", "pass", "passed", "good", "valid", "accept", "accepted", "io"})
FAIL_WORDS = frozenset(
    {"nok", "fail", "failed", "bad", "defect", "reject", "rejected", "error", "nio"}
)
NOT_WORDS = frozenset({"not", "no"})


def meaning(name: str) -> bool | None:
    """Return which of its values is the good one, by a field's name; None where it does not tell.

    ``ok`` is good when true, ``defect`` and ``not_ok`` when false. Of ``present`` nobody knows.
    """
    words = set(re.findall(r"[a-z]+", name.lower()))
    known = bool(words & PASS_WORDS) + bool(words & FAIL_WORDS)
    return None if known != 1 else bool(words & PASS_WORDS) is not bool(words & NOT_WORDS)
