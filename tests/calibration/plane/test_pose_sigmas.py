"""Compare predicted errors of poses in the robot's space with many calibrations."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartcam.calibration import fit_plane
from smartcam.models import Header, Localization, Pose, PoseSigma, Position, Quaternion
from tests.geometry.rigid import NOON

SEEN = np.array([(0.0, 0.0), (0.3, 0.0), (0.3, 0.2), (0.0, 0.2), (0.15, 0.1)])
TILT = Rotation.from_euler("xyz", (20, -30, 130), degrees=True).as_matrix()
TOUCH, PLACE, TURN = 2e-4, (1e-4, 3e-4), 1e-3


def localized(x: float, y: float, theta: float, sigma: PoseSigma | None) -> Localization:
    pose = Pose(Header(1, NOON, "cam"), Position(x, y), Quaternion.from_theta(theta))
    return Localization("part", 1.0, 0, pose if sigma is None else pose.with_sigma(sigma))


@pytest.mark.parametrize(
    ("model", "count", "within"),  # of 100 a standard deviation is known to 7 %, of 400 to 3.5 %
    [("similarity", 100, 0.25), pytest.param("homography", 400, 0.12, marks=pytest.mark.judged)],
)
def test_sigma_is_that_of_many_calibrations(model: str, count: int, within: float) -> None:
    random = np.random.default_rng(5)
    true = np.column_stack([SEEN, np.zeros(5)]) @ TILT.T + (0.4, 0.1, 0.2)
    correlation = 0.6
    sigma = PoseSigma(*PLACE, TURN, correlation, -0.5, 0.2)
    unit = np.array([[1, 0.6, -0.5], [0.6, 1, 0.2], [-0.5, 0.2, 1]])
    own = unit * np.outer((*PLACE, TURN), (*PLACE, TURN))
    found: list[tuple[float, ...]] = []
    said: list[PoseSigma] = []
    for _ in range(count):
        touched = true + random.normal(scale=TOUCH, size=true.shape)
        calibration = fit_plane(SEEN, touched, model=model, touch_sigma=TOUCH)  # type: ignore[arg-type]
        x, y, theta = random.multivariate_normal((0.25, 0.03, 0.7), own)
        (part,) = calibration.to_robot([localized(x, y, theta, sigma)])
        turn = TILT.T @ Rotation.from_quat(part.pose.orientation).as_matrix()
        found.append((*part.pose.position, math.atan2(turn[1, 0], turn[0, 0])))
        one = part.pose.sigma
        assert one is not None
        said.append(one)
    observed = np.cov(np.array(found).T)
    mean = [np.mean([getattr(one, name) for one in said]) for name in ("x", "y", "z", "theta")]
    np.testing.assert_allclose(mean, np.sqrt(np.diag(observed)), rtol=within)
    seen = np.corrcoef(np.array(found).T)[[0, 0, 1], [1, 3, 3]]
    np.testing.assert_allclose(said[-1][3:6], seen, atol=within)


def test_flip_turns_the_angle_and_poses_without_sigma_have_none() -> None:
    touched = np.column_stack([SEEN, np.zeros(5)])
    calibration = fit_plane(SEEN, touched, touch_sigma=1e-6)
    sigma = PoseSigma(*PLACE, TURN, 0.0, -0.5, 0.2)
    parts = [localized(0.1, 0.1, 0.3, None), localized(0.1, 0.1, 0.3, sigma)]
    plain, flipped = calibration.to_robot(parts), calibration.to_robot(parts, tool_flip=True)
    assert plain[0].pose.sigma is None
    one, other = plain[1].pose.sigma, flipped[1].pose.sigma
    assert one is not None
    assert other is not None
    assert one[:2] == pytest.approx(PLACE, rel=1e-3)
    assert (one.correlation_xt, one.correlation_yt) == pytest.approx((-0.5, 0.2), abs=1e-3)
    assert (other.correlation_xt, other.correlation_yt) == pytest.approx((0.5, -0.2), abs=1e-3)
    assert calibration.to_robot(parts[1]).pose.sigma == one
    unknown = fit_plane(SEEN[:3], touched[:3], model="affine")
    assert unknown.touch_sigma is None
    assert unknown.to_robot(parts[1]).pose.sigma is None
