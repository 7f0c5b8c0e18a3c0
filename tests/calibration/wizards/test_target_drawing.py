"""Pictures of steps with targets or touches, and of the suggested next view."""

from __future__ import annotations

import base64
import json
import math
import os
import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest

from smartcam.calibration import Checkerboard, PlaneCalibration, TargetView, fit_plane
from smartcam.calibration._inside import STANDARD_VIEWS
from smartcam.calibration.wizards._marks import Mark, Touch
from smartcam.calibration.wizards._target_drawing import MAX_SIDE_PX, cell_counts, draw_preview
from smartcam.calibration.wizards._touch_previews import (
    HEAT_MAP_CELLS,
    compare_touches,
    next_touch_preview,
    touch_points,
)
from smartcam.exceptions import CalibrationError
from smartcam.geometry._inside import Code
from tests.calibration.inside import Look, outline
from tests.calibration.plane.planekit import GRID, SIGMA, SPECIAL, Scene

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.geometry._inside import Array

GOLDEN = Path(__file__).with_name("target_drawing.svg")
TARGET = Checkerboard(columns=4, rows=3, square=0.025)
GREY = np.full((480, 640), 128, dtype=np.uint8)
DATA = re.compile(r"(?<=base64,)[\w+/=]+")


def view(
    left: float = 100, low: float = 400, step: float = 60, size: tuple[int, int] = (640, 480)
) -> TargetView:
    """Return a view of the target, upright in front of the camera."""
    points = [(left + step * x, low - step * y) for y in range(3) for x in range(4)]
    return TargetView(
        target=TARGET,
        size=size,
        ids=np.arange(12, dtype=np.intp),
        points=np.array(points),
        covariance=np.tile(0.01 * np.eye(2), (12, 1, 1)),
    )


def elements(picture: str, kind: str) -> list[ET.Element]:
    """Return the elements of a class."""
    found = ET.fromstring(picture).iter()  # noqa: S314
    return [one for one in found if kind in (one.get("class") or "").split()]


def legend(picture: str) -> str:
    texts: list[str] = re.findall(r"<text[^>]*>([^<]*)<", picture)
    return texts[-1]


def picture_in(picture: str) -> NDArray[Any]:
    (data,) = DATA.findall(picture)
    png = np.frombuffer(base64.b64decode(data), dtype=np.uint8)
    return np.asarray(cv2.imdecode(png, cv2.IMREAD_UNCHANGED))


def test_preview_equals_the_approved_one() -> None:
    """To approve a new picture, run this test with SMARTCAM_REWRITE=1 and view the file."""
    one = view()
    drawn = draw_preview(
        GREY,
        view=one,
        earlier=[view(350, 200)],
        predicted=one.points + np.array([0.1, -0.2]),
        axes=[(100, 400), (160, 400), (100, 340), (90, 410)],
        suggested=[(400, 300), (600, 280), (620, 440), (410, 450)],
        title="View 2 <of 10>",
    )
    shown = DATA.sub("", drawn)  # a PNG depends on the version of zlib
    if os.environ.get("SMARTCAM_REWRITE"):
        GOLDEN.write_text(shown, encoding="utf-8", newline="\n")
    assert shown == GOLDEN.read_text(encoding="utf-8")


def test_preview_has_the_camera_s_picture_under_it() -> None:
    image = np.zeros((480, 640, 3), dtype=np.uint8)
    image[100:200, 300:400] = (255, 255, 255)
    assert np.array_equal(picture_in(draw_preview(image)), image[:, :, 0])


@pytest.mark.parametrize("size", [(2000, 3000), (3000, 20), (700, 16)])
def test_preview_of_a_large_image_is_bounded(size: tuple[int, int]) -> None:
    random = np.random.default_rng(1)
    drawn = draw_preview(random.integers(0, 255, size, dtype=np.uint8))
    assert max(picture_in(drawn).shape) == MAX_SIDE_PX
    assert len(drawn) < 1.5 * MAX_SIDE_PX**2 + 5000


def test_preview_draws_points_at_their_places_in_the_picture() -> None:
    points = elements(draw_preview(GREY, view=view()), "point")
    zoom = 900 / 640
    assert len(points) == 12
    assert points[0].get("class") == "point origin"
    # the picture begins half a pixel before the middle of its first pixel
    assert points[0].get("cx") == f"{20 + 100.5 * zoom:.2f}"
    assert points[0].get("cy") == f"{40 + 400.5 * zoom:.2f}"


def test_preview_without_the_origin_fills_no_point() -> None:
    part = view()
    hidden = TargetView(
        target=TARGET,
        size=part.size,
        ids=part.ids[1:],
        points=part.points[1:],
        covariance=part.covariance[1:],
    )
    drawn = draw_preview(GREY, view=hidden)
    assert elements(drawn, "origin") == []
    assert legend(drawn).startswith("11 of 12 points; ")


