"""Let commands through to a camera: from all programs, or only from one that has reserved it."""

from __future__ import annotations

import asyncio
import collections
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable

Change = Literal["Reserved", "Released", "ReservationLost"]
"""Events of a reservation."""


@dataclass(eq=False, slots=True)
class GateRequest:
    """A program's request to run a command, or to reserve the camera.

    Attributes:
        program: name of the waiting program.
        reservation: key of the wanted reservation; None: the request is for a command.
        granted: whether the request was granted.
        future: future that is done when the request is granted; None if no caller waits.
    """

    program: str
    reservation: Hashable | None
    granted: bool = False
    future: asyncio.Future[None] | None = None


def _report_nothing(change: Change, program: str) -> None:
    """Report nothing."""


@dataclass(eq=False)
class Gate:
    """Lets commands through to one camera, in the order in which they come.

    Attributes:
        on_change: callback for the start and the end of a program's reservation.
        holder: program that has reserved the camera; None if no program has.
    """

    on_change: Callable[[Change, str], None] = _report_nothing
    holder: str | None = None
    _reservations: set[Hashable] = field(default_factory=set["Hashable"])
    _running_commands: collections.Counter[str] = field(default_factory=collections.Counter[str])
    _queue: collections.deque[GateRequest] = field(default_factory=collections.deque["GateRequest"])

    async def enter(self, program: str, timeout: float) -> None:
        """Wait for the turn of a command of ``program``, which ends with :meth:`leave`.

        Raises:
            TimeoutError: the turn did not come within ``timeout`` seconds.
        """
        if not self.try_enter(program):
            await self._wait_turn(program, None, timeout)

    def try_enter(self, program: str) -> bool:
        """Begin a command if it need not wait; return True if the command has begun."""
        if self._queue or (self.holder is not None and self.holder != program):
            return False
        self._running_commands[program] += 1
        return True

    def leave(self, program: str) -> None:
        """Count a command of ``program`` as ended."""
        remaining = self._running_commands[program] - 1
        if remaining:
            self._running_commands[program] = remaining
        else:
            del self._running_commands[program]
        if self._queue:
            self._grant_requests()

    @property
    def waiting_count(self) -> int:
        """Number of waiting requests."""
        return len(self._queue)

    async def reserve(self, program: str, reservation: Hashable, timeout: float) -> None:
        """Keep the commands of other programs out, and wait until their running commands end.

        A program may reserve the camera again; each reservation is released separately.

        Raises:
            TimeoutError: the turn did not come within ``timeout`` seconds.
        """
        await self._wait_turn(program, reservation, timeout)

    def release(self, reservation: Hashable) -> None:
        """End a reservation, or the wait for this reservation; do nothing if there is neither."""
        self._reservations.discard(reservation)
        if not self._reservations:
            self._end_hold("Released")
        self._grant_requests()

    def holds(self, reservation: Hashable) -> bool:
        """Return True if a reservation was made and has not ended."""
        return reservation in self._reservations

    def lose_program(self, program: str) -> None:
        """End the reservations of a program that is lost, and report the loss."""
        if self.holder == program:
            self._reservations.clear()
            self._end_hold("ReservationLost")
            self._grant_requests()

    def _end_hold(self, change: Change) -> None:
        holder, self.holder = self.holder, None
        if holder is not None:
            self.on_change(change, holder)

    async def _wait_turn(self, program: str, reservation: Hashable | None, timeout: float) -> None:
        request = self.add_request(program, reservation)
        if request.granted:
            return
        request.future = asyncio.get_running_loop().create_future()
        try:
            async with asyncio.timeout(timeout):
                await request.future
        except BaseException:
            self.withdraw_request(request)
            raise

    def add_request(self, program: str, reservation: Hashable | None) -> GateRequest:
        """Add a request to the queue; grant it if no other request is before it."""
        request = GateRequest(program, reservation)
        if not self._queue or self.holder == program:
            self._queue.appendleft(request)
        else:
            self._queue.append(request)
        self._grant_requests()
        return request

    def withdraw_request(self, request: GateRequest) -> None:
        """Remove a request from the queue; if it was granted, end its command or reservation."""
        if request in self._queue:
            self._queue.remove(request)
        elif request.reservation is not None:
            self.release(request.reservation)
        else:
            self.leave(request.program)
        self._grant_requests()

    def _grant_requests(self) -> None:
        while self._queue and self._can_grant(self._queue[0]):
            request = self._queue.popleft()
            if request.reservation is None:
                self._running_commands[request.program] += 1
            else:
                was_held, self.holder = self.holder is not None, request.program
                self._reservations.add(request.reservation)
                if not was_held:
                    self.on_change("Reserved", request.program)
            request.granted = True
            if request.future is not None and not request.future.done():
                request.future.set_result(None)

    def _can_grant(self, request: GateRequest) -> bool:
        if self.holder not in {None, request.program}:
            return False
        others = self._running_commands.total() - self._running_commands[request.program]
        return request.reservation is None or not others
