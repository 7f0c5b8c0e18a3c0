"""Find out the protocol, transport and dialect of an address; each try has a new link.

Every try is a :class:`Trial` with all sent and received bytes, as hex and, if possible, decoded. If
a camera closes the link without sending a byte, the try is repeated without the Disconnect before
Connect (see :mod:`smartcam._client.handshake`).
"""

from __future__ import annotations

import asyncio
import collections
import contextlib
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

from smartcam._client._inside import Attempt, SessionRefusedError, attempt, dialect_names, explain
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
"""Largest number of frames that a trial keeps: a session has six, and a camera may send results at
once."""

CLOSE_TIMEOUT = 1.0
"""Seconds for the orderly end of a session."""


class CameraAnswer(NamedTuple):
    """A camera's description of itself.

    Attributes:
        url: URL of the camera, with transport and dialect pinned.
        status: first status that the camera sent.
        application: id of the active application.
        protocol_version: protocol version in the answer to Connect.
    """

    url: str
    status: Status
    application: int | None
    protocol_version: int


@dataclass(slots=True, kw_only=True)
class Trial(Attempt):
    """One try and its outcome; ``outcome`` is ``session`` if a camera answered.

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
        """Return the try in one line, for an error."""
        text = super(Trial, self).__str__()
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
    """One way to speak to an address: a protocol, a transport, and its first message."""

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
            pinned = protocol.dialect_groups(transport, address.dialect, address.quirks, parameters)
            others = [
                tuple(dialect for dialect in group if dialect.name != address.dialect)
                for group in groups
            ]
            groups = pinned + [group for group in others if group]
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


async def trials(
    address: Address,
    *,
    timeout: float,
    trace: Callable[[TraceEntry], None] | None = None,
    continue_after_answer: bool = False,
    every_protocol: bool = False,
) -> AsyncGenerator[Trial]:
    """Try every way in turn and yield each try; a session is ended before its try is yielded.

    The pinned options of ``address`` are tried first. ``timeout``: seconds for all tries; each has
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
        trial = await _try_way(way, share, trace, disconnect_first=disconnect_first)
        trial.is_other_protocol = trial.address.protocol != address.protocol
        if trial.hung_up and disconnect_first and way.transport is Transport.TCP:
            # the camera may have closed because of the Disconnect
            remaining.appendleft((way, False))
        _put_greeted_first(remaining, trial)
        yield trial
        if trial.answer is not None and not continue_after_answer:
            return


def _put_greeted_first(remaining: collections.deque[tuple[Way, bool]], trial: Trial) -> None:
    """If a try has received a protocol's greeting, move the ways of that protocol to the front."""
    protocol = _greeted_protocol(trial, {way.address.protocol for way, _ in remaining})
    if protocol is not None:
        protocol_and_port = (protocol, trial.address.port)
        reordered = sorted(
            remaining,
            key=lambda pair: (pair[0].address.protocol, pair[0].address.port) != protocol_and_port,
        )
        remaining.clear()
        remaining.extend(reordered)


def _greeted_protocol(trial: Trial, names: Iterable[str]) -> str | None:
    """Return the protocol whose greeting a try has received; None if it has received none."""
    if trial.answer is not None or trial.transport != Transport.TCP.value:
        return None
    unread = next((entry.hex for entry in trial.frames if entry.direction == "!"), "")
    beginning = bytes.fromhex(unread).lstrip()
    return next((name for name in names if _is_greeting_of(load_protocol(name), beginning)), None)


def _is_greeting_of(protocol: Protocol, received: bytes) -> bool:
    return bool(protocol.greeting) and received.startswith(protocol.greeting or b"")


async def locate(host: str, *, timeout: float) -> str:
    """Return the URL of the camera at a bare ``HOST[:PORT]``, with the protocol that it answers.

    The session is ended before the return. ``timeout``: seconds for all ways together.

    Raises:
        ConnectFailedError: the camera answered no protocol; the error has the most informative
            try, and the cure.

    Cancellation: the link is dropped.
    """
    failed: list[Trial] = []
    address = parse_address(host)
    async with contextlib.aclosing(trials(address, timeout=timeout, every_protocol=True)) as tries:
        async for trial in tries:
            if trial.answer is not None:
                return trial.answer.url
            failed.append(trial)
    raise no_session(host, address, failed) from most_informative_first(failed)[0].error


def no_session(host: str, address: Address, failed: Sequence[Trial]) -> ConnectFailedError:
    """Return the error for failed tries, with the most informative one and the cure."""
    ranked = most_informative_first(failed)
    address_tried = ranked[0].address
    explanation = explain(ranked[:1], address_tried, load_protocol(address_tried.protocol))
    return ConnectFailedError(
        f"no session with {masked(host)}: {explanation}",
        host=address.host,
        port=address.port,
        attempts=tuple(map(str, ranked)),
    )


def most_informative_first(failed: Iterable[Trial]) -> list[Trial]:
    """Return failed tries, the most informative first.

    The order: a refusal, bytes of a frame that is no message, other bytes, silence, no link.
    """

    def rank(trial: Trial) -> tuple[bool, bool, bool, bool]:
        refused = isinstance(trial.error, (CommandRejectedError, SessionRefusedError))
        linked = trial.opened and trial.transport == Transport.TCP.value
        garbage = isinstance(trial.error, ProtocolError)
        return (not refused, not trial.received, not garbage, not linked)

    return sorted(failed, key=rank)


async def _try_way(
    way: Way,
    time_limit: float,
    trace: Callable[[TraceEntry], None] | None,
    *,
    disconnect_first: bool,
) -> Trial:
    address, transport, dialects = way
    trial = Trial(dialect_names(dialects), transport.value, address=address)

    def record_frames(frames: Sequence[RawFrame]) -> None:
        for frame in frames:
            entry = frame.entry()
            trial.keep(entry)
            if trace is not None:
                trace(entry)

    try:
        async with asyncio.timeout(time_limit):
            session = await attempt(
                address,
                dialects,
                transport,
                progress=trial,
                name=f"{address.host}:{address.port}",
                max_length=DEFAULT_MAX_LENGTH,
                trace=record_frames,
                disconnect_first=disconnect_first,
            )
    except (OSError, UnicodeError, SmartCamError) as exc:  # TimeoutError is an OSError
        trial.end(exc, time_limit)
    else:
        trial.outcome = "session"
        trial.answer = _camera_answer(session)
        await session.link.close(CLOSE_TIMEOUT)
    return trial


def _camera_answer(session: Session) -> CameraAnswer:
    status, application = None, None
    for event in (event for chunk in session.early for event in chunk.events):
        if isinstance(event, StatusReport) and status is None:
            status = event.status
        elif isinstance(event, QueryAnswer):
            application = event.application
    return CameraAnswer(session.address.url, status or Status(0), application, session.version)
