"""Test the makes' emulated cameras with marks, faults, scenarios and replay."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import smartcam
from smartcam import Camera, Status
from smartcam.emulator import LineCamera, ManualClock, load_scenario
from smartcam.exceptions import ConfigurationError, ConnectionLostError, TriggerTimeoutError
from smartcam.makes import EmulatedIfm, EmulatedIv3, EmulatedSr
from smartcam.recording import Recorder, load_recording, replay
from smartcam.testing import ThreadedCamera

MAKES: dict[str, Callable[..., LineCamera]] = {
    "pcic": lambda **given: EmulatedIfm(
        defaults={"parts": [{"n": one} for one in range(100)]}, **given
    ),
    "iv3": lambda **given: EmulatedIv3(parts=[(one,) for one in range(100)], **given),
    "sr": lambda **given: EmulatedSr(codes=list(map(str, range(100))), **given),
}


@pytest.mark.real_time
@pytest.mark.smartcam(
    protocol="pcic", defaults={"parts": [{"x": 1.5, "passed": True}]}, interpret_as="x: real32 mm"
)
@pytest.mark.asyncio
async def test_mark_puts_up_an_ifm(camera: Camera, emulated_camera: ThreadedCamera) -> None:
    assert (await camera.trigger()).value.x == pytest.approx(0.0015)
    emulated_camera.log.expect("Connect", "Trigger")


@pytest.mark.real_time
@pytest.mark.smartcam(
    protocol="iv3",
    parts=[[99, 10]],
    interpret_as="n: uint32, passed: bool, (t: uint16, ok: bool, rate: uint32)*",
)
@pytest.mark.asyncio
async def test_mark_puts_up_an_iv3(camera: Camera) -> None:
    value = (await camera.trigger()).value
    assert (value.n, value.passed) == (1, False)
    assert [(one.t, one.ok, one.rate) for one in value.records] == [(1, True, 99), (2, False, 10)]


@pytest.mark.real_time
@pytest.mark.smartcam(
    protocol="sr", codes=["4006381333931"], interpret_as="read: bool, code: string[20]"
)
@pytest.mark.asyncio
async def test_mark_puts_up_a_reader(camera: Camera) -> None:
    value = (await camera.trigger()).value
    assert (value.read, value.code) == (True, "4006381333931")


@pytest.mark.parametrize("make", MAKES)
@pytest.mark.asyncio
async def test_fault_that_drops_a_result_is_a_timeout_and_the_next_result_its_own(
    make: str,
) -> None:
    async with (
        MAKES[make](faults=[{"kind": "drop", "on": "ResultContainer"}]) as emulator,
        smartcam.connect(emulator.url, request_timeout=0.3) as camera,
    ):
        with pytest.raises(TriggerTimeoutError):
            await camera.trigger(timeout=0.2)
        # the answer that never came leaves the link untrustworthy: a new one is made
        with pytest.raises((TriggerTimeoutError, ConnectionLostError)):
            await camera.trigger(timeout=0.5)
        await camera.wait_connected()
        first = await camera.trigger()
        second = await camera.trigger()
        assert first.raw != second.raw
        assert camera.statistics().late == 0


FAULTS: dict[str, dict[str, Any]] = {
    "split": {"after": 3},
    "delay": {"seconds": 0.05},
    "duplicate": {},
    "truncate": {"keep": 3},
    "reset": {},
    "close": {},
}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("make", MAKES)
@pytest.mark.asyncio
async def test_result_under_a_fault_is_the_triggers_or_an_error(make: str, fault: str) -> None:
    given = {"kind": fault, "on": "ResultContainer", **FAULTS[fault]}
    async with MAKES[make]() as emulator:
        emulator.inject(given)
        async with smartcam.connect(emulator.url, request_timeout=0.5) as camera:
            numbers: list[bytes] = []
            for _ in range(4):
                try:
                    numbers.append((await camera.trigger(timeout=0.5)).raw)
                except smartcam.exceptions.SmartCamError:
                    await camera.wait_connected()
            assert len(numbers) >= 2
            assert len(set(numbers)) == len(numbers), "no result was given to two triggers"


@pytest.mark.asyncio
async def test_scenario_describes_a_camera_of_a_make(tmp_path: Path) -> None:
    file = tmp_path / "line.yaml"
    file.write_text(
        "protocol: pcic\nactive: 2\noptions:\n  applications: [1, 2]\n  version: 4\n"
        "timeline:\n  - at: 1.0\n    do: [{kind: delay, on: ResultContainer, seconds: 0.1}]\n"
    )
    async with (
        EmulatedIfm.from_scenario(load_scenario(file)) as emulator,
        smartcam.connect(emulator.url) as camera,
    ):
        assert camera.url.endswith("?dialect=v4")
        assert camera.active_application == 2
    file.write_text("protocol: pcic\noptions:\n  version: 7\n")
    with pytest.raises(ConfigurationError, match=r"line 3: options: .*version"):
        load_scenario(file)


@pytest.mark.parametrize("make", MAKES)
@pytest.mark.asyncio
@pytest.mark.real_time
async def test_recording_is_played_to_clients_that_ask_otherwise(make: str, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    async with MAKES[make]() as emulator:
        with Recorder(path) as recorder:
            async with smartcam.connect(emulator.url, name="left", observers=[recorder]) as camera:
                recorded = [(await camera.trigger()).raw for _ in range(3)]
    async with replay(load_recording(path)) as played, smartcam.connect(played.url) as camera:
        await camera.query_application()  # which moves all the tickets
        assert [(await camera.trigger()).raw for _ in range(3)] == recorded


@pytest.mark.asyncio
@pytest.mark.real_time
async def test_recorded_state_is_played_at_its_trigger_however_often_a_client_asks(
    tmp_path: Path,
) -> None:
    path = tmp_path / "run.mcap"
    clock = ManualClock()
    async with MAKES["sr"](reading_time=0.3, clock=clock) as emulator:
        with Recorder(path) as recorder:
            async with smartcam.connect(emulator.url, name="left", observers=[recorder]) as camera:
                triggered = asyncio.create_task(camera.trigger())
                while Status.BUSY not in (last := await camera.query_status()):
                    assert not triggered.done()
                clock.advance(0.3)
                recorded = (await triggered).raw
    assert Status.BUSY in last  # only the code comes after it
    async with replay(load_recording(path)) as played, smartcam.connect(played.url) as camera:
        for _ in range(5):
            assert Status.BUSY not in await camera.query_status()
        assert (await camera.trigger()).raw == recorded
        assert Status.BUSY not in await camera.query_status()
