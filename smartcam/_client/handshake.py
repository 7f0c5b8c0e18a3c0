"""Make a session: fresh links, one after the other, until a camera answers.

Each attempt sends Disconnect (harmless without a session; old sessions confuse the camera, thesis
3.1.4), then Connect, and awaits the answer with its version, the first status and the answer to a
Query. Anything unexpected, silence included, ends the attempt: close, fresh link, next attempt. To
a camera that hangs up without a byte, the next attempt is made without the Disconnect.
If no dialect is pinned, attempts take turns through the protocol's dialects. Those that begin a
session alike share an attempt: the answer to Connect, and what follows, tells them apart.
"""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

from smartcam._client.attempts import CONNECTING, OPENING, SessionRefusedError, Try, explain
from smartcam._client.link import Chunk, Link, open_link
from smartcam.exceptions import (
    CommandRejectedError,
    ConfigurationError,
    ConnectFailedError,
    RemoteProtocolError,
    SmartCamError,
)
from smartcam.protocols import Dialect, LinkEnded, LinkFailed, Transport, Verdict
from smartcam.protocols._inside import load_protocol
from smartcam.protocols.messages import (
    Connect,
    ConnectAnswer,
    Disconnect,
    GetStatus,
    Query,
    QueryAnswer,
    ResultContainer,
    StatusReport,
    UnknownMessage,
)
from smartcam.settings import FLEET_SCHEMES

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from smartcam.layout import Layout
    from smartcam.observers import RawFrame
    from smartcam.protocols import Protocol
    from smartcam.protocols.messages import Message
    from smartcam.settings import Address, CameraSettings

logger: logging.Logger = logging.getLogger("smartcam.handshake")

DETECTION_TIMEOUT = 0.5
"""Seconds for the answer to Connect in the first round while other dialects are still untried. A
camera answers in milliseconds, one that speaks another dialect is silent; later rounds have the
rest of the time, for slow links."""

TELLING_ROUNDS = 3
"""Number of requests for the status that a camera must answer to count as one that answers."""

BUSY_PAUSE = 0.05
"""Seconds until a camera that was too busy to name its application is asked again."""


MAX_EARLY_BYTES = 1 << 20
"""Largest number of bytes that may come while a session is made, beside one frame of
``max_length``. Making one takes a few round trips, and the fastest camera sends a fraction of it
meanwhile."""


class Session(NamedTuple):
    """A link with a session on it.

    Attributes:
        link: the link.
        address: address of the attempt, with the dialect pinned.
        dialect: dialect of the session.
        version: protocol version from the Connect answer.
        early: every chunk that came meanwhile, in order: the first status, and any other
            messages.
    """

    link: Link
    address: Address
    dialect: Dialect
    version: int
    early: list[Chunk]


@dataclass(slots=True)
class _Collector:
    """Takes events until a wanted one is there; keeps the rest for the client.

    Attributes:
        link: link that the events come from.
        most: largest number of bytes that may come meanwhile.
    """

    link: Link
    most: int
    early: list[Chunk] = field(default_factory=list[Chunk])
    version: int | None = None
    statuses: int = 0
    answers: int = 0  # number of answers to Query, whatever their contents
    application: int | None = None

    async def take(self) -> None:
        chunk = await self.link.receive()
        received = self.link.machine.counters.bytes_received
        if received > self.most:
            raise RemoteProtocolError(
                f"{received} bytes came before there was a session; {self.most} are accepted"
            )
        self.early.append(chunk)
        dialect = self.link.machine.dialect
        for event in chunk.events:
            match event:
                case ConnectAnswer(code=code, version=version):
                    if dialect.code(code, Connect).verdict is not Verdict.DONE:
                        text = "the camera refused the session: "
                        text += code_text(dialect, code, Connect)
                        if dialect.has_login:
                            raise CommandRejectedError(text, code=code)
                        raise SessionRefusedError(text)
                    if version < 1:
                        raise RemoteProtocolError(f"the camera speaks protocol version {version}")
                    self.version = version
                case StatusReport():
                    self.statuses += 1
                case QueryAnswer(code=code, application=application):
                    self.answers += 1
                    done = dialect.code(code).verdict is Verdict.DONE
                    self.application = application if done else None
                case ResultContainer():
                    pass
                case LinkFailed(error=error):
                    raise error
                case LinkEnded(pending=pending):
                    more = f" in the middle of a frame ({pending} bytes of it)" if pending else ""
                    raise RemoteProtocolError(f"the other side closed the connection{more}")
                case _:
                    logger.debug("%s ! %s during connect", self.link.name, type(event).__name__)

    async def ask(self, *first: Message) -> None:
        """Send a Query after ``first`` and wait for its answer."""
        before = self.answers
        for message in first:
            self.link.send(message, answered=False)
        self.link.send(Query())
        while self.answers == before:
            await self.take()

    async def tell_apart(self) -> None:
        """Find out which dialect of its kin the camera speaks, by an answer to Get status, or none.

        A status may also come by itself, so it must come to each of several questions.
        """
        machine, reader = self.link.machine, self.link.machine.dialect
        asking = [dialect for dialect in machine.kin if dialect.has(GetStatus)]
        others = [dialect for dialect in machine.kin if not dialect.has(GetStatus)]
        if asking and others:
            # a missing answer is certain if no message is lost
            certain = 1 if machine.transport is Transport.TCP else 2
            number = asking[0].message_id(GetStatus)
            known = reader.has(GetStatus)
            question = GetStatus() if known else UnknownMessage(message_id=number, payload=b"")
            answered = unanswered = 0
            while answered < TELLING_ROUNDS and unanswered < certain:
                before = self.statuses
                await self.ask(question)
                status_came = self.statuses > before
                answered, unanswered = answered + status_came, 0 if status_came else unanswered + 1
            machine.adopt((others if unanswered else asking)[0])
        else:
            machine.adopt(machine.kin[0])
        for chunk in self.early:
            chunk.events[:] = [
                machine.dialect.restate(event, reader) if isinstance(event, StatusReport) else event
                for event in chunk.events
            ]


