"""Parameters of a camera's node: the camera's settings; a few of them can be set."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from smartcam.exceptions import ConfigurationError
from smartcam.ros2._cameras.transforms import CameraFrames
from smartcam.settings import masked

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.camera import Camera
    from smartcam.ros2._cameras.options import CameraNodeOptions
    from smartcam.ros2._cameras.status import CameraStatus
    from smartcam.settings import CameraSettings

SWITCH_TIMEOUT = 9.0
"""Largest timeout of an application switch in seconds: setting a parameter may take 10 seconds."""

MAX_APPLICATION_ID = 0xFFFFFFFF
DIAGNOSTICS_PERIODS = (0.1, 3600.0)
"""Smallest and largest number of seconds between two diagnostics messages."""

SETTINGS: Mapping[str, tuple[str, Callable[[CameraSettings], Any]]] = {
    "url": ("URL of the camera, without a password", lambda settings: masked(settings.address.url)),
    "interpret_as": (
        "interpretation of result containers; empty: none",
        lambda settings: interpretation_text(settings.interpret_as),
    ),
    "y_down": ("the camera's y axis points down", lambda settings: settings.y_down),
    "lenient": ("any byte but 0 counts as true in a bool", lambda settings: settings.lenient),
    "restore": (
        "application and run state are restored after a reconnect",
        lambda settings: settings.restore,
    ),
    "reconnect": (
        "the client reconnects after a loss",
        lambda settings: settings.reconnect is not None,
    ),
    "connect_timeout": (
        "seconds to establish a session",
        lambda settings: settings.connect_timeout,
    ),
    "switch_timeout": (
        "seconds for a switch until the camera is ready",
        lambda settings: settings.switch_timeout,
    ),
    "request_timeout": (
        "seconds for the answer to a request",
        lambda settings: settings.request_timeout,
    ),
    "liveness_timeout": (
        "seconds until a camera that does not answer counts as lost; 0: never",
        lambda settings: settings.liveness_timeout or 0.0,
    ),
}
"""Description of each read-only parameter, and a function that returns its value."""

PICTURE_PARAMETERS = {
    "video_device": "source of the frames",
    "pixel_format": "format of frames, as four characters",
    "image_size": "width and height of frames in pixels",
    "camera_info_url": "file of the lens calibration",
}
"""Descriptions of the parameters of the source of frames, by v4l2_camera's names."""


def interpretation_text(spec: object) -> str:
    """Return an interpretation in one line."""
    if spec is None:
        return ""
    if isinstance(spec, Mapping):
        return json.dumps({str(key): interpretation_text(value) for key, value in spec.items()})
    return spec if isinstance(spec, str) else type(spec).__name__


class CameraParameters:
    """Declares parameters for a camera's settings.

    ``application`` is the active application, 0 if that is not known. Setting this parameter
    switches the camera, for all its users: the parameter has the new value once the camera is
    ready; if the camera refuses, the parameter is refused with the camera's error.

    Args:
        camera: camera of the parameters.
        node: node of ROS 2.
        options: settings of the camera's node.
        status: publisher of the status, which reports the camera's changes and has the period of
            diagnostics.
    """

    def __init__(
        self, camera: Camera[Any], node: Any, options: CameraNodeOptions, status: CameraStatus
    ) -> None:
        self._camera, self._parameters = camera, node.parameters
        self._options, self._status = options, status
        self._declared: list[str] = []
        self._stop_listening: Callable[[], None] | None = None

    @classmethod
    def create(
        cls, camera: Camera[Any], node: Any, options: CameraNodeOptions, status: CameraStatus
    ) -> CameraParameters | None:
        """Return the parameters of a camera; None if the node has no parameters."""
        if getattr(node, "parameters", None) is None:
            return None
        return cls(camera, node, options, status)

    def start(self) -> None:
        """Declare the parameters."""
        options, camera = self._options, self._camera
        settings = options.settings or camera.settings
        for name, (description, value) in SETTINGS.items():
            self._declare(name, value(settings), description, read_only=True)
        self._declare(
            "application",
            self._active_application(),
            "the active application; 0: not known",
            minimum=0,
            maximum=MAX_APPLICATION_ID,
            on_set=self._switch,
        )
        frame_id = options.frame_id or camera.name
        self._declare("frame_id", frame_id, "frame of results", read_only=True)
        self._declare(
            "parent_frame", options.parent_frame, "parent of the camera's frame", read_only=True
        )
        self._declare(
            "diagnostics_period",
            float(options.diagnostics_period),
            "seconds between two diagnostics",
            minimum=min(DIAGNOSTICS_PERIODS[0], options.diagnostics_period),
            maximum=DIAGNOSTICS_PERIODS[1],
            on_set=self._status.set_period,
        )
        for name, value in options.video_parameters.items():
            self._declare(name, value, PICTURE_PARAMETERS.get(name, ""), read_only=True)
        if options.video_parameters:
            optical = CameraFrames(frame_id).optical
            self._declare("camera_frame_id", optical, "frame of pictures", read_only=True)
        self._stop_listening = self._status.listen(self._update_application)

    def _declare(self, name: str, value: object, description: str, **options: Any) -> None:
        self._parameters.declare(name, value, description=description, **options)
        self._declared.append(name)

    async def close(self) -> None:
        """Undeclare the parameters. Idempotent."""
        if self._stop_listening is not None:
            self._stop_listening()
        declared, self._declared = self._declared, []
        for name in declared:
            with contextlib.suppress(ConfigurationError):  # another program has undeclared it
                self._parameters.undeclare(name)

    def _active_application(self) -> int:
        return (self._camera.active_application or 0) if self._camera.connected else 0

    def _update_application(self) -> None:
        """Update the parameter ``application`` to the active application."""
        self._parameters.update("application", self._active_application())

    async def _switch(self, application: int) -> None:
        camera = self._camera
        settings = self._options.settings or camera.settings
        timeout = min(settings.switch_timeout, SWITCH_TIMEOUT)
        if not camera.connected or await camera.query_application() != application:
            await camera.switch_application(application, timeout=timeout)
        else:
            await camera.wait_status(lambda status: not status.loading, timeout)
