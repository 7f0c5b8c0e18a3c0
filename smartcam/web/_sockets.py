"""Serve WebSockets that send a message only after the page has shown the previous one."""

from __future__ import annotations

import asyncio
import logging
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Final

from aiohttp import WSCloseCode, WSMsgType, web

from smartcam.exceptions import LinkError
from smartcam.web._errors import RefusedError, short_repr
from smartcam.web._site import FINISH_TIMEOUT

if TYPE_CHECKING:
    from collections.abc import Coroutine

_log = logging.getLogger("smartcam.web")

MAX_NEXT_BYTES: Final = 64
"""Largest number of bytes of the message by which a page requests the next message."""


def check_websocket(
    request: web.Request, protocol: str, viewer_count: int, max_viewers: int
) -> None:
    """Check that a request is for a WebSocket of ``protocol``, and one more viewer is allowed.

    Raises:
        RefusedError: 400, it asks for something else; 503, there are ``max_viewers`` already.
    """
    headers = request.headers
    header = headers.get("Sec-WebSocket-Protocol", protocol)
    offered = [offer.strip() for offer in header.split(",")]
    if headers.get("Upgrade", "").lower() != "websocket" or protocol not in offered:
        received = f"Upgrade {short_repr(headers.get('Upgrade'))}, protocols {short_repr(offered)}"
        raise RefusedError(400, received, f"a WebSocket of {protocol}")
    if viewer_count >= max_viewers:
        raise RefusedError(503, f"viewer {max_viewers + 1}", f"{max_viewers} at one time")


class PageSocket(ABC):
    """The WebSocket of a page.

    Args:
        request: request that asks for the WebSocket.
        protocol: subprotocol of the WebSocket.
        subject: word for what the messages show, for the log.
        heartbeat: seconds between pings, which detect a page that is gone; None: no pings.
        max_message_bytes: largest number of bytes of a message from the page.
    """

    def __init__(
        self,
        request: web.Request,
        protocol: str,
        subject: str,
        *,
        heartbeat: float | None = None,
        max_message_bytes: int = MAX_NEXT_BYTES,
    ) -> None:
        self._request = request
        self._subject = subject
        self._socket = web.WebSocketResponse(
            protocols=(protocol,),
            max_msg_size=max_message_bytes,
            timeout=FINISH_TIMEOUT,
            compress=False,
            heartbeat=heartbeat,
        )
        self._was_shown = asyncio.Event()  # set when the page has shown the last message
        self._end_requested = asyncio.Event()

    def end(self) -> None:
        """Make :meth:`serve` end."""
        self._end_requested.set()

    async def serve(self) -> web.WebSocketResponse:
        """Send messages until the page is closed, is too slow, or :meth:`end` is called.

        Cancellation: ends the socket.
        """
        try:
            await self._socket.prepare(self._request)
            await _run_until_first_end(
                self._listen(), self._send_messages(), self._end_requested.wait()
            )
            async with asyncio.timeout(2 * FINISH_TIMEOUT):
                await self._socket.close(code=WSCloseCode.GOING_AWAY)
        except TimeoutError:
            _log.info(
                "= %s: a page that takes no %s was disconnected",
                self._request.remote,
                self._subject,
            )
            if self._request.transport is not None:
                self._request.transport.abort()
        except LinkError:  # a ConnectionError, but of a camera
            raise
        except ConnectionError:
            pass  # the page is gone
        return self._socket

    @abstractmethod
    async def _send_messages(self) -> None:
        """Send messages one by one; TimeoutError: the page does not accept or show a message."""

    async def _listen(self) -> None:
        """Receive messages of the page, until it is closed or sends an unknown message."""
        while True:
            message = await self._socket.receive()
            if message.type is not WSMsgType.TEXT:
                return
            if message.data == "next":
                self._was_shown.set()
            elif not self._handle_message(message.data):
                return

    def _handle_message(self, _message: str) -> bool:
        """Handle a message other than ``next``; return False if it is unknown: the socket ends."""
        return False


async def _run_until_first_end(*jobs: Coroutine[object, object, object]) -> None:
    """Run jobs until one of them ends; cancel the others, and raise its error."""
    tasks = [asyncio.create_task(job) for job in jobs]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)
    for task in done:
        if not task.cancelled():
            task.result()
