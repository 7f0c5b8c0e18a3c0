"""Every way to fail or be ended: exit code, one line on stderr, in time."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
from typing import TYPE_CHECKING

import pytest

from tests.cli.commandline import (
    ACTIVE_21,
    BOMB,
    BUSY,
    CONNECT,
    CONNECTED,
    DIE,
    DISCONNECT,
    HELLO_WORLD,
    INSPECTING,
    QUERY,
    SCENARIO,
    SESSION,
    STOPPED,
    TRIGGER,
    WAITING,
    Peer,
    closed_port,
    each,
    emulators,
    run,
    run_as_far_as,
    run_emulator,
)
from tests.processes import PATIENCE, Process, script

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

COMMANDS = [
    ("status", []),
    ("trigger", []),
    ("watch", []),
    ("start", []),
    ("stop", []),
    ("switch", ["3"]),
    ("probe", []),
]


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with emulators(tmp_path_factory.mktemp("errors"), ()) as (one,):
        yield one


# ---------------------------------------------------------------------- no session: 3


def test_command_nothing_listens_exits_3() -> None:
    for command, more in COMMANDS:
        with each(command), closed_port() as address:
            outcome = run(command, f"bvs://{address}", *more, "--timeout", "60")
            outcome.failed(3, address, "onnection refused")
            assert command == "probe" or outcome.out == ""


def test_error_is_json_where_json_is_asked_for() -> None:
    with closed_port() as address:
        outcome = run("status", f"bvs://{address}", "--json", "--timeout", "60")
    told = json.loads(outcome.err)
    assert (outcome.code, outcome.out) == (3, "")
    assert (told["error"], told["exit_code"]) == ("ConnectFailedError", 3)
    assert f"no session with bvs://{address}: nothing listens at" in told["text"]
    assert f"{told['host']}:{told['port']}" == address
    assert told["attempts"][0].startswith("attempt 1: ")


def test_wrong_use_is_json_where_json_is_asked_for() -> None:
    for program in (run, run_emulator):
        for arguments in (("--json", "--bogus"), ("--bogus", "--json")):
            command = ("status", "bvs://h") if program is run else ()
            outcome = program(*command, *arguments)
            told = json.loads(outcome.err)
            assert (outcome.code, told["error"], told["exit_code"]) == (2, "NoSuchOption", 2)
    told = json.loads(run("watch", "bvs://h", "--count", "-1", "--json").err)
    assert (told["error"], told["exit_code"]) == ("BadParameter", 2)


def test_status_silent_peer_exits_3() -> None:
    with Peer() as peer:
        step = "waiting for the answer to Connect"
        outcome = run_as_far_as(step, "status", f"bvs://{peer.host_and_port}")
    outcome.failed(3, step, "silence")


def test_status_silent_udp_peer_exits_3() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as silent:
        silent.bind(("127.0.0.1", 0))
        url = f"bvs+udp://127.0.0.1:{silent.getsockname()[1]}"
        outcome = run_as_far_as("nothing comes back", "status", url)
    outcome.failed(3, "nothing comes back from", "set to UDP, not to TCP")


def test_status_garbage_exits_3() -> None:
    with Peer(greeting=b"HTTP/1.1 400 Bad Request\r\n\r\n") as peer:
        outcome = run_as_far_as("wrong magic", "status", f"bvs://{peer.host_and_port}")
    outcome.failed(3, "wrong magic number: 48 54 54 50")


def test_status_length_bomb_at_connect_exits_3() -> None:
    with Peer(greeting=BOMB) as peer:
        outcome = run_as_far_as("announces", "status", peer.url)
    outcome.failed(3, "announces 4294967295 bytes")


def test_status_peer_closes_at_once_exits_3() -> None:
    with Peer({CONNECT: DIE}) as peer:
        run_as_far_as("hangs up", "status", peer.url).failed(3, "hangs up without a word")


def test_status_no_first_status_exits_3() -> None:
    with Peer({CONNECT: CONNECTED}) as peer:
        run_as_far_as("first status", "status", peer.url).failed(3, "waiting for the first status")


def test_status_no_answer_to_query_exits_3() -> None:
    with Peer({CONNECT: SESSION[CONNECT]}) as peer:
        outcome = run_as_far_as("to Query", "status", peer.url)
    outcome.failed(3, "waiting for the answer to Query")


def test_trigger_length_bomb_exits_3() -> None:
    with Peer({**SESSION, TRIGGER: BOMB}) as peer:
        outcome = run("trigger", peer.url, "--timeout", "60")
    outcome.failed(3, "announces 4294967295 bytes")


def test_trigger_garbage_exits_3() -> None:
    with Peer({**SESSION, TRIGGER: b"garbage"}) as peer:
        run("trigger", peer.url, "--timeout", "60").failed(3, "wrong magic number")


def test_trigger_connection_reset_exits_3() -> None:
    with Peer({**SESSION, TRIGGER: DIE}) as peer:
        run("trigger", peer.url, "--timeout", "60").failed(3, "the link is gone")


def test_trigger_emulator_killed_exits_3(tmp_path: Path) -> None:
    scenario = tmp_path / "slow.yaml"
    scenario.write_text(SCENARIO, encoding="utf-8")
    with Process("smartcam-emulator", str(scenario), "--debug") as emulator:
        url = emulator.read_until(b"\n").strip()
        with Process("smartcam", "trigger", url, "--application", "6") as command:
            emulator.read_until(b"Trigger", stream="stderr")
            emulator.send_signal(signal.SIGKILL)
            command.wait().failed(3, "the link is gone")


# ---------------------------------------------------------------------- a wait ran out: 4


def test_trigger_busy_for_ever_exits_4() -> None:
    with Peer({**SESSION, CONNECT: CONNECTED + BUSY}) as peer:
        outcome = run_as_far_as("did not wait", "trigger", peer.url)
    outcome.failed(4, "did not wait for a trigger within ", "status: BUSY")


def test_trigger_switch_never_answered_exits_4() -> None:
    with Peer({**SESSION, CONNECT: CONNECTED + STOPPED}) as peer:
        outcome = run_as_far_as("no answer", "trigger", peer.url, "--application", "5")
    outcome.failed(4, "no answer to SwitchApplication (0x31)")


def test_trigger_switch_while_busy_for_ever_exits_4() -> None:
    with Peer({**SESSION, CONNECT: CONNECTED + BUSY}) as peer:
        outcome = run_as_far_as("to be loaded", "trigger", peer.url, "--application", "5")
    outcome.failed(4, "for the application to be loaded; status: BUSY")


def test_start_never_running_exits_4() -> None:
    with Peer({**SESSION, CONNECT: CONNECTED + BUSY}) as peer:
        run_as_far_as("after Start", "start", peer.url).failed(4, "after Start")


def test_trigger_no_result_exits_4() -> None:
    with Peer(SESSION) as peer:
        outcome = run_as_far_as("no result", "trigger", peer.url)
    outcome.failed(4, "no result within ", "WAITING_FOR_TRIGGER")


def test_trigger_free_running_exits_4_and_reports_it(url: str) -> None:
    outcome = run_as_far_as("runs free", "trigger", url, "--application", "5")
    outcome.failed(4, "runs free")


def test_watch_count_without_result_exits_4() -> None:
    with Peer(SESSION) as peer:
        outcome = run_as_far_as("no result", "watch", peer.url, "--count", "1")
    outcome.failed(4, "no result within ", "WAITING_FOR_TRIGGER")


# ---------------------------------------------------------------------- refused, not running: 5


def test_command_unknown_application_exits_5(url: str) -> None:
    for application, text in (("0", "id 0"), ("99", "refused to switch to application 99")):
        for command in ("switch", "trigger", "watch"):
            option = [] if command == "switch" else ["--application"]
            with each(command, application):
                run(command, url, *option, application).failed(5, text)


def test_trigger_stopped_exits_5_and_tells_how_to_start(url: str) -> None:
    run("switch", url, "2").done()
    run("stop", url).done()
    outcome = run("trigger", url)
    outcome.failed(5, "application 2 is stopped", f"smartcam start '{url}'", "--application 2")


# ---------------------------------------------------------------------- not interpretable: 6


@pytest.mark.parametrize("command", ["trigger", "watch"])
def test_command_layout_too_long_exits_6(url: str, command: str) -> None:
    application = "2" if command == "trigger" else "5"
    layout = "n: int32, more: real32"
    outcome = run(command, url, "--application", application, "--interpret-as", layout)
    outcome.failed(6, "'more' (real32) at offset 4", "expected 4 bytes, got 0")


def test_trigger_layout_too_short_exits_6(url: str) -> None:
    run("trigger", url, "--application", "2", "--interpret-as", "n: int16").failed(6, "got 4")


# ---------------------------------------------------------------------- wrong usage: 2


def test_trigger_wrong_layout_text_exits_2_with_the_position() -> None:
    # nothing listens on port 1: what is wrong is seen before anything is tried
    outcome = run("trigger", "bvs://127.0.0.1:1", "--interpret-as", "n: int33")
    outcome.failed(2, "'int33'", "did you mean 'int32'?", "at character 3")


@pytest.mark.parametrize("spec", ["nonsense", ""])
def test_watch_unknown_interpreter_exits_2_and_lists_known_ones(spec: str) -> None:
    outcome = run("watch", "bvs://127.0.0.1:1", "--interpret-as", spec)
    outcome.failed(2, f"{spec!r} is unknown", "localizations, raw, record, strings50, table")


BAD_URLS = {
    "": "no host",
    "ftp://127.0.0.1": "known are bvs://, bvs+udp://",
    "bvs://": "no host",
    "bvs://127.0.0.1:99999": "ort",
    "bvs://127.0.0.1/path": "a path",
    "bvs://127.0.0.1?dialect=latin": "handbook, thesis",
    "bvs://127.0.0.1?colour=red": "known are 'dialect', 'quirks'",
}


def test_command_bad_url_exits_2() -> None:
    for command, more in COMMANDS:
        for url, text in BAD_URLS.items():
            with each(command, url):
                run(command, url, *more).failed(2, "camera address" if command == "probe" else text)


BAD_OPTIONS = [
    ("--count", "0"),
    ("--count", "many"),
    ("--seconds", "0"),
    ("--seconds", "-1"),
    ("--seconds", "nan"),
    ("--timeout", "0"),
    ("--timeout", "inf"),
    ("--timeout", "nan"),
    ("--application", "-1"),
    ("--application", "4294967296"),
    ("--trace", "/"),
]


def test_command_bad_option_exits_2() -> None:
    for command in ("trigger", "watch"):
        for option, value in BAD_OPTIONS:
            with each(command, option, value):
                outcome = run(command, "bvs://127.0.0.1:1", option, value)
                assert (outcome.code, outcome.out) == (2, "")
                last = outcome.err.splitlines()[-1]
                assert last.startswith("Error: ")
                assert option in last


def test_trigger_bad_input_exits_2() -> None:
    run("trigger", "bvs://127.0.0.1:1", "--input", "4g").failed(2, "--input", "'4g' is no hex")


def test_trigger_trace_unwritable_exits_2(tmp_path: Path) -> None:
    path = tmp_path / "missing" / "trace.jsonl"
    outcome = run("trigger", "bvs://127.0.0.1:1", "--trace", str(path))
    outcome.failed(2, f"--trace {path}: No such file or directory")


def test_unexpected_error_exits_1_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("smartcam._cli.demo.EmulatedCamera", None)
    run("demo").failed(1, "unexpected TypeError", "--debug shows where")


def test_status_debug_shows_the_traceback() -> None:
    with Process("smartcam", "status", "bvs://127.0.0.1:1", "--debug") as command:
        outcome = command.wait()
    assert outcome.code == 3
    assert "Traceback" in outcome.err
    assert outcome.err.splitlines()[-1].startswith("smartcam: error: ")


# ----------------------------------------------------------------------
# Ctrl-C, SIGTERM, and a reader of stdout that goes away.


WORKING = {**SESSION, QUERY: ACTIVE_21 + HELLO_WORLD, TRIGGER: INSPECTING + HELLO_WORLD + WAITING}
"""A camera that sends a result by itself, and one for every trigger."""


@pytest.mark.parametrize(
    ("command", "number", "code"),
    [
        ("watch", signal.SIGINT, 0),
        ("watch", signal.SIGTERM, 143),
        ("trigger", signal.SIGINT, 130),
        ("trigger", signal.SIGTERM, 143),
    ],
)
def test_command_signal_says_disconnect(command: str, number: int, code: int) -> None:
    with (
        Peer(WORKING) as peer,
        Process("smartcam", command, peer.url, "--count", "1000000") as process,
    ):
        process.read_until(b"\n")
        process.send_signal(number)
        outcome = process.wait()
        peer.wait_last(DISCONNECT)
    assert (outcome.code, outcome.err) == (code, "")


def test_trigger_interrupted_while_it_waits_says_disconnect() -> None:
    with Peer(SESSION) as peer, Process("smartcam", "trigger", peer.url) as process:
        peer.wait_received(TRIGGER)
        process.send_signal(signal.SIGINT)
        outcome = process.wait()
        peer.wait_last(DISCONNECT)
    assert outcome == (130, "", "")


def test_status_interrupted_during_connect_says_disconnect() -> None:
    with Peer() as peer, Process("smartcam", "status", peer.url) as process:
        peer.wait_received(CONNECT)
        process.send_signal(signal.SIGINT)
        outcome = process.wait()
        peer.wait_last(DISCONNECT)
    assert outcome == (130, "", "")


@pytest.mark.parametrize(
    ("name", "command"),
    [("click", "protocols"), ("construct", "decode"), ("asyncio", "status"), ("asyncio", "probe")],
)
def test_command_interrupted_during_import_exits_130(
    tmp_path: Path, name: str, command: str
) -> None:
    (tmp_path / f"{name}.py").write_text("raise KeyboardInterrupt\n", encoding="utf-8")
    env = {"PYTHONPATH": str(tmp_path)}
    given = [] if command == "protocols" else ["505356420000000030000000"]  # decode: a Query
    with Process("smartcam", command, *given, env=env, fresh=True) as process:
        assert process.wait() == (130, "", "")


@pytest.mark.parametrize("command", ["trigger", "probe"])
def test_command_stdout_closed_ends_quietly_and_says_disconnect(command: str) -> None:
    more = ["--count", "1000000"] if command == "trigger" else []
    with Peer(WORKING) as peer, Process("smartcam", command, peer.url, *more) as process:
        process.close_stdout()
        outcome = process.wait()
        peer.wait_last(DISCONNECT)
    assert (outcome.code, outcome.err) == (0, "")


def test_trigger_into_head_ends_quietly() -> None:
    with Peer(WORKING) as peer:
        outcome = subprocess.run(  # noqa: S602 - a shell's pipe is what is tested
            '"$SMARTCAM" trigger "$URL" --count 1000000 --json | head -n 1',  # noqa: S607
            shell=True,
            env={**os.environ, "SMARTCAM": script("smartcam"), "URL": peer.url},
            capture_output=True,
            timeout=PATIENCE,
            check=True,
        )
        peer.wait_last(DISCONNECT)
    assert outcome.stdout.count(b"\n") == 1
    assert outcome.stderr == b""


def test_trigger_narrow_encoding_escapes_what_it_lacks() -> None:
    text = "Größe→".encode().ljust(20, b"\0")
    answers = {**WORKING, TRIGGER: INSPECTING + HELLO_WORLD[:-20] + text + WAITING}
    with (
        Peer(answers) as peer,
        Process(
            "smartcam", "trigger", peer.url, "--interpret-as", "t: string[20]",
            env={"PYTHONIOENCODING": "latin-1", "PYTHONUTF8": "0"}, fresh=True,
        ) as process,
    ):  # fmt: skip
        process.read_until(b"t = Gr\xf6\xdfe\\u2192\n")


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("trigger", "bvs://HOST", "--application", "seven"), "'seven' is not a whole number."),
        (("trigger", "bvs://HOST", "--timeout", "0,5"), "not a number; did you mean 0.5?"),
        (("calibrate", "plan"), "No such command 'plan'; commands are compare, draw"),
        (("calibrate", "len"), "No such command 'len'; did you mean 'lens'"),
        (("calibrate", "plane", "bvs://HOST"), "smartcam calibrate URL --wizard plane"),
        (("calibrate", "show", "file.json"), "No such command 'show'; commands are compare"),
    ],
)
def test_wrong_use_is_reported_in_words(arguments: tuple[str, ...], text: str) -> None:
    outcome = run(*arguments)
    assert outcome.code == 2
    assert text in " ".join(outcome.err.split())


def test_name_of_a_host_is_no_mistyped_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # where a wizard keeps its journal
    outcome = run("calibrate", "vision1.invalid", "--application", "7", "--timeout", "0.5")
    assert "No such command" not in outcome.err


@pytest.mark.parametrize(
    ("address", "text"),
    [
        ("bvs:/127.0.0.1", "has a path, which means nothing: expected bvs://HOST[:PORT]"),
        ("insight://127.0.0.1/cam", "means nothing: expected insight://HOST[:PORT]"),
    ],
)
def test_address_with_a_path_is_told_its_form(address: str, text: str) -> None:
    run("status", address).failed(2, text)


def test_file_that_is_not_there_is_told_which_one_was_meant(tmp_path: Path) -> None:
    (tmp_path / "fleet.yaml").write_text("cameras: {}\n", encoding="utf-8")
    where = str(tmp_path / "fleet.yml")
    failed = run("serve", where).failed(2, "No such file or directory; did you mean 'fleet.yaml'?")
    assert "Errno" not in failed.err


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("cameras: [line1]", "cameras: Input should be a valid dictionary (got a list)"),
        ("cameras: {a: {emulated: {count: many}}}", "count: Input should be a valid integer"),
        ("cameras: {a: {emulated: {count: many}}}", "(got 'many')"),
    ],
)
def test_mistake_in_a_file_says_what_came(tmp_path: Path, text: str, told: str) -> None:
    path = tmp_path / "fleet.yaml"
    path.write_text(text, encoding="utf-8")
    run("serve", str(path)).failed(2, told)


def test_layout_in_a_file_is_reported_without_the_mark_below_it(tmp_path: Path) -> None:
    path = tmp_path / "fleet.yaml"
    entry = '{url: "bvs://HOST", interpret_as: "x: real32 mmm"}'
    path.write_text(f"cameras:\n  a: {entry}\n", encoding="utf-8")
    failed = run("serve", str(path)).failed(2, "got 'mmm' at character 10")
    assert failed.err.endswith("at character 10\n")


def test_hex_that_is_none_is_reported_without_pythons_words() -> None:
    failed = run("decode", "zz", "--interpret-as", "x: real32").failed(2, "two of 0-9 and a-f")
    assert "fromhex" not in failed.err


def test_port_of_an_address_that_is_searched_has_no_place() -> None:
    run("find", "127.0.0.1:36701", "--may-disturb").failed(2, "a port has no place here")
