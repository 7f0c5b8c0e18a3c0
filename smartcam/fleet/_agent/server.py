"""Run an agent with the cameras of a fleet file, for ``smartcam serve``."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import logging
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

from smartcam._arguments import check_text
from smartcam._extras import from_part
from smartcam._server import Server
from smartcam._zenoh import BusLink, with_ports
from smartcam.camera import DEFAULT_MAX_QUEUE
from smartcam.exceptions import ConfigurationError, ConnectionClosedError, SmartCamError
from smartcam.fleet._agent.agent import Agent
from smartcam.fleet._agent.outlet_service import OutletService
from smartcam.fleet._agent.reload import CameraSource, FleetChanges, Reloader, load_cameras
from smartcam.fleet._agent.reload_service import ReloadService
from smartcam.fleet._bus.address import DEFAULT_PORT, FleetAddress
from smartcam.fleet._bus.keys import Keys
from smartcam.fleet._bus.zenoh import ZenohConnection
from smartcam.fleet._file.bus_access import access_mistakes, effective_access
from smartcam.fleet._file.fleet_file import FleetFile, load_fleet, software_camera
from smartcam.fleet._file.ros import RosSection
from smartcam.fleet._frames.camera_frames import FrameSupply
from smartcam.fleet._security.access import access_control
from smartcam.fleet._security.certificates import AGENT
from smartcam.fleet._security.door import ConnectionFilter
from smartcam.fleet._security.renewal import RETRY_DELAY, CertificateWatch
from smartcam.frames import FrameAddress
from smartcam.models import CameraEvent
from smartcam.observers import Observers
from smartcam.settings import masked
from smartcam.streams import Subscribers, Subscription

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
    from typing import Literal

    from smartcam.calibration._inside import CalibrationsByCamera
    from smartcam.emulator import WireCamera
    from smartcam.fleet._agent.outlet_service import StoredRequest
    from smartcam.fleet._agent.shared_camera import SharedCamera
    from smartcam.fleet._bus.bus import Bus
    from smartcam.fleet._file.bus_access import Access
    from smartcam.fleet._file.fleet_file import FramesEntry, PlannedCamera
    from smartcam.fleet._ros import RosFleet
    from smartcam.frames import FrameSource
    from smartcam.inspection import SoftwareDevice
    from smartcam.observers import Observer
    from smartcam.outlets._inside import OutletState
    from smartcam.settings import CameraSettings

logger: logging.Logger = logging.getLogger("smartcam.fleet")

OPEN_TIMEOUT = 10.0
"""Seconds for connecting to the bus."""


class FleetServer(Server):
    """An agent that shares the cameras of a fleet file; created by :func:`smartcam.fleet.serve`.

    Args:
        file: path of a fleet file, or the contents of one.
        bus: connection to a bus to use instead of the bus in the file.
        folder: folder of the file's relative paths, if ``file`` is not a path itself.
        restore: whether application and run state of a camera are restored after a reconnect, for
            cameras whose entry does not set that. None: True if ``ros2`` in the file has nodes that
            become active by themselves.

    Attributes:
        file: contents of the fleet file.
        folder: folder of the file's relative paths.
        observers: observers of all sessions; add them before the server is started.
        outlet_states: function that returns the states of the outlets, by name.
        stored_results: function that answers a request for stored results, by outlet.
        calibrations: calibrations of the cameras; None if there is no folder for them.

    Raises:
        ConfigurationError: the file is not valid.
        MissingExtraError: PyYAML, or Zenoh, is not installed.
    """

    def __init__(
        self,
        file: str | Path | FleetFile,
        *,
        bus: Bus | None = None,
        folder: Path | None = None,
        restore: bool | None = None,
        _frames: Mapping[str, Callable[[], FrameSource]] | None = None,
    ) -> None:
        self._replayed_frames = _frames or {}
        if not isinstance(file, (Path, FleetFile)):
            file = check_text(file, "fleet file", least=1)
        self._original_file = file
        self.observers: list[Observer] = []
        self.outlet_states: Callable[[], Mapping[str, OutletState]] = dict
        self.stored_results: Callable[[StoredRequest], Awaitable[dict[str, Any]]] = (
            _no_stored_results
        )
        contents = file if isinstance(file, FleetFile) else load_fleet(file)
        self.folder: Path = folder or (Path() if isinstance(file, FleetFile) else Path(file).parent)
        try:
            loaded_file = load_cameras(contents, self.folder)
        except ValueError as exc:
            raise ConfigurationError(f"fleet {contents.fleet}: {exc}") from exc
        self.reloads: Reloader = Reloader(self.folder, loaded_file, self._start_source)
        listen, connect = self.file.endpoints
        for _, mistake in access_mistakes(self.file.access, listen):
            raise ConfigurationError(f"fleet {self.file.fleet}: {mistake}")
        self._listen, self._connect = listen, connect = with_ports(listen), connect
        # with certificates, all connections must go through the router
        peer = self.file.ros2 is not None and self.file.certificates is None
        link = BusLink(listen, connect, self.file.certificates, peer)
        self._bus = bus or ZenohConnection(link, self._zenoh_settings())
        self._ros: RosFleet | None = None
        section = self.file.ros2
        self._restores = (section is not None and section.autostart) if restore is None else restore
        self.calibrations: CalibrationsByCamera | None = None
        # settings of all cameras for ROS; a reload adds those of new cameras
        self._settings: dict[str, CameraSettings] = {}
        self._ros_frames: dict[str, dict[str, Any]] = {}
        self._device_sources: dict[str, Callable[[], Awaitable[FrameSource]]] = {}
        self._agent: Agent | None = None
        self._shared_cameras: dict[str, SharedCamera] = {}
        self._events: Subscribers[CameraEvent] = Subscribers()
        self._stack = contextlib.AsyncExitStack()

    async def start(self) -> None:
        """Start the emulated cameras, connect to the bus, and start the sessions.

        Raises:
            ConnectFailedError: an endpoint cannot be listened on, or reached.
            ConfigurationError: an option of a camera is wrong.

        Cancellation: the server is stopped.
        """
        if self._agent is not None:
            return
        file = self.file
        async with contextlib.AsyncExitStack() as stack:
            sources: dict[str, CameraSource] = {}
            self.reloads = Reloader(self.folder, self.reloads.current, self._start_source)
            self.reloads.sources = sources
            stack.push_async_callback(_end_emulators, sources)
            for name, planned in self.reloads.current.plan.items():
                sources[name] = await self._start_source(planned, self.folder)
            self.calibrations = self._open_calibrations(stack)
            history = (file.history.results, file.history.bytes)
            agent = Agent(
                file.agent_name,
                Keys(file.fleet),
                self._bus,
                {name: source.settings for name, source in sources.items()},
                history=history,
                on_event=self._publish,
                frames={name: source.frames for name, source in sources.items() if source.frames},
                standby=file.standby,
                observers=self.observers,
                on_retired=self._end_event_streams,
                calibrations=self.calibrations,
            )
            self._shared_cameras = agent.shared_cameras  # observers need it from the start
            stack.callback(self._forget_cameras)
            stack.push_async_callback(agent.close)
            await agent.open(OPEN_TIMEOUT)
            self._check_role()
            service = ReloadService(agent, self._bus, Keys(file.fleet), self.reload)
            stack.push_async_callback(self.reloads.close)
            stack.callback(service.close)
            outlets = OutletService(
                agent,
                self._bus,
                Keys(file.fleet),
                lambda: self.outlet_states(),
                lambda request: self.stored_results(request),
            )
            stack.callback(outlets.close)
            stack.push_async_callback(self._leave_ros)
            await self._enter_ros()
            if isinstance(self._bus, ZenohConnection):
                ports = frozenset(int(endpoint.rpartition(":")[2]) for endpoint in self._listen)
                connection_filter = ConnectionFilter(ports, self._bus.connected_addresses)
                connection_filter.open()
                stack.callback(connection_filter.close)
            if self.file.certificates is not None and isinstance(self._bus, ZenohConnection):
                watching = self._watch_certificates(self._bus, agent)
                stack.push_async_callback(_cancel_and_wait, watching)
            self._agent, self._stack = agent, stack.pop_all()

    def _open_calibrations(self, stack: contextlib.AsyncExitStack) -> CalibrationsByCamera | None:
        """Return the calibrations of the cameras, in the folder of the file.

        Raises:
            ConfigurationError: the folder cannot be created.
        """
        if self.file.calibrations is None:
            return None
        with from_part("calibration", '"calibrations:" in a fleet file needs'):
            from smartcam.calibration._inside import CalibrationsByCamera
        folder = self.folder / self.file.calibrations
        try:
            calibrations = CalibrationsByCamera(folder)
        except OSError as exc:
            raise ConfigurationError(
                f"calibrations: {folder}: expected a folder, or a path for one: {exc.strerror}"
            ) from exc
        stack.callback(calibrations.close)
        return calibrations

    def _end_event_streams(self, reason: ConfigurationError) -> None:
        """End the streams of events with the reason why the agent has ended."""
        for stream in self._events:
            stream.end(reason)

    def _forget_cameras(self) -> None:
        self._shared_cameras = {}

    def _zenoh_settings(self) -> dict[str, Any]:
        """Return further settings of Zenoh."""
        settings: dict[str, Any] = {}
        domain: int | None = None
        if self.file.ros2 is not None:
            with from_part("ros2", '"ros2:" in a fleet file needs'):
                from smartcam.ros2._inside import SETTINGS, RosContext

            settings |= SETTINGS
            domain = RosContext(domain=self.file.ros2.domain).domain
        if self._access == "roles":
            settings["access_control"] = access_control(domain)
        return settings

    @property
    def _access(self) -> Access | None:
        return effective_access(self.file.access, self._listen)

    def _check_role(self) -> None:
        """Refuse access by roles if the agent's certificate does not have the role of an agent.

        Raises:
            ConfigurationError: the certificate has another role, or none.
        """
        identity = self._bus.identity
        if self._access == "roles" and identity is not None and identity.role != AGENT:
            raise ConfigurationError(
                f"fleet {self.file.fleet}: access: roles wants a certificate whose common name is "
                f"{AGENT}, as the command `smartcam fleet certificates` makes them; that of "
                f"{identity.folder} has {identity.role!r:.60}. access: any-certificate takes every "
                "certificate of its authority"
            )

    def _watch_certificates(self, bus: ZenohConnection, agent: Agent) -> asyncio.Task[None]:
        """Start to watch the certificates, and use renewed ones."""
        watch = CertificateWatch(
            bus,
            listens=bool(self._listen),
            busy=lambda: agent.busy,
            without_nodes=self._without_ros_nodes,
        )
        return asyncio.get_running_loop().create_task(
            watch.run(), name="smartcam.fleet.certificates"
        )

    async def _enter_ros(self) -> None:
        if self.file.ros2 is not None and isinstance(self._bus, ZenohConnection):
            self._ros = self._ros_fleet(self._bus)
            await self._ros.start()

    async def _leave_ros(self) -> None:
        ros, self._ros = self._ros, None
        if ros is not None:
            await ros.stop()

    @contextlib.asynccontextmanager
    async def _without_ros_nodes(self) -> AsyncIterator[None]:
        """Close the ROS nodes during the block: a new session would lose their latched messages."""
        await self._leave_ros()
        yield
        while True:
            try:
                await self._enter_ros()
            except SmartCamError as exc:
                logger.error("ros2 ! %s; it is tried again", exc)  # noqa: TRY400 - the text says it
                await self._leave_ros()
                await asyncio.sleep(RETRY_DELAY)
            else:
                return

    def _ros_fleet(self, bus: ZenohConnection) -> RosFleet:
        with from_part("ros2", '"ros2:" in a fleet file needs'):
            from smartcam.fleet._ros import RosFleet
        file, own_name = self.file, self.file.agent_name
        cameras = {name: planned.entry.ros2 for name, planned in self.reloads.current.plan.items()}
        calibrations = {name: ros.load_calibration(self.folder) for name, ros in cameras.items()}
        hand_eyes = {name: ros.load_hand_eye(self.folder) for name, ros in cameras.items()}
        return RosFleet(
            bus,
            file.fleet,
            self.address,
            file.ros2 or RosSection.model_validate({}),
            cameras=cameras,
            settings=self._settings,
            frames=self._ros_frames,
            controls=self._device_sources,
            calibrations={
                name: calibration
                for name, calibration in calibrations.items()
                if calibration is not None
            },
            hand_eyes={
                name: hand_eye for name, hand_eye in hand_eyes.items() if hand_eye is not None
            },
            wanted=lambda agent, _camera: agent == own_name,
            calibrations_by_camera=self.calibrations,
        )

    async def stop(self) -> None:
        """End the sessions with Disconnect, and leave the bus. Harmless when called twice."""
        self._agent = None
        await self._stack.aclose()
        for stream in self._events:
            stream.end(None)

    def __del__(self) -> None:
        # the event loop refers to a started server, so it is collected only together with the loop
        if vars(self).get("_agent") is not None:
            text = f"agent {self.file.agent_name} of fleet {self.file.fleet} was not stopped"
            warnings.warn(text, ResourceWarning, source=self, stacklevel=2)

    async def reload(self, file: str | Path | FleetFile | None = None) -> FleetChanges:
        """Read the fleet file again, and apply its changes; unchanged cameras are not touched.

        Unchanged cameras keep their sessions and running calls. A changed camera is closed and
        opened again; a new camera is shared at once, connected or not. Only ``cameras`` can be
        changed; other fields need a restart. Reloads at the same time run one after the other.

        Args:
            file: another file, or the contents of one; None for the server's own.

        Returns:
            The changes.

        Raises:
            ConfigurationError: the file is wrong, or a change needs a restart; the text names the
                field. Nothing was changed.
            ConnectionClosedError: the agent is not started, or it ends.

        Cancellation: nothing is changed, or everything.
        """
        if self._agent is None:
            raise ConnectionClosedError("the agent is not started: there is nothing to reload")
        return await self.reloads.reload(self._agent, self._original_file if file is None else file)

    async def _start_source(self, planned: PlannedCamera, folder: Path) -> CameraSource:
        """Return a camera's settings and frames; first start the camera if it is emulated.

        Raises:
            SmartCamError: the source cannot be created.
        """
        async with contextlib.AsyncExitStack() as stack:
            entry = planned.entry
            replay = self._replayed_frames.get(planned.name)
            frames = None if replay is None else FrameSupply(replay, "replayed")
            if entry.software is not None:
                device, frames = await self._start_software_camera(planned, folder, stack)
                url = device.url
                names = {program.name: number for number, program in device.camera.programs.items()}
                defaults = {"interpret_as": device.interpret_as, "application_names": names}
                update = {
                    name: default for name, default in defaults.items() if not getattr(entry, name)
                }
                entry = entry.model_copy(update=update)
            else:
                url = entry.url or await self._emulate(planned, stack)
            settings = entry.settings(planned.name, url, restore=self._restores)
            if entry.frames is not None:
                make = functools.partial(entry.frames.make_source, folder)
                make()  # raises for wrong options now
                address = FrameAddress.parse(entry.frames.url)
                frames = FrameSupply(make, address.shown)
                if address.scheme in ("v4l2", "gige"):
                    self._device_sources[planned.name] = functools.partial(
                        self._open_frame_source, planned.name
                    )
            self._settings[planned.name] = settings
            self._ros_frames[planned.name] = _ros_frames(entry.frames, folder)
            return CameraSource(settings, frames, stack.pop_all())

    async def _open_frame_source(self, name: str) -> FrameSource:
        """Return the open source of a camera's frames.

        Raises:
            ConfigurationError: the agent does not have the camera.
            SmartCamError: the source cannot be opened.
        """
        camera = self._shared_cameras.get(name)
        if camera is None:
            raise ConfigurationError(f"{name}: the agent does not have it")
        return await camera.frames.source()

    async def _start_software_camera(
        self, planned: PlannedCamera, folder: Path, stack: contextlib.AsyncExitStack
    ) -> tuple[SoftwareDevice, FrameSupply]:
        """Start a software camera; return it, and the supply of its inspected frames."""
        entry = planned.entry.software or {}
        camera = await asyncio.to_thread(software_camera, planned.name, entry, folder)
        with from_part("inspection", '"software:" in a fleet file needs'):
            from smartcam.inspection import SoftwareDevice
            from smartcam.inspection._inside import PictureFinder, judged_source
        device = SoftwareDevice(camera)
        await stack.enter_async_context(device)
        drawn = bool(entry.get("drawn", True))
        make = functools.partial(judged_source, device.inspector, drawn=drawn)
        observers = Observers(self.observers)
        reporter = PictureFinder(
            device.last_sent,
            lambda: self._shared_cameras[planned.name].client.statistics().received,
            lambda result, judged: observers.picture(result, judged.frame_with_drawings),
            max_kept=0,
        )
        device.inspector.viewers.add(reporter.record_picture)
        return device, FrameSupply(make, masked(camera.frames), reporter)

    async def _emulate(self, planned: PlannedCamera, stack: contextlib.AsyncExitStack) -> str:
        """Start an emulated camera; return its URL."""
        from smartcam.emulator import EmulatedCamera, load_scenario
        from smartcam.emulator._inside import emulated_class

        emulated = planned.entry.emulated
        if emulated is None:
            raise ConfigurationError(f"{planned.name}: neither url nor emulated")
        seed = emulated.seed + planned.index_in_entry
        camera: WireCamera
        if emulated.scenario is None:
            camera = EmulatedCamera(seed=seed)
        else:
            scenario = load_scenario(self.folder / emulated.scenario)
            scenario = scenario.model_copy(update={"seed": seed})
            camera = emulated_class(scenario.protocol).from_scenario(scenario, host="127.0.0.1")
        await stack.enter_async_context(camera)
        return camera.url

    async def wait_first_attempts(self) -> None:
        """Wait for the end of each camera's first attempt; bounded by ``connect_timeout``."""
        if self._agent is not None:
            await self._agent.wait_first_attempts()

    def events(
        self,
        *,
        max_queue: int = DEFAULT_MAX_QUEUE,
        overflow: Literal["drop_oldest", "error"] = "drop_oldest",
    ) -> Subscription[CameraEvent]:
        """Subscribe to the events of all cameras, like :meth:`smartcam.Camera.events` of each.

        The stream ends with a :exc:`~smartcam.exceptions.ConfigurationError` if another agent of
        the same name was started earlier: then this agent gives up its cameras.
        """
        stream = Subscription[CameraEvent]("events", max_queue=max_queue, overflow=overflow)
        self._events.add(stream)
        if self._agent is not None and self._agent.retired_by is not None:
            stream.end(self._agent.retired_by)
        return stream

    def _publish(self, event: CameraEvent) -> None:
        for stream in self._events:
            stream.offer(event, 0.0)

    @property
    def file(self) -> FleetFile:
        """The fleet file, as it was read last."""
        return self.reloads.current.file

    @property
    def agent(self) -> Agent | None:
        """The agent, None before the start."""
        return self._agent

    @property
    def is_connected(self) -> bool:
        """True if the agent is started, and connected to its router."""
        return self._agent is not None and self._bus.is_connected

    @property
    def bus_bytes(self) -> int:
        """Number of bytes that wait to be sent on the bus."""
        return self._bus.waiting_bytes

    @property
    def busy(self) -> bool:
        """True while a command of a program runs."""
        return self._agent is not None and self._agent.busy

    @property
    def warning(self) -> str:
        """Warning that the agent's certificate ends soon, with the cure; empty for none."""
        return "" if self._bus.identity is None else self._bus.identity.warning

    @property
    def name(self) -> str:
        """The agent's name."""
        return "" if self._agent is None else self._agent.name

    @property
    def ros_nodes(self) -> list[str]:
        """The full names of the cameras' nodes in ROS 2."""
        return [] if self._ros is None else self._ros.names

    @property
    def shared_cameras(self) -> dict[str, SharedCamera]:
        """The agent's cameras by name, empty before the start."""
        return self._shared_cameras

    @property
    def address(self) -> FleetAddress:
        """Address of the agent for programs on this host."""
        return address_of((*self._listen, *self._connect)[0], self.file)

    @property
    def urls(self) -> dict[str, str]:
        """The fleet URLs of the cameras, by name."""
        address = self.address
        return {name: address.of(name).url for name in self.reloads.current.plan}


