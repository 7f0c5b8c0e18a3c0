"""``smartcam calibrate --wizard sheet``, ``hand-eye``: pictures of a folder or a camera."""

from __future__ import annotations

import asyncio
import itertools
import json
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from smartcam._extras import load
from smartcam.calibration import (
    CameraModel,
    Checkerboard,
    SheetCalibration,
    Transform,
    calibrate_sheet,
    find_target,
    fit_corners,
    target_to_data,
)
from smartcam.calibration._inside import PictureFolder
from smartcam.calibration.formats import write_camera_info
from smartcam.calibration.simulation import render
from smartcam.emulator import EmulatedInSight
from smartcam.exceptions import FrameSourceError
from smartcam.frames import FrameSink, StreamFormat, find_format
from smartcam.registry import FRAMES
from tests.cli.commandline import closed_port, emulators, run
from tests.cli.inside import calibrate
from tests.frames.drivers import ShowingDriver, frame
from tests.processes import Outcome, Process, printed_by

pytestmark = pytest.mark.long

TARGET = Checkerboard(columns=9, rows=6, square=0.025, origin_mark=True)
CAMERA = CameraModel(
    size=(640, 480), matrix=np.array([[700.0, 0, 320], [0, 700.0, 240], [0, 0, 1]])
)
SEEN = Transform("camera", "target", np.diag([1.0, -1.0, -1.0]), np.array([-0.1, 0.06, 0.5]))
OFFSET = np.array([0.4, -0.1, 0.02])
"""Place of the sheet's origin before the robot; its axes are the robot's."""

ABOUT = {"unit": "m", "side": "-z", "touch_sigma": 0.1}


def bitmap(width: int = 640) -> bytes:
    image = render(TARGET, CAMERA, SEEN)[:, :width]
    data: bytes = load("cv2").imencode(".bmp", image)[1].tobytes()
    return data


def calibrating(folder: Path, lines: list[Any], *options: str) -> Outcome:
    """Run the command with these answers."""
    stdin = "".join(f"{json.dumps(one)}\n" for one in lines).encode()
    arguments = ("--folder", str(folder / "kept"), "--json", *options)
    return run(*arguments, stdin=stdin, main=lambda: calibrate(prog_name="smartcam calibrate"))


def answers(*given: dict[str, Any]) -> list[dict[str, Any]]:
    return [{"answers": one} for one in given]


@pytest.fixture
def files(tmp_path: Path) -> list[str]:
    """Options: what is on the sheet, the lens, and where pictures come."""
    target, lens, pictures = (tmp_path / name for name in ("target.json", "lens.yaml", "ftp"))
    target.write_text(json.dumps(target_to_data(TARGET)))
    write_camera_info(lens, CAMERA)
    pictures.mkdir()
    return ["--target", str(target), "--lens", str(lens), "--pictures", str(pictures)]


def by_a_sheet(tmp_path: Path, files: list[str], *more: str) -> Any:
    """Go through the wizard over a folder that pictures come into; return the last view."""
    options = ["--wizard", "sheet", "--json", "--folder", str(tmp_path / "kept"), *files]
    with Process("smartcam", "calibrate", *more, *options) as process:
        number = shots = 0
        while True:
            number += 1
            view = json.loads(process.read_until(b"\n", count=number).splitlines()[-1])
            if view["type"] == "result":
                return view
            assert view["errors"] == {}
            answer: dict[str, Any] = ABOUT if view["step"] == "about" else {}
            if view["step"].startswith("touch-"):
                index = 9 * (view["defaults"]["row"] - 1) + view["defaults"]["column"] - 1
                answer = dict(zip("xyz", (OFFSET + TARGET.points[index]).tolist(), strict=True))
            process.write(json.dumps({"answers": answer}).encode() + b"\n")
            # a camera that goes on taking pictures: some come behind the button
            while view["step"] == "picture" and not process.says(0.5):
                (tmp_path / "ftp" / f"shot{shots}.bmp").write_bytes(bitmap())
                shots += 1


def test_calibrate_by_a_sheet_and_a_folder_gives_a_calibration(
    tmp_path: Path, files: list[str]
) -> None:
    view = by_a_sheet(tmp_path, files)
    assert view["result"]["file"] == "sheet.json"
    assert view["verdict"]["text"].startswith("Good for 0.")
    printed = printed_by(view["result"]["use"]["python"])
    assert np.allclose(np.fromstring(printed.strip("[]\n"), sep=" "), OFFSET, atol=1e-4)
    (row,) = run(*shlex.split(view["result"]["use"]["command"])[1:], "--json").done().lines
    assert (row["name"], row["kind"]) == ("sheet", "sheet")
    found = SheetCalibration.load(tmp_path / "kept" / "sheet.json")
    place = found.transform(CAMERA.project(SEEN.apply(TARGET.points[[10]])))[0]
    assert place == pytest.approx(OFFSET + TARGET.points[10], abs=1e-5)


