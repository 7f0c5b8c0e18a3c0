"""Test the search for cameras: which ports it finds, how fast, and that clients stay unharmed."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from typing import TYPE_CHECKING, Any

import pytest

import smartcam
from smartcam import Backoff, ConfigurationError
from smartcam.doctor import _search
from smartcam.doctor._inside import CameraSearch, FoundPort
from smartcam.doctor._opening import MAX_UNASKED_BYTES, OpenedPort, is_connected_to_itself
from smartcam.emulator import EmulatedCamera, EmulatedInSight
from smartcam.protocols import BVS, Protocol, Transport
from smartcam.registry import PROTOCOLS
from tests.doctor.findkit import NETWORK, RefusesAtOnce, TakenAtOnce, filtered, free_port, listening
from tests.handmade import until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

WELCOME = b"Welcome to In-Sight(tm)  8502P Session 0\r\nUser: "


async def found_on(port: int, *networks: str, **options: Any) -> list[FoundPort]:
    """Return the found ports of this process's network that the first two protocols use."""
    known = ("bvs", "insight")
    options = {"ports": [port], "protocols": known, "may_disturb": True, **options}
    return await smartcam.find(*(networks or (f"{NETWORK}0/28",)), **options)


def by_last_number(found: list[FoundPort]) -> dict[str, tuple[tuple[str, ...], str]]:
    """Return protocols and evidence by the last number of the address."""
    return {one.host.rpartition(".")[2]: (one.protocols, one.evidence) for one in found}


# ---------------------------------------------------------------------- clients at work


@contextlib.asynccontextmanager
async def working_client(camera: Any, url: str) -> AsyncIterator[tuple[smartcam.Camera, list[int]]]:
    """Run a client that triggers without a pause; yield it and the numbers of its results."""
    results: list[int] = []
    async with smartcam.connect(url, reconnect=None) as client:

        async def work() -> None:
            while True:
                number = (await client.trigger()).number
                results.append(number)

        task = asyncio.create_task(work())
        try:
            yield client, results
        finally:
            if not task.done():
                task.cancel()
            await asyncio.gather(task, return_exceptions=True)
            assert task.cancelled(), task.exception()


def peers_heard(camera: EmulatedCamera | EmulatedInSight) -> set[str]:
    """Return the peers from which a camera has received bytes."""
    return {entry.peer for entry in camera.log if entry.direction == "in"}


async def test_clients_at_work_notice_nothing() -> None:
    port = free_port()
    bvs = [EmulatedCamera(host=f"{NETWORK}{n}", port=port, active=21, running=True) for n in (1, 2)]
    insight = EmulatedInSight(host=f"{NETWORK}3", port=port, online=True)
    async with contextlib.AsyncExitStack() as stack:
        works: list[tuple[smartcam.Camera, list[int], Any]] = []
        for one in (*bvs, insight):
            await stack.enter_async_context(one)
            url = one.url + ("?cells=A1" if one is insight else "")
            works.append((*await stack.enter_async_context(working_client(one, url)), one))
        silent = await stack.enter_async_context(listening(f"{NETWORK}4", port))
        await stack.enter_async_context(listening(f"{NETWORK}5", port, hangs_up=True))
        rubbish = await stack.enter_async_context(listening(f"{NETWORK}6", port, b"\xff\xfd\x18"))
        endless = await stack.enter_async_context(listening(f"{NETWORK}7", port, b"\n" * 9999))
        await asyncio.sleep(0.5)
        sessions = [list(one.sessions) for _, _, one in works]
        before = [len(results) for _, results, _ in works]

        found = await found_on(port)

        assert by_last_number(found) == {
            "1": (("bvs",), "silent"),
            "2": (("bvs",), "silent"),
            "3": (("insight",), "greeted"),
            "4": (("bvs",), "silent"),
            "5": (("bvs", "insight"), "ended"),
            "6": ((), "other"),
            "7": ((), "other"),
        }
        assert [one.urls for one in found[2:3]] == [(f"insight://{NETWORK}3:{port}",)]
        assert len(found[-1].received) == MAX_UNASKED_BYTES
        for (client, results, one), had, session in zip(works, before, sessions, strict=True):
            assert len(results) > had > 0, "it has worked before and meanwhile"
            assert results == list(range(1, len(results) + 1)), "each trigger has had its result"
            seen = client.statistics()
            assert (seen.sessions, seen.triggered) == (1, seen.received)
            assert client.connected
            assert one.sessions == session
            assert peers_heard(one) == set(session)
        others = (silent, rubbish, endless)
        assert [(other.opened, other.received) for other in others] == [(1, b"")] * 3
        await until(lambda: all(other.ended == 1 for other in others))
        peers = {ended.peer for one in bvs for ended in one.ended_connections}
        assert len(peers) == 2, "each was opened once, and closed by us"


