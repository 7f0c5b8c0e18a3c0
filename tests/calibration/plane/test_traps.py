"""The traps of the thesis' mathematics, T1 to T23, and a test for each.

Short tests about planes are in this file; for other traps the table names the tests. T7, exchanged
names in a listing, cannot occur here. T18 is about images of marks.
"""

from __future__ import annotations

import math
import re

import numpy as np
import pytest

from smartcam.calibration import PlaneCalibration, fit_plane, fit_touches
from smartcam.geometry._inside import Array, matrix_from_quaternion
from tests import ROOT
from tests.calibration.plane.planekit import GRID, SIGMA, SPECIAL, Scene, grid, part, spread
from tests.geometry.rigid import AXES, rotation_about, yaw

ELSEWHERE = {
    "t4": ("test_camera_position_subtracts_before_it_turns", "test_plane_p1_*"),
    "t5": ("test_rotate_ccw_quarter_turn_takes_x_to_y",),
    "t5b": ("test_plane_p12_*",),
    "t6": ("test_plane_p11_*", "test_chain_zero_vector_is_finite"),
    "t6b": ("test_quaternion_multiply_equals_scipy", "test_transform_of_no_quaternion_*"),
    "t6c": ("test_rotate_equals_scipy", "test_quaternion_from_matrix_*"),
    "t9": ("test_fit_plane_with_a_sheet_printed_small_does_not_choose_rigid",),
    "t10": ("test_plane_p13_*", "test_fit_touches_of_one_ray_twice_raises"),
    "t11b": ("test_camera_position_origin_becomes_zero_and_its_angle_nothing",),
    "t13": ("test_at_height_puts_the_point_on_the_ray", "test_height_moves_along_the_ray_*"),
    "t14": ("test_tool_tip_error_that_was_found_is_gone_at_every_yaw",),
    "t15": ("test_moved_before_the_chain_is_wrong", "test_plane_p15_*"),
    "t15b": ("test_moving_camera_whose_plane_moves_is_refused", "test_moving_pinhole_*"),
    "t16": ("test_moving_camera_image_and_pose_must_*", "test_transform_between_is_scipys_slerp"),
    "t17": ("test_fit_touches_uncertain_theta_counts_with_distance",),
    "t19": ("test_octant_*", "test_plane_properties_each_number_has_a_test"),
    "t21": ("test_to_robot_from_another_frame_raises", "test_transform_wrong_way_round_is_refused"),
    "t22": ("test_fit_touches_of_swapped_rays_is_mirrored", "test_to_robot_with_tool_flip_*"),
}
"""Places of the traps' tests in other files; ``*`` is any ending."""

TRAPS = [*(f"t{number}" for number in range(1, 24)), "t3b", "t5b", "t6b", "t6c", "t11b", "t15b"]
SEEN = part(0.0, 0.0)


def touched(turn: Array, a: float = 0.2, b: float = 0.15) -> PlaneCalibration:
    """Return the calibration from exact touches of a turned sheet."""
    o = np.array([0.4, 0.1, 0.02])
    return fit_touches(SEEN, o, o + a * turn[:, 0], o + b * turn[:, 1], touch_sigma=0.0005)


def tilted(degrees: float) -> Array:
    """Return the grid's pixels in a camera 0.5 m away, with 1200 pixels in a radian."""
    sin, cos = math.sin(math.radians(degrees)), math.cos(math.radians(degrees))
    marks = GRID - GRID.mean(axis=0)
    seen: Array = 1200.0 * marks * (cos, 1.0) / (0.5 + marks[:, :1] * sin)
    return seen


@pytest.mark.parametrize("trap", [trap for trap in TRAPS if trap not in {"t7", "t18"}])
def test_traps_each_one_has_a_test(trap: str) -> None:
    names = {
        name
        for room in ("calibration", "geometry")
        for path in (ROOT / "tests" / room).rglob("test_*.py")
        for name in re.findall(r"^def (test_\w+)", path.read_text("utf-8"), re.MULTILINE)
    }
    wanted = ELSEWHERE.get(trap, (f"test_trap_{trap}_*",))
    for one in wanted:
        ending = re.escape(one).replace(r"\*", r"\w*")
        assert any(re.fullmatch(ending, name) for name in names), one


def test_trap_t1_normal_is_the_cross_product_of_the_rays() -> None:
    found = fit_touches(SEEN, (0, 0, 0), (0.2, 0, 0), (0, 0.15, 0))
    assert found.normal == pytest.approx([0, 0, 1], abs=1e-15)


