"""The thesis' sequence without tokens: allowed calls, interruptions and resumption."""

from __future__ import annotations

import asyncio
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from smartcam.calibration._inside import (
    CalibrationStart,
    PixelPoseRequest,
    StepRequest,
    ThesisCalibration,
)
from smartcam.exceptions import CalibrationError, TriggerError
from smartcam.geometry import Transform
from tests.calibration.wizards.bench import GRID, Bench, where
from tests.calibration.wizards.test_services import saved, served

SMARTCAMERA = "SMARTCAMERA"
FIXED = CalibrationStart(topic_image2=SMARTCAMERA, fixed_camera="True")


class Camera:
    """A camera of the bench, whose next picture may be late or fail."""

    name, y_down, unit = "line1/cam3", False, "m"

    def __init__(self) -> None:
        self.bench = Bench()
        self.error: Exception | None = None
        self.hold: asyncio.Event | None = None
        self.waiting = asyncio.Event()

    async def localize(self) -> Any:
        if self.hold is not None:
            self.waiting.set()
            await self.hold.wait()
        if self.error is not None:
            raise self.error
        return await self.bench.localize()

    async def take_picture(self) -> Any:
        return np.zeros((48, 64), np.uint8)


class Graph:
    """A stand-in for ROS: a tree of one frame, and no pictures."""

    def check_topic(self, topic: str) -> None:
        pass

    def listen(self) -> None:
        pass

    async def picture(self, topic: str) -> tuple[Any, float | None]:
        return np.zeros((48, 64), np.uint8), None

    async def lens(self, topic: str) -> None:
        return None

    async def pose(self, frame: str, base: str, utc: float | None) -> Transform:
        at = datetime(2026, 1, 1, tzinfo=UTC)
        return Transform(base, frame, np.eye(3), np.array([1.0, 2.0, 3.0]), at)

    async def root(self, frame: str) -> str:
        return "base_link"


class Client:
    """A front end of one camera's calibrations."""

    def __init__(self, folder: Path, **options: Any) -> None:
        self.camera = Camera()
        self.calibration = ThesisCalibration(folder, "line1/cam3", **options)

    async def step(self, *values: float, **more: Any) -> dict[str, Any]:
        asked = StepRequest(value_inputs=values, **more)
        return await self.calibration.perform(asked, self.camera)

    async def accept(self, answer: dict[str, Any], *texts: str) -> dict[str, Any]:
        """Answer a step by its fields."""
        inputs = {
            "text_inputs": texts or answer["default_needed_strings"],
            "option_inputs": [one.split()[0] for one in answer["default_needed_options"]],
        }
        answer = await self.step(*answer["default_needed_values"], **inputs)
        assert answer["error"] == ""
        return answer

    async def to_picture(self, start: CalibrationStart = FIXED) -> dict[str, Any]:
        """Start, and go on to the step that takes a picture."""
        await self.calibration.start(start)
        answer = await self.accept(await self.step(), "table")
        answer = await self.accept(answer)
        assert answer["button_text"] == "Take a picture"
        return answer


# ---------------------------------------------------------------------- who may call when


async def test_a_call_beside_another_one_is_refused_and_changes_nothing(tmp_path: Path) -> None:
    client = Client(tmp_path)
    await client.to_picture()
    client.camera.hold = asyncio.Event()
    first = asyncio.create_task(client.step())
    await client.camera.waiting.wait()
    for call in (client.step(), client.step(repeat_last_step=True)):
        with pytest.raises(CalibrationError, match="another call is under way") as caught:
            await call
        assert caught.value.code == "NOT_POSSIBLE"
    with pytest.raises(CalibrationError, match="a calibration is under way") as caught:
        await client.calibration.start(FIXED)
    assert caught.value.code == "IN_USE"
    client.camera.hold.set()
    assert (await first)["header_text"] == "Which ones will be touched?"
    client.calibration.close()


async def test_abort_cancels_a_picture_and_its_caller_gets_an_error(tmp_path: Path) -> None:
    client = Client(tmp_path)
    await client.to_picture()
    client.camera.hold = asyncio.Event()
    first = asyncio.create_task(client.step())
    await client.camera.waiting.wait()
    async with asyncio.timeout(5):
        answer = await client.step(abort=True)
        assert (answer["header_text"], answer["button_text"]) == ("Aborted", "")
        assert "another call has aborted" in (await first)["error"]
    with pytest.raises(CalibrationError, match="the last one was aborted") as caught:
        await client.step()
    assert caught.value.code == "NO_SEQUENCE"
    client.camera.hold = None
    await client.to_picture()  # can restart at once
    client.calibration.close()