@pytest.mark.parametrize("quirks", [{"second_client": "takeover"}, {"second_client": "refuse"}])
async def test_session_stays_whatever_becomes_of_second_clients(quirks: dict[str, str]) -> None:
    port = free_port()
    async with (
        EmulatedCamera(host=f"{NETWORK}1", port=port, quirks=quirks) as emulator,
        smartcam.connect(emulator.url, reconnect=None) as client,
    ):
        assert by_last_number(await found_on(port)) == {"1": (("bvs",), "silent")}
        await client.query_application()
        assert peers_heard(emulator) == set(emulator.sessions)


async def test_camera_of_one_client_is_not_asked_without_consent() -> None:
    port = free_port()
    async with (
        TakenAtOnce(host=f"{NETWORK}1", port=port) as emulator,
        smartcam.connect(emulator.url, reconnect=Backoff(initial=0.1)) as client,
    ):
        session = list(emulator.sessions)
        with pytest.raises(ConfigurationError, match=r"cameras of bvs serve one client.*consent"):
            await found_on(port, may_disturb=False, ask=True)
        await found_on(port, exclude=[f"{NETWORK}1"])
        await found_on(port, exclude=[f"{NETWORK}0/28"])
        await found_on(port, may_disturb=False, ask=True, protocols=["insight"], ports=[])
        assert emulator.sessions == session
        assert not emulator.ended_connections
        # what "exclude" is for: this reading of the documents, and what it costs
        assert by_last_number(await found_on(port, may_disturb=False)) == {
            "1": (("bvs",), "silent")
        }
        await until(lambda: client.connected and emulator.sessions not in ([], session))
        assert client.statistics().reconnects == 1


async def test_camera_that_sends_newcomers_away_is_perhaps_one() -> None:
    port = free_port()
    async with (
        RefusesAtOnce(host=f"{NETWORK}1", port=port) as emulator,
        smartcam.connect(emulator.url, reconnect=None) as client,
    ):
        assert by_last_number(await found_on(port)) == {"1": (("bvs", "insight"), "ended")}
        await client.query_application()


# ---------------------------------------------------------------------- what was heard


@pytest.mark.parametrize(
    ("greeting", "protocols", "evidence"),
    [
        (WELCOME, ("insight",), "greeted"),
        (b"\r\n" + WELCOME, ("insight",), "greeted"),
        (b"Welcome to In-Sight", ("insight",), "greeted"),
        (b"Welcome to In", (), "other"),
        (b"Welcome to the switch\r\n", (), "other"),
        (b"SSH-2.0-x\r\n", (), "other"),
        (bytes.fromhex("50535642 04000000 01000000 01000000"), (), "other"),
    ],
)
async def test_what_comes_by_itself_tells(
    greeting: bytes, protocols: tuple[str, ...], evidence: str
) -> None:
    port = free_port()
    async with listening(f"{NETWORK}1", port, greeting):
        (found,) = await found_on(port, f"{NETWORK}1")
    assert (found.protocols, found.evidence, found.received) == (protocols, evidence, greeting)


