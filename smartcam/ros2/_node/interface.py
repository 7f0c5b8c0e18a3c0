"""The interface of a node of ROS, as a camera's node uses it.

:class:`~smartcam.ros2.Node` uses the wire format of rmw_zenoh, a ``NativeNode`` uses rclpy, and ROS
1's node a rosbridge. The parts of a camera's node use only this interface.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam.ros2._node.qos import QoS
    from smartcam.ros2._types.types import RosTypes


class AnyPublisher(Protocol):
    """A publisher of a topic.

    It may also have ``has_subscribers``, False if the topic is known to have no subscriber;
    ``publish_encoded`` for an encoded message; and ``publish_newest`` for pictures, of which a slow
    subscriber gets only the newest.
    """

    @property
    def type(self) -> Any:
        """The type of the messages."""
        ...

    def publish(self, message: Any = None, /, **fields: Any) -> None:
        """Publish a message; never waits."""
        ...

    def close(self) -> None:
        """Stop publishing. Idempotent."""
        ...


class AnyService(Protocol):
    """A server of a service. It may also have ``wait_closed``."""

    def close(self) -> None:
        """Stop serving, and cancel running calls. Idempotent."""
        ...


class NodeOfRos(Protocol):
    """A node of ROS, opened and closed by ``async with``.

    A node of ROS 2 also has ``subscribe``, ``client``, and ``graph``, which shows the other nodes;
    only a node with ``graph`` can have a life cycle.

    Attributes:
        name: name of the node.
        namespace: namespace of the node.
    """

    name: str
    namespace: str

    @property
    def parameters(self) -> Any:
        """The parameters of the node; None in ROS 1."""
        ...

    @property
    def full_name(self) -> str:
        """The absolute name of the node."""
        ...

    @property
    def types(self) -> RosTypes:
        """The types of messages and services that the node knows."""
        ...

    async def __aenter__(self) -> Any:
        """Open the node."""
        ...

    async def __aexit__(self, *exc: object) -> None:
        """Close the node, with all its endpoints."""
        ...

    def publisher(self, topic: str, type: str, *, qos: QoS = ...) -> AnyPublisher:
        """Publish on a topic."""
        ...

    def serve(
        self,
        service: str,
        type: str,
        handler: Callable[[Any], Awaitable[Any]],
        *,
        qos: QoS = ...,
        timeout: float = ...,
    ) -> AnyService:
        """Serve a service."""
        ...
