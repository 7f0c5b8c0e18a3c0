"""A node of ROS 1 behind a rosbridge: it publishes topics and serves services."""

from __future__ import annotations

import asyncio
import logging
import re
from typing import TYPE_CHECKING, Any

from smartcam.backoff import Backoff
from smartcam.exceptions import ConfigurationError
from smartcam.ros1._calls import RosbridgeService
from smartcam.ros1._json_messages import encoded, ros1_name, to_json
from smartcam.ros1._link import BridgeLink
from smartcam.ros1._outbox import Lane, Outbox
from smartcam.ros1._retiring import retire
from smartcam.ros2._types import RosTypes

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Coroutine, Iterable
    from typing import Self

    from smartcam.ros1._json_messages import Part
    from smartcam.ros2._types import MessageType

logger: logging.Logger = logging.getLogger("smartcam.ros1")

FLUSH = 1.0
"""Seconds at the end for what waits to be sent."""
MOST_CALLS = 64
"""That are carried out for a node at the same time; the next is refused."""
_NAME = re.compile(r"[A-Za-z]\w*", re.ASCII)
_LEVELS = {"error": logging.ERROR, "warning": logging.WARNING, "info": logging.INFO}


class RosbridgePublisher:
    """A topic that a node publishes.

    Attributes:
        topic: its full name.
        type: what its messages are.
    """

    def __init__(self, node: RosbridgeNode, topic: str, kind: MessageType, lane: Lane) -> None:
        self.topic, self.type, self.lane = topic, kind, lane
        self._node = node

    @property
    def dropped(self) -> int:
        """Messages that were not sent: there was no bridge, or newer ones came."""
        return self.lane.dropped

    @property
    def sent(self) -> int:
        """Messages that were sent to the bridge; it does not say what became of them."""
        return self.lane.sent

    def publish(self, message: Any = None, /, **fields: Any) -> None:
        """Publish a message, or the one of these fields; never waits.

        Raises:
            RosMessageError: it is none of this topic's type.
        """
        if message is None:
            message = self.type.new(**fields)
        said: dict[str, Any] = {"op": "publish", "topic": self.topic}
        said["msg"] = to_json(self.type, message)
        if self.lane.latched:
            said["latch"] = True  # or the bridge takes it for another publisher
        self._node._put(self, encoded(said))  # noqa: SLF001 - its own

    def close(self) -> None:
        """Stop publishing; what waits is not sent. Idempotent."""
        self._node._forget_publisher(self)  # noqa: SLF001

    def advertisement(self) -> dict[str, Any]:
        """Return how a bridge is told."""
        told = {"op": "advertise", "topic": self.topic, "type": ros1_name(self.type.name)}
        return told | {"latch": self.lane.latched}


