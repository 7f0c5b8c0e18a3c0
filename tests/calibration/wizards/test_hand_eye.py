"""The wizard of a camera on a robot, with a rendered sheet and a robot that knows its poses."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from smartcam.calibration import CameraModel, Folder, HandEyeCalibration, Transform
from smartcam.calibration._inside import ROBOTS, list_calibrations
from smartcam.calibration.formats import pose_to
from smartcam.calibration.simulation import render
from smartcam.calibration.wizards import WizardSession, hand_eye_wizard
from smartcam.calibration.wizards._hand_eye import SUGGESTIONS
from tests.calibration.inside import Journal
from tests.calibration.scenes import SHEET, scene
from tests.calibration.wizards.bench import say
from tests.processes import printed_by

CAMERA = CameraModel(size=(480, 360), matrix=np.array([[450.0, 0, 240], [0, 447, 176], [0, 0, 1]]))
TRUTH = scene("eye-in-hand", poses=8, seed=7)


@functools.cache
def picture(number: int) -> Any:
    """Return what the camera sees at a pose of the robot."""
    return render(SHEET, CAMERA, TRUTH.target_in_camera(TRUTH.robot_poses[number]), blur=0.7)


class Cell:
    """A robot with a camera; each picture is taken at the next pose."""

    def __init__(self) -> None:
        self.left = list(range(len(TRUTH.robot_poses)))
        self.hidden = 0

    async def take_picture(self) -> Any:
        if self.hidden:
            self.hidden -= 1
            return np.full(CAMERA.size[::-1], 128, dtype=np.uint8)
        return picture(self.left[0])

    async def read_robot(self) -> Transform:
        return self.pose if self.hidden else TRUTH.robot_poses[self.left.pop(0)]

    @property
    def pose(self) -> Transform:
        return TRUTH.robot_poses[self.left[0]]


def begin(
    folder: Path,
    cell: Cell,
    journal: Path | None = None,
    camera: CameraModel | None = CAMERA,
) -> WizardSession:
    wizard = hand_eye_wizard(
        target=SHEET,
        take_picture=cell.take_picture,
        read_robot=cell.read_robot,
        save_to=lambda name: folder / f"{name}.json",
        camera=camera,
    )
    opened = None if journal is None else Journal(journal)
    return WizardSession(wizard, opened, parameters={"name": "gripper"})


async def test_views_taken_give_a_calibration_in_a_file(tmp_path: Path) -> None:
    session = begin(tmp_path, Cell())
    view = await say(session, {"setup": "eye-in-hand"})
    for number in range(8):
        assert view["step"] == f"view-{number + 1}"
        assert SUGGESTIONS[number] in view["description"]
        assert view["notes"][0].startswith(f"{number} of 10 views, 40 at most; ")
        end = "to end, choose to calculate" if number > 2 else "to end before, abort"
        assert view["notes"][0].endswith(end)
        view = await say(session)
    view = await say(session, {"next": "calculate"})
    assert view["step"] == "calculate"
    view = await say(session)
    assert (view["step"], view["defaults"]["next"]) == ("review", "accept")
    assert (view["verdict"]["level"], view["verdict"]["text"][:9]) == ("good", "Good for ")
    assert any("mm rms on the sheet, at views that were left out" in one for one in view["notes"])
    assert "view 8: held out" in view["preview"]["svg"]
    view = await say(session)
    assert view["step"] == "save"
    view = await say(session)
    assert view["type"] == "result", view
    assert view["preview"]["svg"].startswith("<svg ")
    assert view["preview"]["svg"].count('class="board"') == 1
    assert view["result"]["good_for_mm"] >= 2 * view["result"]["held_out_mm"]
    found = HandEyeCalibration.load(tmp_path / "gripper.json")
    assert TRUTH.errors(found.camera_pose)[1] < 2e-4
    assert len(found.views) == 8
    (row,) = list_calibrations(Folder(tmp_path))
    assert (row["kind"], row["held_out_mm"]) == ("hand-eye", view["result"]["held_out_mm"])
    printed = printed_by(view["result"]["use"]["python"])
    assert printed.startswith("Transform(")


async def test_lens_that_is_not_known_says_which_view_helps_most(tmp_path: Path) -> None:
    session = begin(tmp_path, Cell(), camera=None)
    await say(session, {"setup": "eye-in-hand"})
    for _ in range(3):
        view = await say(session)
    assert SUGGESTIONS[3] not in view["description"]
    assert ": with the sheet " in view["description"]
    assert view["notes"][1].startswith("the lens is known to within ")
    assert "orange: the next one" in view["preview"]["svg"]


async def test_view_without_a_sheet_is_taken_again(tmp_path: Path) -> None:
    cell = Cell()
    session = begin(tmp_path, cell)
    await say(session)
    cell.hidden = 1
    view = await session.submit(session.token, None)
    assert "base" in view["errors"]
    assert view["step"] == "view-1"
    cell.hidden = 0
    assert (await say(session))["step"] == "view-2"


@pytest.mark.judged
async def test_view_removed_is_calculated_without(tmp_path: Path) -> None:
    session = begin(tmp_path, Cell())
    await say(session)
    for _ in range(5):
        await say(session)
    await say(session, {"next": "calculate"})
    await say(session)
    view = await say(session, {"next": "remove", "view": 2})
    assert (view["step"], view["notes"]) == ("calculate", ["4 views"])
    view = await say(session)
    assert view["notes"][0].startswith("4 views, ")
    view = await say(session, {"next": "more"})
    assert view["step"] == "view-5"


async def test_views_that_give_nothing_say_why(tmp_path: Path) -> None:
    cell = Cell()
    cell.left = [0] * 3
    session = begin(tmp_path, cell)
    for _ in range(4):
        await say(session)
    await say(session, {"next": "calculate"})
    view = await say(session)
    assert view["notes"][0].startswith("POSES_TOO_SIMILAR: hand-eye: expected at least 3")
    assert view["defaults"]["next"] == "more"


async def test_views_are_there_again_after_a_crash(tmp_path: Path) -> None:
    cell = Cell()
    session = begin(tmp_path, cell, tmp_path / "journal")
    for _ in range(4):
        view = await say(session)
    left = len(cell.left)
    session.close()
    again = begin(tmp_path, cell, tmp_path / "journal")
    assert again.current["step"] == view["step"] == "view-4"
    assert len(cell.left) == left
    again.close()


@pytest.mark.judged
async def test_poses_typed_as_the_robot_writes_them_are_the_same(tmp_path: Path) -> None:
    cell = Cell()
    wizard = hand_eye_wizard(
        suggested=SHEET,
        take_picture=cell.take_picture,
        save_to=lambda name: tmp_path / f"{name}.json",
        camera=CAMERA,
    )
    session = WizardSession(wizard, parameters={"name": "gripper", "robot": "kuka"})
    for step in ("about", "sheet", "rulers"):
        assert session.current["step"] == step
        await say(session)
    for number in range(6):
        view = session.current
        assert ("svg" in (view["preview"] or {})) == (number > 0)
        await say(session, typed(cell.pose))
        cell.left.pop(0)
    view = await session.submit(session.token, {"next": "view", "x": 1.0})
    assert view["errors"]["a"] == "no answer"
    await say(session, {"next": "calculate"})
    view = await say(session)
    assert view["verdict"]["text"] == "Not known how good: take more views"
    assert view["defaults"]["next"] == "more"
    await say(session, {"next": "accept"})
    await say(session)
    found = HandEyeCalibration.load(tmp_path / "gripper.json")
    assert TRUTH.errors(found.camera_pose)[1] < 2e-4
    assert found.robot_poses[0].source == "flange"


async def test_pose_typed_that_is_none_costs_no_picture(tmp_path: Path) -> None:
    cell = Cell()
    wizard = hand_eye_wizard(
        target=SHEET, take_picture=cell.take_picture, save_to=lambda name: tmp_path / name
    )
    session = WizardSession(wizard, parameters={"robot": "xyzw"})
    await say(session)
    pose = dict.fromkeys(("x", "y", "z", "qx", "qy", "qz"), 0.1)
    cell.hidden = 1
    view = await session.submit(session.token, {**pose, "qw": 0.2})
    assert "a quaternion of length 1" in view["errors"]["base"]
    assert cell.hidden == 1
    session.close()


def typed(pose: Transform) -> dict[str, float]:
    return dict(zip(ROBOTS["kuka"].numbers, pose_to("kuka", pose), strict=True))


@pytest.mark.judged
async def test_touches_of_the_sheet_verify_a_calibration_or_refute_it(tmp_path: Path) -> None:
    session = begin(tmp_path, Cell())
    view = await say(session, {"setup": "eye-in-hand", "allowed": 4.0})
    for _ in range(8):
        view = await say(session)
    await say(session, {"next": "calculate"})
    view = await say(session)
    assert view["verdict"]["text"].endswith("4 mm are allowed")
    corners = TRUTH.target_pose.apply(SHEET.points[[0, -1, SHEET.columns - 1]])
    for off, level, chosen in ((0.0, "good", "accept"), (0.008, "poor", "more")):
        view = await say(session, {"next": "verify"})
        for number, corner in enumerate(corners):
            assert view["title"] == f"Touch {number + 1} of 3"
            place = 1e3 * (corner + np.array([off, 0.0, 0.0]))
            view = await say(session, dict(zip("xyz", place.tolist(), strict=True)))
        assert (view["step"], view["verdict"]["level"]) == ("review", level)
        assert view["defaults"]["next"] == chosen
        assert "the tip touched the sheet " in view["notes"][-1]
    await say(session, {"next": "accept"})
    await say(session)
    found = HandEyeCalibration.load(tmp_path / "gripper.json")
    assert found.verdict.text.startswith("Not good enough: touches of the sheet are off")