def _ros_frames(entry: FramesEntry | None, folder: Path) -> dict[str, Any]:
    """Return the address and lens of a frame source as parameters of v4l2_camera."""
    if entry is None:
        return {}
    parameters: dict[str, Any] = {"video_device": masked(entry.url)}
    if url := entry.camera_info_url(folder):
        parameters["camera_info_url"] = url
    return parameters


async def _no_stored_results(_request: StoredRequest) -> dict[str, Any]:
    return {}


async def _end_emulators(sources: dict[str, CameraSource]) -> None:
    for source in sources.values():
        await source.emulator.aclose()


async def _cancel_and_wait(task: asyncio.Task[None]) -> None:
    task.cancel()
    await asyncio.wait({task})


def address_of(endpoint: str, file: FleetFile) -> FleetAddress:
    """Return the address of a fleet from an endpoint such as ``tcp/127.0.0.1:7447``."""
    kind, _, rest = endpoint.partition("/")
    host, _, port = rest.partition("?")[0].partition("#")[0].rpartition(":")
    host = host.strip("[]") or rest
    if host in {"0.0.0.0", "::"}:  # noqa: S104 - listening on all addresses includes this host
        host = "127.0.0.1"
    scheme = "fleet+tls" if kind in {"tls", "quic"} else "fleet"
    number = int(port) if port.isdecimal() else DEFAULT_PORT
    # with roles, each program needs an own certificate: that of the agent may not command
    is_usable = scheme == "fleet+tls" and file.access == "any-certificate"
    certificates = file.certificates if is_usable else None
    # a router of several agents may have several fleets
    name = None if file.endpoints[0] else file.fleet
    return FleetAddress(scheme, host, number, name, "", certificates)
