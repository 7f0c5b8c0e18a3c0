"""Messages to systemd, by a socket of its kind."""

from __future__ import annotations

import asyncio
import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from smartcam._cli.systemd import MAX_UNSENT, Notifier

pytestmark = pytest.mark.skipif(not hasattr(socket, "AF_UNIX"), reason="no such sockets here")


@pytest.fixture(params=["path", "abstract"])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    if request.param == "path":
        return str(tmp_path / "notify")
    if not Path("/proc/self").exists():
        pytest.skip("sockets without a path are Linux'")
    return f"@smartcam-test-{os.getpid()}-{time.monotonic_ns()}"


@pytest.fixture
def heard(place: str) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.bind(place.replace("@", "\0"))
        sock.setblocking(False)
        yield sock


def read(sock: socket.socket) -> list[list[str]]:
    found: list[list[str]] = []
    while True:
        try:
            found.append(sock.recv(1 << 16).decode().split("\n"))
        except BlockingIOError:
            return found


def test_each_state_is_one_datagram(place: str, heard: socket.socket) -> None:
    notifier = Notifier({"NOTIFY_SOCKET": place})
    before = time.monotonic_ns() // 1000
    notifier.report_ready("2 of 2")
    notifier.report_reloading("reading")
    notifier.report_ready("3 of 3,\nand a line")
    notifier.report_status("3 of 3, and a line")  # as before: nothing new
    notifier.report_status("x" * 1000)
    notifier.report_alive()
    notifier.report_stopping()
    notifier.close()
    ready, reloading, again, long, alive, stopping = read(heard)
    assert ready == ["READY=1", "STATUS=2 of 2"]
    assert (reloading[0], reloading[2]) == ("RELOADING=1", "STATUS=reading")
    clock = int(reloading[1].removeprefix("MONOTONIC_USEC="))
    assert before <= clock <= time.monotonic_ns() // 1000
    assert again == ["READY=1", "STATUS=3 of 3, and a line"]
    assert long == ["STATUS=" + "x" * 500]
    assert alive == ["WATCHDOG=1"]
    assert stopping == ["STOPPING=1", "STATUS=stopping"]


def test_who_does_not_read_stops_nothing_and_hears_of_states_later(
    place: str, heard: socket.socket
) -> None:
    notifier = Notifier({"NOTIFY_SOCKET": place})
    for _ in range(1000):
        notifier.report_alive()
    notifier.report_ready("here")
    assert ["READY=1", "STATUS=here"] not in read(heard)
    notifier.report_alive()
    assert read(heard) == [["READY=1", "STATUS=here"], ["WATCHDOG=1"]]
    for _ in range(1000):
        notifier.report_ready("again")
    assert len(notifier._unsent) <= MAX_UNSENT
    notifier.close()


def test_nobody_is_told_if_nobody_wants_to_know(caplog: pytest.LogCaptureFixture) -> None:
    for given in ({}, {"NOTIFY_SOCKET": ""}, {"NOTIFY_SOCKET": "vsock:2:1"}):
        notifier = Notifier(given)
        assert not notifier.is_wanted
        notifier.report_ready("")
    assert "expected /PATH or @NAME, got 'vsock:2:1'" in caplog.text
    gone = Notifier({"NOTIFY_SOCKET": "/nowhere/at/all"})
    gone.report_ready("")
    gone.report_stopping()
    gone.close()
    assert caplog.text.count("reports to systemd by NOTIFY_SOCKET fail") == 1


def test_the_watchdog_is_for_the_process_that_systemd_means() -> None:
    here = str(os.getpid())
    assert Notifier({"WATCHDOG_USEC": "30000000"}).watchdog == 30.0
    assert Notifier({"WATCHDOG_USEC": "500000", "WATCHDOG_PID": here}).watchdog == 0.5
    for other in ({"WATCHDOG_USEC": "1000", "WATCHDOG_PID": "1"}, {"WATCHDOG_USEC": "x"}, {}):
        assert Notifier(other).watchdog is None


async def test_the_loop_tells_that_it_runs_at_half_of_the_time(
    place: str, heard: socket.socket
) -> None:
    notifier = Notifier({"NOTIFY_SOCKET": place, "WATCHDOG_USEC": "8000000"})
    said = "one"
    with notifier.reporting(lambda: said):
        assert read(heard) == [["WATCHDOG=1"], ["STATUS=one"]]
        await asyncio.sleep(3.9)
        assert read(heard) == []
        said = "two"
        await asyncio.sleep(0.2)
        assert read(heard) == [["WATCHDOG=1"], ["STATUS=two"]]
        await asyncio.sleep(8.0)
        assert read(heard) == [["WATCHDOG=1"]] * 2
    await asyncio.sleep(20.0)
    assert read(heard) == []
    notifier.close()
