"""``smartcam calibrate``: prompts, JSON lines, going on where it was broken off."""

from __future__ import annotations

import json
import math
import re
import shlex
import signal
import urllib.request
from collections.abc import Iterator
from datetime import date
from pathlib import Path
from typing import Any

import pytest

from smartcam.calibration import PlaneCalibration, fit_plane
from smartcam.emulator._inside import PIECES
from tests.cli.commandline import closed_port, emulators, run
from tests.cli.inside import calibrate
from tests.processes import PATIENCE, Outcome, Process, printed_by

STALE = 7


YAW, OFFSET = math.radians(120.0), (0.5, -0.1, 0.02)


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with emulators(tmp_path_factory.mktemp("calibrate"), ()) as found:
        yield found[0]


def calibrating(url: str, folder: Path, lines: list[str], *options: str) -> Outcome:
    """Run the command with these lines on its standard input."""
    stdin = "".join(f"{line}\n" for line in lines).encode()
    arguments = (url, "--folder", str(folder), "--application", "7", *options)
    return run(*arguments, stdin=stdin, main=lambda: calibrate(prog_name="smartcam calibrate"))


def process(url: str, folder: Path, *options: str) -> Process:
    """Start the command in a process of its own."""
    command = ("calibrate", url, "--folder", str(folder), "--application", "7", *options)
    return Process("smartcam", *command)


def touch(name: str) -> tuple[float, float, float]:
    """Return the robot's position when it touches a piece, metres."""
    x, y, _ = PIECES[name]
    return (
        OFFSET[0] + x * math.cos(YAW) - y * math.sin(YAW),
        OFFSET[1] + x * math.sin(YAW) + y * math.cos(YAW),
        OFFSET[2],
    )


TOUCHES = [dict(zip("xyz", touch(name), strict=True)) for name in PIECES]


def as_lines(*answers: dict[str, Any]) -> list[str]:
    return [json.dumps({"answers": one}) for one in answers]


TWO_TOUCHES = ["touch-1", "touch-2"]

ABOUT = {"touch_sigma": 0.2, "unit": "m"}


def test_calibrate_in_json_gives_a_calibration(url: str, tmp_path: Path) -> None:
    lines = as_lines(ABOUT, {}, {}, *TOUCHES, {}, {})
    done = calibrating(url, tmp_path, lines, "--json").done()
    steps = [line.get("step") for line in done.lines]
    touches = [f"touch-{number}" for number in range(1, 8)]
    assert steps == ["about", "picture", "which", *touches, "review", "save", None]
    result = done.lines[-1]["result"]
    assert (result["file"], result["points"]) == ("plane.json", 7)
    assert result["held_out_mm"] < 1.0
    calibration = PlaneCalibration.load(tmp_path / "plane.json")
    assert calibration.y_down is False
    assert calibration.transform([PIECES["square"][:2]])[0] == pytest.approx(
        touch("square"), abs=0.001
    )


def test_calibrate_in_the_terminal_asks_and_shows_errors(url: str, tmp_path: Path) -> None:
    typed = [str(value) for one in TOUCHES for value in one.values()]
    about = ["marks", "m", "", "", "pin", "inch", "m", "", "0,2", ""]
    touches = [*typed[:1], "much", "", ":repeat", *typed[1:18], ":undo", *typed[15:18]]
    lines = [*about, "", *["yes"] * 6, "n", *touches, "", "", ""]
    done = calibrating(url, tmp_path, lines).done()
    assert "Step 1 of about 9: Camera, robot and tool  (:abort)" in done.out
    unit, again = done.out.split(
        "! Unit of the robot's coordinates: 'inch': expected one of mm, m\n"
    )
    assert unit.count("Unit of the robot's coordinates\n") == 1
    assert again.startswith("Unit of the robot's coordinates\n")
    assert "x, m: y, m: ! y: 'much': expected a number\ny, m: ! y: '': expected a number\n" in again
    assert "y, m: ! :repeat: expected one of :undo, :abort\ny, m: z, m: " in again
    assert "  - model " in done.out
    assert "from 6 points" in done.out
    assert "\ndone\nGood for 0." in done.out
    assert "  file: plane.json\n" in done.out


