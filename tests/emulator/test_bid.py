"""The emulated BVS ID over TCP and UDP, byte by byte."""

from __future__ import annotations

from collections.abc import AsyncIterator, Sequence
from typing import Any

import pytest

from smartcam.emulator import faults
from smartcam.models import Status
from smartcam.protocols import messages as m
from tests.emulator.wire_16_bit import (
    CONNECT,
    DISCONNECT,
    GET_CLOCK,
    GET_STATUS,
    HELLO_WORLD,
    QUERY,
    RESET_ERRORS,
    SWITCH_21,
    TRIGGER,
    Rig,
    frame,
    reopened,
    rig,
)

CONNECTED = frame("0100 0400 0000 0100")  # published: I-1
DISCONNECTED = frame("0200 0200 0000")  # published: I-2
WAITING = frame("1200 0200 2100")  # Ready and Waiting For Trigger: derived
READY = frame("1200 0200 2000")  # published: I-4
BUSY = frame("1200 0200 0000")  # derived
TRIGGER_ERROR = frame("1200 0200 2001")  # published: I-3
WAITING_TRIGGER_ERROR = frame("1200 0200 2101")  # derived
ERRORS_RESET = frame("1600 0200 0000")  # published: I-4
ACTIVE_21 = frame("3000 0400 0200 1500")  # published: I-5
ACTIVE_1 = frame("3000 0400 0200 0100")
LOADING = frame("3000 0400 1600 0000")  # derived
SWITCHED_21 = frame("3100 0400 0000 1500")
TRIGGERED = frame("4000 0200 0000")  # published: I-11
TRIGGER_BUSY = frame("4000 0200 1600")

ECHO = {
    "id": 5,
    "layout": "text: string[12]",
    "input": "text: string[12]",
    "generator": "input",
    "processing_time": 0.0,
}


@pytest.fixture
async def at_21(transport: Any) -> AsyncIterator[Rig]:
    """A camera with application 21, in a session."""
    async with rig(transport, "bid", active=21) as made:
        await made.opens(CONNECTED)
        yield made


# ---------------------------------------------------------------------- each message


async def test_bid_url_names_the_dialect(at_21: Rig, transport: str) -> None:
    scheme = {"tcp": "bvs", "udp": "bvs+udp"}[transport]
    assert at_21.emulator.url == f"{scheme}://127.0.0.1:{at_21.emulator.port}?dialect=bid"


async def test_bid_connect_is_answered_and_no_status_comes(at_21: Rig) -> None:
    await at_21.asks((QUERY, (ACTIVE_21,)), (CONNECT, (CONNECTED,)), (QUERY, (ACTIVE_21,)))


async def test_bid_status_comes_on_request(at_21: Rig) -> None:
    await at_21.asks((GET_STATUS, (WAITING,)), (GET_STATUS, (WAITING,)))


async def test_bid_reset_errors_is_answered_and_a_status_follows_always(at_21: Rig) -> None:
    await at_21.asks((RESET_ERRORS, (ERRORS_RESET, WAITING)))


async def test_bid_trigger_is_acknowledged_and_only_the_result_comes(at_21: Rig) -> None:
    await at_21.asks((TRIGGER, (TRIGGERED,)), (GET_STATUS, (READY,)))
    at_21.clock.advance(0.05)
    await at_21.client.expect(HELLO_WORLD)
    await at_21.asks((GET_STATUS, (WAITING,)))


async def test_bid_runs_without_a_start_and_has_none(at_21: Rig) -> None:
    assert at_21.emulator.device.running
    await at_21.asks(
        *[
            (frame(f"{number} 0000"), (frame(f"{number} 0200 1300"),))
            for number in ("4100", "4200", "4300")
        ],
        (frame("3500 0400 01000000"), (frame("3500 0200 1300"),)),
        (QUERY, (ACTIVE_21,)),
    )
    assert at_21.emulator.device.running


async def test_bid_clock_is_set_and_told(at_21: Rig) -> None:
    await at_21.asks(
        # I-9, published
        (frame("3300 0C00 E007 0300 0200 0C00 0E00 0A00"), (frame("3300 0200 0000"),)),
        (GET_CLOCK, (frame("3200 0E00 0600 E007 0300 0200 0C00 0E00 0A00"),)),
        # I-8, published
        (frame("3300 0C00 E007 0600 1900 0A00 0B00 0C00"), (frame("3300 0200 0000"),)),
        (GET_CLOCK, (frame("3200 0E00 0600 E007 0600 1900 0A00 0B00 0C00"),)),
    )


