"""Planes in space with cameras over them and robots that touch, as the truth of tests."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from smartcam.geometry._inside import Array, rotate_ccw
from smartcam.models import Header, Localization, Pose, Position, Quaternion

__all__ = ["GRID", "SIGMA", "Scene", "grid", "part", "scenes", "spread"]

SIGMA = 0.0002
"""Standard deviation of a touch, metres."""


def grid(columns: int, rows: int, width: float = 0.3, height: float = 0.24) -> Array:
    """Return marks over a field, (N, 2), metres."""
    across, along = np.linspace(0, width, columns), np.linspace(0, height, rows)
    return np.stack(np.meshgrid(across, along), axis=-1).reshape(-1, 2)


GRID = grid(3, 3)


@dataclass(frozen=True)
class Scene:
    """The place of a camera's plane in a robot's space.

    Attributes:
        turn: R_robot_camera (3, 3).
        origin: place of the camera's (0, 0) (3,), metres.
        scale: metres for each unit of the camera.
    """

    turn: Array
    origin: Array
    scale: float = 1.0

    def camera(self, marks: Array) -> Array:
        """Return the camera's coordinates of marks (N, 2), which are in metres, in its own unit."""
        seen: Array = marks / self.scale
        return seen

    def robot(self, marks: Array) -> Array:
        """Return the places (N, 3) of marks (N, 2)."""
        lying: Array = marks @ self.turn[:, :2].T + self.origin
        return lying

    def touched(self, marks: Array, seed: int, sigma: float = SIGMA) -> Array:
        """Return a robot's touches (N, 3) of marks, with noise."""
        noise = np.random.default_rng(seed).normal(size=(len(marks), 3))
        touches: Array = self.robot(marks) + sigma * noise
        return touches


def part(x: float, y: float, theta: float = 0.0, *, frame: str = "camera") -> Localization:
    """Return a part that a camera has found."""
    header = Header(7, datetime(2024, 5, 1, tzinfo=UTC), frame)
    pose = Pose(header, Position(x, y, 0.0), Quaternion.from_theta(theta))
    return Localization("cube", 0.9, 1, pose)


def spread(calibrated: Array, truth: Array) -> float:
    """Return the largest distance of points (N, 3)."""
    return float(np.linalg.norm(calibrated - truth, axis=1).max())


def _turn(values: tuple[float, float, float, float]) -> Array:
    return np.asarray(Rotation.from_quat(values).as_matrix())


SPECIAL = [
    np.eye(3),
    np.diag([1.0, -1.0, -1.0]),
    np.diag([-1.0, 1.0, -1.0]),
    np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
    np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
]
"""Normals along and against z, the latter in two attitudes, and along and against x."""

_unit = st.floats(-1, 1)
_turns = st.one_of(
    st.sampled_from(SPECIAL),
    st.tuples(_unit, _unit, _unit, _unit)
    .filter(lambda values: math.hypot(*values) > 0.1)
    .map(_turn),
)


@st.composite
def scenes(draw: st.DrawFn) -> Scene:
    """Draw a plane in any octant, in any attitude, seen in any unit."""
    signs = draw(st.tuples(*[st.sampled_from([-1.0, 1.0])] * 3))
    distances = draw(st.tuples(*[st.floats(0, 10)] * 3))
    yaw, scale = draw(st.floats(-math.pi, math.pi)), 10.0 ** draw(st.floats(-6, 3))
    turn = draw(_turns).copy()
    turn[:, :2] = rotate_ccw(turn[:, :2], -yaw)
    return Scene(turn, np.multiply(signs, distances), scale)