class RosbridgeNode:
    """A node of ROS 1 in asyncio, over a rosbridge: ``async with RosbridgeNode(...) as node``.

    Opening it does not wait for the bridge: it is tried until it is there, and again when it is
    lost. What is advertised is advertised again then, and the last message of latched topics is
    published again; other messages that are published without a bridge are dropped and counted.
    A call that is under way when the bridge goes ends.

    The protocol has no answer to an advertisement. That the bridge has the type (its machine must
    have the package) shows in the bridge's log, and in ``rostopic info``.

    Args:
        name: the node's name.
        namespace: where it is.
        bridge: the bridge's URL, ``ws://host:9090``.
        types: the messages and services that are known; None for those of ROS 2 Jazzy.
        backoff: when a bridge is tried again.

    Raises:
        ConfigurationError: a name, or the URL, cannot work.
    """

    def __init__(
        self,
        name: str,
        namespace: str = "/",
        *,
        bridge: str,
        types: RosTypes | None = None,
        backoff: Backoff | None = None,
    ) -> None:
        self.namespace = _full_name(namespace, "/")
        self.name = _full_name(name, self.namespace)
        self.types = types or RosTypes()
        self._outbox = Outbox()
        self._link = BridgeLink(bridge, self._outbox, self, backoff or Backoff())
        self._publishers: dict[str, RosbridgePublisher] = {}
        self._services: dict[str, RosbridgeService] = {}
        self._running: asyncio.Task[None] | None = None
        self._tasks: set[asyncio.Task[None]] = set()  # that live as long as a link
        self._new: list[RosbridgeService] = []  # that are to be advertised
        self._heard: dict[str, Callable[[dict[str, Any]], None]] = {
            "call_service": self._called,
            "status": self._told,
        }

    @property
    def connected(self) -> bool:
        """Whether the bridge is there."""
        return self._link.connected

    @property
    def failure(self) -> str:
        """Why the bridge is not there."""
        return self._link.failure

    async def wait_connected(self, timeout: float | None = None) -> None:
        """Wait until the bridge is there.

        Raises:
            TimeoutError: it was not within ``timeout`` seconds.
        """
        async with asyncio.timeout(timeout), self._link.changed:
            await self._link.changed.wait_for(lambda: self._link.connected)

    async def __aenter__(self) -> Self:
        if self._running is not None:
            raise ConfigurationError(f"{self.name}: it was opened already")
        self._running = asyncio.create_task(self._link.run())
        return self

    async def __aexit__(self, *_: object) -> None:
        """Withdraw everything from the bridge, within seconds."""
        running, self._running = self._running, None
        if running is None:
            return
        try:
            if self.connected:
                await self._withdraw_all()
        finally:
            running.cancel()
            await asyncio.wait((running,))
            await self.lost()

    async def _withdraw_all(self) -> None:
        try:
            async with asyncio.timeout(FLUSH):
                await self._outbox.flushed()
        except TimeoutError:
            pass  # it does not read
        await asyncio.gather(*(one.still() for one in self._services.values()))
        await retire(self._link.url, [*self._services])

    # ------------------------------------------------------------------ what it has

    def publisher(
        self, topic: str, type: str, *, depth: int = 5, latched: bool = False  # noqa: A002
    ) -> RosbridgePublisher:
        """Publish on a topic.

        Args:
            topic: its name: relative to the namespace, ``/absolute`` or ``~/private``.
            type: what is published, ``std_msgs/msg/String``.
            depth: messages that may wait for the bridge; beyond that the oldest goes.
            latched: who subscribes later gets the last message.

        Raises:
            ConfigurationError: no such type, also in ROS 1; no such name; or there is one already.
        """
        kind, name = self.types.message(type), self.resolve(topic)
        self._check(name, kind.name, self._publishers)
        lane = Lane(depth, latched=latched)
        publisher = self._publishers[name] = RosbridgePublisher(self, name, kind, lane)
        self._outbox.add(lane)
        self._say(publisher.advertisement())
        return publisher

    def serve(
        self, service: str, type: str, handler: Callable[[Any], Awaitable[Any]]  # noqa: A002
    ) -> RosbridgeService:
        """Serve a service.

        Args:
            service: its name, as a topic's.
            type: what it takes and gives, ``std_srvs/srv/Trigger``.
            handler: gets the request and returns the response. What it raises becomes the
                response's text field for errors (``error``, ``message``, ``status_message``). Where
                it has none the call fails at the caller.

        Raises:
            ConfigurationError: as for :meth:`publisher`.
        """
        kind, name = self.types.service(type), self.resolve(service)
        self._check(name, kind.name, self._services)
        served = self._services[name] = RosbridgeService(self, name, kind, handler)
        self._advertise([served])
        return served

    def resolve(self, name: str) -> str:
        """Return the full name of a topic or service of this node.

        Raises:
            ConfigurationError: it is none.
        """
        if name.startswith("~"):
            return _full_name(name[1:].removeprefix("/"), self.name)
        return _full_name(name, self.namespace)

    def _check(self, name: str, kind: str, there: dict[str, Any]) -> None:
        if name in there:
            raise ConfigurationError(f"{self.name}: {name} is there already")
        if ros1_name(kind) is None:
            raise ConfigurationError(f"{self.name}: {name}: ROS 1 has no type {kind}")

    # ------------------------------------------------------------------ for its parts

    def _put(self, publisher: RosbridgePublisher, parts: tuple[Part, ...]) -> None:
        if self._publishers.get(publisher.topic) is not publisher:
            raise ConfigurationError(f"{publisher.topic}: it is closed")
        publisher.lane.put(parts, connected=self.connected)
        self._outbox.wake()

    def _forget_publisher(self, publisher: RosbridgePublisher) -> None:
        if self._publishers.get(publisher.topic) is publisher:
            del self._publishers[publisher.topic]
            self._outbox.remove(publisher.lane)
            self._say({"op": "unadvertise", "topic": publisher.topic})

    def _forget_service(self, service: RosbridgeService) -> None:
        if self._services.get(service.service) is service:
            del self._services[service.service]
            if self.connected:
                self._start(service.withdraw())

    def _say(self, operation: dict[str, Any]) -> None:
        """Say something to the bridge that is there now; the next one hears it otherwise."""
        if self.connected:
            self._outbox.say(encoded(operation))

    def _start(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """Have something done as long as this bridge is there."""
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    # ------------------------------------------------------------------ what the link tells

    def came(self) -> None:
        """Advertise everything to a new bridge."""
        for publisher in self._publishers.values():
            self._outbox.say(encoded(publisher.advertisement()))
            publisher.lane.say_again()
        self._outbox.wake()
        self._advertise(self._services.values())

    def _advertise(self, services: Iterable[RosbridgeService]) -> None:
        """Have services advertised, all at once that are new in this turn of the loop."""
        if self.connected:
            begun = bool(self._new)
            self._new += services
            if not begun and self._new:
                self._start(self._advertise_new())

    async def _advertise_new(self) -> None:
        while self._new:
            await asyncio.sleep(0)
            new, self._new = self._new, []
            await retire(self._link.url, [one.service for one in new])
            for service in new:
                if self._services.get(service.service) is service:
                    service.advertise()

    def heard(self, operation: dict[str, Any]) -> None:
        """Do what the bridge says."""
        heard = self._heard.get(operation["op"])
        if heard is None:
            logger.debug("%s: from the bridge: %.200r", self.name, operation)
        else:
            heard(operation)

    async def lost(self) -> None:
        """End what was under way for a bridge that is gone."""
        self._new.clear()
        for service in self._services.values():
            service.ready = False
        tasks = [*self._tasks]
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks)

    def _called(self, operation: dict[str, Any]) -> None:
        name, identity = operation.get("service"), operation.get("id")
        service = self._services.get(name) if isinstance(name, str) else None
        if service is None:
            logger.warning("%s: the bridge calls %.80r, which is not served", self.name, name)
            self._say({"op": "service_response", "service": name, "id": identity, "result": False})
        elif service.ready:  # or it is a call that the bridge has aborted
            service.call(identity, operation.get("args"), busy=len(self._tasks) >= MOST_CALLS)

    def _told(self, operation: dict[str, Any]) -> None:
        level = _LEVELS.get(str(operation.get("level")), logging.DEBUG)
        about = f" ({operation['id']})" if operation.get("id") else ""
        logger.log(level, "%s: the bridge%s: %.500s", self.name, about, operation.get("msg"))


def _full_name(name: str, within: str) -> str:
    """Return a full name.

    Raises:
        ConfigurationError: it is none.
    """
    parts = [one for one in name.split("/") if one]
    if not all(map(_NAME.fullmatch, parts)) or (not parts and within != "/"):
        raise ConfigurationError(
            f"no name in ROS: expected parts of letters, digits and _, got {name!r:.80}"
        )
    before = "" if name.startswith("/") or within == "/" else within
    return "/".join([before, *parts]) if parts else "/"
