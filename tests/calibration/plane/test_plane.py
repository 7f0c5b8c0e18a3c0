from __future__ import annotations

import json
import math
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from smartcam import CalibrationError
from smartcam.calibration import PlaneCalibration, fit_plane
from smartcam.geometry._inside import Array, matrix_from_quaternion
from tests.calibration.plane.planekit import GRID, SIGMA, SPECIAL, Scene, grid, part, spread

SCENE = Scene(SPECIAL[3], np.array([1.0, -2.0, 0.5]))
DOWN = -SCENE.turn[:, 2]
CORNERS = grid(2, 2)


def tilted(degrees: float) -> Array:
    """Return a tilted camera's coordinates of the grid, pixels of about 0.42 mm."""
    sin, cos = math.sin(math.radians(degrees)), math.cos(math.radians(degrees))
    marks = GRID - (0.15, 0.12)
    pixels: Array = 1200.0 * np.column_stack([marks[:, 0] * cos, marks[:, 1]])
    return pixels / (0.5 + marks[:, :1] * sin) + (640.0, 480.0)


def said(found: PlaneCalibration, code: str) -> str:
    """Return the text of a calibration's one warning with a code."""
    (text,) = [one.text for one in found.warnings if one.code == code]
    return text


def healthy(**options: Any) -> PlaneCalibration:
    return fit_plane(GRID, SCENE.touched(GRID, 1), tool_z=DOWN, touch_sigma=SIGMA, **options)


def test_fit_plane_healthy_points_choose_similarity_without_warnings() -> None:
    found = healthy()
    assert found.model == "similarity"
    assert found.warnings == ()
    assert set(found.candidate_errors) == {"similarity", "affine", "homography"}
    assert found.candidate_errors["similarity"] == pytest.approx(found.held_out_error)
    assert found.scale == pytest.approx(1.0, abs=0.005)


def test_fit_plane_with_nominal_scale_chooses_rigid() -> None:
    found = healthy(nominal_scale=1.0)
    assert found.model == "rigid"
    assert found.scale == pytest.approx(1.0, abs=1e-12)


def test_fit_plane_with_a_sheet_printed_small_does_not_choose_rigid() -> None:
    found = fit_plane(GRID, SCENE.touched(0.97 * GRID, 1), nominal_scale=1.0, tool_z=DOWN)
    assert found.model == "similarity"
    assert [one.code for one in found.warnings] == ["SCALE_MISMATCH"]
    assert "expected 1 m for each unit of the camera, got 0.9697" in found.warnings[0].text


@pytest.mark.parametrize("degrees", [1.0, 3.0, 5.0])
def test_fit_plane_of_a_tilted_camera_chooses_homography(degrees: float) -> None:
    found = fit_plane(tilted(degrees), SCENE.touched(GRID, 1, 5e-5), touch_sigma=5e-5, tool_z=DOWN)
    assert found.model == "homography"
    assert [one.code for one in found.warnings] == ["NOT_SIMILAR"]
    assert spread(found.transform(tilted(degrees)), SCENE.robot(GRID)) < 2e-4


def test_fit_plane_similarity_of_a_tilted_camera_warns() -> None:
    found = fit_plane(tilted(3.0), SCENE.touched(GRID, 1), model="similarity", tool_z=DOWN)
    assert [one.code for one in found.warnings] == ["POOR_FIT", "NOT_SIMILAR"]
    assert found.warnings[1].text.endswith("its lens distorts; similarity was asked for")


@pytest.mark.long
def test_fit_plane_chooses_a_wrong_model_seldom() -> None:
    chosen = [
        fit_plane(GRID, SCENE.touched(GRID, seed), touch_sigma=SIGMA).model for seed in range(100)
    ]
    assert chosen.count("similarity") >= 96


