"""Define what a protocol consists of: dialects, roles with their policies, the entry point.

A :class:`Dialect` is one variant of a protocol on the wire, whatever form its frames have;
``_framed/dialect.py`` has the dialect of binary frames. A :class:`Policy`, chosen by role and
transport, decides how broken input is handled.
"""

from __future__ import annotations

import enum
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

from smartcam.exceptions import ConfigurationError, FrameError, MessageError, UnsupportedError
from smartcam.protocols.messages import Message, Request, Sender, StatusReport, wire_fields

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from smartcam.exceptions import RemoteProtocolError
    from smartcam.layout import Layout
    from smartcam.models import Capabilities
    from smartcam.protocols._machine import Frame, LinkMachine

    MachineFactory = Callable[..., LinkMachine]


class Role(enum.Enum):
    """The side of the link whose messages a machine sends."""

    CLIENT = "client"
    CAMERA = "camera"

    @property
    def sends(self) -> Sender:
        """The sender of this side's messages."""
        return Sender.CLIENT if self is Role.CLIENT else Sender.CAMERA

    @property
    def receives(self) -> Sender:
        """The sender of the other side's messages."""
        return Sender.CAMERA if self is Role.CLIENT else Sender.CLIENT


class Transport(enum.Enum):
    """The transport of frames: a stream of bytes, or a datagram for each frame."""

    TCP = "tcp"
    UDP = "udp"


@dataclass(frozen=True, slots=True, kw_only=True)
class Policy:
    """The way in which one role handles broken input.

    Attributes:
        fatal: errors that end the link: :exc:`~smartcam.FrameError` for bytes that are no frame,
            :exc:`~smartcam.MessageError` for a short body or a message at the wrong time. Input
            that causes another error is dropped and counted.
        exact_length: True if a known message must have exactly its documented length; otherwise a
            longer body is accepted and counted.
        reports_malformed: True if a known message of the wrong length is reported as an event, not
            dropped.
        bounded: True if a frame counts as broken when it announces more bytes than its message may
            have, or is not complete in time.
    """

    fatal: tuple[type[RemoteProtocolError], ...]
    exact_length: bool
    reports_malformed: bool = False
    bounded: bool = False


POLICIES: Mapping[tuple[Role, Transport], Policy] = {
    (Role.CLIENT, Transport.TCP): Policy(
        fatal=(FrameError, MessageError), exact_length=False, bounded=True
    ),
    (Role.CLIENT, Transport.UDP): Policy(fatal=(), exact_length=False, bounded=True),
    # the camera ignores invalid messages silently (SC manual p. 28: published)
    (Role.CAMERA, Transport.TCP): Policy(fatal=(), exact_length=True),
    (Role.CAMERA, Transport.UDP): Policy(fatal=(), exact_length=True),
}


class Verdict(enum.Enum):
    """The verdict of a result code on a request."""

    DONE = "done"
    BUSY = "busy"
    """Not now; the same request may succeed later."""
    UNKNOWN = "unknown"
    """The camera does not know the request."""
    REFUSED = "refused"


class CodeMeaning(NamedTuple):
    """The meaning of a result code: a text, and the verdict on the request."""

    text: str
    verdict: Verdict


UNDOCUMENTED = CodeMeaning("not documented", Verdict.REFUSED)
"""Meaning of a result code that no document explains."""


class ReadableFrame(NamedTuple):
    """A frame in readable form, for traces.

    Attributes:
        message_id: id on the wire, None if the dialect has no such ids.
        message: the message's name.
        fields: the frame's decoded body, None if the body cannot be decoded.
        data: the whole frame's bytes.
    """

    message_id: int | None
    message: str
    fields: dict[str, Any] | None
    data: bytes


