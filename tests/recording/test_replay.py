"""A recording as an emulated camera."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

import smartcam
from smartcam.emulator import EmulatedCamera, ManualClock
from smartcam.exceptions import ConfigurationError, OvertriggeredError, TriggerTimeoutError
from smartcam.models import Status
from smartcam.protocols import messages as m
from smartcam.recording import Recorder, Recording, ReplayedCamera, load_recording
from tests.recording.recordingkit import (
    COUNTER,
    URL,
    at,
    container,
    containers,
    frame,
    record,
    session,
    status,
    write,
)

WAITS = ("RUNNING", "WAITING_FOR_TRIGGER")
FREE: dict[str, Any] = {"id": 9, "layout": "n: int32", "generator": "sequence", "rate": 100.0}


def triggered(path: Path) -> Recording:
    """Return a recording of two triggers: 0.25 s and 0.5 s."""
    items = [
        *session(URL, *WAITS),
        frame(1, "> Trigger"),
        container(1.25, b"a"),
        frame(2, "> Trigger"),
        container(2.5, b"b"),
    ]
    return write(path / "run.mcap", items)


def free(path: Path) -> Recording:
    """Return a recording of a free run: 0.5 s and 0.75 s after its start."""
    items = [*session(URL, "RUNNING"), container(0.5, b"a"), container(0.75, b"b")]
    return write(path / "run.mcap", items)


def sent(emulator: EmulatedCamera) -> list[tuple[float, bytes]]:
    """Return which containers were sent, and when by the emulator's clock."""
    return [
        (round(entry.time, 4), entry.message.data)
        for entry in emulator.log
        if isinstance(entry.message, m.ResultContainer)
    ]


async def trigger(emulator: ReplayedCamera, camera: smartcam.Camera, clock: ManualClock) -> Any:
    """Trigger, let 1 s pass, return the result's bytes."""
    count = sum(isinstance(entry.message, m.Trigger) for entry in emulator.log)
    task = asyncio.create_task(camera.trigger(timeout=2))
    await emulator.wait_received(m.Trigger, count=count + 1)
    clock.advance(1)
    return (await task).raw


# ---------------------------------------------------------------------- there and back


@pytest.mark.parametrize(
    ("dialect", "transport", "quirks"),
    [
        ("handbook", "tcp", {}),
        ("thesis", "udp", {}),
        ("b16", "tcp", {"code": True, "no_id": True}),
        ("bid", "udp", {}),
    ],
)
async def test_replay_recorded_again_is_the_same(
    tmp_path: Path, dialect: str, transport: Any, quirks: dict[str, Any]
) -> None:
    async with EmulatedCamera(
        [COUNTER], dialect=dialect, transport=transport, quirks=quirks
    ) as emulator:
        first = await record(tmp_path / "a.mcap", emulator, triggers=3)
    async with ReplayedCamera(first, quirks={"overtriggered_time": 0.2}) as emulator:
        assert emulator.wire_dialect.quirks == tuple(quirks)
        assert emulator.quirks.overtriggered_time == 0.2
        assert (emulator.dialect, emulator.transport) == (dialect, transport)
        second = await record(tmp_path / "b.mcap", emulator, triggers=3)
        assert emulator.remaining == 0
    assert [data for _, data in containers(first)] == ["00000000", "01000000", "02000000"]
    assert containers(second) == containers(first)
    async with ReplayedCamera(second) as emulator:
        third = await record(tmp_path / "c.mcap", emulator, triggers=3)
    assert containers(third) == containers(first)


async def test_replay_free_run_recorded_again_is_the_same(tmp_path: Path) -> None:
    async def run(url: str, path: Path) -> Recording:
        with Recorder(path) as recorder:
            options: Any = {"name": "left", "application": 9, "observers": [recorder]}
            camera = smartcam.connect(url, **options)
            # before there is a session, so that none is missed: there are no more than recorded
            async with camera.results() as results, camera, asyncio.timeout(60):
                for _ in range(10):
                    await anext(results)
        return load_recording(path)

    async with EmulatedCamera([FREE]) as emulator:
        first = await run(emulator.url, tmp_path / "a.mcap")
    async with ReplayedCamera(first, speed=2) as emulator:
        second = await run(emulator.url, tmp_path / "b.mcap")
    assert containers(second)[:10] == containers(first)[:10]
    assert len(containers(second)) >= 10


