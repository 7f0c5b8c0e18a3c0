"""The way of a link's messages while faults act on them.

A link has a passage only while wire faults wait or something of theirs is under way. What the
camera says goes ``Passage.say -> mangle -> Conveyor -> Carrier.write``; what a client sends goes
``Passage.take -> Cutter -> mangle -> Conveyor -> Carrier.feed``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, Protocol

from smartcam.emulator.faults.delay_line import Conveyor, Piece
from smartcam.emulator.faults.wire_effects import Cutter, Parcel, cut_datagram, mangle
from smartcam.protocols.base import Transport
from smartcam.protocols.framed.framing import Frame
from smartcam.protocols.messages import Sender

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from smartcam.emulator.clock import Clock, TimerHandle
    from smartcam.emulator.faults import Fault
    from smartcam.emulator.faults.matching import FaultQueue
    from smartcam.emulator.faults.wire_effects import Ending
    from smartcam.protocols.framed.dialect import FramedDialect
    from smartcam.protocols.framed.machine import Machine

__all__ = ["Carrier", "Passage", "Watch"]

_ENDED = "connection ended"
_UNSENT = "not sent"


class Watch(Protocol):
    """What a passage wants from the emulator."""

    @property
    def spoken(self) -> FramedDialect:
        """The dialect."""
        ...

    @property
    def clock(self) -> Clock:
        """Its time."""
        ...

    @property
    def queue(self) -> FaultQueue:
        """The faults that wait."""
        ...

    def step(self) -> AbstractContextManager[object]:
        """Bring the device's time up; afterwards deliver what it said."""
        ...


class Carrier(Protocol):
    """What a passage wants from its link."""

    closed: bool
    hearing: str | None
    """Kinds of the faults that acted on what the camera hears just now."""

    def feed(self, data: bytes) -> None:
        """Let the camera hear bytes."""
        ...

    def heard(self) -> None:
        """The camera heard something: write what it said to it."""
        ...

    def flush(self) -> None:
        """Write what was said."""
        ...

    def write(self, data: bytes) -> bool:
        """Write bytes that belong together; False if it was not possible."""
        ...

    def part(self, how: Literal["close", "reset"]) -> None:
        """End the connection."""
        ...

    def stop_listening(self) -> None:
        """Read nothing more."""
        ...

    def overflow(self) -> None:
        """Too much is held back."""
        ...

    def heal(self) -> None:
        """End what a fault does for long."""
        ...

    def traced_parcel(self, sender: Sender, parcel: Parcel) -> None:
        """What faults made of a message has passed, or is lost."""
        ...


