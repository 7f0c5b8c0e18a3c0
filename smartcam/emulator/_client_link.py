"""A client's link to the camera, and the path of its messages while faults act on them.

The owner of a link makes the link's protocol machine, which has the camera's role. A link is faulty
only while wire faults wait or hold messages back. The camera's messages then go
``FaultyLink.send -> apply_faults -> DelayLine -> ClientLink.write``; the client's go
``FaultyLink.take -> cut -> apply_faults -> DelayLine -> ClientLink.feed``.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol, TypeAlias

from smartcam.emulator._clock import OneTimer, nanoseconds
from smartcam.emulator.faults._delay_line import DelayLine
from smartcam.emulator.faults._wire_effects import WireMessage, apply_faults, cut, cut_datagram
from smartcam.exceptions import LocalProtocolError
from smartcam.protocols import Frame, Transport
from smartcam.protocols import messages as m

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from contextlib import AbstractContextManager

    from smartcam.emulator._clock import Clock
    from smartcam.emulator.faults import Fault
    from smartcam.emulator.faults._delay_line import Ending
    from smartcam.emulator.faults._matching import FaultQueue
    from smartcam.emulator.faults._wire_effects import WireCodec, WireFramer
    from smartcam.exceptions import RemoteProtocolError
    from smartcam.protocols import FramedDialect, State

_log = logging.getLogger("smartcam.emulator")

MAX_INPUT_BYTES = 1 << 16
"""Largest number of bytes of payload that the camera accepts: input data has the container's limit
of about 64 kB (HALCON script manual p. 35, published for the other direction)."""

_ENDED = "connection ended"
_UNSENT = "not sent"

Trace: TypeAlias = "Callable[[m.Sender, Frame | RemoteProtocolError], None]"


class CameraMachine(Protocol):
    """The methods that a link calls on its protocol machine, which has the camera's role."""

    transport: Transport

    @property
    def state(self) -> State:
        """State of the link."""
        ...

    @property
    def buffered(self) -> int:
        """Bytes of an unfinished message."""
        ...

    def receive_data(self, data: bytes) -> None:
        """Add received bytes; never raises for bad bytes."""

    def events(self) -> Iterable[object]:
        """Return the messages and bytes received since the last call."""
        ...

    def send(self, message: Any) -> None:
        """Send a message; LocalProtocolError: not now."""

    def data_to_send(self) -> list[bytes]:
        """Return the bytes to write, in order."""
        ...


class LinkOwner(Protocol):
    """The methods of the emulator that links call."""

    clock: Clock
    queue: FaultQueue  # the faults that wait
    max_links: int  # largest number of clients
    write_limit: int  # largest number of bytes kept for a client

    @property
    def codec(self) -> WireCodec:
        """Return the codec of the messages on the wire."""
        ...

    def step(self) -> AbstractContextManager[object]:
        """Advance the device's time; afterwards deliver its messages."""
        ...

    def make_machine(self, transport: Transport, trace: Trace) -> CameraMachine:
        """Return the machine of a new link."""
        ...

    def arrived(self, link: ClientLink) -> None:
        """Note that a connection was made."""
        ...

    def received(self, link: ClientLink, message: m.Message) -> None:
        """Handle a message of a link."""
        ...

    def serves(self, link: ClientLink) -> bool:
        """Return True if the link has the session."""
        ...

    def lost(self, link: ClientLink) -> None:
        """Forget a link that is gone; a second call does nothing."""
        ...

    def connection_ended(self, link: ClientLink, *, by_client: bool, reset: bool) -> None:
        """Note that a connection has ended."""
        ...

    def traced(self, link: ClientLink, sender: m.Sender, seen: Frame | RemoteProtocolError) -> None:
        """Note a frame that a machine saw, or bytes that make no frame."""
        ...

    def passed(self, link: ClientLink, sender: m.Sender, message: WireMessage) -> None:
        """Note a message that passed or is lost, as faults have changed it."""
        ...


