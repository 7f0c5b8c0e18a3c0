"""What pictures of touches are drawn from: places, the view, the map of predicted errors."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from planekit import GRID, SIGMA, SPECIAL, Scene

from smartcam.calibration.plane.calibration import PlaneCalibration, fit_plane
from smartcam.calibration.wizards.marks import Mark, Touch
from smartcam.calibration.wizards.plane_drawing import CELLS, before, compared, plain

if TYPE_CHECKING:
    from smartcam.calibration.geometry.rotations import Array

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
    return compared(found, done, found.camera_points, found.residuals, found.leave_one_out, worst=2)


def middles(preview: dict[str, Any]) -> Array:
    """Return where the middles of the heat map's cells lie (rows, columns, 2), in the plane."""
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
    assert max(cells.shape[:2]) == CELLS
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
def test_compared_marks_what_is_left_out_and_counts_it_nowhere(off: float, shown: bool) -> None:
    touched = SCENE.touched(GRID, 1)
    touched[2] += off * SCENE.turn[:, 0]
    found = fit_plane(GRID, touched, touch_sigma=SIGMA, model="similarity", robust=True)
    assert found.outliers == (2,)
    done = touches(GRID, touched)
    preview = compared(
        found, done, GRID, found.residuals, found.leave_one_out, worst=found.worst, left_out=(2,)
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
    preview = compared(found, far, seen[:1], np.ones((1, 3)), worst=0)
    assert preview["heat"] is None
    assert preview["points"][0]["held_out"] is None


def test_before_shows_marks_and_the_next_one() -> None:
    done = touches(GRID[:1], SCENE.robot(GRID[:1]))
    mark, other = Mark("a", 0.1, 0.2, 0.0), Mark("b", 0.3, 0.4, 0.0)
    assert before(done, [mark, other], other) == {
        **plain(done), "marks": [[0.1, 0.2], [0.3, 0.4]], "next": [0.3, 0.4],
    }  # fmt: skip
    assert before(done, [], other) is None
