"""Use a session of Zenoh in an event loop, although Zenoh calls back in threads of its own.

The callbacks put received messages into one queue. A burst of messages wakes the event loop once.
A "participant" is a program that has a session on the bus. Callbacks "for later" run only after all
other callbacks.
"""

from __future__ import annotations

import asyncio
import collections
import contextlib
import ctypes
import errno
import functools
import io
import json
import logging
import os
import random
import re
import socket
import struct
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from smartcam._extras import load
from smartcam._forks import notify_of_forks
from smartcam._user_code import ENDS_PROGRAM
from smartcam.exceptions import (
    ConfigurationError,
    ConnectFailedError,
    LocalProtocolError,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping
    from typing import Self

logger: logging.Logger = logging.getLogger("smartcam.fleet")

RUNTIME = (
    "(rx:(handover:app),acc:(handover:app),net:(worker_threads:2),tx:(worker_threads:1),"
    "app:(worker_threads:1))"
)
"""Zenoh's threads: as few as possible, which halves the CPU time of a call; callbacks only put
messages into a queue. Sending has a thread of its own: if an answer exceeds a queue (128 KiB,
such as the tokens of 20 nodes of ROS), the receiving thread waits for the sending thread. If both
were one, it would wait for itself until the link is given up. Tasks inside Zenoh have two threads:
when a latched publisher is closed, the binding waits for such a task and blocks all threads of
Python, including the thread that is to call back. The variable ZENOH_RUNTIME overrides these
numbers."""

LEASE_TIME = 5.0
"""Seconds without a sign of life after which a participant counts as gone. If its process was
killed, it counts as gone at once."""

MAX_LISTING_TIME = 120.0
"""Seconds after which Zenoh treats a list of presences as complete. Zenoh's own default
is 10; to list thousands of presences on a busy machine takes longer."""

PORTS = range(20_000, 32_000)
"""The ports tried for port 0, below the range from which systems give ports to connections.

So no connection of another program takes a port between the test that it is free and Zenoh's
use of it.
"""

INTERNET = (socket.AF_INET, socket.AF_INET6)

ROOM_TIMEOUT = 0.001
"""Seconds that Zenoh waits for room in a queue before it drops a message that may be dropped. It
waits only once: until it can send something to the same participant again, it drops further
messages of that priority at once."""

MAX_WAITING_BYTES = 1 << 26
"""Largest number of bytes in each of the queues: for the event loop, for its callbacks for later,
and for the thread that sends long replies. More is dropped; results are requested again later."""

QUERY_BYTES = 256
"""Bytes that a query counts in addition to its payload."""

REPLY_THREADS = 4
"""Threads that answer queries; a client that does not read its answer blocks one of them."""

MAX_WAITING_QUERIES = 4096
"""Largest number of queries that may wait for an answering thread; further ones get no answer."""

CALLBACKS_PER_TURN = 64
"""Callbacks that run in one turn of the event loop."""

LATER_CALLBACKS_PER_TURN = 8
"""Callbacks for later that run after the others in one turn of the event loop.

So a flood of them delays other work only by the time that these few take.
"""

CLOSE_TIMEOUT = 5.0

PEER_ENDPOINT = "tcp/127.0.0.1:0"
"""Endpoint on which a peer listens for direct links from other peers on this host."""

ROUTER_TIMEOUT = 3.0
"""Seconds that a peer waits for a router before it goes on without one."""

NOT_ZENOH = "nothing there speaks Zenoh"

MAX_DECLARED_AT_ONCE = 32
"""Largest number of declarations made in one turn of the event loop."""

_RING = (1).to_bytes(8, sys.byteorder)

_CALLBACK_FAILED = "%s ! a message from the bus was not handled: its callback failed"


@dataclass(frozen=True)
class BusLink:
    """The endpoints by which a participant joins the bus.

    Attributes:
        listen: endpoints to listen on, such as ``tcp/127.0.0.1:7447``.
        connect: endpoints to connect to; of several, one that answers is used.
        certificates: folder with ``ca.pem``, ``cert.pem`` and ``key.pem``, for TLS.
        peer: True if a participant that only connects is a peer. A peer, such as a node of
            rmw_zenoh, also has direct links to the participants that it finds on this host, and
            keeps working without the routers at ``connect``.
    """

    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    certificates: str | None = None
    peer: bool = False

    @property
    def mode(self) -> str:
        """Zenoh's mode: "router" if it listens, else "peer" or "client"."""
        return "router" if self.listen else "peer" if self.peer else "client"

    @property
    def endpoints_text(self) -> str:
        """The endpoints to listen on as a text, or, without them, those to connect to."""
        return ", ".join(self.listen or self.connect)

    def settings(self, timeout: float) -> dict[str, Any]:
        """Return Zenoh's settings by their paths."""
        settings: dict[str, Any] = {
            "mode": self.mode,
            "listen/endpoints": [PEER_ENDPOINT] if self.mode == "peer" else list(self.listen),
            "connect/endpoints": list(self.connect),
            # 0: one try, then Zenoh tries again later; a peer does so only with -1, no timeout
            "connect/timeout_ms": -1 if self.mode == "peer" else 0,
            "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000},
            "connect/exit_on_failure": self.mode == "client",
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
            "scouting/delay": 0,
            "transport/shared_memory/enabled": False,
            "transport/link/tx/lease": int(1e3 * LEASE_TIME),
            "transport/link/tx/queue/congestion_control/drop/wait_before_drop": int(
                1e6 * ROOM_TIMEOUT
            ),
            "routing/interests/timeout": int(1e3 * MAX_LISTING_TIME),
            # also for each later try: a try that began while a cable was cut sends its packets less
            # and less often, so a long timeout would delay the next successful try
            "transport/unicast/open_timeout": max(1, int(1e3 * min(timeout, LEASE_TIME))),
        }
        for queue in ("control", "data", "interactive_high", "data_low"):
            settings[f"transport/link/tx/queue/size/{queue}"] = 16
        if self.certificates is not None:
            tls = f"{self.certificates.rstrip('/')}/"
            settings |= {
                "transport/link/tls/root_ca_certificate": f"{tls}ca.pem",
                "transport/link/tls/enable_mtls": True,
                "transport/link/tls/connect_certificate": f"{tls}cert.pem",
                "transport/link/tls/connect_private_key": f"{tls}key.pem",
                "transport/link/tls/listen_certificate": f"{tls}cert.pem",
                "transport/link/tls/listen_private_key": f"{tls}key.pem",
                "transport/link/tls/verify_name_on_connect": True,
            }
        return settings


def with_ports(endpoints: Iterable[str]) -> tuple[str, ...]:
    """Return endpoints to listen on, with a free port in place of port 0."""
    return tuple(
        f"{endpoint.removesuffix(':0')}:{_free_port(endpoint)}"
        if endpoint.endswith(":0")
        else endpoint
        for endpoint in endpoints
    )


def _free_port(endpoint: str) -> int:
    """Return a free port; if the host is not this machine, Zenoh reports it later."""
    host = endpoint.partition("/")[2].rpartition(":")[0].strip("[]")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    ports = random.SystemRandom().sample(PORTS, 100)
    for port in ports:
        try:
            with socket.socket(family) as sock:
                sock.bind((host, port))
        except OSError as exc:
            if exc.errno in {errno.EADDRINUSE, errno.EACCES}:
                continue
        return port
    return ports[0]


def _disable_linger(ports: frozenset[int]) -> None:
    """Make Zenoh close its connections without waiting for data that is still unsent.

    Otherwise the thread that serves all connections waits 10 s when it closes a connection that is
    cut off, for the acknowledgement of the last data.
    """
    try:
        numbers = [int(name) for name in os.listdir("/dev/fd")]  # noqa: PTH208 - names are enough
    except OSError:
        return  # Windows, on which nothing has to wait
    for number in numbers:
        try:
            sock = socket.socket(fileno=number)
        except OSError:
            continue  # a file, or closed by now
        try:
            if sock.family in INTERNET and ports & {sock.getsockname()[1], sock.getpeername()[1]}:
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 0, 0))
        except OSError:
            pass  # the socket has no peer
        finally:
            sock.detach()


