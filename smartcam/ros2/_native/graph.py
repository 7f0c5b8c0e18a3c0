"""The graph of nodes, from rclpy."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from smartcam._ros_names import full_name

if TYPE_CHECKING:
    from smartcam.ros2._native.node import NativeNode


class NativeGraph:
    """The nodes, topics and services that a node knows.

    Every method raises a :class:`~smartcam.RosError` if the node is not open.

    Args:
        node: node whose graph is returned.
    """

    def __init__(self, node: NativeNode) -> None:
        self._node = node

    def nodes(self) -> list[str]:
        """Return the full names of all nodes, as ``ros2 node list``."""
        names = self._call("get_node_names_and_namespaces")
        return sorted(full_name(namespace, name) for name, namespace in names)

    def topics(self) -> dict[str, list[str]]:
        """Return the types of each topic by its name, as ``ros2 topic list -t``."""
        return {name: sorted(types) for name, types in self._call("get_topic_names_and_types")}

    def services(self) -> dict[str, list[str]]:
        """Return the types of each service by its name, as ``ros2 service list -t``."""
        return {name: sorted(types) for name, types in self._call("get_service_names_and_types")}

    def _call(self, method: str) -> Any:
        return self._node.call_rclpy(lambda rclpy_node: getattr(rclpy_node, method)())
