"""Exchange messages with a camera over one TCP or UDP link, which is used once.

The transport passes received bytes to the machine of ``protocols/``. Each call of the transport is
a *delivery*; its events wait as a chunk in a bounded queue. The receive task takes one chunk in a
turn of the event loop (:meth:`Link.receive`). So no user code runs in the transport's callbacks,
and a camera that sends without a pause takes no more of a turn than other cameras.
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
from smartcam._datagrams import MAX_DATAGRAM_BYTES, limit_read_size, second_socket
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

The link stops earlier if one chunk is larger than the task handles in a turn. It reads again when
no chunk is left, so a camera cannot send results faster than they are delivered.
"""

MAX_DATAGRAMS = 256
"""Largest number of datagrams that may wait for the receive task; further ones are dropped and
counted."""

MAX_DATAGRAMS_AT_ONCE = 8
"""Largest number of waiting datagrams that are read in one turn of the loop: twice the number of a
trigger's answers."""

TURN_TIME = 0.0002
"""Seconds of processor time that the receive task aims to take in one turn of the event loop.

The processing time of one chunk decides the size of the next one.
"""

SHARED_TURN_TIME = 0.00005
"""Value instead of :data:`TURN_TIME` if other links share the event loop.

Each step of another link waits for one turn of every busy link.
"""

MAX_TURNS_PER_CHUNK = 4
"""Largest number of turns of the loop between two chunks if other links share the loop. The link
waits for several turns only while other tasks need the loop."""


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
        """Return the object that counts a loop's links; there is one object for each loop."""
        known = _links_of_loops.get(loop)
        if known is None:
            known = _links_of_loops[loop] = LinksOfLoop()
        return known


_links_of_loops: weakref.WeakKeyDictionary[asyncio.AbstractEventLoop, LinksOfLoop] = (
    weakref.WeakKeyDictionary()
)


MIN_FRAMES_PER_CHUNK = 5
"""Least number of frames of a cut chunk."""

FIRST_CHUNK_FRAMES = 64
"""Largest number of frames of a chunk until their processing time is known."""

MAX_CHUNK_FRAMES = 512
"""Largest number of frames of a chunk, also after fast chunks: the next frames may be slower."""

