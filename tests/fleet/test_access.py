"""Rights: each role, each kind of message, each key, by the engine's own rules."""

from __future__ import annotations

import asyncio
import contextlib
import importlib
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

from smartcam.fleet._agent.calls import ACTIONS
from smartcam.fleet._bus.keys import COMMANDS
from smartcam.fleet._inside import Keys, ZenohConnection, may_command, patterns_overlap
from tests.fleet.fleetkit import PATIENCE, until
from tests.fleet.inside import RIGHTS, ROLES, SERVICES, THESIS, ros_rights
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
    return said.replace("**", "line1/cam3").replace("$*", "x").replace("*", "x")


def keys_of(does: str) -> list[str]:
    """Return all keys with which something is tried: whoever may do anything with them."""
    found = [concrete(key) for right in TABLE for key in right.keys] + FOREIGN
    return [*dict.fromkeys(found)]


def allowed(role: str, does: str, key: str) -> bool:
    """Return True if the table has the right."""
    if role == "router":
        return True
    return any(
        role in right.roles
        and right.use == does
        and any(patterns_overlap(one, key) for one in right.keys)
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
) -> AsyncIterator[tuple[str, ZenohConnection, ZenohConnection]]:
    """Give a role, an end with it, and the one that guards."""
    async with (
        guarded(plant, DOMAIN) as (guard, place),
        joined(place, plant / WHO[request.param]) as end,
    ):
        yield request.param, end, guard


Ends = tuple[str, ZenohConnection, ZenohConnection]


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


async def known(end: ZenohConnection, guard: ZenohConnection, role: str) -> None:
    """Wait until all that an end has declared is known: in order, its presence at last."""
    seen = Seen()
    watch = guard.watch(KEYS.program("*"), seen)
    end.announce(KEYS.program(f"{role}-{MARK}"))
    await seen.mark(KEYS.program(f"{role}-{MARK}"))
    watch.close()


async def test_say(ends: Ends) -> None:
    role, end, guard = ends
    seen = Seen()
    for pattern in ("**", "**/@adv/**", "@ros2_lv/**"):
        guard.subscribe(pattern, seen)
    mark = KEYS.ask(role, MARK, MARK)
    for key in keys_of("put"):
        end.put(key, b"")
    end.put("smartcam/plant/*/x/line1/cam3", b"")  # a pattern means commands, too
    end.put("smartcam/**", b"")
    end.put(mark, b"")
    came = await seen.mark(mark)
    patterns = {key for key in came if "*" in key}
    assert came - patterns == expected(role, "put")
    assert bool(patterns) == (role == "router")


async def test_hear(ends: Ends) -> None:
    role, end, guard = ends
    seen = Seen()
    mark = KEYS.states(MARK)
    for key in [*keys_of("subscribe"), mark]:
        end.subscribe(key, seen)
    everything = Seen()
    end.subscribe("smartcam/**", everything)
    await known(end, guard, role)
    for key in [*keys_of("subscribe"), mark]:
        guard.put(key, b"")
    assert await seen.mark(mark) == expected(role, "subscribe")
    assert {*everything.keys} - {mark} <= expected(
        role, "subscribe"
    )  # a wide pattern brings no more


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
    asking = {key: asyncio.ensure_future(end.ask(key, b"", PATIENCE)) for key in keys_of("query")}
    await asyncio.sleep(0)  # they ask
    assert await end.ask(mark, b"", PATIENCE) == [(mark, b"yes")]
    assert await seen.mark(mark) == expected(role, "query")
    for key in expected(role, "query"):
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
    for key in keys_of("announce"):
        end.announce(key)
    end.announce(KEYS.program(f"{role}-{MARK}"))
    assert await seen.mark(KEYS.program(f"{role}-{MARK}")) == expected(role, "announce")


async def test_watch(ends: Ends) -> None:
    role, end, guard = ends
    mark = KEYS.agent(MARK)
    for key in [*keys_of("watch"), mark]:
        guard.announce(key)
    seen = Seen()
    for key in [*keys_of("watch"), mark]:
        end.watch(key, seen)
    assert await seen.mark(mark) == expected(role, "watch")


