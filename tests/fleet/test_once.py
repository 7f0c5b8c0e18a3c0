"""Commands are carried out once per call, on a bus that loses, repeats, delays and reorders."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Sequence
from typing import Any

import pytest

from smartcam import fleet
from smartcam.exceptions import (
    ConnectionLostError,
    LocalProtocolError,
    ResponseTimeoutError,
    SmartCamError,
    TriggerTimeoutError,
)
from smartcam.fleet import FleetFile
from smartcam.models import Disconnected, Reconnected
from smartcam.streams import Subscription
from tests.client.clientkit import gone
from tests.fleet.fleetkit import NAME, NumberedCamera, Plant, end_of, until
from tests.fleet.inside import AgentLog, decode, decode_trigger, decode_trigger_reply
from tests.fleet.lossy_bus import LossyBus, as_said, only


def token(number: int) -> bytes:
    """Return the input that tells which call it is."""
    return number.to_bytes(4, "little")


def slow(seconds: float) -> NumberedCamera:
    return NumberedCamera(time=seconds)


async def _runs(results: Subscription[Any]) -> AsyncIterator[int]:
    for _ in range(results.statistics().queued):
        yield (await anext(results)).value.run


class Recorded:
    """A bus whose commands are kept, to be said again."""

    def __init__(self) -> None:
        self.bus = LossyBus(self.fate)
        self.said: list[tuple[str, bytes]] = []

    def fate(self, key: str, payload: bytes) -> Sequence[float]:
        if key.split("/")[2] in {"command", "ask"}:
            self.said.append((key, payload))
        return (0.0,)

    def calls(self, do: str) -> list[tuple[str, bytes]]:
        return [one for one in self.said if _what(one[1]) == do]


def _what(payload: bytes) -> str | None:
    """Return what a call wants done; None for a cancellation."""
    if decode_trigger(payload, "it") is not None:
        return "trigger"
    return decode(payload, "it").fields.get("do")


async def test_doubled_calls_and_replies_are_one() -> None:
    bus = LossyBus(lambda _key, _payload: (0.0, 0.0, 0.01))
    async with Plant(bus=bus) as plant, plant.camera() as camera:
        for number in range(1, 51):
            result = await camera.trigger(timeout=1.0)
            assert result.value.run == number == plant.box.runs
        await asyncio.sleep(0.1)
        assert plant.box.runs == 50


async def test_lost_reply_is_a_timeout_that_does_not_guess() -> None:
    bus = LossyBus()
    async with Plant(bus=bus) as plant, plant.camera() as camera:
        bus.fate = only("reply", lambda *_: ())
        error = await gone(camera.trigger(timeout=0.5))
        assert isinstance(error, TriggerTimeoutError)
        assert "whether the camera was triggered is unknown" in str(error)
        assert "agent" in str(error)
        error = await gone(camera.start(timeout=0.5))
        assert isinstance(error, ResponseTimeoutError)
        assert "whether it was done is unknown" in str(error)
        bus.fate = as_said
        assert (await camera.trigger(timeout=1.0)).value.run == 2


async def test_statuses_of_a_lost_reply_come_all_the_same() -> None:
    def no_outcome(key: str, payload: bytes) -> Sequence[float]:
        return (0.0,) if decode_trigger_reply(payload, "it") is None else ()

    bus = LossyBus()
    async with Plant(bus=bus) as plant, plant.camera() as camera:
        statuses = camera.statuses()
        await camera.trigger(timeout=1.0)
        before = statuses.statistics().queued
        bus.fate = only("reply", no_outcome)
        assert isinstance(await gone(camera.trigger(timeout=0.5)), TriggerTimeoutError)
        await asyncio.sleep(1.0)
        assert statuses.statistics().queued == 2 * before > 0


async def test_lost_command_is_a_timeout_and_nothing_was_done() -> None:
    bus = LossyBus()
    async with Plant(bus=bus) as plant, plant.camera() as camera:
        bus.fate = only("command", lambda *_: ())
        assert isinstance(await gone(camera.trigger(timeout=0.5)), TriggerTimeoutError)
        bus.fate = as_said
        assert (await camera.trigger(timeout=1.0)).value.run == 1


async def test_call_that_comes_after_its_deadline_is_not_done() -> None:
    bus = LossyBus()
    async with Plant(bus=bus) as plant, plant.camera() as camera:
        bus.fate = only("command", lambda *_: (5.0,))
        assert isinstance(await gone(camera.trigger(timeout=0.5)), TriggerTimeoutError)
        bus.fate = as_said
        await asyncio.sleep(10.0)
        assert (await camera.trigger(timeout=1.0)).value.run == 1


async def test_cancelled_call_that_comes_after_its_cancellation_is_not_done() -> None:
    bus = LossyBus()
    late = [True]

    def overtaken(_key: str, _payload: bytes) -> Sequence[float]:
        return (1.0,) if late.pop() else (0.0,)

    async with Plant(bus=bus) as plant, plant.camera() as camera:
        late.insert(0, False)
        bus.fate = only("command", overtaken)
        task = asyncio.create_task(camera.trigger(timeout=60.0))
        await asyncio.sleep(0.01)
        task.cancel()
        await asyncio.wait({task})
        bus.fate = as_said
        await asyncio.sleep(5.0)
        assert (await camera.trigger(timeout=1.0)).value.run == 1


async def test_late_double_is_not_done_after_the_agent_was_restarted() -> None:
    record = Recorded()
    async with Plant(bus=record.bus) as plant, plant.camera() as camera:
        for number in range(1, 4):
            await camera.trigger(2, timeout=60.0, input=token(number))
        await plant.stop_agent()
        await plant.start_agent()
        await camera.wait_connected()
        for key, payload in record.calls("trigger"):
            end_of(camera).put(key, payload)
        result = await camera.trigger(2, timeout=60.0, input=token(4))
        assert result.value.token == 4
        assert [*plant.box.inputs.values()] == [1, 2, 3, 4]


async def test_late_double_is_not_done_after_its_program_was_cut_off_and_came_back() -> None:
    """The agent forgets a program that is gone, and yet does nothing of before for it."""
    record = Recorded()
    async with Plant(bus=record.bus) as plant, plant.camera() as camera:
        for number in range(1, 4):
            await camera.trigger(2, timeout=60.0, input=token(number))
        end_of(camera).detach()
        await asyncio.sleep(0.1)
        end_of(camera).attach()
        await camera.wait_connected()
        for key, payload in record.calls("trigger"):
            end_of(camera).put(key, payload)
        result = await camera.trigger(2, timeout=60.0, input=token(4))
        assert result.value.token == 4
        assert [*plant.box.inputs.values()] == [1, 2, 3, 4]


async def test_double_of_a_program_that_is_gone_is_not_done_and_nothing_of_it_is_kept() -> None:
    record = Recorded()
    async with Plant(bus=record.bus) as plant:
        async with plant.camera() as camera:
            await camera.trigger(timeout=60.0)
        await asyncio.sleep(0.1)
        assert plant.agent._programs == {}
        other = plant.bus.new_connection()
        await other.open(1.0)
        for key, payload in [*record.said]:
            other.put(key, payload)
        await asyncio.sleep(1.0)
        assert plant.box.runs == 1
        assert plant.agent._programs == {}
        await other.close()


async def test_agent_that_is_restarted_ends_calls_at_once_and_is_met_again() -> None:
    async with Plant(slow(5.0)) as plant, plant.camera() as camera:
        events, results = camera.events(), camera.results()
        calls = [asyncio.create_task(camera.trigger(timeout=600.0)) for _ in range(3)]
        await asyncio.sleep(1.0)
        begun = asyncio.get_running_loop().time()
        plant.cut_off_agent()  # it is gone without a word
        errors = await asyncio.gather(*calls, return_exceptions=True)
        assert asyncio.get_running_loop().time() - begun < 0.1
        for error in errors:
            assert isinstance(error, ConnectionLostError)
            assert "agent" in str(error)
            assert "unknown" in str(error)
        assert not camera.connected
        assert isinstance(await gone(camera.trigger(timeout=1.0)), ConnectionLostError)
        await plant.stop_agent()
        await until(lambda: not plant.box.sessions)
        await plant.start_agent()
        await camera.wait_connected()
        assert camera.status == await camera.query_status() if False else camera.connected
        result = await camera.trigger(timeout=600.0)
        assert result.value.run == plant.box.runs
        kinds = [type(await anext(events)) for _ in range(events.statistics().queued)]
        assert [kind for kind in kinds if kind in {Disconnected, Reconnected}] == [
            Disconnected,
            Reconnected,
        ]
        # of the run of before its end may come, too, which is nobody's now
        assert [run async for run in _runs(results)][-1] == result.value.run


async def test_status_is_right_after_an_agent_was_restarted() -> None:
    async with Plant() as plant, plant.camera() as camera:
        before = camera.status
        await plant.stop_agent()
        await until(lambda: not camera.connected)
        plant.box.device.stop()
        await plant.start_agent()
        await camera.wait_connected()
        assert camera.status == plant.agent.shared_cameras[NAME].client.status != before


def as_started_anew(plant: Plant) -> None:
    """Have an agent be as one of its name that was started before its end was seen.

    It was cut off, say, and another start of it was there before its lease was over: presence is
    told by name, so nobody sees a change.
    """
    agent, host = plant.agent, plant.agent.shared_cameras[NAME]
    agent.epoch += 1
    host.epoch += 1
    host.results, host.states = AgentLog(100, 1 << 20), AgentLog(100, 1 << 20)
    for program in [*agent._programs]:
        agent._forget_program(program)
    agent._last_calls.clear()


async def test_start_of_an_agent_that_nobody_saw_is_told_to_who_calls() -> None:
    async with Plant() as plant, plant.camera() as camera:
        await camera.trigger(timeout=1.0)
        as_started_anew(plant)
        error = await gone(camera.trigger(timeout=1.0))
        assert isinstance(error, ConnectionLostError)
        assert "was restarted" in str(error)
        assert "trigger was not done" in str(error)
        await camera.wait_connected()
        assert (await camera.trigger(timeout=1.0)).value.run == 2


async def test_start_of_an_agent_that_nobody_saw_is_seen_by_who_only_listens() -> None:
    async with Plant() as plant, plant.camera() as camera:
        results, events = camera.results(), camera.events()
        await asyncio.sleep(0.1)
        plant.box.device.trigger()
        assert (await anext(results)).value.run == 1
        as_started_anew(plant)
        async with asyncio.timeout(60.0):
            for run in (2, 3, 4):
                plant.box.device.trigger()
                result = await anext(results)
                assert (result.value.run, result.number) == (run, run - 1)
        kinds = [type(await anext(events)) for _ in range(events.statistics().queued)]
        assert [kind for kind in kinds if kind in {Disconnected, Reconnected}] == [
            Disconnected,
            Reconnected,
        ]


async def test_as_many_calls_at_once_as_cameras(monkeypatch: pytest.MonkeyPatch) -> None:
    """The bound of calls under way grows with the cameras: a whole fleet is triggered."""
    monkeypatch.setattr("smartcam.fleet._agent.agent.MAX_CALLS_PER_PROGRAM", 2)
    file = FleetFile.model_validate({"cameras": {"line1/**": {"emulated": {"count": 5}}}})
    async with fleet.open(file) as plant:
        cameras = plant.cameras()
        await asyncio.gather(*(one.start() for one in cameras))
        outcomes = await plant.trigger("**", timeout=10.0)
        assert [one for one in outcomes.values() if isinstance(one, SmartCamError)] == []
        many = (cameras[0].trigger(timeout=10.0) for _ in range(50))
        ends = await asyncio.gather(*many, return_exceptions=True)
        refused = [one for one in ends if isinstance(one, LocalProtocolError)]
        assert 0 < len(refused) <= 50 - 2
