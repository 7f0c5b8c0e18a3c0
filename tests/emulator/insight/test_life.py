"""The emulated In-Sight camera's port: login, several clients, bounds, operator's switches."""

from __future__ import annotations

import asyncio
import contextlib

import numpy as np
import pytest

from smartcam.emulator import EmulatedInSight, InSightQuirks, ManualClock
from smartcam.exceptions import ConfigurationError, ResponseTimeoutError
from tests.emulator.inside import _TcpLink
from tests.emulator.insight import insight_wire as wire
from tests.emulator.insight.insight_wire import TelnetClient
from tests.handmade import until

MAX_INPUT_BYTES = 64 << 10
MAX_LOGGED = 4 << 10
MAX_SESSIONS = 16


JOB = {"file": "1.job", "cells": {"A1": 5}, "acquisition_time": 0.1, "processing_time": 0.1}


# ---------------------------------------------------------------------- start and stop


async def test_start_and_stop_keep_the_port_and_the_time_that_was_left() -> None:
    clock = ManualClock()
    free = {"file": "1.job", "rate": 10}
    emulator = EmulatedInSight([free], online=True, clock=clock)
    assert emulator.port == 0
    clock.advance(1000)
    await emulator.start()
    await emulator.start()
    port = emulator.port
    assert emulator.url == f"insight://127.0.0.1:{port}"
    clock.advance(0.15)
    assert emulator.device.runs == 1
    await emulator.stop()
    await emulator.stop()
    clock.advance(1000)
    assert emulator.device.runs == 1
    async with emulator:
        assert emulator.port == port
        clock.advance(0.05)
        assert emulator.device.runs == 2


async def test_stop_ends_connections_and_what_is_under_way_is_not_answered() -> None:
    async with EmulatedInSight([JOB], online=True, clock=ManualClock()) as emulator:
        client = await TelnetClient.log_in(emulator)
        client.send(b"SW8\r\n")
        await emulator.wait_heard("SW")
    async with client:
        await client.expect_end()
    assert emulator.links == []


async def test_port_that_is_taken_is_a_configuration_error() -> None:
    async with EmulatedInSight() as first:
        second = EmulatedInSight(port=first.port)
        with pytest.raises(ConfigurationError, match="emulator: cannot listen on tcp 127"):
            await second.start()


async def test_operator_may_act_before_the_start() -> None:
    emulator = EmulatedInSight([JOB, {"file": "2.job"}])
    emulator.load(2)
    emulator.set_online(True)
    async with emulator, await TelnetClient.log_in(emulator) as client:
        await client.ask(b"GO\r\nGJ\r\n", b"1\r\n1\r\n2\r\n")


# ---------------------------------------------------------------------- login


async def test_login_to_the_byte() -> None:
    async with (
        EmulatedInSight(users={"op": "secret"}, model="IS7802") as emulator,
        await TelnetClient.open(emulator) as client,
    ):
        await client.expect(b"Welcome to In-Sight(tm)  IS7802 Session 0\r\nUser: ")
        await client.ask(b"op\r\n", b"Password: ")
        assert emulator.sessions == []
        await client.ask(b"secret\r\n", b"User Logged In\r\n")
        assert emulator.sessions == emulator.links
        assert [entry.text for entry in emulator.log if entry.direction == "in"] == ["op", "***"]


@pytest.mark.parametrize(
    ("user", "password"), [(b"admin", b"x"), (b"Admin", b""), (b"nobody", b""), (b"", b"")]
)
async def test_refused_login_ends_the_connection(user: bytes, password: bytes) -> None:
    async with EmulatedInSight() as emulator, await TelnetClient.open(emulator) as client:
        await client.expect(wire.GREETING)
        await client.ask(user + b"\r\n", wire.PASSWORD)
        await client.ask(password + b"\r\n", wire.REFUSED)
        await client.expect_end()


async def test_login_and_commands_may_come_in_one_piece() -> None:
    async with EmulatedInSight([JOB]) as emulator, await TelnetClient.open(emulator) as client:
        client.send(b"admin\r\n\r\nGF\x00GJ\r\x00" + 500 * b"GVA001\r\n")
        await client.expect(wire.GREETING + wire.PASSWORD + wire.LOGGED_IN)
        await client.expect(b"1\r\n1.job\r\n1\r\n1\r\n" + 500 * b"1\r\n5.000\r\n")


