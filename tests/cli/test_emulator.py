"""``smartcam-emulator``."""

from __future__ import annotations

import json
import re
import signal
import socket
from pathlib import Path

import pytest

from tests.cli.commandline import SCENARIO, run, run_emulator
from tests.processes import Process

URL = re.compile(r"(bvs|bvs\+udp)://127\.0\.0\.1:(\d+)\?dialect=(handbook|thesis)")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_emulator_signal_ends_it_well(number: int) -> None:
    with Process("smartcam-emulator", fresh=True) as emulator:
        line = emulator.read_until(b"\n")
        match = URL.fullmatch(line.strip())
        assert match is not None
        assert (match[1], match[3]) == ("bvs", "handbook")
        emulator.send_signal(number)
        outcome = emulator.wait()
    assert outcome == (0, line, "")


def test_emulator_with_a_client_ends_well() -> None:
    with Process("smartcam-emulator") as emulator:
        url = emulator.read_until(b"\n").strip()
        with Process("smartcam", "watch", url, "--application", "9") as client:
            client.read_until(b"\n")
            emulator.send_signal(signal.SIGTERM)
            emulator.wait().done()
            client.wait().failed(3, "the link is gone")


@pytest.mark.sampled(every=2)
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_emulator_in_a_background_that_ignores_sigint_ends_well(number: int) -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        emulator = Process("smartcam-emulator", fresh=True)
    finally:
        signal.signal(signal.SIGINT, before)
    with emulator:
        emulator.read_until(b"\n")
        emulator.send_signal(number)
        emulator.wait().done()


def test_emulator_json_gives_one_object_a_camera() -> None:
    options = ("--cameras", "3", "--transport", "udp", "--dialect", "thesis", "--json")
    with Process("smartcam-emulator", *options) as emulator:
        lines = [json.loads(line) for line in emulator.read_until(b"\n", count=3).splitlines()]
        emulator.send_signal(signal.SIGTERM)
        emulator.wait().done()
    assert len({line["port"] for line in lines}) == 3
    for line in lines:
        assert line == {
            "url": f"bvs+udp://127.0.0.1:{line['port']}?dialect=thesis",
            "host": "127.0.0.1",
            "port": line["port"],
            "transport": "udp",
            "dialect": "thesis",
            "applications": [1, 3, 7, 9, 21],
        }


def test_emulator_cameras_each_have_a_line_and_a_state() -> None:
    with Process("smartcam-emulator", "--cameras", "3") as emulator:
        urls = emulator.read_until(b"\n", count=3).splitlines()
        assert len(set(urls)) == 3
        run("switch", urls[1], "21").done()
        states = [run("status", url, "--json").done().lines[0] for url in urls]
        emulator.send_signal(signal.SIGTERM)
        emulator.wait().done()
    assert [one["active_application"] for one in states] == [1, 21, 1]


def test_emulator_scenario_has_its_applications(tmp_path: Path) -> None:
    path = tmp_path / "scenario.yaml"
    path.write_text(f"{SCENARIO}active: 8\nrunning: true\n", encoding="utf-8")
    with Process("smartcam-emulator", str(path), "--json") as emulator:
        line = json.loads(emulator.read_until(b"\n"))
        status = run("status", line["url"]).done().out
        emulator.send_signal(signal.SIGTERM)
        emulator.wait().done()
    assert line["applications"] == [1, 2, 3, 4, 5, 6, 7, 8, 9, 11, 13, 21]
    assert "application 8, running" in status


@pytest.mark.parametrize(
    ("text", "texts"),
    [
        ("applications:\n  - {id: 0}\n", ["line 2", "applications.0.id"]),
        ("applications: [{id: 5, lay: 3}]\n", ["line 1", "applications.0.lay"]),
        ("name: camera\nquirks:\n  reboot_time: soon\n", ["line 3", "quirks.reboot_time"]),
        ("name: one\nname: two\n", ["line 2", "'name' stands there twice"]),
        ("name: [\n", ["line "]),
        ('name: "a\0b"\n', ["not allowed"]),
        ("", ["applications:"]),
        ("applications: [{id: 5}]\nactive: 99\nbuiltins: false\n", ["99"]),
    ],
)
def test_emulator_bad_scenario_exits_2(tmp_path: Path, text: str, texts: list[str]) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text, encoding="utf-8")
    outcome = run_emulator(str(path)).failed(2, *texts)
    assert "active" in text or str(path) in outcome.err
    assert outcome.out == ""


