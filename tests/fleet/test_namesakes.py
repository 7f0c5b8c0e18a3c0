"""Two agents of one name: one keeps the name and its cameras, the other ends with an error."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator

import pytest

from smartcam import Backoff
from smartcam.exceptions import ConfigurationError
from smartcam.fleet import FleetFile, FleetServer, MemoryBus
from smartcam.fleet._inside import Keys
from smartcam.settings import CameraSettings
from tests.fleet.fleetkit import FLEET, NAME, PATIENCE, NumberedCamera, until
from tests.fleet.inside import Agent, MemoryConnection, Standby

QUICK = Backoff(initial=0.05, maximum=0.2, jitter=0.0)
STANDS_BY = Standby.model_validate({})


class Namesakes:
    """A camera, and two agents of one name that want it; made in the order of their starts."""

    def __init__(self, box: NumberedCamera, standby: Standby | None) -> None:
        self.bus = MemoryBus()
        self.ends: list[MemoryConnection] = [self.bus.new_connection() for _ in range(2)]
        self.told: list[ConfigurationError] = []
        settings = CameraSettings.make(box.url, None, {"reconnect": QUICK, "name": NAME})
        self.agents = [
            Agent(
                "south",
                Keys(FLEET),
                end,
                {NAME: settings},
                standby=standby,
                on_retired=self.told.append,
            )
            for end in self.ends
        ]

    def having(self) -> list[int]:
        """Return which of them have a session with the camera."""
        found = [agent.shared_cameras.get(NAME) for agent in self.agents]
        return [number for number, host in enumerate(found) if host and host.connected]

    def sharing(self) -> list[int]:
        """Return which of them say that they have the camera."""
        return [number for number, agent in enumerate(self.agents) if agent.shared_cameras]


@contextlib.asynccontextmanager
async def namesakes(standby: Standby | None) -> AsyncIterator[Namesakes]:
    async with NumberedCamera(time=0.01) as box:
        made = Namesakes(box, standby)
        try:
            yield made
        finally:
            for agent in made.agents:
                await agent.close()


@pytest.mark.parametrize("standby", [None, STANDS_BY], ids=["alone", "standby"])
@pytest.mark.parametrize("first", [0, 1])
async def test_of_two_that_meet_after_a_split_the_earlier_start_stays(
    first: int, standby: Standby | None
) -> None:
    async with namesakes(standby) as made:
        for number in (first, 1 - first):
            await made.agents[number].open(PATIENCE)
            made.ends[number].detach()
        await until(lambda: made.having())
        for end in made.ends:
            end.attach()
        await until(lambda: made.sharing() == [0])
        await until(lambda: made.having() == [0], 5.0)  # it need not wait for its slow retry
        assert ["started before this one" in str(one) for one in made.told] == [True]
        assert made.agents[0].retired_by is None
        with pytest.raises(ConfigurationError, match="an agent named south"):
            await made.agents[1].add_camera("other", made.agents[0].shared_cameras[NAME].settings)


@pytest.mark.parametrize("standby", [None, STANDS_BY], ids=["alone", "standby"])
async def test_of_two_that_start_together_one_stays(standby: Standby | None) -> None:
    async with namesakes(standby) as made:
        outcomes = await asyncio.gather(
            *(agent.open(PATIENCE) for agent in made.agents), return_exceptions=True
        )
        await until(lambda: made.having() == [0])
        assert made.sharing() == [0]
        assert isinstance(outcomes[1], ConfigurationError) or made.told


async def test_name_is_free_again_once_both_are_gone() -> None:
    async with namesakes(None) as made:
        for number, agent in enumerate(made.agents):
            await agent.open(PATIENCE)
            made.ends[number].detach()
        for end in made.ends:
            end.attach()
        await until(lambda: made.told)
        for agent in made.agents:
            await agent.close()
        bus = MemoryBus.new_connection(made.bus)
        settings = made.agents[0]._cameras
        third = Agent("south", Keys(FLEET), bus, settings)
        await third.open(PATIENCE)
        await until(lambda: third.shared_cameras[NAME].connected)
        await third.close()


async def test_server_whose_name_another_one_has_says_so_to_who_follows_it() -> None:
    async with NumberedCamera() as box:
        bus, file = (
            MemoryBus(),
            FleetFile.model_validate({"agent": "south", "cameras": {NAME: {"url": box.url}}}),
        )
        earlier = Agent("south", Keys("plant"), bus.new_connection(), {})
        end = bus.new_connection()
        async with FleetServer(file, bus=end) as server:
            end.detach()
            await earlier.open(PATIENCE)
            try:
                events = server.events()
                end.attach()
                with pytest.raises(ConfigurationError, match="an agent named south"):
                    async for _ in events:
                        pass
                with pytest.raises(ConfigurationError, match="an agent named south"):
                    await anext(server.events())
                assert server.shared_cameras == {}
            finally:
                await earlier.close()
