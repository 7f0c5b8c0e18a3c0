"""The bus between processes and hosts: Zenoh, whose binding calls back in threads of its own.

What comes is put into one queue, and a burst wakes the event loop once. Nothing is said in a way
that could make the loop wait: what does not fit into the engine's buffers is dropped there, and who
hears it finds the gap by the numbers. What is long, or much, goes out in a thread, which may wait.
"""

from __future__ import annotations

import asyncio
import collections
import contextlib
import functools
import io
import json
import logging
import os
import re
import socket
import struct
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from smartcam.exceptions import ConfigurationError, ConnectFailedError, MissingExtraError
from smartcam.fleet._bus import Bus, BusQuestion, Handle, Publisher

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping
    from typing import Self

    from smartcam.fleet._bus import Data

logger: logging.Logger = logging.getLogger("smartcam.fleet")

RUNTIME = (
    "(rx:(handover:app),acc:(handover:app),tx:(handover:app),net:(handover:app),"
    "app:(worker_threads:1))"
)
"""Zenoh's threads: one for everything, which halves the CPU time of a call; its callbacks here only
put what comes into a queue. The variable ZENOH_RUNTIME goes before it."""

LEASE = 5.0
"""Seconds until an end counts as gone that gives no sign of life; one that is killed is at once."""

INTERNET = (socket.AF_INET, socket.AF_INET6)

LONG = 1 << 16
"""Bytes beyond which something is said by a thread, which waits until the engine has taken it."""

REPLIERS = 4
"""Threads that answer queries: who asks and does not read holds up one of them."""

MOST_REPLYING = 4096
"""Queries whose answers wait for these threads; one beyond gets none."""

MOST_WAITING = 1 << 26
"""Bytes that wait for the event loop, or for the thread that says what is long; what comes beyond
is dropped, and results are asked for again later."""

CALM = 0.01
"""Seconds in which a few things are said at once, and many together."""

MOST_EXPRESS, MOST_SAID = 8, 64
"""Messages in that time that each go out at once, and those that the loop says itself. The engine
has room for 16 packets of a kind on their way: the next go in packets of many, up to a millisecond
later, and what comes then is said by the thread, for the engine would drop it."""

TURN = 64
"""Callbacks in one turn of the event loop."""

CLOSE_TIMEOUT = 5.0

_ONE = (1).to_bytes(8, sys.byteorder)


@dataclass(frozen=True)
class BusLink:
    """How an end comes to the bus.

    Attributes:
        listen: endpoints to listen on, such as ``tcp/127.0.0.1:7447``.
        connect: endpoints to connect to; with several, whichever answers.
        certificates: folder with ``ca.pem``, ``cert.pem`` and ``key.pem``, for TLS.
    """

    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    certificates: str | None = None

    @property
    def place(self) -> str:
        """Return where it is, for texts."""
        return ", ".join(self.listen or self.connect)

    def settings(self, timeout: float) -> dict[str, Any]:
        """Return the engine's settings by their paths."""
        found: dict[str, Any] = {
            # who connects only is a client of a router, which whoever listens is
            "mode": "router" if self.listen else "client",
            "listen/endpoints": list(self.listen),
            "connect/endpoints": list(self.connect),
            "connect/timeout_ms": 0,  # one try; later ones are made without end
            "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000},
            "connect/exit_on_failure": not self.listen,
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
            "scouting/delay": 0,
            "transport/shared_memory/enabled": False,
            "transport/link/tx/lease": int(1e3 * LEASE),
            "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 0,
            "transport/unicast/open_timeout": max(1, int(1e3 * timeout)),
        }
        for queue in ("data", "interactive_high", "data_low"):
            found[f"transport/link/tx/queue/size/{queue}"] = 16
        if self.certificates is not None:
            tls = f"{self.certificates.rstrip('/')}/"
            found |= {
                "transport/link/tls/root_ca_certificate": f"{tls}ca.pem",
                "transport/link/tls/enable_mtls": True,
                "transport/link/tls/connect_certificate": f"{tls}cert.pem",
                "transport/link/tls/connect_private_key": f"{tls}key.pem",
                "transport/link/tls/listen_certificate": f"{tls}cert.pem",
                "transport/link/tls/listen_private_key": f"{tls}key.pem",
                "transport/link/tls/verify_name_on_connect": True,
            }
        return found