def test_emulator_missing_scenario_exits_2(tmp_path: Path) -> None:
    path = str(tmp_path / "missing.yaml")
    run_emulator(path).failed(2, path, "No such file or directory")


@pytest.mark.parametrize("transport", ["tcp", "udp"])
def test_emulator_port_taken_exits_2(transport: str) -> None:
    kind = socket.SOCK_STREAM if transport == "tcp" else socket.SOCK_DGRAM
    with socket.socket(socket.AF_INET, kind) as taken:
        taken.bind(("127.0.0.1", 0))
        if transport == "tcp":
            taken.listen()
        port = taken.getsockname()[1]
        outcome = run_emulator("--port", str(port), "--transport", transport)
    outcome.failed(2, f"cannot listen on {transport} 127.0.0.1:{port}", "in use")


def test_emulator_ports_beyond_the_last_exit_2() -> None:
    run_emulator("--port", "65535", "--cameras", "2").failed(2, "emulator: port: expected")


def test_emulator_unknown_host_exits_2() -> None:
    run_emulator("--host", "no host").failed(2, "cannot listen on tcp no host:0")


@pytest.mark.parametrize(
    "options", [("--port", "65536"), ("--dialect", "latin"), ("--cameras", "0")]
)
def test_emulator_bad_option_exits_2(options: tuple[str, str]) -> None:
    outcome = run_emulator(*options)
    assert outcome.code == 2
    assert options[0] in outcome.err.splitlines()[-1]


def test_emulator_stdout_closed_ends_quietly() -> None:
    with Process("smartcam-emulator") as emulator:
        emulator.close_stdout()
        outcome = emulator.wait()
    assert (outcome.code, outcome.err) == (0, "")


@pytest.mark.parametrize(
    ("options", "quirks"),
    [
        (("--dialect", "b16", "--quirk", "code"), "dialect=b16&quirks=code"),
        (
            ("--dialect", "b16", "--quirk", "no_id=on", "--quirk", "code=true"),
            "dialect=b16&quirks=code,no_id",
        ),
        (("--dialect", "b16", "--quirk", "code", "--quirk", "code=false"), "dialect=b16"),
        (("--dialect", "bid", "--quirk", "push_status"), "dialect=bid"),
        (("--quirk", "second_client=refuse", "--quirk", "reboot_time=0.5"), "dialect=handbook"),
    ],
)
def test_emulator_quirks_are_those_of_its_url(options: tuple[str, ...], quirks: str) -> None:
    with Process("smartcam-emulator", *options) as emulator:
        url = emulator.read_until(b"\n").strip()
        status = run("status", url, "--json").done().lines[0]
        emulator.send_signal(signal.SIGTERM)
        emulator.wait().done()
    assert url.partition("?")[2] == quirks
    assert status["url"] == url


def test_emulator_quirk_goes_before_the_scenarios_and_leaves_the_others(tmp_path: Path) -> None:
    path = tmp_path / "scenario.yaml"
    path.write_text("quirks: {no_id: true, code: true}\n", encoding="utf-8")
    options = (str(path), "--dialect", "b16", "--quirk", "code=no", "--quirk", "big_endian_number")
    with Process("smartcam-emulator", *options) as emulator:
        url = emulator.read_until(b"\n").strip()
        emulator.send_signal(signal.SIGTERM)
        emulator.wait().done()
    assert url.partition("?")[2] == "dialect=b16&quirks=big_endian_number,no_id"


@pytest.mark.parametrize(
    ("given", "texts"),
    [
        (("colour=red",), ["quirks: colour: ", "got 'red'"]),
        (("colour",), ["quirks: colour: "]),
        (("reboot_time=soon",), ["quirks: reboot_time: ", "got 'soon'"]),
        (("reboot_time=-1",), ["quirks: reboot_time: "]),
        (("reboot_time=",), ["quirks: reboot_time: "]),
        (("reboot_time=[",), ["--quirk reboot_time=[: "]),
        (("second_client=[refuse]",), ["quirks: second_client: "]),
        (("code",), ["dialect handbook has no quirk 'code'"]),
    ],
)
def test_emulator_bad_quirk_exits_2(given: tuple[str, ...], texts: list[str]) -> None:
    options = [word for one in given for word in ("--quirk", one)]
    run_emulator(*options).failed(2, *texts)