def test_trap_t2_x_axis_leads_from_the_origin_to_a() -> None:
    found = fit_touches(SEEN, (0.1, 0.1, 0), (0.3, 0.1, 0), (0.1, 0.25, 0))
    assert found.rotation == pytest.approx(np.eye(3), abs=1e-15)


@pytest.mark.parametrize("degrees", [30, 90, 180, -45])
@pytest.mark.parametrize("normal", AXES)
def test_trap_t3_turn_about_the_normal_is_kept(
    normal: tuple[float, float, float], degrees: float
) -> None:
    turn = rotation_about(np.array(normal), math.radians(degrees))
    found = touched(turn)
    assert found.rotation == pytest.approx(turn, abs=1e-12)
    expected = found.origin + 0.2 * turn[:, 0]
    assert spread(found.transform([[0.2, 0.0]]), expected[None]) < 1e-12


@pytest.mark.parametrize("tilt", [(1e-9, 0.0), (-1e-9, 0.0), (0.0, 1e-9), (0.0, -1e-9), (0.0, 0.0)])
def test_trap_t3b_normal_against_z_is_like_any_other(tilt: tuple[float, float]) -> None:
    down = np.diag([1.0, -1.0, -1.0])
    down[2, :2] = tilt
    found = touched(down).to_robot(part(0.2, 0.0, 0.3)).pose
    assert found.position == pytest.approx((0.6, 0.1, 0.02), abs=1e-8)
    heading = matrix_from_quaternion(found.orientation)[:, 0]
    assert heading == pytest.approx([math.cos(0.3), -math.sin(0.3), 0.0], abs=1e-8)


def test_trap_t8_long_rays_are_better_than_short_ones() -> None:
    """At (200, 200) mm a frame from the three points has 5.94 and 0.93 mm."""
    short, long_ = (
        touched(np.eye(3), leg, leg).predicted_error([[0.2, 0.2]])[0] for leg in (0.05, 0.3)
    )
    assert 1e3 * short == pytest.approx(5.16, abs=0.03)
    assert 1e3 * long_ == pytest.approx(0.717, abs=0.003)


def test_trap_t11_orientation_has_the_planes_own_turn() -> None:
    found = touched(yaw(math.radians(30)))
    pose = found.to_robot(part(0.0, 0.0, math.radians(135))).pose
    assert math.degrees(pose.orientation.theta) == pytest.approx(165)


@pytest.mark.parametrize(("degrees", "most_mm"), [(1.0, 0.79), (3.0, 2.41), (5.0, 4.06)])
def test_trap_t12_one_scale_does_not_do_for_a_tilted_camera(degrees: float, most_mm: float) -> None:
    table = Scene(SPECIAL[3], np.array([1.0, -2.0, 0.5])).robot(GRID)
    seen = tilted(degrees)
    similar, bent = (fit_plane(seen, table, model=one) for one in ("similarity", "homography"))
    assert 1e3 * spread(similar.transform(seen), table) == pytest.approx(most_mm, rel=0.15)
    assert spread(bent.transform(seen), table) < 1e-9


def test_trap_t20_normal_is_the_planes_not_the_cameras() -> None:
    scene = Scene(SPECIAL[1], np.zeros(3))
    found = fit_plane(tilted(20.0), scene.robot(GRID), model="homography")
    assert found.normal == pytest.approx([0, 0, -1], abs=1e-9)


@pytest.mark.parametrize(
    ("marks", "field_mm", "corner_mm"),
    [
        (np.array([[0, 0], [0.2, 0], [0, 0.15]]), 0.419, 0.755),
        (grid(2, 2), 0.214, 0.265),
        (GRID, 0.154, 0.200),
        (grid(4, 4), 0.121, 0.160),
        (grid(5, 5), 0.099, 0.133),
    ],
    ids=["o-a-b", "corners", "3x3", "4x4", "5x5"],
)
def test_trap_t23_many_touches_are_better_than_one(
    marks: Array, field_mm: float, corner_mm: float
) -> None:
    touches = Scene(SPECIAL[3], np.zeros(3)).robot(marks)
    found = fit_plane(marks, touches, model="similarity", touch_sigma=SIGMA)
    error = 1e3 * found.predicted_error(grid(61, 49))
    assert math.sqrt((error**2).mean()) == pytest.approx(field_mm, rel=0.04)
    assert error.max() == pytest.approx(corner_mm, rel=0.03)
