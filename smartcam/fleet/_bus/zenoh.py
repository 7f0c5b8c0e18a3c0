"""Define the bus between processes and hosts, over Zenoh, which calls back in its own threads.

Received messages are put into one queue; many messages at once wake the event loop only once. To
send a message, Zenoh waits at most a millisecond for room in its buffers, and then
drops the message. Receivers notice lost results, states and parts of frames by their numbers. Calls
and replies are not lost: if sending one took so long, a thread sends it again, and waits for room.
"""

from __future__ import annotations

import asyncio
import collections
import contextlib
import functools
import logging
import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

from smartcam._zenoh import (
    MAX_WAITING_BYTES,
    NOT_ZENOH,
    QUERY_BYTES,
    ROOM_TIMEOUT,
    BusLink,
    ZenohDeclared,
    ZenohSession,
    direct,
    quietly,
)
from smartcam.exceptions import ConnectFailedError, SmartCamError
from smartcam.fleet._bus.bus import Bus, BusQuestion, Handle, Publisher, never
from smartcam.fleet._security.certificates import DIAGNOSIS_TIMEOUT, read_identity, shake_hands
from smartcam.fleet._security.door import plain_host

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from typing import Self

    from smartcam.fleet._bus.bus import Data
    from smartcam.fleet._security.certificates import Identity

logger: logging.Logger = logging.getLogger("smartcam.fleet")

MAX_DIRECT_BYTES = 1 << 16
"""Largest size, bytes, of a message that the event loop sends; a thread sends larger messages."""

LINK = re.compile(r"\w+/(?P<host>[0-9.]+|\[[^]]+\]):(?P<port>[0-9]+)")
"""Address of the other side of a link, in Zenoh's form."""

BURST_PERIOD = 0.01
"""Period, seconds, in which only :data:`MAX_EXPRESS_MESSAGES` messages are sent without delay."""

MAX_EXPRESS_MESSAGES = 8
"""Number of messages in :data:`BURST_PERIOD` that are each sent as a packet of its own, without
delay. Zenoh has room for 16 such packets. Further messages share packets, which are sent up to
a millisecond later."""

MAX_FREQUENT_KEYS = 64
"""Largest number of keys that have a publisher; it is bounded since routers store each
publisher."""

IDLE_KEY_TIMEOUT = 10.0
"""Seconds without use after which a key's publisher may be closed to make room for another key's.
If it were closed earlier, that could overtake its messages that still wait to be sent."""

SENDER_THREADS = 8
"""Number of threads that send messages which may have to wait for room. Each program that does not
read its messages blocks one thread."""


