"""One client's way to the camera, and the way of its messages while faults act on them.

Each link has a machine in the camera's role, which its owner makes. It is faulty only while wire
faults wait or something of theirs is under way. What the camera says then goes
``FaultyLink.say -> apply_faults -> DelayLine -> ClientLink.write``; what a client sends goes
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
"""Largest number of bytes of payload the camera takes: input data has the container's limit of
about 64 kB (HALCON script manual p. 35, published for the other direction)."""

_ENDED = "connection ended"
_UNSENT = "not sent"

Trace: TypeAlias = "Callable[[m.Sender, Frame | RemoteProtocolError], None]"


class CameraMachine(Protocol):
    """The methods that a link needs of the machine which speaks over it, in the camera's role."""

    transport: Transport

    @property
    def state(self) -> State:
        """State of the link."""
        ...

    @property
    def buffered(self) -> int:
        """Bytes that wait for more."""
        ...

    def receive_data(self, data: bytes) -> None:
        """Take bytes; never raises for what is in them."""

    def events(self) -> Iterable[object]:
        """Return the messages and bytes heard since the last call."""
        ...

    def send(self, message: Any) -> None:
        """Say something; LocalProtocolError: not now."""

    def data_to_send(self) -> list[bytes]:
        """Return the bytes to write, in order."""
        ...


class LinkOwner(Protocol):
    """The methods that links need of the emulator behind them."""

    clock: Clock
    queue: FaultQueue  # the faults that wait
    max_links: int  # clients that are looked at
    write_limit: int  # bytes kept for a client that does not read

    @property
    def codec(self) -> WireCodec:
        """Return the codec of the messages on the wire."""
        ...

    def step(self) -> AbstractContextManager[object]:
        """Bring the device's time up; afterwards deliver what it said."""
        ...

    def make_machine(self, transport: Transport, trace: Trace) -> CameraMachine:
        """Return the machine of a new link."""
        ...

    def arrived(self, link: ClientLink) -> None:
        """Note that a connection was made."""
        ...

    def received(self, link: ClientLink, message: m.Message) -> None:
        """Take a message of a link."""
        ...

    def serves(self, link: ClientLink) -> bool:
        """Return True if the link has the session."""
        ...

    def lost(self, link: ClientLink) -> None:
        """Forget a link that is gone; a second call does nothing."""
        ...

    def parted(self, link: ClientLink, *, by_client: bool, reset: bool) -> None:
        """Note that a connection has ended."""
        ...

    def traced(self, link: ClientLink, sender: m.Sender, what: Frame | RemoteProtocolError) -> None:
        """Note a frame that a machine saw, or bytes that make no frame."""
        ...

    def passed(self, link: ClientLink, sender: m.Sender, message: WireMessage) -> None:
        """Take note of a message that passed or is lost, as faults have made it."""
        ...


class ClientLink(ABC):
    """One client's way to the camera."""

    def __init__(self, owner: LinkOwner, transport: Transport, peer: str) -> None:
        self.peer = peer
        self.closed: bool = False
        self.hearing: str | None = None
        """Kinds of the faults that acted on what the camera hears just now."""
        self._owner = owner
        self.machine: CameraMachine = owner.make_machine(transport, self._trace)
        self._faulty: FaultyLink | None = None  # there while faults act

    def say(self, message: m.Message) -> None:
        """Put a message behind those that :meth:`flush` will write."""
        if self._owner.queue.said and self._faulty is None:
            self._enter_faulty()
        try:
            self.machine.send(message)
        except LocalProtocolError as exc:
            _log.warning("! %s: not sent: %s", self.peer, exc)
            return
        if self._faulty is not None:
            self._faulty.say(message, b"".join(self.machine.data_to_send()))

    def flush(self) -> None:
        """Write everything said."""
        faulty = self._faulty
        if faulty is None:
            self._write_frames(self.machine.data_to_send())
            return
        faulty.run()
        if faulty.idle:
            self._faulty = None

    @property
    def settled(self) -> bool:
        """True if the link has the session and so makes room for nobody."""
        return self._owner.serves(self)

    def turn_away(self, why: str) -> None:
        """End the link to make room, or because it was without a session for too long."""
        self.close(why)

    @abstractmethod
    def close(self, reason: str) -> None:
        """End the link; nothing is read or written any more."""

    def dismiss(self, reason: str) -> None:
        """End the link because another client has the session; a dead one stays as it is."""
        if self._faulty is None or not self._faulty.dead:
            self.close(reason)

    def unseated(self) -> None:  # noqa: B027  only where links have an order of their own
        """Note that the client has given the session back; it may stay."""

    def heard(self) -> None:
        """Write the camera's answers to what it heard."""
        self.flush()

    def feed(self, data: bytes) -> None:
        """Feed the machine and pass its messages on."""
        self.machine.receive_data(data)
        for event in self.machine.events():
            if isinstance(event, m.Message) and not self.closed:
                self._owner.received(self, event)

    @abstractmethod
    def write(self, data: bytes) -> bool:
        """Write bytes that belong together; False if it was not possible."""

    @abstractmethod
    def part(self, how: Literal["close", "reset"], why: str = "a fault ends it") -> None:
        """End the link behind what was written, or by a reset."""

    def hold(self, on: bool) -> None:  # noqa: B027  only where the network keeps what is not read
        """Read nothing more for a time, or go on."""

    @abstractmethod
    def stop_listening(self) -> None:
        """Read nothing more."""

    @abstractmethod
    def heal(self) -> None:
        """End what a fault does to the link for long."""

    def overflow(self) -> None:
        """End the link: faults hold back too much."""
        self.close(f"more than {self._owner.write_limit} bytes are held back")

    @abstractmethod
    def _write_frames(self, frames: list[bytes]) -> None:
        """Write frames as they are."""

    def _take(self, data: bytes) -> None:
        """Take what came: bytes of a stream, or one datagram."""
        if self._faulty is None and not self._owner.queue.heard:
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

    def _trace(self, sender: m.Sender, what: Frame | RemoteProtocolError) -> None:
        if self._faulty is None or sender is m.Sender.CLIENT:
            self._owner.traced(self, sender, what)


