"""The offset between the clocks of a robot and a camera."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from smartcam.calibration import PoseHistory, Transform, estimate_time_offset
from smartcam.geometry._inside import Rigid
from tests.calibration.inside import Setup
from tests.calibration.scenes import refused

NOON = datetime(2026, 3, 4, 12, tzinfo=UTC)


def pose(seconds: float, speed: float = 1.0) -> Rigid:
    """Return where the flange is: it swings about all axes, at some 0.2 m/s."""
    t = speed * seconds
    step = [
        *(0.4 * np.sin(0.9 * t), 0.4 * np.sin(1.3 * t + 1), 0.5 * np.sin(0.7 * t + 2)),
        *(0.2 * np.sin(1.1 * t), 0.15 * np.sin(0.8 * t + 1), 0.6 + 0.1 * np.sin(1.7 * t)),
    ]
    return Rigid(np.eye(3), np.zeros(3)).turned_in_source(np.array(step))


def drive(
    setup: Setup, offset: float, *, speed: float = 1.0, sigma: float = 2e-4
) -> tuple[PoseHistory, list[Transform]]:
    """Return a history, and views whose times are ``offset`` before the robot's."""
    random = np.random.default_rng(6)
    history = PoseHistory(size=10_000)
    for number in range(700):
        moment = NOON + timedelta(seconds=number / 50)
        history.add(Transform("base", "flange", *pose(number / 50, speed), at=moment))
    camera = pose(3.0).turned_in_source(np.array([0.1, -0.2, 0.3, 0.0, 0.1, 0.0]))
    target, seen = pose(5.0), []
    for number in range(24):
        seconds = 1.0 + number / 2.1
        between = pose(seconds, speed)
        between = between.inverse() if setup == "eye-in-hand" else between
        there = (camera.inverse() @ between @ target).turned_in_source(random.normal(0.0, sigma, 6))
        moment = NOON + timedelta(seconds=seconds - offset)
        seen.append(Transform("camera", "target", *there, at=moment))
    return history, seen


def _long(*values: object) -> object:
    return pytest.param(*values, marks=pytest.mark.long)


@pytest.mark.sampled(every=2)
@pytest.mark.parametrize(
    ("setup", "offset"),
    [
        ("eye-in-hand", -0.11),
        ("eye-to-hand", 0.037),
        _long("eye-in-hand", 0.0),
        _long("eye-to-hand", 0.0),
        _long("eye-in-hand", 0.037),
        _long("eye-to-hand", -0.11),
    ],
)
def test_time_offset_is_found_within_its_sigma(setup: Setup, offset: float) -> None:
    found = estimate_time_offset(*drive(setup, offset), setup=setup)
    assert abs(found.seconds - offset) < 4 * found.sigma < 0.01
    assert found.rms_after < 2e-3
    if offset:
        assert found.rms_before > 4 * found.rms_after


@pytest.mark.long
def test_time_offset_of_a_robot_that_stands_still_is_not_told() -> None:
    history, seen = drive("eye-in-hand", 0.05)
    still = PoseHistory(size=10_000)
    for one in seen:
        assert one.at is not None
        there = history.at(one.at).rigid
        for step in (-0.04, -0.02, 0.0, 0.02, 0.04):
            moment = one.at + timedelta(seconds=step)
            still.add(Transform("base", "flange", *there, at=moment))
    with refused("BAD_TIME", "take pictures while the robot moves"):
        estimate_time_offset(still, seen, setup="eye-in-hand", max_offset=0.04)


def test_time_offset_says_what_it_wants() -> None:
    history, seen = drive("eye-in-hand", 0.0)
    with refused("TOO_FEW", "10 views or more, got 9"):
        estimate_time_offset(history, seen[:9], setup="eye-in-hand")
    with refused("BAD_TIME", "view 0 with a time, got none"):
        estimate_time_offset(history, [seen[0].undated(), *seen[1:]], setup="eye-in-hand")
    with refused("BAD_TIME", "nothing is extrapolated"):
        estimate_time_offset(history, seen, setup="eye-in-hand", max_offset=5.0)
    for setup in ("eye_in_hand", "", None, ["eye-in-hand"]):
        with refused("SHAPE", "setup: expected one of ['eye-in-hand', 'eye-to-hand'], got"):
            estimate_time_offset(history, seen, setup=setup)  # type: ignore[arg-type]
