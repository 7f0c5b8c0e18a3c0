"""Names behind the wall of the room that several of its tests use."""

from __future__ import annotations

from smartcam.ros2._cameras.results import CameraResults
from smartcam.ros2._node.attachment import Attachment
from smartcam.ros2._node.qos import PARAMETERS
from smartcam.ros2._node.tokens import Entity
from smartcam.ros2._types.built_in import MESSAGES

__all__ = ["MESSAGES", "PARAMETERS", "Attachment", "CameraResults", "Entity"]
