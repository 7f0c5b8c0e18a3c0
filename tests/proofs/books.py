"""Helpers of proofs about the client: the keeper of a camera's book, and the client's listeners.

Each container of a :class:`BookKeeper` says which run it is of, and the camera knows of each run
when it began and by which Trigger message. A :class:`ClientEar` counts what came to one client.
"""

from __future__ import annotations

import asyncio
import struct
from array import array
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from smartcam import exceptions
from smartcam.emulator import Application, EmulatedCamera, Run
from smartcam.emulator._inside import ClientLink
from smartcam.models import CameraEvent, Connected, Disconnected, Reconnected, Status
from smartcam.observers import Observer, TraceEntry
from smartcam.protocols import messages as m

LINK_LOST = (
    exceptions.ConnectionLostError,
    exceptions.ConnectionTakenError,
    exceptions.ConnectionClosedError,
)

TRIGGER_OUTCOMES: tuple[type[exceptions.SmartCamError], ...] = (
    exceptions.OvertriggeredError,
    exceptions.NotRunningError,
    exceptions.CameraBusyError,
    exceptions.CameraFaultError,
    exceptions.InputContainerError,
    exceptions.TriggerTimeoutError,
    exceptions.WrongApplicationError,
    exceptions.InterpretationError,
    exceptions.CommandRejectedError,
    exceptions.UnsupportedError,
    *LINK_LOST,
)
"""Errors that a trigger may end with in place of a result; the list is closed."""


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """Return a table as text: the first column to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for cells in rows:
        rest = (cell.rjust(width) for cell, width in zip(cells[1:], widths[1:], strict=True))
        lines.append("  ".join([cells[0].ljust(widths[0]), *rest]))
    return "\n".join(lines)


class LagProbe:
    """Measures how late the loop is."""

    def __init__(self, step: float = 0.005) -> None:
        self.worst = 0.0  # seconds
        self._step = step
        self._lags: deque[tuple[float, float]] = deque(maxlen=4_000)
        self._loop = asyncio.get_running_loop()
        self._due = self._loop.time() + step
        self._timer = self._loop.call_at(self._due, self._tick)

    def since(self, begun: float) -> Iterator[float]:
        """Give each time since then that the loop was late, seconds; first how late it is now."""
        yield max(0.0, self._loop.time() - max(self._due, begun))
        for at, lag in reversed(self._lags):
            if at < begun:
                return
            yield min(lag, at - begun)

    def stop(self) -> None:
        """Measure no more."""
        self._timer.cancel()

    def _tick(self) -> None:
        now = self._loop.time()
        self.worst = max(self.worst, now - self._due)
        self._lags.append((now, now - self._due))
        self._due = now + self._step
        self._timer = self._loop.call_at(self._due, self._tick)


# ---------------------------------------------------------------------- the camera's side

RECORD = struct.Struct("<4i")
"""A container: sequence number, run, token of the input data, application."""

NOBODY = -1
"""In place of the number that was set before a trigger: none was."""

FULL_LOG = 1000
"""Entries of the emulator's log that are read before it forgets any."""

MEMORY = 1 << 14
"""Runs that are remembered; a container does not come later than that."""


def layout_of(marked: bool) -> str:
    """Return how a client reads a container, with the number to be looked at or not."""
    mark = " @sequence" if marked else ""
    return f"number: int32{mark}, run: int32, token: int32, application: int32"


def run_of(data: bytes) -> int:
    """Return which run a container is of."""
    return int.from_bytes(data[4:8], "little", signed=True)


@dataclass(frozen=True, slots=True)
class KeptRun:
    """One inspection."""

    index: int  # which, from 1
    began: float  # seconds of the device's time
    session: int = 0  # in which it was triggered, counted from 1 by the Connects that came
    trigger: int = 0  # which Trigger message of that session began it, 0 for none
    told: int = NOBODY  # the number that was set before that, :data:`NOBODY` for none


class Sent(NamedTuple):
    """A container that the log shows."""

    peer: str  # to whom it was sent
    run: KeptRun  # of which
    data: bytes
    whole: bool  # it went out as it is


