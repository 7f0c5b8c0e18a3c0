"""A node of ROS 1 through a rosbridge: it publishes, subscribes, and serves services."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from typing import TYPE_CHECKING, Any

from smartcam._user_code import ENDS_PROGRAM
from smartcam.backoff import Backoff
from smartcam.exceptions import ConfigurationError
from smartcam.ros1._json_messages import encoded
from smartcam.ros1._link import BridgeLink
from smartcam.ros1._outbox import Outbox
from smartcam.ros1._publishing import RosbridgePublisher
from smartcam.ros1._retiring import PROBED_SERVICE, question, retire
from smartcam.ros1._serving import CLOSE_TIMEOUT, RosbridgeService
from smartcam.ros1._subscribers import listen_for_subscribers
from smartcam.ros1._subscribing import RosbridgeSubscription
from smartcam.ros2 import QoS, RosTypes
from smartcam.ros2._inside import DEFAULT, HANDLER_TIMEOUT, SERVICES, NamedNode

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Coroutine

    from smartcam.ros1._json_messages import Part

logger: logging.Logger = logging.getLogger("smartcam.ros1")

FLUSH_TIMEOUT = 1.0
"""Seconds to send waiting operations at the end."""
ASK_TIMEOUT = 5.0
"""Seconds that the bridge may take to answer a call by smartcam."""
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
        self._running: asyncio.Task[None] | None = None
        self._tasks: set[asyncio.Task[None]] = set()  # tasks that end with the link
        self._new: list[RosbridgeService] = []  # services to be advertised
        self._leaving: list[RosbridgeService] = []  # services to be withdrawn
        self._changing: asyncio.Task[None] | None = None
        self._pending_answers: dict[str, asyncio.Future[dict[str, Any]]] = {}
        self._hears: dict[str, Callable[[dict[str, Any]], None]] = {
            "call_service": self._called,
            "publish": self._published,
            "status": self._log_status,
            "service_response": self._answered,
        }

    @property
    def is_open(self) -> bool:
        """True from ``start()`` until ``stop()``, with or without a bridge."""
        return self._running is not None

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

    async def _wait(self, timeout: float | None, met: Callable[[], bool]) -> None:
        async with asyncio.timeout(timeout), self._link.changed:
            await self._link.changed.wait_for(met)

    # ------------------------------------------------------------------ life

    async def start(self) -> None:
        """Open the node."""
        if self._running is None:
            self._running = asyncio.create_task(self._link.run())

    async def stop(self) -> None:
        """Withdraw everything from the bridge, which takes some seconds. Idempotent."""
        running, self._running = self._running, None
        if running is None:
            return
        try:
            if self.connected:
                await self._withdraw_all()
        finally:
            running.cancel()
            await asyncio.wait((running,))
            await self._link.end()
            for subscription in [*self._subscriptions]:
                subscription.close()
            self._publishers.clear()
            self._services.clear()
            self._leaving.clear()
            self._outbox = self._link.outbox = Outbox()

    async def _withdraw_all(self) -> None:
        with contextlib.suppress(TimeoutError):  # the bridge does not read
            async with asyncio.timeout(FLUSH_TIMEOUT):
                await self._outbox.flushed()
        for service in tuple(self._services.values()):
            self.forget(service)
        while self._changing is not None:
            await asyncio.wait((self._changing,))

    # ------------------------------------------------------------------ topics and services

    def publisher(self, topic: str, type: str, *, qos: QoS = DEFAULT) -> RosbridgePublisher:
        """Publish on a topic.

        Args:
            topic: name of the topic: absolute, relative to the namespace, or private (``~/it``).
            type: type of the messages, such as ``std_msgs/msg/String``.
            qos: quality of service, of which ``depth``, for messages that wait for the bridge, and
                ``latched`` count.

        Raises:
            ConfigurationError: the topic is not valid, exists already, or there is no such type.
            RosError: the node is not open.
        """
        kind, name = self.types.message(type), self._new_name(topic, "topic", self._publishers)
        publisher = self._publishers[name] = RosbridgePublisher(self, name, kind, qos)
        if self._log_if_absent(publisher.exists, name, kind.name):
            self._outbox.add(publisher.lane)
            self.send(encoded(publisher.advertisement()))
        return publisher

    def subscribe(self, topic: str, type: str, *, qos: QoS = DEFAULT) -> RosbridgeSubscription:
        """Subscribe to a topic.

        Args:
            topic: name of the topic, as of :meth:`publisher`.
            type: type of the messages, such as ``std_msgs/msg/String``.
            qos: quality of service, of which ``depth`` counts, for messages that wait for a reader.

        Raises:
            ConfigurationError: the topic is not valid, or there is no such type.
            RosError: the node is not open.
        """
        kind, name = self.types.message(type), self._resolved(topic, "topic")
        subscription = RosbridgeSubscription(self, name, kind, qos)
        if self._log_if_absent(subscription.exists, name, kind.name):
            self._subscriptions.append(subscription)
            subscription.ask()
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
        kind, name = self.types.service(type), self._new_name(service, "service", self._services)
        served = RosbridgeService(self, name, kind, handler, timeout)
        self._services[name] = served
        if self._log_if_absent(served.exists, name, kind.name):
            self._new.append(served)
            self._change()
        return served

    def _new_name(self, name: str, kind_text: str, existing: dict[str, Any]) -> str:
        full = self._resolved(name, kind_text)
        if full in existing:
            raise ConfigurationError(f"{self.full_name}: the {kind_text} {full} is there already")
        return full

    def _log_if_absent(self, exists: bool, name: str, kind: str) -> bool:
        if not exists:
            logger.info("%s: left out, ROS 1 has no %s", name, kind)
        return exists

    # ------------------------------------------------------------------ for its parts

    def has(self, end: RosbridgePublisher | RosbridgeService) -> bool:
        """Return True if the end is not closed."""
        return end in (self._publishers.get(end.name), self._services.get(end.name))

    def forget(self, end: RosbridgePublisher | RosbridgeService) -> None:
        """Remove a closed publisher or service."""
        if not self.has(end):
            return
        if isinstance(end, RosbridgePublisher):
            del self._publishers[end.name]
            if end.exists:
                self._outbox.remove(end.lane)
                self.send(encoded({"op": "unadvertise", "topic": end.name}))
            return
        del self._services[end.name]
        end.end_turn()
        if end.exists:
            self._leaving.append(end)
            self._change()

    def forget_subscription(self, subscription: RosbridgeSubscription) -> None:
        """Remove a closed subscription."""
        if subscription in self._subscriptions:
            self._subscriptions.remove(subscription)
            subscription.leave()

    def renew(self, service: RosbridgeService) -> None:
        """Withdraw a service and advertise it again, so that its calls fail at their callers."""
        service.end_turn()
        self._leaving.append(service)
        self._new.append(service)
        self._change()

    def send(self, parts: tuple[Part, ...]) -> None:
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
            if publisher.exists:
                self.send(encoded(publisher.advertisement()))
                publisher.lane.repeat()
        for subscription in self._subscriptions:
            subscription.ask()
        self.begin(self._repeat_shared())
        self.begin(listen_for_subscribers(self, self._publishers))
        self._new = [service for service in self._services.values() if service.exists]
        self._change()

    def _report_change(self) -> None:
        try:
            self._on_change(self)
        except ENDS_PROGRAM:
            raise
        except BaseException:
            logger.exception("%s ! on_change failed", self.full_name)

    async def _repeat_shared(self) -> None:
        within = f"{self.full_name}/"
        while True:
            await asyncio.sleep(REPEAT_INTERVAL)
            for publisher in self._publishers.values():
                if publisher.exists and not publisher.name.startswith(within):
                    publisher.lane.repeat()
                    self._outbox.wake()

    def _change(self) -> None:
        """Start to withdraw and advertise services, in one task for all of a turn of the loop."""
        if self.connected and self._changing is None and (self._new or self._leaving):
            self._changing = self.begin(self._change_services())
            self._changing.add_done_callback(self._changed)

    def _changed(self, task: asyncio.Task[None]) -> None:
        if self._changing is task:
            self._changing = None
            self._change()

    async def _change_services(self) -> None:
        await asyncio.sleep(0)
        new, leaving = self._new, [*self._leaving]
        self._new = []
        await asyncio.gather(*(service.still() for service in leaving))
        names = dict.fromkeys(service.name for service in (*leaving, *new))
        await retire(self._link.url, list(names))
        if leaving:  # first handle calls that the bridge has aborted
            await self.ask(PROBED_SERVICE, {})
        self._leaving = self._leaving[len(leaving) :]
        for service in new:
            service.advertise()

    async def ask(self, service: str, arguments: dict[str, Any]) -> dict[str, Any] | None:
        """Call a service of ROS 1; return the bridge's answer, None without one in time.

        Earlier operations of the bridge have been handled by then.
        """
        request = question(service, arguments)
        answer: asyncio.Future[dict[str, Any]] = asyncio.get_running_loop().create_future()
        self._pending_answers[request["id"]] = answer
        try:
            async with asyncio.timeout(ASK_TIMEOUT):
                self.send(encoded(request))
                return await answer
        except TimeoutError:
            logger.warning("%s: the bridge does not answer a call of %s", self.full_name, service)
            return None
        finally:
            del self._pending_answers[request["id"]]

    def _answered(self, operation: dict[str, Any]) -> None:
        answer = self._pending_answers.get(str(operation.get("id")))
        if answer is not None and not answer.done():
            answer.set_result(operation)

    def on_operation(self, operation: dict[str, Any]) -> None:
        """Handle an operation of the bridge."""
        hear = self._hears.get(operation["op"])
        if hear is None:
            logger.debug("%s: from the bridge: %.200r", self.full_name, operation)
        else:
            hear(operation)

    async def on_lost(self, was: bool) -> None:
        """End calls and tasks for a lost bridge."""
        if self._running is not None and was:
            self._report_change()
        for service in self._services.values():
            service.end_turn()
        self._new, self._changing = [], None
        tasks = [*self._tasks]
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks, timeout=CLOSE_TIMEOUT)

    def _called(self, operation: dict[str, Any]) -> None:
        name, identity = operation.get("service"), operation.get("id")
        if not isinstance(name, str) or not isinstance(identity, str | int | None):
            logger.warning("%s: no call: %.200r", self.full_name, operation)
            return
        service = self._services.get(name)
        if any(left.name == name for left in self._leaving):
            return  # the call fails at its caller
        if service is None:
            logger.warning("%s ! called %.80r, which it does not serve", self.full_name, name)
            refusal = {"op": "service_response", "service": name, "id": identity, "result": False}
            self.send(encoded(refusal))
        elif service.ready:  # otherwise the bridge aborts the call
            service.call(identity, operation.get("args"))

    def _published(self, operation: dict[str, Any]) -> None:
        for subscription in self._subscriptions:
            if subscription.name == operation.get("topic"):
                subscription.take(operation.get("msg"))

    def _log_status(self, operation: dict[str, Any]) -> None:
        level = _LEVELS.get(str(operation.get("level")), logging.DEBUG)
        about = f" ({operation['id']})" if operation.get("id") else ""
        text = operation.get("msg")
        logger.log(level, "%s: the bridge says%s: %.500s", self.full_name, about, text)