@pytest.mark.parametrize(
    "date",
    [
        "E007 0200 1E00 0A00 0B00 0C00",  # the 30th of February
        "E007 0000 0100 0A00 0B00 0C00",
        "E007 0600 1900 1800 0B00 0C00",
        "0000 0600 1900 0A00 0B00 0C00",
        "FFFF FFFF FFFF FFFF FFFF FFFF",
    ],
)
async def test_bid_impossible_date_is_refused_and_the_clock_goes_on(at_21: Rig, date: str) -> None:
    await at_21.asks(
        (frame("3300 0C00" + date), (frame("3300 0200 1000"),)),
        (GET_CLOCK, (frame("3200 0E00 0600 B207 0100 0100 0000 0000 0000"),)),
    )


async def test_bid_reference_value_is_acknowledged_and_used(transport: Any) -> None:
    async with rig(transport, "bid", applications=[ECHO]) as camera:
        await camera.opens(CONNECTED)
        reference = "48656C6C6F20576F726C6400"
        await camera.asks(
            (frame("3400 0C00" + reference), (frame("3400 0200 0000"),)),  # published: I-10
            (TRIGGER, (TRIGGERED, frame("2000 0E00 0500" + reference))),
            # it stays until the next one
            (TRIGGER, (TRIGGERED, frame("2000 0E00 0500" + reference))),
            (frame("3400 0C00" + "41" * 12), (frame("3400 0200 0000"),)),
            (frame("3400 0C00" + "42" * 12), (frame("3400 0200 0000"),)),
            (TRIGGER, (TRIGGERED, frame("2000 0E00 0500" + "42" * 12))),
            (GET_STATUS, (WAITING,)),
        )


@pytest.mark.parametrize("reference", ["", "48656C6C6F", "41" * 13])
async def test_bid_reference_value_of_another_length_is_refused(
    transport: Any, reference: str
) -> None:
    async with rig(transport, "bid", applications=[ECHO]) as camera:
        await camera.opens(CONNECTED)
        length = len(reference) // 2
        await camera.asks((frame(f"3400 {length:02x}00 {reference}"), (frame("3400 0200 1000"),)))


async def test_bid_reference_value_without_a_place_for_it_is_refused(at_21: Rig) -> None:
    await at_21.asks((frame("3400 0100 41"), (frame("3400 0200 1000"),)))


async def test_bid_disconnect_is_answered_and_silence_follows(at_21: Rig) -> None:
    await at_21.asks((DISCONNECT, (DISCONNECTED,)))
    at_21.client.send(QUERY, GET_STATUS, DISCONNECT)
    await at_21.emulator.wait_received(m.GetStatus)
    assert not at_21.emulator.has_session
    await at_21.asks((CONNECT, (CONNECTED,)))


async def test_bid_requests_before_connect_are_ignored(transport: Any) -> None:
    async with rig(transport, "bid", active=21) as camera:
        for request in (QUERY, GET_STATUS, RESET_ERRORS, TRIGGER, frame("7700 0000"), DISCONNECT):
            camera.client.send(request)
        camera.client.send(frame("0100 0100 FF"))  # a Connect with a body is none
        await camera.opens(CONNECTED)
        await camera.asks((QUERY, (ACTIVE_21,)))
        assert camera.emulator.device.next_number == 0


# ---------------------------------------------------------------------- switching


async def test_bid_switch_is_answered_when_it_is_done(transport: Any) -> None:
    async with rig(transport, "bid") as camera:
        await camera.opens(CONNECTED)
        await camera.asks((QUERY, (ACTIVE_1,)))
        camera.client.send(SWITCH_21)
        await camera.emulator.wait_received(m.SwitchApplication)
        await camera.asks(
            (QUERY, (LOADING,)),
            (GET_STATUS, (BUSY,)),
            (TRIGGER, (TRIGGER_BUSY,)),
            (SWITCH_21, (frame("3100 0400 1600 0100"),)),
        )
        camera.clock.advance(0.3)
        await camera.client.expect(SWITCHED_21)
        await camera.asks((QUERY, (ACTIVE_21,)), (GET_STATUS, (WAITING,)))


@pytest.mark.parametrize("application", ["0000", "0700", "FFFF"])
async def test_bid_switch_to_an_id_that_is_not_there_is_refused(
    transport: Any, application: str
) -> None:
    async with rig(transport, "bid", applications=[ECHO], active=5, builtins=False) as camera:
        await camera.opens(CONNECTED)
        refused = frame("3100 0400 1A00 0500")  # published for 7 and 1: I-7
        await camera.asks(
            (frame("3100 0200" + application), (refused,)),
            (QUERY, (frame("3000 0400 0200 0500"),)),
            (GET_STATUS, (WAITING,)),
        )


