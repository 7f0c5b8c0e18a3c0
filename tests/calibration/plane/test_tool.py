"""The tip of a tool from touches of one point."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from smartcam.calibration import ToolOffset, Transform, fit_tool_tip
from tests.calibration.inside import Poses
from tests.geometry.rigid import (
    refused,
    rotation_about,
    transforms,
    yaw,
)

TIP = np.array([0.012, -0.007, 0.145])
POINT = np.array([0.4, -0.2, 0.1])
DOWN = np.diag([1.0, -1.0, -1.0])


def touching(rotation: NDArray[np.float64]) -> Transform:
    return Transform("base", "flange", rotation, POINT - rotation @ TIP)


def test_tool_tip_of_four_orientations_is_exact() -> None:
    turns = [
        rotation_about(np.array(n), 0.3)
        for n in ([0, 0, -1], [0.5, 0, -1], [0, 0.5, -1], [-0.4, -0.4, -1])
    ]
    found = fit_tool_tip([touching(turn) for turn in turns])
    np.testing.assert_allclose(found.tip, TIP, atol=1e-12)
    np.testing.assert_allclose(found.point, POINT, atol=1e-12)
    np.testing.assert_allclose(found.residuals, np.zeros((4, 3)), atol=1e-12)
    assert found.unknown_axis is None


def test_tool_tip_of_two_yaws_is_exact_across_their_axis() -> None:
    found = fit_tool_tip([touching(DOWN), touching(DOWN @ yaw(np.pi))])
    np.testing.assert_allclose(found.tip, [*TIP[:2], 0], atol=1e-12)
    assert found.unknown_axis is not None
    np.testing.assert_allclose(np.abs(found.unknown_axis), [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(found.point[:2], POINT[:2], atol=1e-12)


@given(transforms("base", "base"), st.permutations(range(4)))
def test_tool_tip_does_not_depend_on_base_and_order(base: Transform, order: list[int]) -> None:
    turns = [
        DOWN @ rotation_about(np.array(n), 1) for n in ([1, 0, 1], [0, 1, 1], [-1, 0, 1], [0, 0, 1])
    ]
    flanges = [touching(turns[index]) for index in order]
    found = fit_tool_tip([base @ flange for flange in flanges])
    np.testing.assert_allclose(found.tip, TIP, atol=1e-10)
    np.testing.assert_allclose(found.point, base.apply(POINT), atol=1e-10)


@pytest.mark.parametrize(("angle", "error"), [(0, 0.0), (90, 1.414e-3), (180, 2e-3)])
def test_tool_tip_error_that_was_found_is_gone_at_every_yaw(angle: int, error: float) -> None:
    """1 mm of error at the tip: 0, 1.41 and 2 mm off at a yaw of 0, 90 and 180 degrees."""
    off = np.array([1e-3, 0, 0])
    touched = touching(DOWN).apply(TIP + off)  # the tip by the controller
    target = Transform("base", "part", DOWN @ yaw(np.radians(angle)), touched)
    poses = Poses(target.translation[None], target.quaternion[None])

    def reached(tip: NDArray[np.float64]) -> NDArray[np.float64]:
        to = ToolOffset.flange(tip).solve(poses)
        flange = Transform.from_quaternion("base", "flange", to.points[0], to.quaternions[0])
        return flange.apply(TIP)

    assert np.linalg.norm(reached(TIP + off) - POINT) == pytest.approx(error, abs=1e-6)
    tip = fit_tool_tip([touching(DOWN), touching(DOWN @ yaw(2.0))]).tip
    np.testing.assert_allclose(reached(np.array([*tip[:2], TIP[2]])), touched, atol=1e-12)


def test_tool_tip_residuals_show_a_bad_touch() -> None:
    turns = [DOWN @ rotation_about(np.array([0.5, 0, 1]), turn) for turn in range(6)]
    flanges = [touching(turn @ yaw(index)) for index, turn in enumerate(turns)]
    bad = flanges[2]
    flanges[2] = Transform(
        "base", "flange", bad.rotation, bad.translation + np.array([0.005, 0, 0])
    )
    lengths = np.linalg.norm(fit_tool_tip(flanges).residuals, axis=1)
    assert int(np.argmax(lengths)) == 2
    assert lengths[2] > 0.002


def test_tool_tip_without_turns_is_refused() -> None:
    with refused("TOO_FEW", "two touches or more, got 1"):
        fit_tool_tip([touching(DOWN)])
    with refused("INSUFFICIENT_ROTATION", "orientations that differ", "0.087"):
        fit_tool_tip([touching(DOWN), touching(DOWN @ yaw(np.radians(10)))])


def test_tool_tip_of_poses_in_different_frames_is_refused() -> None:
    first, second = touching(DOWN), touching(np.eye(3))
    other = Transform("cell", "flange", second.rotation, second.translation)
    with refused("WRONG_FRAME", "got T_base_flange and T_cell_flange"):
        fit_tool_tip([first, other])
