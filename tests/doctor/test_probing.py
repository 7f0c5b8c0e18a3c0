"""Test finding the dialect of an address: the order of tries, their records, and their end."""

from __future__ import annotations

import asyncio
import socket
from contextlib import aclosing
from typing import Any

import pytest

from smartcam.doctor._inside import TracedAttempt, try_ways
from smartcam.doctor._probing import MAX_FRAMES, ways
from smartcam.emulator import EmulatedCamera
from smartcam.models import Status
from smartcam.observers import TraceEntry
from smartcam.settings import parse_address
from tests.handmade import (
    CONNECT,
    CONNECT_ANSWER,
    DISCONNECT,
    HOST,
    OPENING,
    QUERY,
    QUERY_ANSWER,
    RESULT,
    STATUS,
    Peer,
    datagrams,
    listening,
    refusing,
    scripted,
)

SHORT = 0.3
"""Seconds for all tries in tests where most tries get no answer."""


async def tried(url: str, timeout: float = SHORT, **options: Any) -> list[TracedAttempt]:
    async with aclosing(try_ways(parse_address(url), timeout=timeout, **options)) as found:
        return [trial async for trial in found]


def names(url: str) -> list[tuple[str, str]]:
    """Return transport and dialects of every way, in order."""
    return [
        (way.transport.value, "/".join(dict.fromkeys(d.name for d in way.dialects)))
        for way in ways(parse_address(url))
    ]


def broken(trial: TracedAttempt) -> list[tuple[str, str]]:
    return [(one.message, one.hex) for one in trial.frames if one.direction == "!"]


# ---------------------------------------------------------------------- the order


