"""Keep one row of the fleet page's table: a camera's state, its counts and its last result."""

from __future__ import annotations

import asyncio
import collections
import functools
import json
import math
import time
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from smartcam.exceptions import InterpretationError, SmartCamError
from smartcam.layout._inside import ShownUnits
from smartcam.models import Status
from smartcam.web._history import ShiftHistory
from smartcam.web._live_view import layout_of, value_fields
from smartcam.web._verdicts import Outcome, outcome_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.fleet import FleetCamera
    from smartcam.layout import Layout
    from smartcam.models import CameraEvent, Result
    from smartcam.streams import BatchSubscription, Subscription

MAX_QUEUE: Final = 64
"""Largest number of a camera's results that wait for the next update; older ones are only
counted."""

MAX_QUEUE_BYTES: Final = 1 << 18
"""Largest number of bytes of the waiting results of a camera."""

MAX_KEPT_BYTES: Final = 1 << 16
"""Largest number of bytes of a result whose contents a row shows; of a longer result only the
length is shown."""

MAX_DRAWN_PARTS: Final = 30
"""Largest number of parts of a result that a row draws."""

MAX_TEXT_CHARACTERS: Final = 160
"""Largest number of characters of a text in a row."""

RATE_SECONDS: Final = 5
"""Number of seconds over which the rate of results is averaged."""

ERROR_MARK_SECONDS: Final = 60.0
"""Seconds for which a row shows an error."""

OUTCOMES: Final[tuple[Outcome, ...]] = ("passed", "failed", "other", "errors")

MODES: Final = ("error", "lost", "ended", "gone", "awaited", "stopped", "busy", "running")
"""States of a camera, the worst first.

"ended": the camera was taken or given up; "gone": no agent shares it any more; "awaited": it was
never connected.
"""

SI: Final = ShownUnits()
"""Units for texts in SI: no other units are shown."""

_ERRORS: Final = Status.SYSTEM_ERROR | Status.OVERHEAT


class RowState(NamedTuple):
    """The state of a camera."""

    connected: bool
    has_ended: bool  # whether the camera was given up
    status: Status
    application: int | None
    reason: str  # reason why it is not connected
    error: str  # text of the last error
    agents: tuple[str, ...]


UNKNOWN: Final = RowState(False, False, Status(0), None, "", "", ())