def test_fit_plane_auto_leaves_out_a_model_that_is_not_determined() -> None:
    marks = np.array([[0.0, 0.0], [0.1, 0.0], [0.2, 0.0], [0.3, 0.0], [0.1, 0.2]])
    found = fit_plane(marks, SCENE.touched(marks, 1), tool_z=DOWN, touch_sigma=SIGMA)
    assert found.model == "similarity"
    assert found.candidate_errors["homography"] is None
    assert "without point 5 the others give no" in said(found, "NOT_HELD_OUT")


def test_fit_plane_weights_move_the_map_to_the_point() -> None:
    touches = SCENE.touched(GRID, 1)
    even, heavy = (
        fit_plane(GRID, touches, weights=[weight] + [1] * 8, model="similarity")
        for weight in (1.0, 100.0)
    )
    off = [np.linalg.norm(one.residuals[0]) for one in (even, heavy)]
    assert off[1] < 0.2 * off[0]


@pytest.mark.parametrize("seen_again", [0.0, 1e-4])
def test_fit_plane_counts_repeated_touches_once(seen_again: float) -> None:
    """The camera's part of a point's error is in all of its touches, as the robot's in pictures."""
    touches, again = SCENE.touched(GRID, 1), np.repeat(np.arange(9), 3)
    seen = GRID[again] + seen_again * np.tile([-1.0, 0.0, 1.0], 9)[:, None]
    once = fit_plane(GRID, touches, tool_z=DOWN)
    thrice = fit_plane(seen, touches[again], tool_z=DOWN)
    assert spread(thrice.transform(GRID), once.transform(GRID)) < 1e-12
    assert thrice.freedom == once.freedom
    assert thrice.touch_sigma == pytest.approx(once.touch_sigma)
    assert thrice.held_out_error == pytest.approx(once.held_out_error)
    assert np.allclose(thrice.leave_one_out, once.leave_one_out[again])


def test_fit_plane_of_contradictory_touches_of_one_point_has_a_remark() -> None:
    again = [*range(9), 4]
    touches = SCENE.touched(GRID, 1)[again]
    touches[9] += 0.02 * SCENE.turn[:, 0]
    found = fit_plane(GRID[again], touches, tool_z=DOWN)
    assert any("was touched 10 mm from the mean of its" in one.text for one in found.warnings)
    assert found.verdict.level == "poor"


def test_fit_plane_of_three_points_recorded_thrice_promises_nothing() -> None:
    again = np.repeat([0, 2, 6], 3)
    found = fit_plane(GRID[again], SCENE.touched(GRID, 1)[again], tool_z=DOWN)
    assert found.held_out_error is None
    assert found.predicted_error(GRID).min() > 1e-4
    assert found.verdict.level == "unknown"


REFUSED: list[tuple[Any, Any, dict[str, Any], str, str]] = [
    (GRID[:2], GRID[:2], {}, "TOO_FEW", "expected at least 3 points, got 2"),
    (GRID[:3], GRID[:3], {"model": "homography"}, "TOO_FEW", "at least 4 points, got 3"),
    (GRID, GRID[:8], {}, "SHAPE", r"as many robot points as camera points \(9\), got 8"),
    (GRID[[0, 1, 0]], GRID[[0, 1, 3]], {}, "COINCIDENT", "camera points: .* different ones, got 2"),
    (GRID[[0, 1, 3]], GRID[[0, 1, 1]], {}, "COINCIDENT", "robot points: .* different ones, got 2"),
    (GRID[:3], CORNERS[:3], {}, "COLLINEAR", "camera points: .* nearly in a line"),
    (CORNERS[:3], GRID[:3], {}, "COLLINEAR", "robot points: .* nearly in a line"),
    (CORNERS, CORNERS, {"touch_sigma": 0.013}, "SHORT_LEVER", r"\(260 mm\).*got 240 mm"),
    (GRID, GRID, {"touch_sigma": -1.0}, "NOT_FINITE", "expected a positive number of metres"),
    (GRID, GRID, {"nominal_scale": 0.0}, "NOT_FINITE", "nominal_scale: expected a positive number"),
    (GRID, GRID, {"weights": [1.0] * 8}, "SHAPE", "weights: expected 9 positive numbers"),
    (GRID, GRID, {"weights": [0.0] * 9}, "SHAPE", "weights: expected 9 positive numbers"),
    (GRID, GRID, {"tool_z": SCENE.turn[:, 2]}, "MIRRORED", "y axis points the wrong way"),
    (GRID, GRID, {"tool_z": [0, 0, 0]}, "COINCIDENT", "tool axis: expected a direction"),
    (GRID, 0.9 * GRID, {"model": "rigid"}, "SCALE_MISMATCH", r"got 0.9 \(-10 %\)"),
    (1e3 * GRID, GRID, {"nominal_scale": 1.0}, "SCALE_MISMATCH", r"got 0.001 \(-100 %\)"),
    (GRID * math.nan, GRID, {}, "NOT_FINITE", "camera points: expected finite numbers"),
]


