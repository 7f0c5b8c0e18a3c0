"""The cameras of a fleet as nodes of ROS 1."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any

from smartcam.fleet._inside import RosFleet, ZenohConnection
from smartcam.ros1._link import checked_url
from smartcam.ros1._rosbridge import RosbridgeNode

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from smartcam.fleet._inside import FleetAddress, RosSection

TIMEOUT = 10.0
"""Seconds to connect to the fleet, and to a bridge."""


class RosbridgeFleet(RosFleet):
    """A node of ROS 1 for each present camera of a fleet.

    Args:
        bridge: the URL of the rosbridge.
        on_change: function called with a node whose bridge was connected or lost.
        *args: arguments of :class:`RosFleet`.
        **options: arguments of :class:`RosFleet` by name.
    """

    def __init__(
        self, bridge: str, on_change: Callable[[RosbridgeNode], None], *args: Any, **options: Any
    ) -> None:
        super().__init__(*args, **options)
        self._bridge, self._on_change = bridge, on_change

    def _node(self, name: str) -> Any:
        ros2_node = super()._node(name)
        return RosbridgeNode(
            ros2_node.name,
            namespace=ros2_node.namespace,
            bridge=self._bridge,
            types=ros2_node.types,
            on_change=self._on_change,
        )

    @property
    def bridged_nodes(self) -> list[RosbridgeNode]:
        """The nodes, in the order of their names."""
        nodes = [camera.node for camera in self.nodes.values()]
        return sorted(nodes, key=lambda node: node.full_name)

    async def wait_first_attempts(self) -> None:
        """Wait, for a bounded time, until every node is connected or has failed to connect."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(TIMEOUT):
                for node in self.bridged_nodes:
                    await node.wait_first_attempts()


@contextlib.asynccontextmanager
async def run_bridged_nodes(
    bridge: str,
    on_change: Callable[[RosbridgeNode], None],
    address: FleetAddress,
    section: RosSection,
    **options: Any,
) -> AsyncIterator[RosbridgeFleet]:
    """Run nodes of ROS 1 for the cameras of a running fleet.

    Args:
        bridge: the URL of the rosbridge.
        on_change: function called with a node whose bridge was connected or lost.
        address: address of the fleet.
        section: settings of the nodes of the cameras.
        **options: arguments of :class:`RosFleet` about single cameras.

    Raises:
        ConfigurationError: the URL is not valid.
        ConnectFailedError: no bus, or no agent with a camera, was found in time.
    """
    checked_url(bridge)
    bus = ZenohConnection(address.link)
    await bus.open(TIMEOUT)
    try:
        args = (bus, address.fleet, address, section)
        async with RosbridgeFleet(bridge, on_change, *args, **options) as ros:
            yield ros
    finally:
        await bus.close()
