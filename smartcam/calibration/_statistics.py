"""Test whether noise alone explains residuals, and whether offsets share one move."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from smartcam._extras import load

if TYPE_CHECKING:
    from smartcam.geometry._inside import Array

MAX_MOVED_SPREAD: Final = 0.2
"""Largest distance of an offset from the mean offset, as a part of that mean, of offsets that count
as one common move. Without this test a sheet pushed by 3 to 50 mm before the last two to four of
nine touches, or by 20 mm before the last three of fourteen views, was called good."""


class Noise(NamedTuple):
    """The variance of the touches' noise, and its degrees of freedom."""

    variance: float  # variance of one coordinate, m^2
    # degrees of freedom of the estimate that the variance comes from; None if it was given
    freedom: int | None = None

    def chance(self, squares: float, count: float) -> float:
        """Return the p-value: the probability that noise gives ``squares`` (m^2) or more.

        ``squares``: sum of ``count`` squared residuals.


        This is a chi-square test if the variance was given, and an F-test if it was estimated from
        other squares.
        """
        special = load("scipy.special")
        if self.freedom is None:
            return float(special.chdtrc(count, squares / self.variance))
        return float(special.fdtrc(count, self.freedom, squares / count / self.variance))


def normal_deviations(chance: float | Array) -> float:
    """Convert a probability to the number of standard deviations that is as unlikely."""
    return float(-load("scipy.special").ndtri(0.5 * max(float(chance), 1e-300)))


def common_move(offsets: Array) -> Array | None:
    """Return the mean of two or more offsets (N, K) that are alike; None if they are not."""
    if len(offsets) < 2:
        return None
    middle: Array = offsets.mean(axis=0)
    apart = np.linalg.norm(offsets - middle, axis=1)
    alike = float(apart.max()) < MAX_MOVED_SPREAD * float(np.linalg.norm(middle))
    return middle if alike else None
