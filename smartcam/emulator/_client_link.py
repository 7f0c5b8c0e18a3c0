"""Pass messages between a client's link and the emulated camera, while faults act on them.

The owner of a link makes the link's protocol machine, which has the camera's role. A link has a
:class:`FaultyLink` only while wire faults wait or hold messages back. Then the camera's messages go
``FaultyLink.send -> apply_faults -> DelayLine -> ClientLink.write``, and the client's go
``FaultyLink.take_bytes -> parse -> apply_faults -> DelayLine -> ClientLink.feed``.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol, TypeAlias

from smartcam.emulator._clock import OneTimer, nanoseconds
from smartcam.emulator.faults._delay_line import DelayLine
from smartcam.emulator.faults._wire_effects import WireMessage, apply_faults, parse, parse_one
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
        """Send a message; raise LocalProtocolError if the state forbids it."""

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

    def connection_begun(self, link: ClientLink) -> None:
        """Note that a connection was made."""
        ...

    def handle_message(self, link: ClientLink, message: m.Message) -> None:
        """Handle a message of a link."""
        ...

    def serves(self, link: ClientLink) -> bool:
        """Return True if the link has the session."""
        ...

    def forget_link(self, link: ClientLink) -> None:
        """Forget a link that is gone; a second call does nothing."""
        ...

    def connection_ended(self, link: ClientLink, *, by_client: bool, reset: bool) -> None:
        """Note that a connection has ended."""
        ...

    def note_frame(
        self, link: ClientLink, sender: m.Sender, content: Frame | RemoteProtocolError
    ) -> None:
        """Note a frame that a machine saw, or bytes that make no frame."""
        ...

    def note_message(self, link: ClientLink, sender: m.Sender, message: WireMessage) -> None:
        """Note a message that passed or was lost, in the form that faults gave it."""
        ...


class ClientLink(ABC):
    """A client's link to the camera."""

    def __init__(self, owner: LinkOwner, transport: Transport, peer: str) -> None:
        self.peer = peer
        self.closed: bool = False
        self.input_faults: str | None = None
        """Kinds of the faults that acted on the message being received; None for none."""
        self._owner = owner
        self.machine: CameraMachine = owner.make_machine(transport, self._trace)
        self._faulty: FaultyLink | None = None  # set while faults act

    def send(self, message: m.Message) -> None:
        """Add a message to the messages that :meth:`flush` will write."""
        if self._owner.queue.camera_wire_faults and self._faulty is None:
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
        if faulty.is_idle:
            self._faulty = None

    @property
    def keeps_place(self) -> bool:
        """True if the link has the session, so that it is never closed for a new client."""
        return self._owner.serves(self)

    def close_for(self, reason: str) -> None:
        """End the link for a new client, or because it had no session for too long."""
        self.close(reason)

    @abstractmethod
    def close(self, reason: str) -> None:
        """End the link; nothing more is read or written."""

    def dismiss(self, reason: str) -> None:
        """End the link, since another client has the session; a half-open link stays open."""
        if self._faulty is None or not self._faulty.is_dead:
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
                self._owner.handle_message(self, event)

    @abstractmethod
    def write(self, data: bytes) -> bool:
        """Write bytes together; return False if that is not possible."""

    @abstractmethod
    def end_link(self, how: Literal["close", "reset"], reason: str = "a fault ends it") -> None:
        """End the link after the bytes written so far, or by a reset."""

    def set_paused(self, paused: bool) -> None:  # noqa: B027  only TCP keeps unread bytes
        """Stop reading for a time, or continue (``paused`` is False)."""

    @abstractmethod
    def stop_reading(self) -> None:
        """Stop reading for good."""

    @abstractmethod
    def end_fault_effects(self) -> None:
        """End the lasting effects of faults on the link."""

    def overflow(self) -> None:
        """End the link, since faults hold too many bytes back."""
        self.close(f"more than {self._owner.write_limit} bytes are held back")

    @abstractmethod
    def _write_frames(self, frames: list[bytes]) -> None:
        """Write frames as they are."""

    def _handle_bytes(self, data: bytes) -> None:
        """Handle received bytes: a part of a stream, or one datagram."""
        if self._faulty is None and not self._owner.queue.client_wire_faults:
            self.feed(data)
        else:
            self._enter_faulty().take_bytes(data)

    def _enter_faulty(self) -> FaultyLink:
        if self._faulty is None:
            self._write_frames(self.machine.data_to_send())
            self._faulty = FaultyLink(self, self._owner, self.machine)
        return self._faulty

    def _mark_closed(self) -> None:
        self.closed = True
        if self._faulty is not None:
            self._faulty.close()

    def _trace(self, sender: m.Sender, content: Frame | RemoteProtocolError) -> None:
        if self._faulty is None or sender is m.Sender.CLIENT:
            self._owner.note_frame(self, sender, content)


