"""A simulated fleet: any number of cheap cameras, which a test controls."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, cast

from smartcam._client._inside import Interpretation
from smartcam.exceptions import ConfigurationError, LinkError
from smartcam.fleet import AgentJoined, AgentLeft, CameraJoined, CameraLeft, FleetEvent
from smartcam.models import Disconnected, Result, Status, StatusChanged
from smartcam.streams import BatchSubscription, Subscribers, Subscription

if TYPE_CHECKING:
    from smartcam.fleet import Fleet
    from smartcam.models import CameraEvent

READY = Status.RUNNING | Status.WAITING_FOR_TRIGGER
AT = datetime(2026, 1, 1, tzinfo=UTC)


class MadeUpCamera:
    """A camera as the table asks for it; without a session where it is not ``connected``."""

    def __init__(self, name: str) -> None:
        self.name, self.url = name, f"fleet:///{name}"
        self.connected, self.ended = True, False
        self.status, self.active_application = READY, 7
        self.trouble: LinkError | None = None
        self.sent = 0
        self._default: Interpretation
        self.read_as(None)
        self._results: Subscribers[Result[Any]] = Subscribers()
        self._events: Subscribers[CameraEvent] = Subscribers()

    def results(self, *, batch: bool, max_queue: int, max_queue_bytes: int) -> Any:
        assert batch
        stream = BatchSubscription[Result[Any]](
            "results",
            max_queue=max_queue,
            max_queue_bytes=max_queue_bytes,
            size_of=lambda one: len(one.raw),
            overflow="drop_oldest",
        )
        self._results.add(stream)
        return stream

    def events(self, *, max_queue: int) -> Subscription[CameraEvent]:
        stream = Subscription[Any]("events", max_queue=max_queue, overflow="drop_oldest")
        self._events.add(stream)
        return stream

    def read_as(self, spec: Any) -> None:
        """Set the interpretation of results; this camera itself interprets none."""
        self._default = Interpretation(spec, lenient=False, y_down=False)

    def send(self, value: Any, *, raw: bytes = b"", at: datetime | None = None) -> None:
        """Deliver a result."""
        self.sent += 1
        at = at or datetime.now(UTC)
        result = Result(self.name, 7, None, self.sent, None, at, None, raw, value)
        for stream in self._results:
            stream.offer(result, 0.0, len(raw))

    def fail(self, error: Any) -> None:
        """Deliver a container that cannot be read."""
        for stream in self._results:
            stream.offer(error, 0.0)

    def miss(self, count: int) -> None:
        """Report some results as lost."""
        for stream in self._results:
            stream.miss(count)
        self.say(self.status)

    def say(self, status: Status) -> None:
        """Report this status."""
        before, self.status = self.status, status
        self._tell(StatusChanged(camera=self.name, at=AT, status=status, previous=before))

    def lose(self, reason: str) -> None:
        """End the session."""
        self.connected, self.trouble = False, LinkError(reason)
        self._tell(Disconnected(camera=self.name, at=AT, reason=reason, expected=False))

    def _tell(self, event: CameraEvent) -> None:
        for stream in self._events:
            stream.offer(event, 0.0)


class MadeUpFleet:
    """A fleet as the page asks for it, with agents ``a`` and ``b`` that have every other camera."""

    url = "fleet://made-up"

    def __init__(self, names: list[str]) -> None:
        self.made = {name: MadeUpCamera(name) for name in names}
        self.agent = {name: "ab"[index % 2] for index, name in enumerate(names)}
        self._events: Subscribers[FleetEvent] = Subscribers()

    @property
    def as_fleet(self) -> Fleet:
        """It, as the page's site takes it."""
        return cast("Fleet", self)

    def events(self, *, max_queue: int) -> Subscription[FleetEvent]:
        stream = Subscription[FleetEvent]("events", max_queue=max_queue, overflow="drop_oldest")
        for agent in sorted(set(self.agent.values())):
            stream.offer(AgentJoined("plant", AT, agent), 0.0)
        for name, agent in self.agent.items():
            stream.offer(CameraJoined("plant", AT, agent, name), 0.0)
        self._events.add(stream)
        return stream

    def __getitem__(self, name: str) -> MadeUpCamera:
        if name not in self.made:
            raise ConfigurationError(f"the fleet has no camera {name!r}")
        return self.made[name]

    def join(self, name: str, agent: str) -> MadeUpCamera:
        """Add a camera, a new one or one that was gone."""
        camera = self.made.setdefault(name, MadeUpCamera(name))
        self.agent[name] = agent
        self._tell(CameraJoined("plant", AT, agent, name))
        return camera

    def lose(self, agent: str) -> None:
        """Remove an agent."""
        for name in [name for name, one in self.agent.items() if one == agent]:
            self.leave(name)
        self._tell(AgentLeft("plant", AT, agent))

    def leave(self, name: str) -> None:
        """Remove a camera."""
        self._tell(CameraLeft("plant", AT, self.agent.pop(name), name))

    def _tell(self, event: FleetEvent) -> None:
        for stream in self._events:
            stream.offer(event, 0.0)


def names(count: int) -> list[str]:
    """Return names of so many cameras, in their order."""
    return [f"line{1 + number // 500:02}/cam{number % 500:03}" for number in range(count)]
