"""Fleets of many cameras: patterns, one outcome for each camera, streams, and events."""

from __future__ import annotations

import asyncio
import contextlib
import gc
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import smartcam
import smartcam.fleet
from smartcam import Result
from smartcam.emulator import EmulatedCamera, faults
from smartcam.exceptions import (
    ConfigurationError,
    ConnectionClosedError,
    ConnectionLostError,
    InterpretationError,
    LocalProtocolError,
    NotRunningError,
    ReservationLostError,
    ResponseTimeoutError,
    SubscriberOverflowError,
    TriggerTimeoutError,
)
from smartcam.fleet import (
    AgentJoined,
    AgentLeft,
    CameraJoined,
    CameraLeft,
    Fleet,
    FleetEvent,
    FleetFile,
    FleetServer,
    MemoryBus,
)
from smartcam.makes import EmulatedIfm
from tests.client.clientkit import cancelled
from tests.fleet.inside import Handle, MemoryConnection, in_words
from tests.handmade import until

LOOK = {"application": 21, "interpret_as": "text: string[20]"}
HELLO = {**LOOK, "emulated": {}}


def file(cameras: dict[str, Any], **more: Any) -> FleetFile:
    return FleetFile.model_validate({"cameras": cameras, **more})


PLANT = file(
    {
        "line1/**": {**HELLO, "emulated": {"count": 2}},
        "line2/cam1": HELLO,
        "press": HELLO,
    },
    agent="first",
)


def agent(bus: MemoryBus, name: str, *cameras: str) -> FleetServer:
    """An agent with emulated cameras."""
    return FleetServer(file(dict.fromkeys(cameras, HELLO), agent=name), bus=bus.new_connection())


def fleet_on(bus: MemoryBus, **options: Any) -> Fleet:
    """A program with the fleet of a bus."""
    return Fleet(bus.new_connection(), None, "plant", None, 2.0, options)


def texts(results: Any) -> list[str]:
    return [one.value.text for one in results]


# ---------------------------------------------------------------------- cameras


async def test_cameras_are_found_by_patterns() -> None:
    async with smartcam.fleet.open(PLANT) as fleet:
        assert [one.name for one in fleet] == ["line1/cam1", "line1/cam2", "line2/cam1", "press"]
        assert [one.name for one in fleet.cameras("line1/*")] == ["line1/cam1", "line1/cam2"]
        assert [one.name for one in fleet.cameras("*/cam1")] == ["line1/cam1", "line2/cam1"]
        assert [one.name for one in fleet.cameras("**/cam1")] == ["line1/cam1", "line2/cam1"]
        assert [one.name for one in fleet.cameras("*")] == ["press"]
        assert fleet.cameras("line3/*") == []
        with pytest.raises(ConfigurationError, match="expected a camera's name, with"):
            fleet.cameras("line*")
        assert len(fleet) == 4
        assert "press" in fleet
        assert fleet.agents() == ["first"]
        assert fleet["press"] is fleet.cameras("press")[0]
        assert repr(fleet) == "<Fleet fleet://, 4 cameras>"


async def test_cameras_of_a_fleet_are_cameras() -> None:
    async with smartcam.fleet.open(PLANT) as fleet:
        camera = fleet["line1/cam1"]
        assert isinstance(camera, smartcam.Camera)
        assert (camera.connected, camera.active_application) == (True, 21)
        result = await camera.trigger(timeout=2.0)
        assert (result.camera, result.value.text) == ("line1/cam1", "Hello World")
        with pytest.raises(LocalProtocolError, match="opened or closed before"):
            await camera.open()


async def test_unknown_camera_is_told_with_what_was_meant() -> None:
    async with smartcam.fleet.open(PLANT) as fleet:
        with pytest.raises(ConfigurationError, match=r"no camera 'line1/cm1'; .*'line1/cam1'\?"):
            fleet["line1/cm1"]
        assert "line1/cm1" not in fleet


async def test_camera_that_is_not_there_is_shown_as_such() -> None:
    async with EmulatedCamera() as gone:
        url = gone.url
    plan = file({"here": HELLO, "gone": {"url": url}})
    async with smartcam.fleet.open(plan) as fleet:
        assert {one.name: one.connected for one in fleet} == {"here": True, "gone": False}
        outcomes = await fleet.trigger()
        assert isinstance(outcomes["here"], Result)
        error = outcomes["gone"]
        assert isinstance(error, ConnectionLostError)
        assert "the agent has no session with the camera" in str(error)


