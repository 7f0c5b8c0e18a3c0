"""Check whether views show the target in enough places and ways to calibrate a lens well."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.geometry._inside import Array

SUFFICIENT_RANGES: Final[dict[str, float]] = {"x": 0.7, "y": 0.7, "size": 0.4, "skew": 0.5}
"""Range, over all views, that is enough of each quantity of :class:`Coverage`.

Source: ROS' camera_calibration, calibrator.py (published).
"""


class Coverage(NamedTuple):
    """Coverage of each quantity, from 0 to 1; 1 is good enough.

    Attributes:
        x: range of places from left to right.
        y: range of places from top to bottom.
        size: range of sizes from far to near.
        skew: range of tilts from head-on to tilted.
    """

    x: float
    y: float
    size: float
    skew: float

    @property
    def lacking(self) -> tuple[str, ...]:
        """Names of the quantities below 1."""
        values = self._asdict().items()
        return tuple(name for name, value in values if value < 1.0)


def coverage(outlines: Sequence[Array], size: tuple[int, int]) -> Coverage:
    """Return the coverage of views: of places, sizes and tilts of the target.

    For each view, x and y are the place of the target's centre within the range in which the target
    stays in the image. ``size`` is the square root of the target's part of the image's area, and
    ``skew`` twice the angle, in radians, by which its first corner differs from a right angle. A
    coverage is the range of a quantity over the views, divided by its value in
    :data:`SUFFICIENT_RANGES`.

    ``outlines``: the target's four outer points in order (4, 2), pixels, of each view. ``size``:
    width and height of the images, pixels.
    """
    quantities = np.array([_quantities(outline, size) for outline in outlines])
    ranges = np.ptp(quantities, axis=0) if len(quantities) else np.zeros(4)
    sufficient = np.array(list(SUFFICIENT_RANGES.values()))
    return Coverage(*np.minimum(ranges / sufficient, 1.0).tolist())


def _quantities(outline: Array, size: tuple[int, int]) -> list[float]:
    x, y = outline.T
    # shoelace formula
    area = 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))
    side = math.sqrt(area)
    places = [
        float(np.clip((mean - side / 2) / max(length - side, 1.0), 0.0, 1.0))
        for mean, length in zip(outline.mean(axis=0).tolist(), size, strict=True)
    ]
    first_side, second_side = outline[0] - outline[1], outline[2] - outline[1]
    lengths = float(np.linalg.norm(first_side) * np.linalg.norm(second_side))
    angle = (
        math.acos(max(-1.0, min(1.0, float(first_side @ second_side) / lengths)))
        if lengths
        else 0.0
    )
    skew = min(1.0, 2.0 * abs(math.pi / 2 - angle))
    return [*places, math.sqrt(area / (size[0] * size[1])), skew]
