"""The site of pictures: the newest frame of up to a few sources, to whoever looks.

Each who looks at a source has a reader of it and a WebSocket, with one picture on the way at a
time: the next one, the newest then, goes when the page says that it has shown the last. So who is
slow skips, and delays neither the device nor anybody else. With nobody there is no reader, and
the device does not stream.
"""

from __future__ import annotations

import asyncio
import json
import logging
import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, Final

from aiohttp import WSCloseCode, WSMsgType, web

from smartcam.backoff import Backoff
from smartcam.exceptions import (
    ConfigurationError,
    FrameFormatError,
    FrameSourceError,
    FrameTimeoutError,
    LocalProtocolError,
)
from smartcam.web._errors import RefusedError, shown
from smartcam.web._jpeg import jpeg, require_encoder
from smartcam.web._routes import CallRequest, Calls
from smartcam.web._site import API, FAREWELL, Site
from smartcam.web._streams import SLOW

if TYPE_CHECKING:
    from collections.abc import Coroutine, Sequence

    from smartcam.frames import Frame, FrameReader, FrameSource

_log = logging.getLogger("smartcam.web")

MAX_VIEWERS: Final = 32
"""WebSockets at a time: eight people before four cameras."""

PROTOCOL: Final = "smartcam.frames"
"""Of the WebSockets."""

ACCOUNT_PERIOD: Final = 1.0
"""Seconds without a frame after which the page is told the account all the same."""

LONGEST_WORD: Final = 64
"""Bytes of what a page may say: that it wants the next one."""

THREADS: Final = 2
"""That make JPEGs; with more they wait for the processor instead."""

AGAIN: Final = Backoff(initial=0.5, maximum=5.0)
"""When a source that ended with an error is read again."""


class FramesSite(Site):
    """A page and HTTP calls that show the newest frames of some sources.

    ::

        async with (
            smartcam.frames.open("synthetic://") as source,
            FramesSite([source]) as site,
        ):
            site.url    # http://127.0.0.1:PORT/

    Args:
        sources: they are opened and closed by who made them; one that is not open is awaited.
        quality: of the JPEGs that are made, 1 to 100. What a camera sends as JPEG stays as it is.
        host: address to listen on; nothing but this.
        port: port to listen on, 0 for a free one.
        token: what every call must carry in ``Authorization: Bearer``, as
            :class:`~smartcam.web.LiveSite` has it. A browser's WebSocket, which can carry none,
            names it among its protocols: ``bearer.TOKEN``.

    Attributes:
        sources: as given.
        failures: why a source is not open, by its place in ``sources``; for whoever opens them to
            say.

    Raises:
        ConfigurationError: the token cannot be used, or the quality is none.
        MissingExtraError: the extra ``frames`` is not installed.
    """

    def __init__(
        self,
        sources: Sequence[FrameSource],
        *,
        quality: int = 80,
        host: str = "127.0.0.1",
        port: int = 0,
        token: str | None = None,
    ) -> None:
        super().__init__(CALLS, "frames", host=host, port=port, token=token)
        if not 1 <= quality <= 100:
            raise ConfigurationError(f"quality: expected 1 to 100, got {quality!r}")
        require_encoder()
        self.sources: tuple[FrameSource, ...] = tuple(sources)
        self.failures: dict[int, str] = {}
        self.viewers: set[Viewer] = set()
        self._quality = quality
        self._presses: list[Press] = []
        self._threads: ThreadPoolExecutor | None = None

    async def start(self) -> None:
        """Open the port."""
        if self._threads is None:
            self._threads = ThreadPoolExecutor(THREADS, thread_name_prefix="smartcam.web.jpeg")
            self._presses = [Press(self._threads, self._quality) for _ in self.sources]
        await super().start()

    async def stop(self) -> None:
        """Close the port; nobody looks any longer."""
        for one in self.viewers:
            one.end()
        try:
            await super().stop()
        finally:
            threads, self._threads = self._threads, None
            if threads is not None:
                await asyncio.to_thread(threads.shutdown)

    def press(self, place: int) -> Press:
        """Return what makes JPEGs of a source."""
        return self._presses[place]

    def state(self, place: int) -> dict[str, Any]:
        """Return how a source is."""
        source = self.sources[place]
        try:
            streams: str | None = str(source.format)
        except LocalProtocolError:
            streams = None
        account = source.statistics()
        return {
            "place": place,
            "name": source.name,
            "format": streams,
            "failure": self._failure(place) if streams is None else "",
            "streaming": account.streaming,
            "readers": account.readers,
            "started": account.started,
            "frames": account.frames,
            "lost": account.lost,
        }

    def _failure(self, place: int) -> str:
        return self.failures.get(place, f"{self.sources[place].name} is not open")


