"""Finding out what a camera speaks: emulated cameras, and peers written by hand."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import select
import socket
from collections.abc import Awaitable, Callable, Iterator
from typing import Any

import pytest

from smartcam._client._inside import Session
from smartcam.emulator import EmulatedCamera
from smartcam.exceptions import ConnectFailedError, MessageError
from smartcam.models import Status
from smartcam.protocols import messages as m
from smartcam.settings import CameraSettings
from tests.client.inside import establish, handshake
from tests.handmade import CONNECT_ANSWER, HOST, LIMIT, Peer, datagrams, scripted, until

DETECTION_TIMEOUT = 0.5


IDLE = Status.RUNNING | Status.WAITING_FOR_TRIGGER

DISCONNECT, CONNECT = bytes.fromhex("02000000"), bytes.fromhex("01000000")
OPENING = DISCONNECT + CONNECT
GET_STATUS, QUERY = bytes.fromhex("12000000"), bytes.fromhex("30000000")

CODED_CONNECTED = bytes.fromhex("01000400 0000 0100")  # bid, and b16 with the quirk
CODED_ACTIVE = bytes.fromhex("30000400 0200 1500")
BID_DISCONNECTED = bytes.fromhex("02000200 0000")
BID_STATUS = bytes.fromhex("12000200 2100")
B16_CONNECTED = bytes.fromhex("01000200 0100")
B16_STATUS = bytes.fromhex("12000200 8002")

CAMERAS: dict[str, tuple[str, dict[str, Any]]] = {
    "handbook": ("handbook", {}),
    "thesis": ("thesis", {}),
    "b16": ("b16", {}),
    "b16 with code": ("b16", {"code": True}),
    "bid": ("bid", {}),
    "bid with push": ("bid", {"push_status": True}),
    "bid that does not answer Disconnect": ("bid", {"disconnect_answer": "silent"}),
}


@pytest.fixture
def short_share(monkeypatch: pytest.MonkeyPatch) -> None:
    """A dialect gets little time in the first round."""
    monkeypatch.setattr(handshake, "DETECTION_TIMEOUT", 0.2)


def settings(port: int, transport: str = "tcp", query: str = "", **options: Any) -> CameraSettings:
    scheme = {"tcp": "bvs", "udp": "bvs+udp"}[transport]
    options = {"name": "cell 1", "connect_timeout": LIMIT, **options}
    return CameraSettings.make(f"{scheme}://{HOST}:{port}{query}", None, options)


def statuses(session: Session) -> list[Status]:
    """Return those that came while the session was made."""
    return [
        event.status
        for chunk in session.early_chunks
        for event in chunk.events
        if isinstance(event, m.StatusReport)
    ]


# ---------------------------------------------------------------------- emulated cameras


@pytest.mark.usefixtures("short_share")
@pytest.mark.parametrize("name", CAMERAS)
async def test_establish_unpinned_finds_the_dialect_and_pins_it(name: str, transport: Any) -> None:
    dialect, quirks = CAMERAS[name]
    async with EmulatedCamera(
        transport=transport, dialect=dialect, quirks=quirks, active=21, running=True
    ) as emulator:
        session = await establish(settings(emulator.port, transport))
        assert session.address.url == emulator.url
        assert session.dialect.name == dialect
        assert session.dialect.quirks == emulator.wire_dialect.quirks
        assert set(statuses(session)) == {IDLE}
        await session.link.close(LIMIT)
        await until(lambda: not emulator.has_session)


@pytest.mark.parametrize("quirk", [False, True])
async def test_establish_pinned_b16_finds_out_whether_it_has_codes(
    transport: Any, *, quirk: bool
) -> None:
    async with EmulatedCamera(
        transport=transport, dialect="b16", quirks={"code": quirk}
    ) as emulator:
        session = await establish(settings(emulator.port, transport, "?dialect=b16"))
        assert session.address.url == emulator.url
        await session.link.close(LIMIT)


async def test_establish_pinned_quirk_that_the_camera_lacks_says_what_came() -> None:
    async with EmulatedCamera(dialect="b16") as emulator:
        pinned = settings(emulator.port, query="?dialect=b16&quirks=code", connect_attempts=1)
        with pytest.raises(ConnectFailedError) as caught:
            await establish(pinned)
    assert caught.value.attempts == (
        "attempt 1: b16 over TCP: waiting for the answer to Connect: "
        "ConnectAnswer (0x01) came with 2 bytes, it needs 4: 01 00",
    )
    assert isinstance(caught.value.__cause__, MessageError)


# ---------------------------------------------------------------------- by hand


def talks(transport: str, answer: Callable[[bytes], list[bytes]]) -> Any:
    """Return a peer that answers each message of the 16-bit dialects with what ``answer`` gives."""
    if transport == "udp":
        return datagrams(answer)

    async def talk(peer: Peer, number: int) -> None:
        try:
            while True:
                header = await peer.reader.readexactly(4)
                body = await peer.reader.readexactly(int.from_bytes(header[2:], "little"))
                peer.write(b"".join(answer(header + body)))
        finally:
            peer.close()

    return scripted(talk)


def table(**answers: list[bytes]) -> Callable[[bytes], list[bytes]]:
    """Return what gives the answers to the messages that are named."""
    names = {"disconnect": DISCONNECT, "connect": CONNECT, "status": GET_STATUS, "query": QUERY}
    known = {names[name]: answer for name, answer in answers.items()}
    return lambda message: known.get(message, [])


@pytest.mark.usefixtures("short_share")
async def test_establish_bid_that_answers_disconnect_before_a_session_is_found(
    transport: Any,
) -> None:
    answer = table(
        disconnect=[BID_DISCONNECTED],
        connect=[CODED_CONNECTED],
        status=[BID_STATUS],
        query=[CODED_ACTIVE],
    )
    async with talks(transport, answer) as camera:
        session = await establish(settings(camera.port, transport))
        assert session.address.dialect == "bid"
        assert set(statuses(session)) == {IDLE}
        await session.link.close(LIMIT)


@pytest.mark.usefixtures("short_share")
@pytest.mark.parametrize("by_chance", [0, 1, 2])
@pytest.mark.parametrize("dialect", [None, "b16"])
async def test_establish_status_by_chance_does_not_make_b16_a_bid(
    by_chance: int, dialect: str | None, transport: Any
) -> None:
    chances = itertools.chain([[B16_STATUS]] * by_chance, itertools.repeat([]))

    def answer(message: bytes) -> list[bytes]:
        if message == CONNECT:
            return [CODED_CONNECTED, B16_STATUS]
        return [*next(chances), CODED_ACTIVE] if message == QUERY else []

    async with talks(transport, answer) as camera:
        query = "" if dialect is None else f"?dialect={dialect}"
        session = await establish(settings(camera.port, transport, query))
        assert session.address.url.endswith("?dialect=b16&quirks=code")
        assert set(statuses(session)) == {IDLE}
        await session.link.close(LIMIT)


async def test_establish_status_between_the_answers_of_a_bid_does_not_confuse() -> None:
    busy = bytes.fromhex("12000200 2000")
    told = table(connect=[CODED_CONNECTED], status=[busy, BID_STATUS], query=[busy, CODED_ACTIVE])
    async with talks("tcp", told) as camera:
        session = await establish(settings(camera.port))
        assert session.address.dialect == "bid"
        assert set(statuses(session)) == {Status.RUNNING, IDLE}
        await session.link.close(LIMIT)


@pytest.mark.usefixtures("short_share")
async def test_establish_udp_status_that_is_lost_once_does_not_make_bid_a_b16() -> None:
    lost = iter([True])

    def answer(message: bytes) -> list[bytes]:
        if message == GET_STATUS:
            return [] if next(lost, False) else [BID_STATUS]
        return {CONNECT: [CODED_CONNECTED], QUERY: [CODED_ACTIVE]}.get(message, [])

    async with datagrams(answer) as camera:
        session = await establish(settings(camera.port, "udp", ""))
        assert session.address.dialect == "bid"
        await session.link.close(LIMIT)


@pytest.mark.parametrize(
    ("connected", "step"),
    [
        (CODED_CONNECTED, "finding out the dialect: 8 bytes"),
        (B16_CONNECTED, "waiting for the first status: 6 bytes"),
        (B16_CONNECTED + B16_STATUS, "waiting for the answer to Query: 12 bytes"),
    ],
)
async def test_establish_camera_that_answers_connect_only_is_named_and_no_other_dialect_tried(
    connected: bytes, step: str
) -> None:
    async with talks("tcp", table(connect=[connected])) as camera:
        with pytest.raises(ConnectFailedError) as caught:
            await establish(settings(camera.port, connect_timeout=0.4, connect_attempts=2))
    first, second = caught.value.attempts
    assert step in first
    assert step in second


@pytest.mark.parametrize(
    ("code", "meaning"),
    [
        ("1000", "0x10 (NOK Error: transfer or execution failed, e.g. wrong format or length)"),
        ("1600", "0x16 (NOK Busy: Ready status is not set)"),
        ("5500", "0x55 (not documented)"),
    ],
)
async def test_establish_refused_code_is_named_and_tried_again(
    transport: Any, code: str, meaning: str
) -> None:
    refused = bytes.fromhex(f"01000400 {code} 0100")
    answer = table(connect=[refused], status=[BID_STATUS], query=[CODED_ACTIVE])
    async with talks(transport, answer) as camera:
        with pytest.raises(ConnectFailedError) as caught:
            await establish(settings(camera.port, transport, "?dialect=bid", connect_attempts=2))
    assert f"the camera refused the session: code {meaning}" in str(caught.value)
    assert len(caught.value.attempts) == 2


# ---------------------------------------------------------------------- garbage, and time


async def http(peer: Peer, number: int) -> None:
    await peer.reader.read(24)
    peer.write(b"HTTP/1.1 400 Bad Request\r\n\r\n")
    await peer.rest()


async def silent(peer: Peer, number: int) -> None:
    await peer.rest()


async def chatty(peer: Peer, number: int) -> None:
    """Connect is answered, then statuses come for ever and no answer."""
    await peer.read(8)
    peer.write(CODED_CONNECTED)
    while True:
        await peer.reader.read(64)
        peer.write(B16_STATUS * 10)
        await peer.writer.drain()


@pytest.mark.parametrize("talk", [http, silent, chatty])
async def test_establish_whatever_comes_is_over_within_the_connect_timeout(
    talk: Callable[[Peer, int], Awaitable[None]],
) -> None:
    loop = asyncio.get_running_loop()
    async with scripted(talk) as listener:
        begin = loop.time()
        with pytest.raises(ConnectFailedError):
            await establish(settings(listener.port, connect_timeout=0.5, connect_attempts=3))
        assert loop.time() - begin < 1.5


async def test_establish_garbage_is_named_for_each_dialect() -> None:
    async with scripted(http) as listener:
        with pytest.raises(ConnectFailedError) as caught:
            await establish(settings(listener.port, connect_timeout=0.3, connect_attempts=1))
    sixteen, handbook, thesis = caught.value.attempts
    assert "b16 or bid over TCP: waiting for the answer to Connect: 28 bytes, then si" in sixteen
    assert "handbook over TCP: waiting for the answer to Connect: wrong magic number" in handbook
    assert "thesis over TCP: waiting for the answer to Connect: wrong magic number" in thesis


async def test_establish_udp_garbage_is_over_within_the_connect_timeout() -> None:
    loop = asyncio.get_running_loop()
    async with datagrams(lambda data: [b"noise", data]) as peer:
        begin = loop.time()
        with pytest.raises(ConnectFailedError):
            await establish(settings(peer.port, "udp", connect_timeout=0.3, connect_attempts=2))
        assert loop.time() - begin < 1.3


TIMEOUT = 4.8

each_dialect = pytest.mark.parametrize("query", ["", "?dialect=handbook", "?dialect=b16"])
each_count = pytest.mark.parametrize("attempts", [1, 2, 3])


@contextlib.contextmanager
def swallowing() -> Iterator[int]:
    """Give a port whose host answers no attempt to connect: its queue of connections is full."""
    with contextlib.ExitStack() as stack:
        listener = stack.enter_context(socket.socket())
        listener.bind((HOST, 0))
        listener.listen(0)
        waiting = [stack.enter_context(socket.socket()) for _ in range(4)]
        for one in waiting:
            one.setblocking(False)
            one.connect_ex(listener.getsockname())
        if select.select([], waiting[-1:], [], 0)[1]:
            pytest.skip("this system accepts more connections than it was told to")
        yield listener.getsockname()[1]


@contextlib.contextmanager
def mute() -> Iterator[int]:
    """Give a port where datagrams are taken and never answered."""
    with socket.socket(type=socket.SOCK_DGRAM) as listener:
        listener.bind((HOST, 0))
        yield listener.getsockname()[1]


async def fail(port: int, query: str, scheme: str = "bvs", **options: Any) -> tuple[str, ...]:
    """Return what was tried; the time must be used up."""
    loop = asyncio.get_running_loop()
    options = {"name": "cell 1", "connect_timeout": TIMEOUT, **options}
    made = CameraSettings.make(f"{scheme}://{HOST}:{port}{query}", None, options)
    begin = loop.time()
    with pytest.raises(ConnectFailedError) as caught:
        await establish(made)
    assert loop.time() - begin == pytest.approx(TIMEOUT, abs=0.01)
    return tuple(one.partition(": ")[2] for one in caught.value.attempts)


@each_dialect
@each_count
async def test_host_that_swallows_attempts_to_connect_is_tried_for_the_whole_time(
    query: str, attempts: int
) -> None:
    with swallowing() as port:
        tried = await fail(port, query, connect_attempts=attempts)
    assert len(tried) == attempts
    text = f"over TCP: opening the link: silence for {TIMEOUT / attempts:.1f} s"
    assert all(one.endswith(text) for one in tried)


@each_dialect
@each_count
async def test_datagrams_that_nobody_answers_are_tried_for_the_whole_time(
    query: str, attempts: int
) -> None:
    with mute() as port:
        tried = await fail(port, query, "bvs+udp", connect_attempts=attempts)
    dialects = 1 if query else 3
    assert len(tried) == attempts * dialects
    if dialects > 1 and attempts > 1:
        hurried = (f"silence for {DETECTION_TIMEOUT:.1f} s",) * dialects
        assert tuple(one.rpartition(": ")[2] for one in tried[:dialects]) == hurried


@each_dialect
@each_count
async def test_camera_that_is_silent_is_tried_for_the_whole_time(query: str, attempts: int) -> None:
    async def silent(peer: Peer, _number: int) -> None:
        await peer.rest()
        peer.close()

    async with scripted(silent) as listener:
        tried = await fail(listener.port, query, connect_attempts=attempts)
    assert len(tried) == attempts * (1 if query else 3)


@pytest.mark.parametrize("query", ["", "?dialect=handbook"])
@each_count
async def test_camera_that_says_no_more_than_its_name_is_tried_for_the_whole_time(
    query: str, attempts: int
) -> None:
    async def talk(peer: Peer, _number: int) -> None:
        if (await peer.read(4)).startswith(b"PSVB"):
            peer.write(CONNECT_ANSWER)
        await peer.rest()
        peer.close()

    async with scripted(talk) as listener:
        tried = await fail(listener.port, query, connect_attempts=attempts)
    assert all(
        "waiting for the first status: 16 bytes" in one for one in tried[0 if query else 1 :]
    )
    assert len(tried) == attempts + (0 if query else 1)
