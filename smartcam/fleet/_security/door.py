"""Filter connections to an agent's port, since Zenoh accepts every connection.

Zenoh does not bound connections: a silent connection stays for 10 s, and after each
failed handshake Zenoh accepts no connection for 0.1 s. So a packet filter on the listening
socket makes the system drop requests for a new connection:

- from an address with many half-open connections, that is, connections whose handshake is not
  complete;
- from all addresses while few file descriptors are left, since cameras and the health page need
  the rest.

Existing connections are not affected; a client's TCP repeats a dropped request by itself. The
filter must not look at contents, since accepted connections inherit it from the listening socket.
"""

from __future__ import annotations

import asyncio
import collections
import contextlib
import ctypes
import errno
import ipaddress
import logging
import os
import select
import socket
import struct
import sys
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

if sys.platform != "win32":
    import resource

HostPort = tuple[str, int]
"""An address and a port."""

logger: logging.Logger = logging.getLogger("smartcam.fleet")

DESCRIPTOR_CHECK_INTERVAL, CALM_CHECK_INTERVAL = 0.01, 0.05
"""Seconds between two checks of the free file descriptors: usually, and after a check at which
hardly more were in use than at the check before."""

CHECK_INTERVAL = 0.25
"""Seconds between two checks of connections while some are half-open. A new connection causes a
check at once."""

CHECK_PAUSE_FACTOR = 4.0
"""Pause after a check of connections, in multiples of the check's duration. A check looks at every
file descriptor, and an agent may have thousands of cameras."""

MAX_CALM_GROWTH = 8
"""Largest growth of used descriptors since the last check that counts as calm."""

CHECKS_PER_SEARCH = 50
"""Number of checks after which Zenoh's listening sockets are checked, too. Renewed
certificates change them."""

RESERVED_DESCRIPTORS: Final = 256
"""Number of file descriptors that are kept for cameras and the health page, at most a quarter of
all."""

MAX_HALF_OPEN_CONNECTIONS: Final = 16
"""Number of half-open connections at which an address is blocked: it gets no further connection."""

RESUMING_HALF_OPEN: Final = 4
"""Number of half-open connections at which a blocked address is unblocked."""

MAX_BLOCKED_ADDRESSES: Final = 256
"""Largest number of blocked addresses; those with the most half-open connections are blocked."""

BACKLOG: Final = 64
"""Number of connections that the system keeps for Zenoh. The filter cannot drop these."""

MAX_DESCRIPTORS: Final = 65_536
"""Limit of file descriptors that an agent requests from the system, which may allow fewer."""

ATTACH_FILTER, DETACH_FILTER = 26, 27
"""Linux' SO_ATTACH_FILTER and SO_DETACH_FILTER."""

LOAD_WORD, LOAD_BYTE, SHIFT_RIGHT, IF_EQUAL, RETURN = 0x20, 0x30, 0x74, 0x15, 0x06
"""Instructions of the classic packet filter."""

IP_HEADER: Final = 0xFFF00000
"""Offset in filters that stands for the start of a packet's IP header."""


class _Instruction(NamedTuple):
    """One instruction of a filter.

    Attributes:
        code: operation of the instruction.
        value: operand of the instruction.
        if_true, if_false: numbers of instructions to skip if a condition is true, and if it is
            false.
    """

    code: int
    value: int = 0
    if_true: int = 0
    if_false: int = 0


_DROP, _PASS = _Instruction(RETURN, 0), _Instruction(RETURN, 0xFFFFFFFF)


def packet_filter(*, refuse_all: bool, blocked: Iterable[str]) -> list[_Instruction]:
    """Return the filter of a listening socket.

    Args:
        refuse_all: whether all connections are refused.
        blocked: addresses whose connections are refused.
    """
    if refuse_all:
        return [_DROP]
    steps: list[_Instruction] = []
    for host in blocked:
        address = ipaddress.ip_address(host)
        offset, words = (12, 1) if address.version == 4 else (8, 4)
        steps += [
            _Instruction(LOAD_BYTE, IP_HEADER),
            _Instruction(SHIFT_RIGHT, 4),
            _Instruction(IF_EQUAL, address.version, 0, 2 * words + 1),
        ]
        for number, (word,) in enumerate(struct.iter_unpack("!I", address.packed)):
            remaining = words - number - 1
            steps += [
                _Instruction(LOAD_WORD, IP_HEADER + offset + 4 * number),
                _Instruction(IF_EQUAL, word, 0, 2 * remaining + 1),
            ]
        steps.append(_DROP)
    return [*steps, _PASS]