def code_text(dialect: Dialect, code: int, request: type[Message] | None = None) -> str:
    """Return the text of a result code in the answer to a request."""
    number = f"{code:#04x}" if code >= 0 else str(code)
    return f"code {number} ({dialect.code(code, request).text})"


async def attempt(
    address: Address,
    dialects: Sequence[Dialect],
    transport: Transport,
    *,
    progress: Try,
    name: str,
    max_length: int,
    trace: Callable[[Sequence[RawFrame]], None] | None = None,
    disconnect_first: bool = True,
    liveness_timeout: float | None = None,
) -> Session:
    """Make a session over one fresh link; bounded by the caller's deadline.

    Args:
        address: address of the camera.
        dialects: one, or several that begin a session alike.
        transport: TCP or UDP.
        progress: function that gets each step of the handshake.
        name: name of the camera, for logs.
        max_length: largest payload accepted, bytes.
        trace: function that is called with frames that came or went together.
        disconnect_first: send Disconnect before Connect.
        liveness_timeout: see :class:`~smartcam._client.link.Link`.

    Raises:
        OSError: no link.
        SmartCamError: the link ended, or the received bytes were no camera's answer.
    """
    link = await open_link(
        load_protocol(address.protocol),
        dialects,
        transport,
        address.host,
        address.port,
        name=name,
        max_length=max_length,
        trace=trace,
        liveness_timeout=liveness_timeout,
    )
    collector = _Collector(link, MAX_EARLY_BYTES + max_length)
    try:
        link.send_all([Disconnect(), Connect()] if disconnect_first else [Connect()])
        progress.reach(CONNECTING)
        while collector.version is None:
            await collector.take()
        if len(link.machine.kin) > 1:
            progress.reach("finding out the dialect")
            await collector.tell_apart()
        dialect = link.machine.dialect
        progress.dialect = dialect.label
        progress.reach("waiting for the first status")
        if not collector.statuses and not dialect.capabilities.status_by_itself:
            link.send(GetStatus(), answered=False)
        while not collector.statuses:
            await collector.take()
        progress.reach("waiting for the answer to Query")
        await collector.ask()
        while collector.application is None:
            await asyncio.sleep(BUSY_PAUSE)
            await collector.ask()
    except BaseException as exc:
        link.give_up(exc)
        raise
    finally:
        progress.received = link.machine.counters.bytes_received
    if collector.version > 1:
        logger.warning("%s ! protocol version %d is newer than 1", name, collector.version)
    if dialect.remark:
        logger.warning("%s ! %s", name, dialect.remark)
    if (address.dialect, address.quirks) != (dialect.name, dialect.quirks):
        address = address._replace(dialect=dialect.name, quirks=dialect.quirks)
    return Session(link, address, dialect, collector.version, collector.early)


def tries_for(address: Address) -> list[tuple[Dialect, ...]]:
    """Return the attempts at an address, each for a fresh link."""
    return _tries_by(load_protocol(address.protocol), address)


def _tries_by(protocol: Protocol, address: Address) -> list[tuple[Dialect, ...]]:
    return protocol.tries(
        protocol.schemes[address.scheme], address.dialect, address.quirks, dict(address.parameters)
    )


