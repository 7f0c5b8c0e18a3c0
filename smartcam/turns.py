"""Whose turn it is: one command at a time, and going back after a temporary switch.

Going back to the application before is a job of the supervisor's task group: it is finished even
when the caller was cancelled, it is bounded, and every later command waits for it.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING

from smartcam.exceptions import ResponseTimeoutError, SmartCamError
from smartcam.models import Status

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator

    from smartcam.conversation import Conversation

__all__ = ["Before", "Turns"]

logger: logging.Logger = logging.getLogger("smartcam.client")


@dataclass(frozen=True, slots=True)
class Before:
    """What to go back to.

    Attributes:
        application: id of the application that was active.
        running: whether it ran.
        expected: the application that was named, if any.
    """

    application: int
    running: bool
    expected: int | None


class Turns:
    """Gives commands their turn.

    Args:
        talk: the conversation that the turn is about.
        switch_timeout: bound of each switch, seconds.
    """

    def __init__(self, talk: Conversation, switch_timeout: float) -> None:
        self.jobs: asyncio.TaskGroup | None = None
        self._talk = talk
        self._switch_timeout = switch_timeout
        self._lock = asyncio.Lock()
        self._leaving: set[asyncio.Task[None]] = set()
        self._failed: SmartCamError | None = None

    @contextlib.asynccontextmanager
    async def hold(self, timeout: float) -> AsyncGenerator[float]:
        """Hold the turn; gives the deadline, the wait for the turn included.

        Raises:
            ResponseTimeoutError: others had it for ``timeout`` seconds.
            SmartCamError: going back failed before this command, and why.
        """
        deadline = self._talk.deadline(timeout)
        self._talk.require_link()
        try:
            async with asyncio.timeout_at(deadline):
                await self._acquire()
        except TimeoutError as exc:
            raise ResponseTimeoutError(
                f"{self._talk.name}: another command had the camera for {timeout:g} s",
                waited=timeout,
            ) from exc
        try:
            self._raise_failed()
            await self._talk.catch_up(deadline)
            yield deadline
        finally:
            self._lock.release()

    @contextlib.asynccontextmanager
    async def hold_in(self, application: int | None, timeout: float) -> AsyncGenerator[float]:
        """Hold the turn with ``application`` running, if one is given; gives the deadline.

        Afterwards the application before is back; after an error or a cancellation that goes on
        behind the caller's back.
        """
        if application is None:
            async with self.hold(timeout) as deadline:
                yield deadline
            return
        self._talk.deadline(timeout)  # a wrong one is refused before anything is switched
        async with self.hold(self._switch_timeout) as switch_deadline:
            before = await self.enter(application, switch_deadline)
            try:
                yield self._talk.deadline(timeout)
            finally:
                going_back = self.leave(before)
        if going_back is not None:
            await asyncio.wait({going_back})

    async def enter(self, application: int, deadline: float) -> Before:
        """Have ``application`` running; the turn is held. Goes back where that fails."""
        running = self._talk.runs
        active = await self._talk.query(deadline)
        before = Before(active, running, self._talk.inbox.expected)
        try:
            await self._talk.ensure(application, deadline)
        except BaseException:
            self.leave(before)
            raise
        return before

    def leave(self, before: Before) -> asyncio.Task[None] | None:
        """Let the supervisor go back as soon as the turn is free; None if the session is over."""
        if self.jobs is None or self._talk.inbox.end is not None:
            return None
        name = f"smartcam[{self._talk.name}].going_back"
        job = self.jobs.create_task(self._go_back(before), name=name)
        self._leaving.add(job)
        job.add_done_callback(self._leaving.discard)
        return job

    async def leave_and_wait(self, before: Before) -> None:
        """Go back, and raise what stood in the way.

        Cancellation: going back is finished nevertheless.
        """
        job = self.leave(before)
        if job is not None:
            await asyncio.wait({job})
            self._raise_failed()

    async def settle(self) -> None:
        """Wait until every job that goes back is done.

        Each is bounded by the switch timeout once it has the turn; who had it before may take
        longer, so the caller has a deadline of its own.
        """
        while self._leaving:
            await asyncio.wait(self._leaving)

    async def _go_back(self, before: Before) -> None:
        """Restore application and run state; never raises."""
        talk = self._talk
        async with self._lock:
            deadline = talk.deadline(self._switch_timeout)
            try:
                if await talk.query(deadline) != before.application:
                    await talk.switch(before.application, deadline, start=before.running)
                elif before.running and Status.RUNNING not in talk.status:
                    await talk.start(deadline)
                elif not before.running and Status.RUNNING in talk.status:
                    await talk.stop(deadline)
            except SmartCamError as error:
                logger.warning("%s ! going back failed: %s", talk.name, error)
                self._failed = error
            finally:
                talk.inbox.expected = before.expected

    async def _acquire(self) -> None:
        """Take the lock, but behind every job that goes back.

        Who had the turn before may have left such a job behind while this command was in line.
        """
        while True:
            await self.settle()
            await self._lock.acquire()
            if not self._leaving:
                return
            self._lock.release()

    def _raise_failed(self) -> None:
        error, self._failed = self._failed, None
        if error is not None:
            raise error
