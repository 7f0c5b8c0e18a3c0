"""Whose commands may go to a camera: anybody's, or those of the program that has reserved it."""

from __future__ import annotations

import asyncio
import collections
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Hashable


@dataclass(eq=False, slots=True)
class _InLine:
    program: str
    reservation: Hashable | None  # None: a command
    granted: asyncio.Future[None]


@dataclass(eq=False)
class Gate:
    """Lets commands through to one camera, in the order in which they come.

    Attributes:
        holder: the program that has reserved the camera, None where none has.
    """

    holder: str | None = None
    _reservations: set[Hashable] = field(default_factory=set["Hashable"])
    _active: collections.Counter[str] = field(default_factory=collections.Counter[str])
    _line: collections.deque[_InLine] = field(default_factory=collections.deque["_InLine"])

    async def enter(self, program: str, timeout: float) -> None:
        """Let a command of ``program`` begin; it ends with :meth:`leave`.

        Raises:
            TimeoutError: not within ``timeout`` seconds.
        """
        if not self.goes_in(program):
            await self._pass(program, None, timeout)

    def goes_in(self, program: str) -> bool:
        """Let a command begin if it need not wait; whether it did."""
        if self._line or (self.holder is not None and self.holder != program):
            return False
        self._active[program] += 1
        return True

    def leave(self, program: str) -> None:
        """A command of ``program`` has ended; programs without any are not kept."""
        left = self._active[program] - 1
        if left:
            self._active[program] = left
        else:
            del self._active[program]
        if self._line:
            self._grant()

    @property
    def waiting(self) -> int:
        """How many wait for being let in."""
        return len(self._line)

    async def reserve(self, program: str, reservation: Hashable, timeout: float) -> None:
        """Keep the commands of others out; those under way are waited for.

        A program may reserve again what it has reserved; each reservation is released by itself.

        Raises:
            TimeoutError: not within ``timeout`` seconds.
        """
        await self._pass(program, reservation, timeout)

    def release(self, reservation: Hashable) -> None:
        """End a reservation, or the wait for it; one that is not there is none."""
        self._reservations.discard(reservation)
        if not self._reservations:
            self.holder = None
        self._grant()

    def forget(self, program: str) -> None:
        """End all reservations of a program that is gone."""
        if self.holder == program:
            self._reservations.clear()
            self.holder = None
            self._grant()

    async def _pass(self, program: str, reservation: Hashable | None, timeout: float) -> None:
        waiting = _InLine(program, reservation, asyncio.get_running_loop().create_future())
        if not self._line or self.holder == program:
            self._line.appendleft(waiting)
        else:
            self._line.append(waiting)
        self._grant()
        if waiting.granted.done():
            return
        try:
            async with asyncio.timeout(timeout):
                await waiting.granted
        except BaseException:
            if waiting in self._line:
                self._line.remove(waiting)
            elif reservation is not None:
                self.release(reservation)
            else:
                self.leave(program)
            self._grant()
            raise

    def _grant(self) -> None:
        while self._line and self._may(self._line[0]):
            waiting = self._line.popleft()
            if waiting.reservation is None:
                self._active[waiting.program] += 1
            else:
                self.holder = waiting.program
                self._reservations.add(waiting.reservation)
            if not waiting.granted.done():
                waiting.granted.set_result(None)

    def _may(self, waiting: _InLine) -> bool:
        if self.holder not in {None, waiting.program}:
            return False
        others = self._active.total() - self._active[waiting.program]
        return waiting.reservation is None or not others