class BookKeeper(EmulatedCamera):
    """An emulated camera whose containers say which run made them, and which knows its runs.

    ``applications`` says by id what each has beside what all of them have, ``marked`` that the
    layout's number is to be looked at.
    """

    def __init__(
        self,
        applications: Mapping[int, Mapping[str, Any]],
        *,
        marked: bool,
        kept_runs: int = MEMORY,
        **options: Any,
    ) -> None:
        self.layout = layout_of(marked)
        self.kept_runs = kept_runs
        self.runs: dict[int, KeptRun] = {}  # the last inspections, by index
        self.triggers = 0
        self.overtriggers = 0  # times it rose with one of these
        self._count = self._session = self._in_session = 0
        self._told = NOBODY
        self._by: tuple[int, int, int] = (0, 0, NOBODY)
        self._sent: list[Sent] = []
        super().__init__(
            [
                Application(
                    id=number,
                    layout=self.layout,
                    generator=self._values,
                    parameters={"application": number},
                    **more,
                )
                for number, more in applications.items()
            ],
            builtins=False,
            running=True,
            **options,
        )

    @property
    def time(self) -> float:
        """The device's time now, seconds."""
        with self.step():
            pass
        return self.device.time

    @property
    def sent(self) -> list[Sent]:
        """The containers that were sent; the log is read for that, and empty then."""
        self._read_log()
        return self._sent

    def _read_log(self) -> None:
        while self.log:
            entry = self.log.popleft()
            if isinstance(entry.message, m.ResultContainer) and entry.direction == "out":
                data = entry.message.data
                index = run_of(data)
                run = self.runs.get(index, KeptRun(index, 0.0))
                self._sent.append(Sent(entry.peer, run, data, entry.wire is None))

    def handle_message(self, link: ClientLink, message: m.Message) -> None:
        """Note whose the run is that a trigger begins."""
        if len(self.log) > FULL_LOG:
            self._read_log()  # it is bounded
        idle, before = not self.device.processing, self.device.status
        if isinstance(message, m.Connect):
            self._session, self._in_session = self._session + 1, 0
        elif isinstance(message, m.SetSequenceNumber):
            self._told = message.number
        elif isinstance(message, m.Trigger):
            self.triggers += 1
            self._in_session += 1
        super().handle_message(link, message)
        if isinstance(message, m.Trigger):
            told, self._told = self._told, NOBODY
            if idle and self.device.processing:
                self._by = (self._session, self._in_session, told)
            self.overtriggers += Status.OVERTRIGGERED in self.device.status & ~before

    def trigger(self) -> None:
        """Trigger by the digital input."""
        if self.device.trigger():
            self._by = (0, 0, NOBODY)

    def _values(self, run: Run) -> dict[str, int]:
        self._count += 1
        self.runs[self._count] = KeptRun(self._count, run.time, *self._by)
        self.runs.pop(self._count - self.kept_runs, None)
        return {
            "number": run.number & 0x7FFFFFFF,
            "run": self._count,
            "token": 0 if run.input is None else run.input["token"],
            "application": run.parameters["application"],
        }


# ---------------------------------------------------------------------- the client's side


