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
from smartcam.ros2._node.graph import OTHER_END, RosGraph
from smartcam.ros2._types.types import RosTypes

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from smartcam.ros2._node.tokens import Entity

logger: logging.Logger = logging.getLogger("smartcam.ros2")

ROUTER = "tcp/localhost:7447"
"""Endpoint of the router of rmw_zenoh's nodes (``DEFAULT_RMW_ZENOH_SESSION_CONFIG.json5``)."""

SETTINGS: Mapping[str, Any] = {
    # publishers of latched topics keep messages by their times
    "timestamping/enabled": {"router": True, "peer": True, "client": True},
    # nodes of rmw_zenoh are peers, and learn of each other from their router
    "scouting/gossip/enabled": True,
}
"""Settings of a Zenoh session for ROS nodes, as in the sessions of rmw_zenoh."""


CALM, MAX_DIRECT = 0.5, 8
"""Seconds, and messages that the event loop passes to the engine itself in that time. The engine's
queue has room for 16 and drops the rest silently while its own thread gets no processor or the link
takes no data. A thread, which waits for room, passes all others: with 0.01 s, 3 of 4 bursts of 1000
results lost some on a machine that kept the engine's thread waiting; with 0.5 s, none of 8."""

PRIORITIES = ("DATA_LOW", "BACKGROUND", "DATA")
"""Priorities of long messages of which only the newest is needed. The engine sends one message of
each priority and link at a time; topics use the priorities in turn, so that the two pictures of a
pair do not wait for each other."""

PAUSE, RATE = 0.002, 5e8
"""Seconds, and bytes per second: the time that a healthy link needs for one long message."""


class NewestSlot:
    """A thread, and a priority, for long messages of which only the newest is needed.

    Attributes:
        lane: name of the thread.
        priority: name of the engine's priority.
    """

    def __init__(self, priority: str) -> None:
        self.lane: str = f"newest-{priority.lower()}"
        self.priority: str = priority
        self._free = 0.0

    def wait(self, size: int) -> None:
        """Wait until the previous message should be sent; ``size`` bytes come now."""
        time.sleep(max(0.0, self._free - time.monotonic()))
        self._free = time.monotonic() + PAUSE + size / RATE


class RosContext:
    """The context that nodes share, opened by the first node.

    Args:
        session: open session of Zenoh, which stays open; None for an own session.
        connect: endpoints that an own session connects to.
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
        self.domain: int = check_domain(_environments() if domain is None else domain)
        self.types: RosTypes = RosTypes(distribution)
        self._owns = session is None
        if session is None:
            listening = _endpoints(listen)
            link = BusLink(listening, () if listening else _endpoints(connect))
            session = ZenohSession(link, SETTINGS, bus_name="ROS 2")
        self.zenoh: ZenohSession = session
        self.graph: RosGraph = RosGraph(self.domain)
        self.zid: str = ""
        self._users = 0
        self._numbers = 0
        self._ends: dict[tuple[str, str], list[Entity]] = {}
        self._watchers: dict[tuple[str, str], list[Callable[[Entity, bool], None]]] = {}
        self._lock = threading.Lock()
        self._threads: dict[str, ThreadPoolExecutor] = {}
        self._long: collections.Counter[object] = collections.Counter()
        self._in_lane: collections.Counter[str] = collections.Counter()
        self._calm_since, self._direct_messages, self._crowded = 0.0, 0, 0.0
        self._slots = itertools.cycle(NewestSlot(priority) for priority in PRIORITIES)
        self._stop_listening: Callable[[], None] = _nothing

    async def open(self, timeout: float) -> None:
        """Open the session, if no node has done so.

        Raises:
            ConnectFailedError: there is no router within ``timeout`` seconds.
        """
        self._users += 1
        if self._users > 1:
            return
        try:
            if self._owns:
                await self.zenoh.open(timeout)
            self.zid = str(self.zenoh.session.info.zid())
            self.graph.open(self.zenoh)
        except BaseException:
            self._users -= 1
            raise
        self._stop_listening = self.graph.listen(self._compare)

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
        if self._owns:
            await self.zenoh.close()

    def next_id(self) -> int:
        """Return a number that is unique in this session."""
        self._numbers += 1
        return self._numbers

    # ------------------------------------------------------------------ incompatible endpoints

    def add(self, entity: Entity) -> None:
        """Add an endpoint of this process; log incompatible endpoints."""
        self._ends.setdefault((entity.name, entity.kind), []).append(entity)
        for other in self.graph.ends(entity.name, OTHER_END[entity.kind]):
            self._differ(entity, other)

    def remove(self, entity: Entity) -> None:
        """Remove a closed endpoint."""
        ends = self._ends.get((entity.name, entity.kind), [])
        if entity in ends:
            ends.remove(entity)
        if not ends:
            self._ends.pop((entity.name, entity.kind), None)

    def watch(
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

        def end() -> None:
            watchers.remove(watcher)
            if not watchers and self._watchers.get((name, kind)) is watchers:
                del self._watchers[name, kind]

        return end

    def _compare(self, other: Entity, present: bool) -> None:
        for watcher in tuple(self._watchers.get((other.name, other.kind), ())):
            watcher(other, present)
        if present and other.kind in OTHER_END:
            for end in self._ends.get((other.name, OTHER_END[other.kind]), ()):
                self._differ(end, other)

    def _differ(self, one: Entity, other: Entity) -> None:
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

    def slot(self) -> NewestSlot:
        """Return the slot of a further topic of which only the newest message is needed."""
        return next(self._slots)

    def waits(self, owner: object) -> bool:
        """Return True if messages of an owner wait to be sent."""
        return bool(self._long[owner])

    def calm(self) -> bool:
        """Return True if the event loop may pass one more short message to the engine."""
        now = time.monotonic()
        if self._in_lane["short"] or now - self._crowded < CALM:
            # the thread may wait in the engine, and would block the loop, too; and the engine has
            # just been full
            return False
        if now - self._calm_since > CALM:
            self._calm_since, self._direct_messages = now, 0
        self._direct_messages += 1
        return self._direct_messages <= MAX_DIRECT

    def send_later(self, owner: object, send: Callable[[], None], lane: str) -> None:
        """Call ``send`` in the thread of a lane, where it may wait for room; in order."""
        thread = self._threads.get(lane)
        if thread is None:
            thread = self._threads[lane] = ThreadPoolExecutor(1, f"smartcam-ros2-{lane}")
        with self._lock:
            self._long[owner] += 1
            self._in_lane[lane] += 1
        thread.submit(quietly, send).add_done_callback(lambda _: self._sent(owner, lane))

    def _sent(self, owner: object, lane: str) -> None:
        with self._lock:
            self._in_lane[lane] -= 1
            if lane == "short":
                self._crowded = time.monotonic()
            self._long[owner] -= 1
            if not self._long[owner]:
                del self._long[owner]


def _environments() -> int:
    text = os.environ.get("ROS_DOMAIN_ID", "").strip()
    if not text:
        return 0
    if not text.isdecimal():
        raise ConfigurationError(f"ROS_DOMAIN_ID is {text!r:.40}: expected a number from 0")
    return int(text)


def _endpoints(given: str | Sequence[str]) -> tuple[str, ...]:
    return (given,) if isinstance(given, str) else tuple(given)


def _nothing() -> None:
    pass
