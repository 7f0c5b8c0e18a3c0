"""A node of ROS 2 in asyncio, without an installation of ROS."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, TypeVar

from smartcam._server import Server
from smartcam._zenoh import ZenohDeclared
from smartcam.exceptions import RosError
from smartcam.ros2._context import ROUTER, RosContext
from smartcam.ros2._names import check_namespace, check_node, full_name, resolve
from smartcam.ros2._parameter_client import CALL_TIMEOUT, ParameterClient
from smartcam.ros2._parameters import RosParameters
from smartcam.ros2._qos import DEFAULT, SERVICES, QoS
from smartcam.ros2._services import RosClient, RosService
from smartcam.ros2._tokens import CLIENT, NODE, PUBLISHER, SERVICE, SUBSCRIPTION, Entity
from smartcam.ros2._topics import RosEnd, RosPublisher, RosSubscription
from smartcam.ros2._type_description import TypeDescriptions

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence

    from smartcam.ros2._graph import RosGraph
    from smartcam.ros2._tokens import Kind
    from smartcam.ros2._types import RosTypes

OPEN_TIMEOUT = 10.0
"""Seconds for coming to a router."""

HANDLER_TIMEOUT = 600.0
"""Seconds that a service's handler may take."""

CLOSE_TIMEOUT = 5.0

End = TypeVar("End", bound=RosEnd)