def _for_layout(
    tries: list[tuple[Dialect, ...]], layout: Layout | None
) -> list[tuple[Dialect, ...]]:
    """Return the attempts in which the camera can get a layout.

    Raises:
        ConfigurationError: no attempt can send the layout.
    """
    groups: list[tuple[Dialect, ...]] = []
    refused: ConfigurationError | None = None
    for dialects in tries:
        try:
            groups.append(tuple(dialect.for_layout(layout) for dialect in dialects))
        except ConfigurationError as exc:
            refused = refused or exc
    if refused is not None and not groups:
        raise refused
    return groups


def remarks(address: Address) -> set[str]:
    """Return the remarks for a user who asks for results at an address.

    An address of a fleet has none: its agent logged them.
    """
    if address.scheme in FLEET_SCHEMES:
        return set()
    return {dialect.remark for dialects in tries_for(address) for dialect in dialects} - {""}


def names_of(dialects: Sequence[Dialect]) -> str:
    """Return the names of dialects that begin a session alike."""
    if len(dialects) == 1:
        return dialects[0].name
    return " or ".join(dict.fromkeys(dialect.name for dialect in dialects))


async def establish(
    settings: CameraSettings,
    trace: Callable[[Sequence[RawFrame]], None] | None = None,
    layout: Layout | None = None,
) -> Session:
    """Make a session within ``connect_timeout``, by up to ``connect_attempts`` rounds.

    Args:
        settings: the address, and the timeouts.
        trace: function that is called with frames that came or went together.
        layout: the fields of the results, for a camera that takes them.

    Raises:
        ConfigurationError: the camera cannot give results of this layout.
        ConnectFailedError: the reason, and the cure; ``attempts`` has the outcome of each.

    Cancellation: the link that was being made is dropped.
    """
    address = settings.address
    protocol = load_protocol(address.protocol)
    transport = protocol.schemes[address.scheme]
    groups = _for_layout(_tries_by(protocol, address), layout)
    loop = asyncio.get_running_loop()
    deadline = loop.time() + settings.connect_timeout
    tries: list[Try] = []
    cause: BaseException | None = None
    disconnect_first = True
    round_tries: list[Try] = []
    for left in range(settings.connect_attempts, 0, -1):
        if isinstance(cause, CommandRejectedError):
            break  # the camera refused, and would refuse again
        round_tries = []
        end = loop.time() + (deadline - loop.time()) / left
        hurried = len(groups) > 1 and left == settings.connect_attempts > 1
        for position, dialects in enumerate(groups):
            begin, untried = loop.time(), len(groups) - position
            progress = Try(names_of(dialects), transport.value)
            tries.append(progress)
            round_tries.append(progress)
            try:
                async with asyncio.timeout_at(end) as limit:
                    progress.on_step = _sharer(limit, end, untried, hurried=hurried)
                    return await attempt(
                        address,
                        dialects,
                        transport,
                        progress=progress,
                        name=settings.name,
                        max_length=settings.max_length,
                        trace=trace,
                        disconnect_first=disconnect_first,
                        liveness_timeout=settings.liveness_timeout,
                    )
            except (OSError, UnicodeError, SmartCamError) as exc:  # TimeoutError is an OSError
                progress.end(exc, loop.time() - begin)
                cause = exc
            if progress.hung_up:
                # perhaps because of the Disconnect: attempts are made with and without it by turns
                disconnect_first = not disconnect_first
            logger.debug("%s ! attempt %d: %s", settings.name, len(tries), progress)
            if progress.step == OPENING or isinstance(cause, CommandRejectedError):
                break  # another dialect would fail, too, in this round
            if progress.step != CONNECTING:
                groups = [dialects]  # the camera answered the Connect, so this is its dialect
                break
    why = explain(round_tries, address, protocol)
    raise ConnectFailedError(
        f"{settings.name}: no session with {address.url}: {why}",
        host=address.host,
        port=address.port,
        attempts=tuple(f"attempt {number}: {tried}" for number, tried in enumerate(tries, 1)),
    ) from cause


def _sharer(
    limit: asyncio.Timeout, end: float, untried: int, *, hurried: bool
) -> Callable[[str], None]:
    """Return the function that gives each step of an attempt its time, in a round until ``end``.

    Only the answer to Connect has to leave time for the untried dialects, this one included:
    without a link no dialect answered, and a camera that answered speaks this one.
    """
    loop = asyncio.get_running_loop()

    def on_step(step: str) -> None:
        when = end
        if step == CONNECTING and (hurried or untried > 1):
            share = (end - loop.time()) / untried
            when = loop.time() + (min(share, DETECTION_TIMEOUT) if hurried else share)
        if when != limit.when():
            limit.reschedule(when)

    return on_step
