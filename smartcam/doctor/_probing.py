"""Asking an address how it speaks: transports and dialects, each on a fresh link, and what came.

Every try is a :class:`Trial` with all that was sent and received, decoded where that is possible
and as hex in any case. A camera that hangs up without a byte is asked once more without the
Disconnect in front (see :mod:`smartcam._client.handshake`).
"""

from __future__ import annotations

import asyncio
import collections
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

from smartcam._client.attempts import Try
from smartcam._client.handshake import attempt, names_of
from smartcam.exceptions import SmartCamError
from smartcam.models import Status
from smartcam.observers import TraceEntry
from smartcam.protocols._base import Transport, load_protocol
from smartcam.protocols._framed.framing import DEFAULT_MAX_LENGTH
from smartcam.protocols.messages import QueryAnswer, StatusReport

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Callable

    from smartcam._client.handshake import Session
    from smartcam.protocols._base import Dialect
    from smartcam.settings import Address

MAX_FRAMES = 64
"""Entries that a trial keeps: making a session takes six, and a camera may send results at once."""

CLOSE_TIMEOUT = 1.0
"""Seconds for the orderly end of a session."""


class CameraAnswer(NamedTuple):
    """What a camera said of itself.

    Attributes:
        url: its address, transport and dialect pinned.
        status: its first status.
        application: id of the active application.
        protocol_version: from the answer to Connect.
    """

    url: str
    status: Status
    application: int | None
    protocol_version: int


@dataclass(slots=True, kw_only=True)
class Trial(Try):
    """One try and what came of it; ``outcome`` is ``session`` where a camera answered.

    Attributes:
        address: where, with the scheme of the transport.
        frames: what went over the wire, in order; direction ``!`` for bytes that make no frame.
        omitted: entries beyond those.
        answer: what the camera said, None where none answered.
    """

    address: Address
    frames: list[TraceEntry] = field(default_factory=list[TraceEntry])
    omitted: int = 0
    answer: CameraAnswer | None = None

    def keep(self, entry: TraceEntry) -> None:
        """Keep an entry, as long as this is not over."""
        if self.answer is None and len(self.frames) < MAX_FRAMES:
            self.frames.append(entry)
        elif self.answer is None:
            self.omitted += 1


class Way(NamedTuple):
    """One way to speak to an address."""

    address: Address  # with the scheme of the transport
    transport: Transport  # what carries it
    dialects: tuple[Dialect, ...]  # one, or several that begin a session alike


def ways(address: Address) -> list[Way]:
    """Return every way to speak to an address, the most probable first.

    What the address says comes first; the rest in the order of the protocol. Raises PluginError:
    its protocol fails to load.
    """
    protocol, parameters = load_protocol(address.protocol), dict(address.parameters)
    found: list[Way] = []
    for scheme in sorted(protocol.schemes, key=lambda one: one != address.scheme):
        transport = protocol.schemes[scheme]
        groups = protocol.tries(transport, parameters=parameters)
        if address.dialect is not None:
            pinned = protocol.tries(transport, address.dialect, address.quirks, parameters)
            others = [tuple(d for d in group if d.name != address.dialect) for group in groups]
            groups = pinned + [group for group in others if group]
        at = address._replace(scheme=scheme)
        found += [Way(at, transport, group) for group in groups]
    return found


async def trials(
    address: Address,
    *,
    timeout: float,
    trace: Callable[[TraceEntry], None] | None = None,
    go_on: bool = False,
) -> AsyncGenerator[Trial]:
    """Try every way in turn and yield each try; the session of one that answers is ended first.

    What ``address`` pins is tried first. ``timeout``: seconds for all of them; each has an equal
    share of what is left. ``trace``: called with everything that goes over the wire. ``go_on``: go
    on behind the first way that answers.

    Cancellation: the link is dropped, after a Disconnect where there was a session.
    """
    loop = asyncio.get_running_loop()
    deadline = loop.time() + timeout
    left = collections.deque((way, True) for way in ways(address))
    while left:
        way, disconnect_first = left.popleft()
        share = max(0.0, deadline - loop.time()) / (len(left) + 1)
        trial = await _try(way, share, trace, disconnect_first=disconnect_first)
        if trial.hung_up and disconnect_first and way.transport is Transport.TCP:
            left.appendleft((way, False))  # perhaps at the Disconnect
        yield trial
        if trial.answer is not None and not go_on:
            return


async def _try(
    way: Way,
    share: float,
    trace: Callable[[TraceEntry], None] | None,
    *,
    disconnect_first: bool,
) -> Trial:
    address, transport, dialects = way
    trial = Trial(names_of(dialects), transport.value, address=address)

    def take(entry: TraceEntry) -> None:
        trial.keep(entry)
        if trace is not None:
            trace(entry)

    try:
        async with asyncio.timeout(share):
            session = await attempt(
                address,
                dialects,
                transport,
                progress=trial,
                name=f"{address.host}:{address.port}",
                max_length=DEFAULT_MAX_LENGTH,
                trace=take,
                disconnect_first=disconnect_first,
            )
    except (OSError, UnicodeError, SmartCamError) as exc:  # TimeoutError is an OSError
        trial.end(exc, share)
    else:
        trial.outcome = "session"
        trial.answer = _answer(session)
        await session.link.close(CLOSE_TIMEOUT)
    return trial


def _answer(session: Session) -> CameraAnswer:
    status, application = None, None
    for event in (event for chunk in session.early for event in chunk.events):
        if isinstance(event, StatusReport) and status is None:
            status = event.status
        elif isinstance(event, QueryAnswer):
            application = event.application
    return CameraAnswer(session.address.url, status or Status(0), application, session.version)
