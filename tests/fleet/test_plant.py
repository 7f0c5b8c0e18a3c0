"""Plants of many cameras: bundles cost one message, and lose nothing."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Any

import pytest

from smartcam import Result
from smartcam._zenoh import BusLink
from smartcam.exceptions import ConfigurationError, ConnectionClosedError, RemoteProtocolError
from smartcam.fleet import Fleet, FleetServer, MemoryBus
from smartcam.fleet._inside import Keys
from smartcam.fleet._program.exchange import Exchange
from tests.fleet.fleetkit import PATIENCE, until
from tests.fleet.inside import AgentBundle, MemoryConnection, decode_bundle, in_words
from tests.fleet.inside import fleet as _fleet
from tests.fleet.test_fleet import HELLO, file
from tests.processes import free_place

CAMERAS = ("a", "b", "c", "d", "e")


@contextlib.asynccontextmanager
async def plant(monkeypatch: pytest.MonkeyPatch, *, met: int = 3) -> AsyncIterator[Fleet]:
    """Give a program with a fleet that is large to it: two agents, five cameras."""
    monkeypatch.setattr(_fleet, "MAX_CAMERAS_ASKED_AT_OPEN", met)
    monkeypatch.setattr(_fleet, "MAX_CAMERAS_SUBSCRIBED", 2)
    bus = MemoryBus()
    async with contextlib.AsyncExitStack() as stack:
        for name, cameras in (("north", CAMERAS[:3]), ("south", CAMERAS[3:])):
            said = file(dict.fromkeys(cameras, HELLO), agent=name)
            server = await stack.enter_async_context(FleetServer(said, bus=bus.new_connection()))
            await server.wait_first_attempts()
        yield await stack.enter_async_context(
            Fleet(bus.new_connection(), None, "plant", None, 2.0, {})
        )


# ---------------------------------------------------------------------- status


async def test_status_of_all_is_one_question_to_each_agent(monkeypatch: Any) -> None:
    async with plant(monkeypatch) as fleet:
        asked: list[str] = []
        ask = MemoryConnection.ask

        async def counted(self: MemoryConnection, pattern: str, *rest: Any) -> Any:
            asked.append(pattern)
            return await ask(self, pattern, *rest)

        monkeypatch.setattr(MemoryConnection, "ask", counted)
        known = await fleet.status()
        assert asked == ["smartcam/plant/summary/*"]
        assert {name: one.agent for name, one in known.items()} == {
            **dict.fromkeys("abc", "north"),
            **dict.fromkeys("de", "south"),
        }
        assert all(one.connected and one.application == 21 for one in known.values())
        assert known["a"].status is not None
        assert [*await fleet.status("d")] == ["d"]
        assert not fleet._cameras  # none was met for that


async def test_status_says_why_there_is_no_session_and_who_has_it_reserved() -> None:
    bus = MemoryBus()
    said = file({"here": HELLO, "gone": {"url": "bvs://127.0.0.1:1"}})
    async with (
        FleetServer(said, bus=bus.new_connection()) as server,
        Fleet(bus.new_connection(), None, "plant", None, 2.0, {}) as fleet,
    ):
        await server.wait_first_attempts()
        async with fleet["here"].reserve():
            known = await fleet.status()
        assert known["here"].reserved_by == in_words(fleet._program.name)
        assert not known["gone"].connected
        assert known["gone"].reason is not None
        with pytest.raises(ConfigurationError, match="timeout: expected seconds"):
            await fleet.status(timeout=-1.0)
    with pytest.raises(ConnectionClosedError):
        await fleet.status()


# ---------------------------------------------------------------------- met as they are used


async def test_large_fleet_is_seen_at_once_and_met_as_it_is_used(monkeypatch: Any) -> None:
    async with plant(monkeypatch) as fleet:
        assert (len(fleet), fleet.names()) == (5, [*CAMERAS])
        assert not fleet._cameras
        result = await fleet["d"].trigger(timeout=5.0)  # its commands wait for the agent
        assert result.camera == "d"
        assert [*fleet._cameras] == ["d"]
        met = await fleet.find_cameras("*")
        assert [one.name for one in met if one.connected] == [*CAMERAS]
        assert isinstance((await fleet.trigger())["a"], Result)


async def test_camera_of_a_large_fleet_that_goes_is_lost(monkeypatch: Any) -> None:
    async with plant(monkeypatch) as fleet:
        (camera,) = await fleet.find_cameras("a")
        assert camera.connected
        bus = fleet._exchange._bus
        assert isinstance(bus, MemoryConnection)
        bus.detach()
        await until(lambda: not camera.connected)
        assert fleet.names() == []
        bus.attach()
        await until(lambda: camera.connected)
        assert len(fleet) == 5


# ---------------------------------------------------------------------- bundles


async def triggered(fleet: Fleet, times: int) -> dict[str, list[int]]:
    """Trigger all cameras again and again, and return the numbers of their results."""
    numbers: dict[str, list[int]] = {}
    for _ in range(times):
        for name, result in (await fleet.trigger(timeout=5.0)).items():
            assert isinstance(result, Result)
            numbers.setdefault(name, []).append(result.number)
    return numbers


@pytest.mark.parametrize("lost", [(), (1,), (0, 2), (0, 1, 2, 3, 4)])
async def test_results_of_all_come_once_and_those_of_a_lost_bundle_too(
    monkeypatch: Any, lost: tuple[int, ...]
) -> None:
    come: list[bytes] = []
    on_bundle = Exchange._on_bundle

    def lossy(self: Exchange, key: str, payload: bytes) -> None:
        come.append(payload)
        if len(come) - 1 not in lost:
            on_bundle(self, key, payload)

    monkeypatch.setattr(Exchange, "_on_bundle", lossy)
    async with plant(monkeypatch) as fleet:
        results = fleet.results()
        await fleet.find_cameras()
        await asyncio.sleep(0.5)
        come.clear()
        numbers = await triggered(fleet, 4)
        heard: dict[str, list[int]] = {}
        async with asyncio.timeout(PATIENCE):
            for _ in range(20):
                result = await anext(results)
                heard.setdefault(result.camera, []).append(result.number)
        assert heard == numbers
        assert sum(len(decode_bundle(one, "it").parts) for one in come) >= 5
        await asyncio.sleep(10.0)  # reminders
        accounts = results.statistics().values()
        assert all((one.taken, one.dropped, one.missed) == (4, 0, 0) for one in accounts)


async def test_who_hears_a_few_hears_no_bundles(monkeypatch: Any) -> None:
    async with plant(monkeypatch) as fleet:
        results = fleet.results("a")
        await fleet.find_cameras("a")
        await asyncio.sleep(0.1)
        assert "results" not in fleet._exchange._common_handles
        result = await fleet["a"].trigger(timeout=5.0)
        assert (await anext(results)).number == result.number


async def test_nobody_who_hears_is_no_bundle(monkeypatch: Any) -> None:
    async with plant(monkeypatch) as fleet:
        results = fleet.results()
        await fleet.find_cameras()
        results.close()
        await until(lambda: "results" in fleet._exchange._common_handles)
        said: list[str] = []
        monkeypatch.setattr(AgentBundle, "add", lambda *_: said.append(""))
        await triggered(fleet, 3)
        assert "results" not in fleet._exchange._common_handles
        said.clear()
        await triggered(fleet, 1)
        assert not said


@pytest.mark.parametrize("payload", [b"", b"scb1", b"x" * 32, b"scb1" + bytes(27) + b"\1"])
def test_broken_bundle_is_told(payload: bytes) -> None:
    with pytest.raises(RemoteProtocolError, match="it is broken"):
        decode_bundle(payload, "it")


# ---------------------------------------------------------------------- the engine


@pytest.mark.real_time
@pytest.mark.long
async def test_thousands_of_presences_come_through_a_router() -> None:
    """With less room for declarations the router waited for itself, and ended the connection."""
    pytest.importorskip("zenoh")
    from smartcam.fleet._inside import ZenohConnection

    places = (free_place(),)
    keys, count = Keys("plant"), 6000
    router, agent = (
        ZenohConnection(BusLink(listen=places)),
        ZenohConnection(BusLink(connect=places)),
    )
    program = ZenohConnection(BusLink(connect=places))
    async with asyncio.timeout(PATIENCE):
        try:
            await router.open(PATIENCE)
            await agent.open(PATIENCE)
            for number in range(count):
                agent.announce(keys.camera("agent", f"line1/cam{number}"))
            everything = keys.camera("*", "**")
            while len(await router.present_keys(everything, PATIENCE)) < count:  # noqa: ASYNC110
                await asyncio.sleep(0.1)
            await program.open(PATIENCE)
            assert len(await program.present_keys(everything, PATIENCE)) == count
        finally:
            for end in (program, agent, router):
                await end.close()