class FleetRow:
    """A camera's row in the table of a fleet.

    Args:
        name: name of the camera.
        on_change: callback with the row, when the row may have changed.
        units: units that the page can show instead of SI.

    Attributes:
        agents: names of the agents that share the camera.
        version: version of the view at the last change of the row.
        mode: state of the camera, in a word.
        flags: names of the filters that the row passes.
        count: number of results received since the camera has been followed.
        text: text that a search examines.
        rate: results per second.
        errors: number of results that could not be read or did not come, and of lost connections.
        error: text of the last error, for as long as it is marked.
        may_have_changed: True if the camera may have changed since the last update.
        error_at: time of the last error, on the loop's clock.
        history: outcomes and failures of the last hours.
        changed_at: time at which the camera was last connected or lost, seconds since 1970.
        changed_at_exact: False if ``changed_at`` is only the time of the first update; the change
            itself was earlier.
        picture_at: time of the last try to get the picture of a failure, on the loop's clock.
    """

    def __init__(self, name: str, on_change: Callable[[FleetRow], None], units: ShownUnits) -> None:
        self.name: str = name
        self.agents: set[str] = set()
        self.camera: FleetCamera[Any] | None = None
        self.version: int = 0
        self.mode: str = "gone"
        self.flags: frozenset[str] = frozenset({"all"})
        self.count: int = 0
        self.errors: int = 0
        self.rate: float = 0.0
        self.text: str = name
        self.error: str = ""
        self.error_at: float | None = None
        self.may_have_changed: bool = False
        self.history: ShiftHistory = ShiftHistory()
        self.changed_at: float = time.time()
        self.changed_at_exact: bool = False
        self.picture_at: float = -math.inf
        self._on_change = on_change
        self._units = units
        self._last_lost_counts = (0, 0)  # numbers of missed and dropped results at the last count
        self._last: Result[Any] | None = None
        self._layout: Layout | None = None  # layout of the last result
        self._counts_by_second: collections.deque[int] = collections.deque([0], RATE_SECONDS + 1)
        self._state: RowState = UNKNOWN
        self._connected = False
        self._results: BatchSubscription[Result[Any]] | None = None
        self._events: Subscription[CameraEvent] | None = None
        self._json: tuple[int, str] = (-1, "")

    # ------------------------------------------------------------------ following a camera

    def follow(self, camera: FleetCamera[Any]) -> None:
        """Follow a camera object, which may replace a camera that was given up."""
        if self.camera is camera:
            return
        self.stop_following()
        self.camera = camera
        on_result = functools.partial(self._on_change, self)
        self._results = camera.results(
            batch=True, max_queue=MAX_QUEUE, max_queue_bytes=MAX_QUEUE_BYTES
        )
        self._events = camera.events(max_queue=1)
        # every new result or event causes a call, so that no task waits for them
        self._results.share(_RowBell(on_result))
        self._events.share(_RowBell(self.note_change))
        self.note_change()

    def note_change(self) -> None:
        """Note that the row may have changed."""
        self.may_have_changed = True
        self._on_change(self)

    def stop_following(self) -> None:
        """Stop following the camera. Idempotent."""
        for stream in (self._results, self._events):
            if stream is not None:
                stream.close()
        self._results = self._events = self.camera = None
        self._last_lost_counts = (0, 0)

    # ------------------------------------------------------------------ updates

    async def count_results(self, now: float) -> collections.Counter[str]:
        """Count the new results, and return how many there are of each outcome; never wait."""
        outcomes: collections.Counter[str] = collections.Counter()
        stream, was_full = self._results, False
        while stream is not None and stream.waiting:
            try:
                batch = await anext(stream)
            except InterpretationError as exc:
                outcomes["errors"] += 1
                self.errors += 1
                self._mark_error(str(exc), now)
                self.history.add_error(str(exc))
                continue
            except (StopAsyncIteration, SmartCamError):
                break
            outcomes.update(self.history.add(result) for result in batch)
            self._last = batch[-1]
            self._layout = None if self.camera is None else layout_of(self.camera, self._last)
            was_full |= len(batch) >= MAX_QUEUE
        self.count += outcomes.total()
        if was_full:
            self.count_lost_results(outcomes, now)
        return outcomes

    def count_lost_results(self, outcomes: collections.Counter[str], now: float) -> None:
        """Count missed results as errors, and dropped results as "other", in ``outcomes``."""
        if self._results is None:
            return
        counts, last_counts = self._results.statistics(), self._last_lost_counts
        self._last_lost_counts = (counts.missed, counts.dropped)
        missed, dropped = counts.missed - last_counts[0], counts.dropped - last_counts[1]
        if missed:
            text = f"{missed} results did not come: the agent was out of reach for too long"
            self._mark_error(text, now)
            self.history.add_missed(missed, text)
            outcomes["errors"] += missed
            self.errors += missed
        if dropped:
            outcomes["other"] += dropped
        self.count += missed + dropped

    def _mark_error(self, error: str, now: float) -> None:
        self.error, self.error_at = error[:MAX_TEXT_CHARACTERS], now

    def refresh(self, now: float) -> tuple[bool, bool]:
        """Update the camera's state; return whether it changed, and whether it was just lost."""
        camera = self.camera
        connected = camera is not None and camera.connected and bool(self.agents)
        lost = self._connected and not connected
        if connected != self._connected:
            self.changed_at, self.changed_at_exact = time.time(), self._state is not UNKNOWN
        self._connected, self.may_have_changed = connected, False
        status, application, reason, has_ended = Status(0), None, "", False
        if camera is not None:
            has_ended = camera.ended
            if connected:
                application = camera.active_application
                status = status if application is None else camera.status
            else:
                reason = _loss_reason(camera)
        if lost:
            self._mark_error(reason or "lost", now)
            self.history.add_loss(reason or "no agent shares the camera")
            self.errors += 1
        elif self.error_at is not None and now - self.error_at >= ERROR_MARK_SECONDS:
            self.error, self.error_at = "", None
        state = RowState(
            connected,
            has_ended,
            status,
            application,
            reason,
            self.error,
            tuple(sorted(self.agents)),
        )
        if state == self._state:
            return False, False
        self._state = state
        self._describe(state)
        return True, lost

    def _describe(self, state: RowState) -> None:
        """Set mode, flags and searched text from the state."""
        self.mode = self._mode_of(state)
        self.flags = _flags(self.mode, state, has_error=self.error_at is not None)
        words = (self.name, *state.agents, self.mode, state.reason, state.error, state.application)
        self.text = "\n".join(str(word) for word in words if word is not None).lower()

    def _mode_of(self, state: RowState) -> str:
        if not state.agents or self.camera is None:
            return "gone"
        if not state.connected:
            if state.has_ended:
                return "ended"
            return "awaited" if self.camera.active_application is None else "lost"
        if state.status & _ERRORS:
            return "error"
        if state.status & Status.BUSY:
            return "busy"
        return "running" if state.status & Status.RUNNING else "stopped"

    def update_rate(self) -> bool:
        """Compute the rate; call it once a second.

        Returns:
            Whether the rate will change even without new results.
        """
        self._counts_by_second.append(self.count)
        self.rate = (self.count - self._counts_by_second[0]) / (len(self._counts_by_second) - 1)
        return self._counts_by_second[0] != self.count

    @property
    def failure_serial(self) -> int:
        """Serial of the newest result if it is a failure; otherwise, or if not counted yet, 0."""
        has_uncounted = self._results is None or self._results.waiting
        return 0 if has_uncounted else self.history.newest_result_failure

    # ------------------------------------------------------------------ for the page

    @property
    def last(self) -> Result[Any] | None:
        """The last result."""
        return self._last

    @property
    def last_at(self) -> float:
        """Time of the last result, seconds since 1970; 0 without one."""
        return self._last.received_at.timestamp() if self._last is not None else 0.0

    def as_json(self) -> str:
        """Return the row as JSON, which is made once for all pages."""
        if self._json[0] != self.version:
            self._json = (self.version, json.dumps(self.fields(), separators=(",", ":")))
        return self._json[1]

    def fields(self) -> dict[str, Any]:
        """Return the row as a page shows it."""
        state = self._state
        return {
            "name": self.name,
            "agents": state.agents,
            "mode": self.mode,
            "status": state.status.names,
            "application": state.application,
            "reason": state.reason or state.error,
            "rate": round(self.rate, 1),
            "count": self.count,
            "errors": self.errors,
            "last": None if self._last is None else self._result_fields(self._last),
            "changed_at": round(self.changed_at),
            "changed_at_exact": self.changed_at_exact,
            "failed_since": self.history.failed_since,
            "in_a_row": self.history.in_a_row,
            "shift": self.history.totals,
            "trend": self.history.trend(),
        }

    def _result_fields(self, result: Result[Any]) -> dict[str, Any]:
        """Return a result as a row shows it: lines of text, or parts to be drawn.

        ``text`` is in SI, ``practical`` in the units that the page can show instead.
        """
        fields: dict[str, Any] = {
            "at": round(result.received_at.timestamp(), 2),
            "number": result.number,
            "outcome": outcome_of(result.value),
        }
        if len(result.raw) > MAX_KEPT_BYTES:
            return {**fields, "text": f"{len(result.raw)} bytes"}
        value = value_fields(result.value, self._layout)
        if "parts" in value:
            parts = [
                [part["name"][:40], *(round(part[key], 5) for key in ("x", "y", "theta"))]
                for part in value["parts"][:MAX_DRAWN_PARTS]
                if None not in (part["x"], part["y"], part["theta"])
            ]
            return {**fields, "parts": parts, "parts_count": value["count"]}
        if "cut" in value:
            return {**fields, "text": value["cut"][:MAX_TEXT_CHARACTERS]}
        units = value["units"]
        lines = {"text": line_of(value["value"], units)}
        if units:
            lines["practical"] = line_of(value["value"], units, self._units)
        return {**fields, **{name: text[:MAX_TEXT_CHARACTERS] for name, text in lines.items()}}


