"""``smartcam demo --pick``: parts picked by a robot that knew nothing of the table.

With ``--plain`` they are located in drawn pictures, and put onto a pallet.
"""

from __future__ import annotations

import importlib.util
import json
import math
import sys
import xml.etree.ElementTree as ET
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from numpy.typing import NDArray

from smartcam._cli import demo_pick
from smartcam._cli.demo_pallet import Grid, palletize
from smartcam._cli.demo_pick import SimulatedRobot, nine_marks, pick
from smartcam._cli.demo_table import DrawnTable, TablePart, TableRobot, radius_of
from smartcam.emulator import TablePose, TableScene
from smartcam.emulator._inside import PIECES, TABLE_SIZE
from smartcam.exceptions import ConfigurationError, MissingExtraError
from smartcam.geometry import PlacePattern
from smartcam.inspection import PartModel, load_cell
from smartcam.models import Header, Localization, Pose, Position, Quaternion
from tests.cli.commandline import run
from tests.cli.inside import Options

NEEDS_INSPECTION = pytest.mark.skipif(
    importlib.util.find_spec("cv2") is None, reason="needs the extra inspection"
)

NOON = datetime(2026, 3, 4, 12, tzinfo=UTC)


async def picked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], seed: int = 1
) -> list[dict[str, Any]]:
    """Run the demo with JSON and return its lines."""
    await pick(Options(as_json=True), str(tmp_path / "pick.svg"), seed)
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


