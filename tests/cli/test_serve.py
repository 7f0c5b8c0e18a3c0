"""``smartcam serve`` as a process: signals, systemd, health and numbers, the log."""

from __future__ import annotations

import json
import os
import signal
import socket
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.processes import PATIENCE, Process, free_place, free_port

pytestmark = pytest.mark.real_time


class Unit:
    """Messages of a process that systemd hears."""

    def __init__(self) -> None:
        self.place = f"@smartcam-serve-{os.getpid()}-{time.monotonic_ns()}"
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(self.place.replace("@", "\0"))
        self._socket.settimeout(PATIENCE)

    def hear(self, word: str) -> list[str]:
        while True:
            lines = self._socket.recv(1 << 16).decode().split("\n")
            if lines[0] == word:
                return lines

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def unit() -> Iterator[Unit]:
    if not Path("/proc/self").exists():
        pytest.skip("sockets without a path are Linux'")
    made = Unit()
    yield made
    made.close()


def put(path: Path, count: int, place: str, **operations: Any) -> None:
    file = {
        "agent": "a1",
        "listen": place,
        "operations": {"listen": f"127.0.0.1:{operations.pop('port')}", **operations},
        "cameras": {"e/**": {"emulated": {"count": count}}},
    }
    path.write_text(yaml.safe_dump(file), "utf-8")


def ask(port: int, path: str) -> tuple[int, str]:
    try:
        url = f"http://127.0.0.1:{port}{path}"
        with urllib.request.urlopen(url, timeout=PATIENCE) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as exc:
        with exc:
            return exc.code, exc.read().decode()


def test_a_process_is_told_ready_reloaded_and_stopped_and_says_how_it_is(
    tmp_path: Path, unit: Unit
) -> None:
    path, port = tmp_path / "fleet.yaml", free_port()
    place = free_place()
    put(path, 2, place, port=port)
    env = {"NOTIFY_SOCKET": unit.place, "WATCHDOG_USEC": "20000000"}
    with Process("smartcam", "serve", str(path), "--log", "json", env=env) as process:
        assert unit.hear("READY=1") == ["READY=1", "STATUS=2 of 2 cameras connected"]
        assert ask(port, "/healthz") == (200, "ok\n")
        status, text = ask(port, "/readyz")
        assert (status, json.loads(text)["connected"]) == (200, 2)
        assert 'smartcam_connected{agent="a1",camera="e/cam2"} 1.0' in ask(port, "/metrics")[1]

        put(path, 3, place, port=port)
        process.send_signal(signal.SIGHUP)
        reloading = unit.hear("RELOADING=1")
        assert reloading[1].startswith("MONOTONIC_USEC=")
        unit.hear("READY=1")
        assert len(json.loads(ask(port, "/readyz")[1])["not_connected"]) <= 1

        put(path, 3, place, port=port, log="json")
        process.send_signal(signal.SIGHUP)
        _, said = unit.hear("READY=1")
        assert "not reloaded: operations: it was changed" in said
        assert 'smartcam_last_reload_successful{agent="a1"} 0.0' in ask(port, "/metrics")[1]

        process.send_signal(signal.SIGTERM)
        unit.hear("STOPPING=1")
        ended = process.wait()
    assert (ended.code, ended.out) == (0, "")
    lines = [json.loads(line) for line in ended.err.splitlines()]
    assert {one["agent"] for one in lines} == {"a1"}
    shared = [one["camera"] for one in lines if one["message"].startswith("shared: ")]
    assert shared == ["e/cam1", "e/cam2"]
    told = [one["message"] for one in lines if one["logger"] == "smartcam.fleet"]
    assert told[0] == "the fleet file was read again: 1 added (e/cam3), 2 kept"
    assert told[1].startswith("the fleet file was not taken, all stays as it was: operations:")


def test_a_fleet_is_reloaded_by_a_command(tmp_path: Path, unit: Unit) -> None:
    path = tmp_path / "fleet.yaml"
    place = free_place()
    put(path, 2, place, port=0)
    url = f"fleet://{place.removeprefix('tcp/')}"
    env = {"NOTIFY_SOCKET": unit.place}
    with Process("smartcam", "serve", str(path), env=env) as process:
        unit.hear("READY=1")
        put(path, 1, place, port=0)
        with Process("smartcam", "fleet", "reload", url, "--json") as command:
            (said,) = command.wait().done().lines
        assert said["removed"] == ["e/cam2"]
        assert said["kept"] == 1
        path.write_text("cameras: [", "utf-8")
        with Process("smartcam", "fleet", "reload", url, "--agent", "a1") as command:
            ended = command.wait()
        assert ended.code == 2
        assert ended.out.startswith("a1: error: fleet ")
        with Process("smartcam", "fleet", "reload", url, "--agent", "a2") as command:
            command.wait().failed(2, "no agent 'a2'", "a1")
        process.send_signal(signal.SIGTERM)
        ended = process.wait()
    assert ended.code == 0
    assert "reloaded: 1 removed (e/cam2), 1 kept\n" in ended.err
    assert "not reloaded, all stays as it was: fleet " in ended.err


def test_a_wrong_file_is_reported_as_json(tmp_path: Path) -> None:
    path = tmp_path / "fleet.yaml"
    path.write_text("operations: {listen: here}\ncameras: {a: {emulated: {}}}", "utf-8")
    with Process("smartcam", "serve", str(path), "--log", "json") as process:
        ended = process.wait()
    line = json.loads(ended.err)
    assert (ended.code, line["level"], line["logger"]) == (2, "critical", "smartcam.serve")
    assert "operations.listen: expected HOST:PORT" in line["message"]


def test_agent_whose_router_is_away_tries_again_and_a_router_has_no_cameras(tmp_path: Path) -> None:
    place = free_place()
    south, router = tmp_path / "south.yaml", tmp_path / "router.yaml"
    router.write_text(f"agent: router\nlisten: {place}\ncameras: {{}}\n")
    south.write_text(
        f"agent: south\nconnect: {place}\ncameras: {{line1/cam3: {{emulated: {{}}}}}}\n"
    )
    with Process("smartcam", "serve", str(south), merged=True) as agent:
        said = agent.read_until(b"\n")
        assert "cannot reach" in said
        assert said.endswith("; trying again\n")
        with Process("smartcam", "serve", str(router)) as other:
            host = place.removeprefix("tcp/")
            assert other.read_until(b"\n") == f"fleet://{host}  a router, without cameras\n"
            shared = agent.read_until(b"\n", count=2).splitlines()[-1]
            assert shared.startswith(f"fleet://{host}/line1/cam3")
            with Process(
                "smartcam", "trigger", f"fleet://{host}/line1/cam3", "--application", "7"
            ) as it:
                assert it.wait().code == 0
            agent.send_signal(signal.SIGTERM)
            assert agent.wait().code == 0
            other.send_signal(signal.SIGTERM)
            assert other.wait().code == 0
