"""The picture of a plane calibration."""

from __future__ import annotations

import os
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from smartcam.calibration import PlaneCalibration, fit_plane
from smartcam.calibration._inside import draw
from tests.geometry.rigid import localization, rotation_about, yaw

GOLDEN = Path(__file__).with_name("drawing.svg")

GRID = np.array([(x, y) for y in (0.02, 0.1, 0.18) for x in (0.03, 0.15, 0.27)])
NOISE = np.array(
    [
        [[3, -1, 2], [-2, 2, 1], [0, 1, -3]],
        [[1, 1, 1], [-1, -3, 0], [2, 0, -1]],
        [[-3, 1, 1], [0, -2, 2], [0, 1, -3]],
    ]
).reshape(9, 3)
ROTATION = rotation_about(np.array([0.2, -0.4, 1.0]), 0.6)


def calibration(
    sigma: float | None = 2e-4, rotation: NDArray[np.float64] = ROTATION
) -> PlaneCalibration:
    touched = GRID @ rotation[:, :2].T + [0.4, -0.3, 0.1] + 1e-4 * NOISE
    return fit_plane(GRID, touched, model="similarity", touch_sigma=sigma)


def elements(picture: str, kind: str) -> list[ET.Element]:
    """Return the elements of a class."""
    return [e for e in ET.fromstring(picture).iter() if e.get("class") == kind]  # noqa: S314


def texts(picture: str) -> list[str]:
    return re.findall(r"<text[^>]*>([^<]*)<", picture)


def enlargement(picture: str) -> float:
    (text,) = re.findall(r"([\d.e+]+) times larger", picture)
    return float(text)


def numbers(picture: str) -> list[float]:
    return [float(text) for text in re.findall(r"-?\d+\.\d+", picture)]


def test_picture_equals_the_approved_one() -> None:
    """To approve a new picture, run this test with SMARTCAM_REWRITE=1 and view the file."""
    parts = [localization(0.08, 0.05, 0.5, "screw <1>"), localization(0.2, 0.12, -2.0, "nut")]
    picture = draw(calibration(), parts, title="Table & camera")
    if os.environ.get("SMARTCAM_REWRITE"):
        GOLDEN.write_text(picture, encoding="utf-8", newline="\n")
    golden = GOLDEN.read_text(encoding="utf-8")
    assert re.sub(r"-?\d+\.\d+", "#", picture) == re.sub(r"-?\d+\.\d+", "#", golden)
    np.testing.assert_allclose(numbers(picture), numbers(golden), rtol=0, atol=0.011)


def test_picture_shows_each_touch_with_residual_and_ellipse() -> None:
    picture = draw(calibration())
    assert len(elements(picture, "touch")) == len(elements(picture, "residual")) == 9
    assert len(elements(picture, "ellipse")) == 9
    error = np.sqrt(np.mean(np.sum(calibration().leave_one_out ** 2, axis=1)))
    assert f"similarity, 9 touches; held-out error {1e3 * error:.3f} mm rms" in texts(picture)


def test_picture_residuals_are_enlarged_by_the_stated_factor() -> None:
    one = calibration()
    picture = draw(one)
    larger = enlargement(picture)
    lengths = []
    for line in elements(picture, "residual"):
        x1, y1, x2, y2 = (float(line.get(name, "")) for name in ("x1", "y1", "x2", "y2"))
        lengths.append(np.hypot(x2 - x1, y2 - y1))
    inside = one.residuals @ one.rotation[:, :2]
    zoom = 900 / (0.24 + 2 * 0.15 * 0.24)
    expected = np.linalg.norm(inside, axis=1) / one.scale * larger * zoom
    np.testing.assert_allclose(lengths, expected, atol=0.02)


def test_picture_ellipse_of_many_touches_is_a_circle_of_95_percent() -> None:
    """In the middle of the touches the covariance is sigma^2 / N on each axis."""
    picture = draw(calibration())
    larger = enlargement(picture)
    ellipse = elements(picture, "ellipse")[4].get("points", "")
    corners = np.array([[float(v) for v in pair.split(",")] for pair in ellipse.split()])
    radii = np.linalg.norm(corners - corners.mean(axis=0), axis=1)
    zoom = 900 / (0.24 + 2 * 0.15 * 0.24)
    np.testing.assert_allclose(radii, 2e-4 / 3 * 2.4477 * larger * zoom, rtol=0.01)


@pytest.mark.parametrize("far", [1e-2, 1000.0])
def test_picture_of_points_left_out_has_crosses_and_else_nothing_of_them(far: float) -> None:
    touched = np.array(calibration().robot_points)
    touched[8] += far
    one = fit_plane(GRID, touched, model="similarity", touch_sigma=2e-4, robust=True)
    picture = draw(one)
    assert one.outliers == (8,)
    assert len(elements(picture, "left-out")) == 2
    assert [len(elements(picture, kind)) for kind in ("touch", "residual", "ellipse")] == [8, 8, 8]
    assert [text for text in texts(picture) if text.isdecimal()] == [*map(str, range(1, 10))]
    assert any(text.startswith("similarity, 8 of 9 touches;") for text in texts(picture))
    assert any(text.endswith("larger than they are; crosses: left out") for text in texts(picture))
    assert enlargement(picture) >= 50


def test_picture_of_a_mark_seen_far_away_and_left_out_does_not_show_it() -> None:
    seen = GRID.copy()
    seen[3] += 100.0
    one = fit_plane(
        seen, calibration().robot_points, model="similarity", touch_sigma=2e-4, robust=True
    )
    assert one.outliers == (3,)
    assert elements(draw(one), "left-out") == []
    assert len(elements(draw(one), "touch")) == 8


def test_picture_without_a_sigma_has_no_errors_to_show() -> None:
    touched = GRID[[0, 2, 6]] @ ROTATION[:, :2].T
    one = fit_plane(GRID[[0, 2, 6]], touched, model="affine")
    picture = draw(one, [localization(0.1, 0.1)])
    assert elements(picture, "ellipse") == []
    assert not any("predicted" in text for text in texts(picture))
    assert "affine, 3 touches; held-out error not known" in texts(picture)
    assert enlargement(picture) == 1


def test_picture_of_pixels_has_its_bar_in_millimetres() -> None:
    touched = GRID @ yaw(0.3)[:, :2].T
    picture = draw(fit_plane(GRID * 4000 + 100, touched, touch_sigma=1e-4))
    assert "50 mm" in texts(picture)


def test_picture_robot_axis_that_stands_on_the_plane_is_a_dot() -> None:
    picture = draw(calibration(rotation=yaw(0.3)))
    dots = [e for e in elements(picture, "robot") if e.tag.endswith("circle")]
    assert len(dots) == 1
    lines = [e for e in elements(draw(calibration()), "robot") if e.tag.endswith("line")]
    assert len(lines) == 3


@pytest.mark.parametrize("place", [(0.5, 0.1), (0.1, -2.0)])
def test_picture_has_room_for_parts_beside_the_touches(place: tuple[float, float]) -> None:
    picture = draw(calibration(), [localization(*place)])
    (circle,) = (e for e in elements(picture, "part") if e.tag.endswith("circle"))
    root = ET.fromstring(picture)  # noqa: S314
    assert 0 < float(circle.get("cx", "")) < float(root.get("width", ""))
    assert 0 < float(circle.get("cy", "")) < float(root.get("height", ""))
