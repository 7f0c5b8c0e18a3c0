"""Run a node of ROS 2 for each camera of a fleet, on the Zenoh session of the fleet's bus."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from typing import TYPE_CHECKING, Any

from smartcam._finishing import close_all
from smartcam._ros_names import as_name
from smartcam._server import Server
from smartcam.exceptions import SmartCamError
from smartcam.fleet._bus.zenoh import ZenohConnection
from smartcam.fleet._file.ros import RosCamera, RosSection, node_names
from smartcam.fleet._program.camera import FleetCamera
from smartcam.fleet._program.fleet import CameraJoined, Fleet
from smartcam.ros2 import CameraNode, CameraNodeOptions, Node
from smartcam.ros2._inside import SETTINGS, NativeContext, NativeNode, RosContext
from smartcam.settings import CameraSettings

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Mapping

    from smartcam._client._inside import Interpretation
    from smartcam.calibration import HandEyeCalibration
    from smartcam.calibration._inside import CalibrationsByCamera
    from smartcam.fleet._bus.address import FleetAddress
    from smartcam.frames import FrameSource
    from smartcam.models import Calibration

logger: logging.Logger = logging.getLogger("smartcam.ros2")

CONNECT_TIMEOUT = 10.0
"""Seconds for connecting to the fleet."""

FIRST_ANSWER_TIMEOUT = 2.0
"""Seconds to wait for the first answer of a camera's agent before the camera's node is created."""


class _NodeCamera(FleetCamera[Any]):
    """A camera that expects no application, since ROS gets the results of all applications.

    Its calibration applies only to applications whose results are localizations, so it drops
    ``of_camera``, which would require localizations of each.
    """

    def _interpretation(self, spec: object, *, of_camera: bool = False) -> Interpretation:
        return super()._interpretation(spec)

    async def switch_application(
        self, application: int | str, *, timeout: float | None = None
    ) -> None:
        await super().switch_application(application, timeout=timeout)
        self._expected_application = None


class _NodeFleet(Fleet):
    """A fleet whose cameras have their own calibrations, and are nodes of ROS."""

    def __init__(self, *arguments: Any, calibrations: Mapping[str, Calibration]) -> None:
        self._calibrations = calibrations
        super().__init__(*arguments, bus_is_shared=True)

    def _make_camera(self, name: str) -> FleetCamera[Any]:
        calibration = self._calibrations.get(name)
        options = {"name": name, "connect_timeout": CONNECT_TIMEOUT, "calibration": calibration}
        settings = CameraSettings.of(self._address_of(name), options)
        return _NodeCamera(settings, name, self._program, shared=True)


class RosFleet(Server):
    """Runs a node for each camera of a fleet.

    Args:
        bus: opened connection to the fleet's bus; its session carries ROS, too.
        fleet: the fleet's name; None for the only one on the bus.
        address: address of the fleet.
        section: settings of all cameras' nodes.
        cameras: settings of single cameras' nodes, by name.
        settings: the agent's settings of the cameras' sessions, by name; None: unknown.
        frames: sources of the cameras' frames, by name, as parameters of v4l2_camera.
        calibrations: calibrations that convert results of cameras to the robot's frame, by
            name.
        controls: functions that return the open source of a camera's frames, by name, for cameras
            whose device has controls.
        hand_eyes: hand-eye calibrations of the cameras, by name.
        wanted: function of an agent's name and a camera's name that returns whether the camera
            gets a node.
        calibrations_by_camera: calibrations of the agent's cameras, by name; None without a folder.

    Raises:
        ConfigurationError: the domain is not valid, or rclpy is wanted and not installed.
        MissingExtraError: the extra ``ros2`` is not installed.
    """

    def __init__(
        self,
        bus: ZenohConnection,
        fleet: str | None,
        address: FleetAddress,
        section: RosSection,
        *,
        cameras: Mapping[str, RosCamera] | None = None,
        settings: Mapping[str, CameraSettings] | None = None,
        frames: Mapping[str, Mapping[str, Any]] | None = None,
        controls: Mapping[str, Callable[[], Awaitable[FrameSource]]] | None = None,
        calibrations: Mapping[str, Calibration] | None = None,
        hand_eyes: Mapping[str, HandEyeCalibration] | None = None,
        wanted: Callable[[str, str], bool] = lambda _agent, _camera: True,
        calibrations_by_camera: CalibrationsByCamera | None = None,
    ) -> None:
        self._calibrations_by_camera = calibrations_by_camera
        self._section, self._camera_options, self._wanted = section, dict(cameras or {}), wanted
        self._settings, self._frames = settings or {}, frames or {}  # the agent adds entries later
        self._hand_eyes, self._controls = hand_eyes or {}, controls or {}
        self.context: RosContext | NativeContext = _context(bus, section)
        self._fleet = _NodeFleet(
            bus, address, fleet, None, CONNECT_TIMEOUT, {}, calibrations=dict(calibrations or {})
        )
        self.nodes: dict[str, CameraNode] = {}
        self._node_cameras: dict[str, FleetCamera[Any]] = {}
        self._task: asyncio.Task[None] | None = None

    async def start(self) -> None:
        """Connect to the fleet, and start its nodes.

        Raises:
            ConnectFailedError: no agent of the fleet answers.
        """
        if self._task is not None:
            return
        await self._fleet.open()
        events = self._fleet.events(max_queue=100_000)
        for camera in self._fleet.cameras():
            await self._create_node(camera.name)
        self._task = asyncio.get_running_loop().create_task(self._follow(events))

    async def _follow(self, events: Any) -> None:
        """Create a node for each new camera. The node of a lost camera stays, and reports that."""
        async for event in events:
            if isinstance(event, CameraJoined) and self._wanted(event.agent, event.camera):
                await self._create_node(event.camera)

    async def _create_node(self, name: str) -> None:
        """Create a camera's node; if the camera has a new object, this replaces the old node."""
        camera = self._fleet[name]
        if self._node_cameras.get(name) is camera:
            return
        agents = self._fleet.agents(name)
        if not any(self._wanted(agent, name) for agent in agents):
            return
        await self._wait_for_agent(camera)
        old = self.nodes.pop(name, None)
        if old is not None:
            await old.stop()
        try:
            node = self._node(name)
            camera_node = CameraNode(camera, node, options=self._options(name, camera))
            await camera_node.start()
        except SmartCamError as exc:
            logger.warning("%s ! it is not seen in ROS: %s", name, exc)
            return
        self._node_cameras[name], self.nodes[name] = camera, camera_node

    @staticmethod
    async def _wait_for_agent(camera: FleetCamera[Any]) -> None:
        """Wait briefly for the agent's answer, which says whether the camera has frames."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(FIRST_ANSWER_TIMEOUT):
                while not camera.has_agent:  # noqa: ASYNC110 - there is no event for it
                    await asyncio.sleep(0.01)

    def _node(self, name: str) -> Node | NativeNode:
        try:
            full = node_names([*self._node_cameras.keys() - {name}, name])[name]
        except ValueError as exc:
            raise SmartCamError(str(exc)) from exc
        namespace, _, node_name = full.rpartition("/")
        parent = self._section.namespace.rstrip("/")
        if isinstance(self.context, RosContext):
            return Node(node_name, namespace=f"{parent}/{namespace}", context=self.context)
        return NativeNode(node_name, namespace=f"{parent}/{namespace}", context=self.context)

    def _options(self, name: str, camera: FleetCamera[Any]) -> CameraNodeOptions:
        options = self._camera_options.get(name, RosCamera.model_validate({}))
        calibrations = self._calibrations_by_camera
        return CameraNodeOptions(
            frame_id=options.frame_id or as_name(name).replace("/", "_"),
            parent_frame=options.parent_frame or "",
            flange_frame=options.flange_frame or "",
            hand_eye=self._hand_eyes.get(name),
            calibration_pose=options.robot_pose(),
            autostart=self._section.autostart,
            settings=self._settings.get(name),
            is_agent_alive=lambda: camera.has_agent,
            video_parameters=self._frames.get(name, {}),
            get_frame_source=self._controls.get(name),
            calibrations=None if calibrations is None else calibrations.of(name),
        )

    @property
    def names(self) -> list[str]:
        """The full names of the nodes."""
        return sorted(node.node.full_name for node in self.nodes.values())

    async def stop(self) -> None:
        """Close all nodes. Idempotent, bounded."""
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            await asyncio.wait({task})
        nodes, self.nodes = self.nodes, {}
        await close_all(node.stop for node in nodes.values())
        self._node_cameras.clear()
        await self._fleet.close()


def _context(bus: ZenohConnection, section: RosSection) -> RosContext | NativeContext:
    """Return the context of the nodes: the bus' own session, or a context of rclpy."""
    if section.through == "zenoh":
        return RosContext(bus, domain=section.domain, distribution=section.distribution)
    distribution = section.distribution if "distribution" in section.model_fields_set else ""
    return NativeContext(domain=section.domain, distribution=distribution, args=section.args)


@contextlib.asynccontextmanager
async def ros_of(address: FleetAddress, section: RosSection) -> AsyncIterator[RosFleet]:
    """Run nodes of ROS 2 for all cameras of a fleet that is already running.

    Raises:
        ConnectFailedError: no bus, or no agent with a camera, answers in time.
    """
    bus = ZenohConnection(address.link, SETTINGS)
    await bus.open(CONNECT_TIMEOUT)
    try:
        async with RosFleet(bus, address.fleet, address, section) as ros:
            yield ros
    finally:
        await bus.close()