async def test_command_before_the_login_is_a_user_name() -> None:
    async with EmulatedInSight() as emulator, await TelnetClient.open(emulator) as client:
        await client.expect(wire.GREETING)
        await client.ask(b"SO1\r\n", wire.PASSWORD)
        assert not emulator.online


# ---------------------------------------------------------------------- several clients


async def test_sessions_have_the_lowest_free_number() -> None:
    async with EmulatedInSight() as emulator:
        first = await TelnetClient.log_in(emulator, 0)
        async with await TelnetClient.log_in(emulator, 1):
            assert len(emulator.sessions) == 2
            async with first:
                first.writer.close()
                await first.writer.wait_closed()
            async with await TelnetClient.open(emulator) as third:
                await third.expect(wire.GREETING)


async def test_connection_too_many_is_closed() -> None:
    async with EmulatedInSight() as emulator, contextlib.AsyncExitStack() as stack:
        for number in range(MAX_SESSIONS):
            await stack.enter_async_context(await TelnetClient.log_in(emulator, number))
        client = await stack.enter_async_context(await TelnetClient.open(emulator))
        await client.expect_end()
        assert len(emulator.links) == MAX_SESSIONS


async def test_client_always_gets_in_if_not_all_are_logged_in() -> None:
    async with EmulatedInSight() as emulator, contextlib.AsyncExitStack() as stack:
        first = await stack.enter_async_context(await TelnetClient.log_in(emulator))
        idle = [
            await stack.enter_async_context(await TelnetClient.open(emulator))
            for _ in range(3 * MAX_SESSIONS)
        ]
        async with await TelnetClient.open(emulator) as client:
            await client.expect(wire.GREETING.replace(b"0\r", b"4\r"))
            await client.ask(b"admin\r\n", wire.PASSWORD)
            await client.ask(b"\r\n", wire.LOGGED_IN)
            for one in idle[: 2 * MAX_SESSIONS]:
                await one.reader.read()  # to its end
            await first.ask(b"GO\r\n", b"0\r\n")
            assert len(emulator.links) == MAX_SESSIONS
            assert emulator.crowded_out == 2 * MAX_SESSIONS + 2
    assert len(asyncio.all_tasks()) == 1


async def test_clients_are_served_side_by_side() -> None:
    clock = ManualClock()
    async with (
        EmulatedInSight([JOB], online=True, clock=clock) as emulator,
        await TelnetClient.log_in(emulator) as client,
        await TelnetClient.log_in(emulator, 1) as other,
    ):
        client.send(b"SW8\r\nGO\r\n")
        await emulator.wait_heard("SW")
        await other.ask(b"GO\r\nSW8\r\n", b"1\r\n-2\r\n")
        clock.advance(0.2)
        await client.expect(b"1\r\n1\r\n")


async def test_client_that_leaves_does_not_end_its_run() -> None:
    clock = ManualClock()
    async with EmulatedInSight([JOB], online=True, clock=clock) as emulator:
        async with await TelnetClient.log_in(emulator) as client:
            client.send(b"SW8\r\n")
            await emulator.wait_heard("SW")
        clock.advance(0.2)
        assert emulator.device.runs == 1


# ---------------------------------------------------------------------- bounds


async def test_line_that_is_too_long_ends_the_connection() -> None:
    async with EmulatedInSight() as emulator, await TelnetClient.log_in(emulator) as client:
        client.send(b"SS" + 5000 * b"x")
        await client.expect_end()


async def test_commands_after_one_under_way_wait_in_a_bounded_buffer() -> None:
    clock = ManualClock()
    line = b"SS" + 4000 * b"x" + b"\r\n"
    async with (
        EmulatedInSight([JOB], online=True, clock=clock) as emulator,
        await TelnetClient.log_in(emulator) as client,
    ):
        (link,) = emulator._clients
        assert isinstance(link, _TcpLink)
        client.send(b"SW8\r\n" + 500 * line)
        await until(lambda: not link._transport.is_reading())
        assert MAX_INPUT_BYTES < link.machine.buffered < MAX_INPUT_BYTES + 2**18 + 1
        clock.advance(0.2)
        await client.expect(wire.DONE + 500 * wire.INVALID)


async def test_client_that_does_not_read_loses_its_connection() -> None:
    image = np.zeros((2000, 4000), np.uint8)
    async with (
        EmulatedInSight(image=image) as emulator,
        await TelnetClient.log_in(emulator) as client,
    ):
        client.send(3 * b"RI\r\n")
        await until(lambda: not emulator.links)


