"""Opening an end of Zenoh's bus again: all declarations are restored."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from smartcam._zenoh import BusLink
from smartcam.exceptions import ConfigurationError, ConnectFailedError
from smartcam.fleet._inside import ZenohConnection
from tests.fleet.fleetkit import PATIENCE, until
from tests.fleet.test_zenoh import two_ends
from tests.processes import free_place

pytestmark = pytest.mark.real_time


async def test_all_is_there_again() -> None:
    async with two_ends() as (listens, connects):
        heard: list[tuple[str, bytes]] = []
        seen: list[tuple[str, bool]] = []
        told: list[bool] = []
        listens.subscribe("test/**", lambda key, payload: heard.append((key, payload)))
        listens.answer("question", answer)
        listens.watch("there/*", lambda key, present: seen.append((key, present)))
        publisher = listens.publisher("topic/a", told.append)
        closed = listens.announce("here/closed")
        listens.announce("here/a")
        came: list[bytes] = []
        known: list[tuple[str, bool]] = []
        connects.subscribe("topic/*", lambda _, payload: came.append(payload))
        connects.watch("here/*", lambda key, present: known.append((key, present)))
        connects.announce("there/stays")
        goes = connects.announce("there/goes")
        await until(lambda: len(seen) == 2 and len(known) == 2 and publisher.has_subscribers)
        closed.close()
        await until(lambda: len(known) == 3)
        seen.clear()
        known.clear()
        told.clear()

        reopening = asyncio.ensure_future(listens.reopen(PATIENCE))
        await asyncio.sleep(0)
        assert not listens.opened
        listens.announce("here/meanwhile")
        early = listens.publisher("topic/b")
        early.put(b"nobody hears it")
        listens.announce("here/taken back").close()
        goes.close()
        await reopening

        await until(
            lambda: (
                ("there/stays", True) in seen
                and publisher.has_subscribers
                and early.has_subscribers
            )
        )
        # both are gone with the session; who has gone while there was none does not come back
        assert sorted(seen[:2]) == [("there/goes", False), ("there/stays", False)]
        assert [one for one in seen[2:] if one[1]] == [("there/stays", True)]
        assert told[-1:] == [True]
        await until(lambda: {("here/a", True), ("here/meanwhile", True)} <= {*known})
        assert {key for key, present in known if present} == {"here/a", "here/meanwhile"}
        publisher.put(b"1")
        early.put(b"2")
        connects.put("test/b", b"3")
        await until(lambda: len(came) == 2 and {*heard} == {("test/b", b"3")})
        assert await connects.ask("question", b"", PATIENCE) == [("question", b"answer")]


def answer(question: Any) -> None:
    question.reply("question", b"answer")
    question.close()


async def test_publisher_that_nobody_hears_any_more_is_told() -> None:
    async with two_ends() as (listens, connects):
        told: list[bool] = []
        publisher = listens.publisher("topic/a", told.append)
        hears = connects.subscribe("topic/a", lambda *_: None)
        await until(lambda: publisher.has_subscribers)
        reopening = asyncio.ensure_future(listens.reopen(PATIENCE))
        await asyncio.sleep(0)
        hears.close()
        await reopening
        await until(lambda: not publisher.has_subscribers)
        assert told[-1] is False


async def test_again_where_it_could_not_listen() -> None:
    place = free_place()
    one = ZenohConnection(BusLink(listen=(place,)))
    await one.open(PATIENCE)
    found: list[str] = []
    one.subscribe("test", lambda key, _: found.append(key))
    link, one._link = one._link, BusLink(listen=("tcp/192.0.2.1:7447",))  # nobody's here
    with pytest.raises(ConnectFailedError, match=r"cannot listen on tcp/192\.0\.2\.1:7447"):
        await one.reopen(PATIENCE)
    assert not one.opened
    one.put("test", b"")  # is lost
    one._link = link
    await one.reopen(PATIENCE)
    one.put("test", b"")
    await until(lambda: found == ["test"])
    await one.close()
    with pytest.raises(ConfigurationError, match="is not open"):
        await one.reopen(PATIENCE)


@pytest.mark.parametrize("turns", [1, 2, 3, 5, 8])
async def test_cancelled(turns: int) -> None:
    """At any await: it closes, or is opened again."""
    one = ZenohConnection(BusLink(listen=(free_place(),)))
    await one.open(PATIENCE)
    for number in range(100):
        one.announce(f"here/{number}")
    task = asyncio.ensure_future(one.reopen(PATIENCE))
    for _ in range(turns):
        await asyncio.sleep(0.01 if turns > 3 else 0)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    await one.close()
    assert not one.opened