class ClientLink(ABC):
    """A client's link to the camera."""

    def __init__(self, owner: LinkOwner, transport: Transport, peer: str) -> None:
        self.peer = peer
        self.closed: bool = False
        self.input_faults: str | None = None
        """Kinds of the faults that acted on the message that the camera is receiving."""
        self._owner = owner
        self.machine: CameraMachine = owner.make_machine(transport, self._trace)
        self._faulty: FaultyLink | None = None  # set while faults act

    def send(self, message: m.Message) -> None:
        """Add a message to the messages that :meth:`flush` will write."""
        if self._owner.queue.on_camera and self._faulty is None:
            self._enter_faulty()
        try:
            self.machine.send(message)
        except LocalProtocolError as exc:
            _log.warning("! %s: not sent: %s", self.peer, exc)
            return
        if self._faulty is not None:
            self._faulty.send(message, b"".join(self.machine.data_to_send()))

    def flush(self) -> None:
        """Write all added messages."""
        faulty = self._faulty
        if faulty is None:
            self._write_frames(self.machine.data_to_send())
            return
        faulty.run()
        if faulty.idle:
            self._faulty = None

    @property
    def settled(self) -> bool:
        """True if the link has the session, so that it never makes room for another."""
        return self._owner.serves(self)

    def turn_away(self, why: str) -> None:
        """End the link to make room, or because it was without a session for too long."""
        self.close(why)

    @abstractmethod
    def close(self, reason: str) -> None:
        """End the link; nothing more is read or written."""

    def dismiss(self, reason: str) -> None:
        """End the link, since another client has the session; a dead link stays as it is."""
        if self._faulty is None or not self._faulty.dead:
            self.close(reason)

    def session_ended(self) -> None:  # noqa: B027  only TCP has an order of links
        """Note that the client has ended its session; the link may stay open."""

    def answer_messages(self) -> None:
        """Write the camera's answers to the received messages."""
        self.flush()

    def feed(self, data: bytes) -> None:
        """Feed the machine, and pass its messages on."""
        self.machine.receive_data(data)
        for event in self.machine.events():
            if isinstance(event, m.Message) and not self.closed:
                self._owner.received(self, event)

    @abstractmethod
    def write(self, data: bytes) -> bool:
        """Write bytes that belong together; False if it was not possible."""

    @abstractmethod
    def end_link(self, how: Literal["close", "reset"], why: str = "a fault ends it") -> None:
        """End the link after the bytes written so far, or by a reset."""

    def hold(self, on: bool) -> None:  # noqa: B027  only TCP keeps unread bytes
        """Stop reading for a time, or continue."""

    @abstractmethod
    def stop_listening(self) -> None:
        """Stop reading for good."""

    @abstractmethod
    def heal(self) -> None:
        """End the lasting effects of faults on the link."""

    def overflow(self) -> None:
        """End the link, since faults hold too many bytes back."""
        self.close(f"more than {self._owner.write_limit} bytes are held back")

    @abstractmethod
    def _write_frames(self, frames: list[bytes]) -> None:
        """Write frames as they are."""

    def _take(self, data: bytes) -> None:
        """Handle received bytes: a part of a stream, or one datagram."""
        if self._faulty is None and not self._owner.queue.on_client:
            self.feed(data)
        else:
            self._enter_faulty().take(data)

    def _enter_faulty(self) -> FaultyLink:
        if self._faulty is None:
            self._write_frames(self.machine.data_to_send())
            self._faulty = FaultyLink(self, self._owner, self.machine)
        return self._faulty

    def _leave(self) -> None:
        self.closed = True
        if self._faulty is not None:
            self._faulty.close()

    def _trace(self, sender: m.Sender, seen: Frame | RemoteProtocolError) -> None:
        if self._faulty is None or sender is m.Sender.CLIENT:
            self._owner.traced(self, sender, seen)