async def test_silence_is_no_insight_camera() -> None:
    port = free_port()
    async with listening(f"{NETWORK}1", port):
        (found,) = await found_on(port, f"{NETWORK}1", protocols=["insight"], may_disturb=False)
    assert (found.protocols, found.evidence, found.urls) == ((), "other", ())


async def test_plug_in_says_port_and_greeting(monkeypatch: pytest.MonkeyPatch) -> None:
    port = free_port()

    def known(name: str, **options: Any) -> None:
        schemes = {name: Transport.TCP}
        made = Protocol(
            name=name,
            schemes=schemes,
            default_port=port,
            models=(),
            dialects=BVS.dialects,
            machine=BVS.machine,
            **options,
        )
        monkeypatch.setitem(PROTOCOLS._registered, name, made)
        monkeypatch.setitem(PROTOCOLS._loaded, name, made)

    known("unsaid")
    known("polite", greeting=b"HELLO")
    async with (
        listening(f"{NETWORK}1", port, b"HELLO\n"),
        listening(f"{NETWORK}2", port, b"ho\n"),
        listening(f"{NETWORK}3", port),
    ):
        found = await smartcam.find(f"{NETWORK}0/29", may_disturb=True)
    assert by_last_number(found) == {
        "1": (("polite",), "greeted"),
        "2": (("unsaid",), "said"),
        "3": (("unsaid",), "silent"),
    }


async def test_asking_speaks_to_what_may_be_a_camera() -> None:
    port = free_port()
    async with (
        EmulatedCamera(host=f"{NETWORK}1", port=port, active=21) as emulator,
        EmulatedInSight(host=f"{NETWORK}2", port=port),
        listening(f"{NETWORK}3", port) as silent,
        listening(f"{NETWORK}4", port, b"SSH-2.0-x\r\n") as other,
    ):
        found = await found_on(port, ask=True, may_disturb=True)
        assert not emulator.has_session
    first, second, third, fourth = found
    assert first.answer is not None
    assert first.answer.application == 21
    assert first.urls == (f"bvs://{NETWORK}1:{port}?dialect=handbook",)
    assert second.urls == (f"insight://{NETWORK}2:{port}?dialect=native",)
    assert third.answer is None
    assert "silence" in third.refusal
    assert silent.received
    assert (fourth.answer, fourth.refusal, other.received) == (None, "", b"")


# ---------------------------------------------------------------------- bounds


def fake_openings(monkeypatch: pytest.MonkeyPatch, lasts: float) -> tuple[list[float], list[int]]:
    """Replace opening a port by waiting; return start times, and counts of openings at once."""
    times: list[float] = []
    at_once = [0, 0]

    async def open_port(sock: socket.socket, *_: Any, **__: Any) -> OpenedPort:
        with sock:
            times.append(asyncio.get_running_loop().time())
            at_once[0] += 1
            at_once[1] = max(at_once)
            await asyncio.sleep(lasts)
            at_once[0] -= 1
        return OpenedPort("no answer")

    monkeypatch.setattr(_search, "open_port", open_port)
    return times, at_once


async def test_openings_have_a_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    times, _ = fake_openings(monkeypatch, lasts=0.3)
    search = CameraSearch(["10.0.0.0/24"], protocols=["insight"], ports=[24], rate=20, at_once=500)
    await search.run()
    assert len(times) == search.tried == search.total == 2 * 254
    # neither more than 20 in any second, nor a burst in a tenth of one
    assert all(later - first > 1 - 1e-3 for first, later in zip(times, times[20:], strict=False))
    assert all(later - first > 0.1 - 1e-3 for first, later in zip(times, times[2:], strict=False))
    assert times[-1] - times[0] == pytest.approx((len(times) - 1) / 20, rel=0.01)


