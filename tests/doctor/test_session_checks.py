"""Test the doctor's checks before a session, and of a lost session, against real peers."""

from __future__ import annotations

import asyncio
import socket
import sys
from unittest import mock

import pytest

import smartcam
from smartcam.doctor import examine
from smartcam.emulator import EmulatedCamera, faults
from smartcam.emulator._inside import BaseFault
from smartcam.testing import proxy as rules
from smartcam.testing.proxy import LinkProxy
from tests.doctor.doctorkit import SHORT, errors, examined, finding_of, severities
from tests.doctor.inside import Exit
from tests.handmade import (
    CONNECT_ANSWER,
    HOST,
    OPENING,
    QUERY,
    QUERY_ANSWER,
    STATUS,
    Peer,
    datagrams,
    listening,
    refusing,
    scripted,
)

NO_SESSION = [("session", Exit.NO_SESSION)]

linux = pytest.mark.skipif(sys.platform != "linux", reason="how the system refuses differs")


# ---------------------------------------------------------------------- the name


@pytest.mark.parametrize("host", ["no..host", "256.0.0.1.invalid"])
async def test_name_that_does_not_resolve_is_an_error(host: str) -> None:
    findings = await examined(f"bvs://{host}")
    assert [one.check for one in findings] == ["notice", "name"]
    assert errors(findings) == [("name", Exit.NO_SESSION)]
    found = finding_of(findings, "name")
    assert found.text.startswith(f"the name '{host}' does not resolve: ")
    assert "IP address" in found.cure


async def test_name_that_resolves_is_reported_with_its_addresses() -> None:
    with refusing(socket.SOCK_STREAM) as port:
        findings = await examined(f"bvs://localhost:{port}", timeout=SHORT)
    found = finding_of(findings, "name")
    assert found.severity == "ok"
    assert HOST in found.details["addresses"]


# ---------------------------------------------------------------------- no session


async def test_connecting_is_announced_before_anything_is_sent() -> None:
    async with EmulatedCamera(running=True) as emulator:
        findings = examine(emulator.url)
        first = await anext(findings)
        assert (first.check, first.severity) == ("notice", "ok")
        assert "another one that is connected now loses its session" in first.text
        assert list(emulator.log) == []
        await findings.aclose()


async def test_nothing_listens_is_reported_with_every_way_that_was_tried() -> None:
    with refusing(socket.SOCK_STREAM) as port:
        findings = await examined(f"bvs://{HOST}:{port}", timeout=SHORT)
    assert errors(findings) == NO_SESSION
    found = finding_of(findings, "session")
    assert found.text == f"nothing listens at {HOST}:{port} (TCP): Connection refused"
    assert "36701" in found.cure
    own = [one for one in found.details["attempts"] if " at port " not in one.partition(":")[0]]
    assert {one.partition(":")[0].rpartition(" ")[2] for one in own} == {"TCP", "UDP"}
    assert len(own) < len(found.details["attempts"])
    assert findings[-1] is found


async def test_nothing_listens_at_any_address_of_a_name_is_reported() -> None:
    with refusing(socket.SOCK_STREAM) as port:
        loop = asyncio.get_running_loop()
        several = [
            (socket.AF_INET, socket.SOCK_STREAM, 6, "", (host, port))
            for host in (HOST, "127.0.0.2")
        ]
        with mock.patch.object(loop, "getaddrinfo", mock.AsyncMock(return_value=several)):
            findings = await examined(f"bvs://several:{port}", timeout=SHORT)
    assert finding_of(findings, "name").text == "several is 127.0.0.1, 127.0.0.2"
    assert finding_of(findings, "session").text.startswith(
        f"nothing listens at several:{port} (TCP): "
    )


async def test_nothing_listens_on_udp_is_reported() -> None:
    with refusing(socket.SOCK_DGRAM) as port:
        findings = await examined(f"bvs+udp://{HOST}:{port}", timeout=SHORT)
    assert finding_of(findings, "session").text.startswith(
        f"nothing listens at {HOST}:{port} (UDP)"
    )