def test_calibrate_by_a_sheet_ends_with_lines_for_the_camera_that_was_named(
    tmp_path: Path, files: list[str]
) -> None:
    spec = "localizations: (x: uint8 px, y: uint8 px)*"
    with emulators(tmp_path, ()) as (url,):
        options = (url, "--application", "21", "--interpret-as", spec)
        use = by_a_sheet(tmp_path, files, *options)["result"]["use"]
        (result,) = run(*shlex.split(use["command"])[1:], "--json").done().lines
        assert result["value"][0]["pose"]["header"]["frame_id"] == "robot"
        assert "Position(x=" in printed_by(use["python"])


def test_calibration_by_a_sheet_wants_y_down_where_it_is_used(tmp_path: Path) -> None:
    ids = [0, 8, 22, 45, 53]
    plane = fit_corners(TARGET, ids, OFFSET + TARGET.points[ids], tool_z=(0, 0, -1))
    path = tmp_path / "sheet.json"
    calibrate_sheet(find_target(render(TARGET, CAMERA, SEEN), TARGET), plane).save(path)
    options = ("--interpret-as", "localizations", "--calibration", str(path))
    with closed_port() as url:
        run("trigger", url, *options).failed(2, "made with --y-down: give it here, too")
        run("trigger", url, *options, "--y-down").failed(3)


