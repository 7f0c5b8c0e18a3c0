"""Remove the lens' distortion from frames."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from smartcam.calibration import CameraModel, Transform
from smartcam.calibration._inside import rectify
from smartcam.exceptions import ConfigurationError, FrameFormatError
from smartcam.frames import FrameSet, Rectifier, Undistorter, find_format
from smartcam.geometry._inside import DistortionModel
from tests.frames.drivers import frame

SIZE = (320, 240)
MATRIX = np.array([[260.0, 0, 160], [0, 260, 120], [0, 0, 1]])
LENSES: dict[DistortionModel, list[float]] = {
    "plumb_bob": [-0.25, 0.06, 0.001, -0.001, 0],
    "equidistant": [0.02, -0.01, 0, 0],
}


def lens(model: DistortionModel) -> CameraModel:
    return CameraModel(
        size=SIZE, matrix=MATRIX, distortion=np.array(LENSES[model]), distortion_model=model
    )


def spots(camera: CameraModel, points: np.ndarray) -> bytes:
    """Return a camera's picture of bright spots at points."""
    u, v = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    picture = np.zeros((SIZE[1], SIZE[0]))
    for x, y in camera.project(points):
        picture += 220 * np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * 2.5**2))
    return np.clip(picture, 0, 255).astype(np.uint8).tobytes()


def centres(picture: np.ndarray) -> np.ndarray:
    """Return the places of the spots in a picture, from left to right."""
    count, labels = cv2.connectedComponents((picture > 60).astype(np.uint8))
    found = []
    for number in range(1, count):
        v, u = np.nonzero(labels == number)
        weights = picture[v, u].astype(float)
        found.append((np.average(u, weights=weights), np.average(v, weights=weights)))
    return np.array(sorted(found))


def seen(data: bytes) -> dict[str, object]:
    return {"data": data, "width": SIZE[0], "height": SIZE[1], "stride": SIZE[0]}


@pytest.mark.parametrize("model", LENSES)
def test_undistorted_points_are_those_of_an_ideal_lens(model: DistortionModel) -> None:
    points = np.array([[-0.35, 0.2, 1.0], [-0.1, -0.25, 1], [0.05, 0.05, 1], [0.3, -0.1, 1]])
    undistorter = Undistorter(lens(model))
    one = frame(1, **seen(spots(lens(model), points)))
    expected = undistorter.camera.project(points)
    assert not undistorter.camera.distortion.any()
    np.testing.assert_allclose(centres(undistorter(one)), expected, atol=0.25)
    assert undistorter(one, colour=True).shape == (240, 320, 3)
    assert np.abs(centres(one.array()) - expected).max() > 2


def test_rows_of_a_rectified_pair_show_the_same_points() -> None:
    turn = np.array(cv2.Rodrigues(np.array([0.03, -0.05, 0.04]))[0], dtype=np.float64)
    right_left = Transform("right", "left", turn, np.array([-0.1, 0.005, 0.0]))
    camera = lens("plumb_bob")
    points = np.array([[-0.2, 0.15, 1.1], [-0.02, -0.2, 0.9], [0.1, 0.05, 1.3], [0.3, -0.1, 1.0]])
    rectifier = Rectifier(rectify(camera, camera, right_left), SIZE)
    pair = FrameSet(
        {
            "left": frame(1, **seen(spots(camera, points))),
            "right": frame(2, **seen(spots(camera, right_left.apply(points)))),
        },
        0.0,
    )
    left, right = (centres(one) for one in rectifier(pair))
    np.testing.assert_allclose(left[:, 1], right[:, 1], atol=0.3)
    assert np.all(left[:, 0] > right[:, 0])


def test_frame_of_another_size_or_alpha_is_refused() -> None:
    with pytest.raises(FrameFormatError, match="expected frames of the lens' 320x240, got 4x2"):
        Undistorter(lens("plumb_bob"))(frame(1))
    with pytest.raises(ConfigurationError, match="alpha"):
        Undistorter(lens("plumb_bob"), alpha=1.5)
    assert find_format("GREY").name == "Mono8"
