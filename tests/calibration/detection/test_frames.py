"""Targets in frames of a camera: the brightness that it sent counts."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from smartcam.calibration import CameraModel, Checkerboard, Transform, find_target
from smartcam.calibration.simulation import render
from smartcam.exceptions import CalibrationError, FrameFormatError
from smartcam.frames import Frame, find_format
from tests.frames.drivers import frame

BOARD = Checkerboard(columns=5, rows=4, square=0.03, origin_mark=True)
CAMERA = CameraModel(
    size=(320, 240), matrix=np.array([[300.0, 0, 160], [0, 300.0, 120], [0, 0, 1]])
)
SEEN = Transform("camera", "target", np.diag([1.0, -1.0, -1.0]), np.array([-0.06, 0.045, 0.3]))
IMAGE = render(BOARD, CAMERA, SEEN)


def shot(data: bytes, format: str, stride: int) -> Frame:
    return frame(data=data, format=find_format(format), width=320, height=240, stride=stride)


@pytest.mark.parametrize("format", ["Mono8", "YUYV", "Mono12"])
def test_target_in_a_frame_equals_that_in_its_brightness(format: str) -> None:
    levels: Any = IMAGE
    stride = 320
    if format == "YUYV":  # U and V of strong colours, which the brightness does not have
        levels, stride = np.dstack([IMAGE, np.full_like(IMAGE, 230)]), 640
    if format == "Mono12":
        levels, stride = IMAGE.astype(np.uint16) * 16, 640
    found = find_target(shot(levels.tobytes(), format, stride), BOARD, name="frame")
    wanted = find_target(levels if format == "Mono12" else IMAGE, BOARD)
    assert np.array_equal(found.points, wanted.points)
    assert found.name == "frame"


def test_target_in_a_frame_with_rows_that_are_padded_is_found() -> None:
    padded = np.zeros((240, 400), np.uint8)
    padded[:, :320] = IMAGE
    found = find_target(shot(padded.tobytes(), "Mono8", 400), BOARD)
    assert np.array_equal(found.points, find_target(IMAGE, BOARD).points)


def test_target_in_a_frame_without_brightness_is_refused() -> None:
    with pytest.raises(FrameFormatError, match="Coord3D_C16"):
        find_target(shot(bytes(320 * 480), "Z16", 640), BOARD)
    with pytest.raises(FrameFormatError, match="expected"):
        find_target(shot(b"torn", "Mono8", 320), BOARD)


def test_frame_that_shows_no_target_is_refused() -> None:
    with pytest.raises(CalibrationError) as refused:
        find_target(shot(bytes(320 * 240), "Mono8", 320), BOARD)
    assert refused.value.code == "TARGET_NOT_FOUND"