def test_calibrate_ends_with_lines_that_work_as_printed(url: str, tmp_path: Path) -> None:
    folder = tmp_path / "two words"
    about = ["", "", "cell", "", "", "m", "", "0,2", ""]
    typed = [str(value) for one in TOUCHES for value in one.values()]
    lines = [*about, "", *[""] * 7, *typed, "", "", ""]
    done = calibrating(url, folder, lines, "--name", "table").done()
    _, end = done.out.split("\ndone\n")
    assert f"  path: {folder / 'table.json'}\n" in end
    head, command, python = re.split(r"\n\nOn the command line:\n\n|\n\nIn Python:\n\n", end)
    assert "Good for " in head
    program, *words = shlex.split(command)
    assert program == "smartcam"
    shown = run(*words).done().out
    assert [line.split()[0] for line in shown.splitlines()[2:]] == list(PIECES)
    assert "cell" in words
    told = printed_by(python)
    assert [line.split()[0] for line in told.splitlines()] == list(PIECES)
    x = float(re.findall(r"Position\(x=([-\d.e]+)", told)[0])
    assert x == pytest.approx(touch(next(iter(PIECES)))[0], abs=0.001)


def test_calibrate_y_down_is_kept_and_wanted_by_the_check(url: str, tmp_path: Path) -> None:
    lines = as_lines({**ABOUT, "side": "unknown"}, {}, {}, *TOUCHES, {"next": "accept"}, {})
    calibrating(url, tmp_path, lines, "--json", "--y-down").done()
    assert PlaneCalibration.load(tmp_path / "plane.json").y_down is True
    calibrating(url, tmp_path, [], "--check", "plane").failed(
        2, "--check plane: the calibration was made with --y-down: give it here, too"
    )
    assert not (tmp_path / "plane.drift.journal").exists()
    done = calibrating(url, tmp_path, ['{"do": "abort"}'], "--json", "--check", "plane", "--y-down")
    assert (done.code, done.lines[0]["step"]) == (130, "about")


def test_calibrate_resumed_with_another_y_down_takes_no_picture(url: str, tmp_path: Path) -> None:
    only = {f"mark_{number}": number == 1 for number in range(1, 8)}
    lines = as_lines(ABOUT, {}, only, TOUCHES[0])
    calibrating(url, tmp_path, lines, "--json")
    done = calibrating(url, tmp_path, as_lines({}), "--json", "--y-down")
    assert [line["step"] for line in done.lines] == ["picture", "picture"]
    assert done.lines[1]["errors"]["base"].startswith(
        "the previous picture has y_down=False, now it is True"
    )


def saved(folder: Path) -> None:
    """Put a calibration of exact touches into the folder."""
    marks = [PIECES[name][:2] for name in PIECES]
    touched = [touch(name) for name in PIECES]
    fit_plane(marks, touched, touch_sigma=0.0002, tool_z=(0, 0, -1)).save(folder / "plane.json")


@pytest.mark.parametrize(("knock", "code"), [(0.0, 0), (0.003, STALE)])
def test_calibrate_check_tells_by_its_exit_code(
    url: str, tmp_path: Path, knock: float, code: int
) -> None:
    saved(tmp_path)
    touches = [{**one, "x": one["x"] + knock} for one in TOUCHES]
    lines = as_lines({"unit": "m"}, {}, {}, *touches, {})
    done = calibrating(url, tmp_path, lines, "--json", "--check", "plane")
    assert (done.code, done.err) == (code, "")
    assert done.lines[-1]["result"]["stale"] is (code == STALE)
    assert len((tmp_path / "plane.checks.jsonl").read_text().splitlines()) == 2


def test_calibrate_check_in_the_terminal_shows_the_verdict(url: str, tmp_path: Path) -> None:
    saved(tmp_path)
    typed = [str(value) for value in TOUCHES[0].values()]
    lines = ["m", "", "", "", *["n"] * 6, *typed, ""]
    done = calibrating(url, tmp_path, lines, "--check", "plane").done()
    assert "Step 1 of about 5: Is plane still true?  (:abort)" in done.out
    assert ": plane still holds  (:undo, :abort)" in done.out
    assert "\ndone\nStill true: 0." in done.out
    assert " mm rms off\n  name: plane\n  stale: no\n  touches: 1\n" in done.out