class Passage:
    """Both directions of one link.

    Args:
        watch: the emulator.
        carrier: the link.
        machine: the link's.
        max_length: largest payload that the machine accepts, bytes.
        limit: bytes held back at most, in each direction.

    Attributes:
        muted: kind of the fault that keeps the camera silent on this link.
        dead: nothing is read either.
        saying: the frame that the machine made last.
    """

    def __init__(
        self, watch: Watch, carrier: Carrier, machine: Machine, *, max_length: int, limit: int
    ) -> None:
        self.muted: str | None = None
        self.dead: bool = False
        self.saying: Frame | None = None
        self._watch = watch
        self._carrier = carrier
        self._machine = machine
        self._max_length = max_length
        self._limit = limit
        ordered = machine.transport is Transport.TCP
        self._outgoing = Conveyor(
            watch.clock,
            ordered=ordered,
            wake=self._wake_outgoing,
            carry=self._carry_out,
            end=self._end,
            lost=lambda parcel: self._lose(Sender.CAMERA, parcel),
        )
        self._incoming = Conveyor(
            watch.clock,
            ordered=ordered,
            wake=self._wake_incoming,
            carry=self._carry_in,
            end=self._end,
            lost=lambda parcel: self._lose(Sender.CLIENT, parcel),
        )
        self._cutter: Cutter | None = None  # where it is, the client's bytes go through it
        self._revival: TimerHandle | None = None

    @property
    def idle(self) -> bool:
        """Whether messages may go the short way again, as far as this link is concerned."""
        return (
            self.muted is None
            and not self.dead
            and self._cutter is None
            and self._outgoing.idle
            and self._incoming.idle
        )

    @property
    def unheard(self) -> bool:
        """Whether something of the client's is held back."""
        return not self._incoming.idle

    def close(self) -> None:
        """Drop what is under way, and every timer."""
        if self._revival is not None:
            self._revival.cancel()
            self._revival = None
        self._outgoing.close()
        self._incoming.close()

    def heal(self) -> None:
        """Listen and talk again."""
        if self._revival is not None:
            self._revival.cancel()
            self._revival = None
        self.muted, self.dead = None, False

    # ------------------------------------------------------------------ out

    def say(self, frame: Frame, data: bytes) -> None:
        """Take a frame that the camera says; :meth:`run` next."""
        queue = self._watch.queue
        faults = queue.by_frame(queue.said, Sender.CAMERA, frame)
        self._put(self._outgoing, mangle(Parcel.of(frame, data), faults, self._watch.spoken))

    def run(self) -> None:
        """Write everything for which it is time."""
        self._outgoing.run()

    def _carry_out(self, batch: list[Piece]) -> None:
        silent = self._carrier.closed or self.muted is not None
        written = not silent and self._carrier.write(b"".join(data for _, data in batch))
        for piece in batch:
            parcel = piece.parcel
            if not written and piece.data:
                self._take_back(piece)
            if not parcel.parts:
                self._carrier.traced_parcel(Sender.CAMERA, parcel)

    def _wake_outgoing(self) -> None:
        with self._watch.step():
            self._outgoing.run()
            self._carrier.flush()

    # ------------------------------------------------------------------ in

    def take(self, data: bytes) -> None:
        """Take bytes of the client: of a stream, or one datagram."""
        if self.dead:
            return
        heard = self._watch.queue.heard
        if self._machine.transport is Transport.UDP:
            self._take_parcel(cut_datagram(data, self._watch.spoken))
            return
        if self._cutter is None:
            data = self._finish_frame(data) if heard else data
            if not heard or self._machine.buffered:
                self._carrier.feed(data)
                return
            self._cutter = Cutter(self._watch.spoken, self._max_length)
        for parcel in self._cutter.cut(data):
            if self.dead or self._carrier.closed:
                return
            self._take_parcel(parcel)
        self._stop_cutting()

    def _stop_cutting(self) -> None:
        """Give the bytes of an unfinished frame to the machine where no fault may need it whole."""
        if self._cutter is not None and not self._watch.queue.heard and self._incoming.idle:
            rest, self._cutter = self._cutter.pending, None
            self._carrier.feed(rest)

    def _finish_frame(self, data: bytes) -> bytes:
        """Let the frame pass that was under way when the faults were given; return the rest."""
        done = 0
        while self._machine.buffered and done < len(data):
            self._carrier.feed(data[done : done + 1])
            done += 1
        return data[done:]

    def _take_parcel(self, parcel: Parcel) -> None:
        queue, frame = self._watch.queue, parcel.what
        faults: list[Fault] = []
        if isinstance(frame, Frame):
            faults = queue.by_frame(queue.heard, Sender.CLIENT, frame)
        self._put(self._incoming, mangle(parcel, faults, self._watch.spoken))
        self._incoming.run()

    def _carry_in(self, batch: list[Piece]) -> None:
        for parcel, data in batch:
            if self.dead or self._carrier.closed:
                self._take_back(Piece(parcel, data))
                self._carrier.traced_parcel(Sender.CLIENT, parcel)
            elif data or not parcel.faults:
                self._carrier.hearing = ", ".join(parcel.faults) or None
                self._carrier.feed(data)
                self._carrier.hearing = None
            else:
                self._carrier.traced_parcel(Sender.CLIENT, parcel)

    def _wake_incoming(self) -> None:
        with self._watch.step():
            self._incoming.run()
            self._stop_cutting()
            self._carrier.heard()

    # ------------------------------------------------------------------ both

    def _put(self, conveyor: Conveyor, parcels: list[Parcel]) -> None:
        if conveyor.size + sum(parcel.size for parcel in parcels) > self._limit:
            self._carrier.overflow()
        outgoing = conveyor is self._outgoing
        if self._carrier.closed or (outgoing and self.muted is not None):
            for parcel in parcels:
                self._lose(Sender.CAMERA if outgoing else Sender.CLIENT, parcel)
        else:
            conveyor.put(parcels)

    def _lose(self, sender: Sender, parcel: Parcel) -> None:
        parcel.faults.append(self._why)
        self._carrier.traced_parcel(sender, parcel)

    def _take_back(self, piece: Piece) -> None:
        """A piece that was to pass does not."""
        del piece.parcel.passed[len(piece.parcel.passed) - len(piece.data) :]
        piece.parcel.faults.append(self._why)

    @property
    def _why(self) -> str:
        """Why something is lost now."""
        return self.muted or (_ENDED if self._carrier.closed else _UNSENT)

    def _end(self, ending: Ending) -> None:
        self._outgoing.run()  # what the camera said to the message that ends it
        if self._carrier.closed:
            return
        if ending.how in {"close", "reset"}:
            self._carrier.part("close" if ending.how == "close" else "reset")
            return
        self.muted = ending.fault
        self._outgoing.close()
        if ending.how == "half_open":
            self.dead = True
            self._incoming.close()
            self._carrier.stop_listening()
            if ending.seconds is not None:
                clock = self._watch.clock
                self._revival = clock.call_at(clock.now + ending.seconds, self._revive)

    def _revive(self) -> None:
        with self._watch.step():
            self._carrier.heal()
