"""``docs/bus.md`` lists the bus: what is on it is on the page, and what is on the page is there.

A fleet with a camera, and programs with smartcam and without that use all of it, work at a bus that
notes every key that is said, heard, asked, answered, shown or watched.
"""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import re
from collections.abc import AsyncIterator, Callable, Iterator
from typing import get_args

import pytest

import smartcam.fleet
from smartcam.emulator import EmulatedCamera
from smartcam.fleet import FleetServer, MemoryBus
from smartcam.fleet._inside import Keys, patterns_overlap
from smartcam.models import CameraEvent
from tests import ROOT
from tests.fleet.fleetkit import until
from tests.fleet.inside import (
    SERVICES,
    THESIS,
    BusQuestion,
    Change,
    Data,
    Handle,
    MemoryConnection,
    Publisher,
    never,
)
from tests.fleet.inside import fleet as _fleet
from tests.fleet.plainkit import (
    COUNTER,
    NAME,
    PATIENCE,
    PREFIX,
    InProcess,
    applications,
    fleet_file,
    plant,
    zenoh_session,
)

PAGE = (ROOT / "docs" / "bus.md").read_text(encoding="utf-8")

MANY = ("CAMERA", "TOPIC", "...")
"""Words that stand for several parts of a key."""


def section(title: str) -> str:
    """Return a part of the page."""
    return PAGE.split(f"\n## {title}\n", 1)[1].split("\n## ", 1)[0]


def cells(text: str, header: str) -> Iterator[list[str]]:
    """Give the names in backticks of the first cells of a table."""
    table = text.split(f"| {header}", 1)[1].split("\n\n", 1)[0]
    for line in table.splitlines()[2:]:
        yield re.findall(r"`([^`]+)`", line.split("|")[1])


def pattern_of(listed: str) -> str:
    """Return the pattern that a key of the page is."""
    chunks = ["**" if one in MANY else "*" if one.isupper() else one for one in listed.split("/")]
    return "/".join([PREFIX, *chunks])


LISTED = {one: pattern_of(one) for row in cells(section("Keys"), "key after") for one in row}
"""Patterns of the page's keys."""


class NotingBus(MemoryBus):
    """A bus that notes the keys of everything.

    Attributes:
        noted: keys and patterns, and what was done with them.
    """

    def __init__(self) -> None:
        super().__init__()
        self.noted: dict[str, set[str]] = {}

    def note(self, what: str, key: str) -> None:
        self.noted.setdefault(key, set()).add(what)

    def new_connection(self) -> MemoryConnection:
        return NotingEnd(self)


class NotingEnd(MemoryConnection):
    """An end of it."""

    def __init__(self, bus: NotingBus) -> None:
        super().__init__(bus)
        self._note = bus.note

    def put(self, key: str, payload: bytes) -> None:
        self._note("say", key)
        super().put(key, payload)

    def put_part(self, key: str, head: bytes, data: Data) -> None:
        self._note("say", key)
        super().put_part(key, head, data)

    def subscribe(
        self, pattern: str, hear: Callable[[str, bytes], None], *, low_priority: bool = False
    ) -> Handle:
        self._note("hear", pattern)
        return super().subscribe(pattern, hear, low_priority=low_priority)

    def subscribe_parts(self, pattern: str, hear: Callable[[str, bytes, Data], None]) -> Handle:
        self._note("hear", pattern)
        return super().subscribe_parts(pattern, hear)

    def publisher(
        self,
        key: str,
        on_subscribers: Callable[[bool], None] | None = None,
        *,
        urgent: bool = False,
    ) -> Publisher:
        self._note("would say", key)
        return super().publisher(key, on_subscribers, urgent=urgent)

    def answer(
        self,
        pattern: str,
        answer: Callable[[BusQuestion], None],
        *,
        low_priority: Callable[[str], bool] = never,
    ) -> Handle:
        self._note("answer", pattern)
        return super().answer(pattern, answer, low_priority=low_priority)

    async def ask(self, pattern: str, payload: bytes, timeout: float) -> list[tuple[str, bytes]]:
        self._note("ask", pattern)
        answers = await super().ask(pattern, payload, timeout)
        for key, _ in answers:
            self._note("reply", key)
        return answers

    def announce(self, key: str) -> Handle:
        self._note("appear", key)
        return super().announce(key)

    def watch(self, pattern: str, see: Callable[[str, bool], None]) -> Handle:
        self._note("watch", pattern)
        return super().watch(pattern, see)

    async def present_keys(self, pattern: str, timeout: float) -> list[str]:
        self._note("watch", pattern)
        return await super().present_keys(pattern, timeout)