@functools.cache
def load_zenoh() -> Any:
    """Return Zenoh.

    Raises:
        MissingExtraError: Zenoh is not installed.
    """
    os.environ.setdefault("ZENOH_RUNTIME", RUNTIME)
    return load("zenoh")


class _ZenohUse:
    """Records whether this process has had a session: then Zenoh's threads run in it."""

    def __init__(self) -> None:
        self.has_begun: bool = False
        self.is_forked: bool = False
        notify_of_forks(self)

    def on_fork(self) -> None:
        """Note in a fork that Zenoh's threads do not run there."""
        self.is_forked = self.has_begun


_use = _ZenohUse()


class ZenohSession:
    """A session whose callbacks run in one event loop.

    Args:
        link: endpoints and certificates that the session uses.
        more: further settings of Zenoh, by their paths: "transport/link/tx/lease".
        bus_name: name of the bus in texts.
    """

    def __init__(
        self,
        link: BusLink,
        more: Mapping[str, Any] | None = None,
        bus_name: str = "the fleet's bus",
    ) -> None:
        self._link, self._extra_settings, self._bus_name = link, dict(more or {}), bus_name
        self._zenoh = load_zenoh()
        self._session: Any = None
        self._declared: dict[ZenohDeclared, None] = {}  # declarations in their order
        self._waiting: collections.deque[tuple[Callable[..., None], tuple[Any, ...], int]]
        self._waiting = collections.deque()
        self._waiting_later = self._waiting.copy()
        # bytes of all calls that were queued, counted in any thread; and of those that were handled
        self._queued_bytes = self._queued_later_bytes = 0
        self._handled_bytes = self._handled_later_bytes = 0
        self._wake_pending = False
        self._bell: _LoopBell | None = None
        self._lock = threading.Lock()
        self._reported_dropped = False
        self._repliers: ThreadPoolExecutor | None = None
        self._reply_count = 0
        self._reopening = False
        self._linger_timer: asyncio.TimerHandle | None = None  # disables linger again

    # ------------------------------------------------------------------ life

    async def open(self, timeout: float) -> Self:
        """Open the session.

        Raises:
            ConnectFailedError: the session cannot listen, or reach another participant, within
                ``timeout`` seconds.
            ConfigurationError: Zenoh refuses a setting.
            LocalProtocolError: this process is a fork of one that had a session before.
        """
        if _use.is_forked:
            raise LocalProtocolError(
                f"{self._bus_name}: this process is a fork of one in which Zenoh's threads "
                "run, and it has none of them: start it by another method, such as "
                "multiprocessing's 'spawn', or before the first session"
            )
        _use.has_begun = True
        self._loop = asyncio.get_running_loop()
        await self._open(timeout)
        self._keep_linger_disabled()
        self._forget_waiting()
        self._wake_pending = False
        self._bell = _LoopBell.on(self._loop, self._drain)
        return self

    async def _open(self, timeout: float) -> None:
        loop = self._loop
        try:
            async with asyncio.timeout(timeout):
                while self._session is None:
                    begun_at = loop.time()
                    try:
                        self._session = await self._open_zenoh_session(timeout)
                    except self._zenoh.ZError as exc:
                        # Zenoh gives up a silent one after a lease; then try the others again
                        if loop.time() - begun_at < 0.9 * min(timeout, LEASE_TIME):
                            raise self._connect_error(await self._failure_reason(exc)) from exc
        except TimeoutError as exc:
            raise self._connect_error(f"no answer within {timeout:g} s") from exc
        if self._link.mode == "peer":
            await self._wait_for_router(min(timeout, ROUTER_TIMEOUT))

    async def _wait_for_router(self, timeout: float) -> None:
        """Wait for a router, so that later queries reach everybody; warn if none comes in time."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout):
                while not self._session.info.routers_zid():  # noqa: ASYNC110 - nothing tells of it
                    await asyncio.sleep(0.02)
                return
        logger.warning(
            "%s ! no router at %s yet: programs behind it can be reached once it runs",
            self._bus_name,
            self._link.endpoints_text,
        )

    async def _open_zenoh_session(self, timeout: float) -> Any:
        """Open a Zenoh session; close it if it opens only after the caller has given up."""
        zenoh = self._zenoh
        config = zenoh.Config()
        settings = {**self._link.settings(timeout), **self._extra_settings}
        for path, value in settings.items():
            try:
                config.insert_json5(path, json.dumps(value))
            except zenoh.ZError as exc:
                raise ConfigurationError(
                    f"{self._bus_name}: Zenoh refuses {path}: {value!r}"
                ) from exc
        opening = self._loop.run_in_executor(None, zenoh.open, config)
        try:
            return await asyncio.shield(opening)
        except asyncio.CancelledError:
            opening.add_done_callback(functools.partial(_close_late, self._link.mode != "client"))
            raise

    async def reopen(self, timeout: float) -> None:
        """Replace this session by a new one, with all declarations.

        The other participants see this one leave and return; nothing is sent or received in
        between. Declarations that are requested meanwhile are made with the new session.

        Raises:
            ConnectFailedError: the session cannot listen again within ``timeout`` seconds; there is
                no session until the next call succeeds.

        Cancellation: leaves no session either, until the next call succeeds.
        """
        session, self._session = self._session, None
        if session is not None:
            self._reopening = True
            lost = [declared.detach() for declared in tuple(self._declared)]
            closing = self._loop.run_in_executor(
                None, _end_and_release, session, lost, self._link.mode != "client"
            )
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(CLOSE_TIMEOUT):
                    await asyncio.shield(closing)
        if not self._reopening:
            raise ConfigurationError(f"{self._bus_name} is not open")
        await self._open(timeout)
        for index, declared in enumerate(tuple(self._declared)):
            if index % MAX_DECLARED_AT_ONCE == 0:
                await asyncio.sleep(0)
            declared.redeclare()
        self._reopening = False

    def _keep_linger_disabled(self) -> None:
        """Keep Zenoh's connections from lingering; again and again, for new ones."""
        self._linger_timer = self._loop.call_later(LEASE_TIME / 2, self._keep_linger_disabled)
        endpoints = (*self._link.listen, *self._link.connect)
        ports = frozenset(int(endpoint.rpartition(":")[2]) for endpoint in endpoints)
        self._loop.run_in_executor(None, _disable_linger, ports)

    async def _failure_reason(self, error: Exception) -> str:
        """Return why nobody was reached; Zenoh does not say that a name does not resolve."""
        reason = _reason(error)
        for endpoint in self._link.connect if reason == NOT_ZENOH else ():
            host = endpoint.partition("/")[2].rpartition(":")[0].strip("[]")
            try:
                await self._loop.getaddrinfo(host, None)
            except OSError as exc:
                return f"the name {host!r} does not resolve: {exc.strerror}"
        return reason

    def _connect_error(self, reason: str) -> ConnectFailedError:
        verb = "listen on" if self._link.listen else "reach"
        text = f"{self._bus_name}: cannot {verb} {self._link.endpoints_text}: {reason}"
        return ConnectFailedError(text, attempts=(reason,))

    async def close(self) -> None:
        """Close the session, and with it all declarations. Idempotent."""
        session, self._session = self._session, None
        self._reopening = False
        if self._linger_timer is not None:
            self._linger_timer.cancel()
        self._forget_waiting()
        bell, self._bell = self._bell, None
        if bell is not None:
            bell.close()
        if session is None:
            return
        for declared in tuple(self._declared):
            declared.close()
        closing = self._loop.run_in_executor(
            None, _end_session, session, self._threads(), self._link.mode != "client"
        )
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(CLOSE_TIMEOUT):
                await asyncio.shield(closing)

    def _threads(self) -> list[ThreadPoolExecutor]:
        """Return the pools of threads that still send; they finish before the session ends."""
        repliers, self._repliers = self._repliers, None
        return [] if repliers is None else [repliers]

    # ------------------------------------------------------------------ to the loop

    def _forget_waiting(self) -> None:
        self._waiting.clear()
        self._waiting_later.clear()
        self._handled_bytes, self._handled_later_bytes = (
            self._queued_bytes,
            self._queued_later_bytes,
        )

    def call_in_loop(self, call: Callable[..., None], size: int, *arguments: Any) -> None:
        """Schedule a call in the event loop, in order; from any thread."""
        with self._lock:
            self._waiting.append((call, arguments, size))
            self._queued_bytes += size
            if self._wake_pending:
                return
            self._wake_pending = True
        self._wake()

    def call_in_loop_later(self, call: Callable[..., None], size: int, *arguments: Any) -> None:
        """Schedule a call like :meth:`call_in_loop`, but after all other calls."""
        with self._lock:
            self._waiting_later.append((call, arguments, size))
            self._queued_later_bytes += size
            if self._wake_pending:
                return
            self._wake_pending = True
        self._wake()

    def _wake(self) -> None:
        bell = self._bell
        if bell is not None:
            bell.ring()
            return
        with contextlib.suppress(RuntimeError):  # the loop is closed
            self._loop.call_soon_threadsafe(self._drain)

    def _drain(self) -> None:
        waiting, later = self._waiting, self._waiting_later
        for _ in range(CALLBACKS_PER_TURN):
            if not waiting:
                break
            call, arguments, size = waiting.popleft()
            self._handled_bytes += size
            try:
                call(*arguments)
            except ENDS_PROGRAM:
                self._loop.call_soon(self._drain)
                raise
            except BaseException:
                logger.exception(_CALLBACK_FAILED, self._link.endpoints_text)
        for _ in range(min(LATER_CALLBACKS_PER_TURN, len(later))):
            if not later:
                break
            call, arguments, size = later.popleft()
            self._handled_later_bytes += size
            try:
                call(*arguments)
            except ENDS_PROGRAM:
                self._loop.call_soon(self._drain)
                raise
            except BaseException:
                logger.exception(_CALLBACK_FAILED, self._link.endpoints_text)
        with self._lock:
            self._wake_pending = bool(waiting or later)
        if self._wake_pending:
            self._loop.call_soon(self._drain)

    def full(self, size: int, *, later: bool = False) -> bool:
        """Return True if too many bytes wait for the loop, so that a message has to be dropped."""
        if later:
            waiting = self._queued_later_bytes - self._handled_later_bytes
        else:
            waiting = self._queued_bytes - self._handled_bytes
        if waiting + size <= MAX_WAITING_BYTES:
            return False
        if not self._reported_dropped:
            self._reported_dropped = True
            logger.warning(
                "%s ! this program does not read: %d bytes wait; more is dropped",
                self._link.endpoints_text,
                waiting,
            )
        return True

    def reply(self, query: Any, replies: list[tuple[str, bytes]], **options: Any) -> None:
        """Answer a query, and end it; never waits.

        A thread sends the replies, since Zenoh may wait for the program that asked.

        Args:
            query: query of Zenoh.
            replies: keys and their payloads.
            **options: Zenoh's options of a reply.
        """
        if replies:
            self._run_in_replier(query, _reply, query, replies, options)
        else:
            quietly(query.drop)

    def refuse(self, query: Any, reason: str) -> None:
        """Answer a query with an error, and end it; never waits."""
        self._run_in_replier(query, _refuse, query, reason)

    def _run_in_replier(self, query: Any, call: Callable[..., None], *arguments: Any) -> None:
        if self._session is None or self._reply_count >= MAX_WAITING_QUERIES:
            quietly(query.drop)
            return
        if self._repliers is None:
            self._repliers = ThreadPoolExecutor(REPLY_THREADS, "smartcam-fleet-reply")
        with self._lock:
            self._reply_count += 1
        self._repliers.submit(call, *arguments).add_done_callback(self._on_replied)

    def _on_replied(self, _: object) -> None:
        with self._lock:
            self._reply_count -= 1

    def declare(self, declared: ZenohDeclared, make: Callable[[Any], Any]) -> Any:
        """Make a declaration at Zenoh, and remember it; it is closed with this session.

        Args:
            declared: the owner of the declaration.
            make: function that gets Zenoh's session, and returns Zenoh's declaration.

        Returns:
            Zenoh's declaration; None while the session is reopened, which makes it later.
        """
        declaration = None if self._reopening else make(self.session)
        self._declared[declared] = None
        return declaration

    def forget(self, declared: ZenohDeclared) -> None:
        """Forget a declaration that was closed, so that the session does not close it."""
        self._declared.pop(declared, None)

    @property
    def session(self) -> Any:
        """Zenoh's session.

        Raises:
            ConfigurationError: the session is not open.
        """
        if self._session is None:
            raise ConfigurationError(f"{self._bus_name} is not open")
        return self._session

    @property
    def opened(self) -> bool:
        """True while the session is open."""
        return self._session is not None

    @property
    def zenoh(self) -> Any:
        """Zenoh's module."""
        return self._zenoh

    def call_in_loop_uncounted(self, call: Callable[..., None], *arguments: Any) -> None:
        """Schedule a call in the event loop, without counted bytes; from any thread."""
        self.call_in_loop(call, 0, *arguments)


