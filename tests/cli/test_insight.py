"""Commands with an In-Sight camera, the emulated one."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.cli.commandline import closed_port, emulators, run, run_emulator
from tests.processes import Process

CAN = "switch, load_file, start_stop, result_codes, get_status, read_image"


@pytest.fixture(scope="module")
def started() -> Iterator[str]:
    """An emulated camera as the command starts it."""
    with Process("smartcam-emulator", "--protocol", "insight") as emulator:
        yield emulator.read_until(b"\n").strip()
        emulator.send_signal(signal.SIGTERM)
        emulator.wait().done()


@pytest.fixture
def url(started: str) -> str:
    """The same, as it is at first: offline, job 1 is active."""
    (line,) = run("stop", started, "--json").done().lines
    if line["active_application"] != 1:
        run("switch", started, "1").done()
    return started


@pytest.fixture
def online(url: str) -> str:
    """The same, online."""
    run("start", url).done()
    return url


def test_emulator_says_what_it_is() -> None:
    with Process("smartcam-emulator", "--protocol", "insight", "--json") as emulator:
        said = json.loads(emulator.read_until(b"\n"))
        emulator.send_signal(signal.SIGINT)
        emulator.wait().done()
    assert said["url"] == f"insight://127.0.0.1:{said['port']}"
    assert (said["transport"], said["dialect"], said["applications"]) == (
        "tcp",
        "native",
        [1, 7, 9],
    )


def test_emulator_takes_quirks_and_several_cameras() -> None:
    options = ("--protocol", "insight", "--quirk", "image_size=bytes", "--cameras", "2")
    with Process("smartcam-emulator", *options) as emulator:
        urls = emulator.read_until(b"\n", count=2).split()
        for url in urls:
            run("status", url).done()
        emulator.send_signal(signal.SIGTERM)
        emulator.wait().done()
    assert len(set(urls)) == 2


@pytest.mark.parametrize(
    ("given", "text"),
    [
        (("--dialect", "handbook"), "--protocol insight takes no --dialect"),
        (("--transport", "tcp"), "--protocol insight takes no --transport"),
    ],
)
def test_emulator_refuses_what_does_not_fit(given: tuple[str, ...], text: str) -> None:
    outcome = run_emulator("--protocol", "insight", *given)
    assert outcome.code == 2
    assert text in outcome.err


def test_emulator_refuses_a_quirk_of_the_other_protocol() -> None:
    run_emulator("--protocol", "insight", "--quirk", "push_status").failed(
        2, "quirks: push_status: Extra inputs are not permitted"
    )


def test_status_shows_the_camera(url: str) -> None:
    out = run("status", url).done().out
    assert out == (
        f"{url}?dialect=native\n  application 1, stopped\n  status: no bit set\n"
        "  protocol version 1\n"
    )
    (line,) = run("status", url, "--json").done().lines
    assert (line["active_application"], line["status"]) == (1, [])


def test_start_and_stop_go_online_and_offline(url: str) -> None:
    assert "application 1, running" in run("start", url).done().out
    assert "status: RUNNING + WAITING_FOR_TRIGGER" in run("status", url).done().out
    assert "application 1, stopped" in run("stop", url).done().out


def test_image_is_written_as_the_camera_sends_it(online: str, tmp_path: Path) -> None:
    run("trigger", f"{online}?cells=A1").done()
    file = tmp_path / "seen.bmp"
    (line,) = run("image", online, "-o", str(file), "--json").done().lines
    data = file.read_bytes()
    assert data.startswith(b"BM")
    assert (line["file"], line["size"]) == (str(file), len(data))
    run("image", online, "-o", str(file)).failed(2, "exists already; --force replaces it")
    assert f"{len(data):,} bytes" in run("image", online, "-o", str(file), "--force").done().out
    run("image", online, "-o", str(tmp_path / "none" / "seen.bmp")).failed(2, "none")


def test_image_of_a_camera_that_has_none_reports_it(tmp_path: Path) -> None:
    with emulators(tmp_path, ()) as (bvs,):
        run("image", bvs, "-o", str(tmp_path / "seen.bmp")).failed(5, "has no ReadImage")
    assert not (tmp_path / "seen.bmp").exists()


@pytest.mark.long
def test_trigger_without_cells_reports_it(online: str) -> None:
    said = "no cells are asked for, so results are empty; ?cells=B2,C2 in the URL names some"
    empty = run("trigger", online)
    assert (empty.code, empty.err) == (0, f"note: {said}\n")
    run("trigger", f"{online}?cells=A1").done()
    wrong = run("trigger", online, "--interpret-as", "x: real32")
    assert (wrong.code, wrong.err.count("?cells=B2,C2 in the URL names")) == (6, 2)
    assert f"warning  session: {said}" in run("doctor", online).out


def test_trigger_prints_cells_as_the_layout_says(online: str) -> None:
    cells, layout = f"{online}?cells=A1,Passed,C1", "x: real32 mm, ok: bool, code: string[8]"
    (line,) = run("trigger", cells, "--interpret-as", layout, "--json").done().lines
    assert line["value"] == {"x": pytest.approx(0.1015), "ok": True, "code": "ABC"}
    assert json.loads(bytes.fromhex(line["raw"])) == {
        "A001": "101.500",
        "Passed": "1.000",
        "C001": "ABC",
    }
    out = run("trigger", cells, "--interpret-as", layout, "--count", "2").done().out
    assert out.count("  x = 0.1015 m\n  ok = True\n  code = ABC\n") == 2


def test_trigger_with_an_application_has_it_online(url: str) -> None:
    cells = f"{url}?cells=A1"
    options = ("--application", "7", "--interpret-as", "n: int32 @sequence", "--count", "3")
    lines = run("trigger", cells, *options, "--json").done().lines
    assert [line["sequence"] for line in lines] == [1, 2, 3]
    assert {line["application"] for line in lines} == {7}


def test_trigger_of_a_camera_that_is_offline_exits_5_and_says_how_to_start(url: str) -> None:
    run("trigger", f"{url}?cells=A1").failed(
        5, "application 1 is stopped", f"smartcam start '{url}?dialect=native&cells=A1'"
    )


@pytest.mark.parametrize(
    ("query", "layout", "code", "text"),
    [
        ("?cells=A1", "x: int32", 6, "cell A001 holds '101.500': no whole number"),
        ("?cells=A1", "x: real32, y: real32", 6, "1 cells came, the layout has 2 fields"),
        ("?cells=A999", "x: int32", 2, "'A999' is no cell"),
        ("?cells=A1", "x: int", 2, "did you mean 'int32'?"),
    ],
)
def test_trigger_that_cannot_be_read_exits(
    online: str, query: str, layout: str, code: int, text: str
) -> None:
    run("trigger", online + query, "--interpret-as", layout).failed(code, text)


def test_trigger_with_input_is_unsupported(online: str) -> None:
    run("trigger", f"{online}?cells=A1", "--input", "00").failed(5, f"no SetInput; it can: {CAN}")


@pytest.mark.parametrize("job", ["7", "7Counter.job", "7Counter"])
def test_switch_takes_an_id_or_a_file(url: str, job: str) -> None:
    (line,) = run("switch", url, job, "--json").done().lines
    assert (line["active_application"], line["status"]) == (7, [])


@pytest.mark.parametrize("job", ["8", "nix.job"])
def test_switch_refused_exits_5(online: str, job: str) -> None:
    run("switch", online, job).failed(
        5, f"refused to switch to application {job}: code -2 (the camera is online, there is"
    )
    assert "application 1, running" in run("status", online).done().out


@pytest.mark.parametrize("job", ["1000", "4294967295"])
def test_switch_to_an_id_that_no_job_has_exits_2(url: str, job: str) -> None:
    run("switch", url, job).failed(2, f"application id {job} is not 0 to 999")


@pytest.mark.parametrize("job", ["4294967296", "+-3"])
def test_switch_to_a_number_that_is_no_id_is_wrong_usage(url: str, job: str) -> None:
    outcome = run("switch", url, job)
    assert outcome.code == 2
    assert "Invalid value for 'ID|FILE'" in outcome.err


def test_switch_to_a_file_is_unsupported_if_there_are_none() -> None:
    with Process("smartcam-emulator") as emulator:
        url = emulator.read_until(b"\n").strip()
        run("switch", url, "7bolts.job").failed(
            5, "'7bolts.job' is no id, and so the name of a file: dialect handbook has no LoadFile"
        )
        emulator.send_signal(signal.SIGTERM)
        emulator.wait().done()


def test_watch_says_that_nothing_comes_by_itself(online: str) -> None:
    run("watch", online, "--seconds", "10").failed(
        5, "the camera sends no results by itself; to have some: smartcam trigger 'insight://"
    )


def test_probe_shows_the_conversation(url: str) -> None:
    out = run("probe", url, "--timeout", "60").done().out
    assert sum(line.startswith("  ") for line in out.splitlines()) == 11
    for line in (
        "tcp native: a camera answers\n",
        "  < line(text=Welcome to In-Sight(tm)  8502P Session 0)  57656c636f6d65",
        "  < text(text=User: )  557365723a20\n",
        "  > command(text=admin)  61646d696e0d0a\n",
        "  > password(text=***)  \n",
        "  < line(text=User Logged In)  ",
        "  > command(text=GJ)  474a0d0a\n",
        f"use: {url}?dialect=native\n",
    ):
        assert line in out


def test_probe_never_sends_or_shows_a_wrong_password_twice(url: str, tmp_path: Path) -> None:
    trace = tmp_path / "trace.jsonl"
    login = url.replace("//", "//admin:hunter2@")
    outcome = run("probe", login, "--trace", str(trace))
    outcome.failed(3, "code -6 (the user or the password is wrong)")
    written = trace.read_text(encoding="utf-8")
    shown = written + outcome.out + outcome.err
    assert "hunter2" not in shown
    assert b"hunter2".hex() not in shown
    assert written.count('"password"') == 1


def test_wrong_password_exits_3_at_once(url: str) -> None:
    outcome = run("status", url.replace("//", "//admin:hunter2@"))
    outcome.failed(3, "insight://admin@127.0.0.1", "the user or the password is wrong")
    assert "hunter2" not in outcome.err


def test_nothing_listens_exits_3() -> None:
    with closed_port() as address:
        run("status", f"insight://{address}", "--timeout", "60").failed(3, "Connection refused")


def test_protocols_lists_it_with_its_parameters() -> None:
    lines = run("protocols", "--json").done().lines
    (line,) = [line for line in lines if line["name"] == "insight"]
    assert (line["schemes"], line["default_port"], line["models"]) == (
        ["insight"],
        23,
        ["IN-SIGHT"],
    )
    assert list(line["parameters"]) == ["user", "password", "cells", "counter"]
    assert "insight (built-in): insight://, port 23" in run("protocols").done().out