def test_preview_residuals_are_enlarged_by_the_stated_factor() -> None:
    one = view()
    drawn = draw_preview(GREY, view=one, predicted=one.points + np.array([0.3, 0.4]))
    (line, *rest) = elements(drawn, "residual")
    x1, y1, x2, y2 = (float(line.get(name, "")) for name in ("x1", "y1", "x2", "y2"))
    assert len(rest) == 11
    assert math.dist((x1, y1), (x2, y2)) == pytest.approx(50 * 0.5 * 900 / 640, abs=0.02)
    assert legend(drawn).endswith("residuals (red) 50 times larger than they are, 0.500 px rms")


def test_preview_of_a_perfect_fit_enlarges_nothing() -> None:
    one = view()
    assert "(red) 1 times larger than they are, 0.000 px rms" in legend(
        draw_preview(GREY, view=one, predicted=one.points)
    )


def test_preview_counts_the_cells_of_all_views() -> None:
    drawn = draw_preview(GREY, view=view(0, 479, 10), earlier=[view(0, 479, 10), view(600, 50, 10)])
    assert len(elements(drawn, "covered")) == 2
    assert legend(drawn) == "12 of 12 points; 2 of 48 cells seen by 3 views"


def test_preview_without_a_view_reports_that_no_target_was_found() -> None:
    drawn = draw_preview(GREY, earlier=[view()])
    assert elements(drawn, "point") == []
    assert legend(drawn).startswith("no target found; ")
    assert legend(drawn).endswith(" of 48 cells seen by 1 view")


def test_preview_names_the_axes_at_their_ends() -> None:
    drawn = draw_preview(GREY, axes=[(100, 400), (160, 400), (100, 340), (90, 410)])
    assert [one.text for one in elements(drawn, "name")] == ["x", "y", "z"]
    (x,) = elements(drawn, "x")
    assert x.get("x2") == f"{20 + 160.5 * 900 / 640:.2f}"


def test_cell_counts_counts_points_in_cells_of_the_image() -> None:
    counts = cell_counts([view(-0.5, 479, 80)])  # one in each of four columns, in three rows
    assert counts.shape == (6, 8)
    assert counts[3:, :4].tolist() == [[1] * 4] * 3
    assert counts.sum() == 12


def test_cell_counts_leaves_out_points_outside_of_the_image() -> None:
    assert cell_counts([view(-5000)]).sum() == 0
    assert cell_counts([]).sum() == 0


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"view": view(size=(320, 240))}, "a view of an image of 640 x 480 pixels, got one of 320"),
        ({"view": view(), "predicted": [(1, 2)]}, "preview: expected 12 points, got 1"),
        ({"axes": [(1, 2)] * 3}, "preview: expected 4 points, got 3"),
        ({"suggested": [1, 2, 3]}, "suggested outline"),
    ],
)
def test_preview_of_contradictory_arguments_is_refused(options: dict[str, Any], text: str) -> None:
    with pytest.raises(CalibrationError, match=text) as caught:
        draw_preview(GREY, **options)
    assert caught.value.code == Code.SHAPE


def test_preview_of_no_image_is_refused() -> None:
    with pytest.raises(CalibrationError, match="image: expected an array of uint8 or uint16"):
        draw_preview(np.zeros((4, 4)))


# ----------------------------------------------------------------------
# The data of pictures of touches: places, the view, the map of predicted errors.


SCENE = Scene(SPECIAL[3], np.array([1.0, -2.0, 0.5]))


def touches(marks: Array, places: Array) -> list[Touch]:
    return [
        Touch(Mark("mark", u, v, 0.0), (x, y, z), None)
        for (u, v), (x, y, z) in zip(marks.tolist(), places.tolist(), strict=True)
    ]


def calibrated(marks: Array = GRID, **options: Any) -> PlaneCalibration:
    return fit_plane(marks, SCENE.touched(marks, 1), model="similarity", **options)


def preview_of(found: PlaneCalibration) -> dict[str, Any]:
    done = touches(found.camera_points, found.robot_points)
    return compare_touches(
        found, done, found.camera_points, found.residuals, found.leave_one_out, worst=2
    )


def middles(preview: dict[str, Any]) -> Array:
    """Return the middles (rows, columns, 2) of the heat map's cells, in the plane."""
    low, high = np.array(preview["view"])
    rows, columns = len(preview["heat"]), len(preview["heat"][0])
    x = low[0] + (np.arange(columns) + 0.5) * (high - low)[0] / columns
    y = low[1] + (np.arange(rows) + 0.5) * (high - low)[1] / rows
    return np.stack(np.meshgrid(x, y), axis=-1)


