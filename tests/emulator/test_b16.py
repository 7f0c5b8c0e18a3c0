"""The emulated BVS SC in the dialect b16 over TCP and UDP, byte by byte."""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Any

import pytest

from smartcam.emulator import EmulatedCamera
from smartcam.exceptions import ConfigurationError
from smartcam.protocols import messages as m
from tests.emulator.wire_16_bit import (
    DISCONNECT,
    GET_CLOCK,
    GET_STATUS,
    HELLO_WORLD,
    QUERY,
    REBOOT,
    RESET_ERRORS,
    START,
    STOP,
    SWITCH_21,
    TRIGGER,
    Rig,
    frame,
    reopened,
    rig,
)

# all inferred: the bodies of the dialects with 32 bits, narrowed
CONNECTED = frame("0100 0200 0100")
NO_BIT = frame("1200 0200 0000")
BUSY = frame("1200 0200 1000")
RUNNING = frame("1200 0200 8000")
WAITING = frame("1200 0200 8002")
OVERTRIGGERED = frame("1200 0200 8001")
ACTIVE_1 = frame("3000 0200 0100")
ACTIVE_21 = frame("3000 0200 1500")
SWITCHED_21 = frame("3100 0400 0000 1500")
SET_CLOCK = frame("3300 0C00 E007 0600 1900 0A00 0B00 0C00")
CLOCK = frame("3200 0C00 E007 0600 1900 0A00 0B00 0C00")

COUNTER = {
    "id": 2,
    "layout": "n: uint32 @sequence",
    "generator": "sequence",
    "processing_time": 0.0,
}


@pytest.fixture
async def at_21(transport: Any) -> AsyncIterator[Rig]:
    """A camera that runs application 21, in a session."""
    async with rig(transport, "b16", active=21, running=True) as made:
        await made.opens(CONNECTED, WAITING)
        yield made


async def test_b16_conversation_of_the_knowledge_base(transport: Any) -> None:
    async with rig(transport, "b16") as camera:
        await camera.opens(CONNECTED, NO_BIT)
        await camera.asks((QUERY, (ACTIVE_1,)), (SWITCH_21, (BUSY,)), (QUERY, (ACTIVE_1,)))
        camera.clock.advance(0.3)
        await camera.client.expect(NO_BIT, SWITCHED_21)
        await camera.asks((START, (WAITING,)), (TRIGGER, (RUNNING,)))
        camera.clock.advance(0.05)
        await camera.client.expect(HELLO_WORLD, WAITING)
        await camera.asks((STOP, (NO_BIT,)), (QUERY, (ACTIVE_21,)))
        camera.client.send(DISCONNECT)
        await camera.emulator.wait_received(m.Disconnect)
        assert not camera.emulator.has_session


@pytest.mark.parametrize("application", ["0000", "0700", "FFFF"])
async def test_b16_switch_to_an_id_that_is_not_there_is_refused(
    transport: Any, application: str
) -> None:
    async with rig(transport, "b16", applications=[COUNTER], builtins=False) as camera:
        await camera.opens(CONNECTED, NO_BIT)
        await camera.asks(
            (frame("3100 0200" + application), (frame("3100 0400 0100 0200"),)),
            (QUERY, (frame("3000 0200 0200"),)),
        )


async def test_b16_switch_while_running_is_refused(at_21: Rig) -> None:
    await at_21.asks((frame("3100 0200 0100"), (frame("3100 0400 0100 1500"),)))


async def test_b16_dropped_trigger_shows_for_a_moment(at_21: Rig) -> None:
    await at_21.asks((TRIGGER, (RUNNING,)), (TRIGGER, (OVERTRIGGERED,)))
    at_21.clock.advance(0.06)
    await at_21.client.expect(HELLO_WORLD, frame("1200 0200 8003"))
    at_21.clock.advance(0.06)
    await at_21.client.expect(WAITING)


async def test_b16_clock_is_set_and_told(at_21: Rig) -> None:
    at_21.client.send(SET_CLOCK)
    await at_21.asks((GET_CLOCK, (CLOCK,)))


async def test_b16_impossible_date_is_dropped(at_21: Rig) -> None:
    at_21.client.send(SET_CLOCK, frame("3300 0C00 E007 0200 1E00 0A00 0B00 0C00"))
    await at_21.asks((GET_CLOCK, (CLOCK,)))


@pytest.mark.parametrize("number", ["01000000", "00B05703", "FFFFFFFF"])
async def test_b16_sequence_number_is_the_next_runs(transport: Any, number: str) -> None:
    async with rig(transport, "b16", applications=[COUNTER], running=True) as camera:
        await camera.opens(CONNECTED, WAITING)
        camera.client.send(frame("3500 0400" + number))
        await camera.asks((TRIGGER, (RUNNING, frame("2000 0600 0200" + number), WAITING)))


async def test_b16_input_data_belongs_to_the_next_inspection(transport: Any) -> None:
    echo = {"id": 2, "layout": "n: uint8", "input": "n: uint8", "generator": "input"}
    async with rig(
        transport, "b16", applications=[{**echo, "processing_time": 0.0}], running=True
    ) as camera:
        await camera.opens(CONNECTED, WAITING)
        camera.client.send(frame("3400 0100 2A"))
        await camera.asks((TRIGGER, (RUNNING, frame("2000 0300 0200 2A"), WAITING)))