@linux
async def test_host_without_a_route_is_unreachable() -> None:
    findings = await examined("bvs://255.255.255.255", timeout=SHORT)
    found = finding_of(findings, "session")
    assert found.text.startswith("255.255.255.255:36701 (TCP) cannot be reached: ")
    assert "both must be in one network" in found.cure


@linux
async def test_connection_that_never_opens_is_reported() -> None:
    with socket.socket() as full:
        full.bind((HOST, 0))
        full.listen(0)
        port = full.getsockname()[1]
        fillers = [socket.socket() for _ in range(3)]
        for filler in fillers:
            filler.setblocking(False)
            filler.connect_ex((HOST, port))
        findings = await examined(f"bvs://{HOST}:{port}?dialect=handbook", timeout=SHORT)
        for filler in fillers:
            filler.close()
    found = finding_of(findings, "session")
    assert found.text.startswith(f"nobody answers at {HOST}:{port} (TCP), not even with a refusal")
    assert "firewall" in found.cure


async def test_silent_peer_is_reported_with_the_questions_to_ask() -> None:
    async with listening() as listener:
        findings = await examined(f"bvs://{HOST}:{listener.port}", timeout=SHORT)
    assert errors(findings) == NO_SESSION
    found = finding_of(findings, "session")
    assert "takes the connection and says nothing: waiting for the answer to Connect" in found.text
    for cause in ("set to TCP, not to UDP", "36701 by default", "another client or dialect"):
        assert cause in found.cure
    assert "over UDP: waiting for the answer to Connect: Connection refused" in found.cure
    assert found.details["answers_at"] is None


async def test_silent_udp_peer_is_reported() -> None:
    async with datagrams() as peer:
        findings = await examined(f"bvs+udp://{HOST}:{peer.port}", timeout=SHORT)
    found = finding_of(findings, "session")
    assert "UDP does not tell whether anybody is there" in found.text
    assert "set to UDP, not to TCP" in found.cure


async def test_silent_tcp_camera_set_to_udp_is_found_and_examined() -> None:
    async with (
        listening() as listener,
        EmulatedCamera(transport="udp", port=listener.port, running=True) as emulator,
    ):
        findings = await examined(f"bvs://{HOST}:{listener.port}", timeout=2 * SHORT)
    assert errors(findings) == NO_SESSION
    failed, made = [one for one in findings if one.check == "session"]
    assert failed.cure == (
        f"A camera answers at {emulator.url}: use this URL. The next checks were made there."
    )
    assert made.details["url"] == emulator.url
    assert finding_of(findings, "run state").severity == "ok"


async def test_wrong_dialect_pinned_the_right_one_is_named() -> None:
    async with EmulatedCamera(dialect="thesis", running=True) as emulator:
        wrong = emulator.url.replace("thesis", "handbook")
        findings = await examined(wrong, timeout=2 * SHORT)
    failed, made = [one for one in findings if one.check == "session"]
    assert failed.exit_code is Exit.NO_SESSION
    assert failed.details["answers_at"] == made.details["url"] == emulator.url


async def test_camera_that_answers_one_try_only_is_gone_again() -> None:
    once = faults.Refuse(on="Disconnect", seconds=60)
    async with EmulatedCamera(dialect="thesis", faults=[once]) as emulator:
        wrong = emulator.url.replace("thesis", "handbook")
        findings = await examined(wrong, timeout=2 * SHORT)
    assert errors(findings) == 2 * NO_SESSION
    assert findings[-1].text.startswith("the camera that answered a moment ago is gone: ")


async def test_camera_that_refuses_newcomers_hangs_up() -> None:
    async with (
        EmulatedCamera(quirks={"second_client": "refuse"}) as emulator,
        smartcam.connect(emulator.url),
    ):
        findings = await examined(emulator.url, timeout=SHORT)
    found = finding_of(findings, "session")
    assert "takes the connection and hangs up without a word" in found.text
    assert "serve another client and refuse newcomers" in found.cure