class Node(Server):
    """A node of ROS 2, for programs that use rmw_zenoh; ``async with`` opens and closes it.

    ::

        async with smartcam.ros2.Node("viewer") as node:
            async for message in node.subscribe("/chatter", "std_msgs/msg/String"):
                print(message.data)

    Args:
        name: letters, digits and ``_``.
        namespace: such as ``/line1``.
        connect: where the Zenoh router is; rmw_zenoh's own default.
        listen: where to listen instead, and be the router.
        domain: the number that keeps systems apart; None for the variable ``ROS_DOMAIN_ID``.
        distribution: of ROS, whose messages are spoken: its type hashes are part of all names.
        context: what it shares with other nodes of this process, instead of these.
        parameters: whether other nodes see its parameters and types, by seven services and a topic.
        open_timeout: seconds for coming to the router.

    Attributes:
        parameters: what it has of them.

    Raises:
        ConfigurationError: a name, domain or distribution cannot be.
        MissingExtraError: the extra ``ros2`` is not installed.
    """

    def __init__(
        self,
        name: str,
        *,
        namespace: str = "/",
        connect: str | Sequence[str] = ROUTER,
        listen: str | Sequence[str] = (),
        domain: int | None = None,
        distribution: str = "jazzy",
        context: RosContext | None = None,
        parameters: bool = True,
        open_timeout: float = OPEN_TIMEOUT,
    ) -> None:
        self.name: str = check_node(name)
        self.namespace: str = check_namespace(namespace)
        self.context: RosContext = context or RosContext(
            connect=connect, listen=listen, domain=domain, distribution=distribution
        )
        self._open_timeout = open_timeout
        self._id = 0
        self._token: ZenohDeclared | None = None
        self._ends: set[RosEnd] = set()
        self.parameters: RosParameters = RosParameters(self, served=parameters)
        self._descriptions = (
            TypeDescriptions(self, lambda: [end.entity for end in self._ends])
            if parameters
            else None
        )

    @property
    def full_name(self) -> str:
        """Such as ``/line1/cam3``."""
        return full_name(self.namespace, self.name)

    @property
    def types(self) -> RosTypes:
        """The messages and services that it speaks."""
        return self.context.types

    @property
    def graph(self) -> RosGraph:
        """Who is there."""
        return self.context.graph

    # ------------------------------------------------------------------ life

    async def start(self) -> None:
        """Open it.

        Raises:
            ConnectFailedError: there is no router, or it cannot listen.

        Cancellation: leaves it closed.
        """
        if self._token is not None:
            return
        await self.context.open(self._open_timeout)
        try:
            self._id = self.context.next_id()
            token = self._entity(NODE, self._id).token
            self._token = ZenohDeclared(self.context.zenoh).of(
                lambda session: session.liveliness().declare_token(token)
            )
        except BaseException:
            await self.context.close()
            raise
        try:
            self.parameters.open()
            if self._descriptions is not None:
                self._descriptions.open()
        except BaseException:
            await self.stop()
            raise

    async def stop(self) -> None:
        """Close it, with all that it publishes, hears, serves and calls. Idempotent."""
        token, self._token = self._token, None
        if token is None:
            return
        services = [one for one in self._ends if isinstance(one, RosService)]
        for end in tuple(self._ends):
            end.close()
        token.close()
        try:
            async with asyncio.timeout(CLOSE_TIMEOUT):
                await self.parameters.close()
                for one in services:
                    await one.wait_closed()
        except TimeoutError:
            pass  # a handler that does not end when it is cancelled is its author's
        finally:
            await self.context.close()

    # ------------------------------------------------------------------ what it has

    def publisher(self, topic: str, type: str, *, qos: QoS = DEFAULT) -> RosPublisher:
        """Publish on a topic.

        Args:
            topic: absolute, relative to the namespace, or private (``~/it``).
            type: such as ``std_msgs/msg/String``.
            qos: quality of service.

        Raises:
            ConfigurationError: the topic cannot be, or there is no such type.
            RosError: the node is not open.
        """
        kind = self.types.message(type)
        entity = self._end(PUBLISHER, topic, "topic", kind.dds, kind.hash, qos)
        return self._kept(RosPublisher(self.context, entity, kind, self._ends.discard))

    def subscribe(self, topic: str, type: str, *, qos: QoS = DEFAULT) -> RosSubscription:
        """Hear a topic; read it by ``async for``.

        Args:
            topic: absolute, relative to the namespace, or private (``~/it``).
            type: such as ``std_msgs/msg/String``.
            qos: quality of service; its depth is that of the queue.

        Raises:
            ConfigurationError: the topic cannot be, or there is no such type.
            RosError: the node is not open.
        """
        kind = self.types.message(type)
        entity = self._end(SUBSCRIPTION, topic, "topic", kind.dds, kind.hash, qos)
        return self._kept(RosSubscription(self.context, entity, kind, self._ends.discard))

    def serve(
        self,
        service: str,
        type: str,
        handler: Callable[[Any], Awaitable[Any]],
        *,
        qos: QoS = SERVICES,
        timeout: float = HANDLER_TIMEOUT,
    ) -> RosService:
        """Serve.

        Args:
            service: its name, as of a topic.
            type: such as ``std_srvs/srv/Trigger``.
            handler: is awaited with each request, and returns the response, or a mapping of its
                fields; an error of it leaves the call without a reply, with the text in the log.
            qos: quality of service.
            timeout: seconds that the handler may take.

        Raises:
            ConfigurationError: the name cannot be, or there is no such type.
            RosError: the node is not open.
        """
        kind = self.types.service(type)
        entity = self._end(SERVICE, service, "service", kind.dds, kind.hash, qos)
        return self._kept(
            RosService(self.context, entity, kind, handler, timeout, self._ends.discard)
        )

    def client(self, service: str, type: str, *, qos: QoS = SERVICES) -> RosClient:
        """Return what calls a service.

        Args:
            service: its name, as of a topic.
            type: such as ``std_srvs/srv/Trigger``.
            qos: quality of service.

        Raises:
            ConfigurationError: the name cannot be, or there is no such type.
            RosError: the node is not open.
        """
        kind = self.types.service(type)
        entity = self._end(CLIENT, service, "service", kind.dds, kind.hash, qos)
        return self._kept(RosClient(self.context, entity, kind, self._ends.discard))

    def parameters_of(self, name: str, *, timeout: float = CALL_TIMEOUT) -> ParameterClient:
        """Return what lists, gets, describes and sets another node's parameters.

        Args:
            name: the node's, absolute or relative to the namespace.
            timeout: seconds for one call.

        Raises:
            ConfigurationError: the name cannot be.
        """
        return ParameterClient(self, resolve(name, self.namespace, self.name, "node"), timeout)

    def _kept(self, end: End) -> End:
        self._ends.add(end)
        return end

    def _end(
        self,
        kind: Kind,
        name: str,
        what: str,
        dds: str,
        hashed: str,
        qos: QoS,
    ) -> Entity:
        full = resolve(name, self.namespace, self.name, what)
        if self._token is None:
            raise RosError(f"{self.full_name}: the node is not open")
        return self._entity(kind, self.context.next_id(), full, dds, hashed, qos)

    def _entity(self, kind: Kind, number: int, *more: Any) -> Entity:
        context = self.context
        return Entity(
            kind, context.domain, context.zid, self._id, number, self.namespace, self.name, *more
        )
