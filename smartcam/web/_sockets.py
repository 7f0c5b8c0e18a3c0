"""A WebSocket with one message on its way: the next is sent when the page has shown the last."""

from __future__ import annotations

import asyncio
import logging
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Final

from aiohttp import WSCloseCode, WSMsgType, web

from smartcam.exceptions import LinkError
from smartcam.web._errors import RefusedError, shown
from smartcam.web._site import FINISH_TIMEOUT

if TYPE_CHECKING:
    from collections.abc import Coroutine

_log = logging.getLogger("smartcam.web")

MAX_WORD_BYTES: Final = 64
"""Largest number of bytes of a page's message, which asks for the next one."""


def check_websocket(request: web.Request, protocol: str, viewers: int, most: int) -> None:
    """Check that a request asks for a WebSocket of ``protocol``, and that there is room for it.

    Raises:
        RefusedError: 400, it asks for another; 503, there are ``most`` viewers already.
    """
    headers = request.headers
    asked = headers.get("Sec-WebSocket-Protocol", protocol)
    offered = [offer.strip() for offer in asked.split(",")]
    if headers.get("Upgrade", "").lower() != "websocket" or protocol not in offered:
        received = f"Upgrade {shown(headers.get('Upgrade'))}, protocols {shown(offered)}"
        raise RefusedError(400, received, f"a WebSocket of {protocol}")
    if viewers >= most:
        raise RefusedError(503, f"viewer {most + 1}", f"{most} at one time")


class PageSocket(ABC):
    """The WebSocket of a page.

    Args:
        request: request that asks for the WebSocket.
        protocol: subprotocol of the WebSocket.
        subject: word for the shown messages, for the log.
        heartbeat: seconds between pings, by which a vanished page is noticed; None: no pings.
        longest: largest number of bytes of a message from the page.
    """

    def __init__(
        self,
        request: web.Request,
        protocol: str,
        subject: str,
        *,
        heartbeat: float | None = None,
        longest: int = MAX_WORD_BYTES,
    ) -> None:
        self._request = request
        self._subject = subject
        self._socket = web.WebSocketResponse(
            protocols=(protocol,),
            max_msg_size=longest,
            timeout=FINISH_TIMEOUT,
            compress=False,
            heartbeat=heartbeat,
        )
        self._shown = asyncio.Event()  # the page has shown the last message
        self._ending = asyncio.Event()

    def end(self) -> None:
        """End the socket."""
        self._ending.set()

    async def serve(self) -> web.WebSocketResponse:
        """Show messages until the page goes, is too slow, or :meth:`end` is called.

        Cancellation: ends the socket.
        """
        try:
            await self._socket.prepare(self._request)
            await _first(self._listen(), self._show(), self._ending.wait())
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
    async def _show(self) -> None:
        """Send messages one by one; TimeoutError: the page does not accept or show one."""

    async def _listen(self) -> None:
        """Receive that messages were shown, until the page goes or sends another message."""
        while True:
            message = await self._socket.receive()
            if message.type is not WSMsgType.TEXT:
                return
            if message.data == "next":
                self._shown.set()
            elif not self._receive(message.data):
                return

    def _receive(self, _message: str) -> bool:
        """Handle another message; return False if it has no meaning, which ends the socket."""
        return False


async def _first(*jobs: Coroutine[object, object, object]) -> None:
    """Run jobs until one ends, and raise its error."""
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