class Press:
    """Makes JPEGs of a source in threads, each frame once however many look at it."""

    def __init__(self, threads: ThreadPoolExecutor, quality: int) -> None:
        self._threads = threads
        self._quality = quality
        self._frame: Frame | None = None
        self._made: asyncio.Future[bytes] | None = None

    async def jpeg(self, frame: Frame) -> bytes:
        """Return a frame as a JPEG.

        Raises:
            FrameFormatError: its bytes are wrong.
            MissingExtraError: a codec is not installed.

        Cancellation: safe; others who wait for it get it.
        """
        if self._made is None or self._frame is not frame:
            loop = asyncio.get_running_loop()
            self._frame = frame
            self._made = loop.run_in_executor(self._threads, jpeg, frame, self._quality)
            self._made.add_done_callback(_seen)
        return await asyncio.shield(self._made)

    def forget(self) -> None:
        """Keep no picture."""
        self._frame = self._made = None


def _seen(made: asyncio.Future[bytes]) -> None:
    if not made.cancelled():
        made.exception()  # who asked may be gone, and then nobody else asks


class Viewer:
    """One who looks at a source; ``place`` is that of the source."""

    def __init__(self, site: FramesSite, place: int) -> None:
        self._site = site
        self._source = site.sources[place]
        self.place = place
        self._socket = web.WebSocketResponse(
            protocols=(PROTOCOL,), max_msg_size=LONGEST_WORD, timeout=FAREWELL, compress=False
        )
        self._shown = asyncio.Event()  # the page has shown the last picture
        self._ending = asyncio.Event()
        self._sent = 0

    def end(self) -> None:
        """Have it end."""
        self._ending.set()

    async def serve(self, request: web.Request) -> web.WebSocketResponse:
        """Show frames until the page goes, is too slow, or :meth:`end` is called.

        Cancellation: ends it.
        """
        self._site.viewers.add(self)
        try:
            await self._socket.prepare(request)
            await self._first(self._listen(), self._show(), self._ending.wait())
            await self._close()
        except TimeoutError:
            _log.info("= %s: a page that takes no picture was disconnected", request.remote)
            if request.transport is not None:
                request.transport.abort()
        except ConnectionError:
            pass  # the page is gone
        finally:
            self._site.viewers.discard(self)
            if not any(one.place == self.place for one in self._site.viewers):
                self._site.press(self.place).forget()
        return self._socket

    async def _close(self) -> None:
        """Say good-bye; TimeoutError: the page does not even read it."""
        async with asyncio.timeout(2 * FAREWELL):
            await self._socket.close(code=WSCloseCode.GOING_AWAY)

    @staticmethod
    async def _first(*jobs: Coroutine[Any, Any, object]) -> None:
        """Run jobs until one is over, and raise what it raised."""
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

    async def _listen(self) -> None:
        """Hear that pictures were shown, until the page goes or says something else."""
        while True:
            message = await self._socket.receive()
            if message.type is not WSMsgType.TEXT or message.data != "next":
                return
            self._shown.set()

    async def _show(self) -> None:
        """Show frames, and read the source again where it ended.

        One that is lost stays so for the page until a picture of it comes.
        """
        delays, lost = AGAIN.delays(), False
        while True:
            before = self._sent
            try:
                async with self._source.reader(timeout=ACCOUNT_PERIOD) as reader:
                    if not lost:
                        await self._tell({"state": "waiting", **self._site.state(self.place)})
                    await self._show_frames(reader)
            except LocalProtocolError:
                await self._tell(
                    {"state": "awaited", "text": self._site.state(self.place)["failure"]}
                )
                lost = False
            except (FrameSourceError, ConfigurationError) as exc:
                await self._tell({"state": "lost", "text": str(exc)})
                lost = True
            else:
                await self._tell({"state": "ended", "text": f"{self._source.name} has ended."})
                await asyncio.Event().wait()  # a page that hears it twice would play it again
            if self._sent > before:
                delays = AGAIN.delays()
            await asyncio.sleep(next(delays))

    async def _show_frames(self, reader: FrameReader) -> None:
        """Show frames until the source ends."""
        bad = 0
        while True:
            try:
                frame = await anext(reader)
            except FrameTimeoutError:
                await self._tell({"account": _account(reader, bad)})
                continue
            except StopAsyncIteration:
                return
            try:
                picture = await self._site.press(self.place).jpeg(frame)
            except FrameFormatError as exc:
                bad += 1
                await self._tell({"account": _account(reader, bad), "bad": str(exc)})
                continue
            await self._send_picture(_about(frame), _account(reader, bad), picture)

    async def _send_picture(
        self, frame: dict[str, Any], account: dict[str, Any], picture: bytes
    ) -> None:
        """Send a picture behind its JSON, and wait until it is shown; TimeoutError: it is not."""
        said = json.dumps({"frame": frame, "account": account}).encode()
        self._shown.clear()
        async with asyncio.timeout(SLOW):
            await self._socket.send_bytes(len(said).to_bytes(4, "little") + said + picture)
            self._sent += 1
            await self._shown.wait()

    async def _tell(self, value: dict[str, Any]) -> None:
        async with asyncio.timeout(SLOW):
            await self._socket.send_str(json.dumps(value))


