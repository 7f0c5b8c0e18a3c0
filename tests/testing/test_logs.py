"""Expectations on the log: each holds for a good client, and fails for a bad one."""

from __future__ import annotations

import re
import socket
import time
from collections.abc import Callable, Iterator

import pytest

import smartcam
from smartcam.exceptions import ConfigurationError
from smartcam.protocols import messages as m
from smartcam.testing import ThreadedCamera
from tests.processes import PATIENCE, wait_until

pytestmark = pytest.mark.real_time

CONNECT = bytes.fromhex("50535642 00000000 01000000")
DISCONNECT = bytes.fromhex("50535642 00000000 02000000")
QUERY = bytes.fromhex("50535642 00000000 30000000")
SWITCH_5 = bytes.fromhex("50535642 04000000 31000000 05000000")
START = bytes.fromhex("50535642 00000000 41000000")


@pytest.fixture
def emulator() -> Iterator[ThreadedCamera]:
    slow = {"id": 5, "load_time": PATIENCE}
    with ThreadedCamera(applications=[slow], active=21, running=True) as threaded:
        yield threaded


def talk(emulator: ThreadedCamera, *frames: bytes) -> socket.socket:
    kind = socket.SOCK_STREAM if emulator.transport == "tcp" else socket.SOCK_DGRAM
    client = socket.socket(socket.AF_INET, kind)
    client.connect((emulator.host, emulator.port))
    for frame in frames:
        client.sendall(frame)
    return client


def client_is_heard(emulator: ThreadedCamera) -> None:
    """Wait until something was ignored."""
    end = time.monotonic() + 60
    while not any(entry.error for entry in emulator.log):
        assert time.monotonic() < end
        time.sleep(0.001)


def failure(check: Callable[..., None], *args: object, **options: object) -> str:
    with pytest.raises(AssertionError) as caught:
        check(*args, **options)
    return str(caught.value)


async def test_good_client_meets_every_expectation(emulator: ThreadedCamera) -> None:
    async with smartcam.connect(emulator.url, application=3) as camera:
        await camera.trigger()
    log = emulator.log
    log.expect(m.Connect, m.ConnectAnswer, m.Query, m.Stop, m.SwitchApplication, m.Trigger)
    log.expect("Trigger", 0x20, m.Disconnect(), only=False, timeout=PATIENCE)
    log.expect_nothing_while_busy()
    log.expect_disconnect_before_close(timeout=PATIENCE)
    log.expect_no_errors()
    assert m.Trigger() in log.received
    assert any(isinstance(message, m.ResultContainer) for message in log.sent)


def test_message_that_did_not_come_is_named_with_the_log(emulator: ThreadedCamera) -> None:
    with talk(emulator, CONNECT, QUERY):
        emulator.wait_received(m.Query)
        text = failure(emulator.log.expect, "Connect", "Query", "Trigger", timeout=0.05)
    assert text.startswith("expected Trigger, after Connect, Query; it did not come\n")
    assert re.search(r"< 127.0.0.1:\d+  Query\(\)\n", text)
    assert failure(emulator.log.expect, 0x40, timeout=0).startswith("expected message 0x40, at fir")


def test_log_that_was_full_is_reported_and_is_no_proof(emulator: ThreadedCamera) -> None:
    log = emulator.log
    with talk(emulator, CONNECT, QUERY):
        log.expect(m.Query, "QueryAnswer", timeout=PATIENCE)
        assert log.dropped_count == 0
        emulator.run(lambda camera: setattr(camera.log, "maxlen", 3))
    with talk(emulator, CONNECT) as client:
        emulator.wait_received(m.Connect, count=2)
        client.sendall(DISCONNECT)
        emulator.wait_received(m.Disconnect)
    gone = f"{log.dropped_count} older entries were pushed out of the full log\n"
    log.expect("ConnectAnswer", "Disconnect")  # what is there is there
    assert gone in failure(log.expect, "Query", timeout=0)
    # of what went, nobody knows whether it was right
    assert failure(log.expect, "Disconnect", only=True).startswith(gone)
    assert failure(log.expect_nothing_while_busy).startswith(gone)
    assert failure(log.expect_no_errors).startswith(gone)
    assert gone in failure(log.expect_disconnect_before_close, timeout=0)
    emulator.run(lambda camera: camera.log.clear())
    log.expect_no_errors()