async def test_connections_at_a_time_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    times, at_once = fake_openings(monkeypatch, lasts=1.0)
    await smartcam.find("10.0.0.0/24", protocols=["insight"], rate=1000, at_once=10)
    assert at_once == [0, 10]
    assert times[-1] - times[0] == pytest.approx(25, rel=0.05)


async def test_address_that_answers_nothing_ends_by_its_deadline() -> None:
    port, loop = free_port(), asyncio.get_running_loop()
    with filtered(f"{NETWORK}1", port), filtered(f"{NETWORK}2", port):
        search = CameraSearch(
            [f"{NETWORK}1-2"], ports=[port], protocols=["insight"], timeout=2.0, rate=1000
        )
        begun = loop.time()
        await search.run()
    assert search.results() == []
    assert search.counts == {"no answer": 2, "refused": 2}  # the protocol's own port is closed
    assert 2.0 <= loop.time() - begun < 2.1


async def test_talker_that_never_says_a_line_ends_by_its_deadline() -> None:
    port, loop = free_port(), asyncio.get_running_loop()
    async with listening(f"{NETWORK}1", port, WELCOME, slowly=0.5):
        begun = loop.time()
        (found,) = await found_on(port, f"{NETWORK}1", timeout=2.0)
        assert loop.time() - begun < 2.1
        await asyncio.sleep(99)  # until the talker has noticed
    assert (found.evidence, found.received) == ("other", b"Welc")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"networks": []}, "expected one network"),
        ({"networks": [["10.0.0.1"]]}, "each a text of its own"),
        ({"networks": ["10.0.0.0/8"]}, r"16,777,214 addresses .* max_addresses=16777214"),
        ({"networks": ["10.0.0.0/24"], "max_addresses": 253}, "254 addresses"),
        ({"networks": ["10.0.0.0/24", "10.0.0.1-255"], "max_addresses": 254}, "255 addresses"),
        ({"rate": 0}, "rate: .* got 0"),
        ({"rate": float("nan")}, "rate: .* got nan"),
        ({"at_once": 1001}, "at_once: .* got 1001"),
        ({"timeout": -1.0}, "timeout: .* got -1.0"),
        ({"max_addresses": 1 << 25}, "max_addresses: .* got 33554432"),
        ({"ports": [0]}, "port: .* got 0"),
        ({"ports": range(1, 40)}, "39 ports"),
        ({"protocols": []}, "no protocol"),
        ({"protocols": ["insigth"]}, "did you mean 'insight'"),
        ({"exclude": ["10.0.0."]}, "is no address"),
    ],
)
def test_search_that_cannot_work_is_refused(options: dict[str, Any], said: str) -> None:
    options = {"networks": ["10.0.0.1"], "protocols": ["insight"], **options}
    with pytest.raises(ConfigurationError, match=said):
        CameraSearch(options.pop("networks"), **options)


async def test_more_addresses_may_be_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    times, _ = fake_openings(monkeypatch, lasts=0.0)
    networks, only = ("10.0.0.1-5", "10.0.0.4-6"), ["insight"]
    with pytest.raises(ConfigurationError, match="6 addresses are more than 3"):
        CameraSearch(networks, protocols=only, max_addresses=3)
    await CameraSearch(networks, protocols=only, max_addresses=6).run()
    assert len(times) == 6


async def test_network_that_is_left_is_left_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    times, _ = fake_openings(monkeypatch, lasts=0.0)
    search = CameraSearch(
        ["10.0.0.0-20"], protocols=["insight"], exclude=["10.0.0.0/28", "10.0.0.17"]
    )
    await search.run()
    assert len(times) == search.total == 4
    assert search.excluded == {"10.0.0.17": "10.0.0.17"}


