"""The life cycle of a node of rclpy: ROS' own state machine, which follows one of smartcam's.

rclpy's own callbacks of a transition block its thread until the transition has ended. A camera may
take long for a transition, so the order is reversed: smartcam's life cycle does the work in the
event loop, and makes ROS' machine take each step. The machine publishes each step and answers
requests for the state; requests for a change are answered here.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

from smartcam.exceptions import RosError
from smartcam.ros2._native.installed import rclpy_class
from smartcam.ros2._native.services import ServiceCalls
from smartcam.ros2._node.named_node import HANDLER_TIMEOUT

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam.ros2._native.node import NativeNode
    from smartcam.ros2._node.lifecycle import Lifecycle, LifecycleTransition

logger: logging.Logger = logging.getLogger("smartcam.ros2")

CHANGE_STATE = "lifecycle_msgs/srv/ChangeState"


class NativeLifecycle:
    """Makes ROS' own state machine follow a life cycle of smartcam's.

    Args:
        node: open node of rclpy.
        lifecycle: life cycle to follow.
        handler: coroutine function that answers ``change_state``.

    Raises:
        RosError: rclpy's node keeps its state machine in other attributes.
    """

    def __init__(
        self, node: NativeNode, lifecycle: Lifecycle, handler: Callable[[Any], Awaitable[Any]]
    ) -> None:
        self._machine: Any = getattr(node.rclpy_node, "_state_machine", None)
        service: Any = getattr(node.rclpy_node, "_service_change_state", None)
        if self._machine is None or service is None:
            raise RosError(
                f"{node.full_name}: this rclpy keeps its state machine in other attributes than "
                "Humble to Kilted; run without rclpy to use smartcam's own life cycle"
            )
        self._name = node.full_name
        service_type = node.types.service(CHANGE_STATE)
        self._calls = ServiceCalls(
            node,
            service.srv_name,
            service_type,
            rclpy_class(CHANGE_STATE),
            handler,
            HANDLER_TIMEOUT,
        )
        service.callback = self._calls.on_request
        self._stop_listening = lifecycle.listen(self._on_step)

    def _on_step(self, transition: LifecycleTransition) -> None:
        try:
            self._machine.trigger_transition_by_id(transition.id, True)
        except Exception as exc:  # noqa: BLE001 - the context has ended, and the request with it
            logger.warning("%s ! %s: %s", self._name, transition.label, exc)

    def close(self) -> None:
        """Stop following, and cancel running changes. Idempotent."""
        self._stop_listening()
        self._calls.close()
        self._machine = None
