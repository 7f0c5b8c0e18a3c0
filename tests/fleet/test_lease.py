"""Reservations last until the end of their block, or their program gets an event."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

import pytest

from smartcam.emulator import faults
from smartcam.exceptions import ConnectionLostError, ReservationLostError, SmartCamError
from smartcam.fleet import FleetCamera, MemoryBus, ReservationLost
from smartcam.protocols import messages as m
from tests.client.clientkit import gone
from tests.fleet.fleetkit import NAME, PATIENCE, Plant, end_of, until
from tests.fleet.inside import ProgramName, decode, decode_trigger, encode, in_words
from tests.fleet.lossy_bus import LossyBus, only
from tests.fleet.test_standby import Pair

Robot = FleetCamera[Any]


class Scene:
    """A robot and another program at one camera, and what has become of the robot's reservation."""

    def __init__(self, plant: Any, robot: Robot, other: Robot) -> None:
        self.plant, self.robot, self.other = plant, robot, other
        self.box = plant.box

    async def come_between(self) -> None:
        """Have the other program's command done."""
        runs = self.box.runs
        await until(lambda: self.other.connected)
        await self.other.trigger(timeout=60.0)
        assert self.box.runs == runs + 1


async def restart(scene: Scene) -> None:
    await scene.plant.stop_agent()
    await scene.plant.start_agent()


async def kill_and_start(scene: Scene) -> None:
    scene.plant.cut_off_agent()
    await scene.plant.agent.close()
    await scene.plant.start_agent()


async def cut_off(scene: Scene) -> None:
    """As a robot that is stopped for longer than the lease."""
    end_of(scene.robot).detach()
    await asyncio.sleep(0.1)
    end_of(scene.robot).attach()


async def add_anew(scene: Scene) -> None:
    """As a reload does without the camera, and one with it again."""
    agent = scene.plant.agent
    settings = agent.shared_cameras[NAME].settings
    await agent.remove_camera(NAME, "a test")
    await asyncio.sleep(0.1)
    await agent.add_camera(NAME, settings)


async def take_over(scene: Scene) -> None:
    scene.plant.ends["north"].detach()
    await until(lambda: "south" in scene.plant.having())


async def split(scene: Scene) -> None:
    """Agents that cannot see each other both have the camera, which serves the newcomer; the robot
    sees only the one that has lost it."""
    north, south = scene.plant.agents["north"], scene.plant.agents["south"]
    south.share(NAME, north.shared_cameras[NAME].settings)
    await until(lambda: "south" in scene.plant.having())


ONE = (restart, kill_and_start, cut_off, add_anew)
TWO = (take_over, split)
WAYS: tuple[Callable[[Scene], Awaitable[None]], ...] = (*ONE, *TWO)


@contextlib.asynccontextmanager
async def scene_of(way: object, bus: MemoryBus | None = None) -> AsyncIterator[Scene]:
    if way in TWO:
        async with Pair() as pair:
            await pair.start("north")
            await pair.start("south")
            async with pair.program() as robot, pair.program() as other:
                yield Scene(pair, robot, other)
    else:
        async with Plant(bus=bus) as plant, plant.cameras(2) as (robot, other):
            yield Scene(plant, robot, other)


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("inside", ["nothing", "trigger", "start", "reserve", "caught", "late"])
async def test_block_whose_reservation_is_lost_ends_with_an_error(
    way: Callable[[Scene], Awaitable[None]], inside: str
) -> None:
    async with scene_of(way) as scene:
        robot, box = scene.robot, scene.box
        told: list[BaseException | None] = []

        async def block() -> None:
            async with robot.reserve(timeout=5.0):
                await robot.trigger(timeout=5.0)
                await way(scene)
                await scene.come_between()
                if inside == "nothing":
                    return
                if inside == "late":  # another program's own block has the camera by now
                    async with scene.other.reserve(timeout=5.0):
                        await until(lambda: robot.connected)
                        told.append(await gone(robot.trigger(timeout=0.5)))
                    return
                await until(lambda: robot.connected)
                runs = box.runs
                calls: dict[str, Callable[[], Awaitable[object]]] = {
                    "trigger": lambda: robot.trigger(timeout=5.0),
                    "caught": lambda: robot.trigger(timeout=5.0),
                    "start": lambda: robot.start(timeout=5.0),
                    "reserve": lambda: robot.reserve(timeout=5.0).__aenter__(),
                }
                told.append(await gone(calls[inside]()))
                assert box.runs == runs
                if inside != "caught":
                    assert told[0] is not None
                    raise told[0]

        error = await gone(block())
        assert isinstance(error, ReservationLostError), error
        # the loss of the agent itself may be told first: nothing was done then, either
        assert all(isinstance(one, SmartCamError) for one in told), told
        await until(lambda: robot.connected)
        async with robot.reserve(timeout=10.0):  # the next one is as any other
            await robot.trigger(timeout=5.0)


