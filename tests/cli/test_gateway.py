"""``smartcam gateway``."""

from __future__ import annotations

import json
import signal
import socket
from typing import TYPE_CHECKING

from tests.cli.commandline import run
from tests.processes import PATIENCE, Process, free_port

if TYPE_CHECKING:
    from pathlib import Path


def ask(address: str, *requests: bytes) -> list[bytes]:
    """Return the answers of a gateway, a line each."""
    place = ("127.0.0.1", int(address.rpartition(":")[2]))
    with socket.create_connection(place, PATIENCE) as robot, robot.makefile("rb") as lines:
        robot.settimeout(PATIENCE)
        answers = []
        for request in requests:
            robot.sendall(request)
            answers.append(lines.readline())
        return answers


def test_demo_answers_and_tells_the_counts() -> None:
    with Process("smartcam", "gateway", "--demo", "--json", "--listen", "tcp/127.0.0.1:0") as it:
        address = json.loads(it.read_until(b"\n"))["gateway"]
        status, part = ask(address, b"STATUS\n", b"TRIGGER\r\n")
        assert status == b"0,0,1,1,7\r\n"
        assert part.startswith(b"0,6,")
        it.send_signal(signal.SIGINT)
        ended = it.wait()
    counts = json.loads(ended.out.splitlines()[-1])["counts"]
    assert (ended.code, ended.err) == (0, "")
    assert (counts["requests"], counts["parts"], counts["delivered"]) == (2, 7, 1)
    assert (counts["forgotten"], counts["waiting"]) == (6, 0)


def test_file_says_what_options_say_and_options_win(tmp_path: Path) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text("emulated: true\nrobot: ur\nlisten: tcp/127.0.0.1:0\ndecimals: 1\n")
    with Process("smartcam", "gateway", str(path), "--decimals", "2") as it:
        address = it.read_until(b"\n").split()[1]
        (part,) = ask(address, b"TRIGGER\n")
        it.send_signal(signal.SIGINT)
        assert it.wait().code == 0
    assert part.startswith(b"(0,6,0.06,0.06,0.00,")


def test_camera_that_is_not_there_is_awaited() -> None:
    url = f"bvs://127.0.0.1:{free_port()}"
    with Process("smartcam", "gateway", url, "--listen", "tcp/127.0.0.1:0") as it:
        address = it.read_until(b"\n").split()[1]
        (answer,) = ask(address, b"TRIGGER\n")
        it.send_signal(signal.SIGINT)
        ended = it.wait()
    assert answer.startswith(b"22,0,NOT_CONNECTED ")
    assert ended.code == 0
    assert "nothing listens" in ended.err


def test_what_cannot_work_is_reported() -> None:
    for given, told in (
        ((), "expected a camera's URL, a YAML file, or --demo"),
        (("--demo", "bvs://127.0.0.1"), "expected a camera's URL, a YAML file, or --demo"),
        (("--demo", "--listen", "7001"), "--listen: expected tcp/HOST:PORT"),
        (("--demo", "--line-end", "none"), "line_end: answers without a line end need a width"),
        (("nowhere.yaml",), "nowhere.yaml"),
    ):
        outcome = run("gateway", *given)
        assert outcome.code == 2, given
        assert told in outcome.err