async def test_abort_while_a_wizard_begins_leaves_its_journal_free(tmp_path: Path) -> None:
    class Slow(Graph):
        async def lens(self, topic: str) -> None:
            begun.set()
            await go_on.wait()

    begun, go_on = asyncio.Event(), asyncio.Event()
    client = Client(tmp_path)
    client.calibration.graph = Slow()
    await client.calibration.start(CalibrationStart("/i", fixed_camera="True"))
    await client.step()
    first = asyncio.create_task(client.step(text_inputs=["table"]))
    await begun.wait()
    await client.step(abort=True)
    go_on.set()
    assert "another call has aborted" in (await first)["error"]
    await client.to_picture()  # under the same name
    client.calibration.close()


async def test_a_caller_that_goes_away_leaves_the_step(tmp_path: Path) -> None:
    client = Client(tmp_path)
    await client.to_picture()
    client.camera.hold = asyncio.Event()
    gone = asyncio.create_task(client.step())
    await client.camera.waiting.wait()
    gone.cancel()
    with pytest.raises(asyncio.CancelledError):
        await gone
    client.camera.hold = None
    answer = await client.step(repeat_last_step=True)
    assert answer["header_text"] == "Camera, robot and tool"
    client.calibration.close()


async def test_error_of_a_camera_is_shown_and_keeps_the_step(tmp_path: Path) -> None:
    client = Client(tmp_path)
    await client.to_picture()
    client.camera.error = TriggerError("it is not running")
    answer = await client.step()
    assert answer["error"] == "it is not running"
    assert answer["button_text"] == "Take a picture"
    client.calibration.close()


# ---------------------------------------------------------------------- what is left


async def test_a_calibration_that_is_left_alone_is_given_up_and_goes_on_later(
    tmp_path: Path,
) -> None:
    client = Client(tmp_path, abandon_timeout=0.2)
    answer = await client.to_picture()
    answer = await client.accept(await client.accept(answer))
    answer = await client.step(1.0, 2.0, 3.0)
    assert answer["header_text"] == "Touch mark 2 of 9"
    await asyncio.sleep(0.1)
    assert (await client.step(1.0, 2.0))["error"]  # any call restarts the time limit
    await asyncio.sleep(0.15)
    assert (await client.step(1.0, 2.0))["error"]
    await asyncio.sleep(0.3)
    with pytest.raises(CalibrationError, match=r"was abandoned after 0\.2 s"):
        await client.step()
    await client.calibration.start(FIXED)
    answer = await client.accept(await client.step(), "table")
    assert answer["header_text"] == "Touch mark 2 of 9"
    assert client.camera.bench.pictures == 1
    client.calibration.close()


async def test_a_run_that_was_started_in_another_way_begins_anew(tmp_path: Path) -> None:
    client = Client(tmp_path)
    await client.to_picture()
    client.calibration.close()
    client.calibration.graph = Graph()
    await client.calibration.start(FIXED._replace(tf_frame_robot_tcp="tip"))
    answer = await client.accept(await client.step(), "table")
    assert answer["header_text"] == "Camera, robot and tool"
    assert "base_link" in answer["default_needed_strings"]
    assert (tmp_path / "table.journal.1").exists()
    client.calibration.close()


async def test_end_of_a_calibration_stops_its_timer(tmp_path: Path) -> None:
    client = Client(tmp_path, abandon_timeout=0.1)
    await client.to_picture()
    await client.step(abort=True)
    await asyncio.sleep(0.2)
    with pytest.raises(CalibrationError, match="the last one was aborted"):
        await client.step()


# ---------------------------------------------------------------------- steps


async def test_the_first_call_answers_nothing(tmp_path: Path) -> None:
    client = Client(tmp_path)
    await client.calibration.start(CalibrationStart())
    answer = await client.step(1.0)
    assert "expected no inputs in the first call" in answer["error"]
    asked = [*answer["descriptions_for_needed_strings"], *answer["descriptions_for_needed_options"]]
    assert [one.split()[0] for one in asked] == ["Name", "Topic", "Where"]
    assert answer["default_needed_strings"] == ["line1-cam3", SMARTCAMERA]
    assert answer["default_needed_options"] == ["True True False"]
    assert "False: on the flange" in answer["description_text"]
    client.calibration.close()


async def test_undo_goes_back_to_before_the_wizard(tmp_path: Path) -> None:
    client = Client(tmp_path)
    await client.to_picture()
    assert (await client.step(repeat_last_step=True))["header_text"] == "Camera, robot and tool"
    answer = await client.step(repeat_last_step=True)
    assert (answer["header_text"], answer["default_needed_strings"]) == ("Calibration", ["table"])
    answer = await client.step(repeat_last_step=True)
    assert answer["error"] == "repeat_last_step: there is no step before this one"
    answer = await client.accept(answer)
    assert answer["header_text"] == "Camera, robot and tool"
    client.calibration.close()