@pytest.mark.parametrize(("seen", "marks", "options", "code", "text"), REFUSED)
def test_fit_plane_of_useless_points_raises(
    seen: Array, marks: Array, options: dict[str, Any], code: str, text: str
) -> None:
    with pytest.raises(CalibrationError, match=text) as caught:
        fit_plane(seen, SCENE.robot(marks), **options)
    assert caught.value.code == code
    assert pickle.loads(pickle.dumps(caught.value)).code == code  # noqa: S301  our own


def test_fit_plane_of_points_in_space_raises() -> None:
    touches = SCENE.robot(GRID)
    touches[4] += 0.5 * SCENE.turn[:, 2]
    with pytest.raises(CalibrationError, match="robot points: expected a plane") as caught:
        fit_plane(GRID, touches)
    assert caught.value.code == "NOT_PLANAR"


def test_fit_plane_of_an_unknown_model_raises() -> None:
    with pytest.raises(ValueError, match=r"model: expected auto, rigid, .*, got 'cubic'"):
        fit_plane(GRID, SCENE.robot(GRID), model="cubic")  # type: ignore[arg-type]


@pytest.mark.parametrize("index", range(9))
def test_fit_plane_with_a_bump_of_2_mm_names_it(index: int) -> None:
    touches = SCENE.touched(GRID, 1)
    touches[index] += 0.002 * SCENE.turn[:, 2]
    text = said(fit_plane(GRID, touches, touch_sigma=SIGMA, tool_z=DOWN), "NOT_PLANAR")
    assert f"point {1 + index} is the furthest" in text


@pytest.mark.long
def test_fit_plane_with_a_bump_of_1_mm_in_the_middle_usually_warns() -> None:
    found = 0
    for seed in range(100):
        touches = SCENE.touched(GRID, seed)
        touches[4] += 0.001 * SCENE.turn[:, 2]
        one = fit_plane(GRID, touches, touch_sigma=SIGMA, model="similarity")
        found += "NOT_PLANAR" in {remark.code for remark in one.warnings}
    assert found >= 85


def test_fit_plane_with_an_outlier_names_it() -> None:
    touches = SCENE.touched(GRID, 1)
    touches[7] += 0.005 * SCENE.turn[:, 0]
    for sigma in (None, SIGMA):
        found = fit_plane(GRID, touches, touch_sigma=sigma, tool_z=DOWN, model="similarity")
        assert found.worst == 7
        assert "point 8 fits far worse" in said(found, "OUTLIER")


def test_fit_plane_with_worse_touches_than_given_warns() -> None:
    found = fit_plane(
        GRID, SCENE.touched(GRID, 1), touch_sigma=0.5 * SIGMA, tool_z=DOWN, model="similarity"
    )
    assert said(found, "POOR_FIT").endswith("where 0.1 mm was given")


