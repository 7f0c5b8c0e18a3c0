"""Let commands pass to a camera: from all programs, or only from the one that reserved it."""

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
class InLine:
    """A command or reservation in the line.

    Attributes:
        program: name of the waiting program.
        reservation: key of the reservation; None for a command.
        granted: whether the turn has come.
        wake: future that is done when the turn comes; None if no caller waits.
    """

    program: str
    reservation: Hashable | None
    granted: bool = False
    wake: asyncio.Future[None] | None = None


def _report_nothing(change: Change, program: str) -> None:
    """Report nothing."""


@dataclass(eq=False)
class Gate:
    """Lets commands through to one camera, in the order in which they come.

    Attributes:
        on_change: callback for the start and the end of a program's reservation.
        holder: program that has reserved the camera; None if none has.
    """

    on_change: Callable[[Change, str], None] = _report_nothing
    holder: str | None = None
    _reservations: set[Hashable] = field(default_factory=set["Hashable"])
    _active: collections.Counter[str] = field(default_factory=collections.Counter[str])
    _line: collections.deque[InLine] = field(default_factory=collections.deque["InLine"])

    async def enter(self, program: str, timeout: float) -> None:
        """Wait for the turn of a command of ``program``, which ends with :meth:`leave`.

        Raises:
            TimeoutError: the turn did not come within ``timeout`` seconds.
        """
        if not self.goes_in(program):
            await self._pass(program, None, timeout)

    def goes_in(self, program: str) -> bool:
        """Begin a command if it need not wait; return whether it began."""
        if self._line or (self.holder is not None and self.holder != program):
            return False
        self._active[program] += 1
        return True

    def leave(self, program: str) -> None:
        """Count a command of ``program`` as ended."""
        left = self._active[program] - 1
        if left:
            self._active[program] = left
        else:
            del self._active[program]
        if self._line:
            self._grant()

    @property
    def waiting(self) -> int:
        """Number of waiting programs."""
        return len(self._line)

    async def reserve(self, program: str, reservation: Hashable, timeout: float) -> None:
        """Keep the commands of other programs out, and wait until their running commands end.

        A program may reserve the camera again; each reservation is released separately.

        Raises:
            TimeoutError: the turn did not come within ``timeout`` seconds.
        """
        await self._pass(program, reservation, timeout)

    def release(self, reservation: Hashable) -> None:
        """End a reservation, or the wait for it; does nothing if there is neither."""
        self._reservations.discard(reservation)
        if not self._reservations:
            self._free("Released")
        self._grant()

    def holds(self, reservation: Hashable) -> bool:
        """Return True if a reservation was made and has not ended."""
        return reservation in self._reservations

    def forget(self, program: str) -> None:
        """End the reservations that a program has not released; report them as lost."""
        if self.holder == program:
            self._reservations.clear()
            self._free("ReservationLost")
            self._grant()

    def _free(self, change: Change) -> None:
        holder, self.holder = self.holder, None
        if holder is not None:
            self.on_change(change, holder)

    async def _pass(self, program: str, reservation: Hashable | None, timeout: float) -> None:
        waiting = self.line_up(program, reservation)
        if waiting.granted:
            return
        waiting.wake = asyncio.get_running_loop().create_future()
        try:
            async with asyncio.timeout(timeout):
                await waiting.wake
        except BaseException:
            self.give_up(waiting)
            raise

    def line_up(self, program: str, reservation: Hashable | None) -> InLine:
        """Add a command or a reservation to the line, and grant its turn if none is before it."""
        waiting = InLine(program, reservation)
        if not self._line or self.holder == program:
            self._line.appendleft(waiting)
        else:
            self._line.append(waiting)
        self._grant()
        return waiting

    def give_up(self, waiting: InLine) -> None:
        """Remove an entry from the line, or end its turn if it was granted."""
        if waiting in self._line:
            self._line.remove(waiting)
        elif waiting.reservation is not None:
            self.release(waiting.reservation)
        else:
            self.leave(waiting.program)
        self._grant()

    def _grant(self) -> None:
        while self._line and self._may(self._line[0]):
            waiting = self._line.popleft()
            if waiting.reservation is None:
                self._active[waiting.program] += 1
            else:
                again, self.holder = self.holder is not None, waiting.program
                self._reservations.add(waiting.reservation)
                if not again:
                    self.on_change("Reserved", waiting.program)
            waiting.granted = True
            if waiting.wake is not None and not waiting.wake.done():
                waiting.wake.set_result(None)

    def _may(self, waiting: InLine) -> bool:
        if self.holder not in {None, waiting.program}:
            return False
        others = self._active.total() - self._active[waiting.program]
        return waiting.reservation is None or not others