@pytest.mark.parametrize(
    "request_",
    [
        "3000 0100 00",
        "3100 0000",
        "3100 0400 0100 0000",
        "3300 0200 E007",
        "3500 0200 0100",
        "4000 0100 00",
        "1200 0000",  # the status cannot be asked for
        "1600 0000",  # error bits cannot be reset
        "7700 0000",
        "2000 0200 0100",
    ],
)
async def test_b16_bad_message_is_ignored(at_21: Rig, request_: str) -> None:
    at_21.client.send(frame(request_))
    await at_21.asks((QUERY, (ACTIVE_21,)))
    assert at_21.emulator.device.next_number == 0


async def test_b16_requests_before_connect_are_ignored(transport: Any) -> None:
    async with rig(transport, "b16", active=21) as camera:
        for request in (QUERY, START, TRIGGER, GET_STATUS, RESET_ERRORS, REBOOT, DISCONNECT):
            camera.client.send(request)
        await camera.opens(CONNECTED, NO_BIT)


async def test_b16_reboot_comes_back_stopped(transport: Any) -> None:
    async with rig(transport, "b16", active=21, running=True) as camera:
        await camera.opens(CONNECTED, WAITING)
        camera.client.send(REBOOT)
        await camera.emulator.wait_received(m.Reboot)
        camera.clock.advance(30.0)
        async with reopened(camera) as again:
            await again.opens(CONNECTED, NO_BIT)
            await again.asks((QUERY, (ACTIVE_21,)))


async def test_b16_tcp_connect_of_the_other_framing_is_no_message() -> None:
    """Read as 16 bits, that Connect announces 16,982 bytes: nothing is answered any more."""
    async with rig("tcp", "b16") as camera:
        camera.client.send(frame("50535642 00000000 01000000"))
        async with reopened(camera) as other:
            await other.opens(CONNECTED, NO_BIT)
        assert [entry.message_id for entry in camera.emulator.log] == [0x01, 0x01, 0x12]


# ---------------------------------------------------------------------- quirks


async def test_b16_quirk_code_begins_answers_with_a_result_code(transport: Any) -> None:
    async with rig(transport, "b16", quirks={"code": True}) as camera:
        assert camera.emulator.url.endswith("?dialect=b16&quirks=code")
        await camera.opens(frame("0100 0400 0000 0100"), NO_BIT)
        camera.client.send(SET_CLOCK)
        await camera.asks(
            (QUERY, (frame("3000 0400 0200 0100"),)),
            (GET_CLOCK, (frame("3200 0E00 0600 E007 0600 1900 0A00 0B00 0C00"),)),
            (frame("3100 0200 0000"), (frame("3100 0400 1A00 0100"),)),
            (SWITCH_21, (BUSY,)),
        )
        camera.clock.advance(0.3)
        await camera.client.expect(NO_BIT, SWITCHED_21)
        # what has no answer in b16 has none here
        camera.client.send(frame("3400 0000"), frame("3500 0400 01000000"), GET_STATUS)
        await camera.asks((START, (WAITING,)), (TRIGGER, (RUNNING,)), (STOP, (NO_BIT,)))


async def test_b16_quirk_no_id_leaves_the_containers_id_out(transport: Any) -> None:
    async with rig(transport, "b16", active=21, running=True, quirks={"no_id": True}) as camera:
        assert camera.emulator.url.endswith("?dialect=b16&quirks=no_id")
        await camera.opens(CONNECTED, WAITING)
        await camera.asks((TRIGGER, (RUNNING,)))
        camera.clock.advance(0.05)
        hello = frame("2000 1400 48656C6C6F20576F726C64 000000000000000000")  # as in B-5
        await camera.client.expect(hello, WAITING)


async def test_b16_quirk_big_endian_number_reads_the_manuals_example(transport: Any) -> None:
    quirks = {"big_endian_number": True}
    async with rig(transport, "b16", applications=[COUNTER], running=True, quirks=quirks) as camera:
        await camera.opens(CONNECTED, WAITING)
        camera.client.send(frame("3500 0400 0357B000"))  # published: B-6, 56,078,336
        await camera.asks((TRIGGER, (RUNNING, frame("2000 0600 0200 00B05703"), WAITING)))


async def test_b16_quirks_together_stand_in_the_url() -> None:
    quirks = {"code": True, "no_id": True, "big_endian_number": True}
    async with EmulatedCamera(dialect="b16", quirks=quirks) as emulator:
        assert emulator.url.endswith("?dialect=b16&quirks=big_endian_number,code,no_id")


@pytest.mark.parametrize("dialect", ["handbook", "thesis", "bid"])
@pytest.mark.parametrize("quirk", ["code", "no_id", "big_endian_number"])
def test_quirk_of_b16_in_another_dialect_is_refused(dialect: str, quirk: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        EmulatedCamera(dialect=dialect, quirks={quirk: True})
    assert (
        str(caught.value)
        == f"emulator: quirks: dialect {dialect} has no quirk {quirk!r}; it has none"
    )


@pytest.mark.parametrize("dialect", ["b16", "bid"])
def test_application_whose_id_has_more_than_16_bits_is_refused(dialect: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        EmulatedCamera([{"id": 0x10000}], dialect=dialect)
    assert str(caught.value) == (
        "emulator: applications.0.id: application id 65536 does not fit "
        f"dialect {dialect}: 1 to 65535"
    )
