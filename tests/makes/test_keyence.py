"""Test Keyence's cameras: judgements, readings with a deadline, and vention's client."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Any

import pytest

import smartcam
from smartcam.emulator import ManualClock
from smartcam.exceptions import (
    CameraBusyError,
    CommandRejectedError,
    ConfigurationError,
    ConnectionLostError,
    TriggerTimeoutError,
    UnsupportedError,
    WrongApplicationError,
)
from smartcam.makes import EmulatedIv3, EmulatedSr
from tests.handmade import until

PATIENCE = 10.0
CODE = "read: bool, code: string[20]"


@contextlib.asynccontextmanager
async def sensor_by_hand(
    says: dict[str, list[str]], scheme: str
) -> AsyncIterator[tuple[list[str], smartcam.Camera[Any]]]:
    """Serve one client with the answers to each line in turn, then always the last; "" is none."""
    heard: list[str] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError):
            while True:
                line = (await reader.readuntil(b"\r"))[:-1].decode()
                heard.append(line)
                answers = says[line]
                answer = answers.pop(0) if len(answers) > 1 else answers[0]
                writer.write(answer.encode() + b"\r" * bool(answer))
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    try:
        options: dict[str, Any] = {"request_timeout": 0.5, "connect_timeout": 5.0}
        async with smartcam.connect(f"{scheme}://127.0.0.1:{port}", **options) as camera:
            yield heard, camera
    finally:
        server.close()
        await server.wait_closed()


IV3 = {"RT": ["RT,00000,NG"], "PR": ["PR,007"]}
SR = {
    "ERRSTAT": ["OK,ERRSTAT,NONE"],
    "BUSYSTAT": ["OK,BUSYSTAT,NONE"],
    "NUM": ["OK,NUM,0,0"],
    "LOFF": [""],
}


# ---------------------------------------------------------------------- IV3


@pytest.mark.asyncio
async def test_refusal_of_a_trigger_is_reported_by_its_number() -> None:
    refusals = ["ER,T2,02", "ER,T2,77", "RT,00001,OK"]
    async with sensor_by_hand({**IV3, "T2": refusals}, "iv3") as (_, camera):
        with pytest.raises(UnsupportedError, match="unknown command"):
            await camera.trigger()
        with pytest.raises(CommandRejectedError, match="not documented"):
            await camera.trigger()
        assert (await camera.trigger()).raw == b"RT,00001,OK"


@pytest.mark.asyncio
async def test_busy_sensor_is_asked_again_or_told() -> None:
    says = {**IV3, "T2": ["ER,T2,03", "ER,T2,03", "ER,T2,03", "RT,00001,OK"]}
    async with sensor_by_hand(says, "iv3") as (heard, camera):
        with pytest.raises(CameraBusyError):
            await camera.trigger(when_busy="refuse")
        assert (await camera.trigger()).raw == b"RT,00001,OK"
        assert heard.count("T2") == 4


@pytest.mark.parametrize("wrong", ["RT,1", "RT,1,MAYBE", "RT,1,OK,01,OK", "T2", "PW"])
@pytest.mark.asyncio
async def test_line_that_is_no_result_ends_the_link(wrong: str) -> None:
    async with sensor_by_hand({**IV3, "T2": [wrong, "RT,00001,OK"]}, "iv3") as (_, camera):
        with pytest.raises(ConnectionLostError):
            await camera.trigger()
        await camera.wait_connected()
        assert (await camera.trigger()).raw == b"RT,00001,OK"


@pytest.mark.asyncio
async def test_sensor_that_never_answers_is_given_up_and_comes_back() -> None:
    async with sensor_by_hand({**IV3, "T2": ["", "RT,00002,OK"]}, "iv3") as (_, camera):
        with pytest.raises(TriggerTimeoutError):
            await camera.trigger(timeout=0.2)
        with pytest.raises((TriggerTimeoutError, ConnectionLostError)):
            await camera.trigger(timeout=1.0)
        await camera.wait_connected()
        assert (await camera.trigger()).raw == b"RT,00002,OK"


@pytest.mark.asyncio
async def test_count_of_the_sensor_is_the_sequence_of_a_result() -> None:
    layout = "count: uint32 @sequence, passed: bool, (tool: uint16, good: bool, rate: uint32)*"
    async with (
        EmulatedIv3() as emulator,
        smartcam.connect(emulator.url, interpret_as=layout) as camera,
    ):
        assert [(await camera.trigger()).sequence for _ in range(3)] == [1, 2, 3]
        assert await camera.request("T1") == b"T1"
        assert (await camera.trigger()).sequence == 5


@pytest.mark.asyncio
async def test_result_is_of_the_program_that_somebody_else_has_chosen() -> None:
    async with EmulatedIv3(programs=(0, 1)) as emulator, smartcam.connect(emulator.url) as camera:
        assert (await camera.trigger()).application == 0
        emulator.device.switch_application(1)
        with pytest.raises(WrongApplicationError):
            await camera.trigger()
        assert (await camera.trigger()).application == 1


# ---------------------------------------------------------------------- SR


@pytest.mark.asyncio
async def test_reading_without_a_code_ends_before_the_deadline_and_reports_it() -> None:
    async with (
        EmulatedSr(codes=[None, "4006381333931"]) as emulator,
        smartcam.connect(emulator.url, interpret_as=CODE) as camera,
    ):
        nothing = await camera.trigger(timeout=1.0)
        assert (nothing.value.read, nothing.value.code, nothing.raw) == (False, "", b"ERROR")
        assert (await camera.trigger(timeout=1.0)).value.code == "4006381333931"


@pytest.mark.asyncio
async def test_reader_that_tells_at_the_end_only_answers_in_time() -> None:
    async with (
        EmulatedSr(codes=["A", "B"], waits_for_end=True) as emulator,
        smartcam.connect(emulator.url) as camera,
    ):
        assert [(await camera.trigger(timeout=0.5)).raw for _ in range(2)] == [b"A", b"B"]


@pytest.mark.asyncio
async def test_cancelled_trigger_ends_the_reading_at_once() -> None:
    clock = ManualClock()
    async with (
        EmulatedSr(clock=clock) as emulator,
        smartcam.connect(emulator.url) as camera,
        camera.results() as results,
    ):
        trigger = asyncio.create_task(camera.trigger(timeout=3600.0))
        await until(lambda: "TRG" in emulator.answer("BUSYSTAT"))
        trigger.cancel()
        await asyncio.wait({trigger})
        async with asyncio.timeout(PATIENCE):
            await asyncio.sleep(0.01)
            clock.advance(0.0)
            assert (await anext(results)).raw == b"ERROR"
        assert camera.statistics().late == 1


@pytest.mark.asyncio
async def test_code_that_somebody_else_has_read_is_streamed() -> None:
    async with (
        EmulatedSr(codes=["A", "B"]) as emulator,
        smartcam.connect(emulator.url) as camera,
        camera.results() as results,
    ):
        emulator.device.trigger()
        async with asyncio.timeout(PATIENCE):
            assert (await anext(results)).raw == b"A"
        assert (await camera.trigger()).raw == b"B"
        assert (camera.statistics().streamed, camera.statistics().triggered) == (1, 1)


@pytest.mark.asyncio
async def test_refused_reading_is_reported_by_its_number() -> None:
    says = {**SR, "LON": ["ER,LON,00", "ER,LON,99", "ER,LON,20", "A"]}
    async with sensor_by_hand(says, "sr") as (_, camera):
        with pytest.raises(UnsupportedError):
            await camera.trigger()
        with pytest.raises(CommandRejectedError, match="broken"):
            await camera.trigger()
        assert (await camera.trigger()).raw == b"A"


@pytest.mark.asyncio
async def test_reading_whose_client_is_gone_is_ended_and_is_nobodys_result() -> None:
    async with EmulatedSr(codes=[None, "A"]) as emulator:
        _, writer = await asyncio.open_connection("127.0.0.1", emulator.port)
        writer.write(b"LON\r")
        await until(lambda: "TRG" in emulator.answer("BUSYSTAT"))
        writer.transport.abort()
        async with smartcam.connect(emulator.url) as camera:
            assert (await camera.trigger(timeout=2.0)).raw == b"A"
            assert camera.statistics().triggered == 1


@pytest.mark.asyncio
async def test_line_of_a_reading_that_was_ended_for_another_client_is_streamed() -> None:
    says = {**SR, "BUSYSTAT": ["OK,BUSYSTAT,TRG"], "LOFF": ["ERROR"], "LON": ["A"]}
    async with sensor_by_hand(says, "sr") as (heard, camera), camera.results() as results:
        trigger = asyncio.create_task(camera.trigger(timeout=PATIENCE))
        async with asyncio.timeout(PATIENCE):
            assert (await anext(results)).raw == b"ERROR"
        says["BUSYSTAT"] = ["OK,BUSYSTAT,NONE"]
        assert (await trigger).raw == b"A"
        assert heard.count("LOFF") == 1


@pytest.mark.parametrize("bank", ["16", "x", "", "-1", "1.5"])
def test_bank_that_is_none_is_a_mistake(bank: str) -> None:
    with pytest.raises(ConfigurationError, match="bank: 0 to 15"):
        smartcam.connect(f"sr://reader?bank={bank}")


@pytest.mark.asyncio
async def test_bytes_of_a_code_come_as_they_are() -> None:
    code = bytes(range(14, 256)).decode("latin-1")
    async with EmulatedSr(codes=[code]) as emulator, smartcam.connect(emulator.url) as camera:
        assert (await camera.trigger()).raw == code.encode("latin-1")


# ---------------------------------------------------------------------- a client of somebody else


async def scanned(emulator: EmulatedSr, times: int, **options: Any) -> list[str | None]:
    """Return the codes that vention-barcode-scanner reads."""
    keyence = pytest.importorskip("barcode_scanner.scanners.keyence")
    scanner = keyence.KeyenceScanner("left", "127.0.0.1", emulator.port, **options)
    assert await scanner.connect()
    try:
        return [(await scanner.scan()).label_string for _ in range(times)]
    finally:
        await scanner.disconnect()


@pytest.mark.real_time
@pytest.mark.asyncio
async def test_ventions_client_reads_codes_from_the_emulated_reader() -> None:
    async with EmulatedSr(codes=["A", "B", None], waits_for_end=True) as emulator:
        found = await scanned(emulator, 3, timeout=5.0, scan_dwell=0.2)
    assert found == ["A", "B", None]


@pytest.mark.real_time
@pytest.mark.asyncio
async def test_ventions_client_takes_a_late_code_for_the_next_scans_and_smartcam_does_not() -> None:
    late: dict[str, Any] = {"waits_for_end": True, "answer_time": 0.35}
    async with EmulatedSr(codes=["A", "B", "C"], **late) as emulator:
        assert await scanned(emulator, 2, timeout=0.2, scan_dwell=0.2) == [None, "A"]
    async with (
        EmulatedSr(codes=["A", "B", "C"], **late) as emulator,
        smartcam.connect(emulator.url) as camera,
    ):
        with pytest.raises(TriggerTimeoutError):
            await camera.trigger(timeout=0.3)
        assert (await camera.trigger(timeout=5.0)).raw == b"B"


@pytest.mark.asyncio
@pytest.mark.parametrize("program", ["PR,999", "PR," + 23 * "9"])
async def test_program_that_no_sensor_has_ends_the_link_by_a_typed_error(program: str) -> None:
    with pytest.raises(smartcam.SmartCamError):
        async with sensor_by_hand({**IV3, "PR": [program]}, "iv3") as (_, camera):
            await camera.query_application()


@pytest.mark.asyncio
async def test_acknowledgement_of_lon_is_no_code_that_was_read() -> None:
    async with sensor_by_hand({**SR, "LON": ["OK,LON"]}, "sr") as (_, camera):
        with pytest.raises(smartcam.SmartCamError):
            await camera.trigger(timeout=1.0)
        assert camera.statistics().triggered == 0
