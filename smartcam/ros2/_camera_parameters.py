"""Parameters of a camera's node."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from smartcam.camera import Camera
    from smartcam.ros2._camera_node import CameraNodeOptions
    from smartcam.ros2._camera_status import CameraStatus


class CameraParameters:
    """Declares what there is to know, and to set, of a camera."""

    def __init__(
        self, camera: Camera[Any], node: Any, options: CameraNodeOptions, status: CameraStatus
    ) -> None:
        self._camera, self._node, self._options, self._status = camera, node, options, status

    @classmethod
    def of(
        cls, camera: Camera[Any], node: Any, options: CameraNodeOptions, status: CameraStatus
    ) -> CameraParameters | None:
        """Return them, None where a node has no parameters."""
        if getattr(node, "parameters", None) is None:
            return None
        return cls(camera, node, options, status)

    def start(self) -> None:
        """Declare them."""

    async def close(self) -> None:
        """Nothing is left of them."""
