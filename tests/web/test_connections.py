"""The connections of a site: bounded in number, time and bytes, for every client."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import socket
import subprocess
import sys
from typing import Any

import aiohttp
import pytest

import smartcam
from smartcam._accepting import Places
from tests.handmade import until
from tests.web.inside import (
    MAX_BODY_BYTES,
    MAX_CONNECTIONS,
    MAX_HEAD_BYTES,
    MAX_STREAMS,
    MAX_WAITING_CALLS,
    SiteConnection,
)
from tests.web.inside import _connections as connections
from tests.web.inside import _emulator as emulator
from tests.web.inside import _routes as routes
from tests.web.sitekit import TOKEN, Raw, World, served

HALF = b"GET /api HTTP/1.1\r\nHost: localhost\r\nX-Slow: "
UNFINISHED = b"POST /api HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9\r\n\r\n"


def places_of(world: World) -> Places[SiteConnection]:
    opened = world.site._open_port
    assert opened is not None
    return opened.places


async def ended(raw: Raw) -> bytes:
    """Return everything received until the site closes the connection."""
    async with asyncio.timeout(60):
        try:
            return await raw.reader.read()
        except ConnectionResetError:
            return b""


async def flooded(world: World, stack: contextlib.AsyncExitStack, count: int, data: bytes) -> Any:
    """Open connections, and say something on each that is no request."""
    found = [await stack.enter_async_context(Raw.connected(world.site)) for _ in range(count)]
    for raw in found:
        raw.writer.write(data)
    return found


# ---------------------------------------------------------------------- how many


@pytest.mark.parametrize("data", [b"", b"G", HALF, UNFINISHED])
async def test_connections_are_bounded_and_everybody_gets_in(data: bytes) -> None:
    async with served(token=TOKEN) as world, contextlib.AsyncExitStack() as stack:
        found = await flooded(world, stack, 2 * MAX_CONNECTIONS, data)
        await until(lambda: places_of(world).crowded_out >= MAX_CONNECTIONS)
        assert len(places_of(world)) == MAX_CONNECTIONS
        assert (await world.caller.get())["name"] == "camera"
        async with smartcam.connect(world.emulator.url) as camera:
            assert camera.active_application == 1
        for raw in found[:MAX_CONNECTIONS]:
            await ended(raw)


async def test_place_of_a_request_that_is_answered_is_safe(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with served() as world, contextlib.AsyncExitStack() as stack, world.events() as events:
        await events.next("clock")
        waiting = asyncio.create_task(world.caller.get("log?wait=30"))
        await until(lambda: world.site._waiting_count == 1)
        with caplog.at_level(logging.INFO, logger="smartcam.web"):
            await flooded(world, stack, 2 * MAX_CONNECTIONS, HALF)
            await until(lambda: places_of(world).crowded_out >= MAX_CONNECTIONS)
        async with smartcam.connect(world.emulator.url):
            assert (await waiting)["entries"]
            await events.next("log")
    assert "64 others are open, it was without a request for longest" in caplog.text


async def test_connection_that_was_used_last_goes_last() -> None:
    async with served() as world, contextlib.AsyncExitStack() as stack:
        kept = await stack.enter_async_context(Raw.connected(world.site))
        idle = await flooded(world, stack, MAX_CONNECTIONS - 1, b"")
        await until(lambda: len(places_of(world)) == MAX_CONNECTIONS)
        assert (await kept.call("GET /api HTTP/1.1", "Host: localhost"))[0] == 200
        await flooded(world, stack, MAX_CONNECTIONS - 1, b"")
        for raw in idle:
            await ended(raw)
        assert (await kept.call("GET /api HTTP/1.1", "Host: localhost"))[0] == 200


async def test_streams_and_calls_that_wait_leave_places_free() -> None:
    assert MAX_STREAMS + MAX_WAITING_CALLS <= MAX_CONNECTIONS // 2
    async with served() as world:
        waiting = [
            asyncio.create_task(world.caller.get("log?wait=30")) for _ in range(MAX_WAITING_CALLS)
        ]
        await until(lambda: world.site._waiting_count == MAX_WAITING_CALLS)
        answer = await world.caller.call("GET", "log?wait=30")
        assert (answer.status, answer.value["expected"]) == (503, "16 at most")
        assert (await world.caller.get("log"))["entries"] == []
        await world.site.stop()
        await asyncio.gather(*waiting, return_exceptions=True)
        assert world.site._waiting_count == 0


async def test_where_every_place_is_taken_the_newcomer_is_reported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(connections, "MAX_CONNECTIONS", 1)
    async with served() as world, world.events() as events:
        await events.next("clock")
        async with Raw.connected(world.site) as raw:
            assert (await ended(raw)).startswith(b"HTTP/1.1 503 Service Unavailable\r\n")
        assert (len(places_of(world)), places_of(world).crowded_out) == (1, 1)
        await events.next("clock")


# ---------------------------------------------------------------------- how long


@pytest.mark.parametrize("data", [b"", HALF])
async def test_head_that_does_not_come_ends_the_connection(
    data: bytes, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(connections, "HEAD_TIMEOUT", 0.05)
    with caplog.at_level(logging.INFO, logger="smartcam.web"):
        async with served() as world, Raw.connected(world.site) as raw:
            raw.writer.write(data)
            await ended(raw)
            await until(lambda: not len(places_of(world)))
    assert "connection closed: no request within 0.05 s" in caplog.text


async def test_second_head_that_does_not_become_whole_ends_the_connection(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async with served() as world, Raw.connected(world.site) as raw:
        assert (await raw.call("GET /api HTTP/1.1", "Host: localhost"))[0] == 200
        monkeypatch.setattr(connections, "HEAD_TIMEOUT", 0.05)
        with caplog.at_level(logging.INFO, logger="smartcam.web"):
            raw.writer.write(HALF)
            await ended(raw)
    assert "connection closed: half a request within 0.05 s" in caplog.text


async def test_connection_without_another_request_ends(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(connections, "KEEP_ALIVE_TIMEOUT", 0.05)
    with caplog.at_level(logging.INFO, logger="smartcam.web"):
        async with served() as world, Raw.connected(world.site) as raw:
            assert (await raw.call("GET /api HTTP/1.1", "Host: localhost"))[0] == 200
            await ended(raw)
    assert "connection closed: no request within 0.05 s" in caplog.text


async def test_answer_takes_as_long_as_it_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    async with served() as world, world.events() as events:
        await events.next("clock")
        for name in ("HEAD_TIMEOUT", "KEEP_ALIVE_TIMEOUT"):
            monkeypatch.setattr(connections, name, 0.001)
        for _ in range(2):  # which come once a second
            await events.next("clock")


# ---------------------------------------------------------------------- how many bytes


async def test_head_that_is_too_long_ends_the_connection(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, logger="smartcam.web"):
        async with served() as world, Raw.connected(world.site) as raw:
            raw.writer.write(b"GET /api HTTP/1.1\r\nHost: localhost\r\n")
            for number in range(MAX_HEAD_BYTES // 1000 + 1):
                raw.writer.write(b"X-%d: %s\r\n" % (number, 1000 * b"x"))
            await ended(raw)
    assert f"the head of its request has more than {MAX_HEAD_BYTES} bytes" in caplog.text


async def test_head_may_come_byte_by_byte_and_its_body_with_it() -> None:
    body = b'{"endian": 1}'
    head = b"POST /api/cameras/camera/endian HTTP/1.1\r\nHost: localhost\r\n"
    head += b"Content-Type: application/json\r\nContent-Length: %d\r\n\r\n" % len(body)
    async with served() as world, Raw.connected(world.site) as raw:
        for byte in head + body:
            raw.writer.write(bytes([byte]))
            await raw.writer.drain()
            await asyncio.sleep(0)
        async with asyncio.timeout(60):
            assert (await raw.reader.readuntil(b"\r\n")).startswith(b"HTTP/1.1 200 ")
        assert world.emulator.device.endian == 1


@pytest.mark.parametrize("token", [TOKEN, "another-token-of-24-chars"])
async def test_large_body_does_not_count_as_a_head(token: str) -> None:
    async with served(token=TOKEN) as world, Raw.connected(world.site) as raw:
        raw.writer.write(
            b"POST /api/cameras/camera/endian HTTP/1.1\r\nHost: localhost\r\n"
            b"Content-Type: application/json\r\n"
            + f"Authorization: Bearer {token}\r\nContent-Length: {MAX_BODY_BYTES}\r\n\r\n".encode()
            + bytes(MAX_BODY_BYTES)
        )
        answer = await ended(raw) if token != TOKEN else await raw.reader.readuntil(b"\r\n")
    assert answer.startswith(b"HTTP/1.1 400 " if token == TOKEN else b"HTTP/1.1 401 ")


async def test_refused_request_whose_body_does_not_come_ends_the_connection(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(connections, "HEAD_TIMEOUT", 0.1)
    with caplog.at_level(logging.INFO, logger="smartcam.web"):
        async with served(token=TOKEN) as world, Raw.connected(world.site) as raw:
            raw.writer.write(UNFINISHED)
            assert (await ended(raw)).startswith(b"HTTP/1.1 40")
    assert "no end of a body within 0.1 s" in caplog.text


# ---------------------------------------------------------------------- clients that go


async def test_call_that_waits_ends_with_its_client() -> None:
    async with served() as world:
        async with Raw.connected(world.site) as raw:
            raw.writer.write(
                b"GET /api/cameras/camera/log?wait=30 HTTP/1.1\r\nHost: localhost\r\n\r\n"
            )
            await until(lambda: world.site._waiting_count == 1)
        await until(lambda: world.site._waiting_count == 0)


async def test_client_that_goes_in_the_middle_of_its_body_is_no_error(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with caplog.at_level(logging.DEBUG):
        async with served() as world:
            async with Raw.connected(world.site) as raw:
                raw.writer.write(UNFINISHED.replace(b"/api ", b"/api/cameras/camera/endian "))
                await until(lambda: any(one._head is None for one in places_of(world)))
                for _ in range(5):  # until the body is awaited
                    await asyncio.sleep(0)
            await until(lambda: not len(places_of(world)))
            assert (await world.caller.get())["name"] == "camera"
    assert [one for one in caplog.records if one.levelno > logging.INFO] == []


@pytest.mark.parametrize("rounds", range(6))
async def test_site_that_stops_while_a_client_is_accepted_leaves_nothing(rounds: int) -> None:
    async with served() as world:
        sock = socket.create_connection(("127.0.0.1", world.site.port))
        for _ in range(rounds):
            await asyncio.sleep(0)
        await world.site.stop()
        sock.settimeout(60)
        with sock, contextlib.suppress(ConnectionResetError):
            assert sock.recv(1) == b""


# ---------------------------------------------------------------------- what is told of it


@pytest.mark.parametrize(
    "data", [b"\x16\x03\x01 no HTTP\r\n\r\n", b"GET / HTTP/1.1\r\nno header\r\n\r\n", b"\r\n\r\n\0"]
)
async def test_what_is_no_http_is_no_error_of_ours(
    data: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.DEBUG):
        async with served() as world, Raw.connected(world.site) as raw:
            raw.writer.write(data)
            assert (await ended(raw)).startswith(b"HTTP/1.0 400 ")
    assert [one for one in caplog.records if one.levelno > logging.INFO] == []


async def test_descriptors_that_are_used_up_are_told_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("smartcam._accepting.ACCEPT_PAUSE", 0.001)
    failures = 100

    class Scarce(socket.socket):
        def accept(self) -> Any:
            nonlocal failures
            if failures:
                failures -= 1
                raise OSError(errno.EMFILE, "no descriptor left")
            return super().accept()

    with monkeypatch.context() as patch:
        patch.setattr("smartcam.web._site.socket.socket", Scarce)
        patch.setattr("smartcam.web._site.socket.create_server", scarce_server(Scarce))
        async with served() as world:
            patch.undo()
            assert (await world.caller.get())["name"] == "camera"
    assert failures == 0
    told = [one for one in caplog.records if one.levelno >= logging.WARNING]
    assert [one.getMessage() for one in told] == [
        "! a connection cannot be accepted: [Errno 24] no descriptor left"
    ]
    assert told[0].exc_info is None


def scarce_server(kind: type[socket.socket]) -> Any:
    def create(address: tuple[str, int], **options: Any) -> socket.socket:
        sock = kind(options["family"])
        sock.bind(address)
        sock.listen(options["backlog"])
        return sock

    return create


def ended_process(process: asyncio.subprocess.Process) -> None:
    if process.returncode is None:
        process.kill()


ATTACKED = """
import asyncio, resource, socket, sys
import smartcam
from smartcam.emulator import EmulatedCamera
from smartcam.web import EmulatorSite

