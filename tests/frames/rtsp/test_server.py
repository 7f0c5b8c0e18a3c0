"""Answers of a server, and its refusals."""

from __future__ import annotations

import asyncio
import base64
import re
import socket
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import pytest

from smartcam.exceptions import ConfigurationError
from smartcam.frames import RtspServer
from tests.frames.drivers import GoneError, scripted
from tests.frames.rtsp.client import TCP, Client, digest
from tests.frames.rtsp.test_shared_stream import drawn
from tests.handmade import until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from tests.frames.drivers import ScriptedDriver
    from tests.frames.rtsp.client import Reply

IDLE_TIMEOUT = 60.0
LINGER = 2.0
MAX_STRAY_PACKETS = 64
REQUEST_TIMEOUT = 10.0
TIMEOUT = 60


pytestmark = pytest.mark.usefixtures("no_leaks")

SECRET = "secret"  # noqa: S105
PUBLIC = "OPTIONS, DESCRIBE, SETUP, PLAY, PAUSE, GET_PARAMETER, SET_PARAMETER, TEARDOWN"


@asynccontextmanager
async def served(**options: Any) -> AsyncIterator[tuple[ScriptedDriver, RtspServer]]:
    """Serve a scripted device as ``left`` and ``other``."""
    driver, source = scripted(stall=None)
    async with (
        source,
        RtspServer({"left": source, "other": source}, port=0, **options) as server,
    ):
        yield driver, server


@pytest.fixture
async def server() -> AsyncIterator[tuple[ScriptedDriver, RtspServer]]:
    async with served() as made:
        yield made


def connections(server: RtspServer) -> set[Any]:
    """Return the open connections."""
    assert server._serving is not None
    return set(server._serving.places)


Served = tuple["ScriptedDriver", RtspServer]


async def described(client: Client, driver: ScriptedDriver, **headers: str) -> Reply:
    asking = asyncio.create_task(client.ask("DESCRIBE", **headers))
    await driver.streams()
    driver.give(drawn(1))
    return await asking


async def test_a_stream_is_described(server: Served) -> None:
    driver, serving = server
    async with await Client.connect(serving) as client:
        reply = await described(client, driver, Accept="application/sdp")
    assert reply.status == 200
    assert reply.headers["content-type"] == "application/sdp"
    assert reply.headers["content-base"] == serving.url("left") + "/"
    lines = reply.body.decode().split("\r\n")
    assert lines[0] == "v=0"
    assert "m=video 0 RTP/AVP 96" in lines
    assert "a=rtpmap:96 H264/90000" in lines
    assert "a=control:track1" in lines
    found = re.search(
        r"a=fmtp:96 packetization-mode=1;profile-level-id=([0-9A-F]{6});"
        r"sprop-parameter-sets=([^,\s]+),([^,\s]+)\r\n",
        reply.body.decode(),
    )
    assert found is not None
    sps, pps = (base64.b64decode(one) for one in found.groups()[1:])
    assert (sps[0] & 0x1F, pps[0] & 0x1F) == (7, 8)
    assert sps[1:4].hex().upper() == found[1]


async def test_answer_to_each_method(server: Served) -> None:
    _, serving = server
    async with await Client.connect(serving) as client:
        assert (await client.ask("OPTIONS", "*")).headers["public"] == PUBLIC
        assert (await client.ask("OPTIONS")).status == 200
        reply = await client.set_up("RTP/AVP/TCP;unicast;interleaved=4-5")
        assert reply.headers["session"] == f"{client.session};timeout={TIMEOUT}"
        assert re.fullmatch(
            r'RTP/AVP/TCP;unicast;interleaved=4-5;ssrc=[0-9A-F]{8};mode="PLAY"',
            reply.headers["transport"],
        )
        assert (await client.ask("PAUSE")).status == 455
        played = await client.ask("PLAY", Range="npt=0.000-")
        assert played.headers["range"] == "npt=now-"
        assert re.fullmatch(
            rf"url={serving.url('left')}/track1;seq=\d{{1,5}};rtptime=\d{{1,10}}",
            played.headers["rtp-info"],
        )
        assert (await client.ask("PLAY")).status == 200
        assert (await client.ask("GET_PARAMETER")).headers["session"].startswith(client.session)
        assert (await client.ask("SET_PARAMETER", body="\r\n")).status == 200
        assert (await client.ask("SET_PARAMETER", body="volume: 11")).status == 451
        assert (await client.ask("PAUSE")).status == 200
        assert serving.statistics()["left"].viewers == 1
        assert (await client.ask("TEARDOWN")).status == 200
        assert serving.statistics()["left"].viewers == 0
        assert (await client.ask("PLAY")).status == 454