MAX_REST_BYTES = 256
"""Largest number of bytes of an unfinished frame that a trace shows; such a frame may be long."""


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
        make_future: function that makes a future for which one task waits, and which the receive
            task or another one sets.
        wake_after_subscribers: function by which the tasks whose answers came in this delivery
            continue only after the subscribers.
        trace: trace of the link's frames; None if neither an observer nor the log wants them.
        last_byte_at: loop time of the last byte received.
    """

    # an object with more than thirty attributes and no slots is slower at each of them
    __slots__ = (
        *(
            "_direct_socket",
            "_loop_links",
            "_busy_since",
            "_busy_frames",
            "_chunks",
            "_closed",
            "_close_waiters",
        ),
        *("_closing", "_is_udp", "_doorbell", "_frames", "_buffer_full", "_liveness_timeout"),
        *(
            "_loss_reason",
            "_max_frames",
            "_paused",
            "_machine_may_reply",
            "_get_buffer",
            "_send_all",
            "_transport",
        ),
        *("_writable", "deliveries", "last_byte_at", "host", "loop", "machine", "name"),
        *("make_future", "port", "trace", "wake_after_subscribers"),
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
        self._loop_links = LinksOfLoop.of(self.loop)  # this link, and others on its loop
        self.last_byte_at: float = self.loop.time()
        self._transport: Any = None
        self._is_udp = machine.transport is Transport.UDP
        # socket for reading waiting datagrams directly
        self._direct_socket: socket.socket | None = None
        self._machine_may_reply = machine.may_reply
        self._get_buffer = machine.get_buffer
        # a method of the machine, if it can send several messages at once
        send_singly: Callable[[Sequence[Message]], None] = functools.partial(send_each, machine)
        self._send_all = getattr(machine, "send_all", send_singly)
        self.trace: FrameTrace | None = None
        self._chunks: collections.deque[Chunk] = collections.deque()
        self.deliveries = 0  # number of deliveries with events so far
        self._frames = 0  # number of frames received until the last chunk
        self._max_frames = FIRST_CHUNK_FRAMES  # largest number of frames of the next chunk
        # processor time when the task took the last chunk, if that was a large one
        self._busy_since: float | None = None
        self._busy_frames = 0
        self._doorbell = bell = make_doorbell(self.loop)  # doorbell of the receive task
        self.make_future: Callable[[], DirectFuture[Any] | asyncio.Future[Any]] = bell.make_future
        self.wake_after_subscribers: Callable[[], None] = bell.wake_after_subscribers
        self._closed = False
        self._close_waiters: list[
            asyncio.Future[None]
        ] = []  # futures of the waits for the link's end
        self._loss_reason: BaseException | None = None
        self._buffer_full = False  # whether the transport's send buffer is full
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
        if self._loss_reason is not None:
            raise self.lost_error()
        self.machine.send(message, answered=answered)
        self._flush()

    def send_all(self, messages: Sequence[Message]) -> None:
        """Write several messages: one write on TCP, a datagram each on UDP.

        Raises:
            LocalProtocolError: the state forbids a message; the messages before it were written.
            ConnectionLostError: the link is gone.
        """
        if self._loss_reason is not None:
            raise self.lost_error()
        try:
            self._send_all(messages)
        finally:
            self._flush()

    def is_writable(self) -> bool:
        """Return True if the send buffer has room, so that :meth:`drain` would not wait."""
        return not self._buffer_full

    async def drain(self) -> None:
        """Wait until the send buffer has room; bounded by the caller's deadline."""
        if self._writable is not None:
            await self._writable.wait()

    async def receive(self) -> Chunk:
        """Return the next chunk, one in a turn of the event loop; wait for one if there is none.

        Raises:
            ConnectionLostError: the link is gone and every chunk was taken.

        Cancellation: safe, nothing is lost.
        """
        if self._busy_since is not None:
            self._adapt_chunk_size(self._busy_since)
        if self._chunks:
            await self._yield_to_others()
        while not self._chunks:
            if self._loss_reason is not None:
                raise self.lost_error()
            await self._doorbell
        chunk = self._chunks.popleft()
        if chunk.frames > self._max_frames:
            chunk, remainder = split_chunk(chunk, self._max_frames)
            if remainder.events:
                self._chunks.appendleft(remainder)
        if chunk.frames >= MIN_FRAMES_PER_CHUNK and (
            self._chunks or chunk.frames > MIN_FRAMES_PER_CHUNK
        ):
            # more than the answers of a trigger
            self._busy_since, self._busy_frames = thread_time(), chunk.frames
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
            self._send_disconnect()
            if self._is_udp:
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
        self._note_loss(reason or ConnectionAbortedError("closed by this side"))
        if self._transport is not None:
            self._transport.abort()

    def give_up(self, reason: BaseException) -> None:
        """Drop the link at once, but send Disconnect first if there is a session."""
        if self._transport is not None and not self._transport.is_closing():
            self._send_disconnect()
        self.abort(reason)

    def lost_error(self) -> ConnectionLostError:
        """Return the error for the receive task and writers when the link is gone."""
        where = "" if self.name == self.peer else f" to {self.peer}"
        error = ConnectionLostError(
            f"{self.name}: the link{where} is gone: {self._loss_reason}",
            host=self.host,
            port=self.port,
        )
        error.__cause__ = self._loss_reason
        return error

    async def wait_closed(self, timeout: float) -> None:
        """Wait until the link has ended, ``timeout`` seconds at most."""
        if self._closed:
            return
        waiter: asyncio.Future[None] = self.loop.create_future()
        self._close_waiters.append(waiter)
        timer = self.loop.call_later(timeout, wake, waiter)
        try:
            await waiter
        finally:
            timer.cancel()
            self._close_waiters.remove(waiter)

    @property
    def lost(self) -> bool:
        """True once the link is lost; earlier chunks may still wait for the receive task."""
        return self._loss_reason is not None

    @property
    def peer(self) -> str:
        """``host:port`` of the camera."""
        return f"{self.host}:{self.port}"

    # ------------------------------------------------------------------ transport callbacks

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """asyncio: the link is open."""
        self._transport = transport
        self._loop_links.open += 1
        if self._is_udp:
            limit_read_size(transport)
            self._direct_socket = second_socket(transport)
        sock = transport.get_extra_info("socket")
        if sock is not None and not self._is_udp:
            # the camera sets it, too, and its manual recommends it (SC manual p. 40)
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if self._liveness_timeout is not None:
                for option in _keep_alive_options(self._liveness_timeout):
                    sock.setsockopt(*option)

    def get_buffer(self, sizehint: int) -> memoryview:
        """asyncio: the buffer for the next bytes of a TCP link."""
        return self._get_buffer()

    def buffer_updated(self, nbytes: int) -> None:
        """asyncio: bytes of a TCP link."""
        self.last_byte_at = self.loop.time()
        if self.machine.buffer_updated(nbytes, self.last_byte_at):
            self._queue_events()
        if self._machine_may_reply and self._loss_reason is None:
            self._flush()

    def datagram_received(self, data: bytes, addr: Any) -> None:
        """asyncio: a datagram of a UDP link."""
        self.last_byte_at = self.loop.time()
        chunks = self._chunks  # only the first chunk may consist of several datagrams
        if chunks and len(chunks) - 1 + chunks[0].frames >= MAX_DATAGRAMS:
            self.machine.counters.ignored_frames += 1
            return
        self.machine.receive_data(data)
        error = (
            None
            if self._direct_socket is None or chunks
            else self._read_waiting_datagrams(self._direct_socket)
        )
        self._queue_events()
        if error is not None:
            self.error_received(error)

    def eof_received(self) -> None:
        """asyncio: the camera will send no more."""
        if self.trace is not None:
            self.trace.note_unfinished_frame()
        self.machine.receive_eof()
        self._queue_events()
        self._note_loss(ConnectionResetError("the camera closed the connection"))

    def error_received(self, exc: Exception) -> None:
        """asyncio: the system reports that nothing listens at the address."""
        self._note_loss(exc)
        self._transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """asyncio: the link has ended."""
        self._note_loss(exc or ConnectionResetError("the camera closed the connection"))
        self._loop_links.open -= 1
        if self._direct_socket is not None:
            self._direct_socket.close()
            self._direct_socket = None
        self._closed = True
        for waiter in self._close_waiters:
            wake(waiter)

    def pause_writing(self) -> None:
        """asyncio: the send buffer is full."""
        self._buffer_full, self._writable = True, self._writable or asyncio.Event()

    def resume_writing(self) -> None:
        """asyncio: the send buffer has room again."""
        writable, self._buffer_full, self._writable = self._writable, False, None
        if writable is not None:
            writable.set()

    # ------------------------------------------------------------------ inside

    def _flush(self) -> None:
        frames = self.machine.data_to_send()
        if self.trace is not None:
            self.trace.pass_on()
        if not frames:
            return
        if self._is_udp:
            for frame in frames:
                self._transport.sendto(frame)
        else:
            self._transport.write(frames[0] if len(frames) == 1 else b"".join(frames))

    def _read_waiting_datagrams(self, sock: socket.socket) -> OSError | None:
        """Read the waiting datagrams in this turn of the loop.

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

    def _send_disconnect(self) -> None:
        state = self.machine.state
        if state is State.CONNECTED or state is State.CONNECTING:
            self.machine.send(Disconnect())
            self._flush()

    def _queue_events(self) -> None:
        """Queue the events of the last bytes for the receive task."""
        events = self.machine.events()
        if self.trace is not None:
            self.trace.pass_on()
        if not events or self._closing:
            return
        received = self.machine.counters.frames_received
        frames, self._frames = received - self._frames, received
        self.deliveries += 1
        self._chunks.append(Chunk(self.last_byte_at, events, frames, self.deliveries))
        last = events[-1]
        if isinstance(last, LinkFailed):
            self._note_loss(last.error)
            self._transport.abort()
        elif frames > self._max_frames or len(self._chunks) >= MAX_CHUNKS:
            self._pause()
        self._doorbell.deliver()

    async def _yield_to_others(self) -> None:
        """Wait for a turn of the loop, or for several if other busy links share it."""
        for _ in range(MAX_TURNS_PER_CHUNK if self._loop_links.open > 1 else 1):
            slept_at = perf_counter()
            await asyncio.sleep(0)
            if perf_counter() - slept_at < SHARED_TURN_TIME:
                break

    def _adapt_chunk_size(self, since: float) -> None:
        """Set the size of the next chunks by the processing time of the last one."""
        self._busy_since = None
        took = thread_time() - since
        turn = SHARED_TURN_TIME if self._loop_links.open > 1 else TURN_TIME
        frames = int(self._busy_frames * turn / max(took, 1e-9))
        frames = max(frames, self._max_frames // 2)  # a single slow chunk may be an exception
        self._max_frames = max(MIN_FRAMES_PER_CHUNK, min(MAX_CHUNK_FRAMES, frames))

    def _pause(self) -> None:
        if not (self._paused or self._is_udp):
            self._paused = True
            self._transport.pause_reading()

    def _resume(self) -> None:
        if self._paused:
            self._paused = False
            self._transport.resume_reading()

    def _note_loss(self, reason: BaseException) -> None:
        if self._loss_reason is None:
            self._loss_reason = reason
            if self.trace is not None:
                self.trace.note_unfinished_frame()
        if self._buffer_full:
            self.resume_writing()
        self._doorbell.ring()


class FrameTrace:
    """The frames of a link that the log and the observers did not get yet.

    They get the frames of a delivery together, before its events are dispatched.

    Args:
        name: name of the camera.
        on_frames: function that is called with frames; None if only the log wants them.

    Attributes:
        machine: the link's machine.
    """

    __slots__ = ("_frames", "_name", "_on_frames", "_rest_noted", "machine")

    def __init__(self, name: str, on_frames: Callable[[Sequence[RawFrame]], None] | None) -> None:
        self.machine: LinkMachine
        self._name, self._on_frames = name, on_frames
        self._frames: list[RawFrame] = []
        self._rest_noted = False  # whether the link's last bytes were noted

    def note(self, sender: Sender, frame: Frame | RemoteProtocolError) -> None:
        """Add a frame, or an error about bytes that are no frame; the machine calls this."""
        frames, name = self._frames, self._name
        at = frames[-1].at if frames else datetime.now(UTC)
        content: Frame | TraceEntry
        if isinstance(frame, RemoteProtocolError):
            content = TraceEntry(at, name, "!", None, str(frame), None, frame.data.hex())
        else:
            content = frame
        frames.append(RawFrame(at, name, self.machine.dialect, sender, content))

    def note_unfinished_frame(self) -> None:
        """Add and pass on the bytes of an unfinished frame when the link ends; only once."""
        was_noted, self._rest_noted = self._rest_noted, True
        rest = b"" if was_noted else self.machine.unfinished_bytes
        if rest:
            text = f"{len(rest)} bytes that make no whole frame"
            hexed = rest[:MAX_REST_BYTES].hex()
            content = TraceEntry(datetime.now(UTC), self._name, "!", None, text, None, hexed)
            dialect = self.machine.dialect
            self._frames.append(RawFrame(content.at, self._name, dialect, Sender.CAMERA, content))
            self.pass_on()

    def pass_on(self) -> None:
        """Pass the frames on to the log and the observers."""
        frames, self._frames = self._frames, []
        if frames and logger.isEnabledFor(logging.DEBUG):
            for frame in frames:
                _, name, direction, _, message, _, data = frame.entry()
                logger.debug("%s %s %s %s", name, direction, message, data[:128])
        if frames and self._on_frames is not None:
            self._on_frames(frames)


def split_chunk(chunk: Chunk, frames: int) -> tuple[Chunk, Chunk]:
    """Split a chunk after a number of frames; a burst of results may be split, too.

    A trigger's answer and the next event stay together, since one frame may be answer and result.
    Otherwise the answer's caller would send before the result is handled.
    """
    at, events = chunk.received_at, chunk.events
    if chunk.frames == len(events):  # one frame for each event
        while frames < len(events) and type(events[frames - 1]) is TriggerAnswer:
            frames += 1
        later_chunk = Chunk(at, events[frames:], chunk.frames - frames, chunk.delivery)
        return Chunk(at, events[:frames], frames, chunk.delivery), later_chunk
    first_events: list[Event] = []
    frames_left, events_left = frames, collections.deque(events)
    while frames_left > 0 and events_left:
        event = events_left.popleft()
        if type(event) is ResultBurst:
            if len(event.data) > frames_left:
                event, rest_of_burst = event.split(frames_left)
                events_left.appendleft(rest_of_burst)
            frames_left -= len(event.data)
        else:
            frames_left -= 1
        first_events.append(event)
    while first_events and events_left and type(first_events[-1]) is TriggerAnswer:
        first_events.append(events_left.popleft())
    taken = frames - frames_left
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
        protocol: protocol that makes the machine.
        dialects: one dialect, or several whose sessions begin with the same messages.
        transport: TCP or UDP.
        host: the camera's name or address.
        port: port of the camera.
        name: name of the camera in logs.
        max_length: bytes of the largest payload that is accepted.
        trace: function that is called with the frames of each delivery, and with sent frames.
        liveness_timeout: see :class:`Link`.

    Raises:
        OSError: the name does not resolve, nothing listens, or the host is unreachable.
    """
    loop = asyncio.get_running_loop()
    traced = trace is not None or logger.isEnabledFor(logging.DEBUG)
    frame_trace = FrameTrace(name, trace)
    machine = protocol.machine(
        dialects[0],
        Role.CLIENT,
        transport,
        max_length=max_length,
        trace=frame_trace.note if traced else None,
        candidates=tuple(dialects),
    )
    link = Link(machine, name=name, host=host, port=port, liveness_timeout=liveness_timeout)
    if traced:
        frame_trace.machine, link.trace = machine, frame_trace
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
_PROBE_COUNT, _USER_TIMEOUT = (
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
    if _PROBE_COUNT is not None:
        options.append((int(socket.IPPROTO_TCP), _PROBE_COUNT, 2))
    if _USER_TIMEOUT is not None:  # milliseconds
        options.append((int(socket.IPPROTO_TCP), _USER_TIMEOUT, max(1, round(timeout * 1000))))
    return tuple(options)
