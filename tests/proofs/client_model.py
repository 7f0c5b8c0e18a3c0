"""What the proofs about the asyncio client share: a plain camera.

:class:`CameraModel` is written from the protocol's description, not from the
emulator: it is told what clients and operators did and when, and says which inspections there were,
who triggered each, and what became of it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, NamedTuple

from smartcam.protocols import messages as m

if TYPE_CHECKING:
    from smartcam.emulator.traffic import Log, LogEntry

__all__ = ["CameraModel", "Program", "Run"]

# ---------------------------------------------------------------------- the camera

TOLERANCE = 1e-6
"""Seconds by which sums of the same times may differ here and there."""


class Program(NamedTuple):
    """An application: seconds of an inspection and of loading it, runs a second if it runs free."""

    processing: float
    loading: float
    rate: float | None = None


@dataclass(slots=True)
class Run:
    """One inspection.

    Attributes:
        began: when it began, seconds.
        number: its sequence number.
        application: the one that ran.
        by: the client's address and which of its Trigger messages, from 0; None for the camera's
            own doing and the operator's.
        fate: ``sent`` once its result was seen on the wire.
        peer: who got the result.
    """

    began: float
    number: int
    application: int
    by: tuple[str, int] | None
    fate: Literal["under way", "finished", "void", "sent"] = "under way"
    peer: str | None = None


@dataclass(slots=True)
class CameraModel:
    """What a camera does, by time; seconds of any clock.

    Sources: bvs.md 2.4, 2.5 (published); 8.9 (decided): Stop and a switch void the inspection under
    way, a trigger while one is under way is dropped, a switch while running is refused, a reboot
    comes up stopped with number 0. One that always runs (``bid``; 5.2, published, and 8.9): it is
    switched while it runs, and runs when it has loaded an application or come up.
    """

    programs: dict[int, Program]
    active: int
    reboot_time: float
    always_runs: bool = False
    mode: Literal["stopped", "running", "switching", "rebooting"] = "stopped"
    faulty: bool = False
    next_number: int = 0
    session: str | None = None
    runs: list[Run] = field(default_factory=list[Run])
    sent: list[Run] = field(default_factory=list[Run])
    triggers: dict[str, int] = field(default_factory=dict[str, int])
    _run: Run | None = None
    _run_ends: float = 0.0
    _mode_ends: float = 0.0
    _target: tuple[int, bool] = (0, False)
    _free_since: float = 0.0
    _free_count: int = 0

    @property
    def program(self) -> Program:
        """The active application."""
        return self.programs[self.active]

    # ------------------------------------------------------------------ what happened

    def read(self, log: Log) -> None:
        """Take what was said out of a camera's log."""
        assert len(log) < (log.maxlen or 0), "something may have gone by"
        while log:
            entry = log.popleft()
            self.advance(entry.time)
            if entry.direction == "in":
                self._hear(entry)
            elif isinstance(entry.message, m.ResultContainer):
                self._note_result(entry)

    def advance(self, now: float) -> None:
        """Let everything happen that is due until ``now``."""
        while True:
            due = [
                (when, order, what)
                for order, (when, what) in enumerate(self._due())
                if when <= now + TOLERANCE
            ]
            if not due:
                return
            when, _, what = min(due)
            getattr(self, what)(when)

    def start(self, now: float) -> None:
        """Enter run mode."""
        self.advance(now)
        if self.mode == "stopped":
            self.mode = "running"
            self._free_since, self._free_count = now, 0
            self.advance(now)

    def stop(self, now: float) -> None:
        """Leave run mode."""
        self.advance(now)
        if self.mode == "running":
            self._void()
            self.mode = "stopped"

    def trigger(self, now: float, by: tuple[str, int] | None) -> None:
        """Begin an inspection, if the camera waits for a trigger."""
        self.advance(now)
        waits = self.mode == "running" and self.program.rate is None
        if waits and self._run is None and not self.faulty:
            self._begin(now, by)

    def switch(self, now: float, application: int, *, running: bool = False) -> None:
        """Load an application, as the operator does."""
        self.advance(now)
        if self.mode in {"stopped", "running"}:
            self._void()
            self.mode, self._target = "switching", (application, running)
            self._mode_ends = now + self.programs[application].loading
            self.advance(now)

    def reboot(self, now: float) -> None:
        """Restart."""
        self.advance(now)
        if self.mode != "rebooting":
            self._void()
            self.mode, self.session, self._mode_ends = "rebooting", None, now + self.reboot_time

    def fault(self, now: float, *, on: bool) -> None:
        """Set or clear System Error."""
        self.advance(now)
        self.faulty = on
        if on:
            self._void()

    # ------------------------------------------------------------------ inside

    def _hear(self, entry: LogEntry) -> None:
        now, peer, message = entry.time, entry.peer, entry.message
        if self.mode == "rebooting":
            return
        if isinstance(message, m.Connect):
            self.session = peer
        if self.session != peer:
            return
        match message:
            case m.Disconnect():
                self.session = None
            case m.Trigger():
                count = self.triggers.get(peer, 0)
                self.triggers[peer] = count + 1
                self.trigger(now, (peer, count))
            case m.SetSequenceNumber(number=number):
                self.next_number = number
            case m.Start():
                self.start(now)
            case m.Stop():
                self.stop(now)
            case m.SwitchApplication(application=application):
                if self._takes_switch and application in self.programs:
                    self.switch(now, application)
            case m.Reboot():
                self.reboot(now)
            case _:
                pass

    @property
    def _takes_switch(self) -> bool:
        if self.always_runs:
            return self.mode == "running" and not self.faulty
        return self.mode == "stopped"

    def _note_result(self, entry: LogEntry) -> None:
        container = entry.message
        assert isinstance(container, m.ResultContainer)
        last = next((run for run in reversed(self.runs) if run.fate != "under way"), None)
        assert last is not None, f"a result came that no inspection made: {entry}"
        assert last.fate == "finished", f"a result came of an inspection that was over: {last}"
        number = int.from_bytes(container.data[:4], "little")
        assert (last.number, last.application) == (number, container.application), (last, entry)
        last.fate, last.peer = "sent", entry.peer
        self.sent.append(last)

    def _due(self) -> list[tuple[float, str]]:
        """What comes by itself, and when; at one instant in this order."""
        due: list[tuple[float, str]] = []
        if self._run is not None:
            due.append((self._run_ends, "_finish"))
        if self.mode in {"switching", "rebooting"}:
            due.append((self._mode_ends, "_come_up"))
        if self.mode == "running" and self.program.rate is not None:
            due.append((self._free_since + self._free_count / self.program.rate, "_run_free"))
        return due

    def _begin(self, now: float, by: tuple[str, int] | None) -> None:
        self._run = Run(now, self.next_number, self.active, by)
        self._run_ends = now + self.program.processing
        self.runs.append(self._run)
        self.next_number += 1

    def _finish(self, _: float) -> None:
        assert self._run is not None
        self._run.fate, self._run = "finished", None

    def _void(self) -> None:
        if self._run is not None:
            self._run.fate, self._run = "void", None

    def _run_free(self, now: float) -> None:
        self._free_count += 1
        if not self.faulty:
            self._begin(now, None)

    def _come_up(self, now: float) -> None:
        if self.mode == "rebooting":
            self.faulty, self.next_number, running = False, 0, False
        else:
            self.active, running = self._target
        self.mode = "stopped"
        if running or self.always_runs:
            self.start(now)
