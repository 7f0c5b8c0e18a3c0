"""The cameras of a fleet as nodes of ROS 2, on the fleet's own session of Zenoh."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from typing import TYPE_CHECKING, Any

from smartcam._server import Server
from smartcam.exceptions import SmartCamError
from smartcam.fleet._fleet import CameraJoined, Fleet
from smartcam.fleet._ros_file import RosCamera, RosSection, node_names
from smartcam.fleet._zenoh import ZenohEnd
from smartcam.ros2._camera_node import CameraNode, CameraNodeOptions
from smartcam.ros2._context import SETTINGS, RosContext
from smartcam.ros2._names import as_name
from smartcam.ros2._node import Node
from smartcam.settings import CameraSettings

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Mapping

    from smartcam.fleet._address import FleetAddress
    from smartcam.fleet._camera import FleetCamera
    from smartcam.models import Calibration

logger: logging.Logger = logging.getLogger("smartcam.ros2")

TIMEOUT = 10.0
"""Seconds for coming to the fleet."""


MEET = 2.0
"""Seconds that a camera's agent is waited for before its node comes."""


class _Cameras(Fleet):
    """A fleet whose cameras have calibrations of their own."""

    def __init__(self, *given: Any, calibrations: Mapping[str, Calibration]) -> None:
        self._calibrations = calibrations
        super().__init__(*given, guest=True)

    def _make(self, name: str) -> FleetCamera[Any]:
        camera = super()._make(name)
        calibration = self._calibrations.get(name)
        if calibration is None:
            return camera
        options = {"name": name, "connect_timeout": TIMEOUT, "calibration": calibration}
        settings = CameraSettings.of(self._address_of(name), options)
        return type(camera)(settings, name, self._program, shared=True)


class RosFleet(Server):
    """A node for each camera of a fleet, as they come and go.

    Args:
        bus: an end of the fleet's bus, open; its session carries ROS, too.
        fleet: the fleet's name; None for the only one that is there.
        address: where it is.
        section: how the cameras are seen.
        cameras: what is said of single cameras, by name.
        settings: what the agent tells their sessions, by name, where that is known.
        frames: where their frames come from, by name, as parameters of v4l2_camera.
        calibrations: of cameras whose results are to be the robot's.
        wanted: whether a camera, of an agent, is to be seen.

    Raises:
        ConfigurationError: there is no such domain.
        MissingExtraError: the extra ``ros2`` is not installed.
    """

    def __init__(
        self,
        bus: ZenohEnd,
        fleet: str | None,
        address: FleetAddress,
        section: RosSection,
        *,
        cameras: Mapping[str, RosCamera] | None = None,
        settings: Mapping[str, CameraSettings] | None = None,
        frames: Mapping[str, Mapping[str, Any]] | None = None,
        calibrations: Mapping[str, Calibration] | None = None,
        wanted: Callable[[str, str], bool] = lambda _agent, _camera: True,
    ) -> None:
        self._section, self._said, self._wanted = section, dict(cameras or {}), wanted
        self._settings, self._frames = dict(settings or {}), dict(frames or {})
        self.context: RosContext = RosContext(
            bus, domain=section.domain, distribution=section.distribution
        )
        self._fleet = _Cameras(
            bus, address, fleet, None, TIMEOUT, {}, calibrations=dict(calibrations or {})
        )
        self.nodes: dict[str, CameraNode] = {}
        self._of: dict[str, FleetCamera[Any]] = {}
        self._task: asyncio.Task[None] | None = None

    async def start(self) -> None:
        """Meet the fleet, and begin.

        Raises:
            ConnectFailedError: no agent of the fleet answers.
        """
        if self._task is not None:
            return
        await self._fleet.open()
        events = self._fleet.events(max_queue=100_000)
        for camera in self._fleet.cameras():
            await self._show(camera.name)
        self._task = asyncio.get_running_loop().create_task(self._follow(events))

    async def _follow(self, events: Any) -> None:
        """Have a node for each camera that comes; one that goes stays, and says so."""
        async for event in events:
            if isinstance(event, CameraJoined) and self._wanted(event.agent, event.camera):
                await self._show(event.camera)

    async def _show(self, name: str) -> None:
        """Have a camera seen; a node whose camera was given up gets the one that came for it."""
        camera = self._fleet[name]
        if self._of.get(name) is camera:
            return
        agents = self._fleet.agents(name)
        if not any(self._wanted(agent, name) for agent in agents):
            return
        await self._meet(camera)
        old = self.nodes.pop(name, None)
        if old is not None:
            await old.stop()
        try:
            node = self._node(name)
            made = CameraNode(camera, node, options=self._options(name, camera))
            await made.start()
        except SmartCamError as exc:
            logger.warning("%s ! it is not seen in ROS: %s", name, exc)
            return
        self._of[name], self.nodes[name] = camera, made

    @staticmethod
    async def _meet(camera: FleetCamera[Any]) -> None:
        """Wait a moment for what its agent says of it: whether it has frames."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(MEET):
                while not camera.met:  # noqa: ASYNC110 - nothing tells of it
                    await asyncio.sleep(0.01)

    def _node(self, name: str) -> Node:
        try:
            full = node_names([*self._of.keys() - {name}, name])[name]
        except ValueError as exc:
            raise SmartCamError(str(exc)) from exc
        namespace, _, own = full.rpartition("/")
        above = self._section.namespace.rstrip("/")
        return Node(own, namespace=f"{above}/{namespace}", context=self.context)

    def _options(self, name: str, camera: FleetCamera[Any]) -> CameraNodeOptions:
        said = self._said.get(name, RosCamera.model_validate({}))
        return CameraNodeOptions(
            frame_id=said.frame_id or as_name(name).replace("/", "_"),
            parent_frame=said.parent_frame or "",
            autostart=self._section.autostart,
            settings=self._settings.get(name),
            heard=lambda: camera.met,
            frames=self._frames.get(name, {}),
        )

    @property
    def names(self) -> list[str]:
        """The full names of the nodes."""
        return sorted(one.node.full_name for one in self.nodes.values())

    async def stop(self) -> None:
        """Take all nodes back. Idempotent, bounded."""
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
        nodes, self.nodes = self.nodes, {}
        await asyncio.gather(*(node.stop() for node in nodes.values()))
        self._of.clear()
        await self._fleet.close()


@contextlib.asynccontextmanager
async def ros_of(address: FleetAddress, section: RosSection) -> AsyncIterator[RosFleet]:
    """Have all cameras of a fleet that is there already seen in ROS 2.

    Raises:
        ConnectFailedError: no bus, or no agent with a camera, within the time.
    """
    bus = ZenohEnd(address.link, SETTINGS)
    await bus.open(TIMEOUT)
    try:
        async with RosFleet(bus, address.fleet, address, section) as ros:
            yield ros
    finally:
        await bus.close()
