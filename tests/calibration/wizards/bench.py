"""A camera, a robot and a table for tests of the wizard: exact, or with noise of a given seed."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np

from smartcam.models import Header, Localization, Pose, Position, Quaternion

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.calibration.wizards import WizardSession

GRID = [(0.05 + 0.1 * i, 0.04 + 0.08 * j) for j in range(3) for i in range(3)]
"""Marks over a field of 0.3 x 0.24 m, in the camera's frame, metres."""

YAW = math.radians(30.0)
_COS, _SIN = math.cos(YAW), math.sin(YAW)
ROTATION = np.array([[_COS, -_SIN, 0.0], [_SIN, _COS, 0.0], [0.0, 0.0, 1.0]])
"""R_robot_camera: a table that is turned under the robot."""

OFFSET = np.array([0.4, -0.2, 0.05])
"""Place of the camera's origin in the robot's space, metres."""

HELD = Quaternion(1.0, 0.0, 0.0, 0.0)
"""The tool points down."""


def where(x: float, y: float) -> list[float]:
    """Return the robot's touch of a point of the camera, metres."""
    place: list[float] = (ROTATION @ [x, y, 0.0] + OFFSET).tolist()
    return place


class Bench:
    """A camera that sees marks, and a robot whose tip the test moves.

    Args:
        marks: places of the marks, in the camera's frame.
        sigma: standard deviation of a touch, metres.
    """

    def __init__(self, marks: Sequence[tuple[float, float]] = GRID, sigma: float = 0.0) -> None:
        self.marks = list(marks)
        self.sigma = sigma
        self.tip = (0.0, 0.0, 0.0)
        self.pictures = 0
        self._random = np.random.default_rng(7)

    async def localize(self) -> list[Localization]:
        self.pictures += 1
        header = Header(self.pictures, datetime.now(UTC), "camera")
        return [
            Localization("mark", 0.9, 0, Pose(header, Position(x, y), Quaternion.from_theta(0.3)))
            for x, y in self.marks
        ]

    async def read_robot(self) -> Pose:
        return Pose(Header(0, datetime.now(UTC), "robot"), Position(*self.tip), HELD)

    def touch(self, x: float, y: float) -> tuple[float, float, float]:
        """Move the tip onto a point of the camera, and return the tip's place."""
        place = np.array(where(x, y)) + self._random.normal(0.0, self.sigma, 3)
        self.tip = (float(place[0]), float(place[1]), float(place[2]))
        return self.tip

    def touch_mm(self, x: float, y: float) -> dict[str, float]:
        """Return an answer with the tip's place at a point, in mm."""
        return {axis: 1e3 * value for axis, value in zip("xyz", self.touch(x, y), strict=True)}


async def say(session: WizardSession, answers: object = None) -> dict[str, Any]:
    """Answer the current step, which must accept the answer."""
    view = await session.submit(session.token, answers)
    assert view["errors"] == {}, view
    return view
