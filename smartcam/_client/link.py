"""One TCP or UDP link to a camera, used once.

The transport passes bytes to the machine of ``protocols/``. The machine's events of each delivery
wait as a chunk in a bounded queue. The receive task takes one chunk in a turn of the event loop
(:meth:`Link.receive`). So no user code runs in the transport's callbacks, and a camera that floods
takes no more of a turn than others.
"""

from __future__ import annotations

import asyncio
import collections
import contextlib
import functools
import logging
import socket
import weakref
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from time import perf_counter, thread_time
from typing import TYPE_CHECKING, Any

from smartcam._client.doorbell import make_doorbell, wake
from smartcam._datagrams import MAX_DATAGRAM_BYTES, read_no_more_than_needed, second_socket
from smartcam.exceptions import ConnectionLostError, RemoteProtocolError
from smartcam.observers import RawFrame, TraceEntry
from smartcam.protocols import Dialect, LinkFailed, LinkMachine, Role, State, Transport
from smartcam.protocols._inside import Event, ResultBurst, send_each
from smartcam.protocols.messages import (
    Disconnect,
    Message,
    Sender,
    TriggerAnswer,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from smartcam._client.doorbell import DirectFuture
    from smartcam.protocols import Frame, Protocol

logger: logging.Logger = logging.getLogger("smartcam.connection")

MAX_CHUNKS = 2
"""Largest number of chunks that may wait for the receive task before the link stops reading from
TCP.

The link stops earlier if one chunk is more than the task handles in a turn, and continues when no
chunk is left: so a camera cannot send results faster than they are delivered.
"""

MAX_DATAGRAMS = 256
"""Largest number of datagrams that may wait for the receive task; further ones are dropped and
counted."""

MAX_DATAGRAMS_AT_ONCE = 8
"""Largest number of waiting datagrams that are read in one turn of the loop: twice a trigger's
answers."""

TURN_TIME = 0.0002
"""Seconds of processor time that the receive task aims to take in one turn of the event loop.

The processing time of one chunk decides the size of the next one.
"""

SHARED_TURN_TIME = 0.00005
"""Seconds instead of :data:`TURN_TIME` if other links share the event loop.

Each step of another link waits for one turn of every flooded link.
"""

MAX_PASSES = 4
"""Largest number of turns of the loop before the next chunk, if other links share the loop: as
long as other tasks take longer than one turn."""


class LinksOfLoop:
    """The links that share an event loop.

    Attributes:
        open: number of links that are open.
    """

    __slots__ = ("open",)

    def __init__(self) -> None:
        self.open: int = 0

    @staticmethod
    def of(loop: asyncio.AbstractEventLoop) -> LinksOfLoop:
        """Return the links of a loop: always the same object."""
        known = _links_of_loops.get(loop)
        if known is None:
            known = _links_of_loops[loop] = LinksOfLoop()
        return known


_links_of_loops: weakref.WeakKeyDictionary[asyncio.AbstractEventLoop, LinksOfLoop] = (
    weakref.WeakKeyDictionary()
)


MIN_FRAMES_PER_CHUNK = 5
"""Least number of frames of a cut chunk."""

FIRST_CHUNK = 64
"""Number of frames of a chunk until the time that they take is known."""

LARGEST_CHUNK = 512
"""Largest number of frames of a chunk, also after fast ones: the next frames may take longer."""

MAX_REST_BYTES = 256
"""Largest number of bytes of an unfinished frame that a trace shows: it may be as long as the
largest frame."""


@dataclass(slots=True)
class Chunk:
    """The events of one delivery of bytes, or a part of them.

    Attributes:
        received_at: loop time of the delivery.
        events: events of the delivery, in order.
        frames: number of frames of the events; an event may consist of several (In-Sight).
        delivery: number of the delivery on its link, from 1.
    """

    received_at: float
    events: list[Event]
    frames: int = 1
    delivery: int = 1


class Link(asyncio.BufferedProtocol, asyncio.DatagramProtocol):
    """A link, made by :func:`open_link` and used once.

    Args:
        machine: the protocol's client side.
        name: the camera's name, for logs and errors.
        host: address of the camera.
        port: port of the camera.
        liveness_timeout: seconds after which the operating system, too, ends the connection of a
            peer that acknowledges nothing (TCP keep-alive and user timeout, if supported); None
            for the system's default.

    Attributes:
        loop: the event loop that the link is used in.
        outcome: function that makes a future for one task to wait for, which the receive task or
            another one sets.
        wake_in_order: function that makes callers of the present delivery go on after subscribers.
        trace: trace of the link's frames; None if nobody wants them.
        heard_at: loop time of the last byte received.
    """

    # an object with more than thirty attributes and no slots is slower at each of them
    __slots__ = (
        *("_aside", "_beside", "_busy_since", "_busy_with", "_chunks", "_closed", "_closers"),
        *("_closing", "_datagrams", "_doorbell", "_frames", "_full", "_liveness_timeout"),
        *("_loss", "_most", "_paused", "_replies", "_room", "_send_all", "_transport"),
        *("_writable", "deliveries", "heard_at", "host", "loop", "machine", "name"),
        *("outcome", "port", "trace", "wake_in_order"),
    )

    def __init__(
        self,
        machine: LinkMachine,
        *,
        name: str,
        host: str,
        port: int,
        liveness_timeout: float | None = None,
    ) -> None:
        self.machine = machine
        self.name = name
        self.host = host
        self.port = port
        self._liveness_timeout = liveness_timeout
        self.loop: asyncio.AbstractEventLoop = asyncio.get_running_loop()
        self._beside = LinksOfLoop.of(self.loop)  # this link, and others on its loop
        self.heard_at: float = self.loop.time()
        self._transport: Any = None
        self._datagrams = machine.transport is Transport.UDP
        self._aside: socket.socket | None = None  # socket for reading waiting datagrams directly
        self._replies = machine.replies
        self._room = machine.room
        # if the machine can send several at once
        each: Callable[[Sequence[Message]], None] = functools.partial(send_each, machine)
        self._send_all = getattr(machine, "send_all", each)
        self.trace: FrameTrace | None = None
        self._chunks: collections.deque[Chunk] = collections.deque()
        self.deliveries = 0  # number of deliveries with events so far
        self._frames = 0  # number of frames received until the last chunk
        self._most = FIRST_CHUNK  # frames of the next chunk
        # time since which the link works on the last chunk, if that was a large one
        self._busy_since: float | None = None
        self._busy_with = 0
        self._doorbell = bell = make_doorbell(self.loop)  # doorbell of the receive task
        self.outcome: Callable[[], DirectFuture[Any] | asyncio.Future[Any]] = bell.outcome
        self.wake_in_order: Callable[[], None] = bell.wake_in_order
        self._closed = False
        self._closers: list[asyncio.Future[None]] = []  # futures of the waits for the link's end
        self._loss: BaseException | None = None
        self._full = False  # whether the transport's send buffer is full
        self._writable: asyncio.Event | None = None  # made when the send buffer is full
        self._closing = False
        self._paused = False

    # ------------------------------------------------------------------ for the client

    def send(self, message: Message, *, answered: bool | None = None) -> None:
        """Write a message.

        Args:
            message: the message.
            answered: whether the message is answered, if the protocol does not know.

        Raises:
            LocalProtocolError: the protocol's state forbids it.
            ConnectionLostError: the link is gone.
        """
        if self._loss is not None:
            raise self.lost_error()
        self.machine.send(message, answered=answered)
        self._flush()

    def send_all(self, messages: Sequence[Message]) -> None:
        """Write several messages: one write on TCP, a datagram each on UDP.

        Raises:
            LocalProtocolError: the state forbids a message; those before it were written.
            ConnectionLostError: the link is gone.
        """
        if self._loss is not None:
            raise self.lost_error()
        try:
            self._send_all(messages)
        finally:
            self._flush()

    def is_writable(self) -> bool:
        """Return True if the send buffer has room, so that :meth:`drain` would not wait."""
        return not self._full

    async def drain(self) -> None:
        """Wait until the send buffer has room; bounded by the caller's deadline."""
        if self._writable is not None:
            await self._writable.wait()

    async def receive(self) -> Chunk:
        """Return the next chunk, one in a turn of the event loop; waits as long as the link lives.

        Raises:
            ConnectionLostError: the link is gone and every chunk was taken.

        Cancellation: safe, nothing is lost.
        """
        if self._busy_since is not None:
            self._adapt(self._busy_since)
        if self._chunks:
            await self._give_way()
        while not self._chunks:
            if self._loss is not None:
                raise self.lost_error()
            await self._doorbell
        chunk = self._chunks.popleft()
        if chunk.frames > self._most:
            chunk, remainder = split(chunk, self._most)
            if remainder.events:
                self._chunks.appendleft(remainder)
        if chunk.frames >= MIN_FRAMES_PER_CHUNK and (
            self._chunks or chunk.frames > MIN_FRAMES_PER_CHUNK
        ):
            # more than the answers of a trigger
            self._busy_since, self._busy_with = thread_time(), chunk.frames
        if self._paused and not self._chunks:
            self._resume()
        return chunk

    async def close(self, timeout: float) -> None:
        """Send Disconnect and end the link in order; abort it after ``timeout`` seconds.

        On TCP the client closes its sending side first and waits for the camera's end: closing a
        socket with unread bytes sends a reset, which can overtake the Disconnect.
        Cancellation: aborts the link.
        """
        self._closing = True
        try:
            if self._transport is None or self._closed:
                return
            self._send_goodbye()
            if self._datagrams:
                self._transport.close()
            elif not self._transport.is_closing():
                self._resume()
                with contextlib.suppress(OSError):  # the connection was reset just now
                    self._transport.write_eof()
            await self.wait_closed(timeout)
        finally:
            self.abort()

    def abort(self, reason: BaseException | None = None) -> None:
        """Drop the link at once; ``reason``: error for the receive task and writers."""
        self._lose(reason or ConnectionAbortedError("closed by this side"))
        if self._transport is not None:
            self._transport.abort()

    def give_up(self, reason: BaseException) -> None:
        """Drop the link at once, but send Disconnect first if there is a session."""
        if self._transport is not None and not self._transport.is_closing():
            self._send_goodbye()
        self.abort(reason)

    def lost_error(self) -> ConnectionLostError:
        """Return the error for the receive task and writers when the link is gone."""
        where = "" if self.name == self.peer else f" to {self.peer}"
        error = ConnectionLostError(
            f"{self.name}: the link{where} is gone: {self._loss}",
            host=self.host,
            port=self.port,
        )
        error.__cause__ = self._loss
        return error

    async def wait_closed(self, timeout: float) -> None:
        """Wait until the link has ended, ``timeout`` seconds at most."""
        if self._closed:
            return
        waiter: asyncio.Future[None] = self.loop.create_future()
        self._closers.append(waiter)
        timer = self.loop.call_later(timeout, wake, waiter)
        try:
            await waiter
        finally:
            timer.cancel()
            self._closers.remove(waiter)

    @property
    def lost(self) -> bool:
        """True once the link is lost; earlier chunks may still wait for the receive task."""
        return self._loss is not None

    @property
    def peer(self) -> str:
        """``host:port`` of the camera."""
        return f"{self.host}:{self.port}"

    # ------------------------------------------------------------------ transport callbacks

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """asyncio: the link is open."""
        self._transport = transport
        self._beside.open += 1
        if self._datagrams:
            read_no_more_than_needed(transport)
            self._aside = second_socket(transport)
        sock = transport.get_extra_info("socket")
        if sock is not None and not self._datagrams:
            # the camera sets it, too, and its manual recommends it (SC manual p. 40: published)
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if self._liveness_timeout is not None:
                for option in _keep_alive_options(self._liveness_timeout):
                    sock.setsockopt(*option)

    def get_buffer(self, sizehint: int) -> memoryview:
        """asyncio: the buffer for the next bytes of a TCP link."""
        return self._room()

    def buffer_updated(self, nbytes: int) -> None:
        """asyncio: bytes of a TCP link."""
        self.heard_at = self.loop.time()
        if self.machine.filled(nbytes, self.heard_at):
            self._hand_on()
        if self._replies and self._loss is None:
            self._flush()

    def datagram_received(self, data: bytes, addr: Any) -> None:
        """asyncio: a datagram of a UDP link."""
        self.heard_at = self.loop.time()
        chunks = self._chunks  # only the first chunk may consist of several datagrams
        if chunks and len(chunks) - 1 + chunks[0].frames >= MAX_DATAGRAMS:
            self.machine.counters.ignored_frames += 1
            return
        self.machine.receive_data(data)
        error = None if self._aside is None or chunks else self._read_aside(self._aside)
        self._hand_on()
        if error is not None:
            self.error_received(error)

    def eof_received(self) -> None:
        """asyncio: the camera will send no more."""
        if self.trace is not None:
            self.trace.note_rest()
        self.machine.receive_eof()
        self._hand_on()
        self._lose(ConnectionResetError("the camera closed the connection"))

    def error_received(self, exc: Exception) -> None:
        """asyncio: the system reports that nothing listens at the address."""
        self._lose(exc)
        self._transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """asyncio: the link is over."""
        self._lose(exc or ConnectionResetError("the camera closed the connection"))
        self._beside.open -= 1
        if self._aside is not None:
            self._aside.close()
            self._aside = None
        self._closed = True
        for waiter in self._closers:
            wake(waiter)

    def pause_writing(self) -> None:
        """asyncio: the send buffer is full."""
        self._full, self._writable = True, self._writable or asyncio.Event()

    def resume_writing(self) -> None:
        """asyncio: the send buffer has room again."""
        writable, self._full, self._writable = self._writable, False, None
        if writable is not None:
            writable.set()

    # ------------------------------------------------------------------ inside

    def _flush(self) -> None:
        frames = self.machine.data_to_send()
        if self.trace is not None:
            self.trace.tell()
        if not frames:
            return
        if self._datagrams:
            for frame in frames:
                self._transport.sendto(frame)
        else:
            self._transport.write(frames[0] if len(frames) == 1 else b"".join(frames))

    def _read_aside(self, sock: socket.socket) -> OSError | None:
        """Read the waiting datagrams, without a turn of the loop for each.

        Returns:
            The system's error about a datagram that this side has sent; None without one.
        """
        for _ in range(min(MAX_DATAGRAMS_AT_ONCE, MAX_DATAGRAMS) - 1):
            try:
                data = sock.recv(MAX_DATAGRAM_BYTES)
            except (BlockingIOError, InterruptedError):
                break
            except OSError as exc:
                return exc
            self.machine.receive_data(data)
        return None

    def _send_goodbye(self) -> None:
        state = self.machine.state
        if state is State.CONNECTED or state is State.CONNECTING:
            self.machine.send(Disconnect())
            self._flush()

    def _hand_on(self) -> None:
        """Queue the events of the last bytes for the receive task."""
        events = self.machine.events()
        if self.trace is not None:
            self.trace.tell()
        if not events or self._closing:
            return
        received = self.machine.counters.frames_received
        frames, self._frames = received - self._frames, received
        self.deliveries += 1
        self._chunks.append(Chunk(self.heard_at, events, frames, self.deliveries))
        last = events[-1]
        if isinstance(last, LinkFailed):
            self._lose(last.error)
            self._transport.abort()
        elif frames > self._most or len(self._chunks) >= MAX_CHUNKS:
            self._pause()
        self._doorbell.deliver()

    async def _give_way(self) -> None:
        """Wait for a turn of the loop, or for several if other busy links share it."""
        for _ in range(MAX_PASSES if self._beside.open > 1 else 1):
            left = perf_counter()
            await asyncio.sleep(0)
            if perf_counter() - left < SHARED_TURN_TIME:
                break

    def _adapt(self, since: float) -> None:
        """Set the size of the next chunks by the processing time of the last one."""
        self._busy_since = None
        took = thread_time() - since
        turn = SHARED_TURN_TIME if self._beside.open > 1 else TURN_TIME
        frames = int(self._busy_with * turn / max(took, 1e-9))
        frames = max(frames, self._most // 2)  # a single slow chunk may be an exception
        self._most = max(MIN_FRAMES_PER_CHUNK, min(LARGEST_CHUNK, frames))

    def _pause(self) -> None:
        if not (self._paused or self._datagrams):
            self._paused = True
            self._transport.pause_reading()

    def _resume(self) -> None:
        if self._paused:
            self._paused = False
            self._transport.resume_reading()

    def _lose(self, reason: BaseException) -> None:
        if self._loss is None:
            self._loss = reason
            if self.trace is not None:
                self.trace.note_rest()
        if self._full:
            self.resume_writing()
        self._doorbell.ring()


class FrameTrace:
    """The frames of a link that the log and the observers do not have yet.

    They get those of a delivery together, before anything else happens because of it.

    Args:
        name: name of the camera.
        show: function that is called with frames; None if only the log wants them.

    Attributes:
        machine: the link's machine.
    """

    __slots__ = ("_frames", "_name", "_over", "_show", "machine")

    def __init__(self, name: str, show: Callable[[Sequence[RawFrame]], None] | None) -> None:
        self.machine: LinkMachine
        self._name, self._show = name, show
        self._frames: list[RawFrame] = []
        self._over = False  # whether the link's last bytes were noted

    def note(self, sender: Sender, frame: Frame | RemoteProtocolError) -> None:
        """Keep a frame, or bytes that make none; the machine calls this."""
        frames, name = self._frames, self._name
        at = frames[-1].at if frames else datetime.now(UTC)
        content: Frame | TraceEntry
        if isinstance(frame, RemoteProtocolError):
            content = TraceEntry(at, name, "!", None, str(frame), None, frame.data.hex())
        else:
            content = frame
        frames.append(RawFrame(at, name, self.machine.dialect, sender, content))

    def note_rest(self) -> None:
        """Tell of an unfinished frame, once: the link is over."""
        over, self._over = self._over, True
        rest = b"" if over else self.machine.pending
        if rest:
            text = f"{len(rest)} bytes that make no whole frame"
            hexed = rest[:MAX_REST_BYTES].hex()
            content = TraceEntry(datetime.now(UTC), self._name, "!", None, text, None, hexed)
            dialect = self.machine.dialect
            self._frames.append(RawFrame(content.at, self._name, dialect, Sender.CAMERA, content))
            self.tell()

    def tell(self) -> None:
        """Pass the frames on."""
        frames, self._frames = self._frames, []
        if frames and logger.isEnabledFor(logging.DEBUG):
            for frame in frames:
                _, name, direction, _, message, _, data = frame.entry()
                logger.debug("%s %s %s %s", name, direction, message, data[:128])
        if frames and self._show is not None:
            self._show(frames)


def split(chunk: Chunk, frames: int) -> tuple[Chunk, Chunk]:
    """Split a chunk after a number of frames; a burst of results may be split, too.

    A trigger's answer and the events after it stay together, since one frame may be answer and
    result: otherwise the answer's caller would send before the result is handled.
    """
    at, events = chunk.received_at, chunk.events
    if chunk.frames == len(events):  # one frame for each event
        while frames < len(events) and type(events[frames - 1]) is TriggerAnswer:
            frames += 1
        others = Chunk(at, events[frames:], chunk.frames - frames, chunk.delivery)
        return Chunk(at, events[:frames], frames, chunk.delivery), others
    first_events: list[Event] = []
    left, events_left = frames, collections.deque(events)
    while left > 0 and events_left:
        event = events_left.popleft()
        if type(event) is ResultBurst:
            if len(event.data) > left:
                event, behind = event.cut(left)
                events_left.appendleft(behind)
            left -= len(event.data)
        else:
            left -= 1
        first_events.append(event)
    while first_events and events_left and type(first_events[-1]) is TriggerAnswer:
        first_events.append(events_left.popleft())
    taken = frames - left
    first = replace(chunk, events=first_events, frames=taken)
    return first, replace(chunk, events=list(events_left), frames=chunk.frames - taken)


async def open_link(
    protocol: Protocol,
    dialects: Sequence[Dialect],
    transport: Transport,
    host: str,
    port: int,
    *,
    name: str,
    max_length: int,
    trace: Callable[[Sequence[RawFrame]], None] | None = None,
    liveness_timeout: float | None = None,
) -> Link:
    """Open a link; bounded by the caller's deadline.

    Args:
        protocol: function that makes the machine.
        dialects: one dialect, or several that begin a session alike.
        transport: TCP or UDP.
        host: the camera's name or address.
        port: port of the camera.
        name: name of the camera in logs.
        max_length: bytes of the largest payload that is accepted.
        trace: function that is called with the frames of each delivery, and with those sent.
        liveness_timeout: see :class:`Link`.

    Raises:
        OSError: the name does not resolve, nothing listens, or the host is unreachable.
    """
    loop = asyncio.get_running_loop()
    traced = trace is not None or logger.isEnabledFor(logging.DEBUG)
    frames = FrameTrace(name, trace)
    machine = protocol.machine(
        dialects[0],
        Role.CLIENT,
        transport,
        max_length=max_length,
        trace=frames.note if traced else None,
        kin=tuple(dialects),
    )
    link = Link(machine, name=name, host=host, port=port, liveness_timeout=liveness_timeout)
    if traced:
        frames.machine, link.trace = machine, frames
    if transport is Transport.TCP:
        await loop.create_connection(lambda: link, host, port)
    else:
        await loop.create_datagram_endpoint(lambda: link, remote_addr=(host, port))
    return link


_PROBE_TIMES = [
    getattr(socket, name)
    for name in ("TCP_KEEPIDLE", "TCP_KEEPALIVE", "TCP_KEEPINTVL")  # the first two are one option
    if hasattr(socket, name)
]
_PROBES, _USER_TIMEOUT = (
    getattr(socket, f"TCP_{name}", None) for name in ("KEEPCNT", "USER_TIMEOUT")
)


@functools.lru_cache(maxsize=16)
def _keep_alive_options(timeout: float) -> tuple[tuple[int, int, int], ...]:
    """Return the options by which the system ends a link whose peer acknowledges nothing.

    ``timeout``: seconds until then.
    """
    probe = max(1, round(timeout / 3))  # whole seconds before the first probe, and between two
    options = [(int(socket.SOL_SOCKET), int(socket.SO_KEEPALIVE), 1)]
    options += [(int(socket.IPPROTO_TCP), option, probe) for option in _PROBE_TIMES]
    if _PROBES is not None:
        options.append((int(socket.IPPROTO_TCP), _PROBES, 2))
    if _USER_TIMEOUT is not None:  # milliseconds
        options.append((int(socket.IPPROTO_TCP), _USER_TIMEOUT, max(1, round(timeout * 1000))))
    return tuple(options)
