"""What went over the wire: the emulator's log, and waiting for something to appear in it."""

from __future__ import annotations

import asyncio
from collections import Counter, deque
from typing import TYPE_CHECKING, Literal, NamedTuple

from smartcam.exceptions import RemoteProtocolError, ResponseTimeoutError
from smartcam.protocols.messages import Message, Sender, UnknownMessage

if TYPE_CHECKING:
    from smartcam.emulator.parcels import Parcel
    from smartcam.protocols.base import Dialect
    from smartcam.protocols.framing import Frame

__all__ = ["LogEntry", "TrafficLog"]

MAX_ENTRIES = 10_000
"""Entries kept; the oldest go first. A day of a fast line is not what the log is for."""


Direction = Literal["in", "out"]


class LogEntry(NamedTuple):
    """One frame, or bytes that make none.

    Attributes:
        time: of the emulator's clock, seconds.
        direction: ``in`` from a client, ``out`` to it.
        peer: address and port of the client.
        message_id: id of the frame, None for bytes that make none.
        message: what the frame says; None for an unknown id, a body that does not fit, and bytes
            that make no frame.
        hex: the frame's payload, or the first bytes that make no frame.
        error: why it was ignored, None for a frame. A whole frame that is ignored has two
            entries: the frame, then the reason.
        fault: kinds of the faults that acted on it, in order; ``connection ended`` or ``not sent``
            behind them where it was lost for that reason. None where none did. The entry of a
            message is made when it has passed, or is lost. What the camera sends is told as it
            meant it, what it hears as it heard it.
        wire: the bytes that really passed, header included, as hex; empty for nothing. None: those
            of the frame.
    """

    time: float
    direction: Direction
    peer: str
    message_id: int | None
    message: Message | None
    hex: str
    error: str | None = None
    fault: str | None = None
    wire: str | None = None


class TrafficLog:
    """Keeps the last entries and counts what clients sent."""

    def __init__(self, dialect: Dialect) -> None:
        self.entries: deque[LogEntry] = deque(maxlen=MAX_ENTRIES)
        self._dialect = dialect
        self._received: Counter[int | type[Message]] = Counter()
        self._changed = asyncio.Event()

    def add(
        self,
        time: float,
        peer: str,
        sender: Sender,
        what: Frame | RemoteProtocolError,
        fault: str | None = None,
    ) -> LogEntry:
        """Keep what a machine traced, and return it as an entry."""
        direction: Direction = "in" if sender is Sender.CLIENT else "out"
        if isinstance(what, RemoteProtocolError):
            data, error = what.data.hex(" "), str(what)
            entry = LogEntry(time, direction, peer, None, None, data, error, fault)
        else:
            message_id, payload = what
            message = self._decode(sender, what)
            entry = LogEntry(
                time, direction, peer, message_id, message, payload.hex(" "), None, fault
            )
            if sender is Sender.CLIENT:
                self._count(message_id, message)
        self.entries.append(entry)
        return entry

    def add_parcel(self, time: float, peer: str, sender: Sender, parcel: Parcel) -> LogEntry:
        """Keep what faults made of a message, and return it as an entry."""
        direction: Direction = "in" if sender is Sender.CLIENT else "out"
        what, wire = parcel.what, parcel.wire
        if isinstance(what, bytes):
            entry = LogEntry(time, direction, peer, None, None, what.hex(" "))
        else:
            message_id, payload = what
            message = self._decode(sender, what)
            entry = LogEntry(time, direction, peer, message_id, message, payload.hex(" "))
        entry = entry._replace(
            fault=", ".join(parcel.faults) or None, wire=None if wire is None else wire.hex(" ")
        )
        self.entries.append(entry)
        return entry

    async def wait_received(
        self, what: int | type[Message], *, count: int = 1, timeout: float = 5.0
    ) -> None:
        """Wait until clients have sent ``count`` whole frames of a kind since the beginning.

        The timeout runs in real time, whatever the emulator's clock is.

        Args:
            what: a message id, or a message type.
            count: how many, those that came before this call included.
            timeout: seconds.

        Raises:
            ResponseTimeoutError: they did not come in time.

        Cancellation: safe.
        """
        try:
            async with asyncio.timeout(timeout):
                while self._received[what] < count:
                    changed = self._changed
                    await changed.wait()
        except TimeoutError as exc:
            name = f"message {what:#04x}" if isinstance(what, int) else what.__name__
            raise ResponseTimeoutError(
                f"the emulator received {self._received[what]} of {count} {name} in {timeout} s",
                message_id=what if isinstance(what, int) else None,
                waited=timeout,
            ) from exc

    def _count(self, message_id: int, message: Message | None) -> None:
        self._received[message_id] += 1
        if message is not None:
            self._received[type(message)] += 1
        self._changed.set()
        self._changed = asyncio.Event()

    def _decode(self, sender: Sender, frame: Frame) -> Message | None:
        if self._dialect.surplus(sender, frame) > 0:
            return None
        try:
            message = self._dialect.decode(sender, frame)
        except RemoteProtocolError:
            return None
        return None if isinstance(message, UnknownMessage) else message
