"""One camera of the fleet's page: what it is, what it has sent, and its last result."""

from __future__ import annotations

import asyncio
import collections
import functools
import json
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, TypeAlias

from smartcam.exceptions import InterpretationError, SmartCamError
from smartcam.models import Localization, Status
from smartcam.web._live_view import meaning, shown_value

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.fleet import FleetCamera
    from smartcam.models import CameraEvent, Result
    from smartcam.streams import BatchSubscription, Subscription

MAX_QUEUE: Final = 64
"""Results of a camera that wait for a look; of those beyond only their number is known."""

MAX_QUEUE_BYTES: Final = 1 << 18
"""Bytes of them."""

MAX_KEPT: Final = 1 << 16
"""Bytes of a result that is kept for its picture; of a longer one its length is told."""

MAX_JUDGED: Final = 200
"""Records of a result in which pass or fail is looked for."""

MAX_DRAWN: Final = 30
"""Parts of a result in its picture."""

MAX_TEXT: Final = 160
"""Characters of a text in a row."""

RATE_SECONDS: Final = 5
"""Over which a rate is counted."""

BAD_SECONDS: Final = 60.0
"""For which a camera with an error has the mark of one."""

Outcome: TypeAlias = Literal["passed", "failed", "other", "errors"]
OUTCOMES: Final[tuple[Outcome, ...]] = ("passed", "failed", "other", "errors")

MODES: Final = ("error", "lost", "ended", "gone", "awaited", "stopped", "busy", "running")
"""What a camera is, in a word, the worst first: one that has ended was taken or given up, no agent
shares one that is gone, and one that is awaited was never there."""

_ERRORS: Final = Status.SYSTEM_ERROR | Status.OVERHEAT


class RowState(NamedTuple):
    """How a camera is."""

    connected: bool
    over: bool  # it was given up
    status: Status
    application: int | None
    reason: str  # why it is not connected
    error: str  # the last one
    agents: tuple[str, ...]


UNKNOWN: Final = RowState(False, False, Status(0), None, "", "", ())


class FleetRow:
    """A camera.

    Args:
        name: of the camera.
        ring: is called with the row when something of it may have changed.

    Attributes:
        agents: that share it.
        version: of the view, when it was changed last.
        mode: what it is, in a word.
        flags: the filters that it passes.
        count: results that it has sent since it is followed.
        text: in which a search looks.
        rate: results in a second.
        errors: results that could not be read or did not come, and times that it was lost.
        error: the last of them, for as long as it is marked.
        stirred: it may be otherwise than when it was looked at.
        error_at: when it had an error last, on the loop's clock.
    """

    def __init__(self, name: str, ring: Callable[[FleetRow], None]) -> None:
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
        self.stirred: bool = False
        self._ring = ring
        self._counted = (0, 0)  # missed, dropped
        self._last: Result[Any] | None = None
        self._marks: collections.deque[int] = collections.deque([0], RATE_SECONDS + 1)
        self._state: RowState = UNKNOWN
        self._connected = False
        self._results: BatchSubscription[Result[Any]] | None = None
        self._events: Subscription[CameraEvent] | None = None
        self._json: tuple[int, str] = (-1, "")

    # ------------------------------------------------------------------ what it follows

    def follow(self, camera: FleetCamera[Any]) -> None:
        """Follow this object, which may take the place of one that was given up."""
        if self.camera is camera:
            return
        self.leave()
        self.camera = camera
        ring = functools.partial(self._ring, self)
        self._results = camera.results(
            batch=True, max_queue=MAX_QUEUE, max_queue_bytes=MAX_QUEUE_BYTES
        )
        self._events = camera.events(max_queue=1)
        # every offer rings, so nobody needs to wait for either, nor to take the events
        self._results.share(_RowBell(ring))
        self._events.share(_RowBell(self.stir))
        self.stir()

    def stir(self) -> None:
        """It may be otherwise than before."""
        self.stirred = True
        self._ring(self)

    def leave(self) -> None:
        """Hear nothing more of it; idempotent."""
        for stream in (self._results, self._events):
            if stream is not None:
                stream.close()
        self._results = self._events = self.camera = None
        self._counted = (0, 0)

    # ------------------------------------------------------------------ looks

    async def take(self, now: float) -> collections.Counter[str]:
        """Take what has come; return how it turned out. It does not wait."""
        outcomes: collections.Counter[str] = collections.Counter()
        stream, full = self._results, False
        while stream is not None and stream.waiting:
            try:
                batch = await anext(stream)
            except InterpretationError as exc:
                outcomes["errors"] += 1
                self.errors += 1
                self._note(str(exc), now)
                continue
            except (StopAsyncIteration, SmartCamError):
                break
            outcomes.update(judged(result.value) for result in batch)
            self._last = batch[-1]
            full |= len(batch) >= MAX_QUEUE
        self.count += outcomes.total()
        if full:
            self.account(outcomes, now)
        return outcomes

    def account(self, outcomes: collections.Counter[str], now: float) -> None:
        """Count what did not come, or was not taken: a result that nobody judged is another one."""
        if self._results is None:
            return
        said, before = self._results.statistics(), self._counted
        self._counted = (said.missed, said.dropped)
        missed, dropped = said.missed - before[0], said.dropped - before[1]
        if missed:
            self._note(f"{missed} results did not come: cut off from the agent for too long", now)
            outcomes["errors"] += missed
            self.errors += missed
        if dropped:
            outcomes["other"] += dropped
        self.count += missed + dropped

    def _note(self, error: str, now: float) -> None:
        self.error, self.error_at = error[:MAX_TEXT], now

    def refresh(self, now: float) -> tuple[bool, bool]:
        """Look how the camera is; return whether that changed, and whether it was lost."""
        camera = self.camera
        connected = camera is not None and camera.connected and bool(self.agents)
        lost = self._connected and not connected
        self._connected, self.stirred = connected, False
        status, application, reason, over = Status(0), None, "", False
        if camera is not None:
            over = camera.ended
            if connected:
                application = camera.active_application
                status = status if application is None else camera.status
            else:
                reason = _why(camera)
        if lost:
            self._note(reason or "lost", now)
            self.errors += 1
        elif self.error_at is not None and now - self.error_at >= BAD_SECONDS:
            self.error, self.error_at = "", None
        state = RowState(
            connected, over, status, application, reason, self.error, tuple(sorted(self.agents))
        )
        if state == self._state:
            return False, False
        self._state = state
        self._describe(state)
        return True, lost

    def _describe(self, state: RowState) -> None:
        """Have the words for what it is."""
        self.mode = self._word(state)
        self.flags = _flags(self.mode, state, bad=self.error_at is not None)
        told = (self.name, *state.agents, self.mode, state.reason, state.error, state.application)
        self.text = "\n".join(str(one) for one in told if one is not None).lower()

    def _word(self, state: RowState) -> str:
        if not state.agents or self.camera is None:
            return "gone"
        if not state.connected:
            if state.over:
                return "ended"
            return "awaited" if self.camera.active_application is None else "lost"
        if state.status & _ERRORS:
            return "error"
        if state.status & Status.BUSY:
            return "busy"
        return "running" if state.status & Status.RUNNING else "stopped"

    def mark(self) -> bool:
        """Count the rate, once a second; return whether it will change by itself."""
        self._marks.append(self.count)
        self.rate = (self.count - self._marks[0]) / (len(self._marks) - 1)
        return self._marks[0] != self.count

    # ------------------------------------------------------------------ for the page

    @property
    def last(self) -> Result[Any] | None:
        """The last result."""
        return self._last

    @property
    def last_at(self) -> float:
        """When the last result came, seconds since 1970; 0 without one."""
        return self._last.received_at.timestamp() if self._last is not None else 0.0

    def as_json(self) -> str:
        """Return it as JSON, made once for all who look."""
        if self._json[0] != self.version:
            self._json = (self.version, json.dumps(self.fields(), separators=(",", ":")))
        return self._json[1]

    def fields(self) -> dict[str, Any]:
        """Return it as a page shows it."""
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
            "last": None if self._last is None else _pictured(self._last),
        }


