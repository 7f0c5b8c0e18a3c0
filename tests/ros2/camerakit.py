"""Helpers of the tests of a camera's node: a camera that numbers its parts, and a node of paper."""

from __future__ import annotations

import asyncio
import contextlib
import importlib.util
from collections.abc import AsyncIterator, Awaitable, Callable
from types import SimpleNamespace
from typing import Any

import pytest

from smartcam._ros_names import full_name, resolve
from smartcam.emulator import Application, EmulatedCamera, Run
from smartcam.exceptions import ConfigurationError, RosError
from smartcam.ros2 import QoS, RosTypes
from smartcam.ros2._inside import NativeContext, NativeNode
from tests.emulator.builtins import LOCALIZATIONS
from tests.ros2.roskit import DOMAIN, NO_RCLPY
from tests.timed_loop import TimedLoop

PARTS, TEXTS, RUNNING, BROKEN, PIXELS, BOTH = 1, 2, 3, 4, 5, 6
"""Applications of :class:`PartsCamera`."""

READ_AS: dict[int, Any] = {
    PARTS: "localizations",
    TEXTS: "strings50",
    RUNNING: "localizations",
    BROKEN: "localizations",
    PIXELS: "localizations: (x: real32 px, y: real32 px)*",
    BOTH: "localizations",
}


class PartsCamera(EmulatedCamera):
    """An emulated camera whose parts say which run found them: two each time.

    Args:
        time: seconds of a run, and of a switch.
        rate: runs in a second of application 3, which runs by itself.
        **options: as an emulated camera has them.
    """

    def __init__(self, *, time: float = 0.001, rate: float = 500.0, **options: Any) -> None:
        self.runs = 0
        common: dict[str, Any] = {"load_time": time, "layout": LOCALIZATIONS}
        found = {**common, "generator": self._found}
        texts = [{"text": "one"}, {"text": "two"}]
        made: list[Any] = [
            {**found, "id": PARTS, "processing_time": time},
            {**common, "id": TEXTS, "layout": "(text: string[50])*", "constant": texts},
            {**found, "id": RUNNING, "rate": rate},
            {**common, "id": BROKEN, "layout": "text: string[9]", "constant": {"text": "no part"}},
            {**common, "id": PIXELS, "layout": "(x: real32, y: real32)*", "constant": [[320, 240]]},
            {**common, "id": BOTH, "constant": []},
        ]
        options.setdefault("running", True)
        super().__init__([Application(**one) for one in made], builtins=False, **options)
        self.runs = 0  # an application tries its values when it is made

    def _found(self, run: Run) -> list[dict[str, Any]]:
        self.runs += 1
        one = {"feature_id": f"run{self.runs}", "quality": 0.5, "photo_index": 0}
        first = {**one, "x": 0.001 * self.runs, "y": -0.25, "theta": 0.5}
        return [first, {**first, "photo_index": 1, "x": -0.125}]


class PaperPublisher:
    """Keeps what is published, as who hears it would read it."""

    def __init__(self, node: PaperNode, name: str, kind: str, qos: QoS) -> None:
        self.name, self.qos, self.has_subscribers, self.closed = name, qos, True, False
        self.type = node.types.message(kind)
        self.messages: list[Any] = []

    def publish(self, message: Any) -> None:
        assert not self.closed
        self.messages.append(self.type.decode(self.type.encode(message)))

    def close(self) -> None:
        self.closed = True


class PaperNode:
    """A node in memory, as far as the parts of a camera's node use one."""

    def __init__(self, name: str = "cam3", namespace: str = "/line1") -> None:
        self.name, self.namespace = name, namespace
        self.full_name = full_name(namespace, name)
        self.types = RosTypes()
        self.publishers: dict[str, PaperPublisher] = {}
        self.handlers: dict[str, tuple[Any, Callable[[Any], Awaitable[Any]]]] = {}
        self.missing: set[str] = set()
        """Types that it does not have."""

    def publisher(self, topic: str, type: str, *, qos: QoS) -> PaperPublisher:
        name = resolve(topic, self.namespace, self.name, "topic")
        if type in self.missing:
            raise ConfigurationError(f"no {type}")
        made = self.publishers[name] = PaperPublisher(self, name, type, qos)
        return made

    def serve(self, service: str, type: str, handler: Any, *, timeout: float = 0.0) -> Any:
        name = resolve(service, self.namespace, self.name, "service")
        self.handlers[name] = (self.types.service(type), handler)
        return SimpleNamespace(close=lambda: self.handlers.pop(name))

    def said(self, topic: str) -> list[Any]:
        """Return the messages of a topic."""
        return self.publishers[f"{self.full_name}/{topic}"].messages

    async def call(self, service: str, **fields: Any) -> Any:
        """Call a service, over bytes both ways."""
        kind, handler = self.handlers[f"{self.full_name}/{service}"]
        request = kind.request.decode(kind.request.encode(fields))
        return kind.response.decode(kind.response.encode(await handler(request)))


class HeardNode(PaperNode):
    """Node through rclpy: another node calls, and published messages are kept, too."""

    def __init__(self, here: NativeNode, there: NativeNode) -> None:
        super().__init__()
        self.here, self.there = here, there

    def publisher(self, topic: str, type: str, *, qos: QoS) -> PaperPublisher:
        made = super().publisher(topic, type, qos=qos)
        end = self.here.publisher(topic, type, qos=qos)
        noted, closed = made.publish, made.close

        def publish(message: Any) -> None:
            noted(message)
            end.publish(message)

        def close() -> None:
            closed()
            end.close()

        made.publish, made.close = publish, close  # type: ignore[method-assign]
        return made

    def serve(self, service: str, type: str, handler: Any, *, timeout: float = 600.0) -> Any:
        return self.here.serve(service, type, handler, timeout=timeout)

    async def call(self, service: str, **fields: Any) -> Any:
        """Call a service from the other node."""
        name = f"{self.full_name}/{service}"
        kinds = self.here.graph.services()
        while name not in kinds:
            await asyncio.sleep(0.02)
            kinds = self.here.graph.services()
        client = self.there.client(name, kinds[name][0])
        try:
            return await client.call(fields, timeout=60)
        finally:
            client.close()


@contextlib.asynccontextmanager
async def paper_or_rclpy() -> AsyncIterator[PaperNode]:
    """Give a node on paper, or on asyncio's own loop one through rclpy."""
    if isinstance(asyncio.get_running_loop(), TimedLoop):
        yield PaperNode()
        return
    if importlib.util.find_spec("rclpy") is None:
        pytest.skip(NO_RCLPY)
    context = NativeContext(domain=DOMAIN)
    async with (
        NativeNode("cam3", namespace="/line1", context=context, managed=False) as here,
        NativeNode("viewer", context=context, managed=False) as there,
    ):
        yield HeardNode(here, there)


class Life:
    """A life cycle that goes where it is asked to, unless it is told to fail."""

    def __init__(self, label: str = "unconfigured") -> None:
        self.state = SimpleNamespace(label=label)
        self.asked: list[str] = []
        self.error: Exception | None = None

    def _go(self, what: str, start: str, goal: str) -> None:
        self.asked.append(what)
        if self.error is not None:
            raise self.error
        if self.state.label != start:
            raise RosError(f"{what}: it is {self.state.label}")
        self.state.label = goal

    async def configure(self) -> None:
        self._go("configure", "unconfigured", "inactive")

    async def activate(self) -> None:
        self._go("activate", "inactive", "active")

    async def deactivate(self) -> None:
        self._go("deactivate", "active", "inactive")

    async def cleanup(self) -> None:
        self._go("cleanup", "inactive", "unconfigured")