@pytest.mark.parametrize(
    ("start", "fixed", "title", "asked"),
    [
        (FIXED, "", "Camera, robot and tool", "Unit of the camera's positions"),
        (FIXED._replace(fixed_camera=""), "True", "Camera, robot and tool", "Unit of the camera's"),
        # pictures for the front end beside a smart camera that localizes
        (FIXED._replace(topic_image1="/i"), "", "Camera, robot and tool", "Unit of the camera's"),
        (CalibrationStart("/i", fixed_camera="True"), "", "Camera, robot and tool", "What is"),
        (CalibrationStart("/a", "/i", 0.0, "tip"), "False", "Camera and robot", "Where the camera"),
        (FIXED._replace(fixed_camera="False"), "", "Camera and robot", "Where the camera is"),
    ],
)
async def test_a_request_chooses_the_wizard(
    tmp_path: Path, start: CalibrationStart, fixed: str, title: str, asked: str
) -> None:
    client = Client(tmp_path)
    client.calibration.graph = Graph()
    await client.calibration.start(start)
    await client.step()
    options = [fixed] if fixed else []
    answer = await client.step(text_inputs=["table"], option_inputs=options)
    assert (answer["error"], answer["header_text"]) == ("", title)
    named = [one for one in answer["descriptions_for_needed_options"] if one.startswith(asked)]
    assert named
    client.calibration.close()


async def test_zero_is_no_answer_if_it_is_out_of_range(tmp_path: Path) -> None:
    client = Client(tmp_path)
    await client.calibration.start(FIXED)
    answer = await client.accept(await client.step(), "table")
    assert answer["default_needed_values"] == [0.0, 0.0]
    assert "0 stands for no answer" in answer["description_text"]
    await client.accept(answer)
    sequence = client.calibration._running
    assert sequence is not None
    assert sequence.session is not None
    assert sequence.session.samples[0]["answers"]["touch_sigma"] is None
    client.calibration.close()


async def test_side_of_a_square_is_the_default(tmp_path: Path) -> None:
    client = Client(tmp_path)
    client.calibration.graph = Graph()
    await client.calibration.start(CalibrationStart("/i", "", 0.025, "", "base", "True"))
    answer = await client.accept(await client.step(), "table")
    assert answer["default_needed_strings"] == ["", "base", ""]
    answer = await client.accept(answer)
    answer = await client.accept(answer)
    assert answer["descriptions_for_needed_values"][2] == "Side of a square [mm]"
    assert answer["default_needed_values"][2] == 25.0
    client.calibration.close()


# ---------------------------------------------------------------------- files and poses


async def test_a_symbolic_link_is_refused_before_anything_is_measured(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    secret = tmp_path / "secret.json"
    secret.write_text("{}")
    (tmp_path / "folder/table.json").symlink_to(secret)
    (tmp_path / "folder/other.journal").symlink_to(tmp_path / "made")
    client = Client(tmp_path / "folder")
    await client.calibration.start(FIXED)
    await client.step()
    for name in ("table", "other"):
        answer = await client.step(text_inputs=[name])
        assert "expected no symbolic link" in answer["error"]
    assert secret.read_text() == "{}"
    assert not (tmp_path / "made").exists()
    client.calibration.close()


async def test_a_pose_comes_in_the_frame_that_is_wanted(tmp_path: Path) -> None:
    saved(served(tmp_path), "table")
    client = Client(tmp_path / "folder")
    with pytest.raises(CalibrationError) as caught:
        await client.calibration.transform(PixelPoseRequest(0.1, 0.2))
    assert caught.value.code == "NO_CALIBRATION"
    client.calibration.load("table")
    pose = await client.calibration.transform(PixelPoseRequest(0.1, 0.2, 0.5, seq=7, utc=1e9))
    assert np.allclose(pose.position, where(0.1, 0.2))
    assert (pose.header.seq, pose.header.frame_id) == (7, "base")
    assert pose.header.stamp.timestamp() == 1e9
    with pytest.raises(CalibrationError, match="not seen in ROS") as caught:
        await client.calibration.transform(PixelPoseRequest(0.1, 0.2, reference="hall"))
    assert caught.value.code == "WRONG_FRAME"
    client.calibration.graph = Graph()
    pose = await client.calibration.transform(PixelPoseRequest(0.1, 0.2, reference="hall"))
    assert np.allclose(pose.position, np.add(where(0.1, 0.2), [1.0, 2.0, 3.0]))
    assert pose.header.frame_id == "hall"


async def test_finished_calibration_maps_pixels_at_once(tmp_path: Path) -> None:
    client = Client(tmp_path)
    answer = await client.accept(await client.accept(await client.to_picture()))
    for mark in GRID:
        answer = await client.step(*(1e3 * one for one in client.camera.bench.touch(*mark)))
    answer = await client.step(9.0, option_inputs=["accept"])
    answer = await client.step()
    assert (answer["button_text"], answer["error"]) == ("", "")
    pose = await client.calibration.transform(PixelPoseRequest(*GRID[4]))
    assert np.allclose(pose.position, where(*GRID[4]), atol=1e-9)
