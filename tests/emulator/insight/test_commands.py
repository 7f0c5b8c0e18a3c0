"""Commands of the emulated In-Sight camera, to the byte, over a real connection."""

from __future__ import annotations

import struct
from collections.abc import AsyncIterator
from typing import Any

import numpy as np
import pytest

from smartcam.emulator import EmulatedInSight, InSightQuirks, Job, ManualClock
from smartcam.protocols._inside import words
from tests.emulator.inside import BUILTIN_JOBS
from tests.emulator.insight import insight_wire as wire
from tests.emulator.insight.insight_wire import TelnetClient

JOBS: list[dict[str, Any]] = [
    {
        "file": "7bolts.job",
        "cells": {
            "A1": [1, 2.5, "three"],
            "B2": {"kind": "int", "value": 3, "low": 0, "high": 10},
            "C3": {"kind": "float", "value": 0.5},
            "D4": {"kind": "string", "value": "Before SS", "max_length": 20},
            "E5": lambda run: run * 10,
            "Passed": True,
            "F6": float("nan"),
            "G7": "28.9\xb0",
        },
        "acquisition_time": 0,
        "processing_time": 0,
    },
    {"file": "nuts.job", "load_time": 1.5, "cells": {"A1": "nuts"}},
    {"file": "12free.jobx", "rate": 10, "load_time": 0, "cells": {"A1": lambda run: run}},
]


@pytest.fixture
async def emulator(clock: ManualClock) -> AsyncIterator[EmulatedInSight]:
    async with EmulatedInSight(JOBS, clock=clock) as emulator:
        yield emulator


@pytest.fixture
async def client(emulator: EmulatedInSight) -> AsyncIterator[TelnetClient]:
    async with await TelnetClient.log_in(emulator) as client:
        yield client


# ---------------------------------------------------------------------- words


@pytest.mark.parametrize(
    ("command", "answer"),
    [
        (b"", wire.UNKNOWN),
        (b"G", wire.UNKNOWN),
        (b"QQ", wire.UNKNOWN),
        (b" GO", wire.UNKNOWN),
        (b"GO1", wire.UNKNOWN),
        (b"GJ ", wire.UNKNOWN),
        (b"Put Live 1", wire.UNKNOWN),
        (b"go", b"0\r\n"),
        (b"gF", b"1\r\n7bolts.job\r\n"),
    ],
)
async def test_command_is_two_letters_of_either_case(
    client: TelnetClient, command: bytes, answer: bytes
) -> None:
    await client.ask(command + b"\r\n", answer)
    await client.expect_nothing()


