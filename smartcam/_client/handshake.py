"""Make a session: try new links, one after the other, until the camera answers.

Each attempt sends Disconnect (harmless without a session; an old session confuses the camera,
section 3.1.4 of the thesis in ``docs/sources.md``), then Connect, and awaits the answer with its
version, the first status and the answer to a Query. Anything unexpected, silence included, ends
the attempt, and the next one uses a new link.
If a camera closes the connection without sending a byte, the next attempt is made without the
Disconnect.
If the address names no dialect, the protocol's dialects are tried in turn. Dialects that begin a
session alike, with the same messages, share an attempt; the answer to Connect and the messages
after it show which one the camera speaks.
"""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

from smartcam._client.attempts import CONNECTING, OPENING, Attempt, SessionRefusedError, explain
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
"""Seconds for the answer to Connect in the first round while other dialects are untried. A camera
answers in milliseconds, or not at all if it speaks another dialect. Later rounds have the remaining
time, for slow links."""

MIN_STATUS_ANSWERS = 3
"""Number of requests for the status that a camera must answer to show that its dialect has this
request. One answer is not enough, since a status may also come by itself."""

BUSY_PAUSE = 0.05
"""Seconds until a camera that was too busy to name its application is asked again."""


MAX_EARLY_BYTES = 1 << 20
"""Largest number of bytes that may come while a session is made, in addition to one frame of
``max_length``. A session takes a few round trips, in which the fastest camera sends a fraction of
this number."""


class Session(NamedTuple):
    """A link with a session on it.

    Attributes:
        link: the link.
        address: address of the attempt, in which the dialect is named.
        dialect: dialect of the session.
        version: protocol version from the Connect answer.
        early_chunks: chunks received while the session was made, in order: the first status, and
            any other messages.
    """

    link: Link
    address: Address
    dialect: Dialect
    version: int
    early_chunks: list[Chunk]


