"""Keep a WebSocket to a rosbridge, and open it again whenever it is lost."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import logging
import socket
from typing import TYPE_CHECKING, Any, Protocol
from urllib.parse import urlsplit

from smartcam._extras import load
from smartcam._user_code import ENDS_PROGRAM
from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    import aiohttp

    from smartcam.backoff import Backoff
    from smartcam.ros1._json_messages import TextPart
    from smartcam.ros1._outbox import Outbox

logger: logging.Logger = logging.getLogger("smartcam.ros1")

CONNECT_TIMEOUT = 10.0
"""Seconds for a bridge to answer the handshake."""
STALLED_TIMEOUT = 10.0
"""Seconds that a bridge may take to read one message."""
GOODBYE_TIMEOUT = 1.0
"""Seconds for a bridge to answer a closing handshake."""
SEND_BUFFER = 1 << 17
"""Size of the system's send buffer in bytes: small, since data that wait there become old."""
HEARTBEAT_INTERVAL = 10.0
"""Seconds of silence after which the bridge gets a ping; it has half of that time to answer."""
MIN_LINK_SECONDS = 5.0
"""Shortest life of a link in seconds after which the next attempt follows at once."""
MAX_MESSAGE_BYTES = 8 << 20
"""Largest number of bytes of a message from a bridge; a longer one ends the link."""


class LinkListener(Protocol):
    """The receiver of a link's events."""

    def on_connected(self) -> None:
        """Handle a new connection; advertise the topics."""

    def on_operation(self, operation: dict[str, Any]) -> None:
        """Handle an operation; never wait."""

    async def on_lost(self, was_connected: bool) -> None:
        """Handle a lost connection, or a failed attempt if ``was_connected`` is False."""


def checked_url(url: str) -> str:
    """Return a bridge's URL.

    Raises:
        ConfigurationError: the URL is not valid.
    """
    example = "ws://192.168.0.5:9090"
    try:
        parts = urlsplit(url)
        is_usable = parts.scheme in {"ws", "wss"} and parts.hostname and parts.port != 0
    except ValueError:
        is_usable = False
    if not is_usable:
        raise ConfigurationError(f"no rosbridge: expected a URL such as {example}, got {url!r:.80}")
    return url


def _aiohttp() -> Any:
    return load("aiohttp", "a rosbridge needs")


def link_errors() -> tuple[type[Exception], ...]:
    """Return the types of errors of a link that cannot be opened, or is lost."""
    return OSError, TimeoutError, _aiohttp().ClientError


async def _refuse_redirect(_session: object, _context: object, sent: Any) -> None:
    """Refuse a redirect, which aiohttp would follow to any host: a bridge is only at its URL."""
    location = sent.response.headers.get("Location", "")
    raise ConnectionError(f"expected a WebSocket, got a redirect to {location!r:.200}")


@contextlib.asynccontextmanager
async def web_socket(url: str) -> AsyncIterator[aiohttp.ClientWebSocketResponse]:
    """Open a WebSocket to a bridge; when it is closed, data that the bridge has not read are lost.

    Raises:
        OSError, aiohttp.ClientError, TimeoutError: the bridge cannot be reached.
    """
    aiohttp = _aiohttp()
    timeout = aiohttp.ClientWSTimeout(ws_receive=None, ws_close=GOODBYE_TIMEOUT)
    trace_config = aiohttp.TraceConfig()
    trace_config.on_request_redirect.append(_refuse_redirect)
    async with aiohttp.ClientSession(trace_configs=[trace_config]) as session:
        try:
            async with asyncio.timeout(CONNECT_TIMEOUT):
                web = await session.ws_connect(
                    url,
                    timeout=timeout,
                    heartbeat=HEARTBEAT_INTERVAL,
                    max_msg_size=MAX_MESSAGE_BYTES,
                )
        except TimeoutError:
            raise TimeoutError(f"no answer within {CONNECT_TIMEOUT:g} s") from None
        peer = web.get_extra_info("socket")
        if peer is not None:
            peer.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        try:
            yield web
        finally:
            try:
                async with asyncio.timeout(GOODBYE_TIMEOUT):
                    await web.close()
            except link_errors():
                pass  # the bridge does not read, or has ended
            finally:
                if peer is not None:
                    with contextlib.suppress(OSError):
                        # otherwise waiting data would be kept for the bridge
                        peer.shutdown(socket.SHUT_RDWR)


async def operation_text(parts: tuple[TextPart, ...]) -> str:
    """Return the text of an operation; for a long one, let the loop run in between."""
    pieces: list[str] = []
    for part in parts:
        if isinstance(part, str):
            pieces.append(part)
            continue
        for number, chunk in enumerate(part.chunks()):
            if number:
                await asyncio.sleep(0)
            pieces.append(base64.b64encode(chunk).decode("ascii"))
    return "".join(pieces)