def _about(frame: Frame) -> dict[str, Any]:
    """Return what a page says of a frame; its age is that of now."""
    return {
        "sequence": frame.sequence,
        "width": frame.width,
        "height": frame.height,
        "format": frame.format.name,
        "age": frame.age,
        "moment": frame.moment.value,
    }


def _account(reader: FrameReader, bad: int) -> dict[str, Any]:
    """Return what became of the frames since one looks; ``at`` in seconds of a clock."""
    account = reader.statistics()
    return {
        "at": time.monotonic(),
        "offered": account.offered,
        "delivered": account.delivered,
        "skipped": account.skipped,
        "lost": account.lost,
        "bad": bad,
    }


# ---------------------------------------------------------------------- what calls do

CALLS: Calls[FramesSite] = Calls()
"""All calls."""


def _place(site: FramesSite, call: CallRequest) -> int:
    given = call.path["place"]
    if not given.isdecimal() or len(given) > 3 or int(given) >= len(site.sources):
        raise RefusedError(404, f"source {shown(given)}", f"0 to {len(site.sources) - 1}")
    return int(given)


@CALLS.add("GET", API)
def _calls(_site: FramesSite, _call: CallRequest) -> object:
    """These calls."""
    return {"calls": CALLS.as_json()}


@CALLS.add("GET", f"{API}/sources")
def _sources(site: FramesSite, _call: CallRequest) -> object:
    """The sources, how each is and what was counted."""
    return {"sources": [site.state(place) for place in range(len(site.sources))]}


@CALLS.add("GET", f"{API}/sources/{{place}}/picture")
async def _picture(site: FramesSite, call: CallRequest) -> web.Response:
    """The newest frame, as a JPEG; the device streams for it."""
    place = _place(site, call)
    try:
        frame = await site.sources[place].newest()
        data = await site.press(place).jpeg(frame)
    except LocalProtocolError as exc:
        raise RefusedError(409, site.state(place)["failure"], "a source that is there") from exc
    except FrameSourceError as exc:
        raise RefusedError(409, str(exc), "a source that gives frames") from exc
    headers = {"Frame-Sequence": str(frame.sequence), "Frame-Age": f"{frame.age:.4f}"}
    return web.Response(body=data, content_type="image/jpeg", headers=headers)


@CALLS.add(
    "GET",
    f"{API}/sources/{{place}}/pictures",
    about="A WebSocket: the newest frame after each `next` that one says, as a JPEG behind JSON.",
)
async def _pictures(site: FramesSite, call: CallRequest) -> web.StreamResponse:
    place = _place(site, call)
    headers = call.request.headers
    offered = [one.strip() for one in headers.get("Sec-WebSocket-Protocol", PROTOCOL).split(",")]
    if headers.get("Upgrade", "").lower() != "websocket" or PROTOCOL not in offered:
        what = f"Upgrade {shown(headers.get('Upgrade'))}, protocols {shown(offered)}"
        raise RefusedError(400, what, f"a WebSocket of {PROTOCOL}")
    if len(site.viewers) >= MAX_VIEWERS:
        raise RefusedError(503, f"viewer {MAX_VIEWERS + 1}", f"{MAX_VIEWERS} at one time")
    return await Viewer(site, place).serve(call.request)
