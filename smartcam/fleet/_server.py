"""An agent with its cameras, as a fleet file says: what ``smartcam serve`` runs."""

from __future__ import annotations

import contextlib
import functools
from pathlib import Path
from typing import TYPE_CHECKING, Any

from smartcam._server import Server
from smartcam._zenoh import BusLink, with_ports
from smartcam.camera import DEFAULT_MAX_QUEUE
from smartcam.exceptions import ConfigurationError
from smartcam.fleet._address import DEFAULT_PORT, FleetAddress
from smartcam.fleet._agent import Agent
from smartcam.fleet._file import FleetFile, load_fleet
from smartcam.fleet._frames import FramesOf
from smartcam.fleet._keys import Keys
from smartcam.fleet._ros_file import RosSection
from smartcam.fleet._zenoh import ZenohEnd
from smartcam.frames import FrameAddress
from smartcam.models import CameraEvent
from smartcam.streams import Subscribers, Subscription

if TYPE_CHECKING:
    from typing import Literal

    from smartcam.emulator._wire_camera import WireCamera
    from smartcam.fleet._bus import Bus
    from smartcam.fleet._file import Planned
    from smartcam.fleet._host import Host
    from smartcam.fleet._ros import RosFleet
    from smartcam.settings import CameraSettings

OPEN_TIMEOUT = 10.0
"""Seconds for coming to the bus."""