def test_fit_plane_of_three_points_reports_that_it_is_unverified() -> None:
    found = fit_plane(CORNERS[:3], SCENE.touched(CORNERS[:3], 1))
    assert [one.code for one in found.warnings] == ["NOT_HELD_OUT", "UNVERIFIED", "SIDE_UNKNOWN"]
    assert found.held_out_error is None
    assert np.isnan(found.leave_one_out).all()


def test_fit_plane_with_a_tool_along_the_plane_does_not_tell_the_side() -> None:
    found = fit_plane(GRID, SCENE.touched(GRID, 1), tool_z=[SCENE.turn[:, 0]] * 9)
    assert [one.code for one in found.warnings] == ["SIDE_UNKNOWN"]


def test_residuals_are_touched_minus_mapped() -> None:
    found = healthy()
    assert found.residuals == pytest.approx(found.robot_points - found.transform(GRID), abs=1e-15)
    assert found.touch_sigma == SIGMA
    assert not found.residuals.flags.writeable


def test_touch_sigma_not_given_is_estimated() -> None:
    marks = grid(12, 12)
    found = fit_plane(marks, SCENE.touched(marks, 1), model="similarity")
    assert found.touch_sigma == pytest.approx(SIGMA, rel=0.1)
    assert not found.sigma_given


def test_predicted_error_equals_the_known_bound() -> None:
    found, place = healthy(model="similarity"), np.array([0.05, 0.2])
    centre = GRID.mean(axis=0)
    lever, spread_ = place - centre, GRID - centre
    inside = 2 / 9 + 2 * (lever @ lever) / (spread_**2).sum()
    out = 1 / 9 + lever @ np.linalg.solve(spread_.T @ spread_, lever)
    expected = SIGMA * math.sqrt(inside + out)
    assert found.predicted_error([place])[0] == pytest.approx(expected, rel=0.01)
    axes = found.rotation.T @ found.covariance_at([place])[0] @ found.rotation
    assert axes[2, 2] == pytest.approx(SIGMA**2 * out, rel=0.01)


@pytest.mark.long
@pytest.mark.parametrize("model", ["rigid", "similarity", "affine", "homography"])
def test_predicted_error_equals_the_observed_one(model: Any) -> None:
    places = np.array([[0.0, 0.0], [0.15, 0.12], [0.35, 0.1]])
    found = [
        fit_plane(GRID, SCENE.touched(GRID, seed), model=model, touch_sigma=SIGMA)
        for seed in range(200)
    ]
    errors = np.array([one.transform(places) - SCENE.robot(places) for one in found])
    observed = np.sqrt((errors**2).sum(axis=2).mean(axis=0))
    assert found[0].predicted_error(places) == pytest.approx(observed, rel=0.12)


def test_predicted_error_without_any_sigma_raises() -> None:
    found = fit_plane(CORNERS[:3], SCENE.robot(CORNERS[:3]), model="affine")
    assert found.touch_sigma is None
    with pytest.raises(CalibrationError, match="expected touch_sigma, or more") as caught:
        found.predicted_error(CORNERS)
    assert caught.value.code == "UNVERIFIED"


def test_predicted_error_of_no_points_is_empty() -> None:
    assert healthy().predicted_error(np.zeros((0, 2))).shape == (0,)


def test_check_of_a_knock_finds_it_stale() -> None:
    found = healthy()
    drift = found.check([0.1, 0.1], SCENE.robot(np.array([[0.1, 0.1]]))[0] + [0, 0.0012, 0])
    assert drift.stale
    assert drift.z > 3
    assert drift.expected == pytest.approx(math.sqrt(3 + 5 / 9) * SIGMA, rel=0.1)


