"""The proxy on UDP, between bare sockets: rules for the first, a middle and the last datagram."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import AsyncIterator
from typing import NamedTuple

import pytest

from smartcam import ConfigurationError
from smartcam.testing.proxy import (
    DelayDatagrams,
    DropDatagrams,
    DuplicateDatagrams,
    LinkProxy,
    Reorder,
    Rule,
)
from smartcam.testing.proxy import _udp as udp
from tests.handmade import until
from tests.testing.inside import Direction, Entry
from tests.testing.proxykit import HOST, SHORT, Mailbox, mailbox

FIVE = [b"1", b"2", b"3", b"4", b"5"]


class Linked(NamedTuple):
    """A client and a camera's place with a proxy between."""

    proxy: LinkProxy
    client: Mailbox
    camera: Mailbox


@contextlib.asynccontextmanager
async def linked(*rules: Rule, echo: bool = True) -> AsyncIterator[Linked]:
    """An echo server, a proxy before it, and a client."""
    async with (
        mailbox(echo=echo) as camera,
        LinkProxy(HOST, camera.port, transport="udp", rules=rules) as proxy,
        mailbox(proxy.port) as client,
    ):
        yield Linked(proxy, client, camera)


async def receives(box: Mailbox, expected: list[bytes]) -> None:
    """Wait until exactly these came, in this order."""
    await until(lambda: len(box.received) >= len(expected))
    assert box.received == expected


async def stays_silent(box: Mailbox) -> None:
    """Assert that nothing more comes while a timeout has the time to fire."""
    before = len(box.received)
    with pytest.raises(TimeoutError):
        await until(lambda: len(box.received) > before, SHORT)


async def test_datagrams_pass_both_ways_and_stay_whole() -> None:
    sent = [b"a", bytes(1472), bytes(40_000)]
    async with linked() as (proxy, client, camera):
        client.send(*sent)
        await receives(client, sent)
        assert camera.received == sent
        assert proxy.passed == {"up": 3, "down": 3}
        assert list(proxy.log) == [Entry("connect", 1)]


async def test_clients_are_kept_apart() -> None:
    async with linked() as (proxy, client, camera), mailbox(proxy.port) as other:
        client.send(b"a")
        other.send(b"b")
        await receives(client, [b"a"])
        await receives(other, [b"b"])
        assert len(camera.peers) == proxy.open_connections == 2


@pytest.mark.parametrize("number", [1, 3, 5])
@pytest.mark.parametrize("direction", ["up", "down"])
async def test_lost_datagram_is_the_one_that_is_meant(direction: Direction, number: int) -> None:
    left = [one for one in FIVE if one != b"%d" % number]
    async with linked(DropDatagrams(number=number, direction=direction)) as (proxy, client, camera):
        client.send(*FIVE)
        await receives(client, left)
        assert camera.received == (FIVE if direction == "down" else left)
        assert proxy.log[-1] == Entry("drop", 1, direction, number)


@pytest.mark.parametrize("number", [1, 3, 5])
async def test_repeated_datagram_comes_again_at_once(number: int) -> None:
    async with linked(DuplicateDatagrams(number=number, copies=2)) as (proxy, client, _):
        client.send(*FIVE)
        again = FIVE[number - 1 : number] * 2
        await receives(client, FIVE[:number] + again + FIVE[number:])
        assert proxy.passed["down"] == 7


@pytest.mark.parametrize(
    ("number", "order"), [(1, b"23145"), (3, b"12453"), (4, b"12354"), (5, b"12345")]
)
async def test_reordered_datagram_comes_after_two_others_or_at_its_time(
    number: int, order: bytes
) -> None:
    async with linked(Reorder(number=number, overtaken_by=2, seconds=SHORT)) as (_, client, _):
        client.send(*FIVE)
        await receives(client, [order[at : at + 1] for at in range(5)])


async def test_late_datagram_is_overtaken() -> None:
    loop = asyncio.get_running_loop()
    async with linked(DelayDatagrams(number=2, seconds=SHORT, jitter=0.01)) as (_, client, _):
        begin = loop.time()
        client.send(*FIVE)
        await receives(client, [b"1", b"3", b"4", b"5", b"2"])
        assert loop.time() - begin >= SHORT * 0.8


async def test_late_and_reordered_datagram_is_both() -> None:
    late, twice = DelayDatagrams(number=1, seconds=SHORT), DuplicateDatagrams(number=1)
    async with linked(Reorder(number=1, overtaken_by=4), late, twice) as (proxy, client, _):
        client.send(*FIVE)
        await receives(client, [b"2", b"3", b"4", b"5"])
        await proxy.wait_passed("down", 6)
        await until(lambda: client.received[4:] == [b"1", b"1"])


async def test_chance_is_the_same_again_with_the_same_seed() -> None:
    sent = [b"%d" % number for number in range(60)]
    kept: list[list[bytes]] = []
    for seed in (1, 1, 2):
        async with linked(DropDatagrams(probability=0.5, seed=seed)) as (proxy, client, _):
            client.send(*sent)
            await until(lambda: proxy.passed["down"] + proxy.counts["drop"] == len(sent))
            await until(lambda: len(client.received) == proxy.passed["down"])
            kept.append(client.received)
    assert kept[0] == kept[1] != kept[2]
    assert 10 < len(kept[0]) < 50