@pytest.mark.parametrize("way", WAYS)
async def test_block_s_own_error_is_not_hidden(way: Callable[[Scene], Awaitable[None]]) -> None:
    async with scene_of(way) as scene:

        async def block() -> None:
            async with scene.robot.reserve(timeout=5.0):
                await way(scene)
                raise ZeroDivisionError

        assert isinstance(await gone(block()), ZeroDivisionError)


@pytest.mark.parametrize("how", ["stopped", "restarted"])
async def test_reservation_lasts_while_the_camera_comes_and_goes(how: str) -> None:
    """Nobody else can have it meanwhile, where no agent stands by."""
    async with (
        Plant() as plant,
        plant.cameras(2) as (robot, other),
        robot.reserve(timeout=5.0),
    ):
        if how == "stopped":
            await plant.box.stop()
            await until(lambda: not robot.connected)
            await plant.box.start()
        else:
            await robot.reboot()
        await robot.wait_connected()
        await robot.start(timeout=5.0)
        await robot.trigger(timeout=5.0)
        assert isinstance(await gone(other.trigger(timeout=0.2)), TimeoutError)


async def test_reservation_is_lost_with_the_session_where_another_agent_stands_by() -> None:
    """It may have had the camera meanwhile."""
    async with Pair() as pair:
        await pair.start("north")
        await pair.start("south")
        async with pair.program() as robot:

            async def block() -> None:
                async with robot.reserve(timeout=5.0):
                    pair.box.inject(faults.Close(on=m.QueryAnswer))
                    await gone(robot.query_application(timeout=5.0))
                    await until(lambda: robot.connected)
                    assert pair.having() == ["north"]

            assert isinstance(await gone(block()), ReservationLostError)


async def test_agent_without_the_camera_reserves_nothing_where_another_may_have_it() -> None:
    async with Pair() as pair:
        await pair.start("north")
        await pair.start("south")
        async with pair.program() as robot:
            await pair.box.stop()
            await until(lambda: not pair.having())
            host = pair.agents["north"].shared_cameras[NAME]
            error = await gone(host.reserve(robot._program.name, "it", 5.0))
            assert isinstance(error, ConnectionLostError)
            assert host.gate.holder is None
            await pair.box.start()


async def test_agent_that_may_have_lost_the_camera_unseen_asks_it_at_the_end() -> None:
    async with Pair() as pair:
        await pair.start("north")
        await pair.start("south")
        async with pair.program() as robot:

            async def block(*given: faults.Drop) -> None:
                async with robot.reserve(timeout=5.0):
                    await robot.trigger(timeout=5.0)
                    pair.box.inject(*given)

            assert await gone(block()) is None
            silent = faults.Drop(on=m.QueryAnswer, times=None)
            assert isinstance(await gone(block(silent)), ReservationLostError)


async def test_tasks_that_reserve_at_the_same_time_lose_nothing() -> None:
    async with Plant() as plant, plant.cameras(1) as (robot,):

        async def work(count: int) -> None:
            async with robot.reserve(timeout=5.0):
                for _ in range(count):
                    await robot.trigger(timeout=5.0)

        await asyncio.gather(work(1), work(5), work(3))
        assert plant.agent.shared_cameras[NAME].gate.holder is None


@pytest.mark.parametrize("do", ["trigger", "start"])
async def test_every_command_of_a_block_says_whose_it_is(do: str) -> None:
    """The agent refuses one whose reservation it does not know, whatever the program believes."""
    said: list[bytes] = []

    def fate(key: str, payload: bytes) -> tuple[float, ...]:
        if "/command/" in key:
            said.append(payload)
        return (0.0,)

    bus = LossyBus(fate)
    async with Plant(bus=bus) as plant, plant.cameras(1) as (robot,):
        plain = await robot.trigger(timeout=5.0)
        order = decode_trigger(said[-1], "it")
        assert order is not None
        assert order[1].reservation is None

        async def block() -> None:
            async with robot.reserve(timeout=5.0):
                reservation = decode(said[-1], "it").fields["call"]
                plant.agent.shared_cameras[NAME].lose_reservation()
                call = robot.trigger(timeout=5.0) if do == "trigger" else robot.start(timeout=5.0)
                assert isinstance(await gone(call), ReservationLostError)
                if order := decode_trigger(said[-1], "it"):
                    assert order[1].reservation == reservation
                else:
                    assert decode(said[-1], "it").fields["reservation"] == reservation

        assert isinstance(await gone(block()), ReservationLostError)
        assert plant.box.runs == plain.value.run