async def test_look_who_is_there(ends: Ends) -> None:
    role, end, guard = ends
    mark = KEYS.agent(MARK)
    for key in [*keys_of("watch"), mark]:
        guard.announce(key)
    asking = {
        key: asyncio.ensure_future(end.present_keys(key, PATIENCE)) for key in keys_of("watch")
    }
    await asyncio.sleep(0)  # they ask
    assert await end.present_keys(mark, PATIENCE) == [mark]
    for key, one in asking.items():
        if allowed(role, "watch", key):
            assert await one == [key]
        assert not one.done() or await one == ([key] if allowed(role, "watch", key) else [])
        one.cancel()
    await asyncio.gather(*asking.values(), return_exceptions=True)


# ---------------------------------------------------------------------- calls and services

QUESTIONS = {
    *(
        "hello",
        "find_first_result",
        "reserved",
        "results",
        "states",
        "refresh_status",
        "about_frames",
        "frame",
        "next_frame",
    ),
    *("end_stream", "lens", "query_application", "query_status", "wait_connected", "wait_ready"),
    *("read_image", "get_clock", "features"),
}
"""Calls that were looked at, and change nothing: a new one has to be, too."""

LOOKING = {
    *("status", "results", "frame", "query_application", "query_status", "wait_ready"),
    *("get_clock", "read_image", "features"),
}


@pytest.mark.parametrize("role", ROLES[:3])
@pytest.mark.parametrize("do", ACTIONS)
def test_each_call(role: str, do: str) -> None:
    key = KEYS.command("line1", "line1/cam3")
    if do not in COMMANDS:
        key = KEYS.ask(role, "line1", "line1/cam3")
    assert allowed(role, "put", key) == (do in QUESTIONS or role == "operator")
    assert may_command(role) == (role == "operator")


@pytest.mark.parametrize("role", ROLES[:3])
def test_each_service(role: str) -> None:
    for name in SERVICES:
        may = allowed(role, "query", KEYS.service("line1/cam3", name))
        assert may == (name in LOOKING or role == "operator"), name
    for name in THESIS:
        assert allowed(role, "query", KEYS.thesis(name)) == (role == "operator")
    camera_named_so = KEYS.service("line1/status", "trigger")
    assert allowed(role, "query", camera_named_so) == (role == "operator")


async def test_certificate_without_a_role_may_nothing(plant: Path, tmp_path: Path) -> None:
    """Its common name is none of the roles: it comes in, and sees nobody."""
    from smartcam.fleet._security import authority as _authority

    folder = tmp_path / "plant"
    folder.mkdir()
    (folder / "authority").symlink_to(plant / "authority")
    authority = _authority._Authority.open_or_create(folder)
    authority.make_certificate("visitor", "somebody", [], _authority.LIFETIME)
    async with (
        guarded(plant) as (guard, place),
        joined(place, folder / "somebody") as end,
        joined(place, plant / "dashboard") as viewer,
    ):
        guard.announce(KEYS.agent("line1"))
        seen, heard = Seen(), Seen()
        guard.subscribe("**", heard)
        end.watch("**", seen)
        for key in keys_of("put"):
            end.put(key, b"")
        asked = asyncio.ensure_future(end.present_keys(KEYS.agent("*"), PATIENCE))
        assert await viewer.present_keys(KEYS.agent("*"), PATIENCE) == [KEYS.agent("line1")]
        mark = KEYS.ask("viewer", "a", MARK)
        viewer.put(mark, b"")
        assert await heard.mark(mark) == set()
        assert seen.keys == []
        asked.cancel()
        await asyncio.gather(asked, return_exceptions=True)


# ---------------------------------------------------------------------- patterns

