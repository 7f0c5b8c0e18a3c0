"""Agents that stand by: who has a camera, takeovers, and their effect on programs."""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter
from collections.abc import AsyncIterator
from typing import Any, Self

import pytest

import smartcam
from smartcam import Backoff
from smartcam.emulator import faults
from smartcam.exceptions import (
    ConfigurationError,
    ConnectionTakenError,
    LinkError,
    SmartCamError,
    TriggerTimeoutError,
)
from smartcam.fleet import Fleet, FleetCamera, FleetFile, MemoryBus
from smartcam.fleet._inside import Keys
from smartcam.models import Connected, Disconnected, Reconnected
from smartcam.settings import Address, CameraSettings
from tests.fleet.fleetkit import FLEET, LAYOUT, NAME, PATIENCE, NumberedCamera, until
from tests.fleet.inside import Agent, MemoryConnection, Program, Standby

ASK_TIMEOUT = 0.5
HOLD_OFF = 0.2
RETURN_WAIT = 4.0


QUICK = Backoff(initial=0.1, maximum=0.2, jitter=0.0)
STANDS_BY = Standby.model_validate({})
SOON = 1.0
"""Seconds within which a camera is taken over, once the presence of who had it has ended."""


ENDS = (LinkError, TriggerTimeoutError)
"""Errors that a call ends with when its agent goes."""


class Pair:
    """A camera, and agents on one bus that may have it; a context manager."""

    def __init__(self) -> None:
        self.box = NumberedCamera(time=0.01)
        self.bus = MemoryBus()
        self.agents: dict[str, Agent] = {}
        self.ends: dict[str, MemoryConnection] = {}
        self._stack = contextlib.AsyncExitStack()

    async def __aenter__(self) -> Self:
        await self._stack.enter_async_context(self.box)
        self._stack.push_async_callback(self.close)
        return self

    async def __aexit__(self, *exc: object) -> None:
        await self._stack.aclose()

    async def close(self) -> None:
        for agent in self.agents.values():
            await agent.close()

    async def start(self, name: str, standby: Standby | None = STANDS_BY) -> Agent:
        """Start an agent."""
        end = self.ends[name] = self.bus.new_connection()
        settings = CameraSettings.make(self.box.url, None, {"reconnect": QUICK, "name": NAME})
        agent = Agent(name, Keys(FLEET), end, {NAME: settings}, standby=standby)
        await agent.open(PATIENCE)
        self.agents[name] = agent
        await agent.wait_first_attempts()
        return agent

    def having(self) -> list[str]:
        """Return who has a session with the camera."""
        found = [(name, one.shared_cameras.get(NAME)) for name, one in self.agents.items()]
        return [name for name, host in found if host is not None and host.connected]

    def sharing(self) -> list[str]:
        """Return who says that it has the camera."""
        return [name for name, one in self.agents.items() if NAME in one.shared_cameras]

    def program(self) -> FleetCamera[Any]:
        """Return the camera of a program, to be opened."""
        options = {"name": NAME, "interpret_as": LAYOUT, "reconnect": QUICK}
        address = Address("fleet", "fleet", "127.0.0.1", 7447, path=NAME)
        settings = CameraSettings.of(address, options)
        return FleetCamera(settings, NAME, Program(self.bus.new_connection(), FLEET, NAME))