class _LoopBell:
    """Wakes an event loop from any thread; cheaper than its own ``call_soon_threadsafe``.

    Args:
        loop: the loop.
        call: function that the loop calls after :meth:`ring`.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, call: Callable[[], None]) -> None:
        # a file object knows that it is closed; its descriptor may be another file's by then
        self._file = io.FileIO(os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC), "r+")
        self._loop, self._call = loop, call
        loop.add_reader(self._file.fileno(), self._on_ring)

    @classmethod
    def on(cls, loop: asyncio.AbstractEventLoop, call: Callable[[], None]) -> _LoopBell | None:
        """Return a bell; None if the system or the loop does not support it."""
        if sys.platform != "linux":
            return None
        with contextlib.suppress(NotImplementedError, OSError):
            return cls(loop, call)
        return None

    def ring(self) -> None:
        """Make the loop call the function; several rings before that cause only one call."""
        try:  # noqa: SIM105 - each message does this, and suppress() costs as much as the rest
            self._file.write(_RING)
        except (ValueError, OSError):  # the bell is closed
            pass

    def _on_ring(self) -> None:
        self._file.read(8)
        self._call()

    def close(self) -> None:
        """Stop waking the loop. Idempotent."""
        if not self._file.closed:
            self._loop.remove_reader(self._file.fileno())
            self._file.close()


class ZenohDeclared:
    """A declaration at Zenoh, until this object or its session is closed.

    Args:
        owner: the session for the declaration.
        by_dropping: True if Zenoh's declaration ends by dropping its only reference, which is
            this object's. To undeclare an advanced publisher or subscriber, the binding holds
            Python's lock while it waits for a thread that may wait for that lock; to drop it, the
            binding releases the lock.
    """

    def __init__(self, owner: ZenohSession, *, by_dropping: bool = False) -> None:
        self._by_dropping = by_dropping
        self._owner = owner
        self._closed = False
        self._declaration: Any = None
        self._make: Callable[[Any], Any] = _declare_nothing
        self._on_lost: Callable[[], None] | None = None

    def declare(self, make: Callable[[Any], Any]) -> Self:
        """Make the declaration: ``make`` gets Zenoh's session, and returns the declaration."""
        self._make = make
        self._declaration = self._owner.declare(self, make)
        return self

    def when_lost(self, call: Callable[[], None]) -> Self:
        """Set the function that the event loop calls when the session is replaced by a new one."""
        self._on_lost = call
        return self

    def detach(self) -> Any:
        """Prepare for the end of the session; return the declaration to keep until that end."""
        declaration, self._declaration = self._declaration, None
        if self._on_lost is not None:
            self._owner.call_in_loop_uncounted(self.call, self._on_lost)
        return None if self._by_dropping else declaration

    def redeclare(self) -> None:
        """Make the declaration again with the new session."""
        if not self._closed and self._declaration is None:
            self._declaration = self._make(self._owner.session)

    def call(self, call: Callable[..., None], *arguments: Any) -> None:
        """Call a function, unless the declaration was closed meanwhile."""
        if not self._closed:
            call(*arguments)

    def close(self) -> None:
        """End the declaration. Idempotent."""
        if not self._closed:
            self._closed = True
            self._owner.forget(self)
            declaration, self._declaration = self._declaration, None
            if not self._by_dropping and declaration is not None:
                quietly(declaration.undeclare)


