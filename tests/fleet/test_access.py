"""Who may what: each role, each kind of message, each key, by the engine's own rules."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

from smartcam.fleet._access import RIGHTS, ros_rights
from smartcam.fleet._calls import ACTIONS
from smartcam.fleet._certificates import ROLES, may_command
from smartcam.fleet._keys import COMMANDS, Keys, meets
from smartcam.fleet._services import SERVICES
from smartcam.fleet._thesis import THESIS
from smartcam.fleet._zenoh import ZenohEnd
from tests.fleet.fleetkit import PATIENCE, until
from tests.fleet.plantkit import WHO, certified, guarded, joined

pytestmark = pytest.mark.real_time

KEYS = Keys("plant")
DOMAIN = 7
TABLE = RIGHTS + ros_rights(DOMAIN)
FOREIGN = ["other/key", "smartcam/plant/else/x", "8/chatter/x", "@ros2_lv/8/x"]
"""Keys that nobody but a router may use."""

MARK = "mark"
STRANGER = "stranger"


def concrete(pattern: str) -> str:
    """Return a key that a pattern means."""
    said = pattern.replace("smartcam/*/", "smartcam/plant/", 1)
    return said.replace("**", "line1/cam3").replace("*", "x")


def keys_of(does: str) -> list[str]:
    """Return all keys with which something is tried: whoever may do anything with them."""
    found = [concrete(key) for right in TABLE for key in right.keys] + FOREIGN
    return [*dict.fromkeys(found)]


def allowed(role: str, does: str, key: str) -> bool:
    """Whether the table has it."""
    if role == "router":
        return True
    return any(
        role in right.roles and right.does == does and any(meets(one, key) for one in right.keys)
        for right in TABLE
    )


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("plant")
    asyncio.run(certified(folder))
    return folder


@pytest.fixture(params=[*ROLES[:3], pytest.param("router", marks=pytest.mark.long)])
async def ends(
    request: pytest.FixtureRequest, plant: Path
) -> AsyncIterator[tuple[str, ZenohEnd, ZenohEnd]]:
    """Give a role, an end with it, and the one that guards."""
    async with (
        guarded(plant, DOMAIN) as (guard, place),
        joined(place, plant / WHO[request.param]) as end,
    ):
        yield request.param, end, guard


Ends = tuple[str, ZenohEnd, ZenohEnd]


class Seen:
    """Keys that came, in order."""

    def __init__(self) -> None:
        self.keys: list[str] = []

    def __call__(self, key: str, *_: Any) -> None:
        self.keys.append(key)

    async def mark(self, mark: str) -> set[str]:
        """Wait for the last one; return all others."""
        await until(lambda: mark in self.keys)
        return {*self.keys} - {mark}


def expected(role: str, does: str) -> set[str]:
    return {key for key in keys_of(does) if allowed(role, does, key)}


async def known(end: ZenohEnd, guard: ZenohEnd, role: str) -> None:
    """Wait until all that an end has declared is known: in order, its presence at last."""
    seen = Seen()
    watch = guard.watch(KEYS.program("*"), seen)
    end.be_present(KEYS.program(MARK))
    await seen.mark(KEYS.program(MARK))
    watch.close()


async def test_say(ends: Ends) -> None:
    role, end, guard = ends
    seen = Seen()
    for pattern in ("**", "**/@adv/**", "@ros2_lv/**"):
        guard.subscribe(pattern, seen)
    mark = KEYS.call(MARK, MARK, command=False)
    for key in keys_of("say"):
        end.put(key, b"")
    end.put("smartcam/plant/*/x/line1/cam3", b"")  # a pattern means commands, too
    end.put("smartcam/**", b"")
    end.put(mark, b"")
    came = await seen.mark(mark)
    patterns = {key for key in came if "*" in key}
    assert came - patterns == expected(role, "say")
    assert bool(patterns) == (role == "router")


async def test_hear(ends: Ends) -> None:
    role, end, guard = ends
    seen = Seen()
    mark = KEYS.states(MARK)
    for key in [*keys_of("hear"), mark]:
        end.subscribe(key, seen)
    everything = Seen()
    end.subscribe("smartcam/**", everything)
    await known(end, guard, role)
    for key in [*keys_of("hear"), mark]:
        guard.put(key, b"")
    assert await seen.mark(mark) == expected(role, "hear")
    assert {*everything.keys} - {mark} <= expected(role, "hear")  # a wide pattern brings no more


async def test_ask(ends: Ends) -> None:
    role, end, guard = ends
    seen = Seen()

    def answer(question: Any) -> None:
        seen(question.key)
        question.reply(question.key, b"yes")
        question.close()

    for pattern in ("**", "**/@adv/**", "@ros2_lv/**"):
        guard.answer(pattern, answer)
    mark = KEYS.listing(MARK)
    asking = {key: asyncio.ensure_future(end.ask(key, b"", PATIENCE)) for key in keys_of("ask")}
    await asyncio.sleep(0)  # they ask
    assert await end.ask(mark, b"", PATIENCE) == [(mark, b"yes")]
    assert await seen.mark(mark) == expected(role, "ask")
    for key in expected(role, "ask"):
        assert await asking[key] == [(key, b"yes")]
    for one in asking.values():
        one.cancel()
    await asyncio.gather(*asking.values(), return_exceptions=True)


async def test_answer(ends: Ends) -> None:
    role, end, guard = ends
    seen = Seen()

    def answer(question: Any) -> None:
        seen(question.key)
        question.reply(question.key, b"yes")
        question.close()

    for key in keys_of("answer"):
        end.answer(key, answer)
    await known(end, guard, role)
    for key in keys_of("answer"):
        said = [(key, b"yes")] if allowed(role, "answer", key) else []
        assert await guard.ask(key, b"", PATIENCE) == said, key
    assert {*seen.keys} == expected(role, "answer")


async def test_appear(ends: Ends) -> None:
    role, end, guard = ends
    seen = Seen()
    for pattern in ("**", "**/@adv/**", "@ros2_lv/**"):
        guard.watch(pattern, seen)
    for key in keys_of("appear"):
        end.be_present(key)
    end.be_present(KEYS.program(MARK))
    assert await seen.mark(KEYS.program(MARK)) == expected(role, "appear")


async def test_watch(ends: Ends) -> None:
    role, end, guard = ends
    mark = KEYS.agent(MARK)
    for key in [*keys_of("watch"), mark]:
        guard.be_present(key)
    seen = Seen()
    for key in [*keys_of("watch"), mark]:
        end.watch(key, seen)
    assert await seen.mark(mark) == expected(role, "watch")


async def test_look_who_is_there(ends: Ends) -> None:
    role, end, guard = ends
    mark = KEYS.agent(MARK)
    for key in [*keys_of("watch"), mark]:
        guard.be_present(key)
    asking = {key: asyncio.ensure_future(end.present(key, PATIENCE)) for key in keys_of("watch")}
    await asyncio.sleep(0)  # they ask
    assert await end.present(mark, PATIENCE) == [mark]
    for key, one in asking.items():
        if allowed(role, "watch", key):
            assert await one == [key]
        assert not one.done() or await one == ([key] if allowed(role, "watch", key) else [])
        one.cancel()
    await asyncio.gather(*asking.values(), return_exceptions=True)


# ---------------------------------------------------------------------- calls and services

QUESTIONS = {
    *("hello", "find", "results", "states", "refresh", "about_frames", "frame", "next_frame"),
    *("leave_frames", "lens", "query_application", "query_status", "wait_connected", "wait_ready"),
    *("read_image", "get_clock"),
}
"""Calls that were looked at, and change nothing: a new one has to be, too."""

LOOKING = {
    *("status", "results", "frame", "query_application", "query_status", "wait_ready"),
    *("get_clock", "read_image"),
}


@pytest.mark.parametrize("role", ROLES[:3])
@pytest.mark.parametrize("do", ACTIONS)
def test_each_call(role: str, do: str) -> None:
    key = KEYS.call("line1", "line1/cam3", command=do in COMMANDS)
    assert allowed(role, "say", key) == (do in QUESTIONS or role == "operator")
    assert may_command(role) == (role == "operator")


@pytest.mark.parametrize("role", ROLES[:3])
def test_each_service(role: str) -> None:
    for name in SERVICES:
        may = allowed(role, "ask", KEYS.service("line1/cam3", name))
        assert may == (name in LOOKING or role == "operator"), name
    for name in THESIS:
        assert allowed(role, "ask", KEYS.thesis(name)) == (role == "operator")
    camera_named_so = KEYS.service("line1/status", "trigger")
    assert allowed(role, "ask", camera_named_so) == (role == "operator")


async def test_certificate_without_a_role_may_nothing(plant: Path, tmp_path: Path) -> None:
    """Its common name is none of the roles: it comes in, and sees nobody."""
    from smartcam.fleet import _authority

    folder = tmp_path / "plant"
    folder.mkdir()
    (folder / "authority").symlink_to(plant / "authority")
    authority = _authority._Authority.of(folder)
    authority.make("visitor", "somebody", [], _authority.LIFETIME)
    async with (
        guarded(plant) as (guard, place),
        joined(place, folder / "somebody") as end,
        joined(place, plant / "dashboard") as viewer,
    ):
        guard.be_present(KEYS.agent("line1"))
        seen, heard = Seen(), Seen()
        guard.subscribe("**", heard)
        end.watch("**", seen)
        for key in keys_of("say"):
            end.put(key, b"")
        asked = asyncio.ensure_future(end.present(KEYS.agent("*"), PATIENCE))
        assert await viewer.present(KEYS.agent("*"), PATIENCE) == [KEYS.agent("line1")]
        viewer.put(KEYS.call("a", MARK, command=False), b"")
        assert await heard.mark(KEYS.call("a", MARK, command=False)) == set()
        assert seen.keys == []
        asked.cancel()
        await asyncio.gather(asked, return_exceptions=True)