def raise_descriptor_limit() -> None:
    """Raise this process' limit of file descriptors as far as the system allows, bounded."""
    if sys.platform == "win32":
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MAX_DESCRIPTORS if hard == resource.RLIM_INFINITY else min(MAX_DESCRIPTORS, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


class ConnectionFilter:
    """Filters connections to the ports of this process' Zenoh; only on Linux.

    Args:
        ports: ports at which Zenoh listens.
        links: function that returns the addresses with a complete handshake, such as ``("10.1.0.5",
            40123)``; None if they are not known.

    Attributes:
        refuses_all: whether all connections are refused.
        blocked: addresses that get no further connections.
    """

    def __init__(
        self, ports: frozenset[int], links: Callable[[], set[HostPort] | None] = lambda: None
    ) -> None:
        self._ports, self._links = ports, links
        self.refuses_all = False
        self.blocked: frozenset[str] = frozenset()
        self._listeners: list[int] = []  # descriptors, which may have been reused meanwhile
        self._timer: asyncio.TimerHandle | None = None
        self._check_count = self._last_lowest = 0
        self._check_timer: asyncio.TimerHandle | None = None
        self._next_check_at = 0.0
        self._connection_epoll: select.epoll | None = None

    def open(self) -> None:
        """Start to check."""
        if sys.platform == "linux" and self._ports:
            self._renew_listeners()
            self._check_descriptors()

    def close(self) -> None:
        """Stop checking, and remove the filter. Idempotent."""
        if self._timer is None:
            return
        self._timer.cancel()
        self._timer = None
        self._schedule_check(None)
        self._stop_watching()
        if self.refuses_all or self.blocked:
            self.refuses_all, self.blocked = False, frozenset()
            self._set_filters()

    def _check_descriptors(self) -> None:
        limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        lowest, previous = _lowest_free(limit), self._last_lowest
        self._last_lowest = lowest
        is_calm = not self.refuses_all and lowest <= previous + MAX_CALM_GROWTH
        delay = CALM_CHECK_INTERVAL if is_calm else DESCRIPTOR_CHECK_INTERVAL
        self._timer = asyncio.get_running_loop().call_later(delay, self._check_descriptors)
        self._check_count += 1
        if self._check_count % CHECKS_PER_SEARCH == 0 and not self._are_listeners_unchanged():
            self._renew_listeners()  # Zenoh has opened new sockets
        if limit == resource.RLIM_INFINITY:
            return
        free_count = limit - lowest
        reserve = min(RESERVED_DESCRIPTORS, limit // 4)
        if not self.refuses_all and free_count <= reserve:
            self.refuses_all = True
            self._set_filters()
            logger.warning(
                "! the port of the fleet accepts no connection: only %d file descriptors are left, "
                "%d are reserved for cameras and health",
                free_count,
                reserve,
            )
        elif self.refuses_all and free_count > reserve + reserve // 4:
            self.refuses_all = False
            self._set_filters()
            logger.warning("= the port of the fleet accepts connections again")

    # ------------------------------------------------------------------ connections

    def _watch_connections(self) -> None:
        """Call :meth:`_on_connection` at each new connection; Zenoh's threads accept it."""
        self._stop_watching()
        self._connection_epoll = select.epoll()
        for number in self._listeners:
            with contextlib.suppress(OSError):  # the descriptor was reused, or closed
                self._connection_epoll.register(number, select.EPOLLIN | select.EPOLLET)
        asyncio.get_running_loop().add_reader(self._connection_epoll.fileno(), self._on_connection)

    def _stop_watching(self) -> None:
        epoll, self._connection_epoll = self._connection_epoll, None
        if epoll is not None:
            asyncio.get_running_loop().remove_reader(epoll.fileno())
            epoll.close()

    def _on_connection(self) -> None:
        if self._connection_epoll is not None:
            self._connection_epoll.poll(0)
        self._schedule_check(max(0.0, self._next_check_at - asyncio.get_running_loop().time()))

    def _schedule_check(self, delay: float | None) -> None:
        """Check for half-open connections in ``delay`` seconds; None: cancel the planned check."""
        if self._check_timer is not None:
            self._check_timer.cancel()
            self._check_timer = None
        if delay is not None:
            loop = asyncio.get_running_loop()
            self._check_timer = loop.call_later(delay, self._check_half_open)

    def _check_half_open(self) -> None:
        """Block addresses that have too many half-open connections."""
        loop, links = asyncio.get_running_loop(), self._links()
        self._schedule_check(None)
        if links is None:
            return
        started_at = loop.time()
        half_open = collections.Counter(host for host, _ in self._peer_addresses() - links)
        self._next_check_at = loop.time() + CHECK_PAUSE_FACTOR * (loop.time() - started_at)
        if half_open:
            self._schedule_check(CHECK_INTERVAL)
        blocked = [
            host
            for host, count in half_open.most_common(MAX_BLOCKED_ADDRESSES)
            if count >= MAX_HALF_OPEN_CONNECTIONS
            or (host in self.blocked and count > RESUMING_HALF_OPEN)
        ]
        if self.blocked == {*blocked}:
            return
        for host in sorted({*blocked} - self.blocked):
            logger.warning(
                "! the port of the fleet accepts no further connection from %s: %d from there are "
                "half-open",
                host,
                half_open[host],
            )
        self.blocked = frozenset(blocked)
        self._set_filters()

    def _peer_addresses(self) -> set[HostPort]:
        """Return the addresses of the other sides of all connections of the ports."""
        addresses: set[HostPort] = set()
        for sock in _sockets():
            with contextlib.suppress(OSError, IndexError):  # not a connection, or ended
                if sock.getsockname()[1] in self._ports and not _is_listening(sock):
                    host, port, *_ = sock.getpeername()
                    addresses.add((plain_host(host), port))
        return addresses

    # ------------------------------------------------------------------ filters

    def _set_filters(self) -> None:
        results = [self._set_filter(number) for number in self._listeners]
        if not all(results):
            self._renew_listeners()

    def _renew_listeners(self) -> None:
        with contextlib.suppress(OSError):  # no descriptor is left for the search
            self._listeners = self._find_listeners()
            self._watch_connections()
        for number in self._listeners:
            self._set_filter(number)

    def _are_listeners_unchanged(self) -> bool:
        """Return True if all listening sockets are still the same."""
        for number in self._listeners:
            try:
                listener = socket.socket(fileno=number)
            except OSError:
                return False
            try:
                if not self._is_zenoh_listener(listener):
                    return False
            finally:
                listener.detach()
        return bool(self._listeners)

    def _set_filter(self, number: int) -> bool:
        """Set the filter of one listening socket; return False if it is not Zenoh's."""
        try:
            listener = socket.socket(fileno=number)
        except OSError:
            return False
        try:
            if not self._is_zenoh_listener(listener):
                return False
            steps = packet_filter(refuse_all=self.refuses_all, blocked=sorted(self.blocked))
            if steps == [_PASS]:
                with contextlib.suppress(FileNotFoundError):  # the socket has no filter
                    listener.setsockopt(socket.SOL_SOCKET, DETACH_FILTER, 0)
            else:
                set_filter(listener, steps)
        except OSError:
            return False
        else:
            return True
        finally:
            listener.detach()

    def _find_listeners(self) -> list[int]:
        """Return the descriptors of Zenoh's listening sockets."""
        numbers: list[int] = []
        for sock in _sockets():
            with contextlib.suppress(OSError):
                if self._is_zenoh_listener(sock):
                    sock.listen(BACKLOG)
                    numbers.append(sock.fileno())
        return numbers

    def _is_zenoh_listener(self, sock: socket.socket) -> bool:
        return _is_listening(sock) and sock.getsockname()[1] in self._ports


def set_filter(sock: socket.socket, steps: list[_Instruction]) -> None:
    """Set the filter of a socket in the system.

    Raises:
        OSError: the system refuses the filter.
    """
    packed = b"".join(
        struct.pack("HBBI", step.code, step.if_true, step.if_false, step.value) for step in steps
    )
    program_buffer = ctypes.create_string_buffer(packed, len(packed))
    program = struct.pack("HP", len(steps), ctypes.addressof(program_buffer))
    sock.setsockopt(socket.SOL_SOCKET, ATTACH_FILTER, program)  # the system has a copy


def plain_host(text: str) -> str:
    """Return an address for comparisons: without a scope, and an IPv4-mapped one as IPv4."""
    address = ipaddress.ip_address(text.strip("[]").partition("%")[0])
    return str(getattr(address, "ipv4_mapped", None) or address)


def _is_listening(sock: socket.socket) -> bool:
    internet = sock.family in {socket.AF_INET, socket.AF_INET6}
    return internet and bool(sock.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN))


def _sockets() -> Iterator[socket.socket]:
    """Yield this process' sockets in turn, without taking ownership."""
    for name in os.listdir("/dev/fd"):  # noqa: PTH208 - names are enough
        try:
            sock = socket.socket(fileno=int(name))
        except OSError:
            continue
        try:
            yield sock
        finally:
            sock.detach()


def _lowest_free(limit: int) -> int:
    """Return the lowest free descriptor; ``limit`` if none is free."""
    try:
        number = os.dup(0)
    except OSError as exc:
        return limit if exc.errno == errno.EMFILE else 0
    os.close(number)
    return number