def _end_and_release(session: Any, declarations: list[Any], is_kept: bool) -> None:
    _end_session(session, [], is_kept)
    declarations.clear()  # this is slow while the session is open


def _declare_nothing(_: Any) -> None:
    pass


def _reply(query: Any, replies: list[tuple[str, bytes]], options: dict[str, Any]) -> None:
    for key, payload in replies:
        quietly(query.reply, key, payload, express=True, **options)
    quietly(query.drop)


def _refuse(query: Any, reason: str) -> None:
    quietly(query.reply_err, reason.encode())
    quietly(query.drop)


def _end_session(session: Any, threads: list[ThreadPoolExecutor], is_kept: bool) -> None:
    """Wait for the threads that still send, then end the session.

    With ``is_kept``, as for routers and peers, the session is never freed, which costs 16 KiB.
    Dropping its last reference would wait for a thread of Zenoh and hold the interpreter lock
    meanwhile, and that thread may wait for the lock to call another session of this process.
    """
    for pool in threads:
        pool.shutdown()
    if is_kept:
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(session))
    session.close()


class _ZenohThread(threading.local):
    """A thread of Zenoh that calls back into Python."""

    is_kept: bool = False


_zenoh_thread = _ZenohThread()


def keep_thread() -> None:
    """Keep Python's state of this thread of Zenoh; call this first in a callback.

    For each callback the binding would make and free Python's state of the thread, which takes a
    third of the time of a message. This function enters Python once without leaving it, so the
    thread keeps its state until it ends. Zenoh has few threads, which end with the process.
    """
    if not _zenoh_thread.is_kept:
        _zenoh_thread.is_kept = True
        ctypes.pythonapi.PyGILState_Ensure()