def with_ports(endpoints: Iterable[str]) -> tuple[str, ...]:
    """Return endpoints to listen on, with a free port where one has port 0."""
    return tuple(
        f"{one.removesuffix(':0')}:{_free_port(one)}" if one.endswith(":0") else one
        for one in endpoints
    )


def _free_port(endpoint: str) -> int:
    host = endpoint.partition("/")[2].rpartition(":")[0].strip("[]")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family) as found:
        found.bind((host, 0))
        return int(found.getsockname()[1])


def _end_lingering(ports: frozenset[int]) -> None:
    """Have the engine close its connections without waiting.

    It closes one that is cut off in the thread that serves all others, which would wait there 10 s
    for an answer to what was sent last.
    """
    try:
        numbers = [int(name) for name in os.listdir("/dev/fd")]  # noqa: PTH208 - names are enough
    except OSError:
        return  # Windows, where nothing waits
    for number in numbers:
        try:
            found = socket.socket(fileno=number)
        except OSError:
            continue  # a file, or closed by now
        try:
            if found.family in INTERNET and ports & {
                found.getsockname()[1],
                found.getpeername()[1],
            }:
                found.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 0, 0))
        except OSError:
            pass  # it has no other end
        finally:
            found.detach()


@functools.cache
def _engine() -> Any:
    """Return Zenoh.

    Raises:
        MissingExtraError: it is not installed.
    """
    os.environ.setdefault("ZENOH_RUNTIME", RUNTIME)
    try:
        import zenoh
    except ImportError as exc:
        raise MissingExtraError(
            'a fleet over the network needs Zenoh, which is not installed: pip install "'
            'smartcam[fleet]"',
            extra="fleet",
        ) from exc
    return zenoh