def test_order_counts(emulator: ThreadedCamera) -> None:
    with talk(emulator, CONNECT, QUERY):
        emulator.log.expect(m.Connect, m.Query, timeout=PATIENCE)
        assert "expected Connect, after Query" in failure(
            emulator.log.expect, m.Query, m.Connect, timeout=0
        )


def test_only_finds_what_else_was_sent(emulator: ThreadedCamera) -> None:
    with talk(emulator, CONNECT, QUERY) as client:
        emulator.log.expect(m.QueryAnswer, timeout=PATIENCE)
        client.sendall(QUERY)
        emulator.wait_received(m.Query, count=2)
        emulator.log.expect(m.Connect, m.Query, m.QueryAnswer, m.Query, only=True)
        text = failure(emulator.log.expect, m.Connect, m.Query, only=True, timeout=0)
    assert text.startswith("the client also sent Query(), after Connect, Query")


def test_expectation_waits_for_what_is_on_its_way(emulator: ThreadedCamera) -> None:
    emulator.inject({"kind": "delay", "on": "Query", "seconds": 0.05})
    with talk(emulator, CONNECT, QUERY):
        emulator.log.expect(m.Query, m.QueryAnswer, timeout=PATIENCE)


def test_unknown_name_is_refused(emulator: ThreadedCamera) -> None:
    with pytest.raises(ConfigurationError, match="no message is called 'Triger'; there are"):
        emulator.log.expect("Triger")


def test_what_is_sent_while_busy_is_found(emulator: ThreadedCamera) -> None:
    emulator.device.stop()
    with talk(emulator, CONNECT, SWITCH_5):
        emulator.log.expect("SwitchApplication", "StatusReport", timeout=PATIENCE)
        with talk(emulator, QUERY):  # has no session, so nobody told it of BUSY
            emulator.wait_received(m.Query)
        emulator.log.expect_nothing_while_busy()
    with talk(emulator, CONNECT) as client:
        emulator.log.expect(m.Connect, m.Connect, m.StatusReport, timeout=PATIENCE)
        client.sendall(START)  # the camera is BUSY still
        emulator.wait_received(m.Start)
        text = failure(emulator.log.expect_nothing_while_busy)
        assert re.match(r"the client sent Start\(\) while the camera was BUSY, for .* s\n", text)
        emulator.log.expect_nothing_while_busy(m.Start)
        emulator.log.expect_nothing_while_busy(grace=60)


def test_close_without_disconnect_is_found(emulator: ThreadedCamera) -> None:
    with talk(emulator, CONNECT):
        emulator.wait_received(m.Connect)
        text = failure(emulator.log.expect_disconnect_before_close, timeout=0)
        assert "was Connect(), not Disconnect\n" in text
    wait_until(lambda: emulator.ended_connections)  # it has noticed
    text = failure(emulator.log.expect_disconnect_before_close, timeout=0.1)
    assert re.search(r"not Disconnect, and the client (reset|closed) the connection\n", text)


def test_client_that_stays_connected_is_found(emulator: ThreadedCamera) -> None:
    with talk(emulator, CONNECT, DISCONNECT):
        emulator.wait_received(m.Disconnect)
        assert failure(emulator.log.expect_disconnect_before_close, timeout=0).startswith("still")
    emulator.log.expect_disconnect_before_close(timeout=PATIENCE)


def test_over_udp_disconnect_is_the_last_message() -> None:
    with ThreadedCamera(transport="udp") as emulator, talk(emulator, CONNECT) as client:
        emulator.wait_received(m.Connect)
        assert "not Disconnect" in failure(emulator.log.expect_disconnect_before_close, timeout=0)
        client.sendall(DISCONNECT)
        emulator.log.expect_disconnect_before_close(timeout=PATIENCE)


def test_what_the_camera_refuses_is_found(emulator: ThreadedCamera) -> None:
    with talk(emulator, CONNECT):
        emulator.wait_received(m.Connect)
        emulator.log.expect_no_errors()
        with talk(emulator, b"\xff" * 40):
            client_is_heard(emulator)
        assert failure(emulator.log.expect_no_errors).startswith("the client sent what the camera")


def test_long_log_is_cut(emulator: ThreadedCamera) -> None:
    with talk(emulator, CONNECT, QUERY * 50):
        emulator.wait_received(m.Query, count=50)
        text = failure(emulator.log.expect, "Trigger", timeout=0)
    assert re.search(r"^  \.\.\. 6\d before$", text, re.MULTILINE)
    assert len(text.splitlines()) == 43