# ---------------------------------------------------------------------- triggers


async def test_replay_trigger_has_the_recorded_bytes_and_latency(tmp_path: Path) -> None:
    clock = ManualClock()
    async with ReplayedCamera(triggered(tmp_path), clock=clock) as emulator:
        async with smartcam.connect(emulator.url, application=5) as camera:
            assert await trigger(emulator, camera, clock) == b"a"
            assert await trigger(emulator, camera, clock) == b"b"
        assert sent(emulator) == [(0.25, b"a"), (1.5, b"b")]


async def test_replay_speed_scales_the_latency(tmp_path: Path) -> None:
    clock = ManualClock()
    async with ReplayedCamera(triggered(tmp_path), clock=clock, speed=5) as emulator:
        async with smartcam.connect(emulator.url, application=5) as camera:
            await trigger(emulator, camera, clock)
            await trigger(emulator, camera, clock)
        assert sent(emulator) == [(0.05, b"a"), (1.1, b"b")]


async def test_replay_that_is_over_gives_no_result_and_tells(tmp_path: Path) -> None:
    told: list[str] = []
    clock = ManualClock()
    recording = triggered(tmp_path)
    async with (
        ReplayedCamera(recording, clock=clock, on_over=lambda: told.append("over")) as emulator,
        smartcam.connect(emulator.url, application=5) as camera,
    ):
        await trigger(emulator, camera, clock)
        assert (emulator.remaining, told) == (1, [])
        await trigger(emulator, camera, clock)
        assert (emulator.remaining, told) == (0, ["over"])
        with pytest.raises(TriggerTimeoutError):
            await camera.trigger(timeout=0.05)


async def test_replay_with_loop_begins_again(tmp_path: Path) -> None:
    clock = ManualClock()
    async with (
        ReplayedCamera(triggered(tmp_path), clock=clock, loop=True) as emulator,
        smartcam.connect(emulator.url, application=5) as camera,
    ):
        found = [await trigger(emulator, camera, clock) for _ in range(5)]
    assert found == [b"a", b"b", b"a", b"b", b"a"]


async def test_replay_trigger_without_a_result_has_none_again(tmp_path: Path) -> None:
    items = [
        *session(URL, *WAITS),
        frame(1, "> Trigger"),
        frame(1.2, "> Stop"),
        frame(2, "> Trigger"),
        container(2.1, b"b"),
    ]
    async with (
        ReplayedCamera(write(tmp_path / "run.mcap", items)) as emulator,
        smartcam.connect(emulator.url, application=5) as camera,
    ):
        with pytest.raises(TriggerTimeoutError):
            await camera.trigger(timeout=0.05)
        assert (await camera.trigger()).raw == b"b"


async def test_replay_dropped_trigger_is_dropped_again(tmp_path: Path) -> None:
    items = [
        *session(URL, *WAITS),
        frame(1, "> Trigger"),
        status(1, *WAITS, "OVERTRIGGERED"),
        frame(2, "> Trigger"),
        container(2.01, b"b"),
    ]
    async with (
        ReplayedCamera(write(tmp_path / "run.mcap", items)) as emulator,
        smartcam.connect(emulator.url, application=5) as camera,
    ):
        with pytest.raises(OvertriggeredError):
            await camera.trigger()
        assert (await camera.trigger()).raw == b"b"