class Work:
    """A program that triggers again and again, and takes all results.

    Attributes:
        outcomes: what became of each trigger, by its token: the token of its result, or an error.
        streamed: the run of each result that came.
    """

    def __init__(self, camera: FleetCamera[Any]) -> None:
        self.camera = camera
        self.outcomes: dict[int, int | SmartCamError] = {}
        self.streamed: list[int] = []
        self.stream = camera.results()
        self.events = camera.events()
        self._over = False

    async def trigger(self) -> None:
        token = 0
        while not self._over:
            token += 1
            try:
                result = await self.camera.trigger(
                    2, input=token.to_bytes(4, "little"), timeout=2.0
                )
                self.outcomes[token] = result.value.token
            except SmartCamError as error:
                self.outcomes[token] = error
                await asyncio.sleep(0.02)

    async def take(self) -> None:
        async for result in self.stream:
            self.streamed.append(result.value.run)

    @contextlib.asynccontextmanager
    async def going_on(self) -> AsyncIterator[None]:
        taking = asyncio.create_task(self.take())
        working = asyncio.create_task(self.trigger())
        try:
            await self.some()
            yield
            await self.some()
        finally:
            self._over = True
            await working
            await asyncio.sleep(2.0)  # reminders
            taking.cancel()
            await asyncio.gather(taking, return_exceptions=True)

    @property
    def done(self) -> int:
        return sum(isinstance(one, int) for one in self.outcomes.values())

    async def some(self) -> None:
        """Wait until some more triggers went well."""
        wanted = self.done + 5
        await until(lambda: self.done >= wanted)

    def check(self, box: NumberedCamera, *, ends: tuple[type[SmartCamError], ...] = ENDS) -> None:
        """No result twice, none under another's trigger, each in the account.

        Args:
            box: the camera.
            ends: what a trigger that did not go well may have ended with.
        """
        for token, outcome in self.outcomes.items():
            if isinstance(outcome, int):
                assert outcome == token
            else:
                assert isinstance(outcome, ends), outcome
        times = Counter(box.inputs.values())
        assert max(times.values()) == 1, times  # no trigger was sent again
        assert self.streamed == sorted(set(self.streamed))
        account = self.stream.statistics()
        assert account.offered == account.taken == len(self.streamed)
        assert (account.dropped, account.queued) == (0, 0)
        # what no session heard is in no account; what an agent had numbered is
        well = {run for run, token in box.inputs.items() if self.outcomes.get(token or 0) == token}
        assert len(well - {*self.streamed}) <= account.missed

    async def told(self) -> list[str]:
        """Return what was told of sessions."""
        kinds: list[str] = []
        while self.events.statistics().queued:
            event = await anext(self.events)
            if isinstance(event, (Connected, Disconnected, Reconnected)):
                kinds.append(type(event).__name__)
        return kinds


@pytest.mark.parametrize("how", ["start", "reload"])
async def test_agent_takes_no_camera_that_another_has_under_another_name(how: str) -> None:
    async with Pair() as pair:
        north = await pair.start("north")
        settings = CameraSettings.make(pair.box.url, None, {"name": "thief", "reconnect": QUICK})
        first = {} if how == "reload" else {"thief": settings}
        south = Agent("south", Keys(FLEET), pair.bus.new_connection(), first, standby=STANDS_BY)
        try:
            if how == "reload":
                await south.open(PATIENCE)
            with pytest.raises(ConfigurationError, match=f"is the camera {NAME} of the agent"):
                await (south.open(PATIENCE) if first else south.add_camera("thief", settings))
            assert not south.shared_cameras
            assert pair.having() == ["north"]
            if how == "reload":
                await north.close()
                await south.add_camera("thief", settings)  # it is free now
                assert [*south.shared_cameras] == ["thief"]
        finally:
            await south.close()


async def test_camera_is_not_taken_over_while_another_name_has_it() -> None:
    async with Pair() as pair:
        north = await pair.start("north")
        await pair.start("south")
        settings = CameraSettings.make(pair.box.url, None, {"name": "thief", "reconnect": QUICK})
        third = Agent("third", Keys(FLEET), pair.bus.new_connection(), {})
        await third.open(PATIENCE)
        try:
            await north.close()
            third.share("thief", settings)  # as a Setup that was faster
            await third.wait_first_attempts()
            await asyncio.sleep(SOON)
            assert third.shared_cameras["thief"].connected
            assert pair.sharing() == ["north"]  # which is closed
            await third.remove_camera("thief", "a test")
            await until(lambda: "south" in pair.having())
        finally:
            await third.close()


@contextlib.asynccontextmanager
async def pair_at_work() -> AsyncIterator[tuple[Pair, Work]]:
    """Give a pair of which north has the camera and south stands by, and a program at work."""
    async with Pair() as pair:
        await pair.start("north")
        await pair.start("south")
        async with pair.program() as camera:
            work = Work(camera)
            async with work.going_on():
                assert (pair.having(), pair.sharing()) == (["north"], ["north"])
                yield pair, work
            work.check(pair.box)


