"""Messages and services that rosbags' stores lack, as the texts of their ``.msg`` and ``.srv``."""

from __future__ import annotations

from typing import Final

from smartcam.ros2._types.built_in.ros import ROS_MESSAGES, ROS_SERVICES
from smartcam.ros2._types.built_in.smartcam import SMARTCAM_MSGS

MESSAGES: Final = {**ROS_MESSAGES, **{k: v for k, v in SMARTCAM_MSGS.items() if "/msg/" in k}}
SERVICES: Final = {**ROS_SERVICES, **{k: v for k, v in SMARTCAM_MSGS.items() if "/srv/" in k}}
