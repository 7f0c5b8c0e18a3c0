"""Find out the protocol, transport and dialect of an address; each attempt has a new link.

A :class:`TracedAttempt` has all sent and received bytes, as hex and, if possible, decoded. If a
camera closes the link without sending a byte, the attempt is repeated without the Disconnect before
Connect (see :mod:`smartcam._client.handshake`).
"""

from __future__ import annotations

import asyncio
import collections
import contextlib
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

from smartcam._client._inside import Attempt, SessionRefusedError, dialect_names, explain
from smartcam._client._inside import attempt as begin_session
from smartcam.exceptions import (
    CommandRejectedError,
    ConfigurationError,
    ConnectFailedError,
    ProtocolError,
    SmartCamError,
)
from smartcam.models import Status
from smartcam.observers import RawFrame, TraceEntry
from smartcam.protocols import Transport
from smartcam.protocols._inside import DEFAULT_MAX_LENGTH, load_protocol
from smartcam.protocols.messages import QueryAnswer, StatusReport
from smartcam.settings import Address, known_protocols, masked, parse_address

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Callable, Iterable, Sequence

    from smartcam._client._inside import Session
    from smartcam.protocols import Dialect, Protocol

MAX_FRAMES = 64
"""Largest number of frames that an attempt keeps: a session has six, and a camera may send results
at once."""

CLOSE_TIMEOUT = 1.0
"""Seconds for the orderly end of a session."""


class CameraAnswer(NamedTuple):
    """A camera's description of itself.

    Attributes:
        url: URL of the camera, which names transport and dialect.
        status: first status that the camera sent.
        application: id of the active application.
        protocol_version: protocol version in the answer to Connect.
    """

    url: str
    status: Status
    application: int | None
    protocol_version: int


@dataclass(slots=True, kw_only=True)
class TracedAttempt(Attempt):
    """An attempt and its frames; ``outcome`` is ``session`` if a camera answered.

    Attributes:
        address: address that was tried, with the scheme of the transport.
        frames: frames on the wire, in order; direction ``!`` for bytes that make no frame.
        omitted: number of entries beyond ``frames``.
        answer: answer of the camera; None if none answered.
        is_other_protocol: whether the tried protocol differs from that of the given address.
    """

    address: Address
    frames: list[TraceEntry] = field(default_factory=list[TraceEntry])
    omitted: int = 0
    answer: CameraAnswer | None = None
    is_other_protocol: bool = False

    def __str__(self) -> str:
        """Return the attempt in one line, for an error."""
        text = super(TracedAttempt, self).__str__()
        return (
            f"{self.address.protocol} at port {self.address.port}: {text}"
            if self.is_other_protocol
            else text
        )

    def keep(self, entry: TraceEntry) -> None:
        """Keep an entry, up to :data:`MAX_FRAMES`."""
        if self.answer is None and len(self.frames) < MAX_FRAMES:
            self.frames.append(entry)
        elif self.answer is None:
            self.omitted += 1


class Way(NamedTuple):
    """One way to begin a session with an address: a transport, and dialects that begin alike."""

    address: Address  # address with the scheme of the transport
    transport: Transport  # transport that carries the protocol
    dialects: tuple[Dialect, ...]  # dialects that begin a session alike


def ways(address: Address) -> list[Way]:
    """Return every way to speak to an address, the most probable first.

    The address's own options come first, the rest in the order of the protocol. Raises PluginError:
    its protocol fails to load.
    """
    protocol, parameters = load_protocol(address.protocol), dict(address.parameters)
    found: list[Way] = []
    for scheme in sorted(protocol.schemes, key=lambda scheme: scheme != address.scheme):
        transport = protocol.schemes[scheme]
        groups = protocol.dialect_groups(transport, parameters=parameters)
        if address.dialect is not None:
            given = protocol.dialect_groups(transport, address.dialect, address.quirks, parameters)
            others = [
                tuple(dialect for dialect in group if dialect.name != address.dialect)
                for group in groups
            ]
            groups = given + [group for group in others if group]
        scheme_address = address._replace(scheme=scheme)
        found += [Way(scheme_address, transport, group) for group in groups]
    return found


def other_ways(address: Address) -> list[Way]:
    """Return every way to speak to an address's host in the other registered protocols.

    They use the address's port; if that is the default port of its protocol, each protocol uses
    its own default port.
    """
    own_protocol = load_protocol(address.protocol)
    found: list[Way] = []
    for protocol in known_protocols():
        if protocol.name == own_protocol.name:
            continue
        port = protocol.default_port if address.port == own_protocol.default_port else address.port
        scheme = next(iter(protocol.schemes))
        try:
            found += ways(Address(protocol.name, scheme, address.host, port))
        except ConfigurationError:  # the protocol needs more than the URL has, such as a login
            continue
    return found