class BridgeLink:
    """A link to a bridge that :meth:`run` opens, and opens again when it is lost.

    Attributes:
        url: URL of the bridge.
        outbox: operations and messages to send.
        connected: whether the bridge is connected now.
        failure: reason why the bridge is not connected; "" before the first attempt.
        changed: condition that is notified of each change of ``connected`` and ``failure``.
    """

    def __init__(self, url: str, outbox: Outbox, listener: LinkListener, backoff: Backoff) -> None:
        self.url = checked_url(url)
        self.failure = ""
        self.changed = asyncio.Condition()
        self.connected = False
        self.outbox = outbox
        self._listener, self._backoff = listener, backoff

    async def run(self) -> None:
        """Keep the link open until this task is cancelled, or the last attempt has failed."""
        clock, short_lived = asyncio.get_running_loop().time, 0
        while True:
            for delay in self._backoff.delays(short_lived=short_lived):
                started_at = clock()
                reason = await self._use_one_link()
                if await self._report_lost(reason):
                    short_lived = 0 if clock() - started_at > MIN_LINK_SECONDS else short_lived + 1
                    await asyncio.sleep(delay)
                    break
                await asyncio.sleep(delay)
            else:
                return

    async def _use_one_link(self) -> str:
        """Open one link and use it until it is lost; return the reason."""
        try:
            async with web_socket(self.url) as web:
                logger.info("%s: connected", self.url)
                await self._set_state(connected=True)
                self._listener.on_connected()
                await self._read_and_write(web)
        except link_errors() as exc:
            return str(getattr(exc, "os_error", exc)) or type(exc).__name__
        except Exception as exc:  # a fault of smartcam: the next link may work
            logger.exception("%s ! the link failed unexpectedly", self.url)
            return f"{type(exc).__name__}: {exc}"
        return "it closed the link"

    async def _read_and_write(self, web: aiohttp.ClientWebSocketResponse) -> None:
        """Read and write until one of both ends."""
        tasks = [asyncio.create_task(self._read(web)), asyncio.create_task(self._write(web))]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.wait(tasks)
        for task in done:
            task.result()

    async def _set_state(self, *, connected: bool, failure: str = "") -> None:
        async with self.changed:
            self.connected, self.failure = connected, failure
            self.changed.notify_all()

    async def _report_lost(self, reason: str) -> bool:
        """Log that the link is lost; return True if there was one."""
        previous_failure = self.failure
        was_connected = await self.end_link(f"{self.url}: {reason}")
        level = logging.DEBUG if previous_failure == self.failure else logging.WARNING
        logger.log(level, "%s: no rosbridge: %s", self.url, reason)
        return was_connected

    async def end_link(self, failure: str = "") -> bool:
        """End the link and drop its unsent data; return True if there was a link."""
        was_connected = self.connected
        await self._set_state(connected=False, failure=failure)
        self.outbox.clear()
        await self._listener.on_lost(was_connected)
        return was_connected

    async def _write(self, web: aiohttp.ClientWebSocketResponse) -> None:
        while True:
            text = await operation_text(await self.outbox.take())
            try:
                async with asyncio.timeout(STALLED_TIMEOUT):
                    await web.send_str(text)
            except TimeoutError:
                raise TimeoutError(
                    f"it did not read a message within {STALLED_TIMEOUT:g} s"
                ) from None

    async def _read(self, web: aiohttp.ClientWebSocketResponse) -> None:
        message_types = _aiohttp().WSMsgType
        while True:
            message = await web.receive()
            if message.type is message_types.TEXT:
                self._handle_text(message.data)
                await asyncio.sleep(0)  # let the loop run, if many operations came at once
                await self.outbox.wait_for_room()
            elif message.type is message_types.ERROR:
                raise ConnectionError(str(web.exception() or message.data))
            elif message.type in {message_types.CLOSE, message_types.CLOSING, message_types.CLOSED}:
                return
            else:
                logger.warning("%s: expected text, got binary: is it in BSON mode?", self.url)

    def _handle_text(self, text: str) -> None:
        try:
            operation = json.loads(text)
        except (ValueError, RecursionError):
            operation = None
        if isinstance(operation, dict) and isinstance(operation.get("op"), str):
            try:
                self._listener.on_operation(operation)
            except ENDS_PROGRAM:
                raise
            except BaseException:
                logger.exception("%s ! operation failed: %.200r", self.url, operation)
        else:
            logger.warning("%s: expected an operation of rosbridge, got %.80r", self.url, text)
