"""Timelines and their clocks: cues at a time, on a state, on command; exact, always the same."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Sequence
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from smartcam.emulator import Cue, EmulatedCamera, ManualClock
from smartcam.emulator._inside import RealClock
from smartcam.emulator._scenario.states import DeviceState
from smartcam.emulator.faults import Fault
from smartcam.exceptions import ConfigurationError
from smartcam.models import Status
from smartcam.protocols import messages as m
from tests.emulator import camera_wire as wire
from tests.emulator.camera_wire import TcpClient
from tests.emulator.inside import MAX_CUES_AT_ONCE, MAX_PENDING, Timeline

STOP = {"kind": "stop"}


class Bench:
    """A timeline whose injections are written down with their time."""

    def __init__(self, *cues: dict[str, Any], seed: int = 0) -> None:
        self.clock = ManualClock()
        self.happened: list[tuple[float, str]] = []
        made = [Cue.model_validate(cue) for cue in cues]
        self.timeline = Timeline(made, clock=self.clock, seed=seed, inject=self.inject)
        self.timeline.start()

    def inject(self, do: Sequence[Fault]) -> None:
        self.happened += [(round(self.clock.now, 6), fault.kind) for fault in do]


# ---------------------------------------------------------------------- the timeline alone


def test_cue_without_a_moment_happens_at_the_start() -> None:
    bench = Bench({"do": [STOP, {"kind": "start"}]})
    assert bench.happened == [(0.0, "stop"), (0.0, "start")]


def test_cue_at_a_time_happens_then_and_once() -> None:
    bench = Bench({"at": 2.5, "do": STOP})
    bench.clock.advance(2.4999)
    assert bench.happened == []
    bench.clock.advance(100)
    assert bench.happened == [(2.5, "stop")]
    assert bench.timeline.injected_counts == [1]


def test_cue_comes_again_as_often_as_it_says_without_drift() -> None:
    bench = Bench({"at": 0.1, "every": 0.1, "times": 1000, "do": STOP})
    bench.clock.advance(500)
    assert [when for when, _ in bench.happened] == [round(0.1 * n, 6) for n in range(1, 1001)]


def test_cues_of_one_instant_happen_in_the_order_of_the_file() -> None:
    bench = Bench(
        {"at": 1, "do": STOP},
        {"at": 0.5, "every": 0.5, "do": {"kind": "start"}},
        {"at": 1, "do": {"kind": "no_result"}},
    )
    bench.clock.advance(1)
    assert bench.happened == [
        (0.5, "start"), (1.0, "stop"), (1.0, "no_result"), (1.0, "start")
    ]  # fmt: skip


def test_cue_on_a_state_counts_and_waits() -> None:
    bench = Bench({"entering": "running", "nth": 2, "times": 2, "after": 0.25, "do": STOP})
    for _ in range(5):
        bench.timeline.note_entered(DeviceState.RUNNING)
        bench.timeline.note_entered(DeviceState.STOPPED)
        bench.clock.advance(1)
    assert bench.happened == [(1.25, "stop"), (2.25, "stop")]


def test_cue_on_command_happens_each_time() -> None:
    bench = Bench({"command": "jam", "do": STOP}, {"command": "jam", "nth": 3, "do": STOP})
    for _ in range(3):
        bench.timeline.command("jam")
    assert bench.timeline.injected_counts == [3, 1]


def test_unknown_command_is_refused_and_the_known_are_named() -> None:
    bench = Bench({"command": "jam", "do": STOP}, {"command": "clear", "do": STOP})
    with pytest.raises(ConfigurationError, match="command 'jan'; there are clear, jam"):
        bench.timeline.command("jan")


def test_stopped_timeline_does_nothing_more() -> None:
    bench = Bench({"at": 1, "do": STOP})
    bench.timeline.stop()
    bench.timeline.stop()
    bench.clock.advance(2)
    assert bench.happened == []


def test_chance_has_the_odds_it_was_given_and_the_spread_is_even() -> None:
    bench = Bench({"at": 1, "every": 1, "chance": 0.3, "spread": 0.5, "times": 5000, "do": STOP})
    bench.clock.advance(6000)
    late = [math.modf(when)[0] for when, _ in bench.happened]
    assert abs(len(late) - 1500) < 4 * math.sqrt(5000 * 0.3 * 0.7)
    assert 0 <= min(late) < 0.01
    assert 0.49 < max(late) < 0.5
    assert abs(sum(late) / len(late) - 0.25) < 0.02


def test_same_seed_is_the_same_chance_and_another_is_not() -> None:
    def run(seed: int, *more: dict[str, Any]) -> list[tuple[float, str]]:
        cue = {"at": 1, "every": 1, "chance": 0.5, "times": 50, "do": STOP}
        bench = Bench(cue, *more, seed=seed)
        bench.clock.advance(60)
        return [one for one in bench.happened if one[1] == "stop"]

    assert run(7) == run(7)
    assert run(7) != run(8)
    other = {"at": 0.5, "every": 1, "chance": 0.5, "do": {"kind": "start"}}
    assert run(7, other) == run(7)  # one cue's chance is not another's


def test_cues_that_wait_are_bounded(caplog: pytest.LogCaptureFixture) -> None:
    bench = Bench({"entering": "busy", "after": 10, "times": 20_000, "do": STOP})
    for _ in range(MAX_PENDING + 5):
        bench.timeline.note_entered(DeviceState.BUSY)
    assert caplog.text.count("cues wait, one is dropped") == 5
    bench.clock.advance(10)
    assert len(bench.happened) == MAX_CUES_AT_ONCE


@given(
    st.lists(
        st.fixed_dictionaries(
            {"at": st.sampled_from([0, 0.1, 1, 2]), "do": st.just(STOP)},
            optional={
                "every": st.sampled_from([0.1, 0.3]),
                "chance": st.sampled_from([0.5, 1]),
                "after": st.sampled_from([0.0, 0.2]),
                "spread": st.sampled_from([0.0, 1.0]),
            },
        ),
        max_size=4,
    ),
    st.lists(st.floats(0, 0.7), max_size=8),
)
def test_how_the_time_is_cut_changes_nothing(cues: list[dict[str, Any]], cuts: list[float]) -> None:
    whole, cut = Bench(*cues), Bench(*cues)
    for one in cuts:
        cut.clock.advance(one)
    whole.clock.advance(cut.clock.now)
    assert cut.happened == whole.happened


# ---------------------------------------------------------------------- the model


@pytest.mark.parametrize(
    ("cue", "text"),
    [
        ({}, "do\n  Field required"),
        ({"do": []}, "do: 1 to 100 faults, got 0"),
        ({"do": {"kind": "explode"}}, "Input tag 'explode'"),
        ({"at": 1, "command": "x", "do": STOP}, "one moment, not by at and command"),
        ({"at": -1, "do": STOP}, "greater than or equal to 0"),
        ({"at": math.nan, "do": STOP}, "finite number"),
        ({"every": 1, "do": STOP}, "every needs at"),
        ({"at": 1, "every": 0, "do": STOP}, "greater than or equal to 0.001"),
        ({"at": 1, "nth": 2, "do": STOP}, "nth needs entering or command"),
        ({"at": 1, "times": 2, "do": STOP}, "times needs every, entering or command"),
        ({"do": STOP, "times": 2}, "times needs every, entering or command"),
        ({"entering": "sleeping", "do": STOP}, "'stopped', 'running'"),
        ({"command": "", "do": STOP}, "at least 1 character"),
        ({"command": "a/b", "do": STOP}, "should match pattern"),
        ({"chance": 0, "do": STOP}, "greater than 0"),
        ({"wait": 1, "do": STOP}, "Extra inputs are not permitted"),
    ],
)
def test_wrong_cue_is_refused(cue: dict[str, Any], text: str) -> None:
    with pytest.raises(ValidationError) as caught:
        Cue.model_validate(cue)
    assert text in str(caught.value)


def test_cue_survives_json() -> None:
    cue = Cue.model_validate({"entering": "busy", "do": {"kind": "insert", "data": "ff00"}})
    assert Cue.model_validate_json(cue.model_dump_json()) == cue
    assert cue.entering is DeviceState.BUSY


# ---------------------------------------------------------------------- with a camera


def camera(*timeline: dict[str, Any], **options: Any) -> tuple[ManualClock, EmulatedCamera]:
    clock = ManualClock()
    options = {"active": 21, "running": True, **options}
    return clock, EmulatedCamera(clock=clock, timeline=timeline, **options)


async def test_camera_gets_hot_at_its_time_and_cools_down() -> None:
    clock, emulator = camera(
        {"at": 5, "do": {"kind": "condition", "condition": "overheat"}},
        {
            "entering": "overheat",
            "after": 2,
            "do": {"kind": "condition", "condition": "overheat", "active": False},
        },
    )
    async with emulator:
        clock.advance(5)
        assert Status.OVERHEAT in emulator.device.status
        clock.advance(1.999)
        assert Status.OVERHEAT in emulator.device.status
        clock.advance(0.001)
        assert Status.OVERHEAT not in emulator.device.status
    assert [round(one.time, 3) for one in emulator.fired] == [5.0, 7.0]


async def test_message_that_tells_a_state_is_not_changed_the_next_is() -> None:
    clock, emulator = camera({"entering": "inspecting", "do": {"kind": "drop", "sender": "camera"}})
    async with emulator, await TcpClient.open(emulator) as client:
        client.send(wire.CONNECT)
        await client.expect(wire.CONNECTED, wire.WAITING)
        client.send(wire.TRIGGER)
        await client.expect(wire.RUNNING)  # tells that it inspects
        clock.advance(0.05)
        await client.expect(wire.WAITING)  # the result was the next message, and was dropped
    assert [entry.fault for entry in emulator.log if entry.message_id == 0x20] == ["drop"]


async def test_sensor_triggers_and_operator_stops_by_the_timeline() -> None:
    clock, emulator = camera(
        {"at": 1, "every": 1, "times": 3, "do": {"kind": "digital_input"}},
        {"at": 3.01, "do": {"kind": "stop"}},
    )
    async with emulator, await TcpClient.open(emulator) as client:
        client.send(wire.CONNECT)
        await client.expect(wire.CONNECTED, wire.WAITING)
        clock.advance(10)
        await client.expect(
            wire.RUNNING, wire.HELLO_WORLD, wire.WAITING,
            wire.RUNNING, wire.HELLO_WORLD, wire.WAITING,
            wire.RUNNING, wire.NO_BIT,
        )  # fmt: skip


async def test_every_state_can_be_entered() -> None:
    cues = [{"entering": state.value, "do": {"kind": "no_result"}} for state in DeviceState]
    clock, emulator = camera(*cues, running=False, active=3)
    async with emulator:
        device = emulator.device
        for message in (m.Connect(), m.SetInput(data=b"x"), m.SwitchApplication(application=21)):
            device.handle(message)
        clock.advance(1)
        device.start()
        device.trigger()
        device.trigger()
        clock.advance(1)
        device.set_condition(Status.OVERHEAT | Status.SYSTEM_ERROR, on=True)
        device.stop()
        device.handle(m.Disconnect())
        device.reboot(1)
        device.report_entered()
    done = dict(zip(DeviceState, emulator.cue_counts, strict=True))
    assert [state for state, count in done.items() if not count] == [DeviceState.INPUT_CONTAINER]


async def test_input_container_bit_is_a_state() -> None:
    takes = {"id": 5, "layout": "n: int32", "input": "n: int32", "generator": "input"}
    clock, emulator = camera(
        {"entering": "input_container", "do": {"kind": "stop"}},
        applications=[takes], active=5,
    )  # fmt: skip
    async with emulator:
        emulator.device.trigger()  # without a container
        clock.advance(1)
        assert emulator.cue_counts == [1]
        assert not emulator.device.running


async def test_command_moves_a_part_of_the_scene() -> None:
    _, emulator = camera(
        {
            "command": "shuffle",
            "do": [
                {"kind": "move_part", "part": "square", "x": 0.1, "y": 0.05, "theta": 1.0},
                {"kind": "move_part", "part": "washer", "x": 0.2, "y": 0.05},
                {"kind": "remove_part", "part": "parallelogram"},
                {"kind": "remove_part", "part": "no such part"},
                {"kind": "byte_order", "endian": 1},
            ],
        }
    )
    async with emulator:
        assert emulator.commands == ("shuffle",)
        emulator.command("shuffle")
        assert emulator.scene.pieces["square"] == (0.1, 0.05, 1.0)
        assert {one.name for one in emulator.scene.measure()} >= {"washer", "square"}
        assert "parallelogram" not in emulator.scene.pieces
        assert emulator.device.endian == 1


async def test_clear_faults_on_the_timeline_ends_what_lasts() -> None:
    clock, emulator = camera(
        {"do": [{"kind": "busy_for_ever"}, {"kind": "drop", "on": "QueryAnswer"}]},
        {"at": 1, "do": {"kind": "clear_faults"}},
    )
    async with emulator:
        assert Status.BUSY in emulator.device.status
        clock.advance(1)
        assert Status.BUSY not in emulator.device.status
        assert emulator.faults == []


async def test_cues_that_bring_each_other_about_end(caplog: pytest.LogCaptureFixture) -> None:
    _, emulator = camera(
        {"entering": "running", "times": 10_000, "do": {"kind": "stop"}},
        {"entering": "stopped", "times": 10_000, "do": {"kind": "start"}},
    )
    async with emulator:
        emulator.device.stop()
        assert sum(emulator.cue_counts) == MAX_CUES_AT_ONCE
    assert "one is dropped" in caplog.text


async def test_timeline_begins_anew_with_each_start() -> None:
    clock, emulator = camera({"at": 1, "do": {"kind": "stop"}})
    for _ in range(2):
        async with emulator:
            emulator.device.start()
            clock.advance(0.999)
            assert emulator.device.running
            clock.advance(0.001)
            assert not emulator.device.running
        clock.advance(5)


async def test_too_many_faults_are_reported_and_the_camera_goes_on(
    caplog: pytest.LogCaptureFixture,
) -> None:
    waiting = [{"kind": "drop", "on": "ClockAnswer"}] * 100
    clock, emulator = camera({"at": 1, "every": 1, "do": waiting})
    async with emulator:
        with caplog.at_level(logging.WARNING):
            clock.advance(101)
        assert len(emulator.faults) == 10_000
    assert "not injected: at most 10000 faults can wait" in caplog.text


async def test_same_timeline_and_seed_give_the_same_bytes() -> None:
    async def run(seed: int) -> list[tuple[float, int | None, str]]:
        clock, emulator = camera(
            {"at": 0.5, "every": 0.4, "chance": 0.5, "do": {"kind": "digital_input"}},
            {"entering": "inspecting", "times": 50, "chance": 0.3, "do": {"kind": "no_result"}},
            seed=seed,
            active=7,
        )
        async with emulator, await TcpClient.open(emulator) as client:
            client.send(wire.CONNECT)
            await client.expect(wire.CONNECTED, wire.WAITING)
            clock.advance(20)
        return [(entry.time, entry.message_id, entry.hex) for entry in emulator.log]

    assert await run(4) == await run(4) != await run(5)


async def test_timeline_in_real_time() -> None:
    emulator = EmulatedCamera(
        active=21, running=True, clock=RealClock(), timeline=[{"at": 0.05, "do": STOP}]
    )
    async with emulator, asyncio.timeout(5):
        while emulator.device.running:  # noqa: ASYNC110 - the device has no event for it
            await asyncio.sleep(0.005)
    assert emulator.cue_counts == [1]


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (
            {"timeline": [{"at": 1, "do": {"kind": "drop", "on": "TriggerAnswer"}}]},
            "emulator: timeline.0.do.0.on: dialect handbook has no TriggerAnswer",
        ),
        (
            {
                "timeline": [
                    {"do": STOP},
                    {"do": [STOP, {"kind": "switch_application", "application": 99}]},
                ]
            },
            "emulator: timeline.1.do.1.application: the camera has no application 99",
        ),
        ({"timeline": [{"do": STOP}, {"at": 1}]}, "cue 2: do: Field required"),
        ({"active": 99}, "emulator: active: no application has the id 99; there are 1, 3, 7"),
    ],
)
def test_what_the_camera_cannot_do_is_refused_at_once(options: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        EmulatedCamera(**options)
    assert text in str(caught.value)


# ---------------------------------------------------------------------- clocks


def test_manual_clock_stands_still() -> None:
    clock = ManualClock()
    assert clock.now == 0.0
    clock.advance(0.0)
    assert clock.now == 0.0


def test_manual_clock_advance_calls_in_order_of_time() -> None:
    clock = ManualClock()
    seen: list[tuple[str, float]] = []
    clock.call_at(2.0, lambda: seen.append(("b", clock.now)))
    clock.call_at(1.0, lambda: seen.append(("a", clock.now)))
    clock.call_at(2.0, lambda: seen.append(("c", clock.now)))
    clock.call_at(9.0, lambda: seen.append(("never", clock.now)))
    clock.advance(3.0)
    assert seen == [("a", 1.0), ("b", 2.0), ("c", 2.0)]
    assert clock.now == 3.0


def test_manual_clock_advance_calls_what_was_set_inside_it() -> None:
    clock = ManualClock()
    seen: list[float] = []

    def again() -> None:
        seen.append(clock.now)
        clock.call_at(clock.now + 0.1, again)

    clock.call_at(0.1, again)
    clock.advance(1.0)
    assert seen == pytest.approx([0.1 * n for n in range(1, 11)], abs=1e-12)


def test_manual_clock_past_instant_is_called_at_the_next_advance() -> None:
    clock = ManualClock()
    clock.advance(5.0)
    seen: list[float] = []
    clock.call_at(1.0, lambda: seen.append(clock.now))
    clock.advance(0.0)
    assert seen == [5.0]


def test_manual_clock_cancelled_timer_is_not_called() -> None:
    clock = ManualClock()
    seen: list[int] = []
    timer = clock.call_at(1.0, lambda: seen.append(1))
    timer.cancel()
    timer.cancel()
    clock.advance(2.0)
    assert seen == []


@pytest.mark.parametrize("seconds", [-1.0, float("nan")])
def test_manual_clock_backwards_is_refused(seconds: float) -> None:
    with pytest.raises(ConfigurationError, match="clock: seconds: "):
        ManualClock().advance(seconds)


def test_manual_clock_advance_inside_advance_is_refused_and_it_works_on() -> None:
    clock = ManualClock()
    clock.call_at(1.0, lambda: clock.advance(1.0))
    with pytest.raises(ConfigurationError, match="inside advance"):
        clock.advance(2.0)
    assert clock.now == 1.0
    clock.advance(2.0)
    assert clock.now == 3.0


async def test_real_clock_is_the_loops() -> None:
    clock = RealClock()
    loop = asyncio.get_running_loop()
    assert abs(loop.time() - clock.now) < 1.0
    called = asyncio.Event()
    clock.call_at(clock.now, called.set)
    async with asyncio.timeout(5):
        await called.wait()


class _Count:
    """A value that counts how often it is compared."""

    compared = 0

    def __init__(self, number: int) -> None:
        self.number = number

    def __hash__(self) -> int:
        return hash(self.number)

    def __eq__(self, other: object) -> bool:
        _Count.compared += 1
        return bool(isinstance(other, _Count) and self.number == other.number)


def test_scenario_ids_are_compared_once_each() -> None:
    from smartcam.emulator._scenario.scenario import _first_duplicate

    _Count.compared = 0
    assert _first_duplicate(_Count(number) for number in range(5000)) is None
    assert _Count.compared < 5000