async def test_interpretation_is_the_programs_or_the_files() -> None:
    async with smartcam.fleet.open(PLANT) as fleet:
        assert (await fleet["press"].trigger()).value.text == "Hello World"
    async with smartcam.fleet.open(PLANT, interpret_as="raw") as fleet:
        assert (await fleet["press"].trigger()).value.startswith(b"Hello")


# ---------------------------------------------------------------------- life


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"interpret_as": "n: int3"}, "int3"),
        ({"interpretas": "raw"}, "no option 'interpretas'; .*did you mean 'interpret_as'"),
        ({"application": 7}, "no option 'application'"),
        ({"switch_timeout": -1}, "switch_timeout: .*greater than 0"),
        ({"connect_timeout": 0}, "connect_timeout: .*greater than 0"),
        ({"reconnect": 3}, "reconnect: "),
    ],
)
def test_options_are_validated_at_once(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        smartcam.fleet.open(PLANT, **options)


def test_place_that_is_none(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"scheme 'flet'; did you mean 'fleet'"):
        smartcam.fleet.open("flet://localhost")
    with pytest.raises(ConfigurationError, match=r"fleet .*none.yaml: .*No such file"):
        smartcam.fleet.open(tmp_path / "none.yaml")


async def test_close_ends_everything_and_is_idempotent() -> None:
    fleet = await smartcam.fleet.open(PLANT).open()
    camera, results, events = fleet["press"], fleet.results(), fleet.events()
    await camera.trigger()
    await fleet.close()
    await fleet.close()
    assert texts([one async for one in results]) == ["Hello World"]  # what was queued
    assert len([one async for one in events]) == 5
    with pytest.raises(ConnectionClosedError):
        await camera.trigger()
    with pytest.raises(ConnectionClosedError, match="fleet://: not open"):
        await fleet.trigger()
    assert [one async for one in fleet.results()] == []
    assert [one async for one in fleet.events()] == []
    with pytest.raises(LocalProtocolError, match="make a new one"):
        await fleet.open()


async def test_fleet_that_was_never_opened() -> None:
    fleet = smartcam.fleet.open(PLANT)
    assert fleet.cameras() == []
    with pytest.raises(ConnectionClosedError, match="not open"):
        await fleet.trigger()
    await fleet.close()


@pytest.mark.parametrize("steps", [1, 3, 10, 30, 100, 300])
async def test_cancelled_open_leaves_nothing(steps: int) -> None:
    fleet = smartcam.fleet.open(PLANT)
    task = asyncio.create_task(fleet.open())
    for _ in range(steps):
        await asyncio.sleep(0)
    if not task.done():
        await cancelled(task)  # the test's own check finds what is left
    await fleet.close()


# ---------------------------------------------------------------------- trigger


async def test_trigger_gives_each_camera_its_own_outcome() -> None:
    async with contextlib.AsyncExitStack() as stack:
        box = [await stack.enter_async_context(EmulatedCamera()) for _ in range(4)]
        plan = file({f"cam{n}": {**LOOK, "url": one.url} for n, one in enumerate(box)})
        fleet = await stack.enter_async_context(smartcam.fleet.open(plan))
        await fleet["cam1"].stop()
        box[2].inject(faults.NoResult())
        box[3].inject(faults.HalfOpen(on="Trigger"))
        outcomes = await fleet.trigger(timeout=1.0)
    assert {name: type(one) for name, one in outcomes.items()} == {
        "cam0": Result,
        "cam1": NotRunningError,
        "cam2": TriggerTimeoutError,
        "cam3": TriggerTimeoutError,
    }
    assert outcomes["cam0"].camera == "cam0"  # type: ignore[union-attr]


async def test_trigger_takes_what_a_camera_takes() -> None:
    async with smartcam.fleet.open(PLANT) as fleet:
        raw = await fleet.trigger("line1/*", interpret_as="raw", when_busy="refuse")
        assert {name: one.value[:5] for name, one in raw.items()} == {  # type: ignore[union-attr]
            "line1/cam1": b"Hello",
            "line1/cam2": b"Hello",
        }
        lists: Any = await fleet.trigger("press", results_per_trigger=1)
        assert texts(lists["press"]) == ["Hello World"]


@pytest.mark.parametrize(
    ("pattern", "options", "message"),
    [
        ("line3/*", {}, r"no camera of the fleet is 'line3/\*'; there are line1/cam1, line1/cam2"),
        ("Line", {}, "expected a camera's name, with"),
        ("**", {"timeout": -1}, "timeout: expected seconds"),
        ("**", {"when_busy": "go"}, "when_busy: expected 'wait' or 'refuse'"),
        ("**", {"interpret_as": "n: int3"}, "int3"),
    ],
)
async def test_trigger_that_cannot_work_is_refused(
    pattern: str, options: dict[str, Any], message: str
) -> None:
    async with smartcam.fleet.open(PLANT) as fleet:
        with pytest.raises(ConfigurationError, match=message):
            await fleet.trigger(pattern, **options)
        with pytest.raises(TypeError, match="aplication"):
            await fleet.trigger(aplication=7)


async def test_what_one_camera_cannot_do_costs_the_others_nothing() -> None:
    plan = file({"a": HELLO, "b": {**HELLO, "interpret_as": "raw"}})
    async with smartcam.fleet.open(plan) as fleet:
        camera = fleet["b"]

        async def refuse(*_: Any, **__: Any) -> Any:
            raise ConfigurationError("not this one")

        camera._trigger = refuse  # type: ignore[method-assign]
        outcomes = await fleet.trigger()
        assert isinstance(outcomes["a"], Result)
        assert isinstance(outcomes["b"], ConfigurationError)


async def test_agent_that_dies_during_a_trigger_is_named_at_once() -> None:
    bus = MemoryBus()
    async with agent(bus, "one", "a"), fleet_on(bus) as fleet:
        end = bus.new_connection()
        slow = {"b": {**HELLO, "emulated": {}, "application": 21}}
        async with FleetServer(file(slow, agent="two"), bus=end):
            await until(lambda: len(fleet) == 2 and fleet["b"].connected)
            waiting = asyncio.create_task(fleet.trigger(timeout=60.0))
            await until(lambda: len(fleet["b"]._program._pending_calls) >= 2)
            before = asyncio.get_running_loop().time()
            end.detach()
            outcomes = await waiting
    assert isinstance(outcomes["a"], Result)
    assert isinstance(outcomes["b"], ConnectionLostError)
    assert "two" in str(outcomes["b"])
    assert asyncio.get_running_loop().time() - before < 5.0


async def test_cancelled_trigger_is_cancelled_at_every_agent() -> None:
    async with smartcam.fleet.open(PLANT) as fleet:
        for camera in fleet:
            await camera.switch_application(9)  # runs free: a trigger has no result
        task = asyncio.create_task(fleet.trigger(timeout=60.0))
        await until(lambda: len(fleet["press"]._program._pending_calls) == 4)
        await cancelled(task)
        for camera in fleet:
            await camera.switch_application(21)
        outcomes = await fleet.trigger(timeout=2.0)
        assert all(isinstance(one, Result) for one in outcomes.values()), outcomes


# ---------------------------------------------------------------------- results


async def test_results_of_several_cameras_come_in_one_stream() -> None:
    async with smartcam.fleet.open(PLANT) as fleet:
        async with fleet.results("line1/*") as results, fleet.results() as everything:
            for _ in range(3):
                await fleet.trigger()
            got = [await anext(results) for _ in range(6)]
            assert Counter(one.camera for one in got) == {"line1/cam1": 3, "line1/cam2": 3}
            for name in ("line1/cam1", "line1/cam2"):
                assert [one.number for one in got if one.camera == name] == [1, 2, 3]
            account = results.statistics()
            assert {one: (of.offered, of.taken) for one, of in account.items()} == {
                "line1/cam1": (3, 3),
                "line1/cam2": (3, 3),
            }
            queued = everything.statistics()
            assert {of.queued for of in queued.values()} == {3}
            assert len(queued) == 4
        assert {of.dropped for of in everything.statistics().values()} == {3}
        with pytest.raises(StopAsyncIteration):
            await anext(everything)


async def test_cameras_are_read_in_turn() -> None:
    async with smartcam.fleet.open(PLANT) as fleet:
        results = fleet.results()
        for _ in range(5):
            await fleet["press"].trigger()
        await fleet["line2/cam1"].trigger()
        got = [(await anext(results)).camera for _ in range(6)]
        assert got.index("line2/cam1") == 1
        assert Counter(got)["press"] == 5


async def test_camera_that_sends_much_takes_nothing_from_the_others() -> None:
    async with smartcam.fleet.open(PLANT) as fleet:
        results = fleet.results(max_queue=2)
        await fleet["line2/cam1"].trigger()
        for _ in range(5):
            await fleet["press"].trigger()
        account = results.statistics()
        assert (account["press"].dropped, account["press"].queued) == (3, 2)
        assert (account["line2/cam1"].dropped, account["line2/cam1"].queued) == (0, 1)


async def test_overflow_ends_one_cameras_stream_and_no_others() -> None:
    async with smartcam.fleet.open(PLANT) as fleet:
        results = fleet.results(max_queue=1, overflow="error")
        for _ in range(2):
            await fleet["press"].trigger()
        assert (await anext(results)).camera == "press"
        with pytest.raises(SubscriberOverflowError):
            await anext(results)
        await fleet.trigger()
        got = {(await anext(results)).camera for _ in range(3)}
        assert got == {"line1/cam1", "line1/cam2", "line2/cam1"}
        account = results.statistics()["press"]
        assert account.offered == account.taken + account.dropped + account.queued


async def test_result_that_cannot_be_read_is_raised_and_the_stream_goes_on() -> None:
    layouts = {21: "text: string[19]", 3: "raw"}
    async with smartcam.fleet.open(PLANT, interpret_as=layouts) as fleet:
        camera, results = fleet["press"], fleet.results()
        with pytest.raises(InterpretationError):
            await camera.trigger()
        with pytest.raises(InterpretationError):
            await anext(results)
        await camera.trigger(application=3)
        assert (await anext(results)).application == 3


async def test_camera_that_joins_later_is_in_the_streams() -> None:
    bus = MemoryBus()
    async with agent(bus, "one", "line1/cam1"), fleet_on(bus) as fleet:
        results, others = fleet.results("line1/*"), fleet.results("line2/*")
        async with agent(bus, "two", "line1/cam2"):
            await until(lambda: "line1/cam2" in fleet and fleet["line1/cam2"].connected)
            await fleet.trigger()
            assert {(await anext(results)).camera for _ in range(2)} == {
                "line1/cam1",
                "line1/cam2",
            }
            assert others.statistics() == {}


async def test_stream_goes_on_over_an_agent_that_comes_back() -> None:
    bus = MemoryBus()
    async with fleet_on(bus) as fleet:
        results = fleet.results()
        for _ in range(2):
            async with agent(bus, "one", "a"):
                await until(lambda: "a" in fleet and fleet["a"].connected)
                await fleet["a"].trigger()
                assert (await anext(results)).camera == "a"
            await until(lambda: not fleet["a"].connected)
            assert fleet.cameras() == []
            assert "a" in fleet


async def test_camera_lost_for_good_is_told_once() -> None:
    bus = MemoryBus()
    async with agent(bus, "one", "a"), fleet_on(bus, reconnect=None) as fleet:
        results = fleet.results()
        async with agent(bus, "two", "b"):
            await until(lambda: "b" in fleet and fleet["b"].connected)
        with pytest.raises(ConnectionLostError, match="two"):
            await anext(results)
        await fleet["a"].trigger()
        assert (await anext(results)).camera == "a"


async def test_camera_that_was_given_up_is_another_when_its_agent_is_back() -> None:
    bus = MemoryBus()
    async with fleet_on(bus, reconnect=None) as fleet:
        results = fleet.results()
        async with agent(bus, "one", "a"):
            await until(lambda: "a" in fleet and fleet["a"].connected)
            before = fleet["a"]
        await until(lambda: before.ended)
        async with agent(bus, "one", "a"):
            await until(lambda: fleet["a"].connected)
            assert fleet["a"] is not before
            with pytest.raises(ConnectionLostError):
                await before.trigger()
            await fleet["a"].trigger()
            with contextlib.suppress(ConnectionLostError):  # what ended the stream of before
                await anext(results)
            assert (await anext(results)).camera == "a"


async def test_stream_that_nobody_refers_to_is_gone() -> None:
    async with smartcam.fleet.open(PLANT) as fleet:
        kept = fleet.results()
        fleet.results()
        gc.collect()
        await fleet["press"].trigger()
        assert len(fleet["press"].statistics().subscribers) == 1
        assert kept.statistics()["press"].queued == 1


@pytest.mark.parametrize(
    "options",
    [{"max_queue": 0}, {"overflow": "drop"}, {"min_interval": -1}, {"max_queue_bytes": 0}],
)
async def test_wrong_options_of_a_stream_are_told_at_once(options: dict[str, Any]) -> None:
    async with fleet_on(MemoryBus()) as fleet:  # without a camera
        with pytest.raises(ConfigurationError, match=r"results\(\)"):
            fleet.results(**options)
        with pytest.raises(ConfigurationError, match="expected a camera's name"):
            fleet.results("A")


async def test_cancelled_read_loses_nothing() -> None:
    async with smartcam.fleet.open(PLANT) as fleet:
        results = fleet.results()
        task = asyncio.create_task(anext(results))
        await asyncio.sleep(0.1)
        await cancelled(task)
        await fleet["press"].trigger()
        assert (await anext(results)).camera == "press"


# ---------------------------------------------------------------------- events


def told(events: list[smartcam.fleet.FleetEvent]) -> list[tuple[str, ...]]:
    return [
        (
            type(one).__name__,
            one.agent,
            *([one.camera] if isinstance(one, CameraJoined | CameraLeft) else []),
        )
        for one in events
    ]


async def test_events_tell_who_is_there_and_who_comes_and_goes() -> None:
    bus = MemoryBus()
    async with agent(bus, "one", "a"), fleet_on(bus) as fleet:
        events = fleet.events()
        async with agent(bus, "two", "b", "c"):
            await until(lambda: len(fleet) == 3)
            late = fleet.events()
            assert fleet.agents() == ["one", "two"]
            assert fleet.agents("b") == ["two"]
        await until(lambda: len(fleet) == 1)
        assert fleet.agents() == ["one"]
    left = [("CameraLeft", "two", "b"), ("CameraLeft", "two", "c"), ("AgentLeft", "two")]
    assert told([one async for one in events]) == [
        ("AgentJoined", "one"),
        ("CameraJoined", "one", "a"),
        ("AgentJoined", "two"),
        ("CameraJoined", "two", "b"),
        ("CameraJoined", "two", "c"),
        *left,
    ]
    assert told([one async for one in late]) == [
        ("AgentJoined", "one"),
        ("AgentJoined", "two"),
        ("CameraJoined", "one", "a"),
        ("CameraJoined", "two", "b"),
        ("CameraJoined", "two", "c"),
        *left,
    ]


async def test_events_begin_before_the_fleet_is_opened() -> None:
    fleet = smartcam.fleet.open(PLANT)
    events = fleet.events()
    async with fleet:
        pass
    got = [one async for one in events]
    assert [type(one) for one in got] == [AgentJoined, *[CameraJoined] * 4]
    assert {(one.fleet, one.agent) for one in got} == {("plant", "first")}


async def test_camera_can_be_waited_for_as_soon_as_it_has_joined() -> None:
    bus = MemoryBus()
    async with fleet_on(bus) as fleet:
        events = fleet.events()
        async with agent(bus, "one", "a"):
            async for event in events:
                if isinstance(event, CameraJoined):
                    break
            assert not fleet["a"].connected
            await fleet["a"].wait_connected()
            assert fleet["a"].connected


async def test_agent_that_is_cut_off_has_left_and_comes_back() -> None:
    bus = MemoryBus()
    end = bus.new_connection()
    one = FleetServer(file({"a": HELLO}, agent="one"), bus=end)
    async with one, fleet_on(bus) as fleet:
        events = fleet.events()
        end.detach()
        await until(lambda: not fleet.agents())
        assert fleet.cameras() == []
        assert not fleet["a"].connected
        end.attach()
        await until(lambda: fleet.agents() and fleet["a"].connected)
        assert (await fleet["a"].trigger()).value.text == "Hello World"
    kinds = [type(one) async for one in events]
    assert kinds == [AgentJoined, CameraJoined, CameraLeft, AgentLeft, AgentJoined, CameraJoined]


class _LatePresenceOfOne(MemoryConnection):
    """An end at which who watches one camera is told later than who watches all."""

    def watch(self, pattern: str, see: Callable[[str, bool], None]) -> Handle:
        if "/presence/camera/" not in pattern or pattern.endswith("**"):
            return super().watch(pattern, see)
        loop = asyncio.get_running_loop()

        def late(key: str, present: bool) -> None:
            loop.call_later(0.05, see, key, present)

        return super().watch(pattern, late)


@pytest.mark.parametrize("kind", [CameraLeft, AgentLeft])
async def test_camera_is_away_once_the_fleet_says_that_it_or_its_agent_left(
    kind: type[FleetEvent],
) -> None:
    bus = MemoryBus()
    async with Fleet(_LatePresenceOfOne(bus), None, "plant", None, 2.0, {}) as fleet:
        events = fleet.events()
        async with agent(bus, "one", "a"):
            await until(lambda: "a" in fleet)
            await fleet["a"].wait_connected()
        async for event in events:
            if isinstance(event, kind):
                break
        assert not fleet["a"].connected
        with pytest.raises(ConnectionLostError, match=r"shares the camera no more|is gone"):
            await fleet["a"].trigger()


async def test_second_agent_with_a_camera_refuses_and_names_the_first() -> None:
    bus = MemoryBus()
    async with agent(bus, "one", "a", "b"), fleet_on(bus) as fleet:
        second = agent(bus, "two", "b", "c")
        with pytest.raises(ConfigurationError, match=r"^b: the agent one of fleet plant has this"):
            await second.start()
        assert fleet.names() == ["a", "b"]  # not even the camera that nobody has
        assert isinstance((await fleet.trigger())["b"], Result)


# ---------------------------------------------------------------------- reservations


async def test_reserved_camera_keeps_the_fleets_others_out() -> None:
    bus = MemoryBus()
    async with agent(bus, "one", "a", "b"), fleet_on(bus) as mine, fleet_on(bus) as yours:
        async with mine["a"].reserve(timeout=1.0) as camera:
            assert camera is mine["a"]
            outcomes = await yours.trigger(timeout=0.5)
            assert isinstance(outcomes["b"], Result)
            refused = outcomes["a"]
            assert isinstance(refused, TriggerTimeoutError)
            assert in_words(mine["a"]._program.name) in str(refused)
            with pytest.raises(ResponseTimeoutError, match="reserved by"):
                async with yours["a"].reserve(timeout=0.5):
                    raise AssertionError
            assert isinstance((await mine.trigger())["a"], Result)
        assert isinstance((await yours.trigger())["a"], Result)


async def test_reservation_ends_with_its_program() -> None:
    bus = MemoryBus()
    async with agent(bus, "one", "a"), fleet_on(bus) as yours:
        mine = fleet_on(bus)
        await mine.open()
        reservation = mine["a"].reserve()
        await reservation.__aenter__()
        await mine.close()
        assert isinstance((await yours.trigger(timeout=2.0))["a"], Result)
        with pytest.raises(ReservationLostError, match="closed"):  # its block had it no more
            await reservation.__aexit__(None, None, None)


async def test_remarks_of_a_camera_reach_the_programs_of_a_fleet() -> None:
    slow = [{"id": 1, "processing_time": 5.0}]
    async with EmulatedIfm(applications=slow) as emulator:
        bus = MemoryBus()
        server = FleetServer(file({"left": {"url": emulator.url}}), bus=bus.new_connection())
        async with server, fleet_on(bus) as fleet:
            events = fleet["left"].events()
            await fleet["left"].wait_connected(timeout=10.0)
            emulator.device.trigger()
            emulator.device.trigger()  # an overrun
            async with asyncio.timeout(10.0):
                async for event in events:
                    if isinstance(event, smartcam.NoticeReceived):
                        break
        assert isinstance(event, smartcam.NoticeReceived)
        assert (event.camera, event.kind, event.code) == ("left", "error", 110001006)
        assert event.text == "Trigger overrun"
        assert fleet["left"].statistics().notices == 1
