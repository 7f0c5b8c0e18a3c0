"""``smartcam find``: what it prints, what a fleet file gets, how it ends."""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import re
import signal
import socket
import sys
from typing import TYPE_CHECKING, Any

import pytest

from smartcam._cli import find as command
from smartcam._cli.find import fleet_lines, show_progress_line
from smartcam.doctor._inside import CameraSearch, FoundPort
from smartcam.exceptions import ConfigurationError
from smartcam.fleet import load_fleet
from tests.cli.commandline import emulators, run
from tests.doctor.findkit import NETWORK, filtered, free_port
from tests.processes import Outcome, Process

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

QUICK = ("--timeout", "0.5", "--rate", "10000")
"""Options of a quick search: a silent camera stays silent however long it is heard."""


@pytest.fixture
def port() -> int:
    return free_port()


@contextlib.contextmanager
def silent(port: int, *hosts: int) -> Iterator[list[socket.socket]]:
    """Listen at addresses that accept connections and send nothing."""
    with contextlib.ExitStack() as stack:
        yield [
            stack.enter_context(socket.create_server((f"{NETWORK}{host}", port))) for host in hosts
        ]


def search(*args: str) -> Outcome:
    """Search, and check the success, with only the progress on stderr."""
    known = () if "--protocol" in args else ("--protocol", "bvs", "--protocol", "insight")
    outcome = run("find", *args, *known)
    assert outcome.code == 0, outcome
    assert re.fullmatch(
        r"\d+ of \d+ ports tried: .* do not show\.( A camera of .*)?\n", outcome.err
    ), outcome
    return outcome


def opened(server: socket.socket) -> bool:
    """Return whether a connection was opened."""
    server.setblocking(False)
    try:
        server.accept()[0].close()
    except BlockingIOError:
        return False
    return True


def test_bounds_of_options_are_those_of_the_library() -> None:
    given = inspect.signature(CameraSearch).parameters["max_addresses"].default
    assert given == command.DEFAULT_ADDRESSES
    most: dict[str, Any] = {
        "max_addresses": command.MAX_ADDRESSES,
        "at_once": command.MAX_OPEN_CONNECTIONS,
        "rate": command.MAX_OPENINGS_PER_SECOND,
        "timeout": command.MAX_SECONDS,
    }
    CameraSearch([f"{NETWORK}2"], **most)
    for name, value in most.items():
        with pytest.raises(ConfigurationError, match=name):
            CameraSearch([f"{NETWORK}2"], **{name: value + 1})


def test_find_prints_a_table_and_how_it_went(port: int) -> None:
    with silent(port, 2, 10):
        outcome = search(f"{NETWORK}0/28", "--port", str(port), *QUICK)
    head, *rows = outcome.out.splitlines()
    assert head.split() == ["host", "port", "protocol", "opened", "what", "is", "known"]
    assert [row.split()[:3] for row in rows] == [
        [f"{NETWORK}2", str(port), "bvs"],
        [f"{NETWORK}10", str(port), "bvs"],
    ]
    assert all(row.endswith("silent, as bvs is before a client speaks") for row in rows)
    assert outcome.err == (
        "42 of 42 ports tried: 2 open, 40 refused. Cameras that are set to UDP do not show. A "
        "camera of bvs may drop its client when another one connects, as this search does: keep "
        "away from cameras at work with --exclude or --fleet.\n"
    )


def test_find_asks_nothing_without_consent_and_opens_without(port: int) -> None:
    with silent(port, 2) as (server,):
        run("find", f"{NETWORK}2", "--port", str(port), "--ask").failed(
            2, "without consent", "--may-disturb"
        )
        assert not opened(server)
        search(f"{NETWORK}2", "--port", str(port), *QUICK)
        assert opened(server)


def test_find_with_nothing_there_prints_nothing(port: int) -> None:
    args = (f"{NETWORK}1", "--protocol", "insight", *QUICK)
    outcome = search(*args)
    assert (outcome.out, outcome.err[:29]) == ("", "1 of 1 ports tried: 1 refused")
    assert search(*args, "--json").out == ""
    assert search(*args, "--yaml").out == "# cameras: none was found\n"
    run("find", *args, "--yaml", "--json").failed(2, "do not go together")