def test_ways_begin_with_the_transport_of_the_url() -> None:
    tcp, udp = names("bvs://h"), names("bvs+udp://h")
    assert {transport for transport, _ in tcp[: len(tcp) // 2]} == {"tcp"}
    assert {transport for transport, _ in udp[: len(udp) // 2]} == {"udp"}
    assert sorted(tcp) == sorted(udp)


@pytest.mark.parametrize("dialect", ["handbook", "thesis", "b16", "bid"])
def test_ways_begin_with_the_pinned_dialect_and_try_each_once(dialect: str) -> None:
    found = ways(parse_address(f"bvs://h?dialect={dialect}"))
    assert {one.name for one in found[0].dialects} == {dialect}
    assert found[0].address.scheme == "bvs"
    tcp = [one.name for way in found if way.transport.value == "tcp" for one in way.dialects]
    assert {"handbook", "thesis", "b16", "bid"} == set(tcp)
    assert tcp.count("handbook") == tcp.count("thesis") == tcp.count("bid") == 1


def test_ways_keep_pinned_quirks() -> None:
    first = ways(parse_address("bvs://h?dialect=b16&quirks=code"))[0]
    assert [one.label for one in first.dialects] == ["b16 with quirk code"]


# ---------------------------------------------------------------------- a camera answers


@pytest.mark.parametrize("transport", ["tcp", "udp"])
@pytest.mark.parametrize("dialect", ["handbook", "thesis", "b16", "bid"])
async def test_camera_is_found_whatever_it_speaks(dialect: str, transport: Any) -> None:
    async with EmulatedCamera(dialect=dialect, transport=transport, running=True) as emulator:
        *failed, last = await tried(f"bvs://{HOST}:{emulator.port}", timeout=1.5)
        assert emulator.sessions == []
    assert last.answer is not None
    assert last.answer.url == emulator.url
    assert last.answer.status == Status.RUNNING | Status.WAITING_FOR_TRIGGER
    assert (last.answer.application, last.answer.protocol_version) == (1, 1)
    assert (last.outcome, last.dialect, last.error) == ("session", dialect, None)
    assert all(trial.answer is None and trial.error is not None for trial in failed)


async def test_session_is_over_before_its_try_is_reported() -> None:
    seen: list[TraceEntry] = []
    async with EmulatedCamera() as emulator:
        async for trial in try_ways(parse_address(emulator.url), timeout=1.0, trace=seen.append):
            assert trial.answer is not None
            assert emulator.sessions == []
    assert [one.message for one in trial.frames] == [
        "Disconnect", "Connect", "ConnectAnswer", "StatusReport", "Query", "QueryAnswer",
    ]  # fmt: skip
    assert [one.message for one in seen] == [*(one.message for one in trial.frames), "Disconnect"]


async def test_going_on_tries_the_rest_too() -> None:
    async with EmulatedCamera() as emulator:
        found = await tried(emulator.url, continue_after_answer=True)
    assert [trial.answer is not None for trial in found] == [True] + [False] * (len(found) - 1)
    assert len(found) == len(ways(parse_address(emulator.url)))


async def test_camera_that_hangs_up_at_disconnect_is_asked_without() -> None:
    async def touchy(peer: Peer, number: int) -> None:
        if await peer.read(len(CONNECT)) == DISCONNECT:
            peer.reset()
            return
        peer.write(CONNECT_ANSWER + STATUS)
        await peer.read(len(QUERY))
        peer.write(QUERY_ANSWER)
        await peer.rest()
        peer.close()

    async with scripted(touchy) as listener:
        first, second = await tried(f"bvs://{HOST}:{listener.port}?dialect=handbook")
    assert first.hung_up
    assert first.outcome == "Connection reset by peer"
    assert second.answer is not None
    assert [one.message for one in second.frames][:2] == ["Connect", "ConnectAnswer"]


# ---------------------------------------------------------------------- what came instead


async def test_nothing_listens_each_way_reports_it() -> None:
    with refusing(socket.SOCK_STREAM) as port:
        found = await tried(f"bvs://{HOST}:{port}")
    assert {trial.outcome for trial in found} == {"Connection refused"}
    assert [trial.opened for trial in found] == [trial.transport == "udp" for trial in found]
    assert len(found) == len(names("bvs://h"))


async def test_silence_is_reported_and_bounded() -> None:
    loop = asyncio.get_running_loop()
    begin = loop.time()
    async with listening() as listener:
        found = await tried(f"bvs://{HOST}:{listener.port}?dialect=handbook")
    assert loop.time() - begin < SHORT + 1.0
    assert str(found[0]).startswith("handbook over TCP: waiting for the answer to Connect: silence")
    assert [one.hex for one in found[0].frames[:2]] == [DISCONNECT.hex(), CONNECT.hex()]


async def test_wrong_magic_shows_the_bytes() -> None:
    async def web_server(peer: Peer, number: int) -> None:
        peer.write(b"HTTP/1.1 400")
        await peer.rest()

    async with scripted(web_server) as listener:
        found = await tried(f"bvs://{HOST}:{listener.port}?dialect=handbook")
    ((text, data),) = broken(found[0])
    assert text.startswith("wrong magic number: 48 54 54 50 came")
    assert bytes.fromhex(data) == b"HTTP/1.1 400"


@pytest.mark.parametrize("dialect", ["handbook", "b16"])
async def test_bytes_that_make_no_whole_frame_are_shown(dialect: str) -> None:
    half = CONNECT_ANSWER[:14] if dialect == "handbook" else bytes.fromhex("0100 0200 01")

    async def cut_short(peer: Peer, number: int) -> None:
        await peer.read(4)
        peer.write(half)
        await peer.rest()

    async with scripted(cut_short) as listener:
        found = await tried(f"bvs://{HOST}:{listener.port}?dialect={dialect}")
    text = f"{len(half)} bytes that make no whole frame"
    assert broken(found[0]) == [(text, half.hex())]


async def test_bytes_after_whole_frames_are_shown_without_them() -> None:
    async def cut_short(peer: Peer, number: int) -> None:
        await peer.read(len(OPENING))
        peer.write(CONNECT_ANSWER + STATUS[:5])
        await peer.rest()

    async with scripted(cut_short) as listener:
        found = await tried(f"bvs://{HOST}:{listener.port}?dialect=handbook")
    assert found[0].step == "waiting for the first status"
    assert [data for _, data in broken(found[0])] == [STATUS[:5].hex()]


async def test_bytes_that_come_only_once_are_shown() -> None:
    links: list[int] = []

    async def once(peer: Peer, number: int) -> None:
        links.append(number)
        await peer.read(len(OPENING))
        if number == 1:
            peer.write(CONNECT_ANSWER[:13])
        await peer.rest()

    async with scripted(once) as listener:
        found = await tried(f"bvs://{HOST}:{listener.port}?dialect=handbook")
    text = "13 bytes that make no whole frame"
    assert broken(found[0]) == [(text, CONNECT_ANSWER[:13].hex())]
    assert links == list(range(1, len([one for one in found if one.transport == "tcp"]) + 1))


async def test_bytes_without_end_are_bounded() -> None:
    async def endless(peer: Peer, number: int) -> None:
        await peer.read(4)
        peer.write(bytes.fromhex("2000 ffff") + bytes(60_000))  # a container
        await peer.rest()

    async with scripted(endless) as listener:
        found = await tried(f"bvs://{HOST}:{listener.port}?dialect=b16")
    ((text, data),) = broken(found[0])
    assert text.startswith("60004 bytes that make no whole frame")
    assert len(bytes.fromhex(data)) == 256


async def test_frames_of_a_flood_are_bounded_and_counted() -> None:
    async def flood(peer: Peer, number: int) -> None:
        await peer.read(len(OPENING))
        peer.write(CONNECT_ANSWER + 100 * RESULT)
        await peer.rest()

    async with scripted(flood) as listener:
        found = await tried(f"bvs://{HOST}:{listener.port}?dialect=handbook")
    assert found[0].step == "waiting for the first status"
    assert len(found[0].frames) == MAX_FRAMES
    assert found[0].omitted == 3 + 100 + 1 - MAX_FRAMES  # three before it, one Disconnect


async def test_broken_datagram_is_shown() -> None:
    async with datagrams(lambda data: [b"nonsense"]) as peer:
        found = await tried(f"bvs+udp://{HOST}:{peer.port}?dialect=handbook")
    assert found[0].transport == "udp"
    assert {data for _, data in broken(found[0])} == {b"nonsense".hex()}


async def test_half_a_datagram_is_shown() -> None:
    async with datagrams(lambda data: [CONNECT_ANSWER[:14]]) as peer:
        found = await tried(f"bvs+udp://{HOST}:{peer.port}?dialect=handbook")
    text, data = broken(found[0])[0]
    assert "a datagram is not one whole frame" in text
    assert data == CONNECT_ANSWER[:14].hex()


async def test_hanging_up_in_order_is_reported() -> None:
    async def closes(peer: Peer, number: int) -> None:
        await peer.read(1)
        peer.close()

    async with scripted(closes) as listener:
        found = await tried(f"bvs://{HOST}:{listener.port}?dialect=handbook")
    assert found[0].hung_up
    assert found[0].error is not None


# ---------------------------------------------------------------------- the end


async def test_cancelled_says_disconnect() -> None:
    async with listening() as listener:
        task = asyncio.create_task(
            tried(f"bvs://{HOST}:{listener.port}?dialect=handbook", timeout=30)
        )
        peer = await listener.accept()
        assert await peer.read(len(OPENING)) == OPENING
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        assert await peer.rest() == DISCONNECT


async def test_try_that_runs_out_says_disconnect() -> None:
    goodbyes: list[bytes] = []

    async def cut_short(peer: Peer, number: int) -> None:
        await peer.read(len(OPENING))
        peer.write(CONNECT_ANSWER[:14])
        goodbyes.append(await peer.rest())

    async with scripted(cut_short) as listener:
        address = parse_address(f"bvs://{HOST}:{listener.port}?dialect=handbook")
        async with aclosing(try_ways(address, timeout=SHORT)) as found:
            assert (await anext(found)).answer is None
        async with asyncio.timeout(5.0):
            while not goodbyes:  # noqa: ASYNC110 - what is waited for has no event
                await asyncio.sleep(0)
    assert goodbyes == [DISCONNECT]
