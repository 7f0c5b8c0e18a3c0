"""A node of ROS 1 through a rosbridge: it publishes, subscribes, and serves services."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from typing import TYPE_CHECKING, Any

from smartcam._user_code import ENDS_PROGRAM
from smartcam.backoff import Backoff
from smartcam.exceptions import ConfigurationError
from smartcam.ros1._json_messages import encode_operation
from smartcam.ros1._link import BridgeLink
from smartcam.ros1._outbox import Outbox
from smartcam.ros1._publishing import RosbridgePublisher
from smartcam.ros1._retiring import PROBED_SERVICE, make_call, withdraw_services
from smartcam.ros1._serving import CLOSE_TIMEOUT, RosbridgeService
from smartcam.ros1._subscribers import listen_for_subscribers
from smartcam.ros1._subscribing import RosbridgeSubscription
from smartcam.ros2 import QoS, RosTypes
from smartcam.ros2._inside import DEFAULT, HANDLER_TIMEOUT, SERVICES, NamedNode

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Coroutine

    from smartcam.ros1._json_messages import TextPart

logger: logging.Logger = logging.getLogger("smartcam.ros1")

FLUSH_TIMEOUT = 1.0
"""Seconds to send waiting operations when the node is stopped."""
ASK_TIMEOUT = 5.0
"""Seconds that the bridge may take to answer a call of smartcam."""
REPEAT_INTERVAL = 10.0
"""Seconds between two repetitions of a latched message on a topic that nodes share, such as
``/tf_static``: a bridge keeps one message for all of its clients."""
_LEVELS = {"error": logging.ERROR, "warning": logging.WARNING, "info": logging.INFO}


class RosbridgeNode(NamedNode):
    """A node of ROS 1 in asyncio, over a rosbridge; ``async with`` opens and closes it.

    Opening the node does not wait for the bridge: the node tries to connect until it succeeds, and
    again after a loss. Then it advertises everything again, and publishes the last message of each
    latched topic again; other messages without a bridge are dropped and counted. A call under way
    is cancelled when the bridge is lost.

    The protocol has no answer to an advertisement: if a bridge does not know a type, because its
    machine does not have the package, only the bridge's log says so.

    Args:
        name: name of the node, of letters, digits and ``_``.
        namespace: namespace of the node, such as ``/line1``.
        bridge: the bridge's URL, ``ws://host:9090``.
        types: the known messages and services; None for Jazzy's. Topics and services of
            types that ROS 1 does not have are left out, and logged.
        backoff: delays between attempts to connect; None: the defaults of
            :class:`smartcam.Backoff`.
        on_change: function called in the event loop when the bridge was connected or lost.

    Raises:
        ConfigurationError: a name or the URL is not valid.
        MissingExtraError: the extra ``ros2`` is not installed.
    """

    parameters: None = None  # nodes of ROS 1 have no parameters of their own

    def __init__(
        self,
        name: str,
        *,
        namespace: str = "/",
        bridge: str,
        types: RosTypes | None = None,
        backoff: Backoff | None = None,
        on_change: Callable[[RosbridgeNode], None] = lambda _node: None,
    ) -> None:
        super().__init__(name, namespace)
        self.types: RosTypes = types or RosTypes()
        self._on_change = on_change
        self._outbox = Outbox()
        self._link = BridgeLink(bridge, self._outbox, self, backoff or Backoff())
        self._publishers: dict[str, RosbridgePublisher] = {}
        self._services: dict[str, RosbridgeService] = {}
        self._subscriptions: list[RosbridgeSubscription] = []
        self._link_task: asyncio.Task[None] | None = None
        self._tasks: set[asyncio.Task[None]] = set()  # tasks that end with the link
        self._to_advertise: list[RosbridgeService] = []  # services to be advertised
        self._to_withdraw: list[RosbridgeService] = []  # services to be withdrawn
        self._change_task: asyncio.Task[None] | None = None
        self._pending_answers: dict[str, asyncio.Future[dict[str, Any]]] = {}
        self._handlers: dict[str, Callable[[dict[str, Any]], None]] = {
            "call_service": self._on_call,
            "publish": self._on_publish,
            "status": self._log_status,
            "service_response": self._on_response,
        }

    @property
    def is_open(self) -> bool:
        """True from ``start()`` until ``stop()``, with or without a bridge."""
        return self._link_task is not None

    @property
    def connected(self) -> bool:
        """True while the bridge is connected."""
        return self._link.connected

    @property
    def failure(self) -> str:
        """Reason why the bridge is not connected; "" if it is, or before the first attempt."""
        return self._link.failure

    async def wait_connected(self, timeout: float | None = None) -> None:
        """Wait until the bridge is connected.

        Raises:
            TimeoutError: the bridge was not connected within ``timeout`` seconds.
        """
        await self._wait(timeout, lambda: self._link.connected)

    async def wait_first_attempts(self) -> None:
        """Wait until the bridge is connected, or an attempt has failed."""
        await self._wait(None, lambda: self._link.connected or bool(self._link.failure))

    async def _wait(self, timeout: float | None, condition: Callable[[], bool]) -> None:
        async with asyncio.timeout(timeout), self._link.changed:
            await self._link.changed.wait_for(condition)

    # ------------------------------------------------------------------ life

    async def start(self) -> None:
        """Open the node."""
        if self._link_task is None:
            self._link_task = asyncio.create_task(self._link.run())

    async def stop(self) -> None:
        """Withdraw everything from the bridge, which takes some seconds. Idempotent."""
        link_task, self._link_task = self._link_task, None
        if link_task is None:
            return
        try:
            if self.connected:
                await self._withdraw_all()
        finally:
            link_task.cancel()
            await asyncio.wait((link_task,))
            await self._link.end_link()
            for subscription in [*self._subscriptions]:
                subscription.close()
            self._publishers.clear()
            self._services.clear()
            self._to_withdraw.clear()
            self._outbox = self._link.outbox = Outbox()

    async def _withdraw_all(self) -> None:
        with contextlib.suppress(TimeoutError):  # the bridge does not read
            async with asyncio.timeout(FLUSH_TIMEOUT):
                await self._outbox.wait_flushed()
        for service in tuple(self._services.values()):
            self.forget(service)
        while self._change_task is not None:
            await asyncio.wait((self._change_task,))

    # ------------------------------------------------------------------ topics and services

    def publisher(self, topic: str, type: str, *, qos: QoS = DEFAULT) -> RosbridgePublisher:
        """Publish on a topic.

        Args:
            topic: name of the topic: absolute, relative to the namespace, or private (``~/it``).
            type: type of the messages, such as ``std_msgs/msg/String``.
            qos: quality of service. Only ``depth`` (number of messages that may wait for the
                bridge) and ``latched`` have an effect.

        Raises:
            ConfigurationError: the topic is not valid, exists already, or there is no such type.
            RosError: the node is not open.
        """
        message_type, name = (
            self.types.message(type),
            self._resolve_new_name(topic, "topic", self._publishers),
        )
        publisher = self._publishers[name] = RosbridgePublisher(self, name, message_type, qos)
        if self._log_if_absent(publisher.has_ros1_type, name, message_type.name):
            self._outbox.add_queue(publisher.queue)
            self.send(encode_operation(publisher.advertise_operation()))
        return publisher

    def subscribe(self, topic: str, type: str, *, qos: QoS = DEFAULT) -> RosbridgeSubscription:
        """Subscribe to a topic.

        Args:
            topic: name of the topic, as of :meth:`publisher`.
            type: type of the messages, such as ``std_msgs/msg/String``.
            qos: quality of service; only ``depth`` has an effect: messages that wait for a reader.

        Raises:
            ConfigurationError: the topic is not valid, or there is no such type.
            RosError: the node is not open.
        """
        message_type, name = self.types.message(type), self._resolve_name(topic, "topic")
        subscription = RosbridgeSubscription(self, name, message_type, qos)
        if self._log_if_absent(subscription.has_ros1_type, name, message_type.name):
            self._subscriptions.append(subscription)
            subscription.send_subscribe()
        return subscription

    def serve(
        self,
        service: str,
        type: str,
        handler: Callable[[Any], Awaitable[Any]],
        *,
        qos: QoS = SERVICES,
        timeout: float = HANDLER_TIMEOUT,
    ) -> RosbridgeService:
        """Serve a service.

        Args:
            service: name of the service, resolved like a topic's name.
            type: type of the service, such as ``std_srvs/srv/Trigger``.
            handler: coroutine function that takes each request and returns the response, or a
                mapping of its fields. The text of an error becomes the response's field ``error``,
                ``message`` or ``status_message``; where the response has none of these fields, the
                call fails at its caller.
            qos: has no meaning in ROS 1.
            timeout: seconds of the handler's timeout.

        Raises:
            ConfigurationError: the name is not valid, exists already, or there is no such type.
            RosError: the node is not open.
        """
        service_type, name = (
            self.types.service(type),
            self._resolve_new_name(service, "service", self._services),
        )
        new_service = RosbridgeService(self, name, service_type, handler, timeout)
        self._services[name] = new_service
        if self._log_if_absent(new_service.has_ros1_type, name, service_type.name):
            self._to_advertise.append(new_service)
            self._schedule_changes()
        return new_service

    def _resolve_new_name(self, name: str, kind_text: str, existing: dict[str, Any]) -> str:
        absolute_name = self._resolve_name(name, kind_text)
        if absolute_name in existing:
            raise ConfigurationError(
                f"{self.full_name}: the {kind_text} {absolute_name} is there already"
            )
        return absolute_name

    def _log_if_absent(self, has_ros1_type: bool, name: str, type_name: str) -> bool:
        if not has_ros1_type:
            logger.info("%s: left out, ROS 1 has no %s", name, type_name)
        return has_ros1_type

    # ------------------------------------------------------------------ for publishers and services

    def has(self, endpoint: RosbridgePublisher | RosbridgeService) -> bool:
        """Return True if a publisher or service is not closed."""
        return endpoint in (self._publishers.get(endpoint.name), self._services.get(endpoint.name))

    def forget(self, endpoint: RosbridgePublisher | RosbridgeService) -> None:
        """Remove a closed publisher or service."""
        if not self.has(endpoint):
            return
        if isinstance(endpoint, RosbridgePublisher):
            del self._publishers[endpoint.name]
            if endpoint.has_ros1_type:
                self._outbox.remove_queue(endpoint.queue)
                self.send(encode_operation({"op": "unadvertise", "topic": endpoint.name}))
            return
        del self._services[endpoint.name]
        endpoint.discard_calls()
        if endpoint.has_ros1_type:
            self._to_withdraw.append(endpoint)
            self._schedule_changes()

    def forget_subscription(self, subscription: RosbridgeSubscription) -> None:
        """Remove a closed subscription."""
        if subscription in self._subscriptions:
            self._subscriptions.remove(subscription)
            subscription.send_unsubscribe()

    def renew(self, service: RosbridgeService) -> None:
        """Withdraw a service and advertise it again, so that its calls fail at their callers."""
        service.discard_calls()
        self._to_withdraw.append(service)
        self._to_advertise.append(service)
        self._schedule_changes()

    def send(self, parts: tuple[TextPart, ...]) -> None:
        """Send an operation, if the bridge is connected; a later bridge gets all advertisements."""
        if self.connected:
            self._outbox.add_operation(parts)

    def wake(self) -> None:
        """Wake the task that sends, since a message waits."""
        self._outbox.wake()

    def begin(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """Start a task that is cancelled when this bridge is lost."""
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    # ------------------------------------------------------------------ events of the link

    def on_connected(self) -> None:
        """Advertise everything to a new bridge."""
        self._report_change()
        for publisher in self._publishers.values():
            if publisher.has_ros1_type:
                self.send(encode_operation(publisher.advertise_operation()))
                publisher.queue.repeat_last()
        for subscription in self._subscriptions:
            subscription.send_subscribe()
        self.begin(self._repeat_latched())
        self.begin(listen_for_subscribers(self, self._publishers))
        self._to_advertise = [
            service for service in self._services.values() if service.has_ros1_type
        ]
        self._schedule_changes()

    def _report_change(self) -> None:
        try:
            self._on_change(self)
        except ENDS_PROGRAM:
            raise
        except BaseException:
            logger.exception("%s ! on_change failed", self.full_name)

    async def _repeat_latched(self) -> None:
        own_prefix = f"{self.full_name}/"
        while True:
            await asyncio.sleep(REPEAT_INTERVAL)
            for publisher in self._publishers.values():
                if publisher.has_ros1_type and not publisher.name.startswith(own_prefix):
                    publisher.queue.repeat_last()
                    self._outbox.wake()

    def _schedule_changes(self) -> None:
        """Start a task that withdraws and advertises services, unless one is running."""
        if (
            self.connected
            and self._change_task is None
            and (self._to_advertise or self._to_withdraw)
        ):
            self._change_task = self.begin(self._change_services())
            self._change_task.add_done_callback(self._on_changes_done)

    def _on_changes_done(self, task: asyncio.Task[None]) -> None:
        if self._change_task is task:
            self._change_task = None
            self._schedule_changes()

    async def _change_services(self) -> None:
        await asyncio.sleep(0)
        to_advertise, to_withdraw = self._to_advertise, [*self._to_withdraw]
        self._to_advertise = []
        await asyncio.gather(*(service.stop_calls() for service in to_withdraw))
        names = dict.fromkeys(service.name for service in (*to_withdraw, *to_advertise))
        await withdraw_services(self._link.url, list(names))
        if to_withdraw:  # aborted calls arrive before the answer to this call
            await self.ask(PROBED_SERVICE, {})
        self._to_withdraw = self._to_withdraw[len(to_withdraw) :]
        for service in to_advertise:
            service.advertise()

    async def ask(self, service: str, arguments: dict[str, Any]) -> dict[str, Any] | None:
        """Call a service of ROS 1; return the bridge's answer, None if none came in time.

        An answer comes after all earlier operations of the bridge.
        """
        request = make_call(service, arguments)
        answer: asyncio.Future[dict[str, Any]] = asyncio.get_running_loop().create_future()
        self._pending_answers[request["id"]] = answer
        try:
            async with asyncio.timeout(ASK_TIMEOUT):
                self.send(encode_operation(request))
                return await answer
        except TimeoutError:
            logger.warning("%s: the bridge does not answer a call of %s", self.full_name, service)
            return None
        finally:
            del self._pending_answers[request["id"]]

    def _on_response(self, operation: dict[str, Any]) -> None:
        answer = self._pending_answers.get(str(operation.get("id")))
        if answer is not None and not answer.done():
            answer.set_result(operation)

    def on_operation(self, operation: dict[str, Any]) -> None:
        """Handle an operation of the bridge."""
        handle = self._handlers.get(operation["op"])
        if handle is None:
            logger.debug("%s: from the bridge: %.200r", self.full_name, operation)
        else:
            handle(operation)

    async def on_lost(self, was_connected: bool) -> None:
        """End the calls and tasks of the lost bridge."""
        if self._link_task is not None and was_connected:
            self._report_change()
        for service in self._services.values():
            service.discard_calls()
        self._to_advertise, self._change_task = [], None
        tasks = [*self._tasks]
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks, timeout=CLOSE_TIMEOUT)

    def _on_call(self, operation: dict[str, Any]) -> None:
        name, identity = operation.get("service"), operation.get("id")
        if not isinstance(name, str) or not isinstance(identity, str | int | None):
            logger.warning("%s: expected a service call, got %.200r", self.full_name, operation)
            return
        service = self._services.get(name)
        if any(service.name == name for service in self._to_withdraw):
            return  # the call fails at its caller
        if service is None:
            logger.warning("%s: got a call of %.80r, which it does not serve", self.full_name, name)
            refusal = {"op": "service_response", "service": name, "id": identity, "result": False}
            self.send(encode_operation(refusal))
        elif service.is_advertised:  # otherwise the bridge aborts the call
            service.start_call(identity, operation.get("args"))

    def _on_publish(self, operation: dict[str, Any]) -> None:
        for subscription in self._subscriptions:
            if subscription.name == operation.get("topic"):
                subscription.on_message(operation.get("msg"))

    def _log_status(self, operation: dict[str, Any]) -> None:
        level = _LEVELS.get(str(operation.get("level")), logging.DEBUG)
        about = f" ({operation['id']})" if operation.get("id") else ""
        text = operation.get("msg")
        logger.log(level, "%s: the bridge says%s: %.500s", self.full_name, about, text)