def test_find_leaves_a_fleets_cameras_alone(port: int, tmp_path: Path) -> None:
    fleet = tmp_path / "plant.yaml"
    fleet.write_text(
        f'cameras:\n  line1/cam3: {{url: "bvs://{NETWORK}2:{port}"}}\n'
        f'  line1/cam4: {{model: IN-SIGHT, url: "{NETWORK}3"}}\n  line2/**: {{emulated: {{}}}}\n'
        f'  found/{NETWORK.replace(".", "-")}4: {{url: "bvs://10.0.0.9"}}\n'
    )
    alone = ("--fleet", str(fleet), "--exclude", f"{NETWORK}1")
    args = (f"{NETWORK}1-4", "--port", str(port), "--may-disturb", *QUICK, *alone)
    with silent(port, 1, 2, 3, 4) as servers:
        out = search(*args).out
        assert f"{NETWORK}2" in out
        assert "not touched: it is line1/cam3 of the fleet" in out
        assert "not touched: it is line1/cam4 of the fleet" in out
        lines = search(*args, "--json").lines
        assert [opened(server) for server in servers] == [False, False, False, True]
        text = search(*args, "--yaml").out
    assert [line.get("fleet_camera") for line in lines] == [None, "line1/cam3", "line1/cam4"]
    assert lines[0]["urls"] == [f"bvs://{NETWORK}4:{port}"]
    assert lines[0]["evidence"] == "silent"
    assert (lines[0]["said"], "received" in lines[0]) == ("", False)
    only = search(f"{NETWORK}2", "--may-disturb", "--fleet", str(fleet))
    assert "it is line1/cam3 of the fleet" in only.out
    assert only.err.startswith("0 of 0 ports tried")
    # the lines go into that very file, below its last camera
    with fleet.open("a") as file:
        file.write(text.partition("\n")[2])
    last = load_fleet(fleet).plan()[-1]
    assert last.name == f"found/{NETWORK.replace('.', '-')}4-{port}"
    assert last.entry.url == f"bvs://{NETWORK}4:{port}"
    run("find", *args, "--fleet", str(tmp_path / "none.yaml")).failed(2, "none.yaml")


def found(host: str = "10.0.0.7", **said: object) -> FoundPort:
    given = {
        "port": 36701,
        "protocols": ("bvs",),
        "evidence": "silent",
        "received": b"",
        "seconds": 0.1,
    }
    return FoundPort(host=host, **{**given, **said})  # type: ignore[arg-type]


def test_lines_load_whatever_was_said(tmp_path: Path) -> None:
    lines = fleet_lines(
        [
            found(),
            found(port=36702),
            found("fd00::7"),
            found("10.0.0.8", protocols=("bvs", "insight"), evidence="ended"),
            found("10.0.0.9", protocols=(), evidence="other", received=b"SSH"),
            found("10.0.0.10", refusal="silence"),
            found(
                "10.0.0.11",
                protocols=("insight",),
                evidence="greeted",
                received=b'Welcome to In-Sight "\x1b[2J # {\xff\nrm: x',
            ),
        ]
    )
    path = tmp_path / "found.yaml"
    path.write_text("\n".join(lines))
    assert {one.name: one.entry.url for one in load_fleet(path).plan()} == {
        "found/10-0-0-7": "bvs://10.0.0.7:36701",
        "found/10-0-0-7-36702": "bvs://10.0.0.7:36702",
        "found/fd00--7": "bvs://[fd00::7]:36701",
        "found/10-0-0-8": "bvs://10.0.0.8:36701",
        "found/10-0-0-11": "insight://10.0.0.11:36701",
    }
    assert '  # found/10-0-0-8-36701: {url: "insight://10.0.0.8:36701"}' in "\n".join(lines)
    assert "  # found/10-0-0-10: " in "\n".join(lines)
    assert all(line.isascii() and line.isprintable() for line in lines)


@pytest.mark.long
@pytest.mark.skipif(sys.platform == "win32", reason="there is no Ctrl-C for one process")
def test_find_after_ctrl_c_shows_what_it_has(port: int) -> None:
    with (
        filtered(f"{NETWORK}9", port),
        socket.create_server((f"{NETWORK}2", port)) as server,
        Process(
            *("smartcam", "find", f"{NETWORK}2", f"{NETWORK}9", "--port", str(port)),
            *("--may-disturb", "--timeout", "60", "--json"),
        ) as process,
        server.accept()[0] as connection,
    ):
        connection.sendall(b"Welcome to In-Sight(tm)\r\n")
        assert connection.recv(1) == b""  # it has heard enough, and closed
        process.send_signal(signal.SIGINT)
        outcome = process.wait()
    assert outcome.code == 130
    assert [line["protocols"] for line in outcome.lines] == [["insight"]]
    assert outcome.lines[0]["greeting"] == "Welcome to In-Sight(tm)"
    # on a slow machine some of the other host's are refused before the signal comes
    assert re.search(r"\d+ of 12 ports tried: 1 open, \d+ refused", outcome.err)


async def test_terminal_is_told_how_far_it_is(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    search = CameraSearch(["10.0.0.1"], protocols=["insight"])
    async with show_progress_line(search):
        await asyncio.sleep(2.5)
    assert capsys.readouterr().err == ""  # which is no terminal
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setenv("TERM", "xterm")
    async with show_progress_line(search):
        search.tried, search.total, search.counts["open"] = 7, 9, 1
        await asyncio.sleep(1.5)
    clear = "\r\x1b[K"
    assert capsys.readouterr().err == f"{clear}7 of 9 ports, 1 open{clear}"


@pytest.mark.long
def test_find_asks_where_it_may(port: int, tmp_path: Path) -> None:
    with emulators(tmp_path, ("--host", f"{NETWORK}1", "--port", str(port))):
        args = (f"{NETWORK}1", "--port", str(port), "--ask", "--may-disturb", "--timeout", "2")
        out = search(*args).out
        assert f"a camera answers: bvs://{NETWORK}1:{port}?dialect=handbook" in out
        path = tmp_path / "found.yaml"
        path.write_text(search(*args, "--yaml").out)
    (planned,) = load_fleet(path).plan()
    assert planned.entry.url == f"bvs://{NETWORK}1:{port}?dialect=handbook"