def _why(camera: FleetCamera[Any]) -> str:
    """Return why a camera is not connected: what its agent says, where there is one."""
    trouble = camera.trouble
    if trouble is None:
        return ""
    return str(trouble.__cause__ or trouble).removeprefix(f"{camera.name}: ")[:MAX_TEXT]


class _RowBell(asyncio.Event):
    """Calls somebody instead of waking one."""

    def __init__(self, ring: Callable[[], None]) -> None:
        super().__init__()
        self._call = ring

    def set(self) -> None:
        self._call()


def _flags(mode: str, state: RowState, *, bad: bool) -> frozenset[str]:
    status, connected = state.status, state.connected
    inspecting = bool(status & Status.RUNNING) and not status & Status.WAITING_FOR_TRIGGER
    flags = {
        "all": True,
        "connected": connected,
        "errors": bad or not connected or mode == "error",
        "busy": connected and (inspecting or bool(status & Status.BUSY)),
        "stopped": mode == "stopped",
    }
    return frozenset(name for name, on in flags.items() if on)


_meaning = functools.lru_cache(maxsize=4096)(meaning)


def judged(value: Any) -> Outcome:
    """Return how a result turned out, by the names of its truth values."""
    rows = value if isinstance(value, list) else [value]
    verdict: Outcome = "other"
    for row in rows[:MAX_JUDGED]:
        if isinstance(row, Localization) or not hasattr(row, "_asdict"):
            return "other"
        for name, one in row._asdict().items():
            if one is True or one is False:
                good = _meaning(name)
                if good is not None and one is not good:
                    return "failed"
                if good is not None:
                    verdict = "passed"
    return verdict


def _pictured(result: Result[Any]) -> dict[str, Any]:
    """Return a result as a row shows it: a line of text, or parts to be drawn."""
    told: dict[str, Any] = {
        "at": round(result.received_at.timestamp(), 2),
        "number": result.number,
        "outcome": judged(result.value),
    }
    if len(result.raw) > MAX_KEPT:
        return {**told, "text": f"{len(result.raw)} bytes"}
    value = shown_value(result.value)
    if "parts" in value:
        parts = [
            [one["name"][:40], *(round(one[key], 5) for key in ("x", "y", "theta"))]
            for one in value["parts"][:MAX_DRAWN]
            if None not in (one["x"], one["y"], one["theta"])
        ]
        return {**told, "parts": parts, "parts_count": value["count"]}
    text = value.get("cut") or _line(value.get("value"))
    return {**told, "text": text[:MAX_TEXT]}


def _line(value: Any) -> str:
    """Return a value in one line."""
    if isinstance(value, dict):
        return ", ".join(f"{name} {_line(one)}" for name, one in list(value.items())[:20])
    if isinstance(value, list):
        return f"{len(value)}: " + " | ".join(map(_line, value[:3]))
    if isinstance(value, float):
        return f"{value:.5g}"
    return value if isinstance(value, str) else json.dumps(value)
