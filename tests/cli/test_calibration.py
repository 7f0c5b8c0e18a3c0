"""``--calibration FILE``: results in the robot's frame."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from smartcam.calibration import PlaneCalibration, fit_plane
from smartcam.emulator._inside import PIECES
from tests.cli.commandline import emulators, run

MARKS = np.array([[0.0, 0.0], [0.3, 0.0], [0.0, 0.2], [0.3, 0.2], [0.1, 0.1]])
SHIFT = np.array([0.5, -0.1, 0.2])


def calibrated(**options: Any) -> PlaneCalibration:
    """Return the calibration of a table that stands upright: its y is the robot's z."""
    upright = np.stack([MARKS[:, 0], 0 * MARKS[:, 0], MARKS[:, 1]], axis=-1)
    return fit_plane(MARKS, upright + SHIFT, model="rigid", tool_z=(0, 1, 0), **options)


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with emulators(tmp_path_factory.mktemp("calibration"), ()) as (found,):
        yield found


@pytest.fixture
def seven(url: str) -> list[str]:
    return ["trigger", url, "--application", "7", "--interpret-as", "localizations"]


@pytest.fixture
def table(tmp_path: Path) -> str:
    path = tmp_path / "table.json"
    calibrated().save(path)
    return str(path)


def test_trigger_calibration_puts_the_pieces_into_the_robots_frame(
    seven: list[str], table: str
) -> None:
    (result,) = run(*seven, "--calibration", table, "--json").done().lines
    assert len(result["value"]) == len(PIECES)
    for part in result["value"]:
        true, pose = PIECES[part["feature_id"]], part["pose"]
        assert pose["header"]["frame_id"] == "robot"
        expected = np.array([true.x, 0.0, true.y]) + SHIFT
        assert math.dist(pose["position"].values(), expected) < 1e-3


def test_trigger_calibration_shows_people_poses_in_space(seven: list[str], table: str) -> None:
    head, titles, *rows = run(*seven, "--calibration", table).done().out.splitlines()
    assert head.startswith("result 1 of application 7")
    assert " ".join(titles.split()) == "feature_id quality x [m] y [m] z [m] qx qy qz qw"
    assert [row.split()[0] for row in rows] == list(PIECES)
    assert {row.split()[3] for row in rows} == {"-0.1"}


@pytest.mark.parametrize("wrong", [False, True])
def test_trigger_calibration_that_is_not_good_warns(
    seven: list[str], tmp_path: Path, wrong: bool
) -> None:
    path = tmp_path / "table.json"
    marks = np.array([(0.15 * i, 0.1 * j) for i in range(3) for j in range(3)])
    touched = np.column_stack([marks, np.zeros(9)])
    if wrong:
        touched[[2, 4]] = touched[[4, 2]]
    fit_plane(marks, touched, tool_z=(0, 0, -1)).save(path)
    for _ in range(2):
        outcome = run(*seven, "--calibration", str(path))
        told = f"warning: --calibration {path}: this calibration is not known to be good. Not good"
        assert outcome.err.startswith(told) == wrong
        assert (outcome.code, outcome.err == "") == (0, not wrong)


def test_watch_calibration_maps_each_result(url: str, table: str) -> None:
    spec = "localizations: (x: int16 px, y: int16 px)*"
    told = ("watch", url, "--application", "5", "--interpret-as", spec, "--count", "3", "--json")
    plain, mapped = run(*told).done().lines, run(*told, "--calibration", table).done().lines
    for result in [*plain, *mapped]:
        number = int.from_bytes(bytes.fromhex(result["raw"]), "little")
        (part,) = result["value"]
        moved = SHIFT if result in mapped else np.zeros(3)
        expected = [number + moved[0], *moved[1:]]
        assert list(part["pose"]["position"].values()) == pytest.approx(expected)


def test_trigger_calibration_with_a_frame_wants_the_camera_named_so(
    seven: list[str], tmp_path: Path
) -> None:
    path = tmp_path / "cell.json"
    calibrated(camera_frame="cell").save(path)
    outcome = run(*seven, "--calibration", str(path))
    outcome.failed(6, "calibration: expected poses in the frame 'cell', got one in '127.0.0.1:")
    (result,) = run(*seven, "--calibration", str(path), "--name", "cell", "--json").done().lines
    assert result["camera"] == "cell"
    assert result["value"][0]["pose"]["header"]["frame_id"] == "robot"


@pytest.mark.parametrize(
    ("y_down", "options", "text"),
    [
        (True, (), "made with --y-down: give it here, too, or poses are mirrored"),
        (False, ("--y-down",), "made without --y-down: omit it here, too"),
    ],
)
def test_trigger_calibration_with_another_y_down_says_what_to_give(
    seven: list[str], tmp_path: Path, y_down: bool, options: tuple[str, ...], text: str
) -> None:
    path = tmp_path / "table.json"
    calibrated(y_down=y_down).save(path)
    told = [*seven, "--calibration", str(path)]
    run(*told, *options).failed(2, f"--calibration {path}: the calibration was {text}")
    (result,) = run(*told, *(() if options else ("--y-down",)), "--json").done().lines
    assert len(result["value"]) == len(PIECES)


def test_trigger_calibration_without_interpret_as_says_what_to_give(url: str, table: str) -> None:
    outcome = run("trigger", url, "--calibration", table)
    outcome.failed(2, "as with interpret_as='localizations', got the interpreter 'raw'")


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (None, "No such file or directory"),
        ("{", "no JSON"),
        ('{"schema": "other"}', "schema 'other', expected 'smartcam.calibration'"),
    ],
)
def test_trigger_calibration_that_cannot_be_read_is_wrong_usage(
    seven: list[str], tmp_path: Path, content: str | None, text: str
) -> None:
    path = tmp_path / "bad.json"
    if content is not None:
        path.write_text(content, encoding="utf-8")
    run(*seven, "--calibration", str(path)).failed(2, str(path), text)


def test_trigger_calibration_changed_by_hand_is_refused(seven: list[str], table: str) -> None:
    path = Path(table)
    content = json.loads(path.read_text(encoding="utf-8"))
    content["data"]["robot_frame"] = "other"
    path.write_text(json.dumps(content), encoding="utf-8")
    run(*seven, "--calibration", table).failed(2, "it was damaged, or changed by hand")


def test_trigger_without_calibration_does_not_import_it() -> None:
    code = (
        "import sys, smartcam._cli.camera, smartcam._client.interpretation; "
        "print([name for name in sys.modules if name.startswith('smartcam.calibration')])"
    )
    done = subprocess.run(  # noqa: S603 - our own interpreter
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.strip() == "[]"