class ClientEar(Observer):
    """Hears what one client says and what it is told; knows which links became sessions."""

    def __init__(self, keep: int | None = None) -> None:
        # what was said in both directions; ``keep`` of the last
        self.frames: deque[TraceEntry] = deque(maxlen=keep)
        self.number: int | None = None  # the sequence number that was set last
        # that which was set before the last trigger, :data:`NOBODY` for none
        self.triggered_as = NOBODY
        # containers of sessions, by run, where all is kept; of the session that is open, ``now``
        self.got: Counter[int] = Counter()
        self.now: Counter[int] = Counter()
        self._before = self._in_session = 0  # containers of sessions that ended, and of this one
        self.after = 0  # containers that came when the client had been told to close
        self.closing = False  # it was told to close
        self.at_frame: Callable[[TraceEntry], None] | None = None  # called with each frame
        # called with the run of each container, in a session or not
        self.at_container: Callable[[int], None] | None = None
        self._told = NOBODY
        self._adopted = False

    @property
    def received(self) -> int:
        """Containers of sessions that came before the client was told to close."""
        return self._before + (self._in_session if self._adopted else 0)

    def on_frame(self, entry: TraceEntry) -> None:
        if entry.direction == "!":
            self._take_back(entry.hex)
            return
        self.frames.append(entry)
        match entry.message:
            case "Connect" if entry.direction == ">" and not self._adopted:
                self._forget_session()  # an attempt; in a session it asks for the status
            case "SetSequenceNumber":
                self.number = self._told = entry.fields["number"]
            case "Trigger":
                self.triggered_as, self._told = self._told, NOBODY
            case "ResultContainer" if entry.fields is not None:
                self._came(_run_told(entry))
            case _:
                pass
        if self.at_frame is not None:
            self.at_frame(entry)

    def _came(self, run: int) -> None:
        if self.at_container is not None:
            self.at_container(run)
        if self.closing and self._adopted:
            self.after += 1
        else:
            self._count(run, 1)

    def _count(self, run: int, more: int) -> None:
        self._in_session += more
        if self.frames.maxlen is None:
            self.now[run] += more

    def _forget_session(self) -> None:
        self.now, self._in_session = Counter(), 0

    def _take_back(self, payload: str) -> None:
        """A frame was refused: a container where there is no session is none."""
        last = self.frames[-1] if self.frames else None
        if last is None or last.message != "ResultContainer" or last.fields is None:
            return
        if payload and payload.endswith(last.fields["data"]):
            self._count(_run_told(last), -1)

    def on_state(self, event: CameraEvent) -> None:
        if isinstance(event, (Connected, Reconnected)):
            self._adopted = True
        elif isinstance(event, Disconnected):
            self.got += self.now
            self._before += self._in_session
            self._forget_session()
            self._adopted = self.closing


def _run_told(entry: TraceEntry) -> int:
    return run_of(bytes.fromhex(entry.fields["data"]))


# ---------------------------------------------------------------------- both sides

STRANGER = "second client"
"""The peer whose log entries are on no link of ours."""


class Ledger:
    """Sent and received, for one camera and all its clients."""

    def __init__(
        self, name: str, emulator: BookKeeper, complain: Callable[[str], None], *, ordered: bool
    ) -> None:
        # lost: with a link that ended; on UDP, all that did not come
        # received: those that came
        # sent: containers that the log showed
        self.sent = self.received = self.lost = 0
        self._name = name
        self._emulator = emulator  # whose log is read, and emptied by that
        self._ordered = ordered  # TCP
        self._complain = complain  # told of what must not be
        self._open: deque[Sent] = deque()
        self._recent = array("q", bytes(8 * MEMORY))  # runs rise by one

    def read_log(self) -> None:
        """Note what was sent since the last time."""
        sent = self._emulator.sent
        for one in sent:
            if one.peer != STRANGER:
                self.sent += 1
                self._recent[one.run.index % MEMORY] = one.run.index
                if self._ordered:
                    self._open.append(one)
        sent.clear()

    def on_received(self, run: int) -> None:
        """A container came."""
        self.read_log()
        self.received += 1
        if not self._ordered:
            if self._recent[run % MEMORY] != run:
                self._complain(f"{self._name}: container {run} came and was not sent")
            return
        passed: Counter[str] = Counter()
        while self._open:
            entry = self._open.popleft()
            if entry.run.index == run:
                self.lost += passed.total()
                if gap := passed[entry.peer]:
                    self._complain(f"{self._name}: {gap} containers before {run} are missing")
                return
            passed[entry.peer] += 1
        self._complain(f"{self._name}: container {run} came once more than it was sent")

    def close(self) -> None:
        """Everything has been heard: on the link that is open now nothing may be missing."""
        self.read_log()
        alive = set(self._emulator.sessions)
        missing = sum(entry.peer in alive for entry in self._open)
        if missing:
            self._complain(f"{self._name}: {missing} containers did not come over an open link")
        self.lost = self.sent - self.received if not self._ordered else self.lost + len(self._open)
        self._open.clear()
