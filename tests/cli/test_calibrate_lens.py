"""``smartcam calibrate lens``: from picture files, and from a source of frames."""

from __future__ import annotations

import asyncio
import functools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from smartcam._cli.calibrate_lens import MIN_NEW_VIEW_SHARE, ViewCollector
from smartcam._extras import load
from smartcam.calibration import (
    CameraModel,
    Checkerboard,
    IntrinsicCalibration,
    TargetView,
    target_to_data,
)
from smartcam.calibration.formats import read_cameras
from smartcam.calibration.simulation import poses_around, render
from smartcam.exceptions import FrameSourceError
from smartcam.frames import FrameSink, StreamFormat, find_format
from smartcam.registry import FRAMES
from tests.cli.commandline import run
from tests.frames.drivers import ShowingDriver, frame
from tests.processes import Outcome

BOARD = Checkerboard(columns=5, rows=4, square=0.04, origin_mark=True)
LENS = CameraModel(size=(320, 240), matrix=np.array([[300.0, 0, 159], [0, 301.0, 121], [0, 0, 1]]))
NOTHING = np.full((240, 320), 128, np.uint8)


@functools.cache
def images() -> list[Any]:
    """Return pictures from five sides."""
    random = np.random.default_rng(7)
    return [
        render(BOARD, LENS, pose.inverse(), noise=1.0, random=random)
        for pose in poses_around(BOARD, 5, tilt=0.5, distance=0.6, random=random)
    ]


@pytest.fixture
def target(tmp_path: Path) -> str:
    path = tmp_path / "target.json"
    path.write_text(json.dumps(target_to_data(BOARD)))
    return str(path)


def calibrating(target: str, *arguments: str) -> Outcome:
    return run("calibrate", "lens", *arguments, "--target", target)


def write(folder: Path, images: list[Any]) -> Path:
    folder.mkdir()
    for number, image in enumerate(images):
        data: bytes = load("cv2").imencode(".png", image)[1].tobytes()
        (folder / f"{number}.png").write_bytes(data)
    (folder / "notes.txt").write_text("no picture")
    return folder


# ---------------------------------------------------------------------- files


def test_lens_of_a_folder_leaves_out_what_shows_no_target(tmp_path: Path, target: str) -> None:
    folder = write(tmp_path / "pictures", [*images(), NOTHING])
    output = tmp_path / "lens.yaml"
    done = calibrating(target, str(folder), "-o", str(output), "--json").done()
    *views, told = done.lines
    assert [one["used"] for one in views] == [True] * 5 + [False]
    assert views[0] == {
        "picture": str(folder / "0.png"), "used": True, "points": 20, "reason": "",
    }  # fmt: skip
    assert "found none" in views[5]["reason"]
    assert (told["file"], told["views"]) == (str(output), 5)
    assert abs(told["lens"]["fx"] - 300) < 5 * told["deviations"]["fx"] < 5
    written = read_cameras(output, "camera_info").cameras[0]
    assert written.matrix[0, 0] == pytest.approx(told["lens"]["fx"])


@pytest.mark.long
def test_lens_of_files_has_its_views_in_json(tmp_path: Path, target: str) -> None:
    folder = write(tmp_path / "pictures", images())
    files = [str(one) for one in sorted(folder.glob("*.png"))]
    output = tmp_path / "lens.json"
    out = calibrating(target, *files, "-o", str(output)).done().out
    assert f"{output}: 5 views, error " in out
    assert "lacking: views at the left and right" in out
    assert len(IntrinsicCalibration.load(output).views) == 5
    done = calibrating(target, *files, "-o", str(output))
    done.failed(2, "lens.json: the file exists already; --force replaces it")
    calibrating(target, *files, "-o", str(output), "--force").done()


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("nothing.png", "-o", "x.yaml"), "nothing.png: No such file"),
        ((".", "-o", "x.yaml"), ".: expected pictures (.bmp, .jpeg"),
        (("x.png", "-o", "x.txt"), "expected a name that ends with .yaml or .json"),
        (("x.png", "-o", "nowhere/x.yaml"), "there is no folder nowhere"),
        (("synthetic://", "x.png", "-o", "x.yaml"), "expected files and folders, or one URL"),
        (("x.png", "-o", "x.yaml", "--count", "5"), "are for a source of frames"),
        (("synthetc://", "-o", "x.yaml"), "did you mean 'synthetic'?"),
        (("synthetic://?size=5x5", "-o", "x.yaml"), "room for the stamp"),
    ],
)
def test_lens_with_wrong_use_is_reported(
    target: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: tuple[str, ...],
    text: str,
) -> None:
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path / "empty")
    done = calibrating(target, *arguments)
    assert done.code == 2
    assert text in done.err