async def test_garbage_is_reported_with_its_bytes() -> None:
    async def web_server(peer: Peer, number: int) -> None:
        peer.write(b"HTTP/1.1 400 Bad Request\r\n\r\n")
        await peer.rest()

    async with scripted(web_server) as listener:
        findings = await examined(f"bvs://{HOST}:{listener.port}", timeout=2 * SHORT)
    found = finding_of(findings, "session")
    assert "no camera's language: wrong magic number: 48 54 54 50" in found.text
    broken = [
        entry.hex for trial in found.details["frames"] for entry in trial if entry.direction == "!"
    ]
    assert b"HTTP/1.1 400".hex() in broken[0]


async def test_half_an_answer_is_reported() -> None:
    async def half(peer: Peer, number: int) -> None:
        await peer.read(len(OPENING))
        peer.write(CONNECT_ANSWER[:14])
        await peer.rest()

    async with scripted(half) as listener:
        url = f"bvs://{HOST}:{listener.port}?dialect=handbook"
        findings = await examined(url, timeout=SHORT)
    found = finding_of(findings, "session")
    assert "answers, and no session comes of it" in found.text
    assert "14 bytes, then silence" in found.text


async def test_session_that_fails_at_first_only_is_a_warning() -> None:
    async def late_riser(peer: Peer, number: int) -> None:
        if number <= 3:
            peer.reset()
            return
        await peer.read(len(OPENING))
        peer.write(CONNECT_ANSWER + STATUS)
        while await peer.read(len(QUERY)) == QUERY:
            peer.write(QUERY_ANSWER)
        peer.close()

    async with scripted(late_riser) as listener:
        url = f"bvs://{HOST}:{listener.port}?dialect=handbook"
        findings = await examined(url, timeout=SHORT)
    warned, made = [one for one in findings if one.check == "session"]
    assert (warned.severity, made.severity) == ("warning", "ok")
    assert "the second one had a session" in warned.text
    assert len(warned.details["attempts"]) == 3


async def test_session_that_cannot_be_made_again_is_an_error() -> None:
    refuse = faults.Refuse(on="Disconnect", nth=1, seconds=60)
    async with EmulatedCamera(faults=[refuse]) as emulator:
        findings = await examined(emulator.url, timeout=SHORT)
    assert errors(findings) == NO_SESSION
    assert "another one right after it was not" in finding_of(findings, "session").text
    assert findings[-1].check == "session"


async def test_session_has_the_connect_time_with_its_spread() -> None:
    async with EmulatedCamera(running=True) as emulator:
        findings = await examined(emulator.url)
    found = finding_of(findings, "session")
    times = found.details["connect_time"]
    assert list(times) == ["samples", "min", "median", "p99", "jitter"]
    assert times["samples"] == 5
    assert 0 < times["min"] <= times["median"] <= times["p99"]
    assert (found.cure, found.details["url"]) == ("", emulator.url)


async def test_session_without_a_pinned_dialect_tells_the_url_to_use() -> None:
    async with EmulatedCamera(running=True) as emulator:
        findings = await examined(emulator.url.partition("?")[0], timeout=3.0)
    found = finding_of(findings, "session")
    assert found.cure == f"Use {emulator.url} from now on: it names the dialect."
    assert "the first, which found the dialect, " in found.text
    assert found.details["connect_time"]["samples"] >= 1


# ---------------------------------------------------------------------- a session lost

ROUND_TRIP_QUERY = 8
"""Number of a Query of the round trip; five sessions have sent one each before it."""


async def last_finding(*given: BaseFault, timeout: float = 1.0) -> tuple[str, str, Exit]:
    """Return check, text and exit code of an examination's last finding."""
    async with EmulatedCamera(faults=given, running=True) as emulator:
        findings = await examined(emulator.url, timeout=timeout)
    last = findings[-1]
    assert errors(findings) == [(last.check, last.exit_code)]
    return last.check, last.text, last.exit_code


