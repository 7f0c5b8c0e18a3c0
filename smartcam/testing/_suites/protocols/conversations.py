"""Check a protocol's state machine against recorded conversations of client and camera."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

from smartcam.exceptions import RemoteProtocolError
from smartcam.protocols import LinkFailed, Role, Transport
from smartcam.protocols._inside import ResultBurst
from smartcam.protocols.messages import Message

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from smartcam.protocols import Dialect, Frame, LinkMachine, Protocol
    from smartcam.protocols._inside import Event
    from smartcam.protocols.messages import Sender

    Trace = Callable[[Sender, Frame | RemoteProtocolError], None]

MAX_LENGTH = 1 << 12
"""Length of the longest payload, in bytes, that the state machines under test accept."""

MachineOutput: TypeAlias = Message | type[RemoteProtocolError]
"""An output of a state machine: a message, or the kind of error that ends the link."""


class Sent(NamedTuple):
    """A message of the client.

    Attributes:
        message: the message.
        wire: the bytes written for it; bytes of several datagrams one after the other.
    """

    message: Message
    wire: bytes


class Received(NamedTuple):
    """Bytes of the camera: any piece of a stream, or one datagram.

    Attributes:
        data: the bytes.
        events: the machine's events for them: messages, and at the end possibly the type of the
            error that ends the link.
        wire: bytes that the machine writes in reply by itself: nothing asks it to send them.
    """

    data: bytes
    events: tuple[MachineOutput, ...] = ()
    wire: bytes = b""


Step: TypeAlias = Sent | Received


@dataclass(frozen=True, kw_only=True)
class Conversation:
    """The messages on one link from its beginning, with bytes from the protocol's documents.

    Attributes:
        name: name of the conversation for people.
        steps: bytes that client and camera send, in order.
        dialect: name of the dialect.
        transport: transport that carries the conversation.
        quirks: deviations from the dialect that the camera is known to have.
        parameters: further parameters that a URL would have.
    """

    name: str
    steps: Sequence[Step]
    dialect: str
    transport: Transport = Transport.TCP
    quirks: tuple[str, ...] = ()
    parameters: Mapping[str, str] = field(default_factory=dict[str, str])

    def __str__(self) -> str:
        return self.name

    def group(self, protocol: Protocol) -> tuple[Dialect, ...]:
        """Return the dialects with which a client may begin on the link; all begin alike.

        Raises:
            ConfigurationError: the dialect has no such quirk, or cannot use a parameter.
        """
        tries = protocol.dialect_groups(self.transport, self.dialect, self.quirks, self.parameters)
        return tries[0]


def flatten_events(events: Iterable[Event]) -> list[Any]:
    """Return the events; a burst becomes its containers, a failure the type of its error."""
    flattened: list[Any] = []
    for event in events:
        if isinstance(event, ResultBurst):
            flattened += event
        else:
            flattened.append(type(event.error) if isinstance(event, LinkFailed) else event)
    return flattened


class Player:
    """Runs a state machine through a conversation, and checks its output after each step."""

    def __init__(
        self, protocol: Protocol, conversation: Conversation, trace: Trace | None = None
    ) -> None:
        self.conversation = conversation
        self.group: tuple[Dialect, ...] = conversation.group(protocol)
        self.machine: LinkMachine = protocol.machine(
            self.group[0],
            Role.CLIENT,
            conversation.transport,
            max_length=MAX_LENGTH,
            trace=trace,
            candidates=self.group,
        )
        self.step_index: int = 0

    def play(self, end: int | None = None) -> Player:
        """Do the steps before index ``end``, by default all that are left; return the player.

        Raises:
            AssertionError: the machine's bytes or events differ.
        """
        for step in self.conversation.steps[self.step_index : end]:
            self.step(step)
        return self

    def step(
        self, step: Step, chunks: Sequence[bytes] | None = None, *, use_buffer: bool = True
    ) -> None:
        """Do one step; ``chunks`` are the bytes received in this step, cut at other offsets.

        With ``use_buffer``, received bytes of a stream are written into the machine's own buffer.

        Raises:
            AssertionError: the machine's bytes or events differ.
        """
        where = f"{self.conversation}, step {self.step_index}, {step!r:.300}"
        events: list[Any] = []
        if isinstance(step, Sent):
            self.machine.send(step.message)
            expected_events: list[Any] = []
            events = flatten_events(self.machine.events())
        else:
            expected_events = list(step.events)
            for chunk in [step.data] if chunks is None else chunks:
                events += self.feed_machine(chunk, use_buffer=use_buffer)
        wire = self.take_output()
        if events != expected_events:
            raise AssertionError(f"{where}: expected events {expected_events}, got {events}")
        if wire != step.wire:
            raise AssertionError(f"{where}: expected {step.wire!r} on the wire, got {wire!r}")
        if wire and not isinstance(step, Sent) and not self.machine.may_reply:
            raise AssertionError(
                f"{where}: the machine replies by itself, so may_reply must be True"
            )
        self.step_index += 1

    def feed_machine(self, chunk: bytes, *, use_buffer: bool = True) -> list[Any]:
        """Give bytes to the machine as a link does, and return its events."""
        if not use_buffer or self.machine.transport is Transport.UDP:
            self.machine.receive_data(chunk)
            return flatten_events(self.machine.events())
        events: list[Any] = []
        while chunk:
            buffer = self.machine.get_buffer()
            if not len(buffer):
                raise AssertionError("room() gave no room for a single byte")
            count = min(len(buffer), len(chunk))
            buffer[:count] = chunk[:count]
            chunk = chunk[count:]
            if self.machine.buffer_updated(count, 0.0):
                events += flatten_events(self.machine.events())
        return events + flatten_events(self.machine.events())

    def take_output(self) -> bytes:
        """Take the bytes that the machine has to write, and return them."""
        return b"".join(self.machine.data_to_send())
