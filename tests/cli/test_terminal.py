"""Output that only a terminal gets, on a real pseudo-terminal: colour, and a line that counts."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import threading

import pytest

from smartcam._cli.texts import table_text
from smartcam.testing import ThreadedCamera

pty = pytest.importorskip("pty", reason="needs pseudo-terminals, which Windows has none of")

pytestmark = pytest.mark.real_time

GREEN, RED = "\x1b[32m", "\x1b[31m"


def shown(*words: str, **env: str) -> str:
    """Run smartcam with stdout and stderr on a terminal; return what it showed there."""
    ours, theirs = pty.openpty()
    clean = {name: one for name, one in os.environ.items() if name not in {"NO_COLOR", "TERM"}}
    with subprocess.Popen(  # noqa: S603 - our own command
        [sys.executable, "-m", "smartcam", *words],
        stdin=subprocess.DEVNULL,
        stdout=theirs,
        stderr=theirs,
        env={**clean, "TERM": "xterm", **env},
    ) as process:
        os.close(theirs)
        parts: list[bytes] = []

        def read() -> None:
            try:
                while part := os.read(ours, 65_536):
                    parts.append(part)
            except OSError:
                pass  # the other side is closed

        reader = threading.Thread(target=read)
        reader.start()
        process.wait()
        reader.join()
    os.close(ours)
    return b"".join(parts).decode()


@pytest.mark.long
def test_doctor_has_colours_on_a_terminal_and_words_everywhere() -> None:
    with ThreadedCamera(active=21) as emulator:
        colourful = shown("doctor", emulator.url)
        assert f"{GREEN}ok      \x1b[0m session: " in colourful
        assert f"{RED}\x1b[1merror   \x1b[0m run state: " in colourful
        for env in ({"NO_COLOR": "1"}, {"TERM": "dumb"}):
            plain = shown("doctor", emulator.url, **env)
            assert "\x1b" not in plain
            assert "\r\nerror    run state: " in plain


def test_error_is_red_on_a_terminal_and_plain_as_json() -> None:
    assert f"smartcam: {RED}\x1b[1merror:\x1b[0m " in shown("status", "bvs://127.0.0.1:1")
    assert "\x1b" not in shown("status", "bvs://127.0.0.1:1", "--json")


@pytest.mark.long
def test_watch_counts_while_it_waits_and_leaves_result_lines_whole() -> None:
    words = ("--application", "9", "--interpret-as", "n: int32", "--seconds", "2.5")
    with ThreadedCamera() as emulator:
        text = shown("watch", emulator.url, *words)
    lines = text.replace("\r\n", "\n").split("\n")
    counted = [line for line in lines if " a second" in line]
    assert counted
    for line in counted:  # the line, blanks over it, and the result's
        assert re.fullmatch(r"\d+ results, \d+ a second\r *\r(result \d+ of application 9)?", line)
    assert lines[-1].endswith("\r") or lines[-1] == ""


@pytest.mark.long
def test_watch_says_for_how_long_nothing_came() -> None:
    with ThreadedCamera(active=21, running=True) as emulator:
        text = shown("watch", emulator.url, "--seconds", "4.5")
    told = re.findall(r"0 results, nothing for (\d) s\r", text)
    assert len(told) >= 2  # a slow machine leaves some out
    assert told == sorted(set(told))


@pytest.mark.long
def test_watch_shows_no_counting_line_on_a_dumb_terminal() -> None:
    with ThreadedCamera(active=21, running=True) as emulator:
        printed = shown("watch", emulator.url, "--seconds", "1.5", TERM="dumb")
    assert printed.startswith("note: no result came in 1.5 s")
    assert printed.count("\n") == 1


@pytest.mark.parametrize(
    ("values", "cells"),
    [
        ([0.0599298, 0.18505, -0.15], ["0.05993", "0.18505", "-0.15000"]),
        ([2.39838, -0.5, 0.0], ["2.39838", "-0.50000", "0.00000"]),
        ([1.0, 2.0], ["1", "2"]),
        ([12.5, 100.0], ["12.5", "100.0"]),
        ([1e-9, 0.0], ["1e-09", "0"]),
        ([1e12, 1.0], ["1e+12", "1"]),
        ([float("nan"), 1.0], ["nan", "1"]),
        ([123456.0, 0.25], ["123456", "0.25"]),
    ],
)
def test_numbers_of_a_column_have_their_points_below_each_other(
    values: list[float], cells: list[str]
) -> None:
    lines = table_text(["value"], [[value] for value in values]).splitlines()[1:]
    assert [line.strip() for line in lines] == cells