async def test_rule_for_the_second_client_leaves_the_first() -> None:
    rules = [DropDatagrams(connection=2, number=1, direction="up")]
    async with linked(*rules) as (proxy, client, camera), mailbox(proxy.port) as other:
        client.send(b"a")
        await receives(client, [b"a"])
        other.send(b"b", b"c")
        await receives(other, [b"c"])
        assert camera.received == [b"a", b"c"]


async def test_rule_from_now_counts_from_here() -> None:
    async with linked() as (proxy, client, _):
        client.send(b"a", b"b")
        await receives(client, [b"a", b"b"])
        proxy.from_now(DropDatagrams(number=2, direction="up"), DuplicateDatagrams())
        client.send(b"c", b"d", b"e")
        await receives(client, [b"a", b"b", b"c", b"c", b"e", b"e"])


@pytest.mark.parametrize("direction", ["up", "down", None])
async def test_stall_loses_what_comes_meanwhile(direction: Direction | None) -> None:
    async with linked() as (proxy, client, camera):
        proxy.stall(direction)
        client.send(b"a")
        await proxy.wait_for("stall", 2)
        await stays_silent(client)
        assert camera.received == ([b"a"] if direction == "down" else [])
        proxy.resume()
        client.send(b"b")
        await receives(client, [b"b"])


async def test_stall_of_one_client_is_not_possible() -> None:
    async with linked() as (proxy, _, _):
        with pytest.raises(ConfigurationError, match="on UDP a stall is for every client"):
            proxy.stall(connection=1)
        assert proxy.counts["stall"] == 0


async def test_refused_port_is_the_systems_own_refusal() -> None:
    async with linked() as (proxy, client, _):
        client.send(b"a")
        await receives(client, [b"a"])
        proxy.refuse()
        proxy.refuse()
        client.send(b"b")
        await until(lambda: client.error)
        assert isinstance(client.error, ConnectionRefusedError)
        proxy.refuse(False)
        client.send(b"c")
        await receives(client, [b"a", b"c"])


async def test_answer_to_a_refused_port_is_counted() -> None:
    async with linked(echo=False) as (proxy, client, camera):
        client.send(b"a")
        await receives(camera, [b"a"])
        proxy.refuse()
        camera.transport.sendto(b"b", camera.peers[0])
        await proxy.wait_for("refused")
        assert proxy.passed == {"up": 1}


async def test_target_that_is_not_there_is_counted() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind((HOST, 0))
        sock.connect((HOST, 9))  # takes datagrams of that peer alone
        port = sock.getsockname()[1]
        async with LinkProxy(HOST, port, transport="udp") as proxy, mailbox(proxy.port) as client:
            client.send(b"a")
            await proxy.wait_for("no target")
            client.send(b"b")
            await proxy.wait_for("no target", 2)


@pytest.mark.parametrize("end", ["cut", "reset"])
async def test_ended_client_is_a_new_one_when_it_speaks_again(end: str) -> None:
    async with linked() as (proxy, client, camera):
        client.send(b"a")
        await receives(client, [b"a"])
        getattr(proxy, end)()
        assert proxy.open_connections == 0
        client.send(b"b")
        await receives(client, [b"a", b"b"])
        assert len(camera.peers) == proxy.counts["connect"] == 2


async def test_client_that_was_answered_lately_keeps_its_place(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(udp, "MAX_CLIENTS", 1)
    async with linked() as (proxy, client, _), mailbox(proxy.port) as other:
        client.send(b"a")
        await receives(client, [b"a"])
        other.send(b"b")
        await proxy.wait_for("turned away")
        client.send(b"c")
        await receives(client, [b"a", b"c"])
        await asyncio.sleep(udp.ANSWERED_GRACE)
        other.send(b"d")
        await receives(other, [b"d"])
        assert proxy.open_connections == 1


async def test_client_that_was_never_answered_makes_room(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(udp, "MAX_CLIENTS", 1)
    async with linked(echo=False) as (proxy, client, camera), mailbox(proxy.port) as other:
        client.send(b"a")
        await receives(camera, [b"a"])
        other.send(b"b")
        await receives(camera, [b"a", b"b"])
        assert proxy.open_connections == 1


async def test_datagrams_held_back_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(udp, "MAX_WAITING_DATAGRAMS", 2)
    async with linked(DelayDatagrams(seconds=SHORT)) as (proxy, client, _):
        client.send(*FIVE)
        await proxy.wait_for("full", 3)
        await receives(client, [b"1", b"2"])


async def test_forgotten_client_gets_nothing_that_was_held_back() -> None:
    rules = [
        DelayDatagrams(number=1, seconds=SHORT / 2),
        Reorder(number=2, overtaken_by=9, seconds=SHORT / 2),
    ]
    async with linked(*rules) as (proxy, client, _):
        client.send(b"1", b"2")
        await proxy.wait_for("reorder")
        proxy.reset()
        await stays_silent(client)


async def test_closing_forgets_what_is_on_its_way() -> None:
    rules = [DelayDatagrams(number=1, seconds=60), Reorder(number=2, overtaken_by=9, seconds=60)]
    async with mailbox(echo=True) as camera:
        async with (
            LinkProxy(HOST, camera.port, transport="udp", rules=rules) as proxy,
            mailbox(proxy.port) as client,
        ):
            client.send(b"1", b"2")
            await proxy.wait_for("reorder")
        assert proxy.open_connections == 0
        assert proxy.passed == {"up": 2}