@pytest.mark.parametrize(
    ("method", "path", "headers", "status"),
    [
        ("DESCRIBE", "/none", {}, 404),
        ("DESCRIBE", "/left", {"Accept": "text/html"}, 406),
        ("DESCRIBE", "/left", {"Require": "funky"}, 551),
        ("SETUP", "/none/track1", {"Transport": TCP}, 404),
        ("SETUP", "/left/track1", {"Transport": "RTP/AVP;multicast"}, 461),
        ("SETUP", "/left/track1", {}, 461),
        (
            "SETUP",
            "/left/track1",
            {"Transport": "RTP/AVP;unicast;destination=127.0.0.2;client_port=5000-5001"},
            461,
        ),
        ("SETUP", "/left/track1", {"Transport": TCP, "Session": "none"}, 454),
        ("PLAY", "/left", {}, 455),
        ("PLAY", "/left", {"Session": "none"}, 454),
        ("TEARDOWN", "/none", {"Session": "none"}, 404),
        ("GET_PARAMETER", "/left", {"Session": "none"}, 454),
        ("ANNOUNCE", "/left", {}, 405),
        ("RECORD", "/left", {}, 405),
        ("DANCE", "/left", {}, 501),
    ],
)
async def test_refusals(
    server: Served, method: str, path: str, headers: dict[str, str], status: int
) -> None:
    _, serving = server
    async with await Client.connect(serving) as client:
        url = f"rtsp://127.0.0.1:{serving.port}{path}"
        reply = await client.ask(method, url, **headers)
        assert reply.status == status
        assert reply.body
        assert {405: "allow", 501: "public", 551: "unsupported"}.get(
            status, "cseq"
        ) in reply.headers
        assert (await client.ask("OPTIONS")).status == 200  # the connection goes on


@pytest.mark.parametrize(
    ("data", "status"),
    [
        (b"HELLO\r\n\r\n", 400),
        (b"OPTIONS * RTSP/2.0\r\nCSeq: 1\r\n\r\n", 505),
        (b"OPTIONS * RTSP/1.0\r\nContent-Length: 9000\r\n\r\n", 413),
        (b"x" * 5000, 400),
    ],
)
async def test_bytes_without_rtsp_end_the_connection(
    server: Served, data: bytes, status: int
) -> None:
    _, serving = server
    async with await Client.connect(serving) as client:
        client.writer.write(data)
        reply = await client.reply()
        assert (reply.status, reply.headers["connection"]) == (status, "close")
        assert await client.ended()


async def test_a_request_without_a_number_is_refused(server: Served) -> None:
    _, serving = server
    async with await Client.connect(serving) as client:
        client.writer.write(b"OPTIONS * RTSP/1.0\r\n\r\n")
        assert (await client.reply()).status == 400
        assert (await client.ask("OPTIONS")).status == 200


async def test_many_requests_at_once_are_answered_in_order(server: Served) -> None:
    _, serving = server
    async with await Client.connect(serving) as client:
        client.writer.write(
            b"".join(b"OPTIONS * RTSP/1.0\r\nCSeq: %d\r\n\r\n" % n for n in range(1000))
        )
        for number in range(1000):
            assert (await client.reply()).headers["cseq"] == str(number)


async def test_half_a_request_ends_the_connection_after_a_time(server: Served) -> None:
    _, serving = server
    loop = asyncio.get_running_loop()
    async with await Client.connect(serving) as client:
        client.writer.write(b"OPTIONS * RTSP/1.0\r\n")
        before = loop.time()
        for _ in range(3):  # a byte now and then does not lengthen it
            await asyncio.sleep(REQUEST_TIMEOUT / 4)
            client.writer.write(b"A")
        await asyncio.sleep(REQUEST_TIMEOUT / 4)
        reply = await client.reply()
        assert (reply.status, await client.ended()) == (408, True)
        assert loop.time() - before == pytest.approx(REQUEST_TIMEOUT, abs=0.2)


