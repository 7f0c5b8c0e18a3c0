"""The context that the nodes of a process share: a session of Zenoh, a domain, and its graph."""

from __future__ import annotations

import collections
import itertools
import logging
import os
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

from smartcam._ros_names import check_domain
from smartcam._zenoh import BusLink, ZenohSession, quietly
from smartcam.exceptions import ConfigurationError
from smartcam.ros2._node.graph import OPPOSITE_KIND, RosGraph
from smartcam.ros2._types.types import RosTypes

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from smartcam.ros2._node.tokens import Entity

logger: logging.Logger = logging.getLogger("smartcam.ros2")

ROUTER = "tcp/localhost:7447"
"""Endpoint of the router of rmw_zenoh's nodes (``DEFAULT_RMW_ZENOH_SESSION_CONFIG.json5``)."""

SETTINGS: Mapping[str, Any] = {
    # publishers of latched topics keep only messages with a timestamp
    "timestamping/enabled": {"router": True, "peer": True, "client": True},
    # nodes of rmw_zenoh are peers, and learn of each other from their router
    "scouting/gossip/enabled": True,
}
"""Settings of a Zenoh session for ROS nodes, as in the sessions of rmw_zenoh."""


CALM_TIME, MAX_DIRECT_MESSAGES = 0.5, 8
"""The event loop passes at most ``MAX_DIRECT_MESSAGES`` to Zenoh in ``CALM_TIME`` seconds; a
thread, which can wait for room, passes all others. Zenoh's queue has room for 16 messages and
silently drops further ones while its own thread gets no processor or the link takes no data. With
0.01 s, 3 of 4 bursts of 1000 results lost some on a busy machine; with 0.5 s, none of 8."""

PRIORITIES = ("DATA_LOW", "BACKGROUND", "DATA")
"""Priorities for long messages of which only the newest is needed. On each link Zenoh sends
one message of a priority at a time. Topics get the priorities in turn, so that the two pictures of
a pair do not wait for each other."""

MESSAGE_PAUSE, LINK_BYTES_PER_SECOND = 0.002, 5e8
"""Seconds, and bytes per second: the assumed time of a healthy link for one long message."""


class NewestLane:
    """A thread, and a priority, for long messages of which only the newest is needed.

    Attributes:
        thread_name: name of the thread.
        priority: name of Zenoh's priority.
    """

    def __init__(self, priority: str) -> None:
        self.thread_name: str = f"newest-{priority.lower()}"
        self.priority: str = priority
        self._next_send_at = 0.0

    def wait_for_link(self, size: int) -> None:
        """Wait for the time of the previous message; count ``size`` bytes for the next call."""
        time.sleep(max(0.0, self._next_send_at - time.monotonic()))
        self._next_send_at = time.monotonic() + MESSAGE_PAUSE + size / LINK_BYTES_PER_SECOND