def test_compared_heat_is_the_predicted_error_at_each_cell() -> None:
    found = calibrated(touch_sigma=SIGMA)
    preview = preview_of(found)
    assert preview["worst"] == 2
    assert json.loads(json.dumps(preview, allow_nan=False)) == preview
    cells = middles(preview)
    assert max(cells.shape[:2]) == HEAT_MAP_CELLS
    across, centre = found.rotation, found.robot_points.mean(axis=0)
    places = cells.reshape(-1, 2) @ across[:, :2].T + centre
    expected = 1e3 * found.predicted_error(found.inverse(places))
    assert np.ravel(preview["heat"]) == pytest.approx(expected, abs=1e-5)


def test_compared_view_has_all_points_and_the_origin_that_is_near() -> None:
    preview = preview_of(calibrated(GRID + 0.05, touch_sigma=SIGMA))
    (left, bottom), (right, top) = preview["view"]
    x, y, _ = preview["camera_origin"]
    assert left < x < right
    assert bottom < y < top
    assert all(left < one["at"][0] < right for one in preview["points"])


def test_compared_view_leaves_an_origin_that_is_far_away() -> None:
    preview = preview_of(calibrated(GRID + 3.0, touch_sigma=SIGMA))
    assert np.ptp(preview["view"], axis=0) == pytest.approx([0.45, 0.39], abs=0.01)
    assert np.linalg.norm(preview["camera_origin"]) > 4


def test_compared_without_a_sigma_has_no_heat_and_no_covariance() -> None:
    marks = GRID[[0, 2, 6]]
    found = replace(calibrated(marks), touch_sigma=None)
    preview = preview_of(found)
    assert preview["heat"] is None
    assert [one["covariance"] for one in preview["points"]] == [None] * 3


@pytest.mark.parametrize(("off", "shown"), [(0.02, True), (1000.0, False)])
def test_compared_marks_left_out_points_and_does_not_count_them(off: float, shown: bool) -> None:
    touched = SCENE.touched(GRID, 1)
    touched[2] += off * SCENE.turn[:, 0]
    found = fit_plane(GRID, touched, touch_sigma=SIGMA, model="similarity", robust=True)
    assert found.outliers == (2,)
    done = touches(GRID, touched)
    preview = compare_touches(
        found, done, GRID, found.residuals, found.leave_one_out, worst=found.worst, excluded=(2,)
    )
    (one,) = (point for point in preview["points"] if point["left_out"])
    assert (one["label"], one["held_out"], one["covariance"]) == ("3", None, None)
    low, high = np.array(preview["view"])
    at = np.array(one["at"][:2])
    assert ((low < at) & (at < high)).all() == shown
    assert (high - low).max() < 0.6


def test_compared_beyond_the_horizon_has_no_heat() -> None:
    seen = GRID / (1.0 + 2.5 * GRID[:, :1])
    found = fit_plane(seen, SCENE.robot(GRID), touch_sigma=SIGMA, model="homography")
    far = touches(seen[:1], SCENE.robot(np.array([[-0.6, 0.0]])))
    preview = compare_touches(found, far, seen[:1], np.ones((1, 3)), worst=0)
    assert preview["heat"] is None
    assert preview["points"][0]["held_out"] is None


def test_before_shows_marks_and_the_next_one() -> None:
    done = touches(GRID[:1], SCENE.robot(GRID[:1]))
    mark, other = Mark("a", 0.1, 0.2, 0.0), Mark("b", 0.3, 0.4, 0.0)
    assert next_touch_preview(done, [mark, other], other) == {
        **touch_points(done), "marks": [[0.1, 0.2], [0.3, 0.4]], "next": [0.3, 0.4],
    }  # fmt: skip
    assert next_touch_preview(done, [], other) is None


# ----------------------------------------------------------------------
# Outlines of the next view: they fit into the image, and differ.


BOARD = Checkerboard(columns=9, rows=6, square=0.025)
SIZE = (640, 480)


@pytest.mark.parametrize("look", STANDARD_VIEWS, ids=lambda look: look.text[:20])
def test_outline_fills_its_part_of_the_image(look: Look) -> None:
    found = outline(look, BOARD, SIZE)
    assert (np.ptp(found, axis=0) / SIZE).max() == pytest.approx(look.fill, abs=0.01)
    assert ((found >= 0) & (found <= SIZE)).all()
    (ax, ay), (bx, by) = found[1] - found[0], found[3] - found[0]
    assert ax * by - ay * bx < 0  # seen from the front: y up on the sheet, v down


def test_outline_from_the_front_is_upright_or_turned_by_a_quarter() -> None:
    straight, turned = (outline(STANDARD_VIEWS[one], BOARD, SIZE) for one in (0, 5))
    assert straight[0] == pytest.approx([128, 360])
    assert straight[2] == pytest.approx([512, 120])
    assert np.ptp(turned, axis=0)[0] < np.ptp(turned, axis=0)[1]


def test_outline_tilted_is_nearer_on_one_side() -> None:
    widths = [np.ptp(outline(STANDARD_VIEWS[one], BOARD, SIZE)[:2, 0]) for one in (1, 2)]
    assert abs(widths[0] - widths[1]) > 30