async def test_every_command_of_the_table_is_known(client: TelnetClient) -> None:
    for mnemonic in words.COMMANDS:
        client.send(mnemonic.encode() + b"\r\n")
        answer = await client.reader.readline()
        assert mnemonic == "GO" or answer != wire.UNKNOWN, mnemonic
        if answer == wire.DONE:
            lines = {words.AnswerForm.LINE: 1, words.AnswerForm.INFO: 5}
            digits = 2 * (14 + 40 + 1024 + 64 * 48)
            lines[words.AnswerForm.HEX] = 1 + -(-digits // 80) + 1
            for _ in range(lines[words.COMMANDS[mnemonic].form]):
                await client.reader.readline()
    await client.expect_nothing()


# ---------------------------------------------------------------------- mode


async def test_set_online_switches_and_get_online_tells(client: TelnetClient) -> None:
    await client.ask(b"GO\r\nSO1\r\nGO\r\nSO1\r\nSO0\r\nGO\r\n", b"0\r\n1\r\n1\r\n1\r\n1\r\n0\r\n")


@pytest.mark.parametrize("argument", [b"", b"2", b"-1", b"on", b" 1", b"01"])
async def test_set_online_of_anything_else_is_invalid(
    client: TelnetClient, argument: bytes
) -> None:
    await client.ask(b"SO" + argument + b"\r\n", wire.INVALID)


async def test_set_online_of_a_camera_held_offline_says_so(
    emulator: EmulatedInSight, client: TelnetClient
) -> None:
    emulator.set_online(False)
    await client.ask(b"SO1\r\n", wire.HELD)
    await client.ask(b"GO\r\n", b"0\r\n")
    emulator.set_online(True)
    await client.ask(b"GO\r\n", b"1\r\n")


# ---------------------------------------------------------------------- jobs


async def test_load_file_and_set_job_make_a_job_active(
    clock: ManualClock, emulator: EmulatedInSight, client: TelnetClient
) -> None:
    client.send(b"LFnuts.job\r\n")
    await emulator.wait_heard("LF")
    clock.advance(1.4999)
    assert emulator.active == "7bolts.job"
    clock.advance(0.0001)
    await client.expect(wire.DONE)
    await client.ask(b"GF\r\nGJ\r\nGVA001\r\n", b"1\r\nnuts.job\r\n-2\r\n1\r\nnuts\r\n")
    client.send(b"SJ7\r\n")
    await emulator.wait_heard("SJ")
    clock.advance(0.5)
    await client.ask(b"GF\r\nGJ\r\n", wire.DONE + b"1\r\n7bolts.job\r\n1\r\n7\r\n")


async def test_load_file_needs_no_extension(client: TelnetClient) -> None:
    await client.ask(b"LF12free\r\n", wire.DONE)
    await client.ask(b"GF\r\n", b"1\r\n12free.jobx\r\n")


@pytest.mark.parametrize(
    ("command", "answer"),
    [
        (b"LF", wire.INVALID),
        (b"LFbolts.job", wire.FAILED),
        (b"LF7BOLTS.JOB", wire.FAILED),
        (b"SJ", wire.INVALID),
        (b"SJ-1", wire.INVALID),
        (b"SJ7.0", wire.INVALID),
        (b"SJ8", wire.FAILED),
        (b"SJ1000", wire.FAILED),
    ],
)
async def test_load_of_no_job_is_refused(
    client: TelnetClient, command: bytes, answer: bytes
) -> None:
    await client.ask(command + b"\r\n", answer)
    await client.ask(b"GF\r\n", b"1\r\n7bolts.job\r\n")


async def test_load_is_refused_online_and_while_another_job_is_loaded(
    clock: ManualClock, emulator: EmulatedInSight, client: TelnetClient
) -> None:
    await client.ask(b"SO1\r\nLFnuts.job\r\nSJ7\r\nSO0\r\n", b"1\r\n-2\r\n-2\r\n1\r\n")
    async with await TelnetClient.log_in(emulator, 1) as other:
        client.send(b"LFnuts.job\r\n")
        await emulator.wait_heard("LF", count=2)
        await other.ask(b"SJ7\r\nSO1\r\nGVPassed\r\nGO\r\n", b"-2\r\n-2\r\n-2\r\n0\r\n")
        await other.ask(b"SIB0025\r\nGF\r\n", b"-2\r\n1\r\n7bolts.job\r\n")
        clock.advance(1.5)
        await client.expect(wire.DONE)


async def test_camera_without_jobs_has_one_that_was_never_saved() -> None:
    async with (
        EmulatedInSight(online=True) as emulator,
        await TelnetClient.log_in(emulator) as client,
    ):
        assert emulator.active is None
        await client.ask(b"GF\r\nGJ\r\nGVA000\r\nSIA0001\r\n", 4 * wire.FAILED)
        await client.ask(b"SW8\r\n", wire.DONE)


# ---------------------------------------------------------------------- events


async def test_wait_is_answered_with_the_cells_there_and_set_event_at_the_image() -> None:
    clock = ManualClock()
    job = Job(
        file="1.job", cells={"A1": lambda run: run}, acquisition_time=0.2, processing_time=0.3
    )
    async with (
        EmulatedInSight([job], online=True, clock=clock) as emulator,
        await TelnetClient.log_in(emulator) as client,
    ):
        client.send(b"SE8\r\nGVA001\r\n")
        await emulator.wait_heard("SE")
        clock.advance(0.2)
        await client.expect(b"1\r\n1\r\n#ERR\r\n")
        await client.ask(b"SW8\r\n", wire.FAILED)
        clock.advance(0.3)
        await client.ask(b"GVA001\r\n", b"1\r\n1.000\r\n")
        client.send(b"SW8\r\nGVA001\r\n")
        await emulator.wait_heard("SW", count=2)
        clock.advance(0.5)
        await client.expect(b"1\r\n1\r\n2.000\r\n")
        assert emulator.device.runs == 2


@pytest.mark.parametrize("argument", [b"", b"9", b"-1", b"x", b"8 ", b"8.0"])
@pytest.mark.parametrize("command", [b"SE", b"SW"])
async def test_event_of_another_number_is_invalid(
    client: TelnetClient, command: bytes, argument: bytes
) -> None:
    await client.ask(b"SO1\r\n", wire.DONE)
    await client.ask(command + argument + b"\r\n", wire.INVALID)


async def test_events_fail_offline(client: TelnetClient) -> None:
    await client.ask(b"SE8\r\nSW8\r\nSE0\r\nSW7\r\n", 4 * wire.FAILED)


async def test_soft_event_acquires_nothing(emulator: EmulatedInSight, client: TelnetClient) -> None:
    await client.ask(b"SO1\r\nSE0\r\nSW7\r\n", 3 * wire.DONE)
    assert emulator.device.runs == 0


async def test_job_that_runs_freely_takes_no_trigger(
    clock: ManualClock, emulator: EmulatedInSight, client: TelnetClient
) -> None:
    await client.ask(b"SJ12\r\nSO1\r\nSW8\r\nSE8\r\n", b"1\r\n1\r\n-2\r\n-2\r\n")
    clock.advance(0.35)
    await client.ask(b"GVA001\r\nSO0\r\n", b"1\r\n3.000\r\n1\r\n")
    clock.advance(1.0)
    await client.ask(b"GVA001\r\nSO1\r\n", b"1\r\n3.000\r\n1\r\n")
    clock.advance(0.1)
    await client.ask(b"GVA001\r\n", b"1\r\n4.000\r\n")
    assert emulator.device.runs == 4


async def test_run_that_another_client_breaks_off_fails() -> None:
    clock = ManualClock()
    async with (
        EmulatedInSight([{"file": "1.job"}], online=True, clock=clock) as emulator,
        await TelnetClient.log_in(emulator) as client,
        await TelnetClient.log_in(emulator, 1) as other,
    ):
        client.send(b"SW8\r\n")
        await emulator.wait_heard("SW")
        await other.ask(b"SO0\r\n", wire.DONE)
        await client.expect(wire.FAILED)
        clock.advance(1.0)
        await client.expect_nothing()
        assert emulator.device.runs == 0


async def test_sized_answer_to_an_event_is_a_quirk() -> None:
    quirks = InSightQuirks(event_answer="sized")
    async with (
        EmulatedInSight(JOBS, online=True, quirks=quirks) as emulator,
        await TelnetClient.log_in(emulator) as client,
    ):
        await client.ask(b"SE8\r\nSE9\r\nSW8\r\n", b"1\r\n0\r\n\r\n-1\r\n1\r\n")


# ---------------------------------------------------------------------- cells


async def test_values_are_shown_with_three_decimals_and_go_on_with_each_run(
    emulator: EmulatedInSight, client: TelnetClient
) -> None:
    await client.ask(b"GVA001\r\nGVE005\r\n", 2 * b"1\r\n#ERR\r\n")
    await client.ask(b"SO1\r\n", wire.DONE)
    for first, other in [
        (b"1.000", b"10"),
        (b"2.500", b"20"),
        (b"three", b"30"),
        (b"1.000", b"40"),
    ]:
        await client.ask(b"SW8\r\nGVA001\r\n", b"1\r\n1\r\n" + first + b"\r\n")
        await client.ask(b"gve005\r\n", b"1\r\n" + other + b".000\r\n")
    await client.ask(b"GVpassed\r\nGVF006\r\n", b"1\r\n1.000\r\n1\r\n#ERR\r\n")
    await client.ask(b"GVG007\r\n", b"1\r\n28.9\xb0\r\n")
    emulator.load(7)
    await client.ask(b"GVA001\r\n", b"1\r\n#ERR\r\n")


@pytest.mark.parametrize(
    ("command", "answer"),
    [
        (b"GV", wire.INVALID),
        (b"GVA1", wire.INVALID),
        (b"GVA01", wire.INVALID),
        (b"GVA0011", wire.INVALID),
        (b"GVA400", wire.INVALID),
        (b"GVA001:B002", wire.INVALID),
        (b"GVPassed ", wire.INVALID),
        (b"GVNobody", wire.INVALID),
        (b"GVZ399", wire.FAILED),
    ],
)
async def test_value_of_no_cell_is_refused(
    client: TelnetClient, command: bytes, answer: bytes
) -> None:
    await client.ask(command + b"\r\n", answer)
    await client.expect_nothing()


async def test_controls_are_set_until_the_job_is_loaded_again(
    emulator: EmulatedInSight, client: TelnetClient
) -> None:
    await client.ask(b"SIB0028\r\nGVB002\r\n", b"1\r\n1\r\n8.000\r\n")
    await client.ask(b"SFC003-2.25\r\nGVC003\r\n", b"1\r\n1\r\n-2.250\r\n")
    await client.ask(b"SSD004After SS\r\nGVD004\r\n", b"1\r\n1\r\nAfter SS\r\n")
    await client.ask(b"SO1\r\nSW8\r\nGVB002\r\n", b"1\r\n1\r\n1\r\n8.000\r\n")
    emulator.load("7bolts")
    await client.ask(b"GVB002\r\nGVD004\r\n", b"1\r\n3.000\r\n1\r\nBefore SS\r\n")


async def test_control_with_a_name_is_set_behind_a_space() -> None:
    job = {"file": "1.job", "cells": {"Math_1.A1": {"kind": "string", "value": ""}}}
    async with EmulatedInSight([job]) as emulator, await TelnetClient.log_in(emulator) as client:
        await client.ask(b"SSMath_1.A1 After SS\r\n", wire.DONE)
        await client.ask(b"GVmath_1.a1\r\n", b"1\r\nAfter SS\r\n")


@pytest.mark.parametrize(
    ("command", "answer"),
    [
        (b"SIB002x", wire.INVALID),
        (b"SIB002", wire.INVALID),
        (b"SIB0021.5", wire.INVALID),
        (b"SIB4001", wire.INVALID),
        (b"SINobody 1", wire.INVALID),
        (b"SIB00211", wire.FAILED),
        (b"SIC0031", wire.FAILED),
        (b"SIA0011", wire.FAILED),
        (b"SIPassed 1", wire.FAILED),
        (b"SFC003nan", wire.INVALID),
        (b"SFC0031e99", wire.DONE),
        (b"SFB0021.5", wire.FAILED),
        (b"SSD004" + b"x" * 20, wire.DONE),
        (b"SSD004" + b"x" * 21, wire.FAILED),
        (b"SSB0025", wire.FAILED),
    ],
)
async def test_setting_is_refused_as_documented(
    client: TelnetClient, command: bytes, answer: bytes
) -> None:
    await client.ask(command + b"\r\n", answer)


# ---------------------------------------------------------------------- the rest


async def test_info_has_five_lines() -> None:
    async with (
        EmulatedInSight(info={"Serial Number": "42"}) as emulator,
        await TelnetClient.log_in(emulator) as client,
    ):
        await client.ask(
            b"GI\r\n",
            b"1\r\nSerial Number: 42\r\nApplication Version: 6.1.0\r\nMonitor Version: 6.1.0\r\n"
            b"MAC Address: 00-D0-24-00-00-01\r\nDate of Build: Jan 01 2020\r\n",
        )


async def test_evaluate_answers_what_was_given_and_fails_otherwise() -> None:
    evaluations = {"GetMSBuffer(0)": "<MS>1</MS>"}
    async with (
        EmulatedInSight(evaluations=evaluations) as emulator,
        await TelnetClient.log_in(emulator) as client,
    ):
        await client.ask(b"EV GetMSBuffer(0)\r\n", b"1\r\n10\r\n<MS>1</MS>\r\n")
        await client.ask(b"EV GetMSBuffer(1)\r\nEV\r\n", 2 * wire.FAILED)


async def read_image(client: TelnetClient, command: bytes) -> tuple[int, bytes, bytes]:
    """Return the size line, the data and the checksum."""
    client.send(command)
    await client.expect(wire.DONE)
    size = int(await client.reader.readline())
    lines = [await client.reader.readline() for _ in range(-(-size // 80))]
    assert {len(line) for line in lines[:-1]} == {82}
    data = bytes.fromhex(b"".join(lines).decode())
    return size, data, (await client.reader.readline()).removesuffix(b"\r\n")


@pytest.mark.parametrize("command", [b"RI\r\n", b"RB\r\n"])
async def test_image_is_a_bitmap_in_lines_of_eighty_digits(
    emulator: EmulatedInSight, client: TelnetClient, command: bytes
) -> None:
    emulator.set_image(np.arange(10, dtype=np.uint8).reshape(2, 5))
    size, data, checksum = await read_image(client, command)
    rows = bytes([5, 6, 7, 8, 9, 0, 0, 0, 0, 1, 2, 3, 4, 0, 0, 0])
    assert data == (
        b"BM" + struct.pack("<IHHI", 1094, 0, 0, 1078)
        + struct.pack("<IiiHHIIiiII", 40, 5, 2, 1, 8, 0, 16, 2835, 2835, 256, 256)
        + b"".join(bytes([grey, grey, grey, 0]) for grey in range(256))
        + rows
    )  # fmt: skip
    assert size == 2 * 1094
    assert checksum == words.checksum(data.hex().upper().encode()).encode()
    await client.expect_nothing()


async def test_image_size_in_bytes_and_a_pause_are_quirks() -> None:
    clock = ManualClock()
    quirks = {"image_size": "bytes", "transfer_pause": 0.5}
    async with (
        EmulatedInSight(image=np.zeros((1, 4), np.uint8), quirks=quirks, clock=clock) as emulator,
        await TelnetClient.log_in(emulator) as client,
    ):
        await client.ask(b"RI\r\n", b"1\r\n1082\r\n")
        assert emulator.log[-1].text == "1\r\n1082\r\n"
        clock.advance(0.5)
        await client.expect(b"424D")


async def test_builtin_jobs_work() -> None:
    clock = ManualClock()
    async with (
        EmulatedInSight(BUILTIN_JOBS, clock=clock) as emulator,
        await TelnetClient.log_in(emulator) as client,
    ):
        await client.ask(b"GJ\r\nGVPassed\r\n", b"1\r\n1\r\n1\r\n1.000\r\n")
        await client.ask(b"SFThreshold 0.75\r\n", wire.DONE)
        emulator.load(9)
        emulator.set_online(True)
        clock.advance(1.0)
        await client.ask(b"GVA001\r\n", b"1\r\n20.000\r\n")
