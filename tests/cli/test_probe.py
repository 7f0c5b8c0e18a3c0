"""``smartcam probe``: every try with what was sent and what came, and the URL to use."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.cli.commandline import (
    CONNECT,
    CONNECTED,
    HELLO_WORLD,
    QUERY,
    SESSION,
    WAITING,
    Peer,
    closed_port,
    emulators,
    run,
    run_as_far_as,
)
from tests.processes import PATIENCE

ANSWERED = "tcp handbook: a camera answers"


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with emulators(tmp_path_factory.mktemp("probe"), ()) as (one,):
        yield one


@contextmanager
def datagrams(answer: bytes) -> Iterator[str]:
    """CameraAnswer every datagram with the same bytes; gives host and port."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        sock.settimeout(PATIENCE)
        port = sock.getsockname()[1]

        def serve() -> None:
            while True:
                data, peer = sock.recvfrom(2048)
                if not data:
                    return
                sock.sendto(answer, peer)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield f"127.0.0.1:{port}"
        finally:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as last:
                last.sendto(b"", ("127.0.0.1", port))
            thread.join(PATIENCE)


def lines_of(outcome: str, head: str) -> list[str]:
    """Return the lines below the first one that begins with ``head``."""
    lines = iter(outcome.splitlines())
    found: list[str] = []
    for line in lines:
        if line.startswith(head):
            break
    for line in lines:
        if not line.startswith("  "):
            break
        found.append(line.strip())
    return found


def test_probe_shows_each_frame_decoded_and_as_hex() -> None:
    with Peer(SESSION) as peer:
        outcome = run("probe", peer.url, "--timeout", "60").done()
    assert lines_of(outcome.out, ANSWERED) == [
        "> Disconnect()  505356420000000002000000",
        "> Connect()  505356420000000001000000",
        f"< ConnectAnswer(version=1)  {CONNECTED.hex()}",
        "< StatusReport(status=['RUNNING', 'WAITING_FOR_TRIGGER'], endian=0)  " + WAITING.hex(),
        "> Query()  505356420000000030000000",
        f"< QueryAnswer(application=21)  {SESSION[QUERY].hex()}",
    ]


def test_probe_ends_with_the_url_to_use(url: str) -> None:
    outcome = run_as_far_as("use: ", "probe", url.partition("?")[0]).done()
    assert outcome.out.splitlines()[-1] == f"use: {url}"


def test_probe_pinned_wrong_finds_the_right_one(url: str) -> None:
    wrong = url.replace("handbook", "thesis")
    *tries, found = run_as_far_as('"url": ', "probe", wrong, "--json").done().lines
    assert (tries[0]["dialect"], tries[-1]["outcome"]) == ("thesis", "session")
    assert (found["url"], found["application"], found["also"]) == (url, 2, [])


def test_probe_all_goes_on_after_the_first_answer(url: str) -> None:
    one = run_as_far_as('"url": ', "probe", url, "--json").done().lines
    *tries, found = run_as_far_as('"url": ', "probe", url, "--all", "--json").done().lines
    assert len(one) == 2
    assert {each["transport"] for each in tries} == {"tcp", "udp"}
    assert [each["outcome"] == "session" for each in tries] == [True] + [False] * (len(tries) - 1)
    assert found["url"] == url


def test_probe_garbage_is_shown_as_hex_and_text() -> None:
    with Peer(greeting=b"SSH-2.0-OpenSSH_9.6\r\n") as peer:
        address = f"{peer.host_and_port}?dialect=handbook"
        outcome = run_as_far_as("wrong magic number", "probe", address)
    outcome.failed(3, "wrong magic number")
    (line,) = [each for each in lines_of(outcome.out, "tcp handbook") if each.startswith("!")]
    assert line.endswith(b"SSH-2.0-OpenSSH_9.6\r\n".hex() + "  'SSH-2.0-OpenSSH_9.6..'")


def test_probe_half_a_frame_is_shown() -> None:
    with Peer({CONNECT: CONNECTED[:14]}) as peer:
        outcome = run_as_far_as("14 bytes, then silence", "probe", peer.url)
    outcome.failed(3, "14 bytes, then silence")
    line = lines_of(outcome.out, "tcp handbook")[-1]
    assert line.startswith("! 14 bytes that make no whole frame  ")
    assert CONNECTED[:14].hex() in line


def test_probe_long_frame_is_cut_for_people_and_whole_in_json() -> None:
    size = 100
    long = bytes.fromhex("50535642") + size.to_bytes(4, "little") + HELLO_WORLD[8:16]
    long += bytes(size - 4)
    with Peer({**SESSION, CONNECT: CONNECTED + long + WAITING}) as peer:
        text = run("probe", peer.url, "--timeout", "60").done().out
        first = run("probe", peer.url, "--timeout", "60", "--json").done().lines[0]
    (line,) = [each for each in lines_of(text, ANSWERED) if "ResultContainer" in each]
    assert line.endswith(long.hex()[:128] + "...")
    assert long.hex() in [frame["hex"] for frame in first["frames"]]


def test_probe_flood_is_counted_and_not_shown() -> None:
    flood = HELLO_WORLD * 200
    with Peer({**SESSION, CONNECT: CONNECTED + flood + WAITING}) as peer:
        outcome = run("probe", peer.url, "--timeout", "60").done()
    shown = outcome.out.splitlines()
    assert len(shown) < 70
    assert any(line.startswith("  ... and ") and line.endswith(" more") for line in shown)


def test_probe_broken_datagram_is_shown() -> None:
    with datagrams(b"nonsense") as address:
        url = f"bvs+udp://{address}?dialect=handbook"
        outcome = run_as_far_as(b"nonsense".hex(), "probe", url)
    outcome.failed(3, " bytes, then silence", "Something else listens there")
    shown = [each for each in lines_of(outcome.out, "udp handbook") if each.startswith("!")]
    assert shown
    assert all(each.endswith(b"nonsense".hex() + "  'nonsense'") for each in shown)


def test_probe_silence_says_what_was_sent() -> None:
    with Peer() as peer:
        step = "waiting for the answer to Connect: silence for "
        outcome = run_as_far_as(step, "probe", peer.host_and_port, "--json")
    outcome.failed(3, step)
    tries = [json.loads(line) for line in outcome.out.splitlines()]
    assert CONNECT.hex() in [frame["hex"] for one in tries for frame in one["frames"]]
    assert {one["omitted"] for one in tries} == {0}


def test_probe_trace_has_the_end_of_the_session_too(tmp_path: Path) -> None:
    path = tmp_path / "trace.jsonl"
    with Peer(SESSION) as peer:
        run("probe", peer.url, "--timeout", "60", "--trace", str(path)).done()
    messages = [json.loads(line)["message"] for line in path.read_text().splitlines()]
    assert messages == [
        "Disconnect", "Connect", "ConnectAnswer", "StatusReport", "Query", "QueryAnswer",
        "Disconnect",
    ]  # fmt: skip


def test_no_answer_is_reported_once_with_what_to_do() -> None:
    with closed_port() as place:
        failed = run("probe", place).failed(3, f"no session with {place}", "Look at the port")
    assert failed.err.count("Connection refused") == 1