async def test_idle_connection_is_closed(server: Served) -> None:
    _, serving = server
    async with await Client.connect(serving) as client:
        assert (await client.ask("OPTIONS")).status == 200
        for _ in range(7):
            await asyncio.sleep(IDLE_TIMEOUT / 8)
            client.writer.write(b"\r\n$\1\0\0")
        await asyncio.sleep(IDLE_TIMEOUT / 7)
        assert await client.ended()


async def test_few_packets_without_a_session_are_ignored(server: Served) -> None:
    _, serving = server
    async with await Client.connect(serving) as client:
        client.writer.write(b"$\1\0\0" * MAX_STRAY_PACKETS)
        assert (await client.ask("OPTIONS")).status == 200
        before = asyncio.get_running_loop().time()
        client.writer.write(b"$\1\0\0")
        assert await client.ended()
        assert asyncio.get_running_loop().time() - before < 1


async def test_client_that_leaves_during_a_describe_leaves_nothing_open(server: Served) -> None:
    driver, serving = server
    async with await Client.connect(serving) as client:
        client.writer.write(f"DESCRIBE {client.base} RTSP/1.0\r\nCSeq: 1\r\n\r\n".encode())
        await driver.streams()
    await until(lambda: not connections(serving))
    await asyncio.sleep(LINGER + 0.1)
    await driver.rests()


async def test_cancelled_stop_is_finished() -> None:
    driver, source = scripted(stall=None)
    async with source:
        server = RtspServer({"left": source}, port=0)
        await server.start()
        async with await Client.connect(server) as client:
            await client.play()
            await driver.streams()
            stopping = asyncio.create_task(server.stop())
            await asyncio.sleep(0)
            stopping.cancel()
            with pytest.raises(asyncio.CancelledError):
                await stopping
            await driver.rests()
            assert await client.ended()
        await server.stop()


async def test_client_that_reads_no_answers_is_disconnected(server: Served) -> None:
    _, serving = server
    async with await Client.connect(serving, room=4096) as client:
        client.writer.write(b"OPTIONS * RTSP/1.0\r\nCSeq: 1\r\n\r\n" * 10_000)
        await until(lambda: not connections(serving))
        answers = await client.everything()
    assert 100 < answers.count(b"200 OK") < 5000


async def test_passwords() -> None:
    async with (
        served(user="me", password=SECRET) as (driver, serving),
        await Client.connect(serving) as client,
    ):
        assert (await client.ask("OPTIONS")).status == 200
        asked = await client.ask("DESCRIBE")
        assert asked.status == 401
        for method in ("DESCRIBE", "SETUP", "PLAY", "GET_PARAMETER", "TEARDOWN"):
            wrong = digest(asked, method, client.base, "me", "wrong")
            assert (await client.ask(method, Authorization=wrong)).status == 401
        assert driver.calls == ["open"]  # the device never streamed
        right = digest(asked, "DESCRIBE", client.base, "me", "secret")
        assert (await described(client, driver, Authorization=right)).status == 200


async def test_client_that_guesses_passwords_is_disconnected() -> None:
    async with (
        served(user="me", password=SECRET) as (_, serving),
        await Client.connect(serving) as client,
    ):
        for _ in range(10):
            assert (await client.ask("DESCRIBE", Authorization="Digest x=y")).status == 401
        assert await client.ended()


async def test_lost_camera_is_reported_and_reopened(server: Served) -> None:
    driver, serving = server
    driver.fails["start"] = GoneError("scripted: it was unplugged")
    async with await Client.connect(serving) as client:
        for _ in range(2):
            reply = await client.ask("DESCRIBE")
            assert (reply.status, reply.body) == (503, b"scripted: it was unplugged\n")
        del driver.fails["start"]
        assert (await described(client, driver)).status == 200
    assert driver.calls.count("start") == 3


async def test_silent_camera_is_reported(server: Served) -> None:
    _, serving = server
    async with await Client.connect(serving) as client:
        asking = asyncio.create_task(client.ask("DESCRIBE"))
        await asyncio.sleep(4)
        assert not asking.done()
        await asyncio.sleep(2)
        reply = await asking
    assert (reply.status, reply.body) == (503, b"scripted: no frame came within 5 s\n")


