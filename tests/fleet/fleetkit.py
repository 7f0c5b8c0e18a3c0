"""Helpers of the fleet's tests: a numbered camera, its agent, programs that use it."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Mapping
from typing import Any, Self

from smartcam import Backoff
from smartcam._client._inside import TriggerRequest
from smartcam._zenoh import BusLink
from smartcam.emulator import Application, EmulatedCamera, Run
from smartcam.fleet import FleetCamera, MemoryBus
from smartcam.fleet._inside import Bus, Keys, ZenohConnection
from smartcam.frames import FrameSource
from smartcam.settings import Address, CameraSettings
from tests.fleet.inside import Agent, AgentInterpretation, FrameSupply, MemoryConnection, Program
from tests.processes import free_place

FLEET = "plant"
NAME = "line1/cam1"
LAYOUT = "run: int32, token: int32"
FAST = Backoff(initial=0.01, maximum=0.05, jitter=0.0)

PATIENCE = 60.0
"""Seconds that only a failure takes."""


class NumberedCamera(EmulatedCamera):
    """An emulated camera whose results say which run made them, and whose input asked for it.

    Application 1 takes no input, 2 does; with a ``rate``, 1 runs by itself.

    Args:
        time: seconds of a run, and of a switch.
        rate: runs in a second.
        **options: as an emulated camera has them.

    Attributes:
        inputs: the input of each run, by the run's number; None without.
    """

    def __init__(self, *, time: float = 0.001, rate: float | None = None, **options: Any) -> None:
        self.inputs: dict[int, int | None] = {}
        program: dict[str, Any] = {
            "layout": LAYOUT,
            "generator": self._values,
            "processing_time": time,
            "load_time": time,
        }
        options.setdefault("running", True)
        super().__init__(
            [
                Application(id=1, rate=rate, **program),
                Application(id=2, input="token: int32", **program),
            ],
            builtins=False,
            **options,
        )
        self.inputs.clear()  # an application tries its values when it is made

    @property
    def runs(self) -> int:
        """Triggers that were executed."""
        return len(self.inputs)

    def _values(self, run: Run) -> dict[str, int]:
        token = None if run.input is None else int(run.input["token"])
        number = len(self.inputs) + 1
        self.inputs[number] = token
        return {"run": number, "token": token or 0}


class Plant:
    """A bus with an agent that shares one camera; a context manager.

    Args:
        box: the camera; a numbered one by default.
        bus: a bus that misbehaves, perhaps.
        zenoh: the bus is Zenoh's, on a free port of this computer.
        engine: settings of the agent's end of it.
        history: results, and their bytes, that the agent keeps.
        frames: makes the source of the camera's frames.
        session: options of the agent's session with the camera.
    """

    def __init__(
        self,
        box: NumberedCamera | None = None,
        *,
        bus: MemoryBus | None = None,
        zenoh: bool = False,
        engine: Mapping[str, Any] | None = None,
        history: tuple[int, int] = (10_000, 1 << 24),
        frames: Callable[[], FrameSource] | None = None,
        **session: Any,
    ) -> None:
        self.box = NumberedCamera() if box is None else box
        self.bus = MemoryBus() if bus is None else bus
        self.places = (free_place(),) if zenoh else ()
        self._engine = engine
        self._frames = frames
        self.session = {"reconnect": FAST, "name": NAME, **session}
        self.history = history
        self.agent: Agent
        self.end: Bus
        self._stack = contextlib.AsyncExitStack()

    async def __aenter__(self) -> Self:
        await self._stack.enter_async_context(self.box)
        await self.start_agent()
        self._stack.push_async_callback(self.stop_agent)
        return self

    async def __aexit__(self, *exc: object) -> None:
        await self._stack.aclose()

    async def start_agent(self, name: str = "agent") -> None:
        """Start an agent: the first one, or the next after one that is gone."""
        if self.places:
            self.end = ZenohConnection(BusLink(listen=self.places), self._engine)
        else:
            self.end = self.bus.new_connection()
        settings = CameraSettings.make(self.box.url, None, self.session)
        frames = {} if self._frames is None else {NAME: FrameSupply(self._frames, "scripted")}
        self.agent = Agent(
            name,
            Keys(FLEET),
            self.end,
            {NAME: settings},
            history=self.history,
            frames=frames,
        )
        await self.agent.open(PATIENCE)
        await self.agent.wait_first_attempts()

    def cut_off_agent(self) -> None:
        """Have it gone from the bus without a word."""
        assert isinstance(self.end, MemoryConnection)
        self.end.detach()

    async def stop_agent(self) -> None:
        """End it."""
        await self.agent.close()

    def camera(self, **options: Any) -> FleetCamera[Any]:
        """Return a camera of a program of its own, to be opened; ``end`` of it is its bus'."""
        options.setdefault("interpret_as", LAYOUT)
        options.setdefault("reconnect", FAST)
        end = (
            ZenohConnection(BusLink(connect=self.places))
            if self.places
            else self.bus.new_connection()
        )
        settings = CameraSettings.of(self.address, {"name": NAME, **options})
        return FleetCamera(settings, NAME, Program(end, FLEET, NAME))

    @property
    def address(self) -> Address:
        """The camera's; for programs elsewhere where the bus is Zenoh's."""
        port = int(self.places[0].rpartition(":")[2]) if self.places else 7447
        return Address("fleet", "fleet", "127.0.0.1", port, path=NAME)

    @contextlib.asynccontextmanager
    async def cameras(self, count: int, **options: Any) -> AsyncIterator[list[FleetCamera[Any]]]:
        """Give so many open cameras, each of a program of its own."""
        async with contextlib.AsyncExitStack() as stack:
            yield [await stack.enter_async_context(self.camera(**options)) for _ in range(count)]


def trigger_request() -> TriggerRequest:
    """Return a program's request that nobody has numbered."""
    return TriggerRequest(AgentInterpretation(), None, 1, True)


def end_of(camera: FleetCamera[Any]) -> MemoryConnection:
    """Return the end of the bus of a camera's program."""
    end = camera._program.bus
    assert isinstance(end, MemoryConnection)
    return end


async def until(condition: Any, seconds: float = PATIENCE) -> None:
    """Wait until something is true."""
    async with asyncio.timeout(seconds):
        while not condition():  # noqa: ASYNC110 - whatever the condition is
            await asyncio.sleep(0.001)
