"""Wrong results that OpenCV and SciPy give without an error, and smartcam's answer to each."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from smartcam.calibration import RobotSigmas, calibrate_hand_eye, fit_plane
from smartcam.geometry._inside import Code
from tests.calibration.inside import fit_homography
from tests.calibration.scenes import CAMERA, refused, scene

if TYPE_CHECKING:
    from smartcam.geometry._inside import Array

SIGMAS = RobotSigmas(1e-4, 1e-4)
METHODS = ("tsai", "park", "horaud", "andreff", "daniilidis")


@pytest.mark.long
def test_trap_hand_eye_methods_are_not_all_tsais() -> None:
    """``calibrateHandEye(a, b, c, d, METHOD)`` takes the method as an output, and runs Tsai's."""
    poses, views = scene("eye-in-hand", poses=5).simulate_measurements(
        pixel_sigma=0.3, robot_sigmas=SIGMAS, random=np.random.default_rng(2)
    )
    found = [
        calibrate_hand_eye(
            poses, views, setup="eye-in-hand", camera=CAMERA, method=name, adjust="nothing"
        ).camera_pose.translation
        for name in METHODS
    ]
    apart = [float(np.linalg.norm(one - found[0])) for one in found[1:]]
    assert min(apart) > 1e-7


@pytest.mark.parametrize("count", [10, 5000])
def test_trap_homography_to_space_divides(count: int) -> None:
    """``perspectiveTransform`` from two to three dimensions multiplies by ``w``."""
    flat = np.array([(0.0, 0.0), (0.3, 0.0), (0.3, 0.24), (0.0, 0.24), (0.15, 0.12)])
    seen = flat / (1.0 + 0.4 * flat[:, :1])
    calibration = fit_plane(seen, np.column_stack([flat, np.full(5, 0.1)]), model="homography")
    points = np.random.default_rng(3).uniform(0.0, 0.2, (count, 2))
    homogeneous = np.column_stack([points, np.ones(count)]) @ calibration.matrix.T
    expected = homogeneous[:, :3] / homogeneous[:, 3:]
    assert np.abs(calibration.transform(points) - expected).max() < 1e-12
    assert np.abs(expected[:, 2] - 0.1).max() < 1e-9


def line(count: int) -> Array:
    return np.column_stack([np.linspace(0.0, 1.0, count), np.zeros(count)])


def test_trap_homography_of_a_line_is_none() -> None:
    """``findHomography`` returns None, or a random matrix."""
    found = fit_homography(line(6), line(6))
    assert found is None or not np.isfinite(np.linalg.cond(found)) or np.linalg.cond(found) > 1e6


def test_trap_rotation_of_a_line_is_refused() -> None:
    """``align_vectors`` only warns; ``estimateAffine3D`` raises an error of its own."""
    touched = np.column_stack([line(6), np.zeros(6)])
    with refused(Code.COLLINEAR):
        fit_plane(line(6), touched)


@pytest.mark.parametrize("name", METHODS)
def test_trap_turns_about_one_axis_are_refused_by_each_method(name: str) -> None:
    """Tsai's gives 89 mm of error without a warning, Daniilidis' 3155 mm, Park's NaN."""
    poses, views = scene("eye-in-hand").simulate_measurements(
        pixel_sigma=0.1, robot_sigmas=SIGMAS, random=np.random.default_rng(2)
    )
    turned = [
        type(one)(one.target, one.source, about_z(0.2 * i) @ poses[0].rotation, one.translation)
        for i, one in enumerate(poses)
    ]
    with refused(Code.INSUFFICIENT_ROTATION, "about a single axis"):
        calibrate_hand_eye(turned, views, setup="eye-in-hand", camera=CAMERA, method=name)


def about_z(angle: float) -> Array:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