async def main():
    async with EmulatedCamera() as emulator, EmulatorSite({"c": emulator}, token=16 * "x") as site:
        async with smartcam.connect(emulator.url):
            pass  # everything is loaded
        print(site.port, emulator.url, flush=True)
        await asyncio.to_thread(sys.stdin.read)

soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
resource.setrlimit(resource.RLIMIT_NOFILE, (int(sys.argv[1]), hard))
asyncio.run(main())
"""


@pytest.mark.long
@pytest.mark.skipif(sys.platform == "win32", reason="descriptors are bounded elsewhere only")
@pytest.mark.real_time
@pytest.mark.parametrize("most", [128, 64])  # more than all places take, and fewer
async def test_half_requests_do_not_take_the_process_its_descriptors(most: int) -> None:
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-c", ATTACKED, str(most)),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    assert process.stdout is not None
    assert process.stdin is not None
    with contextlib.ExitStack() as stack:
        stack.callback(ended_process, process)
        port, url = (await process.stdout.readline()).decode().split()
        for _ in range(300):
            attacker = socket.create_connection(("127.0.0.1", int(port)), timeout=60)
            stack.enter_context(attacker).sendall(HALF)
        async with smartcam.connect(url, connect_timeout=60) as camera:
            assert camera.active_application == 1
        async with (
            aiohttp.ClientSession() as session,
            session.get(f"http://127.0.0.1:{port}/") as page,
        ):
            assert page.status == 200
        process.stdin.close()
        _, told = await process.communicate()
    assert told.decode() == ""
    assert process.returncode == 0


def test_bounds_fit_each_other() -> None:
    assert connections.HEAD_TIMEOUT <= connections.KEEP_ALIVE_TIMEOUT
    assert routes.READ_TIMEOUT <= connections.KEEP_ALIVE_TIMEOUT
    assert emulator.MAX_WAIT > 0