@contextlib.asynccontextmanager
async def everything(bus: MemoryBus, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[None]:
    """Have all that a fleet offers used once."""
    async with contextlib.AsyncExitStack() as stack:
        enter = stack.enter_async_context
        box = await enter(EmulatedCamera(applications=applications(), active=COUNTER, running=True))
        frames = {"url": "synthetic://?size=256x16&fps=50"}
        server = await enter(
            FleetServer(fleet_file(box.url, frames=frames), bus=bus.new_connection())
        )
        await server.wait_first_attempts()
        plain = InProcess(await bus.new_connection().open(PATIENCE))
        for kind in ("results", "status", "events"):
            await plain.topic(f"topic/{kind}/{NAME}")
        await plain.ask("cameras/**")
        await plain.call("trigger")
        await plain.thesis("EnablePublishing", topic_for_outputs="line1/outputs")
        await plain.topic("thesis/topic/line1/outputs")
        await plain.thesis("Trigger50ByteString")
        fleet = await enter(
            smartcam.fleet.Fleet(bus.new_connection(), None, "plant", None, PATIENCE, {})
        )
        camera, results = fleet[NAME], fleet.results()
        await camera.wait_connected(PATIENCE)
        async with camera.reserve():
            await camera.trigger()
        await anext(results)
        own = camera.results()
        await camera.trigger()
        await anext(own)
        await fleet.status()
        await fleet.reload()
        await fleet.outlets()
        await camera.frame_after(0.0, encoding="jpeg", timeout=PATIENCE)
        monkeypatch.setattr(_fleet, "MAX_CAMERAS_SUBSCRIBED", 0)  # as if there were many cameras
        bundled = fleet.results()
        await camera.trigger()
        await anext(bundled)
        yield


@pytest.fixture
async def noted(monkeypatch: pytest.MonkeyPatch) -> dict[str, set[str]]:
    bus = NotingBus()
    async with everything(bus, monkeypatch):
        pass
    return bus.noted


async def test_nothing_is_on_the_bus_that_the_page_does_not_list(
    noted: dict[str, set[str]],
) -> None:
    unlisted = {
        key: does
        for key, does in noted.items()
        if not any(patterns_overlap(key, pattern) for pattern in LISTED.values())
    }
    assert unlisted == {}
    assert all(key.startswith("smartcam/") for key in noted)


async def test_all_that_the_page_lists_is_on_the_bus(noted: dict[str, set[str]]) -> None:
    told = {
        listed: set().union(
            *(does for key, does in noted.items() if patterns_overlap(key, pattern))
        )
        for listed, pattern in LISTED.items()
    }
    # each has two ends: who says and who hears, who asks and who answers, who is there and who sees
    ends = ({"say", "hear"}, {"would say", "hear"}, {"ask", "answer"}, {"appear", "watch"})
    without = {
        listed: does for listed, does in told.items() if not any(pair <= does for pair in ends)
    }
    assert without == {}


def test_page_lists_the_key_of_every_kind() -> None:
    keys = Keys("plant")
    for name, method in inspect.getmembers(keys, inspect.ismethod):
        if name not in {"__init__", "tail"}:
            wanted = inspect.signature(method).parameters
            key = method(*("results" if one == "kind" else "x" for one in wanted))
            assert any(patterns_overlap(key, pattern) for pattern in LISTED.values()), name


def test_page_lists_every_service_and_no_other() -> None:
    plain = {name for row in cells(section("Services"), "service") for name in row}
    thesis = {name for row in cells(section("The thesis' interface"), "service") for name in row}
    assert plain == {*SERVICES}
    assert thesis == {*THESIS}


def test_page_lists_every_event_and_no_other() -> None:
    listed = {name for row in cells(section("Status and events"), "event") for name in row}
    cameras = {one.__name__ for one in CameraEvent.__subclasses__()}
    assert listed == cameras | {*get_args(Change)}


@pytest.mark.real_time
async def test_what_a_spy_hears_at_the_engine_is_listed() -> None:
    pytest.importorskip("zenoh")
    heard: set[str] = set()
    async with plant() as place:
        spy = await asyncio.to_thread(zenoh_session, place.server.address.port)
        try:
            spy.declare_subscriber("**", lambda sample: heard.add(str(sample.key_expr)))
            tokens = spy.liveliness().declare_subscriber(
                "**", lambda sample: heard.add(str(sample.key_expr)), history=True
            )
            await place.client.topic("topic/**")
            async with place.fleet() as fleet:
                await fleet[NAME].wait_connected(PATIENCE)
                async with fleet[NAME].reserve():
                    await fleet[NAME].trigger()
                await until(lambda: f"{PREFIX}/topic/results/{NAME}" in heard)
                await until(lambda: any("/presence/program/" in key for key in heard))
            tokens.undeclare()
        finally:
            await asyncio.to_thread(spy.close)
    patterns = LISTED.values()
    assert {
        key for key in heard if not any(patterns_overlap(key, one) for one in patterns)
    } == set()
    assert any(f"{PREFIX}/command/" in key for key in heard)