class ZenohConnection(ZenohSession, Bus):
    """A connection to a bus over Zenoh.

    Args:
        link: endpoints and certificates by which it joins the bus.
        more: further settings of Zenoh, by their paths.
    """

    def __init__(self, link: BusLink, more: Mapping[str, Any] | None = None) -> None:
        super().__init__(link, more)
        self._warned: tuple[bytes, int] | None = None
        self._certificate_task: asyncio.Task[None] | None = None
        self._senders: dict[int, ThreadPoolExecutor] = {}
        self._sending_bytes = 0
        self._uncertain_count = (
            0  # number of messages that may have been dropped, and were not sent again yet
        )
        self._waiting_in_threads: collections.Counter[str] = collections.Counter()
        self._burst_began_at, self._burst_count = -BURST_PERIOD, 0
        # keys that are used often, in the order of their last use
        self._frequent_keys: dict[str, _FrequentKey] = {}
        zenoh = self._zenoh
        control, priority = zenoh.CongestionControl, zenoh.Priority.INTERACTIVE_HIGH
        self._drop_options, self._block_options = (
            {
                express: {
                    "priority": priority,
                    "express": express,
                    "congestion_control": congestion,
                }
                for express in (False, True)
            }
            for congestion in (control.DROP, control.BLOCK)
        )
        self._part_options = {
            "priority": zenoh.Priority.DATA_LOW,
            "express": True,
            "congestion_control": control.DROP,
        }

    def _threads(self) -> list[ThreadPoolExecutor]:
        senders, self._senders = self._senders, {}
        return [*super()._threads(), *senders.values()]

    # ------------------------------------------------------------------ open and close

    async def open(self, timeout: float) -> Self:
        """Connect to the bus.

        Raises:
            ConnectFailedError: the bus cannot listen, or reach another participant, within
                ``timeout`` seconds; the text names an error of a certificate.
            ConfigurationError: the certificates are not valid.
        """
        folder = self._link.certificates
        if folder is None:
            return await self._open_plain(timeout)
        loop = asyncio.get_running_loop()
        deadline = loop.time() + timeout
        await self.check_certificates()
        try:
            # the rest of the timeout is for finding the cause of a failure
            await super().open(timeout - min(DIAGNOSIS_TIMEOUT, timeout / 3))
        except ConnectFailedError as exc:
            if self._link.listen:
                raise
            if reason := await self._find_handshake_error(Path(folder), deadline - loop.time()):
                raise self._connect_error(reason) from exc
            raise
        self._certificate_task = loop.create_task(
            self._watch_certificates(), name="smartcam.fleet.check_certificates"
        )
        return self

    async def _open_plain(self, timeout: float) -> Self:
        try:
            return await super().open(timeout)
        except ConnectFailedError as exc:
            if exc.attempts[0] != NOT_ZENOH:
                raise
            text = f"{exc}, or it wants TLS and a certificate: fleet+tls://"
            raise ConnectFailedError(text, attempts=exc.attempts) from exc

    async def close(self) -> None:
        """Leave the bus, which ends all declarations. Idempotent."""
        task, self._certificate_task = self._certificate_task, None
        if task is not None:
            task.cancel()
        self._frequent_keys.clear()
        await super().close()

    async def check_certificates(self) -> Identity:
        """Read the identity of the current certificates; log a warning if they end soon.

        Raises:
            ConnectFailedError: the certificates have expired.
            ConfigurationError: the certificates are not valid.
        """
        folder, loop = Path(self._link.certificates or ""), asyncio.get_running_loop()
        identity = await loop.run_in_executor(None, read_identity, folder)
        if identity.expired_text:
            raise self._connect_error(identity.expired_text)
        warning = identity.digest, identity.urgency
        if identity.urgency and warning != self._warned:
            logger.warning("%s ! %s", self._link.endpoints_text, identity.warning)
        self._warned, self.identity = warning, identity
        return identity

    async def _watch_certificates(self) -> None:
        """Check the certificates again and again, until it is closed."""
        while self.identity is not None:
            await asyncio.sleep(self.identity.next_check_delay)
            try:
                await self.check_certificates()
            except SmartCamError as exc:
                logger.error("%s ! %s", self._link.endpoints_text, exc)  # noqa: TRY400 - the text says it

    async def _find_handshake_error(self, folder: Path, timeout: float) -> str:
        """Return the first error of a handshake with an endpoint; empty if there is none."""
        endpoint_timeout = max(0.0, min(DIAGNOSIS_TIMEOUT, timeout / len(self._link.connect)))
        for endpoint in self._link.connect:
            kind, _, address = endpoint.partition("/")
            host, _, port = address.rpartition(":")
            if kind == "tls":
                handshake = await shake_hands(host.strip("[]"), int(port), folder, endpoint_timeout)
                if handshake.trouble:
                    return handshake.trouble
        return ""

    @property
    def is_connected(self) -> bool:
        session = self._session
        if session is None:
            return False
        # Zenoh notices a lost link before it notices that the router is gone
        return bool(self._link.mode != "client" or session.info.links())

    def connected_addresses(self) -> set[tuple[str, int]] | None:
        """Return the addresses of connected participants; None while they are not known."""
        if self._session is None:
            return None
        addresses = (parse_link_address(str(link.dst)) for link in self._session.info.links())
        return {address for address in addresses if address is not None}

    # ------------------------------------------------------------------ sending

    @property
    def waiting_bytes(self) -> int:
        return self._sending_bytes

    def put(self, key: str, payload: bytes) -> None:
        session = self._session
        if session is None:
            return
        started_at = self._loop.time()
        if started_at - self._burst_began_at > BURST_PERIOD:
            self._burst_began_at, self._burst_count = started_at, 0
        self._burst_count += 1
        # a few messages are sent without delay; Zenoh has no room for many of these
        express = self._burst_count <= MAX_EXPRESS_MESSAGES
        needs_thread = len(payload) > MAX_DIRECT_BYTES or self._uncertain_count
        if needs_thread or (
            self._waiting_in_threads and self._queue_name(key) in self._waiting_in_threads
        ):
            self._send_in_thread(self._queue_name(key), session, key, payload, express)
            return
        try:
            publisher = self._publisher_of(key, started_at) if express else None
            if publisher is None:
                session.put(key, payload, **self._drop_options[express])
            else:
                publisher.put(payload)
        except self._zenoh.ZError as exc:  # the session ends meanwhile
            logger.debug("the fleet's bus: %s", exc)
        if self._loop.time() - started_at >= ROOM_TIMEOUT:
            self._send_in_thread(
                self._queue_name(key), session, key, payload, express, may_be_dropped=True
            )

    def _queue_name(self, key: str) -> str:
        """Return the name of the queue in which a message is sent in order."""
        # a client sends everything to its router; others have a queue for each receiver
        return "" if self._link.mode == "client" else key

    def _publisher_of(self, key: str, now: float) -> Any:
        """Return Zenoh's publisher of a key that was used before; None for a new key.

        With a publisher, Zenoh need not look up the key's subscribers at each message.

        Raises:
            ZError: the session ends meanwhile.
        """
        frequent = self._frequent_keys
        known = frequent.pop(key, None)
        if known is not None:
            frequent[key] = known
            return known.use_publisher(now)
        if len(frequent) >= MAX_FREQUENT_KEYS:
            oldest = next(iter(frequent))
            if now - frequent[oldest].used_at < IDLE_KEY_TIMEOUT:
                return None
            frequent.pop(oldest).close()
        frequent[key] = _FrequentKey(self, key, self._drop_options[True], now)
        return None

    def put_part(self, key: str, head: bytes, data: Data) -> None:
        if self._session is not None:
            payload = bytes(data) if isinstance(data, memoryview) else data
            quietly(self._session.put, key, payload, attachment=head, **self._part_options)

    def subscribe_parts(self, pattern: str, on_part: Callable[[str, bytes, Data], None]) -> Handle:
        def on_sample(sample: Any) -> None:
            head = sample.attachment
            data = sample.payload.to_bytes()
            if head is not None and not self.full(len(data)):
                part_head, key = head.to_bytes(), str(sample.key_expr)
                self.call_in_loop(declared.call, len(data), on_part, key, part_head, data)

        declared = _BusDeclaration(self)
        return declared.declare(
            lambda session: session.declare_subscriber(pattern, direct(on_sample))
        )

    def _send_in_thread(
        self,
        queue: str,
        session: Any,
        key: str,
        payload: bytes,
        express: bool,
        *,
        may_be_dropped: bool = False,
    ) -> None:
        """Have a thread send a message, and all later messages of its queue until it is sent.

        Args:
            queue: name of the queue whose messages are sent in order.
            session: Zenoh's session.
            key: key of the message.
            payload: the message.
            express: whether the message is sent as an own packet, without delay.
            may_be_dropped: whether the loop has sent the message before, and this took so long that
                Zenoh may have dropped it. Zenoh may then drop further messages, too. So
                threads send all messages until this one is sent. A receiver that gets the message
                twice recognizes the repetition by the message's number.
        """
        size = len(payload)
        if self._sending_bytes + size > MAX_WAITING_BYTES:
            logger.warning(
                "%s ! %d bytes wait to be sent; further ones are dropped", key, self._sending_bytes
            )
            return
        thread_index = hash(queue) % SENDER_THREADS
        sender = self._senders.get(thread_index)
        if sender is None:
            sender = self._senders[thread_index] = ThreadPoolExecutor(1, "smartcam-fleet")
        options = self._block_options[express]

        def send() -> None:
            try:
                _put(session, key, payload, options)
            finally:
                with self._lock:
                    self._sending_bytes -= size
                    self._uncertain_count -= may_be_dropped
                    self._waiting_in_threads[queue] -= 1
                    if not self._waiting_in_threads[queue]:
                        del self._waiting_in_threads[queue]

        with self._lock:
            self._sending_bytes += size
            self._uncertain_count += may_be_dropped
            self._waiting_in_threads[queue] += 1
        sender.submit(send)

    def publisher(
        self,
        key: str,
        on_subscribers: Callable[[bool], None] | None = None,
        *,
        urgent: bool = False,
    ) -> Publisher:
        return _ZenohPublisher(self, key, on_subscribers, urgent=urgent)

    def subscribe(
        self, pattern: str, on_message: Callable[[str, bytes], None], *, low_priority: bool = False
    ) -> Handle:
        in_loop = self.call_in_loop_later if low_priority else self.call_in_loop
        full = functools.partial(self.full, later=True) if low_priority else self.full

        key = None if "*" in pattern else pattern  # faster than Zenoh's text of the key

        def on_sample(sample: Any) -> None:
            payload = sample.payload.to_bytes()
            if not full(len(payload)):
                key_text = key or str(sample.key_expr)
                in_loop(declared.call, len(payload), on_message, key_text, payload)

        declared = _BusDeclaration(self)
        return declared.declare(
            lambda session: session.declare_subscriber(pattern, direct(on_sample))
        )

    def answer(
        self,
        pattern: str,
        answer: Callable[[BusQuestion], None],
        *,
        low_priority: Callable[[str], bool] = never,
    ) -> Handle:
        def on_query(query: Any) -> None:
            question = _ZenohQuestion(self, query)
            is_late, size = low_priority(question.key), QUERY_BYTES + len(question.payload)
            if self.full(size, later=is_late):
                quietly(query.drop)
                return
            in_loop = self.call_in_loop_later if is_late else self.call_in_loop
            in_loop(declared.call, size, answer, question)

        declared = _BusDeclaration(self)
        return declared.declare(
            lambda session: session.declare_queryable(pattern, direct(on_query), complete=False)
        )

    async def ask(self, pattern: str, payload: bytes, timeout: float) -> list[tuple[str, bytes]]:
        zenoh = self._zenoh
        return await self._answers(
            lambda session, hear: session.get(
                pattern,
                hear,
                payload=payload,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=timeout,
            ),
            timeout,
        )

    async def _answers(
        self, ask: Callable[[Any, Any], None], timeout: float
    ) -> list[tuple[str, bytes]]:
        """Return all answers; ``ask(session, callback)`` sends the question."""
        session = self._session
        answers: list[tuple[str, bytes]] = []
        done = self._loop.create_future()

        def add(key: str, payload: bytes) -> None:
            answers.append((key, payload))

        def finish() -> None:
            if not done.done():
                done.set_result(None)

        def on_reply(reply: Any) -> None:
            if reply.ok is not None:
                payload = reply.ok.payload.to_bytes()
                self.call_in_loop(add, len(payload), str(reply.ok.key_expr), payload)

        if session is None:
            return answers
        on_end = functools.partial(self.call_in_loop, finish, 0)
        ask(session, direct(on_reply, on_end))
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout):
                await done
        return answers

    # ------------------------------------------------------------------ presence

    def announce(self, key: str) -> Handle:
        return _BusDeclaration(self).declare(
            lambda session: session.liveliness().declare_token(key)
        )

    async def present_keys(self, pattern: str, timeout: float) -> list[str]:
        answers = await self._answers(
            lambda session, hear: session.liveliness().get(pattern, hear, timeout=timeout), timeout
        )
        return [key for key, _ in answers]

    def watch(self, pattern: str, on_presence: Callable[[str, bool], None]) -> Handle:
        put = self._zenoh.SampleKind.PUT

        keys_present: dict[str, None] = {}

        def note_presence(key: str, present: bool) -> None:
            if present:
                keys_present[key] = None
            else:
                keys_present.pop(key, None)
            on_presence(key, present)

        def on_session_lost() -> None:  # a new session does not report who left meanwhile
            for key in [*keys_present]:
                note_presence(key, False)

        def on_sample(sample: Any) -> None:
            self.call_in_loop(
                declared.call, 0, note_presence, str(sample.key_expr), sample.kind == put
            )

        declared = _BusDeclaration(self).when_lost(on_session_lost)
        return declared.declare(
            lambda session: session.liveliness().declare_subscriber(
                pattern, direct(on_sample), history=True
            )
        )

    # ------------------------------------------------------------------ publishing

    def publish(self, publisher: Any, payload: bytes, urgent_key: str | None) -> None:
        """Send a message by a publisher.

        Args:
            publisher: Zenoh's publisher; None while its session is not open yet.
            payload: the message.
            urgent_key: key of an urgent message, see :meth:`publisher`; None otherwise.
        """
        session = self._session
        if publisher is None or session is None:
            return
        started_at = self._loop.time()
        quietly(publisher.put, payload)
        if urgent_key is not None and self._loop.time() - started_at >= ROOM_TIMEOUT:
            self._send_in_thread(
                self._queue_name(urgent_key),
                session,
                urgent_key,
                payload,
                False,
                may_be_dropped=True,
            )