class ZenohEnd(Bus):
    """One end of a bus that Zenoh makes.

    Args:
        link: how it comes there.
        more: further settings of the engine, by their paths.
    """

    def __init__(self, link: BusLink, more: Mapping[str, Any] | None = None) -> None:
        self._link, self._more = link, dict(more or {})
        self._zenoh = _engine()
        self._session: Any = None
        self._declared: set[_ZenohDeclared] = set()
        self._waiting: collections.deque[tuple[Callable[..., None], tuple[Any, ...], int]]
        self._waiting = collections.deque()
        self._bytes = 0
        self._woken = False
        self._bell: _LoopBell | None = None
        self._lock = threading.Lock()
        self._told_dropped = False
        self._sender: ThreadPoolExecutor | None = None
        self._sending = 0
        self._behind: collections.Counter[str] = collections.Counter()
        self._calm_since, self._said = -CALM, 0
        self._repliers: ThreadPoolExecutor | None = None
        self._replying = 0
        self._look: asyncio.TimerHandle | None = None  # for connections that linger
        zenoh = self._zenoh
        control, priority = zenoh.CongestionControl, zenoh.Priority.INTERACTIVE_HIGH
        self._dropping, self._waiting_for_room = (
            {
                express: {"priority": priority, "express": express, "congestion_control": one}
                for express in (False, True)
            }
            for one in (control.DROP, control.BLOCK)
        )
        self._behind_all = {
            "priority": zenoh.Priority.DATA_LOW,
            "express": True,
            "congestion_control": control.DROP,
        }

    # ------------------------------------------------------------------ life

    async def open(self, timeout: float) -> Self:
        self._loop = loop = asyncio.get_running_loop()
        zenoh = self._zenoh
        config = zenoh.Config()
        for path, value in {**self._link.settings(timeout), **self._more}.items():
            try:
                config.insert_json5(path, json.dumps(value))
            except zenoh.ZError as exc:
                raise ConfigurationError(f"the fleet's engine refuses {path}: {value!r}") from exc
        opening = loop.run_in_executor(None, zenoh.open, config)
        try:
            async with asyncio.timeout(timeout):
                self._session = await asyncio.shield(opening)
        except TimeoutError as exc:
            opening.add_done_callback(_close_late)
            raise self._failed(f"no answer within {timeout:g} s") from exc
        except zenoh.ZError as exc:
            raise self._failed(_reason(exc)) from exc
        except asyncio.CancelledError:
            opening.add_done_callback(_close_late)
            raise
        self._end_lingering()
        self._bell = _LoopBell.on(loop, self._drain)
        return self

    def _end_lingering(self) -> None:
        """Look at the connections now, and again before a new one can be cut off for its lease."""
        self._look = self._loop.call_later(LEASE / 2, self._end_lingering)
        endpoints = (*self._link.listen, *self._link.connect)
        ports = frozenset(int(one.rpartition(":")[2]) for one in endpoints)
        self._loop.run_in_executor(None, _end_lingering, ports)

    def _failed(self, why: str) -> ConnectFailedError:
        doing = "listen on" if self._link.listen else "reach"
        text = f"the fleet's bus: cannot {doing} {self._link.place}: {why}"
        return ConnectFailedError(text, attempts=(why,))

    async def close(self) -> None:
        session, self._session = self._session, None
        if self._look is not None:
            self._look.cancel()
        self._waiting.clear()
        self._bytes = 0
        bell, self._bell = self._bell, None
        if bell is not None:
            bell.close()
        if session is None:
            return
        for one in tuple(self._declared):
            one.close()
        threads = [one for one in (self._sender, self._repliers) if one is not None]
        self._sender = self._repliers = None
        closing = self._loop.run_in_executor(None, _end, session, threads)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(CLOSE_TIMEOUT):
                await asyncio.shield(closing)

    # ------------------------------------------------------------------ to the loop

    def _in_loop(self, call: Callable[..., None], size: int, *arguments: Any) -> None:
        """Have something called in the event loop, in order; for any thread."""
        with self._lock:
            self._waiting.append((call, arguments, size))
            self._bytes += size
            if self._woken:
                return
            self._woken = True
        self._wake()

    def _wake(self) -> None:
        bell = self._bell
        if bell is not None:
            bell.ring()
            return
        with contextlib.suppress(RuntimeError):  # the loop is closed, and nobody hears any more
            self._loop.call_soon_threadsafe(self._drain)

    def _drain(self) -> None:
        waiting = self._waiting
        for _ in range(TURN):
            try:
                call, arguments, size = waiting.popleft()
            except IndexError:
                break
            with self._lock:
                self._bytes -= size
            try:
                call(*arguments)
            except Exception:
                logger.exception("%s ! what came from the bus was not taken", self._link.place)
        with self._lock:
            self._woken = bool(waiting)
        if self._woken:
            self._loop.call_soon(self._drain)

    def _full(self, size: int) -> bool:
        """Whether the loop is so far behind that what can be asked for again is dropped."""
        if self._bytes + size <= MOST_WAITING:
            return False
        if not self._told_dropped:
            self._told_dropped = True
            logger.warning(
                "%s ! this program does not read: %d bytes wait; more is dropped",
                self._link.place,
                self._bytes,
            )
        return True

    # ------------------------------------------------------------------ what is said

    def put(self, key: str, payload: bytes) -> None:
        session = self._session
        if session is None:
            return
        now = self._loop.time()
        if now - self._calm_since > CALM:
            self._calm_since, self._said = now, 0
        self._said += 1
        # what is said by itself goes out at once, a burst together: there is not room for many
        express = self._said <= MOST_EXPRESS
        way = key if self._link.listen else ""  # a router has one to each who listens
        if len(payload) > LONG or self._said > MOST_SAID or way in self._behind:
            self._hand_over(way, session, key, payload, self._waiting_for_room[express])
            return
        try:
            session.put(key, payload, **self._dropping[express])
        except self._zenoh.ZError as exc:  # it ends meanwhile
            logger.debug("the fleet's bus: %s", exc)

    def put_part(self, key: str, head: bytes, data: Data) -> None:
        if self._session is not None:
            said = bytes(data) if isinstance(data, memoryview) else data
            _quietly(self._session.put, key, said, attachment=head, **self._behind_all)

    def subscribe_parts(self, pattern: str, hear: Callable[[str, bytes, Data], None]) -> Handle:
        def on_sample(sample: Any) -> None:
            head = sample.attachment
            data = sample.payload.to_bytes()
            if head is not None and not self._full(len(data)):
                said, key = head.to_bytes(), str(sample.key_expr)
                self._in_loop(declared.call, len(data), hear, key, said, data)

        declared = _ZenohDeclared(self)
        return declared.of(lambda session: session.declare_subscriber(pattern, _direct(on_sample)))

    def _hand_over(
        self, way: str, session: Any, key: str, payload: bytes, how: dict[str, Any]
    ) -> None:
        """Have a thread say it, which waits until there is room; what goes the same way, too."""
        if self._sender is None:
            self._sender = ThreadPoolExecutor(1, "smartcam-fleet")
        size = len(payload)
        if self._sending + size > MOST_WAITING:
            logger.warning("%s ! %d bytes wait to be said; more is dropped", key, self._sending)
            return

        def say() -> None:
            _put(session, key, payload, how)
            with self._lock:
                self._sending -= size
                self._behind[way] -= 1
                if not self._behind[way]:
                    del self._behind[way]

        with self._lock:
            self._sending += size
            self._behind[way] += 1
        self._sender.submit(say)

    def reply(self, query: Any, replies: list[tuple[str, bytes]]) -> None:
        """Answer a query, and end it; never waits.

        The engine may wait for who has asked, as that one has said in the query; so threads do it.
        """
        if self._session is None or not replies or self._replying >= MOST_REPLYING:
            _quietly(query.drop)
            return
        if self._repliers is None:
            self._repliers = ThreadPoolExecutor(REPLIERS, "smartcam-fleet-reply")
        with self._lock:
            self._replying += 1
        encoding = self._zenoh.Encoding.APPLICATION_JSON
        self._repliers.submit(_reply, query, replies, encoding).add_done_callback(self._replied)

    def _replied(self, _: object) -> None:
        with self._lock:
            self._replying -= 1

    def publisher(
        self, key: str, on_heard: Callable[[bool], None] | None = None, *, urgent: bool = False
    ) -> Publisher:
        return _ZenohPublisher(self, key, on_heard, urgent=urgent)

    def subscribe(self, pattern: str, hear: Callable[[str, bytes], None]) -> Handle:
        in_loop, full = self._in_loop, self._full

        key = None if "*" in pattern else pattern  # which saves asking for it

        def on_sample(sample: Any) -> None:
            payload = sample.payload.to_bytes()
            if not full(len(payload)):
                said = key or str(sample.key_expr)
                in_loop(declared.call, len(payload), hear, said, payload)

        declared = _ZenohDeclared(self)
        return declared.of(lambda session: session.declare_subscriber(pattern, _direct(on_sample)))

    def answer(self, pattern: str, answer: Callable[[BusQuestion], None]) -> Handle:
        def on_query(query: Any) -> None:
            self._in_loop(declared.call, 0, answer, _ZenohQuestion(self, query))

        declared = _ZenohDeclared(self)
        return declared.of(
            lambda session: session.declare_queryable(pattern, _direct(on_query), complete=False)
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
        """Return what all answer; ``ask`` is given the session and what hears them."""
        zenoh, session = self._zenoh, self._session
        answers: list[tuple[str, bytes]] = []
        done = self._loop.create_future()

        def add(key: str, payload: bytes) -> None:
            answers.append((key, payload))

        def end() -> None:
            if not done.done():
                done.set_result(None)

        def on_reply(reply: Any) -> None:
            if reply.ok is not None:
                payload = reply.ok.payload.to_bytes()
                self._in_loop(add, len(payload), str(reply.ok.key_expr), payload)

        if session is None:
            return answers
        ended = functools.partial(self._in_loop, end, 0)
        ask(session, zenoh.handlers.Callback(on_reply, ended, indirect=False))
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout):
                await done
        return answers

    # ------------------------------------------------------------------ who is there

    def be_present(self, key: str) -> Handle:
        return _ZenohDeclared(self).of(lambda session: session.liveliness().declare_token(key))

    async def present(self, pattern: str, timeout: float) -> list[str]:
        found = await self._answers(
            lambda session, hear: session.liveliness().get(pattern, hear, timeout=timeout), timeout
        )
        return [key for key, _ in found]

    def watch(self, pattern: str, see: Callable[[str, bool], None]) -> Handle:
        put = self._zenoh.SampleKind.PUT

        def on_sample(sample: Any) -> None:
            self._in_loop(declared.call, 0, see, str(sample.key_expr), sample.kind == put)

        declared = _ZenohDeclared(self)
        return declared.of(
            lambda session: session.liveliness().declare_subscriber(
                pattern, _direct(on_sample), history=True
            )
        )

    # ------------------------------------------------------------------ for what is declared

    def declare(self, one: _ZenohDeclared, how: Callable[[Any], Any]) -> Any:
        """Declare something at the engine; it is closed with this end."""
        if self._session is None:
            raise ConfigurationError("the fleet's bus is not open")
        made = how(self._session)
        self._declared.add(one)
        return made

    def forget(self, one: _ZenohDeclared) -> None:
        """It is closed."""
        self._declared.discard(one)

    def publish(self, publisher: Any, payload: bytes) -> None:
        """Have a publisher say something."""
        _quietly(publisher.put, payload)

    @property
    def engine(self) -> Any:
        """The module."""
        return self._zenoh

    def later(self, call: Callable[..., None], *arguments: Any) -> None:
        """Call something in the event loop; for any thread."""
        self._in_loop(call, 0, *arguments)


