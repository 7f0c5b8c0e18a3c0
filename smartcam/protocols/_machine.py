"""Define the interface between a link and its protocol's state machine.

A machine turns received bytes into events, and messages into bytes to send, in either role; it
imports no socket, loop or clock. ``_framed`` has the machine for frames, ``_lines`` and
``_insight`` those for lines of text.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

from smartcam.protocols import messages as m

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from smartcam.exceptions import RemoteProtocolError
    from smartcam.protocols._base import Dialect, Transport
    from smartcam.protocols.messages import Message


class State(enum.Enum):
    """The state of a link."""

    if not TYPE_CHECKING:
        __hash__ = object.__hash__  # faster than Enum.__hash__, which is written in Python
    IDLE = "idle"
    """Open, without a session."""
    CONNECTING = "connecting"
    """Connect was sent, its answer has not come."""
    CONNECTED = "connected"
    """A session is open."""
    DISCONNECTED = "disconnected"
    """Disconnect was sent; messages that the camera sent before may still come."""
    CLOSED = "closed"
    """The peer closed the link."""
    FAILED = "failed"
    """The peer broke the protocol; nothing is read any more."""


class Frame(NamedTuple):
    """One frame: message id and the bytes after the header."""

    message_id: int
    payload: bytes


@dataclass(slots=True, kw_only=True)
class ResultBurst:
    """Two or more result containers of one application that came directly after each other.

    The client's machine returns it for containers that were received together, so that the results
    of a free-running camera need no object each. Iterating yields the containers one by one.

    Attributes:
        application: id of the application that sent the containers.
        data: bytes of each container after the application id.
        size: bytes of all data together.
    """

    application: int
    data: list[bytes]
    size: int

    def __iter__(self) -> Iterator[m.ResultContainer]:
        return (m.ResultContainer(application=self.application, data=data) for data in self.data)

    def split(self, count: int) -> tuple[ResultBurst, ResultBurst]:
        """Return the first ``count`` containers and the others."""
        data, remaining = self.data[:count], self.data[count:]
        size = sum(map(len, data))
        return (
            ResultBurst(application=self.application, data=data, size=size),
            ResultBurst(application=self.application, data=remaining, size=self.size - size),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkFailed:
    """The peer broke the protocol: close the link. Always the last event."""

    error: RemoteProtocolError


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkEnded:
    """The peer closed the link; ``pending`` bytes of an unfinished frame were left."""

    pending: int


Event = m.Message | ResultBurst | LinkFailed | LinkEnded


class LinkMachine(Protocol):
    """The methods of a machine in the client's role that a link calls.

    Received bytes are passed in by :meth:`get_buffer` and :meth:`buffer_updated` (a stream) or by
    :meth:`receive_data` (a datagram). :meth:`events` returns them as messages of
    :mod:`smartcam.protocols.messages`, whatever their form on the wire.
    """

    transport: Transport
    """The transport of the link."""
    may_reply: bool
    """True if receiving bytes may give the machine bytes to send, such as a queued request."""
    counters: Counters
    """The counters of bytes and messages."""

    @property
    def dialect(self) -> Dialect:
        """The dialect that is spoken."""
        ...

    @property
    def candidates(self) -> Sequence[Dialect]:
        """The dialects that the camera may speak: several until :meth:`adopt` chooses one."""
        ...

    @property
    def state(self) -> State:
        """State of the link."""
        ...

    @property
    def unfinished_bytes(self) -> bytes:
        """Copy of the received bytes of an unfinished frame."""
        ...

    def adopt(self, dialect: Dialect) -> None:
        """Speak this dialect of :attr:`candidates` from now on."""

    def get_buffer(self) -> memoryview:
        """Return the buffer for a stream's next bytes; call :meth:`buffer_updated` next."""
        ...

    def buffer_updated(self, count: int, now: float) -> bool:
        """Accept ``count`` bytes that were written into :meth:`get_buffer`.

        ``now``: time of arrival, seconds of any clock; a machine that limits the time for a frame
        compares such times. Returns False if these bytes cannot have completed a message.
        """
        ...

    def receive_data(self, data: bytes) -> None:
        """Add bytes of a stream, or one whole datagram; never raises for bad bytes."""

    def receive_eof(self) -> None:
        """Record that the peer will send no more."""

    def events(self) -> list[Event]:
        """Return the events since the last call, in order; the caller owns the list."""
        ...

    def send(self, message: Message, *, answered: bool | None = None, again: bool = False) -> None:
        """Queue a message; write :meth:`data_to_send` next.

        ``answered``: whether an answer is expected; None: as the dialect says. ``again``: allow a
        second pending request of this kind.

        Raises:
            LocalProtocolError: the message is not possible now; nothing has changed.
            UnsupportedError: the dialect has no such message.
        """

    def data_to_send(self) -> list[bytes]:
        """Return the bytes to write, in order."""
        ...


def send_each(machine: LinkMachine, messages: Iterable[m.Message]) -> None:
    """Send messages that the link will write together.

    A second Query is allowed: the client asks before a trigger and again after it. GetStatus does
    not wait for an answer, since the camera also sends statuses by itself.

    Raises:
        LocalProtocolError: the link's state forbids a message; ``data_to_send()`` has those before.
    """
    has_query = False
    for message in messages:
        kind = type(message)
        if kind is m.Query and has_query:
            machine.send(message, again=True)
        else:
            machine.send(message, answered=False if kind is m.GetStatus else None)
        has_query = has_query or kind is m.Query


@dataclass(slots=True)
class Counters:
    """Counters of bytes and messages that went through a machine.

    Attributes:
        ignored_frames: broken frames that were dropped.
        unknown_ids: messages with an id that the dialect does not know.
        unexpected_messages: answers that no request was waiting for.
        long_bodies: messages with a longer body than documented, which were accepted.
    """

    frames_received: int = 0
    frames_sent: int = 0
    bytes_received: int = 0
    bytes_sent: int = 0
    ignored_frames: int = 0
    unknown_ids: int = 0
    unexpected_messages: int = 0
    long_bodies: int = 0