async def test_log_is_bounded_and_cuts_what_is_long() -> None:
    async with EmulatedInSight() as emulator, await TelnetClient.log_in(emulator) as client:
        client.send(b"RI\r\n")
        await client.expect(b"1\r\n8300\r\n424D")
        assert emulator.log.maxlen == 10_000
        assert len(emulator.log[-1].text) == MAX_LOGGED
        assert (emulator.log[-3].direction, emulator.log[-3].text) == ("in", "RI")


# ---------------------------------------------------------------------- switches


async def test_refused_login_refuses_everybody() -> None:
    async with EmulatedInSight() as emulator:
        emulator.refuse_login = True
        async with await TelnetClient.open(emulator) as client:
            await client.expect(wire.GREETING)
            await client.ask(b"admin\r\n", wire.PASSWORD)
            await client.ask(b"\r\n", wire.REFUSED)
        emulator.refuse_login = False
        async with await TelnetClient.log_in(emulator):
            pass


async def test_silent_camera_hears_and_says_nothing() -> None:
    async with EmulatedInSight([JOB]) as emulator, await TelnetClient.log_in(emulator) as client:
        emulator.silent = True
        client.send(b"SO1\r\n")
        await emulator.wait_heard("SO")
        assert emulator.online
        emulator.silent = False
        await client.ask(b"GO\r\n", b"1\r\n")


async def test_dropped_connections_are_gone_and_new_ones_are_served() -> None:
    async with EmulatedInSight() as emulator:
        async with await TelnetClient.log_in(emulator) as client:
            emulator.drop_connections()
            await client.expect_end()
        assert emulator.links == []
        async with await TelnetClient.log_in(emulator):
            pass


async def test_ordered_answers_take_the_place_of_commands() -> None:
    async with EmulatedInSight([JOB]) as emulator, await TelnetClient.log_in(emulator) as client:
        emulator.answer_next(-6, command="so")
        emulator.answer_next(-4)
        await client.ask(b"GO\r\nSO1\r\nGO\r\n", b"-4\r\n-6\r\n0\r\n")


async def test_ordered_answers_are_bounded() -> None:
    emulator = EmulatedInSight()
    for _ in range(1000):
        emulator.answer_next(0)
    with pytest.raises(ConfigurationError, match="1000 codes wait already"):
        emulator.answer_next(0)


async def test_wait_heard_gives_up_with_what_was_heard() -> None:
    async with EmulatedInSight([JOB]) as emulator, await TelnetClient.log_in(emulator) as client:
        await client.ask(b"GO\r\n", b"0\r\n")
        with pytest.raises(
            ResponseTimeoutError, match=r"the emulator received 1 of 2 GO in 0\.05 s"
        ) as caught:
            await emulator.wait_heard("go", count=2, timeout=0.05)
        assert caught.value.waited == 0.05


async def test_operator_triggers_and_loads() -> None:
    async with EmulatedInSight([JOB, {"file": "2.job"}], clock=ManualClock()) as emulator:
        assert not emulator.trigger()
        emulator.set_online(True)
        assert emulator.trigger()
        assert not emulator.trigger()
        emulator.load("2.job")
        assert emulator.active == "2.job"
        assert emulator.trigger()
        with pytest.raises(ConfigurationError, match=r"job 3 is not on the camera; there are: 1"):
            emulator.load(3)


async def test_operator_cannot_load_while_a_client_does() -> None:
    async with (
        EmulatedInSight([JOB, {"file": "2.job"}], clock=ManualClock()) as emulator,
        await TelnetClient.log_in(emulator) as client,
    ):
        client.send(b"SJ2\r\n")
        await emulator.wait_heard("SJ")
        with pytest.raises(ConfigurationError, match="job 1: another one is being loaded"):
            emulator.load(1)


def test_quirks_that_are_none_are_a_configuration_error() -> None:
    assert EmulatedInSight(quirks=InSightQuirks(image_size="bytes")).quirks.image_size == "bytes"
    with pytest.raises(ConfigurationError, match=r"quirks: image_size: .*'lines'"):
        EmulatedInSight(quirks={"image_size": "lines"})
    with pytest.raises(ConfigurationError, match="info: known are Serial Number, "):
        EmulatedInSight(info={"Colour": "red"})
    with pytest.raises(ConfigurationError, match="evaluations: X: only Latin-1 can be sent"):
        EmulatedInSight(evaluations={"X": "\u20ac"})
