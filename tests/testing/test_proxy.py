"""The proxy as a test uses it: addresses, rules, its log, and a real client through it."""

from __future__ import annotations

import asyncio
import socket
from random import Random
from typing import TYPE_CHECKING, Any

import pytest

import smartcam
from smartcam import ConfigurationError, ConnectFailedError, TriggerTimeoutError
from smartcam.emulator import EmulatedCamera
from smartcam.testing.proxy import (
    CoalesceBytes,
    Cut,
    DelayBytes,
    DelayDatagrams,
    Drip,
    DropDatagrams,
    DuplicateBytes,
    DuplicateDatagrams,
    Flip,
    InsertBytes,
    LinkProxy,
    Rate,
    Reorder,
    SplitBytes,
    Stall,
)
from tests.testing.inside import MAX_COPY_BYTES, MAX_RULE_BYTES, Entry
from tests.testing.inside import _log as log
from tests.testing.proxykit import HOST, MESSAGE, SHORT, client, linked, target

if TYPE_CHECKING:
    from collections.abc import Callable

CONNECT_ANSWER = 16
"""Bytes of the answer to Connect in the dialect handbook; the status after it has 20."""


@pytest.mark.parametrize(
    ("of", "expected"),
    [
        ("bvs://10.0.0.1:36701?dialect=thesis", "bvs://127.0.0.1:{port}?dialect=thesis"),
        ("bvs+udp://camera", "bvs+udp://127.0.0.1:{port}"),
        ("bvs://[::1]:5?dialect=b16", "bvs://127.0.0.1:{port}?dialect=b16"),
    ],
)
async def test_url_is_the_same_but_for_the_address(of: str, expected: str) -> None:
    async with target() as camera, LinkProxy("localhost", camera.port) as proxy:
        assert proxy.url(of) == expected.format(port=proxy.port)


async def test_name_of_the_target_is_resolved() -> None:
    async with (
        target(echo=True) as camera,
        LinkProxy("localhost", camera.port) as proxy,
        client(proxy.port) as end,
    ):
        end.write(MESSAGE)
        await end.wait_data(MESSAGE)


async def test_wait_ends_at_its_deadline_and_says_how_far_it_came() -> None:
    async with linked() as (proxy, _, _):
        with pytest.raises(TimeoutError, match=r"'connect' came to 1 in 0.05 s, not to 2"):
            await proxy.wait_for("connect", 2, timeout=SHORT)
        with pytest.raises(TimeoutError, match=r"'up' came to 0 in 0.05 s, not to 3"):
            await proxy.wait_passed("up", 3, timeout=SHORT)


async def test_log_is_bounded_and_the_counts_are_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(log, "MAX_ENTRIES", 2)
    async with linked() as (proxy, _, _):
        proxy.resume()
        proxy.stall("up", connection=1)
        proxy.resume()
        assert list(proxy.log) == [Entry("stall", 1, "up"), Entry("resume")]
        assert proxy.counts == {"connect": 1, "resume": 2, "stall": 1}


async def test_direction_that_is_none_is_refused() -> None:
    async with linked() as (proxy, _, _):
        with pytest.raises(ConfigurationError, match="direction is 'up', 'down' or None"):
            proxy.stall("left")  # type: ignore[arg-type]


async def test_rule_of_the_other_transport_is_refused_from_now() -> None:
    async with linked() as (proxy, _, _):
        with pytest.raises(ConfigurationError, match="it means nothing on TCP"):
            proxy.from_now(DropDatagrams())


async def test_port_is_free_again_after_it() -> None:
    async with target() as camera:
        async with LinkProxy(HOST, camera.port) as proxy:
            pass
        with pytest.raises(ConnectionRefusedError):
            async with client(proxy.port):
                pass
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        async with LinkProxy(HOST, 9, transport="udp") as proxy:
            pass
        sock.bind((HOST, proxy.port))


# ---------------------------------------------------------------------- with a client


async def test_client_does_not_mind_how_the_bytes_come() -> None:
    rules = [Drip(), Drip(direction="up"), SplitBytes(at=CONNECT_ANSWER)]
    async with (
        EmulatedCamera(active=7) as emulator,
        LinkProxy(emulator.host, emulator.port, rules=rules) as proxy,
        smartcam.connect(proxy.url(emulator.url), application=7) as camera,
    ):
        assert (await camera.trigger()).application == 7
        assert proxy.counts["drip"] == 2


async def test_client_is_told_of_a_cut_link() -> None:
    async with (
        EmulatedCamera(active=7) as emulator,
        LinkProxy(emulator.host, emulator.port) as proxy,
        smartcam.connect(proxy.url(emulator.url)) as camera,
    ):
        events = camera.events()
        proxy.kill()
        async with asyncio.timeout(5):
            while not isinstance(await anext(events), smartcam.Disconnected):
                pass


async def test_client_refuses_a_broken_frame() -> None:
    rules = [Flip(at=CONNECT_ANSWER + 20)]  # the magic number of what follows the status
    async with (
        EmulatedCamera(active=7) as emulator,
        LinkProxy(emulator.host, emulator.port, rules=rules) as proxy,
    ):
        with pytest.raises(ConnectFailedError) as caught:
            async with smartcam.connect(proxy.url(emulator.url), connect_attempts=1):
                pass
        assert "wrong magic number" in str(caught.value)