class FleetServer(Server):
    """An agent that shares the cameras of a fleet file; made by :func:`smartcam.fleet.serve`.

    Args:
        file: the path of a fleet file, or what stands in one.
        bus: an end of another bus than the file says.
        folder: that paths in it are in, where it is not a path itself.

    Raises:
        ConfigurationError: something in it cannot work.
        MissingExtraError: PyYAML, or the bus' engine, is not installed.
    """

    def __init__(
        self, file: str | Path | FleetFile, *, bus: Bus | None = None, folder: Path | None = None
    ) -> None:
        self.file: FleetFile = file if isinstance(file, FleetFile) else load_fleet(file)
        self._folder = folder or (Path() if isinstance(file, FleetFile) else Path(file).parent)
        try:
            self._plan = self.file.plan()
        except ValueError as exc:
            raise ConfigurationError(f"fleet {self.file.fleet}: {exc}") from exc
        listen, connect = self.file.endpoints
        self._listen, self._connect = listen, connect = with_ports(listen), connect
        self._bus = bus or ZenohEnd(BusLink(listen, connect, self.file.certificates), self._more())
        self._ros: RosFleet | None = None
        self._agent: Agent | None = None
        self._events: Subscribers[CameraEvent] = Subscribers()
        self._stack = contextlib.AsyncExitStack()

    async def start(self) -> None:
        """Start the emulated cameras, come to the bus, and begin to have sessions.

        Raises:
            ConnectFailedError: an endpoint cannot be listened on, or reached.
            ConfigurationError: an option of a camera cannot work.

        Cancellation: leaves it stopped.
        """
        if self._agent is not None:
            return
        file = self.file
        async with contextlib.AsyncExitStack() as stack:
            cameras: dict[str, CameraSettings] = {}
            frames: dict[str, FramesOf] = {}
            for planned in self._plan:
                url = planned.entry.url or await self._emulate(planned, stack)
                cameras[planned.name] = planned.entry.settings(planned.name, url)
                entry = planned.entry.frames
                if entry is not None:
                    make = functools.partial(entry.source, self._folder)
                    make()  # what cannot work is told now
                    frames[planned.name] = FramesOf(make, FrameAddress.parse(entry.url).shown)
            history = (file.history.results, file.history.bytes)
            agent = Agent(
                file.agent_name,
                Keys(file.fleet),
                self._bus,
                cameras,
                history=history,
                on_event=self._tell,
                frames=frames,
                standby=file.standby,
            )
            stack.push_async_callback(agent.close)
            await agent.open(OPEN_TIMEOUT)
            if self.file.ros2 is not None and isinstance(self._bus, ZenohEnd):
                self._ros = await stack.enter_async_context(self._seen_in_ros(self._bus))
            self._agent, self._stack = agent, stack.pop_all()

    def _more(self) -> dict[str, Any]:
        """Return further settings of the engine."""
        if self.file.ros2 is None:
            return {}
        from smartcam.ros2._context import SETTINGS

        return dict(SETTINGS)

    def _seen_in_ros(self, bus: ZenohEnd) -> RosFleet:
        from smartcam.fleet._ros import RosFleet

        file, own = self.file, self.file.agent_name
        said = {planned.name: planned.entry.ros2 for planned in self._plan}
        found = {name: one.load_calibration(self._folder) for name, one in said.items()}
        return RosFleet(
            bus,
            file.fleet,
            self.address,
            file.ros2 or RosSection(),
            cameras=said,
            calibrations={name: one for name, one in found.items() if one is not None},
            wanted=lambda agent, _camera: agent == own,
        )

    async def stop(self) -> None:
        """End the sessions with Disconnect, and leave the bus. Harmless when done twice."""
        self._agent = self._ros = None
        await self._stack.aclose()
        for stream in self._events:
            stream.end(None)

    async def _emulate(self, planned: Planned, stack: contextlib.AsyncExitStack) -> str:
        """Start an emulated camera; return its URL."""
        from smartcam.emulator import EmulatedCamera, load_scenario
        from smartcam.emulator._makes import emulated_class

        emulated = planned.entry.emulated
        if emulated is None:
            raise ConfigurationError(f"{planned.name}: neither url nor emulated")
        seed = emulated.seed + planned.nth
        camera: WireCamera
        if emulated.scenario is None:
            camera = EmulatedCamera(seed=seed)
        else:
            scenario = load_scenario(self._folder / emulated.scenario)
            scenario = scenario.model_copy(update={"seed": seed})
            camera = emulated_class(scenario.protocol).from_scenario(scenario, host="127.0.0.1")
        await stack.enter_async_context(camera)
        return camera.url

    async def wait_tried(self) -> None:
        """Wait until every camera was tried once, well or not; bounded by ``connect_timeout``."""
        if self._agent is not None:
            await self._agent.wait_tried()

    def events(
        self,
        *,
        max_queue: int = DEFAULT_MAX_QUEUE,
        overflow: Literal["drop_oldest", "error"] = "drop_oldest",
    ) -> Subscription[CameraEvent]:
        """Subscribe to what happens to its cameras: :meth:`smartcam.Camera.events` of them all."""
        stream = Subscription[CameraEvent]("events", max_queue=max_queue, overflow=overflow)
        self._events.add(stream)
        return stream

    def _tell(self, event: CameraEvent) -> None:
        for stream in self._events:
            stream.offer(event, 0.0)

    @property
    def name(self) -> str:
        """The agent's name."""
        return "" if self._agent is None else self._agent.name

    @property
    def ros_nodes(self) -> list[str]:
        """The full names of its cameras' nodes in ROS 2, if it has any."""
        return [] if self._ros is None else self._ros.names

    @property
    def hosts(self) -> dict[str, Host]:
        """Its cameras by name, empty before it is started."""
        return {} if self._agent is None else self._agent.hosts

    @property
    def address(self) -> FleetAddress:
        """Where programs on this host find it."""
        return address_of((*self._listen, *self._connect)[0], self.file)

    @property
    def urls(self) -> dict[str, str]:
        """The fleet URLs of its cameras, by name."""
        address = self.address
        return {planned.name: address.of(planned.name).url for planned in self._plan}


def address_of(endpoint: str, file: FleetFile) -> FleetAddress:
    """Return the address of a fleet by an endpoint such as ``tcp/127.0.0.1:7447``."""
    kind, _, place = endpoint.partition("/")
    host, _, port = place.partition("?")[0].partition("#")[0].rpartition(":")
    host = host.strip("[]") or place
    if host in {"0.0.0.0", "::"}:  # noqa: S104 - what is listened on everywhere is here, too
        host = "127.0.0.1"
    scheme = "fleet+tls" if kind in {"tls", "quic"} else "fleet"
    number = int(port) if port.isdecimal() else DEFAULT_PORT
    certificates = file.certificates if scheme == "fleet+tls" else None
    # a router that others stand around may have several fleets
    name = None if file.endpoints[0] else file.fleet
    return FleetAddress(scheme, host, number, name, "", certificates)
