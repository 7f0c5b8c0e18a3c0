"""Simulate a table with seven tangram pieces, and a camera that sees it.

The pieces have ground-truth poses in metres. The camera turns them into pixels by a similarity
transformation (scale, rotation, offset) and adds noise; its own calibration is the exact inverse of
that transformation, so its poses in metres differ from the truth only by the noise.
"""

from __future__ import annotations

import math
import random
from typing import TYPE_CHECKING, NamedTuple

from smartcam._arguments import check_flag, check_number, check_seed, wrong_argument

if TYPE_CHECKING:
    from collections.abc import Mapping

TABLE_SIZE = (0.30, 0.25)
"""Width and depth of the table, metres."""


class TablePose(NamedTuple):
    """The pose of a piece: x to the right and y to the back, metres; theta, radians.

    The angle theta is counter-clockwise.
    """

    x: float
    y: float
    theta: float


class Observation(NamedTuple):
    """The observation of one piece by the camera."""

    name: str  # name of the piece
    u: float  # pixels to the right
    v: float  # pixels upwards, or downwards for a scene with ``y_down``
    theta: float  # radians, counter-clockwise (clockwise with ``y_down``), in (-pi, pi]
    quality: float  # 0 to 1


PIECES: Mapping[str, TablePose] = {
    "big_triangle_1": TablePose(0.060, 0.060, 0.30),
    "big_triangle_2": TablePose(0.060, 0.185, -0.80),
    "medium_triangle": TablePose(0.150, 0.055, 1.20),
    "small_triangle_1": TablePose(0.145, 0.130, 2.40),
    "small_triangle_2": TablePose(0.155, 0.205, -2.10),
    "square": TablePose(0.240, 0.065, 0.55),
    "parallelogram": TablePose(0.235, 0.185, -1.35),
}
"""The pieces at their first poses; no two touch, none reaches over the table's edge."""

_HALF_LENGTH_M = 0.02
"""Half the length of a piece, metres: at this distance, pixel noise acts on its angle."""


MAX_PIXELS = 1e9
"""Largest scale, offset and noise, in pixels; more is refused, and so are NaN and infinity."""


class TableScene:
    """Seven pieces on a table and the camera above it.

    Args:
        scale: pixels per metre. 4000 puts the table onto a sensor of 1280 x 1024 pixels.
        offset: pixel of the table's origin.
        rotation: radians, of the image against the table.
        pixel_noise: standard deviation of u and v, pixels.
        seed: seed of the noise; the same seed gives the same observations.
        y_down: v counts downwards, as in image files.

    Raises:
        ConfigurationError: the scale is not positive, or the noise is negative.
    """

    def __init__(
        self,
        *,
        scale: float = 4000.0,
        offset: tuple[float, float] = (45.0, 10.0),
        rotation: float = 0.01,
        pixel_noise: float = 0.2,
        seed: int = 0,
        y_down: bool = False,
    ) -> None:
        if not isinstance(offset, tuple) or len(offset) != 2:
            raise wrong_argument("offset", "a pixel's u and v", offset, "scene")
        limit = MAX_PIXELS
        self.scale: float = check_number(scale, "scale", 0, limit, "scene", exclusive=True)
        self.offset: tuple[float, float] = (
            check_number(offset[0], "offset", -limit, limit, "scene"),
            check_number(offset[1], "offset", -limit, limit, "scene"),
        )
        self.rotation: float = check_number(rotation, "rotation", -limit, limit, "scene")
        self.pixel_noise: float = check_number(pixel_noise, "pixel_noise", 0, limit, "scene")
        self.seed: int = check_seed(seed, "scene")
        self.y_down: bool = check_flag(y_down, "y_down", "scene")
        self.pieces: dict[str, TablePose] = dict(PIECES)
        """Ground truth by name; a change shows in the next measurement."""
        self._random = random.Random(seed)  # noqa: S311  noise, not a secret
        self._v_sign = -1.0 if y_down else 1.0

    def to_pixels(self, pose: TablePose) -> tuple[float, float, float]:
        """Return u, v (pixels) and theta (radians) of a pose on the table, without noise."""
        cos, sin = self.scale * math.cos(self.rotation), self.scale * math.sin(self.rotation)
        u = self.offset[0] + cos * pose.x - sin * pose.y
        v = self.offset[1] + self._v_sign * (sin * pose.x + cos * pose.y)
        return u, v, self._v_sign * (pose.theta + self.rotation)

    def to_table(self, observation: Observation) -> TablePose:
        """Return the pose on the table of an observation, by the camera's calibration."""
        u = observation.u - self.offset[0]
        v = self._v_sign * (observation.v - self.offset[1])
        cos, sin = math.cos(self.rotation) / self.scale, math.sin(self.rotation) / self.scale
        theta = self._v_sign * observation.theta - self.rotation
        return TablePose(cos * u + sin * v, cos * v - sin * u, _wrap_angle(theta))

    def measure(self) -> list[Observation]:
        """Return one observation of each piece, in the order of :attr:`pieces`, with new noise."""
        gauss = self._random.gauss
        observations: list[Observation] = []
        for name, pose in list(self.pieces.items()):  # a test may change them in its own thread
            u, v, theta = self.to_pixels(pose)
            angle_noise = gauss(0.0, self.pixel_noise / (_HALF_LENGTH_M * self.scale))
            observations.append(
                Observation(
                    name=name,
                    u=u + gauss(0.0, self.pixel_noise),
                    v=v + gauss(0.0, self.pixel_noise),
                    theta=_wrap_angle(theta + angle_noise),
                    quality=self._random.uniform(0.95, 1.0),
                )
            )
        return observations


def _wrap_angle(angle: float) -> float:
    """Return an angle in (-pi, pi]."""
    return math.pi - (math.pi - angle) % (2 * math.pi)