async def test_program_that_was_forgotten_is_told_of_its_reservation() -> None:
    """The agent's answer to a stranger names what is lost."""
    async with Plant() as plant, plant.cameras(1) as (robot,):

        async def block() -> None:
            async with robot.reserve(timeout=5.0):
                plant.agent._forget_program(robot._program.name)
                error = await gone(robot.trigger(timeout=5.0))
                assert isinstance(error, ReservationLostError)
                assert "was not done" in str(error)

        assert isinstance(await gone(block()), ReservationLostError)
        await until(lambda: robot.connected)
        assert (await robot.trigger(timeout=5.0)).value.run == 1


@pytest.mark.parametrize("lost", ["ask", "reply"])
async def test_block_whose_end_nobody_confirms_ends_with_an_error(lost: str) -> None:
    bus = LossyBus()
    async with Plant(bus=bus) as plant, plant.cameras(1, request_timeout=1.0) as (robot,):
        with pytest.raises(ReservationLostError, match="unknown"):
            async with robot.reserve(timeout=5.0):
                bus.fate = only(lost, lambda *_: ())
        assert plant.box.runs == 0


async def test_question_at_the_end_is_asked_again_where_it_is_lost() -> None:
    bus, fates = LossyBus(), iter([()])
    async with Plant(bus=bus) as plant, plant.cameras(1) as (robot,):
        async with robot.reserve(timeout=5.0):
            bus.fate = only("ask", lambda *_: next(fates, (0.0,)))
        await until(lambda: plant.agent.shared_cameras[NAME].gate.holder is None)


async def test_reservation_that_is_cancelled_as_it_is_made_is_given_back() -> None:
    """Whenever that is: the reply may be there already."""
    bus = LossyBus()
    async with Plant(bus=bus) as plant, plant.cameras(1) as (robot,):
        host = plant.agent.shared_cameras[NAME]
        bus.fate = only("states", lambda *_: ())  # what the reply speaks of is waited for
        host._publish_state({"kind": "Tried"})
        reservation = robot.reserve(timeout=5.0)
        task = asyncio.create_task(reservation.__aenter__())
        await until(lambda: host.gate.holder is not None)
        await asyncio.sleep(0.01)
        assert not task.done()
        task.cancel()
        assert isinstance(await gone(task), asyncio.CancelledError)
        await until(lambda: host.gate.holder is None)


async def test_call_without_the_word_of_a_reservation_is_a_call() -> None:
    """Older programs, and those that have none, say nothing of it; nonsense is no call."""
    async with Plant() as plant, plant.cameras(1) as (robot,):
        fields = {"program": robot._program.name, "do": "start", "arguments": {}}
        key = robot._caller._key_of_call("agent", "start")
        guest = plant.agent._programs[robot._program.name]
        for call, reservation in enumerate(("x", [], {}), start=10_000):
            robot._program.bus.put(
                key, encode({**fields, "call": call, "reservation": reservation})
            )
        await asyncio.sleep(0.1)
        assert guest.commands.last_call < 10_000
        await robot.start(timeout=5.0)


@pytest.mark.parametrize("way", WAYS)
async def test_loss_is_an_event_of_the_camera(way: Callable[[Scene], Awaitable[None]]) -> None:
    async with scene_of(way) as scene:
        robot, told = scene.robot, list[ReservationLost]()
        events = robot.events()

        async def hear() -> None:
            async for event in events:
                if isinstance(event, ReservationLost):
                    told.append(event)

        hearing = asyncio.create_task(hear())
        name = in_words(ProgramName.from_token(robot._program.token).name)

        async def block() -> None:
            async with robot.reserve(timeout=5.0):
                await way(scene)
                await scene.come_between()
                await until(lambda: robot.connected)
                await gone(robot.trigger(timeout=5.0))

        assert isinstance(await gone(block()), ReservationLostError)
        async with robot.reserve(timeout=10.0):
            await robot.trigger(timeout=5.0)
        await asyncio.sleep(1.0)
        hearing.cancel()
        assert [(one.camera, one.program) for one in told] == [(robot.name, name)]


async def test_loss_of_another_s_reservation_is_an_event_too() -> None:
    async with Plant() as plant, plant.cameras(2) as (robot, other):
        await other.query_application()
        seen, own = other.events(), robot.events()
        name = in_words(ProgramName.from_token(robot._program.token).name)

        async def block() -> None:
            async with robot.reserve(timeout=5.0):
                plant.agent.shared_cameras[NAME].lose_reservation()
                assert [one.program async for one in only_lost(seen)] == [name]  # at once
                assert [one.program async for one in only_lost(own)] == [name]

        assert isinstance(await gone(block()), ReservationLostError)
        assert other.connected


async def only_lost(events: Any) -> AsyncIterator[ReservationLost]:
    """Give the first loss that is told."""
    async with asyncio.timeout(PATIENCE):
        async for event in events:
            if isinstance(event, ReservationLost):
                yield event
                return
