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

CURE = (
    "source the setup.bash of a ROS 2 in front of this Python, or install the wheels of rclpy, or "
    "leave it out: without it smartcam speaks the wire format of rmw_zenoh itself"
)


def rclpy(name: str = "") -> Any:
    """Return rclpy, or a module in it.

    Raises:
        ConfigurationError: this Python has no rclpy that can be imported.
    """
    full = f"rclpy.{name}" if name else "rclpy"
    try:
        return importlib.import_module(full)
    except ImportError as exc:
        raise ConfigurationError(
            f"ROS 2 through rclpy: {full} cannot be imported ({exc!s:.300}): expected ROS' own "
            f"rclpy for this Python; {CURE}"
        ) from exc


def distribution() -> str:
    """Return the distribution of the installed ROS, as far as it is known."""
    name = os.environ.get("ROS_DISTRO", "")
    return name if name in DISTRIBUTIONS else "jazzy"


@functools.cache
def class_of(name: str) -> Any:
    """Return rclpy's class of a message or a service; None if there is none.

    Args:
        name: name of the type, such as ``std_msgs/msg/String``.
    """
    package, kind, type_name = name.split("/")
    check = rclpy("type_support").check_for_type_support
    try:
        class_ = getattr(importlib.import_module(f"{package}.{kind}"), type_name)
        for message_class in (class_.Request, class_.Response) if kind == "srv" else (class_,):
            check(message_class)
    except (ImportError, AttributeError, rclpy("exceptions").NoTypeSupportImportedException):
        return None
    return class_


def checked_message(kind: MessageType) -> Any:
    """Return rclpy's class of a type of message; None if there is none.

    Raises:
        ConfigurationError: its fields differ from smartcam's.
    """
    class_ = class_of(kind.name)
    if class_ is not None:
        _compare(kind, class_)
    return class_


def checked_service(kind: ServiceType) -> Any:
    """Return rclpy's class of a type of service; None if there is none.

    Raises:
        ConfigurationError: its fields differ from smartcam's.
    """
    class_ = class_of(kind.name)
    if class_ is not None:
        _compare(kind.request, class_.Request)
        _compare(kind.response, class_.Response)
    return class_


def _compare(kind: MessageType, class_: Any) -> None:
    ours = [field.name for field in kind.fields]
    theirs = [name for name in class_.get_fields_and_field_types() if name != EMPTY_FIELD]
    if ours != theirs:
        raise ConfigurationError(
            f"{kind.name}: the ROS that is installed has the fields {', '.join(theirs)}: expected "
            f"{', '.join(ours)}; name its distribution, or build the package of this smartcam"
        )


EMPTY_FIELD = "structure_needs_at_least_one_member"
"""The field that ROS puts into a message without fields."""


def to_ros(kind: MessageType, value: Any, cls: Any) -> Any:
    """Return a message of rclpy for one of smartcam's, or for a mapping of its fields."""
    return rclpy("serialization").deserialize_message(kind.encode(value), cls)
