"""A node of ROS 2 in asyncio, without an installation of ROS."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, TypeVar

from smartcam._ros_names import resolve
from smartcam._zenoh import ZenohDeclared
from smartcam.ros2._node.context import ROUTER, RosContext
from smartcam.ros2._node.named_node import HANDLER_TIMEOUT, NamedNode
from smartcam.ros2._node.parameter_client import CALL_TIMEOUT, ParameterClient
from smartcam.ros2._node.parameters import RosParameters
from smartcam.ros2._node.qos import DEFAULT, SERVICES, QoS
from smartcam.ros2._node.services import RosClient, RosService
from smartcam.ros2._node.tokens import CLIENT, NODE, PUBLISHER, SERVICE, SUBSCRIPTION, Entity
from smartcam.ros2._node.topics import RosEndpoint, RosPublisher, RosSubscription
from smartcam.ros2._node.type_description import TypeDescriptions

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence

    from smartcam.ros2._node.graph import RosGraph
    from smartcam.ros2._node.tokens import Kind
    from smartcam.ros2._types.types import RosTypes

OPEN_TIMEOUT = 10.0
"""Seconds for connecting to a router."""

CLOSE_TIMEOUT = 5.0

Endpoint = TypeVar("Endpoint", bound=RosEndpoint)


class Node(NamedNode):
    """A node of ROS 2, for programs that use rmw_zenoh; ``async with`` opens and closes it.

    ::

        async with smartcam.ros2.Node("viewer") as node:
            async for message in node.subscribe("/chatter", "std_msgs/msg/String"):
                print(message.data)

    Args:
        name: name of the node, of letters, digits and ``_``.
        namespace: namespace of the node, such as ``/line1``.
        connect: endpoints of the Zenoh router; default: rmw_zenoh's own.
        listen: endpoints to listen on as the router; then ``connect`` is not used.
        domain: number of the domain, which separates systems; None for the variable
            ``ROS_DOMAIN_ID``.
        distribution: name of the ROS distribution, whose type hashes are part of all names.
        context: context shared with other nodes of this process, instead of the arguments above.
        parameters: whether its parameters and types are served, by seven services and a topic.
        open_timeout: seconds for connecting to the router.

    Attributes:
        parameters: parameters of the node.

    Raises:
        ConfigurationError: a name, domain or distribution is not valid.
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
        super().__init__(name, namespace)
        self.context: RosContext = context or RosContext(
            connect=connect, listen=listen, domain=domain, distribution=distribution
        )
        self._open_timeout = open_timeout
        self._id = 0
        self._token: ZenohDeclared | None = None
        self._endpoints: set[RosEndpoint] = set()
        self.parameters: RosParameters = RosParameters(self, served=parameters)
        self._descriptions = (
            TypeDescriptions(self, lambda: [endpoint.entity for endpoint in self._endpoints])
            if parameters
            else None
        )

    @property
    def types(self) -> RosTypes:
        """The message and service types that the node knows."""
        return self.context.types

    @property
    def graph(self) -> RosGraph:
        """Graph of the node's domain."""
        return self.context.graph

    @property
    def is_open(self) -> bool:
        """True from the end of ``start()`` until ``stop()``."""
        return self._token is not None

    # ------------------------------------------------------------------ life

    async def start(self) -> None:
        """Open the node.

        Raises:
            ConnectFailedError: there is no router, or the node cannot listen.

        Cancellation: the node is closed.
        """
        if self._token is not None:
            return
        await self.context.open(self._open_timeout)
        try:
            self._id = self.context.next_id()
            token = self._entity(NODE, self._id).token
            self._token = ZenohDeclared(self.context.zenoh).declare(
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
        """Close the node, with its publishers, subscriptions, services and clients. Idempotent."""
        token, self._token = self._token, None
        if token is None:
            return
        services = [endpoint for endpoint in self._endpoints if isinstance(endpoint, RosService)]
        for endpoint in tuple(self._endpoints):
            endpoint.close()
        token.close()
        try:
            async with asyncio.timeout(CLOSE_TIMEOUT):
                await self.parameters.close()
                for service in services:
                    await service.wait_closed()
        except TimeoutError:
            pass  # the handler's author must end it at cancellation
        finally:
            await self.context.close()

    # ------------------------------------------------------------------ endpoints

    def publisher(self, topic: str, type: str, *, qos: QoS = DEFAULT) -> RosPublisher:
        """Publish on a topic.

        Args:
            topic: name of the topic: absolute, relative to the namespace, or private (``~/it``).
            type: type of the messages, such as ``std_msgs/msg/String``.
            qos: quality of service.

        Raises:
            ConfigurationError: the topic is not valid, or there is no such type.
            RosError: the node is not open.
        """
        message_type = self.types.message(type)
        entity = self._make_entity(
            PUBLISHER, topic, "topic", message_type.dds, message_type.hash, qos
        )
        return self._register(
            RosPublisher(self.context, entity, message_type, self._endpoints.discard)
        )

    def subscribe(self, topic: str, type: str, *, qos: QoS = DEFAULT) -> RosSubscription:
        """Subscribe to a topic; read it by ``async for``.

        Args:
            topic: name of the topic: absolute, relative to the namespace, or private (``~/it``).
            type: type of the messages, such as ``std_msgs/msg/String``.
            qos: quality of service; its depth is the queue's length.

        Raises:
            ConfigurationError: the topic is not valid, or there is no such type.
            RosError: the node is not open.
        """
        message_type = self.types.message(type)
        entity = self._make_entity(
            SUBSCRIPTION, topic, "topic", message_type.dds, message_type.hash, qos
        )
        return self._register(
            RosSubscription(self.context, entity, message_type, self._endpoints.discard)
        )

    def serve(
        self,
        service: str,
        type: str,
        handler: Callable[[Any], Awaitable[Any]],
        *,
        qos: QoS = SERVICES,
        timeout: float = HANDLER_TIMEOUT,
    ) -> RosService:
        """Serve a service.

        Args:
            service: name of the service, resolved like a topic's name.
            type: type of the service, such as ``std_srvs/srv/Trigger``.
            handler: coroutine function that takes each request and returns the response, or a
                mapping of its fields; its error is logged, and is in the response if that has
                fields such as ``success`` or ``error``; otherwise the call gets no reply.
            qos: quality of service.
            timeout: seconds of the handler's timeout.

        Raises:
            ConfigurationError: the name is not valid, or there is no such type.
            RosError: the node is not open.
        """
        service_type = self.types.service(type)
        entity = self._make_entity(
            SERVICE, service, "service", service_type.dds, service_type.hash, qos
        )
        return self._register(
            RosService(
                self.context, entity, service_type, handler, timeout, self._endpoints.discard
            )
        )

    def client(self, service: str, type: str, *, qos: QoS = SERVICES) -> RosClient:
        """Return a client that calls a service.

        Args:
            service: name of the service, resolved like a topic's name.
            type: type of the service, such as ``std_srvs/srv/Trigger``.
            qos: quality of service.

        Raises:
            ConfigurationError: the name is not valid, or there is no such type.
            RosError: the node is not open.
        """
        service_type = self.types.service(type)
        entity = self._make_entity(
            CLIENT, service, "service", service_type.dds, service_type.hash, qos
        )
        return self._register(
            RosClient(self.context, entity, service_type, self._endpoints.discard)
        )

    def parameters_of(self, name: str, *, timeout: float = CALL_TIMEOUT) -> ParameterClient:
        """Return a client that lists, gets, describes and sets another node's parameters.

        Args:
            name: name of the other node, absolute or relative to the namespace.
            timeout: seconds for one call.

        Raises:
            ConfigurationError: the name is not valid.
        """
        return ParameterClient(
            self.client, resolve(name, self.namespace, self.name, "node"), timeout
        )

    def _register(self, endpoint: Endpoint) -> Endpoint:
        self._endpoints.add(endpoint)
        return endpoint

    def _make_entity(
        self,
        kind: Kind,
        name: str,
        kind_text: str,
        dds: str,
        type_hash: str,
        qos: QoS,
    ) -> Entity:
        absolute_name = self._resolve_name(name, kind_text)
        return self._entity(kind, self.context.next_id(), absolute_name, dds, type_hash, qos)

    def _entity(self, kind: Kind, number: int, *topic_fields: Any) -> Entity:
        context = self.context
        return Entity(
            kind,
            context.domain,
            context.zid,
            self._id,
            number,
            self.namespace,
            self.name,
            *topic_fields,
        )