class _BusDeclaration(ZenohDeclared, Handle):
    pass


class _FrequentKey(_BusDeclaration):
    """A key that is used often; from its second use on, it has a publisher.

    Args:
        connection: the connection that uses the key.
        key: the key.
        options: Zenoh's options of the publisher.
        now: loop time.

    Attributes:
        used_at: loop time of the last use.
    """

    def __init__(
        self, connection: ZenohConnection, key: str, options: dict[str, Any], now: float
    ) -> None:
        super().__init__(connection)
        self.used_at: float = now
        self._key, self._options = key, options
        self._is_declared = False

    def use_publisher(self, now: float) -> Any:
        """Return the publisher, and declare it at the first call; None while there is none."""
        self.used_at = now
        if not self._is_declared:
            self._is_declared = True
            self.declare(lambda session: session.declare_publisher(self._key, **self._options))
        return self._declaration


class _ZenohPublisher(Publisher):
    def __init__(
        self,
        connection: ZenohConnection,
        key: str,
        on_subscribers: Callable[[bool], None] | None,
        *,
        urgent: bool,
    ) -> None:
        zenoh = connection.zenoh
        self._connection = connection
        self._on_change = on_subscribers
        self._urgent_key = key if urgent else None

        def declare(session: Any) -> Any:
            return session.declare_publisher(
                key,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.INTERACTIVE_HIGH if urgent else zenoh.Priority.DATA,
                express=False,
            )

        def on_matching(status: Any) -> None:
            connection.call_in_loop_uncounted(
                self._declared.call, self._on_subscribers, status.matching
            )

        self._declared = _BusDeclaration(connection)
        self._publisher: Any = None
        self._declared.declare(lambda session: self._declare(declare(session), on_matching))

    def _declare(self, publisher: Any, on_matching: Callable[[Any], None]) -> Any:
        is_new_session, self._publisher = self._publisher is not None, publisher
        publisher.declare_matching_listener(direct(on_matching))
        has_subscribers = bool(publisher.matching_status.matching)
        if is_new_session:
            self._connection.call_in_loop_uncounted(
                self._declared.call, self._on_subscribers, has_subscribers
            )
        else:
            self.has_subscribers = has_subscribers
        return publisher

    def _on_subscribers(self, has_subscribers: bool) -> None:
        self.has_subscribers = has_subscribers
        if self._on_change is not None:
            self._on_change(has_subscribers)

    def put(self, payload: bytes) -> None:
        self._connection.publish(self._publisher, payload, self._urgent_key)

    def close(self) -> None:
        self._declared.close()


class _ZenohQuestion(BusQuestion):
    def __init__(self, connection: ZenohConnection, query: Any) -> None:
        self.key = str(query.key_expr)
        self.payload = b"" if query.payload is None else query.payload.to_bytes()
        self._connection, self._query = connection, query
        self._replies: list[tuple[str, bytes]] = []

    def reply(self, key: str, payload: bytes) -> None:
        self._replies.append((key, payload))

    def close(self) -> None:
        query, self._query = self._query, None
        if query is not None:
            self._connection.reply(
                query, self._replies, encoding=self._connection.zenoh.Encoding.APPLICATION_JSON
            )


def parse_link_address(text: str) -> tuple[str, int] | None:
    """Return address and port from Zenoh's text on a link; None if it has none."""
    match = LINK.match(text)
    return None if match is None else (plain_host(match["host"]), int(match["port"]))


def _put(session: Any, key: str, payload: bytes, options: dict[str, Any]) -> None:
    quietly(session.put, key, payload, **options)
