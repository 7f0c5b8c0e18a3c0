"""A camera as a node of ROS: its parts, and their start and stop."""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import logging
from typing import TYPE_CHECKING, Any, Protocol

from smartcam._server import Server
from smartcam.ros2._cameras.calibrations import calibrations_of
from smartcam.ros2._cameras.controls import CameraControls
from smartcam.ros2._cameras.lifecycle import CameraLifecycle
from smartcam.ros2._cameras.options import CameraNodeOptions
from smartcam.ros2._cameras.parameters import CameraParameters
from smartcam.ros2._cameras.pictures import CameraPictures
from smartcam.ros2._cameras.results import CameraResults
from smartcam.ros2._cameras.robot_graph import CameraGraph
from smartcam.ros2._cameras.services import CameraServices
from smartcam.ros2._cameras.status import CameraStatus
from smartcam.ros2._cameras.transforms import CameraFrames, StaticTransforms
from smartcam.ros2._node.rosout import RosOut

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam.calibration._inside import ThesisCalibration
    from smartcam.camera import Camera
    from smartcam.ros2._node.interface import NodeOfRos

logger: logging.Logger = logging.getLogger("smartcam.ros2")


class CameraPart(Protocol):
    """A part of a camera's node, which owns its topics and services, and its tasks."""

    def start(self) -> Awaitable[None] | None:
        """Declare topics and services, and start."""
        ...

    async def close(self) -> None:
        """End the part, within seconds; also if its start failed."""
        ...


PARTS: tuple[Callable[[CameraNode], CameraPart | None], ...] = (
    lambda this: CameraParameters.of(this.camera, this.node, this.options, this.status),
    lambda this: this.status,
    lambda this: this.results,
    lambda this: CameraGraph(
        this.node, this.calibrations, owned=this.calibrations is not this.options.calibrations
    ),
    lambda this: this.services,
    lambda this: this.rosout(),
    lambda this: CameraPictures(
        this.camera,
        this.node,
        frame_id=this.frames.optical,
        camera_info_url=str(this.options.frames.get("camera_info_url", "")),
    ),
    lambda this: this.controls(),
    lambda this: StaticTransforms(this.node, this.frames.transforms()),
    lambda this: this.lifecycle,
)
"""Parts of a node, in the order of their start. The life cycle is the last, so that the others get
its events."""


class CameraNode(Server):
    """A camera as a node of ROS; ``async with`` opens and closes it.

    The camera is open, connected or not, and its owner closes it. The node is opened and closed
    with this object. See :class:`CameraLifecycle` for the meaning of the states.

    Args:
        camera: open camera of the node.
        node: node of ROS 2, or of ROS 1 through a rosbridge.
        options: settings of the node.

    Attributes:
        lifecycle: life cycle of the node, which decides whether results are published.
        status: publisher of the camera's status and diagnostics.
        results: publisher of the camera's results.
        services: services of the camera for other nodes.
        calibrations: the camera's calibrations; None if there is no folder for them.
    """

    def __init__(
        self, camera: Camera[Any], node: NodeOfRos, *, options: CameraNodeOptions | None = None
    ) -> None:
        self.camera: Camera[Any] = camera
        self.calibrations: ThesisCalibration | None = calibrations_of(
            (options or CameraNodeOptions()).calibrations, camera.name
        )
        self.node: Any = node
        self.options: CameraNodeOptions = options or CameraNodeOptions()
        self.lifecycle: CameraLifecycle
        self.status: CameraStatus
        self.results: CameraResults
        self.services: CameraServices
        self._renew()
        self._stack: contextlib.AsyncExitStack | None = None
        self._turn = asyncio.Lock()

    def _renew(self) -> None:
        camera, node, options = self.camera, self.node, self.options
        self.lifecycle = CameraLifecycle(
            camera, node, application=options.application, autostart=options.autostart
        )
        self.status = CameraStatus(camera, node, options, lambda: self.lifecycle.state.label)
        self.results = CameraResults(
            camera, node, frame_id=self.frame_id, robot_frame=self.frames.robot
        )
        self.results.active = False
        self.services = CameraServices(
            camera, node, self.results, self.lifecycle, self.calibrations
        )
        self.lifecycle.listen(self._on_transition)

    @property
    def frame_id(self) -> str:
        """The frame of the camera's results."""
        return self.options.frame_id or self.camera.name

    @property
    def frames(self) -> CameraFrames:
        """The names of the camera's frames, and their places."""
        options = self.options
        return CameraFrames(
            self.frame_id,
            self.camera.settings.calibration,
            place=options.place,
            parent=options.parent_frame,
            flange=options.flange_frame,
            calibrated_at=options.calibrated_at,
        )

    def controls(self) -> CameraControls | None:
        """Return the parameters of the frames' device; None if there are none."""
        source = self.options.controls
        if self.node.parameters is None or source is None:
            return None
        return CameraControls(self.node, source)

    def rosout(self) -> RosOut | None:
        """Return the publisher of the camera's warnings on ``/rosout``; None in ROS 1."""
        if self.node.parameters is None:
            return None
        begins = (f"{self.camera.name} ", f"{self.camera.name}:")

        def wanted(record: logging.LogRecord) -> bool:
            return record.getMessage().startswith(begins)

        return RosOut(self.node, logging.getLogger("smartcam"), wanted=wanted)

    def _on_transition(self, _: object) -> None:
        self.results.active = self.lifecycle.active

    async def start(self) -> None:
        """Open the node, and start all its parts.

        Raises:
            SmartCamError: a part cannot start; then the node is closed again.

        Cancellation: the node is closed.
        """
        async with self._turn:
            if self._stack is not None:
                return
            if self.lifecycle.closed:
                self._renew()
            async with contextlib.AsyncExitStack() as stack:
                await stack.enter_async_context(self.node)
                for make in PARTS:
                    part = make(self)
                    if part is not None:
                        stack.push_async_callback(_closed, part)
                        begun = part.start()
                        if inspect.isawaitable(begun):
                            await begun
                        await asyncio.sleep(0)  # a declaration takes the engine a while
                self._stack = stack.pop_all()

    async def stop(self) -> None:
        """Close all parts and the node. Idempotent, bounded."""
        async with self._turn:
            stack, self._stack = self._stack, None
            if stack is not None:
                await stack.aclose()


async def _closed(part: CameraPart) -> None:
    """Close a part; log a failure, so that the others are closed too."""
    try:
        await part.close()
    except Exception:
        logger.exception("%s ! it did not close", type(part).__name__)