@pytest.mark.long
def test_check_of_an_unchanged_cell_is_stale_at_the_stated_rate() -> None:
    stale, knocked = 0, 0
    marks = GRID[[0, 4, 8]]
    for seed in range(300):
        found = fit_plane(GRID, SCENE.touched(GRID, seed), touch_sigma=SIGMA, model="similarity")
        again = SCENE.touched(marks, seed + 1000)
        stale += found.check(marks, again).stale
        knocked += found.check(marks, again + np.array([0.001, 0, 0])).stale
    assert stale <= 9
    assert knocked >= 290


@pytest.mark.long
def test_check_of_one_mark_again_and_again_sees_a_shift_the_better() -> None:
    knocked, sigma = 0, 1.4 * SIGMA
    corner = GRID[[0] * 5]
    for seed in range(200):
        touches = SCENE.touched(GRID, seed, sigma)
        found = fit_plane(GRID, touches, touch_sigma=sigma, model="similarity")
        again = SCENE.touched(corner, seed + 5000, sigma) + 0.001 * SCENE.turn[:, 2]
        knocked += found.check(corner, again).stale
    assert knocked >= 160  # the 15 coordinates without the one shift: 130


def test_check_of_one_touch_far_off_among_many_finds_it_stale() -> None:
    again = SCENE.touched(GRID, 7)
    again[4] += 0.002 * SCENE.turn[:, 0]
    assert healthy().check(GRID, again).stale


def test_check_with_an_estimated_sigma_allows_for_its_uncertainty() -> None:
    found = fit_plane(CORNERS, SCENE.touched(CORNERS, 3), model="similarity")
    given = fit_plane(
        CORNERS, SCENE.touched(CORNERS, 3), model="similarity", touch_sigma=found.touch_sigma
    )
    knocked = SCENE.robot(CORNERS)[:1] + 5e-4
    assert found.check(CORNERS[:1], knocked).chance > given.check(CORNERS[:1], knocked).chance


def test_check_of_points_that_do_not_pair_raises() -> None:
    with pytest.raises(CalibrationError, match=r"camera points \(2\), one at least, got 1"):
        healthy().check(GRID[:2], SCENE.robot(GRID[:1]))


@pytest.mark.parametrize("y_down", [True, False, None])
def test_fit_plane_y_down_is_kept_in_all_derived_calibrations(y_down: bool | None) -> None:
    found = fit_plane(GRID, SCENE.robot(GRID), y_down=y_down)
    raised = found.at_height(0.02, SCENE.origin + SCENE.turn[:, 2])
    again = PlaneCalibration.from_data(json.loads(json.dumps(raised.to_data())))
    assert (found.y_down, raised.y_down, again.y_down) == (y_down,) * 3
    assert found.matrix.tobytes() == fit_plane(GRID, SCENE.robot(GRID)).matrix.tobytes()


def test_from_data_of_a_file_without_y_down_leaves_it_unknown() -> None:
    data = fit_plane(GRID, SCENE.robot(GRID), y_down=True).to_data()
    del data["y_down"]
    assert PlaneCalibration.from_data(data).y_down is None
    with pytest.raises(CalibrationError, match="stored plane calibration: y_down: ") as caught:
        PlaneCalibration.from_data({**data, "y_down": "yes"})
    assert caught.value.code == "SHAPE"


def test_at_height_puts_the_point_on_the_ray() -> None:
    marks, camera = np.array([[0.15, 0.0], [0.3, 0.2]]), SCENE.origin + 0.5 * SCENE.turn[:, 2]
    found = fit_plane(GRID, SCENE.robot(GRID), touch_sigma=SIGMA).at_height(0.02, camera)
    top = SCENE.robot(marks) + 0.02 * SCENE.turn[:, 2]
    seen = SCENE.robot(marks)[:, :] - camera
    on_ray = camera + seen * (0.48 / 0.5)
    assert found.transform(marks) == pytest.approx(on_ray, abs=1e-12)
    assert np.linalg.norm(found.transform(marks) - top, axis=1)[0] == pytest.approx(0.006)
    assert found.predicted_error(GRID) == pytest.approx(
        0.96 * healthy().predicted_error(GRID), rel=0.01
    )
    assert found.height == 0.02
    assert found.inverse(on_ray) == pytest.approx(marks, abs=1e-12)