async def test_pick_takes_all_seven_and_says_how_well(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = await picked(tmp_path, capsys)
    assert [line["step"] for line in lines if "step" in line] == [1, 2, 3, 4, 5, 6]
    (picks,) = (line["picks"] for line in lines if "picks" in line)
    assert {one["part"] for one in picks} == set(PIECES)
    assert all(one["taken"] and one["error"] < 3 * one["predicted"] < 1e-3 for one in picks)
    assert max(abs(one["heading_error"]) for one in picks) < math.radians(0.6)
    (left,) = (line["left"] for line in lines if "left" in line)
    assert left == 0


async def test_pick_prediction_holds_over_many_tables(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    errors, predicted = 0.0, 0.0
    for seed in range(10):
        (one,) = (x for x in await picked(tmp_path, capsys, seed) if "predicted" in x)
        assert one["picked"] == 7
        errors, predicted = errors + one["error"] ** 2, predicted + one["predicted"] ** 2
    assert 0.8 < math.sqrt(errors / predicted) < 1.25


async def test_pick_tells_its_story_and_writes_a_picture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "pick.svg"
    await pick(Options(), str(path), 1)
    out = capsys.readouterr().out
    for text in ("9 marks", "Calibrated (similarity)", "7 of 7 picked", "0 parts", str(path)):
        assert text in out
    texts = {node.text for node in ET.parse(path).getroot().iter() if node.tag.endswith("text")}  # noqa: S314
    assert {"1", "9", "parallelogram", "robot x", "camera x"} <= texts


class _Bumpy(SimulatedRobot):
    """The mark in the middle lies 2 mm above the table."""

    def touch(self, mark: TablePose) -> NDArray[Any]:
        middle = mark == nine_marks()["mark_5"]
        return super().touch(mark) - 0.002 * middle * self.tool_z


async def test_pick_warns_of_marks_that_lie_in_no_plane(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(demo_pick, "SimulatedRobot", _Bumpy)
    await pick(Options(), str(tmp_path / "pick.svg"), 1)
    out = capsys.readouterr().out
    assert "   NOT_PLANAR: " in out
    assert "point 5 is the furthest" in out


async def test_pick_with_a_picture_that_cannot_be_written_reports_it(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"--picture .*: No such file"):
        await pick(Options(as_json=True), str(tmp_path / "no" / "pick.svg"), 1)


async def test_pick_without_the_extra_names_it_before_anything_else(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "scipy", None)
    with pytest.raises(MissingExtraError, match=r"SciPy: pip install .smartcam\[calibration\]"):
        await pick(Options(), str(tmp_path / "pick.svg"), 1)
    assert capsys.readouterr().out == ""


def test_marks_lie_over_the_whole_table() -> None:
    marks = nine_marks()
    assert len({(mark.x, mark.y) for mark in marks.values()}) == 9
    assert marks["mark_1"] == TablePose(0.025, 0.025, 0.0)
    assert marks["mark_9"] == pytest.approx((TABLE_SIZE[0] - 0.025, TABLE_SIZE[1] - 0.025, 0))


def test_robot_that_goes_beside_a_part_misses_it() -> None:
    scene = TableScene()
    robot = SimulatedRobot(scene, seed=1)
    square = scene.pieces["square"]
    beside = robot.table.apply([square.x + 0.0021, square.y, 0.0]).tolist()
    header = Header(1, NOON, "robot")
    pose = Pose(header, Position(*beside), Quaternion())
    found = robot.pick(Localization("square", 1.0, 0, pose), 1e-4)
    assert not found.taken
    assert found.error == pytest.approx(0.0021)
    assert "square" in scene.pieces


def test_demo_with_pick_is_a_command(tmp_path: Path) -> None:
    picture = tmp_path / "seen.svg"
    out = run("demo", "--pick", "--picture", str(picture), "--seed", "4").done().out
    assert "7 of 7 picked" in out
    assert picture.read_text(encoding="utf-8").startswith("<svg ")


# ---------------------------------------------------------------------- a plain camera


@pytest.mark.long
@NEEDS_INSPECTION
async def test_every_part_is_put_onto_its_place_and_errors_are_as_predicted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "demo"
    await palletize(Options(as_json=True), folder, 1, Grid(3, 3, 1))
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    placed: list[dict[str, Any]] = [one for line in lines for one in line.get("placed", [])]
    assert len(placed) == 9
    assert all(one["taken"] and one["off_place"] < 2e-3 for one in placed)
    assert max(abs(one["heading_error"]) for one in placed) < math.radians(0.2)
    (account,) = (line for line in lines if "filled" in line)
    assert (account["filled"], account["places"]) == (9, 9)
    # all errors of a run have one calibration's in common: four parameters, so they vary a lot
    assert 0.2 < account["error"] / account["predicted"] < 2.0
    assert 5e-5 < account["predicted"] < 2e-4
    (empty,) = (line for line in lines if "left" in line)
    assert empty["left"] == 0
    assert empty["reason"].startswith("0 found, expected 1 or more")
    assert len(list((folder / "judged").glob("*-ok.png"))) == 2
    assert PartModel.read(folder / "bracket.model").symmetry.fold == 1
    assert load_cell(folder / "marks.yaml")["desk/camera"].calibration is None


@NEEDS_INSPECTION
def test_demo_with_plain_is_a_command(tmp_path: Path) -> None:
    folder = tmp_path / "demo"
    done = run(
        *("demo", "--pick", "--plain", "--pallet", "2x2x1", "--folder", str(folder), "--seed", "3")
    ).done()
    assert "4 of 4 places filled" in done.out
    cell = str(folder / "cell.yaml")
    again = run("inspect", cell, "desk/camera", "1", str(folder / "judged")).done()
    assert (again.out.count(": ok, "), again.out.count(": not ok, ")) == (1, 1)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--plain"], "--plain goes with --pick"),
        (["--pick", "--plain", "--pallet", "1x2x1"], "2x2x1 to 12x12x10, got '1x2x1'"),
        (["--pick", "--plain", "--pallet", "three"], "got 'three'"),
    ],
)
def test_options_that_cannot_work_are_reported(arguments: list[str], text: str) -> None:
    done = run("demo", *arguments)
    assert (done.code, text in done.err) == (2, True)


def test_table_has_no_room_for_too_many_parts() -> None:
    with pytest.raises(ConfigurationError, match="no room for 200 parts"):
        DrawnTable(1).lay_parts("bracket", 200)


def test_robot_that_goes_beside_a_part_leaves_it_on_the_table() -> None:
    table = DrawnTable(1)
    part = TablePart("bracket", TablePose(0.1, 0.1, 0.3))
    table.parts = [part]
    robot = TableRobot(table, 1)
    corners = [robot.touch_pallet(*end) for end in ((0, 0), (1, 0), (0, 1))]
    pattern = PlacePattern.from_touches(*corners, rows=2, columns=2)
    touches = [robot.touch_table(part.pose) for _ in range(30)]
    x, y = (sum(one[axis] for one in touches) / len(touches) for axis in (0, 1))
    missed = robot.palletize((x + 0.003, y, 0.0), TablePose(0, 0, 0), pattern, 0)
    assert not missed.taken
    assert missed.error == pytest.approx(0.003, abs=2e-4)
    assert table.parts == [part]
    taken = robot.palletize((x, y, 0.0), TablePose(0, 0, 0), pattern, 0)
    assert taken.taken
    assert taken.off_place < 1e-3
    assert table.parts == []


@NEEDS_INSPECTION
def test_picture_shows_each_part_where_it_lies() -> None:
    table = DrawnTable(2)
    table.lay_parts("mark", 4)
    picture = table.take_picture().astype(float)
    reach = round(radius_of("mark") / table.pixel) + 6
    for part in table.parts:
        u, v, _ = table.to_pixels(part.pose)
        left, top = round(u) - reach, round(v) - reach
        patch = picture[top : top + 2 * reach + 1, left : left + 2 * reach + 1] - 60
        rows, columns = (patch.sum(axis=1 - axis) for axis in (0, 1))
        at = range(2 * reach + 1)
        assert left + (columns @ at) / columns.sum() == pytest.approx(u, abs=0.05)
        assert top + (rows @ at) / rows.sum() == pytest.approx(v, abs=0.05)
