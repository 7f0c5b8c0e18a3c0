"""Keep the data of the live page: a camera's last results, their rate, and the last picture."""

from __future__ import annotations

import asyncio
import collections
import json
import math
import time
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

from smartcam._client._inside import camera_interpreter
from smartcam.exceptions import ConnectionTakenError, InterpretationError, SmartCamError
from smartcam.layout._inside import units_of
from smartcam.models import Connected, Disconnected, Localization, Reconnected, Result, jsonable
from smartcam.web._history import ShiftHistory
from smartcam.web._verdicts import verdicts

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from smartcam.camera import Camera
    from smartcam.layout import Layout

MAX_RESULTS = 100
"""Largest number of results on the page; older ones are dropped."""

MAX_VALUE_CHARACTERS = 20_000
"""Largest number of characters of a value as JSON on the page; a longer text is cut."""

MAX_PARTS = 500
"""Largest number of localizations of a result that the page draws."""

MAX_SHOWN_RAW_BYTES = 64
"""Largest number of bytes of a container that the page shows."""

SERIES_DURATION = 300
"""Seconds for which the page draws rate and latency."""

IMAGE_PERIOD = 1.0
"""Least number of seconds between two pictures that are fetched for the page."""


@runtime_checkable
class DrawsPictures(Protocol):
    """A camera that draws what its programs found into the last picture."""

    async def read_drawn_image(self) -> bytes:
        """Return the picture as a file's bytes."""
        ...


class ShownResult(NamedTuple):
    """A result on the page, or the error of a container that could not be read."""

    serial: int  # counted from 0
    result: Result[Any] | None
    error: str  # reason why a container could not be read, or ""
    layout: Layout | None = None  # layout with the units of a table's columns

    def as_json(self) -> dict[str, Any]:
        """Return the result for the page, as values for JSON."""
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
            "raw": result.raw[:MAX_SHOWN_RAW_BYTES].hex(" "),
            **value_fields(result.value, self.layout),
        }


class Picture(NamedTuple):
    """A camera's picture, as a file's bytes."""

    serial: int  # counted from 1
    data: bytes