async def test_bid_switch_to_the_active_one_loads_it_again(transport: Any) -> None:
    instant = {**ECHO, "load_time": 0.0}
    async with rig(transport, "bid", applications=[instant]) as camera:
        await camera.opens(CONNECTED)
        await camera.asks((frame("3100 0200 0500"), (frame("3100 0400 0000 0500"),)))  # I-6


async def test_bid_switch_voids_the_inspection_under_way(at_21: Rig) -> None:
    await at_21.asks((TRIGGER, (TRIGGERED,)))
    at_21.client.send(SWITCH_21)
    await at_21.emulator.wait_received(m.SwitchApplication)
    at_21.clock.advance(1.0)
    await at_21.client.expect(SWITCHED_21)
    await at_21.asks((GET_STATUS, (WAITING,)))


# ---------------------------------------------------------------------- lengths and ids


@pytest.mark.sampled(every=4)
@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        ("3000 0100 00", "3000 0200 1000"),
        ("1200 0200 0000", "1200 0200 1000"),
        ("1600 0100 00", "1600 0200 1000"),
        ("3100 0000", "3100 0200 1000"),
        ("3100 0400 1500 0000", "3100 0200 1000"),
        ("3200 0100 00", "3200 0200 1000"),
        ("3300 0200 E007", "3300 0200 1000"),
        ("4000 0100 00", "4000 0200 1000"),
        ("0200 0100 00", "0200 0200 1000"),
        ("0100 0100 00", "0100 0200 1000"),
        ("7700 0000", "7700 0200 1300"),
        ("7700 0300 010203", "7700 0200 1300"),
        ("2000 0000", "2000 0200 1300"),
        ("FFFF 0000", "FFFF 0200 1300"),
        ("0000 0000", "0000 0200 1300"),
    ],
)
@pytest.mark.parametrize("told", [True, False])
@pytest.mark.parametrize("waiting", [(), (faults.Drop(on=m.ResultContainer), faults.NoResult())])
async def test_bid_bad_message_is_answered_with_a_code_or_ignored(
    transport: Any, request_: str, answer: str, *, told: bool, waiting: Sequence[faults.Fault]
) -> None:
    quirks = {"bad_message": "code" if told else "ignore"}
    async with rig(transport, "bid", active=21, quirks=quirks, faults=waiting) as camera:
        await camera.opens(CONNECTED)
        camera.client.send(frame(request_))
        if told:
            await camera.client.expect(frame(answer))
        await camera.asks((QUERY, (ACTIVE_21,)))
        assert camera.emulator.device.next_number == 0


async def test_bid_udp_datagram_that_is_no_frame_is_ignored() -> None:
    async with rig("udp", "bid", active=21) as camera:
        await camera.opens(CONNECTED)
        camera.client.send(b"", b"\x30", QUERY[:3], QUERY + b"\0", QUERY + QUERY)
        await camera.asks((QUERY, (ACTIVE_21,)))


async def test_bid_tcp_requests_in_any_pieces_are_answered_in_order() -> None:
    async with rig("tcp", "bid", active=21) as camera:
        camera.client.send(CONNECT + QUERY + GET_STATUS + RESET_ERRORS[:3])
        await camera.client.expect(CONNECTED, ACTIVE_21, WAITING)
        camera.client.send(RESET_ERRORS[3:] + DISCONNECT)
        await camera.client.expect(ERRORS_RESET, WAITING, DISCONNECTED)


# ---------------------------------------------------------------------- error bits


async def test_bid_trigger_error_stays_until_it_is_reset(at_21: Rig) -> None:
    await at_21.asks(
        (TRIGGER, (TRIGGERED,)),
        (TRIGGER, (TRIGGERED,)),  # dropped, and acknowledged nevertheless
        (GET_STATUS, (TRIGGER_ERROR,)),
    )
    at_21.clock.advance(60.0)
    await at_21.client.expect(HELLO_WORLD)
    await at_21.asks(
        (GET_STATUS, (WAITING_TRIGGER_ERROR,)),
        (DISCONNECT, (DISCONNECTED,)),
        (CONNECT, (CONNECTED,)),
        (GET_STATUS, (WAITING_TRIGGER_ERROR,)),
        (RESET_ERRORS, (ERRORS_RESET, WAITING)),
        (GET_STATUS, (WAITING,)),
    )


