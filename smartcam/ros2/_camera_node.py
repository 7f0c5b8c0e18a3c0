"""A camera as a node of ROS: what it is made of, and its life."""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

from smartcam._server import Server
from smartcam.exceptions import ConfigurationError
from smartcam.ros2._camera_lifecycle import CameraLifecycle
from smartcam.ros2._camera_parameters import CameraParameters
from smartcam.ros2._camera_pictures import CameraPictures
from smartcam.ros2._camera_results import CameraResults
from smartcam.ros2._camera_services import CameraServices
from smartcam.ros2._camera_status import CameraStatus
from smartcam.ros2._rosout import RosOut
from smartcam.ros2._transforms import StaticTransforms, camera_transforms

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam.camera import Camera
    from smartcam.settings import CameraSettings

logger: logging.Logger = logging.getLogger("smartcam.ros2")


class CameraPart(Protocol):
    """What a camera's node is made of: it owns what it declares, and its tasks."""

    def start(self) -> Awaitable[None] | None:
        """Declare it, and begin."""
        ...

    async def close(self) -> None:
        """End it, within seconds; also where starting it failed."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraNodeOptions:
    """How a camera is seen in ROS.

    Attributes:
        frame_id: of what it sees; empty for the camera's name.
        parent_frame: of the frame that a calibration puts it in; empty for none.
        autostart: the life cycle goes to Active by itself.
        application: to have running and ready when it is configured; None for what the camera's
            settings say.
        diagnostics_period: seconds between two diagnostics.
        status_rate: how often a second the status is said at most.
        hardware_id: of the diagnostics; empty for the camera's address.
        settings: what the session with the camera is told, where that is not what the camera's own
            settings say: the agent's, of a camera of a fleet.
        heard: whether there is any sign of who has the session, the agent of a fleet; None where
            nobody is between.
        frames: parameters that say where its frames come from, by v4l2_camera's names:
            ``video_device``, ``pixel_format``, ``image_size`` and ``camera_info_url``.
    """

    frame_id: str = ""
    parent_frame: str = ""
    autostart: bool = True
    application: int | None = None
    diagnostics_period: float = 1.0
    status_rate: float = 20.0
    hardware_id: str = ""
    settings: CameraSettings | None = None
    heard: Callable[[], bool] | None = None
    frames: Mapping[str, Any] = field(default_factory=dict[str, Any])

    def __post_init__(self) -> None:
        for name, value in (
            ("diagnostics_period", self.diagnostics_period),
            ("status_rate", self.status_rate),
        ):
            if not 0.01 <= value <= 3600:
                raise ConfigurationError(f"{name}: {value!r}: expected 0.01 to 3600")


PARTS: tuple[Callable[[CameraNode], CameraPart | None], ...] = (
    lambda one: CameraParameters.of(one.camera, one.node, one.options, one.status),
    lambda one: one.status,
    lambda one: one.results,
    lambda one: one.services,
    lambda one: one.rosout(),
    lambda one: CameraPictures(
        one.camera, one.node, camera_info_url=str(one.options.frames.get("camera_info_url", ""))
    ),
    lambda one: StaticTransforms(one.node, one.transforms()),
    lambda one: one.lifecycle,
)
"""What a node is made of, in the order in which it starts; the life cycle is the last, so that what
it tells is heard."""


class CameraNode(Server):
    """A camera as a node of ROS; ``async with`` opens and closes it.

    The camera is its owner's: it is open, connected or not, and stays so. The node is opened and
    closed with this. See :class:`CameraLifecycle` for what its states mean.

    Args:
        camera: it; open.
        node: of ROS 2, or of ROS 1 behind a rosbridge.
        options: how it is seen.

    Attributes:
        lifecycle: whether it publishes results.
        status: what it says of the camera.
        results: its results.
        services: what others can have it do.
    """

    def __init__(
        self, camera: Camera[Any], node: Any, *, options: CameraNodeOptions | None = None
    ) -> None:
        self.camera: Camera[Any] = camera
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
        self.results = CameraResults(camera, node, frame_id=self.frame_id)
        self.results.active = False
        settings = options.settings or camera.settings
        self.services = CameraServices(
            camera, node, self.results, self.lifecycle, address=settings.address
        )
        self.lifecycle.listen(self._on_transition)

    @property
    def frame_id(self) -> str:
        """The frame of what it sees."""
        return self.options.frame_id or self.camera.name

    def rosout(self) -> RosOut | None:
        """Return what has the camera's warnings in ``/rosout``; None in ROS 1."""
        if self.node.parameters is None:
            return None
        begins = (f"{self.camera.name} ", f"{self.camera.name}:")

        def wanted(record: logging.LogRecord) -> bool:
            return record.getMessage().startswith(begins)

        return RosOut(self.node, logging.getLogger("smartcam"), wanted=wanted)

    def transforms(self) -> list[Any]:
        """Return where the calibration puts the camera; none where it does not say, or is none."""
        calibration = self.camera.settings.calibration
        if calibration is None or isinstance(calibration, Mapping):  # of each application one
            return []
        return camera_transforms(calibration, self.frame_id, parent=self.options.parent_frame)

    def _on_transition(self, _: object) -> None:
        self.results.active = self.lifecycle.active

    async def start(self) -> None:
        """Open the node, and begin with all that it is made of.

        Raises:
            SmartCamError: something of it cannot be; all is undone.

        Cancellation: leaves it closed.
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
                        await asyncio.sleep(0)  # to declare takes the engine a while
                self._stack = stack.pop_all()

    async def stop(self) -> None:
        """End all of it, and the node. Idempotent, bounded."""
        async with self._turn:
            stack, self._stack = self._stack, None
            if stack is not None:
                await stack.aclose()


async def _closed(part: CameraPart) -> None:
    """Close a part; the others are closed whatever becomes of it."""
    try:
        await part.close()
    except Exception:
        logger.exception("%s ! it did not close", type(part).__name__)