@dataclass(eq=False)
class FaultyLink:
    """Both directions of a link while faults act on it."""

    _link: ClientLink
    _owner: LinkOwner
    machine: CameraMachine

    def __post_init__(self) -> None:
        self.muted: str | None = None  # kind of the fault that keeps the camera silent on this link
        self.dead: bool = False  # nothing is read on the link either
        self._outgoing = self._line(m.Sender.CAMERA, self._wake_outgoing, self._carry_out)
        self._incoming = self._line(m.Sender.CLIENT, self._wake_incoming, self._carry_in)
        # framer of the client's bytes, if there is one
        self._framer: WireFramer | None = None
        self._revival = OneTimer(self._owner.clock, self._revive)

    def _line(
        self,
        sender: m.Sender,
        wake: Callable[[], None],
        carry: Callable[[list[tuple[WireMessage, bytes]]], None],
    ) -> DelayLine[WireMessage]:
        return DelayLine(
            self._owner.clock,
            ordered=self.machine.transport is Transport.TCP,
            wake=wake,
            carry=carry,
            end=self._end,
            lost=lambda message: self._lose(sender, message),
        )

    @property
    def idle(self) -> bool:
        """True if no fault acts on this link any more, so that messages may bypass it."""
        return (
            self.muted is None
            and not self.dead
            and self._framer is None
            and not self._outgoing
            and not self._incoming
        )

    @property
    def holds_input(self) -> bool:
        """True while bytes of the client are held back."""
        return bool(self._incoming)

    def close(self) -> None:
        """Drop all messages that are held back, and every timer."""
        self._revival.set(None)
        self._outgoing.close()
        self._incoming.close()

    def heal(self) -> None:
        """Read and write again."""
        self._revival.set(None)
        self.muted, self.dead = None, False

    # ------------------------------------------------------------------ out

    def send(self, message: m.Message, data: bytes) -> None:
        """Add a message of the camera, and its bytes; call :meth:`run` next."""
        dialect, queue = self._owner.codec, self._owner.queue
        frame = dialect.to_frame(message)
        faults = queue.by_message(queue.on_camera, message)
        self._put(self._outgoing, apply_faults(WireMessage.of(frame, data), faults, dialect))

    def run(self) -> None:
        """Write all messages whose time has come."""
        self._outgoing.run()

    def _carry_out(self, batch: list[tuple[WireMessage, bytes]]) -> None:
        silent = self._link.closed or self.muted is not None
        written = not silent and self._link.write(b"".join(data for _, data in batch))
        for message, data in batch:
            if written:
                message.passed += data
            elif data:
                message.faults.append(self._why)
            if not message.parts:
                self._owner.passed(self._link, m.Sender.CAMERA, message)

    def _wake_outgoing(self) -> None:
        with self._owner.step():
            self._outgoing.run()
            self._link.flush()

    # ------------------------------------------------------------------ in

    def take(self, data: bytes) -> None:
        """Add bytes of the client: a part of a stream, or one datagram."""
        if self.dead:
            return
        faults_wait = self._owner.queue.on_client
        if self.machine.transport is Transport.UDP:
            self._take_message(cut_datagram(data, self._owner.codec))
            return
        if self._framer is None:
            data = self._finish_frame(data) if faults_wait else data
            if not faults_wait or self.machine.buffered:
                self._link.feed(data)
                return
            self._framer = self._owner.codec.framer(MAX_INPUT_BYTES)
        for message in cut(data, self._framer, self._owner.codec):
            if self.dead or self._link.closed:
                return
            self._take_message(message)
        self._stop_cutting()

    def _stop_cutting(self) -> None:
        """Give an unfinished frame's bytes to the machine, if no fault needs the whole frame."""
        if self._framer is not None and not self._owner.queue.on_client and not self._incoming:
            pending, self._framer = self._framer.pending, None
            self._link.feed(pending)

    def _finish_frame(self, data: bytes) -> bytes:
        """Let the frame pass that was unfinished when the faults were given; return the rest."""
        done = 0
        while self.machine.buffered and done < len(data):
            self._link.feed(data[done : done + 1])
            done += 1
        return data[done:]

    def _take_message(self, message: WireMessage) -> None:
        queue, frame = self._owner.queue, message.what
        faults: list[Fault] = []
        if isinstance(frame, Frame):
            faults = queue.by_frame(queue.on_client, frame)
        self._put(self._incoming, apply_faults(message, faults, self._owner.codec))
        self._incoming.run()

    def _carry_in(self, batch: list[tuple[WireMessage, bytes]]) -> None:
        for message, data in batch:
            gone = self.dead or self._link.closed
            if gone:
                message.faults.append(self._why)
            if gone or (message.faults and not data):
                self._owner.passed(self._link, m.Sender.CLIENT, message)
                continue
            message.passed += data
            self._link.input_faults = ", ".join(message.faults) or None
            self._link.feed(data)
            self._link.input_faults = None

    def _wake_incoming(self) -> None:
        with self._owner.step():
            self._incoming.run()
            self._stop_cutting()
            self._link.answer_messages()

    # ------------------------------------------------------------------ both

    def _put(self, line: DelayLine[WireMessage], sent: list[WireMessage]) -> None:
        if line.size + sum(message.size for message in sent) > self._owner.write_limit:
            self._link.overflow()
        outgoing = line is self._outgoing
        if self._link.closed or (outgoing and self.muted is not None):
            for message in sent:
                self._lose(m.Sender.CAMERA if outgoing else m.Sender.CLIENT, message)
        else:
            line.put(sent)

    def _lose(self, sender: m.Sender, message: WireMessage) -> None:
        message.faults.append(self._why)
        self._owner.passed(self._link, sender, message)

    @property
    def _why(self) -> str:
        """Reason why a message is lost now."""
        return self.muted or (_ENDED if self._link.closed else _UNSENT)

    def _end(self, ending: Ending) -> None:
        self._outgoing.run()  # the camera's answers to the ending message
        if self._link.closed:
            return
        if ending.how in {"close", "reset"}:
            self._link.end_link("close" if ending.how == "close" else "reset")
            return
        self.muted = ending.cause
        self._outgoing.close()
        if ending.how == "half_open":
            self.dead = True
            self._incoming.close()
            self._link.stop_listening()
            if ending.seconds is not None:
                self._revival.set(nanoseconds(self._owner.clock.now + ending.seconds))

    def _revive(self) -> None:
        with self._owner.step():
            self._link.heal()


@dataclass(eq=False)
class SecondClientSession:
    """The second client that a fault simulates: it has the session, but no connection."""

    _dialect: FramedDialect
    _traced: Callable[[Frame], None]  # called with all messages to it; none is on a wire
    peer: ClassVar[str] = "second client"

    def send(self, message: m.Message) -> None:
        """Accept a message."""
        try:
            frame = self._dialect.to_frame(message)
            self._dialect.encode_frame(frame)
        except LocalProtocolError:
            return  # a link would not send it either
        self._traced(frame)

    def flush(self) -> None:
        """Do nothing, since nothing waits."""

    def dismiss(self, reason: str) -> None:
        """Do nothing: another client has the session, and there is nothing to close."""