@dataclass(eq=False)
class FaultyLink:
    """Both directions of one link."""

    _link: ClientLink
    _owner: LinkOwner
    machine: CameraMachine

    def __post_init__(self) -> None:
        self.muted: str | None = None  # kind of the fault that keeps the camera silent on this link
        self.dead: bool = False  # nothing is read either
        self._outgoing = self._line(m.Sender.CAMERA, self._wake_outgoing, self._carry_out)
        self._incoming = self._line(m.Sender.CLIENT, self._wake_incoming, self._carry_in)
        # framer that the client's bytes go through, if there is one
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
            lost=lambda one: self._lose(sender, one),
        )

    @property
    def idle(self) -> bool:
        """True if messages may go the short way again, as far as this link is concerned."""
        return (
            self.muted is None
            and not self.dead
            and self._framer is None
            and not self._outgoing
            and not self._incoming
        )

    @property
    def unheard(self) -> bool:
        """True while something of the client's is held back."""
        return bool(self._incoming)

    def close(self) -> None:
        """Drop what is under way, and every timer."""
        self._revival.set(None)
        self._outgoing.close()
        self._incoming.close()

    def heal(self) -> None:
        """Listen and talk again."""
        self._revival.set(None)
        self.muted, self.dead = None, False

    # ------------------------------------------------------------------ out

    def say(self, message: m.Message, data: bytes) -> None:
        """Take a message that the camera says, and its bytes; :meth:`run` next."""
        dialect, queue = self._owner.codec, self._owner.queue
        frame = dialect.to_frame(message)
        faults = queue.by_message(queue.said, message)
        self._put(self._outgoing, apply_faults(WireMessage.of(frame, data), faults, dialect))

    def run(self) -> None:
        """Write everything for which it is time."""
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
        """Take bytes of the client: of a stream, or one datagram."""
        if self.dead:
            return
        heard = self._owner.queue.heard
        if self.machine.transport is Transport.UDP:
            self._take_message(cut_datagram(data, self._owner.codec))
            return
        if self._framer is None:
            data = self._finish_frame(data) if heard else data
            if not heard or self.machine.buffered:
                self._link.feed(data)
                return
            self._framer = self._owner.codec.framer(MAX_INPUT_BYTES)
        for message in cut(data, self._framer, self._owner.codec):
            if self.dead or self._link.closed:
                return
            self._take_message(message)
        self._stop_cutting()

    def _stop_cutting(self) -> None:
        """Give the bytes of an unfinished frame to the machine where no fault may need it whole."""
        if self._framer is not None and not self._owner.queue.heard and not self._incoming:
            rest, self._framer = self._framer.pending, None
            self._link.feed(rest)

    def _finish_frame(self, data: bytes) -> bytes:
        """Let the frame pass that was under way when the faults were given; return the rest."""
        done = 0
        while self.machine.buffered and done < len(data):
            self._link.feed(data[done : done + 1])
            done += 1
        return data[done:]

    def _take_message(self, message: WireMessage) -> None:
        queue, frame = self._owner.queue, message.what
        faults: list[Fault] = []
        if isinstance(frame, Frame):
            faults = queue.by_frame(queue.heard, frame)
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
            self._link.hearing = ", ".join(message.faults) or None
            self._link.feed(data)
            self._link.hearing = None

    def _wake_incoming(self) -> None:
        with self._owner.step():
            self._incoming.run()
            self._stop_cutting()
            self._link.heard()

    # ------------------------------------------------------------------ both

    def _put(self, line: DelayLine[WireMessage], sent: list[WireMessage]) -> None:
        if line.size + sum(one.size for one in sent) > self._owner.write_limit:
            self._link.overflow()
        outgoing = line is self._outgoing
        if self._link.closed or (outgoing and self.muted is not None):
            for one in sent:
                self._lose(m.Sender.CAMERA if outgoing else m.Sender.CLIENT, one)
        else:
            line.put(sent)

    def _lose(self, sender: m.Sender, message: WireMessage) -> None:
        message.faults.append(self._why)
        self._owner.passed(self._link, sender, message)

    @property
    def _why(self) -> str:
        """Reason for which something is lost now."""
        return self.muted or (_ENDED if self._link.closed else _UNSENT)

    def _end(self, ending: Ending) -> None:
        self._outgoing.run()  # what the camera said to the message that ends it
        if self._link.closed:
            return
        if ending.how in {"close", "reset"}:
            self._link.part("close" if ending.how == "close" else "reset")
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
    """The second client of a fault: it has the session, and no program behind it reads anything."""

    _dialect: FramedDialect
    _traced: Callable[[Frame], None]  # told of all the camera says to it; none of it is on a wire
    peer: ClassVar[str] = "second client"

    def say(self, message: m.Message) -> None:
        """Take a message."""
        try:
            frame = self._dialect.to_frame(message)
            self._dialect.encode_frame(frame)
        except LocalProtocolError:
            return  # a link would not have sent it either
        self._traced(frame)

    def flush(self) -> None:
        """Do nothing, since nothing waits."""

    def dismiss(self, reason: str) -> None:
        """Do nothing: another client has the session, and nothing is there to be closed."""