def test_lens_of_too_few_views_is_refused(tmp_path: Path, target: str) -> None:
    folder = write(tmp_path / "pictures", images()[:2])
    done = calibrating(target, str(folder), "-o", str(tmp_path / "x.yaml"))
    assert done.code == 2
    assert "expected 3 views or more, got 2" in done.err
    assert not (tmp_path / "x.yaml").exists()


# ---------------------------------------------------------------------- a source


class Table(ShowingDriver):
    """Shows images one after the other, each for a while, like a person with a sheet."""

    images: tuple[Any, ...] = ()
    ends: Any = "not"

    async def open(self) -> StreamFormat:
        return StreamFormat(find_format("Mono8"), 320, 240)

    async def show(self, sink: FrameSink) -> None:
        about: dict[str, Any] = {"format": find_format("Mono8"), "width": 320, "height": 240}
        for image in self.images:
            for _ in range(40):
                sink.frame(frame(1, data=image.tobytes(), stride=320, **about))
                await asyncio.sleep(0.01)
        if self.ends != "not":
            sink.ended(self.ends)


@pytest.fixture
def table(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Register ``table://``; yield the function that puts images there."""
    monkeypatch.setattr(FRAMES, "_registered", {"table": Table})
    monkeypatch.setattr(FRAMES, "_loaded", {})

    def put(*images: Any, **other: Any) -> None:
        for name, value in {"images": images, **other}.items():
            monkeypatch.setattr(Table, name, value)

    return put


@pytest.mark.long
def test_lens_of_a_source_takes_a_view_wherever_the_target_is_held(
    tmp_path: Path, target: str, table: Any
) -> None:
    table(*images()[:2], NOTHING, *images(), *images())
    output = tmp_path / "lens.json"
    done = calibrating(target, "table://", "-o", str(output), "--count", "3").done()
    assert done.out.startswith("view 1 of 3: hold the target straight from the front")
    assert "\nview 3 of 3: 20 points\n" in done.out
    assert done.out.count("  next: ") == 2
    assert len(IntrinsicCalibration.load(output).views) == 3


def test_lens_of_a_source_ends_with_its_seconds_and_says_what_lacks(
    tmp_path: Path, target: str, table: Any
) -> None:
    table(NOTHING)
    done = calibrating(target, "table://", "-o", str(tmp_path / "x.yaml"), "--seconds", "0.1")
    assert done.code == 2
    assert "expected 3 views or more, got 0" in done.err


@pytest.mark.parametrize(
    ("other", "code", "text"),
    [
        ({"ends": FrameSourceError("table: it was unplugged")}, 3, "table: it was unplugged"),
        ({}, 4, "expected the next frame, got none in time"),
    ],
)
def test_lens_of_a_source_that_dies_or_is_silent_reports_it(
    tmp_path: Path, target: str, table: Any, other: dict[str, Any], code: int, text: str
) -> None:
    table(**other)
    arguments = ("table://", "-o", str(tmp_path / "x.yaml"), "--timeout", "0.1", "--seconds", "60")
    done = calibrating(target, *arguments)
    assert done.code in {code, 3}  # silent, or stuck: which is noticed first is as it comes
    assert text in done.err or "gave no frame for 0.1 s" in done.err


# ---------------------------------------------------------------------- which views


def view(shift: float, ids: Any = None) -> TargetView:
    numbers = np.arange(20) if ids is None else np.array(ids)
    points = np.stack([10.0 * numbers + 20 + shift, 5.0 * numbers + 20], axis=1)
    return TargetView(
        target=BOARD,
        size=(320, 240),
        ids=numbers,
        points=points,
        covariance=np.tile(np.eye(2) * 1e-4, (len(numbers), 1, 1)),
    )


def test_view_is_taken_of_a_target_that_stands_still_and_elsewhere() -> None:
    taken = ViewCollector()
    far = MIN_NEW_VIEW_SHARE * 320
    assert not taken.add_if_new(view(0.0))  # it may be moving
    assert taken.add_if_new(view(0.5))
    assert not taken.add_if_new(view(0.5))  # is there already
    assert not taken.add_if_new(view(far + 2.0))  # moved
    assert taken.add_if_new(view(far + 2.5))
    assert not taken.add_if_new(view(far - 3.0))
    assert not taken.add_if_new(view(far - 3.0))  # too near to one that is there
    assert not taken.add_if_new(view(3 * far))
    taken.note_target_lost()
    assert not taken.add_if_new(view(3 * far))  # not seen in between: it may have moved
    assert taken.add_if_new(view(3 * far))
    assert len(taken.views) == 3


def test_views_without_common_points_are_others() -> None:
    taken = ViewCollector()
    taken.add_if_new(view(0.0, range(10)))
    assert not taken.add_if_new(view(0.0, range(10, 20)))
    assert taken.add_if_new(view(0.0, range(10, 20)))