def direct(call: Callable[[Any], None], ended: Callable[[], None] | None = None) -> Any:
    """Return a handler that runs ``call`` in Zenoh's own thread, not in a new one.

    ``ended`` is called when no more calls will come.
    """

    def callback(received: Any) -> None:
        if not _zenoh_thread.is_kept:
            keep_thread()
        call(received)

    return load_zenoh().handlers.Callback(callback, ended, indirect=False)


def quietly(call: Callable[..., Any], *arguments: Any, **named: Any) -> None:
    """Call Zenoh; log an error that only means that the session has ended meanwhile.

    An object that another thread is using cannot be released now; that thread releases it later.
    """
    try:
        call(*arguments, **named)
    except load_zenoh().ZError as exc:
        logger.debug("Zenoh: %s", exc)
    except RuntimeError as exc:
        if "borrowed" not in str(exc):
            raise
        logger.debug("Zenoh: %s, in another thread", exc)


def _close_late(is_kept: bool, opening: asyncio.Future[Any]) -> None:
    """Close a session that was opened after the caller had given up.

    The thread that closes it is no daemon, so that the interpreter waits for it at its exit.
    Otherwise the thread could not return from Zenoh to Python, and Zenoh would abort the
    process.
    """
    if not opening.cancelled() and opening.exception() is None:
        threading.Thread(
            target=_end_session, args=(opening.result(), [], is_kept), daemon=False
        ).start()


def _reason(error: Exception) -> str:
    """Return an error's text: the system's part of it, or else all but the line of Zenoh's code."""
    text = str(error).partition(" at /")[0].strip(" .")
    system = re.search(r": ([^:]+) \(os error \d+\)", text)
    if system is not None:
        return system[1]
    return NOT_ZENOH if "Unable to connect" in text else text