async def test_replay_containers_of_one_trigger_come_together(tmp_path: Path) -> None:
    items = [
        *session(URL, *WAITS),
        frame(1, "> Trigger"),
        status(1, "RUNNING"),
        container(1.01, b"a"),
        container(1.01, b"b"),
        status(1.01, *WAITS),
    ]
    async with (
        ReplayedCamera(write(tmp_path / "run.mcap", items)) as emulator,
        smartcam.connect(emulator.url, application=5) as camera,
    ):
        results = await camera.trigger(results_per_trigger=2)
    assert [one.raw for one in results] == [b"a", b"b"]


async def test_replay_client_that_sets_numbers_gets_its_own(tmp_path: Path) -> None:
    layout = "x: real32, n: int32 @sequence"
    path = tmp_path / "run.mcap"
    app = {**COUNTER, "layout": layout}
    async with EmulatedCamera([app]) as emulator:
        with Recorder(path) as recorder:
            recorder.describe("left", interpret_as=layout)
            options: Any = {"name": "left", "application": 5, "interpret_as": layout}
            async with smartcam.connect(emulator.url, observers=[recorder], **options) as camera:
                recorded = await camera.trigger()
    async with ReplayedCamera(load_recording(path), loop=True) as emulator:
        async with smartcam.connect(emulator.url, application=5) as camera:
            assert (await camera.trigger()).raw == recorded.raw
        async with smartcam.connect(emulator.url, **options) as camera:
            again = await camera.trigger()
            last = [e.message for e in emulator.log if isinstance(e.message, m.SetSequenceNumber)]
    assert again.sequence == last[-1].number
    assert again.raw[:4] == recorded.raw[:4]


@pytest.mark.parametrize(
    "told", [None, "localizations", "{7: 'n: int32'}", "n: int32", "x: int64, n: int32 @sequence"]
)
async def test_replay_without_a_known_number_keeps_the_bytes(
    tmp_path: Path, told: str | None
) -> None:
    items = [*session(URL, *WAITS), frame(1, "> Trigger"), container(1.01, b"abcd")]
    recording = write(tmp_path / "run.mcap", items, interpret_as=told)
    async with (
        ReplayedCamera(recording) as emulator,
        smartcam.connect(emulator.url, application=5) as camera,
    ):
        await camera.request(0x35, (77).to_bytes(4, "little"))
        assert (await camera.trigger()).raw == b"abcd"


# ---------------------------------------------------------------------- by itself


async def test_replay_free_run_begins_with_the_first_session(tmp_path: Path) -> None:
    clock = ManualClock()
    async with ReplayedCamera(free(tmp_path), clock=clock) as emulator:
        clock.advance(10)
        assert sent(emulator) == []
        async with smartcam.connect(emulator.url, application=5):
            clock.advance(5)
        assert sent(emulator) == [(10.5, b"a"), (10.75, b"b")]


async def test_replay_free_run_waits_while_the_camera_is_stopped(tmp_path: Path) -> None:
    clock = ManualClock()
    async with ReplayedCamera(free(tmp_path), clock=clock) as emulator:
        async with smartcam.connect(emulator.url) as camera:
            clock.advance(0.6)
            await camera.stop()
            clock.advance(10)
            await camera.start()
            clock.advance(10)
        assert sent(emulator) == [(0.5, b"a"), (10.85, b"b")]


async def test_replay_free_run_waits_while_nobody_listens(tmp_path: Path) -> None:
    clock = ManualClock()
    async with ReplayedCamera(free(tmp_path), clock=clock) as emulator:
        async with smartcam.connect(emulator.url):
            pass
        await emulator.wait_received(m.Disconnect, count=2)
        clock.advance(10)
        async with smartcam.connect(emulator.url):
            clock.advance(10)
        assert sent(emulator) == [(10.5, b"a"), (10.75, b"b")]