async def test_connections_and_viewers_are_limited() -> None:
    async with served(max_connections=2, max_viewers=1) as (_, serving):
        async with await Client.connect(serving) as one, await Client.connect(serving) as two:
            await one.set_up()
            assert (await two.ask("SETUP", Transport=TCP)).status == 453
            async with await Client.connect(serving) as three:
                assert await two.ended()  # closed to make room for three
                assert (await one.ask("TEARDOWN")).status == 200
                await three.set_up()
        await until(lambda: not connections(serving))


async def test_newcomer_is_refused_when_all_connections_have_sessions() -> None:
    async with served(max_connections=2) as (_, serving):
        async with await Client.connect(serving) as one, await Client.connect(serving) as two:
            await one.set_up()
            await two.set_up()
            async with await Client.connect(serving) as three:
                assert (await three.reply()).status == 503
                assert await three.ended()
            assert (await one.ask("GET_PARAMETER")).status == 200
            assert (await two.ask("TEARDOWN")).status == 200
            async with await Client.connect(serving) as three:
                assert await two.ended()
                await three.set_up()
        await until(lambda: not connections(serving))
        async with await Client.connect(serving) as client:
            await client.set_up()


async def test_sessions_of_one_connection(server: Served) -> None:
    _, serving = server
    async with await Client.connect(serving) as client:
        await client.set_up()
        first, client.session = client.session, ""
        assert (await client.ask("SETUP", Transport=TCP)).status == 461  # the channels are in use
        other = serving.url("other")
        reply = await client.ask("SETUP", other, Transport="RTP/AVP/TCP;unicast")
        assert "interleaved=2-3" in reply.headers["transport"]
        assert (await client.ask("SETUP", Session=first, Transport=TCP)).status == 455
        assert (await client.ask("SETUP", other, Session=first, Transport=TCP)).status == 459
        assert (await client.ask("PLAY", other, Session=first)).status == 454
        for _ in range(6):
            assert (await client.ask("SETUP", Transport="RTP/AVP/TCP")).status == 200
        assert (await client.ask("SETUP", Transport="RTP/AVP/TCP")).status == 453
        assert serving.statistics()["left"].viewers == 7


async def test_other_connections_cannot_end_a_session(server: Served) -> None:
    _, serving = server
    async with await Client.connect(serving) as one, await Client.connect(serving) as two:
        await one.set_up()
        assert (await two.ask("TEARDOWN", Session=one.session)).status == 454
        assert serving.statistics()["left"].viewers == 1


async def test_server_starts_and_stops_repeatedly() -> None:
    _, source = scripted()
    async with source:
        server = RtspServer({"left": source}, port=0)
        for _ in range(2):
            async with server:
                await server.start()
                async with await Client.connect(server) as client:
                    assert (await client.ask("OPTIONS")).status == 200
                    await client.set_up()
                    await server.stop()
                    assert await client.ended()
            await server.stop()


async def test_sources_that_cannot_be_served_are_refused() -> None:
    _, source = scripted()
    for wrong, text in (
        ({}, "expected a source"),
        ({"a/b": source}, "a name: expected"),
        ({"": source}, "a name: expected"),
    ):
        with pytest.raises(ConfigurationError, match=text):
            RtspServer(wrong)
    with pytest.raises(ConfigurationError, match="max_viewers"):
        RtspServer({"a": source}, max_viewers=0)
    with pytest.raises(ConfigurationError, match="user and password"):
        RtspServer({"a": source}, user="me")
    with pytest.raises(ConfigurationError, match="expected one of a, got 'b'"):
        RtspServer({"a": source}).url("b")
    async with source:
        with pytest.raises(ConfigurationError, match="crf"):
            await RtspServer({"a": source}, port=0, crf=99).start()
        with socket.create_server(("127.0.0.1", 0)) as taken:
            port = taken.getsockname()[1]
            with pytest.raises(ConfigurationError, match=f"cannot listen on 127.0.0.1 port {port}"):
                await RtspServer({"a": source}, port=port).start()


async def test_url_has_a_name_that_other_hosts_resolve() -> None:
    _, source = scripted()
    assert RtspServer({"a": source}).url("a") == "rtsp://127.0.0.1:8554/a"
    assert RtspServer({"a": source}, host="::1", port=1).url("a") == "rtsp://[::1]:1/a"
    here = socket.gethostname()
    assert RtspServer({"a": source}, host="0.0.0.0").url("a") == f"rtsp://{here}:8554/a"  # noqa: S104