def test_calibrate_by_a_folder_if_nothing_comes_keeps_the_step(
    tmp_path: Path, files: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(PictureFolder.__init__, "__kwdefaults__", {"timeout": 0.3})
    lines = [*answers(ABOUT, {}, {}), {"do": "abort"}]
    done = calibrating(tmp_path, lines, "--wizard", "sheet", *files)
    assert done.code == 130
    assert [line.get("step") for line in done.lines[-3:]] == ["picture", "picture", None]
    assert "within 0.3 s" in done.lines[-2]["errors"]["base"]
    asked = done.lines[2]
    assert (
        f"the first file written to {tmp_path / 'ftp'} from now on counts" in asked["description"]
    )
    assert asked["notes"] == ["picture 1 of 1; to end without it, abort"]
    assert asked["waiting"].startswith("Waiting: the first file written to ")
    assert "The step waits 0.3 s for it" in asked["waiting"]


def test_calibrate_hand_eye_asks_for_the_pose_in_the_robots_way(
    tmp_path: Path, files: list[str]
) -> None:
    lines = [*answers({"robot": "kuka", "setup": "eye-to-hand"}, {}, {"x": 1.0}), {"do": "abort"}]
    done = calibrating(tmp_path, lines, "--wizard", "hand-eye", *files)
    assert [line.get("step") for line in done.lines] == [
        "about", "rulers", "view-1", "view-1", None,
    ]  # fmt: skip
    properties = done.lines[2]["schema"]["properties"]
    assert list(properties) == ["x", "y", "z", "a", "b", "c"]
    assert (properties["x"]["x-unit"], "x-unit" in properties["a"]) == ("mm", False)
    assert set(done.lines[3]["errors"]) == {"y", "z", "a", "b", "c"}


def test_calibrate_by_a_sheet_with_a_camera_that_sends_no_pictures_reports_it(
    tmp_path: Path, files: list[str]
) -> None:
    lines = [*answers(ABOUT, {}, {}), {"do": "abort"}]
    with emulators(tmp_path, ()) as urls:
        done = calibrating(tmp_path, lines, urls[0], "--wizard", "sheet", *files[:4])
    assert (
        "its protocol sends no pictures; expected a protocol that does, or --pictures FOLDER"
        in (done.lines[-2]["errors"]["base"])
    )


class Sheet(ShowingDriver):
    """Shows the sheet, ten times a second."""

    async def open(self) -> StreamFormat:
        if self.address.host == "gone":
            raise FrameSourceError("sheet: no such device")
        return StreamFormat(find_format("Mono8"), 640, 480)

    async def show(self, sink: FrameSink) -> None:
        data = render(TARGET, CAMERA, SEEN).tobytes()
        about: dict[str, Any] = {"format": find_format("Mono8"), "width": 640, "height": 480}
        for number in itertools.count(1):
            sink.frame(frame(number, data=data, stride=640, **about))
            await asyncio.sleep(0.02)


@pytest.fixture
def sheet_source(monkeypatch: pytest.MonkeyPatch) -> None:
    """Register ``sheet://``."""
    monkeypatch.setattr(FRAMES, "_registered", {"sheet": Sheet})
    monkeypatch.setattr(FRAMES, "_loaded", {})


@pytest.mark.usefixtures("sheet_source")
def test_calibrate_by_a_sheet_looks_at_frames(tmp_path: Path, files: list[str]) -> None:
    lines = [*answers(ABOUT, {}, {}), {"do": "abort"}]
    options = ["--wizard", "sheet", *files[:4], "--pictures", "sheet://"]
    done = calibrating(tmp_path, lines, *options)
    assert [view.get("step") for view in done.lines] == [
        "about", "rulers", "picture", "touch-1", None,
    ]  # fmt: skip
    assert done.lines[2]["button"] == "Take a picture"
    assert done.lines[3]["notes"][0] == "54 of 54 points of the target seen"


@pytest.mark.usefixtures("sheet_source")
def test_calibrate_by_a_source_that_is_not_there_ends_before_anything_is_asked(
    tmp_path: Path, files: list[str]
) -> None:
    options = ["--wizard", "hand-eye", *files[:4], "--pictures"]
    done = calibrating(tmp_path, [], *options, "sheet://gone").failed(3, "no such device")
    assert done.out == ""
    calibrating(tmp_path, [], *options, "synthetic://?fbs=3").failed(2, "did you mean 'fps'")
    assert not (tmp_path / "kept").exists()


@pytest.mark.real_time
async def test_calibrate_by_a_sheet_reads_the_picture_of_an_in_sight(
    tmp_path: Path, files: list[str]
) -> None:
    lines = [*answers(ABOUT, {}, {}), {"do": "abort"}]
    options = ["--wizard", "sheet", *files[:4]]
    async with EmulatedInSight(image=render(TARGET, CAMERA, SEEN), online=True) as emulator:
        command = ("calibrate", emulator.url, "--json", "--folder", str(tmp_path), *options)
        with Process("smartcam", *command) as process:
            process.write("".join(f"{json.dumps(one)}\n" for one in lines).encode())
            views = (await asyncio.to_thread(process.wait)).lines
    assert [view.get("step") for view in views] == [
        "about", "rulers", "picture", "touch-1", None,
    ]  # fmt: skip
    assert views[3]["notes"][0] == "54 of 54 points of the target seen"


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--wizard", "sheet"], "a URL is missing"),
        (["--pictures", "."], "a URL is missing"),
        (["bvs://x", "--check", "t", "--wizard", "sheet"], "leave out --wizard"),
        (["v4l2:///dev/video0", "--wizard", "sheet"], "--pictures v4l2:///dev/video0 with"),
    ],
)
def test_calibrate_with_options_that_contradict_reports_it(
    tmp_path: Path, options: list[str], text: str
) -> None:
    done = calibrating(tmp_path, [], *options)
    assert done.code == 2
    assert text in done.err


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--wizard", "sheet", "--pictures", "nowhere"], "nowhere: expected a folder"),
        (["bvs://x", "--target", "nowhere"], "--target nowhere: No such file"),
        (["bvs://x", "--lens", "nowhere"], "--lens nowhere: No such file"),
    ],
)
def test_calibrate_with_options_that_cannot_work_reports_it(
    tmp_path: Path, options: list[str], text: str
) -> None:
    calibrating(tmp_path, [], *options).failed(2, text)


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ("{", "not valid JSON"),
        ("[]", "expected a file of smartcam sheet"),
        ("{}", "expected a kind of"),
    ],
)
def test_calibrate_with_a_target_that_is_none_reports_it(
    tmp_path: Path, content: str, text: str
) -> None:
    (tmp_path / "target.json").write_text(content)
    options = ("bvs://x", "--target", str(tmp_path / "target.json"))
    calibrating(tmp_path, [], *options).failed(2, "target.json: ", text)


def test_calibrate_with_a_lens_that_is_none_reports_it(tmp_path: Path) -> None:
    (tmp_path / "lens.yaml").write_text("no: lens\n")
    calibrating(tmp_path, [], "bvs://x", "--lens", str(tmp_path / "lens.yaml")).failed(2, "--lens:")


def test_terminal_names_the_file_of_a_step_s_picture(tmp_path: Path) -> None:
    from smartcam._cli.calibrate_terminal import _step_text, _write_picture

    path = tmp_path / "table.step.svg"
    view = {"preview": {"svg": "<svg>ring</svg>"}, "can": ["abort"], "number": 4, "of": 10}
    view |= {"title": "Touch point 1", "description": "", "notes": [], "errors": {}}
    view |= {"schema": {"properties": {}}}
    assert _write_picture(view, path) == path
    assert path.read_text() == "<svg>ring</svg>"
    text = _step_text(view, path)
    assert text == f"\nStep 4 of about 10: Touch point 1  (:abort)\n  picture: {path}"
    assert _write_picture({"preview": None}, path) is None