async def test_replay_sensor_results_come_with_their_statuses(tmp_path: Path) -> None:
    items = [
        *session(URL, *WAITS),
        status(1, "RUNNING"),
        container(1.25, b"a"),
        status(1.25, *WAITS),
    ]
    clock = ManualClock()
    recording = write(tmp_path / "run.mcap", items)
    async with ReplayedCamera(recording, clock=clock) as emulator:
        async with smartcam.connect(emulator.url):
            clock.advance(3)
        said = [
            (round(entry.time, 4), entry.message)
            for entry in emulator.log
            if entry.time and entry.direction == "out"
        ]
    assert said == [
        (1.0, m.StatusReport(status=Status.RUNNING, endian=0)),
        (1.25, m.ResultContainer(application=5, data=b"a")),
        (1.25, m.StatusReport(status=Status.RUNNING | Status.WAITING_FOR_TRIGGER, endian=0)),
    ]


async def test_replay_sensor_result_waits_for_the_trigger_under_way(tmp_path: Path) -> None:
    items = [
        *session(URL, *WAITS),
        container(1, b"sensor"),
        frame(2, "> Trigger"),
        container(2.5, b"trigger"),
    ]
    clock = ManualClock()
    recording = write(tmp_path / "run.mcap", items)
    async with ReplayedCamera(recording, clock=clock) as emulator:
        async with smartcam.connect(emulator.url) as camera:
            clock.advance(0.8)
            assert await trigger(emulator, camera, clock) == b"trigger"
        assert sent(emulator) == [(1.3, b"trigger"), (1.3, b"sensor")]


# ---------------------------------------------------------------------- conditions and the rest


async def test_replay_conditions_come_again(tmp_path: Path) -> None:
    items = [
        *session(URL, *WAITS, "OVERHEAT"),
        status(1, *WAITS),
        status(2, *WAITS, "SYSTEM_ERROR"),
    ]
    clock = ManualClock()
    recording = write(tmp_path / "run.mcap", items)
    async with ReplayedCamera(recording, clock=clock, loop=True) as emulator:
        clock.advance(5)
        async with smartcam.connect(emulator.url) as camera:
            seen = [camera.status]
            for _ in range(3):
                clock.advance(1)
                seen.append(emulator.device.status)
    waits = Status.RUNNING | Status.WAITING_FOR_TRIGGER
    assert seen == [
        waits | Status.OVERHEAT,
        waits,
        Status.RUNNING | Status.SYSTEM_ERROR,
        Status.RUNNING | Status.SYSTEM_ERROR,
    ]


async def test_replay_begins_as_the_camera_was(tmp_path: Path) -> None:
    recording = write(tmp_path / "run.mcap", session(URL, endian=1))
    async with ReplayedCamera(recording, name="again") as emulator:
        assert (emulator.name, emulator.device.running, emulator.device.endian) == (
            "again",
            False,
            1,
        )
        assert list(emulator.device.applications) == [5]


async def test_replay_can_speak_otherwise(tmp_path: Path) -> None:
    recording = triggered(tmp_path)
    async with ReplayedCamera(recording, dialect="b16", transport="udp") as emulator:
        async with smartcam.connect(emulator.url, application=5) as camera:
            assert (await camera.trigger()).raw == b"a"
        assert emulator.url.startswith("bvs+udp://127.0.0.1:")


async def test_replay_stopped_in_the_middle_leaves_nothing(tmp_path: Path) -> None:
    async with ReplayedCamera(free(tmp_path)) as emulator:
        async with smartcam.connect(emulator.url):
            await emulator.stop()
        await emulator.start()
        async with smartcam.connect(emulator.url) as camera:
            assert camera.active_application == 5


@pytest.mark.parametrize("speed", [0, -1, 1001, float("nan")])
def test_replay_speed_out_of_range_is_refused(tmp_path: Path, speed: float) -> None:
    with pytest.raises(ConfigurationError, match=r"speed: expected a number, 0\.001 to 1000, got"):
        ReplayedCamera(triggered(tmp_path), speed=speed)


def test_replay_reads_the_time_of_a_link_that_was_lost(tmp_path: Path) -> None:
    gone = smartcam.Disconnected(camera="left", at=at(3), reason="gone", expected=False)
    recording = write(tmp_path / "run.mcap", [*session(URL, *WAITS), gone])
    assert ReplayedCamera(recording).remaining == 0
