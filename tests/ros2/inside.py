"""Private names of the room for its helpers of tests, or for several tests."""

from __future__ import annotations

from smartcam.ros2._cameras.image_messages import (
    ENCODINGS,
    array_fields,
    choose_compression,
    compressed_fields,
    header_fields_at,
    image_fields,
    to_ros_format,
)
from smartcam.ros2._cameras.lens_messages import lens_fields, lens_from
from smartcam.ros2._cameras.results import CameraResults
from smartcam.ros2._node.attachment import Attachment
from smartcam.ros2._node.parameters import RosParameters
from smartcam.ros2._node.qos import PARAMETERS, SENSOR_DATA
from smartcam.ros2._node.tokens import Entity, gid_of
from smartcam.ros2._types.built_in import MESSAGES, SERVICES
from smartcam.ros2._types.definitions import INTEGERS, NUMBERS, parse_message, parse_service
from smartcam.ros2._types.stores import stored_fields