async def test_session_taken_by_another_client_is_told() -> None:
    check, text, code = await last_finding(faults.SecondClient(on="Query", nth=ROUND_TRIP_QUERY))
    assert (check, code) == ("taken", Exit.NO_SESSION)
    assert "soon after its Connect, and still takes connections: another client" in text


async def test_session_taken_while_watching_is_reported() -> None:
    async with EmulatedCamera(running=True) as emulator:
        async with asyncio.TaskGroup() as group:
            watching = group.create_task(examined(emulator.url, seconds=5.0))
            await emulator.wait_received(0x30, count=5 + 1 + 30)
            emulator.inject(faults.SecondClient())
        findings = watching.result()
    assert findings[-1].check == "taken"


async def test_camera_that_dies_in_the_middle_is_reported() -> None:
    check, text, code = await last_finding(faults.PowerCycle(on="Query", nth=ROUND_TRIP_QUERY))
    assert (check, code) == ("lost", Exit.NO_SESSION)
    assert "the session broke after" in text
    assert "the camera takes no connection now" in text


async def test_garbage_in_the_session_is_reported() -> None:
    garbage = faults.Insert(on="QueryAnswer", nth=ROUND_TRIP_QUERY, data=b"garbage")
    check, text, code = await last_finding(garbage)
    assert (check, code) == ("lost", Exit.NO_SESSION)
    assert "sent something that is no message" in text
    assert "67 61 72 62" in text


async def test_camera_that_falls_silent_is_reported() -> None:
    check, text, code = await last_finding(
        faults.HalfOpen(on="Query", nth=ROUND_TRIP_QUERY), timeout=0.1
    )
    assert (check, code) == ("lost", Exit.TIMED_OUT)
    assert "the camera fell silent after" in text
    assert "no answer to Query (0x30)" in text


async def test_camera_taken_over_udp_falls_silent_and_the_cure_says_why() -> None:
    async with EmulatedCamera(
        faults=[faults.SecondClient(on="Query", nth=ROUND_TRIP_QUERY)],
        transport="udp",
        running=True,
    ) as emulator:
        findings = await examined(emulator.url, timeout=0.1)
    assert findings[-1].check == "lost"
    assert "a client is not told that another one has taken the camera" in findings[-1].cure


# ---------------------------------------------------------------------- a slow link


async def test_slow_link_is_measured_and_gets_a_hint() -> None:
    async with EmulatedCamera(running=True) as emulator:
        slow = [rules.DelayBytes(seconds=0.055)]
        async with LinkProxy(emulator.host, emulator.port, rules=slow) as proxy:
            findings = await examined(proxy.url(emulator.url), timeout=5.0)
    assert errors(findings) == []
    assert severities(findings, "round trip") == ["hint"]
    found = finding_of(findings, "round trip")
    assert found.details["round_trip"]["min"] >= 0.055
    assert "slow for a local network" in found.text


async def test_link_reset_in_the_middle_looks_taken() -> None:
    async with EmulatedCamera(running=True) as emulator:
        reset = [rules.ResetConnection(connection=5, direction="up", at=12 * 10)]
        async with LinkProxy(emulator.host, emulator.port, rules=reset) as proxy:
            findings = await examined(proxy.url(emulator.url))
    assert errors(findings) == [("taken", Exit.NO_SESSION)]


async def test_link_cut_for_good_in_the_middle_is_no_other_client() -> None:
    async with (
        EmulatedCamera(running=True) as emulator,
        LinkProxy(emulator.host, emulator.port) as proxy,
        asyncio.TaskGroup() as group,
    ):
        watching = group.create_task(examined(proxy.url(emulator.url), seconds=5.0))
        await emulator.wait_received(0x30, count=5 + 1 + 30)
        proxy.kill()
    assert errors(watching.result()) == [("lost", Exit.NO_SESSION)]
