"""Filter connections to an agent's port, since the engine accepts every connection.

The engine has no bounds: a silent connection stays for 10 s, and after each failed handshake no
connection is accepted for 0.1 s. So the system drops requests for a further connection, by a filter
on the listening socket:

- from an address that has many half-open connections, whose handshake has not ended;
- from all addresses while few file descriptors are left, which cameras and health need.

Existing connections are not affected; TCP repeats a dropped request by itself. The filter cannot
look at contents, since connections inherit it from the listening socket.
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

Place = tuple[str, int]
"""An address and a port."""

logger: logging.Logger = logging.getLogger("smartcam.fleet")

LOOK_EVERY, LOOK_EVERY_IF_CALM = 0.01, 0.05
"""Seconds between two checks of the free descriptors, and the same if there are hardly fewer than
at the last check. A new connection causes a check at once."""

CHECK_INTERVAL = 0.25
"""Seconds between two checks of connections while some are half-open and no other comes."""

CHECK_PAUSE_FACTOR = 4.0
"""Pause after a check of connections, in multiples of its duration: it reads every descriptor, and
an agent may have thousands of cameras."""

MAX_CALM_GROWTH = 8
"""Largest growth of used descriptors since the last check that counts as calm."""

CHECK_AFTER = 50
"""Number of checks between two searches for the engine's sockets, which change with renewed
certificates."""

RESERVED_DESCRIPTORS: Final = 256
"""Descriptors that the port leaves to cameras and health; at most a quarter of all."""

MAX_HALF_OPEN_CONNECTIONS: Final = 16
"""Largest number of half-open connections of one address, which gets no further one then."""

RESUMING_HALF_OPEN: Final = 4
"""Number of half-open connections at which an address gets a further one again."""

MAX_BLOCKED_ADDRESSES: Final = 256
"""Largest number of addresses in a filter, those with most connections."""

BACKLOG: Final = 64
"""Connections that the system keeps for the engine; these are accepted even if it is shut."""

MAX_WANTED: Final = 65_536
"""Number of descriptors that an agent requests from the system, if it may."""

ATTACH_FILTER, DETACH_FILTER = 26, 27
"""Linux' SO_ATTACH_FILTER and SO_DETACH_FILTER."""

LOAD_WORD, LOAD_BYTE, SHIFT_RIGHT, IF_EQUAL, RETURN = 0x20, 0x30, 0x74, 0x15, 0x06
"""Instructions of the classic packet filter."""

IP_HEADER: Final = 0xFFF00000
"""The offset of a packet's IP header."""


class _Instruction(NamedTuple):
    """One instruction of a filter.

    Attributes:
        code: operation of the instruction.
        value: operand of the instruction.
        yes, no: numbers of instructions to skip if a condition is true, and if it is false.
    """

    code: int
    value: int = 0
    yes: int = 0
    no: int = 0


_DROP, _PASS = _Instruction(RETURN, 0), _Instruction(RETURN, 0xFFFFFFFF)


def packet_filter(*, shut: bool, blocked: Iterable[str]) -> list[_Instruction]:
    """Return the filter of a listening socket.

    Args:
        shut: whether all connections are refused.
        blocked: addresses whose connections are refused.
    """
    if shut:
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
            left = words - number - 1
            steps += [
                _Instruction(LOAD_WORD, IP_HEADER + offset + 4 * number),
                _Instruction(IF_EQUAL, word, 0, 2 * left + 1),
            ]
        steps.append(_DROP)
    return [*steps, _PASS]