def _loss_reason(camera: FleetCamera[Any]) -> str:
    """Return the reason why a camera is not connected, from its agent if there is one."""
    trouble = camera.trouble
    if trouble is None:
        return ""
    return str(trouble.__cause__ or trouble).removeprefix(f"{camera.name}: ")[:MAX_TEXT_CHARACTERS]


class _RowBell(asyncio.Event):
    """An event that calls a function instead of waking a task."""

    def __init__(self, callback: Callable[[], None]) -> None:
        super().__init__()
        self._call = callback

    def set(self) -> None:
        self._call()


def _flags(mode: str, state: RowState, *, has_error: bool) -> frozenset[str]:
    status, connected = state.status, state.connected
    is_inspecting = bool(status & Status.RUNNING) and not status & Status.WAITING_FOR_TRIGGER
    flags = {
        "all": True,
        "connected": connected,
        "errors": has_error or not connected or mode == "error",
        "busy": connected and (is_inspecting or bool(status & Status.BUSY)),
        "stopped": mode == "stopped",
    }
    return frozenset(name for name, on in flags.items() if on)


def line_of(value: Any, units: Any, displayed: ShownUnits = SI) -> str:
    """Return a value as a text of one line.

    Args:
        value: value in its JSON form.
        units: SI unit of the value, or the units of its fields by name.
        displayed: units in which the line shows numbers.
    """
    if isinstance(value, dict):
        fields = list(value.items())[:20]
        return ", ".join(
            f"{name} {line_of(value, units.get(name, {}), displayed)}" for name, value in fields
        )
    if isinstance(value, list):
        return f"{len(value)}: " + " | ".join(line_of(item, units, displayed) for item in value[:3])
    if isinstance(value, float):
        if isinstance(units, str):
            return f"{displayed.shown(value, units):.5g} {displayed.of(units).name}"
        return f"{value:.5g}"
    return value if value and isinstance(value, str) else json.dumps(value)