class RosContext:
    """The context that nodes share, opened by the first node.

    Args:
        session: open session of Zenoh, which stays open; None for an own session.
        connect: endpoints that an own session connects to, if it does not listen.
        listen: endpoints that an own session listens on, which makes it the router.
        domain: number of the domain; None for the value of the variable ``ROS_DOMAIN_ID``, or 0.
        distribution: name of the ROS distribution whose messages and type hashes are used.

    Raises:
        ConfigurationError: there is no such domain or distribution.
        MissingExtraError: the extra ``ros2`` is not installed.
    """

    def __init__(
        self,
        session: ZenohSession | None = None,
        *,
        connect: str | Sequence[str] = ROUTER,
        listen: str | Sequence[str] = (),
        domain: int | None = None,
        distribution: str = "jazzy",
    ) -> None:
        self.domain: int = check_domain(_domain_of_environment() if domain is None else domain)
        self.types: RosTypes = RosTypes(distribution)
        self._owns_session = session is None
        if session is None:
            listen_endpoints = _as_tuple(listen)
            link = BusLink(listen_endpoints, () if listen_endpoints else _as_tuple(connect))
            session = ZenohSession(link, SETTINGS, bus_name="ROS 2")
        self.zenoh: ZenohSession = session
        self.graph: RosGraph = RosGraph(self.domain)
        self.zid: str = ""
        self._users = 0
        self._last_id = 0
        self._endpoints: dict[tuple[str, str], list[Entity]] = {}
        self._watchers: dict[tuple[str, str], list[Callable[[Entity, bool], None]]] = {}
        self._lock = threading.Lock()
        self._threads: dict[str, ThreadPoolExecutor] = {}
        self._waiting_by_owner: collections.Counter[object] = collections.Counter()
        self._waiting_by_thread: collections.Counter[str] = collections.Counter()
        self._interval_started_at, self._direct_messages, self._last_thread_send_at = 0.0, 0, 0.0
        self._lanes = itertools.cycle(NewestLane(priority) for priority in PRIORITIES)
        self._stop_listening: Callable[[], None] = _nothing

    async def open(self, timeout: float) -> None:
        """Open the session, unless another node has opened it.

        Raises:
            ConnectFailedError: there is no router within ``timeout`` seconds.
        """
        self._users += 1
        if self._users > 1:
            return
        try:
            if self._owns_session:
                await self.zenoh.open(timeout)
            self.zid = str(self.zenoh.session.info.zid())
            self.graph.open(self.zenoh)
        except BaseException:
            self._users -= 1
            raise
        self._stop_listening = self.graph.listen(self._on_entity)

    async def close(self) -> None:
        """Release the context for a node; the last one closes an own session."""
        self._users -= 1
        if self._users:
            return
        self._stop_listening()
        self._stop_listening = _nothing
        self.graph.close()
        for thread in self._threads.values():
            thread.shutdown(wait=False)  # waiting jobs find the session closed, and end
        self._threads.clear()
        if self._owns_session:
            await self.zenoh.close()

    def next_id(self) -> int:
        """Return a number that is unique in this session."""
        self._last_id += 1
        return self._last_id

    # ------------------------------------------------------------------ incompatible endpoints

    def add_endpoint(self, entity: Entity) -> None:
        """Add an endpoint of this process, and log endpoints that are incompatible with it."""
        self._endpoints.setdefault((entity.name, entity.kind), []).append(entity)
        for other in self.graph.endpoints(entity.name, OPPOSITE_KIND[entity.kind]):
            self._warn_if_incompatible(entity, other)

    def remove_endpoint(self, entity: Entity) -> None:
        """Remove a closed endpoint."""
        endpoints = self._endpoints.get((entity.name, entity.kind), [])
        if entity in endpoints:
            endpoints.remove(entity)
        if not endpoints:
            self._endpoints.pop((entity.name, entity.kind), None)

    def watch_endpoints(
        self, name: str, kind: str, watcher: Callable[[Entity, bool], None]
    ) -> Callable[[], None]:
        """Call ``watcher(entity, present)`` for each endpoint that comes or goes from now on.

        Args:
            name: name of the topic or service.
            kind: kind of the endpoints.
            watcher: function that is called in the event loop.

        Returns:
            A function that ends this.
        """
        watchers = self._watchers.setdefault((name, kind), [])
        watchers.append(watcher)

        def stop_watching() -> None:
            watchers.remove(watcher)
            if not watchers and self._watchers.get((name, kind)) is watchers:
                del self._watchers[name, kind]

        return stop_watching

    def _on_entity(self, other: Entity, present: bool) -> None:
        for watcher in tuple(self._watchers.get((other.name, other.kind), ())):
            watcher(other, present)
        if present and other.kind in OPPOSITE_KIND:
            for endpoint in self._endpoints.get((other.name, OPPOSITE_KIND[other.kind]), ()):
                self._warn_if_incompatible(endpoint, other)

    def _warn_if_incompatible(self, one: Entity, other: Entity) -> None:
        if (one.type, one.hash) != (other.type, other.hash):
            logger.warning(
                "%s of %s is %s %s here, but %s of %s has %s %s: they do not hear each other",
                one.name,
                one.full_node,
                one.ros_type,
                one.hash,
                other.kind,
                other.full_node,
                other.ros_type,
                other.hash,
            )

    # ------------------------------------------------------------------ waiting messages

    def next_lane(self) -> NewestLane:
        """Return a lane for one more topic of which only the newest message is needed."""
        return next(self._lanes)

    def has_waiting(self, owner: object) -> bool:
        """Return True if messages of an owner wait to be sent."""
        return bool(self._waiting_by_owner[owner])

    def allow_direct_send(self) -> bool:
        """Return True, and count the message, if the event loop may pass it to Zenoh."""
        now = time.monotonic()
        if self._waiting_by_thread["short"] or now - self._last_thread_send_at < CALM_TIME:
            # Zenoh's queue may be full: sending would wait for room, and block the event loop
            return False
        if now - self._interval_started_at > CALM_TIME:
            self._interval_started_at, self._direct_messages = now, 0
        self._direct_messages += 1
        return self._direct_messages <= MAX_DIRECT_MESSAGES

    def send_in_thread(self, owner: object, send: Callable[[], None], thread_name: str) -> None:
        """Call ``send`` in the context's thread of this name, where it may wait for room."""
        thread = self._threads.get(thread_name)
        if thread is None:
            thread = self._threads[thread_name] = ThreadPoolExecutor(
                1, f"smartcam-ros2-{thread_name}"
            )
        with self._lock:
            self._waiting_by_owner[owner] += 1
            self._waiting_by_thread[thread_name] += 1
        thread.submit(quietly, send).add_done_callback(lambda _: self._on_sent(owner, thread_name))

    def _on_sent(self, owner: object, thread_name: str) -> None:
        with self._lock:
            self._waiting_by_thread[thread_name] -= 1
            if thread_name == "short":
                self._last_thread_send_at = time.monotonic()
            self._waiting_by_owner[owner] -= 1
            if not self._waiting_by_owner[owner]:
                del self._waiting_by_owner[owner]


def _domain_of_environment() -> int:
    text = os.environ.get("ROS_DOMAIN_ID", "").strip()
    if not text:
        return 0
    if not text.isdecimal():
        raise ConfigurationError(f"ROS_DOMAIN_ID is {text!r:.40}: expected a number from 0")
    return int(text)


def _as_tuple(value: str | Sequence[str]) -> tuple[str, ...]:
    return (value,) if isinstance(value, str) else tuple(value)


def _nothing() -> None:
    pass