async def test_bid_system_error_is_not_ready_and_no_reset_clears_it(at_21: Rig) -> None:
    at_21.emulator.device.set_condition(Status.SYSTEM_ERROR, True)
    await at_21.asks(
        (GET_STATUS, (BUSY,)),
        (RESET_ERRORS, (ERRORS_RESET, BUSY)),
        (TRIGGER, (TRIGGER_BUSY,)),
        (SWITCH_21, (frame("3100 0400 1600 1500"),)),
    )
    at_21.emulator.device.set_condition(Status.SYSTEM_ERROR, False)
    await at_21.asks((GET_STATUS, (WAITING,)))


async def test_bid_not_ready_refuses_triggers_and_switches(at_21: Rig) -> None:
    at_21.emulator.inject(faults.BusyForEver())
    await at_21.asks(
        (GET_STATUS, (BUSY,)),
        (TRIGGER, (TRIGGER_BUSY,)),
        (SWITCH_21, (frame("3100 0400 1600 1500"),)),
    )
    assert at_21.emulator.device.next_number == 0


# ---------------------------------------------------------------------- restart


async def test_bid_runs_again_after_a_restart_with_its_clock_lost(transport: Any) -> None:
    async with rig(transport, "bid", active=21) as camera:
        await camera.opens(CONNECTED)
        await camera.asks(
            (frame("3300 0C00 E007 0600 1900 0A00 0B00 0C00"), (frame("3300 0200 0000"),)),
            (TRIGGER, (TRIGGERED,)),
        )
        camera.emulator.device.reboot(10.0)
        assert not camera.emulator.has_session
        camera.clock.advance(10.0)
        assert camera.emulator.device.running
        async with reopened(camera) as again:
            await again.opens(CONNECTED)
            await again.asks(
                (QUERY, (ACTIVE_21,)),
                (GET_STATUS, (WAITING,)),
                (GET_CLOCK, (frame("3200 0E00 0600 B207 0100 0100 0000 0000 0000"),)),
                (TRIGGER, (TRIGGERED,)),
            )
            camera.clock.advance(0.05)
            await again.client.expect(HELLO_WORLD)


# ---------------------------------------------------------------------- quirks


async def test_bid_push_status_tells_each_change(transport: Any) -> None:
    async with rig(transport, "bid", active=21, quirks={"push_status": True}) as camera:
        await camera.opens(CONNECTED)
        await camera.asks(
            (QUERY, (ACTIVE_21,)),  # no status came with the session
            (TRIGGER, (TRIGGERED, READY)),
            (TRIGGER, (TRIGGERED, TRIGGER_ERROR)),
            (GET_STATUS, (TRIGGER_ERROR,)),
        )
        camera.clock.advance(0.05)
        await camera.client.expect(HELLO_WORLD, WAITING_TRIGGER_ERROR)
        await camera.asks((RESET_ERRORS, (ERRORS_RESET, WAITING)), (SWITCH_21, (BUSY,)))
        camera.clock.advance(0.3)
        await camera.client.expect(SWITCHED_21, WAITING)
        await camera.asks((QUERY, (ACTIVE_21,)))


async def test_bid_silent_disconnect_ends_the_session_without_a_word(transport: Any) -> None:
    quirks = {"disconnect_answer": "silent"}
    async with rig(transport, "bid", active=21, quirks=quirks) as camera:
        await camera.opens(CONNECTED)
        camera.client.send(DISCONNECT)
        await camera.opens(CONNECTED)


async def test_bid_waiting_before_result_is_seen_on_request(transport: Any) -> None:
    quirks = {"push_status": True, "waiting_before_result": True}
    async with rig(transport, "bid", active=21, quirks=quirks) as camera:
        await camera.opens(CONNECTED)
        await camera.asks((TRIGGER, (TRIGGERED, READY)))
        camera.clock.advance(0.05)
        await camera.client.expect(WAITING, HELLO_WORLD)


async def test_bid_free_running_application_runs_from_the_beginning(transport: Any) -> None:
    async with rig(transport, "bid", active=9) as camera:
        await camera.opens(CONNECTED)
        await camera.asks((GET_STATUS, (READY,)), (TRIGGER, (TRIGGERED,)))
        camera.clock.advance(0.05)
        await camera.client.expect(frame("2000 0600 0900 00000000"))


async def test_bid_container_carries_an_id_of_16_bits(transport: Any) -> None:
    highest = {"id": 0xFFFF, "layout": "n: uint8", "constant": [7], "processing_time": 0.0}
    async with rig(transport, "bid", applications=[highest]) as camera:
        await camera.opens(CONNECTED)
        await camera.asks(
            (QUERY, (frame("3000 0400 0200 FFFF"),)),
            (TRIGGER, (TRIGGERED, frame("2000 0300 FFFF 07"))),
        )