class RawRequest(NamedTuple):
    """A request that a user sends by its id or command, and what is known of its answer.

    Attributes:
        message: the message to send.
        answer: the answer's message type, or its id.
        expects_answer: True if the documents say that the camera answers the request, or if the id
            is unknown.
        known: True if the dialect knows the id.
    """

    message: Message
    answer: type[Message] | int
    expects_answer: bool
    known: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class Dialect(ABC):
    """One wire variant of a protocol, as far as the client needs it.

    Args:
        name: name as in ``?dialect=``.
        about: one line for people.
        source: document that describes the dialect, and whether that is published, derived or
            inferred.
        quirks: names of this dialect's deviations, as in ``?quirks=``.
        shows_triggers: True if the status shows each accepted trigger: the bit Waiting for
            Trigger is cleared.
    """

    name: str
    about: str
    source: str
    quirks: tuple[str, ...] = ()
    shows_triggers: bool = True

    results_are_attributable: ClassVar[bool] = False
    """True if it is known without a Query to which trigger a result belongs: the camera handles one
    request after the other, so that an answer shows that all earlier requests are finished and
    their results were sent; or each result names its trigger."""
    exclusive: ClassVar[bool] = True
    """True if the camera serves one client at a time, and a new client displaces the old one."""
    has_login: ClassVar[bool] = False
    """True if the camera checks a password, so that a refused session is not tried again."""

    @property
    def label(self) -> str:
        """Name and quirks, for people."""
        return f"{self.name} with quirk {', '.join(self.quirks)}" if self.quirks else self.name

    @property
    def remark(self) -> str:
        """Text for a user who asks for results in this dialect, "" for nothing."""
        return ""

    @property
    @abstractmethod
    def capabilities(self) -> Capabilities:
        """Abilities of a camera in this dialect."""

    @property
    @abstractmethod
    def application_ids(self) -> range:
        """The ids that applications may have."""

    @abstractmethod
    def code(self, code: int, request: type[Message] | None = None) -> CodeMeaning:
        """Return the meaning of a result code in the answer to a request."""

    @abstractmethod
    def has(self, message_type: type[Message]) -> bool:
        """Return True if the dialect has a message of this type."""

    @abstractmethod
    def message_id(self, message: Message | type[Message]) -> int:
        """Return the id of a message in this dialect.

        Raises:
            UnsupportedError: the dialect has no such message.
        """

    def message_label(self, message: Message) -> str:
        """Return a message's name for errors, with its id or command."""
        return f"{type(message).__name__} ({self.message_id(message):#04x})"

    def answers(self, request: type[Request]) -> bool:
        """Return True if the camera answers a request of this type."""
        return request.answer is not None and self.has(request.answer)

    def fields(self, message_type: type[Message]) -> tuple[str, ...]:
        """Return the names of the fields that a message has on the wire."""
        return tuple(name for name, _ in wire_fields(message_type))

    def reinterpret_status(self, report: StatusReport, source_dialect: Dialect) -> StatusReport:
        """Return a status, decoded by ``source_dialect``, as this dialect decodes the same bits."""
        return report

    def data_begins(self, sender: Sender, message_id: int) -> int | None:
        """Return the number of bytes of a body before its ``data``; None if there is no such field.

        ``data`` is the last field. :meth:`make_readable` needs only the bytes before it and the
        body's length.
        """
        return None

    @abstractmethod
    def make_readable(self, sender: Sender, frame: Frame) -> ReadableFrame:
        """Return a frame in readable form, for a trace; it never raises."""

    @abstractmethod
    def raw_request(self, message_id: int | str, payload: bytes) -> RawRequest:
        """Return a request by its id, for users who know a message that the dialect lacks.

        Raises:
            LocalProtocolError: only the client itself may send it, such as Connect and Disconnect.
            UnsupportedError: the id must be a number in this dialect, or must be a text.
        """

    @abstractmethod
    def body(self, answer: Message) -> bytes:
        """Return the bytes of the answer to a raw request.

        Raises:
            CommandRejectedError: the answer is a refusal.
        """

    def unsupported(self, message_type: type[Message]) -> UnsupportedError:
        """Return the error for a message that the dialect does not have."""
        return UnsupportedError(
            f"dialect {self.name} has no {message_type.__name__}; "
            f"it can: {', '.join(self.capabilities.names)}"
        )

    def with_quirks(self, names: Iterable[str]) -> Dialect:
        """Return the dialect with these deviations from it.

        Raises:
            ConfigurationError: the dialect knows no such deviation.
        """
        for name in names:
            raise ConfigurationError(f"dialect {self.name} has no quirk {name!r}; it has none")
        return self

    def for_layout(self, layout: Layout | None) -> Dialect:
        """Return the dialect for a session whose results are read with a layout.

        Overridden if the client can tell the camera which values its results shall hold.

        Args:
            layout: the fields; None for results as the camera sends them.

        Raises:
            ConfigurationError: the camera cannot give such results.
        """
        return self

    def with_parameters(self, parameters: Mapping[str, str]) -> Dialect:
        """Return the dialect with the parameters of a URL; overridden if the dialect has any.

        Raises:
            ConfigurationError: a parameter cannot be used.
        """
        return self


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """A family of dialects under one name, from an entry point of ``smartcam.protocols``.

    Attributes:
        name: name of the protocol.
        schemes: the transport of each URL scheme.
        default_port: port if a URL names none.
        models: camera models that speak it.
        dialects: the protocol's dialects by name.
        machine: function that makes the client's machine of a link. The machine gets dialects
            whose sessions begin with the same messages, and finds out which one the camera speaks.
        parameters: further parameters of a URL, with their meanings; in a URL, ``user`` and
            ``password`` are written before the host.
        detection: groups of dialects that a client tries if none is given, the most probable group
            first, each on a new link. The sessions of a group's dialects begin with the same
            messages. Default: a group for each dialect.
        emulator: ``module:attribute`` of the class of its emulated cameras, such as a
            :class:`~smartcam.emulator.LineCamera`; "" if there is none.
        greeting: bytes that a camera sends to a new client before it receives anything; ``b""`` if
            the camera sends nothing then, None if that is not known.
    """

    name: str
    schemes: Mapping[str, Transport]
    default_port: int
    models: tuple[str, ...]
    dialects: Mapping[str, Dialect]
    machine: MachineFactory
    parameters: Mapping[str, str] = field(default_factory=dict[str, str])
    detection: Mapping[Transport, tuple[tuple[Dialect, ...], ...]] = field(
        default_factory=dict[Transport, "tuple[tuple[Dialect, ...], ...]"]
    )
    emulator: str = ""
    greeting: bytes | None = None

    def dialect_groups(
        self,
        transport: Transport,
        dialect: str | None = None,
        quirks: Iterable[str] = (),
        parameters: Mapping[str, str] | None = None,
    ) -> list[tuple[Dialect, ...]]:
        """Return the groups of dialects to try, each on a new link.

        The sessions of a group's dialects begin with the same messages.


        Args:
            transport: transport of the link.
            dialect: name of the dialect that the URL sets; None to find out dialect and quirks.
            quirks: names of the quirks that the URL sets.
            parameters: other parameters of the URL.

        Raises:
            ConfigurationError: the dialect has no such quirk, or cannot use a parameter.
        """
        groups = self.detection.get(transport) or tuple((d,) for d in self.dialects.values())
        if dialect is not None:
            names = tuple(quirks)
            dialects = [d for group in groups for d in group if d.name == dialect and not names]
            groups = (tuple(dialects) or (self.dialects[dialect].with_quirks(names),),)
        if not parameters:
            return list(groups)
        return [tuple(d.with_parameters(parameters) for d in group) for group in groups]


def load_protocol(name: str) -> Protocol:
    """Return the protocol of this name.

    Raises:
        PluginError: the name is unknown, or the protocol failed to load.
        ConfigurationError: the entry point gives no :class:`Protocol`.
    """
    from smartcam.registry import PROTOCOLS  # imported late, since it imports logging

    protocol = PROTOCOLS.load(name)
    if not isinstance(protocol, Protocol):
        raise ConfigurationError(f"entry point {name!r} gives {protocol!r}, not a Protocol")
    return protocol