@dataclass(slots=True)
class _Collector:
    """Receives chunks while a session is made, and keeps them for the client.

    Attributes:
        link: link that the chunks come from.
        max_bytes: largest number of bytes that may come until there is a session.
        early_chunks: the chunks received.
        version: protocol version in the answer to Connect.
        statuses: number of statuses.
        answers: number of answers to Query, successful or not.
        application: application in the last answer to Query, if that was successful.
    """

    link: Link
    max_bytes: int
    early_chunks: list[Chunk] = field(default_factory=list[Chunk])
    version: int | None = None
    statuses: int = 0
    answers: int = 0
    application: int | None = None

    async def receive_chunk(self) -> None:
        chunk = await self.link.receive()
        received = self.link.machine.counters.bytes_received
        if received > self.max_bytes:
            raise RemoteProtocolError(
                f"{received} bytes came before there was a session; {self.max_bytes} are accepted"
            )
        self.early_chunks.append(chunk)
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

    async def query(self, *messages_before: Message) -> None:
        """Send a Query after ``messages_before`` and wait for its answer."""
        before = self.answers
        for message in messages_before:
            self.link.send(message, answered=False)
        self.link.send(Query())
        while self.answers == before:
            await self.receive_chunk()

    async def find_dialect(self) -> None:
        """Find out which of the machine's dialects the camera speaks, by asking for its status.

        A status may also come by itself, so it must come after each of several requests.
        """
        machine, first_dialect = self.link.machine, self.link.machine.dialect
        with_status = [dialect for dialect in machine.candidates if dialect.has(GetStatus)]
        without_status = [dialect for dialect in machine.candidates if not dialect.has(GetStatus)]
        if with_status and without_status:
            # one missing answer is enough if no message can be lost
            silences_needed = 1 if machine.transport is Transport.TCP else 2
            message_id = with_status[0].message_id(GetStatus)
            has_status = first_dialect.has(GetStatus)
            question = (
                GetStatus() if has_status else UnknownMessage(message_id=message_id, payload=b"")
            )
            answered = unanswered = 0
            while answered < MIN_STATUS_ANSWERS and unanswered < silences_needed:
                before = self.statuses
                await self.query(question)
                status_came = self.statuses > before
                answered, unanswered = answered + status_came, 0 if status_came else unanswered + 1
            machine.adopt((without_status if unanswered else with_status)[0])
        else:
            machine.adopt(machine.candidates[0])
        for chunk in self.early_chunks:
            chunk.events[:] = [
                machine.dialect.reinterpret_status(event, first_dialect)
                if isinstance(event, StatusReport)
                else event
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
    progress: Attempt,
    name: str,
    max_length: int,
    trace: Callable[[Sequence[RawFrame]], None] | None = None,
    disconnect_first: bool = True,
    liveness_timeout: float | None = None,
) -> Session:
    """Make a session over one fresh link; bounded by the caller's deadline.

    Args:
        address: address of the camera.
        dialects: one dialect, or several whose sessions begin with the same messages.
        transport: TCP or UDP.
        progress: record of the attempt, in which each step is noted.
        name: name of the camera, for logs.
        max_length: largest payload accepted, bytes.
        trace: function that is called with frames that were received or sent together.
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
            await collector.receive_chunk()
        if len(link.machine.candidates) > 1:
            progress.reach("finding out the dialect")
            await collector.find_dialect()
        dialect = link.machine.dialect
        progress.dialect = dialect.label
        progress.reach("waiting for the first status")
        if not collector.statuses and not dialect.capabilities.unasked_status:
            link.send(GetStatus(), answered=False)
        while not collector.statuses:
            await collector.receive_chunk()
        progress.reach("waiting for the answer to Query")
        await collector.query()
        while collector.application is None:
            await asyncio.sleep(BUSY_PAUSE)
            await collector.query()
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
    return Session(link, address, dialect, collector.version, collector.early_chunks)


def dialect_groups(address: Address) -> list[tuple[Dialect, ...]]:
    """Return groups of dialects, one group for each attempt at an address."""
    return _dialect_groups(load_protocol(address.protocol), address)


def _dialect_groups(protocol: Protocol, address: Address) -> list[tuple[Dialect, ...]]:
    return protocol.dialect_groups(
        protocol.schemes[address.scheme], address.dialect, address.quirks, dict(address.parameters)
    )


def _groups_for_layout(
    groups: list[tuple[Dialect, ...]], layout: Layout | None
) -> list[tuple[Dialect, ...]]:
    """Return the dialects that can use a layout, in their groups.

    Raises:
        ConfigurationError: no group can use the layout.
    """
    usable: list[tuple[Dialect, ...]] = []
    first_error: ConfigurationError | None = None
    for dialects in groups:
        try:
            usable.append(tuple(dialect.for_layout(layout) for dialect in dialects))
        except ConfigurationError as exc:
            first_error = first_error or exc
    if first_error is not None and not usable:
        raise first_error
    return usable


def dialect_remarks(address: Address) -> set[str]:
    """Return the remarks of an address' dialects, for a user who asks for results.

    An address of a fleet has none: its agent logged them.
    """
    if address.scheme in FLEET_SCHEMES:
        return set()
    return {dialect.remark for dialects in dialect_groups(address) for dialect in dialects} - {""}


def dialect_names(dialects: Sequence[Dialect]) -> str:
    """Return the names of the dialects of one attempt."""
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
        trace: function that is called with frames that were received or sent together.
        layout: the fields of the results, for a camera that must be told them.

    Raises:
        ConfigurationError: the camera cannot give results of this layout.
        ConnectFailedError: no attempt made a session; the text has a cause and a cure, and
            ``attempts`` the outcome of each attempt.

    Cancellation: the link that was being made is dropped.
    """
    address = settings.address
    protocol = load_protocol(address.protocol)
    transport = protocol.schemes[address.scheme]
    groups = _groups_for_layout(_dialect_groups(protocol, address), layout)
    loop = asyncio.get_running_loop()
    deadline = loop.time() + settings.connect_timeout
    attempts: list[Attempt] = []
    cause: BaseException | None = None
    disconnect_first = True
    round_attempts: list[Attempt] = []
    for rounds_left in range(settings.connect_attempts, 0, -1):
        if isinstance(cause, CommandRejectedError):
            break  # the camera refused, and would refuse again
        round_attempts = []
        round_end = loop.time() + (deadline - loop.time()) / rounds_left
        is_detecting = len(groups) > 1 and rounds_left == settings.connect_attempts > 1
        for position, dialects in enumerate(groups):
            begun_at, untried_count = loop.time(), len(groups) - position
            progress = Attempt(dialect_names(dialects), transport.value)
            attempts.append(progress)
            round_attempts.append(progress)
            try:
                async with asyncio.timeout_at(round_end) as limit:
                    progress.on_step = _step_timer(
                        limit, round_end, untried_count, is_detecting=is_detecting
                    )
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
                progress.end(exc, loop.time() - begun_at)
                cause = exc
            if progress.hung_up:
                # perhaps because of the Disconnect, so only every other attempt sends it
                disconnect_first = not disconnect_first
            logger.debug("%s ! attempt %d: %s", settings.name, len(attempts), progress)
            if progress.step == OPENING or isinstance(cause, CommandRejectedError):
                break  # another dialect would fail, too, in this round
            if progress.step != CONNECTING:
                groups = [dialects]  # the camera answered the Connect, so this is its dialect
                break
    reason = explain(round_attempts, address, protocol)
    raise ConnectFailedError(
        f"{settings.name}: no session with {address.url}: {reason}",
        host=address.host,
        port=address.port,
        attempts=tuple(f"attempt {number}: {tried}" for number, tried in enumerate(attempts, 1)),
    ) from cause


def _step_timer(
    limit: asyncio.Timeout, round_end: float, untried_count: int, *, is_detecting: bool
) -> Callable[[str], None]:
    """Return a function that sets the time limit of each step of an attempt.

    Each step may take until the end of the round. Only the answer to Connect has a share of that
    time, since it must leave time for the dialects that are untried after this one.
    """
    loop = asyncio.get_running_loop()

    def on_step(step: str) -> None:
        when = round_end
        if step == CONNECTING and (is_detecting or untried_count > 1):
            share = (round_end - loop.time()) / untried_count
            when = loop.time() + (min(share, DETECTION_TIMEOUT) if is_detecting else share)
        if when != limit.when():
            limit.reschedule(when)

    return on_step