WIDE = (
    "**",
    "smartcam/**",
    "smartcam/*/**",
    "smartcam/plant/**",
    "smartcam/plant/command/**",
    "smartcam/plant/*/*/line1/cam3",
    "smartcam/plant/ask/**",
    "smartcam/plant/ask/*/*/line1/cam3",
    "smartcam/plant/reply/**",
    "smartcam/plant/service/**",
    "smartcam/plant/*/line1/cam3/trigger",
    "smartcam/plant/service/line1/*/trigger",
    "smartcam/plant/thesis/**",
    "smartcam/plant/presence/**",
    "smartcam/plant/presence/program/**",
    "smartcam/plant/presence/*/operator-robot.secret",
    "smartcam/plant/administer/**",
    "smartcam/plant/states/**",
    "smartcam/plant/topic/**",
    "smartcam/plant/summary/**",
)
"""Patterns that mean more than any role may do."""

MINE = "operator-robot.secret"


def covered(role: str, does: str, pattern: str) -> bool:
    """Return True if the table allows all that a pattern means."""
    expression: Any = importlib.import_module("zenoh").KeyExpr
    return any(
        expression(one).includes(expression(pattern))
        for right in TABLE
        if role in right.roles and right.use == does
        for one in right.keys
    )


@pytest.mark.parametrize("ends", ROLES[:3], indirect=True)  # a router passes everything on
async def test_wide_pattern_does_nothing_at_keys_that_the_role_may_not_use(ends: Ends) -> None:
    """Do nothing for a pattern: messages under it would be heard by all who mean a part of it."""
    role, end, guard = ends
    said, asked, present = Seen(), Seen(), Seen()

    def answer(question: Any) -> None:
        asked(question.key)
        question.close()

    mark = KEYS.ask(role, MARK, MARK)
    guard.subscribe("**", said)
    guard.answer("**", answer)
    guard.watch("**", present)
    for pattern in WIDE:
        end.put(pattern, b"forged")
        end.session.delete(pattern)
        end.answer(pattern, lambda question: question.reply(question.key, b"forged"))
        with contextlib.suppress(Exception):  # some are no keys to be present under
            end.announce(pattern)
    asking = [asyncio.ensure_future(end.ask(one, b"", PATIENCE)) for one in WIDE]
    await asyncio.sleep(0)
    await known(end, guard, role)
    end.put(mark, b"")
    assert await said.mark(mark) <= {one for one in WIDE if covered(role, "put", one)}
    assert await end.ask(KEYS.listing(MARK), b"", PATIENCE) == []  # which came behind
    allowed_to_ask = {one for one in WIDE if covered(role, "query", one)} | {KEYS.listing(MARK)}
    assert {*asked.keys} <= allowed_to_ask
    own = {KEYS.program(f"{role}-{MARK}")}
    assert {*present.keys} - own <= {one for one in WIDE if covered(role, "announce", one)}
    for key in (KEYS.service("line1/cam3", "trigger"), KEYS.summary("line1"), KEYS.reload("x")):
        forged = [(key, b"forged")] if allowed(role, "answer", key) else []
        assert await guard.ask(key, b"", 1.0) in ([], forged)
    for one in asking:
        one.cancel()
    await asyncio.gather(*asking, return_exceptions=True)


@pytest.mark.sampled(every=4)
@pytest.mark.parametrize("ends", ["viewer", "operator"], indirect=True)  # others see all
@pytest.mark.parametrize("pattern", WIDE)
async def test_wide_pattern_brings_no_operator_what_is_for_agents(ends: Ends, pattern: str) -> None:
    """Secrets of other programs are in their presence and their calls, which agents alone see."""
    role, end, guard = ends
    heard, seen = Seen(), Seen()
    end.subscribe(pattern, heard)
    end.watch(pattern, seen)
    end.subscribe(KEYS.states(MARK), heard)
    end.watch(KEYS.agent(MARK), seen)
    await known(end, guard, role)
    for key in (KEYS.command("line1", "cam3"), KEYS.ask("operator", "line1", "cam3")):
        guard.put(key, b"")
    guard.announce(KEYS.program(MINE))
    guard.announce(KEYS.agent(MARK))
    guard.put(KEYS.states(MARK), b"")
    assert not any(
        "/command/" in one or "/ask/" in one for one in await heard.mark(KEYS.states(MARK))
    )
    assert KEYS.program(MINE) not in await seen.mark(KEYS.agent(MARK))
