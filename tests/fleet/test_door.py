"""The door of an agent's port: half-open connections, and the last descriptors."""

from __future__ import annotations

import asyncio
import contextlib
import resource
import socket
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

import pytest

import smartcam
import smartcam.fleet
from smartcam.fleet._agent import server as _server
from tests.fleet.fleetkit import PATIENCE, until
from tests.fleet.inside import ConnectionFilter
from tests.fleet.inside import door as _door
from tests.fleet.inside import zenoh as _zenoh
from tests.fleet.plantkit import certified, plant_file, url_of

pytestmark = [
    pytest.mark.real_time,
    pytest.mark.skipif(sys.platform != "linux", reason="filters on sockets are Linux'"),
]

FEW = 40
"""Descriptors that a test's process has left."""


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have the door see a limit that is near; the process itself keeps its own."""
    most = _door._lowest_free(1 << 20) + FEW
    monkeypatch.setattr(resource, "getrlimit", lambda _: (most, most))
    monkeypatch.setattr(_door, "RESERVED_DESCRIPTORS", 16)


def hardly_any(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have the door see that two descriptors are left."""
    most = _door._lowest_free(1 << 20) + 2
    monkeypatch.setattr(resource, "getrlimit", lambda _: (most, most))


class Port:
    """A port that takes every connection, as the engine's does; a context manager."""

    def __enter__(self) -> Self:
        self.listener = socket.create_server(("127.0.0.1", 0), backlog=1024)
        self.listener.setblocking(False)
        self.place = self.listener.getsockname()
        self.taken: list[socket.socket] = []
        asyncio.get_running_loop().add_reader(self.listener, self._take)
        return self

    def _take(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                self.taken.append(self.listener.accept()[0])

    def __exit__(self, *_: object) -> None:
        asyncio.get_running_loop().remove_reader(self.listener)
        for one in (self.listener, *self.taken):
            one.close()


@pytest.fixture
def strangers() -> Iterator[list[socket.socket]]:
    found: list[socket.socket] = []
    yield found
    for one in found:
        one.close()


def knock(
    place: tuple[str, int], strangers: list[socket.socket], host: str = "127.0.0.1"
) -> socket.socket:
    """Ask for a connection from an address of this computer."""
    one = socket.socket()
    one.bind((host, 0))
    one.setblocking(False)
    one.connect_ex(place)
    strangers.append(one)
    return one


def is_in(one: socket.socket) -> bool:
    with contextlib.suppress(OSError):
        return bool(one.getpeername())
    return False


async def test_door_is_shut_while_few_descriptors_are_left(
    few: None, strangers: list[socket.socket]
) -> None:
    with Port() as port:
        door = ConnectionFilter(frozenset({port.place[1]}))
        door.open()
        try:
            first = knock(port.place, strangers)
            await until(lambda: is_in(first))
            assert not door.refuses_all
            while not door.refuses_all:  # each is a descriptor of this process at both ends
                assert len(strangers) < FEW
                knock(port.place, strangers)
                await asyncio.sleep(2 * _door.CALM_CHECK_INTERVAL)
            await until(lambda: all(is_in(one) for one in strangers))
            before = len(port.taken)
            late = knock(port.place, strangers)
            await asyncio.sleep(0.5)
            assert not is_in(late)
            assert len(port.taken) == before
            port.taken[0].send(b"still there")  # who is in notices nothing
            loop = asyncio.get_running_loop()
            async with asyncio.timeout(PATIENCE):
                assert await loop.sock_recv(first, 100) == b"still there"
            for one in (*port.taken[1:], *strangers[1:-1]):
                one.close()
            await until(lambda: not door.refuses_all)
            await until(lambda: is_in(late))  # it asks again by itself
        finally:
            door.close()


async def test_door_is_open_when_nobody_looks_any_more(
    few: None, strangers: list[socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    hardly_any(monkeypatch)
    with Port() as port:
        door = ConnectionFilter(frozenset({port.place[1]}))
        door.open()
        assert door.refuses_all
        door.close()
        door.close()
        assert not door.refuses_all
        one = knock(port.place, strangers)
        await until(lambda: is_in(one))


async def test_port_that_is_opened_anew_is_shut_too(
    few: None, monkeypatch: pytest.MonkeyPatch, strangers: list[socket.socket]
) -> None:
    """The engine does so when it has taken renewed certificates."""
    monkeypatch.setattr(_door, "CHECKS_PER_SEARCH", 2)
    with Port() as old:
        door = ConnectionFilter(frozenset({old.place[1]}))
        door.open()
        try:
            old.listener.close()
            with socket.create_server(old.place, backlog=1024) as anew:
                await until(lambda: anew.fileno() in door._listeners)
                hardly_any(monkeypatch)
                await until(lambda: door.refuses_all)
                late = knock(old.place, strangers)
                await asyncio.sleep(0.3)
                assert not is_in(late)
        finally:
            door.close()


def test_limit_of_descriptors_is_raised_as_far_as_it_may(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[tuple[int, int]] = []
    monkeypatch.setattr(resource, "setrlimit", lambda _, limits: said.append(limits))
    for soft, hard, wanted in (
        (1024, 4096, [(4096, 4096)]),
        (1024, 1 << 20, [(_door.MAX_DESCRIPTORS, 1 << 20)]),
        (1024, resource.RLIM_INFINITY, [(_door.MAX_DESCRIPTORS, resource.RLIM_INFINITY)]),
        (4096, 4096, []),
        (1 << 20, 1 << 20, []),
    ):
        said.clear()
        monkeypatch.setattr(resource, "getrlimit", lambda _, now=(soft, hard): now)
        _door.raise_descriptor_limit()
        assert said == wanted


# ---------------------------------------------------------------------- one address


class KnownPort(Port):
    """Such a port, which knows who has come in."""

    def __init__(self) -> None:
        self.known: set[tuple[str, int]] | None = set()

    def door(self) -> ConnectionFilter:
        return ConnectionFilter(frozenset({self.place[1]}), lambda: self.known)


async def test_address_with_many_connections_half_open_gets_no_more(
    strangers: list[socket.socket],
) -> None:
    with KnownPort() as port:
        door = port.door()
        door.open()
        try:
            stranger, other = "127.0.0.9", "127.0.0.8"
            while not door.blocked:
                assert len(strangers) < 4 * _door.MAX_HALF_OPEN_CONNECTIONS
                knock(port.place, strangers, stranger)
                await asyncio.sleep(0.01)
            assert door.blocked == {stranger}
            assert len(strangers) >= _door.MAX_HALF_OPEN_CONNECTIONS
            await until(lambda: len(port.taken) == len(strangers))
            late = knock(port.place, strangers, stranger)
            await until(lambda: is_in(knock(port.place, strangers, other)))
            assert not is_in(late)
            for one in strangers[: _door.MAX_HALF_OPEN_CONNECTIONS]:
                one.close()
            for one in port.taken:
                one.close()
            await until(lambda: not door.blocked)
            await until(lambda: is_in(late))  # it asks again by itself
        finally:
            door.close()


async def test_connections_that_have_come_in_count_for_nothing(
    strangers: list[socket.socket],
) -> None:
    with KnownPort() as port:
        door = port.door()
        door.open()
        try:
            for _ in range(3 * _door.MAX_HALF_OPEN_CONNECTIONS):
                one = knock(port.place, strangers)
                assert port.known is not None
                port.known.add(one.getsockname())
                await until(lambda: is_in(one))  # noqa: B023 - waited for here
            assert not door.blocked
            port.known = None  # there is no session: nobody can tell
            knock(port.place, strangers)
            await asyncio.sleep(2 * _door.CALM_CHECK_INTERVAL)
            assert not door.blocked
        finally:
            door.close()


@pytest.mark.parametrize(
    ("family", "host", "blocked"),
    [
        (socket.AF_INET, "127.0.0.1", ["127.0.0.1"]),
        (socket.AF_INET, "127.0.0.1", ["10.0.0.1", "::1", "127.0.0.1", "127.0.0.9"]),
        (socket.AF_INET6, "::1", ["::1"]),
        (socket.AF_INET6, "::1", ["127.0.0.1", "fe80::1", "::1"]),
        (socket.AF_INET6, "::1", []),
        (socket.AF_INET6, "::1", ["127.0.0.1", "::2", "::1:0:0:1"]),
        (socket.AF_INET, "127.0.0.1", ["127.0.0.2", "::1"]),
    ],
)
def test_filter_drops_what_comes_from_addresses_that_it_names(
    family: int, host: str, blocked: list[str], strangers: list[socket.socket]
) -> None:
    with socket.create_server((host, 0), family=family) as listener:
        _door.set_filter(listener, _door.packet_filter(refuse_all=False, blocked=blocked))
        one = socket.socket(family)
        strangers.append(one)
        one.settimeout(0.3)
        if host in blocked:
            with pytest.raises(TimeoutError):
                one.connect((host, listener.getsockname()[1]))
        else:
            one.connect((host, listener.getsockname()[1]))


def test_filter_sees_ipv4_within_ipv6(strangers: list[socket.socket]) -> None:
    with socket.create_server(("::", 0), family=socket.AF_INET6, dualstack_ipv6=True) as listener:
        blocked = [_door.plain_host("::ffff:127.0.0.9")]
        assert blocked == ["127.0.0.9"]
        _door.set_filter(listener, _door.packet_filter(refuse_all=False, blocked=blocked))
        for host, comes in (("127.0.0.9", False), ("127.0.0.8", True)):
            one = knock(("127.0.0.1", listener.getsockname()[1]), strangers, host)
            assert is_in(one) == comes


def test_filter_has_room_for_as_many_addresses_as_it_may_name() -> None:
    most = [f"2001:db8::{number:x}" for number in range(1, _door.MAX_BLOCKED_ADDRESSES + 1)]
    with socket.create_server(("::", 0), family=socket.AF_INET6) as listener:
        _door.set_filter(listener, _door.packet_filter(refuse_all=False, blocked=most))


async def test_strangers_at_the_port_of_an_agent_keep_only_their_own_address_out(
    tmp_path: Path, strangers: list[socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Over Zenoh and TLS: the engine itself has no bound."""
    pytest.importorskip("zenoh")
    keys = await certified(tmp_path)
    made: list[ConnectionFilter] = []

    def make(*given: Any) -> ConnectionFilter:
        made.append(ConnectionFilter(*given))
        return made[-1]

    monkeypatch.setattr(_server, "ConnectionFilter", make)
    async with smartcam.fleet.serve(plant_file(keys)) as server:
        await server.wait_first_attempts()
        port = server.address.port
        place, (door,) = ("127.0.0.1", port), made
        while not door.blocked:
            assert len(strangers) < 1000
            knock(place, strangers, "127.0.0.9")
            await asyncio.sleep(0.001)
        async with smartcam.connect(url_of(port, keys / "robot")) as camera:
            assert (await camera.trigger()).number
        assert door.blocked == {"127.0.0.9"}
        for one in strangers:
            one.close()
        await until(lambda: not door.blocked)


@pytest.mark.parametrize(
    ("said", "found"),
    [
        ("tls/127.0.0.1:51920", ("127.0.0.1", 51920)),
        ("tcp/10.1.0.5:7?rel=1;prio=1-7", ("10.1.0.5", 7)),
        ("tls/[::1]:443#so_sndbuf=1", ("::1", 443)),
        ("tls/[fe80::1%2]:443", ("fe80::1", 443)),
        ("tcp/[::ffff:10.1.0.5]:7", ("10.1.0.5", 7)),
        ("unixsock-stream/a-socket", None),
    ],
)
def test_places_of_who_has_come_in_are_read_as_the_system_has_them(
    said: str, found: tuple[str, int] | None
) -> None:
    assert _zenoh.parse_link_address(said) == found


async def test_many_that_knock_are_looked_at_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """A look costs what an agent of thousands of cameras has: it is done a part of the time."""
    door = ConnectionFilter(frozenset({1}), set)
    looks = 0
    loop = asyncio.get_running_loop()
    now = [loop.time()]
    monkeypatch.setattr(loop, "time", lambda: now[0])

    def look() -> set[tuple[str, int]]:
        nonlocal looks
        looks += 1
        now[0] += 0.02
        return set()

    monkeypatch.setattr(door, "_peer_addresses", look)
    door._check_half_open()
    for _ in range(100):
        door._on_connection()
        now[0] += 0.0001
    await asyncio.sleep(0)
    assert looks == 1
    now[0] += _door.CHECK_PAUSE_FACTOR * 0.02
    await until(lambda: looks == 2)
    door._schedule_check(None)