async def try_ways(
    address: Address,
    *,
    timeout: float,
    trace: Callable[[TraceEntry], None] | None = None,
    continue_after_answer: bool = False,
    every_protocol: bool = False,
) -> AsyncGenerator[TracedAttempt]:
    """Try every way in turn and yield each attempt, after the end of its session.

    The options of ``address`` are tried first. ``timeout``: seconds for all attempts; each has
    an equal share of the rest. ``trace``: called with every frame on the wire.
    ``continue_after_answer``: continue after the first way that answers. ``every_protocol``: try
    the other registered protocols, too; a protocol whose greeting was received is next.

    Cancellation: the link is dropped, after a Disconnect if there was a session.
    """
    loop = asyncio.get_running_loop()
    deadline = loop.time() + timeout
    all_ways = ways(address)
    if every_protocol:
        first_transport = all_ways[0].transport
        all_ways = sorted(
            [*all_ways, *other_ways(address)], key=lambda way: way.transport is not first_transport
        )
    remaining = collections.deque((way, True) for way in all_ways)
    while remaining:
        way, disconnect_first = remaining.popleft()
        share = max(0.0, deadline - loop.time()) / (len(remaining) + 1)
        attempt = await _try_way(way, share, trace, disconnect_first=disconnect_first)
        attempt.is_other_protocol = attempt.address.protocol != address.protocol
        if attempt.hung_up and disconnect_first and way.transport is Transport.TCP:
            # the camera may have closed because of the Disconnect
            remaining.appendleft((way, False))
        _put_greeted_first(remaining, attempt)
        yield attempt
        if attempt.answer is not None and not continue_after_answer:
            return


def _put_greeted_first(
    remaining: collections.deque[tuple[Way, bool]], attempt: TracedAttempt
) -> None:
    """If an attempt has received a protocol's greeting, move that protocol's ways to the front."""
    protocol = _greeted_protocol(attempt, {way.address.protocol for way, _ in remaining})
    if protocol is not None:
        protocol_and_port = (protocol, attempt.address.port)
        reordered = sorted(
            remaining,
            key=lambda pair: (pair[0].address.protocol, pair[0].address.port) != protocol_and_port,
        )
        remaining.clear()
        remaining.extend(reordered)


def _greeted_protocol(attempt: TracedAttempt, names: Iterable[str]) -> str | None:
    """Return the protocol whose greeting an attempt has received; None if it has received none."""
    if attempt.answer is not None or attempt.transport != Transport.TCP.value:
        return None
    unread = next((entry.hex for entry in attempt.frames if entry.direction == "!"), "")
    beginning = bytes.fromhex(unread).lstrip()
    return next((name for name in names if _is_greeting_of(load_protocol(name), beginning)), None)


def _is_greeting_of(protocol: Protocol, received: bytes) -> bool:
    return bool(protocol.greeting) and received.startswith(protocol.greeting or b"")


async def locate(host: str, *, timeout: float) -> str:
    """Return the URL of the camera at a bare ``HOST[:PORT]``, with the protocol that it answers.

    The session is ended before the return. ``timeout``: seconds for all ways together.

    Raises:
        ConnectFailedError: the camera answered no protocol; the error has the most informative
            attempt, and the cure.

    Cancellation: the link is dropped.
    """
    failed: list[TracedAttempt] = []
    address = parse_address(host)
    attempts = try_ways(address, timeout=timeout, every_protocol=True)
    async with contextlib.aclosing(attempts):
        async for attempt in attempts:
            if attempt.answer is not None:
                return attempt.answer.url
            failed.append(attempt)
    raise no_session(host, address, failed) from most_informative_first(failed)[0].error


def no_session(host: str, address: Address, failed: Sequence[TracedAttempt]) -> ConnectFailedError:
    """Return the error for failed attempts, with the most informative one and the cure."""
    ranked = most_informative_first(failed)
    address_tried = ranked[0].address
    explanation = explain(ranked[:1], address_tried, load_protocol(address_tried.protocol))
    return ConnectFailedError(
        f"no session with {masked(host)}: {explanation}",
        host=address.host,
        port=address.port,
        attempts=tuple(map(str, ranked)),
    )


def most_informative_first(failed: Iterable[TracedAttempt]) -> list[TracedAttempt]:
    """Return failed attempts, the most informative first.

    The order: a refusal, bytes of a frame that is no message, other bytes, silence, no link.
    """

    def rank(attempt: TracedAttempt) -> tuple[bool, bool, bool, bool]:
        refused = isinstance(attempt.error, (CommandRejectedError, SessionRefusedError))
        linked = attempt.opened and attempt.transport == Transport.TCP.value
        garbage = isinstance(attempt.error, ProtocolError)
        return (not refused, not attempt.received, not garbage, not linked)

    return sorted(failed, key=rank)


async def _try_way(
    way: Way,
    time_limit: float,
    trace: Callable[[TraceEntry], None] | None,
    *,
    disconnect_first: bool,
) -> TracedAttempt:
    address, transport, dialects = way
    attempt = TracedAttempt(dialect_names(dialects), transport.value, address=address)

    def record_frames(frames: Sequence[RawFrame]) -> None:
        for frame in frames:
            entry = frame.entry()
            attempt.keep(entry)
            if trace is not None:
                trace(entry)

    try:
        async with asyncio.timeout(time_limit):
            session = await begin_session(
                address,
                dialects,
                transport,
                progress=attempt,
                name=f"{address.host}:{address.port}",
                max_length=DEFAULT_MAX_LENGTH,
                trace=record_frames,
                disconnect_first=disconnect_first,
            )
    except (OSError, UnicodeError, SmartCamError) as exc:  # TimeoutError is an OSError
        attempt.end(exc, time_limit)
    else:
        attempt.outcome = "session"
        attempt.answer = _camera_answer(session)
        await session.link.close(CLOSE_TIMEOUT)
    return attempt


def _camera_answer(session: Session) -> CameraAnswer:
    status, application = None, None
    for event in (event for chunk in session.early_chunks for event in chunk.events):
        if isinstance(event, StatusReport) and status is None:
            status = event.status
        elif isinstance(event, QueryAnswer):
            application = event.application
    return CameraAnswer(session.address.url, status or Status(0), application, session.version)
