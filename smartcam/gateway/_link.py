"""Serve the connection of one robot: answer its requests one after the other."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
from collections import deque
from typing import TYPE_CHECKING, Final, cast

from smartcam.gateway._lines import AnswerCode, RequestReader, RobotAnswer, TooLongError, WriteError
from smartcam.gateway._requests import PART_WORDS, RobotRequests

if TYPE_CHECKING:
    from smartcam._accepting import Acceptor
    from smartcam.gateway._lines import AnswerWriter, RobotRequest
    from smartcam.gateway._requests import GatewayCamera

MAX_WAITING_REQUESTS: Final = 8
"""Largest number of a robot's requests that wait while an earlier one is answered. Only requests
that carry a number may wait."""

MAX_UNSENT_BYTES: Final = 1 << 16
"""Largest number of bytes that wait to be sent to a robot; with more, the robot counts as stuck."""

_KEEPALIVE_PERIOD = (("TCP_KEEPIDLE", 30), ("TCP_KEEPINTVL", 10), ("TCP_KEEPCNT", 3))
"""TCP's keep-alive options: seconds of silence until the first check, seconds between checks, and
number of unanswered checks that end the connection."""

_log = logging.getLogger("smartcam.gateway")


class RobotLink(asyncio.Protocol):
    """The connection of one robot.

    Args:
        shared: the camera and other objects that all robots share.
        writer: object that formats the answers.
        acceptor: object that bounds the number of connections.

    Attributes:
        keeps_place: True once the robot has requested a part. Until then the connection may be
            closed to make room for a new one.
    """

    _transport: asyncio.Transport

    def __init__(
        self, shared: GatewayCamera, writer: AnswerWriter, acceptor: Acceptor[RobotLink]
    ) -> None:
        self.keeps_place: bool = False
        self._shared, self._writer, self._acceptor = shared, writer, acceptor
        self._counts = shared.counts
        self._robot_requests = RobotRequests(shared)
        self._reader = RequestReader(shared.settings.style.form)
        self._queue: deque[tuple[RobotRequest, float]] = deque()
        self._task: asyncio.Task[None] | None = None
        self._idle_timer: asyncio.TimerHandle | None = None
        self._peer = "?"
        self._closed = True

    # ------------------------------------------------------------------ from the transport

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin to serve the robot, or refuse it if there are too many connections."""
        self._transport = cast("asyncio.Transport", transport)
        address = transport.get_extra_info("peername")
        self._peer = f"{address[0]}:{address[1]}" if address else "?"
        refusal = self._acceptor.enter(self, address)
        if refusal:
            self._counts.refused += 1
            _log.warning("%s: refused: %s", self._peer, refusal)
            self._write(RobotAnswer(AnswerCode.FULL, text=refusal), None)
            self._transport.close()
            return
        self._closed = False
        self._counts.robots += 1
        _keep_alive(transport.get_extra_info("socket"))
        self._acceptor.set_time_limit(self, self._shared.settings.idle, "no request")
        self._restart_idle_timer()

    def data_received(self, data: bytes) -> None:
        """Read requests, and answer them."""
        if self._closed:
            return
        self._restart_idle_timer()
        try:
            requests = self._reader.feed(data)
        except TooLongError as exc:
            self._report_error(RobotAnswer(AnswerCode.TOO_LONG, text=str(exc)), None)
            self._close("a request is too long")
            return
        for request in requests:
            if not self._closed:
                self._accept_request(request)

    def connection_lost(self, exc: Exception | None) -> None:
        """End the unfinished requests, and forget the parts that the robot has not fetched yet."""
        self._close("the robot closed the connection" if exc is None else str(exc), abort=True)

    def close_for(self, reason: str) -> None:
        """Close the connection at once, to make room for another one."""
        self._close(reason, abort=True)

    # ------------------------------------------------------------------ requests

    def _accept_request(self, request: RobotRequest) -> None:
        self.keeps_place = self.keeps_place or request.word in PART_WORDS
        self._counts.requests += 1
        loop = asyncio.get_running_loop()
        deadline = loop.time() + self._shared.settings.timeout
        if self._task is None:
            self._counts.open += 1
            self._task = loop.create_task(self._serve(request, deadline), name="smartcam.gateway")
        elif request.tag is None:
            # without numbers, the robot would read the previous answer as the answer to this one
            self._counts.abandoned += 1
            self._close("a request without a number came before the answer to the one before")
        elif len(self._queue) >= MAX_WAITING_REQUESTS:
            self._counts.errors += 1
            words = f"{MAX_WAITING_REQUESTS} requests are waiting already"
            self._write(RobotAnswer(AnswerCode.BUSY, text=words), request.tag)
        else:
            self._counts.open += 1
            self._queue.append((request, deadline))

    async def _serve(self, request: RobotRequest, deadline: float) -> None:
        """Answer a request, and then the requests that have arrived meanwhile."""
        while True:
            answer = await self._robot_requests.answer(request, deadline)
            self._counts.open -= 1
            if self._write(answer, request.tag):
                self._counts.errors += 1
            else:
                self._counts.answered += 1
            if self._transport.get_write_buffer_size() > MAX_UNSENT_BYTES:
                self._close("the robot reads nothing", abort=True)
                return
            if not self._queue:
                break
            request, deadline = self._queue.popleft()
        self._task = None

    def _write(self, answer: RobotAnswer, tag: int | None) -> bool:
        """Write an answer, or an error if it cannot be written; return True for an error."""
        try:
            data = self._writer.write(answer, tag)
        except WriteError as exc:
            answer = self._robot_requests.replace_answer(str(exc))
            data = self._writer.write(answer, tag)
        self._transport.write(data)
        self._robot_requests.on_sent()
        if answer.code.is_error:
            _log.warning("%s: %s: %s", self._peer, answer.code.name, answer.text)
        return answer.code.is_error

    def _report_error(self, answer: RobotAnswer, tag: int | None) -> None:
        self._counts.requests += 1
        if self._task is not None:
            # without numbers, the robot would read a late error as the answer to its next request
            self._counts.abandoned += 1
            return
        self._counts.errors += 1
        self._write(answer, tag)

    # ------------------------------------------------------------------ the end

    def _restart_idle_timer(self) -> None:
        if self._idle_timer is not None:
            self._idle_timer.cancel()
        idle = self._shared.settings.idle
        reason = f"no request within {idle:g} s"
        self._idle_timer = asyncio.get_running_loop().call_later(idle, self._close, reason)

    def _close(self, reason: str, abort: bool = False) -> None:
        if self._closed:
            return
        self._closed = True
        _log.info("%s: closed: %s", self._peer, reason)
        if self._idle_timer is not None:
            self._idle_timer.cancel()
        self._acceptor.leave(self)
        abandoned = len(self._queue)
        self._queue.clear()
        task, self._task = self._task, None
        if task is not None and task is not asyncio.current_task():
            task.cancel()
            abandoned += 1
        self._counts.open -= abandoned
        self._counts.abandoned += abandoned
        self._robot_requests.forget_result()
        if abort:
            self._transport.abort()
        else:
            self._transport.close()

    async def finish(self) -> None:
        """Close the connection, and wait until the task that answers its requests has ended."""
        task = self._task
        self._close("the gateway is closed")
        if task is not None:
            await asyncio.wait({task})


def _keep_alive(sock: socket.socket | None) -> None:
    """Have TCP detect a robot that was switched off or unplugged."""
    if sock is None:
        return
    with contextlib.suppress(OSError):
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        for name, value in _KEEPALIVE_PERIOD:
            if hasattr(socket, name):
                sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