def test_calibrate_lists_calibrations_in_a_table(url: str, tmp_path: Path) -> None:
    saved(tmp_path)
    (tmp_path / "a.json").write_text("{")
    lines = as_lines({"unit": "m"}, {}, {}, *TOUCHES, {})
    calibrating(url, tmp_path, lines, "--json", "--check", "plane").done()
    listed = run("calibrate", "--list", "--folder", str(tmp_path)).done()
    head, broken, row = listed.out.splitlines()
    assert re.split(r" {2,}", head.strip()) == ["name", "kind", "date (UTC)", "error", "last check"]
    assert [one.strip() for one in re.split(r" {2,}", row.strip())][:2] == ["plane", "plane"]
    assert re.search(r"\d{4}-\d\d-\d\d \d\d:\d\d  0\.00 mm rms  \d{4}-.*: still true$", row)
    assert "cannot be read: " in broken
    rows = run("calibrate", "--list", "--folder", str(tmp_path), "--json").done().lines
    assert [(one["name"], one["stale"]) for one in rows] == [("a", None), ("plane", False)]


def test_calibrate_lists_an_empty_folder_and_makes_none(tmp_path: Path) -> None:
    listed = run("calibrate", "--list", "--folder", str(tmp_path)).done()
    assert listed.out == f"no calibrations in {tmp_path}\n"
    missing = tmp_path / "missing"
    run("calibrate", "--list", "--folder", str(missing)).failed(2, "no such folder")
    assert not missing.exists()


def test_calibrate_check_of_no_calibration_says_so_and_leaves_nothing(tmp_path: Path) -> None:
    done = calibrating("bvs://127.0.0.1:9", tmp_path, [], "--check", "table")
    done.failed(2, "no calibration 'table'; there are none: the folder is empty")
    assert list(tmp_path.iterdir()) == []


def test_calibrate_check_with_a_name_is_wrong_usage(tmp_path: Path) -> None:
    done = calibrating("bvs://127.0.0.1:9", tmp_path, [], "--check", "a", "--name", "b")
    assert done.code == 2
    assert "--check names the calibration already: leave out --name" in done.err


def test_calibrate_broken_off_goes_on(url: str, tmp_path: Path) -> None:
    lines = as_lines(ABOUT, {}, {}, *TOUCHES, {}, {})
    first = calibrating(url, tmp_path, lines[:5], "--json")
    first_lines, last = first.lines, first.lines[-1]
    assert first.code == 2
    assert "the same command continues with them" in first.err
    second = calibrating(url, tmp_path, lines[5:], "--json").done()
    (going_on, *_) = second.lines
    resumed = going_on.pop("resumed")
    assert first_lines[0]["resumed"] is None
    assert going_on == last
    assert [one["step"] for one in resumed["done"]] == ["about", "picture", "which", *TWO_TOUCHES]
    assert resumed["since"] <= resumed["done"][0]["at"] <= resumed["last"]
    assert len(first_lines) == 6
    assert second.lines[-1]["type"] == "result"


def test_calibrate_broken_off_says_since_when_and_asks(url: str, tmp_path: Path) -> None:
    calibrating(url, tmp_path, as_lines(ABOUT, {}, {}, *TOUCHES[:2]), "--json")
    text = (tmp_path / "plane.journal").read_text()
    (tmp_path / "plane.journal").write_text(text.replace(str(date.today().year), "2025"))  # noqa: DTZ011
    again = calibrating(url, tmp_path, ["perhaps", "", ":abort"])
    assert re.search(r"Broken off: begun 2025-\d\d-\d\d \d\d:\d\d UTC \(\d+ days ago\)", again.out)
    assert "  4. touch-1: x " in again.out
    assert "! 'perhaps': expected 'go on' or 'begin anew'" in again.out
    assert "Step 6 of about 9: " in again.out


@pytest.mark.parametrize("json_lines", [False, True])
def test_calibrate_broken_off_begins_anew_when_told(
    url: str, tmp_path: Path, json_lines: bool
) -> None:
    calibrating(url, tmp_path, as_lines(ABOUT, {}, {}, *TOUCHES[:2]), "--json")
    lines = ['{"do": "anew"}', '{"do": "abort"}'] if json_lines else ["begin anew", ":abort"]
    done = calibrating(url, tmp_path, lines, *(("--json",) if json_lines else ()))
    assert done.code == 130
    if json_lines:
        assert [line["number"] for line in done.lines[:2]] == [6, 1]
    else:
        assert "Step 1 of about 9: Camera, robot and tool" in done.out


