"""A camera behind a server of OPC UA, and clients of it, for tests."""

from __future__ import annotations

import asyncio
import contextlib
import secrets
import socket
from collections.abc import AsyncIterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from asyncua import Client, ua

import smartcam
from smartcam._client._inside import Interpretation
from smartcam.backoff import Backoff
from smartcam.emulator import EmulatedCamera
from smartcam.exceptions import ConfigurationError, SmartCamError
from smartcam.models import ApplicationChanged, Connected, Disconnected, Reconnected
from smartcam.outlets import Outlets
from smartcam.outlets._inside import columns_of, do_command
from tests.outlets.outletkit import until

MV = "http://opcfoundation.org/UA/MachineVision"
LAYOUT = "passed: bool, count: int32, x: real32 mm, code: string[8]"


def free_port() -> int:
    """Return a port that nobody listens on, of those that systems give to nobody by themselves.

    One of the others may be a client's of another test before it is listened on.
    """
    while True:
        port = 20_000 + secrets.randbelow(12_000)
        with socket.socket() as free, contextlib.suppress(OSError):
            free.bind(("127.0.0.1", port))
            return port


class Cell(NamedTuple):
    """A camera whose results come out over OPC UA."""

    url: str
    outlets: Outlets
    camera: Any
    emulator: EmulatedCamera
    commands: list[tuple[str, Mapping[str, Any]]]


@contextlib.asynccontextmanager
async def cell(
    folder: Path,
    emulator: Mapping[str, Any] | None = None,
    specs: Mapping[int, str] | None = None,
    names: Mapping[str, int] | None = None,
    **more: Any,
) -> AsyncIterator[Cell]:
    """Have an emulated camera, its client and an outlet, as ``smartcam outlet`` has them."""
    url = f"opc.tcp://127.0.0.1:{free_port()}"
    given = {"listen": url, "anonymous": "control", "unencrypted": True, **more}
    given = {name: one for name, one in given.items() if one is not None}
    made = {"running": True, "active": 7, **(emulator or {})}
    read = dict(specs or {7: "localizations", 1: LAYOUT})
    done: list[tuple[str, Mapping[str, Any]]] = []
    async with EmulatedCamera(**made) as device:
        camera = smartcam.connect(
            device.url, interpret_as=read, name="line1/cam1", reconnect=Backoff()
        )
        results, events = camera.results(max_queue=10_000), camera.events()

        async def command(name: str, verb: str, fields: Mapping[str, Any]) -> dict[str, Any]:
            done.append((verb, fields))
            if name != "line1/cam1":
                raise ConfigurationError(name)
            return await do_command(camera, verb, fields)

        outlets = Outlets(
            {"opcua": given},
            folder,
            columns=lambda _camera, number: columns_of(
                Interpretation(read, lenient=False, y_down=False).interpreter(number)
            ),
            command=command,
            cameras=lambda: {"line1/cam1": True},
            application_names=lambda _camera: dict(names or {}),
        )
        async with outlets:
            tasks = [
                asyncio.create_task(_results(results, outlets)),
                asyncio.create_task(_events(events, outlets)),
            ]
            try:
                async with camera:
                    pump: Any = outlets._pumps["opcua"]
                    await until(lambda: bool(pump.trouble or pump.outlet._open), 300)
                    assert not pump.trouble, pump.trouble
                    yield Cell(url, outlets, camera, device, done)
            finally:
                for task in tasks:
                    task.cancel()
                await asyncio.wait(tasks)


async def _results(results: Any, outlets: Outlets) -> None:
    while True:
        try:
            outlets.offer_result(await anext(results))
        except StopAsyncIteration:
            return
        except SmartCamError as exc:
            at, kind = datetime.now(UTC), type(exc).__name__
            outlets.offer_error("line1/cam1", at, str(exc), kind)
            if results.ended:
                return


async def _events(events: Any, outlets: Outlets) -> None:
    state: dict[str, Any] = {"connected": False, "application": None, "reason": None}
    async for event in events:
        if isinstance(event, (Connected, Reconnected)):
            state |= {"connected": True, "reason": None}
        elif isinstance(event, Disconnected):
            state |= {"connected": False, "reason": event.reason}
        elif isinstance(event, ApplicationChanged):
            state |= {"application": event.application}
        outlets.state_changed(event.camera, dict(state))


class Heard:
    """The events of a subscription."""

    def __init__(self) -> None:
        self.events: list[Any] = []

    def event_notification(self, event: Any) -> None:
        """Keep an event."""
        self.events.append(event)

    def of(self, number: int) -> list[Any]:
        """Return the events of a type of the nodeset."""
        return [one for one in self.events if one.EventType.Identifier == number]


class Plc:
    """A client of asyncua at one camera.

    Args:
        client: client that is connected.
        camera: name of the camera.
    """

    def __init__(self, client: Client, camera: str = "line1/cam1") -> None:
        self.client, self.camera = client, camera
        self.vision = self.own = 0

    async def learn(self) -> None:
        """Learn the namespaces."""
        self.vision = await self.client.get_namespace_index(MV)
        self.own = await self.client.get_namespace_index("urn:smartcam:outlets:opcua")

    def node(self, path: str = "") -> Any:
        """Return a node below the camera's."""
        name = f"{self.camera}.{path}" if path else self.camera
        return self.client.get_node(ua.NodeId(name, self.own))

    async def call(self, path: str, *arguments: Any) -> Any:
        """Call a method by the path of its node."""
        parent, _, name = path.rpartition(".")
        space = self.own if path.startswith("Plain.") else self.vision
        return await self.node(parent).call_method(ua.QualifiedName(name, space), *arguments)

    async def state(self) -> str:
        """Return the state, as simple clients read it."""
        return str(await self.node("Plain.State").read_value())

    async def wait_for(self, state: str, seconds: float = 300.0) -> None:
        """Wait until the camera is in a state."""
        async with asyncio.timeout(seconds):
            while await self.state() != state:  # noqa: ASYNC110
                await asyncio.sleep(0.01)

    async def hear(self, *numbers: int) -> Heard:
        """Subscribe to events of the nodeset's types."""
        heard = Heard()
        subscription = await self.client.create_subscription(20, heard)
        types = [self.client.get_node(ua.NodeId(one, self.vision)) for one in numbers]
        await subscription.subscribe_events(self.node(), types, queuesize=10_000)
        return heard

    async def start_job(self, meas: str = "", part: str = "", recipe: str = "") -> str:
        """Call StartSingleJob with structures, and return the id of the job."""
        job, error = await self.call(
            "VisionStateMachine.AutomaticModeStateMachine.StartSingleJob",
            getattr(ua, "MeasIdDataType")(Id=meas),  # noqa: B009 - made from the nodeset
            getattr(ua, "PartIdDataType")(Id=part),  # noqa: B009
            getattr(ua, "RecipeIdExternalDataType")(Id=recipe),  # noqa: B009
            getattr(ua, "ProductIdDataType")(Id=""),  # noqa: B009
            ua.Variant([], ua.VariantType.Variant, is_array=True),
        )
        assert error == 0
        return str(job.Id)


@contextlib.asynccontextmanager
async def plc(url: str, seconds: float = 300.0) -> AsyncIterator[Plc]:
    """Have a client that is connected."""
    client = Client(url, timeout=60, watchdog_intervall=60)
    async with asyncio.timeout(seconds):
        while True:
            with contextlib.suppress(OSError):
                await client.connect()
                break
            await asyncio.sleep(0.05)
    async with contextlib.AsyncExitStack() as stack:
        stack.push_async_callback(client.disconnect)
        found = Plc(client)
        await found.learn()
        yield found
