"""The installed rclpy: its modules, and its classes of messages and services."""

from __future__ import annotations

import functools
import importlib
import os
from typing import TYPE_CHECKING, Any

from smartcam.exceptions import ConfigurationError
from smartcam.ros2._types.stores import DISTRIBUTIONS

if TYPE_CHECKING:
    from smartcam.ros2._types.types import MessageType, ServiceType

HOW_TO_GET_RCLPY = (
    "source the setup.bash of a ROS 2 before you start this Python, or install the wheels of "
    "rclpy, or do not use rclpy: smartcam itself speaks the wire format of rmw_zenoh"
)


def rclpy(name: str = "") -> Any:
    """Return rclpy, or a module in it.

    Raises:
        ConfigurationError: this Python has no rclpy that can be imported.
    """
    module_name = f"rclpy.{name}" if name else "rclpy"
    try:
        return importlib.import_module(module_name)
    except ImportError as exc:
        raise ConfigurationError(
            f"ROS 2 through rclpy: {module_name} cannot be imported ({exc!s:.300}): expected ROS' "
            f"own rclpy for this Python; {HOW_TO_GET_RCLPY}"
        ) from exc


def installed_distribution() -> str:
    """Return the distribution in ``ROS_DISTRO``; jazzy if that is not set or not known."""
    name = os.environ.get("ROS_DISTRO", "")
    return name if name in DISTRIBUTIONS else "jazzy"


@functools.cache
def rclpy_class(name: str) -> Any:
    """Return rclpy's class of a message or a service; None if there is none.

    Args:
        name: name of the type, such as ``std_msgs/msg/String``.
    """
    package, category, type_name = name.split("/")
    check = rclpy("type_support").check_for_type_support
    try:
        class_ = getattr(importlib.import_module(f"{package}.{category}"), type_name)
        for message_class in (class_.Request, class_.Response) if category == "srv" else (class_,):
            check(message_class)
    except (ImportError, AttributeError, rclpy("exceptions").NoTypeSupportImportedException):
        return None
    return class_


def checked_message_class(message_type: MessageType) -> Any:
    """Return rclpy's class of a type of message; None if there is none.

    Raises:
        ConfigurationError: its fields differ from smartcam's.
    """
    class_ = rclpy_class(message_type.name)
    if class_ is not None:
        _check_same_fields(message_type, class_)
    return class_


def checked_service_class(service_type: ServiceType) -> Any:
    """Return rclpy's class of a type of service; None if there is none.

    Raises:
        ConfigurationError: its fields differ from smartcam's.
    """
    class_ = rclpy_class(service_type.name)
    if class_ is not None:
        _check_same_fields(service_type.request, class_.Request)
        _check_same_fields(service_type.response, class_.Response)
    return class_


def _check_same_fields(message_type: MessageType, class_: Any) -> None:
    ours = [field.name for field in message_type.fields]
    theirs = [name for name in class_.get_fields_and_field_types() if name != EMPTY_FIELD]
    if ours != theirs:
        raise ConfigurationError(
            f"{message_type.name}: the ROS that is installed has the fields {', '.join(theirs)}: "
            f"expected {', '.join(ours)}; set the distribution to the installed one, or build the "
            "package that belongs to this smartcam"
        )


EMPTY_FIELD = "structure_needs_at_least_one_member"
"""The field that ROS puts into a message without fields."""


def to_ros(message_type: MessageType, value: Any, rclpy_type: Any) -> Any:
    """Return a message of rclpy for one of smartcam's, or for a mapping of its fields."""
    return rclpy("serialization").deserialize_message(message_type.encode(value), rclpy_type)