def test_at_height_above_the_camera_raises() -> None:
    with pytest.raises(CalibrationError, match=r"a height below the camera's \(0.5 m\)") as caught:
        healthy().at_height(0.6, healthy().transform([[0.1, 0.1]])[0] + 0.5 * healthy().normal)
    assert caught.value.code == "OUT_OF_FIELD"


def test_to_robot_keeps_all_fields_but_the_pose() -> None:
    found = healthy(robot_frame="base").to_robot(part(0.1, 0.1, 0.5))
    assert (found.feature_id, found.quality, found.photo_index) == ("cube", 0.9, 1)
    assert (found.pose.header.seq, found.pose.header.frame_id) == (7, "base")


def test_to_robot_with_tool_flip_points_into_the_plane() -> None:
    found = healthy()
    plain = matrix_from_quaternion(found.to_robot(part(0.1, 0.1, 0.5)).pose.orientation)
    flipped = found.to_robot(part(0.1, 0.1, 0.5), tool_flip=True).pose.orientation
    assert matrix_from_quaternion(flipped) == pytest.approx(plain * [1, -1, -1])


def test_to_robot_of_a_tilted_camera_heads_along_the_mapped_direction() -> None:
    found = fit_plane(tilted(20.0), SCENE.robot(GRID), model="homography")
    u, v = tilted(20.0)[8]
    pose = found.to_robot(part(float(u), float(v), 0.7)).pose
    step = 1e-4 * np.array([math.cos(0.7), math.sin(0.7)])
    ahead, here = found.transform(np.array([u, v]) + np.array([step, -step]))
    assert matrix_from_quaternion(pose.orientation)[:, 0] == pytest.approx(
        (ahead - here) / np.linalg.norm(ahead - here), abs=1e-6
    )
    assert pose.position == pytest.approx(tuple(SCENE.robot(GRID)[8]))


def test_to_robot_from_another_frame_raises() -> None:
    with pytest.raises(CalibrationError, match="frame 'left', got one in 'camera'") as caught:
        healthy(camera_frame="left").to_robot([part(0.1, 0.1)])
    assert caught.value.code == "WRONG_FRAME"


def test_to_robot_of_a_pose_out_of_the_plane_raises() -> None:
    lying = part(0.1, 0.1)
    above = lying._replace(pose=lying.pose._replace(position=lying.pose.position._replace(z=0.01)))
    with pytest.raises(CalibrationError, match="a pose in the camera's plane") as caught:
        healthy().to_robot([lying, above])
    assert caught.value.code == "OUT_OF_PLANE"


@pytest.mark.parametrize("count", [1, 100_000])
@pytest.mark.parametrize("columns", [2, 3])
def test_transform_behind_the_horizon_raises(count: int, columns: int) -> None:
    found = fit_plane(tilted(40.0), SCENE.robot(GRID), model="homography")
    seen = np.ones((count, columns)) * [640.0, 480.0, 1.0][:columns]
    assert found.transform(seen)[-1] == pytest.approx(SCENE.robot(np.array([[0.15, 0.12]]))[0])
    seen[-1, 0] = 1e5
    with pytest.raises(CalibrationError, match="behind its horizon") as caught:
        found.transform(seen)
    assert caught.value.code == "OUT_OF_FIELD"
    with pytest.raises(CalibrationError, match="behind its horizon"):
        found.to_robot(part(1e5, 480.0))