def raise_descriptor_limit() -> None:
    """Raise this process' limit of file descriptors as far as the system allows, bounded."""
    if sys.platform == "win32":
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MAX_WANTED if hard == resource.RLIM_INFINITY else min(MAX_WANTED, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


class Door:
    """Filters connections to the ports of this process' engine; only on Linux.

    Args:
        ports: ports at which the engine listens.
        links: function that returns the addresses of accepted links, such as ``("10.1.0.5",
            40123)``; None if they are not known.

    Attributes:
        shut: whether all connections are refused.
        blocked: addresses that get no further connections.
    """

    def __init__(
        self, ports: frozenset[int], links: Callable[[], set[Place] | None] = lambda: None
    ) -> None:
        self._ports, self._links = ports, links
        self.shut = False
        self.blocked: frozenset[str] = frozenset()
        self._listeners: list[int] = []  # descriptors, which may have been reused meanwhile
        self._timer: asyncio.TimerHandle | None = None
        self._looks = self._lowest = 0
        self._coming: asyncio.TimerHandle | None = None
        self._rested = 0.0
        self._knocks: select.epoll | None = None

    def open(self) -> None:
        """Start to check."""
        if sys.platform == "linux" and self._ports:
            self._find_again()
            self._look()

    def close(self) -> None:
        """Stop checking, and remove the filter. Idempotent."""
        if self._timer is None:
            return
        self._timer.cancel()
        self._timer = None
        self._expect_look(None)
        self._forget_knocks()
        if self.shut or self.blocked:
            self.shut, self.blocked = False, frozenset()
            self._set()

    def _look(self) -> None:
        most = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        lowest, before = _lowest_free(most), self._lowest
        self._lowest = lowest
        calm = not self.shut and lowest <= before + MAX_CALM_GROWTH
        delay = LOOK_EVERY_IF_CALM if calm else LOOK_EVERY
        self._timer = asyncio.get_running_loop().call_later(delay, self._look)
        self._looks += 1
        if self._looks % CHECK_AFTER == 0 and not self._all_ours():
            self._find_again()  # the engine has opened new sockets
        if most == resource.RLIM_INFINITY:
            return
        left = most - lowest
        reserve = min(RESERVED_DESCRIPTORS, most // 4)
        if not self.shut and left <= reserve:
            self.shut = True
            self._set()
            logger.warning(
                "! the port of the fleet accepts no connection: %d file descriptors are left, %d "
                "of them for cameras and health",
                left,
                reserve,
            )
        elif self.shut and left > reserve + reserve // 4:
            self.shut = False
            self._set()
            logger.warning("= the port of the fleet accepts connections again")

    # ------------------------------------------------------------------ connections

    def _watch_connections(self) -> None:
        """Check at each new connection, which the engine accepts in its own threads."""
        self._forget_knocks()
        self._knocks = select.epoll()
        for number in self._listeners:
            with contextlib.suppress(OSError):  # the descriptor was reused, or closed
                self._knocks.register(number, select.EPOLLIN | select.EPOLLET)
        asyncio.get_running_loop().add_reader(self._knocks.fileno(), self._on_knock)

    def _forget_knocks(self) -> None:
        knocks, self._knocks = self._knocks, None
        if knocks is not None:
            asyncio.get_running_loop().remove_reader(knocks.fileno())
            knocks.close()

    def _on_knock(self) -> None:
        if self._knocks is not None:
            self._knocks.poll(0)
        self._expect_look(max(0.0, self._rested - asyncio.get_running_loop().time()))

    def _expect_look(self, delay: float | None) -> None:
        """Check the port in ``delay`` seconds, or not at all; this replaces an earlier plan."""
        if self._coming is not None:
            self._coming.cancel()
            self._coming = None
        if delay is not None:
            loop = asyncio.get_running_loop()
            self._coming = loop.call_later(delay, self._look_who_comes)

    def _look_who_comes(self) -> None:
        """Block addresses that have too many half-open connections."""
        loop, links = asyncio.get_running_loop(), self._links()
        self._expect_look(None)
        if links is None:
            return
        begun = loop.time()
        coming = collections.Counter(host for host, _ in self._connected() - links)
        self._rested = loop.time() + CHECK_PAUSE_FACTOR * (loop.time() - begun)
        if coming:
            self._expect_look(CHECK_INTERVAL)
        many = [
            host
            for host, count in coming.most_common(MAX_BLOCKED_ADDRESSES)
            if count >= MAX_HALF_OPEN_CONNECTIONS
            or (host in self.blocked and count > RESUMING_HALF_OPEN)
        ]
        if self.blocked == {*many}:
            return
        for host in sorted({*many} - self.blocked):
            logger.warning(
                "! the port of the fleet accepts no further connection from %s: %d from there are "
                "half-open",
                host,
                coming[host],
            )
        self.blocked = frozenset(many)
        self._set()

    def _connected(self) -> set[Place]:
        """Return the other ends of all connections of the ports."""
        ends: set[Place] = set()
        for sock in _sockets():
            with contextlib.suppress(OSError, IndexError):  # not a connection, or ended
                if sock.getsockname()[1] in self._ports and not _listens(sock):
                    host, port, *_ = sock.getpeername()
                    ends.add((plain_host(host), port))
        return ends

    # ------------------------------------------------------------------ filters

    def _set(self) -> None:
        done = [self._filter(number) for number in self._listeners]
        if not all(done):
            self._find_again()

    def _find_again(self) -> None:
        with contextlib.suppress(OSError):  # no descriptor is left for the search
            self._listeners = self._find()
            self._watch_connections()
        for number in self._listeners:
            self._filter(number)

    def _all_ours(self) -> bool:
        """Return True if all listening sockets are still the same."""
        for number in self._listeners:
            try:
                listener = socket.socket(fileno=number)
            except OSError:
                return False
            try:
                if not self._is_ours(listener):
                    return False
            finally:
                listener.detach()
        return bool(self._listeners)

    def _filter(self, number: int) -> bool:
        """Set the filter of one listening socket; return False if it is not the engine's."""
        try:
            listener = socket.socket(fileno=number)
        except OSError:
            return False
        try:
            if not self._is_ours(listener):
                return False
            steps = packet_filter(shut=self.shut, blocked=sorted(self.blocked))
            if steps == [_PASS]:
                with contextlib.suppress(FileNotFoundError):  # the socket has no filter
                    listener.setsockopt(socket.SOL_SOCKET, DETACH_FILTER, 0)
            else:
                attach(listener, steps)
        except OSError:
            return False
        else:
            return True
        finally:
            listener.detach()

    def _find(self) -> list[int]:
        """Return the descriptors of the engine's listening sockets."""
        numbers: list[int] = []
        for sock in _sockets():
            with contextlib.suppress(OSError):
                if self._is_ours(sock):
                    sock.listen(BACKLOG)
                    numbers.append(sock.fileno())
        return numbers

    def _is_ours(self, sock: socket.socket) -> bool:
        return _listens(sock) and sock.getsockname()[1] in self._ports


def attach(sock: socket.socket, steps: list[_Instruction]) -> None:
    """Set the filter of a socket in the system.

    Raises:
        OSError: the system refuses the filter.
    """
    packed = b"".join(
        struct.pack("HBBI", step.code, step.yes, step.no, step.value) for step in steps
    )
    program_buffer = ctypes.create_string_buffer(packed, len(packed))
    program = struct.pack("HP", len(steps), ctypes.addressof(program_buffer))
    sock.setsockopt(socket.SOL_SOCKET, ATTACH_FILTER, program)  # the system has a copy


def plain_host(text: str) -> str:
    """Return an address for comparisons: without a scope, IPv4 within IPv6 as IPv4."""
    address = ipaddress.ip_address(text.strip("[]").partition("%")[0])
    return str(getattr(address, "ipv4_mapped", None) or address)


def _listens(sock: socket.socket) -> bool:
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


def _lowest_free(most: int) -> int:
    """Return the lowest free descriptor: all below are in use."""
    try:
        number = os.dup(0)
    except OSError as exc:
        return most if exc.errno == errno.EMFILE else 0
    os.close(number)
    return number