async def test_address_of_ipv6() -> None:
    try:
        server = socket.create_server(("::1", 0), family=socket.AF_INET6)
    except OSError:
        pytest.skip("this system has no IPv6")
    with server:
        port = server.getsockname()[1]
        found = [one for one in await found_on(port, "::1") if one.port == port]
    assert [one.urls for one in found] == [(f"bvs://[::1]:{port}",)]


async def test_name_means_its_addresses(monkeypatch: pytest.MonkeyPatch) -> None:
    port, loop = free_port(), asyncio.get_running_loop()

    async def look_up(name: str, *_: Any, **__: Any) -> list[Any]:
        if name == "nobody.example":
            raise socket.gaierror(socket.EAI_NONAME, "no such name")
        await asyncio.sleep(0 if name == "cam.example" else 99)
        return [(socket.AF_INET, None, 0, "", (f"{NETWORK}{n}", 0)) for n in (1, 2)]

    monkeypatch.setattr(loop, "getaddrinfo", look_up)
    async with listening(f"{NETWORK}1", port), listening(f"{NETWORK}2", port) as other:
        assert [*by_last_number(await found_on(port, "cam.example"))] == ["1", "2"]
        assert await found_on(port, exclude=["cam.example"]) == []
        assert other.opened == 1
    for name, said in (("nobody.example", "no such name"), ("slow.example", "within 5 s")):
        with pytest.raises(ConfigurationError, match=f"{name}.*{said}"):
            await found_on(port, name)


# ---------------------------------------------------------------------- the system's limits


async def test_few_file_descriptors_are_enough() -> None:
    resource = pytest.importorskip("resource", reason="this system has no such limit")
    port = free_port()
    async with contextlib.AsyncExitStack() as stack:
        for n in range(1, 13):
            await stack.enter_async_context(listening(f"{NETWORK}{n}", port, hangs_up=True))
        with filtered(f"{NETWORK}14", port), socket.socket() as next_free:
            limits = resource.getrlimit(resource.RLIMIT_NOFILE)
            # a connection to this process takes two
            resource.setrlimit(resource.RLIMIT_NOFILE, (next_free.fileno() + 5, limits[1]))
            try:
                found = await found_on(port, rate=10_000, timeout=5.0)
            finally:
                resource.setrlimit(resource.RLIMIT_NOFILE, limits)
    assert len(found) == 12


async def test_no_file_descriptor_at_all_is_reported() -> None:
    resource = pytest.importorskip("resource", reason="this system has no such limit")
    with socket.socket() as last:
        limits = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (last.fileno() + 1, limits[1]))
        try:
            with pytest.raises(ConfigurationError, match="no socket left") as caught:
                await smartcam.find(f"{NETWORK}0/24", protocols=["insight"])
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, limits)
    assert "ulimit" in str(caught.value)


async def test_cancelled_search_closes_and_keeps_what_it_found() -> None:
    port = free_port()
    async with (
        listening(f"{NETWORK}1", port, WELCOME),
        listening(f"{NETWORK}2", port) as silent,
        listening(f"{NETWORK}4", port) as later,
    ):
        with filtered(f"{NETWORK}3", port):
            search = CameraSearch(
                [f"{NETWORK}1-4"],
                ports=[port],
                may_disturb=True,
                rate=10_000,
                timeout=30.0,
                at_once=6,
            )
            task = asyncio.create_task(search.run())
            await until(lambda: silent.opened and search.results())
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task
        await until(lambda: silent.ended == silent.opened and later.ended == later.opened)
        assert by_last_number(search.results()) == {"1": (("insight",), "greeted")}
        assert search.tried < search.total


async def test_port_that_meets_itself_is_not_open() -> None:
    with socket.socket() as sock, socket.create_server((f"{NETWORK}1", 0)) as server:
        sock.bind((f"{NETWORK}1", free_port()))
        sock.connect(sock.getsockname())
        assert is_connected_to_itself(sock)
        with socket.create_connection(server.getsockname()) as other:
            assert not is_connected_to_itself(other)
