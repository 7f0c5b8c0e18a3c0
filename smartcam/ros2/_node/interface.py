"""The methods that a camera's node asks of the node of ROS below it.

:class:`~smartcam.ros2.Node` speaks the wire format of rmw_zenoh, a ``NativeNode`` speaks through
rclpy, and ROS 1's goes through a rosbridge. The parts of a camera know only this.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam.ros2._node.qos import QoS
    from smartcam.ros2._types.types import RosTypes


class PublisherEnd(Protocol):
    """A topic that is published on.

    An end may also have ``heard``, which says whether anybody hears the topic as far as is known;
    ``publish_encoded``, which takes bytes of the type; and ``publish_newest``, which takes
    pictures: True for pictures, of which a slow subscriber gets the newest only.
    """

    @property
    def type(self) -> Any:
        """The type of the messages."""
        ...

    def publish(self, message: Any = None, /, **fields: Any) -> None:
        """Publish a message; never waits."""
        ...

    def close(self) -> None:
        """Publish no more. Idempotent."""
        ...


class ServiceEnd(Protocol):
    """A service that is served. An end may also have ``wait_closed``."""

    def close(self) -> None:
        """Serve no more; calls under way are given up. Idempotent."""
        ...


class NodeOfRos(Protocol):
    """A node of ROS, opened and closed by ``async with``.

    A node of ROS 2 also has ``graph``, which is how a node with a life cycle is told from others,
    ``subscribe`` and ``client``.

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
        """The messages and services that the node speaks."""
        ...

    async def __aenter__(self) -> Any:
        """Open the node."""
        ...

    async def __aexit__(self, *exc: object) -> None:
        """Close the node, with all ends that are left."""
        ...

    def publisher(self, topic: str, type: str, *, qos: QoS = ...) -> PublisherEnd:
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
    ) -> ServiceEnd:
        """Serve a service."""
        ...