# ---------------------------------------------------------------------- taking over


async def test_who_stands_by_has_no_session_and_takes_over_at_a_clean_stop() -> None:
    async with pair_at_work() as (pair, work):
        north = pair.agents.pop("north")
        await north.close()
        await until(lambda: pair.having() == ["south"], SOON)
        await work.some()
        assert (await work.told())[-2:] == ["Disconnected", "Reconnected"]


async def test_who_stands_by_takes_over_from_one_that_is_cut_off() -> None:
    async with pair_at_work() as (pair, work):
        pair.ends["north"].detach()
        await until(lambda: pair.having() == ["south"], SOON)
        await work.some()


async def test_the_one_that_has_it_keeps_it() -> None:
    async with pair_at_work() as (pair, work):
        await pair.agents.pop("north").close()
        await until(lambda: pair.having() == ["south"], SOON)
        await pair.start("north")
        await work.some()
        assert (pair.having(), pair.sharing()) == (["south"], ["south"])
        await pair.agents.pop("south").close()  # and back again
        await until(lambda: pair.having() == ["north"], SOON)
        await work.some()


async def test_agent_that_has_it_again_goes_on_with_its_numbers() -> None:
    async with pair_at_work() as (pair, work):
        for one, other in (("north", "south"), ("south", "north"), ("north", "south")):
            pair.ends[one].detach()
            await until(lambda other=other: pair.having() == [other], PATIENCE)
            pair.ends[one].attach()
            await until(lambda other=other: pair.sharing() == [other], PATIENCE)
            await work.some()


async def test_program_that_comes_later_misses_nothing_of_before() -> None:
    async with Pair() as pair:
        await pair.start("north")
        await pair.start("south")
        async with pair.program() as camera:
            for _ in range(3):
                await camera.trigger(timeout=PATIENCE)
        pair.ends["north"].detach()
        await until(lambda: pair.having() == ["south"])
        pair.ends["north"].attach()
        await until(lambda: pair.sharing() == ["south"])
        async with pair.program() as camera, camera.results() as results:
            first = await camera.trigger(timeout=PATIENCE)
            await pair.agents.pop("south").close()
            await until(lambda: pair.having() == ["north"] and camera.connected)
            second = await camera.trigger(timeout=PATIENCE)
            assert [await anext(results), await anext(results)] == [first, second]
            assert second.number == 4  # of north's
            account = results.statistics()
            assert (account.taken, account.missed) == (2, 0)


async def test_of_several_the_preferred_one_takes_over() -> None:
    async with Pair() as pair:
        await pair.start("north")
        await pair.start("late", Standby(rank=2))
        await pair.start("soon", Standby(rank=1))
        await pair.agents.pop("north").close()
        await until(lambda: pair.having() == ["soon"], SOON)
        await asyncio.sleep(4 * HOLD_OFF)
        assert pair.sharing() == ["soon"]


async def test_of_two_at_the_same_time_one_keeps_it() -> None:
    async with Pair() as pair:
        await pair.start("north")
        await pair.start("east")
        await pair.start("west")
        await pair.agents.pop("north").close()
        await until(lambda: len(pair.having()) == len(pair.sharing()) == 1)
        (first,) = pair.having()
        await asyncio.sleep(20.0)
        assert (pair.having(), pair.sharing()) == ([first], [first])


# ---------------------------------------------------------------------- splits


async def split(pair: Pair) -> str:
    """Cut north off, which has the camera; return who has it once they have settled that."""
    pair.ends["north"].detach()
    await until(lambda: "south" in pair.sharing(), SOON)
    await asyncio.sleep(15.0)
    (winner,) = pair.having()
    return winner


@pytest.mark.long
async def test_split_is_settled_by_the_camera_and_nobody_flaps() -> None:
    async with pair_at_work() as (pair, _):
        winner = await split(pair)
        sessions = [one.client.statistics().sessions for one in hosts(pair)]
        await asyncio.sleep(15.0)
        assert pair.having() == [winner]
        assert [one.client.statistics().sessions for one in hosts(pair)] == sessions
        pair.ends["north"].attach()
        await until(lambda: len(pair.sharing()) == 1, PATIENCE)
        assert pair.having() == pair.sharing() == [winner]
        loser = pair.agents["north" if winner == "south" else "south"]
        assert winner in str(loser._claims.given_up[NAME])


