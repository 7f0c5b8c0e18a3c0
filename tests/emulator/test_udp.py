"""The emulated camera over UDP, datagram by datagram."""

from __future__ import annotations

import logging
from collections.abc import AsyncIterator
from typing import Any

import pytest

from smartcam.emulator import EmulatedCamera, ManualClock
from smartcam.protocols import messages as m
from tests.emulator import camera_wire as wire
from tests.emulator.camera_wire import UdpClient


@pytest.fixture
async def emulator(clock: ManualClock) -> AsyncIterator[EmulatedCamera]:
    async with EmulatedCamera(transport="udp", clock=clock) as camera:
        yield camera


@pytest.fixture
async def session(emulator: EmulatedCamera) -> AsyncIterator[UdpClient]:
    async with UdpClient(emulator) as client:
        await wire.greet(client)
        yield client


async def test_udp_one_message_is_one_datagram(
    emulator: EmulatedCamera, session: UdpClient, clock: ManualClock
) -> None:
    assert emulator.url == f"bvs+udp://127.0.0.1:{emulator.port}?dialect=handbook"
    session.send(wire.SWITCH_21)
    await session.expect(wire.BUSY)
    clock.advance(0.3)
    await session.expect(wire.NO_BIT, wire.SWITCHED_21)
    session.send(wire.START, wire.TRIGGER)
    await session.expect(wire.WAITING, wire.RUNNING)
    clock.advance(0.05)
    await session.expect(wire.HELLO_WORLD, wire.WAITING)


async def test_udp_in_the_dialect_of_the_thesis(clock: ManualClock) -> None:
    async with (
        EmulatedCamera(transport="udp", dialect="thesis", clock=clock) as emulator,
        UdpClient(emulator) as client,
    ):
        client.send(wire.CONNECT, wire.thesis(wire.CONNECT))
        await client.expect(*map(wire.thesis, wire.HELLO))
        await client.expect_nothing_but(wire.thesis(wire.QUERY), wire.thesis(wire.ACTIVE_1))


@pytest.mark.parametrize(
    "datagram",
    [
        b"",
        b"P",
        wire.QUERY[:-1],
        wire.QUERY + b"\0",
        wire.QUERY + wire.QUERY,
        bytes.fromhex("50535642 04000000 01000000"),
        bytes.fromhex("42565350 00000000 30000000"),
        bytes.fromhex("50535642 00000000 77000000"),
        bytes(1000),
    ],
)
async def test_udp_invalid_datagram_is_ignored(session: UdpClient, datagram: bytes) -> None:
    session.send(datagram)
    await session.expect_nothing_but(wire.QUERY, wire.ACTIVE_1)


async def test_udp_two_halves_are_no_message(session: UdpClient) -> None:
    session.send(wire.GET_CLOCK[:5], wire.GET_CLOCK[5:])
    await session.expect_nothing_but(wire.QUERY, wire.ACTIVE_1)


async def test_udp_before_connect_silence(emulator: EmulatedCamera) -> None:
    async with UdpClient(emulator) as client:
        client.send(wire.QUERY, wire.START, wire.CONNECT)
        await client.expect(*wire.HELLO)


async def test_udp_after_disconnect_silence(
    emulator: EmulatedCamera, session: UdpClient, clock: ManualClock
) -> None:
    session.send(wire.START, wire.TRIGGER)
    await session.expect(wire.WAITING, wire.RUNNING)
    session.send(wire.DISCONNECT, wire.QUERY)
    await emulator.wait_received(m.Query)
    clock.advance(1.0)
    assert not emulator.has_session
    session.send(wire.CONNECT)
    await session.expect(wire.CONNECTED, wire.WAITING)


@pytest.mark.parametrize("second_client", ["takeover", "refuse"])
async def test_udp_newcomer_wins_whatever_the_quirk_for_tcp_says(
    clock: ManualClock, second_client: str
) -> None:
    quirks = {"second_client": second_client}
    async with (
        EmulatedCamera(transport="udp", clock=clock, quirks=quirks) as emulator,
        UdpClient(emulator) as old,
        UdpClient(emulator) as new,
    ):
        await wire.greet(old)
        new.send(wire.QUERY, wire.CONNECT)
        await new.expect(*wire.HELLO)
        old.send(wire.QUERY)
        await emulator.wait_received(m.Query, count=2)
        await wire.greet(old)


async def test_udp_peers_are_bounded_and_the_session_is_kept(
    emulator: EmulatedCamera, session: UdpClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(EmulatedCamera, "max_links", 2)
    async with UdpClient(emulator) as second, UdpClient(emulator) as third:
        second.send(wire.QUERY)
        await emulator.wait_received(m.Query)
        third.send(wire.QUERY)
        await emulator.wait_received(m.Query, count=2)
        assert (len(emulator.links), emulator.crowded_out) == (2, 1)
        await session.expect_nothing_but(wire.QUERY, wire.ACTIVE_1)
        await wire.greet(second)


async def test_udp_peer_that_is_gone_is_not_noticed(
    emulator: EmulatedCamera, session: UdpClient, clock: ManualClock
) -> None:
    session.send(wire.START)
    await session.expect(wire.WAITING)
    session.socket.close()
    emulator.device.trigger()
    clock.advance(0.1)
    assert emulator.has_session
    async with UdpClient(emulator) as other:
        other.send(wire.CONNECT)
        await other.expect(wire.CONNECTED, wire.WAITING)


async def test_udp_reboot_is_silent_until_the_camera_is_up(
    emulator: EmulatedCamera, session: UdpClient, clock: ManualClock
) -> None:
    port = emulator.port
    session.send(wire.REBOOT)
    await emulator.wait_received(m.Reboot)
    assert not emulator.has_session
    clock.advance(29.9)
    assert emulator.device.rebooting
    clock.advance(0.1)
    assert emulator.port == port
    await wire.greet(session)


async def test_udp_datagrams_for_a_network_that_is_too_slow_are_dropped(
    emulator: EmulatedCamera,
    session: UdpClient,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(EmulatedCamera, "write_limit", -1)
    with caplog.at_level(logging.WARNING, logger="smartcam.emulator"):
        emulator.device.start()
    assert "datagram dropped: the network is too slow" in caplog.text
    monkeypatch.undo()
    await session.expect_nothing_but(wire.QUERY, wire.ACTIVE_1)


async def test_udp_shut_listener_neither_hears_nor_speaks(emulator: EmulatedCamera) -> None:
    listener: Any = emulator._listener
    await emulator.stop()
    listener.datagram_received(wire.CONNECT, ("127.0.0.1", 9))
    listener.send(wire.CONNECT, ("127.0.0.1", 9))
    listener.error_received(ConnectionRefusedError("nobody there"))
    assert emulator.links == []
