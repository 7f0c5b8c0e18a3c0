"""A camera as a node of ROS: its parts, and their start and stop."""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import logging
from typing import TYPE_CHECKING, Any, Protocol

from smartcam._server import Server
from smartcam.ros2._cameras.calibrations import open_calibrations
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
    """A part of a camera's node, with topics, services and tasks of its own."""

    def start(self) -> Awaitable[None] | None:
        """Declare topics and services, and start."""
        ...

    async def close(self) -> None:
        """Close the part within seconds, even if ``start`` failed."""
        ...


PARTS: tuple[Callable[[CameraNode], CameraPart | None], ...] = (
    lambda camera_node: CameraParameters.create(
        camera_node.camera, camera_node.node, camera_node.options, camera_node.status
    ),
    lambda camera_node: camera_node.status,
    lambda camera_node: camera_node.results,
    lambda camera_node: CameraGraph(
        camera_node.node,
        camera_node.calibrations,
        owned=camera_node.calibrations is not camera_node.options.calibrations,
    ),
    lambda camera_node: camera_node.services,
    lambda camera_node: camera_node.rosout(),
    lambda camera_node: CameraPictures(
        camera_node.camera,
        camera_node.node,
        frame_id=camera_node.frames.optical,
        camera_info_url=str(camera_node.options.video_parameters.get("camera_info_url", "")),
    ),
    lambda camera_node: camera_node.controls(),
    lambda camera_node: StaticTransforms(camera_node.node, camera_node.frames.transforms()),
    lambda camera_node: camera_node.lifecycle,
)
"""Functions that make the parts of a node, in the order of their start. The life cycle starts last,
so that all other parts get its events."""


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
        self.calibrations: ThesisCalibration | None = open_calibrations(
            (options or CameraNodeOptions()).calibrations, camera.name
        )
        self.node: Any = node
        self.options: CameraNodeOptions = options or CameraNodeOptions()
        self.lifecycle: CameraLifecycle
        self.status: CameraStatus
        self.results: CameraResults
        self.services: CameraServices
        self._create_parts()
        self._stack: contextlib.AsyncExitStack | None = None
        self._lock = asyncio.Lock()

    def _create_parts(self) -> None:
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
            hand_eye=options.hand_eye,
            parent=options.parent_frame,
            flange=options.flange_frame,
            calibration_pose=options.calibration_pose,
        )

    def controls(self) -> CameraControls | None:
        """Return the parameters of the device that takes the pictures; None if there are none."""
        get_frame_source = self.options.get_frame_source
        if self.node.parameters is None or get_frame_source is None:
            return None
        return CameraControls(self.node, get_frame_source)

    def rosout(self) -> RosOut | None:
        """Return the publisher of the camera's warnings on ``/rosout``; None in ROS 1."""
        if self.node.parameters is None:
            return None
        prefixes = (f"{self.camera.name} ", f"{self.camera.name}:")

        def is_of_camera(record: logging.LogRecord) -> bool:
            return record.getMessage().startswith(prefixes)

        return RosOut(self.node, logging.getLogger("smartcam"), is_wanted=is_of_camera)

    def _on_transition(self, _: object) -> None:
        self.results.active = self.lifecycle.active

    async def start(self) -> None:
        """Open the node, and start all its parts.

        Raises:
            SmartCamError: a part cannot start; then the node is closed again.

        Cancellation: the node is closed.
        """
        async with self._lock:
            if self._stack is not None:
                return
            if self.lifecycle.closed:
                self._create_parts()
            async with contextlib.AsyncExitStack() as stack:
                await stack.enter_async_context(self.node)
                for make_part in PARTS:
                    part = make_part(self)
                    if part is not None:
                        stack.push_async_callback(_close_part, part)
                        started = part.start()
                        if inspect.isawaitable(started):
                            await started
                        await asyncio.sleep(0)  # let other tasks run: declaring takes Zenoh a while
                self._stack = stack.pop_all()

    async def stop(self) -> None:
        """Close all parts and the node. Idempotent, bounded."""
        async with self._lock:
            stack, self._stack = self._stack, None
            if stack is not None:
                await stack.aclose()


async def _close_part(part: CameraPart) -> None:
    """Close a part; log an error instead of raising it, so that the other parts are closed, too."""
    try:
        await part.close()
    except Exception:
        logger.exception("%s ! it did not close", type(part).__name__)
