"""The wizard of the sheet: both ways, refusals, saved files, and resumed sessions."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from smartcam.calibration import Checkerboard, SheetCalibration
from smartcam.calibration.simulation import render
from tests.calibration import sheetkit
from tests.calibration.inside import read_document
from tests.calibration.sheetkit import (
    CAMERA,
    LIES,
    SEEN,
    TARGET,
    Cell,
    begin,
    field,
    next_answer,
    truth,
)
from tests.calibration.wizards.bench import say


async def go_to(session: Any, cell: Cell, step: str) -> dict[str, Any]:
    """Answer up to a step."""
    view: dict[str, Any] = session.current
    while view["step"] != step:
        view = await say(session, await next_answer(view, cell))
    return view


async def test_corners_touched_give_a_calibration_as_good_as_predicted(tmp_path: Path) -> None:
    cell = Cell()
    session = begin(tmp_path, cell)
    view = await go_to(session, cell, "review")
    assert view["notes"][0] == "model rigid from 4 points"
    assert any("from pixel to robot" in note for note in view["notes"])
    for _ in range(5):
        view = await say(session, {"next": "more"})
        view = await say(session, cell.corner(view))
    assert len(view["preview"]["points"]) == 9
    await say(session, {"next": "accept"})
    view = await say(session)
    assert (view["type"], view["result"]["seen"], view["result"]["points"]) == ("result", 54, 9)
    found = SheetCalibration.load(tmp_path / "table.json")
    errors = np.linalg.norm(found.transform(field()) - truth(field()), axis=1)
    predicted = found.predicted_error(field())
    assert 0.3 < np.sqrt((errors**2).mean() / (predicted**2).mean()) < 2.0
    assert predicted.max() < 0.5e-3
    context = read_document(tmp_path / "table.json").context
    assert [one["touched"] for one in context["samples"][:3]] == [
        "point 1 of row 1",
        "point 9 of row 6",
        "point 9 of row 1",
    ]
    assert context["camera_unit"] == "px"


async def test_picture_is_shown_with_the_point_to_touch(tmp_path: Path) -> None:
    cell = Cell()
    session = begin(tmp_path, cell)
    view = await go_to(session, cell, "touch-2")
    svg = view["preview"]["svg"]
    assert svg.startswith("<svg ")
    assert svg.count('class="point') == 54
    assert svg.count('class="suggested"') == 1
    assert ">A</text>" in svg
    assert ">B</text>" in svg
    assert view["notes"][0] == "54 of 54 points of the target seen"
    assert "differs from the other corners by" in view["notes"][1]
    assert "point 9 of row 6, which has a ring" in view["description"]
    choices = view["preview"]["choices"]
    assert [one["answers"] for one in choices[8:10]] == [
        {"column": 9, "row": 1}, {"column": 1, "row": 2},
    ]  # fmt: skip
    circles = re.findall(r'<circle cx="([\d.]+)" cy="([\d.]+)" r="5"', svg)
    assert np.allclose([one["at"] for one in choices], np.array(circles, dtype=float), atol=0.06)
    session.close()


async def test_rays_touched_give_a_calibration(tmp_path: Path) -> None:
    cell = Cell(sigma=0.0)
    session = begin(tmp_path, cell, method="rays")
    view = await go_to(session, cell, "touch-O")
    for place in ((0.0, 0.0), (0.19, 0.0), (0.0, 0.14)):
        view = await say(session, cell.touch(*place))
    assert "Three touches fit any plane" in view["description"]
    assert any(note.startswith("NOT_HELD_OUT") for note in view["notes"])
    await say(session)
    await say(session)
    found = SheetCalibration.load(tmp_path / "table.json")
    assert found.model == "touches"
    assert np.linalg.norm(found.transform(field()) - truth(field()), axis=1).max() < 2e-4


async def test_corner_of_the_user_s_choice_counts_at_its_place(tmp_path: Path) -> None:
    cell = Cell(sigma=0.0)
    session = begin(tmp_path, cell)
    await go_to(session, cell, "touch-1")
    for column, row in ((2, 1), (8, 2), (5, 6), (1, 4)):
        x, y = TARGET.points[(row - 1) * 9 + column - 1, :2].tolist()
        view = await say(session, {"column": column, "row": row, **cell.touch(x, y)})
    assert view["step"] == "review"
    assert view["preview"]["points"][1]["feature"] == "point 8 of row 2"
    assert view["preview"]["points"][1]["camera"] == pytest.approx([0.175, 0.025])
    assert (view["verdict"]["level"], view["defaults"]["next"]) == ("unknown", "more")
    session.close()


async def test_wrong_touch_is_touched_again_or_removed(tmp_path: Path) -> None:
    cell = Cell()
    session = begin(tmp_path, cell)
    view = await go_to(session, cell, "touch-4")
    answer = cell.corner(view)
    view = await say(session, {**answer, "x": answer["x"] + 8.0})
    assert any(note.startswith(("OUTLIER", "POOR_FIT")) for note in view["notes"]), view["notes"]
    view = await say(session, {"next": "redo", "point": 4})
    assert view["title"] == "Touch point 4 again"
    view = await say(session, cell.corner(view))
    assert not any(note.startswith(("OUTLIER", "POOR_FIT")) for note in view["notes"])
    view = await say(session, {"next": "remove", "point": 2})
    assert (view["step"], len(view["preview"]["points"])) == ("review", 3)
    view = await say(session, {"next": "remove", "point": 2})
    assert view["title"] == "Touch point 3"
    session.close()


@pytest.mark.judged
async def test_smaller_print_is_reported_unless_the_rulers_are_smaller_too(tmp_path: Path) -> None:
    cell = Cell(scale=0.97, sigma=0.0)
    session = begin(tmp_path, cell)
    view = await go_to(session, cell, "review")
    assert any(note.startswith("SCALE_MISMATCH") for note in view["notes"])
    session.close()
    session = begin(tmp_path, cell)
    await say(session, sheetkit.ABOUT)
    await say(session)
    await say(session, {"ruler_x": 97.1, "ruler_y": 96.9})
    view = await go_to(session, cell, "review")
    assert not any(note.startswith("SCALE_MISMATCH") for note in view["notes"])
    session.close()


async def test_target_typed_is_the_one_in_the_picture(tmp_path: Path) -> None:
    cell = Cell()
    session = begin(tmp_path, cell, target=None)
    view = await say(session, sheetkit.ABOUT)
    assert view["defaults"]["kind"] == "checkerboard"
    view = await say(session)
    assert list(view["schema"]["properties"]) == ["columns", "rows", "square", "origin_mark"]
    await say(session, {"columns": 9, "rows": 6, "square": 25.0})
    await say(session)
    view = await say(session)
    assert view["notes"][0] == "54 of 54 points of the target seen"
    session.close()


async def test_target_of_dots_typed_in_mm_is_kept_in_metres(tmp_path: Path) -> None:
    session = begin(tmp_path, Cell(), target=None)
    await say(session)
    await say(session, {"kind": "circles"})
    view = await say(
        session, {"columns": 10, "rows": 8, "spacing": 15, "diameter": 8, "origin_diameter": 12}
    )
    assert view["step"] == "rulers"
    view = await say(session)
    assert view["step"] == "picture"
    view = await session.submit(session.token)
    assert "dots" in view["errors"]["base"]
    session.close()


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("", {"description": "expected the description of a target"}),
        ("[1]", {"description": "expected the description of a target"}),
        ('{"kind": "moon"}', {"base": "expected a kind of ['charuco', 'checkerboard', 'circles'"}),
        ('{"kind": "checkerboard", "columns": 9}', {"base": "missing 2 required"}),
    ],
)
async def test_invalid_description_keeps_the_step(
    tmp_path: Path, text: str, wrong: dict[str, str]
) -> None:
    session = begin(tmp_path, Cell())
    await say(session)
    view = await session.submit(session.token, {"kind": "described", "description": text})
    assert view["step"] == "sheet"
    assert view["errors"].keys() == wrong.keys()
    assert all(part in view["errors"][name] for name, part in wrong.items())
    session.close()


async def test_rulers_that_no_printer_makes_keep_the_step(tmp_path: Path) -> None:
    session = begin(tmp_path, Cell())
    await say(session)
    await say(session)
    view = await session.submit(session.token, {"ruler_x": 99.0, "ruler_y": 100.0})
    assert view["step"] == "rulers"
    assert "expected the same length along x and y within 0.5%" in view["errors"]["base"]
    session.close()


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize(
    ("picture", "text"),
    [
        (np.full((600, 800), 128, dtype=np.uint8), "checkerboard"),
        (np.zeros((600, 800)), "expected an array of uint8 or uint16"),
        (None, "expected an array of uint8 or uint16"),
    ],
)
async def test_picture_without_the_sheet_keeps_the_step(
    tmp_path: Path, picture: Any, text: str
) -> None:
    cell = Cell()
    cell.pictures = [picture]
    session = begin(tmp_path, cell)
    await go_to(session, cell, "picture")
    view = await session.submit(session.token)
    assert view["step"] == "picture"
    assert text in view["errors"]["base"]
    view = await say(session)
    assert (view["step"], cell.taken) == ("touch-1", 2)
    session.close()


@pytest.mark.judged
async def test_unmarked_origin_is_reported(tmp_path: Path) -> None:
    cell = Cell()
    plain = Checkerboard(columns=9, rows=6, square=0.025)
    cell.pictures = [render(plain, CAMERA, sheetkit.SEEN)]
    session = begin(tmp_path, cell)
    await go_to(session, cell, "picture")
    view = await session.submit(session.token)
    assert view["step"] == "picture"
    assert "grey levels" in view["errors"]["base"]
    session.close()


async def test_picture_of_another_size_than_the_lens_keeps_the_step(tmp_path: Path) -> None:
    cell = Cell()
    session = begin(tmp_path, cell)
    await go_to(session, cell, "picture")
    cell.pictures = [(await cell.take_picture())[:500]]
    view = await session.submit(session.token)
    assert "expected an image of 800 x 600 pixels, got 800 x 500" in view["errors"]["base"]
    session.close()


async def test_tool_on_the_wrong_side_is_reported(tmp_path: Path) -> None:
    cell = Cell()
    side = "-z" if LIES.rotation[2, 2] < 0 else "+z"
    session = begin(tmp_path, cell, side=side)
    view = await go_to(session, cell, "review")
    assert view["notes"][0].startswith("MIRRORED: ")
    assert "accept" not in json.dumps(view["schema"]["properties"]["next"])
    session.close()


async def test_wizard_resumed_at_each_step_gives_the_same_without_a_picture(tmp_path: Path) -> None:
    cell = Cell(sigma=0.0)
    journal = tmp_path / "table.journal"
    session = begin(tmp_path, cell, journal=journal)
    while session.state == "asking":
        view = session.current
        await say(session, await next_answer(view, cell))
        expected = session.current
        session.close()
        later = view["number"] > 3  # the lens of the picture counts, whatever is given then
        session = begin(tmp_path, cell, journal=journal, camera=None if later else CAMERA)
        assert session.current == expected
    assert cell.taken == 1
    assert SheetCalibration.load(tmp_path / "table.json").camera is not None
    session.close()


async def test_picture_repeated_takes_the_place_of_the_other(tmp_path: Path) -> None:
    cell = Cell()
    session = begin(tmp_path, cell)
    view = await go_to(session, cell, "touch-1")
    assert "repeat" in view["can"]
    view = await session.repeat(session.token)
    assert (view["step"], view["errors"], cell.taken) == ("touch-1", {}, 2)
    session.close()


def start(folder: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(  # noqa: S603 - our own interpreter
        [sys.executable, "-m", sheetkit.__name__, str(folder)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def says(process: subprocess.Popen[str]) -> dict[str, Any]:
    assert process.stdout is not None
    said: dict[str, Any] = json.loads(process.stdout.readline())
    return said


def go_on(process: subprocess.Popen[str]) -> None:
    assert process.stdin is not None
    process.stdin.write("\n")
    process.stdin.flush()


@pytest.mark.long
def test_process_killed_after_picture_and_touches_loses_nothing(tmp_path: Path) -> None:
    reached, taken = 1, 0
    for steps in (4, 2, 3):
        with start(tmp_path) as process:
            said = says(process)
            assert (said["number"], said["taken"]) == (reached, 0)
            for _ in range(steps):
                go_on(process)
                said = says(process)
            reached, taken = said["number"], taken + said["taken"]
            process.kill()
    with start(tmp_path) as process:
        assert says(process)["number"] == 10
        go_on(process)
        assert says(process)["type"] == "result"
        process.kill()
    assert taken == 1
    found = SheetCalibration.load(tmp_path / "table.json")
    assert np.linalg.norm(found.transform(field()) - truth(field()), axis=1).max() < 2e-4


@pytest.mark.long
def test_process_killed_during_a_picture_does_the_step_or_leaves_it(
    tmp_path: Path,
) -> None:
    with start(tmp_path) as process:
        for _ in range(3):
            says(process)
            go_on(process)
        assert says(process)["number"] == 4
        go_on(process)
        process.kill()
    with start(tmp_path) as process:
        assert says(process)["number"] in {4, 5}
        process.kill()


async def test_one_of_five_touches_that_is_off_is_named_and_not_the_print(tmp_path: Path) -> None:
    cell = Cell(sigma=0.0)
    session = begin(tmp_path, cell, side="-z")
    view = await go_to(session, cell, "touch-2")
    off = cell.corner(view)
    view = await say(session, {**off, "x": off["x"] + 5})
    for _ in range(2):
        view = await say(session, cell.corner(view))
    await say(session, {"next": "more"})
    view = await say(session, cell.corner(session.current))
    assert view["verdict"]["text"] == "Not good enough: touch point 2 again"
    assert (view["defaults"]["next"], view["defaults"]["point"]) == ("redo", 2)


async def test_direction_of_the_pictures_right_side_is_shown(tmp_path: Path) -> None:
    cell = Cell(sigma=0.0)
    session = begin(tmp_path, cell, side="-z")
    view = await go_to(session, cell, "review")
    right = (LIES.rotation @ SEEN.rotation.T)[:, 0]
    (note,) = [one for one in view["notes"] if "to the right in the picture" in one]
    told = [float(one) for one in re.findall(r"-?\d\.\d\d", note)]
    assert np.allclose(told, right, atol=0.18)  # the sheet is tilted in front of the camera
