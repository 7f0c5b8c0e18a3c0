"""A node that records publications and services, in the loop's time; and emulated cameras."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import smartcam
from smartcam.backoff import Backoff
from smartcam.emulator import Application, EmulatedCamera
from smartcam.exceptions import RosError
from smartcam.ros2 import CameraNode, CameraNodeOptions, RosTypes

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable

NAME = "line1/cam3"
FAST = Backoff(initial=0.01, maximum=0.05, jitter=0.0)
COUNTER, OTHER = 11, 12

TYPES = RosTypes()


class Published(NamedTuple):
    """A message, and when it was published."""

    at: float
    message: Any


class NotedPublisher:
    """Notes what is published, as who hears it would read it."""

    def __init__(self, node: NotedNode, topic: str, kind: str, qos: Any) -> None:
        self.node, self.topic, self.qos = node, topic, qos
        self.type = TYPES.message(kind)
        self.has_subscribers = True
        self.fails = False
        self.closed = False
        self.said: list[Published] = []

    def publish(self, message: Any = None, /, **fields: Any) -> None:
        if self.closed or self.fails:
            raise RosError(f"{self.topic}: this publisher is closed")
        data = self.type.encode(fields if message is None else message)
        self.said.append(Published(asyncio.get_running_loop().time(), self.type.decode(data)))

    def publish_encoded(self, data: bytes) -> None:
        self.publish(self.type.decode(data))

    def close(self) -> None:
        self.closed = True


class NotedService:
    """A service that is called without a wire."""

    def __init__(self, kind: str, handler: Callable[[Any], Awaitable[Any]]) -> None:
        self.type = TYPES.service(kind)
        self.handler = handler
        self.closed = False

    async def call(self, **fields: Any) -> Any:
        request = self.type.request.decode(self.type.request.encode(fields))
        reply = await self.handler(request)
        return self.type.response.decode(self.type.response.encode(reply))

    def close(self) -> None:
        self.closed = True


class NotedNode:
    """As a node of ROS 2, or of ROS 1 without what that does not have."""

    def __init__(self, *, ros1: bool = False, parameters: Any = None) -> None:
        self.name, self.namespace, self.full_name = "cam3", "/line1", f"/{NAME}"
        self.types = TYPES
        self.graph: object = None if ros1 else object()
        self.parameters = parameters
        self.topics: dict[str, NotedPublisher] = {}
        self.services: dict[str, NotedService] = {}
        self.refuses = ""
        self.open = False

    async def __aenter__(self) -> Self:
        self.open = True
        return self

    async def __aexit__(self, *_: object) -> None:
        self.open = False

    def publisher(self, topic: str, type: str, *, qos: Any = None) -> NotedPublisher:
        if topic == self.refuses:
            raise RosError(f"{topic}: refused")
        made = self.topics[topic] = NotedPublisher(self, topic, type, qos)
        return made

    def serve(
        self, service: str, type: str, handler: Callable[[Any], Awaitable[Any]], **_: Any
    ) -> NotedService:
        made = self.services[service] = NotedService(type, handler)
        return made

    @property
    def still_declared(self) -> list[str]:
        """The ends that were declared and are not closed."""
        ends: dict[str, Any] = {**self.topics, **self.services}
        return sorted(name for name, one in ends.items() if not one.closed)

    def last(self, topic: str) -> Any:
        """The last message of a topic."""
        return self.topics[topic].said[-1].message

    def steps(self) -> list[tuple[str, str]]:
        """The transitions that were told, as states that were left and entered."""
        said = [one.message for one in self.topics["~/transition_event"].said]
        return [(one.start_state.label, one.goal_state.label) for one in said]

    async def change(self, label: str = "", number: int = 0) -> bool:
        """Ask for a transition."""
        wanted = {"id": number, "label": label}
        reply = await self.services["~/change_state"].call(transition=wanted)
        return bool(reply.success)


def box(**options: Any) -> EmulatedCamera:
    """Return an emulated camera that counts."""
    counts: list[Any] = [{"n": number} for number in range(1, 100)]
    options.setdefault("running", True)
    return EmulatedCamera(
        [
            Application(id=COUNTER, layout="n: int32", cycle=counts, load_time=0.05),
            Application(id=OTHER, layout="n: int32", cycle=counts, load_time=0.05),
        ],
        builtins=False,
        **options,
    )


class Seen(NamedTuple):
    """An emulated camera, its client, and its node."""

    box: EmulatedCamera
    camera: Any
    node: NotedNode
    seen: CameraNode

    @property
    def state(self) -> str:
        return self.seen.lifecycle.state.label


@contextlib.asynccontextmanager
async def seen(
    emulated: EmulatedCamera | None = None,
    node: NotedNode | None = None,
    client: dict[str, Any] | None = None,
    **options: Any,
) -> AsyncIterator[Seen]:
    """Give a camera that is seen in ROS."""
    node = node or NotedNode()
    settings = {"name": NAME, "reconnect": FAST, "interpret_as": "n: int32", **(client or {})}
    async with (
        emulated or box() as one,
        smartcam.connect(one.url, **settings) as camera,
        CameraNode(camera, node, options=CameraNodeOptions(**options)) as made,
    ):
        await until(lambda: node.topics["/diagnostics"].said)
        yield Seen(one, camera, node, made)


async def until(true: Callable[[], object], seconds: float = 60.0) -> None:
    """Wait until something is true."""
    async with asyncio.timeout(seconds):
        while not true():  # noqa: ASYNC110 - there is no event for it
            await asyncio.sleep(0.02)


@contextlib.asynccontextmanager
async def away(seconds: float, **options: Any) -> AsyncIterator[Seen]:
    """Give a camera that is seen in ROS while it is away, for so long."""
    node, retry = NotedNode(), Backoff(initial=5.0, maximum=5.0, jitter=0.0)
    settings: dict[str, Any] = {"name": NAME, "reconnect": retry, "connect_timeout": 2.0}
    async with box() as emulated, smartcam.connect(emulated.url, **settings) as camera:
        emulated.inject({"kind": "refuse", "seconds": seconds}, {"kind": "close"})
        await until(lambda: not camera.connected)
        async with CameraNode(camera, node, options=CameraNodeOptions(**options)) as made:
            await until(lambda: node.topics["/diagnostics"].said)
            yield Seen(emulated, camera, node, made)
