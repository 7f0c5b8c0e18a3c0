"""Request the camera's status, and wait for a particular one."""

from __future__ import annotations

import asyncio
import contextlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

from smartcam._arguments import duration_text
from smartcam.exceptions import LocalProtocolError, ResponseTimeoutError
from smartcam.models import Status
from smartcam.protocols import messages as m

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam._client.camera_state import CameraState
    from smartcam._client.connection import Connection
    from smartcam._client.polling import Polling
    from smartcam._client.requests import Requests
    from smartcam._client.waits import Waits

BUSY_PAUSE = 0.02
"""Seconds until a request that the camera was too busy to handle is repeated."""


def runs_not_busy(status: Status) -> bool:
    """Return True if the camera is Running and not BUSY."""
    return Status.RUNNING in status and Status.BUSY not in status


@dataclass(eq=False)
class StatusRequests:
    """Waits for statuses, and requests them if the camera does not send them by itself."""

    _connection: Connection
    _requests: Requests
    _polling: Polling
    _state: CameraState
    _waits: Waits

    def begin_session(self) -> None:
        """Request statuses from now on, if the camera does not send them by itself."""
        self._polling.begin_session()

    def end_session(self) -> None:
        """Stop requesting statuses."""
        self._polling.end_session()

    def start_polling(self) -> None:
        """Request statuses for a new subscriber, if the camera does not send them by itself."""
        self._polling.poll_soon()

    @property
    def last(self) -> Status:
        """The last status; every session begins with one."""
        return self._state.status or Status(0)

    async def until(
        self,
        predicate: Callable[[Status], bool],
        deadline: float,
        awaited: str,
        *,
        asks_again: bool = True,
    ) -> Status:
        """Wait for a status.

        Args:
            predicate: function that returns True for the status awaited.
            deadline: loop time.
            awaited: description of the status, for the error.
            asks_again: request the status again if it may have been lost (UDP).

        Raises:
            ResponseTimeoutError: the status did not arrive in time; the text names it and the last
                received one.
        """
        begin = asyncio.get_running_loop().time()
        try:
            if not asks_again:
                return await self.wait(predicate, deadline)
            return await self.wait_asking_again(predicate, deadline)
        except TimeoutError as exc:
            waited = max(0.0, deadline - begin)
            raise ResponseTimeoutError(
                f"{self._connection.name}: waited {duration_text(waited)} for {awaited}; "
                f"status: {self.last}",
                waited=waited,
            ) from exc

    async def wait(self, predicate: Callable[[Status], bool], deadline: float) -> Status:
        """Return the first status, the present one included, that ``predicate`` accepts.

        ``predicate`` is called with every status in order; its errors are raised here.

        Raises:
            TimeoutError: at ``deadline`` (loop time).
            LinkError: the session ended.
        """
        self._waits.raise_end()
        status = self._state.status
        if status is not None and predicate(status):
            return status
        self._polling.poll_soon()
        return await self._waits.wait_status(predicate, deadline)

    async def wait_asking_again(
        self, predicate: Callable[[Status], bool], deadline: float
    ) -> Status:
        """Wait for a status; over UDP, where it may be lost, request it at half of the time.

        Raises:
            TimeoutError: at ``deadline``.
        """
        features = self._connection.features
        if not features.keeps_order and not features.polled:
            now = asyncio.get_running_loop().time()
            with contextlib.suppress(TimeoutError):
                return await self.wait(predicate, now + 0.5 * (deadline - now))
            await self.make_camera_send(deadline)
        return await self.wait(predicate, deadline)

    async def make_camera_send(self, deadline: float) -> None:
        """Make the camera send its status, by Get status or else by Connect.

        The camera sends a status after Connect (SC manual p. 29, published). A Query goes first,
        so that a client whose session was taken does not take it back by the Connect.
        """
        link = self._connection.require_link()
        if self._connection.features.polled:
            self._requests.ask_status()
            return
        try:
            await self._requests.round_trip(deadline)
            link.send(m.Connect())
        except ResponseTimeoutError:
            pass  # the caller may have time left; keepalive detects a lost camera
        except LocalProtocolError as exc:  # the answer to the last Connect never arrived
            link.give_up(TimeoutError(f"statuses are lost: {exc}"))

    async def refresh(self, deadline: float) -> None:
        """Get the present status, if it can be requested.

        An answer to a request from before this call does not count: it may be older than the call.

        Raises:
            ResponseTimeoutError: the camera did not send it.
        """
        connection, state = self._connection, self._state
        if not connection.dialect.has(m.GetStatus):
            return
        # answers to requests from before this call end at this count
        older_count, count = state.statuses_due, state.statuses_received
        while True:
            self._requests.ask_status()
            await self._requests.round_trip(deadline)
            if state.statuses_received > older_count:
                return
            if state.statuses_received == count:  # a datagram may be lost
                await self.pause(deadline, "the camera to tell its status")
            older_count = count = state.statuses_received  # earlier answers have come or are lost

    async def pause(self, deadline: float, awaited: str) -> None:
        """Wait a moment before the camera is asked again.

        Raises:
            ResponseTimeoutError: there is no time left.
        """
        now = asyncio.get_running_loop().time()
        if deadline - now <= BUSY_PAUSE:
            raise ResponseTimeoutError(
                f"{self._connection.name}: the time is over; waited for {awaited}; "
                f"status: {self.last}"
            )
        with contextlib.suppress(TimeoutError):  # a loss ends the pause at once
            await self.wait(_accept_none, now + BUSY_PAUSE)


def _accept_none(_: Status) -> bool:
    return False
