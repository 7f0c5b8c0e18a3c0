"""Names for other packages of smartcam; users do not need them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.ros2._cameras.health import (
        DIAGNOSTICS,
        OK,
        STATUS_TYPE,
        WARN,
        KnownState,
        diagnostic_fields,
        hardware_id,
        header_fields,
        health,
        status_fields,
    )
    from smartcam.ros2._cameras.messages import DETECTIONS, POSES, RESULT, ResultMessages, utf8
    from smartcam.ros2._native.node import NativeNode
    from smartcam.ros2._native.spinning import NativeContext
    from smartcam.ros2._node.context import SETTINGS, RosContext
    from smartcam.ros2._node.named_node import HANDLER_TIMEOUT, NamedNode
    from smartcam.ros2._node.qos import DEFAULT, DRIVER, LATCHED, SERVICES
    from smartcam.ros2._node.topic_reader import TopicReader
    from smartcam.ros2._types.definitions import MessageField
    from smartcam.ros2._types.types import MessageType, ServiceType

__all__ = [
    "DEFAULT",
    "DETECTIONS",
    "DIAGNOSTICS",
    "DRIVER",
    "HANDLER_TIMEOUT",
    "LATCHED",
    "OK",
    "POSES",
    "RESULT",
    "SERVICES",
    "SETTINGS",
    "STATUS_TYPE",
    "WARN",
    "KnownState",
    "MessageField",
    "MessageType",
    "NamedNode",
    "NativeContext",
    "NativeNode",
    "ResultMessages",
    "RosContext",
    "ServiceType",
    "TopicReader",
    "diagnostic_fields",
    "hardware_id",
    "header_fields",
    "health",
    "status_fields",
    "utf8",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_types.types": "ServiceType MessageType",
            "_cameras.health": "DIAGNOSTICS KnownState OK STATUS_TYPE WARN "
            "diagnostic_fields hardware_id header_fields health status_fields",
            "_cameras.messages": "DETECTIONS POSES RESULT ResultMessages utf8",
            "_native.node": "NativeNode",
            "_native.spinning": "NativeContext",
            "_node.context": "RosContext SETTINGS",
            "_node.named_node": "HANDLER_TIMEOUT NamedNode",
            "_node.qos": "DEFAULT DRIVER LATCHED SERVICES",
            "_node.topic_reader": "TopicReader",
            "_types.definitions": "MessageField",
        },
    )