@pytest.mark.parametrize("columns", [2, 3])
@pytest.mark.parametrize("model", ["similarity", "homography"])
def test_transform_of_many_equals_a_few_at_a_time(model: Any, columns: int) -> None:
    found = fit_plane(tilted(3.0), SCENE.touched(GRID, 1), model=model)
    seen = np.random.default_rng(1).uniform(0, 1000, size=(70_000, columns))
    seen[:, 2:] = 1.0
    few = np.concatenate([found.transform(part) for part in np.array_split(seen, 140)])
    out = np.empty_like(few)
    assert found.transform(seen, out) is out
    np.testing.assert_allclose(out, few, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.transform(seen[::2]), few[::2], rtol=0, atol=1e-12)


@pytest.mark.parametrize("points", [[1.0, 2.0], [[1.0]], [[1.0, 2.0, 1.0, 4.0]]])
def test_transform_of_another_shape_raises(points: Any) -> None:
    with pytest.raises(CalibrationError, match=r"camera points: expected shape \(N, 2\)"):
        healthy().transform(points)


def test_transform_into_an_unfit_array_raises() -> None:
    with pytest.raises(CalibrationError, match=r"out: expected a contiguous float64 array"):
        healthy().transform(GRID, np.empty((9, 3), order="F"))


def test_transform_of_no_points_is_empty() -> None:
    assert healthy().transform(np.zeros((0, 2))).shape == (0, 3)


def test_inverse_behind_the_camera_raises() -> None:
    found = fit_plane(tilted(40.0), SCENE.robot(GRID), model="homography")
    with pytest.raises(CalibrationError, match="behind its horizon"):
        found.inverse(SCENE.robot(np.array([[-3.0, 0.1]])))


def test_inverse_of_a_point_beside_the_plane_is_its_foot() -> None:
    found = fit_plane(GRID, SCENE.robot(GRID))
    assert found.inverse(SCENE.robot(GRID) + 0.1 * SCENE.turn[:, 2]) == pytest.approx(GRID)


def test_save_and_load_give_the_same_bits(tmp_path: Path) -> None:
    found = fit_plane(CORNERS[:3], SCENE.touched(CORNERS[:3], 1), touch_sigma=SIGMA)
    found.save(tmp_path / "table.json")
    assert PlaneCalibration.load(tmp_path / "table.json").to_data() == found.to_data()


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"weights": [1.0] * 8}, "weights: expected 9"),
        ({"unit_covariance": [[0.0] * 11] * 12}, "unit_covariance: expected rows of 12"),
        ({"matrix": None}, "matrix: Input should be a valid tuple"),
        ({"colour": "red"}, "colour: Extra inputs are not permitted"),
        ({"robot_points": [[math.nan] * 3] * 9}, "finite number"),
    ],
)
def test_from_data_of_something_else_raises(change: dict[str, Any], text: str) -> None:
    data = json.loads(json.dumps(healthy().to_data()))
    with pytest.raises(CalibrationError, match=f"stored plane calibration: .*{text}") as caught:
        PlaneCalibration.from_data(data | change)
    assert caught.value.code == "SHAPE"


@pytest.mark.parametrize("level", [0.0, 1.0, 2.0, math.nan])
def test_check_with_an_invalid_level_raises(level: float) -> None:
    found = fit_plane(GRID, np.column_stack([GRID, np.zeros(len(GRID))]), touch_sigma=SIGMA)
    with pytest.raises(
        CalibrationError, match="level: expected a number between 0 and 1"
    ) as caught:
        found.check(GRID[0], (*GRID[0], 0.0), level=level)
    assert caught.value.code == "NOT_FINITE"


@pytest.mark.parametrize(
    ("scale", "code"), [(1e300, "NOT_FINITE"), (1e-120, "COINCIDENT"), (1e-300, "COINCIDENT")]
)
def test_fit_plane_of_points_whose_squares_are_no_numbers_raises(scale: float, code: str) -> None:
    with pytest.raises(CalibrationError, match="camera points: expected") as caught:
        fit_plane(scale * GRID, np.column_stack([GRID, np.zeros(len(GRID))]))
    assert caught.value.code == code