@pytest.mark.long
def test_calibrate_killed_at_every_step_loses_no_sample(url: str, tmp_path: Path) -> None:
    touched = {f"mark_{number}": number in {1, 2, 6} for number in range(1, 8)}
    some = [TOUCHES[index] for index in (0, 1, 5)]
    lines = as_lines(ABOUT, {}, touched, *some, {"next": "accept"}, {})
    for number, line in enumerate(lines, 1):
        with process(url, tmp_path, "--json") as killed:
            killed.read_until(b"\n")
            killed.write(f"{line}\n".encode())
            shown = killed.read_until(b"\n", count=2).splitlines()
            assert [json.loads(one)["number"] for one in shown] == [number, number + 1]
            killed.send_signal(signal.SIGKILL)
    calibration = PlaneCalibration.load(tmp_path / "plane.json")
    assert calibration.robot_points.tolist() == [list(one.values()) for one in some]


def test_calibrate_aborted_has_its_exit_code_and_no_file(url: str, tmp_path: Path) -> None:
    done = calibrating(url, tmp_path, [":repeat", ":abort"])
    assert (done.code, done.err) == (130, "")
    assert "! :repeat: expected one of :abort" in done.out
    assert done.out.endswith("aborted; the measurements stay in the journal\n")
    assert [one.name for one in tmp_path.iterdir()] == ["plane.journal"]


def test_calibrate_without_a_camera_keeps_the_step(tmp_path: Path) -> None:
    with closed_port() as address:
        lines = [*as_lines(ABOUT, {}), '{"do": "abort"}']
        done = calibrating(f"bvs://{address}", tmp_path, lines, "--json")
    assert done.code == 130
    assert [line.get("step") for line in done.lines[:3]] == ["about", "picture", "picture"]
    assert "Connection refused" in done.lines[2]["errors"]["base"]


@pytest.mark.parametrize(
    ("lines", "options", "text"),
    [
        ([], ("--name", "../out"), "the name '../out' cannot be used"),
        (["hello"], ("--json",), "a line of input: expected"),
        (["[1]"], ("--json",), "a line of input: expected"),
        (['{"do": "dance"}'], ("--json",), "do: expected one of undo, repeat, abort"),
        (['{"token": "old"}'], ("--json",), "the step has changed meanwhile"),
    ],
)
def test_calibrate_with_wrong_usage_says_what_is_wrong(
    tmp_path: Path, lines: list[str], options: tuple[str, ...], text: str
) -> None:
    calibrating("bvs://127.0.0.1:9", tmp_path, lines, *options).failed(2, text)


def test_calibrate_with_results_that_are_no_localizations_fails(url: str, tmp_path: Path) -> None:
    lines = [*as_lines(ABOUT, {}), '{"do": "abort"}']
    done = calibrating(url, tmp_path, lines, "--json", "--interpret-as", "raw")
    assert done.lines[2]["errors"] == {
        "base": "--interpret-as raw: expected localizations, got bytes"
    }


def test_calibrate_with_a_page_serves_it_until_it_is_ended(url: str, tmp_path: Path) -> None:
    with process(url, tmp_path, "--web") as serving:
        page = serving.read_until(b"\n").removeprefix("page: ").strip()
        with urllib.request.urlopen(f"{page}api/step", timeout=PATIENCE) as answer:  # noqa: S310
            step = json.loads(answer.read())
        serving.send_signal(signal.SIGINT)
        assert serving.wait().code == 0
    assert (step["step"], step["wizard"]) == ("about", "plane")


def test_calibrate_with_an_option_of_the_page_alone_is_wrong_usage(tmp_path: Path) -> None:
    done = calibrating("bvs://127.0.0.1:9", tmp_path, [], "--web-port", "0")
    assert done.code == 2
    assert "--web-port needs --web" in done.err


def test_calibrate_with_an_address_that_cannot_work_leaves_nothing(tmp_path: Path) -> None:
    calibrating("http://camera", tmp_path, []).failed(2, "http")
    assert not list(tmp_path.rglob("*.journal"))