class LiveView:
    """Follows a camera and keeps the data of its page.

    Args:
        camera: camera that the caller opens and closes.
        is_watched: function that returns True while a page is open, so that pictures are fetched.
        history: history of the camera that another object keeps; None: the view keeps its own.

    Attributes:
        history: outcomes and failures of the last hours.
    """

    def __init__(
        self,
        camera: Camera[Any],
        is_watched: Callable[[], bool],
        history: ShiftHistory | None = None,
    ) -> None:
        self.history: ShiftHistory = history or ShiftHistory()
        self._owns_history = history is None
        self.camera: Camera[Any] = camera
        self.entries: collections.deque[ShownResult] = collections.deque(maxlen=MAX_RESULTS)
        self.series: collections.deque[dict[str, Any]] = collections.deque(maxlen=SERIES_DURATION)
        self.picture: Picture | None = None
        self.picture_error: str = ""
        self.changed_at: float = time.time()  # time of the last connection or loss
        self.changed_at_exact: bool = False  # False: the change was earlier
        self.loss: str = ""  # reason why the camera is not connected, or ""
        self._end_error: SmartCamError | None = (
            None  # error that ended the camera's events for good
        )
        self._is_watched = is_watched
        self._serial = 0
        self._picture_wanted = True
        self._fetched_failure = 0  # serial of the last failure whose picture was fetched
        self._latencies: list[float] = []  # latencies of the current second
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
        """Start to follow the camera."""
        jobs = (
            self._follow_results(),
            self._follow_events(),
            self._sample_rates(),
            self._fetch_pictures(),
        )
        self._tasks = [asyncio.create_task(job, name="smartcam.live") for job in jobs]

    async def stop(self) -> None:
        """Stop following the camera; do nothing if stopped."""
        tasks, self._tasks = self._tasks, []
        self._results.close()
        self._events.close()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def follow(self, camera: Camera[Any], loss: str) -> None:
        """Follow another camera, which is not open yet; ``loss``: why the old one was left.

        Cancellation: leaves the view stopped.
        """
        await self.stop()
        self._end_error, self.loss = None, loss
        self.camera = camera
        self._subscribe(camera)
        self.start()

    def add_result(self, result: Result[Any]) -> None:
        """Add a result that the camera gave before the view was started."""
        self._add_entry(result)

    def request_picture(self) -> None:
        """Have the camera's picture fetched soon, while there are viewers."""
        self._picture_wanted = True

    def state(self) -> dict[str, Any]:
        """Return the state of the camera, as values for JSON."""
        camera = self.camera
        has_state = camera.active_application is not None
        return {
            "name": camera.name,
            "url": camera.url,
            "connection": self._connection(),
            "loss": self.loss,
            "last_error": "" if camera.connected else camera.statistics().last_error or "",
            "changed_at": self.changed_at,
            "changed_at_exact": self.changed_at_exact,
            "status": camera.status.names if has_state else [],
            "application": camera.active_application,
            "capabilities": camera.capabilities if has_state else None,
            "picture_error": self.picture_error,
        }

    def _connection(self) -> str:
        if self.camera.connected:
            return "connected"
        if self.camera.active_application is None:
            return "awaited"
        if isinstance(self._end_error or self.camera.trouble, ConnectionTakenError):
            return "taken"
        return "lost" if self._end_error is None else "ended"

    def counts(self) -> dict[str, Any]:
        """Return the counts of results, as values for JSON."""
        statistics = self.camera.statistics()
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
        return {name: getattr(statistics, name) for name in names} | {
            "not_shown": self._unshown_count()
        }

    def _unshown_count(self) -> int:
        """Return the number of results dropped because the page was too slow for them."""
        return self._results.statistics().dropped

    # ------------------------------------------------------------------ tasks

    async def _follow_results(self) -> None:
        while True:
            try:
                batch = await anext(self._results)
            except InterpretationError as exc:
                self._add_entry(None, str(exc))
                continue
            except (StopAsyncIteration, SmartCamError):
                return
            if self._owns_history:
                for result in batch:
                    self.history.add(result)
            self._serial += max(0, len(batch) - MAX_RESULTS)
            for result in batch[-MAX_RESULTS:]:
                self._add_entry(result)
            self._latencies += [result.latency for result in batch if result.latency is not None]
            self._picture_wanted = True

    def _add_entry(self, result: Result[Any] | None, error: str = "") -> None:
        layout = None if result is None else layout_of(self.camera, result)
        self.entries.append(ShownResult(self._serial, result, error, layout))
        self._serial += 1
        if not self._owns_history:
            return
        if result is None:
            self.history.add_error(error)

    async def _follow_events(self) -> None:
        try:
            async for event in self._events:
                if isinstance(event, (Connected, Reconnected, Disconnected)):
                    self.changed_at, self.changed_at_exact = event.at.timestamp(), True
                    self.loss = event.reason if isinstance(event, Disconnected) else ""
                    if (
                        isinstance(event, Disconnected)
                        and not event.expected
                        and self._owns_history
                    ):
                        self.history.add_loss(self.loss)
                    self._picture_wanted |= not self.loss
        except SmartCamError as exc:
            self._end_error, self.loss = exc, str(exc)
            self.changed_at, self.changed_at_exact = time.time(), True

    async def _sample_rates(self) -> None:
        last_received = self.camera.statistics().received
        while True:
            await asyncio.sleep(1.0)
            received = self.camera.statistics().received
            latencies, self._latencies = sorted(self._latencies), []
            median = latencies[len(latencies) // 2] if latencies else None
            self.series.append(
                {"at": time.time(), "rate": max(0, received - last_received), "latency": median}
            )
            last_received = received

    async def _fetch_pictures(self) -> None:
        while True:
            is_wanted = self._picture_wanted and self._is_watched()
            failure = self.history.newest_result_failure
            is_missing = (
                self._owns_history
                and self.history.wants_picture
                and failure != self._fetched_failure
            )
            if (is_wanted or is_missing) and self.camera.connected:
                self._fetched_failure = failure
                self._picture_wanted = False
                if self.camera.capabilities.read_image:
                    await self._fetch_picture()
                    await asyncio.sleep(IMAGE_PERIOD)
            await asyncio.sleep(IMAGE_PERIOD / 10)

    async def _fetch_picture(self) -> None:
        """Fetch the camera's last picture; the state reports an error."""
        failure = self.history.newest_result_failure
        try:
            camera: object = self.camera
            if isinstance(camera, DrawsPictures):
                data = await camera.read_drawn_image()
            else:
                data = await self.camera.read_image()
        except SmartCamError as exc:
            self.picture_error = str(exc)
        else:
            self.picture_error = ""
            # if a newer result came meanwhile, the picture may belong to that result
            if (
                self._owns_history
                and failure == self.history.newest_result_failure
                and not self._results.waiting
            ):
                self.history.attach_picture(failure, data)
            self.picture = Picture(1 + (self.picture.serial if self.picture else 0), data)


def layout_of(camera: Camera[Any], result: Result[Any]) -> Layout | None:
    """Return the layout by which a camera's result was interpreted; None without a layout."""
    interpreter = camera_interpreter(camera, result.application)
    return None if interpreter is None else interpreter.layout


def value_fields(value: Any, layout: Layout | None = None) -> dict[str, Any]:
    """Return a value for the page: parts to draw, or JSON, which is cut if it is long.

    ``units`` has the units of its fields, and of the fields of its lists; those of a table come
    from ``layout``.
    """
    if isinstance(value, list) and all(isinstance(part, Localization) for part in value):
        localizations: list[Localization] = value
        frame = localizations[0].pose.header.frame_id if localizations else ""
        return {
            "parts": [_part_fields(localization) for localization in localizations[:MAX_PARTS]],
            "count": len(localizations),
            "frame": frame,
        }
    units = {**units_of(value, layout), **_units_of_lists(value)}
    value = jsonable(_as_text(value))
    text = json.dumps(value)
    shown = (
        {"value": value, "units": units}
        if len(text) <= MAX_VALUE_CHARACTERS
        else {"cut": text[: MAX_VALUE_CHARACTERS // 10]}
    )
    return {"verdicts": verdicts(value), **shown}


def _units_of_lists(value: Any) -> dict[str, Mapping[str, str]]:
    """Return the units of the fields of a record's lists, by the lists' names."""
    fields = value._asdict() if hasattr(value, "_asdict") else {}
    lists = {name: units_of(field) for name, field in fields.items() if isinstance(field, list)}
    return {name: units for name, units in lists.items() if units}


def _as_text(value: Any) -> Any:
    """Return bytes as text if they are printable, such as the cells of an In-Sight in JSON."""
    if not isinstance(value, bytes):
        return value
    try:
        text = value.decode()
    except UnicodeDecodeError:
        return value
    return text if text and text.replace("\n", " ").isprintable() else value


def _part_fields(localization: Localization) -> dict[str, Any]:
    """Return a part's position in metres, and its angle about z in radians."""
    (x, y, z), (i, j, k, w) = localization.pose.position, localization.pose.orientation
    theta = math.atan2(2.0 * (w * k + i * j), 1.0 - 2.0 * (j * j + k * k))
    place = {"x": x, "y": y, "z": z, "theta": theta}
    part = {"name": localization.feature_id, "quality": localization.quality, **place}
    return {name: jsonable(item) for name, item in part.items()}