class _LoopBell:
    """Wakes an event loop from any thread; for less than its own ``call_soon_threadsafe``.

    Args:
        loop: the loop.
        call: what it calls then.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, call: Callable[[], None]) -> None:
        # a file, as its number may be another's when it is closed, and an object knows that
        self._file = io.FileIO(os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC), "r+")
        self._loop, self._call = loop, call
        loop.add_reader(self._file.fileno(), self._hear)

    @classmethod
    def on(cls, loop: asyncio.AbstractEventLoop, call: Callable[[], None]) -> _LoopBell | None:
        """Return a bell; None where the system or the loop has nothing for it."""
        if sys.platform != "linux":
            return None
        with contextlib.suppress(NotImplementedError, OSError):
            return cls(loop, call)
        return None

    def ring(self) -> None:
        """Have the loop call; once, however often it is rung before."""
        with contextlib.suppress(ValueError):  # it is closed, and nobody hears any more
            self._file.write(_ONE)

    def _hear(self) -> None:
        self._file.read(8)
        self._call()

    def close(self) -> None:
        """Wake nobody any more. Idempotent."""
        if not self._file.closed:
            self._loop.remove_reader(self._file.fileno())
            self._file.close()


class _ZenohDeclared(Handle):
    def __init__(self, end: ZenohEnd) -> None:
        self._end = end
        self._closed = False
        self._it: Any = None

    def of(self, how: Callable[[Any], Any]) -> Self:
        self._it = self._end.declare(self, how)
        return self

    def call(self, call: Callable[..., None], *arguments: Any) -> None:
        """Call back, unless it was closed meanwhile."""
        if not self._closed:
            call(*arguments)

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            self._end.forget(self)
            _quietly(self._it.undeclare)


class _ZenohPublisher(Publisher):
    def __init__(
        self, end: ZenohEnd, key: str, on_heard: Callable[[bool], None] | None, *, urgent: bool
    ) -> None:
        zenoh = end.engine
        self._end = end
        self._heard = False
        self._told = on_heard

        def declare(session: Any) -> Any:
            return session.declare_publisher(
                key,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.INTERACTIVE_HIGH if urgent else zenoh.Priority.DATA,
                express=False,
            )

        def on_matching(status: Any) -> None:
            end.later(self._declared.call, self._on_heard, status.matching)

        self._declared = _ZenohDeclared(end)
        self._publisher: Any = None
        self._declared.of(lambda session: self._declare(declare(session), on_matching))

    def _declare(self, publisher: Any, on_matching: Callable[[Any], None]) -> Any:
        self._publisher = publisher
        publisher.declare_matching_listener(_direct(on_matching))
        self._heard = publisher.matching_status.matching
        return publisher

    def _on_heard(self, heard: bool) -> None:
        if heard != self._heard:
            self._heard = heard
        if self._told is not None:
            self._told(heard)

    @property
    def heard(self) -> bool:
        return self._heard

    def put(self, payload: bytes) -> None:
        self._end.publish(self._publisher, payload)

    def close(self) -> None:
        self._declared.close()


class _ZenohQuestion(BusQuestion):
    def __init__(self, end: ZenohEnd, query: Any) -> None:
        self.key = str(query.key_expr)
        self.payload = b"" if query.payload is None else query.payload.to_bytes()
        self._end, self._query = end, query
        self._replies: list[tuple[str, bytes]] = []

    def reply(self, key: str, payload: bytes) -> None:
        self._replies.append((key, payload))

    def close(self) -> None:
        query, self._query = self._query, None
        if query is not None:
            self._end.reply(query, self._replies)


def _reply(query: Any, replies: list[tuple[str, bytes]], encoding: Any) -> None:
    for key, payload in replies:
        _quietly(query.reply, key, payload, encoding=encoding, express=True)
    _quietly(query.drop)


def _end(session: Any, threads: list[ThreadPoolExecutor]) -> None:
    """Say what is to be said yet, then end the session."""
    for one in threads:
        one.shutdown()
    session.close()


def _direct(call: Callable[[Any], None]) -> Any:
    """Have a callback called in the engine's own thread: by default each has a thread."""
    return _engine().handlers.Callback(call, indirect=False)


def _put(session: Any, key: str, payload: bytes, how: dict[str, Any]) -> None:
    _quietly(session.put, key, payload, **how)


def _quietly(call: Callable[..., Any], *arguments: Any, **named: Any) -> None:
    """Do something at the engine; a session that ends meanwhile is no error of the caller's."""
    try:
        call(*arguments, **named)
    except _engine().ZError as exc:
        logger.debug("the fleet's bus: %s", exc)


def _close_late(opening: asyncio.Future[Any]) -> None:
    """Close a session that came after nobody wanted it any more."""
    if not opening.cancelled() and opening.exception() is None:
        threading.Thread(target=opening.result().close, daemon=True).start()


def _reason(error: Exception) -> str:
    """Return what the engine says without its source's places, or the system's own words."""
    text = str(error).partition(" at /")[0].strip(" .")
    system = re.search(r": ([^:]+) \(os error \d+\)", text)
    if system is not None:
        return system[1]
    return "nothing there answers as a fleet's bus" if "Unable to connect" in text else text