async def test_client_gets_no_result_from_a_stalled_camera() -> None:
    async with (
        EmulatedCamera(active=7) as emulator,
        LinkProxy(emulator.host, emulator.port) as proxy,
        smartcam.connect(
            proxy.url(emulator.url), application=7, close_timeout=SHORT, request_timeout=SHORT
        ) as camera,
    ):
        proxy.stall("down")
        with pytest.raises(TriggerTimeoutError):
            await camera.trigger(timeout=SHORT)


async def test_client_on_udp_asks_again_where_the_answer_is_lost() -> None:
    drop = DropDatagrams(number=1, connection=1)
    async with (
        EmulatedCamera(active=7, transport="udp") as emulator,
        LinkProxy(emulator.host, emulator.port, transport="udp", rules=[drop]) as proxy,
        smartcam.connect(proxy.url(emulator.url), connect_timeout=2) as camera,
    ):
        assert camera.active_application == 7
        assert proxy.counts["drop"] == 1
        assert proxy.counts["connect"] == 2


async def test_stall_at_the_greeting_is_silence_to_a_client() -> None:
    async with (
        EmulatedCamera(active=7) as emulator,
        LinkProxy(emulator.host, emulator.port, rules=[Stall(both=True)]) as proxy,
    ):
        with pytest.raises(ConnectFailedError):
            async with smartcam.connect(
                proxy.url(emulator.url), connect_timeout=SHORT, connect_attempts=1
            ):
                pass
        assert proxy.passed == {}


# ---------------------------------------------------------------------- rules


WRONG: list[tuple[Callable[[], object], str]] = [
    (lambda: Cut(at=-1), "at must be 0 or more bytes"),
    (lambda: Cut(connection=0), "connections count from 1"),
    (lambda: Cut(direction="left"), "direction must be 'up' or 'down'"),  # type: ignore[arg-type]
    (lambda: Flip(at=-1), "at must be 0 or more bytes"),
    (lambda: Flip(count=0), "count must be 1 or more bytes"),
    (lambda: Flip(mask=0), "mask must be 1 to 255"),
    (lambda: SplitBytes(pause=-1), "pause must be 0 or more seconds"),
    (lambda: Drip(pause=-1), "pause must be 0 or more seconds"),
    (lambda: CoalesceBytes(size=MAX_RULE_BYTES + 1), "size must be 1 to 65536 bytes"),
    (lambda: CoalesceBytes(size=1, seconds=0), "seconds must be more than 0"),
    (lambda: InsertBytes(data=b""), "data must be 1 to 1048576 bytes"),
    (lambda: DuplicateBytes(count=MAX_COPY_BYTES + 1), "count must be at most 1048576 bytes"),
    (lambda: DuplicateBytes(count=None), "count must be at most 1048576 bytes"),
    (lambda: DelayBytes(seconds=-1), "times must be 0 or more seconds"),
    (lambda: DelayBytes(seconds=1, jitter=-1), "times must be 0 or more seconds"),
    (lambda: Rate(bytes_per_second=0), "the rate must be more than 0"),
    (lambda: DropDatagrams(number=0), "datagrams count from 1"),
    (lambda: DropDatagrams(probability=1.5), "probability must be 0 to 1"),
    (lambda: DuplicateDatagrams(copies=0), "copies must be 1 to 100"),
    (lambda: DelayDatagrams(seconds=-1), "times must be 0 or more seconds"),
    (lambda: Reorder(overtaken_by=0), "overtaken_by must be 1 or more datagrams"),
    (lambda: Reorder(seconds=0), "seconds must be more than 0"),
    (lambda: LinkProxy("h", 1, rules=[DropDatagrams()]), "it means nothing on TCP"),
    (lambda: LinkProxy("h", 1, transport="udp", rules=[Cut()]), "it means nothing on UDP"),
]


@pytest.mark.parametrize(("make", "text"), WRONG)
def test_wrong_argument_is_refused(make: Callable[[], Any], text: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        make()
    assert text in str(caught.value)


def test_wrong_transport_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="transport is 'tcp' or 'udp', not 'can'"):
        LinkProxy("h", 1, transport="can")  # type: ignore[arg-type]


def test_rule_concerns_its_direction_and_connection() -> None:
    assert [Cut().concerns(n, "down") for n in (1, 2)] == [True, True]
    assert [Cut(connection=2).concerns(n, "down") for n in (1, 2)] == [False, True]
    assert not Cut().concerns(1, "up")


def chance(seed: int) -> Random:
    return Random(seed)  # noqa: S311 - no secret


def test_number_picks_one_datagram() -> None:
    assert [n for n in range(1, 6) if DropDatagrams(number=3).picks(n, chance(0))] == [3]


def test_probability_picks_the_same_again_with_the_same_seed() -> None:
    rule = DropDatagrams(probability=0.3)
    first, second = ([rule.picks(n, one) for n in range(1000)] for one in (chance(5), chance(5)))
    assert first == second
    assert 200 < sum(first) < 400