@dataclass(eq=False)
class FaultyLink:
    """Both directions of a link while faults act on it."""

    _link: ClientLink
    _owner: LinkOwner
    machine: CameraMachine

    def __post_init__(self) -> None:
        # kind of the fault that keeps the camera silent on this link; None for none
        self.muted_by: str | None = None
        self.is_dead: bool = False  # whether nothing is read on the link either (half open)
        self._outgoing = self._make_delay_line(
            m.Sender.CAMERA, self._wake_outgoing, self._write_batch
        )
        self._incoming = self._make_delay_line(
            m.Sender.CLIENT, self._wake_incoming, self._feed_batch
        )
        # framer of the client's bytes, if there is one
        self._framer: WireFramer | None = None
        self._revival_timer = OneTimer(self._owner.clock, self._revive)

    def _make_delay_line(
        self,
        sender: m.Sender,
        wake: Callable[[], None],
        carry: Callable[[list[tuple[WireMessage, bytes]]], None],
    ) -> DelayLine[WireMessage]:
        return DelayLine(
            self._owner.clock,
            keeps_order=self.machine.transport is Transport.TCP,
            wake=wake,
            carry=carry,
            end=self._end_link,
            on_dropped=lambda message: self._report_lost(sender, message),
        )

    @property
    def is_idle(self) -> bool:
        """True if no fault acts on this link any more, so that messages may bypass it."""
        return (
            self.muted_by is None
            and not self.is_dead
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
        self._revival_timer.set(None)
        self._outgoing.close()
        self._incoming.close()

    def end_fault_effects(self) -> None:
        """Read and write again."""
        self._revival_timer.set(None)
        self.muted_by, self.is_dead = None, False

    # ------------------------------------------------------------------ out

    def send(self, message: m.Message, data: bytes) -> None:
        """Add a message of the camera, and its bytes; call :meth:`run` next."""
        dialect, queue = self._owner.codec, self._owner.queue
        frame = dialect.to_frame(message)
        faults = queue.by_message(queue.camera_wire_faults, message)
        self._add_messages(
            self._outgoing, apply_faults(WireMessage.of(frame, data), faults, dialect)
        )

    def run(self) -> None:
        """Write all messages whose time has come."""
        self._outgoing.run()

    def _write_batch(self, batch: list[tuple[WireMessage, bytes]]) -> None:
        silent = self._link.closed or self.muted_by is not None
        was_written = not silent and self._link.write(b"".join(data for _, data in batch))
        for message, data in batch:
            if was_written:
                message.passed_bytes += data
            elif data:
                message.effects.append(self._loss_reason)
            if not message.parts:
                self._owner.note_message(self._link, m.Sender.CAMERA, message)

    def _wake_outgoing(self) -> None:
        with self._owner.step():
            self._outgoing.run()
            self._link.flush()

    # ------------------------------------------------------------------ in

    def take_bytes(self, data: bytes) -> None:
        """Add bytes of the client: a part of a stream, or one datagram."""
        if self.is_dead:
            return
        faults_wait = self._owner.queue.client_wire_faults
        if self.machine.transport is Transport.UDP:
            self._add_client_message(parse_one(data, self._owner.codec))
            return
        if self._framer is None:
            data = self._finish_frame(data) if faults_wait else data
            if not faults_wait or self.machine.buffered:
                self._link.feed(data)
                return
            self._framer = self._owner.codec.framer(MAX_INPUT_BYTES)
        for message in parse(data, self._framer, self._owner.codec):
            if self.is_dead or self._link.closed:
                return
            self._add_client_message(message)
        self._stop_parsing()

    def _stop_parsing(self) -> None:
        """Pass an unfinished frame's bytes to the machine, if no fault needs the whole frame."""
        faults_wait = self._owner.queue.client_wire_faults
        if self._framer is not None and not faults_wait and not self._incoming:
            pending, self._framer = self._framer.unfinished_bytes, None
            self._link.feed(pending)

    def _finish_frame(self, data: bytes) -> bytes:
        """Finish the frame that was begun before the faults; return the bytes after it."""
        fed_count = 0
        while self.machine.buffered and fed_count < len(data):
            self._link.feed(data[fed_count : fed_count + 1])
            fed_count += 1
        return data[fed_count:]

    def _add_client_message(self, message: WireMessage) -> None:
        queue, frame = self._owner.queue, message.content
        faults: list[Fault] = []
        if isinstance(frame, Frame):
            faults = queue.by_frame(queue.client_wire_faults, frame)
        self._add_messages(self._incoming, apply_faults(message, faults, self._owner.codec))
        self._incoming.run()

    def _feed_batch(self, batch: list[tuple[WireMessage, bytes]]) -> None:
        for message, data in batch:
            is_gone = self.is_dead or self._link.closed
            if is_gone:
                message.effects.append(self._loss_reason)
            if is_gone or (message.effects and not data):
                self._owner.note_message(self._link, m.Sender.CLIENT, message)
                continue
            message.passed_bytes += data
            self._link.input_faults = ", ".join(message.effects) or None
            self._link.feed(data)
            self._link.input_faults = None

    def _wake_incoming(self) -> None:
        with self._owner.step():
            self._incoming.run()
            self._stop_parsing()
            self._link.answer_messages()

    # ------------------------------------------------------------------ both

    def _add_messages(self, line: DelayLine[WireMessage], sent: list[WireMessage]) -> None:
        if line.size + sum(message.size for message in sent) > self._owner.write_limit:
            self._link.overflow()
        is_outgoing = line is self._outgoing
        if self._link.closed or (is_outgoing and self.muted_by is not None):
            for message in sent:
                self._report_lost(m.Sender.CAMERA if is_outgoing else m.Sender.CLIENT, message)
        else:
            line.put(sent)

    def _report_lost(self, sender: m.Sender, message: WireMessage) -> None:
        message.effects.append(self._loss_reason)
        self._owner.note_message(self._link, sender, message)

    @property
    def _loss_reason(self) -> str:
        """Reason why a message is lost now."""
        return self.muted_by or (_ENDED if self._link.closed else _UNSENT)

    def _end_link(self, ending: Ending) -> None:
        self._outgoing.run()  # the camera's answers to the ending message
        if self._link.closed:
            return
        if ending.how in {"close", "reset"}:
            self._link.end_link("close" if ending.how == "close" else "reset")
            return
        self.muted_by = ending.cause
        self._outgoing.close()
        if ending.how == "half_open":
            self.is_dead = True
            self._incoming.close()
            self._link.stop_reading()
            if ending.seconds is not None:
                self._revival_timer.set(nanoseconds(self._owner.clock.now + ending.seconds))

    def _revive(self) -> None:
        with self._owner.step():
            self._link.end_fault_effects()


@dataclass(eq=False)
class SecondClientSession:
    """The session of the second client that a fault simulates, without a connection."""

    _dialect: FramedDialect
    _on_frame: Callable[[Frame], None]  # called with the frame of each message to it
    peer: ClassVar[str] = "second client"

    def send(self, message: m.Message) -> None:
        """Accept a message."""
        try:
            frame = self._dialect.to_frame(message)
            self._dialect.encode_frame(frame)
        except LocalProtocolError:
            return  # a link would not send it either
        self._on_frame(frame)

    def flush(self) -> None:
        """Do nothing, since nothing waits."""

    def dismiss(self, reason: str) -> None:
        """Do nothing: another client has the session, and there is nothing to close."""