@pytest.mark.long
async def test_program_follows_to_who_won_a_split() -> None:
    async with pair_at_work() as (pair, work):
        await split(pair)
        pair.ends["north"].attach()
        await until(lambda: len(pair.sharing()) == 1, PATIENCE)
        await work.some()
        assert work.camera.connected
        assert not work.camera.ended


async def test_session_that_begins_while_another_agent_is_asked_is_seen(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with Pair() as pair:
        await pair.start("north")
        await pair.start("south")
        await pair.agents["north"].unshare(NAME, "it is told to")
        await until(lambda: pair.having() == ["south"])
        async with pair.program() as camera:
            pair.box.inject(faults.Delay(on="ConnectAnswer", seconds=1.0))
            say_hello = camera._caller._greet_agent

            async def slowly(agent: str) -> Any:
                heard = await say_hello(agent)
                await asyncio.sleep(2.0)  # another one is asked, and says nothing
                return heard

            monkeypatch.setattr(camera._caller, "_greet_agent", slowly)
            await pair.agents["south"].remove_camera(NAME, "it is told to")
            await until(lambda: pair.having() == ["north"])
            await camera.wait_connected(timeout=PATIENCE)
            assert (await camera.trigger(2)).value.run == 1


async def test_without_standby_the_one_that_lost_it_shares_it_no_more() -> None:
    async with Pair() as pair:
        await pair.start("north", None)
        pair.ends["north"].detach()
        await pair.start("south", None)
        await until(lambda: len(pair.having()) == 1)
        await asyncio.sleep(15.0)
        (winner,) = pair.having()
        pair.ends["north"].attach()
        await until(lambda: pair.sharing() == [winner], PATIENCE)
        await pair.agents.pop(winner).close()
        await asyncio.sleep(10.0)
        assert pair.sharing() == []


async def test_bus_that_was_away_is_no_reason_to_take_over() -> None:
    async with Pair() as pair:
        await pair.start("north")
        await pair.start("south")
        for end in pair.ends.values():  # as with a router that ends
            end.detach()
        await asyncio.sleep(10 * ASK_TIMEOUT)
        assert pair.having() == ["north"]
        pair.ends["south"].attach()
        await asyncio.sleep(ASK_TIMEOUT)
        pair.ends["north"].attach()
        await asyncio.sleep(10.0)
        assert (pair.having(), pair.sharing()) == (["north"], ["north"])
        assert pair.agents["north"].shared_cameras[NAME].client.statistics().sessions == 1


async def test_who_is_back_with_the_bus_and_then_ends_is_replaced_at_once() -> None:
    async with Pair() as pair:
        await pair.start("north")
        await pair.start("south")
        for end in pair.ends.values():
            end.detach()
        await asyncio.sleep(2 * ASK_TIMEOUT)
        for end in pair.ends.values():
            end.attach()
        await asyncio.sleep(ASK_TIMEOUT)  # south waits for those who are not back yet
        await pair.agents.pop("north").close()
        await until(lambda: pair.having() == ["south"], SOON)


async def test_who_is_not_back_with_the_bus_is_replaced_after_a_while() -> None:
    async with Pair() as pair:
        await pair.start("north")
        await pair.start("south")
        for end in pair.ends.values():
            end.detach()
        await pair.agents.pop("north").close()
        await asyncio.sleep(2 * ASK_TIMEOUT)
        pair.ends["south"].attach()
        await asyncio.sleep(RETURN_WAIT - ASK_TIMEOUT)
        assert pair.sharing() == []
        await until(lambda: pair.having() == ["south"], 2 * ASK_TIMEOUT + SOON)


@pytest.mark.long
async def test_camera_whose_winner_ends_during_a_split_is_taken_again() -> None:
    async with pair_at_work() as (pair, work):
        winner = await split(pair)
        await pair.agents.pop(winner).close()
        pair.ends["north"].attach()
        (loser,) = pair.agents
        await until(lambda: pair.having() == [loser], RETURN_WAIT + 2 * ASK_TIMEOUT + SOON)
        await work.some()


@pytest.mark.parametrize("contested", [True, False])
async def test_camera_that_was_taken_is_taken_back_from_an_agent_only(contested: bool) -> None:
    """From one that had it, and has let go of it, too: else nobody would have it. And once."""
    async with Pair() as pair:
        await pair.start("north")
        other = pair.bus.new_connection()
        await other.open(1.0)
        for _ in range(1 + contested):
            await until(lambda: pair.having() == ["north"])
            if contested:
                other.announce(Keys(FLEET).camera("south", NAME)).close()
            await taken_twice(pair)
        (host,) = hosts(pair)
        await asyncio.sleep(15.0)
        assert isinstance(host.client.trouble, ConnectionTakenError)
        assert (hosts(pair), pair.having()) == ([host], [])


async def taken_twice(pair: Pair) -> None:
    """Have a client that is no agent take the camera, and take it again."""
    for _ in range(2):
        await until(lambda: pair.having() == ["north"])
        async with smartcam.connect(pair.box.url):
            await until(lambda: pair.having() == [])


def hosts(pair: Pair) -> list[Any]:
    return [one.shared_cameras[NAME] for one in pair.agents.values() if NAME in one.shared_cameras]


# ---------------------------------------------------------------------- who refuses


async def test_agent_that_does_not_stand_by_gives_way_to_one_that_does() -> None:
    async with Pair() as pair:
        await pair.start("north")
        await pair.start("south", None)
        assert pair.sharing() == ["north"]


async def test_presence_of_the_dead_is_waited_for() -> None:
    async with Pair() as pair:
        end = pair.bus.new_connection()
        await end.open(1.0)
        token = end.announce(Keys(FLEET).camera("ghost", NAME))
        asyncio.get_running_loop().call_later(3.0, token.close)
        await pair.start("north", None)
        assert pair.having() == ["north"]


async def test_agent_that_says_nothing_is_named() -> None:
    async with Pair() as pair:
        end = pair.bus.new_connection()
        await end.open(1.0)
        end.announce(Keys(FLEET).camera("ghost", NAME))
        with pytest.raises(ConfigurationError, match="agent ghost of fleet plant, which does not"):
            await pair.start("north", None)


async def test_name_of_an_agent_that_goes_is_free() -> None:
    async with Pair() as pair:
        end = pair.bus.new_connection()
        await end.open(1.0)
        token = end.announce(Keys(FLEET).agent("north"))
        asyncio.get_running_loop().call_later(0.7, token.close)
        await pair.start("north", None)
        assert pair.having() == ["north"]


@pytest.mark.long
async def test_two_agents_of_one_name_are_one_too_many() -> None:
    async with Pair() as pair:
        await pair.start("north")
        with pytest.raises(ConfigurationError, match="an agent named north is in fleet plant"):
            await pair.start("north")
        assert pair.having() == ["north"]


@pytest.mark.parametrize(
    ("said", "found"),
    [(True, STANDS_BY), (False, None), ({"rank": 2}, Standby(rank=2)), ({}, STANDS_BY)],
)
def test_standby_in_a_file(said: object, found: Standby | None) -> None:
    cameras = {"a": {"url": "bvs://192.0.2.1"}}
    file = FleetFile.model_validate({"standby": said, "cameras": cameras})
    assert file.standby == found


async def test_fleet_sees_one_camera_throughout() -> None:
    async with Pair() as pair:
        await pair.start("north")
        await pair.start("south")
        async with Fleet(pair.bus.new_connection(), None, FLEET, None, 2.0, {}) as fleet:
            camera = fleet[NAME]
            assert (await fleet.status())[NAME].agent == "north"
            await pair.agents.pop("north").close()
            await until(lambda: fleet.agents(NAME) == ["south"] and camera.connected, SOON)
            assert fleet[NAME] is camera
            assert (await fleet.status())[NAME].agent == "south"
